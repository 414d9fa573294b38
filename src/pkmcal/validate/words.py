"""What a validation says: is the machine better than its drawing, by how much, and how sure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.validate.figures import figures, promised, reading_units
from pkmcal.validate.holdouts import HoldOut, Judged
from pkmcal.validate.judged import Ratio, ratio, rms
from pkmcal.wording import SCALES, brief, count

MOSTLY_NOISE = 2**0.5
"""Factor on the photographs' noise within which that is more than half of the mean square."""
POOR = 2.0
"""Factor by which a region's errors must exceed those of the configurations in use to be told."""


def amount(value: float, unit: str) -> str:
    """``0.07 mm``, ``0.3°``."""
    factor, name = SCALES[unit]
    return brief(value * factor) + ("" if name == "°" else " ") + name


def verdict_of(judged: Judged | None, holdouts: Sequence[HoldOut], machine: Machine) -> Verdict:
    """The verdict on new data, or, without any, on the regions held out, pooled."""
    units = reading_units(machine)
    unit = units[0] if len(set(units)) == 1 else None
    groups = [judged] if judged else [h.left_out for h in holdouts]
    before, after = (
        np.concatenate([getattr(g, name) for g in groups]) for name in ("before", "after")
    )
    floor = rms(np.concatenate([np.full(len(g.rows), g.floor) for g in groups]))
    gain = ratio(before, after)
    reasons = [*_not_better(gain), *_broken(groups, units)]
    headline = _headline(gain, before, after, unit, bool(judged))
    warnings = _regions(holdouts, unit)
    return Verdict(
        not reasons, headline, tuple(reasons), tuple(warnings), tuple(_noise(after, floor, unit))
    )


def _headline(gain: Ratio, before: Array, after: Array, unit: str | None, new: bool) -> str:
    times = f"{_times(gain.value)} (±{_times(gain.sigma)})"
    where = "" if new else " of regions that it did not see"
    if gain.high < 1:
        core = (
            f"The drawing predicts the readings{where} {_times(1 / gain.value)} times better than"
            " the calibrated machine"
        )
    elif gain.better:
        core = (
            f"The calibrated machine predicts the readings{where} {times} times better than the"
            " drawing"
        )
    else:
        core = (
            f"The calibrated machine is not shown to predict the readings{where} better than the"
            f" drawing: {times} times"
        )
    if unit is None:
        return core + "."
    sign = "," if not gain.better and gain.high >= 1 else ":"
    return f"{core}{sign} {amount(rms(after), unit)} against {amount(rms(before), unit)}."


def _times(value: float) -> str:
    """A factor with the digits that it deserves."""
    if not np.isfinite(value):
        return "?"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _not_better(gain: Ratio) -> list[str]:
    if gain.better:
        return []
    if gain.high < 1:
        return [
            "The calibration made the machine worse: use the drawing, and look for mixed-up files,"
            " a machine that was changed, or a camera's calibration that is not its own."
        ]
    return [
        f"On these data it may be {_times(gain.low)} to {_times(gain.high)} times as good as the"
        " drawing (95 %): too few configurations, or too much noise in them, to tell."
    ]


def _broken(groups: Sequence[Judged], units: tuple[str, ...]) -> list[str]:
    """Residuals that the deviations do not promise: the first group's that has such."""
    for group in groups:
        if not group.promise.usual:
            return [_too_large(group, units)]
        if not group.promise.steady:
            return [_in_common(group, units)]
    return []


def _too_large(group: Judged, units: tuple[str, ...]) -> str:
    said = ""
    if len(set(units)) == 1:
        found = rms(figures(group.calibrated, group).joint_rms)
        said = f" ({amount(found, units[0])}, promised {amount(rms(promised(group)), units[0])})"
    return (
        f"The residuals are {_times(group.promise.factor)} times larger than the calibration's"
        f" deviations and the photographs' noise promise{said}; chance does not explain that."
        " The machine has changed since, or something that the model leaves out moves it."
    )


def _in_common(group: Judged, units: tuple[str, ...]) -> str:
    test = group.promise
    worst = int(np.argmax(np.abs(test.common) / test.common_sigma))
    off = amount(abs(float(test.common[worst])), units[worst])
    sigma = amount(float(test.common_sigma[worst]), units[worst])
    more = "more" if test.common[worst] > 0 else "less"
    return (
        f"In all configurations alike, joint {worst + 1} reads {off} (±{sigma}) {more} than"
        " predicted, which the calibration's deviations do not explain: its homing, its length or a"
        " joint has changed since, or the calibration is wrong by as much."
    )


def _noise(after: Array, floor: float, unit: str | None) -> list[str]:
    if unit is None or rms(after) > MOSTLY_NOISE * floor:
        return []
    return [
        f"What is left is mostly the photographs' own noise, {amount(floor, unit)}: the machine may"
        " be better still. Several stations that see the same configurations would tell."
    ]


def _regions(holdouts: Sequence[HoldOut], unit: str | None) -> list[str]:
    """Regions in which a calibration of the rest is poor."""
    out: list[str] = []
    for item in holdouts:
        off, usual = rms(item.left_out.after), rms(item.used.after)
        if off < POOR * usual:
            continue
        how = f": {amount(off, unit)} against {amount(usual, unit)}" if unit else ""
        out.append(
            f"Extrapolation is poor where the platform is {item.region.name}"
            f" ({count(len(item.left_out.rows), 'configuration')}, left out){how}. Photograph"
            " configurations there before the machine works there."
        )
    return out
