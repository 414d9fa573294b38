"""Levenberg-Marquardt steps of many small dense problems at once, such as poses or corners.

Each problem has its own damping, and keeps a step only where the step lowers its cost. What the
cost is, and how a state is retracted, is the caller's; problems that share unknowns or are large
belong to `solver.search`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

FIRST_DAMPING = 1e-3
DAMPING_AFTER_SUCCESS, DAMPING_AFTER_FAILURE = 0.3, 10.0
"""Factors on a problem's damping after a step that lowered its cost, and after another one."""
LEAST_CURVATURE = 1e-9
"""Added to the diagonal of normal matrices, so that one without data can be solved."""


class Damping(NamedTuple):
    """Marquardt damping (n,) of n problems, relative to the diagonals of their normal matrices."""

    value: Array

    @classmethod
    def first(cls, n: int) -> Damping:
        """Damping of the first step."""
        return cls(np.full(n, FIRST_DAMPING))

    def step(self, normal: Array, right: Array) -> Array:
        """Steps x (n, d) of ``(N + damping diag N) x = b``; normal N (n, d, d), right b (n, d)."""
        diagonal = self.value[:, None] * np.einsum("nii->ni", normal) + LEAST_CURVATURE
        damped = normal + diagonal[..., None] * np.eye(normal.shape[-1])
        return np.linalg.solve(damped, right[..., None])[..., 0]

    def after(self, better: Booleans) -> Damping:
        """Damping of the next step; better : (n,) whether the last one lowered the cost."""
        factor = np.where(better, DAMPING_AFTER_SUCCESS, DAMPING_AFTER_FAILURE)
        return Damping(self.value * factor)

    def select(self, keep: Booleans | Integers) -> Damping:
        """Damping of some of the problems."""
        return Damping(self.value[keep])
