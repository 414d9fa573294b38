"""Heights above a bed before and after a calibration, by the readings of the motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.calibration.discrepancy_basis import height_rows
from pkmcal.geometry.rigid import dot
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import Measurements
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT


@dataclass(frozen=True)
class ProbedHeights:
    """Errors of N heights: predicted by the forward kinematics less measured, m.

    configuration, station : (N,) of each height.
    x, y : (N,) of the tool, base frame, m.
    before, after : (N,) by the nominal model and by the calibrated machine; before less its mean,
        and less the bed's tilt where the bed need not be level. NaN where the nominal model does
        not close.
    sigma : (N,) standard deviation of such an error by the noise of the probe and of the readings,
        as estimated.
    used : (N,) False for a rejected height.
    """

    configuration: Integers
    station: Integers
    x: Array
    y: Array
    before: Array
    after: Array
    sigma: Array
    used: Booleans

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.after)

    @property
    def by_size(self) -> Integers:
        """Indices (N,) of the heights, the largest error after calibration in sigmas first."""
        return np.argsort(-np.abs(self.after / self.sigma), kind="stable")

    def document(self, session: Session) -> list[dict[str, Any]]:
        """Entries of calibration.json, m, in the order of the tables."""
        return [
            {
                "configuration": session.configurations[self.configuration[k]],
                "station": session.station_names[self.station[k]],
                "x": self.x[k],
                "y": self.y[k],
                "before": self.before[k],
                "after": self.after[k],
                "sigma": self.sigma[k],
                "used": bool(self.used[k]),
            }
            for k in range(len(self))
        ]


def probed_heights(
    session: Session, measurements: Measurements, estimate: Estimate
) -> ProbedHeights:
    """Heights of a session with their errors; empty without any."""
    if not session.trackers:
        none, nothing = np.zeros(0, dtype=int), np.zeros(0)
        no = np.zeros(0, dtype=bool)
        return ProbedHeights(none, none, nothing, nothing, nothing, nothing, nothing, no)
    poses, rows = measurements.poses, height_rows(measurements)
    configuration, station = poses.configuration[rows], poses.station[rows]
    state, machine, statistics = estimate.state, estimate.machine, estimate.statistics
    T_station_base = state.T_camera_base[station]
    joints = session.joints[configuration]
    T_after = machine.forward_result(joints, state.T_base_platform[configuration]).T_base_platform
    T_before = session.forward.T_base_platform[configuration]
    measured = poses.T_station_target[rows, 2, 3]
    before, after = (
        (T_station_base @ T @ state.T_mount[poses.mount[rows]])[:, 2, 3] - measured
        for T in (T_before, T_after)
    )
    used = estimate.pose_weights[rows] >= INLIER_WEIGHT
    xy = T_after[:, :2, 3]
    level = measurements.level
    for s in np.unique(station).tolist():
        own = station == s
        # the plane through the heights in use, horizontal for a level bed
        is_level = len(level) > s and bool(level[s])
        columns = np.column_stack([np.ones(len(xy)), 0 * xy if is_level else xy])
        fitted = own & used & np.isfinite(before)
        plane = np.linalg.lstsq(columns[fitted], before[fitted], rcond=None)[0]
        before[own] -= columns[own] @ plane
    # readings move the target along the bed's normal, the station's z axis
    by_readings = np.einsum(
        "ni,nij->nj", T_station_base[:, 2, :3], machine.forward_jacobian(T_after)[:, 3:]
    )
    probe = statistics.pose_scale / np.linalg.norm(poses.whiten[rows, :, 5], axis=-1)
    reading = statistics.reading_scale * session.joint_noise
    sigma = np.sqrt(probe**2 + reading**2 * dot(by_readings, by_readings))
    return ProbedHeights(
        configuration, station, xy[:, 0], xy[:, 1], before, after, sigma, used
    )  # fmt: skip
