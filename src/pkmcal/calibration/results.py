"""What a calibration leaves on disk: mechanism.yaml and calibration.json, written and read back.

calibration.json holds everything that a calibration found, in SI units, in the frames that
``gauge`` names; without dates, so that the same session gives the same file but for its timings.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.calibration.shown import Overview, ShownCalibration
from pkmcal.errors import InputError
from pkmcal.files import (
    Document,
    Schema,
    check_writable,
    entries,
    json_text,
    plain,
    read_json,
    validate,
)
from pkmcal.geometry.rigid import inverse, skew
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.estimate import Estimate, Statistics
from pkmcal.identify.tool import ToolError, checked_poses, tool_error
from pkmcal.measurements import BREATHING_SIGMA
from pkmcal.mechanisms import (
    Machine,
    MechanismDocument,
    checked_machine,
    mechanism_text,
    with_exact_scales,
)
from pkmcal.outcome import Verdict
from pkmcal.session.load import digests, session_digest
from pkmcal.wording import listed

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.calibration.toolmap import ToolMap
    from pkmcal.identify.unidentified import Findings

MECHANISM, EVERYTHING, REPORT = "mechanism.yaml", "calibration.json", "report.html"
FILES = (REPORT, MECHANISM, EVERYTHING)
CAMERA_FILE = re.compile(r"camera-.+\.yaml")
"""Cameras as refined with the machine, where that was asked for."""
EXACT = 1e-9
"""Relative difference below which two numbers of a file are the same: rounding leaves 1e-15, a
change by hand a millionth."""
FORMAT_KEY, FORMAT = "pkmcal_calibration", 1
PACKAGES = ("numpy", "scipy", "opencv-contrib-python-headless")
CONVENTIONS = (
    "SI: m and rad. T_a_b maps coordinates of frame b to frame a. length = scale * reading +"
    " offset. Legs, tubes and sides count from 1. sigma is a standard deviation: of sampling, not"
    " of what the model leaves out. Rotations of a pose are perturbed from the left, about the axes"
    " of its outer frame."
)
EDGE_COLUMNS = ("station", "configuration", "leg", "tube", "side", "weight", "shift", "tilt")
"""Of a row in residuals.edges, names as numbers from 1; shift and tilt in standard deviations."""
POSE_COLUMNS = (
    "station", "configuration", "target", "weight", "turn1", "turn2", "turn3", "x", "y", "z",
)  # fmt: skip
"""Of a row in residuals.poses, the last six whitened together, in standard deviations."""
EDGE_WEIGHT, POSE_WEIGHT = EDGE_COLUMNS.index("weight"), POSE_COLUMNS.index("weight")
OPEN = 1.0
"""m or rad; a target's place that is known no better is not told by the data."""

Row3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]
Factor = Annotated[float, Field(gt=0)]


def check_output(folder: Path | str, *, force: bool = False) -> list[str]:
    """Raise `InputError` where a result cannot go into `folder`; call it before the work.

    Only a new or empty folder, or an earlier result, is written to: a session's own
    mechanism.yaml must not be lost to its calibrated one. Returns the files of that result, which
    is kept beside its place (:mod:`pkmcal.calibration.kept`) unless ``force`` replaces it.
    """
    folder = Path(folder)
    check_writable(folder)
    standing = entries(folder)
    foreign = [name for name in standing if name not in FILES and not CAMERA_FILE.fullmatch(name)]
    # A mechanism.yaml without the rest is somebody's drawing.
    if foreign or (standing and EVERYTHING not in standing):
        raise InputError(
            "the output folder holds something other than a calibration",
            where=str(folder),
            found=listed(foreign or standing, 4),
            expected="a new or empty folder, or one of an earlier calibration",
            next_step="Name another folder with -o, or move these files away",
        )
    if standing and not force:
        try:
            check_writable(folder.resolve().parent)
        except InputError:
            raise InputError(
                "the calibration that is there cannot be kept, for nothing can be written beside"
                " its folder",
                where=str(folder),
                next_step="Name another folder with -o, or replace it with --force",
            ) from None
    return standing


def texts_of(
    calibration: Calibration,
    not_identified: Sequence[str] = (),
    holdout: dict[str, Any] | None = None,
    over: ToolMap | str | None = None,
    photographs: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, str]:
    """What a calibration leaves on disk besides its page: texts by their files' names.

    not_identified, holdout, over, photographs : as for :func:`document_of`.
    """
    from pkmcal.cameras.files import camera_text

    texts = {
        MECHANISM: calibrated_mechanism_text(calibration),
        EVERYTHING: json_text(document_of(calibration, not_identified, holdout, over, photographs)),
    }
    cameras = calibration.cameras
    for file in cameras.files if cameras.refined else ():
        camera = cameras.result(calibration.estimate, file)
        texts[refined_camera(file)] = camera_text(camera)
    return texts


def refined_camera(file: str) -> str:
    """The name of a camera's file as refined with the machine, by the one that the session names:
    camera-front.yaml of cameras/front.yaml; other folders, and a # in it, become hyphens.
    """
    parts = re.split(r"[/\\#]", re.sub(r"\.(ya?ml|xml|json)(?=#|$)", "", file))
    return f"camera-{'-'.join(p for p in parts if p not in ('', '.', '..', 'cameras'))}.yaml"


def calibrated_mechanism_text(calibration: Calibration) -> str:
    """The calibrated machine as a mechanism file, with what it is on top."""
    verdict = calibration.verdict
    name = calibration.session.folder.resolve().name
    lines = [
        f"Calibrated by pkmcal {version('pkmcal')} from the session {name}"
        f" (method {calibration.method}, seed {calibration.seed}).",
        verdict.headline if verdict.usable else "NOT TO BE USED: " + " ".join(verdict.reasons),
        f"Frames: {calibration.estimate.gauge}. Lengths in metres.",
        f"Standard deviations, covariance and all else: {EVERYTHING}; for people: {REPORT}.",
    ]
    # A session's name may hold a line break; what follows it must stay a comment.
    comment = "".join(f"# {' '.join(line.split())}\n" for line in lines)
    return comment + mechanism_text(calibration.machine)


def document_of(
    calibration: Calibration,
    not_identified: Sequence[str] = (),
    holdout: dict[str, Any] | None = None,
    over: ToolMap | str | None = None,
    photographs: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """The content of calibration.json, plain data without NaN and dates.

    not_identified : sentences about what the data could not decide, as the report tells them.
    holdout : residuals on configurations that were held out, beside those in use. over : the tool
    over the workspace, or why there is no map of it. photographs : their digests, read unless
    given.
    """
    session, estimate = calibration.session, calibration.estimate
    bed = calibration.findings and calibration.findings.bed
    seen = digests(session) if photographs is None else photographs
    document = {
        FORMAT_KEY: FORMAT,
        "conventions": CONVENTIONS,
        "verdict": asdict(calibration.verdict),
        "method": calibration.method,
        "model": calibration.session.model,
        "seed": calibration.seed,
        "gauge": estimate.gauge,
        "parameters": _parameters(calibration),
        "covariance": estimate.covariance,
        "not_identified": not_identified,
        "identifiability": identifiability_of(calibration.findings),
        "stations": _stations(calibration),
        "station_covariance": _station_covariance(calibration),
        "targets": _targets(calibration),
        "cameras": _cameras(calibration),
        "configurations": _configurations(calibration, seen),
        "statistics": asdict(estimate.statistics),
        "edge_noise": _edge_noise(estimate),
        "tool": {"why_not": over} if isinstance(over, str) else over and over.document(),
        "bed": bed and asdict(bed),
        "holdout": holdout,
        "residuals": _residuals(calibration),
        "rejected": _rejected(calibration),
        "mechanism": estimate.machine.to_document(),
        "session": {
            "folder": session.folder.resolve().name,
            "digest": session_digest(session, seen),
            **session.document,
        },
        "departures": [one.document() for one in calibration.departures],
        "warnings": session.warnings,
        "versions": versions(),
        "timings": {name: round(value, 3) for name, value in calibration.timings.items()},
    }
    return plain(document)


def _edge_noise(estimate: Estimate) -> list[dict[str, Any]]:
    """One entry for each tube of a leg, from 1: what its edges scatter by."""
    if not estimate.edge_weights.size:
        return []
    found = estimate.edge_noise
    rows = zip(found.scale, found.shading, found.tails, strict=True)
    return [
        {"tube": k, "scale": scale, "shading": shading, "tails": tails}
        for k, (scale, shading, tails) in enumerate(rows, start=1)
    ]


def versions() -> dict[str, str]:
    """Versions of pkmcal, Python and the packages that numbers depend on."""
    found = {"pkmcal": version("pkmcal"), "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _parameters(calibration: Calibration) -> list[dict[str, Any]]:
    """One entry a parameter."""
    return [asdict(row) for row in calibration.parameters]


def identifiability_of(findings: Findings | None) -> dict[str, Any] | None:
    """The rank, what is open in words, and the paper's conditions; null where not looked at.

    moves_platform : m, root mean square over the platform's joints and poses.
    """
    if findings is None:
        return None
    told = findings.told
    return {
        "rank": told.rank,
        "n_parameters": told.n_parameters,
        "n_frames": told.n_frames,
        "singular_values": told.singular_values,
        "moves_platform_by_drawing": findings.by_drawing,
        "unidentified": [asdict(sentence) for sentence in findings.unidentified],
        "weak": [asdict(sentence) for sentence in findings.weak],
        "conditions": [asdict(condition) for condition in findings.conditions],
    }


def _stations(calibration: Calibration) -> list[dict[str, Any]]:
    estimate = calibration.estimate
    out: list[dict[str, Any]] = []
    session = calibration.session
    sources = [(x.name, x.camera_file, len(x.photographs)) for x in session.stations]
    sources += [(table.name, table.label, len(table.configuration)) for table in session.trackers]
    for s, (name, file, number) in enumerate(sources):
        T_camera_base = estimate.state.T_camera_base[s]
        covariance = base_camera_covariance(T_camera_base, estimate.station_covariance[s])
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        out.append(
            {
                "name": name,
                "camera": file,
                "T_base_camera": inverse(T_camera_base),
                "sigma_rotation": sigma[:3],
                "sigma_translation": sigma[3:],
                "photographs": number,
                **_focal_scale(calibration, s),
            }
        )
    return out


def _station_covariance(calibration: Calibration) -> dict[str, Any]:
    """Stations that a camera may be left in, by name, and their rows (6 k, P + 6 k) of the joint
    covariance of all parameters and these stations, (omega, tau) of T_base_camera. What felt
    heights stands nowhere along the bed.
    """
    session, estimate = calibration.session, calibration.estimate
    nowhere = {station.name for station in session.stations if station.handheld}
    nowhere |= {table.name for table in session.trackers if table.kind == "heights"}
    names = session.station_names
    kept = np.array([k for k, name in enumerate(names) if name not in nowhere], dtype=int)
    n = len(estimate.machine.parameters)
    rows = _joint_rows(n, kept)
    joint = _turned(
        estimate.joint_covariance[np.ix_(rows, rows)], estimate.state.T_camera_base[kept]
    )
    return {"stations": [names[k] for k in kept], "rows": joint[n:]}


def _joint_rows(n: int, stations: Integers) -> Integers:
    """Rows of n parameters and then of some stations in a joint covariance."""
    return np.concatenate([np.arange(n), (n + 6 * stations[:, None] + np.arange(6)).ravel()])


def _turned(joint: Array, T_a_b: Array) -> Array:
    """A joint covariance of parameters and poses (k, 4, 4), (omega, tau) of T_a_b, as that of the
    parameters and (omega, tau) of T_b_a.
    """
    n = len(joint) - 6 * len(T_a_b)
    by = np.eye(len(joint))
    for k, transform in enumerate(T_a_b):
        at = slice(n + 6 * k, n + 6 * k + 6)
        by[at, at] = _inverse_errors(transform)
    return by @ joint @ by.T


def _focal_scale(calibration: Calibration, number: int) -> dict[str, Any]:
    """By how much a hand-held photograph's focal lengths are its camera's, and how well known."""
    cameras, estimate = calibration.cameras, calibration.estimate
    if number >= len(cameras.breathes) or not cameras.breathes[number]:
        return {}
    return {
        "focal_scale": 1 + BREATHING_SIGMA * cameras.moved(estimate).breath[number],
        "sigma_focal_scale": BREATHING_SIGMA * estimate.breathing_sigma[number],
    }


def _targets(calibration: Calibration) -> list[dict[str, Any]]:
    """Boards, and what trackers measured, on their body; sigma null where nothing tells it."""
    estimate, mounts = calibration.estimate, calibration.measurements.mounts
    sizes = iter(zip(estimate.state.sizes, estimate.size_sigma, strict=True))
    out: list[dict[str, Any]] = []
    for m, mount in enumerate(mounts):
        size: dict[str, float] = {}
        if mount.tolerance > 0 and len(estimate.state.sizes):  # the papers' methods estimate none
            value, deviation = next(sizes)
            size = {"size": 1 + mount.tolerance * value, "sigma_size": mount.tolerance * deviation}
        body = "platform" if estimate.state.on_platform[m] else "base"
        sigma = np.sqrt(np.maximum(np.diag(estimate.mount_covariance[m]), 0.0))
        known = [float(x) if x < OPEN else None for x in sigma]
        out.append(
            {
                "name": mount.name,
                **size,
                "fixed_to": body,
                f"T_{body}_target": estimate.state.T_mount[m],
                "sigma_rotation": known[:3],
                "sigma_translation": known[3:],
            }
        )
    return out


def base_camera_covariance(T_camera_base: Array, covariance: Array) -> Array:
    """Covariance (6, 6) of (omega, tau) of T_base_camera from that of T_camera_base, m and rad."""
    return _turned(covariance, T_camera_base[None])


def _inverse_errors(transform: Array) -> Array:
    """Errors (omega, tau) of an inverse pose by those of the pose (4, 4), (6, 6).

    With its R and t: omega' = -R^T omega, tau' = -R^T ([t]x omega + tau).
    """
    rot_t, t = transform[:3, :3].T, transform[:3, 3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -rot_t
    jacobian[3:, :3] = -rot_t @ skew(t)
    return jacobian


def _cameras(calibration: Calibration) -> list[dict[str, Any]]:
    """Each camera file once, with its edge shift, px outward."""
    estimate, numbers = calibration.estimate, calibration.measurements.camera_of_station.tolist()
    stations = calibration.session.stations
    # trackers, whose number means nothing, come last
    files = {c: station.camera_file for c, station in zip(numbers, stations, strict=False)}
    return [
        {
            "file": files[c],
            "edge_shift": estimate.state.edge_shift[c],
            "sigma": estimate.edge_shift_sigma[c],
            **_refined(calibration, files[c]),
        }
        for c in sorted(files)
    ]


def _refined(calibration: Calibration, file: str) -> dict[str, Any]:
    """The intrinsics where they were refined with the machine, with their deviations."""
    if not calibration.cameras.refined:
        return {}
    camera = calibration.cameras.result(calibration.estimate, file)
    n = len(camera.parameters)
    covariance = np.zeros((n, n)) if camera.covariance is None else camera.covariance
    return {
        "parameters": list(camera.parameter_names),
        "values": camera.parameters,
        "deviations": np.sqrt(np.diag(covariance)),
    }


def _configurations(
    calibration: Calibration, seen: Mapping[str, Sequence[str]]
) -> list[dict[str, Any]]:
    """Poses of all configurations; those not used have theirs from the readings alone. seen : the
    photographs' digests.
    """
    session, estimate = calibration.session, calibration.estimate
    return [
        {
            "name": name,
            "photographs": seen.get(name, []),
            "used": bool(estimate.configurations[k]),
            "joints": session.joints[k],
            "joint_residuals": np.round(estimate.joint_residuals[k], 4),
            "T_base_platform": estimate.state.T_base_platform[k],
        }
        for k, name in enumerate(session.configurations)
    ]


def _residuals(calibration: Calibration) -> dict[str, Any]:
    """One row an edge, and one a pose, whitened; what they are of, by numbers from 1."""
    estimate = calibration.estimate

    def rows(places: Sequence[Integers], *reals: Array) -> list[list[float]]:
        numbers = (np.column_stack(places) + 1).tolist()
        values = np.round(np.column_stack(reals), 3).tolist()
        return [[*place, *more] for place, more in zip(numbers, values, strict=True)]

    edges, poses = calibration.observation.edges, calibration.measurements.poses
    return {
        "columns": EDGE_COLUMNS,
        "edges": rows(
            (edges.station, edges.configuration, edges.leg, edges.tube, edges.side),
            estimate.edge_weights,
            estimate.edge_residuals,
        ),
        "pose_columns": POSE_COLUMNS,
        "poses": rows(
            (poses.station, poses.configuration, poses.mount),
            estimate.pose_weights,
            estimate.pose_residuals,
        ),
    }


def _rejected(calibration: Calibration) -> list[dict[str, Any]]:
    """What was left out, by reason; leg, tube and side from 1, 0 where all of them are meant."""
    session = calibration.session
    groups: dict[str, list[list[Any]]] = {}
    for item in calibration.observation.rejected:
        groups.setdefault(item.reason, []).append(
            [
                session.station_names[item.station],
                session.configurations[item.configuration],
                item.leg + 1,
                item.tube + 1,
                item.side + 1,
            ]
        )
    return [
        {"reason": reason, "count": len(cases), "cases": cases}
        for reason, cases in sorted(groups.items(), key=lambda group: -len(group[1]))
    ]


# ------------------------------------------------------------------ read back


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

    __repr__ = short_repr


@dataclass(frozen=True, repr=False)
class SavedCalibration(ShownCalibration):
    """A calibration read back, in the frames that `gauge` names.

    machine : with the calibrated values. drawing : (P,) values before.
    placed : k stations whose covariance with the machine is known; none of an older file.
    joint_covariance : (P + 6 k, P + 6 k) of the parameters and then of these stations, (omega, tau)
    of T_camera_base, left perturbation, as :class:`~pkmcal.identify.estimate.Estimate` has it.
    data_share : (P,), NaN where it means nothing.
    configurations : K names. used : (K,). joints : (K, m). T_base_platform : (K, 4, 4).
    document : the whole file.
    """

    path: Path
    machine: Machine
    drawing: Array
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
        """(P, P) of the machine's parameters."""
        n = len(self.machine.parameters)
        return self.joint_covariance[:n, :n]

    def overview(self) -> Overview:
        """What it shows of itself; an older file may not have all of it."""
        document = self.document
        residuals = document.get("residuals") or {}
        parts = [
            [x for row in residuals.get(key) or () if row[weight] >= 0.5 for x in row[weight + 1 :]]
            for key, weight in (("edges", EDGE_WEIGHT), ("poses", POSE_WEIGHT))
        ]
        known = {f.name for f in fields(Statistics)}
        statistics = {k: v for k, v in (document.get("statistics") or {}).items() if k in known}
        needed = {f.name for f in fields(Statistics) if f.default is MISSING}
        whole = needed <= statistics.keys()
        return Overview(
            source=str((document.get("session") or {}).get("folder", "")),
            method=self.method,
            machine=self.machine,
            verdict=self.verdict,
            drawing=self.drawing,
            covariance=self.covariance,
            data_share=self.data_share,
            poses=self.T_base_platform[self.used],
            stations=tuple(station.name for station in self.stations),
            residuals=np.array([*parts[0], *parts[1]], dtype=float),
            chi2=Statistics(**statistics).chi2_as_stated if whole else float("nan"),
            warnings=tuple(document.get("warnings") or ()),
        )

    def tool_error(self, T_base_platform: Array) -> ToolError:
        """As :meth:`pkmcal.calibration.calibrate.Calibration.tool_error`, from the file."""
        edges = (self.document.get("residuals") or {}).get("edges")
        # what the file's machine calls its drawing are the calibrated values
        table = replace(self.machine.parameters, drawing=self.drawing)
        machine = replace(self.machine, parameters=table)
        return tool_error(
            machine.with_values(self.drawing),
            machine,
            free_of_gauge(machine, self.covariance),
            checked_poses(T_base_platform),
            legs_seen=bool(edges),
        )

    def with_stations(self, names: Sequence[str]) -> Array:
        """Joint covariance (P + 6 n, P + 6 n) of the parameters and of n stations in their order,
        (omega, tau) of T_camera_base. Raises InputError for one that is not ``placed``.
        """
        for name in names:
            if name in self.placed:
                continue
            hand = any(station.name == name for station in self.stations) and self.placed
            raise InputError(
                "where this station stood is not known together with the machine",
                where=str(self.path),
                found=name,
                expected=listed(self.placed, 8) or "a calibration that tells it",
                next_step="A photograph by hand is no place that a camera is left in"
                if hand
                else "Calibrate once more with this pkmcal, or name a station of the calibration",
            )
        where = np.array([self.placed.index(name) for name in names], dtype=int)
        rows = _joint_rows(len(self.machine.parameters), where)
        return self.joint_covariance[np.ix_(rows, rows)]

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of the machine's parameters, m or rad."""
        return np.sqrt(np.diag(self.covariance))


class _Part(Schema):
    """Fields that are needed here; a newer pkmcal may write more."""

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
    sigma_rotation: Row3
    sigma_translation: Row3


class _StationCovariance(_Part):
    stations: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]


class _Configuration(_Part):
    name: str
    photographs: tuple[str, ...] = ()
    used: bool
    joints: tuple[float, ...]
    T_base_platform: Matrix4


class _Camera(_Part):
    file: str
    edge_shift: float


class _Target(_Part):
    name: str
    T_platform_target: Matrix4 | None = None


class _Residuals(_Part):
    edges: list[Any] | None = None


class _Statistics(_Part):
    noise_scale: Factor = 1.0
    pose_scale: Factor = 1.0
    reading_scale: Factor = 1.0


class _Readings(_Part):
    noise: Factor | None = None
    columns: tuple[str, ...] = ()


class _Session(_Part):
    folder: str = ""
    joints: _Readings | None = None


class _Saved(_Part):
    pkmcal_calibration: Literal[1] = Field(description="the file's version, 1")
    verdict: Verdict
    method: str
    seed: int
    gauge: str
    parameters: tuple[_Parameter, ...]
    covariance: tuple[tuple[float, ...], ...]
    stations: tuple[_Station, ...]
    station_covariance: _StationCovariance | None = None
    configurations: tuple[_Configuration, ...]
    mechanism: MechanismDocument
    # read where they are wanted, and absent from some older files
    cameras: tuple[_Camera, ...] = ()
    targets: tuple[_Target, ...] = ()
    residuals: _Residuals | None = None
    statistics: _Statistics | None = None
    session: _Session | None = None


def load(source: Path | str) -> SavedCalibration:
    """Read a calibration from its folder or its calibration.json, and check that it is whole."""
    document = _read(Path(source))
    saved = validate(document, _Saved)
    machine = checked_machine(_mechanism(saved), document, "mechanism")
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
    placed, joint = _covariance(document, saved)
    return SavedCalibration(
        path=document.path,
        machine=machine,
        drawing=np.array([p.drawing for p in saved.parameters]),
        placed=placed,
        joint_covariance=joint,
        data_share=np.array([p.data_share for p in saved.parameters], dtype=float),
        gauge=saved.gauge,
        method=saved.method,
        seed=saved.seed,
        verdict=saved.verdict,
        stations=tuple(
            SavedStation(
                station.name,
                station.camera,
                np.array(station.T_base_camera),
                np.array(station.sigma_rotation),
                np.array(station.sigma_translation),
            )
            for station in saved.stations
        ),
        configurations=tuple(c.name for c in saved.configurations),
        used=np.array([c.used for c in saved.configurations], dtype=bool),
        joints=np.array([c.joints for c in saved.configurations]).reshape(-1, machine.n_joints),
        T_base_platform=np.array([c.T_base_platform for c in saved.configurations]),
        document=document.data,
    )


def _mechanism(saved: _Saved) -> MechanismDocument:
    """The mechanism; of a file from before readings had scales, one whose scales are exact."""
    mechanism = saved.mechanism
    if any(p.name.endswith(".scale") for p in saved.parameters):
        return mechanism
    return with_exact_scales(mechanism)


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


def _covariance(document: Document, saved: _Saved) -> tuple[tuple[str, ...], Array]:
    """Names of the stations that are known with the machine, and the covariance of both."""
    count, known = len(saved.parameters), saved.station_covariance
    _check_size(document, "covariance", saved.covariance, (count, count), "list of parameters")
    if known is None:
        matrix = np.array(saved.covariance)
        _check_covariance(document, "covariance", matrix)
        return (), matrix
    poses = {station.name: np.array(station.T_base_camera) for station in saved.stations}
    if not set(known.stations) <= set(poses):
        raise _edited(document, "station_covariance.stations", "names of the stations")
    more = 6 * len(known.stations)
    key = "station_covariance"
    _check_size(document, key, known.rows, (more, count + more), "lists of parameters and stations")
    rows = np.array(known.rows).reshape(more, count + more)
    upper = np.concatenate([np.array(saved.covariance), rows[:, :count].T], axis=1)
    matrix = np.concatenate([upper, rows])
    _check_covariance(document, "covariance", matrix[:count, :count])
    _check_covariance(document, key, matrix)
    found = np.array([poses[name] for name in known.stations]).reshape(-1, 4, 4)
    return known.stations, _turned(matrix, found)


def _check_size(
    document: Document,
    key: str,
    rows: tuple[tuple[float, ...], ...],
    shape: tuple[int, int],
    of: str,
) -> None:
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
    good = not np.any(np.abs(matrix - matrix.T) > EXACT * limit) and np.all(np.diag(matrix) >= 0)
    if good:
        unit = np.where(limit > 0, matrix / np.where(limit > 0, limit, 1.0), 0.0)
        least = float(np.linalg.eigvalsh(0.5 * (unit + unit.T)).min(initial=0.0))
        good = least > -EXACT * len(matrix)
    if not good:
        raise InputError(
            "the covariance is not that of any numbers: not symmetric, or a combination of them has"
            " a negative variance",
            where=document.where(key),
            next_step="Calibrate again; this file was changed after it was written",
        )


def _check_poses(document: Document, group: str, key: str, items: tuple[Any, ...]) -> None:
    for k, item in enumerate(items):
        if (rows := getattr(item, key)) is None:
            continue
        matrix = np.array(rows)
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
