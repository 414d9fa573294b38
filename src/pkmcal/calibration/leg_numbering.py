"""Numberings of the legs that images and readings cannot distinguish.

If a nominal model is symmetric under a rotation, counting the columns of the readings from another
leg fits equally well: only the base frame differs, by that rotation. For such a machine, only a
hand-placed camera pose determines whether the first leg of the readings is the first leg of the
nominal model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from pkmcal.arrays import Array, Integers, evenly
from pkmcal.calibration.localization import legs_stations
from pkmcal.geometry.rigid import register
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.reading_hypotheses import (
    ReadingHypothesis,
    exchanged_motors,
    renumbered_legs,
)
from pkmcal.outcome.finding import Finding, note
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS, EvidenceLevel, posterior
from pkmcal.session.load import Session
from pkmcal.wording import in_full

NUMBERING_CONFIGURATIONS = 5
"""Number of configurations at which numberings are compared; unequal machines differ at any."""
LAST_DIGIT = 1e-6
"""Difference (m) between equal nominal models that is caused by rounding in their files."""


def equal_numberings(machine: Machine, joints: Array) -> tuple[Integers, ...]:
    """Permutations of the readings' columns, (m,) each, under which the nominal model is the same
    machine within its prior sigmas.

    Each starts the count at another leg, or counts backwards. Empty for machines with legs without
    a reading of their own.

    joints : (K, m) readings at which the machines are compared.
    """
    layout, m = machine.layout, machine.n_joints
    if machine.n_legs != m or sorted(layout.actuated.tolist()) != list(range(m)):
        return ()
    readings = joints[evenly(len(joints), NUMBERING_CONFIGURATIONS)]
    level = EvidenceLevel("nominal model", partial(_expected_ratios, machine, readings))
    # with two motors, counting from the other one exchanges them
    ranked = posterior(renumbered_legs(m) or exchanged_motors(m), [level])
    orders = [
        one.hypothesis.facts["order"] for one in ranked if one.log_odds > -HYPOTHESIS_THRESHOLDS.act
    ]
    return tuple(sorted(orders, key=lambda order: order[0]))


def _expected_ratios(
    machine: Machine, readings: Array, hypotheses: Sequence[ReadingHypothesis]
) -> Array:
    """Expected log-likelihood ratios (N,) of other numberings if the stated one is right.

    By the differences of the nominal model from itself with the legs in another order, after the
    best rigid motion, in prior sigmas, at readings (n, m).
    """
    layout, table = machine.layout, machine.parameters
    column, sigma = layout.actuated, table.tolerance
    joints = np.stack([readings, *(one.apply(readings) for one in hypotheses)])
    flat = joints.reshape(-1, joints.shape[-1])
    fk = machine.forward_result(flat)
    if not fk.converged[: len(readings)].all():
        return np.full(len(hypotheses), -np.inf)
    ends = limb_ends(layout, machine.values, flat, fk.T_base_platform, fk.internal)
    points = np.concatenate([ends.a, ends.b], axis=1).reshape(*joints.shape[:2], -1, 3)
    closed = np.all(fk.converged.reshape(joints.shape[:2]), axis=1).tolist()
    centre_sigma = max(float(sigma[table.of_kind("center")].mean()), LAST_DIGIT)
    out = np.full(len(hypotheses), -np.inf)
    for k, one in enumerate(hypotheses):
        other = np.argsort(column)[one.facts["order"][column]]  # leg that had each leg's new column
        radii = [(mine, layout.radius[its]) for mine, its in zip(layout.radius, other, strict=True)]
        if not closed[k + 1] or any(len(mine) != len(its) for mine, its in radii):
            continue
        tubes = [
            (machine.values[mine] - machine.values[its]) / np.maximum(sigma[mine], LAST_DIGIT)
            for mine, its in radii
        ]
        # best rigid motion between corresponding legs, and its residuals
        legs = np.concatenate([other, other + machine.n_legs])
        before, after = points[0][:, legs].reshape(-1, 3), points[k + 1].reshape(-1, 3)
        turn = register(after, before)
        off = (after @ turn[:3, :3].T + turn[:3, 3] - before) / centre_sigma
        # each end counts once, not in each configuration
        out[k] = -0.5 * (np.sum(off**2) / len(readings) + np.sum(np.concatenate(tubes) ** 2))
    return out


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
