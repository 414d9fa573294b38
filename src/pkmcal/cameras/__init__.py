"""Central cameras: one contract, one file a model; reading and writing their files."""

from pkmcal.cameras.contract import Camera, camera_models
from pkmcal.cameras.files import load_camera

__all__ = ["Camera", "camera_models", "load_camera"]
