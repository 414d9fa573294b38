"""Test of a calibrated machine for changes as an outcome: tables and charts of its tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.identify.score import Score
from pkmcal.judge.changes import DETECTION_POWER, LegTest
from pkmcal.judge.sentences import cause_words, least_size, signed
from pkmcal.judge.watch import Watch, names_of
from pkmcal.judge.watch_runs import Run, continued, share
from pkmcal.levels import NOISE_EXCESS
from pkmcal.outcome import Figure, Level, Outcome, Part, Row, Table
from pkmcal.outcome.blocks.base import configuration_key, leg_key
from pkmcal.outcome.blocks.plot import (
    DotsMark,
    LineMark,
    Mark,
    Plot,
    Point,
    RuleMark,
    category_axis,
    leg_colour,
    line_points,
    linear_axis,
    log_axis,
    panels,
    rounded,
)
from pkmcal.report.charts import NORMAL_90, bar_plot
from pkmcal.wording import (
    DISPLAY_UNITS,
    Chance,
    amount,
    brief,
    count,
    listed,
    named,
    number,
    percentage,
)

NO_VALUE_SIGN = "–"
STAMPS = {
    "as_calibrated": "Still as calibrated",
    "changed": "Changed",
    "undecided": "Undecided",
    "another_machine": "Another machine",
}
"""Result of a test in one to three words."""
LEAST_DRAWN_SHARE = 0.01
"""Statistic, in thresholds, below which it is drawn there on the logarithmic axis."""
WATCH_METHOD_TEXT = (
    "Nothing is calibrated anew. The machine is held as the calibration left it; every pose of the"
    " platform, and where cameras and boards stand, are found from the new data. What is left over"
    " is weighed by the noise of these data and by the calibration's own covariance, as far as"
    " poses, stations, edge shifts and shading cannot take it up. Each leg is then tested for a"
    " change of its numbers: a score test, chi-square of as many degrees of freedom as these data"
    " see.",
    "A camera's place costs six freedoms, unless it is stated to have been left in place: what"
    " moves all of the machine against its camera is not seen then. Directions in which a"
    " change by the nominal model's whole tolerance would make less than one standard deviation are"
    " left out.",
)


LEG_COLUMNS = {
    "Leg": "",
    "χ² / degrees": "Statistic of all numbers of the leg, and its degrees of freedom.",
    "χ² of zero": "Statistic of the zero of the leg's reading alone.",
    "By chance": "Probability of as much in a machine that did not change, all tests allowed for.",
    "Zero off by": "Change of the zero of the reading, if nothing else changed.",
    "Found from": "Smallest change of the zero with a probability of"
    f" {percentage(DETECTION_POWER)} to be found.",
    "Base joint from, mm": "Smallest displacement that would be found as often, in the direction"
    " seen best, and seen worst.",
    "Platform joint from, mm": "Smallest displacement that would be found as often, in the"
    " direction seen best, and seen worst.",
}
"""Columns of the table of legs, with their explanations."""


FIXED_STATION_TEXT = (
    "A camera's place in the calibration is used with its covariance, most of which it shares with"
    " the machine. Whether such a camera was moved is tested as well; a base that moved against its"
    " camera looks the same."
)


def outcome_of(w: Watch) -> Outcome:
    """Outcome of ``pkmcal watch``."""
    causes, run = _findings_table(w), panels(_by_configuration(w))
    parts = (
        _history(w),
        Part(
            "legs",
            "Tests",
            blocks=panels(_statistics(w), _zeros(w)),
            tables=(legs_table(w), _others_table(w)),
        ),
        Part("causes", "Causes", tables=(causes,)) if causes else None,
        Part("residuals", "Residuals", blocks=run) if run else None,
        _how(w),
    )
    return Outcome(
        command="watch",
        title=f"Watch of {w.calibration.machine.name}",
        kicker=w.session.called,
        verdict=w.verdict,
        stamp=STAMPS[w.run.result],
        level=Level.WRONG if w.judged.changed else Level.DOUBTFUL,
        figures=_cards(w),
        parts=tuple(part for part in parts if part),
        findings=w.session.findings,
        document=w.as_dict(),
    )


def _how(w: Watch) -> Part:
    """Section on the method."""
    poses = w.session.board or w.session.trackers
    allowed = (
        "Several tests are made, so each chance is adjusted: noise is drawn 20 000 times through"
        " the same tests, and the share in which any of them comes out as small is given. So"
        f" {w.judged.alpha:g} of machines that did not change are flagged. The noise is"
        f" {w.noise_scale:.2f} times the stated one of edges"
        + (f" and {w.pose_scale:.2f} times that of poses" if poses else "")
        + ": the larger of the calibration's and these data's."
    )
    prior = [n for n, k in zip(w.session.configurations, w.calibrated, strict=True) if k]
    left_out = f"Left out, for the calibration had seen them: {', '.join(prior)}."
    stayed = f"Left in place: {listed(w.same_place, 8)}. {FIXED_STATION_TEXT}"
    text = (*WATCH_METHOD_TEXT, stayed, allowed) if w.same_place else (*WATCH_METHOD_TEXT, allowed)
    return Part("how", "How it was computed", text, notes=(left_out,) if prior else ())


def _history(w: Watch) -> Part | None:
    """Section with the run charts over this test and earlier ones; None without one."""
    every = continued(w.earlier, w.run)
    runs = [one for one in every if one.calibration == w.run.calibration]
    if len(runs) < 2:
        return None
    others = len(every) - len(runs)
    note = (
        f"{count(others, 'earlier test')} against another calibration"
        f" {'is' if others == 1 else 'are'} not drawn."
    )
    rows = tuple(
        Row(
            f"{one.when:%Y-%m-%d %H:%M}",
            (one.session, str(one.configurations), brief(one.share), STAMPS[one.result]),
            mark="good" if one.result == "as_calibrated" else Level.DOUBTFUL,
        )
        for one in reversed(runs)
    )
    table = Table(
        "Tests against this calibration",
        ("Tested", "Session", "Configurations", "Largest statistic", "Result"),
        rows,
        brief=False,
        words=(1, 4),
        hints=("", "", "", "Largest statistic of all tests, in thresholds: 1 is a change.", ""),
    )
    return Part(
        "history",
        "Run chart",
        blocks=panels(_share_chart(runs), _zero_chart(runs)),
        tables=(table,),
        notes=(note,) if others else (),
    )


def _labels(runs: Sequence[Run]) -> list[str]:
    """Dates of tests; dates and times, or numbers, where a day has several."""
    days = [f"{one.when:%Y-%m-%d}" for one in runs]
    for names in (days, [f"{one.when:%m-%d %H:%M}" for one in runs]):
        if len({*names}) == len(names):
            return names
    return [f"{k + 1}" for k in range(len(runs))]


def _share_chart(runs: Sequence[Run]) -> Plot:
    """Run chart of the largest statistic, in thresholds."""
    labels, values = _labels(runs), [max(one.share, LEAST_DRAWN_SHARE) for one in runs]
    points = tuple(
        Point(
            x=label,
            y=rounded(value),
            tip=f"{one.when:%Y-%m-%d %H:%M}, {one.session}: {STAMPS[one.result].lower()},"
            f" {brief(one.share)} thresholds",
            colour=None if one.result == "as_calibrated" else "bad",
        )
        for label, value, one in zip(labels, values, runs, strict=True)
    )
    return Plot(
        name="history",
        title="Largest statistic of each test",
        caption="Above the threshold the machine changed, or is another one.",
        alt=f"Largest statistics of {count(len(runs), 'test')} in thresholds, by date",
        x=category_axis(labels, "tested"),
        y=log_axis("in thresholds", (*values, 1.0)),
        marks=(
            RuleMark(name="threshold", axis="y", at=1.0, colour="bad"),
            LineMark(name="", colour="quiet", points=line_points(labels, values)),
            DotsMark(name="tests", colour="good", points=points),
        ),
    )


def _zero_chart(runs: Sequence[Run]) -> Plot | None:
    """Run chart of the zeros of the legs' readings, in their limits; of another machine, whose
    zeros mean nothing, there are none.
    """
    labels = _labels(runs)
    legs = sorted({zero.legs for one in runs for zero in one.zeros})
    marks: list[Mark] = [
        RuleMark(name="limits", axis="y", at=at, colour="bad") for at in (-1.0, 1.0)
    ]
    marks[1] = marks[1].model_copy(update={"name": ""})
    drawn: list[float] = [-1.0, 1.0]
    for leg in legs:
        points: list[Point] = []
        for label, one in zip(labels, runs, strict=True):
            zero = next((each for each in one.zeros if each.legs == leg), None)
            if zero is None or one.result == "another_machine":
                continue
            name = named(j - 1 for j in leg)
            text = signed(zero.value, zero.sigma, zero.unit)
            limit = amount(zero.limit, zero.unit)
            points.append(
                Point(
                    x=label,
                    y=rounded(zero.value / zero.limit),
                    tip=f"{name}, {label}: {text}, limit {limit}",
                    key=leg_key(leg[0]),
                )
            )
        values = [float(point.y) for point in points]
        drawn += values
        line = line_points([str(point.x) for point in points], values)
        colour, key = leg_colour(leg[0]), leg_key(leg[0])
        marks += [
            LineMark(name="", colour=colour, points=line, key=key),
            DotsMark(name=named(j - 1 for j in leg), colour=colour, points=tuple(points), radius=3),
        ]
    if len(drawn) == 2:
        return None
    return Plot(
        name="history-zeros",
        title="The zero of each leg's reading, if nothing else changed",
        caption="In limits: beyond ±1 the leg's own test fails.",
        alt=f"Changes of the zeros in {count(len(runs), 'test')}, in their limits, by date",
        x=category_axis(labels, "tested"),
        y=linear_axis("in limits", drawn),
        marks=tuple(marks),
    )


def _cards(w: Watch) -> tuple[Figure, ...]:
    """Main numbers."""
    judged = w.judged
    named_tests = [(named(leg.legs), leg.chance) for leg in judged.legs]
    named_tests += [("all legs together", judged.machine.adjusted)]
    finite = [(name, chance) for name, chance in named_tests if np.isfinite(chance)]
    who, least = min(finite, key=lambda item: item[1], default=("nothing", 1.0))
    out = [
        Figure(
            "How likely by chance alone?",
            ((Chance(least), ""),),
            f"of {who}, the least of {count(len(judged.tests), 'test')},"
            f" their number allowed for; below {Chance(judged.alpha)} counts as a change",
        )
    ]
    sizes = [leg for leg in judged.legs if leg.zero and leg.zero.dof]
    if sizes:
        out.append(
            Figure(
                "What would have been found?",
                (least_size(sizes),),
                "of the zero of a leg's reading, depending on the leg, with"
                f" {percentage(DETECTION_POWER)} probability",
            )
        )
    out.append(
        Figure(
            "What is it based on?",
            ((str(int(w.observed.sum())), "configurations"),),
            "seen by the session, not used by the calibration",
        )
    )
    return tuple(out)


def legs_table(w: Watch) -> Table:
    """Table with a row for each leg: statistics, chance, change of its zero, detectable changes."""
    rows = [
        Row(
            named(leg.legs).capitalize(),
            (
                _statistic(leg.whole),
                _statistic(leg.zero),
                Chance(leg.chance),
                _zero(leg),
                amount(leg.detects_zero, leg.unit)
                if np.isfinite(leg.detects_zero)
                else NO_VALUE_SIGN,
                _span(leg.detects_base),
                _span(leg.detects_platform),
            ),
        )
        for leg in w.judged.legs
    ]
    return Table(
        "Legs",
        tuple(LEG_COLUMNS),
        tuple(rows),
        "A leg that changed moves the tests of the others, too.",
        first=6,
        hints=tuple(LEG_COLUMNS.values()),
    )


def _others_table(w: Watch) -> Table:
    """Table of the tests of all legs together."""
    j = w.judged
    scale = j.scale_change
    text = NO_VALUE_SIGN
    if j.scale.dof:
        text = (
            f"{number(scale.value[0] * 1e6, 0, signed=True)} µm/m"
            f" (±{number(scale.sigma[0] * 1e6, 0)})"
        )
    rows = (
        Row("Every number of all legs", (*_cells(j.machine), "")),
        Row("All lengths by one factor", (*_cells(j.scale), text)),
    )
    return Table(
        "All legs together",
        ("Test", "χ²", "Degrees", "By chance", "Change"),
        rows,
        "A common factor is seen against the readings: a frame that warmed, or readings of another"
        " scale.",
        brief=False,
        hints=(
            "",
            "Statistic of the test.",
            "Degrees of freedom of the statistic.",
            LEG_COLUMNS["By chance"],
            "Change and its standard deviation.",
        ),
    )


def _findings_table(w: Watch) -> Table | None:
    """Table of the explanations of a change, the best first.

    Explanations that these data do not separate from it follow each one.
    """
    if not w.judged.findings:
        return None
    station_names = names_of(w.session)
    rows = [
        Row(
            f"{mark} {cause_words(suspect, station_names)}",
            (number(suspect.chi2, 1), str(len(suspect.cause.sizes))),
        )
        for place, finding in enumerate(w.judged.findings, start=1)
        for mark, suspect in [
            (f"{place}.", finding.suspect),
            *(("or", other) for other in finding.others),
        ]
    ]
    return Table(
        "What explains it",
        ("Cause", "χ² explained", "numbers"),
        tuple(rows),
        "Causes are compared by how likely they make the data, changes of a tolerance's size being"
        " usual; those that odds of a thousand to one do not separate stand under the best with"
        " “or”.",
        brief=False,
    )


def _cells(test: Score) -> tuple[str, str, str]:
    """Statistic, degrees of freedom and probability of a test, as text."""
    cells = (
        (number(test.chi2, 1), Chance(test.adjusted))
        if test.dof
        else (NO_VALUE_SIGN, NO_VALUE_SIGN)
    )
    return cells[0], str(test.dof), cells[1]


def _statistic(test: Score | None) -> str:
    """Statistic and degrees of freedom of a test, as text."""
    return (
        f"{number(test.chi2, 1)} / {test.dof}" if test is not None and test.dof else NO_VALUE_SIGN
    )


def _zero(leg: LegTest) -> str:
    """Change of a reading's zero, as text."""
    if leg.change is None or leg.zero is None or not leg.zero.dof:
        return NO_VALUE_SIGN
    return signed(float(leg.change.value[0]), float(leg.change.sigma[0]), leg.unit)


def _span(sizes: tuple[float, float]) -> str:
    """Interval of sizes in mm, as text."""
    texts = [brief(v * 1e3) if np.isfinite(v) and v < 1 else NO_VALUE_SIGN for v in sizes]
    return NO_VALUE_SIGN if texts == [NO_VALUE_SIGN, NO_VALUE_SIGN] else " to ".join(texts)


def _statistics(w: Watch) -> Plot | None:
    """Chart of the larger statistic of each leg, relative to its threshold."""
    bars = [
        _leg_bar(named(leg.legs), leg.legs[0] + 1, tests, w.judged.level)
        for leg in w.judged.legs
        for tests in [[t for t in (leg.whole, leg.zero) if t and t.dof]]
        if leg.whole.dof
    ]
    return bar_plot(
        "statistics",
        "Each leg's χ² over its threshold",
        "",
        "the larger of both tests, in thresholds",
        bars,
        "Statistic of each leg as a share of its threshold",
        more=(RuleMark(name="threshold", axis="y", at=1.0),),
        high=1.0,
        series="χ²",
    )


def _leg_bar(label: str, leg: int, tests: list[Score], level: float) -> Point:
    """Bar of a leg's tests."""
    shares = [share(test, level) for test in tests]
    texts = [
        f"χ² {number(t.chi2, 1)} for {count(t.dof, 'degree')} of freedom, {brief(one)} thresholds"
        for t, one in zip(tests, shares, strict=True)
    ]
    return Point(
        x=label,
        y=rounded(max(shares)),
        tip=f"{label}: {'; '.join(texts)}",
        key=leg_key(leg),
        colour="quiet" if max(shares) < 1 else None,
    )


def _zeros(w: Watch) -> Plot | None:
    """Changes of the readings' zeros with the interval of nine tenths by chance."""
    legs = [leg for leg in w.judged.legs if leg.change is not None and leg.zero and leg.zero.dof]
    if not legs or len({leg.unit for leg in legs}) > 1:
        return None
    factor, name = DISPLAY_UNITS[legs[0].unit]
    points: list[Point] = []
    for leg in legs:
        if leg.change is None or not np.isfinite(leg.change.sigma[0]):
            continue
        value, sigma = float(leg.change.value[0]) * factor, float(leg.change.sigma[0]) * factor
        first = leg.legs[0] + 1
        points.append(
            Point(
                x=rounded(value),
                y=named(leg.legs),
                low=rounded(value - NORMAL_90 * sigma),
                high=rounded(value + NORMAL_90 * sigma),
                tip=f"{named(leg.legs)}: {_zero(leg)}",
                key=leg_key(first),
                colour=leg_colour(first),
            )
        )
    ends = [end for point in points for end in (point.low, point.high) if end is not None]
    return Plot(
        name="zeros",
        title="The zero of each leg's reading, if nothing else changed",
        caption="Lines: nine tenths by chance.",
        alt="Change of the zero of each leg's reading, with the interval of nine tenths",
        x=linear_axis(f"change, {name}", (*ends, 0.0)),
        y=category_axis(str(point.y) for point in points),
        marks=(
            RuleMark(name="", axis="x", at=0.0, colour="quiet"),
            DotsMark(name="", colour="quiet", points=tuple(points)),
        ),
    )


def _by_configuration(w: Watch) -> Plot | None:
    """Run chart: root mean square residual of each configuration with the machine fixed, in the
    order in which they were measured.
    """
    points: list[Point] = []
    for k in np.flatnonzero(w.observed).tolist():
        name, value = w.session.configurations[k], float(w.residuals[k])
        if np.isfinite(value):
            points.append(
                Point(
                    x=name,
                    y=rounded(value),
                    tip=f"{name}: {number(value, 2)} standard deviations",
                    key=configuration_key(name),
                    colour="quiet" if value < NOISE_EXCESS else None,
                )
            )
    if not points:
        return None
    names, values = [str(p.x) for p in points], [float(p.y) for p in points]
    return Plot(
        name="run",
        title="Residuals in the order of the configurations, the machine held as calibrated",
        caption="A lasting change of level means that something changed; single points mean that an"
        " image or its readings are wrong.",
        alt=f"Residuals of {count(len(points), 'configuration')}",
        x=category_axis(names, "configurations"),
        y=linear_axis("root mean square, standard deviations", (*values, NOISE_EXCESS), zero=True),
        marks=(
            RuleMark(name="expected of noise alone", axis="y", at=1.0),
            RuleMark(
                name=f"{NOISE_EXCESS:g} times as much",
                axis="y",
                at=NOISE_EXCESS,
                colour="calibrated",
            ),
            LineMark(name="", colour="quiet", points=line_points(names, values)),
            DotsMark(name="residuals", colour="calibrated", points=tuple(points)),
        ),
    )
