"""Measurement of legs in images: search of each leg as a whole, then sub-pixel edges.

The errors of the nominal model shift predictions by a few pixels, more than the distance to
highlights, shadows and neighbours. But all edges of one leg, two for each tube, move together: so
:func:`search` shifts and tilts the leg as a whole until the grey-level gradients under all its
edges are strongest. A highlight imitates one edge, but not four at the right distances.

Where the prediction is correct to a pixel, :func:`measure` fits every edge separately to the
profiles across it (:mod:`pkmcal.observe.profiles`).

Both process images in windows (:mod:`pkmcal.observe.image_batches`); of each image only a few
hundred numbers about its edges remain in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras.contract import PIXEL_PARAMETERS
from pkmcal.cameras.response import light_of_levels
from pkmcal.geometry.cylinders import SIDE_SIGNS
from pkmcal.geometry.rigid import of_components
from pkmcal.levels import FEW, NEARLY_ALL
from pkmcal.measurements import EdgeSet, Rejection, concatenate
from pkmcal.mechanisms import Machine
from pkmcal.observe import profiles
from pkmcal.observe.grey_levels import levels_at
from pkmcal.observe.image_batches import ImageWindow, Placed, StationImages, windows
from pkmcal.observe.predict import (
    EdgePoints,
    TubeList,
    edge_points,
    legs_in_camera,
    tubes_of,
    unobstructed,
)
from pkmcal.observe.profiles import (
    EDGE_FIT_OPTIONS,
    PROFILE_OPTIONS,
    BlurByStation,
    EdgeFitOptions,
    EdgeFits,
    ProfileOptions,
    Profiles,
    edge_set,
    estimate_blur,
    fit_edges,
)
from pkmcal.outcome.finding import note

USUAL_PICTURE_LENGTH = 1024
"""Longer side, in pixels, of images in which errors of the nominal model are pixels and tubes
are tens of pixels wide; the lengths below refer to it. Larger images are binned to about this
size."""

ImageBatchesInUse = Callable[[int], None]
"""Progress callback, called with the number of images processed since the last call."""


def first_binning(image_size: tuple[int, int]) -> int:
    """Binning of images of a size in the first measurement pass."""
    return max(round(max(image_size) / USUAL_PICTURE_LENGTH), 1)


def sharp_binning(binning: int, blur: float) -> int:
    """Binning at which edges, with this blur (px) at a present binning, are as sharp as usual.

    Smaller bins would resolve the lens's blur without further information. Twice the present
    binning where the blur exceeds those that profiles can explain.
    """
    if blur > PROFILE_OPTIONS.blurs[-1] - 1e-6:  # up to rounding
        return 2 * binning
    return min(max(int(binning * blur / PROFILE_OPTIONS.usual_blur), 1), binning)


@dataclass(frozen=True)
class EdgeOptions:
    """Constants of the measurement of edges to sub-pixel accuracy."""

    # segments of an edge; a position is fitted to the mean profile of each
    segments: int = 8
    # points of each segment that are predicted: odd, so one is in the middle
    segment_points: int = 3
    # smallest number of profiles around each of these points; with the largest, one per pixel on
    # edges of 72 to 192 pixels. Shorter edges are sampled more densely
    fewest_profiles: int = 3
    # largest number of them: faint edges need one per pixel, and more would sample the same
    # pixels; on longer edges so many exhaust the information that shading leaves
    most_profiles: int = 8
    # smallest share of a segment's points that must be clear for its mean profile to be used
    fewest_share: float = FEW
    # distance in pixels from the outlines of other legs: the outer reach of a profile (3) and of
    # the search around it (1.5), rounded up
    clearance: float = float(np.ceil(PROFILE_OPTIONS.reach_outside + PROFILE_OPTIONS.shift_reach))
    # largest trial shift of a leg's ends relative to its middle, px, once its position is known to
    # a pixel
    tilt_reach: float = 1.0
    # spacing of these trial shifts, px: half of the window about the leg's edge
    tilt_step: float = 0.25
    # model of the profiles
    profiles: ProfileOptions = PROFILE_OPTIONS
    # fit of the edges' planes
    fit: EdgeFitOptions = EDGE_FIT_OPTIONS

    @cached_property
    def tilts(self) -> Array:
        """Trial shifts of a leg's ends relative to its middle, px."""
        return np.arange(-self.tilt_reach, self.tilt_reach + self.tilt_step, self.tilt_step)


EDGE_OPTIONS = EdgeOptions()


@dataclass(frozen=True)
class LegSearchOptions:
    """Constants of the search of legs; lengths in pixels of images binned to about the usual
    length.
    """

    # range of shifts to each side: several times an error of the nominal model of 2 mm at 0.9
    # px/mm, and the remaining error of the station's pose
    reach: float = 10.0
    # range once the other legs have determined the position: further away are highlights and
    # neighbours
    repeated_reach: float = 4.0
    # largest trial shift of a leg's ends relative to its middle, in steps of one pixel
    tilt_reach: int = 4
    # standard deviation of a blur against the noise of dark images
    blur: float = 1.0
    # pixels to each side within which the steepest point has the largest weight
    peak_half_width: int = 2
    # slope, in levels per pixel, at which an edge has half the strength of a strong one, so that
    # strong highlights do not outweigh three weak edges. Levels are square roots of grey levels
    # (255 is unchanged), whose noise is even: 0.3 per pixel after smoothing, of which this is five
    # times (derived)
    gradient_half: float = 1.5
    # ratio of the second best score to the best one from which a leg's position is ambiguous
    rival_share: float = 0.95
    # standard deviation of edges from the search: one step of it
    sigma: float = 1.0
    # number of points along an edge
    samples: int = 12
    # fewest visible points of a leg's two edges with which it is searched: a third of them. Not
    # checked within a factor of two
    fewest: int = 8
    # share of a leg's points below which it counts as hidden instead of not found
    in_sight: float = 1 - NEARLY_ALL
    # distance from the outlines of other legs
    clearance: float = EdgeOptions.clearance

    @property
    def rival_away(self) -> int:
        """Distance from the best position, px, from which another one is no part of its flank."""
        return 2 * self.peak_half_width

    @cached_property
    def tilts(self) -> Array:
        """Trial shifts of a leg's ends relative to its middle, px."""
        return np.arange(-self.tilt_reach, self.tilt_reach + 0.5)


LEG_SEARCH_OPTIONS = LegSearchOptions()


@dataclass(frozen=True)
class LegPlaces:
    """Positions of legs found in images, arrays (K, L).

    shift, tilt : px sideways, towards side 0, of the leg's middle, and of its visible end near B
        relative to the middle.
    score : 0 to 1.
    share : of the leg's edge points that are visible.
    clear : False where the leg is hidden or its position ambiguous.
    """

    shift: Array
    tilt: Array
    score: Array
    share: Array
    clear: Booleans

    def outward(self, points: EdgePoints, visible: Booleans, tubes: TubeList) -> Array:
        """Outward positions (K, E, n) px of all edge points at these positions of the legs."""
        along = place_on_leg(points.along, visible, tubes)
        shift, tilt = (v[:, tubes.leg][..., None] for v in (self.shift, self.tilt))
        return SIDE_SIGNS[tubes.side][:, None] * (shift + tilt * along)


def search_legs(
    images: Sequence[Integers],
    tubes: TubeList,
    points: EdgePoints,
    clear: Booleans,
    reach: float | None = None,
    options: LegSearchOptions = LEG_SEARCH_OPTIONS,
) -> LegPlaces:
    """Shift and tilt of every leg in images, by exhaustive search.

    images : K arrays (height, width), float32 or uint8.
    points, clear : predictions (K, E, n).
    reach : range of shifts, px; None for that of the options.
    """
    reach = options.reach if reach is None else reach
    steps = np.arange(-reach, reach + 0.5)
    offsets = np.arange(steps[0] - options.tilts[-1], steps[-1] + options.tilts[-1] + 0.5)
    # strength of image edges across every predicted point
    strength = np.zeros((*clear.shape, len(offsets)), np.float32)
    for k, (image, visible) in enumerate(zip(images, clear, strict=True)):
        if not visible.any():  # no leg in the image
            continue
        at = points.pixel[k][visible], points.outward[k][visible]
        strength[k][visible] = gradient_strength(image, *at, offsets, options=options)
    place = place_on_leg(points.along, clear, tubes)
    scores = _by_tilt(strength, place, options.tilts, len(steps), tubes)
    legs = range(tubes.leg.max() + 1)
    total = np.stack([clear[:, tubes.leg == leg].sum(axis=(1, 2)) for leg in legs], axis=1)
    points_of = np.array([max(int((tubes.leg == leg).sum()) * clear.shape[2], 1) for leg in legs])
    scores /= np.maximum(total, 1.0)[..., None, None]
    return _choose(scores, total, total / points_of, steps, options)


def _by_tilt(values: Array, place: Array, tilts: Array, count: int, tubes: TubeList) -> Array:
    """Sums (K, L, tilts, count) over the points of a leg, for each of its shifts and tilts to side
    0.

    values : (K, E, n, steps) at steps outward of each point.
    place : (K, E, n) positions of the points on their legs, -1 to 1.
    tilts : in steps.
    count : number of shifts, fewer than steps and in the middle of them; beyond the steps their
        last value holds.
    """
    towards = np.where((SIDE_SIGNS[tubes.side] > 0)[:, None, None], values, values[..., ::-1])
    room = (values.shape[-1] - count) // 2
    beyond = max(int(np.ceil(tilts[-1])) - room, 0)
    if beyond:
        ends = towards[..., :1], towards[..., -1:]
        wide = [np.broadcast_to(end, (*end.shape[:-1], beyond)) for end in ends]
        towards = np.concatenate([wide[0], towards, wide[1]], axis=-1)
    # windows of all shifts; a tilt selects each point's window
    shifted = sliding_window_view(towards.reshape(-1, towards.shape[-1]), count, axis=-1)
    row = np.arange(place.size).reshape(place.shape)
    legs, first_edge = tubes.by_leg
    out = np.zeros((len(values), tubes.leg.max() + 1, len(tilts), count), values.dtype)
    for i, tilt in enumerate(tilts):
        first = np.rint(tilt * place).astype(int) + (room + beyond)
        by_edge = shifted[row, first].sum(axis=2)
        out[:, legs, i] = np.add.reduceat(by_edge, first_edge, axis=1)
    return out


def gradient_strength(
    image: Integers,
    pixel: Array,
    outward: Array,
    offsets: Array,
    options: LegSearchOptions = LEG_SEARCH_OPTIONS,
) -> Array:
    """Strength (n, offsets), 0 to 1, of image edges across predicted ones.

    pixel, outward : (n, 2) of points on the predicted edges.
    offsets : consecutive whole pixels outward.
    """
    import cv2

    wide = np.concatenate([[offsets[0] - 1], offsets, [offsets[-1] + 1]])
    level = np.sqrt(255.0 * levels_at(image, *_outward_of(pixel, outward, wide), blur=options.blur))
    slope = np.abs(level[:, 2:] - level[:, :-2]) / 2
    about = np.ones((1, 2 * options.peak_half_width + 1), np.uint8)
    sharp = slope / np.maximum(cv2.dilate(slope, about), 1e-6)
    return (1 + sharp) / 2 * slope**2 / (slope**2 + options.gradient_half**2)


def _outward_of(pixel: Array, outward: Array, offsets: Array) -> Iterator[Array]:
    """Columns and rows (n, offsets) of pixels (n, 2) displaced along unit vectors (n, 2), single
    precision.
    """
    # a small matrix product for each coordinate: eight times as fast as broadcasting
    away = np.stack([np.ones(len(offsets)), offsets]).astype(np.float32)
    for k in (0, 1):
        yield np.stack([pixel[:, k], outward[:, k]], axis=1).astype(np.float32) @ away


def place_on_leg(along: Array, clear: Booleans, tubes: TubeList) -> Array:
    """Position (K, E, n) of every point between the ends of its leg's visible part, -1 to 1."""
    legs, first_edge = tubes.by_leg
    ends: list[Array] = []
    for reduce, beyond in ((np.minimum, np.inf), (np.maximum, -np.inf)):
        of_edge = reduce.reduce(np.where(clear, along, beyond), axis=2)
        ends.append(reduce.reduceat(of_edge, first_edge, axis=1))
    in_view = ends[0] <= ends[1]
    low, high = (np.where(in_view, end, 0.0) for end in ends)
    middle, half = (high + low) / 2, np.where(in_view, np.maximum((high - low) / 2, 1e-3), np.inf)
    which = np.searchsorted(legs, tubes.leg)
    middle, half = (v[:, which, None] for v in (middle, half))
    return np.clip(np.nan_to_num((along - middle) / half), -1, 1)


def _choose(
    scores: Array, total: Array, share: Array, steps: Array, options: LegSearchOptions
) -> LegPlaces:
    """Best shift and tilt of each leg from scores (K, L, tilts, steps).

    total, share : (K, L) number and share of visible points.
    steps : shifts, px.
    """
    flat = scores.reshape(*scores.shape[:2], -1)
    tilt, step = np.unravel_index(np.argmax(flat, axis=-1), scores.shape[2:])
    best = flat.max(axis=-1)
    # ambiguous: a rival far from the best, too few points, or the best at the end of the range
    away = np.abs(steps - steps[step][..., None]) >= options.rival_away
    rival = np.where(away, scores.max(axis=2), 0.0).max(axis=-1)
    inside = np.abs(steps[step]) < steps[-1]
    clear = (total >= options.fewest) & (rival < options.rival_share * best) & inside
    return LegPlaces(steps[step], options.tilts[tilt], best, share, clear)


@dataclass(frozen=True)
class StationEdges:
    """Edges from a measurement pass, of one station or, before it is split, of several.

    points, point_edge : (M, 2) px of the inliers, and (M,) the edge in ``edges`` that each
        supports.
    blur : px, of the image edges; NaN where not estimated.
    shift : median distance (px) of the edges from their predictions.
    """

    edges: EdgeSet
    rejected: tuple[Rejection, ...]
    points: Array
    point_edge: Integers
    blur: float
    shift: float

    def of_station(self, station: int) -> StationEdges:
        """Edges of one station; blur and shift are unchanged."""
        mine = self.edges.station == station
        at, number = mine[self.point_edge], np.cumsum(mine) - 1
        return replace(
            self,
            edges=self.edges.select(mine),
            rejected=tuple(r for r in self.rejected if r.station == station),
            points=self.points[at],
            point_edge=number[self.point_edge[at]],
        )

    def unbinned(self, count: int) -> StationEdges:
        """Edges in full-size images from those in binned ones.

        Points and derivatives by the camera's parameters are converted to full-size pixels. Pixel
        quantities of an edge itself stay in binned pixels.
        """
        if count == 1:
            return self
        by_intrinsics = self.edges.by_intrinsics.copy()
        by_intrinsics[..., PIXEL_PARAMETERS] /= count  # as in `Camera.binned`
        edges = replace(self.edges, by_intrinsics=by_intrinsics)
        return replace(self, edges=edges, points=(self.points + 0.5) * count - 0.5)


def search(
    images: StationImages,
    machine: Machine,
    T_camera_base: Array,
    poses: Array,
    reach: float | None = None,
    options: LegSearchOptions = LEG_SEARCH_OPTIONS,
) -> StationEdges:
    """:func:`search_stations` for one station's images; poses : T_base_platform (K, 4, 4)."""
    return search_stations([Placed(images, T_camera_base, poses)], machine, reach, options=options)[
        0
    ]


def search_stations(
    placed: Sequence[Placed],
    machine: Machine,
    reach: float | None = None,
    done: ImageBatchesInUse | None = None,
    options: LegSearchOptions = LEG_SEARCH_OPTIONS,
) -> list[StationEdges]:
    """Edges of every leg to about a pixel, from shifting each leg as a whole."""
    reach = options.reach if reach is None else reach
    passes: list[StationEdges] = []
    for window in windows(placed):
        passes.append(_searched(window, machine, reach, options))
        if done is not None:
            done(len(window.images))
        del window  # free before the next one is decoded
    every = joined_passes(passes, float("nan"), reach)
    return [every.of_station(one.images.station) for one in placed]


def _searched(
    window: ImageWindow, machine: Machine, reach: float, options: LegSearchOptions
) -> StationEdges:
    """Edges of one window of images by :func:`search_stations`."""
    tubes, points, clear = predicted(window, machine, options.samples, options.clearance)
    places = search_legs(window.images, tubes, points, clear, reach, options=options)
    valid = clear & places.clear[:, tubes.leg][..., None]
    position = places.outward(points, clear, tubes)
    fits = fit_edges(points, position, np.full(position.shape, options.sigma), valid)
    keep = fits.good & places.clear[:, tubes.leg]
    edges = edge_set(points, fits, tubes, window.station, window.configuration, keep)
    hidden, no_place = note("edges.out_of_sight"), note("edges.no_place")
    rejected = [
        Rejection(
            int(window.station[k]),
            int(window.configuration[k]),
            int(leg),
            -1,
            -1,
            why.text,
            why.code,
        )
        for k, leg in zip(*np.nonzero(~places.clear), strict=True)
        for why in [hidden if places.share[k, leg] < options.in_sight else no_place]
        if leg in tubes.leg
    ]
    nowhere = np.zeros((0, 2)), np.zeros(0, dtype=int)
    return StationEdges(edges, tuple(rejected), *nowhere, float("nan"), reach)


def measure(
    images: StationImages,
    machine: Machine,
    T_camera_base: Array,
    poses: Array,
    blur: float | None = None,
    refine_camera: bool = False,
    options: EdgeOptions = EDGE_OPTIONS,
) -> StationEdges:
    """:func:`measure_stations` for one station's images; poses : T_base_platform (K, 4, 4)."""
    blur_by_station = {} if blur is None else {images.station: blur}
    placed = Placed(images, T_camera_base, poses)
    return measure_stations([placed], machine, blur_by_station, refine_camera, options=options)[0]


def measure_stations(
    placed: Sequence[Placed],
    machine: Machine,
    blur: BlurByStation,
    refine_camera: bool = False,
    done: ImageBatchesInUse | None = None,
    options: EdgeOptions = EDGE_OPTIONS,
) -> list[StationEdges]:
    """Edges to sub-pixel accuracy, by the shading-aware model of :mod:`pkmcal.observe.profiles`.

    blur : from an earlier measurement pass; for other stations it is estimated from the profiles of
        one window of images, spread over all.
    refine_camera : also compute the edges' derivatives by the camera's parameters.
    """
    # blur of stations with several windows, from images spread over all of them
    numbers = dict(blur)
    for one in placed:
        p = one.images
        if p.station not in numbers and len(p.images) > p.window:
            few = next(windows([one.select(p.spread(p.window))]))
            numbers |= _blur_in(
                _predicted_edges(few, machine, options).across, [p.station], options.profiles
            )
            del few
    passes: list[StationEdges] = []
    shifted: list[Array] = [np.zeros(0)]
    for window in windows(placed):
        # edges window by window; a station's first window may determine its blur
        prediction = _predicted_edges(window, machine, options)
        new = [k for k in np.unique(window.station).tolist() if k not in numbers]
        numbers |= _blur_in(prediction.across, new, options.profiles)
        station_edges, away = _measured(window, prediction, numbers, refine_camera, options)
        passes.append(station_edges.unbinned(window.binning))
        shifted.append(away)
        if done is not None:
            done(len(window.images))
        del prediction, window  # free before the next one is decoded
    every = joined_passes(passes, float("nan"), float("nan"))
    # edges of each station, with its blur and median shift
    away, at = np.concatenate(shifted), every.edges.station[every.point_edge]
    out: list[StationEdges] = []
    for one in placed:
        station = one.images.station
        own = away[at == station]
        station_blur = numbers.get(station, options.profiles.usual_blur)
        middle = float(np.median(own)) if own.size else 0.0
        out.append(replace(every.of_station(station), blur=station_blur, shift=middle))
    return out


def _blur_in(
    across: Profiles, stations: Sequence[int], options: ProfileOptions
) -> dict[int, float]:
    """Blur (px) by station, estimated from its profiles; the usual one without profiles."""
    out: dict[int, float] = {}
    for station in stations:
        own = np.flatnonzero(across.station == station)
        some = own.size > 0
        out[station] = estimate_blur(across.select(own)) if some else options.usual_blur
    return out


def joined_passes(passes: Sequence[StationEdges], blur: float, shifted: float) -> StationEdges:
    """Concatenation of the windows of one station, or of several stations."""
    first = np.cumsum([0, *(len(station_edges.edges) for station_edges in passes)])[:-1]
    number = [station_edges.point_edge + k for station_edges, k in zip(passes, first, strict=True)]
    return StationEdges(
        edges=concatenate([EdgeSet.empty(), *(station_edges.edges for station_edges in passes)]),
        rejected=tuple(
            rejection for station_edges in passes for rejection in station_edges.rejected
        ),
        points=np.concatenate(
            [np.zeros((0, 2)), *(station_edges.points for station_edges in passes)]
        ),
        point_edge=np.concatenate([np.zeros(0, dtype=int), *number]),
        blur=blur,
        shift=shifted,
    )


@dataclass(frozen=True)
class _PredictedEdges:
    """Predicted positions along edges in one window, and the profiles at the clear ones.

    full : (K, E, segments) segments with a profile.
    """

    tubes: TubeList
    places: EdgePoints
    full: Booleans
    across: Profiles


def _predicted_edges(
    window: ImageWindow, machine: Machine, options: EdgeOptions
) -> _PredictedEdges:
    """Middles of all segments, and the mean profiles of those with enough clear points."""
    samples = options.segments * options.segment_points
    tubes, points, clear = predicted(window, machine, samples, options.clearance)
    middles = np.arange(options.segments) * options.segment_points + options.segment_points // 2
    per_point = (f.name for f in fields(points) if f.name != "normal")
    places = replace(points, **{name: getattr(points, name)[:, :, middles] for name in per_point})
    half_width = places.gain * machine.values[tubes.radius][:, None]
    return _PredictedEdges(
        tubes, places, *_segment_profiles(window, points, clear, half_width, options)
    )


def _measured(
    window: ImageWindow,
    prediction: _PredictedEdges,
    blur: BlurByStation,
    refine_camera: bool,
    options: EdgeOptions,
) -> tuple[StationEdges, Array]:
    """Edges of one window by :func:`measure_stations`, and the distance (px) of each inlier from
    its prediction.
    """
    tubes, places, full = prediction.tubes, prediction.places, prediction.full
    # positions in the profiles, each near its leg's edge
    across, highlight = profiles.without_highlights(prediction.across, blur)
    curves = profiles.residual_curves(across, blur)
    about = _leg_lines(
        profiles.shift_log_likelihoods(across, curves), places.along, full, tubes, options
    )
    at = profiles.locate(across, curves, about)
    position, sigma, valid = np.zeros(full.shape), np.ones(full.shape), full.copy()
    position[full], sigma[full], valid[full] = at.position, at.sigma, at.valid & ~highlight
    # planes through the positions, and their measurements
    fits = fit_edges(places, position, sigma, valid, options.fit)
    by_camera = window.camera.project_jacobians(places.point)[1] if refine_camera else None
    names = window.station, window.configuration
    edges = edge_set(places, fits, tubes, *names, fits.good, by_camera)
    lamps = full.copy()
    lamps[full] = at.valid & highlight
    # rejections, and pixels of the inliers
    rejected = _rejections(*names, tubes, full, valid, lamps, fits, options.fit.fewest)
    k, e, s = np.nonzero(fits.used & fits.good[..., None])
    xy = places.pixel[k, e, s] + position[k, e, s, None] * places.outward[k, e, s]
    number = np.cumsum(fits.good.ravel()).reshape(fits.good.shape) - 1
    station_edges = StationEdges(edges, rejected, xy, number[k, e], float("nan"), float("nan"))
    return station_edges, np.abs(position[k, e, s])


def predicted(
    window: ImageWindow,
    machine: Machine,
    samples: int,
    clearance: float = EdgeOptions.clearance,
) -> tuple[TubeList, EdgePoints, Booleans]:
    """Edges of all tubes, with ``samples`` points on each, and the mask (K, E, n) of unobstructed
    ones.

    clearance : px from the outlines of other legs.
    """
    tubes = tubes_of(machine)
    legs = legs_in_camera(machine, window.T_camera_base, window.poses, window.joints)
    points = edge_points(machine, window.camera, legs, tubes, samples)
    clear = unobstructed(machine, window.camera, legs, tubes, points, clearance)
    return tubes, points, clear


def _segment_profiles(
    window: ImageWindow,
    points: EdgePoints,
    clear: Booleans,
    half_width: Array,
    options: EdgeOptions,
) -> tuple[Booleans, Profiles]:
    """Mean profiles over the clear points of each segment.

    Returns the mask (K, E, segments) of segments with enough clear points, and their profiles.
    """
    visible = _by_segment(clear, options)
    full = visible.sum(axis=-1) >= options.fewest_share * visible.shape[-1]
    # profiles around each point, about one per pixel
    step = np.diff(_by_segment(points.pixel, options)[full], axis=1)
    pitch = np.fmax.reduce(np.hypot(step[..., 0], step[..., 1]), axis=1)  # px from point to point
    pitch = np.nan_to_num(pitch, nan=options.most_profiles)  # NaN: no neighbour has an image
    each = np.clip(np.ceil(pitch), options.fewest_profiles, options.most_profiles).astype(int)
    count = each * visible[full].sum(axis=-1)
    # position and direction of each profile
    which, at = _between(visible[full], each)
    pixel = window.camera.project(_on_edges(points, full, which, at, options))
    outward = _by_segment(points.outward.astype(np.float32), options)[full].reshape(-1, 2)[which]
    # sums of the profiles of each segment, image by image
    offsets = options.profiles.sampled_offsets
    explained = len(options.profiles.profile_offsets)
    total = np.empty((len(count), len(offsets)), np.float32)
    clipped = np.zeros((len(count), explained), dtype=bool)
    response = window.response
    clipped_from = light_of_levels(response)[options.profiles.saturated]
    first = np.concatenate([[0], np.cumsum(count)])  # profile of each segment
    parts = pairwise(np.cumsum([0, *full.sum(axis=(1, 2))]))
    for image, (start, end) in zip(window.images, parts, strict=True):
        taken, begin = slice(first[start], first[end]), first[start:end] - first[start]
        across = _outward_of(pixel[taken], outward[taken], offsets)
        grey = levels_at(image, *across, cubic=True, response=response)
        np.add.reduceat(grey, begin, axis=0, out=total[start:end])
        if grey.max(initial=0.0) >= clipped_from:
            bright = grey[:, -explained:] >= clipped_from
            np.logical_or.reduceat(bright, begin, axis=0, out=clipped[start:end])
    mean = total / count[:, None].astype(np.float32)
    station = window.station[np.nonzero(full)[0]]
    return full, Profiles.of(mean, clipped, count, half_width[full], station, options.profiles)


def _by_segment(values: Array | Booleans, options: EdgeOptions) -> Any:
    """Values (K, E, segments, points of a segment, ...) from the points' (K, E, n, ...)."""
    return values.reshape(*values.shape[:2], options.segments, -1, *values.shape[3:])


def _between(visible: Booleans, each: Integers) -> tuple[Integers, Array]:
    """Distribution of profiles around the visible points of segments.

    Returns for each of M profiles the index (M,) of its point, counted over all segments, and its
    position (M,) relative to that point, -1/2 to 1/2 of the distance to the next.

    visible : (N, points of one segment).
    each : (N,) profiles around a point.
    """
    times = (visible * each[:, None]).ravel()
    which = np.repeat(np.arange(times.size), times)
    turn = np.arange(len(which)) - np.repeat(np.cumsum(times) - times, times)
    return which, ((turn + 0.5) / each[which // visible.shape[1]] - 0.5).astype(np.float32)


def _on_edges(
    points: EdgePoints, full: Booleans, which: Integers, at: Array, options: EdgeOptions
) -> Array:
    """Points (M, 3) of profiles on the edges, camera frame, single precision.

    Points of an edge are evenly spaced on a line in space, so positions in between are interpolated
    there; the direction of the profiles hardly changes from one point to the next.

    which, at : (M,) from :func:`_between` for the segments in ``full``.
    """
    k, e, _ = np.nonzero(full)
    step = (points.point[k, e, 1] - points.point[k, e, 0]).astype(np.float32)
    here = _by_segment(points.point.astype(np.float32), options)[full]
    segment = which // here.shape[1]
    here = here.reshape(-1, 3)
    return of_components(*(here[which, c] + at * step[segment, c] for c in range(3)))


def _leg_lines(
    likelihood: Array, along: Array, full: Booleans, tubes: TubeList, options: EdgeOptions
) -> Array:
    """Position (N,), px outward, of each profile's edge according to all profiles of its leg.

    A leg is shifted and tilted as a whole: a highlight beside one edge may be likelier there than
    the edge, but not for all edges.

    likelihood : (N, shifts) log-likelihoods of the profiles in ``full`` (K, E, n).
    """
    every = np.zeros((*full.shape, likelihood.shape[-1]), np.float32)
    every[full] = likelihood
    place = place_on_leg(along, full, tubes)
    steps = options.profiles.shifts
    tilts = options.tilts / (steps[1] - steps[0])
    score = _by_tilt(every, place, tilts, len(steps), tubes)
    best = score.reshape(*score.shape[:2], -1).argmax(axis=-1)
    tilt, shift = np.unravel_index(best, score.shape[2:])
    shift, tilt = (v[:, tubes.leg][..., None] for v in (steps[shift], options.tilts[tilt]))
    return (SIDE_SIGNS[tubes.side][:, None] * (shift + tilt * place))[full]


def _rejections(
    station: Integers,
    configuration: Integers,
    tubes: TubeList,
    full: Booleans,
    valid: Booleans,
    lamps: Booleans,
    fits: EdgeFits,
    fewest: int,
) -> tuple[Rejection, ...]:
    """Rejections of edges without a measurement, each with its reason.

    station, configuration : (K,).
    full, valid, lamps : (K, E, n) segments with a profile, with an edge, and with a highlight.
    fewest : positions from which an edge is fitted.
    """
    k, e = np.nonzero(~fits.good)
    visible, in_view, mirrored = (where[k, e].sum(axis=-1) for where in (full, valid, lamps))
    few = in_view < fewest
    lamp = few & (in_view + mirrored >= fewest)
    reasons = (
        note("edges.out_of_sight"),
        note("edges.highlight"),
        note("edges.too_little"),
        note("edges.not_one_edge"),
    )
    why = np.select([visible == 0, lamp, few], [0, 1, 2], 3)
    text, code = (
        np.array(part)[why] for part in zip(*((r.text, r.code) for r in reasons), strict=True)
    )
    names = station[k], configuration[k], tubes.leg[e], tubes.tube[e], tubes.side[e], text, code
    return tuple(Rejection(*name) for name in zip(*(v.tolist() for v in names), strict=True))
