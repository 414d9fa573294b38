"""Camera of a plan or a simulation without a camera file: a small industrial one."""

from __future__ import annotations

import numpy as np

from pkmcal.cameras import Camera, camera_models


def default_camera() -> Camera:
    """Small industrial camera with a 6 mm lens and its usual barrel distortion."""
    parameters = np.array([705.0, 706.0, 402.3, 297.8, -0.11, 0.09, 0.0004, -0.0003, 0.0])
    return camera_models()["pinhole"]((800, 600), parameters)


def camera_of_size(size: tuple[int, int]) -> Camera:
    """Default camera with the same lens and another image size (width, height)."""
    camera = default_camera()
    width, height = camera.image_size
    scale = size[0] / width
    parameters = camera.parameters.copy()
    parameters[:2] *= scale
    middle = ((width - 1) / 2, (height - 1) / 2)
    for axis in (0, 1):
        off = (parameters[2 + axis] - middle[axis]) * scale
        parameters[2 + axis] = (size[axis] - 1) / 2 + off
    return camera_models()[camera.model](size, parameters)
