"""Reader of SDF: links, frames and joints, with the meaning of the specification."""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.read_model import (
    BASE_CROSS,
    JOINT_BODY,
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
    label_of,
    limits_of,
    numbers,
    refused,
    unit_axis,
    xml_root,
)
from pkmcal.geometry.rigid import apply, from_roll_pitch_yaw, inverse, pose

SDF_NAMESPACE = "urn:pkmcal"
SDF_MODEL_FRAME, SDF_WORLD_FRAME = "__model__", "world"
SDF_JOINT_AXES = {
    "revolute": ("axis",),
    "continuous": ("axis",),
    "prismatic": ("axis",),
    "universal": ("axis", "axis2"),
    "revolute2": ("axis", "axis2"),
    "ball": (),
    "fixed": (),
}
LOOP_JOINT_ENDING = "_loop"
MOST_FRAMES_IN_SERIES = 100
MODEL_AXES_BEFORE = (1, 5)
"""Version up to which axes are in the model's frame instead of the joint's."""
SAME_FRAME = 1e-15


def read_sdf(text: str) -> ReadModel:
    """Model of an SDF text.

    Joints named ``…_loop``, and further joints of a link that has one, are the loop closures.
    Raises InputError for what is not read.
    """
    root = xml_root(text)
    models = [node for node in root.iter("model") if node.find("joint") is not None]
    if len(models) != 1:
        raise InputError(
            "the file does not have one model with joints",
            found=f"{len(models)} models with joints",
            expected="one",
        )
    model = models[0]
    for name in ("include", "model"):
        if (node := model.find(name)) is not None:
            raise refused(node, f"<{name}> inside a model is not read", expected="its links")
    # links as bodies along the tree, then loops between them
    words = root.get("version", "").split(".")
    if root.tag != "sdf" or not all(word.isdecimal() and len(word) < 4 for word in words):
        raise InputError("this is no SDF", where=label_of(root), expected='<sdf version="1.7">')
    tree = _Links(model, tuple(map(int, words)))
    for link in tree.links:
        tree.put(link)
    loops = [tree.loop(name) for name in tree.joints if name in tree.closing]
    sites = {
        name: (tree.numbers[node.attrib["attached_to"]], tree.own_pose(node)[:3, 3])
        for name, node in tree.frames.items()
        if node.get("attached_to") in tree.numbers
    }
    # a rod's origin is its base joint, or that of the joint's own cross, if its axes do not meet
    for link in sorted(tree.links, key=lambda name: name.endswith(BASE_CROSS)):
        for ending in ("_rod", BASE_CROSS):
            if link.endswith(ending):
                sites[f"{link.removesuffix(ending)}_base"] = (tree.numbers[link], np.zeros(3))
    return ReadModel(
        bodies=tuple(tree.bodies),
        loops=tuple(loops),
        couplings=tuple(
            ReadCoupling(
                tree.joint(name, node).dof,
                tree.joint(attribute(mimic, "joint"), mimic).dof,
                *_ratio_and_offset(mimic),
            )
            for name, node in tree.joints.items()
            if (mimic := node.find("axis/mimic")) is not None
        ),
        sites=sites,
        cylinders=tuple(
            tree.cylinder(visual, cylinder, link)
            for link, node in tree.links.items()
            for visual in node.findall("visual")
            for kind in ("cylinder", "capsule")
            if (cylinder := visual.find(f"geometry/{kind}")) is not None
        ),
        actuated=np.array([tree.joint(n, model).dof for n in tree.readings], dtype=int),
        gear=np.array([1 / float(values["scale"]) for values in tree.readings.values()]),
        ctrl=np.array([float(values["home"]) for values in tree.readings.values()]),
        key=np.array(tree.key),
    )


class _Links:
    """Links of a model as bodies, each added after its parent.

    above : joint above each link.
    closing : names of the joints that close loops.
    numbers : index of each link's body.
    joints_by_name : joints, of several axes the first.
    key : state at home.
    """

    def __init__(self, model: Element, version: tuple[int, ...]) -> None:
        self.version = version
        self.links = by_name(model.findall("link"))
        self.frames = by_name(model.findall("frame"))
        self.joints = by_name(model.findall("joint"))
        self.readings = {
            attribute(node, "joint"): {
                key: str(numbers(node, attribute(node, key), (1,), key)[0])
                for key in ("scale", "home")
            }
            for node in model.findall(f"{{{SDF_NAMESPACE}}}reading")
        }
        self.above: dict[str, str] = {}
        self.closing = {name for name in self.joints if name.endswith(LOOP_JOINT_ENDING)}
        for name, node in self.joints.items():
            if node.get("type") not in SDF_JOINT_AXES:
                raise refused(
                    node, "this type of joint is not read", node.get("type"),
                    ", ".join(SDF_JOINT_AXES),
                )  # fmt: skip
            parent, child = (self._end(node, which) for which in ("parent", "child"))
            # a second joint of a link, or one above its own parent, closes a loop
            if name not in self.closing:
                if child in self.above or self._is_above(child, parent):
                    self.closing.add(name)
                else:
                    self.above[child] = name
        self.bodies = [ReadBody(SDF_WORLD_FRAME, 0, np.eye(4), ())]
        self.numbers = {SDF_WORLD_FRAME: 0}
        self.joints_by_name: dict[str, ReadJoint] = {}
        self.key: list[float] = []

    def _end(self, joint: Element, which: str) -> str:
        """Name of the link that is a joint's parent or child."""
        name = joint.findtext(which, "").strip()
        if name not in self.links and name != SDF_WORLD_FRAME:
            raise refused(joint, f"there is no link that is its {which}", name)
        return name

    def _is_above(self, link: str, other: str) -> bool:
        """Whether a link is the other one, or above it in the tree."""
        while other != link and other in self.above:
            other = self._end(self.joints[self.above[other]], "parent")
        return other == link or link == SDF_WORLD_FRAME

    def joint(self, name: str, node: Element) -> ReadJoint:
        """First axis of a joint; node : the element that names it."""
        if name not in self.joints_by_name:
            raise refused(node, "there is no such joint with an axis", name)
        return self.joints_by_name[name]

    def drawn(self, name: str, depth: int = 0) -> Array:
        """Pose (4, 4) of a link, frame or joint at home, model frame."""
        if name in ("", SDF_MODEL_FRAME, SDF_WORLD_FRAME):
            return np.eye(4)
        nodes = (self.frames, self.links, self.joints)
        node = next((group[name] for group in nodes if name in group), None)
        if node is None or depth > MOST_FRAMES_IN_SERIES:
            raise InputError(
                "a frame is not defined" if node is None else "frames are relative to each other",
                where="<pose>",
                found=name,
            )
        place = node.find("pose")
        relative = "" if place is None else place.get("relative_to", "")
        if not relative and node.tag == "frame":
            relative = node.get("attached_to", "")
        if not relative and node.tag == "joint":
            relative = self._end(node, "child")
        return self.drawn(relative, depth + 1) @ self.own_pose(node)

    def own_pose(self, node: Element) -> Array:
        """Pose (4, 4) that an element states; identity without one."""
        place = node.find("pose")
        if place is None:
            return np.eye(4)
        for key in ("frame", "rotation_format", "degrees"):
            if place.get(key, "") not in ("", "euler_rpy", "false"):
                raise refused(node, "this form of a pose is not read", f'{key}="{place.get(key)}"')
        text = (place.text or "").strip() or "0 0 0 0 0 0"
        values = numbers(node, text, (6,), "pose")
        return pose(from_roll_pitch_yaw(values[3:]), values[:3])

    def cylinder(self, visual: Element, cylinder: Element, link: str) -> ReadCylinder:
        """Cylinder along z of a visual's pose."""
        radius, length = (
            float(numbers(cylinder, cylinder.findtext(key, ""), (1,), key)[0])
            for key in ("radius", "length")
        )
        ends = np.array([[0, 0, -length / 2], [0, 0, length / 2]])
        place = visual.find("pose")
        stated = "" if place is None else place.get("relative_to", "")
        turn = np.eye(4) if not stated else inverse(self.drawn(link)) @ self.drawn(stated)
        ends = apply(turn @ self.own_pose(visual), ends)
        return ReadCylinder(visual.get("name", ""), self.numbers[link], ends, radius)

    def put(self, link: str) -> int:
        """Index of a link's body, added if necessary."""
        if link in self.numbers:
            return self.numbers[link]
        place = self.drawn(link)
        if link in self.above:
            name = self.above[link]
            parent = self._end(self.joints[name], "parent")
            number, at = self.put(parent), self.drawn(name)
            T_joint_link = inverse(at) @ place
            body = ReadBody(link, number, inverse(self.drawn(parent)) @ at, self._axes(name, at))
            if np.abs(T_joint_link - np.eye(4)).max() > SAME_FRAME:  # a joint beside the origin
                self.bodies.append(body._replace(name=f"{link}{JOINT_BODY}"))
                body = ReadBody(link, len(self.bodies) - 1, T_joint_link, ())
        else:  # held by loops only
            joint = ReadJoint(link, "free", np.zeros(3), len(self.key), 0.0)
            body = ReadBody(link, 0, place, (joint,))
            self.key.extend([0.0] * 6)
        self.bodies.append(body)
        self.numbers[link] = len(self.bodies) - 1
        return self.numbers[link]

    def loop(self, name: str) -> ReadLoop:
        """Closure by a joint between two placed links.

        If the joint has axes, a body of its own turns on the parent, and the child is fixed to
        that body.
        """
        node, at = self.joints[name], self.drawn(name)
        parent, child = self._end(node, "parent"), self._end(node, "child")
        frames = inverse(self.drawn(child)) @ at, inverse(self.drawn(parent)) @ at
        joints = () if node.get("type") == "ball" else self._axes(name, at)
        ends = self.numbers[child], self.numbers[parent]
        if joints:
            self.bodies.append(ReadBody(name, ends[1], frames[1], joints))
            ends, frames = (ends[0], len(self.bodies) - 1), (frames[0], np.eye(4))
        return ReadLoop(node.get("type") != "ball", ends, frames)

    def _axes(self, name: str, at: Array) -> tuple[ReadJoint, ...]:
        """Axes of a joint, in its own frame; a ball in the tree is three hinges.

        at : (4, 4) pose of that frame at home.
        """
        node, reading = self.joints[name], self.readings.get(name)
        # a reading's joint counts from home in SDF, from reading zero in this state
        ref = 0.0 if reading is None else float(reading["scale"]) * float(reading["home"])
        kind = "slide" if node.get("type") == "prismatic" else "hinge"
        axes: list[tuple[Array, Array]] = []
        for tag in SDF_JOINT_AXES[node.get("type", "")]:
            xyz, part = node.find(f"{tag}/xyz"), node.find(tag)
            axis = numbers(node, "0 0 1" if xyz is None else xyz.text or "", (3,), f"{tag}/xyz")
            frame = "" if xyz is None else xyz.get("expressed_in", "")
            of_model = node.findtext(f"{tag}/use_parent_model_frame", "0").strip()
            if self.version < MODEL_AXES_BEFORE or of_model in ("1", "true"):
                frame = SDF_MODEL_FRAME
            if frame:
                axis = at[:3, :3].T @ self.drawn(frame)[:3, :3] @ axis
            limit = None if part is None else part.find("limit")
            ends = (None if limit is None else limit.findtext(end) for end in ("lower", "upper"))
            axes.append((unit_axis(node, axis), limits_of(node, *ends) + ref))
        if node.get("type") == "ball":
            axes = [(axis, np.full(2, np.nan)) for axis in np.eye(3)]
        out: list[ReadJoint] = []
        for axis, limits in axes:
            out.append(ReadJoint(name, kind, axis, len(self.key), ref, limits))
            self.key.append(ref)
        if out:
            self.joints_by_name[name] = out[0]
        return tuple(out)


def _ratio_and_offset(mimic: Element) -> tuple[float, float]:
    """Ratio and offset of multiplier * (leader - reference) + offset."""
    ratio, offset, zero = (
        float(numbers(mimic, mimic.findtext(word, default), (1,), word)[0])
        for word, default in (("multiplier", "1"), ("offset", "0"), ("reference", "0"))
    )
    return ratio, offset - ratio * zero
