"""Study of visual servoing as an outcome, as in [B] Fig. 10: curves, an animation, the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers, rms
from pkmcal.control.sentences import chosen_legs, judgement
from pkmcal.control.study import Study, Trials
from pkmcal.geometry.outlines import ring
from pkmcal.geometry.rigid import inverse
from pkmcal.outcome import Figure, Outcome, Part, Plot, Row, Table, Verdict
from pkmcal.pages.page import N_COLOURS
from pkmcal.pages.plots import coordinates, line, markers, plane, space_layout
from pkmcal.wording import brief, number

MOST_CHOICES = 2
"""Listed sets of legs of each size."""
SERVO_ESTIMATE_COLOURS = {
    "true": "--quiet",
    "identified": "--drawing",
    "cad": "--good",
    "hand": "--calibrated",
}
SERVO_BAND_COLOURS = {"identified": "rgba(0,104,168,.16)", "hand": "rgba(194,72,12,.16)"}
ANIMATION_FRAMES = 60
"""Frames of the animation; more would only make the page large."""
SERVO_CURVE_POINTS = 300
"""Points of a curve."""
LEAST_SERVO_ERROR_SHARE = 1e-5
"""Lower limit of curves, as a share of the initial error."""
SERVO_EDGE_POINTS = 17
"""Points along a drawn edge; in a mirror edges are curved."""
SERVO_METHOD_TEXT = (
    "The camera measures the edges of one tube of each seen leg. The error is the cross product of"
    " what is seen and what was seen when the goal was taught: of the edges' normals, or of the"
    " legs' directions. The drives' rates are −gain · D N⁺ e, with the interaction matrix N and the"
    " inverse Jacobian D by the measured directions, the readings, and the base centres that the"
    " controller believes. The goal is taught by the true machine without noise, so a wrong"
    " geometry changes the way and not the end.",
    "The true machine follows its drives by forward kinematics. A run ends early where a drive"
    " leaves its range, the platform comes near a singular pose, or a leg leaves the image. A leg"
    " behind another one is measured all the same.",
)


def outcome_of(study: Study) -> Outcome:
    """Outcome of `pkmcal servo`."""
    verdict, run = judgement(study), example_run(study)
    document = servo_document(study, verdict)
    ends = ends_table(study)
    return Outcome(
        command="servo",
        title=f"Control by the legs of {study.scene.machine.name}",
        verdict=verdict,
        kicker="visual servoing, simulated",
        subject=study.scene.origin,
        stamp="It works in simulation" if verdict.usable else "Not to be used",
        figures=servo_cards(study),
        parts=(
            Part(
                "curves",
                "Error curves",
                terminal_text=(stillness(study),),
                plots=(
                    Plot(
                        "curves",
                        f"Error of the {study.plan.loop.law}, as a part of its start's",
                        "Lines: the median; shaded: from the least to the largest; of runs that"
                        " reach the goal. Logarithmic, so that an exponential is a straight line;"
                        " [B] Fig. 10 for one run.",
                        "Norm of the error against time for four estimates of the geometry",
                        curves(study),
                        height=420,
                    ),
                    Plot(
                        "tail",
                        "The end of the ways, platform's joints from the goal",
                        "Distance of the platform's joints from the goal, as a part of the way,"
                        " median of runs that reach it.",
                        "Distance from the goal against time, enlarged near zero",
                        tail(study),
                        height=320,
                    ),
                ),
                tables=(outcome_table(study), *([ends] if ends else [])),
            ),
            Part(
                "run",
                "One run",
                plots=(
                    Plot(
                        "space",
                        f"Run {run + 1} in space",
                        "The true machine, led by the identified geometry; dashed: the goal; grey:"
                        " the way of the platform's middle with the identified geometry, orange"
                        " with the one by hand.",
                        "The machine in three dimensions on its way to the goal",
                        space(study, run),
                        height=560,
                        frames=frames(study, run),
                    ),
                    Plot(
                        "image",
                        f"Run {run + 1} in the image",
                        "Edges of the seen legs at the start (thin) and at the goal (thick), and"
                        " the way of their ends between; the frame is the image's.",
                        "The legs' edges in the camera's image and their ways from start to goal",
                        image(study, run),
                        height=520,
                    ),
                ),
            ),
            Part("legs", "Legs", tables=(choices_table(study),)),
            Part("how", "How it was computed", SERVO_METHOD_TEXT, tables=(settings_table(study),)),
        ),
        findings=study.scene.findings,
        document=document,
        summary={name: value for name, value in document.items() if name != "curves"},
    )


def stillness(s: Study) -> str:
    """Sentence on the platform's motion when held at the goal."""
    position, turn = rms(s.held.position), rms(s.held.turn)
    image_position, image_turn = rms(s.image.position), rms(s.image.turn)
    if not position > 0:
        return "The edges are without noise."
    return (
        f"Held at its goal, noise of {s.plan.loop.noise.shift:g} px moves the platform by"
        f" {brief(1e3 * position)} mm and {brief(np.rad2deg(turn))}° (root mean square);"
        f" one image alone is good to {brief(1e3 * image_position)} mm and"
        f" {brief(np.rad2deg(image_turn))}°."
    )


def servo_document(s: Study, verdict: Verdict) -> dict[str, Any]:
    """Study as plain data: m, rad, s; legs count from 1."""
    return {
        "machine": s.scene.machine.name,
        "origin": s.scene.origin,
        "station": s.scene.station,
        "usable": verdict.usable,
        "headline": verdict.headline,
        "reasons": verdict.reasons,
        "warnings": (*(one.text for one in s.scene.findings), *verdict.warnings),
        "advice": verdict.advice,
        "findings": [one.document() for one in verdict.findings],
        "settings": _settings(s),
        "estimates": {o.estimate.name: _outcome_document(o) for o in s.outcomes},
        "stillness": {
            "position": rms(s.held.position),
            "turn": rms(s.held.turn),
            "one_image_position": rms(s.image.position),
            "one_image_turn": rms(s.image.turn),
        },
        "hidden": dict(zip([str(j + 1) for j in s.eye.true.legs], s.hidden, strict=True)),
        "visibility": {
            "legs": [
                {"legs": [j + 1 for j in c.legs], "worst": c.worst, "usual": c.usual}
                for c in s.choices
            ],
        },
        "equilibria": {
            "reached": s.equilibria.reached,
            "alike": s.equilibria.same_image,
            "cancelled": s.equilibria.cancelled,
            "outside": s.equilibria.out,
            "distance": s.equilibria.distance,
            "looks_alike": s.equilibria.same_edges,
            "T_base_platform": s.equilibria.T_base_platform,
        },
        "curves": {
            "time": s.outcomes[0].runs.time,
            **{o.estimate.name: np.median(shares(o, o.runs.error), axis=0) for o in s.outcomes},
        },
    }


def example_run(study: Study) -> int:
    """Index of the run that is drawn.

    Of the runs in which all estimates reach the goal, the one in which the estimate by hand strays
    farthest from the path.
    """
    everywhere = np.all([o.runs.reached for o in study.outcomes], axis=0)
    return int(np.argmax(np.where(everywhere, study.trials("hand").astray, -1.0)))


def servo_cards(s: Study) -> tuple[Figure, ...]:
    """Main numbers."""
    good, hand = s.trials("identified"), s.trials("hand")
    n = s.plan.runs
    return (
        Figure(
            "How many runs reach their goal?",
            ((f"{good.reached}", f"of {n}"),),
            f"with the identified geometry; by hand {hand.reached}",
        ),
        Figure(
            "How fast?",
            ((_seconds(good), "s"),),
            f"until the platform stays within 2 % of its way, median; by hand {_seconds(hand)} s,"
            f" an exponential {np.log(50) / s.plan.loop.gain:.1f} s",
        ),
        Figure(
            "How far does it leave its way?",
            ((_mm(good.astray, good), "mm"),),
            f"at most, median of the runs, beside the way with the true geometry; by hand"
            f" {_mm(hand.astray, hand)} mm, and {_mm(hand.astray, hand, np.max)} mm in the worst",
        ),
        Figure(
            "Does it pass its goal?",
            ((_percent(good.overshoot, good), "%"),),
            f"of the way, the farthest of all runs; by hand {_percent(hand.overshoot, hand)} %",
        ),
        Figure(
            "How still is it held?",
            (
                (_magnitude(1e3 * rms(s.held.position)), "mm"),
                (_magnitude(float(np.rad2deg(rms(s.held.turn)))), "°"),
            ),
            f"root mean square, noise of {s.plan.loop.noise.shift:g} px an edge",
        ),
    )


def outcome_table(study: Study) -> Table:
    """Table with a row for each estimate."""
    rows = [
        Row(
            o.estimate.title,
            (
                f"{o.reached} of {len(o.runs.end)}",
                _mm(o.astray, o),
                _mm(o.astray, o, np.max),
                _percent(o.overshoot, o),
                _percent(o.rise, o),
                _seconds(o),
            ),
        )
        for o in study.outcomes
    ]
    return Table(
        "Estimates of the geometry",
        (
            "Geometry",
            "Reached",
            "Off its way, mm",
            "at most",
            "Passed goal, %",
            "Error rose, %",
            "Settled, s",
        ),
        tuple(rows),
        "Off its way: how far the platform's joints were from the way that they take with the true"
        " geometry, median and largest of the runs. Passed goal: part of its way by which the"
        " platform was beyond the goal, and error rose, the rise of the error's norm above an"
        " earlier value: the largest."
        " Settled: within 2 % of the way for good, median. All of runs that reached the goal.",
    )


def ends_table(study: Study) -> Table | None:
    """Table of how failed runs ended; None without failed runs."""
    kinds = {end for o in study.outcomes for end in o.ends if not end.good}
    if not kinds:
        return None
    rows = [
        Row(end.sentence, tuple(str(o.ends.get(end, 0)) for o in study.outcomes))
        for end in sorted(kinds, key=lambda end: end.word)
    ]
    columns = ("How the others ended", *(o.estimate.title for o in study.outcomes))
    return Table("Runs that did not reach their goal", columns, tuple(rows), brief=False)


def choices_table(s: Study) -> Table:
    """Table of the sets of legs that have to be observed."""
    useful = [c for c in s.choices if not c.blind]
    sizes = sorted({len(c.legs) for c in useful})
    listed = [c for n in sizes for c in [c for c in useful if len(c.legs) == n][:MOST_CHOICES]]
    if s.own not in listed:
        listed = [s.own, *listed]
    rows = [
        Row(
            chosen_legs(c, s) + (", as seen" if c == s.own else ""),
            (number(c.worst, 5), number(c.usual, 5), "no" if c.blind else "hardly, at some poses"
             if c.fading else "yes"),
        )
        for c in listed
    ]  # fmt: skip
    return Table(
        f"Which legs must be seen, by their {s.plan.loop.law}",
        ("Legs", "Visibility, worst pose", "usual", "Every motion seen"),
        tuple(rows),
        "Visibility: the smallest singular value of the interaction matrix as a part of its"
        " largest, at poses all over the workspace; the two best choices of each number. Fewer legs"
        " do not show every motion.",
        brief=False,
    )


def settings_table(study: Study) -> Table:
    """Table of the simulation's settings."""
    s, units = _settings(study), dict.fromkeys(study.eye.true.machine.joint_units)
    s |= {
        "hand_position": 1e3 * s["hand_position"],
        "hand_rotation": float(np.degrees(s["hand_rotation"])),
    }
    names = {
        "law": "Control by",
        "legs": "Legs seen",
        "gain": "Gain, 1/s",
        "rate": "Images a second",
        "delay": "Delay, images",
        "noise": "Noise of an edge, px",
        "joint_noise": f"Noise of a reading, {' or '.join(units)}",
        "speed": f"Fastest drive, {' or '.join(f'{unit}/s' for unit in units)}",
        "duration": "Time of a run, s",
        "hand_position": "Camera's place by hand, off by mm",
        "hand_rotation": "and by °",
        "runs": "Runs of every estimate",
        "seed": "Seed",
    }
    rows = [Row(name, (_run_words(s[key]),)) for key, name in names.items()]
    return Table("What was simulated", ("Setting", "Value"), tuple(rows), brief=False)


def _run_words(value: Any) -> str:
    """Setting as text."""
    if isinstance(value, list):
        return ", ".join(str(item) for item in value)
    return (
        "no limit" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    )


def _settings(s: Study) -> dict[str, Any]:
    """Settings as plain data."""
    loop, plan = s.plan.loop, s.plan
    return {
        "law": loop.law,
        "legs": [int(j) + 1 for j in s.eye.true.legs],
        "gain": loop.gain,
        "rate": loop.rate,
        "delay": loop.delay,
        "noise": loop.noise.shift,
        "joint_noise": loop.joint_noise,
        "speed": None if loop.speed is None else float(loop.speed[0]),
        "duration": loop.duration,
        "hand_position": plan.hand_position,
        "hand_rotation": plan.hand_rotation,
        "runs": plan.runs,
        "seed": plan.seed,
    }


def _outcome_document(o: Trials) -> dict[str, Any]:
    """Runs of one estimate as plain data."""
    return {
        "title": o.estimate.title,
        "reached": o.reached,
        "ends": {end.word: n for end, n in o.ends.items()},
        "astray_median": _statistic(o.astray, o, np.median),
        "astray_largest": _statistic(o.astray, o, np.max),
        "overshoot_median": _statistic(o.overshoot, o, np.median),
        "overshoot_largest": _statistic(o.overshoot, o, np.max),
        "error_rise_largest": _statistic(o.rise, o, np.max),
        "settling_median": _settled(o),
        "runs": [
            {"end": end.word, "way": sense, "astray": off, "overshoot": over, "settling": settling}
            for end, sense, off, over, settling in zip(
                o.runs.end, o.runs.travel[:, 0], o.astray, o.overshoot, o.settling, strict=True
            )
        ],
    }


def _statistic(values: Any, o: Trials, of: Callable[[Any], Any]) -> float | None:
    """Statistic over the runs that reached the goal, None without any."""
    good = values[o.runs.reached]
    return float(of(good)) if good.size else None


def _percent(values: Any, o: Trials) -> str:
    """Largest value over the runs that reached the goal, as a percentage."""
    value = _statistic(values, o, np.max)
    return "–" if value is None else brief(100 * value) if value > 5e-4 else "0"


def _mm(values: Array, o: Trials, of: Callable[[Any], Any] = np.median) -> str:
    """Statistic in m over the runs that reached the goal, as millimetres."""
    value = _statistic(values, o, of)
    return "–" if value is None else _magnitude(1e3 * value)


def _settled(o: Trials) -> float | None:
    """Median settling time (s) of the runs that came to rest at the goal, None without any."""
    finite = o.settling[np.isfinite(o.settling)]
    return float(np.median(finite)) if finite.size else None


def _seconds(o: Trials) -> str:
    """Settling time in words."""
    time = _settled(o)
    return "–" if time is None else f"{time:.1f}"


def _magnitude(value: float) -> str:
    """Magnitude with two digits, or 0."""
    return brief(value) if value > 0 else "0"


# ------------------------------------------------------------------ against time


def shares(o: Trials, values: Array) -> Array:
    """Values (R, K) relative to the start, of the runs that reached the goal.

    Of all runs if none did.
    """
    rows = o.runs.reached if o.reached else np.ones(len(values), dtype=bool)
    return values[rows] / np.maximum(values[rows, :1], 1e-300)


def _sample_rows(samples: int, most: int) -> Integers:
    """Indices of at most ``most`` samples at equal distances."""
    return np.unique(np.linspace(0, samples - 1, min(samples, most)).round().astype(int))


def _significant(values: Array, digits: int = 4) -> list[float]:
    """Numbers with so many significant digits."""
    return [float(f"{v:.{digits}g}") for v in values]


def curves(s: Study) -> dict[str, Any]:
    """Plot of the error's norm against time, a line and a band for each estimate."""
    data: list[dict[str, Any]] = []
    time = s.outcomes[0].runs.time
    rows = _sample_rows(len(time), SERVO_CURVE_POINTS)
    for o in s.outcomes:
        values = np.maximum(shares(o, o.runs.error)[:, rows], LEAST_SERVO_ERROR_SHARE)
        name = o.estimate.name
        if name in SERVO_BAND_COLOURS:
            data.append(_band(time[rows], values, SERVO_BAND_COLOURS[name], name))
    for o in s.outcomes:
        values = np.maximum(
            np.median(shares(o, o.runs.error)[:, rows], axis=0), LEAST_SERVO_ERROR_SHARE
        )
        data.append(_curve(o, time[rows], values, "%{y:.2g} after %{x:.2f} s"))
    layout = plane("time, s", "error / error at the start")
    layout["yaxis"] |= {"type": "log", "exponentformat": "power", "dtick": 1}
    return {"data": data, "layout": layout, "config": {}}


def tail(s: Study) -> dict[str, Any]:
    """Plot of the distance from the goal as a share of the path, enlarged near zero."""
    data: list[dict[str, Any]] = []
    time = s.outcomes[0].runs.time
    rows = _sample_rows(len(time), SERVO_CURVE_POINTS)
    for o in s.outcomes:
        values = 100 * np.median(shares(o, o.runs.travel)[:, rows], axis=0)
        data.append(_curve(o, time[rows], values, "%{y:.2f} % after %{x:.2f} s"))
    layout = plane("time, s", "% of the way")
    layout["yaxis"] |= {"range": [0, 10]}
    return {"data": data, "layout": layout, "config": {}}


def _curve(o: Trials, time: Array, values: Array, hover: str) -> dict[str, Any]:
    """Trace of an estimate."""
    dash = {"true": "dot", "cad": "dash"}.get(o.estimate.name, "solid")
    style = {"color": SERVO_ESTIMATE_COLOURS[o.estimate.name], "width": 2.5, "dash": dash}
    entries = {"hoverinfo": "all", "hovertemplate": hover}
    return _line_trace(o.estimate.title, _significant(time), _significant(values), style, **entries)


def _line_trace(name: str, x: Any, y: Any, style: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Trace of a line in the plane."""
    plain = {"type": "scatter", "mode": "lines", "name": name, "x": x, "y": y}
    return {**plain, "line": style, "hoverinfo": "skip", **more}


def _band(time: Array, values: Array, colour: str, name: str) -> dict[str, Any]:
    """Trace of the band between the smallest and the largest of all runs."""
    both = np.concatenate([time, time[::-1]])
    edge = np.concatenate([values.max(axis=0), values.min(axis=0)[::-1]])
    fill = {"fill": "toself", "fillcolor": colour, "showlegend": False}
    return _line_trace(
        f"{name}, all runs", _significant(both), _significant(edge), {"width": 0}, **fill
    )


# ------------------------------------------------------------------ in space


def _limbs(s: Study, poses: Array) -> tuple[Array, Array]:
    """Ends A and B (n, L, 3) of the true limbs at poses (n, 4, 4), m."""
    machine = s.eye.true.machine
    ends = machine.ends_at(np.nan_to_num(machine.inverse(poses)), poses)
    return np.broadcast_to(ends.a, ends.b.shape), ends.b


def _moving(s: Study, pose: Array) -> list[dict[str, Any]]:
    """Coordinates of the moving traces: each leg, then the platform."""
    a, b = (v[0] for v in _limbs(s, pose[None]))
    legs = (coordinates([np.stack(ends)]) for ends in zip(a, b, strict=True))
    return [dict(leg) for leg in legs] + [dict(coordinates([ring(b)]))]


def space(s: Study, run: int) -> dict[str, Any]:
    """Plot of the machine on its path.

    Moving traces come first, so that frames refer to them by index.
    """
    runs = s.trials("identified").runs
    start, goal = runs.T_base_platform[run, 0], runs.goals[run]
    observed = set(s.eye.true.legs.tolist())
    # moving traces: observed legs in their colours, then the platform
    *legs, platform = _moving(s, start)
    data = [
        line(
            f"leg {j + 1}" + ("" if j in observed else ", not seen"),
            f"--leg{j % N_COLOURS + 1}" if j in observed else "--quiet",
            8 if j in observed else 4,
            (),
            **leg,
        )
        for j, leg in enumerate(legs)
    ]
    data.append(line("platform", "--ink", 6, (), **platform))
    # static traces: base, goal, paths and camera
    a, b = (v[0] for v in _limbs(s, goal[None]))
    data.append(line("base", "--muted", 3, [ring(a)], showlegend=False))
    dashed = line("goal", "--ink", 2, [ring(b)])
    dashed["line"]["dash"] = "dash"
    data.append(dashed)
    for name, colour in (("identified", "--muted"), ("hand", "--calibrated")):
        o = s.trials(name)
        poses = o.runs.T_base_platform[run][_sample_rows(len(o.runs.time), ANIMATION_FRAMES)]
        middle = _limbs(s, poses)[1].mean(axis=1)
        data.append(line(f"way, {o.estimate.title.lower()}", colour, 5, [middle]))
    camera = markers(
        "camera",
        inverse(s.eye.true.T_camera_base)[None, :3, 3],
        {"size": 5, "color": "--ink", "symbol": "square"},
        mode="markers+text",
        text=["camera"],
        textposition="top center",
        textfont={"color": "--ink", "size": 12},
        hoverinfo="skip",
        showlegend=False,
    )
    layout = space_layout({"x": 1.3, "y": -1.3, "z": 0.7}) | {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 70},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
        "updatemenus": [_player()],
    }
    return {"data": [*data, camera], "layout": layout, "config": {"scrollZoom": True}}


def frames(s: Study, run: int) -> tuple[dict[str, Any], ...]:
    """Frames of the animation of :func:`space`."""
    runs = s.trials("identified").runs
    out: list[dict[str, Any]] = []
    for row in _sample_rows(int(runs.last[run]) + 1, ANIMATION_FRAMES):
        moving = _moving(s, runs.T_base_platform[run, row])
        out.append(
            {
                "name": f"{runs.time[row]:.2f} s",
                "data": [{"type": "scatter3d", **trace} for trace in moving],
                "traces": list(range(len(moving))),
            }
        )
    return tuple(out)


def _player() -> dict[str, Any]:
    """Buttons of the animation."""
    still = {"transition": {"duration": 0}}
    play = {"frame": {"duration": 60, "redraw": True}, "fromcurrent": True, **still}
    pause = {"frame": {"duration": 0, "redraw": False}, "mode": "immediate", **still}
    return {
        "type": "buttons",
        "direction": "left",
        "x": 0,
        "y": 0,
        "xanchor": "left",
        "yanchor": "top",
        "pad": {"t": 14},
        "showactive": False,
        "bgcolor": "--card",
        "bordercolor": "--quiet",
        "buttons": [
            {"label": "▶ Play", "method": "animate", "args": [None, play]},
            {"label": "❚❚ Pause", "method": "animate", "args": [[None], pause]},
        ],
    }


# ------------------------------------------------------------------ in the image


def image(s: Study, run: int) -> dict[str, Any]:
    """Plot of edges at start and goal, paths of their ends, and the border of the image."""
    width, height = s.eye.camera.image_size
    right, bottom = width - 0.5, height - 0.5
    x, y = [-0.5, right, right, -0.5, -0.5], [-0.5, -0.5, bottom, bottom, -0.5]
    data = [_line_trace("image", x, y, {"color": "--muted", "width": 1.5}, showlegend=False)]
    runs = s.trials("identified").runs
    first, goal = runs.T_base_platform[run, :1], runs.goals[run : run + 1]
    data += _edges(s, first, 1.2, "at the start", "dot")
    data += _edges(s, goal, 2.6, "at the goal", "solid")
    data += _end_paths(s, run, "identified", "solid")
    data += _end_paths(s, run, "hand", "dash")
    layout = plane("x, pixels", "y, pixels")
    layout["xaxis"] |= {"range": [-0.04 * width, 1.04 * width], "constrain": "domain"}
    layout["yaxis"] |= {"range": [1.04 * height, -0.04 * height], "constrain": "domain"}
    layout["yaxis"] |= {"scaleanchor": "x"}
    return {"data": data, "layout": layout, "config": {}}


def _pixels(s: Study, poses: Array, places: int) -> Array:
    """Pixels (n, E, places, 2) along the edges of the observed legs."""
    machine = s.eye.true.machine
    return s.eye.points(poses, np.nan_to_num(machine.inverse(poses)), places).pixel


def _edges(s: Study, pose: Array, width: float, name: str, dash: str) -> list[dict[str, Any]]:
    """Traces of the edges at a pose."""
    pixels = _pixels(s, pose, SERVO_EDGE_POINTS)[0]
    return [
        _line_trace(
            f"edges {name}",
            _pixel_list(pixels[e, :, 0]),
            _pixel_list(pixels[e, :, 1]),
            {"color": f"--leg{int(leg) % N_COLOURS + 1}", "width": width, "dash": dash},
            legendgroup=name,
            showlegend=e == 0,
        )
        for e, leg in enumerate(s.eye.tubes.leg)
    ]


def _end_paths(s: Study, run: int, name: str, dash: str) -> list[dict[str, Any]]:
    """Traces of the paths of both ends of each leg's first edge."""
    o = s.trials(name)
    poses = o.runs.T_base_platform[run][_sample_rows(len(o.runs.time), ANIMATION_FRAMES)]
    pixels, gap = _pixels(s, poses, 3), np.full((1, 2), np.nan)
    data: list[dict[str, Any]] = []
    for e in range(0, len(s.eye.tubes.leg), 2):
        ways = np.concatenate([pixels[:, e, 0], gap, pixels[:, e, -1]])
        data.append(
            _line_trace(
                f"way, {o.estimate.title.lower()}",
                _pixel_list(ways[:, 0]),
                _pixel_list(ways[:, 1]),
                {"color": SERVO_ESTIMATE_COLOURS[name], "width": 1.6, "dash": dash},
                legendgroup=f"way {name}",
                showlegend=e == 0,
            )
        )
    return data


def _pixel_list(values: Array) -> list[float | None]:
    """Pixels with one decimal, None for NaN."""
    return [round(float(v), 1) if np.isfinite(v) else None for v in values]
