"""Localization of a session's stations, with which `check` and `calibrate` begin."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans, Integers, rms
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.errors import GeometryError, InputError, PkmcalError, ResultError
from pkmcal.identify.verdict import VERDICT
from pkmcal.levels import MAJORITY, OUTLIER_SIGMAS
from pkmcal.measurements.contract import LinkKind, kinds_of
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.mechanisms.kinematics import ForwardResult
from pkmcal.mechanisms.reading_hypotheses import ReadingHypothesis, reading_error, reversed_motor
from pkmcal.observe import legs
from pkmcal.observe.distance_tables import distance_tables
from pkmcal.observe.hypotheses import SuspectStation, image_mistake
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.images import CACHED_IMAGE_BYTES, Pictures, fitting
from pkmcal.observe.pose_likelihood import StationView
from pkmcal.observe.station_localization import LocalizedPose, find_station
from pkmcal.outcome.hypotheses import EvidenceLevel, decide, log_likelihood, posterior
from pkmcal.outcome.progress import Progress, no_progress
from pkmcal.session.image_files import label_of
from pkmcal.session.load import Session, Station
from pkmcal.session.poses import check_lengths
from pkmcal.session.readings import frozen
from pkmcal.wording import amount, listed


@dataclass(frozen=True)
class SearchImages:
    """Numbers of images in which the machine is localized, spread over those of each station."""

    # largest number of images of a station, and of all stations: a search uses eight, and thirty
    # held-out images with a z-score of one each have a joint z-score above five. Their tables take
    # 200 to 400 MB
    most_at_station: int = 64
    most: int = 128
    # images of each station, however many stations there are: as many as a search uses
    fewest_at_station: int = 8


SEARCH_IMAGES = SearchImages()


def check_observable(session: Session) -> None:
    """Raise `InputError` for a session without anything that can be observed."""
    session.machine.check_free(f"{session.document['mechanism']}, fixed")
    visible = [station.name for station in session.stations if "legs" in station.observe]
    if visible and not any(leg.tubes for leg in session.machine.document.legs):
        raise InputError(
            "no leg of the nominal model has visible cylinders",
            where=f"{session.document['mechanism']}, legs",
            expected="tubes: [{radius: 0.014, from: 0.05, to: 0.25}] on the legs",
            next_step="Measure the legs' radii with calipers",
        )


def read_images(session: Session, cached_bytes: int = CACHED_IMAGE_BYTES) -> list[StationImages]:
    """Image batches of the stations that observe legs, checked to be decodable; the first images
    that fit into ``cached_bytes`` bytes stay decoded.
    """

    def read(number: int, most: int) -> StationImages:
        station = session.stations[number]
        paths, labels = image_files(session, station)
        images = Pictures.read(paths, station.camera.image_size, labels, most)
        rows = np.array([p.configuration for p in station.images])
        readings = session.joints[rows]
        return StationImages(
            number, station.camera, rows, readings, images, station.response,
            legs.first_binning(station.camera.image_size),
        )  # fmt: skip

    numbers, room, retained = legs_stations(session), cached_bytes, list[int]()
    for number in numbers:
        station = session.stations[number]
        size = station.camera.image_size
        retained.append(min(fitting(size, room), len(station.images)))
        room -= retained[-1] * size[0] * size[1]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(read, numbers, retained))


def image_files(session: Session, station: Station) -> tuple[list[Path], list[str]]:
    """Paths of a station's images, and their names in messages."""
    paths = [photo.path for photo in station.images]
    return paths, [label_of(session.folder, path) for path in paths]


def legs_stations(session: Session) -> list[int]:
    """Numbers of the stations that observe legs."""
    return [k for k, station in enumerate(session.stations) if "legs" in station.observe]


def platform_poses(session: Session, *, most: bool = False) -> Array:
    """Nominal poses T_base_platform (K, 4, 4) of all configurations.

    most : accept readings that the nominal model can take in most configurations; measured poses
        may determine the others, because the zero of a motor is often nominal to degrees only.

    Raises `InputError` that names the configurations without a pose.
    """
    try:
        fk = session.forward
    except GeometryError as error:  # the nominal model is the user's: it is at fault
        raise error.as_input(session.document["mechanism"]) from None
    if session.machine.layout.underdetermined:  # every pose is measured
        return fk.T_base_platform
    # near the ends of its workspace a nominal model within its prior sigmas may not close
    near = fk.error < _allowed_leg_miss(session.machine, fk)
    if near.all() or (most and near.mean() > MAJORITY):
        _check_turns(session, fk.T_base_platform, near)
        return fk.T_base_platform
    bad = [session.configurations[k] for k in np.flatnonzero(~near)]
    _check_columns(session, bad)
    gap = float(np.max(fk.error, where=np.isfinite(fk.error), initial=0.0))
    raise InputError(
        "the nominal model cannot take these readings: its legs do not meet the platform",
        where=f"{session.document['joints']['file']}, configuration {listed(bad)}",
        found=f"a gap of {amount(gap, 'm')}" if gap else "legs that are too short for any pose",
        expected="readings at which all legs reach the platform",
        next_step="Check these readings, the order of their columns, and the nominal"
        " model's centres",
    )


def _check_columns(session: Session, bad: list[str]) -> None:
    """Raise `InputError` where loops do not close because a reading never changes, or because the
    readings of one motor have the wrong sign.
    """
    if error := frozen_in(session):
        raise error
    document, machine = session.document["joints"], session.machine
    count = machine.n_joints
    null = _closing_misfit(session, session.joints)

    def by_legs(hypotheses: Sequence[ReadingHypothesis]) -> Array:
        misfits = [_closing_misfit(session, one.apply(session.joints)) for one in hypotheses]
        values = log_likelihood(np.array([null, *misfits]), len(session.joints))
        return np.where(np.array(misfits) < 1, values[1:] - values[0], -np.inf)

    signs = [replace(reversed_motor(k, 0.0), log_prior=-log(count)) for k in range(count)]
    best = decide(posterior(signs, [EvidenceLevel("legs", by_legs)]))
    if best is None:
        return
    without = "the legs meet the platform"
    error = reading_error(
        best.hypothesis, document["file"], document["columns"], machine.joint_units, without
    )
    raise error.with_fields(
        found=f"readings that the machine cannot take in configuration {listed(bad)}"
    )


def _closing_misfit(session: Session, joints: Array) -> float:
    """Root mean square closure error of the legs at readings (K, m), relative to
    :func:`_allowed_leg_miss`.

    Each configuration counts with ``VerdictOptions.too_noisy`` at most. If the platform rotates
    further than its parts allow, the excess counts instead.
    """
    machine = session.machine
    fk = machine.forward_result(joints)
    miss = fk.error / _allowed_leg_miss(machine, fk)
    blocked = np.abs(_turn(fk.T_base_platform)) > machine.most_turn[0]
    miss = np.where(blocked | ~(miss < VERDICT.too_noisy), VERDICT.too_noisy, miss)
    return rms(miss)


def _allowed_leg_miss(machine: Machine, fk: ForwardResult) -> Array:
    """Largest closure error (K,), m, at the readings of a machine that differs by its prior sigmas,
    up to OUTLIER_SIGMAS times.

    More rods than degrees of freedom meet only in the true geometry: each has a closure error of
    its own.
    """
    table = machine.parameters
    if not machine.layout.overdetermined:
        return np.full(len(fk.error), OUTLIER_SIGMAS * machine.document.tolerance.center)
    c = closure(machine.layout, machine.values, fk.readings, fk.T_base_platform, fk.internal)
    by_prior = dense(c, len(table)) @ (table.free_matrix() * table.tolerances_free())
    return OUTLIER_SIGMAS * np.linalg.norm(by_prior, axis=-1).max(axis=-1)


def _turn(poses: Array) -> Array:
    """Turns (K,) about z, rad."""
    return np.arctan2(poses[:, 1, 0], poses[:, 0, 0])


def _check_turns(session: Session, poses: Array, usable: Booleans) -> None:
    """Raise `InputError` where an articulated platform turns by more than its parts allow."""
    turn, (most, obstacle) = _turn(poses), session.machine.most_turn
    bad = np.flatnonzero((np.abs(turn) > most) & usable)
    if not bad.size:
        return
    _check_columns(session, [session.configurations[k] for k in bad])
    worst = bad[np.argmax(np.abs(turn[bad]))]
    raise InputError(
        f"the readings turn the platform beyond {np.rad2deg(most):.0f} degrees, where {obstacle}",
        where=f"{session.document['joints']['file']}, configuration"
        f" {listed([session.configurations[k] for k in bad])}",
        found=f"{np.rad2deg(turn[worst]):.1f} degrees "
        f"(configuration {session.configurations[worst]})",
        expected=f"less than {np.rad2deg(most):.0f} degrees to either side",
        next_step="Check these readings, and the zero of the motors",
    )


@dataclass(frozen=True)
class LegLocalization:
    """Localization of all stations.

    used : indices of the images that were used, by station.
    views : views of these images.
    """

    views: tuple[StationView, ...]
    localizations: tuple[LocalizedPose, ...]
    used: tuple[Integers, ...]

    @property
    def complete(self) -> bool:
        """Whether the machine was recognised in every station's images."""
        return all(pose.good for pose in self.localizations)


def localize_by_legs(
    session: Session,
    images: list[StationImages],
    poses: Array,
    rngs: list[np.random.Generator],
    boards: Boards | None = None,
    starts: Array | None = None,
    numbers: SearchImages = SEARCH_IMAGES,
) -> LegLocalization:
    """Localize every station that observes legs; nothing is raised.

    poses : T_base_platform (K, 4, 4) of the configurations.
    rngs : one for each of ``images``.
    boards : on the base; through them localized stations give others without a rough pose a start.
    starts : (S, 4, 4) better starts than the rough poses, for all stations; NaN for none. A station
        that is not localized from its start is searched anywhere.
    numbers : numbers of images that are used, spread over those of each station.
    """
    boards = boards or Boards()
    machine = session.machine
    most = min(numbers.most_at_station, numbers.most // max(len(images), 1))
    in_view = tuple(p.spread(max(most, numbers.fewest_at_station)) for p in images)

    def view(p: StationImages) -> StationView:
        tables = distance_tables(p.images)
        return StationView(
            machine, p.camera, p.configuration, session.joints, poses, tables,
            earlier_joints=session.earlier_joints,
        )  # fmt: skip

    at = [p.station for p in images]
    start_poses = [station.T_camera_base for station in session.stations]
    if starts is not None:
        start_pairs = zip(start_poses, starts[: len(start_poses)], strict=True)
        start_poses = [
            T if T is not None or np.isnan(start).any() else start for T, start in start_pairs
        ]
    # one station after the other, because the computation of its tables uses all threads
    views = tuple(view(p.select(some)) for p, some in zip(images, in_view, strict=True))
    solution = _searched(views, [start_poses[s] for s in at], [None] * len(at), rngs)
    # Other stations start from the localized ones through the boards. A rough pose instead would
    # have an error of its angle times the distance between the stations.
    good: list[Array | None] = [None] * len(start_poses)
    for s, pose in zip(at, solution, strict=True):
        good[s] = pose.T_camera_base if pose and pose.good else None
    # second search, of the stations that were not localized
    ahead = boards.joined(good)
    solution = _searched(views, [ahead[s] for s in at], solution, rngs)
    localized = _anywhere(views, solution, rngs)
    localized = _again(views, [start_poses[s] for s in at], localized, rngs)
    return LegLocalization(views, tuple(localized), in_view)


Search = LocalizedPose | None


def _searched(
    views: tuple[StationView, ...],
    starts: list[Array | None],
    before: Sequence[Search],
    rngs: list[np.random.Generator],
) -> list[Search]:
    """Localizations so far or, where these are not good, by a search from each given start."""

    def search(
        view: StationView, start: Array | None, before: Search, rng: np.random.Generator
    ) -> Search:
        if start is None or (before and before.good):
            return before
        return _better(find_station(view, start, rng), before)

    # one after the other: around a known pose arrays are so small that threads only wait
    return list(map(search, views, starts, before, rngs))


def _anywhere(
    views: tuple[StationView, ...], before: Sequence[Search], rngs: list[np.random.Generator]
) -> list[LocalizedPose]:
    """Localizations that are certain; for the others the better of the present one and a global
    search.
    """

    def search(view: StationView, before: Search, rng: np.random.Generator) -> LocalizedPose:
        if before and before.sure:
            return before
        return _better(find_station(view, None, rng), before)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(search, views, before, rngs))


def _again(
    views: tuple[StationView, ...],
    starts: list[Array | None],
    before: list[LocalizedPose],
    rngs: list[np.random.Generator],
) -> list[LocalizedPose]:
    """Localizations, those of stations that were missed from a second draw of poses.

    The search is random, and misses a pose in some of a hundred stations. A second attempt doubles
    the probability of an acceptance by chance, so its p-value is multiplied by two.
    """

    def search(
        view: StationView, start: Array | None, before: LocalizedPose, rng: np.random.Generator
    ) -> LocalizedPose:
        if before.good or len(view.configuration) < 2:
            return before
        second = find_station(view, start, rng, near_prior=True)
        return _better(replace(second, p_value=min(2 * second.p_value, 1.0)), before)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(search, views, starts, before, rngs))


def _better(one: LocalizedPose, other: Search) -> LocalizedPose:
    if other is None:
        return one
    return max(one, other, key=lambda item: (item.good, item.log_likelihood_ratio))


def mistake_in(
    session: Session,
    images: list[StationImages],
    leg_localization: LegLocalization,
    rng: np.random.Generator,
) -> InputError | None:
    """Error about stations that were not localized, or whose images a hypothesis explains better
    than the session as stated.

    A reading that never changes is reported first, because its effect may equal that of any
    hypothesis.
    """
    still = frozen_in(session)
    if still is not None and not leg_localization.complete:  # an error in any case, and cheaper
        return still
    error = image_mistake(suspect_stations(session, images, leg_localization), rng)
    return error and (still or error)


def suspect_stations(
    session: Session, images: list[StationImages], leg_localization: LegLocalization
) -> list[SuspectStation]:
    """Stations as input of hypotheses, with the files of the images in use."""
    stations = [session.stations[p.station] for p in images]
    return [
        SuspectStation(
            station.name,
            [label_of(session.folder, station.images[k].path) for k in used],
            session.configurations,
            session.document["joints"]["file"],
            session.document["joints"]["columns"],
            view,
            station.T_camera_base,
            pose,
        )
        for station, view, pose, used in zip(
            stations,
            leg_localization.views,
            leg_localization.localizations,
            leg_localization.used,
            strict=True,
        )
    ]


def frozen_in(session: Session) -> InputError | None:
    """Error about readings that never change; None without such readings."""
    joints = session.document["joints"]
    return frozen(session.joints, session.joint_noise, joints["columns"], joints["file"])


class StationSearch(NamedTuple):
    """Poses of all stations.

    leg_localization : localization by the legs, None if no images were searched.
    T_camera_base : (S, 4, 4), NaN for hand-held images that are not localized yet.
    error : why another station has no pose, or the mistake that explains its images; poses are then
        incomplete.
    """

    leg_localization: LegLocalization | None
    T_camera_base: Array
    error: PkmcalError | None


def localize_stations(
    session: Session,
    images: list[StationImages],
    boards: Boards,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> Array:
    """Poses T_camera_base (S, 4, 4) of all stations, by :func:`locate_stations`.

    Raises `InputError`, or `ResultError`, if the pose of a station that is not hand-held is
    undetermined.
    """
    value = locate_stations(session, images, boards, rng, progress)
    if value.error is not None:
        raise value.error
    return value.T_camera_base


def locate_stations(
    session: Session,
    images: list[StationImages],
    boards: Boards,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> StationSearch:
    """Poses of all stations, each by the first source that determines it; nothing is raised.

    Sources are the session and boards, localization by the legs, and measured poses.

    images : in which the machine is localized, none hand-held.
    progress : called with the step in words and the share done.
    """
    nowhere = np.full((len(session.station_names), 4, 4), np.nan)
    value: LegLocalization | None = None
    try:
        start_poses = prior_station_poses(session, boards)
        poses = platform_poses(session) if images else nowhere
    except PkmcalError as error:
        return StationSearch(None, nowhere, error)
    if images:
        rngs = rng.spawn(len(images) + 1)
        count = sum(len(p.images) for p in images)
        progress(f"Localizing the stations by {count} images", 0.0)
        # by the legs, unless a mistake explains the images better; others through boards on the
        # base
        value = localize_by_legs(session, images, poses, rngs[1:], boards, start_poses)
        progress("Testing hypotheses about the images", 0.8)
        mistake = mistake_in(session, images, value, rngs[0])
        if mistake is not None:
            return StationSearch(value, start_poses, mistake)
        start_poses[[p.station for p in images]] = [
            pose.T_camera_base for pose in value.localizations
        ]
        visible = [None if np.isnan(T).any() else T for T in start_poses[: len(session.stations)]]
        for k, T in enumerate(boards.joined(visible)):
            start_poses[k] = start_poses[k] if T is None else T
    by_hand = [s.handheld for s in session.stations] + [False] * len(session.trackers)
    # stations without a pose so far: by measured poses
    if not (np.isnan(start_poses[:, 0, 0]) & ~np.array(by_hand, dtype=bool)).any():
        return StationSearch(value, start_poses, None)
    try:
        return StationSearch(value, _by_poses(session, boards, start_poses), None)
    except PkmcalError as error:
        return StationSearch(value, start_poses, error)


def prior_station_poses(session: Session, boards: Boards) -> Array:
    """T_camera_base (S, 4, 4) of all stations without localization by the legs.

    As the session states, or by a board; NaN where there is neither.
    """
    # the pose of a hand-held image is too rough for the images that a board joins to it
    given = [None if one.handheld else one.T_camera_base for one in session.stations]
    given = boards.joined(given) + _tracker_starts(session)
    T_camera_base = np.array([np.full((4, 4), np.nan) if T is None else T for T in given])
    T_camera_base = T_camera_base.reshape(-1, 4, 4)
    by_hand = np.array([station.handheld for station in session.stations], dtype=bool)
    lost = np.isnan(T_camera_base[: len(session.stations), 0, 0]) & ~by_hand
    # If a station is localized by its legs only, the others are searched with it, from the boards.
    by_legs_only = any(lost[k] and k not in boards.stations for k in legs_stations(session))
    if boards.body == "base" or not boards.stations or by_legs_only or not lost.any():
        return T_camera_base
    return _by_poses(session, boards, T_camera_base)


def _by_poses(session: Session, boards: Boards, start_poses: Array) -> Array:
    """Stations (S, 4, 4), those without a pose (NaN) determined by measured poses.

    Raises `InputError`, or `ResultError`, where these do not determine them.
    """
    from pkmcal.identify.hand_eye import start_from_poses

    measurements = measurements_of(session, boards)
    try:
        return start_from_poses(session.machine, measurements, start_poses).T_camera_base
    except (InputError, ResultError) as error:
        lost = session.station_names[int(np.flatnonzero(np.isnan(start_poses[:, 0, 0]))[0])]
        raise error.located(f"session.yaml, stations.{lost}") from None


def _tracker_starts(session: Session) -> list[Array | None]:
    """Start poses of trackers whose points or heights do not determine their orientation."""
    if not session.trackers and not session.links:
        return []
    try:
        fk = session.forward
    except GeometryError:
        return [None] * len(session.trackers)
    poses = np.where(fk.converged[:, None, None], fk.T_base_platform, np.nan)
    for table in session.trackers:
        check_lengths(table, poses)
    for links in session.links:
        kinds_of(LinkKind)[links.kind].check_start(links, poses)
    return [table.start(poses) for table in session.trackers]


def boards_of(session: Session, images: list[StationImages]) -> Boards:
    """The session's board in its images; see :func:`pkmcal.boards.stations.find_boards`.

    Images of the board alone are decoded one by one, on access.
    """
    if session.board is None:  # the usual case; the detection of boards is slow to import
        return Boards()
    from pkmcal.boards.stations import find_boards

    return find_boards(session, board_images(session, images))


def board_images(
    session: Session, station_images: list[StationImages]
) -> dict[int, Sequence[Integers]]:
    """Images of all stations by station number: decoded already, or on access."""
    images: dict[int, Sequence[Integers]] = {p.station: p.images for p in station_images}
    for number, station in enumerate(session.stations):
        if number not in images:
            paths, labels = image_files(session, station)
            images[number] = Pictures(paths, station.camera.image_size, labels)
    return images
