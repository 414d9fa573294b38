"""Mistakes in a table of joint readings, as transformations of the readings.

One list serves images, boards and trackers: a motor that counts the other way, two columns
exchanged, columns counted from another leg or backwards, rows shifted by one configuration. The
evidence is the closure of platform poses for boards and trackers, and the likelihood of edges for
images. A second list (units, signs, zeros) is decided by the ranges of the readings alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import log, pi
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.levels import NEGLIGIBLE
from pkmcal.outcome.hypotheses import Hypothesis, parameter_cost
from pkmcal.wording import DISPLAY_UNITS, listed, number


@dataclass(frozen=True)
class ReadingHypothesisOptions:
    """Constants of the hypotheses about readings and of the likelihood of their ranges."""

    # part of a stroke by which a reading may leave its range: homing shifts a range by the offset's
    # tolerance
    range_margin: float = 0.05
    # constants that are tried for a reversed motor in one stroke: one that is half a step off moves
    # the platform by a thirtieth of the stroke, a tenth of what the reversed readings do
    constants_in_a_stroke: int = 16
    # prior share of single readings that are wrong, such as mistyped ones: as many as are no reason
    # against a result
    slip_share: float = NEGLIGIBLE
    # decades about the width of a range over which a wrong reading may be
    slip_decades: float = 6.0


READING_HYPOTHESIS_OPTIONS = ReadingHypothesisOptions()
OTHER_UNITS = {"m": 1e-3, "rad": pi / 180}
"""Factor to each SI unit from the one in which readings are often written, mm or degrees."""

ReadingHypothesis = Hypothesis[Array]
"""Data of these hypotheses are readings (K, m), m or rad. Facts: ``motors``, the columns (from 0)
of one motor, or of the two that are exchanged; ``constant`` of a reversed motor, the sum (m or rad)
of a reading and the joint value that it stands for, 0 for a wrong sign alone; ``order`` (m,), the
column of each leg; ``step``, by how many rows the readings come late."""


def reading_hypotheses(
    joints: Array,
    ranges: Array,
    options: ReadingHypothesisOptions = READING_HYPOTHESIS_OPTIONS,
) -> list[ReadingHypothesis]:
    """Mistakes in readings that measurements can show, with equal prior odds of each explanation.

    joints : (K, m). ranges : (m, 2) smallest and largest reading, NaN where unknown.
    """
    hypotheses = [
        *reversed_motors(joints, ranges, options),
        *exchanged_motors(joints.shape[1]),
        *renumbered_legs(joints.shape[1]),
        *shifted_rows(len(joints)),
    ]
    prior = -log(max(len({one.meaning for one in hypotheses}), 1))
    return [replace(one, log_prior=prior) for one in hypotheses]


def range_hypotheses(
    joints: Array,
    ranges: Array,
    units: Sequence[str],
    options: ReadingHypothesisOptions = READING_HYPOTHESIS_OPTIONS,
) -> list[ReadingHypothesis]:
    """Mistakes in whole columns of readings (K, m) that their ranges (m, 2) can show, with equal
    prior odds: signs, and readings in millimetres or degrees or another zero point of all joints
    with a unit, or of those that leave their range.

    units : ``m`` or ``rad`` for each joint. Facts in addition: ``factor`` (m,) of the readings, and
    ``constants``, the smallest and largest by which all of them are in range.
    """
    out, kinds = list[ReadingHypothesis](), np.array(units)
    low, high = ranges.T
    slack = options.range_margin * (high - low)
    # fmax and fmin ignore NaN: an unknown range allows any constant
    least = np.fmax(low - slack - joints.min(axis=0), -np.inf)
    most = np.fmin(high + slack - joints.max(axis=0), np.inf)
    outside = (joints.min(axis=0) < low - slack) | (joints.max(axis=0) > high + slack)
    for unit, factor in OTHER_UNITS.items():
        same = kinds == unit
        # all joints and those outside are one hypothesis where they are the same
        for which in {tuple(each): each for each in (same, same & outside) if each.any()}.values():
            out.append(_linear("readings.units", which, factor))
    stated, turned = (range_log_likelihood(sign * joints, ranges, options) for sign in (1, -1))
    reverse = (-joints.max(axis=0) >= low - slack) & (-joints.min(axis=0) <= high + slack)
    if (reverse & (turned > stated)).any():
        out.append(_linear("readings.sign", reverse & (turned > stated), -1.0))
    for unit in dict.fromkeys(units):
        same = kinds == unit
        for which in (same, same & ((least > 0) | (most < 0))):
            ends = np.max(least[which], initial=-np.inf), np.min(most[which], initial=np.inf)
            if ends[0] <= ends[1] and np.isfinite(ends).all():
                cost = parameter_cost(1, joints[:, which].size)
                middle = float(np.mean(ends))
                out.append(_linear("readings.zero", which, 1.0, middle, cost, constants=ends))
    prior = -log(max(len(out), 1))
    return [replace(one, log_prior=prior + one.log_prior) for one in out]


def _linear(
    code: str,
    which: Booleans,
    factor: float,
    constant: float = 0.0,
    log_prior: float = 0.0,
    **facts: Any,
) -> ReadingHypothesis:
    """Readings of the motors ``which`` (m,) times a factor, plus a constant."""
    factors, motors = np.where(which, factor, 1.0), tuple(np.flatnonzero(which).tolist())
    return ReadingHypothesis(
        code,
        f"motors {', '.join(str(motor + 1) for motor in motors)}",
        lambda joints: factors * joints + np.where(which, constant, 0.0),
        log_prior,
        facts={"motors": motors, "factor": factors, **facts},
    )


def range_ratios(
    joints: Array,
    ranges: Array,
    hypotheses: Sequence[ReadingHypothesis],
    options: ReadingHypothesisOptions = READING_HYPOTHESIS_OPTIONS,
) -> Array:
    """Log-likelihood ratios (N,) of hypotheses about readings (K, m) by their ranges (m, 2)."""
    known = np.isfinite(ranges).all(axis=1)
    null = range_log_likelihood(joints, ranges, options).sum()
    values = [range_log_likelihood(one.apply(joints), ranges, options).sum() for one in hypotheses]
    # density of the table's readings by that of the right ones
    scales = [np.log(np.abs(one.facts["factor"]))[known].sum() for one in hypotheses]
    return np.array(values) - null + len(joints) * np.array(scales)


def range_log_likelihood(joints: Array, ranges: Array, options: ReadingHypothesisOptions) -> Array:
    """Log-likelihood (m,) of each column of readings (K, m) by its range (m, 2), relative to
    readings that are uniform over the range with its margin; constant for unknown ranges.

    Readings beyond their range are slips, each by any factor, or the range is stated too narrow,
    by ``range_margin`` on average.
    """
    low, high = ranges.T
    margin, decades, share = options.range_margin, options.slip_decades, options.slip_share
    width, slack = (1 + 2 * margin) * (high - low), margin * (high - low)
    # in widths of the range; fmax ignores NaN, an unknown range
    below = np.fmax((low - slack - joints) / width, 0.0)
    above = np.fmax((joints - high - slack) / width, 0.0)
    ends = below.max(axis=0) + above.max(axis=0)
    # uniform in the logarithm, so no other unit, or sign, makes slips likelier
    size = np.maximum(np.abs(joints) / width, 10.0 ** (-decades / 2))
    slip = np.log(share / (2 * log(10.0) * decades * size))
    slips = np.where(below + above > 0, slip, np.log1p(-share)).sum(axis=0)
    wider = -len(joints) * np.log1p(ends) - ends / margin
    return np.maximum(slips, wider)


def reversed_motor(motor: int, constant: float) -> ReadingHypothesis:
    """One motor that counts the other way."""

    def apply(joints: Array) -> Array:
        turned = joints.copy()
        turned[:, motor] = constant - joints[:, motor]
        return turned

    code = "readings.reversed" if constant else "readings.sign"
    facts: dict[str, Any] = {"motors": (motor,), "constant": constant}
    return ReadingHypothesis(code, f"motor {motor + 1}", apply, facts=facts)


def reversed_motors(
    joints: Array, ranges: Array, options: ReadingHypothesisOptions
) -> list[ReadingHypothesis]:
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
        slack = options.range_margin * stroke
        least = low - slack + joints[:, motor].max()
        most = high + slack + joints[:, motor].min()
        count = int(np.ceil(options.constants_in_a_stroke * (most - least) / stroke)) + 1
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
    """Columns in another order; order : (m,), the column of each leg."""
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
    hypothesis: Hypothesis[Any],
    file: str,
    columns: Sequence[str],
    units: Sequence[str],
    without: str = "",
) -> InputError:
    """Error that names a mistake in the readings, without the value that was found.

    file, columns : of the readings. units : ``m`` or ``rad`` for each column. without : state of
    the data without the mistake, which ends the error's ``expected``.
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
