"""Checks of joint readings against their machine: columns, units, signs, ranges, movement."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.files import CsvTable
from pkmcal.measurements import Effect, ModelViolation
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.wording import DISPLAY_UNITS, listed, number

# A drawing's range is no hard stop: homing shifts it by the offset's tolerance, so a reading that
# is out by less than this part of the stroke is told, and one that is further out is refused.
_MARGIN = 0.05
# Largest difference within K equal readings, in standard deviations: below 6 for any K under
# a million, so more than this is movement.
_SAME_SIGMAS = 6.0
_UNITS = {
    "m": (
        1e-3,
        "millimetres",
        "metres",
        "Divide them by 1000, or head the columns leg1 [mm] and so on",
    ),
    "rad": (
        pi / 180,
        "degrees",
        "radians",
        "Multiply them by pi/180, or head them motor1 [deg] and so on",
    ),
}


def check_readings(
    table: CsvTable, ranges: Array, noise: float, units: Sequence[str]
) -> list[Finding]:
    """Raise `InputError` for readings that this machine cannot have; return warnings.

    ranges : (m, 2) smallest and largest reading of each joint, m or rad; NaN where not known.
    noise : standard deviation of a reading, m or rad. units : ``m`` or ``rad`` of each joint.
    """
    _check_columns(table, len(ranges))
    table.check_kinds(units)
    if len(table.names) < 2:
        raise InputError(
            "there is only one configuration",
            where=table.label,
            found=listed(table.names),
            expected="two at least; one cannot tell a joint's place from its offset",
            next_step="Move the machine and take more photographs; 15 configurations are usual",
        )
    _check_units(table, ranges, units)
    _check_signs(table, ranges)
    _check_shift(table, ranges, units)
    return _check_ranges(table, ranges) + _check_movement(table, noise)


def _check_columns(table: CsvTable, n_joints: int) -> None:
    names = len(table.columns)
    if names != n_joints:
        raise InputError(
            "another number of joint columns than the machine has actuated legs",
            where=f"{table.label}, line 1",
            found=f"{names} ({', '.join(table.columns)})",
            expected=str(n_joints),
        )
    numbers = [re.fullmatch(r"leg(\d+)", name) for name in table.columns]
    order = [int(match[1]) for match in numbers if match]
    if len(order) == names and order != sorted(order):
        raise InputError(
            "the columns are not in the order of the machine's legs",
            where=f"{table.label}, line 1",
            found=" ".join(table.columns),
            expected=" ".join(f"leg{number}" for number in sorted(order)),
            next_step="Sort the columns, names and readings together",
            code="readings.order",
        )


def _check_units(table: CsvTable, ranges: Array, units: Sequence[str]) -> None:
    """Raise `InputError` where most readings are out of range, and in range in another unit."""
    for kind, (factor, unit, expected, next_step) in _UNITS.items():
        finite = np.isfinite(ranges).all(axis=1) & (np.array(units) == kind)
        if not finite.any() or _inside(table.values, ranges)[:, finite].mean() > 0.5:
            continue
        if _inside(table.values * factor, ranges)[:, finite].mean() > 0.5:
            column = int(np.flatnonzero(finite)[0])
            low, high = ranges[column]
            raise InputError(
                f"the readings look like {unit}",
                where=table.where(0, column),
                found=f"{table.values[0, column]:g}",
                expected=f"{expected}, between {low:g} and {high:g}",
                next_step=next_step,
                code="readings.units",
            )


def _check_signs(table: CsvTable, ranges: Array) -> None:
    """Raise `InputError` for joints that are out of range, and in range with the other sign."""
    here, there = _inside(table.values, ranges), _inside(-table.values, ranges)
    wrong = np.flatnonzero((here.mean(axis=0) < 0.5) & there.all(axis=0))
    if not wrong.size:
        return
    column = int(wrong[0])
    row = int(np.argmin(here[:, column]))
    low, high = ranges[column]
    names = listed([table.columns[k] for k in wrong])
    raise InputError(
        f"the readings of {names} have the wrong sign",
        where=table.where(row, column),
        found=f"{table.values[row, column]:g}",
        expected=f"{low:g} to {high:g}, where all of them lie with the other sign",
        next_step="Turn the sign of this column round, or the axis and range in the mechanism file",
        code="readings.sign",
    )


def _check_shift(table: CsvTable, ranges: Array, units: Sequence[str]) -> None:
    """Raise `InputError` where most readings of all joints, or of some, are out of range, and all
    in range after a constant shift: they count from another zero.
    """
    inside, loosely = _inside(table.values, ranges, margin=0.0), _inside(table.values, ranges)
    if loosely.all():
        return
    few = inside.mean(axis=0) < 0.5
    for unit in dict.fromkeys(units):
        same = np.array(units) == unit
        for which in (same, same & few):
            if not which.any() or inside[:, which].mean() > 0.5 or not loosely[:, ~which].all():
                continue
            low, high = ranges[which].T
            values, slack = table.values[:, which], _MARGIN * (high - low)
            # fmax, fmin: a range that is not known allows any shift
            least = float(np.fmax.reduce(low - slack - values.min(axis=0)))
            most = float(np.fmin.reduce(high + slack - values.max(axis=0)))
            if least <= most:
                raise _shifted(table, ranges, which, (least, most), unit)


def _shifted(
    table: CsvTable, ranges: Array, which: Booleans, shift: tuple[float, float], unit: str
) -> InputError:
    """Error about joints ``which`` (m,) whose readings a shift puts into their ranges."""
    column = int(np.flatnonzero(which)[0])
    low, high = ranges[column]
    scale, name = DISPLAY_UNITS[unit]
    least, most = (number(end * scale, 0 if unit == "m" else 1, signed=True) for end in shift)
    return InputError(
        f"the readings of {listed([table.columns[k] for k in np.flatnonzero(which)], 7)} are off by"
        " one constant: they count from another place than the mechanism file does, such as from"
        " the homing switch",
        where=table.where(0, column),
        found=f"{table.values[0, column]:g}",
        expected=f"{low:g} to {high:g}, where all of them lie with one number between {least} and"
        f" {most} {name} added",
        next_step="Add the readings' constant to these columns, as far as you know it, or put it"
        " into the mechanism file's offsets: what is left of it is calibrated",
        code="readings.zero",
    )


def _check_ranges(table: CsvTable, ranges: Array) -> list[Finding]:
    far = np.argwhere(~_inside(table.values, ranges))
    if len(far):
        row, column = far[0]
        low, high = ranges[column]
        more = f"It is one of {len(far)} such readings. " if len(far) > 1 else ""
        alone = len(set(far[:, 1])) == 1 and np.ptp(table.values[:, column]) <= high - low
        direction = ", the motor's direction if it counts the other way" if alone else ""
        raise InputError(
            "this reading is outside the machine's range",
            where=table.where(row, column),
            found=f"{table.values[row, column]:g}",
            expected=f"{low:g} to {high:g}, the range in the mechanism file",
            next_step=f"{more}Correct the reading{direction}, or the mechanism's range",
            code="readings.outside_range",
        )
    near = np.argwhere(~_inside(table.values, ranges, margin=0.0))
    if not len(near):
        return []
    row, column = near[0]
    low, high = ranges[column]
    return [
        doubtful(
            "readings.outside_range",
            table.where(row, column),
            value=float(table.values[row, column]),
            low=float(low),
            high=float(high),
            number=len(near),
        )
    ]


def unmoved_readings(joints: Array, noise: float) -> Booleans:
    """Mask (m,) of the readings (K, m) that never move by more than their noise."""
    return np.ptp(joints, axis=0) <= _SAME_SIGMAS * noise


def frozen(joints: Array, noise: float, columns: Sequence[str], file: str) -> InputError | None:
    """Error about readings that never move, for data that contradict the readings; None without."""
    still = np.flatnonzero(unmoved_readings(joints, noise)).tolist() if len(joints) else []
    if not still:
        return None
    names = [columns[k] for k in still]
    return InputError(
        f"the readings of {listed(names)} are frozen: they never change, and what was seen does not"
        " fit the readings",
        where=f"{file}, column {names[0]}",
        found=f"{joints[0, still[0]]:g} in all {len(joints)} configurations",
        expected="readings that follow the motor",
        next_step="Look at the encoder, its cable and the program that logs it. If this motor was"
        " really held, something else is wrong",
        code="readings.frozen",
    )


def reading_violations(
    joints: Array, columns: Sequence[str], units: Sequence[str], present: Array
) -> tuple[list[ModelViolation], list[ModelViolation]]:
    """What may be otherwise with readings (K, m): of each its scale, beyond its tolerance, and its
    play, by which it differs with the way from which its motor came, in the order of the table.

    units : (m,). present : (m,) the scales of the estimate, over the drawing's. A scale that is
    free beside its tolerance leaves that one to the drawing again, so the value that fits is all of
    the difference, as the present scale counts it.
    """
    direction = np.sign(np.diff(joints, axis=0, prepend=joints[:1])) / 2
    scales: list[ModelViolation] = []
    plays: list[ModelViolation] = []
    for m, (name, unit) in enumerate(zip(columns, units, strict=True)):
        one = np.eye(len(columns))[m]

        def scale(
            value: Array, sigma: Array, name: str = name, own: float = float(present[m])
        ) -> dict[str, Any]:
            change = own * value[0]
            return {"column": name, "value": change, "sigma": sigma[0], "factor": 1 + change}

        def play(value: Array, sigma: Array, name: str = name, unit: str = unit) -> dict[str, Any]:
            return {"column": name, "value": value[0], "sigma": sigma[0], "unit": unit}

        by_scale, by_path = ((x * one)[..., None] for x in (joints, direction))
        scales.append(ModelViolation("readings.scale", name, scale, Effect(readings=by_scale)))
        plays.append(ModelViolation("readings.play", name, play, Effect(readings=by_path)))
    return scales, plays


def wrong_reading(column: str, unit: str, configuration: str) -> ModelViolation:
    """A single reading that is wrong."""

    def facts(value: Array, sigma: Array) -> dict[str, Any]:
        return {
            "column": column,
            "configuration": configuration,
            "value": value[0],
            "sigma": sigma[0],
            "unit": unit,
        }

    return ModelViolation("readings.single", f"{column}, {configuration}", facts)


def _check_movement(table: CsvTable, noise: float) -> list[Finding]:
    still = unmoved_readings(table.values, noise)
    if still.all():
        raise InputError(
            "all configurations are alike: no joint moves by more than its noise",
            where=table.label,
            found=f"differences of {np.ptp(table.values, axis=0).max():g} at most",
            expected=f"much more than joints.noise, {noise:g}",
            next_step="Check that the readings are the right ones and the noise is not too large",
            code="readings.unmoved",
        )
    if not still.any():
        return []
    names = [name for name, similar in zip(table.columns, still, strict=True) if similar]
    return [doubtful("readings.unmoved", table.label, columns=names)]


def same_pose(joints: Array, noise: float) -> Integers:
    """For each of the readings (K, m) the first row (K,) that differs by no more than noise: rows
    of one pose share it.
    """
    owner = np.full(len(joints), -1)
    # by the reading that spreads most, so that each row is held against few others
    spread = joints[:, np.argmax(np.ptp(joints, axis=0))]
    order = np.argsort(spread, kind="stable")
    far = np.searchsorted(
        spread[order], spread + noise * np.array([[-1.0], [1.0]]) * (_SAME_SIGMAS + 1)
    )
    for row in range(len(owner)):
        if owner[row] < 0:
            near = order[far[0, row] : far[1, row]]
            same = (np.abs(joints[near] - joints[row]) <= _SAME_SIGMAS * noise).all(axis=1)
            owner[near[same & (owner[near] < 0)]] = row
    return owner


def without_repeats(table: CsvTable, noise: float) -> tuple[CsvTable, list[Finding]]:
    """The table with rows of one pose merged into their mean, and a warning about them.

    For readings that are calibrated by themselves. Errors that the model leaves out, such as a belt
    that sags or a hook that is no point, are equal in all repeats of a pose, so repeats are no
    independent measurements. Rows are of one pose where no reading differs by more than noise. Over
    so small a step the closure equations are linear, so the mean of the rows is the reading of the
    mean pose.
    """
    first, group = np.unique(same_pose(table.values, noise), return_inverse=True)
    if len(first) == len(group):
        return table, []
    total = np.zeros((len(first), table.values.shape[1]))
    np.add.at(total, group, table.values)
    merged = replace(
        table,
        names=tuple(table.names[row] for row in first),
        values=total / np.bincount(group)[:, None],
        lines=tuple(table.lines[row] for row in first),
    )
    rows = {"number": len(group), "poses": len(first), "apart": _SAME_SIGMAS}
    return merged, [doubtful("readings.repeated_poses", table.label, **rows)]


def _inside(values: Array, ranges: Array, margin: float = _MARGIN) -> np.ndarray:
    """Mask (K, m) of readings in their range, widened by `margin` of it, or without a range."""
    low, high = ranges[:, 0], ranges[:, 1]
    slack = margin * (high - low)
    # Negated, so that NaN, a range that is not known, counts as inside.
    return ~((values < low - slack) | (values > high + slack))
