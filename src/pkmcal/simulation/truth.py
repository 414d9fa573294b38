"""What is true in a simulated session, and how it is drawn.

The same seed and settings give the same truth. Streams of random numbers are separate for the
machine, the stations, the configurations, the readings, the room and each photograph, so that
changing one setting does not reshuffle the rest.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.boards.board import Board
from pkmcal.cameras import Camera
from pkmcal.errors import GeometryError, InputError
from pkmcal.files import read_text
from pkmcal.measurements.effects import FOCAL_SIGMA
from pkmcal.mechanisms import Machine
from pkmcal.session.load import load_session
from pkmcal.session.readings import same_pose
from pkmcal.session.schema import BoardBody
from pkmcal.simulation.board import place_board
from pkmcal.simulation.placement import (
    StationPlace,
    default_stations,
    draw_configurations,
    in_picture,
    places_by_hand,
    platform_unfolded,
    rough_pose,
)
from pkmcal.simulation.render import Sensor
from pkmcal.simulation.surfaces import Light, Style

TRUTH_FILE = "truth.json"
RANDOM_STREAMS = (
    "machine", "stations", "configurations", "readings", "room", "photographs", "board", "focal",
)  # fmt: skip
READING_ROUNDING = 1e-9
"""By which readings that were drawn at one end differ from each other, m or rad: rounding."""
HANDHELD_STATION_NAME = "phone"
"""The name in session.yaml of a station whose camera is held by hand."""


@dataclass(frozen=True)
class RequestedConfigurations:
    """Configurations that somebody asks for, as a plan does.

    joints : (n, m) readings. pairs : (M, 2) stations and the configurations that they photograph.
    """

    joints: Array
    pairs: Integers


@dataclass(frozen=True)
class Settings:
    """What a simulated session is like.

    stations : how many, or where they stand. configurations : photographed by each station.
    shared : every station photographs the same configurations; otherwise each its own.
    tolerance : true values differ from the drawing by this many times its tolerances.
    joint_noise : standard deviation of a reading, m. rough_position, rough_angle : by how much
    the session's station poses are off, m and rad. extreme : share of configurations with legs
    near the ends of their ranges, as far as there are that many: no two are of one pose. board :
    seen by every station, fixed to ``board_on``. observe : what the session says of the stations
    that see one. repeats : photographs of each configuration from each station, with sensor noise
    of their own. shake : standard deviations (m, rad) by which the camera moves between them.
    finish, light : of the legs and of the room. as_built : motors, rings and cables, which no
    drawing shows, on the legs. asked : these configurations, in place of drawn ones. handheld :
    each photograph from a place of its own about the machine, ``repeats`` of each configuration,
    with focal lengths that differ by ``breathing``, one standard deviation; ``stations`` then says
    nothing.
    """

    stations: int | tuple[StationPlace, ...] = 3
    configurations: int = 15
    shared: bool = False
    tolerance: float = 1.0
    joint_noise: float = 3e-6
    rough_position: float = 0.05
    rough_angle: float = float(np.deg2rad(5))
    extreme: float = 0.5
    sensor: Sensor = field(default_factory=Sensor)
    board: Board | None = None
    board_on: BoardBody = "base"
    observe: tuple[str, ...] = ("legs", "board")
    repeats: int = 1
    shake: tuple[float, float] = (0.0, 0.0)
    finish: Style = "mixed"
    light: Light = "usual"
    as_built: bool = False
    handheld: bool = False
    breathing: float = FOCAL_SIGMA
    asked: RequestedConfigurations | None = None

    @property
    def n_stations(self) -> int:
        """Number of stations."""
        if self.handheld:
            return self.configurations * self.repeats
        return self.stations if isinstance(self.stations, int) else len(self.stations)


@dataclass(frozen=True)
class Truth:
    """What a user never has. Frames: the base frame that the true machine's centres stand in.

    machine : with its true values. stations, configurations : names, S and K.
    T_camera_base : (S, 4, 4). rough : poses written into the session.
    T_base_platform : (K, 4, 4). joints : (K, m) exact readings. readings : (K, m) with noise.
    photographs : (M, 2) station and configuration of each photograph. seed : of everything.
    T_base_board, T_platform_board : (4, 4) of the board, where there is one. repeats : photographs
    of each pair. focal_scale : (S,) of photographs by hand, times their camera's focal lengths.
    """

    machine: Machine
    stations: tuple[str, ...]
    configurations: tuple[str, ...]
    T_camera_base: Array
    rough: tuple[StationPlace, ...]
    T_base_platform: Array
    joints: Array
    readings: Array
    photographs: Integers
    seed: int
    T_base_board: Array | None = None
    repeats: int = 1
    T_platform_board: Array | None = None
    focal_scale: Array | None = None

    __repr__ = short_repr


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """The seed of one of the session's streams of random numbers."""
    return np.random.SeedSequence(seed).spawn(len(RANDOM_STREAMS))[RANDOM_STREAMS.index(name)]


def true_machine(drawing: Machine, scale: float, rng: np.random.Generator) -> Machine:
    """A machine as it might be built: normal deviations of ``scale`` tolerances.

    Fixed parameters keep their drawing value, tied ones move together; an axis is turned.
    """
    table = drawing.parameters
    tolerance = table.tolerances_free()
    step = table.free_matrix() @ (scale * tolerance * rng.standard_normal(len(tolerance)))
    return drawing.with_values(table.unit_axes(drawing.values + step))


def draw_truth(
    drawing: Machine, cameras: tuple[Camera, ...], settings: Settings, seed: int
) -> Truth:
    """A true machine, stations, configurations and readings; cameras : one a station, by hand
    without its breathing.
    """
    rngs = {name: np.random.default_rng(stream(seed, name)) for name in RANDOM_STREAMS}
    machine = true_machine(drawing, settings.tolerance, rngs["machine"])
    poses = settings.stations
    if settings.handheld:
        poses = places_by_hand(drawing, cameras, rngs["stations"])
    elif isinstance(poses, int):
        in_view = settings.board_on if settings.board is not None else None
        poses = default_stations(drawing, cameras, rngs["stations"], in_view)
    T_camera_base = np.stack([pose.T_camera_base() for pose in poses])
    rough = tuple(
        rough_pose(
            T,
            float(np.linalg.norm(np.subtract(pose.look_at, pose.position))),
            settings.rough_position,
            settings.rough_angle,
            rngs["stations"],
        )
        for T, pose in zip(T_camera_base, poses, strict=True)
    )
    T_base_platform, joints, photographs = _configurations(
        drawing, machine, cameras, T_camera_base, settings, rngs["configurations"]
    )
    board = None
    if settings.board is not None:
        board = place_board(
            machine,
            settings.board,
            settings.board_on,
            cameras,
            T_camera_base,
            T_base_platform,
            joints,
            rngs["board"],
        )
    noise = settings.joint_noise * rngs["readings"].standard_normal(joints.shape)
    configurations = tuple(f"{k:04d}" for k in range(len(joints)))
    names = tuple(f"station{k + 1}" for k in range(len(poses)))
    if settings.handheld:
        taken = enumerate(photographs[:, 1].tolist())
        names = tuple(
            f"{HANDHELD_STATION_NAME}-{configurations[k]}-{s % settings.repeats + 1}"
            for s, k in taken
        )
    return Truth(
        machine=machine,
        stations=names,
        configurations=configurations,
        T_camera_base=T_camera_base,
        rough=rough,
        T_base_platform=T_base_platform,
        joints=joints,
        readings=joints + noise,
        photographs=photographs,
        seed=seed,
        T_base_board=board if settings.board_on == "base" else None,
        repeats=1 if settings.handheld else settings.repeats,
        T_platform_board=board if settings.board_on == "platform" else None,
        focal_scale=1 + settings.breathing * rngs["focal"].standard_normal(len(poses))
        if settings.handheld
        else None,
    )


def _configurations(
    drawing: Machine,
    machine: Machine,
    cameras: tuple[Camera, ...],
    T_camera_base: Array,
    settings: Settings,
    rng: np.random.Generator,
) -> tuple[Array, Array, Integers]:
    """Poses, readings, and which station photographs which: legs must be in the picture.

    A controller that moves the machine by its drawing only goes where that closes.
    """
    if settings.asked is not None:
        return _at_requested(drawing, machine, settings.asked)
    n, repeats = settings.configurations, settings.repeats
    wanted = n if settings.shared or settings.handheld else n * len(cameras)
    poses, joints = draw_configurations(machine, 2 * wanted + 10, settings.extreme, rng)
    by_drawing = drawing.forward_result(joints)
    reached = by_drawing.converged & platform_unfolded(drawing, by_drawing.T_base_platform)
    poses, joints = poses[reached], joints[reached]
    in_view = np.stack(
        [
            in_picture(machine, camera, T, poses, joints)
            for camera, T in zip(cameras, T_camera_base, strict=True)
        ]
    )
    groups = [np.asarray(in_view.all(axis=0))] if settings.shared else list(in_view)
    if settings.handheld:  # each configuration by its own photographs
        n, groups = 1, list(np.all(in_view.reshape(n, repeats, -1), axis=1, keepdims=True)[:, 0])
    taken = np.zeros(len(poses), dtype=bool)
    chosen: list[Integers] = []
    for k, good in enumerate(groups):
        rows = np.flatnonzero(good & ~taken)[:n]
        if rows.size < n:
            raise GeometryError(
                what=f"station {k + 1} does not see the legs in enough configurations",
                found=str(rows.size),
                expected=str(n),
                next_step="move the station back, or use a wider lens",
            )
        taken[rows] = True
        chosen.append(rows)
    rows = _without_repeats(np.concatenate(chosen), groups, joints)
    stations = range(len(cameras))
    if settings.handheld:
        pairs = [(s, s // repeats) for s in stations]
    elif settings.shared:
        pairs = [(s, k) for s in stations for k in range(n)]
    else:
        pairs = [(s, s * n + k) for s in stations for k in range(n)]
    return poses[rows], joints[rows], np.array(pairs, dtype=int).reshape(-1, 2)


def _without_repeats(rows: Integers, groups: Sequence[Booleans], joints: Array) -> Integers:
    """The chosen candidates (K,), as many of each group; where one repeats a pose, another instead.

    Poses with every leg near an end are two to the power of the legs, so they are drawn again;
    another such stands in as long as there are any. The rest keep their places, and with these
    their names and their noise. groups : of each, the candidates (N,) that its stations see.
    joints : (N, m).
    """
    rows, pose = rows.copy(), same_pose(joints, READING_ROUNDING)
    ends = (joints < joints.min(axis=0) + READING_ROUNDING) | (
        joints > joints.max(axis=0) - READING_ROUNDING
    )
    extreme = ends.all(axis=1)
    n = len(rows) // len(groups)
    for place in range(len(rows)):
        if not np.isin(pose[rows[place]], pose[rows[:place]]):
            continue
        free = np.flatnonzero(groups[place // n] & ~np.isin(pose, pose[rows]))
        if not free.size:
            raise GeometryError(
                what="there are not enough different configurations in which the legs are seen",
                found=str(len(np.unique(pose[rows]))),
                expected=str(len(rows)),
                next_step="ask for fewer, or for fewer with every leg near an end of its range",
            )
        rows[place] = free[np.argmax(extreme[free])]
    return rows


def _at_requested(
    drawing: Machine, machine: Machine, request: RequestedConfigurations
) -> tuple[Array, Array, Integers]:
    """Poses that the true machine takes at the readings that are asked for."""
    by_drawing = drawing.forward_result(request.joints)
    fk = machine.forward_result(request.joints, by_drawing.T_base_platform)
    bad = np.flatnonzero(~(fk.converged & by_drawing.converged))
    if bad.size:
        raise GeometryError(
            what="the machine cannot take a configuration that was asked for",
            found=", ".join(f"{q:.4g}" for q in request.joints[bad[0]]),
            expected="readings at which all legs reach the platform",
        )
    return fk.T_base_platform, request.joints, request.pairs


def truth_document(truth: Truth) -> dict[str, Any]:
    """The content of ``truth.json``; m, rad, frames as in the project's conventions.

    ``parameters`` are the true values by name; ``stations`` hold 4x4 ``T_camera_base``;
    ``configurations`` hold 4x4 ``T_base_platform`` and the exact readings ``joints``;
    ``photographs`` are pairs of names, each taken ``repeats`` times (once where absent). No
    estimator reads this file.
    """
    names = truth.machine.parameters.names
    return {
        "pkmcal_truth": 1,
        "convention": "length = scale * reading + offset; x_camera = T_camera_base x_base; "
        "x_base = T_base_platform x_platform; m",
        "seed": truth.seed,
        "mechanism": truth.machine.name,
        "parameters": dict(zip(names, truth.machine.values.tolist(), strict=True)),
        "stations": {
            name: {
                "T_camera_base": T.tolist(),
                **({} if truth.focal_scale is None else {"focal_scale": truth.focal_scale[s]}),
            }
            for s, (name, T) in enumerate(zip(truth.stations, truth.T_camera_base, strict=True))
        },
        "configurations": {
            name: {"T_base_platform": T.tolist(), "joints": q.tolist()}
            for name, T, q in zip(
                truth.configurations, truth.T_base_platform, truth.joints, strict=True
            )
        },
        "photographs": [
            [truth.stations[s], truth.configurations[k]] for s, k in truth.photographs.tolist()
        ],
        **({} if truth.T_base_board is None else {"T_base_board": truth.T_base_board.tolist()}),
        **(
            {}
            if truth.T_platform_board is None
            else {"T_platform_board": truth.T_platform_board.tolist()}
        ),
        **({"repeats": truth.repeats} if truth.repeats > 1 else {}),
    }


def load_truth(folder: Path | str, drawing: Machine | None = None) -> Truth:
    """Read ``truth.json`` of a simulated session, for scoring; drawing : the session's machine,
    read from there unless given.

    Readings and rough poses are the session's; here the exact readings stand for the former.
    """
    path = Path(folder) / TRUTH_FILE
    data = json.loads(read_text(path))
    if data.get("pkmcal_truth") != 1:
        raise InputError("not the truth of a simulated session", where=str(path))
    drawing = drawing or load_session(folder).machine
    reference_values = data["parameters"]
    # a truth from before readings had scales has readings that are what they say
    values = [
        reference_values[name] if name in reference_values or not name.endswith(".scale") else 1.0
        for name in drawing.parameters.names
    ]
    stations, configurations = tuple(data["stations"]), tuple(data["configurations"])
    joints = np.array([c["joints"] for c in data["configurations"].values()])
    T_camera_base = np.array([s["T_camera_base"] for s in data["stations"].values()])
    focal = [s["focal_scale"] for s in data["stations"].values() if "focal_scale" in s]
    return Truth(
        machine=drawing.with_values(np.array(values)),
        stations=stations,
        configurations=configurations,
        T_camera_base=T_camera_base,
        rough=tuple(StationPlace.of(T) for T in T_camera_base),
        T_base_platform=np.array([c["T_base_platform"] for c in data["configurations"].values()]),
        joints=joints,
        readings=joints,
        photographs=np.array(
            [[stations.index(s), configurations.index(k)] for s, k in data["photographs"]]
        ),
        seed=data["seed"],
        T_base_board=np.array(data["T_base_board"]) if "T_base_board" in data else None,
        repeats=data.get("repeats", 1),
        T_platform_board=np.array(data["T_platform_board"]) if "T_platform_board" in data else None,
        focal_scale=np.array(focal) if focal else None,
    )
