"""The platform of a MuJoCo model: one body, its freedoms by the machine's motion, and its bars."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.export.mujoco_home import SAME, HomeState, part_values, unit
from pkmcal.export.mujoco_xml import LIGHT, PLATFORM, body, comment, cylinder, joint, numbers, site
from pkmcal.geometry.rigid import inverse, rotation, rotation_vector
from pkmcal.papers.hand_eye import quaternion

UP = np.array([0.0, 0.0, 1.0])
WHY_RESTRICTED = {
    "planar": "The platform stays in the plane by its own two slides and its hinge.",
    "translation": "The platform keeps its direction by its own three slides, which stand for the "
    "parallelograms or axes that hold it.",
    "schoenflies": "The platform stays upright by its own three slides and its hinge, which stand "
    "for the parallelograms that hold it.",
}


@dataclass(frozen=True)
class Anchor:
    """Where a leg is held: the body's name, and the point (3,) in that body's frame, m."""

    body: str
    point: Array


def add_platform(world: Element, equality: Element, home: HomeState) -> tuple[Anchor, ...]:
    """The platform with its bars; returns where each leg is held."""
    t = home.T_base_platform[:3, 3]
    motion = home.machine.document.motion
    centres = _mean(home)
    comment(world, WHY_RESTRICTED.get(motion, "The platform has all six freedoms."))
    platform = body(world, "platform", t, PLATFORM, centres, 2.4 * home.radius)
    _turned(platform, home.rot)
    if motion == "spatial":
        SubElement(platform, "freejoint", name="platform")
    else:
        _restricted(platform, home, motion)
    anchors = _bars(platform, equality, home, motion)
    thick = home.size / 60
    for j, anchor in enumerate(anchors):
        of = platform if anchor.body == "platform" else _find(platform, anchor.body)
        cylinder(of, centres if of is platform else np.zeros(3), anchor.point, thick, "platform")
        site(of, f"leg{j + 1}_platform", anchor.point)
    return anchors


def _mean(home: HomeState) -> Array:
    """The joints' middle in the platform's frame (3,)."""
    T_platform_base = inverse(home.T_base_platform)
    return T_platform_base[:3, :3] @ home.b.mean(axis=0) + T_platform_base[:3, 3]


def _turned(node: Element, rot: Array) -> None:
    """The body's orientation in its parent, where it is not the parent's own."""
    if np.abs(rot - np.eye(3)).max() > 1e-15:  # rounding is no turn
        node.set("quat", numbers(quaternion(rot)))


def turn_of(rot: Array) -> float:
    """The angle (rad) of a turn about z; zero for any other orientation, which is then counted
    from.
    """
    omega = rotation_vector(rot)
    return float(omega[2]) if np.abs(omega[:2]).max() < SAME else 0.0


def _restricted(platform: Element, home: HomeState, motion: str) -> None:
    """Slides whose values are the platform's place in the base frame, and a hinge about z."""
    own = home.rot.T  # joints' axes are told in the body's frame
    t = home.T_base_platform[:3, 3]
    for k, axis in enumerate("xy" if motion == "planar" else "xyz"):
        joint(platform, f"platform_{axis}", "slide", own[:, k], float(t[k]))
    if motion != "translation":
        joint(platform, "platform_turn", "hinge", own[:, 2], turn_of(home.rot))


def _bars(platform: Element, equality: Element, home: HomeState, motion: str) -> tuple[Anchor, ...]:
    """Anchors of all legs; side bars are made as legs ask for them."""
    out: list[Anchor] = []
    known: dict[int, dict[str, Array]] = {}
    for j in range(home.machine.n_legs):
        kind, values = home.leg(j).platform.joint, part_values(home, "platform", j)
        if kind in ("spherical", "universal", "revolute"):
            out.append(Anchor("platform", values["center"]))
            continue
        if kind not in ("bar", "hinged-bar"):
            raise InputError(
                f"leg {j + 1} ends in a joint that the MuJoCo export has no body for",
                found=kind,
                expected="spherical, universal, revolute, bar or hinged-bar",
            )
        number = home.leg(j).platform.bar
        name = f"bar{number}"
        if number not in known:
            known[number] = values
            _bar(platform, equality, home, j, motion)
        elif any(
            np.abs(values[f] - known[number][f]).max() > SAME for f in values if f != "center"
        ):
            raise InputError(
                f"leg {j + 1} has another hinge than the other legs on its bar, and one MuJoCo "
                "body has one",
                where=home.machine.name,
                next_step="tie the hinges of all legs on one bar",
            )
        out.append(Anchor(name, values["center"]))
    return tuple(out)


def _bar(platform: Element, equality: Element, home: HomeState, j: int, motion: str) -> None:
    """A side bar, hinged on the platform: free, or held in its direction."""
    values = part_values(home, "platform", j)
    name = f"bar{home.leg(j).platform.bar}"
    reach = float(np.linalg.norm(values["center"]))
    cylinder(platform, _mean(home), values["hinge"], home.size / 60, "motor")
    bar = body(platform, name, values["hinge"], LIGHT, np.zeros(3), 2 * reach)
    if home.leg(j).platform.joint == "hinged-bar":
        axis, phi = unit(values["axis"]), float(home.internal[home.machine.layout.internal[j]])
        _turned(bar, rotation(phi * axis))
        joint(bar, f"{name}_turn", "hinge", axis, phi)
        return
    _turned(bar, home.rot.T)
    if motion == "translation":
        return
    joint(bar, f"{name}_turn", "hinge", UP)
    comment(
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


def _find(platform: Element, name: str) -> Element:
    return next(node for node in platform.iter("body") if node.get("name") == name)
