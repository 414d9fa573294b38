"""[A]'s four steps, [B]'s linear solution and [C]'s inverse-kinematic method as results of their
own, to compare with.

They come without uncertainties in the papers; here, standard deviations are the spread of the
method over repetitions with the edges' and readings' stated noise added once more.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import apply as move
from pkmcal.geometry.rigid import inverse, perturb, pose_difference, register
from pkmcal.identify import linear
from pkmcal.identify.assembly import Assembled, assemble, batch_of
from pkmcal.identify.covariance import data_share
from pkmcal.identify.four_step import four_step
from pkmcal.identify.four_step_boards import mount_poses
from pkmcal.identify.gauge import apply, centre_index, default_gauge
from pkmcal.identify.hand_eye import start_from_poses
from pkmcal.identify.inverse_kinematic import inverse_kinematic
from pkmcal.identify.problem import Estimate, State, Statistics
from pkmcal.identify.residuals import BatchState
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine

Method = Literal["four-step", "linear", "inverse-kinematic"]
REPETITIONS = 60
"""Repetitions for the standard deviations: they are then known to 9 %."""


def by_paper(
    method: Method, machine: Machine, measurements: Measurements, joint: Estimate, seed: int = 0
) -> Estimate:
    """An estimate by one of the papers' methods on the same edges.

    joint : the joint estimate, for the stations' poses where a station sees too few legs.
    Raises ResultError where the method cannot be applied.
    """
    guess = joint.state.T_camera_base
    state = _solve(method, machine, measurements, guess)
    rng = np.random.default_rng(seed)
    repeats = _repeated(method, machine, measurements, guess, rng)
    theta = np.cov(np.stack([r.theta for r in repeats]), rowvar=False)
    turns = np.stack([pose_difference(r.T_camera_base, state.T_camera_base) for r in repeats])
    stations = np.stack([np.cov(turns[:, s], rowvar=False) for s in range(turns.shape[1])])
    return _estimate(machine.with_values(state.theta), measurements, state, theta, stations)


def _repeated(
    method: Method,
    machine: Machine,
    measurements: Measurements,
    guess: Array,
    rng: np.random.Generator,
) -> list[State]:
    """The method with noise added once more, again and again; most repetitions must go through."""
    found: list[State] = []
    failed: list[ResultError] = []
    for _ in range(REPETITIONS):
        try:
            found.append(_solve(method, machine, _noisy(measurements, rng), guess))
        except ResultError as error:
            failed.append(error)
    if len(failed) > len(found):
        raise failed[0]
    return found


def _solve(method: Method, machine: Machine, measurements: Measurements, guess: Array) -> State:
    if method == "linear":
        state = linear_state(machine, measurements)
    elif method == "inverse-kinematic":
        start = start_from_poses(machine, measurements, guess)
        state = inverse_kinematic(machine, measurements, start)
    else:
        state = four_step(machine, measurements, T_camera_base_guess=guess)
    state = apply(machine, state, default_gauge(machine))
    return replace(state, theta=machine.parameters.unit_axes(state.theta))


def linear_state(machine: Machine, measurements: Measurements) -> State:
    """[B] 14 robustly for the base centres, 16 for their scale, 15 for the stations; rest drawn.

    An edge shift or a wrong radius scales what a station sees (16 tells why), so each station's
    centres are brought to the drawing's size, by Procrustes: as printed, the mean ratio of
    distances, close pairs and their noise decide.
    Base centres of several stations are averaged after registration, weighted by how well each
    station knows them.
    """
    found = linear.centres(machine, measurements, "robust")
    drawing = machine.base_centers()
    known: Booleans = np.all(np.isfinite(found.centres), axis=-1)
    if (known.sum(axis=1) < 3).any():
        raise ResultError(
            "[B]'s linear method needs three legs, each in two directions, at every station",
            found=f"{known.sum(axis=1).min()} legs at one of them",
            next_step="Use the joint method (bundle), which is the default",
        )
    sizes = [
        linear.procrustes_scale(a[k], drawing[k]) for a, k in zip(found.centres, known, strict=True)
    ]
    centres = found.centres / np.array(sizes)[:, None, None]
    stations = np.stack([register(drawing[k], a[k]) for a, k in zip(centres, known, strict=True)])
    spread = np.trace(found.covariance, axis1=-2, axis2=-1)
    weight = np.where(known, 1 / np.where(known, spread, 1.0), 0.0)
    in_base = move(inverse(stations)[:, None], np.where(known[..., None], centres, 0.0))
    total = weight.sum(axis=0)
    mean = np.einsum("sl,slc->lc", weight, in_base) / np.where(total > 0, total, 1.0)[:, None]
    theta = machine.values.copy()
    base_index, platform_index = centre_index(machine.layout)
    theta[base_index] = np.where(total[:, None] > 0, mean, drawing)
    if machine.document.motion == "planar":  # both ends of a leg have one height
        rise = theta[base_index[:, 2]] - drawing[:, 2]
        theta[platform_index[:, 2]] = machine.platform_centers()[:, 2] + rise
    poses = machine.with_values(theta).forward_result(measurements.joints, machine.home())
    n_cameras = int(np.max(measurements.camera_of_station)) + 1
    state = State(theta, stations, poses.T_base_platform, np.zeros(n_cameras))
    boards = mount_poses(measurements, state)
    return replace(state, T_mount=boards, on_platform=measurements.on_platform)


def _noisy(measurements: Measurements, rng: np.random.Generator) -> Measurements:
    """The measurements with their stated noise added once more."""
    edges = measurements.edges
    turn = np.linalg.cholesky(edges.covariance) @ rng.normal(size=(len(edges), 2, 1))
    normal = edges.normal + (edges.basis @ turn)[..., 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    noise = measurements.joint_noise * rng.normal(size=measurements.joints.shape)
    poses = measurements.poses
    # what was not measured has no noise
    move = (np.linalg.pinv(poses.whiten) @ rng.normal(size=(len(poses), 6, 1)))[..., 0]
    return replace(
        measurements,
        edges=replace(edges, normal=normal),
        joints=measurements.joints + noise,
        poses=replace(poses, T_station_target=perturb(poses.T_station_target, move)),
    )


def _estimate(
    machine: Machine, measurements: Measurements, state: State, theta: Array, stations: Array
) -> Estimate:
    """The method's result with its residuals; edges far off the rest have weight 0."""
    assembled = assemble(machine, measurements, default_gauge(machine), use_drawing=False)
    batch = batch_of(machine, assembled, state)
    rows = assembled.problem.block_residuals(batch)[0][assembled.row, assembled.place]
    rows = np.nan_to_num(rows)
    distance = np.sqrt(np.sum(rows**2, axis=-1))
    middle = float(np.median(distance)) if distance.size else 0.0
    scale = max(middle / np.sqrt(2 * np.log(2)), 1.0)
    off = _pose_residuals(assembled, batch)
    count = float(measurements.poses.rows.sum())
    pose_scale = max(float(np.sqrt(np.sum(off**2) / count)) if count else 1.0, 1.0)
    weight = (distance < 6.5 * scale).astype(float)
    return Estimate(
        machine=machine,
        state=state,
        covariance=theta,
        station_covariance=stations,
        edge_shift_sigma=np.zeros(len(state.edge_shift)),
        edge_residuals=rows / scale,
        pose_residuals=off / pose_scale,
        pose_weights=np.ones(len(off)),
        mount_covariance=np.zeros((len(state.T_mount), 6, 6)),
        edge_weights=weight,
        joint_residuals=_joint_residuals(machine, measurements, state),
        data_share=data_share(machine, state.theta, theta, default_gauge(machine)),
        configurations=assembled.seen,
        statistics=replace(
            _statistics(rows, weight, scale),
            chi2_poses=float(np.sum(off**2)) / pose_scale**2,
            n_poses=count,
            dof_poses=count,
            pose_scale=pose_scale,
        ),
        gauge=default_gauge(machine).name,
    )


def _pose_residuals(assembled: Assembled, batch: BatchState) -> Array:
    """Whitened residuals of the boards' poses, (N, 6)."""
    rows = assembled.problem.pose_residuals(batch)
    return rows[0, assembled.pose_row, assembled.pose_place]


def _joint_residuals(machine: Machine, measurements: Measurements, state: State) -> Array:
    """Closures in standard deviations; zero to rounding, as poses come from the readings."""
    predicted = machine.inverse(state.T_base_platform)
    return (predicted - measurements.joints) / measurements.joint_noise


def _statistics(rows: Array, weight: Array, scale: float) -> Statistics:
    chi2 = float(np.sum(weight[:, None] * (rows / scale) ** 2))
    count = float(2 * weight.sum())
    return Statistics(
        chi2=chi2,
        dof=count,
        chi2_edges=chi2,
        n_edges=count,
        chi2_joints=0.0,
        n_joints=0,
        chi2_drawing=0.0,
        n_drawing=0,
        steps=0,
        stopped="closed form",
        noise_scale=scale,
    )
