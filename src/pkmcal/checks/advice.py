"""Advice on better images, and the forecast of a capture, as findings and tables.

Advice follows from measurements: where legs are hidden, where expected edges are lost and why, and
the directions from which the stations look.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pkmcal.checks.forecast import Forecast, LegForecast
from pkmcal.checks.inspection import Inspection, StationInspection
from pkmcal.geometry.rigid import inverse
from pkmcal.levels import CAUSE_SHARE, MAJORITY, RELEVANT_FACTOR
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.profiles import PROFILE_OPTIONS
from pkmcal.outcome import Figure, Level, Part, Row, Table
from pkmcal.outcome.finding import Finding, note
from pkmcal.placement.stations import PANORAMIC_HALF_VIEW, view_angle
from pkmcal.planning.first import EdgesOf
from pkmcal.wording import brief, count, listed, named, percentage

INFORMATION_LOST_SHARE = CAUSE_SHARE
"""Share of the information that is lost with that factor."""
LEG_COLUMNS = {
    "In view": "Share of the leg's edges that nothing hides.",
    "Measured": "Share of these that are measured and agree with the others.",
    "Edge sigma": "Standard deviation of an edge across itself, median.",
    "Information": "Share of the edges' information about the machine.",
    "Tool variance": "Share of the variance of the platform's position that comes from the leg's"
    " edges: where it is large, a better view of that leg gains most.",
}
"""Columns of the tables of legs, with their explanations."""


def advice(inspection: Inspection, forecast: Forecast | None) -> tuple[Finding, ...]:
    """Advice for a session, the most useful first."""
    out = [
        *_better_captures(forecast),
        *_from_one_side(inspection),
        *_hidden_legs(inspection),
        *_slim_tubes(inspection),
    ]
    if forecast is not None and not forecast.handheld:
        for station, edges in zip(inspection.stations, forecast.edges, strict=True):
            out += _lost_edges(inspection, station, edges)
    return tuple(out)


def _better_captures(forecast: Forecast | None) -> list[Finding]:
    """Advice to use a second station, or a board on the base for hand-held images, if that gains
    more than further images of the present kind.
    """
    if forecast is None:
        return []
    before, out = forecast.position, list[Finding]()
    if (sigma := forecast.second) * RELEVANT_FACTOR < before:
        at = {"number": forecast.photographs, "tool_sigma": sigma, "tool_sigma_before": before}
        out.append(note("images.second_place", **at))
    if (sigma := forecast.with_board) * RELEVANT_FACTOR < before:
        out.append(note("images.base_board", tool_sigma=sigma, tool_sigma_before=before))
    return out


def _from_one_side(inspection: Inspection) -> list[Finding]:
    """Advice if all stations look along nearly the same line.

    What one camera determines badly, along its line of sight, another determines by the sine of the
    angle between the two lines.
    """
    cameras = [station.images.camera for station in inspection.stations]
    if len(cameras) < 2 or any(view_angle(camera) >= PANORAMIC_HALF_VIEW for camera in cameras):
        return []
    centres = inspection.session.machine.base_centers()
    middle = np.concatenate([centres, inspection.poses[:, :3, 3]]).mean(axis=0)
    eyes = inverse(np.stack([station.T_camera_base for station in inspection.stations]))[:, :3, 3]
    direction = (middle - eyes) / np.linalg.norm(middle - eyes, axis=-1, keepdims=True)
    sine = np.linalg.norm(np.cross(direction[:, None], direction), axis=-1)
    if (
        not all(station.recognised for station in inspection.stations)
        or sine.max() * RELEVANT_FACTOR > 1
    ):
        return []
    angle = math.degrees(math.asin(float(sine.max())))
    return [note("images.one_side", degrees=angle)]


def _hidden_legs(inspection: Inspection) -> list[Finding]:
    """Advice on legs that are hidden from every station."""
    recognised = [station for station in inspection.stations if station.quality is not None]
    if not recognised or len(recognised) < len(inspection.stations):
        return []
    hidden = np.stack([s.quality.hidden.mean(axis=0) for s in recognised if s.quality is not None])
    best = np.argmin(np.nan_to_num(hidden, nan=np.inf), axis=0)
    least = hidden[best, np.arange(hidden.shape[1])]
    out: list[Finding] = []
    for s, station in enumerate(recognised):
        bad = np.flatnonzero((least > INFORMATION_LOST_SHARE) & (best == s))
        if not bad.size:
            continue
        out.append(
            note(
                "images.hidden",
                named(bad),
                legs=named(bad),
                number=bad.size,
                share=float(least[bad].mean()),
                station=station.name if len(recognised) > 1 else None,
            )
        )
    return out


def _slim_tubes(inspection: Inspection) -> list[Finding]:
    """Advice on tubes so narrow in a station's images that the profiles of both edges overlap."""
    tubes, least = tubes_of(inspection.session.machine), 2 * PROFILE_OPTIONS.reach_inside
    out: list[Finding] = []
    for station in inspection.stations:
        if station.quality is None:
            continue
        width = 2 * station.quality.half_width
        usual = [
            (tube, float(np.nanmedian(mine)))
            for tube in np.unique(tubes.tube)
            if np.isfinite(mine := width[:, tubes.tube == tube]).any()
        ]
        slim = [f"tube {tube + 1} {brief(px)} px" for tube, px in usual if px < least]
        if slim:
            at = {"station": station.name, "tubes": slim, "least": least}
            out.append(note("images.slim", station.name, **at))
    return out


def _lost_edges(
    inspection: Inspection, station: StationInspection, edges: EdgesOf
) -> list[Finding]:
    """Advice on the cause of lost edges, if many of the expected ones are lost."""
    expected, lost = int(edges.expected.sum()), edges.expected & ~edges.valid
    if station.quality is None or not expected or lost.sum() <= INFORMATION_LOST_SHARE * expected:
        return []
    level, behind = (part[edges.images] for part in (station.quality.level, station.quality.behind))
    # Causes of lost edges by the brightness of the leg and of its background.
    contrast = np.abs(level - behind)
    usual = contrast[edges.valid & np.isfinite(contrast)]
    usual = float(np.median(usual)) if usual.size else math.nan
    finite = lost & np.isfinite(contrast)
    brighter = np.fmax(level, behind)
    kinds = {
        "white": brighter >= station.quality.options.saturated,
        "black": brighter <= station.quality.options.black,
    }
    kinds["faint"] = ~kinds["white"] & ~kinds["black"] & (contrast < MAJORITY * usual)
    kinds["clear"] = ~(kinds["white"] | kinds["black"] | kinds["faint"])
    number = {name: int(np.sum(finite & of)) for name, of in kinds.items()}
    kind = max(number, key=lambda name: number[name])
    # Legs that lose more than their share.
    tubes = tubes_of(inspection.session.machine)
    by_leg = [
        int((lost[:, tubes.leg == j]).sum()) for j in range(inspection.session.machine.n_legs)
    ]
    worst = np.flatnonzero(np.array(by_leg) > 2 * lost.sum() / len(by_leg))
    at: dict[str, Any] = {
        "station": station.name,
        "share": float(lost.sum() / expected),
        "legs": named(worst) if worst.size else None,
        "number": worst.size,
    }
    if kind == "faint":
        faint = contrast[finite & kinds["faint"]]
        at |= {"contrast": float(np.median(faint)) if faint.size else 0.0, "usual": usual}
        at["sheet"] = _sheet(station)
    return [note(f"images.lost_{kind}", station.name, **at)]


def _sheet(station: StationInspection) -> str:
    """Brightness of a background with better contrast for the quartile of legs of least
    contrast.
    """
    if station.quality is None:
        return "white"
    level = station.quality.level[np.isfinite(station.quality.level)]
    return "white" if np.quantile(255 - level, 0.25) >= np.quantile(level, 0.25) else "dark"


# ------------------------------------------------------------------ the forecast


def forecast_figure(forecast: Forecast) -> Figure:
    """Key figure of the forecast."""
    images = f"{forecast.photographs} such images a station"
    if forecast.handheld:
        images = count(forecast.photographs, "localized image")
    return Figure(
        f"What would {images} give?",
        ((brief(forecast.position * 1e3), "mm"), (brief(math.degrees(forecast.orientation)), "°")),
        "1σ of the platform's pose at given readings, mean over the joints' ranges",
    )


def forecast_part(forecast: Forecast) -> Part:
    """Section on the predicted accuracy of a capture, and the legs that determine it."""
    stations = tuple(dict.fromkeys(leg.station for leg in forecast.legs))
    numbers = tuple(dict.fromkeys(leg.leg for leg in forecast.legs))
    by = {(leg.station, leg.leg): leg for leg in forecast.legs}
    total = {j: sum(by[s, j].tells for s in stations) for j in numbers}
    mean = sum(total.values()) / len(total)
    poor = [j for j in numbers if total[j] < MAJORITY * mean]
    hints = ("", *LEG_COLUMNS.values())
    details = Table(
        "By station and leg",
        ("Station, leg", *LEG_COLUMNS),
        tuple(Row(f"{leg.station}, {leg.leg}", _cells(leg)) for leg in forecast.legs),
        brief=False,
        folded=True,
        hints=hints,
    )
    if len(stations) == 1:
        rows = tuple(
            Row(str(leg.leg), _cells(leg), mark=Level.NOTE if leg.leg in poor else "good")
            for leg in forecast.legs
        )
        tables = (Table("Legs", ("Leg", *LEG_COLUMNS), rows, brief=bool(poor), hints=hints),)
    else:
        rows = tuple(
            Row(
                str(j),
                (
                    *(percentage(by[s, j].tells) for s in stations),
                    percentage(total[j]),
                    percentage(sum(by[s, j].variance for s in stations)),
                ),
                mark=Level.NOTE if j in poor else "good",
            )
            for j in numbers
        )
        together = [sum(by[s, j].tells for j in numbers) for s in stations]
        variance = sum(leg.variance for leg in forecast.legs)
        all_ = Row(
            "all", tuple(percentage(x) for x in (*together, sum(together), variance)), mark="good"
        )
        share = LEG_COLUMNS["Information"]
        head = ("Leg", *stations, "All stations", "Tool variance")
        shares = Table(
            "Information by leg and station", head, (*rows, all_),
            brief=bool(poor), shaded=tuple(range(1, 1 + len(stations))),
            hints=("", *(share for _ in head[1:-1]), LEG_COLUMNS["Tool variance"]),
        )  # fmt: skip
        tables = (shares, details)
    return Part(
        "forecast",
        "What these images would give" if forecast.handheld else "What a full capture would give",
        terminal_text=_forecast_lines(forecast, poor),
        tables=tables,
    )


def _forecast_lines(forecast: Forecast, poor: list[int]) -> tuple[str, ...]:
    """Sentences on the forecast, and on the legs with the least information and their causes."""
    subject, source = f"{forecast.photographs} such images a station, over the joints' ranges,", ""
    if forecast.handheld:
        subject = f"These {count(forecast.photographs, 'localized image')}"
    else:
        images = sum(len(edges.images) for edges in forecast.edges)
        source = f", by the edges of {count(images, 'image')}"
    out = [
        f"{subject} would determine the platform's position to {brief(forecast.position * 1e3)} mm"
        f" and its orientation to {brief(math.degrees(forecast.orientation))}° (standard deviations"
        f" at given readings{source}). Of its variance"
        f" {percentage(sum(leg.variance for leg in forecast.legs))} comes from the edges,"
        f" {percentage(forecast.readings)} from the readings, {percentage(forecast.drawing)} from"
        " the priors of the nominal model and of shading."
    ]
    for j in poor:
        mine = [leg for leg in forecast.legs if leg.leg == j]
        why: list[str] = []
        for leg in mine:
            if leg.seen < 1 - INFORMATION_LOST_SHARE:
                why.append(f"{percentage(1 - leg.seen)} hidden from {leg.station}")
            elif leg.found < 1 - INFORMATION_LOST_SHARE:
                why.append(f"{percentage(1 - leg.found)} of its edges lost at {leg.station}")
        because = f": {listed(why, 3)}" if why else ""
        share = percentage(sum(leg.tells for leg in mine))
        out.append(f"Leg {j} contributes little, {share} of the edges' information{because}.")
    return tuple(out)


def _cells(leg: LegForecast) -> tuple[str, ...]:
    sigma = f"{leg.sigma:.2f} px" if math.isfinite(leg.sigma) else "–"
    return (
        percentage(leg.seen),
        percentage(leg.found),
        sigma,
        percentage(leg.tells),
        percentage(leg.variance),
    )
