"""A machine as a MuJoCo model (MJCF): bodies and joints in its home pose, loops closed.

Limbs come as elementary joints (:mod:`pkmcal.export.limbs`). All bodies of a leg stand parallel to
the base frame at home, so that their axes and points are told along the base's axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import wrap
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.source import Source
from pkmcal.errors import GeometryError, InputError
from pkmcal.export.limbs import FIXED, SLIDE, TELESCOPE, TURN, Limbs, limbs_of
from pkmcal.geometry.rigid import cross, dot, inverse, quaternion, rotation, rotation_vector
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import PLANAR, platform_carriers
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.joints import Equation, equations
from pkmcal.mechanisms.kinematics import forward, inverse_result, on_manifold

STEP = "0.001"
"""s; the loops' time constant is twice that, the shortest that MuJoCo allows."""
STIFF = 2.0e4
"""N/m of a drive's position control: with the parts' masses it settles within some 20 ms."""
DAMPED = 2.0e2
"""N s/m of a drive."""
LIGHT, PLATFORM = 0.1, 1.0
"""kg of a part and of the platform: placeholders, since photographs weigh nothing."""
SAME = 1e-9
"""Metres and radians by which two legs' common axis or hinge may differ: rounding."""
ALONG = 0.5
"""Sine of the angle between a leg and a first axis of its universal joint, below which another
axis is taken: at zero the two hinges of the joint would turn alike.
"""
UP = np.array([0.0, 0.0, 1.0])
COLOURS = {
    "base": "0.35 0.35 0.38 1",
    "rod": "0.55 0.60 0.68 1",
    "piston": "0.80 0.82 0.85 1",
    "motor": "0.20 0.45 0.70 1",
    "platform": "0.85 0.45 0.20 1",
}
CONVENTIONS = (
    "Units: m, rad, kg, s. MuJoCo's world is the machine's base frame; the body 'platform' has the"
    " platform frame, so its xpos and xmat are T_base_platform.",
    "Actuators leg1, leg2, … (motor1, … where a motor moves several rods) have the machine's"
    " readings as their values, and sensors of these names tell them: set data.ctrl to readings."
    " Joints of these names have scale * reading: a rod's length is that + offset, a crank's angle"
    " that + angle. An actuator's gear is 1 / scale; without one the scale is 1.",
    "The keyframe 'home' is closed by pkmcal's kinematics, and is the model as drawn (qpos0)."
    " Loops are closed by the equality constraints named after the legs.",
    "PLACEHOLDERS: masses, inertias, damping and the actuators' gains. Photographs weigh nothing,"
    " so this model is for kinematics. Gravity and contacts are off for that reason.",
)
WHY_RESTRICTED = {
    "planar": "The platform stays in the plane by its own two slides and its hinge.",
    "planar-translation": "The platform stays in the plane and keeps its direction by its own two "
    "slides.",
    "translation": "The platform keeps its direction by its own three slides, which stand for the "
    "parallelograms or axes that hold it.",
    "schoenflies": "The platform stays upright by its own three slides and its hinge, which stand "
    "for the parallelograms that hold it.",
}


def mjcf(source: Source) -> str:
    """The model's XML. Raises InputError for a machine that MuJoCo's bodies cannot be."""
    home = home_state(source.machine)
    root = Element("mujoco", model=plain(source.machine.name))
    _settings(root, home)
    world = SubElement(root, "worldbody")
    size = numbers(np.zeros(2), 5 * home.size)
    SubElement(world, "light", pos=size, dir="0 0 -1", directional="true")
    equality = Element("equality")
    anchors = _add_platform(world, equality, home)
    _add_legs(world, equality, home, anchors)
    root.append(equality)
    _drives(root, home)
    _keyframe(root, home)
    indent(root)
    lines = [plain(line) for line in (*source.header(*CONVENTIONS), "Parameters:")]
    lines = [part for line in lines for part in wrap(line, 96, break_on_hyphens=False)]
    lines += [plain(line) for line in source.sigma_lines()]
    about = "\n".join(["<!--", *(f"  {line}" for line in lines), "-->"])
    return f"{about}\n{tostring(root, encoding='unicode')}\n"


# The machine at home


@dataclass(frozen=True)
class HomeState:
    """A machine closed at home.

    T_base_platform : (4, 4). readings : (m,) m or rad. internal : (n,) the bars' hinges, rad.
    a, b : (L, 3) the limbs' ends, m, base frame; u : (L, 3) unit directions from a to b;
    distance : (L,) m. equations : what the axes of each leg add to the closure.
    """

    machine: Machine
    limbs: Limbs
    T_base_platform: Array
    readings: Array
    internal: Array
    a: Array
    b: Array
    u: Array
    distance: Array
    equations: tuple[frozenset[Equation], ...]

    @property
    def rot(self) -> Array:
        """The platform's orientation, (3, 3)."""
        return self.T_base_platform[:3, :3]

    @property
    def size(self) -> float:
        """A length of the machine, m: its rods' mean."""
        return float(self.distance.mean())

    @property
    def middle(self) -> Array:
        """The mean of the platform's joints (3,), platform frame."""
        T_platform_base = inverse(self.T_base_platform)
        return T_platform_base[:3, :3] @ self.b.mean(axis=0) + T_platform_base[:3, 3]

    def leg(self, j: int) -> Any:
        """Leg j (from 0) as its file has it."""
        return self.machine.document.legs[j]

    def column(self, j: int) -> int:
        """The reading of leg j, -1 without."""
        return int(self.limbs.joint[j])

    def motor_legs(self, column: int) -> tuple[int, ...]:
        """The legs (from 0) that a reading moves."""
        return tuple(int(j) for j in np.flatnonzero(self.limbs.joint == column))

    def reading_name(self, column: int) -> str:
        """``leg1`` where the reading moves one leg, as columns of joints.csv; else ``motor1``."""
        legs = self.motor_legs(column)
        return f"leg{legs[0] + 1}" if len(legs) == 1 else f"motor{column + 1}"

    def scale(self, column: int) -> float:
        """What the motor moves is scale * reading."""
        return float(self.limbs.scale[self.motor_legs(column)[0]])

    def values(self, column: int) -> Array:
        """What a motor has moved at home and at both ends of its range, (3,) m or rad."""
        reading = self.readings[column]
        return self.scale(column) * np.append(reading, self.machine.joint_ranges[column])

    def lever(self, column: int) -> float:
        """What makes a motor's stiffness that of a slide: 1, or a turning arm, m."""
        j = self.motor_legs(column)[0]
        return float(np.linalg.norm(self.limbs.arm[j])) if self.limbs.drive[j] == TURN else 1.0

    def gives_way(self, j: int) -> bool:
        """Whether leg j's length changes, by its motor or because it is passive."""
        return self.limbs.drive[j] == TELESCOPE or not np.isfinite(self.limbs.length[j])


def home_state(machine: Machine) -> HomeState:
    """The machine at its home pose, or, where constant rods or axes forbid that, next to it.

    Raises GeometryError where it cannot be closed there.
    """
    layout, values = machine.layout, machine.values
    near = on_manifold(layout, values, machine.home()).T_base_platform
    readings, internal = inverse_result(layout, values, near)
    reached = bool(np.isfinite(readings).all())
    found = forward(layout, values, readings, near, internal) if reached else None
    if found is None or not bool(found.converged):
        raise GeometryError(
            f"mechanism {machine.name!r} does not close at its home pose",
            found="no readings" if found is None else f"a gap of {float(found.error) * 1e3:.3g} mm",
            expected="a pose that all legs reach",
            next_step="give home: {position: [x, y, z]} in the mechanism file",
        )
    ends = limb_ends(layout, values, readings, found.T_base_platform, found.internal)
    line = ends.b - ends.a
    distance = np.sqrt(dot(line, line))
    known = equations(machine.document)
    return HomeState(
        machine,
        limbs_of(machine),
        found.T_base_platform,
        readings,
        found.internal,
        np.array(ends.a),
        np.array(ends.b),
        line / distance[:, None],
        distance,
        tuple(frozenset(kind for leg, kind in known if leg == j) for j in range(machine.n_legs)),
    )


def _joint_axis(home: HomeState, side: str, j: int) -> Array | None:
    """The unit axis (3,) of a joint in its body's frame: as calibrated where it is a parameter, as
    drawn where nothing depends on it; None where the joint has none.
    """
    machine = home.machine
    known = (machine.base_axes() if side == "base" else machine.platform_axes())[j]
    if np.isfinite(known).all():
        return known
    drawn = getattr(getattr(home.leg(j), side), "axis", None)
    return None if drawn is None else _unit(np.array(drawn, dtype=float))


def _universal_axes(home: HomeState, j: int) -> tuple[Array, Array]:
    """First and second hinge (3,) of leg j's universal joint on the base side, base frame.

    The second is square to the first and to the leg. Where a torsion depends on the first it is
    the file's; else the file's, or the motor's that the leg turns with, as long as the leg does not
    lie along it; else the horizontal one square to the leg.
    """
    u, drive = home.u[j], home.limbs.drive[j]
    drawn = home.limbs.axis[j] if drive == TURN else _joint_axis(home, "base", j)
    least = SAME if "torsion" in home.equations[j] else ALONG
    # the axis of a slide is no hinge's
    if drawn is not None and drive != SLIDE and np.linalg.norm(cross(drawn, u)) > least:
        first = drawn
    else:
        level = cross(UP, u)
        first = _unit(level if np.linalg.norm(level) > ALONG / 5 else cross(np.eye(3)[1], u))
    return first, _unit(cross(first, u))


def _unit(v: Array) -> Array:
    return v / np.sqrt(dot(v, v))


# The platform and its bars


@dataclass(frozen=True)
class Anchor:
    """Where a leg is held: the body, and the point (3,) in its frame, m."""

    body: Element
    point: Array

    @property
    def name(self) -> str:
        """The body's name."""
        return self.body.attrib["name"]


def _add_platform(world: Element, equality: Element, home: HomeState) -> list[Anchor]:
    """The platform with its bars; returns where each leg is held."""
    motion = home.machine.document.motion
    _comment(world, WHY_RESTRICTED.get(motion, "The platform has all six freedoms."))
    spread = home.b - home.b.mean(axis=0)
    radius = float(np.sqrt(dot(spread, spread).mean())) or home.size / 4
    at = home.T_base_platform[:3, 3]
    platform = _body(world, "platform", at, PLATFORM, home.middle, 2.4 * radius)
    _turned(platform, home.rot)
    if motion == "spatial":
        SubElement(platform, "freejoint", name="platform")
    else:
        own = home.rot.T  # joints' axes are told in the body's frame
        for k, axis in enumerate("xy" if motion in PLANAR else "xyz"):
            _joint(platform, f"platform_{axis}", "slide", own[:, k], float(at[k]))
        if "translation" not in motion:
            # its value is a turn about z; another orientation is what the value is counted from
            omega = rotation_vector(home.rot)
            turn = float(omega[2]) if np.abs(omega[:2]).max() < SAME else 0.0
            _joint(platform, "platform_turn", "hinge", own[:, 2], turn)
    anchors = _anchors(platform, equality, home)
    for j, anchor in enumerate(anchors):
        start = home.middle if anchor.body is platform else np.zeros(3)
        _cylinder(anchor.body, start, anchor.point, home.size / 60, "platform")
        _site(anchor.body, f"leg{j + 1}_platform", anchor.point)
    return anchors


def _anchors(platform: Element, equality: Element, home: HomeState) -> list[Anchor]:
    """Where each leg is held; bars are made as legs ask for them."""
    limbs, out = home.limbs, list[Anchor]()
    known: dict[str, tuple[int, Element]] = {}
    for j, held in enumerate(limbs.held):
        if held == FIXED:
            out.append(Anchor(platform, limbs.platform[j]))
            continue
        node = home.leg(j).platform
        field = platform_carriers()[node.joint].body
        name = f"{field}{getattr(node, field)}" if field else f"leg{j + 1}_bar"
        if name not in known:
            known[name] = j, _bar(platform, equality, home, j, name)
        first, bar = known[name]
        hinges = np.stack([limbs.platform, limbs.hinge_axis], axis=1)
        if np.abs(hinges[j] - hinges[first]).max() > SAME:
            raise InputError(
                f"leg {j + 1} has another hinge than the other legs on its bar, and one MuJoCo "
                "body has one",
                where=home.machine.name,
                next_step="tie the hinges of all legs on one bar",
            )
        out.append(Anchor(bar, limbs.bar[j]))
    return out


def _bar(platform: Element, equality: Element, home: HomeState, j: int, name: str) -> Element:
    """A bar, hinged on the platform: free, or held in its direction."""
    hinge, axis = home.limbs.platform[j], home.limbs.hinge_axis[j]
    _cylinder(platform, home.middle, hinge, home.size / 60, "motor")
    reach = float(np.linalg.norm(home.limbs.bar[j]))
    bar = _body(platform, name, hinge, LIGHT, np.zeros(3), 2 * reach)
    if home.limbs.held[j] == TURN:
        phi = float(home.internal[home.limbs.hinge[j]])
        _turned(bar, rotation(phi * axis))
        _joint(bar, f"{name}_turn", "hinge", axis, phi)
        return bar
    _turned(bar, home.rot.T)
    if "translation" not in home.machine.document.motion:
        _joint(bar, f"{name}_turn", "hinge", UP)
        _comment(
            equality,
            f"{name} keeps its direction: it turns back by what the platform turns. Its forearms' "
            "parallelograms, each drawn as one rod, do this in the machine.",
        )
        SubElement(
            equality,
            "joint",
            name=f"{name}_keeps_direction",
            joint1=f"{name}_turn",
            joint2="platform_turn",
            polycoef="0 -1 0 0 0",
        )
    return bar


# The legs


def _add_legs(world: Element, equality: Element, home: HomeState, anchors: list[Anchor]) -> None:
    """Every leg as a chain from the base, closed on the platform."""
    made: dict[int, tuple[Element, Array]] = {}
    for j, anchor in enumerate(anchors):
        _comment(world, _words(home, j))
        parent, origin = _carrier(world, home, j, made)
        name, length = f"leg{j + 1}", float(home.distance[j])
        middle = home.u[j] * length / 2
        rod = _body(parent, f"{name}_rod", home.a[j] - origin, LIGHT, middle, length)
        for hinge, axis in _base_hinges(home, j):
            _joint(rod, f"{name}_{hinge}", "hinge", axis)
        _site(rod, f"{name}_base", np.zeros(3))
        last, end = _tip(rod, home, j)
        _site(last, f"{name}_tip", end)
        _close(last, end, equality, home, j, anchor)


def _words(home: HomeState, j: int) -> str:
    """A leg in words."""
    leg, found = home.leg(j), home.equations[j]
    rod = "a rod of constant length"
    if home.gives_way(j):
        driven = home.limbs.drive[j] == TELESCOPE
        rod = "a rod that its motor moves" if driven else "a passive rod"
    out = f"Leg {j + 1}: {leg.base.joint} on the base, {rod}, {leg.platform.joint} on the platform."
    if not found and home.machine.document.motion not in PLANAR:
        out += (
            " Two hinges and a ball: its turn about its own line, which moves nothing, is left out."
        )
    if "torsion" in found:
        out += " Its universal joints keep it from twisting."
    if any("platform" in kind for kind in found):
        out += " It may turn about its own line; its equations say nothing of that."
    return out


def _carrier(
    world: Element, home: HomeState, j: int, made: dict[int, tuple[Element, Array]]
) -> tuple[Element, Array]:
    """What the leg's base joint stands on, and where that is (3,): the base, or its motor's body,
    which all legs on the motor share.
    """
    limbs, column, thick = home.limbs, home.column(j), home.size / 40
    if limbs.drive[j] not in (SLIDE, TURN):
        _ball(world, home.a[j], thick)
        return world, np.zeros(3)
    axis, turns = limbs.axis[j], limbs.drive[j] == TURN
    if column not in made:
        at = limbs.base[j] if turns else home.a[j]
        made[column] = _motor(world, home, column, at, axis), at
    body, at = made[column]
    first = home.motor_legs(column)[0]
    # a carriage has no line of its own
    off = cross(limbs.base[j] - limbs.base[first], axis) if turns else np.zeros(3)
    if max(np.abs(axis - limbs.axis[first]).max(), np.abs(off).max()) > SAME:
        raise InputError(
            f"legs {first + 1} and {j + 1} are on one motor, but move about two axes, which "
            "one MuJoCo body cannot do",
            where=home.machine.name,
            next_step="give both cranks the same center, axis, radial and zero",
        )
    end = home.a[j] - at
    if turns:
        _cylinder(body, (end @ axis) * axis, end, 0.7 * thick, "motor")
    else:
        _cylinder(body, end - 0.8 * thick * axis, end + 0.8 * thick * axis, thick, "motor")
    return body, at


def _motor(world: Element, home: HomeState, column: int, at: Array, axis: Array) -> Element:
    """A crank or carriage, by what its motor has moved."""
    name, thick = home.reading_name(column), home.size / 40
    turns = home.limbs.drive[home.motor_legs(column)[0]] == TURN
    kind, word = ("hinge", "crank") if turns else ("slide", "carriage")
    size = home.lever(column) if turns else home.size / 10
    out = _body(world, f"{name}_{word}", at, LIGHT, np.zeros(3), 2 * size)
    _driven(out, home, column, kind, axis)
    now, *limits = home.values(column)
    if turns:
        _cylinder(world, at - 1.2 * thick * axis, at + 1.2 * thick * axis, thick, "base")
    elif np.isfinite(limits).all():
        low, high = (at + (q - now) * axis for q in limits)
        _cylinder(world, low, high, 0.4 * thick, "base")
    return out


def _base_hinges(home: HomeState, j: int) -> Iterator[tuple[str, Array]]:
    """Names and axes (3,) of a leg's hinges on the base side, in their order."""
    found = home.equations[j]
    if home.machine.document.motion in PLANAR:
        yield "base", UP
        return
    if "revolute base" in found:
        axis = _joint_axis(home, "base", j)
        yield "base", UP if axis is None else axis
    else:
        first, second = _universal_axes(home, j)
        yield "base_first", first
        yield "base_second", second
    if "revolute platform" in found:
        yield "twist", home.u[j]


def _tip(rod: Element, home: HomeState, j: int) -> tuple[Element, Array]:
    """The body at the rod's far end and the end in it (3,): the rod, or the piston in it."""
    u, length, column = home.u[j], float(home.distance[j]), home.column(j)
    reach = length  # m, that the leg may have
    if home.limbs.drive[j] == TELESCOPE:
        now, _, high = home.values(column).tolist()
        reach = high + length - now if np.isfinite(high) else length
    tubes = _tubes(home, j, reach)
    names: list[str | None] = [f"leg{j + 1}_tube{k + 1}" for k in range(len(home.leg(j).tubes))]
    names += [None] * (len(tubes) - len(names))
    if not home.gives_way(j):
        for (radius, start, stop), name in zip(tubes, names, strict=True):
            _cylinder(rod, start * u, min(stop, length) * u, radius, "rod", name)
        return rod, length * u
    for (radius, start, stop), name in zip(tubes[:-1], names[:-1], strict=True):
        _cylinder(rod, start * u, stop * u, radius, "rod", name)
    piston = _body(rod, f"leg{j + 1}_piston", length * u, LIGHT, -u * length / 4, length / 2)
    if column >= 0:
        _driven(piston, home, column, "slide", u)
    else:
        _joint(piston, f"leg{j + 1}_length", "slide", u, length)
    radius, start, stop = tubes[-1]
    out = max(min(stop, reach) - start, home.size / 20)
    _cylinder(piston, -out * u, np.zeros(3), radius, "piston", names[-1])
    return piston, np.zeros(3)


def _tubes(home: HomeState, j: int, reach: float) -> list[tuple[float, float, float]]:
    """(radius, from, to) of what is drawn of a leg, m from A: its tubes, or thin rods instead."""
    length, radii = float(home.distance[j]), home.machine.radii()[j]
    tubes = [
        (float(r), float(t.start), float(t.stop))
        for r, t in zip(radii, home.leg(j).tubes, strict=True)
    ]
    if not home.gives_way(j):
        return tubes or [(length / 80, 0.0, length)]
    if not tubes:
        tubes = [(length / 60, 0.0, 0.55 * length)]
    if len(tubes) == 1:  # what telescopes out of it
        tubes.append((0.6 * tubes[0][0], min(tubes[0][2], length), reach))
    return tubes


def _close(
    node: Element, end: Array, equality: Element, home: HomeState, j: int, anchor: Anchor
) -> None:
    """The loop's closure: a ball on the platform, or hinges and a weld where axes count."""
    found, name = home.equations[j], f"leg{j + 1}"
    axes: list[tuple[str, Array]] = []
    own = _joint_axis(home, "platform", j)
    if own is not None and "torsion" in found:
        second = _universal_axes(home, j)[1]
        axes = [("platform_second", second), ("platform_first", home.rot @ own)]
    elif own is not None and "revolute platform" in found:
        axes = [("platform", home.rot @ own)]
    if axes:
        last = _body(node, f"{name}_end", end, LIGHT, np.zeros(3), home.size / 10)
        for kind, axis in axes:
            _joint(last, f"{name}_{kind}", "hinge", axis)
        SubElement(equality, "weld", name=name, body1=anchor.name, body2=f"{name}_end")
        return
    SubElement(
        equality,
        "connect",
        name=name,
        body1=anchor.name,
        body2=node.attrib["name"],
        anchor=numbers(anchor.point),
    )


# Settings, drives, keyframe


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
        stiffness = numbers(STIFF * home.lever(column) ** 2)
        drive = SubElement(actuator, "position", name=name, joint=name, kp=stiffness)
        if home.scale(column) != 1:
            drive.set("gear", numbers(1 / home.scale(column)))
        if np.isfinite(limits).all():
            drive.set("ctrllimited", "true")
            drive.set("ctrlrange", numbers(limits))
        SubElement(sensor, "actuatorpos", name=name, actuator=name)
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


# Elements: bodies, joints, shapes; numbers to the last digit


def numbers(*values: float | Array) -> str:
    """Numbers to the last digit, or the 16th behind the point; no negative zeros."""
    flat = np.concatenate([np.atleast_1d(np.asarray(v, dtype=float)).ravel() for v in values])
    return " ".join(repr(round(float(v), 16) + 0.0) for v in flat)


def plain(text: str) -> str:
    """Text that may stand in an XML comment: printable, and no two hyphens in a row."""
    text = "".join(c for c in text if c.isprintable())
    while "--" in text:
        text = text.replace("--", "- -")
    return f"{text} " if text.endswith("-") else text


def _body(
    parent: Element, name: str, at: Array, mass: float, middle: Array, size: float
) -> Element:
    """A body at a point (3,) of its parent's frame.

    middle : (3,) its centre of mass. size : m, of a rod of that length; placeholders.
    """
    out = SubElement(parent, "body", name=name, pos=numbers(at))
    inertia = numbers(np.full(3, mass * size**2 / 12))
    SubElement(out, "inertial", pos=numbers(middle), mass=numbers(mass), diaginertia=inertia)
    return out


def _turned(node: Element, rot: Array) -> None:
    """The body's orientation in its parent, where it is not the parent's own."""
    if np.abs(rot - np.eye(3)).max() > 1e-15:  # rounding is no turn
        node.set("quat", numbers(quaternion(rot)))


def _joint(parent: Element, name: str, kind: str, axis: Array, ref: float = 0.0) -> Element:
    """A ``hinge`` or ``slide`` at the body's origin; ``ref`` is its value as drawn (m, rad)."""
    out = SubElement(parent, "joint", name=name, type=kind, axis=numbers(axis))
    if ref:
        out.set("ref", numbers(ref))
    return out


def _driven(parent: Element, home: HomeState, column: int, kind: str, axis: Array) -> None:
    """A motor's joint, whose value is scale * reading; its damping is N s/m or N m s."""
    now, *limits = home.values(column).tolist()
    out = _joint(parent, home.reading_name(column), kind, axis, now)
    if np.isfinite(limits).all():
        out.set("limited", "true")
        out.set("range", numbers(*limits))
    out.set("damping", numbers(DAMPED * home.lever(column) ** 2))


def _cylinder(
    parent: Element, start: Array, stop: Array, radius: float, look: str, name: str | None = None
) -> None:
    """A round bar between two points (3,) of the body's frame."""
    if np.linalg.norm(stop - start) < radius / 10:  # MuJoCo takes no cylinder without a length
        return
    shape = {"fromto": numbers(start, stop), "size": numbers(radius), "rgba": COLOURS[look]}
    geom = SubElement(parent, "geom", {"type": "cylinder", **shape})
    if name:
        geom.set("name", name)


def _ball(parent: Element, at: Array, radius: float) -> None:
    size = numbers(radius)
    SubElement(parent, "geom", type="sphere", pos=numbers(at), size=size, rgba=COLOURS["base"])


def _site(parent: Element, name: str, at: Array) -> None:
    """A named point (3,) of a body."""
    SubElement(parent, "site", name=name, pos=numbers(at))


def _comment(parent: Element, text: str) -> None:
    """A sentence for people."""
    parent.append(Comment(f" {plain(text)} "))
