"""[C] IV.C and IV.D on simulated runs: Tables 2, 3 and 4, the error before, and the square.

All with the machine that the paper identified (Table 2, Model 12) as the truth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import inverse as inverted
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward, inverse
from pkmcal.papers.measured_platform import taken
from pkmcal.reproduce.paper_c_methods import Fitted
from pkmcal.reproduce.paper_c_simulation import (
    MIDDLE,
    SIGNS,
    Settings,
    Truth,
    schoenflies,
    workspace,
)

SIDE = 0.1
"""[C] IV.D: the square's side, m."""
RULERS = (0.2, 0.4)
"""The ruled line's length, m; the paper does not tell it, and errors grow as its square."""
RULES = (np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
POINTS = 21


class Residuals(NamedTuple):
    """[C] Table 3: mean and root mean square of each motor's residual, (B, 4) rad."""

    mean: Array
    rms: Array


def table_2_of(machine: Machine, theta: Array) -> Array:
    """h, arm, R, rod, four alpha, four q0 (B, 12) of Model 12's parameters (B, P)."""
    index = machine.parameters.index

    def of(name: str) -> Array:
        return theta[..., index(name)]

    legs = [f"legs[{j + 1}]" for j in range(len(SIGNS))]
    first = legs[0]
    alpha = [np.arctan2(-of(f"{p}.base.axis.x"), of(f"{p}.base.axis.y")) for p in legs]
    sizes = [
        of(f"{first}.{field}")
        for field in ("platform.hinge.x", "base.arm", "base.radial", "length.constant")
    ]
    wrapped = [np.mod(a + 0.5, 2 * np.pi) - 0.5 for a in alpha]
    return np.stack([*sizes, *wrapped, *(-of(f"{p}.base.angle") for p in legs)], axis=-1)


def control_residuals(machine: Machine, fit: Fitted, truth: Truth) -> Residuals:
    """What the inverse kinematics wants at the control poses' photographs, less the readings."""
    n = truth.n_calibration
    seen = truth.seen[:, n:]
    poses = inverted(fit.T_camera_base)[:, None] @ seen @ inverted(fit.T_mount)[:, None]
    own = taken(machine.layout.motion, poses).pose
    wanted = inverse(machine.layout, fit.theta[:, None], own)
    return _residuals(wanted - truth.joints[:, n:])


def residuals_before(machine: Machine, truth: Truth) -> Residuals:
    """The same with the drawing, at the true poses: what a controller would be wrong by."""
    n = truth.n_calibration
    wanted = inverse(machine.layout, machine.parameters.drawing, truth.poses[:, n:])
    return _residuals(wanted - truth.joints[:, n:])


def _residuals(off: Array) -> Residuals:
    return Residuals(off.mean(axis=1), np.sqrt(np.mean(off**2, axis=1)))


class Before(NamedTuple):
    """[C] IV.C: mean error of the nacelle with the drawing, m and rad."""

    shift: float
    turn: float


def before(machine: Machine, truth: Truth, count: int = 400) -> Before:
    """The drawing's poses against the true ones at the same readings, in the machine's frame."""
    poses = workspace(count, np.random.default_rng(0))
    readings = inverse(truth.machine.layout, truth.theta[0], poses)
    found = forward(machine.layout, machine.parameters.drawing, readings, poses).T_base_platform
    shift = np.linalg.norm(found[:, :3, 3] - poses[:, :3, 3], axis=1)
    turn = rotation_vector(found[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], -1, -2))
    return Before(float(shift.mean()), float(np.linalg.norm(turn, axis=1).mean()))


def straightness(
    machine: Machine, theta: Array, truth: Truth, settings: Settings, rng: np.random.Generator
) -> Array:
    """[C] Table 4: root mean square distance (B, 4) of poses along a ruler from their best line.

    Two directions of each of RULERS. The tool is led along the true line; poses come from the
    readings by the machine (B, P).
    """
    ways = [length * rule for length in RULERS for rule in RULES]
    return np.stack([_off_line(machine, theta, truth, settings, way, rng) for way in ways], axis=-1)


def _off_line(
    machine: Machine, theta: Array, truth: Truth, settings: Settings, way: Array,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """The same of one line, its whole length and direction ``way`` (3,): (B,)."""
    along = np.linspace(-0.5, 0.5, POINTS)[:, None] * way
    poses = schoenflies(np.concatenate([MIDDLE + along, np.zeros((POINTS, 1))], axis=1))
    readings = inverse(truth.machine.layout, truth.theta[:, None], poses)
    readings = readings + settings.joint_noise * rng.normal(size=readings.shape)
    found = forward(machine.layout, theta[..., None, :], readings, poses).T_base_platform
    points = found[..., :3, 3]
    s = np.linalg.svd(points - points.mean(axis=-2, keepdims=True), compute_uv=False)
    return np.sqrt(np.sum(s[..., 1:] ** 2, axis=-1) / POINTS)


def square(machine: Machine, theta: Array, truth: Truth) -> Array:
    """[C] IV.D: error (B, 4) of a square's sides, m, where the controller has the machine (B, P).

    It asks for the corners by its inverse kinematics; the true machine goes where that leads.
    """
    corners = MIDDLE + SIDE / 2 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    poses = schoenflies(np.concatenate([corners, np.zeros((4, 1))], axis=1))
    readings = inverse(machine.layout, theta[..., None, :], poses)
    went = forward(truth.machine.layout, truth.theta[:, None], readings, poses).T_base_platform
    points = went[..., :3, 3]
    sides = np.linalg.norm(np.roll(points, -1, axis=-2) - points, axis=-1)
    return sides - SIDE
