"""Accuracy over the bed of a machine calibrated by heights: flatness, and position along x and y.

Errors that a firmware cannot represent, such as leaning towers and wrong scales of motors, are held
fixed by the mechanism file, but still bend the bed. The standard deviations are therefore those of
a wider model, in which every parameter with a tolerance is free and the bed is as uneven as
estimated. Its estimate gives the errors of the calibrated machine as far as the heights determine
them, and its covariance contains the undetermined part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.covariance import Information
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.score import columns_of, eliminate_beside, prior_root
from pkmcal.identify.tool import closed_poses, pose_by_parameters
from pkmcal.levels import ROUNDING
from pkmcal.measurements import Column
from pkmcal.mechanisms import Machine, machine_from_document
from pkmcal.solver.elimination import rows_on_shared
from pkmcal.solver.ranks import column_space

POINTS_OVER_BED = 60
"""Points over the bed at which heights are evaluated, probed or not."""
NOTICED_TOUCH_DEVIATIONS = 4.13
"""Error of a height that is detected with a power of 80 % at a false-alarm level of 0.1 %, in
standard deviations of its difference from the prediction by the others (W. Baarda, A testing
procedure for use in geodetic networks, 1968).
"""
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
"""Angle between consecutive points on a spiral that covers a disc evenly."""


@dataclass(frozen=True)
class Bed:
    """Accuracy of the platform over the disc around the probed points.

    radius : radius of the disc, m.
    sigma : standard deviation (m, root mean square over the disc) of the platform's height above
        the bed, apart from the bed's height and tilt, with the prior sigmas of held parameters.
    by_drawing : same as ``sigma``, from the nominal model's prior sigmas alone.
    sideways : standard deviation of the platform's position along the bed, frames removed, m.
    size : relative standard deviation of the scale along the bed.
    z : height of the platform's origin, m, base frame, in the middle of the disc, where the first
        table's height is 0.
    touches : number of heights.
    unnoticed : m, root mean square over the disc: largest effect on the bed of one wrong height
        that is just not detected; None where no error of a height would be detected.
    """

    radius: float
    sigma: float
    by_drawing: float
    sideways: float
    size: float
    z: float
    touches: int
    unnoticed: float | None


def bed_by_parameters(estimate: Estimate) -> Array:
    """Derivative (n, P) of the bed's shape by the parameters.

    For a change v of the parameters ``norm(out @ v)`` is the change of the tool's height over the
    disc (m, root mean square), apart from the bed's height and tilt.
    """
    poses, _, height = _bent(estimate)
    return height / np.sqrt(len(poses))


def _bent(estimate: Estimate) -> tuple[Array, Array, Array]:
    """Poses over the disc (n, 4, 4) and derivatives by the parameters there.

    The derivatives are those of the platform's position (n, 3, P), and of its height above the bed
    (n, P), apart from the bed's height and tilt.
    """
    machine = estimate.machine
    poses = _over_the_disc(estimate.state.T_base_platform[estimate.configurations])
    joints, poses = closed_poses(machine, poses)
    by = pose_by_parameters(machine, joints, poses)[:, 3:]
    xy = poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0)
    plane = np.column_stack([np.ones(len(xy)), xy])
    slope = np.linalg.lstsq(plane, poses[:, 2, 3], rcond=None)[0][1:]
    return poses, by, _less(by[:, 2] - np.einsum("i,nip->np", slope, by[:, :2]), plane)


def bed_of(estimate: Estimate, discrepancy_columns: Sequence[Column]) -> Bed:
    """Accuracy over the bed of an estimate from heights alone.

    discrepancy_columns : of the estimated model discrepancy, which is an uneven bed.
    """
    machine = estimate.machine
    poses, by, height = _bent(estimate)
    xy = poses[:, :2, 3] - poses[:, :2, 3].mean(axis=0)
    ones, zeros = np.ones(len(xy)), np.zeros(len(xy))
    # position along the bed, without shifts and rotation of the frame; its scale
    along = by[:, :2].reshape(-1, by.shape[-1])
    shifts = np.stack([ones, zeros], axis=1).ravel(), np.stack([zeros, ones], axis=1).ravel()
    turn = np.stack([-xy[:, 1], xy[:, 0]], axis=1).ravel()
    along = _less(along, np.column_stack([*shifts, turn]))
    stretch = xy.ravel() @ along / np.sum(xy**2)
    # heights of the tool and of the table in the middle
    middle, state = poses[0], estimate.state
    there = state.T_camera_base[0] @ middle @ state.T_mount[0]
    nominal = _nominal_root(machine, by)
    off, root = _wider(estimate, nominal, discrepancy_columns)
    return Bed(
        radius=float(np.linalg.norm(xy, axis=1).max()),
        sigma=_deviation(height, off, root, len(xy)),
        by_drawing=_deviation(height, np.zeros(len(off)), nominal, len(xy)),
        sideways=_deviation(along, off, root, len(xy)),
        size=_deviation(stretch[None], off, root, 1),
        z=float(middle[2, 3] - there[2, 3]),
        touches=len(estimate.pose_residuals),
        unnoticed=_unnoticed(estimate, height),
    )


def _over_the_disc(probed: Array) -> Array:
    """Poses (n, 4, 4) of the platform over the disc around the probed points, in the plane through
    them.
    """
    xy = probed[:, :2, 3]
    middle = xy.mean(axis=0)
    plane = np.column_stack([np.ones(len(xy)), xy])
    height = np.linalg.lstsq(plane, probed[:, 2, 3], rcond=None)[0]
    k = np.arange(POINTS_OVER_BED)
    r = np.linalg.norm(xy - middle, axis=1).max() * np.sqrt((k + 0.5) / POINTS_OVER_BED)
    places = middle + r[:, None] * np.stack(
        [np.cos(GOLDEN_ANGLE * k), np.sin(GOLDEN_ANGLE * k)], axis=1
    )
    out = np.repeat(probed[:1], POINTS_OVER_BED, axis=0)
    out[:, :2, 3] = places
    out[:, 2, 3] = height[0] + places @ height[1:]
    return out


def _less(rows: Array, span: Array) -> Array:
    """Rows (n, P) minus their projection on the columns of ``span`` (n, m)."""
    return rows - span @ np.linalg.lstsq(span, rows, rcond=None)[0]


def _nominal_root(machine: Machine, by: Array) -> Array:
    """Root R (P, m) of the prior covariance of the free parameters, and of held parameters with an
    effect of their own.

    A held parameter with the same effect as a free one (the lower end of a rod, the position of its
    tower) would count twice and is omitted. by : (n, 3, P) derivative of the platform's position.
    """
    table = machine.parameters
    everything = machine_from_document(machine.document.model_copy(update={"fixed": ()})).parameters
    free, wide = (t.free_matrix() * t.tolerances_free() for t in (table, everything))
    by = by.reshape(-1, by.shape[-1])
    u, s, _ = np.linalg.svd(by @ free, full_matrices=False)
    u = u[:, s > ROUNDING * s[0]]
    shifted = by @ wide
    own = np.linalg.norm(shifted - u @ (u.T @ shifted), axis=0)
    return np.column_stack([free, wide[:, own > ROUNDING * np.linalg.norm(shifted, axis=0)]])


def _wider(
    estimate: Estimate, nominal: Array, discrepancy_columns: Sequence[Column]
) -> tuple[Array, Array]:
    """Estimate of the parameters in the wider model: difference (P,) to the estimate, and a root
    (P, m) of the covariance.

    nominal : (P, m) root of the prior covariance of the varying parameters.
    discrepancy_columns : of the bed's unevenness.
    """
    rows, remainder = _rows_beside(estimate, discrepancy_columns)
    table = estimate.machine.parameters
    n, m = nominal.shape
    # the estimate, in deviations of the nominal model; a flat bed
    at = np.zeros(m + rows.shape[1] - n)
    free = table.to_free(estimate.machine.values) / table.tolerances_free()
    at[: free.size] = free
    both = np.concatenate(
        [np.concatenate([rows[:, :n] @ nominal, rows[:, n:]], axis=1), np.eye(len(at))]
    )
    _, s, vt = np.linalg.svd(both, full_matrices=False)
    half = vt.T / s
    best = -half @ (half.T @ (both.T @ np.concatenate([remainder, at])))
    return nominal @ best[:m], nominal @ half[:m]


def _rows_beside(estimate: Estimate, discrepancy_columns: Sequence[Column]) -> tuple[Array, Array]:
    """Information of the heights on all P parameters and the l random effects.

    Returns rows (r, P + l), by parameters in m and rad and by effects in their prior sigmas, and
    residuals (r,). All other unknowns are marginalized; priors of the parameters are left out.
    """
    assembled, info = estimate.linearized
    problem, state = info.problem.opened(info.state)
    columns = columns_of(replace(assembled, problem=problem), state, discrepancy_columns)
    root = prior_root(discrepancy_columns)
    machine, count = problem.unknowns.columns("machine"), problem.unknowns.count
    parts: list[tuple[Array, Array]] = []
    for cut, piece in zip(problem.cuts, Information(problem, state).pieces(), strict=True):
        linear = piece.linear
        own, value = eliminate_beside(linear, columns(cut, linear) @ root)
        parts.append((own.reshape(-1, own.shape[-1]), value.ravel()))
        reference = ~linear.shared_by[:, machine].any(axis=1)
        if not cut.start:
            prior = np.pad(linear.shared_by[reference], ((0, 0), (0, root.shape[1])))
            parts.append((prior, linear.shared_value[0][reference]))
    rows, remaining = (np.concatenate(part) for part in zip(*parts, strict=True))
    used = np.append(machine, np.arange(count, rows.shape[1]))
    q = column_space(np.delete(rows, used, axis=1))
    rows = rows[:, used]
    return rows - q @ (q.T @ rows), remaining - q @ (q.T @ remaining)


def _unnoticed(estimate: Estimate, height: Array) -> float | None:
    """Effect on the bed of one wrong height that is just not detected (``Bed.unnoticed``).

    height : (n, P) derivative of the height over the disc.
    """
    info = estimate.linearized.info
    problem, state = info.problem, info.state
    rows = rows_on_shared(info.linear, info.reduced)[0][0]
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv((rows / scale).T @ (rows / scale), rcond=ROUNDING, hermitian=True)
    inverse /= scale[:, None] * scale
    own = rows[: len(rows) - len(problem.prior)]
    # with its pose eliminated, each configuration has one reduced row: its height
    _, s, vt = np.linalg.svd(own.reshape(state.T_base_platform.shape[1], -1, own.shape[1]))
    felt = s[:, :1] * vt[:, 0]
    gain = felt @ inverse
    remainder = 1 - np.sum(gain * felt, axis=1)
    if remainder.min() < ROUNDING:
        return None
    shifted = height @ problem.free @ gain[:, problem.unknowns.machine].T
    return float(
        np.max(NOTICED_TOUCH_DEVIATIONS * np.sqrt(np.mean(shifted**2, axis=0) / remainder))
    )


def _deviation(rows: Array, off: Array, root: Array, places: int) -> float:
    """Standard deviation of rows (n, P), root mean square over ``places`` points.

    off, root : offset (P,) of the parameters, and root (P, m) of their covariance.
    """
    return float(np.sqrt((np.sum((rows @ off) ** 2) + np.sum((rows @ root) ** 2)) / places))
