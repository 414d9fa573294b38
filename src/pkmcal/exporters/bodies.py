"""Machine as a tree of bodies at its home pose, and the loops that close it.

MuJoCo, URDF and SDF exports write this tree in their own syntax. Limbs come as elementary joints
(:mod:`pkmcal.exporters.limbs`). At home the frames of all bodies of a leg are parallel to the base
frame, so their axes and points are components along the base's axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.home import (
    BASE_FRAME_UP,
    SAME_HINGE_DIFFERENCE,
    HomeState,
    home_state,
    joint_axis,
    universal_hinges,
)
from pkmcal.exporters.limbs import FIXED_CARRIER, SLIDE_CARRIER, TELESCOPE_ROD, TURN_CARRIER
from pkmcal.exporters.read_model import BASE_CROSS, DISPLAY_MARK, PLATFORM_CROSS
from pkmcal.geometry.rigid import cross, dot, pose, rotation, rotation_vector
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import PLANAR_MOTIONS, platform_carriers
from pkmcal.mechanisms.joints import joint_offsets
from pkmcal.outcome.finding import Finding, note

BODY_COLOURS = {
    "base": "0.35 0.35 0.38 1",
    "rod": "0.55 0.60 0.68 1",
    "piston": "0.80 0.82 0.85 1",
    "motor": "0.20 0.45 0.70 1",
    "platform": "0.85 0.45 0.20 1",
}
WHY_RESTRICTED = {
    "planar": "The platform stays in the plane by its own two slides and its hinge.",
    "planar-translation": "The platform stays in the plane and keeps its direction by its own two "
    "slides.",
    "translation": "The platform keeps its direction by its own three slides, which stand for the "
    "parallelograms or axes that hold it.",
    "schoenflies": "The platform stays upright by its own three slides and its hinge, which stand "
    "for the parallelograms that hold it.",
}
NOT_WEIGHED = "NOT KNOWN: masses and inertias, since images weigh nothing"
"""Beginning of the convention line in which each format states how it treats missing masses."""


def without_masses(form: str) -> Finding:
    """Note that links have no masses, with the consequence for a format."""
    return note("export.no_masses", format=form)


@dataclass(frozen=True)
class BodyJoint:
    """Joint between a body and its parent, at the body's origin.

    axis : (3,) unit, in the body's frame.
    value : m or rad, at home.
    column : index of the reading that drives the joint, by its scale; -1 for none.
    """

    name: str
    kind: Literal["hinge", "slide"]
    axis: Array
    value: float = 0.0
    column: int = -1


@dataclass(frozen=True)
class RoundBar:
    """Cylinder between two points (3,) of a body's frame, m; a sphere if ``stop`` is None."""

    start: Array
    stop: Array | None
    radius: float
    colour: str
    name: str = ""

    @property
    def flat(self) -> bool:
        """Whether the cylinder is too short to be drawn."""
        return self.stop is not None and bool(
            np.linalg.norm(self.stop - self.start) < self.radius / 10
        )

    @property
    def drawn(self) -> tuple[Array, float, Array]:
        """Midpoint (3,) and length, m, and the rotation of the z axis to the cylinder's.

        The rotation is roll, pitch and yaw (3,), rad.
        """
        if self.stop is None:
            return self.start, 0.0, np.zeros(3)
        x, y, z = line = self.stop - self.start
        turned = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
        return (self.start + self.stop) / 2, float(np.linalg.norm(line)), turned


@dataclass(frozen=True)
class TreeBody:
    """Body of the tree, with the joints to its parent in series.

    T_parent_body : (4, 4) at home.
    middle, size : centre (3,) and length, m, of the body's shapes.
    free : all six degrees of freedom in place of the joints.
    comment : remark for readers of the exported file.
    points : named points (3,) in the body's frame.
    """

    name: str
    parent: TreeBody | None
    T_parent_body: Array
    middle: Array
    size: float
    free: bool = False
    comment: str = ""
    joints: list[BodyJoint] = field(default_factory=list[BodyJoint])
    shapes: list[RoundBar] = field(default_factory=list[RoundBar])
    points: dict[str, Array] = field(default_factory=dict[str, Array])

    @property
    def T_base_body(self) -> Array:
        """Pose at home, (4, 4)."""
        up = np.eye(4) if self.parent is None else self.parent.T_base_body
        return up @ self.T_parent_body


@dataclass(frozen=True)
class Loop:
    """Closure of a loop: a leg's end coincides with a point of the platform or of a bar on it.

    name : name of the leg.
    held, point : platform or bar, and the point (3,) in its frame.
    tip, end : body of the leg, and the point (3,) in its frame.
    hinges : names and axes (3,), in the leg's frame, of the joint there, from the leg on; empty
        for a ball joint.
    """

    name: str
    held: TreeBody
    point: Array
    tip: TreeBody
    end: Array
    hinges: tuple[tuple[str, Array], ...]


@dataclass(frozen=True)
class Coupling:
    """Joint that turns by the negative angle of another; both angles count from home."""

    name: str
    follower: str
    leader: str
    comment: str


@dataclass(frozen=True)
class BodyTree:
    """Bodies with loops and couplings.

    bodies : each after its parent, the base first, the platform second.
    """

    home: HomeState
    bodies: tuple[TreeBody, ...]
    loops: tuple[Loop, ...]
    couplings: tuple[Coupling, ...]

    @property
    def platform(self) -> TreeBody:
        """Platform; its frame is the machine's platform frame."""
        return self.bodies[1]

    def children(self, of: TreeBody) -> list[TreeBody]:
        """Bodies whose parent is the given one."""
        return [body for body in self.bodies if body.parent is of]


def body_tree(machine: Machine) -> BodyTree:
    """Body tree of a machine.

    Raises InputError for a machine that rigid bodies with loops cannot represent.
    """
    home = home_state(machine)
    base = TreeBody("base", None, np.eye(4), np.zeros(3), home.size)
    bodies, couplings = [base], list[Coupling]()
    held = _add_platform(bodies, couplings, home)
    loops = tuple(_add_legs(bodies, home, held))  # also appends to bodies
    return BodyTree(home, tuple(bodies), loops, tuple(couplings))


def _body(bodies: list[TreeBody], body: TreeBody) -> TreeBody:
    bodies.append(body)
    return body


# The platform and its bars


def _add_platform(
    bodies: list[TreeBody], couplings: list[Coupling], home: HomeState
) -> list[tuple[TreeBody, Array]]:
    """Add the platform with its bars; return the body and the point that hold each leg."""
    motion = home.machine.document.motion
    spread = home.b - home.b.mean(axis=0)
    radius = float(np.sqrt(dot(spread, spread).mean())) or home.size / 4
    at = home.T_base_platform[:3, 3]
    platform = _body(
        bodies,
        TreeBody(
            "platform",
            bodies[0],
            home.T_base_platform,
            home.middle,
            2.4 * radius,
            free=motion == "spatial",
            comment=WHY_RESTRICTED.get(motion, "The platform has all six freedoms."),
        ),
    )
    if not platform.free:
        own = home.rot.T  # joint axes are in the body's frame
        for k, axis in enumerate("xy" if motion in PLANAR_MOTIONS else "xyz"):
            name = f"platform_{axis}"
            platform.joints.append(BodyJoint(name, "slide", own[:, k], float(at[k])))
        if "translation" not in motion:
            # the joint's value is the rotation about z; any other orientation of the platform at
            # home is its zero
            omega = rotation_vector(home.rot)
            turn = float(omega[2]) if np.abs(omega[:2]).max() < SAME_HINGE_DIFFERENCE else 0.0
            platform.joints.append(BodyJoint("platform_turn", "hinge", own[:, 2], turn))
    held = _holders(bodies, couplings, home)
    for j, (body, point) in enumerate(held):
        start = home.middle if body is platform else np.zeros(3)
        body.shapes.append(RoundBar(start, point, home.size / 60, "platform"))
        body.points[f"leg{j + 1}_platform"] = point
    return held


def _holders(
    bodies: list[TreeBody], couplings: list[Coupling], home: HomeState
) -> list[tuple[TreeBody, Array]]:
    """Body and point that hold each leg; bars are added when the first leg on them is met."""
    limbs, out = home.limbs, list[tuple[TreeBody, Array]]()
    numbers: dict[str, tuple[int, TreeBody]] = {}
    for j, held in enumerate(limbs.held):
        if held == FIXED_CARRIER:
            out.append((bodies[1], limbs.platform[j]))
            continue
        node = home.leg(j).platform
        number = platform_carriers()[node.joint].body
        name = f"{number}{getattr(node, number)}" if number else f"leg{j + 1}_bar"
        if name not in numbers:
            numbers[name] = j, _side_bar(bodies, couplings, home, j, name)
        first, bar = numbers[name]
        # a bar is one body, so its legs must have the same hinge
        hinges = np.stack([limbs.platform, limbs.hinge_axis], axis=1)
        if np.abs(hinges[j] - hinges[first]).max() > SAME_HINGE_DIFFERENCE:
            raise InputError(
                f"leg {j + 1} has another hinge than the other legs on its bar, and one body has"
                " one",
                where=home.machine.name,
                next_step="tie the hinges of all legs on one bar",
                code="export.bar_hinges",
            )
        out.append((bar, limbs.bar[j]))
    return out


def _side_bar(
    bodies: list[TreeBody], couplings: list[Coupling], home: HomeState, j: int, name: str
) -> TreeBody:
    """Add a bar hinged on the platform.

    The hinge is free, or coupled to keep the bar's direction.
    """
    platform, hinge, axis = bodies[1], home.limbs.platform[j], home.limbs.hinge_axis[j]
    platform.shapes.append(RoundBar(home.middle, hinge, home.size / 60, "motor"))
    reach = 2 * float(np.linalg.norm(home.limbs.bar[j]))
    if home.limbs.held[j] == TURN_CARRIER:
        phi = float(home.internal[home.limbs.hinge[j]])
        place = pose(rotation(phi * axis), hinge)
        bar = _body(bodies, TreeBody(name, platform, place, np.zeros(3), reach))
        bar.joints.append(BodyJoint(f"{name}_turn", "hinge", axis, phi))
        return bar
    bar = _body(bodies, TreeBody(name, platform, pose(home.rot.T, hinge), np.zeros(3), reach))
    if "translation" not in home.machine.document.motion:
        bar.joints.append(BodyJoint(f"{name}_turn", "hinge", BASE_FRAME_UP))
        text = (
            f"{name} keeps its direction: it turns back by what the platform turns. Its forearms' "
            "parallelograms, each drawn as one rod, do this in the machine."
        )
        couplings.append(Coupling(f"{name}_keeps_direction", f"{name}_turn", "platform_turn", text))
    return bar


# The legs


def _add_legs(
    bodies: list[TreeBody], home: HomeState, held: list[tuple[TreeBody, Array]]
) -> Iterator[Loop]:
    """Add each leg as a chain from the base, and yield the loop that closes it on the platform."""
    motors: dict[int, TreeBody] = {}
    for j, (holder, point) in enumerate(held):
        parent = _carrier(bodies, home, j, motors)
        origin = parent.T_base_body[:3, 3]
        name, length, comment = f"leg{j + 1}", float(home.distance[j]), _description(home, j)
        place, middle = pose(np.eye(3), home.a[j] - origin), home.u[j] * length / 2
        hinges = [
            BodyJoint(f"{name}_{kind}", "hinge", axis) for kind, axis in _base_hinges(home, j)
        ]
        ahead, beyond = home.rods[0, j] - home.a[j], home.b[j] - home.rods[1, j]
        first = None
        if ahead.any():  # the cross of a joint whose axes do not meet, with both axes
            cross_name, reach = f"{name}{BASE_CROSS}", float(np.linalg.norm(ahead))
            first = TreeBody(cross_name, parent, place, ahead / 2, reach, comment=comment)
            first.joints.append(hinges.pop(0))
            _body(bodies, first)
            parent, place, comment = first, pose(np.eye(3), ahead), ""
        rod = TreeBody(f"{name}_rod", parent, place, middle, length, comment=comment)
        rod.joints.extend(hinges)
        _body(bodies, rod)
        (first or rod).points[f"{name}_base"] = np.zeros(3)
        tip, end = _tip(bodies, rod, home, j)
        hinged = _end_hinges(home, j)
        if beyond.any():
            (kind, axis), *hinged = hinged
            place, reach = pose(np.eye(3), end), float(np.linalg.norm(beyond))
            tip = _body(bodies, TreeBody(f"{name}{PLATFORM_CROSS}", tip, place, beyond / 2, reach))
            tip.joints.append(BodyJoint(f"{name}_{kind}", "hinge", axis))
            end = beyond
        tip.points[f"{name}_tip"] = end
        yield Loop(name, holder, point, tip, end, tuple(hinged))


def _description(home: HomeState, j: int) -> str:
    """Description of a leg for the file's comment."""
    leg, equations = home.leg(j), home.equations[j]
    rod = "a rod of constant length"
    if home.length_varies(j):
        driven = home.limbs.drive[j] == TELESCOPE_ROD
        rod = "a rod that its motor moves" if driven else "a passive rod"
    out = f"Leg {j + 1}: {leg.base.joint} on the base, {rod}, {leg.platform.joint} on the platform."
    if any(joint_offsets(home.machine.document).get(j, ())):
        out += " The two axes of its universal joints do not meet."
    elif not equations and home.machine.document.motion not in PLANAR_MOTIONS:
        out += (
            " Two hinges and a ball: its turn about its own line, which moves nothing, is left out."
        )
    if "torsion" in equations:
        out += " Its universal joints keep it from twisting."
    if any("platform" in kind for kind in equations):
        out += " It may turn about its own line; its equations do not restrict that."
    return out


def _carrier(
    bodies: list[TreeBody], home: HomeState, j: int, motors: dict[int, TreeBody]
) -> TreeBody:
    """Body that carries a leg's base joint: the base, or the motor body of all legs on that motor.

    Raises InputError if legs on one motor do not share its axis.
    """
    limbs, column, thick = home.limbs, home.column(j), home.size / 40
    if limbs.drive[j] not in (SLIDE_CARRIER, TURN_CARRIER):
        bodies[0].shapes.append(RoundBar(home.a[j], None, thick, "base"))
        return bodies[0]
    axis, turns = limbs.axis[j], limbs.drive[j] == TURN_CARRIER
    if column not in motors:
        motors[column] = _motor(bodies, home, column, limbs.base[j] if turns else home.a[j], axis)
    body = motors[column]
    first = home.motor_legs(column)[0]
    # a carriage has a direction, but no axis in space
    # legs on one motor turn about the same line, or slide in the same direction
    off = cross(limbs.base[j] - limbs.base[first], axis) if turns else np.zeros(3)
    if max(np.abs(axis - limbs.axis[first]).max(), np.abs(off).max()) > SAME_HINGE_DIFFERENCE:
        raise InputError(
            f"legs {first + 1} and {j + 1} are on one motor, but move about two axes, which "
            "one body cannot do",
            where=home.machine.name,
            next_step="give both cranks the same center, axis, radial and zero",
            code="export.motor_axes",
        )
    end = home.a[j] - body.T_parent_body[:3, 3]
    if turns:
        body.shapes.append(RoundBar((end @ axis) * axis, end, 0.7 * thick, "motor"))
    else:
        body.shapes.append(
            RoundBar(end - 0.8 * thick * axis, end + 0.8 * thick * axis, thick, "motor")
        )
    return body


def _motor(
    bodies: list[TreeBody], home: HomeState, column: int, at: Array, axis: Array
) -> TreeBody:
    """Add a motor's crank or carriage, at its displacement at home."""
    name, thick, base = home.reading_name(column), home.size / 40, bodies[0]
    turns = home.limbs.drive[home.motor_legs(column)[0]] == TURN_CARRIER
    size = home.lever(column) if turns else home.size / 10
    word = "crank" if turns else "carriage"
    out = _body(
        bodies, TreeBody(f"{name}_{word}", base, pose(np.eye(3), at), np.zeros(3), 2 * size)
    )
    now, *limits = home.values(column).tolist()
    out.joints.append(BodyJoint(name, "hinge" if turns else "slide", axis, now, column))
    if turns:
        base.shapes.append(
            RoundBar(at - 1.2 * thick * axis, at + 1.2 * thick * axis, thick, "base")
        )
    elif np.isfinite(limits).all():
        low, high = (at + (q - now) * axis for q in limits)
        base.shapes.append(RoundBar(low, high, 0.4 * thick, "base"))
    return out


def _base_hinges(home: HomeState, j: int) -> Iterator[tuple[str, Array]]:
    """Names and axes (3,) of a leg's hinges on the base side, in series."""
    equations = home.equations[j]
    if home.machine.document.motion in PLANAR_MOTIONS:
        yield "base", BASE_FRAME_UP
        return
    if "revolute base" in equations:
        axis = joint_axis(home, "base", j)
        yield "base", BASE_FRAME_UP if axis is None else axis
    else:
        first, second = universal_hinges(home, j)
        yield "base_first", first
        yield "base_second", second
    _, offset = joint_offsets(home.machine.document).get(j, (0.0, 0.0))
    if "revolute platform" in equations or offset:
        yield "twist", home.u[j]


def _end_hinges(home: HomeState, j: int) -> tuple[tuple[str, Array], ...]:
    """Names and axes (3,) of a leg's hinges on the platform side.

    Empty where they act as a ball joint.
    """
    equations, own = home.equations[j], joint_axis(home, "platform", j)
    _, offset = joint_offsets(home.machine.document).get(j, (0.0, 0.0))
    if own is not None and offset:
        axis = home.rot @ own
        second = cross(axis, home.u[j])
        return ("platform_second", second / np.sqrt(dot(second, second))), ("platform_first", axis)
    if own is not None and "torsion" in equations:
        second = universal_hinges(home, j)[1]
        return ("platform_second", second), ("platform_first", home.rot @ own)
    if own is not None and "revolute platform" in equations:
        return (("platform", home.rot @ own),)
    return ()


def _tip(bodies: list[TreeBody], rod: TreeBody, home: HomeState, j: int) -> tuple[TreeBody, Array]:
    """Body at the rod's far end, and the end point (3,) in its frame.

    The body is the rod, or the piston that slides in it.
    """
    u, length, column = home.u[j], float(home.distance[j]), home.column(j)
    reach = length  # longest leg, m
    if home.limbs.drive[j] == TELESCOPE_ROD:
        now, _, high = home.values(column).tolist()
        reach = high + length - now if np.isfinite(high) else length
    # names of the file's tubes, and of cylinders added for display
    tubes = _tubes(home, j, reach)
    names = [f"leg{j + 1}_tube{k + 1}" for k in range(len(home.leg(j).tubes))]
    names += [f"leg{j + 1}{DISPLAY_MARK}{k + 1}" for k in range(len(tubes) - len(names))]
    if not home.length_varies(j):
        for (radius, start, stop), name in zip(tubes, names, strict=True):
            rod.shapes.append(RoundBar(start * u, min(stop, length) * u, radius, "rod", name))
        return rod, length * u
    # a telescope: all tubes but the last are the rod, the last one is the piston
    for (radius, start, stop), name in zip(tubes[:-1], names[:-1], strict=True):
        rod.shapes.append(RoundBar(start * u, stop * u, radius, "rod", name))
    place = pose(np.eye(3), length * u)
    piston = _body(bodies, TreeBody(f"leg{j + 1}_piston", rod, place, -u * length / 4, length / 2))
    if column >= 0:
        now = float(home.values(column)[0])
        piston.joints.append(BodyJoint(home.reading_name(column), "slide", u, now, column))
    else:
        piston.joints.append(BodyJoint(f"leg{j + 1}_length", "slide", u, length))
    radius, start, stop = tubes[-1]
    out = max(min(stop, reach) - start, home.size / 20)
    piston.shapes.append(RoundBar(-out * u, np.zeros(3), radius, "piston", names[-1]))
    return piston, np.zeros(3)


def _tubes(home: HomeState, j: int, reach: float) -> list[tuple[float, float, float]]:
    """Cylinders (radius, start, stop) that depict a leg, m from A.

    The leg's tubes, or thin rods for a leg without any.
    """
    length, radii = float(home.distance[j]), home.machine.radii()[j]
    tubes = [
        (float(r), float(t.start), float(t.stop))
        for r, t in zip(radii, home.leg(j).tubes, strict=True)
    ]
    if not home.length_varies(j):
        return tubes or [(length / 80, 0.0, length)]
    if not tubes:
        tubes = [(length / 60, 0.0, 0.55 * length)]
    if len(tubes) == 1:  # the piston
        tubes.append((0.6 * tubes[0][0], min(tubes[0][2], length), reach))
    return tubes
