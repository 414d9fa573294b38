"""Report section on the bed: its deviation from a plane at the probed points."""

from __future__ import annotations

import numpy as np

from pkmcal.calibration.discrepancy_basis import BedSurface, ModelError, uneven_bed
from pkmcal.outcome import Part, Plot
from pkmcal.pages.plots import plane
from pkmcal.session.load import Session

SURFACE_COLOUR_SCALE = [[0.0, "--calibrated"], [0.5, "--band"], [1.0, "--drawing"]]
"""Colours below the mean, at the mean, and above it."""


def section(session: Session, errors: tuple[ModelError, ...]) -> Part | None:
    """Section with the bed's map; None unless the data show an uneven bed with certainty."""
    for error in errors:
        if error.sure and error.surface is not None:
            plot = surface_plot(session, error.surface)
            return Part("bed", "The bed", (uneven_bed(error).text,), plots=(plot,))
    return None


def surface_plot(session: Session, surface: BedSurface) -> Plot:
    """Map of the bed: a marker at each probed point, coloured by its height."""
    x, y, height, sigma = (
        np.round(1e3 * values, 4).tolist()
        for values in (surface.x, surface.y, surface.height, surface.sigma)
    )
    most = float(np.max(np.abs(surface.height), initial=0.0)) * 1e3
    names = [session.configurations[k] for k in surface.configuration]
    trace = {
        "type": "scatter",
        "mode": "markers",
        "x": x,
        "y": y,
        "customdata": [list(row) for row in zip(names, height, sigma, strict=True)],
        "hovertemplate": "%{customdata[0]}: %{customdata[1]:.3f} ± %{customdata[2]:.3f} mm"
        "<extra></extra>",
        "marker": {
            "size": 14,
            "color": height,
            "cmin": -most,
            "cmax": most,
            "colorscale": SURFACE_COLOUR_SCALE,
            "showscale": True,
            "colorbar": {
                "title": {"text": "mm", "side": "top"},
                "thickness": 12,
                "outlinewidth": 0,
            },
        },
    }
    layout = plane("x, mm", "y, mm")
    layout["yaxis"] = {**layout["yaxis"], "scaleanchor": "x"}
    layout["showlegend"] = False
    return Plot(
        "surface",
        "How uneven the bed is",
        "Heights of the points that were probed above their mean, as smooth as the data show them"
        " to be. A bending of the machine is not distinguished from the bed's; that is in the"
        " standard deviations. Point at a mark for its number.",
        "A map of the bed, coloured by height.",
        {"data": [trace], "layout": layout, "config": {}},
    )
