"""What the data leave open, said so that people know what to do.

    data -> directions that they do not see -> nearest motions with a name -> sentences

The null space of the data's information has no axes of its own: any rotation of it is as good.
So changes that people can picture (:mod:`pkmcal.identify.motions`) are held against the whole
space, one after the other: what lies in it is taken out and said
(:mod:`pkmcal.identify.sentences`), the rest stays for the next. All comparisons are made in units
of the drawing's tolerances, with the frames' freedoms taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.identify.assembly import machine_size
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.identify.motions import NamedChanges, Situation, all_radii, candidates
from pkmcal.identify.sentences import OpenMotion, Sentence, few, sentence
from pkmcal.identify.tool import platform_by_parameters
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import nonzero

if TYPE_CHECKING:
    from pkmcal.identify.bed import Bed
    from pkmcal.identify.covariance import Identifiability, ParameterDirection
    from pkmcal.measurements import EdgeSet, Measurements

INSIDE_OPEN_SHARES = (0.999, 0.95)
"""Shares of a change (squared) that lie in the open space for it to explain part of that space:
first what fits exactly, since much looks alike once frames are taken out, then what fits in all
but name. The space is that of the estimate, whose poses' noise bends what would be exact."""
WEAK_INFORMATION = 1 / 3
"""Information below which a direction counts as not told: the data then decide less than a tenth
of its variance. Poses that only shift seem to turn by their noise, so directions that nothing fixes
come out with a trace of information."""
UNIDENTIFIED_SHARE = 0.5
"""Part of what is known beforehand of a place or turn from which the data do not determine it."""
NEW_CHANGE_SINE = 0.1
"""Sine of the angle to what is said already below which a change says nothing new."""
STEPS_TO_FEWEST_NUMBERS, CHEAP_FRAME_WEIGHT = 20, 10.0
"""Steps to the fewest numbers, and how much less a frame's costs: they are not said."""
CONVENTION_NULL_SHARE = 1e-6
"""Metres a metre (or a radian) of a held value that free values leave undone, at most, for it to be
a convention: both are derivatives at one machine, alike but for rounding."""


@dataclass(frozen=True)
class Condition:
    """One of [A]'s conditions, counted by :mod:`pkmcal.papers.conditions`.

    equation : its number in the paper. needed, available : counts. met : needed <= available.
    text : what is counted, a sentence for people.
    """

    equation: str
    needed: int
    available: int
    met: bool
    text: str


@dataclass(frozen=True)
class Findings:
    """What the data tell and do not tell: the test, its words, and the paper's conditions.

    identifiability : rank and spectrum. unidentified : what such data do not tell, of
    ``told.unidentified`` and of what they know ``WEAK_INFORMATION``. weak : what the drawing knows
    better. by_drawing : how far (m, as ``Sentence.moves_platform``) the platform moves when all
    parameters are as wrong as the drawing's tolerances let expect. conventional : held parameters
    for which any value would do; also_conventional : combinations of the other held ones. bed : how
    flat it will be, where nothing but heights was measured.
    """

    identifiability: Identifiability
    unidentified: tuple[Sentence, ...]
    weak: tuple[Sentence, ...]
    by_drawing: float
    conditions: tuple[Condition, ...] = ()
    conventional: tuple[str, ...] = ()
    also_conventional: int = 0
    bed: Bed | None = None

    __repr__ = short_repr


def explain(
    ranks: Identifiability,
    estimate: Estimate,
    visible: Booleans,
    conditions: tuple[Condition, ...] = (),
    bed: Bed | None = None,
) -> Findings:
    """The findings of an estimate; visible : (S, L) legs that each station sees. bed : where
    nothing but heights was measured.

    Stations that a board on the base joins are one here, see :func:`observed_by_boards`.
    """
    machine, table = estimate.machine, estimate.machine.parameters
    poses = estimate.state.T_base_platform[estimate.configurations]
    photographed = estimate.edge_weights.size > 0
    around = Situation(machine, visible, poses, photographed, only_heights(estimate))
    effect = platform_by_parameters(machine, poses)
    unseen = {id(d) for d in ranks.unidentified}

    def text(directions: tuple[ParameterDirection, ...]) -> tuple[Sentence, ...]:
        reference = [0.0 if id(d) in unseen else d.information for d in directions]
        return describe(around, direction_vectors(directions, machine), np.array(reference), effect)

    lost = (*ranks.unidentified, *(d for d in ranks.weak if d.information < WEAK_INFORMATION))
    weak = tuple(d for d in ranks.weak if d.information >= WEAK_INFORMATION)
    # Poses and heights blend what they hardly see with what they do not: together it has names.
    sentences = (*text(lost), *text(weak)) if photographed else text((*lost, *weak))
    conventional, others = conventions_held(machine, effect)
    return Findings(
        ranks,
        tuple(s for s in sentences if not s.weak),
        tuple(s for s in sentences if s.weak),
        float(np.linalg.norm(effect @ (table.free_matrix() * table.tolerances_free()))),
        conditions,
        conventional,
        others,
        bed,
    )


def only_heights(estimate: Estimate) -> bool:
    """Whether nothing but heights was measured: what is not measured leaves no residual."""
    poses = estimate.pose_residuals
    others = estimate.edge_weights.size + estimate.link_weights.size
    return not others and len(poses) > 0 and not poses[:, :5].any()


def identified(machine: Machine, covariance: Array) -> Booleans:
    """Which of the six numbers of poses the data determine, (..., 6); covariance (..., 6, 6), rad
    and m. The others are conventions, or where the search began, and stand nowhere as numbers.

    Of a target's place no more than the machine's size is known beforehand, and of a turn nothing:
    a number that is known no better than half of that is not known by the data.
    """
    sigma = np.sqrt(np.maximum(np.einsum("...ii->...i", covariance), 0.0))
    return sigma < UNIDENTIFIED_SHARE * np.repeat([1.0, machine_size(machine)], 3)


def direction_vectors(directions: tuple[ParameterDirection, ...], machine: Machine) -> Array:
    """Directions as rows (n, P), in the parameters' units."""
    return np.array([d.vector for d in directions]).reshape(-1, len(machine.parameters))


def observed_legs(edges: EdgeSet, weights: Array, n_stations: int, n_legs: int) -> Booleans:
    """Legs that each station sees, (S, L); edges given up, of weight (N,) below a half, aside."""
    inliers = np.asarray(weights) >= 0.5
    out = np.zeros((n_stations, n_legs), dtype=bool)
    out[edges.station[inliers], edges.leg[inliers]] = True
    return out


def observed_by_boards(visible: Booleans, measurements: Measurements) -> Booleans:
    """The same (S, L), where stations that see one board on the base count as one station."""
    out, poses = visible.copy(), measurements.poses
    for k, mount in enumerate(measurements.mounts):
        stations = np.unique(poses.station[poses.mount == k])
        if mount.body == "base" and stations.size:
            out[stations] = out[stations].any(axis=0)
    return out


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
    q = q[:, nonzero(s)]
    residual = held - q @ (q.T @ held)
    # a metre moves joints by about a metre: without effect is without effect in metres
    alone = np.linalg.norm(residual, axis=0) < CONVENTION_NULL_SHARE
    names = tuple(name for name, is_alone in zip(table.fixed, alone, strict=True) if is_alone)
    others = residual[:, ~alone]
    kinds = np.unique(np.round(others / CONVENTION_NULL_SHARE), axis=1)  # what is tied counts once
    rank = int(np.sum(np.linalg.svd(others, compute_uv=False) > CONVENTION_NULL_SHARE))
    return names, kinds.shape[1] - rank


# ------------------------------------------------------------------ directions to motions


class _Open(NamedTuple):
    """What is left open, in units of the drawing's deviations: rows (n, P) orthonormal, their
    covariance (n, n) as the estimate leaves it, frames (P, g) orthonormal, unit (P,).
    """

    rows: Array
    covariance: Array
    frames: Array
    unit: Array


def describe(
    around: Situation, null: Array, information: Array | None = None, effect: Array | None = None
) -> tuple[Sentence, ...]:
    """Sentences for a space of changes that the data do not see.

    null : (n, P) changes of all parameters in their units, any basis.
    information : (n,) singular values of what the data know of each after all, in units of the
    tolerance, 0 where absent: from ``WEAK_INFORMATION`` on it is said that the drawing knows
    it better, not that it is free. effect : (r, P) as :func:`platform_by_parameters` gives it.
    """
    machine = around.machine
    space = _open(machine, null, information)
    if not len(space.rows):
        return ()
    if effect is None:
        effect = platform_by_parameters(machine, around.T_base_platform)
    if not around.photographed:  # nobody asks a board how thick legs are
        space = _without(space, _within(all_radii(around).columns, space, INSIDE_OPEN_SHARES[0]))
    results = _merged(around, _explained(around, space))
    text = [sentence(around, part, space.unit, *_moves(part, space, effect)) for part in results]
    return few(text)


def _open(machine: Machine, null: Array, information: Array | None) -> _Open:
    """The open space without frames, in units of the drawing's deviations."""
    squares = machine.parameters.free_matrix() ** 2
    # tied parameters share one deviation
    shared = np.where(squares.sum(axis=1) > 0, squares @ squares.sum(axis=0), 1.0)
    unit = machine.parameters.tolerance * np.sqrt(np.maximum(shared, 1.0))
    shifted = generators(machine.layout, machine.values) @ freedoms(machine)
    frames = _orthonormal((shifted / unit[:, None]).T).T
    rows = null / unit
    rows = rows - (rows @ frames) @ frames.T
    size = np.linalg.norm(rows, axis=1)
    s = np.zeros(len(rows)) if information is None else information
    rows, s = rows[size > 0] / size[size > 0, None], s[size > 0]
    basis = _orthonormal(rows)
    if information is None or not len(rows):
        return _Open(basis, np.eye(len(basis)), frames, unit)
    mixed = np.linalg.lstsq(rows.T, basis.T, rcond=None)[0].T
    return _Open(basis, mixed / (1 + s**2) @ mixed.T, frames, unit)


def _orthonormal(rows: Array, least: float = 1e-6) -> Array:
    """An orthonormal basis (k, P) of the rows' space."""
    if rows.size == 0:
        return np.zeros((0, rows.shape[-1]))
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[s > least * max(float(s[0]), 1e-300)]


def _explained(around: Situation, space: _Open) -> list[OpenMotion]:
    """Motions that lie in the open space, each with what it says anew."""
    parts: list[OpenMotion] = []
    done = np.zeros((0, space.rows.shape[1]))
    reference_values, whole = list(candidates(around)), space
    for motion, inside in [
        *((m, share) for share in INSIDE_OPEN_SHARES for m in reference_values[:-1]),
        (reference_values[-1], 0.0),
    ]:
        if len(done) == len(whole.rows):
            break
        names = _within(motion.columns, space, inside)
        new = _directions(names - (names @ done.T) @ done)
        if len(new) == 0:
            continue
        if motion is reference_values[-1]:
            names = new
        done = _orthonormal(np.concatenate([done, new]))
        numbers = _coefficients(motion, space, names)
        own = numbers @ motion.columns.T / space.unit
        parts.append(OpenMotion(motion, motion.legs, names, numbers, own, len(new)))
        if motion.convention:
            space = _without(space, new)
    return parts


def _without(space: _Open, directions: Array) -> _Open:
    """The open space where changes (k, P) in it count for nothing, as frames do."""
    retained_rows = np.linalg.svd(space.rows @ directions.T)[0][:, len(directions) :].T
    frames = np.concatenate([space.frames, directions.T], axis=1)
    return _Open(
        retained_rows @ space.rows,
        retained_rows @ space.covariance @ retained_rows.T,
        frames,
        space.unit,
    )


def _directions(rows: Array) -> Array:
    """Orthonormal directions (k, P) that the rows still have, those that rounding left aside."""
    if rows.size == 0:
        return rows[:0]
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[s > NEW_CHANGE_SINE]


def _within(changes: Array, space: _Open, inside: float) -> Array:
    """Directions (k, P) of the open space that changes (P, m) can make, orthonormal."""
    columns = (changes / space.unit[:, None]).T
    size = np.linalg.norm(columns, axis=1)
    columns = columns[size > 0] / size[size > 0, None]
    # what only moves the frames changes nothing, whatever rounding leaves of it
    basis = _orthonormal(columns - (columns @ space.frames) @ space.frames.T, 1e-4)
    u, s, _ = np.linalg.svd(space.rows @ basis.T)
    s = np.pad(s, (0, len(space.rows) - len(s)))[: len(space.rows)]
    return u[:, s**2 > inside].T @ space.rows


def _coefficients(motion: NamedChanges, space: _Open, values: Array) -> Array:
    """The motion's own numbers (k, m) for each direction, frames aside.

    Frames leave a choice: of a single change the numbers whose magnitudes have the smallest sum,
    by reweighted least squares, since people want to read as few as possible.
    """
    columns = motion.columns / space.unit[:, None]
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    m, both = len(scale), np.concatenate([columns / scale, space.frames], axis=1)
    weight = np.ones(both.shape[1])
    few = len(values) == 1 and m > 1 and not (motion.how or motion.convention)
    solved = np.linalg.lstsq(both, values.T, rcond=1e-6)[0]
    for _ in range(STEPS_TO_FEWEST_NUMBERS if few else 0):
        weight[:m] = np.sqrt(np.abs(solved[:m, 0]) / max(np.abs(solved[:m, 0]).max(), 1e-300))
        weight[m:] = CHEAP_FRAME_WEIGHT
        solved = np.linalg.lstsq(both * weight, values.T, rcond=1e-6)[0] * weight[:, None]
    return (solved[:m] / scale[:, None]).T


def _merged(around: Situation, parts: list[OpenMotion]) -> list[OpenMotion]:
    """Parts with one sentence as one: the same of several legs, or the same legs' again."""
    out: dict[tuple[object, ...], OpenMotion] = {}
    for part in parts:
        single = len(part.legs) == 1
        key = (part.motion.one, *((part.how(around), len(part.space)) if single else part.legs))
        out[key] = out[key].and_of(part) if key in out else part
    return [_with_last_leg(part, parts) for part in out.values()]


def _with_last_leg(part: OpenMotion, parts: list[OpenMotion]) -> OpenMotion:
    """Sizes of all legs but one, of which the common part is said too, are those of all legs."""
    same = [p.legs for p in parts if p.motion.labels == part.motion.labels and len(p.legs) > 1]
    single = bool(part.motion.labels) and len(part.motion.legs) == 1
    if single and same and len(part.legs) == len(same[0]) - 1:
        return replace(part, legs=same[0])
    return part


def _moves(part: OpenMotion, space: _Open, effect: Array) -> tuple[float, bool]:
    """How far (m) it moves the platform, and whether the data know something of it after all."""
    value = _directions(part.space)
    mixed = value @ space.rows.T
    shifted = effect @ (space.unit[:, None] * value.T)
    covariance = mixed @ space.covariance @ mixed.T
    # the estimate's information is the drawing's, one, and the data's
    data = mixed @ (np.linalg.inv(space.covariance) - np.eye(len(space.rows))) @ mixed.T
    above_limit = float(np.sqrt(max(np.linalg.eigvalsh(data)[-1], 0.0)))
    return float(np.sqrt(np.sum((shifted @ covariance) * shifted))), above_limit >= WEAK_INFORMATION
