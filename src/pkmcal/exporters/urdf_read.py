"""Reader of URDF, with its file of loops.

Links and joints have the meaning of URDF's documentation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal
from xml.etree.ElementTree import Element

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.read_model import (
    NO_LIMITS,
    ReadBody,
    ReadCoupling,
    ReadJoint,
    ReadLoop,
    ReadModel,
)
from pkmcal.exporters.xml_read import (
    attribute,
    limits_of,
    numbers,
    refused,
    unit_axis,
    vector,
    xml_root,
)
from pkmcal.files import Schema, parse_yaml, validated_document
from pkmcal.geometry.rigid import from_roll_pitch_yaw, pose

URDF_JOINT_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}


class LoopEntry(Schema):
    """Two links that coincide, in their origins or as poses."""

    name: str
    frames: tuple[str, str]
    coincide: Literal["point", "pose"]


class ReadingEntry(Schema):
    """Joint with a reading; the joint's value is scale * reading."""

    joint: str
    scale: Annotated[float, Field(gt=0)] = 1.0
    home: float


class LoopsDocument(Schema):
    """File of loops; home has the joints' values in a closed state, m and rad."""

    loops: tuple[LoopEntry, ...]
    readings: tuple[ReadingEntry, ...]
    home: dict[str, float]


def read_urdf(text: str, loops: str, loops_name: str = "loops.yaml") -> ReadModel:
    """Model of a URDF text and its file of loops.

    loops_name : name of that file in messages. Raises InputError for what is not read.
    """
    root = xml_root(text)
    beside = validated_document(parse_yaml(loops, Path(loops_name)), LoopsDocument)
    if foreign := [node for node in root.iter() if "}" in node.tag]:
        raise InputError(
            "a xacro file is not read", found=foreign[0].tag, expected="the URDF that it expands to"
        )
    links = {attribute(node, "name"): node for node in root.findall("link")}
    joint_above = {_link(node, "child", links): node for node in root.findall("joint")}
    bodies: list[ReadBody] = []
    numbered: dict[str, int] = {}
    joints: dict[str, ReadJoint] = {}

    def put(link: str, depth: int = 0) -> int:
        """Index of a link's body, added after its parent's if necessary."""
        if link in numbered:
            return numbered[link]
        node = joint_above.get(link)
        if depth > len(links):
            raise refused(links[link], "a link is above itself, and a URDF is a tree")
        if node is None:  # the root
            if bodies:
                raise refused(links[link], "a URDF has one root", f"{bodies[0].name} besides")
            bodies.append(ReadBody(link, 0, np.eye(4), ()))
        else:
            parent, own = put(_link(node, "parent", links), depth + 1), tuple[ReadJoint, ...]()
            if node.get("type") != "fixed":
                own = (_joint(node, len(joints)),)
                joints[own[0].name] = own[0]
            bodies.append(ReadBody(link, parent, _origin_pose(node), own))
        numbered[link] = len(bodies) - 1
        return numbered[link]

    def named(name: str) -> ReadJoint:
        """Joint by name."""
        if name not in joints:
            raise InputError("there is no such joint in the URDF", where=loops_name, found=name)
        return joints[name]

    for link in links:
        put(link)
    # joints that follow others, and the state at home
    couplings: list[ReadCoupling] = []
    for node in root.findall("joint"):
        if (mimic := node.find("mimic")) is not None:
            ratio = float(vector(mimic, "multiplier", "1", 1)[0])
            offset = float(vector(mimic, "offset", "0", 1)[0])
            own, leader = named(attribute(node, "name")), named(attribute(mimic, "joint"))
            couplings.append(ReadCoupling(own.dof, leader.dof, ratio, offset))
    key = np.zeros(len(joints))
    for name, value in beside.home.items():
        key[named(name).dof] = value
    for c in couplings:
        key[c.follower] = c.ratio * key[c.leader] + c.offset
    # named links: each leg's base, and the two ends of each loop
    ends = {f"{leg.name}_base": numbered[rod] for leg in beside.loops
            if (rod := f"{leg.name}_rod") in numbered}  # fmt: skip
    for loop in beside.loops:
        for name in loop.frames:
            if name not in numbered:
                raise InputError("there is no such link in the URDF", where=loops_name, found=name)
            ends[name] = numbered[name]
    radii = {
        node.attrib["name"]: float(vector(cylinder, "radius", "", 1)[0])
        for node in root.iter("visual")
        if "name" in node.attrib and (cylinder := node.find("geometry/cylinder")) is not None
    }
    return ReadModel(
        bodies=tuple(bodies),
        loops=tuple(
            ReadLoop(
                loop.coincide == "pose",
                (ends[loop.frames[0]], ends[loop.frames[1]]),
                (np.eye(4), np.eye(4)),
            )
            for loop in beside.loops
        ),
        couplings=tuple(couplings),
        sites={name: (body, np.zeros(3)) for name, body in ends.items()},
        radii=radii,
        actuated=np.array([named(r.joint).dof for r in beside.readings], dtype=int),
        gear=np.array([1 / r.scale for r in beside.readings]),
        ctrl=np.array([r.home for r in beside.readings]),
        key=key,
    )


def _joint(node: Element, dof: int) -> ReadJoint:
    """Hinge or slide of a joint's element."""
    kind = URDF_JOINT_KINDS.get(node.get("type", ""))
    if kind is None:
        types = ", ".join((*URDF_JOINT_KINDS, "fixed"))
        raise refused(node, "this type of joint is not read", node.get("type"), types)
    part, limit = node.find("axis"), node.find("limit")
    axis = numbers(node, "1 0 0" if part is None else part.get("xyz", "1 0 0"), (3,), "axis")
    limits = NO_LIMITS
    if limit is not None:
        limits = limits_of(limit, limit.get("lower"), limit.get("upper"))
    return ReadJoint(attribute(node, "name"), kind, unit_axis(node, axis), dof, 0.0, limits)


def _link(joint: Element, which: str, links: dict[str, Element]) -> str:
    """Name of a joint's parent or child link."""
    node = joint.find(which)
    name = "" if node is None else node.get("link", "")
    if name not in links:
        raise refused(joint, f"there is no link that is its {which}", name)
    return name


def _origin_pose(node: Element) -> Array:
    """Pose (4, 4) of a joint's origin."""
    origin = node.find("origin")
    if origin is None:
        return np.eye(4)
    return pose(from_roll_pitch_yaw(vector(origin, "rpy", "0 0 0")), vector(origin, "xyz", "0 0 0"))
