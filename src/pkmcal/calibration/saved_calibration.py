"""Reader of saved calibrations: loads and validates calibration.json as written by
:mod:`pkmcal.calibration.results`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.calibration.file_names import CALIBRATION_DOCUMENT_FILE, CALIBRATION_FOLDER
from pkmcal.calibration.results import (
    CALIBRATION_FORMAT,
    EDGE_COLUMNS,
    EDGE_RESIDUALS,
    EDGE_WEIGHT,
    FORMAT_KEY,
    POSE_COLUMNS,
    POSE_WEIGHT,
    of_inverse_poses,
    rows_of_stations,
)
from pkmcal.calibration.summary import CalibrationSummary, Overview
from pkmcal.cameras.response import Response
from pkmcal.errors import InputError
from pkmcal.files import Document, Schema, given_path, read_json, validated_document
from pkmcal.geometry.rigid import inverse, is_rigid
from pkmcal.identify.estimate import Statistics
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms import Machine, MechanismDocument, checked_machine, with_exact_scales
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, Level
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import listed

Sigma3 = tuple[float | None, float | None, float | None]
"""None where the data do not determine the number."""
Row4 = tuple[float, float, float, float]
"""Row of a 4x4 matrix."""
Matrix4 = tuple[Row4, Row4, Row4, Row4]
Factor = Annotated[float, Field(gt=0)]
"""Positive number."""


@dataclass(frozen=True)
class SavedStation:
    """Estimated pose of one camera: T_base_camera (4, 4), m.

    camera : its camera file.
    sigma_rotation, sigma_translation : (3,) standard deviations, rad and m, base axes; infinite
        where the data do not determine the number.
    """

    name: str
    camera: str
    T_base_camera: Array
    sigma_rotation: Array
    sigma_translation: Array

    __repr__ = short_repr


@dataclass(frozen=True)
class CalibrationPrior:
    """Prior from a calibration, of the machine and of the cameras that have not moved since.

    covariance : (P + 6 k, P + 6 k) of the parameters and of these cameras' poses, left
        perturbation.
    stations : (k,) their numbers in a session; all others have to be localized anew.
    T_camera_base : (k, 4, 4).
    """

    covariance: Array
    stations: tuple[int, ...] = ()
    T_camera_base: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def only(self, stations: Sequence[int]) -> CalibrationPrior:
        """Prior with only some of the stations in their former poses."""
        n = len(self.covariance) - 6 * len(self.stations)
        remainder = np.array([k for k, s in enumerate(self.stations) if s in stations], dtype=int)
        rows = rows_of_stations(n, remainder)
        return CalibrationPrior(
            self.covariance[np.ix_(rows, rows)],
            tuple(self.stations[k] for k in remainder),
            self.T_camera_base[remainder],
        )


@dataclass(frozen=True, repr=False)
class SavedCalibration(CalibrationSummary):
    """A calibration read from its file, in the frames that `gauge` names.

    machine : with the calibrated values.
    nominal : (P,) nominal values.
    placed : the k stations whose covariance with the machine is stored; none in older files.
    joint_covariance : (P + 6 k, P + 6 k) of the parameters and then of these stations, (omega, tau)
        of T_camera_base, left perturbation, as in :class:`~pkmcal.identify.estimate.Estimate`.
    data_share : (P,), NaN where undefined.
    configurations : K names.
    used : (K,) whether a configuration was in use.
    joints : (K, m).
    T_base_platform : (K, 4, 4).
    document : the whole file.
    """

    path: Path
    machine: Machine
    nominal: Array
    placed: tuple[str, ...]
    joint_covariance: Array
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
    def covariance(self) -> Array:
        """Covariance (P, P) of the machine's parameters."""
        n = len(self.machine.parameters)
        return self.joint_covariance[:n, :n]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings of the calibration; none of one from before findings had codes."""
        return self.verdict.findings

    def overview(self) -> Overview:
        """Contents of the summary; older files may not have all of them."""
        document = self.document
        residuals = document.get("residuals") or {}
        edges, poses = (residuals.get(key) or () for key in ("edges", "poses"))
        # residuals of inlying edges and poses
        parts = [
            [x for row in edges if row[EDGE_WEIGHT] >= INLIER_WEIGHT for x in row[EDGE_RESIDUALS]],
            [
                x
                for row in poses
                if row[POSE_WEIGHT] >= INLIER_WEIGHT
                for x in row[POSE_WEIGHT + 1 :]
            ],
        ]
        # statistics, if the file has all that have no default
        names = {f.name for f in fields(Statistics)}
        statistics = {k: v for k, v in (document.get("statistics") or {}).items() if k in names}
        needed = {f.name for f in fields(Statistics) if f.default is MISSING}
        whole = needed <= statistics.keys()
        return Overview(
            source=str((document.get("session") or {}).get("folder", "")),
            method=self.method,
            machine=self.machine,
            verdict=self.verdict,
            nominal=self.nominal,
            covariance=self.covariance,
            data_share=self.data_share,
            poses=self.T_base_platform[self.used],
            stations=tuple(station.name for station in self.stations),
            legs_observed=bool(residuals.get("edges")),
            residuals=np.array([*parts[0], *parts[1]], dtype=float),
            chi2=Statistics(**statistics).chi2_as_stated if whole else float("nan"),
            warnings=tuple(document.get("warnings") or ()),
        )

    def prior(self, names: Sequence[str], of_session: Sequence[str]) -> CalibrationPrior:
        """Prior of the machine and of the stations ``names``, numbered as in ``of_session``.

        Raises InputError for a station that is not in ``placed``.
        """
        for name in names:
            if name in self.placed:
                continue
            hand = any(station.name == name for station in self.stations) and self.placed
            raise InputError(
                "the calibration has no covariance of this station and the machine",
                where=str(self.path),
                found=name,
                expected=listed(self.placed, 8) or "a calibration with the stations' covariance",
                next_step="An image by hand is no place that a camera is left in"
                if hand
                else "Calibrate once more with this pkmcal, or name a station of the calibration",
                code="calibration.no_covariance",
            )
        where = np.array([self.placed.index(name) for name in names], dtype=int)
        rows = rows_of_stations(len(self.machine.parameters), where)
        places = {station.name: inverse(station.T_base_camera) for station in self.stations}
        return CalibrationPrior(
            self.joint_covariance[np.ix_(rows, rows)],
            tuple(of_session.index(name) for name in names),
            np.array([places[name] for name in names]).reshape(-1, 4, 4),
        )

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of the machine's parameters, m or rad."""
        return np.sqrt(np.diag(self.covariance))


class _Part(Schema):
    """Schema of the needed fields; a newer pkmcal may write more."""

    model_config = ConfigDict(extra="ignore")


class _Parameter(_Part):
    name: str
    drawing: float
    value: float
    data_share: float | None


class _Station(_Part):
    name: str
    camera: str
    T_base_camera: Matrix4
    sigma_rotation: Sigma3
    sigma_translation: Sigma3
    response: Response | None = None
    binning: Annotated[int, Field(ge=1)] | None = None
    focal_scale: Factor = 1.0


class _StationCovariance(_Part):
    stations: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]


class _Configuration(_Part):
    name: str
    images: tuple[str, ...] = ()
    used: bool
    joints: tuple[float, ...]
    T_base_platform: Matrix4


class _Camera(_Part):
    file: str
    edge_shift: float
    upside_down: bool | None = None


class _Target(_Part):
    name: str
    T_platform_target: Matrix4 | None = None


Numbers = tuple[float | None, ...]
"""A row of residuals."""


def _has_weight(columns: Sequence[str], fewest: int) -> AfterValidator:
    """Validator of a row of residuals: number of columns, and numbers up to the weight.

    fewest : number of columns in older files, which lack the last ones.
    """
    most = columns.index("weight") + 1

    def check(row: Numbers) -> Numbers:
        if not fewest <= len(row) <= len(columns) or None in row[:most]:
            raise ValueError(f"a row of residuals has other columns than {', '.join(columns)}")
        return row

    return AfterValidator(check)


class _Residuals(_Part):
    edges: list[Annotated[Numbers, _has_weight(EDGE_COLUMNS, EDGE_RESIDUALS.stop)]] | None = None
    poses: list[Annotated[Numbers, _has_weight(POSE_COLUMNS, len(POSE_COLUMNS))]] | None = None


class _Statistics(_Part):
    """Statistics of the estimate: numbers, with positive factors."""

    noise_scale: Factor = 1.0
    pose_scale: Factor = 1.0
    reading_scale: Factor = 1.0
    link_scale: Factor = 1.0
    chi2: float = 0.0
    dof: float = 0.0
    chi2_edges: float = 0.0
    n_edges: float = 0.0
    chi2_joints: float = 0.0
    n_joints: float = 0.0
    chi2_drawing: float = 0.0
    n_drawing: float = 0.0
    chi2_poses: float = 0.0
    n_poses: float = 0.0
    chi2_links: float = 0.0
    n_links: float = 0.0
    steps: int = 0
    stopped: str = ""


Ends = tuple[float, float] | None
"""Lower and upper bound, m."""


class _Region(_Part):
    x: Ends = None
    y: Ends = None
    z: Ends = None
    turn: float | None = None


class _Tool(_Part):
    region: _Region | None = None


class _Bed(_Part):
    z: float | None = None


class _Rejected(_Part):
    reason: str
    cases: tuple[tuple[str, str, int, int, int], ...] = ()


class _Readings(_Part):
    noise: Factor | None = None
    columns: tuple[str, ...] = ()


class _Tracker(_Part):
    level: bool = False


class _SessionStation(_Part):
    tracker: _Tracker | None = None


class _Session(_Part):
    folder: str = ""
    digest: str = ""
    joints: _Readings | None = None
    stations: dict[str, _SessionStation] | None = None


class _Finding(_Part):
    code: str
    level: Level
    text: str
    subject: str = ""
    next_step: str = ""
    facts: dict[str, Any] = Field(default_factory=dict)


class _Verdict(_Part):
    usable: bool
    headline: str
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    findings: tuple[_Finding, ...] = ()


class _Saved(_Part):
    pkmcal_calibration: Literal[1] = Field(description="the file's version, 1")
    verdict: _Verdict
    method: str
    seed: int
    gauge: str
    parameters: tuple[_Parameter, ...]
    covariance: tuple[tuple[float, ...], ...]
    stations: tuple[_Station, ...]
    station_covariance: _StationCovariance | None = None
    configurations: tuple[_Configuration, ...]
    mechanism: MechanismDocument
    # optional, because some older files lack them
    cameras: tuple[_Camera, ...] = ()
    targets: tuple[_Target, ...] = ()
    residuals: _Residuals | None = None
    statistics: _Statistics | None = None
    session: _Session | None = None
    tool: _Tool | None = None
    bed: _Bed | None = None
    rejected: tuple[_Rejected, ...] | None = None
    warnings: tuple[str, ...] | None = None


def load(source: Path | str) -> SavedCalibration:
    """Read a calibration from its folder or its calibration.json, and validate it.

    Raises InputError if there is none, or if it is inconsistent.
    """
    document = _read(given_path(source, "a calibration's folder"))
    saved = validated_document(document, _Saved)
    # consistency of machine, poses, readings and covariance
    mechanism = saved.mechanism
    if not any(p.name.endswith(".scale") for p in saved.parameters):
        mechanism = with_exact_scales(mechanism)  # written before scales were parameters
    machine = checked_machine(mechanism, document, "mechanism", held=False)
    _check_parameters(document, saved, machine)
    for group, key in (
        ("stations", "T_base_camera"),
        ("configurations", "T_base_platform"),
        ("targets", "T_platform_target"),
    ):
        _check_poses(document, group, key, getattr(saved, group))
    for k, one in enumerate(saved.configurations):
        if len(one.joints) != machine.n_joints:
            wanted = f"the {machine.n_joints} readings of its machine, not {len(one.joints)}"
            raise _edited(document, f"configurations[{k + 1}].joints", wanted)
    # covariance with the stations, and the result
    placed, joint = _covariance(document, saved)
    return SavedCalibration(
        path=document.path,
        machine=machine,
        nominal=np.array([p.drawing for p in saved.parameters]),
        placed=placed,
        joint_covariance=joint,
        data_share=np.array([p.data_share for p in saved.parameters], dtype=float),
        gauge=saved.gauge,
        method=saved.method,
        seed=saved.seed,
        verdict=_verdict(saved.verdict),
        stations=tuple(
            SavedStation(
                station.name,
                station.camera,
                np.array(station.T_base_camera),
                _deviations(station.sigma_rotation),
                _deviations(station.sigma_translation),
            )
            for station in saved.stations
        ),
        configurations=tuple(c.name for c in saved.configurations),
        used=np.array([c.used for c in saved.configurations], dtype=bool),
        joints=np.array([c.joints for c in saved.configurations]).reshape(-1, machine.n_joints),
        T_base_platform=np.array([c.T_base_platform for c in saved.configurations]),
        document=document.data,
    )


def _deviations(values: Sigma3) -> Array:
    """Standard deviations (3,), infinite where the file has none."""
    return np.array([np.inf if value is None else value for value in values])


def _verdict(saved: _Verdict) -> Verdict:
    """Verdict with its saved sentences; findings from before there were codes have none."""
    coded = {(one.level, one.text): one for one in saved.findings}
    findings: list[Finding] = []
    for level, texts in (
        (Level.WRONG, saved.reasons),
        (Level.DOUBTFUL, saved.warnings),
        (Level.NOTE, saved.advice),
    ):
        for text in texts:
            one = coded.get((level, text)) or _Finding(code="", level=level, text=text)
            findings.append(
                Finding(
                    one.code,
                    level,
                    one.facts,
                    one.subject,
                    saved_text=text,
                    saved_next_step=one.next_step,
                )
            )
    return Verdict(saved.usable, saved.headline, tuple(findings))


def _read(source: Path) -> Document:
    """Document of a calibration; raises InputError if there is none or its version is unknown."""
    path = source / CALIBRATION_DOCUMENT_FILE if source.is_dir() else source
    if not path.is_file():
        inside = source / CALIBRATION_FOLDER  # of a session
        raise InputError(
            "there is no calibration here",
            where=str(source),
            expected=f"a folder that pkmcal calibrate wrote, or its {CALIBRATION_DOCUMENT_FILE}",
            next_step=f"Name {inside}, the calibration of this session"
            if (inside / CALIBRATION_DOCUMENT_FILE).is_file()
            else None,
            code="calibration.missing",
        )
    document = read_json(path, label=str(path))
    value = document.data.get(FORMAT_KEY)
    if value != CALIBRATION_FORMAT:
        raise InputError(
            "this version of calibration files is not supported" if value else
            "this is not a calibration",
            where=f"{path}, {FORMAT_KEY}",
            found=value,
            expected=str(CALIBRATION_FORMAT),
        )  # fmt: skip
    return document


def _check_parameters(document: Document, saved: _Saved, machine: Machine) -> None:
    """Raise `InputError` unless parameters and mechanism agree in names and values."""
    names = tuple(p.name for p in saved.parameters)
    if names != machine.parameters.names:
        raise _edited(document, "parameters", "the names of the mechanism's parameters")
    values = np.array([p.value for p in saved.parameters])
    if not np.allclose(values, machine.values, rtol=ROUNDING, atol=ROUNDING**2):
        k = int(np.argmax(np.abs(values - machine.values)))
        raise _edited(document, f"parameters[{k + 1}].value", f"the value of {names[k]}")


def _covariance(document: Document, saved: _Saved) -> tuple[tuple[str, ...], Array]:
    """Names of the stations with a stored covariance, and the joint covariance.

        [ covariance            rows^T   ]  parameters
        [ rows of the stations           ]  six numbers for each station

    Poses in the file are T_base_camera; the result is that of the inverse poses.
    """
    count, of_stations = len(saved.parameters), saved.station_covariance
    _check_size(document, "covariance", saved.covariance, (count, count), "list of parameters")
    if of_stations is None:
        matrix = np.array(saved.covariance)
        _check_covariance(document, "covariance", matrix)
        return (), matrix
    poses = {station.name: np.array(station.T_base_camera) for station in saved.stations}
    if not set(of_stations.stations) <= set(poses):
        raise _edited(document, "station_covariance.stations", "names of the stations")
    more = 6 * len(of_stations.stations)
    key = "station_covariance"
    _check_size(
        document,
        key,
        of_stations.rows,
        (more, count + more),
        "lists of parameters and stations",
    )
    rows = np.array(of_stations.rows).reshape(more, count + more)
    upper = np.concatenate([np.array(saved.covariance), rows[:, :count].T], axis=1)
    matrix = np.concatenate([upper, rows])
    _check_covariance(document, "covariance", matrix[:count, :count])
    _check_covariance(document, key, matrix)
    values = np.array([poses[name] for name in of_stations.stations]).reshape(-1, 4, 4)
    return of_stations.stations, of_inverse_poses(matrix, values)


def _check_size(
    document: Document,
    key: str,
    rows: tuple[tuple[float, ...], ...],
    shape: tuple[int, int],
    of: str,
) -> None:
    """Raise `InputError` for a matrix of another shape."""
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise InputError(
            f"the covariance has another size than the {of}",
            where=document.where(key),
            expected=f"{shape[0]} rows of {shape[1]} numbers",
        )


def _check_covariance(document: Document, key: str, matrix: Array) -> None:
    """Raise `InputError` for a matrix that is not symmetric or not positive semidefinite."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    limit = scale[:, None] * scale
    good = not np.any(np.abs(matrix - matrix.T) > ROUNDING * limit) and np.all(np.diag(matrix) >= 0)
    if good:
        unit = np.where(limit > 0, matrix / np.where(limit > 0, limit, 1.0), 0.0)
        least = float(np.linalg.eigvalsh(0.5 * (unit + unit.T)).min(initial=0.0))
        good = least > -ROUNDING * len(matrix)
    if not good:
        raise InputError(
            "the covariance is not symmetric and positive semidefinite",
            where=document.where(key),
            next_step="Calibrate again; this file was changed after it was written",
        )


def _check_poses(document: Document, group: str, key: str, items: tuple[Any, ...]) -> None:
    """Raise `InputError` for a matrix that is not a rigid motion."""
    for k, item in enumerate(items):
        if (rows := getattr(item, key)) is None:
            continue
        if not is_rigid(np.array(rows)):
            raise _edited(document, f"{group}[{k + 1}].{key}", "a rotation and a translation")


def _edited(document: Document, field: str, expected: str) -> InputError:
    """Error for a file that contradicts itself."""
    return InputError(
        "the calibration file is inconsistent",
        where=f"{document.label}, {field}",
        expected=expected,
        next_step="Calibrate again; this file was changed after it was written",
    )
