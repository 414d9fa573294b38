"""Simulated calibrations of many machines by the joint estimate, and their errors.

True machines are drawn from the prior sigmas of the nominal model, cameras' edge shifts and tubes'
shading from the priors of the estimate, so the stated standard deviations, which use all of these
priors, should hold. Measurements are edges and board poses with their stated noise. The estimate is
that of ``calibrate``: robust, with the scale of the noise and the shading estimated from the data,
started from the nominal model; stations start with the errors that localization leaves.

Axes: B runs, K configurations, N edges, V views of a board, W poses of the workspace.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import ResultError
from pkmcal.geometry.cylinders import (
    SIDE_SIGNS,
    contour_point,
    edge_normal,
    line_through,
    tangent_basis,
)
from pkmcal.geometry.rigid import apply, dot, inverse, perturb, pose_difference, skew
from pkmcal.identify.assembly import Assembled, assemble, state_of
from pkmcal.identify.bundle import BatchResult, counts, solve_batch
from pkmcal.identify.covariance import machine_covariance
from pkmcal.identify.gauge import (
    BestFit,
    Gauge,
    alignment,
    changed_frames,
    default_gauge,
    in_gauge,
    transformation,
)
from pkmcal.identify.start import middle_pose
from pkmcal.identify.state import State
from pkmcal.identify.tool import pose_by_parameters, without_frames
from pkmcal.identify.unknowns import BatchState
from pkmcal.identify.verdict import VERDICT
from pkmcal.levels import ROUNDING
from pkmcal.measurements import OWN_SHADING, SHADING_CORRELATION_ANGLE, SHADING_SIGMA
from pkmcal.measurements.edges import EdgeData
from pkmcal.measurements.effects import SHIFT_SIGMA, lines
from pkmcal.measurements.poses import PoseData
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.kinematics import ForwardResult, driven_towards, forward
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.edges import EDGE_TURN_POINTS, moved_outward
from pkmcal.solver.search import Stop, take
from pkmcal.studies.capture import Capture, Design, captured
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.statistics import covered
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample

JOINT_ESTIMATE_KEY: Key = ("joint",)
CALIBRATIONS_A_BATCH = 10
"""Number of runs that are solved together and share one capture plan."""
UNSHARED_SHADING_VARIANCE = 1e-9
"""Part of the unit variance of the shading that is independent for each edge: the correlation
matrix of edges with equal normals would have no Cholesky factor without it.
"""
STATION_START_SIGMAS = np.repeat([np.deg2rad(1.0), 0.01], 3)
"""Standard deviations (rad, rad, rad, m, m, m) of the stations' starting poses: the errors that
localization leaves, which come from those of the nominal model.
"""
TOOL_ERROR_POSES = 20
"""Number of poses at which the tool's error is evaluated."""
TIMES_MACHINES_REDRAWN = 20
"""Number of attempts to draw a machine that can take the readings of the plan."""
IMAGE_PLAN_STREAM, TOOL_POSES_STREAM = 1, 2
"""Random streams of a batch, besides 0 of the simulation."""
CALIBRATED_QUANTITIES: Mapping[str, Quantity] = {
    "position": Quantity("rms", 1e3, "mm"),
    "orientation": Quantity("rms", 1e3, "mrad"),
    "position_sigma": Quantity("rms", 1e3, "mm"),
    "orientation_sigma": Quantity("rms", 1e3, "mrad"),
    "covered": Quantity("mean"),
    "covered_tool": Quantity("mean"),
    "failed": Quantity("mean"),
}


@dataclass(frozen=True)
class SimulatedSessions:
    """Batch of simulated sessions, ready to be calibrated.

    capture : the plan that all share.
    theta, poses, internal : true parameters (B, P), T_base_platform (B, K, 4, 4), hinges (B, K, n).
    assembled : least-squares problem of all runs.
    start : initial state.
    """

    capture: Capture
    theta: Array
    poses: Array
    internal: Array
    assembled: Assembled
    start: BatchState


@dataclass(frozen=True)
class SimulatedCalibrations:
    """Study of calibrations of machines by one design. batch : number of runs that share a plan."""

    design: Design
    batch: int = CALIBRATIONS_A_BATCH
    quantities: Mapping[str, Quantity] = field(default_factory=lambda: CALIBRATED_QUANTITIES)

    doing = "Calibrating simulated machines"

    @cached_property
    def gauge(self) -> Gauge:
        """Gauge of the result, the default of a calibration."""
        return default_gauge(self.design.machine_with_cylinders)

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the parameters whose errors are reported, (P,)."""
        table = self.design.machine_with_cylinders.parameters
        return tuple(zip(table.names, table.units, strict=True))

    def populations(self, runs: int) -> list[Population]:
        """A single population with all runs."""
        return [Population("machine", runs, self.batch)]

    def draw(self, batch: Batch) -> SimulatedSessions:
        """Draw true machines, compute their poses at the plan's readings, and simulate the
        measurements.
        """
        design, rng = self.design, batch.generator(0)
        # Truth and readings; one problem with the structure of the plan for all runs.
        capture = captured(design, batch.generator(IMAGE_PLAN_STREAM))
        theta, true = _machines(design, capture, batch.runs, rng)
        poses, internal = true.T_base_platform, true.internal
        readings = design.readings(true.readings, rng)
        template = assemble(capture.machine, capture.measurements(design.reading_sigma), self.gauge)
        problem = template.problem
        data = replace(problem.data, joints=readings[:, template.observed])
        if len(capture.edges):
            data = _measured_edges(design, capture, template, theta, true, rng)
            data = replace(data, joints=readings[:, template.observed])
        pose_data = problem.pose_data
        if len(capture.views):
            pose_data = _measured_boards(design, capture, template, poses, rng)
        # Start of the estimate, and the priors of the mounts there.
        off = STATION_START_SIGMAS * rng.standard_normal((batch.runs, len(capture.cameras), 6))
        stations = perturb(capture.T_camera_base, off)
        problem = replace(problem, data=data, pose_data=pose_data)
        assembled = replace(template, problem=problem)
        start = _start(capture, assembled, stations, readings)
        mounts = np.array(template.priors) == "mount"
        # the prior is a metre wide: the same for all runs
        there = problem.prior_values(start).mean(axis=0)
        target = np.where(mounts, there, problem.prior_target)
        assembled = replace(template, problem=replace(problem, prior_target=target))
        return SimulatedSessions(capture, theta, poses, internal, assembled, start)

    def solve(self, batch: Batch, data: SimulatedSessions) -> dict[Key, Fitted]:
        """Joint estimate of all runs, in the gauge of the result."""
        problem = data.assembled.problem
        fit = solve_batch(problem, data.start)
        n, own = batch.runs, problem.layout.own_motion.shape[1]
        # Degrees of freedom: inliers, closures and priors, less own and shared unknowns.
        used = sum(counts(problem, fit.weight))
        k = int(data.assembled.observed.sum())
        dof = used + k * (problem.layout.n_equations - own) + len(problem.prior)
        dof = dof - problem.unknowns.count
        scale = np.maximum(fit.noise_scale, fit.scale.poses)
        good = np.array([stop is Stop.CONVERGED for stop in fit.solution.stop])
        parameters = [self._in_gauge(data, fit, run) for run in range(n)]
        return {
            JOINT_ESTIMATE_KEY: Fitted(
                np.array([theta for theta, _ in parameters]),
                extra={
                    "chi2": fit.solution.cost / dof,
                    "scale": scale,
                    "steps": fit.solution.steps.astype(float),
                    "failed": 1.0 - (good & (scale <= VERDICT.too_noisy)),
                },
                covariance=np.array([covariance for _, covariance in parameters]),
            )
        }

    def _in_gauge(self, data: SimulatedSessions, fit: BatchResult, run: int) -> tuple[Array, Array]:
        """Parameters (P,) in the result's gauge and their covariance (P, P)."""
        machine, p = data.capture.machine, data.theta.shape[1]
        state = state_of(
            data.assembled, take(fit.solution.state, np.array([run])), _truth(data, run)
        )
        shared = fit.covariance[run]
        full = machine_covariance(data.assembled.problem, machine, state, shared, self.gauge)
        theta = machine.parameters.unit_axes(in_gauge(machine, state, self.gauge).theta)
        return theta, full[:p, :p]

    def judge(
        self, batch: Batch, data: SimulatedSessions, fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of the parameters and of the tool, with their stated standard deviations."""
        machine, fit = data.capture.machine, fits[JOINT_ESTIMATE_KEY]
        by_board = "legs" not in self.design.observe
        joints = draw_configurations(
            machine, TOOL_ERROR_POSES, 0.0, batch.generator(TOOL_POSES_STREAM)
        )[1]
        joints = joints[:TOOL_ERROR_POSES]
        parts = [self._judged(data, fit, run, joints, every=by_board) for run in range(batch.runs)]
        parameters, tool = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        return {JOINT_ESTIMATE_KEY: judged(parameters, tool, fit)}

    def _judged(
        self, data: SimulatedSessions, fit: Fitted, run: int, joints: Array, *, every: bool
    ) -> tuple[Array, Array]:
        """Errors and stated standard deviations of one run: of the parameters (2, P) and the tool
        (2, W, 6).
        """
        machine, true = data.capture.machine, _truth(data, run)
        theta = fit.theta[run]
        covariance = np.zeros((len(theta),) * 2) if fit.covariance is None else fit.covariance[run]
        true_theta = machine.parameters.unit_axes(in_gauge(machine, true, self.gauge).theta)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        sigma = np.where(sigma > ROUNDING, sigma, np.nan)
        # An axis is a unit vector: its largest component follows from the other two, and changes
        # only to second order when the axis turns.
        axes = machine.parameters.axes
        largest = np.argmax(np.abs(machine.parameters.nominal[axes]), axis=1)
        sigma[axes[np.arange(len(axes)), largest]] = np.nan
        off = tool_error_and_sigma(machine, theta, covariance, true, joints, every=every)
        return np.stack([theta - true_theta, sigma]), np.stack(off)


def judged(parameters: Array, tool: Array, fit: Fitted) -> Sample:
    """Sample of calibrations with all their figures.

    parameters : (2, B, n) errors and stated standard deviations in m or rad; NaN for parameters
    that are not unknowns of their own. tool : (2, B, W, 6) the same for the tool's pose (omega,
    tau).
    """
    size, stated = _sizes(tool[0]), _sizes(tool[1])
    figures = {
        "parameters": parameters[0],
        "tool": tool[0],
        "position": size[1], "orientation": size[0],
        "position_sigma": stated[1], "orientation_sigma": stated[0],
        "covered": covered(*parameters), "covered_tool": covered(*tool),
    }  # fmt: skip
    return Sample(figures | fit.extra, {"parameters": parameters[1], "tool": tool[1]})


def tool_error_and_sigma(
    machine: Machine,
    theta: Array,
    covariance: Array,
    true: State,
    joints: Array,
    *,
    every: bool,
) -> tuple[Array, Array]:
    """Errors of a calibrated machine's poses at given readings, and their stated standard
    deviations.

    theta, covariance : (P,) and (P, P) of the result.
    true : true state.
    joints : (W, m) readings.
    every : remove all frame changes, as if no legs were observed.

    The frames of the truth are registered to those of the result as in
    :func:`pkmcal.identify.tool.tool_error`. Returns two arrays (W, 6) of (omega, tau); NaN where a
    machine cannot take the readings.
    """
    n = len(theta)
    # register the truth to the result rather than to the nominal model
    calibrated = replace(
        machine, parameters=replace(machine.parameters, nominal=theta), values=theta
    )
    registered = changed_frames(machine.layout, true, *alignment(calibrated, true, BestFit()))
    there = replace(true, theta=theta)
    keep = transformation(calibrated, there, BestFit())[:n, :n]
    # Forward kinematics of the truth, and of the result at the truth's readings.
    home = np.broadcast_to(machine.home(), (len(joints), 4, 4))
    nominal_fk = forward(machine.layout, machine.parameters.nominal, joints, home)
    true_fk = driven_towards(
        machine.layout,
        registered.theta,
        joints,
        nominal_fk.T_base_platform,
        nominal_fk.internal,
    )
    joints = true_fk.readings
    calibrated_fk = forward(
        machine.layout, theta, joints, true_fk.T_base_platform, true_fk.internal
    )
    good = calibrated_fk.converged & true_fk.converged
    # Error and its covariance, both without the components that are changes of frames.
    poses = calibrated_fk.T_base_platform[good]
    by_parameters = pose_by_parameters(calibrated, joints[good], poses) @ keep
    by_parameters = without_frames(calibrated, poses, by_parameters, every=every)
    error = pose_difference(poses, true_fk.T_base_platform[good])[..., None]
    error = without_frames(calibrated, poses, error, every=every)[..., 0]
    variance = np.einsum("kip,pq,kiq->ki", by_parameters, covariance, by_parameters)
    out = np.full((2, len(joints), 6), np.nan)
    out[0, good], out[1, good] = error, np.sqrt(np.maximum(variance, 0.0))
    out[:, out[1] < ROUNDING] = np.nan  # the machine cannot move in this direction
    return out[0], out[1]


def _sizes(tool: Array) -> tuple[Array, Array]:
    """Root mean square (B,) rotations (rad) and displacements (m) of the tool over the
    workspace.
    """
    squares = np.nansum(tool.reshape(*tool.shape[:2], 2, 3) ** 2, axis=-1)
    there = np.asarray(np.isfinite(tool).any(axis=-1))
    squares = np.where(there[..., None], squares, np.nan)
    size = np.sqrt(np.nanmean(squares, axis=1))
    return size[:, 0], size[:, 1]


def _truth(data: SimulatedSessions, run: int) -> State:
    """True state of a run."""
    capture = data.capture
    return State(
        data.theta[run],
        capture.T_camera_base,
        data.poses[run],
        T_mount=np.zeros((0, 4, 4)) if capture.T_platform_board is None
        else capture.T_platform_board[None],
        on_platform=np.ones(int(capture.T_platform_board is not None), dtype=bool),
        internal=data.internal[run],
    )  # fmt: skip


def _machines(
    design: Design, capture: Capture, runs: int, rng: np.random.Generator
) -> tuple[Array, ForwardResult]:
    """Draw true machines (B, P) by the prior sigmas, with the plan's readings as targets.

    Returns their parameters, and forward kinematics with poses (B, K, 4, 4) and each machine's own
    readings (B, K, m). A machine that cannot take the readings is drawn again; ResultError after
    TIMES_MACHINES_REDRAWN attempts.
    """
    machine, table = capture.machine, capture.machine.parameters
    tolerance, free = design.tolerance * table.tolerances_free(), table.free_matrix()
    start = machine.forward_result(capture.joints, capture.T_base_platform)
    theta = np.empty((runs, len(table)))
    poses = np.empty((runs, *start.T_base_platform.shape))
    internal = np.empty((runs, *start.internal.shape))
    readings, error = np.empty((runs, *capture.joints.shape)), np.empty((runs, len(capture.joints)))
    remaining = np.arange(runs)
    for _ in range(TIMES_MACHINES_REDRAWN):
        # Draw the remaining machines, and keep those that close at all readings.
        step = tolerance * rng.standard_normal((len(remaining), len(tolerance)))
        theta[remaining] = table.unit_axes(table.nominal + step @ free.T)
        fk = driven_towards(
            machine.layout,
            theta[remaining, None],
            capture.joints,
            start.T_base_platform,
            start.internal,
        )
        poses[remaining], internal[remaining] = fk.T_base_platform, fk.internal
        readings[remaining], error[remaining] = fk.readings, fk.error
        remaining = remaining[~fk.converged.all(axis=1)]
        if not remaining.size:
            closed = np.ones(error.shape, dtype=bool)
            return theta, ForwardResult(
                poses, closed, error, internal, machine.layout, theta[:, None], readings
            )
    raise ResultError(
        "machines within the nominal model's tolerances cannot take the readings of the plan",
        found=f"{remaining.size} of {runs} machines, drawn {TIMES_MACHINES_REDRAWN} times",
        next_step="Look at the tolerances and ranges in the mechanism file",
    )


def _measured_edges(
    design: Design,
    capture: Capture,
    template: Assembled,
    theta: Array,
    true: ForwardResult,
    rng: np.random.Generator,
) -> EdgeData:
    """Edge measurements of all runs, at their places in the problem."""
    machine, edges, at = capture.machine, capture.edges, template.places.edges
    blocks, runs, n = template.problem.blocks, len(theta), len(capture.edges)
    ends = limb_ends(
        machine.layout, theta[:, None], true.readings, true.T_base_platform, true.internal
    )
    radius = theta[:, blocks.radius[at.row, at.place]]
    normal, basis, first = np.empty((runs, n, 3)), np.empty((runs, n, 3, 2)), np.empty((runs, n, 3))
    by_shift, by_tilt = np.empty((2, runs, n, 2))
    for station, camera in enumerate(capture.cameras):
        own = np.flatnonzero(edges.station == station)
        place = (slice(None), edges.configuration[own], edges.leg[own])
        a, b = (
            apply(capture.T_camera_base[station], np.broadcast_to(e, ends.b.shape)[place])
            for e in ends.rods
        )
        u, m = line_through(a, b)
        # Exact edge normals, and their rotations by a shift and a tilt of one pixel.
        exact = edge_normal(u, m, radius[:, own], SIDE_SIGNS[edges.side[own]])
        span = edges.span[own]
        along = span[:, :1] + (span[:, 1:] - span[:, :1]) * np.linspace(0, 1, EDGE_TURN_POINTS)
        points = contour_point(
            a[:, :, None], u[:, :, None], exact[:, :, None], radius[:, own, None],
            np.broadcast_to(along, (runs, *along.shape)),
        )  # fmt: skip
        rays = points / np.sqrt(dot(points, points))[..., None]
        middle = rays[:, :, EDGE_TURN_POINTS // 2]
        frame = tangent_basis(exact, middle)
        flat = (x.reshape(-1, *x.shape[2:]) for x in (exact, frame, rays))
        shift, tilt = moved_outward(camera, *flat)
        normal[:, own], basis[:, own], first[:, own] = exact, frame, middle
        by_shift[:, own] = shift.reshape(runs, -1, 2)
        by_tilt[:, own] = tilt.reshape(runs, -1, 2)
    # Errors in px: independent noise, the camera's edge shift, and the shading of the tube's side.
    error = design.edge_noise * rng.standard_normal((2, runs, n))
    measured = capture.measurements(design.reading_sigma)
    camera = np.asarray(measured.camera_of_station)[edges.station]
    outward = SHIFT_SIGMA * rng.standard_normal((runs, measured.n_cameras))[:, camera]
    line = lines(measured)[1]
    of_lines = rng.standard_normal((runs, int(line.max(initial=0)) + 1))
    alone = rng.standard_normal((runs, n))
    own = OWN_SHADING / SHADING_SIGMA * _own_shading(line, normal[0], rng, runs)
    shaded = design.shading * (np.where(line < 0, alone, of_lines[:, line]) + own)
    turn = by_shift * (error[0] + outward + shaded)[..., None] + by_tilt * error[1][..., None]
    normal = normal + (basis @ turn[..., None])[..., 0]
    normal = normal / np.sqrt(dot(normal, normal))[..., None]
    basis = tangent_basis(normal, first)
    # Whitening by the noise that the estimate assumes.
    parts = design.edge_noise * np.stack([by_shift, by_tilt], axis=-1)
    whiten = np.linalg.inv(np.linalg.cholesky(parts @ parts.mT))

    def placed(values: Array) -> Array:
        return np.moveaxis(at.filled(np.moveaxis(values, 0, 1)), 2, 0)

    return replace(
        template.problem.data,
        basis=placed(basis)[:, :, :, None],
        white=placed(whiten),
        shift=placed(by_shift),
        # all columns of edges are shifts, of their camera and of their line
        columns=placed(by_shift)[..., None] * (blocks.column[:, :, None] >= 0),
    )


def _own_shading(line: Integers, normal: Array, rng: np.random.Generator, runs: int) -> Array:
    """Shading of each edge in addition to its line's, (runs, n) of unit variance.

    Its correlation between edges of the same line follows from the angle between their normals (n,
    3).
    """
    out = rng.standard_normal((runs, len(line)))
    for number in range(int(line.max(initial=-1)) + 1):
        own = np.flatnonzero(line == number)
        angle = np.arccos(np.clip(normal[own] @ normal[own].T, -1, 1))
        out[:, own] = (
            out[:, own]
            @ np.linalg.cholesky(
                np.exp(-angle / SHADING_CORRELATION_ANGLE)
                + UNSHARED_SHADING_VARIANCE * np.eye(len(own))
            ).T
        )
    return out


def _measured_boards(
    design: Design, capture: Capture, template: Assembled, poses: Array, rng: np.random.Generator
) -> PoseData:
    """Board poses of all runs, with the covariance that follows from the noise of the corners."""
    if capture.board is None or capture.T_platform_board is None:
        return template.problem.pose_data
    at, (station, row) = template.places.poses, capture.views.T
    true = capture.T_camera_base[station] @ poses[:, row] @ capture.T_platform_board
    information = np.empty((*true.shape[:2], 6, 6))
    for number, camera in enumerate(capture.cameras):
        own = np.flatnonzero(station == number)
        # Information of the visible corners on (omega, tau) of the board's pose.
        points = apply(true[:, own][:, :, None], capture.board.points)
        arm = points - true[:, own][:, :, None, :3, 3]
        by_point, _ = camera.project_jacobians(points)
        by_pose = np.concatenate([-by_point @ skew(arm), by_point], axis=-1)
        by_pose = np.where(capture.corners[own][..., None, None], by_pose, 0.0)
        by_pose = by_pose.reshape(*by_pose.shape[:2], -1, 6) / design.corner_noise
        information[:, own] = by_pose.mT @ by_pose
    # Draw poses with the covariance of the corners' noise.
    covariance = np.linalg.inv(information)
    covariance = 0.5 * (covariance + covariance.mT)
    root = np.linalg.cholesky(covariance)
    measured = perturb(true, (root @ rng.standard_normal((*true.shape[:2], 6, 1)))[..., 0])

    def placed(values: Array, empty: Array) -> Array:
        out = np.moveaxis(at.filled(np.moveaxis(values, 0, 1)), 2, 0)
        return np.where(at.present[..., None, None], out, empty)

    return replace(
        template.problem.pose_data,
        T_station_target=placed(measured, np.eye(4)),
        whiten=placed(np.linalg.inv(root), np.zeros((6, 6))),
    )


def _start(
    capture: Capture, assembled: Assembled, T_camera_base: Array, readings: Array
) -> BatchState:
    """Initial state of all runs: nominal parameters, platform poses by forward kinematics, mounts
    from the platform poses.
    """
    machine, problem = capture.machine, assembled.problem
    runs, u = len(readings), problem.unknowns
    reached = machine.forward_result(capture.joints, capture.T_base_platform)
    fk = forward(
        machine.layout, machine.values, readings, reached.T_base_platform, reached.internal
    )
    observed = assembled.observed
    mounts = np.zeros((runs, 0, 4, 4))
    if len(capture.views):
        station, row = capture.views.T
        target = assembled.places.poses
        measured = problem.pose_data.T_station_target[:, target.row, target.place]
        each = inverse(T_camera_base[:, station] @ fk.T_base_platform[:, row]) @ measured
        mounts = np.stack([middle_pose(poses) for poses in each])[:, None]
    return BatchState(
        np.zeros((runs, u.n_free)),
        T_camera_base,
        fk.T_base_platform[:, observed],
        np.zeros((runs, u.effects.stop - u.effects.start)),
        mounts,
        fk.internal[:, observed],
    )
