"""How sure the estimate is: covariance, noise scale, rank. All from exact derivatives.

The covariance is the inverse of the reduced information at the solution, told in a gauge. It
covers the noise of edges and readings and the drawing's tolerances; it does not cover errors
of the model (joint clearance, bending, a wrong lens).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import skew
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import (
    Gauge,
    alignment,
    carried_errors,
    changed_frames,
    conventions,
    generators,
    mount_generators,
    move_generators,
    projector,
    transformation,
)
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms import Machine, ParameterTable
from pkmcal.solver import Linear, Reduced, eliminate, reduced_normal, transposed

RANK_TOLERANCE = 1e-9
"""Singular values below this share of the largest are zero: rounding leaves 1e-12 to 1e-14
there with exact derivatives, and real directions are many orders above."""
NULL = 1e-12
"""Same, for the scaled rows with drawing and gauge: below it a direction counts as unknown."""
UNKNOWN = 1e-13
"""Same, for eigenvalues of the scaled normal matrix, which hold half of the digits."""


class Information(NamedTuple):
    """The problem at the solution.

    linear, reduced : its rows and their elimination. covariance : (B, na, na) of the shared
    unknowns; a direction that nothing fixes has a huge variance.
    """

    linear: Linear
    reduced: Reduced
    covariance: Array

    def cost(self) -> Array:
        """Sum of squares of all residuals, (B,)."""
        own = np.sum(self.linear.value**2, axis=(1, 2))
        return own + np.sum(self.linear.shared_value**2, axis=1)


def information(problem: Problem, state: BatchState) -> Information:
    """Covariance of the shared unknowns before any gauge is applied."""
    linear = problem.linearize(state)
    reduced = eliminate(linear, np.zeros(state.z.shape[0]))
    n_runs, na = reduced.rows.shape[0], reduced.rows.shape[-1]
    stacked = np.concatenate(
        [
            reduced.rows.reshape(n_runs, -1, na),
            np.broadcast_to(linear.shared_by, (n_runs, *linear.shared_by.shape)),
        ],
        axis=1,
    )
    scale = np.sqrt(np.sum(stacked**2, axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    r = np.linalg.qr(stacked / scale[:, None, :], mode="r")
    _, s, vt = np.linalg.svd(r)
    half = transposed(vt) / np.maximum(s, NULL * s[:, :1])[:, None, :] / scale[:, :, None]
    return Information(linear, reduced, half @ transposed(half))


def group_fit(linear: Linear, reduced: Reduced, group: slice, count: Array) -> tuple[Array, Array]:
    """A group's chi2 and its degrees of freedom, count - tr(hat), (B,) each.

    group : its rows in a configuration. count : rows in use, (B,). reduced : without damping. The
    hat matrix splits into the own unknowns' part Q Q^T and the shared unknowns' part
    tr(N^-1 N_group); directions that nothing fixes have no part in it.
    """
    own = np.sum(reduced.q[:, :, group] ** 2, axis=(1, 2, 3))
    rows = reduced.rows[:, :, group].reshape(len(count), -1, reduced.rows.shape[-1])
    normal = reduced_normal(linear, reduced)
    scale = np.sqrt(np.einsum("bii->bi", normal))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(normal / (scale[:, :, None] * scale[:, None, :]))
    known = values > UNKNOWN * values[:, -1:]
    rows = rows / scale[:, None, :] @ vectors
    variance = np.where(known, 1 / np.where(known, values, 1.0), 0.0)
    shared = np.sum(rows**2 * variance[:, None], axis=(1, 2))
    return np.sum(linear.value[:, :, group] ** 2, axis=(1, 2)), count - own - shared


def machine_covariance(
    problem: Problem, machine: Machine, before: State, shared: Array, gauge: Gauge
) -> Array:
    """Covariance (P + 6 S + 6 M) of parameters, stations and mounts, told in the gauge.

    before : the solution as the solver left it. shared : (na, na) covariance there.
    """
    n_free, n_par = problem.free.shape[1], len(machine.parameters)
    n_first, n_mount = 6 * problem.n_stations, 6 * problem.pose_blocks.n_mounts
    kept = np.r_[: n_free + n_first, len(shared) - n_mount : len(shared)]
    spread = np.zeros((n_par + n_first + n_mount, len(kept)))
    spread[:n_par, :n_free] = problem.free
    spread[n_par:, n_free:] = np.eye(n_first + n_mount)
    e, f = alignment(machine, before, gauge)
    after = changed_frames(machine.layout, before, e, f)
    first = n_par + n_first
    spread[:first] = carried_errors(machine.layout, before, e, f) @ spread[:first]
    spread[first:] = _carried_mounts(before, e, f) @ spread[first:]
    spread[first:] -= _moved_mounts(machine, after, gauge) @ spread[:n_par]
    spread[:first] = transformation(machine, after, gauge) @ spread[:first]
    spread[:n_par] = _along_units(machine, after.theta, spread[:n_par])
    out = spread @ shared[np.ix_(kept, kept)] @ spread.T
    # constrained and fixed coordinates are exactly known; the product leaves rounding there
    known = np.flatnonzero(np.diag(out)[:n_par] < 1e-18 * machine.parameters.tolerance**2)
    out[known, :], out[:, known] = 0.0, 0.0
    return 0.5 * (out + out.T)


def _carried_mounts(before: State, e: Array, f: Array) -> Array:
    """Errors (6M, 6M) of mounts before the frame changes to those after: turned with their body,
    and moved by the turn about its new origin.
    """
    n = len(before.T_mount)
    out = np.zeros((n, 6, n, 6))
    for m, moving in enumerate(before.on_platform):
        frame = f if moving else e
        rot = frame[:3, :3]
        out[m, :3, m, :3] = out[m, 3:, m, 3:] = rot
        out[m, 3:, m, :3] = skew(frame[:3, 3]) @ rot
    return out.reshape(6 * n, 6 * n)


def _moved_mounts(machine: Machine, after: State, gauge: Gauge) -> Array:
    """What restoring the gauge does to mounts, by the parameters' errors, (6M, P)."""
    moved = mount_generators(after.T_mount, after.on_platform).reshape(-1, 12)
    return moved @ projector(machine, after.theta, gauge)


def _along_units(machine: Machine, theta: Array, rows: Array) -> Array:
    """Errors (P, n) of parameters, those of axes kept across the axis: their length is one."""
    for index in np.concatenate(machine.layout.turning):
        axis = theta[index] / np.linalg.norm(theta[index])
        rows[index] -= np.outer(axis, axis @ rows[index])
    return rows


def data_share(machine: Machine, theta: Array, covariance: Array, gauge: Gauge) -> Array:
    """1 - posterior variance / drawing variance in the gauge, (P,); 0 where both vanish."""
    table, free = machine.parameters, machine.parameters.free_matrix()
    change = projector(machine, theta, gauge)
    spread = free - generators(machine.layout, theta) @ (change @ free)
    drawing = np.sum((spread * table.tolerances_free()) ** 2, axis=1)
    known = drawing > 1e-12 * table.tolerance**2
    share = 1 - np.diag(covariance)[: len(table)] / np.where(known, drawing, 1.0)
    return np.where(known, share, 0.0)


@dataclass(frozen=True)
class Direction:
    """A combination of parameters: names with weights, largest first, and how well known.

    information : singular value of the data in units of the drawing's tolerance; 1 means that
    the data know it as well as the drawing does. vector : (P,) the change of all parameters, m and
    rad, with the largest entry one tolerance.
    """

    names: tuple[str, ...]
    weights: tuple[float, ...]
    information: float
    vector: Array


@dataclass(frozen=True)
class Identifiability:
    """What the data alone can tell of the machine, frames aside.

    n_parameters : free ones. n_frames : freedoms of the frames, and of hinges' beginnings.
    rank : directions the data fix. unidentified : directions that no amount of such data fixes.
    weak : directions that the drawing knows better than the data.
    """

    n_parameters: int
    n_frames: int
    rank: int
    unidentified: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    singular_values: Array

    @property
    def basis(self) -> Array:
        """Changes (n, P) of all parameters that the data cannot see, m and rad."""
        return np.array([d.vector for d in self.unidentified]).reshape(len(self.unidentified), -1)


def identifiability(problem: Problem, machine: Machine, state: BatchState) -> Identifiability:
    """Rank of the data's own information, drawing left out; the problem's first run.

    Poses, stations, edge shifts and shading are eliminated, frames taken out, and the columns are
    scaled by the drawing's tolerances.
    """
    linear = problem.linearize(state)
    rows = eliminate(linear, np.zeros(state.z.shape[0])).rows[0]
    table, nz = machine.parameters, problem.free.shape[1]
    # what is known beforehand of cameras and shading is no drawing: without it, a shift of every
    # line by itself would hide the tubes' radii
    other = linear.shared_by[:, :nz].any(axis=1) | linear.shared_by[:, problem.mounts_at :].any(
        axis=1
    )
    beside = linear.shared_by[~other]
    rows = np.concatenate([rows.reshape(-1, rows.shape[-1]), beside])
    q = _column_space(rows[:, nz:])
    tolerance = table.tolerances_free()
    left = rows[:, :nz] * tolerance
    left = left - q @ (q.T @ left)
    theta, moves = problem.theta(state)[0], conventions(machine)
    moved = move_generators(machine.layout, theta) @ moves
    moved = np.linalg.lstsq(problem.free, moved, rcond=None)[0]
    basis = np.linalg.qr(moved / tolerance[:, None], mode="complete")[0][:, moves.shape[1] :]
    s, vt = _all_singular(left @ basis)
    directions = vt @ basis.T
    lost = s < RANK_TOLERANCE * s[0]
    vectors = (directions * tolerance) @ problem.free.T
    made = [
        _direction(table, d, v, float(x)) for d, v, x in zip(directions, vectors, s, strict=True)
    ]
    return Identifiability(
        n_parameters=nz,
        n_frames=moves.shape[1],
        rank=int(np.sum(~lost)),
        unidentified=tuple(m for m, gone in zip(made, lost, strict=True) if gone),
        weak=tuple(m for m, gone in zip(made, lost, strict=True) if not gone and m.information < 1),
        singular_values=s,
    )


def _all_singular(matrix: Array) -> tuple[Array, Array]:
    """Singular values and all right vectors: as many as columns, however few rows there are."""
    _, s, vt = np.linalg.svd(np.linalg.qr(matrix, mode="r"), full_matrices=True)
    return np.pad(s, (0, len(vt) - len(s))), vt


def _column_space(columns: Array) -> Array:
    """An orthonormal basis of what columns can make; a station seen from nowhere spans less."""
    u, s, _ = np.linalg.svd(_scaled(columns), full_matrices=False)
    return u[:, s > RANK_TOLERANCE * s.max(initial=0.0)]


def _scaled(columns: Array) -> Array:
    norm = np.linalg.norm(columns, axis=0)
    return columns[:, norm > 0] / norm[norm > 0]


def _direction(table: ParameterTable, weights: Array, vector: Array, value: float) -> Direction:
    order = np.argsort(-np.abs(weights), kind="stable")
    order = order[np.abs(weights[order]) > 0.15 * np.abs(weights).max()][:8]
    names = table.free_names()
    size = np.abs(vector / table.tolerance).max()
    return Direction(
        tuple(names[k] for k in order),
        tuple(float(weights[k]) for k in order),
        value,
        vector / size,
    )
