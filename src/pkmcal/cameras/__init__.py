"""Central cameras: their contract, one file for each model, and reading and writing of camera
files.
"""

from pkmcal.cameras.contract import Camera, camera_models
from pkmcal.cameras.files import load_camera

__all__ = ["Camera", "camera_models", "load_camera"]
