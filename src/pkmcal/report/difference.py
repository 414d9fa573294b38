"""Difference of two machines as an outcome: tables, and plots of joints and tool."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.toolmap import ToolMap
from pkmcal.judge.difference import MachineDifference
from pkmcal.levels import ROUNDING
from pkmcal.outcome import Figure, Level, Outcome, Part, Plot, Row, Table
from pkmcal.pages.plots import COMMON_AXIS_LAYOUT, COMMON_PLOT_LAYOUT, coloured, space_layout
from pkmcal.report.watch import NO_VALUE_SIGN, chance_text
from pkmcal.report.workspace import middle_and_worst
from pkmcal.wording import DISPLAY_UNITS, brief, count, decimals, number

CHANGES_ON_TERMINAL = 8
"""Changes that a terminal lists."""


def outcome_of(d: MachineDifference) -> Outcome:
    """Outcome of ``pkmcal diff``."""
    tool = () if isinstance(d.tool, str) else (_space(d.tool),)
    text = (d.tool,) if isinstance(d.tool, str) else ()
    parts = (
        Part("tool", "What it does to the tool", text, plots=tool, tables=_tool_tables(d)),
        Part(
            "joints",
            "Joints and legs",
            plots=(_joints(d),),
            tables=(_legs(d),),
        ),
        Part("parameters", "All numbers", tables=_parameters(d)),
        Part("how", "How they were compared", d.assumed),
    )
    refused = any(side.saved and not side.saved.verdict.usable for side in (d.a, d.b))
    return Outcome(
        command="diff",
        title=f"Difference of two {d.a.machine.name}",
        kicker=f"{d.a.name} → {d.b.name}",
        subject=f"A: {d.a.name}, a {d.a.kind}; B: {d.b.name}, a {d.b.kind}",
        verdict=d.verdict,
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
    shifted = np.concatenate([np.linalg.norm(side.change, axis=-1) for side in d.centres]) * 1e3
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
                ((chance_text(d.chance), ""),),
                f"χ² {number(d.change.chi2, 1)} for {count(d.change.dof, 'degree')} of freedom",
            )
        )
    return tuple(out)


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
    columns = ("At the same readings", "median", "worst", "by chance, 1σ")
    note = (
        f"At {count(d.tool.spread, 'pose')} spread evenly over {d.tool.region}: the platform's pose"
        " by B less that by A at the same readings, frames laid over each other."
    )
    return (Table("How far the tool differs", columns, tuple(rows), note),)


def _legs(d: MachineDifference) -> Table:
    """Table of the distances that each leg's joints moved."""
    rows: list[Row] = []
    sides = [(np.linalg.norm(x.change, axis=-1) * 1e3, x.sigma * 1e3) for x in d.centres]
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
        ("Leg", "base joint, mm", "platform joint, mm"),
        tuple(rows),
        f"Distances after both machines' joints were laid over each other{brackets}.",
        brief=False,
    )


def _parameters(d: MachineDifference) -> tuple[Table, ...]:
    """Significant changes, short enough for a terminal, and a folded table of all parameters."""
    columns = ("Parameter", "A", "B", "change", "1σ", "chance")
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
    chance = chance_text(float(d.chances[k]))
    return Row(
        f"{name}, {unit}" if unit else name,
        (
            number(value, places),
            number(value + change, places),
            number(change, places, signed=True),
            brief(sigma) if sigma > 0 else NO_VALUE_SIGN,
            chance,
        ),
        mark=Level.DOUBTFUL if k in d.significant else None,
    )


# ------------------------------------------------------------------ plots


def _joints(d: MachineDifference) -> Plot:
    """Bars of the distance that each joint moved, with its standard deviation."""
    legs = [f"leg {leg + 1}" for leg in range(d.a.machine.n_legs)]
    data: list[dict[str, Any]] = []
    for side, colour in zip(d.centres, ("--drawing", "--calibrated"), strict=True):
        shifted = np.linalg.norm(side.change, axis=-1) * 1e3
        data.append(
            {
                "type": "bar",
                "name": f"{side.side} joint",
                "x": legs,
                "y": np.round(shifted, 5).tolist(),
                "marker": {"color": colour},
                "error_y": {
                    "type": "data",
                    "array": np.round(side.sigma * 1e3, 5).tolist(),
                    "visible": bool(d.change.dof),
                    "color": "--ink",
                    "thickness": 1,
                },
                "hovertemplate": "%{x}, %{data.name}: %{y:.3g} mm<extra></extra>",
            }
        )
    layout = {
        **COMMON_PLOT_LAYOUT,
        "barmode": "group",
        "margin": {"l": 56, "r": 12, "t": 10, "b": 36},
        "xaxis": {**COMMON_AXIS_LAYOUT},
        "yaxis": {**COMMON_AXIS_LAYOUT, "title": {"text": "moved, mm"}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
    }
    return Plot(
        "joints",
        "How far each joint moved",
        "Bars with lines: the standard deviation by chance."
        if d.change.dof
        else "Joints of both nominal models laid over each other.",
        "Bars of how far each leg's base joint and platform joint moved, in millimetres; the table"
        " below has the numbers.",
        {"data": data, "layout": layout, "config": {}},
        height=320,
    )


def _space(tool_map: ToolMap) -> Plot:
    """Plot of the evenly spread poses, coloured by the tool's change."""
    _, after = tool_map.evenly
    off, sigma = _changes(tool_map)
    hover = [[float(f"{a:.3g}"), float(f"{b:.3g}")] for a, b in zip(off, sigma, strict=True)]
    points = coloured(
        "tool",
        after.T_base_platform[np.isfinite(after.off_position), :3, 3],
        off,
        "mm",
        customdata=hover,
        hovertemplate="x: %{x:.3g}<br>y: %{y:.3g}<br>z: %{z:.3g}<br>differs by %{customdata[0]:.3g}"
        " mm<br>σ %{customdata[1]:.3g} mm<extra></extra>",
    )
    layout = space_layout()
    layout["showlegend"] = False
    return Plot(
        "reach",
        "Where the tool differs",
        "The tool's place at the same readings, by the second less by the first. Drag to turn.",
        "Points of the workspace in three dimensions, coloured by how far the tool differs.",
        {"data": [points], "layout": layout, "config": {"scrollZoom": True}},
        height=420,
    )
