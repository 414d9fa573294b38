"""Checks of joint readings against their machine: columns, units, signs, ranges, movement."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.files import CsvTable
from pkmcal.levels import FALSE_ALARM
from pkmcal.measurements import Column
from pkmcal.mechanisms.reading_hypotheses import (
    READING_HYPOTHESIS_OPTIONS,
    range_hypotheses,
    range_ratios,
)
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.outcome.hypotheses import EvidenceLevel, decide, posterior
from pkmcal.wording import DISPLAY_UNITS, listed, number

_UNITS = {
    "m": ("millimetres", "metres", "Divide them by 1000", "mm"),
    "rad": ("degrees", "radians", "Multiply them by pi/180", "deg"),
}
"""By SI unit: name of the likely wrong unit, that of the right one, the remedy, and the unit in a
column's head."""


MULTIPLE_ROUNDING = 1e-6
"""Difference of a reading from a whole multiple of a step, in steps, that is rounding."""
TEMPERATURE_HEAD = re.compile(r"temperature(?: ?[\[(](?:°C|degC|C|(K))[\])])?")
"""Head of the column of temperatures; its group is kelvin."""
ICE_POINT = 273.15
"""0 °C, K."""
TEMPERATURE_RANGE = (-100.0, 200.0)
"""Temperatures of machines, °C: beyond them they are in kelvin, or °C under kelvin."""


FORCE_WORDS = ("force", "tension", "torque")
"""Words after a reading's name in the head of a column of forces."""
FORCE_UNITS = {"m": {"N": 1.0, "kN": 1e3}, "rad": {"N m": 1.0, "Nm": 1.0}}
"""Units of the force on a reading in metres or radians, and their factors."""


@dataclass(frozen=True)
class JointTable:
    """Content of joints.csv.

    readings : table of the joint readings alone.
    forces : (K, m) on the readings, N, of cranks and spools N m; None without their columns.
    temperature : (K,) °C, of the configurations; None without their column.
    """

    readings: CsvTable
    forces: Array | None
    temperature: Array | None


def joint_table(whole: CsvTable, units: Sequence[str]) -> JointTable:
    """Parts of a table of readings, of forces after them and of temperatures in its last column.

    units : of the machine's readings, m or rad. Raises InputError for forces without their reading,
    or in another unit, and for temperatures of no machine.
    """
    table, temperature = _without_temperature(whole)
    heads = [_force_head(column) for column in table.columns]
    count = next((k for k, head in enumerate(heads) if head), len(heads))
    readings = _first_columns(table, count)
    if count == len(heads):
        return JointTable(readings, None, temperature)
    of = [head[0] if head else None for head in heads[count:]]
    if of != list(readings.columns):
        raise InputError(
            "the columns of forces are not those of the readings",
            where=f"{table.label}, line 1",
            found=", ".join(table.columns[count:]),
            expected=", ".join(f"{name} force" for name in readings.columns)
            or "the readings in front of their forces",
            next_step="Write one force for each reading, in the order of the readings",
            code="readings.forces",
        )
    factors = []
    for column, head, unit in zip(table.columns[count:], heads[count:], units, strict=False):
        stated, allowed = head[1] if head else "", FORCE_UNITS[unit]
        if stated and stated not in allowed:
            raise InputError(
                "this force is in another unit than its reading needs",
                where=f"{table.label}, line 1",
                found=column,
                expected="N m, since the reading is an angle" if unit == "rad"
                else "N or kN, since the reading is a length",
                code="readings.force_unit",
            )  # fmt: skip
        factors.append(allowed[stated] if stated else 1.0)
    factors += [1.0] * (len(of) - len(factors))  # the number of readings is checked later
    return JointTable(readings, table.values[:, count:] * factors, temperature)


def _force_head(column: str) -> tuple[str, str] | None:
    """Reading and unit, empty without one, of a column of forces; None for other columns."""
    name, _, unit = column.replace("(", "[").rstrip("])").partition("[")
    of, _, word = name.strip().rpartition(" ")
    return (of, unit.strip()) if of and word.lower() in FORCE_WORDS else None


def _first_columns(table: CsvTable, count: int) -> CsvTable:
    """The table's first columns of numbers."""
    return replace(
        table,
        columns=table.columns[:count],
        values=table.values[:, :count],
        units=table.units[:count],
    )


def _without_temperature(table: CsvTable) -> tuple[CsvTable, Array | None]:
    """Table without temperatures, and the temperatures (K,) of its last column, °C, if it has one;
    those without a unit are as they are. Raises InputError for temperatures of no machine.
    """
    head = TEMPERATURE_HEAD.fullmatch(table.columns[-1]) if table.columns else None
    if head is None:
        return table, None
    temperature = table.values[:, -1] - (ICE_POINT if head[1] else 0.0)
    least, most = TEMPERATURE_RANGE
    if wrong := np.flatnonzero((temperature < least) | (temperature > most)).tolist():
        raise InputError(
            "no machine has this temperature",
            where=f"{table.label}, line {table.lines[wrong[0]]}",
            found=f"{temperature[wrong[0]]:g} °C under {table.columns[-1]}",
            expected=f"{least:g} to {most:g} °C",
            next_step="Head the column temperature [K], or temperature [°C]",
            code="readings.temperature_unit",
        )
    return _first_columns(table, len(table.columns) - 1), temperature


def rounding_step(readings: Array, unit: str, least: float) -> float | None:
    """Largest round number, m or rad, of which all readings are whole multiples, as rounded numbers
    and commands are; None if it is not above ``least``.

    Round numbers are 1, 2 and 5 times a power of ten of metres, radians or degrees; readings with
    more digits are whole multiples of none by chance. readings : of one unit, any shape.
    """
    scales = (1.0,) if unit == "m" else (1.0, np.pi / 180)
    steps = [c * d * 10.0**k for c in scales for d in (1, 2, 5) for k in range(-7, 1)]
    for step in sorted(steps, reverse=True):
        counts = readings / step
        if step > least and np.abs(counts - np.round(counts)).max() < MULTIPLE_ROUNDING:
            return float(step)
    return None


def check_readings(
    table: CsvTable, ranges: Array, noise: float, units: Sequence[str], fewest: int = 2
) -> list[Finding]:
    """Raise InputError for readings that are impossible for the machine; return warnings.

    ranges : (m, 2) smallest and largest reading of each joint, m or rad; NaN if unknown.
    noise : standard deviation of a reading, m or rad.
    units : ``m`` or ``rad`` for each joint.
    fewest : fewest configurations.
    """
    _check_columns(table, len(ranges))
    table.check_kinds(units)
    if len(table.names) < fewest:
        raise InputError(
            "there is only one configuration",
            where=table.label,
            found=listed(table.names),
            expected="two at least; one does not distinguish a joint's place from its offset",
            next_step="Move the machine and take more images; 15 configurations are usual",
            code="configurations.only_one",
        )
    _check_mistakes(table, ranges, units)
    movement = _check_movement(table, noise) if len(table.names) > 1 else []
    return _check_ranges(table, ranges) + movement


def _check_columns(table: CsvTable, n_joints: int) -> None:
    """Check number and order of the columns."""
    n_columns = len(table.columns)
    if n_columns != n_joints:
        raise InputError(
            "another number of joint columns than the machine has actuated legs",
            where=f"{table.label}, line 1",
            found=f"{n_columns} ({', '.join(table.columns)})",
            expected=str(n_joints),
        )
    numbers = [re.fullmatch(r"leg(\d+)", name) for name in table.columns]
    order = [int(match[1]) for match in numbers if match]
    if len(order) == n_columns and order != sorted(order):
        raise InputError(
            "the columns are not in the order of the machine's legs",
            where=f"{table.label}, line 1",
            found=" ".join(table.columns),
            expected=" ".join(f"leg{number}" for number in sorted(order)),
            next_step="Sort the columns, names and readings together",
            code="readings.order",
        )


def _check_mistakes(table: CsvTable, ranges: Array, units: Sequence[str]) -> None:
    """Refuse readings in another unit, of the wrong sign or off by one constant, by the ranges
    (:func:`~pkmcal.mechanisms.reading_hypotheses.range_hypotheses`).

    Columns that are exchanged or shifted are not decided here: images do that
    (:mod:`pkmcal.observe.hypotheses`), or poses (:mod:`pkmcal.calibration.pose_hypotheses`).
    """
    level = EvidenceLevel("ranges", partial(range_ratios, table.values, ranges))
    best = decide(posterior(range_hypotheses(table.values, ranges, units), [level]))
    if best is None:
        return
    facts = best.hypothesis.facts
    motors = [k for k in facts["motors"] if np.isfinite(ranges[k]).all()]
    column, names = motors[0], listed([table.columns[k] for k in facts["motors"]], 7)
    row = int(np.argmin(_inside(table.values, ranges)[:, column]))
    low, high = ranges[column]
    if best.hypothesis.code == "readings.units":
        unit, expected, remedy, symbol = _UNITS[units[column]]
        what = f"the readings of {names} look like {unit}"
        expected = f"{expected}, between {low:g} and {high:g}"
        further = " and so on" if len(motors) > 1 else ""
        next_step = f"{remedy}, or head the column {table.columns[column]} [{symbol}]{further}"
    elif best.hypothesis.code == "readings.sign":
        what = f"the readings of {names} have the wrong sign"
        expected = f"{low:g} to {high:g}, where all of them lie with the other sign"
        next_step = (
            "Turn the sign of this column round, or the axis and range in the mechanism file"
        )
    else:
        unit = units[column]
        scale, display = DISPLAY_UNITS[unit]
        least, most = (
            number(end * scale, 0 if unit == "m" else 1, signed=True) for end in facts["constants"]
        )
        what = (
            f"the readings of {names} are off by one constant: they count from another place than"
            " the mechanism file does, such as from the homing switch"
        )
        expected = (
            f"{low:g} to {high:g}, where all of them lie with one number between {least} and {most}"
            f" {display} added"
        )
        next_step = (
            "Add the readings' constant to these columns, as far as you know it, or put it into the"
            " mechanism file's offsets: what is left of it is calibrated"
        )
    raise InputError(
        what,
        where=table.where(row, column),
        found=f"{table.values[row, column]:g}",
        expected=expected,
        next_step=next_step,
        code=best.hypothesis.code,
    )


def _check_ranges(table: CsvTable, ranges: Array) -> list[Finding]:
    """Refuse readings beyond the margin of their range; return a warning about those within the
    margin.
    """
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


def largest_range(count: int) -> float:
    """Range of repeated readings of one column, in standard deviations, that noise exceeds with the
    probability FALSE_ALARM at most.

    By Bonferroni's inequality for all pairs of readings: 4.9 for 5, 5.9 for 20, 6.9 for 100.
    """
    from scipy.special import ndtri

    return float(-np.sqrt(2) * ndtri(FALSE_ALARM / max(count * (count - 1), 2)))


def unmoved_readings(joints: Array, noise: float) -> Booleans:
    """Whether each column of readings (K, m) varies by no more than its noise, (m,)."""
    return np.ptp(joints, axis=0) <= largest_range(len(joints)) * noise


def frozen(joints: Array, noise: float, columns: Sequence[str], file: str) -> InputError | None:
    """Error about readings that never change, for data that contradict the readings; None if all
    change.
    """
    still = np.flatnonzero(unmoved_readings(joints, noise)).tolist() if len(joints) else []
    if not still:
        return None
    names = [columns[k] for k in still]
    return InputError(
        f"the readings of {listed(names)} are frozen: they never change, and the measurements do"
        " not fit the readings",
        where=f"{file}, column {names[0]}",
        found=f"{joints[0, still[0]]:g} in all {len(joints)} configurations",
        expected="readings that follow the motor",
        next_step="Look at the encoder, its cable and the program that logs it. If this motor was"
        " really held, something else is wrong",
        code="readings.frozen",
    )


def scale_columns(joints: Array, columns: Sequence[str], present: Array) -> Iterator[Column]:
    """Scale of each of the readings (K, m), beyond its prior sigma, in the order of the table.

    present : (m,) estimated scales relative to the nominal model.

    A score-tested scale has no prior, so its estimate is the full difference from the nominal
    scale, expressed relative to the present scale; the fact ``value`` is relative to the nominal
    one.
    """
    for m, name in enumerate(columns):

        def facts(
            value: Array, sigma: Array, name: str = name, own: float = float(present[m])
        ) -> dict[str, Any]:
            change = own * value[0]
            return {"column": name, "value": change, "sigma": sigma[0], "factor": 1 + change}

        by = (joints * np.eye(len(columns))[m])[..., None]
        yield Column("readings.scale", name, "reading scale", readings=by, facts=facts)


def play_columns(joints: Array, columns: Sequence[str], units: Sequence[str]) -> Iterator[Column]:
    """Play of each motor: its reading (K, m) differs with the direction in which it came."""
    direction = np.sign(np.diff(joints, axis=0, prepend=joints[:1])) / 2
    for m, (name, unit) in enumerate(zip(columns, units, strict=True)):

        def facts(value: Array, sigma: Array, name: str = name, unit: str = unit) -> dict[str, Any]:
            return {"column": name, "value": value[0], "sigma": sigma[0], "unit": unit}

        by = (direction * np.eye(len(columns))[m])[..., None]
        yield Column("readings.play", name, "backlash", readings=by, facts=facts)


def eccentricity_columns(
    joints: Array, columns: Sequence[str], units: Sequence[str]
) -> Iterator[Column]:
    """Eccentric encoder discs on cranks: readings (K, m) are off by a sine of their own angle, once
    per turn, with any phase. A disc that is off its axis by e reads e / radius too much at most.
    """
    for m, (name, unit) in enumerate(zip(columns, units, strict=True)):
        if unit != "rad":
            continue

        def facts(value: Array, sigma: Array, name: str = name) -> dict[str, Any]:
            size = float(np.linalg.norm(value))
            spread = float(np.linalg.norm(value * sigma)) / size if size else float(max(sigma))
            return {"column": name, "value": size, "sigma": spread, "sine_cosine": value.tolist()}

        by = np.zeros((*joints.shape, 2))
        by[:, m] = np.stack([np.sin(joints[:, m]), np.cos(joints[:, m])], axis=-1)
        yield Column("readings.eccentric", name, "eccentric encoder", readings=by, facts=facts)


def wrong_reading(column: str, unit: str, configuration: str, by: Array | None = None) -> Column:
    """Column of one wrong reading; by : (K, m, 1), one at that reading."""

    def facts(value: Array, sigma: Array) -> dict[str, Any]:
        return {
            "column": column,
            "configuration": configuration,
            "value": value[0],
            "sigma": sigma[0],
            "unit": unit,
        }

    name = f"{column}, {configuration}"
    return Column("readings.single", name, "reading", readings=by, facts=facts)


def _check_movement(table: CsvTable, noise: float) -> list[Finding]:
    """Refuse readings of which none changes; return a warning about joints that do not move."""
    still = unmoved_readings(table.values, noise)
    if still.all():
        raise InputError(
            "all configurations are equal: no joint moves by more than its noise",
            where=table.label,
            found=f"differences of {np.ptp(table.values, axis=0).max():g} at most",
            expected=f"much more than joints.noise, {noise:g}",
            next_step="Check that the readings are the right ones and the noise is not too large",
            code="readings.unmoved",
        )
    if not still.any():
        return []
    names = [name for name, is_still in zip(table.columns, still, strict=True) if is_still]
    return [doubtful("readings.unmoved", table.label, columns=names)]


def same_pose(joints: Array, noise: float) -> Integers:
    """Row (K,) of the first reading vector that equals each row of readings (K, m) within noise.

    Rows of one pose share this index.
    """
    owner = np.full(len(joints), -1)
    limit = largest_range(len(joints)) * noise
    # Sort by the joint with the largest range, so that each row is compared with few others.
    spread = joints[:, np.argmax(np.ptp(joints, axis=0))]
    order = np.argsort(spread, kind="stable")
    far = np.searchsorted(spread[order], spread + np.array([[-1.0], [1.0]]) * (limit + noise))
    for row in range(len(owner)):
        if owner[row] < 0:
            near = order[far[0, row] : far[1, row]]
            same = (np.abs(joints[near] - joints[row]) <= limit).all(axis=1)
            owner[near[same & (owner[near] < 0)]] = row
    return owner


def without_repeats(
    table: CsvTable, readings: CsvTable, noise: float
) -> tuple[CsvTable, list[Finding]]:
    """Table with the rows of one pose replaced by their mean, and a warning about them.

    readings : the table of the readings alone, of which poses are.

    Used for self-calibration from readings alone. Model errors, such as a belt that sags or a hook
    that is no point, are the same in all repeats of a pose; counted as independent measurements,
    the repeats would make sigma too small. Rows belong to one pose if no reading differs by more
    than noise. Over such small steps the closure equations are linear, so the mean of the rows is a
    reading of the mean pose.
    """
    first, group = np.unique(same_pose(readings.values, noise), return_inverse=True)
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
    rows = {"number": len(group), "poses": len(first), "apart": largest_range(len(group))}
    return merged, [doubtful("readings.repeated_poses", table.label, **rows)]


def _inside(
    values: Array, ranges: Array, margin: float = READING_HYPOTHESIS_OPTIONS.range_margin
) -> np.ndarray:
    """Whether each reading (K, m) is inside its range, widened by `margin` of the stroke; True for
    unknown ranges.
    """
    low, high = ranges[:, 0], ranges[:, 1]
    slack = margin * (high - low)
    # Negated, so that NaN (an unknown range) counts as inside.
    return ~((values < low - slack) | (values > high + slack))
