"""[A] 4 in sections of a page: tables and plots of a study beside the paper's figures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.outcome import Part, Plot, Row, Table
from pkmcal.papers.axis_measurements import AxisNoise
from pkmcal.reproduce.paper_a_charts import LABELS, by_poses, figure_4
from pkmcal.reproduce.paper_a_expected import (
    AFTER,
    BEFORE,
    GROUP_NAMES,
    MEAN_ERRORS,
    PROTOTYPE,
    PROTOTYPE_EFFECTOR,
    PROTOTYPE_POSES,
    TABLE_1,
)
from pkmcal.reproduce.paper_a_methods import Thirty, thirty
from pkmcal.reproduce.paper_a_simulation import study_machine
from pkmcal.reproduce.paper_a_study import BOUND, DRAWING, JOINT, METHODS, PRINTED, Study
from pkmcal.wording import brief, number

if TYPE_CHECKING:
    from pkmcal.reproduce.paper_a_photographs import MeasuredNoise


def mm(value: float, places: int = 3) -> str:
    """Metres as millimetres without the unit."""
    return number(1e3 * value, places)


def deg(value: float, places: int = 4) -> str:
    """Radians as degrees without the sign."""
    return number(float(np.degrees(value)), places)


def table_1(measured: MeasuredNoise | None = None) -> Table:
    """[A] Table 1 and what the simulation takes; measured : the same on repeated photographs."""
    used = AxisNoise(images=3).sigma()
    printed = ("0.05 rad", "0.06 rad", "0.05 mm", "0.1 mm")
    rows = [
        Row("The paper, printed", printed, "paper"),
        Row("The paper, in degrees", _noise_cells(TABLE_1.sigma(), 2), "paper"),
        Row("Used: mean of three images", _noise_cells(used, 3)),
    ]
    if measured is not None:
        rows += [
            Row("Measured here, median leg", _noise_cells(measured.middle.sigma(), 2)),
            Row("Measured here, worst leg", _noise_cells(measured.bound.sigma(), 2)),
        ]
    title = "Table 1: standard deviations of a leg's axis"
    return Table(title, ("", "ψ", "θ", "x", "z"), tuple(rows))


def _noise_cells(sigma: Array, places: int) -> tuple[str, ...]:
    psi, theta, x, z = sigma.tolist()
    return (f"{deg(psi, places)}°", f"{deg(theta, places)}°",
            f"{mm(x, places)} mm", f"{mm(z, places)} mm")  # fmt: skip


def noise_part(measured: MeasuredNoise | None = None) -> Part:
    """[A] Table 1 and how it enters. measured : see :func:`table_1`."""
    return Part(
        "noise",
        "Table 1",
        (
            "How well one image of a leg tells its axis: ψ and θ are the angles of its direction in"
            " the image plane and towards the viewer, x and z the point of the axis with y = 0, in"
            " the camera's frame. The paper prints radians. It must mean degrees: 0.05 rad over a"
            " leg of 0.4 m would be 20 mm.",
            "The simulation adds these deviations, divided by √3 since the paper takes three images"
            " of each pose, to the four coordinates of every axis. The four steps take the axis"
            " as it is; the joint estimate takes it as the two edges that a leg around this axis"
            " would show, with the same noise.",
            *([_about(measured)] if measured else []),
        ),
        tables=(table_1(measured),),
    )


def _about(measured: MeasuredNoise) -> str:
    """What the measurement on photographs says of Table 1."""
    return (
        "Measured here: rendered photographs of 1024×768 pixels, six configurations from three"
        f" places some 1.1 m away, each taken five times. Edges scatter by {brief(measured.edge)}"
        " px. Still the axes scatter more than the paper's, towards the viewer above all: depth"
        " comes from the leg's apparent width alone, some 20 px. The joint estimate of photographs"
        " therefore takes the edges, never the axes."
    )


def figure_part(s: Study) -> Part:
    """[A] Fig. 4."""
    params = thirty(study_machine())
    return Part(
        "figure",
        "Fig. 4",
        (
            "Thirty parameters: the joint centres of base (A) and platform (B) in frames by the"
            " centres 1, 3 and 5, where six coordinates of each vanish, and the offsets (q).",
        ),
        (
            Plot(
                "errors",
                "True values and mean errors of the thirty parameters",
                "The scale of errors is logarithmic. As printed, every z keeps the error that the"
                " drawing had. Corrected, the four steps find all parameters; the joint estimate"
                " cannot be told from the bound.",
                "Bars of the mean error of thirty parameters by method, true values as a line",
                figure_4(params.names, params.drawing, s.mean_error),
                560,
                860,
            ),
        ),
        (_summary_of_errors(s, params), _all_errors(s, params)),
    )


def _summary_of_errors(s: Study, params: Thirty) -> Table:
    low, high = (mm(v, 2) for v in MEAN_ERRORS)
    rows = [Row("The paper", (low, "", high, "z"), "paper")]
    for method in METHODS:
        error = s.mean_error[method]
        worst = params.names[int(np.argmax(error))]
        cells = (mm(float(error.min())), mm(float(error.mean())), mm(float(error.max())), worst)
        rows.append(Row(_name(method), cells))
    return Table(
        "Mean |error| of the parameters, mm", ("", "smallest", "mean", "largest", "worst"),
        tuple(rows),
    )  # fmt: skip


def _all_errors(s: Study, params: Thirty) -> Table:
    rows = [
        Row(name, (mm(float(value), 1), *(mm(float(s.mean_error[m][k])) for m in METHODS)))
        for k, (name, value) in enumerate(zip(params.names, params.drawing, strict=True))
    ]
    columns = ("", "true value", *(_name(m) for m in METHODS))
    return Table("All thirty, mm", columns, tuple(rows), brief=False, folded=True)


def _name(method: str) -> str:
    text = LABELS[method]
    return text[:1].upper() + text[1:]


def effector_part(s: Study, narrow: Study) -> Part:
    """The end-effector, [A] eq. 20. narrow : with the other reading of the drawing's errors."""
    rows = [
        Row("The paper, before", (mm(BEFORE[0], 2), deg(BEFORE[1], 3), ""), "paper"),
        Row("The paper, after", (mm(AFTER[0], 2), deg(AFTER[1], 3), ""), "paper"),
    ]
    for method in METHODS:
        a = s.accuracy[method]
        cells = (mm(a.displacement), deg(a.orientation), mm(a.displacement_registered))
        rows.append(Row(_name(method), cells))
        e = s.error[method]
        cells = (mm(e.displacement), deg(e.orientation), mm(e.displacement_registered))
        rows.append(Row("  ± Monte-Carlo error", cells, "prototype"))
        if method in PROTOTYPE_EFFECTOR:
            move, turn = PROTOTYPE_EFFECTOR[method]
            rows.append(Row("  independent prototype", (f"{move:g}", f"{turn:g}", ""), "prototype"))
    return Part(
        "effector",
        "End-effector",
        (
            "Mean displacement and turn of the platform at ten random poses a run, by the"
            " estimated and by the true machine, equation 20. In frames that three joints define,"
            " these joints' own errors turn the frame; the last column lays the estimated machine"
            " on the true one by all its joints first.",
        ),
        tables=(
            Table(
                "Errors of the end-effector",
                ("", "mm", "°", "mm, all joints"),
                tuple(rows),
                "The paper's angles are printed in rad; degrees are meant, as in Table 1.",
            ),
            _readings_table(s, narrow),
        ),
    )


def _readings_table(wide: Study, narrow: Study) -> Table:
    """What the drawing's errors do, by the two readings of the paper."""
    z = np.char.endswith(np.array(thirty(study_machine()).names), "z")

    def row(name: str, s: Study) -> Row:
        a = s.accuracy
        depth = float(s.mean_error[PRINTED][z].mean())
        return Row(name, (mm(a[DRAWING].displacement, 2), mm(a[PRINTED].displacement, 2),
                          mm(depth, 2), mm(a[JOINT].displacement)))  # fmt: skip

    return Table(
        "Drawing errors: “uniform noise with variance equal to 2 mm”",
        ("", "drawing", "as printed", "its mean |z|", "joint"),
        (
            Row("The paper", (mm(BEFORE[0], 2), mm(AFTER[0], 2), "up to 1", ""), "paper"),
            row("Standard deviation 2 mm", wide),
            row("Within ± 2 mm", narrow),
        ),
        "End-effector, and mean |error| in z of the four steps as printed; mm.",
    )


def group_part(s: Study) -> Part:
    """RMSE by kind of parameter, beside the prototype's."""
    rows: list[Row] = []
    for method in METHODS:
        a, e = s.accuracy[method][:5], s.error[method][:5]
        rows.append(Row(_name(method), tuple(mm(v) for v in a)))
        rows.append(Row("  ± Monte-Carlo error", tuple(mm(v, 4) for v in e), "prototype"))
        if method in PROTOTYPE:
            cells = tuple(number(v, 3 if v < 1 else 2) for v in PROTOTYPE[method])
            rows.append(Row("  independent prototype", cells, "prototype"))
    return Part(
        "groups",
        "By kind of parameter",
        (
            "Root mean square errors over the runs, and their standard errors from the runs'"
            " scatter. The prototype shares no code with this program.",
        ),
        tables=(Table("RMSE, mm", ("", *GROUP_NAMES), tuple(rows)),),
    )


def poses_part(studies: dict[int, Study]) -> Part:
    """Accuracy by the number of poses a station."""
    joint = {n: (s.accuracy[JOINT], s.error[JOINT]) for n, s in studies.items()}
    bound = {n: s.accuracy[BOUND].displacement for n, s in studies.items()}
    rows = [
        Row(
            str(n),
            (mm(a.displacement, 4), mm(e.displacement, 4), mm(bound[n], 4),
             number(PROTOTYPE_POSES[n], 3)),
        )
        for n, (a, e) in joint.items()
    ]  # fmt: skip
    plot = Plot(
        "poses",
        "End-effector by the number of poses",
        "Joint estimate with two Monte-Carlo standard errors. Both axes are logarithmic.",
        "Displacement of the end-effector against poses a station",
        by_poses(
            {n: (1e3 * a.displacement, 1e3 * e.displacement) for n, (a, e) in joint.items()},
            {n: 1e3 * value for n, value in bound.items()},
            PROTOTYPE_POSES,
        ),
        380,
    )
    text = (
        "The same simulation with other numbers of poses a station. Independent measurements let"
        " errors fall as N to the power of −½; the first poses gain a little more, since few poses"
        " leave some combinations of parameters weakly known."
    )
    columns = ("poses a station", "found", "± Monte-Carlo", "bound", "prototype")
    title = "Displacement of the end-effector, joint estimate, mm"
    return Part("poses", "More poses", (text,), (plot,), (Table(title, columns, tuple(rows)),))


def how_part(s: Study, seed: int) -> Part:
    """The setting, and what was chosen."""
    c = s.settings
    return Part(
        "how",
        "How it was computed",
        (
            f"{s.runs} runs, seed {seed}. A Gough-Stewart platform; {c.poses} poses of"
            f" extreme leg lengths a station; three cameras, {c.distance:g} m from the middle and"
            f" {c.height:g} m high, the middle of the legs, that look level and see {c.legs_seen}"
            " legs each; readings with 3 µm of uniform noise. The paper does not tell where the"
            " cameras stood: the distance has no influence, the height has.",
            f"The joint estimate begins at the corrected four steps and takes"
            f" {number(float(s.steps.mean()), 1)} steps on average. The bound is the inverse of the"
            " information at the truth; its end-effector is that of errors drawn from it.",
            "These errors are of noise alone. Simulation cannot show what the model leaves out.",
        ),
    )
