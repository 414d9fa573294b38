"""The legs of a MuJoCo model: motors, joints, rods, and how each closes on the platform.

At home all bodies of a leg stand parallel to the base frame, so that axes and points are told
along the base's axes.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.export.mujoco_home import (
    HomeState,
    gives_way,
    joint_axis,
    longest,
    motor_axis,
    universal_axes,
)
from pkmcal.export.mujoco_platform import UP, Anchor
from pkmcal.export.mujoco_xml import LIGHT, ball, body, comment, cylinder, joint, numbers, site
from pkmcal.mechanisms.document import ActuatedLength

STIFF = 2.0e4
"""N/m of a drive's position control: with the parts' masses it settles within some 20 ms."""
DAMPED = 2.0e2
"""N s/m of a drive."""


def add_legs(
    world: Element, equality: Element, home: HomeState, anchors: tuple[Anchor, ...]
) -> None:
    """Every leg as a chain from the base, closed on the platform."""
    made: dict[int, Element] = {}
    for j in range(home.machine.n_legs):
        comment(world, words(home, j))
        parent, origin = _carrier(world, home, j, made)
        length = float(home.distance[j])
        rod = body(
            parent, f"leg{j + 1}_rod", home.a[j] - origin, LIGHT, home.u[j] * length / 2, length
        )
        for name, axis in _base_hinges(home, j):
            joint(rod, f"leg{j + 1}_{name}", "hinge", axis)
        site(rod, f"leg{j + 1}_base", np.zeros(3))
        tip = _tip(rod, home, j)
        site(tip[0], f"leg{j + 1}_tip", tip[1])
        _close(tip, equality, home, j, anchors[j])


def words(home: HomeState, j: int) -> str:
    """A leg in words."""
    leg = home.leg(j)
    length = leg.length
    rod = "a rod of constant length"
    if gives_way(home, j):
        rod = (
            "a rod that its motor moves" if isinstance(length, ActuatedLength) else "a passive rod"
        )
    out = f"Leg {j + 1}: {leg.base.joint} on the base, {rod}, {leg.platform.joint} on the platform."
    found = home.equations(j)
    if not found and home.machine.document.motion != "planar":
        out += (
            " Two hinges and a ball: its turn about its own line, which moves nothing, is left out."
        )
    if "torsion" in found:
        out += " Its universal joints keep it from twisting."
    if any("platform" in kind for kind in found):
        out += " It may turn about its own line; its equations say nothing of that."
    return out


def damping(home: HomeState, column: int) -> float:
    """Of a motor's joint, N s/m or N m s."""
    return DAMPED * lever(home, column) ** 2


def lever(home: HomeState, column: int) -> float:
    """What makes a motor's stiffness that of a slide: 1, or a crank's arm, m."""
    if home.machine.joint_units[column] == "m":
        return 1.0
    return float(np.linalg.norm(home.a_by_reading[home.motor_legs(column)[0]]))


def _carrier(
    world: Element, home: HomeState, j: int, made: dict[int, Element]
) -> tuple[Element, Array]:
    """What the leg's base joint stands on, and where that is (3,): the base, crank or carriage."""
    kind, column = home.leg(j).base.joint, int(home.machine.layout.actuated[j])
    thick = home.size / 40
    if kind in ("spherical", "universal", "revolute"):
        ball(world, home.a[j], thick, "base")
        return world, np.zeros(3)
    if kind not in ("crank", "slider"):
        raise InputError(
            f"leg {j + 1} begins in a joint that the MuJoCo export has no body for",
            found=kind,
            expected="spherical, universal, revolute, crank or slider",
        )
    at, axis = motor_axis(home, column)
    if column not in made:
        made[column] = _motor(world, home, column, at, axis)
    end = home.a[j] - at
    if kind == "crank":
        foot = (end @ axis) * axis
        cylinder(made[column], foot, end, 0.7 * thick, "motor")
    else:
        cylinder(made[column], end - 0.8 * thick * axis, end + 0.8 * thick * axis, thick, "motor")
    return made[column], at


def _motor(world: Element, home: HomeState, column: int, at: Array, axis: Array) -> Element:
    """A crank or carriage; its joint's value is the machine's reading."""
    name, thick = home.reading_name(column), home.size / 40
    turns = home.machine.joint_units[column] == "rad"
    size = lever(home, column) if turns else home.size / 10
    out = body(
        world, f"{name}_{'crank' if turns else 'carriage'}", at, LIGHT, np.zeros(3), 2 * size
    )
    reading, limits = float(home.readings[column]), home.machine.joint_ranges[column]
    joint(
        out,
        name,
        "hinge" if turns else "slide",
        axis,
        reading,
        limits,
        damping(home, column),
    )
    if turns:
        cylinder(world, at - 1.2 * thick * axis, at + 1.2 * thick * axis, thick, "base")
    elif np.isfinite(limits).all():
        low, high = (at + (q - reading) * axis for q in limits)
        cylinder(world, low, high, 0.4 * thick, "base")
    return out


def _base_hinges(home: HomeState, j: int) -> Iterator[tuple[str, Array]]:
    """Names and axes (3,) of a leg's hinges on the base side, in their order."""
    found = home.equations(j)
    if home.machine.document.motion == "planar":
        yield "base", UP
        return
    if "revolute base" in found:
        axis = joint_axis(home, "base", j)
        yield "base", UP if axis is None else axis
    else:
        first, second = universal_axes(home, j)
        yield "base_first", first
        yield "base_second", second
    if "revolute platform" in found:
        yield "twist", home.u[j]


def _tip(rod: Element, home: HomeState, j: int) -> tuple[Element, Array]:
    """The body at the rod's far end and the end in it (3,): the rod, or the piston in it."""
    tubes = _tubes(home, j)
    u, length = home.u[j], float(home.distance[j])
    names = [f"leg{j + 1}_tube{k + 1}" for k in range(len(home.leg(j).tubes))]
    names += [""] * (len(tubes) - len(names))
    if not gives_way(home, j):
        for (radius, start, stop), name in zip(tubes, names, strict=True):
            cylinder(rod, start * u, min(stop, length) * u, radius, "rod", name)
        return rod, length * u
    for (radius, start, stop), name in zip(tubes[:-1], names[:-1], strict=True):
        cylinder(rod, start * u, stop * u, radius, "rod", name)
    piston = body(rod, f"leg{j + 1}_piston", length * u, LIGHT, -u * length / 4, length / 2)
    column = int(home.machine.layout.actuated[j])
    if column >= 0:
        limits = home.machine.joint_ranges[column]
        reading, damped = float(home.readings[column]), damping(home, column)
        joint(piston, home.reading_name(column), "slide", u, reading, limits, damped)
    else:
        joint(piston, f"leg{j + 1}_length", "slide", u, length)
    radius, start, stop = tubes[-1]
    out = max(min(stop, longest(home, j)) - start, home.size / 20)
    cylinder(piston, -out * u, np.zeros(3), radius, "piston", names[-1])
    return piston, np.zeros(3)


def _tubes(home: HomeState, j: int) -> list[tuple[float, float, float]]:
    """(radius, from, to) of what is drawn of a leg, m from A: its tubes, or thin rods instead."""
    length, reach = float(home.distance[j]), longest(home, j)
    radii = home.machine.radii()[j]
    tubes = [
        (float(r), float(t.start), float(t.stop))
        for r, t in zip(radii, home.leg(j).tubes, strict=True)
    ]
    if not gives_way(home, j):
        return tubes or [(length / 80, 0.0, length)]
    if not tubes:
        tubes = [(length / 60, 0.0, 0.55 * length)]
    if len(tubes) == 1:  # what telescopes out of it
        tubes.append((0.6 * tubes[0][0], min(tubes[0][2], length), reach))
    return tubes


def _close(
    tip: tuple[Element, Array], equality: Element, home: HomeState, j: int, anchor: Anchor
) -> None:
    """The loop's closure: a ball on the platform, or hinges and a weld where axes count."""
    node, end = tip
    found = home.equations(j)
    name = f"leg{j + 1}"
    axes: list[tuple[str, Array]] = []
    own = joint_axis(home, "platform", j)
    if own is not None and "torsion" in found:
        second = universal_axes(home, j)[1]
        axes = [("platform_second", second), ("platform_first", home.rot @ own)]
    elif own is not None and "revolute platform" in found:
        axes = [("platform", home.rot @ own)]
    if not axes:
        SubElement(
            equality,
            "connect",
            name=name,
            body1=anchor.body,
            body2=str(node.get("name")),
            anchor=numbers(anchor.point),
        )
        return
    last = body(node, f"{name}_end", end, LIGHT, np.zeros(3), home.size / 10)
    for kind, axis in axes:
        joint(last, f"{name}_{kind}", "hinge", axis)
    SubElement(equality, "weld", name=name, body1=anchor.body, body2=f"{name}_end")
