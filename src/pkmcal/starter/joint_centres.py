"""Nominal model of a hexapod from a file of its joint centres: LinuxCNC's HAL file with pins of
genhexkins, or a CSV table.

genhexkins (LinuxCNC's src/emc/kinematics): joint N is the length from ``base.N``, in the base
frame, to ``platform.N``, in the platform frame; pins have the unit of the INI file's LINEAR_UNITS.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError, legible
from pkmcal.files import MOST_MACHINE_LEGS, check_count, closest, quoted
from pkmcal.files.quantities import LARGEST_UNITLESS_LENGTH, split_head
from pkmcal.starter.families import DIMENSIONS
from pkmcal.starter.nominal import NominalLeg, NominalModel, Screw, millimetres
from pkmcal.starter.sources import StarterSource
from pkmcal.wording import listed

UNITS: Mapping[str, float] = {"mm": 1e-3, "inch": 0.0254}
"""LinuxCNC's units of length, m."""
STRUTS = 6
PINS = (
    *(f"{group}.{strut}.{axis}" for group, strut, axis in product(
        ("base", "platform", "base-n", "platform-n"), range(STRUTS), "xyz")),
    "screw-lead", "spindle-offset", "tool-offset",
    "convergence-criterion", "limit-iterations", "max-error",
)  # fmt: skip
"""Pins and parameters of genhexkins that a HAL file sets."""
COLUMNS = tuple(f"{end}_{axis}" for end, axis in product(("base", "platform"), "xyz"))
EXPECTED_HEADER = f"leg,{','.join(f'{name} [mm]' for name in COLUMNS)}"
NEEDS, TAKES = ("leg",), ("travel", "tube_radius")
"""Dimensions besides the joint centres."""
_PIN = re.compile(r"^[^\S\n]*setp[^\S\n]+genhexkins\.(\S+)[^\S\n]+(\S+)", re.MULTILINE)


@final
class JointCentres(StarterSource):
    """Joint centres of a hexapod, which need the legs' length at home."""

    title: ClassVar = "a file of joint centres"
    recognised: ClassVar = (
        "LinuxCNC's lines 'setp genhexkins.base.0.x VALUE', or a .csv table with the header"
        f" {EXPECTED_HEADER}"
    )
    options: ClassVar = ("unit", *NEEDS, *TAKES)

    def claims(self, text: str, path: Path) -> bool:
        """Whether a text has pins of genhexkins, or a file is a table."""
        return _PIN.search(text) is not None or path.suffix.lower() == ".csv"

    def read(
        self, text: str, path: Path, unit: str | None, given: Mapping[str, float]
    ) -> NominalModel:
        """Nominal model of the joint centres.

        unit : of a HAL file, ``mm`` or ``inch``. given : dimensions besides the centres, m. Raises
        InputError for missing centres, and for legs that do not reach.
        """
        if "leg" not in given:
            raise InputError(
                "joint centres need the legs' length at home",
                where="--from",
                found=f"{path.name} without --leg",
                expected="--leg LENGTH, and where known --travel and --tube-radius",
            )
        screws: tuple[Screw, ...] | None = None
        if _PIN.search(text):
            base, platform, screws = _of_hal(text, path.name, unit)
        else:
            if unit is not None:
                raise InputError(
                    "a table names its units in its header",
                    where="--unit",
                    expected=EXPECTED_HEADER,
                )
            base, platform = _of_table(text, path.name)
        centres = np.abs(np.hstack([base, platform]))
        leg, column = np.unravel_index(centres.argmax(), centres.shape)
        if centres[leg, column] > LARGEST_UNITLESS_LENGTH:
            raise InputError(
                "a joint centre is too far from the frame's origin",
                where=f"{path.name}, leg {leg + 1}, {COLUMNS[column]}",
                found=f"{centres[leg, column]:.3g} m",
                expected=f"at most {LARGEST_UNITLESS_LENGTH:g} m",
                next_step="Check the unit",
            )
        return _model(base, platform, path.name, given, screws)


def _model(
    base: Array,
    platform: Array,
    label: str,
    given: Mapping[str, float],
    screws: tuple[Screw, ...] | None,
) -> NominalModel:
    """Nominal model of centres (L, 3), m, and of the struts' screws."""
    home = _home(base, platform, given["leg"])
    lengths = np.linalg.norm(platform + home - base, axis=1)
    half = given.get("travel", 0.0) / 2
    sweep = (float(lengths.min()) - half, float(lengths.max()) + half) if half else None
    if sweep is not None and sweep[0] <= 0:
        raise InputError(
            "the shortest leg would have no length",
            where="--travel",
            found=millimetres(2 * half),
            expected=f"less than {millimetres(2 * float(lengths.min()))}",
        )
    return NominalModel(
        "hexapod",
        (
            f"A hexapod by the joint centres in {legible(label)}: legs of variable length, in"
            " that file's order. A reading is the leg's length"
            + (", with what a screw adds that its joints turn." if screws else "."),
        ),
        tuple(
            (f"{name}: {millimetres(given[name])}", *DIMENSIONS[name])
            for name in (*NEEDS, *TAKES)
            if name in given
        ),
        "spatial",
        tuple(
            NominalLeg.telescope(a, b, sweep, screw)
            for a, b, screw in zip(base, platform, screws or [None] * len(base), strict=True)
        ),
        home,
        given.get("tube_radius"),
    )


def _home(base: Array, platform: Array, leg: float) -> Array:
    """Position (3,) of the platform, without rotation and above the base, at which legs have the
    root mean square length ``leg``.
    """
    gap = platform - base
    across = gap[:, :2] - gap[:, :2].mean(axis=0)
    # mean of across^2 + (z + gap_z)^2 = leg^2
    rest = leg**2 - np.sum(across**2, axis=1).mean() - gap[:, 2].var()
    if rest <= 0:
        raise InputError(
            "the legs do not reach the platform at home",
            where="--leg",
            found=millimetres(leg),
            expected=f"more than {millimetres(np.sqrt(leg**2 - rest))}, by these joint centres",
        )
    return np.array([*-gap[:, :2].mean(axis=0), np.sqrt(rest) - gap[:, 2].mean()])


def _of_hal(
    text: str, label: str, unit: str | None
) -> tuple[Array, Array, tuple[Screw, ...] | None]:
    """Centres (6, 3) of base and platform, m, and the struts' screws, of pins of genhexkins."""
    if unit not in UNITS:
        raise InputError(
            f"{label} does not name the unit of its values",
            where="--unit",
            found=unit,
            expected=f"{listed(list(UNITS))}: LINEAR_UNITS in the INI file".replace(
                " and ", " or "
            ),
        )
    pins = {name: (value, m) for m in _PIN.finditer(text) for name, value in [m.groups()]}
    for name, (_, match) in pins.items():
        if name not in PINS:
            another_strut = re.fullmatch(r"(base|platform)(-n)?\.\d+\.[xyz]", name)
            guess = None if another_strut else closest(name, PINS)
            raise InputError(
                "genhexkins has no such pin",
                where=f"{label}, line {_line(text, match)}",
                found=quoted(f"genhexkins.{name}"),
                expected=f"genhexkins.{guess}" if guess else "pins of six struts, from 0 to 5",
            )

    def pin(name: str, what: str) -> float:
        if name not in pins:
            raise InputError(
                f"{what} is incomplete",
                where=label,
                found=f"no genhexkins.{name}",
                expected=f"setp genhexkins.{name} VALUE",
            )
        value, match = pins[name]
        return _number(value, f"{label}, line {_line(text, match)}, genhexkins.{name}")

    def vectors(group: str, what: str) -> Array:
        names = ([f"{group}.{strut}.{axis}" for axis in "xyz"] for strut in range(STRUTS))
        return np.array([[pin(name, what) for name in row] for row in names])

    base, platform = (UNITS[unit] * vectors(x, "a joint centre") for x in ("base", "platform"))
    lead = pin("screw-lead", "a screw") if "screw-lead" in pins else 0.0
    if lead == 0:
        return base, platform, None
    axes = np.stack([vectors(f"{end}-n", "a screw's axis") for end in ("base", "platform")], axis=1)
    size = np.linalg.norm(axes, axis=-1, keepdims=True)
    if not size.all():
        raise InputError(
            "a joint's axis has no direction",
            where=label,
            found="0, 0, 0",
            expected="genhexkins.base-n.N and genhexkins.platform-n.N as unit vectors",
        )
    return base, platform, tuple(Screw(lead * UNITS[unit], *pair) for pair in axes / size)


def _line(text: str, match: re.Match[str]) -> int:
    """Line, from 1, of a pin."""
    return text.count("\n", 0, match.start(1)) + 1


def _of_table(text: str, label: str) -> tuple[Array, Array]:
    """Centres (L, 3) of base and platform, m, of a table."""
    rows = [
        (number, [cell.strip() for cell in row])
        for number, row in enumerate(csv.reader(io.StringIO(text.removeprefix("\ufeff"))), 1)
        if any(cell.strip() for cell in row)
    ]
    heads = [split_head(head) for head in (rows[0][1] if rows else [])]
    names = [name.lower() for name, _ in heads]
    if names != ["leg", *COLUMNS]:
        raise InputError(
            "the table's columns are not those of joint centres",
            where=f"{label}, line {rows[0][0] if rows else 1}",
            found=quoted(",".join(names)),
            expected=EXPECTED_HEADER,
            next_step=_other_table(rows[0][1] if rows else []),
        )
    if wrong := [name for name, head_unit in heads[1:] if head_unit and head_unit.kind != "m"]:
        raise InputError(
            "a joint centre is a length",
            where=f"{label}, line {rows[0][0]}",
            found=f"another unit of {wrong[0]}",
            expected="m, mm or in",
        )
    check_count(len(rows) - 1, MOST_MACHINE_LEGS, "legs", label)
    if len(rows) - 1 < STRUTS:
        raise InputError(
            "a platform with six degrees of freedom has six legs or more",
            where=label,
            found=f"{len(rows) - 1} rows",
            expected=f"{STRUTS} or more",
        )
    values = np.empty((len(rows) - 1, 6))
    lines = dict[str, int]()
    for row, (line, cells) in enumerate(rows[1:]):
        if lines.setdefault(cells[0], line) != line:
            raise InputError(
                "two rows have one leg",
                where=f"{label}, line {line}, leg",
                found=quoted(cells[0]),
                expected=f"another leg than that of line {lines[cells[0]]}",
            )
        if len(cells) != len(names):
            raise InputError(
                "a row has another number of cells than the header",
                where=f"{label}, line {line}",
                found=len(cells),
                expected=len(names),
            )
        for k, cell in enumerate(cells[1:]):
            values[row, k] = _number(cell, f"{label}, line {line}, {COLUMNS[k]}")
    values *= [1.0 if head_unit is None else head_unit.factor for _, head_unit in heads[1:]]
    return values[:, :3], values[:, 3:]


def _other_table(header: Sequence[str]) -> str | None:
    """Next step for a header of a kind that occurs."""
    if len(header) == 1 and ";" in header[0]:
        return "Separate the columns by commas, and write decimal points"
    if any(re.search(r"phi|angle|radius|_r\b", head.lower()) for head in header):
        return "Write x, y and z, or polar centres in mechanism.yaml (docs/files.md)"
    return None


def _number(text: str, where: str) -> float:
    """Finite number of a text."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(
            "this is not a number", where=where, found=quoted(text), expected="a finite number"
        )
    return value
