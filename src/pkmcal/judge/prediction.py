"""Prediction of readings and tool points by a fixed machine, from images.

Stations, mounts and platform poses are estimated from the images with the machine fixed
(:mod:`pkmcal.judge.fixed_machine`). Where images do not determine the poses of stations and boards
(a board is observed by a camera of unknown pose), the readings of *other* configurations do:
closures enter the estimate with the large standard deviation :data:`SOFT_READING_NOISES`, so that
any observation dominates them, and each configuration's own readings are then removed exactly, by
their leverage (leave-one-out).

With E the rows of readings and ``P = 1 - Q Q^T - q q^T`` the projector of
:mod:`pkmcal.judge.fixed_machine`, where Q and q are orthonormal bases of the column spaces of a
configuration's own unknowns and of the shared ones, their residuals are ``E P y``. The part of a
reading's own error in them is ``L``, a configuration's block of ``E P E^T``: residuals of fits
without the own readings are ``L^-1 E P y``, to first order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.holdout import select
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.gauge import pose_generators
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import BatchState
from pkmcal.judge.fixed_machine import Held, hold, not_converged, too_little
from pkmcal.levels import ROUNDING
from pkmcal.measurements import Measurements
from pkmcal.measurements.readings import PERFECT_CLOSURE_SIGMA
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.kinematics import forward, inverse_result
from pkmcal.solver.elimination import Linear, Reduced, eliminate, rows_on_shared
from pkmcal.solver.ranks import RANK_TOLERANCE, column_space, inverse_root
from pkmcal.solver.search import Stop

SOFT_READING_NOISES = 0.01, 0.001, 0.0001
"""Standard deviations (m, rad) of readings in the estimate of stations and poses. The first is tens
of times the uncertainty by an image, so that an observed pose hardly depends on them. The smaller
ones serve where the search does not converge: where readings alone tell the board's place from the
camera's, as on a platform that hardly rotates, softness lets both slide along a curved valley.
Poses then depend on readings more; each configuration's own are removed in any case.
"""
WIDEST_PREDICTION = 0.1
"""Largest standard deviation (m, rad) of a predicted reading: beyond it the leave-one-out fit, a
step of first order, is not valid."""
LEAST_REDUNDANCY = 1e-4
"""Smallest eigenvalue of L: its inverse amplifies what the search leaves, 1e-7 of
SOFT_READING_NOISES, to 10 um."""
FRAME_LAYING_STEPS = 20
FRAMES_LAID_CHANGE = 1e-10
"""Change of the frames (m, rad) below which their registration has converged."""


@dataclass(frozen=True)
class ReadingErrors:
    """Errors at n configurations.

    residuals : (n, m) measured minus predicted readings, m or rad. position, orientation : (n,)
    errors of the tool point by the readings, m and rad; NaN if the machine does not close.
    """

    residuals: Array
    position: Array
    orientation: Array

    def of(self, rows: Integers) -> ReadingErrors:
        """Errors of selected configurations."""
        return ReadingErrors(self.residuals[rows], self.position[rows], self.orientation[rows])


@dataclass(frozen=True)
class Prediction:
    """Prediction of a session by a machine; values are NaN for configurations without observations.

    machine : fixed machine, with the session's tube radii.
    observed : (K,) configurations with an observed pose.
    T_base_platform : (K, 4, 4) observed poses, from fits without the configuration's own readings.
    errors : (K,) errors of the readings predicted from these poses, and of the tool point.
    noise : (n, n) covariance of the residuals of the n = K' m observed readings, due to the noise
        of images and readings.
    by_machine : (n, P) derivatives of these residuals by the machine's parameters.
    """

    machine: Machine
    observed: Booleans
    T_base_platform: Array
    errors: ReadingErrors
    noise: Array
    by_machine: Array


def predict(machine: Machine, measurements: Measurements, start: State) -> Prediction:
    """Predict readings and tool points of the measured configurations.

    Configurations whose pose is determined almost only by their own readings, such as those of an
    image with hardly an edge, count as not observed.

    start : stations, mounts and poses in frames near those of the machine.

    Raises ResultError if the poses cannot be estimated, or if no configuration's pose is observed.
    """
    # Links determine only the difference of two poses. The fit with the readings' own noise comes
    # first: from afar, a search with soft readings follows a curved valley.
    measurements = replace(measurements, links=())
    near = hold(machine, measurements, start).located(start)
    soft, held = _softly_held(machine, measurements, near)
    linear = held.problem.linearize(held.state)
    reduced = eliminate(linear)
    own, shared = reduced.q[0], column_space(rows_on_shared(linear, reduced)[0][0])
    picks = _reading_selector(held, linear.value.shape[-1])
    n, m, n_rows = picks.shape

    # L = E P E^T, the redundancy of each configuration's readings, and the predictions' noise.
    along = picks @ own
    along = along @ along.mT
    beside = picks @ shared[: n * n_rows].reshape(n, n_rows, -1)
    redundancy = np.eye(m) - along - beside @ beside.mT  # L
    determined = np.linalg.eigvalsh(redundancy).min(axis=-1) >= LEAST_REDUNDANCY
    alone = np.linalg.inv(np.where(determined[:, None, None], redundancy, np.eye(m)))
    units = _reading_per_sigma(held, soft)[..., None] * alone
    less = 1 - (measurements.joint_noise / soft) ** 2
    noise = _noise(along, beside, units, less)
    blocks = np.einsum("kikj->kij", noise.reshape(n, m, n, m))
    determined &= np.linalg.eigvalsh(blocks).max(axis=-1) <= WIDEST_PREDICTION**2
    if not determined.any():
        raise too_little(machine, measurements)
    if not determined.all():
        keep = held.observed.copy()
        keep[held.observed] = determined
        return predict(machine, select(measurements, keep), start)

    # Leave-one-out poses, the errors at these, and the derivatives by the fixed machine.
    leave_one_out = _leave_one_out(held, linear, reduced, picks.mT @ alone @ picks)
    by = _by_machine(held, own, shared[: n * n_rows]).reshape(n, n_rows, -1)
    joints = measurements.joints[held.observed]
    errors = _errors(
        held.machine, joints, leave_one_out.T_base_platform[0], leave_one_out.internal[0]
    )
    # to first order at poses that the fixed machine does not reach
    first_order = (units @ picks @ linear.value[0, ..., None])[..., 0]
    residuals = np.where(np.isfinite(errors.residuals), errors.residuals, first_order)
    return Prediction(
        machine=held.machine,
        observed=held.observed,
        T_base_platform=_among_all(leave_one_out.T_base_platform[0], held.observed),
        errors=ReadingErrors(
            _among_all(residuals, held.observed),
            _among_all(errors.position, held.observed),
            _among_all(errors.orientation, held.observed),
        ),
        noise=noise,
        by_machine=(units @ picks @ by).reshape(n * m, -1),
    )


def _softly_held(machine: Machine, measurements: Measurements, near: State) -> tuple[float, Held]:
    """The largest of SOFT_READING_NOISES with which the search ends, and its fit."""
    softer = [noise for noise in SOFT_READING_NOISES if noise > measurements.joint_noise]
    for soft in softer or [measurements.joint_noise]:
        held = hold(machine, replace(measurements, joint_noise=soft), near)
        if held.stop is Stop.CONVERGED:
            return soft, held
    raise not_converged(Stop.STEPS)


def _reading_selector(held: Held, n_rows: int) -> Array:
    """E (K', m, r): selects the rows of readings among those of a configuration."""
    problem, state = held.problem, held.state
    n_poses, n_equations = state.T_base_platform.shape[1], problem.layout.n_equations
    columns = [
        problem.joint_rows(np.broadcast_to(row, (1, n_poses, n_equations)), state)[0]
        for row in np.eye(n_equations)
    ]
    out = np.zeros((n_poses, problem.layout.n_readings, n_rows))
    out[..., problem.closure_rows] = np.stack(columns, axis=-1)
    return out


def _reading_per_sigma(held: Held, soft: float) -> Array:
    """Reading (K', m) that corresponds to one standard deviation of its row, m or rad, with its
    sign; soft : standard deviation of readings in the rows.
    """
    layout, c = held.problem.layout, held.problem.closure(held.state)
    by_reading = c.by_reading[0]
    slope = np.sqrt(by_reading**2 @ layout.of_motor)
    sign = 1.0 if layout.shares_motors else np.sign(by_reading @ layout.of_motor)
    return sign * np.hypot(PERFECT_CLOSURE_SIGMA, soft * slope) / slope


def _leave_one_out(held: Held, linear: Linear, reduced: Reduced, alone: Array) -> BatchState:
    """Poses of leave-one-out fits, each without the configuration's own readings.

    alone : E^T L^-1 E (K', r, r). ``R^-1 Q^T (1 - A N^+ S^T) alone y`` is the change of the own
    unknowns when the readings are moved to the values that the others predict; S are the rows A of
    the shared unknowns with own ones eliminated, and N their normal matrix, in which unidentifiable
    directions count as exact.
    """
    half = inverse_root(rows_on_shared(linear, reduced)[0][0], RANK_TOLERANCE, loose=False)
    moved = alone @ linear.value[0, ..., None]
    others = half @ (half.T @ (reduced.rows[0].mT @ moved))
    own = reduced.q[0].mT @ (moved - linear.by_shared[0] @ others)
    own = np.linalg.solve(reduced.r[0], own)[..., 0]
    shared = np.zeros((1, held.problem.unknowns.count))
    return held.problem.retract(held.state, shared, own[None])


def _by_machine(held: Held, own: Array, shared: Array) -> Array:
    """P A (K' r, P) for all fixed parameters; own : Q (K', r, d), shared : q (K' r, a)."""
    wide, there = held.problem.opened(held.state)
    by = wide.linearize(there).by_shared[0, ..., wide.unknowns.machine]
    by = np.where(np.any(held.problem.free != 0, axis=1), 0.0, by)
    by = (by - own @ (own.mT @ by)).reshape(len(shared), -1)
    return by - shared @ (shared.T @ by)


def _noise(along: Array, beside: Array, units: Array, less: float) -> Array:
    """Covariance (K' m, K' m) of the residuals ``units E P y`` by noise.

    along : D (K', m, m), projection of the readings' rows onto their own unknowns. beside : F (K',
    m, a), onto the shared ones: ``H = E P E^T = 1 - D - F F^T``. Rows have unit variance, but
    readings have less than their softness, by the share ``less`` of its variance: the
    covariance of E P y is ``H - less H H``, in a form without differences of nearly equal numbers.
    """
    n, m = along.shape[:2]
    # Blocks of each configuration, and the low-rank part that all share.
    block = (np.eye(m) - along) @ ((1 - less) * np.eye(m) + less * along)
    flat = beside.reshape(n * m, -1)
    inner = less * (np.eye(flat.shape[1]) - flat.T @ flat) - (1 - less) * np.eye(flat.shape[1])
    far = (units @ along @ beside).reshape(n * m, -1)
    flat = (units @ beside).reshape(n * m, -1)
    out = flat @ inner @ flat.T - less * (far @ flat.T + flat @ far.T)
    k = np.arange(n)
    out.reshape(n, m, n, m)[k, :, k, :] += units @ block @ units.mT
    return 0.5 * (out + out.T)


def _errors(machine: Machine, joints: Array, poses: Array, internal: Array) -> ReadingErrors:
    """Errors of a machine at observed poses T_base_platform (n, 4, 4) in its own frames."""
    fk = forward(machine.layout, machine.values, joints, poses, internal)
    off = np.full((len(poses), 6), np.nan)
    ok = fk.converged
    off[ok] = pose_difference(poses[ok], fk.T_base_platform[ok])
    return ReadingErrors(
        joints - machine.inverse(poses),
        np.linalg.norm(off[:, 3:], axis=1),
        np.linalg.norm(off[:, :3], axis=1),
    )


def _among_all(values: Array, visible: Booleans) -> Array:
    """Values (K', ...) of the observed configurations among all (K, ...), NaN elsewhere."""
    out = np.full((len(visible), *values.shape[1:]), np.nan)
    out[visible] = values
    return out


def errors_on(machine: Machine, joints: Array, poses: Array) -> ReadingErrors:
    """Errors of a machine at observed poses T_base_platform (n, 4, 4) in another machine's frames.

    joints : (n, m). The frames of base and platform, which are conventions, are registered for the
    best agreement of the readings. The errors are corrected for the degrees of freedom of this
    registration, so that few configurations do not make a machine look better.
    """
    e, f, used = closing_frame_changes(machine, joints, poses)
    own = e @ poses @ inverse(f)
    readings, internal = inverse_result(machine.layout, machine.values, own)
    fk = forward(machine.layout, machine.values, joints, own, internal)
    off = np.full((len(poses), 6), np.nan)
    ok = fk.converged
    off[ok] = pose_difference(inverse(e) @ fk.T_base_platform[ok] @ f, poses[ok])
    more = np.sqrt(joints.size / max(joints.size - used, 1))
    return ReadingErrors(
        (joints - readings) * more,
        np.linalg.norm(off[:, 3:], axis=1) * more,
        np.linalg.norm(off[:, :3], axis=1) * more,
    )


def closing_frame_changes(
    machine: Machine, joints: Array, poses: Array
) -> tuple[Array, Array, int]:
    """Frame changes E, F (4, 4) after which E X F^-1 closes the machine best at the readings, and
    the number of their components that the readings determine.

    Gauss-Newton on the closure, with the directions of hinges eliminated; unobservable components
    are zero.
    """
    e, f = np.eye(4), np.eye(4)
    used = 0
    for _ in range(FRAME_LAYING_STEPS):
        own = e @ poses @ inverse(f)
        internal = inverse_result(machine.layout, machine.values, own)[1]
        c = closure(machine.layout, machine.values, joints, own, np.nan_to_num(internal))
        # Linearized closure by both frame changes.
        jac, value = c.rows.by_pose @ pose_generators(own), c.rows.value
        if machine.layout.n_internal:
            # eliminate the hinges
            q = np.linalg.qr(c.rows.by_internal)[0]
            rest = np.eye(q.shape[-2]) - q @ q.mT
            jac, value = rest @ jac, (rest @ value[..., None])[..., 0]
        y, _, rank, _ = np.linalg.lstsq(jac.reshape(-1, 12), -value.reshape(-1), rcond=ROUNDING)
        used = int(rank)
        e, f = perturb(np.eye(4), y[:6]) @ e, perturb(np.eye(4), y[6:]) @ f
        if np.abs(y).max() < FRAMES_LAID_CHANGE:
            break
    return e, f, used
