"""``pkmcal.simulate``: a simulated session with images and known truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from pkmcal.cameras import Camera, load_camera
from pkmcal.errors import InputError
from pkmcal.files import closest
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.placement.default_camera import default_camera
from pkmcal.ranges import RANGES, check_number
from pkmcal.session.load import Session, load_session
from pkmcal.simulation import Sensor, Settings, simulate_session, to_simulate
from pkmcal.wording import listed


def simulate(
    folder: Path | str,
    mechanism: Machine | Path | str = "gough-stewart",
    *,
    camera: Camera | Path | str | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> Session:
    """Simulate a session in a new folder: images, readings, and the truth in truth.json.

    Parameters
    ----------
    folder :
        A new or empty one.
    mechanism :
        A built-in machine's name, a mechanism file, or a loaded machine. A nominal model without
        visible cylinders gets one on each rod.
    camera :
        A camera's file, or a loaded camera; by default a small industrial one of 800 x 600 px.
    seed :
        Seed for all random numbers.
    progress :
        Called with the number of finished images and of all images.
    settings :
        Fields of :class:`pkmcal.simulation.Settings`: ``stations=3``, ``configurations=15``,
        ``tolerance=1.0`` (standard deviation of the machine in prior sigmas), ``joint_noise=3e-6``,
        ``board=``, ``finish="metal"`` and so on.

    Returns
    -------
    Session
        As loaded by :func:`pkmcal.load_session`. ``pkmcal.simulation.load_truth(folder)`` reads the
        truth; ``pkmcal.compare`` compares a machine with it.

    Raises
    ------
    pkmcal.errors.InputError
        The folder is not empty, or the machine, the camera or a setting is invalid.

    """
    names = [one.name for one in fields(Settings)]
    for name in settings:
        if name not in names:
            guess = closest(name, names)
            raise InputError(
                "this is no setting of a simulation",
                found=name,
                expected=guess or listed(names, len(names)),
            )
    check_number("simulate", "seed", seed)
    _check_settings(settings)
    nominal = mechanism if isinstance(mechanism, Machine) else load_mechanism(mechanism)
    eye = (
        camera
        if isinstance(camera, Camera)
        else load_camera(camera)
        if camera
        else default_camera()
    )
    machine = to_simulate(nominal, nominal.name)
    simulate_session(folder, machine, eye, Settings(**settings), seed=seed, progress=progress)
    return load_session(folder)


def _check_settings(settings: Mapping[str, Any]) -> None:
    """Raise InputError for a number of the settings, or of their sensor, that is out of range."""
    for name, value in settings.items():
        if name == "stations" and not isinstance(value, int | float):
            continue  # poses of the stations instead of their number
        if name in RANGES["simulate"]:
            each: Any = value if name == "shake" else (value,)
            for one in each:
                check_number("simulate", name, one)
    sensor = settings.get("sensor")
    if isinstance(sensor, Sensor):
        check_number("simulate", "blur", sensor.blur, "sensor.blur")
        check_number("simulate", "noise", sensor.read_noise, "sensor.read_noise")
