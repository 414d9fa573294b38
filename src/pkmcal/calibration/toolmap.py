"""Uncertainty of the platform's poses over the workspace: after calibration, and by the prior
sigmas of the nominal model, with the errors of the nominal model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.geometry.rigid import pose, pose_difference
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.tool import ToolAccuracy, tool_error
from pkmcal.levels import NEGLIGIBLE, TRANSLATION_TURN
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import on_manifold
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.mechanisms.workspace import ROUGH_EFFORT, Limits, reachable

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration


@dataclass(frozen=True)
class ToolMapOptions:
    """Constants of a map of the tool's errors."""

    # poses spread over the region, from which figures are computed
    poses: int = 250
    # cells along the longer side of a slice
    cells: int = 20
    # heights of the slices, as shares of the range of those poses
    heights: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)
    # extension of the slices beyond those poses to either side, as a share of their range
    margin: float = 0.08
    # fewest rows and columns of cells, and smallest share of reachable cells among these, for a
    # slice: a platform that can only shift as it rotates has one orientation in few places. They
    # decide what is drawn, not the figures. A triangle fills half of its rows and columns, a little
    # less where cells are cut
    least_cells: int = 3
    least_filled: float = 0.4
    # largest distance, in cells, by which rods and axes may put a pose off its cell's middle: two
    # neighbours are then drawn for poses at least half a cell apart
    most_off_middle: float = 0.25


_OPTIONS = ToolMapOptions()


@dataclass(frozen=True)
class Slice:
    """Grid of positions in a plane, at the home orientation.

    across, up : axes (0 to 2) of the base frame that span the slice.
    level : its coordinate along the third axis, m.
    u, v : (a,) and (b,) coordinates of the cells' middles, m.
    rows : (b, a) index of each cell's pose in the map, -1 where the machine cannot reach it.
    """

    across: int
    up: int
    level: float
    u: Array
    v: Array
    rows: Integers

    @property
    def normal(self) -> int:
        """Index of the third axis."""
        return 3 - self.across - self.up


@dataclass(frozen=True)
class ToolMap:
    """Uncertainty and error of the poses of a region.

    spread : the first so many poses are evenly distributed over the region, the others are in
        slices.
    after : uncertainty after the calibration, and error of the nominal model.
    before : uncertainty by the prior sigmas of the nominal model alone.
    """

    region: Region
    spread: int
    slices: tuple[Slice, ...]
    after: ToolAccuracy
    before: ToolAccuracy

    __repr__ = short_repr

    @cached_property
    def evenly(self) -> tuple[ToolAccuracy, ToolAccuracy]:
        """``before`` and ``after`` at the evenly distributed poses alone."""
        return self.before.first(self.spread), self.after.first(self.spread)

    def document(self) -> dict[str, Any]:
        """Figures of the evenly distributed poses for programs, m and rad."""
        before, after = self.evenly
        worst = int(np.nanargmax(after.position))
        return {
            "region": {
                **dict(zip("xyz", self.region.sides, strict=True)),
                "turn": self.region.turn,
            },
            "poses": self.spread,
            "sigma": _summary(after.position, after.orientation),
            "drawing_off": _summary(after.off_position, after.off_orientation),
            "sigma_of_drawing": _summary(before.position, before.orientation),
            "worst_at": after.T_base_platform[worst, :3, 3],
        }


def _summary(position: Array, orientation: Array) -> dict[str, Any]:
    """Medians and largest values, None where nothing is finite."""
    parts = {"position": position, "orientation": orientation}
    finite = {name: values[np.isfinite(values)] for name, values in parts.items()}
    return {
        name: {"median": float(np.median(values)), "worst": float(values.max())}
        if values.size
        else None
        for name, values in finite.items()
    }


def map_of(
    nominal: Machine,
    calibrated: Machine,
    covariance: Array,
    region: Region | None = None,
    *,
    legs_observed: bool = True,
) -> ToolMap:
    """Map of a region; of the whole workspace by default.

    Raises InputError if the machine can reach no pose of the region.

    covariance : (P, P) of the calibrated parameters, in any gauge.
    legs_observed : see :func:`~pkmcal.identify.tool.tool_error`; without legs the frames are those
        that fit the evenly distributed poses best.
    """
    region = region or Region()
    limits = calibrated.limits()
    even = poses_in(limits, region, _OPTIONS.poses)
    slices, more = _slices(limits, region, even)
    poses = np.concatenate([even, *more])
    table = calibrated.parameters
    root = table.free_matrix() * table.tolerances_free()
    after = tool_error(
        nominal,
        calibrated,
        free_of_gauge(calibrated, covariance),
        poses,
        legs_observed=legs_observed,
        fitted=np.arange(len(even)),
    )
    before = replace(after, parameters=free_of_gauge(calibrated, root @ root.T))
    return ToolMap(region, len(even), slices, after, before)


def of_calibration(calibration: Calibration) -> ToolMap:
    """Map over the session's workspace. Raises PkmcalError if the calibrated machine has none."""
    estimate, session = calibration.estimate, calibration.session
    in_view = estimate.edge_weights.size > 0
    return map_of(
        session.machine,
        estimate.machine,
        estimate.covariance,
        session.workspace,
        legs_observed=in_view,
    )


def _slices(limits: Limits, region: Region, even: Array) -> tuple[tuple[Slice, ...], list[Array]]:
    """Slices and their poses: horizontal ones and, where the machine has a height, a vertical one.

    The poses are in the order in which the slices' rows count them, after the evenly distributed
    ones.
    """
    places = even[:, :3, 3]
    low, high = places.min(axis=0), places.max(axis=0)
    wide = high - low
    box = low - _OPTIONS.margin * wide, high + _OPTIONS.margin * wide
    flat = wide <= NEGLIGIBLE * wide.max()
    middle = (low + high) / 2
    if flat[2]:
        # a planar machine has one horizontal slice
        planes = [(0, 1, float(middle[2]))]
    else:
        planes = [(0, 1, float(low[2] + share * wide[2])) for share in _OPTIONS.heights]
        across = int(np.argmax(wide[:2]))
        planes.append((across, 2, float(middle[1 - across])))
    out: list[Slice] = []
    poses: list[Array] = []
    first = len(even)
    for across, up, level in planes:
        if flat[across] or flat[up]:
            continue
        made, taken = _slice(limits, region, (across, up, level), box, first)
        there = made.rows >= 0
        rows, columns = there.any(axis=1).sum(), there.any(axis=0).sum()
        # keep slices that the machine fills sufficiently
        if (
            min(rows, columns) >= _OPTIONS.least_cells
            and len(taken) >= _OPTIONS.least_filled * rows * columns
        ):
            out.append(made)
            poses.append(taken)
            first += len(taken)
    return tuple(out), poses


def _slice(
    limits: Limits,
    region: Region,
    plane: tuple[int, int, float],
    box: tuple[Array, Array],
    first: int,
) -> tuple[Slice, Array]:
    """One slice within a box, and its poses.

    plane : axes across and up, and the level along the third.
    box : lowest and highest corner.
    first : index of its first pose in the map.
    """
    across, up, level = plane
    low, high = box
    cell = max(high[across] - low[across], high[up] - low[up]) / _OPTIONS.cells
    u, v = (
        low[k] + cell * (np.arange(max(round((high[k] - low[k]) / cell), 1)) + 0.5)
        for k in (across, up)
    )
    at = np.full((len(v), len(u), 3), level)
    at[..., across], at[..., up] = u, v[:, None]
    wanted = pose(limits.home[:3, :3], at.reshape(-1, 3))
    # nearest poses that the mechanism can take, inside the region and close to the cell's middle
    closed = on_manifold(limits.layout, limits.theta, wanted, ROUGH_EFFORT.newton)
    there = closed.T_base_platform
    off = pose_difference(there, wanted)
    good = closed.converged & (np.linalg.norm(off[:, 3:], axis=1) < _OPTIONS.most_off_middle * cell)
    good &= np.linalg.norm(off[:, :3], axis=1) < TRANSLATION_TURN
    good &= reachable(limits, there).inside & region.holds(limits, wanted)
    rows = np.full(len(good), -1)
    rows[good] = first + np.arange(np.count_nonzero(good))
    return Slice(across, up, level, u, v, rows.reshape(len(v), len(u))), there[good]
