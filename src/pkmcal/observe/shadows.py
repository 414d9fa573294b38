"""Detection of the machine's shadow among candidate poses.

Legs that move in a plane cast shadows on a parallel plane that have exactly the machine's shape,
often with clearer edges than the machine itself. A shadow always darkens the surface. So of two
poses with similar orientation, one on pixels that have become darker and the other on pixels that
have become brighter than in the other images, the darker one is the shadow of the other: a machine
at the darker pose would not explain the brighter pixels. A machine that is darker than its
background allows no such conclusion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras import Camera
from pkmcal.levels import MAJORITY
from pkmcal.observe.distance_tables import DistanceTables
from pkmcal.observe.pose_candidates import same_pose
from pkmcal.observe.predict import LegsInCamera, TubeList, of_edges, visible_stretch


@dataclass(frozen=True)
class ShadowOptions:
    """Constants of the detection of shadows."""

    # sampled positions along the axis of a tube, as shares of its visible part
    along: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)
    # share of the samples, over all images, above which a pose lies on pixels that became darker,
    # or brighter: the majority
    changed: float = MAJORITY


SHADOW_OPTIONS = ShadowOptions()


def lightness(
    camera: Camera,
    tubes: TubeList,
    legs: LegsInCamera,
    tables: DistanceTables,
    options: ShadowOptions = SHADOW_OPTIONS,
) -> Array:
    """Mean sign (H,) of the brightness change on the legs' axes against the median image, -1 to 1.

    legs : (H, K, L) camera frame, in the K images of ``tables``.
    """
    a, b, u = of_edges(legs, tubes)
    first, last = visible_stretch(a, b, tubes)
    length = np.maximum(last - first, 0.0)
    at = (first + length * np.array(options.along)[:, None, None, None])[..., None]
    number = np.arange(len(tables.row))[:, None]
    sign, inside = tables.brighter(camera.project(a + at * u), number)
    count = np.maximum(inside.sum(axis=(0, 2, 3)), 1)
    return sign.sum(axis=(0, 2, 3)) / count


def without_shadows(
    places: Array, light: Array, options: ShadowOptions = SHADOW_OPTIONS
) -> Integers:
    """Indices of the pose candidates (H, 4, 4) that are not the shadow of another candidate.

    light : (H,) as `lightness` returns. A shadow has nearly the machine's orientation, because the
        two planes are nearly parallel.
    """
    casts = (light > options.changed) & same_pose(places[:, None], places)
    return np.flatnonzero((light > -options.changed) | ~casts.any(axis=1))
