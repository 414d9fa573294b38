"""A calibrated machine held as it is, on new measurements: the regression behind every judgement.

Nothing is calibrated anew. The machine's parameters stay where they are; the platform's poses,
stations, boards, edge shifts and shading are found. At that point the residuals y, in standard
deviations, have the derivative A by the machine's parameters, and P is the projector that takes out
what all those other unknowns can explain. The truth is the calibrated values plus the calibration's
error e, of covariance C, plus a change c; to first order

    -P y = P A (c + e) + P noise,      the noise of unit variance.

Two things are read from that: what all else predicts of a configuration's readings
(:mod:`pkmcal.judge.prediction`), and whether there is a change c (:func:`change_evidence`).
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
from pkmcal.identify.estimate import Estimate, State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import SHADING_SIGMA, Measurements
from pkmcal.measurements.effects import INTRINSICS
from pkmcal.measurements.rows import Kinds
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import RANK_TOLERANCE, column_space
from pkmcal.solver.search import Stop, minimise
from pkmcal.wording import named

USUAL_RATIO_CHANGE = 1e-3
"""Of a magnification, or another ratio: the size against which it counts as seen."""
USUAL_STATION_MOVE = 1e-2
"""m and rad: the same of a camera's place, what a tripod makes that somebody ran into."""
UNSCALED_NOISE = Kinds(1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Trust:
    """How far new data are believed: weights (N,) of each kind, factors on its noise and on that of
    readings, and the standard deviation (px) of shading.

    Weights come from an estimate whose machine could move: with the machine held, a leg that has
    changed would be taken for an error of its edges, and be let go.
    """

    robust: Kinds[Array]
    scale: Kinds[float] = UNSCALED_NOISE
    readings: float = 1.0
    shading: float = SHADING_SIGMA

    @property
    def weights(self) -> Kinds[Array]:
        """The weights by the noise as scaled."""
        return Kinds(*(w / scale**2 for w, scale in zip(self.robust, self.scale, strict=True)))

    @classmethod
    def full(cls, measurements: Measurements) -> Trust:
        """All data as they are stated."""
        counts = len(measurements.edges), len(measurements.poses), measurements.n_links
        return cls(Kinds(*map(np.ones, counts)))

    @classmethod
    def of(
        cls, estimate: Estimate, scale: Kinds[float] = UNSCALED_NOISE, readings: float = 1.0
    ) -> Trust:
        """An estimate's weights, for data as it found them
        (:meth:`~pkmcal.identify.estimate.Estimate.stated_edge_noise`), where the calibration's
        factors on the stated noise are larger by as much more; of the readings the estimate's own
        where its data contradict their stated noise.
        """
        own = estimate.statistics
        return cls(
            Kinds(
                estimate.edge_weights * estimate.edge_trust,
                estimate.pose_weights,
                estimate.link_weights,
            ),
            Kinds(
                max(scale.edges / own.noise_scale, 1.0),
                max(own.pose_scale, scale.poses),
                max(own.link_scale, scale.links),
            ),
            readings if own.reading_scale == 1 else 1.0,
            own.shading,
        )


@dataclass(frozen=True)
class Held:
    """A machine held on new measurements; see the module.

    machine : as held, with tubes' radii where these were found. observed : (K,). problem, state :
    with the weights in use, and its solution. unknowns : names of the unknowns in which a change is
    looked for: the machine's parameters, and, as intrinsics, the cameras' magnifications.
    """

    machine: Machine
    observed: Booleans
    problem: Problem
    state: BatchState
    unknowns: tuple[str, ...]

    def residuals(self) -> Array:
        """Root mean squares of each configuration's residuals in standard deviations, (K,).

        Its own pose takes up as many rows as it has freedoms; NaN where nothing was seen.
        """
        problem, linear = self.problem, self.problem.linearize(self.state)
        used = (np.sum((k.weight[0] > 0) * k.count, axis=1) for k in problem.kinds)
        count = sum(used, start=np.full(len(linear.value[0]), problem.layout.n_equations))
        free = np.maximum(count - linear.by_own.shape[-1], 1)
        out = np.full(len(self.observed), np.nan)
        out[self.observed] = np.sqrt(np.sum(linear.value[0] ** 2, axis=1) / free)
        return out


def held_machine(machine: Machine, radii: bool) -> Machine:
    """The machine with nothing free, its values for a drawing; radii : but its tubes' radii, which
    light and photographs decide.
    """
    table = machine.parameters
    free = {n for n, kind in zip(table.names, table.kinds, strict=True) if kind == "radius"}
    free = free if radii else set[str]()
    opposed = table.opposed or ((),) * len(table.tied)
    groups = [g for g in zip(table.tied, opposed, strict=True) if free & set(g[0])]
    values = table.unit_axes(machine.values)
    table = replace(
        table,
        drawing=values,
        fixed=tuple(n for n in table.names if n not in free or n in table.fixed),
        tied=tuple(group for group, _ in groups),
        opposed=tuple(against for _, against in groups),
    )
    return replace(machine, parameters=table, values=values.copy())


def hold(
    machine: Machine,
    measurements: Measurements,
    start: State,
    irls_weight: Trust | None = None,
    magnified: Measurements | None = None,
) -> Held:
    """Poses, stations and boards of measurements, found with the machine held.

    start : stations, mounts and poses in frames near the machine's. irls_weight : how far to
    believe the data; without it that is found here, and so are the tubes' radii. magnified : the
    measurements with an unknown magnification a camera (:func:`~pkmcal.judge.causes.magnified`), to
    tell that from a change of the machine. Raises ResultError where the poses are not found.
    """
    still = held_machine(machine, radii=irls_weight is None)
    shading = SHADING_SIGMA if irls_weight is None else irls_weight.shading
    if irls_weight is not None:
        noise = measurements.joint_noise * irls_weight.readings
        measurements = replace(measurements, joint_noise=noise)
        magnified = magnified and replace(magnified, joint_noise=noise)
    assembled = assemble(still, measurements, default_gauge(still), shading=shading)
    begin = batch_of(still, assembled, replace(start, theta=still.values))
    if irls_weight is None:
        if not _is_enough(assembled.problem, begin):
            raise too_little(machine, measurements)
        result = solve_batch(assembled.problem, begin, scale_readings=False)
        problem, solution = result.info.problem, result.solution
    else:
        problem = assembled.trusting(irls_weight.weights)
        solution = minimise(problem, begin)
    if solution.stop[0] in (Stop.NOT_FINITE, Stop.STALLED):
        raise ResultError(
            "the platform's poses were not found with the calibrated machine:"
            f" {solution.stop[0].value}"
        )
    state: BatchState = solution.state
    still = still.with_values(problem.theta(state)[0])
    if irls_weight is None or magnified is None:
        return Held(still, assembled.observed, problem, state, ("machine",))
    opened = assemble(still, magnified, default_gauge(still), shading=irls_weight.shading)
    problem = opened.trusting(irls_weight.weights)
    u = problem.unknowns
    new = u.columns(INTRINSICS)
    columns = np.zeros((len(state.columns), u.effects.stop - u.effects.start))
    columns[:, np.delete(np.arange(columns.shape[1]), new - u.effects.start)] = state.columns
    state = replace(state, columns=columns)
    return Held(still, assembled.observed, problem, state, ("machine", INTRINSICS))


def _is_enough(problem: Problem, state: BatchState) -> bool:
    """Whether there are as many rows as unknowns."""
    linear = problem.linearize(state)
    rows = int(linear.usable.sum()) + len(linear.shared_by)
    return rows >= problem.unknowns.count + linear.by_own.shape[1] * linear.by_own.shape[-1]


def too_little(machine: Machine, measurements: Measurements) -> PkmcalError:
    """Why readings cannot be predicted: too little was measured, or, of legs alone whose ends are
    moved by the readings, more of it would not help.
    """
    layout = machine.layout
    shifted = np.flatnonzero((layout.actuated >= 0) & ~layout.rod_reads)
    if len(measurements.edges) and not measurements.on_platform.any() and shifted.size:
        return InputError(
            f"the readings of {machine.name} cannot be predicted from photographs of its legs yet",
            found=f"{named(shifted, layout.n_legs)} on cranks or sliders, where edges are located"
            " with the readings that are to be predicted",
            expected="a board on the platform, or a tracker's table of its poses, besides",
            next_step="Add one of these (observe: [legs, board]), or calibrate two sessions of"
            " different configurations and compare the results with pkmcal diff",
        )
    return ResultError(
        "too little was seen to predict readings: some poses follow from their own readings alone",
        expected="legs, a board or whole poses in several more configurations; heights tell none",
        next_step="Photograph more configurations from each station",
    )


@dataclass(frozen=True)
class Evidence:
    """New data as a linear regression on a change of the machine, ``w = X c + noise``.

    w : (n,) of unit variance. by : X (n, P + C + 6 k), by the parameters' changes in m and rad, by
    the magnification of C cameras where that was asked for, and by how k cameras that were left in
    place turned and moved, (phi, s) in their own axes, rad and m. An axis' own length has no part
    in it. fixed_stations : (k,) numbers of these stations in the session.
    Every test of a change is one on w and X: a score test, no machine is estimated.
    """

    w: Array
    by: Array
    fixed_stations: tuple[int, ...] = ()

    def along(self, columns: Array) -> Array:
        """X D of changes (P, k) of the parameters, (P + C, k) with cameras' magnifications, or of
        all columns.
        """
        return self.by[:, : len(columns)] @ columns


def change_evidence(held: Held, prior: CalibrationPrior) -> Evidence:
    """What the data tell of a change from the held values: whitened by V = 1 + A C A^T with the
    calibration's covariance C.

    Stations that it does not know are found anew and take up what they can. Of the kept ones the
    residuals are told at the calibration's places, by the derivatives at those found.
    """
    machine, n = held.machine, len(held.machine.parameters)
    covariance, stations = prior.covariance, prior.stations
    problem, state = held.problem.opened(held.state)
    names = (*held.unknowns, "stations") if stations else held.unknowns
    rows, remainder = reduced_rows(Information(problem, state), names)
    if stations:
        rows, remainder = _with_fixed_stations(rows, remainder, state.T_camera_base[0], n, prior)
    n_cameras = rows.shape[1] - n - 6 * len(stations)
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
    observable = s > RANK_TOLERANCE * s.max(initial=0.0)
    # noise is drawn in this basis: its signs must not be rounding's choice
    sign = np.sign(vt[np.arange(len(vt)), np.abs(vt).argmax(axis=1)])[observable]
    by = (sign * s[observable])[:, None] * vt[observable] / size
    projected = -sign * (u[:, observable].T @ remainder)
    errors = np.delete(by, n + np.arange(n_cameras), axis=1)
    spread = np.eye(len(projected)) + errors @ covariance @ errors.T
    lower = np.linalg.cholesky(0.5 * (spread + spread.T))
    for k, station in enumerate(stations):
        at = n + n_cameras + 6 * k
        by[:, at : at + 6] = by[:, at : at + 6] @ _by_camera(state.T_camera_base[0, station])
    return Evidence(np.linalg.solve(lower, projected), np.linalg.solve(lower, by), stations)


def _with_fixed_stations(
    rows: Array, remainder: Array, values: Array, n: int, prior: CalibrationPrior
) -> tuple[Array, Array]:
    """Rows by n parameters, all stations' places (S, 4, 4) and cameras, as rows by parameters,
    cameras and the kept stations; and the residuals with these at the calibration's places.
    """
    six = np.arange(6)
    all_stations = n + np.arange(6 * len(values))
    own = (n + 6 * np.array(prior.stations)[:, None] + six).ravel()
    q = column_space(rows[:, np.setdiff1d(all_stations, own)])
    rows, remainder = rows - q @ (q.T @ rows), remainder - q @ (q.T @ remainder)
    off = pose_difference(prior.T_camera_base, values[list(prior.stations)]).ravel()
    remainder = remainder + rows[:, own] @ off
    return np.concatenate([np.delete(rows, all_stations, axis=1), rows[:, own]], axis=1), remainder


def _by_camera(T_camera_base: Array) -> Array:
    """Changes (omega, tau) of T_camera_base (4, 4) as the camera turns by phi and moves by s in its
    own axes, (6, 6): points become Exp(-phi) (p - s) there.
    """
    out = -np.eye(6)
    out[3:, :3] = skew(T_camera_base[:3, 3])
    return out


def _across_axes(machine: Machine) -> Array:
    """Projector (P, P) that takes out what would only make axes longer."""
    table = machine.parameters
    values, out = table.unit_axes(machine.values), np.eye(len(table))
    for index in table.axes:
        out[np.ix_(index, index)] -= np.outer(values[index], values[index])
    return out
