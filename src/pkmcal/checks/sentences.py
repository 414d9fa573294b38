"""Findings of a check, and its outcome."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, rms
from pkmcal.checks.advice import forecast_figure, forecast_part
from pkmcal.checks.forecast import NEAR_END
from pkmcal.checks.results import BoardCheck, JointCheck, SessionCheck, StationCheck, exit_code_of
from pkmcal.files import resolved
from pkmcal.identify.verdict import VERDICT
from pkmcal.judge.repeatability import RepeatStudy, part_of
from pkmcal.levels import FEW, MAJORITY, RELEVANT_FACTOR
from pkmcal.measurements.contract import measurement_kinds
from pkmcal.observe.profiles import PROFILE_OPTIONS
from pkmcal.outcome import Figure, Mark, Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.finding import Finding, Level, doubtful, note
from pkmcal.session.load import Session
from pkmcal.session.readings import same_pose
from pkmcal.wording import DISPLAY_UNITS, Chance, count, listed, number, percentage, with_unit

OVEREXPOSED_PIXEL_SHARE = 0.25
"""Share of saturated pixels on the legs above which edges are lost; a highlight covers a tenth. Not
checked within a factor of two."""
BLUR_STILL_MEASURED = RELEVANT_FACTOR * PROFILE_OPTIONS.blur_range[1]
"""Blur (px) beyond which edges are measured badly: the widest that the model of an edge tries, by
the factor that matters."""
POOR_CORNERS = 0.5
"""Residual of corners (px rms) beyond that of any sharp image of a flat board. Not checked within a
factor of two."""
STATION_COLUMNS = {
    "Station": "",
    "Images": "",
    "Match by chance": "Probability that wrong readings (of an image by hand: another place) match"
    " the images as well; good below 1 in 1000, near a rough pose or by hand below 1 in 100.",
    "Moved": "Distance and turn from the rough pose to the estimated one.",
    "Legs found": "Mean number in an image.",
    "Blur": "Standard deviation of the blur of the sharpest edges.",
    "White": "Share of the legs' pixels that are saturated.",
    "Black": "Share of the legs' pixels that are black.",
}
"""Columns of the table of stations, with their explanations."""
BOARD_COLUMNS = {
    "Board at": "",
    "Images": "Images in which the board was found.",
    "Corners": "Mean number found in these.",
    "Residual": "Root mean square distance of the corners from their predicted places.",
    "Wander": "Motion of a board on the base between images; a still one stays below 0.1 px.",
    "Distance": "From the camera.",
}
JOINT_COLUMNS = {
    "Joint": "",
    "Lowest": "",
    "Highest": "",
    "Range used": "From the lowest to the highest reading, of the mechanism file's range.",
    "Near low end": f"Configurations with a reading in the lowest {percentage(NEAR_END)} of the"
    " range; readings near both ends determine the joint's offset best.",
    "Near high end": f"Configurations with a reading in the highest {percentage(NEAR_END)} of the"
    " range.",
}
KINEMATICS_SENTENCE = (
    "The nominal machine closes at all readings, {0.singularity:.2f} from a singular pose (0 is"
    " singular, 1 far). Assembly modes at the first readings: {0.assemblies}; the one at home is"
    " taken."
)


def link_findings(session: Session, poses: Array | None) -> list[Finding]:
    """Notes on the difference between links of configurations and the nominal machine, one for each
    kind.

    poses : T_base_platform (K, 4, 4) by the nominal machine; None if it has none.
    """
    out: list[Finding] = []
    for links in session.links:
        kind = measurement_kinds()[links.kind]
        off: dict[str, float] = {}
        if poses is not None:
            first, second = (poses[links.configuration[:, k]][None] for k in (0, 1))
            still = np.broadcast_to(np.eye(4), (1, len(links), 4, 4))
            rows = links.rows(first, second, still).value[0] * links.sigma
            off["rms"] = rms(rows)
        joined = len(np.unique(links.configuration))
        out.append(
            note("session.links", links.label, links=count(len(links), kind.one), number=joined,
                 unit=kind.unit, **off)
        )  # fmt: skip
    return out


def station_findings(station: StationCheck, n_legs: int) -> list[Finding]:
    """Findings on the images of a station. n_legs : of the machine."""
    findings: list[Finding] = []
    at = {"subject": station.name, "station": station.name}
    where = "legs" if station.recognised else "images"
    if station.saturated > OVEREXPOSED_PIXEL_SHARE:
        findings.append(doubtful("images.overexposed", **at, share=station.saturated, where=where))
    if station.black > MAJORITY:
        findings.append(doubtful("images.black", **at, share=station.black, where=where))
    if station.blur > BLUR_STILL_MEASURED:
        findings.append(doubtful("images.blurred", **at, blur=station.blur))
    if station.recognised and station.legs < MAJORITY * n_legs:
        findings.append(doubtful("images.few_legs", **at, number=station.legs, of=n_legs))
    return findings


def board_findings(session: Session, number: int, check: BoardCheck) -> list[Finding]:
    """Findings on the board in a station's images. number : of the station, from 0."""
    station = session.stations[number]
    at = {"subject": station.name, "station": station.name}
    findings: list[Finding] = []
    if check.rms > POOR_CORNERS:
        findings.append(doubtful("board.corners_off", **at, rms=check.rms))
    if check.unseen:
        findings.append(doubtful("board.part_unseen", **at, part=check.unseen.capitalize()))
    # a board on the base needs one image, each configuration one of a board on the platform
    if session.board_body == "platform" and check.found < FEW * len(station.images):
        findings.append(
            doubtful("board.few_images", **at, number=check.found, of=len(station.images))
        )
    if session.board_body == "base" and check.found == 1 and len(station.images) > 1:
        findings.append(note("board.seen_once", **at))
    return findings


def joint_findings(session: Session, joints: tuple[JointCheck, ...]) -> list[Finding]:
    """Findings on the ranges and the number of configurations."""
    findings: list[Finding] = []
    if session.heights_alone:  # the bed determines the configurations
        return findings
    crowded = [joint for joint in joints if joint.used < MAJORITY]
    if crowded and not session.of_a_bed:
        names = [joint.name for joint in crowded]
        least = min(joint.used for joint in crowded)
        findings.append(note("readings.crowded", listed(names), columns=names, share=least))
    count = len(session.configurations)
    if count < VERDICT.few_configurations:
        findings.append(note("configurations.too_few", number=count))
    return findings + _repeated_pose_findings(session)


def _repeated_pose_findings(session: Session) -> list[Finding]:
    """Note on configurations with the same pose by their readings, and how to declare repeats."""
    owner = same_pose(session.joints, session.joint_noise)
    first, names = np.unique(owner, return_counts=True)
    if len(first) == len(owner):
        return []
    same = [session.configurations[k] for k in np.flatnonzero(owner == first[np.argmax(names > 1)])]
    facts: dict[str, Any] = {
        "number": len(owner),
        "poses": len(first),
        "names": same,
        "others": ", and so on" if np.sum(names > 1) > 1 else "",
    }
    again = {
        station.entry or station.name
        for station in session.stations
        if len({owner[photo.configuration] for photo in station.images})
        < len({photo.configuration for photo in station.images})
    }
    if not session.stations:  # a tracker's table has one row for each configuration
        return [note("configurations.equal_rows", **facts)]
    if not again:
        return [note("configurations.equal_names", **facts, name=same[0])]
    entry = min(again)
    pattern = session.document["stations"][entry]["images"]
    if "{repeat}" not in pattern:
        pattern = pattern.replace("{configuration}", "{configuration}_{repeat}")
    files = [pattern.format(configuration=same[0], repeat=k) for k in (1, 2)]
    facts |= {"stations": sorted(again), "files": files, "pattern": pattern}
    return [note("configurations.equal_at_stations", **facts)]


def outcome_of(check: SessionCheck, study: RepeatStudy | None = None) -> Outcome:
    """Outcome for people and programs. study : of the session's repeats."""
    findings = (*check.findings, *(study.findings if study else ()))
    headlines = (
        f"Nothing is wrong. Next: pkmcal calibrate {shlex.quote(check.folder)}",
        "It can be calibrated, but the marked points will cost accuracy.",
        "It cannot be calibrated yet.",
    )
    code = exit_code_of(findings)
    refused = any(finding.error is not None for finding in findings)
    name = check.folder
    if Path(name).name in ("", ".."):  # "." and ".." are no names for a reader
        name = resolved(Path(name)).name or name
    parts: tuple[Part, ...] = ()
    if check.machine:
        text = KINEMATICS_SENTENCE.format(check) if math.isfinite(check.singularity) else ""
        tables = (_stations_table(check), _boards_table(check), _joints_table(check.joints))
        parts = (
            Part(
                "session",
                "What was checked",
                terminal_text=(text,) if text else (),
                tables=tuple(table for table in tables if table.rows),
            ),
        )
    if check.forecast:
        parts = (*parts, forecast_part(check.forecast))
    images = sum(station.photographs for station in check.stations)
    return Outcome(
        command="check",
        title=f"Check of {name}",
        subject=f"{name}: {check.machine}, {check.n_legs} legs,"
        f" {check.configurations} configurations" + (f", {images} images" if check.stations else "")
        if check.machine
        else "",
        verdict=Verdict(code == 0, headlines[2 if refused else code], check.advice),
        stamp=("Ready", "Doubtful", "Not yet")[2 if refused else code],
        level=Level.WRONG if code == 2 else Level.DOUBTFUL,
        figures=_cards(check),
        parts=(*parts, part_of(study)) if study else parts,
        findings=findings,
        document=check.as_dict(),
    )


def _cards(check: SessionCheck) -> tuple[Figure, ...]:
    """Main numbers; those without data are left out."""
    out: list[Figure] = []
    searched = [one for one in check.stations if math.isfinite(one.by_chance)]
    if searched:
        good = sum(one.recognised for one in searched)
        worst = max(searched, key=lambda one: one.by_chance)
        by_hand = all(one.handheld for one in searched)
        out.append(
            Figure(
                "Where is the machine recognized?",
                ((f"{good} of {len(searched)}", "images" if by_hand else "stations"),),
                ("another place" if worst.handheld else "wrong readings")
                + f" would match as well with a probability of {Chance(worst.by_chance)} at worst"
                f" ({worst.name})",
                mark="good" if good == len(searched) else Level.WRONG,
            )
        )
    used = [joint for joint in check.joints if math.isfinite(joint.used)]
    if used:
        least = min(used, key=lambda joint: joint.used)
        out.append(
            Figure(
                "How much of the joints' ranges is used?",
                ((percentage(least.used), ""),),
                f"by {least.name}, the least of {count(len(used), 'joint')}",
                f"limit {percentage(MAJORITY)}",
                "good" if least.used >= MAJORITY else Level.NOTE,
            )
        )
    if check.forecast:
        out.append(forecast_figure(check.forecast))
    return tuple(out)


def _stations_table(check: SessionCheck) -> Table:
    rows: list[Row] = []
    for station in check.stations:
        levels = {f.level for f in check.findings if f.station == station.name}
        if not station.recognised:
            levels.add(Level.WRONG)
        worst = [level for level in Level if level in levels]
        mark: Mark = worst[0] if worst else "good"
        motion = f"{station.moved * 1e3:.0f} mm, {math.degrees(station.turned):.1f}°"
        finite = station.recognised and math.isfinite(station.legs)
        cells = (
            str(station.photographs),
            Chance(station.by_chance),
            motion if math.isfinite(station.moved) else "–",
            f"{station.legs:.1f} of {check.n_legs}" if finite else "–",
            _number(station.blur, "{:.1f} px"),
            percentage(station.saturated),
            percentage(station.black),
        )
        rows.append(Row(station.name, cells, mark=mark))
    return _table("Stations", STATION_COLUMNS, tuple(rows), first=6)


def _boards_table(check: SessionCheck) -> Table:
    rows = tuple(
        Row(
            station.name,
            (
                f"{board.found} of {station.photographs}",
                f"{board.corners:.0f} of {board.corners_of}",
                f"{board.rms:.3f} px",
                _number(board.scatter, "{:.3f} px"),
                f"{board.distance:.2f} m",
            ),
            mark="good",
        )
        for station in check.stations
        if (board := station.board) is not None
    )
    return _table("Boards", BOARD_COLUMNS, rows)


def _joints_table(joints: tuple[JointCheck, ...]) -> Table:
    rows = tuple(
        Row(
            joint.name,
            (
                _reading(joint.low, joint.unit),
                _reading(joint.high, joint.unit),
                percentage(joint.used),
                *(str(n) if math.isfinite(joint.used) else "–" for n in joint.ends),
            ),
            mark=Level.NOTE if joint.used < MAJORITY else "good",
        )
        for joint in joints
    )
    brief = any(row.mark != "good" for row in rows)
    return _table("Readings", JOINT_COLUMNS, rows, brief=brief)


def _table(title: str, columns: Mapping[str, str], rows: tuple[Row, ...], **layout: Any) -> Table:
    """Table whose columns have explanations; layout : further fields."""
    return Table(title, tuple(columns), rows, hints=tuple(columns.values()), **layout)


def _reading(value: float, unit: str) -> str:
    """Reading, m or rad, in its display unit."""
    scale, name = DISPLAY_UNITS[unit]
    return with_unit(number(value * scale, 1 if unit == "m" else 2), name)


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"
