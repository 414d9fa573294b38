"""Region of interest in a workspace, and poses spread evenly over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.levels import NEGLIGIBLE
from pkmcal.mechanisms.kinematics import on_manifold
from pkmcal.mechanisms.workspace import (
    ALLOWED_CONSTRAINT_ERROR,
    ROUGH_EFFORT,
    Limits,
    extents,
    reachable,
    straight_path_spans,
)

RegionSide = tuple[float, float]
REGION_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class RegionSamplingOptions:
    """Constants of the sampling of a region."""

    # most candidate poses for each pose wanted; if the machine can take a smaller share, fewer
    # poses are returned
    candidates_a_pose: int = 200
    # fewest candidate poses before a region counts as out of reach
    fewest_candidates: int = 5000
    # most candidate poses in one batch
    batch: int = 4096


_SAMPLING = RegionSamplingOptions()


@dataclass(frozen=True)
class Region:
    """Box of positions of the platform's origin, with a largest rotation.

    x, y, z : lowest and highest coordinate in the base frame, m; None for the machine's full reach.
    turn : largest rotation from home's orientation about any axis of the motion, rad. None for no
        rotation; but if constant rods or axes do not allow all translations without rotation (a
        3-RPS), for the machine's full reach.
    Raises InputError for invalid intervals or rotations.
    """

    x: RegionSide | None = None
    y: RegionSide | None = None
    z: RegionSide | None = None
    turn: float | None = None

    def __post_init__(self) -> None:
        for name, side in zip(REGION_AXES, self.sides, strict=True):
            if side is not None and not (np.isfinite(side).all() and side[0] <= side[1]):
                raise InputError(
                    what=f"the workspace's {name} is no interval",
                    found=f"[{side[0]:g}, {side[1]:g}]",
                    expected="[lowest, highest] in metres",
                )
        if self.turn is not None and not 0 <= self.turn <= np.pi:
            raise InputError(
                what="the workspace's turn is no angle that a platform turns to either side by",
                found=f"{self.turn:g}",
                expected="radians from 0 to 3.14; 15 degrees are 0.262",
            )

    @property
    def sides(self) -> tuple[RegionSide | None, RegionSide | None, RegionSide | None]:
        """Intervals of x, y and z."""
        return self.x, self.y, self.z

    def holds(self, limits: Limits, poses: Array) -> Booleans:
        """Whether poses (..., 4, 4) are in the region, to a micrometre and a microradian, reachable
        or not.
        """
        out = np.ones(poses.shape[:-2], dtype=bool)
        for k, side in enumerate(self.sides):
            if side is not None:
                place = poses[..., k, 3]
                out &= (place >= side[0] - ALLOWED_CONSTRAINT_ERROR) & (
                    place <= side[1] + ALLOWED_CONSTRAINT_ERROR
                )
        if self.turn is not None:
            turned = np.linalg.norm(pose_difference(poses, limits.home)[..., :3], axis=-1)
            out &= turned <= self.turn + ALLOWED_CONSTRAINT_ERROR
        return out

    def __str__(self) -> str:
        boxed = [
            f"{name} {side[0] * 1e3:.4g}"
            + (f" to {side[1] * 1e3:.4g} mm" if side[1] > side[0] else " mm")
            for name, side in zip(REGION_AXES, self.sides, strict=True)
            if side is not None
        ]
        turned = [f"turned by up to {np.rad2deg(self.turn):.3g}°"] if self.turn else []
        return ", ".join([*(boxed or ["the whole reach"]), *turned])


@dataclass(frozen=True)
class Within:
    """Part of a region near which the machine can move from home.

    low, high : (3,) corners of a box, m.
    turn : largest rotation, rad.
    """

    low: Array
    high: Array
    turn: float


def within_reach(limits: Limits, region: Region) -> Within:
    """Box and rotation in which poses of the region are searched.

    The region's intervals, intersected with the reach of straight paths from home without rotation.
    Raises InputError if the region is beyond this reach, or if the machine cannot take the home
    pose.
    """
    free = np.eye(3)[limits.layout.free[3:]]
    low = high = limits.home[:3, 3]
    moves = 0
    if len(free):
        near, far = straight_path_spans(limits, limits.home, free, ROUGH_EFFORT)
        low, high = low + near @ free, high + far @ free
        # misaligned axes allow small movements in other directions
        moves = int(np.count_nonzero(far - near > NEGLIGIBLE * (far - near).max()))
    for k, (name, side) in enumerate(zip(REGION_AXES, region.sides, strict=True)):
        if side is not None and (
            side[1] < low[k] - ALLOWED_CONSTRAINT_ERROR
            or side[0] > high[k] + ALLOWED_CONSTRAINT_ERROR
        ):
            raise InputError(
                what="the machine does not come to the workspace that was asked for",
                found=f"{name} from {side[0]:g} to {side[1]:g} m",
                expected=f"a part of {low[k]:.3g} to {high[k]:.3g} m, where its platform's origin"
                " comes from home without turning",
            )
        if side is not None:
            low[k], high[k] = np.clip((low[k], high[k]), *side)
    if region.turn is not None:
        return Within(low, high, region.turn)
    if moves == len(free):
        return Within(low, high, 0.0)
    # Translation needs rotation: as far as the platform rotates at home about any axis.
    axes = np.eye(6)[:3][limits.layout.free[:3]]
    turns = extents(limits, np.concatenate([axes, -axes]), limits.home).distance
    return Within(low, high, float(turns.max()))


def poses_in(limits: Limits, region: Region, count: int, seed: int = 0) -> Array:
    """Poses T_base_platform (n, 4, 4), spread evenly over the reachable part of a region.

    n is ``count``, or less if the machine can take less than one in two hundred of the candidates.
    For machines whose rods and axes constrain some freedoms, candidates are projected to the
    nearest admissible poses.

    seed : shifts the sequence of candidates; equal seeds give equal poses.
    Raises InputError if the machine can take none of the candidates.
    """
    within = within_reach(limits, region)
    batches: list[Array] = []
    accepted = tried = 0
    most = max(_SAMPLING.candidates_a_pose * count, _SAMPLING.fewest_candidates)
    while accepted < count and tried < most:
        more = min(max(count, tried), _SAMPLING.batch)
        poses = _candidate_poses(limits, within, np.arange(tried, tried + more), seed)
        closed = on_manifold(limits.layout, limits.theta, poses, ROUGH_EFFORT.newton)
        poses = closed.T_base_platform[closed.converged]
        poses = poses[region.holds(limits, poses)]
        poses = poses[reachable(limits, poses).inside]
        batches.append(poses)
        accepted, tried = accepted + len(poses), tried + more
    if not accepted:
        home = ", ".join(f"{x:.0f}" for x in np.round(1e3 * limits.home[:3, 3]) + 0.0)
        raise InputError(
            what="the machine can take no pose of the workspace that was asked for",
            found=f"{region}; {tried} poses tried",
            expected=f"a part of the machine's own, which is about home, [{home}] mm",
            next_step="widen the workspace, or check the ranges in the mechanism file",
        )
    return np.concatenate(batches)[:count]


def _candidate_poses(limits: Limits, within: Within, numbers: Integers, seed: int) -> Array:
    """Members of a low-discrepancy sequence of poses in the box, (n, 4, 4), by their indices.

    Additive recurrence with powers of the generalised golden ratio, the root of phi^(d + 1) = phi +
    1 (Roberts 2018).
    """
    axes = np.flatnonzero(limits.layout.free[:3]) if within.turn else np.zeros(0, dtype=int)
    d = 3 + len(axes)
    golden = max(np.roots([1.0, *np.zeros(d - 1), -1.0, -1.0]).real)
    start = np.random.default_rng(seed).random(d)
    unit = (start + np.outer(numbers + 1, golden ** -np.arange(1.0, d + 1))) % 1
    delta = np.zeros((len(unit), 6))
    delta[:, 3:] = within.low + unit[:, :3] * (within.high - within.low) - limits.home[:3, 3]
    if len(axes) == 1:
        delta[:, axes[0]] = within.turn * (2 * unit[:, 3] - 1)
    elif len(axes):  # uniform in a ball of rotation vectors
        height, angle = 2 * unit[:, 3] - 1, 2 * np.pi * unit[:, 4]
        flat = np.sqrt(1 - height**2)
        direction = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=-1)
        delta[:, :3] = within.turn * np.cbrt(unit[:, 5:]) * direction
    return perturb(limits.home, delta)
