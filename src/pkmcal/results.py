"""What a calibration leaves on disk (mechanism.yaml, calibration.json, report.html), read back."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from pkmcal import __version__
from pkmcal.arrays import Array, Booleans
from pkmcal.calibration.results import FORMAT, document_of
from pkmcal.errors import InputError
from pkmcal.files import (
    Document,
    Schema,
    check_writable,
    json_text,
    read_json,
    staged_folder,
    validate,
)
from pkmcal.mechanisms import Machine, MechanismDocument, machine_from_document, mechanism_text
from pkmcal.outcome import Verdict
from pkmcal.wording import listed

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

MECHANISM, EVERYTHING, REPORT = "mechanism.yaml", "calibration.json", "report.html"
FILES = (REPORT, MECHANISM, EVERYTHING)
CAMERA_FILE = re.compile(r"camera-.+\.yaml")
"""Cameras as refined with the machine, where that was asked for."""
EXACT = 1e-9
"""Relative difference below which two numbers of a file are the same: rounding leaves 1e-15, a
change by hand a millionth."""
FORMAT_KEY = "pkmcal_calibration"

Row3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


def check_output(folder: Path | str) -> None:
    """Raise `InputError` where a result cannot go into `folder`; call it before the work.

    Only a new or empty folder, or an earlier result, is written to: a session's own
    mechanism.yaml must not be lost to its calibrated one.
    """
    folder = Path(folder)
    check_writable(folder)
    if not folder.is_dir():
        return
    entries = sorted(entry.name for entry in folder.iterdir())
    foreign = [name for name in entries if name not in FILES and not CAMERA_FILE.fullmatch(name)]
    # A mechanism.yaml without the rest is somebody's drawing.
    if foreign or (entries and EVERYTHING not in entries):
        raise InputError(
            "the output folder holds something other than a calibration",
            where=str(folder),
            found=listed(foreign or entries, 4),
            expected="a new or empty folder, or an earlier calibration to replace",
            next_step="Name another folder with -o, or move these files away",
        )


def save(calibration: Calibration, folder: Path | str) -> None:
    """Write a calibration's three files into `folder`, whole or not at all."""
    from pkmcal.report import report_html

    check_output(folder)
    report = report_html(
        calibration.session,
        calibration.observation,
        calibration.estimate,
        calibration.verdict,
        findings=calibration.findings,
        timings=calibration.timings,
        holdout=calibration.holdout,
    )
    texts = {
        MECHANISM: calibrated_mechanism_text(calibration),
        EVERYTHING: json_text(document_of(calibration)),
        REPORT: report,
    }
    texts |= _refined_cameras(calibration)
    with staged_folder(folder) as stage:
        for name, text in texts.items():
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).write_text(text, encoding="utf-8", newline="\n")


def _refined_cameras(calibration: Calibration) -> dict[str, str]:
    """Camera files as refined with the machine, by their place in the folder."""
    from pkmcal.cameras.files import camera_text

    cameras = calibration.cameras
    if not cameras.active:
        return {}
    return {
        f"camera-{Path(file).stem}.yaml": camera_text(cameras.result(calibration.estimate, file))
        for file in cameras.files
    }


def calibrated_mechanism_text(calibration: Calibration) -> str:
    """The calibrated machine as a mechanism file, with what it is on top."""
    verdict = calibration.verdict
    name = calibration.session.folder.resolve().name
    lines = [
        f"Calibrated by pkmcal {__version__} from the session {name}"
        f" (method {calibration.method}, seed {calibration.seed}).",
        verdict.headline if verdict.usable else "NOT TO BE USED: " + " ".join(verdict.reasons),
        f"Frames: {calibration.estimate.gauge}. Lengths in metres.",
        f"Standard deviations, covariance and all else: {EVERYTHING}; for people: {REPORT}.",
    ]
    # A session's name may hold a line break; what follows it must stay a comment.
    comment = "".join(f"# {' '.join(line.split())}\n" for line in lines)
    return comment + mechanism_text(calibration.machine)


@dataclass(frozen=True)
class SavedStation:
    """One camera's pose as found: T_base_camera (4, 4), m.

    sigma_rotation, sigma_translation : (3,) standard deviations, rad and m, base axes.
    """

    name: str
    camera: str
    T_base_camera: Array
    sigma_rotation: Array
    sigma_translation: Array


@dataclass(frozen=True)
class SavedCalibration:
    """A calibration read back, in the frames that `gauge` names.

    machine : with the calibrated values. drawing : (P,) values before. covariance : (P, P).
    data_share : (P,), NaN where it means nothing.
    configurations : K names. used : (K,). joints : (K, m). T_base_platform : (K, 4, 4).
    document : the whole file.
    """

    path: Path
    machine: Machine
    drawing: Array
    covariance: Array
    data_share: Array
    gauge: str
    method: str
    seed: int
    verdict: Verdict
    stations: tuple[SavedStation, ...]
    configurations: tuple[str, ...]
    used: Booleans
    joints: Array
    T_base_platform: Array
    document: dict[str, Any]

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of the machine's parameters, m or rad."""
        return np.sqrt(np.diag(self.covariance))


class _Part(Schema):
    """Fields that are needed here; a newer pkmcal may write more."""

    model_config = ConfigDict(extra="ignore")


class _Verdict(_Part):
    usable: bool
    headline: str
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()


class _Parameter(_Part):
    name: str
    drawing: float
    value: float
    data_share: float | None


class _Station(_Part):
    name: str
    camera: str
    T_base_camera: Matrix4
    sigma_rotation: Row3
    sigma_translation: Row3


class _Configuration(_Part):
    name: str
    used: bool
    joints: tuple[float, ...]
    T_base_platform: Matrix4


class _Saved(_Part):
    pkmcal_calibration: Literal[1] = Field(description="the file's version, 1")
    verdict: _Verdict
    method: str
    seed: int
    gauge: str
    parameters: tuple[_Parameter, ...]
    covariance: tuple[tuple[float, ...], ...]
    stations: tuple[_Station, ...]
    configurations: tuple[_Configuration, ...]
    mechanism: MechanismDocument


def load(source: Path | str) -> SavedCalibration:
    """Read a calibration from its folder or its calibration.json, and check that it is whole."""
    document = _read(Path(source))
    saved = validate(document, _Saved)
    machine = machine_from_document(saved.mechanism)
    _check_parameters(document, saved, machine)
    covariance = _covariance(document, saved)
    for group in ("stations", "configurations"):
        _check_poses(document, group, getattr(saved, group))
    return SavedCalibration(
        path=document.path,
        machine=machine,
        drawing=np.array([p.drawing for p in saved.parameters]),
        covariance=covariance,
        data_share=np.array([p.data_share for p in saved.parameters], dtype=float),
        gauge=saved.gauge,
        method=saved.method,
        seed=saved.seed,
        verdict=Verdict(**saved.verdict.model_dump()),
        stations=tuple(_station(station) for station in saved.stations),
        configurations=tuple(c.name for c in saved.configurations),
        used=np.array([c.used for c in saved.configurations], dtype=bool),
        joints=np.array([c.joints for c in saved.configurations]).reshape(-1, machine.n_joints),
        T_base_platform=np.array([c.T_base_platform for c in saved.configurations]),
        document=document.data,
    )


def _read(source: Path) -> Document:
    path = source / EVERYTHING if source.is_dir() else source
    if not path.is_file():
        raise InputError(
            "there is no calibration here",
            where=str(source),
            expected=f"a folder that pkmcal calibrate wrote, or its {EVERYTHING}",
        )
    document = read_json(path, label=str(path))
    found = document.data.get(FORMAT_KEY)
    if found != FORMAT:
        raise InputError(
            "this is not a calibration of a version that is known" if found else
            "this is not a calibration",
            where=f"{path}, {FORMAT_KEY}",
            found=found,
            expected=str(FORMAT),
        )  # fmt: skip
    return document


def _check_parameters(document: Document, saved: _Saved, machine: Machine) -> None:
    names = tuple(p.name for p in saved.parameters)
    if names != machine.parameters.names:
        raise _edited(document, "parameters", "the names of the mechanism's parameters")
    values = np.array([p.value for p in saved.parameters])
    if not np.allclose(values, machine.values, rtol=EXACT, atol=EXACT**2):
        k = int(np.argmax(np.abs(values - machine.values)))
        raise _edited(document, f"parameters[{k + 1}].value", f"the value of {names[k]}")


def _covariance(document: Document, saved: _Saved) -> Array:
    count = len(saved.parameters)
    if {len(row) for row in saved.covariance} != {count} or len(saved.covariance) != count:
        raise InputError(
            "the covariance has another size than the list of parameters",
            where=document.where("covariance"),
            expected=f"{count} rows of {count} numbers",
        )
    matrix = np.array(saved.covariance)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    off = np.abs(matrix - matrix.T) > EXACT * scale[:, None] * scale
    if off.any() or np.any(np.diag(matrix) < 0):
        raise InputError(
            "the covariance is not that of any numbers: not symmetric, or negative on its diagonal",
            where=document.where("covariance"),
            next_step="Calibrate again; this file was changed after it was written",
        )
    return matrix


def _check_poses(document: Document, group: str, items: tuple[Any, ...]) -> None:
    key = "T_base_camera" if group == "stations" else "T_base_platform"
    for k, item in enumerate(items):
        matrix = np.array(getattr(item, key))
        rot = matrix[:3, :3]
        rigid = np.allclose(rot @ rot.T, np.eye(3), atol=1e-6) and np.linalg.det(rot) > 0
        if not rigid or not np.array_equal(matrix[3], [0, 0, 0, 1]):
            raise _edited(document, f"{group}[{k + 1}].{key}", "a rotation and a translation")


def _edited(document: Document, field: str, expected: str) -> InputError:
    return InputError(
        "the calibration does not agree with itself",
        where=f"{document.label}, {field}",
        expected=expected,
        next_step="Calibrate again; this file was changed after it was written",
    )


def _station(saved: _Station) -> SavedStation:
    return SavedStation(
        saved.name,
        saved.camera,
        np.array(saved.T_base_camera),
        np.array(saved.sigma_rotation),
        np.array(saved.sigma_translation),
    )
