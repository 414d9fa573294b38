"""The page of a validation, and what a calibration's report says of held-out configurations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.outcome import Figure, Row, Table
from pkmcal.report import charts, page
from pkmcal.session.load import Session
from pkmcal.validate.figures import Figures, figures, promised, reading_units
from pkmcal.validate.holdouts import HoldOut, Judged
from pkmcal.validate.judged import Ratio, rms
from pkmcal.validate.paths import Straightness
from pkmcal.wording import SCALES, brief, count, decimals, number

if TYPE_CHECKING:
    from pkmcal.validation import LinePath, Validation

POSE_UNITS = ("m", "rad")


@dataclass(frozen=True)
class Joints:
    """Names and units (m or rad) of the readings."""

    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def unit(self) -> str | None:
        """The unit of all, None where they differ."""
        return self.units[0] if len(set(self.units)) == 1 else None


def joints_of(session: Session) -> Joints:
    """The readings of a session."""
    columns = session.document["joints"]["columns"]
    return Joints(tuple(columns), reading_units(session.machine))


def validation_html(v: Validation) -> str:
    """One HTML page that needs nothing else: no network, no other file."""
    return page.render(
        "validation.html.j2",
        v=v,
        verdict=v.verdict,
        cards=cards(v),
        tables=tables(v),
        regions=v.regions and regions_table(v.regions, joints_of(v.session)),
        paths=v.paths and paths_table(v.paths),
        by_configuration=v.judged and _by_configuration(v, v.judged),
        by_joint=v.judged and _by_joint(v.judged, joints_of(v.session)),
        left_out=[n for n, flag in zip(v.session.configurations, v.known, strict=True) if flag],
    )


def cards(v: Validation) -> tuple[Figure, ...]:
    """The main numbers."""
    judged = v.judged
    if judged is None:
        return ()
    new, old = figures(judged.calibrated, judged), figures(judged.drawing, judged)
    test, gain = judged.promise, judged.ratio
    unit = joints_of(v.session).unit
    against = (
        f"; {_text(rms(judged.after), unit)} against {_text(rms(judged.before), unit)}, weighed by"
        " how well the photographs see each direction"
        if unit
        else ""
    )
    return (
        Figure(
            "How many times better than the drawing?",
            ((times(gain), ""),),
            f"in predicting readings, 95 %: {_factor(gain.low)} to {_factor(gain.high)}{against}",
        ),
        Figure(
            "Where is the tool, by the readings?",
            (_pair(new.position, "m"), _pair(new.orientation, "rad")),
            "root mean square distance from where the photographs see it, their noise included; by"
            f" the drawing {_text(old.position, 'm')} and {_text(old.orientation, 'rad')}",
        ),
        Figure(
            "Is the promise kept?",
            ((number(test.factor, 2), "× the deviations"),),
            f"1 is expected; χ² {number(test.chi2, 0)} for {count(test.dof, 'degree')} of freedom",
        ),
        Figure(
            "What is it based on?",
            ((str(len(judged.rows)), "configurations"),),
            "seen by the session, not used by the calibration",
        ),
    )


def tables(v: Validation) -> tuple[Table, ...]:
    """Of new data: joints, then the tool."""
    if v.judged is None:
        return ()
    joints = joints_of(v.session)
    return joint_table(v.judged, joints), tool_table(v.judged)


def joint_table(judged: Judged, joints: Joints) -> Table:
    """Residuals of the readings, [C] Table 3."""
    old, new = figures(judged.drawing, judged), figures(judged.calibrated, judged)
    expected, test = promised(judged), judged.promise
    rows = [
        Row(
            f"{name}, {SCALES[unit][1]}",
            (
                *_mean_rms(old, k, unit),
                *_mean_rms(new, k, unit),
                _number(expected[k], unit),
                _signed(test.common[k], test.common_sigma[k], unit),
                _number(test.common_sigma[k], unit),
            ),
        )
        for k, (name, unit) in enumerate(zip(joints.names, joints.units, strict=True))
    ]
    return Table(
        "Readings: measured less predicted",
        (
            "Joint",
            "Drawing, mean",
            "rms",
            "Calibrated, mean",
            "rms",
            "promised",
            "in common",
            "σ",
        ),
        tuple(rows),
        "Predicted from poses that the photographs show, without their own readings; weighed by"
        " how well each was seen. Promised: what the calibration's deviations and the photographs'"
        " noise let one expect. In common: what all configurations are off alike.",
    )


def tool_table(judged: Judged) -> Table:
    """Errors of the tool point."""
    rows = [
        Row(name, (_number(f.position, "m"), _number(f.orientation, "rad")))
        for name, f in (
            ("Drawing", figures(judged.drawing, judged)),
            ("Calibrated", figures(judged.calibrated, judged)),
        )
    ]
    return Table(
        "Tool point: forward kinematics of the readings against the photographs",
        ("Machine", "Position, mm", "Orientation, °"),
        tuple(rows),
        "Root mean squares, frames laid over each other for the drawing. The photographs' own noise"
        " is in both.",
    )


def regions_table(items: tuple[HoldOut, ...], joints: Joints) -> Table:
    """Regions held out, one a row."""
    unit = joints.unit
    rows = [
        Row(
            item.region.name,
            (
                str(len(item.left_out.rows)),
                _text(rms(item.left_out.before), unit),
                _text(rms(item.left_out.after), unit),
                _text(rms(item.used.after), unit),
                times(item.left_out.ratio),
                number(item.left_out.promise.factor, 2),
            ),
        )
        for item in items
    ]
    return Table(
        "Regions of the workspace, each left out once and predicted by a calibration of the rest",
        (
            "Platform",
            "Left out",
            "Drawing",
            "Calibrated",
            "Where used",
            "Times better",
            "× promise",
        ),
        tuple(rows),
        "Residuals of the readings, root mean square, weighed by how well the photographs see each"
        " direction. A region far worse than the configurations in use is extrapolated badly.",
    )


def paths_table(paths: tuple[LinePath, ...]) -> Table:
    """Straight paths, [C] Table 4."""
    rows = [
        Row(
            path.name,
            (str(path.n), *(_straight(s) for s in (path.seen, path.drawing, path.calibrated))),
        )
        for path in paths
    ]
    return Table(
        "Straight paths: distance of the tool points from the line through them, rms (largest), mm",
        ("Path", "Points", "As seen", "By drawing", "By calibration"),
        tuple(rows),
        "As seen: where the photographs show the tool. By drawing and by calibration: forward"
        " kinematics of the readings, for a tool that was led along a ruler.",
    )


def holdout_views(item: HoldOut | None, session: Session) -> dict[str, Any] | None:
    """What a calibration's report says of held-out configurations; None without any."""
    if item is None:
        return None
    joints = joints_of(session)
    return {
        "sentence": holdout_sentence(item, joints),
        "table": holdout_table(item, joints),
    }


def holdout_sentence(item: HoldOut, joints: Joints) -> str:
    """Held-out configurations in one sentence."""
    out, used = item.left_out, item.used
    unit = joints.unit
    amounts = (
        f": {_text(rms(out.after), unit)} against {_text(rms(out.before), unit)}" if unit else ""
    )
    kept = "" if out.promise.kept else " That is more than the deviations promise."
    inside = f" In the configurations in use, {_text(rms(used.after), unit)}." if unit else ""
    return (
        f"On {count(len(out.rows), 'configuration')} held out, the calibrated machine predicts the"
        f" readings {times(out.ratio)} times better than the drawing{amounts}.{inside}{kept}"
    )


def holdout_table(item: HoldOut, joints: Joints) -> Table:
    """Residuals on held-out configurations beside those in use."""
    groups = (item.used, item.left_out)
    made = [figures(g.calibrated, g) for g in groups]
    drawn = figures(item.left_out.drawing, item.left_out)
    rows = [
        Row(
            f"{name}, {SCALES[unit][1]}",
            (
                *_mean_rms(made[0], k, unit),
                *_mean_rms(made[1], k, unit),
                _number(drawn.joint_rms[k], unit),
            ),
        )
        for k, (name, unit) in enumerate(zip(joints.names, joints.units, strict=True))
    ]
    for name, field, unit in (
        ("tool position, mm", "position", "m"),
        ("tool orientation, °", "orientation", "rad"),
    ):
        values = [getattr(f, field) for f in (*made, drawn)]
        cells = [_number(value, unit) for value in values]
        rows.append(Row(name, ("", cells[0], "", cells[1], cells[2])))
    return Table(
        "Residuals of configurations in use and held out",
        ("Joint", "In use, mean", "rms", "Held out, mean", "rms", "by the drawing, rms"),
        tuple(rows),
        "Readings measured less predicted from poses that the photographs show, weighed by how well"
        " each was seen; their noise is in all columns.",
    )


def times(gain: Ratio) -> str:
    """``14 (±3)``."""
    return f"{_factor(gain.value)} (±{_factor(gain.sigma)})"


def _factor(value: float) -> str:
    if not np.isfinite(value):
        return "–"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _straight(found: Straightness | None) -> str:
    if found is None:
        return "–"
    return f"{_number(found.rms, 'm')} ({_number(found.largest, 'm')})"


def _mean_rms(found: Figures, k: int, unit: str) -> tuple[str, str]:
    """A joint's mean with the digits of its root mean square, and that."""
    root = found.joint_rms[k]
    return _signed(found.joint_mean[k], root, unit), _number(root, unit)


def _signed(value: float, sigma: float, unit: str) -> str:
    """A number with the digits that ``sigma`` deserves."""
    factor = SCALES[unit][0]
    return number(value * factor, decimals(sigma * factor), signed=True)


def _number(value: float, unit: str) -> str:
    """A magnitude in the unit that people read, two significant digits."""
    return brief(value * SCALES[unit][0])


def _text(value: float, unit: str | None) -> str:
    if unit is None:
        return "–"
    name = SCALES[unit][1]
    return f"{brief(value * SCALES[unit][0])}{'' if name == '°' else ' '}{name}"


def _pair(value: float, unit: str) -> tuple[str, str]:
    return brief(value * SCALES[unit][0]), SCALES[unit][1]


def _by_configuration(v: Validation, judged: Judged) -> charts.BarChart | None:
    """Residuals of the readings by configuration: bars of the calibrated machine, a line of the
    drawing.
    """
    unit = joints_of(v.session).unit
    if unit is None:
        return None
    factor, name = SCALES[unit]
    bars = [
        charts.Bar(
            v.session.configurations[row],
            f"{v.session.configurations[row]}: {_text(new, unit)}; drawing {_text(old, unit)}",
            new * factor,
        )
        for row, new, old in zip(
            judged.rows, judged.after.tolist(), judged.before.tolist(), strict=True
        )
    ]
    last = len(bars) - 1
    labels = tuple((k + 0.5, bars[k].label) for k in sorted({0, last // 2, last}))
    line = tuple((k + 0.5, old * factor) for k, old in enumerate(judged.before.tolist()))
    return charts.bar_chart(
        "Residuals of the readings by configuration",
        name,
        bars,
        labels,
        f"Residuals of {count(len(bars), 'configuration')}, calibrated and by the drawing",
        line,
    )


def _by_joint(judged: Judged, joints: Joints) -> charts.RowChart | None:
    """The calibrated machine's residuals in the standard deviations that are promised."""
    values = judged.calibrated.residuals / judged.promise.expected
    boxes = [charts.box(name, values[:, k], "σ", 1, k + 1) for k, name in enumerate(joints.names)]
    return charts.row_chart(
        "Residuals by joint",
        "promised standard deviations",
        [box for box in boxes if box],
        charts.NORMAL_90,
        "Residuals of the readings by joint, in the standard deviations that are promised",
    )
