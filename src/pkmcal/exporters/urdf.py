"""URDF: the machine's bodies as a tree, with a second file for the loops."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, final
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import yaml

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.exporters.agreement import differences
from pkmcal.exporters.bodies import (
    BODY_COLOURS,
    NOT_WEIGHED,
    BodyJoint,
    BodyTree,
    Loop,
    RoundBar,
    TreeBody,
    body_tree,
    without_masses,
)
from pkmcal.exporters.contract import Difference, Exporter, commented
from pkmcal.exporters.markup import comment, document, file_name, numbers_text
from pkmcal.exporters.urdf_read import read_urdf
from pkmcal.geometry.rigid import pose, roll_pitch_yaw, rotation
from pkmcal.outcome.finding import Finding, doubtful

JOINT_LIMIT_ROD_LENGTHS = 2.0
"""Limits that URDF demands where none are known, in mean rod lengths to either side of home."""
POSE_JOINTS = ("x", "y", "z", "yaw", "pitch", "roll")
CONVENTIONS = (
    "Units: m, rad. The link 'base' has the machine's base frame, the link 'platform' the platform"
    " frame.",
    "Joints leg1, leg2, … (motor1, … where a motor moves several rods) have scale * reading: a"
    " rod's length is that + offset, a crank's angle that + angle.",
    "NOT IN HERE: THE LOOPS. A URDF is a tree, so no leg is fastened to the platform. The machine"
    " is closed where each leg's links legN_tip and legN_platform coincide; which of them do so in"
    " their origins alone, and the values of all joints at home, stand in {loops}. Joint values"
    " have to come from a closed machine: nothing in this file holds them together.",
    "NO PARTS OF THE MACHINE: the joints platform_x and so on, by which the tree holds the"
    " platform. {pose}",
    f"{NOT_WEIGHED}; no link has any, so this file"
    " is for kinematics and pictures. URDF demands limits: an effort and a velocity of 0 stand for"
    " not known, and slides without a range have {reach:g} of the rods' mean lengths to either side"
    " of home.",
)
FREE_PLATFORM_WORDS = (
    "Their values are its pose: T_base_platform = Trans(platform_x, platform_y, platform_z)"
    " Rz(platform_yaw) Ry(platform_pitch) Rx(platform_roll)."
)
RESTRICTED_PLATFORM_WORDS = (
    "They leave it the machine's motion; what holds it so in the machine is not drawn."
)
LOOPS_FILE_WORDS = (
    "Loops that the URDF beside this cannot hold. frames: the origins of these two links coincide,"
    " or, where coincide is pose, their axes as well.",
    "readings: the joint's value is scale * reading. home: all joints' values where the machine is"
    " closed, m and rad; joints that mimic others are left out.",
)


@final
class UrdfExporter(Exporter):
    """``<name>.urdf``, and ``<name>.loops.yaml``."""

    name: ClassVar = "urdf"
    title: ClassVar = "URDF (a tree), and the loops that it cannot hold"
    holds_joint_offsets: ClassVar = True

    def files(self, source: MachineSource) -> dict[str, str]:
        """Texts of the tree and of its loops."""
        tree, (name, loops) = body_tree(source.machine), _file_names(source)
        return {name: _urdf(tree, source, loops), loops: _loops(tree, source)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences of the model that the text's links and joints and the loops describe."""
        tree, loops = files.values()
        return differences(read_urdf(tree, loops), source.machine)

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Warning that the tree lacks the loops, and note on missing masses."""
        tree, loops = _file_names(source)
        return (
            doubtful("export.urdf_tree", tree, loops=loops),
            without_masses("urdf"),
        )


def _file_names(source: MachineSource) -> tuple[str, str]:
    """Names of the two files."""
    name = file_name(source.machine.name)
    return f"{name}.urdf", f"{name}.loops.yaml"


def _urdf(tree: BodyTree, source: MachineSource, loops: str) -> str:
    """URDF text."""
    root = Element("robot", name=file_name(source.machine.name))
    for style, rgba in BODY_COLOURS.items():
        SubElement(SubElement(root, "material", name=style), "color", rgba=rgba)
    for body in tree.bodies:
        if body.comment:
            comment(root, body.comment)
        last = "" if body.parent is None else body.parent.name
        for link, joint, origin in _steps(body):
            _joint(root, joint, (last, link), origin, tree)
            last = link
            if link != body.name:
                SubElement(root, "link", name=link)
        node = SubElement(root, "link", name=body.name)
        for shape in body.shapes:
            _visual(node, shape)
    for loop in tree.loops:
        _ends(root, loop, tree)
    words = {
        "loops": loops,
        "pose": FREE_PLATFORM_WORDS if tree.platform.free else RESTRICTED_PLATFORM_WORDS,
        "reach": JOINT_LIMIT_ROD_LENGTHS,
    }
    return document(root, source, [line.format(**words) for line in CONVENTIONS])


def _steps(body: TreeBody) -> Iterator[tuple[str, BodyJoint | None, Array]]:
    """Joints in series that lead to a body: link after the joint, joint, and pose (4, 4) before it.

    The pose is in the preceding link's frame at value zero, from which URDF counts. A fixed link
    has None for the joint.
    """
    if body.parent is None:
        return
    joints, origin = list(body.joints), body.T_parent_body
    if body.free:  # the joints' values are the components of the pose in the base frame
        axes = np.eye(3)[[0, 1, 2, 2, 1, 0]]
        values = [*body.T_parent_body[:3, 3], *roll_pitch_yaw(body.T_parent_body[:3, :3])[::-1]]
        joints = [
            BodyJoint(f"platform_{name}", "slide" if name in "xyz" else "hinge", axis, float(value))
            for name, axis, value in zip(POSE_JOINTS, axes, values, strict=True)
        ]
    if not joints:
        yield body.name, None, origin
    for k, joint in enumerate(joints):
        back = -joint.value * joint.axis
        hinge = joint.kind == "hinge"
        zero = pose(rotation(back), np.zeros(3)) if hinge else pose(np.eye(3), back)
        link = body.name if k == len(joints) - 1 else f"{joint.name}_link"
        yield link, joint, np.eye(4) if body.free else origin @ zero
        origin = np.eye(4)


def _joint(
    root: Element, joint: BodyJoint | None, links: tuple[str, str], T: Array, tree: BodyTree
) -> None:
    """Add a joint between two links, fixed if ``joint`` is None."""
    limits = _limits(joint, tree)
    kind = "fixed"
    if joint is not None:
        turns = "continuous" if limits is None else "revolute"
        kind = "prismatic" if joint.kind == "slide" else turns
    name = f"{links[1]}_fixed" if joint is None else joint.name
    out = SubElement(root, "joint", name=name, type=kind)
    SubElement(
        out, "origin", xyz=numbers_text(T[:3, 3]), rpy=numbers_text(roll_pitch_yaw(T[:3, :3]))
    )
    SubElement(out, "parent", link=links[0])
    SubElement(out, "child", link=links[1])
    if joint is not None:
        SubElement(out, "axis", xyz=numbers_text(joint.axis))
    if limits is not None:
        low, high = (numbers_text(limit) for limit in limits)
        SubElement(out, "limit", lower=low, upper=high, effort="0", velocity="0")
    for coupling in tree.couplings:
        if joint is not None and coupling.follower == joint.name:
            values = {j.name: j.value for body in tree.bodies for j in body.joints}
            offset = numbers_text(values[coupling.follower] + values[coupling.leader])
            SubElement(out, "mimic", joint=coupling.leader, multiplier="-1", offset=offset)


def _limits(joint: BodyJoint | None, tree: BodyTree) -> Array | None:
    """Limits (2,) of a joint, m or rad; None for hinges without a range.

    From the mechanism file's range; a slide without one gets wide limits that it does not reach.
    """
    if joint is None:
        return None
    if joint.column >= 0:
        finite = tree.home.values(joint.column)[1:]
        if np.isfinite(finite).all():
            return np.sort(finite)
    if joint.kind == "slide":
        return joint.value + JOINT_LIMIT_ROD_LENGTHS * tree.home.size * np.array([-1.0, 1.0])
    return None


def _ends(root: Element, loop: Loop, tree: BodyTree) -> None:
    """Add the two links that coincide where a leg closes, after the loop joint's own hinges."""
    at = pose(np.eye(3), loop.end)
    last = loop.tip.name
    how = ", axes as well" if loop.hinges else " in their origins: a ball"
    comment(root, f"Loop: {loop.name}_tip and {loop.name}_platform coincide{how}.")
    for kind, axis in loop.hinges:
        name = f"{loop.name}_{kind}"
        _joint(root, BodyJoint(name, "hinge", axis), (last, f"{name}_link"), at, tree)
        SubElement(root, "link", name=f"{name}_link")
        last, at = f"{name}_link", np.eye(4)
    turned = loop.held.T_base_body[:3, :3].T if loop.hinges else np.eye(3)
    for end, body, T in (
        ("tip", last, at),
        ("platform", loop.held.name, pose(turned, loop.point)),
    ):
        name = f"{loop.name}_{end}"
        _joint(root, None, (body, name), T, tree)
        SubElement(root, "link", name=name)


def _visual(link: Element, shape: RoundBar) -> None:
    """Add a link's shape; cylinders are along their own z."""
    if shape.flat:
        return
    out = SubElement(link, "visual")
    if shape.name:
        out.set("name", shape.name)
    middle, length, turned = shape.drawn
    SubElement(out, "origin", xyz=numbers_text(middle), rpy=numbers_text(turned))
    geometry, radius = SubElement(out, "geometry"), numbers_text(shape.radius)
    if shape.stop is None:
        SubElement(geometry, "sphere", radius=radius)
    else:
        SubElement(geometry, "cylinder", radius=radius, length=numbers_text(length))
    SubElement(out, "material", name=shape.colour)


def _loops(tree: BodyTree, source: MachineSource) -> str:
    """Text of the loops, the readings, and the joints' values at home."""
    home = tree.home
    following = {coupling.follower for coupling in tree.couplings}
    joints = [joint for body in tree.bodies for _, joint, _ in _steps(body) if joint is not None]
    hinges = {f"{loop.name}_{kind}": 0.0 for loop in tree.loops for kind, _ in loop.hinges}
    values = {j.name: j.value for j in joints if j.name not in following} | hinges
    document: dict[str, Any] = {
        "loops": [
            {
                "name": loop.name,
                "frames": [f"{loop.name}_platform", f"{loop.name}_tip"],
                "coincide": "pose" if loop.hinges else "point",
            }
            for loop in tree.loops
        ],
        "readings": [
            {"joint": home.reading_name(k), "scale": home.scale(k), "home": float(reading)}
            for k, reading in enumerate(home.readings)
        ],
        "home": values,
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=96)
    return commented(source.header(*LOOPS_FILE_WORDS), "#") + text
