"""Report on [C] IV: Tables 2, 3 and 4, 26 mm and 5 mm, beside the paper's figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.outcome import Outcome, Row, Table
from pkmcal.pages.plots import bars, plane, trace
from pkmcal.studies.engine import StudyResult, run
from pkmcal.studies.paper_c import (
    EQ3_AS_PRINTED,
    EQ5_AS_PRINTED,
    EQ5_WHITENED,
    LARGER_WORKSPACE_FACTOR,
    METHODS_BY_TRUTH,
    PAPER_C_BOUND,
    PAPER_C_JOINT,
    PAPER_C_NOMINAL,
    ROTATION_AXIS_METHOD,
    H4ByBoard,
    largest_side,
    ranks,
)
from pkmcal.studies.paper_c_expected import (
    NACELLE_ERROR_BEFORE,
    PAPER_C_METHOD_LABELS,
    PAPER_C_MODEL_LABELS,
    PAPER_C_PROTOTYPE,
    ROTATION_AXIS_SPREAD,
    SQUARE_AFTER,
    SQUARE_BEFORE,
    TABLE_3,
    TABLE_4,
    TRUE_MACHINE_HEADINGS,
    paper_c_checks,
    paper_c_figures,
)
from pkmcal.studies.paper_c_machine import A_PRIORI, IDENTIFIED_TABLE_2
from pkmcal.studies.paper_c_validation import Before, before
from pkmcal.studies.reproduction import Column, Options, Words, accuracy_rows, deg, mm
from pkmcal.studies.statistics import each_rms, ratio_of_figures, rms_over_runs
from pkmcal.wording import number

TABLE_2_ANGLE_HEADS = ("α₁", "α₂", "α₃", "α₄", "q₀₁", "q₀₂", "q₀₃", "q₀₄")
PAPER_C_REMARKS = ("models", "floor", "axis", "apart")
"""Remarks of the report; the last only if there are such differences."""
VALIDATION_TABLE_ROWS = (
    ("Before", ("design", PAPER_C_NOMINAL), "before"),
    ("Model 12, eq. 3", ("design", EQ3_AS_PRINTED), "design"),
    ("Model 31, eq. 5", ("calibration", EQ5_AS_PRINTED), "calibration"),
)
"""Rows of Tables 3 and 4: their label, model and method, and the key of the paper's row."""

H4ByBoardStudy = StudyResult[H4ByBoard]


def reproduce(options: Options) -> Outcome:
    """Reproduce [C] IV."""
    return paper_c_outcome(run(H4ByBoard(), options.runs, options.seed, options.progress))


def paper_c_outcome(study: H4ByBoardStudy) -> Outcome:
    """Outcome of a study."""
    start = before()
    words = _words(study, start)
    return words.reproduction(
        (
            words.part(
                "accuracy",
                *_accuracy_tables(study),
                plots={"tool": {"figure": _accuracy_plot(study), "height": 520}},
            ),
            words.part("table-2", *_tables_2(study)),
            words.part(
                "before",
                Table(
                    "Mean error with the a priori parameters",
                    ("", "mm", "rad"),
                    (
                        Row(
                            "The paper",
                            (
                                mm(NACELLE_ERROR_BEFORE.shift, 0),
                                number(NACELLE_ERROR_BEFORE.turn, 3),
                            ),
                            "paper",
                        ),
                        Row("Found", (mm(start.shift, 1), number(start.turn, 4))),
                    ),
                ),
            ),
            words.part(
                "table-3", _table_3(study), plots={"motors": {"figure": _residual_plot(study)}}
            ),
            words.part("table-4", _table_4(study), _square_table(study)),
            words.part("axis", _axis_table(study)),
            words.part("ranks", _ranks_table(study)),
            words.part("how"),
        ),
        checks=paper_c_checks(study, start),
        remarks=[name for name in PAPER_C_REMARKS if words.values.get(name, True)],
        numbers=_numbers(study, start),
    )


def _words(s: H4ByBoardStudy, start: Before) -> Words:
    """Text of the report with its values, and with the differences from the prototype."""
    apart = [f for f in paper_c_figures(s) if not f.held and not f.tolerable]
    right, setting = ("calibration", "calibration"), s.setting
    return Words.of(
        "c",
        s,
        before_mm=1e3 * start.shift,
        before_rad=start.turn,
        over_bound=ratio_of_figures(
            *(s.of(*right, m)["larger_shift"] for m in (PAPER_C_JOINT, PAPER_C_BOUND))
        ).value,
        line=1e3
        * rms_over_runs(
            s.values("straightness", "design", "calibration", EQ5_AS_PRINTED)[:, :2]
        ).value,
        apart="; ".join(
            f"{f.name} {f.measured.value:.3g} for {f.expected:g} {f.unit}" for f in apart
        ),
        larger=LARGER_WORKSPACE_FACTOR,
        noise_mm=1e3 * setting.shift,
        noise_deg=float(np.degrees(setting.turn)),
        noise_urad=1e6 * setting.joint_noise,
        off_mm=1e3 * setting.deviations.length,
        off_mrad=1e3 * setting.deviations.axis,
    )


# ------------------------------------------------------------------ tables


def _accuracy_tables(s: H4ByBoardStudy) -> list[Table]:
    """Tables of every estimator's error over the workspace, beside the prototype's."""
    columns = [
        *(Column(name, 3, 3) for name in ("shift", "turn", "larger_shift", "larger_turn")),
        Column("chi2", 2, 2),
    ]
    heads = ("", "mm", "mrad", "mm*", "mrad*", "χ²")
    note = "* over a workspace a quarter larger; χ² per degree of freedom."
    out: list[Table] = []
    for kind, models in METHODS_BY_TRUTH.items():
        rows: list[Row] = []
        for name, methods in models.items():
            for method in methods:
                key, title = (
                    (kind, name, method),
                    f"{PAPER_C_MODEL_LABELS[name]}, {PAPER_C_METHOD_LABELS[method]}",
                )
                rows += accuracy_rows(
                    s, key, title, columns, PAPER_C_PROTOTYPE.get(key), errors=False
                )
        out.append(Table(TRUE_MACHINE_HEADINGS[kind], heads, tuple(rows), note))
    return out


def _tables_2(s: H4ByBoardStudy) -> tuple[Table, Table]:
    """[C] Table 2: sizes and angles."""
    printed = [
        (name, np.array([t.h, t.arm, t.radius, t.rod, *t.alpha, *t.q0]))
        for name, t in (("a priori", A_PRIORI), ("identified", IDENTIFIED_TABLE_2))
    ]
    equation, best = (
        (name, s.values("table_2", "design", "design", method))
        for name, method in (("equation 3", EQ3_AS_PRINTED), ("joint estimate", PAPER_C_JOINT))
    )

    def rows(of: slice, places: int, *value: tuple[str, Array]) -> tuple[Row, ...]:
        def cells(values: Array) -> tuple[str, ...]:
            return tuple(number(float(v), places) for v in values[of])

        out = [Row(f"The paper, {name}", cells(values), "paper") for name, values in printed]
        for name, values in value:
            out.append(Row(f"Found, {name}", cells(values.mean(axis=0))))
            out.append(Row("  its scatter", cells(values.std(axis=0)), "prototype"))
        return tuple(out)

    # The paper has four decimals; the scatter of sizes needs five.
    sizes, angles = rows(slice(4), 5, equation, best), rows(slice(4, None), 4, equation)
    return (
        Table("Table 2: sizes, m", ("", "h", "arm", "R", "forearm"), sizes),
        Table("Table 2: angles, rad", ("", *TABLE_2_ANGLE_HEADS), angles, brief=False),
    )


def _control_mean(s: H4ByBoardStudy, model_and_method: tuple[str, str]) -> Array:
    """Means (4,) of the motors' residuals, rad.

    After a calibration their signs are random, so these are root mean squares over the runs.
    """
    means = s.values("control_mean", "design", *model_and_method)
    return means.mean(axis=0) if model_and_method[1] == PAPER_C_NOMINAL else each_rms(means)


def _table_3(s: H4ByBoardStudy) -> Table:
    """[C] Table 3."""

    def two_digits(values: Any) -> tuple[str, ...]:
        return tuple(f"{1e3 * v:.2g}".replace("-", "\N{MINUS SIGN}") for v in values)

    rows: list[Row] = []
    for label, which, key in VALIDATION_TABLE_ROWS:
        ours = (_control_mean(s, which), each_rms(s.values("control_rms", "design", *which)))
        for what, paper, figures in zip(("mean", "rms"), TABLE_3[key], ours, strict=True):
            rows.append(Row(f"{label}, {what}: the paper", two_digits(paper), "paper"))
            rows.append(Row("  found", two_digits(figures)))
    heads = ("", "q₁", "q₂", "q₃", "q₄")
    return Table("Table 3: residuals of the motors, mrad", heads, tuple(rows))


def _table_4(s: H4ByBoardStudy) -> Table:
    """[C] Table 4."""
    rows: list[Row] = []
    for label, which, key in (
        *VALIDATION_TABLE_ROWS,
        ("Model 31, joint", ("calibration", PAPER_C_JOINT), ""),
    ):
        if key:
            one, two = TABLE_4[key]
            rows.append(Row(f"{label}: the paper", (mm(one, 2), mm(two, 2), "", ""), "paper"))
        straightness = each_rms(s.values("straightness", "design", *which))
        name = "  found" if key else f"  found, {label}"
        rows.append(Row(name, tuple(mm(float(v)) for v in straightness)))
    return Table(
        "Table 4: straightness, mm",
        ("", "200 mm, x", "200 mm, y", "400 mm, x", "400 mm, y"),
        tuple(rows),
        "The paper's two directions stand in the first two columns.",
    )


def _square_table(s: H4ByBoardStudy) -> Table:
    """[C] IV.D."""
    old = mm(largest_side(s, ("design", PAPER_C_NOMINAL)), 2)
    rows = [Row("The paper", (mm(SQUARE_BEFORE, 0), f"< {1e3 * SQUARE_AFTER:g}"), "paper")]
    rows += [
        Row(label, (old, mm(largest_side(s, which))))
        for label, which, _ in VALIDATION_TABLE_ROWS[1:]
    ]
    heads = ("", "before", "after")
    return Table("Largest error of the square's sides, mm", heads, tuple(rows))


def _axis_table(s: H4ByBoardStudy) -> Table:
    """[C] IV.B: the axis of rotation and its spread."""
    a = s.samples["design", ROTATION_AXIS_METHOD].values

    def row(name: str, value: float, noise: float) -> Row:
        return Row(name, (deg(value, 3), deg(noise, 3)))

    rows = (
        Row("The paper, standard deviation", (deg(ROTATION_AXIS_SPREAD, 2), ""), "paper"),
        row(
            "Pairs of poses, root mean square",
            rms_over_runs(a["spread"]).value,
            rms_over_runs(a["expected"]).value,
        ),
        row("Single poses off the axis", rms_over_runs(a["tilt"]).value, 2**0.5 * s.setting.turn),
    )
    return Table("Spread of the axis, °", ("", "found", "by noise alone"), rows)


def _ranks_table(s: H4ByBoardStudy) -> Table:
    """[C] III.C: identifiable unknowns."""
    unknowns = {"design": 24, "calibration": 46}
    rows = [
        Row(
            f"{PAPER_C_MODEL_LABELS[name]}, {PAPER_C_METHOD_LABELS[method]}",
            (str(unknowns[name]), str(rank), str(count)),
        )
        for (name, method), (rank, count) in ranks(s).items()
    ]
    return Table("Ranks", ("", "unknowns", "rank", "estimated"), tuple(rows))


# ------------------------------------------------------------------ plots


def _accuracy_plot(s: H4ByBoardStudy) -> dict[str, Any]:
    """Plot of the tool's error over the larger workspace by truth, model and method, mm, beside the
    prototype's, whose workspace fits that size.
    """
    data: list[dict[str, Any]] = []
    places: list[int] = []
    labels: list[str] = []
    printed: dict[int, float] = {}
    for kind, models in METHODS_BY_TRUTH.items():
        errors: dict[int, float] = {}
        for name, method in ((name, m) for name, methods in models.items() for m in methods):
            place = len(labels) + len(data)  # leaves a gap between machines
            labels.append(f"{PAPER_C_MODEL_LABELS[name]}, {PAPER_C_METHOD_LABELS[method]}")
            places.append(place)
            errors[place] = 1e3 * s.of(kind, name, method)["larger_shift"].value
            prototype = PAPER_C_PROTOTYPE.get((kind, name, method), {}).get("larger_shift")
            if prototype:
                printed[place] = float(prototype)
        colour = {"design": "--drawing", "calibration": "--calibrated", "rods": "--leg3"}[kind]
        # horizontal bars, for the length of their names
        horizontal = bars(TRUE_MACHINE_HEADINGS[kind], errors.values(), errors, color=colour)
        data.append({**horizontal, "orientation": "h", "width": 0.8})
    marks = {"color": "--ink", "size": 9, "symbol": "diamond-open"}
    data.append(
        trace("independent prototype", printed.values(), printed, "--ink", "markers", marker=marks)
    )
    for each in data:
        each["hovertemplate"] = "%{x:.3g} mm"
    layout = plane("mm", "")
    layout |= {"margin": {"l": 8, "r": 16, "t": 34, "b": 44}, "barmode": "overlay"}
    layout["xaxis"] |= {"type": "log"}
    layout["xaxis"] |= {"tickvals": [0.05, 0.1, 0.2, 0.5, 1, 2, 5], "range": [-1.5, 0.9]}
    layout["yaxis"] |= {"tickvals": places, "ticktext": labels, "showgrid": False}
    layout["yaxis"] |= {"range": [places[-1] + 0.6, -0.6], "automargin": True}
    return {"data": data, "layout": layout}


def _residual_plot(s: H4ByBoardStudy) -> dict[str, Any]:
    """Plot of [C] Table 3 after the calibration: root mean square residuals of the motors, mrad."""
    data: list[dict[str, Any]] = []
    colours = {"design": "--drawing", "calibration": "--calibrated"}
    motors = [f"q{sign}" for sign in "₁₂₃₄"]
    for label, which, key in VALIDATION_TABLE_ROWS[1:]:
        ours = 1e3 * each_rms(s.values("control_rms", "design", *which))
        paper = 1e3 * np.array(TABLE_3[key][1])
        data += [
            bars(f"{label}: the paper", motors, paper, color=colours[key], opacity=0.35),
            bars(f"{label}: found", motors, ours, color=colours[key]),
        ]
    layout = plane("", "mrad")
    layout["margin"] = {"l": 58, "r": 8, "t": 34, "b": 40}
    return {"data": data, "layout": layout}


# ------------------------------------------------------------------ for programs


def _numbers(s: H4ByBoardStudy, start: Before) -> dict[str, Any]:
    """Figures for programs, m and rad."""
    axis = s.samples["design", ROTATION_AXIS_METHOD].values
    validated = [
        (name, method)
        for name, methods in METHODS_BY_TRUTH["design"].items()
        for method in methods
        if method != PAPER_C_BOUND
    ]
    return {
        "runs": s.runs,
        "seed": s.seed,
        "seconds": {"wall": s.wall, "workers": s.workers},
        "before": start._asdict(),
        "paper": {
            "before": NACELLE_ERROR_BEFORE._asdict(),
            "table_3": {k: {"mean": v[0], "rms": v[1]} for k, v in TABLE_3.items()},
            "table_4": TABLE_4,
            "square": {"before": SQUARE_BEFORE, "after": SQUARE_AFTER},
        },
        "accuracy": [
            _accuracy(s, kind, name, method)
            for kind, models in METHODS_BY_TRUTH.items()
            for name, methods in models.items()
            for method in methods
        ],
        "table_2": {
            method: {
                "mean": s.values("table_2", "design", "design", method).mean(axis=0).tolist(),
                "std": s.values("table_2", "design", "design", method).std(axis=0).tolist(),
            }
            for method in (EQ3_AS_PRINTED, EQ5_WHITENED, PAPER_C_JOINT)
        },
        "validation": {
            ", ".join(which): {
                "control_mean": _control_mean(s, which).tolist(),
                "control_rms": each_rms(s.values("control_rms", "design", *which)).tolist(),
                "straightness": each_rms(s.values("straightness", "design", *which)).tolist(),
                "square": largest_side(s, which),
            }
            for which in validated
        },
        "axis": {
            "spread": rms_over_runs(axis["spread"]).value,
            "expected": rms_over_runs(axis["expected"]).value,
            "chi2_per_dof": s.of("design", ROTATION_AXIS_METHOD)["chi2"].value,
        },
        "ranks": {", ".join(key): rank for key, rank in ranks(s).items()},
    }


def _accuracy(s: H4ByBoardStudy, *key: str) -> dict[str, Any]:
    """Figures of one method for programs, with the prototype's, in mm and mrad, if there are
    any.
    """
    summaries = s.of(*key)
    chi2, printed = summaries["chi2"].value, PAPER_C_PROTOTYPE.get(key)
    figures = [printed.get(name) for name in ("larger_shift", "larger_turn")] if printed else None
    return {
        **dict(zip(("truth", "model", "method"), key, strict=True)),
        **{
            name: summaries[name].value for name in ("shift", "turn", "larger_shift", "larger_turn")
        },
        **{f"{name}_error": summaries[name].error for name in ("larger_shift", "larger_turn")},
        "chi2": None if np.isnan(chi2) else chi2,
        "runs": len(s.values("shift", *key)),
        "prototype": figures and [v and float(v) for v in figures],
    }
