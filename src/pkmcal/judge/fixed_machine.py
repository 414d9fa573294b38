"""Fit of new measurements with the calibrated machine fixed: the regression behind every judgement.

The machine's parameters are fixed; the platform's poses, stations, boards, edge shifts and shading
are estimated. At that point the residuals y, in standard deviations, have the derivative A by the
machine's parameters, and P is the projector that eliminates all other unknowns, the nuisance
parameters. The true parameters are the calibrated ones plus the calibration's error e, of
covariance C, plus a change c; to first order

    -P y = P A (c + e) + P noise,      with noise of unit variance.

This gives the prediction of a configuration's readings by all other data
(:mod:`pkmcal.judge.prediction`), and the tests for a change c (:func:`change_evidence`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.calibration.saved_calibration import CalibrationPrior
from pkmcal.errors import InputError, PkmcalError, ResultError
from pkmcal.geometry.rigid import pose_difference, skew
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.covariance import Information, reduced_rows
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.problem import Problem
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import SHADING_SIGMA, Measurements
from pkmcal.measurements.effects import INTRINSICS
from pkmcal.measurements.rows import RowGroups
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import column_space, nonzero
from pkmcal.solver.search import Stop, minimise
from pkmcal.wording import named

USUAL_RATIO_CHANGE = 1e-3
"""Typical change of a magnification or another ratio, the scale of its observability."""
USUAL_STATION_MOVE = 1e-2
"""Typical motion of a camera, m and rad, such as that of a tripod that was bumped."""
UNSCALED_NOISE = RowGroups(1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Trust:
    """Weights and noise of new data.

    robust : (N,) IRLS weights of each kind.
    scale, readings : factors on the stated noise of each kind, and of readings.
    shading : px, standard deviation of the lines' shading.

    Weights come from an estimate with a free machine: with a fixed one, the edges of a changed leg
    would be outliers and lose their weights.
    """

    robust: RowGroups[Array]
    scale: RowGroups[float] = UNSCALED_NOISE
    readings: float = 1.0
    shading: float = SHADING_SIGMA

    @property
    def weights(self) -> RowGroups[Array]:
        """Weights relative to the scaled noise."""
        return RowGroups(*(w / scale**2 for w, scale in zip(self.robust, self.scale, strict=True)))

    @classmethod
    def full(cls, measurements: Measurements) -> Trust:
        """Unit weights and the stated noise."""
        counts = len(measurements.edges), len(measurements.poses), measurements.n_links
        return cls(RowGroups(*map(np.ones, counts)))

    @classmethod
    def of(
        cls, estimate: Estimate, scale: RowGroups[float] = UNSCALED_NOISE, readings: float = 1.0
    ) -> Trust:
        """Weights of an estimate, for data with its noise
        (:meth:`~pkmcal.identify.estimate.Estimate.stated_edge_noise`).

        scale, readings : the calibration's factors on the stated noise, used where they are larger
            than the estimate's own. For readings the estimate's own factor is used if its data
            contradict the stated noise.
        """
        own = estimate.statistics
        return cls(
            RowGroups(
                estimate.edge_weights * estimate.edge_trust,
                estimate.pose_weights,
                estimate.link_weights,
            ),
            RowGroups(
                max(scale.edges / own.noise_scale, 1.0),
                max(own.pose_scale, scale.poses),
                max(own.link_scale, scale.links),
            ),
            readings if own.reading_scale == 1 else 1.0,
            own.shading,
        )


@dataclass(frozen=True)
class Held:
    """Fit of new measurements with a fixed machine; see the module.

    machine : fixed machine; the tubes' radii are estimated if they were free.
    observed : (K,) configurations with measurements.
    problem, state : problem with the final weights, and its solution.
    unknowns : names of the unknowns of a change: the machine's parameters, and the cameras'
        magnifications (as intrinsics).
    stop : why the search for it ended; the step limit may have been reached.
    """

    machine: Machine
    observed: Booleans
    problem: Problem
    state: BatchState
    unknowns: tuple[str, ...]
    stop: Stop

    def located(self, start: State) -> State:
        """Stations, boards and observed poses of the solution; the rest is that of ``start``."""
        poses, internal = start.T_base_platform.copy(), self.state.internal[0]
        poses[self.observed] = self.state.T_base_platform[0]
        hinges = np.zeros((len(poses), internal.shape[-1]))
        hinges[self.observed] = internal
        return replace(
            start,
            T_camera_base=self.state.T_camera_base[0],
            T_base_platform=poses,
            T_mount=self.state.T_mount[0],
            internal=hinges,
        )

    def residuals(self) -> Array:
        """Root mean squares (K,) of each configuration's residuals in standard deviations.

        Rows are reduced by the degrees of freedom of the configuration's own pose; NaN without
        measurements.
        """
        problem, linear = self.problem, self.problem.linearize(self.state)
        used = (np.sum((k.weight[0] > 0) * k.count, axis=1) for k in problem.row_groups)
        count = sum(used, start=np.full(len(linear.value[0]), problem.layout.n_equations))
        free = np.maximum(count - linear.by_own.shape[-1], 1)
        out = np.full(len(self.observed), np.nan)
        out[self.observed] = np.sqrt(np.sum(linear.value[0] ** 2, axis=1) / free)
        return out


def held_machine(machine: Machine, radii: bool) -> Machine:
    """Machine with all parameters fixed, with its values as the nominal model.

    radii : leave the tubes' radii free, because they depend on light and images.
    """
    table = machine.parameters
    free = {n for n, kind in zip(table.names, table.kinds, strict=True) if kind == "radius"}
    free = free if radii else set[str]()
    opposed = table.opposed or ((),) * len(table.tied)
    groups = [g for g in zip(table.tied, opposed, strict=True) if free & set(g[0])]
    values = table.unit_axes(machine.values)
    table = replace(
        table,
        nominal=values,
        fixed=tuple(n for n in table.names if n not in free or n in table.fixed),
        tied=tuple(group for group, _ in groups),
        opposed=tuple(against for _, against in groups),
    )
    return replace(machine, parameters=table, values=values.copy())


def hold(
    machine: Machine,
    measurements: Measurements,
    start: State,
    data_weights: Trust | None = None,
    magnified: Measurements | None = None,
) -> Held:
    """Estimate poses, stations and boards with the machine fixed.

    start : stations, mounts and poses in frames near those of the machine.
    data_weights : weights and noise of the data; without it they are estimated, as well as the
        tubes' radii.
    magnified : the measurements with an unknown magnification for each camera
        (:func:`~pkmcal.judge.causes.magnified`), to separate it from a change of the machine.

    Raises ResultError if the poses are not found.
    """
    # Problem with the machine fixed, with the given noise if any.
    still = held_machine(machine, radii=data_weights is None)
    shading = SHADING_SIGMA if data_weights is None else data_weights.shading
    if data_weights is not None:
        noise = measurements.joint_noise * data_weights.readings
        measurements = replace(measurements, joint_noise=noise)
        magnified = magnified and replace(magnified, joint_noise=noise)
    assembled = assemble(still, measurements, default_gauge(still), shading=shading)
    begin = batch_of(still, assembled, replace(start, theta=still.values))
    if data_weights is None:
        # Weights and noise are estimated if there are enough rows.
        linear, unknowns = assembled.problem.linearize(begin), assembled.problem.unknowns.count
        unknowns += linear.by_own.shape[1] * linear.by_own.shape[-1]
        if int(linear.usable.sum()) + len(linear.shared_by) < unknowns:
            raise too_little(machine, measurements)
        fit = solve_batch(assembled.problem, begin, scale_readings=False)
        problem, solution = fit.info.problem, fit.solution
    else:
        problem = assembled.trusting(data_weights.weights)
        solution = minimise(problem, begin)
    if solution.stop[0] in (Stop.NOT_FINITE, Stop.STALLED):
        raise not_converged(solution.stop[0])
    state: BatchState = solution.state
    still = still.with_values(problem.theta(state)[0])
    if data_weights is None or magnified is None:
        return Held(still, assembled.observed, problem, state, ("machine",), solution.stop[0])
    # The same solution in a problem with magnifications, which are zero there.
    opened = assemble(still, magnified, default_gauge(still), shading=data_weights.shading)
    problem = opened.trusting(data_weights.weights)
    u = problem.unknowns
    new = u.columns(INTRINSICS)
    columns = np.zeros((len(state.columns), u.effects.stop - u.effects.start))
    columns[:, np.delete(np.arange(columns.shape[1]), new - u.effects.start)] = state.columns
    state = replace(state, columns=columns)
    return Held(
        still, assembled.observed, problem, state, ("machine", INTRINSICS), solution.stop[0]
    )


def not_converged(stop: Stop) -> ResultError:
    """Error if the platform's poses are not found."""
    return ResultError(
        f"the platform's poses were not found with the calibrated machine: {stop.value}",
        code="poses.not_converged",
    )


def too_little(machine: Machine, measurements: Measurements) -> PkmcalError:
    """Error if readings cannot be predicted.

    There are too few measurements, or only legs whose ends move with the readings, for which more
    measurements do not help.
    """
    layout = machine.layout
    moved = np.flatnonzero((layout.actuated >= 0) & ~layout.lengthens)
    if len(measurements.edges) and not measurements.on_platform.any() and moved.size:
        return InputError(
            f"the readings of {machine.name} cannot be predicted from images of its legs yet",
            found=f"{named(moved, layout.n_legs)} on cranks or sliders, where edges are located"
            " with the readings that are to be predicted",
            expected="a board on the platform, or a tracker's table of its poses, besides",
            next_step="Add one of these (observe: [legs, board]), or calibrate two sessions of"
            " different configurations and compare the results with pkmcal diff",
        )
    return ResultError(
        "there are too few measurements to predict readings: some poses follow from their own"
        " readings alone",
        expected="legs, a board or whole poses in several more configurations; heights determine"
        " no pose",
        next_step="Take images of more configurations from each station",
        code="validation.few_measurements",
    )


@dataclass(frozen=True)
class Evidence:
    """Linear regression of new data on a change of the machine, ``w = X c + noise``.

    w : (n,) of unit variance.
    by : X (n, P + C + 6 k), for the parameters' changes in m and rad, the magnifications of C
        cameras if requested, and the motion (phi, s) of k cameras that were left in place, along
        their own axes, rad and m. Changes of the length of an axis are projected out.
    fixed_stations : (k,) indices of these stations in the session.

    Every test for a change is a score test on w and X, without an estimate of the machine.
    """

    w: Array
    by: Array
    fixed_stations: tuple[int, ...] = ()

    def along(self, columns: Array) -> Array:
        """X D for changes D (P, k) of the parameters, (P + C, k) with cameras' magnifications, or
        of all columns.
        """
        return self.by[:, : len(columns)] @ columns


def change_evidence(held: Held, prior: CalibrationPrior) -> Evidence:
    """Evidence on a change from the fixed values, whitened by V = 1 + A C A^T with the
    calibration's covariance C.

    Stations that are not part of the calibration are nuisance parameters and eliminated. For
    stations that were left in place, residuals refer to the calibration's poses, with the
    derivatives at the estimated ones.
    """
    machine, n = held.machine, len(held.machine.parameters)
    covariance, stations = prior.covariance, prior.stations
    problem, state = held.problem.opened(held.state)
    # Rows on machine, magnifications and stations, with all other unknowns eliminated.
    names = (*held.unknowns, "stations") if stations else held.unknowns
    rows, residual = reduced_rows(Information(problem, state), names)
    if stations:
        rows, residual = _with_fixed_stations(rows, residual, state.T_camera_base[0], n, prior)
    n_cameras = rows.shape[1] - n - 6 * len(stations)
    # Reduction to the observable directions, with columns in units of typical changes.
    size = np.concatenate(
        [
            machine.parameters.tolerance,
            np.full(n_cameras, USUAL_RATIO_CHANGE),
            np.full(6 * len(stations), USUAL_STATION_MOVE),
        ]
    )
    by = rows * size
    by[:, :n] = rows[:, :n] @ _across_axes(machine) * size[:n]
    u, s, vt = np.linalg.svd(by, full_matrices=False)
    observable = nonzero(s)
    # draws of noise are in this basis, so the signs of its vectors must not depend on rounding
    sign = np.sign(vt[np.arange(len(vt)), np.abs(vt).argmax(axis=1)])[observable]
    by = (sign * s[observable])[:, None] * vt[observable] / size
    projected = -sign * (u[:, observable].T @ residual)
    # Whitening by noise and the calibration's error, which has no part for magnifications.
    errors = np.delete(by, n + np.arange(n_cameras), axis=1)
    spread = np.eye(len(projected)) + errors @ covariance @ errors.T
    lower = np.linalg.cholesky(0.5 * (spread + spread.T))
    for k, station in enumerate(stations):
        at = n + n_cameras + 6 * k
        # by a rotation phi and a motion s of the camera along its own axes, after which points
        # are Exp(-phi) (p - s) in its frame
        by_camera = -np.eye(6)
        by_camera[3:, :3] = skew(state.T_camera_base[0, station, :3, 3])
        by[:, at : at + 6] = by[:, at : at + 6] @ by_camera
    return Evidence(np.linalg.solve(lower, projected), np.linalg.solve(lower, by), stations)


def _with_fixed_stations(
    rows: Array, residual: Array, T_camera_base: Array, n: int, prior: CalibrationPrior
) -> tuple[Array, Array]:
    """Rows with the stations reduced to the kept ones, and residuals at the calibration's poses.

    rows : by n parameters, all stations' poses T_camera_base (S, 4, 4), and cameras; returned by
    parameters, cameras and the kept stations. The other stations are eliminated.
    """
    six = np.arange(6)
    all_stations = n + np.arange(6 * len(T_camera_base))
    own = (n + 6 * np.array(prior.stations)[:, None] + six).ravel()
    q = column_space(rows[:, np.setdiff1d(all_stations, own)])
    rows, residual = rows - q @ (q.T @ rows), residual - q @ (q.T @ residual)
    off = pose_difference(prior.T_camera_base, T_camera_base[list(prior.stations)]).ravel()
    residual = residual + rows[:, own] @ off
    return np.concatenate([np.delete(rows, all_stations, axis=1), rows[:, own]], axis=1), residual


def _across_axes(machine: Machine) -> Array:
    """Projector (P, P) that removes changes of the lengths of axes."""
    table = machine.parameters
    values, out = table.unit_axes(machine.values), np.eye(len(table))
    for index in table.axes:
        out[np.ix_(index, index)] -= np.outer(values[index], values[index])
    return out
