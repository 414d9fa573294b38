"""Calibration as an outcome: its verdict, main numbers, and the parts of the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array, rms
from pkmcal.calibration import toolmap
from pkmcal.calibration.archive import keep_earlier
from pkmcal.calibration.file_names import CALIBRATION_REPORT_FILE
from pkmcal.calibration.results import (
    calibration_document,
    check_output,
    rejected_photographs,
    texts_of,
)
from pkmcal.calibration.toolmap import ToolMap
from pkmcal.errors import PkmcalError
from pkmcal.files import output_lock, write_folder
from pkmcal.identify.centres import Centres, free_of_gauge
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import ToolAccuracy, centres_and_tool, platform_sigma
from pkmcal.identify.verdict import VERDICT
from pkmcal.levels import CONTRADICTION_SIGMAS, ROUNDING
from pkmcal.measurements import LinkSet, Observation
from pkmcal.outcome import Figure, Outcome
from pkmcal.outcome.blocks.log_bar import LogBar, Magnitude
from pkmcal.outcome.finding import Level, Mark
from pkmcal.report import (
    bed,
    correlation_plot,
    field,
    heights,
    identifiability,
    link_measurements,
    parameters,
    pictures,
    poses,
    provenance,
    residuals,
    scene,
    workspace,
)
from pkmcal.session.load import Session, digests, session_digest
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.web.report_page import is_remark, report_page
from pkmcal.wording import amount, brief, count, number, percentage

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.identify.bed import Bed
    from pkmcal.judge.holdouts import HoldOut

OF_RESULT = frozenset({"geometry", "workspace", "parameters"})
"""Sections that mean nothing if the result is refused; others show why it was."""
TOOL_QUESTION = "How well is the platform's pose known?"
FLATNESS_QUESTION = "How flat will the bed be?"
CHANGE_QUESTION = "How far is the machine from its nominal model?"
DATA_QUESTION = "What is it based on?"
FIT_QUESTION = "Does the model explain the data?"


def outcome_of(calibration: Calibration) -> Outcome:
    """Outcome of `pkmcal calibrate`, with the texts of its files."""
    c, held_out, over = calibration, _held_out(calibration), _tool_map(calibration)
    file_digests = digests(c.session)
    report = report_of(c, held_out, over, session_digest(c.session, file_digests))
    open_ = parameters.unidentified(c.estimate, c.identification)
    predicted = held_out.document(c.session.configurations) if held_out else None
    return replace(
        report,
        closing="" if c.verdict.usable else "Written all the same, to find out why:",
        texts=texts_of(c, calibration_document(c, open_, predicted, over, file_digests)),
        summary={
            "verdict": c.verdict.document(),
            **(report.summary or {}),
            "session_warnings": c.session.warnings,
            "photographs": c.session.images_taken,
            "rejected_photographs": rejected_photographs(c.session),
            "heights": c.heights.document(c.session),
            "holdout": predicted,
            "timings": c.timings,
        },
    )


def _held_out(calibration: Calibration) -> HoldOut | None:
    """Comparison of the estimate with the holdout, None without one."""
    if calibration.holdout is None:  # the usual case; the import below is slow
        return None
    from pkmcal.judge.holdouts import holdout_of

    return holdout_of(calibration)


def _tool_map(calibration: Calibration) -> ToolMap | str:
    """Tool error over the workspace, or the sentence on why there is no map."""
    try:
        return toolmap.of_calibration(calibration)
    except PkmcalError as error:
        return f"There is no map of the workspace: {error}"


def save(
    calibration: Calibration,
    folder: Path | str,
    *,
    force: bool = False,
    outcome: Outcome | None = None,
) -> Path | None:
    """Write a calibration's three files into ``folder``, all or none.

    An earlier result there is moved beside it, into a folder with its date, which is returned;
    ``force`` replaces it. Raises InputError if the folder holds anything else.

    outcome : of the calibration, where it has been made already.
    """
    folder = Path(folder)
    check_output(folder, force=force)
    outcome = outcome or outcome_of(calibration)
    texts = {CALIBRATION_REPORT_FILE: report_page(outcome, datetime.now()), **outcome.texts}
    with output_lock(folder):  # another process may have written into it since the first check
        over = check_output(folder, force=force)
        archive_folder = None if force else keep_earlier(folder, outcome.texts)
        write_folder(folder, texts, over)
    return archive_folder


def report_of(
    calibration: Calibration,
    holdout: HoldOut | None = None,
    over: ToolMap | str | None = None,
    digest: str = "",
) -> Outcome:
    """Outcome with verdict, cards and parts.

    holdout : prediction of configurations that the estimate did not use; None for none.
    over : tool error over the workspace, or the reason why there is no map; None for no section.
    digest : digest of the session.
    """
    # data that several sections share: offsets of edges, joint centres, images and links to them
    c, session, observation = calibration, calibration.session, calibration.observation
    estimate, findings, edges = calibration.estimate, calibration.identification, observation.edges
    shifts = residuals.outward_shift(edges, estimate, session.joints, session.camera_of_station)
    held = None
    if holdout:
        from pkmcal.report.validation import held_out_part

        held = held_out_part(holdout, session)
    centres, tool = centres_and_tool(session.machine, estimate, session.joints)
    album = pictures.album(c, shifts, centres)
    targets = poses.target_places(observation, estimate)
    # sections in the order of the page
    parts = (
        scene.section(session, estimate, centres, targets, over),
        provenance.stations(session, observation, estimate),
        workspace.section(session, estimate, over) if over else None,
        parameters.section(session.machine, estimate),
        pictures.section(session, album) if session.stations else None,
        heights.section(session, c.heights),
        poses.section(session, observation, estimate),
        *link_measurements.sections(session, _links(c), estimate),
        held,
        bed.section(session, c.model_errors),
    )
    expert_parts = (
        identifiability.section(findings, estimate.machine.parameters),
        correlation_plot.section(estimate),
        residuals.section(
            session, edges, estimate, shifts, poses.axes(observation.poses, estimate)
        ),
        field.section(
            session,
            observation,
            estimate,
            album.corners,
            pictures.station_images(c),
            [one.key for one in album.images],
        ),
        provenance.left_out(session, observation.rejected, estimate),
        provenance.how(session, estimate, c.timings),
    )
    return Outcome(
        command="calibrate",
        title=f"Calibration of {session.machine.name}",
        verdict=c.verdict,
        kicker=session.called,
        origin=(f"digest of the session {digest}",) if digest else (),
        notes=(session.document.get("notes") or "").strip(),
        explanation=_joint_accuracy(estimate, centres) if len(edges) and c.verdict.usable else "",
        comparison=_comparison(c, tool, holdout) if c.verdict.usable else None,
        certificate=provenance.certificate(c, digest),
        partial=any(one.sure for one in c.model_errors),
        figures=calibration_cards(c, centres, tool),
        parts=(
            *(replace(part, of_result=part.name in OF_RESULT) for part in parts if part),
            *(replace(part, expert=True) for part in expert_parts if part),
        ),
        findings=session.findings,
        summary={"figures": calibration_numbers(observation, estimate, centres, tool)},
    )


# ------------------------------------------------------------------ the main numbers


def calibration_cards(
    calibration: Calibration, centres: tuple[Centres, ...], tool: ToolAccuracy
) -> tuple[Figure, ...]:
    """Cards in their order; those without data are left out."""
    session, observation = calibration.session, calibration.observation
    # the flatness exists for sessions of heights only
    estimate, flatness = calibration.estimate, calibration.identification.bed
    # joint centres: standard deviation, and distance from the nominal model, mm
    sigma = np.concatenate([side.sigma for side in centres]) * 1e3
    worst = int(np.argmax(sigma))
    joints = Figure(
        "How well are the joint centres known?",
        ((brief(float(np.median(sigma))), "mm"),),
        f"1σ of a coordinate, median of {len(sigma)} centres; the least certain, "
        f"{_centre_name(centres, worst)}, {brief(float(sigma[worst]))} mm",
    )
    change = np.concatenate([np.linalg.norm(side.change, axis=-1) for side in centres]) * 1e3
    farthest = int(np.argmax(change))
    shifted = Figure(
        CHANGE_QUESTION,
        ((brief(float(change.mean())), "mm"),),
        "mean distance of the joint centres, nominal model and result laid over each other;"
        f" largest {brief(float(change[farthest]))} mm ({_centre_name(centres, farthest)})",
    )
    cards = (
        _flatness(flatness, tool) if flatness else None,
        joints if len(observation.edges) else None,
        _tool_sigma(session, estimate, tool),
        shifted,
        _tool_change(session, estimate, tool),
        _data(session, observation, estimate, _links(calibration)),
        _fit(session, estimate),
    )
    limits = _limits(calibration)
    return tuple(
        replace(card, limit=limits[card.question][0], mark=limits[card.question][1])
        if card.question in limits
        else card
        for card in cards
        if card
    )


def _limits(calibration: Calibration) -> dict[str, tuple[str, Mark]]:
    """Limits of a usable result by the question of their card, with the verdict's own judgement."""
    estimate, findings, verdict = (
        calibration.estimate, calibration.identification, calibration.verdict,
    )  # fmt: skip
    statistics = estimate.statistics

    def judged(*codes: str) -> Mark:
        of_codes = [one for code in codes for one in verdict.of(code)]
        levels = {one.level for one in of_codes if not is_remark(one)}
        return next((one for one in (Level.WRONG, Level.DOUBTFUL) if one in levels), "good")

    far = verdict.of("machine.far_from_nominal")
    limits: dict[str, tuple[str, Mark]] = {
        CHANGE_QUESTION: (
            f"{'values' if far else 'no value'} beyond {CONTRADICTION_SIGMAS:g} tolerances",
            judged("machine.far_from_nominal"),
        )
    }
    # what the result is for: the flatness of a bed, else the platform's joints at given readings
    share, bed = VERDICT.nominal_error_share, findings.bed
    if bed:
        limits[FLATNESS_QUESTION] = (
            f"limit {amount(share * bed.by_drawing, 'm')}: {percentage(share)} of what the"
            " tolerances give",
            judged("bed.no_gain", "bed.height_unnoticed"),
        )
    elif np.any(estimate.configurations):
        limits[TOOL_QUESTION] = (
            f"platform's joints {amount(platform_sigma(estimate), 'm')}, limit"
            f" {amount(share * findings.by_nominal, 'm')}: {percentage(share)} of what the"
            " tolerances give",
            judged("platform.no_gain", "machine.undetermined"),
        )
    weights = np.concatenate([*estimate.weights.values()])
    if weights.size:
        rejected = float(np.mean(weights < INLIER_WEIGHT))
        limits[DATA_QUESTION] = (
            f"{percentage(rejected)} rejected, limit {percentage(VERDICT.too_many_rejected)}",
            judged("data.rejected_share", "edges.leg_seldom_seen"),
        )
    scales = [one.scale for one in statistics.groups if one.n and one.name in estimate.weights]
    if scales and statistics.dof > 0 and calibration.method == "bundle":
        limits[FIT_QUESTION] = (
            f"noise {number(max(scales), 2)} times as stated, limit {VERDICT.too_noisy:g} times",
            judged("data.misfit", "data.scatter", "readings.misfit"),
        )
    return limits


def _joint_accuracy(estimate: Estimate, centres: tuple[Centres, ...]) -> str:
    """Sentence on the joint centres and offsets, medians that favour no frame."""
    machine = estimate.machine
    sigma = float(np.median(np.concatenate([side.sigma for side in centres])))
    offsets = np.diag(free_of_gauge(machine, estimate.covariance))[
        machine.parameters.of_kind("offset")
    ]
    also = (
        f" and offsets to {amount(float(np.sqrt(np.median(offsets))), 'm')}" if offsets.size else ""
    )
    return f"Joint centres to {amount(sigma, 'm')}{also} (standard deviations)."


def _comparison(
    calibration: Calibration, tool: ToolAccuracy, holdout: HoldOut | None
) -> LogBar | None:
    """Error of the tool's position by tolerances, as measured, after calibration and held out."""
    machine = calibration.estimate.machine
    root = machine.parameters.free_matrix() * machine.parameters.tolerances_free()
    prior = replace(tool, parameters=free_of_gauge(machine, root @ root.T))
    tested = holdout.left_out.figures(holdout.left_out.calibrated).position if holdout else None
    magnitudes = tuple(
        Magnitude(label=label, value=value * 1e3, text=amount(value, "m"), role=role)
        for label, value, role in (
            ("Tolerances", _mean(prior.position), "prior"),
            ("Nominal model", _mean(tool.off_position), "nominal"),
            ("Calibrated", _mean(tool.position), "calibrated"),
            ("Held out", tested, "test"),
        )
        if value is not None and np.isfinite(value) and value > ROUNDING
    )
    if len(magnitudes) < 2:
        return None
    tested_text = (
        " Held out: configurations that the calibration has not used, with the images' own noise."
        if any(one.role == "test" for one in magnitudes)
        else ""
    )
    return LogBar(
        title="Error of the tool's position",
        unit="mm",
        magnitudes=magnitudes,
        note=f"Means over {count(len(tool.position), 'pose')}. Tolerances and calibrated: standard"
        " deviations. Nominal model: its distance from the calibrated machine at the same"
        f" readings.{tested_text}",
    )


def calibration_numbers(
    observation: Observation, estimate: Estimate, centres: tuple[Centres, ...], tool: ToolAccuracy
) -> dict[str, Any]:
    """Main numbers in m and rad, for the summary of ``--json``.

    Means over joint centres and configurations; sigma is that of one coordinate.
    """
    statistics, table = estimate.statistics, estimate.machine.parameters
    offsets = np.sqrt(np.diag(estimate.covariance)[table.of_kind("offset")])
    sigma = np.concatenate([side.sigma for side in centres])
    change = np.concatenate([np.linalg.norm(side.change, axis=-1) for side in centres])
    return {
        "joint_centre_sigma": float(np.median(sigma)),
        "joint_offset_sigma": float(np.median(offsets)) if offsets.size else None,
        "joint_centre_change": float(change.mean()),
        "platform_position_sigma": _mean(tool.position),
        "platform_orientation_sigma": _mean(tool.orientation),
        "platform_position_change": _mean(tool.off_position),
        "platform_orientation_change": _mean(tool.off_orientation),
        "edges": len(observation.edges),
        "rejected": len(observation.rejected),
        "chi2_per_freedom": statistics.chi2_as_stated if statistics.dof > 0 else None,
        "edge_noise_scale": statistics.noise_scale,
        "reading_noise_scale": statistics.reading_scale,
    }


def _mean(values: Array) -> float | None:
    """Mean of the finite values, None without any."""
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else None


def _tool_sigma(session: Session, estimate: Estimate, tool: ToolAccuracy) -> Figure | None:
    """Card on the standard deviation of the platform's pose that follows from the geometry's."""
    if not np.isfinite(tool.position).any():
        return None
    used = np.flatnonzero(estimate.configurations)
    where = session.configurations[used[int(np.argmax(tool.position))]]
    return Figure(
        TOOL_QUESTION,
        _pose_values(tool.position.mean(), tool.orientation.mean()),
        f"1σ from the geometry's uncertainty, mean over {count(len(tool.position), 'pose')}; "
        f"worst {brief(tool.position.max() * 1e3)} mm (configuration {where})"
        f"{_turn_text(float(tool.orientation.max()))}",
    )


def _flatness(bed: Bed, tool: ToolAccuracy) -> Figure:
    """Card on the flatness of a probed bed.

    The expected sigma of the tool's height, and how the nominal model bent the bed.
    """
    xy = tool.T_base_platform[:, :2, 3]
    finite = np.isfinite(tool.off_position)
    # error of the nominal model in z, without the plane that only tilts and lifts the bed
    plane = np.column_stack([np.ones(int(finite.sum())), xy[finite]])
    off = tool.off[finite, 5]
    bent = off - plane @ np.linalg.lstsq(plane, off, rcond=None)[0]
    return Figure(
        FLATNESS_QUESTION,
        ((brief(bed.sigma * 1e3), "mm"),),
        f"1σ of the tool's height over a disc of {brief(bed.radius * 1e3)} mm radius, the bed's"
        " own tilt and height aside; by the nominal model's tolerances"
        f" {brief(bed.by_drawing * 1e3)} mm. The nominal model bent it by"
        f" {brief(rms(bent) * 1e3)} mm where it was probed. Along x and y"
        f" {brief(bed.sideways * 1e3)} mm, by the nominal model",
    )


def _tool_change(session: Session, estimate: Estimate, tool: ToolAccuracy) -> Figure | None:
    """Card on the errors that the nominal model caused in the platform's pose."""
    good = np.isfinite(tool.off_position)
    if not good.any():
        return None
    off, turn = tool.off_position[good], tool.off_orientation[good]
    used = np.flatnonzero(estimate.configurations)
    where = session.configurations[used[good][int(np.argmax(off))]]
    return Figure(
        "What did the nominal model do to the platform's pose?",
        _pose_values(off.mean(), turn.mean()),
        "mean error of the nominal model's pose at the same readings; worst "
        f"{brief(off.max() * 1e3)} mm (configuration {where}){_turn_text(float(turn.max()))}",
    )


def _links(calibration: Calibration) -> tuple[LinkSet, ...]:
    """Links between configurations in the estimate, by kind."""
    return calibration.measurements.links if calibration.session.links else ()


def _data(
    session: Session, observation: Observation, estimate: Estimate, links: Sequence[LinkSet]
) -> Figure:
    """Card on the data: images and edges, used and unused.

    Without images the trackers' poses and links; without these the readings alone.
    """
    taken = session.images_taken
    if not session.station_names and not session.links:
        return Figure(
            DATA_QUESTION,
            ((str(len(session.configurations)), "poses"),),
            f"{count(session.machine.n_joints, 'reading')} of each, "
            f"{session.machine.redundancy} more than the machine has freedoms; nothing else was"
            " measured",
        )
    # without images: poses and links
    if not taken:
        weights = np.concatenate([estimate.pose_weights, estimate.link_weights])
        quiet, n = int(np.sum(weights < INLIER_WEIGHT)), len(weights)
        kinds = [label for rows in estimate.weights for label in session.labels.get(rows, ())]
        return Figure(
            DATA_QUESTION,
            ((f"{n - quiet} of {n}", " and ".join(kinds)),),
            f"measured without a camera; {quiet} of them given less than half their weight",
        )
    used = sum(provenance.used_images(session, observation, estimate))
    coarse = int(observation.edges.coarse.sum())
    beside = f" and {coarse} from silhouettes" if coarse else ""
    parts = [
        f"{count(n, thing)} measured{more}, {int(np.sum(weights < INLIER_WEIGHT))} of"
        " them given less than half their weight"
        for thing, weights, n, more in (
            ("edge", estimate.edge_weights, len(observation.edges) - coarse, beside),
            ("pose", estimate.pose_weights, len(estimate.pose_weights), ""),
            *(
                (one, part, len(part), "")
                for one, part in link_measurements.weights(links, estimate)
            ),
        )
        if len(weights)
    ]
    lost = taken - sum(len(station.images) for station in session.stations)
    remainder = f"; {count(lost, 'image')} left out whole" if lost else ""
    return Figure(
        DATA_QUESTION,
        ((f"{used} of {taken}", "images"),),
        f"{'; '.join(parts)}; {count(len(observation.rejected), 'measurement')} rejected or"
        f" not detected{remainder}",
    )


def _fit(session: Session, estimate: Estimate) -> Figure:
    """Card on chi-square per degree of freedom, by the noise as stated."""
    s = estimate.statistics
    scaled = [
        f"the {what}' stated noise was multiplied by {number(scale, 2)}"
        for what, scale in (
            (provenance.group_label(session, one.name), one.scale) for one in s.groups
        )
        if np.isfinite(scale) and abs(scale - 1) > 0.005
    ]
    if s.dof <= 0:
        return Figure(
            FIT_QUESTION,
            (("–", "χ² per degree of freedom"),),
            "as many unknowns as measurements: nothing is left over for a test",
        )
    value = s.chi2 / s.dof
    return Figure(
        FIT_QUESTION,
        ((number(s.chi2_as_stated, 2), "χ² per degree of freedom"),),
        f"1 is expected of the noise as stated, over {count(s.dof, 'degree')} of freedom"
        + (f"; {number(value, 2)} after {' and '.join(scaled)}" if scaled else ""),
    )


def _pose_values(position: float, orientation: float) -> tuple[tuple[str, str], ...]:
    """Position, and orientation unless the platform does not turn, with units."""
    turn = ((brief(float(np.rad2deg(orientation))), "°"),) if orientation > ROUNDING else ()
    return ((brief(position * 1e3), "mm"), *turn)


def _turn_text(orientation: float) -> str:
    """Orientation (rad) as the rest of a sentence; empty for a platform that does not turn."""
    return f", {brief(float(np.rad2deg(orientation)))}°" if orientation > ROUNDING else ""


def _centre_name(centres: tuple[Centres, ...], position: int) -> str:
    """Name, as ``leg 3, platform``, of an index into the centres.

    All base centres come first, then all platform centres.
    """
    legs = len(centres[0].calibrated)
    return f"leg {position % legs + 1}, {centres[position // legs].side}"
