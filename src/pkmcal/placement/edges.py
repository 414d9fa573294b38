"""Simulated edge measurements with known noise, without images; for studies and tests.

Axes: M images, E edges of the machine (each tube, side 0 then 1), n samples along an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.cylinders import (
    SIDE_SIGNS,
    contour_point,
    edge_normal,
    has_silhouette,
    line_through,
    tangent_basis,
)
from pkmcal.geometry.rigid import apply, dot
from pkmcal.measurements import EdgeSet, concatenate
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import TubeList, tubes_of
from pkmcal.placement.stations import one_a_station

POINTS_ALONG_EDGE = 48
"""Samples along each tube: a hidden stretch is bounded to a fiftieth of the tube."""
EDGE_TURN_POINTS = 13
"""Samples for an edge's response to a shift and a tilt, which is as smooth as the lens distortion.
"""
JOINT_HOUSING = 0.005
"""Length, in metres, at both ends of a tube that is never measured."""
HIDING_LEG_CLEARANCE = 2.0
"""Distance, in pixels, between an edge and a leg in front of it below which the two cannot be
separated."""
LEAST_VISIBLE_SAMPLES = 8
"""Consecutive visible samples that an edge needs; a shorter stretch hardly determines the tilt."""


@dataclass(frozen=True)
class EdgeNoise:
    """Errors of measured edges.

    shift, tilt : standard deviations, in px, of the sideways position of the whole edge, and of its
    ends when the edge turns about its middle. outward : constant shift of all edges, px. wrong :
    fraction of edges that are replaced by another leg's.
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
    images: Integers | None = None,
    joint_noise: float = 3e-6,
) -> tuple[EdgeSet, Array]:
    """Edges that a true machine would give, and its readings (K, m).

    T_camera_base : (S, 4, 4). camera : one for all stations, or one for each.
    T_base_platform : (K, 4, 4). images : (M, 2) pairs of station and configuration; all pairs
    by default. Edges outside the image or hidden behind other legs are omitted; a partly hidden
    edge keeps its longest visible stretch.
    """
    cameras = one_a_station(camera, len(T_camera_base))
    joints = machine.inverse(T_base_platform)
    if images is None:
        images = np.argwhere(np.ones((len(cameras), len(joints)), dtype=bool))
    tubes = tubes_of(machine)
    sets: list[EdgeSet] = []
    for station, one in enumerate(cameras):
        rows = images[images[:, 0] == station, 1]
        ends = machine.ends_at(joints[rows], T_base_platform[rows])
        a, b = (apply(T_camera_base[station], end) for end in ends.rods)
        exact, rays = visible_edges(one, tubes, machine.values[tubes.radius], a, b)
        exact = replace(
            exact,
            station=np.full(len(exact), station),
            configuration=rows[exact.configuration],
        )
        sets.append(_with_errors(one, exact, rays, noise, rng))
    edges = _with_wrong_ones(concatenate(sets), noise.wrong, rng)
    return edges, joints + joint_noise * rng.standard_normal(joints.shape)


def visible_edges(
    camera: Camera, tubes: TubeList, radius: Array, a: Array, b: Array
) -> tuple[EdgeSet, Array]:
    """Visible edges in M images of one camera, and unit rays (N, n, 3) along each edge.

    radius : (E,) m. a, b : (M, L, 3) legs' ends, camera frame. In the result all stations are 0,
    and configurations are the images' numbers; covariances and shifts are zero.
    """
    # exact silhouettes, sampled along each tube
    a_e, b_e = a[:, tubes.leg], b[:, tubes.leg]
    u, m = line_through(a_e, b_e)
    length = np.sqrt(dot(b_e - a_e, b_e - a_e))
    normal = edge_normal(u, m, radius, SIDE_SIGNS[tubes.side])
    first = np.broadcast_to(tubes.start + JOINT_HOUSING, length.shape)
    last = np.minimum(tubes.stop, length) - JOINT_HOUSING
    where = np.linspace(0, 1, POINTS_ALONG_EDGE)
    along = first[..., None] + (last - first)[..., None] * where
    points = contour_point(
        a_e[..., None, :], u[..., None, :], normal[..., None, :], radius[:, None], along
    )
    # visibility of each sample: in the image, and in front of all other tubes
    with np.errstate(invalid="ignore"):
        prediction = camera.in_image(camera.project(points))
        prediction &= (has_silhouette(m, radius) & (last > first))[..., None]
    prediction &= ~hidden(points, tubes.leg, tubes.tube, tubes, radius, a, b, pixel_angle(camera))
    # longest visible stretch of each edge
    begin, count = _longest_run(prediction)
    photo, edge = np.nonzero(count >= LEAST_VISIBLE_SAMPLES)
    begin, count = begin[photo, edge], count[photo, edge]
    span = np.stack([along[photo, edge, begin], along[photo, edge, begin + count - 1]], axis=-1)
    # edges of these stretches, with rays resampled along each
    normal = normal[photo, edge]
    points = contour_point(
        a_e[photo, edge][:, None], u[photo, edge][:, None], normal[:, None], radius[edge][:, None],
        span[:, :1] * (1 - where) + span[:, 1:] * where,
    )  # fmt: skip
    rays = points / np.sqrt(dot(points, points))[..., None]
    edges = EdgeSet(
        station=np.zeros(len(edge), dtype=int), configuration=photo,
        leg=tubes.leg[edge], tube=tubes.tube[edge], side=tubes.side[edge], normal=normal,
        basis=tangent_basis(normal, rays[:, POINTS_ALONG_EDGE // 2]),
        covariance=np.zeros((len(edge), 2, 2)), shift=np.zeros((len(edge), 2)), span=span,
    )  # fmt: skip
    return edges, rays


def hidden(
    points: Array, leg: Integers, tube: Integers, tubes: TubeList, radius: Array,
    a: Array, b: Array, pixel: float,
) -> Booleans:  # fmt: skip
    """(M, G, n) True where another leg, or another tube of the same leg, occludes a point.

    points : (M, G, n, 3), camera frame, m. leg, tube : (G,) the tube that the points lie on, -1 for
    points off the machine. radius : (E,) of the tubes, m. a, b : (M, L, 3) the legs' ends. pixel :
    angle of a pixel, rad; another leg also hides points within HIDING_LEG_CLEARANCE of its
    silhouette.
    """
    distance = np.sqrt(dot(points, points))
    margin = HIDING_LEG_CLEARANCE * pixel * distance
    d = points / distance[..., None]
    out = np.zeros(distance.shape, dtype=bool)
    for e in range(0, len(tubes.leg), 2):  # both sides of a tube are one cylinder
        j = tubes.leg[e]
        start, end = a[:, None, None, j], b[:, None, None, j]
        u, _ = line_through(start, end)
        length = np.sqrt(dot(end - start, end - start))
        du, au = dot(d, u), dot(start, u)
        # |t d - start|^2 across u, as a quadratic in t
        qa = np.maximum(1 - du**2, 1e-12)
        qb = dot(d, start) - du * au
        other = (leg != j)[:, None]
        qc = dot(start, start) - au**2 - (radius[e] + other * margin) ** 2
        disc = qb**2 - qa * qc
        t = (qb - np.sqrt(np.maximum(disc, 0.0))) / qa
        s = t * du - au
        inside = (s > tubes.start[e]) & (s < np.minimum(tubes.stop[e], length))
        meets = (disc > 0) & inside & (t > 0) & (t < distance)
        out |= meets & (other | (tube != tubes.tube[e])[:, None])
    return out


def pixel_angle(camera: Camera) -> float:
    """Angle, in rad, between neighbouring pixels in the middle of the image."""
    middle = (np.array(camera.image_size) - 1) / 2
    rays = camera.ray(middle + np.array([[0.0, 0.0], [1.0, 0.0]]))
    return float(np.linalg.norm(rays[1] - rays[0]))


def _longest_run(visible: Booleans) -> tuple[Integers, Integers]:
    """Start and length of the longest run of True along the last axis."""
    index = np.arange(visible.shape[-1])
    gap = np.where(visible, -1, index)
    # samples since the last gap, by a running maximum
    run = np.where(visible, index - np.maximum.accumulate(gap, axis=-1), 0)
    last = np.argmax(run, axis=-1)
    count = np.take_along_axis(run, last[..., None], axis=-1)[..., 0]
    return last - count + 1, count


def _with_errors(
    camera: Camera, edges: EdgeSet, rays: Array, noise: EdgeNoise, rng: np.random.Generator
) -> EdgeSet:
    """Edges with noise, its covariance, and the derivative of the normal by an outward shift."""
    few = rays[:, np.linspace(0, POINTS_ALONG_EDGE - 1, EDGE_TURN_POINTS).astype(int)]
    by_shift, by_tilt = moved_outward(camera, edges.normal, edges.basis, few)
    normal = disturbed(edges.normal, edges.basis, by_shift, by_tilt, noise, rng)
    parts = np.stack([by_shift * noise.shift, by_tilt * noise.tilt], axis=-1)
    return replace(
        edges, normal=normal, basis=tangent_basis(normal, rays[:, POINTS_ALONG_EDGE // 2]),
        covariance=parts @ parts.mT, shift=by_shift,
    )  # fmt: skip


def moved_outward(camera: Camera, normal: Array, basis: Array, rays: Array) -> tuple[Array, Array]:
    """Response of edges to a shift and to a tilt, (N, 2) each, as :func:`responses` defines them.

    normal : (N, 3). basis : (N, 3, 2). rays : (N, n, 3) unit rays along each edge. A point at ray s
    that moves outward by e px turns by e c, with c = |J^T n| and J = d ray / d pixel; the plane
    follows where s . dn = -c e.
    """
    pixels = camera.project(rays)
    by_pixel, _ = camera.ray_jacobians(pixels)
    gradient = np.einsum("nkij,ni->nkj", by_pixel, normal)
    by_turn = -np.einsum("nki,nij->nkj", rays, basis)
    return responses(by_turn / np.sqrt(dot(gradient, gradient))[..., None], pixels)


def responses(by_turn: Array, pixels: Array) -> tuple[Array, Array]:
    """Rotations (..., 2) of edges' normals, in their bases, by an outward shift and by a tilt.

    The shift moves the whole edge outward by one pixel; the tilt moves the far end out by one pixel
    and the near end in. by_turn : (..., n, 2) outward motion, in px, of n samples per unit
    rotation. pixels : (..., n, 2). Least squares over the samples; zero if no sample of an edge
    projects into the image (NaN).
    """
    step = np.diff(np.nan_to_num(pixels), axis=-2)
    run = np.cumsum(np.sqrt(dot(step, step)), axis=-1)
    run = np.concatenate([np.zeros((*run.shape[:-1], 1)), run], axis=-1)
    tilt = 2 * run / np.maximum(run[..., -1:], 1e-300) - 1
    value = np.stack([np.ones(tilt.shape), tilt], axis=-1)
    rows = np.nan_to_num(by_turn)
    turned = rows.mT
    normal = turned @ rows + 1e-300 * np.eye(2)
    gone = np.abs(np.linalg.det(normal)) < 1e-200  # no sample of the edge projects into the image
    solved = np.linalg.solve(np.where(gone[..., None, None], np.eye(2), normal), turned @ value)
    return solved[..., 0], solved[..., 1]


def disturbed(
    normal: Array, basis: Array, by_shift: Array, by_tilt: Array, noise: EdgeNoise,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Normals (..., 3) with random shift, tilt and the constant outward shift.

    basis : (..., 3, 2). by_shift, by_tilt : (..., 2), as from :func:`responses`.
    """
    error = rng.standard_normal((*by_shift.shape[:-1], 2)) * (noise.shift, noise.tilt)
    turn = by_shift * (error[..., :1] + noise.outward) + by_tilt * error[..., 1:]
    shifted = normal + (basis @ turn[..., None])[..., 0]
    return shifted / np.sqrt(dot(shifted, shifted))[..., None]


def _with_wrong_ones(edges: EdgeSet, fraction: float, rng: np.random.Generator) -> EdgeSet:
    """Edges of which a fraction is replaced by the edge of another leg on the same side of the
    image.
    """
    if fraction <= 0:
        return edges
    source = np.arange(len(edges))
    group = np.stack([edges.station, edges.configuration, edges.side], axis=-1)
    _, member, count = np.unique(group, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(member, kind="stable")
    first = np.cumsum(count) - count
    wrong = rng.random(len(edges)) < fraction
    for _ in range(8):  # a draw may hit the leg itself; a lone edge stays as it is
        pick = order[first[member] + (rng.random(len(edges)) * count[member]).astype(int)]
        again = wrong & (edges.leg[source] == edges.leg)
        source = np.where(again, pick, source)
    taken = edges.select(source)
    return replace(
        edges, normal=taken.normal, basis=taken.basis, covariance=taken.covariance,
        shift=taken.shift, span=taken.span,
    )  # fmt: skip
