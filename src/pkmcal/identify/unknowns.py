"""Unknowns of the joint estimate: their names, their columns, and their values in B runs.

The shared unknowns have this order of columns:

- **machine** : free combinations z of its parameters, ``theta = nominal + free z``.
- **stations** : left perturbation (omega, tau) of each T_camera_base.
- **columns** : numbers of the effects on measurements that have a prior, those of one code side by
  side (:mod:`pkmcal.measurements.effects`).
- **mounts** : left perturbation of each T_mount, of boards and targets.
- **linked** : the own unknowns, see below, of each configuration that a measurement links to
  another: the rows of both depend on them.

Each other configuration has own unknowns, nuisance parameters that are eliminated first: the
platform's motion (left perturbation of T_base_platform, along the directions that the machine has)
and, on an articulated platform, its hinges
(:attr:`~pkmcal.mechanisms.layout.LimbLayout.own_motion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Integers


@dataclass(frozen=True)
class Unknowns:
    """Numbers of the shared unknowns, and their columns.

    n_free : free unknowns of the machine.
    codes : codes of the effects in their order, each with its number of columns.
    n_linked : own unknowns of all linked configurations together.
    """

    n_free: int
    n_stations: int
    codes: tuple[tuple[str, int], ...] = ()
    n_mounts: int = 0
    n_linked: int = 0

    @cached_property
    def machine(self) -> slice:
        """Columns of the machine."""
        return slice(0, self.n_free)

    @cached_property
    def stations(self) -> slice:
        """Columns of the stations, six each."""
        return slice(self.n_free, self.n_free + 6 * self.n_stations)

    @cached_property
    def effects(self) -> slice:
        """Columns of all effects."""
        first = self.stations.stop
        return slice(first, first + sum(count for _, count in self.codes))

    def of_code(self, code: str) -> slice:
        """Columns of the effects of a code; an empty slice where there is none."""
        first = self.effects.start
        for one, count in self.codes:
            if one == code:
                return slice(first, first + count)
            first += count
        return slice(first, first)

    @cached_property
    def mounts(self) -> slice:
        """Columns of the mounts, six each."""
        return slice(self.effects.stop, self.effects.stop + 6 * self.n_mounts)

    @cached_property
    def linked(self) -> slice:
        """Columns of the own unknowns of linked configurations."""
        return slice(self.mounts.stop, self.mounts.stop + self.n_linked)

    @cached_property
    def count(self) -> int:
        """Number of shared unknowns, na."""
        return self.linked.stop

    def columns(self, *names: str) -> Integers:
        """Columns of the named unknowns in increasing order.

        names : machine, stations, mounts, linked, or codes of effects.
        """
        parts = [getattr(self, n) if n in PARTS else self.of_code(n) for n in names]
        none = np.zeros(0, dtype=int)
        return np.unique(np.concatenate([none, *(np.arange(x.start, x.stop) for x in parts)]))


PARTS = ("machine", "stations", "mounts", "linked")
"""Names of the unknowns other than effects."""


def own_blocks(matrix: Array, part: slice, width: int) -> Array:
    """Diagonal blocks (n, width, width) of a covariance, of unknowns with ``width`` columns
    each.
    """
    n = (part.stop - part.start) // width
    own = matrix[part, part].reshape(n, width, n, width)
    return np.einsum("iaib->iab", own)


@dataclass(frozen=True)
class BatchState:
    """Values of the unknowns in B runs.

    z : (B, nz) free parameters.
    T_camera_base : (B, S, 4, 4).
    T_base_platform : (B, K, 4, 4).
    columns : (B, n) numbers of the effects.
    T_mount : (B, M, 4, 4) boards and targets.
    internal : (B, K, n) hinges of articulated platforms.
    linked : (B, J, 4, 4) T_base_platform of the linked configurations, in the state of some of the
        configurations; otherwise empty, since T_base_platform contains them.
    """

    z: Array
    T_camera_base: Array
    T_base_platform: Array
    columns: Array
    T_mount: Array = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))
    internal: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    linked: Array = field(default_factory=lambda: np.zeros((0, 0, 4, 4)))

    def __post_init__(self) -> None:
        """Set absent fields to empty ones for each run."""
        none = {
            "internal": (self.T_base_platform.shape[1], 0),
            "T_mount": (0, 4, 4),
            "linked": (0, 4, 4),
        }
        for name, shape in none.items():
            if len(getattr(self, name)) != len(self.z):
                object.__setattr__(self, name, np.zeros((len(self.z), *shape)))


def batch_of_runs(states: Sequence[BatchState]) -> BatchState:
    """Runs of several batches as one."""
    names = [one.name for one in fields(BatchState)]
    return BatchState(*(np.concatenate([getattr(x, name) for x in states]) for name in names))
