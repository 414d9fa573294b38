"""``pkmcal.new``: a session to be filled in, or a whole one of a delta printer."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pkmcal.api.result import Result
from pkmcal.errors import InputError, legible
from pkmcal.firmware.session import printer_session_texts
from pkmcal.mechanisms import catalogue
from pkmcal.outcome import Outcome, Verdict
from pkmcal.outcome.finding import note
from pkmcal.ranges import check_number
from pkmcal.starter import check_new_folder, session_texts, write_texts
from pkmcal.starter.families import FAMILIES, family_model
from pkmcal.starter.nominal import NominalModel, option_of
from pkmcal.starter.sources import SessionTexts, read_source
from pkmcal.wording import listed

SESSION_FILE_DESCRIPTIONS = {
    "session.yaml": "begin here: what to do, step by step",
    "mechanism.yaml": "the nominal model of your machine",
    "cameras/front.yaml": "the calibration of your camera",
    "board.yaml": "the board on the platform",
    "joints.csv": "one row of readings for each configuration",
}
PRINTER_MECHANISM_DESCRIPTION = "the printer by its firmware: see whether its tolerances are right"
PROBED_FILE_DESCRIPTIONS = {
    "session.yaml": "how good the probe is: see whether it is yours",
    "mechanism.yaml": PRINTER_MECHANISM_DESCRIPTION,
    "joints.csv": "the carriages when the bed was probed",
    "poses.csv": "the tool's height above the bed there",
    "distances.csv": "distances on the printed part",
}
"""Descriptions of the files of a complete session of a printer."""
IMAGES_DESCRIPTION = "where the images go"


@dataclass(frozen=True, repr=False)
class NewResult(Result):
    """Files of a new session.

    texts : contents by name. of_printer : whether the nominal model is that of a firmware.
    complete : whether nothing is missing. assumed : dimensions that were not given. remarks : on
    what a printer's configuration leaves open.
    """

    texts: Mapping[str, str]
    of_printer: bool = False
    complete: bool = False
    assumed: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict in one sentence."""
        return Outcome(
            command="new",
            title="New session",
            verdict=Verdict(True, "A session:" if self.complete else "A session to fill in:"),
            findings=(
                *(
                    note("session.assumed_dimension", "mechanism.yaml", option=option_of(name))
                    for name in self.assumed
                ),
                *(
                    note("session.printer_remark", "mechanism.yaml", remark=legible(remark))
                    for remark in self.remarks
                ),
            ),
            document={"files": [*self.texts]},
        )

    @property
    def file_list(self) -> Mapping[str, str]:
        """Files in the order in which they are to be read."""
        probed = self.of_printer and self.complete
        words = dict(PROBED_FILE_DESCRIPTIONS if probed else SESSION_FILE_DESCRIPTIONS)
        if self.of_printer:
            words["mechanism.yaml"] = PRINTER_MECHANISM_DESCRIPTION
        names = [name for name in words if name in self.texts]
        names += sorted(set(self.texts) - set(names))
        return {name: words.get(name, IMAGES_DESCRIPTION) for name in names}

    def contents(self) -> dict[str, str | bytes]:
        """Contents of the files by name."""
        return dict(self.texts)

    @staticmethod
    def check_folder(folder: Path | str) -> None:
        """Raise InputError for a folder that is not empty."""
        check_new_folder(folder)

    def save(self, folder: Path | str, *, force: bool = False) -> None:
        """Write the files into a new or empty folder; InputError for another one."""
        del force
        write_texts(folder, dict(self.texts))

    def path_document(self, folder: Path) -> dict[str, Any]:
        """The session's folder."""
        return {"folder": str(folder)}

    def next_step(self, folder: Path) -> str:
        """The command that is next."""
        place = shlex.quote(str(folder))
        return (
            f"Next: pkmcal calibrate {place}"
            if self.complete
            else f"What is still missing: pkmcal check {place}"
        )


def new(
    machine: Path | str | None = None,
    *,
    board: bool = False,
    legs: bool = False,
    places: int | None = None,
    printer: Path | str | None = None,
    probed: Path | str | None = None,
    part: Path | str | None = None,
    firmware: str | None = None,
    from_file: Path | str | None = None,
    unit: str | None = None,
    base_radius: float | None = None,
    platform_radius: float | None = None,
    leg: float | None = None,
    arm: float | None = None,
    base_spacing: float | None = None,
    platform_spacing: float | None = None,
    arm_angle: float | None = None,
    travel: float | None = None,
    tube_radius: float | None = None,
) -> NewResult:
    """Make a commented session to fill in, or the session of a delta printer, without writing
    files.

    Parameters
    ----------
    machine :
        Name of a built-in machine, or a mechanism file; by default a hexapod to be edited. With
        dimensions a family of machines: ``hexapod``, ``rotary-hexapod``, ``delta`` or
        ``linear-delta``.
    board, legs :
        What the camera observes; by default the legs, or a board if the nominal model has no
        cylinders, or nothing if its readings alone determine the geometry.
    places :
        Number of stations of the camera; 1 by default.
    printer :
        Configuration of a delta printer: Klipper's printer.cfg, RepRapFirmware's config.g with
        M665, Marlin's Configuration.h, Smoothieware's config, what M503 printed (Marlin,
        Smoothieware) or M205 (Repetier-Firmware). The session has its nominal model, and the
        heights of its bed unless ``board``.
    probed :
        Console output of a printer that probed its bed; by default the heights in ``printer``.
    part :
        Distances on a printed part, beside the heights: a YAML file with the commanded positions of
        its marks.
    firmware :
        ``klipper``, ``marlin``, ``repetier``, ``reprap`` or ``smoothie``, for a ``printer`` that
        does not show which it is of.
    from_file :
        MJCF, SDF, or URDF with its file of loops, all with ``tube_radius`` where known; Klipper's
        printer.cfg of a rotary delta or a winch, a Hangprinter's configuration with
        RepRapFirmware's ``M669 K6``, the calibration log of a Maslow 4, or a file of a hexapod's
        joint centres: LinuxCNC's HAL file with pins of genhexkins, or a CSV table with the columns
        leg, base_x, base_y, base_z, platform_x, platform_y, platform_z and their units. Joint
        centres with ``leg``, and where known ``travel`` and ``tube_radius``.
    unit :
        ``mm`` or ``inch``, of the lengths in a HAL file.
    base_radius, platform_radius :
        Radii, m, of the circles through the joints of base (motors, towers) and platform.
    leg :
        Length, m, of a leg at home, or of a leg's rod.
    arm :
        Length, m, of a crank.
    base_spacing, platform_spacing :
        Distances, m, between the joints of a pair of a hexapod; a fifth of the radius by default.
    arm_angle :
        Direction, rad, of the level arms of a rotary hexapod, seen from above: from outwards at
        the middle of their pair (0) towards away from each other (pi / 2, by default); -pi / 2 if
        they face each other.
    travel :
        Range, m, of the legs' lengths or the carriages' readings.
    tube_radius :
        Radius, m, of the legs' cylinders.

    Returns
    -------
    NewResult
        ``texts``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The machine or the printer's file is invalid, the dimensions are those of no machine, or the
        arguments exclude each other.

    """
    check_number("new", "places", places)
    given = {
        "base_radius": base_radius,
        "platform_radius": platform_radius,
        "leg": leg,
        "arm": arm,
        "base_spacing": base_spacing,
        "platform_spacing": platform_spacing,
        "arm_angle": arm_angle,
        "travel": travel,
        "tube_radius": tube_radius,
    }
    dimensions = {name: value for name, value in given.items() if value is not None}
    for name, value in dimensions.items():
        check_number("new", name, value)
    if printer is None:
        _check_no_printer(firmware, probed, part)
        nominal = _nominal(None if machine is None else str(machine), from_file, unit, dimensions)
        return _of_nominal(nominal, board, legs, places)
    others = {"--machine": machine, "--legs": legs}
    others |= {"--probed": probed, "--part": part} if board else {}
    others |= {"--from": from_file, "--unit": unit}
    others |= {option_of(name): True for name in dimensions}
    if extra := [name for name, given in others.items() if given]:
        raise InputError(
            "a printer's session has probed heights, or with --board a board on the tool",
            where="--printer",
            found=" and ".join(extra) + " besides",
            expected="neither --machine nor --legs, and --probed or --board",
        )
    texts, remarks = printer_session_texts(
        Path(printer),
        None if probed is None else Path(probed),
        "board" if board else None,
        places or 1,
        firmware,
        None if part is None else Path(part),
    )
    return NewResult(texts, of_printer=True, complete=not board, remarks=remarks)


def _check_no_printer(
    firmware: str | None, probed: Path | str | None, part: Path | str | None
) -> None:
    """Raise InputError for what only a printer's session has."""
    if firmware is not None:
        raise InputError(
            "a firmware is named for a printer's file",
            where="--firmware",
            expected="--printer FILE besides",
        )
    if probed is not None or part is not None:
        raise InputError(
            "a printer's measurements need its configuration",
            where="--part" if probed is None else "--probed",
            expected="--printer FILE besides: its printer.cfg, its config.g with M665, or what M503"
            " printed",
        )


def _of_nominal(
    nominal: NominalModel | SessionTexts | str | None,
    board: bool,
    legs: bool,
    places: int | None,
) -> NewResult:
    """Session of a nominal model, to be filled in, or the whole one that its file has."""
    if isinstance(nominal, dict):
        others = {"--legs": legs, "--board": board, "--places": places}
        if extra := [name for name, given in others.items() if given]:
            raise InputError(
                "the file has all measurements of its session",
                where="--from",
                found=f"{listed(extra)} besides",
                expected="--from FILE alone",
            )
        return NewResult(nominal, complete=True)
    observed = "both" if board and legs else "board" if board else "legs" if legs else None
    return NewResult(
        session_texts(nominal, observed, places or 1),
        assumed=nominal.assumed if isinstance(nominal, NominalModel) else (),
    )


def _nominal(
    machine: str | None,
    from_file: Path | str | None,
    unit: str | None,
    dimensions: Mapping[str, float],
) -> NominalModel | SessionTexts | str | None:
    """Nominal model or session of a file, or model of a family's dimensions; else ``machine``."""
    if from_file is not None:
        if machine is not None:
            raise InputError(
                "the machine is described twice",
                where="--from",
                found="--machine besides",
                expected="one of them",
            )
        return read_source(Path(from_file), unit, dimensions)
    if unit is not None:
        raise InputError(
            "a unit is named for a file of joint centres",
            where="--unit",
            expected="--from FILE besides",
        )
    # of the families, only those without a built-in machine of their name need dimensions
    if dimensions or machine in FAMILIES.keys() - catalogue().keys():
        return family_model(machine, dimensions)
    return machine
