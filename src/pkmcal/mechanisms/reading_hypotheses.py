"""Mistakes in a table of joint readings, as transformations of the readings.

Boards and trackers weigh these hypotheses by the misfit of platform poses, images by the likelihood
of edges; the list is one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from pkmcal.arrays import Array

RANGE_MARGIN = 0.05
"""Part of a stroke by which a reading may leave its range: homing shifts a range by the offset's
tolerance."""
CONSTANTS_IN_A_STROKE = 16
"""Constants that are tried for a reversed motor in one stroke. One that is half a step off moves
the platform by a thirtieth of the stroke, a tenth of what the reversed readings do."""


@dataclass(frozen=True)
class ReadingHypothesis:
    """Readings (K, m) that a session may have in place of its own.

    motors : columns that differ. constant : of a reversed motor, the sum (m or rad) of a reading
    and the joint value that it stands for; 0 is a wrong sign alone.
    """

    code: Literal["readings.reversed", "readings.exchanged", "readings.renumbered"]
    motors: tuple[int, ...]
    joints: Array
    constant: float = 0.0


def reversed_motor(joints: Array, motor: int, constant: float) -> ReadingHypothesis:
    """Readings (K, m) of which one motor counts the other way."""
    turned = joints.copy()
    turned[:, motor] = constant - joints[:, motor]
    return ReadingHypothesis("readings.reversed", (motor,), turned, constant)


def reversed_motors(joints: Array, ranges: Array) -> list[list[ReadingHypothesis]]:
    """For each motor the constants with which its reversed readings are in range, a wrong sign
    alone first where that is one of them; an empty list where none is.

    joints : (K, m). ranges : (m, 2) smallest and largest reading, NaN where not known: then a wrong
    sign alone.
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
    """Readings (K, m) of two motors exchanged, every pair."""
    out: list[ReadingHypothesis] = []
    for one, other in combinations(range(joints.shape[1]), 2):
        order = np.arange(joints.shape[1])
        order[[one, other]] = other, one
        out.append(ReadingHypothesis("readings.exchanged", (one, other), joints[:, order]))
    return out
