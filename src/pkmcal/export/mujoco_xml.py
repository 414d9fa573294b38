"""Elements of a MuJoCo model (MJCF): bodies, joints, shapes; numbers to the last digit."""

from __future__ import annotations

from xml.etree.ElementTree import Comment, Element, SubElement

import numpy as np

from pkmcal.arrays import Array

LIGHT = 0.1
"""kg of a part: a placeholder, since photographs weigh nothing."""
PLATFORM = 1.0
COLOURS = {
    "base": "0.35 0.35 0.38 1",
    "rod": "0.55 0.60 0.68 1",
    "piston": "0.80 0.82 0.85 1",
    "motor": "0.20 0.45 0.70 1",
    "platform": "0.85 0.45 0.20 1",
}


def numbers(*values: float | Array) -> str:
    """Numbers to the last digit, or the 16th behind the point; no negative zeros."""
    flat = np.concatenate([np.atleast_1d(np.asarray(v, dtype=float)).ravel() for v in values])
    return " ".join(repr(round(float(v), 16) + 0.0) for v in flat)


def body(parent: Element, name: str, at: Array, mass: float, middle: Array, size: float) -> Element:
    """A body at a point (3,) of its parent's frame.

    middle : (3,) its centre of mass. size : m, of a rod of that length; placeholders.
    """
    out = SubElement(parent, "body", name=name, pos=numbers(at))
    inertia = np.full(3, mass * size**2 / 12)
    SubElement(
        out, "inertial", pos=numbers(middle), mass=numbers(mass), diaginertia=numbers(inertia)
    )
    return out


def joint(
    parent: Element,
    name: str,
    kind: str,
    axis: Array,
    ref: float = 0.0,
    limits: Array | None = None,
    damping: float | None = None,
) -> None:
    """A ``hinge`` or ``slide`` at the body's origin; ``ref`` is its value as drawn (m, rad)."""
    out = SubElement(parent, "joint", name=name, type=kind, axis=numbers(axis))
    if ref:
        out.set("ref", numbers(ref))
    if limits is not None and np.isfinite(limits).all():
        out.set("limited", "true")
        out.set("range", numbers(limits))
    if damping is not None:
        out.set("damping", numbers(damping))


def cylinder(
    parent: Element, start: Array, stop: Array, radius: float, look: str, name: str | None = None
) -> None:
    """A round bar between two points (3,) of the body's frame."""
    if np.linalg.norm(stop - start) < radius / 10:  # MuJoCo takes no cylinder without a length
        return
    geom = SubElement(
        parent,
        "geom",
        type="cylinder",
        fromto=numbers(start, stop),
        size=numbers(radius),
        rgba=COLOURS[look],
    )
    if name:
        geom.set("name", name)


def ball(parent: Element, at: Array, radius: float, look: str) -> None:
    """A ball at a point (3,)."""
    SubElement(
        parent, "geom", type="sphere", pos=numbers(at), size=numbers(radius), rgba=COLOURS[look]
    )


def site(parent: Element, name: str, at: Array) -> None:
    """A named point (3,) of a body."""
    SubElement(parent, "site", name=name, pos=numbers(at))


def comment(parent: Element, text: str) -> None:
    """A sentence for people."""
    parent.append(Comment(f" {plain(text)} "))


def plain(text: str) -> str:
    """Text that may stand in an XML comment: printable, and no two hyphens in a row."""
    text = "".join(c for c in text if c.isprintable())
    while "--" in text:
        text = text.replace("--", "- -")
    return f"{text} " if text.endswith("-") else text
