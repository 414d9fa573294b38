"""Defaults of a plan, shared by the command's options and the function's arguments.

This module imports nothing, so that the command line's help stays quick.
"""

CONFIGURATIONS_A_CAPTURE = 15
"""Number of configurations at each station."""
PLANNED_IMAGE_SIZE = (1280, 960)
"""Image size in px of a machine's camera without a camera file."""
STATIONS_AROUND_A_MACHINE = 3
"""Number of stations for a machine, unless a board or a panoramic camera needs only one."""
NOMINAL_EDGE_SIGMA = 0.1
"""Standard deviation (px) of an edge's shift, and of its ends by tilt, before any image is
measured: what shading leaves on painted legs and bare rods, as for simulated edges. Polished legs
are worse.
"""
NOMINAL_CORNER_SIGMA = 0.05
"""Standard deviation (px) of a board's corner, before any image is measured."""
UNTOLD_READING_NOISE = 3e-6
"""Default noise of a reading, m or rad: that of a good encoder."""
