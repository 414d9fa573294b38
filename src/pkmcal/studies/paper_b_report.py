"""Report on [B] V: Figs. 6 to 10, 12 mm and 8 mm, beside the paper's figures."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import apply, inverse, pose_difference, register
from pkmcal.outcome import Outcome, Part, Row, Table
from pkmcal.pages.plots import plane, trace
from pkmcal.studies.engine import StudyResult, run
from pkmcal.studies.paper_b import (
    CONTROLLED_POPULATION,
    HUBER_REGRESSION,
    LEAST_MEDIAN_REGRESSION,
    MIRROR_VIEW,
    PAPER_B_CASES,
    PAPER_B_JOINT,
    PAPER_B_VIEW_NAMES,
    PERSPECTIVE_VIEW,
    PLAIN_REGRESSION,
    POINT_NOISE,
    POINTS_FITTED_AN_EDGE,
    ROBUST_REGRESSION,
    SCALED_BY_RATIO,
    SCALED_BY_SIMILARITY,
    TUKEY_REGRESSION,
    HexapodByLegs,
    hexapod_with_cylinder_legs,
    views_by_name,
)
from pkmcal.studies.paper_b_control import (
    CONTROL_GOAL_READINGS,
    CONTROL_START_READINGS,
    E1,
    E2,
    ControlledHexapod,
    controlled_by_estimates,
)
from pkmcal.studies.paper_b_expected import (
    CAD_MEDIAN_ERROR,
    PAPER_B_PROTOTYPE,
    paper_b_checks,
    paper_b_figures,
)
from pkmcal.studies.reproduction import Column, Options, Words, accuracy_rows
from pkmcal.wording import number

PAPER_B_METHOD_LABELS = {
    PLAIN_REGRESSION: "least squares",
    HUBER_REGRESSION: "Huber",
    TUKEY_REGRESSION: "Tukey",
    LEAST_MEDIAN_REGRESSION: "least median",
    ROBUST_REGRESSION: "median, Tukey, EIV",
    SCALED_BY_RATIO: "eq. 16's scale",
    SCALED_BY_SIMILARITY: "similarity",
    PAPER_B_JOINT: "joint estimate",
}
VIEW_TABLE_TITLES = {MIRROR_VIEW: "Through the mirror", PERSPECTIVE_VIEW: "Before the camera"}
CASE_NAMES = {
    "right": "Right edges",
    "shifted": "0.1 px outside",
    "radius": "Radius 1 % wrong",
    **{f"{n} % wrong": f"{n} % wrong edges" for n in (5, 20, 35)},
}
PAPER_B_COLUMNS = [
    Column("centre", 3, 3),
    Column("depth", 3, 3),
    Column("pixel", 3, 3),
    Column("cad", 1, 1),
]
DRAWN_EDGE_POINTS = 9
"""Number of points of a plotted edge."""
DRAWN_ERROR_ENLARGEMENT = 10.0
"""Factor by which plotted errors are enlarged."""
EXAMPLE_RUNS = 0
"""Index of the run whose joints are plotted: the first, not the best."""
CONTROL_CURVE_STYLES = {
    "true": ("True geometry", "--quiet", "dot"),
    E1: ("E1: nominal model, fitted", "--good", "dash"),
    E2: ("E2: linear", "--drawing", "solid"),
    "hand": ("E3: by hand, 3 cm and 3°", "--calibrated", "solid"),
    "coarse": ("E3: 10 cm and 10°", "--leg7", "dash"),
}
PAPER_B_METHOD_COLOURS = {
    PLAIN_REGRESSION: "--quiet",
    HUBER_REGRESSION: "--leg1",
    TUKEY_REGRESSION: "--leg3",
    LEAST_MEDIAN_REGRESSION: "--leg4",
    ROBUST_REGRESSION: "--drawing",
    PAPER_B_JOINT: "--calibrated",
}

HexapodByLegsStudy = StudyResult[HexapodByLegs]


def reproduce(options: Options) -> Outcome:
    """Reproduce [B] V."""
    began = perf_counter()
    study = run(HexapodByLegs(), options.runs, options.seed, options.within(0.0, 0.9))
    options.progress("Control by the edges", 0.9)
    ran = controlled_by_estimates(
        study.values("centres", CONTROLLED_POPULATION, CONTROLLED_POPULATION, ROBUST_REGRESSION),
        options.seed,
    )
    return paper_b_outcome(study, ran, perf_counter() - began)


def paper_b_outcome(study: HexapodByLegsStudy, ran: ControlledHexapod, elapsed: float) -> Outcome:
    """Outcome of a study and the controlled runs. elapsed : duration of both in s."""
    words = _words(study, ran, elapsed)
    return words.reproduction(
        (
            words.part(
                "accuracy", *_tables(study), plots={"shares": {"figure": _share_plot(study)}}
            ),
            words.part("figure-6", plots={"mirror": _joints_plot(study, MIRROR_VIEW)}),
            _geometry_part(words, study),
            words.part("figure-8", plots={"camera": _joints_plot(study, PERSPECTIVE_VIEW, ran)}),
            words.part(
                "figure-9",
                plots={
                    name: _configuration_plot(ran, readings)
                    for name, readings in (
                        ("start", CONTROL_START_READINGS),
                        ("goal", CONTROL_GOAL_READINGS),
                    )
                },
            ),
            words.part(
                "figure-10",
                _control_table(ran),
                plots={
                    "error": {"figure": _error_plot(ran), "height": 380},
                    "beside": {"figure": _distance_plot(ran), "height": 320},
                },
            ),
            words.part("how"),
        ),
        checks=paper_b_checks(study, ran),
        remarks=("accuracy", "scale", "overshoot", "alike"),
        numbers=_numbers(study, ran, elapsed),
    )


def _words(s: HexapodByLegsStudy, ran: ControlledHexapod, elapsed: float) -> Words:
    """Text of the report with its values."""
    true, estimated = _joints(s, MIRROR_VIEW)
    project = views_by_name()[MIRROR_VIEW].camera.project
    project_controlled = ran.eye.camera.project
    by_hand = np.linalg.norm(
        project_controlled(ran.centres["hand"]) - project_controlled(ran.centres["true"]), axis=-1
    )
    astray = {
        f"{name}_astray": 1e3 * float(np.median(trial.astray)) for name, trial in ran.trials.items()
    }
    start, goal = ran.eye.true.machine.forward(
        np.array([CONTROL_START_READINGS, CONTROL_GOAL_READINGS])
    )
    motion = pose_difference(goal, start)
    return Words.of(
        "b",
        s,
        elapsed=elapsed,
        each=len(s.values("centre", MIRROR_VIEW, "right", ROBUST_REGRESSION)),
        controlled=len(ran.centres[E2]),
        points=POINTS_FITTED_AN_EDGE,
        noise=POINT_NOISE,
        mirror_pixel=float(np.linalg.norm(project(estimated) - project(true), axis=-1).max()),
        mirror_off=1e3 * float(np.linalg.norm(estimated - true, axis=-1).max()),
        hand_pixel=float(np.median(by_hand)),
        way=1e3 * float(np.linalg.norm(motion[3:])),
        way_tilt=float(np.degrees(np.linalg.norm(motion[:3]))),
        **astray,
    )


# ------------------------------------------------------------------ tables


def _tables(s: HexapodByLegsStudy) -> list[Table]:
    """Table for each camera."""
    out: list[Table] = []
    for view in PAPER_B_VIEW_NAMES:
        rows = [Row("The paper", ("", "", "", number(1e3 * CAD_MEDIAN_ERROR[view], 0)), "paper")]
        for case, setting in PAPER_B_CASES.items():
            for method in setting.methods:
                key, name = (
                    (view, case, method),
                    f"{CASE_NAMES[case]}: {PAPER_B_METHOD_LABELS[method]}",
                )
                rows += accuracy_rows(
                    s, key, name, PAPER_B_COLUMNS, PAPER_B_PROTOTYPE.get(key), errors=False
                )
        heads = ("", "mm", "depth, mm", "px", "nominal, mm")
        note = "Pictures of joints that have collapsed into the camera have no place."
        out.append(Table(VIEW_TABLE_TITLES[view], heads, tuple(rows), note))
    return out


def _control_table(ran: ControlledHexapod) -> Table:
    """Table of [B] Fig. 10."""
    rows = [
        Row(
            title,
            (
                f"{t.reached} of {len(t.runs.end)}",
                number(1e3 * float(np.median(t.astray)), 2),
                number(100 * float(t.overshoot.max()), 2),
                number(100 * float(t.rise.max()), 2),
                number(float(np.nanmedian(t.settling)), 1) if t.reached else "–",
            ),
        )
        for name, (title, _, _) in CONTROL_CURVE_STYLES.items()
        for t in [ran.trials[name]]
    ]
    heads = ("", "reached", "off its way, mm", "passed goal, %", "error rose, %", "settled, s")
    note = (
        "Off its way: the farthest from the way with the true geometry, median of the runs; passed"
        " goal and error rose: the largest; settled: within 2 % of the way, median."
    )
    return Table("What is believed of the base", heads, tuple(rows), note)


# ------------------------------------------------------------------ plots


def _joints(s: HexapodByLegsStudy, view: str, case: str = "shifted") -> tuple[Array, Array]:
    """True and linearly estimated base joints (L, 3) of the plotted run, camera frame, m."""
    key = (view, case, ROBUST_REGRESSION)
    return s.values("truth", *key)[EXAMPLE_RUNS], s.values("centres", *key)[EXAMPLE_RUNS]


def _share_plot(s: HexapodByLegsStudy) -> dict[str, Any]:
    """Plot of the error by the share of wrong edges, for the catadioptric camera."""
    data: list[dict[str, Any]] = []
    for method, colour in PAPER_B_METHOD_COLOURS.items():
        cases = {
            share: 1e3 * s.of(MIRROR_VIEW, case, method)["centre"].value
            for case, share in (("right", 0), ("5 % wrong", 5), ("20 % wrong", 20),
                                ("35 % wrong", 35))
            if method in PAPER_B_CASES[case].methods
        }  # fmt: skip
        curve = trace(PAPER_B_METHOD_LABELS[method], cases, cases.values(), colour)
        data.append({**curve, "hovertemplate": "%{y:.3g} mm with %{x} %"})
    layout = plane("wrong edges, %", "error of a joint, mm")
    layout["yaxis"] |= {"type": "log", "exponentformat": "power", "dtick": 1}
    return {"data": data, "layout": layout}


def _joints_plot(
    s: HexapodByLegsStudy, view: str, ran: ControlledHexapod | None = None
) -> dict[str, Any]:
    """Plots of [B] Figs. 6 and 8: joints in the image, and the nominal legs in the home pose.

    ran : source of the joints by a camera pose measured by hand; not plotted without it.
    """
    camera, T = views_by_name()[view]
    machine = hexapod_with_cylinder_legs()
    home = machine.home()
    ends = machine.ends_at(machine.inverse(home), home)
    along = ends.a[:, None] + np.linspace(0, 1, 25)[:, None] * (ends.b - ends.a)[:, None]
    pixels = camera.project(apply(T, along))
    gap = np.full((1, 2), np.nan)
    legs = np.concatenate([np.concatenate([leg, gap]) for leg in pixels])
    true, estimated = (camera.project(points) for points in _joints(s, view))
    data = [trace("legs at home", legs[:, 0], legs[:, 1], "--quiet", "lines")]
    if ran is None:
        data.append(_marks("true joints", true, "--ink", "x-thin", 11))
    else:
        data.append(_marks("true joints", true, "--ink", "circle", 4))
        # offset of the controlled machine's joints, applied to the true joints of this run
        off = camera.project(ran.centres["hand"][EXAMPLE_RUNS]) - camera.project(
            ran.centres["true"][EXAMPLE_RUNS]
        )
        data.append(_marks("by hand", true + off, "--calibrated", "x-thin", 11))
    data.append(_marks("estimated joints", estimated, "--drawing", "circle-open", 13))
    return _image_axes(camera.image_size, data)


def _image_axes(image_size: tuple[int, int], data: list[dict[str, Any]]) -> dict[str, Any]:
    """Plot with the axes of an image: framed, with y downwards."""
    width, height = image_size
    layout = plane("x, pixels", "y, pixels")
    framed = {"showline": True, "mirror": True, "constrain": "domain"}
    layout["xaxis"] |= {**framed, "range": [-0.5, width - 0.5]}
    layout["yaxis"] |= {**framed, "range": [height - 0.5, -0.5], "scaleanchor": "x"}
    return {"figure": {"data": data, "layout": layout}, "height": 500}


def _geometry_part(words: Words, s: HexapodByLegsStudy) -> Part:
    """Section on [B] Fig. 7."""
    nominal = hexapod_with_cylinder_legs().base_centers()
    sets: list[tuple[str, Array, str, str, float]] = [
        ("nominal model", nominal, "--ink", "square", 8)
    ]
    styles = (
        (MIRROR_VIEW, "--calibrated", "circle-open"),
        (PERSPECTIVE_VIEW, "--drawing", "diamond-open"),
    )
    for view, colour, symbol in styles:
        true, estimated = _joints(s, view)
        # the run's machine is replaced by the nominal one, so that only the method's errors are
        # plotted
        fitted = register(true, estimated)
        off = apply(inverse(fitted), estimated) - true
        turned = views_by_name()[view].T_camera_base[:3, :3]
        sets.append((view, nominal + DRAWN_ERROR_ENLARGEMENT * off @ turned, colour, symbol, 10))
    plots: dict[str, dict[str, Any]] = {}
    for name, axes in (("lateral", (0, 2)), ("top", (0, 1))):
        data = [
            _marks(title, points[:, axes], colour, symbol, size)
            for title, points, colour, symbol, size in sets
        ]
        layout = plane("xyz"[axes[0]] + ", m", "xyz"[axes[1]] + ", m")
        layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
        height = 300 if name == "lateral" else 420
        plots[name] = {"figure": {"data": data, "layout": layout}, "height": height}
    return words.part("figure-7", plots=plots)


def _configuration_plot(ran: ControlledHexapod, readings: Array) -> dict[str, Any]:
    """Plot of [B] Fig. 9: the camera's image at readings (m,), nearer legs in front of others."""
    machine, camera, T = ran.eye.true.machine, ran.eye.camera, ran.eye.true.T_camera_base
    pose = machine.forward(readings)
    edges = (
        ran.eye.points(pose[None], readings[None], DRAWN_EDGE_POINTS)
        .pixel[0]
        .reshape(-1, 2, DRAWN_EDGE_POINTS, 2)
    )
    ends = machine.ends_at(readings, pose)
    base, platform = apply(T, ends.a), apply(T, ends.b)
    data: list[dict[str, Any]] = []
    for leg in np.argsort(-(base + platform)[:, 2]):
        first, second = edges[ran.eye.true.legs.tolist().index(leg)]
        outline = np.concatenate([first, second[::-1], first[:1]])
        outline_trace = trace(
            f"leg {leg + 1}", outline[:, 0], outline[:, 1], f"--leg{leg + 1}", "lines"
        )
        data.append(
            {**outline_trace, "fill": "toself", "fillcolor": "--card", "legendrank": int(leg)}
        )
    x, y, _ = (machine.platform_centers() - machine.platform_centers().mean(axis=0)).T
    around = np.argsort(np.arctan2(y, x))
    ring = camera.project(platform)[[*around, around[0]]]
    data.append(trace("platform", ring[:, 0], ring[:, 1], "--ink", "lines"))
    data.append(_marks("base joints", camera.project(base), "--ink", "circle", 6))
    return _image_axes(camera.image_size, data)


def _error_plot(ran: ControlledHexapod) -> dict[str, Any]:
    """Plot of [B] Fig. 10: norm of e against time."""
    data: list[dict[str, Any]] = []
    for name, (title, colour, dash) in CONTROL_CURVE_STYLES.items():
        runs = ran.trials[name].runs
        share = np.median(runs.error / runs.error[:, :1], axis=0)
        style = {"color": colour, "dash": dash, "width": 2}
        data.append(trace(title, runs.time, np.maximum(share, 1e-5), colour, "lines", line=style))
    layout = plane("time, s", "error / error at the start")
    layout["yaxis"] |= {"type": "log", "exponentformat": "power", "dtick": 1}
    return {"data": data, "layout": layout}


def _distance_plot(ran: ControlledHexapod) -> dict[str, Any]:
    """Plot of the platform's distance from its path with the true geometry, against time."""
    ideal = ran.trials["true"].runs
    points = hexapod_with_cylinder_legs().platform_centers()
    there = apply(ideal.T_base_platform[:, :, None], points)
    data: list[dict[str, Any]] = []
    for name, (title, colour, dash) in CONTROL_CURVE_STYLES.items():
        here = apply(ran.trials[name].runs.T_base_platform[:, :, None], points)
        off = np.sqrt(np.mean(np.sum((here - there) ** 2, axis=-1), axis=-1))
        style = {"color": colour, "dash": dash, "width": 2}
        off_mm = 1e3 * np.median(off, axis=0)
        data.append(trace(title, ideal.time, off_mm, colour, "lines", line=style))
    return {"data": data, "layout": plane("time, s", "mm")}


def _marks(name: str, points: Array, colour: str, symbol: str, size: float) -> dict[str, Any]:
    style = {"color": colour, "size": size, "symbol": symbol, "line": {"color": colour, "width": 2}}
    return trace(name, points[:, 0], points[:, 1], colour, "markers", marker=style)


# ------------------------------------------------------------------ for programs


def _numbers(s: HexapodByLegsStudy, ran: ControlledHexapod, elapsed: float) -> dict[str, Any]:
    """Figures for programs, m, px and s."""
    return {
        "runs": s.runs,
        "seed": s.seed,
        "seconds": {"wall": elapsed, "solving": s.solving, "cpu": s.cpu, "workers": s.workers},
        "paper": {"from_drawing": CAD_MEDIAN_ERROR},
        "accuracy": [
            {
                **dict(zip(("view", "case", "method"), key, strict=True)),
                **{
                    q: _finite_or_none(s.of(*key)[q].value)
                    for q in ("centre", "depth", "cad", "pixel")
                },
                "centre_error": _finite_or_none(s.of(*key)["centre"].error),
                "runs": len(s.values("centre", *key)),
                "prototype": PAPER_B_PROTOTYPE.get(key, {}).get("centre"),
            }
            for key in s.samples
        ],
        "prototype": [
            {"key": f.key, "found": f.measured.value, "expected": f.expected, "held": f.held}
            for f in paper_b_figures(s)
        ],
        "control": {
            name: {
                "reached": t.reached,
                "runs": len(t.runs.end),
                "astray": float(np.median(t.astray)),
                "overshoot": float(t.overshoot.max()),
                "error_rise": float(t.rise.max()),
                "settling": _finite_or_none(float(np.nanmedian(t.settling))) if t.reached else None,
            }
            for name, t in ran.trials.items()
        },
    }


def _finite_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
