"""Reader of URDF, with its file of loops.

Links and joints have the meaning of URDF's documentation.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Annotated, Literal
from xml.etree.ElementTree import Element

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.read_model import (
    BASE_CROSS,
    NO_LIMITS,
    ReadBody,
    ReadCoupling,
    ReadCylinder,
    ReadJoint,
    ReadLoop,
    ReadModel,
)
from pkmcal.exporters.xml_read import (
    attribute,
    by_name,
    limits_of,
    numbers,
    refused,
    unit_axis,
    vector,
    xml_root,
)
from pkmcal.files import Schema, parse_yaml, validated_document
from pkmcal.geometry.rigid import apply, from_roll_pitch_yaw, pose

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
    tree = _Tree(root, loops_name)
    couplings: list[ReadCoupling] = []
    for node in root.findall("joint"):
        if (mimic := node.find("mimic")) is not None:
            ratio = float(vector(mimic, "multiplier", "1", 1)[0])
            offset = float(vector(mimic, "offset", "0", 1)[0])
            follower, leader = attribute(node, "name"), attribute(mimic, "joint")
            couplings.append(
                ReadCoupling(tree.joint(follower).dof, tree.joint(leader).dof, ratio, offset)
            )
    # the state at home
    key = np.zeros(len(tree.joints))
    for name, value in beside.home.items():
        key[tree.joint(name).dof] = value
    for c in couplings:
        key[c.follower] = c.ratio * key[c.leader] + c.offset
    # named links: the two ends of each loop, and each leg's base
    ends = {name: tree.link(name) for loop in beside.loops for name in loop.frames}
    firsts = product(beside.loops, ("_rod", BASE_CROSS))  # a joint's own cross precedes the rod
    rods = ((f"{loop.name}_base", f"{loop.name}{ending}") for loop, ending in firsts)
    sites = ends | {name: tree.numbers[rod] for name, rod in rods if rod in tree.numbers}
    return ReadModel(
        bodies=tuple(tree.bodies),
        loops=tuple(
            ReadLoop(
                loop.coincide == "pose",
                (ends[loop.frames[0]], ends[loop.frames[1]]),
                (np.eye(4), np.eye(4)),
            )
            for loop in beside.loops
        ),
        couplings=tuple(couplings),
        sites={name: (body, np.zeros(3)) for name, body in sites.items()},
        cylinders=tuple(
            _cylinder(visual, cylinder, tree.numbers[name])
            for name, link in tree.links.items()
            for visual in link.findall("visual")
            if (cylinder := visual.find("geometry/cylinder")) is not None
        ),
        actuated=np.array([tree.joint(r.joint).dof for r in beside.readings], dtype=int),
        gear=np.array([1 / r.scale for r in beside.readings]),
        ctrl=np.array([r.home for r in beside.readings]),
        key=key,
    )


class _Tree:
    """Links as bodies, each added after its parent.

    numbers : index of each link's body. joints : by name.
    """

    def __init__(self, root: Element, loops_name: str) -> None:
        self.loops_name = loops_name
        self.links = by_name(root.findall("link"))
        self.above: dict[str, Element] = {}
        for node in by_name(root.findall("joint")).values():
            if self._end(node, "child") in self.above:
                raise refused(node, "a link has two joints above it", self._end(node, "child"))
            self.above[self._end(node, "child")] = node
        self.bodies: list[ReadBody] = []
        self.numbers: dict[str, int] = {}
        self.joints: dict[str, ReadJoint] = {}
        for link in self.links:
            self._put(link)

    def link(self, name: str) -> int:
        """Index of the body of a link that the file of loops names."""
        if name not in self.numbers:
            raise InputError("there is no such link in the URDF", where=self.loops_name, found=name)
        return self.numbers[name]

    def joint(self, name: str) -> ReadJoint:
        """Joint that a mimic or the file of loops names."""
        if name not in self.joints:
            raise InputError(
                "there is no such joint in the URDF", where=self.loops_name, found=name
            )
        return self.joints[name]

    def _end(self, joint: Element, which: str) -> str:
        """Name of a joint's parent or child link."""
        node = joint.find(which)
        name = "" if node is None else node.get("link", "")
        if name not in self.links:
            raise refused(joint, f"there is no link that is its {which}", name)
        return name

    def _put(self, link: str, depth: int = 0) -> int:
        """Index of a link's body, added after its parent's if necessary."""
        if link in self.numbers:
            return self.numbers[link]
        node = self.above.get(link)
        if depth > len(self.links):
            raise refused(self.links[link], "a link is above itself, and a URDF is a tree")
        if node is None:  # the root
            if self.bodies:
                raise refused(
                    self.links[link], "a URDF has one root", f"{self.bodies[0].name} besides"
                )
            self.bodies.append(ReadBody(link, 0, np.eye(4), ()))
        else:
            parent, own = self._put(self._end(node, "parent"), depth + 1), tuple[ReadJoint, ...]()
            if node.get("type") != "fixed":
                own = (_joint(node, len(self.joints)),)
                self.joints[own[0].name] = own[0]
            self.bodies.append(ReadBody(link, parent, _origin_pose(node), own))
        self.numbers[link] = len(self.bodies) - 1
        return self.numbers[link]


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


def _cylinder(visual: Element, cylinder: Element, body: int) -> ReadCylinder:
    """Cylinder along z of a visual's origin."""
    half = float(vector(cylinder, "length", "", 1)[0]) / 2
    ends = apply(_origin_pose(visual), np.array([[0, 0, -half], [0, 0, half]]))
    radius = float(vector(cylinder, "radius", "", 1)[0])
    return ReadCylinder(visual.get("name", ""), body, ends, radius)


def _origin_pose(node: Element) -> Array:
    """Pose (4, 4) of a joint's origin."""
    origin = node.find("origin")
    if origin is None:
        return np.eye(4)
    return pose(from_roll_pitch_yaw(vector(origin, "rpy", "0 0 0")), vector(origin, "xyz", "0 0 0"))
