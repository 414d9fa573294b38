"""The numbers of a machine that its C source holds: both ends of each rod, lengths, joints' axes.

Every end is a sum of fixed vectors times a few functions of a reading, a pose or a hinge:
``A = base``, ``base + q along`` or ``foot + arm (cos Q outward + sin Q sideways)`` and
``B = t + float + R (arm + cos phi arm_cos + sin phi arm_sin)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.bars import Bar, HingedBar
from pkmcal.mechanisms.carriers.crank import Crank
from pkmcal.mechanisms.carriers.fixed import FixedPoint
from pkmcal.mechanisms.carriers.rigid import RigidPlatform
from pkmcal.mechanisms.carriers.slider import Slider
from pkmcal.mechanisms.joints import equations

KINDS = {FixedPoint: 0, Slider: 1, Crank: 2}
FIXED, SLIDER, CRANK = range(3)
ANGLE_KINDS = {"revolute base": 0, "revolute platform": 1, "torsion": 2}


@dataclass(frozen=True)
class Tables:
    """Numbers by rod (L of them: passive legs have none), m and rad.

    leg : (L,) each rod's leg in the mechanism file, from 1. kind : (L,) of the base's carrier.
    base : (L, 3) fixed end, a slider's place at reading zero, or the foot of a crank's arm.
    along : (L, 3) a slider's axis. outward, sideways : (L, 3) of a crank at angle zero and pi/2.
    arm, angle : (L,) a crank's. arm_fixed, arm_cos, arm_sin : (L, 3) platform side, platform frame.
    floating : (L, 3) along the base frame's axes. length : (L,) offset or constant length.
    joint : (L,) column of the reading, -1 without. reads : (L,) the reading is the rod's length.
    hinge : (L,) column of the hinge, -1 without; hinge_axis : (L, 3) unit, platform frame.
    middle : (L,) mid-range.
    freedoms : which of omega_x, …, tau_z the platform has. radius : m, of the platform.
    size : m, of the longest rod. angle_* : rod, kind and axes of each axis' equation.
    ranges : (m, 2), NaN where the file is silent. home : (4, 4).
    """

    leg: Integers
    kind: Integers
    base: Array
    along: Array
    outward: Array
    sideways: Array
    arm: Array
    angle: Array
    arm_fixed: Array
    arm_cos: Array
    arm_sin: Array
    floating: Array
    length: Array
    joint: Integers
    reads: Booleans
    hinge: Integers
    hinge_axis: Array
    middle: Array
    freedoms: tuple[int, ...]
    radius: float
    size: float
    angle_rod: Integers
    angle_kind: Integers
    angle_base: Array
    angle_platform: Array
    ranges: Array
    home: Array

    @property
    def n_rods(self) -> int:
        """Rods of a length that is known."""
        return len(self.leg)

    @property
    def n_joints(self) -> int:
        """Readings."""
        return len(self.ranges)

    @property
    def hinge_axes(self) -> Array:
        """Unit axes of the hinges, one each (h, 3), platform frame."""
        first = [int(np.flatnonzero(self.hinge == k)[0]) for k in range(self.n_hinges)]
        return self.hinge_axis[first]

    @property
    def n_hinges(self) -> int:
        """Hinges of an articulated platform."""
        return int(self.hinge.max(initial=-1)) + 1

    @property
    def n_equations(self) -> int:
        """Rows of the closure."""
        return self.n_rods + len(self.angle_rod)

    @property
    def n_unknowns(self) -> int:
        """The platform's freedoms and hinges."""
        return len(self.freedoms) + self.n_hinges

    @property
    def shared(self) -> bool:
        """Whether a motor moves several rods."""
        return int(np.count_nonzero(self.joint >= 0)) > self.n_joints


def tables_of(machine: Machine) -> Tables:
    """The machine's numbers; InputError where the C source has no formula for a part."""
    layout, values = machine.layout, machine.parameters.unit_axes(machine.values)
    base, platform = _base_side(machine, values), _platform_side(machine, values)
    rods = np.flatnonzero(layout.closing)
    rod_of = {int(leg): k for k, leg in enumerate(rods)}
    found = [(rod_of[j], ANGLE_KINDS[kind]) for j, kind in equations(machine.document)]
    home = machine.home()
    out = Tables(
        leg=rods + 1,
        **{name: value[rods] for name, value in (base | platform).items()},
        length=values[layout.rod[rods]],
        joint=layout.actuated[rods],
        reads=layout.rod_reads[rods],
        hinge=layout.internal[rods],
        middle=layout.middle[rods],
        freedoms=tuple(int(k) for k in np.argmax(layout.motion, axis=0)),
        radius=_radius(platform["arm_fixed"] + platform["arm_cos"]),
        size=_size(machine, home),
        angle_rod=np.array([k for k, _ in found], dtype=int),
        angle_kind=np.array([kind for _, kind in found], dtype=int),
        angle_base=np.nan_to_num(machine.base_axes())[layout.angles.leg],
        angle_platform=np.nan_to_num(machine.platform_axes())[layout.angles.leg],
        ranges=machine.joint_ranges,
        home=home,
    )
    if out.n_equations != out.n_unknowns:
        raise InputError(
            f"the rods and axes of mechanism {machine.name!r} do not just hold its platform",
            found=f"{out.n_equations} equations for {out.n_unknowns} unknowns",
            expected="as many of both, for Newton's method",
        )
    return out


def _base_side(machine: Machine, values: Array) -> dict[str, Any]:
    n = machine.n_legs
    vectors: dict[str, Any] = {
        name: np.zeros((n, 3)) for name in ("base", "along", "outward", "sideways")
    }
    out: dict[str, Any] = {
        "kind": np.zeros(n, dtype=int),
        "arm": np.ones(n),
        "angle": np.zeros(n),
        **vectors,
    }
    for group in machine.layout.base:
        legs, p, carrier = group.legs, group.of(values), group.carrier
        if carrier not in KINDS:
            raise _unknown(machine, legs)
        out["kind"][legs] = KINDS[carrier]
        out["base"][legs] = p[:, :3]
        if carrier is Slider:
            out["along"][legs] = p[:, 3:6]
        if carrier is Crank:
            ends = [carrier.point(p, turn - p[:, 7]).value for turn in (0.0, np.pi / 2, np.pi)]
            foot, arm = (ends[0] + ends[2]) / 2, p[:, 6, None]
            out["arm"][legs], out["angle"][legs] = p[:, 6], p[:, 7]
            out["base"][legs] = foot
            out["outward"][legs] = (ends[0] - ends[2]) / 2 / arm
            out["sideways"][legs] = (ends[1] - foot) / arm
    return out


def _platform_side(machine: Machine, values: Array) -> dict[str, Any]:
    n = machine.n_legs
    names = ("arm_fixed", "arm_cos", "arm_sin", "floating", "hinge_axis")
    out: dict[str, Any] = {name: np.zeros((n, 3)) for name in names}
    for group in machine.layout.platform:
        legs, p = group.legs, group.of(values)
        if group.carrier is RigidPlatform:
            out["arm_fixed"][legs] = p[:, :3]
        elif group.carrier is Bar:
            out["floating"][legs], out["arm_fixed"][legs] = p[:, :3], p[:, 3:6]
        elif group.carrier is HingedBar:
            w = p[:, 6:] / np.linalg.norm(p[:, 6:], axis=1, keepdims=True)
            high = w * np.sum(w * p[:, :3], axis=1, keepdims=True)
            out["hinge_axis"][legs] = w
            out["arm_fixed"][legs] = p[:, 3:6] + high
            out["arm_cos"][legs] = p[:, :3] - high
            out["arm_sin"][legs] = np.cross(w, p[:, :3])
        else:
            raise _unknown(machine, legs)
    return out


def _unknown(machine: Machine, legs: Integers) -> InputError:
    return InputError(
        "the C source has no formula for a joint of this machine",
        where=f"mechanism {machine.name!r}, legs[{int(legs[0]) + 1}]",
        expected="fixed joints, sliders, cranks, rigid platforms or bars",
    )


def _radius(arms: Array) -> float:
    """Root mean square distance of the platform's joints from their mean, m; 1 for none."""
    spread = arms - arms.mean(axis=0)
    radius = float(np.sqrt(np.mean(np.sum(spread**2, axis=1))))
    return radius if radius > 0 else 1.0


def _size(machine: Machine, home: Array) -> float:
    """The longest rod or arm at home, m: what rounding is measured by."""
    a = np.abs(machine.base_centers()).max()
    return float(max(a, np.abs(home[:3, 3]).max(), np.abs(machine.platform_centers()).max()))
