"""Reader of MJCF: bodies, hinges, slides and balls, equality constraints, drives.

They have the meaning of MuJoCo's documentation. What moves a model in another way, such as tendons,
is refused; what only draws it is skipped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.read_model import (
    JOINT_BODY,
    NO_LIMITS,
    ReadBody,
    ReadCoupling,
    ReadCylinder,
    ReadJoint,
    ReadLoop,
    ReadModel,
    body_poses,
)
from pkmcal.exporters.xml_read import (
    LARGEST_MODEL_FILE,
    MOST_ELEMENTS,
    attribute,
    by_name,
    check_size,
    refused,
    unit_axis,
    vector,
    xml_root,
)
from pkmcal.files import read_text
from pkmcal.geometry.rigid import apply, from_quaternion, inverse, pose, pose_difference, rotation
from pkmcal.levels import ROUNDING

UNREAD_ELEMENTS = ("composite", "flexcomp", "attach")
"""Elements that add bodies."""
FRAMES = ("frame", "replicate")
"""Elements that move those inside them."""
UNREAD_ORIENTATIONS = ("xyaxes", "zaxis")
REFERENCES = ("body", "site", "joint", "tendon", "geom")
"""Attributes that name other elements, without the number of two."""
NAMES = ("name", *REFERENCES, *(f"{key}{k}" for key in REFERENCES for k in "12"))
FREEDOMS = {"free": 6, "ball": 3, "hinge": 1, "slide": 1}
NO_FRAME = np.eye(4)


def read_mujoco(text: str, folder: Path | None = None) -> ReadModel:
    """Model of an MJCF text; loops close at home, as MuJoCo's compiler takes them.

    folder : of the files that the text includes; None for a text that may include none. Raises
    InputError for what is not read.
    """
    root = xml_root(text)
    _include(root, folder)
    _replicate(root)
    for name in UNREAD_ELEMENTS:
        if (node := root.find(f".//{name}")) is not None:
            raise refused(node, f"<{name}> is not read", expected="bodies that are written out")
    for tags in (("joint", "freejoint"), ("site",)):
        by_name(node for tag in tags for node in root.findall(f"worldbody//{tag}[@name]"))
    _fill_defaults(root)
    tree = _Bodies(_units(root))
    for world in root.findall("worldbody"):
        tree.collect(world, 0)
    # state at home: every joint at its reference value
    joints = {j.name: j for body in tree.bodies for j in body.joints}
    drawn = np.zeros(tree.dofs)
    for j in joints.values():
        drawn[j.dof] = j.ref
    at = dict(
        zip((b.name for b in tree.bodies), enumerate(body_poses(tree.bodies, drawn)), strict=True)
    )
    nodes = [node for part in root.findall("equality") for node in part]
    nodes = [node for node in nodes if node.get("active", "true") == "true"]
    for node in nodes:
        if node.tag not in ("connect", "weld", "joint"):
            raise refused(node, "this constraint is not read", node.tag, "connect, weld or joint")
    drives = _drives(root, joints)
    key = None if tree.has_ball else root.find("keyframe/key[@qpos]")
    return ReadModel(
        tuple(tree.bodies),
        tuple(_loop(n, at, tree.sites) for n in nodes if n.tag in ("connect", "weld")),
        tuple(_coupling(n, joints) for n in nodes if n.tag == "joint"),
        tree.sites,
        tuple(tree.cylinders),
        np.array([joints[n.attrib["joint"]].dof for n in drives], dtype=int),
        # of other actuators the gear scales a force, not a value
        np.array([vector(n, "gear", "1", *range(1, 7))[0] if n.tag == "position" else 1.0
                  for n in drives]),
        np.zeros(0)
        if key is None
        else np.array([float(word) for word in key.get("ctrl", "").split()]),
        drawn if key is None else _of_qpos(tree.bodies, drawn, key),
    )  # fmt: skip


def _include(root: Element, folder: Path | None) -> None:
    """Replace each ``<include file="…"/>`` by the elements of that file, which is in the folder or
    below it, and is included once.
    """
    done = set[str]()
    while found := [(parent, node) for parent in root.iter() for node in parent.findall("include")]:
        for parent, node in found:
            name = attribute(node, "file")
            # the file is in the folder or below it, wherever its links lead
            if folder is None or not Path(os.path.realpath(folder / name)).is_relative_to(
                os.path.realpath(folder)
            ):
                raise refused(
                    node, "a file from elsewhere is not included", name, "one beside the document"
                )
            path = os.path.realpath(folder / name)
            if path in done:
                raise refused(node, "the file is included twice", name)
            done.add(path)
            text = read_text(Path(path), name, LARGEST_MODEL_FILE)
            try:
                inside = xml_root(text)
            except InputError as error:
                raise error.as_input(name) from None
            at = list(parent).index(node)
            parent[at : at + 1] = list(inside)
        check_size(root)


def _replicate(root: Element) -> None:
    """Replace each ``<replicate>`` by frames with copies of what is in it, innermost first.

    Names have the copy's number added. Constraints and drives of nothing but bodies inside are
    copied, too, as MuJoCo does.
    """
    parents = [(parent, node) for parent in root.iter() for node in parent.findall("replicate")]
    for parent, node in reversed(parents):
        count = vector(node, "count", "", 1)[0]
        elements = sum(1 for _ in node.iter())
        letters = len(tostring(node)) + elements * len(node.get("sep", ""))
        if not (
            count >= 1
            and count == int(count)
            and count * elements <= MOST_ELEMENTS
            and count * letters <= LARGEST_MODEL_FILE
        ):
            raise refused(node, "this number of copies is not possible", node.get("count"))
        endings = [f"{node.get('sep', '')}{k:0{len(str(int(count)))}}" for k in range(int(count))]
        names = {part.get("name", "") for part in node.iter()} - {""}
        at = list(parent).index(node)
        parent[at : at + 1] = [_copy(node, names, ending, "frame") for ending in endings]
        for k, frame in enumerate(parent[at : at + len(endings)]):
            frame.set("copy", str(k))
        for part in (*root.findall("equality"), *root.findall("actuator")):
            for other in list(part):
                ends = [value for key, value in other.items() if key.rstrip("12") in REFERENCES]
                if ends and names.issuperset(ends):
                    place = list(part).index(other)
                    part[place : place + 1] = [
                        _copy(other, {*names, other.get("name", "")} - {""}, ending, other.tag)
                        for ending in endings
                    ]
        check_size(root)


def _copy(node: Element, names: set[str], ending: str, tag: str) -> Element:
    """Copy of an element with what is in it, with an ending after these names."""
    out = Element(tag, node.attrib)
    for key in NAMES:
        if out.get(key) in names:
            out.set(key, out.attrib[key] + ending)
    out.extend(_copy(child, names, ending, child.tag) for child in node)
    return out


Classes = dict[str, dict[str, dict[str, str]]]
"""Attributes by class and tag."""


def _fill_defaults(root: Element) -> None:
    """Write the attributes of default classes into the joints, sites and constraints."""
    classes: Classes = {"main": {}}
    for node in root.findall("default"):
        _collect_class(node, classes["main"], classes)
    for tag in ("worldbody", "equality", "actuator"):
        for node in root.findall(tag):
            _fill(node, "main", classes)


def _collect_class(node: Element, above: dict[str, dict[str, str]], classes: Classes) -> None:
    """Add the attributes of a class, with those of the class around it, and the classes inside."""
    own = {tag: dict(values) for tag, values in above.items()}
    for child in node:
        if child.tag != "default":
            own[child.tag] = own.get(child.tag, {}) | child.attrib
    classes[node.get("class", "main")] = own
    for child in node.findall("default"):
        _collect_class(child, own, classes)


def _fill(node: Element, name: str, classes: Classes) -> None:
    """Fill the attributes of an element and of those inside it; name : class that applies."""
    own = node.get("class", name)
    if own not in classes:
        raise refused(node, "there is no such default class", own, ", ".join(classes))
    for key, value in classes[own].get(node.tag, {}).items():
        node.attrib.setdefault(key, value)
    inside = node.get("childclass", name)
    for child in node:
        _fill(child, inside, classes)


def _units(root: Element) -> tuple[float, str]:
    """Radians of the file's unit of angles, and the axes of its Euler angles."""
    values = {key: value for node in root.findall("compiler") for key, value in node.items()}
    if values.get("coordinate", "local") != "local":
        raise InputError(
            "global coordinates are not read",
            where="<compiler>",
            found=values["coordinate"],
            expected='coordinate="local"',
        )
    sequence = values.get("eulerseq", "xyz")
    if len(sequence) != 3 or not set(sequence.lower()) <= set("xyz"):
        raise InputError(
            "Euler angles have three axes", where="<compiler>", found=sequence, expected="xyz"
        )
    return (np.deg2rad(1.0) if values.get("angle", "degree") == "degree" else 1.0), sequence


@dataclass
class _Bodies:
    """Bodies in the text's order, depth first, as MuJoCo numbers bodies and joints.

    units : radians of a unit of angle, and axes of Euler angles. dofs : degrees of freedom so far.
    """

    units: tuple[float, str]
    bodies: list[ReadBody] = field(default_factory=lambda: [ReadBody("world", 0, np.eye(4), ())])
    sites: dict[str, tuple[int, Array]] = field(default_factory=dict[str, tuple[int, Array]])
    cylinders: list[ReadCylinder] = field(default_factory=list[ReadCylinder])
    dofs: int = 0
    has_ball: bool = False

    def collect(self, node: Element, number: int, frame: Array = NO_FRAME) -> None:
        """Collect all below a body; frame : (4, 4) pose in it of the element."""
        for site in node.findall("site"):
            if "name" in site.attrib:
                point = apply(frame, vector(site, "pos", "0 0 0"))
                self.sites[site.attrib["name"]] = (number, point)
        self.cylinders += [
            self._cylinder(geom, number, frame)
            for geom in node.findall("geom")
            if geom.get("type") in ("cylinder", "capsule")
            and "size" in geom.attrib
            and not set(UNREAD_ORIENTATIONS) & set(geom.attrib)
        ]
        for child in node:
            if child.tag in FRAMES:
                if (joint := child.find("joint")) is not None:
                    raise refused(joint, "a joint in a frame is not read", expected="in its body")
                self.collect(child, number, frame @ self._frame(child))
            elif child.tag == "body":
                name = child.get("name", f"body {len(self.bodies)}")
                self._add(child, name, number, frame)
                self.collect(child, len(self.bodies) - 1)

    def _cylinder(self, node: Element, number: int, frame: Array) -> ReadCylinder:
        """Cylinder or capsule of a body, by its ends or by its middle and half its length."""
        if "fromto" in node.attrib:
            radius, ends = vector(node, "size", "", 1, 2, 3)[0], vector(node, "fromto", "", 6)
            ends = ends.reshape(2, 3)
        else:
            radius, half, *_ = vector(node, "size", "", 2, 3)
            place = pose(self._turn(node), vector(node, "pos", "0 0 0"))
            ends = apply(place, np.array([[0, 0, -half], [0, 0, half]]))
        return ReadCylinder(node.get("name", ""), number, apply(frame, ends), float(radius))

    def _frame(self, node: Element) -> Array:
        """Pose (4, 4) of a frame; of a copy, that of as many steps as its number."""
        if (copies := node.get("copy")) is None:
            return pose(self._turn(node), vector(node, "pos", "0 0 0"))
        step, place = vector(node, "euler", "0 0 0"), np.zeros(3)
        for k in range(int(copies)):
            place = place + self._euler(k * step) @ vector(node, "offset", "0 0 0")
        return pose(self._euler(int(copies) * step), place)

    def _add(self, node: Element, name: str, parent: int, frame: Array) -> None:
        """Add a body, and one for each further position of joints on it."""
        place = frame @ pose(self._turn(node), vector(node, "pos", "0 0 0"))
        groups: list[tuple[Array, list[ReadJoint]]] = [(np.zeros(3), [])]
        for j in node:
            if j.tag in ("joint", "freejoint"):
                point = vector(j, "pos", "0 0 0")
                if np.abs(point - groups[-1][0]).max() > ROUNDING:
                    groups.append((point, []))
                groups[-1][1].extend(self._joints(j))
        # a hinge beside the body's origin: a body there, and the body fixed to it
        if np.any(groups[-1][0]):
            groups.append((np.zeros(3), []))
        last = np.zeros(3)
        groups = groups[1:] if len(groups) > 1 and not groups[0][1] else groups
        for k, (point, joints) in enumerate(groups):
            own = name if k == len(groups) - 1 else f"{name} {k + 1}{JOINT_BODY}"
            offset = pose(np.eye(3), point - last)
            T = place @ offset if k == 0 else offset
            self.bodies.append(ReadBody(own, parent, T, tuple(joints)))
            parent, last = len(self.bodies) - 1, point

    def _joints(self, node: Element) -> list[ReadJoint]:
        """Elementary joints of a joint; a ball is three hinges."""
        kind = "free" if node.tag == "freejoint" else node.get("type", "hinge")
        if kind not in FREEDOMS:
            raise refused(node, "this is no type of joint", kind, ", ".join(FREEDOMS))
        name, first = node.get("name", f"joint {self.dofs}"), self.dofs
        self.dofs += FREEDOMS[kind]
        if kind == "ball":
            self.has_ball = True
            return [
                ReadJoint(f"{name} {x}", "hinge", axis, first + k, 0.0)
                for k, (x, axis) in enumerate(zip("xyz", np.eye(3), strict=True))
            ]
        factor = self.units[0] if kind == "hinge" else 1.0
        axis = unit_axis(node, vector(node, "axis", "0 0 1"))
        ref = factor * float(vector(node, "ref", "0", 1)[0])
        # ranges apply where limited is not stated, too, unless the compiler says otherwise
        free = "range" not in node.attrib or node.get("limited", "auto") == "false"
        limits = NO_LIMITS if free else factor * vector(node, "range", "", 2)
        return [ReadJoint(name, kind, axis, first, ref, limits)]

    def _turn(self, node: Element) -> Array:
        """Orientation (3, 3) of a body in its parent."""
        for key in UNREAD_ORIENTATIONS:
            if key in node.attrib:
                raise refused(node, "this orientation is not read", key, "quat or euler")
        if "axisangle" in node.attrib:
            *axis, angle = vector(node, "axisangle", "", 4)
            return rotation(self.units[0] * angle * unit_axis(node, np.array(axis)))
        if "euler" in node.attrib:
            return self._euler(vector(node, "euler", ""))
        return _rotation_of(node, vector(node, "quat", "1 0 0 0", 4))

    def _euler(self, angles: Array) -> Array:
        """Orientation (3, 3) of Euler angles (3,) in the file's unit."""
        (factor, sequence), out = self.units, np.eye(3)
        for axis, angle in zip(sequence, factor * angles, strict=True):
            turn = rotation(angle * np.eye(3)["xyz".index(axis.lower())])
            # lower-case axes turn with the body, capital ones are fixed
            out = out @ turn if axis.islower() else turn @ out
        return out


def _rotation_of(node: Element, quaternion: Array) -> Array:
    """Rotation (3, 3) of a quaternion (4,) of any length but zero."""
    if not np.any(quaternion):
        raise refused(node, "a quaternion of zeros is no orientation")
    return from_quaternion(quaternion / np.linalg.norm(quaternion))


def _drives(root: Element, joints: dict[str, ReadJoint]) -> list[Element]:
    """Actuators, one for each joint that they move."""
    out: dict[str, Element] = {}
    for node in root.iterfind("actuator/*"):
        if node.get("joint") not in joints:
            keys = [key for key in ("tendon", "site", "body", "joint") if key in node.attrib]
            raise refused(
                node,
                "an actuator that moves no single joint is not read",
                f'{keys[0]}="{node.attrib[keys[0]]}"' if keys else None,
                "the joint, a hinge or a slide, that it moves",
            )
        out.setdefault(node.attrib["joint"], node)
    return list(out.values())


def _coupling(node: Element, joints: dict[str, ReadJoint]) -> ReadCoupling:
    """Equality of two joints; both values count from home."""
    names = [attribute(node, key) for key in ("joint1", "joint2")]
    if missing := [name for name in names if name not in joints]:
        raise refused(node, "there is no such joint", missing[0])
    first, second = (joints[name] for name in names)
    shift, ratio, *rest = vector(node, "polycoef", "0 1 0 0 0", 5)
    if np.any(rest):
        raise refused(node, "a curved coupling is not read", node.get("polycoef"), "a line")
    return ReadCoupling(first.dof, second.dof, ratio, first.ref - ratio * second.ref + shift)


def _loop(
    node: Element, at: dict[str, tuple[int, Array]], sites: dict[str, tuple[int, Array]]
) -> ReadLoop:
    """Loop closure; as in MuJoCo the second body's frame follows from the model at home.

    ``connect``: the anchor is a point of the first body. ``weld``: the second body's origin. Of
    sites, both points are theirs.
    """
    if "site1" in node.attrib:
        names = [attribute(node, key) for key in ("site1", "site2")]
        if missing := [name for name in names if name not in sites]:
            raise refused(node, "there is no such site", missing[0])
        if node.tag == "weld":
            raise refused(node, "a weld of sites is not read", expected="body1 and body2")
        (first, point1), (second, point2) = (sites[name] for name in names)
        frames = pose(np.eye(3), point1), pose(np.eye(3), point2)
        return ReadLoop(False, (first, second), frames)
    names = [attribute(node, "body1"), node.get("body2", "world")]
    if missing := [name for name in names if name not in at]:
        raise refused(node, "there is no such body", missing[0])
    (first, T1), (second, T2) = (at[name] for name in names)
    if node.tag == "weld":
        relative = vector(node, "relpose", "0 1 0 0 0 0 0", 7)
        stated = bool(np.any(relative[3:]))
        own = pose(from_quaternion(relative[3:]), relative[:3]) if stated else inverse(T1) @ T2
        frames = own, np.eye(4)
    else:
        anchor = pose(np.eye(3), vector(node, "anchor", ""))
        frames = anchor, inverse(T2) @ T1 @ anchor
    return ReadLoop(node.tag == "weld", (first, second), frames)


def _of_qpos(bodies: Sequence[ReadBody], drawn: Array, key: Element) -> Array:
    """State (d,) of a keyframe.

    ``qpos`` has scalars, and position and quaternion of a free joint.
    """
    joints = [(body, j) for body in bodies for j in body.joints]
    qpos = vector(key, "qpos", "", sum(7 if j.kind == "free" else 1 for _, j in joints))
    x, at = drawn.copy(), 0
    for body, j in joints:
        if j.kind == "free":
            here = pose(_rotation_of(key, qpos[at + 3 : at + 7]), qpos[at : at + 3])
            x[j.dof : j.dof + 6] = pose_difference(here, body.T_parent_body)
            at += 7
        else:
            x[j.dof] = qpos[at]
            at += 1
    return x
