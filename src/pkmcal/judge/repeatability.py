"""Measurement accuracy by experiment, [A] 4.2 and Table 1: scatter of repeated images.

The session is calibrated, so that every leg is measured at its predicted position; then each image
is measured by itself. Differences between images of one configuration from one station give the
noise of a measurement: of the direction and position of each leg's axis, and of its edges.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, rms
from pkmcal.calibration.calibrate import Calibration, calibrate_session
from pkmcal.calibration.localization import read_images
from pkmcal.errors import InputError
from pkmcal.files import json_value
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import cross, dot, skew
from pkmcal.identify.axis_measurements import AxisNoise
from pkmcal.levels import ALIGNED_ANGLE, CAUSE_SHARE, NEARLY_ALL, RELEVANT_SHARE
from pkmcal.measurements import EdgeSet
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.predict import legs_in_camera
from pkmcal.observe.repeats import (
    Groups,
    groups_of,
    outlying_repeats,
    pixel_units,
    same_edges,
    turns_from_first,
)
from pkmcal.outcome import Part, Row, Table
from pkmcal.outcome.finding import Finding, Level, doubtful, finding, note
from pkmcal.outcome.progress import Progress, no_progress
from pkmcal.session.load import Session, Station, load_session
from pkmcal.solver.ranks import nonzero

REPEAT_SHUFFLES = 16
"""Number of permutations of the repeats, from which the share explained by chance is estimated
to a few hundredths."""
PAPER_AXIS_NOISE = AxisNoise(images=1)
"""[A] Table 1, upper bounds, in degrees where the paper prints rad (errata)."""
REPEATS_TABLE_LEGEND = (
    "Standard deviations of one image, pooled over the configurations. ψ: of the leg's direction in"
    " the image. θ: towards the camera. x, z: of its point with y = 0, camera frame; – for a leg"
    " level in the image, without one. θ and z come from the leg's width in the image, so they"
    " scatter most. Shift, tilt: of its edges, as a whole and at their ends."
)


@dataclass(frozen=True)
class LegScatter:
    """Standard deviations of one image of a leg (from 1), pooled over configurations.

    psi, theta, x, z : of the axis, rad and m, [A] Table 1, camera frame; NaN where undefined.
    shift, tilt : of an edge, px, as a whole and at its ends.
    promised : ratio of the edges' scatter to the standard deviations estimated from each image
        alone.
    images, freedom : number of images in which the leg was measured, and how many of these are
        repeats.
    """

    station: str
    leg: int
    psi: float
    theta: float
    x: float
    z: float
    shift: float
    tilt: float
    promised: float
    photographs: int
    freedom: int


@dataclass(frozen=True)
class StationScatter:
    """Causes of the differences between repeats at a station.

    shift, promised : as for a leg (px, ratio), over all legs.
    camera, platform, legs : share of the squared scatter, above chance, that is explained by a
        motion of the camera, of the platform, or of each leg separately.
    images, configurations : numbers of images, and of configurations with repeats.
    dropped : number of rejected repeats of edges.
    """

    station: str
    photographs: int
    configurations: int
    shift: float
    promised: float
    camera: float
    platform: float
    legs: float
    dropped: int

    @property
    def cause(self) -> str:
        """Cause of the scatter: ``camera``, ``platform``, ``legs`` or, where no motion explains it,
        ``noise``.

        Separate motions of the legs can reproduce most of a common motion, and have more
        parameters; so they must explain clearly more.
        """
        best = "camera" if self.camera >= self.platform else "platform"
        whole = max(self.camera, self.platform)
        if self.legs > CAUSE_SHARE and whole < NEARLY_ALL * self.legs:
            return "legs"
        return best if whole > CAUSE_SHARE else "noise"


@dataclass(frozen=True)
class RepeatStudy:
    """Table 1 of a session.

    legs : by station and leg.
    middle, bound : median and largest value of each column (leg 0).
    """

    legs: tuple[LegScatter, ...]
    stations: tuple[StationScatter, ...]
    middle: LegScatter
    bound: LegScatter
    findings: tuple[Finding, ...]

    def as_dict(self) -> dict[str, Any]:
        """All results by name, for ``--json``."""
        causes = [{**asdict(s), "cause": s.cause} for s in self.stations]
        paper = {name: getattr(PAPER_AXIS_NOISE, name) for name in ("psi", "theta", "x", "z")}
        findings = [finding.document() for finding in self.findings]
        own = asdict(replace(self, findings=()))
        return json_value({**own, "findings": findings, "stations": causes, "paper": paper})


def study_repeats(
    session: Session | Path | str, *, seed: int = 0, progress: Progress = no_progress
) -> RepeatStudy:
    """Scatter of images of the same configurations, by station and leg.

    Raises InputError if the session has no repeats, and the errors of `calibrate_session`.
    """
    if not isinstance(session, Session):
        session = load_session(session)
    require_repeats(session)
    return scatter_of_repeats(calibrate_session(session, seed=seed, progress=progress))


def scatter_of_repeats(calibration: Calibration) -> RepeatStudy:
    """Scatter of images of the same configurations about a calibration of their session."""
    session = calibration.session  # without hand-held images that were not localized
    observed = [p for p in read_images(session) if _sees_legs(session.stations[p.station])]
    parts = [_StationEdges.of(calibration, images) for images in observed]
    parts = [station_edges for station_edges in parts if np.any(station_edges.same.count > 1)]
    names = [station.name for station in session.stations]
    legs = tuple(
        row
        for station_edges in parts
        for row in _leg_rows(station_edges, names[station_edges.station])
    )
    stations = tuple(
        _station_row(station_edges, names[station_edges.station]) for station_edges in parts
    )
    middle, bound = _over_legs(legs, 0.5), _over_legs(legs, 1.0)
    return RepeatStudy(legs, stations, middle, bound, repeat_findings(stations))


def require_repeats(session: Session) -> None:
    """Raise InputError, with the needed entry, if no station that observes legs has repeats."""
    for station in session.stations:
        rows = [photo.configuration for photo in station.images]
        if _sees_legs(station) and len(set(rows)) < len(rows):
            return
    name = next((s.name for s in session.stations if not s.handheld), None)
    if name is None:
        raise InputError(
            "the session has no repeated images",
            where="session.yaml, stations",
            found="no camera that stands in one place",
            expected="a station from which configurations were imaged several times",
            next_step="Put a camera on a tripod and image some configurations several times,"
            " moving nothing in between",
            code="session.no_repeats",
        )
    raise InputError(
        "the session has no repeated images",
        where=f"session.yaml, stations.{name}.images",
        found=f"{session.document['stations'][name]['images']}, one image a configuration",
        expected=f"a pattern such as images/{name}/{{configuration}}_{{repeat}}.png",
        next_step="Take several images of some configurations, moving nothing in between, and"
        f" name the images images/{name}/0001_1.png, images/{name}/0001_2.png and so on",
        code="session.no_repeats",
    )


def _sees_legs(station: Station) -> bool:
    """Whether a station observes legs."""
    return "legs" in station.observe


@dataclass(frozen=True)
class _StationEdges:
    """One station's edges, measured in each image separately, without outlying repeats.

    photo : (N,) number of the image.
    cylinders : of the legs, camera frame.
    same : groups of the repeats of each edge.
    turn : (N, 2) rotation of each edge from the mean of its repeats, rad, in the tangent bases
        ``basis`` (N, 3, 2).
    dropped : number of rejected repeats.
    """

    station: int
    edges: EdgeSet
    photo: Integers
    cylinders: Cylinders
    same: Groups
    turn: Array
    basis: Array
    dropped: int

    @classmethod
    def of(cls, calibration: Calibration, images: StationImages) -> _StationEdges:
        """Measure a station's images from the calibrated scene."""
        state, machine = calibration.estimate.state, calibration.machine
        s, rows = images.station, images.configuration
        camera = calibration.cameras.at_station(int(s))
        binning = int(calibration.observation.binning[s])
        # each image as a configuration by itself, so that repeats are not combined
        numbered = replace(
            images, camera=camera, configuration=np.arange(len(rows)), binning=binning
        )
        poses, T_camera_base = state.T_base_platform[rows], state.T_camera_base[s]
        edges = legs.measure(numbered, machine, T_camera_base, poses).edges
        photo = edges.configuration
        edges = replace(edges, configuration=rows[photo])
        # reject outlying repeats
        odd = outlying_repeats(edges, same_edges(edges))
        keep = ~odd.any
        edges, photo = edges.select(keep), photo[keep]
        same = same_edges(edges)
        # deviations from the means
        turn = turns_from_first(edges, same)
        ends = legs_in_camera(machine, T_camera_base, poses, images.joints)
        radius = machine.radii_of(edges.leg, edges.tube)
        return cls(
            station=s,
            edges=edges,
            photo=photo,
            cylinders=Cylinders(ends.a[photo, edges.leg], ends.b[photo, edges.leg], radius),
            same=same,
            turn=turn - same.mean(turn)[same.member],
            basis=edges.basis[same.first[same.member]],
            dropped=int(np.sum(~keep)),
        )


def _leg_rows(station_edges: _StationEdges, station: str) -> list[LegScatter]:
    """Table 1 of one station: a row for each leg that has repeats."""
    edges = station_edges.edges
    pixel = pixel_units(edges)[:, 0]
    tilt = station_edges.turn[:, 1] * half_angles(edges, station_edges.cylinders)
    pixels = _pooled(
        np.stack([station_edges.turn[:, 0], tilt], axis=1) / pixel[:, None], station_edges.same
    )
    promised = _pooled(station_edges.turn / _stated(station_edges), station_edges.same)
    rows, axes = _axis_scatter(station_edges)
    leg = edges.leg[station_edges.same.first]
    out: list[LegScatter] = []
    for j in np.unique(leg[station_edges.same.count > 1]):
        mine = leg == j
        psi, theta, x, z = (float(v) for v in _deviation(axes, rows == j))
        shift, tilts = (float(v) for v in _deviation(pixels, mine))
        ratio = rms(_deviation(promised, mine))
        count = len(np.unique(station_edges.photo[edges.leg == j]))
        freedom = count - len(np.unique(edges.configuration[edges.leg == j]))
        row = (station, int(j) + 1, psi, theta, x, z, shift, tilts, ratio, count, freedom)
        out.append(LegScatter(*row))
    return out


@dataclass(frozen=True)
class _Pooled:
    """Sums of squares (G, n) of the deviations from each group's mean, and their freedoms (G,)."""

    squares: Array
    freedom: Array


def _pooled(values: Array, groups: Groups) -> _Pooled:
    """Deviations of values (N, n) from their groups' means."""
    away = values - groups.mean(values)[groups.member]
    return _Pooled(groups.total(away**2), groups.count - 1.0)


def _deviation(pooled: _Pooled, mine: Booleans) -> Array:
    """Standard deviations (n,) pooled over some groups, ``mine`` (G,); NaN without repeats."""
    freedom = pooled.freedom[mine].sum()
    return np.sqrt(pooled.squares[mine].sum(axis=0) / (freedom if freedom else np.nan))


def _stated(station_edges: _StationEdges) -> Array:
    """Standard deviations (N, 2) estimated from each edge's own image, mean over repeats."""
    mean = station_edges.same.mean(station_edges.edges.covariance[:, [0, 1], [0, 1]])
    return np.sqrt(mean)[station_edges.same.member]


def _whiten(station_edges: _StationEdges) -> Array:
    """Inverse Cholesky factors (N, 2, 2) of the edges' stated covariances, equal for all repeats of
    one.
    """
    stated = station_edges.same.mean(station_edges.edges.covariance)[station_edges.same.member]
    return np.linalg.inv(np.linalg.cholesky(stated))


def _axis_scatter(station_edges: _StationEdges) -> tuple[Integers, _Pooled]:
    """Scatter of psi, theta, x and z of the axes: the leg of each group of repeats, and the sums.

    An axis is fitted to all edges of the leg, of all its tubes, with the weights of the
    calibration. Legs with one visible side have no axis.
    """
    edges, legs = station_edges.edges, station_edges.cylinders
    in_view = groups_of(station_edges.photo, edges.leg)
    fit = fit_motions(
        station_edges.turn,
        by_ends(edges, station_edges.basis, legs),
        _whiten(station_edges),
        in_view,
    )
    change = axis_coordinates(fit.motion, legs.a[in_view.first], legs.b[in_view.first])
    sides = in_view.total(edges.side[:, None] == np.array([0, 1]))
    whole = np.flatnonzero((sides > 0).all(axis=1))
    first = in_view.first[whole]
    repeats = groups_of(edges.configuration[first], edges.leg[first])
    return edges.leg[first][repeats.first], _pooled(change[whole], repeats)


def _station_row(station_edges: _StationEdges, station: str) -> StationScatter:
    """Scatter over all legs of a station, and the motions that explain it."""
    edges, same, legs = station_edges.edges, station_edges.same, station_edges.cylinders
    every = np.ones(len(same.first), dtype=bool)
    shift = _deviation(_pooled(station_edges.turn[:, :1] / pixel_units(edges)[:, :1], same), every)
    promised = _deviation(_pooled(station_edges.turn / _stated(station_edges), same), every)
    ends = by_ends(edges, station_edges.basis, legs)
    photo = groups_of(station_edges.photo)
    return StationScatter(
        station=station,
        photographs=len(photo.first),
        configurations=len(np.unique(edges.configuration[same.first[same.count > 1]])),
        shift=float(shift[0]),
        promised=rms(promised),
        camera=_explained(station_edges, by_camera(ends, legs), photo),
        platform=_explained(station_edges, by_platform(ends, legs), photo),
        legs=_explained(station_edges, ends, groups_of(station_edges.photo, edges.leg)),
        dropped=station_edges.dropped,
    )


def _explained(station_edges: _StationEdges, rows: Array, groups: Groups) -> float:
    """Share of the squared scatter that motions of groups explain: 0 as by chance, 1 all.

    The share explained by chance is estimated by permuting the repeats of each edge separately,
    which preserves the edge's scatter and removes its correlation with the other edges. It is never
    zero: any shifts of two edges of a leg are partly a motion of the leg.

    rows : (N, 2, p) derivative of the edges' rotation by a group's motion.
    """
    whiten, rng = _whiten(station_edges), np.random.default_rng(0)

    def share(turn: Array) -> float:
        fit = fit_motions(turn, rows, whiten, groups)
        return float(fit.explained.sum() / max(fit.total.sum(), 1e-300))

    shuffled = [
        share(station_edges.turn[station_edges.same.exchanged(rng)]) for _ in range(REPEAT_SHUFFLES)
    ]
    chance = float(np.mean(shuffled))
    # where chance explains nearly all, too few edges are affected by the motion
    return (share(station_edges.turn) - chance) / (1 - chance) if chance < NEARLY_ALL else 0.0


@dataclass(frozen=True)
class Cylinders:
    """Legs of N edges: ends a, b (N, 3) of the axes, camera frame, and radii (N,), m."""

    a: Array
    b: Array
    radius: Array


def half_angles(edges: EdgeSet, legs: Cylinders) -> Array:
    """Half the angle (N,), rad, subtended by an edge's length at the camera."""
    d = legs.b - legs.a
    u = d / np.sqrt(dot(d, d))[:, None]
    first, last = (legs.a + edges.span[:, k, None] * u for k in (0, 1))
    return np.arctan2(np.linalg.norm(cross(first, last), axis=-1), dot(first, last)) / 2


def by_ends(edges: EdgeSet, basis: Array, legs: Cylinders) -> Array:
    """Derivative (N, 2, 6), rad/m, of the edges' rotation by the ends a and b of the axes.

    basis : tangent bases (N, 3, 2) of the normals.
    """
    e = edge_normal_jacobians(legs.a, legs.b, legs.radius, edges.side)
    return basis.mT @ np.concatenate([e.dn_da, e.dn_db], axis=-1)


def by_camera(ends: Array, legs: Cylinders) -> Array:
    """Derivative (N, 2, 6) of the edges' rotation by six numbers (omega, tau) of the camera.

    ends : (N, 2, 6) derivative by the ends, see :func:`by_ends`.
    """
    return ends[..., :3] @ _rigid(legs.a) + ends[..., 3:] @ _rigid(legs.b)


def by_platform(ends: Array, legs: Cylinders) -> Array:
    """Derivative (N, 2, 6) of the edges' rotation by six numbers (omega, tau) of the platform.

    The rotation omega is about the mean of the ends b.

    ends : (N, 2, 6) derivative by the ends, see :func:`by_ends`.
    """
    return ends[..., 3:] @ _rigid(legs.b - legs.b.mean(axis=0))


def _rigid(points: Array) -> Array:
    """Derivative (N, 3, 6) of points (N, 3) by (omega, tau): omega x p + tau."""
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([-skew(points), eye], axis=-1)


@dataclass(frozen=True)
class MotionFit:
    """Least-squares motions of groups.

    motion : (G, p).
    explained, total : (G,) sums of squared whitened rotations.
    """

    motion: Array
    explained: Array
    total: Array


def fit_motions(turn: Array, rows: Array, whiten: Array, groups: Groups) -> MotionFit:
    """Least-squares motion of each group from rotations (N, 2) of its edges.

    Motions that affect no edge are zero.

    rows : (N, 2, p) derivatives.
    whiten : (N, 2, 2), applied to both.
    """
    white = (whiten @ turn[..., None])[..., 0]
    rows = whiten @ rows
    # normal equations by group, solved by pseudo-inverse
    normal = groups.total(rows.mT @ rows)
    right = groups.total((white[:, None, :] @ rows)[:, 0])
    values, axes = np.linalg.eigh(normal)
    visible = nonzero(values)  # the others are motions that no edge shows
    along = (axes.mT @ right[..., None])[..., 0]
    along = np.where(visible, along / np.where(visible, values, 1.0), 0.0)
    motion = (axes @ along[..., None])[..., 0]
    return MotionFit(motion, dot(motion, right), groups.total(dot(white, white)))


def axis_coordinates(motion: Array, a: Array, b: Array) -> Array:
    """Change (G, 4) of psi, theta (rad), x, z (m) by motions (G, 6) of an axis's ends a, b (G, 3).

    To first order; the coordinates of identify.axis_measurements.to_coordinates. x and z are NaN
    for a leg that is level in the image, which has no point with y = 0.
    """
    d = b - a
    length = np.sqrt(dot(d, d))[:, None]
    u = d / length
    # change of the direction u, and from it of both angles
    step = motion[:, 3:] - motion[:, :3]
    du = (step - dot(step, u)[:, None] * u) / length
    across = np.hypot(u[:, 0], u[:, 1])
    psi = (u[:, 0] * du[:, 1] - u[:, 1] * du[:, 0]) / across**2
    theta = du[:, 2] / across
    # change of the point with y = 0
    uy = np.where(np.abs(u[:, 1]) < np.sin(ALIGNED_ANGLE), np.nan, u[:, 1])[:, None]
    ay, day, duy = a[:, 1, None], motion[:, 1, None], du[:, 1, None]
    point = motion[:, :3] - day / uy * u + ay / uy**2 * duy * u - ay / uy * du
    return np.stack([psi, theta, point[:, 0], point[:, 2]], axis=-1)


def _over_legs(rows: tuple[LegScatter, ...], share: float) -> LegScatter:
    """Quantile of each column over all legs; share 1 is the largest value, as in [A] Table 1."""

    def quantile(name: str) -> float:
        column = np.array([getattr(row, name) for row in rows])
        finite = column[np.isfinite(column)]
        return float(np.quantile(finite, share)) if finite.size else float("nan")

    return LegScatter(
        station="",
        leg=0,
        psi=quantile("psi"),
        theta=quantile("theta"),
        x=quantile("x"),
        z=quantile("z"),
        shift=quantile("shift"),
        tilt=quantile("tilt"),
        promised=quantile("promised"),
        photographs=sum(row.photographs for row in rows),
        freedom=sum(row.freedom for row in rows),
    )


def part_of(study: RepeatStudy) -> Part:
    """Report part with the scatter as a table, beside the paper's."""
    rows = [Row(leg.station, (str(leg.leg), *_cells(leg))) for leg in study.legs]
    rows.append(Row("median", ("", *_cells(study.middle))))
    rows.append(Row("upper bound", ("", *_cells(study.bound))))
    noise = PAPER_AXIS_NOISE
    paper = (_degrees(noise.psi), _degrees(noise.theta), _mm(noise.x), _mm(noise.z))
    rows.append(Row("[A] Table 1", ("", "", *paper, "", "")))
    columns = ("Station", "Leg", "Images", "ψ", "θ", "x", "z", "Shift", "Tilt")
    table = Table("Scatter of repeated images", columns, tuple(rows), legend=REPEATS_TABLE_LEGEND)
    return Part("repeats", "Repeats", tables=(table,))


def _cells(row: LegScatter) -> tuple[str, ...]:
    """Cells of a row: number of images, axis and edges."""
    axis = (_degrees(row.psi), _degrees(row.theta), _mm(row.x), _mm(row.z))
    edges = (f"{v:.3f} px" if math.isfinite(v) else "–" for v in (row.shift, row.tilt))
    return str(row.photographs), *axis, *edges


def _degrees(value: float) -> str:
    return f"{math.degrees(value):.2g}°" if math.isfinite(value) else "–"


def _mm(value: float) -> str:
    return f"{value * 1e3:.2g} mm" if math.isfinite(value) else "–"


def repeat_findings(stations: tuple[StationScatter, ...]) -> tuple[Finding, ...]:
    """Findings about each station's repeats, and about the benefit of further ones."""
    results = [_finding(station) for station in stations] or [doubtful("repeats.none")]
    # averaging would reduce no standard deviation by a relevant factor
    if stations and all(station.promised < RELEVANT_SHARE for station in stations):
        results.append(note("repeats.mostly_common"))
    return tuple(results)


def _finding(station: StationScatter) -> Finding:
    """Finding about the size and the cause of a station's scatter."""
    share = {"camera": station.camera, "platform": station.platform, "legs": station.legs}
    return finding(
        f"repeats.by_{station.cause}",
        Level.DOUBTFUL if station.promised > 1 else Level.NOTE,
        station.station,
        station=station.station,
        scatter=station.shift,
        scale=station.promised,
        share=share.get(station.cause, 0.0),
        taken="yes" if station.promised > 1 else "no",
    )
