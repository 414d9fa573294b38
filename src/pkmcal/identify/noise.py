"""How large the noise of each kind of rows is, as the data show it: variance components.

An error that no unknown takes up is left in the residuals. With H the hat matrix of all rows in
standard deviations and R = 1 - H, the residuals of kind k have the sum of squares c_k, expected as

    E c_k = sum over all kinds l of s_l^2 S_kl,      S_kl = tr(R_kl R_lk),      sum_l S_kl = tr R_kk

where the noise of kind l is s_l times what it counts for (MINQUE; Rao 1971). Solved again and again
at the noise that it finds, that is restricted maximum likelihood (Patterson and Thompson 1971).
Where poses follow their readings, S_kk of the readings is small: their residuals are mostly what
other kinds leave in them, and hardly answer to a noise that is stated wrong; so the interval that
the data allow is wide.

c_k is nearly a multiple of a chi-square variable (Satterthwaite 1946), of ``tr^2 R_kk / S_kk``
degrees of freedom, fewer where the s_l of the other kinds are not well known themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.identify.covariance import Information
from pkmcal.identify.problem import Problem
from pkmcal.identify.rows import Kinds

NOISE_CONTRADICTION_CHANCE = 0.01 / 3
"""Probability of contradicting a noise that is stated right: one in a hundred, shared by the three
kinds of rows."""
LEAST_NOISE_FREEDOM = 5.0
"""Degrees of freedom below which a sum of squares tells no noise."""
LARGEST_NOISE_STEP = 10.0
"""Largest factor on a noise in one step: what follows from it is linear no further."""
LEAST_NOISE_DIVISOR = 1e-300


@dataclass(frozen=True)
class Components:
    """What B solutions leave of each kind of rows, see the module.

    chi2 : (B, 3) c_k. freedom : (B, 3) tr R_kk. square : (B, 3, 3) S_kl.
    """

    chi2: Array
    freedom: Array
    square: Array

    @property
    def told(self) -> Array:
        """Degrees of freedom (B, 3) of the chi-square variables that the sums of squares are."""
        own = np.einsum("bkk->bk", self.square)
        others = (self.freedom > LEAST_NOISE_FREEDOM)[:, None, :] & ~np.eye(3, dtype=bool)
        across = self.square**2 / np.where(others, own[:, None, :], 1.0)
        spread = own + np.where(others, across, 0.0).sum(axis=-1)
        return np.where(own > 0, self.freedom**2 / np.where(own > 0, spread, 1.0), 0.0)

    def factor(self, kind: int) -> Array:
        """By what to multiply a kind's noise next, (B,): to where c_k is as expected, or, where no
        noise would be too much, by how much less it is. Where the data allow the present noise and
        any smaller one it stays: they know no better, and a noise of nothing promises too much.
        """
        square = self._variance(kind, self.chi2[:, kind])
        freedom = np.maximum(self.freedom, LEAST_NOISE_DIVISOR)
        less = (np.minimum(self.chi2, freedom) / freedom)[:, kind]
        step = np.sqrt(
            np.clip(
                np.where(square > less, square, less), LARGEST_NOISE_STEP**-2, LARGEST_NOISE_STEP**2
            )
        )
        low, high = self.interval(kind)
        return np.where((low == 0) & (high >= 1), 1.0, step)

    def interval(self, kind: int) -> tuple[Array, Array]:
        """Factors on a kind's noise, smallest and largest (B,) each, that the data allow; 0 and
        infinity where they say nothing. Where less is left than the other kinds' noise alone would
        leave, it is that which counts too much, and nothing is said of this one.
        """
        from scipy.special import chdtri

        dof = self.told[:, kind]
        known = dof > LEAST_NOISE_FREEDOM
        ends: list[Array] = []
        for share in (NOISE_CONTRADICTION_CHANCE / 2, 1 - NOISE_CONTRADICTION_CHANCE / 2):
            mean = (
                self.chi2[:, kind] * dof / chdtri(np.where(known, dof, LEAST_NOISE_FREEDOM), share)
            )
            ends.append(np.sqrt(np.maximum(self._variance(kind, mean), 0.0)))
        said = known & (ends[1] > 0)
        return np.where(said, ends[0], 0.0), np.where(said, ends[1], np.inf)

    def contradicts(self, kind: int) -> Booleans:
        """Whether the data do not allow a kind's noise as it is, (B,)."""
        low, high = self.interval(kind)
        return (low > 1) | (high < 1)

    def _variance(self, kind: int, chi2: Array) -> Array:
        """s_k^2 (B,) with which a kind's sum of squares is expected to be ``chi2`` (B,), the other
        kinds' noise as their own sums of squares have it; what is known beforehand counts as it is.
        """
        own = self.square[:, kind, kind]
        known = self.freedom > LEAST_NOISE_FREEDOM
        others = np.where(known, self.chi2 / np.where(known, self.freedom, 1.0), 1.0)
        others[:, kind] = 1.0
        by_others = np.sum((others - 1) * self.square[:, kind], axis=-1)
        return 1 + (chi2 - self.freedom[:, kind] - by_others) / np.maximum(own, LEAST_NOISE_DIVISOR)


def components(info: Information, weight: Kinds[Array]) -> Components:
    """Those of a solution with weights (B, K, G) in use.

    H is Q Q^T of the own unknowns and S S^T of the shared ones, orthogonal to each other; what
    nothing fixes has no part in it. With G_k = [Q S]_k^T [Q S]_k, tr(H_kl H_lk) = tr(G_k G_l).
    """
    problem, sums, half = info.problem, info.by_kind, info.root
    n_readings = float(info.state.T_base_platform.shape[1] * problem.layout.n_readings)
    count = np.stack([*counts(problem, weight), np.full(len(half), n_readings)], axis=-1)
    kinds = np.flatnonzero(count.any(axis=0))
    shared = np.zeros((len(half), 3, *half.shape[1:]))
    shared[:, kinds] = half.mT[:, None] @ sums.normal[:, kinds] @ half[:, None]
    trace = sums.trace + np.einsum("bkii->bk", shared)
    flat = shared.reshape(*shared.shape[:2], -1)
    cross = np.einsum("bklij,bij->bkl", sums.cross, half @ half.mT)
    square = sums.own + 2 * cross + flat @ flat.mT
    each = np.arange(3)
    square[:, each, each] += count - 2 * trace
    return Components(
        chi2=sums.chi2,
        freedom=count - trace,
        square=np.maximum(square, 0.0),
    )


def counts(problem: Problem, weight: Kinds[Array]) -> Kinds[Array]:
    """Residuals of each kind in use, each counted by its robust weight, (B,)."""
    parts = zip(problem.kinds, weight, strict=True)
    return Kinds(*(np.sum(part * kind.count, axis=(1, 2)) for kind, part in parts))
