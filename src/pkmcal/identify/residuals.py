"""Residuals of the joint estimate and their exact Jacobians, all in standard deviations.

Rows of a configuration are its edges, two each, then its limbs' closures, then its boards' poses
(:mod:`pkmcal.identify.rows`), six each:

- edge: ``L^-1 (basis^T n_predicted + shift * s)`` with L the Cholesky factor of the edge's
  covariance. The measured normal is the true one moved by ``basis @ (shift * s)`` when all
  edge points lie s px outward, and ``basis^T n_measured = 0``; hence the plus sign.
- closure: ``c / (|dc/dq| sigma_q)``, [B] eq. 4, [C] eq. 5 whitened; what no reading enters (rods
  of constant length, joints' axes) is taken as perfect and held to
  :data:`pkmcal.identify.rows.PERFECT`.

Rows on shared unknowns: ``(theta - drawing) / tolerance``, the edge shift's prior, the gauge.

"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import skew
from pkmcal.identify.rows import (
    Blocks,
    Data,
    PoseBlocks,
    PoseData,
    PoseRows,
    by_noise,
    joint_rows,
    no_poses,
    pose_rows,
)
from pkmcal.identify.steps import moved
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms.closure import Closure, LimbLayout, closure
from pkmcal.solver import Linear, Values, of_runs

SHADING_SIGMA = 0.03
"""Standard deviation (px) of what shading adds to all edges of one side of a tube at one station,
before any data. Path-traced photographs of a known machine show 0.02 (and are best fitted without
it), our own renderer's 0.05; with 0.03 the deviations are right for both, at 3 to 5 % of their
size."""
SHIFT_SIGMA = 0.3
"""Standard deviation (px) of a camera's constant edge shift before any data: errata, B."""


class Ends(NamedTuple):
    """Predicted normals of the blocks and what their derivatives need."""

    n: Array
    by_a: Array
    by_b: Array
    by_radius: Array
    a_camera: Array
    b_camera: Array


@dataclass(frozen=True)
class Problem:
    """The joint estimation as a least-squares problem (solver.LeastSquares).

    layout, drawing (P,), free (P, nz) : the machine. blocks, data : the measurements.
    joint_noise : standard deviation of a reading.
    prior : (c, na) rows on the shared unknowns (z, stations, optics) and prior_target : (c,).
    frames : (12 + n, g) frame changes and others that the model allows. pose_blocks, pose_data : of
    boards. n_lines : tubes' sides at stations with a shading of their own.
    """

    layout: LimbLayout
    drawing: Array
    free: Array
    blocks: Blocks
    data: Data
    joint_noise: float
    n_stations: int
    n_cameras: int
    prior: Array
    prior_target: Array
    frames: Array
    pose_blocks: PoseBlocks = field(default_factory=no_poses)
    pose_data: PoseData = field(default_factory=PoseData)
    n_lines: int = 0

    @property
    def n_shared(self) -> int:
        """Number of shared unknowns."""
        return self.mounts_at + 6 * self.pose_blocks.n_mounts

    @property
    def mounts_at(self) -> int:
        """Where the mounts' unknowns begin: after z, stations, optics and shading."""
        return self.lines_at + self.n_lines

    @property
    def lines_at(self) -> int:
        """Where the lines' shading begins: after z, stations and optics."""
        return self.free.shape[1] + 6 * self.n_stations + self.n_cameras * self.n_optics

    @property
    def n_optics(self) -> int:
        """Number of unknowns of a camera."""
        return self.data.optics.shape[-1]

    @property
    def n_edge_rows(self) -> int:
        """Rows of a configuration that belong to edges; they come first."""
        return self.blocks.side.size // self.blocks.side.shape[0] * 2

    @property
    def closure_rows(self) -> slice:
        """Rows of a configuration that are the closure's."""
        return slice(self.n_edge_rows, self.n_edge_rows + self.layout.n_equations)

    @property
    def pose_rows(self) -> slice:
        """Rows of a configuration that are boards' poses; they come last."""
        return slice(self.closure_rows.stop, None)

    def theta(self, state: BatchState) -> Array:
        """Machine parameters (B, P)."""
        return self.drawing + state.z @ self.free.T

    def residuals(self, state: BatchState) -> Values:
        """Residuals; NaN where a leg passes through the camera."""
        c = self.closure(state)
        edges = self._normals(state, c.ends.a, c.ends.b)
        rows = [self._edge_rows(state, edges.n), self._closure_rows(c)]
        if self.pose_blocks.count:
            value = self._poses(state).value
            rows.append(value.reshape(*value.shape[:2], -1))
        return Values(np.concatenate(rows, axis=-1), self._prior_rows(state))

    def linearize(self, state: BatchState) -> Linear:
        """Residuals and exact Jacobian."""
        c = self.closure(state)
        edges = self._normals(state, c.ends.a, c.ends.b)
        by_a, by_b = self._project(edges.by_a), self._project(edges.by_b)
        value = [self._edge_rows(state, edges.n), self._closure_rows(c)]
        by_shared = [self._edge_by_shared(state, c, edges, by_a, by_b), self._closure_by_shared(c)]
        by_own = [self._by_own(state, c, by_b)]
        if self.pose_blocks.count:
            poses = self._poses(state)
            value.append(poses.value.reshape(*poses.value.shape[:2], -1))
            by_shared.append(self._pose_by_shared(poses))
            own = self._to_own(poses.by_own)
            by_own.append(own.reshape(*own.shape[:2], -1, own.shape[-1]))
        return self._linear(
            state,
            np.concatenate(value, axis=-1),
            np.concatenate(by_shared, axis=-2),
            np.concatenate(by_own, axis=-2),
        )

    def _linear(self, state: BatchState, value: Array, by_shared: Array, by_own: Array) -> Linear:
        """The rows with what cannot be predicted, or is not there, put to zero."""
        # padding may lie anywhere, so its derivatives need not be finite though its row is zero
        usable = np.isfinite(value) & self._rows_in_use(value.shape)
        lost = ~np.isfinite(value + by_shared.sum(axis=-1))
        return Linear(
            np.where(usable, value, 0.0),
            np.where(lost[..., None], 0.0, by_shared),
            np.where(lost[..., None], 0.0, by_own),
            usable,
            self._prior_rows(state),
            self.prior,
        )

    def moved(self, state: BatchState, shared: Array, own: Array) -> BatchState:
        """The state after a step; see :mod:`pkmcal.identify.steps`."""
        return moved(self, state, shared, own)

    def select(self, runs: Integers) -> Problem:
        """The problem of some runs only."""
        return replace(
            self,
            data=of_runs(self.data, runs),
            pose_data=of_runs(self.pose_data, runs),
        )

    def weighted(self, weight: Array, poses: Array | None = None) -> Problem:
        """The same problem with other weights of the edges' blocks, and of the boards' poses where
        given, (B, K, G) each.
        """
        changed = replace(self, data=replace(self.data, weight=weight))
        if poses is None:
            return changed
        return replace(changed, pose_data=replace(self.pose_data, weight=poses))

    def block_residuals(self, state: BatchState) -> Array:
        """Whitened residuals of the blocks without their weights, (B, K, G, 2g)."""
        plain = self.weighted(self.blocks.present[None].astype(float))
        c = plain.closure(state)
        n = plain._normals(state, c.ends.a, c.ends.b).n
        return plain._edge_rows(state, n).reshape(*n.shape[:3], 2 * self.blocks.side.shape[-1])

    def pose_residuals(self, state: BatchState) -> Array:
        """Whitened errors of the measured boards' poses without their weights, (B, K, G, 6)."""
        present = self.pose_blocks.present[None].astype(float)
        return self.weighted(self.data.weight, present)._poses(state).value

    def _poses(self, state: BatchState) -> PoseRows:
        return pose_rows(
            self.pose_blocks,
            self.pose_data,
            state.T_camera_base,
            state.T_base_platform,
            state.T_mount,
            state.optics,
        )

    def _pose_by_shared(self, rows: PoseRows) -> Array:
        """Rows of boards' poses by the shared unknowns, (B, K, 6G, na)."""
        shape = rows.by_station.shape[:-1]
        optics = np.broadcast_to(rows.by_optics, (*shape, self.n_optics))
        parts = [
            np.zeros((*shape, self.free.shape[1])),
            _one_hot(rows.by_station, self.pose_blocks.station, self.n_stations),
            _one_hot(optics, self.pose_blocks.camera, self.n_cameras),
            np.zeros((*shape, self.n_lines)),
            _one_hot(rows.by_mount, self.pose_blocks.mount, self.pose_blocks.n_mounts),
        ]
        out = np.concatenate(parts, axis=-1)
        return out.reshape(*out.shape[:2], -1, out.shape[-1])

    def closure(self, state: BatchState) -> Closure:
        """The closure of all runs and configurations, (B, K, E)."""
        theta = self.theta(state)[:, None, :]
        internal = state.internal if self.layout.n_internal else None
        return closure(self.layout, theta, self.data.joints, state.T_base_platform, internal)

    def _prior_rows(self, state: BatchState) -> Array:
        return self.prior_values(state) - self.prior_target

    def prior_values(self, state: BatchState) -> Array:
        """What the prior's rows (B, c) come to, before their targets are taken off."""
        nz = self.free.shape[1]
        x = np.zeros((state.z.shape[0], self.n_shared))
        x[:, :nz] = state.z
        x[:, nz + 6 * self.n_stations : self.lines_at] = state.optics.reshape(len(x), -1)
        x[:, self.lines_at : self.mounts_at] = state.shading
        mounts = x[:, self.mounts_at :].reshape(len(x), -1, 6)  # of which only places are known
        mounts[..., 3:] = state.T_mount[..., :3, 3]
        return x @ self.prior.T

    def _normals(self, state: BatchState, a: Array, b: Array) -> Ends:
        """Predicted normals in the camera frames, [B] eq. 3; last axes (K, G, g)."""
        k = np.arange(self.blocks.leg.shape[0])[:, None]
        transform = state.T_camera_base[:, self.blocks.station]
        rot, t = transform[..., :3, :3], transform[..., :3, 3]
        a_c, b_c = ((rot @ p[:, k, self.blocks.leg, :, None])[..., 0] + t for p in (a, b))
        radius = self.theta(state)[:, self.blocks.radius]
        e = edge_normal_jacobians(
            a_c[..., None, :], b_c[..., None, :], radius[..., None], self.blocks.side
        )
        return Ends(e.n, e.dn_da, e.dn_db, e.dn_dradius, a_c, b_c)

    def _project(self, vectors: Array) -> Array:
        """basis^T v, whitened and weighted: (B, K, G, g, 3, n) -> (B, K, G, 2g, n)."""
        flat = np.swapaxes(self.data.basis, -1, -2) @ vectors
        flat = flat.reshape(*flat.shape[:3], 2 * flat.shape[3], flat.shape[-1])
        return np.sqrt(self.data.weight)[..., None, None] * (self.data.whiten @ flat)

    def _optics_columns(self) -> Array:
        """Edge rows by their camera's unknowns, (B, K, G, 2g, w)."""
        return np.sqrt(self.data.weight)[..., None, None] * (self.data.whiten @ self.data.optics)

    def _edge_rows(self, state: BatchState, n: Array) -> Array:
        optics = state.optics[:, self.blocks.camera, :, None]
        columns = self._optics_columns()
        rows = (self._project(n[..., None]) + columns @ optics)[..., 0]
        if self.n_lines:  # a line's shading moves its edges as the camera's shift moves all
            rows = rows + columns[..., 0] * state.shading[:, self.blocks.line, None]
        unused = np.broadcast_to((self.data.weight == 0)[..., None], rows.shape)
        return np.where(unused, 0.0, rows).reshape(*rows.shape[:2], self.n_edge_rows)

    def _rows_in_use(self, shape: tuple[int, ...]) -> Booleans:
        """Rows that are not padding and not weighted away, (B, K, r)."""
        edges = np.repeat(self.data.weight > 0, self.data.whiten.shape[-1], axis=-1)
        used = np.ones(shape, dtype=bool)
        used[..., : edges.shape[-1]] = edges
        if self.pose_blocks.count:
            used[..., self.pose_rows] = np.repeat(self.pose_data.weight > 0, 6, axis=-1)
        return used

    def _closure_rows(self, c: Closure) -> Array:
        return self._by_noise(c, c.value[..., None])[..., 0]

    def _by_noise(self, c: Closure, rows: Array) -> Array:
        """Rows (B, K, E, n) of the closure in standard deviations."""
        return by_noise(self.layout, self.joint_noise, c.by_reading, rows)

    def joint_rows(self, c_rows: Array, state: BatchState) -> Array:
        """Whitened closure rows (B, K, E) as one a reading, (B, K, m)."""
        return joint_rows(self.layout, self.closure(state).by_reading, c_rows)

    def _edge_by_shared(
        self, state: BatchState, c: Closure, e: Ends, by_a: Array, by_b: Array
    ) -> Array:
        """Edge rows by the shared unknowns, (B, K, 2gG, na)."""
        transform = state.T_camera_base[:, self.blocks.station]
        rot, t = transform[..., :3, :3], transform[..., :3, 3]
        by_turn = -by_a @ skew(e.a_camera - t) - by_b @ skew(e.b_camera - t)
        by_station = np.concatenate([by_turn, by_a + by_b], axis=-1)
        legs, k = self.blocks.leg, np.arange(len(self.blocks.leg))[:, None]
        machine = self._to_free(
            [
                (c.ends.a_index[legs], by_a @ (rot @ c.ends.a_by[:, k, legs])),
                (c.ends.b_index[legs], by_b @ (rot @ c.ends.b_by[:, k, legs])),
                (self.blocks.radius[..., None], self._project(e.by_radius[..., None])),
            ]
        )
        optics = self._optics_columns()
        optics = np.broadcast_to(optics, (*by_station.shape[:-1], optics.shape[-1]))
        parts = [
            machine,
            _one_hot(by_station, self.blocks.station, self.n_stations),
            _one_hot(optics, self.blocks.camera, self.n_cameras),
        ]
        if self.n_lines:
            parts.append(_one_hot(optics[..., :1], self.blocks.line, self.n_lines))
        parts.append(np.zeros((*by_station.shape[:-1], 6 * self.pose_blocks.n_mounts)))
        out = np.concatenate(parts, axis=-1)
        return out.reshape(*out.shape[:2], out.shape[2] * out.shape[3], out.shape[-1])

    def _by_own(self, state: BatchState, c: Closure, by_b: Array) -> Array:
        """Edge and closure rows by the platform's motion, (B, K, r, d)."""
        rot = state.T_camera_base[:, self.blocks.station, :3, :3]
        legs, k = self.blocks.leg, np.arange(len(self.blocks.leg))[:, None]
        by_own = self._to_own(c.ends.b_by_pose, c.ends.b_by_internal)
        edges = by_b @ (rot @ by_own[:, k, legs])
        edges = edges.reshape(*edges.shape[:2], self.n_edge_rows, edges.shape[-1])
        return np.concatenate([edges, self._by_noise(c, self.layout.by_own(c))], axis=-2)

    def _to_own(self, by_pose: Array, by_internal: Array | None = None) -> Array:
        """Derivatives (..., 6) by the pose, and (..., n) by what is internal, as those by the
        configuration's own unknowns, (..., d + n).
        """
        out = by_pose @ self.layout.motion
        if not self.layout.n_internal:
            return out
        if by_internal is None:
            by_internal = np.zeros((*out.shape[:-1], self.layout.n_internal))
        return np.concatenate([out, by_internal], axis=-1)

    def _closure_by_shared(self, c: Closure) -> Array:
        """Closure rows by the shared unknowns, (B, K, E, na)."""
        free = self._to_free([(c.index[None], c.by_theta[..., None, :])])[..., 0, :]
        free = self._by_noise(c, free)
        rest = np.zeros((*free.shape[:-1], self.n_shared - free.shape[-1]))
        return np.concatenate([free, rest], axis=-1)

    def _to_free(self, parts: list[tuple[Integers, Array]]) -> Array:
        """Derivatives by machine parameters put into the free unknowns' columns.

        parts : positions (K or 1, G, n) and derivatives (B, K, G, rows, n).
        """
        shape = np.broadcast_shapes(*(values.shape[:-1] for _, values in parts))
        n = self.drawing.size
        full = np.zeros((*shape, n + 1))  # the last column takes what is no parameter's
        for index, values in parts:
            np.put_along_axis(full, index[None, :, :, None, :], values, axis=-1)
        if self.choice is not None:  # no ties, no axes: a choice of columns, far cheaper
            return full[..., self.choice]
        return full[..., :n] @ self.free

    @cached_property
    def choice(self) -> Integers | None:
        """The parameter of each free unknown where each moves one parameter alone."""
        alone = np.all((self.free != 0).sum(axis=0) == 1) and np.all(self.free.sum(axis=0) == 1)
        return np.argmax(self.free, axis=0) if alone else None


def _one_hot(values: Array, index: Integers, n: int) -> Array:
    """Columns (B, K, G, rows, w) moved to the place of their index (K, G): (..., n w)."""
    out = np.zeros((*values.shape[:-1], n, values.shape[-1]))
    place = index[None, :, :, None, None, None]
    np.put_along_axis(out, place, values[..., None, :], axis=-2)
    return out.reshape(*values.shape[:-1], n * values.shape[-1])
