"""The simulated measurements of [A] 4.3: machines, stations, poses, axes with their noise.

A Gough-Stewart platform, three stations that each see four legs in fifteen configurations with
extreme leg lengths; axes measured with the noise of Table 1 in degrees, three images averaged;
drawing errors uniform. Runs are batched: B of them, K configurations, L legs, S stations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import apply, look_at
from pkmcal.identify.assembly import prior_rows
from pkmcal.identify.gauge import ThreeCentres, freedoms
from pkmcal.identify.residuals import Blocks, Data, Problem
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.kinematics import forward
from pkmcal.papers.axis_measurements import AxisNoise, as_edges, from_coordinates, to_coordinates
from pkmcal.papers.four_step import Axes


@dataclass(frozen=True)
class Settings:
    """[A] 4.3. poses : per station. drawing_error, joint_noise : m, standard deviations of uniform
    errors ("variance equal to 2 mm"). distance, height : of the cameras, which look level, m.

    The paper does not say where they stand. The distance has no influence, since Table 1 is in
    the camera's frame. The height has: the axis's point with y = 0 lies there, and errors of
    direction grow away from it. So it is the middle of the legs.
    """

    poses: int = 15
    legs_seen: int = 4
    noise: AxisNoise = field(default_factory=AxisNoise)
    joint_noise: float = 3e-6
    drawing_error: float = 0.002
    distance: float = 0.9
    height: float = 0.18
    extreme: bool = True


class Truth(NamedTuple):
    """Simulated runs: theta (B, P), T_camera_base (S, 4, 4), T_base_platform (B, K, 4, 4),
    measured joints (B, K, m), axis coordinates (B, K, G, 4).
    """

    theta: Array
    T_camera_base: Array
    T_base_platform: Array
    joints: Array
    axis: Array


def study_machine() -> Machine:
    """The catalogue's Gough-Stewart platform with its radii held: axes do not need them."""
    machine = load_mechanism("gough-stewart")
    radii = [
        n
        for n, k in zip(machine.parameters.names, machine.parameters.kinds, strict=True)
        if k == "radius"
    ]
    return replace(machine, parameters=machine.parameters.with_roles(fixed=tuple(radii)))


def stations(settings: Settings) -> Array:
    """T_camera_base (3, 4, 4): cameras on a circle, each between two pairs of base joints."""
    angles = np.radians([60.0, 180.0, 300.0])
    return np.stack(
        [
            look_at(
                np.array(
                    [settings.distance * np.cos(a), settings.distance * np.sin(a), settings.height]
                ),
                np.array([0.0, 0.0, settings.height]),
                np.array([0.0, 0.0, 1.0]),
            )
            for a in angles
        ]
    )


def visible(machine: Machine, T_camera_base: Array, settings: Settings) -> Integers:
    """The legs whose base joints are nearest to each camera, (S, legs_seen)."""
    depth = apply(T_camera_base[:, None], machine.base_centers())[..., 2]
    return np.sort(np.argsort(depth, axis=1)[:, : settings.legs_seen], axis=1)


def _station_of(settings: Settings) -> Integers:
    return np.repeat(np.arange(3), settings.poses)


def simulate(machine: Machine, settings: Settings, runs: int, rng: np.random.Generator) -> Truth:
    """True machines, poses and noisy measurements of ``runs`` runs."""
    table = machine.parameters
    error = _uniform(rng, (runs, len(table)), settings.drawing_error)
    error *= np.array(table.kinds) != "radius"
    held = ThreeCentres().constraints(machine)
    error -= error @ np.linalg.pinv(held) @ held  # the truth, told in the study's frames
    theta = table.drawing + error
    readings = _readings(machine, settings, runs, rng)
    start = machine.forward_result(readings.reshape(-1, 6)).T_base_platform
    poses = forward(
        machine.layout, theta[:, None], readings, start.reshape(*readings.shape[:2], 4, 4)
    ).T_base_platform
    T = stations(settings)
    ends = limb_ends(machine.layout, theta[:, None], readings, poses)
    station = _station_of(settings)
    legs = visible(machine, T, settings)[station]
    k = np.arange(len(station))[:, None]
    a, b = (apply(T[station][:, None], p[:, k, legs]) for p in (ends.a, ends.b))
    axis = to_coordinates(a, b)
    axis = axis + settings.noise.sigma() * rng.normal(size=axis.shape)
    noise = _uniform(rng, readings.shape, settings.joint_noise)
    return Truth(theta, T, poses, readings + noise, axis)


def _uniform(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Array:
    return rng.uniform(-1, 1, shape) * np.sqrt(3) * sigma


def _readings(machine: Machine, settings: Settings, runs: int, rng: np.random.Generator) -> Array:
    """Readings (B, K, 6): distinct corners of the legs' ranges per station, or uniform."""
    low, high = machine.joint_ranges.T
    if not settings.extreme:
        return rng.uniform(low, high, (runs, 3 * settings.poses, 6))
    corners = np.array(list(product(*zip(low, high, strict=True))))
    order = np.argsort(rng.random((runs, 3, len(corners))), axis=-1)
    repeats = -(-settings.poses // len(corners))
    pick = np.concatenate([order] * repeats, axis=-1)[..., : settings.poses]
    return corners[pick].reshape(runs, -1, 6)


def joint_problem(machine: Machine, settings: Settings, truth: Truth) -> Problem:
    """The joint problem of all runs: pairs of edges for axes, no drawing values."""
    station = _station_of(settings)
    legs = visible(machine, truth.T_camera_base, settings)[station]
    radius_index = np.array([index[0] for index in machine.layout.radius])[legs]
    shape = legs.shape
    blocks = Blocks(
        leg=legs,
        station=np.broadcast_to(station[:, None], shape),
        camera=np.zeros(shape, dtype=int),
        radius=radius_index,
        side=np.broadcast_to([0, 1], (*shape, 2)),
        present=np.ones(shape, dtype=bool),
    )
    radius = machine.parameters.drawing[radius_index]
    basis, whiten = as_edges(
        truth.axis, settings.noise.sigma(), np.broadcast_to(radius, truth.axis.shape[:-1])
    )
    data = Data(basis, whiten, np.zeros((1, *shape, 4, 1)), truth.joints, np.ones((1, *shape)))
    prior, target, _ = prior_rows(machine, ThreeCentres(), 3, 1, use_drawing=False)
    return Problem(
        layout=machine.layout,
        drawing=machine.parameters.drawing,
        free=machine.parameters.free_matrix(),
        blocks=blocks,
        data=data,
        joint_noise=settings.joint_noise,
        n_stations=3,
        n_cameras=1,
        prior=prior,
        prior_target=target,
        frames=freedoms(machine),
    )


def measured_axes(machine: Machine, settings: Settings, truth: Truth) -> Axes:
    """The measured axes as [A]'s steps want them."""
    station = _station_of(settings)
    legs = visible(machine, truth.T_camera_base, settings)[station]
    u, point, _, _ = from_coordinates(truth.axis)
    n_runs, n_photos = truth.joints.shape[:2]
    k = np.arange(n_photos)[:, None]
    seen = np.zeros((n_photos, machine.n_legs), dtype=bool)
    seen[k, legs] = True
    full_u, full_point = np.zeros((2, n_runs, n_photos, machine.n_legs, 3))
    full_u[:, k, legs], full_point[:, k, legs] = u, point
    return Axes(station, np.arange(n_photos), seen, full_u, full_point, truth.joints)
