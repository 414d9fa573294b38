"""Reader of MJCF, as far as :mod:`pkmcal.exporters.mujoco` uses it.

Bodies, joints and equality constraints have the meaning of MuJoCo's documentation.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from pkmcal.arrays import Array
from pkmcal.exporters.read_model import (
    ReadBody,
    ReadCoupling,
    ReadJoint,
    ReadLoop,
    ReadModel,
    body_poses,
)
from pkmcal.geometry.rigid import from_quaternion, inverse, pose, pose_difference


def read_mujoco(text: str) -> ReadModel:
    """Model of an MJCF text; loops close at home, as MuJoCo's compiler takes them."""
    root = fromstring(text)
    bodies = [ReadBody("world", 0, np.eye(4), ())]
    sites: dict[str, tuple[int, Array]] = {}
    radii: dict[str, float] = {}
    world = root.find("worldbody")
    dofs = 0 if world is None else _collect(world, 0, bodies, 0, sites, radii)
    # state at home: every joint at its reference value
    joints = {j.name: j for body in bodies for j in body.joints}
    drawn = np.zeros(dofs)
    for j in joints.values():
        drawn[j.dof] = j.ref
    at = dict(
        zip((body.name for body in bodies), enumerate(body_poses(bodies, drawn)), strict=True)
    )
    nodes = [node for part in root.findall("equality") for node in part]
    drives = root.findall("actuator/position")
    key = root.find("keyframe/key")
    return ReadModel(
        tuple(bodies),
        tuple(_loop(n, at) for n in nodes if n.tag in ("connect", "weld")),
        tuple(_coupling(n, joints) for n in nodes if n.tag == "joint"),
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
    """Collect all below a body, in the text's order.

    Return the degrees of freedom counted so far.
    """
    for site in node.findall("site"):
        sites[site.attrib["name"]] = (number, _vector(site, "pos"))
    for geom in node.findall("geom"):
        if "name" in geom.attrib:
            radii[geom.attrib["name"]] = float(_vector(geom, "size")[0])
    # depth first, as MuJoCo numbers bodies and joints
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


def _coupling(node: Element, joints: dict[str, ReadJoint]) -> ReadCoupling:
    """Equality of two joints; both values count from home."""
    first, second = (joints[node.attrib[key]] for key in ("joint1", "joint2"))
    ratio = float(_vector(node, "polycoef")[1])
    return ReadCoupling(first.dof, second.dof, ratio, first.ref - ratio * second.ref)


def _loop(node: Element, at: dict[str, tuple[int, Array]]) -> ReadLoop:
    """Loop closure; as in MuJoCo the second body's frame follows from the model at home.

    ``connect``: the anchor is a point of the first body. ``weld``: the second body's origin.
    """
    (first, T1), (second, T2) = at[node.attrib["body1"]], at[node.attrib["body2"]]
    if node.tag == "weld":
        frames = inverse(T1) @ T2, np.eye(4)
    else:
        anchor = pose(np.eye(3), _vector(node, "anchor"))
        frames = anchor, inverse(T2) @ T1 @ anchor
    return ReadLoop(node.tag == "weld", (first, second), frames)


def _of_qpos(bodies: Sequence[ReadBody], drawn: Array, qpos: Array) -> Array:
    """State (d,) of a keyframe.

    ``qpos`` has scalars, and position and quaternion of a free joint.
    """
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


def _vector(node: Element, key: str, default: str = "") -> Array:
    """Numbers of an attribute."""
    return np.array([float(v) for v in node.get(key, default).split()])
