"""Workspace: reachable poses with the obstacles elsewhere, extents along directions, sections, and
paths.

A pose is in the workspace if every limb reaches it, every reading is in range, constant rods,
joints' axes and the file's motion allow it, no singular pose is near, and the determinant has
home's sign (:mod:`pkmcal.mechanisms.velocities`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose, pose_difference
from pkmcal.levels import NEGLIGIBLE
from pkmcal.mechanisms.kinematics import (
    KINEMATICS,
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
"""Largest violation of constant rods and axes, m, and of the motion, m and rad: above the rounding
of a pose in a file, below any drive's step."""


@dataclass(frozen=True)
class Limits:
    """Machine with the limits of its workspace.

    theta : (P,).
    ranges : (m, 2) of the readings, NaN if unlimited.
    units : of the readings.
    home : (4, 4), whose assembly mode is used.
    """

    layout: LimbLayout
    theta: Array
    ranges: Array
    units: tuple[str, ...]
    home: Array

    __repr__ = short_repr

    @cached_property
    def at_home(self) -> tuple[float, float]:
        """Sign of the determinant at home, and the singularity measure below which a pose is
        singular. The latter is at most half of home's, so a machine that is weak at home is not
        refused everywhere.
        """
        scaled = scaled_rows(closure_at(self.layout, self.theta, self.home))
        least = 0.5 * float(singularity_of(scaled))
        return float(sign_of(scaled)), min(NEAR_SINGULAR, least)


@dataclass(frozen=True)
class Reach:
    """Obstacles to poses (...,); in words by :meth:`why`.

    readings : (..., m), NaN if the motor's limb cannot reach.
    lost : (..., m) whether the motor's limb cannot reach.
    too_short, too_long : (..., m) whether the reading is below or above its range.
    off : (...) closure error of the rows that no motor moves, m.
    forbidden : (...) whether ``off`` is more than a micrometre, or the pose is outside the file's
        motion.
    singularity : (...) as in forward kinematics.
    singular : (...) whether it is too small.
    crossed : (...) whether the determinant's sign differs from home's: a singular pose is between.
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
        """Whether the machine can take each pose (...), by these conditions."""
        motors = (self.lost | self.too_short | self.too_long).any(axis=-1)
        return ~(motors | self.forbidden | self.singular | self.crossed)

    def why(self, *pose: int) -> tuple[str, ...]:
        """Obstacles to one pose, by its index in the batch, as text; empty for none."""
        words = [
            text
            for j, u in enumerate(self.limits.units)
            for text in self._motor_obstacles(pose, j, u)
        ]
        if self.forbidden[pose]:
            words.append(self._constraint_obstacle(pose))
        if self.singular[pose]:
            words.append(
                f"the pose is singular or nearly so: {float(self.singularity[pose]):.2g}, where at"
                f" least {self.limits.at_home[1]:.2g} is wanted"
            )
        if self.crossed[pose]:
            words.append("the pose lies beyond a singular one, in another assembly than home")
        return tuple(words)

    def _motor_obstacles(self, pose: tuple[int, ...], motor: int, unit: str) -> list[str]:
        """Obstacle at one motor as text, in a list of at most one."""
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

    def _constraint_obstacle(self, pose: tuple[int, ...]) -> str:
        """Obstacle by constraints as text."""
        off = float(self.off[pose])
        if off > ALLOWED_CONSTRAINT_ERROR:
            return (
                "the rods of constant length and the joints' axes do not allow the pose, by"
                f" {off * 1e3:.3g} mm"
            )
        return "the machine cannot turn or move in this way"


def reachable(limits: Limits, poses: Array) -> Reach:
    """Check poses T_base_platform (..., 4, 4) against the limits."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a joint B on its A
        c = closure_at(limits.layout, limits.theta, poses)
        residual = undriven(c)[0]
    readings, scaled = c.readings, scaled_rows(c)
    singularity = singularity_of(scaled)
    lost = np.isnan(readings)
    off = np.where(lost.any(axis=-1), 0.0, np.abs(residual).max(axis=-1, initial=0.0))
    sign, least = limits.at_home
    own = sign_of(scaled)
    return Reach(
        readings=readings,
        lost=lost,
        too_short=readings < limits.ranges[:, 0],
        too_long=readings > limits.ranges[:, 1],
        off=off,
        forbidden=(off > ALLOWED_CONSTRAINT_ERROR) | _outside_motion(limits, poses),
        singularity=singularity,
        singular=~lost.any(axis=-1) & ~(singularity >= least),
        crossed=own * sign < 0,
        limits=limits,
    )


def _outside_motion(limits: Limits, poses: Array) -> Booleans:
    """Whether poses (..., 4, 4) are outside the motion that the file states."""
    held = ~limits.layout.free
    if not held.any():
        return np.zeros(poses.shape[:-2], dtype=bool)
    deviation = np.abs(pose_difference(poses, limits.home)[..., held])
    return np.asarray(deviation.max(axis=-1) > ALLOWED_CONSTRAINT_ERROR)


@dataclass(frozen=True)
class Effort:
    """Resolution of the searches in a workspace, and sizes of their batches."""

    # poses along a path before the bisection; narrower gaps are missed
    steps: int = 100
    # subdivisions of each step of a given path that are checked
    subdivisions: int = 8
    # steps of the bisection
    halvings: int = 30
    # steps of the projection onto admissible poses
    newton: int = KINEMATICS.most_steps
    # corrections along the direction for the distance that the projection took away
    rounds: int = 4
    # poses of each path in one batch
    ahead: int = 8
    # poses of a grid in one batch
    batch: int = 20_000


FINE_EFFORT = Effort()
"""Default resolution."""
ROUGH_EFFORT = Effort(steps=40, halvings=14, newton=6, rounds=1)
"""Resolution for a bounding box of the workspace."""


@dataclass(frozen=True)
class Extents:
    """Extents of the workspace along k directions.

    distance : (k,) in units of the direction; m for three numbers, which are normalised.
    poses : (k, 4, 4) last reachable pose.
    why : obstacles to the next pose, for each direction; empty if the search reached its end.
    """

    distance: Array
    poses: Array
    why: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Grid:
    """Workspace on a grid of positions with one orientation.

    axes : coordinates along each direction, m from the middle pose, (a,) (b,) and, for a volume,
        (c,).
    inside : (a, b[, c]) reachable poses that are connected to the middle pose through neighbours.
    singularity : (a, b[, c]), NaN out of reach.
    size : area (m^2) or volume (m^3) inside, by counting cells.
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
    """Distances from ``start`` (4, 4) along straight paths to the first obstacle: a range, a limb's
    reach, a singular pose.

    directions : (k, 3) along the base's axes, or (k, 6) twists (omega, tau), whose multiples are
        the distances: a twist of 1 rad about an axis gives rad.
    most : end of the search, in the same units; by default half a turn or twice a rod's length,
        whichever comes first.

    On machines whose rods and axes constrain some freedoms, paths follow the admissible poses next
    to the straight line.
    Raises InputError if ``start`` is outside the workspace, and for a direction of length zero.
    """
    at_start = reachable(limits, start)
    if not at_start.inside:
        raise InputError(
            what="the search for the workspace begins at a pose that the machine cannot take",
            found="; ".join(at_start.why()),
            next_step="begin at the home pose, or check the ranges in the mechanism file",
            code="pose.outside_workspace",
        )
    twists = _twists(directions)
    if most is not None:
        farthest = np.full(len(twists), most)
    else:
        # Half a turn, or twice a rod's length.
        turn, move = (np.linalg.norm(part, axis=-1) for part in (twists[:, :3], twists[:, 3:]))
        with np.errstate(divide="ignore"):  # without rotation, or translation
            farthest = np.minimum(np.pi / turn, 2 * _reach(limits) / move)
    # Bracket the first obstacle of each path, in batches that stop with the path.
    distances = farthest[:, None] * np.linspace(0, 1, effort.steps + 1)
    inside_so_far = np.zeros(distances.shape, dtype=bool)
    ahead: Integers = np.arange(len(distances))
    for first in range(0, effort.steps + 1, effort.ahead):
        at = slice(first, first + effort.ahead)
        inside = _reach_along(limits, start, twists[ahead, None], distances[ahead, at], effort)[
            1
        ].inside
        inside_so_far[ahead, at] = np.logical_and.accumulate(inside, axis=1)
        ahead = ahead[inside.all(axis=1)]
        if not ahead.size:
            break
    # Bisect between the last reachable pose and the next.
    last = inside_so_far.sum(axis=1) - 1
    rows = np.arange(len(twists))
    low, high = distances[rows, last], distances[rows, np.minimum(last + 1, effort.steps)]
    for _ in range(effort.halvings):
        middle = (low + high) / 2
        good = _reach_along(limits, start, twists, middle, effort)[1].inside
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    poses = _reach_along(limits, start, twists, low, effort)[0]
    beyond = _reach_along(limits, start, twists, high, effort)[1]
    why = tuple(() if last[k] == effort.steps else beyond.why(k) for k in range(len(twists)))
    return Extents(low, poses, why)


def _reach(limits: Limits) -> float:
    """Typical rod length at home, m."""
    readings = readings_at_poses(limits.layout, limits.theta, limits.home)
    return typical_reach(limits.layout, limits.theta, readings)


def _twists(directions: Array) -> Array:
    """Twists (k, 6) from directions (k, 3) or (k, 6)."""
    if not directions.any(axis=-1).all():
        raise InputError(
            what="a direction of length zero leads nowhere",
            expected="directions [x, y, z], or twists of six numbers",
        )
    if directions.shape[-1] == 6:
        return directions
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.concatenate([np.zeros_like(unit), unit], axis=-1)


def _reach_along(
    limits: Limits, start: Array, twists: Array, distances: Array, effort: Effort
) -> tuple[Array, Reach]:
    """Poses (..., 4, 4) at distances (...,) along twists (..., 6), and their obstacles."""
    poses = perturb(start, twists * distances[..., None])
    if limits.layout.row_motor.min(initial=0) < 0 or limits.layout.shares_motors:
        poses = _projected(limits, start, twists, distances, poses, effort)
    return poses, reachable(limits, poses)


def _projected(
    limits: Limits, start: Array, twists: Array, distances: Array, poses: Array, effort: Effort
) -> Array:
    """Poses (..., 4, 4) projected onto those that rods and axes allow, at their distance along the
    twists.

    Alternates the projection with a step along the twist by the distance that it took away. A pose
    that remains short of its distance is returned without projection, and is then forbidden.
    """
    size = np.sum(twists * twists, axis=-1)
    settled = on_manifold(limits.layout, limits.theta, poses, effort.newton).T_base_platform
    for _ in range(effort.rounds):
        behind = distances - np.sum(pose_difference(settled, start) * twists, axis=-1) / size
        if np.all(np.abs(behind) <= NEGLIGIBLE**2 * distances):
            break
        ahead = perturb(settled, twists * behind[..., None])
        settled = on_manifold(limits.layout, limits.theta, ahead, effort.newton).T_base_platform
    behind = distances - np.sum(pose_difference(settled, start) * twists, axis=-1) / size
    reached = np.abs(behind) <= NEGLIGIBLE * distances
    return np.where(reached[..., None, None], settled, poses)


def workspace_grid(limits: Limits, middle: Array, directions: Array, count: int) -> Grid:
    """Workspace around ``middle`` (4, 4), at its orientation.

    directions : (2, 3) or (3, 3) orthogonal, base frame, for a section or a volume.
    count : number of points along the longest side. The grid spans the reach of straight paths
        along and between the directions, and a tenth more.
    Raises InputError if ``middle`` is outside the workspace, and if the machine cannot move along
    one of the directions without rotation.
    """
    from scipy.ndimage import label

    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    low, high = straight_path_spans(limits, middle, unit)
    _refuse_flat(limits, unit, high - low)
    cell = float((high - low).max()) / count
    # the middle pose is a grid point
    axes = tuple(
        cell * np.arange(np.floor(a / cell), np.ceil(b / cell) + 1)
        for a, b in zip(low, high, strict=True)
    )
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    positions = middle[:3, 3] + points.reshape(-1, len(unit)) @ unit
    inside, singular = _at_positions(limits, middle, positions)
    shape = points.shape[:-1]
    # Keep the component that contains the middle pose.
    parts: Integers = np.zeros(shape, dtype=np.int32)
    label(inside.reshape(shape), output=parts)
    start = tuple(int(np.argmin(np.abs(axis))) for axis in axes)
    connected = np.asarray((parts == parts[start]) & inside.reshape(shape))
    size = float(np.count_nonzero(connected)) * cell ** len(unit)
    return Grid(axes, connected, singular.reshape(shape), size)


def straight_path_spans(
    limits: Limits, middle: Array, unit: Array, effort: Effort = FINE_EFFORT
) -> tuple[Array, Array]:
    """Lowest and highest coordinate (k,) along unit vectors (k, 3) that straight paths from
    ``middle`` (4, 4) reach, along the vectors and between them, and a tenth more, m.
    """
    signs = np.array([s for s in itertools.product((-1, 0, 1), repeat=len(unit)) if any(s)])
    ways = extents(limits, signs @ unit, middle, effort=effort)
    far = (ways.poses[:, :3, 3] - middle[:3, 3]) @ unit.T
    return 1.1 * far.min(axis=0), 1.1 * far.max(axis=0)


def _refuse_flat(limits: Limits, unit: Array, sides: Array) -> None:
    """Raise InputError if the reach along a direction of the grid vanishes."""
    flat = np.flatnonzero(sides < 1e-4 * _reach(limits))
    if flat.size:
        raise InputError(
            what="the workspace has no extent along one of the directions at this orientation",
            found="direction [" + ", ".join(f"{x:.3g}" for x in unit[flat[0]]) + "]",
            expected="directions in which the machine can move without turning",
            next_step="ask for the extents along its own freedoms instead",
        )


def _at_positions(limits: Limits, middle: Array, positions: Array) -> tuple[Booleans, Array]:
    """Whether positions (n, 3) are in the workspace, and their singularity measure, (n,) each."""
    inside, singular = np.zeros(len(positions), dtype=bool), np.zeros(len(positions))
    for first in range(0, len(positions), FINE_EFFORT.batch):
        rows = slice(first, first + FINE_EFFORT.batch)
        reach = reachable(limits, pose(middle[:3, :3], positions[rows]))
        inside[rows], singular[rows] = reach.inside, reach.singularity
    return inside, singular


@dataclass(frozen=True)
class PathCheck:
    """Check of a path of n poses; places are fractional indices, 2.5 is half way from the third to
    the fourth pose.

    inside : (n,) whether the path's own poses are reachable.
    leaves : first place outside the workspace, None if there is none.
    why : obstacles at this place.
    crossings : places where the determinant changes its sign: a singular pose.
    closest : (place, singularity) of the checked pose nearest to a singular one.
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
    """Check a path T_base_platform (n, 4, 4), n >= 2, straight from each pose to the next.

    A singular pose that is crossed twice between two checked poses, or an excursion between them,
    is missed.
    Raises InputError for invalid paths.
    """
    if poses.ndim != 3 or len(poses) < 2:
        raise InputError(
            what="a path needs two poses or more",
            found=f"an array of shape {poses.shape}",
            expected="(n, 4, 4)",
        )
    places = np.linspace(0, len(poses) - 1, (len(poses) - 1) * FINE_EFFORT.subdivisions + 1)
    reach = reachable(limits, _path_poses(poses, places))
    leaves, why = _first_exit(limits, poses, places, reach)
    nearest = np.where(np.isfinite(reach.singularity), reach.singularity, np.inf)
    k = int(np.argmin(nearest))
    own = slice(None, None, FINE_EFFORT.subdivisions)
    return PathCheck(
        inside=reach.inside[own],
        leaves=leaves,
        why=why,
        crossings=_crossings(limits, poses, places, reach),
        closest=(float(places[k]), float(nearest[k])),
        readings=reach.readings[own],
    )


def _path_poses(poses: Array, places: Array) -> Array:
    """Poses at places along a path."""
    first = np.minimum(places.astype(int), len(poses) - 2)
    step = pose_difference(poses[1:], poses[:-1])[first]
    return perturb(poses[first], (places - first)[:, None] * step)


def _first_exit(
    limits: Limits, poses: Array, places: Array, reach: Reach
) -> tuple[float | None, tuple[str, ...]]:
    """First place outside the workspace, by bisection, and the obstacles there."""
    outside = np.flatnonzero(~reach.inside)
    if not outside.size:
        return None, ()
    if outside[0] == 0:
        return 0.0, reach.why(0)
    low, high = places[outside[0] - 1], places[outside[0]]
    for _ in range(FINE_EFFORT.halvings):
        middle = (low + high) / 2
        good = bool(reachable(limits, _path_poses(poses, np.array([middle]))).inside[0])
        low, high = (middle, high) if good else (low, middle)
    return float(high), reachable(limits, _path_poses(poses, np.array([high]))).why(0)


def _crossings(limits: Limits, poses: Array, places: Array, reach: Reach) -> tuple[float, ...]:
    """Places where the determinant changes its sign between two reachable poses, by bisection."""
    reached = np.asarray(~reach.lost.any(axis=-1))
    changes = np.diff(reach.crossed.astype(int)) != 0
    at = np.flatnonzero(changes & reached[1:] & reached[:-1])
    low, high = places[at], places[at + 1]
    for _ in range(FINE_EFFORT.halvings if at.size else 0):
        middle = (low + high) / 2
        same = reachable(limits, _path_poses(poses, middle)).crossed == reach.crossed[at]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return tuple(float(x) for x in high)
