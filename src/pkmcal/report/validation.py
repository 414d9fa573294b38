"""Validation as an outcome, and the report section on held-out configurations."""

from __future__ import annotations

import numpy as np

from pkmcal.judge.comparison import NominalComparison, WeighedErrors, finite_rms
from pkmcal.judge.holdouts import HoldOut
from pkmcal.judge.paths import LinePath, Straightness
from pkmcal.judge.sentences import against, better, factor
from pkmcal.judge.validate import Validation
from pkmcal.outcome import Figure, Level, Outcome, Part, Row, Table
from pkmcal.outcome.blocks.base import configuration_key, leg_key
from pkmcal.outcome.blocks.images import Images
from pkmcal.outcome.blocks.plot import (
    Box,
    DotsMark,
    Plot,
    Point,
    leg_colour,
    panels,
    rounded,
)
from pkmcal.outcome.blocks.space import Space
from pkmcal.outcome.blocks.text import Hint, Paragraph
from pkmcal.report.charts import NORMAL_90, bar_plot, box, row_plot
from pkmcal.report.pictures import images_of_configurations
from pkmcal.report.scene import station_cameras
from pkmcal.report.space import space_points, space_poses
from pkmcal.session.load import Session
from pkmcal.session.readings import same_pose
from pkmcal.web.motion import Postures
from pkmcal.web.stage import leg_rows, machine_shape
from pkmcal.wording import DISPLAY_UNITS, amount, brief, count, decimals, listed, number

RESIDUAL_COLUMNS = {
    "Joint": "",
    "Mean before": "Mean residual by the nominal model.",
    "rms before": "Root mean square of the residuals by the nominal model.",
    "Mean after": "Mean residual by the calibrated machine.",
    "rms after": "Root mean square of the residuals by the calibrated machine.",
    "Promised": "Root mean square that the calibration's standard deviations and the images'"
    " noise let one expect.",
    "Common": "By how much all configurations are off alike.",
    "Common σ": "Standard deviation of that.",
}
"""Columns of the table of readings, with their explanations."""
SMALLEST_POINT = 0.3
"""Size of the smallest point of a configuration, relative to that with the largest residuals."""
FIRST_IMAGES = 6
"""Images on the page before all are asked for."""
VALIDATION_METHOD_TEXT = (
    "The machine is held as the calibration left it. Stations, boards and every pose of the"
    " platform are estimated from the images; a configuration's own readings have no part in its"
    " pose, and where images leave open where a camera or a board is, the readings of the other"
    " configurations decide. The readings are then predictions. The nominal model is judged in"
    " the same way, frames laid over each other, on the poses that suit it best.",
    "The uncertainty of “times better” is from drawing the configurations again at random"
    " (bootstrap). Directions count by how well the images see them: one image"
    " determines depth poorly, and there any two machines look the same.",
    "The promise holds the calibration's covariance and the noise of these images and"
    " readings. It is broken where chance explains the residuals less than once in a thousand times"
    " even if all deviations were half as large again.",
)


def outcome_of(v: Validation) -> Outcome:
    """Outcome of ``pkmcal validate``."""
    prior = [n for n, flag in zip(v.session.configurations, v.calibrated, strict=True) if flag]
    again = [n for n, flag in zip(v.session.configurations, v.repeated, strict=True) if flag]
    sentences = (
        ("Left out, for the calibration had seen them", prior),
        ("At poses that the calibration used, taken anew", again),
    )
    notes = tuple(f"{what}: {', '.join(names)}." for what, names in sentences if names)
    parts = (
        _readings(v.judged, v.session) if v.judged else None,
        _configurations(v.judged, v) if v.judged else None,
        _images(v.judged, v) if v.judged else None,
        Part("paths", "Paths", tables=(paths_table(v.paths),)) if v.paths else None,
        Part("regions", "Regions", tables=(regions_table(v.regions, v.session),))
        if v.regions
        else None,
        Part("how", "How it was computed", VALIDATION_METHOD_TEXT, notes=notes),
    )
    return Outcome(
        command="validate",
        title=f"Validation of {v.calibration.machine.name}",
        kicker=v.session.called,
        verdict=v.verdict,
        stamp="Confirmed" if v.verdict.usable else "Not confirmed",
        figures=_cards(v.judged, v) if v.judged else (),
        parts=tuple(part for part in parts if part),
        findings=v.session.findings,
        document=v.as_dict(),
    )


def _cards(judged: NominalComparison, v: Validation) -> tuple[Figure, ...]:
    """Main numbers."""
    session, again = v.session, int(v.repeated[judged.rows].sum())
    calibrated, nominal = judged.figures(judged.calibrated), judged.figures(judged.nominal)
    test, gain, unit = judged.promise, judged.ratio, _unit(session)
    weighed = ""
    if unit:
        weighed = (
            f"; {against(judged.after, judged.before, unit)}, weighed by how well the images"
            " see each direction"
        )
    return (
        Figure(
            "How many times better than the nominal model?",
            ((better(gain), ""),),
            f"in predicting readings, 95 %: {factor(gain.low)} to {factor(gain.high)}{weighed}",
        ),
        Figure(
            "Where is the tool, by the readings?",
            tuple(
                (_magnitude(value, unit), DISPLAY_UNITS[unit][1])
                for value, unit in ((calibrated.position, "m"), (calibrated.orientation, "rad"))
            ),
            "root mean square distance from where the images see it, their noise included; by"
            f" the nominal model {amount(nominal.position, 'm')} and"
            f" {amount(nominal.orientation, 'rad')}",
        ),
        Figure(
            "Is the promise kept?",
            ((number(test.factor, 2), "× the deviations"),),
            f"1 is expected; χ² {number(test.chi2, 0)} for {count(test.dof, 'degree')} of freedom",
            limit="within chance" if test.holds else "more than chance explains",
            mark="good" if test.holds else Level.DOUBTFUL,
        ),
        Figure(
            "What is it based on?",
            ((str(len(judged.rows)), "configurations"),),
            "seen by the session, not used by the calibration"
            + (f"; {again} of them at poses that it used" if again else ""),
        ),
    )


def _readings(judged: NominalComparison, session: Session) -> Part:
    """Section on readings and tool: charts, residuals as in [C] Table 3, and tool point errors."""
    nominal, calibrated = judged.figures(judged.nominal), judged.figures(judged.calibrated)
    test = judged.promise
    residuals = Table(
        "Readings: measured less predicted",
        tuple(RESIDUAL_COLUMNS),
        tuple(
            Row(
                name,
                (
                    *_mean_rms(nominal, k, unit),
                    *_mean_rms(calibrated, k, unit),
                    _magnitude(test.joint_rms[k], unit),
                    _signed(test.common[k], test.common_sigma[k], unit),
                    _magnitude(test.common_sigma[k], unit),
                ),
            )
            for k, (name, unit) in enumerate(_joints(session))
        ),
        "Predicted from poses that the images show, without their own readings; weighed by"
        " how well each was seen.",
        hints=tuple(RESIDUAL_COLUMNS.values()),
        first=6,
    )
    tool = Table(
        "Tool point: forward kinematics of the readings against the images",
        ("Machine", "Position, mm", "Orientation, °"),
        tuple(
            Row(name, (_magnitude(f.position, "m"), _magnitude(f.orientation, "rad")))
            for name, f in (("Nominal model", nominal), ("Calibrated", calibrated))
        ),
        "Root mean squares, frames laid over each other for the nominal model. The images' own"
        " noise is in both.",
    )
    return Part(
        "readings",
        "Readings and tool",
        _worst(judged, session),
        blocks=panels(_by_configuration(judged, session), _by_joint(judged, session)),
        tables=(residuals, tool),
    )


def _images(judged: NominalComparison, v: Validation) -> Part | None:
    """Section with the images of the judged configurations, the worst first; None without any."""
    unit, size = _unit(v.session), np.nan_to_num(judged.after, nan=-np.inf)
    captions = {
        int(judged.rows[k]): f"readings {amount(float(judged.after[k]), unit)} off"
        if unit and np.isfinite(judged.after[k])
        else "configuration not judged"
        for k in np.argsort(-size, kind="stable").tolist()
    }
    images = images_of_configurations(v.remeasured, captions)
    if not images:
        return None
    n = len(judged.rows)
    text = (
        f"Of the {count(n, 'judged configuration')}, the one with the largest residuals first."
        " Lines: measured edges in their leg's colour, dashed where they were rejected."
    )
    hint = "A click on a bar, a row or a point above leads to its image."
    legs = v.session.machine.n_legs if any(one.overlays for one in images) else 0
    block = Images(images=images, first=FIRST_IMAGES, legs=legs)
    return Part("photographs", "Images", blocks=(Paragraph(text=text), Hint(text=hint), block))


def _configurations(judged: NominalComparison, v: Validation) -> Part | None:
    """Section with the machine at the judged configurations, the one with the largest residuals
    first, and their table; None for readings of two units.
    """
    unit, session, estimate = _unit(v.session), v.session, v.remeasured.estimate
    order = [
        k for k in np.argsort(-judged.after, kind="stable").tolist() if np.isfinite(judged.after[k])
    ]
    if unit is None or not order:
        return None
    scale, unit_name = DISPLAY_UNITS[unit]
    rows = judged.rows[order]
    names = [session.configurations[row] for row in rows]
    keys = [configuration_key(name) for name in names]
    after, before = ((scale * values[order]).tolist() for values in (judged.after, judged.before))
    stations: dict[int, list[str]] = {}
    for station in session.stations:
        for image in station.images:
            stations.setdefault(image.configuration, []).append(station.name)
    table = Table(
        "Residuals by configuration",
        ("Configuration", "Seen from", f"Calibrated, {unit_name}", f"Nominal model, {unit_name}"),
        tuple(
            Row(name, (listed(stations.get(row, []), 3), brief(new), brief(old)), key=key)
            for name, row, new, old, key in zip(
                names, rows.tolist(), after, before, keys, strict=True
            )
        ),
        "Root mean squares of the readings' residuals. A row leads to its images, and takes the"
        " machine above there.",
        brief=False,
        words=(1,),
    )
    machine = estimate.machine
    postures = Postures(session.joints[rows], estimate.state.T_base_platform[rows])
    tips = [
        f"{name}: readings {brief(new)} {unit_name} off"
        for name, new in zip(names, after, strict=True)
    ]
    sizes = np.maximum(np.array(after) / after[0], SMALLEST_POINT).round(2).tolist()
    block = Space(
        title="Where the residuals are large",
        caption="The machine at the judged configurations, the one with the largest residuals"
        " first. Points are the platform's positions: the larger, the larger the residuals.",
        alt="The machine in three dimensions at the judged configurations, with a point for each;"
        " the table below has the numbers.",
        machine=machine_shape(
            machine,
            leg_rows(machine, None),
            station_cameras(session, estimate),
            Postures(*(part[:1] for part in postures)),
        ),
        poses=space_poses(machine, postures, names, configuration_key),
        points=(
            space_points("Judged poses", "--calibrated", postures.T_base_platform[:, :3, 3], keys,
                         tips, sizes),
        ),
    )  # fmt: skip
    return Part("configurations", "Configurations", blocks=(block,), tables=(table,))


def _worst(judged: NominalComparison, session: Session) -> tuple[str, ...]:
    """Sentence on the configuration with the largest residuals; empty for readings of two units."""
    unit = _unit(session)
    if unit is None or not np.isfinite(judged.after).any():
        return ()
    k = int(np.nanargmax(judged.after))
    name = session.configurations[judged.rows[k]]
    return (
        f"Worst is configuration {name}, {amount(float(judged.after[k]), unit)}; the root mean"
        f" square of all is {amount(finite_rms(judged.after), unit)}.",
    )


def regions_table(items: tuple[HoldOut, ...], session: Session) -> Table:
    """Table of held-out regions."""
    unit = _unit(session)

    def text(value: float) -> str:
        return amount(value, unit) if unit else "–"

    rows = [
        Row(
            item.region.name,
            (
                str(len(item.left_out.rows)),
                text(finite_rms(item.left_out.before)),
                text(finite_rms(item.left_out.after)),
                text(finite_rms(item.used.after)),
                better(item.left_out.ratio),
                number(item.left_out.promise.factor, 2),
            ),
        )
        for item in items
    ]
    return Table(
        "Regions of the workspace, each left out once and predicted by a calibration of the rest",
        (
            "Platform", "Left out", "Nominal model", "Calibrated", "Where used", "Times better",
            "× promise",
        ),
        tuple(rows),
        "Residuals of the readings, root mean square, weighed by how well the images see each"
        " direction. A region far worse than the configurations in use is extrapolated badly.",
    )  # fmt: skip


def paths_table(paths: tuple[LinePath, ...]) -> Table:
    """Table of straight paths, as in [C] Table 4."""

    def text(value: Straightness | None) -> str:
        return f"{_magnitude(value.rms, 'm')} ({_magnitude(value.largest, 'm')})" if value else "–"

    rows = [
        Row(path.name, (str(path.n), *map(text, (path.seen, path.drawing, path.calibrated))))
        for path in paths
    ]
    return Table(
        "Straight paths: distance of the tool points from the line through them, rms (largest), mm",
        ("Path", "Points", "As seen", "By nominal model", "By calibration"),
        tuple(rows),
        "As seen: where the images show the tool. By nominal model and by calibration: forward"
        " kinematics of the readings, for a tool that was led along a ruler.",
    )


def held_out_part(item: HoldOut, session: Session) -> Part:
    """Report section on the configurations held out of a calibration."""
    out, used, unit = item.left_out, item.used, _unit(session)
    amounts = inside = ""
    if unit:
        amounts = f": {against(out.after, out.before, unit)}"
        inside = f" In the configurations in use, {amount(finite_rms(used.after), unit)}."
    broken = "" if out.promise.holds else " That is more than the deviations promise."
    held = count(len(out.rows), "configuration")
    # repeats of a pose are not independent configurations
    poses = len(np.unique(same_pose(session.joints[out.rows], session.joint_noise)))
    if poses < len(out.rows):
        held += f" of {count(poses, 'pose')}"
    sentence = (
        f"On {held} held out, the calibrated machine predicts the"
        f" readings {better(out.ratio)} times better than the nominal"
        f" model{amounts}.{inside}{broken}"
    )
    in_use, held_out = used.figures(used.calibrated), out.figures(out.calibrated)
    nominal = out.figures(out.nominal)
    rows = [
        Row(
            name,
            (
                *_mean_rms(in_use, k, unit),
                *_mean_rms(held_out, k, unit),
                _magnitude(nominal.joint_rms[k], unit),
            ),
        )
        for k, (name, unit) in enumerate(_joints(session))
    ]
    for name, field, unit in (
        ("tool position, mm", "position", "m"),
        ("tool orientation, °", "orientation", "rad"),
    ):
        cells = [_magnitude(getattr(f, field), unit) for f in (in_use, held_out, nominal)]
        rows.append(Row(name, ("", cells[0], "", cells[1], cells[2])))
    table = Table(
        "Residuals of configurations in use and held out",
        (
            "Joint",
            "Mean in use",
            "rms in use",
            "Mean held out",
            "rms held out",
            "rms by the nominal model",
        ),
        tuple(rows),
        "Readings measured less predicted from poses that the images show, weighed by how well"
        " each was seen; their noise is in all columns.",
        brief=False,
    )
    return Part("heldout", "Held out", terminal_text=(sentence,), tables=(table,))


def _joints(session: Session) -> list[tuple[str, str]]:
    """Name with unit, and unit m or rad, of each reading."""
    names, units = session.document["joints"]["columns"], session.machine.joint_units
    return [(f"{n}, {DISPLAY_UNITS[unit][1]}", unit) for n, unit in zip(names, units, strict=True)]


def _unit(session: Session) -> str | None:
    """Unit of all readings, None if they differ."""
    units = session.machine.joint_units
    return units[0] if len(set(units)) == 1 else None


def _mean_rms(value: WeighedErrors, k: int, unit: str) -> tuple[str, str]:
    """Mean and root mean square of a joint's residuals, with the same digits."""
    root = value.joint_rms[k]
    return _signed(value.joint_mean[k], root, unit), _magnitude(root, unit)


def _signed(value: float, sigma: float, unit: str) -> str:
    """Number with the digits that ``sigma`` justifies."""
    scale = DISPLAY_UNITS[unit][0]
    return number(value * scale, decimals(sigma * scale), signed=True)


def _magnitude(value: float, unit: str) -> str:
    """Magnitude in the displayed unit, two significant digits."""
    return brief(value * DISPLAY_UNITS[unit][0])


def _by_configuration(judged: NominalComparison, session: Session) -> Plot | None:
    """Residuals of readings by configuration: bars for the calibrated machine, and dots for the
    nominal model; None for readings of two units.
    """
    unit = _unit(session)
    if unit is None:
        return None
    scale, unit_name = DISPLAY_UNITS[unit]
    bars, nominal = list[Point](), list[Point]()
    for row, new, old in zip(
        judged.rows.tolist(), judged.after.tolist(), judged.before.tolist(), strict=True
    ):
        name = session.configurations[row]
        key = configuration_key(name)
        tip = f"{name}: {amount(new, unit)}; nominal model {amount(old, unit)}"
        if np.isfinite(new):
            bars.append(Point(x=name, y=rounded(new * scale), tip=tip, key=key))
            if np.isfinite(old):
                nominal.append(Point(x=name, y=rounded(old * scale), key=key))
    alt = f"Residuals of {count(len(bars), 'configuration')}, calibrated and by the nominal model"
    return bar_plot(
        "readings-by-configuration",
        "Residuals of the readings by configuration",
        "configurations",
        f"root mean square, {unit_name}",
        bars,
        alt,
        more=(DotsMark(name="nominal model", colour="nominal", points=tuple(nominal), radius=3),),
        high=max((float(point.y) for point in nominal), default=0.0),
        series="calibrated",
    )


def _by_joint(judged: NominalComparison, session: Session) -> Plot | None:
    """Residuals of the calibrated machine, in predicted standard deviations."""
    normalized = judged.calibrated.residuals / judged.promise.expected
    boxes: list[Box | None] = []
    for k, name in enumerate(session.document["joints"]["columns"]):
        leg = int(np.flatnonzero(session.machine.layout.actuated == k)[0]) + 1
        boxes.append(box(name, normalized[:, k], "σ", 1, leg_colour(leg), leg_key(leg)))
    return row_plot(
        "readings-by-joint",
        "Residuals by joint",
        "promised standard deviations",
        boxes,
        "Residuals of the readings by joint, in the standard deviations that are promised",
        NORMAL_90,
        "Shaded: where nine tenths are expected.",
    )
