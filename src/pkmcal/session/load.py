"""Session: images, joint readings, cameras, tables and the machine's nominal model.

`load_session` checks everything that can be checked without decoding images. Each fault is an
`InputError` with file, line and field.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers, numbered, short_repr
from pkmcal.cameras import Camera
from pkmcal.cameras.files import camera_path, load_camera
from pkmcal.cameras.response import JPEG_FILE_ENDINGS, Response
from pkmcal.errors import LONGEST_NAME, InputError
from pkmcal.files import (
    LARGEST_UNITLESS_LENGTH,
    MOST_HANDHELD_IMAGES,
    CsvTable,
    Document,
    Keys,
    Unit,
    any_unit,
    check_count,
    check_regular,
    closest,
    given_path,
    json_text,
    no_such,
    quoted,
    read_csv,
    read_yaml,
    resolved,
    validated_document,
    wanted_file,
    written_unit,
)
from pkmcal.geometry.rigid import look_at
from pkmcal.levels import NEGLIGIBLE
from pkmcal.measurements import LinkSet
from pkmcal.measurements.contract import LinkKind, kinds_of, measurement_kinds
from pkmcal.measurements.heights import Heights
from pkmcal.measurements.tracker_poses import TrackerPoses
from pkmcal.mechanisms import Machine, catalogue, check_plausible, load_mechanism
from pkmcal.mechanisms.disturbances import is_compliant, sag, tool_shift
from pkmcal.mechanisms.kinematics import ForwardResult
from pkmcal.mechanisms.region import Region
from pkmcal.outcome.finding import Finding, Level, doubtful, note
from pkmcal.session.exif import EXIF_CAMERA_WORD, camera_by_exif
from pkmcal.session.image_files import Image, find_images, image_header, label_of
from pkmcal.session.poses import PoseTable, read_poses
from pkmcal.session.readings import JointTable, check_readings, joint_table, without_repeats
from pkmcal.session.schema import (
    BoardBody,
    PoseDocument,
    SessionDocument,
    StationDocument,
    session_schema,
)
from pkmcal.wording import count, listed

SESSION_FILE_NAME, CALIBRATION_FILE_NAME = "session.yaml", "calibration.json"
SESSION_FILE_VERSION = 1
SHORTEST_PATH = 3
"""Fewest configurations of a straight path; two points are always on a line."""


@dataclass(frozen=True)
class Station:
    """One camera at a fixed place.

    camera_file : as named in session.yaml; a made-up name if the camera comes from EXIF data.
    T_camera_base : (4, 4) rough pose, base to camera coordinates in m; None if not given.
    images : images, sorted by configuration and repeat.
    observe : legs, board, or both, in this order.
    entry : name of the entry in session.yaml. A hand-held entry has one station for each image.
    handheld : whether the camera was held by hand.
    from_exif : whether only the EXIF focal length of the camera is known.
    response : encoding of light in the images.
    response_given : whether the response is stated in session.yaml or was determined from edges;
        otherwise it is the usual one for the type of file.
    """

    name: str
    camera: Camera
    camera_file: str
    T_camera_base: Array | None
    images: tuple[Image, ...]
    observe: tuple[str, ...]
    entry: str = ""
    handheld: bool = False
    from_exif: bool = False
    response: Response = "linear"
    response_given: bool = False

    __repr__ = short_repr


@dataclass(frozen=True)
class RejectedStation:
    """Station whose images do not determine its pose.

    label : name in messages.
    reason : text that follows "for".
    T_camera_base : (4, 4) most likely pose, None where no pose was tried.
    """

    station: Station
    label: str
    reason: str
    T_camera_base: Array | None = None

    @property
    def finding(self) -> Finding:
        """Warning about the rejected station."""
        return doubtful(
            "rejected.image" if self.station.handheld else "rejected.station",
            self.label,
            station=self.station.name,
            reason=self.reason,
        )


@dataclass(frozen=True)
class Session:
    """A session, loaded and checked.

    configurations : K names, in the order of joints.csv.
    joints : (K, m) readings, m or rad, in the order of the machine's actuated legs.
    joint_noise : standard deviation of a reading, m or rad.
    board : file that describes the calibration board; None if no station observes one.
    board_body : body to which the board is fixed, base or platform.
    document : session.yaml with defaults, readings and image files written out.
    findings : warnings about the session.
    trackers : tables measured by trackers; in station numbers they follow the cameras' stations.
    model : name of the machine's model in the mechanism file, None for the default.
    mechanism : source of the machine, from which other models are loaded.
    workspace : region in which the tool must be accurate; None if not stated.
    rejected : stations that were removed because their images do not determine their poses.
    links : measurements that depend on two configurations, by kind.
    temperature : (K,) °C, of the configurations; None where joints.csv has none.
    forces : (K, m) on the readings, N or N m, positive where readings grow; None where joints.csv
        has none.
    earlier_joints : (E, m) readings of the same machine at other poses; None for none. The
        localization of few images is tested against them as well.
    reading_units : units in the heads of joints.csv's m columns, None for SI; empty without any.
    """

    folder: Path
    machine: Machine
    configurations: tuple[str, ...]
    joints: Array
    joint_noise: float
    stations: tuple[Station, ...]
    board: Path | None
    document: dict[str, Any]
    findings: tuple[Finding, ...] = ()
    board_body: BoardBody = "platform"
    trackers: tuple[PoseTable, ...] = ()
    model: str | None = None
    mechanism: Path | str = ""
    workspace: Region | None = None
    rejected: tuple[RejectedStation, ...] = ()
    links: tuple[LinkSet, ...] = ()
    temperature: Array | None = None
    forces: Array | None = None
    earlier_joints: Array | None = None
    reading_units: tuple[Unit | None, ...] = ()

    def __repr__(self) -> str:
        parts = (
            count(len(self.configurations), "configuration"),
            count(len(self.station_names), "station"),
            count(self.images_taken, "image"),
        )
        return f"<Session {resolved(self.folder).name}: {self.machine.name}, {', '.join(parts)}>"

    @cached_property
    def forward(self) -> ForwardResult:
        """Forward kinematics of the nominal model at the readings, solved once.

        The nearest pose where its loops do not close. Raises GeometryError if the nominal model
        has no home pose.
        """
        result = self.machine.forward_result(self.joints)
        for shared in (result.T_base_platform, result.internal):
            shared.setflags(write=False)
        return result

    @property
    def called(self) -> str:
        """Name of the session for messages: its folder's, or the parent's if the folder is named
        session.
        """
        folder = resolved(self.folder)
        return f"session {(folder if folder.name != 'session' else folder.parent).name}"

    @property
    def heights_alone(self) -> bool:
        """Whether the session has only heights of a bed."""
        return self.of_a_bed and not self.links

    @property
    def of_a_bed(self) -> bool:
        """Whether all poses were measured by heights of a bed, whatever links there are."""
        felt = bool(self.trackers) and all(table.kind == Heights.code for table in self.trackers)
        return felt and not self.stations

    @property
    def labels(self) -> dict[str, list[str]]:
        """Plurals of the kinds of measurements besides the readings, by group of rows."""
        observed = {word for station in self.stations for word in station.observe}
        used = {measured.kind for measured in (*self.trackers, *self.links)}
        labels: dict[str, list[str]] = {}
        for code, kind in measurement_kinds().items():
            if code in used or getattr(kind, "observe", "") in observed:
                labels.setdefault(kind.rows, []).append(kind.label)
        return labels

    @property
    def station_names(self) -> tuple[str, ...]:
        """Names of all stations, trackers last, in the order of station numbers."""
        return tuple(station.name for station in (*self.stations, *self.trackers))

    @property
    def camera_of_station(self) -> Integers:
        """Index (S,) of each station's camera, in order of first use. Trackers have index 0, which
        has no effect on their measurements.
        """
        cameras = numbered(station.camera_file for station in self.stations)
        return np.pad(cameras, (0, len(self.trackers)))

    def of_stations(self, numbers: Sequence[int]) -> Session:
        """Session with a subset of its camera stations."""
        return replace(self, stations=tuple(self.stations[k] for k in numbers))

    def without(
        self, reasons: Mapping[int, str], tried: Mapping[int, Array] = MappingProxyType({})
    ) -> Session:
        """Session with some stations rejected.

        reasons : by station number. tried : their most likely T_camera_base, where there is one.
        """
        rejected = tuple(
            RejectedStation(self.stations[k], self.label(k), why, tried.get(k))
            for k, why in reasons.items()
        )
        return replace(
            self.of_stations([k for k in range(len(self.stations)) if k not in reasons]),
            rejected=self.rejected + rejected,
            findings=self.findings + tuple(one.finding for one in rejected),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings, without notes."""
        return tuple(one.text for one in self.findings if one.level is not Level.NOTE)

    def label(self, number: int) -> str:
        """Name of a camera station in messages: the image's file for a hand-held one."""
        station = self.stations[number]
        if not station.handheld:
            return station.name
        return label_of(self.folder, station.images[0].path)

    @property
    def images_taken(self) -> int:
        """Number of images of all stations, rejected stations included."""
        stations = (*self.stations, *(one.station for one in self.rejected))
        return sum(len(station.images) for station in stations)

    def other_model(self, name: str | None) -> Machine:
        """Machine with another model from the same mechanism file."""
        held = not self.machine.layout.underdetermined
        return load_mechanism(self.mechanism, model=name, held=held)


def session_folder(subject: str) -> Path | None:
    """Folder of the session that a subject names, by its folder or its session.yaml; None if the
    subject is a machine.

    A folder that has the name of a built-in machine and contains no session counts as the machine.
    """
    path = Path(subject)
    folder = path.parent if path.name == SESSION_FILE_NAME else path
    if (folder / SESSION_FILE_NAME).is_file() or (folder.is_dir() and subject not in catalogue()):
        return folder
    return None


def load_session(
    folder: Path | str, model: str | None = None, *, measured: bool = True, fewest: int = 2
) -> Session:
    """Read and check a session.

    Parameters
    ----------
    folder :
        The session's folder, or its session.yaml.
    model :
        One of the models that the mechanism file names.
    measured :
        Whether images, or poses, are required. A session is shown and planned for before any
        exist.
    fewest :
        Fewest configurations with images or poses, if they are required. A calibration needs two;
        one image can be viewed.

    Raises
    ------
    pkmcal.errors.InputError
        A file is missing or invalid; the error names file, line and field.

    """
    # Session file and machine.
    folder, document = _session_document(given_path(folder, "a session's folder"))
    schema = validated_document(document, session_schema())
    machine, source = _machine(folder, document, schema.mechanism, model, held=False)
    # Joint readings.
    logged, findings = _readings(folder, document, schema, machine, measured, fewest)
    table = logged.readings
    # Board, camera stations and trackers.
    board = _board(folder, document, schema)
    findings += _unused_board(document, schema)
    stations = tuple(
        camera_station
        for name, station in schema.cameras.items()
        for camera_station in _stations(folder, document, name, station, table.names, measured)
    )
    findings += _rotated_images(folder, stations)
    trackers = _trackers(folder, document, schema, table.names, measured)
    links = _links(folder, document, schema, table.names, machine) if measured else ()
    findings += _default_noise(trackers, links)
    if measured:
        findings += _forces(machine, logged)
    # Checks across files.
    if machine.layout.underdetermined and (stations or not _all_tracked(table, trackers)):
        _machine(folder, document, schema.mechanism, model, held=True)
    if measured:
        _check_paths(document, schema, table)
    _check_distinct(document, stations)
    _check_tables_distinct(folder, document, schema)
    _check_noise(document, schema, machine)
    _check_names(document, (*stations, *trackers))
    if measured and (schema.stations or links):
        findings += _unmeasured(table, stations, trackers, links, fewest)
    return Session(
        folder=folder,
        machine=machine,
        configurations=table.names,
        joints=table.values,
        temperature=logged.temperature,
        forces=logged.forces,
        joint_noise=schema.joints.noise,
        stations=stations,
        board=board,
        document=_resolved_document(folder, schema, logged, stations),
        findings=tuple(findings),
        board_body=schema.board.fixed_to if schema.board else "platform",
        trackers=trackers,
        model=model,
        mechanism=source,
        workspace=_workspace(document, schema),
        links=links,
        reading_units=table.units if any(table.units) else (),
    )


def load_session_to_plan(folder: Path | str) -> Session:
    """Read and check a session of which images or poses may not exist yet.

    Raises InputError as :func:`load_session` does, and for a session without a station.
    """
    session = load_session(folder, measured=False)
    if not session.station_names:
        raise InputError(
            "there is no station to plan for",
            where="session.yaml, stations",
            expected="one entry a camera, or a tracker, in one place",
            next_step="Where readings alone are calibrated from, spread the poses over all that the"
            " machine reaches",
            code="session.no_station",
        )
    return session


def _readings(
    folder: Path,
    document: Document,
    schema: SessionDocument,
    machine: Machine,
    measured: bool,
    fewest: int,
) -> tuple[JointTable, list[Finding]]:
    """Readings, forces and temperatures, and findings on them; empty where none exist before a
    plan.
    """
    if not measured and not (folder / schema.joints.file).exists():
        none = np.zeros((0, machine.n_joints))
        empty = CsvTable(schema.joints.file, machine.joint_names, (), none, ())
        return JointTable(empty, None, None), []
    path = _regular_file(folder, document, schema.joints.file, ("joints", "file"))
    whole, noise = read_csv(path, label=schema.joints.file), schema.joints.noise
    logged = joint_table(whole, machine.joint_units)
    written = written_unit(document.data["joints"]["noise"])
    if written and written.kind not in machine.joint_units:
        error = no_such(machine.joint_units[0], document.data["joints"]["noise"]).error
        raise error.located(document.where("joints", "noise"))
    findings = check_readings(
        logged.readings, machine.joint_ranges, noise, machine.joint_units, fewest
    )
    if measured and not schema.stations and not schema.links():
        _check_redundant(document, machine)
        whole, repeated = without_repeats(whole, logged.readings, noise)
        logged = joint_table(whole, machine.joint_units)
        findings += repeated
    return logged, findings


def _forces(machine: Machine, logged: JointTable) -> list[Finding]:
    """Warning about stated compliances without forces. Raises InputError for forces that shift the
    tool at home by more than NEGLIGIBLE of the machine's size: the correction is of first order.
    """
    if not is_compliant(machine):
        return []
    label, forces = logged.readings.label, logged.forces
    if forces is None:
        return [] if machine.document.load else [doubtful("readings.forces_unknown", label)]
    home = machine.home()
    yields = sag(machine, home, forces)
    if machine.layout.underdetermined:  # no tool follows from the readings
        distance = np.where(np.array(machine.joint_units) == "m", np.abs(yields), 0.0).max(axis=-1)
    else:
        distance = np.linalg.norm(tool_shift(machine, home, yields), axis=-1)
    row, most = int(np.argmax(np.nan_to_num(distance))), NEGLIGIBLE * machine.size
    if distance[row] > most:
        raise InputError(
            "the legs yield too far under these forces",
            where=logged.readings.where(row),
            found=f"{distance[row]:.2g} m at home, by what the mechanism file states",
            expected=f"at most {most:.2g} m, a hundredth of the machine's size",
            next_step="Write forces in N, of cranks and spools in N m, each stiffness in N/m or"
            " N m/rad, and each axial_rigidity in N",
            code="readings.forces",
        )
    return []


def _trackers(
    folder: Path,
    document: Document,
    schema: SessionDocument,
    names: tuple[str, ...],
    measured: bool,
) -> tuple[PoseTable, ...]:
    """Tables of the trackers; names : of the configurations."""
    out: list[PoseTable] = []
    for name, station in schema.trackers.items():
        tracker, keys = station.tracker, ("stations", name, "tracker", "poses")
        noise = tracker.noise.position, tracker.noise.rotation
        if measured or (folder / tracker.poses).exists():
            path = _regular_file(folder, document, tracker.poses, keys)
            read = read_poses(path, tracker.poses, names, *noise, name, level=tracker.level)
            out.append(read)
        else:
            out.append(PoseTable.to_come(name, tracker.poses, *noise))
    return tuple(out)


def _all_tracked(table: CsvTable, trackers: tuple[PoseTable, ...]) -> bool:
    """Whether trackers measured the platform's whole pose in every configuration."""
    whole = [one.configuration for one in trackers if one.kind == TrackerPoses.code]
    return bool(whole) and set(np.concatenate(whole).tolist()) == set(range(len(table.names)))


def _session_document(folder: Path) -> tuple[Path, Document]:
    """Folder and session.yaml of a session, its format version checked before its content."""
    if folder.name == SESSION_FILE_NAME and folder.is_file():
        folder = folder.parent
    if not folder.is_dir():
        beside = closest(
            folder.name, (p.parent.name for p in folder.parent.glob(f"*/{SESSION_FILE_NAME}"))
        )
        raise InputError(
            "there is no such session folder",
            where=str(folder),
            found="a file" if folder.is_file() else None,
            expected="a folder with a session.yaml" if folder.is_file() else None,
            next_step=f"There is {folder.with_name(beside)}" if beside else None,
            code="session.missing",
        )
    if not (folder / SESSION_FILE_NAME).exists():
        below = sorted(path.parent.name for path in folder.glob(f"*/{SESSION_FILE_NAME}"))
        found = f"sessions in {listed(below)} below it" if below else None
        step = "Name the session's folder; pkmcal new DIR makes one to fill in"
        if (folder / CALIBRATION_FILE_NAME).is_file():
            found = "a calibration"
            step = "Name the session; validate and watch take the calibration first"
        raise InputError(
            f"the folder holds no {SESSION_FILE_NAME}",
            where=str(folder),
            found=found,
            next_step=step,
            code="session.missing",
        )
    document = read_yaml(folder / SESSION_FILE_NAME)
    version = document.data.get("pkmcal", SESSION_FILE_VERSION)
    if type(version) is not int or version != SESSION_FILE_VERSION:
        raise InputError(
            "this version of the session's format is not known",
            where=document.where("pkmcal"),
            found=quoted(version),
            expected=str(SESSION_FILE_VERSION),
            next_step="Use the pkmcal that wrote it, or a newer one",
        )
    return folder, document


def _regular_file(folder: Path, document: Document, name: str, keys: Keys) -> Path:
    """Path of a regular file named in session.yaml, relative to the session's folder; raises
    InputError.
    """
    path = folder / name
    try:
        check_regular(path, name)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            "there is no such file",
            where=document.where(*keys),
            found=name,
            expected=wanted_file(path),
            code="file.missing",
        ) from None
    except InputError as error:
        raise error.located(document.where(*keys)) from None
    except OSError as error:  # e.g. an invalid file name
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=document.where(*keys),
            found=name,
            code="file.unreadable",
        ) from None
    return path


def _machine(
    folder: Path, document: Document, source: str, model: str | None, *, held: bool
) -> tuple[Machine, Path | str]:
    """Machine, and the source from which its other models are loaded: a file's path or a built-in
    name.

    held : whether legs that do not hold the platform are an error.
    """
    looks_like_path = source.endswith((".yaml", ".yml")) or "/" in source
    if looks_like_path or len(source) > LONGEST_NAME or (folder / source).is_file():
        path = _regular_file(folder, document, source, ("mechanism",))
        return load_mechanism(path, label=source, model=model, held=held), path
    where = document.where("mechanism")
    return load_mechanism(source, label=where, model=model, held=held), source


def _check_redundant(document: Document, machine: Machine) -> None:
    """Refuse sessions of readings alone for machines without redundant actuators: nothing
    constrains the geometry.
    """
    if machine.redundancy > 0:
        return
    raise InputError(
        "nothing was measured but the readings, and these cannot calibrate this machine: it has no"
        " more of them than freedoms, so any geometry fits them",
        where=document.where("stations"),
        found=f"{machine.n_joints} readings for {machine.n_joints - machine.redundancy} freedoms",
        expected="stations: a camera or a tracker, or a machine with more readings than freedoms",
        next_step="Take images of the machine, or measure its platform, and name that"
        " under stations",
    )


def _links(
    folder: Path,
    document: Document,
    schema: SessionDocument,
    names: tuple[str, ...],
    machine: Machine,
) -> tuple[LinkSet, ...]:
    """Measurements that depend on two configurations, by kind, read from their tables."""
    out: list[LinkSet] = []
    for code, node in schema.links().items():
        kind = kinds_of(LinkKind)[code]
        path = _regular_file(folder, document, kind.table(node), (kind.key, "file"))
        out.append(kind.read(node, path, names, machine))
    return tuple(out)


def _board(folder: Path, document: Document, schema: SessionDocument) -> Path | None:
    """Path of the board's file, None without a board; raises InputError if stations cannot use the
    board as stated.
    """
    users = schema.observers("board")
    if schema.board is None:
        if users:
            raise InputError(
                f"station {listed(users)} observes a board, and none is described",
                where=document.where("stations", users[0], "observe"),
                expected="a line board: board.yaml at the top level",
            )
        return None
    if schema.board.fixed_to == "base":
        _check_base_board(document, schema, users)
    written = document.data["board"]
    keys: Keys = ("board",) if isinstance(written, str) else ("board", "file")
    return _regular_file(folder, document, schema.board.file, keys)


def _check_base_board(document: Document, schema: SessionDocument, users: list[str]) -> None:
    """Refuse stations that observe only a board on the base.

    Such a board relates stations that also observe legs; alone it has no information on the
    machine.
    """
    legs = schema.observers("legs")
    alone = [name for name in users if name not in legs]
    if not alone:
        return
    who = "no station observes legs" if not legs else f"station {listed(alone)} observes no legs"
    raise InputError(
        f"the board is fixed to the base, which does not move, and {who}",
        where=document.where("stations", alone[0], "observe"),
        found="board",
        expected="[legs, board], in the same images",
        next_step="If the board is on the platform, write board: {file: "
        f"{schema.board.file if schema.board else 'board.yaml'}, fixed_to: platform}}",
    )


def _workspace(document: Document, schema: SessionDocument) -> Region | None:
    """Region of the session, None if not stated; raises InputError with its location."""
    if schema.workspace is None:
        return None
    try:
        return Region(**schema.workspace.model_dump())
    except InputError as error:
        raise error.located(document.where("workspace")) from None


def _unused_board(document: Document, schema: SessionDocument) -> list[Finding]:
    """Warnings about a board without effect: observed by no station, or on the base and observed by
    a single fixed station.
    """
    users = schema.observers("board")
    if schema.board is None:
        return []
    if not users:
        return [doubtful("session.board_unused", document.where("board"))]
    first = schema.stations[users[0]]
    by_hand = isinstance(first, StationDocument) and first.handheld
    if schema.board.fixed_to == "base" and len(users) == 1 and not by_hand:
        where = document.where("board")
        return [doubtful("session.board_joins_none", where, station=users[0])]
    return []


def _stations(
    folder: Path,
    document: Document,
    name: str,
    station: StationDocument,
    names: tuple[str, ...],
    measured: bool,
) -> list[Station]:
    """Stations of an entry: one, or one for each image of a hand-held camera."""
    keys: Keys = ("stations", name)
    where = document.where(*keys, "images")
    images = find_images(folder, station.images, names, where, needed=measured)
    from_exif = station.camera == EXIF_CAMERA_WORD
    if from_exif:
        label = document.where(*keys, "camera")
        camera = camera_by_exif([(p.path, label_of(folder, p.path)) for p in images], label)
        camera_file = f"exif/{name}.yaml"
    else:
        camera_file = station.camera
        _, inside = camera_path(folder / camera_file)
        _regular_file(folder, document, camera_file.removesuffix(f"#{inside}"), (*keys, "camera"))
        camera = load_camera(folder / camera_file, label=camera_file)
    endings = {image.path.suffix.lower() for image in images}
    usual: Response = "srgb" if endings and endings <= JPEG_FILE_ENDINGS else "linear"
    T_camera_base = None
    if station.handheld:
        _check_handheld(document, name, station)
    elif station.poses:
        raise InputError(
            "poses of single images belong to a hand-held camera",
            where=document.where(*keys, "poses"),
            found="poses, without handheld: true",
            expected="pose, of a camera at one place",
            next_step="Write pose for a camera on a tripod, or handheld: true",
        )
    if station.pose is not None:
        T_camera_base = _rough_pose(document, (*keys, "pose"), station.pose)
    whole = Station(
        name, camera, camera_file, T_camera_base, images, station.observe, name,
        station.handheld, from_exif, station.response or usual, station.response is not None,
    )  # fmt: skip
    if not station.handheld or not images:  # by hand without images: of a session to be planned
        return [whole]
    check_count(len(images), MOST_HANDHELD_IMAGES, "images by hand", where)
    called = ["-".join(filter(None, (names[one.configuration], one.repeat))) for one in images]
    for image in station.poses.keys() - set(called):
        raise InputError(
            "there is no hand-held image of this name",
            where=document.where(*keys, "poses", image),
            found=image,
            expected=closest(image, called) or "a configuration and a repeat, such as 0003-2",
        )
    poses = {
        image: _rough_pose(document, (*keys, "poses", image), pose)
        for image, pose in station.poses.items()
    }
    return [
        replace(whole, name=f"{name}-{one}", images=(image,), T_camera_base=poses.get(one))
        for one, image in zip(called, images, strict=True)
    ]


def _rough_pose(document: Document, keys: Keys, pose: PoseDocument) -> Array:
    """T_camera_base (4, 4) of a pose by hand."""
    away = max(map(abs, pose.position))
    if away > LARGEST_UNITLESS_LENGTH and not any_unit(document.data):
        raise InputError(
            "the camera's place looks like millimetres",
            where=document.where(*keys, "position"),
            found=f"{away:g} m",
            expected=f"metres, at most {LARGEST_UNITLESS_LENGTH:g} where no value has a unit",
            next_step="Write it with its unit, such as 1250 mm, or divide by 1000",
        )
    try:
        return look_at(pose.position, pose.look_at, pose.up)
    except InputError as error:
        raise error.located(document.where(*keys)) from None


def _check_handheld(document: Document, name: str, station: StationDocument) -> None:
    """Refuse a pose for a hand-held camera, and hand-held images of a board alone."""
    keys: Keys = ("stations", name)
    if station.pose is not None:
        raise InputError(
            "a hand-held camera has no single pose",
            where=document.where(*keys, "pose"),
            found="handheld: true, and a pose",
            expected="one of them",
            next_step="Write it under poses, by the image's configuration and repeat, or remove"
            " handheld where all images are from one place",
        )
    if "legs" not in station.observe:
        raise InputError(
            "hand-held images of a board alone do not determine the machine",
            where=document.where(*keys, "observe"),
            found="board",
            expected="legs, or [legs, board]: only the legs determine where the board is",
        )


def _rotated_images(folder: Path, stations: tuple[Station, ...]) -> list[Finding]:
    """Warnings about images rotated by 90 degrees after they were taken; raises InputError for an
    image whose size differs from its camera's.
    """
    turned: list[str] = []
    for station, image in ((s, image) for s in stations for image in s.images):
        label, wanted = label_of(folder, image.path), tuple(station.camera.image_size)
        width, height = size = image_header(image.path, label)
        if wanted not in (size, (height, width)):
            raise InputError(
                "the image has another size than its camera",
                where=label,
                found=f"{width}x{height}",
                expected=f"{wanted[0]}x{wanted[1]} ({station.camera_file})",
                next_step="Use unscaled, uncropped images, or the camera file of this resolution",
            )
        if wanted != size:
            turned.append(label)
    if not turned:
        return []
    return [doubtful("session.turned_by_quarter", turned[0], number=len(turned))]


def _check_distinct(document: Document, stations: tuple[Station, ...]) -> None:
    """Refuse the same images in two stations (for the same observation): a line was copied and not
    edited.
    """
    owners: dict[tuple[str, str], str] = {}
    for station in stations:
        for image in station.images:
            path = os.path.realpath(image.path)
            others = {owners.setdefault((path, w), station.name) for w in station.observe}
            for other in others - {station.name}:
                raise InputError(
                    f"station {station.name} has the images of station {other}",
                    where=document.where("stations", station.name, "images"),
                    found=image.path.name,
                    expected="its own images; a station is one camera in one place",
                    code="station.same_images",
                )


def _check_tables_distinct(folder: Path, document: Document, schema: SessionDocument) -> None:
    """Refuse the same tracker table in two stations: its measurements would count twice."""
    owners: dict[str, str] = {}
    for name, station in schema.trackers.items():
        table = station.tracker.poses
        other = owners.setdefault(os.path.realpath(folder / table), name)
        if other != name:
            raise InputError(
                f"station {name} has the table of station {other}",
                where=document.where("stations", name, "tracker", "poses"),
                found=table,
                expected="its own table; a station is one instrument in one place",
            )


def _default_noise(trackers: Sequence[PoseTable], links: Sequence[LinkSet]) -> list[Finding]:
    """Notes on standard deviations that the session does not state."""
    kinds = {table.label: table.kind for table in trackers if table.by_default}
    kinds |= {one.label: one.kind for one in links if one.by_default}
    every = measurement_kinds()
    return [
        note(
            "session.default_noise",
            label,
            sigma=every[code].default_sigma,
            one=every[code].one,
            own=every[code].own_sigma,
        )
        for label, code in kinds.items()
    ]


def _check_noise(document: Document, schema: SessionDocument, machine: Machine) -> None:
    """Refuse standard deviations of lengths that are not smaller than the machine's parts."""
    noises: list[tuple[tuple[str, ...], float]] = [
        (("stations", name, "tracker", "noise", "position"), station.tracker.noise.position)
        for name, station in schema.trackers.items()
        if station.tracker.noise.position is not None
    ]
    for code, node in schema.links().items():
        kind = kinds_of(LinkKind)[code]
        noise = kind.noise(node)
        if noise is not None and kind.unit == "m":
            noises.append(((kind.key, "noise"), noise))
    if "m" in machine.joint_units:
        noises.append((("joints", "noise"), schema.joints.noise))
    for keys, sigma in noises:
        check_plausible(sigma, machine, document.where(*keys), "a standard deviation")


def _check_paths(document: Document, schema: SessionDocument, table: CsvTable) -> None:
    """Refuse straight paths with unknown or fewer than SHORTEST_PATH configurations."""
    names = set(table.names)
    for name, members in (schema.paths or {}).items():
        for k, member in enumerate(members):
            if member not in names:
                guess = closest(member, table.names)
                raise InputError(
                    "there is no such configuration",
                    where=document.where("paths", name, k),
                    found=member,
                    expected=guess or f"a name from {table.label}",
                )
        if len(set(members)) < SHORTEST_PATH:
            raise InputError(
                "too few configurations for a straight path",
                where=document.where("paths", name),
                found=str(len(set(members))),
                expected=f"{SHORTEST_PATH} at least",
            )


def _check_names(document: Document, stations: tuple[Station | PoseTable, ...]) -> None:
    """Refuse equal names of stations; each hand-held image is a station of its own."""
    many = Counter(station.name for station in stations)
    twice = next((name for name, count in many.items() if count > 1), None)
    if twice is not None:
        raise InputError(
            "two stations, or hand-held images, have the same name",
            where=document.where("stations"),
            found=twice,
            expected="names that differ; an image by hand is called by its station,"
            " configuration and repeat",
        )


def _unmeasured(
    table: CsvTable,
    stations: tuple[Station, ...],
    trackers: tuple[PoseTable, ...],
    links: tuple[LinkSet, ...],
    fewest: int,
) -> list[Finding]:
    """Warning about configurations without measurements; raises InputError if too few have any."""
    measured = {image.configuration for station in stations for image in station.images}
    measured |= {int(k) for tracker in trackers for k in tracker.configuration}
    measured |= {int(k) for one in links for k in one.configuration.ravel()}
    if len(measured) < fewest:
        raise InputError(
            "only one configuration was measured"
            if trackers or links
            else "only one configuration has images",
            where=table.label,
            found=table.names[min(measured)],
            expected="two at least; one does not distinguish a joint's place from its offset",
            code="configurations.only_one",
        )
    missing = [name for row, name in enumerate(table.names) if row not in measured]
    if not missing:
        return []
    return [
        doubtful(
            "session.unmeasured",
            table.label,
            names=missing,
            number=len(missing),
            of=len(table.names),
            by="trackers" if trackers or links else "cameras",
        )
    ]


def _resolved_document(
    folder: Path,
    schema: SessionDocument,
    logged: JointTable,
    stations: tuple[Station, ...],
) -> dict[str, Any]:
    """Content of session.yaml as plain data, with columns, readings and image files written out."""
    document = schema.model_dump(mode="json")
    for kind in kinds_of(LinkKind).values():  # keep digests independent of unused kinds
        if document[kind.key] is None:
            del document[kind.key]
    table = logged.readings
    document["joints"]["columns"] = list(table.columns)
    document["joints"]["readings"] = dict(zip(table.names, table.values.tolist(), strict=True))
    if logged.temperature is not None:
        document["joints"]["temperatures"] = logged.temperature.tolist()
    if logged.forces is not None:
        document["joints"]["forces"] = logged.forces.tolist()
    for station in stations:
        entry = document["stations"][station.entry]
        entry["observe"] = station.observe[0] if len(station.observe) == 1 else station.observe
        files = [label_of(folder, image.path) for image in station.images]
        entry["photographs"] = entry.get("photographs", []) + files
    return document


def digests(session: Session) -> dict[str, list[str]]:
    """Short digests of the image files, by configuration."""
    out: dict[str, list[str]] = {}
    for station in session.stations:
        for image in station.images:
            name = session.configurations[image.configuration]
            digest = blake2b(image.path.read_bytes(), digest_size=8).hexdigest()
            out.setdefault(name, []).append(digest)
    return out


def session_digest(session: Session, images: Mapping[str, Sequence[str]]) -> str:
    """Short digest of everything that a result depends on: readings, nominal model, cameras, board,
    tables of trackers and links, and images.

    images : :func:`digests` of the session.

    The digest is of values, not of the files' bytes (board and images excepted): comments and the
    user's notes do not change it.
    """
    entries = {name: value for name, value in session.document.items() if name != "notes"}
    cameras = {
        s.camera_file: [s.camera.model, s.camera.image_size, s.camera.parameters]
        for s in session.stations
    }
    tables = [[t.configuration, t.T, t.position, t.rotation] for t in session.trackers]
    tables += [[one.configuration, one.value, one.sigma] for one in session.links]
    board = session.board.read_bytes() if session.board else b""
    all_of_it = [
        entries,
        session.machine.to_document(),
        session.model,
        cameras,
        tables,
        images,
    ]
    text = json_text(all_of_it) + blake2b(board).hexdigest()
    return blake2b(text.encode("utf-8"), digest_size=8).hexdigest()
