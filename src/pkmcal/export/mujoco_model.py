"""A machine as a MuJoCo model: the whole text."""

from __future__ import annotations

from textwrap import wrap
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from pkmcal.export.mujoco_home import HomeState, home_state
from pkmcal.export.mujoco_legs import STIFF, add_legs, lever
from pkmcal.export.mujoco_platform import add_platform
from pkmcal.export.mujoco_xml import numbers, plain
from pkmcal.export.source import Source

STEP = "0.001"
"""s; the loops' time constant is twice that, the shortest that MuJoCo allows."""
CONVENTIONS = (
    "Units: m, rad, kg, s. MuJoCo's world is the machine's base frame; the body 'platform' has the"
    " platform frame, so its xpos and xmat are T_base_platform.",
    "Joints and actuators leg1, leg2, … (motor1, … where a motor moves several rods) have the"
    " machine's readings as their values: a rod's length is its reading + offset, a crank's angle"
    " its reading + angle. Set data.ctrl to readings.",
    "The keyframe 'home' is closed by pkmcal's kinematics, and is the model as drawn (qpos0)."
    " Loops are closed by the equality constraints named after the legs.",
    "PLACEHOLDERS: masses, inertias, damping and the actuators' gains. Photographs weigh nothing,"
    " so this model is for kinematics. Gravity and contacts are off for that reason.",
)


def mjcf(source: Source) -> str:
    """The model's XML. Raises InputError for a machine that MuJoCo's bodies cannot be."""
    home = home_state(source.machine)
    root = Element("mujoco", model=plain(source.machine.name))
    _settings(root, home)
    world = SubElement(root, "worldbody")
    size = numbers(np.zeros(2), 5 * home.size)
    SubElement(world, "light", pos=size, dir="0 0 -1", directional="true")
    equality = Element("equality")
    anchors = add_platform(world, equality, home)
    add_legs(world, equality, home, anchors)
    root.append(equality)
    _drives(root, home)
    _keyframe(root, home)
    indent(root)
    return f"{_header(source)}\n{tostring(root, encoding='unicode')}\n"


def _settings(root: Element, home: HomeState) -> None:
    SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    option = SubElement(root, "option", timestep=STEP, gravity="0 0 0", integrator="implicitfast")
    SubElement(option, "flag", contact="disable")
    middle = np.concatenate([home.a, home.b]).mean(axis=0)
    SubElement(root, "statistic", center=numbers(middle), extent=numbers(2 * home.size))
    default = SubElement(root, "default")
    SubElement(default, "geom", contype="0", conaffinity="0")
    SubElement(default, "site", size=numbers(home.size / 100))
    SubElement(default, "joint", damping="0.01")
    # as stiff as the step allows: the loops are the machine's joints, not springs
    SubElement(default, "equality", solref="0.002 1", solimp="0.99 0.9999 0.0001 0.5 2")


def _drives(root: Element, home: HomeState) -> None:
    """Position control of every reading, and sensors."""
    actuator, sensor = SubElement(root, "actuator"), SubElement(root, "sensor")
    for column in range(home.machine.n_joints):
        name, limits = home.reading_name(column), home.machine.joint_ranges[column]
        drive = SubElement(
            actuator,
            "position",
            name=name,
            joint=name,
            kp=numbers(STIFF * lever(home, column) ** 2),
        )
        if np.isfinite(limits).all():
            drive.set("ctrllimited", "true")
            drive.set("ctrlrange", numbers(limits))
        SubElement(sensor, "jointpos", name=name, joint=name)
    for kind, name in (("framepos", "platform_position"), ("framequat", "platform_quaternion")):
        SubElement(sensor, kind, name=name, objtype="xbody", objname="platform")


def _keyframe(root: Element, home: HomeState) -> None:
    """All joints' values at home in MuJoCo's order, which is the text's."""
    world = root.iterfind("worldbody/")
    values = [n.get("ref", "0.0") for part in world for n in part.iter("joint")]
    free = next((n for n in root.iter("body") if n.find("freejoint") is not None), None)
    if free is not None:  # the platform comes first
        values[:0] = [free.get("pos", "0 0 0"), free.get("quat", "1 0 0 0")]
    key = SubElement(SubElement(root, "keyframe"), "key", name="home", qpos=" ".join(values))
    key.set("ctrl", numbers(home.readings))


def _header(source: Source) -> str:
    """A comment on what this is, with every parameter and its standard deviation."""
    lines = [plain(line) for line in (*source.header(*CONVENTIONS), "Parameters:")]
    lines = [part for line in lines for part in wrap(line, 96, break_on_hyphens=False)]
    lines += [plain(line) for line in source.sigma_lines()]
    return "\n".join(["<!--", *(f"  {line}" for line in lines), "-->"])
