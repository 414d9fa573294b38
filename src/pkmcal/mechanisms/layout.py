"""Where each limb finds its carriers, its parameters and its reading; made once from the file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.mechanisms.angles import AngleLayout, angle_layout
from pkmcal.mechanisms.carriers.contract import (
    ParameterKind,
    base_carriers,
    of_part,
    platform_carriers,
)
from pkmcal.mechanisms.motors import middles, motor_columns
from pkmcal.mechanisms.rods import ActuatedLength, PassiveLength
from pkmcal.mechanisms.schema import MechanismDocument

if TYPE_CHECKING:
    from pkmcal.mechanisms.limbs import Closure
    from pkmcal.mechanisms.rows import Rows


@dataclass(frozen=True)
class CarrierGroup:
    """The legs that one carrier kind serves.

    legs : (g,) leg numbers from 0. index : (g, n) their parameters' positions, P where the file is
    silent; there ``constants`` (g, n) has the value.
    """

    carrier: Any
    legs: Integers
    index: Integers
    constants: Array
    silent: Booleans

    @cached_property
    def complete(self) -> bool:
        """Whether the file gives every number."""
        return not self.silent.any()

    def of(self, theta: Array) -> Array:
        """The group's parameters (..., g, n) out of all, (..., P)."""
        if self.complete:
            return theta[..., self.index]
        known = theta[..., np.where(self.silent, 0, self.index)]
        return np.where(self.silent, self.constants, known)


@dataclass(frozen=True)
class LimbLayout:
    """Where each leg finds its parameters; made once from the document.

    base, platform : groups of legs by carrier.
    rod : (L,) position of each rod's offset or constant length, -1 for a passive rod.
    closing : (L,) legs whose length is an equation; all but the passive ones.
    actuated : (L,) the reading's column, -1 for a leg without; middle : (L,) its mid-range.
    internal : (L,) the column of the platform carrier's internal coordinate, -1 without.
    rod_reads : (L,) whether the reading is the rod's own length (and not the carrier's motion).
    base_axis, platform_axis : (L, 3) positions of the axes' parameters, -1 where none is one.
    angles : the axes' equations. turning : positions (n, 3) of all directions among the
    parameters that turn with the base frame, and with the platform frame.
    radius : list of (tubes,) positions of each leg's radii.
    motion : (6, d) directions in which the platform moves. n_parameters : P.
    """

    n_legs: int
    base: tuple[CarrierGroup, ...]
    platform: tuple[CarrierGroup, ...]
    rod: Integers
    closing: Booleans
    actuated: Integers
    middle: Array
    internal: Integers
    rod_reads: Booleans
    base_axis: Integers
    platform_axis: Integers
    angles: AngleLayout
    turning: tuple[Integers, Integers]
    radius: tuple[Integers, ...]
    motion: Array
    n_parameters: int

    @cached_property
    def n_equations(self) -> int:
        """Rows of the closure: lengths, then angles."""
        return int(self.closing.sum()) + len(self.angles)

    @cached_property
    def all_close(self) -> bool:
        """Whether the length of every leg is an equation."""
        return bool(self.closing.all())

    @cached_property
    def driven_rows(self) -> Integers:
        """Rows of the closure that belong to legs with a reading, in the legs' order."""
        return np.flatnonzero(self.actuated[self.closing] >= 0)

    @cached_property
    def n_readings(self) -> int:
        """Readings of a configuration, m."""
        return int(self.actuated.max(initial=-1)) + 1

    @cached_property
    def n_internal(self) -> int:
        """Internal coordinates of a pose."""
        return int(self.internal.max(initial=-1)) + 1

    @cached_property
    def row_motor(self) -> Integers:
        """The reading's column that enters each row of the closure, (E,), -1 where none."""
        angles = np.full(len(self.angles), -1)
        return np.concatenate([self.actuated[self.closing], angles])

    @cached_property
    def shares_motors(self) -> bool:
        """Whether a reading enters several rows."""
        return self.driven_rows.size > self.n_readings

    @cached_property
    def own_motion(self) -> Array:
        """(6 + n, d + n): the pose's directions, then its internal coordinates."""
        n, d = self.n_internal, self.motion.shape[1]
        out = np.eye(6 + n, d + n)
        out[:6, :d], out[6:, d:] = self.motion, np.eye(n)
        out[:6, d:], out[6:, :d] = 0.0, 0.0
        return out

    @cached_property
    def free(self) -> Booleans:
        """(6,) which of (omega, tau) the motion has."""
        return np.asarray(self.motion.any(axis=1))

    @cached_property
    def freedoms(self) -> slice:
        """The same as a slice of the six."""
        used = np.flatnonzero(self.free)
        return slice(int(used[0]), int(used[-1]) + 1)

    def by_own(self, rows: Closure | Rows) -> Array:
        """Rows (..., E, d + n) by the pose's own freedoms, internal coordinates last."""
        by_pose = rows.by_pose[..., self.freedoms]
        if not self.n_internal:
            return by_pose
        return np.concatenate([by_pose, rows.by_internal], axis=-1)


MOTIONS: dict[str, Array] = {
    "spatial": np.eye(6),
    "planar": np.eye(6)[:, [2, 3, 4]],
    "translation": np.eye(6)[:, 3:],
    "schoenflies": np.eye(6)[:, 2:],
}
"""Columns: the directions (omega, tau) in which the platform can move, base frame; neighbours."""


def layout_of(document: MechanismDocument, positions: dict[str, int]) -> LimbLayout:
    """The layout of a document whose parameters stand at ``positions``."""
    legs = document.legs
    carriers = base_carriers()
    reads = np.array([isinstance(leg.length, ActuatedLength) for leg in legs])
    closing = np.array([not isinstance(leg.length, PassiveLength) for leg in legs])
    base_axis, platform_axis = (_axis_index(document, s, positions) for s in ("base", "platform"))
    return LimbLayout(
        n_legs=len(legs),
        base=_groups(document, "base", carriers, positions),
        platform=_groups(document, "platform", platform_carriers(), positions),
        rod=np.array([_rod_index(j, leg.length, positions) for j, leg in enumerate(legs)]),
        closing=closing,
        actuated=motor_columns(document),
        middle=middles(document),
        internal=_internal(document),
        rod_reads=reads,
        base_axis=base_axis,
        platform_axis=platform_axis,
        angles=angle_layout(document, base_axis, platform_axis),
        turning=(_turning("base", positions), _turning("platform", positions)),
        radius=tuple(
            np.array(
                [positions[f"legs[{j + 1}].tubes[{t + 1}].radius"] for t in range(len(leg.tubes))],
                dtype=int,
            )
            for j, leg in enumerate(legs)
        ),
        motion=MOTIONS[document.motion],
        n_parameters=len(positions),
    )


def _axis_index(document: MechanismDocument, side: str, positions: dict[str, int]) -> Integers:
    """Positions (L, 3) of the axes' parameters on one side, -1 where there is none."""
    names = [[f"legs[{j + 1}].{side}.axis.{c}" for c in "xyz"] for j in range(len(document.legs))]
    return np.array([[positions.get(name, -1) for name in row] for row in names], dtype=int)


def _turning(side: str, positions: dict[str, int]) -> Integers:
    """Positions (n, 3) of the directions on one side, whoever has them; three in a row."""
    first = [k for name, k in positions.items() if f".{side}." in name and name.endswith("axis.x")]
    return np.array(first, dtype=int)[:, None] + np.arange(3)


def _rod_index(leg: int, length: Any, positions: dict[str, int]) -> int:
    if isinstance(length, PassiveLength):
        return -1
    field = "offset" if isinstance(length, ActuatedLength) else "constant"
    return positions[f"legs[{leg + 1}].length.{field}"]


def _groups(
    document: MechanismDocument, side: str, carriers: dict[str, Any], positions: dict[str, int]
) -> tuple[CarrierGroup, ...]:
    nodes = [getattr(leg, side) for leg in document.legs]
    kinds = [carriers[node.joint] for node in nodes]
    groups: list[CarrierGroup] = []
    for kind in dict.fromkeys(kinds):
        legs = np.flatnonzero([k is kind for k in kinds])
        names = [[f"legs[{j + 1}].{side}.{p.path}" for p in kind.parameters] for j in legs]
        index = np.array([[positions.get(n, len(positions)) for n in row] for row in names])
        constants = np.array([[_constant(nodes[j], p) for p in kind.parameters] for j in legs])
        groups.append(CarrierGroup(kind, legs, index, constants, index == len(positions)))
    return tuple(groups)


def _constant(node: Any, kind: ParameterKind) -> float:
    value = of_part(node, kind)
    return kind.otherwise if value is None else value


def _internal(document: MechanismDocument) -> Integers:
    """The column of each leg's internal coordinate, by its bar; -1 without."""
    carriers = platform_carriers()
    nodes = [leg.platform for leg in document.legs]
    bars = [node.bar if carriers[node.joint].turns else None for node in nodes]
    known = sorted({bar for bar in bars if bar is not None})
    return np.array([-1 if bar is None else known.index(bar) for bar in bars], dtype=int)
