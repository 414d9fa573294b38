"""Named motions of a machine: candidates for the null space of the data.

A motion is a set of changes with one name and one sentence: its columns are changes of all P
parameters in their own units (m, rad, or parts of a unit axis). Motions come from the parameter
table (a parameter of one leg, the same parameter of all legs, parameters that all legs have in
common), from frames (single legs, groups of legs and whole bodies moved as rigid bodies), from
slides of a leg along itself, and from the carriers' own files, so no kind of joint is named here.
:mod:`pkmcal.identify.unidentified` selects the motions that the data do not determine.
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
from pkmcal.identify.tool import closed_poses, pose_by_parameters
from pkmcal.levels import ALIGNED_ANGLE, NAMED_SHARE, NEARLY_ALL, NEGLIGIBLE
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import joint_values
from pkmcal.wording import (
    DISPLAY_UNITS,
    decimals,
    joined,
    named,
    number,
    percentage,
    split_name,
    with_unit,
)

AXIS_LETTERS = "xyz"
MOST_GROUPS = 120
"""Largest number of groups of legs that are tried; ten stations, each of which sees other legs,
form about as many."""
MOST_SIZES = 3
"""Largest number of sizes that are tried together, besides all of them; the number of combinations
grows as powers of two."""
MOST_VALUES_LISTED = 5
"""Largest number of terms in a sentence, the last of which may stand for all smaller ones."""

Advice = Literal[
    "more", "photograph", "tie", "caliper", "more or caliper", "turn", "drawing", "size"
]  # fmt: skip
"""Kind of advice: see :mod:`pkmcal.identify.sentences`."""


@dataclass(frozen=True)
class UnidentifiedOptions:
    """Constants of the sentences on undetermined directions. All but ``weak`` only affect their
    wording; no verdict depends on them.
    """

    # squared cosines between a motion and the undetermined space above which the motion explains a
    # part of that space. The larger one is applied first, since many motions are similar once
    # frames are removed; the smaller one allows for the noise of the poses at which the space was
    # evaluated. They choose among sentences on one space; the motions' sum is the same
    inside: tuple[float, float] = (0.999, 0.95)
    # information in units of the prior (singular value) below which a direction counts as
    # unidentified: the data then leave nearly all of its variance, 1 / (1 + weak^2). Estimated
    # poses of a translational platform contain small rotations by noise, so unidentifiable
    # directions have some spurious information
    weak: float = (1 / NEARLY_ALL - 1) ** 0.5
    # reweighting steps to the sparsest coefficients, and weight of the frames' coefficients, which
    # are not part of a sentence and so need not be sparse
    sparse_steps: int = 20
    frame_weight: float = 10.0

    # sine of the angle to the previous motions below which a motion describes nothing new: the new
    # share of its square is negligible
    new_sine: float = NEGLIGIBLE**0.5


UNIDENTIFIED = UnidentifiedOptions()


@dataclass(frozen=True)
class Situation:
    """Session from which the candidates are made.

    machine : with its present values.
    observed : (S, L) legs that each station measures.
    T_base_platform : (K, 4, 4) poses of the session.
    imaged : whether legs are in images; otherwise only boards, poses or heights were
    measured.
    heights : whether nothing but heights was measured.
    options : those of the sentences.
    """

    machine: Machine
    observed: Booleans
    T_base_platform: Array
    imaged: bool = True
    heights: bool = False
    options: UnidentifiedOptions = UNIDENTIFIED

    @cached_property
    def legs(self) -> tuple[int, ...]:
        """All legs, from 0."""
        return tuple(range(self.machine.n_legs))

    @cached_property
    def fields(self) -> tuple[dict[str, Integers], ...]:
        """Positions of each leg's parameters by field: ``base.center``, ``length.offset``, and
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
        """Positions of a leg's parameters in fields whose names start with one of ``starts``."""
        results = [rows for field, rows in self.fields[leg].items() if field.startswith(starts)]
        return np.concatenate([np.zeros(0, dtype=int), *results])

    def label(self, rows: Integers) -> str:
        """Name of the field with these parameters, for people."""
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
        """Unit changes of single parameters, (P, rows)."""
        return np.eye(len(self.machine.parameters))[:, rows]


How = Callable[[Situation, Array], str]
"""Words made from a motion's coefficients (k, m), one row for each open direction."""


@dataclass(frozen=True)
class NamedChanges:
    """Changes of the parameters with one name.

    legs : legs that the changes concern, from 0.
    columns : (P, m).
    one, several : sentence for one leg, and for several legs, without a full stop, with the fields

    - ``{legs}``: leg 3; legs 1 to 4. ``{each}``: "each of ", before several legs.
    - ``{is}``, ``{are}``, ``{open}``: is free, are free, free; or known from the nominal model
      only. ``{better}``, ``{limited}``: the same as an end of the sentence, empty where it is free.
    - ``{n}``: number of independent changes of a leg. ``{combinations}``: number of undetermined
      combinations. ``{ways}``: number of independent changes, in words.
    - ``{mostly}``: terms of a single change, or the parameters that change most.
    - ``{how}``: result of ``how`` for the motion's coefficients.

    how : function from the coefficients (k, m) to words.
    labels : names and units of the columns, where ``{mostly}`` lists these instead of parameters.
    advice : kind of advice.
    convention : whether the change affects only the description of the machine, as frames do; other
        motions are searched without it.
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
        """Sentence for a number of legs."""
        return self.several if n_legs > 1 and self.several else self.one


def candidates(s: Situation) -> Iterator[NamedChanges]:
    """All motions, the most specific first; the last one is any change at all."""
    if s.imaged:
        yield from (_unseen(s, j) for j in s.legs if not s.observed[:, j].any())
    yield from _conventions(s)
    carried = [m for j in s.legs for m in _carriers(s, j)]
    own = [motion for j in s.legs for motion in _of_one_leg(s, j)]
    shared = [*(motion for motion, _ in carried), *_sizes(s)]
    # images measure legs one by one; poses leave open changes that all legs have in common
    yield from (*own, *shared) if s.imaged else (*shared, *own)
    for group in movable_leg_groups(s.observed):
        yield from _group(s, group)
    for j in s.legs:
        yield from _whole_leg(s, j)
    if s.imaged and any("tubes" in fields for fields in s.fields):
        yield from (_spread(s, group) for group in (*movable_leg_groups(s.observed), s.legs))
    yield _everything(s)
    yield from _all_together(s, carried)
    rest = "of the machine's numbers, {combinations}{mostly}"
    yield NamedChanges(s.legs, np.eye(len(s.machine.parameters)), rest)


# ------------------------------------------------------------------ legs in no image, frames


def _unseen(s: Situation, leg: int) -> NamedChanges:
    """All parameters of a leg that is in no image."""
    read = "; its readings alone leave {n} of its values {open}"
    all_read = "; their readings alone leave {n} of each one's values {open}"
    if not s.rows(leg, "length").size:
        read = ", so that nothing determines where its joints are"
        all_read = ", so that nothing determines where their joints are"
    return NamedChanges(
        (leg,),
        s.one_hot(s.rows(leg, "")),
        "{legs} is in no image" + read,
        "{legs} are in no image" + all_read,
        advice="photograph",
    )


def _conventions(s: Situation) -> Iterator[NamedChanges]:
    """Both ends of the legs shifted in the same way, as a frame of its own; the base frame rotated.

    Where the file fixes parameters that a frame change would have to change, the others may still
    change.
    """
    ends = centre_index(s.machine.layout)
    shifts = np.zeros((len(s.machine.parameters), 3, s.machine.n_legs))
    for centres in ends:
        for axis in range(3):
            shifts[centres[:, axis], axis, list(s.legs)] = 1.0
    shifts = shifts.reshape(len(shifts), -1)
    layout = s.machine.layout
    bars = any(g.carrier.floats or g.carrier.turns for g in layout.platform)
    if s.imaged or (layout.motion[:3].any() and not bars):
        shifts = shifts[:, :0]  # images, or the platform's rotations, determine both ends
    else:
        one = "of {how}: both can shift alike {ways}"
        yield NamedChanges(s.legs, shifts, one, how=_difference, convention=True)
    frames = generators(s.machine.layout, s.machine.values)
    for axis in (2, 0, 1):
        # with shifts of both ends, which compensate for coordinates that are fixed at one end
        turn = np.concatenate([frames[:, [axis, 6 + axis]], shifts], axis=1)
        text = (
            f"the turn of the base frame about {AXIS_LETTERS[axis]} {{is}}: the axes and places"
            " of all base joints can turn together, and the camera or tracker with them; nothing"
            " that the mechanism file holds stops it"
        )
        yield NamedChanges(s.legs, turn, text, convention=True)


def _difference(s: Situation, coefficients: Array) -> str:
    """Axes along which both ends shift, and the difference that is identifiable instead."""
    numbers = np.abs(coefficients).max(axis=0).reshape(3, -1).max(axis=1)
    axes = [
        c for c, x in zip(AXIS_LETTERS, numbers, strict=True) if x > NAMED_SHARE * numbers.max()
    ]
    layout = s.machine.layout
    base, platform = (
        joined(list(dict.fromkeys(f"the {g.carrier.called}" for g in groups_)))
        for groups_ in (layout.base, layout.platform)
    )
    one_body = not any(g.carrier.floats or g.carrier.turns for g in layout.platform)
    size = one_body and {"x", "y"} <= set(axes)
    visible = ", as the difference of base and platform radius" if size else ""
    return f"{joined(axes)} of {base} and of {platform}, only the difference is determined{visible}"


# ------------------------------------------------------------------ one leg


def _of_one_leg(s: Situation, leg: int) -> Iterator[NamedChanges]:
    """Motions of one leg: axes, radii, the leg along itself, then each parameter and each point
    alone.
    """
    # both axes rotated together
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
    # each axis, the tubes' radii, the leg along itself
    for field in axes:
        one = f"the direction of the {what[field]} of {{each}}{{legs}} {{is}}"
        yield NamedChanges((leg,), alone[field], one, advice="turn")
    if "tubes" in alone:
        one = "the tubes' radii of {legs} {are}"
        yield NamedChanges((leg,), alone["tubes"], one, advice="caliper")
    yield _along(s, leg)
    # each other parameter, and each point, alone
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
    """Base joint back along the leg, platform joint forward along it, the rod growing; (P, 2)."""
    out = np.zeros((len(s.machine.parameters), 2))
    for end, (centres, along) in enumerate(
        zip(centre_index(s.machine.layout), s.along, strict=True)
    ):
        out[centres[leg], end] = (2 * end - 1) * along[leg]
    out[s.rows(leg, "length")] = 1.0
    return out


def _sliding(_s: Situation, coefficients: Array) -> str:
    """End that slides: base, platform, both independently, or the leg as a whole."""
    if len(coefficients) > 1:
        return "can grow and shift along itself, its two joints and its length together"
    base, platform = np.abs(coefficients[0])
    if min(base, platform) < NEGLIGIBLE * max(base, platform):
        if base > platform:
            return "can grow while its base joint moves back along it"
        return "can grow while its platform joint moves on along it"
    if abs(coefficients[0].sum()) < NAMED_SHARE * max(base, platform):
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
    """Name of the axis that a vector (3,) is parallel to, empty for none."""
    size = np.abs(vector) / max(float(np.linalg.norm(vector)), 1e-300)
    return AXIS_LETTERS[int(np.argmax(size))] if size.max() > np.cos(ALIGNED_ANGLE) else ""


def _carriers(s: Situation, leg: int) -> Iterator[tuple[NamedChanges, str]]:
    """Motions that a leg's carriers define, each with its sentence for all legs."""
    layout, poses = s.machine.layout, s.T_base_platform
    readings = np.full(len(poses), np.nan)
    if layout.actuated[leg] >= 0:
        readings = joint_values(layout, s.machine.values, s.readings)[:, leg]
    for group in (*layout.base, *layout.platform):
        for i in np.flatnonzero(group.legs == leg):
            own = group.of(s.machine.values)[i]
            for motion in group.carrier.motions(own, readings):
                # parameters that are not in the file have the last index, a row that is discarded
                columns = np.zeros((len(s.machine.parameters) + 1, motion.columns.shape[1]))
                columns[group.index[i]] = motion.columns
                names = NamedChanges((leg,), columns[:-1], motion.one, motion.several)
                yield names, motion.together


def _whole_leg(s: Situation, leg: int) -> Iterator[NamedChanges]:
    """Any combination of a leg's parameters; tube radii with the distance to the camera."""
    own = s.rows(leg, "base", "platform", "length", "scale")
    one = "of the values of {legs}, {combinations}{mostly}"
    yield NamedChanges((leg,), s.one_hot(own), one)
    if "tubes" in s.fields[leg] and s.imaged:
        one = "the tubes' radii of {legs} and the distance to the camera cannot be separated"
        every = s.one_hot(s.rows(leg, ""))
        yield NamedChanges((leg,), every, one + "{better}", advice="caliper")


# ------------------------------------------------------------------ sizes that legs share


class Size(NamedTuple):
    """A parameter that several legs have.

    label, unit : its name and unit.
    columns : (P, L), one column a leg.
    """

    label: str
    unit: str
    columns: Array


def sizes(s: Situation) -> tuple[Size, ...]:
    """Base radius (joints move outwards from their centre), base height (along z), and every other
    parameter that several legs have, if any of these is free.
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
    """Combinations of few sizes first: of all legs together, then of single legs."""
    all_sizes = sizes(s)
    numbers = [*range(1, min(MOST_SIZES, len(all_sizes)) + 1)]
    numbers += [len(all_sizes)] if len(all_sizes) > MOST_SIZES else []
    apart = "cannot be separated" + (" by heights" if s.heights else "") + "{better}"
    single: list[NamedChanges] = []
    for group in (group for n in numbers for group in combinations(all_sizes, n)):
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
    """Words on sizes that change together without effect on heights, and on their effect on x and
    y.
    """

    def how(s: Situation, coefficients: Array) -> str:
        """Words on a single change; none for several."""
        if len(coefficients) > 1:
            return ""
        what, unit = changes(coefficients[0], labels)
        joints, poses = closed_poses(s.machine, s.T_base_platform)
        shifted = pose_by_parameters(s.machine, joints, poses)
        shifted = shifted @ columns @ coefficients[0] * unit
        xy = poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0)
        stretch = float(np.sum(shifted[:, 3:5] * xy) / np.sum(xy**2))
        does = "stretch" if stretch > 0 else "shrink"
        return (
            f": with {joined(what)}, the bed looks as flat, and x and y {does} by"
            f" {percentage(abs(stretch), 2)}"
        )

    return how


def changes(values: Array, labels: tuple[tuple[str, str], ...]) -> tuple[list[str], float]:
    """Terms of a change (m,): ``+1 mm of the rod length``, ``+0.2 mm of the radius``.

    The change is scaled so that its largest length is a millimetre, or, without lengths, its
    largest angle a tenth of a degree, or its largest scale a tenth of a per cent; the factor is
    also returned.

    labels : name and unit of each number.
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
    order = [k for k in order if abs(values_out[k]) > NEGLIGIBLE]
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
    """Groups of legs that may move relative to the others, by the legs that stations see (S, L).

    Legs of one station, differences between two stations, and legs connected through stations that
    share legs; of a group and its complement the smaller.
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
    """Sets of legs (L,) that stations (S, L) connect: each station shares a leg with the next."""
    joint = visible.T.astype(int) @ visible.astype(int) > 0
    reach = np.linalg.matrix_power(np.eye(len(joint)) + joint.astype(float), len(joint))
    return tuple(np.unique(reach > 0, axis=0))


def _group(s: Situation, legs: tuple[int, ...]) -> Iterator[NamedChanges]:
    """Ends of some legs moved as a rigid body, the others unchanged."""
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
    """Words on how stations measure the group together with the other legs."""
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
    """Words on the open rigid motions of a group; of both bodies' twelve numbers, on the base's."""

    def how(s: Situation, coefficients: Array) -> str:
        """Words on the twists of one body."""
        own, other = coefficients[:, :6], coefficients[:, 6:]
        twists = own if np.linalg.norm(own) > 0 or not other.size else other
        points = s.machine.values[centre_index(s.machine.layout)[body]]
        apart = ", base and platform joints each by themselves" if len(twists) > 6 else ""
        return rigid_words(twists, points, legs) + apart

    return how


def rigid_words(twists: Array, points: Array, legs: tuple[int, ...]) -> str:
    """Twists in words: ``shift along x and turn about the axis through joints 1 and 4``.

    twists : (k, 6) each (omega, tau), about the centre of some legs' joints.
    points : (L, 3) all joints.
    """
    middle = points[list(legs)].mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=-1))))
    omega, tau = twists[:, :3] * spread, twists[:, 3:]
    least = NEGLIGIBLE * max(float(np.linalg.norm(np.c_[omega, tau], axis=1).max()), 1e-300)
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
    """Axis of a twist (omega, tau) about ``middle`` in words, by the other joints on it."""
    square = float(omega @ omega)
    point, direction = middle + cross(omega, tau) / square, omega / np.sqrt(square)
    axis = _axis_name(direction)
    if abs(float(omega @ tau) / square) > NAMED_SHARE * spread:
        return f"{axis or 'an axis'} and shift along it at once"
    distance = np.linalg.norm(np.cross(points - point, direction), axis=-1)
    on = [j for j in np.flatnonzero(distance < NAMED_SHARE * spread) if j not in legs]
    if len(on) >= 2:
        return f"the axis through joints {joined([str(j + 1) for j in on])}"
    if len(on) == 1:
        return f"{axis or 'an axis'} through joint {on[0] + 1}"
    return f"a line along {axis}" if axis else "one axis"


# ------------------------------------------------------------------ all legs


def _spread(s: Situation, legs: tuple[int, ...]) -> NamedChanges:
    """Change (P, 1) that moves legs apart in their present shape and scales their tubes' radii
    alike.

    All depths change by the same ratio, so the images stay the same if the platform does not
    rotate.
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
    text = f"how far apart {who} stand and how thick their tubes are cannot be separated{{better}}"
    return NamedChanges(legs, out, text, advice="more or caliper")


def _everything(s: Situation) -> NamedChanges:
    """All lengths grow by the same ratio, (P, 1): readings in m as well if all their scales are
    free; else readings cannot follow, and offsets stay.
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
        return NamedChanges(s.legs, columns, text, advice="more" if rows.size else "size")
    text = (
        "the size of everything is known from the nominal model only, by the tolerance of the"
        " readings' scales: all lengths can grow alike, and the scales with them"
    )
    return NamedChanges(s.legs, columns, text, advice="size")


def _all_together(s: Situation, carried: list[tuple[NamedChanges, str]]) -> Iterator[NamedChanges]:
    """Motions of single legs of which only combinations are open."""
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
    """Radii of all tubes, (P, tubes)."""
    legs = tuple(j for j in s.legs if "tubes" in s.fields[j])
    rows = np.concatenate([s.rows(j, "tubes") for j in s.legs])
    return NamedChanges(legs, s.one_hot(rows), "the tubes' radii of {legs} {are}", advice="caliper")
