"""What a controller may believe of a machine's geometry, [B] Fig. 10, for many runs at once.

E1: the drawing, laid on the identified base centres ([B] eq. 15). E2: the identified geometry. E3:
the drawing, with the camera's place measured by hand. Beside them the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.control.seen import SeenMachine
from pkmcal.geometry.rigid import apply, inverse, perturb, pose, register, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends

HAND_POSITION = 0.03
HAND_ROTATION = float(np.deg2rad(3))
"""m and rad by which a camera's place is wrong that was measured by ruler and eye."""


@dataclass(frozen=True)
class Uncertainty:
    """What a calibration leaves open.

    covariance : (P, P) of the machine's values. rotation, translation : standard deviations (3,)
    of T_base_camera's six numbers, rad and m, base axes.
    """

    covariance: Array
    rotation: Array
    translation: Array


@dataclass(frozen=True)
class Estimate:
    """One estimate of the geometry. seen : values (R, P) and camera's places (R, 4, 4)."""

    name: str
    title: str
    seen: SeenMachine


def estimates(
    true: SeenMachine,
    drawing: Array,
    uncertainty: Uncertainty,
    runs: int,
    rng: np.random.Generator,
    hand_position: float = HAND_POSITION,
    hand_rotation: float = HAND_ROTATION,
) -> tuple[Estimate, ...]:
    """The truth, the identified geometry, the drawing fitted to it, and the drawing by hand.

    true : the machine that is controlled. drawing : (P,) values. Every run has its own error of
    calibration, drawn from the uncertainty, and its own error by hand: of the given sizes, in
    random directions.
    """
    identified = _identified(true, uncertainty, runs, rng)
    drawn = true.machine.with_values(drawing)
    fitted = _fitted(drawn, identified)
    exact = _fitted(drawn, replace(true, T_camera_base=_many(true.T_camera_base, runs)))
    by_hand = _moved_by_hand(exact, hand_position, hand_rotation, rng)
    return (
        Estimate("true", "True geometry", _repeated(true, runs)),
        Estimate("identified", "Identified", identified),
        Estimate("cad", "Drawing, fitted", fitted),
        Estimate("hand", "By hand", by_hand),
    )


def _many(T: Array, runs: int) -> Array:
    return np.broadcast_to(T, (runs, 4, 4))


def _repeated(true: SeenMachine, runs: int) -> SeenMachine:
    values = np.broadcast_to(true.theta, (runs, true.theta.shape[-1]))
    machine = true.machine.with_values(values)
    return replace(true, machine=machine, T_camera_base=_many(true.T_camera_base, runs))


def _identified(
    true: SeenMachine, uncertainty: Uncertainty, runs: int, rng: np.random.Generator
) -> SeenMachine:
    """Values and camera's places as a calibration would have them."""
    size, axes = np.linalg.eigh(uncertainty.covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    values = true.theta + rng.standard_normal((runs, len(size))) @ root.T
    sigma = np.concatenate([uncertainty.rotation, uncertainty.translation])
    T_base_camera = perturb(inverse(true.T_camera_base), rng.standard_normal((runs, 6)) * sigma)
    machine = true.machine.with_values(values)
    return replace(true, machine=machine, T_camera_base=inverse(T_base_camera))


def _fitted(drawing: Machine, seen: SeenMachine) -> SeenMachine:
    """The drawing with the camera where the seen machine's base centres put it, [B] eq. 15."""
    middle, poses = drawing.middle_readings(), np.eye(4)
    here = limb_ends(drawing.layout, drawing.values, middle, poses).a
    there = limb_ends(seen.machine.layout, seen.theta, middle, poses).a
    target = apply(seen.T_camera_base[..., None, :, :], there)
    T = register(np.broadcast_to(here, target.shape), target)
    return replace(seen, machine=drawing, T_camera_base=T)


def _moved_by_hand(
    seen: SeenMachine, position: float, turn: float, rng: np.random.Generator
) -> SeenMachine:
    """The camera's places off by the sizes, m and rad, in random directions."""
    way, axis = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in _normal(seen, rng))
    T = inverse(seen.T_camera_base)
    moved = pose(rotation(turn * axis) @ T[..., :3, :3], T[..., :3, 3] + position * way)
    return replace(seen, T_camera_base=inverse(moved))


def _normal(seen: SeenMachine, rng: np.random.Generator) -> Array:
    return rng.standard_normal((2, *seen.T_camera_base.shape[:-2], 3))
