"""Verdicts in words, of ``validate`` and ``watch``.

Whether the calibrated machine is better than the nominal one, by how much and how significantly;
whether it is unchanged, has changed and where, or the data are insufficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.judge.changes import (
    DETECTION_POWER,
    Change,
    ChangeTests,
    Explanation,
    LegTest,
    StationTest,
    Suspect,
)
from pkmcal.judge.comparison import (
    NominalComparison,
    Ratio,
    finite_rms,
    improvement_ratio,
)
from pkmcal.judge.holdouts import HoldOut
from pkmcal.levels import FALSE_ALARM, NOISE_EXCESS
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, doubtful, note, wrong
from pkmcal.wording import (
    DISPLAY_UNITS,
    amount,
    brief,
    count,
    decimals,
    listed,
    named,
    number,
    percentage,
    with_unit,
)

MOSTLY_NOISE = 2**0.5
"""Factor on the noise of images within which noise is more than half of the mean square."""
STEEL_EXPANSION = 12e-6
"""Thermal expansion of steel, 1/K, to illustrate a common scale."""
MOST_OTHERS = 4
"""Maximum number of rival causes that are named."""


def factor(value: float) -> str:
    """A factor with its significant digits."""
    if not np.isfinite(value):
        return "–"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def better(gain: Ratio) -> str:
    """``14 (±3)``."""
    return f"{factor(gain.value)} (±{factor(gain.sigma)})"


def validation_verdict(
    judged: NominalComparison | None,
    holdouts: Sequence[HoldOut],
    machine: Machine,
    measurements: Measurements,
    repeated: Booleans | None = None,
) -> Verdict:
    """Verdict on new data, or, without any, on all held-out regions together.

    measurements : of all configurations. repeated : (K,) configurations at poses that the
    calibration used; None for none.
    """
    units = machine.joint_units
    unit = units[0] if len(set(units)) == 1 else None
    groups = [judged] if judged else [h.left_out for h in holdouts]
    before, after = (
        np.concatenate([getattr(g, name) for g in groups]) for name in ("before", "after")
    )
    floor = finite_rms(np.concatenate([np.full(len(g.rows), g.floor) for g in groups]))
    gain = improvement_ratio(before, after)
    reasons = [*_not_better(gain), *_promise_findings(groups, units)]
    again = int(repeated[judged.rows].sum()) if judged and repeated is not None else 0
    every = judged is not None and again == len(judged.rows)
    where = " of regions that it did not see" if judged is None else ""
    if every:
        where = " at the poses that it was calibrated from"
    headline = _validation_headline(gain, before, after, unit, where)
    warnings = _region_findings(holdouts, unit)
    if judged and again:
        warnings.insert(0, doubtful("validation.same_poses", number=again, of=len(judged.rows)))
    if judged and gain.better:
        warnings += _unweighted_findings(judged, units)
    noise = _noise_findings(
        after, floor, unit, measurements, np.concatenate([g.rows for g in groups])
    )
    return Verdict(not reasons, headline, (*reasons, *warnings, *noise))


def _validation_headline(
    gain: Ratio, before: Array, after: Array, unit: str | None, where: str
) -> str:
    if gain.high < 1:
        core = (
            f"The nominal model predicts the readings{where} {factor(1 / gain.value)} times better"
            " than the calibrated machine"
        )
    elif gain.better:
        core = (
            f"The calibrated machine predicts the readings{where} {better(gain)} times better than"
            " the nominal model"
        )
    else:
        core = (
            f"The calibrated machine is not shown to predict the readings{where} better than the"
            f" nominal model: {better(gain)} times"
        )
    if unit is None:
        return core + "."
    sign = "," if not gain.better and gain.high >= 1 else ":"
    return f"{core}{sign} {against(after, before, unit)}."


def against(new: Array, old: Array, unit: str) -> str:
    """Root mean squares of residuals (n,), m or rad: ``0.07 mm against 0.9 mm``."""
    return f"{amount(finite_rms(new), unit)} against {amount(finite_rms(old), unit)}"


def _not_better(gain: Ratio) -> list[Finding]:
    if gain.better:
        return []
    facts = {"value": gain.value, "low": gain.low, "high": gain.high}
    if gain.high < 1:
        return [wrong("validation.worse", **facts)]
    words = {"low_words": factor(gain.low), "high_words": factor(gain.high)}
    return [wrong("validation.not_better", **facts, **words)]


def _promise_findings(groups: Sequence[NominalComparison], units: tuple[str, ...]) -> list[Finding]:
    """Finding on residuals larger than their standard deviations, of the first group with such."""
    same_unit = len(set(units)) == 1
    for group in groups:
        promise = group.promise
        if not promise.usual:
            rms = finite_rms(group.figures(group.calibrated).joint_rms) if same_unit else None
            found = wrong(
                "validation.residuals_too_large",
                value=promise.factor,
                times=factor(promise.factor),
                rms=rms,
                promised=finite_rms(promise.joint_rms) if same_unit else None,
                unit=units[0],
            )
            return [found]
        if not promise.steady:
            worst = int(np.argmax(np.abs(promise.common) / promise.common_sigma))
            found = wrong(
                "validation.joint_offset",
                f"joint {worst + 1}",
                joint=worst + 1,
                value=float(promise.common[worst]),
                sigma=float(promise.common_sigma[worst]),
                unit=units[worst],
            )
            return [found]
    return []


def _unweighted_findings(group: NominalComparison, units: tuple[str, ...]) -> list[Finding]:
    """Finding if unweighted root mean squares contradict the verdict, which weights by
    observability.
    """
    by_nominal, by_calibrated = (group.figures(e) for e in (group.nominal, group.calibrated))
    worse = by_calibrated.joint_rms > by_nominal.joint_rms
    if not worse.any() and by_calibrated.position <= by_nominal.position:
        return []
    joint = int(np.argmax(np.where(worse, by_calibrated.joint_rms, -np.inf)))
    promised = float(group.promise.joint_rms[joint])
    facts: dict[str, Any] = {}
    if worse.any():
        facts = {"joint": joint + 1, "sigma": promised, "unit": units[joint]}
    return [doubtful("validation.hardly_seen", **facts)]


def _noise_findings(
    after: Array, floor: float, unit: str | None, measurements: Measurements, rows: Integers
) -> tuple[Finding, ...]:
    """Finding if the residuals of configurations ``rows`` are mostly noise, with the remedy."""
    if unit is None or finite_rms(after) > MOSTLY_NOISE * floor:
        return ()
    observed = np.zeros((len(measurements.joints), measurements.n_stations), dtype=bool)
    edges, poses = measurements.edges, measurements.poses
    poses = poses.select(measurements.on_platform[poses.mount])
    for one in (edges, poses):
        observed[one.configuration, one.station] = True
    stations = int(observed[rows].any(axis=0).sum())
    once = int(np.sum(observed[rows].sum(axis=1) == 1))
    facts = {"noise": floor, "unit": unit, "stations": stations, "number": once, "of": len(rows)}
    if stations == 1:
        return (note("validation.noise_one_station", **facts),)
    if once == len(rows):
        return (note("validation.noise_each_once", **facts),)
    if once:
        return (note("validation.noise_some_once", **facts),)
    return (note("validation.noise_several", **facts),)


def _region_findings(holdouts: Sequence[HoldOut], unit: str | None) -> list[Finding]:
    """Findings on regions in which a calibration by the others is poor."""
    out: list[Finding] = []
    for holdout in holdouts:
        off, usual = finite_rms(holdout.left_out.after), finite_rms(holdout.used.after)
        if off > NOISE_EXCESS * usual:
            out.append(
                doubtful(
                    "validation.extrapolation",
                    holdout.region.name,
                    number=len(holdout.left_out.rows),
                    rms=off,
                    rms_used=usual,
                    unit=unit,
                )
            )
    return out


@dataclass(frozen=True)
class Names:
    """Names of cameras and stations by their indices."""

    cameras: tuple[str, ...] = ()
    stations: tuple[str, ...] = ()


@dataclass(frozen=True)
class ComparedSession:
    """Facts of a session for a verdict, besides the tests.

    configurations : (K,) names.
    calibrated, observed : (K,) configurations used by the calibration, and those with observations.
    noisier : noise of the edges relative to that of the calibration.
    stations_moved : cameras that were assumed to be unmoved and have moved.
    """

    configurations: tuple[str, ...]
    calibrated: Booleans
    observed: Booleans
    noisier: float
    names: Names = Names()
    stations_moved: tuple[StationTest, ...] = ()


def watch_verdict(judged: ChangeTests, around: ComparedSession) -> Verdict:
    """Verdict on a change; usable means unchanged."""
    warnings = _warnings(around)
    if judged.changed:
        return _change_verdict(judged, around, warnings)
    blind = [leg for leg in judged.legs if is_blind(leg)]
    if blind:
        return Verdict(
            False,
            "These data are too few to decide whether the machine is still as calibrated.",
            (*_blindness_findings(blind), *warnings, note("watch.more_configurations")),
        )
    new = int(np.sum(around.observed & ~around.calibrated))
    headline = (
        f"Still as calibrated, as far as {count(new, 'new configuration')} can show:"
        f" {_detectable_clause(judged)}."
    )
    silent = [leg for leg in judged.legs if leg.zero is None and leg.whole.dof]
    advice = (
        [note("watch.no_reading", _leg_names(silent), legs=_leg_names(silent))] if silent else []
    )
    return Verdict(True, headline, (*warnings, *advice))


def is_blind(leg: LegTest) -> bool:
    """Whether even a change as large as the prior sigma would not have been detected."""
    if leg.zero is None:
        return leg.whole.dof == 0
    return not leg.detects_zero <= leg.tolerance


def cause_words(suspect: Suspect, names: Names = Names(), short: bool = False) -> str:
    """A cause with its estimated change, as a part of a sentence.

    short : only the size of a joint's motion, without its direction.
    """
    cause, value, sigma = suspect.cause, suspect.change.value, suspect.change.sigma
    who = named(cause.legs) if cause.legs else ""
    if cause.part == "scale":
        return f"all lengths against the readings by {_ratio(value[0], sigma[0])}"
    if cause.part == "camera":
        has_name = cause.camera < len(names.cameras)
        name = names.cameras[cause.camera] if has_name else "a camera"
        return f"the focal length of {name} by {_ratio(value[0], sigma[0])}"
    if cause.part == "station":
        motion = _camera_motion(suspect.change)
        return f"the place of the camera {names.stations[cause.station]}{motion}"
    if cause.part in ("base", "platform"):
        joint = f"the {cause.part} joint{'s' if len(cause.legs) > 1 else ''} of {who}"
        together = " together" if len(cause.legs) > 1 else ""
        return f"{joint}{together}{_joint_motion(suspect, short)}"
    if cause.part == "lead":
        return f"the scale of {who}'s reading by {_ratio(value[0], sigma[0])}"
    parts = {"zero": f"the zero of {who}'s reading", "rod": f"the rod length of {who}"}
    what = parts.get(cause.part, f"the {cause.part} of {who}")
    if len(value) > 1:
        return f"{what}{_joint_motion(suspect, short)}"
    return f"{what} by {signed(value[0], sigma[0], cause.unit)}"


def signed(value: float, sigma: float, unit: str) -> str:
    """``+0.31 mm (±0.04)``."""
    scale, name = DISPLAY_UNITS[unit]
    if not np.isfinite(sigma):
        return "an amount that these data do not determine"
    places = decimals(sigma * scale)
    size = with_unit(number(value * scale, places, signed=True), name)
    return f"{size} (±{number(sigma * scale, places)})"


def _ratio(value: float, sigma: float) -> str:
    """``+120 µm/m (±15)``."""
    places = decimals(sigma * 1e6)
    return f"{number(value * 1e6, places, signed=True)} µm/m (±{number(sigma * 1e6, places)})"


def _joint_motion(suspect: Suspect, short: bool) -> str:
    """Size and direction of a joint's motion, if the data determine it."""
    cause, change = suspect.cause, suspect.change
    size = float(np.linalg.norm(change.value[:3]))
    if len(change.value) != 3 or size == 0 or not np.isfinite(change.sigma).all():
        return ""
    along = change.value / size
    sigma = float(np.sqrt(along @ change.covariance @ along))
    places = decimals(sigma * 1e3)
    text = f" by {number(size * 1e3, places)} mm (±{number(sigma * 1e3, places)})"
    if short:
        return text
    parts = ", ".join(number(v * 1e3, places, signed=True) for v in change.value)
    return f"{text}, ({parts}) mm in the {cause.part} frame"


def _camera_motion(change: Change) -> str:
    """Motion and rotation of a camera, as far as the data determine them."""
    out: list[str] = []
    for part, unit, factor in ((slice(3, 6), "mm", 1e3), (slice(0, 3), "°", 180 / np.pi)):
        value, covariance = change.value[part], change.covariance[part, part]
        size = float(np.linalg.norm(value))
        if size == 0 or not np.isfinite(change.sigma[part]).all():
            continue
        sigma = float(np.sqrt(value @ covariance @ value)) / size * factor
        places = decimals(sigma)
        text = with_unit(number(size * factor, places), unit)
        out.append(f"{text} (±{number(sigma, places)})")
    return f" by {' and '.join(out)}" if out else ""


def _change_verdict(
    judged: ChangeTests, around: ComparedSession, warnings: tuple[Finding, ...]
) -> Verdict:
    names = around.names
    findings = judged.findings
    if judged.another_machine:
        headline = (
            "This is not the machine that was calibrated, or most of its numbers have changed."
        )
        facts = {"chi2": judged.machine.chi2, "dof": judged.machine.dof}
        return Verdict(False, headline, (wrong("watch.another_machine", **facts), *warnings))
    if not findings:
        headline = "The machine is not as calibrated."
        legs = [leg for leg in judged.legs if leg.chance < judged.alpha]
        facts = {"chi2": judged.machine.chi2, "dof": judged.machine.dof}
        unidentified = wrong("watch.machine_test_fails", **facts)
        if legs:
            unidentified = wrong("watch.leg_test_fails", _leg_names(legs), legs=_leg_names(legs))
        return Verdict(False, headline, (unidentified, *warnings))
    lens = all(f.suspect.cause.part == "camera" for f in findings)
    if lens:
        headline = (
            "The images do not fit the calibration, and a camera explains that better than"
            " the machine: these data do not decide whether the machine is as calibrated."
        )
    else:
        headline = f"The machine is not as calibrated: {_changes_headline(findings)}."
    reasons = [_cause_finding(f, k, names) for k, f in enumerate(findings)]
    if judged.rest.dof and judged.rest.chance < FALSE_ALARM:
        remainder = {"chi2": judged.rest.chi2, "dof": judged.rest.dof, "chance": judged.rest.chance}
        reasons.append(wrong("watch.unexplained", **remainder))
    return Verdict(False, headline, (*reasons, *warnings, _next_step(findings)))


def _changes_headline(findings: Sequence[Explanation]) -> str:
    """Summary of the changes."""
    causes = [f.suspect.cause for f in findings if f.suspect.cause.part not in ("scale", "camera")]
    if not causes:
        return "all its lengths have another scale"
    legs = {leg for cause in causes for leg in cause.legs}
    rivals = {leg for f in findings for o in f.others for leg in o.cause.legs} - legs
    verb = "has" if len(legs) == 1 else "have"
    return f"{named(legs)} {verb} changed" + (", or another that looks the same" if rivals else "")


def _cause_finding(value: Explanation, place: int, names: Names) -> Finding:
    """Finding of one cause: its change and its rivals."""
    cause, change = value.suspect.cause, value.suspect.change
    alternatives = [cause_words(other, names, short=True) for other in value.others[:MOST_OTHERS]]
    if more := len(value.others) - len(alternatives):
        alternatives.append(count(more, "other cause"))
    facts: dict[str, Any] = {
        "place": "first" if place == 0 else "further",
        "part": cause.part,
        "legs": [leg + 1 for leg in cause.legs],
        "value": change.value,
        "sigma": change.sigma,
        "what": cause_words(value.suspect, names),
        "others": "; or ".join(alternatives) or None,
    }
    subject = named(cause.legs) if cause.legs else ""
    if cause.part in ("base", "platform"):
        return wrong("watch.mount" if len(cause.legs) > 1 else "watch.joint", subject, **facts)
    if cause.part == "scale":
        kelvin = brief(abs(change.value[0]) / STEEL_EXPANSION)
        return wrong("watch.scale", **facts, kelvin=kelvin, way=change.value[0])
    if cause.part in ("zero", "lead", "camera"):
        return wrong(f"watch.{cause.part}", subject, **facts)
    return wrong("watch.part", subject, **facts)


def _next_step(findings: Sequence[Explanation]) -> Finding:
    parts = {f.suspect.cause.part for f in findings}
    if parts == {"camera"}:
        return note("watch.next_camera")
    if parts == {"scale"}:
        return note("watch.next_scale")
    if any(f.others for f in findings):
        return note("watch.next_several")
    return note("watch.next_part")


def _detectable_clause(judged: ChangeTests) -> str:
    """Changes that would have been detected, in words."""
    zeros = [leg for leg in judged.legs if leg.zero is not None and leg.zero.dof]
    if not zeros:
        return "no test of a leg fails"
    what = "leg's length" if zeros[0].unit == "m" else "motor's zero"
    return (
        f"a change of any {what} by {with_unit(*least_size(zeros))}, depending on the leg, would"
        f" have been found with a probability of {percentage(DETECTION_POWER)}"
    )


def least_size(legs: Sequence[LegTest]) -> tuple[str, str]:
    """Smallest detectable changes of the legs' zeros, such as ``0.3 to 0.5``, and their unit."""
    scale, name = DISPLAY_UNITS[legs[0].unit]
    sizes = [brief(f(leg.detects_zero for leg in legs) * scale) for f in (min, max)]
    return " to ".join(dict.fromkeys(sizes)), name


def _blindness_findings(legs: Sequence[LegTest]) -> tuple[Finding, ...]:
    """Findings on legs for which these data are insufficient."""
    nothing = [leg for leg in legs if not np.isfinite(leg.detects_zero)]
    little = [leg for leg in legs if np.isfinite(leg.detects_zero)]
    out: list[Finding] = []
    if nothing:
        out.append(wrong("watch.leg_blind", _leg_names(nothing), legs=_leg_names(nothing)))
    if little:
        least = with_unit(*least_size(little))
        out.append(
            wrong("watch.leg_weak", _leg_names(little), legs=_leg_names(little), least=least)
        )
    return tuple(out)


def _warnings(around: ComparedSession) -> tuple[Finding, ...]:
    out: list[Finding] = []
    for s in around.stations_moved:
        name = around.names.stations[s.station]
        facts = {"station": name, "by": _camera_motion(s.change), "value": s.change.value}
        out.append(doubtful("watch.station_moved", name, **facts))
    both = around.calibrated & around.observed
    if both.any():
        names = [*compress(around.configurations, both)]
        out.append(doubtful("watch.known_configurations", listed(names, 4), names=names))
    if around.noisier > NOISE_EXCESS:
        out.append(doubtful("watch.noisier", scale=around.noisier))
    return tuple(out)


def _leg_names(tests: Sequence[LegTest]) -> str:
    """Names of the legs of tests."""
    return named(j for test in tests for j in test.legs)
