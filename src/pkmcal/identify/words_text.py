"""The words for each kind of change that data leave open, and what to do about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.words_families import AXES, Circumstances, Family, line_of

ALIGNED = 0.985
"""Cosine (10 degrees) of a direction with an axis that still is called by that axis's name."""
THROUGH = 0.05
"""Distance of a joint from an axis, in parts of the joints' spread, that still lies on it."""
SAME = 1e-3
"""Part of its greatest number below which a number of a change is nothing."""
MOST_NAMES = 4
NAMES = {
    "length.offset": "offset",
    "length.constant": "length",
    "base.arm": "arm",
    "base.angle": "crank angle",
    "base.along": "place along its axis",
    "base.radial": "axis' distance from its centre",
}
"""What a leg's numbers are called."""
SIZES = {
    "radius": "the radius of the base joints",
    "height": "the height of the base joints",
    "arm": "the arms' length",
    "angle": "the crank angle",
    "rod": "the rods' length",
}


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
    text = tell(_Told(around, first, tuple(legs), coefficients, names, weak))
    return text[0].upper() + text[1:]


class _Told:
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


def named(legs: Iterable[int]) -> str:
    """``leg 3``, ``legs 1, 2 and 5``, ``legs 1 to 6``, from numbers that count from 0."""
    found = sorted({leg + 1 for leg in legs})
    if len(found) > 2 and found[-1] - found[0] == len(found) - 1:
        return f"legs {found[0]} to {found[-1]}"
    return ("leg " if len(found) == 1 else "legs ") + joined([str(n) for n in found])


def joined(words: list[str]) -> str:
    """``a, b and c``."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def parameter(name: str) -> str:
    """A parameter in words: ``z of leg 3's base joint``, ``leg 2's offset``."""
    match = re.fullmatch(r"legs\[(\d+)\]\.(.+)", name)
    if not match:
        return name
    leg, path = f"leg {match[1]}'s", match[2]
    if found := re.fullmatch(r"(base|platform)\.(center|axis)\.([xyz])", path):
        what = "joint" if found[2] == "center" else "axis"
        return f"{found[3]} of {leg} {found[1]} {what}"
    if found := re.fullmatch(r"tubes\[(\d+)\]\.radius", path):
        return f"the radius of {leg} tube {found[1]}"
    if found := re.fullmatch(r"platform\.hinge\.([xyz])", path):
        return f"{found[1]} of {leg} hinge"
    return f"{leg} {NAMES.get(path, path.replace('.', ' '))}"


def _listed(names: tuple[str, ...]) -> str:
    words = [parameter(name) for name in names[:MOST_NAMES]]
    if len(names) > MOST_NAMES:
        return f"{', '.join(words)} and {len(names) - MOST_NAMES} more"
    return joined(words)


def _unseen(told: _Told) -> str:
    where = f"{told.whose} {'are' if told.several else 'is'} in no photograph"
    read = any(told.around.at.rod[leg] >= 0 for leg in told.legs)
    if not read:
        whose = "their joints are" if told.several else "its joints are"
        return f"{where}, so that nothing tells where {whose}"
    whose = "each one's" if told.several else "its"
    values = f"{_count(_dims(told))} of {whose} values"
    return f"{where}; {'their' if told.several else 'its'} readings alone leave {values} " + (
        "to the drawing" if told.weak else "free"
    )


def _common_turn(told: _Told) -> str:
    return (
        f"the common direction of both universal axes of {'each of ' if told.several else ''}"
        f"{told.whose} {told.open(False)}: only the angle between the two can be seen"
    )


def _axis(told: _Told) -> str:
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


def _slide(told: _Told) -> str:
    moves = {
        "base": "can grow while its base joint moves back along it",
        "platform": "can grow while its platform joint moves on along it",
        "both": "can grow and shift along itself, its two joints and its length together",
        "whole": "can shift along itself with both joints",
        "together": "can grow while both of its joints move along it",
    }[_sliding(told.coefficients[: _dims(told)])]
    if told.family.among == "passive":
        moves = "can shift along itself, its two joints by themselves"
    direction = "one direction each" if told.several else "one direction"
    start = f"{told.whose} keep{'' if told.several else 's'} nearly {direction} in the data"
    each = "each of them" if told.several else "it"
    unsure = ", which only the drawing limits" if told.weak else ""
    return f"{start}: {each} {moves}{unsure}"


def _dims(told: _Told) -> int:
    """Dimensions of one leg's part where several legs were put together."""
    return max(1, len(told.coefficients) // len(told.legs))


def _rod(told: _Told) -> str:
    constant = told.around.at.constant[list(told.legs)].all()
    what = "constant length" if constant else "offset"
    return f"the {what}{'s' if told.several else ''} of {told.whose} {told.open(told.several)}"


def _centre(told: _Told) -> str:
    where = _directions(told.coefficients[: _dims(told)])
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


def _group(told: _Told) -> str:
    side = told.family.among
    what = {
        "base": told.ends("base"),
        "platform": told.ends("platform"),
        "both": f"{told.whose} as a whole",
    }[side]
    unsure = ", as far as the data know" if told.weak else ""
    return f"{_relation(told)}: {what} can{unsure}{',' if unsure else ''} {_rigid(told, side)}"


def _relation(told: _Told) -> str:
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


def _rigid(told: _Told, side: str) -> str:
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


def _freedoms(told: _Told, coefficients: Array, side: str) -> tuple[str, str]:
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


def _about(told: _Told, twist: Array, points: Array, spread: float) -> str:
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


def _coordinate(told: _Told) -> str:
    body = told.family.kind.partition(" of ")[2]
    what = "heights (z)" if told.family.among == "z" else f"{told.family.among} coordinates"
    where = {"base": "the base joints", "platform": "the platform joints"}.get(body, "all joints")
    ways = _ways(len(told.coefficients))
    return f"the {what} of {where} {told.open(True)} against each other {ways}"


def _ways(k: int) -> str:
    return "in one way" if k == 1 else f"in {_count(k)} ways"


def _count(k: int) -> str:
    words = ("no", "one", "two", "three", "four", "five", "six")
    return words[k] if k < len(words) else str(k)


def _lengths(told: _Told) -> str:
    what = "constant lengths" if "constant" in told.family.kind else "offsets"
    if told.family.kind.startswith("common"):
        return f"the common part of the {what} of {told.whose} {told.open(False)}"
    ways = _ways(len(told.coefficients))
    return f"the {what} of {told.whose} {told.open(True)} {ways}: they can change together"


def _scale_text(told: _Told) -> str:
    return f"the size of everything {told.open(False)}: all lengths can grow by the same share"


def _leg(told: _Told) -> str:
    where = f"of the values of {told.whose}, {_count(_dims(told))} combination"
    where += "" if _dims(told) == 1 else "s"
    each = " each" if told.several else ""
    return f"{where}{each} {told.open(_dims(told) > 1)}, mostly of " + _listed(told.names)


def _slides_text(told: _Told) -> str:
    k = _count(len(told.coefficients))
    return (
        f"legs that grow while their joints move along them {told.open(True)} in {k} "
        f"combination{'' if len(told.coefficients) == 1 else 's'}, mostly of {_listed(told.names)}"
    )


def _centres(told: _Told) -> str:
    ways = _ways(len(told.coefficients))
    return (
        f"how the {told.family.among} joints lie to each other {told.open(False)} {ways}, mostly "
        f"{_listed(told.names)}"
    )


def _axes_text(told: _Told) -> str:
    return f"the directions of the joints' axes {told.open(True)} {_ways(len(told.coefficients))}"


def _radius(told: _Told) -> str:
    return f"the tubes' radii of {told.whose} {told.open(True)}"


def _depth(told: _Told) -> str:
    return (
        f"the tubes' radii of {told.whose} and the distance to the camera cannot be told apart"
        + (" better than the drawing does" if told.weak else "")
    )


def _spread(told: _Told) -> str:
    legs = "the legs" if len(told.legs) == told.around.machine.n_legs else told.whose
    better = " better than the drawing does" if told.weak else ""
    return f"how far apart {legs} stand and how thick their tubes are cannot be told apart{better}"


def _rest(told: _Told) -> str:
    k = len(told.coefficients)
    what = "a combination" if k == 1 else f"{_count(k)} combinations"
    return f"{what} of {_listed(told.names)} {told.open(k > 1)}"


def _against(told: _Told) -> str:
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
        f"is seen{size}: both can shift alike {_ways(len(told.coefficients))}"
    )


def _turn_text(told: _Told) -> str:
    axis = told.family.among
    return (
        f"the turn of the base frame about {axis} {told.open(False)}: what is fixed or tied in the "
        "mechanism file does not hold the base joints' axes and places, which can turn together, "
        "the camera with them"
    )


def _sizes(told: _Told) -> str:
    whose = "of all legs alike" if told.family.kind == "sizes" else f"of {told.whose}"
    chosen = told.family.among.split(",")
    what = f"{joined([SIZES[name] for name in chosen])}, {whose},"
    better = " better than the drawing does" if told.weak else ""
    if len(chosen) == 1:
        return f"{what[:-1]} {told.open(False)}"
    return f"{what} cannot be told apart{better} {_ways(_dims(told))}"


def _tilts(told: _Told) -> str:
    what = "the tilts of the base joints' axes to each other (how parallel they are)"
    where = "each with its joint's place along it"
    seen = "readings say nothing of them, only the board's tilt does"
    ways = _ways(len(told.coefficients))
    return f"{what}, {where}, {told.open(True)} {ways}, mostly {_listed(told.names)}: {seen}"


_TEXTS: dict[str, Callable[[_Told], str]] = {
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
    "against": _against,
    "turn": _turn_text,
    "sizes": _sizes,
    "leg sizes": _sizes,
    "tilts": _tilts,
    "radius": _radius,
    "radii": _radius,
    "depth": _depth,
}
