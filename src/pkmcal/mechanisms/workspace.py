"""Which poses a machine can take, and why not the others.

A pose belongs to the workspace where every limb reaches, every reading is in its range, the
constant rods, the joints' axes and the file's motion allow it, no singular pose is near, and the
determinant has home's sign (:mod:`pkmcal.mechanisms.signs`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import pose_difference
from pkmcal.mechanisms.kinematics import (
    NEAR_SINGULAR,
    inverse_result,
    rows_and_drives,
    scaled_rows,
    singularity_of,
    undriven,
)
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.signs import sign_of

ALLOWED = 1e-6
"""What the constant rods and axes must close to, m, and the motion, m and rad: more than rounding
of a pose in a file, less than any drive's step."""


@dataclass(frozen=True)
class Limits:
    """A machine with its limits: theta (P,), ranges (m, 2) of the readings, NaN where there is
    none, their units, and home (4, 4), whose assembly is meant.
    """

    layout: LimbLayout
    theta: Array
    ranges: Array
    units: tuple[str, ...]
    home: Array

    @cached_property
    def at_home(self) -> tuple[float, float]:
        """Home's sign and the singularity that counts as near: a machine that is weak at home is
        not refused everywhere for it.
        """
        readings, internal = inverse_result(self.layout, self.theta, self.home)
        rows, _ = rows_and_drives(self.layout, self.theta, readings, self.home, internal)
        scaled = scaled_rows(self.layout, self.theta, rows)
        least = 0.5 * float(singularity_of(self.layout, scaled))
        return float(sign_of(scaled)), min(NEAR_SINGULAR, least)


@dataclass(frozen=True)
class Reach:
    """What stands against each of the poses (...,); see :meth:`why`.

    readings : (..., m), NaN where the motor's limb cannot reach: ``lost`` (..., m).
    too_short, too_long : (..., m) readings below and above their range.
    off : (...) how far what no motor moves is from closing, m; ``forbidden`` (...) where that is
        more than a micrometre, or the pose leaves the file's motion.
    singularity : (...) the measure of forward kinematics; ``singular`` (...) where it is too small.
    crossed : (...) the determinant has not home's sign: a singular pose lies between.
    """

    readings: Array
    lost: Booleans
    too_short: Booleans
    too_long: Booleans
    off: Array
    forbidden: Booleans
    singularity: Array
    singular: Booleans
    crossed: Booleans
    limits: Limits

    @property
    def inside(self) -> Booleans:
        """(...) whether the machine can take the pose, as far as these conditions tell."""
        motors = (self.lost | self.too_short | self.too_long).any(axis=-1)
        return ~(motors | self.forbidden | self.singular | self.crossed)

    def why(self, *pose: int) -> tuple[str, ...]:
        """In words what stands against one pose, by its place in the batch; () for none."""
        words = [text for j, u in enumerate(self.limits.units) for text in self._motor(pose, j, u)]
        if self.forbidden[pose]:
            words.append(self._forbidden(pose))
        if self.singular[pose]:
            words.append(
                f"the pose is singular or nearly so: {float(self.singularity[pose]):.2g}, where at"
                f" least {self.limits.at_home[1]:.2g} is wanted"
            )
        if self.crossed[pose]:
            words.append("the pose lies beyond a singular one, in another assembly than home")
        return tuple(words)

    def _motor(self, pose: tuple[int, ...], motor: int, unit: str) -> list[str]:
        at, (low, high) = (*pose, motor), self.limits.ranges[motor]
        if self.lost[at]:
            return [f"the limb of motor {motor + 1} cannot reach"]
        if not (self.too_short[at] or self.too_long[at]):
            return []
        reading, short = float(self.readings[at]), bool(self.too_short[at])
        end = float(low if short else high)
        if abs(reading - end) < ALLOWED:
            return [f"motor {motor + 1} is at the end of its range, {end:.4g} {unit}"]
        where = f"below its range, which begins at {end:.4g} {unit}"
        if not short:
            where = f"above its range, which ends at {end:.4g} {unit}"
        return [f"motor {motor + 1} would stand at {reading:.4g} {unit}, {where}"]

    def _forbidden(self, pose: tuple[int, ...]) -> str:
        off = float(self.off[pose])
        if off > ALLOWED:
            return (
                "the rods of constant length and the joints' axes do not allow the pose, by"
                f" {off * 1e3:.3g} mm"
            )
        return "the machine cannot turn or move in this way"


def reachable(limits: Limits, poses: Array) -> Reach:
    """What stands against poses T_base_platform (..., 4, 4)."""
    layout, theta = limits.layout, limits.theta
    with np.errstate(divide="ignore", invalid="ignore"):  # a platform's joint on a base joint
        readings, internal = inverse_result(layout, theta, poses)
        rows, by_reading = rows_and_drives(layout, theta, readings, poses, internal)
    scaled = scaled_rows(layout, theta, rows)
    singularity = singularity_of(layout, scaled)
    lost = np.isnan(readings)
    left = undriven(layout, rows, by_reading)[0]
    off = np.where(lost.any(axis=-1), 0.0, np.abs(left).max(axis=-1, initial=0.0))
    sign, least = limits.at_home
    own = sign_of(scaled)
    return Reach(
        readings=readings,
        lost=lost,
        too_short=readings < limits.ranges[:, 0],
        too_long=readings > limits.ranges[:, 1],
        off=off,
        forbidden=(off > ALLOWED) | _elsewhere(limits, poses),
        singularity=singularity,
        singular=~lost.any(axis=-1) & ~(singularity >= least),
        crossed=own * sign < 0,
        limits=limits,
    )


def _elsewhere(limits: Limits, poses: Array) -> Booleans:
    """Whether poses (..., 4, 4) leave the motion that the file names."""
    held = ~limits.layout.free
    if not held.any():
        return np.zeros(poses.shape[:-2], dtype=bool)
    moved = np.abs(pose_difference(poses, limits.home)[..., held])
    return np.asarray(moved.max(axis=-1) > ALLOWED)
