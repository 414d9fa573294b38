"""``pkmcal.simulate``: a simulated session with images and known truth."""

from __future__ import annotations

import shlex
import shutil
import webbrowser
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pkmcal.api.result import Result
from pkmcal.boards.board import Board
from pkmcal.cameras import Camera, load_camera
from pkmcal.errors import InputError
from pkmcal.files import closest, resolved, staged_folder
from pkmcal.files.quantities import in_joint_units
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.outcome import Outcome, Verdict
from pkmcal.outcome.finding import Finding, Level, finding, note
from pkmcal.outcome.progress import Progress, whole
from pkmcal.placement.default_camera import camera_of_size, default_camera
from pkmcal.ranges import GOOD_ENCODER_SIGMA, RANGES, check_number, default
from pkmcal.session.load import Session, load_session
from pkmcal.simulation import Sensor, Settings, Truth, board_for, simulate_session, to_simulate
from pkmcal.simulation.rehearsal import Rehearsal, rehearsal_of
from pkmcal.starter import check_new_folder
from pkmcal.wording import count, listed


@dataclass(frozen=True, repr=False, eq=False)
class SimulationResult(Session, Result):
    """Simulated session, as loaded, with its truth.

    ``document`` is that of the session, as of every session; ``outcome.document`` is that of the
    command.

    truth : true values. cylinders_added : whether the nominal model had no visible cylinders.
    """

    truth: Truth | None = None
    cylinders_added: bool = False

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict with the number of images and stations."""
        images, places = self.images_taken, count(len(self.station_names), "place")
        findings: list[Finding] = []
        if self.cylinders_added:
            findings.append(note("session.cylinders_added", self.machine.name))
        if self.truth and (names := self.truth.unreachable):
            findings.append(finding("session.unreachable", Level.DOUBTFUL, names=names))
        return Outcome(
            command="simulate",
            title=f"Simulated session of {self.machine.name}",
            verdict=Verdict(
                True,
                f"{count(images, 'image')} of {self.machine.name} from {places} in {self.folder};"
                " the truth is in its truth.json, which no calibration reads.",
            ),
            findings=tuple(findings),
            document={
                "photographs": images,
                "stations": self.station_names,
                "seed": self.truth.seed if self.truth else 0,
            },
        )

    @property
    def file_list(self) -> Mapping[str, str]:
        """No list: the files are those of a session."""
        return {}

    def save(self, folder: Path | str, *, force: bool = False) -> None:
        """Copy the session into a new or empty folder; InputError for another one."""
        del force
        check_new_folder(folder)
        if resolved(Path(folder)).is_relative_to(resolved(self.folder)):
            raise InputError(
                "a session is not copied into itself",
                where=str(folder),
                next_step="Name a folder beside it",
                code="output.inside_session",
            )
        with staged_folder(folder) as stage:
            shutil.copytree(self.folder, stage, dirs_exist_ok=True)

    def show(self) -> Path:
        """Open the session's folder in a browser, and return it."""
        webbrowser.open(resolved(self.folder).as_uri())
        return self.folder

    def path_document(self, folder: Path) -> dict[str, Any]:
        """The session's folder."""
        return {"folder": str(folder)}

    def next_step(self, folder: Path) -> str:
        """The command that is next."""
        return f"Next: pkmcal calibrate {shlex.quote(str(folder))}"


def simulate(
    folder: Path | str,
    mechanism: Machine | Path | str = "gough-stewart",
    *,
    camera: Camera | Path | str | tuple[int, int] | None = None,
    board: Board | bool = False,
    on_platform: bool = False,
    noise: float = default("simulate", "noise"),
    blur: float = default("simulate", "blur"),
    joint_noise: float | str | None = None,
    plan: Path | str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **settings: Any,
) -> SimulationResult:
    """Simulate a session in a new folder: images, readings, and the truth in truth.json.

    Parameters
    ----------
    folder :
        A new or empty one.
    mechanism :
        A built-in machine's name, a mechanism file, or a loaded machine. A nominal model without
        visible cylinders gets one on each rod.
    camera :
        A camera, its file, or the image size (width, height) of a small industrial one; by default
        800 x 600 px.
    board :
        A board that every station sees; True for one of a size that suits the machine.
    on_platform :
        Fix the board, the suitable one by default, to the platform instead of the base.
    noise, blur :
        Standard deviations of a pixel's noise, grey levels, and of the lens's blur, px.
    joint_noise :
        Standard deviation of a reading, m or rad, or a text with its unit, such as "3 um"; by
        default the plan's, or 3e-6.
    plan :
        Folder of a plan, whose machine, cameras, stations and configurations are simulated.
        Configurations that the true machine cannot take are left out, with a finding.
    seed :
        Seed for all random numbers.
    progress :
        Called with a text and the share done, 0 to 1.
    settings :
        Further fields of :class:`pkmcal.simulation.Settings`: ``stations=3``,
        ``configurations=15``, ``tolerance=1.0`` (standard deviation of the machine in prior
        sigmas), ``finish="metal"``, ``sensor=`` instead of ``noise`` and
        ``blur``, and so on.

    Returns
    -------
    SimulationResult
        The session, as loaded by :func:`pkmcal.load_session`, with its ``truth``, which
        ``pkmcal.simulation.load_truth(folder)`` reads as well; ``pkmcal.compare`` compares a
        machine with it.

    Raises
    ------
    pkmcal.errors.InputError
        The folder is not empty, or the machine, the camera or a setting is invalid.

    """
    given: dict[str, Any] = {"sensor": Sensor(blur=blur, read_noise=noise), **settings}
    _check_settings({**given, "noise": noise, "blur": blur, "seed": seed})
    planned = None if plan is None else rehearsal_of(plan)
    if planned:
        nominal = planned.machine
    else:
        nominal = mechanism if isinstance(mechanism, Machine) else load_mechanism(mechanism)
    # errors are located at the plan, at the mechanism's file or at the machine's name
    source = mechanism if plan is None else plan
    machine = to_simulate(nominal, nominal.name if isinstance(source, Machine) else str(source))
    place = "platform" if on_platform else settings.get("board_on", "base")
    if isinstance(board, Board):
        fixed = board
    else:
        fixed = board_for(machine, place) if board or on_platform else None
    given |= {"board": fixed, "board_on": place}
    if joint_noise is None:
        joint_noise = planned.joint_noise if planned else GOOD_ENCODER_SIGMA
    reading = in_joint_units(joint_noise, "m or rad", machine.joint_units, "--joint-noise")
    check_number("simulate", "joint_noise", reading)
    setting = Settings(**given, joint_noise=reading)
    eye = planned.cameras if planned else _camera(camera)
    with whole(progress, "Rendering") as report:
        truth = simulate_session(
            folder,
            machine,
            eye,
            _rehearsed(setting, planned) if planned else setting,
            seed=seed,
            progress=lambda done, total: report(f"Image {done} of {total}", done / total),
        )
        session = load_session(folder)
    return SimulationResult.of(session, truth=truth, cylinders_added=machine is not nominal)


def _camera(camera: Camera | Path | str | tuple[int, int] | None) -> Camera:
    """Camera as given, by its file or image size, or the usual one."""
    if camera is None or isinstance(camera, Camera):
        return camera or default_camera()
    return camera_of_size(camera) if isinstance(camera, tuple) else load_camera(camera)


def _rehearsed(settings: Settings, planned: Rehearsal) -> Settings:
    """Settings with the stations, the configurations and the board of a plan."""
    settings = replace(
        settings, stations=planned.places, requested=planned.requested, handheld=planned.handheld
    )
    if planned.board is None:
        return settings
    return replace(settings, board=planned.board, board_on="platform", observe=planned.observe)


def _check_settings(settings: Mapping[str, Any]) -> None:
    """Raise InputError for an unknown setting, and for a number, also of the sensor, that is out of
    range.
    """
    names = [one.name for one in fields(Settings)]
    for name, value in settings.items():
        if name not in (*names, *RANGES["simulate"]):
            guess = closest(name, names)
            raise InputError(
                "a simulation has no such setting",
                found=name,
                expected=guess or listed(names, len(names)),
            )
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
