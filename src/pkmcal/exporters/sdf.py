"""SDF model: the machine's bodies, with loops as joints between links of two branches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, final
from xml.etree.ElementTree import Element, SubElement

import numpy as np

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
from pkmcal.exporters.contract import Difference, Exporter
from pkmcal.exporters.home import SAME_HINGE_DIFFERENCE
from pkmcal.exporters.markup import comment, document, file_name, numbers_text
from pkmcal.exporters.sdf_read import SDF_MODEL_FRAME, SDF_NAMESPACE, read_sdf
from pkmcal.geometry.rigid import pose, roll_pitch_yaw
from pkmcal.outcome.finding import Finding, doubtful

SDF_VERSION, SDF_MIMIC_VERSION = "1.7", "1.11"
"""Lowest versions that have the features used, since readers refuse newer ones than their own.

1.7 is the first with named frames (``relative_to``, ``attached_to``, ``expressed_in``), 1.11 the
first with joints that follow others (``mimic``).
"""
CONVENTIONS = (
    "Units: m, rad. The model's frame is the machine's base frame, the link 'platform' has the"
    " platform frame; its pose is T_base_platform at home, where all is drawn.",
    "Joints count from home. Of those that a motor moves, leg1, leg2, … (motor1, … where it moves"
    " several rods), the value is scale * (reading - home): the elements pkmcal:reading have both"
    " numbers, which SDF has no word for. All other joints have an effort of 0: no motor.",
    "Joints legN_loop close the loops, as SDF has them: joints between links of two branches, drawn"
    " closed. Not every program that reads SDF closes them: see docs/export.md.",
    f"{NOT_WEIGHED}. Where SDF finds none it takes"
    " 1 kg and 1 kg m2 for each link, which is not this machine's: the model is for kinematics, and"
    " gravity is off.",
)


@final
class SdfExporter(Exporter):
    """One file, ``<name>.sdf``."""

    name: ClassVar = "sdf"
    title: ClassVar = "SDF model with closed loops"
    holds_joint_offsets: ClassVar = True

    def files(self, source: MachineSource) -> dict[str, str]:
        """SDF text."""
        name = file_name(source.machine.name)
        return {f"{name}.sdf": _sdf(body_tree(source.machine), source, name)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences of the model that the text's links and joints describe."""
        return differences(read_sdf(next(iter(files.values()))), source.machine)

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Warning of readers that do not close loops, and note on missing masses."""
        del source
        return (
            doubtful("export.sdf_loops"),
            without_masses("sdf"),
        )


def _sdf(tree: BodyTree, source: MachineSource, name: str) -> str:
    """SDF text."""
    version = SDF_MIMIC_VERSION if tree.couplings else SDF_VERSION
    root = Element("sdf", {"version": version, "xmlns:pkmcal": SDF_NAMESPACE})
    model = SubElement(root, "model", name=name)
    for k, reading in enumerate(tree.home.readings):
        attributes = {"joint": tree.home.reading_name(k), "home": numbers_text(reading)}
        SubElement(model, "pkmcal:reading", attributes, scale=numbers_text(tree.home.scale(k)))
    for body in tree.bodies:
        if body.comment:
            comment(model, body.comment)
        _chain(model, body, tree)
        node = SubElement(model, "link", name=body.name)
        if body.parent is not None:
            _pose(node, body.T_parent_body, body.parent.name)
        SubElement(node, "gravity").text = "false"
        for k, shape in enumerate(body.shapes):
            _visual(node, shape, shape.name or f"shape{k + 1}")
        for point, place in body.points.items():
            if not point.endswith("_base"):  # origin of a rod's own frame
                frame = SubElement(model, "frame", {"name": point, "attached_to": body.name})
                _pose(frame, pose(np.eye(3), place))
    for loop in tree.loops:
        _loop(model, loop)
    return document(root, source, CONVENTIONS)


def _chain(model: Element, body: TreeBody, tree: BodyTree) -> None:
    """Add the joints that lead to a body, with a massless link between two of them."""
    if body.parent is None:
        _joint(model, "base_fixed", ("world", body.name), "fixed")
        return
    # a free body has no joint; loops hold it
    if body.free:
        return
    last = body.parent.name
    steps = list(_steps(body.joints))
    if not steps:
        _joint(model, f"{body.name}_fixed", (last, body.name), "fixed")
    # all joints but the last lead to a massless link
    for k, joints in enumerate(steps):
        own = joints[0].name.removesuffix("_first")
        link = body.name if k == len(steps) - 1 else f"{own}_link"
        kind = "prismatic" if joints[0].kind == "slide" else "revolute"
        out = _joint(model, own, (last, link), kind if len(joints) == 1 else "universal")
        for tag, joint in zip(("axis", "axis2"), joints, strict=False):
            _axis(out, tag, joint, tree)
        if link != body.name:
            between = SubElement(model, "link", name=link)
            _pose(between, body.T_parent_body, body.parent.name)
            SubElement(between, "gravity").text = "false"
        last = link


def _steps(joints: list[BodyJoint]) -> Iterator[tuple[BodyJoint, ...]]:
    """Joints in series; two consecutive perpendicular hinges form a universal joint."""
    k = 0
    while k < len(joints):
        pair = tuple(joints[k : k + 2])
        turns = [joint.kind == "hinge" for joint in pair]
        square = (
            turns == [True, True]
            and abs(float(pair[0].axis @ pair[1].axis)) < SAME_HINGE_DIFFERENCE
        )
        yield pair if square else pair[:1]
        k += 2 if square else 1


def _joint(model: Element, name: str, links: tuple[str, str], kind: str) -> Element:
    """Add a joint between two links."""
    out = SubElement(model, "joint", name=name, type=kind)
    SubElement(out, "parent").text, SubElement(out, "child").text = links
    return out


def _axis(parent: Element, tag: str, joint: BodyJoint, tree: BodyTree) -> None:
    """Add a joint's axis in the joint's frame, with limits and coupling."""
    out = SubElement(parent, tag)
    SubElement(out, "xyz").text = numbers_text(joint.axis)
    limit = SubElement(out, "limit")
    if joint.column < 0:
        SubElement(limit, "effort").text = "0"  # without a limit readers assume a motor
    else:
        limits = np.sort(tree.home.values(joint.column)[1:] - joint.value)
        for end, value in zip(("lower", "upper"), limits, strict=True):
            if np.isfinite(value):
                SubElement(limit, end).text = numbers_text(value)
    for coupling in tree.couplings:
        if coupling.follower == joint.name:
            mimic = SubElement(out, "mimic", joint=coupling.leader, axis="axis")
            for word, value in (("multiplier", "-1"), ("offset", "0"), ("reference", "0")):
                SubElement(mimic, word).text = value


def _loop(model: Element, loop: Loop) -> None:
    """Add the joint that closes a leg: a ball joint, or one with the leg's end hinges."""
    kind = ("ball", "revolute", "universal")[len(loop.hinges)]
    out = _joint(model, f"{loop.name}_loop", (loop.tip.name, loop.held.name), kind)
    _pose(out, np.eye(4), f"{loop.name}_platform")
    for tag, (_, axis) in zip(("axis", "axis2"), loop.hinges, strict=False):
        node = SubElement(out, tag)
        SubElement(node, "xyz", expressed_in=SDF_MODEL_FRAME).text = numbers_text(axis)
        SubElement(SubElement(node, "limit"), "effort").text = "0"


def _pose(parent: Element, T: Array, relative_to: str = "") -> None:
    """Add a pose."""
    out = SubElement(parent, "pose")
    if relative_to:
        out.set("relative_to", relative_to)
    out.text = numbers_text(T[:3, 3], roll_pitch_yaw(T[:3, :3]))


def _visual(link: Element, shape: RoundBar, name: str) -> None:
    """Add a link's shape; cylinders are along their own z."""
    if shape.flat:
        return
    out = SubElement(link, "visual", name=name)
    middle, length, turned = shape.drawn
    SubElement(out, "pose").text = numbers_text(middle, turned)
    geometry = SubElement(out, "geometry")
    form = SubElement(geometry, "sphere" if shape.stop is None else "cylinder")
    SubElement(form, "radius").text = numbers_text(shape.radius)
    if shape.stop is not None:
        SubElement(form, "length").text = numbers_text(length)
    material = SubElement(out, "material")
    for light in ("ambient", "diffuse"):
        SubElement(material, light).text = BODY_COLOURS[shape.colour]
