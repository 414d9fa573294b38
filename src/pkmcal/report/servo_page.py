"""The page of a study of servoing, [B] Fig. 10: error curves, an animation, the image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.control.source import Controlled
from pkmcal.control.study import Outcome, Plan, Study, study
from pkmcal.control.words import Judgement, judgement, named
from pkmcal.outcome import Figure, Plot, Row, Table
from pkmcal.report import page as templating
from pkmcal.report import scene as figure
from pkmcal.report import servo_figures
from pkmcal.wording import brief, number

MOST_CHOICES = 2
"""Choices of legs told of each number of them."""
SLIGHT = 0.01
"""Part of the way by which noise may bring a platform beyond its goal."""
LONG = 100.0
"""m of a way that count as much as passing the goal by all of it."""


@dataclass(frozen=True)
class Servo:
    """A study with what is said of it."""

    subject: Controlled
    study: Study
    judgement: Judgement

    @property
    def warnings(self) -> tuple[str, ...]:
        """Of the scene and of the control."""
        return (*self.subject.warnings, *self.judgement.warnings)

    @property
    def stillness(self) -> str:
        """How still the platform is held, in a sentence."""
        s = self.study
        position, turn = _rms(s.held.position), _rms(s.held.turn)
        one, one_turn = _rms(s.image.position), _rms(s.image.turn)
        if not position > 0:
            return "The edges are without noise."
        return (
            f"Held at its goal, noise of {s.plan.loop.noise.shift:g} px moves the platform by"
            f" {brief(1e3 * position)} mm and {brief(np.rad2deg(turn))}° (root mean square);"
            f" one image alone is good to {brief(1e3 * one)} mm and"
            f" {brief(np.rad2deg(one_turn))}°."
        )

    def document(self) -> dict[str, Any]:
        """Plain data for JSON: m, rad, s; legs count from 1."""
        s, j = self.study, self.judgement
        return {
            "machine": self.subject.name,
            "origin": self.subject.origin,
            "station": self.subject.station,
            "usable": j.usable,
            "headline": j.headline,
            "reasons": j.reasons,
            "warnings": self.warnings,
            "advice": j.advice,
            "settings": _settings(s),
            "estimates": {o.estimate.name: _outcome_document(o) for o in s.outcomes},
            "stillness": {
                "position": _rms(s.held.position),
                "turn": _rms(s.held.turn),
                "one_image_position": _rms(s.image.position),
                "one_image_turn": _rms(s.image.turn),
            },
            "hidden": dict(zip([str(j + 1) for j in s.eye.true.legs], s.hidden, strict=True)),
            "visibility": {
                "legs": [
                    {"legs": [j + 1 for j in c.legs], "worst": c.worst, "usual": c.usual}
                    for c in s.choices
                ],
            },
            "equilibria": _equilibria(s),
            "curves": {
                "time": s.outcomes[0].runs.time,
                **{o.estimate.name: np.median(servo_figures.shares(o), axis=0) for o in s.outcomes},
            },
        }


def servo_of(
    subject: Controlled, plan: Plan, progress: Callable[[str, float], None] = lambda _t, _s: None
) -> Servo:
    """Study and judge."""
    found = study(subject.scene, plan, progress)
    return Servo(subject, found, judgement(found))


def servo_html(found: Servo) -> str:
    """One HTML page that needs nothing else: no network, no other file."""
    plots = plots_of(found)
    return templating.render(
        "servo.html.j2",
        s=found,
        j=found.judgement,
        cards=cards(found),
        outcomes=outcome_table(found),
        ends=ends_table(found),
        choices=choices_table(found),
        settings=settings_table(found),
        plots=plots,
        frames=servo_figures.frames(found.study, shown_run(found.study)),
        plotly=figure.plotly_script(),
    )


def shown_run(found: Study) -> int:
    """The run that is drawn: the one whose estimate by hand passes its goal farthest, of those that
    all estimates bring there.
    """
    everywhere = np.all([o.runs.reached for o in found.outcomes], axis=0)
    hand = found.outcome("hand")
    # where nobody passes the goal, the longest way shows most
    passed = np.where(hand.overshoot > SLIGHT, hand.overshoot, 0.0)
    marks = passed + hand.runs.way[:, 0] / LONG
    return int(np.argmax(np.where(everywhere, marks, -1.0)))


def plots_of(found: Servo) -> tuple[Plot, ...]:
    """Curves, animation, image."""
    s = found.study
    return (
        Plot(
            "curves",
            f"Error of the {s.plan.loop.law}, as a part of its start's",
            "Lines: the median; shaded: from the least to the largest; of runs that reach the goal."
            " Logarithmic, so that an exponential is a straight line; [B] Fig. 10 for one run.",
            "Norm of the error against time for four estimates of the geometry",
            servo_figures.curves(s),
            height=420,
        ),
        Plot(
            "tail",
            "The end of the ways, platform's joints from the goal",
            "Distance of the platform's joints from the goal, as a part of the way, median of runs"
            " that reach it.",
            "Distance from the goal against time, enlarged near zero",
            servo_figures.tail(s),
            height=320,
        ),
        *_run_plots(s, shown_run(s)),
    )


def _run_plots(s: Study, run: int) -> tuple[Plot, ...]:
    return (
        Plot(
            "space",
            f"Run {run + 1} in space",
            "The true machine, led by the identified geometry; dashed: the goal; grey: the way of"
            " the platform's middle with the identified geometry, orange with the one by hand.",
            "The machine in three dimensions on its way to the goal",
            servo_figures.space(s, run),
            height=560,
        ),
        Plot(
            "image",
            f"Run {run + 1} in the image",
            "Edges of the seen legs at the start (thin) and at the goal (thick), and the way of"
            " their ends between; the frame is the image's.",
            "The legs' edges in the camera's image and their ways from start to goal",
            servo_figures.image(s, run),
            height=520,
        ),
    )


def cards(found: Servo) -> tuple[Figure, ...]:
    """The main numbers."""
    s = found.study
    good, hand = s.outcome("identified"), s.outcome("hand")
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
            "Does it pass its goal?",
            ((_percent(good.overshoot, good), "%"),),
            f"of the way, the farthest of all runs; by hand {_percent(hand.overshoot, hand)} %",
        ),
        Figure(
            "How still is it held?",
            (
                (_magnitude(1e3 * _rms(s.held.position)), "mm"),
                (_magnitude(float(np.rad2deg(_rms(s.held.turn)))), "°"),
            ),
            f"root mean square, noise of {s.plan.loop.noise.shift:g} px an edge",
        ),
    )


def outcome_table(found: Servo) -> Table:
    """One row an estimate."""
    rows = [
        Row(
            o.estimate.title,
            (
                f"{o.reached} of {len(o.runs.end)}",
                _percent(o.overshoot, o, np.median),
                _percent(o.overshoot, o),
                _percent(o.rise, o),
                _seconds(o),
                _last(o),
            ),
        )
        for o in found.study.outcomes
    ]
    return Table(
        "Estimates of the geometry",
        (
            "Geometry",
            "Reached",
            "Passed goal, %",
            "at most",
            "Error rose, %",
            "Settled, s",
            "Left, mm",
        ),
        tuple(rows),
        "Passed goal: part of its way by which the platform was beyond the goal, median and"
        " largest. Error rose: the largest rise of the error's norm above an earlier value."
        " Settled: within 2 % of the way for good, median. Left: distance of the platform's joints"
        " at the end, median. All of runs that reached the goal.",
    )


def ends_table(found: Servo) -> Table | None:
    """How runs ended that failed; None where none did."""
    kinds = {end for o in found.study.outcomes for end in o.ends if not end.good}
    if not kinds:
        return None
    rows = [
        Row(end.sentence, tuple(str(o.ends.get(end, 0)) for o in found.study.outcomes))
        for end in sorted(kinds, key=lambda end: end.word)
    ]
    columns = ("How the others ended", *(o.estimate.title for o in found.study.outcomes))
    return Table("Runs that did not reach their goal", columns, tuple(rows))


def choices_table(found: Servo) -> Table:
    """Which legs must be seen."""
    s = found.study
    useful = [c for c in s.choices if not c.blind]
    sizes = sorted({len(c.legs) for c in useful})
    shown = [c for n in sizes for c in [c for c in useful if len(c.legs) == n][:MOST_CHOICES]]
    if s.own not in shown:
        shown = [s.own, *shown]
    rows = [
        Row(
            named(c, s) + (", as seen" if c == s.own else ""),
            (number(c.worst, 5), number(c.usual, 5), "no" if c.blind else "hardly, at some poses"
             if c.fading else "yes"),
        )
        for c in shown
    ]  # fmt: skip
    return Table(
        f"Which legs must be seen, by their {s.plan.loop.law}",
        ("Legs", "Visibility, worst pose", "usual", "Every motion seen"),
        tuple(rows),
        "Visibility: the smallest singular value of the interaction matrix as a part of its"
        " largest, at poses all over the workspace; the two best choices of each number. Fewer legs"
        " do not show every motion.",
    )


def settings_table(found: Servo) -> Table:
    """What was simulated."""
    s = _settings(found.study)
    names = {
        "law": "Control by",
        "legs": "Legs seen",
        "gain": "Gain, 1/s",
        "rate": "Images a second",
        "delay": "Delay, images",
        "noise": "Noise of an edge, px",
        "joint_noise": "Noise of a reading, m or rad",
        "speed": "Fastest drive, m/s or rad/s",
        "duration": "Time of a run, s",
        "hand_position": "Camera's place by hand, off by m",
        "hand_rotation": "and by rad",
        "runs": "Runs of every estimate",
        "seed": "Seed",
    }
    rows = [Row(name, (_told(s[key]),)) for key, name in names.items()]
    return Table("What was simulated", ("Setting", "Value"), tuple(rows))


def _told(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(str(item) for item in value)
    return (
        "no limit" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    )


def _settings(s: Study) -> dict[str, Any]:
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


def _equilibria(s: Study) -> dict[str, Any]:
    found = s.equilibria
    return {
        "reached": found.reached,
        "alike": found.alike,
        "cancelled": found.cancelled,
        "outside": found.out,
        "distance": found.distance,
        "looks_alike": found.looks_alike,
        "T_base_platform": found.T_base_platform,
    }


def _outcome_document(o: Outcome) -> dict[str, Any]:
    return {
        "title": o.estimate.title,
        "reached": o.reached,
        "ends": {end.word: n for end, n in o.ends.items()},
        "overshoot_median": _over(o.overshoot, o, np.median),
        "overshoot_largest": _over(o.overshoot, o, np.max),
        "error_rise_largest": _over(o.rise, o, np.max),
        "settling_median": float(np.nanmedian(o.settling)) if o.reached else None,
        "runs": [
            {"end": end.word, "way": way, "overshoot": over, "settling": settling}
            for end, way, over, settling in zip(
                o.runs.end, o.runs.way[:, 0], o.overshoot, o.settling, strict=True
            )
        ],
    }


def _over(values: Any, o: Outcome, of: Callable[[Any], Any]) -> float | None:
    """A figure over the runs that reached the goal."""
    good = values[o.runs.reached]
    return float(of(good)) if good.size else None


def _percent(values: Any, o: Outcome, of: Callable[[Any], Any] = np.max) -> str:
    value = _over(values, o, of)
    return "–" if value is None else brief(100 * value) if value > 5e-4 else "0"


def _seconds(o: Outcome) -> str:
    known = o.settling[np.isfinite(o.settling)]
    return f"{np.median(known):.1f}" if known.size else "–"


def _last(o: Outcome) -> str:
    way = o.runs.way[o.runs.reached][:, -max(1, o.runs.way.shape[1] // 10) :]
    return brief(1e3 * float(np.median(way.mean(axis=1)))) if len(way) else "–"


def _magnitude(value: float) -> str:
    return brief(value) if value > 0 else "0"


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(values**2)))
