"""Numberings of the legs that images and readings cannot distinguish.

If a nominal model is symmetric under a rotation, counting the columns of the readings from another
leg fits equally well: only the base frame differs, by that rotation. For such a machine, only a
hand-placed camera pose determines whether the first leg of the readings is the first leg of the
nominal model.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pkmcal.arrays import Array, Integers, evenly
from pkmcal.calibration.localization import legs_stations
from pkmcal.geometry.rigid import register
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.outcome.finding import Finding, note
from pkmcal.session.load import Session
from pkmcal.wording import in_full

NUMBERING_CONFIGURATIONS = 5
"""Number of configurations at which numberings are compared; unequal machines differ at any."""
LAST_DIGIT = 1e-6
"""Difference (m) between equal nominal models that is caused by rounding in their files."""


def equal_numberings(machine: Machine, joints: Array) -> tuple[Integers, ...]:
    """Permutations of the readings' columns, (m,) each, under which the nominal model is the same
    machine.

    Each starts the count at another leg; the rotated machine agrees within its prior sigmas. Empty
    for machines with legs without a reading of their own.

    joints : (K, m) readings at which the machines are compared.
    """
    layout, m = machine.layout, machine.n_joints
    if machine.n_legs != m or sorted(layout.actuated.tolist()) != list(range(m)):
        return ()
    readings = joints[evenly(len(joints), NUMBERING_CONFIGURATIONS)]
    orders = [np.roll(np.arange(m), -first) for first in range(1, m)]
    return tuple(order for order in orders if _equivalent(machine, readings, order))


def _equivalent(machine: Machine, readings: Array, order: Integers) -> bool:
    """Whether exchanging the columns of readings (n, m) is equivalent to one rigid motion of the
    machine.
    """
    layout, table = machine.layout, machine.parameters
    column = layout.actuated
    other = np.argsort(column)[order[column]]  # leg that had each leg's new column
    for mine, its in zip(layout.radius, (layout.radius[j] for j in other), strict=True):
        if len(mine) != len(its):
            return False
        if np.any(np.abs(machine.values[mine] - machine.values[its]) > table.tolerance[mine]):
            return False
    # limb ends at both orders of the readings
    points: list[Array] = []
    for joints in (readings, readings[:, order]):
        fk = machine.forward_result(joints)
        if not fk.converged.all():
            return False
        ends = limb_ends(layout, machine.values, joints, fk.T_base_platform, fk.internal)
        points.append(np.concatenate([ends.a, ends.b], axis=1))
    # best rigid motion between corresponding legs, and its residuals
    legs = np.concatenate([other, other + machine.n_legs])
    before, after = points[0][:, legs].reshape(-1, 3), points[1].reshape(-1, 3)
    turn = register(after, before)
    off = after @ turn[:3, :3].T + turn[:3, 3] - before
    limit = max(float(table.tolerance[table.of_kind("center")].mean()), LAST_DIGIT)
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) < limit


def numbering_note(session: Session) -> Iterator[Finding]:
    """Finding where nothing in a session determines which leg is the readings' first.

    A station's hand-placed pose determines it.
    """
    if not legs_stations(session) or any(
        station.T_camera_base is not None for station in session.stations
    ):
        return
    orders = equal_numberings(session.machine, session.joints)
    if orders:
        names, file = session.document["joints"]["columns"], session.document["joints"]["file"]
        by_hand = all(station.handheld for station in session.stations)
        yield note(
            "readings.first_leg_unknown",
            file,
            sides=in_full(len(orders) + 1),
            columns=[names[order[0]] for order in orders],
            others=" or ".join(names[order[0]] for order in orders),
            first=names[0],
            pose=None if by_hand else "pose",  # hand-held images have no pose
        )
