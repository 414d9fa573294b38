"""Hypotheses about mistakes in a table of joint readings, as transformations of the readings.

Board and tracker poses compare these hypotheses by their misfit, images by the likelihood of edges;
the list of hypotheses is the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from pkmcal.arrays import Array

RANGE_MARGIN = 0.05
"""Margin of a reading beyond its range, as a share of the stroke: homing shifts a range by the
prior sigma of the offset."""
CONSTANTS_IN_A_STROKE = 16
"""Constants tried for a reversed motor in one stroke. The nearest is at most half a step off, which
moves the platform by a thirtieth of the stroke, a tenth of the effect of reversed readings."""


@dataclass(frozen=True)
class ReadingHypothesis:
    """Readings (K, m) that may be the true ones of a session.

    motors : columns that differ.
    constant : for a reversed motor, the sum (m or rad) of a reading and its true value; 0 for a
        wrong sign alone.
    """

    code: Literal["readings.reversed", "readings.exchanged", "readings.renumbered"]
    motors: tuple[int, ...]
    joints: Array
    constant: float = 0.0


def reversed_motor(joints: Array, motor: int, constant: float) -> ReadingHypothesis:
    """Readings (K, m) with one motor reversed."""
    turned = joints.copy()
    turned[:, motor] = constant - joints[:, motor]
    return ReadingHypothesis("readings.reversed", (motor,), turned, constant)


def reversed_motors(joints: Array, ranges: Array) -> list[list[ReadingHypothesis]]:
    """Hypotheses for each motor: reversed readings with constants that put them into range.

    joints : (K, m).
    ranges : (m, 2) smallest and largest reading, NaN if unknown.
    Returns a list for each motor. The wrong sign alone comes first if these readings are in range;
    for an unknown range it is the only hypothesis. The list is empty if no constant is possible.
    """
    out: list[list[ReadingHypothesis]] = []
    for motor, (low, high) in enumerate(ranges):
        stroke = high - low
        if not np.isfinite(stroke):
            out.append([reversed_motor(joints, motor, 0.0)])
            continue
        slack = RANGE_MARGIN * stroke
        least = low - slack + joints[:, motor].max()
        most = high + slack + joints[:, motor].min()
        count = int(np.ceil(CONSTANTS_IN_A_STROKE * (most - least) / stroke)) + 1
        constants = np.linspace(least, most, count) if least <= most else np.zeros(0)
        signs = [0.0] if least <= 0 <= most else []
        out.append([reversed_motor(joints, motor, float(c)) for c in (*signs, *constants)])
    return out


def exchanged_motors(joints: Array) -> list[ReadingHypothesis]:
    """Readings (K, m) with two motors exchanged, for every pair."""
    out: list[ReadingHypothesis] = []
    for one, other in combinations(range(joints.shape[1]), 2):
        order = np.arange(joints.shape[1])
        order[[one, other]] = other, one
        out.append(ReadingHypothesis("readings.exchanged", (one, other), joints[:, order]))
    return out
