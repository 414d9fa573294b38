"""Report section on the bed: its deviation from a plane at the probed points."""

from __future__ import annotations

import numpy as np

from pkmcal.calibration.discrepancy_basis import BedSurface, ModelError, uneven_bed
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.plot import (
    ColourScale,
    DotsMark,
    Plot,
    Point,
    linear_axis,
    linear_ticks,
    rounded,
)
from pkmcal.session.load import Session
from pkmcal.wording import number

PROBE_RADIUS = 7.0
"""Radius of a probed point's mark, px."""


def section(session: Session, errors: tuple[ModelError, ...]) -> Part | None:
    """Section with the bed's map; None unless the data show an uneven bed with certainty."""
    for error in errors:
        if error.sure and error.surface is not None:
            plot = surface_plot(session, error.surface)
            return Part("bed", "The bed", (uneven_bed(error).text,), blocks=(plot,))
    return None


def surface_plot(session: Session, surface: BedSurface) -> Plot:
    """Map of the bed: a marker at each probed point, coloured by its height."""
    x, y, height, sigma = (
        (1e3 * values).tolist() for values in (surface.x, surface.y, surface.height, surface.sigma)
    )
    points: list[Point] = []
    for k, *values in zip(surface.configuration.tolist(), x, y, height, sigma, strict=True):
        name, (at_x, at_y, z, spread) = session.configurations[k], values
        tip = f"{name}: {number(z, 3, signed=True)} ± {number(spread, 3)} mm"
        points.append(
            Point(
                x=rounded(at_x),
                y=rounded(at_y),
                value=rounded(z),
                tip=tip,
                key=configuration_key(name),
            )
        )
    most = float(np.max(np.abs(height), initial=1e-6))
    return bed_map(
        "surface",
        "How uneven the bed is",
        points,
        ("height, mm", most),
        "Heights of the points that were probed above their mean, as smooth as the data"
        " show them to be. A bending of the machine is not distinguished from the bed's; that is in"
        " the standard deviations.",
    )


def bed_map(
    name: str, title: str, points: list[Point], scale: tuple[str, float], caption: str = ""
) -> Plot:
    """Map of the bed: a mark at each probed point, coloured by its value.

    points : x, y and value, mm. scale : name of the value, and its largest magnitude.
    """
    label, most = scale
    return Plot(
        name=name,
        title=title,
        caption=caption,
        alt=f"{title}: a map of the bed, coloured by {label}, which is within"
        f" {number(most, 3)} mm.",
        x=linear_axis("x, mm", [float(point.x) for point in points]),
        y=linear_axis("y, mm", [float(point.y) for point in points]),
        marks=(DotsMark(name="", colour="quiet", points=tuple(points), radius=PROBE_RADIUS),),
        colours=ColourScale(
            label=label,
            limits=(-most, most),
            ticks=linear_ticks(-most, most),
            diverging=True,
        ),
        equal=True,
    )
