"""Study of visual servoing as an outcome: its figures, tables, and parts of the report."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pkmcal.arrays import Array, rms
from pkmcal.control.sentences import judgement
from pkmcal.control.study import Study, Trials
from pkmcal.outcome import Figure, Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.blocks.plot import panels
from pkmcal.report.servo_plots import (
    astray_plot,
    error_plot,
    image_plot,
    run_stage,
    shares,
    tail_plot,
)
from pkmcal.wording import amount, brief

SERVO_METHOD_TEXT = (
    "The camera measures the edges of one tube of each seen leg. The error is the cross product of"
    " what is seen and what was seen when the goal was taught: of the edges' normals, or of the"
    " legs' directions. The drives' rates are −gain · D N⁺ e, with the interaction matrix N and the"
    " inverse Jacobian D by the measured directions, the readings, and the base centres of"
    " the controller's model. The goal is taught by the true machine without noise, so a wrong"
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
                blocks=(*panels(astray_plot(study)), error_plot(study), tail_plot(study)),
                tables=(outcome_table(study), *([ends] if ends else [])),
            ),
            Part("run", "One run", blocks=(run_stage(study, run), image_plot(study, run))),
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
        "visibility": {"worst": s.visibility.worst, "usual": s.visibility.usual},
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
            "At most, mm",
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


def settings_table(study: Study) -> Table:
    """Table of the simulation's settings."""
    s, units = _settings(study), dict.fromkeys(study.eye.true.machine.joint_units)
    s |= {
        "joint_noise": " or ".join(amount(s["joint_noise"], unit) for unit in units),
        "hand_position": amount(s["hand_position"], "m"),
        "hand_rotation": amount(s["hand_rotation"], "rad"),
    }
    names = {
        "law": "Control by",
        "legs": "Legs seen",
        "gain": "Gain, 1/s",
        "rate": "Images a second",
        "delay": "Delay, images",
        "noise": "Noise of an edge, px",
        "joint_noise": "Noise of a joint reading",
        "speed": f"Fastest drive, {' or '.join(f'{unit}/s' for unit in units)}",
        "duration": "Time of a run, s",
        "hand_position": "Position error of the camera by hand",
        "hand_rotation": "Orientation error of the camera by hand",
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
