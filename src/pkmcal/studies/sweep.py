"""Subjects of a study and the names that can be varied, with their effect on a design.

A study starts from a machine, a session or a paper's setting, and runs every combination of the
given values (a full grid). All combinations use the same seeds: their machines, noise and choices
of configurations differ only by what is varied.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pkmcal.boards.board import load_board
from pkmcal.cameras import Camera, camera_models, load_camera
from pkmcal.cameras.contract import FOCAL
from pkmcal.errors import InputError
from pkmcal.files import closest
from pkmcal.files.quantities import read_quantity
from pkmcal.mechanisms import Machine, MechanismDocument, catalogue, load_mechanism
from pkmcal.mechanisms.machine import machine_from_document
from pkmcal.outcome.finding import Finding, note
from pkmcal.placement.configurations import check_drawable
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.session.load import Session, load_session_to_plan, session_folder
from pkmcal.studies.calibrations import SimulatedCalibrations
from pkmcal.studies.capture import Design
from pkmcal.studies.tasks import StudySetting
from pkmcal.studies.varied import DESIGN_NAMES_VARIED, PAPER_NAMES_VARIED, Varied
from pkmcal.wording import DISPLAY_UNITS, listed, with_unit

STUDIED_PAPER = "a"
MOST_CELLS = 500
BUILT_IN_CAMERA_SIZE = (1024, 768)
"""Width and height in px of the built-in cameras."""
MIRROR_FOCAL, MIRROR_XI = 0.35, 1.0
"""Focal length of the built-in mirror in image heights, and its xi: a parabola, in view up to 110
degrees from its axis.
"""
Value = float | int | str


class PaperSetting(StudySetting, Protocol):
    """Setting of a paper's simulated calibrations. parameters : their names and units."""

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]: ...

    def varied(self, values: Mapping[str, Value]) -> PaperSetting:
        """Setting with other values of the names in PAPER_NAMES_VARIED."""
        ...


SweptSetting = SimulatedCalibrations | PaperSetting


@dataclass(frozen=True)
class StudySubject:
    """Subject of a study: a design, or the setting of a paper.

    name : description in words. findings : remarks on how the subject differs from the session.
    """

    name: str
    design: Design | PaperSetting
    findings: tuple[Finding, ...] = ()

    @property
    def names(self) -> Mapping[str, Varied]:
        """Names that can be varied."""
        return DESIGN_NAMES_VARIED if isinstance(self.design, Design) else PAPER_NAMES_VARIED

    def unit_of(self, name: str) -> str:
        """Unit of a name's numbers: m or rad alone where all readings of the machine are of a
        kind.
        """
        unit = self.names[name].unit
        if unit == "m or rad" and isinstance(self.design, Design):
            kinds = set(self.design.machine.joint_units)
            return kinds.pop() if len(kinds) == 1 else unit
        return unit

    def display_unit(self, name: str) -> tuple[float, str]:
        """Factor and unit in which a name's numbers are shown: mm or degrees for readings."""
        unit = self.unit_of(name)
        return (1.0, unit) if unit == self.names[name].unit else DISPLAY_UNITS[unit]

    def value_text(self, name: str, value: Value) -> str:
        """A value of a name with its unit."""
        factor, unit = self.display_unit(name)
        return value if isinstance(value, str) else with_unit(f"{value * factor:g}", unit).rstrip()

    def in_words(self, values: Mapping[str, Value]) -> str:
        """Description of a combination, such as "stations 2, edge noise 0.1 px"; empty if nothing
        varies.
        """
        return ", ".join(
            f"{name.replace('_', ' ')} {self.value_text(name, value)}"
            for name, value in values.items()
        )


@dataclass(frozen=True)
class Cell:
    """One combination. values : of the varied names. setting : of the simulation."""

    values: Mapping[str, Value]
    setting: SweptSetting


def subject_of(origin: Machine | str) -> StudySubject:
    """Subject by a machine, a session's folder, a mechanism file or a built-in machine's name.

    Raises InputError if the origin is none of these.
    """
    if isinstance(origin, Machine):
        return _of_machine(origin)
    folder = session_folder(origin)
    if folder is not None:
        session = load_session_to_plan(folder)
        check_drawable(session.machine)
        return _of_session(session)
    if origin not in catalogue() and Path(origin).suffix not in (".yaml", ".yml"):
        raise InputError(
            "no machine or session has this name",
            found=origin,
            expected=closest(origin, catalogue())
            or f"a session's folder, a mechanism file, the paper {STUDIED_PAPER}, or"
            f" {listed(sorted(catalogue()), 20)}",
            code="machine.unknown",
        )
    return _of_machine(load_mechanism(origin, label=None))


def _of_machine(machine: Machine) -> StudySubject:
    """Subject with a machine and the built-in camera."""
    check_drawable(machine)
    return StudySubject(machine.name, Design(machine, (camera_of_size(BUILT_IN_CAMERA_SIZE),)))


def _of_session(session: Session) -> StudySubject:
    """Subject with a session's machine, cameras, stations, noise, and number of configurations.

    Raises InputError if stations are hand-held or do not all observe the same.
    """
    if not session.stations or any(station.handheld for station in session.stations):
        raise InputError(
            "a study needs cameras that stand still",
            where=str(session.folder),
            found="images by hand" if session.stations else "trackers alone",
            next_step="Study the machine itself: pkmcal study with its mechanism file",
        )
    # What a study leaves out of the session.
    on_base = session.board is not None and session.board_body == "base"
    findings: list[Finding] = []
    if on_base:
        findings.append(note("study.without_board"))
    if session.trackers:
        findings.append(note("study.without_trackers"))
    if session.workspace is not None:
        findings.append(note("study.whole_reach"))
    observed = [{w for w in s.observe if not (on_base and w == "board")} for s in session.stations]
    if any(own != observed[0] for own in observed) or not observed[0]:
        raise InputError(
            "a study needs stations that all observe the same, legs or a board on the platform",
            where=str(session.folder),
            found=listed([" and ".join(sorted(own)) or "the base's board" for own in observed], 4),
        )
    # Stations keep their poses if all are known, and the number of their configurations.
    poses = [station.T_camera_base for station in session.stations]
    given = [place for place in poses if place is not None]
    if len(given) < len(poses):
        findings.append(note("study.chosen_stations"))
    by_station = [{p.configuration for p in station.images} for station in session.stations]
    usual = Design.configurations
    if not any(by_station):
        findings.append(note("study.no_images", number=usual))
    board = None if session.board is None or on_base else load_board(session.board)
    design = Design(
        session.machine,
        tuple(station.camera for station in session.stations),
        stations=len(poses),
        T_camera_base=np.stack(given) if len(given) == len(poses) else None,
        observe=tuple(word for word in ("legs", "board") if word in observed[0]),
        board=board,
        configurations=max(2, round(float(np.median([len(own) for own in by_station]))))
        if any(by_station)
        else usual,
        shared=len(by_station) > 1
        and any(by_station)
        and all(own == by_station[0] for own in by_station),
        reading_noise=session.joint_noise,
    )
    return StudySubject(f"the session {session.folder}", design, tuple(findings))


def parsed(subject: StudySubject, texts: Sequence[str]) -> dict[str, tuple[Value, ...]]:
    """Values by name from texts ``NAME=V1,V2,…``; raises InputError for a name or value that is
    invalid.
    """
    out: dict[str, tuple[Value, ...]] = {}
    for text in texts:
        name, equals, rest = text.partition("=")
        name = name.strip().replace("-", "_")
        if name not in subject.names:
            guess = closest(name, subject.names)
            raise InputError(
                "this cannot be varied",
                where="--vary",
                found=text,
                expected=guess or f"NAME=V1,V2 with a name of {listed(list(subject.names), 20)}",
            )
        if name in out:
            raise InputError(
                "a name is varied twice", where="--vary", found=name, code="study.name_twice"
            )
        parts = [part.strip() for part in rest.split(",")]
        if not equals or not all(parts):
            raise InputError(
                "a value is missing", where="--vary", found=text, expected=f"{name}=V1,V2"
            )
        unit = subject.unit_of(name)
        readable = {"°": "deg"}.get(unit, unit)
        values = [_value(name, subject.names[name], readable, part) for part in parts]
        if len(set(values)) < len(values):
            raise InputError(
                "a value occurs twice", where="--vary", found=text, code="study.value_twice"
            )
        out[name] = tuple(values)
    return out


def _value(name: str, varied: Varied, unit: str, text: str) -> Value:
    """One value of a name, validated. unit : of a number, as for :func:`read_quantity`."""
    if varied.words:
        if text in varied.words or (name == "camera" and Path(text).is_file()):
            return text
        *words, last = *varied.words, *(["a camera's file"] if name == "camera" else [])
        raise InputError(
            f"no such {name}", where="--vary", found=text, expected=f"{', '.join(words)} or {last}"
        )
    value = math.nan
    with suppress(ValueError):
        value = float(text) if varied.whole else read_quantity(text, unit)
    good = varied.least <= value <= varied.most and not (varied.whole and value % 1)
    if not good:
        most = f" to {varied.most:g}" if math.isfinite(varied.most) else " or more"
        raise InputError(
            f"{name} cannot have this value ({varied.cell_text})",
            where="--vary",
            found=text,
            expected=("a whole number of " if varied.whole else "")
            + f"{varied.least:g}{most} {unit}".rstrip(),
        )
    return int(value) if varied.whole else value


def cells_of(subject: StudySubject, varied: Mapping[str, Sequence[Value]]) -> list[Cell]:
    """All combinations of the values."""
    count = math.prod(map(len, varied.values()))
    if count > MOST_CELLS:
        raise InputError(
            "too many combinations", where="--vary", found=str(count),
            expected=f"at most {MOST_CELLS}", next_step="Give fewer values",
        )  # fmt: skip
    out: list[Cell] = []
    for values in product(*varied.values()):
        chosen = dict(zip(varied, values, strict=True))
        if isinstance(subject.design, Design):
            out.append(Cell(chosen, SimulatedCalibrations(_design(subject.design, chosen))))
        else:
            out.append(Cell(chosen, subject.design.varied(chosen)))
    return out


def _design(design: Design, values: Mapping[str, Value]) -> Design:
    """Design with other values; stations are chosen anew if their poses no longer fit."""
    # Stations and cameras.
    affects_stations = {"stations", "distance", "elevation", "size", "camera"} & values.keys()
    if affects_stations:
        design = replace(design, T_camera_base=None)
    if "stations" in values and len(design.cameras) > 1:
        design = replace(design, cameras=design.cameras[:1])
    cameras = design.cameras
    if "camera" in values:
        cameras = (_camera(str(values["camera"])),)
    if "resolution" in values:
        cameras = tuple(_resized(camera, int(values["resolution"])) for camera in cameras)
    if "focal" in values:
        cameras = tuple(_refocused(camera, float(values["focal"])) for camera in cameras)
    # The machine, and values that are fields of the design.
    machine = design.machine
    if "size" in values:
        machine = scaled(machine, float(values["size"]))
    plain: dict[str, Any] = {
        name: value
        for name, value in values.items()
        if name not in ("camera", "resolution", "focal", "size", "radius", "observe", "elevation")
    }
    if "observe" in values:
        plain["observe"] = tuple(str(values["observe"]).split("+"))
    if "elevation" in values:
        plain["elevation"] = math.radians(float(values["elevation"]))
    design = replace(design, machine=machine, cameras=cameras, **plain)
    if "radius" in values:
        design = replace(
            design, machine=_with_radii(design.machine_with_cylinders, float(values["radius"]))
        )
    return design


def _camera(name: str) -> Camera:
    """Built-in camera by its name, or camera from a file."""
    if name == "pinhole":
        return camera_of_size(BUILT_IN_CAMERA_SIZE)
    if name == "mirror":
        width, height = BUILT_IN_CAMERA_SIZE
        focal = MIRROR_FOCAL * height
        centre = [(width - 1) / 2, (height - 1) / 2]
        parameters = np.array([focal, focal, *centre, MIRROR_XI, 0.0, 0.0, 0.0, 0.0])
        return camera_models()["unified"](BUILT_IN_CAMERA_SIZE, parameters)
    return load_camera(Path(name))


def _resized(camera: Camera, width: int) -> Camera:
    """Camera with the same lens and sensor size, and another number of pixels."""
    factor = width / camera.image_size[0]
    size = (width, max(1, round(factor * camera.image_size[1])))
    return camera.resampled(factor, size)


def _refocused(camera: Camera, focal: float) -> Camera:
    """Camera with another focal length and the same sensor."""
    parameters = camera.parameters.copy()
    parameters[FOCAL] *= focal / float(camera.focal[0])
    return replace(camera, parameters=parameters, covariance=None)


def _with_radii(machine: Machine, factor: float) -> Machine:
    """Machine with its tubes' radii times a factor."""
    document = machine.to_document()
    for leg in document["legs"]:
        for tube in leg.get("tubes", ()):
            tube["radius"] *= factor
    return _rebuilt(document)


def scaled(machine: Machine, factor: float) -> Machine:
    """Machine with all its nominal lengths times a factor; prior sigmas are unchanged, because
    those of a workshop do not depend on the size.
    """
    values = machine.values.copy()
    lengths = np.array(machine.parameters.units) == "m"
    values[lengths] *= factor
    document = machine.with_values(values).to_document()
    for leg, motor in zip(document["legs"], machine.layout.actuated.tolist(), strict=True):
        _scale(leg["length"], "range", factor)
        if motor >= 0 and machine.joint_units[motor] == "m":
            _scale(leg["base"], "range", factor)
        for tube in leg.get("tubes", ()):
            tube["from"] *= factor
            tube["to"] *= factor
    if document.get("home"):
        _scale(document["home"], "position", factor)
    return _rebuilt(document)


def _scale(node: dict[str, Any], key: str, factor: float) -> None:
    if node.get(key) is not None:
        node[key] = [factor * value for value in node[key]]


def _rebuilt(document: dict[str, Any]) -> Machine:
    import json

    return machine_from_document(MechanismDocument.model_validate_json(json.dumps(document)))
