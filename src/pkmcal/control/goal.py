"""Result of a control step, its sentences and checks, and the goal of the control."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.control.machine_view import (
    Legs,
    MachineView,
    directions_of,
    leg_ends_in_view,
    legs_at,
    true_edges,
)
from pkmcal.control.track import Sight, first_track_state, track
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.cylinders import line_through
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.mechanisms.velocities import sign_of
from pkmcal.wording import named

GOAL_TOLERANCE = 5e-4
"""Distance from the goal of the readings (m or rad), and of the platform's joints (m), that counts
as none: one image of 640x480 pixels determines a reading to 0.3 mm."""
UNIT_LENGTH_TOLERANCE = 1e-6
"""Difference of a normal's length from 1 that rounding to six written digits may cause."""


class Status(Enum):
    """State of the controller after a sample; the machine moves in the first two only."""

    RUNNING = "on its way to the goal"
    CONVERGED = "at the goal"
    LOST = "stopped: too few legs are seen"
    NOT_AT_READINGS = "stopped: the machine is not seen where its readings put it"
    WRONG_ASSEMBLY = "stopped: the machine stands in another assembly than the start's"
    TOO_FAR = "stopped: the goal is too far away"
    CROSSING = "stopped: a singular pose lies between the machine and the goal"
    SINGULAR = "stopped: the pose is nearly singular"
    OUT_OF_RANGE = "stopped: the next move would leave a motor's range"
    UNREACHABLE = "stopped: no pose of the machine fits the readings"

    @property
    def moves(self) -> bool:
        """Whether the controller gives velocities."""
        return self in (Status.RUNNING, Status.CONVERGED)


@dataclass(frozen=True)
class Step:
    """Result of the controller for one sample; m readings, s observed legs.

    joint_velocities : (m,) per second, in the readings' units; zero unless ``status.moves``.
    error : RMS angle, in rad, of the law's error over the legs used; NaN without any.
    remaining : (m,) distance of each reading from the goal, as estimated by the law; NaN if the
        controller stopped before.
    sigma : (m,) standard deviation of `remaining` due to the image's noise; NaN for edges without
        covariances.
    converged : whether the machine is at the goal, within the tolerance.
    status, sentence : the controller's state, for programs and for people.
    warnings : problems that do not stop the controller.
    used : (s,) legs that enter the law.
    normals : (s, 2, 3) measured edges, camera frame.
    """

    joint_velocities: Array
    error: float
    remaining: Array
    sigma: Array
    converged: bool
    status: Status
    sentence: str
    warnings: tuple[str, ...]
    used: Booleans
    normals: Array


def motor_name(machine: Machine, column: int) -> str:
    """Name of a motor by the leg, or legs, that it drives."""
    return named(np.flatnonzero(machine.layout.actuated == column))


def missing_clauses(
    legs: Integers, used: Booleans, goal: Array, reasons: tuple[str, ...]
) -> list[str]:
    """One clause for every reason why seen legs (s,) are not used."""
    missing: dict[str, list[int]] = {}
    for k in np.flatnonzero(~used):
        left_out = np.isnan(goal[k]).any()
        why = "left out by the goal" if left_out else f"not seen ({reasons[k]})"
        missing.setdefault(why, []).append(int(legs[k]))
    return [
        f"{named(group)} {'are' if len(group) > 1 else 'is'} {why}"
        for why, group in missing.items()
    ]


def vague_sentence(machine: Machine, sigma: Array) -> str:
    """Sentence on the motor whose distance to the goal has the largest sigma (m,)."""
    k = int(np.nanargmax(sigma))
    return (
        f"what is seen determines where the motor of {motor_name(machine, k)} should be"
        f" to {sigma[k] * 1e3:.2g} m{machine.joint_units[k]} only"
    )


def range_sentence(machine: Machine, ranges: Array, readings: Array, leaves: Booleans) -> str:
    """Sentence on the first motor that would leave its range (m, 2)."""
    k = int(np.argmax(leaves))
    (low, high), unit = ranges[k], machine.joint_units[k]
    return (
        f"the motor of {motor_name(machine, k)} reads {readings[k]:.4g} {unit},"
        f" its range is {low:.4g} to {high:.4g}"
    )


def leaving(
    ranges: Array, readings: Array, velocities: Array, period: float
) -> tuple[Booleans, Booleans]:
    """Motors (m,) that leave their range (m, 2) within a period, and motors that are outside.

    A NaN in a range is no bound.
    """
    after = readings + velocities * period
    with np.errstate(invalid="ignore"):
        low = (after < ranges[:, 0]) & (velocities < 0)
        high = (after > ranges[:, 1]) & (velocities > 0)
        outside = (readings < ranges[:, 0]) | (readings > ranges[:, 1])
    return low | high, outside


@dataclass(frozen=True)
class GoalImage:
    """Image of the machine at the goal, (height, width) uint8, and its readings (m,)."""

    image: Integers
    readings: Array


@dataclass(frozen=True)
class Goal:
    """Goal of the control.

    normals : (s, 2, 3) edges at the goal, camera frame; NaN for legs without a goal. aspect : sign
    of the closure's determinant at the goal, 0 if unknown.
    """

    normals: Array
    aspect: float


def goal_of(sight: Sight | None, view: MachineView, goal: Array | GoalImage) -> Goal:
    """Goal from a platform pose (4, 4), edges (s, 2, 3) or an image.

    Raises InputError for any other array, for an unreachable or singular pose, and for an image
    without a camera; GeometryError for an image in which no leg is found.
    """
    if isinstance(goal, GoalImage):
        return _of_image(sight, view, goal)
    array = np.asarray(goal, dtype=float)
    if array.shape == (4, 4):
        return _of_pose(view, array)
    if array.shape == (len(view.legs), 2, 3):
        return Goal(checked_normals(view, array, "the goal's edges"), 0.0)
    raise InputError(
        what="the goal is neither a platform pose nor edges",
        found=f"an array of shape {array.shape}",
        expected=f"(4, 4), or ({len(view.legs)}, 2, 3) for the {len(view.legs)} seen legs",
    )


def checked_normals(view: MachineView, normals: Array, name: str) -> Array:
    """Edges (s, 2, 3) as an array, NaN for a leg that is not seen.

    Raises InputError for a wrong shape and for normals that are not unit vectors.
    """
    array = np.asarray(normals, dtype=float)
    if array.shape != (len(view.legs), 2, 3):
        raise InputError(
            what=f"{name} have the wrong shape",
            found=str(array.shape),
            expected=f"({len(view.legs)}, 2, 3), two normals for each seen leg",
        )
    length = dot(array, array)
    if np.any(np.abs(length - 1) > 2 * UNIT_LENGTH_TOLERANCE):  # NaN passes: a leg that is not seen
        raise InputError(
            what=f"{name} are not unit vectors",
            found=f"length {float(np.sqrt(np.nanmax(np.abs(length - 1)) + 1)):.6g}",
            expected="length 1, or NaN for a leg that is not seen",
        )
    return array


def aspect_of(machine: Machine, legs: Legs) -> float:
    """Sign of the determinant of the closure's rows by the machine's motion.

    The sign changes only where the platform can move with all motors locked, so a singular pose
    lies between poses of different signs. 0 for a platform with hinges, where the rows outnumber
    the degrees of freedom.
    """
    if machine.layout.n_internal:
        return 0.0
    return float(sign_of(legs.rows @ machine.layout.motion))


def check_sides(view: MachineView, normals: Array, T_base_platform: Array) -> None:
    """Raise InputError if the two sides of the edges (s, 2, 3) are exchanged.

    The legs' directions from exchanged edges point from platform to base; they are compared with
    the directions at a pose (4, 4) in the right assembly mode.
    """
    a, b = leg_ends_in_view(view, T_base_platform)
    finite = np.isfinite(normals).all(axis=(-1, -2))
    cosine = dot(directions_of(normals), line_through(a, b)[0])[finite]
    if cosine.size and np.median(cosine) < 0:
        raise InputError(
            what="the edges have their two sides exchanged",
            expected="side 0 on the right of a leg, looking along it from base to platform",
            next_step="see docs/conventions.md, Edges and sides",
            code="edges.sides_exchanged",
        )


def _of_pose(view: MachineView, T_base_platform: Array) -> Goal:
    machine = view.machine
    if not np.isfinite(T_base_platform).all():
        raise InputError(
            "the goal's pose holds a value that is not a finite number", code="array.not_finite"
        )
    _check_closes(view, T_base_platform)
    readings = machine.inverse(T_base_platform[None])[0]
    ranges = machine.joint_ranges
    with np.errstate(invalid="ignore"):
        out = ~np.isfinite(readings) | (readings < ranges[:, 0]) | (readings > ranges[:, 1])
    if out.any():
        k = int(np.argmax(out))
        unit = machine.joint_units[k]
        raise InputError(
            what=f"the goal is out of the machine's reach: {motor_name(machine, k)}",
            found=f"a reading of {readings[k]:.4g} {unit}"
            if np.isfinite(readings[k])
            else "no reading that reaches it",
            expected=f"{ranges[k, 0]:.4g} to {ranges[k, 1]:.4g} {unit}",
            next_step="choose a goal inside the workspace",
            code="pose.outside_workspace",
        )
    edges = true_edges(view, T_base_platform)
    if np.isnan(edges).any():
        raise InputError(
            what="at the goal a leg passes through the camera's centre of projection",
            next_step="check T_camera_base",
        )
    return Goal(edges, aspect_of(machine, legs_at(view, T_base_platform)))


def _check_closes(view: MachineView, T_base_platform: Array) -> None:
    """Raise InputError if the machine cannot take the pose, or if the pose is nearly singular."""
    machine = view.machine
    readings = machine.inverse(T_base_platform[None])[0]
    if not np.isfinite(readings).all():
        return  # reported by the caller with the motor's name
    fk = machine.forward_result(readings, T_base_platform)
    shifted = np.abs(fk.T_base_platform - T_base_platform).max()
    if not bool(fk.converged) or shifted > UNIT_LENGTH_TOLERANCE:
        raise InputError(
            what="the machine cannot take the goal's pose",
            expected=f"a pose that a machine of motion {machine.document.motion!r} can take",
            next_step="give machine.forward(readings) of readings at the goal",
            code="pose.not_admissible",
        )
    if float(fk.singularity) < NEAR_SINGULAR:
        raise InputError(
            what="the goal is nearly singular: there the platform moves with its motors locked",
            found=f"smallest singular value {float(fk.singularity):.2g}",
            expected=f"more than {NEAR_SINGULAR}; 1 is a good pose",
            code="pose.singular",
        )


def _of_image(sight: Sight | None, view: MachineView, goal: GoalImage) -> Goal:
    if sight is None:
        raise InputError(
            "a goal image needs the camera",
            next_step="give camera to VisualServo",
            code="servo.no_camera",
        )
    readings = np.asarray(goal.readings, dtype=float)
    value = track(sight, first_track_state(view), goal.image, readings)
    if not value.closed:
        raise GeometryError(
            what="no pose of the machine fits the readings of the goal image",
            next_step="check that they are in metres or radians, in the order of the motors",
            code="readings.unreachable",
        )
    if not value.valid.any():
        raise GeometryError(
            what="no leg was found in the goal image",
            found=value.reasons[0],
            next_step="check the camera, its place and the light",
            code="servo.goal_not_visible",
        )
    legs = legs_at(view, value.state.T_base_platform, readings)
    return Goal(value.lines.normal, aspect_of(view.machine, legs))
