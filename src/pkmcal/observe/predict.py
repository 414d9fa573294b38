"""Prediction of the edges of every leg in every image.

Arrays have the axes (..., E edges of a machine, n samples along an edge), preceded by K images. The
E edges are the same in every image: each visible tube of each leg, side 0 then side 1.
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
"""Length (m) left out at both ends of a tube: collars and joint housings hide or imitate edges."""


@dataclass(frozen=True)
class TubeList:
    """Edges of the visible tubes of a machine, E = 2 x tubes.

    leg, tube, side : (E,).
    start, stop : (E,) m along the leg from A.
    radius : (E,) index of the radius among the machine's parameters.
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
        """Legs with tubes, and the index of the first edge of each; edges are ordered by leg."""
        return np.unique(self.leg, return_index=True)


def tubes_of(machine: Machine) -> TubeList:
    """Edges of all tubes of the nominal model, ordered by leg, tube and side."""
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
    """Leg axes in a camera's frame: ends a, b and unit directions u from a to b, each (..., L, 3).

    The precision of the arrays is that of all results derived from them.
    """

    a: Array
    b: Array
    u: Array

    def __getitem__(self, which: Any) -> LegsInCamera:
        """Select along the leading axes."""
        return LegsInCamera(self.a[which], self.b[which], self.u[which])

    def __len__(self) -> int:
        return len(self.a)

    def single(self) -> LegsInCamera:
        """A copy in single precision, which suffices for a search in reduced images."""
        return LegsInCamera(*(v.astype(np.float32) for v in (self.a, self.b, self.u)))

    def joined(self, other: LegsInCamera) -> LegsInCamera:
        """Concatenation along the first axis."""
        pairs = (self.a, other.a), (self.b, other.b), (self.u, other.u)
        return LegsInCamera(*(np.concatenate(pair) for pair in pairs))

    def under(self, T_camera_base: Array) -> LegsInCamera:
        """Legs (H, K, L) in the frames of cameras (H, 4, 4), from legs (K, L) or (H, K, L) in the
        base frame.
        """
        T = T_camera_base.astype(self.a.dtype)
        shape = self.a.shape[-3:-1]
        lead = self.a.shape[:-3] or (1,)
        own = np.stack([self.a, self.b, self.u]).reshape(3, *lead, shape[0] * shape[1], 3)
        in_view = T[:, :3, :3] @ own.mT  # (3, H, 3, K L), component by component
        in_view[:2] += T[:, :3, 3:]  # translation applies to points, not to directions
        return LegsInCamera(*in_view.reshape(3, len(T), 3, *shape).transpose(0, 1, 3, 4, 2))


def legs_in_camera(
    machine: Machine, T_camera_base: Array, T_base_platform: Array, joints: Array
) -> LegsInCamera:
    """Leg axes in a camera's frame; T_camera_base (..., 4, 4) and T_base_platform (K, 4, 4)
    broadcast.

    joints : (K, m) readings.
    """
    ends, camera = machine.ends_at(joints, T_base_platform), T_camera_base[..., None, :, :]
    a, b = np.broadcast_arrays(*(apply(camera, end) for end in ends.rods))
    return LegsInCamera(a, b, line_through(a, b)[0])


@dataclass(frozen=True)
class EdgePoints:
    """Points along predicted edges, with their derivatives in the image.

    normal : (..., E, 3) unit normals of the edge planes, camera frame.
    along : (..., E, n) position on the leg, m from A.
    point : (..., E, n, 3) point of the cylinder where the viewing ray is tangent to it, camera
        frame.
    pixel : (..., E, n, 2).
    outward : (..., E, n, 2) unit normals of the edge in the image, away from the leg.
    gain : (..., E, n) px per metre of motion along the normal.
    valid : (..., E, n) whether the point has an image.
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
        """Derivative (..., E, n, 3) of the outward position of the pixel (px) by the point (m).

        Motions within the edge's plane have no effect.
        """
        return self.gain[..., None] * self.normal[..., None, :]

    def by_normal(self) -> Array:
        """Derivative (..., E, n, 3) of the outward position of the edge (px) by its plane's normal.

        The plane n . x = 0 rotated by dn contains P + e n with e = -dn . P.
        """
        return -self.point * self.gain[..., None]


def edge_points(
    machine: Machine, camera: Camera, legs: LegsInCamera, tubes: TubeList, samples: int
) -> EdgePoints:
    """Points on all edges, ``samples`` on each, evenly spaced over the visible stretch.

    Leading axes and precision are those of ``legs``.
    """
    radius = machine.values[tubes.radius].astype(legs.a.dtype)
    a, b, u = of_edges(legs, tubes)
    normal, ok = normals_of_edges(a, u, radius, tubes)
    first, last = visible_stretch(a, b, tubes)
    fraction = ((np.arange(samples) + 0.5) / samples).astype(a.dtype)
    along = first[:, None] + np.maximum(last - first, 0.0)[..., None] * fraction
    base = a + radius[:, None] * normal
    point = of_components(*(base[..., None, k] + along * u[..., None, k] for k in range(3)))
    # image, its derivative along the leg and along the normal
    pixel, by_place, by_shift = camera.project_along(point, u[..., None, :], normal[..., None, :])
    x, y = by_place[..., 0], by_place[..., 1]
    # points beside the camera have no image, and those nearby have arbitrary ones
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.sqrt(y * y + x * x)
        outward = of_components(-y / length, x / length)
        gain = dot(outward, by_shift)
        outward = outward * np.sign(gain)[..., None]
    valid = (ok & (last > first))[..., None] & np.isfinite(gain)
    return EdgePoints(normal, along, point, pixel, outward, np.abs(gain), valid)


def of_edges(legs: LegsInCamera, tubes: TubeList) -> Iterator[Array]:
    """Ends a, b and directions u of the leg of every edge, (..., E, 3) each."""
    for vectors in (legs.a, legs.b, legs.u):
        yield of_components(*(vectors[..., k].take(tubes.leg, axis=-1) for k in range(3)))


def normals_of_edges(a: Array, u: Array, radius: Array, tubes: TubeList) -> tuple[Array, Booleans]:
    """Normals (..., E, 3) of the edge planes, and whether each leg has a silhouette ([B] eq. 3).

    a, u : (..., E, 3) of each edge's leg.
    radius : (E,) m.
    """
    m = cross(a, u)
    ok = has_silhouette(m, radius)
    sign = SIDE_SIGNS.astype(a.dtype)[tubes.side]
    return edge_normal(u, m, np.where(ok, radius, 0.0), sign), ok


def visible_stretch(a: Array, b: Array, tubes: TubeList) -> tuple[Array, Array]:
    """First position, (E,), and last position, (..., E), of each tube's visible stretch, m from A.

    Both are JOINT_MARGIN within the tube; the last one also within the leg.
    """
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
    """Mask (..., E, n) of the points in the image that no other leg hides or disturbs.

    The viewing ray of a point passes the axis of another leg at some distance. If the distance is
    less than that leg's radius, the leg hides the point or lies behind it. A leg behind only
    matters if its own outline disturbs the point's background, which is within ``clearance`` px of
    it.
    """
    clear = edges.valid & camera.in_image(edges.pixel, margin=4.0)
    reach = np.sqrt(dot(edges.point, edges.point))
    rays = edges.point / reach[..., None]
    room = clearance / np.maximum(edges.gain, 1e-9)
    for j in range(machine.n_legs):
        others = machine.values[machine.layout.radius[j]]
        if others.size == 0:
            continue
        a, b, u = (v[..., j, None, None, :] for v in (legs.a, legs.b, legs.u))
        length, start = np.sqrt(dot(b - a, b - a)), dot(u, a)
        cosine, ahead = dot(rays, u), dot(rays, a)
        # position on the other leg's axis, m from a, nearest to the ray; depth is along the ray
        place = (cosine * ahead - start) / np.maximum(1 - cosine**2, 1e-9)
        place = np.clip(place, 0, length)
        depth = ahead + place * cosine
        # squared distance between ray and axis
        distance2 = dot(a, a) + place * (2 * start + place) - depth**2
        # in front: within the outline and its clearance; behind: only near the outline
        spoiled = (depth > 0) & (distance2 < (others.max() + room) ** 2)
        within = others.min() - room
        spoiled &= (depth < reach) | (distance2 > within * np.abs(within))
        clear &= ~(spoiled & (tubes.leg != j)[:, None])
    return clear
