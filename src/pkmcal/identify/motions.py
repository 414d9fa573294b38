"""Changes of a machine that people can picture: candidates for what data leave open.

A motion is a set of changes with one name and one sentence: its columns are changes of all P
parameters in their own units (m, rad, or parts of a unit axis). They come from the parameter table
(a number of one leg, the same number of all legs, what all legs have in common), from the frames
(single legs, groups of legs and whole bodies moved as frames are), from what a leg looks like along
itself, and from the carriers' own files: no joint kind is known here by its name.

:mod:`pkmcal.identify.unidentified` finds which of them the data do not see.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, skew
from pkmcal.identify.gauge import centre_index, generators
from pkmcal.identify.tool import pose_by_parameters
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import joint_values
from pkmcal.wording import DISPLAY_UNITS, decimals, joined, named, number, split_name, with_unit

AXIS_LETTERS = "xyz"
MOST_GROUPS = 120
"""Groups of legs that are tried; ten stations that each see other legs make about as many."""
MOST_SIZES = 3
"""Sizes of which fewer than all are tried together; their combinations grow as powers of two."""
ALIGNED_AXIS_COSINE = 0.985
"""Cosine (10 degrees) of a direction with an axis that still is called by that axis's name."""
THROUGH_AXIS_DISTANCE = 0.05
"""Distance of a joint from an axis, in parts of the joints' spread, that still lies on it."""
NEGLIGIBLE_CHANGE_SHARE = 1e-3
"""Part of its greatest number below which a number of a change is nothing."""
UNTOLD_SIZE_CHANGE = 0.01
"""mm (or degrees) by which a size changes with another's 1 mm and is not worth a word."""
MOST_VALUES_LISTED = 5
"""Numbers of a change that are told, the last of them for all smaller ones."""

Advice = Literal[
    "more", "photograph", "tie", "caliper", "more or caliper", "turn", "drawing", "size"
]  # fmt: skip
"""What helps: see :mod:`pkmcal.identify.sentences`."""


@dataclass(frozen=True)
class Situation:
    """What the candidates are made from.

    machine : with the present values. observed : (S, L) legs that each station sees.
    T_base_platform : (K, 4, 4) poses of the session. photographed : whether legs are in
    photographs; otherwise only boards or poses were seen. heights : whether it was nothing but
    heights.
    """

    machine: Machine
    observed: Booleans
    T_base_platform: Array
    photographed: bool = True
    heights: bool = False

    @cached_property
    def legs(self) -> tuple[int, ...]:
        """All legs, from 0."""
        return tuple(range(self.machine.n_legs))

    @cached_property
    def fields(self) -> tuple[dict[str, Integers], ...]:
        """Positions of each leg's parameters by field: ``base.center``, ``length.offset``,
        ``tubes`` for all radii.
        """
        out: tuple[dict[str, list[int]], ...] = tuple({} for _ in self.legs)
        for k, name in enumerate(self.machine.parameters.names):
            leg, path = split_name(name)
            field = "tubes" if path.startswith("tubes[") else path
            field = field[:-2] if field[-2:] in (".x", ".y", ".z") else field
            out[(leg or 1) - 1].setdefault(field, []).append(k)
        return tuple({field: np.array(rows) for field, rows in leg.items()} for leg in out)

    def rows(self, leg: int, *starts: str) -> Integers:
        """Positions of a leg's parameters in fields that start so."""
        results = [rows for field, rows in self.fields[leg].items() if field.startswith(starts)]
        return np.concatenate([np.zeros(0, dtype=int), *results])

    def label(self, rows: Integers) -> str:
        """What a field is called."""
        label = self.machine.parameters.labels[int(rows[0])]
        return label[:-2] if len(rows) == 3 else label

    @cached_property
    def along(self) -> tuple[Array, Array]:
        """Mean direction (L, 3) of each leg, in the base frame and in the platform frame."""
        poses = self.T_base_platform
        ends = self.machine.ends_at(np.nan_to_num(self.readings), poses)
        u = ends.b - ends.a
        u = u / np.linalg.norm(u, axis=-1, keepdims=True)
        base, platform = (v.mean(axis=0) for v in (u, u @ poses[:, :3, :3]))
        return tuple(v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (base, platform))

    @cached_property
    def readings(self) -> Array:
        """Readings (K, m) at the poses."""
        return self.machine.inverse(self.T_base_platform)

    def one_hot(self, rows: Integers) -> Array:
        """Each of these parameters by itself, (P, rows)."""
        return np.eye(len(self.machine.parameters))[:, rows]


How = Callable[[Situation, Array], str]
"""Words from a motion's own numbers (k, m), one row for each direction that data leave open."""


@dataclass(frozen=True)
class NamedChanges:
    """Changes with one name.

    legs : that it is about, from 0. columns : (P, m). one, several : its sentence for one leg, and
    for several that say the same, without a full stop, with places for

    - ``{legs}``: leg 3; legs 1 to 4. ``{each}``: "each of ", before several legs.
    - ``{is}``, ``{are}``, ``{open}``: is free, are free, free; or that only the drawing knows it.
      ``{better}``, ``{limited}``: the same as an end of the sentence, empty where it is free.
    - ``{n}``: how many independent changes of a leg. ``{combinations}``: that so many are open.
      ``{ways}``: in how many ways.
    - ``{mostly}``: the numbers of a single change, or the parameters that change most.
    - ``{how}``: what ``how`` says of the motion's own numbers.

    labels : names and units of the columns, where ``{mostly}`` tells these and not the parameters.
    advice : what helps. convention : a change of the description, not of a leg: what was found does
    not count again.
    """

    legs: tuple[int, ...]
    columns: Array
    one: str
    several: str = ""
    how: How | None = None
    labels: tuple[tuple[str, str], ...] = ()
    advice: Advice = "more"
    convention: bool = False

    def words(self, n_legs: int) -> str:
        """The sentence for so many legs."""
        return self.several if n_legs > 1 and self.several else self.one


def candidates(s: Situation) -> Iterator[NamedChanges]:
    """Every motion, the most particular first; the last is anything at all."""
    yield from (_unseen(s, j) for j in s.legs if not s.observed[:, j].any())
    yield from _conventions(s)
    carried = [m for j in s.legs for m in _carriers(s, j)]
    own = [motion for j in s.legs for motion in _of_one_leg(s, j)]
    shared = [*(motion for motion, _ in carried), *_sizes(s)]
    # photographs tell legs one by one; poses leave open what is the same of all
    yield from (*own, *shared) if s.photographed else (*shared, *own)
    for group in movable_leg_groups(s.observed):
        yield from _group(s, group)
    for j in s.legs:
        yield from _whole_leg(s, j)
    if s.photographed and any("tubes" in fields for fields in s.fields):
        yield from (_spread(s, group) for group in (*movable_leg_groups(s.observed), s.legs))
    yield _everything(s)
    yield from _all_together(s, carried)
    rest = "of the machine's numbers, {combinations}{mostly}"
    yield NamedChanges(s.legs, np.eye(len(s.machine.parameters)), rest)


# ------------------------------------------------------------------ legs nobody sees, frames


def _unseen(s: Situation, leg: int) -> NamedChanges:
    read = "; its readings alone leave {n} of its values {open}"
    all_read = "; their readings alone leave {n} of each one's values {open}"
    if not s.rows(leg, "length").size:
        read = ", so that nothing tells where its joints are"
        all_read = ", so that nothing tells where their joints are"
    return NamedChanges(
        (leg,),
        s.one_hot(s.rows(leg, "")),
        "{legs} is in no photograph" + read,
        "{legs} are in no photograph" + all_read,
        advice="photograph",
    )


def _conventions(s: Situation) -> Iterator[NamedChanges]:
    """Both ends of a leg shifted alike, as a frame of its own; the base frame turned.

    Where the file holds some of what a frame would have to take along, the rest still may move.
    """
    ends = centre_index(s.machine.layout)
    shifts = np.zeros((len(s.machine.parameters), 3, s.machine.n_legs))
    for centres in ends:
        for axis in range(3):
            shifts[centres[:, axis], axis, list(s.legs)] = 1.0
    shifts = shifts.reshape(len(shifts), -1)
    layout = s.machine.layout
    bars = any(g.carrier.floats or g.carrier.turns for g in layout.platform)
    if s.photographed or (layout.motion[:3].any() and not bars):
        shifts = shifts[:, :0]  # photographs, or the platform's turns, tell the ends of legs
    else:
        one = "of {how}: both can shift alike {ways}"
        yield NamedChanges(s.legs, shifts, one, how=_difference, convention=True)
    frames = generators(s.machine.layout, s.machine.values)
    for axis in (2, 0, 1):
        # with shifts of both ends: what is held of the one end, the other makes good
        turn = np.concatenate([frames[:, [axis, 6 + axis]], shifts], axis=1)
        text = (
            f"the turn of the base frame about {AXIS_LETTERS[axis]} {{is}}: the axes and places"
            " of all base joints can turn together, and the camera or tracker with them; nothing"
            " that the mechanism file holds stops it"
        )
        yield NamedChanges(s.legs, turn, text, convention=True)


def _difference(s: Situation, coefficients: Array) -> str:
    """Along which axes both ends shift, and what is seen instead."""
    numbers = np.abs(coefficients).max(axis=0).reshape(3, -1).max(axis=1)
    axes = [c for c, x in zip(AXIS_LETTERS, numbers, strict=True) if x > 0.05 * numbers.max()]
    layout = s.machine.layout
    base, platform = (
        joined(list(dict.fromkeys(f"the {g.carrier.called}" for g in groups_)))
        for groups_ in (layout.base, layout.platform)
    )
    one_body = not any(g.carrier.floats or g.carrier.turns for g in layout.platform)
    size = one_body and {"x", "y"} <= set(axes)
    visible = ", as the difference of base and platform radius" if size else ""
    return f"{joined(axes)} of {base} and of {platform}, only the difference is seen{visible}"


# ------------------------------------------------------------------ of one leg


def _of_one_leg(s: Situation, leg: int) -> Iterator[NamedChanges]:
    """Its axes, its radii, the leg along itself, then every number and every point by itself."""
    base, platform = s.fields[leg].get("base.axis"), s.fields[leg].get("platform.axis")
    if base is not None and platform is not None:
        values, rot = s.machine.values, s.T_base_platform[0, :3, :3]
        turn = np.zeros((values.size, 3))
        turn[base] = -skew(values[base])
        turn[platform] = -skew(values[platform]) @ rot.T
        one = (
            "the common direction of both axes of {each}{legs} {is}: only the angle between the two"
            " can be seen"
        )
        yield NamedChanges((leg,), turn, one, advice="drawing")
    alone = {field: s.one_hot(rows) for field, rows in s.fields[leg].items()}
    what = {field: s.label(rows) for field, rows in s.fields[leg].items()}
    axes = [field for field in alone if field.endswith("axis")]
    points = [f for f, own in alone.items() if own.shape[1] == 3 and f not in (*axes, "tubes")]
    for field in axes:
        one = f"the direction of the {what[field]} of {{each}}{{legs}} {{is}}"
        yield NamedChanges((leg,), alone[field], one, advice="turn")
    if "tubes" in alone:
        one = "the tubes' radii of {legs} {are}"
        yield NamedChanges((leg,), alone["tubes"], one, advice="caliper")
    yield _along(s, leg)
    for field in (f for f in alone if f not in (*axes, *points, "tubes")):
        yield NamedChanges((leg,), alone[field], f"the {what[field]} of {{each}}{{legs}} {{is}}")
    for field in points:
        name = what[field].replace("centre", "joint")
        one = f"the {name} of {{each}}{{legs}} {{is}} {{how}}"
        yield NamedChanges((leg,), alone[field], one, how=lambda _s, c: directions_in_words(c))


def _along(s: Situation, leg: int) -> NamedChanges:
    """A leg that grows, or shifts, along itself."""
    start = "{legs} keeps nearly one direction in the data: it "
    starts = "{legs} keep nearly one direction each in the data: each of them "
    if s.rows(leg, "length").size:
        end, how = "{how}{limited}", _sliding
    else:
        end, how = "can shift along itself, its two joints by themselves{limited}", None
    return NamedChanges((leg,), _slide(s, leg), start + end, starts + end, how)


def _slide(s: Situation, leg: int) -> Array:
    """Base joint back along the leg, platform joint on along it, the rod growing; (P, 2)."""
    out = np.zeros((len(s.machine.parameters), 2))
    for end, (centres, along) in enumerate(
        zip(centre_index(s.machine.layout), s.along, strict=True)
    ):
        out[centres[leg], end] = (2 * end - 1) * along[leg]
    out[s.rows(leg, "length")] = 1.0
    return out


def _sliding(_s: Situation, coefficients: Array) -> str:
    """Which end slides: base, platform, both on their own, or the leg as a whole."""
    if len(coefficients) > 1:
        return "can grow and shift along itself, its two joints and its length together"
    base, platform = np.abs(coefficients[0])
    if min(base, platform) < NEGLIGIBLE_CHANGE_SHARE * max(base, platform):
        if base > platform:
            return "can grow while its base joint moves back along it"
        return "can grow while its platform joint moves on along it"
    if abs(coefficients[0].sum()) < 0.05 * max(base, platform):
        return "can shift along itself with both joints"
    return "can grow while both of its joints move along it"


def directions_in_words(vectors: Array) -> str:
    """Directions (k, 3) in words: ``along x``, ``in the x-y plane``, ``in all directions``."""
    if len(vectors) >= 3:
        return "in all directions"
    if len(vectors) == 2:
        axis = _axis_name(np.cross(vectors[0], vectors[1]))
        if axis:
            return f"in the {'-'.join(c for c in AXIS_LETTERS if c != axis)} plane"
        return "in two directions"
    axis = _axis_name(vectors[0])
    return f"along {axis}" if axis else "in one direction"


def _axis_name(vector: Array) -> str:
    """The axis that a vector (3,) is along, empty where it is along none."""
    size = np.abs(vector) / max(float(np.linalg.norm(vector)), 1e-300)
    return AXIS_LETTERS[int(np.argmax(size))] if size.max() > ALIGNED_AXIS_COSINE else ""


def _carriers(s: Situation, leg: int) -> Iterator[tuple[NamedChanges, str]]:
    """What a leg's carriers name in their own files, each with its sentence for all legs."""
    layout, poses = s.machine.layout, s.T_base_platform
    readings = np.full(len(poses), np.nan)
    if layout.actuated[leg] >= 0:
        readings = joint_values(layout, s.machine.values, s.readings)[:, leg]
    for group in (*layout.base, *layout.platform):
        for i in np.flatnonzero(group.legs == leg):
            own = group.of(s.machine.values)[i]
            for motion in group.carrier.motions(own, readings):
                # what the file is silent about lands in the last row
                columns = np.zeros((len(s.machine.parameters) + 1, motion.columns.shape[1]))
                columns[group.index[i]] = motion.columns
                names = NamedChanges((leg,), columns[:-1], motion.one, motion.several)
                yield names, motion.together


def _whole_leg(s: Situation, leg: int) -> Iterator[NamedChanges]:
    own = s.rows(leg, "base", "platform", "length", "scale")
    one = "of the values of {legs}, {combinations}{mostly}"
    yield NamedChanges((leg,), s.one_hot(own), one)
    if "tubes" in s.fields[leg] and s.photographed:
        one = "the tubes' radii of {legs} and the distance to the camera cannot be told apart"
        every = s.one_hot(s.rows(leg, ""))
        yield NamedChanges((leg,), every, one + "{better}", advice="caliper")


# ------------------------------------------------------------------ sizes that legs share


class Size(NamedTuple):
    """A number that several legs have: what it is called, its unit, and (P, L) a column a leg."""

    label: str
    unit: str
    columns: Array


def sizes(s: Situation) -> tuple[Size, ...]:
    """Radius of the base (a joint moves outwards from the middle of all) and height (along z), and
    every other number that several legs have, free ones only.
    """
    table, n = s.machine.parameters, s.machine.n_legs
    places, _ = centre_index(s.machine.layout)
    centres = s.machine.values[places]
    outwards = (centres - centres.mean(axis=0)) * [1, 1, 0]
    size = np.linalg.norm(outwards, axis=1, keepdims=True)
    outwards = outwards / np.where(size > 0, size, 1.0)
    radius, height = np.zeros((len(table), n)), np.zeros((len(table), n))
    for j in s.legs:
        radius[places[j], j] = outwards[j]
        height[places[j, 2], j] = 1.0
    results = [Size("base radius", "m", radius), Size("base height", "m", height)]
    free = np.any(table.free_matrix(), axis=1)
    for field in dict.fromkeys(field for leg in s.fields for field in leg if field != "tubes"):
        having = [j for j in s.legs if len(s.fields[j].get(field, ())) == 1]
        rows = [int(s.fields[j][field][0]) for j in having]
        if len(rows) > 1 and free[rows].any():
            columns = np.zeros((len(table), n))
            columns[rows, having] = 1.0
            results.append(Size(table.labels[rows[0]], table.units[rows[0]], columns))
    return tuple(results)


def _sizes(s: Situation) -> Iterator[NamedChanges]:
    """Few of them first: of all legs alike, then of single legs."""
    reference_values = sizes(s)
    numbers = [*range(1, min(MOST_SIZES, len(reference_values)) + 1)]
    numbers += [len(reference_values)] if len(reference_values) > MOST_SIZES else []
    apart = "cannot be told apart" + (" by heights" if s.heights else "") + "{better}"
    single: list[NamedChanges] = []
    for group in (group for n in numbers for group in combinations(reference_values, n)):
        columns = np.stack([g.columns for g in group], axis=2)  # (P, L, sizes)
        labels = tuple((f"the {g.label}", g.unit) for g in group)
        having = np.any(columns, axis=0)  # (L, sizes)
        legs = tuple(j for j in s.legs if having[j].any())
        whose = "all legs" if len(legs) == len(s.legs) else named(legs)
        what, similar = joined([label for label, _ in labels]), columns.sum(axis=1)
        text = f"{what}, of {whose} alike, "
        if len(group) == 1:
            yield NamedChanges(legs, similar, text + "{is}")
            continue
        if s.heights:
            how = _as_flat(labels, similar)
            yield NamedChanges(legs, similar, text + apart + "{how}", how=how, labels=labels)
        else:
            yield NamedChanges(legs, similar, text + apart + "{mostly}", labels=labels)
        text = f"{what} of {{each}}{{legs}} {apart}{{mostly}}"
        single += [
            NamedChanges((j,), columns[:, j], text, labels=labels) for j in legs if having[j].all()
        ]
    yield from single


def _as_flat(labels: tuple[tuple[str, str], ...], columns: Array) -> How:
    """What changes together while heights stay, and what it does to x and y."""

    def how(s: Situation, coefficients: Array) -> str:
        if len(coefficients) > 1:
            return ""
        what, unit = changes(coefficients[0], labels)
        poses = s.T_base_platform
        shifted = pose_by_parameters(s.machine, s.readings, poses)
        shifted = shifted @ columns @ coefficients[0] * unit
        xy = poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0)
        stretch = float(np.sum(shifted[:, 3:5] * xy) / np.sum(xy**2))
        does = "stretch" if stretch > 0 else "shrink"
        return (
            f": with {joined(what)}, the bed looks as flat, and x and y {does} by"
            f" {abs(stretch):.2%}"
        )

    return how


def changes(values: Array, labels: tuple[tuple[str, str], ...]) -> tuple[list[str], float]:
    """``+1 mm of the rod length``, ``+0.2 mm of the radius``: a change (m,) told by its numbers.

    labels : name and unit of each. The largest length becomes a millimetre, or, where there is
    none, the largest angle a tenth of a degree, or scale a tenth of a per cent; also returns the
    factor by which.
    """
    units = [
        {**DISPLAY_UNITS, "": (100.0, "%")}.get(unit, DISPLAY_UNITS["rad"]) for _, unit in labels
    ]
    scale = np.array([factor for factor, _ in units])
    length = np.array([unit == "m" for _, unit in labels]) & (np.abs(values) > 0)
    first = int(np.argmax(np.where(length, np.abs(values), 0 if length.any() else np.abs(values))))
    one = 1.0 if length.any() else 0.1
    factor = one / (scale[first] * values[first])
    values_out = values * factor * scale
    order = [first, *(k for k in np.argsort(-np.abs(values_out), kind="stable") if k != first)]
    order = [k for k in order if abs(values_out[k]) > UNTOLD_SIZE_CHANGE]
    texts: list[str] = []
    for k in order:
        places = decimals(abs(values_out[k])) if k != first else int(one < 1)
        texts.append(
            f"{with_unit(number(values_out[k], places, signed=True), units[k][1])} of"
            f" {labels[k][0]}"
        )
    if len(texts) > MOST_VALUES_LISTED:
        texts = [
            *texts[: MOST_VALUES_LISTED - 1],
            f"{len(texts) - MOST_VALUES_LISTED + 1} smaller changes",
        ]
    return texts, factor


# ------------------------------------------------------------------ groups of legs


def movable_leg_groups(visible: Booleans) -> tuple[tuple[int, ...], ...]:
    """Groups of legs that might move against the others, by which stations (S, L) see them.

    What one station sees, what it sees and another does not, and what hangs together through
    shared legs; of a group and its complement the smaller.
    """
    results: dict[tuple[int, ...], None] = {}
    rows = np.unique(visible, axis=0)
    parts = [*hanging_together(visible), *rows]
    parts += [a & ~b for a, b in combinations(rows, 2)] + [b & ~a for a, b in combinations(rows, 2)]
    for part in parts:
        count = int(part.sum())
        other = 2 * count > part.size or (2 * count == part.size and bool(part[0]))
        group = np.flatnonzero(~part if other else part)
        if 0 < group.size < part.size:
            results[tuple(group.tolist())] = None
    return tuple(list(results)[:MOST_GROUPS])


def hanging_together(visible: Booleans) -> tuple[Booleans, ...]:
    """Sets of legs (L,) that stations (S, L) connect, one station sharing a leg with the next."""
    joint = visible.T.astype(int) @ visible.astype(int) > 0
    reach = np.linalg.matrix_power(np.eye(len(joint)) + joint.astype(float), len(joint))
    return tuple(np.unique(reach > 0, axis=0))


def _group(s: Situation, legs: tuple[int, ...]) -> Iterator[NamedChanges]:
    """Some legs' ends moved as their body's frame would move them, the others left."""
    frames = generators(s.machine.layout, s.machine.values)
    ends: list[Array] = []
    for body, side in enumerate(("base", "platform")):
        rows = np.concatenate([s.rows(j, side) for j in legs])
        shifted = np.zeros((len(frames), 6))
        shifted[rows] = frames[rows, 6 * body : 6 * body + 6]
        middle = s.machine.values[centre_index(s.machine.layout)[body][list(legs)]].mean(axis=0)
        shifted[:, :3] += shifted[:, 3:] @ skew(
            middle
        )  # turns about the middle of these legs' joints
        ends.append(shifted)
    who, relation = named(legs), _relation(s, legs)
    joints = f"joint{'s' if len(legs) > 1 else ''} of {who}"
    text = f"{relation}: {{}} can {{{{how}}}} against the others{{{{limited}}}}"
    for what, columns, body in (
        (f"the base {joints}", ends[0], 0),
        (f"the platform {joints}", ends[1], 1),
        (f"{who} as a whole", np.concatenate(ends, axis=1), 0),
    ):
        yield NamedChanges(legs, columns, text.format(what), how=_rigid(legs, body), advice="tie")


def _relation(s: Situation, legs: tuple[int, ...]) -> str:
    """How the group is seen with the other legs."""
    others = [j for j in s.legs if j not in legs]
    with_group = np.any(s.observed[s.observed[:, list(legs)].any(axis=1)], axis=0)
    bridging = [j for j in others if with_group[j]]
    verb = "are" if len(legs) > 1 else "is"
    if not bridging:
        return f"{named(legs)} {verb} never seen together with the others"
    if len(bridging) < len(others):
        return f"of the others, only {named(bridging)} {'is' if len(bridging) == 1 else 'are'} " + (
            f"ever seen together with {named(legs)}"
        )
    return f"although {named(legs)} {verb} seen with the others, these data do not tie them"


def _rigid(legs: tuple[int, ...], body: int) -> How:
    """A group's open rigid motions; of both bodies' twelve numbers the base's tell."""

    def how(s: Situation, coefficients: Array) -> str:
        own, other = coefficients[:, :6], coefficients[:, 6:]
        twists = own if np.linalg.norm(own) > 0 or not other.size else other
        points = s.machine.values[centre_index(s.machine.layout)[body]]
        apart = ", base and platform joints each by themselves" if len(twists) > 6 else ""
        return rigid_words(twists, points, legs) + apart

    return how


def rigid_words(twists: Array, points: Array, legs: tuple[int, ...]) -> str:
    """``shift along x and turn about the axis through joints 1 and 4``: twists (k, 6) about the
    middle of some legs' joints among the points (L, 3), (omega, tau) each.
    """
    middle = points[list(legs)].mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1))))
    omega, tau = twists[:, :3] * spread, twists[:, 3:]
    least = 1e-2 * max(float(np.linalg.norm(np.c_[omega, tau], axis=1).max()), 1e-300)
    u, s, vt = np.linalg.svd(omega, full_matrices=True)
    turns = int(np.sum(s > least))
    shifts = (u[:, turns:].T @ np.c_[omega, tau])[:, 3:]  # combinations that do not turn
    if turns == 1 and not len(shifts):
        k = int(np.argmax(np.linalg.norm(omega, axis=1)))
        return f"turn about {_line(twists[k, :3], tau[k], middle, points, legs, spread)}"
    text = [f"shift {directions_in_words(shifts)}"] if len(shifts) else []
    axis = _axis_name(vt[0])
    about = (f"about {axis or 'one axis'}", "about two axes", "freely")
    return joined(text + ([f"turn {about[turns - 1]}"] if turns else []))


def _line(
    omega: Array, tau: Array, middle: Array, points: Array, legs: tuple[int, ...], spread: float
) -> str:
    """What a twist (omega, tau) about ``middle`` turns about, by the other joints on its line."""
    square = float(omega @ omega)
    point, direction = middle + cross(omega, tau) / square, omega / np.sqrt(square)
    axis = _axis_name(direction)
    if abs(float(omega @ tau) / square) > THROUGH_AXIS_DISTANCE * spread:
        return f"{axis or 'an axis'} and shift along it at once"
    distance = np.linalg.norm(np.cross(points - point, direction), axis=-1)
    on = [j for j in np.flatnonzero(distance < THROUGH_AXIS_DISTANCE * spread) if j not in legs]
    if len(on) >= 2:
        return f"the axis through joints {joined([str(j + 1) for j in on])}"
    if len(on) == 1:
        return f"{axis or 'an axis'} through joint {on[0] + 1}"
    return f"a line along {axis}" if axis else "one axis"


# ------------------------------------------------------------------ all legs


def _spread(s: Situation, legs: tuple[int, ...]) -> NamedChanges:
    """Legs move apart as they are while their tubes grow thicker by the same share, (P, 1).

    A camera sees the same where the platform does not turn: it is the depth of all of them.
    """
    values, (base, platform) = s.machine.values, centre_index(s.machine.layout)
    centres = values[base[list(legs)]]
    apart = centres - centres.mean(axis=0)
    out = np.zeros((values.size, 1))
    out[base[list(legs)], 0] = apart
    out[platform[list(legs)], 0] = apart @ s.T_base_platform[0, :3, :3]
    for j in legs:
        rows = s.rows(j, "tubes")
        out[rows, 0] = values[rows]
    who = "the legs" if len(legs) == len(s.legs) else named(legs)
    text = f"how far apart {who} stand and how thick their tubes are cannot be told apart{{better}}"
    return NamedChanges(legs, out, text, advice="more or caliper")


def _everything(s: Situation) -> NamedChanges:
    """All lengths grow by the same share, (P, 1): what readings in m stand for as well, where all
    their scales are free; else readings cannot, so offsets stay.
    """
    table, layout = s.machine.parameters, s.machine.layout
    free = np.append(np.any(table.free_matrix(), axis=1), False)
    units = np.array([*s.machine.joint_units, ""])  # the last is that of legs without a reading
    rows = layout.scale[units[layout.actuated] == "m"]
    follow = bool(free[rows].all())
    lengths = zip(table.names, table.units, strict=True)
    grows = np.array([u == "m" and (follow or not n.endswith("offset")) for n, u in lengths])
    grows[rows[: rows.size * follow]] = True
    columns = np.where(grows, s.machine.values, 0.0)[:, None]
    if not (rows.size and follow):
        text = "the size of everything {is}: all lengths can grow alike"
        return NamedChanges(s.legs, columns, text)
    text = (
        "the size of everything is known from the drawing only, by the tolerance of the readings'"
        " scales: all lengths can grow alike, and the scales with them"
    )
    return NamedChanges(s.legs, columns, text, advice="size")


def _all_together(s: Situation, carried: list[tuple[NamedChanges, str]]) -> Iterator[NamedChanges]:
    """Motions of single legs, of which only combinations are open."""
    slides = np.concatenate([_slide(s, j) for j in s.legs], axis=1)
    text = "legs that grow while their joints move along them {are} {ways}{mostly}"
    yield NamedChanges(s.legs, slides, text)
    for side, centres in zip(("base", "platform"), centre_index(s.machine.layout), strict=True):
        text = f"how the {side} joints lie to each other {{is}} {{ways}}{{mostly}}"
        yield NamedChanges(s.legs, s.one_hot(centres.ravel()), text)
    scaled = [rows for leg in s.fields for field, rows in leg.items() if field == "scale"]
    if scaled:
        text = "the scales of the readings {are} {ways}{mostly}"
        yield NamedChanges(s.legs, s.one_hot(np.concatenate(scaled)), text)
    axes = [rows for leg in s.fields for field, rows in leg.items() if field.endswith("axis")]
    if axes:
        text = "the directions of the joints' axes {are} {ways}{mostly}"
        yield NamedChanges(s.legs, s.one_hot(np.concatenate(axes)), text, advice="turn")
    for sentence in dict.fromkeys(text for _, text in carried if text):
        own = [motion for motion, text in carried if text == sentence]
        legs = tuple(leg for motion in own for leg in motion.legs)
        columns = np.concatenate([motion.columns for motion in own], axis=1)
        yield NamedChanges(legs, columns, sentence, advice="turn")
    radii = all_radii(s)
    if radii.columns.size:
        yield radii


def all_radii(s: Situation) -> NamedChanges:
    """The radii of all tubes, (P, tubes)."""
    legs = tuple(j for j in s.legs if "tubes" in s.fields[j])
    rows = np.concatenate([s.rows(j, "tubes") for j in s.legs])
    return NamedChanges(legs, s.one_hot(rows), "the tubes' radii of {legs} {are}", advice="caliper")
