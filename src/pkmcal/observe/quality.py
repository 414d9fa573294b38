"""Quality of images on the legs of a localized machine: exposure, blur, occlusion and contrast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.mechanisms import Machine
from pkmcal.observe.grey_levels import levels_at
from pkmcal.observe.image_batches import ImageWindow, Placed, StationImages, windows
from pkmcal.observe.legs import LEG_SEARCH_OPTIONS, LegSearchOptions, predicted, search_legs
from pkmcal.observe.profiles import PROFILE_OPTIONS


@dataclass(frozen=True)
class QualityOptions:
    """Constants of the quality of images."""

    # largest grey level of a black sample, as far from black as a clipped one is from white:
    # shading and edges are lost in noise
    black: int = 255 - PROFILE_OPTIONS.saturated
    # smallest grey level of a clipped sample
    saturated: int = PROFILE_OPTIONS.saturated
    # depths inside an edge at which exposure is sampled, in half widths of the leg
    depths: tuple[float, ...] = (0.25, 0.6, 1.0)
    # extent to each side of an edge of the profiles from which the blur is estimated, px: more
    # than a flank
    reach: float = 8.0
    # spacing of these profiles, px
    pitch: float = 0.5
    # pixels from the steepest point within which a blurred edge attains its full contrast: three
    # times a blur of two
    flank: float = 6.0
    # smallest contrast, in grey levels, of an edge from which the blur is estimated. Its slope, by
    # two samples two steps apart, has the noise of one level times the root of two per pixel; of
    # the contrast C and the largest blur s that is still measured, 1.74 px, it is C / (s sqrt(2
    # pi)). From 31 levels on the blur of one edge is known to a fifth, RELEVANT_FACTOR
    least_contrast: float = 31.0
    # percentile of the edges' widths that is taken as the lens's blur; shading widens the other
    # edges
    percentile: float = 25.0
    # range of distances from an edge, px, over which its two grey levels are averaged: beyond the
    # blur, and before the next feature
    beside: tuple[float, float] = (1.5, 4.0)
    # search of the legs
    search: LegSearchOptions = LEG_SEARCH_OPTIONS


QUALITY_OPTIONS = QualityOptions()


@dataclass(frozen=True)
class Quality:
    """Quality of the K images of one station, with L legs and E edges.

    legs : (K, L) True where a leg was measured; all False where the machine was not localized.
    saturated, black : (K,) share of such samples on the legs or, without legs, of all pixels.
    blur : (K,) standard deviation of the sharper edges, px; NaN where no edge has enough contrast.
    hidden : (K, L) share of a leg's edges behind other legs or outside the image; NaN for legs
        without tubes.
    level, behind : (K, E) grey levels beside each edge, on the leg and on its background, in the
        order of ``tubes_of``; NaN where no point of the edge is visible.
    half_width : (K, E) px of the tube there.
    options : those of the figures.
    """

    legs: Booleans
    saturated: Array
    black: Array
    blur: Array
    hidden: Array = field(default_factory=lambda: np.zeros((0, 0)))
    level: Array = field(default_factory=lambda: np.zeros((0, 0)))
    behind: Array = field(default_factory=lambda: np.zeros((0, 0)))
    half_width: Array = field(default_factory=lambda: np.zeros((0, 0)))
    options: QualityOptions = QUALITY_OPTIONS

    @property
    def contrast(self) -> Array:
        """Grey-level difference (K, E) between each leg and its background."""
        return np.abs(self.level - self.behind)


def quality(
    images: StationImages,
    machine: Machine,
    T_camera_base: Array,
    poses: Array,
    options: QualityOptions = QUALITY_OPTIONS,
) -> Quality:
    """Quality on the legs of one station's images.

    T_camera_base : (4, 4).
    poses : T_base_platform (K, 4, 4), one for each image.
    """
    placed = Placed(images, T_camera_base, poses)
    parts = [_quality(window, machine, options) for window in windows([placed])]
    each = (f.name for f in fields(Quality) if f.name != "options")
    return Quality(
        *(
            np.concatenate([getattr(station_edges, name) for station_edges in parts])
            for name in each
        ),
        options=options,
    )


def _quality(window: ImageWindow, machine: Machine, options: QualityOptions) -> Quality:
    """Quality on the legs in one window of images."""
    # edges found by the search, and the widths of their legs
    tubes, points, clear = predicted(
        window, machine, options.search.samples, options.search.clearance
    )
    places = search_legs(window.images, tubes, points, clear, options=options.search)
    edge = places.outward(points, clear, tubes)[..., None]
    half_width = (points.gain * machine.values[tubes.radius][:, None])[..., None]

    def measure(outward: Array) -> Array:
        pixel = points.pixel[..., None, :] + outward[..., None] * points.outward[..., None, :]
        pairs = zip(window.images, pixel, strict=True)
        return np.stack([levels_at(im, p[..., 0], p[..., 1]) for im, p in pairs])

    # exposure inside the legs, and profiles across the edges
    inside = measure(edge - np.array(options.depths) * half_width)
    offsets = np.arange(-options.reach, options.reach + options.pitch / 2, options.pitch)
    across = measure(edge + offsets).astype(float)
    valid = clear & places.clear[:, tubes.leg][..., None]
    near = (np.abs(offsets) >= options.beside[0]) & (np.abs(offsets) <= options.beside[1])
    hidden = np.full((len(clear), machine.n_legs), np.nan)
    for leg in np.unique(tubes.leg):
        hidden[:, leg] = 1 - clear[:, tubes.leg == leg].mean(axis=(1, 2))
    return Quality(
        legs=places.clear,
        saturated=_share(inside >= options.saturated, clear),
        black=_share(inside <= options.black, clear),
        blur=np.array([_blur(a[f], options) for a, f in zip(across, valid, strict=True)]),
        hidden=hidden,
        level=_middle(across[..., near & (offsets < 0)].mean(axis=-1), clear),
        behind=_middle(across[..., near & (offsets > 0)].mean(axis=-1), clear),
        half_width=_middle(half_width[..., 0], clear),
        options=options,
    )


def unlocalized_quality(
    images: Sequence[Integers], n_legs: int, options: QualityOptions = QUALITY_OPTIONS
) -> Quality:
    """Quality of images in which the machine was not localized: exposure of all pixels."""
    count = len(images)
    shares = np.array(
        [
            (np.mean(image >= options.saturated), np.mean(image <= options.black))
            for image in images
        ],
        dtype=float,
    ).reshape(count, 2)
    return Quality(
        legs=np.zeros((count, n_legs), dtype=bool),
        saturated=shares[:, 0],
        black=shares[:, 1],
        blur=np.full(count, np.nan),
        options=options,
    )


def _middle(values: Array, clear: Booleans) -> Array:
    """Median (K, E) of values (K, E, n) over the clear points; NaN where there are none."""
    some = clear.any(axis=-1)
    out = np.full(some.shape, np.nan)
    out[some] = np.nanmedian(np.where(clear, values, np.nan)[some], axis=-1)
    return out


def _share(is_so: Booleans, clear: Booleans) -> Array:
    """Share (K,) of True samples (K, E, n, depths) among those at clear edge points."""
    count = np.maximum(clear.sum(axis=(1, 2)), 1) * is_so.shape[-1]
    return np.sum(is_so & clear[..., None], axis=(1, 2, 3)) / count


def _blur(profiles: Array, options: QualityOptions) -> float:
    """Blur s (px) from profiles (N, n): a step of contrast C has the slope C / (s sqrt(2 pi)).

    NaN where no profile has enough contrast.
    """
    flank = round(options.flank / options.pitch)
    slope = np.abs(profiles[:, 2:] - profiles[:, :-2]) / (2 * options.pitch)
    # near the middle, so that the profile contains most of the contrast around
    near = slope[:, flank // 2 : -(flank // 2)]
    steepest = near.argmax(axis=1) + flank // 2
    around = steepest[:, None] + 1 + np.arange(-flank, flank + 1)
    around = np.clip(around, 0, profiles.shape[1] - 1)
    contrast = np.ptp(np.take_along_axis(profiles, around, axis=1), axis=1)
    steep = near.max(axis=1)
    use = (contrast > options.least_contrast) & (steep > 0)
    if not use.any():
        return float("nan")
    width = contrast[use] / steep[use] / np.sqrt(2 * np.pi)
    return float(np.percentile(width, options.percentile))
