"""Rows of measurements that link two configurations (:mod:`pkmcal.measurements.links`).

The row of a link is among those of its second configuration. It depends on shared unknowns only:
the own unknowns of both configurations, which are shared, and the mount.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.identify.places import Places
from pkmcal.measurements import LinkRows, LinkSet


@dataclass(frozen=True)
class LinkBlocks:
    """Positions of the links: K configurations of G rows, padded; the same for all runs.

    sets : N links by kind, whose ``configuration`` counts linked configurations, from 0.
    linked : (J,) linked configurations, by their number among all.
    number : (K,) number of each configuration among the linked ones, -1 for none.
    at : positions of the links.
    """

    sets: tuple[LinkSet, ...]
    linked: Integers
    number: Integers
    at: Places

    @cached_property
    def present(self) -> Booleans:
        """(K, G) False for padding."""
        return self.at.present

    @cached_property
    def ends(self) -> Integers:
        """(N, 2) linked configurations of each link, numbered as in ``linked``."""
        none = np.zeros((0, 2), dtype=int)
        return np.concatenate([none, *(one.configuration for one in self.sets)])

    @cached_property
    def mount(self) -> Integers:
        """(N,) number of the mount."""
        none = np.zeros(0, dtype=int)
        return np.concatenate([none, *(one.mount for one in self.sets)])

    def among(self, configurations: slice) -> LinkBlocks:
        """Links of some configurations; all linked configurations stay among the unknowns."""
        first, stop, _ = configurations.indices(len(self.number))
        keep = (self.at.row >= first) & (self.at.row < stop)
        ends = np.cumsum([len(one) for one in self.sets])
        sets = tuple(
            one.select(keep[end - len(one) : end])
            for one, end in zip(self.sets, ends.tolist(), strict=True)
        )
        at = Places(
            self.at.row[keep] - first, self.at.place[keep], (stop - first, self.at.shape[1])
        )
        return replace(self, sets=sets, number=self.number[configurations], at=at)


@dataclass(frozen=True)
class LinkData:
    """Weights and whitening of the links.

    weight : (B or 1, K, G) robust weight, 0..1, divided by the squared noise scale.
    whiten : (1, K, G, 1, 1) inverse of the stated standard deviation.
    """

    weight: Array
    whiten: Array

    def among(self, configurations: slice) -> LinkData:
        """Data of some configurations."""
        return LinkData(self.weight[:, configurations], self.whiten[:, configurations])


def link_rows(blocks: LinkBlocks, data: LinkData, linked: Array, T_mount: Array) -> LinkRows:
    """Weighted residuals (B, K, G) of links and their derivatives (B, N, 6), in standard
    deviations.

    linked : (B, J, 4, 4) T_base_platform of the linked configurations.
    T_mount : (B, M, 4, 4).
    """
    count, each = blocks.at.shape
    value, n_runs = np.zeros((len(linked), count, each)), len(linked)
    if not len(blocks.ends):
        none = np.zeros((n_runs, 0, 6))
        return LinkRows(value, none, none, none)
    results = [
        one.rows(
            linked[:, one.configuration[:, 0]],
            linked[:, one.configuration[:, 1]],
            T_mount[:, one.mount],
        )
        for one in blocks.sets
    ]
    parts = [np.concatenate(part, axis=1) for part in zip(*results, strict=True)]
    weigh = np.sqrt(data.weight[:, blocks.at.row, blocks.at.place])
    value[:, blocks.at.row, blocks.at.place] = weigh * parts[0]
    return LinkRows(value, *(weigh[..., None] * part for part in parts[1:]))
