"""What heights of a flat bed tell of a machine: how flat it will be, and how little of x and y."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import pose_by_parameters

POINTS = 60
"""Places all over the bed: where nobody probed counts as well."""
GOLDEN = np.pi * (3 - np.sqrt(5))
"""Turn from one place to the next on a spiral that covers a disc evenly."""


@dataclass(frozen=True)
class Bed:
    """How well the platform is known over the disc about the places that were probed.

    radius : of the disc, m. sigma : standard deviation (m, root mean square over the disc) of the
    platform's height above the bed, the bed's own height and tilt aside; by_drawing : the same by
    the drawing's tolerances. sideways : of its place along the bed, frames aside. size : of how
    much larger or smaller all is along the bed, a share. z : of the platform's origin, m, base
    frame, in the middle of the disc where the first table's height is 0.
    """

    radius: float
    sigma: float
    by_drawing: float
    sideways: float
    size: float
    z: float


def bed_of(estimate: Estimate) -> Bed:
    """The bed of an estimate from heights alone."""
    machine, table = estimate.machine, estimate.machine.parameters
    poses = _over_the_disc(estimate.state.T_base_platform[estimate.configurations])
    joints = machine.inverse(poses)
    reached = np.isfinite(joints).all(axis=1)
    joints, poses = joints[reached], poses[reached]
    by = pose_by_parameters(machine, joints, poses)[:, 3:]
    xy = poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0)
    ones, zeros = np.ones(len(xy)), np.zeros(len(xy))
    plane = np.column_stack([ones, xy])
    slope = np.linalg.lstsq(plane, poses[:, 2, 3], rcond=None)[0][1:]
    height = _less(by[:, 2] - np.einsum("i,nip->np", slope, by[:, :2]), plane)
    along = by[:, :2].reshape(-1, by.shape[-1])
    shifts = np.stack([ones, zeros], axis=1).ravel(), np.stack([zeros, ones], axis=1).ravel()
    turn = np.stack([-xy[:, 1], xy[:, 0]], axis=1).ravel()
    along = _less(along, np.column_stack([*shifts, turn]))
    stretch = xy.ravel() @ along / np.sum(xy**2)
    middle, state = poses[0], estimate.state
    there = state.T_camera_base[0] @ middle @ state.T_mount[0]
    drawing = table.free_matrix() * table.tolerances_free()
    return Bed(
        radius=float(np.linalg.norm(xy, axis=1).max()),
        sigma=_deviation(height, estimate.covariance, len(xy)),
        by_drawing=_deviation(height, drawing @ drawing.T, len(xy)),
        sideways=_deviation(along, estimate.covariance, len(xy)),
        size=_deviation(stretch[None], estimate.covariance, 1),
        z=float(middle[2, 3] - there[2, 3]),
    )


def _over_the_disc(probed: Array) -> Array:
    """Poses (n, 4, 4) of the platform all over the disc about the places that were probed, in the
    plane through these.
    """
    xy = probed[:, :2, 3]
    middle = xy.mean(axis=0)
    plane = np.column_stack([np.ones(len(xy)), xy])
    height = np.linalg.lstsq(plane, probed[:, 2, 3], rcond=None)[0]
    k = np.arange(POINTS)
    r = np.linalg.norm(xy - middle, axis=1).max() * np.sqrt((k + 0.5) / POINTS)
    places = middle + r[:, None] * np.stack([np.cos(GOLDEN * k), np.sin(GOLDEN * k)], axis=1)
    out = np.repeat(probed[:1], POINTS, axis=0)
    out[:, :2, 3] = places
    out[:, 2, 3] = height[0] + places @ height[1:]
    return out


def _less(rows: Array, known: Array) -> Array:
    """Rows (n, P) without what the columns of ``known`` (n, m) can make of them."""
    return rows - known @ np.linalg.lstsq(known, rows, rcond=None)[0]


def _deviation(rows: Array, covariance: Array, places: int) -> float:
    """Standard deviation of rows (n, P), root mean square over so many places."""
    return float(np.sqrt(max(np.sum((rows @ covariance) * rows), 0.0) / places))
