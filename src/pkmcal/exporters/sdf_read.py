"""Reader of SDF, as far as :mod:`pkmcal.exporters.sdf` uses it.

Links, frames and joints have the meaning of the specification.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, fromstring

import numpy as np

from pkmcal.arrays import Array
from pkmcal.exporters.read_model import ReadBody, ReadCoupling, ReadJoint, ReadLoop, ReadModel
from pkmcal.geometry.rigid import from_roll_pitch_yaw, inverse, pose

SDF_NAMESPACE = "urn:pkmcal"
SDF_MODEL_FRAME, SDF_WORLD_FRAME = "__model__", "world"
SDF_JOINT_AXES = {"revolute": ("axis",), "prismatic": ("axis",), "universal": ("axis", "axis2")}
LOOP_JOINT_ENDING = "_loop"


def read_sdf(text: str) -> ReadModel:
    """Model of an SDF text; joints named ``…_loop`` are the loop closures."""
    model = fromstring(text)[0]
    # links as bodies along the tree, then loops between them
    tree = _Links(model)
    for link in tree.links:
        tree.put(link)
    loops = [tree.loop(name) for name in tree.joints if name.endswith(LOOP_JOINT_ENDING)]
    sites = {
        name: (tree.numbers[node.attrib["attached_to"]], _pose(node)[:3, 3])
        for name, node in tree.frames.items()
    }
    for link in tree.links:  # a rod's origin is its base joint
        if link.endswith("_rod"):
            sites[f"{link.removesuffix('rod')}base"] = (tree.numbers[link], np.zeros(3))
    return ReadModel(
        bodies=tuple(tree.bodies),
        loops=tuple(loops),
        couplings=tuple(
            ReadCoupling(
                tree.joints_by_name[name].dof,
                tree.joints_by_name[mimic.attrib["joint"]].dof,
                *_ratio_and_offset(mimic),
            )
            for name, node in tree.joints.items()
            if (mimic := node.find("axis/mimic")) is not None
        ),
        sites=sites,
        radii={
            node.attrib["name"]: float(node.findtext("geometry/cylinder/radius", "nan"))
            for node in model.iter("visual")
        },
        actuated=np.array([tree.joints_by_name[name].dof for name in tree.readings], dtype=int),
        gear=np.array([1 / float(values["scale"]) for values in tree.readings.values()]),
        ctrl=np.array([float(values["home"]) for values in tree.readings.values()]),
        key=np.array(tree.key),
    )


class _Links:
    """Links of a model as bodies, each added after its parent.

    above : joint above each link.
    numbers : index of each link's body.
    joints_by_name : joints, of several axes the first.
    key : state at home.
    """

    def __init__(self, model: Element) -> None:
        self.links = _named(model, "link")
        self.frames = _named(model, "frame")
        self.joints = _named(model, "joint")
        self.readings = {
            node.attrib["joint"]: node.attrib
            for node in model.findall(f"{{{SDF_NAMESPACE}}}reading")
        }
        self.above = {
            _end(node, "child"): name
            for name, node in self.joints.items()
            if not name.endswith(LOOP_JOINT_ENDING)
        }
        self.bodies = [ReadBody(SDF_WORLD_FRAME, 0, np.eye(4), ())]
        self.numbers = {SDF_WORLD_FRAME: 0}
        self.joints_by_name: dict[str, ReadJoint] = {}
        self.key: list[float] = []

    def drawn(self, name: str) -> Array:
        """Pose (4, 4) of a link or frame at home, model frame."""
        if name in ("", SDF_MODEL_FRAME, SDF_WORLD_FRAME):
            return np.eye(4)
        if name in self.frames:
            return self.drawn(self.frames[name].attrib["attached_to"]) @ _pose(self.frames[name])
        node = self.links[name].find("pose")
        above = "" if node is None else node.get("relative_to", "")
        return self.drawn(above) @ _pose(self.links[name])

    def put(self, link: str) -> int:
        """Index of a link's body, added if necessary."""
        if link in self.numbers:
            return self.numbers[link]
        if link in self.above:
            name = self.above[link]
            parent = _end(self.joints[name], "parent")
            number = self.put(parent)
            place = inverse(self.drawn(parent)) @ self.drawn(link)
            body = ReadBody(link, number, place, self._axes(name, self.drawn(link)))
        else:  # held by loops only
            joint = ReadJoint(link, "free", np.zeros(3), len(self.key), 0.0)
            body = ReadBody(link, 0, self.drawn(link), (joint,))
            self.key.extend([0.0] * 6)
        self.bodies.append(body)
        self.numbers[link] = len(self.bodies) - 1
        return self.numbers[link]

    def loop(self, name: str) -> ReadLoop:
        """Closure by a joint between two placed links.

        If the joint has axes, a body of its own turns on the parent, and the child is fixed to
        that body.
        """
        node = self.joints[name]
        parent, child = _end(node, "parent"), _end(node, "child")
        placed = node.find("pose")
        relative = child if placed is None else placed.get("relative_to", child)
        at = self.drawn(relative) @ _pose(node)
        frames = inverse(self.drawn(child)) @ at, inverse(self.drawn(parent)) @ at
        joints = self._axes(name, at)
        numbers = self.numbers[child], self.numbers[parent]
        if joints:
            self.bodies.append(ReadBody(name, numbers[1], frames[1], joints))
            numbers, frames = (numbers[0], len(self.bodies) - 1), (frames[0], np.eye(4))
        return ReadLoop(bool(joints), numbers, frames)

    def _axes(self, name: str, at: Array) -> tuple[ReadJoint, ...]:
        """Axes of a joint, in its own frame.

        at : (4, 4) pose of that frame at home.
        """
        node, reading = self.joints[name], self.readings.get(name)
        # a reading's joint counts from home in SDF, from reading zero in this state
        ref = 0.0 if reading is None else float(reading["scale"]) * float(reading["home"])
        kind = "slide" if node.attrib["type"] == "prismatic" else "hinge"
        out: list[ReadJoint] = []
        for tag in SDF_JOINT_AXES.get(node.attrib["type"], ()):
            xyz = node.find(f"{tag}/xyz")
            axis = np.array([] if xyz is None else (xyz.text or "").split(), dtype=float)
            if xyz is not None and xyz.get("expressed_in") == SDF_MODEL_FRAME:
                axis = at[:3, :3].T @ axis
            out.append(ReadJoint(name, kind, axis, len(self.key), ref))
            self.key.append(ref)
        if out:
            self.joints_by_name[name] = out[0]
        return tuple(out)


def _named(model: Element, tag: str) -> dict[str, Element]:
    """Elements of a tag by name."""
    return {node.attrib["name"]: node for node in model.findall(tag)}


def _ratio_and_offset(mimic: Element) -> tuple[float, float]:
    """Ratio and offset of multiplier * (leader - reference) + offset."""
    ratio, offset, zero = (
        float(mimic.findtext(word, "nan")) for word in ("multiplier", "offset", "reference")
    )
    return ratio, offset - ratio * zero


def _end(joint: Element, which: str) -> str:
    """Name of a joint's parent or child."""
    return joint.findtext(which, "").strip()


def _pose(node: Element) -> Array:
    """Pose (4, 4) of an element; identity without one."""
    values = np.array([float(v) for v in node.findtext("pose", "0 0 0 0 0 0").split()])
    return pose(from_roll_pitch_yaw(values[3:]), values[:3])
