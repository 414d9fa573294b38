"""Measurement plan as an outcome: configurations, their order, stations, and expected accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.files import csv_text, json_value, yaml_text
from pkmcal.geometry.rigid import inverse
from pkmcal.levels import NEGLIGIBLE
from pkmcal.mechanisms.drives import ball_of, legs_space
from pkmcal.outcome import Figure, Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.plot import (
    DotsMark,
    LineMark,
    Plot,
    Point,
    RuleMark,
    line_points,
    log_axis,
    rounded,
)
from pkmcal.outcome.blocks.space import Space, SpacePoints
from pkmcal.outcome.blocks.text import Hint
from pkmcal.outcome.finding import Finding, note
from pkmcal.placement.stations import StationPose
from pkmcal.planning.plan import Accuracy, MeasurementPlan, TriedStation
from pkmcal.planning.rig import BoardFrom, LegsFrom
from pkmcal.report.space import space_points, space_poses
from pkmcal.web.motion import Postures
from pkmcal.web.stage import leg_rows, machine_shape
from pkmcal.wording import DISPLAY_UNITS, amount, brief, count, listed, number

PLAN_TABLE_FILE, PLAN_STATIONS_FILE = "plan.csv", "stations.yaml"
PLAN_FORMAT = 1
PLAN_READING_DECIMALS = 6
"""Decimals of a reading in metres or radians."""
STATION_COLOURS = ("--calibrated", "--drawing", "--good", "--warn", "--ink", "--accent")
SMALLEST_CANDIDATE = 0.5
"""Size of the point of the worst candidate, relative to the best."""
HANDHELD_PLACES_TEXT = (
    "From: directions of the two images from the middle of the machine, from its x towards its y"
    " axis and above the level, and the distance; to ten degrees is enough. "
)
PLAN_METHOD_TEXT = (
    "Each candidate's rows are those of the joint estimate: the exact derivatives of its edges,"
    " corners, poses and readings, with the platform's pose of that configuration eliminated."
    " Stations, edge shifts, shading and boards stay unknown, so what is promised is what calibrate"
    " then states, as far as the images turn out as good as assumed.",
    "Configurations are taken greedily, then each is exchanged for the best of all others until"
    " nothing gains (Fedorov), then moved by a part of the motors' ranges and exchanged again. Two"
    " of a place differ by a tenth of some motor's range at least: an image taken twice errs by"
    " the same. They are within the joints' ranges, in home's assembly, away from singular poses,"
    " with legs clear of each other; what lies outside the image or behind a leg adds nothing.",
)


def outcome_of(plan: MeasurementPlan) -> Outcome:
    """Outcome of ``pkmcal plan``."""
    texts: dict[str, str | bytes] = {PLAN_TABLE_FILE: _table_text(plan)}
    parts = [_curve(plan), _stage_part(plan, _cameras(plan)), _order(plan)]
    if plan.tried:
        texts[PLAN_STATIONS_FILE] = yaml_text(stations_document(plan))
        parts.insert(2, _camera_poses(plan))
    parts.append(Part("how", "How it was computed", (*PLAN_METHOD_TEXT, *plan.subject.words)))
    machine = plan.subject.rig.machine
    gain = plan.by_chance.position / plan.promised.position
    findings = [_worth_note(plan)]
    if blocked := [name for name, bad in zip(plan.names, plan.blocked, strict=True) if bad]:
        findings.append(note("plan.blocked", listed(blocked), names=blocked))
    return Outcome(
        command="plan",
        title=f"What to measure next on {machine.name}",
        subject=_purpose(plan),
        verdict=Verdict(
            usable=True,
            headline=f"These {count(len(plan.names), 'configuration')} will determine the tool's"
            f" {_accuracy_text(plan.promised)}, standard deviations, mean over the workspace.",
            findings=tuple(findings),
        ),
        stamp="Plan",
        figures=(
            Figure(
                "How well will the tool be known?",
                (
                    (brief(plan.promised.position * 1e3), "mm"),
                    *(
                        ((brief(np.rad2deg(plan.promised.orientation)), "°"),)
                        if plan.promised.orientation
                        else ()
                    ),
                ),
                "now "
                + amount(plan.now.position, "m")
                + (f" and {amount(plan.now.orientation, 'rad')}" if plan.now.orientation else ""),
            ),
            Figure(
                "How much better than by chance?",
                ((number(gain, 1), "×"),),
                "as many configurations spread evenly over the joints' ranges would determine it"
                f" to {amount(plan.by_chance.position, 'm')}",
            ),
            Figure(
                "How long is the way?",
                ((number(plan.travel[0], 1), "ranges"),),
                "moved by the slowest motor in this order, from home; in an order by chance"
                f" {number(plan.travel[1], 1)}",
            ),
        ),
        parts=tuple(parts),
        findings=tuple(note("plan.source", text=text) for text in plan.subject.words),
        document=plan_document(plan),
        texts=texts,
    )


def _table_text(plan: MeasurementPlan) -> str:
    """Readings in the columns and units of joints.csv."""
    subject = plan.subject
    units = subject.units or (None,) * len(subject.columns)
    heads = [
        name if unit is None else f"{name} [{unit.name}]"
        for name, unit in zip(subject.columns, units, strict=True)
    ]
    values = plan.joints.copy()
    for m, unit in enumerate(units):
        factor = 1.0 if unit is None else unit.factor
        decimals = PLAN_READING_DECIMALS + math.ceil(math.log10(factor))
        values[:, m] = np.round(values[:, m] / factor, decimals)
    return csv_text(heads, plan.names, values)


def _accuracy_text(accuracy: Accuracy) -> str:
    """Accuracy of position and, if the platform turns, of orientation, in words."""
    words = f"position to {amount(accuracy.position, 'm')}"
    if not accuracy.orientation:
        return words
    return f"{words} and its orientation to {amount(accuracy.orientation, 'rad')}"


def _purpose(plan: MeasurementPlan) -> str:
    """Purpose of the plan in a sentence."""
    where = ""
    if plan.subject.handheld:
        where = " in two hand-held images each"
    elif len({name for names in plan.stations for name in names}) > 1:
        where = " seen by all stations" if plan.together else " from each place"
    each = count(plan.promised.count, "configuration") + where
    return f"{each}, chosen for the least variance of the tool; workspace: {plan.region}."


def _worth_note(plan: MeasurementPlan) -> Finding:
    """Note on the number of configurations beyond which more are not worthwhile."""
    last, until = plan.promised, plan.pays_until
    twice = next(a for a in plan.curve if a.count > last.count)
    facts = {
        "tool_sigma": twice.position,
        "gain": 1 - twice.position / last.position,
        "worthwhile": NEGLIGIBLE,
    }
    if until is None:
        return note("plan.all_pay", **facts)
    return note("plan.pays_until", number=until, **facts)


def _order(plan: MeasurementPlan) -> Part:
    """Section with the configurations in their order."""
    units = plan.subject.rig.machine.joint_units
    columns = [
        f"{name}, {DISPLAY_UNITS[unit][1]}"
        for name, unit in zip(plan.subject.columns, units, strict=True)
    ]
    where = {name: _direction(plan, T) for name, _, T in _cameras(plan)}
    by_hand = plan.subject.handheld
    rows = [
        Row(
            name,
            (
                "; ".join(where[image] for image in who) if by_hand else listed(who, 3),
                str(int(rank)),
                *(number(q * DISPLAY_UNITS[u][0], 2) for q, u in zip(joints, units, strict=True)),
            ),
        )
        for name, who, rank, joints in zip(
            plan.names, plan.stations, plan.rank, plan.joints.tolist(), strict=True
        )
    ]
    table = Table(
        "In this order",
        ("Configuration", "From", "Rank", *columns),
        tuple(rows),
        (HANDHELD_PLACES_TEXT if by_hand else "")
        + "The way from home is the shortest that was found. Rank: if fewer are"
        " wanted, those up to a rank are the best so many"
        f"{'' if by_hand else ' from each place'}. {PLAN_TABLE_FILE} holds the readings in the"
        " units of joints.csv; measured readings replace them.",
        brief=False,
        words=(1,),
    )
    return Part("order", "Configurations", tables=(table,))


def _direction(plan: MeasurementPlan, T_camera_base: Array) -> str:
    """Where a camera is from the middle of the machine's space, in words."""
    centre = ball_of(legs_space(plan.subject.rig.machine))[0]
    away = inverse(T_camera_base)[:3, 3] - centre
    distance = float(np.linalg.norm(away))
    azimuth = np.rad2deg(np.arctan2(away[1], away[0])) % 360
    height = np.rad2deg(np.arcsin(away[2] / distance))
    return f"{azimuth:.0f}°, {height:.0f}° up, {distance:.2g} m"


def _curve(plan: MeasurementPlan) -> Part:
    """Section on the tool's standard deviation against the number of configurations."""
    here = plan.promised
    wanted = {3, 5, 8, 10, 15, 20, 30, 50}
    turns = here.orientation > 0
    few = [a for a in plan.curve if a.count in wanted or a.count >= here.count]
    rows = [
        Row(
            f"{a.count:g}",
            (amount(a.position, "m"), *([amount(a.orientation, "rad")] if turns else [])),
            mark="good" if a.count == here.count else None,
        )
        for a in few
    ]
    table = Table(
        "Accuracy by the number" + ("" if plan.subject.handheld else " from each place"),
        ("Configurations", "Position", *(["Orientation"] if turns else [])),
        tuple(rows),
        "Standard deviations of the tool, mean over the workspace. Fewer: those of the lowest"
        " ranks. More: these again, as often.",
    )
    return Part("curve", "How many", blocks=(_curve_plot(plan),), tables=(table,))


def _curve_plot(plan: MeasurementPlan) -> Plot:
    """Standard deviation of the best configurations, and of as many by chance."""
    here = plan.promised
    x = [float(accuracy.count) for accuracy in plan.curve]
    y = [accuracy.position * 1e3 for accuracy in plan.curve]
    chance = plan.by_chance.position * 1e3
    configurations = "configurations" + ("" if plan.subject.handheld else " from each place")
    best = tuple(
        Point(x=n, y=rounded(sigma), tip=f"{n:g} {configurations}: {brief(sigma)} mm")
        for n, sigma in zip(x, y, strict=True)
    )
    by_chance = Point(
        x=float(here.count), y=rounded(chance), tip=f"{here.count:g} by chance: {brief(chance)} mm"
    )
    return Plot(
        name="curve",
        title="How σ falls with the number of configurations",
        caption="Mean over the workspace, both axes logarithmic: by chance alone, four times as"
        " many halve it. Up to this plan's number the best of the plan; beyond it, each again.",
        alt="The tool's standard deviation against the number of"
        f" {configurations}, from {brief(y[0])} to {brief(y[-1])} mm; the table has the numbers",
        x=log_axis(configurations, x),
        y=log_axis("σ of the tool's position, mm", (*y, chance)),
        marks=(
            RuleMark(name="this plan", axis="x", at=float(here.count), colour="quiet"),
            LineMark(name="", colour="calibrated", points=line_points(x, y)),
            DotsMark(name="the best", colour="calibrated", points=best, radius=3),
            DotsMark(
                name="by chance", colour="nominal", points=(by_chance,), symbol="cross", radius=5
            ),
        ),
    )


def _stage_part(plan: MeasurementPlan, cameras: Sequence[tuple[str, Camera, Array]]) -> Part:
    """Section with the machine at each configuration of the plan, in its order.

    cameras : name of the station, camera, and T_camera_base.
    """
    machine = plan.subject.rig.machine
    postures = Postures(plan.joints, plan.T_base_platform)
    points = _positions_by_station(plan)
    if plan.tried:
        points.append(_candidates(plan.tried))
    block = Space(
        title="",
        caption="The machine at a configuration; points are the platform's positions"
        + ("." if plan.subject.handheld else ", by the stations that measure them.")
        + (" The larger a camera's place, the better it is alone." if plan.tried else ""),
        alt="The machine in three dimensions at the configurations of the plan, with the cameras.",
        machine=machine_shape(
            machine,
            leg_rows(machine, None),
            {name: (camera, inverse(T)) for name, camera, T in cameras},
            Postures(*(part[:1] for part in postures)),
        ),
        poses=space_poses(machine, postures, plan.names, configuration_key),
        points=tuple(points),
    )
    hint = Hint(text="The slider takes the machine through the configurations in their order.")
    return Part("where", "In space", blocks=(block, hint))


def _positions_by_station(plan: MeasurementPlan) -> list[SpacePoints]:
    """Platform positions, one set for each group of stations that measure together."""
    where = [f"From {listed(names, 3)}" for names in plan.stations]
    if plan.subject.handheld:  # each has its own
        where = ["In two images each"] * len(where)
    out: list[SpacePoints] = []
    for n, words in enumerate(dict.fromkeys(where)):
        rows = [k for k, own in enumerate(where) if own == words]
        names = [plan.names[k] for k in rows]
        out.append(
            space_points(
                words,
                STATION_COLOURS[n % len(STATION_COLOURS)],
                plan.T_base_platform[rows, :3, 3],
                [configuration_key(name) for name in names],
                [f"{name} ({words[0].lower()}{words[1:]})" for name in names],
            )
        )
    return out


def _candidates(tried: tuple[TriedStation, ...]) -> SpacePoints:
    """Candidate places of the camera, the larger the better alone."""
    level = np.log([one.alone for one in tried])
    worse = (level - level.min()) / (np.ptp(level) or 1.0)
    state = [", chosen" if one.chosen else "" for one in tried]
    return space_points(
        "Places tried",
        "--quiet",
        np.array([one.place.position for one in tried]),
        [""] * len(tried),
        [
            f"alone {brief(one.alone * 1e3)} mm{text}"
            for one, text in zip(tried, state, strict=True)
        ],
        np.round(1 - (1 - SMALLEST_CANDIDATE) * worse, 2).tolist(),
    )


def _cameras(plan: MeasurementPlan) -> list[tuple[str, Camera, Array]]:
    """Cameras of the plan: name of the station, camera, and T_camera_base."""
    out: dict[str, tuple[str, Camera, Array]] = {}
    rig = plan.subject.rig
    for one in rig.instruments:
        if isinstance(one, LegsFrom | BoardFrom):
            name = rig.names[one.station]
            out[name] = (name, one.camera, one.T_camera_base)
    return list(out.values())


def _camera_poses(plan: MeasurementPlan) -> Part:
    """Section on the camera's places, and what the best of them give alone."""
    order = sorted(plan.tried, key=lambda tried: (not tried.chosen, tried.alone))[:12]
    rows = [
        Row(
            "[" + ", ".join(f"{x:.3g}" for x in tried.place.position) + "]",
            (
                "[" + ", ".join(f"{x:.3g}" for x in tried.place.look_at) + "]",
                amount(tried.alone, "m"),
            ),
            mark="good" if tried.chosen else None,
        )
        for tried in order
    ]
    table = Table(
        "Places of the camera",
        ("Position, m", "Looks at, m", "Tool from there alone"),
        tuple(rows),
        "Base frame. Chosen as a set: two places that see the same badly do not help each other."
        f" {PLAN_STATIONS_FILE} holds them as session.yaml wants them;"
        " to a few centimetres is enough.",
        words=(0, 1),
    )
    return Part("places", "Where to put the camera", tables=(table,))


def stations_document(plan: MeasurementPlan) -> dict[str, Any]:
    """Chosen places as entries of session.yaml."""
    out = dict[str, Any]()
    for name, _, T_camera_base in _cameras(plan):
        observe = _observed(plan, name)
        out[name] = {
            "camera": "cameras/camera.yaml",
            "images": f"images/{name}/{{configuration}}.png",
            "observe": observe[0] if len(observe) == 1 else observe,
            "pose": StationPose.of(T_camera_base).rounded(3),
        }
    return {"stations": out}


def _observed(plan: MeasurementPlan, name: str) -> list[str]:
    """What a station observes, as in session.yaml."""
    rig = plan.subject.rig
    own = [one for one in rig.instruments if rig.names[one.station] == name]
    kinds = (("legs", LegsFrom), ("board", BoardFrom))
    return [word for word, kind in kinds if any(isinstance(one, kind) for one in own)]


def plan_document(plan: MeasurementPlan) -> dict[str, Any]:
    """Plan as plain data, m and rad."""
    rig = plan.subject.rig
    joined = zip(
        plan.names, plan.stations, plan.rank, plan.joints, plan.T_base_platform,
        plan.blocked, strict=True,
    )  # fmt: skip
    return json_value(
        {
            "pkmcal_plan": PLAN_FORMAT,
            "machine": rig.machine.name,
            "workspace": {
                "x": plan.region.x, "y": plan.region.y, "z": plan.region.z,
                "turn": plan.region.turn,
            },
            "together": plan.together,
            "handheld": plan.subject.handheld,
            "now": _accuracy_document(plan.now),
            "promised": _accuracy_document(plan.promised),
            "by_chance": _accuracy_document(plan.by_chance),
            "pays_until": plan.pays_until,
            "curve": [_accuracy_document(a) for a in plan.curve],
            "columns": list(plan.subject.columns),
            "joint_noise": rig.joint_noise,
            "configurations": [
                {
                    "name": name,
                    "stations": list(stations),
                    "rank": int(rank),
                    "joints": joints,
                    "T_base_platform": T,
                    "go_by_home": bool(blocked),
                }
                for name, stations, rank, joints, T, blocked in joined
            ],
            "stations": [
                {
                    "name": name, "T_base_camera": inverse(T), "camera": camera.document(),
                    "observe": _observed(plan, name),
                }
                for name, camera, T in _cameras(plan)
            ],
            "places_tried": [
                {
                    "position": list(one.place.position),
                    "look_at": list(one.place.look_at),
                    "tool_alone": one.alone,
                    "chosen": one.chosen,
                }
                for one in plan.tried
            ],
            "assumptions": list(plan.subject.words),
            "board": plan.subject.board,
            "mechanism": rig.machine.to_document(),
        }
    )  # fmt: skip


def _accuracy_document(accuracy: Accuracy) -> dict[str, float]:
    """Accuracy as plain data."""
    return {
        "configurations": accuracy.count,
        "position": accuracy.position,
        "orientation": accuracy.orientation,
    }
