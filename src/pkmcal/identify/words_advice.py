"""What to do about each kind of change that data leave open."""

from __future__ import annotations

import numpy as np

from pkmcal.geometry.rigid import rotation_vector
from pkmcal.identify.words_driven import is_driven
from pkmcal.identify.words_families import AXES, Circumstances, Family
from pkmcal.identify.words_names import named

TURNED = 0.02
"""Turn (rad) of the platform between configurations below which they only shift it."""
MOST_FIXED = 3
PARALLEL = 1e-9
"""Component of an axis below which the file can hold it alone."""
BY_CALIPER = ("radius", "radii", "depth")
ACROSS = "Measure x and y too, by a board on the platform (observe: board) or a tracker"
"""More heights of the same bed would not help."""


def advice_on(
    around: Circumstances,
    families: tuple[Family, ...],
    names: tuple[str, ...],
    matters: bool,
    weak: bool,
) -> str:
    """What to do about what the families leave open.

    names : its parameters. matters : whether it moves the platform. weak : whether the data
    know it, yet less than the drawing does.
    """
    kind = families[0].kind
    if not matters:
        enough = _fixing(_enough(around, families[0], names))
        return f"Nothing needs to be done; {enough} silences this."
    legs = sorted({leg for family in families for leg in family.legs})
    if kind == "unseen":
        do = f"Photograph {named(legs)}, from another station if need be"
    elif kind == "group":
        do = _tying(around, legs)
    elif kind == "spread":
        do = f"{_more(around, legs)}; or measure the tubes with a caliper"
    elif kind in BY_CALIPER:
        do = f"Measure the tubes of {named(legs)} with a caliper and give a small tolerance.radius"
    elif kind == "common turn":
        do = "Legs look the same however these axes lie: leave them to the drawing"
    elif kind in ("axis", "axes", "tilts"):
        do = f"{_take(around)} configurations that turn these joints further, to both sides"
    else:
        do = _more(around, legs)
    return f"{do}; or {_holding(_enough(around, families[0], names), weak)}."


def _tying(around: Circumstances, legs: list[int]) -> str:
    """How to tie a group of legs to the others."""
    others = [j for j in range(around.seen.shape[1]) if j not in legs]
    with_group = np.flatnonzero(around.seen[around.seen[:, legs].any(axis=1)].any(axis=0))
    apart = [j for j in others if j not in with_group]
    shown = named(apart or others)
    camera = f"Add a station that sees {named(legs)} together with {shown}"
    board = "let a board fixed to the base be seen with the legs (observe: [legs, board], board:"
    return f"{camera}; or {board} {{fixed_to: base}})"


def _more(around: Circumstances, legs: list[int]) -> str:
    """Which configurations are missing."""
    if around.heights:
        return ACROSS
    poses = around.T_base_platform
    those = named(legs) if len(legs) < around.machine.n_legs else "all legs"
    point = "points" if len(legs) == 1 else "point"
    if len(poses) == 1:
        return f"{_take(around)} more configurations, so that {those} {point} elsewhere too"
    turn = rotation_vector(poses[:, :3, :3] @ poses[0, :3, :3].T)
    can_turn = around.machine.layout.motion[:3].any()
    if can_turn and np.abs(turn).max() < TURNED:
        return f"Turn the platform in some configurations, so that {those} {point} elsewhere"
    what = "readings" if is_driven(around.machine) else "lengths"
    ends = f"with {what} near both ends of their range"
    return f"{_take(around)} configurations in which {those} {point} elsewhere, {ends}"


def _take(around: Circumstances) -> str:
    return "Photograph" if around.photographed else "Measure"


def _enough(around: Circumstances, family: Family, names: tuple[str, ...]) -> tuple[str, ...]:
    """What is enough to hold: one end of legs of which only the difference counts, and one axis
    for a turn of all.
    """
    chosen: tuple[str, ...] = ()
    if family.kind == "against":
        chosen = tuple(name for name in names if ".platform." in name)
    elif family.kind == "turn":
        drawn = dict(
            zip(around.machine.parameters.names, around.machine.parameters.drawing, strict=True)
        )
        chosen = tuple(n for n in sorted(names) if ".axis." in n and abs(drawn[n]) < PARALLEL)[:1]
    return chosen or names


def _holding(names: tuple[str, ...], weak: bool) -> str:
    """How the drawing can decide."""
    if weak:
        return "state smaller tolerances in the mechanism file if the drawing warrants them"
    return f"{_fixing(names)} if the drawing is sure of that"


def _fixing(names: tuple[str, ...]) -> str:
    """The line of the mechanism file that takes parameters out.

    An axis is held as a whole, and a centre is said as a whole where all of it is meant.
    """
    entries = list(dict.fromkeys(_entry(name, names) for name in names))
    more = ", …" if len(entries) > MOST_FIXED else ""
    said = ", ".join(f'"{name}"' for name in entries[:MOST_FIXED])
    return f"fixed: [{said}{more}] in the mechanism file"


def _entry(name: str, names: tuple[str, ...]) -> str:
    whole, _, component = name.rpartition(".")
    every = component in AXES and all(f"{whole}.{c}" in names for c in AXES)
    alone = len(names) == 1
    return whole if every or (".axis." in name and not alone) else name
