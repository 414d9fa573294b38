"""Convex shapes for ray casting: cylinders, balls, boxes and the walls of a room.

All coordinates are in one outer frame (base), m. Inside the renderer vectors have their components
first, (3, n), which keeps NumPy's inner loops long. ``d`` are unit directions of rays from one
common ``origin`` (3, 1), or from one each (3, n), outside the shape.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

BALLS_ALONG = 8
"""Bounding balls in a row along a long shape; a single ball round a leg would cover most of the
image."""


class Shape(ABC):
    """Convex body that rays hit; being convex, it casts no shadow on its own lit points."""

    @abstractmethod
    def enter(self, origin: Array, d: Array) -> Array:
        """Distance (n,) to the first hit of rays from origin (3, 1 or n) along d (3, n); inf for a
        miss.
        """

    @abstractmethod
    def normal(self, points: Array) -> Array:
        """Outward unit normals (3, n) at surface points (3, n)."""

    def face(self, points: Array) -> Integers:
        """Number (n,), 0 to 2, of the smooth face that surface points (3, n) lie on."""
        return np.zeros(points.shape[1], dtype=np.int16)

    @abstractmethod
    def local(self, points: Array) -> Array:
        """Surface points (3, n) in the shape's own frame, for its pattern."""

    @abstractmethod
    def balls(self) -> tuple[Array, Array]:
        """Centres (3, k) and radii (k,) of balls that together contain the shape."""

    def veil(self, light: Array, d: Array, distance: Array, spread: float) -> Array:
        """Share (n,) of a lamp of radius ``spread`` at ``light`` (3,) that the shape occludes.

        The lit points lie at ``distance`` (n,) from the lamp along d (3, n). By default all or
        nothing; round shapes have a soft border.
        """
        del spread
        return (self.enter(light[:, None], d) < distance - 1e-9).astype(float)


def inner(d: Array, v: Array) -> Array:
    """Inner products (n,) of vectors (3, n) with one vector (3,), or with one each (3, n)."""
    out = d[0] * v[0]
    out += d[1] * v[1]
    out += d[2] * v[2]
    return out


def turned_components(rot: Array, v: Array) -> Array:
    """Vectors (3, ...) rotated by a matrix (3, 3).

    BLAS is avoided: for so small a matrix its threads wait more than they work, and images are
    rendered in threads already.
    """
    return np.stack([inner(v, row) for row in rot])


def _soft(clearance: Array, t: Array, distance: Array, spread: float, where: Booleans) -> Array:
    """Occluded share (n,) of a lamp of radius ``spread`` behind the border of a shape.

    clearance : (n,) distance, in m, by which a ray misses the shape at its parameter t, negative
        for a hit.
    distance : (n,) of the lit points from the lamp.
    where : (n,) rays that the shape can occlude; zero for others.
    """
    hidden = np.zeros(clearance.shape)
    # most rays pass by: the lamp's penumbra at the shape is never wider than the lamp
    near = np.flatnonzero(where & (t > 0) & (t < distance) & (clearance < spread + 1e-6))
    width = spread * np.maximum(1 - t[near] / distance[near], 0.0) + 1e-6
    x = np.clip(0.5 - clearance[near] / (2 * width), 0, 1)
    hidden[near] = x * x * (3 - 2 * x)
    return hidden


@final
@dataclass(frozen=True)
class Cylinder(Shape):
    """Closed cylinder: centre of its first cap (3,), unit axis (3,), radius and length, in m."""

    start: Array
    axis: Array
    radius: float
    length: float

    def enter(self, origin: Array, d: Array) -> Array:
        """Root of the quadratic of the infinite cylinder, cut to its length, and the cap that
        faces.
        """
        o, along, du, b = self._along(origin, d)
        a = 1 - du * du
        c = inner(o, o) - along**2 - self.radius**2
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (-b - np.sqrt(b * b - a * c)) / a
            s = along + t * du
            t = np.where((t > 0) & (s >= 0) & (s <= self.length), t, np.inf)
            # neither cap is visible from between their planes
            beyond = (along < 0) | (along > self.length)
            if not beyond.any():
                return t
            t_cap = (np.where(along < 0, 0.0, self.length) - along) / du
            inside = (c + t_cap * (2 * b + a * t_cap) <= 0) & (t_cap > 0) & beyond
            return np.where(inside, np.minimum(t, t_cap), t)

    def normal(self, points: Array) -> Array:
        """Radial on the side, along the axis on the caps."""
        s, radial, rho = self._place(points)
        cap_normal = np.where(s > self.length / 2, 1.0, -1.0) * self.axis[:, None]
        side_normal = radial / np.maximum(rho, 1e-12)
        return np.where(self._on_cap(s, rho), cap_normal, side_normal)

    def face(self, points: Array) -> Integers:
        """Face number: 0 the side, 1 and 2 the caps."""
        s, _, rho = self._place(points)
        return np.where(self._on_cap(s, rho), 1 + (s > self.length / 2), 0).astype(np.int16)

    def local(self, points: Array) -> Array:
        """Two coordinates across the axis and one along it."""
        return turned_components(_frame_of(self.axis), points - self.start[:, None])

    def balls(self) -> tuple[Array, Array]:
        """Row of balls along the axis, or one ball round a disc."""
        n = BALLS_ALONG if self.length > 4 * self.radius else 1
        s = (np.arange(n) + 0.5) * self.length / n
        radius = np.hypot(self.radius, self.length / (2 * n))
        return self.start[:, None] + self.axis[:, None] * s, np.full(n, radius)

    def veil(self, light: Array, d: Array, distance: Array, spread: float) -> Array:
        """Occluded share from the distance by which rays miss: a tube at the nearest approach, a
        disc in its middle plane.
        """
        o, along, du, b = self._along(light[:, None], d)
        a = np.maximum(1 - du * du, 1e-9)
        across2 = inner(o, o) - along**2
        if self.length > self.radius:
            t = -b / a
            s = along + t * du
            # hard ends: where tube and rod meet, two soft ends would let light through
            between = (s >= 0) & (s <= self.length)
        else:
            t = (self.length / 2 - along) / np.where(np.abs(du) < 1e-9, 1e-9, du)
            between = np.ones(t.shape, dtype=bool)
        miss = np.sqrt(np.maximum(across2 + t * (2 * b + a * t), 0.0)) - self.radius
        return _soft(miss, t, distance, spread, between)

    def _place(self, points: Array) -> tuple[Array, Array, Array]:
        """Coordinates along the axis (n,), vectors from the axis (3, n) and their lengths (n,)."""
        p = points - self.start[:, None]
        s = inner(p, self.axis)
        radial = p - s * self.axis[:, None]
        return s, radial, np.sqrt(np.einsum("in,in->n", radial, radial))

    def _on_cap(self, s: Array, rho: Array) -> Booleans:
        """Whether points lie on a cap: the nearer surface. Points are accurate to 1e-12 m, so only
        rims are ambiguous.
        """
        return np.minimum(s, self.length - s) < np.abs(self.radius - rho)

    def _along(self, origin: Array, d: Array) -> tuple[Array, Array, Array, Array]:
        """Origin relative to the start, its coordinate on the axis, and the rays' parts along the
        axis and across.
        """
        o = origin - self.start[:, None]
        along = inner(o, self.axis)
        du = inner(d, self.axis)
        return o, along, du, inner(d, o) - along * du


@final
@dataclass(frozen=True)
class Ball(Shape):
    """Sphere: centre (3,) and radius, in m."""

    centre: Array
    radius: float

    def enter(self, origin: Array, d: Array) -> Array:
        """Nearer root of the quadratic."""
        o = origin - self.centre[:, None]
        b = inner(d, o)
        with np.errstate(invalid="ignore"):
            t = -b - np.sqrt(b * b - (inner(o, o) - self.radius**2))
        return np.where(t > 0, t, np.inf)

    def normal(self, points: Array) -> Array:
        """Away from the centre."""
        return (points - self.centre[:, None]) / self.radius

    def local(self, points: Array) -> Array:
        """Points relative to the centre."""
        return points - self.centre[:, None]

    def balls(self) -> tuple[Array, Array]:
        """The sphere itself."""
        return self.centre[:, None], np.array([self.radius])

    def veil(self, light: Array, d: Array, distance: Array, spread: float) -> Array:
        """Occluded share from the distance by which rays miss."""
        o = light - self.centre
        t = -inner(d, o)
        miss = np.sqrt(np.maximum(o @ o - t * t, 0.0)) - self.radius
        return _soft(miss, t, distance, spread, np.ones(t.shape, dtype=bool))


@final
@dataclass(frozen=True)
class Box(Shape):
    """Block: centre (3,), axes as rows of ``rot`` (3, 3), half its sizes (3,), in m."""

    centre: Array
    rot: Array
    half: Array

    def enter(self, origin: Array, d: Array) -> Array:
        """Entry into the last of the three slabs, if it is before the exit from the first."""
        o = self.local(origin)
        with np.errstate(divide="ignore", invalid="ignore"):
            inv = 1 / turned_components(self.rot, d)
            near = -o * inv - self.half[:, None] * np.abs(inv)
            far = -o * inv + self.half[:, None] * np.abs(inv)
        first, last = near.max(axis=0), far.min(axis=0)
        return np.where((first < last) & (first > 0), first, np.inf)

    def normal(self, points: Array) -> Array:
        """Normal of the face that the point is nearest to."""
        q, face = self.local(points), self.face(points)
        sign = np.sign(np.take_along_axis(q, face[None], axis=0)[0])
        return self.rot.T[:, face] * sign

    def face(self, points: Array) -> Integers:
        """Axis that the face is square to; opposite faces are never seen side by side."""
        return np.argmin(self.half[:, None] - np.abs(self.local(points)), axis=0)

    def local(self, points: Array) -> Array:
        """Coordinates along the box's axes, from its centre."""
        return turned_components(self.rot, points - self.centre[:, None])

    def balls(self) -> tuple[Array, Array]:
        """Row of balls along the longest axis."""
        k = int(np.argmax(self.half))
        across = float(np.linalg.norm(np.delete(self.half, k)))
        n = BALLS_ALONG if self.half[k] > 2 * across else 1
        s = (2 * (np.arange(n) + 0.5) / n - 1) * self.half[k]
        radius = np.hypot(across, self.half[k] / n)
        return self.centre[:, None] + self.rot[k][:, None] * s, np.full(n, radius)


@final
@dataclass(frozen=True)
class Wall(Shape):
    """Infinite wall, floor or ceiling: a point (3,) and the unit normal (3,) into the room."""

    point: Array
    inward: Array

    def enter(self, origin: Array, d: Array) -> Array:
        """Intersection with the plane for rays from inside."""
        height = inner(origin - self.point[:, None], self.inward)
        with np.errstate(divide="ignore"):
            t = -height / inner(d, self.inward)
        return np.where(t > 0, t, np.inf)

    def normal(self, points: Array) -> Array:
        """Normal into the room."""
        return np.broadcast_to(self.inward[:, None], points.shape)

    def local(self, points: Array) -> Array:
        """Two coordinates in the plane; the third is zero."""
        return turned_components(_frame_of(self.inward), points - self.point[:, None])

    def balls(self) -> tuple[Array, Array]:
        """One ball of infinite radius."""
        return self.point[:, None], np.array([np.inf])

    def veil(self, light: Array, d: Array, distance: Array, spread: float) -> Array:
        """Zero: lamps hang inside the room."""
        del light, d, spread
        return np.zeros(distance.shape)


def _frame_of(axis: Array) -> Array:
    """Rows of an orthonormal frame whose third is the axis and whose second is as upright as
    possible.
    """
    up = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(up, axis)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])
