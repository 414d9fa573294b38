"""Machine in front of a camera, as a controller models it, and its legs at one moment.

Visual servoing by the legs ([B] III) needs the points A_j and the rods' lengths, from the readings
and the model, and the legs' measured directions. If every leg is observed and the platform is
rigid, that is sufficient: B = A + length u, without the platform's geometry and without forward
kinematics. Legs that are not observed, joint axes and articulated platforms need the pose from the
readings.

A twist is (omega, tau) as in :mod:`pkmcal.geometry.rigid`, along the base frame's axes; tau is the
velocity of the point of the platform that is at ``pivot``. The pivot of the project's own twist is
the platform's origin, the pivot of [B]'s twist the camera's centre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.cylinders import SIDE_SIGNS, edge_normal, line_through
from pkmcal.geometry.rigid import apply, cross, dot, register, skew
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import by_pose
from pkmcal.mechanisms.closure import (
    Closure,
    LimbEnds,
    along,
    base_ends,
    by_motors,
    closure,
    limb_ends,
    rod_lengths,
)
from pkmcal.mechanisms.kinematics import closure_at, forward


@dataclass(frozen=True)
class MachineView:
    """Controller's model of a machine and of the camera in front of it.

    machine : its values may be (..., P), one machine for each run.
    T_camera_base : (..., 4, 4).
    legs : (s,) seen legs, from 0.
    radius : (s,) m, of each leg's visible tube.
    """

    machine: Machine
    T_camera_base: Array
    legs: Integers
    radius: Array

    def only(self, which: Integers | Booleans) -> MachineView:
        """Machine view with some of the seen legs, by index or mask (s,)."""
        return replace(self, legs=self.legs[which], radius=self.radius[which])

    @property
    def theta(self) -> Array:
        """Parameter values (..., P) of the machine."""
        return self.machine.values

    @cached_property
    def by_image_alone(self) -> bool:
        """Whether all legs are seen and close, and only rods constrain a rigid platform."""
        layout = self.machine.layout
        every = len(self.legs) == layout.n_legs and bool(layout.closing.all())
        return self.rigid and every and layout.rods_alone

    @cached_property
    def rigid(self) -> bool:
        """Whether the platform is one rigid body."""
        carriers = [g.carrier for g in self.machine.layout.platform]
        return not any(carrier.turns or carrier.floats for carrier in carriers)

    @cached_property
    def home(self) -> Array:
        """Home pose (4, 4) of the nominal model."""
        return self.machine.with_values(self.machine.parameters.nominal).home()


def machine_view(
    machine: Machine, T_camera_base: Array, legs: Integers | None = None
) -> MachineView:
    """View of a machine whose given legs are seen by a camera; by default all legs with tubes.

    Each leg is seen by its tube with the longest visible length at home. Raises InputError for a
    leg that does not exist, is repeated or has no tube, for cables over pulleys, and for joints
    whose axes do not meet.
    """
    if machine.layout.windings:
        raise InputError(
            what=f"control by the legs of {machine.name!r} takes rods, of which the whole length is"
            " seen",
            found="cables on pulleys or spools",
            expected="joints other than pulley and spool",
        )
    if len(machine.layout.offsets):
        raise InputError(
            what=f"control by the legs of {machine.name!r} takes rods between joint centres",
            found="universal joints whose axes do not meet",
            expected="joints without offset",
        )
    tubed = [j for j, leg in enumerate(machine.document.legs) if leg.tubes]
    wanted = np.array(tubed if legs is None else legs, dtype=int)
    missing = sorted({int(j) + 1 for j in wanted} - {j + 1 for j in tubed})
    if missing or not len(wanted) or len(set(wanted.tolist())) < len(wanted):
        raise InputError(
            what=f"control by the legs of {machine.name!r} needs legs with tubes, each once",
            found=f"legs {', '.join(str(int(j) + 1) for j in wanted)}" if len(wanted) else "none",
            expected=f"some of {', '.join(str(j + 1) for j in tubed)}" if tubed else "tubes",
            next_step="give the visible cylinders under tubes in the mechanism file, or other legs",
        )
    radius = machine.radii_of(wanted, visible_tubes(machine, wanted))
    return MachineView(machine, T_camera_base, wanted, radius)


def visible_tubes(machine: Machine, legs: Integers) -> Integers:
    """Number of the tube with the longest visible length at home, for each leg (s,)."""
    home = machine.with_values(machine.parameters.nominal).home()
    readings = machine.inverse(home[None])[0]
    ends = limb_ends(machine.layout, machine.parameters.nominal, readings, home)
    length = np.sqrt(dot(ends.b - ends.a, ends.b - ends.a))
    chosen: list[int] = []
    for j in legs:
        tubes = machine.document.legs[j].tubes
        visible = [min(tube.stop, float(length[j])) - tube.start for tube in tubes]
        chosen.append(int(np.argmax(visible)))
    return np.array(chosen, dtype=int)


@dataclass(frozen=True)
class Legs:
    """All limbs at one moment, base frame, leading axes broadcast; L legs, E rows of closure.

    a, b, u : (..., L, 3).
    length : (..., L).
    pivot : (..., 3) point of tau.
    a_by_reading : (..., L, 3).
    b_by_pose : (..., L, 3, 6), b_by_internal : (..., L, 3, n).
    rows : (..., E, 6), hinges : (..., E, n), drives : (..., E, m) derivatives of the closure by the
        twist, the hinges and the readings.
    """

    a: Array
    b: Array
    u: Array
    length: Array
    pivot: Array
    a_by_reading: Array
    b_by_pose: Array
    b_by_internal: Array
    rows: Array
    hinges: Array
    drives: Array


def legs_at(view: MachineView, T_base_platform: Array, readings: Array | None = None) -> Legs:
    """Limbs of the model at poses (..., 4, 4), with the platform's origin as pivot.

    readings : (..., m), by default from inverse kinematics.
    """
    layout, theta = view.machine.layout, view.theta
    c = closure_at(layout, theta, T_base_platform)
    if readings is not None:
        c = closure(layout, theta, readings, T_base_platform, c.internal)
    return _of_closure(c, c.rows.u, T_base_platform[..., :3, 3])


def legs_from_image(
    view: MachineView, u_camera: Array, readings: Array, near: Array | None = None
) -> Legs:
    """Limbs with measured directions; other quantities from the model and the readings.

    u_camera : (..., s, 3) measured directions of the seen legs, camera frame.
    readings : (..., m).
    near : (..., 4, 4) start of forward kinematics, where they are needed; by default the pose from
        the seen legs, or home. The pivot is the mean of the platform's joints.
    """
    rot_t = view.T_camera_base[..., :3, :3].mT[..., None, :, :]
    u = (rot_t @ u_camera[..., None])[..., 0]
    if view.by_image_alone:
        return _by_image(view, u, readings)
    layout, theta = view.machine.layout, view.theta
    start = _start(view, u, readings) if near is None else near
    fk = forward(layout, theta, readings, start)
    poses, internal = fk.T_base_platform, fk.internal
    c = closure(layout, theta, readings, poses, internal)
    directions = np.array(np.broadcast_to(c.rows.u, (*fk.converged.shape, *c.rows.u.shape[-2:])))
    directions[..., view.legs, :] = u
    legs = _of_closure(c, directions, poses[..., :3, 3])
    return moved_to(legs, legs.b.mean(axis=-2))


def moved_to(legs: Legs, pivot: Array) -> Legs:
    """Limbs with tau at another point (..., 3), base frame."""
    change = twist_change(legs.pivot - pivot)
    return replace(
        legs,
        pivot=pivot,
        b_by_pose=legs.b_by_pose @ change[..., None, :, :],
        rows=legs.rows @ change,
    )


def twist_change(arm: Array) -> Array:
    """Matrix (..., 6, 6) from a twist to the twist at a point displaced by ``arm`` (..., 3)."""
    out = np.zeros((*arm.shape[:-1], 6, 6))
    out[...] = np.eye(6)
    out[..., 3:, :3] = -skew(arm)
    return out


def _start(view: MachineView, u: Array, readings: Array) -> Array:
    """Pose from three or more seen legs of a rigid platform, else home; u in the base frame."""
    layout = view.machine.layout
    ends = limb_ends(layout, view.theta, readings, np.eye(4))
    shape = np.broadcast_shapes(ends.a.shape[:-2], u.shape[:-2])
    closing = np.flatnonzero(layout.closing[view.legs])
    if not view.rigid or len(closing) < 3 or layout.motion.shape[1] < 6:
        return np.broadcast_to(view.home, (*shape, 4, 4))
    legs = view.legs[closing]
    length = rod_lengths(layout, view.theta, readings)[..., legs, None]
    b = ends.a[..., legs, :] + length * u[..., closing, :]
    return register(np.broadcast_to(ends.b[..., legs, :], b.shape), b)


def _by_image(view: MachineView, u: Array, readings: Array) -> Legs:
    """Limbs of a rigid platform with all legs seen: A and length from the model, u measured."""
    layout, theta = view.machine.layout, view.theta
    order = np.argsort(view.legs)
    u = u[..., order, :]
    base = base_ends(layout, theta, readings)
    length = np.broadcast_to(base.length, u.shape[:-1])
    a = np.broadcast_to(base.a, u.shape)
    b = a + length[..., None] * u
    pivot = b.mean(axis=-2)
    b_by_pose = by_pose(b - pivot[..., None, :])
    by_reading = -dot(u, base.by_reading) - base.rate
    return Legs(
        a, b, u, length, pivot, np.broadcast_to(base.by_reading, u.shape), b_by_pose,
        np.zeros((*b.shape, 0)), along(u, b_by_pose), np.zeros((*length.shape, 0)),
        by_motors(layout, by_reading),
    )  # fmt: skip


def _of_closure(c: Closure, u: Array, pivot: Array) -> Legs:
    """Limbs of a closed machine, with given directions (..., L, 3).

    The rows of the rods' lengths use these directions; the rows of joint axes are unchanged.
    """
    layout, a_by_reading = c.layout, np.broadcast_to(c.a_by_reading, u.shape)
    b_by_internal = c.platform.by_internal
    rows, hinges, by_reading = c.rows.by_pose, c.rows.by_internal, c.by_reading
    # replace the rows of the rods' lengths, which come first, by those along the given directions
    if u is not c.rows.u:
        rows, hinges, by_reading = (np.array(x) for x in (rows, hinges, by_reading))
        keep, n = layout.closing, int(layout.closing.sum())
        own = u[..., keep, :]
        rows[..., :n, :] = along(own, c.b_by_pose[..., keep, :, :])
        hinges[..., :n, :] = along(own, b_by_internal[..., keep, :, :])
        shifted = dot(own, a_by_reading[..., keep, :])
        by_reading[..., :n] = -shifted - np.broadcast_to(c.base.rate, u.shape[:-1])[..., keep]
    return Legs(
        a=np.broadcast_to(c.a, u.shape),
        b=np.broadcast_to(c.b, u.shape),
        u=u,
        length=np.broadcast_to(c.rows.distance, u.shape[:-1]),
        pivot=pivot,
        a_by_reading=a_by_reading,
        b_by_pose=np.broadcast_to(c.b_by_pose, (*u.shape, 6)),
        b_by_internal=np.broadcast_to(b_by_internal, (*u.shape, layout.n_internal)),
        rows=rows,
        hinges=hinges,
        drives=by_motors(layout, by_reading),
    )


def true_edges(view: MachineView, T_base_platform: Array, readings: Array | None = None) -> Array:
    """Normals (..., s, 2, 3) of the seen legs' edges at poses (..., 4, 4), camera frame, [B] eq. 3.

    readings : (..., m), by default from inverse kinematics. NaN where the camera's centre lies in a
    leg, and where a limb cannot reach.
    """
    a, b = leg_ends_in_view(view, T_base_platform, readings)
    u, m = line_through(a, b)
    return edge_normal(u[..., None, :], m[..., None, :], view.radius[:, None], SIDE_SIGNS)


def leg_ends_in_view(
    view: MachineView, T_base_platform: Array, readings: Array | None = None
) -> tuple[Array, Array]:
    """Ends a and b (..., s, 3) of the seen legs, camera frame, m."""
    layout, theta = view.machine.layout, view.theta
    ends: LimbEnds = closure_at(layout, theta, T_base_platform)
    if readings is not None:
        ends = limb_ends(layout, theta, readings, T_base_platform, ends.internal)
    T = view.T_camera_base[..., None, :, :]
    return apply(T, ends.a[..., view.legs, :]), apply(T, ends.b[..., view.legs, :])


def directions_of(normals: Array) -> Array:
    """Directions u (..., s, 3) of legs from their edges (..., s, 2, 3); errata, [B] eq. 11."""
    u = cross(normals[..., 1, :], normals[..., 0, :])
    return u / np.sqrt(dot(u, u))[..., None]
