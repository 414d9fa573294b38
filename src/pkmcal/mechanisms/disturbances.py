"""Readings under a load and in warmth: what weight and temperature do to a machine's drives.

Weight. Without friction, motor power equals platform power, so the weight's wrench w on the
platform is a force J^T w on the readings, with J the forward Jacobian
(:mod:`pkmcal.mechanisms.velocities`). A drive of stiffness k yields by J^T w / k: its true motion
is the reading plus that, negative where a leg is compressed.

Warmth. With a temperature T, of lengths that hold at T0, a length L is L (1 + g (T - T0)), with one
coefficient g for drives (screws, racks and their zeros) and one for the frame (joint centres, arms,
rods of constant length). What a growth of parameters theta does to a closure c equals a change of
its reading q, to first order: ``dc/dq dq = dc/dtheta dtheta``.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import cross
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.mechanisms.document import Growth
from pkmcal.mechanisms.kinematics import inverse_result, readings_at_poses
from pkmcal.mechanisms.machine import Machine


def weight_on_readings(machine: Machine, poses: Array) -> Array:
    """Forces (..., m) of the load's weight along each reading, N, of a crank N m, at poses
    T_base_platform (..., 4, 4); zero without a load, and at singular poses.
    """
    load = machine.document.load
    if load is None:
        return np.zeros((*poses.shape[:-2], machine.n_joints))
    weight = np.broadcast_to(load.mass * np.array(load.gravity), (*poses.shape[:-2], 3))
    moment = cross(poses[..., :3, :3] @ np.array(load.center), weight)
    wrench = np.concatenate([moment, weight], axis=-1)
    force = machine.forward_jacobian(poses).mT @ wrench[..., None]
    return np.nan_to_num(force[..., 0])


def compliance(machine: Machine) -> Array | None:
    """Compliance (m,) of each drive, m/N or rad/(N m); None where the file states no stiffness."""
    legs, column = machine.document.legs, machine.layout.actuated
    first = [legs[int(np.argmax(column == m))].stiffness for m in range(machine.n_joints)]
    return None if None in first else 1 / np.array(first, dtype=float)


def sag(machine: Machine, poses: Array) -> Array:
    """What each drive yields by under the load (..., m), m or rad; zero without a stiffness."""
    yields = compliance(machine)
    return weight_on_readings(machine, poses) * (0.0 if yields is None else yields)


def tool_shift(machine: Machine, poses: Array, readings: Array) -> Array:
    """Shift (..., 3) of the platform's origin by changes of the readings (..., m), m."""
    return (machine.forward_jacobian(poses) @ readings[..., None])[..., 3:, 0]


def growth_of(machine: Machine, temperature: Array) -> Growth:
    """Growth that the file states; otherwise 0 +- steel's, about the mean of temperatures (K,)."""
    return machine.document.growth or Growth(temperature=float(temperature.mean()))


def growth_by_readings(machine: Machine, joints: Array, poses: Array) -> Array:
    """Derivatives (K, m, 2) of the readings (K, m) at poses (K, 4, 4) by the growth g (T - T0) of
    drives and of the frame.
    """
    layout = machine.layout
    internal = np.nan_to_num(inverse_result(layout, machine.values, poses)[1])
    at = closure(layout, machine.values, joints, poses, internal)
    slope = at.by_reading[..., None] * layout.of_motor
    square = np.sum(slope**2, axis=1)
    by_theta = dense(at, len(machine.parameters)) * machine.values

    def as_readings(parameters: Booleans) -> Array:
        grown = np.sum(by_theta[..., parameters], axis=-1)
        return np.sum(slope * grown[..., None], axis=1) / square

    of_drives, of_frame = _growing(machine)
    moved = np.where(np.array(machine.joint_units) == "m", joints, 0.0)
    return np.stack([moved + as_readings(of_drives), as_readings(of_frame)], axis=-1)


def grown_readings(machine: Machine, poses: Array, growth: Array) -> Array:
    """Readings (K, m) at poses (K, 4, 4) of the machine whose drives and frame have grown by
    ``growth`` (K, 2), exactly.
    """
    theta = np.broadcast_to(machine.values, (len(poses), len(machine.values))).copy()
    for k, parameters in enumerate(_growing(machine)):
        theta[:, parameters] *= 1 + growth[:, k, None]
    readings = readings_at_poses(machine.layout, theta, poses)
    return np.where(np.array(machine.joint_units) == "m", readings / (1 + growth[:, :1]), readings)


def _growing(machine: Machine) -> tuple[Booleans, Booleans]:
    """Parameters (P,) that grow with the drives, and those that grow with the frame."""
    table = machine.parameters
    lengths = np.array(table.units) == "m"
    zeros = np.array([part == "zero" for part in table.parts])
    return lengths & zeros, lengths & ~zeros
