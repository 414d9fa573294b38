"""Ray-cast images of a scene by any central camera: exact silhouettes, sub-pixel borders, noise.

Rays are cast in bundles of neighbours, (3, bundles, rays). A bundle lies in a narrow cone, and only
shapes with a bounding ball in that cone are tested: the cost of a leg is proportional to its area
in the image. The first hit is lit by the share of the lamp that is visible from the point.

Each pixel is sampled once through its centre. Where the label (shape, face, shadow) of a pixel
differs from a neighbour's, the pixel is sampled again, so that its grey level is the mean over its
area: through its corners if these have the centre's label, because no border that is straight over
a pixel passes between them, and otherwise through points spread over the area. Lens blur, sensor
noise and quantization to 8 bits follow, all linear in the light.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.ranges import default
from pkmcal.simulation.shapes import Shape, turned_components
from pkmcal.simulation.surfaces import Lamp, Lighting, Material, radiance

RAY_BUNDLE_SIDE = 16
"""Pixels along the side of a bundle of neighbouring rays."""
BORDER_PIXEL_SAMPLES = 32
"""Samples in a border pixel. They stand on as many different rows and columns, and are shifted at
random from pixel to pixel: a straight edge is then right to 0.02 px in each row of pixels, and
without bias along the edge, upright edges included."""
LEAST_STEP = 0.004
"""Step in light (about a grey level) below which a border is not sampled again, as in soft shadows.
"""
RAY_BUNDLES_AT_ONCE = 256
"""Bundles processed together: 65 thousand rays, whose arrays fit the processor's cache."""


@dataclass(frozen=True)
class ScenePart:
    """Shape with its surface; ``solid`` parts cast shadows."""

    shape: Shape
    material: Material
    solid: bool = True


@dataclass(frozen=True)
class Scene:
    """Everything that a camera sees, base frame."""

    parts: tuple[ScenePart, ...]
    lighting: Lighting

    def having(self, parts: Sequence[ScenePart]) -> Scene:
        """The scene with further parts."""
        return Scene((*parts, *self.parts), self.lighting)


@dataclass(frozen=True)
class Bounds:
    """Bounding balls of all shapes: centres (3, b), radii (b,), first ball of each shape (p,)."""

    centre: Array
    radius: Array
    first: Integers

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> Bounds:
        """Bounding balls of the shapes, one shape after the other."""
        balls = [shape.balls() for shape in shapes]
        counts = [len(radius) for _, radius in balls]
        return cls(
            np.concatenate([centre for centre, _ in balls], axis=1),
            np.concatenate([radius for _, radius in balls]),
            np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int),
        )

    def reached(self, origin: Array, rays: Array, grow: float = 0.0) -> Booleans:
        """(bundles, p) True where a ray of a bundle may come within ``grow`` (m) of a shape."""
        middle = rays.mean(axis=2)
        middle = middle / np.sqrt(np.einsum("ib,ib->b", middle, middle))
        spread = np.einsum("ibr,ib->br", rays, middle).min(axis=1)
        half = np.arccos(np.clip(spread, -1, 1))
        to_ball = self.centre - origin[:, None]
        distance = np.sqrt(np.einsum("ib,ib->b", to_ball, to_ball))
        cosine = np.einsum("ik,ib->kb", middle, to_ball) / np.maximum(distance, 1e-12)
        radius = self.radius + grow
        width = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1.0))
        # every ray meets a ball round the origin
        width = np.where(distance <= radius, np.pi, width)
        angle = np.arccos(np.clip(cosine, -1, 1))
        # arccos is ill-conditioned near one: a rounding error there is worth 1e-7 rad
        near = angle <= half[:, None] + width + 1e-6
        return np.logical_or.reduceat(near, self.first, axis=1)


def first_hits(
    shapes: Sequence[Shape], bounds: Bounds, origin: Array, rays: Array
) -> tuple[Array, Integers]:
    """Distance (bundles, rays) to the nearest shape, inf if none, and the shape's number, -1 if
    none.
    """
    distance = np.full(rays.shape[1:], np.inf)
    owner = np.full(rays.shape[1:], -1, dtype=np.int16)
    reached = bounds.reached(origin, rays)
    for k, shape in enumerate(shapes):
        rows = np.flatnonzero(reached[:, k])
        if not rows.size:
            continue
        value = shape.enter(origin[:, None], _flat(rays, rows)).reshape(rows.size, -1)
        before = distance[rows]
        closer = value < before
        distance[rows] = np.where(closer, value, before)
        owner[rows] = np.where(closer, np.int16(k), owner[rows])
    return distance, owner


def lamp_visibility(
    parts: Sequence[ScenePart], bounds: Bounds, lamp: Lamp, points: Array, owner: Integers
) -> Array:
    """Share of the lamp (bundles, rays) that surface points (3, bundles, rays) see.

    A convex shape casts no shadow on its own lit points, so the shape ``owner`` of each point is
    skipped; no tolerance at the surface is needed.
    """
    rays = points - lamp.place[:, None, None]
    distance = np.sqrt(np.einsum("ibr,ibr->br", rays, rays))
    rays /= distance
    visible = np.ones(distance.shape)
    reached = bounds.reached(lamp.place, rays, lamp.radius)
    for k, part in enumerate(parts):
        rows = np.flatnonzero(reached[:, k])
        if not (part.solid and rows.size):
            continue
        hidden = part.shape.veil(
            lamp.place, _flat(rays, rows), distance[rows].ravel(), lamp.radius
        ).reshape(rows.size, -1)
        # overlapping parts of one leg hide the same piece of the lamp: the larger share counts
        visible[rows] = np.minimum(visible[rows], np.where(owner[rows] == k, 1.0, 1.0 - hidden))
    return visible


class RayHits(NamedTuple):
    """First hits of rays, (bundles, rays) each.

    light : radiance.
    label : integer that changes at every visible border; it encodes the shape, its face, and
        whether the point is in shadow.
    visible : share of the lamp that is visible from the point.
    """

    light: Array
    label: Integers
    visible: Array


def ray_hits(scene: Scene, bounds: Bounds, origin: Array, rays: Array) -> RayHits:
    """First hits of rays (3, bundles, rays) from an origin (3,)."""
    distance, owner = first_hits([part.shape for part in scene.parts], bounds, origin, rays)
    lost = owner < 0
    points = origin[:, None, None] + np.where(lost, 1.0, distance) * rays
    visible = np.ones(distance.shape)
    for lamp in scene.lighting.lamps:
        if lamp.shadows:
            visible = lamp_visibility(scene.parts, bounds, lamp, points, owner)
    flat, face = points.reshape(3, -1), np.zeros(owner.size, dtype=np.int16)
    for k, at in _by_owner(owner):
        face[at] = scene.parts[k].shape.face(flat[:, at])
    light = light_of(scene, origin, rays, distance, owner, visible)
    label = 6 * owner + 2 * face.reshape(owner.shape) + (visible < 0.5)
    return RayHits(light, np.where(lost, -1, label).astype(np.int16), visible)


def light_of(
    scene: Scene, origin: Array, rays: Array, distance: Array, owner: Integers, visibility: Array
) -> Array:
    """Light (bundles, rays) along rays (3, bundles, rays) from their first hits.

    visibility : share of the lamp that each hit sees.
    """
    flat, far, lit = rays.reshape(3, -1), distance.ravel(), visibility.ravel()
    light = np.zeros(owner.size)
    for k, at in _by_owner(owner):
        part, along = scene.parts[k], flat[:, at]
        points = origin[:, None] + far[at] * along
        light[at] = radiance(part.shape, part.material, points, -along, lit[at], scene.lighting)
        if part.material.polish > 0:
            light[at] += part.material.polish * _mirrored(scene, k, points, -along)
    return light.reshape(owner.shape)


def _by_owner(owner: Integers) -> Iterator[tuple[int, Integers]]:
    """Each shape that any ray hits, with the flat indices of those rays."""
    numbers = owner.ravel()
    order = np.argsort(numbers, kind="stable")
    values, starts = np.unique(numbers[order], return_index=True)
    for k, at in zip(values.tolist(), np.split(order, starts[1:]), strict=True):
        if k >= 0:
            yield k, at


def _mirrored(scene: Scene, number: int, points: Array, to_camera: Array) -> Array:
    """Light (n,) that a polished shape's points (3, n) reflect towards the camera.

    One reflection: the first hit among the other shapes, fully lit and itself not reflecting.
    """
    n = scene.parts[number].shape.normal(points)
    d = 2 * np.einsum("in,in->n", n, to_camera) * n - to_camera
    nearest, owner = np.full(points.shape[1], np.inf), np.full(points.shape[1], -1)
    for k, part in enumerate(scene.parts):
        if k != number:  # a convex shape does not reflect itself
            values = part.shape.enter(points, d)
            owner = np.where(values < nearest, k, owner)
            nearest = np.minimum(values, nearest)
    light, lit = np.zeros(points.shape[1]), np.ones(points.shape[1])
    for k in np.unique(owner[owner >= 0]):
        at, part = np.flatnonzero(owner == k), scene.parts[k]
        met = points[:, at] + nearest[at] * d[:, at]
        light[at] = radiance(part.shape, part.material, met, -d[:, at], lit[at], scene.lighting)
    return light


def _flat(rays: Array, rows: Integers) -> Array:
    """Rays of some bundles as (3, n); a view if all bundles are selected."""
    wanted = rays if rows.size == rays.shape[1] else rays[:, rows]
    return wanted.reshape(3, -1)


@dataclass(frozen=True)
class Sensor:
    """Lens blur and sensor.

    blur : standard deviation of the point spread, px.
    exposure : grey levels for light 1.
    read_noise : grey levels.
    shot_noise : variance for each grey level; the noise at level g has the variance read_noise^2 +
        shot_noise g.
    """

    blur: float = default("simulate", "blur")
    exposure: float = 230.0
    read_noise: float = default("simulate", "noise")
    shot_noise: float = 0.012


@dataclass(frozen=True)
class PixelRays:
    """Rays of a camera, computed once: (3, H, W) through pixel centres and (3, H+1, W+1) through
    pixel corners, camera frame; NaN for pixels outside the field of view.
    """

    centre: Array
    corner: Array

    @classmethod
    def of(cls, camera: Camera) -> PixelRays:
        """Rays through all pixel centres and corners."""
        width, height = camera.image_size
        return cls(
            _rays(camera, np.arange(width) * 1.0, np.arange(height) * 1.0),
            _rays(camera, np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5),
        )


def render_light(
    scene: Scene, view: PixelRays, T_camera_base: Array, rng: np.random.Generator
) -> Array:
    """Light (H, W) on each pixel, mean over the pixel's area, before blur; 1 is white."""
    rot = T_camera_base[:3, :3].T
    origin = -rot @ T_camera_base[:3, 3]
    bounds = Bounds.of([part.shape for part in scene.parts])
    blind = np.isnan(view.centre[0])
    hits = _through_centres(scene, bounds, origin, rot, view, blind)
    light = hits.light
    border = _borders(hits.label, light) & ~blind
    light[border] = _over_area(scene, bounds, origin, rot, view, border, hits, rng)
    light[blind] = 0.0
    return light


def sensor_image(light: Array, sensor: Sensor, rng: np.random.Generator) -> Integers:
    """8-bit image (H, W) of the light on each pixel."""
    from scipy.ndimage import gaussian_filter

    level = light * sensor.exposure
    if sensor.blur > 0:
        level = gaussian_filter(level, sensor.blur, mode="nearest", truncate=5.0)
    sigma = np.sqrt(sensor.read_noise**2 + sensor.shot_noise * np.maximum(level, 0.0))
    level = level + sigma * rng.standard_normal(level.shape)
    return np.clip(np.rint(level), 0, 255).astype(np.uint8)


def _rays(camera: Camera, x: Array, y: Array) -> Array:
    """(3, len(y), len(x)) rays, computed in strips: lens models use much memory for each pixel."""
    out = np.empty((3, y.size, x.size))
    for rows in np.array_split(np.arange(y.size), max(1, y.size * x.size // 30_000)):
        u, v = np.meshgrid(x, y[rows])
        out[:, rows] = np.moveaxis(camera.ray(np.stack([u, v], axis=-1)), -1, 0)
    return out


def _through_centres(
    scene: Scene, bounds: Bounds, origin: Array, rot: Array, view: PixelRays, blind: Booleans
) -> RayHits:
    """Hits of one ray through each pixel's centre, (H, W); undefined in blind pixels."""
    shape = blind.shape
    light, label = np.zeros(blind.size), np.full(blind.size, -2, dtype=np.int16)
    visible = np.ones(blind.size)
    pixels = _tiles(*shape)
    seeing = ~blind.ravel()[pixels].all(axis=1)
    rays = view.centre.reshape(3, -1)
    for rows in _chunks(pixels[seeing]):
        d = _seeing(rays[:, rows])
        light[rows], label[rows], visible[rows] = ray_hits(
            scene, bounds, origin, turned_components(rot, d)
        )
    label[blind.ravel()] = -2
    return RayHits(light.reshape(shape), label.reshape(shape), visible.reshape(shape))


def _over_area(
    scene: Scene, bounds: Bounds, origin: Array, rot: Array, view: PixelRays, border: Booleans,
    hits: RayHits, rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Mean light (n,) over the area of each border pixel, in the order of the mask.

    hits : (H, W) of the rays through the pixels' centres. Where the lamp is entirely visible from a
        pixel and all its neighbours, or entirely hidden from all of them, no shadow ray is cast for
        the samples between; this holds for most borders.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    width, shapes = border.shape[1], [part.shape for part in scene.parts]
    wanted = np.flatnonzero(border)
    # neighbours together, for narrow bundles
    order = np.lexsort((wanted % width // RAY_BUNDLE_SIDE, wanted // width // RAY_BUNDLE_SIDE))
    at = wanted[order]
    offsets = (_pattern()[None] + rng.random((at.size, 1, 2))) % 1.0
    corner = view.corner.reshape(3, -1)
    first = at // width * (width + 1) + at % width
    label, around = _through_corners(scene, bounds, origin, rot, corner, first, width)
    # light quadratic over the pixel: its mean is the centre's plus a third of the corners' excess
    out = hits.light.ravel()[at]
    bend = (around.mean(axis=1) - out) / 3
    out += bend
    # pixels whose corners have the centre's label need no further samples
    whole = np.all(label == hits.label.ravel()[at, None], axis=1) & (np.abs(bend) < LEAST_STEP)
    visible = hits.visible
    same = (maximum_filter(visible, 3) == minimum_filter(visible, 3)).ravel()[at]
    # random samples over the area of the others; shadows are cast only where the lamp's share
    # varies
    for valid in (True, False):
        part = np.flatnonzero(~whole & (same == valid))
        for rows in _chunks(_grouped(part, RAY_BUNDLE_SIDE)):
            fx, fy = offsets[rows][..., 0], offsets[rows][..., 1]
            c = [corner[:, first[rows] + s][..., None] for s in (0, 1, width + 1, width + 2)]
            d = (c[0] * (1 - fx) + c[1] * fx) * (1 - fy) + (c[2] * (1 - fx) + c[3] * fx) * fy
            # at the rim of the field a corner may have no ray although the centre has one
            if not all(np.isfinite(one).all() for one in c):
                centre = view.centre.reshape(3, -1)[:, at[rows]][..., None]
                d = np.where(np.isfinite(d).all(axis=0), d, centre)
            d /= np.sqrt(np.einsum("i...,i...->...", d, d))
            d = turned_components(rot, d.reshape(3, rows.shape[0], -1))
            if valid:
                lit = np.repeat(visible.ravel()[at[rows]], BORDER_PIXEL_SAMPLES, axis=1)
                light = light_of(scene, origin, d, *first_hits(shapes, bounds, origin, d), lit)
            else:
                light = ray_hits(scene, bounds, origin, d).light
            out[rows] = light.reshape(*rows.shape, BORDER_PIXEL_SAMPLES).mean(axis=-1)
    result = np.empty(at.size)
    result[order] = out
    return result


def _through_corners(
    scene: Scene, bounds: Bounds, origin: Array, rot: Array, corner: Array, first: Integers,
    width: int,
) -> tuple[Integers, Array]:  # fmt: skip
    """Labels and light (n, 4) at the corners of pixels; label -2 for a corner without a ray.

    corner : (3, (H + 1) (W + 1)) rays. first : (n,) index of each pixel's upper left corner.
    """
    # each corner once, in the order of the first pixel that has it
    numbers, begins, which = np.unique(
        first[:, None] + (0, 1, width + 1, width + 2), return_index=True, return_inverse=True
    )
    order = np.argsort(begins, kind="stable")
    seeing = order[np.isfinite(corner[:, numbers[order]]).all(axis=0)]
    label, light = np.full(numbers.size, -2, dtype=np.int16), np.zeros(numbers.size)
    for rows in _chunks(_grouped(seeing, RAY_BUNDLE_SIDE * RAY_BUNDLE_SIDE)):
        value = ray_hits(scene, bounds, origin, turned_components(rot, corner[:, numbers[rows]]))
        label[rows], light[rows] = value.label, value.light
    which = which.reshape(-1, 4)
    return label[which], light[which]


def _grouped(numbers: Integers, size: int) -> Integers:
    """Numbers in rows of this size; the last number is repeated until its row is full."""
    if not numbers.size:
        return numbers.reshape(0, size)
    full = np.arange(numbers.size + -numbers.size % size).clip(max=numbers.size - 1)
    return numbers[full].reshape(-1, size)


def _pattern() -> Array:
    """(BORDER_PIXEL_SAMPLES, 2) Hammersley points in the unit square: each row and column once."""
    k = np.arange(BORDER_PIXEL_SAMPLES)
    bits = BORDER_PIXEL_SAMPLES.bit_length() - 1
    mirrored = sum(((k >> b) & 1) << (bits - 1 - b) for b in range(bits))
    return np.stack(
        [(k + 0.5) / BORDER_PIXEL_SAMPLES, (mirrored + 0.5) / BORDER_PIXEL_SAMPLES], axis=-1
    )


def _borders(label: Integers, light: Array) -> Booleans:
    """(H, W) pixels with a neighbour, diagonals included, of another label and light."""
    border = np.zeros(label.shape, dtype=bool)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = (slice(0, label.shape[0] - dy), slice(max(0, -dx), label.shape[1] - max(0, dx)))
        there = (slice(dy, None), slice(max(0, dx), label.shape[1] - max(0, -dx)))
        differs = label[here] != label[there]
        differs &= np.abs(light[here] - light[there]) > LEAST_STEP
        border[here] |= differs
        border[there] |= differs
    return border


def _tiles(height: int, width: int) -> Integers:
    """Pixel indices (tiles, pixels of one) of square tiles; the last tiles repeat the border's
    pixels.
    """
    side = RAY_BUNDLE_SIDE
    y = np.arange(height + -height % side).clip(max=height - 1).reshape(-1, side)
    x = np.arange(width + -width % side).clip(max=width - 1).reshape(-1, side)
    return (y[:, None, :, None] * width + x[None, :, None, :]).reshape(-1, side * side)


def _chunks(rows: Integers) -> list[Integers]:
    return [rows[k : k + RAY_BUNDLES_AT_ONCE] for k in range(0, len(rows), RAY_BUNDLES_AT_ONCE)]


def _seeing(d: Array) -> Array:
    """Rays (3, tiles, n), with NaN rays replaced by a valid ray of the same tile."""
    good = np.isfinite(d).all(axis=0)
    if good.all():
        return d
    stand_in = np.take_along_axis(d, np.argmax(good, axis=1)[None, :, None], axis=2)
    return np.where(good, d, stand_in)
