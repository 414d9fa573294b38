"""Points of one rigid body, seen in many frames: the body and its poses together.

The corrected form of [A] 9 (base centres seen from the stations) and of [A] 16 (platform
centres seen in the photographs): ``min sum w |T_k p_j - m_kj|^2`` over points p and poses T_k.
Products of distances between coplanar points, as printed, leave the third coordinate to
second order; this does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import perturb, register, skew
from pkmcal.identify.solver import Linear, Solution, Values, minimise

SCALE = 1e-4
"""Metres that count as one standard deviation; it only sets where the search stops."""


class Body(NamedTuple):
    """Points (B, n, 3) and the poses (B, K, 4, 4) that map them to the frames they are seen in."""

    points: Array
    poses: Array


@dataclass(frozen=True)
class BodyProblem:
    """solver.LeastSquares for a rigid body; measured (B, K, n, 3), weight (B, K, n).

    gauge : (c, 3 n) rows that hold the body's frame. drawing : (n, 3) their reference.
    """

    measured: Array
    weight: Array
    gauge: Array
    drawing: Array

    def residuals(self, state: Body) -> Values:
        """Weighted differences and the gauge's rows."""
        linear = self.linearize(state)
        return Values(linear.value, linear.shared_value)

    def linearize(self, state: Body) -> Linear:
        """Residuals and exact Jacobian."""
        shape = self.measured.shape
        rot = state.poses[..., None, :3, :3]
        turned = (rot @ state.points[:, None, :, :, None])[..., 0]
        difference = turned + state.poses[..., None, :3, 3] - self.measured
        w = np.sqrt(self.weight)[..., None] / SCALE
        value = np.where(w > 0, difference * w, 0.0)
        n = shape[2]
        by_shared = np.zeros((*shape, n, 3))
        j = np.arange(n)
        by_shared[:, :, j, :, j, :] = np.moveaxis(
            np.broadcast_to(rot, (*shape, 3)) * w[..., None], 2, 0
        )
        by_own = np.zeros((*shape, 6))
        by_own[..., :3], by_own[..., 3:] = -skew(turned) * w[..., None], np.eye(3) * w[..., None]
        held = (state.points - self.drawing).reshape(shape[0], -1) @ self.gauge.T
        rows = (shape[0], shape[1], 3 * n)
        return Linear(
            value.reshape(rows),
            by_shared.reshape(*rows, 3 * n),
            by_own.reshape(*rows, 6),
            np.ones(rows, dtype=bool),
            held / SCALE,
            self.gauge / SCALE,
        )

    @staticmethod
    def moved(state: Body, shared: Array, own: Array) -> Body:
        """The body after a step."""
        return Body(state.points + shared.reshape(state.points.shape), perturb(state.poses, own))

    def select(self, runs: Integers) -> BodyProblem:
        """Some runs only."""
        return replace(self, measured=self.measured[runs], weight=self.weight[runs])

    @staticmethod
    def take(state: Body, runs: Integers) -> Body:
        """Some runs' states."""
        return Body(state.points[runs], state.poses[runs])

    @staticmethod
    def put(state: Body, runs: Integers, part: Body) -> Body:
        """Some runs' states replaced."""
        points, poses = state.points.copy(), state.poses.copy()
        points[runs], poses[runs] = part.points, part.poses
        return Body(points, poses)


def fit_body(measured: Array, weight: Array, gauge: Array, drawing: Array) -> Body:
    """The body and its poses from what was seen; [A] 9 and 16 corrected.

    measured : (B, K, n, 3) m. weight : (B, K, n), 0 where not seen; a frame with fewer than
    three points leaves its pose undetermined and should be left out. gauge : (c, 3 n) rows on
    the points. drawing : (n, 3) m, the start.
    """
    measured = np.where(weight[..., None] > 0, measured, 0.0)
    points = np.broadcast_to(drawing, (measured.shape[0], *drawing.shape)).copy()
    start = Body(points, register(points[:, None], measured, np.maximum(weight, 1e-12)))
    return minimise(BodyProblem(measured, weight, gauge, drawing), start).state


@dataclass(frozen=True)
class Dense:
    """A plain batched least-squares problem on a vector (B, n), for the papers' criteria.

    rows : function of x (b, n) and the runs' numbers (b,), gives values (b, r) and Jacobian
    (b, r, n).
    """

    rows: Callable[[Array, Integers], tuple[Array, Array]]
    runs: Integers

    def residuals(self, state: Array) -> Values:
        """Values only."""
        value, _ = self.rows(state, self.runs)
        return Values(value[:, None], np.zeros((len(value), 0)))

    def linearize(self, state: Array) -> Linear:
        """Values and Jacobian; there are no unknowns of a configuration's own."""
        value, jac = self.rows(state, self.runs)
        usable: Booleans = np.ones((len(value), 1, value.shape[-1]), dtype=bool)
        own = np.zeros((*usable.shape, 0))
        n = state.shape[-1]
        return Linear(
            value[:, None], jac[:, None], own, usable, np.zeros((len(value), 0)), np.zeros((0, n))
        )

    @staticmethod
    def moved(state: Array, shared: Array, own: Array) -> Array:
        """The vector after a step."""
        return state + shared + 0 * own.sum()

    def select(self, runs: Integers) -> Dense:
        """Some runs only."""
        return replace(self, runs=self.runs[runs])

    @staticmethod
    def take(state: Array, runs: Integers) -> Array:
        """Some runs' vectors."""
        return state[runs]

    @staticmethod
    def put(state: Array, runs: Integers, part: Array) -> Array:
        """Some runs' vectors replaced."""
        out = state.copy()
        out[runs] = part
        return out


def minimise_dense(
    rows: Callable[[Array, Integers], tuple[Array, Array]], start: Array
) -> Solution:
    """Batched Levenberg-Marquardt on plain vectors (B, n)."""
    return minimise(Dense(rows, np.arange(len(start))), start)
