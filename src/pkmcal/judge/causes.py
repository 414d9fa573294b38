"""Causes of a change as directions of the machine's parameters: legs, their parts, thermal
expansion.

The magnification of a camera is one of them. Focus, temperature and touching a lens change the
focal length first; its effect on edges and boards differs from that of a machine, but is correlated
with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.camera_refinement import by_focal, edges_by_camera
from pkmcal.cameras import Camera
from pkmcal.identify.gauge import centre_index
from pkmcal.judge.fixed_machine import USUAL_RATIO_CHANGE, USUAL_STATION_MOVE, Evidence
from pkmcal.measurements import Measurements, Observation
from pkmcal.mechanisms import Machine
from pkmcal.wording import split_name

JointSide = Literal["base", "platform"]
JOINT_SIDES: tuple[JointSide, JointSide] = ("base", "platform")
COMMON_MOUNT_RATIO = 0.5
"""Maximum distance of two joints on a common mount, relative to the distance of the next joint:
half of it, up to which the circles about the pairs do not overlap."""


@dataclass(frozen=True)
class Cause:
    """Possible change of the machine or its cameras, by k numbers.

    part : of a leg (:class:`~pkmcal.mechanisms.ParameterTable`), or ``all``, ``scale``, ``camera``,
        ``station``.
    columns : (P, k) derivative of the machine's parameters (m, rad) by the numbers; (P + C, k) with
        the magnifications of C cameras; or all columns of
        :class:`~pkmcal.judge.fixed_machine.Evidence`.
    sizes : (k,) typical values of the numbers: a prior sigma, USUAL_RATIO_CHANGE, or
        USUAL_STATION_MOVE.
    legs : from 0.
    unit : of the numbers: m, rad, or empty for a ratio.
    camera, station : indices in the session.
    """

    part: str
    legs: tuple[int, ...]
    columns: Array
    sizes: Array
    unit: str
    camera: int = -1
    station: int = -1


def arms(machine: Machine) -> tuple[tuple[int, ...], ...]:
    """Groups of legs that one motor moves, from 0, in the order of their first leg; other legs are
    groups of one.
    """
    column = machine.layout.actuated
    groups: dict[int, list[int]] = {}
    for leg in range(machine.n_legs):
        key = int(column[leg]) if column[leg] >= 0 else -1 - leg
        groups.setdefault(key, []).append(leg)
    return tuple(tuple(legs) for legs in groups.values())


def whole_legs(machine: Machine) -> tuple[Cause, ...]:
    """Cause with all parameters of each arm, except those of its tubes."""
    return tuple(_of_names(machine, "all", legs) for legs in arms(machine))


def zeros(machine: Machine) -> tuple[Cause | None, ...]:
    """Cause with the zero of each arm's reading, as changed by a slipped encoder; None for an arm
    without one.
    """
    return tuple(
        cause if (cause := _of_names(machine, "zero", legs)).sizes.size else None
        for legs in arms(machine)
    )


def whole_machine(machine: Machine) -> Cause:
    """Cause with all parameters except those of the tubes."""
    return _of_names(machine, "all", tuple(range(machine.n_legs)))


def common_scale(machine: Machine) -> Cause:
    """Cause with a common scale of all lengths relative to the readings, by its excess over 1."""
    table = machine.parameters
    lengths = np.array(
        [u == "m" and k != "axis" for u, k in zip(table.units, table.kinds, strict=True)]
    )
    column = np.where(lengths, machine.values, 0.0)[:, None]
    return Cause("scale", tuple(range(machine.n_legs)), column, np.array([USUAL_RATIO_CHANGE]), "")


def magnification(machine: Machine, camera: int) -> Cause:
    """Cause with the magnification of a camera, by its excess over 1."""
    column = np.zeros((len(machine.parameters) + camera + 1, 1))
    column[-1] = 1.0
    return Cause("camera", (), column, np.array([USUAL_RATIO_CHANGE]), "", camera)


def stations_moved(evidence: Evidence) -> tuple[Cause, ...]:
    """Cause with the motion (phi, s) of each camera that is assumed to be unmoved."""
    columns = np.eye(evidence.by.shape[1])[
        :, evidence.by.shape[1] - 6 * len(evidence.fixed_stations) :
    ]
    return tuple(
        Cause(
            "station",
            (),
            columns[:, 6 * k : 6 * k + 6],
            np.full(6, USUAL_STATION_MOVE),
            "m",
            station=station,
        )
        for k, station in enumerate(evidence.fixed_stations)
    )


def single_causes(machine: Machine, evidence: Evidence | None = None) -> tuple[Cause, ...]:
    """All causes that a single event may have: a part of a leg, neighbouring joints, a common
    scale; and, if the evidence has columns for them, a lens or a moved camera.
    """
    out = [
        cause
        for legs in arms(machine)
        for part in dict.fromkeys(machine.parameters.parts)
        if (cause := _of_names(machine, part, legs)).sizes.size
    ]
    for side in JOINT_SIDES:
        for pair in _neighbours(machine, side):  # a common mount of both
            one, other = (joint_of(machine, side, leg) for leg in pair)
            out.append(Cause(side, pair, one.columns + other.columns, one.sizes, "m"))
    out.append(common_scale(machine))
    if evidence is None:
        return tuple(out)
    n_cameras = evidence.by.shape[1] - len(machine.parameters) - 6 * len(evidence.fixed_stations)
    out += [magnification(machine, c) for c in range(n_cameras)]
    return (*out, *stations_moved(evidence))


def joined_causes(causes: Sequence[Cause]) -> Cause:
    """Several causes together, each with its own numbers."""
    n = max(len(cause.columns) for cause in causes)
    columns = [np.pad(c.columns, ((0, n - len(c.columns)), (0, 0))) for c in causes]
    return Cause(
        "all",
        tuple(dict.fromkeys(leg for cause in causes for leg in cause.legs)),
        np.concatenate(columns, axis=1),
        np.concatenate([cause.sizes for cause in causes]),
        causes[0].unit,
    )


def joint_of(machine: Machine, side: JointSide, leg: int) -> Cause:
    """Cause with the displacement of a leg's joint on base or platform."""
    index = centre_index(machine.layout)[side == "platform"][leg]
    columns = np.eye(len(machine.parameters))[:, index]
    return Cause(side, (leg,), columns, machine.parameters.tolerance[index], "m")


def _of_names(machine: Machine, part: str, legs: tuple[int, ...]) -> Cause:
    """Cause with the parameters of a part of several legs, each with its own change, also of two
    rods of an arm.

    The zero of a motor, and the scale of its reading, is one number for all of its rods.
    """
    table = machine.parameters
    rows = [
        k
        for k, (name, own) in enumerate(zip(table.names, table.parts, strict=True))
        if (split_name(name)[0] or 0) - 1 in legs and own and part in (own, "all")
    ]
    tolerance = table.tolerance[rows]
    columns = np.eye(len(table))[:, rows]
    if part in ("zero", "lead") and len(legs) > 1 and len(rows) > 1:
        columns, tolerance = columns.sum(axis=1, keepdims=True), tolerance[:1]
    units = {table.units[k] for k in rows}
    return Cause(part, legs, columns, tolerance, units.pop() if len(units) == 1 else "m")


def _neighbours(machine: Machine, side: JointSide) -> list[tuple[int, int]]:
    """Pairs of legs whose joints on one side are mutually nearest, but not of one arm."""
    index = centre_index(machine.layout)[side == "platform"]
    if machine.n_legs < 4:  # all pairs of three joints are neighbours
        return []
    centres = machine.values[index]
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.argmin(apart, axis=1)
    own = {pair for arm in arms(machine) for pair in [(i, j) for i in arm for j in arm]}
    pairs = {(min(i, j), max(i, j)) for i, j in enumerate(nearest.tolist()) if nearest[j] == i}
    close = [p for p in pairs if apart[p] < COMMON_MOUNT_RATIO * np.sort(apart[p[0]])[1]]
    return sorted(set(close) - own)


def magnified(
    measurements: Measurements, observation: Observation, cameras: Sequence[Camera]
) -> Measurements:
    """Measurements with one more unknown for each camera: the relative excess of its focal lengths
    over the calibrated ones.

    cameras : (S,) of the stations with one, which come first. Derivatives of edges follow from the
    pixels that support them, those of a board's pose from its corners.
    """
    number = np.asarray(measurements.camera_of_station)
    n_cameras = int(number.max(initial=-1)) + 1
    edges, poses = measurements.edges, measurements.poses
    by_edges = by_focal(edges_by_camera(observation, cameras), edges.station, cameras)
    by_poses = by_focal(poses.by_intrinsics, poses.station, cameras)
    return replace(
        measurements,
        edges=replace(edges, by_intrinsics=by_edges[..., None]),
        poses=replace(poses, by_intrinsics=by_poses[..., None]),
        intrinsics_factor=np.ones((n_cameras, 1, 1)),
        intrinsics_at=np.zeros((n_cameras, 1)),
    )
