"""Find what is wrong with a session before any work is spent on it.

Everything that `load_session` refuses, then what only the photographs can tell: whether they
decode, are exposed and sharp, and whether the machine is recognised in them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.calibrate import Progress
from pkmcal.calibration.gather import known_stations
from pkmcal.calibration.recognise import (
    Recognition,
    board_images,
    check_observable,
    legs_stations,
    platform_poses,
    recognise,
    why_unrecognised,
)
from pkmcal.check.check import (
    BoardCheck,
    BoardsCheck,
    JointCheck,
    check_boards,
    joint_checks,
    joint_findings,
    pose_findings,
)
from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import plain
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.observe import legs
from pkmcal.observe.images import decode
from pkmcal.observe.quality import Quality, quality, unrecognised_quality
from pkmcal.outcome import Finding, Level, wrong
from pkmcal.session.load import Session, Station, load_session
from pkmcal.session.photographs import label_of
from pkmcal.session.starter import untouched_files
from pkmcal.wording import listed

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


@dataclass(frozen=True)
class StationCheck:
    """One station. mismatch : 0 perfect, 1 nothing fits; NaN where not looked for.

    moved, turned : from the pose by hand to the one found, m and rad. legs : mean number found in
    a photograph. saturated, black : mean shares of the legs' pixels. blur : median, px. board :
    where the station observes one and it was found.
    """

    name: str
    photographs: int
    recognised: bool
    mismatch: float
    moved: float
    turned: float
    legs: float
    saturated: float
    black: float
    blur: float
    board: BoardCheck | None = None


@dataclass(frozen=True)
class SessionCheck:
    """All that was found. singularity : least over the configurations, 1 good, 0 singular.

    assemblies : ways to assemble the machine at the first configuration's readings.
    """

    folder: str
    findings: tuple[Finding, ...]
    machine: str = ""
    n_legs: int = 0
    configurations: int = 0
    stations: tuple[StationCheck, ...] = ()
    joints: tuple[JointCheck, ...] = ()
    singularity: float = float("nan")
    assemblies: int = 0

    @property
    def exit_code(self) -> int:
        """2 where calibrating would be refused, 1 where its result would be doubtful, else 0."""
        levels = {finding.level for finding in self.findings}
        return 2 if Level.WRONG in levels else 1 if Level.DOUBTFUL in levels else 0

    def as_dict(self) -> dict[str, Any]:
        """Everything under its name, for ``--json``."""
        return {"exit_code": self.exit_code, **plain(asdict(self))}


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
    findings = [Finding(Level.DOUBTFUL, text) for text in untouched_files(folder)]
    try:
        session = load_session(folder)
    except PkmcalError as error:
        return SessionCheck(str(folder), (wrong(error), *findings))
    findings += [Finding(Level.NOTE, text) for text in session.warnings]
    told("Reading photographs", 0.1)
    photographs, broken = _decoded(session)
    told("Recognising the machine", 0.4)
    motion = _kinematics(session, np.random.default_rng(seed))
    seen = _observed(session, photographs, motion.poses, np.random.default_rng(seed))
    joints = joint_checks(session)
    findings += [*broken, *motion.findings, *seen.findings, *joint_findings(session, joints)]
    for station in seen.stations:
        findings += _station_findings(station, session.machine.n_legs)
    return SessionCheck(
        folder=str(folder),
        findings=tuple(sorted(findings, key=lambda finding: list(Level).index(finding.level))),
        machine=session.machine.name,
        n_legs=session.machine.n_legs,
        configurations=len(session.configurations),
        stations=seen.stations,
        joints=joints,
        singularity=motion.singularity,
        assemblies=motion.assemblies,
    )


def _decoded(session: Session) -> tuple[list[legs.Photographs | None], list[Finding]]:
    """Each station's photographs of legs; those that cannot be decoded are findings."""
    out: list[legs.Photographs | None] = []
    findings: list[Finding] = []
    for number, station in enumerate(session.stations):
        if "legs" not in station.observe:  # decoded one by one where the board is looked for
            out.append(None)
            continue
        rows: list[int] = []
        images: list[Integers] = []
        for photo in station.photographs:
            label = label_of(session.folder, photo.path)
            try:
                images.append(decode(photo.path, station.camera.image_size, label))
                rows.append(photo.configuration)
            except InputError as error:
                findings.append(wrong(error, station.name))
        whole = legs.photographs_of(
            number, station.camera, np.array(rows, dtype=int), session.joints, images
        ) if images else None  # fmt: skip
        out.append(whole)
    return out, findings


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
        modes = session.machine.assembly_modes(session.joints[0], rng)
    except PkmcalError as error:
        return _Motion(None, float("nan"), 0, (wrong(error),))
    findings: list[Finding] = []
    weak = [session.configurations[k] for k in np.flatnonzero(found.singularity < NEAR_SINGULAR)]
    if weak:
        findings.append(
            Finding(
                Level.DOUBTFUL,
                f"Near a singular pose in configuration {listed(weak)}: there the readings hardly"
                " say where the platform is. Leave them out.",
            )
        )
    turns = np.linalg.norm(pose_difference(modes, poses[0])[:, :3], axis=-1)
    if np.any((turns > 1e-3) & (turns < OTHER_MODE)):
        findings.append(
            Finding(
                Level.DOUBTFUL,
                f"At configuration {session.configurations[0]} the same readings allow another"
                f" pose, turned by only {np.rad2deg(turns[turns > 1e-3].min()):.0f} degrees."
                " Give home: {position: ...} in the mechanism file, near the machine's real pose.",
            )
        )
    return _Motion(poses, float(found.singularity.min()), len(modes), tuple(findings))


@dataclass(frozen=True)
class _Seen:
    stations: tuple[StationCheck, ...]
    findings: tuple[Finding, ...] = ()


def _observed(
    session: Session,
    photographs: list[legs.Photographs | None],
    poses: Array | None,
    rng: np.random.Generator,
) -> _Seen:
    """What the photographs of every station show."""
    whole = [p for p in photographs if p is not None]
    try:
        check_observable(session)
    except InputError as error:
        return _Seen(_unlooked(session, photographs), (wrong(error),))
    if poses is None or len(whole) < len(legs_stations(session)):
        return _Seen(_unlooked(session, photographs))
    # Of photographs that are broken is told already.
    lost = any(len(p.images) < len(session.stations[p.station].photographs) for p in whole)
    boards = BoardsCheck()
    if not lost:
        boards = check_boards(session, board_images(session, whole))
        lost = any(finding.level is Level.WRONG for finding in boards.findings)
    if lost and any(station.T_camera_base is None for station in session.stations):
        return _Seen(_unlooked(session, photographs), boards.findings)
    told = (*boards.findings, *(() if lost else pose_findings(session, boards.boards)))
    rngs = rng.spawn(len(whole) + 1)
    try:
        starts = None if lost else known_stations(session, boards.boards)
    except PkmcalError as error:
        return _Seen(_unlooked(session, photographs), (wrong(error), *boards.findings))
    found = recognise(session, whole, poses, rngs[1:], boards.boards, starts)
    looked = {p.station: _station(session, p, found, poses) for p in whole}
    stations = tuple(
        replace(
            looked.get(k, _board_alone(station, k in boards.checks)), board=boards.checks.get(k)
        )
        for k, station in enumerate(session.stations)
    )
    if found.complete:
        return _Seen(stations, told)
    why = why_unrecognised(session, whole, found, rngs[0])
    return _Seen(stations, (wrong(why), *told))


def _board_alone(station: Station, seen: bool) -> StationCheck:
    """A station that observes no legs."""
    nan = float("nan")
    return StationCheck(
        station.name, len(station.photographs), seen, nan, nan, nan, nan, nan, nan, nan
    )


def _unlooked(
    session: Session, photographs: list[legs.Photographs | None]
) -> tuple[StationCheck, ...]:
    """Stations in which the machine could not even be looked for."""
    return tuple(
        _summary(
            station,
            unrecognised_quality(p.images if p else [], session.machine.n_legs),
            recognised=False,
        )
        for station, p in zip(session.stations, photographs, strict=True)
    )


def _station(
    session: Session, photographs: legs.Photographs, recognition: Recognition, poses: Array
) -> StationCheck:
    """One station in which the machine was looked for."""
    number = photographs.station
    pose = recognition.found[legs_stations(session).index(number)]
    station, machine = session.stations[number], session.machine
    if not pose.good:
        what = unrecognised_quality(photographs.images, machine.n_legs)
        return replace(_summary(station, what, recognised=False), mismatch=pose.score)
    what = quality(photographs, machine, pose.T_camera_base, poses[photographs.configuration])
    summary = replace(_summary(station, what, recognised=True), mismatch=pose.score)
    if station.T_camera_base is None:
        return summary
    T_base_camera, by_hand = inverse(pose.T_camera_base), inverse(station.T_camera_base)
    change = pose_difference(T_base_camera, by_hand)
    return replace(
        summary,
        moved=float(np.linalg.norm(change[3:])),
        turned=float(np.linalg.norm(change[:3])),
    )


def _summary(station: Station, what: Quality, recognised: bool) -> StationCheck:
    nan = float("nan")
    some = len(what.saturated) > 0
    blur = what.blur[np.isfinite(what.blur)]
    return StationCheck(
        name=station.name,
        photographs=len(station.photographs),
        recognised=recognised,
        mismatch=nan,
        moved=nan,
        turned=nan,
        legs=float(what.legs.sum(axis=1).mean()) if some else 0.0,
        saturated=float(what.saturated.mean()) if some else nan,
        black=float(what.black.mean()) if some else nan,
        blur=float(np.median(blur)) if blur.size else nan,
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
    return [Finding(Level.DOUBTFUL, f"{station.name}: {t}", station.name) for t in texts]
