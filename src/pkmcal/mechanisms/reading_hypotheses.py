"""Mistakes in a table of joint readings, as transformations of the readings.

One list for images, boards and trackers: a motor that counts the other way, two columns exchanged,
columns counted from another leg or backwards, rows shifted by one configuration. Boards and
trackers weigh these hypotheses by how platform poses close, images by the likelihood of edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from math import log
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.outcome.hypotheses import Hypothesis
from pkmcal.wording import DISPLAY_UNITS, listed, number

RANGE_MARGIN = 0.05
"""Part of a stroke by which a reading may leave its range: homing shifts a range by the offset's
tolerance."""
CONSTANTS_IN_A_STROKE = 16
"""Constants that are tried for a reversed motor in one stroke. One that is half a step off moves
the platform by a thirtieth of the stroke, a tenth of what the reversed readings do."""

ReadingHypothesis = Hypothesis[Array]
"""Data of these hypotheses are readings (K, m), m or rad. Facts: ``motors``, the columns (from 0)
of one motor or two; ``constant`` of a reversed motor, the sum (m or rad) of a reading and the joint
value that it stands for, 0 for a wrong sign alone; ``order`` (m,), the column of each leg;
``step``, by how many rows the readings come late."""


def reading_hypotheses(joints: Array, ranges: Array) -> list[ReadingHypothesis]:
    """All mistakes in readings that are weighed, with equal prior odds for each explanation.

    joints : (K, m). ranges : (m, 2) smallest and largest reading, NaN where not known.
    """
    hypotheses = [
        *reversed_motors(joints, ranges),
        *exchanged_motors(joints.shape[1]),
        *renumbered_legs(joints.shape[1]),
        *shifted_rows(len(joints)),
    ]
    prior = -log(max(len({one.meaning for one in hypotheses}), 1))
    return [replace(one, log_prior=prior) for one in hypotheses]


def reversed_motor(motor: int, constant: float) -> ReadingHypothesis:
    """One motor that counts the other way."""

    def apply(joints: Array) -> Array:
        turned = joints.copy()
        turned[:, motor] = constant - joints[:, motor]
        return turned

    code = "readings.reversed" if constant else "readings.sign"
    facts: dict[str, Any] = {"motors": (motor,), "constant": constant}
    return ReadingHypothesis(code, f"motor {motor + 1}", apply, facts=facts)


def reversed_motors(joints: Array, ranges: Array) -> list[ReadingHypothesis]:
    """Each motor that counts the other way, with constants by which its readings are in range.

    A wrong sign alone (constant 0) is the first of a motor where it is in range, and the only one
    where the range is not known.
    """
    out: list[ReadingHypothesis] = []
    for motor, (low, high) in enumerate(ranges):
        stroke = high - low
        if not np.isfinite(stroke):
            out.append(reversed_motor(motor, 0.0))
            continue
        slack = RANGE_MARGIN * stroke
        least = low - slack + joints[:, motor].max()
        most = high + slack + joints[:, motor].min()
        count = int(np.ceil(CONSTANTS_IN_A_STROKE * (most - least) / stroke)) + 1
        constants = np.linspace(least, most, count) if least <= most else np.zeros(0)
        signs = [0.0] if least <= 0 <= most else []
        out += [reversed_motor(motor, float(c)) for c in (*signs, *constants)]
    return out


def exchanged_motors(count: int) -> list[ReadingHypothesis]:
    """The readings of two of ``count`` motors exchanged, every pair."""
    out: list[ReadingHypothesis] = []
    for one, other in combinations(range(count), 2):
        order = np.arange(count)
        order[[one, other]] = other, one
        subject = f"motors {one + 1} and {other + 1}"
        out.append(reordered("readings.exchanged", subject, order, motors=(one, other)))
    return out


def renumbered_legs(count: int) -> list[ReadingHypothesis]:
    """Columns that begin with another leg, or run backwards, but for those that are the nominal
    order or an exchange of two.
    """
    own = np.arange(count)
    turned = [("turned", np.roll(own, -first)) for first in range(1, count)]
    turned += [("reversed", np.roll(own[::-1], first)) for first in range(count)]
    out: dict[tuple[int, ...], ReadingHypothesis] = {}
    for direction, order in turned:
        if np.count_nonzero(order != own) > 2:
            hypothesis = reordered(f"readings.numbering_{direction}", f"leg {order[0] + 1}", order)
            out.setdefault(tuple(order.tolist()), hypothesis)
    return list(out.values())


def reordered(code: str, subject: str, order: Integers, **facts: Any) -> ReadingHypothesis:
    """Columns in another order, (m,): the column of each leg."""
    return ReadingHypothesis(
        code, subject, lambda joints: joints[:, order], facts={"order": order, **facts}
    )


def shifted_rows(count: int) -> list[ReadingHypothesis]:
    """Readings that stand one configuration late or early, of ``count`` rows."""
    if count <= 2:  # a shift is an exchange then
        return []
    return [
        ReadingHypothesis(
            "readings.shifted",
            f"{step:+d} row",
            lambda joints, step=step: np.roll(joints, step, axis=0),
            facts={"step": step},
        )
        for step in (1, -1)
    ]


def reading_error(
    hypothesis: ReadingHypothesis,
    file: str,
    columns: Sequence[str],
    units: Sequence[str],
    without: str = "",
) -> InputError:
    """The error that names a mistake in the readings, without what shows it.

    file : of the readings, with ``columns``. units : ``m`` or ``rad`` of each. without : what the
    data do where the readings are right, for the end of what is expected.
    """
    facts, where = hypothesis.facts, f"{file}, line 1"
    names = [columns[motor] for motor in facts.get("motors", ())]
    if hypothesis.code == "readings.sign":
        what = f"the readings of {names[0]} have the wrong sign"
        where = f"{file}, column {names[0]}"
        expected = "the readings with the other sign"
        next_step = "Turn the sign of this column round, or the axis in the mechanism file"
    elif hypothesis.code == "readings.reversed":
        unit = units[facts["motors"][0]]
        scale, display = DISPLAY_UNITS[unit]
        constant = f"{number(scale * facts['constant'], 0 if unit == 'm' else 1)} {display}"
        what = f"the readings of {names[0]} count the other way"
        where = f"{file}, column {names[0]}"
        expected = f"{constant}, or nearly so, less the reading"
        next_step = (
            f"Turn the motor's direction round where it is set, or write {constant} less"
            " the reading into this column; what is left of the constant is calibrated"
        )
    elif hypothesis.code == "readings.exchanged":
        what = f"the readings of {listed(names)} are exchanged"
        expected = "the two columns in the other order"
        next_step = "Exchange the two columns, or the motors in the mechanism file"
    elif hypothesis.code == "readings.shifted":
        what = "the readings are shifted by one configuration"
        where = file
        near = "before" if facts["step"] > 0 else "after"
        expected = f"at each configuration the readings of the one {near} it"
        next_step = "Look for a row that is missing or was written twice"
    else:
        order = [columns[k] for k in facts["order"]]
        what = "the legs are numbered differently in the readings and in the mechanism file"
        expected = f"the columns in the order {listed(order, len(order))}"
        next_step = "Give the columns the order of the legs in the mechanism file"
    return InputError(
        what,
        where=where,
        expected=f"{expected}; with that, {without}" if without else expected,
        next_step=next_step,
        code=hypothesis.code,
    )
