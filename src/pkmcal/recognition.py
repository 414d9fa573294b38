"""Recognising the machine in a session's photographs: what `check` and `calibrate` begin with."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError, InputError
from pkmcal.files import listed
from pkmcal.observe import legs
from pkmcal.observe.diagnose import unrecognised
from pkmcal.observe.images import decode_all
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.stations import StationPose, View, find_station
from pkmcal.session import Session, Station

WORKERS = 2
"""Threads beside one another: decoding and array work release Python's lock."""


def check_observable(session: Session) -> None:
    """What the session's form allows but this observation cannot use."""
    for station in session.stations:
        where = f"session.yaml, stations.{station.name}"
        if station.observe != "legs":
            raise InputError(
                "boards are not observed yet", where=where, found=f"observe: {station.observe}",
                expected="observe: legs",
            )  # fmt: skip
        if station.T_camera_base is None:
            raise InputError(
                "the station has no rough pose",
                where=where,
                expected="pose: {position: [x, y, z], look_at: [x, y, z], up: [0, 0, 1]}",
                next_step="Measure by hand where the camera stands; 10 cm and 10 degrees will do",
            )
    if not any(leg.tubes for leg in session.machine.document.legs):
        raise InputError(
            "no leg of the drawing has visible cylinders",
            where="mechanism.yaml, legs",
            expected="tubes: [{radius: 0.014, from: 0.05, to: 0.25}] on the legs",
            next_step="Measure the legs' radii with calipers",
        )


def read_photographs(session: Session) -> list[legs.Photographs]:
    """Every station's photographs, decoded and prepared for the search."""

    def read(number: int) -> legs.Photographs:
        station = session.stations[number]
        paths = [p.path for p in station.photographs]
        labels = [label_of(session.folder, path) for path in paths]
        images = decode_all(paths, station.camera.image_size, labels)
        rows = np.array([p.configuration for p in station.photographs])
        return legs.photographs_of(number, station.camera, rows, session.joints, images)

    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(read, range(len(session.stations))))


def label_of(folder: Path, path: Path) -> str:
    """A photograph's name in messages: its path inside the session."""
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def platform_poses(session: Session) -> Array:
    """T_base_platform (K, 4, 4) of all configurations by the drawing, or which one has none."""
    try:
        found = session.machine.forward_result(session.joints)
    except GeometryError as error:  # the drawing is the user's: it is at fault
        raise InputError(
            error.what,
            where=session.document["mechanism"],
            found=error.found,
            expected=error.expected,
            next_step=error.next_step,
        ) from None
    if found.converged.all():
        return found.T_base_platform
    bad = [session.configurations[k] for k in np.flatnonzero(~found.converged)]
    raise InputError(
        "the drawing's machine cannot take these readings: its legs do not meet the platform",
        where=f"{session.document['joints']['file']}, configuration {listed(bad)}",
        found=f"a gap of {float(found.error.max()) * 1e3:.3g} mm",
        expected="readings at which all legs reach the platform",
        next_step="Check these readings, the order of their columns, and the drawing's centres",
    )


@dataclass(frozen=True)
class Recognition:
    """Where the search for each station's pose ended; rough : the poses it began from."""

    views: tuple[View, ...]
    rough: tuple[Array, ...]
    found: tuple[StationPose, ...]

    @property
    def complete(self) -> bool:
        """Whether the machine was recognised in every station's photographs."""
        return all(pose.good for pose in self.found)


def recognise(
    session: Session,
    photographs: list[legs.Photographs],
    poses: Array,
    rngs: list[np.random.Generator],
) -> Recognition:
    """Look for the machine in every station's photographs, nothing raised.

    poses : T_base_platform (K, 4, 4) of the configurations. rngs : one a station.
    """
    machine, tubes = session.machine, tubes_of(session.machine)
    views = tuple(
        View(machine, p.camera, tubes, p.joints, poses[p.configuration], p.tables)
        for p in photographs
    )
    rough = tuple(_rough(station) for station in session.stations)
    with ThreadPoolExecutor(WORKERS) as pool:
        found = tuple(pool.map(find_station, views, rough, rngs))
    return Recognition(views, rough, found)


def why_unrecognised(
    session: Session,
    photographs: list[legs.Photographs],
    recognition: Recognition,
    rng: np.random.Generator,
) -> InputError:
    """The error about the stations that were not recognised; the usual mix-ups are tried."""
    return unrecognised(
        [station.name for station in session.stations],
        list(recognition.views),
        list(recognition.rough),
        list(recognition.found),
        session.joints,
        [p.configuration for p in photographs],
        rng,
    )


def found_stations(
    session: Session, photographs: list[legs.Photographs], rng: np.random.Generator
) -> Array:
    """Poses T_camera_base (S, 4, 4) of all stations, or the reason why one is not recognised."""
    rngs = rng.spawn(len(photographs) + 1)
    found = recognise(session, photographs, platform_poses(session), rngs[1:])
    if not found.complete:
        raise why_unrecognised(session, photographs, found, rngs[0])
    return np.stack([pose.T_camera_base for pose in found.found])


def _rough(station: Station) -> Array:
    """The station's pose by hand; :func:`check_observable` has seen that there is one."""
    return np.eye(4) if station.T_camera_base is None else station.T_camera_base
