"""Plots of a study of visual servoing: errors against time, one run in space and in the image."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.control.study import Study, Trials
from pkmcal.geometry.outlines import ring
from pkmcal.geometry.rigid import inverse
from pkmcal.outcome.blocks.base import leg_key
from pkmcal.outcome.blocks.plot import (
    Box,
    BoxesMark,
    Colour,
    LineMark,
    Plot,
    PlotAxis,
    category_axis,
    leg_colour,
    line_points,
    linear_axis,
    linear_ticks,
    log_axis,
    quantiles,
)
from pkmcal.outcome.blocks.space import Space, SpacePath
from pkmcal.report.space import chosen, space_poses
from pkmcal.web.motion import Postures
from pkmcal.web.stage import leg_rows, line, machine_shape
from pkmcal.wording import brief

ESTIMATE_COLOURS: dict[str, Colour] = {
    "true": "quiet",
    "identified": "nominal",
    "cad": "good",
    "hand": "calibrated",
}
EXTREMES_OF = ("identified", "hand")
"""Estimates whose least and largest values are drawn."""
ANIMATION_FRAMES = 60
"""Frames of the animation; more would only make the page large."""
SERVO_CURVE_POINTS = 300
"""Points of a curve."""
LEAST_SERVO_ERROR_SHARE = 1e-5
"""Lower limit of curves, as a share of the initial error."""
TAIL_PER_CENT = 10.0
"""Upper limit of the plot of the ends, per cent of the way."""
SERVO_EDGE_POINTS = 17
"""Points along a drawn edge; in a mirror edges are curved."""
IMAGE_MARGIN = 0.05
"""Free part of the plot of the image around the edges, at each side."""


def shares(o: Trials, values: Array) -> Array:
    """Values (R, K) relative to the start, of the runs that reached the goal.

    Of all runs if none did.
    """
    rows = o.runs.reached if o.reached else np.ones(len(values), dtype=bool)
    return values[rows] / np.maximum(values[rows, :1], 1e-300)


# ------------------------------------------------------------------ against time


def astray_plot(s: Study) -> Plot | None:
    """Largest distance of each run from the way with the true geometry; None without runs."""
    boxes: list[Box] = []
    for o in s.outcomes:
        values = o.astray[o.runs.reached] * 1e3
        if o.estimate.name == "true" or not values.size:
            continue
        tip = f"{o.estimate.title}: median {brief(float(np.median(values)))} mm"
        boxes.append(
            Box(
                at=o.estimate.title,
                quantiles=quantiles(values.tolist()),
                tip=tip,
                colour=ESTIMATE_COLOURS[o.estimate.name],
            )
        )
    if not boxes:
        return None
    return Plot(
        name="astray",
        title="How far the platform leaves its way",
        caption="Largest distance of the platform's joints from the way with the true geometry, of"
        " the runs that reach the goal: the middle half as a bar, nine tenths as a line.",
        alt="Distances from the way in millimetres; the table below has medians and largest values",
        x=linear_axis("off the way, mm", [q for box in boxes for q in box.quantiles], zero=True),
        y=category_axis([box.at for box in boxes]),
        marks=(BoxesMark(boxes=tuple(boxes)),),
    )


def error_plot(s: Study) -> Plot:
    """Norm of the error against time, of each estimate."""
    time = s.outcomes[0].runs.time
    rows = chosen(len(time), SERVO_CURVE_POINTS)
    values = [
        np.maximum(shares(o, o.runs.error)[:, rows], LEAST_SERVO_ERROR_SHARE) for o in s.outcomes
    ]
    marks = [
        mark for o, v in zip(s.outcomes, values, strict=True) for mark in _lines(o, time[rows], v)
    ]
    return Plot(
        name="curves",
        title=f"Error of the {s.plan.loop.law}, as a part of its start's",
        caption="The median of the runs that reach the goal; of the identified geometry and the one"
        " by hand, dashed: the least and the largest. Logarithmic, so that an exponential is a"
        " straight line; [B] Fig. 10 for one run.",
        alt="Norm of the error against time for four estimates of the geometry",
        x=linear_axis("time, s", time),
        y=log_axis("error / error at the start", np.concatenate([v.ravel() for v in values])),
        marks=tuple(marks),
    )


def _lines(o: Trials, time: Array, values: Array) -> list[LineMark]:
    """Median of values (R, K), and their extremes where they are drawn."""
    name, colour = o.estimate.name, ESTIMATE_COLOURS[o.estimate.name]
    extremes = (values.min(axis=0), values.max(axis=0)) if name in EXTREMES_OF else ()
    out = [
        LineMark(name="", colour=colour, points=line_points(time, v), dashed=True) for v in extremes
    ]
    middle = line_points(time, np.median(values, axis=0))
    return [*out, LineMark(name=o.estimate.title, colour=colour, points=middle)]


def tail_plot(s: Study) -> Plot:
    """Distance from the goal as a share of the path, enlarged near zero."""
    time = s.outcomes[0].runs.time
    rows = chosen(len(time), SERVO_CURVE_POINTS)
    marks: list[LineMark] = []
    for o in s.outcomes:
        values = 100 * np.median(shares(o, o.runs.travel)[:, rows], axis=0)
        first = max(int(np.argmax(values <= TAIL_PER_CENT)) - 1, 0)
        marks.append(
            LineMark(
                name=o.estimate.title,
                colour=ESTIMATE_COLOURS[o.estimate.name],
                points=line_points(time[rows][first:], values[first:]),
            )
        )
    return Plot(
        name="tail",
        title="The end of the ways, platform's joints from the goal",
        caption="Distance of the platform's joints from the goal, as a part of the way, median of"
        " runs that reach it.",
        alt="Distance from the goal against time, enlarged near zero",
        x=linear_axis("time, s", time),
        y=linear_axis("% of the way", (0.0, TAIL_PER_CENT), zero=True),
        marks=tuple(marks),
    )


# ------------------------------------------------------------------ in space


def run_stage(s: Study, run: int) -> Space:
    """Machine on its way in one run, with the ways of other estimates and the goal."""
    machine, runs = s.eye.true.machine, s.trials("identified").runs
    rows = chosen(int(runs.last[run]) + 1, ANIMATION_FRAMES)
    postures = _postures(s, runs.T_base_platform[run, rows])
    goal = _platform_joints(s, runs.goals[run][None])[0]
    paths = [SpacePath(name="Goal", colour="--ink", lines=(line(ring(goal), 4),), dashed=True)]
    for name, colour in (("identified", "--drawing"), ("hand", "--calibrated")):
        o = s.trials(name)
        poses = o.runs.T_base_platform[run][chosen(len(o.runs.time), ANIMATION_FRAMES)]
        middle = _platform_joints(s, poses).mean(axis=1)
        label = f"Way, {o.estimate.title.lower()}"
        paths.append(SpacePath(name=label, colour=colour, lines=(line(middle, 5),)))
    hidden = sorted({leg + 1 for leg in range(machine.n_legs)} - {j + 1 for j in s.eye.true.legs})
    camera = (s.eye.camera, inverse(s.eye.true.T_camera_base))
    return Space(
        title=f"Run {run + 1} in space",
        caption="The true machine, led by the identified geometry; ways of the platform's middle"
        " with the identified geometry and with the one by hand."
        + (f" Not seen: legs {', '.join(map(str, hidden))}." if hidden else ""),
        alt="The machine in three dimensions on its way to the goal",
        machine=machine_shape(
            machine,
            leg_rows(machine, None),
            {s.scene.station or "camera": camera},
            Postures(*(part[:1] for part in postures)),
        ),
        poses=space_poses(
            machine, postures, [f"{t:.2f} s" for t in runs.time[rows]], key=lambda _: ""
        ),
        paths=tuple(paths),
    )


def _postures(s: Study, poses: Array) -> Postures:
    """Postures of the true machine at poses (n, 4, 4)."""
    return Postures(np.nan_to_num(s.eye.true.machine.inverse(poses)), poses)


def _platform_joints(s: Study, poses: Array) -> Array:
    """Platform joints (n, L, 3) of the true machine at poses (n, 4, 4), m."""
    return s.eye.true.machine.ends_at(*_postures(s, poses)).b


# ------------------------------------------------------------------ in the image


def image_plot(s: Study, run: int) -> Plot:
    """Edges at start and goal, and the paths of their ends, in the image."""
    runs = s.trials("identified").runs
    marks = [
        *_edges(s, runs.T_base_platform[run, :1], dashed=True),
        *_edges(s, runs.goals[run : run + 1], dashed=False),
        *_end_paths(s, run, "identified"),
        *_end_paths(s, run, "hand"),
    ]
    points = np.array([p for mark in marks for p in mark.points if p[1] is not None], dtype=float)
    width, height = s.eye.camera.image_size
    (left, top), (right, bottom) = points.min(axis=0), points.max(axis=0)
    more = IMAGE_MARGIN * max(right - left, bottom - top)
    border = [(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)]
    corners = np.array([*border, border[0]])
    frame = LineMark(name="", colour="quiet", points=line_points(corners[:, 0], corners[:, 1]))
    return Plot(
        name="image",
        title=f"Run {run + 1} in the image",
        caption="Edges of the seen legs at the start (dashed) and at the goal, and the way of their"
        f" ends between. The part of the image of {width} × {height} pixels in which they are.",
        alt="The legs' edges in the camera's image and their ways from start to goal",
        x=_pixel_axis("x, pixels", float(left - more), float(right + more)),
        y=_pixel_axis("y, pixels", float(bottom + more), float(top - more)),
        marks=(frame, *marks),
        equal=True,
    )


def _pixel_axis(label: str, first: float, last: float) -> PlotAxis:
    """Axis of pixels; y grows downwards."""
    ticks = linear_ticks(min(first, last), max(first, last))
    return PlotAxis(label=label, scale="linear", limits=(first, last), ticks=ticks)


def _pixels(s: Study, poses: Array, places: int) -> Array:
    """Pixels (n, E, places, 2) along the edges of the observed legs."""
    return s.eye.points(poses, _postures(s, poses).readings, places).pixel


def _edges(s: Study, pose: Array, dashed: bool) -> list[LineMark]:
    """Edges at a pose."""
    pixels = np.round(_pixels(s, pose, SERVO_EDGE_POINTS)[0], 1)
    return [
        LineMark(
            name="",
            colour=leg_colour(leg + 1),
            points=_finite_points(pixels[e]),
            dashed=dashed,
            key=leg_key(leg + 1),
        )
        for e, leg in enumerate(s.eye.tubes.leg.tolist())
    ]


def _end_paths(s: Study, run: int, name: str) -> list[LineMark]:
    """Paths of both ends of each leg's first edge; one of them in the legend."""
    o = s.trials(name)
    rows: Integers = chosen(len(o.runs.time), ANIMATION_FRAMES)
    pixels = np.round(_pixels(s, o.runs.T_base_platform[run][rows], 3), 1)
    ends = [pixels[:, e, place] for e in range(0, len(s.eye.tubes.leg), 2) for place in (0, -1)]
    return [
        LineMark(
            name=f"way, {o.estimate.title.lower()}" if n == 0 else "",
            colour=ESTIMATE_COLOURS[name],
            points=_finite_points(end),
        )
        for n, end in enumerate(ends)
    ]


def _finite_points(pixels: Array) -> tuple[tuple[float, float], ...]:
    """Pixels (n, 2) without those outside of the camera's model."""
    good = pixels[np.isfinite(pixels).all(axis=1)]
    return tuple((float(x), float(y)) for x, y in good)
