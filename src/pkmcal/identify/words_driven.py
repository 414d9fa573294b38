"""Changes that people can picture of machines with cranks, sliders and bars, seen by a board.

What such machines leave open has names of its own: of two bodies' joints only the difference
counts where the one keeps its direction in the other's frame; frames turn where the file holds
what would have to turn along; sizes that all legs share cancel over few poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.gauge import generators

if TYPE_CHECKING:
    from pkmcal.identify.words_families import Circumstances
    from pkmcal.mechanisms import Machine

AXES = "xyz"
SIZES = ("radius", "height", "arm", "angle", "rod")
"""What a leg on a crank or a slider is made of."""
HELD = 1e-6
"""Metres a metre (or a radian) of a held value that free values leave undone, at most, for it to be
a convention: both are derivatives at one machine, alike but for rounding."""

Change = tuple[str, tuple[int, ...], Array, str]
"""Kind, legs, columns and details of a family."""


def is_driven(machine: Machine) -> bool:
    """Whether readings move joints on the base instead of changing lengths."""
    layout = machine.layout
    return bool(((layout.actuated >= 0) & ~layout.rod_reads).any())


def driven_families(around: Circumstances) -> Iterator[Change]:
    """Kind, legs, columns and details of what is particular to such machines, likeliest first."""
    if not is_driven(around.machine):
        return
    legs = tuple(range(around.machine.n_legs))
    against = _against(around)
    yield "against", legs, against, ""
    for axis in (2, 0, 1):
        # with shifts of both ends: what is held of the one end, the other makes good
        yield "turn", legs, np.concatenate([_turn(around, axis), against], axis=1), AXES[axis]
    for j in legs:
        lean = _lean(around, j)
        if lean.any():
            yield "lean", (j,), lean, ""
    sizes = size_columns(around)
    together = {name: column.sum(axis=1, keepdims=True) for name, column in sizes.items()}
    for n in range(1, len(sizes) + 1):
        for chosen in combinations(sizes, n):
            columns = np.concatenate([together[name] for name in chosen], axis=1)
            yield "sizes", legs, columns, ",".join(chosen)
    for n in range(2, len(sizes) + 1):
        for chosen in combinations(sizes, n):
            for j in legs:
                columns = np.stack([sizes[name][:, j] for name in chosen], axis=1)
                if np.abs(columns).max(axis=0).all():
                    yield "leg sizes", (j,), columns, ",".join(chosen)


def remaining(around: Circumstances) -> Iterator[Change]:
    """Tilts of all axes on the base, each joint shifted along its axis."""
    if not is_driven(around.machine):
        return
    at, values = around.at, around.machine.values
    axes = at.base_axis
    has = np.flatnonzero(axes[:, 0] >= 0)
    out = np.zeros((len(values), len(has), 4))
    for n, j in enumerate(has):
        out[axes[j], n, :3] = np.eye(3)
        out[at.base[j], n, 3] = values[axes[j]]
    if has.size:
        yield "tilts", tuple(has.tolist()), out.reshape(len(out), -1), ""


def _against(around: Circumstances) -> Array:
    """Both joints of a leg shifted alike, along x of all legs, y of all legs, then z; (P, 3 L)."""
    at = around.at
    out = np.zeros((len(around.machine.parameters), 3, around.machine.n_legs))
    legs = np.arange(around.machine.n_legs)
    for axis in range(3):
        for side in (at.base, at.platform):
            rows = side[:, axis]
            out[rows[rows >= 0], axis, legs[rows >= 0]] = 1.0
    return out.reshape(len(out), -1)


def _turn(around: Circumstances, axis: int) -> Array:
    """Turns of the base frame and of the platform frame, (P, 2)."""
    moved = generators(around.machine.layout, around.machine.values)
    return moved[:, [axis, 6 + axis]]


def _lean(around: Circumstances, leg: int) -> Array:
    """A guide leaning about the middle of where its carriage was, (P, 3); zero of other joints."""
    machine, at = around.machine, around.at
    out = np.zeros((len(machine.parameters), 3))
    if machine.document.legs[leg].base.joint == "slider":
        readings = machine.inverse(around.T_base_platform)
        middle = float(np.nanmean(readings[:, machine.layout.actuated[leg]]))
        out[at.base_axis[leg]] = np.eye(3)
        out[at.base[leg]] = -middle * np.eye(3)
    return out


def size_columns(around: Circumstances) -> dict[str, Array]:
    """Each leg's sizes, one column (P,) a leg: by name (P, L); those that the machine has.

    Radius : the base joint outwards from the middle of all. Height : it along z.
    """
    machine, at = around.machine, around.at
    names = {name: k for k, name in enumerate(machine.parameters.names)}
    n = machine.n_legs
    centres = machine.values[at.base]
    outwards = (centres - centres.mean(axis=0)) * [1, 1, 0]
    size = np.linalg.norm(outwards, axis=1, keepdims=True)
    outwards = outwards / np.where(size > 0, size, 1.0)
    out = {name: np.zeros((len(names), n)) for name in SIZES}
    for j in range(n):
        out["radius"][at.base[j], j] = outwards[j]
        out["height"][at.base[j, 2], j] = 1.0
        rows = {kind: names.get(f"legs[{j + 1}].base.{kind}", -1) for kind in ("arm", "angle")}
        for kind, row in {**rows, "rod": int(at.rod[j])}.items():
            if row >= 0:
                out[kind][row, j] = 1.0
    return {name: column for name, column in out.items() if column.any()}


def conventions_held(machine: Machine, effect: Array) -> tuple[tuple[str, ...], int]:
    """Held parameters that say nothing of the machine, by name, and how many combinations of the
    other held ones do so: the free ones, or the frames, do all that they could do.

    effect : (r, P) the platform's displacements by the parameters, frames taken out.
    """
    table = machine.parameters
    if not table.fixed:
        return (), 0
    every = replace(table, fixed=()).free_matrix()
    held = effect @ every @ every[[table.index(name) for name in table.fixed]].T
    free = effect @ table.free_matrix()
    q, s, _ = np.linalg.svd(free, full_matrices=False)
    q = q[:, s > 1e-9 * s.max(initial=0.0)]
    left = held - q @ (q.T @ held)
    # a metre moves joints by about a metre: without effect is without effect in metres
    alone = np.linalg.norm(left, axis=0) < HELD
    names = tuple(name for name, said in zip(table.fixed, alone, strict=True) if said)
    others = left[:, ~alone]
    kinds = np.unique(np.round(others / HELD), axis=1)  # what is tied counts once
    rank = int(np.sum(np.linalg.svd(others, compute_uv=False) > HELD))
    return names, kinds.shape[1] - rank
