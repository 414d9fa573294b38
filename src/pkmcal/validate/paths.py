"""Paths: how straight a line is, and what a square becomes that a controller commands; [C] IV.D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError
from pkmcal.geometry.rigid import register
from pkmcal.mechanisms import Machine


@dataclass(frozen=True)
class Straightness:
    """Distances of points from the line that fits them best, m: root mean square ([C] Table 4) and
    largest.
    """

    rms: float
    largest: float


@dataclass(frozen=True)
class Square:
    """A commanded square as it was executed, m.

    side : largest error of a side's length. shape : root mean square distance of its points from
    the commanded ones, laid over each other. place : the same as commanded, in the base frame.
    points : (n, 3) tool points.
    """

    side: float
    shape: float
    place: float
    points: Array


def straightness(points: Array) -> Straightness:
    """Of points (n, 3), n >= 3; the line is the first principal axis."""
    centred = points - points.mean(axis=0)
    along = np.linalg.svd(centred)[2][0]
    off = np.linalg.norm(centred - np.outer(centred @ along, along), axis=1)
    return Straightness(float(np.sqrt(np.mean(off**2))), float(off.max()))


def executed(controller: Machine, machine: Machine, T_base_platform: Array) -> Array:
    """Where a machine goes, (n, 4, 4), when a controller computes its readings by another model.

    T_base_platform : (n, 4, 4) commanded. Raises GeometryError where the path cannot be driven.
    """
    readings = controller.inverse(T_base_platform)
    if not np.isfinite(readings).all():
        raise GeometryError(
            "the path leaves the workspace of the controller's model",
            found=f"{int(np.sum(~np.isfinite(readings).all(axis=1)))} of {len(readings)} points",
            expected="a smaller path, or one nearer to the workspace's middle",
        )
    return machine.forward(readings, T_base_platform)


def square_path(middle: Array, side: float, points: int = 25) -> Array:
    """Poses (4 points, 4, 4) around a closed square in the base's x-y plane, corners first of each
    side; middle : (4, 4) pose of its middle, side in m.
    """
    corners = 0.5 * side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    share = np.arange(points)[:, None] / points
    sides = corners[:, None] + share * (np.roll(corners, -1, axis=0) - corners)[:, None]
    out = np.broadcast_to(middle, (4 * points, 4, 4)).copy()
    out[:, :2, 3] += sides.reshape(-1, 2)
    return out


def closed_square(
    controller: Machine, machine: Machine, middle: Array, side: float = 0.1, points: int = 25
) -> Square:
    """The square ([C] IV.D: 100 mm) that a machine draws under a controller's model."""
    commanded = square_path(middle, side, points)
    goes = executed(controller, machine, commanded)[:, :3, 3]
    wanted = commanded[:, :3, 3]
    corners = goes[::points]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    fitted = register(wanted, goes)
    over = wanted @ fitted[:3, :3].T + fitted[:3, 3]
    return Square(
        side=float(np.abs(lengths - side).max()),
        shape=_rms(goes - over),
        place=_rms(goes - wanted),
        points=goes,
    )


def _rms(difference: Array) -> float:
    """Root mean square length of (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
