"""Validation of [C] IV.C and IV.D on simulated runs: Tables 3 and 4, the error before the
calibration, and the square.

The truth is always the machine that the paper identified (Table 2, Model 12).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import inverse as inverted
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.identify.measured_platform import taken
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward, readings_at_poses
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.paper_c_machine import (
    IDENTIFIED_TABLE_2,
    MEASURED_VOLUME_MIDDLE,
    model,
    schoenflies,
    table_2_values,
    workspace,
)
from pkmcal.studies.simulated import SimulatedRuns

VALIDATION_SQUARE_SIDE = 0.1
"""[C] IV.D: side of the square, m."""
RULED_LINE_LENGTHS = (0.2, 0.4)
"""Lengths of the ruled line, m; the paper does not give its length, and errors grow as its
square.
"""
RULED_LINE_DIRECTIONS = (np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
RULED_LINE_POINTS = 21
ERROR_BEFORE_POSES = 400
"""Number of poses of the workspace over which the error before the calibration is averaged."""


def control_residuals(machine: Machine, fit: Fitted, data: SimulatedRuns) -> Array:
    """[C] Table 3: readings by inverse kinematics at the control poses, less the measured ones, (B,
    n, 4) rad.

    Poses are the measured ones; for the nominal model, which has neither camera nor board poses,
    the true ones, so that residuals are the errors of a controller.
    """
    n = data.count
    poses = data.T_base_platform[:, n:]
    if fit.T_camera_base is not None and fit.T_mount is not None:
        T_camera_board = data.T_camera_board[:, n:]
        poses = (
            inverted(fit.T_camera_base)[:, None] @ T_camera_board @ inverted(fit.T_mount)[:, None]
        )
        poses = taken(machine.layout.motion, poses).pose
    return readings_at_poses(machine.layout, fit.theta[:, None], poses) - data.joints[:, n:]


class Before(NamedTuple):
    """[C] IV.C: mean error of the nacelle with the nominal model, m and rad."""

    shift: float
    turn: float


def before() -> Before:
    """Mean error of the nominal poses with respect to the true ones at the same readings, in the
    machine's frame.
    """
    machine = model("design")
    poses = workspace(ERROR_BEFORE_POSES, np.random.default_rng(0))
    readings = readings_at_poses(machine.layout, table_2_values(machine, IDENTIFIED_TABLE_2), poses)
    fk = forward(machine.layout, machine.parameters.nominal, readings, poses).T_base_platform
    shift = np.linalg.norm(fk[:, :3, 3] - poses[:, :3, 3], axis=1)
    turn = rotation_vector(fk[:, :3, :3] @ poses[:, :3, :3].mT)
    return Before(float(shift.mean()), float(np.linalg.norm(turn, axis=1).mean()))


def straightness_along_rulers(
    machine: Machine, theta: Array, data: SimulatedRuns, rng: np.random.Generator
) -> Array:
    """[C] Table 4: root mean square distance (B, 4) of poses along a ruler from their best line, m.

    Two directions for each of RULED_LINE_LENGTHS. The tool moves along the true line; poses are
    computed from the readings by the machine (B, P).
    """
    out: list[Array] = []
    for direction in [
        length * rule for length in RULED_LINE_LENGTHS for rule in RULED_LINE_DIRECTIONS
    ]:
        along = np.linspace(-0.5, 0.5, RULED_LINE_POINTS)[:, None] * direction
        poses = schoenflies(
            np.concatenate(
                [MEASURED_VOLUME_MIDDLE + along, np.zeros((RULED_LINE_POINTS, 1))], axis=1
            )
        )
        readings = readings_at_poses(data.machine.layout, data.theta[:, None], poses)
        readings = readings + data.noise.reading * rng.normal(size=readings.shape)
        fk = forward(machine.layout, theta[..., None, :], readings, poses).T_base_platform
        points = fk[..., :3, 3]
        s = np.linalg.svd(points - points.mean(axis=-2, keepdims=True), compute_uv=False)
        out.append(np.sqrt(np.sum(s[..., 1:] ** 2, axis=-1) / RULED_LINE_POINTS))
    return np.stack(out, axis=-1)


def square(machine: Machine, theta: Array, data: SimulatedRuns) -> Array:
    """[C] IV.D: error (B, 4) of a square's sides, m, with the machine (B, P) in the controller.

    The controller computes the corners' readings by its inverse kinematics; the true machine goes
    to the poses of these readings.
    """
    corners = MEASURED_VOLUME_MIDDLE + VALIDATION_SQUARE_SIDE / 2 * np.array(
        [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    )
    poses = schoenflies(np.concatenate([corners, np.zeros((4, 1))], axis=1))
    readings = readings_at_poses(machine.layout, theta[..., None, :], poses)
    reached = forward(data.machine.layout, data.theta[:, None], readings, poses).T_base_platform
    points = reached[..., :3, 3]
    sides = np.linalg.norm(np.roll(points, -1, axis=-2) - points, axis=-1)
    return sides - VALIDATION_SQUARE_SIDE
