"""Plant of a servoing study: a calibration with its cameras, or a machine from its
nominal model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource, load_source, loaded
from pkmcal.calibration.saved_calibration import SavedCalibration, SavedStation
from pkmcal.cameras import Camera, load_camera
from pkmcal.control.machine_view import machine_view
from pkmcal.control.study import Plant, Uncertainty
from pkmcal.errors import InputError
from pkmcal.files.quantities import read_quantity
from pkmcal.geometry.rigid import inverse, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.outcome.finding import doubtful
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.stations import default_stations
from pkmcal.simulation.truth import stream, true_machine

CALIBRATED_TOLERANCE_SHARE = 1 / 30
"""Share of a nominal model's prior sigmas that remains after a calibration: 2 mm become 0.06 mm, as
in the demonstration."""
CAMERA_ROTATION = float(np.deg2rad(0.02))
CAMERA_POSITION = 2e-4
"""Standard deviations, in rad and m, of a camera's pose in the same demonstration."""


def load_plant(
    what: SavedCalibration | Machine | Path | str,
    *,
    session: Path | None = None,
    station: str | None = None,
    camera: Path | None = None,
    legs: tuple[int, ...] | None = None,
    seed: int = 0,
) -> Plant:
    """Plant of a calibration or its folder, of a machine, of a mechanism file, or of a built-in
    machine.

    legs : numbers from 0. Raises InputError for any other source, for a station or camera that does
    not exist, and for legs that cannot be seen.
    """
    source = load_source(what, session)
    eye = load_camera(camera) if camera is not None else None
    calibration = loaded(what)
    if isinstance(calibration, SavedCalibration):
        return _of_calibration(calibration, source, station, eye, legs)
    if station is not None or session is not None:
        raise InputError(
            "a machine that is not calibrated has no stations",
            where="--station" if station is not None else "--session",
            found=station or str(session),
            next_step="Name a calibration's folder, or give --camera alone",
        )
    return _of_nominal(source, eye or default_camera(), legs, seed)


def _of_calibration(
    saved: SavedCalibration,
    source: MachineSource,
    station: str | None,
    eye: Camera | None,
    legs: tuple[int, ...] | None,
) -> Plant:
    """Plant with the calibrated machine as the true one.

    Estimates differ from it as the calibrated machine may differ from the real one.
    """
    place = _station(saved, source, station, eye)
    eye = source.cameras[place.name] if eye is None else eye
    refused = doubtful("servo.refused_calibration", source.origin, headline=saved.verdict.headline)
    origin = (
        f"The calibrated machine (folder {source.origin}), seen by the camera of {place.name};"
        " every run has its own errors, drawn from the calibration's covariance."
    )
    return Plant(
        machine=saved.machine,
        nominal=saved.nominal,
        uncertainty=Uncertainty(saved.covariance, place.sigma_rotation, place.sigma_translation),
        camera=eye,
        T_camera_base=inverse(place.T_base_camera),
        legs=legs,
        origin=origin,
        station=place.name,
        findings=() if saved.verdict.usable else (refused,),
    )


def _station(
    saved: SavedCalibration, source: MachineSource, name: str | None, eye: Camera | None
) -> SavedStation:
    """Station of this name, or the first station whose camera is available."""
    names = [one.name for one in saved.stations]
    if name is not None and name not in names:
        raise InputError(
            "the calibration has no such station",
            where="--station",
            found=name,
            expected=" or ".join(names),
            code="calibration.no_station",
        )
    wanted = [one for one in saved.stations if name in (None, one.name)]
    candidates = [one for one in wanted if eye is not None or one.name in source.cameras]
    if not candidates:
        raise InputError(
            "the station's camera file was not found",
            where=str(saved.path.parent),
            expected=", ".join(sorted({one.camera for one in wanted})),
            next_step="Name the session with --session, or the camera's file with --camera",
            code="camera.missing",
        )
    return candidates[0]


def _of_nominal(
    source: MachineSource, eye: Camera, legs: tuple[int, ...] | None, seed: int
) -> Plant:
    """Plant with a random machine within the prior sigmas of its nominal model."""
    machine = source.machine
    machine_view(machine, np.eye(4), None if legs is None else np.array(legs))  # checks legs
    rng = np.random.default_rng(stream(seed, "stations"))
    place = default_stations(machine, (eye,), rng)[0]
    table = machine.parameters
    free = table.free_matrix() * (CALIBRATED_TOLERANCE_SHARE * table.tolerances_free())
    truth = true_machine(machine, 1.0, np.random.default_rng(stream(seed, "machine")))
    x, y, z = place.position
    origin = (
        f"A {machine.name} built within its tolerances, the camera at ({x:.2f}, {y:.2f}, {z:.2f}) m"
        " in the base frame; its calibration is taken to leave a thirtieth of the tolerances,"
        f" {1e3 * CAMERA_POSITION:g} mm and {np.rad2deg(CAMERA_ROTATION):g}° of the camera's place."
    )
    return Plant(
        machine=truth,
        nominal=np.array(machine.values),
        uncertainty=Uncertainty(
            free @ free.T, np.full(3, CAMERA_ROTATION), np.full(3, CAMERA_POSITION)
        ),
        camera=eye,
        T_camera_base=place.T_camera_base(),
        legs=legs,
        origin=origin,
    )


def pose_of_text(text: str, where: str) -> Array:
    """Pose (4, 4) from six numbers x,y,z,rx,ry,rz: a position in metres and a rotation vector in
    radians, or with units.
    """
    kinds = ("m", "m", "m", "rad", "rad", "rad")
    try:
        numbers = np.array(
            [read_quantity(part, kind) for part, kind in zip(text.split(","), kinds, strict=True)]
        )
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise InputError(
            "this is not a platform pose",
            where=where,
            found=text,
            expected="x,y,z,rx,ry,rz: metres and a rotation vector in radians, or with units",
        )
    return pose(rotation(numbers[3:]), numbers[:3])


def legs_of_text(text: str) -> tuple[int, ...]:
    """Numbers of legs, from 1, from a text such as 1,3,5."""
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = list[int]()
    if not numbers or min(numbers) < 1 or len(set(numbers)) < len(numbers):
        raise InputError(
            "this is not a list of legs",
            where="--legs",
            found=text,
            expected="numbers from 1, each once, such as 1,3,5",
        )
    return tuple(numbers)
