"""True values of a simulated session, and how they are drawn.

Equal seeds and settings give equal truths. Machine, stations, configurations, readings, room,
images, board and focal lengths each have their own stream of random numbers, so that a changed
setting does not change the other draws.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
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
from pkmcal.mechanisms.disturbances import grown_readings, growth_of, is_compliant, sag
from pkmcal.mechanisms.document import STIFFNESS_TOLERANCE
from pkmcal.mechanisms.kinematics import driven_towards
from pkmcal.placement.configurations import draw_configurations, platform_unfolded, same_mode
from pkmcal.placement.stations import (
    StationPose,
    default_stations,
    in_picture,
    rough_pose,
    rough_poses,
)
from pkmcal.ranges import GOOD_ENCODER_SIGMA, Light, Style, default
from pkmcal.session.load import load_session
from pkmcal.session.readings import same_pose
from pkmcal.session.schema import BoardBody
from pkmcal.simulation.board import place_board
from pkmcal.simulation.render import Sensor

TRUTH_FILE = "truth.json"
RANDOM_STREAMS = (
    "machine", "stations", "configurations", "readings", "room", "photographs", "board", "focal",
    "effects",
)  # fmt: skip
READING_ROUNDING = 1e-9
"""Difference, in m or rad, up to which two readings at the end of a range are equal: rounding."""
ROOM_TEMPERATURE = 20.0
"""Temperature, °C, from which a machine warms."""
HANDHELD_STATION_NAME = "phone"
"""Name in session.yaml of a station with a hand-held camera."""


@dataclass(frozen=True)
class RequestedConfigurations:
    """Configurations that a caller requests, for example those of a plan.

    names, joints : (n,) and (n, m) readings. stations : names.
    pairs : (M, 2) numbers of a station and of the configuration in its image.
    """

    names: tuple[str, ...]
    joints: Array
    stations: tuple[str, ...]
    pairs: Integers


@dataclass(frozen=True)
class Settings:
    """Properties of a simulated session.

    stations : number of stations, or their poses.
    configurations : number of images of each station.
    shared : whether all stations observe the same configurations; by default each has its own.
    tolerance : standard deviation of the true values about the nominal model, in prior sigmas.
    joint_noise : standard deviation of a reading, m.
    rough_position, rough_angle : errors of the session's station poses, m and rad.
    extreme : share of configurations with every leg near an end of its range, as far as there are
        that many different poses.
    board : board that every station observes, fixed to ``board_on``.
    observe : value of ``observe`` in session.yaml for stations that observe a board.
    repeats : images of each configuration from each station, with independent sensor noise.
    shake : standard deviations (m, rad) of the camera's motion between repeats.
    finish, light : of the legs and of the room.
    as_built : whether legs have motors, rings and cables that are not in the nominal model.
    requested : requested configurations, instead of random ones.
    handheld : whether each image has a pose of its own around the machine, with ``repeats`` images
        of each configuration and focal lengths with the relative standard deviation ``breathing``;
        a number of ``stations`` is then ignored.
    warming : K, increase of the machine's temperature over the session. The readings contain the
        growth of drives and frame, the images show the machine as it is at first.
    force : mean force on each reading, N, of cranks and spools N m. Each configuration's forces are
        drawn between half and three halves of it, and logged.
    """

    stations: int | tuple[StationPose, ...] = default("simulate", "stations")
    configurations: int = default("simulate", "configurations")
    shared: bool = False
    tolerance: float = default("simulate", "tolerance")
    joint_noise: float = GOOD_ENCODER_SIGMA
    rough_position: float = 0.05
    rough_angle: float = float(np.deg2rad(5))
    extreme: float = 0.5
    sensor: Sensor = field(default_factory=Sensor)
    board: Board | None = None
    board_on: BoardBody = "base"
    observe: tuple[str, ...] = ("legs", "board")
    repeats: int = default("simulate", "repeats")
    shake: tuple[float, float] = (0.0, 0.0)
    finish: Style = "mixed"
    light: Light = "usual"
    as_built: bool = False
    handheld: bool = False
    breathing: float = FOCAL_SIGMA
    warming: float = default("simulate", "warming")
    force: float = default("simulate", "force")
    requested: RequestedConfigurations | None = None

    @property
    def n_stations(self) -> int:
        """Number of stations; of images if the camera is hand-held."""
        if not isinstance(self.stations, int):
            return len(self.stations)
        return self.configurations * self.repeats if self.handheld else self.stations


@dataclass(frozen=True)
class TrueEffects:
    """True effects on the readings.

    compliance : of the drives, relative to the stated one; None without a stated one. temperature :
    (K,) of the configurations. growth : (2,) of drives and frame, 1/K; None without temperatures.
    forces : (K, m) on the readings, N or N m; None where they are not measured.
    """

    compliance: float | None = None
    temperature: Array | None = None
    growth: Array | None = None
    forces: Array | None = None

    @classmethod
    def draw(
        cls, nominal: Machine, settings: Settings, count: int, rng: np.random.Generator
    ) -> TrueEffects:
        """Random effects by the stated stiffness and growth, by default the usual growth."""
        compliant, temperature, growth, forces = None, None, None, None
        if is_compliant(nominal):
            tolerance = nominal.document.tolerance.stiffness or STIFFNESS_TOLERANCE
            # a compliance is positive
            compliant = float(np.exp(tolerance * rng.standard_normal()))
        if settings.warming:
            # as a body that is heated evenly, to 95 % of its last temperature
            warmer = np.expm1(-3 * np.linspace(0, 1, count)) / np.expm1(-3)
            temperature = ROOM_TEMPERATURE + settings.warming * warmer
            stated = growth_of(nominal, temperature)
            growth = [stated.drives, stated.frame] + stated.root @ rng.standard_normal(2)
        if settings.force:
            forces = settings.force * rng.uniform(0.5, 1.5, (count, nominal.n_joints))
        return cls(compliant, temperature, growth, forces)

    def readings(self, machine: Machine, joints: Array, poses: Array) -> Array:
        """Readings (K, m) of drives that are at ``joints`` (K, m), at poses (K, 4, 4)."""
        if self.compliance is not None:
            joints = joints - self.compliance * sag(machine, poses, self.forces)
        if self.temperature is None or self.growth is None:
            return joints
        warmer = self.temperature - growth_of(machine, self.temperature).temperature
        grown = grown_readings(machine, poses, warmer[:, None] * self.growth)
        return joints + grown - machine.inverse(poses)


@dataclass(frozen=True)
class Truth:
    """Values that a user never has, in the base frame of the true machine's centres.

    machine : with its true values.
    stations, configurations : names, S and K.
    T_camera_base : (S, 4, 4).
    rough : station poses in session.yaml.
    T_base_platform : (K, 4, 4).
    joints, readings : (K, m) exact readings, and readings with noise.
    images : (M, 2) numbers of the station and the configuration of each image.
    seed : seed for all random numbers.
    T_base_board, T_platform_board : (4, 4) pose of the board, if any.
    repeats : number of images of each pair.
    focal_scale : (S,) factors on the camera's focal lengths, for hand-held images.
    effects : on the readings: temperatures, growth and compliance.
    unreachable : names of requested configurations that the true machine cannot take.
    """

    machine: Machine
    stations: tuple[str, ...]
    configurations: tuple[str, ...]
    T_camera_base: Array
    rough: tuple[StationPose, ...]
    T_base_platform: Array
    joints: Array
    readings: Array
    images: Integers
    seed: int
    T_base_board: Array | None = None
    repeats: int = 1
    T_platform_board: Array | None = None
    focal_scale: Array | None = None
    effects: TrueEffects | None = None
    unreachable: tuple[str, ...] = ()

    __repr__ = short_repr


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """Seed of one of the session's streams of random numbers."""
    return np.random.SeedSequence(seed).spawn(len(RANDOM_STREAMS))[RANDOM_STREAMS.index(name)]


def true_machine(nominal: Machine, scale: float, rng: np.random.Generator) -> Machine:
    """Random machine with normal deviations of ``scale`` prior sigmas from the nominal model.

    Fixed parameters keep their nominal values, tied ones have a common deviation; axes stay unit
    vectors.
    """
    table = nominal.parameters
    tolerance = table.tolerances_free()
    step = table.free_matrix() @ (scale * tolerance * rng.standard_normal(len(tolerance)))
    return nominal.with_values(table.unit_axes(nominal.values + step))


def draw_truth(
    nominal: Machine, cameras: tuple[Camera, ...], settings: Settings, seed: int
) -> Truth:
    """Random true machine, stations, configurations and readings.

    cameras : one for each station; for hand-held images without their breathing.
    """
    # true machine; stations, and their poses as session.yaml states them
    rngs = {name: np.random.default_rng(stream(seed, name)) for name in RANDOM_STREAMS}
    machine = true_machine(nominal, settings.tolerance, rngs["machine"])
    poses = settings.stations
    if isinstance(poses, int) and settings.handheld:
        poses = rough_poses(nominal, cameras, rngs["stations"])
    elif isinstance(poses, int):
        in_view = settings.board_on if settings.board is not None else None
        poses = default_stations(nominal, cameras, rngs["stations"], in_view)
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
    # configurations, board, noise of the readings
    requested = settings.requested
    if requested is None:
        T_base_platform, joints, images = _configurations(
            nominal, machine, cameras, T_camera_base, settings, rngs["configurations"]
        )
        configurations, unreachable = tuple(f"{k:04d}" for k in range(len(joints))), ()
        names = tuple(f"station{k + 1}" for k in range(len(poses)))
        if settings.handheld:
            each = enumerate(configurations[k] for k in images[:, 1])
            names = tuple(f"{name}-{s % settings.repeats + 1}" for s, name in each)
    else:
        taken, T_base_platform, joints, images = _at_requested(nominal, machine, requested)
        configurations = tuple(compress(requested.names, taken))
        names, unreachable = requested.stations, tuple(compress(requested.names, ~taken))
    board = None
    if settings.board is not None:
        board = place_board(
            machine, settings.board, settings.board_on, cameras, T_camera_base, T_base_platform,
            joints, rngs["board"],
        )  # fmt: skip
    noise = settings.joint_noise * rngs["readings"].standard_normal(joints.shape)
    effects = TrueEffects.draw(nominal, settings, len(joints), rngs["effects"])
    if settings.handheld:
        names = tuple(f"{HANDHELD_STATION_NAME}-{name}" for name in names)
    return Truth(
        machine=machine,
        stations=names,
        configurations=configurations,
        T_camera_base=T_camera_base,
        rough=rough,
        T_base_platform=T_base_platform,
        joints=joints,
        readings=effects.readings(machine, joints, T_base_platform) + noise,
        images=images,
        seed=seed,
        T_base_board=board if settings.board_on == "base" else None,
        repeats=1 if settings.handheld else settings.repeats,
        T_platform_board=board if settings.board_on == "platform" else None,
        focal_scale=1 + settings.breathing * rngs["focal"].standard_normal(len(poses))
        if settings.handheld
        else None,
        effects=effects,
        unreachable=unreachable,
    )


def _configurations(
    nominal: Machine,
    machine: Machine,
    cameras: tuple[Camera, ...],
    T_camera_base: Array,
    settings: Settings,
    rng: np.random.Generator,
) -> tuple[Array, Array, Integers]:
    """Poses, readings, and (station, configuration) pairs in which the station sees the legs.

    A controller with the nominal model only moves the machine to poses that the nominal model
    reaches.
    """
    n, repeats = settings.configurations, settings.repeats
    wanted = n if settings.shared or settings.handheld else n * len(cameras)
    poses, joints = draw_configurations(machine, 2 * wanted + 10, settings.extreme, rng)
    # candidates that the nominal model reaches in the same assembly mode
    by_nominal = nominal.forward_result(joints)
    reached = by_nominal.converged & platform_unfolded(nominal, by_nominal.T_base_platform)
    reached &= same_mode(by_nominal.T_base_platform, poses)
    poses, joints = poses[reached], joints[reached]
    # candidates in view of each group of stations, and the selection of each group
    in_view = np.stack(
        [
            in_picture(machine, camera, T, poses, joints)
            for camera, T in zip(cameras, T_camera_base, strict=True)
        ]
    )
    groups = [np.asarray(in_view.all(axis=0))] if settings.shared else list(in_view)
    if settings.handheld:  # each configuration has images of its own
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
    # pairs of station and configuration
    stations = range(len(cameras))
    if settings.handheld:
        pairs = [(s, s // repeats) for s in stations]
    elif settings.shared:
        pairs = [(s, k) for s in stations for k in range(n)]
    else:
        pairs = [(s, s * n + k) for s in stations for k in range(n)]
    return poses[rows], joints[rows], np.array(pairs, dtype=int).reshape(-1, 2)


def _without_repeats(rows: Integers, groups: Sequence[Booleans], joints: Array) -> Integers:
    """Selected candidates (K,), with repeated poses replaced by other candidates of the same group.

    Only two to the power of the number of legs poses have every leg near an end, so random draws
    repeat them; another such pose is the replacement while there is one. The other candidates keep
    their positions, and with these their names and their noise. groups : candidates (N,) that the
    stations of each group see. joints : (N, m).
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
    nominal: Machine, machine: Machine, request: RequestedConfigurations
) -> tuple[Booleans, Array, Array, Integers]:
    """Which of the requested readings the machine can take; of these the poses of the true machine,
    its readings, and the pairs of stations and configurations.
    """
    by_nominal = nominal.forward_result(request.joints)
    fk = driven_towards(machine.layout, machine.values, request.joints, by_nominal.T_base_platform)
    taken = np.asarray(fk.converged & by_nominal.converged)
    if taken.sum() < 2:
        bad = int(np.argmin(taken))
        raise GeometryError(
            what="the machine cannot take the configurations that were asked for",
            found=f"{request.names[bad]}: " + ", ".join(f"{q:.4g}" for q in request.joints[bad]),
            expected="two at least at which all legs reach the platform",
        )
    pairs = request.pairs[taken[request.pairs[:, 1]]]
    pairs = np.stack([pairs[:, 0], np.cumsum(taken)[pairs[:, 1]] - 1], axis=-1)
    return taken, fk.T_base_platform[taken], fk.readings[taken], pairs


def truth_document(truth: Truth) -> dict[str, Any]:
    """Content of ``truth.json``; m, rad, frames as in the project's conventions.

    ``parameters`` are the true values by name; ``stations`` hold 4x4 ``T_camera_base``;
    ``configurations`` hold 4x4 ``T_base_platform`` and the exact readings ``joints``;
    ``images`` are pairs of names, with ``repeats`` images of each (one by default);
    ``compliance``, ``temperature``, ``growth`` and ``forces`` are those of the readings. No
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
            [truth.stations[s], truth.configurations[k]] for s, k in truth.images.tolist()
        ],
        **({} if truth.T_base_board is None else {"T_base_board": truth.T_base_board.tolist()}),
        **(
            {}
            if truth.T_platform_board is None
            else {"T_platform_board": truth.T_platform_board.tolist()}
        ),
        **({"repeats": truth.repeats} if truth.repeats > 1 else {}),
        **_effects_document(truth.effects or TrueEffects()),
    }


def _effects_document(effects: TrueEffects) -> dict[str, Any]:
    """Fields of ``truth.json`` about effects on the readings, those that there are."""
    fields: dict[str, Any] = {}
    if effects.temperature is not None and effects.growth is not None:
        fields = {"temperature": effects.temperature.tolist(), "growth": effects.growth.tolist()}
    if effects.compliance is not None:
        fields["compliance"] = effects.compliance
    if effects.forces is not None:
        fields["forces"] = effects.forces.tolist()
    return fields


def load_truth(folder: Path | str, nominal: Machine | None = None) -> Truth:
    """Read ``truth.json`` of a simulated session, for the evaluation of estimates.

    nominal : the session's machine; read from the session by default. Measured readings and rough
    poses are in the session's files; here the exact values stand in for both.
    """
    path = Path(folder) / TRUTH_FILE
    data = json.loads(read_text(path))
    if data.get("pkmcal_truth") != 1:
        raise InputError("not the truth of a simulated session", where=str(path))
    nominal = nominal or load_session(folder).machine
    parameters = data["parameters"]
    # files from before readings had scales: the scale is one
    values = [
        parameters[name] if name in parameters or not name.endswith(".scale") else 1.0
        for name in nominal.parameters.names
    ]
    stations, configurations = tuple(data["stations"]), tuple(data["configurations"])
    joints = np.array([c["joints"] for c in data["configurations"].values()])
    T_camera_base = np.array([s["T_camera_base"] for s in data["stations"].values()])
    focal = [s["focal_scale"] for s in data["stations"].values() if "focal_scale" in s]
    return Truth(
        machine=nominal.with_values(np.array(values)),
        stations=stations,
        configurations=configurations,
        T_camera_base=T_camera_base,
        rough=tuple(StationPose.of(T) for T in T_camera_base),
        T_base_platform=np.array([c["T_base_platform"] for c in data["configurations"].values()]),
        joints=joints,
        readings=joints,
        images=np.array(
            [[stations.index(s), configurations.index(k)] for s, k in data["photographs"]]
        ),
        seed=data["seed"],
        T_base_board=np.array(data["T_base_board"]) if "T_base_board" in data else None,
        repeats=data.get("repeats", 1),
        T_platform_board=np.array(data["T_platform_board"]) if "T_platform_board" in data else None,
        focal_scale=np.array(focal) if focal else None,
        effects=TrueEffects(
            data.get("compliance"),
            *(
                np.array(data[key]) if key in data else None
                for key in ("temperature", "growth", "forces")
            ),
        ),
    )
