"""Control laws by the legs in the image, [B] eq. 4-9 with the errata.

The error is e_j = u_j x u*_j of the legs' directions, or e_ij = n_ij x n*_ij of their edges'
normals; measured and wanted (*), camera frame. Its derivative by the platform's twist is N_j =
-[u*_j]x L_j, where L_j is the direction's interaction matrix, and the motors follow

    q' = -gain D N+ e,        D the inverse Jacobian, [B] eq. 6-7.

[B] eq. 9 holds for fixed base centres. Here the base's end of a leg depends on its reading as well,
A_j(q_j), which covers cranks and sliders: with q' = D twist,

    du_j = (I - u u^T) / length (dB_j - dA_j),    dA_j = (dA_j / dq_j) D_j twist,

which is [B] eq. 9 where dA_j / dq_j = 0. Machines with fewer than six degrees of freedom are
restricted to the twists that they can make. The wanted values are measured too, in an image of the
machine at the goal, so errors of the controller's geometry change the path but not its end.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.control.machine_view import Legs, MachineView, directions_of, legs_from_image, moved_to
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, cross, dot, skew
from pkmcal.levels import ROUNDING

MatrixPlace = Literal["measured", "goal", "mean"]

UNCOMMANDED_MOTION_SHARE = ROUNDING**0.5
"""Singular value of the scaled interaction matrix, relative to the largest, below which a motion is
unobservable and is not commanded: its square, an eigenvalue of the normal equations, is rounding.
Edges of all legs of a hexapod have 0.02 to 0.2, of three legs 0.001."""


class Rates(NamedTuple):
    """Derivatives of readings and hinges by the twist, and the free twists.

    readings : (..., m, 6) D of [B] eq. 6-7.
    hinges : (..., n, 6).
    free : (..., 6, f) orthonormal twists (rotations times the platform's radius) that the machine
        can make.
    """

    readings: Array
    hinges: Array
    free: Array


def rates(view: MachineView, legs: Legs) -> Rates:
    """Derivatives of readings and hinges by the twist, and the twists that the closure allows.

    Least squares where several rods share a motor. NaN where a crank is in line with its rod.
    """
    # platform's radius, by which rotations are scaled to metres
    layout = view.machine.layout
    m, spread = layout.n_readings, legs.b - legs.b.mean(axis=-2, keepdims=True)
    scale = np.sqrt(np.mean(dot(spread, spread), axis=-1))
    scale = np.where(scale > 0, scale, 1.0)
    # closure: rows @ twist + driving @ (readings', hinges') = 0
    driving = np.concatenate([legs.drives, legs.hinges], axis=-1)
    if layout.shares_motors or layout.n_internal:
        solved = -np.linalg.pinv(driving) @ legs.rows
    else:
        column = layout.driven_rows[np.argsort(layout.row_motor[layout.driven_rows])]
        gain = legs.drives[..., column, np.arange(m)]
        usable = np.abs(gain) > 0
        solved = -legs.rows[..., column, :] / np.where(usable, gain, np.nan)[..., None]
    return Rates(solved[..., :m, :], solved[..., m:, :], _free(view, legs, driving, scale))


def _free(view: MachineView, legs: Legs, driving: Array, scale: Array) -> Array:
    """Twists (..., 6, f) allowed by the machine's motion and by the undriven rows of the
    closure.
    """
    layout = view.machine.layout
    units = np.ones((*scale.shape, 6))
    units[..., :3] /= scale[..., None]
    motion = np.broadcast_to(layout.motion, (*scale.shape, *layout.motion.shape))
    bound = driving.shape[-2] - driving.shape[-1]
    # more rows than unknown rates: the left null space of `driving` constrains the twist
    if bound > 0:
        if layout.shares_motors or layout.n_internal:
            blind = np.linalg.qr(driving, mode="complete")[0][..., driving.shape[-1] :]
            rows = blind.mT @ legs.rows
        else:
            rows = legs.rows[..., np.flatnonzero(layout.row_motor < 0), :]
        held = (rows * units[..., None, :]) @ layout.motion
        v = np.linalg.svd(np.nan_to_num(held))[2].mT
        motion = layout.motion @ v[..., bound:]
    return units[..., :, None] * motion


def moving(view: MachineView, legs: Legs, rate: Rates) -> tuple[Array, Array]:
    """Derivatives (..., s, 3, 6) of the seen legs' ends A and B by the twist, base frame."""
    layout = view.machine.layout
    column = layout.actuated[view.legs]
    own = np.where((column >= 0)[:, None], rate.readings[..., np.maximum(column, 0), :], 0.0)
    by_a = legs.a_by_reading[..., view.legs, :, None] * own[..., None, :]
    by_b = legs.b_by_pose[..., view.legs, :, :]
    if layout.n_internal:
        by_b = by_b + legs.b_by_internal[..., view.legs, :, :] @ rate.hinges[..., None, :, :]
    return np.broadcast_to(by_a, by_b.shape), by_b


def direction_interaction(view: MachineView, legs: Legs, rate: Rates | None = None) -> Array:
    """Interaction matrix L (..., s, 3, 6) of the seen legs' directions, camera frame, by the twist.

    [B] eq. 8-9; [B]'s twist has its pivot in the camera's centre, is in the camera frame, and has
    its velocity first. See :class:`pkmcal.control.machine_view.Legs` for the twist used here.
    """
    by_a, by_b = moving(view, legs, rates(view, legs) if rate is None else rate)
    u, length = legs.u[..., view.legs, :], legs.length[..., view.legs, None, None]
    shifted = (by_b - by_a) / length
    across = shifted - u[..., :, None] * (u[..., None, :] @ shifted)
    return view.T_camera_base[..., None, :3, :3] @ across


def edge_interaction(
    view: MachineView, legs: Legs, normals: Array, rate: Rates | None = None
) -> Array:
    """Interaction matrix (..., s, 2, 3, 6) of the edges' normals, camera frame, by the twist.

    normals : (..., s, 2, 3) measured. From n.a = -R, n.b = -R and n.n = 1, as in
    :func:`pkmcal.geometry.cylinders.edge_normal_jacobians`. For a fixed A this is the errata's J L,
    with J = -(A x n) n^T / (u . (A x n)) and the direction's L; [B] 12-13 differentiated.
    """
    by_a, by_b = moving(view, legs, rates(view, legs) if rate is None else rate)
    # ends of the legs and their derivatives, camera frame
    T = view.T_camera_base[..., None, :, :]
    a, b = (apply(T, p[..., view.legs, :])[..., None, :] for p in (legs.a, legs.b))
    by_a, by_b = (T[..., :3, :3] @ by for by in (by_a, by_b))
    side_a, side_b = cross(b, normals), cross(normals, a)
    # [a b n]^T dn = (-n.da, -n.db, 0) by cross products
    with np.errstate(divide="ignore", invalid="ignore"):
        volume = dot(cross(a, b), normals)[..., None, None]
        along_a, along_b = (normals @ by for by in (by_a, by_b))
        return (
            -(
                side_a[..., :, None] * along_a[..., None, :]
                + side_b[..., :, None] * along_b[..., None, :]
            )
            / volume
        )


class Law(ABC):
    """Control law: an error that is regulated to zero, and its derivative by the twist.

    name : on the command line and in files. title : for people.
    """

    name: ClassVar[str]
    title: ClassVar[str]

    @staticmethod
    @abstractmethod
    def error(measured: Array, goal: Array) -> Array:
        """Error (..., s, k, 3) of normals (..., s, 2, 3), measured and wanted."""

    @staticmethod
    @abstractmethod
    def matrix(view: MachineView, legs: Legs, normals: Array, goal: Array, rate: Rates) -> Array:
        """Interaction N (..., s, k, 3, 6) by the twist, for limbs and normals at one moment."""


@final
class DirectionLaw(Law):
    """[B] 8-9 and errata, "Servoing": e = u x u*, N = -[u*]x L."""

    name: ClassVar = "directions"
    title: ClassVar = "directions of the legs"

    @staticmethod
    def error(measured: Array, goal: Array) -> Array:
        """Error (..., s, 1, 3), one vector for each leg."""
        return cross(directions_of(measured), directions_of(goal))[..., None, :]

    @staticmethod
    def matrix(view: MachineView, legs: Legs, normals: Array, goal: Array, rate: Rates) -> Array:
        """Interaction N (..., s, 1, 3, 6)."""
        del normals
        by_twist = -skew(directions_of(goal)) @ direction_interaction(view, legs, rate)
        return by_twist[..., None, :, :]


@final
class EdgeLaw(Law):
    """Errata, "Servoing": e = n x n*, N = -[n*]x J L."""

    name: ClassVar = "edges"
    title: ClassVar = "edges of the legs"

    @staticmethod
    def error(measured: Array, goal: Array) -> Array:
        """Error (..., s, 2, 3), two vectors for each leg."""
        return cross(measured, goal)

    @staticmethod
    def matrix(view: MachineView, legs: Legs, normals: Array, goal: Array, rate: Rates) -> Array:
        """Interaction N (..., s, 2, 3, 6)."""
        return -skew(goal) @ edge_interaction(view, legs, normals, rate)


CONTROL_LAWS: dict[str, type[Law]] = {law.name: law for law in (EdgeLaw, DirectionLaw)}
"""Laws by name. Edges come first: they hold the platform steadier by an order of magnitude."""


def law_named(name: str) -> type[Law]:
    """Law with this name. Raises InputError for an unknown name."""
    if name not in CONTROL_LAWS:
        raise InputError(
            "there is no such law of control", found=name, expected=" or ".join(CONTROL_LAWS)
        )
    return CONTROL_LAWS[name]


@dataclass(frozen=True)
class Task:
    """Linearized control problem at one moment: e changes by ``matrix @ y`` (..., r, f).

    error : (..., r).
    y : amounts of the free twists in metres, rotations as the displacement of the platform's
        joints.
    twist : (..., 6, f).
    readings : (..., m, f) derivatives by y.
    legs : limbs of the controller's model.
    """

    error: Array
    matrix: Array
    twist: Array
    readings: Array
    legs: Legs


def task_of(
    law: str,
    view: MachineView,
    measured: Array,
    goal: Array,
    legs: Legs,
    goal_legs: Legs | None = None,
    at: MatrixPlace = "measured",
) -> Task:
    """Linearization of a law for normals (..., s, 2, 3), measured and wanted.

    goal_legs : limbs at the goal, required if N is taken at the goal or as the mean. Raises
    InputError without them.
    """
    kind, rate = law_named(law), rates(view, legs)
    parts: list[Array] = []
    if at != "goal":
        parts.append(kind.matrix(view, legs, measured, goal, rate))
    if at != "measured":
        if goal_legs is None:
            raise InputError(
                "the interaction at the goal needs the goal's readings",
                expected="goal_readings, or the interaction as measured",
            )
        there = moved_to(goal_legs, legs.pivot)
        parts.append(kind.matrix(view, there, goal, goal, rates(view, there)))
    by_twist = sum(parts[1:], parts[0]) / len(parts)
    error = kind.error(measured, goal)
    by_twist = by_twist.reshape(*by_twist.shape[:-4], -1, 6)
    return Task(
        error=error.reshape(*error.shape[:-3], -1),
        matrix=by_twist @ rate.free,
        twist=rate.free,
        readings=rate.readings @ rate.free,
        legs=legs,
    )


def solution(task: Task) -> Array:
    """Least-squares solution N+ e (..., f); motions below UNCOMMANDED_MOTION_SHARE stay at rest.

    NaN where an edge or a limb is undefined.
    """
    finite = np.asarray(np.isfinite(task.matrix).all(axis=(-1, -2)))
    finite = finite & np.isfinite(task.error).all(axis=-1)
    matrix = np.where(finite[..., None, None], task.matrix, 0.0)
    error = np.where(finite[..., None], task.error, 0.0)
    turned = matrix.mT
    values, vectors = np.linalg.eigh(turned @ matrix)
    observable = values > UNCOMMANDED_MOTION_SHARE**2 * values[..., -1:]
    weights = np.where(
        observable & (values > 0), 1 / np.where(observable & (values > 0), values, 1.0), 0.0
    )
    wanted = vectors.mT @ (turned @ error[..., None])
    step = (vectors @ (weights[..., None] * wanted))[..., 0]
    return np.where(finite[..., None], step, np.nan)


def joint_velocities(
    law: str,
    view: MachineView,
    measured: Array,
    goal: Array,
    readings: Array,
    gain: float,
    *,
    at: MatrixPlace = "measured",
    goal_readings: Array | None = None,
) -> Array:
    """Motor velocities -gain D N+ e, (..., m) per second; errata, "Servoing".

    law : "directions" or "edges".
    measured, goal : (..., s, 2, 3) unit normals of the seen legs' edges, camera frame, sides as in
        :mod:`pkmcal.geometry.cylinders`.
    readings : (..., m).
    gain : 1/s.
    at : where N is evaluated; "goal" and "mean" need goal_readings (..., m). NaN where an edge is
        undefined, or a limb cannot be at its reading.
    """
    legs = legs_from_image(view, directions_of(measured), readings)
    goal_legs = None
    if at != "measured" and goal_readings is not None:
        goal_legs = legs_from_image(view, directions_of(goal), goal_readings)
    task = task_of(law, view, measured, goal, legs, goal_legs, at)
    return -gain * (task.readings @ solution(task)[..., None])[..., 0]


def limited(speeds: Array, fastest: Array | float | None) -> Array:
    """Velocities (..., m) scaled by a common factor so that none exceeds its limit."""
    if fastest is None:
        return speeds
    with np.errstate(invalid="ignore"):
        excess = np.max(np.abs(speeds) / fastest, axis=-1, keepdims=True, initial=1.0)
    return speeds / excess
