"""The schema of ``mechanism.yaml``; docs/files.md spells it out for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

from pydantic import AfterValidator, Field
from pydantic_core import PydanticKnownError

from pkmcal.files import Schema
from pkmcal.mechanisms.carriers.contract import base_carriers, platform_carriers
from pkmcal.mechanisms.parameters import EVERY
from pkmcal.mechanisms.rods import ActuatedLength, Rod

Motion = Literal["spatial", "planar", "translation", "schoenflies"]


def _one_of(schemas: Iterable[type[Schema]], key: str) -> Any:
    """The union of the schemas, told apart by one key, so that errors name the right field."""
    kinds = tuple(dict.fromkeys(schemas))
    if len(kinds) == 1:
        return kinds[0]
    return Annotated[Union[kinds], Field(discriminator=key)]  # noqa: UP007 - made at run time


if TYPE_CHECKING:  # a type checker cannot see what the carriers' folder holds
    BaseNode = Any
    PlatformNode = Any
else:
    BaseNode = _one_of((c.schema for c in base_carriers().values()), "joint")
    PlatformNode = _one_of((c.schema for c in platform_carriers().values()), "joint")


class Tube(Schema):
    """One visible cylinder of a leg; ``from`` and ``to`` in metres from A along the leg."""

    radius: Annotated[float, Field(gt=0)]
    start: Annotated[float, Field(alias="from", ge=0)]
    stop: Annotated[float, Field(alias="to")]

    def model_post_init(self, _context: Any) -> None:
        """A tube has a length."""
        if self.stop <= self.start:
            raise ValueError("tube's 'to' should be greater than its 'from'")


class Leg(Schema):
    """One limb: its carriers, its rod, and what a camera sees of it."""

    base: BaseNode
    platform: PlatformNode
    length: Rod
    tubes: tuple[Tube, ...] = ()


class Tolerance(Schema):
    """Standard deviations of the drawing's values, metres; of axes and angles, radians."""

    center: Annotated[float, Field(gt=0)] = 0.002
    offset: Annotated[float, Field(gt=0)] = 0.002
    radius: Annotated[float, Field(gt=0)] = 0.0001
    axis: Annotated[float, Field(gt=0, lt=1)] = 0.005
    arm: Annotated[float, Field(gt=0)] = 0.001
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.02


class Home(Schema):
    """A pose in the middle of the workspace; it decides which assembly the machine has."""

    position: tuple[float, float, float]
    rotation_vector: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _some_legs(legs: tuple[Leg, ...]) -> tuple[Leg, ...]:
    if len(legs) < 2:
        raise ValueError("a parallel machine has at least two legs")
    carriers = base_carriers()
    if not any(isinstance(x.length, ActuatedLength) or carriers[x.base.joint].driven for x in legs):
        raise ValueError("a machine has at least one leg with actuated: true")
    return legs


def _several(group: tuple[str, ...]) -> tuple[str, ...]:
    """A tie has two members at least; one that stands for all legs counts as several."""
    if len(group) < 2 and not any(EVERY in entry for entry in group):
        counts = {"field_type": "Tuple", "min_length": 2, "actual_length": len(group)}
        raise PydanticKnownError("too_short", counts)
    return group


Ties = tuple[Annotated[tuple[str, ...], AfterValidator(_several)], ...]


class Model(Schema):
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

    name: str
    motion: Motion
    legs: Annotated[tuple[Leg, ...], AfterValidator(_some_legs)]
    tolerance: Tolerance = Tolerance()
    home: Home | None = None
    fixed: tuple[str, ...] = ()
    tied: Ties = ()
    models: dict[str, Model] = Field(default_factory=dict)
