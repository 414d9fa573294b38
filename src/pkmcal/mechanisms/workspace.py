"""Which poses a machine can take, and why not the others; how far it reaches; along which paths.

A pose belongs to the workspace where every limb reaches, every reading is in its range, the
constant rods, the joints' axes and the file's motion allow it, no singular pose is near, and the
determinant has home's sign (:mod:`pkmcal.mechanisms.velocities`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose, pose_difference
from pkmcal.mechanisms.kinematics import (
    MAX_STEPS,
    NEAR_SINGULAR,
    closure_at,
    on_manifold,
    readings_at_poses,
    scaled_rows,
    singularity_of,
    typical_reach,
    undriven,
)
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.velocities import sign_of

ALLOWED_CONSTRAINT_ERROR = 1e-6
"""What the constant rods and axes must close to, m, and the motion, m and rad: more than rounding
of a pose in a file, less than any drive's step."""


@dataclass(frozen=True)
class Limits:
    """A machine with its limits: theta (P,), ranges (m, 2) of the readings, NaN where there is
    none, their units, and home (4, 4), whose assembly is meant.
    """

    layout: LimbLayout
    theta: Array
    ranges: Array
    units: tuple[str, ...]
    home: Array

    __repr__ = short_repr

    @cached_property
    def at_home(self) -> tuple[float, float]:
        """Home's sign and the singularity that counts as near: a machine that is weak at home is
        not refused everywhere for it.
        """
        scaled = scaled_rows(closure_at(self.layout, self.theta, self.home))
        least = 0.5 * float(singularity_of(self.layout, scaled))
        return float(sign_of(scaled)), min(NEAR_SINGULAR, least)


@dataclass(frozen=True)
class Reach:
    """What stands against each of the poses (...,); see :meth:`why`.

    readings : (..., m), NaN where the motor's limb cannot reach: ``lost`` (..., m).
    too_short, too_long : (..., m) readings below and above their range.
    off : (...) how far what no motor moves is from closing, m; ``forbidden`` (...) where that is
        more than a micrometre, or the pose leaves the file's motion.
    singularity : (...) the measure of forward kinematics; ``singular`` (...) where it is too small.
    crossed : (...) the determinant has not home's sign: a singular pose lies between.
    """

    readings: Array
    lost: Booleans
    too_short: Booleans
    too_long: Booleans
    off: Array
    forbidden: Booleans
    singularity: Array
    singular: Booleans
    crossed: Booleans
    limits: Limits

    __repr__ = short_repr

    @property
    def inside(self) -> Booleans:
        """(...) whether the machine can take the pose, as far as these conditions tell."""
        motors = (self.lost | self.too_short | self.too_long).any(axis=-1)
        return ~(motors | self.forbidden | self.singular | self.crossed)

    def why(self, *pose: int) -> tuple[str, ...]:
        """In words what stands against one pose, by its place in the batch; () for none."""
        words = [text for j, u in enumerate(self.limits.units) for text in self._motor(pose, j, u)]
        if self.forbidden[pose]:
            words.append(self._forbidden(pose))
        if self.singular[pose]:
            words.append(
                f"the pose is singular or nearly so: {float(self.singularity[pose]):.2g}, where at"
                f" least {self.limits.at_home[1]:.2g} is wanted"
            )
        if self.crossed[pose]:
            words.append("the pose lies beyond a singular one, in another assembly than home")
        return tuple(words)

    def _motor(self, pose: tuple[int, ...], motor: int, unit: str) -> list[str]:
        at, (low, high) = (*pose, motor), self.limits.ranges[motor]
        if self.lost[at]:
            return [f"the limb of motor {motor + 1} cannot reach"]
        if not (self.too_short[at] or self.too_long[at]):
            return []
        reading, short = float(self.readings[at]), bool(self.too_short[at])
        end = float(low if short else high)
        if abs(reading - end) < ALLOWED_CONSTRAINT_ERROR:
            return [f"motor {motor + 1} is at the end of its range, {end:.4g} {unit}"]
        where = f"below its range, which begins at {end:.4g} {unit}"
        if not short:
            where = f"above its range, which ends at {end:.4g} {unit}"
        return [f"motor {motor + 1} would stand at {reading:.4g} {unit}, {where}"]

    def _forbidden(self, pose: tuple[int, ...]) -> str:
        off = float(self.off[pose])
        if off > ALLOWED_CONSTRAINT_ERROR:
            return (
                "the rods of constant length and the joints' axes do not allow the pose, by"
                f" {off * 1e3:.3g} mm"
            )
        return "the machine cannot turn or move in this way"


def reachable(limits: Limits, poses: Array) -> Reach:
    """What stands against poses T_base_platform (..., 4, 4)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a platform's joint on a base joint
        c = closure_at(limits.layout, limits.theta, poses)
        remainder = undriven(c)[0]
    readings, scaled = c.readings, scaled_rows(c)
    singularity = singularity_of(limits.layout, scaled)
    lost = np.isnan(readings)
    off = np.where(lost.any(axis=-1), 0.0, np.abs(remainder).max(axis=-1, initial=0.0))
    sign, least = limits.at_home
    own = sign_of(scaled)
    return Reach(
        readings=readings,
        lost=lost,
        too_short=readings < limits.ranges[:, 0],
        too_long=readings > limits.ranges[:, 1],
        off=off,
        forbidden=(off > ALLOWED_CONSTRAINT_ERROR) | _elsewhere(limits, poses),
        singularity=singularity,
        singular=~lost.any(axis=-1) & ~(singularity >= least),
        crossed=own * sign < 0,
        limits=limits,
    )


def _elsewhere(limits: Limits, poses: Array) -> Booleans:
    """Whether poses (..., 4, 4) leave the motion that the file names."""
    held = ~limits.layout.free
    if not held.any():
        return np.zeros(poses.shape[:-2], dtype=bool)
    shifted = np.abs(pose_difference(poses, limits.home)[..., held])
    return np.asarray(shifted.max(axis=-1) > ALLOWED_CONSTRAINT_ERROR)


@dataclass(frozen=True)
class Effort:
    """How finely the ends of ways are looked for. steps : poses along a way before the bisection;
    what is narrower is not seen. halvings : of the bisection. newton : steps that bring a pose
    where rods and axes allow it. rounds : how often it is then moved on, as far as it was.
    """

    steps: int = 100
    halvings: int = 30
    newton: int = MAX_STEPS
    rounds: int = 4


FINE_EFFORT = Effort()
ROUGH_EFFORT = Effort(steps=40, halvings=14, newton=6, rounds=1)
"""For a box about the workspace."""
PATH_POSES_AHEAD = 8
"""Poses of each way at a time."""
PATH_DISTANCE_SHARE = 0.99
"""Share of the way asked for that must be left when constant rods and axes had their say."""
GRID_POSES_AT_ONCE = 20_000
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


def extents(
    limits: Limits,
    directions: Array,
    start: Array,
    most: float | None = None,
    effort: Effort = FINE_EFFORT,
) -> Extents:
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
    direction = farthest[:, None] * np.linspace(0, 1, effort.steps + 1)
    still = np.zeros(direction.shape, dtype=bool)
    ahead: Integers = np.arange(len(direction))
    for first in range(
        0, effort.steps + 1, PATH_POSES_AHEAD
    ):  # what comes after the end is not looked at
        at = slice(first, first + PATH_POSES_AHEAD)
        inside = _along(limits, start, twists[ahead, None], direction[ahead, at], effort)[1].inside
        still[ahead, at] = np.logical_and.accumulate(inside, axis=1)
        ahead = ahead[inside.all(axis=1)]
        if not ahead.size:
            break
    last = still.sum(axis=1) - 1
    rows = np.arange(len(twists))
    low, high = direction[rows, last], direction[rows, np.minimum(last + 1, effort.steps)]
    for _ in range(effort.halvings):
        middle = (low + high) / 2
        good = _along(limits, start, twists, middle, effort)[1].inside
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    poses = _along(limits, start, twists, low, effort)[0]
    beyond = _along(limits, start, twists, high, effort)[1]
    why = tuple(() if last[k] == effort.steps else beyond.why(k) for k in range(len(twists)))
    return Extents(low, poses, why)


def _farthest(limits: Limits, twists: Array) -> Array:
    """Where the search along twists (k, 6) ends, (k,)."""
    turn, move = (np.linalg.norm(part, axis=-1) for part in (twists[:, :3], twists[:, 3:]))
    with np.errstate(divide="ignore"):  # without a turn, or without a way: no end by it
        return np.minimum(np.pi / turn, 2 * _reach(limits) / move)


def _reach(limits: Limits) -> float:
    """A rod's length at home, m."""
    readings = readings_at_poses(limits.layout, limits.theta, limits.home)
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


def _along(
    limits: Limits, start: Array, twists: Array, direction: Array, effort: Effort
) -> tuple[Array, Reach]:
    """Poses (..., 4, 4) after ways (...,) along twists (..., 6), and what stands against them."""
    poses = perturb(start, twists * direction[..., None])
    if limits.layout.row_motor.min(initial=0) < 0 or limits.layout.shares_motors:
        poses = _settled(limits, start, twists, direction, poses, effort)
    return poses, reachable(limits, poses)


def _settled(
    limits: Limits, start: Array, twists: Array, direction: Array, poses: Array, effort: Effort
) -> Array:
    """Poses (..., 4, 4) put where rods and axes allow them, as far along the twists as they were.

    In turns to the nearest pose that is allowed, and on along the twist by what that took away.
    What is then still behind, keeps its own pose, which is forbidden.
    """
    size = np.sum(twists * twists, axis=-1)
    settled = on_manifold(limits.layout, limits.theta, poses, effort.newton).T_base_platform
    for _ in range(effort.rounds):
        behind = direction - np.sum(pose_difference(settled, start) * twists, axis=-1) / size
        if np.all(np.abs(behind) <= (1 - PATH_DISTANCE_SHARE) * 1e-2 * direction):
            break
        ahead = perturb(settled, twists * behind[..., None])
        settled = on_manifold(limits.layout, limits.theta, ahead, effort.newton).T_base_platform
    behind = direction - np.sum(pose_difference(settled, start) * twists, axis=-1) / size
    retained_rows = np.abs(behind) <= (1 - PATH_DISTANCE_SHARE) * direction
    return np.where(retained_rows[..., None, None], settled, poses)


def workspace_grid(limits: Limits, middle: Array, directions: Array, count: int) -> Grid:
    """Positions about ``middle`` (4, 4), at its orientation.

    directions : (2, 3) or (3, 3) square to each other, base frame, for a section or a volume. The
    grid spans what straight ways along them and between them reach, and a tenth more, ``count``
    points along the longest side.
    Raises InputError where ``middle`` itself is outside, and where the machine cannot move along
    one of the directions without turning.
    """
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    low, high = straight_path_spans(limits, middle, unit)
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


def straight_path_spans(
    limits: Limits, middle: Array, unit: Array, effort: Effort = FINE_EFFORT
) -> tuple[Array, Array]:
    """How far down and up (k,) along unit vectors (k, 3) straight ways from ``middle`` (4, 4) come,
    along them and between them, and a tenth more, m.
    """
    signs = np.array([s for s in itertools.product((-1, 0, 1), repeat=len(unit)) if any(s)])
    ways = extents(limits, signs @ unit, middle, effort=effort)
    far = (ways.poses[:, :3, 3] - middle[:3, 3]) @ unit.T
    return 1.1 * far.min(axis=0), 1.1 * far.max(axis=0)


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
    for first in range(0, len(positions), GRID_POSES_AT_ONCE):
        rows = slice(first, first + GRID_POSES_AT_ONCE)
        reach = reachable(limits, pose(middle[:3, :3], positions[rows]))
        inside[rows], singular[rows] = reach.inside, reach.singularity
    return inside, singular


def _connected(inside: Booleans, start: tuple[int, ...]) -> Booleans:
    """The part of a grid that hangs together with one of its points."""
    from scipy.ndimage import label

    parts: Integers = np.zeros(inside.shape, dtype=np.int32)
    label(inside, output=parts)
    return np.asarray((parts == parts[start]) & inside)


LOOKS_A_PATH_STEP = 8
"""Poses looked at from one of the path's to the next."""


@dataclass(frozen=True)
class PathCheck:
    """What was found along a path of n poses; places count in poses, 2.5 is half way from the third
    to the fourth.

    inside : (n,) of the path's own poses. leaves : the first place where the path is outside the
        workspace, None where it stays. why : what stands against it there.
    crossings : places where the determinant changes its sign: a singular pose.
    closest : (place, singularity) nearest to a singular pose, of the poses looked at.
    readings : (n, m) along the path.
    """

    inside: Booleans
    leaves: float | None
    why: tuple[str, ...]
    crossings: tuple[float, ...]
    closest: tuple[float, float]
    readings: Array

    @property
    def usable(self) -> bool:
        """Whether a machine can follow the path."""
        return self.leaves is None and not self.crossings

    def __str__(self) -> str:
        place, least = self.closest
        if self.crossings:
            where = ", ".join(f"{x:.3f}" for x in self.crossings)
            return f"the path crosses a singular pose at {where} (poses count from 0)"
        if self.leaves is not None:
            reason = "; ".join(self.why)
            return (
                f"the path leaves the workspace at {self.leaves:.3f} (poses count from 0): {reason}"
            )
        return (
            f"the path stays in the workspace, and comes to {least:.2g} of a singular pose (1 is"
            f" far) at {place:.3f}"
        )


def check_path(limits: Limits, poses: Array) -> PathCheck:
    """Look along a path T_base_platform (n, 4, 4), n >= 2, straight from each pose to the next.

    A singular pose that is crossed twice within one of the steps looked at, or a corner left so, is
    not seen.
    Raises InputError for a path that is none.
    """
    if poses.ndim != 3 or len(poses) < 2:
        raise InputError(
            what="a path needs two poses or more",
            found=f"an array of shape {poses.shape}",
            expected="(n, 4, 4)",
        )
    places = np.linspace(0, len(poses) - 1, (len(poses) - 1) * LOOKS_A_PATH_STEP + 1)
    reach = reachable(limits, _at(poses, places))
    leaves, why = _leaving(limits, poses, places, reach)
    nearest = np.where(np.isfinite(reach.singularity), reach.singularity, np.inf)
    k = int(np.argmin(nearest))
    own = slice(None, None, LOOKS_A_PATH_STEP)
    return PathCheck(
        inside=reach.inside[own],
        leaves=leaves,
        why=why,
        crossings=_crossings(limits, poses, places, reach),
        closest=(float(places[k]), float(nearest[k])),
        readings=reach.readings[own],
    )


def _at(poses: Array, places: Array) -> Array:
    """Poses at places along the path."""
    first = np.minimum(places.astype(int), len(poses) - 2)
    step = pose_difference(poses[1:], poses[:-1])[first]
    return perturb(poses[first], (places - first)[:, None] * step)


def _leaving(
    limits: Limits, poses: Array, places: Array, reach: Reach
) -> tuple[float | None, tuple[str, ...]]:
    """The first place outside and the reason there."""
    outside = np.flatnonzero(~reach.inside)
    if not outside.size:
        return None, ()
    if outside[0] == 0:
        return 0.0, reach.why(0)
    low, high = places[outside[0] - 1], places[outside[0]]
    for _ in range(FINE_EFFORT.halvings):
        middle = (low + high) / 2
        good = bool(reachable(limits, _at(poses, np.array([middle]))).inside[0])
        low, high = (middle, high) if good else (low, middle)
    return float(high), reachable(limits, _at(poses, np.array([high]))).why(0)


def _crossings(limits: Limits, poses: Array, places: Array, reach: Reach) -> tuple[float, ...]:
    """Places where the determinant changes its sign between two poses in reach."""
    reached = np.asarray(~reach.lost.any(axis=-1))
    changes = np.diff(reach.crossed.astype(int)) != 0
    at = np.flatnonzero(changes & reached[1:] & reached[:-1])
    low, high = places[at], places[at + 1]
    for _ in range(FINE_EFFORT.halvings if at.size else 0):
        middle = (low + high) / 2
        same = reachable(limits, _at(poses, middle)).crossed == reach.crossed[at]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return tuple(float(x) for x in high)
