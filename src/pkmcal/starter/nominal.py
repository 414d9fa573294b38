"""Nominal models that are made of joint centres, and their commented ``mechanism.yaml``."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.errors import InputError
from pkmcal.files import parse_yaml, validated_document
from pkmcal.mechanisms import Machine, MechanismDocument, checked_machine
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.wording import listed

TOLERANCE_SHARE, LARGEST_TOLERANCE = 0.02, 0.002
"""Standard deviation of a centre relative to the longest leg, and its largest value, m: a ruler
from one joint's middle to another's."""
TUBE_PART = (0.1, 0.85)
"""Part of the shortest leg, from A, that its cylinder takes."""


def millimetres(length: float) -> str:
    """Length with its unit, to the micrometre."""
    return f"{float(np.round(1e3 * length, 3)) + 0.0:.10g} mm"


def option_of(number: str) -> str:
    """Option of a dimension."""
    return f"--{number.replace('_', '-')}"


class Screw(NamedTuple):
    """Screw that its universal joints turn: lead, m, and the joints' axes (3,), unit vectors in
    base and platform frame.
    """

    lead: float
    base_axis: Array
    platform_axis: Array


@dataclass(frozen=True)
class NominalLeg:
    """Leg of a nominal model, m.

    base, rod : their entries in the file. start : A (3,) at home, base frame. platform : B (3,),
    platform frame. least : shortest length; None for that at home. axis : (3,) of its universal
    joint on the platform; None for a spherical one. held : the platform's entry, where it is
    neither of these. scale : of the reading; 1 if empty. tubes : radius, start and end of
    cylinders, m from A.
    """

    base: str
    rod: str
    start: Array
    platform: Array
    least: float | None = None
    axis: Array | None = None
    held: str = ""
    scale: str = ""
    tubes: tuple[tuple[float, float, float], ...] = ()

    __repr__ = short_repr

    @classmethod
    def telescope(
        cls,
        base: Array,
        platform: Array,
        sweep: tuple[float, float] | None,
        screw: Screw | None = None,
    ) -> NominalLeg:
        """Leg of variable length; sweep : its shortest and longest length."""
        ends = "" if sweep is None else f", range: {_numbers(sweep)}"
        ends += "" if screw is None else f", lead: {millimetres(screw.lead)}"
        return cls(
            _joint(base, None if screw is None else screw.base_axis),
            f"{{actuated: true, offset: 0{ends}}}",
            base,
            platform,
            None if sweep is None else sweep[0],
            None if screw is None else screw.platform_axis,
        )

    @classmethod
    def crank(
        cls,
        center: Array,
        axis: Array,
        zero: Array,
        arm: float,
        platform: Array,
        rod: float,
        sweep: tuple[float, float] | None = None,
    ) -> NominalLeg:
        """Rod on a crank; axis, zero : unit vectors, zero that of the arm at reading 0. sweep : its
        least and largest reading, degrees.
        """
        ends = "" if sweep is None else f", range: [{sweep[0]:.10g} deg, {sweep[1]:.10g} deg]"
        base = (
            f"{{joint: crank, center: {_numbers(center)}, axis: {_direction(axis)},"
            f" zero: {_direction(zero)}, arm: {millimetres(arm)}{ends}}}"
        )
        return cls(base, _constant(rod), center + arm * zero, platform, rod)

    @classmethod
    def slider(
        cls,
        center: Array,
        axis: Array,
        sweep: tuple[float, float] | None,
        platform: Array,
        rod: float,
    ) -> NominalLeg:
        """Rod on a carriage; sweep : its least and largest reading."""
        ends = "" if sweep is None else f", range: {_numbers(sweep)}"
        base = f"{{joint: slider, center: {_numbers(center)}, axis: {_direction(axis)}{ends}}}"
        return cls(base, _constant(rod), center, platform, rod)


@dataclass(frozen=True)
class NominalModel:
    """Nominal model by its legs and home.

    heading : paragraphs of the file's first comment. numbers : lines of a comment for each number
    that it is made of. home : (3,) position of the platform, m, without rotation. tube_radius : of
    every leg's cylinder, None for legs without. assumed : names of numbers that were not given.
    sigma : standard deviation of the numbers, m; None for that of a ruler. home_entry : the
    file's home; ``home`` to the micrometre by default.
    """

    name: str
    heading: tuple[str, ...]
    numbers: tuple[tuple[str, ...], ...]
    motion: str
    legs: tuple[NominalLeg, ...]
    home: Array
    tube_radius: float | None = None
    assumed: tuple[str, ...] = ()
    home_entry: str = ""
    sigma: float | None = None

    __repr__ = short_repr

    def text(self) -> str:
        """Text of mechanism.yaml."""
        lines = [line for part in self.heading for line in textwrap.wrap(part, 96)]
        for first, *rest in self.numbers:
            lines += ["", first, *(f"  {line}" for line in rest)]
        home = self.home_entry or f"{{position: {_numbers(self.home)}}}"
        frames = "# Base joints in the base frame, platform joints in the platform frame"
        same = ", which has the same\n# directions at home; z is up. "
        frames += ".\n# " if self.home_entry else same
        comment = "\n".join(f"# {line}".rstrip() for line in lines)
        sigma = self.sigma
        if sigma is None:
            lengths = [np.linalg.norm(x.platform + self.home - x.start) for x in self.legs]
            sigma = min(LARGEST_TOLERANCE, TOLERANCE_SHARE * float(max(lengths)))
        return (
            f"{comment}\nname: {self.name}\nmotion: {self.motion}\n\n"
            f"{frames}Replace any centre by a better one.\nlegs:\n"
            + "".join(map(self._leg_text, self.legs))
            + f"\n# The platform frame's origin in the middle of the workspace.\n"
            f"home: {home}\n\n"
            "# Standard deviations of these numbers: how well they were measured, and made.\n"
            f"tolerance: {{center: {millimetres(sigma)}, offset: {millimetres(sigma)}}}\n"
        )

    def machine(self) -> Machine:
        """The machine. Raises InputError for a text that is no machine."""
        document = parse_yaml(self.text(), Path("mechanism.yaml"))
        return checked_machine(validated_document(document, MechanismDocument), document)

    def check_home(self, where: str, expected: str | None = None) -> None:
        """Raise InputError for a model with legs that do not reach the platform at home, and for
        one whose platform could move there with all motors at rest.

        where, expected : of the message; expected where the platform could move.
        """
        machine = self.machine()
        readings = machine.inverse(machine.home()[None])
        if not np.isfinite(readings).all():
            raise InputError(
                "legs do not reach the platform at home",
                where=where,
                found=listed([str(k + 1) for k in np.flatnonzero(~np.isfinite(readings[0]))]),
                expected="lengths, arms or spools with which they do",
            )
        if not machine.forward_result(readings).singularity[0] >= NEAR_SINGULAR:
            raise InputError(
                "the platform could move with all motors at rest: its pose at home is singular",
                where=where,
                found=self.name,
                expected=expected,
            )

    def _leg_text(self, leg: NominalLeg) -> str:
        """Entry of a leg."""
        platform = leg.held or _joint(leg.platform, leg.axis)
        text = f"  - base: {leg.base}\n    platform: {platform}\n    length: {leg.rod}\n"
        text += f"    scale: {leg.scale}\n" if leg.scale else ""
        tubes = leg.tubes
        if self.tube_radius is not None:
            length = float(np.linalg.norm(leg.platform + self.home - leg.start))
            start, stop = ((leg.least or length) * share for share in TUBE_PART)
            tubes = ((self.tube_radius, start, stop),)
        entries = [
            f"{{radius: {radius}, from: {start}, to: {stop}}}"
            for radius, start, stop in (map(millimetres, tube) for tube in tubes)
        ]
        return f"{text}    tubes: [{', '.join(entries)}]\n" if tubes else text


def _numbers(values: Array | tuple[float, ...]) -> str:
    """Lengths as a list."""
    return f"[{', '.join(millimetres(value) for value in values)}]"


def _joint(center: Array, axis: Array | None) -> str:
    """Entry of a spherical joint, or of a universal joint with its axis."""
    if axis is None:
        return f"{{joint: spherical, center: {_numbers(center)}}}"
    return f"{{joint: universal, center: {_numbers(center)}, axis: {_direction(axis)}}}"


def _direction(vector: Array) -> str:
    """Unit vector as a list."""
    return f"[{', '.join(f'{float(np.round(x, 10)) + 0.0:.10g}' for x in vector)}]"


def _constant(length: float) -> str:
    """Rod of constant length."""
    return f"{{actuated: false, constant: {millimetres(length)}}}"
