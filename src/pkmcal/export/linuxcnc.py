"""``linuxcnc``: HAL pins of genhexkins, lineardeltakins, rotarydeltakins, and words for the INI.

Meaning of the pins: LinuxCNC's src/emc/kinematics. genhexkins' joint is the strut's length from
``base.N`` to ``platform.N``; A, B, C are roll, pitch and yaw in degrees, R = Rz(C) Ry(B) Rx(A).
With HOME_ABSOLUTE_ENCODER a joint is at the encoder's position plus HOME_OFFSET (homing.c), so
offsets stand there.

Both delta modules know ideal deltas alone: one radius, one length of rods, towers 120 degrees
apart; they are fitted. Joint 0 of lineardeltakins is the tower at (0, R), joints 1 and 2 are at 210
and 330 degrees; rotarydeltakins' arms are at -90, 30 and 150 degrees, and turn downwards
(lineardeltakins-common.h, rotarydeltakins-common.h; some older rotarydeltakins exchange joints 1
and 2).
"""

from __future__ import annotations

import re
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.source import MachineSource
from pkmcal.errors import InputError
from pkmcal.export.contract import Difference, Exporter, commented, exact, largest
from pkmcal.export.delta import (
    DEGREES_A_RADIAN,
    MM_A_METRE,
    UNTOLD_SCALE_DIFFERENCE,
    Fit,
    Freedoms,
    about,
    firmware_angle,
    firmware_length,
    firmware_tool_difference,
    fit_of,
    follows,
)
from pkmcal.export.limbs import Limbs, rod_limbs
from pkmcal.export.samples import samples
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Finding, Level

LINUXCNC_HAL_FILE, LINUXCNC_INI_FILE = "pkmcal_kinematics.hal", "pkmcal_kinematics.ini"
PROGRAM = "LinuxCNC"
LINUXCNC_LINEAR_FREEDOMS = Freedoms((90.0, 210.0, 330.0), angles=False, rods=False)
LINUXCNC_ROTARY_FREEDOMS = Freedoms(
    (-90.0, 30.0, 150.0), angles=False, rods=False, arms=False, flat=True
)
GENHEXKINS_STRUTS = 6
HEXAPOD_PARAMETERS = ("center", "offset", "scale")
MAX_ERROR = 500.0
"""genhexkins' own limit on the sum of the struts' errors, beyond which it gives up."""
LINUXCNC_READING_ROUNDING = 1e-12
"""m: pins hold 17 digits; angles go through degrees and back."""
_STRUT = re.compile(r"^setp genhexkins\.(base|platform)\.(\d)\.([xyz]) (\S+)$", re.M)
_PIN = re.compile(r"^setp \w+deltakins\.(\w+) (\S+)$", re.M)
_OFFSET = re.compile(r"^HOME_OFFSET = (\S+)$", re.M)
_RATE = re.compile(r"^# joint \d = (\S+) \* reading", re.M)
SCALE_CORRECTION_ADVICE = "Divide its SCALE in the INI file, steps or counts per unit, by that."


@final
class LinuxCnc(Exporter):
    """HAL and INI lines for hexapods and ideal deltas."""

    name: ClassVar = "linuxcnc"
    title: ClassVar = "LinuxCNC: kinematics' HAL pins and INI words"

    def files(self, source: MachineSource) -> dict[str, str]:
        """A HAL file and words for the INI file."""
        if source.machine.document.motion == "translation":
            fit = _fit(source)
            return {
                LINUXCNC_HAL_FILE: _delta_hal(source, fit),
                LINUXCNC_INI_FILE: _delta_ini(source, fit),
            }
        struts = _hexapod(source.machine)
        return {LINUXCNC_HAL_FILE: _hal(source, struts), LINUXCNC_INI_FILE: _ini(source, struts)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Pins and words read again, moved by LinuxCNC's own formulas."""
        hal, machine = files[LINUXCNC_HAL_FILE], source.machine
        offsets = np.array([float(word) for word in _OFFSET.findall(files[LINUXCNC_INI_FILE])])
        if machine.document.motion == "translation":
            fit = _fit(source)
            pins = {name: float(value) for name, value in _PIN.findall(hal)}
            if fit.kind == "linear":
                return [
                    firmware_tool_difference(hal, fit, lambda p: linear_joints(pins, p), offsets)
                ]
            # motors count upwards, LinuxCNC's joints downwards
            return [firmware_tool_difference(hal, fit, lambda p: -rotary_joints(pins, p), -offsets)]
        poses, readings = samples(machine)
        rates = np.array([float(word) for word in _RATE.findall(files[LINUXCNC_INI_FILE])])
        off = largest((genhexkins(hal, world(poses)) - offsets) / rates, readings)
        return [
            Difference(
                f"readings at {len(poses)} poses by genhexkins' formulas",
                off,
                LINUXCNC_READING_ROUNDING,
            )
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Where offsets went, or how well the pins follow the machine."""
        if source.machine.document.motion == "translation":
            return (follows(_fit(source)),)
        return (
            Finding(
                Level.NOTE,
                "Offsets are HOME_OFFSET words: copy the INI file's sections into the machine's"
                " own INI file, and source the HAL file after genhexkins is loaded.",
            ),
        )


# Hexapods


def _hexapod(machine: Machine) -> Limbs:
    """The struts in the order of the joints where genhexkins can express the machine; else
    InputError.
    """
    layout = machine.layout
    rods, axes = int(layout.closing.sum()), len(layout.angles)
    ok = machine.document.motion == "spatial" and rods == GENHEXKINS_STRUTS and not axes
    if not ok or not layout.rod_reads[layout.closing].all() or layout.n_internal:
        joints = sorted({leg.base.joint for leg in machine.document.legs})
        raise InputError(
            f"LinuxCNC's genhexkins moves six telescopic legs on fixed joints, and mechanism"
            f" {machine.name!r} is another machine",
            found=f"motion {machine.document.motion}, {rods} rods on {', '.join(joints)}"
            f" joints, {int(layout.rod_reads.sum())} of them telescopic"
            + (f", {axes} equations of axes" if axes else ""),
            expected="a hexapod; or a linear or rotary delta, for lineardeltakins, rotarydeltakins",
            next_step="Export it with --to c, and build a kinematics module from that",
        )
    struts = rod_limbs(machine)
    return struts.of(np.argsort(struts.joint))


def _hexapod_header(source: MachineSource) -> tuple[str, ...]:
    return source.header(
        "Units: mm and degrees. Strut N is joint N; base.N in the base frame, platform.N in the"
        " platform frame.",
        "XYZ is the platform frame's origin in the base frame; A, B, C are roll, pitch and yaw,"
        " R = Rz(C) Ry(B) Rx(A).",
        "Joint N is the strut's length = 1000 * (scale * reading + offset); 1000 * offset is"
        " HOME_OFFSET, and the scale belongs to the joint's own SCALE, steps or counts a mm.",
    )


def _limits(machine: Machine, struts: Limbs) -> Array:
    """Smallest and largest strut lengths (6, 2) mm."""
    ways = struts.scale[:, None] * machine.joint_ranges[struts.joint]
    return MM_A_METRE * (ways + struts.length[:, None])


def _hal(source: MachineSource, struts: Limbs) -> str:
    limits = _limits(source.machine, struts)
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
        "# spindle-offset. screw-lead stays 0, and base-n.*, platform-n.* unused: readings are",
        "# taken to be lengths, without the turn of a screw that is not held.",
    ]
    return "\n".join(lines) + "\n"


def _ini(source: MachineSource, struts: Limbs) -> str:
    home = world(source.machine.home()[None])[0]
    lines = [
        commented(
            (
                *_hexapod_header(source),
                "HOME_OFFSET holds for absolute encoders that read 1000 * scale * reading. With a"
                " home switch, set HOME_ABSOLUTE_ENCODER = 0 and add 1000 * scale * the reading at"
                " the switch.",
            ),
            "#",
        ),
        "[KINS]\nKINEMATICS = genhexkins\nJOINTS = 6\n",
        "[TRAJ]\nCOORDINATES = XYZABC\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree",
        "# where forward kinematics begins",
        f"HOME = {' '.join(f'{v:.6f}' for v in home + 0.0)}",
    ]
    for n, (low, high) in enumerate(_limits(source.machine, struts).tolist()):
        scale = float(struts.scale[n])
        lines.append(f"\n[JOINT_{n}]\nTYPE = LINEAR\nHOME_ABSOLUTE_ENCODER = 2")
        lines.append(f"# joint {n} = {exact(MM_A_METRE * scale)} * reading + HOME_OFFSET")
        if abs(scale - 1) > UNTOLD_SCALE_DIFFERENCE:
            lines.append(f"# {SCALE_CORRECTION_ADVICE.replace('that', exact(scale))}")
        lines.append(f"HOME_OFFSET = {exact(float(MM_A_METRE * struts.length[n]))}")
        if np.isfinite(low) and np.isfinite(high):
            lines.append(f"MIN_LIMIT = {low:.4f}\nMAX_LIMIT = {high:.4f}")
    return "\n".join(lines) + "\n"


def world(poses: Array) -> Array:
    """X, Y, Z (mm), A, B, C (degrees) of poses (n, 4, 4); (n, 6)."""
    r = poses[:, :3, :3]
    roll = np.arctan2(r[:, 2, 1], r[:, 2, 2])
    pitch = np.arctan2(-r[:, 2, 0], np.hypot(r[:, 2, 1], r[:, 2, 2]))
    yaw = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    turns = np.stack([roll, pitch, yaw], axis=1) * DEGREES_A_RADIAN
    return np.concatenate([MM_A_METRE * poses[:, :3, 3], turns], axis=1)


def genhexkins(hal: str, pose: Array) -> Array:
    """Joints (n, 6) mm at X, Y, Z, A, B, C (n, 6), by the pins that a HAL file sets."""
    pins = {name: np.zeros((GENHEXKINS_STRUTS, 3)) for name in ("base", "platform")}
    for name, strut, axis, value in _STRUT.findall(hal):
        pins[name][int(strut), "xyz".index(axis)] = float(value)
    angle = pose[:, 3:].T / DEGREES_A_RADIAN
    (sa, sb, sc), (ca, cb, cc) = np.sin(angle), np.cos(angle)
    rows = [
        [cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa],
        [sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa],
        [-sb, cb * sa, cb * ca],
    ]
    rot = np.array(rows).transpose(2, 0, 1)
    end = pins["platform"] @ rot.transpose(0, 2, 1) + pose[:, None, :3]
    return np.linalg.norm(end - pins["base"], axis=-1)


# Deltas


def _fit(source: MachineSource) -> Fit:
    return fit_of(source, PROGRAM, LINUXCNC_LINEAR_FREEDOMS, LINUXCNC_ROTARY_FREEDOMS)


def _delta_hal(source: MachineSource, fit: Fit) -> str:
    lines = about(source, fit, "012", SCALE_CORRECTION_ADVICE)
    lines = [line for line in lines if not line.startswith("End switches")]
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


def _delta_ini(source: MachineSource, fit: Fit) -> str:
    linear = fit.kind == "linear"
    sign = 1.0 if linear else -1.0  # arms count downwards
    rate, zero = sign * fit.rate, sign * fit.zero
    word, number = ("LINEAR", firmware_length) if linear else ("ANGULAR", firmware_angle)
    ini = [
        commented(
            (
                *source.header(),
                f"Units: mm and degrees. Joint N = rate * reading + HOME_OFFSET; rates are"
                f" {', '.join(f'{r:.9g}' for r in rate)}, the encoders' scales.",
                "HOME_OFFSET holds for absolute encoders. With a home switch, set"
                " HOME_ABSOLUTE_ENCODER = 0 and add rate * the reading at the switch.",
            ),
            "#",
        ),
        f"[KINS]\nKINEMATICS = {fit.kind}deltakins\nJOINTS = 3\n",
        "[TRAJ]\nCOORDINATES = XYZ\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree",
    ]
    ranges = fit.delta.machine.joint_ranges[fit.delta.joint][fit.order]
    for n in range(3):
        ends = np.sort(rate[n] * ranges[n] + zero[n])
        ini.append(f"\n[JOINT_{n}]\nTYPE = {word}\nHOME_ABSOLUTE_ENCODER = 2")
        ini.append(f"HOME_OFFSET = {number(zero[n])}")
        ini.append(f"MIN_LIMIT = {ends[0]:.4f}\nMAX_LIMIT = {ends[1]:.4f}")
    return "\n".join(ini) + "\n"


def linear_joints(pins: dict[str, float], points: Array) -> Array:
    """Joints (n, 3) mm at points (n, 3) mm."""
    half, side = 0.5 * pins["R"], np.sqrt(3) / 2 * pins["R"]
    towers = np.array([[0.0, pins["R"]], [-side, -half], [side, -half]])
    d = towers - points[:, None, :2]
    return points[:, 2:] + np.sqrt(pins["L"] ** 2 - d[..., 0] ** 2 - d[..., 1] ** 2)


def rotary_joints(pins: dict[str, float], points: Array) -> Array:
    """Joints (n, 3) degrees at points (n, 3) mm, downwards: joint 0 swings in the YZ plane, the
    others are it, the point turned.
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
