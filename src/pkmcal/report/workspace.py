"""Report section on the tool's error over the workspace: slices, and points in space."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.toolmap import Slice, ToolMap
from pkmcal.geometry.rigid import pose_difference
from pkmcal.identify.estimate import Estimate
from pkmcal.levels import NEGLIGIBLE, ROUNDING
from pkmcal.outcome import Part, Plot, Row, Table
from pkmcal.pages.plots import (
    COMMON_AXIS_LAYOUT,
    COMMON_PLOT_LAYOUT,
    MAGNITUDE_COLOUR_SCALE,
    coloured,
    markers,
    space_layout,
)
from pkmcal.report.links import Links
from pkmcal.session.load import Session
from pkmcal.wording import brief, count, number

SLICE_ROW_HEIGHT = 170
"""Height of a row of slices, px."""
SLICES_MARGIN, SLICES_RIGHT_MARGIN, SLICES_TOP_MARGIN, SLICES_BOTTOM_MARGIN = 92, 74, 26, 40
"""Margins around the slices, px, for names, legend and tick labels."""
SLICE_GAP_SHARE = 0.045
"""Gap between slices, in widths of the plot."""
POSE_NEAR_SLICE_SHARE = 0.2
"""Largest distance of a pose that is drawn in a slice, in extents of the poses across it."""
THIN_EXTENT_SHARE = 0.2
"""Least extent of a coordinate worth an axis, in extents of the widest."""
LEAST_TURN_DRAWN = 1.0
"""Least range of a rotation that is drawn, degrees."""
SLICES_READING_TEXT = (
    "Slices are at home's orientation, on one scale of colours; crosses are poses that were"
    " measured, near the slice. By the nominal model: how sure the platform would be by the"
    " nominal model's tolerances. Nominal model's error: how far the nominal model's pose is from"
    " the calibrated at the same readings, frames laid over each other. Calibrated: one standard"
    " deviation that is left, of the geometry; the noise of single readings and what the model"
    " leaves out come on top."
)
NO_UNTURNED_SLICES_TEXT = (
    "The platform does not move aside without turning, so there are no slices of one orientation."
)
TOO_NARROW_TEXT = "The workspace has an extent along one axis at most, so there are no slices."


def section(session: Session, estimate: Estimate, tool_map: ToolMap | str, links: Links) -> Part:
    """Section of the report; for a machine without a map the sentence on the reason."""
    name, title, menu = "workspace", "The tool over the workspace", "Workspace"
    if isinstance(tool_map, str):
        return Part(name, title, (tool_map,), menu=menu)
    slices = _slices(session, estimate, tool_map, links)
    how = (
        SLICES_READING_TEXT
        if slices
        else TOO_NARROW_TEXT
        if _narrow(tool_map)
        else NO_UNTURNED_SLICES_TEXT
    )
    return Part(
        name,
        title,
        (_headline(tool_map), how),
        plots=tuple(plot for plot in (slices, _space(session, estimate, tool_map)) if plot),
        tables=(_table(tool_map),),
        menu=menu,
    )


def _narrow(tool_map: ToolMap) -> bool:
    """Whether the region, rather than the machine, leaves no plane for slices."""
    named = any(side is not None and side[0] == side[1] for side in tool_map.region.sides)
    wide = np.ptp(tool_map.evenly[1].T_base_platform[:, :3, 3], axis=0)
    return named and int(np.count_nonzero(wide > NEGLIGIBLE * wide.max())) < 2


def _headline(tool_map: ToolMap) -> str:
    """Main numbers in a sentence."""
    _, after = tool_map.evenly
    sigma, off = (x[np.isfinite(x)] * 1e3 for x in (after.position, after.off_position))
    text = (
        f"Over {tool_map.region}, {count(tool_map.spread, 'pose')} spread evenly, the calibrated"
        f" platform's place is known to {brief(float(np.median(sigma)))} mm (1σ, median), at worst"
        f" to {brief(float(sigma.max()))} mm"
    )
    if not off.size:
        return f"{text}."
    return (
        f"{text}; the nominal model's was {brief(float(np.median(off)))} mm off, at worst"
        f" {brief(float(off.max()))} mm."
    )


def _table(tool_map: ToolMap) -> Table:
    """Table of the median and the largest error over the evenly spread poses."""
    before, after = tool_map.evenly
    rows: list[Row] = []
    turns = float(np.nanmax(before.orientation)) > ROUNDING
    kinds = (
        ("By the nominal model's tolerances, σ", before.position, before.orientation),
        ("Nominal model's error", after.off_position, after.off_orientation),
        ("Calibrated, σ", after.position, after.orientation),
    )
    for name, place, turn in kinds:
        turned = middle_and_worst(np.rad2deg(turn)) if turns else ()
        rows.append(Row(name, (*middle_and_worst(place * 1e3), *turned)))
    columns = ("Over the region", "place, median, mm", "worst, mm")
    columns += ("turn, median, °", "worst, °") if turns else ()
    return Table("", columns, tuple(rows), brief=False)


def middle_and_worst(values: Array) -> tuple[str, str]:
    """Median and largest of the finite values, as text."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "–", "–"
    return brief(float(np.median(finite))), brief(float(finite.max()))


# ------------------------------------------------------------------ slices


def _slices(session: Session, estimate: Estimate, tool_map: ToolMap, links: Links) -> Plot | None:
    """Plot of all quantities in all slices, one below the other.

    Side by side for a single slice.
    """
    if not tool_map.slices:
        return None
    quantities = (
        ("By the nominal model, σ", tool_map.before.position),
        ("Nominal model's error", tool_map.after.off_position),
        ("Calibrated, σ", tool_map.after.position),
    )
    single = len(tool_map.slices) == 1
    # table of panels: a column for each slice and a row for each quantity, or one row
    across, down = (len(quantities), 1) if single else (len(tool_map.slices), len(quantities))
    extent = _extent(tool_map)
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {**COMMON_PLOT_LAYOUT, "annotations": [], "showlegend": False}
    for row, (name, values) in enumerate(quantities):
        for column, cut in enumerate(tool_map.slices):
            place = (row, 0) if single else (column, row)
            nth = place[1] * across + place[0]
            panel = str(nth + 1) if nth else ""  # Plotly calls axes x, x2, x3
            axes = {"xaxis": f"x{panel}", "yaxis": f"y{panel}"}
            data.append(_heat(cut, values * 1e3, name, axes))
            data.append(_crosses(session, estimate, tool_map, cut, axes, links))
            _add_axes(layout, cut, panel, place, (across, down), extent)
            if single or row == 0:
                layout["annotations"].append(_label(name if single else _title(cut), panel, "top"))
            if not single and column == 0:
                layout["annotations"].append(_label(name, panel, "left"))
    layout["coloraxis"] = _colours(np.concatenate([v for _, v in quantities]) * 1e3)
    layout["margin"] = {
        "l": 46 if single else SLICES_MARGIN,
        "r": SLICES_RIGHT_MARGIN,
        "t": SLICES_TOP_MARGIN,
        "b": SLICES_BOTTOM_MARGIN,
    }
    height = (
        SLICES_TOP_MARGIN + SLICES_BOTTOM_MARGIN + SLICE_ROW_HEIGHT * down + (60 if single else 0)
    )
    return Plot(
        "slices",
        "Before and after, slice by slice",
        "Point at a cell for its number.",
        "Heat maps of how sure the platform's place is by the nominal model, how far the nominal"
        " model was off, and how sure it is as calibrated, in slices through the workspace. The"
        " table below has the figures over all of it.",
        {"data": data, "layout": layout, "config": {}},
        height=height,
        width=640 if single else 150 * across + SLICES_MARGIN + SLICES_RIGHT_MARGIN,
    )


def _extent(tool_map: ToolMap) -> Array:
    """Limits (3, 2) of all slices' coordinates, mm, with a margin."""
    places = tool_map.after.T_base_platform[tool_map.spread :, :3, 3] * 1e3
    low, high = places.min(axis=0), places.max(axis=0)
    more = 0.06 * float((high - low).max())
    return np.round(np.stack([low - more, high + more], axis=1), 1)


def _title(cut: Slice) -> str:
    """Coordinate of a slice's plane."""
    return f"{'xyz'[cut.normal]} = {number(cut.level * 1e3, 0)} mm"


def _heat(cut: Slice, values: Array, name: str, axes: dict[str, str]) -> dict[str, Any]:
    """Heat map of a slice: logarithms of values (n,), mm."""
    visible = np.where(cut.rows >= 0, values[cut.rows], np.nan)
    with np.errstate(divide="ignore"):
        level = np.log10(visible)
    x_name, y_name = "xyz"[cut.across], "xyz"[cut.up]
    return {
        "type": "heatmap",
        "name": name,
        "x": np.round(cut.u * 1e3, 1).tolist(),
        "y": np.round(cut.v * 1e3, 1).tolist(),
        "z": np.round(level, 4),
        "customdata": _significant(visible, 4),
        "hovertemplate": f"{x_name} %{{x:.0f}}, {y_name} %{{y:.0f}}, {_title(cut)}<br>{name}:"
        " %{customdata:.3g} mm<extra></extra>",
        "hoverongaps": False,
        "coloraxis": "coloraxis",
        **axes,
    }


def _significant(values: Array, digits: int) -> Array:
    """Numbers rounded to significant digits."""
    with np.errstate(divide="ignore", invalid="ignore"):
        places = digits - 1 - np.floor(np.log10(np.abs(values)))
    scale = 10.0 ** np.clip(np.nan_to_num(places), 0, 15)
    return np.round(values * scale) / scale


def _crosses(
    session: Session,
    estimate: Estimate,
    tool_map: ToolMap,
    cut: Slice,
    axes: dict[str, str],
    links: Links,
) -> dict[str, Any]:
    """Markers of the measured poses near a slice, each linked to its image."""
    used = np.flatnonzero(estimate.configurations)
    place = estimate.state.T_base_platform[used, :3, 3]
    even = tool_map.evenly[1].T_base_platform[:, cut.normal, 3]
    near = np.abs(place[:, cut.normal] - cut.level) <= POSE_NEAR_SLICE_SHARE * np.ptp(even) + 1e-6
    used, place = used[near], place[near]
    return {
        "type": "scatter",
        "mode": "markers",
        "x": np.round(place[:, cut.across] * 1e3, 1).tolist(),
        "y": np.round(place[:, cut.up] * 1e3, 1).tolist(),
        "text": [f"measured: {session.configurations[k]}" for k in used],
        "hoverinfo": "text",
        "customdata": [links.to_configuration(int(k)) for k in used],
        "marker": {
            "symbol": "x-thin",
            "size": 7,
            "line": {"color": "--calibrated", "width": 1.6},
        },
        **axes,
    }


def _add_axes(
    layout: dict[str, Any],
    cut: Slice,
    panel: str,
    place: tuple[int, int],
    shape: tuple[int, int],
    extent: Array,
) -> None:
    """Add the axes of one panel of a table of panels.

    place : column and row.
    shape : number of columns and rows.
    extent : (3, 2) mm.
    """
    (column, row), (across, down) = place, shape
    # domain of the panel, in shares of the plot
    wide = (1 - SLICE_GAP_SHARE * (across - 1)) / across
    gap = SLICE_GAP_SHARE if down > 1 else 0.0
    tall = (1 - gap * (down - 1)) / down
    left, top = column * (wide + SLICE_GAP_SHARE), 1 - row * (tall + gap)
    common = {**COMMON_AXIS_LAYOUT, "showgrid": False, "zeroline": False, "tickfont": {"size": 10}}
    common |= {"nticks": 4, "tickangle": 0}
    last = row == down - 1
    x_name, y_name = "xyz"[cut.across], "xyz"[cut.up]
    named = column == 0 or y_name == "z"  # slices side by side share their y
    layout[f"xaxis{panel}"] = {
        **common,
        "domain": [left, left + wide],
        "range": extent[cut.across].tolist(),
        "anchor": f"y{panel}",
        "constrain": "domain",
        "showticklabels": last,
        "title": {"text": f"{x_name}, mm" if last else "", "font": {"size": 11}, "standoff": 4},
    }
    layout[f"yaxis{panel}"] = {
        **common,
        "domain": [max(top - tall, 0.0), top],
        "range": extent[cut.up].tolist(),
        "anchor": f"x{panel}",
        "scaleanchor": f"x{panel}",
        "constrain": "domain",
        "title": {"text": f"{y_name}, mm" if named else "", "font": {"size": 11}, "standoff": 2},
    }


def _label(text: str, panel: str, side: str) -> dict[str, Any]:
    """Annotation with a panel's name, above or to the left."""
    at = {"xref": f"x{panel} domain", "yref": f"y{panel} domain", "showarrow": False}
    font = {"size": 12, "color": "--ink"}
    if side == "top":
        return {
            **at, "text": text, "x": 0.5, "y": 1, "yanchor": "bottom", "xanchor": "center",
            "font": font,
        }  # fmt: skip
    return {
        **at, "text": text, "xref": "paper", "x": 0, "xshift": -SLICES_MARGIN + 4, "y": 0.5,
        "textangle": -90, "xanchor": "left", "yanchor": "middle", "font": font,
    }  # fmt: skip


def _colours(values: Array) -> dict[str, Any]:
    """Common colour axis for values (n,), mm, by their logarithms."""
    finite = values[np.isfinite(values) & (values > 0)]
    low, high = np.log10(np.quantile(finite, (0.01, 0.995)))
    high = max(high, low + 0.3)
    steps = [m * 10.0**k for k in range(-5, 5) for m in (1, 2, 5)]
    ticks = [s for s in steps if low - 0.02 <= np.log10(s) <= high + 0.02]
    return {
        "colorscale": MAGNITUDE_COLOUR_SCALE,
        "cmin": round(float(low), 3),
        "cmax": round(float(high), 3),
        "colorbar": {
            "title": {"text": "mm", "side": "top"},
            "tickvals": [round(float(np.log10(s)), 4) for s in ticks],
            "ticktext": [f"{s:g}" for s in ticks],
            "thickness": 12,
            "outlinewidth": 0,
            "x": 1.01,
            "xpad": 4,
        },
    }


# ------------------------------------------------------------------ in space


def _axes(poses: Array) -> tuple[Integers, tuple[str, ...]] | None:
    """Indices of three of the poses' six components (n, 4, 4) to plot, and their names.

    The position, with rotations in place of coordinates in which the platform hardly moves; None
    if fewer than three components change.
    """
    # rotations replace coordinates of little extent, the largest first
    places = np.ptp(poses[:, :3, 3], axis=0)
    thin = places <= THIN_EXTENT_SHARE * places.max()
    turns = np.rad2deg(np.ptp(pose_difference(poses, poses[0])[:, :3], axis=0))
    order = [int(k) for k in np.argsort(-turns) if turns[k] > LEAST_TURN_DRAWN]
    if np.count_nonzero(thin) > len(order):
        return None
    instead = sorted(order[: np.count_nonzero(thin)])
    components = np.array([*instead, *(3 + np.flatnonzero(~thin))])
    names = ("turn about x, °", "turn about y, °", "turn about z, °", "x, mm", "y, mm", "z, mm")
    return components, tuple(names[k] for k in components)


def _plot_coordinates(poses: Array, home: Array, components: Integers) -> Array:
    """Plotted components (n, 3) of poses: rotations from home in degrees, positions in mm."""
    turns = np.rad2deg(pose_difference(poses, home)[:, :3])
    return np.concatenate([turns, poses[:, :3, 3] * 1e3], axis=1)[:, components]


def _space(session: Session, estimate: Estimate, tool_map: ToolMap) -> Plot | None:
    """Plot of the evenly spread poses, coloured by sigma, and of the measured poses.

    None for a machine that moves in a plane.
    """
    _, after = tool_map.evenly
    poses = after.T_base_platform
    axes = _axes(poses)
    if axes is None:
        return None
    components, names = axes
    sigma, turn = after.position * 1e3, np.rad2deg(after.orientation)
    turns = bool(np.nanmax(turn) > np.rad2deg(ROUNDING))
    columns = [sigma, after.off_position * 1e3, turn if turns else np.zeros_like(turn)]
    hover = "<br>".join(f"{name}: %{{{k}:.3g}}" for k, name in zip("xyz", names, strict=True))
    hover += "<br>σ %{customdata[0]:.3g} mm"
    hover += ", %{customdata[2]:.2g}°" if turns else ""
    hover += "<br>nominal model's error %{customdata[1]:.3g} mm<extra></extra>"
    # rotations count from home; without them home is not needed
    home = poses[0] if components.min() >= 3 else session.machine.home()
    used = np.flatnonzero(estimate.configurations)
    data = [
        coloured(
            "Calibrated, σ",
            _plot_coordinates(poses, home, components) * 1e-3,
            sigma,
            "σ, mm",
            customdata=_significant(np.column_stack(columns), 3),
            hovertemplate=hover,
        ),
        markers(
            "Measured",
            _plot_coordinates(estimate.state.T_base_platform[used], home, components) * 1e-3,
            {"size": 4, "color": "--calibrated", "symbol": "diamond"},
            hovertext=[f"measured: {session.configurations[k]}" for k in used],
            hoverinfo="text",
        ),
    ]
    layout = space_layout()
    layout["showlegend"] = False
    for axis, name in zip("xyz", names, strict=True):
        layout["scene"][f"{axis}axis"]["title"] = {"text": name}
    if components.min() < 3:
        layout["scene"]["aspectmode"] = "cube"
    return Plot(
        "reach",
        "What is left, in space",
        "The calibrated platform's σ at the poses of the table, on a scale of its own; diamonds"
        " were measured. Drag to turn, wheel or pinch to come nearer.",
        "Points of the workspace in three dimensions, coloured by the standard deviation of the"
        " platform's place as calibrated.",
        {"data": data, "layout": layout, "config": {"scrollZoom": True}},
        height=420,
    )
