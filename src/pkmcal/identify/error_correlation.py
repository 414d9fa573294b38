"""What edges that err alike do to the covariance of an estimate.

What moves one edge of a line, a highlight or something mirrored, moves its neighbours too: errors
of two edges whose normals are an angle apart are alike by ``exp(-angle /
SHADING_CORRELATION_ANGLE)`` (:class:`~pkmcal.measurements.line_cells.LineCells`), the shift's by
the part of it that is shading, the tilt's by a part ``c`` that the data tell. The estimate counts
every edge by itself, and the shading of its shift as often as edges share it. Were its normal
matrix inverted, that would be the covariance where it makes the same of all of them; but where a
platform's pose takes up what they have in common it is far too careful, and of tilts too sure.

With J the rows of the edges in the noise that they count with, the own unknowns eliminated, and S
the covariance of their errors there, the estimate has the covariance

    C + C J^T (S - 1) J C,      C the inverse of the normal matrix

(Huber 1967; Liang and Zeger 1986). The rows are gone through once, and their sums by cells are all
that is kept.

c is found from the tilts' residuals x: of their products in pairs by how alike they may be, P,
``x^T P x`` is expected to be ``s^2 (tr P Q + c tr P Q P Q)``, with Q = 1 - H the hat matrix's
complement and s^2 their mean square (MINQUE; Rao 1971). Where that tells little, c is the mean of
what it allows between none and all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.covariance import Information
from pkmcal.identify.reduced_edges import reduced_edges
from pkmcal.identify.scatter import NUMBERS_AN_EDGE, shift_squares
from pkmcal.measurements.line_cells import LineCells
from pkmcal.solver.search import take

MOST_TILTS_COMPARED = 800
"""Edges, of configurations evenly among all, whose tilts tell how alike they are, if there are
more: c is then known to a few hundredths."""
LEAST_TILT_INFORMATION = 1e-9
"""Below it the pairs of tilts, or a probability, are rounding."""
UNINFORMED_CORRELATED_SHARE = 0.5
"""The mean of a part of which nothing is told."""


def covariance_of_correlated(info: Information) -> Array:
    """Covariance (B, na, na) of the shared unknowns at a solution, with what edges have in common;
    a direction that nothing fixes has a huge variance.
    """
    if not info.problem.blocks.cells.count.size:
        return info.covariance
    out = info.covariance.copy()
    for run in range(len(out)):
        one = info if len(out) == 1 else _of_run(info, run)  # of many edges no copy is made
        half = one.root[0]
        out[run] += half @ _beside(one) @ half.T
    return out


def _of_run(info: Information, run: int) -> Information:
    """What one run's problem says alone."""
    at = np.array([run])
    normal = None if info.normal is None else info.normal[at]
    return Information(info.problem.select(at), take(info.state, at), normal)


def _beside(info: Information) -> Array:
    """``F^T J^T (S - 1) J F`` (na, na) of one run."""
    half, cells = info.root, info.problem.blocks.cells
    na = half.shape[-1]
    out, tilts = np.zeros((2, na, na))
    sums = np.zeros((NUMBERS_AN_EDGE, len(cells.count) + 1, na))  # the last of what is in none
    every = -(-int(cells.count.sum()) // MOST_TILTS_COMPARED)
    compared = list[_Tilts]()
    for piece in reduced_edges(info):
        blocks, data, (row, place) = piece.problem.blocks, piece.problem.data, piece.at
        size = shift_squares(blocks, data)[0]
        own, scale = data.own[0] ** 2 * size, data.scale[0] ** 2
        used = (place >= 0) & (data.weight[0][row, place] > 0)
        cell = np.where(used, blocks.cell[row, place], -1)
        # the part of what it counts with that is shading, and that of its own shading alone
        part = np.where(cell >= 0, (own / (own + scale))[row, place], 0.0)
        once = np.sqrt(part / np.maximum(blocks.n_effective, 1.0)[row, place])
        for cut, shared in piece.shared(half):
            shift, tilt = (
                shared[0, ..., number::NUMBERS_AN_EDGE].swapaxes(1, 2).reshape(-1, na)
                for number in range(NUMBERS_AN_EDGE)
            )
            mine = cell[cut].ravel()
            out -= (part[cut].reshape(-1, 1) * shift).T @ shift
            np.add.at(sums[0], mine, once[cut].reshape(-1, 1) * shift)
            np.add.at(sums[1], mine, tilt)
            above_limit = mine >= 0
            tilts += tilt[above_limit].T @ tilt[above_limit]
            number = np.broadcast_to(row[cut] + piece.first, cell[cut].shape).ravel()
            some = above_limit & (number % every == 0)
            value = piece.value[0, cut, 1::NUMBERS_AN_EDGE].ravel()
            taken = piece.own[0, cut, :, 1::NUMBERS_AN_EDGE].swapaxes(1, 2)
            taken = taken.reshape(len(mine), -1)
            compared.append(_Tilts(*(x[some] for x in (value, tilt, taken, number, mine))))
    by_tilts = -tilts
    for own, shift_correlation, tilt_correlation in cells.correlated_groups():
        shift, tilt = sums[:, own]
        out += shift.T @ shift_correlation @ shift
        by_tilts += tilt.T @ tilt_correlation @ tilt
    every_tilt = _Tilts(*(np.concatenate(part) for part in zip(*compared, strict=True)))
    return out + every_tilt.correlated_share(cells) * by_tilts


class _Tilts(NamedTuple):
    """Tilts of n edges: residuals value (n,), shared (n, na) and own (n, d) what unknowns take up
    of them, their configurations and cells (n,).
    """

    value: Array
    shared: Array
    own: Array
    configuration: Integers
    cell: Integers

    def correlated_share(self, cells: LineCells) -> float:
        """c; see the module."""
        from scipy.special import ndtr

        together = self.configuration[:, None] == self.configuration
        taken = self.shared @ self.shared.T + np.where(together, self.own @ self.own.T, 0.0)
        rest = np.eye(len(self.value)) - taken
        square = self.value @ self.value / max(np.trace(rest), LEAST_TILT_INFORMATION)
        pairs = np.zeros_like(rest)
        for own, _, correlation in cells.correlated_groups():
            mine = np.flatnonzero((self.cell >= own.start) & (self.cell < own.stop))
            place = self.cell[mine] - own.start
            pairs[np.ix_(mine, mine)] = correlation[np.ix_(place, place)] - np.eye(len(mine))
        product = pairs @ rest
        information = np.sum(product * product.T)
        if square == 0 or information <= LEAST_TILT_INFORMATION:
            return UNINFORMED_CORRELATED_SHARE
        values = (self.value @ pairs @ self.value / square - np.trace(product)) / information
        sigma = np.sqrt(2 / information)
        low, high = -values / sigma, (1 - values) / sigma
        density = np.exp(-(np.array([low, high]) ** 2) / 2) / np.sqrt(2 * np.pi)
        within = ndtr(high) - ndtr(low)
        if within < LEAST_TILT_INFORMATION:
            return float(np.clip(values, 0.0, 1.0))
        return float(values + sigma * (density[0] - density[1]) / within)
