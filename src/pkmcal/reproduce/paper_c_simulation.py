"""The simulated measurements of [C] IV: an H4, a board on its nacelle, a camera on its base.

81 poses on a grid of 200 x 200 x 150 mm and -20, 0, 20 degrees, 71 drawn for the calibration and 10
for control; board poses with 0.2 mm and 0.03 degrees of noise a component. Truths: the machine that
the paper identified (Model 12), one with every arm its own (Model 31), one whose forearms are two
rods of different length. Runs are batched: B of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import look_at, perturb, pose, rotation
from pkmcal.measurements import EdgeSet, Measurements, Mount, PoseSet
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.mechanisms.kinematics import inverse, on_manifold

Kind = Literal["design", "calibration", "rods"]
MIDDLE = np.array([0.0, 0.0, -0.45])
HALF = np.array([0.1, 0.1, 0.075, np.radians(20.0)])
"""Half of the measured volume ([C] IV.A), m and rad."""
LARGER = 1.25
"""Half sizes of the workspace that errors are also told over, by those of the measured volume. The
errata's prototype does not name its own; this one fits its figures."""
ROD_DRAWING = 1e-3, 0.035
"""Tolerances of lengths (m) and angles (rad, 2 degrees) of the machine with rods, which needs a
drawing: about 59 of its parameters are better known than by this one."""
SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""(s, t) of the nacelle's four corners, errata [C]."""


@dataclass(frozen=True)
class Settings:
    """turn, shift : standard deviations of a board's pose, rad and m a component. joint_noise : of
    a reading, rad. error, axis_error : of Model 31's parameters, m and rad. rods : m, of the
    difference between two rods of a forearm. control : poses that are held back.
    """

    turn: float = float(np.radians(0.03))
    shift: float = 2e-4
    joint_noise: float = 1e-5
    error: float = 1e-3
    axis_error: float = 4e-3
    rods: float = 3e-4
    control: int = 10

    @property
    def sigma(self) -> Array:
        """(6,) of (omega, tau)."""
        return np.repeat([self.turn, self.shift], 3)


class Table2(NamedTuple):
    """[C] Table 2: h, the arm (0.26 m), R, the forearm (0.48 m), and four angles and offsets."""

    h: float
    arm: float
    radius: float
    rod: float
    alpha: tuple[float, float, float, float]
    q0: tuple[float, float, float, float]


A_PRIORI = Table2(0.06, 0.26, 0.14, 0.48, (0, 3.1416, 4.7124, 4.7124), (0, 0, 0, 0))
IDENTIFIED = Table2(
    0.0610, 0.26, 0.1413, 0.4876,
    (-0.0015, 3.1016, 4.6807, 4.6859), (-0.0662, -0.0080, -0.0476, -0.0561),
)  # fmt: skip


class Truth(NamedTuple):
    """Simulated runs. machine : of the truth, its document. theta (B, P). poses (B, 81, 4, 4)
    T_base_platform, calibration first; joints (B, 81, m) measured; seen (B, 81, 4, 4) the board's
    measured poses. T_camera_base, T_platform_board (4, 4).
    """

    machine: Machine
    theta: Array
    poses: Array
    joints: Array
    seen: Array
    T_camera_base: Array
    T_platform_board: Array
    n_calibration: int


@cache
def model(kind: Kind) -> Machine:
    """The catalogue's H4 with one of its models; of rods, drawn as well as ROD_DRAWING says."""
    machine = load_mechanism("h4", model=kind)
    if kind != "rods":
        return machine
    table = machine.parameters
    length, angle = ROD_DRAWING
    tolerance = np.where(np.array(table.units) == "m", length, angle)
    return replace(machine, parameters=replace(table, tolerance=tolerance))


def table_2_values(machine: Machine, table: Table2) -> Array:
    """Parameters (P,) of the H4 with a column of Table 2; Q = q - q0, so ``angle`` is -q0."""
    names = machine.parameters.index
    out = machine.parameters.drawing.copy()
    for j, (s, _) in enumerate(SIGNS):
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


def schoenflies(x: Array) -> Array:
    """Poses (..., 4, 4) of (X, Y, Z, theta), (..., 4)."""
    turn = x[..., 3:] * np.array([0.0, 0.0, 1.0])
    return pose(rotation(turn), x[..., :3])


def grid() -> Array:
    """The 81 poses of [C] IV.A, (81, 4, 4)."""
    steps = [np.linspace(-half, half, 3) for half in HALF]
    x = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 4)
    return schoenflies(x + np.append(MIDDLE, 0.0))


def workspace(count: int, rng: np.random.Generator, larger: float = 1.0) -> Array:
    """Random poses (count, 4, 4) in the measured volume, or in a larger one about its middle."""
    x = larger * HALF * rng.uniform(-1, 1, (count, 4))
    return schoenflies(x + np.append(MIDDLE, 0.0))


def true_values(kind: Kind, settings: Settings, runs: int, rng: np.random.Generator) -> Array:
    """True parameters (B, P) of the model of that kind."""
    machine = model(kind)
    table = machine.parameters
    if kind == "design":
        return np.broadcast_to(table_2_values(machine, IDENTIFIED), (runs, len(table))).copy()
    kinds = np.array([table.kinds[k] for k in table.first_of_free()])
    sigma = np.select(
        [kinds == "axis", kinds == "angle"], [settings.axis_error, 0.0], settings.error
    )
    if kind == "rods":
        sigma = _alike(machine, sigma)
    values = table.drawing + (sigma * rng.normal(size=(runs, len(sigma)))) @ table.free_matrix().T
    for leg, motor in enumerate(machine.layout.actuated, start=1):
        values[:, table.index(f"legs[{leg}].base.angle")] = -IDENTIFIED.q0[motor]
    if kind == "rods":
        values = _pairs(machine, settings, values, rng)
    return values


def _alike(machine: Machine, sigma: Array) -> Array:
    """The same with hinges and bars true: forearms then are parallelograms but for their rods."""
    names = machine.parameters.free_names()
    still = np.array([".platform." in n or ".along" in n or ".axis" in n for n in names])
    return np.where(still, 0.0, sigma)


def _pairs(machine: Machine, settings: Settings, values: Array, rng: np.random.Generator) -> Array:
    """Both rods of a forearm and both arms of a motor alike, but for the rods' difference."""
    out = values.copy()
    index = machine.parameters.index
    for first in range(1, machine.n_legs, 2):
        for field in ("base.arm", "length.constant"):
            one, other = (index(f"legs[{leg}].{field}") for leg in (first, first + 1))
            out[:, other] = out[:, one]
        apart = settings.rods * rng.normal(size=len(out)) / 2
        out[:, index(f"legs[{first}].length.constant")] += apart
        out[:, index(f"legs[{first + 1}].length.constant")] -= apart
    return out


def placements() -> tuple[Array, Array]:
    """T_camera_base and T_platform_board: about along the axis of rotation, [C] III.C."""
    camera = look_at(np.array([0.03, -0.02, 0.15]), MIDDLE, np.array([1.0, 0.0, 0.0]))
    turned = rotation(np.array([3.05, 0.05, 0.08]))
    return camera, pose(turned, np.array([0.04, -0.03, 0.03]))


def simulate(kind: Kind, settings: Settings, runs: int, rng: np.random.Generator) -> Truth:
    """True machines, their poses, and noisy measurements of ``runs`` runs."""
    machine = model(kind)
    theta = true_values(kind, settings, runs, rng)
    order = np.argsort(rng.random((runs, len(grid()))), axis=1)
    poses = grid()[order]
    if kind == "rods":  # two rods a forearm tilt the nacelle a little
        poses = on_manifold(machine.layout, theta[:, None], poses).T_base_platform
    joints = inverse(machine.layout, theta[:, None], poses)
    camera, mount = placements()
    noise = settings.sigma * rng.normal(size=(*poses.shape[:2], 6))
    seen = perturb(camera @ poses @ mount, noise)
    joints = joints + settings.joint_noise * rng.normal(size=joints.shape)
    return Truth(machine, theta, poses, joints, seen, camera, mount, len(grid()) - settings.control)


def measurements(truth: Truth, settings: Settings, run: int = 0) -> Measurements:
    """One run's calibration poses as a session gives them."""
    n = truth.n_calibration
    none = np.zeros(n, dtype=int)
    whiten = np.broadcast_to(np.diag(1 / settings.sigma), (n, 6, 6))
    poses = PoseSet(none, np.arange(n), none, truth.seen[run, :n], whiten)
    return Measurements(
        EdgeSet.empty(),
        truth.joints[run, :n],
        settings.joint_noise,
        1,
        np.zeros(1, dtype=int),
        poses=poses,
        mounts=(Mount("board", "platform"),),
    )
