"""Localization of hand-held images in the user's cache folder.

The digest of all that a result depends on is its name, so that every command that localizes the
same images uses the same poses, and images are searched once: :func:`session_name` for all images,
:func:`image_name` for one image by itself, and :func:`pkmcal.files.digest_of` for the program and
the versions of NumPy, SciPy and OpenCV.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from hashlib import blake2b
from typing import Any

import numpy as np

from pkmcal.boards.views import Boards
from pkmcal.calibration.case import PriorScene
from pkmcal.files import digest_of, remember_arrays, remembered_arrays
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms import Machine
from pkmcal.observe.image_localization import PoseHypotheses
from pkmcal.outcome.finding import Finding, Level
from pkmcal.session.load import Session

Localized = tuple[dict[int, PoseHypotheses], PriorScene]
"""Pose hypotheses by station, and the scene with the accepted poses."""


def image_name(session: Session, machine: Machine, station: int) -> str:
    """Name of the localization of one hand-held image by itself: the machine by which it is
    localized, the image's readings, and the image's file, camera and rough pose.
    """
    # Temperatures do not enter: the image is compared with the pose at the readings as they are.
    # They correct readings in the joint estimate, so the name of all images has them.
    readings = session.joints[session.stations[station].images[0].configuration]
    digest = digest_of(machine.to_document(), machine.values, readings, _stated(session, station))
    return f"image-{digest}"


def session_name(
    session: Session, stations: Sequence[int], boards: Boards, scene: PriorScene
) -> str:
    """Name of the localization of all hand-held images: the nominal model, readings, their noise
    temperatures and forces, image files, cameras, rough poses and names of stations, boards, and
    poses of the stations that were localized before.

    stations : that observe legs. scene : of the nominal model.
    """
    stood = [(k, one.stood and one.stood.T_camera_board) for k, one in boards.stations.items()]
    poses = boards.poses
    digest = digest_of(
        session.machine.to_document(),
        session.machine.values,
        session.joints,
        session.joint_noise,
        *(np.zeros(0) if x is None else x for x in (session.temperature, session.forces)),
        [
            [k, session.label(k), session.stations[k].handheld, _stated(session, k)]
            for k in stations
        ],
        session.camera_of_station,  # stations with one camera share its edge shift
        [k for k, _ in stood],
        *(np.zeros(0) if T is None else T for _, T in stood),
        [boards.body, boards.tolerance],
        poses.T_station_target,
        poses.whiten,
        scene.T_camera_base,
    )
    return f"session-{digest}"


def _stated(session: Session, station: int) -> list[Any]:
    """Camera, rough pose, configurations and image digests of a station, as plain data."""
    one = session.stations[station]
    files = [blake2b(photo.path.read_bytes(), digest_size=16).hexdigest() for photo in one.images]
    rows = [photo.configuration for photo in one.images]
    camera = one.camera
    return [
        [camera.model, camera.image_size, camera.parameters, one.response],
        one.T_camera_base,
        rows,
        files,
    ]


def remembered_image(name: str) -> PoseHypotheses | None:
    """Cached hypotheses of one image; None if there are none."""
    arrays = remembered_arrays(name)
    try:
        return None if arrays is None else _hypotheses(arrays, "")
    except (KeyError, ValueError):
        return None


def remember_image(name: str, hypotheses: PoseHypotheses) -> None:
    """Cache the hypotheses of one image."""
    remember_arrays(name, _arrays_of(hypotheses, ""))


def remembered_session(name: str, machine: Machine) -> Localized | None:
    """Cached localization of a session; None if there is none.

    machine : the nominal one.
    """
    arrays = remembered_arrays(name)
    if arrays is None:
        return None
    try:
        places = {int(k): _hypotheses(arrays, f"{k}.") for k in arrays["images"]}
        edges = {
            int(k): EdgeSet(**{f.name: arrays[f"{k}.{f.name}"] for f in fields(EdgeSet)})
            for k in arrays["registered"]
        }
        values = arrays["machine"]
        findings = tuple(
            Finding(code, Level(level), facts, subject)
            for code, level, facts, subject in json.loads(str(arrays["findings"]))
        )
        scene = PriorScene(
            machine if np.array_equal(values, machine.values) else machine.with_values(values),
            arrays["T_camera_base"],
            arrays["T_base_platform"],
            edges,
            scatter=float(arrays["scatter"]),
            findings=findings,
        )
    except (KeyError, ValueError, TypeError):
        return None
    return places, scene


def remember_session(name: str, localized: Localized) -> None:
    """Cache the localization of a session; the marginal prior of the machine is left out."""
    places, scene = localized
    arrays: dict[str, Any] = {
        "images": np.array(sorted(places), dtype=int),
        "registered": np.array(sorted(scene.edges), dtype=int),
        "machine": scene.machine.values,
        "T_camera_base": scene.T_camera_base,
        "T_base_platform": scene.T_base_platform,
        "scatter": np.array(scene.scatter),
        "findings": np.array(
            json.dumps([(f.code, f.level.value, dict(f.facts), f.subject) for f in scene.findings])
        ),
    }
    for k, one in places.items():
        arrays |= _arrays_of(one, f"{k}.")
    for k, edges in scene.edges.items():
        arrays |= {f"{k}.{f.name}": getattr(edges, f.name) for f in fields(edges)}
    remember_arrays(name, arrays)


def _arrays_of(hypotheses: PoseHypotheses, prefix: str) -> Mapping[str, Any]:
    return {prefix + key: np.asarray(value) for key, value in hypotheses._asdict().items()}


def _hypotheses(arrays: Mapping[str, Any], prefix: str) -> PoseHypotheses:
    T, ratio, unit = (arrays[prefix + key] for key in PoseHypotheses._fields)
    return PoseHypotheses(T, ratio, float(unit))
