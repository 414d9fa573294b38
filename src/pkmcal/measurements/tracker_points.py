"""Points of a reflector or a ball on the platform, measured by a tracker or a measuring machine.

Rows: :func:`pkmcal.measurements.poses.pose_rows`, the last three numbers.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import register
from pkmcal.measurements.contract import POINT_COLUMNS, TargetKind


@final
class TrackerPoints(TargetKind):
    """Position of a target."""

    code: ClassVar = "points"
    one: ClassVar = "point"
    label: ClassVar = "points"
    unit: ClassVar = "m"
    numbers: ClassVar = 3
    headers: ClassVar = (POINT_COLUMNS,)
    known: ClassVar = (3, 4, 5)
    fewest_rows: ClassVar = 4

    @classmethod
    def start(cls, T_tracker_target: Array, T_base_platform: Array) -> Array | None:
        """Rigid registration of the platform's positions to the measured points."""
        good = np.isfinite(T_base_platform[:, 0, 0])
        return register(T_base_platform[good, :3, 3], T_tracker_target[good, :3, 3])
