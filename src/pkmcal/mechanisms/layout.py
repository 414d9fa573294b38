"""Where each limb finds its carriers, its parameters and its reading: made once from the file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.mechanisms.carriers.contract import base_carriers, of_part, platform_carriers
from pkmcal.mechanisms.document import (
    MOTION_DIRECTIONS,
    ActuatedLength,
    MechanismDocument,
    PassiveLength,
)
from pkmcal.mechanisms.joints import JOINT_AXIS_KINDS, AngleLayout, angle_layout
from pkmcal.mechanisms.motors import bodies, middles, motor_columns


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
        reference_values = theta[..., np.where(self.silent, 0, self.index)]
        return np.where(self.silent, self.constants, reference_values)


@dataclass(frozen=True)
class LimbLayout:
    """Where each leg finds its parameters; made once from the document.

    base, platform : groups of legs by carrier.
    rod : (L,) position of each rod's offset or constant length, -1 for a passive rod.
    closing : (L,) legs whose length is an equation; all but the passive ones.
    actuated : (L,) the reading's column, -1 for a leg without; middle : (L,) its mid-range.
    internal : (L,) the column of the platform carrier's internal coordinate, -1 without.
    rod_reads : (L,) whether the reading is the rod's own length (and not the carrier's motion).
    scale : (L,) position of each reading's scale, P where it is exact; there ``exact_scale`` (L,)
    has the value, which is 1 for a leg without a reading.
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
    scale: Integers
    exact_scale: Array
    base_axis: Integers
    platform_axis: Integers
    angles: AngleLayout
    turning: tuple[Integers, Integers]
    radius: tuple[Integers, ...]
    motion: Array
    n_parameters: int

    __repr__ = short_repr

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
    def row_is_rod(self) -> Booleans:
        """(E,) rows of the closure whose rod a reading is of."""
        return np.append(self.rod_reads[self.closing], np.zeros(len(self.angles), dtype=bool))

    @cached_property
    def of_motor(self) -> Booleans:
        """(E, m) which reading enters each row."""
        return self.row_motor[:, None] == np.arange(self.n_readings)

    @cached_property
    def shares_motors(self) -> bool:
        """Whether a reading enters several rows."""
        return self.driven_rows.size > self.n_readings

    @cached_property
    def reads_lengths(self) -> bool:
        """Whether a reading is a rod's length wherever there is one, so that the closures' noise is
        the same everywhere.
        """
        lengths = np.all(self.row_is_rod | (self.row_motor < 0))
        return bool(lengths) and not self.shares_motors

    @cached_property
    def own_motion(self) -> Array:
        """(6 + n, d + n): the pose's directions, then its internal coordinates."""
        n, d = self.n_internal, self.motion.shape[1]
        out = np.eye(6 + n, d + n)
        out[:6, :d], out[6:, d:] = self.motion, np.eye(n)
        out[:6, d:], out[6:, :d] = 0.0, 0.0
        return out

    @cached_property
    def overdetermined(self) -> bool:
        """Whether there are more rows than unknowns, so that readings with errors close none."""
        return self.n_equations > self.own_motion.shape[1]

    @cached_property
    def unsure_scales(self) -> Booleans:
        """(L,) readings whose scale is a parameter."""
        return self.scale < self.n_parameters

    @cached_property
    def some_scales_unsure(self) -> bool:
        """Whether the scale of any reading is a parameter."""
        return bool(self.unsure_scales.any())

    @cached_property
    def scale_or_first(self) -> Integers:
        """(L,) where each scale stands among the parameters; the first where it is none."""
        return np.where(self.unsure_scales, self.scale, 0)

    @cached_property
    def all_read(self) -> bool:
        """Whether every leg has a reading."""
        return bool((self.actuated >= 0).all())

    @cached_property
    def reading_or_first(self) -> Integers:
        """(L,) each leg's reading; the first where it has none."""
        return np.maximum(self.actuated, 0)

    @cached_property
    def scales_move_a(self) -> bool:
        """Whether a scale that is a parameter moves a limb's end A, and not a rod."""
        return bool((self.unsure_scales & ~self.rod_reads).any())

    @cached_property
    def scales_move_rods(self) -> bool:
        """Whether one changes a rod's length."""
        return bool((self.unsure_scales & self.rod_reads).any())

    @cached_property
    def a_index(self) -> Integers:
        """(L, n) parameters that each limb's end A depends on, P where there are fewer; the last is
        the reading's scale, where one moves A.
        """
        index = self._ends_index(self.base)
        if not self.scales_move_a:
            return index
        scale = np.where(self.rod_reads, self.n_parameters, self.scale)
        return np.concatenate([index, scale[:, None]], axis=1)

    @cached_property
    def b_index(self) -> Integers:
        """(L, n) the same of B."""
        return self._ends_index(self.platform)

    @cached_property
    def closure_index(self) -> Integers:
        """(E, n) parameters that each row of the closure depends on, P where there are fewer."""
        none, keep, leg = self.n_parameters, self.closing, self.angles.leg
        rod = np.where(keep, self.rod, none)[:, None]
        parts = [self.a_index, self.b_index, rod]
        if self.scales_move_rods:
            parts.append(np.where(self.rod_reads, self.scale, none)[:, None])
        lengths = np.concatenate(parts, axis=1)[keep]
        angles = np.concatenate(
            [
                self.a_index[leg],
                self.b_index[leg],
                np.where(self.angles.on_base[:, None], self.angles.base, none),
                np.where(self.angles.on_platform[:, None], self.angles.platform, none),
            ],
            axis=1,
        )
        if not len(self.angles):
            return lengths
        width = max(lengths.shape[1], angles.shape[1])
        wide = (
            np.pad(x, ((0, 0), (0, width - x.shape[1])), constant_values=none)
            for x in (lengths, angles)
        )
        return np.concatenate(list(wide))

    def _ends_index(self, groups: tuple[CarrierGroup, ...]) -> Integers:
        width = max(g.index.shape[1] for g in groups)
        index = np.full((self.n_legs, width), self.n_parameters)
        for group in groups:
            index[group.legs, : group.index.shape[1]] = group.index
        return index

    def radius_of(self, legs: Integers, tubes: Integers) -> Integers:
        """Positions (n,) of the radii of legs' tubes, by the numbers of both, (n,) each."""
        count = np.array([len(own) for own in self.radius])
        every = np.array([place for own in self.radius for place in own], dtype=int)
        return every[(np.cumsum(count) - count)[legs] + tubes]

    @cached_property
    def free(self) -> Booleans:
        """(6,) which of (omega, tau) the motion has."""
        return np.asarray(self.motion.any(axis=1))

    @cached_property
    def freedoms(self) -> slice:
        """The same as a slice of the six."""
        used = np.flatnonzero(self.free)
        return slice(int(used[0]), int(used[-1]) + 1)


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
        rod=np.array(
            [
                positions.get(f"{rod}.offset", positions.get(f"{rod}.constant", -1))
                for rod in (f"legs[{j + 1}].length" for j in range(len(legs)))
            ]
        ),
        closing=closing,
        actuated=motor_columns(document),
        middle=middles(document),
        internal=_internal(document),
        rod_reads=reads,
        scale=np.array(
            [positions.get(f"legs[{j + 1}].scale", len(positions)) for j in range(len(legs))]
        ),
        exact_scale=np.array([leg.scale for leg in legs]),
        base_axis=base_axis,
        platform_axis=platform_axis,
        angles=angle_layout(document, base_axis, platform_axis),
        turning=(_turning(document, "base", positions), _turning(document, "platform", positions)),
        radius=tuple(
            np.array(
                [positions[f"legs[{j + 1}].tubes[{t + 1}].radius"] for t in range(len(leg.tubes))],
                dtype=int,
            )
            for j, leg in enumerate(legs)
        ),
        motion=MOTION_DIRECTIONS[document.motion],
        n_parameters=len(positions),
    )


def _axis_index(document: MechanismDocument, side: str, positions: dict[str, int]) -> Integers:
    """Positions (L, 3) of the axes' parameters on one side, -1 where there is none."""
    names = [[f"legs[{j + 1}].{side}.axis.{c}" for c in "xyz"] for j in range(len(document.legs))]
    return np.array([[positions.get(name, -1) for name in row] for row in names], dtype=int)


def _turning(document: MechanismDocument, side: str, positions: dict[str, int]) -> Integers:
    """Positions (n, 3) of the directions on one side, whoever has them; three in a row."""
    carriers = base_carriers() if side == "base" else platform_carriers()
    names = (
        f"legs[{j}].{side}.{kind.path}"
        for j, leg in enumerate(document.legs, start=1)
        for kind in dict.fromkeys(
            (*carriers[getattr(leg, side).joint].parameters, *JOINT_AXIS_KINDS)
        )
        if kind.unit == "1" and kind.path.endswith(".x")
    )
    first = [positions[name] for name in names if name in positions]
    return np.array(first, dtype=int)[:, None] + np.arange(3)


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
        indices = [[of_part(nodes[j], p) for p in kind.parameters] for j in legs]
        constants = np.array(
            [
                [p.otherwise if v is None else v for p, v in zip(kind.parameters, row, strict=True)]
                for row in indices
            ]
        )
        groups.append(CarrierGroup(kind, legs, index, constants, index == len(positions)))
    return tuple(groups)


def _internal(document: MechanismDocument) -> Integers:
    """The column of each leg's internal coordinate, by the body that it ends on; -1 without."""
    kinds = platform_carriers()
    turns = np.array([kinds[leg.platform.joint].turns for leg in document.legs])
    on = np.where(turns, bodies(document), -1)
    return np.where(turns, np.searchsorted(np.unique(on[turns]), on), -1)
