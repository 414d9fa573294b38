"""What a machine predicts of readings and tool points that photographs show.

Stations, boards' mounts and the platform's poses are estimated from the photographs, the machine
is held (:mod:`pkmcal.judge.fixed_machine`). Where photographs leave open where stations and boards
are (a board tells a pose in a camera that stands anywhere), readings of *other* configurations
tell: closures stand in the estimate with the soft deviation :data:`SOFT_READING_NOISE`, which gives
way to anything seen, and each configuration's own readings are then taken out again exactly, by
their leverage (leave-one-out).

With E the rows of readings and ``P = 1 - Q Q^T - q q^T`` the projector of
:mod:`pkmcal.judge.fixed_machine`, Q and q orthonormal bases of what a configuration's own unknowns
and the shared ones can explain, their residuals are ``E P y``. Of a reading's own error that leaves
the part ``L``, a configuration's block of ``E P E^T``: residuals of fits without their own readings
are ``L^-1 E P y``, to first order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import pose_generators
from pkmcal.identify.unknowns import BatchState
from pkmcal.judge.fixed_machine import Held, hold, too_little
from pkmcal.measurements import Measurements
from pkmcal.measurements.readings import PERFECT_CLOSURE_SIGMA
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.kinematics import forward, inverse_result
from pkmcal.solver.elimination import Linear, Reduced, eliminate, rows_on_shared
from pkmcal.solver.ranks import RANK_TOLERANCE, column_space, inverse_root

SOFT_READING_NOISE = 0.01
"""Deviation (m, rad) given to readings while stations and poses are sought: tens of times what a
photograph leaves open, so a seen pose hardly knows them."""
LEAST_REDUNDANCY_SHARE = 1e-2
"""Part of a reading's residual that its own fit leaves, below which hardly anything but the reading
told where the platform was: what was seen left ten times SOFT_READING_NOISE open."""
FRAME_LAYING_STEPS = 20
FRAMES_LAID_CHANGE = 1e-10
"""Frame change (m, rad) below which the frames are laid."""
UNREAD_FRAME_CHANGE_SHARE = 1e-9
"""Share of the largest singular value below which a frame change moves no reading."""


@dataclass(frozen=True)
class ReadingErrors:
    """Errors of n configurations.

    residuals : (n, m) readings measured less predicted, m or rad. position, orientation : (n,) of
    the tool point by the readings, m and rad; NaN where the machine cannot be closed.
    """

    residuals: Array
    position: Array
    orientation: Array

    def of(self, rows: Integers) -> ReadingErrors:
        """Those of some configurations."""
        return ReadingErrors(self.residuals[rows], self.position[rows], self.orientation[rows])


@dataclass(frozen=True)
class Prediction:
    """What a machine predicts of a session; values of configurations that were not seen are NaN.

    machine : as held, with the session's tube radii. observed : (K,) configurations whose pose was
    seen. T_base_platform : (K, 4, 4) seen, without the configuration's own readings. errors : (K,)
    of the readings that are predicted from it, and of the tool point.
    noise : (n, n) covariance of the residuals of the n = K' m seen readings by the photographs'
    and the readings' noise. by_machine : (n, P) their derivatives by the machine's parameters.
    """

    machine: Machine
    observed: Booleans
    T_base_platform: Array
    errors: ReadingErrors
    noise: Array
    by_machine: Array


def predict(machine: Machine, measurements: Measurements, start: State) -> Prediction:
    """What a machine predicts of readings and tool points, seen by measurements.

    start : stations, mounts and poses in frames near the machine's. Raises ResultError where they
    are not found, or where nothing but a configuration's own readings tells its pose.
    """
    if not measurements.n_stations:
        raise ResultError(
            "nothing but readings was measured, and readings are not predicted from themselves",
            expected="a session with photographs, or with a table of poses",
            next_step="To see whether the machine is as it was, use pkmcal watch with new readings",
        )
    # links tell the difference of two poses, not the pose at either's readings
    soft = replace(measurements, joint_noise=SOFT_READING_NOISE, links=())
    held = hold(machine, soft, start)
    linear = held.problem.linearize(held.state)
    reduced = eliminate(linear)
    own, shared = reduced.q[0], column_space(rows_on_shared(linear, reduced)[0][0])
    picks = _picks(held, linear.value.shape[-1])
    n, m, n_rows = picks.shape

    along = picks @ own
    along = along @ along.mT
    beside = picks @ shared[: n * n_rows].reshape(n, n_rows, -1)
    residual = np.eye(m) - along - beside @ beside.mT  # L
    if float(np.linalg.eigvalsh(residual).min(initial=1.0)) < LEAST_REDUNDANCY_SHARE:
        raise too_little(machine, measurements)
    alone = np.linalg.inv(residual)
    units = _size(held)[..., None] * alone

    value = _without_own(held, linear, reduced, picks.mT @ alone @ picks)
    by = _by_machine(held, own, shared[: n * n_rows]).reshape(n, n_rows, -1)
    joints = measurements.joints[held.observed]
    errors = _errors(held.machine, joints, value.T_base_platform[0], value.internal[0])
    return Prediction(
        machine=held.machine,
        observed=held.observed,
        T_base_platform=_among_all(value.T_base_platform[0], held.observed),
        errors=ReadingErrors(
            _among_all(errors.residuals, held.observed),
            _among_all(errors.position, held.observed),
            _among_all(errors.orientation, held.observed),
        ),
        noise=_noise(
            along, beside, units, 1 - (measurements.joint_noise / SOFT_READING_NOISE) ** 2
        ),
        by_machine=(units @ picks @ by).reshape(n * m, -1),
    )


def _picks(held: Held, n_rows: int) -> Array:
    """E (K', m, r): the rows of readings, one each, out of a configuration's."""
    problem, state = held.problem, held.state
    n_poses, n_equations = state.T_base_platform.shape[1], problem.layout.n_equations
    columns = [
        problem.joint_rows(np.broadcast_to(row, (1, n_poses, n_equations)), state)[0]
        for row in np.eye(n_equations)
    ]
    out = np.zeros((n_poses, problem.layout.n_readings, n_rows))
    out[..., problem.closure_rows] = np.stack(columns, axis=-1)
    return out


def _size(held: Held) -> Array:
    """Reading (K', m) that one standard deviation of its row is, m or rad, with its sign."""
    layout, c = held.problem.layout, held.problem.closure(held.state)
    by_reading = c.by_reading[0]
    slope = np.sqrt(by_reading**2 @ layout.of_motor)
    sign = 1.0 if layout.shares_motors else np.sign(by_reading @ layout.of_motor)
    return sign * np.hypot(PERFECT_CLOSURE_SIGMA, SOFT_READING_NOISE * slope) / slope


def _without_own(held: Held, linear: Linear, reduced: Reduced, alone: Array) -> BatchState:
    """The poses of fits without each configuration's own readings.

    alone : E^T L^-1 E (K', r, r). ``R^-1 Q^T (1 - A N^+ S^T) alone y`` is the answer to readings
    moved to where the others predict them; S, the rows A of the shared unknowns with own ones taken
    out, and N their normal matrix, in which open directions count as exact.
    """
    half = inverse_root(rows_on_shared(linear, reduced)[0][0], RANK_TOLERANCE, loose=False)
    shifted = alone @ linear.value[0, ..., None]
    others = half @ (half.T @ (reduced.rows[0].mT @ shifted))
    own = reduced.q[0].mT @ (shifted - linear.by_shared[0] @ others)
    own = np.linalg.solve(reduced.r[0], own)[..., 0]
    shared = np.zeros((1, held.problem.unknowns.count))
    return held.problem.retract(held.state, shared, own[None])


def _by_machine(held: Held, own: Array, shared: Array) -> Array:
    """P A (K' r, P) by all parameters that are held; own : Q (K', r, d), shared : q (K' r, a)."""
    wide, there = held.problem.opened(held.state)
    by = wide.linearize(there).by_shared[0, ..., wide.unknowns.machine]
    by = np.where(np.any(held.problem.free != 0, axis=1), 0.0, by)
    by = (by - own @ (own.mT @ by)).reshape(len(shared), -1)
    return by - shared @ (shared.T @ by)


def _noise(along: Array, beside: Array, units: Array, less: float) -> Array:
    """Covariance (K' m, K' m) of the residuals ``units E P y`` by noise.

    along : D (K', m, m), the readings' rows along their own unknowns; beside : F (K', m, a), along
    those of all: ``H = E P E^T = 1 - D - F F^T``. Rows have unit variance, but readings are sharper
    than SOFT_READING_NOISE by the share ``less`` of it: the covariance of E P y is ``H - less H
    H``, written without a difference of numbers that are nearly the same.
    """
    n, m = along.shape[:2]
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
    """Of a machine on seen poses T_base_platform (n, 4, 4) in its own frames."""
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
    """Values (K', ...) of the seen configurations among all, NaN elsewhere."""
    out = np.full((len(visible), *values.shape[1:]), np.nan)
    out[visible] = values
    return out


def errors_on(machine: Machine, joints: Array, poses: Array) -> ReadingErrors:
    """Errors of a machine on seen poses T_base_platform (n, 4, 4) in another machine's frames.

    joints : (n, m). The frames of base and platform, which are a convention, are laid so that the
    readings agree best. What that takes up is given back by the degrees of freedom, so few
    configurations flatter nobody.
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
    how many numbers of them the readings fix.

    Gauss-Newton on the closure, rows that hinges move left out; changes that it does not see are
    left alone.
    """
    e, f = np.eye(4), np.eye(4)
    used = 0
    for _ in range(FRAME_LAYING_STEPS):
        own = e @ poses @ inverse(f)
        internal = inverse_result(machine.layout, machine.values, own)[1]
        c = closure(machine.layout, machine.values, joints, own, np.nan_to_num(internal))
        jac, value = c.rows.by_pose @ pose_generators(own), c.rows.value
        if machine.layout.n_internal:
            q = np.linalg.qr(c.rows.by_internal)[0]
            rest = np.eye(q.shape[-2]) - q @ q.mT
            jac, value = rest @ jac, (rest @ value[..., None])[..., 0]
        y, _, rank, _ = np.linalg.lstsq(
            jac.reshape(-1, 12), -value.reshape(-1), rcond=UNREAD_FRAME_CHANGE_SHARE
        )
        used = int(rank)
        e, f = perturb(np.eye(4), y[:6]) @ e, perturb(np.eye(4), y[6:]) @ f
        if np.abs(y).max() < FRAMES_LAID_CHANGE:
            break
    return e, f, used
