"""Ray casting: which shape each ray meets first, and how much of the lamp each point sees.

Rays come in bundles of neighbours, (3, bundles, rays). A bundle lies in a narrow cone, and only
shapes with a bounding ball in that cone are tried: a leg costs what it covers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.simulation.shapes import Shape
from pkmcal.simulation.surfaces import Lamp, Lighting, Material, radiance


@dataclass(frozen=True)
class Part:
    """A shape with its surface; ``solid`` ones cast shadows."""

    shape: Shape
    material: Material
    solid: bool = True


@dataclass(frozen=True)
class Scene:
    """Everything that a camera sees, base frame."""

    parts: tuple[Part, ...]
    lighting: Lighting


@dataclass(frozen=True)
class Bounds:
    """Bounding balls of all shapes: centres (3, b), radii (b,), first ball of each shape (p,)."""

    centre: Array
    radius: Array
    first: Integers

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> Bounds:
        """The shapes' own balls in a row."""
        balls = [shape.balls() for shape in shapes]
        counts = [len(radius) for _, radius in balls]
        return cls(
            np.concatenate([centre for centre, _ in balls], axis=1),
            np.concatenate([radius for _, radius in balls]),
            np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int),
        )

    def reached(self, origin: Array, rays: Array, grow: float = 0.0) -> Booleans:
        """(bundles, p) True where a ray of a bundle may come within ``grow`` of a shape."""
        middle = rays.mean(axis=2)
        middle = middle / np.sqrt(np.einsum("ib,ib->b", middle, middle))
        spread = np.einsum("ibr,ib->br", rays, middle).min(axis=1)
        half = np.arccos(np.clip(spread, -1, 1))
        to_ball = self.centre - origin[:, None]
        distance = np.sqrt(np.einsum("ib,ib->b", to_ball, to_ball))
        cosine = np.einsum("ik,ib->kb", middle, to_ball) / np.maximum(distance, 1e-12)
        radius = self.radius + grow
        width = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-12), 1.0))
        # a ball round the origin is met by every ray
        width = np.where(distance <= radius, np.pi, width)
        angle = np.arccos(np.clip(cosine, -1, 1))
        # arccos is coarse near one: a rounding error there is worth 1e-7 rad
        near = angle <= half[:, None] + width + 1e-6
        return np.logical_or.reduceat(near, self.first, axis=1)


def first_hits(
    shapes: Sequence[Shape], bounds: Bounds, origin: Array, rays: Array
) -> tuple[Array, Integers]:
    """Distance (bundles, rays) to the nearest shape, inf where none, and its number, -1."""
    distance = np.full(rays.shape[1:], np.inf)
    owner = np.full(rays.shape[1:], -1, dtype=np.int16)
    reached = bounds.reached(origin, rays)
    for k, shape in enumerate(shapes):
        rows = np.flatnonzero(reached[:, k])
        if not rows.size:
            continue
        found = shape.enter(origin, _flat(rays, rows)).reshape(rows.size, -1)
        before = distance[rows]
        closer = found < before
        distance[rows] = np.where(closer, found, before)
        owner[rows] = np.where(closer, np.int16(k), owner[rows])
    return distance, owner


def lamp_seen(
    parts: Sequence[Part], bounds: Bounds, lamp: Lamp, points: Array, owner: Integers
) -> Array:
    """Part of the lamp (bundles, rays) that surface points (3, bundles, rays) see.

    A convex shape does not shadow its own lit points, so ``owner`` is left out; that needs no
    tolerance at the surface.
    """
    rays = points - lamp.place[:, None, None]
    distance = np.sqrt(np.einsum("ibr,ibr->br", rays, rays))
    rays = rays / distance
    seen = np.ones(distance.shape)
    reached = bounds.reached(lamp.place, rays, lamp.radius)
    for k, part in enumerate(parts):
        rows = np.flatnonzero(reached[:, k])
        if not (part.solid and rows.size):
            continue
        hidden = part.shape.veil(
            lamp.place, _flat(rays, rows), distance[rows].ravel(), lamp.radius
        ).reshape(rows.size, -1)
        # overlapping parts of one leg hide the same piece of the lamp: the larger share counts
        seen[rows] = np.minimum(seen[rows], np.where(owner[rows] == k, 1.0, 1.0 - hidden))
    return seen


def look(scene: Scene, bounds: Bounds, origin: Array, rays: Array) -> tuple[Array, Integers]:
    """Light along rays (3, bundles, rays), and labels that change at every visible border.

    Both (bundles, rays). A label counts the shape, its face, and whether it lies in shadow.
    """
    shapes = [part.shape for part in scene.parts]
    distance, owner = first_hits(shapes, bounds, origin, rays)
    lost = owner < 0
    points = origin[:, None, None] + np.where(lost, 1.0, distance) * rays
    seen = np.ones(distance.shape)
    for lamp in scene.lighting.lamps:
        if lamp.shadows:
            seen = lamp_seen(scene.parts, bounds, lamp, points, owner)
    flat, toward, lit = points.reshape(3, -1), -rays.reshape(3, -1), seen.ravel()
    numbers = owner.ravel()
    order = np.argsort(numbers, kind="stable")
    starts = np.searchsorted(numbers[order], np.arange(len(shapes) + 1))
    light = np.zeros(numbers.size)
    face = np.zeros(numbers.size, dtype=np.int16)
    for k, part in enumerate(scene.parts):
        at = order[starts[k] : starts[k + 1]]
        if at.size:
            face[at] = part.shape.face(flat[:, at])
            light[at] = radiance(
                part.shape, part.material, flat[:, at], toward[:, at], lit[at], scene.lighting
            )
    label = 6 * owner + 2 * face.reshape(owner.shape) + (seen < 0.5)
    return light.reshape(distance.shape), np.where(lost, -1, label).astype(np.int16)


def _flat(rays: Array, rows: Integers) -> Array:
    """The rays of some bundles in one row, (3, n); a view where all are wanted."""
    wanted = rays if rows.size == rays.shape[1] else rays[:, rows]
    return wanted.reshape(3, -1)
