"""Model violations of a session: readings, cameras, boards, stations, tubes.

Each violation is a column (:mod:`pkmcal.measurements.columns`) that is defined beside its subject,
with its derivatives and the facts of its finding. Here all of them are score-tested at the
false-alarm level of the session (:mod:`pkmcal.identify.score`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, islice, product
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.camera_refinement import edges_by_camera
from pkmcal.calibration.discrepancy_basis import (
    UNEVEN_BED,
    ModelError,
    bed_surface,
    discrepancy_components,
    model_errors,
    with_discrepancy,
)
from pkmcal.calibration.tube_outlines import Outline, outlines
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.discrepancy import Discrepancy, discrepancy_of
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.score import (
    MOST_VIOLATIONS_SOUGHT,
    OneStepUpdate,
    Score,
    ScoreTests,
)
from pkmcal.identify.tool import ToolAccuracy, tool_error
from pkmcal.measurements import BOARD_MOUNT_NAME, Column, Measurements, Observation
from pkmcal.measurements.effects import columns_of_effects
from pkmcal.mechanisms import machine_from_document
from pkmcal.mechanisms.closure import closure, dense, limb_ends
from pkmcal.mechanisms.closure import scales as scales_of
from pkmcal.mechanisms.disturbances import is_compliant, tool_shift, weight_on_readings
from pkmcal.mechanisms.joints import screw_turns
from pkmcal.outcome.finding import Finding, Level
from pkmcal.session import readings, station_movement
from pkmcal.session.load import Session

Family = Callable[[Session, Observation, Measurements, Estimate], Iterable[Column]]
"""Columns of model violations that share a part of the false-alarm level."""
MOST_TOOL_SHIFT = 1.0
"""Shift of the tool by a violation, in standard deviations, above which the result is refused: the
violation then makes most of the tool's mean squared error."""


@dataclass(frozen=True)
class DetectedViolation:
    """A detected model violation.

    finding : for the verdict, a refusal if it shifts the tool by more than MOST_TOOL_SHIFT.
    value, sigma : (k,) one-step estimates of its numbers, all detected violations together.
    tool, shift : displacement of the platform's position if the violation becomes an unknown, root
        mean square over the session's poses, in its standard deviations, and in m.
    kind : word for calibration.json.
    rivals : columns of violations that explain the data as well, the likeliest first.
    """

    finding: Finding
    value: Array
    sigma: Array
    score: Score
    tool: float
    shift: float
    kind: str
    rivals: tuple[Column, ...] = ()

    @property
    def code(self) -> str:
        """Code of the finding."""
        return self.finding.code

    @property
    def of(self) -> str:
        """Name of the subject."""
        return self.finding.subject

    @property
    def against(self) -> bool:
        """Whether the violation makes the result unusable."""
        return self.finding.level is Level.WRONG

    def document(self) -> dict[str, Any]:
        """Entry of calibration.json."""
        return {
            "code": self.code,
            "kind": self.kind,
            "of": self.of,
            "value": self.value,
            "sigma": self.sigma,
            "chi2": self.score.chi2,
            "dof": self.score.dof,
            "chance": self.score.adjusted,
            "moves_tool": self.shift,
            "moves_tool_in_sigmas": self.tool,
            "rivals": [{"code": one.code, "of": one.subject} for one in self.rivals],
        }


class ModelViolations(NamedTuple):
    """Deviations of the data from the model.

    violations : named violations, the smallest p-value first.
    errors : components of the model discrepancy.
    estimate : estimate whose covariance contains the discrepancy.
    discrepancy_columns : of the discrepancy, with their estimated priors.
    """

    violations: tuple[DetectedViolation, ...]
    errors: tuple[ModelError, ...]
    estimate: Estimate
    discrepancy_columns: tuple[Column, ...]


def model_violations(
    session: Session,
    observation: Observation,
    measurements: Measurements,
    estimate: Estimate,
    tested: Sequence[Family] | None = None,
) -> ModelViolations:
    """Deviations of the data from the model, with and without names.

    A violation is named only if it explains more than the discrepancy does: those that are detected
    first are tested once more beside the discrepancy. The discrepancy in turn is estimated beside
    the violations that are named, and beside no others.

    tested : families of violations, :data:`TESTED` by default.
    """
    candidates = _Candidates.of(
        session, observation, measurements, estimate, TESTED if tested is None else tested
    )
    tests, scores, discrepancy = candidates.beside_discrepancy()
    # covariance with the discrepancy, and its effect on the tool
    before = tool_of(session, estimate)
    estimate = with_discrepancy(estimate, discrepancy)
    tool = tool_of(session, estimate) if discrepancy.scales else before
    surface = None
    if any(one.code == UNEVEN_BED for one in discrepancy.scales):
        surface = bed_surface(measurements, estimate, discrepancy)
    unit = session.machine.joint_units[0]
    return ModelViolations(
        candidates.detections(tests, scores, tool),
        model_errors(discrepancy, tool, before, unit, surface),
        estimate,
        discrepancy.columns,
    )


@dataclass(frozen=True)
class _Candidates:
    """Columns of the violations that are tested.

    listed : columns by family, those of tubes last. After them count the single readings, which
        need no list.
    families : family of each listed column.
    tubes : outlines of tubes, which have scores of their own.
    """

    session: Session
    measurements: Measurements
    estimate: Estimate
    listed: list[Column]
    families: list[int]
    tubes: list[Outline]

    @classmethod
    def of(
        cls,
        session: Session,
        observation: Observation,
        measurements: Measurements,
        estimate: Estimate,
        tested: Sequence[Family],
    ) -> _Candidates:
        """Columns of the families, of effects without a prior, and of tubes."""
        families = [list(family(session, observation, measurements, estimate)) for family in tested]
        further = [one for one in columns_of_effects(measurements) if one.prior is None]
        families += [list(group) for _, group in groupby(further, key=lambda one: one.code)]
        tubes = list(islice(outlines(session, measurements, estimate), MOST_VIOLATIONS_SOUGHT))
        families.append([one.column for one in tubes])
        listed = [(one, n) for n, family in enumerate(families) for one in family]
        columns, numbers = [one for one, _ in listed], [n for _, n in listed]
        return cls(session, measurements, estimate, columns, numbers, tubes)

    def column(self, k: int) -> Column:
        """Column of violation k: a listed one, or a single reading."""
        if k < len(self.listed):
            return self.listed[k]
        names = self.session.document["joints"]["columns"]
        row, m = divmod(k - len(self.listed), len(names))
        configuration = np.flatnonzero(self.estimate.configurations)[row]
        by = np.zeros((*self.measurements.joints.shape, 1))
        by[configuration, m] = 1.0
        unit, name = self.session.machine.joint_units[m], self.session.configurations[configuration]
        return readings.wrong_reading(names[m], unit, name, by)

    @property
    def tube_scores(self) -> dict[int, Score]:
        """Scores of the tubes, by the violation's number."""
        first = len(self.listed) - len(self.tubes)
        return {first + k: one.score for k, one in enumerate(self.tubes)}

    def scored(self, beside: Sequence[Column]) -> tuple[ScoreTests, dict[int, Score]]:
        """Score tests beside other columns, and the significant violations by number."""
        tests = ScoreTests(
            *self.estimate.linearized,
            self.listed,
            self.families,
            singles=True,
            beside=beside,
            variance=1 + self.measurements.imputation_covariance,
        )
        return tests, dict(tests.significant([*self.tube_scores])) | self.tube_scores

    def beside_discrepancy(self) -> tuple[ScoreTests, dict[int, Score], Discrepancy]:
        """Tests and scores of the violations beside the discrepancy, and the latter beside them."""
        components = discrepancy_components(self.measurements, self.estimate)
        statistics = self.estimate.statistics
        alone = self.scored(())
        rivals = [*alone[1]]
        while True:
            discrepancy = discrepancy_of(
                *self.estimate.linearized,
                components,
                [self.column(k) for k in rivals],
                (statistics.reading_scale, statistics.pose_scale),
                self.estimate.purpose is Purpose.HEIGHT,
            )
            beside = discrepancy.scales and alone[1]
            tests, scores = self.scored(discrepancy.columns) if beside else alone
            # a rival that is no violation beside the discrepancy must have no part in it
            if scores.keys() >= set(rivals):
                return tests, scores, discrepancy
            rivals = [k for k in rivals if k in scores]

    def detections(
        self, tests: ScoreTests, scores: Mapping[int, Score], tool: ToolAccuracy
    ) -> tuple[DetectedViolation, ...]:
        """Violations with one-step estimates of their numbers, all together."""
        if not scores:
            return ()
        fits = dict(zip(scores, tests.fitted([*scores]), strict=True))
        # the value of a tube is the median of its lines'
        for k, one in zip(self.tube_scores, self.tubes, strict=True):
            share = one.value / fits[k].value[0] if fits[k].value[0] else 0.0
            value, sigma = np.array([one.value]), np.array([one.sigma])
            fits[k] = OneStepUpdate(value, sigma, fits[k].by_data * share)
        # a tube's value is that of its own lines, so it has no rivals
        rivals = {
            k: () if k in self.tube_scores else tests.rivals(k, [n for n in scores if n != k])
            for k in scores
        }
        return tuple(
            _detection(self.column(k), scores[k], fits[k], tool, [self.listed[n] for n in found])
            for k, found in rivals.items()
        )


def tool_of(session: Session, estimate: Estimate) -> ToolAccuracy:
    """Error of the tool at the session's poses."""
    used, machine = estimate.configurations, estimate.machine
    return tool_error(
        session.machine,
        machine,
        free_of_gauge(machine, estimate.covariance),
        estimate.state.T_base_platform[used],
        session.joints[used],
        legs_observed=estimate.edge_weights.size > 0,
    )


def _detection(
    one: Column, score: Score, fit: OneStepUpdate, tool: ToolAccuracy, rivals: Sequence[Column]
) -> DetectedViolation:
    shift, sigma = tool.shift(fit.by_data), tool.sigma
    ratio = shift / sigma if sigma > 0 else np.inf  # no free parameter moves the tool
    level = Level.WRONG if ratio > MOST_TOOL_SHIFT and not one.remark else Level.DOUBTFUL
    # undetermined numbers are not reported
    facts = {
        name: None if isinstance(value, float) and not np.isfinite(value) else value
        for name, value in one.facts(fit.value, fit.sigma).items()
    }
    facts |= {"chance": score.adjusted, "tool_shift": shift, "tool_shift_sigmas": ratio}
    facts["rivals"] = [f"{other.kind} ({other.subject})" for other in rivals]
    result = Finding(one.code, level, facts, one.subject)
    return DetectedViolation(
        result, fit.value, fit.sigma, score, ratio, shift, one.kind, tuple(rivals)
    )


def _reading_scales(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Scales of the readings."""
    del observation
    layout, document = estimate.machine.layout, session.document["joints"]
    drawn = scales_of(layout, session.machine.parameters.nominal)
    present = scales_of(layout, estimate.machine.values) / drawn
    first = [int(np.argmax(layout.actuated == m)) for m in range(len(document["columns"]))]
    yield from readings.scale_columns(measured.joints, document["columns"], present[first])


def _motors(
    columns: Callable[[Array, Sequence[str], Sequence[str]], Iterator[Column]],
    session: Session,
    observation: Observation,
    measured: Measurements,
    estimate: Estimate,
) -> Iterator[Column]:
    """Columns of the motors' readings, from their names and units."""
    del observation, estimate
    names, units = session.document["joints"]["columns"], session.machine.joint_units
    return columns(measured.joints, names, units)


def _lenses(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Cameras that differ from their files, by the violations that their models declare."""
    del estimate
    if measured.intrinsics_factor.shape[-1]:
        return  # they are estimated already
    changed = CameraChange.of(session, observation, measured)
    if changed is None:
        return
    files = {station.camera_file: station.camera for station in session.stations}
    for file, camera in files.items():
        own = np.array([station.camera_file == file for station in session.stations])
        for part in camera.violations():
            facts = _of_lens(part.facts, file=file)
            one = Column(f"camera.{part.code}", file, LENS_KINDS[part.code], facts=facts)
            yield changed.of_stations(one, own, part.columns)


def _lenses_of_stations(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Station whose camera differs from that of the other stations with the same file.

    Not for hand-held images, whose focal lengths are estimated one by one.
    """
    del estimate
    files = [station.camera_file for station in session.stations]
    shared = [
        files.count(station.camera_file) > 1 and not station.handheld
        for station in session.stations
    ]
    changed = CameraChange.of(session, observation, measured) if any(shared) else None
    if changed is None:
        return
    for s in np.flatnonzero(shared).tolist():
        station, own = session.stations[s], np.arange(len(files)) == s
        for part in station.camera.violations():
            facts = _of_lens(part.facts, file=station.camera_file, station=station.name)
            kind = f"station's {LENS_KINDS[part.code]}"
            one = Column(f"station.{part.code}", station.name, kind, facts=facts)
            yield changed.of_stations(one, own, part.columns)


LENS_KINDS = {
    "focal": "focal length",
    "aspect": "pixel aspect",
    "centre": "picture centre",
    "distortion": "distortion",
}
"""``kind`` in calibration.json of the violations that camera models declare."""


def _of_lens(facts: Mapping[str, Any], **where: str) -> Callable[[Array, Array], dict[str, Any]]:
    """Facts about a camera's file, from estimates of one number, or of one in x and one in y."""

    def described(value: Array, sigma: Array) -> dict[str, Any]:
        more = {"y": value[1], "sigma_y": sigma[1]} if len(value) > 1 else {}
        if "stated" in facts:
            more["fits"] = facts["stated"] + value[0]
        return {"value": value[0], "sigma": sigma[0], **more, **facts, **where}

    return described


@dataclass(frozen=True)
class CameraChange:
    """Derivative of measurements by a change of cameras' parameters.

    Edges (N, 2, n) and poses (M, 6, n), with the station of each, (N,) and (M,).
    """

    edges: Array
    poses: Array
    edge_station: Integers
    pose_station: Integers

    @classmethod
    def of(
        cls, session: Session, observation: Observation, measured: Measurements
    ) -> CameraChange | None:
        """Derivative for a session's measurements; None without a camera."""
        cameras = [station.camera for station in session.stations]
        if not cameras:
            return None
        edges = edges_by_camera(observation, cameras)
        poses = np.zeros((len(measured.poses), 6, edges.shape[-1]))
        own = measured.poses.by_intrinsics
        poses[..., : own.shape[-1]] = own
        return cls(edges, poses, measured.edges.station, measured.poses.station)

    def of_stations(self, column: Column, stations: Booleans, change: Array) -> Column:
        """Column with the derivatives by k numbers of the camera of some stations, (S,).

        change : (n, k) derivative of the camera's parameters.
        """
        n = len(change)
        edges = np.flatnonzero(stations[self.edge_station])
        also = np.append(stations, False)[np.minimum(self.pose_station, len(stations))]
        poses = np.flatnonzero(also)
        return replace(
            column,
            edges=self.edges[edges, :, :n] @ change,
            edge_rows=edges,
            poses=self.poses[poses, :, :n] @ change,
            pose_rows=poses,
        )


def _boards(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Sizes of the boards."""
    del observation, estimate
    for m, mount in enumerate(measured.mounts):
        if mount.name == BOARD_MOUNT_NAME:
            from pkmcal.boards.poses import board_size_column

            yield board_size_column(measured.poses, m, session.document["board"]["file"])


def _tripods(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Stations that moved during the session."""
    del observation, estimate
    for s, name in enumerate(session.station_names):
        in_view = [x.configuration[x.station == s] for x in (measured.edges, measured.poses)]
        what = "camera" if s < len(session.stations) else "tracker"
        used = np.unique(np.concatenate(in_view))
        yield from station_movement.movement_columns(s, name, used, session.configurations, what)


def _leaning_towers(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Directions of sliders that the mechanism file fixes, two angles each."""
    del session, observation
    machine, used = estimate.machine, estimate.configurations
    table, layout, document = machine.parameters, machine.layout, machine.document
    fixed = [axis for axis in table.axes if table.names[axis[0]] in table.fixed]
    sliders = [leg for leg, one in enumerate(document.legs) if one.base.joint == "slider"]
    if not fixed or not sliders:
        return
    # a lean x of a slider has the same effect on the closure as a change of its reading:
    # dc/dreading * dreading = dc/daxis * x
    opened = machine_from_document(document.model_copy(update={"fixed": ()})).parameters
    directions = opened.free_matrix()
    at = closure(
        layout, machine.values, measured.joints[used], estimate.state.T_base_platform[used]
    )
    slope = at.by_reading[..., None] * layout.of_motor
    by_theta = slope.mT @ dense(at, len(table)) / np.sum(slope**2, axis=1)[..., None]
    for leg, axis in product(sliders, fixed):
        if table.names[axis[0]] != f"legs[{leg + 1}].base.axis.x":
            continue
        own = np.any(directions[axis] != 0, axis=0)
        by = np.zeros((*measured.joints.shape, 2))
        by[used] = by_theta @ directions[:, own]
        yield Column(
            "machine.lean", f"leg {leg + 1}", "lean", readings=by, facts=_of_lean, remark=True
        )


def _screw_leads(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Leads and hands of screws that are turned by joints."""
    del session, observation
    machine, used = estimate.machine, estimate.configurations
    layout, screws = machine.layout, machine.layout.screws
    if not len(screws):
        return
    joints, poses = measured.joints[used], estimate.state.T_base_platform[used]
    ends = limb_ends(layout, machine.values, joints, poses)
    turn = screw_turns(screws, machine.values, poses[..., :3, :3], (ends.b - ends.a)[:, screws.leg])
    by = np.zeros((*measured.joints.shape, 1))
    scale = scales_of(layout, machine.values)[screws.leg]
    by[np.flatnonzero(used)[:, None], layout.actuated[screws.leg], 0] = -turn / (2 * np.pi * scale)

    def facts(value: Array, sigma: Array) -> dict[str, Any]:
        lead = float(screws.lead.mean())
        return {"value": value[0], "sigma": sigma[0], "stated": lead, "fits": lead + value[0]}

    yield Column("machine.screw_lead", "screws", "screw lead", readings=by, facts=facts)


def _sag(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Drives that yield under a load or measured forces, of a stiffness that the mechanism file
    does not state; one compliance for all of them.
    """
    del observation
    machine, used = estimate.machine, estimate.configurations
    load, forces = machine.document.load, session.forces
    if (load is None and forces is None) or is_compliant(machine):
        return
    if len(set(machine.joint_units)) > 1:
        return
    poses = estimate.state.T_base_platform[used]
    by = np.zeros((*measured.joints.shape, 1))
    by[used, :, 0] = weight_on_readings(machine, poses) if forces is None else forces[used]
    size = np.nan  # no tool follows from the readings of legs that do not hold the platform
    if not machine.layout.underdetermined:
        shift = tool_shift(machine, poses, by[used, :, 0])
        size = float(np.sqrt(np.nanmean(np.sum(shift**2, axis=-1))))

    def facts(value: Array, sigma: Array) -> dict[str, Any]:
        return {
            "value": value[0],
            "sigma": sigma[0],
            "by": "load" if forces is None else "forces",
            "mass": load.mass if load and forces is None else None,
            "unit": "m/N" if machine.joint_units[0] == "m" else "rad/(N m)",
            "sinks": size * value[0] if np.isfinite(size) else None,
            "stiffness": 1 / value[0] if value[0] > 0 else None,
        }

    yield Column(
        "machine.sag", "drives", "yielding drives", readings=by, facts=facts, positive=True
    )


def _joint_offsets(
    session: Session, observation: Observation, measured: Measurements, estimate: Estimate
) -> Iterator[Column]:
    """Universal joints whose two axes do not meet as stated, by the axes' distance e.

    The second axis then lies e towards the other end, square to the first axis v. With the angle
    beta of the leg out of the plane square to v, the leg's length is |B - A| - e cos(beta), to
    terms in (e sin(beta))^2 / 2 |B - A|.
    """
    del session, observation
    machine, used = estimate.machine, estimate.configurations
    layout, joints = machine.layout, measured.joints[estimate.configurations]
    poses = estimate.state.T_base_platform[used]
    ends = limb_ends(layout, machine.values, joints, poses)
    line = ends.b - ends.a
    u = line / np.linalg.norm(line, axis=-1, keepdims=True)
    scale = scales_of(layout, machine.values)
    for j, leg in enumerate(machine.document.legs):
        for node, side, to_base in (
            (leg.base, "base", np.eye(3)),
            (leg.platform, "platform", poses[:, :3, :3]),
        ):
            axis = getattr(node, "axis", None)
            if node.joint != "universal" or axis is None or not layout.rod_reads[j]:
                continue
            # cos(beta) is the sine of the angle between leg and first axis
            v = to_base @ (np.array(axis) / np.linalg.norm(axis))
            across = np.sqrt(1 - np.sum(u[:, j] * v, axis=-1) ** 2)
            by = np.zeros((*measured.joints.shape, 1))
            by[used, layout.actuated[j], 0] = across / scale[j]

            stated = getattr(node, "offset", None) or 0.0

            def facts(
                value: Array, sigma: Array, side: str = side, stated: float = stated
            ) -> dict[str, Any]:
                return {"value": stated + value[0], "sigma": sigma[0], "side": side}

            yield Column(
                "machine.joint_offset",
                f"leg {j + 1}",
                f"offset of {side} joint's axes",
                readings=by,
                facts=facts,
            )


def _of_lean(value: Array, sigma: Array) -> dict[str, Any]:
    """Facts about a lean by two angles (2,), rad."""
    size = float(np.linalg.norm(value))
    spread = float(np.linalg.norm(value * sigma)) / size if size else float(np.max(sigma))
    return {"value": size, "sigma": spread, "angles": value.tolist()}


TESTED: tuple[Family, ...] = (
    _reading_scales, partial(_motors, readings.play_columns),
    partial(_motors, readings.eccentricity_columns), _leaning_towers, _screw_leads,
    _joint_offsets, _sag, _lenses, _lenses_of_stations, _boards, _tripods,
)  # fmt: skip
"""Families of tested columns: assumptions of a session that may be wrong."""
