"""A machine's shadow, which may look as much like the machine as it does itself.

Legs that move in a plane throw shadows on a parallel one that are their exact image elsewhere, with
edges often clearer than their own. But a shadow darkens what it falls on, always. So of two places
of the machine, turned alike, one of which lies on what has become darker and the other on what has
become brighter than in the other photographs, the darker one is the other's shadow; for what is
bright could not be explained by a machine in the dark. Of dark machines nothing can be said so.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras import Camera
from pkmcal.observe.distance_tables import DistanceTables
from pkmcal.observe.pose_candidates import same_pose
from pkmcal.observe.predict import LegsInCamera, TubeList, of_edges, visible_stretch

PLACES_ALONG_TUBE = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Places along the middle of a tube's visible part that are looked at."""
MOSTLY_CHANGED_SHARE = 0.5
"""Share of these, in all photographs, that have become darker, or brighter, than elsewhere."""


def lightness(camera: Camera, tubes: TubeList, legs: LegsInCamera, tables: DistanceTables) -> Array:
    """How much of the legs' middles is brighter than there in the median of all photographs, less
    what is darker, (H,), -1 to 1.

    legs : camera frame, (H, K, L), of the K photographs of ``tables``.
    """
    a, b, u = of_edges(legs, tubes)
    first, last = visible_stretch(a, b, tubes)
    length = np.maximum(last - first, 0.0)
    at = (first + length * PLACES_ALONG_TUBE[:, None, None, None])[..., None]
    number = np.arange(len(tables.row))[:, None]
    sign, inside = tables.brighter(camera.project(a + at * u), number)
    count = np.maximum(inside.sum(axis=(0, 2, 3)), 1)
    return sign.sum(axis=(0, 2, 3)) / count


def without_shadows(places: Array, light: Array) -> Integers:
    """Indices of the pose candidates (H, 4, 4) that are not another one's shadow.

    light : (H,) as `lightness` returns. A shadow's candidate is turned little against the
    machine's, for the two planes are nearly parallel.
    """
    casts = (light > MOSTLY_CHANGED_SHARE) & same_pose(places[:, None], places)
    return np.flatnonzero((light > -MOSTLY_CHANGED_SHARE) | ~casts.any(axis=1))
