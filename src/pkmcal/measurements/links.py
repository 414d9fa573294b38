"""Measurements that link two configurations: one number each, such as a distance.

A row of a link depends on the poses of both configurations. The pose of a linked configuration is
therefore a shared unknown; the poses of all other configurations are eliminated one by one
(:mod:`pkmcal.identify.problem`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr


class LinkRows(NamedTuple):
    """Residuals of N links in B runs, and their derivatives, in standard deviations.

    value : (B, N), predicted less measured. by_first, by_second : (B, N, 6) by the left
    perturbation (omega, tau) of T_base_platform in either configuration. by_mount : (B, N, 6) by
    that of T_platform_mount.
    """

    value: Array
    by_first: Array
    by_second: Array
    by_mount: Array


@dataclass(frozen=True)
class LinkSet(ABC):
    """N measurements of one kind that link two configurations each.

    label : the table's name in messages. configuration : (N, 2) rows of the readings. mount : (N,)
    number of the mount. value : (N,) as measured, sigma : (N,) its standard deviation, in
    SI. lines : (N,) of the table, from 1.
    """

    label: str
    configuration: Integers
    mount: Integers
    value: Array
    sigma: Array
    lines: Integers

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.value)

    @property
    @abstractmethod
    def kind(self) -> str:
        """Code of the kind."""

    @abstractmethod
    def rows(self, first: Array, second: Array, mount: Array) -> LinkRows:
        """Residuals at poses T_base_platform (B, N, 4, 4) of both configurations, with T_mount
        (B, N, 4, 4) on the platform.
        """

    def select(self, keep: Booleans | Integers) -> Self:
        """The links selected by a mask or by positions."""
        arrays = {
            f.name: getattr(self, f.name)[keep]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **arrays)

    def at_mount(self, number: int) -> Self:
        """The links with another mount."""
        return replace(self, mount=np.full(len(self), number))
