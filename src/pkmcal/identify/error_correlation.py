"""Covariance of an estimate whose edges have correlated errors.

A highlight or a mirrored object that shifts one edge of a line shifts its neighbours too: the
errors of two edges whose normals enclose an angle have the correlation ``exp(-angle /
SHADING_CORRELATION_ANGLE)`` (:class:`~pkmcal.measurements.line_cells.LineCells`). This applies to
the part of the shift's variance that is shading, and to a share ``c`` of the tilt's variance that
is estimated from the data.
The estimate treats the edges as independent, with the variance of shading multiplied by the number
of edges that share it. The inverse of its normal matrix would be the right covariance if all these
edges affected the result in the same way; where a platform's pose absorbs their common error it is
far too large, and for tilts too small.

With J the rows of the edges, in the noise of the estimate and with the own unknowns eliminated, and
S the covariance of their errors in that noise, the estimate has the covariance

    C + C J^T (S - 1) J C,      C the inverse of the normal matrix

(Huber 1967; Liang and Zeger 1986). The rows are evaluated once, and only their sums by cells are
stored.

c is estimated from the tilts' residuals x. With P the correlations of all pairs of edges at c = 1,
the expectation of ``x^T P x`` is ``s^2 (tr P Q + c tr P Q P Q)``, with Q = 1 - H the complement of
the hat matrix and s^2 the tilts' mean square (MINQUE; Rao 1971). c is the mean of its normal
distribution truncated to [0, 1], so that it tends to one half where the data contain little
information about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.covariance import Information
from pkmcal.identify.reduced_edges import reduced_edges
from pkmcal.identify.scatter import NUMBERS_AN_EDGE, shift_squares
from pkmcal.levels import ROUNDING
from pkmcal.measurements.line_cells import LineCells
from pkmcal.solver.search import take


@dataclass(frozen=True)
class ErrorCorrelationOptions:
    """Constants of the estimate of correlated errors."""

    # largest number of edges whose tilts are compared, of configurations evenly among all: c then
    # has a standard deviation of a few hundredths
    most_tilts: int = 800
    # mean of c without data
    uninformed_share: float = 0.5


ERROR_CORRELATION = ErrorCorrelationOptions()


def covariance_of_correlated(
    info: Information, options: ErrorCorrelationOptions = ERROR_CORRELATION
) -> Array:
    """Covariance (B, na, na) of the shared unknowns at a solution, with correlated errors of edges.

    An unidentifiable direction has a huge variance.
    """
    if not info.problem.blocks.cells.count.size:
        return info.covariance
    out = info.covariance.copy()
    for run in range(len(out)):
        one = info
        if len(out) > 1:  # a single run, of many edges, is not copied
            at = np.array([run])
            normal = None if info.normal is None else info.normal[at]
            one = Information(info.problem.select(at), take(info.state, at), normal)
        half = one.root[0]
        out[run] += half @ _beside(one, options) @ half.T
    return out


def _beside(info: Information, options: ErrorCorrelationOptions) -> Array:
    """Correction ``F^T J^T (S - 1) J F`` (na, na) of one run, with F the root of the covariance."""
    half, cells = info.root, info.problem.blocks.cells
    na = half.shape[-1]
    out, tilts = np.zeros((2, na, na))
    sums = np.zeros((NUMBERS_AN_EDGE, len(cells.count) + 1, na))  # the last: edges in no cell
    every = -(-int(cells.count.sum()) // options.most_tilts)
    compared = list[_Tilts]()
    for piece in reduced_edges(info):
        blocks, data, (row, place) = piece.problem.blocks, piece.problem.data, piece.at
        size = shift_squares(blocks, data)[0]
        own, scale = data.own[0] ** 2 * size, data.scale[0] ** 2
        used = (place >= 0) & (data.weight[0][row, place] > 0)
        cell = np.where(used, blocks.cell[row, place], -1)
        # share of an edge's variance that is shading, and its square root for a single edge
        part = np.where(cell >= 0, (own / (own + scale))[row, place], 0.0)
        once = np.sqrt(part / np.maximum(blocks.n_effective, 1.0)[row, place])
        for cut, shared in piece.shared(half):
            shift, tilt = (
                shared[0, ..., number::NUMBERS_AN_EDGE].swapaxes(1, 2).reshape(-1, na)
                for number in range(NUMBERS_AN_EDGE)
            )
            mine = cell[cut].ravel()
            # sums by cell, and -J^T J of the correlated part
            out -= (part[cut].reshape(-1, 1) * shift).T @ shift
            np.add.at(sums[0], mine, once[cut].reshape(-1, 1) * shift)
            np.add.at(sums[1], mine, tilt)
            present = mine >= 0
            tilts += tilt[present].T @ tilt[present]
            # tilts of some configurations, to estimate c
            number = np.broadcast_to(row[cut] + piece.first, cell[cut].shape).ravel()
            some = present & (number % every == 0)
            value = piece.value[0, cut, 1::NUMBERS_AN_EDGE].ravel()
            taken = piece.own[0, cut, :, 1::NUMBERS_AN_EDGE].swapaxes(1, 2)
            taken = taken.reshape(len(mine), -1)
            compared.append(_Tilts(*(x[some] for x in (value, tilt, taken, number, mine))))
    # J^T S J from the sums by cell
    by_tilts = -tilts
    for own, shift_correlation, tilt_correlation in cells.correlated_groups():
        shift, tilt = sums[:, own]
        out += shift.T @ shift_correlation @ shift
        by_tilts += tilt.T @ tilt_correlation @ tilt
    every_tilt = _Tilts(*(np.concatenate(part) for part in zip(*compared, strict=True)))
    return out + every_tilt.correlated_share(cells, options) * by_tilts


class _Tilts(NamedTuple):
    """Tilts of n edges of one run.

    value : (n,) residuals.
    shared, own : (n, na) and (n, d) rows by shared and own unknowns in orthonormal bases; the hat
        matrix is the sum of their products.
    configuration, cell : (n,).
    """

    value: Array
    shared: Array
    own: Array
    configuration: Integers
    cell: Integers

    def correlated_share(self, cells: LineCells, options: ErrorCorrelationOptions) -> float:
        """Estimate of c, see the module's docstring."""
        from scipy.special import ndtr

        together = self.configuration[:, None] == self.configuration
        taken = self.shared @ self.shared.T + np.where(together, self.own @ self.own.T, 0.0)
        rest = np.eye(len(self.value)) - taken
        square = self.value @ self.value / max(np.trace(rest), ROUNDING)
        pairs = np.zeros_like(rest)
        for own, _, correlation in cells.correlated_groups():
            mine = np.flatnonzero((self.cell >= own.start) & (self.cell < own.stop))
            place = self.cell[mine] - own.start
            pairs[np.ix_(mine, mine)] = correlation[np.ix_(place, place)] - np.eye(len(mine))
        product = pairs @ rest
        information = np.sum(product * product.T)
        if square == 0 or information <= ROUNDING:
            return options.uninformed_share
        values = (self.value @ pairs @ self.value / square - np.trace(product)) / information
        sigma = np.sqrt(2 / information)
        low, high = -values / sigma, (1 - values) / sigma
        density = np.exp(-(np.array([low, high]) ** 2) / 2) / np.sqrt(2 * np.pi)
        within = ndtr(high) - ndtr(low)
        if within < ROUNDING:
            return float(np.clip(values, 0.0, 1.0))
        return float(values + sigma * (density[0] - density[1]) / within)
