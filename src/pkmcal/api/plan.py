"""``pkmcal.plan``: the next configurations to measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from threadpoolctl import threadpool_limits

from pkmcal.api.result import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, FolderResult
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.cameras import Camera, load_camera
from pkmcal.errors import InputError
from pkmcal.files.quantities import in_joint_units
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, part, whole
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.stations import PANORAMIC_HALF_VIEW, view_angle
from pkmcal.planning.defaults import PLANNED_IMAGE_SIZE, STATIONS_AROUND_A_MACHINE
from pkmcal.planning.plan import MeasurementPlan, plan_measurements
from pkmcal.planning.subject import Subject, as_it_stands, of_machine
from pkmcal.ranges import check_number, default
from pkmcal.report.plan import PLAN_STATIONS_FILE, PLAN_TABLE_FILE, outcome_of
from pkmcal.session.load import Session, load_session_to_plan, session_folder
from pkmcal.simulation import board_for


@dataclass(frozen=True, repr=False, eq=False)
class PlanResult(FolderResult, MeasurementPlan):
    """Plan with its files: ``joints``, ``names``, ``promised``, ``now``."""

    own_files = MappingProxyType(
        {
            "plan.html": PAGE_DESCRIPTION,
            PLAN_TABLE_FILE: "the readings, in the order to be measured",
            "plan.json": NUMBERS_DESCRIPTION,
            PLAN_STATIONS_FILE: "the places, for session.yaml",
        }
    )
    kind = ("what plan writes", "an earlier plan")

    @cached_property
    def outcome(self) -> Outcome:
        """Tables, figures and sections of the page."""
        return outcome_of(self)

    @property
    def file_list(self) -> Mapping[str, str]:
        """Files of the plan, with those of its stations if these were chosen."""
        return {
            name: what
            for name, what in self.own_files.items()
            if name != PLAN_STATIONS_FILE or self.tried
        }


def plan(
    subject: Session | Machine | Path | str,
    *,
    count: int = default("plan", "configurations"),
    places: int | None = None,
    best_of: int | None = None,
    after: SavedCalibration | Path | str | None = None,
    from_drawing: bool = False,
    same_place: bool = False,
    together: bool | None = None,
    camera: Camera | Path | str | tuple[int, int] | None = None,
    board: bool = False,
    tracker: tuple[float, float | None] | None = None,
    edge_noise: float = default("plan", "edge_noise"),
    corner_noise: float = default("plan", "corner_noise"),
    joint_noise: float | str = default("plan", "joint_noise"),
    reading_resolution: float | str = default("plan", "reading_resolution"),
    play: float | str = default("plan", "play"),
    seed: int = 0,
    progress: Progress | None = None,
) -> PlanResult:
    """Choose the configurations that determine a machine best, without writing files.

    Parameters
    ----------
    subject :
        A session or its folder, with its existing measurements; or a machine, the name of a
        built-in one or a mechanism file, with an assumed camera.
    count :
        Number of configurations at each station.
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
        Camera or its file, or the image size (width, height) of a small industrial one, by default
        1280 x 960 px; machines only. It has three stations, or one if a board, a panoramic camera
        or ``places`` needs no more.
    board :
        Observe a board on the platform instead of the legs; machines only.
    tracker :
        Standard deviations of the positions (m) and turns (rad; None if it measures points) of a
        tracker instead of a camera; machines only.
    edge_noise, corner_noise :
        Standard deviations of edges and of a board's corners without images, px.
    joint_noise :
        Standard deviation of a reading, m or rad, or a text with its unit, such as "3 um"; machines
        only.
    reading_resolution, play :
        Step of the readings, and by how much a drive's positions at one reading differ with the
        side from which it comes, as ``joint_noise``. They count as noise; machines only.
    seed :
        Seed for all random numbers.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    PlanResult
        ``joints`` (n, m), ``names``, ``T_base_platform`` (n, 4, 4) in the order of measurement;
        ``now``, ``promised`` and ``by_chance``, standard deviations of the tool;
        ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The subject or an option does not allow a plan.

    """
    numbers = {"edge_noise": edge_noise, "corner_noise": corner_noise, "seed": seed}
    for name, value in numbers.items():
        check_number("plan", name, value)
    for value in tracker or ():
        check_number("plan", "tracker", value)
    folder = None if isinstance(subject, Session | Machine) else session_folder(str(subject))
    region, where = None, None
    with threadpool_limits(1, "blas"), whole(progress, "Reading the nominal model") as report:
        if isinstance(subject, Session) or folder is not None:
            of_machines = {"--camera": camera, "--board": board, "--tracker": tracker}
            steps = {"--reading-resolution": reading_resolution, "--play": play}
            _check_options("a machine", of_machines | steps)
            session = (
                subject if isinstance(subject, Session) else load_session_to_plan(folder or "")
            )
            region = session.workspace
            report("Reading the measurements", 0.02)
            begin = 0.3
            planned = as_it_stands(
                session, after, from_nominal=from_drawing, same_place=same_place,
                anywhere=places is not None, edge=edge_noise, corner=corner_noise, seed=seed,
            )  # fmt: skip
        else:
            begin = 0.05
            _check_options(
                "a session", {"--after": after, "--same-place": same_place, "--best-of": best_of}
            )
            planned, where = _of_machine(
                subject, camera, board, bool(places),
                {"joint_noise": joint_noise, "reading_resolution": reading_resolution,
                 "play": play},
                tracker=tracker, edge=edge_noise, corner=corner_noise, seed=seed,
            )  # fmt: skip
        choosing = partial(part(report, begin, 1), "Choosing configurations")
        try:
            value = plan_measurements(
                planned, count=count, region=region, together=together,
                free_stations=places, best_of=best_of, seed=seed,
                progress=choosing,
            )  # fmt: skip
        except InputError as error:
            raise error if where is None else error.located(where) from None
        return PlanResult.of(value)


def _of_machine(
    subject: Machine | Path | str,
    camera: Camera | Path | str | tuple[int, int] | None,
    board: bool,
    places: bool,
    readings: Mapping[str, float | str],
    **noise: Any,
) -> tuple[Subject, str]:
    """Machine with an assumed camera, and the location of its errors: the camera's or the machine's
    name as given.

    places : whether stations are chosen. readings : their noise, resolution and play, by the names
    of the options. noise : of edges, corners and the tracker.
    """
    machine = subject if isinstance(subject, Machine) else load_mechanism(str(subject))
    numbers: dict[str, Any] = {}
    for option, value in readings.items():
        where = f"--{option.replace('_', '-')}"
        numbers[option] = in_joint_units(value, "m or rad", machine.joint_units, where)
        check_number("plan", option, numbers[option])
    name = machine.name if isinstance(subject, Machine) else str(subject)
    if camera is None or isinstance(camera, tuple):
        eye = camera_of_size(camera or PLANNED_IMAGE_SIZE)
    else:
        eye = camera if isinstance(camera, Camera) else load_camera(camera)
    one = board or places or view_angle(eye) > PANORAMIC_HALF_VIEW
    try:
        planned = of_machine(
            machine,
            [eye] * (1 if one else STATIONS_AROUND_A_MACHINE),
            machine.joint_names,
            board=board_for(machine, "platform") if board else None,
            **numbers,
            **noise,
        )
    except InputError as error:
        raise error.located(name) from None
    return planned, str(camera) if isinstance(camera, Path | str) else name


def _check_options(owner: str, given: Mapping[str, object]) -> None:
    """Raise `InputError` for options that do not apply to this subject."""
    for name, value in given.items():
        if value:
            raise InputError(
                f"this option is for {owner}",
                where=name,
                next_step="Leave it out",
                code="option.not_applicable",
            )
