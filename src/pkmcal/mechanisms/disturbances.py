"""Readings under forces and in warmth: what weight, tension and temperature do to a machine's
drives.

Weight. Without friction, motor power equals platform power, so the weight's wrench w on the
platform is a force J^T w on the readings, with J the forward Jacobian
(:mod:`pkmcal.mechanisms.velocities`). Where forces f on the readings are measured, as the tensions
of cables, they take the place of J^T w.

Compliance. A drive of stiffness k yields by f / k: its true motion is the reading plus that,
negative where a leg is compressed. A leg of length L, axial rigidity EA and derivative s of its
length by the reading is a spring of stiffness EA s^2 / L in series with its drive; legs on one
motor are springs in parallel.

Warmth. With a temperature T, of lengths that hold at T0, a length L is L (1 + g (T - T0)), with one
coefficient g for drives (screws, racks and their zeros) and one for the frame (joint centres, arms,
rods of constant length). What a growth of parameters theta does to a closure c equals a change of
its reading q, to first order: ``dc/dq dq = dc/dtheta dtheta``.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import cross
from pkmcal.mechanisms.closure import by_motors, closure, dense
from pkmcal.mechanisms.document import Growth
from pkmcal.mechanisms.kinematics import closure_at, inverse_result, readings_at_poses
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


def is_compliant(machine: Machine) -> bool:
    """Whether the file states how far the drives or the legs yield."""
    return any(leg.stiffness or leg.axial_rigidity for leg in machine.document.legs)


def compliance(machine: Machine, poses: Array) -> Array:
    """Compliance (..., m) of each reading at poses T_base_platform (..., 4, 4), m/N or rad/(N m),
    by what the file states; zero of what it does not.
    """
    layout, legs = machine.layout, machine.document.legs
    first = [legs[int(np.argmax(layout.actuated == m))] for m in range(machine.n_joints)]
    drives = np.array([1 / leg.stiffness if leg.stiffness else 0.0 for leg in first])
    out = np.broadcast_to(drives, (*poses.shape[:-2], len(drives)))
    if not any(leg.axial_rigidity for leg in legs):
        return out
    at = closure_at(layout, machine.values, poses)
    rigidity = np.array([leg.axial_rigidity or 0.0 for leg in legs])
    spring = (rigidity / at.rows.distance)[..., layout.closing]
    lengths = by_motors(layout, at.by_reading)[..., : spring.shape[-1], :]
    return out + 1 / np.sum(lengths**2 * spring[..., None], axis=-2)


def sag(machine: Machine, poses: Array, forces: Array | None = None) -> Array:
    """What each reading's drive and legs yield by (..., m), m or rad; zero where the file states
    neither a stiffness nor a rigidity.

    forces : (..., m) measured on the readings, N, of cranks and spools N m, positive where readings
        grow; None for those of the load.
    """
    if not is_compliant(machine):
        return np.zeros((*poses.shape[:-2], machine.n_joints))
    if forces is None:
        forces = weight_on_readings(machine, poses)
    return forces * compliance(machine, poses)


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
