"""Rigid bodies of a multibody model in a closed state, and the elementary joints between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.read_model import ReadModel, body_poses
from pkmcal.geometry.rigid import pose, rotation

KEY_CLOSED_GAP = 1e-12
LARGEST_GAP = 1e-9
"""Gaps (m, rad) with which a stated state counts as closed, and with which one that was solved for
does."""


class Step(NamedTuple):
    """Elementary joint ``hinge``, ``slide`` or ``ball`` at home.

    axis, point : (3,) base frame; the axis is that of a growing value. dof : of the state, -1 for
    the joint of a loop.
    """

    kind: str
    axis: Array
    point: Array
    dof: int


class Edge(NamedTuple):
    """Joints in series between two rigid bodies."""

    first: int
    second: int
    steps: tuple[Step, ...]

    def onward(self, start: int) -> Edge:
        """Edge from one of its bodies to the other."""
        if start == self.first:
            return self
        steps = tuple(step._replace(axis=-step.axis) for step in reversed(self.steps))
        return Edge(self.second, self.first, steps)


@dataclass(frozen=True)
class RigidBodies:
    """Rigid bodies of a model in a closed state.

    model : readings' joints included. x : (d,) closed state. at : poses of the model's bodies.
    rigid : number of each body's rigid body. edges : joints between rigid bodies.
    """

    model: ReadModel
    x: Array
    at: list[Array]
    rigid: tuple[int, ...]
    edges: tuple[Edge, ...]

    def name(self, body: int) -> str:
        """Name of a rigid body: that of its first part."""
        return self.model.bodies[body].name

    def of(self, body: int) -> list[Edge]:
        """Edges from a rigid body on."""
        return [e.onward(body) for e in self.edges if body in (e.first, e.second)]

    @property
    def size(self) -> float:
        """Largest distance of a joint from the base's origin, m."""
        return max(float(np.linalg.norm(s.point)) for e in self.edges for s in e.steps)


def rigid_bodies(model: ReadModel) -> RigidBodies:
    """Rigid bodies of a model, closed from its key, and the joints between them."""
    # bodies without joints are one with their parents, as are bodies that a loop holds as poses
    pairs = [(k, body.parent) for k, body in enumerate(model.bodies) if not body.joints]
    pairs += [loop.bodies for loop in model.loops if loop.rigid]
    rigid = list(range(len(model.bodies)))
    for pair in pairs:
        low, high = sorted(rigid[body] for body in pair)
        rigid = [low if r == high else r for r in rigid]
    x = _closed_state(model)
    at, edges = body_poses(model.bodies, x), list[Edge]()
    for k, body in enumerate(model.bodies):
        if body.joints and body.joints[0].kind != "free":
            steps = tuple(_steps(model, at, x, k))
            edges.append(Edge(rigid[body.parent], rigid[k], steps))
    for loop in model.loops:
        if not loop.rigid:
            point = (at[loop.bodies[0]] @ loop.frames[0])[:3, 3]
            first, second = (rigid[body] for body in loop.bodies)
            edges.append(Edge(first, second, (Step("ball", np.zeros(3), point, -1),)))
    if not edges:
        raise InputError("the model has no joints", found=f"{len(model.bodies) - 1} bodies")
    return RigidBodies(model, x, at, tuple(rigid), tuple(edges))


def _closed_state(model: ReadModel) -> Array:
    """State (d,) of a model that is closed: its key, or the closed state next to it."""
    x = model.key
    if np.abs(model.gaps(x)).max(initial=0.0) > KEY_CLOSED_GAP:
        x = model.closed(x[None], np.zeros(x.size, dtype=bool))[0]
    gap = float(np.abs(model.gaps(x)).max(initial=0.0))
    if not gap < LARGEST_GAP:  # NaN, too
        raise InputError(
            "the loops do not close", found=f"a gap of {gap:.2g} m", expected="none at home"
        )
    return x


def _steps(model: ReadModel, at: Sequence[Array], x: Array, k: int) -> list[Step]:
    """Joints of body k, in the world at state x."""
    body, out = model.bodies[k], list[Step]()
    here = at[body.parent] @ body.T_parent_body
    for j in body.joints:
        if j.kind == "free":
            raise InputError("a free joint beside other joints is not read", where=body.name)
        out.append(Step(j.kind, here[:3, :3] @ j.axis, here[:3, 3], j.dof))
        moved = (x[j.dof] - j.ref) * j.axis
        turns = j.kind == "hinge"
        here = here @ (pose(rotation(moved), np.zeros(3)) if turns else pose(np.eye(3), moved))
    return out
