"""What would be gained if something were free that the model takes for granted: score tests.

A *departure* is a change of what was measured, k numbers of it, that the model does not have: an
encoder's scale, a lens that is another, a camera that was pushed half-way. With J the Jacobian of
the estimate at its minimum, r its residuals and G the derivatives of the rows by a departure, all
in standard deviations, what J leaves of G is ``H = (I - J J^+) G``, and

    value = -(H^T H)^-1 H^T r,    chi2 = r^T H (H^T H)^-1 H^T r,    moved = -J^+ G value

are what a further estimate with the departure free would find to first order (Rao 1948), without
making it: the value that fits, the gain in chi2, and what it does to the unknowns. Under the model
chi2 has as many degrees of freedom as the data see of the departure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.covariance import NULL
from pkmcal.identify.problem import Problem
from pkmcal.identify.rows import by_noise
from pkmcal.identify.unknowns import BatchState
from pkmcal.solver import eliminate, inverse_root, stacked

SEEN = 1e-10
"""Part of a departure's squared rows that has to be left beside all unknowns for the data to see
it; less is rounding. Of what a reading tells of a pose, a hundred times sharper than the edges,
a ten-thousandth is left."""
HIDDEN = 0.01
"""Part of a number that lies in directions which the data do not see, from which it is not told."""
MOST = 4
"""Departures that are looked for one after the other; more are a session with other troubles."""


@dataclass(frozen=True)
class Score:
    """What one departure would gain: chi2 by dof numbers, chance of as much by chance alone in this
    test, and ``adjusted``, in any of all tests that were made, families counting alike.
    """

    chi2: float
    dof: int
    chance: float
    adjusted: float = 1.0


@dataclass(frozen=True)
class Freed:
    """A departure as the data tell it: value, sigma (k,), and moved (P,), what taking it up does to
    the machine's parameters, m and rad. What the data do not see has an infinite sigma.
    """

    value: Array
    sigma: Array
    moved: Array


class Departures:
    """Columns of departures beside the estimate's own, at its minimum (the problem's first run)."""

    def __init__(
        self,
        problem: Problem,
        state: BatchState,
        columns: Sequence[Array],
        families: Sequence[int] | None = None,
    ) -> None:
        """Of departures by their rows' derivatives (K', r, k), by configuration.

        families : of which each is; among many departures of one kind the single one has to gain
        more, and those of other kinds do not pay for it. One family if absent.
        """
        self._family = np.zeros(len(columns), dtype=int) if families is None else np.array(families)
        linear, ends = problem.linearize(state), np.cumsum([part.shape[-1] for part in columns])
        self._parts: list[Integers] = [
            np.arange(end - part.shape[-1], end) for part, end in zip(columns, ends, strict=True)
        ]
        # rows that are weighted away or hold nothing say nothing of departures either
        extra = np.where(linear.usable[0][..., None], np.concatenate(columns, axis=-1), 0.0)
        wide = linear._replace(
            by_shared=np.concatenate([linear.by_shared, extra[None]], axis=-1),
            shared_by=np.pad(linear.shared_by, ((0, 0), (0, extra.shape[-1]))),
        )
        rows, value = (part[0] for part in stacked(wide, eliminate(wide, np.zeros(1))))
        n, machine = problem.unknowns.count, problem.unknowns.machine
        half = inverse_root(rows[None, :, :n], NULL, loose=False)[0]
        basis, by = rows[:, :n] @ half, rows[:, n:]
        along = basis.T @ by
        self._scale = np.sqrt(np.maximum(np.sum(by**2, axis=0), 1e-300))
        self._left = (by - basis @ along) / self._scale
        self._value = value - basis @ (basis.T @ value)
        self._moves = -(problem.free @ half[machine] @ along)

    def scores(self, freed: Sequence[int] = ()) -> list[Score]:
        """Of all departures, in their order, with some of them free already: these gain nothing."""
        from scipy.special import chdtrc

        left, value = self._left, self._value
        if freed:
            u, s, _ = np.linalg.svd(left[:, self._columns(freed)], full_matrices=False)
            known = u[:, s**2 > SEEN]
            left, value = (x - known @ (known.T @ x) for x in (left, value))
        out: list[Score] = []
        for k, part in enumerate(self._parts):
            u, s, _ = np.linalg.svd(left[:, part], full_matrices=False)
            along = u[:, (s**2 > SEEN) & (k not in freed)].T @ value
            chi2, dof = float(along @ along), len(along)
            out.append(Score(chi2, dof, float(chdtrc(dof, chi2)) if dof else 1.0))
        tested = np.bincount(self._family, weights=[score.dof > 0 for score in out])
        times = np.count_nonzero(tested) * tested[self._family]
        return [
            replace(score, adjusted=min(float(n) * score.chance, 1.0)) if score.dof else score
            for score, n in zip(out, times, strict=True)
        ]

    def found(self, alpha: float) -> list[tuple[int, Score]]:
        """Those that the data show at a level ``alpha`` of all tests together (Bonferroni), one
        after the other, the least by chance first, by their numbers; each beside those before it.
        """
        out: list[tuple[int, Score]] = []
        while len(out) < min(MOST, len(self._parts)):
            scores = self.scores([k for k, _ in out])
            best = min(range(len(scores)), key=lambda k: scores[k].adjusted)
            if scores[best].adjusted > alpha:
                break
            out.append((best, scores[best]))
        return out

    def fitted(self, freed: Sequence[int]) -> list[Freed]:
        """What some departures come to, all free together."""
        columns = self._columns(freed)
        u, s, vt = np.linalg.svd(self._left[:, columns], full_matrices=False)
        seen = s**2 > SEEN
        back = vt[seen].T / s[seen]
        value = -(back @ (u[:, seen].T @ self._value)) / self._scale[columns]
        sigma = np.sqrt(np.sum(back**2, axis=1)) / self._scale[columns]
        hidden = np.sum(vt[~seen] ** 2, axis=0) > HIDDEN
        sigma[hidden] = np.inf
        ends = np.cumsum([len(self._parts[k]) for k in freed])
        return [
            Freed(v, s, self._moves[:, self._parts[k]] @ v)
            for k, v, s in zip(
                freed, np.split(value, ends[:-1]), np.split(sigma, ends[:-1]), strict=True
            )
        ]

    def _columns(self, freed: Sequence[int]) -> Integers:
        return np.concatenate([self._parts[k] for k in freed])


def columns_of(
    problem: Problem,
    state: BatchState,
    *,
    edges: Array | None = None,
    readings: Array | None = None,
    poses: Array | None = None,
) -> Array:
    """Columns (K', r, k) of a departure by what it does to the measurements, k numbers.

    edges : (K', G, 2, k) change of the measured normals in their bases. readings : (K', m, k).
    poses : (K', G', 6, k) left perturbation of the measured poses. The changes lead from what was
    measured to what should have been.
    """
    parts = [part for part in (edges, readings, poses) if part is not None]
    k, n = parts[0].shape[-1], len(problem.blocks.present)
    data, boards, closures = problem.data, problem.pose_data, problem.closure_rows
    n_rows = closures.stop + 6 * problem.pose_blocks.present.shape[1]
    out = np.zeros((n, n_rows, k))
    if edges is not None:
        weighed = data.weighed[0]
        out[:, : closures.start] = -(weighed @ edges).reshape(n, closures.start, k)
    if readings is not None:
        c, layout = problem.closure(state), problem.layout
        row = np.where(layout.row_motor >= 0, layout.row_motor, 0)
        by = np.where(layout.row_motor >= 0, c.by_reading[0], 0.0)[..., None] * readings[:, row]
        out[:, closures] = by_noise(
            layout, problem.joint_noise[:1, None, None], c.by_reading, by[None]
        )[0]
    if poses is not None:
        weighed = (np.sqrt(boards.weight)[..., None, None] * boards.whiten)[0]
        out[:, closures.stop :] = -(weighed @ poses).reshape(n, n_rows - closures.stop, k)
    return out
