"""Configurations of a machine while one reading changes: forward kinematics by continuation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import GeometryError
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import Machine
from pkmcal.wording import listed

MOST_RANGES_A_MOTION = 10.0
"""Longest motion of a reading, in widths of its range; a served page may be asked for any."""
STEPS_OVER_RANGE = 40
"""Steps of a continuation over the whole range of a reading."""
READING_ITERATIONS = 20
"""Most Newton steps for a reading of a redundant machine."""
READING_REACHED = 1e-9
"""Largest error of a reading that counts as reached, m or rad."""


class Postures(NamedTuple):
    """Readings (n, m) and the poses T_base_platform (n, 4, 4) that belong to them; NaN where none
    was found.
    """

    readings: Array
    T_base_platform: Array

    @property
    def closed(self) -> Booleans:
        """Whether there is a pose, (n,)."""
        return np.isfinite(self.T_base_platform[:, 0, 0])


def home_posture(machine: Machine) -> Postures:
    """The one posture at home. Raises GeometryError for a machine that does not close there."""
    T = machine.limits().home[None]
    readings = machine.inverse(T)
    error: str | None = None
    if (out_of_reach := ~np.isfinite(readings[0])).any():
        names = [
            name for name, is_out in zip(machine.joint_names, out_of_reach, strict=True) if is_out
        ]
        error = f"no value of {listed(names, len(names))} with which its legs reach the platform"
    else:
        fk = machine.forward_result(readings, T)
        T = fk.T_base_platform
        if not fk.converged.all():
            error = f"closure error {float(fk.error.max()) * 1e3:.3g} mm"
    if error:
        raise GeometryError(
            f"mechanism {machine.name!r} cannot be assembled at its home pose",
            found=error,
            expected="a platform that all legs reach",
            next_step="Check home, and these legs' lengths, centres, axes and arms",
        )
    return Postures(readings, T)


def stepped(machine: Machine, postures: Postures, index: Integers, values: Array) -> Postures:
    """Postures after a small change of one reading in each row.

    index, values : (n,) of the readings that change, and their new values.

    The other readings keep their values; those of a redundant machine follow the smallest motion
    of the platform. NaN without a pose, and where the machine leaves its assembly mode.
    """
    out = Postures(*(np.full_like(part, np.nan) for part in postures))
    rows = np.flatnonzero(postures.closed)
    if not rows.size:
        return out
    before = Postures(postures.readings[rows], postures.T_base_platform[rows])
    solve = _least_motion if machine.redundancy else _forward
    readings, poses = solve(machine, before, index[rows], values[rows])
    good = np.flatnonzero(np.isfinite(readings).all(axis=1))
    same = machine.same_assembly(poses[good], before.T_base_platform[good])
    good = good[same]
    out.readings[rows[good]], out.T_base_platform[rows[good]] = readings[good], poses[good]
    return out


def _forward(machine: Machine, before: Postures, index: Integers, values: Array) -> Postures:
    """Forward kinematics with one reading changed; NaN where it does not converge."""
    readings = before.readings.copy()
    readings[np.arange(len(index)), index] = values
    fk = machine.forward_result(readings, before.T_base_platform)
    return Postures(np.where(fk.converged[:, None], readings, np.nan), fk.T_base_platform)


def _least_motion(machine: Machine, before: Postures, index: Integers, values: Array) -> Postures:
    """Least motion of the platform that gives one reading its value: Newton's method with the row
    of the inverse Jacobian, in the directions in which the platform moves.
    """
    rows, directions = np.arange(len(index)), machine.layout.motion
    readings, poses = before
    reached = np.zeros(len(index), dtype=bool)
    for _ in range(READING_ITERATIONS):
        readings = machine.inverse(poses, before.readings)
        error = values - readings[rows, index]
        reached = np.abs(error) < READING_REACHED
        active = np.flatnonzero(~reached & np.isfinite(readings).all(axis=1))
        if not active.size:
            break
        slope = machine.inverse_jacobian(poses[active])[np.arange(active.size), index[active]]
        slope = slope @ directions
        with np.errstate(all="ignore"):  # a reading that no motion changes
            step = slope * (error[active] / (slope**2).sum(axis=1))[:, None]
        step = np.where(np.isfinite(step), step, 0.0)
        poses = poses.copy()
        poses[active] = perturb(poses[active], step @ directions.T)
    return Postures(np.where(reached[:, None], readings, np.nan), poses)


def moved(
    machine: Machine, posture: Postures, index: int, value: float, range_width: float
) -> Postures:
    """The one posture after a reading has moved to a value, in steps of 1/``STEPS_OVER_RANGE`` of
    the range's width; NaN if the way there has no pose.
    """
    start, which = float(posture.readings[0, index]), np.array([index])
    if not abs(value - start) <= MOST_RANGES_A_MOTION * range_width:  # not a slider's motion
        return posture._replace(readings=np.full_like(posture.readings, np.nan))
    count = max(1, int(np.ceil(abs(value - start) / range_width * STEPS_OVER_RANGE - 1e-9)))
    for at in np.linspace(start, value, count + 1)[1:]:
        posture = stepped(machine, posture, which, np.array([at]))
    return posture


def sweeps(machine: Machine, home: Postures, ranges: Array, count: int) -> tuple[Array, Postures]:
    """Each reading over its range, the others as at home.

    ranges : (m, 2).

    Returns values (m, count), home's among them, and postures (m * count), reading by reading; NaN
    from where no pose is found onwards.
    """
    m = machine.n_joints
    start = home.readings[0]
    values = np.linspace(ranges[:, 0], ranges[:, 1], count, axis=1)
    middle = np.argmin(np.abs(values - start[:, None]), axis=1)
    values[np.arange(m), middle] = start
    readings = np.full((m, count, m), np.nan)
    poses = np.full((m, count, 4, 4), np.nan)
    readings[np.arange(m), middle], poses[np.arange(m), middle] = (
        home.readings,
        home.T_base_platform,
    )
    # from home outwards in both senses: rows 0 to m - 1 downwards, the others upwards
    index, sense = np.tile(np.arange(m), 2), np.repeat([-1, 1], m)
    at = Postures(
        np.repeat(home.readings, 2 * m, axis=0), np.repeat(home.T_base_platform, 2 * m, axis=0)
    )
    for k in range(1, count):
        place = middle[index] + sense * k
        inside = (place >= 0) & (place < count)
        wanted = values[index, np.clip(place, 0, count - 1)]
        at.T_base_platform[~inside] = np.nan
        at = stepped(machine, at, index, wanted)
        rows = np.flatnonzero(at.closed)
        readings[index[rows], place[rows]] = at.readings[rows]
        poses[index[rows], place[rows]] = at.T_base_platform[rows]
    return values, Postures(readings.reshape(-1, m), poses.reshape(-1, 4, 4))
