"""Find what is wrong with a session before any work is spent on it.

Everything that `load_session` refuses, then what only the photographs can tell: whether they
decode, are exposed and sharp, and whether the machine and the boards are recognised in them; then
what readings and measured poses tell before any calibration.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from pkmcal.arrays import Array, Integers
from pkmcal.boards.views import Boards, StationBoard, board_of, station_board
from pkmcal.calibration.byhand import found_alone, why_lost
from pkmcal.calibration.calibrate import Progress
from pkmcal.calibration.doubts import check_poses, richer_models, turning
from pkmcal.calibration.gather import measurements_of, refinement_of
from pkmcal.calibration.numbering import numbering_told
from pkmcal.calibration.recognise import (
    board_images,
    check_observable,
    known_stations,
    legs_stations,
    mistake_in,
    platform_poses,
    recognise,
    station_poses,
)
from pkmcal.calibration.turns import identify_poses
from pkmcal.check.advice import advice, forecast_figure, forecast_part
from pkmcal.check.forecast import Forecast, forecast
from pkmcal.check.look import Look, StationLook
from pkmcal.check.repeats import RepeatStudy, part_of
from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import plain
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.verdict import POOR
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.mechanisms.region import poses_in
from pkmcal.observe import legs
from pkmcal.observe.images import KEPT, Pictures, decode
from pkmcal.observe.quality import Quality, quality, unrecognised_quality
from pkmcal.observe.stations import FoundStation
from pkmcal.outcome import (
    Finding,
    Level,
    Mark,
    Outcome,
    Part,
    Row,
    Table,
    Verdict,
    doubtful,
    first_error,
    note,
    wrong,
)
from pkmcal.session.load import Session, Station, load_session
from pkmcal.session.photographs import label_of
from pkmcal.session.readings import same_pose
from pkmcal.session.starter import untouched_files
from pkmcal.wording import listed

NAMED = 10
"""Broken photographs of a station that are named one by one; the others are counted."""
OVEREXPOSED = 0.25
"""Share of saturated pixels on the legs beyond which edges are lost: a highlight takes a tenth."""
TOO_DARK = 0.5
"""Share of black pixels on the legs beyond which the legs have no shading left."""
BLURRED = 1.7
"""Blur (px) beyond which edges are not measured well: the model of an edge ends at 1.5."""
FEW_LEGS = 0.5
"""Share of the legs found in a station's photographs below which it hardly contributes."""
OTHER_MODE = np.deg2rad(20.0)
"""Turn to another assembly below which one could be taken for the other."""
POOR_CORNERS = 0.5
"""px rms from which the corners are worse than any sharp photograph of a flat board has them."""
LITTLE_USED = 0.5
"""Share of a joint's range below which its configurations are crowded."""
END = 0.15
"""Part of a joint's range, at either end, in which a reading is an extreme one."""
FEW_CONFIGURATIONS = 8
"""Configurations below which standard deviations are large and mistakes go unnoticed."""
STATION_LEGEND = (
    "By chance: probability of other readings fitting as well (of a photograph by",
    "hand, another place); good below 0.001, or 0.01 near a pose or by hand.",
    "Moved: from the pose by hand to the one found. Legs: found in a photograph.",
    "White, black: of the legs' pixels. Blur: of the sharpest edges.",
)
BOARD_LEGEND = (
    "Seen: photographs that show it. Off: corners from their predicted places.",
    "Wander: of the board on the base between photographs; a still one stays below 0.1 px.",
)
KINEMATICS = (
    "The drawing's machine closes at all readings, {0.singularity:.2f} from a singular pose (0 is"
    " singular, 1 far). These lengths allow {0.assemblies} assemblies; the one at home is taken."
)


@dataclass(frozen=True)
class BoardCheck:
    """The board in one station's photographs.

    found : photographs that show it. corners : mean number in these, of ``corners_of``. rms : px
    off their predicted places. scatter : px by which a board on the base wanders from photograph
    to photograph; nan where it need not stand still, or is seen once. distance : m. unseen : an
    outer row or column that no photograph shows though it shows all others, in words.
    """

    found: int
    corners: float
    corners_of: int
    rms: float
    scatter: float
    distance: float
    unseen: str = ""


@dataclass(frozen=True)
class JointCheck:
    """One joint's readings, m or rad; used : share of its range, ends : readings near either end
    of it (NaN and 0 where the mechanism file gives no range).
    """

    name: str
    low: float
    high: float
    used: float
    ends: tuple[int, int]


@dataclass(frozen=True)
class StationCheck:
    """One station. mismatch : 0 perfect, 1 nothing fits; by_chance : probability that wrong
    readings fit as well; NaN where not looked for.

    moved, turned : from the pose by hand to the one found, m and rad. legs : mean number found in
    a photograph. saturated, black : mean shares of the legs' pixels. blur : median, px. board :
    where the station observes one and it was found.
    """

    name: str
    photographs: int
    recognised: bool
    mismatch: float = math.nan
    moved: float = math.nan
    turned: float = math.nan
    legs: float = math.nan
    saturated: float = math.nan
    black: float = math.nan
    blur: float = math.nan
    board: BoardCheck | None = None
    by_chance: float = math.nan


@dataclass(frozen=True)
class SessionCheck:
    """All that was found. singularity : least over the configurations, 1 good, 0 singular.

    assemblies : ways to assemble the machine at the first configuration's readings. forecast : what
    a full capture would give, where the first photographs tell. advice : what would make it better.
    look : where the machine was looked for, for pictures; None where it could not be.
    """

    folder: str
    findings: tuple[Finding, ...]
    machine: str = ""
    n_legs: int = 0
    configurations: int = 0
    stations: tuple[StationCheck, ...] = ()
    joints: tuple[JointCheck, ...] = ()
    singularity: float = math.nan
    assemblies: int = 0
    forecast: Forecast | None = None
    advice: tuple[str, ...] = ()
    look: Look | None = None

    @property
    def exit_code(self) -> int:
        """2 where calibrating would be refused, 1 where its result would be doubtful, else 0."""
        return _exit_code(self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Everything under its name, for ``--json``, and the first error as every command's."""
        seen = self.forecast and replace(self.forecast, edges=())
        out = plain(asdict(replace(self, look=None, forecast=seen, findings=())))
        out.pop("look")
        out["findings"] = [finding.document() for finding in self.findings]
        if self.forecast:
            out["forecast"].pop("edges")
        return first_error(self.findings) | out


def _exit_code(findings: Sequence[Finding]) -> int:
    levels = {finding.level for finding in findings}
    return 2 if Level.WRONG in levels else 1 if Level.DOUBTFUL in levels else 0


def check_session(
    folder: Path | str, *, seed: int = 0, progress: Progress | None = None
) -> SessionCheck:
    """Look through a session; what is wrong comes back as findings, nothing is raised.

    seed : of the random searches, as in `calibrate`.
    """
    # As in `calibrate`: threads inside the linear algebra would only be in each other's way.
    with threadpool_limits(1, "blas"):
        return _check(Path(folder), seed, progress or (lambda _text, _share: None))


def _check(folder: Path, seed: int, told: Progress) -> SessionCheck:
    """:func:`check_session`, step by step."""
    told("Reading the session", 0.0)
    findings = [doubtful(text) for text in untouched_files(folder)]
    try:
        session = load_session(folder)
    except PkmcalError as error:
        return SessionCheck(str(folder), (wrong(error), *findings))
    findings += [note(text) for text in session.warnings] + _workspace(session)
    told("Reading photographs", 0.1)
    photographs, broken = _decoded(session)
    told("Recognising the machine", 0.4)
    motion = _kinematics(session, np.random.default_rng(seed))
    rng = np.random.default_rng(seed)
    seen = _observed(session, photographs, motion.poses, rng)
    stations, joints = seen.stations, joint_checks(session)
    findings += [*broken, *motion.findings, *seen.findings, *joint_findings(session, joints)]
    findings += [note(text) for text in numbering_told(session)]
    told("What such photographs will give", 0.8)
    by_hand = any(station.handheld for station in session.stations)  # no place to come back to
    expected = forecast(seen.look) if seen.look and not by_hand else None
    for station in stations:
        findings += _station_findings(station, session.machine.n_legs)
    return SessionCheck(
        folder=str(folder),
        findings=tuple(sorted(findings, key=lambda finding: list(Level).index(finding.level))),
        machine=session.machine.name,
        n_legs=session.machine.n_legs,
        configurations=len(session.configurations),
        stations=stations,
        joints=joints,
        singularity=motion.singularity,
        assemblies=motion.assemblies,
        forecast=expected,
        advice=advice(seen.look, expected) if seen.look else (),
        look=seen.look,
    )


def _workspace(session: Session) -> list[Finding]:
    """Whether the drawing's machine comes to the workspace that the session names."""
    if session.workspace is None:
        return []
    try:
        poses_in(session.machine.limits(), session.workspace, 1)
    except PkmcalError as error:
        return [doubtful(str(error.located("session.yaml, workspace")))]
    return []


def _decoded(session: Session) -> tuple[list[legs.Photographs | None], list[Finding]]:
    """Each station's photographs of legs; those that cannot be decoded are findings."""
    out: list[legs.Photographs | None] = []
    findings: list[Finding] = []
    room = KEPT
    for number, station in enumerate(session.stations):
        if "legs" not in station.observe:  # decoded one by one where the board is looked for
            out.append(None)
            continue
        rows: list[int] = []
        files: list[tuple[Path, str]] = []
        kept: dict[int, Integers] = {}
        broken = 0
        for photo in station.photographs:
            label = label_of(session.folder, photo.path)
            try:
                image = decode(photo.path, station.camera.image_size, label)
            except InputError as error:
                broken += 1
                if broken <= NAMED:
                    findings.append(wrong(error, station.name))
                continue
            if image.size <= room:
                kept[len(rows)], room = image, room - image.size
            rows.append(photo.configuration)
            files.append((photo.path, label))
        if broken > NAMED:
            findings.append(wrong(_more_broken(session, number, broken - NAMED), station.name))
        at = np.array(rows, dtype=int)
        images = Pictures([p for p, _ in files], station.camera.image_size,
                          [label for _, label in files], kept)  # fmt: skip
        whole = legs.Photographs(number, station.camera, at, session.joints[at], images)
        out.append(whole if rows else None)
    return out, findings


def _more_broken(session: Session, number: int, count: int) -> InputError:
    """The error about all photographs of a station that cannot be decoded but those named."""
    name = session.stations[number].name
    return InputError(
        "photographs cannot be decoded",
        where=f"session.yaml, stations.{name}",
        found=f"{count} more of this station",
        expected="whole PNG or JPEG files",
        next_step="Copy them again from the camera, or remove them",
    )


@dataclass(frozen=True)
class _Motion:
    """poses : T_base_platform (K, 4, 4), None where the drawing cannot take the readings."""

    poses: Array | None
    singularity: float
    assemblies: int
    findings: tuple[Finding, ...]


def _kinematics(session: Session, rng: np.random.Generator) -> _Motion:
    """Whether the drawing's machine closes at all readings, and how well it is held there."""
    try:
        poses = platform_poses(session, most=not legs_stations(session))
        found = session.machine.forward_result(session.joints, poses)
        first = session.joints[0]
        if session.machine.layout.overdetermined:  # with errors they close in no pose
            first = session.machine.inverse(poses[0])
        modes = session.machine.assembly_modes(first, rng)
    except PkmcalError as error:
        return _Motion(None, math.nan, 0, (wrong(error),))
    findings: list[Finding] = []
    weak = [session.configurations[k] for k in np.flatnonzero(found.singularity < NEAR_SINGULAR)]
    if weak:
        findings.append(
            doubtful(
                f"Near a singular pose in configuration {listed(weak)}: there the readings hardly"
                " say where the platform is. Leave them out.",
            )
        )
    turns = np.linalg.norm(pose_difference(modes, poses[0])[:, :3], axis=-1)
    if np.any((turns > 1e-3) & (turns < OTHER_MODE)):
        findings.append(
            doubtful(
                f"At configuration {session.configurations[0]} the same readings allow another"
                f" pose, turned by only {np.rad2deg(turns[turns > 1e-3].min()):.0f} degrees."
                " Give home: {position: ...} in the mechanism file, near the machine's real pose.",
            )
        )
    return _Motion(poses, float(found.singularity.min()), len(modes), tuple(findings))


class _Observed(NamedTuple):
    """look : None where the machine could not be looked for."""

    stations: tuple[StationCheck, ...]
    findings: tuple[Finding, ...]
    look: Look | None = None


def _observed(
    session: Session,
    photographs: list[legs.Photographs | None],
    poses: Array | None,
    rng: np.random.Generator,
) -> _Observed:
    """What the photographs of every station show, and what is to be said of it."""
    whole = [p for p in photographs if p is not None]

    def unlooked() -> tuple[StationCheck, ...]:
        """Stations in which the machine could not even be looked for."""
        n_legs, found = session.machine.n_legs, zip(session.stations, photographs, strict=True)
        return tuple(
            _summary(station, unrecognised_quality(p.images if p else [], n_legs), recognised=False)
            for station, p in found
        )

    try:
        check_observable(session)
    except InputError as error:
        return _Observed(unlooked(), (wrong(error),))
    if poses is None or len(whole) < len(legs_stations(session)):
        return _Observed(unlooked(), ())
    # Of photographs that are broken is told already.
    lost = any(len(p.images) < len(session.stations[p.station].photographs) for p in whole)
    boards = BoardsCheck()
    if not lost:
        boards = check_boards(session, board_images(session, whole))
        lost = any(finding.level is Level.WRONG for finding in boards.findings)
    if lost and any(station.T_camera_base is None for station in session.stations):
        return _Observed(unlooked(), boards.findings)
    told = (*boards.findings, *(() if lost else pose_findings(session, boards.boards)))
    rngs = rng.spawn(len(whole) + 1)
    try:
        starts = None if lost else known_stations(session, boards.boards)
    except PkmcalError as error:
        return _Observed(unlooked(), (wrong(error), *boards.findings))
    fixed = [p for p in whole if not session.stations[p.station].handheld]
    recognition = recognise(session, fixed, poses, rngs[1 : len(fixed) + 1], boards.boards, starts)
    places = {p.station: found for p, found in zip(fixed, recognition.found, strict=True)}
    alone = found_alone(session, whole, poses)
    for k, one in alone.items():  # what chance is to others, another place is to one alone
        places[k] = FoundStation(
            one.T_camera_base[0], math.nan, float(one.evidence[0]), one.doubt, told=True
        )
        if not places[k].good:
            name = session.stations[k].name
            told = (*told, doubtful(f"{name} is left out, for {why_lost(one)}.", name))
    stations = [  # as it is known of one that observes no legs
        StationCheck(station.name, len(station.photographs), k in boards.checks)
        for k, station in enumerate(session.stations)
    ]
    looks: list[StationLook] = []
    for p in whole:
        stations[p.station], look = _station(session, p, places[p.station], poses)
        looks.append(look)
    stations = tuple(replace(s, board=boards.checks.get(k)) for k, s in enumerate(stations))
    look = Look(session, poses, tuple(looks)) if looks else None
    mistake = mistake_in(session, fixed, recognition, rngs[0])
    return _Observed(stations, (*([wrong(mistake)] if mistake else []), *told), look)


def _station(
    session: Session, photographs: legs.Photographs, pose: FoundStation, poses: Array
) -> tuple[StationCheck, StationLook]:
    """One station in which the machine was looked for."""
    number = photographs.station
    station, machine = session.stations[number], session.machine
    by_hand = station.T_camera_base
    look = StationLook(station.name, photographs, by_hand, pose.T_camera_base, None)
    if not pose.good:
        what = unrecognised_quality(photographs.images, machine.n_legs)
        summary = _summary(station, what, recognised=False)
        return replace(summary, mismatch=pose.score, by_chance=pose.by_chance), look
    what = quality(photographs, machine, pose.T_camera_base, poses[photographs.configuration])
    summary = _summary(station, what, recognised=True)
    summary = replace(summary, mismatch=pose.score, by_chance=pose.by_chance)
    look = replace(look, quality=what)
    if by_hand is None:
        return summary, look
    T_base_camera, by_hand = inverse(pose.T_camera_base), inverse(by_hand)
    change = pose_difference(T_base_camera, by_hand)
    summary = replace(
        summary,
        moved=float(np.linalg.norm(change[3:])),
        turned=float(np.linalg.norm(change[:3])),
    )
    return summary, look


def _summary(station: Station, what: Quality, recognised: bool) -> StationCheck:
    some = len(what.saturated) > 0
    blur = what.blur[np.isfinite(what.blur)]
    return StationCheck(
        name=station.name,
        photographs=len(station.photographs),
        recognised=recognised,
        legs=float(what.legs.sum(axis=1).mean()) if some else 0.0,
        saturated=float(what.saturated.mean()) if some else math.nan,
        black=float(what.black.mean()) if some else math.nan,
        blur=float(np.median(blur)) if blur.size else math.nan,
    )


def _station_findings(station: StationCheck, n_legs: int) -> list[Finding]:
    """What is doubtful about a station's photographs."""
    texts: list[str] = []
    if station.saturated > OVEREXPOSED:
        where = "the legs" if station.recognised else "the pictures"
        texts.append(
            f"{station.saturated:.0%} of {where} are overexposed: edges vanish in white. Take the"
            " photographs again with a shorter exposure."
        )
    if station.black > TOO_DARK:
        where = "the legs" if station.recognised else "the pictures"
        texts.append(
            f"{station.black:.0%} of {where} are black. Take the photographs again with a longer"
            " exposure, or more light."
        )
    if station.blur > BLURRED:
        texts.append(
            f"The edges are blurred over {station.blur:.1f} px. Focus on the legs, close the"
            " aperture, and wait until the machine stands still."
        )
    if station.recognised and station.legs < FEW_LEGS * n_legs:
        texts.append(
            f"Only {station.legs:.1f} of {n_legs} legs are found in a photograph on average."
            " Move the camera back or aside, so that it sees the legs one beside the other."
        )
    return [doubtful(f"{station.name}: {t}", station.name) for t in texts]


# ------------------------------------------------------------------ boards


@dataclass(frozen=True)
class BoardsCheck:
    """All stations' boards, by the station's number, and what is to be said of them."""

    boards: Boards = field(default_factory=Boards)
    checks: Mapping[int, BoardCheck] = field(default_factory=dict[int, BoardCheck])
    findings: tuple[Finding, ...] = ()


def check_boards(session: Session, images: Mapping[int, Sequence[Integers]]) -> BoardsCheck:
    """Look for the board in every station that observes it, nothing raised.

    images : all decoded photographs by the station's number.
    """
    findings: list[Finding] = []
    try:
        board = board_of(session)
    except InputError as error:
        return BoardsCheck(findings=(wrong(error),))
    if board is None:
        return BoardsCheck()
    found: dict[int, StationBoard] = {}
    for number, station in enumerate(session.stations):
        if "board" not in station.observe:
            continue
        try:
            found[number] = station_board(session, board, number, images[number])
        except InputError as error:
            findings.append(wrong(error, station.name))
    checks = {number: _board_check(one) for number, one in found.items()}
    for number, check in checks.items():
        findings += _board_findings(session, number, check)
    boards = Boards(found, session.board_body, board.tolerance)
    return BoardsCheck(boards, checks, tuple(findings))


def _unseen(one: StationBoard) -> str:
    """The outer row or column that is never seen though all others are."""
    board = one.seen.board
    if board.type == "aruco_grid":
        return ""
    seen = one.seen.views.seen.any(axis=0).reshape(board.counts[::-1])
    for name, axis, at in (("row", 0, 0), ("row", 0, -1), ("column", 1, 0), ("column", 1, -1)):
        if not np.take(seen, at, axis).any() and np.delete(seen, at, axis).all():
            return f"the {'first' if at == 0 else 'last'} {name}"
    return ""


def _board_check(one: StationBoard) -> BoardCheck:
    seen, stood = one.seen, one.stood
    return BoardCheck(
        found=len(seen.shown),
        corners=float(seen.views.seen.sum(axis=1).mean()),
        corners_of=len(seen.board.points),
        rms=float(np.median(seen.rms)),
        scatter=stood.scatter if stood else math.nan,
        distance=float(np.median(np.linalg.norm(seen.poses.T_camera_board[:, :3, 3], axis=-1))),
        unseen=_unseen(one),
    )


def _board_findings(session: Session, number: int, check: BoardCheck) -> list[Finding]:
    name = session.stations[number].name
    found: list[Finding] = []
    if check.rms > POOR_CORNERS:
        text = (
            f"{name}: The board's corners lie {check.rms:.2g} px off their places, rms; a flat"
            " board, a sharp photograph and the right camera file leave a tenth of a pixel."
        )
        found.append(doubtful(text, name))
    if check.unseen:
        text = (
            f"{name}: {check.unseen.capitalize()} of the board's corners is in no photograph: does"
            " the board have as many squares as its file says?"
        )
        found.append(doubtful(text, name))
    photographs = len(session.stations[number].photographs)
    if session.board_body == "base" and check.found == 1 and photographs > 1:
        text = (
            f"{name}: Only one photograph shows the board on the base, so nobody can tell whether"
            " it, or the camera, stood still."
        )
        found.append(note(text, name))
    return found


# ------------------------------------------------------------------ readings and poses


def joint_checks(session: Session) -> tuple[JointCheck, ...]:
    """All joints' readings."""
    found: list[JointCheck] = []
    for k, name in enumerate(session.document["joints"]["columns"]):
        values, (low, high) = session.joints[:, k], session.machine.joint_ranges[k]
        stroke = high - low
        ends = (int(np.sum(values < low + END * stroke)), int(np.sum(values > high - END * stroke)))
        used = float(np.ptp(values) / stroke)
        found.append(JointCheck(name, float(values.min()), float(values.max()), used, ends))
    return tuple(found)


def joint_findings(session: Session, joints: tuple[JointCheck, ...]) -> list[Finding]:
    """What is doubtful, or worth knowing, about where the machine was photographed."""
    findings: list[Finding] = []
    if session.heights_alone:  # a bed lies where it lies
        return findings
    crowded = [joint for joint in joints if joint.used < LITTLE_USED]
    if crowded:
        findings.append(
            note(
                f"{listed([joint.name for joint in crowded])} used little of the range (down to"
                f" {min(joint.used for joint in crowded):.0%}): readings near both ends of it"
                " halve the standard deviations of the offsets.",
            )
        )
    count = len(session.configurations)
    if count < FEW_CONFIGURATIONS:
        findings.append(
            note(
                f"There are only {count} configurations: standard deviations will be large and"
                " mistakes hard to notice. 15 or more are usual.",
            )
        )
    return findings + _poses_of_many_names(session)


def _poses_of_many_names(session: Session) -> list[Finding]:
    """That configurations are of one pose, by their readings, and how to say so."""
    owner = same_pose(session.joints, session.joint_noise)
    first, names = np.unique(owner, return_counts=True)
    if len(first) == len(owner):
        return []
    alike = [
        session.configurations[k] for k in np.flatnonzero(owner == first[np.argmax(names > 1)])
    ]
    others = ", and so on" if np.sum(names > 1) > 1 else ""
    told = [
        f"{len(owner)} configurations are of {len(first)} poses: the readings of"
        f" {listed(alike)} are equal within their noise{others}. --holdout and --regions leave"
        " those of a pose out together."
    ]
    again = {
        station.entry or station.name
        for station in session.stations
        if len({owner[photo.configuration] for photo in station.photographs})
        < len({photo.configuration for photo in station.photographs})
    }
    if session.stations:  # a tracker's table has one row a configuration
        told.append(
            "Where the machine moved away between them and came back, all is well. Where it stood"
            " still, tell that it is one pose:"
        )
    if again:
        entry = min(again)
        pattern = session.document["stations"][entry]["images"]
        if "{repeat}" not in pattern:
            pattern = pattern.replace("{configuration}", "{configuration}_{repeat}")
        files = [pattern.format(configuration=alike[0], repeat=k) for k in (1, 2)]
        told.append(
            f"at {listed(sorted(again))} name its photographs {' and '.join(files)}, with"
            f" images: {pattern}, and keep one of its rows in joints.csv."
        )
    elif session.stations:
        told.append(
            f"its photographs bear one name at all stations, such as {alike[0]}, and it has one row"
            " in joints.csv."
        )
    return [note(" ".join(told))]


def pose_findings(session: Session, boards: Boards) -> list[Finding]:
    """How the platform turns, and, where no legs are needed for it, whether the poses fit."""
    if not session.trackers and (not boards.stations or boards.body == "base"):
        return []
    try:
        measurements = measurements_of(session, boards)
        turns = turning(session, measurements.poses, measurements.on_platform)
        findings = [doubtful(text) if bad else note(text) for bad, text in turns]
        if any("legs" in station.observe for station in session.stations):
            return findings
        return findings + _fit(session, boards)
    except InputError as error:
        return [wrong(error)]
    except PkmcalError as error:
        return [doubtful(str(error))]


def _fit(session: Session, boards: Boards) -> list[Finding]:
    """Whether the mechanism, its parameters adjusted, explains the poses."""
    known = station_poses(session, [], boards, np.random.default_rng(0))
    cameras = refinement_of(session, refine=False)
    turns = identify_poses(session, boards, known, cameras, lambda _text, _share: None)
    richer = richer_models(session, turns.measurements, turns.estimate)
    check_poses(session, turns.measurements, turns.estimate, richer)
    scale = turns.estimate.statistics.pose_scale
    if scale <= POOR:
        return []
    better = min(richer, key=lambda model: model.scale, default=None)
    told = f" With --model {better.name} it is {better.scale:.2f} times." if better else ""
    text = f"The machine explains the measured poses only to {scale:.1f} times their noise.{told}"
    return [doubtful(text)]


# ------------------------------------------------------------------ in words


def outcome_of(found: SessionCheck, study: RepeatStudy | None = None) -> Outcome:
    """What was found, for people and programs; study : of the session's repeats."""
    findings = (*found.findings, *(study.findings if study else ()))
    headlines = (
        f"Nothing is wrong. Next: pkmcal calibrate {shlex.quote(found.folder)}",
        "It can be calibrated, but the marked points will cost accuracy.",
        "It cannot be calibrated yet.",
    )
    code = _exit_code(findings)
    name = found.folder
    if Path(name).name in ("", ".."):  # "." and the like name nothing to a reader
        name = Path(name).resolve().name or name
    parts: tuple[Part, ...] = ()
    if found.machine:
        said = KINEMATICS.format(found) if math.isfinite(found.singularity) else ""
        tables = (_stations_table(found), _boards_table(found), _joints_table(found.joints))
        parts = (
            Part(
                "session",
                "What was looked at",
                said=(said,) if said else (),
                tables=tuple(table for table in tables if table.rows),
            ),
        )
    if found.forecast:
        parts = (*parts, forecast_part(found.forecast))
    photographs = sum(station.photographs for station in found.stations)
    return Outcome(
        command="check",
        title=f"Check of {name}",
        subject=f"{name}: {found.machine}, {found.n_legs} legs,"
        f" {found.configurations} configurations, {photographs} photographs"
        if found.machine
        else "",
        verdict=Verdict(code == 0, headlines[code], advice=found.advice),
        stamp=("Ready", "Doubtful", "Not yet")[code],
        level=Level.WRONG if code == 2 else Level.DOUBTFUL,
        figures=(forecast_figure(found.forecast),) if found.forecast else (),
        parts=(*parts, part_of(study)) if study else parts,
        findings=findings,
        document=found.as_dict(),
    )


def _stations_table(found: SessionCheck) -> Table:
    rows: list[Row] = []
    for station in found.stations:
        levels = {f.level for f in found.findings if f.station == station.name}
        if not station.recognised:
            levels.add(Level.WRONG)
        worst = [level for level in Level if level in levels]
        mark: Mark = worst[0] if worst else "good"
        moved = f"{station.moved * 1e3:.0f} mm, {math.degrees(station.turned):.1f}°"
        seen = station.recognised and math.isfinite(station.legs)
        cells = (
            str(station.photographs),
            _number(station.by_chance, "{:.0e}"),
            moved if math.isfinite(station.moved) else "–",
            f"{station.legs:.1f}/{found.n_legs}" if seen else "–",
            _number(station.saturated, "{:.0%}"),
            _number(station.black, "{:.0%}"),
            _number(station.blur, "{:.1f} px"),
        )
        rows.append(Row(station.name, cells, mark=mark))
    columns = ("Station", "Photos", "By chance", "Moved", "Legs", "White", "Black", "Blur")
    return Table("", columns, tuple(rows), " ".join(STATION_LEGEND), legend=STATION_LEGEND)


def _boards_table(found: SessionCheck) -> Table:
    rows = tuple(
        Row(
            station.name,
            (
                f"{board.found} of {station.photographs}",
                f"{board.corners:.0f}/{board.corners_of}",
                f"{board.rms:.3f} px",
                _number(board.scatter, "{:.3f} px"),
                f"{board.distance:.2f} m",
            ),
            mark="good",
        )
        for station in found.stations
        if (board := station.board) is not None
    )
    columns = ("Board", "Seen", "Corners", "Off", "Wander", "Distance")
    return Table("", columns, rows, legend=BOARD_LEGEND)


def _joints_table(joints: tuple[JointCheck, ...]) -> Table:
    rows = tuple(
        Row(
            joint.name,
            (
                f"{joint.low:.4f}",
                f"{joint.high:.4f}",
                _number(joint.used, "{:.0%}"),
                f"{joint.ends[0]} + {joint.ends[1]}" if math.isfinite(joint.used) else "–",
            ),
            mark=Level.NOTE if joint.used < LITTLE_USED else "good",
        )
        for joint in joints
    )
    return Table("", ("Joint", "Lowest", "Highest", "Of its range", "Near the ends"), rows)


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"
