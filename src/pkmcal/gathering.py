"""What a session's photographs and tables measured, put together for the identification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards import Boards
from pkmcal.errors import GeometryError, InputError, ResultError
from pkmcal.identify.problem import Measurements, Mount
from pkmcal.observe.edges import EdgeSet
from pkmcal.observe.poses import PoseSet, concatenate_poses
from pkmcal.papers.hand_eye import start_from_poses
from pkmcal.pose_tables import check_lengths
from pkmcal.refinement import CameraRefinement
from pkmcal.session import Session


def measurements_of(
    session: Session,
    boards: Boards,
    edges: EdgeSet | None = None,
    cameras: CameraRefinement | None = None,
) -> Measurements:
    """What is measured; no cameras at a first look, which is too coarse to refine any."""
    files = [station.camera_file for station in session.stations]
    numbers = {name: k for k, name in enumerate(dict.fromkeys(files))}
    # A tracker has no camera; the first one's number moves nothing of what it measured.
    number = [numbers[name] for name in files] + [0] * len(session.trackers)
    mounts, poses = _poses(session, boards, cameras)
    measurements = Measurements(
        edges=EdgeSet.empty() if edges is None else edges,
        joints=session.joints,
        joint_noise=session.joint_noise,
        n_stations=len(number),
        camera_of_station=np.array(number, dtype=int),
        poses=poses,
        mounts=mounts,
    )
    if cameras is None or not cameras.files:
        return measurements
    return replace(
        measurements,
        intrinsics_factor=cameras.factor,
        intrinsics_at=cameras.at,
        shaded=len(measurements.edges) > 0,
    )


def _poses(
    session: Session, boards: Boards, cameras: CameraRefinement | None
) -> tuple[tuple[Mount, ...], PoseSet]:
    """All measured poses, and what their targets are fixed to: the board, each tracker's own."""
    mounts = [Mount("board", boards.body)] if boards.stations else []
    poses = boards.poses
    if cameras is not None and cameras.active:
        poses = poses.moved(np.stack([cameras.change(s.camera_file) for s in session.stations]))
    sets = [poses]
    for number, table in enumerate(session.trackers, start=len(session.stations)):
        sets.append(table.poses(number, len(mounts)))
        mounts.append(Mount(table.name, "platform"))
    return tuple(mounts), concatenate_poses(sets)


def known_stations(session: Session, boards: Boards) -> Array:
    """T_camera_base (S, 4, 4) of all stations before any leg is looked for: as the session says, or
    by what a board on the platform tells; NaN where neither does.
    """
    given = [station.T_camera_base for station in session.stations]
    given = boards.joined(given) + _tracker_starts(session)
    known = np.stack([np.full((4, 4), np.nan) if T is None else T for T in given])
    first = known[: len(session.stations)]
    if boards.body == "base" or not boards.stations or np.isfinite(first).all():
        return known
    return with_poses(session, boards, known)


def with_poses(session: Session, boards: Boards, known: Array) -> Array:
    """Stations (S, 4, 4) with those that are not known (NaN) by what measured poses tell.

    Raises `InputError`, or `ResultError`, where they tell too little.
    """
    if np.isfinite(known).all():
        return known
    measurements = measurements_of(session, boards)
    try:
        return start_from_poses(session.machine, measurements, known).T_camera_base
    except (InputError, ResultError) as error:
        lost = session.station_names[int(np.flatnonzero(np.isnan(known[:, 0, 0]))[0])]
        raise error.located(f"session.yaml, stations.{lost}") from None


def _tracker_starts(session: Session) -> list[Array | None]:
    """First poses of trackers whose points or heights do not tell their turn."""
    if not session.trackers:
        return []
    try:
        found = session.machine.forward_result(session.joints)
    except GeometryError:
        return [None] * len(session.trackers)
    poses = np.where(found.converged[:, None, None], found.T_base_platform, np.nan)
    for table in session.trackers:
        check_lengths(table, poses)
    return [table.start(poses) for table in session.trackers]
