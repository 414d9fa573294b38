"""Files of a calibration: mechanism.yaml and calibration.json, written.

calibration.json holds the whole result in SI units, in the frames that ``gauge`` names; without
dates, so that the same session gives the same file except for timings.
:mod:`pkmcal.calibration.saved_calibration` reads it back.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.file_names import (
    CALIBRATED_MECHANISM_FILE,
    CALIBRATION_DOCUMENT_FILE,
    CALIBRATION_REPORT_FILE,
)
from pkmcal.errors import InputError, legible
from pkmcal.files import check_writable, entries, json_text, json_value, resolved, versions
from pkmcal.geometry.rigid import inverse, skew
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.unidentified import identified
from pkmcal.measurements.effects import BOARD_SIZE, EDGE_SHIFT, FOCAL_EXCESS
from pkmcal.mechanisms import mechanism_text
from pkmcal.session.image_files import label_of
from pkmcal.session.load import Session, digests, session_digest
from pkmcal.wording import listed

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.calibration.toolmap import ToolMap
    from pkmcal.identify.unidentified import Identification

CALIBRATION_RESULT_FILES = (
    CALIBRATION_REPORT_FILE,
    CALIBRATED_MECHANISM_FILE,
    CALIBRATION_DOCUMENT_FILE,
)
CAMERA_FILE = re.compile(r"camera-.+\.yaml")
"""Files of cameras that were refined with the machine."""
FORMAT_KEY, CALIBRATION_FORMAT = "pkmcal_calibration", 1
CALIBRATION_CONVENTIONS = (
    "SI: m and rad. T_a_b maps coordinates of frame b to frame a. length = scale * reading +"
    " offset. Legs, tubes and sides count from 1. sigma is a standard deviation: of sampling, and"
    " of model errors as far as residuals show them. Rotations of a pose are perturbed from the"
    " left, about the axes of its outer frame. Where sigma is null, the data do not determine the"
    " value: it is a convention."
)
EDGE_COLUMNS = (
    "station", "configuration", "leg", "tube", "side", "weight", "shift", "tilt", "coarse",
)  # fmt: skip
"""Columns of residuals.edges, names as numbers from 1; shift and tilt in standard deviations;
coarse is 1 for an edge by its silhouette, 0 for one that was measured by profiles."""
LINK_COLUMNS = ("from", "to", "weight", "value", "sigma", "residual")
"""Columns of residuals of links: two configurations as numbers from 1, the value and its stated
standard deviation in SI, the residual in standard deviations."""
POSE_COLUMNS = (
    "station", "configuration", "target", "weight", "turn1", "turn2", "turn3", "x", "y", "z",
)  # fmt: skip
"""Columns of residuals.poses, the last six whitened together, in standard deviations."""
EDGE_WEIGHT, POSE_WEIGHT = EDGE_COLUMNS.index("weight"), POSE_COLUMNS.index("weight")
EDGE_RESIDUALS = slice(EDGE_COLUMNS.index("shift"), EDGE_COLUMNS.index("tilt") + 1)


def check_output(folder: Path | str, *, force: bool = False) -> list[str]:
    """Raise `InputError` where a result cannot be written to `folder`; to be called before the
    work.

    Only a new or empty folder, or an earlier result, is written to: a session's mechanism.yaml must
    not be replaced by its calibrated one. Returns the files of that result, which is archived
    beside the folder (:mod:`pkmcal.calibration.archive`) unless ``force`` replaces it.
    """
    folder = Path(folder)
    check_writable(folder)
    standing = entries(folder)
    foreign = [
        name
        for name in standing
        if name not in CALIBRATION_RESULT_FILES and not CAMERA_FILE.fullmatch(name)
    ]
    # A mechanism.yaml without the rest is somebody's nominal model.
    if foreign or (standing and CALIBRATION_DOCUMENT_FILE not in standing):
        raise InputError(
            "the output folder holds something other than a calibration",
            where=str(folder),
            found=listed(foreign or standing, 4),
            expected="a new or empty folder, or one of an earlier calibration",
            next_step="Name another folder with -o, or move these files away",
            code="output.foreign_files",
        )
    if standing and not force:
        try:
            check_writable(resolved(folder).parent)
        except InputError:
            raise InputError(
                "the calibration that is there cannot be kept, for nothing can be written beside"
                " its folder",
                where=str(folder),
                next_step="Name another folder with -o, or replace it with --force",
                code="output.earlier_not_kept",
            ) from None
    return standing


def texts_of(calibration: Calibration, document: dict[str, Any]) -> dict[str, str | bytes]:
    """Files of a calibration besides its page, contents by file name.

    document : of :func:`calibration_document`.
    """
    from pkmcal.cameras.files import camera_text, written_camera

    texts: dict[str, str | bytes] = {
        CALIBRATED_MECHANISM_FILE: calibrated_mechanism_text(calibration),
        CALIBRATION_DOCUMENT_FILE: json_text(document),
    }
    cameras = calibration.cameras
    for file in cameras.files if cameras.refined else ():
        camera = cameras.result(calibration.estimate, file)
        texts[written_camera(file)] = camera_text(camera)
    for turned in calibration.upside_down:
        texts[written_camera(turned.subject)] = camera_text(turned.camera)
    return texts


def calibrated_mechanism_text(calibration: Calibration) -> str:
    """The calibrated machine as a mechanism file with a header."""
    verdict = calibration.verdict
    name = resolved(calibration.session.folder).name
    lines = [
        f"Calibrated by pkmcal {versions()['pkmcal']} from the session {name}"
        f" (method {calibration.method}, seed {calibration.seed}).",
        verdict.headline if verdict.usable else "NOT TO BE USED: " + " ".join(verdict.reasons),
        f"Frames: {calibration.estimate.gauge}. Lengths in metres.",
        f"Standard deviations, covariance and all else: {CALIBRATION_DOCUMENT_FILE}; for people:"
        f" {CALIBRATION_REPORT_FILE}.",
    ]
    # A session's name may hold a line break; what follows it must stay a comment.
    comment = "".join(f"# {legible(' '.join(line.split()))}\n" for line in lines)
    return comment + mechanism_text(calibration.machine)


def calibration_document(
    calibration: Calibration,
    not_identified: Sequence[str] = (),
    holdout: dict[str, Any] | None = None,
    over: ToolMap | str | None = None,
    images: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Content of calibration.json, plain data without NaN and dates.

    not_identified : sentences about unidentifiable directions, as in the report.
    holdout : residuals of held-out configurations, besides those in use.
    over : tool over the workspace, or why there is no map of it.
    images : digests of the images, computed by default.
    """
    session, estimate = calibration.session, calibration.estimate
    bed = calibration.identification.bed
    in_view = digests(session) if images is None else images
    document = {
        FORMAT_KEY: CALIBRATION_FORMAT,
        "conventions": CALIBRATION_CONVENTIONS,
        "verdict": calibration.verdict.document(),
        "method": calibration.method,
        "model": calibration.session.model,
        "seed": calibration.seed,
        "gauge": estimate.gauge,
        "parameters": [asdict(row) for row in calibration.parameters],
        "covariance": estimate.covariance,
        "not_identified": not_identified,
        "identifiability": identifiability_of(calibration.identification),
        "stations": _stations(calibration),
        "station_covariance": _station_covariance(calibration),
        "targets": _targets(calibration),
        "cameras": _cameras(calibration),
        "configurations": _configurations(calibration, in_view),
        "statistics": asdict(estimate.statistics),
        "edge_noise": _edge_noise(estimate),
        "tool": {"why_not": over} if isinstance(over, str) else over and over.document(),
        "bed": bed and asdict(bed),
        "heights": calibration.heights.document(session),
        "holdout": holdout,
        "residuals": _residuals(calibration),
        "rejected": _rejected(calibration),
        "rejected_photographs": rejected_photographs(session),
        "mechanism": estimate.machine.to_document(),
        "session": {
            "folder": resolved(session.folder).name,
            "digest": session_digest(session, in_view),
            **session.document,
        },
        "departures": [one.document() for one in calibration.violations],
        "model_errors": [one.document() for one in calibration.model_errors],
        "warnings": session.warnings,
        "versions": versions(),
        "timings": {name: round(value, 3) for name, value in calibration.timings.items()},
    }
    return json_value(document)


def _edge_noise(estimate: Estimate) -> list[dict[str, Any]]:
    """Noise of the edges of each tube of a leg, from 1."""
    if not estimate.edge_weights.size:
        return []
    value = estimate.edge_noise
    rows = zip(value.scale, value.shading, value.dof, strict=True)
    return [
        {"tube": k, "scale": scale, "shading": shading, "tails": tails}
        for k, (scale, shading, tails) in enumerate(rows, start=1)
    ]


def identifiability_of(identification: Identification) -> dict[str, Any]:
    """Rank, unidentifiable directions in words, and the papers' conditions.

    moves_platform : m, root mean square over the platform's joints and poses.
    """
    ranks = identification.identifiability
    return {
        "rank": ranks.rank,
        "n_parameters": ranks.n_parameters,
        "n_frames": ranks.n_frames,
        "singular_values": ranks.singular_values,
        "moves_platform_by_drawing": identification.by_nominal,
        "unidentified": [asdict(sentence) for sentence in identification.unidentified],
        "weak": [asdict(sentence) for sentence in identification.weak],
        "conditions": [asdict(condition) for condition in identification.conditions],
    }


def _stations(calibration: Calibration) -> list[dict[str, Any]]:
    estimate = calibration.estimate
    out: list[dict[str, Any]] = []
    session = calibration.session
    sources: list[tuple[str, str, int, str | None]] = [
        (x.name, x.camera_file, len(x.images), x.response if "legs" in x.observe else None)
        for x in session.stations
    ]
    sources += [(x.name, x.label, len(x.configuration), None) for x in session.trackers]
    for s, (name, file, number, response) in enumerate(sources):
        T_camera_base = estimate.state.T_camera_base[s]
        covariance = base_camera_covariance(T_camera_base, estimate.station_covariance[s])
        sigma = _sigma_where_identified(estimate, covariance)
        out.append(
            {
                "name": name,
                "camera": file,
                "response": response,
                "binning": None if response is None else calibration.observation.binning[s],
                "T_base_camera": inverse(T_camera_base),
                "sigma_rotation": sigma[:3],
                "sigma_translation": sigma[3:],
                "photographs": number,
                **_focal_scale(calibration, s),
            }
        )
    return out


def _station_covariance(calibration: Calibration) -> dict[str, Any]:
    """Joint covariance of all parameters with stations whose camera may stay in place.

    Names of the stations, and their rows (6 k, P + 6 k) of the covariance of all parameters and
    these stations, (omega, tau) of T_base_camera. Stations with a partly determined pose, such as a
    probe of heights or orientations, are omitted.
    """
    session, estimate = calibration.session, calibration.estimate
    nowhere = {station.name for station in session.stations if station.handheld}
    names = session.station_names
    covariances = map(
        base_camera_covariance, estimate.state.T_camera_base, estimate.station_covariance
    )
    nowhere |= {
        name
        for name, covariance in zip(names, covariances, strict=True)
        if None in _sigma_where_identified(estimate, covariance)
    }
    determined = np.array([k for k, name in enumerate(names) if name not in nowhere], dtype=int)
    n = len(estimate.machine.parameters)
    rows = rows_of_stations(n, determined)
    joint = of_inverse_poses(
        estimate.joint_covariance[np.ix_(rows, rows)], estimate.state.T_camera_base[determined]
    )
    return {"stations": [names[k] for k in determined], "rows": joint[n:]}


def rows_of_stations(n: int, stations: Integers) -> Integers:
    """Indices of n parameters, then of some stations, in a joint covariance."""
    return np.concatenate([np.arange(n), (n + 6 * stations[:, None] + np.arange(6)).ravel()])


def of_inverse_poses(joint: Array, T_a_b: Array) -> Array:
    """Joint covariance of parameters and inverse poses, (omega, tau) of T_b_a, from that of the
    parameters and poses T_a_b (k, 4, 4).
    """
    n = len(joint) - 6 * len(T_a_b)
    by = np.eye(len(joint))
    for k, transform in enumerate(T_a_b):
        at = slice(n + 6 * k, n + 6 * k + 6)
        by[at, at] = _inverse_errors(transform)
    return by @ joint @ by.T


def _focal_scale(calibration: Calibration, number: int) -> dict[str, Any]:
    """Factor of a hand-held image's focal lengths on its camera's, with its standard deviation."""
    cameras, estimate = calibration.cameras, calibration.estimate
    if number >= len(cameras.breathes) or not cameras.breathes[number]:
        return {}
    return {
        "focal_scale": 1 + cameras.updated(estimate).breath[number],
        "sigma_focal_scale": estimate.column_sigma(FOCAL_EXCESS)[number],
    }


def _targets(calibration: Calibration) -> list[dict[str, Any]]:
    """Boards and trackers' targets on their body; sigma null where not identified."""
    estimate, mounts = calibration.estimate, calibration.measurements.mounts
    sizes = estimate.state.columns.get(BOARD_SIZE, ())  # the papers' methods estimate none
    sizes = iter(zip(sizes, estimate.column_sigma(BOARD_SIZE), strict=True))
    out: list[dict[str, Any]] = []
    for m, mount in enumerate(mounts):
        size: dict[str, float] = {}
        if mount.tolerance > 0 and (estimated := next(sizes, None)):
            size = {"size": 1 + estimated[0], "sigma_size": estimated[1]}
        body = "platform" if estimate.state.on_platform[m] else "base"
        sigma = _sigma_where_identified(estimate, estimate.mount_covariance[m])
        out.append(
            {
                "name": mount.name,
                **size,
                "fixed_to": body,
                f"T_{body}_target": estimate.state.T_mount[m],
                "sigma_rotation": sigma[:3],
                "sigma_translation": sigma[3:],
            }
        )
    return out


def _sigma_where_identified(estimate: Estimate, covariance: Array) -> list[float | None]:
    """Standard deviations of a pose's six numbers, None where the data do not determine them."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    reference = identified(estimate.machine, covariance)
    return [x if sure else None for x, sure in zip(sigma, reference, strict=True)]


def base_camera_covariance(T_camera_base: Array, covariance: Array) -> Array:
    """Covariance (6, 6) of (omega, tau) of T_base_camera from that of T_camera_base, m and rad."""
    return of_inverse_poses(covariance, T_camera_base[None])


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
    """Each camera file once, with its edge shift, px of its images outward."""
    estimate, numbers = calibration.estimate, calibration.measurements.camera_of_station.tolist()
    stations = calibration.session.stations
    # trackers, whose number means nothing, come last
    files = {c: station.camera_file for c, station in zip(numbers, stations, strict=False)}
    pixels = dict(zip(numbers, calibration.observation.binning.tolist(), strict=False))
    turned = {one.subject for one in calibration.upside_down}
    return [
        {
            "file": files[c],
            "edge_shift": estimate.state.columns[EDGE_SHIFT][c] * pixels[c],
            "sigma": estimate.column_sigma(EDGE_SHIFT)[c] * pixels[c],
            **_refined(calibration, files[c]),
            **({"upside_down": True} if files[c] in turned else {}),
        }
        for c in sorted(files)
    ]


def _refined(calibration: Calibration, file: str) -> dict[str, Any]:
    """Intrinsics that were refined with the machine, with their standard deviations."""
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
    calibration: Calibration, in_view: Mapping[str, Sequence[str]]
) -> list[dict[str, Any]]:
    """Poses of all configurations; of unused ones by the readings alone. in_view : digests of the
    images.
    """
    session, estimate = calibration.session, calibration.estimate
    return [
        {
            "name": name,
            "photographs": in_view.get(name, []),
            "used": bool(estimate.configurations[k]),
            "joints": session.joints[k],
            "joint_residuals": np.round(estimate.joint_residuals[k], 4),
            "T_base_platform": estimate.state.T_base_platform[k],
        }
        for k, name in enumerate(session.configurations)
    ]


def _residuals(calibration: Calibration) -> dict[str, Any]:
    """Whitened residuals, one row for each edge and each pose, with indices from 1."""
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
            edges.coarse.astype(float),
        ),
        "pose_columns": POSE_COLUMNS,
        "poses": rows(
            (poses.station, poses.configuration, poses.mount),
            estimate.pose_weights,
            estimate.pose_residuals,
        ),
        **_link_residuals(calibration),
    }


def _link_residuals(calibration: Calibration) -> dict[str, Any]:
    """Residuals of each kind of link in the session, under its name."""
    estimate, links = calibration.estimate, calibration.measurements.links
    out: dict[str, Any] = {"link_columns": LINK_COLUMNS} if links else {}
    first = 0
    for one in links:
        mine = slice(first, first + len(one))
        first = mine.stop
        reals = (estimate.link_weights[mine], one.value, one.sigma, estimate.link_residuals[mine])
        ends = (one.configuration + 1).tolist()
        values = np.column_stack(reals).tolist()
        out[one.kind] = [[*pair, *row] for pair, row in zip(ends, values, strict=True)]
    return out


def rejected_photographs(session: Session) -> list[dict[str, Any]]:
    """Images without a pose, one entry each: file by its path in the session, station,
    configuration, and the reason in words.
    """
    return [
        {
            "file": label_of(session.folder, photo.path),
            "station": one.station.name,
            "configuration": session.configurations[photo.configuration],
            "reason": one.reason,
        }
        for one in session.rejected
        for photo in one.station.images
    ]


def _rejected(calibration: Calibration) -> list[dict[str, Any]]:
    """Rejections by reason; leg, tube and side from 1, 0 where all of them are meant."""
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
