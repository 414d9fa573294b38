"""What a calibration found, as an outcome: its verdict, main numbers, and the report's parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pkmcal.calibration.results import REPORT, check_output, texts_of
from pkmcal.files import write_folder
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import centres_and_tool
from pkmcal.judge.holdouts import holdout_of
from pkmcal.measurements import Observation
from pkmcal.outcome import Finding, Level, Outcome, Verdict
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
        scene.section(session, estimate, centres, poses.places(observation, estimate)),
        parameters.section(session.machine, estimate),
        findings and identifiability.section(findings, estimate.machine.parameters),
        pictures.section(session, edges, estimate, shifts, centres) if photographed else None,
        poses.section(session, observation, estimate),
        holdout and validation.held_out(holdout, session),
        residuals.section(
            session, edges, estimate, shifts, poses.axes(observation.poses, estimate)
        ),
        provenance.left_out(session, observation.rejected, estimate, findings),
        provenance.stations(session, estimate, camera),
        provenance.how(session, estimate, timings or {}),
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
