"""The simulated H4 of [C] IV, its poses, and the poses of camera and board.

81 poses on a grid of 200 x 200 x 150 mm and -20, 0, 20 degrees. Truths: the machine that the paper
identified (Model 12), a machine with individual arms (Model 31), and a machine whose forearms are
two rods of different length.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import look_at, pose, rotation
from pkmcal.mechanisms import Machine, load_mechanism

H4ModelKind = Literal["design", "calibration", "rods"]
MEASURED_VOLUME_MIDDLE = np.array([0.0, 0.0, -0.45])
MEASURED_VOLUME_HALF = np.array([0.1, 0.1, 0.075, np.radians(20.0)])
"""Half sizes of the measured volume ([C] IV.A), m and rad."""
ROD_NOMINAL = 1e-3, 0.035
"""Prior sigmas of lengths (m) and angles (rad, 2 degrees) of the machine with rods, which needs
priors: about 59 of its parameters are better known than by this nominal model.
"""
NACELLE_CORNER_SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""(s, t) of the nacelle's four corners, errata [C]."""
PAPER_C_CAMERA_POSE = look_at(
    np.array([0.03, -0.02, 0.15]), MEASURED_VOLUME_MIDDLE, np.array([1.0, 0.0, 0.0])
)
"""T_camera_base; the camera looks roughly along the axis of rotation, [C] III.C."""
PAPER_C_BOARD_POSE = pose(rotation(np.array([3.05, 0.05, 0.08])), np.array([0.04, -0.03, 0.03]))
"""T_platform_board."""


class Table2(NamedTuple):
    """Column of [C] Table 2: h, arm (0.26 m), R, forearm (0.48 m), four angles alpha and four
    offsets q0.
    """

    h: float
    arm: float
    radius: float
    rod: float
    alpha: tuple[float, float, float, float]
    q0: tuple[float, float, float, float]


A_PRIORI = Table2(0.06, 0.26, 0.14, 0.48, (0, 3.1416, 4.7124, 4.7124), (0, 0, 0, 0))
IDENTIFIED_TABLE_2 = Table2(
    0.0610, 0.26, 0.1413, 0.4876,
    (-0.0015, 3.1016, 4.6807, 4.6859), (-0.0662, -0.0080, -0.0476, -0.0561),
)  # fmt: skip


class Deviations(NamedTuple):
    """Standard deviations of true machines from the nominal model: of lengths (m), of axes'
    directions (rad), and of the difference between the two rods of a forearm (m).
    """

    length: float = 1e-3
    axis: float = 4e-3
    rods: float = 3e-4


@cache
def model(kind: H4ModelKind) -> Machine:
    """The catalogue's H4 with one of its models; that with rods has the prior sigmas
    ROD_DRAWING.
    """
    machine = load_mechanism("h4", model=kind)
    if kind != "rods":
        return machine
    table = machine.parameters
    length, angle = ROD_NOMINAL
    tolerance = np.where(np.array(table.units) == "m", length, angle)
    return replace(machine, parameters=replace(table, tolerance=tolerance))


def table_2_values(machine: Machine, table: Table2) -> Array:
    """Parameters (P,) of the H4 by a column of Table 2; Q = q - q0, so ``angle`` is -q0."""
    names = machine.parameters.index
    out = machine.parameters.nominal.copy()
    for j, (s, _) in enumerate(NACELLE_CORNER_SIGNS):
        leg, alpha = f"legs[{j + 1}]", table.alpha[j]
        out[names(f"{leg}.platform.hinge.x")] = s * table.h
        out[names(f"{leg}.base.center.x")] = s * table.h
        out[names(f"{leg}.base.axis.x")] = -np.sin(alpha)
        out[names(f"{leg}.base.axis.y")] = np.cos(alpha)
        out[names(f"{leg}.base.arm")] = table.arm
        out[names(f"{leg}.base.radial")] = table.radius
        out[names(f"{leg}.base.angle")] = -table.q0[j]
        out[names(f"{leg}.length.constant")] = table.rod
    return out


def table_2_of(machine: Machine, theta: Array) -> Array:
    """h, arm, R, rod, four alpha, four q0 (B, 12) from the parameters (B, P) of Model 12."""
    index = machine.parameters.index

    def of(name: str) -> Array:
        return theta[..., index(name)]

    legs = [f"legs[{j + 1}]" for j in range(len(NACELLE_CORNER_SIGNS))]
    fields = ("platform.hinge.x", "base.arm", "base.radial", "length.constant")
    alpha = [np.arctan2(-of(f"{p}.base.axis.x"), of(f"{p}.base.axis.y")) for p in legs]
    wrapped = [np.mod(a + 0.5, 2 * np.pi) - 0.5 for a in alpha]
    sizes = [of(f"{legs[0]}.{field}") for field in fields]
    return np.stack([*sizes, *wrapped, *(-of(f"{p}.base.angle") for p in legs)], axis=-1)


def true_values(kind: H4ModelKind, off: Deviations, runs: int, rng: np.random.Generator) -> Array:
    """True parameters (B, P) for a kind of model."""
    machine = model(kind)
    table = machine.parameters
    if kind == "design":
        return np.tile(table_2_values(machine, IDENTIFIED_TABLE_2), (runs, 1))
    kinds = np.array([table.kinds[k] for k in table.first_of_free()])
    sigma = np.select([kinds == "axis", kinds == "angle"], [off.axis, 0.0], off.length)
    if kind == "rods":  # hinges and bars are exact: but for their rods, forearms are parallelograms
        names = table.free_names()
        still = [".platform." in n or ".along" in n or ".axis" in n for n in names]
        sigma = np.where(still, 0.0, sigma)
    theta = table.nominal + (sigma * rng.normal(size=(runs, len(sigma)))) @ table.free_matrix().T
    for leg, motor in enumerate(machine.layout.actuated, start=1):
        theta[:, table.index(f"legs[{leg}].base.angle")] = -IDENTIFIED_TABLE_2.q0[motor]
    return _with_paired_rods(machine, theta, off.rods, rng) if kind == "rods" else theta


def _with_paired_rods(
    machine: Machine, values: Array, rods: float, rng: np.random.Generator
) -> Array:
    """Equal rods of a forearm and equal arms of a motor, except for the difference between the
    rods.
    """
    out = values.copy()
    index = machine.parameters.index
    for first in range(1, machine.n_legs, 2):
        for field in ("base.arm", "length.constant"):
            one, other = (index(f"legs[{leg}].{field}") for leg in (first, first + 1))
            out[:, other] = out[:, one]
        apart = rods * rng.normal(size=len(out)) / 2
        out[:, index(f"legs[{first}].length.constant")] += apart
        out[:, index(f"legs[{first + 1}].length.constant")] -= apart
    return out


def schoenflies(x: Array) -> Array:
    """Poses (..., 4, 4) from (X, Y, Z, theta), (..., 4)."""
    turn = x[..., 3:] * np.array([0.0, 0.0, 1.0])
    return pose(rotation(turn), x[..., :3])


def measured_volume_grid() -> Array:
    """The 81 poses of [C] IV.A, (81, 4, 4)."""
    steps = [np.linspace(-half, half, 3) for half in MEASURED_VOLUME_HALF]
    x = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 4)
    return schoenflies(x + np.append(MEASURED_VOLUME_MIDDLE, 0.0))


def workspace(count: int, rng: np.random.Generator, larger: float = 1.0) -> Array:
    """Random poses (count, 4, 4) in the measured volume, enlarged by a factor about its middle."""
    x = larger * MEASURED_VOLUME_HALF * rng.uniform(-1, 1, (count, 4))
    return schoenflies(x + np.append(MEASURED_VOLUME_MIDDLE, 0.0))
