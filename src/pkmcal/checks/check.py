"""Checks of a session before it is calibrated.

All checks of `load_session`; then checks of the images: whether they can be decoded, are well
exposed and sharp, and whether machine and boards are localized in them; then checks of the readings
and measured poses that do not need a calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from pkmcal.arrays import Array, Integers
from pkmcal.boards.stations import board_of, station_board
from pkmcal.boards.views import Boards, StationBoard
from pkmcal.calibration.calibrate import Clock, Settled, settle
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.case import Case
from pkmcal.calibration.discrepancy_basis import discrepancy_findings, explains_heights
from pkmcal.calibration.faults import turning
from pkmcal.calibration.handheld import Localization, localization_share, localize
from pkmcal.calibration.leg_numbering import numbering_note
from pkmcal.calibration.localization import (
    board_images,
    check_observable,
    legs_stations,
    platform_poses,
)
from pkmcal.calibration.model_violations import model_violations
from pkmcal.checks.advice import advice
from pkmcal.checks.forecast import NEAR_END, forecast
from pkmcal.checks.inspection import Inspection, StationInspection
from pkmcal.checks.results import BoardCheck, JointCheck, SessionCheck, StationCheck
from pkmcal.checks.sentences import (
    board_findings,
    joint_findings,
    link_findings,
    station_findings,
)
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.hand_eye import size_of
from pkmcal.identify.verdict import misfit
from pkmcal.judge.repeatability import require_repeats
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.mechanisms.region import poses_in
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.images import CACHED_IMAGE_BYTES, Pictures, decode
from pkmcal.observe.pose_candidates import SAME_POSE_TURN
from pkmcal.observe.quality import Quality, quality, unlocalized_quality
from pkmcal.observe.station_localization import LocalizedPose
from pkmcal.outcome.finding import Finding, Level, doubtful, note, of_error
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.session.image_files import label_of
from pkmcal.session.load import Session, Station, load_session
from pkmcal.starter import untouched_files
from pkmcal.wording import listed

SAME_SOLUTION_SHARE = 0.01
"""Distance of two assembly modes, relative to that of a near one, below which they are one solution
of the forward kinematics."""
BROKEN_IMAGES_NAMED = 10
"""Number of broken images of a station that are reported individually; the others are counted."""


def check_session(
    folder: Path | str, *, seed: int = 0, repeat: bool = False, progress: Progress = no_progress
) -> SessionCheck:
    """Check a session; faults are returned as findings, never raised.

    seed : of the random searches, as in `calibrate`.
    repeat : raise InputError, before the images are read, for a session without repeated images.
    """
    # as in `calibrate`: threads inside the linear algebra would hinder each other
    with threadpool_limits(1, "blas"):
        return _check(Path(folder), seed, repeat, progress)


def _check(folder: Path, seed: int, repeat: bool, progress: Progress) -> SessionCheck:
    """Steps of :func:`check_session`."""
    progress("Reading the session", 0.0)
    findings = [*untouched_files(folder)]
    try:
        session = load_session(folder)
    except PkmcalError as error:
        return SessionCheck(str(folder), (of_error(error), *findings))
    if repeat:
        require_repeats(session)
    findings += [replace(one, level=Level.NOTE) for one in session.findings] + _workspace(session)
    # hand-held images take so long that reading them is a small share
    by_hand = any(station.handheld for station in session.stations)
    reading, searched = (0.02, 0.95) if by_hand else (0.2, 0.8)
    progress("Reading images" if session.stations else "Reading the measurements", reading / 4)
    images, broken = _decode_images(session)
    progress("Localizing the stations", reading / 2)
    motion = _kinematics(session, np.random.default_rng(seed))
    # Images, readings, links and numbering of the legs.
    observed = _check_images(session, images, motion.poses, seed, part(progress, reading, searched))
    stations, joints = observed.stations, joint_checks(session)
    findings += [*broken, *motion.findings, *observed.findings, *joint_findings(session, joints)]
    findings += link_findings(session, motion.poses)
    findings += numbering_note(session)
    # Forecast of a full capture.
    progress("What such images will give", searched)
    expected = None
    if observed.inspection:
        try:
            expected = forecast(observed.inspection)
        except (PkmcalError, np.linalg.LinAlgError) as error:
            findings.append(note("images.no_forecast", why=str(error).rstrip(".")))
    for station in stations:
        findings += station_findings(station, session.machine.n_legs)
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
        advice=advice(observed.inspection, expected) if observed.inspection else (),
        look=observed.inspection,
    )


def _workspace(session: Session) -> list[Finding]:
    """Finding if the nominal machine does not reach the session's workspace."""
    if session.workspace is None:
        return []
    try:
        poses_in(session.machine.limits(), session.workspace, 1)
    except PkmcalError as error:
        return [of_error(error.located("session.yaml, workspace"), Level.DOUBTFUL)]
    return []


def _decode_images(session: Session) -> tuple[list[StationImages | None], list[Finding]]:
    """Images of legs by station, None for a station without any, and findings on those that cannot
    be decoded.
    """
    out: list[StationImages | None] = []
    findings: list[Finding] = []
    room = CACHED_IMAGE_BYTES
    for number, station in enumerate(session.stations):
        # images of the board are decoded one by one in the search for it
        if "legs" not in station.observe:
            out.append(None)
            continue
        rows: list[int] = []
        files: list[tuple[Path, str]] = []
        cache: dict[int, Integers] = {}
        broken = 0
        for photo in station.images:
            label = label_of(session.folder, photo.path)
            try:
                image = decode(photo.path, station.camera.image_size, label)
            except InputError as error:
                broken += 1
                if broken <= BROKEN_IMAGES_NAMED:
                    findings.append(of_error(error, station=station.name))
                continue
            if image.size <= room:
                cache[len(rows)], room = image, room - image.size
            rows.append(photo.configuration)
            files.append((photo.path, label))
        if broken > BROKEN_IMAGES_NAMED:
            more = InputError(
                "images cannot be decoded",
                where=f"session.yaml, stations.{station.name}",
                found=f"{broken - BROKEN_IMAGES_NAMED} more of this station",
                expected="whole PNG or JPEG files",
                next_step="Copy them again from the camera, or remove them",
            )
            findings.append(of_error(more, station=station.name))
        at = np.array(rows, dtype=int)
        images = Pictures([p for p, _ in files], station.camera.image_size,
                          [label for _, label in files], cache)  # fmt: skip
        whole = StationImages(
            number, station.camera, at, session.joints[at], images, station.response,
            legs.first_binning(station.camera.image_size),
        )  # fmt: skip
        out.append(whole if rows else None)
    return out, findings


@dataclass(frozen=True)
class _NominalKinematics:
    """Kinematics of the nominal machine at the readings.

    poses : T_base_platform (K, 4, 4), None if the closure fails at some readings, or if the legs do
        not hold the platform.
    singularity : least over the configurations.
    assemblies : number of assembly modes at the first readings.
    """

    poses: Array | None
    singularity: float
    assemblies: int
    findings: tuple[Finding, ...]


def _kinematics(session: Session, rng: np.random.Generator) -> _NominalKinematics:
    """Whether the nominal machine closes at all readings, with its singularity and assembly modes
    there.
    """
    if session.machine.layout.underdetermined:
        return _NominalKinematics(None, math.nan, 0, (note("machine.not_held"),))
    try:
        poses, fk = platform_poses(session, most=not legs_stations(session)), session.forward
        first = session.joints[0]
        # an overdetermined machine does not close at readings with errors
        if session.machine.layout.overdetermined:
            first = session.machine.inverse(poses[0])
        modes = session.machine.assembly_modes(first, rng)
    except PkmcalError as error:
        return _NominalKinematics(None, math.nan, 0, (of_error(error),))
    findings: list[Finding] = []
    weak = [session.configurations[k] for k in np.flatnonzero(fk.singularity < NEAR_SINGULAR)]
    if weak:
        findings.append(doubtful("configurations.singular_readings", listed(weak), names=weak))
    # the mirror image below a flat base is turned little, but far away
    apart = pose_difference(modes, poses[0])
    turns, shifts = (np.linalg.norm(part, axis=-1) for part in (apart[:, :3], apart[:, 3:]))
    reach = SAME_POSE_TURN * size_of(session.machine)
    near = np.hypot(turns / SAME_POSE_TURN, shifts / reach)
    near = np.where(near > SAME_SOLUTION_SHARE, near, np.inf)
    # no mode: the legs reach within their prior sigmas, but not with their nominal values
    if near.min(initial=np.inf) < 1:
        nearest = int(near.argmin())
        findings.append(
            doubtful(
                "configurations.other_assembly", session.configurations[0],
                turn=float(turns[nearest]), shift=float(shifts[nearest]),
            )
        )  # fmt: skip
    return _NominalKinematics(poses, float(fk.singularity.min()), len(modes), tuple(findings))


class _ImageChecks(NamedTuple):
    """Results of the checks of the images.

    inspection : None if the machine could not be searched for.
    """

    stations: tuple[StationCheck, ...]
    findings: tuple[Finding, ...]
    inspection: Inspection | None = None


def _check_images(
    session: Session,
    images: list[StationImages | None],
    poses: Array | None,
    seed: int,
    progress: Progress,
) -> _ImageChecks:
    """Checks of the images of every station: boards, localization, and the start of a
    calibration.
    """
    whole = [p for p in images if p is not None]
    try:
        check_observable(session)
    except InputError as error:
        return _ImageChecks(_unsearched(session, images), (of_error(error),))
    if poses is None or len(whole) < len(legs_stations(session)):
        return _ImageChecks(_unsearched(session, images), ())
    # Broken images have been reported already.
    lost = any(len(p.images) < len(session.stations[p.station].images) for p in whole)
    boards = BoardsCheck()
    if not lost:
        boards = look_for_boards(session, board_images(session, whole))
        lost = any(finding.level is Level.WRONG for finding in boards.findings)
    if lost and any(station.T_camera_base is None for station in session.stations):
        return _ImageChecks(_unsearched(session, images), boards.findings)
    turn_findings = () if lost else pose_findings(session, boards.boards)
    share = localization_share(session)
    located = localize(  # with the random numbers of `calibrate`
        session,
        whole,
        boards.boards,
        np.random.default_rng(seed),
        part(progress, 0, share),
    )
    settled: Settled | PkmcalError | None = None
    if isinstance(located.result, PkmcalError):
        settled = located.result
    elif not lost and not any(finding.level is Level.WRONG for finding in turn_findings):
        settled = _calibration_start(session, located.result, seed, part(progress, share, 1))
    case = located.result if not isinstance(settled, Settled) else settled.case
    rejected = () if isinstance(case, PkmcalError) else case.session.rejected
    findings = [
        *([_refusal(settled)] if isinstance(settled, PkmcalError) else []),
        *boards.findings,
        *turn_findings,
        *(one.finding for one in rejected),
    ]
    if isinstance(settled, Settled):
        findings += settled.findings
        heights = settled.case.session.heights_alone
        findings += _height_findings(settled) if heights else _misfit_findings(settled)
    # A rejected station on a tripod was recognized, and its quality may explain the rejection.
    rejected_names = {one.station.name for one in rejected if one.station.handheld}
    if isinstance(case, PkmcalError):  # no hand-held image was localized then
        rejected_names = {station.name for station in session.stations if station.handheld}
    localized = _search_results(session, whole, located)
    stations, inspection = _searched(session, whole, poses, localized, boards, rejected_names)
    return _ImageChecks(stations, tuple(findings), inspection)


def _unsearched(session: Session, images: list[StationImages | None]) -> tuple[StationCheck, ...]:
    """Checks of stations in which the machine cannot be searched for."""
    n_legs, observed = session.machine.n_legs, zip(session.stations, images, strict=True)
    return tuple(
        _station_check(
            station, unlocalized_quality(p.images if p else [], n_legs), recognised=False
        )
        for station, p in observed
    )


def _searched(
    session: Session,
    images: list[StationImages],
    poses: Array,
    localized: dict[int, LocalizedPose],
    boards: BoardsCheck,
    rejected: set[str],
) -> tuple[tuple[StationCheck, ...], Inspection | None]:
    """Checks of all stations after the search for the machine, and the images of those with a
    pose.

    localized : poses by station. rejected : names of the stations whose pose is not accepted.
    """
    stations = [  # default for stations that observe no legs
        StationCheck(station.name, len(station.images), k in boards.checks)
        for k, station in enumerate(session.stations)
    ]
    parts: list[StationInspection] = []
    for p in images:
        if p.station not in localized:  # the search ended at the fault of another station
            summary = unlocalized_quality(p.images, session.machine.n_legs)
            stations[p.station] = _station_check(
                session.stations[p.station], summary, recognised=False
            )
            continue
        pose = localized[p.station]
        recognised = pose.good and stations[p.station].name not in rejected
        stations[p.station], part = _check_station(session, p, pose, poses, recognised)
        parts.append(part)
    checks = tuple(replace(s, board=boards.checks.get(k)) for k, s in enumerate(stations))
    return checks, Inspection(session, poses, tuple(parts)) if parts else None


def _calibration_start(
    session: Session, case: Case, seed: int, progress: Progress
) -> Settled | PkmcalError:
    """Start of a calibration as `calibrate` computes it, or the error with which it would end."""
    try:
        return settle(session, case, False, seed, Clock(progress))
    except PkmcalError as error:
        return error


def _refusal(error: PkmcalError) -> Finding:
    """Finding of an error of `calibrate`: wrong if the session is at fault, doubtful if its data
    are insufficient.
    """
    return of_error(error, Level.WRONG if error.exit_code > 1 else Level.DOUBTFUL)


def _search_results(
    session: Session, images: list[StationImages], located: Localization
) -> dict[int, LocalizedPose]:
    """Localized poses by station number, without stations that were not searched."""
    fixed = [p.station for p in images if not session.stations[p.station].handheld]
    localizations = located.leg_localization.localizations if located.leg_localization else ()
    places = dict(zip(fixed, localizations, strict=bool(localizations)))
    places |= {k: LocalizedPose.of_image(one, True) for k, one in located.places.items()}
    return places


def _check_station(
    session: Session,
    images: StationImages,
    pose: LocalizedPose,
    poses: Array,
    recognised: bool,
) -> tuple[StationCheck, StationInspection]:
    """Check and inspection of a station in which the machine was searched for."""
    station, machine = session.stations[images.station], session.machine
    T_camera_base, by_hand = pose.T_camera_base, station.T_camera_base
    leg_quality = (
        quality(images, machine, T_camera_base, poses[images.configuration])
        if recognised
        else unlocalized_quality(images.images, machine.n_legs)
    )
    summary = replace(
        _station_check(station, leg_quality, recognised=recognised),
        mismatch=pose.score,
        by_chance=pose.p_value,
    )
    if recognised and by_hand is not None:
        change = pose_difference(inverse(T_camera_base), inverse(by_hand))
        distance, angle = (float(np.linalg.norm(part)) for part in (change[3:], change[:3]))
        summary = replace(summary, moved=distance, turned=angle)
    return summary, StationInspection(
        station.name, images, by_hand, T_camera_base, leg_quality if recognised else None
    )


def _station_check(station: Station, what: Quality, recognised: bool) -> StationCheck:
    some = len(what.saturated) > 0
    blur = what.blur[np.isfinite(what.blur)]
    return StationCheck(
        name=station.name,
        photographs=len(station.images),
        recognised=recognised,
        handheld=station.handheld,
        legs=float(what.legs.sum(axis=1).mean()) if some else 0.0,
        saturated=float(what.saturated.mean()) if some else math.nan,
        black=float(what.black.mean()) if some else math.nan,
        blur=float(np.median(blur)) if blur.size else math.nan,
    )


# ------------------------------------------------------------------ boards


@dataclass(frozen=True)
class BoardsCheck:
    """Boards found in the images, their checks by station number, and findings."""

    boards: Boards = field(default_factory=Boards)
    checks: Mapping[int, BoardCheck] = field(default_factory=dict[int, BoardCheck])
    findings: tuple[Finding, ...] = ()


def look_for_boards(session: Session, images: Mapping[int, Sequence[Integers]]) -> BoardsCheck:
    """Search for the board in every station that observes it; errors become findings.

    images : all decoded images by station number.
    """
    findings: list[Finding] = []
    try:
        board = board_of(session)
    except InputError as error:
        return BoardsCheck(findings=(of_error(error),))
    if board is None:
        return BoardsCheck()
    station_boards: dict[int, StationBoard] = {}
    for number, station in enumerate(session.stations):
        if "board" not in station.observe:
            continue
        try:
            station_boards[number] = station_board(session, board, number, images[number])
        except InputError as error:
            findings.append(of_error(error, station=station.name))
    checks = {number: _board_check(one) for number, one in station_boards.items()}
    for number, check in checks.items():
        findings += board_findings(session, number, check)
    boards = Boards(station_boards, session.board_body, board.tolerance)
    return BoardsCheck(boards, checks, tuple(findings))


def _unseen_border(one: StationBoard) -> str:
    """Outer row or column of the board that no image shows while all others are visible; empty if
    none.
    """
    board = one.views.board
    if board.type == "aruco_grid":
        return ""
    views = one.views.views.visible.any(axis=0).reshape(board.counts[::-1])
    for name, axis, at in (("row", 0, 0), ("row", 0, -1), ("column", 1, 0), ("column", 1, -1)):
        if not np.take(views, at, axis).any() and np.delete(views, at, axis).all():
            return f"the {'first' if at == 0 else 'last'} {name}"
    return ""


def _board_check(one: StationBoard) -> BoardCheck:
    """Figures of a board in a station's images."""
    views, stood = one.views, one.stood
    return BoardCheck(
        found=len(views.numbers),
        corners=float(views.views.visible.sum(axis=1).mean()),
        corners_of=len(views.board.points),
        rms=float(np.median(views.rms)),
        scatter=stood.scatter if stood else math.nan,
        distance=float(np.median(np.linalg.norm(views.poses.T_camera_board[:, :3, 3], axis=-1))),
        unseen=_unseen_border(one),
    )


# ------------------------------------------------------------------ readings and poses


def joint_checks(session: Session) -> tuple[JointCheck, ...]:
    """Ranges of all joints' readings."""
    checks: list[JointCheck] = []
    for k, name in enumerate(session.document["joints"]["columns"]):
        readings, (low, high) = session.joints[:, k], session.machine.joint_ranges[k]
        stroke = high - low
        ends = (
            int(np.sum(readings < low + NEAR_END * stroke)),
            int(np.sum(readings > high - NEAR_END * stroke)),
        )
        used = float(np.ptp(readings) / stroke)
        unit = session.machine.joint_units[k]
        extremes = float(readings.min()), float(readings.max())
        checks.append(JointCheck(name, unit, *extremes, used, ends))
    return tuple(checks)


def pose_findings(session: Session, boards: Boards) -> list[Finding]:
    """Findings on the platform's rotations in the measured poses."""
    if not session.trackers and (not boards.stations or boards.body == "base"):
        return []
    try:
        measurements = measurements_of(session, boards)
        return turning(session, measurements.poses, measurements.on_platform)
    except PkmcalError as error:
        return [_refusal(error)]


def _height_findings(settled: Settled) -> list[Finding]:
    """Findings on the model violations and the uneven bed that `calibrate` will report."""
    fit = settled.turns
    tested = model_violations(
        settled.case.session,
        fit.observation,
        fit.measurements,
        fit.estimate,
    )
    return [
        *(replace(one.finding, level=Level.DOUBTFUL) for one in tested.violations),
        *discrepancy_findings(tested.errors),
        *([] if explains_heights(tested.errors) else _misfit_findings(settled)),
    ]


def _misfit_findings(settled: Settled) -> list[Finding]:
    """Findings on measurements without images that the model does not explain; edges are measured
    roughly here.
    """
    session, fit = settled.case.session, settled.turns.estimate
    every = misfit(fit, session.labels, settled.richer, ["edges"])
    return [replace(one, level=Level.DOUBTFUL) for one in every]
