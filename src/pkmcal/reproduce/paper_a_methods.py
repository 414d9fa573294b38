"""The methods that [A] 4.3 compares, on simulated runs, and how far each is from the truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import apply, inverse, perturb, register, rotation_vector
from pkmcal.identify.bundle import BatchResult, solve_batch
from pkmcal.identify.covariance import information
from pkmcal.identify.gauge import ThreeCentres, centre_index, generators, projector
from pkmcal.identify.residuals import BatchState, Problem
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward
from pkmcal.papers.four_step import Form, FourSteps, centres_from_axes, solve
from pkmcal.reproduce.paper_a_simulation import Settings, Truth, measured_axes
from pkmcal.solver import RESTART_DAMPING

POSES = 10
"""Poses a run at which the end-effector is compared, [A] 4.3."""


class Start(NamedTuple):
    """Where the joint estimate begins: theta (B, P), T_camera_base (B, S, 4, 4)."""

    theta: Array
    T_camera_base: Array


class Errors(NamedTuple):
    """Errors of runs: the thirty parameters (B, 30), m; displacement and angle of the
    end-effector with frames by three centres, then registered on all, (B, 4), m and rad.
    """

    thirty: Array
    effector: Array


class Thirty(NamedTuple):
    """The thirty parameters of [A] Fig. 4: names such as ``A2 x``, rows (30, P) that give them
    from a machine's parameters, the drawing's values (30,), m.
    """

    names: tuple[str, ...]
    rows: Array
    drawing: Array


def four_steps(machine: Machine, settings: Settings, truth: Truth) -> dict[Form, FourSteps]:
    """The four steps as printed and corrected."""
    axes = measured_axes(machine, settings, truth)
    a_camera, found = centres_from_axes(axes, 3)
    forms: tuple[Form, Form] = ("printed", "corrected")
    return {form: solve(machine, axes, a_camera, found, form) for form in forms}


def parameters_of(machine: Machine, steps: FourSteps) -> Array:
    """All parameters (B, P) with those that the steps found."""
    base, platform = centre_index(machine.layout)
    theta = np.broadcast_to(machine.parameters.drawing, (len(steps.base), len(machine.parameters)))
    theta = theta.copy()
    theta[:, base], theta[:, platform] = steps.base, steps.platform
    theta[:, machine.layout.rod] = steps.offsets
    return theta


def start_off_drawing(machine: Machine, truth: Truth, error: Array) -> Start:
    """A start without the four steps: parameters error (B, P) off the drawing, stations off by
    a few degrees and centimetres.
    """
    guess = perturb(truth.T_camera_base, np.array([0.03, -0.02, 0.03, 0.01, -0.01, 0.02]))
    theta = machine.parameters.drawing + error
    return Start(theta, np.broadcast_to(guess, (len(theta), *guess.shape)))


def joint(machine: Machine, problem: Problem, truth: Truth, start: Start) -> BatchResult:
    """The joint estimate; poses start by forward kinematics from the readings."""
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    poses = forward(machine.layout, start.theta[:, None], truth.joints, home).T_base_platform
    z = machine.parameters.to_free(start.theta)
    state = BatchState(z, start.T_camera_base, poses, np.zeros((len(z), 1, 1)))
    return solve_batch(problem, state, robust=False, scale_noise=False, damping=RESTART_DAMPING)


def bound(machine: Machine, problem: Problem, truth: Truth) -> Array:
    """Square root (B, P, nz) of the Cramér-Rao covariance, frames by three centres, at the truth.

    An efficient estimate's errors are this matrix times independent unit normals.
    """
    z = machine.parameters.to_free(truth.theta)
    n = len(z)
    T = np.broadcast_to(truth.T_camera_base, (n, *truth.T_camera_base.shape))
    info = information(problem, BatchState(z, T, truth.T_base_platform, np.zeros((n, 1, 1))))
    nz = problem.free.shape[1]
    change = projector(machine, truth.theta, ThreeCentres())
    spread = problem.free - generators(machine.layout, truth.theta) @ change @ problem.free
    values, vectors = np.linalg.eigh(info.covariance[:, :nz, :nz])
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    return spread @ root @ np.swapaxes(vectors, -1, -2)  # the symmetric root is unique


def evaluated(machine: Machine, theta: Array, truth: Truth, rng: np.random.Generator) -> Errors:
    """Errors of parameters (B, P) and of the end-effector at ten random poses a run, [A] 20.

    Displacement and angle are means over the poses, once with frames by three centres and once
    with frames registered on all centres.
    """
    low, high = machine.joint_ranges.T
    readings = rng.uniform(low, high, (len(theta), POSES, len(low)))
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    T, T_true = (
        forward(machine.layout, p[:, None], readings, home).T_base_platform
        for p in (theta, truth.theta)
    )
    base, platform = centre_index(machine.layout)
    e = register(theta[:, base], truth.theta[:, base])[:, None]
    f = register(theta[:, platform], truth.theta[:, platform])[:, None]
    b1 = truth.theta[:, None, platform[0]]  # the frames hold A1 and B1 at the drawing's values
    columns: list[Array] = []
    for moved in (T, e @ T @ inverse(f)):
        columns.append(np.linalg.norm(apply(moved, b1) - apply(T_true, b1), axis=-1).mean(axis=1))
        turn = moved[..., :3, :3] @ np.swapaxes(T_true[..., :3, :3], -1, -2)
        columns.append(np.linalg.norm(rotation_vector(turn), axis=-1).mean(axis=1))
    return Errors((theta - truth.theta) @ thirty(machine).rows.T, np.stack(columns, axis=-1))


def thirty(machine: Machine) -> Thirty:
    """Frames by the centres 1, 3 and 5: origin in the first, x to the third, the fifth in the x-y
    plane. Six coordinates of each body vanish by that; twelve each are left, then the offsets.
    """
    drawing = machine.parameters.drawing
    held = {(0, 0), (0, 1), (0, 2), (2, 1), (2, 2), (4, 2)}
    names: list[str] = []
    rows: list[Array] = []
    values: list[float] = []
    for letter, index in zip("AB", centre_index(machine.layout), strict=True):
        points = drawing[index]
        frame = _frame(points[0], points[2], points[4])
        for leg, axis in sorted(set(np.ndindex(6, 3)) - held):
            row = np.zeros(len(drawing))
            row[index[leg]] = frame[axis]
            names.append(f"{letter}{leg + 1} {'xyz'[axis]}")
            rows.append(row)
            values.append(float(frame[axis] @ (points[leg] - points[0])))
    names += [f"q{leg + 1}" for leg in range(6)]
    rows += list(np.eye(len(drawing))[machine.layout.rod])
    values += drawing[machine.layout.rod].tolist()
    return Thirty(tuple(names), np.array(rows), np.array(values))


def _frame(origin: Array, along: Array, inside: Array) -> Array:
    """Rows x, y, z (3, 3) of the frame with x to ``along`` and ``inside`` in its x-y plane."""
    x = (along - origin) / np.linalg.norm(along - origin)
    z = np.cross(x, inside - origin)
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])
