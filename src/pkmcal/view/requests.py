"""Requests of the page."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Schema

Pixel = tuple[float, float]
RequestedPoseRow = tuple[float, float, float, float]
DisplayMachine = Literal["nominal", "calibration"]
"""Overlaid machine: the nominal one at the session's poses, or the calibrated one."""


class Pin(Schema):
    """Joint placed at a pixel of an image.

    leg : from 1.
    """

    image: int
    end: Literal["base", "platform"]
    leg: int = Field(ge=1)
    pixel: Pixel


class Gesture(Schema):
    """Pull of the mouse from one pixel to another, or a turn of its wheel.

    factor : ratio of the new distance to the old one.
    """

    kind: Literal["aim", "turn", "roll", "distance"]
    start: Pixel
    end: Pixel
    factor: float = Field(default=1.0, gt=0.01, lt=100)


class ViewRequest(Schema):
    """Image with the machine to overlay.

    pose : T_camera_base as rows; None for the pose of the files.
    anywhere : search the pose globally rather than near the given one.
    """

    station: int
    image: int
    shown: DisplayMachine = "nominal"
    pose: tuple[RequestedPoseRow, RequestedPoseRow, RequestedPoseRow, RequestedPoseRow] | None = (
        None
    )
    gesture: Gesture | None = None
    pins: tuple[Pin, ...] = ()
    anywhere: bool = False


def requested_pose(request: ViewRequest) -> Array | None:
    """T_camera_base (4, 4) of a request, None without one.

    Raises InputError for a matrix that is not a rigid motion.
    """
    if request.pose is None:
        return None
    pose = np.array(request.pose, dtype=float)
    rot = pose[:3, :3]
    rigid = np.allclose(rot @ rot.T, np.eye(3), atol=1e-6) and np.linalg.det(rot) > 0
    if not rigid or not np.array_equal(pose[3], [0, 0, 0, 1]):
        raise InputError("the pose is no rotation and translation", where="the page, pose")
    return pose
