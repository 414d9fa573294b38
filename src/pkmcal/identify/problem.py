"""The joint estimate as one least-squares problem: unknowns, residuals, Jacobian and retraction.

The linear system
-----------------
Rows of a configuration are its edges, the closures of its limbs, its boards' poses
(:mod:`pkmcal.measurements`) and the links of which it is the second configuration
(:mod:`pkmcal.identify.link_rows`). Columns are the unknowns (:mod:`pkmcal.identify.unknowns`).
Nonzero blocks of the Jacobian::

                         machine stations effects mounts linked | own unknowns of 1  2
    1  edges                x       x       x                   |                 x
       closures             x               x                   |                 x
       poses                        x       x       x           |                 x
    2  edges                x       x       x                   |                    x
       closures             x               x                   |                    x
    3  edges                x       x       x              x    |
       closures             x               x              x    |
    4  closures             x               x              x    |
       link 3 to 4                                  x      x    |
    priors                  x       x       x       x           |

The own unknowns of linked configurations are shared, so that the own unknowns of all others are
eliminated configuration by configuration (Schur complement). The prior rows are
``(theta - nominal) / sigma``, the priors of effects, level stations and mounts, and the gauge
(:mod:`pkmcal.identify.assembly`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import accumulate
from typing import NamedTuple, cast

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr, with_zero
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
from pkmcal.identify.link_rows import LinkBlocks, LinkData, link_rows
from pkmcal.identify.structure import Structure, numbered_columns
from pkmcal.identify.unknowns import BatchState, Unknowns
from pkmcal.measurements import LinkRows
from pkmcal.measurements.edges import (
    EdgeBlocks,
    EdgeData,
    EdgeRows,
    ViewData,
    edge_rows,
    rows_at_blocks,
)
from pkmcal.measurements.effects import SHADING
from pkmcal.measurements.poses import PoseBlocks, PoseData, PoseRows, pose_rows
from pkmcal.measurements.readings import (
    ReadingColumns,
    by_noise,
    closures_by_readings,
    joint_rows,
    least_joint_noise,
)
from pkmcal.measurements.rows import RowGroup, RowGroups
from pkmcal.mechanisms.closure import (
    Closure,
    by_own,
    closure,
    dense,
    on_tangents,
    rod_lengths,
)
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR, scaled_rows, singularity_of
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.solver.elimination import SOLVER_ROWS_AT_ONCE, Linear, divisions
from pkmcal.solver.search import Values, of_runs
from pkmcal.solver.strips import Compact, Strips

CLOSING_NEWTON_STEPS = 2
"""Newton steps back onto the closures; each squares the remainder."""


class _Evaluated(NamedTuple):
    """Residuals at a state, and their intermediate values."""

    value: Array
    of_edges: Array
    shared_value: Array
    closure: Closure
    edges: EdgeRows
    poses: PoseRows
    links: LinkRows


@dataclass(frozen=True)
class Problem:
    """Joint estimation of B runs as a least-squares problem; a
    :class:`~pkmcal.solver.search.Divisible`.

    layout : limbs of the machine.
    nominal, free : (P,) nominal parameters, and (P, nz) their derivative by the free unknowns z.
    unknowns : numbers and columns of the shared unknowns.
    blocks, data : edges and readings.
    joint_noise : (B or 1,) standard deviation of a reading.
    prior, prior_target : (c, na) rows on the shared unknowns, and (c,) their targets.
    frames : (12 + n, g) changes of frames and of the hinges' origins that no measurement
        determines.
    pose_blocks, pose_data : measured poses.
    link_blocks, link_data : links.
    reading_columns : effects on the readings.
    slopes : (B, K, E) derivatives of the closures by their readings, which give the closures their
        noise, where these are fixed; None to evaluate them at the state.
    structure_cache : :attr:`structure`, shared by problems of the same measurements.
    rows_at_once : number of rows that are linearized together, in whole configurations.
    """

    layout: LimbLayout
    nominal: Array
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
    link_blocks: LinkBlocks
    link_data: LinkData
    reading_columns: ReadingColumns
    slopes: Array | None = None
    structure_cache: Structure | None = None
    rows_at_once: int = SOLVER_ROWS_AT_ONCE
    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Reuse the structure of a problem of the same measurements."""
        parts = (
            self.layout, self.nominal, self.free, self.unknowns, self.blocks, self.frames,
            self.link_blocks,
        )  # fmt: skip
        if self.structure_cache is None or not self.structure_cache.made_of(*parts):
            object.__setattr__(self, "structure_cache", Structure(*parts))

    @property
    def structure(self) -> Structure:
        """Structure of the problem."""
        return cast(Structure, self.structure_cache)

    @cached_property
    def row_groups(self) -> RowGroups[RowGroup]:
        """Rows of each kind of measurement; edges come first in a configuration, links last."""
        edges, poses, links = self.data, self.pose_data, self.link_data
        closures = self.closure_rows
        last = closures.stop + 6 * self.pose_blocks.present.shape[1]
        return RowGroups(
            RowGroup(slice(0, closures.start), self.blocks.present, edges.weight, edges.whiten),
            RowGroup(
                slice(closures.stop, last), self.pose_blocks.present, poses.weight, poses.whiten
            ),
            RowGroup(
                slice(last, self.n_rows), self.link_blocks.present, links.weight, links.whiten
            ),
        )

    @property
    def closure_rows(self) -> slice:
        """Rows of the closures in a configuration."""
        n_edge_rows = self.data.white.shape[2] * self.data.white.shape[3]
        return slice(n_edge_rows, n_edge_rows + self.layout.n_equations)

    def select(self, runs: Integers) -> Problem:
        """Problem of some runs."""
        return replace(
            self,
            data=of_runs(self.data, runs),
            pose_data=of_runs(self.pose_data, runs),
            link_data=of_runs(self.link_data, runs),
            joint_noise=of_runs(self.joint_noise, runs),
            slopes=None if self.slopes is None else of_runs(self.slopes, runs),
        )

    def among(self, configurations: slice) -> Problem:
        """Problem of some configurations; ``self``, with its cache, for all."""
        if configurations == slice(0, len(self.blocks.present)):
            return self
        structure = self.structure.among(configurations)
        return replace(
            self,
            blocks=structure.blocks,
            structure_cache=structure,
            data=self.data.among(configurations),
            pose_blocks=self.pose_blocks.among(configurations),
            pose_data=self.pose_data.among(configurations),
            link_blocks=structure.link_blocks,
            link_data=self.link_data.among(configurations),
            reading_columns=self.reading_columns.among(configurations),
            slopes=None if self.slopes is None else self.slopes[:, configurations],
        )

    def state_among(self, state: BatchState, configurations: slice) -> BatchState:
        """The part of a state that :meth:`among` needs."""
        return replace(
            state,
            T_base_platform=state.T_base_platform[:, configurations],
            internal=state.internal[:, configurations],
            linked=self._linked_poses(state),
        )

    def _linked_poses(self, state: BatchState) -> Array:
        """T_base_platform (B, J, 4, 4) of the linked configurations."""
        if state.linked.shape[1]:
            return state.linked
        return state.T_base_platform[:, self.link_blocks.linked]

    def weighted(self, weight: RowGroups[Array]) -> Problem:
        """Problem with other weights (B, K, G) of the measurements of each kind."""
        return replace(
            self,
            data=replace(self.data, weight=weight.edges),
            pose_data=replace(self.pose_data, weight=weight.poses),
            link_data=replace(self.link_data, weight=weight.links),
        )

    def as_noisy_as_at(self, state: BatchState) -> Problem:
        """Problem with the closures' noise fixed to its value at a state, the start of a search.

        The derivative of a crank's closure by its reading depends on the state. If the noise
        followed the state, the gradient of the cost would contain that of the noise, which no row
        contains, and with thousands of configurations no step near the minimum would reduce the
        cost as predicted.
        """
        if self.layout.reads_lengths:
            return self
        return replace(self, slopes=self.closure(state).by_reading)

    def shaded(self, sigma: Array) -> Problem:
        """Problem with other standard deviations (B, n) px of the lines' shading."""
        unit = np.repeat(self.data.unit, max(len(sigma) // len(self.data.unit), 1), axis=0)
        unit[:, self._lines] = sigma
        return replace(self, data=replace(self.data, unit=unit))

    @property
    def shading(self) -> Array:
        """Standard deviations (B or 1, n) px of the lines' shading."""
        return self.data.unit[:, self._lines]

    def lines_of(self, state: BatchState) -> Array:
        """Shifts (B, n) of the lines, in their prior standard deviations."""
        return state.columns[:, self._lines]

    @property
    def _lines(self) -> slice:
        """Columns of the lines' shading among those of the effects."""
        lines, first = self.unknowns.of_code(SHADING), self.unknowns.effects.start
        return slice(lines.start - first, lines.stop - first)

    def with_shading_units(self, state: BatchState, sigma: Array) -> BatchState:
        """State in the units of other standard deviations (B, n) px of the lines' shading."""
        columns = state.columns.copy()
        columns[:, self._lines] *= self.shading / sigma
        return replace(state, columns=columns)

    def opened(self, state: BatchState) -> tuple[Problem, BatchState]:
        """Problem and state with every parameter of the machine as an unknown.

        For derivatives by fixed parameters; z is then ``theta - nominal``.
        """
        n, machine = self.nominal.size, self.unknowns.machine
        prior = [self.prior[:, machine] @ self.structure.to_free, self.prior[:, machine.stop :]]
        problem = replace(
            self,
            free=np.eye(n),
            unknowns=replace(self.unknowns, n_free=n),
            prior=np.concatenate(prior, axis=1),
        )
        return problem, replace(state, z=self.theta(state) - self.nominal)

    def theta(self, state: BatchState) -> Array:
        """Machine parameters (B, P)."""
        return self.nominal + state.z @ self.free.T

    def closure(self, state: BatchState) -> Closure:
        """Closures of all runs and configurations, (B, K, E)."""
        theta = self.theta(state)[:, None, :]
        internal = state.internal if self.layout.n_internal else None
        joints = self.reading_columns.corrected(self.data.joints, state.columns)
        return closure(self.layout, theta, joints, state.T_base_platform, internal)

    def residuals(self, state: BatchState) -> Values:
        """Residuals; NaN where a leg passes through the camera."""
        evaluated = self._evaluated(state)
        return Values(evaluated.value, evaluated.shared_value, partial(self._rows, evaluated))

    def linearize(self, state: BatchState) -> Linear:
        """Residuals and exact Jacobian; zero for padding and where nothing can be predicted."""
        return self.compact(state).linear()

    def compact(self, state: BatchState) -> Compact:
        """Residuals and Jacobian with the edges of each view as a strip."""
        return self._rows(self._evaluated(state))

    def _evaluated(self, state: BatchState) -> _Evaluated:
        c = self.closure(state)
        edges, poses, links = self._edges(state, c), self._poses(state), self._links(state)
        of_edges = edges.value(state.columns)
        parts = (
            _in_rows(rows_at_blocks(self.blocks, of_edges)[..., None]),
            self._by_noise(c, c.rows.value[..., None]),
            _in_rows(poses.value[..., None]),
            links.value[..., None],
        )
        value = np.concatenate(parts, axis=2)[..., 0]
        shared_value = self.prior_values(state) - self.prior_target
        return _Evaluated(value, of_edges, shared_value, c, edges, poses, links)

    def _rows(self, evaluated: _Evaluated) -> Compact:
        """The rows at a state, from its residuals."""
        usable = np.isfinite(evaluated.value) & self._in_use
        # derivatives of closures, boards and links by shared and own unknowns
        by_closures, by_pose = self._of_closures(evaluated.closure)
        by_boards, by_board = self._of_boards(evaluated.poses)
        by_links = self._of_links(evaluated.links)
        no_own = np.zeros((*by_links.shape[:3], by_pose.shape[-1]))
        by_own = np.concatenate([by_pose, by_board, no_own], axis=2)
        by_own = np.where(np.isfinite(by_own.sum(axis=-1, keepdims=True)), by_own, 0.0)
        rest = self._of_rest(by_closures, np.concatenate([by_boards, by_links], axis=2))
        # effects that change readings act through the closures
        if len(self.reading_columns.column):
            by_readings = self.by_readings(evaluated.closure, self.reading_columns.by)
            columns = self.unknowns.effects.start + self.reading_columns.column
            equations = np.arange(by_readings.shape[2])[:, None]
            rest[:, :, equations, columns] += np.nan_to_num(by_readings)
        # own unknowns of linked configurations are shared columns
        for k, columns in zip(*self.structure.strips.linked_places, strict=True):
            rest[:, k, :, columns] += np.moveaxis(by_own[:, k], -1, 0)
            by_own[:, k] = 0.0
        return Compact(
            np.where(usable, evaluated.value, 0.0),
            usable,
            evaluated.shared_value,
            self.prior,
            Strips(self.structure.strips, self._of_edges(evaluated.edges, evaluated.of_edges)),
            rest,
            by_own,
        )

    def _of_edges(self, edges: EdgeRows, value: Array) -> Array:
        """Numbers of the strips, (B, d + w + 1, N, n).

        Derivatives by the d own unknowns and by the w ``strip_parameters`` of the structure, and
        the residuals; zero where these are not finite or have no weight. value : (B, N, n)
        residuals of the N views.
        """
        # derivatives by own unknowns, both ends, station, radii and effects, written in place
        by_columns, ends_by = edges.data.by_columns, edges.ends_by(self.layout.freedoms)
        tube = self.structure.own_radii
        widths = (ends_by.shape[-1], len(tube), len(by_columns), 1)
        numbers = np.empty((len(value), sum(widths), *value.shape[1:]))
        of_ends, of_radius, of_columns, _ = (
            numbers[:, stop - width : stop]
            for width, stop in zip(widths, accumulate(widths), strict=True)
        )
        by_ends = edges.by_ends().transpose(1, 2, 0, 3)
        np.matmul(ends_by.mT, by_ends, out=of_ends.swapaxes(1, 2))
        np.multiply(edges.by_radius()[:, None], tube, out=of_radius)
        of_columns[...] = by_columns.swapaxes(0, 1)
        numbers[:, -1] = value
        # an edge without weight may have an infinite derivative
        lost = ~(np.isfinite(value) & edges.data.counts)
        if lost.any():
            np.copyto(numbers, 0.0, where=lost[:, None])
        # tied parameters and axes: from derivatives by parameters to those by unknowns
        if self.structure.turn is None:
            return numbers
        d, n_turned = self.layout.own_motion.shape[1], self.structure.turn.columns.shape[1]
        turned = np.empty((len(value), d + n_turned + 1, *value.shape[1:]))
        turned[:, :d], turned[:, -1] = numbers[:, :d], numbers[:, -1]
        for cut, turn in zip(self.structure.strips.groups, self.structure.turn.by, strict=True):
            columns = numbers[:, d:-1, cut]
            rows = turn.T @ columns.reshape(*columns.shape[:2], -1)
            turned[:, d:-1, cut] = rows.reshape(len(rows), n_turned, *columns.shape[2:])
        return turned

    def _of_rest(self, closures: Array, boards: Array) -> Array:
        """Derivatives (B, K, r', na) of closures and boards by all shared unknowns.

        closures : (B, K, E, n) by the structure's ``closure_index``. boards : (B, K, 6 G, na).
        """
        count, (*batch, equations, _) = self.unknowns.count, closures.shape
        out = np.zeros((*batch, equations + boards.shape[2], count + 1))
        if self.structure.choice is None:
            by_free = closures.swapaxes(1, 2) @ self.structure.closure_turn
            out[:, :, :equations, self.unknowns.machine] = by_free.swapaxes(1, 2)
        else:
            each = np.arange(equations)[:, None]
            out[:, :, each, self.structure.column[self.structure.closure_index]] = closures
        out[:, :, equations:, :count] = boards
        return out[..., :count]

    @cached_property
    def n_rows(self) -> int:
        """Rows of a configuration, r."""
        links = self.link_blocks.present.shape[1]
        return self.closure_rows.stop + self.pose_blocks.present.shape[1] * 6 + links

    @property
    def extent(self) -> tuple[int, int]:
        """Configurations K and rows of each, r."""
        return len(self.blocks.present), self.n_rows

    @property
    def cuts(self) -> list[slice]:
        """Slices of the configurations that are linearized together."""
        return divisions(*self.extent, self.rows_at_once)

    def _of_closures(self, c: Closure) -> tuple[Array, Array]:
        """Derivatives (B, K, E, n) of the closures by the structure's ``closure_index``, and by the
        own unknowns; zero where they are not finite.
        """
        by_theta = dense(c, self.nominal.size) if self.layout.shares_motors else c.by_theta
        out = self._by_noise(c, by_theta)
        lost = ~np.isfinite(out.sum(axis=-1))
        if lost.any():
            out[lost] = 0.0
        return out, self._by_noise(c, by_own(self.layout, c.rows))

    def _of_boards(self, poses: PoseRows) -> tuple[Array, Array]:
        """Derivatives (B, K, 6 G, na) of the poses by all shared unknowns, and by the own ones."""
        u, boards = self.unknowns, self.pose_blocks
        if not boards.present.size:
            none = (*poses.value.shape[:2], 0)
            return np.zeros((*none, u.count)), np.zeros((*none, self.layout.own_motion.shape[1]))
        effects = np.where(boards.column < 0, u.count, u.effects.start + boards.column)
        parts = [
            (numbered_columns(u.stations, boards.station, 6), poses.by_station),
            (effects, poses.by_columns),
            (numbered_columns(u.mounts, boards.mount, 6), poses.by_mount),
        ]
        out = np.zeros((*poses.value.shape, u.count + 1))  # the last column is none's
        for columns, values in parts:
            np.put_along_axis(out, columns[None, :, :, None], values, axis=-1)
        out = out[..., :-1]
        own = np.zeros((*poses.value.shape, self.layout.own_motion.shape[1]))
        by_pose = poses.by_platform[..., self.layout.freedoms]
        own[..., : by_pose.shape[-1]] = by_pose
        out[~np.isfinite(poses.value + out.sum(axis=-1))] = 0.0
        return _in_rows(out), _in_rows(own)

    def _of_links(self, links: LinkRows) -> Array:
        """Derivatives (B, K, G, na) of the links by the shared unknowns: the own unknowns of both
        configurations, which are shared, and the mount.
        """
        u, blocks, freedoms = self.unknowns, self.link_blocks, self.layout.freedoms
        out = np.zeros((*links.value.shape, u.count))
        d, at = self.layout.own_motion.shape[1], (blocks.at.row, blocks.at.place)
        each = (links.by_first[..., freedoms], links.by_second[..., freedoms])
        n = each[0].shape[-1]
        for number, by in zip(blocks.ends.T, each, strict=True):
            columns = u.linked.start + d * number[:, None] + np.arange(n)
            out[:, at[0][:, None], at[1][:, None], columns] += by
        columns = numbered_columns(u.mounts, blocks.mount, 6)
        out[:, at[0][:, None], at[1][:, None], columns] += links.by_mount
        return out

    def _links(self, state: BatchState) -> LinkRows:
        return link_rows(self.link_blocks, self.link_data, self._linked_poses(state), state.T_mount)

    def unweighted(self, state: BatchState) -> RowGroups[Array]:
        """Residuals of each kind, (B, K, G, n), in the standard deviation of a single measurement:
        without weights, and without the factor for edges with correlated shading.
        """
        count, n_rows = self.extent
        cuts = divisions(count, len(state.z) * n_rows, self.rows_at_once)
        if len(cuts) > 1:
            parts = (self.among(cut).unweighted(self.state_among(state, cut)) for cut in cuts)
            return RowGroups(*(np.concatenate(part, axis=1) for part in zip(*parts, strict=True)))
        plain = self.weighted(
            RowGroups(*(kind.present[None].astype(float) for kind in self.row_groups))
        )
        n_effective = np.where(self.blocks.n_effective > 0, self.blocks.n_effective, 1.0)
        plain = replace(plain, data=replace(plain.data, own=plain.data.own / np.sqrt(n_effective)))
        edges = plain._edges(state, plain.closure(state))  # noqa: SLF001 - one of its own kind
        rows = edges.value(state.columns)
        rows = rows_at_blocks(self.blocks, rows)
        links = plain._links(state).value[..., None]  # noqa: SLF001
        return RowGroups(rows, plain._poses(state).value, links)  # noqa: SLF001

    def joint_rows(self, c_rows: Array, state: BatchState) -> Array:
        """Whitened closure rows (B, K, E) as one row per reading, (B, K, m)."""
        return joint_rows(self.layout, self.closure(state).by_reading, c_rows)

    def prior_values(self, state: BatchState) -> Array:
        """Values of the prior rows (B, c), before their targets are subtracted."""
        u = self.unknowns
        x = np.zeros((len(state.z), u.count))
        x[:, u.machine] = state.z
        x[:, u.effects] = state.columns
        # mounts have a prior of their position only
        mounts = x[:, u.mounts].reshape(len(x), -1, 6)
        mounts[..., 3:] = state.T_mount[..., :3, 3]
        # stations have a prior of their tilt only, by the direction of the base's z axis
        stations, up = x[:, u.stations].reshape(len(x), -1, 6), state.T_camera_base[..., :3, 2]
        stations[..., 0], stations[..., 1] = -up[..., 1], up[..., 0]
        return x @ self.prior.T

    def _edges(self, state: BatchState, c: Closure) -> EdgeRows:
        return edge_rows(self.blocks, self._view_data, c, self.theta(state), state.T_camera_base)

    @cached_property
    def _view_data(self) -> ViewData:
        return ViewData.of(self.blocks, self.data)

    def _poses(self, state: BatchState) -> PoseRows:
        return pose_rows(
            self.pose_blocks,
            self.pose_data,
            state.T_camera_base,
            state.T_base_platform,
            state.T_mount,
            state.columns,
        )

    def joint_noise_times(self, factor: Array, state: BatchState) -> Array:
        """Noise of the readings (B,) times a factor; at least the resolution of their closures."""
        least = least_joint_noise(self.layout, self.closure(state).by_reading)
        return np.maximum(factor * self.joint_noise, np.minimum(least, self.joint_noise))

    def by_readings(self, c: Closure, by: Array) -> Array:
        """Derivatives (B, K, E, k) of the closures, in standard deviations, by k changes of the
        readings.

        by : (K, m, k) changes of the readings.
        """
        return self._by_noise(c, closures_by_readings(self.layout, c.by_reading, by))

    def _by_noise(self, c: Closure, rows: Array) -> Array:
        """Rows (B, K, E, n) of the closures in standard deviations."""
        slopes = c.by_reading if self.slopes is None else self.slopes
        return by_noise(self.layout, self.joint_noise[:, None, None], slopes, rows)

    @cached_property
    def _in_use(self) -> Booleans:
        """Rows that are neither padding nor rejected, (B or 1, K, r)."""
        out = np.ones((max(len(group.weight) for group in self.row_groups), *self.extent), bool)
        for group in self.row_groups:
            out[..., group.rows] = np.repeat(group.weight > 0, group.whiten.shape[-1], axis=-1)
        return out

    def retract(self, state: BatchState, shared: Array, own: Array) -> BatchState:
        """Retract the state along a step, shared (B, na) and own (B, K, d).

        The part of the step that is a change of frames is applied as an exact rigid motion. Applied
        linearly, it would change the residuals of closures and edges, which have a small noise, at
        second order, and the minimum of the weak prior on the frames would lie along a curved
        valley.
        """
        # own unknowns of linked configurations are among the shared ones
        u, layout = self.unknowns, self.layout
        if len(self.link_blocks.linked):
            own = own.copy()
            each = (len(own), len(self.link_blocks.linked), own.shape[-1])
            own[:, self.link_blocks.linked] = shared[:, u.linked].reshape(each)
        # part of the machine's step that is a frame change (y) or another gauge change (slides)
        z = shared[:, u.machine]
        moves = z @ self.structure.moves_of.T
        y, slides = moves[:, :12], moves[:, 12:]
        by_moves = move_generators(layout, self.theta(state), self.nominal) @ moves[..., None]
        motion = own @ layout.own_motion.T
        steps = (
            shared[:, u.stations].reshape(len(z), u.n_stations, 6),
            motion[..., :6],
            shared[:, u.mounts].reshape(len(z), u.n_mounts, 6),
        )
        # steps of all poses, without the part by the frame change
        by_frames = (
            station_generators(state.T_camera_base),
            pose_generators(state.T_base_platform),
            mount_generators(state.T_mount, self.pose_blocks.on_platform),
        )
        less_frames = np.concatenate(by_frames, axis=1) @ y[:, None, :, None]
        steps = (np.concatenate(steps, axis=1) - less_frames[..., 0], y.reshape(-1, 2, 6))
        # all poses and both frames retracted at once, then the exact frame change
        still = np.broadcast_to(np.eye(4), (len(z), 2, 4, 4))  # the frames' own poses, E and F
        poses = (state.T_camera_base, state.T_base_platform, state.T_mount, still)
        poses = perturb(np.concatenate(poses, axis=1), np.concatenate(steps, axis=1))
        first_pose, first_mount = u.n_stations, poses.shape[1] - u.n_mounts - 2
        inner = BatchState(
            state.z + z - by_moves[..., 0] @ self.structure.to_free.T,
            poses[:, :first_pose],
            poses[:, first_pose:first_mount],
            state.columns + shared[:, u.effects],
            poses[:, first_mount:-2],
            state.internal + motion[..., 6:] + turned_back(layout, slides)[:, None],
        )
        inner = self._in_frames(inner, poses[:, -2:], slides)
        return self._closed(state, inner, shared, own)

    def _in_frames(self, state: BatchState, frames: Array, slides: Array) -> BatchState:
        """State after exact changes E and F of both frames (B, 2, 4, 4), and the other gauge
        changes (B, n).
        """
        layout, (e, f), back = self.layout, frames.swapaxes(0, 1), inverse(frames)
        theta = moved_centres(layout, slid(layout, self.theta(state), slides), e, f)
        theta = on_tangents(layout, theta, self.nominal)
        return replace(
            state,
            z=(theta - self.nominal) @ self.structure.to_free.T,
            T_camera_base=state.T_camera_base @ back[:, :1],
            T_base_platform=e[:, None] @ state.T_base_platform @ back[:, 1:],
            T_mount=moved_mounts(state.T_mount, self.pose_blocks.on_platform, e, f),
            internal=state.internal - turned_back(layout, slides)[:, None],
        )

    def _closed(
        self, state: BatchState, trial: BatchState, shared: Array, own: Array
    ) -> BatchState:
        """Trial state with poses at which the closures have the values that the linear model
        predicts.

        Applied to configurations whose closures are curved by more than their noise; without it the
        search converges slowly there.
        """
        layout = self.layout
        if layout.n_equations != layout.own_motion.shape[1]:
            return trial
        # values of the closures that the linear model predicts, then Newton steps of the poses to
        # them
        bent = self._bent(state, trial)
        if not bent.any():
            return trial
        c = self.closure(state)
        change = with_zero(shared[:, self.unknowns.machine] @ self.free.T)[:, c.index][:, None]
        wanted = c.rows.value + np.sum(c.by_theta * change, axis=-1)
        wanted = wanted + (by_own(layout, c.rows) @ own[..., None])[..., 0]
        for _ in range(CLOSING_NEWTON_STEPS):
            c = self.closure(trial)
            off, by_pose = (wanted - c.rows.value)[..., None], by_own(layout, c.rows)
            try:
                back = np.linalg.solve(by_pose, off)
            except np.linalg.LinAlgError:  # a singular pose among them
                back = np.linalg.pinv(by_pose) @ off
            step = np.where(bent[..., None], back[..., 0] @ layout.own_motion.T, 0.0)
            trial = replace(
                trial,
                T_base_platform=perturb(trial.T_base_platform, step[..., :6]),
                internal=trial.internal + step[..., 6:],
            )
        return trial

    def _bent(self, state: BatchState, trial: BatchState) -> Booleans:
        """Configurations (B, K) whose closures are curved over a step by more than their noise.

        All where cranks or sliders are read, which are far sharper than a board's poses, or where
        joint axes are constraints, which are almost exact. Otherwise by the second-order elongation
        ``d^2 / 2 l`` of a leg of length l whose end moves across by d. None near a singular pose,
        where the lengths hardly determine the pose and a Newton step would move it far away.
        """
        layout, before, after = self.layout, state.T_base_platform, trial.T_base_platform
        if len(layout.angles) or any(group.carrier.driven for group in layout.base):
            return np.ones(after.shape[:2], dtype=bool)
        change = (after - before)[..., :3, :]
        turned = np.linalg.norm(change[..., :3], axis=(-2, -1)) / np.sqrt(2)
        displacement = np.linalg.norm(change[..., 3], axis=-1) + self.structure.reach * turned
        length = rod_lengths(layout, self.nominal, self.data.joints)
        bent = displacement**2 > 2 * np.nanmin(length, axis=-1) * self.joint_noise[:, None]
        if bent.any():
            bent &= singularity_of(scaled_rows(self.closure(state))) > NEAR_SINGULAR
        return bent


def _in_rows(parts: Array) -> Array:
    """Rows (B, K, G, n, w) of G positions as one axis, (B, K, G n, w)."""
    return parts.reshape(*parts.shape[:2], parts.shape[2] * parts.shape[3], parts.shape[4])
