"""Components of the model discrepancy of a session, and their findings.

Errors of the readings over the workspace (legs that yield under load, commanded axes that droop),
with the motors' last steps (backlash, lag), and with time (warming); motions of the base with the
platform; creep of stations; legs that are no straight cylinders; an uneven bed. From heights only
the last can be determined, because other errors over the workspace have the same effect. Each is
one entry of :func:`discrepancy_components`; their scales are estimated in
:mod:`pkmcal.identify.discrepancy`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers, evenly, rms
from pkmcal.calibration.holdout import points_of_poses
from pkmcal.geometry.cylinders import contour_point, line_through
from pkmcal.geometry.rigid import apply, dot, skew
from pkmcal.identify.covariance import data_share, machine_covariance
from pkmcal.identify.discrepancy import Component, Discrepancy
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.row_sums import POSE_ROWS, READING_ROWS
from pkmcal.identify.score import prior_root
from pkmcal.identify.tool import ToolAccuracy
from pkmcal.measurements import Column, Measurements
from pkmcal.outcome.finding import Finding, doubtful


@dataclass(frozen=True)
class DiscrepancyBasisOptions:
    """Constants of the smooth functions that may be added to the model."""

    # correlation lengths of errors over the workspace, relative to the root mean square distance of
    # the session's poses from their mean; functions with the last one are nearly linear
    lengths: tuple[float, ...] = (1.0, 1.5, 2.5, 4.0, 7.0)
    # largest number of functions of the pose: in six dimensions there are 27 linear and quadratic
    # ones
    most_functions: int = 40
    # ratio of successive correlation lengths of a bed, from the points' mean distance, below which
    # unevenness is noise, to the longest one
    length_step: float = 1.5
    # longest correlation length of a bed, relative to the root mean square distance of the points
    # from their mean. Parameters of the machine can reproduce surfaces with longer lengths, so that
    # the data do not determine their scale: a kit with leaning towers was refused for it
    longest_bed_length: float = 1.0
    # largest number of poses (Nyström landmarks) from which the functions are computed
    landmarks: int = 200
    # points along the visible part of an edge at which a change of the pose is evaluated
    points_along_edge: int = 9


DISCREPANCY_BASIS = DiscrepancyBasisOptions()


@dataclass(frozen=True)
class BedSurface:
    """Unevenness of a bed at the n probed points.

    configuration : (n,).
    x, y : (n,) of the tool, m, base frame.
    height, sigma : (n,) m, upwards, with the mean subtracted, and its standard deviation.

    Parts of the surface that the machine's parameters can reproduce as well are determined by the
    prior of the surface only; the standard deviation contains their uncertainty.
    """

    configuration: Integers
    x: Array
    y: Array
    height: Array
    sigma: Array


@dataclass(frozen=True)
class ModelError:
    """A detected component of the discrepancy.

    code : such as readings.workspace.
    scale : its standard deviation, m or rad of the affected quantity.
    unit : m or rad.
    ratio : twice the log likelihood ratio.
    tool, tool_before : m, standard deviation of the platform's position, root mean square over the
        session's poses, with all components and without any.
    sure : whether it is reported; otherwise the covariance contains it, but larger noise of
        readings or poses explains the data as well.
    length, surface : correlation length, m, and map, of an uneven bed; None otherwise.
    """

    code: str
    scale: float
    ratio: float
    tool: float
    tool_before: float
    unit: str
    sure: bool
    length: float | None = None
    surface: BedSurface | None = None

    def document(self) -> dict[str, Any]:
        """Entry of calibration.json."""
        return {
            "code": self.code,
            "scale": self.scale,
            "likelihood_ratio": self.ratio,
            "sure": self.sure,
            "sigma_tool": self.tool,
            "sigma_tool_before": self.tool_before,
            "length": self.length,
            "surface": self.surface and asdict(self.surface),
        }


UNEVEN_BED = "bed.surface"
"""Code of the component that heights have."""


def discrepancy_findings(errors: tuple[ModelError, ...]) -> Iterator[Finding]:
    """Warnings about the components, the bed first, then by evidence; none unless they are
    ``sure``.
    """
    if not any(one.sure for one in errors):
        return
    for one in errors:
        if one.code == UNEVEN_BED:
            yield uneven_bed(one)
    for k, one in enumerate(one for one in errors if one.code != UNEVEN_BED):
        tool: dict[str, Any] = {}
        if not k:
            tool = {"tool_sigma": one.tool, "tool_sigma_before": one.tool_before}
        yield doubtful(f"discrepancy.{one.code}", sigma=one.scale, unit=one.unit,
                       log_odds=one.ratio / 2, **tool)  # fmt: skip


def explains_heights(errors: tuple[ModelError, ...]) -> bool:
    """Whether a significantly uneven bed explains the scatter of heights."""
    return any(one.code == UNEVEN_BED and one.sure for one in errors)


def uneven_bed(error: ModelError) -> Finding:
    """The warning about an uneven bed."""
    return doubtful(
        f"discrepancy.{error.code}",
        sigma=error.scale,
        unit=error.unit,
        log_odds=error.ratio / 2,
        length=error.length,
    )


def discrepancy_components(measurements: Measurements, estimate: Estimate) -> list[Component]:
    """All components that a session can have."""
    bed = _of_bed(measurements, estimate)
    if estimate.purpose is Purpose.HEIGHT:
        return bed
    return [*_of_readings(measurements, estimate), *_of_stations(measurements, estimate),
            *_of_legs(measurements, estimate), *bed]  # fmt: skip


def _of_bed(measurements: Measurements, estimate: Estimate) -> list[Component]:
    """Uneven bed, where heights were measured: a Gaussian process over x and y."""
    poses = measurements.poses
    felt = height_rows(measurements)
    if not felt.size:
        return []
    xy = estimate.state.T_base_platform[poses.configuration[felt], :2, 3]
    xy = xy - xy.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum(xy**2, axis=1))))
    # mean distance of neighbours among n points spread over a disc of that size
    places = len(np.unique(xy.round(6), axis=0))
    apart = np.sqrt(2 * np.pi / places)
    count = int(
        np.ceil(
            np.log(DISCREPANCY_BASIS.longest_bed_length / apart)
            / np.log(DISCREPANCY_BASIS.length_step)
        )
    )
    lengths = apart * DISCREPANCY_BASIS.length_step ** np.arange(max(count, 1))
    basis, roots = smooth_functions(xy, lengths.tolist(), DISCREPANCY_BASIS.landmarks)
    if not roots:
        return []
    effect = np.zeros((len(poses), 6, basis.shape[1]))
    effect[felt, 5] = basis
    either = READING_ROWS, POSE_ROWS  # enlarged noise of readings or probe may be unevenness
    in_metres = tuple((size * lengths).tolist())
    return [Component(Column(UNEVEN_BED, poses=effect), roots, either, in_metres)]


def height_rows(measurements: Measurements) -> Integers:
    """Rows (n,) of the measured poses that are heights: only z of their six numbers was
    measured.
    """
    valid = np.any(measurements.poses.whiten != 0, axis=-2)
    return np.flatnonzero(valid[:, 5] & ~valid[:, :5].any(axis=1))


def _of_readings(measurements: Measurements, estimate: Estimate) -> Iterator[Component]:
    """Errors of the readings: over the workspace, with the last step, with time."""
    used, joints = estimate.configurations, measurements.joints
    n, m = joints.shape
    poses = estimate.state.T_base_platform[used]
    basis, roots = smooth_functions(points_of_poses(estimate.machine, poses))
    each = np.eye(m)

    def by_motor(functions: Array) -> Array:
        """Functions (K', p) of each motor by itself, (K, m, p m)."""
        out = np.zeros((n, m, functions.shape[1] * m))
        out[used] = np.einsum("kp,mn->kmpn", functions, each).reshape(len(functions), m, -1)
        return out

    if not basis.shape[1]:  # all of one pose
        return
    yield Component(
        Column("readings.workspace", readings=by_motor(basis)),
        tuple(np.kron(root, each) for root in roots),
        (READING_ROWS,),
    )
    step = np.diff(joints, axis=0, prepend=joints[:1])
    size = rms(step[used])
    if size > 0:
        sign, step = np.sign(step), step / size
        alone = np.concatenate([x[:, :, None] * each for x in (sign, step)], axis=2)
        together = np.stack([sign, step], axis=2)
        yield Component(
            Column("readings.step", readings=np.concatenate([alone, together], axis=2)),
            (np.eye(2 * m + 2) / 2,),
            (READING_ROWS,),
        )
    time = functions_of_time(n)[used]
    yield Component(
        Column("readings.time", readings=by_motor(time)), (np.eye(2 * m),), (READING_ROWS,)
    )


def smooth_functions(
    points: Array,
    lengths: Sequence[float] = DISCREPANCY_BASIS.lengths,
    most: int = DISCREPANCY_BASIS.most_functions,
) -> tuple[Array, tuple[Array, ...]]:
    """Principal functions of a Gaussian process at K points, by Nyström's method.

    points : (K, d).
    lengths : correlation lengths of the squared exponential kernel, the shortest first, relative to
        the root mean square distance of the points from their mean.
    most : largest number of functions.

    Returns the functions (K, p), of the shortest length, with mean zero and orthogonal over the
    points with a mean square of one; and for each correlation length the root (p, p) of the
    covariance of their coefficients, normalized to a mean square of one.
    """
    size = float(np.sqrt(np.mean(np.sum(points**2, axis=1))))
    points = points / (size or 1.0)
    marks = points[evenly(len(points), DISCREPANCY_BASIS.landmarks)]

    def kernel(one: Array, length: float) -> Array:
        squares = np.sum((one[:, None] - marks) ** 2, axis=-1)
        return np.exp(-squares / (2 * length**2))

    middle = np.eye(len(marks)) - 1 / len(marks)
    values, vectors = np.linalg.eigh(middle @ kernel(marks, lengths[0]) @ middle)
    order = np.argsort(-values)[:most]
    order = order[values[order] > 1e-6 * max(float(values.max()), 1e-6)]
    turn = middle @ vectors[:, order] / np.sqrt(values[order])
    if not order.size:
        return np.zeros((len(points), 0)), ()
    functions = kernel(points, lengths[0]) @ turn
    functions = functions - functions.mean(axis=0)
    q, r = np.linalg.qr(functions)
    scale = np.sqrt(len(points))
    at_marks = (kernel(marks, lengths[0]) @ turn) @ np.linalg.inv(r) * scale
    at_marks = at_marks - at_marks.mean(axis=0)
    back = np.linalg.pinv(at_marks)
    roots: list[Array] = []
    for length in lengths:
        spread = back @ (middle @ kernel(marks, length) @ middle) @ back.T
        value, direction = np.linalg.eigh(spread)
        value = np.maximum(value, 0.0)
        roots.append(direction * np.sqrt(value / max(float(value.sum()), 1e-300)))
    return q * scale, tuple(roots)


def functions_of_time(n: int) -> Array:
    """Linear and quadratic function (n, 2) of the number of a configuration.

    Their means are zero, and their mean square is, together, one.
    """
    time = np.linspace(-1, 1, n)
    both = np.stack([time, time**2 - np.mean(time**2)], axis=1)
    size = np.sqrt(np.mean(both**2, axis=0))
    return both / np.where(size > 0, size, 1.0) / np.sqrt(2)


def _of_stations(measurements: Measurements, estimate: Estimate) -> Iterator[Component]:
    """Motions of the stations relative to the base; rotations in units of the machine's size."""
    used, state, n = estimate.configurations, estimate.state, len(measurements.joints)
    stations = range(measurements.n_stations)
    points = points_of_poses(estimate.machine, state.T_base_platform[used])
    size = float(np.sqrt(np.mean(np.sum(points**2, axis=1))))
    if not stations or size == 0:
        return
    unit = np.diag(np.repeat([1 / size, 1.0], 3))
    straight = np.zeros((n, points.shape[1]))
    straight[used] = points / size
    by_base = [_motion_in_station(T) @ unit for T in state.T_camera_base]
    motion = np.stack([np.einsum("ij,kp->kipj", by, straight) for by in by_base])
    motion = motion.reshape(len(by_base), n, 6, -1)
    yield Component(Column("base.workspace", motion=motion), (np.eye(motion.shape[-1]),))
    parts: list[Array] = []
    for s in stations:
        taken = [x.configuration[x.station == s] for x in (measurements.edges, measurements.poses)]
        if len(np.unique(np.concatenate(taken))) > 1:
            part = np.zeros((len(stations), n, 6, 6))
            part[s] = np.sqrt(2) * functions_of_time(n)[:, :1, None] * unit
            parts.append(part)
    if parts:
        motion = np.concatenate(parts, axis=-1)
        yield Component(Column("station.time", motion=motion), (np.eye(motion.shape[-1]),))


def _motion_in_station(T: Array) -> Array:
    """(6, 6) left perturbation of T_camera_base by (omega, tau) of the base in its own frame."""
    turn, place = T[:3, :3], T[:3, 3]
    return np.block([[turn, np.zeros((3, 3))], [skew(place) @ turn, turn]])


def _of_legs(measurements: Measurements, estimate: Estimate) -> Iterator[Component]:
    """Tapered or bent legs: three numbers for each leg that change radius and axis, m."""
    if not len(measurements.edges):
        return
    edges, machine, state = measurements.edges, estimate.machine, estimate.state
    ends = machine.ends_at(measurements.joints, state.T_base_platform)
    T = state.T_camera_base[edges.station]
    a, b = (apply(T, x[edges.configuration, edges.leg]) for x in ends.rods)
    u = line_through(a, b)[0]
    part = np.linspace(0, 1, DISCREPANCY_BASIS.points_along_edge)
    along = edges.span[:, :1] + (edges.span[:, 1:] - edges.span[:, :1]) * part
    radius = machine.values[machine.layout.radius_of(edges.leg, edges.tube)]
    points = contour_point(
        a[:, None], u[:, None], edges.normal[:, None], radius[:, None], along
    )  # (N, n, 3)
    distance = np.sqrt(dot(points, points))
    place = np.clip(along / np.sqrt(dot(b - a, b - a))[:, None], 0, 1)
    # the leg's own directions: across, level and upright, as the base has them
    level = np.cross(u, T[:, :3, 2])
    level = level / np.maximum(np.sqrt(dot(level, level)), 1e-9)[:, None]
    bow = 4 * place * (1 - place)
    upright = np.cross(u, level)
    bends = [bow * dot(direction, edges.normal)[:, None] for direction in (level, upright)]
    outward = np.stack([2 * place - 1, *bends], axis=-1)
    # a plane that holds the displaced points: rays . dn = -outward / distance
    by_turn = (points / distance[..., None]) @ edges.basis
    turn = np.linalg.pinv(by_turn) @ (-outward / distance[..., None])
    own = np.eye(machine.n_legs)[edges.leg]
    effect = np.einsum("nij,nl->nijl", turn, own).reshape(len(edges), 2, -1)
    yield Component(Column("legs.shape", edges=effect), (np.eye(effect.shape[-1]),))


def with_discrepancy(estimate: Estimate, discrepancy: Discrepancy) -> Estimate:
    """Estimate whose covariances contain the discrepancy.

    From heights alone, the standard deviation of the result is not by these covariances:
    :func:`pkmcal.identify.bed.bed_of` takes the discrepancy's columns instead, in a wider model.
    """
    if not discrepancy.scales:
        return estimate
    problem = estimate.problem.problem
    machine, shared, u = estimate.machine, discrepancy.shared, problem.unknowns
    gauge = default_gauge(machine)
    more = machine_covariance(problem, machine, estimate.state, shared, gauge)
    joint = estimate.joint_covariance + more
    n, covariance = len(machine.values), dict(estimate.column_covariance)
    for code in covariance:
        covariance[code] = covariance[code] + shared[u.of_code(code), u.of_code(code)]
    return replace(
        estimate,
        joint_covariance=joint,
        # with the discrepancy a variance may exceed the prior variance
        data_share=np.maximum(data_share(machine, estimate.state.theta, joint[:n, :n], gauge), 0.0),
        column_covariance=covariance,
    )


def bed_surface(
    measurements: Measurements, estimate: Estimate, discrepancy: Discrepancy
) -> BedSurface:
    """Map of the bed, from the posterior of the discrepancy's coefficients."""
    felt, poses = height_rows(measurements), measurements.poses
    heights = [
        np.zeros((len(felt), column.count)) if column.poses is None else column.poses[felt, 5]
        for column in discrepancy.columns
    ]
    by = np.concatenate(heights, axis=1) @ prior_root(discrepancy.columns)
    place = estimate.state.T_base_platform[poses.configuration[felt], :2, 3]
    variance = np.einsum("ni,ij,nj->n", by, discrepancy.covariance, by)
    return BedSurface(
        poses.configuration[felt],
        place[:, 0],
        place[:, 1],
        by @ discrepancy.mean,
        np.sqrt(np.maximum(variance, 0.0)),
    )


def model_errors(
    discrepancy: Discrepancy,
    tool: ToolAccuracy,
    before: ToolAccuracy,
    unit: str,
    surface: BedSurface | None,
) -> tuple[ModelError, ...]:
    """Detected components, with their effect on the tool's standard deviation.

    tool, before : with the discrepancy and without.
    unit : of the readings.
    surface : map of the bed, if it is one of the components.
    """
    with_, without = tool.sigma, before.sigma
    return tuple(
        ModelError(
            one.code,
            one.scale,
            one.ratio,
            with_,
            without,
            unit if one.code.startswith("readings") else "m",
            discrepancy.sure,
            one.length,
            surface if one.code == UNEVEN_BED else None,
        )
        for one in discrepancy.scales
    )
