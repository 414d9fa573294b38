"""What a loop needs of a calibration on disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import inverse
from pkmcal.mechanisms import Machine

if TYPE_CHECKING:
    from pkmcal.export.source import Source


@dataclass(frozen=True)
class CalibratedStation:
    """A machine and one camera before it. T_camera_base : (4, 4). edge_shift : px outward."""

    machine: Machine
    camera: Camera
    T_camera_base: Array
    edge_shift: float


def calibrated_station(
    folder: Path | str, station: str, session: Path | None = None
) -> CalibratedStation:
    """One station of a calibration's folder.

    session : where the cameras' files are, if not above or beside the folder.
    Raises InputError where there is no such station or no camera file, ResultError for a
    calibration that was refused.
    """
    from pkmcal.export.source import load_source
    from pkmcal.results import load

    saved = load(folder)
    if not saved.verdict.usable:
        raise ResultError(
            what="the calibration was refused: " + " ".join(saved.verdict.reasons),
            where=str(folder),
            next_step="control needs a machine that is known; calibrate again",
        )
    source = load_source(folder, session)
    _check_station(folder, station, source)
    files = {s.name: s.camera for s in saved.stations}
    shifts = {c["file"]: float(c["edge_shift"]) for c in saved.document["cameras"]}
    return CalibratedStation(
        machine=source.machine,
        camera=source.cameras[station],
        T_camera_base=inverse(source.T_base_camera[station]),
        edge_shift=shifts.get(files[station], 0.0),
    )


def _check_station(folder: Path | str, station: str, source: Source) -> None:
    if station not in source.T_base_camera:
        raise InputError(
            what="the calibration has no such station",
            where=str(folder),
            found=station,
            expected=" or ".join(source.T_base_camera),
        )
    if station not in source.cameras:
        raise InputError(
            what="the station's camera file was not found",
            where=str(folder),
            found=station,
            expected="the session above or beside the calibration, with its cameras",
            next_step="give the session's folder as session",
        )
