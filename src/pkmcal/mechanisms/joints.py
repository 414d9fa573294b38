"""Closure equations from joints' axes, with exact derivatives; metres.

A joint at a limb's end may have an axis. On a spatial machine, axes add equations between the
limb's line and the two bodies, by the role that each end's carrier assigns to its axis:

- ``square``, a revolute joint: the limb is orthogonal to the axis ([A] eq. 7);
- ``twist`` at both ends, universal joints: the limb does not twist, so the two first axes and the
  limb's line are in one plane (errata, 3-UPU).

Each equation states that the limb's line d = B - A is orthogonal to a direction w: ``d . w = 0``. A
revolute joint on the base has w = v, its unit axis; on the platform w = R v'. A limb that cannot
twist has ``w = v x R v'``. Values are in metres, like the lengths in the same least-squares
problem.

A screw that the joints are free to turn has two universal joints with axes, too, but does not hold
its rod from twisting: instead, the twist phi changes what the reading is, by lead / (2 pi) phi
(LinuxCNC's genhexkins, ``screw-lead``). phi is the angle about the limb's direction u = d / |d|
from the base's axis to the platform's, both seen along u. Axes are lines, so phi is modulo pi::

    tan phi = s / c,   s = u . (v x R v'),   c = v . R v' - (v . u) (R v' . u)

A universal joint's second axis may lie at a distance e from its first one v, towards the leg's
other end. The rod then runs from A' = A + e n to B' = B + e' n', with n the direction square to v
from A to B', and n' that square to R v' from B to A': each second axis is square to its first one
and to the rod. The reading contains ``|B' - A'| - |B - A|``, nearly -e cos(beta) for the rod's
angle beta out of the plane square to v. With u' the rod's direction, |B' - A'| is stationary in
both joints' angles, so that its derivatives are those of a rod whose ends are fixed to their
bodies.

Planar and translational machines move as their file states, so axes add no equations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, dot, skew
from pkmcal.mechanisms.carriers.contract import ParameterKind, base_carriers, platform_carriers
from pkmcal.mechanisms.document import ActuatedLength, MechanismDocument

OFFSET_TURNS = 12
"""Turns in which a rod's two offset ends are computed: rounding is left where offsets are up to a
twentieth of the leg."""
JOINT_AXIS_KINDS = tuple(ParameterKind(f"axis.{axis}", "1", "axis") for axis in "xyz")

Equation = Literal["revolute base", "revolute platform", "torsion"]


def equations(document: MechanismDocument) -> tuple[tuple[int, Equation], ...]:
    """Angle equations of a machine, (leg from 0, kind), in the order of the legs."""
    if document.motion != "spatial":
        return ()
    out: list[tuple[int, Equation]] = []
    for j, leg in enumerate(document.legs):
        base = base_carriers()[leg.base.joint].axis_role(leg.base)
        platform = platform_carriers()[leg.platform.joint].axis_role(leg.platform)
        if base == "square":
            out.append((j, "revolute base"))
        if platform == "square":
            out.append((j, "revolute platform"))
        if base == platform == "twist" and j not in screws(document):
            out.append((j, "torsion"))
    return tuple(out)


def screws(document: MechanismDocument) -> dict[int, float]:
    """Leads, m, of the screws that joints turn, by leg from 0."""
    lengths = {j: leg.length for j, leg in enumerate(document.legs)}
    return {
        j: length.lead
        for j, length in lengths.items()
        if isinstance(length, ActuatedLength) and length.lead is not None
    }


def joint_offsets(document: MechanismDocument) -> dict[int, tuple[float, float]]:
    """Offsets, m, of the axes of universal joints on base and platform, by leg from 0."""
    ends = ([getattr(x, "offset", None) for x in (leg.base, leg.platform)] for leg in document.legs)
    return {j: (a or 0.0, b or 0.0) for j, (a, b) in enumerate(ends) if a or b}


def axes_in_use(document: MechanismDocument) -> set[tuple[int, str]]:
    """Ends (leg from 0, side) whose axis is in an equation, a screw's twist or an offset joint and
    hence a parameter.
    """
    sides: dict[Equation, tuple[str, ...]] = {
        "revolute base": ("base",),
        "revolute platform": ("platform",),
        "torsion": ("base", "platform"),
    }
    in_equations = {(j, side) for j, which in equations(document) for side in sides[which]}
    in_offsets = {
        (j, side)
        for j, each in joint_offsets(document).items()
        for side, offset in zip(sides["torsion"], each, strict=True)
        if offset
    }
    of_screws = {(j, side) for j in screws(document) for side in sides["torsion"]}
    return in_equations | in_offsets | of_screws


@dataclass(frozen=True)
class AngleLayout:
    """Indices of the E angle equations of a machine.

    leg : (E,).
    base, platform : (E, 3) indices of the axes' parameters, 0 for an axis that is not used.
    on_base, on_platform : (E,) axes used by each equation; a torsion uses both.
    """

    leg: Integers
    base: Integers
    platform: Integers
    on_base: Booleans
    on_platform: Booleans

    def __len__(self) -> int:
        return len(self.leg)


@dataclass(frozen=True)
class ScrewLayout:
    """Screws (S of them) that joints turn.

    leg : (S,). lead : (S,) m per turn, positive for a right-hand thread.
    base, platform : (S, 3) indices of the axes' parameters.
    """

    leg: Integers
    lead: Array
    base: Integers
    platform: Integers

    def __len__(self) -> int:
        return len(self.leg)

    @cached_property
    def axes(self) -> Integers:
        """Indices (S, 6) of the parameters of both axes."""
        return np.concatenate([self.base, self.platform], axis=1)


@dataclass(frozen=True)
class OffsetLayout:
    """Legs (S of them) with universal joints whose axes do not meet.

    leg : (S,). offset : (S, 2) m, of the joints on base and platform, zero where axes meet.
    axis : (S, 2, 3) indices of their first axes' parameters, -1 where axes meet.
    """

    leg: Integers
    offset: Array
    axis: Integers

    def __len__(self) -> int:
        return len(self.leg)


class AngleRows(NamedTuple):
    """Angle equations, or changes of readings by screws and offset axes: values (..., E), m, and
    derivatives (..., E, 3) by the limb's line, by the platform's rotation, and by the parameters of
    the base and platform axes.
    """

    value: Array
    by_line: Array
    by_turn: Array
    by_base_axis: Array
    by_platform_axis: Array


def angle_layout(document: MechanismDocument, base: Integers, platform: Integers) -> AngleLayout:
    """Angle equations of a document.

    base, platform : (L, 3) indices of the axes' parameters, -1 for none.
    """
    pairs = equations(document)
    leg = np.array([j for j, _ in pairs], dtype=int)
    kinds = np.array([kind for _, kind in pairs], dtype=object)
    on_base = np.isin(kinds, ["revolute base", "torsion"])
    on_platform = np.isin(kinds, ["revolute platform", "torsion"])
    return AngleLayout(
        leg,
        np.where(on_base[:, None], base[leg], 0),
        np.where(on_platform[:, None], platform[leg], 0),
        on_base,
        on_platform,
    )


def screw_layout(document: MechanismDocument, base: Integers, platform: Integers) -> ScrewLayout:
    """Screws of a document.

    base, platform : (L, 3) indices of the axes' parameters.
    """
    leads = screws(document)
    leg = np.array(list(leads), dtype=int)
    return ScrewLayout(leg, np.array(list(leads.values())), base[leg], platform[leg])


def offset_layout(document: MechanismDocument, base: Integers, platform: Integers) -> OffsetLayout:
    """Offset joints of a document.

    base, platform : (L, 3) indices of the axes' parameters, -1 for none.
    """
    each = joint_offsets(document)
    leg = np.array(list(each), dtype=int)
    offset = np.array(list(each.values()), dtype=float).reshape(-1, 2)
    axis = np.stack([base[leg], platform[leg]], axis=1)
    return OffsetLayout(leg, offset, np.where(offset[..., None] != 0, axis, -1))


class _OffsetState(NamedTuple):
    """Rods (..., S) between joints with offset axes.

    v, w : (..., S, 3) unit first axes of the joints on base and platform, base frame.
    v_size, own_size : (..., S, 1) lengths of these axes as parameters.
    n, n_platform : (..., S, 3) directions of the offsets; see the module's docstring.
    rod : (..., S, 3) B' - A', m.
    """

    v: Array
    w: Array
    v_size: Array
    own_size: Array
    n: Array
    n_platform: Array
    rod: Array


def _offset_state(layout: OffsetLayout, theta: Array, rot: Array, line: Array) -> _OffsetState:
    """Rods at platform rotations (..., 3, 3) and lines B - A (..., S, 3), m."""
    offset_a, offset_b = layout.offset[:, :1], layout.offset[:, 1:]
    index = np.maximum(layout.axis, 0)
    v, v_size = _unit(theta[..., index[:, 0]], offset_a != 0)
    own, own_size = _unit(theta[..., index[:, 1]], offset_b != 0)
    w = (rot[..., None, :, :] @ own[..., None])[..., 0]

    def direction(vector: Array, axis: Array, offset: Array) -> Array:
        # a joint whose axes meet has no such direction; its leg may be parallel to the axis
        return _direction(np.where(offset != 0, _across(vector, axis), 1.0))

    # A' and B' by turns, from A: each turn is as much better as offsets are shorter than the leg
    n, n_platform = direction(line, v, offset_a), direction(-line, w, offset_b)
    for _ in range(OFFSET_TURNS):
        n = direction(line + offset_b * n_platform, v, offset_a)
        n_platform = direction(offset_a * n - line, w, offset_b)
    rod = line + offset_b * n_platform - offset_a * n
    return _OffsetState(v, w, v_size, own_size, n, n_platform, rod)


def offset_rows(layout: OffsetLayout, theta: Array, rot: Array, line: Array) -> AngleRows:
    """Changes of readings by offset axes, |B' - A'| - |B - A|; see the module's docstring.

    theta : (..., P).
    rot : (..., 3, 3) rotation of the platform.
    line : (..., S, 3) B - A of each leg, m.
    """
    offset_a, offset_b = layout.offset[:, :1], layout.offset[:, 1:]
    v, w, v_size, own_size, n, n_platform, rod = _offset_state(layout, theta, rot, line)
    length, distance = np.sqrt(dot(rod, rod)), np.sqrt(dot(line, line))
    u = rod / length[..., None]
    by_own = -offset_b * dot(u, w)[..., None] * n_platform
    return AngleRows(
        value=length - distance,
        by_line=u - line / distance[..., None],
        by_turn=cross(offset_b * n_platform, u),
        by_base_axis=offset_a * dot(u, v)[..., None] * n / v_size,
        by_platform_axis=(rot.mT[..., None, :, :] @ by_own[..., None])[..., 0] / own_size,
    )


class RodShifts(NamedTuple):
    """Vectors from A to A' and from B to B' (..., S, 2, 3), m, with their derivatives (..., S, 2,
    3, 3) by the leg's line B - A, by the platform's rotation, and by the parameters of both axes.
    """

    value: Array
    by_line: Array
    by_turn: Array
    by_base_axis: Array
    by_platform_axis: Array


def rod_shifts(layout: OffsetLayout, theta: Array, rot: Array, line: Array) -> RodShifts:
    """Ends of rods between joints with offset axes; arguments as of :func:`offset_rows`.

    The directions n(B' - A, v) and n'(A' - B, w) of the offsets e and e' depend on each other:
    ``dn = N (d line + e' dn') + V dv`` and ``dn' = N' (e dn - d line) + W dw``.
    """
    offset_a, offset_b = layout.offset[:, :1], layout.offset[:, 1:]
    v, w, v_size, own_size, n, n_platform, _ = _offset_state(layout, theta, rot, line)
    # a joint whose axes meet has a direction that nothing depends on, at any angle to the vector
    at_base = np.where(offset_a != 0, line + offset_b * n_platform, n)
    at_platform = np.where(offset_b != 0, offset_a * n - line, n_platform)
    by_vector, by_v = _direction_by(at_base, v, n)
    by_other, by_w = _direction_by(at_platform, w, n_platform)
    # columns: line, v, w
    unit, none = np.broadcast_to(np.eye(3), by_v.shape), np.zeros_like(by_v)
    system = np.block(
        [[unit, -offset_b[..., None] * by_vector], [-offset_a[..., None] * by_other, unit]]
    )
    right = np.block([[by_vector, by_v, none], [-by_other, none, by_w]])
    solved = np.linalg.solve(system, right)
    solved = solved.reshape(*solved.shape[:-2], 2, 3, 9)
    by_line, by_v, by_w = np.split(layout.offset[..., None, None] * solved, 3, axis=-1)
    across_v, across_w = (np.eye(3) - axis[..., :, None] * axis[..., None, :] for axis in (v, w))
    of_own = (across_w @ rot[..., None, :, :]) / own_size[..., None]
    directions = np.stack([n, n_platform], axis=-2)
    return RodShifts(
        value=layout.offset[..., None] * directions,
        by_line=by_line,
        by_turn=by_w @ -skew(w)[..., None, :, :],
        by_base_axis=by_v @ (across_v / v_size[..., None])[..., None, :, :],
        by_platform_axis=by_w @ of_own[..., None, :, :],
    )


def _direction_by(vector: Array, axis: Array, direction: Array) -> tuple[Array, Array]:
    """Derivatives (..., 3, 3) of the direction of the part of a vector orthogonal to a unit axis,
    by the vector and by the axis, (..., 3) each.
    """
    size = dot(vector, direction)[..., None, None]
    rest = np.eye(3) - direction[..., :, None] * direction[..., None, :]
    by_axis = axis[..., :, None] * vector[..., None, :] + dot(vector, axis)[..., None, None] * rest
    return (rest - axis[..., :, None] * axis[..., None, :]) / size, -by_axis / size


def _direction(vector: Array) -> Array:
    """Unit vectors (..., 3)."""
    return vector / np.sqrt(dot(vector, vector))[..., None]


def screw_turns(layout: ScrewLayout, theta: Array, rot: Array, line: Array) -> Array:
    """Turns phi (..., S), rad, of screws by their joints; arguments as of :func:`screw_rows`."""
    return screw_rows(replace(layout, lead=np.full(len(layout), 2 * np.pi)), theta, rot, line).value


def screw_rows(layout: ScrewLayout, theta: Array, rot: Array, line: Array) -> AngleRows:
    """Changes of screws' readings, lead / (2 pi) phi; see the module's docstring.

    theta : (..., P).
    rot : (..., 3, 3) rotation of the platform.
    line : (..., S, 3) B - A of each screw's leg, m.
    """
    every = np.ones((len(layout), 1), dtype=bool)
    v, v_size = _unit(theta[..., layout.base], every)
    own, own_size = _unit(theta[..., layout.platform], every)
    w = (rot[..., None, :, :] @ own[..., None])[..., 0]
    distance = np.sqrt(dot(line, line))[..., None]
    u = line / distance
    along_v, along_w = dot(u, v)[..., None], dot(u, w)[..., None]
    normal = cross(v, w)
    s, c = dot(u, normal)[..., None], dot(v, w)[..., None] - along_v * along_w
    # d phi = (c ds - s dc) / (s^2 + c^2), times the growth per radian
    growth = layout.lead[:, None] / (2 * np.pi)
    by_s, by_c = growth * c / (s * s + c * c), -growth * s / (s * s + c * c)
    by_v = by_s * cross(w, u) + by_c * (w - along_w * u)
    by_w = by_s * cross(u, v) + by_c * (v - along_v * u)
    by_u = by_s * normal - by_c * (along_w * v + along_v * w)
    by_own = (rot.mT[..., None, :, :] @ by_w[..., None])[..., 0]
    return AngleRows(
        value=(growth * np.arctan(s / c))[..., 0],
        by_line=_across(by_u, u) / distance,
        by_turn=cross(w, by_w),
        by_base_axis=_across(by_v, v) / v_size,
        by_platform_axis=_across(by_own, own) / own_size,
    )


def angle_rows(layout: AngleLayout, theta: Array, rot: Array, line: Array) -> AngleRows:
    """Angle equations evaluated.

    theta : (..., P).
    rot : (..., 3, 3) rotation of the platform.
    line : (..., E, 3) B - A of each equation's leg, m.
    """
    # Unit axes in the base frame, and the direction w to which the line is orthogonal.
    first, second = layout.on_base[:, None], layout.on_platform[:, None]
    v, v_size = _unit(theta[..., layout.base], first)
    own, own_size = _unit(theta[..., layout.platform], second)
    turned = (rot[..., None, :, :] @ own[..., None])[..., 0]
    w = np.where(first & second, cross(v, turned), np.where(first, v, turned))
    # Derivatives of line . w by the unit axes, in the base frame.
    by_v = np.where(second, cross(turned, line), line)
    by_turned = np.where(first, cross(line, v), line)
    by_own = (rot.mT[..., None, :, :] @ by_turned[..., None])[..., 0]
    return AngleRows(
        value=dot(line, w),
        by_line=w,
        by_turn=np.where(second, cross(turned, by_turned), 0.0),
        by_base_axis=np.where(first, _across(by_v, v) / v_size, 0.0),
        by_platform_axis=np.where(second, _across(by_own, own) / own_size, 0.0),
    )


def _unit(axis: Array, used: Booleans) -> tuple[Array, Array]:
    """Unit axes (..., E, 3) and their lengths (..., E, 1); the z axis if an equation has none."""
    axis = np.where(used, axis, np.array([0.0, 0.0, 1.0]))
    size = np.sqrt(dot(axis, axis))[..., None]
    return axis / size, size


def _across(gradient: Array, axis: Array) -> Array:
    """Part of a gradient orthogonal to a unit axis; the length of an axis has no effect."""
    return gradient - dot(gradient, axis)[..., None] * axis
