"""A machine held as it is, and what it predicts on photographs: poses, readings, tool points.

Stations, boards' mounts and the platform's poses are estimated from the photographs; the machine's
geometry is not. Where photographs leave open where stations and boards are (a board tells a pose in
a camera that stands anywhere), readings of *other* configurations tell: closures stand in the
estimate with the soft deviation :data:`SOFT`, which gives way to anything seen, and each
configuration's own readings are then taken out again exactly, by their leverage (leave-one-out).

Notation of the linear algebra, rows in standard deviations, K' seen configurations: own Jacobian
``Q R``, reduced shared Jacobian ``S = (I - Q Q^T) A``, normal matrix ``N = sum S^T S + F^T F`` with
F of the priors, E the rows of readings. To first order their residuals are
``rho_k = E (I - Q Q^T) y_k - E S_k N^+ (sum S_l^T y_l + F^T eta)``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import pose_difference
from pkmcal.identify.assembly import assemble, batch_of, state_of
from pkmcal.identify.blocks import BatchState
from pkmcal.identify.bundle import BatchResult, solve_batch
from pkmcal.identify.closure_noise import PERFECT
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.problem import State
from pkmcal.identify.residuals import Problem
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.kinematics import forward
from pkmcal.solver import Linear, Reduced, Stop, eliminate, transposed

SOFT = 0.01
"""Deviation (m, rad) given to readings while stations and poses are sought: tens of times what a
photograph leaves open, so a seen pose hardly knows them."""
KNOWN = 1e-9
"""Singular value, of scaled columns, below which a shared unknown counts as open."""
ALONE = 1e-2
"""Part of a reading's residual that its own fit leaves, below which hardly anything but the reading
told where the platform was: what was seen left ten times SOFT open."""


@dataclass(frozen=True)
class Prediction:
    """What a machine predicts of a session; values of configurations that were not seen are NaN.

    machine : as held, with the session's tube radii. state : stations, mounts and poses.
    seen : (K,) configurations whose pose was seen. T_base_platform : (K, 4, 4) seen, without the
    configuration's own readings. readings : (K, m) predicted from it. residuals : (K, m) measured
    less predicted, m or rad. T_by_readings : (K, 4, 4) forward kinematics. position, orientation :
    (K,) distance of the two poses, m and rad. noise_scale, pose_scale : factors on the stated noise
    of edges and of boards' poses.
    noise : (n, n) covariance of the residuals of the n = K' m seen readings by the photographs'
    and the readings' noise. by_machine : (n, P) their derivatives by the machine's parameters.
    """

    machine: Machine
    state: State
    seen: Booleans
    T_base_platform: Array
    readings: Array
    residuals: Array
    T_by_readings: Array
    position: Array
    orientation: Array
    noise_scale: float
    pose_scale: float
    noise: Array
    by_machine: Array


def held(machine: Machine) -> Machine:
    """The machine with nothing free but its tubes' radii, which light and photographs decide."""
    table = machine.parameters
    fixed = tuple(n for n, kind in zip(table.names, table.kinds, strict=True) if kind != "radius")
    radii = set(table.names) - set(fixed)
    opposed = table.opposed or ((),) * len(table.tied)
    groups = [g for g in zip(table.tied, opposed, strict=True) if radii & set(g[0])]
    values = table.unit_axes(machine.values)
    table = replace(
        table,
        drawing=values,
        fixed=(*fixed, *(n for n in table.fixed if n in radii)),
        tied=tuple(group for group, _ in groups),
        opposed=tuple(against for _, against in groups),
    )
    return replace(machine, parameters=table, values=values.copy())


def predict(machine: Machine, measurements: Measurements, start: State) -> Prediction:
    """What a machine predicts of readings and tool points, seen by measurements.

    start : stations, mounts and poses in frames near the machine's. Raises ResultError where they
    are not found, or where nothing but a configuration's own readings tells its pose.
    """
    still = held(machine)
    soft = replace(measurements, joint_noise=SOFT)
    assembled = assemble(still, soft, default_gauge(still))
    begin = batch_of(still, assembled, replace(start, theta=still.values))
    _check_enough(assembled.problem, begin)
    result = solve_batch(assembled.problem, begin)
    stop = result.solution.stop[0]
    if stop in (Stop.NOT_FINITE, Stop.STALLED):
        raise ResultError(f"the platform's poses were not found: {stop.value}")
    fit = _fit(result)
    without = _without_own(result.problem, result.solution.state, fit)
    state = state_of(assembled, without, start)
    still = still.with_values(state.theta)
    noise, by_machine = _deviations(result, fit, measurements.joint_noise)
    shown = _shown(still, measurements.joints, assembled.seen, without)
    return Prediction(
        machine=still,
        state=state,
        seen=assembled.seen,
        **shown,
        noise_scale=float(result.noise_scale[0]),
        pose_scale=float(result.pose_scale[0]),
        noise=noise,
        by_machine=by_machine,
    )


def _check_enough(problem: Problem, state: BatchState) -> None:
    """Raise ResultError where there are fewer rows than unknowns."""
    linear = problem.linearize(state)
    rows = int(linear.usable.sum()) + len(linear.shared_by)
    if rows < problem.n_shared + linear.by_own.shape[1] * linear.by_own.shape[-1]:
        raise _too_little()


def _too_little() -> ResultError:
    return ResultError(
        "too little was seen to predict readings: some poses follow from their own readings alone",
        expected="legs, or a board in several more configurations",
        next_step="Photograph more configurations from each station",
    )


class _Fit(NamedTuple):
    """The first run at the solution, (K', ...); see the module.

    linear, reduced : as the solver has them. inverse : N^+ (a, a). picks : E (K', m, r).
    loo : (K', m, m) turns a residual into that of a fit without its own readings. size : (K', m)
    turns it into a reading's, m or rad.
    """

    linear: Linear
    reduced: Reduced
    inverse: Array
    picks: Array
    loo: Array
    size: Array


def _fit(result: BatchResult) -> _Fit:
    problem, state = result.problem, result.solution.state
    linear = problem.linearize(state)
    reduced = eliminate(linear, np.zeros(1))
    s, q = reduced.rows[0], reduced.q[0]
    inverse = _inverse(s, linear.shared_by)
    picks = _picks(problem, state, s.shape[1])
    along, shared = picks @ q, picks @ s
    left = np.eye(picks.shape[1]) - along @ transposed(along)
    left = left - shared @ inverse @ transposed(shared)
    least = float(np.linalg.eigvalsh(left).min(initial=1.0))
    if least < ALONE:
        raise _too_little()
    return _Fit(linear, reduced, inverse, picks, np.linalg.inv(left), _size(problem, state))


def _inverse(rows: Array, priors: Array) -> Array:
    """N^+ (a, a) from rows (K', r, a) and priors' (c, a); open directions count as exact."""
    stacked = np.concatenate([rows.reshape(-1, rows.shape[-1]), priors])
    scale = np.sqrt(np.sum(stacked**2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(np.linalg.qr(stacked / scale, mode="r"))
    known = s > KNOWN * s.max(initial=0.0)
    half = vt[: len(s)][known].T / s[known] / scale[:, None]
    return half @ half.T


def _picks(problem: Problem, state: BatchState, n_rows: int) -> Array:
    """E (K', m, r): the rows of readings, one each, out of a configuration's."""
    n_poses, n_equations = state.T_base_platform.shape[1], problem.layout.n_equations
    columns = [
        problem.joint_rows(np.broadcast_to(row, (1, n_poses, n_equations)), state)[0]
        for row in np.eye(n_equations)
    ]
    out = np.zeros((n_poses, problem.layout.n_readings, n_rows))
    out[..., problem.closure_rows] = np.stack(columns, axis=-1)
    return out


def _size(problem: Problem, state: BatchState) -> Array:
    """Reading (K', m) that one standard deviation of its row is, m or rad, with its sign."""
    layout = problem.layout
    internal = state.internal[0] if layout.n_internal else None
    c = closure(
        layout, problem.theta(state)[0], problem.data.joints[0], state.T_base_platform[0], internal
    )
    pick = layout.row_motor[:, None] == np.arange(layout.n_readings)
    slope = np.sqrt(c.by_reading**2 @ pick)
    sign = 1.0 if layout.shares_motors else np.sign(c.by_reading @ pick)
    return sign * np.hypot(PERFECT, SOFT * slope) / slope


def _without_own(problem: Problem, state: BatchState, fit: _Fit) -> BatchState:
    """The poses of fits without each configuration's own readings.

    ``R^-1 Q^T (I - A N^+ S^T) E^T (I - L)^-1 rho``: the answer to readings moved to where the
    others predict them.
    """
    value = fit.linear.value[0][..., None]
    moved = transposed(fit.picks) @ fit.loo @ fit.picks @ value
    a, s, q = fit.linear.by_shared[0], fit.reduced.rows[0], fit.reduced.q[0]
    moved = transposed(q) @ (moved - a @ (fit.inverse @ (transposed(s) @ moved)))
    own = np.linalg.solve(fit.reduced.r[0], moved)[..., 0]
    return problem.moved(state, np.zeros((1, a.shape[-1])), own[None])


def _deviations(result: BatchResult, fit: _Fit, joint_noise: float) -> tuple[Array, Array]:
    """Covariance (n, n) of the residuals by noise, and their derivatives (n, P) by the machine."""
    s, q = fit.reduced.rows[0], fit.reduced.q[0]
    less = 1 - (joint_noise / SOFT) ** 2
    own = fit.picks - (fit.picks @ q) @ transposed(q)
    shared, inverse = fit.picks @ s, fit.inverse
    read = fit.picks @ s
    normal = np.sum(transposed(s) @ s - less * transposed(read) @ read, axis=0)
    priors = fit.linear.shared_by
    spread = inverse @ (normal + priors.T @ priors) @ inverse
    own_read = own @ transposed(fit.picks)
    block = own @ transposed(own) - less * own_read @ transposed(own_read)
    cross = (own @ s - less * own_read @ read) @ inverse
    units = fit.size[..., None] * fit.loo
    shared, cross = (_flat(units @ part) for part in (shared, cross))
    noise = shared @ spread @ shared.T - cross @ shared.T - shared @ cross.T
    k = np.arange(len(units))
    m = units.shape[1]
    noise.reshape(len(k), m, len(k), m)[k, :, k, :] += units @ block @ transposed(units)
    by = _by_machine(result)
    answer = own @ by - fit.picks @ s @ inverse @ np.sum(transposed(s) @ by, axis=0)
    return 0.5 * (noise + noise.T), _flat(units @ answer)


def _flat(parts: Array) -> Array:
    """(K', m, n) as (K' m, n)."""
    return parts.reshape(-1, parts.shape[-1])


def _by_machine(result: BatchResult) -> Array:
    """All rows (K', r) by all parameters of the machine but the radii, (K', r, P)."""
    problem, state = result.problem, result.solution.state
    n = problem.drawing.size
    wide = replace(problem, free=np.eye(n), prior=np.zeros((0, 0)), prior_target=np.zeros(0))
    wide = replace(wide, prior=np.zeros((0, wide.n_shared)))
    values = problem.theta(state) - problem.drawing
    rows = wide.linearize(replace(state, z=values)).by_shared[0, ..., :n].copy()
    rows[..., np.any(problem.free != 0, axis=1)] = 0.0
    return rows


def _shown(machine: Machine, joints: Array, seen: Booleans, found: BatchState) -> dict[str, Array]:
    """Poses, readings and tool points of all configurations, NaN where nothing was seen."""
    poses = found.T_base_platform[0]
    readings = machine.inverse(poses)
    by_readings = forward(machine.layout, machine.values, joints[seen], poses, found.internal[0])
    good = by_readings.converged[:, None, None]
    there = np.where(good, by_readings.T_base_platform, np.nan)
    off = np.full((len(poses), 6), np.nan)
    ok = by_readings.converged
    off[ok] = pose_difference(poses[ok], there[ok])
    return {
        "T_base_platform": _spread(poses, seen),
        "readings": _spread(readings, seen),
        "residuals": _spread(joints[seen] - readings, seen),
        "T_by_readings": _spread(there, seen),
        "position": _spread(np.linalg.norm(off[:, 3:], axis=1), seen),
        "orientation": _spread(np.linalg.norm(off[:, :3], axis=1), seen),
    }


def _spread(values: Array, seen: Booleans) -> Array:
    """Values (K', ...) of the seen configurations among all, NaN elsewhere."""
    out = np.full((len(seen), *values.shape[1:]), np.nan)
    out[seen] = values
    return out
