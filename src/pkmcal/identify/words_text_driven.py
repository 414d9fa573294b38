"""The words for what is particular to machines with cranks, sliders and bars."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.words_effect import pose_by_parameters
from pkmcal.identify.words_names import joined, listed, ways

if TYPE_CHECKING:
    from pkmcal.identify.words_families import Circumstances
    from pkmcal.identify.words_text import Told

AXES = "xyz"
SIZES = {
    "radius": "the radius of the base joints",
    "height": "the height of the base joints",
    "arm": "the arms' length",
    "angle": "the crank angle",
    "rod": "the rods' length",
}
"""What sizes are called that legs share."""
LITTLE = 0.01
"""mm by which a size changes with another's 1 mm and is not worth a word."""


def _against(told: Told) -> str:
    """Shifts of both ends alike, of which only the difference counts."""
    numbers = np.abs(told.coefficients).max(axis=0).reshape(3, -1).max(axis=1)
    axes = [c for c, x in zip(AXES, numbers, strict=True) if x > 0.05 * numbers.max()]
    legs = told.around.machine.document.legs
    other, size = "platform", ""
    if any("bar" in leg.platform.joint for leg in legs):
        other, size = (
            "side bars'",
            " (the bars' half width cannot be told from the base joints' places)",
        )
    elif {"x", "y"} <= set(axes):
        size = ", as the difference of base and platform radius"
    if size.startswith(" (") and axes != ["y"]:
        size = ""
    return (
        f"of {joined(axes)} of the base joints and of the {other} joints, only the difference "
        f"is seen{size}: both can shift alike {ways(len(told.coefficients))}"
    )


def _turn_text(told: Told) -> str:
    axis = told.family.among
    return (
        f"the turn of the base frame about {axis} {told.open(False)}: the axes and places of all "
        "base joints can turn together, and the camera or tracker with them; nothing that the "
        "mechanism file holds stops it"
    )


def _sizes(told: Told) -> str:
    common = told.family.kind == "sizes"
    each = "each of " if told.several else ""
    whose = "of all legs alike" if common else f"of {each}{told.whose}"
    chosen = told.family.among.split(",")
    what = f"{joined([SIZES[name] for name in chosen])}, {whose},"
    if len(chosen) == 1:
        return f"{what[:-1]} {told.open(False)}"
    better = " better than the drawing does" if told.weak else ""
    if told.around.heights and common and len(told.coefficients) == 1:
        return f"{what} cannot be told apart by heights{better}: {_same_heights(told, chosen)}"
    by = " by heights" if told.around.heights else ""
    return f"{what} cannot be told apart{by}{better}{'' if by else ' ' + ways(told.dims)}"


def _same_heights(told: Told, chosen: list[str]) -> str:
    """What changes together while heights stay, with 1 mm of the last size."""
    change = told.coefficients[0] / told.coefficients[0, -1]
    also = [
        _grown(name, x) for name, x in zip(chosen[:-1], change[:-1], strict=True) if abs(x) > LITTLE
    ]
    stretch = 1e-3 * _stretch(told.around, told.family.columns @ change)
    way = "stretch" if stretch > 0 else "shrink"
    return (
        f"with {joined([_grown(chosen[-1], 1.0), *also])}, the bed looks as flat, and x and y {way}"
        f" by {abs(stretch):.2%}"
    )


def _grown(size: str, change: float) -> str:
    """A size that changes by so many mm, or mrad."""
    more, less = ("longer", "shorter") if size in ("arm", "rod") else ("larger", "smaller")
    what = {"rod": "rods", "arm": "arms"}.get(size, SIZES[size])
    unit = "mrad" if size == "angle" else "mm"
    return f"{what} {abs(change):.2g} {unit} {more if change > 0 else less}"


def _stretch(around: Circumstances, change: Array) -> float:
    """Share by which the platform's x and y grow with a change (P,) of the parameters."""
    machine, poses = around.machine, around.T_base_platform
    moved = pose_by_parameters(machine, machine.inverse(poses), poses) @ change
    xy = poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0)
    return float(np.sum(moved[:, 3:5] * xy) / np.sum(xy**2))


def _lean(told: Told) -> str:
    guides = "the guides" if told.several else "the guide"
    stand = "they stand" if told.several else "it stands"
    better = " better than the drawing does" if told.weak else ""
    lean = "lean" if told.several else "leans"
    return f"how {guides} of {told.whose} {lean} cannot be told from where {stand}{better}"


def _tilts(told: Told) -> str:
    what = "how the base joints' axes are tilted to each other, with the joints' places along them,"
    bars = any("bar" in leg.platform.joint for leg in told.around.machine.document.legs)
    seen = ": readings say nothing of it, only the platform's tilt does" if bars else ""
    return f"{what} {told.open(False)}, mostly {listed(told.names)}{seen}"


DRIVEN: dict[str, Callable[[Told], str]] = {
    "against": _against,
    "turn": _turn_text,
    "sizes": _sizes,
    "leg sizes": _sizes,
    "lean": _lean,
    "tilts": _tilts,
}
