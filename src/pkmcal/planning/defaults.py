"""Defaults of a plan: one place for the command's options and the function's arguments.

Nothing is imported here, so that the command line's help stays quick.
"""

CONFIGURATIONS_A_CAPTURE = 15
"""Configurations from each place."""
PLANNED_IMAGE_SIZE = (1280, 960)
"""Pixels of a machine's camera where no camera file is given."""
PLACES_AROUND_A_MACHINE = 3
"""Stations of a machine's plan, unless a board or a panoramic camera needs only one."""
NOMINAL_EDGE_SIGMA = 0.1
"""px; how far an edge is off across, and its ends when it turns, before any image was measured:
what shading leaves on painted legs and bare rods, as of simulated edges. Polished ones are worse.
"""
NOMINAL_CORNER_SIGMA = 0.05
"""px; the same of a board's corner."""
UNTOLD_READING_NOISE = 3e-6
"""m or rad; noise of a reading where none is stated: of a good encoder."""
