"""Defaults of a plan.

This module imports only the table of options, so that the command line's help stays quick.
"""

from pkmcal.ranges import GOOD_ENCODER_SIGMA, default

CONFIGURATIONS_A_CAPTURE: int = default("plan", "configurations")
"""Number of configurations at each station."""
PLANNED_IMAGE_SIZE = (1280, 960)
"""Image size in px of a machine's camera without a camera file."""
STATIONS_AROUND_A_MACHINE = 3
"""Number of stations for a machine, unless a board or a panoramic camera needs only one."""
NOMINAL_EDGE_SIGMA: float = default("plan", "edge_noise")
"""Standard deviation (px) of an edge's shift, and of its ends by tilt, before any image is
measured: what shading leaves on painted legs and bare rods, as for simulated edges. Polished legs
are worse.
"""
NOMINAL_CORNER_SIGMA: float = default("plan", "corner_noise")
"""Standard deviation (px) of a board's corner, before any image is measured."""
UNTOLD_READING_NOISE = GOOD_ENCODER_SIGMA
"""Default noise of a reading, m or rad."""
