"""Visibility, singularities and other equilibria of visual servoing by the legs.

The control comes to rest where N^T e = 0: at the goal; at another pose with the same image of the
legs, e = 0; or at a pose where the legs' errors cancel. The directions of three legs, for instance,
leave several poses of a platform with six degrees of freedom, as three points seen by a camera do.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.control.laws import Task, task_of
from pkmcal.control.machine_view import MachineView, legs_at, moved_to, true_edges
from pkmcal.control.simulation import outside, platform_joints
from pkmcal.geometry.rigid import dot, perturb
from pkmcal.mechanisms.kinematics import on_manifold
from pkmcal.mechanisms.velocities import assembly_sign

UNSEEN_MOTION_VISIBILITY = 1e-6
"""Visibility below which a motion is unobservable; rounding leaves 1e-9."""
FADING_VISIBILITY_SHARE = 0.1
"""Share of the median visibility below which a pose is close to one with an unobservable motion."""
MOST_DESCENT_STEPS = 80
DESCENT_END_STEP = 1e-13
"""Length of a step, in m or rad, below which a descent has converged."""
INDISTINGUISHABLE_ERROR = 1e-7
"""Norm of e below which two poses have the same image: about 1e-4 px."""
CANCELLED_ERROR_SHARE = 1e-6
"""Norm of N^T e relative to |N| |e| below which the errors cancel."""
DIFFERENT_POSE_DISTANCE = 1e-3
"""RMS distance of the platform's joints, in metres, above which two poses differ."""


def matrix_at(view: MachineView, law: str, poses: Array) -> Array:
    """Interaction N (R, s, k 3, f) at goal poses (R, 4, 4), by the free twists in metres."""
    task = _task(view, law, poses, true_edges(view, poses))
    return task.matrix.reshape(len(poses), len(view.legs), -1, task.matrix.shape[-1])


def _task(view: MachineView, law: str, poses: Array, goal: Array) -> Task:
    legs = legs_at(view, poses)
    legs = moved_to(legs, legs.b.mean(axis=-2))
    return task_of(law, view, true_edges(view, poses), goal, legs)


def visibility(matrix: Array) -> Array:
    """Smallest singular value of N (..., s, k, f) relative to its largest, (...); 0 if N is rank
    deficient.
    """
    rows = matrix.reshape(*matrix.shape[:-3], -1, matrix.shape[-1])
    values = np.linalg.svd(np.nan_to_num(rows), compute_uv=False)
    if rows.shape[-2] < rows.shape[-1]:
        return np.zeros(values.shape[:-1])
    return values[..., -1] / np.maximum(values[..., 0], 1e-300)


@dataclass(frozen=True)
class Subset:
    """Subset of the legs, with the visibility of the platform's motion by it.

    legs : numbers from 0. worst, usual : smallest and median visibility over the workspace.
    """

    legs: tuple[int, ...]
    worst: float
    usual: float

    @property
    def blind(self) -> bool:
        """Whether some motion is unobservable over most of the workspace."""
        return self.usual < UNSEEN_MOTION_VISIBILITY

    @property
    def fading(self) -> bool:
        """Whether some motion is hardly observable at some poses."""
        return self.worst < FADING_VISIBILITY_SHARE * self.usual


def subsets(matrix: Array, legs: Integers) -> tuple[Subset, ...]:
    """All subsets of the legs by size, and by their worst visibility within a size.

    matrix : (R, s, k, f) of all legs. legs : (s,) their numbers from 0.
    """
    results: list[Subset] = []
    for size in range(1, len(legs) + 1):
        several: list[Subset] = []
        for rows in combinations(range(len(legs)), size):
            values = visibility(matrix[:, list(rows)])
            numbers = tuple(int(legs[row]) for row in rows)
            several.append(Subset(numbers, float(values.min()), float(np.median(values))))
        results += sorted(several, key=lambda subset: -subset.worst)
    return tuple(results)


@dataclass(frozen=True)
class Equilibria:
    """Points at which the control may come to rest, from S starts to each of G goals.

    reached, same_image, cancelled, out : shares of the descents that end at the goal; at another
    pose with the same image; where errors cancel; and outside the workspace.
    T_base_platform : (k, 4, 4) poses other than the goal, in the workspace and in the goal's
    assembly mode. goal : (k,) number of the goal. same_edges : (k,) whether the image is the
    goal's. distance : (k,) RMS distance of the platform's joints from the goal, m. readings : (k,)
    largest difference of a reading from the goal's, m or rad.
    """

    reached: float
    same_image: float
    cancelled: float
    out: float
    T_base_platform: Array
    goal: Integers
    same_edges: Booleans
    distance: Array
    readings: Array


def equilibria(view: MachineView, law: str, goals: Array, starts: Array) -> Equilibria:
    """Descents of |e|^2 from starts (S, 4, 4) to every goal (G, 4, 4), batched.

    The search is not exhaustive: equilibria may be missed.
    """
    machine = view.machine
    g, s = len(goals), len(starts)
    # descents from all starts to all goals
    goal = np.repeat(goals, s, axis=0)
    poses = _descended(view, law, np.tile(starts, (g, 1, 1)), true_edges(view, goal))
    # |e| and |N^T e| at their ends
    task = _task(view, law, poses, true_edges(view, goal))
    size = np.sqrt(dot(task.error, task.error))
    slope = (task.matrix.mT @ task.error[..., None])[..., 0]
    largest = np.sqrt(np.sum(task.matrix**2, axis=(-1, -2)))
    # distance from the goal, and whether the end is in the workspace and the goal's assembly mode
    off = platform_joints(machine, poses) - platform_joints(machine, goal)
    distance = np.sqrt(np.mean(dot(off, off), axis=-1))
    readings, wanted = machine.inverse(poses), machine.inverse(goal)
    inside = ~outside(machine, readings)
    here, there = (assembly_sign(machine.layout, view.theta, T) for T in (poses, goal))
    inside &= here * there >= 0
    # kinds of ends: at the goal, at another pose with the same image, where errors cancel
    indistinguishable = size < INDISTINGUISHABLE_ERROR
    flat = np.sqrt(dot(slope, slope)) < CANCELLED_ERROR_SHARE * largest * np.maximum(
        size, INDISTINGUISHABLE_ERROR
    )
    at_goal = indistinguishable & (distance < DIFFERENT_POSE_DISTANCE)
    other = inside & ~at_goal & (indistinguishable | flat)
    goal_of = np.repeat(np.arange(g), s)
    retained = _distinct(platform_joints(machine, poses), other, goal_of)
    return Equilibria(
        reached=float(at_goal.mean()),
        same_image=float((other & indistinguishable).mean()),
        cancelled=float((other & ~indistinguishable).mean()),
        out=float((~inside & ~at_goal).mean()),
        T_base_platform=poses[retained],
        goal=goal_of[retained],
        same_edges=indistinguishable[retained],
        distance=distance[retained],
        readings=np.abs(readings - wanted).max(axis=-1)[retained],
    )


def _descended(view: MachineView, law: str, poses: Array, goal: Array) -> Array:
    """Poses (R, 4, 4) after Levenberg-Marquardt steps on |e|^2 along the free twists."""
    layout, theta = view.machine.layout, view.theta
    bound = layout.n_equations > layout.driven_rows.size or layout.shares_motors
    damping = np.full(len(poses), 1e-3)
    now = _Slope.of(_task(view, law, poses, goal))
    for _ in range(MOST_DESCENT_STEPS):
        # an overdetermined closure: return each trial to the poses that it allows
        step = now.step(damping, poses)
        if np.abs(step).max() < DESCENT_END_STEP:
            break
        trial = perturb(poses, step)
        if bound:
            trial = on_manifold(layout, theta, trial).T_base_platform
        new = _Slope.of(_task(view, law, trial, goal))
        with np.errstate(invalid="ignore"):
            better = new.cost < now.cost
        poses = np.where(better[:, None, None], trial, poses)
        now = now.replaced(new, better)
        damping = np.clip(np.where(better, damping * 0.1, damping * 10), 1e-12, 1e8)
    return poses


@dataclass(frozen=True)
class _Slope:
    """Error and linearization (R, ...) of a task, as a descent needs them."""

    error: Array
    matrix: Array
    twist: Array
    pivot: Array

    @classmethod
    def of(cls, task: Task) -> _Slope:
        matrix = np.nan_to_num(task.matrix)
        return cls(np.nan_to_num(task.error, nan=1e3), matrix, task.twist, task.legs.pivot)

    @property
    def cost(self) -> Array:
        return dot(self.error, self.error)

    def replaced(self, new: _Slope, where: Booleans) -> _Slope:
        """Rows of `new` where the mask is True, own rows elsewhere."""
        pairs = zip(vars(self).values(), vars(new).values(), strict=True)
        return _Slope(*(np.where(where.reshape(-1, *[1] * (b.ndim - 1)), b, a) for a, b in pairs))

    def step(self, damping: Array, poses: Array) -> Array:
        """Damped steps (R, 6) as twists at the platform's origin, limited to 0.1 m."""
        turned = self.matrix.mT
        normal = turned @ self.matrix
        scale = np.trace(normal, axis1=-2, axis2=-1) / normal.shape[-1] + 1e-300
        normal = normal + (damping * scale)[:, None, None] * np.eye(normal.shape[-1])
        step = -np.linalg.solve(normal, turned @ self.error[..., None])[..., 0]
        size = np.sqrt(dot(step, step))[:, None]
        step = step * np.minimum(1.0, 0.1 / np.maximum(size, 1e-300))
        twist = (self.twist @ step[..., None])[..., 0]
        shifted = twist[:, 3:] + np.cross(twist[:, :3], poses[:, :3, 3] - self.pivot)
        return np.concatenate([twist[:, :3], shifted], axis=-1)


def _distinct(joints: Array, which: Booleans, goal_of: Integers) -> Integers:
    """Row numbers of the distinct poses among the selected rows, for each goal."""
    distinct_rows: list[int] = []
    for row in np.flatnonzero(which):  # few distinct poses: a loop is cheap
        same = [k for k in distinct_rows if goal_of[k] == goal_of[row]]
        off = joints[same] - joints[row]
        if (
            not same
            or np.sqrt(np.mean(np.sum(off**2, axis=-1), axis=-1)).min() > DIFFERENT_POSE_DISTANCE
        ):
            distinct_rows.append(int(row))
    return np.array(distinct_rows, dtype=int)
