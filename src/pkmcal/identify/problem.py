"""The joint estimation as one least-squares problem: all unknowns, all rows, and a step.

Rows of a configuration are its edges, then its limbs' closures, then its boards' poses
(:mod:`pkmcal.identify.rows`). Rows on shared unknowns: ``(theta - drawing) / tolerance``, what is
known beforehand of cameras, shading and mounts, the gauge (:mod:`pkmcal.identify.assembly`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import inverse, perturb
from pkmcal.identify.gauge import (
    mount_generators,
    move_generators,
    moved_centres,
    moved_mounts,
    pose_generators,
    slid,
    station_generators,
    turned_back,
)
from pkmcal.identify.rows import (
    EdgeBlocks,
    EdgeData,
    EdgeRows,
    Kind,
    Kinds,
    PoseBlocks,
    PoseData,
    PoseRows,
    by_noise,
    edge_rows,
    joint_rows,
    pose_rows,
)
from pkmcal.identify.unknowns import BatchState, Unknowns
from pkmcal.mechanisms.closure import Closure, LimbLayout, closure, dense, on_tangents
from pkmcal.solver import Compact, Linear, Memory, Values, of_runs

CLOSINGS = 2
"""Newton steps back onto the closures; each squares what is left."""


class _Evaluated(NamedTuple):
    """Residuals at a point, and what they were found from."""

    value: Array
    shared_value: Array
    closure: Closure
    edges: EdgeRows
    poses: PoseRows


@dataclass(frozen=True)
class Problem:
    """The joint estimation of B runs; a :class:`pkmcal.solver.LeastSquares`.

    layout, drawing (P,), free (P, nz) : the machine. unknowns : which there are, and their columns.
    blocks, data : edges and readings. joint_noise : (B or 1,) standard deviation of a reading.
    prior : (c, na) rows on the shared unknowns and prior_target : (c,).
    frames : (12 + n, g) changes of frames and hinges' beginnings that no measurement knows.
    pose_blocks, pose_data : of boards.
    """

    layout: LimbLayout
    drawing: Array
    free: Array
    unknowns: Unknowns
    blocks: EdgeBlocks
    data: EdgeData
    joint_noise: Array
    prior: Array
    prior_target: Array
    frames: Array
    pose_blocks: PoseBlocks
    pose_data: PoseData

    @cached_property
    def kinds(self) -> Kinds[Kind]:
        """The kinds of measurement: edges' rows come first in a configuration, poses' last."""
        edges, poses = self.data, self.pose_data
        closures = self.closure_rows
        return Kinds(
            Kind(slice(0, closures.start), self.blocks.present, edges.weight, edges.whiten),
            Kind(slice(closures.stop, None), self.pose_blocks.present, poses.weight, poses.whiten),
        )

    @property
    def closure_rows(self) -> slice:
        """Rows of a configuration that are the closure's."""
        n_edge_rows = self.data.whiten.shape[2] * self.data.whiten.shape[3]
        return slice(n_edge_rows, n_edge_rows + self.layout.n_equations)

    def select(self, runs: Integers) -> Problem:
        """The problem of some runs only."""
        return replace(
            self,
            data=of_runs(self.data, runs),
            pose_data=of_runs(self.pose_data, runs),
            joint_noise=of_runs(self.joint_noise, runs),
        )

    def among(self, configurations: slice) -> Problem:
        """The problem of some configurations only."""
        return replace(
            self,
            blocks=self.blocks.among(configurations),
            data=self.data.among(configurations),
            pose_blocks=self.pose_blocks.among(configurations),
            pose_data=self.pose_data.among(configurations),
        )

    def state_among(self, state: BatchState, configurations: slice) -> BatchState:
        """What that problem needs of a state."""
        return replace(
            state,
            T_base_platform=state.T_base_platform[:, configurations],
            internal=state.internal[:, configurations],
        )

    def weighted(self, weight: Kinds[Array]) -> Problem:
        """The same problem with other weights (B, K, G) of each kind's measurements."""
        return replace(
            self,
            data=replace(self.data, weight=weight.edges),
            pose_data=replace(self.pose_data, weight=weight.poses),
        )

    def shaded(self, sigma: Array) -> Problem:
        """The same problem with other standard deviations (B, n) px of the lines' shading."""
        return replace(self, data=replace(self.data, shading=sigma))

    def opened(self, state: BatchState) -> tuple[Problem, BatchState]:
        """The same problem and state with every parameter of the machine an unknown of its own.

        For derivatives by parameters that were held; z is then ``theta - drawing``.
        """
        n, machine = self.drawing.size, self.unknowns.machine
        prior = [self.prior[:, machine] @ self.to_free, self.prior[:, machine.stop :]]
        problem = replace(
            self,
            free=np.eye(n),
            unknowns=replace(self.unknowns, n_free=n),
            prior=np.concatenate(prior, axis=1),
        )
        return problem, replace(state, z=self.theta(state) - self.drawing)

    def theta(self, state: BatchState) -> Array:
        """Machine parameters (B, P)."""
        return self.drawing + state.z @ self.free.T

    @cached_property
    def to_free(self) -> Array:
        """(nz, P), from changes of the parameters to those of z."""
        return np.linalg.pinv(self.free)

    def closure(self, state: BatchState) -> Closure:
        """The closure of all runs and configurations, (B, K, E)."""
        theta = self.theta(state)[:, None, :]
        internal = state.internal if self.layout.n_internal else None
        return closure(self.layout, theta, self.data.joints, state.T_base_platform, internal)

    def residuals(self, state: BatchState) -> Values:
        """Residuals; NaN where a leg passes through the camera."""
        found = self._evaluated(state)
        return Values(found.value, found.shared_value, partial(self._rows, found))

    def linearize(self, state: BatchState) -> Linear:
        """Residuals and exact Jacobian, zero where nothing can be predicted or nothing is there."""
        rows = self.compact(state)
        by_shared = np.empty((*rows.value.shape, rows.n_shared))
        for run in range(len(by_shared)):
            by_shared[run] = rows.write(run, slice(None), Memory())
        return Linear(
            rows.value, by_shared, rows.by_own, rows.usable, rows.shared_value, rows.shared_by
        )

    def compact(self, state: BatchState) -> Compact:
        """The same, with the derivatives by the shared unknowns of all rows that have few of them
        in few numbers.
        """
        return self._rows(self._evaluated(state))

    def _evaluated(self, state: BatchState) -> _Evaluated:
        c = self.closure(state)
        edges, poses = self._edges(state, c), self._poses(state)
        value = self._values(state, c, edges, poses)
        return _Evaluated(value, self.prior_values(state) - self.prior_target, c, edges, poses)

    def _rows(self, found: _Evaluated) -> Compact:
        """The rows at a point, from what was needed of it for its residuals."""
        value, shared_value, c, edges, poses = found
        usable = np.isfinite(value) & self._in_use()
        by_edges, own = self._of_edges(edges)
        by_closures, by_pose = self._of_closures(c)
        by_boards, by_board = self._of_boards(poses)
        by_own = np.concatenate([own, by_pose, by_board], axis=2)
        # padding may lie anywhere, so its derivatives need not be finite though its row is zero
        by_own[~np.isfinite(value + by_own.sum(axis=-1))] = 0.0

        def write(run: int, configurations: slice, memory: Memory) -> Array:
            some = by_edges[:, :, run], by_closures[run], by_boards[run]
            return self._written(*some, configurations, memory)

        value, count = np.where(usable, value, 0.0), self.unknowns.count
        return Compact(value, by_own, usable, shared_value, self.prior, count, write)

    def _written(
        self, edges: Array, closures: Array, boards: Array, some: slice, memory: Memory
    ) -> Array:
        """Derivatives (k, r, na) of some configurations of one run by the shared unknowns, from
        those of the edges (n, 2g, K, G), the closures (K, E, n) and the boards (K, 6 G, na).
        """
        rows, count = self.closure_rows, self.unknowns.count
        out = memory.empty("by shared", (len(boards[some]), self.n_rows, self._width))
        out.fill(0.0)
        flat, before = out.reshape(-1), (some.start or 0) * self.n_rows * self._width
        if edges.size:
            flat[self._edge_places[:, :, some] - before] = edges[:, :, some]
        flat[self._closure_places[some] - before] = closures[some]
        if self._choice is None:
            out[:, : rows.stop, self.unknowns.machine] = out[:, : rows.stop, count:-1] @ self.free
        out[:, rows.stop :, :count] = boards[some]
        return out[..., :count]

    @cached_property
    def n_rows(self) -> int:
        """Rows of a configuration, r."""
        return self.closure_rows.stop + self.pose_blocks.present.shape[1] * 6

    @cached_property
    def _edge_places(self) -> Integers:
        """Where the edges' derivatives are written among all of a run, (n, 2g, K, G)."""
        u, blocks, layout = self.unknowns, self.blocks, self.layout
        index = (layout.a_index[blocks.leg], layout.b_index[blocks.leg], blocks.radius[..., None])
        columns = [self._column[part] for part in index]
        columns.append(_columns(u.stations, blocks.station, 6))
        columns.append(_columns(u.optics, blocks.camera, u.n_optics))
        if u.n_lines:
            columns.append(_columns(u.shading, np.maximum(blocks.line, 0), 1))
        if u.n_breathing:
            columns.append(_columns(u.breathing, blocks.station, 1))
        (k, g), n = blocks.leg.shape, 2 * blocks.side.shape[-1]
        row = self.n_rows * np.arange(k)[:, None] + n * np.arange(g)
        row = row + np.arange(n)[:, None, None]
        return row * self._width + np.moveaxis(np.concatenate(columns, axis=-1), -1, 0)[:, None]

    @cached_property
    def _closure_places(self) -> Integers:
        """The same of the closures' derivatives, (K, E, n); rods on one motor share their noise, so
        each has those of all.
        """
        rows, index = self.closure_rows, self.layout.closure_index
        if self.layout.shares_motors:
            index = np.tile(np.arange(self.drawing.size), (self.layout.n_equations, 1))
        row = self.n_rows * np.arange(len(self.blocks.leg))[:, None] + np.arange(
            rows.start, rows.stop
        )
        return row[..., None] * self._width + self._column[index]

    def _of_edges(self, edges: EdgeRows) -> tuple[Array, Array]:
        """The edges' derivatives (n, 2g, B, K, G) by what :attr:`_edge_places` says, and by the
        configuration's own unknowns, (B, K, G 2g, d); zero where they are lost.
        """
        parts = [*edges.by_machine, edges.by_station, _blocks_last(edges.by_optics)]
        if self.unknowns.n_lines:
            parts.append(_blocks_last(edges.by_line))
        if self.unknowns.n_breathing:
            parts.append(_blocks_last(edges.by_breathing))
        own = edges.by_own(self.layout.freedoms)
        blocks = own.shape[1:]
        out = np.concatenate([np.broadcast_to(part, (len(part), *blocks)) for part in parts])
        lost = ~np.isfinite(out.sum(axis=0))
        if lost.any():
            out[:, lost] = 0.0
        return out, _in_rows(np.moveaxis(own, (0, 1), (-1, -2)))

    def _of_closures(self, c: Closure) -> tuple[Array, Array]:
        """The closures' derivatives (B, K, E, n) by what :attr:`_closure_places` says, and by the
        own unknowns; zero where they are lost.
        """
        by_theta = dense(c, self.drawing.size) if self.layout.shares_motors else c.by_theta
        out = self._by_noise(c, by_theta)
        lost = ~np.isfinite(out.sum(axis=-1))
        if lost.any():
            out[lost] = 0.0
        return out, self._by_noise(c, self.layout.by_own(c))

    def _of_boards(self, poses: PoseRows) -> tuple[Array, Array]:
        """The same of the boards' poses by all shared unknowns, (B, K, 6 G, na)."""
        u, boards = self.unknowns, self.pose_blocks
        parts = [
            (_columns(u.stations, boards.station, 6), poses.by_station),
            (_columns(u.optics, boards.camera, u.n_optics), poses.by_optics),
            (_columns(u.mounts, boards.mount, 6), poses.by_mount),
        ]
        if u.n_breathing:
            parts.append((_columns(u.breathing, boards.station, 1), poses.by_breathing))
        if u.n_sizes:  # an exact size's rows are zero, whatever column they are written to
            number = np.maximum(boards.size[boards.mount], 0)
            parts.append((_columns(u.sizes, number, 1), poses.by_size))
        out = np.zeros((*poses.value.shape, u.count))
        for columns, values in parts:
            np.put_along_axis(out, columns[None, :, :, None], values, axis=-1)
        own = np.zeros((*poses.value.shape, self.layout.own_motion.shape[1]))
        by_pose = poses.by_platform[..., self.layout.freedoms]
        own[..., : by_pose.shape[-1]] = by_pose
        out[~np.isfinite(poses.value + out.sum(axis=-1))] = 0.0
        return _in_rows(out), _in_rows(own)

    @cached_property
    def _width(self) -> int:
        """Columns of an edge's row while it is written: the shared unknowns', where parameters are
        tied or are axes one for each parameter besides, and one for what is no unknown.
        """
        return self.unknowns.count + 1 + (0 if self._choice is not None else self.drawing.size)

    @cached_property
    def _column(self) -> Integers:
        """Where each parameter's derivatives are written, (P + 1,); the last is no parameter's."""
        if self._choice is None:
            return self.unknowns.count + np.arange(self.drawing.size + 1)
        out = np.full(self.drawing.size + 1, self.unknowns.count)
        out[self._choice] = np.arange(len(self._choice))
        return out

    def unweighted(self, state: BatchState) -> Kinds[Array]:
        """Whitened residuals of each kind of measurement without their weights, (B, K, G, n)."""
        plain = self.weighted(Kinds(*(kind.present[None].astype(float) for kind in self.kinds)))
        edges = plain._edges(state, plain.closure(state))
        return Kinds(edges.value(state), plain._poses(state).value)

    def joint_rows(self, c_rows: Array, state: BatchState) -> Array:
        """Whitened closure rows (B, K, E) as one a reading, (B, K, m)."""
        return joint_rows(self.layout, self.closure(state).by_reading, c_rows)

    def prior_values(self, state: BatchState) -> Array:
        """What the prior's rows (B, c) come to, before their targets are taken off."""
        u = self.unknowns
        x = np.zeros((len(state.z), u.count))
        x[:, u.machine] = state.z
        x[:, u.optics] = state.optics.reshape(len(x), -1)
        x[:, u.shading] = state.shading
        x[:, u.breathing] = state.breathing
        x[:, u.sizes] = state.sizes
        mounts = x[:, u.mounts].reshape(len(x), -1, 6)  # of which only places are known
        mounts[..., 3:] = state.T_mount[..., :3, 3]
        # of stations only that they are level: where the base's z axis points, that turns them
        stations, up = x[:, u.stations].reshape(len(x), -1, 6), state.T_camera_base[..., :3, 2]
        stations[..., 0], stations[..., 1] = -up[..., 1], up[..., 0]
        return x @ self.prior.T

    def _edges(self, state: BatchState, c: Closure) -> EdgeRows:
        radius = self.theta(state)[:, self.blocks.radius]
        return edge_rows(self.blocks, self.data, c, radius, state.T_camera_base)

    def _poses(self, state: BatchState) -> PoseRows:
        return pose_rows(
            self.pose_blocks,
            self.pose_data,
            state.T_camera_base,
            state.T_base_platform,
            state.T_mount,
            state.optics,
            state.breathing,
            state.sizes,
        )

    def _by_noise(self, c: Closure, rows: Array) -> Array:
        """Rows (B, K, E, n) of the closure in standard deviations."""
        return by_noise(self.layout, self.joint_noise[:, None, None], c.by_reading, rows)

    def _values(self, state: BatchState, c: Closure, edges: EdgeRows, poses: PoseRows) -> Array:
        """All rows of the configurations, (B, K, r)."""
        parts = (
            edges.value(state),
            self._by_noise(c, c.value[..., None]),
            poses.value,
        )
        return np.concatenate([part.reshape(*part.shape[:2], -1) for part in parts], axis=-1)

    def _in_use(self) -> Booleans:
        """Rows that are not padding and not weighted away, (B or 1, K, r)."""
        edges, poses = (
            np.repeat(kind.weight > 0, kind.whiten.shape[-1], axis=-1) for kind in self.kinds
        )
        runs, n = max(len(edges), len(poses)), edges.shape[1]
        parts = (edges, np.ones((1, n, self.layout.n_equations), dtype=bool), poses)
        parts = [np.broadcast_to(part, (runs, n, part.shape[-1])) for part in parts]
        return np.concatenate(parts, axis=-1)

    @cached_property
    def _choice(self) -> Integers | None:
        """The parameter of each free unknown where each moves one parameter alone."""
        alone = np.all((self.free != 0).sum(axis=0) == 1) and np.all(self.free.sum(axis=0) == 1)
        return np.argmax(self.free, axis=0) if alone else None

    def moved(self, state: BatchState, shared: Array, own: Array) -> BatchState:
        """The state after a step (B, na) and (B, K, d), taken along what bends.

        The part of the step that only turns or shifts the frames is made as an exact frame
        change. Added up it would bend the sharp closures and edges at second order, and the
        drawing's soft hold on the frames would be found along a curved valley.
        """
        u, layout = self.unknowns, self.layout
        z = shared[:, u.machine]
        by_moves = self.to_free @ move_generators(layout, self.theta(state), self.drawing)
        moves = self.frames @ np.linalg.pinv(by_moves @ self.frames) @ z[..., None]
        y, slides = moves[:, :12], moves[:, 12:, 0]

        def less_frames(step: Array, by_frames: Array) -> Array:
            """Steps (B, n, 6) of poses without what the frame change y does to them."""
            return step - (by_frames @ y[:, None])[..., 0]

        camera = shared[:, u.stations].reshape(len(z), u.n_stations, 6)
        mount = shared[:, u.mounts].reshape(*state.T_mount.shape[:2], 6)
        motion = own @ layout.own_motion.T
        on_platform = self.pose_blocks.on_platform
        inner = BatchState(
            state.z + (z - (by_moves @ moves)[..., 0]),
            perturb(
                state.T_camera_base, less_frames(camera, station_generators(state.T_camera_base))
            ),
            perturb(
                state.T_base_platform,
                less_frames(motion[..., :6], pose_generators(state.T_base_platform)),
            ),
            state.optics + shared[:, u.optics].reshape(state.optics.shape),
            perturb(
                state.T_mount, less_frames(mount, mount_generators(state.T_mount, on_platform))
            ),
            state.internal + motion[..., 6:] + turned_back(layout, slides)[:, None],
            state.shading + shared[:, u.shading],
            state.breathing + shared[:, u.breathing],
            state.sizes + shared[:, u.sizes],
        )
        return self._closed(state, self._in_frames(inner, y[..., 0], slides), shared, own)

    def _in_frames(self, state: BatchState, y: Array, slides: Array) -> BatchState:
        """The state after exact frame changes y (B, 12) and others (B, n)."""
        layout, e, f = self.layout, perturb(np.eye(4), y[:, :6]), perturb(np.eye(4), y[:, 6:])
        theta = moved_centres(layout, slid(layout, self.theta(state), slides), e, f)
        theta = on_tangents(layout, theta, self.drawing)
        return replace(
            state,
            z=(theta - self.drawing) @ self.to_free.T,
            T_camera_base=state.T_camera_base @ inverse(e)[:, None],
            T_base_platform=e[:, None] @ state.T_base_platform @ inverse(f)[:, None],
            T_mount=moved_mounts(state.T_mount, self.pose_blocks.on_platform, e, f),
            internal=state.internal - turned_back(layout, slides)[:, None],
        )

    def _closed(
        self, state: BatchState, trial: BatchState, shared: Array, own: Array
    ) -> BatchState:
        """The trial with its poses moved to where the closures are what the step meant them to be.

        For machines with cranks or sliders, whose readings are far sharper than a board's poses, or
        with equations of joints' axes, which are as good as exact: the closures bend over a step by
        more than they may be wrong, and the search would creep.
        """
        layout = self.layout
        freedoms = layout.own_motion.shape[1]
        bends = any(g.carrier.driven for g in layout.base) or len(layout.angles)
        if layout.n_equations != freedoms or not bends:
            return trial
        c = self.closure(state)
        change = shared[:, self.unknowns.machine] @ self.free.T
        change = np.pad(change, ((0, 0), (0, 1)))[:, c.index][:, None]
        wanted = c.value + np.sum(c.by_theta * change, axis=-1)
        wanted = wanted + (layout.by_own(c) @ own[..., None])[..., 0]
        for _ in range(CLOSINGS):
            c = self.closure(trial)
            back = np.linalg.pinv(layout.by_own(c)) @ (wanted - c.value)[..., None]
            step = back[..., 0] @ layout.own_motion.T
            trial = replace(
                trial,
                T_base_platform=perturb(trial.T_base_platform, step[..., :6]),
                internal=trial.internal + step[..., 6:],
            )
        return trial


def _columns(part: slice, number: Integers, width: int) -> Integers:
    """Columns (K, G, width) of unknowns ``width`` wide each, by which one it is, (K, G)."""
    return part.start + width * number[..., None] + np.arange(width)


def _in_rows(parts: Array) -> Array:
    """Rows (B, K, G, n, w) of G places one after the other, (B, K, G n, w)."""
    return parts.reshape(*parts.shape[:2], parts.shape[2] * parts.shape[3], parts.shape[4])


def _blocks_last(values: Array) -> Array:
    """Derivatives (B, K, G, n, w) with the blocks last, (w, n, B, K, G)."""
    return np.moveaxis(values, (-1, -2), (0, 1))
