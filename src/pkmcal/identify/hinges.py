"""Where a hinged bar's numbers begin is a choice, as the frames are: no measurement knows it.

The hinge's point may slide along its axis, with the bar's joints sliding back, and the bar's joints
may be told turned about the hinge, with its internal coordinate turned back. Two numbers a bar:
shift (m) and turn (rad). They continue the frame changes' twelve, see
:mod:`pkmcal.identify.gauge`.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.limbs import LimbLayout


def exact_moves(machine: Machine) -> Array:
    """Frame and hinge changes that the machine's model allows, a basis (12 + 2n, g), at the
    drawing's values.
    """
    frames, layout = freedoms(machine), machine.layout
    n = 2 * layout.n_internal
    if not n:
        return frames
    drawing, free = machine.parameters.drawing, machine.parameters.free_matrix()
    candidates = np.eye(12 + n, frames.shape[1] + n)
    candidates[:12, : frames.shape[1]] = frames
    candidates[12:, frames.shape[1] :] = np.eye(n)
    candidates[:12, frames.shape[1] :] = 0.0
    moved = move_generators(layout, drawing) @ candidates
    outside = moved - free @ np.linalg.lstsq(free, moved, rcond=None)[0]
    _, s, vt = np.linalg.svd(outside)
    size = np.zeros(candidates.shape[1])
    size[: s.size] = s
    return candidates @ vt[size < 1e-9].T


def move_generators(layout: LimbLayout, theta: Array, drawing: Array | None = None) -> Array:
    """How parameters move with frame and hinge changes, (..., P, 12 + 2n)."""
    frames = generators(layout, theta, drawing)
    if not layout.n_internal:
        return frames
    out = np.zeros((*theta.shape, 2 * layout.n_internal))
    for group in layout.platform:
        if group.carrier.turns:
            by = group.carrier.by_slide(group.of(theta))
            for leg, own in enumerate(layout.internal[group.legs]):
                out[..., group.index[leg], 2 * own : 2 * own + 2] = by[..., leg, :, :]
    return np.concatenate([frames, out], axis=-1)


def slid(layout: LimbLayout, theta: Array, y: Array) -> Array:
    """Parameters (..., P) after hinge changes y (..., 2n)."""
    out = theta.copy()
    for group in layout.platform if layout.n_internal else ():
        if group.carrier.turns:
            own = 2 * layout.internal[group.legs]
            moved = group.carrier.slid(group.of(theta), y[..., own], y[..., own + 1])
            out[..., group.index] = moved
    return out
