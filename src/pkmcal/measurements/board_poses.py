"""Poses of a calibration board in images.

Rows: :func:`pkmcal.measurements.poses.pose_rows`, all six numbers. The corners of one image enter
as the pose that they determine, with its covariance.
"""

from __future__ import annotations

from typing import ClassVar, final

from pkmcal.measurements.contract import ImageKind


@final
class BoardPoses(ImageKind):
    """Position and orientation of a board."""

    code: ClassVar = "boards"
    one: ClassVar = "board"
    label: ClassVar = "boards"
    unit: ClassVar = "m or rad"
    numbers: ClassVar = 6
    observe: ClassVar = "board"
