"""LinuxCNC kinematics module around the C export, for machines without a module in LinuxCNC.

Coordinates are the platform's degrees of freedom: X, Y, Z in mm, A, B, C in degrees. A joint is a
calibrated reading, in mm or degrees. ``halcompile`` builds the module;
``linuxcnc_source/pkmcal_kins.c`` is the text around the C source, with the built-in hexapod's
constants.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.c import C_HEADER_FILE, C_SELFTEST_FILE, CSource, c_value, filled, numbers_of
from pkmcal.exporters.contract import Difference, largest
from pkmcal.exporters.delta import DEGREES_A_RADIAN, MM_A_METRE
from pkmcal.mechanisms import Machine

MODULE_NAME = "pkmcal_kins"
MODULE_SOURCE_FOLDER = Path(__file__).parent / "linuxcnc_source"
MODULE_SOURCE_FILE = f"{MODULE_NAME}.c"
MODULE_BUILD_COMMAND = f"sudo halcompile --install {MODULE_SOURCE_FILE}"
MODULE_CONVENTIONS = (
    "LinuxCNC's units: mm and degrees. X, Y, Z are the platform frame's origin in the base frame;"
    " A, B, C are roll, pitch and yaw, R = Rz(C) Ry(B) Rx(A); where the platform turns about z"
    " alone, C counts from its orientation at home.",
    "Joint N is reading N + 1 of the machine, as it was calibrated: mm, or degrees of a crank."
    " Scales and offsets are in the kinematics.",
    f"Build it with: {MODULE_BUILD_COMMAND}",
)
COORDINATE_LETTERS = "ABCXYZ"
"""Letters of the degrees of freedom omega_x, omega_y, omega_z, tau_x, tau_y, tau_z."""


def joint_units(machine: Machine) -> Array:
    """Ratio of LinuxCNC's joints to the readings (m,), mm/m or degrees/rad."""
    return np.array(
        [MM_A_METRE if unit == "m" else DEGREES_A_RADIAN for unit in machine.joint_units]
    )


def linuxcnc_coordinates(machine: Machine) -> str:
    """LinuxCNC's letters of the platform's degrees of freedom, X first.

    Raises InputError if the number of joints differs from theirs: not every command would be a
    pose.
    """
    free = np.argmax(machine.layout.motion, axis=0).tolist()
    if len(free) != machine.n_joints:
        raise InputError(
            "LinuxCNC moves as many joints as coordinates, and mechanism"
            f" {machine.name!r} is another machine",
            found=f"{machine.n_joints} readings, motion {machine.document.motion} with"
            f" {len(free)} freedoms",
            expected="as many of both",
            next_step="Export it with --to c, and choose coordinates of your own",
            code="export.joints_not_coordinates",
        )
    return "".join(sorted((COORDINATE_LETTERS[k] for k in free), key="XYZABC".index))


def module_files(source: MachineSource) -> dict[str, str]:
    """C source and header, and the module around them."""
    linuxcnc_coordinates(source.machine)
    files = CSource().files(source)
    del files[C_SELFTEST_FILE]
    # constants of type double, without the macro of the C source's number type
    plain = c_value(joint_units(source.machine)).replace("REAL(", "").replace(")", "")
    units = f"static const double JOINT_UNITS[PKMCAL_JOINTS] = {plain};\n"
    numbers = f"/* LinuxCNC's joint is the reading times this: mm/m or degrees/rad */\n{units}"
    about = source.header(*MODULE_CONVENTIONS)
    files[MODULE_SOURCE_FILE] = filled(MODULE_SOURCE_FOLDER / MODULE_SOURCE_FILE, about, numbers)
    return files


def module_differences(files: dict[str, str], source: MachineSource) -> list[Difference]:
    """Differences of the C source, read as in the C export, and of the joints' units."""
    own = CSource().files(source)
    units = numbers_of(files[MODULE_SOURCE_FILE], "JOINT_UNITS")
    again = {C_SELFTEST_FILE: own[C_SELFTEST_FILE], **files}
    off = largest(units, joint_units(source.machine))
    return [
        *CSource().check(again, source),
        Difference("the header's sizes", float(files[C_HEADER_FILE] != own[C_HEADER_FILE]), 0.0),
        Difference("joints' units read again", off, 0.0, "mm/m or degrees/rad"),
    ]
