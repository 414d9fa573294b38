"""Report of a study: accuracy of each combination, coverage of the stated standard deviations, and
the varied name with the largest gain.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.outcome import Figure, Level, Outcome, Part, Plot, Row, Table, Verdict
from pkmcal.outcome.finding import Finding, wrong
from pkmcal.pages.plots import plane, trace
from pkmcal.studies.calibrations import JOINT_ESTIMATE_KEY
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.findings import (
    COVERAGE_INTERVALS,
    COVERAGE_TOLERANCE,
    PROMISED_COVERAGE,
    CellFindings,
    Gain,
    SweepResult,
)
from pkmcal.studies.sweep import SweptSetting, Value, in_words
from pkmcal.wording import amount, brief, count, decimals, number

MOST_LINES = 8
"""Maximum number of curves in one plot; beyond it, one curve averages all combinations."""
MOST_TICKS = 8
"""Maximum number of values that are ticks of an axis; beyond it, the axis chooses its ticks."""
MANY_FAILED = 0.1
"""Share of failed runs from which a combination is reported."""
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
    " picture, bending, play and errors of the lens: these cost accuracy, and no simulation"
    " knows how much.",
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
    failing = [cell for cell in study.found if cell.failed.value > MANY_FAILED]
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
            findings=(*map(_coverage_finding, bad), *map(_failure_finding, failing)),
        ),
        stamp="Deviations hold" if not bad and not failing else "Look closer",
        figures=_key_figures(study),
        parts=(
            Part("accuracy", "Accuracy", tables=(_table(study),), plots=_curves(study)),
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
        return f"Too few calibrations{where} can be used to tell how good they are."
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
    sure = [gain for gain in gains if gain.sure]
    if not sure:
        return f"{text} Nothing of what was varied shows beyond chance in so many runs."
    gain = sure[0]
    return (
        f"{text} Most is gained by {_name(gain.name)}: from"
        f" {value_with_unit(study, gain.name, gain.worst)} to"
        f" {value_with_unit(study, gain.name, gain.best)} the tool's"
        f" error falls from {amount(gain.before, 'm')} to {amount(gain.after, 'm')}"
        f" ({brief(gain.times)} times)."
    )


def _coverage_finding(cell: CellFindings) -> Finding:
    where = in_words(cell.values) if cell.values else ""
    return wrong(
        "study.coverage",
        where,
        of=where or None,
        percent=100 * cell.covered.value,
        tool_percent=100 * cell.covered_tool.value,
        least=100 * (PROMISED_COVERAGE - COVERAGE_TOLERANCE),
    )


def _failure_finding(cell: CellFindings) -> Finding:
    where = in_words(cell.values) if cell.values else ""
    return wrong("study.fails", where, of=where or None, percent=100 * cell.failed.value)


def _name(name: str) -> str:
    return name.replace("_", " ")


def value_with_unit(study: SweepResult, name: str, value: Value) -> str:
    """A value with its unit."""
    unit = study.subject.names[name].unit
    text = value if isinstance(value, str) else f"{value:g}"
    return f"{text}{unit}" if unit == "°" else f"{text} {unit}".rstrip()


# ------------------------------------------------------------------ cards and tables


def _rotates(study: SweepResult) -> bool:
    """Whether the platform rotates at all; that of a delta robot does not."""
    return not all(cell.orientation.value == 0 for cell in study.found)


def _key_figures(study: SweepResult) -> tuple[Figure, ...]:
    """Key figures of the best combination."""
    best = min(study.found, key=lambda cell: np.nan_to_num(cell.position.value, nan=np.inf))
    which = f"with {in_words(best.values)}" if len(study.found) > 1 else "root mean square"
    errors = (
        (brief(1e3 * best.position.value), "mm"),
        (brief(1e3 * best.orientation.value), "mrad"),
    )
    percentiles = (
        (brief(1e3 * best.position_95), "mm"),
        (brief(1e3 * best.orientation_95), "mrad"),
    )
    columns = slice(None) if _rotates(study) else slice(1)
    return (
        Figure(
            "How far off is the tool after a calibration?",
            errors[columns],
            f"{which}; ± {brief(1e3 * best.position.error)} mm by chance",
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
        ),
        Figure(
            "Does it always converge?",
            ((number(100 * best.failed.value, 1), "% fail"),),
            f"of {best.runs} runs",
        ),
    )


def _table(study: SweepResult) -> Table:
    """Table with one row for each combination."""
    rows, turns = list[Row](), _rotates(study)
    for cell in study.found:
        turn = (
            _with_error(1e3 * cell.orientation.value, 1e3 * cell.orientation.error),
            brief(1e3 * cell.orientation_sigma),
            brief(1e3 * cell.orientation_95),
        )
        cells = (
            _with_error(1e3 * cell.position.value, 1e3 * cell.position.error),
            brief(1e3 * cell.position_sigma),
            number(100 * cell.covered.value, 1),
            number(100 * cell.covered_tool.value, 1),
            brief(1e3 * cell.position_95),
            *(turn if turns else ()),
            number(100 * cell.failed.value, 1),
        )
        mark = Level.DOUBTFUL if cell.honest is False else None
        rows.append(Row(in_words(cell.values) or study.subject.name, cells, mark=mark))
    heads = ("", "tool, mm", "stated", "held, %", "tool's, %", "95 % below, mm")
    heads += ("tool, mrad", "stated, mrad", "95 % below, mrad") if turns else ()
    heads += ("failed, %",)
    legend = (
        "stated: standard deviation that the calibrations state; held: share of 95 % intervals that"
        " hold the truth, of all parameters and of the tool's pose"
    )
    return Table("Errors after a calibration", heads, tuple(rows), first=5, legend=legend)


def _with_error(value: float, error: float) -> str:
    """A number with its standard error, with the decimals that show at least one digit of each."""
    if not np.isfinite(error):
        return brief(value)
    places = max(decimals(value), decimals(error) - 1 if error > 0 else 0)
    return f"{number(value, places)} ± {number(error, places)}"


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
        ("", "mean", "least", "most"),
        tuple(rows),
        brief=False,
        note="Least and most: of single parameters and combinations; chance alone spreads them.",
    )
    text = (
        "Where an interval of 95 % holds the truth in 95 of 100 calibrations, its deviation may be"
        " believed. Above the line deviations are on the safe side, below it they promise too much."
    )
    plots = (_coverage_plot(study),)
    return Part("honesty", "Do the stated deviations hold?", (text,), plots=plots, tables=(table,))


def _kind(name: str) -> str:
    """Kind of a parameter: its name without leg and coordinate."""
    if "]" not in name:  # [A]'s: A2 x, q5
        return {"A": "base centres", "B": "platform centres"}.get(name[:1], "offsets")
    rest = name.partition("].")[2]
    rest = rest.removesuffix(".x").removesuffix(".y").removesuffix(".z")
    return "tubes.radius" if rest.startswith("tubes") else rest


# ------------------------------------------------------------------ plots


def _groups(study: SweepResult, name: str) -> Iterator[tuple[str, list[CellFindings]]]:
    """Combinations along a name, for each combination of the other values."""
    others: dict[tuple[Any, ...], list[CellFindings]] = {}
    for cell in study.found:
        rest = {key: value for key, value in cell.values.items() if key != name}
        others.setdefault(tuple(rest.items()), []).append(cell)
    for rest, cells in others.items():
        yield in_words({k: v for k, v in rest if len(study.varied[k]) > 1}), cells


def _curves(study: SweepResult) -> tuple[Plot, ...]:
    """Plots of the tool's error and its stated standard deviation along each name."""
    out: list[Plot] = []
    for name, values in study.varied.items():
        if len(values) < 2:
            continue
        groups = list(_groups(study, name))
        x = [value if isinstance(value, str) else float(value) for value in values]
        data: list[dict[str, Any]] = []
        if len(groups) > MOST_LINES:
            # too many curves: one of the means
            means = [study.at(name, value) for value in values]
            bars = {"type": "data", "array": [2e3 * s.error for s in means]}
            y = [1e3 * s.value for s in means]
            data.append(trace("error, all else together", x, y, "--calibrated", error_y=bars))
        else:
            for k, (label, cells) in enumerate(groups):
                colour = f"--leg{k % 8 + 1}"
                bars = {"type": "data", "array": [2e3 * c.position.error for c in cells]}
                y = [1e3 * c.position.value for c in cells]
                data.append(trace(label or "error", x, y, colour, error_y=bars))
                stated = [1e3 * c.position_sigma for c in cells]
                dash = {"color": colour, "dash": "dot"}
                label_text = f"stated, {label}" if label else "stated"
                data.append(trace(label_text, x, stated, colour, "lines", line=dash))
        unit = study.subject.names[name].unit
        layout = plane(_name(name) + (f", {unit}" if unit else ""), "tool's position, mm")
        layout["yaxis"] |= {"rangemode": "tozero"}
        numbers = [v for v in x if not isinstance(v, str)]
        if numbers and min(numbers) > 0 and max(numbers) / min(numbers) >= 8:
            layout["xaxis"] |= {"type": "log"}
        if numbers and len(numbers) <= MOST_TICKS:
            layout["xaxis"] |= {"tickvals": numbers, "ticktext": [f"{v:g}" for v in numbers]}
        caption = "Bars are two standard errors of the simulation; dotted: what is stated."
        out.append(
            Plot(
                f"by-{name.replace('_', '-')}",
                f"By {_name(name)}",
                caption,
                f"The tool's position error by {_name(name)}, with what calibrations state of it.",
                {"data": data, "layout": layout},
                height=380,
            )
        )
    return tuple(out)


def _coverage_plot(study: SweepResult) -> Plot:
    """Plot of actual against nominal coverage, all combinations together."""
    x = 100 * COVERAGE_INTERVALS
    used = [cell for cell in study.found if np.isfinite(cell.held).all()]
    own, tool = (
        100 * np.mean(shares, axis=0) if used else np.full(len(COVERAGE_INTERVALS), np.nan)
        for shares in ([cell.held for cell in used], [cell.held_tool for cell in used])
    )
    line = {"color": "--quiet", "dash": "dash"}
    data = [
        trace("as promised", [50, 100], [50, 100], "--quiet", "lines", line=line),
        trace("parameters", x, own, "--calibrated"),
        trace("tool's pose", x, tool, "--drawing"),
    ]
    layout = plane("interval, %", "hold the truth, %")
    return Plot(
        "held",
        "Intervals that hold",
        "All combinations together.",
        "Share of intervals that hold the truth against the share that they promise.",
        {"data": data, "layout": layout},
        height=380,
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
