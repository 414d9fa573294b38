"""Names that a study can vary, with their limits.

This module imports nothing else of the package, so that the command line's help stays quick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Varied:
    """Name that can be varied.

    cell_text : description.
    least, most : limits of its numbers.
    whole : integers only.
    unit : of its numbers.
    words : its values if they are not numbers.
    """

    cell_text: str
    unit: str = ""
    least: float = 0.0
    most: float = math.inf
    whole: bool = False
    words: tuple[str, ...] = ()


DESIGN_NAMES_VARIED: Mapping[str, Varied] = {
    "resolution": Varied("width of the images", "px", 64, 20000, whole=True),
    "focal": Varied("focal length", "px", 10, 1e6),
    "distance": Varied("distance of the camera from the machine's middle", "m", 1e-3, 1e3),
    "elevation": Varied("elevation of the camera above the machine's middle", "°", -85, 85),
    "stations": Varied("number of stations", "", 1, 100, whole=True),
    "configurations": Varied("configurations for each station", "", 2, 1000, whole=True),
    "edge_noise": Varied("sigma of an edge's shift and of its tilt", "px", 1e-4, 100),
    "corner_noise": Varied("sigma of a board's corner", "px", 1e-4, 100),
    "shading": Varied("sigma of an edge's shift by shading", "px", 0, 100),
    "reading_noise": Varied("sigma of a joint reading", "m or rad", 1e-12, 1),
    "reading_resolution": Varied("step of the joint readings", "m or rad", 0, 1),
    "play": Varied("play of the drives", "m or rad", 0, 1),
    "radius": Varied("radii of the tubes, times the nominal model's", "", 0.01, 100),
    "size": Varied("size of the machine, times the nominal model's", "", 0.001, 1000),
    "tolerance": Varied("standard deviation of true machines, in prior sigmas", "", 0, 100),
    "extreme": Varied("share of configurations with legs near their limits", "", 0, 1),
    "observe": Varied("legs, board, or legs+board", words=("legs", "board", "legs+board")),
    "camera": Varied("pinhole, mirror, or a camera file", words=("pinhole", "mirror")),
}
PAPER_NAMES_VARIED: Mapping[str, Varied] = {
    "configurations": Varied("configurations for each station", "", 5, 1000, whole=True),
    "legs": Varied("number of legs that each camera observes", "", 3, 6, whole=True),
    "axis_noise": Varied("sigma of an axis, times Table 1", "", 1e-3, 1e3),
    "reading_noise": Varied("sigma of a joint reading", "m", 1e-12, 1),
    "drawing_error": Varied("standard deviation of true machines", "m", 0, 1),
    "distance": Varied("distance of the camera from the machine's middle", "m", 0.1, 100),
    "height": Varied("height of the cameras above the base", "m", -10, 10),
}
