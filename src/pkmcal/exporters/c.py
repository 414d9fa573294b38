"""``c``: C99 header and source with the machine's parameters and kinematics, and a self-test.

``c_source/`` holds the complete C files with a built-in machine's parameters. An export replaces
the comment on top and the part between two marks; the rest is copied.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import legible
from pkmcal.exporters.contract import Difference, Exporter, exact, largest
from pkmcal.exporters.limbs import (
    CONSTANT_ROD,
    FLOAT_CARRIER,
    SLIDE_CARRIER,
    TURN_CARRIER,
    Limbs,
    rod_limbs,
)
from pkmcal.exporters.samples import samples
from pkmcal.geometry.rigid import cross, dot, perturb
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import inverse_result
from pkmcal.outcome.finding import Finding, note

C_SOURCE_FOLDER = Path(__file__).parent / "c_source"
C_HEADER_FILE, C_SOURCE_FILE, C_SELFTEST_FILE = (
    "pkmcal_kinematics.h",
    "pkmcal_kinematics.c",
    "pkmcal_selftest.c",
)
SELFTEST_PROGRAM = "pkmcal_selftest"
MACHINE_NUMBERS_BEGIN = "/* ---- the machine ---- */\n"
MACHINE_NUMBERS_END = "/* ---- what follows is the same for every machine ---- */\n"
NEXT_LINE = "\n    "
SELFTEST_PAIRS = 12
C_SOURCE_ROUNDING = 1e-12
"""Tolerance, m and rad: a thousand times the rounding of a double at 1 m.

Poses amplify rounding as they approach singular ones.
"""
CONVENTIONS = (
    "Units: m and rad.",
    "pose: R and t map platform coordinates to base coordinates, p_base = R p_platform + t.",
    "twist: omega_x, omega_y, omega_z (rad/s), tau_x, tau_y, tau_z (m/s): R changes by omega x R,"
    " t by tau, both along the base frame's axes.",
    "length of a rod = scale * reading + offset, less what a screw adds that the joints turn; a"
    " slide's way and a crank's turn are scale * reading."
    " Readings in the order of the machine's columns.",
    "C99, math.h alone; no memory is allotted, nothing but the arguments is written, so that all"
    " functions can run at once in several threads. Do not compile with -ffast-math.",
)


@final
class CSource(Exporter):
    """Machine's kinematics as C99, without dependencies."""

    name: ClassVar = "c"
    title: ClassVar = "C99 header and source: inverse and forward kinematics"
    trial: ClassVar = (
        f"cc -std=c99 -O2 pkmcal_*.c -lm -o {SELFTEST_PROGRAM} && ./{SELFTEST_PROGRAM}"
    )
    holds_screws: ClassVar = True
    leaves: ClassVar = (SELFTEST_PROGRAM, f"{SELFTEST_PROGRAM}.exe")

    def files(self, source: MachineSource) -> dict[str, str]:
        """Header, source and self-test."""
        rods = rod_limbs(source.machine)
        about = source.header(*CONVENTIONS)
        sigmas = (
            "",
            "Parameters (sigma: standard deviation of sampling, and of model errors as far as"
            " residuals show them; held: by the choice of frames, or by the mechanism file):",
            *source.sigma_lines(),
        )
        test = (
            "Self-test: reference pairs of readings and poses, computed by pkmcal. Compile and"
            " run:",
            self.trial,
        )
        return {
            C_HEADER_FILE: filled(
                C_SOURCE_FOLDER / C_HEADER_FILE, about, _sizes(source.machine, rods)
            ),
            C_SOURCE_FILE: filled(
                C_SOURCE_FOLDER / C_SOURCE_FILE, (*about, *sigmas), _tables(source.machine, rods)
            ),
            C_SELFTEST_FILE: filled(
                C_SOURCE_FOLDER / C_SELFTEST_FILE, (*source.header(), *test), _pairs(source)
            ),
        }

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences of the constants read from the texts.

        Closure of the machine's equations, home pose and ranges, and readings of the self-test's
        poses.
        """
        machine = source.machine
        poses, joints = samples(machine)
        hinges = inverse_result(machine.layout, machine.values, poses)[1]
        # closure with the constants as they stand in the text
        off = closure_by_source(files[C_SOURCE_FILE], poses, joints, hinges)
        home, ranges = (numbers_of(files[C_SOURCE_FILE], name) for name in ("HOME", "RANGE"))
        T = machine.home()
        same = np.array_equal(home, np.concatenate([T[:3, :3].ravel(), T[:3, 3]]))
        same = same and np.array_equal(ranges.reshape(-1, 2), _bounds(machine))
        # readings of the self-test by the machine's inverse kinematics
        pairs = numbers_of(files[C_SELFTEST_FILE], "POSES").reshape(-1, 12)
        transform = np.tile(np.eye(4), (len(pairs), 1, 1))
        transform[:, :3, :3], transform[:, :3, 3] = pairs[:, :9].reshape(-1, 3, 3), pairs[:, 9:]
        readings = numbers_of(files[C_SELFTEST_FILE], "READINGS").reshape(-1, machine.n_joints)
        return [
            Difference(
                f"closure of the constants read again, at {len(poses)} poses",
                largest(off),
                C_SOURCE_ROUNDING,
            ),
            Difference("home pose and ranges read again", 0.0 if same else np.inf, 0.0),
            Difference(
                f"readings of the self-test's {len(pairs)} poses",
                largest(machine.inverse(transform), readings),
                C_SOURCE_ROUNDING,
                "m or rad",
            ),
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Use of the self-test, and limits of the source."""
        out = [note("export.c_selftest", identity=source.identity)]
        passive = np.flatnonzero(~source.machine.layout.closing) + 1
        if passive.size:
            out.append(note("export.c_passive_legs", legs=", ".join(map(str, passive))))
        if _coupled(source.machine):
            shared = "motor" if source.machine.layout.shares_motors else "bar"
            out.append(note("export.c_no_jacobian", shared=shared))
        return tuple(out)


def _coupled(machine: Machine) -> bool:
    """Whether some reading depends on more than one rod."""
    return machine.layout.shares_motors or machine.layout.n_internal > 0


def _bounds(machine: Machine) -> Array:
    """Smallest and largest readings (m, 2), infinite where the mechanism file has no range."""
    silent = np.array([-np.inf, np.inf])
    return np.where(np.isfinite(machine.joint_ranges), machine.joint_ranges, silent)


# Texts of the files


def filled(path: Path, about: Iterable[str], numbers: str) -> str:
    """C file with another comment on top and another machine's constants."""
    text = path.read_text(encoding="utf-8")
    above, _, below = text.partition(MACHINE_NUMBERS_BEGIN)
    above = above[above.index("*/\n") + 3 :]
    after = below.partition(MACHINE_NUMBERS_END)[2]
    machine = f"{MACHINE_NUMBERS_BEGIN}\n{numbers}\n{MACHINE_NUMBERS_END}"
    return f"{c_comment(about)}{above}{machine}{after}"


def _sizes(machine: Machine, rods: Limbs) -> str:
    """Definitions of the header: numbers of readings and rods."""
    readings = ", ".join(f"joint {k + 1} {unit}" for k, unit in enumerate(machine.joint_units))
    return (
        f"#define PKMCAL_JOINTS {machine.n_joints} /* readings: {readings} */\n"
        f"#define PKMCAL_RODS {len(rods)}\n"
        "/* 1 where several rods share a motor or a bar: readings are then found by iteration. */\n"
        f"#define PKMCAL_COUPLED {int(_coupled(machine))}\n"
    )


def _tables(machine: Machine, rods: Limbs) -> str:
    """Constants of the machine, each in the fewest digits that reproduce it."""
    layout, home = machine.layout, machine.home()
    free = np.argmax(layout.motion, axis=0).tolist()
    away = rods.ends - rods.ends.mean(axis=0)
    radius = float(np.sqrt(np.mean(np.sum(away**2, axis=1)))) or 1.0
    # length scale for rounding
    size = max(
        np.abs(part).max()
        for part in (machine.base_centers(), home[:3, 3], machine.platform_centers())
    )
    defines = (
        f"#define FREEDOMS {len(free)}\n#define HINGES {layout.n_internal}\n"
        f"#define AXES {len(layout.angles)}\n"
        f"#define SIZE {c_number(size)} /* m, the machine's size */\n"
        f"#define RADIUS {c_number(radius)} /* m, the platform's: makes turns lengths */\n"
    )
    note = "of omega_x, omega_y, omega_z, tau_x, tau_y, tau_z those that the platform has"
    return "\n".join(
        [
            defines,
            f"/* {note} */\nstatic const int FREE[FREEDOMS] = {{{', '.join(map(str, free))}}};\n",
            _rods(machine, rods),
            _axes(machine, rods),
            f"static const pkmcal_pose HOME = {_pose(home, between=NEXT_LINE)};\n",
            c_array(
                "RANGE", "[PKMCAL_JOINTS][2]", _bounds(machine), "m or rad, by the mechanism file"
            ),
        ]
    )


def _rods(machine: Machine, rods: Limbs) -> str:
    """Constant RODS: values of each rod in the order of the structure's members.

    C++ does not take designated initializers in C99's form, so the values have no names.
    """
    foot, swing, rate, floating = np.zeros((4, len(rods), 3))
    # a bar's end: foot + cos(phi) swing + sin(phi) rate for a turning bar
    for k, held in enumerate(rods.held):
        bar, w = rods.bar[k], rods.hinge_axis[k]
        if held == TURN_CARRIER:
            foot[k] = dot(w, bar) * w  # the component along the hinge does not turn
            swing[k], rate[k] = bar - foot[k], cross(w, bar)
        if held == FLOAT_CARRIER:
            floating[k] = bar
    out: list[str] = []
    for k, leg in enumerate(rods.leg):
        driven = rods.drive[k] != CONSTANT_ROD
        middle = rods.scale[k] * machine.layout.middle[leg - 1]
        values: dict[str, Any] = {
            "drive": rods.drive[k].upper(),
            "joint": int(rods.joint[k]) if driven else 0,
            "hinge": int(rods.hinge[k]) + 1,
            "scale": rods.scale[k] if driven else 0.0,
            "middle": middle if rods.drive[k] in (SLIDE_CARRIER, TURN_CARRIER) else 0.0,
            "length": rods.length[k],
            "base": rods.base[k],
            "arm": rods.arm[k],
            "rate": rods.rate[k],
            "platform": rods.platform[k] + foot[k],
            "hinge_axis": rods.hinge_axis[k],
            "swing": swing[k],
            "swing_rate": rate[k],
            "floating": floating[k],
            "growth": rods.growth[k],
            "base_axis": rods.screw_base[k],
            "platform_axis": rods.screw_platform[k],
        }
        body = "".join(
            f"        {c_value(value)}, /* {name} */\n" for name, value in values.items()
        )
        out.append(f"    /* leg {leg} of the mechanism file */\n    {{\n{body}    }},\n")
    return f"static const rod_data RODS[PKMCAL_RODS] = {{\n{''.join(out)}}};\n"


def _axes(machine: Machine, rods: Limbs) -> str:
    """Constant AXIS: of each axis equation the rod, the kind, and the axes in base and platform."""
    angles = machine.layout.angles
    base, platform = machine.base_axes(), machine.platform_axes()
    none = np.zeros(3)
    rows: list[tuple[Any, ...]] = []
    for leg, on_base, on_platform in zip(
        angles.leg, angles.on_base, angles.on_platform, strict=True
    ):
        kind = "TORSION" if on_base and on_platform else "ON_BASE" if on_base else "ON_PLATFORM"
        rod = int(np.flatnonzero(rods.leg == leg + 1)[0])
        rows.append(
            (rod, kind, base[leg] if on_base else none, platform[leg] if on_platform else none)
        )
    lines = "".join(
        f"    {{{', '.join(c_value(value) for value in row)}}},\n"
        for row in rows or [(0, "ON_BASE", none, none)]
    )
    return f"/* one row at least */\nstatic const axis_data AXIS[AXES + 1] = {{\n{lines}}};\n"


def _pairs(source: MachineSource) -> str:
    """Reference poses and readings of the self-test, and starts nearby for its iteration."""
    machine = source.machine
    poses, joints = samples(machine, SELFTEST_PAIRS)
    starts = perturb(poses, 0.02 * machine.layout.motion.sum(axis=1))
    # names are free text, and must not end the string literal
    name, identity = (
        "".join(c for c in text if c.isalnum() or c in " -_.,")
        for text in (machine.name, source.identity)
    )
    lists = "\n".join(
        f"static const pkmcal_pose {what}[PAIRS] = {{\n    "
        + ",\n    ".join(_pose(T) for T in of)
        + "\n};\n"
        for what, of in (("POSES", poses), ("STARTS", starts))
    )
    return (
        f'#define MACHINE "{name}"\n#define TESTED "{identity}"\n#define PAIRS {len(poses)}\n\n'
        + c_array("READINGS", "[PAIRS][PKMCAL_JOINTS]", joints)
        + "\n"
        + lists
    )


def _pose(T: Array, between: str = " ") -> str:
    """Pose as a C initializer.

    between : separator of rows.
    """
    rows = f",{between}".join(c_value(row) for row in T[:3, :3])
    return f"{{{{{rows}}},{between}{c_value(T[:3, 3])}}}"


def c_number(value: float) -> str:
    """C constant of the source's number type; integers are written without a point."""
    if not np.isfinite(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    text = exact(value)
    return f"REAL({text})" if any(mark in text for mark in ".e") else text


def c_value(value: Any) -> str:
    """C initializer of a number, of nested rows of numbers, or of a name, which stays as it is."""
    if isinstance(value, str):
        return value
    if np.ndim(value):
        return "{" + ", ".join(c_value(part) for part in value) + "}"
    return c_number(float(value))


def c_array(name: str, shape: str, values: Array | Sequence[Array], note: str = "") -> str:
    """C constant array, one row a line, with a comment above."""
    above = f"/* {note} */\n" if note else ""
    body = ",\n    ".join(c_value(row) for row in values)
    return f"{above}static const pkmcal_real {name}{shape} = {{\n    {body}\n}};\n"


def c_comment(lines: Iterable[str]) -> str:
    """Lines as one C comment; sequences that would end it or join lines are replaced."""
    safe = (
        legible(line).replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").replace("?", ".")
        for line in lines
    )
    wrapped = [part for line in safe for part in textwrap.wrap(line, 96) or [""]]
    body = "\n".join(f" * {line}".rstrip() for line in wrapped)
    return f"/*\n{body}\n */\n"


# Reader of the files

_CONSTANT = re.compile(r"static const \w+ (\w+)")
_NUMBER = re.compile(r"-?INFINITY|[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_WRAPPED = re.compile(r"REAL\(([^()]*)\)")
_WORD = re.compile(r"(?<![\w.])[A-Z_]+")


def _body(text: str, name: str) -> str:
    """Initializer of a constant, with its braces, without comments."""
    plain = _without_comments(text)
    ends = (match.end() for match in _CONSTANT.finditer(plain) if match[1] == name)
    return next((plain[end:].partition("= ")[2].partition(";")[0] for end in ends), "")


def _without_comments(text: str) -> str:
    """C text without its comments."""
    code, *others = text.split("/*")
    return "".join([code, *(other.partition("*/")[2] for other in others)])


def numbers_of(text: str, name: str) -> Array:
    """Numbers of a constant's initializer, flat."""
    huge = {"INFINITY": np.inf, "-INFINITY": -np.inf}
    words = _NUMBER.findall(_body(text, name))
    return np.array([huge[word] if word in huge else float(word) for word in words])


def _records(text: str, name: str, structure: str) -> list[dict[str, Any]]:
    """Rows of a constant as dictionaries by the members of its structure.

    The order of the members is that of the structure's declaration in the text.
    """
    plain = _without_comments(text)
    end = plain.index(f"}} {structure};")
    declared = plain[plain.rindex("{", 0, end) + 1 : end].split(";")[:-1]
    fields = [declaration.split()[-1].partition("[")[0] for declaration in declared]
    listed = _WRAPPED.sub(r"\1", _body(text, name)).translate(str.maketrans("{}", "[]"))
    rows = json.loads(re.sub(r",\s*\]", "]", _WORD.sub(r'"\g<0>"', listed)))
    return [
        {
            field: np.array(value) if isinstance(value, list) else value
            for field, value in zip(fields, row, strict=True)
        }
        for row in rows
    ]


def twist(line: Array, first: Array, second: Array) -> Array:
    """Angles (n,) about lines (n, 3) from axes (3,) to axes (n, 3), modulo pi."""
    u = line / np.linalg.norm(line, axis=1, keepdims=True)
    across = first - dot(u, first)[:, None] * u
    return np.arctan(dot(np.cross(u, across), second) / dot(across, second))


def closure_by_source(text: str, poses: Array, joints: Array, hinges: Array) -> Array:
    """Equations (n, E) of rods and axes, m, evaluated with the constants of a source.

    The formulas are those in the source's comments.

    poses : (n, 4, 4).
    joints : (n, m) readings.
    hinges : (n, h) angles, rad.
    """
    rot = poses[:, :3, :3]
    lines: list[Array] = []
    out: list[Array] = []
    for rod in _records(text, "RODS", "rod_data"):
        # rods: end on the base a, end on the platform b, |b - a| = length
        q = rod["scale"] * joints[:, rod["joint"], None]
        phi = hinges[:, rod["hinge"] - 1, None] if rod["hinge"] else np.zeros(1)
        a, longer = rod["base"], np.zeros(1)
        match rod["drive"]:
            case "TELESCOPE":
                longer = q[:, 0]
            case "SLIDE":
                a = a + q * rod["rate"]
            case "TURN":
                a = a + np.cos(q) * rod["arm"] + np.sin(q) * rod["rate"]
            case _:
                pass
        own = rod["platform"] + np.cos(phi) * rod["swing"] + np.sin(phi) * rod["swing_rate"]
        b = (rot @ own[..., None])[..., 0] + poses[:, :3, 3] + rod["floating"]
        lines.append(b - a)
        if rod["growth"]:
            longer = longer - rod["growth"] * twist(
                b - a, rod["base_axis"], rot @ rod["platform_axis"]
            )
        out.append(np.linalg.norm(b - a, axis=1) - rod["length"] - longer)
    # axes: the rod is perpendicular to an axis, or to the normal of two
    axes = int(re.findall(r"#define AXES (\d+)", text)[0])
    for axis in _records(text, "AXIS", "axis_data")[:axes]:
        turned = (rot @ axis["platform"][:, None])[..., 0]
        w = {
            "ON_BASE": lambda axis=axis: axis["base"],
            "ON_PLATFORM": lambda turned=turned: turned,
            "TORSION": lambda axis=axis, turned=turned: np.cross(axis["base"], turned),
        }[axis["kind"]]()
        out.append(np.sum(lines[axis["rod"]] * w, axis=1))
    return np.stack(out, axis=1)
