"""The page: every section's view, put into the templates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pkmcal.identify.problem import Estimate
from pkmcal.identify.tool import centres_and_tool
from pkmcal.measurements import Observation
from pkmcal.report import (
    headline,
    identifiability,
    parameters,
    pictures,
    poses,
    provenance,
    residuals,
    scene,
    validation_page,
)
from pkmcal.report import page as templating
from pkmcal.report import provenance as rejections
from pkmcal.report import scene as figure
from pkmcal.session.load import Session

if TYPE_CHECKING:
    from pkmcal.identify.unidentified import Findings
    from pkmcal.outcome import Verdict
    from pkmcal.validate.holdouts import HoldOut


def report_html(
    session: Session,
    observation: Observation,
    estimate: Estimate,
    verdict: Verdict,
    *,
    findings: Findings | None = None,
    timings: Mapping[str, float] | None = None,
    holdout: HoldOut | None = None,
) -> str:
    """One HTML page that needs nothing else: no network, no other file.

    verdict : usable, headline, reasons, warnings, advice. findings : what the data tell of the
    machine; without them their section is left out. timings : seconds by step. holdout : what the
    estimate predicts of configurations that it did not see.
    """
    views = report_views(session, observation, estimate, findings)
    return templating.render(
        "report.html.j2",
        **views,
        verdict=verdict,
        timings=provenance.durations(timings),
        holdout=validation_page.holdout_views(holdout, session),
        plotly=figure.plotly_script(),
    )


def report_views(
    session: Session,
    observation: Observation,
    estimate: Estimate,
    findings: Findings | None = None,
) -> dict[str, Any]:
    """Everything that the templates show besides the verdict, by its name there."""
    edges, machine = observation.edges, estimate.machine
    camera = residuals.camera_numbers(session)
    centres, tool = centres_and_tool(session.machine, estimate, session.joints)
    shifts = residuals.outward_shift(edges, estimate, session.joints, camera)
    groups = parameters.parameter_groups(session.machine, estimate)
    drawn = scene.scene_of(session, estimate, centres)
    seen = poses.places(observation, estimate)
    # boards and trackers alone have no edges to show; legs without any do have a question
    photographed = len(edges) > 0 or not len(observation.poses)
    return {
        "session": session,
        "estimate": estimate,
        "headlines": headline.headlines(session, observation, estimate, centres, tool),
        "scene": drawn,
        "views": scene.views(drawn),
        "figure": figure.figure_of(drawn, seen, session.configurations),
        "groups": groups,
        "unidentified": parameters.bound_together(estimate)
        if findings
        else parameters.unidentified(groups, estimate),
        "told": findings and identifiability.section(findings, machine.parameters),
        "edges": photographed,
        "pictures": pictures.pictures(session, edges, estimate, shifts, centres)
        if photographed
        else (),
        "poses": poses.section(session, observation, estimate),
        "residuals": residuals.residual_charts(session, edges, estimate, shifts),
        "reasons": rejections.reasons(session, observation.rejected),
        "stations": provenance.station_rows(session, estimate, camera),
        "settings": provenance.settings(session, estimate),
        "versions": provenance.versions(),
    }
