"""Photographs of legs to edges, one station at a time.

Three looks, each told where to look by what is known so far: :func:`find` recognises the machine
and refines the station's pose, :func:`search` finds each leg to a pixel, :func:`measure` each
edge to a few hundredths. Between looks the identification turns edges into a better prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.mechanisms import Machine
from pkmcal.observe import profiles
from pkmcal.observe.distance import DistanceTables, distance_tables
from pkmcal.observe.edges import EdgeSet, Rejection
from pkmcal.observe.lines import EdgeFits, edge_set, fit_edges
from pkmcal.observe.predict import (
    EdgePoints,
    TubeList,
    edge_points,
    legs_in_camera,
    tubes_of,
    unobstructed,
)
from pkmcal.observe.search import REACH, SEARCH_SIGMA, sample, search_legs

SEARCH_SAMPLES = 12
SEGMENTS = 8
"""Places along an edge at which a position is fitted, each to the mean of its samples' profiles."""
PLACES = 5 * SEGMENTS
"""Points along an edge that are predicted in full: an odd count a segment, so one is its middle."""
BETWEEN = 5
"""Profiles taken about each of these, so about one a pixel in all: faint edges need it."""
FEWEST_SHARE = 1 / 3
"""Share of a segment's samples that must be clear for its mean profile to count."""
BLUR = 0.7
"""Pixels of blur assumed where no profile is there to tell: lens 0.6, pixel 0.3."""
CLEARANCE = 5.0
"""Pixels kept free of other legs' outlines: a profile's outer reach and the search about it."""


@dataclass(frozen=True)
class Photographs:
    """One station's decoded photographs.

    station : its number. configuration : (K,) rows of the session's joints. joints : (K, m).
    images : K grey-level arrays (height, width). tables : for the coarse search.
    """

    station: int
    camera: Camera
    configuration: Integers
    joints: Array
    images: list[Integers]
    tables: DistanceTables


@dataclass(frozen=True)
class StationEdges:
    """What one look at one station gave.

    points : (M, 2) px and point_edge (M,) the edge in ``edges`` that each supports.
    blur : px, of the pictures' edges; nan where not estimated. moved : median distance (px) of
    the edges from where they were predicted.
    """

    edges: EdgeSet
    rejected: tuple[Rejection, ...]
    points: Array
    point_edge: Integers
    blur: float
    moved: float


def photographs_of(
    station: int, camera: Camera, configuration: Integers, joints: Array, images: list[Integers]
) -> Photographs:
    """Decoded photographs with their distance tables."""
    tables = distance_tables(images)
    return Photographs(station, camera, configuration, joints[configuration], images, tables)


def search(
    photographs: Photographs, machine: Machine, T_camera_base: Array, poses: Array
) -> StationEdges:
    """Every leg to about a pixel, each moved as a whole; edges have sigmas of a pixel.

    poses : T_base_platform (K, 4, 4) of the photographs.
    """
    tubes, points, clear = _predict(
        photographs, machine, T_camera_base, poses, SEARCH_SAMPLES, CLEARANCE
    )
    places = search_legs(photographs.images, tubes, points, clear)
    found = clear & places.clear[:, tubes.leg][..., None]
    position = places.outward(points, clear, tubes)
    fits = fit_edges(points, position, np.full(position.shape, SEARCH_SIGMA), found)
    keep = fits.good & places.clear[:, tubes.leg]
    edges = edge_set(points, fits, tubes, photographs.station, photographs.configuration, keep)
    rejected = [
        Rejection(photographs.station, int(photographs.configuration[k]), int(leg), -1, -1, why)
        for k, leg in zip(*np.nonzero(~places.clear), strict=True)
        for why in [_search_reason(float(places.share[k, leg]))]
        if leg in tubes.leg
    ]
    nowhere = np.zeros((0, 2)), np.zeros(0, dtype=int)
    return StationEdges(edges, tuple(rejected), *nowhere, float("nan"), REACH)


def _search_reason(share: float) -> str:
    if share < 0.1:
        return "hidden behind another leg or outside the photograph"
    return "not found: no place, or two places, where all its edges fit"


def measure(
    photographs: Photographs,
    machine: Machine,
    T_camera_base: Array,
    poses: Array,
    blur: float | None = None,
    refine_camera: bool = False,
) -> StationEdges:
    """Every edge to sub-pixel, by the shading-aware model of :mod:`profiles`.

    blur : px, from an earlier look; estimated from these profiles when absent. refine_camera :
    also how the edges depend on the camera's parameters.
    """
    tubes, points, clear = _predict(photographs, machine, T_camera_base, poses, PLACES, CLEARANCE)
    grey = sample(photographs.images, _profile_pixels(photographs.camera, points))
    places = _at_samples(points, np.arange(SEGMENTS) * 5 + 2)
    half_width = places.gain * machine.values[tubes.radius][:, None]
    full, across = _segment_profiles(grey, np.repeat(clear, BETWEEN, axis=-1), half_width)
    if blur is None:
        blur = profiles.estimate_blur(across) if full.any() else BLUR
    at = profiles.locate(across, blur)
    position, sigma, found = np.zeros(full.shape), np.ones(full.shape), full.copy()
    position[full], sigma[full], found[full] = at.position, at.sigma, at.found
    fits = fit_edges(places, position, sigma, found)
    by_camera = photographs.camera.project_jacobians(places.point)[1] if refine_camera else None
    edges = edge_set(
        places, fits, tubes, photographs.station, photographs.configuration, fits.good, by_camera
    )
    rejected = _rejections(photographs, tubes, full, found, fits)
    k, e, s = np.nonzero(fits.used & fits.good[..., None])
    xy = places.pixel[k, e, s] + position[k, e, s, None] * places.outward[k, e, s]
    number = np.cumsum(fits.good.ravel()).reshape(fits.good.shape) - 1
    moved = float(np.median(np.abs(position[k, e, s]))) if len(k) else 0.0
    return StationEdges(edges, rejected, xy, number[k, e], blur, moved)


def _predict(
    photographs: Photographs,
    machine: Machine,
    T_camera_base: Array,
    poses: Array,
    samples: int,
    clearance: float,
) -> tuple[TubeList, EdgePoints, Booleans]:
    tubes = tubes_of(machine)
    legs = legs_in_camera(machine, T_camera_base, poses, photographs.joints)
    points = edge_points(machine, photographs.camera, legs, tubes, samples)
    clear = unobstructed(machine, photographs.camera, legs, tubes, points, clearance)
    return tubes, points, clear


def _profile_pixels(camera: Camera, points: EdgePoints) -> Array:
    """Pixels (K, E, PLACES * BETWEEN, offsets, 2) of profiles across the edges.

    Points of an edge lie evenly on a line in space, so those between are interpolated there and
    projected; the profiles' directions hardly turn from one to the next.
    """
    start, step = points.point[..., :1, :], np.diff(points.point[..., :2, :], axis=-2)
    fraction = (np.arange(PLACES * BETWEEN) + 0.5) / BETWEEN - 0.5
    pixel = camera.project(start + fraction[:, None] * step)
    outward = np.repeat(points.outward, BETWEEN, axis=-2)
    return pixel[..., None, :] + profiles.profile_offsets()[:, None] * outward[..., None, :]


def _segment_profiles(
    grey: Array, clear: Booleans, half_width: Array
) -> tuple[Booleans, profiles.Profiles]:
    """Mean profiles over each segment's clear samples.

    Returns where there are enough of them, (K, E, SEGMENTS), and the profiles there.
    """
    k, e, n = clear.shape
    grey = grey.reshape(k, e, SEGMENTS, n // SEGMENTS, -1)
    weight = clear.reshape(k, e, SEGMENTS, n // SEGMENTS)
    count = weight.sum(axis=-1)
    full = count >= FEWEST_SHARE * weight.shape[-1]
    kept, weight = grey[full], weight[full][..., None]
    mean = np.sum(kept * weight, axis=-2) / count[full][:, None]
    saturated = np.any((kept >= profiles.SATURATED) & weight, axis=-2)
    cut = profiles.cut_of(saturated, half_width[full])
    return full, profiles.Profiles(mean, count[full], half_width[full], cut)


def _at_samples(points: EdgePoints, samples: Integers) -> EdgePoints:
    """The same edges at some of their samples only."""
    per_sample = {
        f.name: getattr(points, f.name)[:, :, samples] for f in fields(points) if f.name != "normal"
    }
    return replace(points, **per_sample)


def _rejections(
    photographs: Photographs,
    tubes: TubeList,
    full: Booleans,
    found: Booleans,
    fits: EdgeFits,
) -> tuple[Rejection, ...]:
    """Edges without a measurement, each with its reason."""
    visible, seen = full.sum(axis=-1), found.sum(axis=-1)
    out: list[Rejection] = []
    for k, e in zip(*np.nonzero(~fits.good), strict=True):
        if visible[k, e] == 0:
            why = "hidden behind another leg or outside the photograph"
        elif seen[k, e] < 3:
            why = "too little of it is seen as a clear edge"
        else:
            why = "its places do not lie on one edge"
        out.append(
            Rejection(
                photographs.station,
                int(photographs.configuration[k]),
                int(tubes.leg[e]),
                int(tubes.tube[e]),
                int(tubes.side[e]),
                why,
            )
        )
    return tuple(out)
