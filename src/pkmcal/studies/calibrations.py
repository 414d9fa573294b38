"""Simulated calibrations of many machines by the joint estimate, and how far their results are off.

True machines are drawn from the drawing's tolerances, cameras' edge shifts and tubes' shading from
what the estimate takes them for: so its stated deviations, which use all of these as knowledge,
should hold. Measurements are edges and boards' poses with the noise that they state. The estimate
is that of ``calibrate``: robust, with the noise's scale and the shading found from the data, from
the drawing on; stations start as the search in photographs leaves them.

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
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import (
    BestFit,
    Gauge,
    alignment,
    changed_frames,
    default_gauge,
    in_gauge,
    transformation,
)
from pkmcal.identify.parameter_estimates import ROUNDING_SIGMA
from pkmcal.identify.start import middle_pose
from pkmcal.identify.tool import pose_by_parameters, without_frames
from pkmcal.identify.unknowns import BatchState
from pkmcal.identify.verdict import TOO_NOISY
from pkmcal.measurements import OWN_SHADING, SHADING_CORRELATION_ANGLE, SHADING_SIGMA
from pkmcal.measurements.edges import EdgeData
from pkmcal.measurements.effects import SHIFT_SIGMA, lines
from pkmcal.measurements.poses import PoseData
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.kinematics import forward
from pkmcal.simulation.edges import EDGE_TURN_PLACES, moved_outward
from pkmcal.simulation.placement import draw_configurations
from pkmcal.solver.search import Stop, take
from pkmcal.studies.capture import Capture, Design, captured
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.statistics import covered
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample

JOINT_ESTIMATE_KEY: Key = ("joint",)
CALIBRATIONS_A_BATCH = 10
"""Runs that are solved at once, and that share a plan of photographs."""
UNSHARED_SHADING_VARIANCE = 1e-9
"""Of a variance, what two edges with the same normal are shaded by each for itself; a covariance of
equal rows has no root."""
STATION_START_SIGMAS = np.repeat([np.deg2rad(1.0), 0.01], 3)
"""rad and m, standard deviations by which stations start off: so far is what a search for the drawn
machine in photographs leaves, as the drawing's own errors do."""
TOOL_ERROR_POSES = 20
"""Poses at which the tool's error is told."""
TIMES_MACHINES_REDRAWN = 20
"""Times that a machine is drawn again which cannot take the plan's readings."""
PHOTOGRAPH_PLAN_STREAM, TOOL_POSES_STREAM = 1, 2
"""Uses of a batch's draws, besides the simulation."""
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
    """One batch of simulated sessions, ready to be calibrated.

    capture : their plan. theta (B, P), poses (B, K, 4, 4), internal (B, K, n) : the truth.
    assembled : the least-squares problem of all runs. start : where it begins.
    """

    capture: Capture
    theta: Array
    poses: Array
    internal: Array
    assembled: Assembled
    start: BatchState


@dataclass(frozen=True)
class SimulatedCalibrations:
    """Calibrations of machines by one design. batch : runs that share a plan."""

    design: Design
    batch: int = CALIBRATIONS_A_BATCH
    quantities: Mapping[str, Quantity] = field(default_factory=lambda: CALIBRATED_QUANTITIES)

    doing = "Calibrating simulated machines"

    @cached_property
    def gauge(self) -> Gauge:
        """Frames of the result, as a calibration chooses them."""
        return default_gauge(self.design.machine_with_cylinders)

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the parameters that errors are told of, (P,)."""
        table = self.design.machine_with_cylinders.parameters
        return tuple(zip(table.names, table.units, strict=True))

    def populations(self, runs: int) -> list[Population]:
        """All runs alike."""
        return [Population("machine", runs, self.batch)]

    def draw(self, batch: Batch) -> SimulatedSessions:
        """True machines, their poses at the plan's readings, and what is measured of them."""
        design, rng = self.design, batch.generator(0)
        capture = captured(design, batch.generator(PHOTOGRAPH_PLAN_STREAM))
        theta, poses, internal = _machines(design, capture, batch.runs, rng)
        readings = capture.joints + design.reading_noise * rng.standard_normal(
            (batch.runs, *capture.joints.shape)
        )
        one = assemble(capture.machine, capture.measurements(design.reading_noise), self.gauge)
        problem = one.problem
        data = replace(problem.data, joints=readings[:, one.observed])
        if len(capture.edges):
            data = _measured_edges(design, capture, one, theta, poses, internal, rng)
            data = replace(data, joints=readings[:, one.observed])
        pose_data = problem.pose_data
        if len(capture.views):
            pose_data = _measured_boards(design, capture, one, poses, rng)
        off = STATION_START_SIGMAS * rng.standard_normal((batch.runs, len(capture.cameras), 6))
        stations = perturb(capture.T_camera_base, off)
        problem = replace(problem, data=data, pose_data=pose_data)
        assembled = replace(one, problem=problem)
        start = _start(capture, assembled, stations, readings)
        mounts = np.array(one.priors) == "mount"
        there = problem.prior_values(start).mean(axis=0)  # a metre's knowledge: one for all runs
        target = np.where(mounts, there, problem.prior_target)
        assembled = replace(one, problem=replace(problem, prior_target=target))
        return SimulatedSessions(capture, theta, poses, internal, assembled, start)

    def solve(self, batch: Batch, data: SimulatedSessions) -> dict[Key, Fitted]:
        """The joint estimate, told in the result's frames."""
        problem = data.assembled.problem
        value = solve_batch(problem, data.start)
        n, own = batch.runs, problem.layout.own_motion.shape[1]
        used = sum(counts(problem, value.weight))
        k = int(data.assembled.observed.sum())
        dof = used + k * (problem.layout.n_equations - own) + len(problem.prior)
        dof = dof - problem.unknowns.count
        scale = np.maximum(value.noise_scale, value.scale.poses)
        good = np.array([stop is Stop.CONVERGED for stop in value.solution.stop])
        parameters = [self._in_gauge(data, value, run) for run in range(n)]
        return {
            JOINT_ESTIMATE_KEY: Fitted(
                np.array([theta for theta, _ in parameters]),
                extra={
                    "chi2": value.solution.cost / dof,
                    "scale": scale,
                    "steps": value.solution.steps.astype(float),
                    "failed": 1.0 - (good & (scale <= TOO_NOISY)),
                },
                covariance=np.array([covariance for _, covariance in parameters]),
            )
        }

    def _in_gauge(
        self, data: SimulatedSessions, value: BatchResult, run: int
    ) -> tuple[Array, Array]:
        """Parameters (P,) in the result's frames, and their covariance (P, P)."""
        machine, p = data.capture.machine, data.theta.shape[1]
        state = state_of(
            data.assembled, take(value.solution.state, np.array([run])), _truth(data, run)
        )
        shared = value.covariance[run]
        full = machine_covariance(data.assembled.problem, machine, state, shared, self.gauge)
        theta = machine.parameters.unit_axes(in_gauge(machine, state, self.gauge).theta)
        return theta, full[:p, :p]

    def judge(
        self, batch: Batch, data: SimulatedSessions, fits: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of parameters and tool, and what is stated of them."""
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
        """One run's errors and their stated deviations, of the parameters (2, P) and of the tool
        (2, W, 6).
        """
        machine, true = data.capture.machine, _truth(data, run)
        theta = fit.theta[run]
        covariance = np.zeros((len(theta),) * 2) if fit.covariance is None else fit.covariance[run]
        values = machine.parameters.unit_axes(in_gauge(machine, true, self.gauge).theta)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        sigma = np.where(sigma > ROUNDING_SIGMA, sigma, np.nan)
        sigma[_along_axes(machine)] = np.nan
        off = tool_error_and_sigma(machine, theta, covariance, true, joints, every=every)
        return np.stack([theta - values, sigma]), np.stack(off)


def judged(parameters: Array, tool: Array, fit: Fitted) -> Sample:
    """A sample of calibrations, each with all that a study tells of it.

    parameters : (2, B, n) errors and stated deviations in m or rad, NaN of what is no unknown of
    its own. tool : (2, B, W, 6) the same of the tool's pose (omega, tau).
    """
    size, stated = _sizes(tool[0]), _sizes(tool[1])
    values = {
        "parameters": parameters[0],
        "tool": tool[0],
        "position": size[1], "orientation": size[0],
        "position_sigma": stated[1], "orientation_sigma": stated[0],
        "covered": covered(*parameters), "covered_tool": covered(*tool),
    }  # fmt: skip
    return Sample(values | fit.extra, {"parameters": parameters[1], "tool": tool[1]})


def tool_error_and_sigma(
    machine: Machine,
    theta: Array,
    covariance: Array,
    true: State,
    joints: Array,
    *,
    every: bool,
) -> tuple[Array, Array]:
    """By how much a calibrated machine's poses differ from the true one's at the same readings, and
    the standard deviations that the calibration states of that: (W, 6) each, (omega, tau).

    theta (P,), covariance (P, P) : of the result. joints (W, m). Frames of the truth are laid over
    the result's as :func:`pkmcal.identify.tool.tool_error` has it; every : as where no legs were
    seen. NaN where a machine cannot take the readings.
    """
    n = len(theta)
    # the best fit is that of the truth on the result, not on the drawing
    value = replace(machine, parameters=replace(machine.parameters, drawing=theta), values=theta)
    over = changed_frames(machine.layout, true, *alignment(value, true, BestFit()))
    there = replace(true, theta=theta)
    keep = transformation(value, there, BestFit())[:n, :n]
    home = np.broadcast_to(machine.home(), (len(joints), 4, 4))
    drawn = forward(machine.layout, machine.parameters.drawing, joints, home)
    one = forward(machine.layout, theta, joints, drawn.T_base_platform, drawn.internal)
    other = forward(machine.layout, over.theta, joints, one.T_base_platform, one.internal)
    good = one.converged & other.converged
    poses = one.T_base_platform[good]
    by = pose_by_parameters(value, joints[good], poses) @ keep
    by = without_frames(value, poses, by, every=every)
    off = pose_difference(poses, other.T_base_platform[good])[..., None]
    off = without_frames(value, poses, off, every=every)[..., 0]
    variance = np.einsum("kip,pq,kiq->ki", by, covariance, by)
    out = np.full((2, len(joints), 6), np.nan)
    out[0, good], out[1, good] = off, np.sqrt(np.maximum(variance, 0.0))
    out[:, out[1] < ROUNDING_SIGMA] = np.nan  # no motion in this direction
    return out[0], out[1]


def _along_axes(machine: Machine) -> Integers:
    """Positions of each axis's largest component, which follows from the other two: an axis is a
    direction, and what turns it moves that component by the turn's square alone.
    """
    axes = machine.parameters.axes
    largest = np.argmax(np.abs(machine.parameters.drawing[axes]), axis=1)
    return axes[np.arange(len(axes)), largest]


def _sizes(tool: Array) -> tuple[Array, Array]:
    """Root mean squares (B,) over the workspace of turns (rad) and displacements (m)."""
    squares = np.nansum(tool.reshape(*tool.shape[:2], 2, 3) ** 2, axis=-1)
    there = np.asarray(np.isfinite(tool).any(axis=-1))
    squares = np.where(there[..., None], squares, np.nan)
    size = np.sqrt(np.nanmean(squares, axis=1))
    return size[:, 0], size[:, 1]


def _truth(data: SimulatedSessions, run: int) -> State:
    """What is true of a run."""
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
) -> tuple[Array, Array, Array]:
    """True machines (B, P) as they might be built, their poses (B, K, 4, 4) and hinges at the
    plan's readings.
    """
    machine, table = capture.machine, capture.machine.parameters
    tolerance, free = design.tolerance * table.tolerances_free(), table.free_matrix()
    start = machine.forward_result(capture.joints, capture.T_base_platform)
    theta = np.empty((runs, len(table)))
    poses = np.empty((runs, *start.T_base_platform.shape))
    internal = np.empty((runs, *start.internal.shape))
    remaining = np.arange(runs)
    for _ in range(TIMES_MACHINES_REDRAWN):
        step = tolerance * rng.standard_normal((len(remaining), len(tolerance)))
        theta[remaining] = table.unit_axes(table.drawing + step @ free.T)
        fk = forward(
            machine.layout,
            theta[remaining, None],
            capture.joints,
            start.T_base_platform,
            start.internal,
        )
        poses[remaining], internal[remaining] = fk.T_base_platform, fk.internal
        remaining = remaining[~fk.converged.all(axis=1)]
        if not remaining.size:
            return theta, poses, internal
    raise ResultError(
        "machines within the drawing's tolerances cannot take the readings of the plan",
        found=f"{remaining.size} of {runs} machines, drawn {TIMES_MACHINES_REDRAWN} times",
        next_step="Look at the tolerances and ranges in the mechanism file",
    )


def _measured_edges(
    design: Design,
    capture: Capture,
    one: Assembled,
    theta: Array,
    poses: Array,
    internal: Array,
    rng: np.random.Generator,
) -> EdgeData:
    """The edges of all runs at their places in the problem."""
    machine, edges, at = capture.machine, capture.edges, one.places.edges
    blocks, runs, n = one.problem.blocks, len(theta), len(capture.edges)
    ends = limb_ends(machine.layout, theta[:, None], capture.joints, poses, internal)
    radius = theta[:, blocks.radius[at.row, at.place]]
    normal, basis, first = np.empty((runs, n, 3)), np.empty((runs, n, 3, 2)), np.empty((runs, n, 3))
    by_shift, by_tilt = np.empty((2, runs, n, 2))
    for station, camera in enumerate(capture.cameras):
        own = np.flatnonzero(edges.station == station)
        place = (slice(None), edges.configuration[own], edges.leg[own])
        a, b = (
            apply(capture.T_camera_base[station], np.broadcast_to(e, ends.b.shape)[place])
            for e in (ends.a, ends.b)
        )
        u, m = line_through(a, b)
        exact = edge_normal(u, m, radius[:, own], SIDE_SIGNS[edges.side[own]])
        span = edges.span[own]
        along = span[:, :1] + (span[:, 1:] - span[:, :1]) * np.linspace(0, 1, EDGE_TURN_PLACES)
        points = contour_point(
            a[:, :, None], u[:, :, None], exact[:, :, None], radius[:, own, None],
            np.broadcast_to(along, (runs, *along.shape)),
        )  # fmt: skip
        rays = points / np.sqrt(dot(points, points))[..., None]
        middle = rays[:, :, EDGE_TURN_PLACES // 2]
        frame = tangent_basis(exact, middle)
        flat = (x.reshape(-1, *x.shape[2:]) for x in (exact, frame, rays))
        shift, tilt = moved_outward(camera, *flat)
        normal[:, own], basis[:, own], first[:, own] = exact, frame, middle
        by_shift[:, own] = shift.reshape(runs, -1, 2)
        by_tilt[:, own] = tilt.reshape(runs, -1, 2)
    error = design.edge_noise * rng.standard_normal((2, runs, n))
    measured = capture.measurements(design.reading_noise)
    camera = np.asarray(measured.camera_of_station)[edges.station]
    outward = SHIFT_SIGMA * rng.standard_normal((runs, measured.n_cameras))[:, camera]
    line = lines(measured)[1]
    of_lines = rng.standard_normal((runs, int(line.max(initial=0)) + 1))
    alone = rng.standard_normal((runs, n))
    own = OWN_SHADING / SHADING_SIGMA * _own(line, normal[0], rng, runs)
    shaded = design.shading * (np.where(line < 0, alone, of_lines[:, line]) + own)
    turn = by_shift * (error[0] + outward + shaded)[..., None] + by_tilt * error[1][..., None]
    normal = normal + (basis @ turn[..., None])[..., 0]
    normal = normal / np.sqrt(dot(normal, normal))[..., None]
    basis = tangent_basis(normal, first)
    parts = design.edge_noise * np.stack([by_shift, by_tilt], axis=-1)
    whiten = np.linalg.inv(np.linalg.cholesky(parts @ parts.mT))

    def placed(values: Array) -> Array:
        return np.moveaxis(at.filled(np.moveaxis(values, 0, 1)), 2, 0)

    return replace(
        one.problem.data,
        basis=placed(basis)[:, :, :, None],
        white=placed(whiten),
        shift=placed(by_shift),
        # all columns of edges are shifts, of their camera and of their line
        columns=placed(by_shift)[..., None] * (blocks.column[:, :, None] >= 0),
    )


def _own(line: Integers, normal: Array, rng: np.random.Generator, runs: int) -> Array:
    """What edges (n,) are shaded by one by one, of unit variance, (runs, n): alike where normals
    (n, 3) of the same line are near.
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
    design: Design, capture: Capture, one: Assembled, poses: Array, rng: np.random.Generator
) -> PoseData:
    """The board's poses of all runs, with the covariance that their corners' noise gives."""
    if capture.board is None or capture.T_platform_board is None:
        return one.problem.pose_data
    at, (station, row) = one.places.poses, capture.views.T
    true = capture.T_camera_base[station] @ poses[:, row] @ capture.T_platform_board
    information = np.empty((*true.shape[:2], 6, 6))
    for number, camera in enumerate(capture.cameras):
        own = np.flatnonzero(station == number)
        points = apply(true[:, own][:, :, None], capture.board.points)
        arm = points - true[:, own][:, :, None, :3, 3]
        by_point, _ = camera.project_jacobians(points)
        by_pose = np.concatenate([-by_point @ skew(arm), by_point], axis=-1)
        by_pose = np.where(capture.corners[own][..., None, None], by_pose, 0.0)
        by_pose = by_pose.reshape(*by_pose.shape[:2], -1, 6) / design.corner_noise
        information[:, own] = by_pose.mT @ by_pose
    covariance = np.linalg.inv(information)
    covariance = 0.5 * (covariance + covariance.mT)
    root = np.linalg.cholesky(covariance)
    in_view = perturb(true, (root @ rng.standard_normal((*true.shape[:2], 6, 1)))[..., 0])

    def placed(values: Array, empty: Array) -> Array:
        out = np.moveaxis(at.filled(np.moveaxis(values, 0, 1)), 2, 0)
        return np.where(at.present[..., None, None], out, empty)

    return replace(
        one.problem.pose_data,
        T_station_target=placed(in_view, np.eye(4)),
        whiten=placed(np.linalg.inv(root), np.zeros((6, 6))),
    )


def _start(
    capture: Capture, assembled: Assembled, T_camera_base: Array, readings: Array
) -> BatchState:
    """Where all runs begin: the drawing, poses by its forward kinematics, boards from the poses."""
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
