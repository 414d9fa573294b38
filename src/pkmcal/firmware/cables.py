"""Lengths that firmwares state in mm, and anchors of cable robots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files.quantities import LARGEST_UNITLESS_LENGTH

ANCHOR_SIGMA = 0.01
"""Standard deviation of an anchor that was measured with a tape, m."""
SHORTEST_CABLE = 1.0
"""Shortest length of a cable with the tool in the origin, mm."""
LEAST_SIZE, LARGEST_SIZE = 50.0, 1e3 * LARGEST_UNITLESS_LENGTH
"""Bounds of a machine's longest dimension, mm; smaller ones would be metres."""


def check_millimetres(longest: float, where: str) -> None:
    """Raise InputError for a longest dimension, mm, that no machine has, as of metres."""
    if not LEAST_SIZE <= longest <= LARGEST_SIZE:
        raise InputError(
            "these are no lengths of a machine in mm",
            where=where,
            found=f"{longest:.4g} mm at most",
            expected=f"{LEAST_SIZE:g} to {LARGEST_SIZE:g} mm for the longest",
            next_step="If these are metres, multiply them by 1000"
            if longest < LEAST_SIZE
            else None,
            code="printer.units",
        )


def anchors_from_origin(anchors: Array, places: Sequence[str]) -> Array:
    """Anchors (L, 3), m, of cables whose lengths count from the tool in the origin.

    anchors : (L, 3) mm. places : of each in its file, for messages. Raises InputError for a cable
    without a length there, and for lengths that are not in mm.
    """
    lengths = np.linalg.norm(anchors, axis=1)
    check_millimetres(float(lengths.max()), places[int(lengths.argmax())])
    shortest = int(lengths.argmin())
    if lengths[shortest] < SHORTEST_CABLE:
        raise InputError(
            "this cable has no length with the tool in the origin",
            where=places[shortest],
            found=", ".join(f"{value:g}" for value in anchors[shortest]) + " mm",
            expected="an anchor away from the origin",
        )
    return 1e-3 * anchors
