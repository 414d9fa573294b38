"""Study of [A] 4.3: a hexapod and three stations that each measure the axes of four legs.

A Gough-Stewart platform in fifteen configurations per station with extreme leg lengths; axes
measured with the noise of Table 1 in degrees, averaged over three images; uniform errors of the
nominal model. Compared are the paper's four steps as printed and corrected, the joint estimate, and
the Cramér-Rao bound. A second setting has the joint estimate alone, which ``pkmcal study`` varies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import (
    apply,
    inverse,
    look_at,
    perturb,
    pose_difference,
    register,
    rotation_vector,
)
from pkmcal.identify.axis_measurements import AxisNoise, from_coordinates
from pkmcal.identify.covariance import Information
from pkmcal.identify.gauge import ThreeCentres, centre_index, generators, projector
from pkmcal.identify.methods.four_step import FourStepForm, parameters_of, solve_from_centres
from pkmcal.identify.methods.leg_axes import Axes, centres_from_axes
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms import Machine, load_mechanism, machine_from_document, with_exact_scales
from pkmcal.mechanisms.closure import by_own, closure, dense
from pkmcal.mechanisms.kinematics import forward
from pkmcal.studies.calibrations import CALIBRATED_QUANTITIES as CALIBRATED
from pkmcal.studies.calibrations import JOINT_ESTIMATE_KEY, judged
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.estimates import Fitted, freedom, joint, nominal_estimate
from pkmcal.studies.simulated import (
    Noise,
    SimulatedRuns,
    Viewpoints,
    joint_problem,
    simulate_runs,
    spread_evenly,
)
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample

PAPER_A_NOMINAL, FOUR_STEPS_PRINTED, FOUR_STEPS_CORRECTED = (
    "drawing",
    "four steps as printed",
    "four steps",
)
PAPER_A_JOINT, PAPER_A_BOUND = "joint", "bound"
PAPER_A_METHODS = (
    PAPER_A_NOMINAL,
    FOUR_STEPS_PRINTED,
    FOUR_STEPS_CORRECTED,
    PAPER_A_JOINT,
    PAPER_A_BOUND,
)
FOUR_STEP_FORMS: dict[str, FourStepForm] = {
    FOUR_STEPS_PRINTED: "printed",
    FOUR_STEPS_CORRECTED: "corrected",
}

PAPER_A_STATIONS = 3
IMAGES_SOLVED_AT_ONCE = 25 * 45
"""Maximum number of images of all runs in a batch; larger batches exceed the processor's cache."""
END_EFFECTOR_POSES = 10
"""Number of poses in each run at which the end-effector is compared, [A] 4.3."""
DRAWS_FROM_BOUND = 4
"""Number of draws from each run's bound: four halve the standard error of the bound's end-effector
errors.
"""
RIGHT_MINIMUM_CHI2 = 1.5
"""Limit of chi2 per degree of freedom of a run in the right minimum; a false one has more than a
hundred.
"""
STATION_GUESS_OFFSET = np.array([0.03, -0.02, 0.03, 0.01, -0.01, 0.02])
"""Offset (rad and m) of stations that start from the nominal model only."""
END_EFFECTOR_STREAM, START_ERROR_STREAM, PAPER_A_BOUND_STREAM = 1, 2, 3
"""Random streams of a batch, besides 0 of the simulation."""

RADIAN_IN_DEGREES = float(np.degrees(1.0))
PAPER_A_PARAMETER_GROUPS = ("base_xy", "base_z", "platform_xy", "platform_z", "offset")
END_EFFECTOR_QUANTITIES = (
    "displacement",
    "orientation",
    "displacement_registered",
    "orientation_registered",
)
"""Mean error of the end-effector at random poses, [A] eq. 20, in frames by the centres 1, 3 and 5;
then in frames registered on all centres, which excludes the error of frames that are defined by
three joints.
"""
PAPER_A_QUANTITIES: Mapping[str, Quantity] = {
    **{name: Quantity("rms", 1e3, "mm") for name in (*PAPER_A_PARAMETER_GROUPS, "parameters")},
    **{
        name: Quantity(
            "mean", *((1e3, "mm") if "displacement" in name else (RADIAN_IN_DEGREES, "°"))
        )
        for name in END_EFFECTOR_QUANTITIES
    },
    "chi2": Quantity("mean"),
    "steps": Quantity("mean"),
}
"""PAPER_A_PARAMETER_GROUPS and all thirty parameters; the end-effector; chi2 per degree of freedom
and the solver's steps of the joint estimate.
"""


@dataclass(frozen=True)
class HexapodByAxes:
    """Setting of [A] 4.3.

    poses : number at each station. drawing_error, joint_noise : m, standard deviations of uniform
    errors ("variance equal to 2 mm"). distance, height : of the cameras, which look horizontally,
    m. start_error : half width (m) of a uniform error of the nominal model from which the joint
    estimate starts; None to start from the four steps. batch : number of runs that are solved
    together.

    The paper does not give the poses of the cameras. Their distance has no influence, because Table
    1 refers to the camera's frame. Their height has: the point of an axis is that with y = 0, and
    errors of the direction grow with the distance from it. So the height is that of the middle of
    the legs.
    """

    poses: int = 15
    legs_observed: int = 4
    noise: AxisNoise = field(default_factory=AxisNoise)
    joint_noise: float = 3e-6
    nominal_error: float = 0.002
    distance: float = 0.9
    height: float = 0.18
    extreme: bool = True
    start_error: float | None = None
    batch: int | None = None

    doing = "Four steps and joint estimate"
    quantities = PAPER_A_QUANTITIES

    def populations(self, runs: int) -> list[Population]:
        """A single population of hexapods."""
        most = max(1, IMAGES_SOLVED_AT_ONCE // (PAPER_A_STATIONS * self.poses))
        return [Population("hexapod", runs, self.batch or most)]

    def draw(self, batch: Batch) -> SimulatedRuns:
        """Draw true machines in the study's gauge, with poses by their readings."""
        machine, rng = hexapod_with_held_radii(), batch.generator(0)
        table = machine.parameters
        # Uniform errors of all parameters but the radii, projected onto the gauge.
        error = spread_evenly(rng, (batch.runs, len(table)), self.nominal_error)
        error *= np.array(table.kinds) != "radius"
        held = ThreeCentres().constraints(machine)
        error -= error @ np.linalg.pinv(held) @ held
        theta = table.nominal + error
        readings = self._readings(machine, batch.runs, rng)
        start = machine.forward_result(readings.reshape(-1, 6)).T_base_platform
        start = start.reshape(*readings.shape[:2], 4, 4)
        poses = forward(machine.layout, theta[:, None], readings, start).T_base_platform
        noise = Noise(self.joint_noise, even=True, axis=self.noise.sigma())
        return simulate_runs(machine, theta, readings, poses, self.view(machine), noise, rng)

    def _readings(self, machine: Machine, runs: int, rng: np.random.Generator) -> Array:
        """Readings (B, K, 6): distinct corners of the legs' ranges at each station, or uniform."""
        low, high = machine.joint_ranges.T
        if not self.extreme:
            return rng.uniform(low, high, (runs, PAPER_A_STATIONS * self.poses, 6))
        corners = np.array(list(product(*zip(low, high, strict=True))))
        order = np.argsort(rng.random((runs, PAPER_A_STATIONS, len(corners))), axis=-1)
        repeats = -(-self.poses // len(corners))
        pick = np.concatenate([order] * repeats, axis=-1)[..., : self.poses]
        return corners[pick].reshape(runs, -1, 6)

    def view(self, machine: Machine) -> Viewpoints:
        """Cameras on a circle, each between two pairs of base joints, that observe the nearest
        legs.
        """
        angles = np.radians([60.0, 180.0, 300.0])
        up = np.array([0.0, 0.0, self.height])
        T_camera_base = np.stack(
            [
                look_at(
                    self.distance * np.array([np.cos(a), np.sin(a), 0.0]) + up, up, np.eye(3)[2]
                )
                for a in angles
            ]
        )
        depth = apply(T_camera_base[:, None], machine.base_centers())[..., 2]
        legs = np.sort(np.argsort(depth, axis=1)[:, : self.legs_observed], axis=1)
        station: Integers = np.repeat(np.arange(PAPER_A_STATIONS), self.poses)
        return Viewpoints(T_camera_base, station, legs[station])

    def solve(self, batch: Batch, data: SimulatedRuns) -> dict[Key, Fitted]:
        """Four steps in both forms, and the joint estimate started from the corrected form."""
        machine = data.machine
        axes = measured_axes(data)
        a_camera, centres = centres_from_axes(axes, PAPER_A_STATIONS)
        steps = {
            method: solve_from_centres(machine, axes, a_camera, centres, form)
            for method, form in FOUR_STEP_FORMS.items()
        }
        out = {(method,): Fitted(parameters_of(machine, fit)) for method, fit in steps.items()}
        start = Start(out[FOUR_STEPS_CORRECTED,].theta, steps[FOUR_STEPS_CORRECTED].T_camera_base)
        if self.start_error is not None:
            draws = batch.generator(START_ERROR_STREAM).uniform(
                -1, 1, (batch.runs, len(machine.parameters))
            )
            start = start_off_nominal(data, draws * self.start_error)
        return {**out, (PAPER_A_JOINT,): joint_from_readings(data, start)}

    def judge(
        self, batch: Batch, data: SimulatedRuns, fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of every method at the same poses.

        For the bound these are its standard deviations, and the end-effector's errors by draws from
        it.
        """
        machine, rows = data.machine, thirty(data.machine).rows

        def effector(theta: Array) -> Array:
            return effector_errors(data, theta, batch.generator(END_EFFECTOR_STREAM))

        out: dict[Key, Sample] = {}
        for key, fit in {(PAPER_A_NOMINAL,): nominal_estimate(machine, batch.runs), **fits}.items():
            errors = (fit.theta - data.theta) @ rows.T
            out[key] = _sample(machine, errors, effector(fit.theta), fit)
        root = root_of_bound(machine, joint_problem(machine, data, ThreeCentres()), data)
        draws = batch.generator(PAPER_A_BOUND_STREAM).normal(
            size=(DRAWS_FROM_BOUND, batch.runs, root.shape[-1], 1)
        )
        effector_by_bound = np.mean(
            [effector(theta) for theta in data.theta + (root @ draws)[..., 0]], axis=0
        )
        out[PAPER_A_BOUND,] = _sample(
            machine, np.linalg.norm(rows @ root, axis=-1), effector_by_bound
        )
        return out


def _sample(
    machine: Machine, errors: Array, effector: Array, fit: Fitted | None = None
) -> Sample:  # fmt: skip
    """Sample with errors (B, 30) of the parameters, also by group, and (B, 4) of the
    end-effector.
    """
    figures = {name: errors[:, at] for name, at in parameters_by_group(machine).items()}
    figures |= {"parameters": errors}
    figures |= {name: effector[:, k] for k, name in enumerate(END_EFFECTOR_QUANTITIES)}
    return Sample(figures | (fit.extra if fit else {}), fit.sigma if fit else {})


@dataclass(frozen=True)
class JointByAxes(HexapodByAxes):
    """Joint estimate of the same machines from the corrected four steps, with the figures of all
    simulated calibrations.
    """

    doing = "Joint calibrations of [A] 4.3"
    quantities = CALIBRATED

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the thirty parameters."""
        return tuple((name, "m") for name in thirty(hexapod_with_held_radii()).names)

    def solve(
        self,
        batch: Batch,  # noqa: ARG002 - required by the protocol
        data: SimulatedRuns,
    ) -> dict[Key, Fitted]:
        """Joint estimate, started from the corrected four steps."""
        measured = measured_axes(data)
        steps = solve_from_centres(
            data.machine, measured, *centres_from_axes(measured, PAPER_A_STATIONS), "corrected"
        )
        start = Start(parameters_of(data.machine, steps), steps.T_camera_base)
        return {JOINT_ESTIMATE_KEY: joint_from_readings(data, start)}

    def judge(
        self, batch: Batch, data: SimulatedRuns, fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of the thirty parameters and of the platform at random poses of the workspace, in
        the gauge of three centres.
        """
        fit, machine = fits[JOINT_ESTIMATE_KEY], data.machine
        errors = (fit.theta - data.theta) @ thirty(machine).rows.T
        parameters = np.stack([errors, fit.sigma["parameters"]])
        tool = _tool(machine, data.theta, fit, batch.generator(END_EFFECTOR_STREAM))
        figures = fit.extra | {"failed": (fit.extra["chi2"] > RIGHT_MINIMUM_CHI2).astype(float)}
        figures["scale"] = np.ones(batch.runs)
        return {JOINT_ESTIMATE_KEY: judged(parameters, tool, Fitted(fit.theta, extra=figures))}


def converged(study: StudyResult[HexapodByAxes]) -> int:
    """Number of runs whose joint estimate is in the right minimum."""
    return int(np.sum(study.values("chi2", PAPER_A_JOINT) < RIGHT_MINIMUM_CHI2))


def mean_error(study: StudyResult[HexapodByAxes], method: str) -> Array:
    """Mean |error| (30,), m; for the bound, that of a normal distribution with its standard
    deviations.
    """
    errors = np.abs(study.values("parameters", method)).mean(axis=0)
    return errors * (np.sqrt(2 / np.pi) if method == PAPER_A_BOUND else 1.0)


@cache
def hexapod_with_held_radii() -> Machine:
    """The catalogue's Gough-Stewart platform with fixed radii, which axes do not need, and, as in
    the paper, with exact scales of the readings.
    """
    machine = machine_from_document(with_exact_scales(load_mechanism("gough-stewart").document))
    table = machine.parameters
    radii = [n for n, k in zip(table.names, table.kinds, strict=True) if k == "radius"]
    return replace(machine, parameters=table.with_roles(fixed=tuple(radii)))


class Thirty(NamedTuple):
    """The thirty parameters of [A] Fig. 4.

    names : such as ``A2 x``. rows : (30, P) linear map from a machine's parameters. nominal : (30,)
    nominal values, m.
    """

    names: tuple[str, ...]
    rows: Array
    nominal: Array


def thirty(machine: Machine) -> Thirty:
    """Thirty parameters in frames by the centres 1, 3 and 5.

    The origin is in the first centre, x points to the third, and the fifth is in the x-y plane. Six
    coordinates of each body vanish in these frames; twelve each remain, followed by the offsets.
    """
    theta = machine.parameters.nominal
    held = {(0, 0), (0, 1), (0, 2), (2, 1), (2, 2), (4, 2)}
    names: list[str] = []
    rows: list[Array] = []
    nominal: list[float] = []
    for letter, index in zip("AB", centre_index(machine.layout), strict=True):
        points = theta[index]
        x = points[2] - points[0]
        x = x / np.linalg.norm(x)
        z = np.cross(x, points[4] - points[0])
        z = z / np.linalg.norm(z)
        frame = np.stack([x, np.cross(z, x), z])
        for leg, axis in sorted(set(np.ndindex(6, 3)) - held):
            row = np.zeros(len(theta))
            row[index[leg]] = frame[axis]
            names.append(f"{letter}{leg + 1} {'xyz'[axis]}")
            rows.append(row)
            nominal.append(float(frame[axis] @ (points[leg] - points[0])))
    names += [f"q{leg + 1}" for leg in range(6)]
    rows += list(np.eye(len(theta))[machine.layout.rod])
    nominal += theta[machine.layout.rod].tolist()
    return Thirty(tuple(names), np.array(rows), np.array(nominal))


def parameters_by_group(machine: Machine) -> dict[str, Integers]:
    """Indices of the thirty parameters by PAPER_A_PARAMETER_GROUPS."""
    names = thirty(machine).names
    out: dict[str, Integers] = {}
    for body, letter in (("base", "A"), ("platform", "B")):
        own = [k for k, name in enumerate(names) if name.startswith(letter)]
        out[f"{body}_xy"] = np.array([k for k in own if not names[k].endswith("z")])
        out[f"{body}_z"] = np.array([k for k in own if names[k].endswith("z")])
    out["offset"] = np.array([k for k, name in enumerate(names) if name.startswith("q")])
    return out


def measured_axes(data: SimulatedRuns) -> Axes:
    """Measured axes in the form of [A]'s steps."""
    station, legs = data.view.station, data.view.legs
    u, point, _, _ = from_coordinates(data.axis)
    n_runs, n_photos, n_legs = data.joints.shape
    k = np.arange(n_photos)[:, None]
    visible = np.zeros((n_photos, n_legs), dtype=bool)
    visible[k, legs] = True
    full_u, full_point = np.zeros((2, n_runs, n_photos, n_legs, 3))
    full_u[:, k, legs], full_point[:, k, legs] = u, point
    return Axes(station, np.arange(n_photos), visible, full_u, full_point, data.joints)


class Start(NamedTuple):
    """Start of the joint estimate: theta (B, P), T_camera_base (B, S, 4, 4)."""

    theta: Array
    T_camera_base: Array


def start_off_nominal(data: SimulatedRuns, error: Array) -> Start:
    """Start of the joint estimate without the four steps.

    error : (B, P) offset of the free parameters from the nominal model. Stations are off by a few
    degrees and centimetres.
    """
    table = data.machine.parameters
    free = np.any(table.free_matrix() != 0, axis=1)
    guess = perturb(data.view.T_camera_base, STATION_GUESS_OFFSET)
    return Start(
        table.nominal + np.where(free, error, 0.0),
        np.broadcast_to(guess, (len(error), *guess.shape)),
    )


def joint_from_readings(data: SimulatedRuns, start: Start) -> Fitted:
    """Joint estimate; platform poses start by forward kinematics from the readings."""
    machine = data.machine
    problem = joint_problem(machine, data, ThreeCentres())
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    poses = forward(machine.layout, start.theta[:, None], data.joints, home).T_base_platform
    z = machine.parameters.to_free(start.theta)
    state = BatchState(z, start.T_camera_base, poses, np.zeros((len(z), 1)))
    solution = joint(problem, state)
    theta, nz = problem.theta(solution.solution.state), z.shape[1]
    # The gauge fixes 12 of the nz free parameters; each station has 6 unknowns.
    dof = freedom(data, machine.layout, shared_rank=nz - 12 + 6 * PAPER_A_STATIONS)
    spread = in_frames(machine, problem, theta)
    stated = spread @ solution.info.covariance[:, :nz, :nz] @ spread.mT
    rows = thirty(machine).rows
    variance = np.einsum("ip,bpq,iq->bi", rows, stated, rows)
    return Fitted(
        theta,
        extra={
            "chi2": solution.solution.cost / dof,
            "dof": np.full(len(theta), dof),
            "steps": solution.solution.steps.astype(float),
        },
        sigma={"parameters": np.sqrt(variance)},
        covariance=stated,
    )


def in_frames(machine: Machine, problem: Problem, theta: Array) -> Array:
    """Derivatives (B, P, nz) of all parameters in the gauge of three centres by the free
    parameters, at theta (B, P).
    """
    change = projector(machine, theta, ThreeCentres())
    return problem.free - generators(machine.layout, theta) @ change @ problem.free


def root_of_bound(machine: Machine, problem: Problem, data: SimulatedRuns) -> Array:
    """Square root (B, P, nz) of the Cramér-Rao covariance at the truth, in the gauge of three
    centres.

    The errors of an efficient estimate are this matrix times independent standard normal variables.
    """
    z = machine.parameters.to_free(data.theta)
    n, nz = z.shape
    T = np.broadcast_to(data.view.T_camera_base, (n, PAPER_A_STATIONS, 4, 4))
    state = BatchState(z, T, data.T_base_platform, np.zeros((n, 1)))
    covariance = Information(problem, state).covariance[:, :nz, :nz]
    eigenvalues, eigenvectors = np.linalg.eigh(covariance)
    root = eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))[:, None]
    root = root @ eigenvectors.mT  # the symmetric root is unique
    return in_frames(machine, problem, data.theta) @ root


def effector_errors(data: SimulatedRuns, theta: Array, rng: np.random.Generator) -> Array:
    """Errors (B, 4) of the end-effector of machines (B, P), END_EFFECTOR_QUANTITIES, m and rad."""
    machine = data.machine
    low, high = machine.joint_ranges.T
    readings = rng.uniform(low, high, (len(theta), END_EFFECTOR_POSES, len(low)))
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    T, T_true = (
        forward(machine.layout, p[:, None], readings, home).T_base_platform
        for p in (theta, data.theta)
    )
    base, platform = centre_index(machine.layout)
    # Frame changes of base and platform by registration on all centres.
    e = register(theta[:, base], data.theta[:, base])[:, None]
    f = register(theta[:, platform], data.theta[:, platform])[:, None]
    b1 = data.theta[:, None, platform[0]]  # the gauge holds A1 and B1 at their nominal values
    columns: list[Array] = []
    for estimated in (T, e @ T @ inverse(f)):
        columns.append(
            np.linalg.norm(apply(estimated, b1) - apply(T_true, b1), axis=-1).mean(axis=1)
        )
        turn = estimated[..., :3, :3] @ T_true[..., :3, :3].mT
        columns.append(np.linalg.norm(rotation_vector(turn), axis=-1).mean(axis=1))
    return np.stack(columns, axis=-1)


def _tool(machine: Machine, true: Array, fit: Fitted, rng: np.random.Generator) -> Array:
    """Errors of the platform's pose (omega, tau) at random readings, and their stated standard
    deviations, (2, B, END_EFFECTOR_POSES, 6).
    """
    layout, (low, high) = machine.layout, machine.joint_ranges.T
    readings = rng.uniform(low, high, (len(true), END_EFFECTOR_POSES, len(low)))
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    there, T_true = (
        forward(layout, theta[:, None], readings, home).T_base_platform
        for theta in (fit.theta, true)
    )
    off = pose_difference(there, T_true)
    # Derivatives of the pose by the parameters, from the closure's.
    c = closure(layout, fit.theta[:, None], readings, there)
    by = layout.own_motion @ np.linalg.solve(by_own(layout, c.rows), dense(c, true.shape[1]))
    if fit.covariance is None:
        return np.stack([off, np.full(off.shape, np.nan)])
    variance = np.einsum("bkip,bpq,bkiq->bki", by, fit.covariance, by, optimize=True)
    return np.stack([off, np.sqrt(np.maximum(variance, 0.0))])
