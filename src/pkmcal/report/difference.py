"""Difference of two machines as an outcome: tables, and plots of joints and tool."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.toolmap import ToolMap
from pkmcal.errors import GeometryError
from pkmcal.identify.centres import Centres
from pkmcal.judge.difference import MachineDifference
from pkmcal.levels import ROUNDING
from pkmcal.outcome import Figure, Level, Outcome, Part, Row, Table
from pkmcal.outcome.blocks.base import leg_key
from pkmcal.outcome.blocks.plot import (
    BarsMark,
    Colour,
    Plot,
    Point,
    category_axis,
    linear_axis,
    rounded,
)
from pkmcal.outcome.blocks.space import Space, SpaceArrows
from pkmcal.report.space import (
    ELLIPSOID_SIGMAS,
    changes,
    ellipsoids,
    small_vector,
    start_enlargements,
)
from pkmcal.report.watch import NO_VALUE_SIGN
from pkmcal.report.workspace import middle_and_worst
from pkmcal.web.motion import Postures, home_posture
from pkmcal.web.stage import extent_of, leg_rows, line, machine_shape
from pkmcal.wording import DISPLAY_UNITS, Chance, brief, count, decimals, number

CHANGES_ON_TERMINAL = 8
"""Changes that a terminal lists."""


def outcome_of(d: MachineDifference) -> Outcome:
    """Outcome of ``pkmcal diff``."""
    text = (d.tool,) if isinstance(d.tool, str) else ()
    parts = (
        Part("tool", "What it does to the tool", text, blocks=_space(d), tables=_tool_tables(d)),
        Part(
            "joints",
            "Joints and legs",
            blocks=(_joints(d),),
            tables=(_legs(d),),
        ),
        Part("parameters", "Parameters", tables=_parameters(d)),
        Part("how", "How they were compared", d.assumed),
    )
    refused = any(side.saved and not side.saved.verdict.usable for side in (d.a, d.b))
    return Outcome(
        command="diff",
        title=f"Difference of two models of {d.a.machine.name}",
        kicker=f"{d.a.name} → {d.b.name}",
        subject=f"A: {d.a.name}, a {d.a.kind}; B: {d.b.name}, a {d.b.kind}",
        verdict=d.verdict,
        neutral=d.changed and not refused and not d.of_calibrations,
        stamp="Changed" if d.changed else "Undecided" if refused else "No change",
        level=Level.WRONG if d.changed else Level.DOUBTFUL,
        figures=_cards(d),
        parts=parts,
        document=d.as_dict(),
    )


def _cards(d: MachineDifference) -> tuple[Figure, ...]:
    """Main numbers."""
    out: list[Figure] = []
    if not isinstance(d.tool, str):
        off, sigma = _changes(d.tool)
        if off.size:
            middle, worst = middle_and_worst(off)
            by_chance = middle_and_worst(sigma)[0]
            spread = f"; chance alone makes {by_chance} mm" if d.change.dof else ""
            out.append(
                Figure(
                    "How much does the tool differ?",
                    ((middle, "mm"),),
                    f"median over {d.tool.region}; at worst {worst} mm{spread}",
                )
            )
    shifted = np.concatenate([_displacements(side) for side in d.centres])
    out.append(
        Figure(
            "How far did the joints move?",
            ((brief(float(shifted.mean())), "mm"),),
            f"mean distance of {count(len(shifted), 'joint centre')}, largest"
            f" {brief(float(shifted.max()))} mm",
        )
    )
    if d.change.dof:
        out.append(
            Figure(
                "How likely by chance alone?",
                ((Chance(d.chance), ""),),
                f"χ² {number(d.change.chi2, 1)} for {count(d.change.dof, 'degree')} of freedom",
            )
        )
    return tuple(out)


def _displacements(side: Centres) -> Array:
    """Distances (L,) that a body's joints moved, mm; zero within rounding."""
    distance = np.linalg.norm(side.change, axis=-1)
    return 1e3 * np.where(distance > ROUNDING, distance, 0.0)


def _changes(tool_map: ToolMap) -> tuple[Array, Array]:
    """Changes of the tool and their standard deviations at the evenly spread poses, mm."""
    _, after = tool_map.evenly
    finite = np.isfinite(after.off_position)
    return after.off_position[finite] * 1e3, after.position[finite] * 1e3


def _tool_tables(d: MachineDifference) -> tuple[Table, ...]:
    """Table of the median and the largest change of the tool."""
    if isinstance(d.tool, str):
        return ()
    _, after = d.tool.evenly
    kinds = [("Position, mm", after.off_position * 1e3, after.position * 1e3)]
    turn = np.rad2deg(after.off_orientation)
    if np.nanmax(turn, initial=0.0) > np.rad2deg(ROUNDING):
        kinds.append(("Turn, °", turn, np.rad2deg(after.orientation)))
    rows: list[Row] = []
    for name, off, sigma in kinds:
        finite = np.isfinite(off)
        if finite.any():
            by_chance = middle_and_worst(sigma[finite])[0] if d.change.dof else NO_VALUE_SIGN
            rows.append(Row(name, (*middle_and_worst(off), by_chance)))
    columns = ("At the same readings", "Median", "Worst", "By chance, 1σ")
    note = (
        f"At {count(d.tool.spread, 'pose')} spread evenly over {d.tool.region}: the platform's pose"
        " by B less that by A at the same readings, frames laid over each other."
    )
    return (Table("How far the tool differs", columns, tuple(rows), note),)


def _legs(d: MachineDifference) -> Table:
    """Table of the distances that each leg's joints moved."""
    rows: list[Row] = []
    sides = [(_displacements(x), x.sigma * 1e3) for x in d.centres]
    by_chance = bool(d.change.dof)
    for leg in range(d.a.machine.n_legs):
        cells = tuple(
            brief(float(shifted[leg])) + (f" (±{brief(float(sigma[leg]))})" if by_chance else "")
            for shifted, sigma in sides
        )
        rows.append(Row(f"Leg {leg + 1}", cells))
    brackets = "; in brackets the standard deviation of a coordinate by chance" if by_chance else ""
    return Table(
        "Joint centres",
        ("Leg", "Base joint, mm", "Platform joint, mm"),
        tuple(rows),
        f"Distances after both machines' joints were laid over each other{brackets}.",
        brief=False,
    )


def _parameters(d: MachineDifference) -> tuple[Table, ...]:
    """Significant changes, short enough for a terminal, and a folded table of all parameters."""
    columns = ("Parameter", "A", "B", "Change", "1σ", "Chance")
    out: list[Table] = []
    if d.significant:
        rows = tuple(_row(d, k) for k in d.significant)
        more = len(rows) - CHANGES_ON_TERMINAL
        legend = f"and {count(more, 'more number')}" if more > 0 else ""
        out.append(Table("What changed", columns, rows[:CHANGES_ON_TERMINAL], legend=legend))
    names = range(len(d.a.machine.parameters))
    note = (
        "1σ: of the change by chance. Chance: of as large a change of this number in a machine that"
        " did not change, the number of numbers allowed for."
        if d.change.dof
        else ""
    )
    every = tuple(_row(d, k) for k in names)
    out.append(Table("All numbers", columns, every, note, brief=False, folded=True))
    return tuple(out)


def _row(d: MachineDifference, k: int) -> Row:
    """Row of a parameter."""
    table = d.a.machine.parameters
    factor, unit = DISPLAY_UNITS.get(table.units[k], (1.0, ""))
    value = float(table.unit_axes(d.a.machine.values)[k]) * factor
    change, sigma = float(d.change.change[k]) * factor, float(d.change.sigma[k]) * factor
    size = sigma if sigma > 0 else abs(change)
    places = decimals(size) if size > 0 else 3
    name = table.in_words(table.names[k])
    chance = Chance(float(d.chances[k]))
    return Row(
        f"{name}, {unit}" if unit else name,
        (
            number(value, places),
            number(value + change, places),
            number(change, places, signed=True),
            brief(sigma) if sigma > 0 else NO_VALUE_SIGN,
            chance,
        ),
        mark=Level.DOUBTFUL if d.of_calibrations and k in d.significant else None,
    )


# ------------------------------------------------------------------ plots


def _joints(d: MachineDifference) -> Plot:
    """Bars of the distance that each joint moved, with its standard deviation."""
    legs = range(d.a.machine.n_legs)
    marks: list[BarsMark] = []
    most = 0.0
    colours: tuple[Colour, Colour] = ("nominal", "calibrated")
    for side, colour in zip(d.centres, colours, strict=True):
        shifted = _displacements(side)
        sigma = side.sigma * 1e3 if d.change.dof else np.zeros_like(shifted)
        most = max(most, float((shifted + sigma).max()))
        points = tuple(
            Point(
                x=f"leg {j + 1}",
                y=rounded(float(shifted[j])),
                low=rounded(float(shifted[j] - sigma[j])) if sigma[j] > 0 else None,
                high=rounded(float(shifted[j] + sigma[j])) if sigma[j] > 0 else None,
                tip=f"leg {j + 1}, {side.side} joint: {brief(float(shifted[j]))} mm",
                key=leg_key(j + 1),
            )
            for j in legs
        )
        marks.append(BarsMark(name=f"{side.side} joint", colour=colour, points=points))
    return Plot(
        name="joints",
        title="How far each joint moved",
        caption="Lines on the bars: the standard deviation by chance."
        if d.change.dof
        else "Joints of both nominal models laid over each other.",
        alt="Bars of how far each leg's base joint and platform joint moved, in millimetres; the"
        " table below has the numbers.",
        x=category_axis(f"leg {j + 1}" for j in legs),
        y=linear_axis("moved, mm", (0.0, most), zero=True),
        marks=tuple(marks),
    )


def _space(d: MachineDifference) -> tuple[Space, ...]:
    """Stage with the second machine, its change from the first, and that of the tool."""
    machine, tool_map = d.change.machine, d.tool
    try:
        posture = home_posture(machine)
    except GeometryError:
        if isinstance(tool_map, str):
            return ()
        poses = tool_map.evenly[1].T_base_platform[:1]
        posture = Postures(machine.inverse(poses), poses)
    arrows = () if isinstance(tool_map, str) else (_tool_arrows(d, tool_map),)
    moved = np.empty(0) if isinstance(tool_map, str) else _changes(tool_map)[0] * 1e-3
    change, spread = start_enlargements(extent_of(machine, posture), d.centres, moved)
    return (
        Space(
            title="Both machines, and where the tool goes",
            caption=f"At home. Blue lines: A, {d.a.name}. In colours: B, {d.b.name}, laid over it."
            " Arrows lead from the tool's place by A to that by B at the same readings.",
            alt="Both machines in three dimensions with the change of their joints enlarged, and"
            " arrows of how the tool's position changes over the workspace.",
            machine=machine_shape(machine, leg_rows(machine, d.change.sigma), {}, posture),
            poses=(),
            names=("A", "B"),
            changes=changes(d.a.machine, machine, posture, d.centres),
            ellipsoids=ellipsoids(d.centres) if d.change.dof else (),
            sigmas=ELLIPSOID_SIGMAS,
            enlargement=change,
            ellipsoid_enlargement=spread,
            arrows=arrows,
        ),
    )


def _tool_arrows(d: MachineDifference, tool_map: ToolMap) -> SpaceArrows:
    """Change of the tool at the evenly spread poses, from the first machine to the second."""
    _, after = tool_map.evenly
    finite = np.flatnonzero(np.isfinite(after.off_position))
    off, sigma = _changes(tool_map)
    tips = [
        f"the tool differs by {brief(a)} mm" + (f" (±{brief(b)})" if d.change.dof else "")
        for a, b in zip(off.tolist(), sigma.tolist(), strict=True)
    ]
    return SpaceArrows(
        name="Change of the tool",
        colour="--calibrated",
        # from the place by the first machine to that by the second
        points=line(after.T_base_platform[finite, :3, 3] + after.off[finite, 3:], 6),
        vectors=tuple(small_vector(-v) for v in after.off[finite, 3:]),
        tips=tuple(tips),
    )
