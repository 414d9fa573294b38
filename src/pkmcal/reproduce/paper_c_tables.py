"""[C] IV in sections of a page: tables of a study beside the paper's figures."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.outcome import Part, Row, Table
from pkmcal.reproduce.paper_c_expected import (
    BEFORE,
    PROTOTYPE,
    SPREAD,
    SQUARE_BEFORE,
    TABLE_3,
    TABLE_4,
    largest_side,
)
from pkmcal.reproduce.paper_c_simulation import A_PRIORI, IDENTIFIED, LARGER, Kind, Table2
from pkmcal.reproduce.paper_c_study import (
    BOUND,
    DRAWING,
    EQ3,
    EQ5,
    JOINT,
    PLAN,
    WHITENED,
    Study,
)
from pkmcal.reproduce.paper_c_validation import Before
from pkmcal.wording import number

LABELS = {
    DRAWING: "a priori",
    EQ3: "eq. 3 as printed",
    EQ5: "eq. 5 as printed",
    WHITENED: "eq. 5 whitened",
    JOINT: "joint estimate",
    BOUND: "Cramér-Rao bound",
}
MODELS: dict[Kind, str] = {
    "design": "Model 12", "calibration": "Model 31", "rods": "Rods",
}  # fmt: skip
TRUTHS: dict[Kind, str] = {
    "design": "The machine is a Model 12",
    "calibration": "The machine is a Model 31",
    "rods": "The machine has rods",
}
NOTE = "* over a workspace a quarter larger; χ² per degree of freedom."
ANGLES = ("α₁", "α₂", "α₃", "α₄", "q₀₁", "q₀₂", "q₀₃", "q₀₄")


def mm(value: float, places: int = 3) -> str:
    """Metres as millimetres without the unit."""
    return number(1e3 * value, places)


def _rms(values: Array) -> Array:
    return np.sqrt(np.mean(values**2, axis=0))


def table_2_part(s: Study) -> Part:
    """[C] Table 2, and what its two columns mean for the nacelle."""
    found = s.validation[f"design, {EQ3}"].table_2
    best = s.validation[f"design, {JOINT}"].table_2
    sizes = [
        Row("The paper, a priori", _sizes(A_PRIORI), "paper"),
        Row("The paper, identified", _sizes(IDENTIFIED), "paper"),
        Row("Found, equation 3", _cells(found[:, :4].mean(axis=0), 4)),
        Row("  its scatter", _cells(found[:, :4].std(axis=0), 4), "prototype"),
        Row("Found, joint estimate", _cells(best[:, :4].mean(axis=0), 4)),
        Row("  its scatter", _cells(best[:, :4].std(axis=0), 4), "prototype"),
    ]
    angles = [
        Row("The paper, a priori", _angles(A_PRIORI), "paper"),
        Row("The paper, identified", _angles(IDENTIFIED), "paper"),
        Row("Found, equation 3", _cells(found[:, 4:].mean(axis=0), 4)),
        Row("  its scatter", _cells(found[:, 4:].std(axis=0), 4), "prototype"),
    ]
    return Part(
        "table-2",
        "Table 2",
        (
            "The paper's identified values are the truth of this simulation, so the found ones"
            " must come back to them; the scatter is that of the runs. The arm (0.26 m) and the"
            " forearm (0.48 m) are l and L of Table 2; the paper's text has them the other way"
            " round. Offsets enter as Q = q − q₀: only then is the error before what the paper"
            " reports.",
        ),
        tables=(
            Table("Table 2: sizes, m", ("", "h", "arm", "R", "forearm"), tuple(sizes)),
            Table("Table 2: angles, rad", ("", *ANGLES), tuple(angles), brief=False),
        ),
    )


def _sizes(t: Table2) -> tuple[str, ...]:
    return _cells(np.array([t.h, t.arm, t.radius, t.rod]), 4)


def _angles(t: Table2) -> tuple[str, ...]:
    return _cells(np.array([*t.alpha, *t.q0]), 4)


def _cells(values: Array, places: int) -> tuple[str, ...]:
    return tuple(number(float(v), places) for v in values)


def before_part(start: Before) -> Part:
    """[C] IV.C: 26 mm and 0.022 rad."""
    rows = (
        Row("The paper", (mm(BEFORE.shift, 0), number(BEFORE.turn, 3)), "paper"),
        Row("Found", (mm(start.shift, 1), number(start.turn, 4))),
    )
    return Part(
        "before",
        "The error before",
        (
            "How far the nacelle is off where the a priori parameters are used for the identified"
            " ones, in the machine's own frame, over the measured volume.",
        ),
        tables=(Table("Mean error with the a priori parameters", ("", "mm", "rad"), rows),),
    )


def table_3_part(s: Study) -> Part:
    """[C] Table 3."""
    rows: list[Row] = []
    for label, name, key in (
        ("Before", f"design, {DRAWING}", "before"),
        ("Model 12, eq. 3", f"design, {EQ3}", "design"),
        ("Model 31, eq. 5", f"calibration, {EQ5}", "calibration"),
    ):
        v = s.validation[name]
        mean = v.control_mean.mean(axis=0) if key == "before" else _rms(v.control_mean)
        for what, paper, ours in (
            ("mean", TABLE_3[key][0], mean),
            ("rms", TABLE_3[key][1], _rms(v.control_rms)),
        ):
            cells = tuple(_two(v) for v in paper)
            rows.append(Row(f"{label}, {what}: the paper", cells, "paper"))
            rows.append(Row("  found", tuple(_two(float(v)) for v in ours)))
    return Part(
        "table-3",
        "Table 3",
        (
            "What the inverse kinematics wants at the ten poses that were held back, less the"
            " readings. Before, at the true poses; after, at the measured ones, whose noise of"
            " 0.2 mm at an arm of 260 mm makes up nearly all of it. Means after are given as their"
            " root mean square over the runs: they have no sign of their own.",
            "The paper's residuals after are one and a half to three times as large as this noise"
            " explains, with Model 31 more than with Model 12. Something else was in them.",
        ),
        tables=(
            Table("Table 3: residuals of the motors, mrad", ("", "q₁", "q₂", "q₃", "q₄"),
                  tuple(rows)),
        ),
    )  # fmt: skip


def _two(value: float) -> str:
    """Radians as milliradians with two digits."""
    return f"{1e3 * value:.2g}".replace("-", "\N{MINUS SIGN}")


def table_4_part(s: Study) -> Part:
    """[C] Table 4 and the square."""
    rows: list[Row] = []
    for label, name, key in (
        ("Before", f"design, {DRAWING}", "before"),
        ("Model 12, eq. 3", f"design, {EQ3}", "design"),
        ("Model 31, eq. 5", f"calibration, {EQ5}", "calibration"),
        ("Model 31, joint", f"calibration, {JOINT}", ""),
    ):
        if key:
            one, two = TABLE_4[key]
            rows.append(Row(f"{label}: the paper", (mm(one, 2), mm(two, 2), "", ""), "paper"))
        found = _rms(s.validation[name].straightness)
        rows.append(
            Row(f"  found{'' if key else ', ' + label}", tuple(mm(float(v)) for v in found))
        )
    return Part(
        "table-4",
        "Table 4 and the square",
        (
            "The tool is led along a true line; poses by each machine's forward kinematics should"
            " lie on one. The paper does not tell how long its ruler was or where it lay: the"
            " error before grows as the square of its length, and 400 mm come near the paper's."
            " After the calibration, simulated lines are straight to hundredths of a millimetre,"
            " the paper's to half of one.",
            "The square of 100 mm is asked for by the inverse kinematics of the a priori and of the"
            " identified machine, and executed by the true one.",
        ),
        tables=(
            Table("Table 4: straightness, mm",
                  ("", "200 mm, x", "200 mm, y", "400 mm, x", "400 mm, y"), tuple(rows),
                  "The paper's two directions stand in the first two columns."),
            _square_table(s),
        ),
    )  # fmt: skip


def _square_table(s: Study) -> Table:
    """[C] IV.D."""
    old = mm(largest_side(s, f"design, {DRAWING}"), 2)
    rows = (
        Row("The paper", (mm(SQUARE_BEFORE, 0), "< 0.5"), "paper"),
        Row("Model 12, eq. 3", (old, mm(largest_side(s, f"design, {EQ3}")))),
        Row("Model 31, eq. 5", (old, mm(largest_side(s, f"calibration, {EQ5}")))),
    )
    return Table("Largest error of the square's sides, mm", ("", "before", "after"), rows)


def accuracy_part(s: Study) -> Part:
    """Every estimator's error over the workspace, beside the prototype's."""
    tables: list[Table] = []
    for kind, plans in PLAN.items():
        rows: list[Row] = []
        for name, methods in plans:
            for method in methods:
                a = s.accuracy[kind, name, method]
                chi2 = number(a.chi2, 2) if np.isfinite(a.chi2) else ""
                cells = (mm(a.shift), mm(a.turn), mm(a.larger_shift), mm(a.larger_turn), chi2)
                rows.append(Row(f"{MODELS[name]}, {LABELS[method]}", cells))
                known = PROTOTYPE.get((kind, name, method))
                if known:
                    told = tuple("" if v is None else f"{v:g}" for v in known)
                    rows.append(Row("  independent prototype", ("", "", *told, ""), "prototype"))
        columns = ("", "mm", "mrad", "mm*", "mrad*", "χ²")
        tables.append(Table(TRUTHS[kind], columns, tuple(rows), NOTE))
    return Part(
        "accuracy",
        "Accuracy over the workspace",
        (
            "Root mean square error of the tool, after base and tool frames are laid on the true"
            " ones, over the measured volume and over a workspace a quarter larger in every"
            " direction. The prototype, which shares no code with this program, does not name its"
            f" workspace; the one {LARGER:g} times as large fits its figures.",
            "The paper counts residuals of joints or lengths alike. Whitened by the pose's noise"
            " and with the two tilts that the nacelle cannot make, the same equations give what"
            " the joint estimate gives, without any forward kinematics.",
            "A model that is too poor for its machine shows in χ²: it asks for more than noise."
            " With rods the figures of Models 12 and 31 depend on how far the two rods of a forearm"
            " stand apart, 60 mm here, which the paper does not tell.",
        ),
        tables=tuple(tables),
    )


def axis_part(s: Study) -> Part:
    """[C] IV.B: the axis of rotation and its spread."""
    a = s.axis
    rows = (
        Row("The paper, standard deviation", (_deg(SPREAD, 2), ""), "paper"),
        Row("Pairs of poses, root mean square", (_deg(_mean(a.spread)), _deg(_mean(a.expected)))),
        Row("Single poses off the axis", (_deg(_mean(a.tilt)), _deg(2**0.5 * s.settings.turn))),
    )
    return Part(
        "axis",
        "The axis of rotation",
        (
            "The simulated machine has exactly four freedoms. The axes of the turns between two"
            " poses, ten degrees or more, spread all the same: a pose's noise of 0.03° is divided"
            " by the sine of half the turn. So the paper's 0.12° is what noise alone gives, and"
            " proves nothing. The test is χ² of all poses against one axis:"
            f" {number(float((a.chi2 / a.dof).mean()), 3)} per degree of freedom here.",
        ),
        tables=(Table("Spread of the axis, °", ("", "found", "by noise alone"), rows),),
    )


def _mean(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _deg(value: float, places: int = 3) -> str:
    return number(float(np.degrees(value)), places)


def ranks_part(s: Study) -> Part:
    """[C] III.C: what can be identified."""
    unknowns = {"design": 24, "calibration": 46}
    rows = [
        Row(f"{MODELS[name]}, {LABELS[method]}", (str(unknowns[name]), str(rank), str(count)))
        for (name, method), (rank, count) in s.ranks.items()
    ]
    return Part(
        "ranks",
        "What can be identified",
        (
            "Rank of the Jacobian with everything free, at poses without noise. Not told, whatever"
            " the data: the sum of the two heights z; d with the camera's y; with Model 31 a turn"
            " of all about z. Joint residuals alone do not tell how the board is tilted, full poses"
            " do. Where the axis is found beforehand, as the paper does, 19 and 36 unknowns are"
            " left, the paper's 36. Model 31 stands here with its first joint free as well, so"
            " with 46 unknowns for the paper's 43 and three frame choices more.",
        ),
        tables=(Table("Ranks", ("", "unknowns", "rank", "estimated"), tuple(rows)),),
    )


def how_part(s: Study) -> Part:
    """The setting, and what was chosen."""
    c = s.settings
    return Part(
        "how",
        "How it was computed",
        (
            f"{s.runs} runs, seed {s.seed}; a fifth as many with rods. 81 poses on a grid of"
            " 200 × 200 × 150 mm at −20, 0 and 20°, 71 drawn for calibration; board poses with"
            f" {mm(c.shift, 1)} mm and {_deg(c.turn, 2)}° of noise a component, readings with"
            f" {1e6 * c.joint_noise:.0f} µrad. The camera stands on the base and looks about along"
            " the axis of rotation. Model 31 truths differ from the drawing by"
            f" {mm(c.error, 0)} mm and {1e3 * c.axis_error:.0f} mrad. Machines with rods have arms"
            " and axes true in pairs, and rods that differ by 0.3 mm (standard deviation).",
            "Every estimate begins at the drawing with camera and board placed by the closed"
            " form from poses and readings; nothing of the truth is used.",
            "These errors are of noise and of what each model leaves out of the simulated machine."
            " Simulation cannot show what both leave out.",
        ),
    )
