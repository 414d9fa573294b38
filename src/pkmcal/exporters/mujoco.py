"""MuJoCo model (MJCF) with the machine's closed loops, driven by its readings."""

from __future__ import annotations

from typing import ClassVar, final
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.exporters.agreement import differences
from pkmcal.exporters.bodies import BODY_COLOURS, BodyTree, RoundBar, TreeBody, body_tree
from pkmcal.exporters.contract import Difference, Exporter
from pkmcal.exporters.home import HomeState
from pkmcal.exporters.markup import comment, comment_text, document, file_name, numbers_text
from pkmcal.exporters.mujoco_read import read_mujoco
from pkmcal.geometry.rigid import pose, quaternion
from pkmcal.outcome.finding import Finding, note

MUJOCO_TIME_STEP = "0.001"
"""Time step, s; the loops' time constant is twice as large, the shortest that MuJoCo allows."""
DRIVE_STIFFNESS = 2.0e4
"""Stiffness of a drive's position control, N/m.

With the bodies' masses it settles in about 20 ms.
"""
DRIVE_DAMPING = 2.0e2
"""Damping of a drive, N s/m."""
MUJOCO_PART_MASS, MUJOCO_PLATFORM_MASS = 0.1, 1.0
"""Masses of a part and of the platform, kg: placeholders, since images do not determine masses."""
CONVENTIONS = (
    "Units: m, rad, kg, s. MuJoCo's world is the machine's base frame; the body 'platform' has the"
    " platform frame, so its xpos and xmat are T_base_platform.",
    "Actuators leg1, leg2, … (motor1, … where a motor moves several rods) have the machine's"
    " readings as their values, and sensors of these names measure them: set data.ctrl to readings."
    " Joints of these names have scale * reading: a rod's length is that + offset, a crank's angle"
    " that + angle. An actuator's gear is 1 / scale; without one the scale is 1.",
    "The keyframe 'home' is closed by pkmcal's kinematics, and is the model as drawn (qpos0)."
    " Loops are closed by the equality constraints named after the legs.",
    "PLACEHOLDERS: masses, inertias, damping and the actuators' gains. Images weigh nothing,"
    " so this model is for kinematics. Gravity and contacts are off for that reason.",
)


@final
class MujocoExporter(Exporter):
    """One file, ``<name>.xml``."""

    name: ClassVar = "mujoco"
    title: ClassVar = "MuJoCo model (MJCF) with closed loops"
    holds_joint_offsets: ClassVar = True

    def files(self, source: MachineSource) -> dict[str, str]:
        """MJCF text."""
        return {f"{file_name(source.machine.name)}.xml": _mjcf(source)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences of the model that the text's bodies, joints and loops describe."""
        return differences(read_mujoco(next(iter(files.values()))), source.machine)

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Note on placeholders."""
        del source
        return (note("export.mujoco_placeholders"),)


def _mjcf(source: MachineSource) -> str:
    """MJCF text. Raises InputError for a machine that MuJoCo's bodies cannot represent."""
    tree = body_tree(source.machine)
    home = tree.home
    root = Element("mujoco", model=comment_text(source.machine.name))
    _settings(root, home)
    world = SubElement(root, "worldbody")
    size = numbers_text(np.zeros(2), 5 * home.size)
    SubElement(world, "light", pos=size, dir="0 0 -1", directional="true")
    _fill(world, tree.bodies[0], tree)
    equality = SubElement(root, "equality")
    # couplings and loops are equality constraints
    for coupling in tree.couplings:
        comment(equality, coupling.comment)
        out = SubElement(equality, "joint", name=coupling.name, joint1=coupling.follower)
        out.set("joint2", coupling.leader)
        out.set("polycoef", "0 -1 0 0 0")
    for loop in tree.loops:
        kind, second = ("weld", f"{loop.name}_end") if loop.hinges else ("connect", loop.tip.name)
        out = SubElement(equality, kind, name=loop.name, body1=loop.held.name, body2=second)
        if not loop.hinges:
            out.set("anchor", numbers_text(loop.point))
    _drives(root, home)
    # the keyframe at home: values of all joints in MuJoCo's order, that of the text
    parts = root.iterfind("worldbody/")
    values = [n.get("ref", "0.0") for part in parts for n in part.iter("joint")]
    free = next((n for n in root.iter("body") if n.find("freejoint") is not None), None)
    if free is not None:  # the platform comes first
        values[:0] = [free.get("pos", "0 0 0"), free.get("quat", "1 0 0 0")]
    key = SubElement(SubElement(root, "keyframe"), "key", name="home", qpos=" ".join(values))
    key.set("ctrl", numbers_text(home.readings))
    return document(root, source, CONVENTIONS)


# Bodies


def _fill(node: Element, body: TreeBody, tree: BodyTree) -> None:
    """Add joints, shapes and sites of a body, and recursively the bodies on it."""
    for joint in body.joints:
        made = _joint(node, joint.name, joint.kind, joint.axis, joint.value)
        if joint.column >= 0:
            limits = tree.home.values(joint.column)[1:]
            if np.isfinite(limits).all():
                made.set("limited", "true")
                made.set("range", numbers_text(limits))
            # N s/m or N m s
            made.set("damping", numbers_text(DRIVE_DAMPING * tree.home.lever(joint.column) ** 2))
    for shape in body.shapes:
        _geom(node, shape)
    for name, point in body.points.items():
        SubElement(node, "site", name=name, pos=numbers_text(point))
    for child in tree.children(body):
        if child.comment:
            comment(node, child.comment)
        mass = MUJOCO_PLATFORM_MASS if child is tree.platform else MUJOCO_PART_MASS
        made = _body(node, child.name, child.T_parent_body, mass, child.middle, child.size)
        if child.free:
            SubElement(made, "freejoint", name=child.name)
        _fill(made, child, tree)
    for loop in tree.loops:
        if loop.hinges and loop.tip is body:
            # a body with the loop joint's own hinges, to which the platform is welded
            place, size = pose(np.eye(3), loop.end), tree.home.size / 10
            last = _body(node, f"{loop.name}_end", place, MUJOCO_PART_MASS, np.zeros(3), size)
            for kind, axis in loop.hinges:
                _joint(last, f"{loop.name}_{kind}", "hinge", axis)


def _body(parent: Element, name: str, T: Array, mass: float, middle: Array, size: float) -> Element:
    """Add a body at a pose (4, 4) in its parent's frame.

    middle : (3,) centre of mass.
    size : m; the placeholder inertia is that of a rod of this length.
    """
    out = SubElement(parent, "body", name=name, pos=numbers_text(T[:3, 3]))
    inertia = numbers_text(np.full(3, mass * size**2 / 12))
    SubElement(
        out, "inertial", pos=numbers_text(middle), mass=numbers_text(mass), diaginertia=inertia
    )
    if np.abs(T[:3, :3] - np.eye(3)).max() > 1e-15:  # rounding error
        out.set("quat", numbers_text(quaternion(T[:3, :3])))
    return out


def _joint(parent: Element, name: str, kind: str, axis: Array, ref: float = 0.0) -> Element:
    """Add a ``hinge`` or ``slide`` at the body's origin.

    ref : value at home, m or rad.
    """
    out = SubElement(parent, "joint", name=name, type=kind, axis=numbers_text(axis))
    if ref:
        out.set("ref", numbers_text(ref))
    return out


def _geom(parent: Element, shape: RoundBar) -> None:
    """Add a body's shape."""
    size, rgba = numbers_text(shape.radius), BODY_COLOURS[shape.colour]
    if shape.stop is None:
        SubElement(
            parent, "geom", type="sphere", pos=numbers_text(shape.start), size=size, rgba=rgba
        )
    elif not shape.flat:  # MuJoCo rejects cylinders of length 0
        ends = numbers_text(shape.start, shape.stop)
        geom = SubElement(parent, "geom", type="cylinder", fromto=ends, size=size, rgba=rgba)
        if shape.name:
            geom.set("name", shape.name)


# Settings, drives, keyframe


def _settings(root: Element, home: HomeState) -> None:
    """Add compiler, options and defaults."""
    SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    option = SubElement(
        root, "option", timestep=MUJOCO_TIME_STEP, gravity="0 0 0", integrator="implicitfast"
    )
    SubElement(option, "flag", contact="disable")
    middle = np.concatenate([home.a, home.b]).mean(axis=0)
    SubElement(root, "statistic", center=numbers_text(middle), extent=numbers_text(2 * home.size))
    default = SubElement(root, "default")
    SubElement(default, "geom", contype="0", conaffinity="0")
    SubElement(default, "site", size=numbers_text(home.size / 100))
    SubElement(default, "joint", damping="0.01")
    # as stiff as the time step allows: the loops are rigid joints, not springs
    SubElement(default, "equality", solref="0.002 1", solimp="0.99 0.9999 0.0001 0.5 2")


def _drives(root: Element, home: HomeState) -> None:
    """Add position control of each reading, and sensors."""
    actuator, sensor = SubElement(root, "actuator"), SubElement(root, "sensor")
    for column in range(home.machine.n_joints):
        name, limits = home.reading_name(column), home.machine.joint_ranges[column]
        stiffness = numbers_text(DRIVE_STIFFNESS * home.lever(column) ** 2)
        drive = SubElement(actuator, "position", name=name, joint=name, kp=stiffness)
        if home.scale(column) != 1:
            drive.set("gear", numbers_text(1 / home.scale(column)))
        if np.isfinite(limits).all():
            drive.set("ctrllimited", "true")
            drive.set("ctrlrange", numbers_text(limits))
        SubElement(sensor, "actuatorpos", name=name, actuator=name)
    for kind, name in (("framepos", "platform_position"), ("framequat", "platform_quaternion")):
        SubElement(sensor, kind, name=name, objtype="xbody", objname="platform")
