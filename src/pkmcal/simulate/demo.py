"""The demonstration session: small enough to be rendered while one waits."""

from __future__ import annotations

import numpy as np

from pkmcal.cameras import Camera, camera_models
from pkmcal.simulate.truth import Settings

MECHANISM = "gough-stewart"
SEED = 7
SETTINGS = Settings(stations=3, configurations=6)


def demo_camera() -> Camera:
    """A small industrial camera with a 6 mm lens and its usual barrel distortion."""
    parameters = np.array([705.0, 706.0, 402.3, 297.8, -0.11, 0.09, 0.0004, -0.0003, 0.0])
    return camera_models()["pinhole"]((800, 600), parameters)
