"""The page: every section's view, put into the templates."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.identify.centres import free_of_gauge, joint_centres
from pkmcal.identify.problem import Estimate
from pkmcal.observe.edges import Observation
from pkmcal.report import (
    charts,
    figure,
    headline,
    parameters,
    pictures,
    provenance,
    rejections,
    residuals,
    scene,
    toolpoint,
    wording,
)
from pkmcal.session import Session

if TYPE_CHECKING:
    import jinja2

    from pkmcal.identify.verdict import Verdict

N_COLOURS = 8
"""Leg colours in the style sheet; machines with more legs use them again."""


def report_html(
    session: Session,
    observation: Observation,
    estimate: Estimate,
    verdict: Verdict,
    *,
    timings: Mapping[str, float] | None = None,
) -> str:
    """One HTML page that needs nothing else: no network, no other file.

    verdict : usable, headline, reasons, warnings, advice. timings : seconds by step.
    """
    views = report_views(session, observation, estimate)
    template = _environment().get_template("report.html.j2")
    return template.render(
        **views,
        verdict=verdict,
        timings=provenance.durations(timings),
        plotly=figure.plotly_script(),
    )


def report_views(session: Session, observation: Observation, estimate: Estimate) -> dict[str, Any]:
    """Everything that the templates show besides the verdict, by its name there."""
    edges, machine = observation.edges, estimate.machine
    camera = residuals.camera_numbers(session)
    covariance = free_of_gauge(estimate)
    centres = joint_centres(session.machine, machine, covariance)
    tool = toolpoint.tool_point(
        session.machine,
        machine,
        covariance,
        session.joints,
        estimate.state.T_base_platform,
        np.flatnonzero(estimate.configurations),
        centres,
    )
    shifts = residuals.outward_shift(edges, estimate, session.joints, camera)
    groups = parameters.parameter_groups(session.machine, estimate)
    drawn = scene.scene_of(session, estimate, centres)
    return {
        "session": session,
        "estimate": estimate,
        "headlines": headline.headlines(session, observation, estimate, centres, tool),
        "scene": drawn,
        "views": scene.views(drawn),
        "figure": figure.figure_of(drawn),
        "groups": groups,
        "unidentified": parameters.unidentified(groups, estimate),
        "pictures": pictures.pictures(session, edges, estimate, shifts, centres),
        "residuals": residuals.residual_charts(session, edges, estimate, shifts),
        "reasons": rejections.reasons(session, observation.rejected),
        "stations": provenance.station_rows(session, estimate, camera),
        "settings": provenance.settings(session, estimate),
        "versions": provenance.versions(),
    }


@cache
def _environment() -> jinja2.Environment:
    """Templates of this package, every value escaped unless a template says otherwise."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pkmcal.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    shared: dict[str, Any] = {"charts": charts, "count": wording.count}
    environment.globals.update(shared)
    environment.filters["leg"] = _colour_class
    return environment


def _colour_class(leg: int | None) -> str:
    """The style sheet's name of a leg's colour; legs from 1."""
    return f"leg-{(leg - 1) % N_COLOURS + 1}" if leg else "no-leg"
