"""The simulation of [A] 4.3, corrected: four steps against the joint estimate and its bound.

A Gough-Stewart platform, three stations that each see four legs in fifteen configurations
with extreme leg lengths; axes measured with the noise of Table 1 in degrees, three images
averaged; drawing errors uniform within 2 mm. Runs are batched.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import apply, inverse, look_at, perturb, register, rotation_vector
from pkmcal.identify.assembly import prior_rows
from pkmcal.identify.axis_measurements import AxisNoise, as_edges, from_coordinates, to_coordinates
from pkmcal.identify.bundle import BatchResult, solve_batch
from pkmcal.identify.covariance import information
from pkmcal.identify.four_step import Axes, Form, centres_from_axes, solve
from pkmcal.identify.gauge import ThreeCentres, centre_index, freedoms, generators, projector
from pkmcal.identify.residuals import BatchState, Blocks, Data, Problem
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.mechanisms.kinematics import forward
from pkmcal.mechanisms.limbs import limb_ends

CHUNK = 25
"""Runs solved at once; more only leaves the processor's cache."""


@dataclass(frozen=True)
class Settings:
    """[A] 4.3. drawing_error, joint_noise : m, standard deviations of uniform errors ("variance
    equal to 2 mm"). distance, height : of the cameras, m. poses : per station.
    """

    poses: int = 15
    legs_seen: int = 4
    noise: AxisNoise = field(default_factory=AxisNoise)
    joint_noise: float = 3e-6
    drawing_error: float = 0.002
    distance: float = 0.9
    height: float = 0.2
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


class Accuracy(NamedTuple):
    """RMSE over runs, m and rad. base_xy to offset : the thirty parameters in the frames of
    centres 1, 3 and 5. displacement, orientation : mean error of the end-effector, [A] eq. 20,
    in those frames; the last two with frames registered on all centres, so that the error of
    the frames' own definition by three joints is left out.
    """

    base_xy: float
    base_z: float
    platform_xy: float
    platform_z: float
    offset: float
    displacement: float
    orientation: float
    displacement_registered: float
    orientation_registered: float

    @property
    def parameters(self) -> float:
        """RMSE over all thirty parameters."""
        squares = np.square([self.base_xy, self.base_z, self.platform_xy, self.platform_z])
        return float(np.sqrt((squares @ [9, 3, 9, 3] + 6 * self.offset**2) / 30))


@dataclass(frozen=True)
class Study:
    """Accuracy by method (the bound has no end-effector), chi2 over degrees of freedom of each
    run, solver steps of each run, and runs that converged to the right answer.
    """

    accuracy: dict[str, Accuracy]
    chi2_per_dof: Array
    steps: Integers
    converged: int


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


def four_steps(machine: Machine, settings: Settings, truth: Truth) -> Iterator[tuple[str, Array]]:
    """Parameters (B, P) by the four steps, as printed and with registration."""
    axes = measured_axes(machine, settings, truth)
    a_camera, found = centres_from_axes(axes, 3)
    base, platform = centre_index(machine.layout)
    forms: dict[str, Form] = {"four steps as printed": "printed", "four steps": "corrected"}
    for name, form in forms.items():
        steps = solve(machine, axes, a_camera, found, form)
        theta = np.broadcast_to(machine.parameters.drawing, truth.theta.shape).copy()
        theta[:, base], theta[:, platform] = steps.base, steps.platform
        theta[:, machine.layout.rod] = steps.offsets
        yield name, theta


def joint(machine: Machine, problem: Problem, truth: Truth, start_error: Array) -> BatchResult:
    """The joint estimate, started from parameters start_error (B, P) off the drawing.

    Stations start within a few degrees and centimetres, poses by forward kinematics.
    """
    theta = machine.parameters.drawing + start_error
    poses = forward(
        machine.layout, theta[:, None], truth.joints, np.broadcast_to(machine.home(), (1, 1, 4, 4))
    ).T_base_platform
    guess = perturb(truth.T_camera_base, np.array([0.03, -0.02, 0.03, 0.01, -0.01, 0.02]))
    z = (theta - machine.parameters.drawing) @ np.linalg.pinv(problem.free).T
    n = len(theta)
    start = BatchState(z, np.broadcast_to(guess, (n, 3, 4, 4)), poses, np.zeros((n, 1, 1)))
    return solve_batch(problem, start, robust=False, scale_noise=False)


def bound(machine: Machine, problem: Problem, truth: Truth) -> Array:
    """Cramér-Rao variances (B, P) in the frames of three centres, at the truth."""
    z = (truth.theta - machine.parameters.drawing) @ np.linalg.pinv(problem.free).T
    n = len(z)
    T = np.broadcast_to(truth.T_camera_base, (n, 3, 4, 4))
    info = information(problem, BatchState(z, T, truth.T_base_platform, np.zeros((n, 1, 1))))
    nz = problem.free.shape[1]
    change = projector(machine, truth.theta, ThreeCentres())
    spread = problem.free - generators(machine.layout, truth.theta) @ change @ problem.free
    return np.einsum("bpi,bij,bpj->bp", spread, info.covariance[:, :nz, :nz], spread, optimize=True)


def accuracy(machine: Machine, theta: Array, truth: Truth, rng: np.random.Generator) -> Accuracy:
    """RMSE of parameters (B, P) and of the end-effector at ten random poses a run."""
    return _summary(machine, (theta - truth.theta) ** 2, _end_effector(machine, theta, truth, rng))


def _summary(machine: Machine, squares: Array, effector: tuple[float, ...]) -> Accuracy:
    """Root mean squares by group; 9, 3, 9, 3 and 6 of the coordinates are free in the frames."""
    base, platform = centre_index(machine.layout)
    n = len(squares)
    groups = ((base[:, :2], 9), (base[:, 2], 3), (platform[:, :2], 9), (platform[:, 2], 3))
    rms = [float(np.sqrt(squares[:, index].sum() / (n * free))) for index, free in groups]
    offset = float(np.sqrt(squares[:, machine.layout.rod].mean()))
    return Accuracy(rms[0], rms[1], rms[2], rms[3], offset, *effector)


def _end_effector(
    machine: Machine, theta: Array, truth: Truth, rng: np.random.Generator
) -> tuple[float, float, float, float]:
    """[A] eq. 20 at ten random readings a run: displacement and angle, twice (see Accuracy)."""
    low, high = machine.joint_ranges.T
    readings = rng.uniform(low, high, (len(theta), 10, 6))
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    T, T_true = (
        forward(machine.layout, p[:, None], readings, home).T_base_platform
        for p in (theta, truth.theta)
    )
    base, platform = centre_index(machine.layout)
    e = register(theta[:, base], truth.theta[:, base])[:, None]
    f = register(theta[:, platform], truth.theta[:, platform])[:, None]
    b1 = truth.theta[:, None, platform[0]]  # the frames hold A1 and B1 at the drawing's values
    out: list[float] = []
    for moved in (T, e @ T @ inverse(f)):
        out.append(float(np.linalg.norm(apply(moved, b1) - apply(T_true, b1), axis=-1).mean()))
        turn = moved[..., :3, :3] @ np.swapaxes(T_true[..., :3, :3], -1, -2)
        out.append(float(np.linalg.norm(rotation_vector(turn), axis=-1).mean()))
    return out[0], out[1], out[2], out[3]


def study(
    runs: int = 200,
    settings: Settings | None = None,
    seed: int = 20020,
    start_error: float = 0.0,
) -> Study:
    """The whole study. start_error : further uniform error of the joint estimate's start, m."""
    settings = settings or Settings()
    machine = study_machine()
    rng = np.random.default_rng(seed)
    parts: dict[str, list[Array]] = {}
    truths: list[Truth] = []
    chi2, steps, right = [], [], 0
    for first in range(0, runs, CHUNK):
        truth = simulate(machine, settings, min(CHUNK, runs - first), rng)
        truths.append(truth)
        for name, theta in four_steps(machine, settings, truth):
            parts.setdefault(name, []).append(theta)
        problem = joint_problem(machine, settings, truth)
        error = rng.uniform(-1, 1, truth.theta.shape) * start_error
        result = joint(machine, problem, truth, error @ problem.free @ problem.free.T)
        parts.setdefault("joint", []).append(problem.theta(result.solution.state))
        parts.setdefault("bound", []).append(bound(machine, problem, truth))
        chi2.append(result.solution.cost / degrees_of_freedom(problem))
        steps.append(result.steps)
        right += int(np.sum(result.solution.cost < 1.5 * degrees_of_freedom(problem)))
    all_truth = _together(truths)
    none = (float("nan"),) * 4
    table = {
        name: _summary(machine, np.concatenate(part), none)
        if name == "bound"
        else accuracy(machine, np.concatenate(part), all_truth, np.random.default_rng(seed + 1))
        for name, part in parts.items()
    }
    return Study(table, np.concatenate(chi2), np.concatenate(steps), right)


def _together(truths: list[Truth]) -> Truth:
    """All runs; the stations are the same in each."""
    first = truths[0]
    parts = {
        name: np.concatenate([getattr(t, name) for t in truths])
        for name in Truth._fields
        if name != "T_camera_base"
    }
    return first._replace(**parts)


def degrees_of_freedom(problem: Problem) -> int:
    """Residuals less unknowns of a study's problem; the gauge's rows fix twelve of them."""
    n_configurations = problem.blocks.leg.shape[0]
    data = n_configurations * (problem.n_edge_rows + problem.layout.n_legs)
    shared = problem.free.shape[1] - 12 + 6 * problem.n_stations
    return data - shared - 6 * n_configurations
