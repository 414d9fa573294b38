"""Detection of the machine's shadow among candidate poses.

Legs that move in a plane cast shadows on a parallel plane that have exactly the machine's shape,
often with clearer edges than the machine itself. A shadow always darkens the surface. So of two
poses with similar orientation, one on pixels that have become darker and the other on pixels that
have become brighter than in the other images, the darker one is the shadow of the other: brighter
pixels could not be explained by a machine at the darker pose. Nothing follows for machines that are
darker than their background.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras import Camera
from pkmcal.observe.distance_tables import DistanceTables
from pkmcal.observe.pose_candidates import same_pose
from pkmcal.observe.predict import LegsInCamera, TubeList, of_edges, visible_stretch

PLACES_ALONG_TUBE = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Sampled positions along the axis of a tube, as shares of its visible part."""
MOSTLY_CHANGED_SHARE = 0.5
"""Share of these, over all images, above which a pose lies on pixels that became darker, or
brighter."""


def lightness(camera: Camera, tubes: TubeList, legs: LegsInCamera, tables: DistanceTables) -> Array:
    """Mean sign (H,) of the brightness change on the legs' axes against the median image, -1 to 1.

    legs : (H, K, L) camera frame, in the K images of ``tables``.
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
