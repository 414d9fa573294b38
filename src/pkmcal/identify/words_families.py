"""Changes of a machine that people can picture: candidates for what data do not tell.

A family is a set of changes with one name, such as "leg 3's base joint slides along the leg". Its
columns are changes of all parameters, P of them, in their own units (m, rad), base and platform
frame as the parameters are. :mod:`pkmcal.identify.words` finds which families lie in the space
of what the data leave open; the most particular come first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, skew
from pkmcal.identify.words_driven import driven_families, remaining
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends

AXES = "xyz"
MOST_GROUPS = 120
"""Groups of legs that are tried; ten stations that each see other legs make about as many."""


class Places(NamedTuple):
    """Positions of the parameters, -1 where a leg has none.

    base, platform, base_axis, platform_axis : (L, 3). rod : (L,) offset or constant length.
    constant : (L,) legs of constant length. radius : per leg, (tubes,). others : per leg, what
    cranks and bars have besides.
    """

    base: Integers
    platform: Integers
    base_axis: Integers
    platform_axis: Integers
    rod: Integers
    constant: Booleans
    radius: tuple[Integers, ...]
    others: tuple[Integers, ...]

    def of_leg(self, leg: int) -> Integers:
        """All of a leg's parameters but its radii."""
        rows = [*self.base[leg], *self.platform[leg], *self.base_axis[leg]]
        rows = np.array([*rows, *self.platform_axis[leg], self.rod[leg], *self.others[leg]])
        return rows[rows >= 0]


def places(machine: Machine) -> Places:
    """Where each parameter of a machine stands."""
    at = {name: k for k, name in enumerate(machine.parameters.names)}
    legs = range(1, machine.n_legs + 1)

    def triple(path: str) -> Integers:
        return np.array([[at.get(f"legs[{j}].{path}.{c}", -1) for c in AXES] for j in legs])

    constant = np.array([at.get(f"legs[{j}].length.constant", -1) for j in legs])
    offset = np.array([at.get(f"legs[{j}].length.offset", -1) for j in legs])
    radius = [[k for name, k in at.items() if name.startswith(f"legs[{j}].tubes")] for j in legs]
    return Places(
        triple("base.center"),
        triple("platform.center"),
        triple("base.axis"),
        triple("platform.axis"),
        np.maximum(constant, offset),
        constant >= 0,
        tuple(np.array(rows, dtype=int) for rows in radius),
        tuple(np.array(_others(at, j), dtype=int) for j in legs),
    )


def _others(at: dict[str, int], leg: int) -> list[int]:
    """A leg's parameters that are neither centre, axis, length nor tube."""
    start = tuple(f"legs[{leg}].{side}." for side in ("base", "platform"))
    known = tuple(f"{body}{part}" for body in start for part in ("center", "axis"))
    return [k for n, k in at.items() if n.startswith(start) and not n.startswith(known)]


@dataclass(frozen=True)
class Circumstances:
    """What the candidates are made from.

    machine : with the present values. seen : (S, L) legs that each station sees.
    T_base_platform : (K, 4, 4) poses of the session. at : the parameters' places. photographed :
    whether legs are in photographs; otherwise only boards or poses were seen. heights : whether it
    was nothing but heights.
    along_base, along_platform : (L, 3) mean direction of each leg in the frame of either body.
    """

    machine: Machine
    seen: Booleans
    T_base_platform: Array
    at: Places
    photographed: bool
    along_base: Array
    along_platform: Array
    heights: bool = False


def circumstances(
    machine: Machine,
    seen: Booleans,
    T_base_platform: Array,
    photographed: bool = True,
    heights: bool = False,
) -> Circumstances:
    """Leg directions at the poses (K, 4, 4), and the rest as it is."""
    readings = np.zeros((len(T_base_platform), machine.n_joints))
    ends = limb_ends(machine.layout, machine.values, readings, T_base_platform)
    u = ends.b - ends.a
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    turned = u @ T_base_platform[:, :3, :3]
    along = [v.mean(axis=0) for v in (u, turned)]
    along = [v / np.linalg.norm(v, axis=-1, keepdims=True) for v in along]
    at = places(machine)
    return Circumstances(
        machine, seen, T_base_platform, at, photographed, along[0], along[1], heights
    )


@dataclass(frozen=True)
class Family:
    """Changes with one name: kind, the legs it is about (from 0), columns (P, m).

    among : one of the words' details, such as a coordinate's name.
    """

    kind: str
    legs: tuple[int, ...]
    columns: Array
    among: str = ""


def families(around: Circumstances) -> Iterator[Family]:
    """Every candidate, the most particular first."""
    legs = range(around.machine.n_legs)
    yield from (_unseen(around, j) for j in legs if not around.seen[:, j].any())
    yield from (Family(*change) for change in driven_families(around))
    for j in legs:
        yield from _axes(around, j)
        if around.at.radius[j].size:
            yield Family("radius", (j,), _one_hot(around, around.at.radius[j]))
    for j in legs:
        yield from _rod_and_centres(around, j)
    for group in groups(around.seen):
        yield from _group(around, group)
    yield from _whole_bodies(around)
    for j in legs:
        own = around.at.of_leg(j)
        yield Family("leg", (j,), _one_hot(around, own))
        if around.at.radius[j].size and around.photographed:
            own = np.concatenate([own, around.at.radius[j]])
            yield Family("depth", (j,), _one_hot(around, own))
    tubes = around.photographed and any(rows.size for rows in around.at.radius)
    for group in groups(around.seen) if tubes else ():
        yield Family("spread", group, _spread(around, group))
    yield from _common(around)
    yield from (Family(*change) for change in remaining(around))
    yield Family("rest", tuple(legs), np.eye(len(around.machine.parameters)))


def groups(seen: Booleans) -> tuple[tuple[int, ...], ...]:
    """Groups of legs that might move against the others, by which stations (S, L) see them.

    What one station sees, what it sees and another does not, and what hangs together through
    shared legs; of a group and its complement the smaller.
    """
    found: dict[tuple[int, ...], None] = {}
    rows = np.unique(seen, axis=0)
    parts = [*hanging_together(seen), *rows]
    parts += [a & ~b for a, b in combinations(rows, 2)] + [b & ~a for a, b in combinations(rows, 2)]
    for part in parts:
        count = int(part.sum())
        other = 2 * count > part.size or (2 * count == part.size and bool(part[0]))
        group = np.flatnonzero(~part if other else part)
        if 0 < group.size < part.size:
            found[tuple(group.tolist())] = None
    return tuple(list(found)[:MOST_GROUPS])


def hanging_together(seen: Booleans) -> tuple[Booleans, ...]:
    """Sets of legs (L,) that stations (S, L) connect, one station sharing a leg with the next."""
    together = seen.T.astype(int) @ seen.astype(int) > 0
    reach = np.linalg.matrix_power(np.eye(len(together)) + together.astype(float), len(together))
    rows = np.unique(reach > 0, axis=0)
    return tuple(row for row in rows)


def _one_hot(around: Circumstances, rows: Integers) -> Array:
    return np.eye(len(around.machine.parameters))[:, rows]


def _unseen(around: Circumstances, leg: int) -> Family:
    rows = np.concatenate([around.at.of_leg(leg), around.at.radius[leg]])
    return Family("unseen", (leg,), _one_hot(around, rows))


def _axes(around: Circumstances, leg: int) -> Iterator[Family]:
    """Turns of a leg's axes: both together, or one alone."""
    base, platform = around.at.base_axis[leg], around.at.platform_axis[leg]
    if base[0] >= 0 and platform[0] >= 0:
        values, rot = around.machine.values, around.T_base_platform[0, :3, :3]
        out = np.zeros((values.size, 3))
        out[base] = -skew(values[base])
        out[platform] = -skew(values[platform]) @ rot.T
        yield Family("common turn", (leg,), out)
    for side, rows in (("base", base), ("platform", platform)):
        if rows[0] >= 0:
            yield Family("axis", (leg,), _one_hot(around, rows), side)


def _slides(around: Circumstances, leg: int) -> Array:
    """Base joint back along the leg, platform joint on along it, the rod growing; (P, 2)."""
    out = np.zeros((len(around.machine.parameters), 2))
    out[around.at.base[leg], 0] = -around.along_base[leg]
    out[around.at.platform[leg], 1] = around.along_platform[leg]
    if around.at.rod[leg] >= 0:
        out[around.at.rod[leg]] = 1.0
    return out


def _rod_and_centres(around: Circumstances, leg: int) -> Iterator[Family]:
    among = "" if around.at.rod[leg] >= 0 else "passive"
    yield Family("slide", (leg,), _slides(around, leg), among)
    if around.at.rod[leg] >= 0:
        yield Family("rod", (leg,), _one_hot(around, around.at.rod[[leg]]))
    yield Family("centre", (leg,), _one_hot(around, around.at.base[leg]), "base")
    yield Family("centre", (leg,), _one_hot(around, around.at.platform[leg]), "platform")


def twists(around: Circumstances, side: str, legs: tuple[int, ...]) -> Array:
    """Rigid motions (omega, tau) of some legs' joints on one body about their mean, (P, 6)."""
    at = around.at
    centre, axis = (at.base, at.base_axis) if side == "base" else (at.platform, at.platform_axis)
    values = around.machine.values
    middle = values[centre[list(legs)]].mean(axis=0)
    out = np.zeros((values.size, 6))
    for j in legs:
        out[centre[j], :3] = -skew(values[centre[j]] - middle)
        out[centre[j], 3:] = np.eye(3)
        if axis[j, 0] >= 0:
            out[axis[j], :3] = -skew(values[axis[j]])
    return out


def _group(around: Circumstances, legs: tuple[int, ...]) -> Iterator[Family]:
    base, platform = twists(around, "base", legs), twists(around, "platform", legs)
    yield Family("group", legs, base, "base")
    yield Family("group", legs, platform, "platform")
    yield Family("group", legs, np.concatenate([base, platform], axis=1), "both")


def _whole_bodies(around: Circumstances) -> Iterator[Family]:
    """One coordinate of the joints of a body, or of both."""
    legs = tuple(range(around.machine.n_legs))
    for axis, name in enumerate(AXES):
        base, platform = around.at.base[:, axis], around.at.platform[:, axis]
        yield Family(f"{name} of base", legs, _one_hot(around, base), name)
        yield Family(f"{name} of platform", legs, _one_hot(around, platform), name)
        both = np.concatenate([base, platform])
        yield Family(f"{name} of both", legs, _one_hot(around, both), name)


def _common(around: Circumstances) -> Iterator[Family]:
    """What several legs share: lengths, scale, all slides, all centres, all axes."""
    at, all_legs = around.at, tuple(range(around.machine.n_legs))
    driven = np.flatnonzero((at.rod >= 0) & ~at.constant)
    for kind, legs in (("constant", np.flatnonzero(at.constant)), ("offset", driven)):
        if legs.size > 1:
            columns = _one_hot(around, at.rod[legs])
            yield Family(f"common {kind}", tuple(legs.tolist()), columns.sum(1, keepdims=True))
            yield Family(f"{kind}s", tuple(legs.tolist()), columns)
    if around.photographed and any(rows.size for rows in at.radius):
        yield Family("spread", all_legs, _spread(around, all_legs))
    yield Family("scale", all_legs, _scale(around))
    slides = np.concatenate([_slides(around, j) for j in all_legs], axis=1)
    yield Family("slides", all_legs, slides)
    yield Family("centres", all_legs, _one_hot(around, at.base.ravel()), "base")
    yield Family("centres", all_legs, _one_hot(around, at.platform.ravel()), "platform")
    axes = np.concatenate([at.base_axis.ravel(), at.platform_axis.ravel()])
    if (axes >= 0).any():
        yield Family("axes", all_legs, _one_hot(around, axes[axes >= 0]))
    if any(rows.size for rows in at.radius):
        yield all_radii(around)


def all_radii(around: Circumstances) -> Family:
    """The radii of all tubes, (P, tubes)."""
    legs = tuple(range(around.machine.n_legs))
    return Family("radii", legs, _one_hot(around, np.concatenate(around.at.radius)))


def _scale(around: Circumstances) -> Array:
    """All lengths grow by the same share, (P, 1); readings cannot, so offsets stay."""
    values, at = around.machine.values, around.at
    out = np.zeros((values.size, 1))
    rows = [at.base.ravel(), at.platform.ravel(), at.rod[at.constant], *at.radius]
    rows = np.concatenate(rows)
    out[rows, 0] = values[rows]
    return out


def _spread(around: Circumstances, legs: tuple[int, ...]) -> Array:
    """Legs move apart as they are while their tubes grow thicker by the same share, (P, 1).

    A camera sees the same where the platform does not turn: it is the depth of all of them.
    """
    values, at = around.machine.values, around.at
    centres = values[at.base[list(legs)]]
    apart = centres - centres.mean(axis=0)
    out = np.zeros((values.size, 1))
    out[at.base[list(legs)], 0] = apart
    out[at.platform[list(legs)], 0] = apart @ around.T_base_platform[0, :3, :3]
    for j in legs:
        out[at.radius[j], 0] = values[at.radius[j]]
    return out


def line_of(twist: Array, middle: Array) -> tuple[Array, Array, float]:
    """Axis point (3,), direction (3,) and pitch (m/rad) of a twist (omega, tau) about middle."""
    omega, tau = twist[:3], twist[3:]
    size = float(omega @ omega)
    return middle + cross(omega, tau) / size, omega / np.sqrt(size), float(omega @ tau) / size
