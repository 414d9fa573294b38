"""Columns of the Jacobian: effects that change what was measured linearly.

A column is k numbers x of one effect, with the derivatives of the measurements by them. The
measurements without the effect are, to first order, ``measured + derivative @ x``. All effects on
measurements are of this one type:

- *with a prior*, an unknown of the joint estimate (edge shift of a camera, its intrinsics, size of
  a board, ...), or a random effect of the model discrepancy;
- *without a prior*, a model violation, for a score test (:mod:`pkmcal.identify.score`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr

Facts = Mapping[str, Any]


def value_and_sigma(value: Array, sigma: Array) -> Facts:
    """Facts about an effect of one number."""
    return {"value": value[0], "sigma": sigma[0]}


@dataclass(frozen=True)
class Column:
    """An effect of k numbers on the measurements. Absent derivatives are zero.

    code, subject : code of its finding, and name of what it affects.
    kind : word for it in calibration.json.
    edges : (n, 2, k) rotation of the normals of the edges ``edge_rows`` (n,), in their bases;
        without ``edge_rows`` of all edges in their order.
    edge_numbers : (n, w) numbers of the column on which each edge depends, where these are few;
        edges is then (n, 2, w). The structure of the problem follows from rows and numbers only,
        not from the values of the derivatives.
    poses : (n, 6, k) left perturbation of T_station_target of the poses ``pose_rows`` (n,), all by
        default.
    readings : (K, m, k) change of the readings.
    motion : (S, K, 6, k) left perturbation (omega, tau) of the stations' poses, by configuration.
    station, since : number of a camera or tracker that was moved, by (omega, tau) with k = 6, and
        the first configuration after that.
    remark : for a column without a prior, its finding is only a remark and no reason against the
        result, whatever its effect.
    positive : for a column of one number without a prior, whether only positive numbers are
        possible; its score test is one-sided.
    prior : (k, l) root L of the numbers' prior covariance L L^T; None without a prior.
    at : (k,) values of the numbers with which the measurements were made, zero by default; an
        estimate is a change from these.
    facts : function from the estimates and their standard deviations, (k,) each, to facts of the
        finding.
    """

    code: str
    subject: str = ""
    kind: str = ""
    edges: Array | None = None
    edge_rows: Integers | None = None
    edge_numbers: Integers | None = None
    poses: Array | None = None
    pose_rows: Integers | None = None
    readings: Array | None = None
    motion: Array | None = None
    station: int | None = None
    since: int = 0
    remark: bool = False
    positive: bool = False
    prior: Array | None = None
    at: Array | None = None
    facts: Callable[[Array, Array], Facts] = value_and_sigma

    __repr__ = short_repr

    @property
    def count(self) -> int:
        """Number k of the column's numbers."""
        if self.station is not None:
            return 6
        if self.prior is not None:
            return len(self.prior)
        parts = (self.edges, self.poses, self.readings, self.motion)
        return max((part.shape[-1] for part in parts if part is not None), default=0)

    def edges_of(self, number: int) -> Array | None:
        """Derivatives (N, 2, k) of all N edges; None where the effect changes none."""
        edges = self.edges
        if edges is not None and self.edge_numbers is not None:
            few, edges = edges, np.zeros((len(edges), 2, self.count))
            np.put_along_axis(edges, self.edge_numbers[:, None], few, axis=2)
        return _everywhere(edges, self.edge_rows, number)

    def poses_of(self, number: int) -> Array | None:
        """Derivatives (N, 6, k) of all N poses; None where the effect changes none."""
        return _everywhere(self.poses, self.pose_rows, number)


def _everywhere(part: Array | None, rows: Integers | None, number: int) -> Array | None:
    if part is None or rows is None:
        return part
    out = np.zeros((number, *part.shape[1:]))
    out[rows] = part
    return out
