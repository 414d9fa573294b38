"""Each leg found in each photograph: its sideways shift and tilt from where it was predicted.

The drawing's errors leave predictions a few pixels off, more than the distance to highlights,
shadows and neighbours. But all edges of one leg, two to a tube, move together: so the leg is
shifted and tilted as a whole until the grey-level gradients under all its edges are strongest.
A highlight imitates one edge; four at the right distances it does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import SIDE_SIGNS
from pkmcal.observe.predict import EdgePoints, TubeList

REACH = 10.0
"""Pixels to each side that a leg is looked for: 2 mm of drawing error at 0.9 px/mm, several
times over, and what the station's pose leaves."""
TILTS = np.arange(-4.0, 4.5, 1.0)
"""Shifts of a leg's ends against its middle that are tried, px."""
GRADIENT_HALF = 12.0
"""Grey levels per pixel at which an edge counts half of a strong one: strong highlights must not
outvote three weak edges."""
RIVAL = 0.93
"""A second place with this share of the best one's score makes a leg ambiguous."""
RIVAL_AWAY = 4.0
"""Pixels from the best place at which another one is a rival, not its flank."""
FEWEST_POINTS = 8
"""Edge points (of 12 an edge) without which a leg's place is not looked for."""
SEARCH_SIGMA = 1.0
"""Standard deviation (px) given to edges found this way: one step of the search."""


@dataclass(frozen=True)
class LegPlaces:
    """Where legs were found in photographs, arrays (K, L).

    shift, tilt : px sideways, towards side 0, of the leg's middle, and of its visible end near
    B against the middle. score : 0..1. share : of the leg's edge points that can be seen.
    clear : False where the leg is hidden or its place ambiguous.
    """

    shift: Array
    tilt: Array
    score: Array
    share: Array
    clear: Booleans

    def outward(self, points: EdgePoints, seen: Booleans, tubes: TubeList) -> Array:
        """Outward positions (K, E, n) px of all edges' points that these places mean."""
        along = place_on_leg(points.along, seen, tubes)
        shift, tilt = (v[:, tubes.leg][..., None] for v in (self.shift, self.tilt))
        return SIDE_SIGNS[tubes.side][:, None] * (shift + tilt * along)


def sample(images: list[Integers], pixel: Array, cubic: bool = True) -> Array:
    """Grey levels of K images at pixels (K, E, ..., 2): (K, E, ...), interpolated."""
    import cv2

    kind = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    # one row an edge: cv2.remap takes at most 32767 rows and columns
    flat = np.nan_to_num(pixel.reshape(*pixel.shape[:2], -1, 2), nan=-9.0).astype(np.float32)
    out = np.empty(flat.shape[:3], dtype=np.float32)
    for image, at, grey in zip(images, flat, out, strict=True):
        x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        # floats, because cv2 rounds what it interpolates in bytes to whole grey levels
        levels = image.astype(np.float32)
        cv2.remap(levels, x, y, kind, dst=grey, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(pixel.shape[:-1])


def search_legs(
    images: list[Integers], tubes: TubeList, points: EdgePoints, clear: Booleans
) -> LegPlaces:
    """Shift and tilt of every leg in the photographs of one station.

    images : K arrays (height, width), float32 or uint8. points, clear : predictions (K, E, n).
    """
    strength, offsets = gradient_strength(images, points, REACH + TILTS[-1])
    weight = clear.astype(np.float32)
    sign = SIDE_SIGNS[tubes.side]
    steps = np.arange(-REACH, REACH + 0.5)
    legs = range(tubes.leg.max() + 1)
    place = place_on_leg(points.along, clear, tubes)
    scores = np.zeros((len(images), tubes.leg.max() + 1, len(TILTS), len(steps)), np.float32)
    k, e, n = np.ogrid[: clear.shape[0], : clear.shape[1], : clear.shape[2]]
    for i, tilt in enumerate(TILTS):
        at = sign[:, None, None] * (steps + tilt * place[..., None])
        column = np.rint(at - offsets[0]).astype(np.intp)
        value = strength[k[..., None], e[..., None], n[..., None], column]
        # a sum over all edges of a leg, as a matrix product over its edges
        by_edge = np.einsum("kens,ken->kes", value, weight)
        for leg in legs:
            scores[:, leg, i] = by_edge[:, tubes.leg == leg].sum(axis=1)
    total = np.stack([weight[:, tubes.leg == leg].sum(axis=(1, 2)) for leg in legs], axis=1)
    points_of = np.array([max(int((tubes.leg == leg).sum()) * clear.shape[2], 1) for leg in legs])
    scores /= np.maximum(total, 1.0)[..., None, None]
    return _choose(scores, total, total / points_of, steps)


def gradient_strength(
    images: list[Integers], points: EdgePoints, reach: float
) -> tuple[Array, Array]:
    """Strength 0..1 of grey-level edges across the predicted ones, (K, E, n, offsets).

    Also the offsets, whole pixels outward.
    """
    offsets = np.arange(-np.ceil(reach), np.ceil(reach) + 1)
    wide = np.concatenate([[offsets[0] - 1], offsets, [offsets[-1] + 1]])
    pixel = points.pixel[..., None, :] + wide[:, None] * points.outward[..., None, :]
    grey = sample(images, pixel, cubic=False)
    slope = np.abs(grey[..., 2:] - grey[..., :-2]) / 2
    return slope / (slope + GRADIENT_HALF), offsets


def place_on_leg(along: Array, clear: Booleans, tubes: TubeList) -> Array:
    """Place of every point between the ends of its leg's visible part, -1..1; (K, E, n)."""
    place = np.zeros(along.shape)
    for leg in np.unique(tubes.leg):
        mine = tubes.leg == leg
        seen = np.where(clear[:, mine], along[:, mine], np.nan)
        low = np.fmin.reduce(seen, axis=(1, 2), keepdims=True)
        high = np.fmax.reduce(seen, axis=(1, 2), keepdims=True)
        half = np.fmax((high - low) / 2, 1e-3)
        place[:, mine] = np.nan_to_num((along[:, mine] - (high + low) / 2) / half)
    return np.clip(place, -1, 1)


def _choose(scores: Array, total: Array, share: Array, steps: Array) -> LegPlaces:
    """Best shift and tilt of each leg from scores (K, L, tilts, steps)."""
    flat = scores.reshape(*scores.shape[:2], -1)
    tilt, step = np.unravel_index(np.argmax(flat, axis=-1), scores.shape[2:])
    best = flat.max(axis=-1)
    away = np.abs(steps - steps[step][..., None]) >= RIVAL_AWAY
    rival = np.where(away, scores.max(axis=2), 0.0).max(axis=-1)
    inside = np.abs(steps[step]) < REACH
    clear = (total >= FEWEST_POINTS) & (rival < RIVAL * best) & inside
    return LegPlaces(steps[step], TILTS[tilt], best, share, clear)
