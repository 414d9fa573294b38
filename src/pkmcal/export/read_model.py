"""A model of bodies, joints and loops as it was read again from a text, with kinematics of its own.

The other programs need not be there for an export, so that what is written is tested by this.
Nothing here knows a machine.
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
MOST_CLOSING_STEPS = 30
LOOPS_CLOSED_STEP = 1e-13
"""m or rad of a step below which nothing changes any more."""
DIFFERENCE_QUOTIENT_STEP = 1e-7
"""m or rad, of the differences that derivatives are taken from: right to as much."""
DEPENDENT_CONSTRAINT_SHARE = 1e-6
"""Share of the largest singular value below which constraints say the same; above that error."""


class ReadJoint(NamedTuple):
    """A ``hinge``, ``slide`` or ``free`` joint; axis (3,) in its body's frame; first freedom; its
    value as drawn (a free joint's is none).
    """

    name: str
    kind: str
    axis: Array
    dof: int
    ref: float


class ReadBody(NamedTuple):
    """A body: its parent's number (0 is the world), place in it as drawn (4, 4), and joints."""

    name: str
    parent: int
    T_parent_body: Array
    joints: tuple[ReadJoint, ...]


class ReadLoop(NamedTuple):
    """Two bodies' frames, moved to where they meet (4, 4) each, that coincide: their points, and
    where ``rigid`` their orientations as well.
    """

    rigid: bool
    bodies: tuple[int, int]
    frames: tuple[Array, Array]


class ReadCoupling(NamedTuple):
    """A freedom that follows another: ratio * leader's + offset, m or rad."""

    follower: int
    leader: int
    ratio: float
    offset: float


@dataclass(frozen=True)
class ReadModel:
    """What a text says.

    A state x (..., d) has each freedom's value, m or rad: a free joint's are the rotation vector
    from its body's drawn orientation, and the shift. key : the state that the text says is closed.
    sites, radii : points (body, (3,)) and cylinders' radii (m) by name. actuated : freedoms of the
    readings' joints, in order; gear : (m,) what such a joint's value is multiplied by for the
    reading; ctrl : (m,) the readings in the key.
    """

    bodies: tuple[ReadBody, ...]
    loops: tuple[ReadLoop, ...]
    couplings: tuple[ReadCoupling, ...]
    sites: dict[str, tuple[int, Array]]
    radii: dict[str, float]
    actuated: Integers
    gear: Array
    ctrl: Array
    key: Array

    def places(self, x: Array) -> dict[str, Array]:
        """Poses (..., 4, 4) of all bodies by name, world frame."""
        names = (body.name for body in self.bodies)
        return dict(zip(names, body_poses(self.bodies, x), strict=True))

    def site_places(self, x: Array) -> dict[str, Array]:
        """Where the named points are, (..., 3) m, world frame."""
        at = body_poses(self.bodies, x)
        return {name: apply(at[body], point) for name, (body, point) in self.sites.items()}

    def gaps(self, x: Array) -> Array:
        """What is left of the equality constraints (..., E), m and rad."""
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
        return np.concatenate(out, axis=-1)

    @property
    def names(self) -> dict[str, int]:
        """The freedom of each joint, by name; a free body's are left out."""
        joints = [j for body in self.bodies for j in body.joints if j.kind != "free"]
        return {j.name: j.dof for j in reversed(joints)}

    def at(self, readings: Array, T_base_platform: Array) -> Array:
        """States (n, d) closed at readings (n, m), of the assembly that has the platform near poses
        (n, 4, 4); the readings alone decide where it ends.
        """
        drives = np.isin(np.arange(self.key.size), self.actuated)
        x = np.tile(self.key, (len(readings), 1))
        x[:, self.actuated] = readings / self.gear
        # the legs follow the platform; then the loops alone hold it
        return self.closed(self.closed(x, drives, T_base_platform), drives)

    def closed(self, x: Array, held: Booleans, goal: Array | None = None) -> Array:
        """States (n, d) with their loops closed by Gauss-Newton; held : (d,) freedoms that stay.

        goal : (n, 4, 4) poses that the body ``platform`` shall take besides.
        """

        def remainder(x: Array) -> Array:
            gaps = self.gaps(x)
            if goal is None:
                return gaps
            wanted = goal if x.ndim == 2 else goal[:, None]
            off = pose_difference(self.places(x)["platform"], wanted)
            return np.concatenate([gaps, off], axis=-1)

        steps = DIFFERENCE_QUOTIENT_STEP * np.eye(x.shape[-1])[~held]
        for _ in range(MOST_CLOSING_STEPS):
            value = remainder(x)
            by_freedom = (
                remainder(x[:, None] + steps) - value[:, None]
            ).mT / DIFFERENCE_QUOTIENT_STEP
            step = np.linalg.pinv(by_freedom, rcond=DEPENDENT_CONSTRAINT_SHARE) @ value[..., None]
            x = x.copy()
            x[:, ~held] -= step[..., 0]
            if np.abs(step).max() < LOOPS_CLOSED_STEP:
                break
        return x


def body_poses(bodies: Sequence[ReadBody], x: Array) -> list[Array]:
    """Poses (..., 4, 4) of bodies: their joints act one after the other, each in the frame so far;
    a free joint's body stands in the world.
    """
    at: list[Array] = []
    for body in bodies:
        here = at[body.parent] @ body.T_parent_body if at else body.T_parent_body
        for j in body.joints:
            if j.kind == "free":
                here = perturb(here, x[..., j.dof : j.dof + 6])
                continue
            sense = (x[..., j.dof, None] - j.ref) * j.axis
            turns = j.kind == "hinge"
            here = here @ (
                pose(rotation(sense), NO_TRANSLATION) if turns else pose(np.eye(3), sense)
            )
        at.append(here)
    return at
