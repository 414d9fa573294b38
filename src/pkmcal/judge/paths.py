"""Straightness of the tool's path for straight paths that a session names, [C] IV.D and Table 4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, rms
from pkmcal.judge.prediction import Prediction
from pkmcal.mechanisms import Machine
from pkmcal.session.load import SHORTEST_PATH, Session


@dataclass(frozen=True)
class Straightness:
    """Distances of points from their best line, m: root mean square ([C] Table 4) and largest."""

    rms: float
    largest: float


@dataclass(frozen=True)
class LinePath:
    """Straight path that the session names.

    n : number of points.
    seen : straightness of the poses observed in the images; None with fewer than three points.
    drawing, calibrated : straightness by forward kinematics of the readings, of the nominal and of
        the calibrated machine; None if a machine does not close.
    """

    name: str
    n: int
    seen: Straightness | None
    drawing: Straightness | None
    calibrated: Straightness | None


def straightness(points: Array) -> Straightness:
    """Straightness of points (n, 3), n >= 3; the line is the first principal axis."""
    centred = points - points.mean(axis=0)
    along = np.linalg.svd(centred)[2][0]
    off = np.linalg.norm(centred - np.outer(centred @ along, along), axis=1)
    return Straightness(rms(off), float(off.max()))


def paths_of(session: Session) -> dict[str, list[int]]:
    """Rows of the configurations of each straight path, by its name."""
    paths: dict[str, list[str]] = session.document.get("paths") or {}
    return {
        name: [session.configurations.index(member) for member in members]
        for name, members in paths.items()
    }


def line_path(
    name: str, rows: list[int], nominal: Machine, session: Session, prediction: Prediction
) -> LinePath:
    """Straightness of the tool's path through the configurations ``rows``, observed and
    computed.
    """
    observed = prediction.T_base_platform[rows][prediction.observed[rows]]
    by: list[Straightness | None] = []
    for machine in (nominal, prediction.machine):
        fk = machine.forward_result(session.joints[rows])
        closes = bool(fk.converged.all())
        by.append(straightness(fk.T_base_platform[:, :3, 3]) if closes else None)
    return LinePath(
        name=name,
        n=len(rows),
        seen=straightness(observed[:, :3, 3]) if len(observed) >= SHORTEST_PATH else None,
        drawing=by[0],
        calibrated=by[1],
    )
