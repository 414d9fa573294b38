"""Report of a study: accuracy of each combination, coverage of the stated standard deviations, and
the varied name with the largest gain.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.levels import NEARLY_ALL
from pkmcal.outcome import Figure, Level, Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.blocks.plot import (
    Colour,
    DotsMark,
    LineMark,
    Mark,
    Plot,
    PlotAxis,
    Point,
    Tick,
    category_axis,
    leg_colour,
    line_points,
    linear_axis,
    log_axis,
    panels,
    rounded,
)
from pkmcal.outcome.finding import Finding, wrong
from pkmcal.studies.calibrations import JOINT_ESTIMATE_KEY
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.findings import (
    COVERAGE_INTERVALS,
    COVERAGE_TOLERANCE,
    LEAST_FREEDOM,
    PROMISED_COVERAGE,
    CellFindings,
    Gain,
    SweepResult,
    with_error,
)
from pkmcal.studies.statistics import Summary
from pkmcal.studies.sweep import SweptSetting
from pkmcal.wording import amount, brief, count, number

MOST_LINES = 8
"""Maximum number of curves in one plot; beyond it, one curve averages all combinations."""
MOST_TICKS = 8
"""Maximum number of values that are ticks of an axis; beyond it, the axis chooses its ticks."""
LEAST_NUMBERS = 3
"""Smallest number of values that are plotted on a numerical axis and joined by lines."""
LOG_AXIS_RATIO = 8.0
"""Ratio of the largest to the smallest value above which the axis is logarithmic."""
STUDY_METHOD_TEXT = (
    "Each run draws a machine from the nominal model's tolerances, measures it with the noise"
    " that is stated, and calibrates it as pkmcal calibrate does: from the nominal model,"
    " robust, with the scale of the noise and the tubes' shading found from the data. Some runs"
    " share a plan of stations and configurations, which is drawn anew for the next; standard"
    " errors take that into account. All combinations have the same machines, noise and choices"
    " of configurations, as far as what is varied leaves them.",
    "The tool's error is that of the platform's pose at readings spread over the workspace,"
    " between the calibrated and the true machine, frames laid over each other. What a camera"
    " sees is decided by the nominal model. Not simulated are wrong edges, other things in the"
    " picture, bending and errors of the lens: these reduce the accuracy by an"
    " amount that no simulation gives.",
)
PAPER_STUDY_METHOD_TEXT = (
    "Each run draws a hexapod, measures the axes of its legs with the noise of [A] Table 1, and"
    " calibrates it by the joint estimate from the corrected four steps, without the nominal"
    " model as knowledge. The tool's error is that of the platform's pose at ten random"
    " readings, in frames by three joint centres.",
)


def outcome_of(study: SweepResult) -> Outcome:
    """Outcome of ``pkmcal study``."""
    gains, bad = study.gains, [c for c in study.found if c.honest is False]
    failing = [cell for cell in study.found if cell.failed.value > 1 - NEARLY_ALL]
    paper = not hasattr(study.subject.design, "observe")
    runs = count(study.runs, "simulated calibration")
    cells = "" if len(study.found) == 1 else f" of each of {len(study.found)} combinations"
    seconds = f"{study.wall:.1f} s on {count(study.workers, 'worker')}"
    return Outcome(
        command="study",
        title=f"Accuracy of {study.subject.name}",
        kicker="study",
        subject=f"{study.subject.name}: {runs}{cells}, seed {study.seed}.",
        verdict=Verdict(
            usable=not bad and not failing,
            headline=_headline(study, gains, bad),
            findings=(
                *(_coverage_finding(study, cell) for cell in bad),
                *(_failure_finding(study, cell) for cell in failing),
            ),
        ),
        stamp="Deviations hold" if not bad and not failing else "Look closer",
        figures=_key_figures(study),
        parts=(
            Part("accuracy", "Accuracy", blocks=panels(*_curves(study)), tables=(_table(study),)),
            _coverage_part(study),
            Part(
                "how",
                "How it was found",
                text=PAPER_STUDY_METHOD_TEXT if paper else STUDY_METHOD_TEXT,
            ),
        ),
        findings=study.subject.findings,
        closing=f"{count(study.runs * len(study.found), 'run')} in {seconds}.",
        document=study_document(study),
        texts={"study.csv": runs_csv(study)},
    )


# ------------------------------------------------------------------ in words


def _headline(study: SweepResult, gains: list[Gain], bad: list[CellFindings]) -> str:
    """Verdict in one sentence or two."""
    covered = [c.covered.value for c in study.found] + [c.covered_tool.value for c in study.found]
    if any(cell.honest is None for cell in study.found):
        where = " of some combinations" if len(study.found) > 1 else ""
        return f"Too few calibrations{where} can be used to estimate their accuracy."
    low, high = 100 * min(covered), 100 * max(covered)
    share = f"{low:.1f} %" if round(high - low, 1) == 0 else f"{low:.1f} to {high:.1f} %"
    if bad:
        several = f" in {len(bad)} of {len(study.found)} combinations"
        which = several if len(study.found) > 1 else ""
        text = f"The stated deviations are too small{which}: {share} of the 95 % intervals hold."
    else:
        text = f"The stated deviations hold: {share} of the 95 % intervals do."
    if len(study.found) == 1:
        cell = study.found[0]
        error = amount(cell.position.value, "m")
        if _rotates(study):
            error += f" and {amount(cell.orientation.value, 'rad')}"
        return f"Calibrations leave {error} at the tool. {text}"
    errors = [c.position.value for c in study.found if np.isfinite(c.position.value)]
    smallest, largest = brief(1e3 * min(errors)), amount(max(errors), "m")
    accuracy = f"Calibrations leave {smallest} to {largest} at the tool"
    sure = [gain for gain in gains if gain.sure]
    if not sure:
        few = f"{study.runs} runs are too few to show an effect of what was varied"
        return f"{accuracy}; {few}. {text}"
    gain = sure[0]
    return (
        f"{accuracy}; most is gained by {_name(gain.name)}: from"
        f" {study.subject.value_text(gain.name, gain.worst)} to"
        f" {study.subject.value_text(gain.name, gain.best)} it falls from"
        f" {amount(gain.before, 'm')} to {amount(gain.after, 'm')}"
        f" ({brief(gain.times)} times). {text}"
    )


def _coverage_finding(study: SweepResult, cell: CellFindings) -> Finding:
    where = study.subject.in_words(cell.values)
    return wrong(
        "study.coverage",
        where,
        of=where or None,
        percent=100 * cell.covered.value,
        tool_percent=100 * cell.covered_tool.value,
        least=100 * (PROMISED_COVERAGE - COVERAGE_TOLERANCE),
    )


def _failure_finding(study: SweepResult, cell: CellFindings) -> Finding:
    where = study.subject.in_words(cell.values)
    return wrong("study.fails", where, of=where or None, percent=100 * cell.failed.value)


def _name(name: str) -> str:
    return name.replace("_", " ")


# ------------------------------------------------------------------ cards and tables


def _rotates(study: SweepResult) -> bool:
    """Whether the platform rotates at all; that of a delta robot does not."""
    return not all(cell.orientation.value == 0 for cell in study.found)


def _key_figures(study: SweepResult) -> tuple[Figure, ...]:
    """Key figures of the best combination."""
    best = min(study.found, key=lambda cell: np.nan_to_num(cell.position.value, nan=np.inf))
    which = (
        f"with {study.subject.in_words(best.values)}"
        if len(study.found) > 1
        else "root mean square"
    )
    error = best.with_usable_error(best.position).error
    errors = (
        (brief(1e3 * best.position.value), "mm"),
        (brief(np.rad2deg(best.orientation.value)), "°"),
    )
    percentiles = (
        (brief(1e3 * best.position_95), "mm"),
        (brief(np.rad2deg(best.orientation_95)), "°"),
    )
    columns = slice(None) if _rotates(study) else slice(1)
    return (
        Figure(
            "How far off is the tool after a calibration?",
            errors[columns],
            f"{which}; ± {brief(1e3 * error)} mm by chance" if np.isfinite(error) else which,
        ),
        Figure(
            "What stays below in 95 % of the workspace?",
            percentiles[columns],
            "over all runs and poses",
        ),
        Figure(
            "Do its 95 % intervals hold?",
            ((number(100 * best.covered.value, 1), "%"),),
            f"of all parameters; {number(100 * best.covered_tool.value, 1)} % of the tool's poses",
            limit=f"{100 * (PROMISED_COVERAGE - COVERAGE_TOLERANCE):.0f} % is the least, apart from"
            " chance",
            mark=None if best.honest is None else "good" if best.honest else Level.WRONG,
        ),
        Figure(
            "Does it always converge?",
            ((number(100 * best.failed.value, 1), "% fail"),),
            f"of {best.runs} runs",
            limit=f"limit {100 * (1 - NEARLY_ALL):.0f} %",
            mark="good" if best.failed.value <= 1 - NEARLY_ALL else Level.WRONG,
        ),
    )


def _table(study: SweepResult) -> Table:
    """Table with one row for each combination."""
    rows, turns = list[Row](), _rotates(study)
    for cell in study.found:
        turn = (
            with_error(cell.with_usable_error(cell.orientation).times(np.rad2deg(1.0))),
            brief(np.rad2deg(cell.orientation_sigma)),
            brief(np.rad2deg(cell.orientation_95)),
        )
        cells = (
            with_error(cell.with_usable_error(cell.position).times(1e3)),
            brief(1e3 * cell.position_sigma),
            number(100 * cell.covered.value, 1),
            number(100 * cell.covered_tool.value, 1),
            brief(1e3 * cell.position_95),
            *(turn if turns else ()),
            number(100 * cell.failed.value, 1),
        )
        mark = Level.DOUBTFUL if cell.honest is False else None
        rows.append(
            Row(study.subject.in_words(cell.values) or study.subject.name, cells, mark=mark)
        )
    error = (
        "Root mean square error of the tool after a calibration, with its standard error if it has"
        f" {LEAST_FREEDOM} degrees of freedom or more: those of the batches of runs."
    )
    stated = "Standard deviation that the calibrations state."
    largest = "Error that is not exceeded in 95 % of all runs and poses."
    heads = {
        "Setting": "",
        "Tool, mm": error,
        "Stated, mm": stated,
        "Held, %": "Share of the 95 % intervals of all parameters that hold the truth.",
        "Tool held, %": "Share of the 95 % intervals of the tool's pose that hold the truth.",
        "95 % below, mm": largest,
        **({"Tool, °": error, "Stated, °": stated, "95 % below, °": largest} if turns else {}),
        "Failed, %": "Share of the runs that did not converge or had to be refused.",
    }
    return Table(
        "Errors after a calibration", tuple(heads), tuple(rows), first=5,
        hints=tuple(heads.values()),
    )  # fmt: skip


def _coverage_part(study: SweepResult) -> Part:
    """Coverage of intervals of each nominal size, and for each kind of parameter."""
    kinds: dict[str, list[float]] = {}
    for cell in study.found:
        for name, share in zip(cell.parameters, cell.by_parameter.tolist(), strict=True):
            if np.isfinite(share):
                kinds.setdefault(_kind(name), []).append(share)
    rows = [
        Row(kind, (f"{100 * np.mean(own):.1f}", f"{100 * min(own):.1f}", f"{100 * max(own):.1f}"))
        for kind, own in kinds.items()
    ]
    table = Table(
        "95 % intervals of the parameters that hold, %",
        ("Parameter", "Mean", "Least", "Most"),
        tuple(rows),
        brief=False,
        note="Least and most: of single parameters and combinations; chance alone spreads them.",
    )
    text = (
        "Where an interval of 95 % holds the truth in 95 of 100 calibrations, its deviation may be"
        " believed. Above the line deviations are on the safe side, below it they promise too much."
    )
    return Part(
        "honesty",
        "Do the stated deviations hold?",
        (text,),
        blocks=panels(_coverage_plot(study)),
        tables=(table,),
    )


def _kind(name: str) -> str:
    """Kind of a parameter in words: its name without leg and coordinate."""
    if "]" not in name:  # [A]'s: A2 x, q5
        return {"A": "base centres", "B": "platform centres"}.get(name[:1], "offsets")
    rest = name.partition("].")[2]
    rest = rest.removesuffix(".x").removesuffix(".y").removesuffix(".z")
    if rest.startswith("tubes"):
        return "tube radius"
    return rest.replace("center", "centre").replace(".", " ")


# ------------------------------------------------------------------ plots


def _groups(study: SweepResult, name: str) -> Iterator[tuple[str, list[CellFindings]]]:
    """Combinations along a name, for each combination of the other values."""
    others: dict[tuple[Any, ...], list[CellFindings]] = {}
    for cell in study.found:
        rest = {key: value for key, value in cell.values.items() if key != name}
        others.setdefault(tuple(rest.items()), []).append(cell)
    for rest, cells in others.items():
        several = {k: v for k, v in rest if len(study.varied[k]) > 1}
        yield study.subject.in_words(several), cells


def _curves(study: SweepResult) -> list[Plot]:
    """Plots of the tool's error and its stated standard deviation along the varied names.

    Names with the most values come first; a name whose combinations are part of an earlier plot has
    no plot of its own.
    """
    out: list[Plot] = []
    several = [name for name, values in study.varied.items() if len(values) > 1]
    for name in sorted(several, key=lambda name: -len(study.varied[name])):
        groups = list(_groups(study, name))
        out.append(_curve(study, name, groups))
        if len(groups) <= MOST_LINES:  # every combination is in this plot
            break
    return out


def _curve(study: SweepResult, name: str, groups: list[tuple[str, list[CellFindings]]]) -> Plot:
    """Plot of the tool's error along one name: one series for each combination of the others, or,
    where there are too many, one of the means.
    """
    values, (factor, unit) = study.varied[name], study.subject.display_unit(name)
    display_values = [value if isinstance(value, str) else factor * value for value in values]
    x = _value_axis(_name(name) + (f", {unit}" if unit else ""), display_values)
    marks: list[Mark] = []
    if len(groups) > MOST_LINES:
        means = [study.at(name, value) for value in values]
        marks += _series(study, name, x, display_values, "all else together", "calibrated", means)
    else:
        for k, (of, cells) in enumerate(groups):
            colour, stated = leg_colour(k + 1), [cell.position_sigma for cell in cells]
            errors = [cell.with_usable_error(cell.position) for cell in cells]
            marks += _series(study, name, x, display_values, of, colour, errors, stated)
    points = [p for mark in marks if isinstance(mark, DotsMark) for p in mark.points]
    ends = [v for p in points for v in (p.y, p.high) if isinstance(v, float)]
    return Plot(
        name=f"by-{name.replace('_', '-')}",
        title=f"By {_name(name)}",
        caption="Lines through dots: two standard errors of the simulation; crosses: what"
        " calibrations state.",
        alt=f"The tool's position error by {_name(name)}, with what calibrations state of it; the"
        " table has the numbers.",
        x=x,
        y=linear_axis("tool's position, mm", ends, zero=True),
        marks=tuple(marks),
    )


def _series(
    study: SweepResult,
    name: str,
    x: PlotAxis,
    display_values: Sequence[float | str],
    of: str,
    colour: Colour,
    errors: list[Summary],
    stated: list[float] | None = None,
) -> Iterator[Mark]:
    """Dots of the errors at each value of a name, and crosses of the stated standard deviations.

    display_values : the values in the unit of the axis.
    of : combination of the other values, in words; empty without any.
    """
    dots, crosses = list[Point](), list[Point]()
    for k, (value, error) in enumerate(zip(study.varied[name], errors, strict=True)):
        at = _category(display_values[k]) if x.scale == "categories" else display_values[k]
        where = study.subject.value_text(name, value) + (f", {of}" if of else "")
        if np.isfinite(error.value):
            reach = 2 * error.error if np.isfinite(error.error) else 0.0
            dots.append(
                Point(
                    x=at,
                    y=rounded(1e3 * error.value),
                    low=rounded(1e3 * (error.value - reach)),
                    high=rounded(1e3 * (error.value + reach)),
                    tip=f"{where}: {with_error(error.times(1e3))} mm",
                )
            )
        if stated and np.isfinite(stated[k]):
            sigma = 1e3 * stated[k]
            tip = f"{where}: stated {brief(sigma)} mm"
            crosses.append(Point(x=at, y=rounded(sigma), tip=tip))
    if x.scale != "categories":  # between two values, or names, nothing is known
        line = line_points((p.x for p in dots), (float(p.y) for p in dots))
        yield LineMark(name="", colour=colour, points=line)
    yield DotsMark(name=of or "error", colour=colour, points=tuple(dots))
    if crosses:
        label = f"stated, {of}" if of else "stated"
        yield DotsMark(name=label, colour=colour, points=tuple(crosses), symbol="cross")


def _category(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _value_axis(label: str, values: Sequence[float | str]) -> PlotAxis:
    """Axis of a name's values: of numbers, logarithmic if they span much, with the values as ticks
    where these are three to ``MOST_TICKS``; two values, and names, are categories.
    """
    numbers = [v for v in values if not isinstance(v, str)]
    if len(numbers) < len(values) or len(numbers) < LEAST_NUMBERS:
        return category_axis(map(_category, values), label)
    wide = min(numbers) > 0 and max(numbers) / min(numbers) >= LOG_AXIS_RATIO
    axis = (log_axis if wide else linear_axis)(label, numbers)
    if len(numbers) <= MOST_TICKS:
        ticks = tuple(Tick(at=v, label=f"{v:g}") for v in sorted(numbers))
        axis = axis.model_copy(update={"ticks": ticks})
    return axis


def _coverage_plot(study: SweepResult) -> Plot:
    """Plot of actual against nominal coverage, all combinations together."""
    x = (100 * COVERAGE_INTERVALS).tolist()
    used = [cell for cell in study.found if np.isfinite(cell.held).all()]
    marks: list[Mark] = [
        LineMark(
            name="as promised", colour="quiet", points=((x[0], x[0]), (x[-1], x[-1])), dashed=True
        )
    ]
    ends = [*x]
    series: tuple[tuple[str, Colour, list[Array]], ...] = (
        ("parameters", "calibrated", [cell.held for cell in used]),
        ("tool's pose", "nominal", [cell.held_tool for cell in used]),
    )
    for name, colour, shares in series:
        if not shares:
            continue
        held = (100 * np.mean(shares, axis=0)).tolist()
        ends += held
        points = tuple(
            Point(
                x=rounded(of),
                y=rounded(share),
                tip=f"{name}: {number(share, 1)} % of the intervals of {of:g} % hold",
            )
            for of, share in zip(x, held, strict=True)
            if np.isfinite(share)
        )
        line = line_points((p.x for p in points), (float(p.y) for p in points))
        marks.append(LineMark(name="", colour=colour, points=line))
        marks.append(DotsMark(name=name, colour=colour, points=points))
    return Plot(
        name="held",
        title="Intervals that hold",
        caption="All combinations together.",
        alt="Share of intervals that hold the truth against the share that they promise.",
        x=linear_axis("interval, %", x),
        y=linear_axis("hold the truth, %", ends),
        marks=tuple(marks),
    )


# ------------------------------------------------------------------ for programs


def study_document(study: SweepResult) -> dict[str, Any]:
    """Document of the study for programs, in m and rad.

    Durations are left out, so that the same study gives the same file.
    """
    return {
        "pkmcal_study": 1,
        "subject": study.subject.name,
        "vary": {name: list(values) for name, values in study.varied.items()},
        "runs": study.runs,
        "seed": study.seed,
        "combinations": [_cell(cell) for cell in study.found],
        "gains": [
            {
                "name": g.name, "from": g.worst, "to": g.best,
                "position_before": g.before, "position_after": g.after, "beyond_chance": g.sure,
            }
            for g in study.gains
        ],
        "warnings": [one.text for one in study.subject.findings],
    }  # fmt: skip


def _cell(cell: CellFindings) -> dict[str, Any]:
    summaries = ("position", "orientation", "covered", "covered_tool", "failed")
    out: dict[str, Any] = {"values": dict(cell.values), "runs": cell.runs}
    for name in summaries:
        summary = getattr(cell, name)
        out[name] = {"value": summary.value, "standard_error": summary.error}
    for name in ("position_95", "orientation_95", "position_sigma", "orientation_sigma", "chi2"):
        out[name] = getattr(cell, name)
    out["intervals"] = {
        "promised": COVERAGE_INTERVALS, "parameters": cell.held, "tool": cell.held_tool,
    }  # fmt: skip
    out["covered_by_parameter"] = dict(
        zip(cell.parameters, cell.by_parameter.tolist(), strict=True)
    )
    return out | {"deviations_hold": cell.honest}


RUN_TABLE_COLUMNS = (
    "position", "orientation", "position_sigma", "orientation_sigma", "worst_parameter",
    "worst_parameter_error", "worst_parameter_sigma", "covered", "covered_tool", "chi2", "scale",
    "steps", "failed",
)  # fmt: skip
"""Columns of the table of runs, after the varied names and the run's number; m, rad, and shares."""


def runs_table(study: SweepResult) -> dict[str, list[Any]]:
    """Table by column with one row for each run: the varied names, ``run``, then
    RUN_TABLE_COLUMNS.
    """
    out: dict[str, list[Any]] = {name: [] for name in (*study.varied, "run", *RUN_TABLE_COLUMNS)}
    for cell, result in zip(study.cells, study.results, strict=True):
        own = _runs_of(result, [name for name, _ in cell.setting.parameters])
        for name in study.varied:
            out[name] += [cell.values[name]] * study.runs
        out["run"] += list(range(study.runs))
        for name in RUN_TABLE_COLUMNS:
            out[name] += own[name]
    return out


def _runs_of(result: StudyResult[SweptSetting], names: list[str]) -> dict[str, list[Any]]:
    """Columns of one combination.

    The worst parameter is that with the largest error relative to its stated standard deviation.
    """
    sample = result.samples[JOINT_ESTIMATE_KEY]
    values: Mapping[str, Array] = sample.values
    errors, sigma = values["parameters"], sample.sigma["parameters"]
    worst = np.argmax(np.nan_to_num(np.abs(errors) / sigma), axis=1)
    row = np.arange(len(worst))
    out: dict[str, list[Any]] = {
        name: values[name].tolist() for name in RUN_TABLE_COLUMNS if name in values
    }
    out["worst_parameter"] = [names[k] for k in worst]
    out["worst_parameter_error"] = errors[row, worst].tolist()
    out["worst_parameter_sigma"] = sigma[row, worst].tolist()
    return out


def runs_csv(study: SweepResult) -> str:
    """The table of runs as CSV."""
    table = runs_table(study)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return stream.getvalue()
