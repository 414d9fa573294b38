"""Estimates by [A]'s four steps, [B]'s linear solution and [C]'s inverse-kinematic method.

The papers give no uncertainties. Here the linear solution's standard deviations are those of its
equations; for the other methods they are the scatter over repetitions with the stated noise of
edges and readings added once more.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.covariance import data_share, prior_in_gauge
from pkmcal.identify.estimate import Estimate, Statistics
from pkmcal.identify.gauge import default_gauge, in_gauge
from pkmcal.identify.hand_eye import start_from_poses
from pkmcal.identify.methods.four_step import four_step
from pkmcal.identify.methods.four_step_base import with_boards
from pkmcal.identify.methods.inverse_kinematic import inverse_kinematic
from pkmcal.identify.methods.linear_together import base_together
from pkmcal.identify.scatter import EdgeScatter
from pkmcal.identify.state import State, estimated_unknowns
from pkmcal.measurements import OWN_SHADING, Measurements
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.mechanisms import Machine
from pkmcal.ranges import AlternativeMethod
from pkmcal.solver.kernels import NO_WEIGHT_DISTANCE

Repeated = Literal["four-step", "inverse-kinematic"]
SIGMA_REPETITIONS = 60
"""Number of repetitions for the standard deviations, which are then accurate to 9 %."""


def by_method(
    method: AlternativeMethod,
    machine: Machine,
    measurements: Measurements,
    joint: Estimate,
    seed: int = 0,
    repetitions: int = SIGMA_REPETITIONS,
) -> Estimate:
    """Estimate by one of the papers' methods on the same edges.

    joint : the joint estimate, for the poses of stations that see too few legs. Raises ResultError
    if the method cannot be applied.
    """
    if method == "linear":
        return linear_estimate(machine, measurements)
    guess = joint.state.T_camera_base
    state = _solve(method, machine, measurements, guess)
    rng = np.random.default_rng(seed)
    # repetitions with the stated noise added
    repeats: list[State] = []
    failed: list[ResultError] = []
    for _ in range(repetitions):
        try:
            repeats.append(_solve(method, machine, _noisy(measurements, rng), guess))
        except ResultError as error:
            failed.append(error)
    if len(failed) > len(repeats):
        raise failed[0]
    # scatter of machine and stations over the repetitions
    theta = np.stack([r.theta for r in repeats])
    turns = np.stack([pose_difference(r.T_camera_base, state.T_camera_base) for r in repeats])
    mounts = np.zeros((len(repeats), 6 * len(state.T_mount)))
    scatter = np.concatenate([theta, turns.reshape(len(repeats), -1), mounts], axis=1)
    spread = np.cov(scatter, rowvar=False)
    return _estimate(machine.with_values(state.theta), measurements, state, spread)


def _solve(method: Repeated, machine: Machine, measurements: Measurements, guess: Array) -> State:
    if method == "inverse-kinematic":
        start = start_from_poses(machine, measurements, guess)
        state = inverse_kinematic(machine, measurements, start)
    else:
        state = four_step(machine, measurements, T_camera_base_guess=guess)
    state = in_gauge(machine, state, default_gauge(machine))
    return replace(state, theta=machine.parameters.unit_axes(state.theta))


def linear_estimate(machine: Machine, measurements: Measurements) -> Estimate:
    """[B] 14 for base, radii, edge shift and stations; platform and all lengths are nominal.

    Its covariance is that of the equations, with the nominal model's prior sigmas for parameters
    without data, such as platform joints. Raises ResultError without edges of legs, and if a
    station sees too few of them.
    """
    if not len(measurements.edges):
        raise ResultError(
            what="the linear solution needs images of the legs, and no edge of one was measured",
            next_step="take images of the legs, or use the joint method (bundle)",
        )
    base = base_together(machine, measurements)
    poses = machine.with_values(base.theta).forward_result(measurements.joints, machine.home())
    state = with_boards(measurements, base.theta, base.T_camera_base, poses.T_base_platform)
    state = replace(state, columns={EDGE_SHIFT: base.edge_shift})
    gauge, estimated = default_gauge(machine), estimated_unknowns(state)
    spread = np.zeros((estimated.count, base.spread.shape[1]))
    spread[: len(base.spread)] = base.spread
    full = prior_in_gauge(machine, state, spread, np.eye(spread.shape[1]), gauge)
    state = in_gauge(machine, state, gauge)
    state = replace(state, theta=machine.parameters.unit_axes(state.theta))
    return replace(
        _estimate(
            machine.with_values(state.theta),
            measurements,
            state,
            full,
            (base.weights, base.scale),
        ),
        column_covariance={EDGE_SHIFT: np.diag(base.edge_shift_sigma**2)},
        line_shading=base.shading,
    )


def _noisy(measurements: Measurements, rng: np.random.Generator) -> Measurements:
    """The measurements with their stated noise added once more."""
    edges = measurements.edges
    turn = np.linalg.cholesky(edges.covariance) @ rng.normal(size=(len(edges), 2, 1))
    normal = edges.normal + (edges.basis @ turn)[..., 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    noise = measurements.joint_noise * rng.normal(size=measurements.joints.shape)
    poses = measurements.poses
    # components that were not measured have no noise
    shifted = (np.linalg.pinv(poses.whiten) @ rng.normal(size=(len(poses), 6, 1)))[..., 0]
    return replace(
        measurements,
        edges=replace(edges, normal=normal),
        joints=measurements.joints + noise,
        poses=replace(poses, T_station_target=perturb(poses.T_station_target, shifted)),
    )


def _estimate(
    machine: Machine,
    measurements: Measurements,
    state: State,
    joint: Array,
    irls_weight: tuple[Array, float] | None = None,
) -> Estimate:
    """Estimate of a method with its residuals.

    joint : covariance as in :class:`~pkmcal.identify.estimate.Estimate`. irls_weight : weights (N,)
    of the edges and the factor on their noise, if the method has its own; by default edges with a
    large residual have weight 0.
    """
    gauge = default_gauge(machine)
    # whitened residuals of the state
    assembled = assemble(machine, measurements, gauge)
    batch = batch_of(machine, assembled, state)
    unweighted = assembled.problem.unweighted(batch)
    edges = np.nan_to_num(assembled.places.edges.taken(unweighted.edges[0]))
    distance = np.sqrt(np.sum(edges**2, axis=-1))
    # noise scale from the median, and weights
    middle = float(np.median(distance)) if distance.size else 0.0
    scale = max(middle / np.sqrt(2 * np.log(2)), 1.0)
    weight = (distance < NO_WEIGHT_DISTANCE * scale).astype(float)
    if irls_weight is not None:
        weight, scale = irls_weight
    poses = assembled.places.poses.taken(unweighted.poses[0])
    links = assembled.places.links.taken(unweighted.links[0])[:, 0]
    n_poses, n_edges = float(measurements.poses.rows.sum()), float(2 * weight.sum())
    pose_scale = max(float(np.sqrt(np.sum(poses**2) / n_poses)) if n_poses else 1.0, 1.0)
    chi2 = float(np.sum(weight[:, None] * (edges / scale) ** 2))
    n_tubes = max(map(len, machine.layout.radius), default=0)
    # closures are zero to rounding, as poses come from the readings
    joints = machine.inverse(state.T_base_platform) - measurements.joints
    return Estimate(
        machine=machine,
        state=replace(
            state, columns={EDGE_SHIFT: np.zeros(measurements.n_cameras), **state.columns}
        ),
        joint_covariance=joint,
        column_covariance={EDGE_SHIFT: np.zeros((measurements.n_cameras,) * 2)},
        edge_residuals=edges / scale,
        pose_residuals=poses / pose_scale,
        pose_weights=np.ones(len(poses)),
        link_residuals=links,
        link_weights=np.ones(len(links)),
        edge_weights=weight,
        edge_noise=EdgeScatter(
            np.full(n_tubes, scale), np.full(n_tubes, scale * OWN_SHADING), np.full(n_tubes, np.inf)
        ),
        edge_trust=np.ones(len(weight)),
        joint_residuals=joints / measurements.joint_noise,
        data_share=data_share(machine, state.theta, joint, gauge),
        configurations=assembled.observed,
        statistics=Statistics(
            chi2=chi2,
            dof=n_edges,
            chi2_edges=chi2,
            n_edges=n_edges,
            chi2_joints=0.0,
            n_joints=0,
            chi2_drawing=0.0,
            n_drawing=0,
            steps=0,
            stopped="closed form",
            noise_scale=float(scale),
            chi2_poses=float(np.sum(poses**2)) / pose_scale**2,
            n_poses=n_poses,
            dof_poses=n_poses,
            pose_scale=pose_scale,
        ),
        gauge=gauge.name,
        problem=assembled,
    )
