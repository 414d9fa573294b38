"""Gauge: the choice of base and platform frames, and the transformations between choices.

Neither edges nor readings determine the base frame or the platform frame: a rigid motion of either,
six numbers each, changes parameters, stations and poses together and no residual. A gauge is a set
of twelve linear constraints on the joint centres that selects one choice.

Frame changes, by the perturbation of :mod:`pkmcal.geometry.rigid`: E acts on base coordinates,
``A' = E A``, ``T_camera_base' = T_camera_base E^-1``, and F on platform coordinates, ``B' = F B``,
``T_base_platform' = E T_base_platform F^-1``. Twelve numbers: E's six, then F's six.

The origins of an articulated platform's numbers are a choice as well, and follow the twelve:

- The point of a hinge may slide along its axis, with the bar's joints sliding back; and the bar's
  joints may be described turned about the hinge, with its internal coordinate turned back. Two
  numbers a bar: shift (m) and angle (rad).
- The joint of a bar that keeps its direction may move together with its leg's base, by three
  numbers a leg (m, base frame): d in [C] with y_BC.

Fixed and tied parameters allow only some combinations of these and of the frame changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, inverse, perturb, skew
from pkmcal.identify.state import State, estimated_unknowns
from pkmcal.levels import NEGLIGIBLE, ROUNDING
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.layout import LimbLayout


class Gauge(Protocol):
    """Choice of frames: linear constraints C theta = C theta_nominal."""

    @property
    def name(self) -> str:
        """Name of the choice, for people."""
        ...

    def constraints(self, machine: Machine) -> Array:
        """C, (12, P): six rows on the base centres, six on the platform centres."""
        ...


FRAME_CHANGE_ROUNDING = 1e-12
"""Value after a change of frames that is rounding, relative to the machine's size, or to 1 for
directions: some thousand times the rounding of a double."""
COLLINEAR_POINTS_SINE = NEGLIGIBLE
"""Distance of three points from one line, relative to their distances, below which their
information on the rotation about it is negligible, as in registration. Then the frame is another
one, which changes coordinates but no figure of the machine."""


@dataclass(frozen=True)
class ThreeCentres:
    """Frames by three joint centres, 3-2-1, for base and platform.

    The first leg's centre keeps its nominal value, the second lies in the nominal direction from
    it, the third in the nominal plane. Where all legs meet in one point of the platform, that point
    keeps its nominal value, and the platform has no rotation constraints.

    legs : from 0; a machine of fewer than five legs uses its first three.
    """

    legs: tuple[int, int, int] = (0, 2, 4)

    @property
    def name(self) -> str:
        """Name of the choice, for people."""
        return "three centres: legs " + ", ".join(str(j + 1) for j in self.legs)

    def constraints(self, machine: Machine) -> Array:
        """C (12, P)."""
        legs = self.legs if max(self.legs) < machine.n_legs else (0, 1, 2)
        rows = [
            _three_rows(machine.parameters.nominal, index[list(legs)])
            for index in centre_index(machine.layout)
        ]
        return np.concatenate(rows)


@dataclass(frozen=True)
class BestFit:
    """Frames that align the joint centres with the nominal ones by least squares ([B] eq. 15)."""

    @property
    def name(self) -> str:
        """Name of the choice, for people."""
        return "best fit of all centres to the nominal model"

    def constraints(self, machine: Machine) -> Array:
        """C (12, P): sum(A - D) = 0 and sum(D x A) = 0 at the least-squares fit, D nominal and
        centred.
        """
        nominal = machine.parameters.nominal
        rows = []
        for index in centre_index(machine.layout):
            d = nominal[index] - nominal[index].mean(axis=0)
            block = np.zeros((6, nominal.size))
            for axis in range(3):
                block[:3, index[:, axis]] = np.eye(3)[:, axis, None]
                block[3:, index[:, axis]] = skew(d)[:, :, axis].T
            rows.append(block)
        return np.concatenate(rows)


def centre_index(layout: LimbLayout) -> tuple[Integers, Integers]:
    """Positions of the legs' base and platform centres among the parameters, (L, 3) each."""
    out: list[Integers] = []
    for groups in (layout.base, layout.platform):
        index = np.zeros((layout.n_legs, 3), dtype=int)
        for group in groups:
            index[group.legs] = group.index[:, :3]
        out.append(index)
    return out[0], out[1]


def _three_rows(nominal: Array, index: Integers) -> Array:
    """3-2-1 constraints of one body, (6, P); only the first three where all joints coincide."""
    p1, p2, p3 = nominal[index]
    if (p1 == p2).all() and (p1 == p3).all():
        rows = np.zeros((6, nominal.size))
        rows[[0, 1, 2], index[0]] = 1.0
        return rows
    along = (p2 - p1) / np.linalg.norm(p2 - p1)
    normal = cross(along, p3 - p1)
    normal = normal / np.linalg.norm(normal)
    rows = np.zeros((6, nominal.size))
    rows[[0, 1, 2], index[0]] = 1.0
    for row, leg, direction in ((3, 1, normal), (4, 1, cross(normal, along)), (5, 2, normal)):
        rows[row, index[leg]] = direction
        rows[row, index[0]] = -direction
    return rows


def generators(layout: LimbLayout, theta: Array, nominal: Array | None = None) -> Array:
    """Derivatives (..., P, 12) of the parameters by a frame change.

    nominal : (P,) nominal values, where directions stay on the tangent planes of the nominal ones.
    """
    out = np.zeros((*theta.shape[:-1], theta.shape[-1] + 1, 12))
    for group in (*layout.base, *layout.platform):
        # parameters that are not in the file have the last index, a row that is discarded
        out[..., group.index, :] = group.carrier.by_frames(group.of(theta))
    out = out[..., :-1, :]
    for body, axes in enumerate(layout.turning):
        if not axes.size:
            continue
        at = slice(6 * body, 6 * body + 3)
        out[..., axes, at] = -skew(theta[..., axes])
        if nominal is not None:
            along = nominal[axes][..., None, :] @ out[..., axes, at]
            out[..., axes, at] -= theta[..., axes, None] * along
    return out


def mount_generators(T_mount: Array, on_platform: Booleans) -> Array:
    """Derivatives (..., M, 6, 12) of the poses (..., M, 4, 4) of boards on a body by a frame
    change.
    """
    if not on_platform.size:
        return np.zeros((*T_mount.shape[:-2], 6, 12))
    own = np.zeros((*T_mount.shape[:-2], 6, 6))
    own[..., :, :] = np.eye(6)
    own[..., 3:, :3] = -skew(T_mount[..., :3, 3])
    moves = on_platform[:, None, None]
    return np.concatenate([np.where(moves, 0.0, own), np.where(moves, own, 0.0)], axis=-1)


def station_generators(T_camera_base: Array) -> Array:
    """Derivatives (..., S, 6, 12) of the stations' poses (..., S, 4, 4) by a frame change."""
    out = np.zeros((*T_camera_base.shape[:-2], 6, 12))
    out[..., :3, :3] = -T_camera_base[..., :3, :3]
    out[..., 3:, 3:6] = -T_camera_base[..., :3, :3]
    return out


def pose_generators(T_base_platform: Array) -> Array:
    """Derivatives (..., K, 6, 12) of the platform's poses (..., K, 4, 4) by a frame change."""
    rot, t = T_base_platform[..., :3, :3], T_base_platform[..., :3, 3]
    out = np.zeros((*T_base_platform.shape[:-2], 6, 12))
    out[..., :3, :3], out[..., 3:, 3:6] = np.eye(3), np.eye(3)
    out[..., 3:, :3] = -skew(t)
    out[..., :3, 6:9], out[..., 3:, 9:] = -rot, -rot
    return out


def other_moves(layout: LimbLayout) -> int:
    """Number of gauge freedoms besides the frame changes."""
    return 2 * layout.n_internal + 3 * _floating(layout).size


def _floating(layout: LimbLayout) -> Integers:
    """Legs on bars that keep their direction."""
    legs = [g.legs for g in layout.platform if g.carrier.floats]
    return np.concatenate(legs) if legs else np.zeros(0, dtype=int)


def move_generators(layout: LimbLayout, theta: Array, nominal: Array | None = None) -> Array:
    """Derivatives (..., P, 12 + n) of the parameters by frame changes and the n other gauge
    freedoms.
    """
    frames = generators(layout, theta, nominal)
    if not other_moves(layout):
        return frames
    hinges = np.zeros((*theta.shape, 2 * layout.n_internal))
    for group in layout.platform:
        if group.carrier.turns:
            by = group.carrier.by_slide(group.of(theta))
            for leg, own in enumerate(layout.internal[group.legs]):
                hinges[..., group.index[leg], 2 * own : 2 * own + 2] = by[..., leg, :, :]
    return np.concatenate([frames, hinges, _shifts(layout, theta)], axis=-1)


def _shifts(layout: LimbLayout, theta: Array) -> Array:
    """Derivatives (..., P, 3 legs) of both ends of each floating leg by its three numbers."""
    legs = _floating(layout)
    out = np.zeros((theta.shape[-1], 3 * legs.size))
    columns = np.arange(3 * legs.size).reshape(-1, 3)
    for index in centre_index(layout):
        out[index[legs], columns] = 1.0
    return np.broadcast_to(out, (*theta.shape[:-1], *out.shape))


def slid(layout: LimbLayout, theta: Array, y: Array) -> Array:
    """Parameters (..., P) after the gauge changes y (..., n) besides those of the frames."""
    if not other_moves(layout):
        return theta
    out = theta + (_shifts(layout, theta) @ y[..., 2 * layout.n_internal :, None])[..., 0]
    for group in layout.platform:
        if group.carrier.turns:
            own = 2 * layout.internal[group.legs]
            shifted = group.carrier.slid(group.of(out), y[..., own], y[..., own + 1])
            out[..., group.index] = shifted
    return out


def turned_back(layout: LimbLayout, y: Array) -> Array:
    """Decrease of the internal coordinates by the gauge changes y, (..., n_internal)."""
    return y[..., 1 : 2 * layout.n_internal : 2]


def freedoms(machine: Machine) -> Array:
    """Basis (12, g) of the frame changes that the machine's model allows, at the nominal values.

    All twelve for a spatial machine without fixed parameters. Fixed or tied parameters remove some.
    A machine with fewer than six degrees of freedom has only the frame changes that preserve its
    motion.
    """
    shifted = generators(machine.layout, machine.parameters.nominal)
    return _allowed(machine, shifted, respecting_motion(machine.layout.motion))


def conventions(machine: Machine) -> Array:
    """Basis (12 + n, g) of the frame and hinge changes that the machine's model allows, at the
    nominal values: the directions of the parameters that are conventions, which no data determine.
    """
    frames = freedoms(machine)
    return _with_hinges(machine, frames, 2 * machine.layout.n_internal)


def exact_moves(machine: Machine) -> Array:
    """Basis (12 + n, g) of all changes that leave every prediction unchanged, at the nominal
    values.
    """
    frames = respecting_motion(machine.layout.motion)
    return _with_hinges(machine, frames, other_moves(machine.layout))


def _with_hinges(machine: Machine, frames: Array, n: int) -> Array:
    """Combinations of frame changes (12, g) and of the first n other changes that the model
    allows.
    """
    shifted = move_generators(machine.layout, machine.parameters.nominal)
    candidates = np.zeros((shifted.shape[1], frames.shape[1] + n))
    candidates[:12, : frames.shape[1]] = frames
    candidates[12 : 12 + n, frames.shape[1] :] = np.eye(n)
    return _allowed(machine, shifted, candidates)


def _allowed(machine: Machine, shifted: Array, candidates: Array) -> Array:
    """Combinations of candidates (c, k) that change free parameters only.

    shifted : (P, c) derivatives of the parameters.
    """
    free, shifted = machine.parameters.free_matrix(), shifted @ candidates
    outside = shifted - free @ np.linalg.lstsq(free, shifted, rcond=None)[0]
    _, s, vt = np.linalg.svd(outside)
    size = np.zeros(candidates.shape[1])
    size[: s.size] = s
    return candidates @ vt[size < ROUNDING].T


def respecting_motion(motion: Array) -> Array:
    """Basis (12, g) of the frame changes after which the platform still moves along ``motion`` (6,
    m).
    """
    if motion.shape[1] == 6:
        return np.eye(12)
    both = np.concatenate([np.eye(6), np.eye(6)])
    if motion[5].any() and motion[2].any():  # schoenflies: each frame shifted and turned about z
        return np.eye(12)[:, [2, 3, 4, 5, 8, 9, 10, 11]]
    if not motion[[2, 5]].any():  # shifts in a plane: each frame's, and turns of both together
        return np.concatenate([np.eye(12)[:, [3, 4, 9, 10]], both[:, [2, 5]]], axis=1)
    if motion[:3].any():  # planar: each frame in the plane, and both together along its normal
        return np.concatenate([np.eye(12)[:, [2, 3, 4, 8, 9, 10]], both[:, [5]]], axis=1)
    # translation: each frame's origin, and both frames turned together
    return np.concatenate([np.eye(12)[:, [3, 4, 5, 9, 10, 11]], both[:, :3]], axis=1)


def default_gauge(machine: Machine) -> Gauge:
    """Three centres where the joints of three legs form a triangle on both bodies, or coincide in
    one point of a platform that does not rotate; else the best fit.
    """
    legs = (0, 2, 4) if machine.n_legs > 4 else (0, 1, 2)
    if machine.n_legs < 3:
        return BestFit()
    base, platform = centre_index(machine.layout)
    points = machine.parameters.nominal[platform]
    meet = not machine.layout.motion[:3].any() and bool((points == points[0]).all())
    for index in (base,) if meet else (base, platform):
        p1, p2, p3 = machine.parameters.nominal[index[list(legs)]]
        sides = np.linalg.norm([p2 - p1, p3 - p1], axis=1)
        if np.linalg.norm(np.cross(p2 - p1, p3 - p1)) <= COLLINEAR_POINTS_SINE * sides.prod():
            return BestFit()
    return ThreeCentres(legs)


def frame_rows(machine: Machine, gauge: Gauge) -> Array:
    """Constraints of the gauge as rows (g, P) that frame changes can satisfy.

    A machine with fewer frame changes than the gauge has constraints (planar, translational) cannot
    satisfy all of them; these rows are the combinations that it can.
    """
    c, nominal = gauge.constraints(machine), machine.parameters.nominal
    slope = c @ generators(machine.layout, nominal) @ freedoms(machine)
    return np.linalg.pinv(slope) @ c


def projector(machine: Machine, theta: Array, gauge: Gauge) -> Array:
    """Frame change that brings parameters into the gauge, to first order: N C in y = -N C (theta -
    theta_nominal).

    theta : (..., P). Returns (..., 12, P); the S-transformation of the parameters is ``I - G N C``
    with G of :func:`generators`.
    """
    c = gauge.constraints(machine)
    basis = freedoms(machine)
    if basis.shape[1] == 0:
        return np.zeros((*theta.shape[:-1], *c.shape))
    slope = c @ generators(machine.layout, theta) @ basis
    return basis @ np.linalg.pinv(slope) @ c


def alignment(machine: Machine, state: State, gauge: Gauge) -> tuple[Array, Array]:
    """Frame changes E and F, (4, 4) each, that bring a state into the gauge.

    Newton steps, each followed by an exact rigid motion of the centres.
    """
    e, f, theta = np.eye(4), np.eye(4), state.theta
    for _ in range(30):
        change = projector(machine, theta, gauge)
        y = -change @ (theta - machine.parameters.nominal)
        e, f = perturb(np.eye(4), y[:6]) @ e, perturb(np.eye(4), y[6:]) @ f
        theta = moved_centres(machine.layout, state.theta, e, f)
        if np.abs(y).max() < 1e-15:
            break
    return e, f


def in_gauge(machine: Machine, state: State, gauge: Gauge) -> State:
    """State in the frames of the gauge; no residual changes.

    Values that the gauge makes zero are set to zero, without rounding.
    """
    shifted = changed_frames(machine.layout, state, *alignment(machine, state, gauge))
    lengths = np.array([unit == "m" for unit in machine.parameters.units])
    size = np.where(lengths, np.abs(shifted.theta[..., lengths]).max(initial=0.0), 1.0)
    rounding = np.abs(shifted.theta) < FRAME_CHANGE_ROUNDING * size
    return replace(shifted, theta=np.where(rounding, 0.0, shifted.theta))


def changed_frames(layout: LimbLayout, state: State, e: Array, f: Array) -> State:
    """State after the frame changes E and F, (4, 4) each."""
    return replace(
        state,
        theta=moved_centres(layout, state.theta, e, f),
        T_camera_base=state.T_camera_base @ inverse(e),
        T_base_platform=e @ state.T_base_platform @ inverse(f),
        T_mount=moved_mounts(state.T_mount, state.on_platform, e, f),
    )


def moved_mounts(T_mount: Array, on_platform: Booleans, e: Array, f: Array) -> Array:
    """Poses (..., M, 4, 4) of boards in the new frames of their bodies."""
    if not on_platform.size:
        return T_mount
    frames = np.stack([e, f], axis=-3)
    return frames[..., on_platform.astype(int), :, :] @ T_mount


def moved_centres(layout: LimbLayout, theta: Array, e: Array, f: Array) -> Array:
    """Parameters (..., P) in frames changed by E (..., 4, 4) on the base and F on the platform.

    Centres move and directions rotate with their body; other parameters of a carrier follow.
    """
    e, f = e[..., None, :, :], f[..., None, :, :]
    out = np.concatenate([theta, np.zeros((*theta.shape[:-1], 1))], axis=-1)
    for group in (*layout.base, *layout.platform):
        out[..., group.index] = group.carrier.reframed(group.of(theta), e, f)
    out = out[..., :-1]
    for transform, axes in zip((e, f), layout.turning, strict=True):
        out[..., axes] = (transform[..., :3, :3] @ theta[..., axes, None])[..., 0]
    return out


def carried_errors(layout: LimbLayout, before: State, e: Array, f: Array) -> Array:
    """Jacobian (n, n) of (theta, stations, mounts) after frame changes by those before, n = P + 6 S
    + 6 M.

    Centres rotate with their frame. A station's left perturbation (omega, tau) becomes (omega, tau
    + [R R_E^T t_E]x omega), as ``T E^-1`` keeps the camera's axes. A mount's perturbation rotates
    with its body.
    """
    estimated = estimated_unknowns(before)
    out = np.eye(estimated.count)
    for transform, axes in zip((e, f), layout.turning, strict=True):
        out[axes[:, :, None], axes[:, None, :]] = transform[:3, :3]
    # the carriers' parameters; those that are not in the file have the last index
    own = np.pad(out[estimated.machine, estimated.machine], ((0, 1), (0, 1)))
    for group in (*layout.base, *layout.platform):
        by = group.carrier.carried(group.of(before.theta), e[None], f[None])
        own[group.index[:, :, None], group.index[:, None, :]] = by
    out[estimated.machine, estimated.machine] = own[:-1, :-1]
    # stations
    for s, station in enumerate(before.T_camera_base):
        at = estimated.stations.start + 6 * s
        out[at + 3 : at + 6, at : at + 3] = skew(station[:3, :3] @ e[:3, :3].T @ e[:3, 3])
    # boards
    for m, moving in enumerate(before.on_platform):
        at, frame = estimated.mounts.start + 6 * m, f if moving else e
        out[at : at + 3, at : at + 3] = out[at + 3 : at + 6, at + 3 : at + 6] = frame[:3, :3]
    return out


def transformation(machine: Machine, state: State, gauge: Gauge) -> Array:
    """S-transformation (n, n) of the errors of (theta, stations, mounts) into the gauge, n = P + 6
    S + 6 M.

    Errors in the gauge are ``S e``: the frame change that restores the constraints is applied to
    all unknowns together. Constrained coordinates get exactly zero variance.
    """
    change = projector(machine, state.theta, gauge)
    shifted = np.concatenate(
        [
            generators(machine.layout, state.theta),
            station_generators(state.T_camera_base).reshape(-1, 12),
            mount_generators(state.T_mount, state.on_platform).reshape(-1, 12),
        ]
    )
    out = np.eye(len(shifted))
    out[:, : change.shape[1]] -= shifted @ change
    return out
