"""Columns of the Jacobian: effects that change what was measured linearly.

A column is k numbers x of one effect and the derivatives of what was measured by them. What should
have been measured is, to first order, ``measured + derivative @ x``. All effects on measurements
are of this one type:

- *with a prior*, an unknown of the joint estimate (edge shift of a camera, its intrinsics, size of
  a board, ...), or a random effect of the model discrepancy;
- *without a prior*, a model violation: the score test says whether the data show it
  (:mod:`pkmcal.identify.score`).
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
    """An effect of k numbers on what was measured.

    code, subject : of its finding; what is affected, by name. kind : word for it in
    calibration.json.

    edges : (n, 2, k) turn of the normals of the edges ``edge_rows`` (n,), in their bases. poses :
    (n, 6, k) left perturbation of T_station_target of the poses ``pose_rows`` (n,). Without rows,
    all of them in their order. edge_numbers : (n, w) the numbers of the column on which each edge
    depends, where these are few; edges is then (n, 2, w). The problem's structure is that of the
    rows and numbers, whatever the values of the derivatives. readings : (K, m, k). motion : (S, K,
    6, k) left perturbation (omega, tau) of the stations' poses, by configuration. station, since :
    the camera or tracker of that number stands elsewhere from that configuration on, by (omega,
    tau), k = 6. Absent: no effect on these.

    remark : without a prior, its finding is no reason against the result, whatever it moves.
    prior : (k, l) root L of the numbers' covariance L L^T; None where nothing is known of them.
    at : (k,) numbers at which the measurements were made, zero if absent: an estimate finds their
    change from there. facts : of its finding, from the estimates and their standard deviations
    (k,).
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
    prior: Array | None = None
    at: Array | None = None
    facts: Callable[[Array, Array], Facts] = value_and_sigma

    __repr__ = short_repr

    @property
    def count(self) -> int:
        """Number of its numbers, k."""
        if self.station is not None:
            return 6
        if self.prior is not None:
            return len(self.prior)
        parts = (self.edges, self.poses, self.readings, self.motion)
        return max((part.shape[-1] for part in parts if part is not None), default=0)

    def edges_of(self, number: int) -> Array | None:
        """Derivatives (N, 2, k) of all N edges; None where it acts on none."""
        edges = self.edges
        if edges is not None and self.edge_numbers is not None:
            few, edges = edges, np.zeros((len(edges), 2, self.count))
            np.put_along_axis(edges, self.edge_numbers[:, None], few, axis=2)
        return _everywhere(edges, self.edge_rows, number)

    def poses_of(self, number: int) -> Array | None:
        """Derivatives (N, 6, k) of all N poses; None where it acts on none."""
        return _everywhere(self.poses, self.pose_rows, number)


def _everywhere(part: Array | None, rows: Integers | None, number: int) -> Array | None:
    if part is None or rows is None:
        return part
    out = np.zeros((number, *part.shape[1:]))
    out[rows] = part
    return out
