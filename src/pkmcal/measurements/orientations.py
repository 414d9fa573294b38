"""Orientations of the platform, by an inertial sensor, an autocollimator or a vision system.

Rows: :func:`pkmcal.measurements.poses.pose_rows`, the first three numbers. The positions of tracker
and target are arbitrary, and nothing that the rows predict depends on them. All three angles must
be measured; for an inclinometer, which measures two, see CONTRIBUTING ("Add a kind of
measurement").
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import pose, rotation_vector
from pkmcal.measurements.contract import QUATERNION_COLUMNS, TURN_VECTOR_COLUMNS, TargetKind


@final
class Orientations(TargetKind):
    """Orientation of a target."""

    code: ClassVar = "orientations"
    one: ClassVar = "orientation"
    label: ClassVar = "orientations"
    unit: ClassVar = "rad"
    numbers: ClassVar = 3
    headers: ClassVar = (QUATERNION_COLUMNS, TURN_VECTOR_COLUMNS)
    known: ClassVar = (0, 1, 2)
    fewest_rows: ClassVar = 3

    @classmethod
    def start(cls, T_tracker_target: Array, T_base_platform: Array) -> Array | None:
        """Rotation that aligns the rotation vectors since the first row (Kabsch), at the origin."""
        good = np.isfinite(T_base_platform[:, 0, 0])
        measured, nominal = (
            rotation_vector(T[good, :3, :3] @ T[good][0, :3, :3].T)
            for T in (T_tracker_target, T_base_platform)
        )
        u, _, vt = np.linalg.svd(measured.T @ nominal)
        return pose(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, np.zeros(3))
