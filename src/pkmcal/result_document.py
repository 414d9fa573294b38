"""The content of calibration.json: everything that a calibration found, as plain data.

SI units, in the frames that ``gauge`` names; without dates, so that the same session gives the
same file but for its timings.
"""

from __future__ import annotations

import platform
from dataclasses import asdict
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal import __version__
from pkmcal.arrays import Array
from pkmcal.files import plain
from pkmcal.geometry.rigid import inverse, skew
from pkmcal.validate.figures import holdout_document
from pkmcal.validate.independence import digests

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.identify.unidentified import Findings
    from pkmcal.report.parameters import Group

FORMAT = 1
PACKAGES = ("numpy", "scipy", "opencv-contrib-python-headless")
CONVENTIONS = (
    "SI: m and rad. T_a_b maps coordinates of frame b to frame a. length = reading + offset. Legs,"
    " tubes and sides count from 1. sigma is a standard deviation: of sampling, not of what the"
    " model leaves out. Rotations of a pose are perturbed from the left, about the axes of its"
    " outer frame."
)
EDGE_COLUMNS = ("station", "configuration", "leg", "tube", "side", "weight", "shift", "tilt")
"""Of a row in residuals.edges, names as numbers from 1; shift and tilt in standard deviations."""
POSE_COLUMNS = (
    "station", "configuration", "target", "weight", "turn1", "turn2", "turn3", "x", "y", "z",
)  # fmt: skip
"""Of a row in residuals.poses, the last six whitened together, in standard deviations."""
OPEN = 1.0
"""m or rad; a target's place that is known no better is not told by the data."""


def document_of(calibration: Calibration) -> dict[str, Any]:
    """The content of calibration.json, plain data without NaN."""
    session, estimate = calibration.session, calibration.estimate
    document = {
        "pkmcal_calibration": FORMAT,
        "conventions": CONVENTIONS,
        "verdict": asdict(calibration.verdict),
        "method": calibration.method,
        "model": calibration.session.model,
        "seed": calibration.seed,
        "gauge": estimate.gauge,
        "parameters": _parameters(calibration),
        "covariance": estimate.covariance,
        "not_identified": _not_identified(calibration),
        "identifiability": identifiability_of(calibration.findings),
        "stations": _stations(calibration),
        "targets": _targets(calibration),
        "cameras": _cameras(calibration),
        "configurations": _configurations(calibration),
        "statistics": asdict(estimate.statistics),
        "holdout": _holdout(calibration),
        "residuals": _residuals(calibration),
        "rejected": _rejected(calibration),
        "mechanism": estimate.machine.to_document(),
        "session": {"folder": session.folder.resolve().name, **session.document},
        "warnings": session.warnings,
        "versions": versions(),
        "timings": {name: round(value, 3) for name, value in calibration.timings.items()},
    }
    return plain(document)


def versions() -> dict[str, str]:
    """Versions of pkmcal, Python and the packages that numbers depend on."""
    found = {"pkmcal": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _holdout(calibration: Calibration) -> dict[str, Any] | None:
    """Residuals on configurations that were held out, beside those in use."""
    if calibration.holdout is None:
        return None
    return holdout_document(calibration.holdout, calibration.session.configurations)


def _parameters(calibration: Calibration) -> list[dict[str, Any]]:
    """One entry a parameter; decided_by : data, drawing, frame (of the result) or fixed."""
    estimate = calibration.estimate
    source = {row.name: row.source for group in _groups(calibration) for row in group.rows}
    table = estimate.machine.parameters
    sigma = np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0))
    return [
        {
            "name": name,
            "unit": table.units[k],
            "drawing": calibration.session.machine.values[k],
            "value": estimate.machine.values[k],
            "sigma": sigma[k],
            "data_share": estimate.data_share[k],
            "decided_by": source[name],
        }
        for k, name in enumerate(table.names)
    ]


def _groups(calibration: Calibration) -> tuple[Group, ...]:
    from pkmcal.report.parameters import parameter_groups

    return parameter_groups(calibration.session.machine, calibration.estimate)


def _not_identified(calibration: Calibration) -> list[str]:
    """The report's sentences about what the data could not decide."""
    from pkmcal.report.parameters import unidentified

    return list(unidentified(_groups(calibration), calibration.estimate, calibration.findings))


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
            }
        )
    return out


def _targets(calibration: Calibration) -> list[dict[str, Any]]:
    """Boards, and what trackers measured, on their body; sigma null where nothing tells it."""
    estimate, names = calibration.estimate, [m.name for m in calibration.measurements.mounts]
    out: list[dict[str, Any]] = []
    for m, name in enumerate(names):
        body = "platform" if estimate.state.on_platform[m] else "base"
        sigma = np.sqrt(np.maximum(np.diag(estimate.mount_covariance[m]), 0.0))
        known = [float(x) if x < OPEN else None for x in sigma]
        out.append(
            {
                "name": name,
                "fixed_to": body,
                f"T_{body}_target": estimate.state.T_mount[m],
                "sigma_rotation": known[:3],
                "sigma_translation": known[3:],
            }
        )
    return out


def base_camera_covariance(T_camera_base: Array, covariance: Array) -> Array:
    """Covariance (6, 6) of (omega, tau) of T_base_camera from that of T_camera_base, m and rad.

    With R, t of T_camera_base: omega' = -R^T omega, tau' = -R^T ([t]x omega + tau).
    """
    rot_t, t = T_camera_base[:3, :3].T, T_camera_base[:3, 3]
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = -rot_t
    jacobian[3:, :3] = -rot_t @ skew(t)
    return jacobian @ covariance @ jacobian.T


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
    if not calibration.cameras.active:
        return {}
    camera = calibration.cameras.result(calibration.estimate, file)
    n = len(camera.parameters)
    covariance = np.zeros((n, n)) if camera.covariance is None else camera.covariance
    return {
        "parameters": list(camera.parameter_names),
        "values": camera.parameters,
        "deviations": np.sqrt(np.diag(covariance)),
    }


def _configurations(calibration: Calibration) -> list[dict[str, Any]]:
    """Poses of all configurations; those not used have theirs from the readings alone."""
    session, estimate = calibration.session, calibration.estimate
    seen = digests(session)
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
    """One row an edge, and one a pose, whitened."""
    edges, estimate = calibration.observation.edges, calibration.estimate
    whole = [edges.station, edges.configuration, edges.leg, edges.tube, edges.side]
    reals = np.column_stack([estimate.edge_weights, estimate.edge_residuals])
    numbers = np.column_stack(whole) + 1
    rows = [
        [*place, *values]
        for place, values in zip(numbers.tolist(), np.round(reals, 3).tolist(), strict=True)
    ]
    found = calibration.measurements.poses
    reals = np.column_stack([estimate.pose_weights, estimate.pose_residuals])
    numbers = np.column_stack([found.station, found.configuration, found.mount]) + 1
    poses = [
        [*place, *values]
        for place, values in zip(numbers.tolist(), np.round(reals, 3).tolist(), strict=True)
    ]
    return {"columns": EDGE_COLUMNS, "edges": rows, "pose_columns": POSE_COLUMNS, "poses": poses}


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
