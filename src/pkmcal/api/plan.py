"""``pkmcal.plan``: the next configurations to measure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

from threadpoolctl import threadpool_limits

from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.cameras import Camera, load_camera
from pkmcal.errors import InputError
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.stations import PANORAMIC_HALF_VIEW, view_angle
from pkmcal.planning.defaults import (
    CONFIGURATIONS_A_CAPTURE,
    NOMINAL_CORNER_SIGMA,
    NOMINAL_EDGE_SIGMA,
    PLANNED_IMAGE_SIZE,
    STATIONS_AROUND_A_MACHINE,
    UNTOLD_READING_NOISE,
)
from pkmcal.planning.plan import MeasurementPlan
from pkmcal.planning.plan import plan_measurements as run
from pkmcal.planning.subject import as_it_stands, of_machine
from pkmcal.session.load import Session, load_session, session_folder
from pkmcal.simulation import board_for


def plan(
    subject: Session | Machine | Path | str,
    *,
    count: int = CONFIGURATIONS_A_CAPTURE,
    index: Literal["tool", "D", "E", "O1"] = "tool",
    places: int | None = None,
    best_of: int | None = None,
    after: SavedCalibration | Path | str | None = None,
    from_drawing: bool = False,
    same_place: bool = False,
    together: bool | None = None,
    camera: Camera | Path | str | None = None,
    board: bool = False,
    tracker: tuple[float, float | None] | None = None,
    edge_noise: float = NOMINAL_EDGE_SIGMA,
    corner_noise: float = NOMINAL_CORNER_SIGMA,
    joint_noise: float = UNTOLD_READING_NOISE,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> MeasurementPlan:
    """Choose the configurations that determine a machine best, without writing files.

    Parameters
    ----------
    subject :
        A session or its folder, with its existing measurements; or a machine, the name of a
        built-in one or a mechanism file, with an assumed camera.
    count :
        Number of configurations at each station.
    index :
        Criterion to be minimized: the tool's variance, or one of the indices D, E and O1.
    places :
        Number of stations to choose as well, on a sphere around the machine.
    best_of :
        Number of the session's stations to choose; sessions only.
    after :
        Calibration to continue from, by default the usable one in the session's folder; sessions
        only.
    from_drawing :
        Ignore the calibration in the session's folder; sessions only.
    same_place :
        The cameras still have their poses of the calibration; sessions only.
    together :
        Whether all stations measure each configuration, or each its own; by default together if
        there are several cameras, or a tracker.
    camera :
        Camera or its file, by default a small industrial one of 1280 x 960 px; machines only. It
        has three stations, or one if a board, a panoramic camera or ``places`` needs no more.
    board :
        Observe a board on the platform instead of the legs; machines only.
    tracker :
        Standard deviations of the positions (m) and turns (rad; None if it measures points) of a
        tracker instead of a camera; machines only.
    edge_noise, corner_noise :
        Standard deviations of edges and of a board's corners without images, px.
    joint_noise :
        Standard deviation of a reading, m or rad; machines only.
    seed :
        Seed for all random numbers.
    progress :
        Called with the share done, 0 to 1.

    Returns
    -------
    MeasurementPlan
        ``joints`` (n, m), ``names``, ``T_base_platform`` (n, 4, 4) in the order of measurement;
        ``now``, ``promised`` and ``by_chance``, standard deviations of the tool.

    Raises
    ------
    pkmcal.errors.InputError
        The subject or an option does not allow a plan.

    """
    folder = None if isinstance(subject, Session | Machine) else session_folder(str(subject))
    planned = {
        "count": count, "index": index, "together": together, "free_stations": places,
        "best_of": best_of, "seed": seed, "progress": progress,
    }  # fmt: skip
    with threadpool_limits(1, "blas"):
        if folder is not None or isinstance(subject, Session):
            _check_options(
                "a machine", {"--camera": camera, "--board": board, "--tracker": tracker}
            )
            session = subject if isinstance(subject, Session) else None
            session = session or load_session(folder or "", measured=False)
            rig_subject = as_it_stands(
                session, after, from_nominal=from_drawing, same_place=same_place,
                anywhere=places is not None, edge=edge_noise, corner=corner_noise, seed=seed,
            )  # fmt: skip
            return run(rig_subject, region=session.workspace, **planned)
        _check_options(
            "a session", {"--after": after, "--same-place": same_place, "--best-of": best_of}
        )
        machine = subject if isinstance(subject, Machine) else load_mechanism(str(subject))
        if camera is None:
            eye = camera_of_size(PLANNED_IMAGE_SIZE)
        else:
            eye = camera if isinstance(camera, Camera) else load_camera(camera)
        # Errors are located at the machine's or the camera's name as given.
        name = machine.name if isinstance(subject, Machine) else str(subject)
        try:
            one = board or places or view_angle(eye) > PANORAMIC_HALF_VIEW
            rig_subject = of_machine(
                machine,
                [eye] * (1 if one else STATIONS_AROUND_A_MACHINE),
                machine.joint_names,
                board=board_for(machine, "platform") if board else None,
                tracker=tracker,
                joint_noise=joint_noise,
                edge=edge_noise,
                corner=corner_noise,
                seed=seed,
            )
        except InputError as error:
            raise error.located(name) from None
        try:
            return run(rig_subject, **planned)
        except InputError as error:
            raise error.located(str(camera) if isinstance(camera, Path | str) else name) from None


def _check_options(owner: str, given: Mapping[str, object]) -> None:
    """Raise `InputError` for options that do not apply to this subject."""
    for name, value in given.items():
        if value:
            raise InputError(f"this option is for {owner}", where=name, next_step="Leave it out")
