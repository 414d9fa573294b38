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

    cell_text : description. least, most : limits of its numbers. whole : integers only. unit : of
    its numbers. words : its values if they are not numbers.
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
    "distance": Varied("from the camera to the machine's middle", "m", 1e-3, 1e3),
    "elevation": Varied("of the camera above the machine's level", "°", -85, 85),
    "stations": Varied("places of the camera", "", 1, 100, whole=True),
    "configurations": Varied("images from each place", "", 2, 1000, whole=True),
    "edge_noise": Varied("deviation of an edge's place and of its ends", "px", 1e-4, 100),
    "corner_noise": Varied("deviation of a board's corner", "px", 1e-4, 100),
    "shading": Varied("deviation of a tube's side by its shading", "px", 0, 100),
    "reading_noise": Varied("deviation of a reading", "m or rad", 1e-12, 1),
    "radius": Varied("tubes' radii, times the nominal model's", "", 0.01, 100),
    "size": Varied("the machine's size, times the nominal model's", "", 0.001, 1000),
    "tolerance": Varied("deviation of true machines, in tolerances", "", 0, 100),
    "extreme": Varied("share of configurations with legs near their ends", "", 0, 1),
    "observe": Varied("what is seen", words=("legs", "board", "legs+board")),
    "camera": Varied("pinhole, mirror, or a camera's file", words=("pinhole", "mirror")),
}
PAPER_NAMES_VARIED: Mapping[str, Varied] = {
    "configurations": Varied("images from each place", "", 5, 1000, whole=True),
    "legs": Varied("legs that each camera sees", "", 3, 6, whole=True),
    "axis_noise": Varied("noise of an axis, times Table 1", "", 1e-3, 1e3),
    "reading_noise": Varied("deviation of a reading", "m", 1e-12, 1),
    "drawing_error": Varied("deviation of true machines from the nominal model", "m", 0, 1),
    "distance": Varied("from the camera to the machine's middle", "m", 0.1, 100),
    "height": Varied("of the cameras above the base", "m", -10, 10),
}
