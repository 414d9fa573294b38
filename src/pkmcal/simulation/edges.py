"""Measurements without photographs: edges with known noise, for studies and tests.

Axes: M photographs, E edges of the machine (each tube, side 0 then 1), n places along an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.cylinders import (
    contour_point,
    edge_normal_jacobians,
    leg_is_seen,
    line_through,
    tangent_basis,
)
from pkmcal.geometry.rigid import apply, dot
from pkmcal.measurements import EdgeSet, concatenate
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends

PLACES = 48
"""Places looked at along each tube: a hidden stretch is found to a fiftieth of the tube."""
JOINT_HOUSING = 0.005
"""Metres at both ends of a tube that are never measured."""
CLEARANCE = 2.0
"""Pixels between an edge and a leg in front of it, nearer than which the two are one edge."""
LEAST_SEEN = 8
"""Places in a row that an edge needs; shorter stretches say little about the tilt."""


@dataclass(frozen=True)
class EdgeNoise:
    """Errors of measured edges.

    shift, tilt : standard deviations (px) of the whole edge's sideways place, and of its ends
    when it turns about its middle. outward : constant shift of all edges (px). wrong : fraction
    of edges that are another leg's.
    """

    shift: float = 0.1
    tilt: float = 0.1
    outward: float = 0.0
    wrong: float = 0.0


def simulate_edges(
    machine: Machine,
    T_camera_base: Array,
    camera: Camera | Sequence[Camera],
    T_base_platform: Array,
    noise: EdgeNoise,
    rng: np.random.Generator,
    *,
    photographs: Integers | None = None,
    joint_noise: float = 3e-6,
) -> tuple[EdgeSet, Array]:
    """Edges and readings (K, m) that a true machine would give.

    T_camera_base : (S, 4, 4). camera : one for all stations, or one a station.
    T_base_platform : (K, 4, 4). photographs : (M, 2) pairs of station and configuration; all
    pairs when absent. Edges outside the image or hidden behind other legs are left out; an edge
    that is hidden in part keeps its longest visible stretch.
    """
    cameras = _one_a_station(camera, len(T_camera_base))
    joints = machine.inverse(T_base_platform)
    if photographs is None:
        photographs = np.argwhere(np.ones((len(cameras), len(joints)), dtype=bool))
    tubes = _tubes(machine)
    sets: list[EdgeSet] = []
    for station, one in enumerate(cameras):
        rows = photographs[photographs[:, 0] == station, 1]
        ends = limb_ends(machine.layout, machine.values, joints[rows], T_base_platform[rows])
        a, b = apply(T_camera_base[station], ends.a), apply(T_camera_base[station], ends.b)
        exact = _exact_edges(one, tubes, a, b, station, rows)
        sets.append(_with_errors(one, exact, noise, rng))
    edges = _with_wrong_ones(concatenate(sets), noise.wrong, rng)
    return edges, joints + joint_noise * rng.standard_normal(joints.shape)


def _one_a_station(camera: Camera | Sequence[Camera], n_stations: int) -> tuple[Camera, ...]:
    cameras = (camera,) * n_stations if isinstance(camera, Camera) else tuple(camera)
    if len(cameras) != n_stations:
        raise InputError(
            what="the simulation needs one camera for all stations, or one for each",
            found=f"{len(cameras)} cameras for {n_stations} stations",
        )
    return cameras


@dataclass(frozen=True)
class _Tubes:
    """The machine's E edges: leg, tube, side (E,), from and to on the leg (m), radius (m)."""

    leg: Integers
    tube: Integers
    side: Integers
    start: Array
    stop: Array
    radius: Array


@dataclass(frozen=True)
class _Exact:
    """Edges that are seen, exact: an edge set without errors, and rays along each, (N, n, 3)."""

    edges: EdgeSet
    rays: Array
    pixels: Array


def _tubes(machine: Machine) -> _Tubes:
    rows = [
        (j, t, side, tube.start, tube.stop, radius)
        for j, leg in enumerate(machine.document.legs)
        for t, (tube, radius) in enumerate(zip(leg.tubes, machine.radii()[j], strict=True))
        for side in (0, 1)
    ]
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return _Tubes(*columns)


def _exact_edges(
    camera: Camera, tubes: _Tubes, a: Array, b: Array, station: int,
    configurations: Integers,
) -> _Exact:  # fmt: skip
    """All visible edges of a station's photographs; a, b (M, L, 3) in the camera frame."""
    a_e, b_e = a[:, tubes.leg], b[:, tubes.leg]
    u, _ = line_through(a_e, b_e)
    length = np.sqrt(dot(b_e - a_e, b_e - a_e))
    normal = edge_normal_jacobians(a_e, b_e, tubes.radius, tubes.side).n
    first = np.broadcast_to(tubes.start + JOINT_HOUSING, length.shape)
    last = np.minimum(tubes.stop, length) - JOINT_HOUSING
    along = first[..., None] + (last - first)[..., None] * np.linspace(0, 1, PLACES)
    points = contour_point(
        a_e[..., None, :], u[..., None, :], normal[..., None, :], tubes.radius[:, None], along
    )
    with np.errstate(invalid="ignore"):
        seen = camera.in_image(camera.project(points))
        seen &= (leg_is_seen(a_e, b_e, tubes.radius) & (last > first))[..., None]
    seen &= ~_hidden(points, tubes, a, b, _pixel_angle(camera))
    begin, count = _longest_run(seen)
    photo, edge = np.nonzero(count >= LEAST_SEEN)
    begin, count = begin[photo, edge], count[photo, edge]
    span = np.stack([along[photo, edge, begin], along[photo, edge, begin + count - 1]], axis=-1)
    axis = _Axis(a_e[photo, edge], u[photo, edge], tubes.radius[edge], normal[photo, edge])
    rays = axis.rays(span)
    edges = EdgeSet(
        station=np.full(len(edge), station), configuration=configurations[photo],
        leg=tubes.leg[edge], tube=tubes.tube[edge], side=tubes.side[edge], normal=axis.normal,
        basis=tangent_basis(axis.normal, rays[:, PLACES // 2]),
        covariance=np.zeros((len(edge), 2, 2)), shift=np.zeros((len(edge), 2)), span=span,
    )  # fmt: skip
    return _Exact(edges, rays, camera.project(rays))


@dataclass(frozen=True)
class _Axis:
    """Seen edges' axes: point a and direction u (N, 3), radius (N,), edge normal (N, 3)."""

    a: Array
    u: Array
    radius: Array
    normal: Array

    def rays(self, span: Array) -> Array:
        """Unit rays (N, n, 3) to even places on the edges between the ends of span (N, 2), m."""
        where = np.linspace(0, 1, PLACES)
        along = span[:, :1] * (1 - where) + span[:, 1:] * where
        points = contour_point(
            self.a[:, None], self.u[:, None], self.normal[:, None], self.radius[:, None], along
        )
        return points / np.sqrt(dot(points, points))[..., None]


def _hidden(points: Array, tubes: _Tubes, a: Array, b: Array, pixel: float) -> Booleans:
    """(M, E, n) True where a tube of another leg, or of the own one, is in front of a point.

    pixel : angle of a pixel, rad; another leg hides what comes within CLEARANCE of it, too.
    """
    distance = np.sqrt(dot(points, points))
    margin = CLEARANCE * pixel * distance
    d = points / distance[..., None]
    hidden = np.zeros(distance.shape, dtype=bool)
    for e in range(0, len(tubes.leg), 2):  # both sides of a tube are one cylinder
        j = tubes.leg[e]
        start, end = a[:, None, None, j], b[:, None, None, j]
        u, _ = line_through(start, end)
        length = np.sqrt(dot(end - start, end - start))
        du, au = dot(d, u), dot(start, u)
        # |t d - start|^2 across u, as a quadratic in t
        qa = np.maximum(1 - du**2, 1e-12)
        qb = dot(d, start) - du * au
        other = (tubes.leg != j)[:, None]
        qc = dot(start, start) - au**2 - (tubes.radius[e] + other * margin) ** 2
        disc = qb**2 - qa * qc
        t = (qb - np.sqrt(np.maximum(disc, 0.0))) / qa
        s = t * du - au
        inside = (s > tubes.start[e]) & (s < np.minimum(tubes.stop[e], length))
        meets = (disc > 0) & inside & (t > 0) & (t < distance)
        hidden |= meets & (other | (tubes.tube != tubes.tube[e])[:, None])
    return hidden


def _pixel_angle(camera: Camera) -> float:
    """Angle (rad) between neighbouring pixels in the middle of the image."""
    middle = (np.array(camera.image_size) - 1) / 2
    rays = camera.ray(middle + np.array([[0.0, 0.0], [1.0, 0.0]]))
    return float(np.linalg.norm(rays[1] - rays[0]))


def _longest_run(seen: Booleans) -> tuple[Integers, Integers]:
    """First place and number of places of the longest run of True along the last axis."""
    index = np.arange(seen.shape[-1])
    gap = np.where(seen, -1, index)
    # places since the last gap, by a running maximum
    run = np.where(seen, index - np.maximum.accumulate(gap, axis=-1), 0)
    last = np.argmax(run, axis=-1)
    count = np.take_along_axis(run, last[..., None], axis=-1)[..., 0]
    return last - count + 1, count


def _with_errors(
    camera: Camera, exact: _Exact, noise: EdgeNoise, rng: np.random.Generator
) -> EdgeSet:
    """Edges with noise, its covariance, and what an outward shift by a pixel does."""
    edges = exact.edges
    by_shift, by_tilt = _responses(camera, exact)
    error = rng.standard_normal((len(edges), 2)) * (noise.shift, noise.tilt)
    turn = by_shift * (error[:, :1] + noise.outward) + by_tilt * error[:, 1:]
    normal = edges.normal + (edges.basis @ turn[..., None])[..., 0]
    normal = normal / np.sqrt(dot(normal, normal))[..., None]
    basis = tangent_basis(normal, exact.rays[:, PLACES // 2])
    parts = np.stack([by_shift * noise.shift, by_tilt * noise.tilt], axis=-1)
    return replace(
        edges, normal=normal, basis=basis, covariance=parts @ parts.mT,
        shift=by_shift,
    )  # fmt: skip


def _responses(camera: Camera, exact: _Exact) -> tuple[Array, Array]:
    """Change (N, 2) of the normal, in its basis, when the edge moves outward by one pixel
    everywhere, and when its far end moves outward by one pixel and its near end inward.

    A point at ray s that moves outward by e px turns by e c, c = |J^T n| with J = d ray/d pixel,
    and the plane follows where s . dn = -c e: least squares over the places, each in px.
    """
    n = exact.edges.normal
    by_pixel, _ = camera.ray_jacobians(exact.pixels)
    gradient = np.einsum("nkij,ni->nkj", by_pixel, n)
    c = np.sqrt(dot(gradient, gradient))
    design = -np.einsum("nki,nij->nkj", exact.rays, exact.edges.basis) / c[..., None]
    step = np.diff(exact.pixels, axis=1)
    run = np.concatenate(
        [np.zeros((len(n), 1)), np.cumsum(np.sqrt(dot(step, step)), axis=1)], axis=1
    )
    tilt = 2 * run / np.maximum(run[:, -1:], 1e-300) - 1
    gain = np.linalg.pinv(design)
    return gain.sum(axis=-1), np.einsum("njk,nk->nj", gain, tilt)


def _with_wrong_ones(edges: EdgeSet, fraction: float, rng: np.random.Generator) -> EdgeSet:
    """Some edges replaced by what another leg of the same photograph gave on the same side."""
    if fraction <= 0:
        return edges
    source = np.arange(len(edges))
    group = np.stack([edges.station, edges.configuration, edges.side], axis=-1)
    _, member, count = np.unique(group, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(member, kind="stable")
    first = np.cumsum(count) - count
    wrong = rng.random(len(edges)) < fraction
    for _ in range(8):  # a draw may hit the leg itself; an edge that is alone stays right
        pick = order[first[member] + (rng.random(len(edges)) * count[member]).astype(int)]
        again = wrong & (edges.leg[source] == edges.leg)
        source = np.where(again, pick, source)
    taken = edges.select(source)
    return replace(
        edges, normal=taken.normal, basis=taken.basis, covariance=taken.covariance,
        shift=taken.shift, span=taken.span,
    )  # fmt: skip
