"""[C] eq. 3 and 5 as one batched least-squares problem: the closure at measured poses.

Unknowns are the machine's free parameters, the stations' poses and the mounts' (and the hinges of
an articulated platform, each pose its own); platform poses are not, they are the measured ones. So
there is no forward kinematics. ``implicit`` takes the closure itself, eq. 5; ``joint`` the readings
less those that the inverse kinematics wants, eq. 3. A fixed matrix per pose weighs the rows: as
printed, equally; whitened, by what the measured pose's and the reading's noise make of them, what
the machine cannot move (the two tilts of an H4) included. Any machine with a closure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import inverse, perturb
from pkmcal.identify.measured_platform import Seen, Taken, seen_platform, taken
from pkmcal.mechanisms import kinematics
from pkmcal.mechanisms.closure import Closure, LimbLayout, closure, dense
from pkmcal.solver import Linear, Values, of_runs, transposed

Form = Literal["joint", "implicit"]
PRINTED = 1e-4
"""Metres (and radians) that count as one standard deviation where rows are not whitened; it only
sets where the search stops."""
PERFECT = 1e-6
"""Standard deviation (m) of a closure whatever the noise: joints without play."""


class ImplicitState(NamedTuple):
    """Unknowns of B runs: z (B, nz), T_camera_base (B, S, 4, 4), T_mount (B, M, 4, 4), internal
    (B, N, n).
    """

    z: Array
    T_camera_base: Array
    T_mount: Array
    internal: Array


class _Rows(NamedTuple):
    """Rows (B, N, r) without weights: closures, then what is off."""

    value: Array
    seen: Seen
    taken: Taken
    closure: Closure
    scale: Array


@dataclass(frozen=True)
class ImplicitProblem:
    """solver.LeastSquares of B runs with N poses each. Stations' unknowns perturb T_base_camera.

    layout, drawing (P,), free (P, nz) : the machine. station, mount : (N,). T_camera_board
    (B, N, 4, 4) and readings (B, N, m). form : see the module. weigh : (B, N, r, r) of the rows,
    fixed while the search runs. prior : (c, nz) rows on z. keep : (na,) False for what is held.
    """

    layout: LimbLayout
    drawing: Array
    free: Array
    station: Integers
    mount: Integers
    T_camera_board: Array
    readings: Array
    form: Form
    weigh: Array
    prior: Array
    keep: Booleans

    def theta(self, state: ImplicitState) -> Array:
        """Machine parameters (B, P)."""
        return self.drawing + state.z @ self.free.T

    def residuals(self, state: ImplicitState) -> Values:
        """Weighted rows; NaN where the inverse kinematics has no answer."""
        value = (self.weigh @ self._rows(state).value[..., None])[..., 0]
        return Values(value, state.z @ self.prior.T)

    def linearize(self, state: ImplicitState) -> Linear:
        """Weighted rows and exact Jacobian."""
        rows = self._rows(state)
        value = (self.weigh @ rows.value[..., None])[..., 0]
        by_shared = self.weigh @ self.by_shared(state, rows)
        by_own = self.weigh @ self._by_own(rows)
        usable = np.isfinite(value)
        return Linear(
            np.where(usable, value, 0.0),
            np.where(usable[..., None], by_shared, 0.0),
            np.where(usable[..., None], by_own, 0.0),
            usable,
            state.z @ self.prior.T,
            np.pad(self.prior, ((0, 0), (0, self.keep.size - self.free.shape[1]))),
        )

    def by_shared(self, state: ImplicitState, rows: _Rows) -> Array:
        """Rows by z, stations and mounts, (B, N, r, na); zero for what is held."""
        own = self.by_pose(rows)
        n_stations, n_mounts = state.T_camera_base.shape[1], state.T_mount.shape[1]
        machine = rows.scale[..., None] * (dense(rows.closure, self.drawing.size) @ self.free)
        off = np.zeros((*machine.shape[:2], rows.taken.off.shape[-1], machine.shape[-1]))
        parts = [
            np.concatenate([machine, off], axis=-2),
            _placed(own @ rows.seen.by_station, self.station, n_stations),
            _placed(own @ rows.seen.by_mount, self.mount, n_mounts),
        ]
        return np.concatenate(parts, axis=-1) * self.keep

    def by_pose(self, rows: _Rows) -> Array:
        """Rows by the platform's whole pose, (B, N, r, 6)."""
        closures = rows.scale[..., None] * (rows.closure.by_pose @ rows.taken.by)
        return np.concatenate([closures, rows.taken.off_by], axis=-2)

    def _by_own(self, rows: _Rows) -> Array:
        hinges = rows.scale[..., None] * rows.closure.by_internal
        off = np.zeros((*hinges.shape[:2], rows.taken.off.shape[-1], hinges.shape[-1]))
        return np.concatenate([hinges, off], axis=-2)

    def _rows(self, state: ImplicitState) -> _Rows:
        theta = self.theta(state)[:, None]
        seen = seen_platform(
            state.T_camera_base[:, self.station], self.T_camera_board, state.T_mount[:, self.mount]
        )
        own = taken(self.layout.motion, seen.pose)
        internal = state.internal if self.layout.n_internal else None
        readings = self.readings
        if self.form == "joint":
            readings = kinematics.inverse(self.layout, theta, own.pose)
        c = closure(self.layout, theta, readings, own.pose, internal)
        scale = np.ones(c.value.shape)
        value = c.value
        if self.form == "joint":
            motor = self.layout.row_motor
            read = motor >= 0
            # r = measured - wanted, and the closure stays zero: dr = dc / (dc/dq)
            scale = np.where(read, 1 / np.where(read, c.by_reading, 1.0), 1.0)
            value = np.where(read, (self.readings - readings)[..., np.maximum(motor, 0)], value)
        return _Rows(np.concatenate([value, own.off], axis=-1), seen, own, c, scale)

    def whitening(self, state: ImplicitState, noise: Array, joint_noise: float) -> Array:
        """Matrices (B, N, r, r) that whiten the rows at a state.

        noise : (N, 6, 6) covariance of the measured poses. The rows' covariance is theirs and the
        reading's, carried through the rows' derivatives.
        """
        rows = self._rows(state)
        by = self.by_pose(rows) @ rows.seen.by_measured
        covariance = by @ noise @ transposed(by)
        motors = self.layout.row_motor[:, None] == np.arange(self.layout.n_readings)
        slope = (rows.scale * rows.closure.by_reading)[..., None] * motors
        e = slope.shape[-2]
        covariance[..., :e, :e] += joint_noise**2 * (slope @ transposed(slope))
        covariance[..., :e, :e] += PERFECT**2 * np.eye(e) * rows.scale[..., None] ** 2
        return np.linalg.inv(np.linalg.cholesky(covariance))

    def platform_poses(self, state: ImplicitState) -> Array:
        """The measured poses (B, N, 4, 4) as the machine can take them."""
        return self._rows(state).taken.pose

    def ideal(self, state: ImplicitState) -> ImplicitProblem:
        """The same problem with poses and readings that the state explains without any residual.

        Ranks are told there: at the data, noise makes what cannot be told look faintly known.
        """
        poses = self.platform_poses(state)
        readings = kinematics.inverse(self.layout, self.theta(state)[:, None], poses)
        readings = np.where(np.isfinite(readings), readings, self.readings)
        seen = state.T_camera_base[:, self.station] @ poses @ state.T_mount[:, self.mount]
        return replace(self, T_camera_board=seen, readings=readings)

    def plain(self) -> Array:
        """The matrix (1, 1, r, r) of rows that count alike, and not at all where they are off."""
        off = 6 - self.layout.motion.shape[1]
        return np.diag(np.repeat([1 / PRINTED, 0.0], [self.layout.n_equations, off]))[None, None]

    def moved(self, state: ImplicitState, shared: Array, own: Array) -> ImplicitState:
        """The state after a step."""
        shared = shared * self.keep
        nz, s, m = self.free.shape[1], state.T_camera_base.shape[1], state.T_mount.shape[1]
        camera = shared[:, nz : nz + 6 * s].reshape(-1, s, 6)
        mount = shared[:, nz + 6 * s :].reshape(-1, m, 6)
        return ImplicitState(
            state.z + shared[:, :nz],
            inverse(perturb(inverse(state.T_camera_base), camera)),
            perturb(state.T_mount, mount),
            state.internal + own,
        )

    def select(self, runs: Integers) -> ImplicitProblem:
        """Some runs only."""
        poses, readings = self.T_camera_board[runs], self.readings[runs]
        return replace(
            self, T_camera_board=poses, readings=readings, weigh=of_runs(self.weigh, runs)
        )


def _placed(values: Array, index: Integers, n: int) -> Array:
    """Columns (B, N, r, 6) moved to the place of their index (N,) among n: (B, N, r, 6 n)."""
    out = np.zeros((*values.shape[:-1], n, 6))
    place = index[None, :, None, None, None]
    np.put_along_axis(out, place, values[..., None, :], axis=-2)
    return out.reshape(*values.shape[:-1], 6 * n)
