"""A MuJoCo model read again from its text, with kinematics of its own.

MuJoCo itself need not be there for an export, so that what is written is tested by this: bodies,
joints and equality constraints as MuJoCo's documentation of MJCF tells them, as far as
:mod:`pkmcal.export.mujoco_model` uses them. Nothing here knows a machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import (
    apply,
    from_quaternion,
    inverse,
    perturb,
    pose,
    pose_difference,
    rotation,
    rotation_vector,
)

ZERO = np.zeros(3)
STEPS = 30
CLOSED = 1e-13
"""m or rad of a step below which nothing changes any more."""
SMALL = 1e-7
"""m or rad, of the differences that derivatives are taken from: right to as much."""
DEPENDENT = 1e-6
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


class Loop(NamedTuple):
    """Two bodies' frames, moved to where they meet (4, 4) each, that coincide: their points in a
    ``connect``, their orientations as well in a ``weld``.
    """

    kind: str
    bodies: tuple[int, int]
    frames: tuple[Array, Array]


@dataclass(frozen=True)
class ReadModel:
    """What a text says.

    A state x (..., d) has each freedom's value, m or rad: a free joint's are the rotation vector
    from its body's drawn orientation, and the shift. drawn, key : the states as drawn, and in the
    keyframe. couplings : (joint, joint, ratio) by freedoms. sites, radii : points (body, (3,)) and
    cylinders' radii (m) by name. actuated : freedoms of the actuators' joints, in order;
    gear : (m,) what a joint's value is multiplied by for the actuator's; ctrl : (m,) the
    actuators' values in the keyframe.
    """

    bodies: tuple[ReadBody, ...]
    drawn: Array
    loops: tuple[Loop, ...]
    couplings: tuple[tuple[int, int, float], ...]
    sites: dict[str, tuple[int, Array]]
    radii: dict[str, float]
    actuated: Integers
    gear: Array
    ctrl: Array
    key: Array

    def places(self, x: Array) -> dict[str, Array]:
        """Poses (..., 4, 4) of all bodies by name, world frame."""
        names = (body.name for body in self.bodies)
        return dict(zip(names, _placed(self.bodies, x), strict=True))

    def site_places(self, x: Array) -> dict[str, Array]:
        """Where the named points are, (..., 3) m, world frame."""
        at = _placed(self.bodies, x)
        return {name: apply(at[body], point) for name, (body, point) in self.sites.items()}

    def gaps(self, x: Array) -> Array:
        """What is left of the equality constraints (..., E), m and rad."""
        at, out = _placed(self.bodies, x), list[Array]()
        for loop in self.loops:
            first, second = (at[k] @ T for k, T in zip(loop.bodies, loop.frames, strict=True))
            out.append(first[..., :3, 3] - second[..., :3, 3])
            if loop.kind == "weld":
                turn = first[..., :3, :3] @ second[..., :3, :3].mT
                out.append(rotation_vector(turn))
        away = x - self.drawn
        for first, second, ratio in self.couplings:
            out.append((away[..., first] - ratio * away[..., second])[..., None])
        return np.concatenate(out, axis=-1)

    def closed(self, x: Array, held: Booleans, goal: Array | None = None) -> Array:
        """States (n, d) with their loops closed by Gauss-Newton; held : (d,) freedoms that stay.

        goal : (n, 4, 4) poses that the body ``platform`` shall take besides.
        """

        def left(x: Array) -> Array:
            gaps = self.gaps(x)
            if goal is None:
                return gaps
            wanted = goal if x.ndim == 2 else goal[:, None]
            off = pose_difference(self.places(x)["platform"], wanted)
            return np.concatenate([gaps, off], axis=-1)

        steps = SMALL * np.eye(x.shape[-1])[~held]
        for _ in range(STEPS):
            value = left(x)
            by_freedom = (left(x[:, None] + steps) - value[:, None]).mT / SMALL
            step = np.linalg.pinv(by_freedom, rcond=DEPENDENT) @ value[..., None]
            x = x.copy()
            x[:, ~held] -= step[..., 0]
            if np.abs(step).max() < CLOSED:
                break
        return x


def read(text: str) -> ReadModel:
    """The model of a text, with loops closed as MuJoCo's compiler closes them: as drawn."""
    root = fromstring(text)
    bodies = [ReadBody("world", 0, np.eye(4), ())]
    sites: dict[str, tuple[int, Array]] = {}
    radii: dict[str, float] = {}
    world = root.find("worldbody")
    dofs = 0 if world is None else _collect(world, 0, bodies, 0, sites, radii)
    joints = {j.name: j for body in bodies for j in body.joints}
    drawn = np.zeros(dofs)
    for j in joints.values():
        drawn[j.dof] = j.ref
    at = dict(zip((body.name for body in bodies), enumerate(_placed(bodies, drawn)), strict=True))
    nodes = [node for part in root.findall("equality") for node in part]
    drives = root.findall("actuator/position")
    key = root.find("keyframe/key")
    return ReadModel(
        tuple(bodies),
        drawn,
        tuple(_loop(n, at) for n in nodes if n.tag in ("connect", "weld")),
        tuple(
            (
                joints[n.attrib["joint1"]].dof,
                joints[n.attrib["joint2"]].dof,
                float(_vector(n, "polycoef")[1]),
            )
            for n in nodes
            if n.tag == "joint"
        ),
        sites,
        radii,
        np.array([joints[n.attrib["joint"]].dof for n in drives], dtype=int),
        np.array([_vector(n, "gear", "1")[0] for n in drives]),
        np.zeros(0) if key is None else _vector(key, "ctrl"),
        drawn if key is None else _of_qpos(bodies, drawn, _vector(key, "qpos")),
    )


def _collect(
    node: Element,
    number: int,
    bodies: list[ReadBody],
    dofs: int,
    sites: dict[str, tuple[int, Array]],
    radii: dict[str, float],
) -> int:
    """Everything below a body, in the text's order; returns the freedoms counted so far."""
    for site in node.findall("site"):
        sites[site.attrib["name"]] = (number, _vector(site, "pos"))
    for geom in node.findall("geom"):
        if "name" in geom.attrib:
            radii[geom.attrib["name"]] = float(_vector(geom, "size")[0])
    for child in node.findall("body"):
        me, joints = len(bodies), list[ReadJoint]()
        for j in child:
            if j.tag in ("joint", "freejoint"):
                kind = "free" if j.tag == "freejoint" else j.attrib["type"]
                axis = _vector(j, "axis", "0 0 1")
                axis = axis / np.linalg.norm(axis)
                ref = float(j.get("ref", "0"))
                joints.append(ReadJoint(j.attrib["name"], kind, axis, dofs, ref))
                dofs += 6 if kind == "free" else 1
        turn = from_quaternion(_vector(child, "quat", "1 0 0 0"))
        place = pose(turn, _vector(child, "pos", "0 0 0"))
        bodies.append(ReadBody(child.attrib["name"], number, place, tuple(joints)))
        dofs = _collect(child, me, bodies, dofs, sites, radii)
    return dofs


def _loop(node: Element, at: dict[str, tuple[int, Array]]) -> Loop:
    """A closure; the second body's share is taken from the model as drawn, as MuJoCo does.

    ``connect``: its anchor is a point of the first body. ``weld``: the second body's origin.
    """
    (first, T1), (second, T2) = at[node.attrib["body1"]], at[node.attrib["body2"]]
    if node.tag == "weld":
        frames = inverse(T1) @ T2, np.eye(4)
    else:
        anchor = pose(np.eye(3), _vector(node, "anchor"))
        frames = anchor, inverse(T2) @ T1 @ anchor
    return Loop(node.tag, (first, second), frames)


def _of_qpos(bodies: Sequence[ReadBody], drawn: Array, qpos: Array) -> Array:
    """The state (d,) of a keyframe: scalars, and of a free joint its place and quaternion."""
    x, at = drawn.copy(), 0
    for body in bodies:
        for j in body.joints:
            if j.kind == "free":
                here = pose(from_quaternion(qpos[at + 3 : at + 7]), qpos[at : at + 3])
                x[j.dof : j.dof + 6] = pose_difference(here, body.T_parent_body)
                at += 7
            else:
                x[j.dof] = qpos[at]
                at += 1
    return x


def _placed(bodies: Sequence[ReadBody], x: Array) -> list[Array]:
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
            way = (x[..., j.dof, None] - j.ref) * j.axis
            turns = j.kind == "hinge"
            here = here @ (pose(rotation(way), ZERO) if turns else pose(np.eye(3), way))
        at.append(here)
    return at


def _vector(node: Element, key: str, default: str = "") -> Array:
    return np.array([float(v) for v in node.get(key, default).split()])
