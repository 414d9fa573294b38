"""Poses of boards, or of other fixed patterns, in images.

Rows: :func:`pkmcal.measurements.poses.pose_rows`, all six numbers. The corners of one image enter
as the pose that they determine, with its covariance.
"""

from __future__ import annotations

from typing import ClassVar, final

from pkmcal.measurements.contract import ImageKind


@final
class BoardPoses(ImageKind):
    """Pose of a board in an image."""

    code: ClassVar = "boards"
    one: ClassVar = "board"
    label: ClassVar = "boards"
    unit: ClassVar = "m or rad"
    numbers: ClassVar = 6
    rows: ClassVar = "poses"
    observe: ClassVar = "board"
