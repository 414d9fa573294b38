"""Heights of the nozzle or of a probe above a flat bed.

Rows: :func:`pkmcal.measurements.poses.pose_rows`, the last number. The bed's z axis points upwards,
as the base's; with ``level: true`` it is the base's.
"""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import pose
from pkmcal.measurements.contract import TargetKind


@final
class Heights(TargetKind):
    """Height of a target above a flat bed."""

    code: ClassVar = "heights"
    one: ClassVar = "height"
    label: ClassVar = "heights"
    unit: ClassVar = "m"
    numbers: ClassVar = 1
    headers: ClassVar = (("z",),)
    known: ClassVar = (5,)
    fewest_rows: ClassVar = 7
    levels: ClassVar = True
    default_sigma: ClassVar[float] = 2e-5
    own_sigma: ClassVar = "Klipper's PROBE_ACCURACY and Marlin's M48 print yours"

    @classmethod
    def start(cls, T_tracker_target: Array, T_base_platform: Array) -> Array | None:
        """Bed that is parallel to the base's x-y plane, at the mean height."""
        shift = np.nanmean(T_tracker_target[:, 2, 3] - T_base_platform[:, 2, 3])
        return pose(np.eye(3), np.array([0.0, 0.0, shift]))
