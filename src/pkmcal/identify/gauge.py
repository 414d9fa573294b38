"""Which frames the results are told in: an explicit choice that can be changed afterwards.

Neither edges nor readings know where the base frame or the platform frame is: a rigid motion
of either, six numbers each, changes parameters, stations and poses together and no residual.
A gauge is a set of twelve linear constraints on the joint centres that picks one choice.

Frame changes, by the perturbation of :mod:`pkmcal.geometry.rigid`: E moves base coordinates,
``A' = E A``, ``T_camera_base' = T_camera_base E^-1``, and F platform coordinates,
``B' = F B``, ``T_base_platform' = E T_base_platform F^-1``. Twelve numbers: E's six, F's six.

Where an articulated platform's numbers begin is a choice as well, and continues the twelve:

- A hinge's point may slide along its axis, with the bar's joints sliding back, and the bar's
  joints may be told turned about the hinge, with its internal coordinate turned back. Two numbers
  a bar: shift (m) and turn (rad).
- The joint of a bar that keeps its direction may move together with its leg's base, by three
  numbers a leg (m, base frame): [C]'s d with y_BC.

Not all are allowed: fixed and tied parameters leave some combinations, with the frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, inverse, perturb, skew
from pkmcal.identify.estimate import State, estimated_unknowns
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.layout import LimbLayout


class Gauge(Protocol):
    """A choice of frames: linear constraints C theta = C drawing."""

    @property
    def name(self) -> str:
        """The choice in words."""
        ...

    def constraints(self, machine: Machine) -> Array:
        """C, (12, P): six rows on the base centres, six on the platform centres."""
        ...


FRAME_CHANGE_ROUNDING = 1e-12
"""Share of the machine's size, and of a direction's one, below which a value is the rounding of a
change of frames: some thousand times a double's."""
COLLINEAR_POINTS_SINE = 1e-3
"""Three points nearer to one line than this part of their distances fix no turn about it."""


@dataclass(frozen=True)
class ThreeCentres:
    """Frames by three joint centres, 3-2-1, base and platform alike.

    The first leg's centre keeps its drawing value, the second lies in the drawing's direction
    from it, the third in the drawing's plane. Legs from 0; a machine of fewer than five legs
    uses its first three. Where all legs meet in one point of a platform, that keeps its drawing
    value, and no turn of it is told from the base's.
    """

    legs: tuple[int, int, int] = (0, 2, 4)

    @property
    def name(self) -> str:
        """The choice in words."""
        return "three centres: legs " + ", ".join(str(j + 1) for j in self.legs)

    def constraints(self, machine: Machine) -> Array:
        """C (12, P)."""
        legs = self.legs if max(self.legs) < machine.n_legs else (0, 1, 2)
        rows = [
            _three_rows(machine.parameters.drawing, index[list(legs)])
            for index in centre_index(machine.layout)
        ]
        return np.concatenate(rows)


@dataclass(frozen=True)
class BestFit:
    """Frames that lay the joint centres on the drawing's by least squares ([B] eq. 15)."""

    @property
    def name(self) -> str:
        """The choice in words."""
        return "best fit of all centres to the drawing"

    def constraints(self, machine: Machine) -> Array:
        """C (12, P): at the least-squares fit sum(A - D) = 0 and sum(D x A) = 0, D centred."""
        drawing = machine.parameters.drawing
        rows = []
        for index in centre_index(machine.layout):
            d = drawing[index] - drawing[index].mean(axis=0)
            block = np.zeros((6, drawing.size))
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


def _three_rows(drawing: Array, index: Integers) -> Array:
    """The 3-2-1 constraints of one body, (6, P); the first three alone where it is a point."""
    p1, p2, p3 = drawing[index]
    if (p1 == p2).all() and (p1 == p3).all():
        rows = np.zeros((6, drawing.size))
        rows[[0, 1, 2], index[0]] = 1.0
        return rows
    along = (p2 - p1) / np.linalg.norm(p2 - p1)
    normal = cross(along, p3 - p1)
    normal = normal / np.linalg.norm(normal)
    rows = np.zeros((6, drawing.size))
    rows[[0, 1, 2], index[0]] = 1.0
    for row, leg, direction in ((3, 1, normal), (4, 1, cross(normal, along)), (5, 2, normal)):
        rows[row, index[leg]] = direction
        rows[row, index[0]] = -direction
    return rows


def generators(layout: LimbLayout, theta: Array, drawing: Array | None = None) -> Array:
    """How parameters move with the twelve numbers of a frame change, (..., P, 12).

    drawing : (P,) where directions stay on the tangent planes of the drawing's.
    """
    out = np.zeros((*theta.shape[:-1], theta.shape[-1] + 1, 12))
    for group in (*layout.base, *layout.platform):
        # what the file is silent about lands in the last row
        out[..., group.index, :] = group.carrier.by_frames(group.of(theta))
    out = out[..., :-1, :]
    for body, axes in enumerate(layout.turning):
        if not axes.size:
            continue
        at = slice(6 * body, 6 * body + 3)
        out[..., axes, at] = -skew(theta[..., axes])
        if drawing is not None:
            along = drawing[axes][..., None, :] @ out[..., axes, at]
            out[..., axes, at] -= theta[..., axes, None] * along
    return out


def mount_generators(T_mount: Array, on_platform: Booleans) -> Array:
    """How boards (..., M, 4, 4) fixed to a body move with a frame change, (..., M, 6, 12)."""
    if not on_platform.size:
        return np.zeros((*T_mount.shape[:-2], 6, 12))
    own = np.zeros((*T_mount.shape[:-2], 6, 6))
    own[..., :, :] = np.eye(6)
    own[..., 3:, :3] = -skew(T_mount[..., :3, 3])
    moves = on_platform[:, None, None]
    return np.concatenate([np.where(moves, 0.0, own), np.where(moves, own, 0.0)], axis=-1)


def station_generators(T_camera_base: Array) -> Array:
    """How stations (..., S, 4, 4) move with a frame change, (..., S, 6, 12)."""
    out = np.zeros((*T_camera_base.shape[:-2], 6, 12))
    out[..., :3, :3] = -T_camera_base[..., :3, :3]
    out[..., 3:, 3:6] = -T_camera_base[..., :3, :3]
    return out


def pose_generators(T_base_platform: Array) -> Array:
    """How platform poses (..., K, 4, 4) move with a frame change, (..., K, 6, 12)."""
    rot, t = T_base_platform[..., :3, :3], T_base_platform[..., :3, 3]
    out = np.zeros((*T_base_platform.shape[:-2], 6, 12))
    out[..., :3, :3], out[..., 3:, 3:6] = np.eye(3), np.eye(3)
    out[..., 3:, :3] = -skew(t)
    out[..., :3, 6:9], out[..., 3:, 9:] = -rot, -rot
    return out


def other_moves(layout: LimbLayout) -> int:
    """Numbers besides the frames'."""
    return 2 * layout.n_internal + 3 * _floating(layout).size


def _floating(layout: LimbLayout) -> Integers:
    """Legs that end on bars which keep their direction."""
    legs = [g.legs for g in layout.platform if g.carrier.floats]
    return np.concatenate(legs) if legs else np.zeros(0, dtype=int)


def move_generators(layout: LimbLayout, theta: Array, drawing: Array | None = None) -> Array:
    """How parameters move with all these changes, (..., P, 12 + n)."""
    frames = generators(layout, theta, drawing)
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
    """Both ends of each floating leg by its three numbers, (..., P, 3 legs)."""
    legs = _floating(layout)
    out = np.zeros((theta.shape[-1], 3 * legs.size))
    columns = np.arange(3 * legs.size).reshape(-1, 3)
    for index in centre_index(layout):
        out[index[legs], columns] = 1.0
    return np.broadcast_to(out, (*theta.shape[:-1], *out.shape))


def slid(layout: LimbLayout, theta: Array, y: Array) -> Array:
    """Parameters (..., P) after the changes y (..., n) that are not the frames'."""
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
    """By how much the internal coordinates become less, (..., n_internal)."""
    return y[..., 1 : 2 * layout.n_internal : 2]


def freedoms(machine: Machine) -> Array:
    """Frame changes that the machine's model allows, a basis (12, g), at the drawing's values.

    All twelve for a spatial machine without fixed parameters. Fixed or tied parameters take
    some away; a machine that moves in fewer directions keeps those that respect its motion.
    """
    shifted = generators(machine.layout, machine.parameters.drawing)
    return _allowed(machine, shifted, respecting_motion(machine.layout.motion))


def conventions(machine: Machine) -> Array:
    """Frame and hinge changes that the machine's model allows, a basis (12 + n, g), at the
    drawing's values: what is a choice, not a question to the data.
    """
    frames = freedoms(machine)
    return _with_hinges(machine, frames, 2 * machine.layout.n_internal)


def exact_moves(machine: Machine) -> Array:
    """All changes that leave every prediction as it is, a basis (12 + n, g), at the drawing's."""
    frames = respecting_motion(machine.layout.motion)
    return _with_hinges(machine, frames, other_moves(machine.layout))


def _with_hinges(machine: Machine, frames: Array, n: int) -> Array:
    """What the model allows of frame changes (12, g) and of the first n other changes."""
    shifted = move_generators(machine.layout, machine.parameters.drawing)
    candidates = np.zeros((shifted.shape[1], frames.shape[1] + n))
    candidates[:12, : frames.shape[1]] = frames
    candidates[12 : 12 + n, frames.shape[1] :] = np.eye(n)
    return _allowed(machine, shifted, candidates)


def _allowed(machine: Machine, shifted: Array, candidates: Array) -> Array:
    """Combinations of candidates (c, k) that move free parameters only; shifted : (P, c)."""
    free, shifted = machine.parameters.free_matrix(), shifted @ candidates
    outside = shifted - free @ np.linalg.lstsq(free, shifted, rcond=None)[0]
    _, s, vt = np.linalg.svd(outside)
    size = np.zeros(candidates.shape[1])
    size[: s.size] = s
    return candidates @ vt[size < 1e-9].T


def respecting_motion(motion: Array) -> Array:
    """Frame changes after which the platform still moves along ``motion``, (12, g)."""
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
    """Three centres where three legs' joints make a triangle on both bodies, or meet in one point
    of a platform that does not turn; else the best fit.
    """
    legs = (0, 2, 4) if machine.n_legs > 4 else (0, 1, 2)
    if machine.n_legs < 3:
        return BestFit()
    base, platform = centre_index(machine.layout)
    points = machine.parameters.drawing[platform]
    meet = not machine.layout.motion[:3].any() and bool((points == points[0]).all())
    for index in (base,) if meet else (base, platform):
        p1, p2, p3 = machine.parameters.drawing[index[list(legs)]]
        sides = np.linalg.norm([p2 - p1, p3 - p1], axis=1)
        if np.linalg.norm(np.cross(p2 - p1, p3 - p1)) <= COLLINEAR_POINTS_SINE * sides.prod():
            return BestFit()
    return ThreeCentres(legs)


def frame_rows(machine: Machine, gauge: Gauge) -> Array:
    """The gauge's constraints as rows (g, P) that frame changes alone can meet.

    A machine with fewer frames than the gauge has constraints (planar, translational) cannot meet
    them all; these are the combinations that it can.
    """
    c, drawing = gauge.constraints(machine), machine.parameters.drawing
    slope = c @ generators(machine.layout, drawing) @ freedoms(machine)
    return np.linalg.pinv(slope) @ c


def projector(machine: Machine, theta: Array, gauge: Gauge) -> Array:
    """What turns any result into the gauge, to first order: N C with y = -N C (theta - drawing).

    theta : (..., P). Returns (..., 12, P); with it the S-transformation of the parameters is
    ``I - G N C``, G of :func:`generators`.
    """
    c = gauge.constraints(machine)
    basis = freedoms(machine)
    if basis.shape[1] == 0:
        return np.zeros((*theta.shape[:-1], *c.shape))
    slope = c @ generators(machine.layout, theta) @ basis
    return basis @ np.linalg.pinv(slope) @ c


def alignment(machine: Machine, state: State, gauge: Gauge) -> tuple[Array, Array]:
    """The frame changes E and F, (4, 4) each, that bring a state into the gauge.

    Newton steps, each followed by an exact rigid motion of the centres.
    """
    e, f, theta = np.eye(4), np.eye(4), state.theta
    for _ in range(30):
        change = projector(machine, theta, gauge)
        y = -change @ (theta - machine.parameters.drawing)
        e, f = perturb(np.eye(4), y[:6]) @ e, perturb(np.eye(4), y[6:]) @ f
        theta = moved_centres(machine.layout, state.theta, e, f)
        if np.abs(y).max() < 1e-15:
            break
    return e, f


def in_gauge(machine: Machine, state: State, gauge: Gauge) -> State:
    """The same machine, stations and poses told in the gauge's frames; no residual changes.

    What the frames make zero is zero, not the rounding of their change.
    """
    shifted = changed_frames(machine.layout, state, *alignment(machine, state, gauge))
    lengths = np.array([unit == "m" for unit in machine.parameters.units])
    size = np.where(lengths, np.abs(shifted.theta[..., lengths]).max(initial=0.0), 1.0)
    rounding = np.abs(shifted.theta) < FRAME_CHANGE_ROUNDING * size
    return replace(shifted, theta=np.where(rounding, 0.0, shifted.theta))


def changed_frames(layout: LimbLayout, state: State, e: Array, f: Array) -> State:
    """The state after frame changes E and F, (4, 4) each."""
    return replace(
        state,
        theta=moved_centres(layout, state.theta, e, f),
        T_camera_base=state.T_camera_base @ inverse(e),
        T_base_platform=e @ state.T_base_platform @ inverse(f),
        T_mount=moved_mounts(state.T_mount, state.on_platform, e, f),
    )


def moved_mounts(T_mount: Array, on_platform: Booleans, e: Array, f: Array) -> Array:
    """Boards' poses (..., M, 4, 4) in their bodies' new frames."""
    if not on_platform.size:
        return T_mount
    frames = np.stack([e, f], axis=-3)
    return frames[..., on_platform.astype(int), :, :] @ T_mount


def moved_centres(layout: LimbLayout, theta: Array, e: Array, f: Array) -> Array:
    """Parameters (..., P) in frames moved by E (..., 4, 4) on the base, F on the platform.

    Centres move and directions turn with their body; what a carrier has besides follows.
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
    """Errors of (theta, stations, mounts) before the frame changes to those after, (n, n),
    n = P + 6 S + 6 M.

    Centres turn with their frame. A station's left perturbation (omega, tau) becomes
    (omega, tau + [R R_E^T t_E]x omega), as ``(T E^-1)`` keeps the camera's own axes. A mount's
    are turned with its body.
    """
    estimated = estimated_unknowns(before)
    out = np.eye(estimated.count)
    for transform, axes in zip((e, f), layout.turning, strict=True):
        out[axes[:, :, None], axes[:, None, :]] = transform[:3, :3]
    # the carriers' own; the last takes what the file is silent about
    own = np.pad(out[estimated.machine, estimated.machine], ((0, 1), (0, 1)))
    for group in (*layout.base, *layout.platform):
        by = group.carrier.carried(group.of(before.theta), e[None], f[None])
        own[group.index[:, :, None], group.index[:, None, :]] = by
    out[estimated.machine, estimated.machine] = own[:-1, :-1]
    for s, station in enumerate(before.T_camera_base):
        at = estimated.stations.start + 6 * s
        out[at + 3 : at + 6, at : at + 3] = skew(station[:3, :3] @ e[:3, :3].T @ e[:3, 3])
    for m, moving in enumerate(before.on_platform):
        at, frame = estimated.mounts.start + 6 * m, f if moving else e
        out[at : at + 3, at : at + 3] = out[at + 3 : at + 6, at + 3 : at + 6] = frame[:3, :3]
    return out


def transformation(machine: Machine, state: State, gauge: Gauge) -> Array:
    """S-transformation (n, n) of the errors of (theta, stations, mounts) into the gauge,
    n = P + 6 S + 6 M.

    Errors in the gauge are ``J e``: the frame change that restores the constraints is taken
    out of all alike. Constrained coordinates get zero variance exactly.
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
