"""Schema of ``mechanism.yaml``, documented for users in docs/files.md.

A limb consists of the carriers of its two ends (each with a schema of its own), the rod between
them, and its visible tubes.
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
from pkmcal.files import (
    MOST_LEG_TUBES,
    MOST_MACHINE_LEGS,
    FieldError,
    Metres,
    Point,
    Radians,
    Schema,
    Share,
)
from pkmcal.mechanisms.carriers.contract import (
    Carrier,
    ParameterKind,
    base_carriers,
    platform_carriers,
)
from pkmcal.mechanisms.parameters import EVERY_LEG


def _check_increasing(value: tuple[float, float]) -> tuple[float, float]:
    """Validate a range of lengths."""
    if not 0 < value[0] < value[1]:
        raise FieldError(
            "this is no range of lengths",
            found=list(value),
            expected="two increasing positive lengths [min, max]",
        )
    return value


class ActuatedLength(Schema):
    """Rod with a reading, ``length: {actuated: true, offset: 0.0, range: [min, max]}``; length =
    scale * reading + offset, less what a screw that is not held from rotating adds: its lead per
    turn of the outer joint relative to the inner one.
    """

    actuated: Literal[True]
    offset: Metres = 0.0
    range: Annotated[tuple[Metres, Metres], AfterValidator(_check_increasing)] | None = None
    lead: (
        Annotated[
            Metres,
            Field(ge=-0.1, le=0.1, description="the lead of a screw that the joints turn, such as"
                  " 5 mm, negative for a left-hand thread"),
        ]
        | None
    ) = None  # fmt: skip


class ConstantLength(Schema):
    """Rod of constant length, ``length: {actuated: false, constant: 0.48}``, m."""

    actuated: Literal[False]
    constant: Annotated[Metres, Field(gt=0, description="the rod's length in metres")]


class PassiveLength(Schema):
    """Rod of free, unmeasured length, ``length: {passive: true}``; it adds no equation."""

    passive: Literal[True]


def rod_kind(value: Any) -> str:
    """Tag of the schema that applies to a ``length``, so that errors name fields of the right
    schema.

    Tags must not be keys of the file, else an error's location would be mistaken for the key.
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
"""Parameters of a leg's rod and reading."""
EXACT_TURNS, LEAD_TOLERANCE = 0.0, 0.0005
"""Default prior sigmas of a reading's scale: of readings in rad, zero because encoders count whole
turns and gears have whole teeth; of readings in m, that of a ground screw or a tape."""


PlatformMotion = Literal["spatial", "planar", "translation", "schoenflies", "planar-translation"]
MOTION_DIRECTIONS: dict[str, Array] = {
    "spatial": np.eye(6),
    "planar": np.eye(6)[:, [2, 3, 4]],
    "translation": np.eye(6)[:, 3:],
    "schoenflies": np.eye(6)[:, 2:],
    "planar-translation": np.eye(6)[:, [3, 4]],
}
"""Columns: directions (omega, tau) in which the platform can move, base frame; they are adjacent
among the six."""


def _check_turn(angle: float) -> float:
    """Validate an angle: a number beyond a turn was written in degrees."""
    if abs(angle) > 2 * np.pi:
        raise FieldError(
            "this angle is more than a turn; without a unit it is in radians",
            found=f"{angle:g}",
            expected="at most a turn, such as 15 deg",
        )
    return angle


class PolarCentre(Schema):
    """Joint centre about the z axis of its frame, with angles from x towards y:
    ``center: {radius: 300 mm, angle: 15 deg, z: 0}``.
    """

    radius: Annotated[
        Metres, Field(ge=0, description="the distance from the z axis, such as 300 mm")
    ]
    angle: Annotated[
        Radians,
        AfterValidator(_check_turn),
        Field(description="the angle from x towards y, such as 15 deg"),
    ]
    z: Annotated[Metres, Field(description="the height, such as 12.5 mm")] = 0.0

    @property
    def point(self) -> tuple[float, float, float]:
        """[x, y, z], m."""
        x, y = self.radius * np.cos(self.angle), self.radius * np.sin(self.angle)
        return float(x), float(y), self.z


class _WithPolarCentre(Schema):
    """A carrier's polar centre, with its key for the messages."""

    center: PolarCentre


class _OneOfTheCarriers:
    """Annotation of a field that has the schema of one of the carriers, selected by ``joint``.

    The union is built when a file is read. The discriminator makes errors name the right field.
    """

    def __init__(self, carriers: Callable[[], Mapping[str, type[Carrier]]]) -> None:
        self.carriers = carriers

    def adapter(self) -> TypeAdapter[Any]:
        """Adapter for the union of the carriers' schemas."""
        return _union_adapter(tuple(dict.fromkeys(c.schema for c in self.carriers().values())))

    def read(self, value: Any) -> Any:
        """Validated field, from a file's content or from another machine's document."""
        if isinstance(value, Schema):
            return value
        if isinstance(value, dict) and isinstance(value.get("center"), dict):
            text = json.dumps({"center": value["center"]})
            value = {**value, "center": _WithPolarCentre.model_validate_json(text).center.point}
        return self.adapter().validate_json(
            json.dumps(value)
        )  # as :func:`pkmcal.files.validated_document`

    def __get_pydantic_core_schema__(self, *_: Any) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(
        self, _: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        adapters = (self.adapter(), TypeAdapter(_WithPolarCentre))
        return {"anyOf": [handler(adapter.core_schema) for adapter in adapters]}


@cache
def _union_adapter(schemas: tuple[type[Schema], ...]) -> TypeAdapter[Any]:
    """Adapter for a union of schemas, discriminated by ``joint``."""
    one: Any = reduce(or_, schemas)
    if len(schemas) > 1:
        one = Annotated[one, Field(discriminator="joint")]
    return TypeAdapter(one)


BaseNode = Annotated[Any, _OneOfTheCarriers(base_carriers)]
PlatformNode = Annotated[Any, _OneOfTheCarriers(platform_carriers)]


class Tube(Schema):
    """Visible cylinder of a leg; ``from`` and ``to`` in metres from A along the leg."""

    radius: Annotated[Metres, Field(gt=0)]
    start: Annotated[Metres, Field(alias="from", ge=0)]
    stop: Annotated[Metres, Field(alias="to")]

    def model_post_init(self, _context: Any) -> None:
        """Refuse tubes without positive length."""
        if self.stop <= self.start:
            raise FieldError(
                "a tube has no length",
                found=f"from {self.start:g} to {self.stop:g}",
                expected="'to' greater than 'from'",
            )


class Leg(Schema):
    """Limb: carriers, rod, scale of its reading, and visible tubes."""

    base: BaseNode
    platform: PlatformNode
    length: Rod
    scale: Annotated[
        float,
        Field(gt=0.5, lt=2, description="the reading's true value over the reading, such as 1.0"),
    ] = 1.0
    stiffness: (
        Annotated[
            float,
            Field(gt=0, le=1e15, description="the drive's stiffness, N/m (of a crank N m/rad), such"
                  " as 2.0e6"),
        ]
        | None
    ) = None  # fmt: skip
    axial_rigidity: (
        Annotated[
            float,
            Field(gt=0, le=1e15, description="modulus times cross-section EA of the cable or rod,"
                  " N: the force over the strain, such as 2.0e4"),
        ]
        | None
    ) = None  # fmt: skip
    tubes: Annotated[tuple[Tube, ...], Field(max_length=MOST_LEG_TUBES)] = ()


class Load(Schema):
    """Weight on the platform, under which drives yield by their legs' ``stiffness`` and
    ``axial_rigidity``.

    mass : kg, of the platform with all that it carries. center : its centre, platform frame, m.
    gravity : m/s^2, base frame.
    """

    mass: Annotated[float, Field(gt=0, le=1e6, description="the mass in kg, such as 12")]
    center: Point = (0.0, 0.0, 0.0)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)


STIFFNESS_TOLERANCE = 0.3
"""Default prior sigma of all drives' compliance, relative: joints and bearings yield, too."""
STEEL_EXPANSION = 11.5e-6
"""Relative growth of steel's length, 1/K: the prior sigma of a machine's growth."""
Growing = Annotated[
    float, Field(ge=-1e-3, le=1e-3, description="growth per kelvin, such as 11.5e-6")
]


class Growth(Schema):
    """Thermal growth of lengths relative to those of the file, 1/K.

    temperature : of the file's lengths, °C. drives : of
    screws, racks and their zeros. frame : of joint centres, arms and rods of constant length.
    sigma : standard deviations of drives and frame; correlation : of the two.
    """

    temperature: Annotated[float, Field(ge=-300, le=2000)]
    drives: Growing = 0.0
    frame: Growing = 0.0
    sigma: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] = (
        STEEL_EXPANSION,
        STEEL_EXPANSION,
    )
    correlation: Annotated[float, Field(gt=-1, lt=1)] = 0.0

    @property
    def root(self) -> Array:
        """Root L (2, 2) of the covariance L L^T of drives and frame."""
        mutual = np.array([[1.0, self.correlation], [self.correlation, 1.0]])
        return np.diag(self.sigma) @ np.linalg.cholesky(mutual)


TOLERANCE_RANGE = Field(ge=1e-12)
"""Range of prior sigmas of lengths, m. Smaller values would be exact; the upper bound depends on
the machine's size."""


class NominalTolerance(Schema):
    """Prior sigmas of the nominal values: lengths in metres, axes and angles in radians, scales
    relative, where 0 is exact.
    """

    center: Annotated[Metres, TOLERANCE_RANGE] = 0.002
    offset: Annotated[Metres, TOLERANCE_RANGE] = 0.002
    radius: Annotated[Metres, TOLERANCE_RANGE] = 0.0001
    axis: Annotated[Radians, Field(ge=1e-12, lt=1)] = 0.005
    arm: Annotated[Metres, TOLERANCE_RANGE] = 0.001
    angle: Annotated[Radians, Field(ge=1e-12, lt=1)] = 0.02
    scale: Annotated[Share, Field(ge=0, lt=0.1)] | None = None
    stiffness: Annotated[Share, Field(gt=0, le=10)] | None = None


class Home(Schema):
    """Pose in the middle of the workspace, which selects the machine's assembly mode."""

    position: Point
    rotation_vector: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)


def _check_legs(legs: tuple[Leg, ...]) -> tuple[Leg, ...]:
    """Validate the number of legs and that one is actuated."""
    if len(legs) < 2:
        raise FieldError(
            "too few legs of a parallel machine", found=len(legs), expected="two or more"
        )
    carriers = base_carriers()
    if not any(isinstance(x.length, ActuatedLength) or carriers[x.base.joint].driven for x in legs):
        raise FieldError(
            "no reading moves the machine",
            found=f"none of {len(legs)} legs",
            expected="a leg with actuated: true",
        )
    return legs


def _check_members(group: tuple[str, ...]) -> tuple[str, ...]:
    """Validate that a tie has at least two members; an entry for all legs counts as several."""
    if len(group) < 2 and not any(EVERY_LEG in entry for entry in group):
        counts = {"field_type": "Tuple", "min_length": 2, "actual_length": len(group)}
        raise PydanticKnownError("too_short", counts)
    return group


Ties = tuple[Annotated[tuple[str, ...], AfterValidator(_check_members)], ...]


class DocumentModel(Schema):
    """Model of a machine: fixed and tied parameters, or another file that describes it."""

    fixed: tuple[str, ...] = ()
    tied: Ties = ()
    mechanism: str | None = None

    def model_post_init(self, _context: Any) -> None:
        """Refuse roles beside another file, which has its own."""
        if self.mechanism is not None and (self.fixed or self.tied):
            raise FieldError(
                "a model with 'mechanism' takes 'fixed' and 'tied' from that file",
                found="fixed" if self.fixed else "tied",
                expected="'mechanism' alone",
            )


class MechanismDocument(Schema):
    """Mechanism file."""

    name: Annotated[str, Field(max_length=LONGEST_NAME)]
    motion: PlatformMotion
    legs: Annotated[
        tuple[Leg, ...], Field(max_length=MOST_MACHINE_LEGS), AfterValidator(_check_legs)
    ]
    tolerance: NominalTolerance = NominalTolerance()
    home: Home | None = None
    workspace_radius: (
        Annotated[
            Metres,
            Field(gt=0, description="the radius about z that a controller keeps to, such as 90 mm"),
        ]
        | None
    ) = None
    height_offset: (
        Annotated[
            Metres,
            Field(ge=-1, le=1, description="what a controller's height at home contains beyond the"
                  " tool's, such as -16 mm"),
        ]
        | None
    ) = None  # fmt: skip
    steps_per_mm: (
        Annotated[
            tuple[Annotated[float, Field(gt=0, le=1e6)], ...],
            Field(description="motor steps per mm of each leg's carriage, such as [80, 80, 80]"),
        ]
        | None
    ) = None
    load: Load | None = None
    growth: Growth | None = None
    fixed: tuple[str, ...] = ()
    tied: Ties = ()
    models: dict[str, DocumentModel] = Field(default_factory=dict)
