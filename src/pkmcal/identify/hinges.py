"""Changes of a machine's numbers, besides those of its frames, that no measurement knows.

Where an articulated platform's numbers begin is a choice, as the frames are:

- A hinge's point may slide along its axis, with the bar's joints sliding back, and the bar's
  joints may be told turned about the hinge, with its internal coordinate turned back. Two numbers
  a bar: shift (m) and turn (rad).
- The joint of a bar that keeps its direction may move together with its leg's base, by three
  numbers a leg (m, base frame): [C]'s d with y_BC.

They continue the frame changes' twelve, see :mod:`pkmcal.identify.gauge`. Not all are allowed:
fixed and tied parameters leave some combinations, with the frames.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.gauge import centre_index, freedoms, generators, respecting_motion
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import LimbLayout


def conventions(machine: Machine) -> Array:
    """Frame and hinge changes that the machine's model allows, a basis (12 + n, g), at the
    drawing's values: what is a choice, not a question to the data.
    """
    frames, n = freedoms(machine), count(machine.layout)
    basis = np.zeros((12 + n, frames.shape[1] + 2 * machine.layout.n_internal))
    basis[:12, : frames.shape[1]] = frames
    basis[12 : 12 + 2 * machine.layout.n_internal, frames.shape[1] :] = np.eye(
        2 * machine.layout.n_internal
    )
    return _allowed(machine, basis)


def exact_moves(machine: Machine) -> Array:
    """All changes that leave every prediction as it is, a basis (12 + n, g), at the drawing's."""
    n = count(machine.layout)
    if not n:
        return freedoms(machine)
    motion = respecting_motion(machine.layout.motion)
    basis = np.zeros((12 + n, motion.shape[1] + n))
    basis[:12, : motion.shape[1]] = motion
    basis[12:, motion.shape[1] :] = np.eye(n)
    return _allowed(machine, basis)


def count(layout: LimbLayout) -> int:
    """Numbers besides the frames'."""
    return 2 * layout.n_internal + 3 * _floating(layout).size


def _floating(layout: LimbLayout) -> Integers:
    """Legs that end on bars which keep their direction."""
    legs = [g.legs for g in layout.platform if g.carrier.floats]
    return np.concatenate(legs) if legs else np.zeros(0, dtype=int)


def _allowed(machine: Machine, candidates: Array) -> Array:
    """Combinations of the candidates that move free parameters only."""
    free = machine.parameters.free_matrix()
    moved = move_generators(machine.layout, machine.parameters.drawing) @ candidates
    outside = moved - free @ np.linalg.lstsq(free, moved, rcond=None)[0]
    _, s, vt = np.linalg.svd(outside)
    size = np.zeros(candidates.shape[1])
    size[: s.size] = s
    return candidates @ vt[size < 1e-9].T


def move_generators(layout: LimbLayout, theta: Array, drawing: Array | None = None) -> Array:
    """How parameters move with all these changes, (..., P, 12 + n)."""
    frames = generators(layout, theta, drawing)
    if not count(layout):
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
    if not count(layout):
        return theta
    out = theta + (_shifts(layout, theta) @ y[..., 2 * layout.n_internal :, None])[..., 0]
    for group in layout.platform:
        if group.carrier.turns:
            own = 2 * layout.internal[group.legs]
            moved = group.carrier.slid(group.of(out), y[..., own], y[..., own + 1])
            out[..., group.index] = moved
    return out


def turned_back(layout: LimbLayout, y: Array) -> Array:
    """By how much the internal coordinates become less, (..., n_internal)."""
    return y[..., 1 : 2 * layout.n_internal : 2]
