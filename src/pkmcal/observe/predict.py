"""Predicted edges of every leg in every image.

Arrays have the axes (..., E edges of a machine, n samples along an edge), after an axis of K
images; the E edges are the same in every image: each visible tube of each leg, side 0 then side 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.cylinders import SIDE_SIGNS, edge_normal, has_silhouette, line_through
from pkmcal.geometry.rigid import apply, cross, dot, of_components
from pkmcal.mechanisms import Machine

JOINT_MARGIN = 0.006
"""Metres omitted at both ends of a tube: collars and joint housings hide or imitate edges."""


@dataclass(frozen=True)
class TubeList:
    """The visible tubes of a machine, E = 2 x tubes edges.

    leg, tube, side : (E,). start, stop : (E,) m along the leg from A. radius : (E,) position of
    the radius among the machine's parameters.
    """

    leg: Integers
    tube: Integers
    side: Integers
    start: Array
    stop: Array
    radius: Integers

    def __len__(self) -> int:
        return len(self.leg)

    @cached_property
    def by_leg(self) -> tuple[Integers, Integers]:
        """Legs with tubes, and the first edge of each: edges come leg by leg."""
        return np.unique(self.leg, return_index=True)


def tubes_of(machine: Machine) -> TubeList:
    """All edges of the nominal model, in the order leg, tube, side."""
    rows = [
        (j, t, side, tube.start, tube.stop, machine.layout.radius[j][t])
        for j, leg in enumerate(machine.document.legs)
        for t, tube in enumerate(leg.tubes)
        for side in (0, 1)
    ]
    columns = [np.array(c) for c in zip(*rows, strict=True)] if rows else [np.zeros(0)] * 6
    whole = [c.astype(int) for c in columns]
    return TubeList(whole[0], whole[1], whole[2], columns[3], columns[4], whole[5])


@dataclass(frozen=True)
class LegsInCamera:
    """Leg axes in the camera frame: ends a, b and directions u, (..., L, 3)."""

    a: Array
    b: Array
    u: Array

    def __getitem__(self, which: Any) -> LegsInCamera:
        """Some of the legs, by the leading axes."""
        return LegsInCamera(self.a[which], self.b[which], self.u[which])

    def __len__(self) -> int:
        return len(self.a)

    def single(self) -> LegsInCamera:
        """In single precision, which is enough for a search in reduced images."""
        return LegsInCamera(*(v.astype(np.float32) for v in (self.a, self.b, self.u)))

    def joined(self, other: LegsInCamera) -> LegsInCamera:
        """Concatenated with others along the first axis."""
        pairs = (self.a, other.a), (self.b, other.b), (self.u, other.u)
        return LegsInCamera(*(np.concatenate(pair) for pair in pairs))

    def under(self, T_camera_base: Array) -> LegsInCamera:
        """Legs (K, L) or (H, K, L) of the base frame seen by cameras (H, 4, 4), (H, K, L)."""
        T = T_camera_base.astype(self.a.dtype)
        shape = self.a.shape[-3:-1]
        lead = self.a.shape[:-3] or (1,)
        own = np.stack([self.a, self.b, self.u]).reshape(3, *lead, shape[0] * shape[1], 3)
        in_view = T[:, :3, :3] @ own.mT  # (3, H, 3, K L): one component after the other
        in_view[:2] += T[:, :3, 3:]  # directions do not shift
        return LegsInCamera(*in_view.reshape(3, len(T), 3, *shape).transpose(0, 1, 3, 4, 2))


def legs_in_camera(
    machine: Machine, T_camera_base: Array, T_base_platform: Array, joints: Array
) -> LegsInCamera:
    """Leg axes in a camera's frame; T_camera_base (..., 4, 4) and poses (K, 4, 4) broadcast."""
    ends, camera = machine.ends_at(joints, T_base_platform), T_camera_base[..., None, :, :]
    a, b = np.broadcast_arrays(apply(camera, ends.a), apply(camera, ends.b))
    return LegsInCamera(a, b, line_through(a, b)[0])


@dataclass(frozen=True)
class EdgePoints:
    """Points along predicted edges, with the derivatives of their pixels.

    normal : (..., E, 3) edge planes, camera frame. along : (..., E, n) position on the leg, m from
    A. point : (..., E, n, 3) on the cylinder where the view ray grazes it, camera frame.
    pixel : (..., E, n, 2). outward : (..., E, n, 2) unit normals of the edge in the image, away
    from the leg. across : (..., E, n, 3) outward motion of the pixel (px) by the point's (m).
    gain : (..., E, n) px per metre across the leg. valid : (..., E, n) whether there is a pixel.
    """

    normal: Array
    along: Array
    point: Array
    pixel: Array
    outward: Array
    gain: Array
    valid: Booleans

    @property
    def across(self) -> Array:
        """Outward motion of the pixel (px) by the point's (m), (..., E, n, 3): motions within the
        edge's plane do not leave the edge.
        """
        return self.gain[..., None] * self.normal[..., None, :]

    def by_normal(self) -> Array:
        """Outward motion of the edge (px) by a change of its plane's normal, (..., E, n, 3).

        The plane n . x = 0 turned by dn passes P + e n with e = -dn . P.
        """
        return -self.point * self.gain[..., None]


def edge_points(
    machine: Machine, camera: Camera, legs: LegsInCamera, tubes: TubeList, samples: int
) -> EdgePoints:
    """``samples`` points, evenly along every edge; leading axes and precision are those of
    ``legs``.
    """
    radius = machine.values[tubes.radius].astype(legs.a.dtype)
    a, b, u = of_edges(legs, tubes)
    normal, ok = normals_of_edges(a, u, radius, tubes)
    first, last = visible_stretch(a, b, tubes)
    fraction = ((np.arange(samples) + 0.5) / samples).astype(a.dtype)
    along = first[:, None] + np.maximum(last - first, 0.0)[..., None] * fraction
    base = a + radius[:, None] * normal
    point = of_components(*(base[..., None, k] + along * u[..., None, k] for k in range(3)))
    pixel, by_place, by_shift = camera.project_along(point, u[..., None, :], normal[..., None, :])
    x, y = by_place[..., 0], by_place[..., 1]
    # beside the camera nothing has an image, and what almost has one lies anywhere
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.sqrt(y * y + x * x)
        outward = of_components(-y / length, x / length)
        gain = dot(outward, by_shift)
        outward = outward * np.sign(gain)[..., None]
    valid = (ok & (last > first))[..., None] & np.isfinite(gain)
    return EdgePoints(normal, along, point, pixel, outward, np.abs(gain), valid)


def of_edges(legs: LegsInCamera, tubes: TubeList) -> Iterator[Array]:
    """Ends a, b and directions u of the leg of every edge, (..., E, 3)."""
    for vectors in (legs.a, legs.b, legs.u):
        yield of_components(*(vectors[..., k].take(tubes.leg, axis=-1) for k in range(3)))


def normals_of_edges(a: Array, u: Array, radius: Array, tubes: TubeList) -> tuple[Array, Booleans]:
    """Edge planes (..., E, 3) of axes for each edge, and where the leg has a silhouette."""
    m = cross(a, u)
    ok = has_silhouette(m, radius)
    sign = SIDE_SIGNS.astype(a.dtype)[tubes.side]
    return edge_normal(u, m, np.where(ok, radius, 0.0), sign), ok


def visible_stretch(a: Array, b: Array, tubes: TubeList) -> tuple[Array, Array]:
    """First and last visible position on each tube, m from A; (E,) and (..., E)."""
    length = np.sqrt(dot(b - a, b - a))
    start, stop = (place.astype(length.dtype) for place in (tubes.start, tubes.stop))
    return start + JOINT_MARGIN, np.minimum(stop, length) - JOINT_MARGIN


def unobstructed(
    machine: Machine,
    camera: Camera,
    legs: LegsInCamera,
    tubes: TubeList,
    edges: EdgePoints,
    clearance: float,
) -> Booleans:
    """Mask (K, E, n) of points in the image, not behind another leg nor within ``clearance`` px of
    its outline.

    The ray to the point passes another leg's axis at some distance. Where this is less than the
    leg's radius, the leg hides the point or is behind it; a leg behind only matters where its own
    outline is in the point's background.
    """
    clear = edges.valid & camera.in_image(edges.pixel, margin=4.0)
    reach = np.sqrt(dot(edges.point, edges.point))
    rays = edges.point / reach[..., None]
    room = clearance / np.maximum(edges.gain, 1e-9)
    for j in range(machine.n_legs):
        others = machine.values[machine.layout.radius[j]]
        if others.size == 0:
            continue
        a, b, u = (v[:, None, None, j] for v in (legs.a, legs.b, legs.u))
        length, start = np.sqrt(dot(b - a, b - a)), dot(u, a)
        cosine, ahead = dot(rays, u), dot(rays, a)
        # the place on the leg's axis, m from a, that is nearest to the ray; depth is along the ray
        place = (cosine * ahead - start) / np.maximum(1 - cosine**2, 1e-9)
        place = np.clip(place, 0, length)
        depth = ahead + place * cosine
        distance2 = dot(a, a) + place * (2 * start + place) - depth**2
        spoiled = (depth > 0) & (distance2 < (others.max() + room) ** 2)
        within = others.min() - room
        spoiled &= (depth < reach) | (distance2 > within * np.abs(within))
        clear &= ~(spoiled & (tubes.leg != j)[:, None])
    return clear
