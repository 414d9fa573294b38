"""Plan of a session by the nominal model: stations, configurations, and the visible edges and
boards.

Axes: S stations, K configurations, N edges, V views of a board with n corners each. The plan is
made with the nominal model, as a user makes it; the true machines of a study, which differ by their
prior sigmas, then take the same readings. Visibility is that of the plan: the edge of a true
machine's shorter leg still has its planned length.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.board import Board
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, dot
from pkmcal.measurements import (
    BOARD_MOUNT_NAME,
    EdgeSet,
    Measurements,
    Mount,
    PoseSet,
    concatenate,
)
from pkmcal.measurements.readings import reading_sigma
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import tubes_of
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.edges import visible_edges
from pkmcal.placement.stations import default_stations, in_picture
from pkmcal.simulation.board import board_for, place_board
from pkmcal.simulation.cylinders import with_forearms
from pkmcal.simulation.truth import Settings

LEAST_BOARD_SHARE_IN_IMAGE = 0.5
"""Share of a board's corners that an image must show."""
LEAST_FACING = 0.2
"""Cosine of the angle between board normal and line of sight below which no corner is visible:
detectors fail at about 80 degrees.
"""
CORNER_BORDER_MARGIN = 10.0
"""Distance in px of a corner from the image border."""
SPARE_CONFIGURATIONS_DRAWN = 10
"""Number of configurations drawn beyond twice those wanted; stations select those in view."""


@dataclass(frozen=True)
class Design:
    """Design of a machine with its measuring set-up; lengths in m, angles in rad.

    machine : nominal model.
    cameras : one for all stations, or one for each.
    stations : number of stations.
    T_camera_base : (S, 4, 4) poses of the stations; None to choose them in every batch.
    observe : legs, board or both; the board is on the platform.
    board : None for one in proportion to the machine.
    configurations : number for each station.
    shared : whether all stations observe the same configurations.
    distance, elevation : of the cameras; None for the defaults.
    reading_noise : standard deviation of a drive's position at a reading, m or rad.
    reading_resolution : step of the readings, m or rad; 0 for none.
    play : of the drives, m or rad: the difference of a drive's positions at one reading, reached
        from a larger and from a smaller one.
    edge_noise : standard deviation of an edge's shift, and of its ends by tilt, px.
    corner_noise : standard deviation of a coordinate of a corner, px.
    shading : standard deviation of the common shift of all edges of a tube's side at a station, px.
    tolerance : standard deviation of true machines, in prior sigmas.
    extreme : share of configurations with legs near the ends of their ranges.
    """

    machine: Machine
    cameras: tuple[Camera, ...]
    stations: int = 3
    T_camera_base: Array | None = None
    observe: tuple[str, ...] = ("legs",)
    board: Board | None = None
    configurations: int = 15
    shared: bool = False
    distance: float | None = None
    elevation: float | None = None
    reading_noise: float = 3e-6
    reading_resolution: float = 0.0
    play: float = 0.0
    edge_noise: float = 0.1
    corner_noise: float = 0.05
    shading: float = 0.03
    tolerance: float = 1.0
    extreme: float = field(default=Settings.extreme)

    @property
    def machine_with_cylinders(self) -> Machine:
        """The nominal model, with a cylinder for each rod if legs are observed and the model has
        none.
        """
        return with_forearms(self.machine) if "legs" in self.observe else self.machine

    @property
    def reading_sigma(self) -> float:
        """Standard deviation of a reading that a session states, m or rad."""
        return reading_sigma(self.reading_noise, self.reading_resolution, self.play)

    def readings(self, joints: Array, rng: np.random.Generator) -> Array:
        """Readings of drives that are at ``joints`` (..., K, m), in their order.

        A drive that comes from a smaller value stops half of the play short of its reading; the
        first configuration follows the last.
        """
        came = np.sign(joints - np.roll(joints, 1, axis=-2))
        noise = self.reading_noise * rng.standard_normal(joints.shape)
        value = joints + noise + self.play / 2 * came
        if not self.reading_resolution:
            return value
        return self.reading_resolution * np.round(value / self.reading_resolution)

    @property
    def camera_of_station(self) -> tuple[Camera, ...]:
        """Camera of each station."""
        return self.cameras if len(self.cameras) > 1 else self.cameras * self.stations


@dataclass(frozen=True)
class Capture:
    """Plan of images by a design.

    machine : nominal model.
    cameras : one for each station.
    T_camera_base : (S, 4, 4).
    T_base_platform, joints : (K, 4, 4) and (K, m), nominal and exact.
    edges : nominal and exact; empty if legs are not observed.
    views : (V, 2) station and configuration of the images that contain the board.
    corners : (V, n) visibility of its corners.
    board, T_platform_board : None without a board.
    """

    machine: Machine
    cameras: tuple[Camera, ...]
    T_camera_base: Array
    T_base_platform: Array
    joints: Array
    edges: EdgeSet
    views: Integers
    corners: Booleans
    board: Board | None = None
    T_platform_board: Array | None = None

    def measurements(self, joint_noise: float) -> Measurements:
        """The plan as measurements, for their structure: edges are nominal, board poses are
        identity.
        """
        n = len(self.views)
        none = np.zeros(n, dtype=int)
        unit = np.broadcast_to(np.eye(4), (n, 4, 4))
        white = np.broadcast_to(np.eye(6), (n, 6, 6))
        kinds = {camera: k for k, camera in enumerate(dict.fromkeys(map(id, self.cameras)))}
        return Measurements(
            replace(self.edges, covariance=np.broadcast_to(np.eye(2), (len(self.edges), 2, 2))),
            self.joints,
            joint_noise,
            len(self.cameras),
            np.array([kinds[id(camera)] for camera in self.cameras]),
            poses=PoseSet(self.views[:, 0], self.views[:, 1], none, unit, white),
            mounts=(Mount(BOARD_MOUNT_NAME, "platform"),) if n else (),
            shaded=len(self.edges) > 0,
        )


def captured(design: Design, rng: np.random.Generator) -> Capture:
    """Choose stations, mount the board, and draw configurations until enough are in view.

    Raises InputError if a station does not see enough configurations.
    """
    machine, cameras = design.machine_with_cylinders, design.camera_of_station
    by_board = "board" in design.observe
    T_camera_base = design.T_camera_base
    if T_camera_base is None:
        places = default_stations(
            with_forearms(machine), cameras, rng, "platform" if by_board else None,
            distance=design.distance, elevation=design.elevation,
        )  # fmt: skip
        T_camera_base = np.stack([place.T_camera_base() for place in places])
    # Candidate configurations, more than needed.
    n = design.configurations
    wanted = n if design.shared else n * design.stations
    poses, joints = draw_configurations(
        machine, 2 * wanted + SPARE_CONFIGURATIONS_DRAWN, design.extreme, rng
    )
    # Visibility of board and legs at each station.
    board = T_platform_board = None
    visible = np.ones((design.stations, len(joints)), dtype=bool)
    corner_visible = np.zeros((*visible.shape, 0), dtype=bool)
    if by_board:
        whole = with_forearms(machine)
        board = design.board or board_for(whole, "platform")
        T_platform_board = place_board(
            whole, board, "platform", cameras, T_camera_base, poses, whole.inverse(poses), rng
        )
        corner_visible = _corners(board, T_platform_board, cameras, T_camera_base, poses)
        visible &= corner_visible.mean(axis=-1) >= LEAST_BOARD_SHARE_IN_IMAGE
    if "legs" in design.observe:
        visible &= np.stack(
            [
                in_picture(machine, camera, T, poses, joints)
                for camera, T in zip(cameras, T_camera_base, strict=True)
            ]
        )
    # The first configurations that are in view.
    rows, pairs = _chosen(visible, n, shared=design.shared)
    poses, joints = poses[rows], joints[rows]
    edges = EdgeSet.empty()
    if "legs" in design.observe:
        edges = _edges(machine, cameras, T_camera_base, poses, joints, pairs)
    views = pairs if by_board else np.zeros((0, 2), dtype=int)
    corners = corner_visible[views[:, 0], rows[views[:, 1]]]
    return Capture(
        machine, cameras, T_camera_base, poses, joints, edges, views, corners, board,
        T_platform_board,
    )  # fmt: skip


def _chosen(visible: Booleans, n: int, *, shared: bool) -> tuple[Integers, Integers]:
    """Selected candidates (K,), and the pairs (M, 2) of station and configuration.

    visible : (S, candidates).
    """
    taken, rows, pairs = np.zeros(visible.shape[1], dtype=bool), list[Integers](), list[Integers]()
    for number, good in enumerate([np.asarray(visible.all(axis=0))] if shared else list(visible)):
        own = np.flatnonzero(good & ~taken)[:n]
        if len(own) < n:
            raise InputError(
                "a camera does not see the machine, or its board, in enough configurations",
                found=f"{len(own)} at "
                + ("all stations at once" if shared else f"station {number + 1}"),
                expected=str(n),
                next_step="Move the camera back, use a wider lens, or fewer configurations",
                code="station.sees_too_little",
            )
        first = sum(map(len, rows))
        taken[own] = True
        rows.append(own)
        for station in range(len(visible)) if shared else (number,):
            pairs.append(np.stack([np.full(n, station), first + np.arange(n)], axis=1))
    return np.concatenate(rows), np.concatenate(pairs)


def _edges(
    machine: Machine,
    cameras: tuple[Camera, ...],
    T_camera_base: Array,
    poses: Array,
    joints: Array,
    pairs: Integers,
) -> EdgeSet:
    """Exact edges that are visible in the images (M, 2) of station and configuration."""
    tubes, sets = tubes_of(machine), list[EdgeSet]()
    for station, (camera, T) in enumerate(zip(cameras, T_camera_base, strict=True)):
        rows = pairs[pairs[:, 0] == station, 1]
        ends = machine.ends_at(joints[rows], poses[rows])
        radius = machine.values[tubes.radius]
        a, b = (apply(T, end) for end in ends.rods)
        exact, _ = visible_edges(camera, tubes, radius, a, b)
        place = np.full(len(exact), station)
        # the problem gets a column for each shift that is not zero; each run has its own
        shift = np.broadcast_to([1.0, 0.0], exact.shift.shape)
        sets.append(
            replace(exact, station=place, configuration=rows[exact.configuration], shift=shift)
        )
    return concatenate(sets)


def _corners(
    board: Board,
    T_platform_board: Array,
    cameras: tuple[Camera, ...],
    T_camera_base: Array,
    poses: Array,
) -> Booleans:
    """Visibility (S, K, n) of the corners at each station; occlusion by the machine is
    neglected.
    """
    out: list[Booleans] = []
    for camera, T in zip(cameras, T_camera_base, strict=True):
        there = T @ poses @ T_platform_board
        points = apply(there[:, None], board.points)
        facing = dot(there[:, None, :3, 2], points) / np.sqrt(dot(points, points))
        with np.errstate(invalid="ignore"):
            pixels = camera.project(points)
        out.append(camera.in_image(pixels, margin=CORNER_BORDER_MARGIN) & (facing > LEAST_FACING))
    return np.stack(out)
