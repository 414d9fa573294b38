"""Measurements of a calibrated machine in a new session, and the configurations that are new.

The calibrated machine, free within its prior sigmas, is the best start for measuring the images; of
this estimate only the measurements and the poses of platform and stations are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np

from pkmcal.arrays import Booleans
from pkmcal.calibration.calibrate import Calibration, calibrate_session
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.cameras.files import load_camera, written_camera
from pkmcal.errors import InputError
from pkmcal.outcome.finding import Finding, doubtful, note
from pkmcal.outcome.progress import Progress
from pkmcal.session.load import Session, Station, digests
from pkmcal.session.readings import same_pose


def calibrated_rows(saved: SavedCalibration, session: Session) -> Booleans:
    """Mask (K,) of a session's configurations that the calibration used.

    They are identified by their images; without any (a tracker's), or for a calibration that lists
    none, by the readings: two measurements of a pose do not agree to the last digit.
    """
    entries: list[dict[str, Any]] = saved.document["configurations"]
    used = [*compress(entries, saved.used)]
    old = {digest for entry in used for digest in entry.get("photographs", ())}
    new = digests(session) if old else {}
    same = np.any(np.all(session.joints[:, None] == saved.joints[saved.used], axis=2), axis=1)
    return np.array(
        [
            bool(old & set(new[name])) if name in new else bool(similar)
            for name, similar in zip(session.configurations, same, strict=True)
        ]
    )


def repeated_rows(saved: SavedCalibration, session: Session) -> Booleans:
    """Mask (K,) of a session's configurations at poses that the calibration used, by the
    readings.
    """
    used = saved.joints[saved.used]
    owner = same_pose(np.concatenate([used, session.joints]), session.joint_noise)
    return owner[len(used) :] < len(used)


def check_new(valid: Booleans, visible: Booleans, what: str, expected: str, next_step: str) -> None:
    """Raise `InputError`, with the given texts, if no observed configuration is new to the
    calibration.
    """
    if not np.any(visible & ~valid):
        used = int(np.sum(visible & valid))
        raise InputError(
            what,
            found=f"{used} configurations, all of them used",
            expected=expected,
            next_step=next_step,
            code="session.not_new",
        )


def temperature_notes(saved: SavedCalibration, session: Session) -> Iterator[Finding]:
    """Notes on the thermal growth of a calibrated machine in a session: applied, or not and why."""
    growth, temperature = saved.machine.document.growth, session.temperature
    if growth is not None and temperature is not None:
        low, high = (float(end) for end in (temperature.min(), temperature.max()))
        yield note("readings.growth_applied", low=low, high=high, calibrated=growth.temperature)
    elif growth is not None:
        yield doubtful("readings.growth_not_applied", calibrated=growth.temperature)
    elif temperature is not None:
        yield note("readings.growth_unknown", mean=float(temperature.mean()))


def measured_new_data(
    saved: SavedCalibration,
    session: Session,
    seed: int,
    progress: Progress,
) -> Calibration:
    """Measure a session and estimate all poses; see the module.

    The session of the result lacks hand-held images that were not localized, and numbers its
    stations accordingly. seed : of the localization.
    """
    # earlier readings are rivals of the session's own, so they must not be at the same poses
    earlier = saved.joints[saved.used]
    owner = same_pose(np.concatenate([session.joints, earlier]), session.joint_noise)
    new = replace(
        session,
        machine=saved.machine,
        stations=_as_calibrated(saved, session),
        earlier_joints=earlier[owner[len(session.joints) :] >= len(session.joints)],
    )
    # Stations on tripods are localized by the calibrated machine, because they may have few images.
    # Hand-held images are localized by the nominal model, as in `check` and `calibrate`: all
    # commands then use the same images, and cached poses, whose names contain the machine.
    by_hand = any(station.handheld for station in session.stations)
    nominal = session.machine if by_hand else None
    return calibrate_session(new, seed=seed, progress=progress, localized_by=nominal)


def _as_calibrated(saved: SavedCalibration, session: Session) -> tuple[Station, ...]:
    """Stations with the camera response and the half turn of images that the calibration
    determined.

    The session's own response has precedence. A few new images determine both less reliably.
    """
    responses = {row["name"]: row.get("response") for row in saved.document["stations"]}
    turned = {
        row["file"]: load_camera(saved.path.parent / written_camera(row["file"]))
        for row in saved.document.get("cameras", ())
        if row.get("upside_down")
    }
    out: list[Station] = []
    for station in session.stations:
        # a hand-held image has its own name after that of its entry
        names = (
            (name for name in responses if name.startswith(f"{station.entry}-"))
            if station.handheld
            else iter([station.name])
        )
        response = responses.get(next(names, station.name))
        has_response = response is not None and not station.response_given
        # Turn the images by half where the calibration had to.
        camera = station.camera
        turned_camera = turned.get(station.camera_file)
        # otherwise the camera file was corrected since the calibration, or replaced
        if turned_camera is not None and np.allclose(
            camera.turned_by_half().parameters, turned_camera.parameters
        ):
            camera = turned_camera
        station_then = replace(station, camera=camera)
        out.append(
            replace(station_then, response=response, response_given=True)
            if has_response
            else station_then
        )
    return tuple(out)
