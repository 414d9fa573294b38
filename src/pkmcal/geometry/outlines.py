"""Outlines of bodies through their joints."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array


def ring(points: Array) -> Array:
    """Joints (L, 3) of a body in their order around the middle, closed: (L + 1, 3)."""
    centred = points - points.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][:2]
    around = np.argsort(np.arctan2(*(centred @ across.T).T))
    return points[[*around, around[0]]]
