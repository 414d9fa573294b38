"""Reader of URDF, as far as :mod:`pkmcal.exporters.urdf` uses it, with its file of loops.

Links and joints have the meaning of URDF's documentation.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, fromstring

import numpy as np
import yaml

from pkmcal.arrays import Array
from pkmcal.exporters.read_model import ReadBody, ReadCoupling, ReadJoint, ReadLoop, ReadModel
from pkmcal.geometry.rigid import from_roll_pitch_yaw, pose

URDF_JOINT_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}


def read_urdf(text: str, loops: str) -> ReadModel:
    """Model of a URDF text and its file of loops."""
    root, beside = fromstring(text), yaml.safe_load(loops)
    links = {node.attrib["name"]: node for node in root.findall("link")}
    joint_above = {_link(node, "child"): node for node in root.findall("joint")}
    bodies: list[ReadBody] = []
    numbers: dict[str, int] = {}
    joints: dict[str, ReadJoint] = {}

    def put(link: str) -> int:
        """Index of a link's body, added after its parent's if necessary."""
        if link in numbers:
            return numbers[link]
        node = joint_above.get(link)
        if node is None:  # the root
            bodies.append(ReadBody(link, 0, np.eye(4), ()))
        else:
            parent, own = put(_link(node, "parent")), tuple[ReadJoint, ...]()
            if node.attrib["type"] != "fixed":
                axis = _vector(node.find("axis"), "xyz", "1 0 0")
                name, kind = node.attrib["name"], URDF_JOINT_KINDS[node.attrib["type"]]
                joints[name] = ReadJoint(name, kind, axis, len(joints), 0.0)
                own = (joints[name],)
            bodies.append(ReadBody(link, parent, _origin_pose(node), own))
        numbers[link] = len(bodies) - 1
        return numbers[link]

    for link in links:
        put(link)
    # joints that follow others, and the state at home
    couplings: list[ReadCoupling] = []
    for node in root.findall("joint"):
        if (mimic := node.find("mimic")) is not None:
            ratio, offset = (float(mimic.attrib[key]) for key in ("multiplier", "offset"))
            own, leader = joints[node.attrib["name"]], joints[mimic.attrib["joint"]]
            couplings.append(ReadCoupling(own.dof, leader.dof, ratio, offset))
    key = np.zeros(len(joints))
    for name, value in beside["home"].items():
        key[joints[name].dof] = value
    for c in couplings:
        key[c.follower] = c.ratio * key[c.leader] + c.offset
    # named links: each leg's base, and the two ends of each loop
    legs = [loop["name"] for loop in beside["loops"]]
    ends = {f"{leg}_base": numbers[f"{leg}_rod"] for leg in legs}
    ends |= {name: numbers[name] for loop in beside["loops"] for name in loop["frames"]}
    readings = beside["readings"]
    radii = {
        node.attrib["name"]: float(node.findall("geometry/cylinder")[0].attrib["radius"])
        for node in root.iter("visual")
        if "name" in node.attrib
    }
    return ReadModel(
        bodies=tuple(bodies),
        loops=tuple(
            ReadLoop(
                loop["coincide"] == "pose",
                (ends[loop["frames"][0]], ends[loop["frames"][1]]),
                (np.eye(4), np.eye(4)),
            )
            for loop in beside["loops"]
        ),
        couplings=tuple(couplings),
        sites={name: (body, np.zeros(3)) for name, body in ends.items()},
        radii=radii,
        actuated=np.array([joints[r["joint"]].dof for r in readings], dtype=int),
        gear=np.array([1 / r["scale"] for r in readings]),
        ctrl=np.array([r["home"] for r in readings]),
        key=key,
    )


def _link(joint: Element, which: str) -> str:
    """Name of a joint's parent or child link."""
    node = joint.find(which)
    return "" if node is None else node.attrib["link"]


def _origin_pose(node: Element) -> Array:
    """Pose (4, 4) of a joint's origin."""
    origin = node.find("origin")
    return pose(
        from_roll_pitch_yaw(_vector(origin, "rpy", "0 0 0")), _vector(origin, "xyz", "0 0 0")
    )


def _vector(node: Element | None, key: str, default: str) -> Array:
    """Numbers of an attribute, or of the default."""
    text = default if node is None else node.get(key, default)
    return np.array([float(v) for v in text.split()])
