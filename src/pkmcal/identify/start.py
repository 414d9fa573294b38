"""Initial state of the joint estimate, from the readings and the measured poses."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import inverse, pose
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.robust import norms
from pkmcal.identify.state import State
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import ForwardResult

MEDIAN_TURN_STEPS = 15
EQUAL_TURNS_ANGLE = 1e-4
"""Difference of rotation matrices (Frobenius norm, about rad) below which rotations are equal."""


def start_state(
    machine: Machine,
    measurements: Measurements,
    T_camera_base_guess: Array,
    forward: ForwardResult | None = None,
) -> State:
    """Initial state: the machine's present values, and poses by forward kinematics of the readings.

    Poses from measured directions of the legs would lead into local minima (errata, B).

    T_camera_base_guess : (S, 4, 4).
    forward : forward kinematics of the machine at these readings, if solved already.
    """
    fk = forward or machine.forward_result(measurements.joints)
    poses = fk.T_base_platform
    stations = np.asarray(T_camera_base_guess)
    return State(
        machine.values,
        stations,
        poses,
        T_mount=start_mounts(measurements, stations, poses),
        on_platform=measurements.on_platform,
        internal=fk.internal,
    )


def start_mounts(measurements: Measurements, T_camera_base: Array, poses: Array) -> Array:
    """Initial T_mount (M, 4, 4) from the measured poses and the poses of stations and platform.

    T_camera_base : (S, 4, 4). poses : T_base_platform (K, 4, 4).
    """
    in_view, on_platform = measurements.poses, measurements.on_platform
    body = T_camera_base[in_view.station]
    body = np.where(
        on_platform[in_view.mount][:, None, None], body @ poses[in_view.configuration], body
    )
    each = inverse(body) @ in_view.T_station_target
    mounts = [middle_pose(each[in_view.mount == m]) for m in range(len(measurements.mounts))]
    return np.array(mounts).reshape(-1, 4, 4)


def middle_pose(poses: Array) -> Array:
    """Robust mean (4, 4) of poses (n, 4, 4); the identity for n = 0.

    Positions by the median of each coordinate; the rotation by the geometric median, with
    Weiszfeld's iteration.
    """
    if not len(poses):
        return np.eye(4)
    weight, rot = np.ones(len(poses)), np.eye(3)
    for _ in range(MEDIAN_TURN_STEPS):
        u, _, vt = np.linalg.svd(np.einsum("n,nij->ij", weight, poses[:, :3, :3]))
        rot = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        apart = np.linalg.norm(poses[:, :3, :3] - rot, axis=(1, 2))
        weight = 1 / np.maximum(apart, EQUAL_TURNS_ANGLE)
    return pose(rot, np.median(poses[:, :3, 3], axis=0))


def edge_misfit(machine: Machine, measurements: Measurements, state: State) -> float:
    """Median Mahalanobis distance of the edges from their prediction; infinite without edges."""
    assembled = assemble(machine, measurements, default_gauge(machine))
    rows = assembled.problem.unweighted(batch_of(machine, assembled, state))
    distance = norms(assembled.problem, rows).edges
    values = distance[np.isfinite(distance)]
    return float(np.median(values)) if values.size else np.inf
