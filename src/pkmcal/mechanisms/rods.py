"""The rod between a limb's ends: what its length is, and what it says about the reading."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag

from pkmcal.files import Schema
from pkmcal.mechanisms.carriers.contract import ParameterKind


def _increasing(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 < value[0] < value[1]:
        raise ValueError("should be two increasing positive lengths [min, max]")
    return value


class ActuatedLength(Schema):
    """``length: {actuated: true, offset: 0.0, range: [min, max]}``; length = reading + offset."""

    actuated: Literal[True]
    offset: float = 0.0
    range: Annotated[tuple[float, float], AfterValidator(_increasing)] | None = None


class ConstantLength(Schema):
    """``length: {actuated: false, constant: 0.48}``: a rod of one length, metres."""

    actuated: Literal[False]
    constant: Annotated[float, Field(gt=0, description="the rod's length in metres")]


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

OFFSET = ParameterKind("offset", "m", "offset")
CONSTANT = ParameterKind("constant", "m", "offset", label="rod length")
