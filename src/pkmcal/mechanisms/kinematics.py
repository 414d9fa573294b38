"""Inverse and forward kinematics of any machine, batched over poses.

Forward kinematics solves the closure for the pose by Levenberg-Marquardt from a start in the
right assembly; each configuration of the batch has its own damping and stops on its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import perturb, pose, rotation
from pkmcal.mechanisms.limbs import Closure, LimbLayout, closure, limb_ends, rod_lengths

MAX_STEPS = 60
CONVERGED = 1e-12
"""Closure error (m) below which a configuration is solved: 100 times rounding at 1 m."""
SETTLING = 15
"""Steps for a machine's second rods; a pose that they all allow takes four."""
SETTLED = 1e-15
"""A step of readings (rad) and hinges below which nothing changes any more."""
NEAR_SINGULAR = 0.02
"""Smallest singular value of the scaled inverse Jacobian below which a warning is due: a
reading's error then moves the platform fifty times as far."""


@dataclass(frozen=True)
class ForwardResult:
    """Poses found from readings, and how far to trust each.

    T_base_platform : (..., 4, 4); converged : (...); error : (...) largest closure error, m.
    singularity : (...) smallest singular value of the inverse Jacobian with rotations scaled
        by the platform's radius: 1 is a good machine, 0 a singular pose.
    internal : (..., n) the hinges' turns of an articulated platform, rad; n = 0 for a rigid one.
    """

    T_base_platform: Array
    converged: Booleans
    error: Array
    singularity: Array
    internal: Array


def inverse(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Readings (..., m) at poses T_base_platform (..., 4, 4).

    Rods: q = length - offset, [B] eq. 4. Cranks and sliders: the carrier's closed form, [C] eq. 2,
    nearest to mid-range. NaN out of reach.
    """
    return inverse_result(layout, theta, poses)[0]


def inverse_result(layout: LimbLayout, theta: Array, poses: Array) -> tuple[Array, Array]:
    """Readings (..., m) and internal coordinates (..., n) at poses (..., 4, 4)."""
    shape = np.broadcast_shapes(poses.shape[:-2], theta.shape[:-1])
    internal = np.zeros((*shape, layout.n_internal))
    legs = _leg_inverse(layout, theta, poses)
    if not layout.shares_motors:
        return legs[..., np.flatnonzero(layout.actuated >= 0)][..., _in_columns(layout)], internal
    columns = layout.actuated[None] == np.arange(layout.n_readings)[:, None]
    readings = legs @ (columns / columns.sum(axis=1, keepdims=True)).T
    return _settled(layout, theta, poses, readings, internal)


def _in_columns(layout: LimbLayout) -> Integers:
    """Order of the driven legs that makes their readings' columns rise."""
    return np.argsort(layout.actuated[layout.actuated >= 0], kind="stable")


def _leg_inverse(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Each leg's own reading (..., L), zero where it has none."""
    zeros = np.zeros((*poses.shape[:-2], layout.n_readings))
    c = closure(layout, theta, zeros, poses)
    out = np.zeros(c.distance.shape)
    rods = rod_lengths(layout, theta, zeros)
    legs = np.flatnonzero(layout.closing)
    rows = np.flatnonzero(layout.rod_reads[legs])
    # linear in the reading of a rod on a fixed centre
    out[..., legs[rows]] = -c.value[..., rows] / c.by_reading[..., rows]
    for group in layout.base:
        if group.carrier.driven:
            at = (..., group.legs)
            b = c.ends.b[..., group.legs, :]
            near = layout.middle[group.legs]
            out[at] = group.carrier.reading(group.of(theta), b, rods[at], near)
    return out


def _settled(
    layout: LimbLayout, theta: Array, poses: Array, readings: Array, internal: Array
) -> tuple[Array, Array]:
    """Readings and internal coordinates that close a machine with several rods a motor best.

    Gauss-Newton with the poses held, from each motor's mean of its rods.
    """
    m = layout.n_readings
    pick = (layout.row_motor[:, None] == np.arange(m)).astype(float)
    x = np.concatenate([readings, internal], axis=-1)
    for _ in range(SETTLING):
        c = closure(layout, theta, x[..., :m], poses, x[..., m:])
        jac = np.concatenate([c.by_reading[..., None] * pick, c.by_internal], axis=-1)
        # what is out of reach is NaN and stays so
        jac, value = np.nan_to_num(jac), np.nan_to_num(c.value)
        step = _damped_solve(jac, value, np.full(value.shape[:-1], 1e-14))
        x = x - step
        if np.abs(step).max(initial=0.0) < SETTLED:
            break
    return x[..., :m], x[..., m:]


def forward(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    start: Array,
    internal: Array | None = None,
) -> ForwardResult:
    """Poses at readings (..., m), from starts (..., 4, 4); theta (..., P) broadcasts.

    Unknowns are the motion's directions only, so a planar machine stays in its plane, and the
    internal coordinates (..., n), from zero where they are not given.
    """
    shape = np.broadcast_shapes(readings.shape[:-1], start.shape[:-2], theta.shape[:-1])
    current = np.broadcast_to(start, (*shape, 4, 4)).copy()
    phi = np.zeros((*shape, layout.n_internal)) if internal is None else internal
    phi = np.broadcast_to(phi, (*shape, layout.n_internal))
    damping = np.full(shape, 1e-6)
    c = closure(layout, theta, readings, current, phi)
    cost = np.sum(c.value**2, axis=-1)
    for _ in range(MAX_STEPS):
        active = np.max(np.abs(c.value), axis=-1) > CONVERGED * 1e-2
        if not active.any():
            break
        step = -_damped_solve(layout.by_own(c), c.value, damping)
        step = np.where(active[..., None], step, 0.0) @ layout.own_motion.T
        trial, phi_trial = perturb(current, step[..., :6]), phi + step[..., 6:]
        c_trial = closure(layout, theta, readings, trial, phi_trial)
        cost_trial = np.sum(c_trial.value**2, axis=-1)
        better = cost_trial < cost
        if not (better & active).any() and np.all(damping[active] > 1e3):
            break
        current = np.where(better[..., None, None], trial, current)
        phi = np.where(better[..., None], phi_trial, phi)
        cost = np.where(better, cost_trial, cost)
        damping = np.clip(np.where(better, damping * 0.05, damping * 30), 1e-14, 1e6)
        c = closure(layout, theta, readings, current, phi)
    return _result(layout, theta, current, phi, c.value, c)


def _result(
    layout: LimbLayout, theta: Array, poses: Array, internal: Array, value: Array, c: Closure
) -> ForwardResult:
    reached = np.isfinite(c.value).all(axis=-1)
    error = np.where(reached, np.abs(value).max(axis=-1, initial=0.0), np.inf)
    least = _singularity(layout, theta, layout.by_own(c))
    return ForwardResult(poses, error < CONVERGED, error, least, internal)


def _damped_solve(jac: Array, value: Array, damping: Array) -> Array:
    """Levenberg-Marquardt step with column scaling, (..., d)."""
    normal = np.swapaxes(jac, -1, -2) @ jac
    scale = np.einsum("...ii->...i", normal) + 1e-300
    normal = normal + damping[..., None, None] * scale[..., None] * np.eye(jac.shape[-1])
    gradient = np.swapaxes(jac, -1, -2) @ value[..., None]
    return np.linalg.solve(normal, gradient)[..., 0]


def singularity(layout: LimbLayout, theta: Array, by_pose: Array) -> Array:
    """Smallest singular value of the inverse Jacobian of rigid platforms, dimensionless; (...).

    by_pose : the closure's, (..., E, 6). Rotations are scaled by the platform's radius, so a row is
    about a unit direction; zero means that the platform can move with all joints locked.
    """
    return _singularity(layout, theta, by_pose @ layout.motion)


def _singularity(layout: LimbLayout, theta: Array, by_own: Array) -> Array:
    """The same with internal coordinates, which turn as the platform does; by_own (..., E, d)."""
    if layout.n_equations < by_own.shape[-1]:  # fewer than its freedoms: it can always move
        return np.zeros(by_own.shape[:-2])
    hinges = np.arange(by_own.shape[-1]) >= layout.motion.shape[1]
    turns = hinges | (np.abs(layout.own_motion[:3]).sum(axis=0) > 0)
    scale = np.where(turns, 1 / _radius(layout, theta)[..., None], 1.0)
    scaled = by_own * scale[..., None, :]
    known = np.isfinite(scaled).all(axis=(-1, -2))
    least = np.linalg.svd(np.nan_to_num(scaled), compute_uv=False)[..., -1]
    return np.where(known, least, np.nan)


def _radius(layout: LimbLayout, theta: Array) -> Array:
    """Root mean square distance (...) of the platform's joints from their mean, m."""
    points = [g.carrier.point(g.of(theta), np.eye(4)).value for g in layout.platform]
    centres = np.concatenate(points, axis=-2)
    spread = centres - centres.mean(axis=-2, keepdims=True)
    radius = np.sqrt(np.mean(np.sum(spread**2, axis=-1), axis=-1))
    return np.where(radius > 0, radius, 1.0)  # legs that meet in a point turn nothing


def home_candidates(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Starts for a machine whose file names no home pose: the platform unturned, its joints'
    mean above (and below) the base joints' mean, at the height that the rods reach; (k, 4, 4).
    """
    ends = limb_ends(layout, theta, readings, np.eye(4))
    shift = ends.a.mean(axis=-2) - ends.b.mean(axis=-2)
    reach = _reach(layout, theta, readings)
    flat = float(np.linalg.norm((ends.b + shift - ends.a)[..., :2], axis=-1).mean())
    height = np.sqrt(max(reach**2 - flat**2, (0.3 * reach) ** 2))
    sides = (-1, 1) if _hangs(layout, theta, ends.a) else (1, -1)
    starts = [pose(np.eye(3), shift + np.array([0.0, 0.0, s * height])) for s in sides]
    if layout.motion.shape[1] == 3 and layout.motion[2, 0] == 1:
        starts = [pose(rotation(np.array([0, 0, a])), shift) for a in (0.0, 0.5, -0.5, 1.0, -1.0)]
    return np.stack(starts)


def _hangs(layout: LimbLayout, theta: Array, a: Array) -> bool:
    """Whether cranks reach below their axes at these ends (L, 3), so that the platform does."""
    drops = [(a[g.legs] - g.of(theta)[..., :3])[..., 2] for g in layout.base if g.carrier.driven]
    return bool(drops) and float(np.concatenate(drops).mean()) < 0


def _reach(layout: LimbLayout, theta: Array, readings: Array) -> float:
    """Mean length of the rods whose length is known, m."""
    return float(np.abs(rod_lengths(layout, theta, readings)[layout.closing]).mean())


def on_manifold(layout: LimbLayout, theta: Array, poses: Array) -> ForwardResult:
    """Poses (..., 4, 4) moved to where everything closes that no drive can change.

    Constant rods, joints' axes and second rods of a motor leave a platform only some poses;
    readings follow from these. Gauss-Newton with the shortest step, so a pose that is right stays
    where it is.
    """
    current = np.array(poses)
    readings, phi = inverse_result(layout, theta, current)
    c = closure(layout, theta, readings, current, phi)
    free = layout.driven_rows.size < layout.n_equations or layout.shares_motors
    for _ in range(MAX_STEPS if free else 0):
        value, blind = _undriven(layout, c)
        value, by_pose = np.nan_to_num(value), np.nan_to_num(blind @ c.by_pose @ layout.motion)
        if np.abs(value).max(initial=0.0) < CONVERGED * 1e-2:
            break
        step = -np.linalg.pinv(by_pose) @ value[..., None]
        current = perturb(current, (layout.motion @ step)[..., 0])
        readings, phi = inverse_result(layout, theta, current)
        c = closure(layout, theta, readings, current, phi)
    return _result(layout, theta, current, phi, _undriven(layout, c)[0], c)


def _undriven(layout: LimbLayout, c: Closure) -> tuple[Array, Array]:
    """Combinations (..., r, E) of the closure's rows that neither drives nor hinges move, and
    their values (..., r).
    """
    passive = np.flatnonzero(layout.row_motor < 0)
    blind = np.eye(layout.n_equations)[passive]
    if layout.shares_motors:
        pick = layout.row_motor[:, None] == np.arange(layout.n_readings)
        moved = np.concatenate([c.by_reading[..., None] * pick, c.by_internal], axis=-1)
        moved = np.nan_to_num(moved)
        q = np.linalg.qr(moved, mode="complete")[0]
        blind = np.swapaxes(q[..., moved.shape[-1] :], -1, -2)
    return (blind @ c.value[..., None])[..., 0], blind


def assembly_modes(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    rng: np.random.Generator,
    starts: int = 400,
) -> Array:
    """Distinct poses that close the machine at one set of readings (m,): (k, 4, 4).

    A multi-start search: every mode returned is one; that none is missing is not proven.
    """
    home = home_candidates(layout, theta, readings)[0]
    reach = _reach(layout, theta, readings)
    turns = rng.normal(size=(starts, 3)) * 1.2
    shifts = rng.normal(size=(starts, 3)) * reach
    delta = np.concatenate([turns, shifts], axis=-1) @ layout.motion @ layout.motion.T
    found = forward(layout, theta, readings, perturb(home, delta))
    poses = found.T_base_platform[found.converged]
    kept: list[Array] = []
    for candidate in poses:  # few distinct ones: a loop over results, not over work
        if all(np.abs(candidate - other).max() > 1e-6 for other in kept):
            kept.append(candidate)
    return np.stack(kept) if kept else np.zeros((0, 4, 4))
