"""``linuxcnc``: kinematics for LinuxCNC, and entries for its INI file.

Three cases. Hexapods: pins of genhexkins, exact. Deltas that lineardeltakins or rotarydeltakins
approximate to some hundredths of a millimetre: their pins, fitted. All other machines with as many
joints as coordinates, leaning towers too: a generated module, exact (:mod:`.linuxcnc_module`).

Semantics of the pins: LinuxCNC's src/emc/kinematics. genhexkins' joint is the strut's length from
``base.N`` to ``platform.N``; A, B, C are roll, pitch and yaw in degrees, R = Rz(C) Ry(B) Rx(A).

Homing (src/emc/motion/homing.c): with HOME_ABSOLUTE_ENCODER = 2 a joint is at the encoder's
position plus HOME_OFFSET, and nothing moves. Otherwise the position of the switch, or the present
one if both velocities are 0, becomes HOME_OFFSET, and the joint then moves to HOME, without soft
limits, at HOME_FINAL_VEL. A latch velocity without a search velocity is an error, upon which
nothing moves.

Both delta modules know ideal deltas only: one radius, one rod length, towers 120 degrees apart;
they are fitted. Joint 0 of lineardeltakins is the tower at (0, R), joints 1 and 2 are at 210 and
330 degrees; rotarydeltakins' arms are at -90, 30 and 150 degrees, and turn downwards
(lineardeltakins-common.h, rotarydeltakins-common.h; some older versions of rotarydeltakins
exchange joints 1 and 2).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.c import C_HEADER_FILE, C_SOURCE_FILE
from pkmcal.exporters.contract import Difference, Exporter, commented, exact, largest
from pkmcal.exporters.delta import (
    DEGREES_A_RADIAN,
    MM_A_METRE,
    UNWARNED_TOOL_ERROR,
    Fit,
    Freedoms,
    fit_of,
)
from pkmcal.exporters.delta_texts import (
    UNTOLD_SCALE_DIFFERENCE,
    about,
    firmware_length,
    firmware_tool_difference,
    scales_of,
)
from pkmcal.exporters.limbs import Limbs, rod_limbs
from pkmcal.exporters.linuxcnc_module import (
    MODULE_BUILD_COMMAND,
    MODULE_CONVENTIONS,
    MODULE_NAME,
    MODULE_SOURCE_FILE,
    joint_units,
    linuxcnc_coordinates,
    module_differences,
    module_files,
)
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import apply, dot
from pkmcal.mechanisms import Machine
from pkmcal.outcome.finding import Finding, note

LINUXCNC_HAL_FILE, LINUXCNC_INI_FILE = "pkmcal_kinematics.hal", "pkmcal_kinematics.ini"
PROGRAM = "LinuxCNC"
LINUXCNC_LINEAR_FREEDOMS = Freedoms((90.0, 210.0, 330.0), angles=False, rods=False)
LINUXCNC_ROTARY_FREEDOMS = Freedoms(
    (-90.0, 30.0, 150.0), angles=False, rods=False, arms=False, flat=True
)
GENHEXKINS_STRUTS = 6
HEXAPOD_PARAMETERS = ("center", "offset", "scale")
MAX_ERROR = 500.0
"""genhexkins' default limit on the sum of the struts' errors, beyond which it gives up."""
LINUXCNC_READING_ROUNDING = 1e-12
"""Tolerance, m: pins hold all digits; angles are converted to degrees and back."""
_STRUT = re.compile(
    r"^setp genhexkins\.(base|platform|base-n|platform-n)\.(\d)\.([xyz]) (\S+)$", re.M
)
_LEAD = re.compile(r"^setp genhexkins\.screw-lead (\S+)$", re.M)
_PIN = re.compile(r"^setp \w+deltakins\.(\w+) (\S+)$", re.M)
_WORD = re.compile(r"^([A-Z_]+) = (\S+)$", re.M)
_RATE = re.compile(r"^# joint \d = (\S+) \* reading", re.M)
SCALE_CORRECTION_ADVICE = "Divide its SCALE in the INI file, steps or counts per unit, by that."
HOME_FINAL_VELOCITY = 5.0
"""Velocity to HOME, mm/s or degrees/s; without it LinuxCNC uses the joint's largest velocity."""
UNSEARCHED_LATCH_VELOCITY = 1.0
"""Latch velocity without a search velocity; any value but 0.

LinuxCNC then refuses to home a joint that has no absolute encoder.
"""
HOMING_CONVENTIONS = (
    "Homing by these values is for absolute encoders: LinuxCNC sets joint = encoder + HOME_OFFSET"
    " where the machine is, and moves nothing. The encoder counts as in the comment of the joint's"
    " section.",
    "With a home switch, in each joint's section: HOME_ABSOLUTE_ENCODER = 0; HOME_OFFSET = the"
    " joint at the switch, by that comment; HOME_SEARCH_VEL and HOME_LATCH_VEL of your own. After"
    " the switch LinuxCNC moves the joint to HOME, with soft limits off, each joint by itself, at"
    " HOME_FINAL_VEL.",
    "With neither, for a machine that is put into its home pose by hand: HOME_ABSOLUTE_ENCODER = 0,"
    " HOME_LATCH_VEL = 0, HOME_OFFSET = HOME; nothing moves.",
    "HOME_LATCH_VEL without HOME_SEARCH_VEL is an error without an absolute encoder: so LinuxCNC"
    " does not take the present place for the switch's and move to HOME.",
)


@dataclass(frozen=True)
class Joints:
    """Joints (J,) of LinuxCNC, mm or degrees: rate * reading + offset.

    kind : LINEAR or ANGULAR.
    home : at the machine's home pose.
    limits : (J, 2), not finite where the mechanism file has no range.
    scale : of the readings; a joint's SCALE is to be corrected by it unless it is 1.
    """

    kind: tuple[str, ...]
    rate: Array
    offset: Array
    home: Array
    limits: Array
    scale: Array


def _joints(
    machine: Machine, columns: Integers, rate: Array, offset: Array, scale: Array
) -> Joints:
    """Joints that follow some columns of readings. Raises InputError if home is beyond a limit."""
    # joints at home, and limits at the ends of the readings' ranges
    readings = machine.inverse(machine.home()[None])[0][columns]
    home = rate * readings + offset
    limits = np.sort(rate[:, None] * machine.joint_ranges[columns] + offset[:, None], axis=1)
    if (home < limits[:, 0]).any() or (home > limits[:, 1]).any() or not np.isfinite(home).all():
        raise InputError(
            f"the home pose of mechanism {machine.name!r} is beyond a joint's range",
            found=", ".join(f"{value:.6g}" for value in readings),
            expected="readings within the ranges, which become LinuxCNC's limits",
            next_step="Give home: {position: [x, y, z]} in the mechanism file, or wider ranges",
            code="export.home_outside_range",
        )
    kind = tuple("LINEAR" if machine.joint_units[k] == "m" else "ANGULAR" for k in columns)
    return Joints(kind, rate, offset, home, limits, scale)


def joint_sections(joints: Joints) -> list[str]:
    """Section of each joint, with the entries for homing."""
    lines: list[str] = []
    for n, kind in enumerate(joints.kind):
        lines.append(f"\n[JOINT_{n}]\nTYPE = {kind}")
        sign = "-" if joints.offset[n] < 0 else "+"
        lines.append(
            f"# joint {n} = {exact(joints.rate[n])} * reading {sign} {exact(abs(joints.offset[n]))}"
        )
        if abs(joints.scale[n] - 1) > UNTOLD_SCALE_DIFFERENCE:
            lines.append(f"# {SCALE_CORRECTION_ADVICE.replace('that', exact(joints.scale[n]))}")
        words = {
            "HOME_ABSOLUTE_ENCODER": 2,
            "HOME_OFFSET": joints.offset[n],
            "HOME": joints.home[n],
            "HOME_SEQUENCE": 0,
            "HOME_SEARCH_VEL": 0,
            "HOME_LATCH_VEL": UNSEARCHED_LATCH_VELOCITY,
            "HOME_FINAL_VEL": HOME_FINAL_VELOCITY,
        }
        low, high = joints.limits[n]
        if np.isfinite(low) and np.isfinite(high):
            words.update({"MIN_LIMIT": low, "MAX_LIMIT": high})
        lines += [f"{word} = {exact(value)}" for word, value in words.items()]
    return lines


def _ini(about: tuple[str, ...], module: str, letters: str, home: Array, joints: Joints) -> str:
    """INI file.

    home : (6,) X, Y, Z mm, A, B, C degrees.
    """
    # coordinates that the machine lacks are 0, as forward kinematics leaves them
    world_home = [
        float(value) if letter in letters else 0.0
        for letter, value in zip("XYZABC", home, strict=True)
    ]
    lines = [
        commented((*about, *HOMING_CONVENTIONS), "#"),
        f"[KINS]\nKINEMATICS = {module}\nJOINTS = {len(joints.kind)}\n",
        f"[TRAJ]\nCOORDINATES = {letters}\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree",
        "# where forward kinematics begins",
        f"HOME = {' '.join(f'{value:.6f}' for value in np.round(world_home, 6) + 0.0)}",
    ]
    return "\n".join([*lines, *joint_sections(joints)]) + "\n"


def ini_words(ini: str, word: str) -> Array:
    """Values of an entry in the joints' sections."""
    own = ini[ini.index("[JOINT_0]") :]
    return np.array([float(value) for name, value in _WORD.findall(own) if name == word])


def homing_difference(ini: str, joints: Joints) -> Difference:
    """Difference of rates, offsets, home and limits in the text.

    Infinite if home is beyond a limit.
    """
    rates = np.array([float(word) for word in _RATE.findall(ini)])
    offset, home = ini_words(ini, "HOME_OFFSET"), ini_words(ini, "HOME")
    low, high = ini_words(ini, "MIN_LIMIT"), ini_words(ini, "MAX_LIMIT")
    bounded = np.isfinite(joints.limits).all(axis=1)
    off = max(
        largest(rates, joints.rate),
        largest(offset, joints.offset),
        largest(home, joints.home),
        largest(np.stack([low, high], axis=1), joints.limits[bounded]),
    )
    if (home[bounded] < low).any() or (home[bounded] > high).any():
        off = np.inf
    return Difference("joints' home, offsets and limits read again", off, 0.0, "mm or degrees")


def _kind(source: MachineSource) -> Limbs | Fit | None:
    """Built-in kinematics for the machine: struts of genhexkins, the fit of a delta, or None."""
    if source.machine.document.motion != "translation":
        return _hexapod(source.machine)
    try:
        fit = fit_of(source, PROGRAM, LINUXCNC_LINEAR_FREEDOMS, LINUXCNC_ROTARY_FREEDOMS)
    except InputError:  # not a delta, or one that the parameters do not describe
        return None
    return fit if fit.largest <= UNWARNED_TOOL_ERROR else None


@final
class LinuxCnc(Exporter):
    """HAL and INI lines for hexapods and ideal deltas; a kinematics module for other machines."""

    name: ClassVar = "linuxcnc"
    title: ClassVar = "LinuxCNC: kinematics, and INI words"
    holds_screws: ClassVar = True
    leaves: ClassVar = (
        *(LINUXCNC_HAL_FILE, LINUXCNC_INI_FILE),
        *(C_HEADER_FILE, C_SOURCE_FILE, MODULE_SOURCE_FILE, f"{MODULE_NAME}.so"),
    )

    def files(self, source: MachineSource) -> dict[str, str]:
        """HAL file or source of a module, and the INI file's entries."""
        kind = _kind(source)
        if kind is None:
            return {**module_files(source), LINUXCNC_INI_FILE: _module_ini(source)}
        if isinstance(kind, Fit):
            texts = _delta_hal(source, kind), _delta_ini(source, kind)
        else:
            texts = _hal(source, kind), _hexapod_ini(source, kind)
        return dict(zip((LINUXCNC_HAL_FILE, LINUXCNC_INI_FILE), texts, strict=True))

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences by LinuxCNC's own formulas, with the pins and entries of the texts."""
        ini, machine, kind = files[LINUXCNC_INI_FILE], source.machine, _kind(source)
        if kind is None:
            homing = homing_difference(ini, _module_joints(machine))
            return [*module_differences(files, source), homing]
        hal, offsets = files[LINUXCNC_HAL_FILE], ini_words(ini, "HOME_OFFSET")
        if isinstance(kind, Fit):
            homing = homing_difference(ini, _delta_joints(kind))
            pins = {name: float(value) for name, value in _PIN.findall(hal)}
            if kind.kind == "linear":
                move, zero = (lambda p: linear_joints(pins, p)), offsets
            else:  # motors count upwards, LinuxCNC's joints downwards
                move, zero = (lambda p: -rotary_joints(pins, p)), -offsets
            return [firmware_tool_difference(hal, kind, move, zero), homing]
        poses, readings = samples(machine)
        rates = np.array([float(word) for word in _RATE.findall(ini)])
        off = largest((genhexkins(hal, world(poses)) - offsets) / rates, readings)
        what = f"readings at {len(poses)} poses by genhexkins' formulas"
        return [
            Difference(what, off, LINUXCNC_READING_ROUNDING),
            homing_difference(ini, _hexapod_joints(machine, kind)),
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Use of the files, and agreement of pins and machine."""
        kind = _kind(source)
        if isinstance(kind, Fit):
            return (kind.following, note("export.linuxcnc_homing"))
        if kind is None:
            build = {"command": MODULE_BUILD_COMMAND, "module": MODULE_NAME}
            return (note("export.linuxcnc_module", **build),)
        return (note("export.linuxcnc_genhexkins"),)


# Machines with a generated module


def _module_joints(machine: Machine) -> Joints:
    """Joints of the generated module: the readings in mm or degrees."""
    columns, none = np.arange(machine.n_joints), np.zeros(machine.n_joints)
    return _joints(machine, columns, joint_units(machine), none, none + 1)


def _module_ini(source: MachineSource) -> str:
    """INI file for the generated module."""
    machine = source.machine
    home = world(machine.home()[None])[0]
    letters = linuxcnc_coordinates(machine)
    if "A" not in letters:
        home[3:] = 0.0  # C counts from the orientation at home
    return _ini(
        source.header(*MODULE_CONVENTIONS), MODULE_NAME, letters, home, _module_joints(machine)
    )


# Hexapods


def _hexapod(machine: Machine) -> Limbs | None:
    """Struts in the order of the joints if genhexkins can express the machine, else None."""
    layout = machine.layout
    rods, axes = int(layout.closing.sum()), len(layout.angles)
    ok = machine.document.motion == "spatial" and rods == GENHEXKINS_STRUTS and not axes
    if not ok or not layout.rod_reads[layout.closing].all() or layout.n_internal:
        return None
    struts = rod_limbs(machine)
    if np.ptp(struts.growth) > 0:  # genhexkins has one lead for all struts
        return None
    return struts.of(np.argsort(struts.joint))


def _screw_pins(machine: Machine, struts: Limbs) -> list[str]:
    """Lines of genhexkins' lead and axes.

    genhexkins takes the arc sine of the turn, so axes on both ends of a strut have one sense.
    """
    lead = 2 * np.pi * float(struts.growth[0])
    if lead == 0:
        return [
            "# screw-lead stays 0, and base-n.*, platform-n.* unused: readings are lengths.",
        ]
    R = machine.home()[:3, :3]
    sense = np.sign(np.sum(struts.screw_base * (struts.screw_platform @ R.T), axis=1))
    lines = [f"setp genhexkins.screw-lead {exact(MM_A_METRE * lead)}"]
    for name, values in (
        ("base-n", struts.screw_base),
        ("platform-n", sense[:, None] * struts.screw_platform),
    ):
        lines += [
            f"setp genhexkins.{name}.{n}.{axis} {exact(value)}"
            for n, row in enumerate(values)
            for axis, value in zip("xyz", row.tolist(), strict=True)
        ]
    return lines


def _hexapod_header(source: MachineSource) -> tuple[str, ...]:
    """Header lines on the conventions of genhexkins."""
    return source.header(
        "Units: mm and degrees. Strut N is joint N; base.N in the base frame, platform.N in the"
        " platform frame.",
        "XYZ is the platform frame's origin in the base frame; A, B, C are roll, pitch and yaw,"
        " R = Rz(C) Ry(B) Rx(A).",
        "Joint N is the strut's length, with what screw-lead adds, = 1000 * (scale * reading +"
        " offset); 1000 * offset is HOME_OFFSET, and the scale belongs to the joint's own SCALE,"
        " steps or counts a mm. An absolute encoder then counts 1000 * scale * reading.",
    )


def _hexapod_joints(machine: Machine, struts: Limbs) -> Joints:
    """Joints of a hexapod: the lengths of its struts."""
    rate, offset = MM_A_METRE * struts.scale, MM_A_METRE * struts.length
    return _joints(machine, struts.joint, rate, offset, struts.scale)


def _hal(source: MachineSource, struts: Limbs) -> str:
    """HAL file of a hexapod: genhexkins' pins."""
    limits = _hexapod_joints(source.machine, struts).limits
    limit = max(MAX_ERROR, GENHEXKINS_STRUTS * float(np.nanmax(limits, initial=0.0)))
    lines = [
        commented((*_hexapod_header(source), "", *source.sigma_lines(HEXAPOD_PARAMETERS)), "#"),
        "# your own HAL file loads it before: loadrt genhexkins\n",
    ]
    for n, leg in enumerate(struts.leg):
        lines.append(f"# strut {n}: leg {leg} of the mechanism file")
        for name, values in (("base", struts.base), ("platform", struts.platform)):
            lines += [
                f"setp genhexkins.{name}.{n}.{axis} {exact(MM_A_METRE * value)}"
                for axis, value in zip("xyz", values[n].tolist(), strict=True)
            ]
    lines += [
        "",
        "# Newton's iteration of forward kinematics",
        "setp genhexkins.convergence-criterion 1e-9",
        "setp genhexkins.limit-iterations 120",
        f"setp genhexkins.max-error {limit:.0f}",
        "",
        "# Not in this file: tool-offset (net motion.tooloffset.z genhexkins.tool-offset) and",
        "# spindle-offset.",
        *_screw_pins(source.machine, struts),
    ]
    return "\n".join(lines) + "\n"


def _hexapod_ini(source: MachineSource, struts: Limbs) -> str:
    """INI file of a hexapod."""
    home = world(source.machine.home()[None])[0]
    joints = _hexapod_joints(source.machine, struts)
    return _ini(_hexapod_header(source), "genhexkins", "XYZABC", home, joints)


def world(poses: Array) -> Array:
    """Coordinates (n, 6) of poses (n, 4, 4): X, Y, Z in mm, A, B, C in degrees."""
    r = poses[:, :3, :3]
    roll = np.arctan2(r[:, 2, 1], r[:, 2, 2])
    pitch = np.arctan2(-r[:, 2, 0], np.hypot(r[:, 2, 1], r[:, 2, 2]))
    yaw = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    turns = np.stack([roll, pitch, yaw], axis=1) * DEGREES_A_RADIAN
    return np.concatenate([MM_A_METRE * poses[:, :3, 3], turns], axis=1)


def genhexkins(hal: str, pose: Array) -> Array:
    """Joints (n, 6) mm at coordinates (n, 6), by genhexkins' formulas.

    hal : HAL file that sets the pins.
    """
    names = ("base", "platform", "base-n", "platform-n")
    pins = {name: np.zeros((GENHEXKINS_STRUTS, 3)) for name in names}
    for name, strut, axis, value in _STRUT.findall(hal):
        pins[name][int(strut), "xyz".index(axis)] = float(value)
    # R = Rz(C) Ry(B) Rx(A)
    angle = pose[:, 3:].T / DEGREES_A_RADIAN
    (sa, sb, sc), (ca, cb, cc) = np.sin(angle), np.cos(angle)
    rows = [
        [cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa],
        [sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa],
        [-sb, cb * sa, cb * ca],
    ]
    rot = np.array(rows).transpose(2, 0, 1)
    end = pins["platform"] @ rot.transpose(0, 2, 1) + pose[:, None, :3]
    strut = end - pins["base"]
    length = np.linalg.norm(strut, axis=-1)
    lead = _LEAD.search(hal)
    if lead is None:
        return length
    # the base's axis across the strut, and the platform's normal to it, as unit vectors
    u = strut / length[..., None]
    second = np.cross(u, np.cross(pins["base-n"], u))
    across = np.cross(pins["platform-n"] @ rot.transpose(0, 2, 1), u)
    sine = dot(second, across) / np.sqrt(dot(second, second) * dot(across, across))
    return length + float(lead[1]) * np.arcsin(sine) / (2 * np.pi)


# Deltas


def _delta_hal(source: MachineSource, fit: Fit) -> str:
    """HAL file of a delta: pins of lineardeltakins or rotarydeltakins."""
    lines = about(source, fit, "012", SCALE_CORRECTION_ADVICE)
    if fit.kind == "linear":
        pins = [
            f"setp lineardeltakins.R {firmware_length(fit.radius)}",
            f"setp lineardeltakins.L {firmware_length(fit.rod[0])}",
        ]
    else:
        lines.append("LinuxCNC's joints are the motors' angles with the other sign: downwards.")
        pins = [
            "# of platformradius and footradius the difference alone moves the machine",
            f"setp rotarydeltakins.platformradius {firmware_length(fit.radius)}",
            "setp rotarydeltakins.footradius 0.0000",
            f"setp rotarydeltakins.thighlength {firmware_length(fit.arm[0])}",
            f"setp rotarydeltakins.shinlength {firmware_length(fit.rod[0])}",
        ]
    loaded = f"# your own HAL file loads it before: loadrt {fit.kind}deltakins"
    return "\n".join([commented(lines, "#"), loaded, *pins]) + "\n"


def _delta_joints(fit: Fit) -> Joints:
    """Joints of a delta."""
    sign = 1.0 if fit.kind == "linear" else -1.0  # arms count downwards
    columns = fit.delta.joint[fit.order]
    zero = np.round(sign * fit.zero, 5 if sign < 0 else 4)
    return _joints(fit.delta.machine, columns, sign * fit.rate, zero, scales_of(fit))


def _delta_ini(source: MachineSource, fit: Fit) -> str:
    """INI file of a delta."""
    about = source.header("Units: mm and degrees. An absolute encoder counts rate * reading.")
    at = MM_A_METRE * apply(fit.T_firmware_base, source.machine.home()[:3, 3])
    home = np.append(at, np.zeros(3))
    return _ini(about, f"{fit.kind}deltakins", "XYZ", home, _delta_joints(fit))


def linear_joints(pins: dict[str, float], points: Array) -> Array:
    """Joints (n, 3) mm at points (n, 3) mm, by lineardeltakins' formulas."""
    half, side = 0.5 * pins["R"], np.sqrt(3) / 2 * pins["R"]
    towers = np.array([[0.0, pins["R"]], [-side, -half], [side, -half]])
    d = towers - points[:, None, :2]
    return points[:, 2:] + np.sqrt(pins["L"] ** 2 - d[..., 0] ** 2 - d[..., 1] ** 2)


def rotary_joints(pins: dict[str, float], points: Array) -> Array:
    """Joints (n, 3) degrees, downwards, at points (n, 3) mm, by rotarydeltakins' formulas.

    Joint 0 swings in the YZ plane; the others are computed as joint 0 for the point turned by 120
    degrees.
    """
    pfr, thigh, shin, foot = (
        pins[name] for name in ("platformradius", "thighlength", "shinlength", "footradius")
    )
    z = points[:, 2]
    out: list[Array] = []
    for turn in (0.0, -120.0, 120.0):
        c, s = np.cos(turn / DEGREES_A_RADIAN), np.sin(turn / DEGREES_A_RADIAN)
        x, y = points[:, 0] * c - points[:, 1] * s, points[:, 0] * s + points[:, 1] * c
        a = 0.5 * (x**2 + (y - foot) ** 2 + z**2 + thigh**2 - shin**2 - pfr**2) / z
        b = (foot - pfr - y) / z
        knee = (pfr + a * b + np.sqrt(thigh**2 * (b**2 + 1) - (a - b * pfr) ** 2)) / (b**2 + 1)
        out.append(np.arctan2(b * knee - a, knee - pfr) * DEGREES_A_RADIAN)
    return np.stack(out, axis=1)
