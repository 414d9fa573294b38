"""The table of ``pkmcal check --repeat``: how repeated photographs scatter, [A] Table 1."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from pkmcal.check.repeats import LegScatter, RepeatStudy

LEGEND = """\
   Standard deviations of one photograph, pooled over the configurations.
   ψ: of the leg's direction in the image. θ: towards the camera. x, z: of its
   point with y = 0, camera frame; – for a leg level in the image, without one.
   θ and z come from the leg's width in the image, so they scatter most.
   Shift, tilt: of its edges, as a whole and at their ends."""


def tell_repeats(out: Console, study: RepeatStudy) -> None:
    """The table, beside the paper's, then what made the repeats differ."""
    from pkmcal.check.repeats import PAPER

    table = console.plain_table(
        "Station", "Leg", "Photos", "ψ", "θ", "x", "z", "Shift", "Tilt"
    )  # fmt: skip
    for row in study.legs:
        _add(table, row, console.escaped(row.station), str(row.leg))
    table.add_section()
    _add(table, study.middle, "median", "")
    _add(table, study.bound, "upper bound", "")
    paper = [_degrees(PAPER.psi), _degrees(PAPER.theta), _millimetres(PAPER.x)]
    table.add_row("[A] Table 1".replace("[", r"\["), "", "", *paper, _millimetres(PAPER.z), "", "")
    out.print()
    out.print(table)
    out.print(LEGEND, style="dim")
    out.print()
    console.print_points(out, [(console.MARKS[f.level], f.text) for f in study.findings])


def _add(table: Table, row: LegScatter, *names: str) -> None:
    table.add_row(
        *names,
        str(row.photographs),
        _degrees(row.psi),
        _degrees(row.theta),
        _millimetres(row.x),
        _millimetres(row.z),
        _pixels(row.shift),
        _pixels(row.tilt),
    )


def _degrees(value: float) -> str:
    return f"{math.degrees(value):.2g}°" if math.isfinite(value) else "–"


def _millimetres(value: float) -> str:
    return f"{value * 1e3:.2g} mm" if math.isfinite(value) else "–"


def _pixels(value: float) -> str:
    return f"{value:.3f} px" if math.isfinite(value) else "–"
