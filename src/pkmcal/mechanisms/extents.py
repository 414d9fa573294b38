"""How far a machine reaches: along directions from a pose, and over a grid of positions."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose, pose_difference
from pkmcal.mechanisms.kinematics import inverse_result, on_manifold, typical_reach
from pkmcal.mechanisms.workspace import Limits, Reach, reachable

STEPS = 100
"""Poses along a ray before the bisection: what is narrower is not seen."""
HALVINGS = 30
KEPT = 0.99
"""Share of the way asked for that must be left when constant rods and axes had their say."""
ROUNDS = 4
AT_ONCE = 20_000
"""Poses of a grid at a time."""


@dataclass(frozen=True)
class Extents:
    """How far each of k directions leads.

    distance : (k,) in units of the direction: m for three numbers, which are made a unit vector.
    poses : (k, 4, 4) the last that the machine can take. why : what stands against the next, of
    each direction; () where the end of the search was reached.
    """

    distance: Array
    poses: Array
    why: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Grid:
    """Positions on a grid with one orientation.

    axes : the coordinates along each direction, m from the middle pose, (a,) (b,) and, of a
        volume, (c,).
    inside : (a, b[, c]) poses that the machine can take and that hang together with the middle
        pose through neighbours on the grid. singularity : of the same shape, NaN out of reach.
    size : area (m^2) or volume (m^3) of what is inside, cells counted.
    """

    axes: tuple[Array, ...]
    inside: Booleans
    singularity: Array
    size: float


def extents(limits: Limits, directions: Array, start: Array, most: float | None = None) -> Extents:
    """How far one comes from ``start`` (4, 4) along straight ways, until something stands against
    it: a range, a limb's reach, a singular pose.

    directions : (k, 3) along the base's axes, or (k, 6) twists (omega, tau): then distances count
    in them, a twist of 1 rad about an axis in rad. most : where the search ends, in the same units;
    when absent half a turn or twice a rod's length, whichever comes first. On machines whose rods
    and axes hold some freedoms, the pose next to the straight way is taken.
    Raises InputError where ``start`` itself is outside, and for a direction of length zero.
    """
    at_start = reachable(limits, start)
    if not at_start.inside:
        raise InputError(
            what="the search for the workspace begins at a pose that the machine cannot take",
            found="; ".join(at_start.why()),
            next_step="begin at the home pose, or check the ranges in the mechanism file",
        )
    twists = _twists(directions)
    farthest = _farthest(limits, twists) if most is None else np.full(len(twists), most)
    way = farthest[:, None] * np.linspace(0, 1, STEPS + 1)
    inside = _along(limits, start, twists[:, None], way)[1].inside
    still: Booleans = np.logical_and.accumulate(inside, axis=1)
    last = still.sum(axis=1) - 1
    rows = np.arange(len(twists))
    low, high = way[rows, last], way[rows, np.minimum(last + 1, STEPS)]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        good = _along(limits, start, twists, middle)[1].inside
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    poses = _along(limits, start, twists, low)[0]
    beyond = _along(limits, start, twists, high)[1]
    why = tuple(() if last[k] == STEPS else beyond.why(k) for k in range(len(twists)))
    return Extents(low, poses, why)


def _farthest(limits: Limits, twists: Array) -> Array:
    """Where the search along twists (k, 6) ends, (k,)."""
    turn, move = (np.linalg.norm(part, axis=-1) for part in (twists[:, :3], twists[:, 3:]))
    with np.errstate(divide="ignore"):  # without a turn, or without a way: no end by it
        return np.minimum(np.pi / turn, 2 * _reach(limits) / move)


def _reach(limits: Limits) -> float:
    """A rod's length at home, m."""
    readings = inverse_result(limits.layout, limits.theta, limits.home)[0]
    return typical_reach(limits.layout, limits.theta, readings)


def _twists(directions: Array) -> Array:
    """Directions (k, 3) or (k, 6) as twists (k, 6)."""
    if not directions.any(axis=-1).all():
        raise InputError(
            what="a direction of length zero leads nowhere",
            expected="directions [x, y, z], or twists of six numbers",
        )
    if directions.shape[-1] == 6:
        return directions
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.concatenate([np.zeros_like(unit), unit], axis=-1)


def _along(limits: Limits, start: Array, twists: Array, way: Array) -> tuple[Array, Reach]:
    """Poses (..., 4, 4) after ways (...,) along twists (..., 6), and what stands against them."""
    poses = perturb(start, twists * way[..., None])
    if limits.layout.row_motor.min(initial=0) < 0 or limits.layout.shares_motors:
        poses = _settled(limits, start, twists, way, poses)
    return poses, reachable(limits, poses)


def _settled(limits: Limits, start: Array, twists: Array, way: Array, poses: Array) -> Array:
    """Poses (..., 4, 4) put where rods and axes allow them, as far along the twists as they were.

    In turns to the nearest pose that is allowed, and on along the twist by what that took away.
    What is then still behind, keeps its own pose, which is forbidden.
    """
    size = np.sum(twists * twists, axis=-1)
    settled = on_manifold(limits.layout, limits.theta, poses).T_base_platform
    for _ in range(ROUNDS):
        behind = way - np.sum(pose_difference(settled, start) * twists, axis=-1) / size
        if np.all(np.abs(behind) <= (1 - KEPT) * 1e-2 * way):
            break
        ahead = perturb(settled, twists * behind[..., None])
        settled = on_manifold(limits.layout, limits.theta, ahead).T_base_platform
    behind = way - np.sum(pose_difference(settled, start) * twists, axis=-1) / size
    kept = np.abs(behind) <= (1 - KEPT) * way
    return np.where(kept[..., None, None], settled, poses)


def grid(limits: Limits, middle: Array, directions: Array, count: int) -> Grid:
    """Positions about ``middle`` (4, 4), at its orientation.

    directions : (2, 3) or (3, 3) square to each other, base frame, for a section or a volume. The
    grid spans what straight ways along them and between them reach, and a tenth more, ``count``
    points along the longest side.
    Raises InputError where ``middle`` itself is outside, and where the machine cannot move along
    one of the directions without turning.
    """
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    signs = np.array([s for s in itertools.product((-1, 0, 1), repeat=len(unit)) if any(s)])
    far = extents(limits, signs @ unit, middle).poses[:, :3, 3] - middle[:3, 3]
    low, high = 1.1 * (far @ unit.T).min(axis=0), 1.1 * (far @ unit.T).max(axis=0)
    _refuse_flat(limits, unit, high - low)
    cell = float((high - low).max()) / count
    # the middle pose is one of the points
    axes = tuple(
        cell * np.arange(np.floor(a / cell), np.ceil(b / cell) + 1)
        for a, b in zip(low, high, strict=True)
    )
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    positions = middle[:3, 3] + points.reshape(-1, len(unit)) @ unit
    inside, singular = _at_positions(limits, middle, positions)
    shape = points.shape[:-1]
    start = tuple(int(np.argmin(np.abs(axis))) for axis in axes)
    connected = _connected(inside.reshape(shape), start)
    size = float(np.count_nonzero(connected)) * cell ** len(unit)
    return Grid(axes, connected, singular.reshape(shape), size)


def _refuse_flat(limits: Limits, unit: Array, sides: Array) -> None:
    """A grid needs some way along each of its directions."""
    flat = np.flatnonzero(sides < 1e-4 * _reach(limits))
    if flat.size:
        raise InputError(
            what="the workspace has no extent along one of the directions at this orientation",
            found="direction [" + ", ".join(f"{x:.3g}" for x in unit[flat[0]]) + "]",
            expected="directions in which the machine can move without turning",
            next_step="ask for the extents along its own freedoms instead",
        )


def _at_positions(limits: Limits, middle: Array, positions: Array) -> tuple[Booleans, Array]:
    """Whether positions (n, 3) belong to the workspace, and their singularity, (n,) each."""
    inside, singular = np.zeros(len(positions), dtype=bool), np.zeros(len(positions))
    for first in range(0, len(positions), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        found = reachable(limits, pose(middle[:3, :3], positions[rows]))
        inside[rows], singular[rows] = found.inside, found.singularity
    return inside, singular


def _connected(inside: Booleans, start: tuple[int, ...]) -> Booleans:
    """The part of a grid that hangs together with one of its points."""
    from scipy.ndimage import label

    parts: Integers = np.zeros(inside.shape, dtype=np.int32)
    label(inside, output=parts)
    return np.asarray((parts == parts[start]) & inside)
