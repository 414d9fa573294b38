"""Measured edges of one photograph to lines of legs, and to the platform's pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.control.laws import Task
from pkmcal.control.seen import SeenMachine
from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import apply, cross, dot, perturb, skew
from pkmcal.mechanisms.closure import Closure, closure
from pkmcal.observe.edges import EdgeSet

SHADING = 0.1
"""Pixels by which a whole edge may lie off, whatever its own sigma: shading that the edge model
leaves out (docs/observation.md measures 0.14 and 0.22 px a place)."""
ASIDE = 0.1
"""Metres by which a leg's ends are believed to lie beside the prediction: no knowledge at all, but
it keeps the line of a leg with one edge finite until that leg is found to be lost."""
LAG = 0.001
"""Metres by which a reading may lie beside the photograph: 50 mm/s for 20 ms between the two. Edges
tell some motions of the platform a hundred times worse than others, and there readings decide."""
AGREE = 16.0
"""Mean squared misfit, in variances, beyond which a leg's edges are not one leg's."""
SIDES = np.array([0, 1])


@dataclass(frozen=True)
class LegLines:
    """Seen legs as two edges each, of the radius that the controller uses; camera frame.

    normal : (L, 2, 3) unit, NaN where the leg was not found. basis : (L, 2, 3, 2) tangent bases,
    shift first. joint : (L, 4, 4) covariance in these, rad^2, side 0 before side 1: how far away a
    leg is turns both against each other. agrees : (L,) its edges fit one leg.
    found : (L,) an edge of either side was measured, and they agree.
    """

    normal: Array
    basis: Array
    joint: Array
    agrees: Booleans
    found: Booleans

    @property
    def covariance(self) -> Array:
        """Of each edge alone, (L, 2, 2, 2) rad^2."""
        return np.stack([self.joint[:, :2, :2], self.joint[:, 2:, 2:]], axis=1)

    @classmethod
    def nothing(cls, count: int) -> LegLines:
        """No leg found of ``count``."""
        normal, basis, joint = (
            np.full((count, *shape), np.nan) for shape in ((2, 3), (2, 3, 2), (4, 4))
        )
        agrees, found = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        return cls(normal, basis, joint, agrees, found)


@dataclass(frozen=True)
class EdgeRows:
    """Edges of one photograph against the pose where they were looked for; M edges of s seen legs.

    leg : (M,) place of the edge's leg among the seen ones. misfit : (M, 2) turn from the predicted
    plane to the measured one, in the edge's basis. by_a, by_b : (M, 2, 3) its derivatives by the
    ends of the leg, camera frame. information : (M, 2, 2). side : (M,). closure : of the machine
    at that pose. a, b : (s, 3) ends of the seen legs, camera frame.
    """

    leg: Integers
    misfit: Array
    by_a: Array
    by_b: Array
    information: Array
    side: Integers
    closure: Closure
    a: Array
    b: Array

    def of_leg(self, count: int) -> Array:
        """(count, M): 1 where the edge is the leg's."""
        return (self.leg == np.arange(count)[:, None]).astype(float)


def edge_rows(
    seen: SeenMachine, readings: Array, T_base_platform: Array, edges: EdgeSet, edge_shift: float
) -> EdgeRows:
    """Edges of the seen legs against the machine at a pose (4, 4) and its readings (m,).

    edge_shift : px by which the camera shows all edges outward.
    """
    machine = seen.machine
    c = closure(machine.layout, machine.values, readings, T_base_platform)
    a, b = (apply(seen.T_camera_base, p[seen.legs]) for p in (c.ends.a, c.ends.b))
    own = edges.leg[:, None] == seen.legs
    edges = edges.select(own.any(axis=1))
    leg = own[own.any(axis=1)].argmax(axis=1)
    at = edge_normal_jacobians(a[leg], b[leg], _radii(seen, edges.leg, edges.tube), edges.side)
    to_tangent = np.swapaxes(edges.basis, -1, -2)
    off = SHADING * edges.shift
    covariance = edges.covariance + off[:, :, None] * off[:, None, :]
    return EdgeRows(
        leg=leg,
        misfit=-(to_tangent @ at.n[..., None])[..., 0] - edge_shift * edges.shift,
        by_a=to_tangent @ at.dn_da,
        by_b=to_tangent @ at.dn_db,
        information=np.linalg.inv(covariance),
        side=edges.side,
        closure=c,
        a=a,
        b=b,
    )


def _radii(seen: SeenMachine, leg: Integers, tube: Integers) -> Array:
    """Radii (M,) of tubes, m."""
    radii = seen.machine.radii()
    return np.array([radii[j][t] for j, t in zip(leg, tube, strict=True)], dtype=float)


def leg_lines(seen: SeenMachine, rows: EdgeRows) -> LegLines:
    """Lines of the seen legs from their edges.

    A leg's line has four freedoms, its two ends across the leg; every edge tells two, whatever its
    tube's radius. One Gauss-Newton step: a prediction right to 1.5 px leaves 1e-5 rad.
    """
    count = len(seen.legs)
    pick = rows.of_leg(count)
    d = rows.b - rows.a
    across = tangent_basis(d / np.sqrt(dot(d, d))[:, None], rows.a)
    e = across[rows.leg]
    jac = np.concatenate([rows.by_a @ e, rows.by_b @ e], axis=-1)
    to_right = np.swapaxes(jac, -1, -2) @ rows.information
    covariance = np.linalg.inv(np.tensordot(pick, to_right @ jac, 1) + np.eye(4) / ASIDE**2)
    right = pick @ (to_right @ rows.misfit[..., None])[..., 0]
    moved = (covariance @ right[..., None])[..., 0]
    left = rows.misfit - (jac @ moved[rows.leg][..., None])[..., 0]
    square = pick @ dot(left, (rows.information @ left[..., None])[..., 0])
    agrees = square < AGREE * np.maximum(2 * pick.sum(axis=1) - 4, 1)
    both = np.logical_and(*(pick @ (rows.side == side) > 0 for side in SIDES))
    a, b = (
        p + (across @ m[..., None])[..., 0]
        for p, m in ((rows.a, moved[:, :2]), (rows.b, moved[:, 2:]))
    )
    return _answered(seen, a, b, across, covariance, agrees, both & agrees)


def _answered(
    seen: SeenMachine, a: Array, b: Array, across: Array, covariance: Array,
    agrees: Booleans, found: Booleans,
) -> LegLines:  # fmt: skip
    """Lines (L, 3) through a and b as edges of the controller's radius."""
    radius = seen.radius[:, None]
    at = edge_normal_jacobians(a[:, None], b[:, None], radius, SIDES)
    middle = (a + b)[:, None] / 2 + radius[..., None] * at.n
    basis = tangent_basis(at.n, middle / np.sqrt(dot(middle, middle))[..., None])
    by_move = np.concatenate([at.dn_da @ across[:, None], at.dn_db @ across[:, None]], axis=-1)
    turn = (np.swapaxes(basis, -1, -2) @ by_move).reshape(-1, 4, 4)
    joint = turn @ covariance @ np.swapaxes(turn, -1, -2)
    lost = ~found[:, None, None]
    normal, joint = (np.where(lost, np.nan, v) for v in (at.n, joint))
    return LegLines(normal, np.where(lost[..., None], np.nan, basis), joint, agrees, found)


def weighted(law: str, task: Task, lines: LegLines, used: Booleans) -> tuple[Task, float]:
    """A task with its rows weighed by what the photograph tells of the legs used, (s,); and the
    standard deviation (rad) that every row then has.

    Divided by their standard deviations and multiplied by a typical one, rows stay about what they
    were.
    """
    normal, basis, joint = lines.normal[used], lines.basis[used], lines.joint[used]
    if law == "directions":
        u, spread = _direction_spread(normal, basis, joint)
        tangent = tangent_basis(u, normal[:, 0])
        to_turn = _error_to_turn(tangent)
        covariance = np.swapaxes(tangent, -1, -2) @ spread @ tangent
    else:
        to_turn = np.zeros((len(normal), 4, 6))
        to_turn[:, :2, :3], to_turn[:, 2:, 3:] = np.moveaxis(_error_to_turn(basis), 1, 0)
        covariance = joint
    size = to_turn.shape[-2]
    typical = np.exp(np.mean(np.log(np.linalg.det(covariance))) / (2 * size))
    whiten = typical * np.linalg.inv(np.linalg.cholesky(covariance)) @ to_turn
    error = (whiten @ task.error.reshape(len(whiten), -1, 1)).reshape(-1)
    matrix = whiten @ task.matrix.reshape(len(whiten), whiten.shape[-1], -1)
    return replace(task, error=error, matrix=matrix.reshape(error.size, -1)), float(typical)


def _error_to_turn(basis: Array) -> Array:
    """From e = v x v* to the turn (x, y) of v in its tangent basis (t, s = v x t): (..., 2, 3).

    A small turn gives e = -s x + t y, which has no part along v.
    """
    return np.stack([-basis[..., 1], basis[..., 0]], axis=-2)


def _direction_spread(normal: Array, basis: Array, joint: Array) -> tuple[Array, Array]:
    """Directions u = n1 x n0 / |..| (s, 3) and their covariance (s, 3, 3)."""
    across = cross(normal[:, 1], normal[:, 0])
    size = np.sqrt(dot(across, across))[:, None, None]
    u = across / size[..., 0]
    by_turn = np.concatenate(
        [skew(normal[:, 1]) @ basis[:, 0], -skew(normal[:, 0]) @ basis[:, 1]], axis=-1
    )
    by_turn = (by_turn - u[:, :, None] * (u[:, None] @ by_turn)) / size
    return u, by_turn @ joint @ np.swapaxes(by_turn, -1, -2)


def corrected_pose(
    seen: SeenMachine, T_base_platform: Array, rows: EdgeRows, found: Booleans
) -> Array:
    """The pose (4, 4) moved so that the edges of the legs found (s,) fit best: one Gauss-Newton
    step, in the directions in which the platform moves.

    Edges far off count less (Cauchy), so that one leg taken for another does not carry the pose.
    """
    use = found[rows.leg]
    if not use.any():
        return T_base_platform
    motion, c, rot = seen.machine.layout.motion, rows.closure, seen.T_camera_base[:3, :3]
    leg, misfit, information = seen.legs[rows.leg[use]], rows.misfit[use], rows.information[use]
    jac = rows.by_b[use] @ (rot @ c.ends.b_by_pose[leg]) @ motion
    square = dot(misfit, (information @ misfit[..., None])[..., 0])
    weight = 1 / (1 + square / (4 * max(float(np.median(square)), 2.0)))
    to_right = np.swapaxes(jac, -1, -2) @ information * weight[:, None, None]
    closing = c.by_pose @ motion / LAG
    normal = np.sum(to_right @ jac, axis=0) + closing.T @ closing
    right = np.sum(to_right @ misfit[..., None], axis=0)[:, 0] - closing.T @ c.value / LAG
    return perturb(T_base_platform, motion @ np.linalg.solve(normal, right))
