"""What one step of control tells: velocities, how far it is, and why it stopped."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.mechanisms import Machine


class Status(Enum):
    """What the controller does with this sample; only the first two move the machine."""

    RUNNING = "on its way to the goal"
    CONVERGED = "at the goal"
    LOST = "stopped: too few legs are seen"
    NOT_FOUND = "stopped: the machine is not seen where its readings put it"
    WRONG_ASSEMBLY = "stopped: the machine stands in another assembly than the start's"
    TOO_FAR = "stopped: the goal is too far away"
    CROSSING = "stopped: a singular pose lies between the machine and the goal"
    SINGULAR = "stopped: the pose is nearly singular"
    OUT_OF_RANGE = "stopped: the next move would leave a motor's range"
    UNREACHABLE = "stopped: no pose of the machine fits the readings"

    @property
    def moves(self) -> bool:
        """Whether velocities are given."""
        return self in (Status.RUNNING, Status.CONVERGED)


@dataclass(frozen=True)
class Step:
    """The answer to one sample; m readings, s seen legs.

    joint_velocities : (m,) per second, in the readings' units; zero unless ``status.moves``.
    error : root mean square angle (rad) of the law's error over the legs used; NaN without any.
    remaining : (m,) by how much each reading is still off, as the law sees it; NaN when stopped
    before that was known. sigma : (m,) its standard deviation by what the photograph shows, NaN
    for edges given without one. converged : at the goal within the tolerance.
    status, sentence : what is the matter, for programs and for people. warnings : what the
    controller goes on with.
    used : (s,) legs that entered the law. normals : (s, 2, 3) edges as measured, camera frame.
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


def leg_list(numbers: list[int]) -> str:
    """Legs counted from 1, for sentences: "legs 1, 2 and 5"."""
    names = [str(j + 1) for j in numbers]
    if len(names) < 2:
        return f"leg {''.join(names)}"
    return f"legs {', '.join(names[:-1])} and {names[-1]}"


def motor_name(machine: Machine, column: int) -> str:
    """A reading by the leg, or legs, that it drives."""
    return leg_list(np.flatnonzero(machine.layout.actuated == column).tolist())


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
        f"{leg_list(group)} {'are' if len(group) > 1 else 'is'} {why}"
        for why, group in missing.items()
    ]


def vague_sentence(machine: Machine, sigma: Array) -> str:
    """Which motor's way to the goal is known worst; sigma (m,)."""
    k = int(np.nanargmax(sigma))
    return (
        f"what is seen tells where the motor of {motor_name(machine, k)} should be"
        f" to {sigma[k] * 1e3:.2g} m{machine.joint_units[k]} only"
    )


def range_sentence(machine: Machine, ranges: Array, readings: Array, leaves: Booleans) -> str:
    """Which motor would leave its range (m, 2)."""
    k = int(np.argmax(leaves))
    (low, high), unit = ranges[k], machine.joint_units[k]
    return (
        f"the motor of {motor_name(machine, k)} reads {readings[k]:.4g} {unit},"
        f" its range is {low:.4g} to {high:.4g}"
    )


def leaving(
    ranges: Array, readings: Array, velocities: Array, period: float
) -> tuple[Booleans, Booleans]:
    """Motors (m,) that the velocities would drive out of their range (m, 2) within a period, and
    those that are outside already. Ranges that are NaN bound nothing.
    """
    after = readings + velocities * period
    with np.errstate(invalid="ignore"):
        low = (after < ranges[:, 0]) & (velocities < 0)
        high = (after > ranges[:, 1]) & (velocities > 0)
        outside = (readings < ranges[:, 0]) | (readings > ranges[:, 1])
    return low | high, outside
