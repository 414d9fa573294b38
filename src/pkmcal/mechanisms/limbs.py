"""The closure equation of every machine, |B_j - A_j| = length_j, with its derivatives.

All functions take the parameter vector as an array (..., P), so that a whole Monte-Carlo
batch of machines is one call: leading axes of parameters, readings and poses broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.carriers.contract import CarriedPoint, base_carriers, platform_carriers
from pkmcal.mechanisms.schema import MechanismDocument


@dataclass(frozen=True)
class CarrierGroup:
    """The legs that one carrier kind serves.

    legs : (g,) leg numbers from 0. index : (g, n) their parameters' positions.
    """

    carrier: Any
    legs: Integers
    index: Integers


@dataclass(frozen=True)
class LimbLayout:
    """Where each leg finds its parameters; made once from the document.

    base, platform : groups of legs by carrier.
    rod : (L,) position of each rod's offset or constant length.
    actuated : (L,) the reading's column, -1 for a rod of constant length.
    radius : list of (tubes,) positions of each leg's radii.
    """

    n_legs: int
    base: tuple[CarrierGroup, ...]
    platform: tuple[CarrierGroup, ...]
    rod: Integers
    actuated: Integers
    radius: tuple[Integers, ...]
    motion: Array


@dataclass(frozen=True)
class LimbEnds:
    """Both ends of all limbs with derivatives; leading axes broadcast, then L legs.

    a, b : (..., L, 3) m, base frame.
    a_index, b_index : (L, n) parameters that each end depends on.
    a_by, b_by : (..., L, 3, n) derivatives by those parameters.
    a_by_reading : (..., L, 3); b_by_pose : (..., L, 3, 6).
    """

    a: Array
    b: Array
    a_index: Integers
    b_index: Integers
    a_by: Array
    b_by: Array
    a_by_reading: Array
    b_by_pose: Array


@dataclass(frozen=True)
class Closure:
    """Residual c = |B - A| - length of every limb, (..., L), and its derivatives.

    u : (..., L, 3) unit directions from A to B. distance : (..., L) m.
    by_pose : (..., L, 6); by_reading : (..., L); by_ends : A's (..., L, n) and B's, on the
    indices of ``ends``; by the rod's own parameter it is -1.
    """

    value: Array
    u: Array
    distance: Array
    by_pose: Array
    by_reading: Array
    a_by: Array
    b_by: Array
    ends: LimbEnds


MOTIONS: dict[str, Array] = {
    "spatial": np.eye(6),
    "planar": np.eye(6)[:, [2, 3, 4]],
    "translation": np.eye(6)[:, 3:],
}
"""Columns: the directions (omega, tau) in which the platform can move, base frame."""


def layout_of(document: MechanismDocument, positions: dict[str, int]) -> LimbLayout:
    """The layout of a document whose parameters stand at ``positions``."""
    legs = document.legs
    actuated = np.array([leg.length.actuated for leg in legs])
    columns = np.where(actuated, np.cumsum(actuated) - 1, -1)
    rod_name = ["offset" if flag else "constant" for flag in actuated]
    return LimbLayout(
        n_legs=len(legs),
        base=_groups(document, "base", base_carriers(), positions),
        platform=_groups(document, "platform", platform_carriers(), positions),
        rod=np.array([positions[f"legs[{j + 1}].length.{rod_name[j]}"] for j in range(len(legs))]),
        actuated=columns,
        radius=tuple(
            np.array(
                [positions[f"legs[{j + 1}].tubes[{t + 1}].radius"] for t in range(len(leg.tubes))],
                dtype=int,
            )
            for j, leg in enumerate(legs)
        ),
        motion=MOTIONS[document.motion],
    )


def _groups(
    document: MechanismDocument, side: str, carriers: dict[str, Any], positions: dict[str, int]
) -> tuple[CarrierGroup, ...]:
    kinds = [carriers[getattr(leg, side).joint] for leg in document.legs]
    groups: list[CarrierGroup] = []
    for kind in dict.fromkeys(kinds):
        legs = np.flatnonzero([k is kind for k in kinds])
        index = [
            [positions[f"legs[{j + 1}].{side}.{p.path}"] for p in kind.parameters] for j in legs
        ]
        groups.append(CarrierGroup(kind, legs, np.array(index, dtype=int)))
    return tuple(groups)


def limb_ends(layout: LimbLayout, theta: Array, readings: Array, poses: Array) -> LimbEnds:
    """Both ends of every limb.

    theta : (..., P). readings : (..., m). poses : T_base_platform (..., 4, 4).
    """
    q = leg_readings(layout, readings)
    a, a_index = _gather(
        layout,
        layout.base,
        [g.carrier.point(theta[..., g.index], q[..., g.legs]) for g in layout.base],
    )
    b, b_index = _gather(
        layout,
        layout.platform,
        [g.carrier.point(theta[..., g.index], poses[..., None, :, :]) for g in layout.platform],
    )
    return LimbEnds(
        a.value,
        b.value,
        a_index,
        b_index,
        a.by_parameters,
        b.by_parameters,
        a.by_motion,
        b.by_motion,
    )


def leg_readings(layout: LimbLayout, readings: Array) -> Array:
    """Readings (..., m) spread over the legs (..., L), zero for rods of constant length."""
    return np.where(layout.actuated >= 0, readings[..., np.maximum(layout.actuated, 0)], 0.0)


def rod_lengths(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Length of every rod (..., L), m: reading + offset, or the constant; [B] eq. 4."""
    return theta[..., layout.rod] + leg_readings(layout, readings)


def _gather(
    layout: LimbLayout, groups: tuple[CarrierGroup, ...], points: list[CarriedPoint]
) -> tuple[CarriedPoint, Integers]:
    """Carriers' results put in the order of the legs, parameters padded to a common count."""
    if len(groups) == 1:
        return points[0], groups[0].index
    width = max(g.index.shape[1] for g in groups)
    index = np.zeros((layout.n_legs, width), dtype=int)
    shape = np.broadcast_shapes(*(p.value.shape[:-2] for p in points))
    motion = points[0].by_motion.shape[len(points[0].value.shape) - 1 :]
    value = np.zeros((*shape, layout.n_legs, 3))
    by_motion = np.zeros((*shape, layout.n_legs, *motion))
    by_parameters = np.zeros((*shape, layout.n_legs, 3, width))
    for group, point in zip(groups, points, strict=True):
        n = group.index.shape[1]
        index[group.legs, :n] = group.index
        value[..., group.legs, :] = point.value
        by_motion[(..., group.legs, *[slice(None)] * len(motion))] = point.by_motion
        by_parameters[..., group.legs, :, :n] = point.by_parameters
    return CarriedPoint(value, by_motion, by_parameters), index


def closure(layout: LimbLayout, theta: Array, readings: Array, poses: Array) -> Closure:
    """The closure residual of every limb and its exact derivatives; [B] eq. 4, [A] eq. 13.

    theta : (..., P). readings : (..., m). poses : T_base_platform (..., 4, 4).
    """
    ends = limb_ends(layout, theta, readings, poses)
    d = ends.b - ends.a
    distance = np.sqrt(dot(d, d))
    u = d / distance[..., None]
    return Closure(
        value=distance - rod_lengths(layout, theta, readings),
        u=u,
        distance=distance,
        by_pose=(u[..., None, :] @ ends.b_by_pose)[..., 0, :],
        by_reading=-dot(u, ends.a_by_reading) - (layout.actuated >= 0),
        a_by=-(u[..., None, :] @ ends.a_by)[..., 0, :],
        b_by=(u[..., None, :] @ ends.b_by)[..., 0, :],
        ends=ends,
    )
