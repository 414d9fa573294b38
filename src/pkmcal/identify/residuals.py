"""Residuals of the joint estimate and their exact Jacobians, all in standard deviations.

Rows of a configuration are its edges, two each, then its limbs' closures, one each:

- edge: ``L^-1 (basis^T n_predicted + shift * s)`` with L the Cholesky factor of the edge's
  covariance. The measured normal is the true one moved by ``basis @ (shift * s)`` when all
  edge points lie s px outward, and ``basis^T n_measured = 0``; hence the plus sign.
- closure: ``c / (|dc/dq| sigma_q)``, [B] eq. 4; rods of constant length are held as sharply.

Rows on shared unknowns: ``(theta - drawing) / tolerance``, the edge shift's prior, the gauge.

Edges that share their noise are whitened together: a *block* is g edges (g = 1 for edges
fitted in photographs, g = 2 for the two edges that stand for a measured axis, [A] Table 1)
of one tube at one station, with one 2g x 2g whitening matrix and one robust weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import inverse, perturb, skew
from pkmcal.identify.gauge import (
    generators,
    moved_centres,
    pose_generators,
    station_generators,
)
from pkmcal.identify.solver import Linear, Values
from pkmcal.mechanisms.limbs import Closure, LimbLayout, closure

SHIFT_SIGMA = 0.3
"""Standard deviation (px) of a camera's constant edge shift before any data: errata, B."""


@dataclass(frozen=True)
class Blocks:
    """Where the edges are: K configurations of G blocks, padded; the same for all runs.

    leg, station, camera, radius : (K, G) leg, station, camera, position of the tube's radius.
    side : (K, G, g). present : (K, G) False for padding.
    """

    leg: Integers
    station: Integers
    camera: Integers
    radius: Integers
    side: Integers
    present: Booleans


@dataclass(frozen=True)
class Data:
    """Numbers measured in each run; leading axis B, or 1 where all runs share them.

    basis : (B, K, G, g, 3, 2). whiten : (B, K, G, 2g, 2g). optics : (B, K, G, 2g, w) change of
    the measured normals, less the predicted ones', by the w unknowns of their camera: the edge
    shift (px), then its intrinsics where they are refined (in units of their prior).
    joints : (B, K, m). weight : (B, K, G) of the blocks, 0..1 over the noise scale squared.
    """

    basis: Array
    whiten: Array
    optics: Array
    joints: Array
    weight: Array


@dataclass(frozen=True)
class BatchState:
    """Unknowns of B runs: z (B, nz) free parameters, T_camera_base (B, S, 4, 4),
    T_base_platform (B, K, 4, 4), optics (B, C, w).
    """

    z: Array
    T_camera_base: Array
    T_base_platform: Array
    optics: Array


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
    frames : (12, g) frame changes that the model allows.
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

    @property
    def n_shared(self) -> int:
        """Number of shared unknowns."""
        return self.free.shape[1] + 6 * self.n_stations + self.n_cameras * self.n_optics

    @property
    def n_optics(self) -> int:
        """Number of unknowns of a camera."""
        return self.data.optics.shape[-1]

    @property
    def n_edge_rows(self) -> int:
        """Rows of a configuration that belong to edges; they come first."""
        return self.blocks.side.size // self.blocks.side.shape[0] * 2

    def theta(self, state: BatchState) -> Array:
        """Machine parameters (B, P)."""
        return self.drawing + state.z @ self.free.T

    def residuals(self, state: BatchState) -> Values:
        """Residuals; NaN where a leg passes through the camera."""
        c = self._closure(state)
        edges = self._normals(state, c.ends.a, c.ends.b)
        rows = np.concatenate([self._edge_rows(state, edges.n), self._closure_rows(c)], -1)
        return Values(rows, self._prior_rows(state))

    def linearize(self, state: BatchState) -> Linear:
        """Residuals and exact Jacobian."""
        c = self._closure(state)
        edges = self._normals(state, c.ends.a, c.ends.b)
        value = np.concatenate([self._edge_rows(state, edges.n), self._closure_rows(c)], -1)
        by_a, by_b = self._project(edges.by_a), self._project(edges.by_b)
        shared = self._edge_by_shared(state, c, edges, by_a, by_b)
        by_shared = np.concatenate([shared, self._closure_by_shared(c)], axis=-2)
        by_own = self._by_own(state, c, by_b)
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
        """The state after a step.

        The part of the step that only turns or shifts the frames is made as an exact frame
        change. Added up it would bend the sharp closures and edges at second order, and the
        drawing's soft hold on the frames would be found along a curved valley.
        """
        nz, ns = self.free.shape[1], 6 * self.n_stations
        by_frames = np.linalg.pinv(self.free) @ generators(self.layout, self.theta(state))
        y = self.frames @ np.linalg.pinv(by_frames @ self.frames) @ shared[:, :nz, None]
        z = shared[:, :nz] - (by_frames @ y)[..., 0]
        camera = shared[:, nz : nz + ns].reshape(-1, self.n_stations, 6)
        camera = camera - (station_generators(state.T_camera_base) @ y[:, None])[..., 0]
        pose = own @ self.layout.motion.T
        pose = pose - (pose_generators(state.T_base_platform) @ y[:, None])[..., 0]
        inner = BatchState(
            state.z + z,
            perturb(state.T_camera_base, camera),
            perturb(state.T_base_platform, pose),
            state.optics + shared[:, nz + ns :].reshape(state.optics.shape),
        )
        return self._in_frames(inner, y[..., 0])

    def _in_frames(self, state: BatchState, y: Array) -> BatchState:
        """The state after exact frame changes y (B, 12)."""
        e, f = perturb(np.eye(4), y[:, :6]), perturb(np.eye(4), y[:, 6:])
        theta = moved_centres(self.layout, self.theta(state), e, f)
        return BatchState(
            (theta - self.drawing) @ np.linalg.pinv(self.free).T,
            state.T_camera_base @ inverse(e)[:, None],
            e[:, None] @ state.T_base_platform @ inverse(f)[:, None],
            state.optics,
        )

    def select(self, runs: Integers) -> Problem:
        """The problem of some runs only."""
        part = {
            name: array if array.shape[0] == 1 else array[runs]
            for name, array in vars(self.data).items()
        }
        return replace(self, data=Data(**part))

    @staticmethod
    def take(state: BatchState, runs: Integers) -> BatchState:
        """The states of some runs."""
        return BatchState(**{name: array[runs] for name, array in vars(state).items()})

    @staticmethod
    def put(state: BatchState, runs: Integers, part: BatchState) -> BatchState:
        """The state with some runs replaced."""
        out = {name: array.copy() for name, array in vars(state).items()}
        for name, array in vars(part).items():
            out[name][runs] = array
        return BatchState(**out)

    def weighted(self, weight: Array) -> Problem:
        """The same problem with other weights of the blocks, (B, K, G)."""
        return replace(self, data=replace(self.data, weight=weight))

    def block_residuals(self, state: BatchState) -> Array:
        """Whitened residuals of the blocks without their weights, (B, K, G, 2g)."""
        plain = self.weighted(self.blocks.present[None].astype(float))
        c = plain._closure(state)
        n = plain._normals(state, c.ends.a, c.ends.b).n
        return plain._edge_rows(state, n).reshape(*n.shape[:3], -1)

    def _closure(self, state: BatchState) -> Closure:
        theta = self.theta(state)[:, None, :]
        return closure(self.layout, theta, self.data.joints, state.T_base_platform)

    def _prior_rows(self, state: BatchState) -> Array:
        nz = self.free.shape[1]
        x = np.zeros((state.z.shape[0], self.n_shared))
        x[:, :nz] = state.z
        x[:, nz + 6 * self.n_stations :] = state.optics.reshape(len(x), -1)
        return x @ self.prior.T - self.prior_target

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
        flat = flat.reshape(*flat.shape[:3], -1, flat.shape[-1])
        return np.sqrt(self.data.weight)[..., None, None] * (self.data.whiten @ flat)

    def _optics_columns(self) -> Array:
        """Edge rows by their camera's unknowns, (B, K, G, 2g, w)."""
        return np.sqrt(self.data.weight)[..., None, None] * (self.data.whiten @ self.data.optics)

    def _edge_rows(self, state: BatchState, n: Array) -> Array:
        optics = state.optics[:, self.blocks.camera, :, None]
        rows = (self._project(n[..., None]) + self._optics_columns() @ optics)[..., 0]
        unused = np.broadcast_to((self.data.weight == 0)[..., None], rows.shape)
        return np.where(unused, 0.0, rows).reshape(*rows.shape[:2], -1)

    def _rows_in_use(self, shape: tuple[int, ...]) -> Booleans:
        """Rows that are not padding and not weighted away, (B, K, r)."""
        edges = np.repeat(self.data.weight > 0, self.data.whiten.shape[-1], axis=-1)
        used = np.ones(shape, dtype=bool)
        used[..., : edges.shape[-1]] = edges
        return used

    def _closure_rows(self, c: Closure) -> Array:
        return c.value / self._closure_sigma(c)

    def _closure_sigma(self, c: Closure) -> Array:
        """Standard deviation of each closure; its own derivative is multiplied by c = 0."""
        slope = np.where(self.layout.actuated >= 0, np.abs(c.by_reading), 1.0)
        return slope * self.joint_noise

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
        out = np.concatenate(parts, axis=-1)
        return out.reshape(*out.shape[:2], -1, out.shape[-1])

    def _by_own(self, state: BatchState, c: Closure, by_b: Array) -> Array:
        """Edge and closure rows by the platform's motion, (B, K, r, d)."""
        rot = state.T_camera_base[:, self.blocks.station, :3, :3]
        legs, k = self.blocks.leg, np.arange(len(self.blocks.leg))[:, None]
        edges = by_b @ (rot @ c.ends.b_by_pose[:, k, legs])
        edges = edges.reshape(*edges.shape[:2], -1, 6)
        closures = c.by_pose / self._closure_sigma(c)[..., None]
        return np.concatenate([edges, closures], axis=-2) @ self.layout.motion

    def _closure_by_shared(self, c: Closure) -> Array:
        """Closure rows by the shared unknowns, (B, K, L, na)."""
        inverse = 1 / self._closure_sigma(c)[..., None]
        rod = np.broadcast_to(-inverse, (*c.value.shape, 1))
        free = self._to_free(
            [
                (c.ends.a_index[None], (c.a_by * inverse)[..., None, :]),
                (c.ends.b_index[None], (c.b_by * inverse)[..., None, :]),
                (self.layout.rod[None, :, None], rod[..., None, :]),
            ]
        )[..., 0, :]
        rest = np.zeros((*free.shape[:-1], self.n_shared - free.shape[-1]))
        return np.concatenate([free, rest], axis=-1)

    def _to_free(self, parts: list[tuple[Integers, Array]]) -> Array:
        """Derivatives by machine parameters put into the free unknowns' columns.

        parts : positions (K or 1, G, n) and derivatives (B, K, G, rows, n).
        """
        shape = np.broadcast_shapes(*(values.shape[:-1] for _, values in parts))
        columns = self.free.sum(axis=0)
        full = np.zeros((*shape, self.drawing.size))
        for index, values in parts:
            np.put_along_axis(full, index[None, :, :, None, :], values, axis=-1)
        if np.all(columns == 1):  # no ties: a choice of columns, far cheaper than a product
            return full[..., np.argmax(self.free, axis=0)]
        return full @ self.free


def _one_hot(values: Array, index: Integers, n: int) -> Array:
    """Columns (B, K, G, rows, w) moved to the place of their index (K, G): (..., n w)."""
    out = np.zeros((*values.shape[:-1], n, values.shape[-1]))
    place = index[None, :, :, None, None, None]
    np.put_along_axis(out, place, values[..., None, :], axis=-2)
    return out.reshape(*values.shape[:-1], -1)
