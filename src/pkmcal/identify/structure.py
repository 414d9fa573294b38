"""Structure of a problem: all that does not depend on weights, noise or state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.gauge import move_generators
from pkmcal.identify.link_rows import LinkBlocks
from pkmcal.identify.unknowns import Unknowns
from pkmcal.measurements.edges import EdgeBlocks
from pkmcal.mechanisms.closure import platform_ends
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.solver.strips import StripLayout


class _Turn(NamedTuple):
    """Linear map from the columns of strips, which are parameters, to unknowns, where these differ.

    by : (groups, w, w') for each group of strips with the same columns.
    columns : (groups, w') numbers of the shared unknowns.
    """

    by: Array
    columns: Integers

    @classmethod
    def of(cls, parameters: Integers, turn: Array) -> _Turn:
        """Map for strips with the columns ``parameters`` (groups, w).

        turn : (width, na) map of all columns.
        """
        used = [np.flatnonzero(np.any(turn[own] != 0, axis=0)) for own in parameters]
        most = max((len(own) for own in used), default=0)
        columns = np.full((len(used), most), turn.shape[1])
        by = np.zeros((*parameters.shape, most))
        for k, own in enumerate(used):
            columns[k, : len(own)] = own
            by[k, :, : len(own)] = turn[parameters[k]][:, own]
        return cls(by, columns)


@dataclass(frozen=True, eq=False)
class Structure:
    """Structure of a problem (:class:`~pkmcal.identify.problem.Problem`) with these parts.

    Evaluated lazily, and shared by all problems of the same measurements.
    """

    layout: LimbLayout
    nominal: Array
    free: Array
    unknowns: Unknowns
    blocks: EdgeBlocks
    frames: Array
    link_blocks: LinkBlocks

    def made_of(self, *parts: object) -> bool:
        """Whether the structure has these parts (the same objects), in their order."""
        own = (
            self.layout, self.nominal, self.free, self.unknowns, self.blocks, self.frames,
            self.link_blocks,
        )  # fmt: skip
        return all(mine is other for mine, other in zip(own, parts, strict=True))

    @cached_property
    def _parts(self) -> dict[tuple[int, int], Structure]:
        """Cache of the structures of some configurations."""
        return {}

    def among(self, configurations: slice) -> Structure:
        """Structure of some configurations."""
        key = configurations.start, configurations.stop
        if key not in self._parts:
            self._parts[key] = replace(
                self,
                blocks=self.blocks.among(configurations),
                link_blocks=self.link_blocks.among(configurations),
            )
        return self._parts[key]

    @cached_property
    def to_free(self) -> Array:
        """(nz, P) map from changes of the parameters to changes of z."""
        return np.linalg.pinv(self.free)

    @cached_property
    def choice(self) -> Integers | None:
        """Parameter (nz,) of each free unknown if each is exactly one parameter; otherwise None
        (tied parameters, axes).
        """
        alone = np.all((self.free != 0).sum(axis=0) == 1) and np.all(self.free.sum(axis=0) == 1)
        return np.argmax(self.free, axis=0) if alone else None

    @cached_property
    def width(self) -> int:
        """Number of columns of an edge's row before the map to unknowns.

        The shared unknowns, one column for each parameter where parameters are tied or are axes,
        and one for padding.
        """
        return self.unknowns.count + 1 + (0 if self.choice is not None else self.nominal.size)

    @cached_property
    def column(self) -> Integers:
        """Column (P + 1,) of each parameter's derivatives; the last one is for padding."""
        if self.choice is None:
            return self.unknowns.count + np.arange(self.nominal.size + 1)
        out = np.full(self.nominal.size + 1, self.unknowns.count)
        out[self.choice] = np.arange(len(self.choice))
        return out

    @cached_property
    def moves_of(self) -> Array:
        """Gauge changes (12 + n, nz) by a step of z: least-squares fit at the nominal model.

        The remainder of the step is small and applied linearly.
        """
        by_moves = self.to_free @ move_generators(self.layout, self.nominal, self.nominal)
        return self.frames @ np.linalg.pinv(by_moves @ self.frames)

    @cached_property
    def reach(self) -> float:
        """Largest nominal distance of a joint from the platform's origin, m."""
        ends = platform_ends(self.layout, self.nominal, np.eye(4))
        return float(np.linalg.norm(ends.b, axis=-1).max())

    @cached_property
    def strips(self) -> StripLayout:
        """Layout of the views' rows as strips."""
        views, columns = self.blocks.views, self.strip_parameters
        n_rows = 2 * self.blocks.side.shape[-1]
        place = n_rows * (views.place % max(self.blocks.present.shape[1], 1))
        rows = np.where(views.present[..., None], place[..., None] + np.arange(n_rows), -1)
        return StripLayout(
            n_shared=self.unknowns.count,
            n_own=self.layout.own_motion.shape[1],
            count=len(self.blocks.present),
            configuration=views.configuration,
            rows=rows.reshape(len(rows), rows.shape[1] * n_rows),
            groups=views.groups,
            columns=columns if self.turn is None else self.turn.columns,
            linked=self.linked_columns if len(self.link_blocks.linked) else None,
        )

    @cached_property
    def linked_columns(self) -> Integers:
        """(K, d) shared columns of each configuration's own unknowns; -1 where it is not linked."""
        d, number = self.layout.own_motion.shape[1], self.link_blocks.number
        columns = self.unknowns.linked.start + d * number[:, None] + np.arange(d)
        return np.where(number[:, None] < 0, -1, columns)

    @cached_property
    def strip_parameters(self) -> Integers:
        """Columns (groups, w) on which the edges of each group of views depend: the parameters of
        both ends, offset joints' axes, the station, the radii, the effects.
        """
        u, layout, views = self.unknowns, self.layout, self.blocks.views
        first = np.array([cut.start for cut in views.groups], dtype=int)
        leg, none = views.leg[first], self.width - 1
        radii = np.full((len(first), len(self.own_radii)), none)
        for k, one in enumerate(leg):
            radii[k, : len(layout.radius[one])] = self.column[layout.radius[one]]
        effects = self.blocks.view_columns.of_groups
        ends = [layout.b_index[leg], layout.a_index[leg]]
        if len(layout.offsets):
            ends.append(layout.offset_axes[leg])
        parts = [self.column[index] for index in ends]
        parts += [numbered_columns(u.stations, views.station[first], 6), radii]
        parts += [np.where(effects < 0, none, u.effects.start + effects)]
        return np.concatenate(parts, axis=1)

    @cached_property
    def own_radii(self) -> Array:
        """Indicator (radii, N, n) of the radius, among those of its leg, on which each row
        depends.
        """
        views, n_rows = self.blocks.views, 2 * self.blocks.side.shape[-1]
        radii = max((len(self.layout.radius[leg]) for leg in np.unique(views.leg)), default=0)
        used = views.taken(self.blocks.tube) == np.arange(radii)[:, None, None]
        return np.repeat(used.astype(float), n_rows, -1)

    @cached_property
    def turn(self) -> _Turn | None:
        """Map from columns of strips to unknowns, where parameters are tied or are axes."""
        if self.choice is not None:
            return None
        turn = np.eye(self.width, self.unknowns.count)
        turn[self.unknowns.count : -1, self.unknowns.machine] = self.free
        return _Turn.of(self.strip_parameters, turn)

    @cached_property
    def closure_index(self) -> Integers:
        """Parameters (E, n) on which the closures depend.

        Rods on one motor share the noise of its reading, so each depends on all parameters.
        """
        if self.layout.shares_motors:
            return np.tile(np.arange(self.nominal.size), (self.layout.n_equations, 1))
        return self.layout.closure_index

    @cached_property
    def closure_turn(self) -> Array:
        """Map (E, n, nz) from derivatives by ``closure_index`` to derivatives by the free
        unknowns.
        """
        return np.pad(self.free, ((0, 1), (0, 0)))[self.closure_index]


def numbered_columns(part: slice, number: Integers, width: int) -> Integers:
    """Columns (K, G, width) of unknowns with ``width`` columns each, by their number (K, G)."""
    return part.start + width * number[..., None] + np.arange(width)
