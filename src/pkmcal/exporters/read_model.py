"""Multibody model as read from a text, with kinematics of its own.

It stands in for the target programs, which need not be installed, and knows nothing of machines;
this is what makes it a test of the texts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import (
    apply,
    perturb,
    pose,
    pose_difference,
    rotation,
    rotation_vector,
)

NO_TRANSLATION = np.zeros(3)
JOINT_BODY = " joint"
"""End of the names of bodies that readers add where a joint is beside its body's origin."""
DISPLAY_MARK = "_display"
"""Part of the names of cylinders that exports add for display, with radii of no tube."""
BASE_CROSS, PLATFORM_CROSS = "_base_cross", "_platform_cross"
"""Ends of the names of the bodies between the two axes of a universal joint that do not meet."""
NO_LIMITS = np.full(2, np.nan)
MOST_CLOSING_STEPS = 30
LARGEST_CLOSING_STEP = 0.3
"""Largest change of a joint in a step, rad or m; the sine of a larger angle is not linear."""
LOOPS_CLOSED_STEP = 1e-13
"""Largest step of a converged closure, m or rad."""
DIFFERENCE_QUOTIENT_STEP = 1e-7
"""Step of difference quotients, m or rad; their relative error is of the same order."""
DEPENDENT_CONSTRAINT_SHARE = 1e-6
"""Relative singular value below which constraints are redundant.

Above the difference quotients' error.
"""


class ReadJoint(NamedTuple):
    """Joint of kind ``hinge``, ``slide`` or ``free``.

    axis : (3,) in the body's frame.
    dof : index of its first degree of freedom.
    ref : value at home, m or rad; without meaning for a free joint.
    limits : (2,) smallest and largest value; NaN for none.
    """

    name: str
    kind: str
    axis: Array
    dof: int
    ref: float
    limits: Array = NO_LIMITS


class ReadBody(NamedTuple):
    """Body with its joints.

    parent : index of the parent; 0 is the world.
    T_parent_body : (4, 4) at home.
    """

    name: str
    parent: int
    T_parent_body: Array
    joints: tuple[ReadJoint, ...]


class ReadCylinder(NamedTuple):
    """Cylinder or capsule that a body is drawn with.

    body : index. ends : (2, 3) ends of its axis, m, body frame. radius : m.
    """

    name: str
    body: int
    ends: Array
    radius: float


class ReadLoop(NamedTuple):
    """Constraint that the frames of two bodies coincide.

    rigid : origins and orientations; otherwise origins only.
    frames : (4, 4) each, in the frame of its body.
    """

    rigid: bool
    bodies: tuple[int, int]
    frames: tuple[Array, Array]


class ReadCoupling(NamedTuple):
    """Constraint follower = ratio * leader + offset, m or rad."""

    follower: int
    leader: int
    ratio: float
    offset: float


@dataclass(frozen=True)
class ReadModel:
    """Bodies, joints and constraints of a text.

    A state x (..., d) has the value of each degree of freedom, m or rad; those of a free joint are
    the perturbation of its body's pose at home.

    sites : points by name, (body, (3,)).
    cylinders : of all bodies.
    actuated : degrees of freedom of the readings' joints, in order.
    gear : (m,) factors from these joints' values to readings.
    ctrl : (m,) readings at the key.
    key : (d,) state that is closed according to the text.
    """

    bodies: tuple[ReadBody, ...]
    loops: tuple[ReadLoop, ...]
    couplings: tuple[ReadCoupling, ...]
    sites: dict[str, tuple[int, Array]]
    cylinders: tuple[ReadCylinder, ...]
    actuated: Integers
    gear: Array
    ctrl: Array
    key: Array

    @property
    def radii(self) -> dict[str, float]:
        """Radii of the cylinders by name, m."""
        return {cylinder.name: cylinder.radius for cylinder in self.cylinders}

    def places(self, x: Array) -> dict[str, Array]:
        """Poses (..., 4, 4) of all bodies by name, world frame."""
        names = (body.name for body in self.bodies)
        return dict(zip(names, body_poses(self.bodies, x), strict=True))

    def site_places(self, x: Array) -> dict[str, Array]:
        """Positions (..., 3) of the named points, m, world frame."""
        at = body_poses(self.bodies, x)
        return {name: apply(at[body], point) for name, (body, point) in self.sites.items()}

    def gaps(self, x: Array) -> Array:
        """Residuals (..., E) of the constraints, m and rad."""
        at, out = body_poses(self.bodies, x), list[Array]()
        for loop in self.loops:
            first, second = (at[k] @ T for k, T in zip(loop.bodies, loop.frames, strict=True))
            out.append(first[..., :3, 3] - second[..., :3, 3])
            if loop.rigid:
                turn = first[..., :3, :3] @ second[..., :3, :3].mT
                out.append(rotation_vector(turn))
        for c in self.couplings:
            off = x[..., c.follower] - c.ratio * x[..., c.leader] - c.offset
            out.append(off[..., None])
        return np.concatenate([np.zeros((*x.shape[:-1], 0)), *out], axis=-1)

    @property
    def names(self) -> dict[str, int]:
        """Degree of freedom of each joint by name, without free joints."""
        joints = [j for body in self.bodies for j in body.joints if j.kind != "free"]
        return {j.name: j.dof for j in reversed(joints)}

    def at(self, readings: Array, T_base_platform: Array) -> Array:
        """States (n, d) closed at readings (n, m).

        The poses (n, 4, 4) of the platform select the assembly mode; they do not affect the closed
        state.
        """
        drives = np.isin(np.arange(self.key.size), self.actuated)
        x = np.tile(self.key, (len(readings), 1))
        x[:, self.actuated] = readings / self.gear
        # first the legs follow the platform, then the loops alone hold it
        return self.closed(self.closed(x, drives, T_base_platform), drives)

    def closed(self, x: Array, held: Booleans, goal: Array | None = None) -> Array:
        """States (n, d) with closed loops, by Gauss-Newton.

        held : (d,) degrees of freedom that remain fixed.
        goal : (n, 4, 4) poses imposed on the body ``platform``; None for none.
        """

        def remainder(x: Array) -> Array:
            """Residuals of the constraints and of the goal."""
            gaps = self.gaps(x)
            if goal is None:
                return gaps
            wanted = goal if x.ndim == 2 else goal[:, None]
            off = pose_difference(self.places(x)["platform"], wanted)
            return np.concatenate([gaps, off], axis=-1)

        # Gauss-Newton with difference quotients; the pseudoinverse tolerates redundant constraints
        steps = DIFFERENCE_QUOTIENT_STEP * np.eye(x.shape[-1])[~held]
        for _ in range(MOST_CLOSING_STEPS):
            residual = remainder(x)
            by_freedom = (
                remainder(x[:, None] + steps) - residual[:, None]
            ).mT / DIFFERENCE_QUOTIENT_STEP
            step = (
                np.linalg.pinv(by_freedom, rcond=DEPENDENT_CONSTRAINT_SHARE) @ residual[..., None]
            )
            size = np.abs(step[..., 0]).max(axis=-1, keepdims=True)
            share = LARGEST_CLOSING_STEP / np.maximum(size, LARGEST_CLOSING_STEP)
            x = x.copy()
            x[:, ~held] -= share * step[..., 0]
            if size.max() < LOOPS_CLOSED_STEP:
                break
        return x


def body_poses(bodies: Sequence[ReadBody], x: Array) -> list[Array]:
    """Poses (..., 4, 4) of bodies, world frame.

    The joints of a body act in series, each in the frame after the previous one. A free joint
    perturbs the pose in the world.
    """
    at: list[Array] = []
    for body in bodies:
        here = at[body.parent] @ body.T_parent_body if at else body.T_parent_body
        for j in body.joints:
            if j.kind == "free":
                here = perturb(here, x[..., j.dof : j.dof + 6])
                continue
            displacement = (x[..., j.dof, None] - j.ref) * j.axis
            turns = j.kind == "hinge"
            here = here @ (
                pose(rotation(displacement), NO_TRANSLATION)
                if turns
                else pose(np.eye(3), displacement)
            )
        at.append(here)
    return at
