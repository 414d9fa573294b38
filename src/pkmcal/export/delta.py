"""A delta as firmwares know it: three towers or three arms, and a workspace to compare over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.export.c_tables import CRANK, SLIDER, Tables, tables_of
from pkmcal.mechanisms import Machine

STEPS = 7
"""Readings of each motor in the grid: ends, middle, and two on each side."""
LEAST = 0.12
"""Least singular value of the scaled inverse Jacobian: a reading's error grows by eight at most."""
FASTEST = 4.0
"""Carriage's or elbow's way per way of the tool, at most: beyond, a rod stands nearly square to the
motion of its motor, and firmwares divide by that angle."""
UPRIGHT = 0.8
"""Least vertical part of a tower, and radial part of an arm's plane: 37 degrees off at most."""
KINDS = {SLIDER: "linear", CRANK: "rotary"}
MM = 1e3
DEGREE = 180 / np.pi


@dataclass(frozen=True)
class Delta:
    """A machine's three legs, in the order of its file; mm and degrees as firmwares have them.

    kind : linear or rotary. joint : (3,) reading's column. hinge : (3, 3) m, a tower's joint at
    reading zero, or an arm's axis, less the platform's joint: what the rod's far end, moved to the
    platform's origin, hangs on. arm, rod : (3,) m. rate, zero : (3,) the firmware's motor position
    (carriage height in mm, or angle above the horizontal in degrees) is rate * reading + zero, for
    an ideal machine. ends : (3,) readings at the upper end of the range.
    positions : (n, 3) m, T_base_platform's, over the workspace. readings : (n, 3), by leg.
    by_reading : (n, 3, 3) m of the platform's position by the legs' readings.
    """

    machine: Machine
    kind: str
    joint: Integers
    hinge: Array
    arm: Array
    rod: Array
    rate: Array
    zero: Array
    ends: Array
    poses: Array
    readings: Array
    by_reading: Array

    @property
    def positions(self) -> Array:
        """Where the grid's platforms are, (n, 3) m, base frame."""
        return self.poses[:, :3, 3]


def delta_of(machine: Machine, program: str) -> Delta:
    """The machine as a delta; InputError with a sentence where it is none.

    program : who asks, for the sentence.
    """
    kinds = {leg.base.joint for leg in machine.document.legs}
    if machine.document.motion != "translation" or kinds not in ({"slider"}, {"crank"}):
        found = f"{machine.n_legs} legs on {', '.join(sorted(kinds))} joints"
        raise _no_delta(machine, program, f"motion {machine.document.motion}, {found}")
    tables = tables_of(machine)
    if tables.n_rods != 3 or tables.n_joints != 3 or tables.floating.any():
        raise _no_delta(machine, program, f"{tables.n_rods} rods, {tables.n_joints} motors")
    ranges = tables.ranges[tables.joint]
    if not np.isfinite(ranges).all():
        raise InputError(
            f"mechanism {machine.name!r} gives no range for a motor, so its ends are not known",
            expected="range: [min, max] at every slider or crank",
            next_step="Add the ranges: the firmware's end switches are put at their upper ends",
        )
    kind = KINDS[int(tables.kind[0])]
    rate, zero = _towers(tables) if kind == "linear" else _arms(tables, ranges.mean(axis=1))
    if np.isnan(zero).any():
        what = "towers that lean" if kind == "linear" else "arms that do not swing outwards"
        raise _no_delta(machine, program, what)
    poses, readings, by_reading = workspace(machine, tables)
    return Delta(
        machine=machine,
        kind=kind,
        joint=tables.joint,
        hinge=tables.base - tables.arm_fixed @ machine.home()[:3, :3].T,
        arm=tables.arm,
        rod=tables.length,
        rate=rate,
        zero=zero,
        ends=np.where(rate > 0, ranges[:, 1], ranges[:, 0]),
        poses=poses,
        readings=readings,
        by_reading=by_reading,
    )


def _no_delta(machine: Machine, program: str, found: str) -> InputError:
    return InputError(
        f"{program} has settings for linear and rotary deltas, and mechanism {machine.name!r}"
        " is neither",
        found=found,
        expected="motion: translation with three sliders, or three cranks, and rods",
        next_step="Export it with --to c",
    )


def _towers(t: Tables) -> tuple[Array, Array]:
    """Rate (mm/m) and zero (mm) of ideal towers; NaN where they lean."""
    up = t.along[:, 2]
    sign = np.sign(up)
    zero = np.where(np.abs(up) > UPRIGHT, MM * t.base[:, 2], np.nan)
    return sign * MM, zero


def _arms(t: Tables, middle: Array) -> tuple[Array, Array]:
    """Rate (degree/rad) and zero (degrees) of ideal arms; NaN where they are none."""
    centre = t.base.mean(axis=0)
    radial = (t.base - centre) * [1, 1, 0]
    radial = radial / np.linalg.norm(radial, axis=1, keepdims=True)

    def part(v: Array, w: Array) -> Array:
        return np.sum(v * w, axis=1)

    plane = np.hypot(part(t.outward, radial), part(t.sideways, radial))
    turn = middle + t.angle
    c, s = np.cos(turn), np.sin(turn)
    out = c * part(t.outward, radial) + s * part(t.sideways, radial)
    up = c * t.outward[:, 2] + s * t.sideways[:, 2]
    d_out = c * part(t.sideways, radial) - s * part(t.outward, radial)
    d_up = c * t.sideways[:, 2] - s * t.outward[:, 2]
    sign = np.sign(out * d_up - up * d_out)
    zero = np.arctan2(up, out) - sign * middle
    return sign * DEGREE, np.where(plane > UPRIGHT, DEGREE * zero, np.nan)


def workspace(machine: Machine, tables: Tables) -> tuple[Array, Array, Array]:
    """Poses of a grid of readings that are well held, readings by leg, and position by reading."""
    ends = machine.joint_ranges
    axes = [np.linspace(low, high, STEPS) for low, high in ends]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(ends))
    found = machine.forward_result(grid)
    poses = found.T_base_platform
    back = machine.inverse(poses)
    good = found.converged & (found.singularity > LEAST)
    good &= np.nan_to_num(np.abs(back - grid).max(axis=1), nan=1.0) < 1e-9
    ways = np.linalg.norm(machine.inverse_jacobian(poses)[:, tables.joint, 3:], axis=-1)
    good &= np.nan_to_num(ways * tables.arm, nan=np.inf).max(axis=1) < FASTEST
    if not good.any():
        raise InputError(
            f"mechanism {machine.name!r} closes nowhere within its ranges",
            next_step="Check the ranges in the mechanism file",
        )
    poses = poses[good]
    by_reading = machine.forward_jacobian(poses)[:, 3:, :][..., tables.joint]
    return poses, grid[good][:, tables.joint], by_reading


def reach(delta: Delta) -> float:
    """Radius (m) about the z axis, at home's height, within which all readings are in range."""
    machine, home = delta.machine, delta.machine.home()
    radii = np.arange(1, 1001) * 1e-3
    turns = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    poses = np.tile(home, (radii.size, turns.size, 1, 1))
    poses[..., 0, 3] = radii[:, None] * np.cos(turns)
    poses[..., 1, 3] = radii[:, None] * np.sin(turns)
    q = machine.inverse(poses.reshape(-1, 4, 4)).reshape(radii.size, turns.size, -1)
    ends = machine.joint_ranges
    with np.errstate(invalid="ignore"):
        inside = ((q >= ends[:, 0]) & (q <= ends[:, 1])).all(axis=(1, 2))
    outside = np.flatnonzero(~inside)
    last = outside[0] if outside.size else inside.size
    return float(radii[last - 1]) if last else 0.0
