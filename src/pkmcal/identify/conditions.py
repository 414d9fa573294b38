"""Identifiability conditions of [A] 10-12, 15 and 17: number of equations against unknowns.

The conditions are necessary at most, because products and distances of coplanar joints are counted
twice (12 equations of rank 11 occur, and failing counts at full rank; errata). The rank of the
Jacobian is the actual test; these counts are for comparison with the paper.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Booleans, Integers
from pkmcal.identify.nominal_joints import nominal_joints
from pkmcal.identify.unidentified import Condition
from pkmcal.mechanisms import Machine
from pkmcal.wording import named


def conditions(machine: Machine, visible: Booleans) -> tuple[Condition, ...]:
    """All conditions for a machine and the legs that each station sees in one image, (S, L).

    Necessary at most, see the module.
    """
    out = [
        every_leg(visible),
        base(machine, visible),
        offsets_condition(machine, visible),
        platform(machine, visible),
    ]
    return (*out, *at_once(machine, visible))


def every_leg(visible: Booleans) -> Condition:
    """[A] 3.3, first condition: at least one station sees each leg."""
    lost = np.flatnonzero(~visible.any(axis=0))
    text = "every leg is seen by a station"
    if lost.size:
        text += f"; none sees {named(lost)}"
    return _condition("3.3", visible.shape[1], int(visible.any(axis=0).sum()), text)


def base(machine: Machine, visible: Booleans) -> Condition:
    """[A] 12 with 11 (spatial) or 10 (planar): products of the base joints' vectors.

    Unknowns: 3 + 3(n - 3) + 2r of n centres and r revolute axes. Planar, as printed 2 + 2(n - 2);
    corrected 1 + 2(n - 2), as in 17: two centres have one distance. Equations: sum over stations of
    C(n, 2) + C(r, 2) + r(n - 1). The axes of a planar machine are all its normal; their products do
    not depend on the points in the plane and are not counted.
    """
    n, legs = visible.shape[1], nominal_joints(machine)
    count = visible.sum(axis=1)
    if legs.planar:
        text = "products of vectors between base joints, for their places in the plane"
        return _condition("10, 12", 1 + 2 * (n - 2), int(_pairs(count).sum()), text)
    revolute = legs.base_revolute
    r = (visible & revolute).sum(axis=1)
    available = _pairs(count) + _pairs(r) + r * np.maximum(count - 1, 0)
    needed = 3 + 3 * (n - 3) + 2 * int(revolute.sum())
    text = "products of vectors between base joints and revolute axes, for centres and axes"
    return _condition("11, 12", needed, int(available.sum()), text)


def offsets_condition(machine: Machine, visible: Booleans) -> Condition:
    """[A] 15: distances between platform joints against offsets and constant lengths."""
    closing = machine.layout.closing
    available = int(_pairs((visible & closing).sum(axis=1)).sum())
    text = "distances between platform joints of legs with a length, for their offsets"
    return _condition("15", int(closing.sum()), available, text)


def platform(machine: Machine, visible: Booleans) -> Condition:
    """[A] 17: distances between platform joints against the platform's centres.

    E = 3 + 3(n - 3) spatial, 1 + 2(n - 2) planar; n is the number of legs with a length, because
    the centre of a passive leg follows from 19.
    """
    closing = machine.layout.closing
    n = int(closing.sum())
    needed = 1 + 2 * (n - 2) if nominal_joints(machine).planar else 3 + 3 * (n - 3)
    available = int(_pairs((visible & closing).sum(axis=1)).sum())
    text = "distances between platform joints of legs with a length, for their places"
    return _condition("17", needed, available, text)


def at_once(machine: Machine, visible: Booleans) -> tuple[Condition, ...]:
    """[A] 3.5: three legs with a length in one image with each passive leg and platform axis.

    Legs with a revolute joint count among the three themselves, passive legs do not.
    """
    legs = nominal_joints(machine)
    count = (visible & legs.closing).sum(axis=1)
    out: list[Condition] = []
    for j in np.flatnonzero(~legs.closing | legs.platform_revolute):
        passive = not legs.closing[j]
        most = int(np.max(np.where(visible[:, j], count, 0), initial=0))
        what = f"passive leg {j + 1}" if passive else f"the revolute axis of leg {j + 1}"
        text = f"legs with a length seen at once, for {what} on the platform"
        out.append(_condition("19" if passive else "18", 3, most, text))
    return tuple(out)


def _condition(equation: str, needed: int, available: int, text: str) -> Condition:
    return Condition(f"[A] {equation}", needed, available, needed <= available, text)


def _pairs(n: Integers) -> Integers:
    """Number of pairs, C(n, 2)."""
    return n * (n - 1) // 2
