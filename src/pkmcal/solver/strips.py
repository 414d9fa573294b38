"""Strips of rows that depend on few shared unknowns, and the normal equations of all rows.

Most rows depend on few shared unknowns and stand in *strips* (:class:`Strips`), of which only
products are formed (:attr:`Eliminated.strips_normal`): a tenth of the arithmetic, and no digits are
lost against reduced rows, because no strip holds sharp rows such as readings. Together with the
other rows they make the normal equations of a step.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.solver.elimination import Linear, flat
from pkmcal.solver.ranks import unit_diagonal


@dataclass(frozen=True)
class StripLayout:
    """Indices of the rows and columns of N strips, the same for all runs.

    A strip is n rows of one configuration that depend on w of the shared unknowns, such as all
    edges of one leg in one image. Strips with the same columns are adjacent.

    n_shared, n_own : na, d.
    count : number of configurations, K.
    configuration : (N,) of each strip.
    rows : (N, n) number of each row in its configuration, -1 for padding.
    groups : slices of the strips with the same columns.
    columns : (groups, w) shared unknowns, na for padding.
    linked : (K, d) shared columns of each configuration whose own unknowns are shared, -1 for the
        other configurations; None where there are none.
    """

    n_shared: int
    n_own: int
    count: int
    configuration: Integers
    rows: Integers
    groups: list[slice]
    columns: Integers
    linked: Integers | None = None

    @classmethod
    @lru_cache(maxsize=64)  # each step of a search without strips needs its indices
    def none(cls, n_shared: int, n_own: int, count: int) -> StripLayout:
        """Layout without strips."""
        empty = np.zeros((0, 0), dtype=int)
        return cls(n_shared, n_own, count, empty.ravel(), empty, [], empty)

    @cached_property
    def own_target(self) -> Integers:
        """Flat indices, in sums (K, d, d + na + 2), of the strips' products (N, d + w + 1, d) with
        the own unknowns' columns: own unknowns, shared unknowns, padding, residual.
        """
        d, na = self.n_own, self.n_shared
        column = np.empty((len(self.configuration), d + self.columns.shape[1] + 1), dtype=int)
        for cut, columns in zip(self.groups, self.columns, strict=True):
            column[cut, d:-1] = d + columns
        column[:, :d], column[:, -1] = np.arange(d), d + na + 1
        row = d * self.configuration[:, None] + np.arange(d)
        target = row[:, None] * (d + na + 2) + column[..., None]
        return target.astype(np.int32).ravel()  # the largest array that a search keeps

    @cached_property
    def shared_target(self) -> Integers:
        """Flat indices, in sums (na + 2, na + 2), of the groups' products by shared unknowns."""
        residual = np.full((len(self.columns), 1), self.n_shared + 1)
        column = np.concatenate([self.columns, residual], axis=1)
        return (column[:, :, None] * (self.n_shared + 2) + column[:, None]).ravel()

    @cached_property
    def linked_places(self) -> tuple[Integers, Integers]:
        """Configurations (n,) whose own unknowns are shared, and their shared columns (n, d)."""
        if self.linked is None:
            return np.zeros(0, dtype=int), np.zeros((0, self.n_own), dtype=int)
        which = np.flatnonzero(self.linked[:, 0] >= 0) if self.n_own else np.zeros(0, dtype=int)
        return which, self.linked[which]


class Strips(NamedTuple):
    """Numbers (B, d + w + 1, N, n) of strips: derivatives by the own unknowns, by the shared
    unknowns of their columns, and the residual.
    """

    layout: StripLayout
    numbers: Array


class Compact(NamedTuple):
    """Residuals and Jacobian as :class:`Linear`, with strips; rows in no strip come last among the
    rows of their configuration.

    value, usable, shared_value, shared_by : as in :class:`Linear`.
    strips : derivatives and residuals of the rows in strips.
    by_shared, by_own : (B, K, r', na) and (B, K, r', d) of the rows in no strip, which are the last
    r' rows of each configuration.
    """

    value: Array
    usable: Booleans
    shared_value: Array
    shared_by: Array
    strips: Strips
    by_shared: Array
    by_own: Array

    def linear(self) -> Linear:
        """Residuals and Jacobian as dense arrays."""
        layout, numbers = self.strips
        (*batch, n_rows), d, na = self.value.shape, layout.n_own, layout.n_shared
        by_own, by_shared = (
            np.zeros((*batch, n_rows + 1, d)),
            np.zeros((*batch, n_rows + 1, na + 1)),
        )
        at = layout.configuration[:, None]
        by_row = np.moveaxis(numbers, 1, -1)
        by_own[:, at, layout.rows] = by_row[..., :d]
        for cut, columns in zip(layout.groups, layout.columns, strict=True):
            place = at[cut, ..., None], layout.rows[cut, :, None], columns
            by_shared[:, *place] = by_row[:, cut, :, d:-1]
        by_own, by_shared = by_own[:, :, :-1], by_shared[:, :, :-1, :-1]
        for k, columns in zip(*layout.linked_places, strict=True):
            by_shared[:, k, :, columns] = np.moveaxis(by_own[:, k], -1, 0)
            by_own[:, k] = 0.0
        rest = slice(n_rows - self.by_own.shape[2], None)
        by_own[:, :, rest], by_shared[:, :, rest] = self.by_own, self.by_shared
        return Linear(self.value, by_shared, by_own, self.usable, self.shared_value, self.shared_by)


def compact(linear: Linear) -> Compact:
    """A dense Jacobian as `Compact`, without strips."""
    (*_, n_own), (n_runs, count, _, n_shared) = linear.by_own.shape, linear.by_shared.shape
    layout = StripLayout.none(n_shared, n_own, count)
    strips = Strips(layout, np.zeros((n_runs, n_own + 1, 0, 0)))
    rows = linear.value, linear.usable, linear.shared_value, linear.shared_by
    return Compact(*rows, strips, linear.by_shared, linear.by_own)


class Eliminated(NamedTuple):
    """Configurations after the elimination of their own unknowns, ``by_own = Q R``.

    J (r, na) is a configuration's Jacobian by the shared unknowns; index s marks the rows in
    strips.

    For rows in no strip: q (B, K, r', d), the reduced rows (B, K, r', na) and their reduced
    residuals (B, K, r').

    For the strips' rows J_s only their products, which are far smaller than the rows: normal
    J_s^T J_s (B, na, na), slope J_s^T value (B, na), along_strips Q_s^T J_s (B, K, d, na), own
    Q_s^T Q_s (B, K, d, d), which includes the damping's rows, for which J is zero.
    """

    inverse: Array
    along: Array
    fitted: Array
    damped: Array
    q: Array
    rows: Array
    residual: Array
    normal: Array
    slope: Array
    along_strips: Array
    own: Array

    @property
    def strips_normal(self) -> Array:
        """Normal matrices (B, na, na) of the strips' reduced rows ``J_s - Q_s W`` with W = Q^T J:
        ``J_s^T J_s - V^T W - W^T V`` with ``V = Q_s^T J_s - Q_s^T Q_s W / 2``.

        Readings a thousand times sharper than edges do not cancel in these differences: W is in
        units of the own unknowns' directions, which edges determine as well as the shared ones.
        """
        half = self.along_strips - 0.5 * (self.own @ self.along)
        both = flat(half).mT @ flat(self.along)
        return self.normal - both - both.mT

    @property
    def rows_normal(self) -> Array:
        """Normal matrices (B, na, na) of the reduced rows in no strip."""
        rows = flat(self.rows)
        return rows.mT @ rows


def eliminate_strips(rows: Compact, damping: Array) -> Eliminated:
    """Eliminate the own unknowns with Marquardt damping (B,), zero for none.

    The damping's rows sqrt(damping) diag(column norms) are appended, so that a configuration that
    its data do not determine stays solvable.
    """
    (layout, numbers), by_own = rows.strips, rows.by_own
    n_runs, d, na = len(numbers), layout.n_own, layout.n_shared
    # products of the strips' columns, summed by configuration and over all configurations
    strips = numbers.swapaxes(1, 2)
    products = strips @ np.ascontiguousarray(strips[:, :, :d].mT)
    sums = _summed(products, layout.own_target, (n_runs, layout.count, d, d + na + 2))
    square, with_shared, with_value = sums[..., :d], sums[..., d:-2], sums[..., -1:]
    normal, slope = _group_sums(layout, numbers[:, d:])
    for k, columns in zip(*layout.linked_places, strict=True):
        # own unknowns of linked configurations are shared: their products count there
        normal[:, columns] += with_shared[:, k]
        normal[:, :, columns] += with_shared[:, k].mT
        normal[:, columns[:, None], columns] += square[:, k]
        slope[:, columns] += with_value[:, k, :, 0]
        square[:, k], with_shared[:, k], with_value[:, k] = 0.0, 0.0, 0.0
    # R of the own Jacobian: root of the strips' products, other rows, damping
    norms = np.einsum("...ii->...i", square) + np.einsum("...nm,...nm->...m", by_own, by_own)
    damped = damping[:, None, None] * np.where(norms > 0, norms, 1.0)
    extra = np.sqrt(damped)[..., None] * np.eye(d)
    beside = extra
    if (none := ~norms.any(axis=-1)).any():  # nothing to eliminate: R = 1, for it to be invertible
        beside = np.where(none[..., None, None], np.eye(d), extra)
    r = np.linalg.qr(np.concatenate([_root(square), by_own, beside], axis=-2), mode="r")
    inverse = np.linalg.inv(r)

    # Q^T J and Q^T value from both sorts of rows
    q = by_own @ inverse
    value = rows.value[..., rows.value.shape[-1] - q.shape[-2] :, None]
    along_strips = inverse.mT @ with_shared
    along = along_strips + q.mT @ rows.by_shared
    fitted = inverse.mT @ with_value + q.mT @ value
    return Eliminated(
        inverse,
        along,
        fitted[..., 0],
        damped,
        q,
        rows.by_shared - q @ along,
        (value - q @ fitted)[..., 0],
        normal,
        slope,
        along_strips,
        inverse.mT @ (square + extra**2) @ inverse,
    )


def _group_sums(layout: StripLayout, numbers: Array) -> tuple[Array, Array]:
    """J_s^T J_s (B, na, na) and J_s^T value (B, na) of strips (B, w + 1, N, n)."""
    (n_runs, width), na = numbers.shape[:2], layout.n_shared
    products = np.empty((n_runs, len(layout.groups), width, width))
    for k, cut in enumerate(layout.groups):
        columns = numbers[:, :, cut].reshape(n_runs, width, -1)
        np.matmul(columns, columns.mT, out=products[:, k])
    sums = _summed(products, layout.shared_target, (n_runs, na + 2, na + 2))
    return sums[:, :na, :na], sums[:, :na, -1]


def _summed(parts: Array, target: Integers, shape: tuple[int, ...]) -> Array:
    """Sums of the shape (B, ...): the parts of each run added at the flat indices ``target``."""
    out = np.zeros(shape)
    for total, own in zip(out.reshape(len(out), -1), parts.reshape(len(out), -1), strict=True):
        np.add.at(total, target, own)
    return out


def _root(square: Array) -> Array:
    """Square roots (..., d, d) with ``root^T root = square``; a square may be singular."""
    if not square.any():  # no strips
        return square
    try:
        return np.linalg.cholesky(square).mT
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(square)
        return np.sqrt(np.maximum(values, 0.0))[..., None] * vectors.mT


class NormalPart(NamedTuple):
    """Reduced normal equations of some configurations' rows, and the factors from which their own
    unknowns' step follows, so that the rows need not be kept.

    The rows themselves are not stored.

    matrix, gradient : (B, na, na) and (B, na) by the shared unknowns.
    cost : (B,) sum of squares over usable rows.
    usable : (B, K, r) as in :class:`Linear`.
    along, fitted, inverse, damped : as in :class:`Eliminated`.
    """

    matrix: Array
    gradient: Array
    cost: Array
    usable: Booleans
    along: Array
    fitted: Array
    inverse: Array
    damped: Array

    def own(self, shared: Array) -> Array:
        """Step of the own unknowns (B, K, d) for a step of the shared unknowns (B, na)."""
        right = self.fitted[..., None] + self.along @ shared[:, None, :, None]
        return -(self.inverse @ right)[..., 0]


def _part(rows: Compact, damping: Array) -> NormalPart:
    """Reduced normal equations of one part."""
    eliminated_part = eliminate_strips(rows, damping)
    taken_up = flat(eliminated_part.along_strips).mT @ flat(eliminated_part.fitted[..., None])
    residual = flat(rows.by_shared).mT @ flat(eliminated_part.residual[..., None])
    gradient = eliminated_part.slope + (residual - taken_up)[..., 0]
    return NormalPart(
        eliminated_part.strips_normal
        + eliminated_part.rows_normal
        + rows.shared_by.T @ rows.shared_by,
        gradient + rows.shared_value @ rows.shared_by,
        cost_of(rows.value, rows.shared_value, rows.usable),
        rows.usable,
        eliminated_part.along,
        eliminated_part.fitted,
        eliminated_part.inverse,
        eliminated_part.damped,
    )


class NormalEquations(NamedTuple):
    """Reduced normal equations of all parts; see :class:`NormalPart`."""

    matrix: Array
    gradient: Array
    cost: Array
    parts: list[NormalPart]

    def step(self, damping: Array) -> tuple[Array, list[Array]]:
        """Levenberg-Marquardt step: shared (B, na), and own (B, K, d) of each part."""
        scaled, scale = unit_diagonal(self.matrix)
        # at least a few rounding units, so that an unidentified direction gives no step
        np.einsum("...ii->...i", scaled)[...] += np.maximum(damping, 1e-15)[:, None]
        right = (self.gradient / scale)[..., None]
        shared = -np.linalg.solve(scaled, right)[..., 0] / scale
        return shared, [part.own(shared) for part in self.parts]

    def promise(self, shared: Array, own: list[Array]) -> tuple[Array, Array]:
        """Decrease of the linear model's cost along a step to first order, and the squared norm of
        its change of all residuals, (B,) each.

        With ``by_own = Q R`` the residuals' change is ``rows shared - Q fitted``, so that both
        follow from the reduced rows; the damping's own part is subtracted.
        """
        fitted = total(np.sum(part.fitted**2, axis=(1, 2)) for part in self.parts)
        damped = zip(self.parts, own, strict=True)
        size2 = (shared[:, None] @ self.matrix @ shared[..., None])[:, 0, 0] + fitted
        size2 = size2 - total(np.sum(part.damped * y**2, axis=(1, 2)) for part, y in damped)
        first = 2 * (fitted - np.sum(shared * self.gradient, axis=1))
        return first, np.maximum(size2, 0.0)


def total(parts: Iterable[Array]) -> Array:
    """Sum of arrays."""
    return reduce(np.add, parts)


def normal_equations(parts: Iterable[Compact], damping: Array) -> NormalEquations:
    """Normal equations of all parts, each reduced before the next one is formed."""
    done: list[NormalPart] = []
    for rows in parts:
        if done:  # the rows on shared unknowns only stand in the first part
            none = rows.shared_value[:, :0], rows.shared_by[:0]
            rows = rows._replace(shared_value=none[0], shared_by=none[1])
        done.append(_part(rows, damping))
    sums = zip(*((part.matrix, part.gradient, part.cost) for part in done), strict=True)
    matrix, gradient, cost = (total(each) for each in sums)
    return NormalEquations(matrix, gradient, cost, done)


def cost_of(value: Array, shared_value: Array, usable: Booleans) -> Array:
    """Sum of squares (B,) over usable rows; infinite where one is NaN, for a leg left the image."""
    used = np.where(usable, value, 0.0).reshape(len(value), -1)
    total = np.sum(used * used, axis=1) + np.sum(shared_value * shared_value, axis=1)
    return np.where(np.isfinite(total), total, np.inf)
