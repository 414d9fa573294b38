"""The words for each kind of change that data leave open, and what to do about it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.words_families import AXES, Circumstances, Family, line_of
from pkmcal.identify.words_names import count, joined, listed, named, ways
from pkmcal.identify.words_text_driven import DRIVEN

ALIGNED = 0.985
"""Cosine (10 degrees) of a direction with an axis that still is called by that axis's name."""
THROUGH = 0.05
"""Distance of a joint from an axis, in parts of the joints' spread, that still lies on it."""
SAME = 1e-3
"""Part of its greatest number below which a number of a change is nothing."""


def naming(family: Family, coefficients: Array) -> str:
    """What tells two changes of one kind apart in words; coefficients (k, m) of the family."""
    if family.kind == "slide":
        return _sliding(coefficients)
    return _directions(coefficients) if family.kind == "centre" else family.among


def said_of(
    around: Circumstances,
    families: tuple[Family, ...],
    coefficients: Array,
    names: tuple[str, ...],
    weak: bool,
) -> str:
    """What is open, without a full stop. coefficients (k, m) : of the first family's columns."""
    first = families[0]
    legs = sorted({leg for family in families for leg in family.legs})
    tell = _TEXTS.get(first.kind, _rest)
    text = tell(Told(around, first, tuple(legs), coefficients, names, weak))
    return text[0].upper() + text[1:]


class Told:
    """What a text is made from."""

    def __init__(
        self,
        around: Circumstances,
        family: Family,
        legs: tuple[int, ...],
        coefficients: Array,
        names: tuple[str, ...],
        weak: bool,
    ) -> None:
        self.around, self.family, self.legs, self.names = around, family, legs, names
        self.coefficients, self.weak = coefficients, weak
        self.whose = named(legs)

    def open(self, several: bool) -> str:
        """That something is open."""
        if self.weak:
            return f"{'are' if several else 'is'} known from the drawing only"
        return "are free" if several else "is free"

    def ends(self, side: str) -> str:
        """``the base joint of leg 2``, ``the base joints of legs 2 and 5``."""
        return f"the {side} joint{'s' if len(self.legs) > 1 else ''} of {self.whose}"

    @property
    def several(self) -> bool:
        """Whether it is about more than one leg."""
        return len(self.legs) > 1

    @property
    def dims(self) -> int:
        """Dimensions of one leg's part where several legs were put together."""
        return max(1, len(self.coefficients) // len(self.legs))


def _unseen(told: Told) -> str:
    where = f"{told.whose} {'are' if told.several else 'is'} in no photograph"
    read = any(told.around.at.rod[leg] >= 0 for leg in told.legs)
    if not read:
        whose = "their joints are" if told.several else "its joints are"
        return f"{where}, so that nothing tells where {whose}"
    whose = "each one's" if told.several else "its"
    values = f"{count(told.dims)} of {whose} values"
    return f"{where}; {'their' if told.several else 'its'} readings alone leave {values} " + (
        "to the drawing" if told.weak else "free"
    )


def _common_turn(told: Told) -> str:
    return (
        f"the common direction of both universal axes of {'each of ' if told.several else ''}"
        f"{told.whose} {told.open(False)}: only the angle between the two can be seen"
    )


def _axis(told: Told) -> str:
    node = getattr(told.around.machine.document.legs[told.legs[0]], told.family.among)
    whose = f"the {node.joint} ax{'es' if told.several else 'is'} of {told.whose}"
    return f"the direction of {whose} on the {told.family.among} {told.open(False)}"


def _sliding(coefficients: Array) -> str:
    """Which end slides: base, platform, both on their own, or the leg as a whole."""
    if len(coefficients) > 1:
        return "both"
    base, platform = np.abs(coefficients[0])
    if min(base, platform) < SAME * max(base, platform):
        return "base" if base > platform else "platform"
    whole = abs(coefficients[0].sum()) < 0.05 * max(base, platform)
    return "whole" if whole else "together"


def _slide(told: Told) -> str:
    moves = {
        "base": "can grow while its base joint moves back along it",
        "platform": "can grow while its platform joint moves on along it",
        "both": "can grow and shift along itself, its two joints and its length together",
        "whole": "can shift along itself with both joints",
        "together": "can grow while both of its joints move along it",
    }[_sliding(told.coefficients[: told.dims])]
    if told.family.among == "passive":
        moves = "can shift along itself, its two joints by themselves"
    direction = "one direction each" if told.several else "one direction"
    start = f"{told.whose} keep{'' if told.several else 's'} nearly {direction} in the data"
    each = "each of them" if told.several else "it"
    unsure = ", which only the drawing limits" if told.weak else ""
    return f"{start}: {each} {moves}{unsure}"


def _rod(told: Told) -> str:
    constant = told.around.at.constant[list(told.legs)].all()
    what = "constant length" if constant else "offset"
    return f"the {what}{'s' if told.several else ''} of {told.whose} {told.open(told.several)}"


def _centre(told: Told) -> str:
    where = _directions(told.coefficients[: told.dims])
    return f"{told.ends(told.family.among)} {told.open(told.several)} {where}"


def _directions(vectors: Array) -> str:
    """Directions (k, 3) in words: ``along x``, ``in the x-y plane``, ``in all directions``."""
    if len(vectors) >= 3:
        return "in all directions"
    if len(vectors) == 2:
        normal = np.cross(vectors[0], vectors[1])
        axis = _axis_name(normal)
        if axis:
            return f"in the {'-'.join(c for c in AXES if c != axis)} plane"
        return "in two directions"
    axis = _axis_name(vectors[0])
    return f"along {axis}" if axis else "in one direction"


def _axis_name(vector: Array) -> str:
    """The axis that a vector (3,) is along, empty where it is along none."""
    size = np.abs(vector) / max(float(np.linalg.norm(vector)), 1e-300)
    return AXES[int(np.argmax(size))] if size.max() > ALIGNED else ""


def _group(told: Told) -> str:
    side = told.family.among
    what = {
        "base": told.ends("base"),
        "platform": told.ends("platform"),
        "both": f"{told.whose} as a whole",
    }[side]
    unsure = ", as far as the data know" if told.weak else ""
    return f"{_relation(told)}: {what} can{unsure}{',' if unsure else ''} {_rigid(told, side)}"


def _relation(told: Told) -> str:
    """How the group is seen with the other legs."""
    seen, legs = told.around.seen, list(told.legs)
    others = [j for j in range(seen.shape[1]) if j not in legs]
    with_group = np.flatnonzero(seen[seen[:, legs].any(axis=1)].any(axis=0))
    bridging = [j for j in others if j in with_group]
    verb = "are" if told.several else "is"
    if not bridging:
        return f"{told.whose} {verb} never seen together with the others"
    if len(bridging) < len(others):
        return f"of the others, only {named(bridging)} {'is' if len(bridging) == 1 else 'are'} " + (
            f"ever seen together with {told.whose}"
        )
    return f"although {told.whose} {verb} seen with the others, these data do not tie them"


def _rigid(told: Told, side: str) -> str:
    """A group's open rigid motions in words, after "can"."""
    if side == "both":
        base, platform = np.split(told.coefficients, 2, axis=1)
        k = len(base)
        main = base if np.linalg.norm(base) > 0 else platform
        shift, turn = _freedoms(told, main, "base")
        together = "" if k <= 6 else ", base and platform joints each by themselves"
        return f"{_both(shift, turn)} against the others{together}"
    shift, turn = _freedoms(told, told.coefficients, side)
    return f"{_both(shift, turn)} against the others"


def _both(shift: str, turn: str) -> str:
    return " and ".join(part for part in (shift, turn) if part)


def _freedoms(told: Told, coefficients: Array, side: str) -> tuple[str, str]:
    """``shift along x`` and ``turn about the line through joints 1 and 4``, either may be empty."""
    at = told.around.at
    centres = at.base if side == "base" else at.platform
    points = told.around.machine.values[centres]
    spread = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1))))
    scaled = coefficients * np.array([spread] * 3 + [1.0] * 3)
    _, s, vt = np.linalg.svd(scaled[:, :3], full_matrices=False)
    turns = int(np.sum(s > 1e-2 * max(float(np.linalg.norm(scaled, axis=1).max()), 1e-300)))
    shifts = len(_pure_shifts(scaled))
    if turns == 1 and shifts == 0:
        k = int(np.argmax(np.linalg.norm(scaled[:, :3], axis=1)))
        return "", _about(told, coefficients[k], points, spread)
    shift = f"shift {_directions(_pure_shifts(scaled))}" if shifts else ""
    if turns == 0:
        return shift, ""
    axis = _axis_name(vt[0]) if turns == 1 else ""
    about = f"about {axis}" if axis else "about one axis"
    return shift, f"turn {about if turns == 1 else 'about two axes' if turns == 2 else 'freely'}"


def _pure_shifts(scaled: Array) -> Array:
    """Combinations (k, 3) of twists (n, 6) that do not turn."""
    u, s, _ = np.linalg.svd(scaled[:, :3], full_matrices=True)
    rank = int(np.sum(s > 1e-2 * max(float(np.linalg.norm(scaled, axis=1).max()), 1e-300)))
    return (u[:, rank:].T @ scaled)[:, 3:]


def _about(told: Told, twist: Array, points: Array, spread: float) -> str:
    """``turn about the axis through joints 1 and 4``, for one twist."""
    middle = points[list(told.legs)].mean(axis=0)
    point, direction, pitch = line_of(twist, middle)
    away = points - point
    distance = np.linalg.norm(np.cross(away, direction), axis=-1)
    on = [j for j in np.flatnonzero(distance < THROUGH * spread) if j not in told.legs]
    axis = _axis_name(direction)
    if abs(pitch) > THROUGH * spread:
        return f"turn about {axis or 'an axis'} and shift along it at once"
    if len(on) >= 2:
        return f"turn about the axis through joints {joined([str(j + 1) for j in on])}"
    if len(on) == 1:
        return f"turn about {axis or 'an axis'} through joint {on[0] + 1}"
    return f"turn about {'a line along ' + axis if axis else 'one axis'}"


def _coordinate(told: Told) -> str:
    body = told.family.kind.partition(" of ")[2]
    what = "heights (z)" if told.family.among == "z" else f"{told.family.among} coordinates"
    where = {"base": "the base joints", "platform": "the platform joints"}.get(body, "all joints")
    how = ways(len(told.coefficients))
    return f"the {what} of {where} {told.open(True)} against each other {how}"


def _lengths(told: Told) -> str:
    what = "constant lengths" if "constant" in told.family.kind else "offsets"
    if told.family.kind.startswith("common"):
        return f"the common part of the {what} of {told.whose} {told.open(False)}"
    how = ways(len(told.coefficients))
    return f"the {what} of {told.whose} {told.open(True)} {how}: they can change together"


def _scale_text(told: Told) -> str:
    return f"the size of everything {told.open(False)}: all lengths can grow by the same share"


def _leg(told: Told) -> str:
    where = f"of the values of {told.whose}, {count(told.dims)} combination"
    where += "" if told.dims == 1 else "s"
    each = " each" if told.several else ""
    return f"{where}{each} {told.open(told.dims > 1)}, mostly of " + listed(told.names)


def _slides_text(told: Told) -> str:
    k = count(len(told.coefficients))
    return (
        f"legs that grow while their joints move along them {told.open(True)} in {k} "
        f"combination{'' if len(told.coefficients) == 1 else 's'}, mostly of {listed(told.names)}"
    )


def _centres(told: Told) -> str:
    how = ways(len(told.coefficients))
    return (
        f"how the {told.family.among} joints lie to each other {told.open(False)} {how}, mostly "
        f"{listed(told.names)}"
    )


def _axes_text(told: Told) -> str:
    return f"the directions of the joints' axes {told.open(True)} {ways(len(told.coefficients))}"


def _radius(told: Told) -> str:
    return f"the tubes' radii of {told.whose} {told.open(True)}"


def _depth(told: Told) -> str:
    return (
        f"the tubes' radii of {told.whose} and the distance to the camera cannot be told apart"
        + (" better than the drawing does" if told.weak else "")
    )


def _spread(told: Told) -> str:
    legs = "the legs" if len(told.legs) == told.around.machine.n_legs else told.whose
    better = " better than the drawing does" if told.weak else ""
    return f"how far apart {legs} stand and how thick their tubes are cannot be told apart{better}"


def _rest(told: Told) -> str:
    k = len(told.coefficients)
    what = "a combination" if k == 1 else f"{count(k)} combinations"
    return f"{what} of {listed(told.names)} {told.open(k > 1)}"


_TEXTS: dict[str, Callable[[Told], str]] = {
    "unseen": _unseen,
    "common turn": _common_turn,
    "axis": _axis,
    "slide": _slide,
    "rod": _rod,
    "centre": _centre,
    "group": _group,
    **{f"{c} of {body}": _coordinate for c in AXES for body in ("base", "platform", "both")},
    "common constant": _lengths,
    "constants": _lengths,
    "common offset": _lengths,
    "offsets": _lengths,
    "spread": _spread,
    "scale": _scale_text,
    "leg": _leg,
    "slides": _slides_text,
    "centres": _centres,
    "axes": _axes_text,
    **DRIVEN,
    "radius": _radius,
    "radii": _radius,
    "depth": _depth,
}
