"""A step of the joint estimate, taken along what bends: frames, and the limbs' closures."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import inverse, perturb
from pkmcal.identify.gauge import (
    mount_generators,
    move_generators,
    moved_centres,
    moved_mounts,
    pose_generators,
    slid,
    station_generators,
    turned_back,
)
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms.closure import on_tangents

if TYPE_CHECKING:
    from pkmcal.identify.problem import Problem

CLOSINGS = 2
"""Newton steps back onto the closures; each squares what is left."""


def moved(problem: Problem, state: BatchState, shared: Array, own: Array) -> BatchState:
    """The state after a step (B, na) and (B, K, d).

    The part of the step that only turns or shifts the frames is made as an exact frame
    change. Added up it would bend the sharp closures and edges at second order, and the
    drawing's soft hold on the frames would be found along a curved valley.
    """
    y, inner = _inner(problem, state, shared, own)
    trial = _in_frames(problem, inner, y[:, :12, 0], y[:, 12:, 0])
    return _closed(problem, state, trial, shared, own)


def _inner(
    problem: Problem, state: BatchState, shared: Array, own: Array
) -> tuple[Array, BatchState]:
    """The step's part that only changes frames (B, 12 + n, 1), and the state after the rest."""
    nz, ns = problem.free.shape[1], 6 * problem.n_stations
    by_frames = move_generators(problem.layout, problem.theta(state), problem.drawing)
    by_frames = np.linalg.pinv(problem.free) @ by_frames
    moves = problem.frames @ np.linalg.pinv(by_frames @ problem.frames) @ shared[:, :nz, None]
    z = shared[:, :nz] - (by_frames @ moves)[..., 0]
    y, slides = moves[:, :12], moves[:, 12:, 0]
    camera = shared[:, nz : nz + ns].reshape(-1, problem.n_stations, 6)
    camera = camera - (station_generators(state.T_camera_base) @ y[:, None])[..., 0]
    own = own @ problem.layout.own_motion.T
    pose, internal = own[..., :6], own[..., 6:]
    pose = pose - (pose_generators(state.T_base_platform) @ y[:, None])[..., 0]
    n, m = problem.lines_at, problem.mounts_at
    mount = shared[:, m:].reshape(*state.T_mount.shape[:2], 6)
    by_frame = mount_generators(state.T_mount, problem.pose_blocks.on_platform)
    return moves, BatchState(
        state.z + z,
        perturb(state.T_camera_base, camera),
        perturb(state.T_base_platform, pose),
        state.optics + shared[:, nz + ns : n].reshape(state.optics.shape),
        perturb(state.T_mount, mount - (by_frame @ y[:, None])[..., 0]),
        state.internal + internal + turned_back(problem.layout, slides)[:, None],
        state.shading + shared[:, n:m],
    )


def _in_frames(problem: Problem, state: BatchState, y: Array, slides: Array) -> BatchState:
    """The state after exact frame changes y (B, 12) and others (B, n)."""
    layout, e, f = problem.layout, perturb(np.eye(4), y[:, :6]), perturb(np.eye(4), y[:, 6:])
    theta = moved_centres(layout, slid(layout, problem.theta(state), slides), e, f)
    theta = on_tangents(layout, theta, problem.drawing)
    return replace(
        state,
        z=(theta - problem.drawing) @ np.linalg.pinv(problem.free).T,
        T_camera_base=state.T_camera_base @ inverse(e)[:, None],
        T_base_platform=e[:, None] @ state.T_base_platform @ inverse(f)[:, None],
        T_mount=moved_mounts(state.T_mount, problem.pose_blocks.on_platform, e, f),
        internal=state.internal - turned_back(layout, slides)[:, None],
    )


def _closed(
    problem: Problem, state: BatchState, trial: BatchState, shared: Array, own: Array
) -> BatchState:
    """The trial with its poses moved to where the closures are what the step meant them to be.

    For machines with cranks or sliders, whose readings are far sharper than a board's poses: the
    closures bend over a step by more than they may be wrong, and the search would creep.
    """
    layout = problem.layout
    freedoms = layout.own_motion.shape[1]
    if layout.n_equations != freedoms or not any(g.carrier.driven for g in layout.base):
        return trial
    c = problem.closure(state)
    change = shared[:, : problem.free.shape[1]] @ problem.free.T
    change = np.pad(change, ((0, 0), (0, 1)))[:, c.index][:, None]
    wanted = c.value + np.sum(c.by_theta * change, axis=-1)
    wanted = wanted + (layout.by_own(c) @ own[..., None])[..., 0]
    for _ in range(CLOSINGS):
        c = problem.closure(trial)
        back = np.linalg.pinv(layout.by_own(c)) @ (wanted - c.value)[..., None]
        step = back[..., 0] @ layout.own_motion.T
        trial = replace(
            trial,
            T_base_platform=perturb(trial.T_base_platform, step[..., :6]),
            internal=trial.internal + step[..., 6:],
        )
    return trial
