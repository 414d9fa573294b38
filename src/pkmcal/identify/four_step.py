"""[A] section 3: four steps from leg axes to the machine, as printed and corrected.

1. base centres in each station's camera frame ([A] 6, or [B] 14 on the edges themselves);
2. base centres in one frame ([A] 9);
3. offsets of the readings ([A] 13-14);
4. platform centres ([A] 16).

``corrected`` follows errata: stations and photographs are joined by rigid registration,
offsets minimise the deviations from each pair's mean distance. ``printed`` uses products of
distances, consecutive differences and averaged distances as the paper has them.

Arrays: B runs, S stations, C photographs (one station, one configuration), L legs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import apply, cross, dot, register
from pkmcal.identify import linear
from pkmcal.identify.gauge import ThreeCentres, centre_index
from pkmcal.identify.problem import Measurements, State
from pkmcal.identify.registration import SCALE, fit_body, minimise_dense
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.limbs import leg_readings
from pkmcal.observe.edges import EdgeSet

Form = Literal["corrected", "printed"]


@dataclass(frozen=True)
class Axes:
    """Leg axes as the photographs show them, camera frame.

    station, configuration : (C,) of each photograph. seen : (C, L).
    u, point : (B, C, L, 3) direction from A to B, and any point of the axis (m).
    readings : (B, C, L).
    """

    station: Integers
    configuration: Integers
    seen: Booleans
    u: Array
    point: Array
    readings: Array


@dataclass(frozen=True)
class FourSteps:
    """The steps' results: base (B, L, 3), offsets (B, L), platform (B, L, 3),
    T_camera_base (B, S, 4, 4); m, frames by three centres.
    """

    base: Array
    offsets: Array
    platform: Array
    T_camera_base: Array


def centres_from_axes(axes: Axes, n_stations: int) -> tuple[Array, Booleans]:
    """Step 1, [A] 6: the point nearest to a leg's axes, sum (I - u u^T)(M - A) = 0.

    Returns A (B, S, L, 3) in the camera frames and (S, L) whether each could be found.
    """
    project = np.eye(3) - axes.u[..., :, None] * axes.u[..., None, :]
    project = np.where(axes.seen[..., None, None], project, 0.0)
    right = (project @ np.where(axes.seen[..., None], axes.point, 0.0)[..., None])[..., 0]
    of_station = (axes.station == np.arange(n_stations)[:, None]).astype(float)
    normal = np.einsum("sc,bclij->bslij", of_station, project)
    right = np.einsum("sc,bcli->bsli", of_station, right)
    values = np.linalg.eigvalsh(normal)
    found = np.all(values[..., 0] > 1e-6 * values[..., 2], axis=0)
    normal = np.where(found[..., None, None], normal, np.eye(3))
    return np.linalg.solve(normal, right[..., None])[..., 0], found


def base_by_registration(a_camera: Array, seen: Booleans, drawing: Array, gauge: Array) -> Array:
    """Step 2 corrected: base centres (B, L, 3) from those in the camera frames (B, S, L, 3)."""
    enough = seen.sum(axis=1) >= 3
    weight = np.broadcast_to(seen & enough[:, None], a_camera.shape[:-1]).astype(float)
    return fit_body(a_camera[:, enough], weight[:, enough], gauge, drawing).points


def base_by_products(a_camera: Array, seen: Booleans, drawing: Array, gauge: Array) -> Array:
    """Step 2 as printed, [A] 9: scalar products of the vectors between centres, p <= q.

    The vectors of a station run from its first seen leg to its others.
    """
    pairs: list[tuple[int, int, int, int]] = []
    for s, row in enumerate(seen):
        legs = np.flatnonzero(row)
        pairs += [(s, legs[0], p, q) for i, p in enumerate(legs[1:]) for q in legs[1 + i :]]
    s, ref, p, q = np.array(pairs, dtype=int).reshape(-1, 4).T
    known = dot(a_camera[:, s, p] - a_camera[:, s, ref], a_camera[:, s, q] - a_camera[:, s, ref])
    k = np.arange(len(s))

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        points = x.reshape(len(x), -1, 3)
        vp, vq = points[:, p] - points[:, ref], points[:, q] - points[:, ref]
        jac = np.zeros((len(x), len(k), points.shape[1], 3))
        for index, slope in ((p, vq), (q, vp), (ref, -vp - vq)):
            jac[:, k, index] += slope
        held = (x - drawing.ravel()) @ gauge.T
        value = np.concatenate([dot(vp, vq) - known[runs], held], axis=1)
        gauge_rows = np.broadcast_to(gauge, (len(x), *gauge.shape))
        jac = np.concatenate([jac.reshape(len(x), len(k), -1), gauge_rows], axis=1)
        return value / SCALE, jac / SCALE

    start = np.broadcast_to(drawing.ravel(), (len(a_camera), drawing.size)).copy()
    return minimise_dense(rows, start).state.reshape(-1, *drawing.shape)


def offsets(axes: Axes, a_photo: Array, start: Array, form: Form) -> Array:
    """Step 3, [A] 13-14: offsets (B, L) that keep the distances between platform joints.

    a_photo : (B, C, L, 3) base centres in each photograph's camera frame.
    start : (L,) m.
    """
    j, g = np.triu_indices(axes.seen.shape[1], 1)
    both = axes.seen[:, j] & axes.seen[:, g]
    mix = _consecutive(axes, both) if form == "printed" else _deviations(both)
    fixed = a_photo + axes.readings[..., None] * axes.u
    pair = np.arange(len(j))

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        b = fixed[runs] + x[:, None, :, None] * axes.u[runs]
        d = b[:, :, j] - b[:, :, g]
        distance = np.sqrt(np.maximum(dot(d, d), 1e-300))
        e = d / distance[..., None]
        jac = np.zeros((*distance.shape, x.shape[-1]))
        jac[:, :, pair, j] = dot(e, axes.u[runs][:, :, j])
        jac[:, :, pair, g] = -dot(e, axes.u[runs][:, :, g])
        value = np.einsum("pkc,bcp->bkp", mix, distance)
        jac = np.einsum("pkc,bcpl->bkpl", mix, jac, optimize=True)
        n = value.shape[1] * value.shape[2]
        return value.reshape(len(x), n) / SCALE, jac.reshape(len(x), n, -1) / SCALE

    return minimise_dense(rows, np.broadcast_to(start, (len(fixed), len(start))).copy()).state


def _deviations(both: Booleans) -> Array:
    """Matrices (pairs, C, C) that take each pair's mean off its distances."""
    w = both.T.astype(float)
    mean = w[:, :, None] * w[:, None, :] / np.maximum(w.sum(axis=1), 1)[:, None, None]
    return np.eye(both.shape[0]) * w[:, :, None] - mean


def _consecutive(axes: Axes, both: Booleans) -> Array:
    """Matrices (pairs, C - 1, C) of differences between consecutive photographs of a station."""
    n = both.shape[0]
    step = np.eye(n, k=1)[:-1] - np.eye(n)[:-1]
    use = (both[1:] & both[:-1]).T * (axes.station[1:] == axes.station[:-1])
    return step * use[:, :, None]


def platform_by_registration(axes: Axes, b_photo: Array, drawing: Array, gauge: Array) -> Array:
    """Step 4 corrected: platform centres (B, L, 3) from those in the photographs."""
    enough = axes.seen.sum(axis=1) >= 3
    weight = np.broadcast_to(axes.seen[enough], b_photo[:, enough].shape[:-1]).astype(float)
    return fit_body(b_photo[:, enough], weight, gauge, drawing).points


def platform_by_distances(axes: Axes, b_photo: Array, drawing: Array, gauge: Array) -> Array:
    """Step 4 as printed, [A] 16: centres whose distances are each station's mean distances."""
    j, g = np.triu_indices(axes.seen.shape[1], 1)
    both = (axes.seen[:, j] & axes.seen[:, g]).astype(float)
    of_station = (axes.station == np.unique(axes.station)[:, None]).astype(float)
    count = of_station @ both
    d = np.linalg.norm(b_photo[:, :, j] - b_photo[:, :, g], axis=-1)
    known = np.einsum("sc,bcp->bsp", of_station, d * both) / np.maximum(count, 1)
    k, pair = np.nonzero(count)
    j, g, known = j[pair], g[pair], known[:, k, pair]
    row = np.arange(len(j))

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        points = x.reshape(len(x), -1, 3)
        v = points[:, j] - points[:, g]
        distance = np.sqrt(dot(v, v))
        jac = np.zeros((len(x), len(j), points.shape[1], 3))
        jac[:, row, j] = v / distance[..., None]
        jac[:, row, g] = -v / distance[..., None]
        held = (x - drawing.ravel()) @ gauge.T
        value = np.concatenate([distance - known[runs], held], axis=1)
        gauge_rows = np.broadcast_to(gauge, (len(x), *gauge.shape))
        jac = np.concatenate([jac.reshape(len(x), len(j), -1), gauge_rows], axis=1)
        return value / SCALE, jac / SCALE

    start = np.broadcast_to(drawing.ravel(), (len(b_photo), drawing.size)).copy()
    return minimise_dense(rows, start).state.reshape(-1, *drawing.shape)


def solve(machine: Machine, axes: Axes, a_camera: Array, found: Booleans, form: Form) -> FourSteps:
    """Steps 2 to 4 from the base centres in the camera frames, all runs at once.

    a_camera : (B, S, L, 3) with (S, L) whether found; the machine's values start the search.
    """
    base_index, platform_index = centre_index(machine.layout)
    drawing = machine.parameters.drawing
    gauge = ThreeCentres().constraints(machine)
    base_gauge = gauge[:6][:, base_index.ravel()]
    platform_gauge = gauge[6:][:, platform_index.ravel()]
    join = base_by_registration if form == "corrected" else base_by_products
    base = join(np.where(found[..., None], a_camera, 0.0), found, drawing[base_index], base_gauge)
    weight = np.broadcast_to(np.maximum(found, 1e-12), a_camera.shape[:-1])
    T_camera_base = register(base[:, None], np.where(found[..., None], a_camera, 0.0), weight)
    if form == "corrected":
        a_photo = apply(T_camera_base[:, axes.station, None], base[:, None])
    else:
        a_photo = np.where(found[..., None], a_camera, 0.0)[:, axes.station]
    q0 = offsets(axes, a_photo, drawing[machine.layout.rod], form)
    b_photo = a_photo + (axes.readings + q0[:, None])[..., None] * axes.u
    last = platform_by_registration if form == "corrected" else platform_by_distances
    platform = last(axes, b_photo, drawing[platform_index], platform_gauge)
    return FourSteps(base, q0, platform, T_camera_base)


def axes_from_edges(machine: Machine, measurements: Measurements, weights: Array) -> Axes:
    """Leg axes of a session (B = 1) from the edges that count, [A] 4-5.

    The direction is what is least along the normals, over all edges of the leg in a
    photograph; both sides are needed, or the direction would be arbitrary.
    """
    edges = measurements.edges
    photo, index = np.unique(
        edges.station * len(measurements.joints) + edges.configuration, return_inverse=True
    )
    n_legs = machine.n_legs
    u, point, seen = _axes_of_groups(
        edges,
        linear.edge_radii(machine, edges),
        weights,
        index * n_legs + edges.leg,
        len(photo) * n_legs,
    )
    station, configuration = np.divmod(photo, len(measurements.joints))
    readings = leg_readings(machine.layout, measurements.joints[configuration])
    full = (1, len(photo), n_legs)
    return Axes(
        station,
        configuration,
        seen.reshape(full[1:]),
        u.reshape(*full, 3),
        point.reshape(*full, 3),
        readings[None],
    )


def _axes_of_groups(
    edges: EdgeSet, radius: Array, weights: Array, group: Integers, n_groups: int
) -> tuple[Array, Array, Booleans]:
    """Direction, point (n, 3) and whether both sides count, of each group of edges."""
    weight = np.where(weights > 0.5, 1 / np.trace(edges.covariance, axis1=1, axis2=2), 0.0)
    weighted = weight[:, None] * edges.normal
    normal, right = np.zeros((n_groups, 3, 3)), np.zeros((n_groups, 3))
    sides = np.zeros((2, n_groups, 3))
    np.add.at(normal, group, weighted[:, :, None] * edges.normal[:, None])
    np.add.at(right, group, -radius[:, None] * weighted)
    np.add.at(sides, (edges.side, group), weighted)
    both = np.linalg.norm(sides, axis=-1) > 0
    seen = both[0] & both[1]
    total = np.maximum(np.bincount(group, weight, n_groups), 1e-300)
    normal = np.where(seen[:, None, None], normal / total[:, None, None], np.eye(3))
    u = np.linalg.eigh(normal)[1][..., 0]
    u = u * np.where(dot(u, cross(sides[1], sides[0])) < 0, -1.0, 1.0)[:, None]
    # n.M = -R in the plane across the axis, and u.M = 0
    across = normal + u[:, :, None] * u[:, None, :]
    point = np.linalg.solve(across, (right / total[:, None])[..., None])[..., 0]
    return u, point, seen


def through_centres(machine: Machine, edges: EdgeSet, centres: Array) -> EdgeSet:
    """Edges made to pass their base centre exactly, n.A = -R, at the least Mahalanobis change.

    The centre is known from all configurations, so it takes out most of an edge's tilt error.
    centres : (S, L, 3) m, camera frames; edges of a NaN centre stay as they are.
    """
    a = centres[edges.station, edges.leg]
    known: Booleans = np.all(np.isfinite(a), axis=-1)
    a = np.where(known[:, None], a, 0.0)
    along = np.swapaxes(edges.basis, -1, -2) @ a[..., None]
    gain = edges.covariance @ along
    spread = np.maximum((np.swapaxes(along, -1, -2) @ gain)[..., 0], 1e-300)
    miss = np.where(known, dot(edges.normal, a) + linear.edge_radii(machine, edges), 0.0)
    change = (edges.basis @ gain)[..., 0] * (miss[:, None] / spread)
    normal = edges.normal - change
    return replace(edges, normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def four_step(
    machine: Machine,
    measurements: Measurements,
    *,
    form: Form = "corrected",
    T_camera_base_guess: Array | None = None,
    rng: np.random.Generator | None = None,
) -> State:
    """[A]'s four steps on a session: a state that can be used as it is or start the bundle.

    corrected takes the edges themselves for the base centres and survives wrong edges.
    T_camera_base_guess : (S, 4, 4) for stations that see fewer than three legs well enough;
    without it they are an error. Poses come from the readings by forward kinematics.
    """
    found_linear = linear.centres(machine, measurements, "robust", rng)
    edges = measurements.edges
    if form == "corrected":
        edges = through_centres(machine, edges, found_linear.centres)
    axes = axes_from_edges(machine, replace(measurements, edges=edges), found_linear.weights)
    a_camera = found_linear.centres[None]
    found: Booleans = np.all(np.isfinite(found_linear.centres), axis=-1)
    if form == "printed":
        a_camera, found = centres_from_axes(axes, measurements.n_stations)
    _check(machine, found, T_camera_base_guess)
    steps = solve(machine, axes, a_camera, found, form)
    base_index, platform_index = centre_index(machine.layout)
    theta = machine.values.copy()
    theta[base_index], theta[platform_index] = steps.base[0], steps.platform[0]
    theta[machine.layout.rod] = steps.offsets[0]
    poses = machine.with_values(theta).forward_result(measurements.joints, machine.home())
    stations = steps.T_camera_base[0]
    if T_camera_base_guess is not None:
        few = found.sum(axis=1) < 3
        stations = np.where(few[:, None, None], T_camera_base_guess, stations)
    n_cameras = int(np.max(measurements.camera_of_station)) + 1
    return State(theta, stations, poses.T_base_platform, np.zeros(n_cameras))


def _check(machine: Machine, found: Booleans, guess: Array | None) -> None:
    few = np.flatnonzero(found.sum(axis=1) < 3)
    if guess is None and few.size:
        raise ResultError(
            what=f"station {few[0] + 1} sees too few legs for the four steps",
            found=f"{found[few[0]].sum()} base centres",
            expected="three or more, each leg seen in two directions",
            next_step="give the station's pose, or use the joint method (bundle)",
        )
    lost = np.flatnonzero(~found.any(axis=0))
    if lost.size:
        raise ResultError(
            what=f"leg {lost[0] + 1} of {machine.n_legs} is seen by no station well enough",
            expected="every leg seen in two directions at least, [A] 3.3",
            next_step="add configurations or a station, or use the joint method (bundle)",
        )
