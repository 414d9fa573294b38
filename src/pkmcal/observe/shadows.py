"""Rejection of camera poses that explain the machine's shadow.

Legs that move in a plane throw shadows on a parallel plane that are their exact image elsewhere,
with edges often clearer than their own. A shadow always darkens the surface that it falls on. So of
two camera poses with nearly the same orientation, one with its legs on pixels that are darker and
the other on pixels that are brighter than in the other images, the darker one is the shadow of the
other: a machine at the darker pose would leave the bright pixels unexplained. The test does not
apply to dark machines.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import angle_between
from pkmcal.observe.distance_tables import DistanceTables
from pkmcal.observe.predict import LegsInCamera, TubeList, of_edges, visible_stretch

PLACES_ALONG_TUBE = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
"""Positions along the axis of a tube's visible part at which its brightness is sampled."""
MOSTLY_CHANGED_SHARE = 0.5
"""Share of these samples, over all images, that are darker, or brighter, than in the others."""
SHADOW_TURN = np.radians(20.0)
"""Largest angle between two poses of which one is the shadow of the other: planes of legs and
shadow are nearly parallel."""


def lightness(camera: Camera, tubes: TubeList, legs: LegsInCamera, tables: DistanceTables) -> Array:
    """Share of samples on the legs' axes that are brighter than the median of all images, less the
    share of darker ones, (H,), -1 to 1.

    legs : camera frame, (H, K, L), of the K images of ``tables``.
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
    """Indices of the poses (H, 4, 4) that are not the shadow of another.

    light : (H,) as of :func:`lightness`.
    """
    casts = (light > MOSTLY_CHANGED_SHARE) & (angle_between(places[:, None], places) < SHADOW_TURN)
    return np.flatnonzero((light > -MOSTLY_CHANGED_SHARE) | ~casts.any(axis=1))
