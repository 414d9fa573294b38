"""Numberings of the legs that images and readings cannot distinguish.

A machine whose nominal model is symmetric under a rotation fits equally well with the columns of
its readings counted from another leg; only the base frame differs, by that rotation. For such a
machine only the pose by hand of a camera determines which leg of the model the first column is.
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
"""Configurations at which numberings are compared: machines without the symmetry differ at any."""
LAST_DIGIT = 1e-6
"""Difference (m) of equal nominal models that are written with few digits."""


def equal_numberings(machine: Machine, joints: Array) -> tuple[Integers, ...]:
    """Orders (m,) of columns, counted from another leg, with which the nominal model is the same
    machine up to a rotation, within its prior sigmas.

    joints : (K, m) readings at which numberings are compared. Empty for a machine with legs that
    have no reading of their own.
    """
    layout, m = machine.layout, machine.n_joints
    if machine.n_legs != m or sorted(layout.actuated.tolist()) != list(range(m)):
        return ()
    readings = joints[evenly(len(joints), NUMBERING_CONFIGURATIONS)]
    orders = [np.roll(np.arange(m), -first) for first in range(1, m)]
    return tuple(order for order in orders if _equivalent(machine, readings, order))


def _equivalent(machine: Machine, readings: Array, order: Integers) -> bool:
    """Whether legs with the readings (n, m) of other columns are, up to one rigid motion of the
    whole, where the legs of those columns are.
    """
    layout, table = machine.layout, machine.parameters
    column = layout.actuated
    other = np.argsort(column)[order[column]]  # the leg that has each one's new column
    for mine, its in zip(layout.radius, (layout.radius[j] for j in other), strict=True):
        if len(mine) != len(its):
            return False
        if np.any(np.abs(machine.values[mine] - machine.values[its]) > table.tolerance[mine]):
            return False
    points: list[Array] = []
    for joints in (readings, readings[:, order]):
        fk = machine.forward_result(joints)
        if not fk.converged.all():
            return False
        ends = limb_ends(layout, machine.values, joints, fk.T_base_platform, fk.internal)
        points.append(np.concatenate([ends.a, ends.b], axis=1))
    legs = np.concatenate([other, other + machine.n_legs])
    before, after = points[0][:, legs].reshape(-1, 3), points[1].reshape(-1, 3)
    turn = register(after, before)
    off = after @ turn[:3, :3].T + turn[:3, 3] - before
    limit = max(float(table.tolerance[table.of_kind("center")].mean()), LAST_DIGIT)
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) < limit


def numbering_note(session: Session) -> Iterator[Finding]:
    """A note where nothing in a session, such as a station's pose by hand, determines which leg of
    the nominal model the first column of the readings is.
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
            pose=None if by_hand else "pose",  # which photographs by hand have none of
        )
