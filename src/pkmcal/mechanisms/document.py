"""The schema of ``mechanism.yaml``; docs/files.md spells it out for people.

A limb in it: what carries its two ends (a carrier's own schema), the rod between them, and what a
camera sees of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache, reduce
from operator import or_
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, GetJsonSchemaHandler, Tag, TypeAdapter
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from pkmcal.arrays import Array
from pkmcal.errors import LONGEST_NAME
from pkmcal.files import MOST_LEG_TUBES, MOST_MACHINE_LEGS, Metres, Point, Radians, Schema, Share
from pkmcal.mechanisms.carriers.contract import (
    Carrier,
    ParameterKind,
    base_carriers,
    platform_carriers,
)
from pkmcal.mechanisms.parameters import EVERY_LEG


def _increasing(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 < value[0] < value[1]:
        raise ValueError("should be two increasing positive lengths [min, max]")
    return value


class ActuatedLength(Schema):
    """``length: {actuated: true, offset: 0.0, range: [min, max]}``; length = reading's true value +
    offset.
    """

    actuated: Literal[True]
    offset: Metres = 0.0
    range: Annotated[tuple[Metres, Metres], AfterValidator(_increasing)] | None = None


class ConstantLength(Schema):
    """``length: {actuated: false, constant: 0.48}``: a rod of one length, metres."""

    actuated: Literal[False]
    constant: Annotated[Metres, Field(gt=0, description="the rod's length in metres")]


class PassiveLength(Schema):
    """``length: {passive: true}``: free to change, nobody reads it; it adds no equation."""

    passive: Literal[True]


def rod_kind(value: Any) -> str:
    """Which of the three a ``length`` in the file is, told apart so that errors name its fields.

    Tags are no keys of a file, or an error's place would be taken for the key.
    """
    if isinstance(value, Schema):
        value = value.model_dump()
    if not isinstance(value, dict):
        return "actuated rod"
    if value.get("passive"):
        return "passive rod"
    return "constant rod" if value.get("actuated") is False else "actuated rod"


Rod = Annotated[
    Annotated[ActuatedLength, Tag("actuated rod")]
    | Annotated[ConstantLength, Tag("constant rod")]
    | Annotated[PassiveLength, Tag("passive rod")],
    Discriminator(rod_kind),
]

OFFSET_KIND = ParameterKind("offset", "m", "offset", part="zero")
CONSTANT_LENGTH_KIND = ParameterKind("constant", "m", "offset", label="rod length", part="rod")
READING_SCALE_KIND = ParameterKind("scale", "", "scale", 1.0, label="reading scale", part="lead")
EXACT_TURNS, LEAD_TOLERANCE = 0.0, 0.0005
"""Tolerances of a reading's scale where the file gives none: of readings in rad, since an encoder
counts whole turns and a gear has whole teeth; of readings in m, a ground screw's or a tape's."""


PlatformMotion = Literal["spatial", "planar", "translation", "schoenflies", "planar-translation"]
MOTION_DIRECTIONS: dict[str, Array] = {
    "spatial": np.eye(6),
    "planar": np.eye(6)[:, [2, 3, 4]],
    "translation": np.eye(6)[:, 3:],
    "schoenflies": np.eye(6)[:, 2:],
    "planar-translation": np.eye(6)[:, [3, 4]],
}
"""Columns: the directions (omega, tau) in which the platform can move, base frame; neighbours."""


class _OneOfTheCarriers:
    """A part that is in the schema of one of the carriers known when a file is read, told apart by
    ``joint``, so that errors name the right field.
    """

    def __init__(self, carriers: Callable[[], Mapping[str, type[Carrier]]]) -> None:
        self.carriers = carriers

    def adapter(self) -> TypeAdapter[Any]:
        """What reads the union of the carriers' schemas."""
        return _union(tuple(dict.fromkeys(c.schema for c in self.carriers().values())))

    def read(self, value: Any) -> Any:
        """The part, from a file's content or from another machine's document."""
        if isinstance(value, Schema):
            return value
        return self.adapter().validate_json(
            json.dumps(value)
        )  # as :func:`pkmcal.files.validated_document`

    def __get_pydantic_core_schema__(self, *_: Any) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(
        self, _: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        return handler(self.adapter().core_schema)


@cache
def _union(schemas: tuple[type[Schema], ...]) -> TypeAdapter[Any]:
    one: Any = reduce(or_, schemas)
    if len(schemas) > 1:
        one = Annotated[one, Field(discriminator="joint")]
    return TypeAdapter(one)


BaseNode = Annotated[Any, _OneOfTheCarriers(base_carriers)]
PlatformNode = Annotated[Any, _OneOfTheCarriers(platform_carriers)]


class Tube(Schema):
    """One visible cylinder of a leg; ``from`` and ``to`` in metres from A along the leg."""

    radius: Annotated[Metres, Field(gt=0)]
    start: Annotated[Metres, Field(alias="from", ge=0)]
    stop: Annotated[Metres, Field(alias="to")]

    def model_post_init(self, _context: Any) -> None:
        """A tube has a length."""
        if self.stop <= self.start:
            raise ValueError("tube's 'to' should be greater than its 'from'")


class Leg(Schema):
    """One limb: its carriers, its rod, its reading's scale, and what a camera sees of it."""

    base: BaseNode
    platform: PlatformNode
    length: Rod
    scale: Annotated[
        float,
        Field(gt=0.5, lt=2, description="the reading's true value over the reading, such as 1.0"),
    ] = 1.0
    tubes: Annotated[tuple[Tube, ...], Field(max_length=MOST_LEG_TUBES)] = ()


TOLERANCE_RANGE = Field(ge=1e-12)
"""m; nothing is made better, and it would be exact. The most depends on the machine's size."""


class DrawingTolerance(Schema):
    """Standard deviations of the drawing's values, metres; of axes and angles, radians; of scales,
    parts of one, where 0 is exact.
    """

    center: Annotated[Metres, TOLERANCE_RANGE] = 0.002
    offset: Annotated[Metres, TOLERANCE_RANGE] = 0.002
    radius: Annotated[Metres, TOLERANCE_RANGE] = 0.0001
    axis: Annotated[Radians, Field(ge=1e-12, lt=1)] = 0.005
    arm: Annotated[Metres, TOLERANCE_RANGE] = 0.001
    angle: Annotated[Radians, Field(ge=1e-12, lt=1)] = 0.02
    scale: Annotated[Share, Field(ge=0, lt=0.1)] | None = None


class Home(Schema):
    """A pose in the middle of the workspace; it decides which assembly the machine has."""

    position: Point
    rotation_vector: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)


def _some_legs(legs: tuple[Leg, ...]) -> tuple[Leg, ...]:
    if len(legs) < 2:
        raise ValueError("a parallel machine has at least two legs")
    carriers = base_carriers()
    if not any(isinstance(x.length, ActuatedLength) or carriers[x.base.joint].driven for x in legs):
        raise ValueError("a machine has at least one leg with actuated: true")
    return legs


def _several(group: tuple[str, ...]) -> tuple[str, ...]:
    """A tie has two members at least; one that stands for all legs counts as several."""
    if len(group) < 2 and not any(EVERY_LEG in entry for entry in group):
        counts = {"field_type": "Tuple", "min_length": 2, "actual_length": len(group)}
        raise PydanticKnownError("too_short", counts)
    return group


Ties = tuple[Annotated[tuple[str, ...], AfterValidator(_several)], ...]


class DocumentModel(Schema):
    """What a machine's model holds and ties, or the other file that describes it."""

    fixed: tuple[str, ...] = ()
    tied: Ties = ()
    mechanism: str | None = None

    def model_post_init(self, _context: Any) -> None:
        """Another file has roles of its own."""
        if self.mechanism is not None and (self.fixed or self.tied):
            raise ValueError("a model with 'mechanism' takes 'fixed' and 'tied' from that file")


class MechanismDocument(Schema):
    """A whole mechanism file."""

    name: Annotated[str, Field(max_length=LONGEST_NAME)]
    motion: PlatformMotion
    legs: Annotated[
        tuple[Leg, ...], Field(max_length=MOST_MACHINE_LEGS), AfterValidator(_some_legs)
    ]
    tolerance: DrawingTolerance = DrawingTolerance()
    home: Home | None = None
    workspace_radius: (
        Annotated[
            Metres,
            Field(gt=0, description="the radius about z that a controller keeps to, such as 90 mm"),
        ]
        | None
    ) = None
    fixed: tuple[str, ...] = ()
    tied: Ties = ()
    models: dict[str, DocumentModel] = Field(default_factory=dict)
