"""Subjects of a plan: the rig of a session, or of a machine with a hypothetical camera or
tracker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, numbered, short_repr
from pkmcal.boards.board import Board, load_board
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.file_names import CALIBRATION_DOCUMENT_FILE, CALIBRATION_FOLDER
from pkmcal.calibration.localization import (
    boards_of,
    localize_stations,
    platform_poses,
    read_images,
)
from pkmcal.calibration.machine_identity import read_same_machine
from pkmcal.calibration.saved_calibration import CalibrationPrior, SavedCalibration, load
from pkmcal.cameras import Camera
from pkmcal.errors import GeometryError, InputError, PkmcalError
from pkmcal.files import Unit
from pkmcal.geometry.rigid import inverse
from pkmcal.identify.start import start_mounts
from pkmcal.levels import NEGLIGIBLE
from pkmcal.measurements import BOARD_MOUNT_NAME, SHADING_SIGMA, Mount
from pkmcal.measurements.readings import reading_sigma
from pkmcal.mechanisms import Machine
from pkmcal.observe.legs import first_binning
from pkmcal.observe.predict import tubes_of
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.stations import default_stations
from pkmcal.planning.defaults import (
    NOMINAL_CORNER_SIGMA,
    NOMINAL_EDGE_SIGMA,
    UNTOLD_READING_NOISE,
)
from pkmcal.planning.first import Pools, first_edges, joined_pools, spread_over
from pkmcal.planning.rig import (
    BoardFrom,
    Instrument,
    LegsFrom,
    Rig,
    TargetFrom,
    nominal_pools,
)
from pkmcal.session.load import Session, Station
from pkmcal.session.readings import rounding_step
from pkmcal.simulation.board import place_board
from pkmcal.wording import amount, brief

PLAN_IMAGES_A_STATION = 12
"""Maximum number of a station's images whose edges are measured; twice as many of all stations
together. A plan is made once, and few edges determine the shading badly.
"""
FINEST_STEP = 1e-6
"""m or rad, step of a reading below which no drive moves."""
PLAY_IS_AN_OFFSET = (
    "Play counts as noise here, but it is an offset where a drive always comes from the same side:"
    " approach every configuration so, and the result is better than this."
)


@dataclass(frozen=True)
class Subject:
    """Subject of a plan.

    rig : machine and instruments.
    prior : prior of an earlier calibration.
    columns : columns of joints.csv. units : their units, None for SI; empty without any.
    steps : (m,) of which all existing readings of a motor are multiples, m or rad, 0 for none.
    localized : share of its images that are localized, where its camera is held by hand; the rig's
        station stands for all of them. None where stations are fixed.
    names : of existing configurations.
    words : sentences on the sources of its numbers.
    board : fields of the board's file, if a board is observed.
    """

    rig: Rig
    prior: CalibrationPrior | None
    columns: tuple[str, ...]
    names: tuple[str, ...]
    words: tuple[str, ...]
    board: dict[str, Any] | None = None
    units: tuple[Unit | None, ...] = ()
    steps: Array | None = None
    localized: float | None = None

    __repr__ = short_repr

    @property
    def handheld(self) -> bool:
        """Whether the camera is held by hand."""
        return self.localized is not None

    def commanded(self, joints: Array) -> Array:
        """Readings (n, m) as the machine's controller takes them: multiples of the steps."""
        if self.steps is None:
            return joints
        step = np.where(self.steps > 0, self.steps, 1.0)
        return np.where(self.steps > 0, np.round(joints / step) * step, joints)


def as_it_stands(
    session: Session,
    after: SavedCalibration | Path | str | None = None,
    *,
    from_nominal: bool = False,
    same_place: bool = False,
    anywhere: bool = False,
    edge: float = NOMINAL_EDGE_SIGMA,
    corner: float = NOMINAL_CORNER_SIGMA,
    seed: int = 0,
) -> Subject:
    """Subject of a session with its existing measurements.

    after : earlier calibration; by default the usable one in the session's folder, none with
    ``from_nominal``. Others as for :func:`~pkmcal.planning.subject.subject_of_session`. Raises
    InputError if the given calibration is not usable, or if ``same_place`` is set without a
    calibration.
    """
    # The session's own calibration is the default.
    saved: SavedCalibration | None = None
    if (
        after is None
        and not from_nominal
        and (session.folder / CALIBRATION_FOLDER / CALIBRATION_DOCUMENT_FILE).is_file()
    ):
        after = load(session.folder / CALIBRATION_FOLDER)
        if not after.verdict.usable:  # a default must not be an unusable calibration
            after = None
    if after is not None:
        saved, session = read_same_machine(after, session)
        if not saved.verdict.usable:
            raise InputError(
                "this calibration should not be used, so no plan is made from it",
                where=str(saved.path),
                found=saved.verdict.headline,
                next_step="Plan without it: --from-drawing",
                code="calibration.refused",
            )
    if same_place and saved is None:
        raise InputError(
            "there is no calibration with poses of the cameras",
            where="--same-place",
            expected="--after CALIBRATION, or a session with its calibration",
        )
    return subject_of_session(
        session,
        saved,
        same_place=same_place,
        anywhere=anywhere,
        edge=edge,
        corner=corner,
        seed=seed,
    )


def of_machine(
    machine: Machine,
    cameras: Sequence[Camera],
    columns: Sequence[str],
    *,
    board: Board | None = None,
    tracker: tuple[float, float | None] | None = None,
    joint_noise: float = UNTOLD_READING_NOISE,
    reading_resolution: float = 0.0,
    play: float = 0.0,
    edge: float = NOMINAL_EDGE_SIGMA,
    corner: float = NOMINAL_CORNER_SIGMA,
    seed: int = 0,
) -> Subject:
    """Subject with a machine and a hypothetical camera or tracker.

    cameras : one for each station.
    board : on the platform, observed instead of the legs.
    tracker : standard deviations of its positions (m) and turns (rad; None if it measures points),
        instead of cameras.
    joint_noise, reading_resolution, play : standard deviation of a reading, its step, and by how
        much a drive's positions at one reading differ with the side from which it comes, m or rad.
    edge, corner : standard deviations, px.
    """
    rng = np.random.default_rng(seed)
    sigma = reading_sigma(joint_noise, reading_resolution, play)
    same_side = (PLAY_IS_AN_OFFSET,) if play else ()
    steps = np.full(machine.n_joints, reading_resolution)
    good_to = " or ".join(amount(sigma, unit) for unit in dict.fromkeys(machine.joint_units))
    noise = f"Readings are taken to be good to {good_to}"
    if tracker is not None:
        rig = _tracker_rig(machine, tracker, sigma)
        words = (noise + ", as stated.", *same_side)
        return Subject(rig, None, tuple(columns), (), words, steps=steps)
    # Stations at default poses, which observe legs or a board.
    cameras = tuple(cameras)
    stations = default_stations(machine, cameras, rng, "platform" if board else None)
    T_camera_base = np.stack([place.T_camera_base() for place in stations])
    placed = [*enumerate(zip(cameras, T_camera_base, strict=True))]
    instruments: tuple[Instrument, ...]
    if board is None:
        check_tubes(machine, "legs")
        pools = nominal_pools(machine, edge)
        instruments = tuple(
            LegsFrom(s, camera, T, pools, first_binning(camera.image_size))
            for s, (camera, T) in placed
        )
        mounts, T_mount = (), None
        what = f"edges of legs to {edge:g} px"
    else:
        place = _best_board_pose(machine, board, cameras, T_camera_base, rng)
        instruments = tuple(
            BoardFrom(s, camera, T, board.points, place, corner) for s, (camera, T) in placed
        )
        mounts, T_mount = (Mount(BOARD_MOUNT_NAME, "platform", board.tolerance),), place[None]
        what = f"corners of the board to {corner:g} px, and its size to be exact"
    rig = Rig(
        machine,
        tuple(f"station{k + 1}" for k in range(len(cameras))),
        T_camera_base,
        numbered(map(id, cameras)),
        sigma,
        instruments,
        mounts,
        T_mount,
        where=None,
    )
    fields = board.document if board else None
    words = (f"{noise}, {what}: an assumption.", *same_side)
    return Subject(rig, None, tuple(columns), (), words, fields, steps=steps)


def _best_board_pose(
    machine: Machine, board: Board, cameras: tuple[Camera, ...], T: Array, rng: np.random.Generator
) -> Array:
    """T_platform_board (4, 4) at which a board on the platform is visible best."""
    poses, joints = draw_configurations(machine, 12, 0.5, rng)
    return place_board(machine, board, "platform", cameras, T, poses, joints, rng)


def check_tubes(machine: Machine, where: str) -> None:
    """Raise `InputError` for a machine whose legs have no edges. where : their place in a file."""
    if len(tubes_of(machine)):
        return
    raise InputError(
        "no leg of the nominal model has visible cylinders, so a camera sees none",
        where=where,
        expected="tubes: [{radius: 0.014, from: 0.05, to: 0.25}] on the legs",
        next_step="Measure the legs' radii with calipers, or plan with --board or --tracker",
    )


def _tracker_rig(machine: Machine, noise: tuple[float, float | None], joint_noise: float) -> Rig:
    """Rig of a tracker in the base frame, with its target at the platform's origin."""
    position, turn = noise
    whiten = np.diag([0.0 if turn is None else 1 / turn] * 3 + [1 / position] * 3)
    target = TargetFrom(0, np.eye(4), np.eye(4), whiten)
    one = np.eye(4)[None]
    mounts = (Mount("target", "platform"),)
    return Rig(machine, ("tracker",), one, np.zeros(1, int), joint_noise, (target,), mounts, one)


# ------------------------------------------------------------------ of a session


def subject_of_session(
    session: Session,
    saved: SavedCalibration | None = None,
    *,
    same_place: bool = False,
    anywhere: bool = False,
    edge: float = NOMINAL_EDGE_SIGMA,
    corner: float = NOMINAL_CORNER_SIGMA,
    seed: int = 0,
) -> Subject:
    """Subject of a session, by its nominal model, its first images, or an earlier calibration.

    saved : calibration of this machine, the source of its values, stations and prior.
    same_place : whether cameras still have the poses of that calibration.
    anywhere : whether poses of its first camera are to be chosen, so that none must be given.
    edge, corner : px, standard deviations for a session without images.

    A session with a hand-held camera is planned for that camera alone. Raises InputError if the
    pose of a station is not known.
    """
    by_hand = [station for station in session.stations if station.handheld]
    if by_hand and not anywhere:
        return _handheld_subject(session, by_hand, saved, edge, corner, seed)
    if anywhere:
        session = _first_camera_session(session)
    words: list[str] = []
    if saved is not None:
        session = replace(session, machine=saved.machine)
        words.append(f"The machine, and what is known of it, as calibrated in {saved.path.parent}.")
    images = _SessionImages.of(session, saved, np.random.default_rng(seed))
    T_camera_base = _station_poses(session, saved, images, anywhere, seed)
    rig, board, corner_source = _rig(session, saved, images, T_camera_base, edge, corner, seed)
    prior = None
    if saved is not None:
        fixed_stations = [
            name for name in session.station_names if same_place and name in saved.placed
        ]
        prior = saved.prior(fixed_stations, session.station_names)
    columns = tuple(session.document["joints"]["columns"])
    names = session.configurations
    fields = board.document if board else None
    return Subject(
        rig, prior, columns, names, (*words, *corner_source), fields, session.reading_units,
        _steps(session),
    )  # fmt: skip


def _handheld_subject(
    session: Session,
    by_hand: Sequence[Station],
    saved: SavedCalibration | None,
    edge: float,
    corner: float,
    seed: int,
) -> Subject:
    """Subject with a session's hand-held camera.

    by_hand : its images. Edges are as good as in those that the calibration has localized.
    """
    first = replace(by_hand[0], name=by_hand[0].entry)
    rest = replace(session, stations=(first,), trackers=(), links=())
    planned = subject_of_session(rest, saved, anywhere=True, edge=edge, corner=corner, seed=seed)
    words = "All hand-held images are taken to be localized: an assumption."
    planned = replace(planned, localized=1.0, words=(*planned.words, words))
    names = set[str]() if saved is None else {station.name for station in saved.stations}
    placed = [station for station in by_hand if station.name in names]
    if saved is None or not placed:
        return planned
    words = f"As many images are taken to be localized as there: {len(placed)} of {len(by_hand)}."
    share = len(placed) / len(by_hand)
    planned = replace(planned, localized=share, words=(*planned.words[:-1], words))
    if "legs" not in first.observe:
        return planned
    chosen = spread_over(np.arange(len(placed)), most=PLAN_IMAGES_A_STATION)
    known = tuple(placed[k] for k in chosen)
    seen = replace(session, machine=saved.machine, stations=known, trackers=(), links=())
    images, rows = read_images(seen), [np.zeros(1, dtype=int)] * len(known)
    T_base_camera = {station.name: station.T_base_camera for station in saved.stations}
    T_camera_base = inverse(np.stack([T_base_camera[station.name] for station in known]))
    measured = first_edges(seen, images, rows, T_camera_base, platform_poses(seen))
    pools = joined_pools(measured.pools)
    rig = planned.rig
    instruments = tuple(
        replace(one, pools=pools, binning=images[0].binning) if isinstance(one, LegsFrom) else one
        for one in rig.instruments
    )
    shading = measured.estimate.statistics.shading
    edges = f"The accuracy of edges is measured in {len(known)} images that the calibration has."
    rig = replace(rig, instruments=instruments, shading=shading)
    return replace(planned, rig=rig, words=(*planned.words[:-2], edges, words))


def _steps(session: Session) -> Array:
    """Steps (m,) of a session's readings; 0 where they have none, or only few coarse values, whose
    step is more than a negligible share of the motor's range.
    """
    spans = np.ptp(session.machine.joint_ranges, axis=1)
    steps = np.zeros(len(spans))
    for m, (unit, span) in enumerate(zip(session.machine.joint_units, spans, strict=True)):
        readings = session.joints[:, m]
        step = rounding_step(readings, unit, FINEST_STEP) if readings.any() else None
        if step is not None and step <= NEGLIGIBLE * span:
            steps[m] = step
    return steps


def _rig(
    session: Session,
    saved: SavedCalibration | None,
    images: _SessionImages,
    T_camera_base: Array,
    edge: float,
    corner: float,
    seed: int,
) -> tuple[Rig, Board | None, list[str]]:
    """Rig of a session, the board on its platform, and sentences on the sources of the noise.

    Arguments as for :func:`subject_of_session`; T_camera_base : (S, 4, 4).
    """
    words: list[str] = []
    instruments: list[Instrument] = []
    mounts: list[Mount] = []
    T_mount: list[Array] = []
    # The board on the platform.
    has_board = any("board" in s.observe for s in session.stations)
    board: Board | None = None
    if has_board and session.board is not None and session.board_body == "platform":
        board = load_board(session.board)
        mounts.append(Mount(BOARD_MOUNT_NAME, "platform", board.tolerance))
        T_mount.append(_board_pose(session, board, saved, images, T_camera_base, seed))
        sigma, corner_source = _corner_noise(images.boards, corner)
        words.append(corner_source)
        for s, station in enumerate(session.stations):
            if "board" in station.observe:
                place = T_mount[0]
                instruments.append(
                    BoardFrom(s, station.camera, T_camera_base[s], board.points, place, sigma)
                )
    # The legs.
    shading = SHADING_SIGMA
    legs = [s for s, station in enumerate(session.stations) if "legs" in station.observe]
    if legs:
        check_tubes(session.machine, f"{session.document['mechanism']}, legs")
        pixels, pools, shading, corner_source = _edge_noise(
            session, legs, images, T_camera_base, edge
        )
        words.append(corner_source)
        for s, binning, pool in zip(legs, pixels, pools, strict=True):
            camera = session.stations[s].camera
            instruments.append(LegsFrom(s, camera, T_camera_base[s], pool, binning))
    # The trackers' targets.
    for s, table in enumerate(session.trackers, start=len(session.stations)):
        place = _saved_target(saved, table.name)
        mounts.append(Mount(table.name, "platform"))
        T_mount.append(np.eye(4) if place is None else place)
        target = TargetFrom(s, T_camera_base[s], T_mount[-1], table.whiten, len(mounts) - 1)
        instruments.append(target)
    rig = Rig(
        session.machine,
        session.station_names,
        T_camera_base,
        session.camera_of_station,
        session.joint_noise,
        tuple(instruments),
        tuple(mounts),
        np.array(T_mount).reshape(-1, 4, 4),
        shading,
        temperatures=session.temperature,
        forces=session.forces,
    )
    return rig, board, words


def _first_camera_session(session: Session) -> Session:
    """Session with its first camera only, on a tripod; hand-held images do not determine a
    station.
    """
    if not session.stations:
        raise InputError(
            "there is no camera whose place could be chosen",
            where="--places",
            next_step="Leave it out; where a tracker stands does not change its information",
        )
    first = session.stations[0]
    if first.handheld:
        first = replace(first, handheld=False, T_camera_base=None, images=())
    return replace(session, stations=(first,), trackers=())


class _SessionImages(NamedTuple):
    """Images of legs of a session, the boards in them, and the localized stations (S, 4, 4).

    T_camera_base : None without images, or with a calibration that has the stations.
    """

    images: list[Any]
    boards: Boards
    T_camera_base: Array | None

    @classmethod
    def of(
        cls, session: Session, saved: SavedCalibration | None, rng: np.random.Generator
    ) -> _SessionImages:
        if not any(station.images for station in session.stations):
            return cls([], Boards(), None)
        images = read_images(session)
        boards = boards_of(session, images)
        if saved is not None and _saved_station_poses(session, saved) is not None:
            return cls(images, boards, None)
        return cls(images, boards, localize_stations(session, images, boards, rng))


def _saved_station_poses(session: Session, saved: SavedCalibration) -> Array | None:
    """Poses (S, 4, 4) of all stations in a calibration; None if one is missing."""
    there = {station.name: inverse(station.T_base_camera) for station in saved.stations}
    if not all(name in there for name in session.station_names):
        return None
    return np.stack([there[name] for name in session.station_names])


def _station_poses(
    session: Session,
    saved: SavedCalibration | None,
    images: _SessionImages,
    anywhere: bool,
    seed: int,
) -> Array:
    """Poses (S, 4, 4) of all stations by the first source: calibration, localization, pose in
    session.yaml; trackers are in the base frame.

    anywhere : use a default pose for a station without a source, instead of raising InputError.
    """
    poses = None if saved is None else _saved_station_poses(session, saved)
    if poses is None:
        poses = images.T_camera_base
    if poses is not None:
        return poses
    out: list[Array] = []
    for station in session.stations:
        if station.T_camera_base is None and anywhere:
            observed_side = "platform" if "legs" not in station.observe else None
            rng = np.random.default_rng(seed)
            (place,) = default_stations(session.machine, (station.camera,), rng, observed_side)
            out.append(place.T_camera_base())
            continue
        if station.T_camera_base is None:
            raise InputError(
                f"the pose of station {station.name} is not determined",
                where=f"session.yaml, stations.{station.name}",
                expected="pose: {position: [...], look_at: [...]}, three images, or a calibration",
                next_step="Give its pose, or let places be chosen: --places 3",
            )
        out.append(station.T_camera_base)
    return np.stack([*out, *(np.eye(4) for _ in session.trackers)])


def _edge_noise(
    session: Session, legs: list[int], images: _SessionImages, T_camera_base: Array, edge: float
) -> tuple[tuple[int, ...], tuple[Pools, ...], float, str]:
    """Binning and pools of each station with legs, the shading, and a sentence on their source."""
    why = "no image determines it yet"
    if len(images.images) == len(legs):
        rows = [
            spread_over(p.configuration, len(legs), PLAN_IMAGES_A_STATION) for p in images.images
        ]
        try:
            poses = platform_poses(session)
            first = first_edges(session, images.images, rows, T_camera_base[legs], poses)
        except (PkmcalError, np.linalg.LinAlgError):
            # `check` and `calibrate` report what is wrong with these images; the plan uses defaults
            why = "the images that there are do not determine it; pkmcal check gives the reason"
        else:
            count = sum(len(row) for row in rows)
            words = f"The accuracy of edges is measured in {count} of the images that there are."
            pixels = tuple(p.binning for p in images.images)
            return pixels, first.pools, first.estimate.statistics.shading, words
    # without images their sharpness is not known
    pixels = tuple(first_binning(session.stations[s].camera.image_size) for s in legs)
    pools = (nominal_pools(session.machine, edge),) * len(legs)
    return pixels, pools, SHADING_SIGMA, f"Edges are taken to be good to {edge:g} px: {why}."


def _corner_noise(boards: Boards, corner: float) -> tuple[float, str]:
    """Standard deviation of a board's corner in px, and a sentence on its source."""
    sigma = [
        float(np.hypot(np.median(s.views.views.sigma[s.views.views.visible]), s.views.poses.noise))
        for s in boards.stations.values()
        if s.views.views.visible.any()
    ]
    if not sigma:
        return corner, f"Corners are taken to be good to {corner:g} px: no image determines it yet."
    median = float(np.median(sigma))
    return median, f"Corners of the board are good to {brief(median)} px in the images."


def _saved_target(saved: SavedCalibration | None, name: str) -> Array | None:
    """T_platform_target (4, 4) in a calibration; None if there is none."""
    targets: list[dict[str, Any]] = [] if saved is None else saved.document.get("targets", [])
    for target in targets:
        if target["name"] == name and target.get("T_platform_target"):
            return np.array(target["T_platform_target"])
    return None


def _board_pose(
    session: Session,
    board: Board,
    saved: SavedCalibration | None,
    images: _SessionImages,
    T_camera_base: Array,
    seed: int,
) -> Array:
    """T_platform_board (4, 4): as calibrated, from images, or where the board is visible best."""
    calibrated = _saved_target(saved, BOARD_MOUNT_NAME)
    if calibrated is not None:
        return calibrated
    if images.boards.stations:
        measurements = measurements_of(session, images.boards)
        return start_mounts(measurements, T_camera_base, platform_poses(session, most=True))[0]
    users = [s for s, station in enumerate(session.stations) if "board" in station.observe]
    cameras = tuple(session.stations[s].camera for s in users)
    rng = np.random.default_rng(seed)
    try:
        return _best_board_pose(session.machine, board, cameras, T_camera_base[users], rng)
    except GeometryError as error:
        raise error.as_input("session.yaml, stations") from None
