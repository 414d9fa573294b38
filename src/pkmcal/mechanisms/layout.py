"""Indices of each limb's carriers, parameters and reading, built once from the document."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.mechanisms.carriers.contract import (
    Winding,
    base_carriers,
    of_part,
    platform_carriers,
)
from pkmcal.mechanisms.document import (
    MOTION_DIRECTIONS,
    ActuatedLength,
    MechanismDocument,
    PassiveLength,
)
from pkmcal.mechanisms.joints import (
    JOINT_AXIS_KINDS,
    AngleLayout,
    OffsetLayout,
    ScrewLayout,
    angle_layout,
    offset_layout,
    screw_layout,
)
from pkmcal.mechanisms.motors import bodies, middles, motor_columns


@dataclass(frozen=True)
class CarrierGroup:
    """Legs with the same kind of carrier on one side.

    legs : (g,) leg indices from 0.
    index : (g, n) indices of their parameters, P for numbers that are not parameters, whose values
        are in ``constants`` (g, n).
    silent : (g, n) where ``index`` is P.
    """

    carrier: Any
    legs: Integers
    index: Integers
    constants: Array
    silent: Booleans

    @property
    def winds(self) -> bool:
        """Whether the legs are cables over pulleys."""
        return issubclass(self.carrier, Winding)

    @cached_property
    def complete(self) -> bool:
        """Whether all numbers are parameters."""
        return not self.silent.any()

    def of(self, theta: Array) -> Array:
        """Parameters (..., g, n) of the group from all parameters (..., P)."""
        if self.complete:
            return theta[..., self.index]
        parameters = theta[..., np.where(self.silent, 0, self.index)]
        return np.where(self.silent, self.constants, parameters)


@dataclass(frozen=True)
class LimbLayout:
    """Indices of each leg's parameters, built once from the document.

    base, platform : groups of legs by carrier.
    rod : (L,) index of each rod's offset or constant length, -1 for a passive rod.
    closing : (L,) legs whose length is an equation: all but passive ones.
    actuated : (L,) column of the reading, -1 without one.
    middle : (L,) mid-range of the reading.
    internal : (L,) column of the platform carrier's internal coordinate, -1 without one.
    rod_reads : (L,) whether the reading is the rod's own length, not the carrier's motion.
    scale : (L,) index of each reading's scale, P if it is exact; then ``exact_scale`` (L,) holds
        its value, 1 for a leg without a reading.
    base_axis, platform_axis : (L, 3) indices of the axes' parameters, -1 for an axis that is not a
        parameter.
    angles : the axes' equations.
    screws : the screws that joints turn. offsets : universal joints whose axes do not meet.
    turning : indices (n, 3) of all direction vectors among the parameters, in the base frame and in
        the platform frame.
    radius : (tubes,) indices of the radii, for each leg.
    motion : (6, d) directions in which the platform moves.
    n_parameters : P.
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
    screws: ScrewLayout
    offsets: OffsetLayout
    turning: tuple[Integers, Integers]
    radius: tuple[Integers, ...]
    motion: Array
    n_parameters: int

    __repr__ = short_repr

    @cached_property
    def windings(self) -> tuple[CarrierGroup, ...]:
        """Groups of legs that are cables over pulleys."""
        return tuple(g for g in self.base if g.winds)

    @cached_property
    def lengthens(self) -> Booleans:
        """Whether each leg's reading (L,) makes the leg longer, rather than moving its end A."""
        out = self.rod_reads.copy()
        for group in self.windings:
            out[group.legs] |= group.carrier.driven
        return out

    @cached_property
    def n_equations(self) -> int:
        """Number of closure rows: lengths, then axes' equations."""
        return int(self.closing.sum()) + len(self.angles)

    @cached_property
    def all_close(self) -> bool:
        """Whether the length of every leg is an equation."""
        return bool(self.closing.all())

    @cached_property
    def driven_rows(self) -> Integers:
        """Closure rows of legs with a reading, in the legs' order."""
        return np.flatnonzero(self.actuated[self.closing] >= 0)

    @cached_property
    def n_readings(self) -> int:
        """Number of readings of a configuration, m."""
        return int(self.actuated.max(initial=-1)) + 1

    @cached_property
    def n_internal(self) -> int:
        """Number of internal coordinates of a pose."""
        return int(self.internal.max(initial=-1)) + 1

    @cached_property
    def row_motor(self) -> Integers:
        """Column of the reading in each closure row, (E,), -1 for none."""
        angles = np.full(len(self.angles), -1)
        return np.concatenate([self.actuated[self.closing], angles])

    @cached_property
    def row_is_rod(self) -> Booleans:
        """Whether each closure row (E,) is the length of a rod with a reading."""
        return np.append(self.rod_reads[self.closing], np.zeros(len(self.angles), dtype=bool))

    @cached_property
    def of_motor(self) -> Booleans:
        """Whether each closure row depends on each reading, (E, m)."""
        return self.row_motor[:, None] == np.arange(self.n_readings)

    @cached_property
    def shares_motors(self) -> bool:
        """Whether a reading enters several rows."""
        return self.driven_rows.size > self.n_readings

    @cached_property
    def reads_lengths(self) -> bool:
        """Whether all readings are rods' lengths, so that the noise of the closure is the same at
        all poses.
        """
        lengths = np.all(self.row_is_rod | (self.row_motor < 0))
        return bool(lengths) and not self.shares_motors

    @cached_property
    def rods_alone(self) -> bool:
        """Whether distances of joint centres are all of the closure: no axis is in it."""
        return not len(self.angles) and not self.growing.size

    @cached_property
    def growing(self) -> Integers:
        """Legs (S,) whose readings contain more than their length and offset: those with screws
        that joints turn, then those with joints whose axes do not meet.
        """
        return np.concatenate([self.screws.leg, self.offsets.leg])

    @cached_property
    def offset_axes(self) -> Integers:
        """Indices (L, 6) of the first axes' parameters of offset joints, P as padding."""
        out = np.full((self.n_legs, 6), self.n_parameters)
        axis = self.offsets.axis.reshape(-1, 6)
        out[self.offsets.leg] = np.where(axis < 0, self.n_parameters, axis)
        return out

    @cached_property
    def own_motion(self) -> Array:
        """Directions (6 + n, d + n) of the pose's freedoms, then of the internal coordinates."""
        n, d = self.n_internal, self.motion.shape[1]
        out = np.eye(6 + n, d + n)
        out[:6, :d], out[6:, d:] = self.motion, np.eye(n)
        out[:6, d:], out[6:, :d] = 0.0, 0.0
        return out

    @cached_property
    def overdetermined(self) -> bool:
        """Whether there are more rows than unknowns, so that readings with errors close only
        approximately.
        """
        return self.n_equations > self.own_motion.shape[1]

    @cached_property
    def underdetermined(self) -> bool:
        """Whether there are fewer rows than unknowns: the legs alone do not hold the platform, so
        that its pose does not follow from the readings. Four cables need gravity besides.
        """
        return self.n_equations < self.own_motion.shape[1]

    @cached_property
    def unsure_scales(self) -> Booleans:
        """Whether the scale of each leg's reading (L,) is a parameter."""
        return self.scale < self.n_parameters

    @cached_property
    def some_scales_unsure(self) -> bool:
        """Whether any reading's scale is a parameter."""
        return bool(self.unsure_scales.any())

    @cached_property
    def scale_or_first(self) -> Integers:
        """Index of each scale among the parameters (L,), 0 for exact scales."""
        return np.where(self.unsure_scales, self.scale, 0)

    @cached_property
    def all_read(self) -> bool:
        """Whether every leg has a reading."""
        return bool((self.actuated >= 0).all())

    @cached_property
    def reading_or_first(self) -> Integers:
        """Column of each leg's reading (L,), 0 without one."""
        return np.maximum(self.actuated, 0)

    @cached_property
    def scales_move_a(self) -> bool:
        """Whether any scale that is a parameter moves an end A (and not a rod)."""
        return bool((self.unsure_scales & ~self.rod_reads).any())

    @cached_property
    def scales_move_rods(self) -> bool:
        """Whether any scale that is a parameter changes a rod's length."""
        return bool((self.unsure_scales & self.rod_reads).any())

    @cached_property
    def a_index(self) -> Integers:
        """Indices (L, n) of the parameters of each end A, P as padding; the last is the reading's
        scale if any scale moves an end A.
        """
        index = self._ends_index(self.base)
        if not self.scales_move_a:
            return index
        scale = np.where(self.rod_reads, self.n_parameters, self.scale)
        return np.concatenate([index, scale[:, None]], axis=1)

    @cached_property
    def b_index(self) -> Integers:
        """Indices (L, n) of the parameters of each end B, P as padding."""
        return self._ends_index(self.platform)

    @cached_property
    def closure_index(self) -> Integers:
        """Indices (E, n) of the parameters of each closure row, P as padding."""
        none, keep, leg = self.n_parameters, self.closing, self.angles.leg
        rod = np.where(keep, self.rod, none)[:, None]
        parts = [self.a_index, self.b_index, rod]
        if self.scales_move_rods:
            parts.append(np.where(self.rod_reads, self.scale, none)[:, None])
        if self.growing.size:
            turned = self.offset_axes.copy()
            turned[self.screws.leg] = self.screws.axes
            parts.append(turned)
        # Rows of lengths: A, B, rod, the rod's scale, and the axes that turn a screw or are
        # offset.
        lengths = np.concatenate(parts, axis=1)[keep]
        # Rows of axes: A, B and the two axes.
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
        """Indices (L, n) of the carriers' parameters on one side, P as padding."""
        width = max(g.index.shape[1] for g in groups)
        index = np.full((self.n_legs, width), self.n_parameters)
        for group in groups:
            index[group.legs, : group.index.shape[1]] = group.index
        return index

    def radius_of(self, legs: Integers, tubes: Integers) -> Integers:
        """Indices (n,) of the radii of tubes, from the indices of legs and tubes, (n,) each."""
        count = np.array([len(own) for own in self.radius])
        every = np.array([place for own in self.radius for place in own], dtype=int)
        return every[(np.cumsum(count) - count)[legs] + tubes]

    @cached_property
    def free(self) -> Booleans:
        """Whether the motion has each component (6,) of (omega, tau)."""
        return np.asarray(self.motion.any(axis=1))

    @cached_property
    def freedoms(self) -> slice:
        """Slice of the components of (omega, tau) that the motion has."""
        used = np.flatnonzero(self.free)
        return slice(int(used[0]), int(used[-1]) + 1)


def layout_of(document: MechanismDocument, positions: dict[str, int]) -> LimbLayout:
    """Layout of a document, with the indices of its parameters in ``positions``."""
    legs = document.legs
    carriers = base_carriers()
    reads = np.array([isinstance(leg.length, ActuatedLength) for leg in legs])
    closing = np.array([not isinstance(leg.length, PassiveLength) for leg in legs])
    base_axis, platform_axis = (_axis_index(document, s, positions) for s in ("base", "platform"))
    return LimbLayout(
        n_legs=len(legs),
        base=_carrier_groups(document, "base", carriers, positions),
        platform=_carrier_groups(document, "platform", platform_carriers(), positions),
        rod=np.array(
            [
                positions.get(f"{rod}.offset", positions.get(f"{rod}.constant", -1))
                for rod in (f"legs[{j + 1}].length" for j in range(len(legs)))
            ]
        ),
        closing=closing,
        actuated=motor_columns(document),
        middle=middles(document),
        internal=_internal_columns(document),
        rod_reads=reads,
        scale=np.array(
            [positions.get(f"legs[{j + 1}].scale", len(positions)) for j in range(len(legs))]
        ),
        exact_scale=np.array([leg.scale for leg in legs]),
        base_axis=base_axis,
        platform_axis=platform_axis,
        angles=angle_layout(document, base_axis, platform_axis),
        screws=screw_layout(document, base_axis, platform_axis),
        offsets=offset_layout(document, base_axis, platform_axis),
        turning=(
            _direction_index(document, "base", positions),
            _direction_index(document, "platform", positions),
        ),
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
    """Indices (L, 3) of the axes' parameters on one side, -1 for none."""
    names = [[f"legs[{j + 1}].{side}.axis.{c}" for c in "xyz"] for j in range(len(document.legs))]
    return np.array([[positions.get(name, -1) for name in row] for row in names], dtype=int)


def _direction_index(document: MechanismDocument, side: str, positions: dict[str, int]) -> Integers:
    """Indices (n, 3) of the components of all direction vectors on one side; they are adjacent."""
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


def _carrier_groups(
    document: MechanismDocument, side: str, carriers: dict[str, Any], positions: dict[str, int]
) -> tuple[CarrierGroup, ...]:
    """Groups of legs by carrier on one side, in the order of first use."""
    nodes = [getattr(leg, side) for leg in document.legs]
    kinds = [carriers[node.joint] for node in nodes]
    groups: list[CarrierGroup] = []
    for kind in dict.fromkeys(kinds):
        legs = np.flatnonzero([k is kind for k in kinds])
        names = [[f"legs[{j + 1}].{side}.{p.path}" for p in kind.parameters] for j in legs]
        index = np.array([[positions.get(n, len(positions)) for n in row] for row in names])
        numbers = [[of_part(nodes[j], p) for p in kind.parameters] for j in legs]
        constants = np.array(
            [
                [p.otherwise if v is None else v for p, v in zip(kind.parameters, row, strict=True)]
                for row in numbers
            ]
        )
        groups.append(CarrierGroup(kind, legs, index, constants, index == len(positions)))
    return tuple(groups)


def _internal_columns(document: MechanismDocument) -> Integers:
    """Column of each leg's internal coordinate (L,), by the body on which it ends, or -1."""
    kinds = platform_carriers()
    turns = np.array([kinds[leg.platform.joint].turns for leg in document.legs])
    on = np.where(turns, bodies(document), -1)
    return np.where(turns, np.searchsorted(np.unique(on[turns]), on), -1)
