"""The words for what is particular to machines with cranks, sliders and bars."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.identify.words_names import joined, listed, ways

if TYPE_CHECKING:
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
        "base joints can turn together and the camera with them; nothing that the mechanism file "
        "holds stops it"
    )


def _sizes(told: Told) -> str:
    whose = "of all legs alike" if told.family.kind == "sizes" else f"of {told.whose}"
    chosen = told.family.among.split(",")
    what = f"{joined([SIZES[name] for name in chosen])}, {whose},"
    better = " better than the drawing does" if told.weak else ""
    if len(chosen) == 1:
        return f"{what[:-1]} {told.open(False)}"
    return f"{what} cannot be told apart{better} {ways(told.dims)}"


def _tilts(told: Told) -> str:
    what = "how the base joints' axes are tilted to each other, with the joints' places along them,"
    bars = any("bar" in leg.platform.joint for leg in told.around.machine.document.legs)
    seen = ": readings say nothing of it, only the board's tilt does" if bars else ""
    return f"{what} {told.open(False)}, mostly {listed(told.names)}{seen}"


DRIVEN: dict[str, Callable[[Told], str]] = {
    "against": _against,
    "turn": _turn_text,
    "sizes": _sizes,
    "leg sizes": _sizes,
    "tilts": _tilts,
}
