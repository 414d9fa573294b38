"""Report on [A] 4: Table 1, Fig. 4 and the end-effector's errors, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.axis_measurements import AxisNoise
from pkmcal.outcome import Outcome, Part, Row, Table
from pkmcal.pages.plots import (
    COMMON_AXIS_LAYOUT,
    COMMON_PLOT_LAYOUT,
    TRANSPARENT_COLOUR,
    bars,
    trace,
)
from pkmcal.studies.engine import StudyResult, run
from pkmcal.studies.paper_a import (
    END_EFFECTOR_QUANTITIES,
    FOUR_STEPS_CORRECTED,
    FOUR_STEPS_PRINTED,
    PAPER_A_BOUND,
    PAPER_A_JOINT,
    PAPER_A_METHODS,
    PAPER_A_NOMINAL,
    PAPER_A_PARAMETER_GROUPS,
    RADIAN_IN_DEGREES,
    HexapodByAxes,
    converged,
    hexapod_with_held_radii,
    mean_error,
    thirty,
)
from pkmcal.studies.paper_a_expected import (
    FOLLOWS_NOMINAL,
    MEAN_ERRORS,
    PAPER_A_ERRORS_AFTER,
    PAPER_A_ERRORS_BEFORE,
    PAPER_A_PROTOTYPE,
    PROTOTYPE_POSES,
    TABLE_1,
    paper_a_checks,
    paper_a_figures,
)
from pkmcal.studies.reproduction import (
    Column,
    Compared,
    DisplayNumber,
    Options,
    Words,
    accuracy_rows,
    deg,
    mm,
)
from pkmcal.studies.statistics import Summary, covered, mean, ratio_of_figures
from pkmcal.wording import joined, number

if TYPE_CHECKING:
    from pkmcal.studies.paper_a_images import MeasuredNoise

NARROW_NOMINAL_ERROR = 0.002 / 3**0.5
"""Standard deviation (m) of errors that are uniform within ± 2 mm, the other reading of "uniform
noise with variance equal to 2 mm".
"""
PAPER_A_METHOD_LABELS = {
    PAPER_A_NOMINAL: "the nominal model, before",
    FOUR_STEPS_PRINTED: "four steps as printed",
    FOUR_STEPS_CORRECTED: "four steps corrected",
    PAPER_A_JOINT: "joint estimate",
    PAPER_A_BOUND: "Cramér-Rao bound",
}
PAPER_A_QUANTITY_LABELS = {
    "base_xy": "base x, y",
    "base_z": "base z",
    "platform_xy": "platform x, y",
    "platform_z": "platform z",
    "offset": "offset",
    "displacement": "displacement",
    "orientation": "orientation",
}
PAPER_A_REMARKS = ("printed", "before", "agree", "of_nominal", "others")
"""Remarks of the report; the last two only if there are such differences."""
ERROR_AXIS_TICKS = [0.01, 0.03, 0.1, 0.3, 1, 3]
"""Ticks of logarithmic axes, mm."""
FIGURE_4_ERROR_RANGE = (0.005, 5.0)
"""Range of the logarithmic error axis of Fig. 4, mm."""

HexapodByAxesStudy = StudyResult[HexapodByAxes]


def reproduce(options: Options) -> Outcome:
    """Reproduce [A] 4."""
    began = perf_counter()
    measured, done = None, 0.0
    if options.images:
        from pkmcal.studies.paper_a_images import measured_noise

        done = 0.6
        measured = measured_noise(options.seed, options.within(0.0, done))
    share = (1 - done) * (0.1 if options.long else 0.5)
    study, narrow = (
        run(setting, options.runs, options.seed, options.within(begin, begin + share))
        for setting, begin in (
            (HexapodByAxes(), done),
            (HexapodByAxes(nominal_error=NARROW_NOMINAL_ERROR), done + share),
        )
    )
    done += 2 * share
    by_poses: dict[int, HexapodByAxesStudy] = {}  # by number of poses at a station
    for poses in PROTOTYPE_POSES if options.long else ():
        upto = done + (1 - done) * poses / sum(PROTOTYPE_POSES)
        progress = options.within(done, upto)
        same = poses == study.setting.poses
        setting = replace(study.setting, poses=poses)
        by_poses[poses] = study if same else run(setting, options.runs, options.seed, progress)
        done = upto
    figures = paper_a_figures(study)
    elapsed = perf_counter() - began
    words = _words(study, narrow, figures, measured, elapsed)
    return words.reproduction(
        (
            words.part("noise", table_1(measured), more=["measured"] if measured else []),
            _figure_part(words, study),
            words.part("effector", _effector_table(study), _readings_table(study, narrow)),
            words.part(
                "groups",
                Table(
                    "RMSE, mm",
                    ("", *(PAPER_A_QUANTITY_LABELS[g] for g in PAPER_A_PARAMETER_GROUPS)),
                    tuple(
                        _by_method(study, [Column(name, 3, 4) for name in PAPER_A_PARAMETER_GROUPS])
                    ),
                ),
            ),
            *([_poses_part(words, by_poses)] if by_poses else []),
            words.part("how"),
        ),
        checks=paper_a_checks(study),
        remarks=[name for name in PAPER_A_REMARKS if words.values.get(name, True)],
        numbers={**_numbers(study, narrow, figures, by_poses, elapsed), **_noise(measured)},
    )


def _by_method(s: HexapodByAxesStudy, columns: Sequence[Column]) -> list[Row]:
    """Rows with the accuracy of every method, beside the prototype's."""
    return [
        row
        for m in PAPER_A_METHODS
        for row in accuracy_rows(s, (m,), _name(m), columns, PAPER_A_PROTOTYPE.get((m,)))
    ]


def _name(method: str) -> str:
    text = PAPER_A_METHOD_LABELS[method]
    return text[:1].upper() + text[1:]


def _figures_text(figures: list[Compared]) -> str:
    """Text with figures by method: ``Joint estimate, base z 0.06 for 0.063``."""
    texts: list[str] = []
    for (method,) in dict.fromkeys(f.key for f in figures):
        items = [
            f"{PAPER_A_QUANTITY_LABELS[f.quantity]} {f.measured.value:.3g} for {f.expected:g}"
            for f in figures
            if f.key == (method,)
        ]
        texts.append(f"{PAPER_A_METHOD_LABELS[method]}, {joined(items)}")
    text = "; ".join(texts)
    return text[:1].upper() + text[1:]


def _depth_as_printed(s: HexapodByAxesStudy) -> float:
    """Mean |error| in z of the four steps as printed, m."""
    z = np.char.endswith(np.array(thirty(hexapod_with_held_radii()).names), "z")
    return float(mean_error(s, FOUR_STEPS_PRINTED)[z].mean())


def _words(
    s: HexapodByAxesStudy,
    narrow: HexapodByAxesStudy,
    figures: list[Compared],
    measured: MeasuredNoise | None,
    elapsed: float,
) -> Words:
    """Text of the report with its values, and with the differences from the prototype."""

    def over(method: str, other: str) -> float:
        return ratio_of_figures(s.of(method)["parameters"], s.of(other)["parameters"]).value

    apart = [f for f in figures if f.differs]
    of_nominal = [f for f in apart if (f.key, f.quantity) in FOLLOWS_NOMINAL]
    joint = s.samples[PAPER_A_JOINT,]
    inside = mean(covered(joint.values["parameters"], joint.sigma["parameters"])).times(100)
    return Words.of(
        "a",
        s,
        elapsed=elapsed,
        after=(
            DisplayNumber(1e3 * PAPER_A_ERRORS_AFTER[0]),
            DisplayNumber(RADIAN_IN_DEGREES * PAPER_A_ERRORS_AFTER[1]),
        ),
        joint_over_bound=over(PAPER_A_JOINT, PAPER_A_BOUND),
        corrected_over_joint=over(FOUR_STEPS_CORRECTED, PAPER_A_JOINT),
        printed_over_joint=over(FOUR_STEPS_PRINTED, PAPER_A_JOINT),
        converged=converged(s),
        narrow_depth=1e3 * _depth_as_printed(narrow),
        narrow_displacement=1e3 * narrow.of(FOUR_STEPS_PRINTED)["displacement"].value,
        drawing_error_asked=2
        * PAPER_A_ERRORS_BEFORE[0]
        / s.of(PAPER_A_NOMINAL)["displacement"].value,
        agree=len(figures) - len(apart),
        compared=len(figures),
        of_nominal=_figures_text(of_nominal),
        others=_figures_text([f for f in apart if f not in of_nominal]),
        inside=inside.value,
        inside_error=inside.error,
        edge=measured.edge if measured else 0.0,
    )


# ------------------------------------------------------------------ parts


def table_1(measured: MeasuredNoise | None = None) -> Table:
    """[A] Table 1 and the noise of the simulation. measured : noise on rendered images, if
    measured.
    """

    def cells(noise: AxisNoise, places: int) -> tuple[str, ...]:
        psi, theta, x, z = noise.sigma().tolist()
        return (f"{deg(psi, places)}°", f"{deg(theta, places)}°",
                f"{mm(x, places)} mm", f"{mm(z, places)} mm")  # fmt: skip

    rows = [
        Row("The paper, printed", ("0.05 rad", "0.06 rad", "0.05 mm", "0.1 mm"), "paper"),
        Row("The paper, in degrees", cells(TABLE_1, 2), "paper"),
        Row("Used: mean of three images", cells(AxisNoise(images=3), 3)),
    ]
    if measured is not None:
        rows += [
            Row("Measured here, median leg", cells(measured.middle, 2)),
            Row("Measured here, worst leg", cells(measured.bound, 2)),
        ]
    title = "Table 1: standard deviations of a leg's axis"
    return Table(title, ("", "ψ", "θ", "x", "z"), tuple(rows))


def _figure_part(words: Words, s: HexapodByAxesStudy) -> Part:
    """Section on [A] Fig. 4."""
    params = thirty(hexapod_with_held_radii())
    errors = {method: mean_error(s, method) for method in PAPER_A_METHODS}
    low, high = (mm(v, 2) for v in MEAN_ERRORS)
    summary = [Row("The paper", (low, "", high, "z"), "paper")]
    for method, error in errors.items():
        worst = params.names[int(np.argmax(error))]
        cells = (*(mm(float(v)) for v in (error.min(), error.mean(), error.max())), worst)
        summary.append(Row(_name(method), cells))
    every = [
        Row(name, (mm(float(value), 1), *(mm(float(errors[m][k])) for m in PAPER_A_METHODS)))
        for k, (name, value) in enumerate(zip(params.names, params.nominal, strict=True))
    ]
    heads = ("", "true value", *(_name(m) for m in PAPER_A_METHODS))
    return words.part(
        "figure",
        Table(
            "Mean |error| of the parameters, mm",
            ("", "smallest", "mean", "largest", "worst"),
            tuple(summary),
        ),
        Table("All thirty, mm", heads, tuple(every), brief=False, folded=True),
        plots={
            "errors": {
                "figure": figure_4(params.names, params.nominal, errors),
                "height": 560,
                "width": 860,
            }
        },
    )


def figure_4(names: tuple[str, ...], values: Array, errors: dict[str, Array]) -> dict[str, Any]:
    """Plot of true values (30,) as a line above the mean errors (30,) of each method as bars; in
    m.
    """
    in_mm = {method: 1e3 * error for method, error in errors.items()}
    colours = {
        FOUR_STEPS_PRINTED: "--quiet",
        FOUR_STEPS_CORRECTED: "--drawing",
        PAPER_A_JOINT: "--calibrated",
    }
    data = [
        *(
            bars(PAPER_A_METHOD_LABELS[method], names, in_mm[method], color=colour)
            for method, colour in colours.items()
        ),
        bars(
            PAPER_A_METHOD_LABELS[PAPER_A_BOUND], names, in_mm[PAPER_A_BOUND],
            color=TRANSPARENT_COLOUR,  # the bound is not an estimate, so it is not filled
            line={"color": "--ink", "width": 1.2},
        ),
        trace(
            PAPER_A_METHOD_LABELS[PAPER_A_NOMINAL], names, in_mm[PAPER_A_NOMINAL], "--muted",
            "markers",
            marker={"symbol": "line-ew-open", "size": 22, "color": "--muted",
                    "line": {"width": 2, "color": "--muted"}},
        ),
        trace(
            "true value", names, 1e3 * values, "--leg3", yaxis="y2",
            marker={"size": 5, "color": "--leg3"},
        ),
    ]  # fmt: skip
    for each in data:
        each["hovertemplate"] = "%{x}: %{y:.4g} mm"
    low, high = (1e3 * v for v in MEAN_ERRORS)
    band = {
        "type": "rect", "layer": "below", "fillcolor": "--band", "line": {"width": 0},
        "xref": "paper", "x0": 0, "x1": 1, "y0": low, "y1": high,
    }  # fmt: skip
    text = {
        "text": "grey band: the paper, 0.04 to 1 mm", "font": {"size": 11, "color": "--muted"},
        "xref": "paper", "x": 1.0, "xanchor": "right", "showarrow": False,
        "y": float(np.log10(high)), "yanchor": "bottom",
    }  # fmt: skip
    axis = {**COMMON_AXIS_LAYOUT, "fixedrange": True}
    layout = {
        **COMMON_PLOT_LAYOUT,
        "margin": {"l": 64, "r": 8, "t": 34, "b": 46},
        "barmode": "group", "bargap": 0.22, "bargroupgap": 0,
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom",
                   "traceorder": "normal"},
        "xaxis": {**axis, "tickangle": -60, "anchor": "y", "showgrid": False,
                  "range": [-0.7, len(names) - 0.3]},
        "yaxis": {**axis, "type": "log", "range": np.log10(FIGURE_4_ERROR_RANGE).tolist(),
                  "domain": [0.0, 0.68],
                  "tickvals": ERROR_AXIS_TICKS, "title": {"text": "mean |error|, mm"}},
        "yaxis2": {**axis, "domain": [0.76, 1.0], "title": {"text": "true value, mm"}},
        "shapes": [band],
        "annotations": [text],
    }  # fmt: skip
    return {"data": data, "layout": layout}


def _effector_table(s: HexapodByAxesStudy) -> Table:
    """Table of [A] eq. 20."""
    columns = (
        Column("displacement", 3, 3),
        Column("orientation", 4, 4),
        Column("displacement_registered", 3, 3),
    )
    rows = [
        Row(
            "The paper, before",
            (mm(PAPER_A_ERRORS_BEFORE[0], 2), deg(PAPER_A_ERRORS_BEFORE[1], 3), ""),
            "paper",
        ),
        Row(
            "The paper, after",
            (mm(PAPER_A_ERRORS_AFTER[0], 2), deg(PAPER_A_ERRORS_AFTER[1], 3), ""),
            "paper",
        ),
        *_by_method(s, columns),
    ]
    note = "The paper's angles are printed in rad; degrees are meant, as in Table 1."
    heads = ("", "mm", "°", "mm, all joints")
    return Table("Errors of the end-effector", heads, tuple(rows), note)


def _readings_table(wide: HexapodByAxesStudy, narrow: HexapodByAxesStudy) -> Table:
    """Table of the influence of the nominal errors, for the two readings of the paper."""

    def row(name: str, s: HexapodByAxesStudy) -> Row:
        before, printed, joint = (
            s.of(m)["displacement"].value
            for m in (PAPER_A_NOMINAL, FOUR_STEPS_PRINTED, PAPER_A_JOINT)
        )
        depth = mm(_depth_as_printed(s), 2)
        return Row(name, (mm(before, 2), mm(printed, 2), depth, mm(joint)))

    return Table(
        "Nominal errors: “uniform noise with variance equal to 2 mm”",
        ("", "nominal", "as printed", "its mean |z|", "joint"),
        (
            Row(
                "The paper",
                (mm(PAPER_A_ERRORS_BEFORE[0], 2), mm(PAPER_A_ERRORS_AFTER[0], 2), "up to 1", ""),
                "paper",
            ),
            row("Standard deviation 2 mm", wide),
            row("Within ± 2 mm", narrow),
        ),
        "End-effector, and mean |error| in z of the four steps as printed; mm.",
    )


def _poses_part(words: Words, studies: dict[int, HexapodByAxesStudy]) -> Part:
    """Section on the accuracy by number of poses at a station."""
    poses = sorted(studies)
    displacements = {n: studies[n].of(PAPER_A_JOINT)["displacement"].times(1e3) for n in poses}
    least = [1e3 * studies[n].of(PAPER_A_BOUND)["displacement"].value for n in poses]
    rows = [
        Row(
            str(n),
            (number(displacements[n].value, 4), number(displacements[n].error, 4), number(bound, 4),
             number(PROTOTYPE_POSES[n], 3)),
        )
        for n, bound in zip(poses, least, strict=True)
    ]  # fmt: skip
    heads = ("poses a station", "found", "± Monte-Carlo", "bound", "prototype")
    title = "Displacement of the end-effector, joint estimate, mm"
    figure = _poses_plot(poses, [displacements[n] for n in poses], least)
    return words.part(
        "poses",
        Table(title, heads, tuple(rows)),
        plots={"poses": {"figure": figure, "height": 380}},
    )


def _poses_plot(
    poses: list[int], displacements: list[Summary], least: list[float]
) -> dict[str, Any]:
    """Plot of the end-effector's error (mm) by number of poses at a station, on logarithmic
    axes.
    """
    as_root = [least[-1] * (poses[-1] / n) ** 0.5 for n in poses]
    two_sigma = [2 * s.error for s in displacements]
    data = [
        trace("Cramér-Rao bound", poses, least, "--ink", "lines",
               line={"color": "--ink", "dash": "dot", "width": 1.5}),
        trace("as N to the power of −½", poses, as_root, "--quiet", "lines",
               line={"color": "--quiet", "dash": "dash", "width": 1.5}),
        trace("joint estimate", poses, [s.value for s in displacements], "--calibrated",
               error_y={"array": two_sigma, "color": "--calibrated"}),
        trace("independent prototype", PROTOTYPE_POSES, PROTOTYPE_POSES.values(),
               "--drawing", "markers",
               marker={"color": "--drawing", "size": 9, "symbol": "diamond-open"}),
    ]  # fmt: skip
    axis = {**COMMON_AXIS_LAYOUT, "type": "log", "fixedrange": True}
    layout = {
        **COMMON_PLOT_LAYOUT,
        "margin": {"l": 64, "r": 12, "t": 8, "b": 48},
        "legend": {"x": 1, "xanchor": "right", "y": 1, "bgcolor": TRANSPARENT_COLOUR},
        "xaxis": {**axis, "tickvals": poses, "title": {"text": "poses a station, N"}},
        "yaxis": {**axis, "tickvals": ERROR_AXIS_TICKS, "title": {"text": "displacement, mm"}},
    }
    return {"data": data, "layout": layout}


# ------------------------------------------------------------------ for programs


def _numbers(
    s: HexapodByAxesStudy,
    narrow: HexapodByAxesStudy,
    figures: list[Compared],
    by_poses: dict[int, HexapodByAxesStudy],
    elapsed: float,
) -> dict[str, Any]:
    """Figures for programs, m and rad."""
    names = thirty(hexapod_with_held_radii()).names
    return {
        "runs": s.runs,
        "seed": s.seed,
        "poses_per_station": s.setting.poses,
        "converged": converged(s),
        "chi2_per_dof": s.of(PAPER_A_JOINT)["chi2"].value,
        "seconds": {"wall": elapsed, "solving": s.solving, "cpu": s.cpu, "workers": s.workers},
        "paper": {
            "mean_error": MEAN_ERRORS,
            "before": dict(
                zip(("displacement", "orientation"), PAPER_A_ERRORS_BEFORE, strict=True)
            ),
            "after": dict(zip(("displacement", "orientation"), PAPER_A_ERRORS_AFTER, strict=True)),
        },
        "methods": {m: _accuracy(s, m) for m in PAPER_A_METHODS},
        "methods_with_drawing_within_2_mm": {m: _accuracy(narrow, m) for m in PAPER_A_METHODS},
        "mean_error": {
            m: dict(zip(names, mean_error(s, m).tolist(), strict=True)) for m in PAPER_A_METHODS
        },
        "prototype": [
            {
                "method": f.key[0],
                "quantity": f.quantity,
                "found": f.measured.value,
                "error": f.measured.error,
                "expected": f.expected,
                "rounding": f.rounding,
                "differs": f.differs,
                "tolerable": f.tolerable,
            }
            for f in figures
        ],
        "by_poses": {n: _accuracy(other, PAPER_A_JOINT) for n, other in by_poses.items()},
    }


def _accuracy(s: HexapodByAxesStudy, method: str) -> dict[str, Any]:
    summaries = {
        name: s.of(method)[name] for name in (*PAPER_A_PARAMETER_GROUPS, *END_EFFECTOR_QUANTITIES)
    }
    return {
        "found": {name: summary.value for name, summary in summaries.items()},
        "standard_error": {name: summary.error for name, summary in summaries.items()},
    }


def _noise(measured: MeasuredNoise | None) -> dict[str, Any]:
    """[A] Table 1 for one image and, if measured, the noise on rendered images."""

    def report(noise: AxisNoise) -> dict[str, float]:
        return dict(zip(("psi", "theta", "x", "z"), noise.sigma().tolist(), strict=True))

    out: dict[str, Any] = {"table_1": report(TABLE_1)}
    if measured is not None:
        out["table_1_measured"] = {
            "median": report(measured.middle),
            "worst": report(measured.bound),
            "edge_px": measured.edge,
        }
    return out
