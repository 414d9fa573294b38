"""The rod between a limb's ends: what its length is, and what it says about the reading."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

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


OFFSET = ParameterKind("offset", "m", "offset")
CONSTANT = ParameterKind("constant", "m", "offset")
