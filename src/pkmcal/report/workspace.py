"""Report section on the tool's error over the workspace: contour maps in slices, and figures."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.toolmap import Slice, ToolMap
from pkmcal.identify.estimate import Estimate
from pkmcal.levels import NEGLIGIBLE, ROUNDING
from pkmcal.outcome import Part, Row, Table
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.tool_map import Grid, MapLayer, MapPose, MapSlice, ToolMapBlock
from pkmcal.session.load import Session
from pkmcal.wording import brief, count

POSE_NEAR_SLICE_SHARE = 0.2
"""Largest distance of a pose that is drawn in a slice, in extents of the poses across it."""
LIMIT_DIGITS, VALUE_DIGITS = 2, 4
"""Significant digits of the accuracy with which a map starts, and of its values."""
SLICES_READING_TEXT = (
    "Slices at home's orientation; the stronger the colour, the worse. The green line encloses"
    " where the wanted accuracy holds. Its share is that of poses spread evenly over the workspace"
    " and its orientations. Crosses: measured poses near the slice. Error before: distance of the"
    " nominal model's pose from the calibrated one at the same readings, frames laid over each"
    " other. σ after: one standard deviation by the calibrated geometry; the noise of single"
    " readings and what the model leaves out come on top. Gain: the former over the latter."
)
NO_UNTURNED_SLICES_TEXT = (
    "The platform does not move aside without turning, so there are no slices of one orientation."
)
TOO_NARROW_TEXT = "The workspace has an extent along one axis at most, so there are no slices."


def section(session: Session, estimate: Estimate, tool_map: ToolMap | str) -> Part:
    """Section of the report; for a machine without a map the sentence on the reason."""
    name, title, menu = "workspace", "The tool over the workspace", "Workspace"
    if isinstance(tool_map, str):
        return Part(name, title, (tool_map,), menu=menu)
    text = [_headline(tool_map)]
    if not tool_map.slices:
        text.append(TOO_NARROW_TEXT if _narrow(tool_map) else NO_UNTURNED_SLICES_TEXT)
    blocks = (map_block(session, estimate, tool_map),) if tool_map.slices else ()
    return Part(name, title, tuple(text), blocks=blocks, tables=(_table(tool_map),), menu=menu)


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
        f" platform's position is known to {brief(float(np.median(sigma)))} mm (1σ, median), at"
        f" worst to {brief(float(sigma.max()))} mm"
    )
    if not off.size:
        return f"{text}."
    return (
        f"{text}; the nominal model is {brief(float(np.median(off)))} mm off, at worst"
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
    columns = ("Over the region", "Position, median, mm", "Position, worst, mm")
    columns += ("Orientation, median, °", "Orientation, worst, °") if turns else ()
    return Table("", columns, tuple(rows), brief=False)


def middle_and_worst(values: Array) -> tuple[str, str]:
    """Median and largest of the finite values, as text."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "–", "–"
    return brief(float(np.median(finite))), brief(float(finite.max()))


# ------------------------------------------------------------------ slices


def map_block(session: Session, estimate: Estimate, tool_map: ToolMap) -> ToolMapBlock:
    """Contour maps of error before, sigma after, and gain, in all slices."""
    even = tool_map.evenly[1]
    turns = bool(np.nanmax(even.orientation) > ROUNDING)
    layers = _layers(tool_map, "position", "mm", 1e3)
    layers += _layers(tool_map, "orientation", "°", 180 / np.pi) if turns else ()
    return ToolMapBlock(
        caption=SLICES_READING_TEXT,
        alt="Contour map of the error of the tool's pose in a slice through the workspace; the"
        " table has the figures over all of it.",
        slices=tuple(
            MapSlice(
                across="xyz"[cut.across],
                up="xyz"[cut.up],
                normal="xyz"[cut.normal],
                level=round(cut.level * 1e3, 1),
                u=tuple(np.round(cut.u * 1e3, 2).tolist()),
                v=tuple(np.round(cut.v * 1e3, 2).tolist()),
                poses=_near(session, estimate, tool_map, cut),
            )
            for cut in tool_map.slices
        ),
        layers=layers,
    )


def _layers(
    tool_map: ToolMap, component: Literal["position", "orientation"], unit: str, factor: float
) -> tuple[MapLayer, ...]:
    """Layers of position or orientation."""
    after = tool_map.after
    off = factor * (after.off_position if component == "position" else after.off_orientation)
    sigma = factor * (after.position if component == "position" else after.orientation)
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = off / sigma
    wanted = _median(sigma[: tool_map.spread])
    every = (
        ("Error before", unit, off, "small", wanted),
        ("σ after", unit, sigma, "small", wanted),
        ("Gain", "", gain, "large", _median(gain[: tool_map.spread])),
    )
    return tuple(
        MapLayer(
            name=name,
            component=component,
            unit=own,
            better="small" if better == "small" else "large",
            limit=limit,
            slices=tuple(_grid(cut, values) for cut in tool_map.slices),
            evenly=tuple(x for x in map(_value, values[: tool_map.spread]) if x is not None),
        )
        for name, own, values, better, limit in every
    )


def _median(values: Array) -> float:
    """Median of the finite values, with few digits."""
    finite = values[np.isfinite(values)]
    return float(f"{np.median(finite):.{LIMIT_DIGITS}g}") if finite.size else 0.0


def _value(value: float) -> float | None:
    """Value with ``VALUE_DIGITS`` significant digits, None if it is not finite."""
    return float(f"{value:.{VALUE_DIGITS}g}") if np.isfinite(value) else None


def _grid(cut: Slice, values: Array) -> Grid:
    """Values (n,) in the cells of a slice."""
    return tuple(
        tuple(_value(values[k]) if k >= 0 else None for k in row) for row in cut.rows.tolist()
    )


def _near(
    session: Session, estimate: Estimate, tool_map: ToolMap, cut: Slice
) -> tuple[MapPose, ...]:
    """Measured poses near a slice."""
    used = np.flatnonzero(estimate.configurations)
    place = estimate.state.T_base_platform[used, :3, 3]
    even = tool_map.evenly[1].T_base_platform[:, cut.normal, 3]
    near = np.abs(place[:, cut.normal] - cut.level) <= POSE_NEAR_SLICE_SHARE * np.ptp(even) + 1e-6
    return tuple(
        MapPose(
            key=configuration_key(session.configurations[k]),
            tip=f"measured: {session.configurations[k]}",
            u=round(float(p[cut.across]) * 1e3, 1),
            v=round(float(p[cut.up]) * 1e3, 1),
        )
        for k, p in zip(used[near].tolist(), place[near], strict=True)
    )
