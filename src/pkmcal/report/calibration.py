"""What a calibration found, as an outcome: its verdict, main numbers, and the report's parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.results import REPORT, check_output, texts_of, versions
from pkmcal.files import write_folder
from pkmcal.identify.centres import Centres
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import centres_and_tool
from pkmcal.judge.holdouts import holdout_of
from pkmcal.measurements import EdgeSet, Observation
from pkmcal.outcome import Finding, Level, Outcome, Part, Plot, Verdict
from pkmcal.report import (
    headline,
    identifiability,
    page,
    parameters,
    pictures,
    poses,
    provenance,
    residuals,
    scene,
    validation,
)
from pkmcal.session.load import Session

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.identify.unidentified import Findings
    from pkmcal.judge.holdouts import HoldOut

MODEL_ERROR = Markup(
    "<strong>What σ means here.</strong> The standard deviations say how much the result would"
    " scatter if the same photographs and readings were taken again. They know the noise of the"
    " measurement and nothing of what the model leaves out: legs that bend, joints with play, a"
    " lens that its file does not describe. Photographs that the calibration has not seen are the"
    " test for those."
)


def outcome_of(calibration: Calibration) -> Outcome:
    """Everything that `pkmcal calibrate` tells and writes."""
    c, held_out = calibration, holdout_of(calibration)
    told = report_of(
        c.session,
        c.observation,
        c.estimate,
        c.verdict,
        findings=c.findings,
        timings=c.timings,
        holdout=held_out,
    )
    groups = parameters.parameter_groups(c.session.machine, c.estimate)
    open_ = parameters.unidentified(groups, c.estimate, c.findings)
    numbers = held_out and held_out.document(c.session.configurations)
    return replace(
        told,
        closing="" if c.verdict.usable else "Written all the same, to find out why:",
        texts=texts_of(c, open_, numbers),
        summary={
            "verdict": asdict(c.verdict),
            **(told.summary or {}),
            "session_warnings": c.session.warnings,
            "holdout": numbers,
            "timings": c.timings,
        },
    )


def save(calibration: Calibration, folder: Path | str) -> None:
    """Write a calibration's three files into `folder`, whole or not at all."""
    check_output(folder)
    found = outcome_of(calibration)
    write_folder(Path(folder), {REPORT: page.page_html(found), **found.texts})


def report_of(
    session: Session,
    observation: Observation,
    estimate: Estimate,
    verdict: Verdict,
    *,
    findings: Findings | None = None,
    timings: Mapping[str, float] | None = None,
    holdout: HoldOut | None = None,
) -> Outcome:
    """The verdict, cards and parts.

    findings : what the data tell of the machine; without them their section is left out.
    timings : seconds by step. holdout : what the estimate predicts of configurations that it did
    not see.
    """
    edges = observation.edges
    camera = residuals.camera_numbers(session)
    shifts = residuals.outward_shift(edges, estimate, session.joints, camera)
    centres, tool = centres_and_tool(session.machine, estimate, session.joints)
    # boards and trackers alone have no edges to show; legs without any do have a question
    photographed = len(edges) > 0 or not len(observation.poses)
    parts = (
        _geometry(session, observation, estimate, centres),
        _parameters(session, estimate),
        findings and _identifiability(findings, estimate),
        _photographs(session, edges, estimate, shifts, centres) if photographed else None,
        poses.section(session, observation, estimate),
        holdout and validation.held_out(holdout, session),
        residuals.section(
            session, edges, estimate, shifts, poses.axes(observation.poses, estimate)
        ),
        _left_out(session, observation, estimate, findings),
        _stations(session, estimate, camera),
        _how(session, estimate, timings or {}),
    )
    return Outcome(
        command="calibrate",
        title=f"Calibration of {session.machine.name}",
        verdict=verdict,
        kicker=f"session {session.folder.name}",
        figures=headline.cards(session, observation, estimate, centres, tool),
        parts=tuple(part for part in parts if part),
        findings=tuple(Finding(Level.DOUBTFUL, text) for text in session.warnings),
        summary={"figures": headline.numbers(observation, estimate, centres, tool)},
    )


def _geometry(
    session: Session, observation: Observation, estimate: Estimate, centres: tuple[Centres, ...]
) -> Part:
    drawn = scene.scene_of(session, estimate, centres)
    seen = poses.places(observation, estimate)
    return Part(
        "geometry",
        "Geometry before and after",
        (page.render("geometry.html.j2", scene=drawn),),
        plots=(
            Plot(
                "space",
                "In space",
                "Drag to turn, wheel or pinch to come nearer.",
                "The machine in three dimensions: joint centres by the drawing and as calibrated."
                " The two plane views show the same.",
                scene.figure_of(drawn, seen, session.configurations),
                height=420,
            ),
        ),
        html=page.render("views.html.j2", views=scene.views(drawn)),
        menu="Geometry",
    )


def _parameters(session: Session, estimate: Estimate) -> Part:
    groups = parameters.parameter_groups(session.machine, estimate)
    html = page.render("parameters.html.j2", groups=groups, gauge=estimate.gauge)
    return Part("parameters", "Parameters", html=html)


def _identifiability(findings: Findings, estimate: Estimate) -> Part:
    told = identifiability.section(findings, estimate.machine.parameters)
    html = page.render("identifiability.html.j2", told=told)
    return Part("identifiability", "What the data can tell", html=html, menu="What the data tell")


def _photographs(
    session: Session,
    edges: EdgeSet,
    estimate: Estimate,
    shifts: Array,
    centres: tuple[Centres, ...],
) -> Part:
    html = page.render(
        "photographs.html.j2",
        n_legs=session.machine.n_legs,
        pictures=pictures.pictures(session, edges, estimate, shifts, centres),
    )
    return Part("photographs", "Photographs", html=html)


def _left_out(
    session: Session, observation: Observation, estimate: Estimate, findings: Findings | None
) -> Part:
    groups = parameters.parameter_groups(session.machine, estimate)
    html = page.render(
        "rejected.html.j2",
        reasons=provenance.reasons(session, observation.rejected),
        told=bool(findings),
        unidentified=parameters.bound_together(estimate)
        if findings
        else parameters.unidentified(groups, estimate),
    )
    return Part("rejected", "What was left out, and what stays open", html=html, menu="Left out")


def _stations(session: Session, estimate: Estimate, camera: Integers) -> Part:
    table = provenance.stations_table(session, estimate, camera)
    return Part("stations", "Where the cameras stood", tables=(table,), menu="Cameras")


def _how(session: Session, estimate: Estimate, timings: Mapping[str, float]) -> Part:
    html = page.render(
        "how.html.j2",
        model_error=MODEL_ERROR,
        lists=(
            ("Settings and solver", provenance.settings(session, estimate)),
            ("Time", [(name, f"{seconds:.2f} s") for name, seconds in timings.items()]),
            ("Versions", versions().items()),
        ),
    )
    return Part("how", "How it was computed", html=html)
