"""Control by the legs in the image, [B] eq. 4-9 with the errata.

The error is e_j = u_j x u*_j of the legs' directions, or e_ij = n_ij x n*_ij of their edges'
normals; measured and wanted, camera frame. It changes with the platform's twist by
N_j = -[u*_j]x L_j, where L_j is the direction's interaction matrix, and the drives follow

    q' = -gain D N+ e,        D the inverse Jacobian, [B] eq. 6-7.

[B] eq. 9 holds for base centres that stay where they are. Here the base's end moves with its
reading as well, A_j(q_j), so cranks and sliders are served: with q' = D twist,

    du_j = (I - u u^T) / length (dB_j - dA_j),    dA_j = (dA_j / dq_j) D_j twist,

which is [B] eq. 9 where dA_j / dq_j = 0. Machines with fewer than six freedoms are restricted to
twists that they can make. Wanted values are measured, too (the machine was there once), so errors
of the believed geometry change the way and not the end.
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

MatrixPlace = Literal["measured", "goal", "mean"]

UNCOMMANDED_MOTION_SHARE = 1e-4
"""Singular value of the scaled interaction, as a part of the largest, below which a motion counts
as unseen and is not commanded. Edges of all legs of a hexapod have 0.02 to 0.2, of three legs
0.001."""


class Rates(NamedTuple):
    """How everything moves at one moment.

    readings : (..., m, 6) D of [B] eq. 6-7, by the twist. hinges : (..., n, 6).
    free : (..., 6, f) orthonormal twists (turns times the platform's radius) that the machine can
    make.
    """

    readings: Array
    hinges: Array
    free: Array


def rates(view: MachineView, legs: Legs) -> Rates:
    """Readings' and hinges' rates by the twist, and the twists that nothing forbids.

    Least squares where several rods share a motor. NaN where a crank is in line with its rod.
    """
    layout = view.machine.layout
    m, spread = layout.n_readings, legs.b - legs.b.mean(axis=-2, keepdims=True)
    scale = np.sqrt(np.mean(dot(spread, spread), axis=-1))
    scale = np.where(scale > 0, scale, 1.0)
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
    """Twists (..., 6, f) that neither the motion nor undriven rows of the closure forbid."""
    layout = view.machine.layout
    units = np.ones((*scale.shape, 6))
    units[..., :3] /= scale[..., None]
    motion = np.broadcast_to(layout.motion, (*scale.shape, *layout.motion.shape))
    bound = driving.shape[-2] - driving.shape[-1]
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
    """L (..., s, 3, 6): rates of the seen legs' directions, camera frame, by the twist.

    [B] eq. 8-9; its twist is this one with the pivot in the camera's centre, told in the camera
    frame, its velocity first. See :class:`pkmcal.control.machine_view.Legs` for the twist.
    """
    by_a, by_b = moving(view, legs, rates(view, legs) if rate is None else rate)
    u, length = legs.u[..., view.legs, :], legs.length[..., view.legs, None, None]
    shifted = (by_b - by_a) / length
    across = shifted - u[..., :, None] * (u[..., None, :] @ shifted)
    return view.T_camera_base[..., None, :3, :3] @ across


def edge_interaction(
    view: MachineView, legs: Legs, normals: Array, rate: Rates | None = None
) -> Array:
    """(..., s, 2, 3, 6): rates of the edges' normals, camera frame, by the twist.

    normals : (..., s, 2, 3) measured. From n.a = -R, n.b = -R and n.n = 1, as in
    :func:`pkmcal.geometry.cylinders.edge_normal_jacobians`. Where A stays this is the errata's
    J L, with J = -(A x n) n^T / (u . (A x n)) and the direction's L; [B] 12-13 differentiated.
    """
    by_a, by_b = moving(view, legs, rates(view, legs) if rate is None else rate)
    T = view.T_camera_base[..., None, :, :]
    a, b = (apply(T, p[..., view.legs, :])[..., None, :] for p in (legs.a, legs.b))
    by_a, by_b = (T[..., :3, :3] @ by for by in (by_a, by_b))
    side_a, side_b = cross(b, normals), cross(normals, a)
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
    """What is regulated to zero: its error and the matrix by which a twist changes it.

    name : on the command line and in files. title : for people.
    """

    name: ClassVar[str]
    title: ClassVar[str]

    @staticmethod
    @abstractmethod
    def error(measured: Array, goal: Array) -> Array:
        """The error (..., s, k, 3) of normals (..., s, 2, 3), measured and wanted."""

    @staticmethod
    @abstractmethod
    def matrix(view: MachineView, legs: Legs, normals: Array, goal: Array, rate: Rates) -> Array:
        """N (..., s, k, 3, 6) by the twist, with the limbs and normals at one moment."""


@final
class DirectionLaw(Law):
    """[B] 8-9 and errata, "Servoing": e = u x u*, N = -[u*]x L."""

    name: ClassVar = "directions"
    title: ClassVar = "directions of the legs"

    @staticmethod
    def error(measured: Array, goal: Array) -> Array:
        """One vector a leg, (..., s, 1, 3)."""
        return cross(directions_of(measured), directions_of(goal))[..., None, :]

    @staticmethod
    def matrix(view: MachineView, legs: Legs, normals: Array, goal: Array, rate: Rates) -> Array:
        """N (..., s, 1, 3, 6)."""
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
        """Two vectors a leg, (..., s, 2, 3)."""
        return cross(measured, goal)

    @staticmethod
    def matrix(view: MachineView, legs: Legs, normals: Array, goal: Array, rate: Rates) -> Array:
        """N (..., s, 2, 3, 6)."""
        return -skew(goal) @ edge_interaction(view, legs, normals, rate)


CONTROL_LAWS: dict[str, type[Law]] = {law.name: law for law in (EdgeLaw, DirectionLaw)}
"""By name; edges first, which hold the platform an order of magnitude steadier."""


def law_named(name: str) -> type[Law]:
    """A law by its name. Raises InputError for an unknown one."""
    if name not in CONTROL_LAWS:
        raise InputError(
            "there is no such law of control", found=name, expected=" or ".join(CONTROL_LAWS)
        )
    return CONTROL_LAWS[name]


@dataclass(frozen=True)
class Task:
    """One control problem at one moment, linear: e changes by ``matrix @ y`` (..., r, f).

    error : (..., r). y are the free twists' amounts in metres, turns as the platform's joints
    move by them; twist : (..., 6, f). readings : (..., m, f) rates by y. legs : as believed.
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
    """The law's linear problem for normals (..., s, 2, 3), measured and wanted.

    goal_legs : the limbs at the goal, needed where N is to be taken there or in the mean.
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
    """N+ e (..., f), by least squares; what the legs do not see, :data:`UNCOMMANDED_MOTION_SHARE`,
    stays at rest.

    NaN where an edge or a limb has no place.
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
    """The drives' rates -gain D N+ e, (..., m) per second; errata, "Servoing".

    law : "directions" or "edges". measured, goal : (..., s, 2, 3) unit normals of the seen legs'
    edges, camera frame, sides as in :mod:`pkmcal.geometry.cylinders`. readings : (..., m).
    gain : 1/s. at : where N is taken; "goal" and "mean" need the goal_readings (..., m).
    NaN where an edge has no place, or a limb cannot be where the readings put it.
    """
    legs = legs_from_image(view, directions_of(measured), readings)
    goal_legs = None
    if at != "measured" and goal_readings is not None:
        goal_legs = legs_from_image(view, directions_of(goal), goal_readings)
    task = task_of(law, view, measured, goal, legs, goal_legs, at)
    return -gain * (task.readings @ solution(task)[..., None])[..., 0]


def limited(speeds: Array, fastest: Array | float | None) -> Array:
    """All drives' rates (..., m) slowed together until none is too fast: the direction stays."""
    if fastest is None:
        return speeds
    with np.errstate(invalid="ignore"):
        excess = np.max(np.abs(speeds) / fastest, axis=-1, keepdims=True, initial=1.0)
    return speeds / excess
