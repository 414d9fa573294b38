"""Predicted accuracy of a full capture from a station's first images, or of hand-held images.

The first images are measured as `calibrate` measures them. The information of their edges, in
pixels and with lost edges as zero, predicts that of others: every edge that is visible in
configurations drawn over the joints' ranges gets the information of a similar one, drawn at random.
With these edges the problem of the joint estimate is assembled as for a real session, and its
covariance is propagated to the platform. Hand-held images have no station for more of them: what is
predicted is the accuracy that the localized ones give by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers, numbered
from pkmcal.boards.board import Board, chessboard, load_board
from pkmcal.checks.inspection import Inspection, StationInspection
from pkmcal.geometry.rigid import inverse, pose, rotation
from pkmcal.identify.covariance import Information
from pkmcal.levels import NEARLY_ALL
from pkmcal.measurements import BOARD_MOUNT_NAME, Mount
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import tubes_of
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.stations import PANORAMIC_HALF_VIEW, view_angle
from pkmcal.planning.defaults import CONFIGURATIONS_A_CAPTURE
from pkmcal.planning.first import (
    EdgesOf,
    FirstEdges,
    Pools,
    first_edges,
    joined_pools,
    spread_over,
)
from pkmcal.planning.information import tool_by_free
from pkmcal.planning.rig import BoardFrom, LegsFrom, Rig, all_pairs
from pkmcal.planning.subject import PLAN_IMAGES_A_STATION

NEAR_END = 1 - NEARLY_ALL
"""Part of a joint's range, at either end, whose readings count as extreme: beyond nearly all of the
range."""
SECOND_STATION_TURN = np.pi / 2
"""Angle around the machine of a second station, rad: the direction that one camera determines
worst, along its line of sight, the other determines best.
"""
A4_BOARD = chessboard((8, 5), 0.03)
"""Board whose use is weighed where a session has none: 270 by 180 mm, as printed on a sheet."""
FORECAST_SEED = 7
HANDHELD_PASSES = 2
"""Measurement passes over hand-held images: the nominal model predicts each of them by a pose of
its own, so far off that one pass loses edges that `calibrate` finds, and measures others worse."""


@dataclass(frozen=True)
class LegForecast:
    """Forecast for one leg (from 1) at one station.

    seen : share of its edges' points that are not hidden, in all images.
    found : share of the expected edges that were measured and are inliers, in the first images; NaN
        without expected edges.
    sigma : median standard deviation of these edges, px across.
    tells : share of the information of all edges of the capture on the machine (in units of the
        prior sigmas) that is due to this leg.
    variance : share of the variance of the platform's position due to the errors of its edges: a
        better view of a leg with a large share improves the result most.
    """

    station: str
    leg: int
    seen: float
    found: float
    sigma: float
    tells: float
    variance: float


@dataclass(frozen=True)
class Forecast:
    """Predicted accuracy with ``photographs`` images at each station, or hand-held ones in all.

    position, orientation : standard deviations of the platform's pose at given readings, mean over
        poses, m and rad, as `calibrate` states them.
    readings, drawing : shares of the position's variance from readings and priors; the rest comes
        from edges.
    second : position, m, if half of the images are taken a quarter turn around the machine; NaN
        with several stations or a panoramic camera.
    edges : by station, for advice; empty for hand-held images.
    with_board : position, m, by hand-held images with a board on the base; NaN if there is one, or
        on tripods.
    """

    photographs: int
    position: float
    orientation: float
    readings: float
    drawing: float
    second: float
    legs: tuple[LegForecast, ...]
    edges: tuple[EdgesOf, ...] = ()
    with_board: float = np.nan

    @property
    def handheld(self) -> bool:
        """Whether the images are hand-held, each with a pose of its own."""
        return not self.edges


def forecast(inspection: Inspection, images: int = CONFIGURATIONS_A_CAPTURE) -> Forecast | None:
    """Forecast by the first images; None if the machine was not recognized at all stations, or in
    no hand-held image.

    Only legs are used, not boards and trackers, but for a board on the base in hand-held images.
    Raises a `PkmcalError` or a `LinAlgError` if these images do not allow a forecast.
    """
    machine, stations = inspection.session.machine, inspection.stations
    # the angles of hinges are not known without measurements
    if machine.layout.n_internal:
        return None
    by_hand = [inspection.session.stations[s.images.station].handheld for s in stations]
    if any(by_hand):
        return _by_hand(inspection) if all(by_hand) else None
    if not stations or not all(station.recognised for station in stations):
        return None
    first = first_edges(
        inspection.session,
        [station.images for station in stations],
        inspection.measured,
        np.stack([station.T_camera_base for station in stations]),
        inspection.poses,
    )
    capture = _planned_capture(inspection, first, images)
    information = _capture_information(capture)
    second = np.nan
    one = stations[0].images
    if len(stations) == 1 and view_angle(one.camera) < PANORAMIC_HALF_VIEW:
        second = _capture_information(_with_second_station(capture)).position
    return Forecast(
        photographs=images,
        position=information.position,
        orientation=information.orientation,
        readings=information.readings,
        drawing=information.drawing,
        second=second,
        legs=tuple(
            leg
            for s, station in enumerate(stations)
            for leg in _by_leg(station.name, [station], first, information, slice(s, s + 1))
        ),
        edges=first.edges,
    )


def _by_hand(inspection: Inspection) -> Forecast | None:
    """Forecast of what the localized hand-held images give, each with a pose of its own."""
    session = inspection.session
    localized = [station for station in inspection.stations if station.recognised]
    if not localized:
        return None
    # Information of the edges of some images, for all of them.
    chosen = [
        localized[k] for k in spread_over(np.arange(len(localized)), most=PLAN_IMAGES_A_STATION)
    ]
    first = first_edges(
        session,
        [station.images for station in chosen],
        [np.zeros(1, dtype=int)] * len(chosen),
        np.stack([station.T_camera_base for station in chosen]),
        inspection.poses,
        HANDHELD_PASSES,
    )
    T_camera_base = np.stack([station.T_camera_base for station in localized])
    all_pools = [joined_pools(first.pools)] * len(localized)
    rig = _rig(inspection, localized, session.machine, T_camera_base, all_pools, first)
    number = np.arange(len(localized))
    pairs = np.stack([number, [s.images.configuration[0] for s in localized]], axis=-1)
    capture = _Capture(rig, inspection.poses, session.joints, pairs)
    # With and without a board on the base.
    has_board = session.board is not None and session.board_body == "base"
    board = load_board(session.board) if session.board is not None else A4_BOARD
    with_board = _capture_information(capture._replace(rig=_with_base_board(rig, board)))
    information = with_board if has_board else _capture_information(capture)
    entry = session.stations[localized[0].images.station].entry
    return Forecast(
        photographs=len(localized),
        position=information.position,
        orientation=information.orientation,
        readings=information.readings,
        drawing=information.drawing,
        second=np.nan,
        legs=tuple(_by_leg(entry, localized, first, information, slice(None))),
        with_board=np.nan if has_board else with_board.position,
    )


class _Capture(NamedTuple):
    """Images by a rig: pairs (M, 2) of station and configuration."""

    rig: Rig
    T_base_platform: Array
    joints: Array
    pairs: Integers


class _CaptureInformation(NamedTuple):
    """Accuracy of the platform by a capture; share, variance : (S, L)."""

    position: float
    orientation: float
    share: Array
    variance: Array
    readings: float
    drawing: float


def _rig(
    inspection: Inspection,
    stations: Sequence[StationInspection],
    machine: Machine,
    T_camera_base: Array,
    pools: Sequence[Pools],
    first: FirstEdges,
) -> Rig:
    """Rig of cameras at T_camera_base (S, 4, 4) that observe legs; pools : by station."""
    session = inspection.session
    cameras = zip(stations, T_camera_base, pools, strict=True)
    return Rig(
        machine,
        tuple(station.name for station in stations),
        T_camera_base,
        numbered(session.camera_of_station[[s.images.station for s in stations]]),
        session.joint_noise,
        tuple(
            LegsFrom(k, s.images.camera, T, own, s.images.binning)
            for k, (s, T, own) in enumerate(cameras)
        ),
        shading=first.estimate.statistics.shading,
        temperatures=session.temperature,
        forces=session.forces,
    )


def _with_base_board(rig: Rig, board: Board) -> Rig:
    """Rig with a board on the base in view of all stations, flat in the middle of its joints."""
    middle = rig.machine.base_centers().mean(axis=0)
    towards = inverse(rig.T_station_base)[:, :3, 3].mean(axis=0) - middle
    normal = np.linalg.svd(rig.machine.base_centers() - middle)[2][-1]
    if normal @ towards > 0:  # a board's print is on the side of its -z axis
        normal = -normal
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    R_base_board = np.stack([across, np.cross(normal, across), normal], axis=-1)
    T_base_board = pose(R_base_board, middle - R_base_board @ board.points.mean(axis=0))
    cameras = [one for one in rig.instruments if isinstance(one, LegsFrom)]
    boards = (
        BoardFrom(one.station, one.camera, one.T_camera_base, board.points, T_base_board,
                  on_platform=False)
        for one in cameras
    )  # fmt: skip
    mounts = (Mount(BOARD_MOUNT_NAME, "base", board.tolerance),)
    return replace(rig, instruments=(*cameras, *boards), mounts=mounts, T_mount=T_base_board[None])


def _planned_capture(inspection: Inspection, first: FirstEdges, images: int) -> _Capture:
    """Capture with configurations over the joints' ranges, with the present share of extreme
    ones.
    """
    machine, stations = first.estimate.machine, inspection.stations
    # The present share of extreme configurations, and whether stations share configurations.
    low, high = machine.joint_ranges.T
    margin = NEAR_END * (high - low)
    joints = inspection.session.joints
    ends = np.all((joints < low + margin) | (joints > high - margin), axis=1)
    rows = [set(s.images.configuration.tolist()) for s in stations]
    shared = len(rows) > 1 and len(set.union(*rows)) < sum(map(len, rows)) / 2
    wanted = images * (1 if shared else len(stations))
    rng = np.random.default_rng(FORECAST_SEED)
    poses, readings = draw_configurations(machine, wanted, float(ends.mean()), rng)
    number = np.arange(images)
    pairs = [all_pairs([s], number + (0 if shared else images * s)) for s in range(len(rows))]
    T_camera_base = first.estimate.state.T_camera_base
    rig = _rig(inspection, stations, machine, T_camera_base, first.pools, first)
    return _Capture(rig, poses[:wanted], readings[:wanted], np.concatenate(pairs))


def _with_second_station(capture: _Capture) -> _Capture:
    """Capture of a single station, with every other image taken a quarter turn around the
    machine.
    """
    rig = capture.rig
    (one,) = (x for x in rig.instruments if isinstance(x, LegsFrom))
    middle = np.concatenate([rig.machine.base_centers(), capture.T_base_platform[:, :3, 3]])
    turn, centre = rotation(np.array([0.0, 0.0, SECOND_STATION_TURN])), middle.mean(axis=0)
    there = one.T_camera_base @ inverse(pose(turn, centre - turn @ centre))
    pairs = capture.pairs.copy()
    pairs[1::2, 0] = 1
    both = replace(
        rig,
        names=rig.names * 2,
        T_station_base=np.stack([one.T_camera_base, there]),
        camera_of_station=np.repeat(rig.camera_of_station, 2),
        instruments=(one, replace(one, station=1, T_camera_base=there)),
    )
    return capture._replace(rig=both, pairs=pairs)


def _capture_information(capture: _Capture) -> _CaptureInformation:
    """Accuracy of the platform by a capture.

    With N = sum of N_g the information of all groups of rows (legs at stations, readings, priors)
    and J the derivative of the platform's position, its covariance J N^-1 J^T is the sum over g of
    J N^-1 N_g N^-1 J^T, the contributions of each group's errors. The information of edges on the
    machine is the trace of their N_g, with parameters in units of their prior sigmas.
    """
    rig, machine = capture.rig, capture.rig.machine
    n_stations = len(rig.names)
    rng = np.random.default_rng(FORECAST_SEED)
    # The problem of the joint estimate at the true state.
    measurements = rig.measured(capture.joints, capture.T_base_platform, capture.pairs, rng)
    edges = measurements.edges
    assembled, at_truth = rig.assembled(measurements, capture.T_base_platform)
    problem = assembled.problem
    info = Information(problem, at_truth)
    observed = np.flatnonzero(assembled.observed)
    poses, joints = capture.T_base_platform[observed], capture.joints[observed]
    # J N^-1, and the variance of the platform's pose.
    by = tool_by_free(rig, problem, joints, poses)
    machine_part = problem.unknowns.machine
    spread = by @ info.covariance[0][machine_part]  # (K, 6, na)
    variance = np.sum(spread[..., machine_part] * by, axis=-1)
    # Contributions of the rows of readings and edges, and of priors, to the variance.
    place = spread[:, 3:].reshape(-1, spread.shape[-1])
    rows = info.reduced.rows[0][:, : info.linear.value.shape[-1]]
    part = np.sum((rows @ place.T) ** 2, axis=-1)  # (K, r)
    prior = float(np.sum((info.linear.shared_by @ place.T) ** 2))
    # Information of the rows on the machine in prior sigmas.
    tolerance = machine.parameters.tolerances_free()
    row_information = np.sum((rows[..., machine_part] * tolerance) ** 2, axis=-1)
    at = assembled.places.edges

    def by_leg(of_rows: Array) -> Array:
        own = of_rows[at.row[:, None], 2 * at.place[:, None] + np.arange(2)].sum(axis=1)
        out = np.zeros((n_stations, machine.n_legs))
        np.add.at(out, (edges.station, edges.leg), own)
        return out

    share, shares = by_leg(part), by_leg(row_information)
    readings = float(part[:, problem.closure_rows].sum())
    whole = float(share.sum()) + readings + prior
    return _CaptureInformation(
        position=float(np.sqrt(variance[:, 3:].sum(axis=1)).mean()),
        orientation=float(np.sqrt(variance[:, :3].sum(axis=1)).mean()),
        share=shares / shares.sum(),
        variance=share / whole,
        readings=readings / whole,
        drawing=prior / whole,
    )


def _by_leg(
    name: str,
    stations: Sequence[StationInspection],
    first: FirstEdges,
    information: _CaptureInformation,
    of: slice,
) -> list[LegForecast]:
    """Forecast for each leg under a name: of one station, or of hand-held images together.

    stations : those that the name stands for.
    of : their part of the first edges and of the information.
    """
    tubes = tubes_of(first.estimate.machine)
    hidden = np.mean([s.quality.hidden.mean(axis=0) for s in stations if s.quality], axis=0)
    expected = np.sum([edges.expected.sum(axis=0) for edges in first.edges[of]], axis=0)
    inliers = np.sum([edges.valid.sum(axis=0) for edges in first.edges[of]], axis=0)
    out: list[LegForecast] = []
    for j in np.unique(tubes.leg).tolist():
        mine = tubes.leg == j
        number = int(expected[mine].sum())
        sigma = first.sigma[of, j]
        sigma = sigma[np.isfinite(sigma)]
        out.append(
            LegForecast(
                station=name,
                leg=j + 1,
                seen=float(1 - hidden[j]),
                found=float(inliers[mine].sum() / number) if number else float("nan"),
                sigma=float(np.median(sigma)) if sigma.size else float("nan"),
                tells=float(information.share[of, j].sum()),
                variance=float(information.variance[of, j].sum()),
            )
        )
    return out
