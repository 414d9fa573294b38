"""Limbs of a machine as elementary joints, for C sources, multibody models and firmwares.

Carriers state the elementary joint that moves a limb's end (:class:`Chain`), so no format knows
the joint kinds of mechanism files by name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import Chain
from pkmcal.mechanisms.closure import scales
from pkmcal.mechanisms.layout import CarrierGroup

CONSTANT_ROD, TELESCOPE_ROD, SLIDE_CARRIER, TURN_CARRIER = "constant", "telescope", "slide", "turn"
FIXED_CARRIER, FLOAT_CARRIER = "fixed", "float"


@dataclass(frozen=True)
class Limbs:
    """Limbs (L of them) as arrays, m and rad.

    leg : (L,) number in the mechanism file, from 1.
    drive : what the reading moves: the rod's length, its base end along or about an axis, or
        nothing.
    joint : (L,) column of the reading, -1 without.
    scale : (L,) displacement = scale * reading.
    length : (L,) length of the rod, of a telescope at reading zero; NaN for a passive rod.
    base : (L, 3) base frame; the fixed end, the sliding end at reading zero, or the foot of a
        turning end's arm on the axis.
    axis : (L, 3) unit vectors.
    arm : (L, 3) from the foot to the end at reading zero, perpendicular to the axis; zero if
        nothing turns.
    held : body of the platform end: the platform (``fixed``), or a bar that turns on it (``turn``)
        or keeps its direction (``float``).
    platform : (L, 3) platform frame; the end, or the hinge of the bar.
    bar : (L, 3) from hinge to end; platform frame at angle zero, or base frame for ``float``.
    hinge : (L,) column of the bar's angle, -1 without.
    hinge_axis : (L, 3) unit vectors, platform frame.
    growth : (L,) m/rad, of a screw that the joints turn: lead / (2 pi); 0 without.
    screw_base, screw_platform : (L, 3) unit vectors, base and platform frame; a screw's axes, zero
        without.
    """

    leg: Integers
    drive: tuple[str, ...]
    joint: Integers
    scale: Array
    length: Array
    base: Array
    axis: Array
    arm: Array
    held: tuple[str, ...]
    platform: Array
    bar: Array
    hinge: Integers
    hinge_axis: Array
    growth: Array
    screw_base: Array
    screw_platform: Array

    def __len__(self) -> int:
        return len(self.leg)

    @property
    def rate(self) -> Array:
        """Derivative of the base end by the motor's displacement, at zero, (L, 3)."""
        slides = np.array([drive == SLIDE_CARRIER for drive in self.drive])
        return np.where(slides[:, None], self.axis, cross(self.axis, self.arm))

    @property
    def ends(self) -> Array:
        """Platform ends (L, 3), platform frame; the hinge for a floating bar."""
        turns = np.array([held == TURN_CARRIER for held in self.held])
        return np.where(turns[:, None], self.platform + self.bar, self.platform)

    def of(self, limbs: Integers) -> Limbs:
        """Subset of the limbs, by index."""

        def chosen(values: Any) -> Any:
            return tuple(values[k] for k in limbs) if isinstance(values, tuple) else values[limbs]

        return replace(self, **{name: chosen(value) for name, value in vars(self).items()})


def all_limbs(machine: Machine) -> Limbs:
    """All limbs of a machine. Raises InputError for a carrier that is no elementary joint."""
    layout, values = machine.layout, machine.parameters.unit_axes(machine.values)
    base, axis, arm, shifted = _chains(
        machine, "base", layout.base, (FIXED_CARRIER, SLIDE_CARRIER, TURN_CARRIER)
    )
    hinge, hinge_axis, bar, held = _chains(
        machine, "platform", layout.platform, (FIXED_CARRIER, TURN_CARRIER, FLOAT_CARRIER)
    )
    # an arm that does not turn is part of the base point, and so is the axial part of one that
    # turns
    turns = np.array([kind == TURN_CARRIER for kind in shifted])[:, None]
    along = np.where(turns, dot(axis, arm)[:, None] * axis, arm)
    # a platform end on the platform itself has no bar; its offset is part of the point
    barred = np.array([kind != FIXED_CARRIER for kind in held])[:, None]
    driven = np.where(layout.rod_reads, TELESCOPE_ROD, shifted)
    rods = np.where(layout.rod >= 0, layout.rod, 0)
    growth, screw_axes = np.zeros(machine.n_legs), np.zeros((2, machine.n_legs, 3))
    screws = layout.screws
    growth[screws.leg] = screws.lead / (2 * np.pi)
    screw_axes[:, screws.leg] = values[screws.base], values[screws.platform]
    return Limbs(
        leg=np.arange(machine.n_legs) + 1,
        drive=tuple(np.where(layout.actuated >= 0, driven, CONSTANT_ROD).tolist()),
        joint=layout.actuated,
        scale=scales(layout, machine.values),
        length=np.where(layout.rod >= 0, values[rods], np.nan),
        base=base + along,
        axis=axis,
        arm=arm - along,
        held=held,
        platform=hinge + np.where(barred, 0.0, bar),
        bar=np.where(barred, bar, 0.0),
        hinge=layout.internal,
        hinge_axis=hinge_axis,
        growth=growth,
        screw_base=screw_axes[0],
        screw_platform=screw_axes[1],
    )


def rod_limbs(machine: Machine) -> Limbs:
    """Limbs of known length; passive ones move nothing.

    Raises InputError if they and the joints' axes do not determine the platform exactly.
    """
    layout = machine.layout
    unknowns = layout.motion.shape[1] + layout.n_internal
    if layout.n_equations != unknowns:
        raise InputError(
            f"the rods and axes of mechanism {machine.name!r} do not fix its platform exactly",
            found=f"{layout.n_equations} equations for {unknowns} unknowns",
            expected="as many of both, for Newton's method",
            code="export.not_determined",
        )
    return all_limbs(machine).of(np.flatnonzero(layout.closing))


def _chains(
    machine: Machine, side: str, groups: tuple[CarrierGroup, ...], names: tuple[str, ...]
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Points, axes and arms (L, 3) of the joints on one side, and their motions."""
    values = machine.parameters.unit_axes(machine.values)
    point, axis, arm = np.zeros((3, machine.n_legs, 3))
    motion = [""] * machine.n_legs
    for group in groups:
        chain: Chain | None = group.carrier.chain(group.of(values))
        if chain is None or chain.motion not in names:
            leg = int(group.legs[0])
            raise InputError(
                f"leg {leg + 1} of mechanism {machine.name!r} is carried on its {side} side by no"
                " joint that can be exported",
                found=getattr(machine.document.legs[leg], side).joint,
                expected="a joint that is one of " + ", ".join(names),
                next_step="Give its carrier a chain, see docs/export.md",
                code="export.no_chain",
            )
        point[group.legs], axis[group.legs], arm[group.legs] = chain.point, chain.axis, chain.arm
        for leg in group.legs:
            motion[leg] = chain.motion
    return point, axis, arm, tuple(motion)
