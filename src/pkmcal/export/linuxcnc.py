"""``linuxcnc``: HAL pins of genhexkins, lineardeltakins, rotarydeltakins, and words for the INI.

Meaning of the pins: LinuxCNC's src/emc/kinematics. genhexkins' joint is the strut's length from
``base.N`` to ``platform.N``; A, B, C are roll, pitch and yaw in degrees, R = Rz(C) Ry(B) Rx(A).
With HOME_ABSOLUTE_ENCODER a joint is at the encoder's position plus HOME_OFFSET (homing.c), so
offsets stand there.
"""

from __future__ import annotations

import re
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.export.c_tables import Tables, tables_of
from pkmcal.export.contract import Difference, Exporter
from pkmcal.export.delta import DEGREE, MM
from pkmcal.export.linuxcnc_delta import delta_check, delta_files, delta_notes
from pkmcal.export.samples import samples
from pkmcal.export.source import Source
from pkmcal.export.text import commented, exact, sigma_lines
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Finding, Level

HAL, INI = "pkmcal_kinematics.hal", "pkmcal_kinematics.ini"
STRUTS = 6
MAX_ERROR = 500.0
"""genhexkins' own limit on the sum of the struts' errors, beyond which it gives up."""
ROUNDING = 1e-12
"""m: pins hold 17 digits; angles go through degrees and back."""
_SETP = re.compile(r"^setp genhexkins\.(base|platform)\.(\d)\.([xyz]) (\S+)$", re.M)
_OFFSET = re.compile(r"^HOME_OFFSET = (\S+)$", re.M)


@final
class LinuxCnc(Exporter):
    """HAL and INI lines for hexapods and ideal deltas."""

    name: ClassVar = "linuxcnc"
    title: ClassVar = "LinuxCNC: kinematics' HAL pins and INI words"

    def files(self, source: Source) -> dict[str, str]:
        """A HAL file and words for the INI file."""
        if source.machine.document.motion == "translation":
            return dict(zip((HAL, INI), delta_files(source), strict=True))
        tables = _hexapod(source.machine)
        return {HAL: _hal(source, tables), INI: _ini(source, tables)}

    def check(self, files: dict[str, str], source: Source) -> list[Difference]:
        """The pins and words read again, and genhexkins' own inverse kinematics."""
        if source.machine.document.motion == "translation":
            return delta_check(files[HAL], files[INI], source)
        poses, readings = samples(source.machine)
        offsets = np.array([float(word) for word in _OFFSET.findall(files[INI])])
        joints = genhexkins(files[HAL], world(poses))
        off = np.abs((joints - offsets) / MM - readings).max()
        return [
            Difference(
                f"readings at {len(poses)} poses by genhexkins' formulas", float(off), ROUNDING
            )
        ]

    def notes(self, files: dict[str, str], source: Source) -> tuple[Finding, ...]:
        """Where offsets went."""
        del files
        if source.machine.document.motion == "translation":
            return delta_notes(source)
        return (
            Finding(
                Level.NOTE,
                "Offsets are HOME_OFFSET words: copy the INI file's sections into the machine's"
                " own INI file, and source the HAL file after genhexkins is loaded.",
            ),
        )


def _hexapod(machine: Machine) -> Tables:
    """The machine's numbers where genhexkins can express it; else InputError."""
    carriers = {leg.base.joint for leg in machine.document.legs}
    driven = bool(machine.layout.rod_reads[machine.layout.closing].all())
    rods = int(machine.layout.closing.sum())
    axes = len(machine.layout.angles)
    ok = machine.document.motion == "spatial" and rods == STRUTS and driven and not axes
    if not ok or machine.layout.n_internal:
        raise InputError(
            f"LinuxCNC's genhexkins moves six telescopic legs on fixed joints, and mechanism"
            f" {machine.name!r} is another machine",
            found=f"motion {machine.document.motion}, {rods} rods on {', '.join(sorted(carriers))}"
            f" joints, {int(machine.layout.rod_reads.sum())} of them telescopic"
            + (f", {axes} equations of axes" if axes else ""),
            expected="a hexapod; or a linear or rotary delta, for lineardeltakins, rotarydeltakins",
            next_step="Export it with --to c, and build a kinematics module from that",
        )
    return tables_of(machine)


def _about(source: Source) -> tuple[str, ...]:
    return source.header(
        "Units: mm and degrees. Strut N is joint N; base.N in the base frame, platform.N in the"
        " platform frame.",
        "XYZ is the platform frame's origin in the base frame; A, B, C are roll, pitch and yaw,"
        " R = Rz(C) Ry(B) Rx(A).",
        "Joint N is the strut's length = 1000 * (reading + offset); the offset is HOME_OFFSET.",
    )


def _hal(source: Source, t: Tables) -> str:
    order = np.argsort(t.joint)
    limit = max(MAX_ERROR, STRUTS * float(np.nanmax(_limits(t), initial=0.0)))
    lines = [
        commented((*_about(source), "", *sigma_lines(source, ("center", "offset"))), "#"),
        "loadrt genhexkins\n",
    ]
    for n, rod in enumerate(order):
        lines.append(f"# strut {n}: leg {t.leg[rod]} of the mechanism file")
        for name, values in (("base", t.base), ("platform", t.arm_fixed)):
            lines += [
                f"setp genhexkins.{name}.{n}.{axis} {exact(MM * value)}"
                for axis, value in zip("xyz", values[rod].tolist(), strict=True)
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


def _limits(t: Tables) -> Array:
    """Smallest and largest strut lengths (6, 2) mm in the order of the joints."""
    order = np.argsort(t.joint)
    return MM * (t.ranges[t.joint[order]] + t.length[order, None])


def _ini(source: Source, t: Tables) -> str:
    order = np.argsort(t.joint)
    home = world(t.home[None])[0]
    lines = [
        commented(
            (
                *_about(source),
                "HOME_OFFSET holds for absolute encoders that read 1000 * reading. With a home"
                " switch, set HOME_ABSOLUTE_ENCODER = 0 and add 1000 * the reading at the switch.",
            ),
            "#",
        ),
        "[KINS]\nKINEMATICS = genhexkins\nJOINTS = 6\n",
        "[TRAJ]\nCOORDINATES = XYZABC\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree",
        "# where forward kinematics begins",
        f"HOME = {' '.join(f'{v:.6f}' for v in home + 0.0)}",
    ]
    for n, (rod, (low, high)) in enumerate(zip(order, _limits(t).tolist(), strict=True)):
        lines.append(f"\n[JOINT_{n}]\nTYPE = LINEAR\nHOME_ABSOLUTE_ENCODER = 2")
        lines.append(f"HOME_OFFSET = {exact(float(MM * t.length[rod]))}")
        if np.isfinite(low) and np.isfinite(high):
            lines.append(f"MIN_LIMIT = {low:.4f}\nMAX_LIMIT = {high:.4f}")
    return "\n".join(lines) + "\n"


def world(poses: Array) -> Array:
    """X, Y, Z (mm), A, B, C (degrees) of poses (n, 4, 4); (n, 6)."""
    r = poses[:, :3, :3]
    roll = np.arctan2(r[:, 2, 1], r[:, 2, 2])
    pitch = np.arctan2(-r[:, 2, 0], np.hypot(r[:, 2, 1], r[:, 2, 2]))
    yaw = np.arctan2(r[:, 1, 0], r[:, 0, 0])
    turns = np.stack([roll, pitch, yaw], axis=1) * DEGREE
    return np.concatenate([MM * poses[:, :3, 3], turns], axis=1)


def genhexkins(hal: str, pose: Array) -> Array:
    """Joints (n, 6) mm at X, Y, Z, A, B, C (n, 6), by the pins that a HAL file sets."""
    pins = {name: np.zeros((STRUTS, 3)) for name in ("base", "platform")}
    for name, strut, axis, value in _SETP.findall(hal):
        pins[name][int(strut), "xyz".index(axis)] = float(value)
    (sa, sb, sc), (ca, cb, cc) = np.sin(pose[:, 3:].T / DEGREE), np.cos(pose[:, 3:].T / DEGREE)
    rows = [
        [cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa],
        [sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa],
        [-sb, cb * sa, cb * ca],
    ]
    rot = np.array(rows).transpose(2, 0, 1)
    end = pins["platform"] @ rot.transpose(0, 2, 1) + pose[:, None, :3]
    return np.linalg.norm(end - pins["base"], axis=-1)
