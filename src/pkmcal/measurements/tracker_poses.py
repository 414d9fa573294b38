"""Poses of a target on the platform, measured by a laser tracker or a measuring machine.

Rows: :func:`pkmcal.measurements.poses.pose_rows`, all six numbers.
"""

from __future__ import annotations

from typing import ClassVar, final

from pkmcal.arrays import Array
from pkmcal.measurements.contract import (
    POINT_COLUMNS,
    QUATERNION_COLUMNS,
    TURN_VECTOR_COLUMNS,
    TargetKind,
)


@final
class TrackerPoses(TargetKind):
    """Pose of a target."""

    code: ClassVar = "poses"
    one: ClassVar = "pose"
    label: ClassVar = "poses"
    unit: ClassVar = "m or rad"
    numbers: ClassVar = 6
    headers: ClassVar = (
        (*POINT_COLUMNS, *QUATERNION_COLUMNS),
        (*POINT_COLUMNS, *TURN_VECTOR_COLUMNS),
    )
    known: ClassVar = (0, 1, 2, 3, 4, 5)
    fewest_rows: ClassVar = 3

    @classmethod
    def start(cls, T_tracker_target: Array, T_base_platform: Array) -> Array | None:
        """None: one measured pose determines the tracker's pose directly."""
        del T_tracker_target, T_base_platform
        return None
