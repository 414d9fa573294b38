"""Measurements that link two configurations: one number each, such as a distance.

A row of such a measurement depends on the poses of both configurations. The pose of a linked
configuration is therefore a shared unknown; the poses of all other configurations are eliminated
one by one (:mod:`pkmcal.identify.problem`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr


class LinkRows(NamedTuple):
    """Residuals of N links in B runs and their derivatives, in standard deviations.

    value : (B, N) predicted minus measured.
    by_first, by_second : (B, N, 6) by the left perturbation (omega, tau) of T_base_platform in
    either configuration.
    by_mount : (B, N, 6) by the left perturbation of T_platform_mount.
    """

    value: Array
    by_first: Array
    by_second: Array
    by_mount: Array


@dataclass(frozen=True)
class LinkSet(ABC):
    """N measurements of one kind that link two configurations each.

    label : the table's name in messages.
    configuration : (N, 2) rows of the readings.
    mount : (N,) number of the mount on the platform.
    value, sigma : (N,) measured value and its standard deviation, SI.
    lines : (N,) lines of the table, from 1.
    by_default : whether `sigma` is the kind's default because the session states none.
    """

    label: str
    configuration: Integers
    mount: Integers
    value: Array
    sigma: Array
    lines: Integers
    by_default: bool = False

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.value)

    @property
    @abstractmethod
    def kind(self) -> str:
        """Code of the kind."""

    @abstractmethod
    def rows(self, first: Array, second: Array, mount: Array) -> LinkRows:
        """Residuals and derivatives of all links.

        first, second : (B, N, 4, 4) T_base_platform of both configurations.
        mount : (B, N, 4, 4) T_platform_mount.
        """

    def select(self, keep: Booleans | Integers) -> Self:
        """Links at a mask or at positions."""
        arrays = {
            f.name: getattr(self, f.name)[keep]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **arrays)

    def at_mount(self, number: int) -> Self:
        """The same links, all at one mount."""
        return replace(self, mount=np.full(len(self), number))
