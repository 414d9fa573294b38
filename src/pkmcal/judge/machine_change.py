"""Difference between two estimates of one machine, and its covariance due to chance alone.

Frames are conventions, so both are expressed in the frames in which they differ least: by least
squares over all free parameters, each in its prior sigma. The remaining difference y does not
depend on frames.

The estimates are correlated if they have the same nominal model, or share images. With the nominal
model's covariance 1 (in prior sigmas), and the information I_a and I_b of the data of each, their
covariances are C = (1 + I)^-1, and

    cov(y_b - y_a) = C_a + C_b - C_a J C_b - C_b J C_a,    J = 1 + I_shared,

without the 1 where the nominal models differ. I_shared is bounded by the smaller information in
each direction: an estimate from the same data with less information differs by C_a - C_b (Hausman,
1978).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.identify.gauge import (
    BestFit,
    alignment,
    carried_errors,
    freedoms,
    generators,
    moved_centres,
)
from pkmcal.identify.state import State
from pkmcal.levels import NEGLIGIBLE, ROUNDING
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import numerical_rank


@dataclass(frozen=True)
class MachineChange:
    """Machine b minus machine a, in a's frames aligned so that they differ least.

    machine : a with b's values in these frames.
    change : (P,) of the parameters, m and rad.
    covariance : (P, P) of the change due to chance alone; zeros between nominal models.
    chi2, dof : of the change in the directions that the data determine; dof is 0 between nominal
        models.
    """

    machine: Machine
    change: Array
    covariance: Array
    chi2: float
    dof: int

    __repr__ = short_repr

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of the change due to chance alone."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def machine_change(
    a: Machine,
    b: Machine,
    covariances: tuple[Array | None, Array | None],
    *,
    same_nominal: bool = True,
    shared: float = 0.0,
) -> MachineChange:
    """Difference between two machines with the same parameters.

    covariances : (P, P) of either machine's parameters in any frames; None for a nominal model,
        whose values are exact.
    same_nominal : whether both calibrations have the same nominal model.
    shared : share of the smaller data set that the other calibration has as well.
    """
    # b's parameters and covariance in frames aligned to a's
    held = replace(a, parameters=replace(a.parameters, nominal=a.values))
    table, layout = held.parameters, held.layout
    none = np.zeros((0, 4, 4))
    before = State(table.unit_axes(b.values), none, none)
    e, f = alignment(held, before, BestFit())
    there = moved_centres(layout, before.theta, e, f)
    carried = carried_errors(layout, before, e, f)
    cov_a, cov_b = covariances
    if cov_b is not None:
        cov_b = carried @ cov_b @ carried.T
    # free parameters in prior sigmas, frames projected out
    tolerance = table.tolerances_free()
    inward = np.linalg.pinv(table.free_matrix()) / tolerance[:, None]
    frames = generators(layout, a.values) @ freedoms(held)
    own = inward @ frames
    remainder, s, _ = np.linalg.svd(own)
    rest = remainder[:, numerical_rank(s) :]
    step = np.linalg.lstsq(own, inward @ (there - a.values), rcond=1e-9)[0]
    there = there - frames @ step
    change = there - a.values
    invariant = rest.T @ inward
    y = invariant @ change
    # covariance of the difference apart from frames, and its chi-square
    spreads = [None if c is None else invariant @ c @ invariant.T for c in (cov_a, cov_b)]
    spread, null_space = _spread(spreads, y.size, same_nominal, shared)
    outward = table.free_matrix() * tolerance @ rest
    determined = null_space.T @ y  # the part that the data determine
    return MachineChange(
        machine=held.with_values(there),
        change=change,
        covariance=outward @ spread @ outward.T,
        chi2=float(determined @ np.linalg.solve(null_space.T @ spread @ null_space, determined)),
        dof=null_space.shape[1],
    )


def _spread(
    spreads: Sequence[Array | None], size: int, same_nominal: bool, shared: float
) -> tuple[Array, Array]:
    """Covariance (r, r) of the difference by chance, and the directions (r, k) that data
    determine.
    """
    covariances = [c for c in spreads if c is not None]
    if not covariances:
        return np.zeros((size, size)), np.zeros((size, 0))
    values, vectors = np.linalg.eigh(np.mean(covariances, axis=0))
    # directions that retain nearly all of the nominal model's variance are undetermined
    null_vectors = vectors[:, values < 1 - NEGLIGIBLE]
    if len(covariances) == 1:
        return covariances[0], null_vectors
    one, other = (_bounded(c) for c in covariances)
    inverse_one, inverse_other = np.linalg.inv(one), np.linalg.inv(other)
    lesser = _lesser(inverse_one, inverse_other)
    unit = np.eye(len(one))
    joint = shared * (lesser - unit) + (unit if same_nominal else 0.0)
    cross = one @ joint @ other
    # Each estimate has converged to a negligible share of its standard deviation only. That is the
    # lower bound of the spread of two estimates from the same data.
    spread = one + other - cross - cross.T + NEGLIGIBLE**2 * (one + other)
    return spread, null_vectors


def _bounded(covariance: Array) -> Array:
    """Covariance in prior sigmas, bounded above by the nominal model's and below by rounding."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return (vectors * np.clip(values, ROUNDING, 1.0)) @ vectors.T


def _lesser(one: Array, other: Array) -> Array:
    """Smaller of two informations, in the basis in which both are diagonal."""
    root = np.linalg.cholesky(other)
    back = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(back @ one @ back.T)
    outward = root @ vectors
    return (outward * np.minimum(values, 1.0)) @ outward.T
