"""Unidentifiable directions, described by named motions.

    data -> null space of their information -> nearest named motions -> sentences

The basis of a null space is arbitrary. So named motions (:mod:`pkmcal.identify.motions`) are
compared with the whole space, one after the other: a motion that lies in the space is removed from
it and described (:mod:`pkmcal.identify.sentences`), and the next motion is compared with the
remaining space. All comparisons are in units of the prior sigmas, with the freedoms of the frames
removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.identify.assembly import machine_size
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.identify.motions import (
    UNIDENTIFIED,
    NamedChanges,
    Situation,
    UnidentifiedOptions,
    all_radii,
    candidates,
)
from pkmcal.identify.sentences import OpenMotion, Sentence, few, negligible_shift, sentence
from pkmcal.identify.tool import platform_by_parameters
from pkmcal.levels import MAJORITY, NEGLIGIBLE
from pkmcal.mechanisms import Machine
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.solver.ranks import nonzero

if TYPE_CHECKING:
    from pkmcal.identify.bed import Bed
    from pkmcal.identify.covariance import Identifiability, ParameterDirection
    from pkmcal.measurements import EdgeSet, Measurements

CONVENTION_NULL_SHARE = 1e-6
"""Effect of a fixed parameter on the platform, in m per m or rad, that the free parameters cannot
reproduce; below this value it is rounding, and the parameter is a convention."""
PURE_FRAME_SINE = 1e-4
"""Sine of the angle between a change and the frames' changes below which it is one of them."""


@dataclass(frozen=True)
class Condition:
    """One of [A]'s conditions, counted by :mod:`pkmcal.identify.conditions`.

    equation : its number in the paper.
    needed, available : numbers of unknowns and of equations.
    met : needed <= available.
    text : sentence on what is counted.
    """

    equation: str
    needed: int
    available: int
    met: bool
    text: str


@dataclass(frozen=True)
class Identification:
    """Directions of the machine that the data determine, and those that they do not.

    identifiability : rank and spectrum of the information.
    unidentified : sentences on directions without information, or with less than
        ``UnidentifiedOptions.weak``.
    weak : sentences on directions that the nominal model determines better than the data.
    by_nominal : displacement of the platform by the prior sigmas of all parameters, m, as
        ``Sentence.moves_platform``.
    undetermined_shift : displacement of the platform by the part of the nominal model's errors that
        the data do not correct, m.
    n_harmless : number of independent unidentifiable changes that do not move the platform.
    conditions : [A]'s conditions.
    conventional : fixed parameters that are conventions; any value would do.
    also_conventional : number of combinations of other fixed parameters that are conventions.
    bed : predicted flatness, if only heights were measured.
    """

    identifiability: Identifiability
    unidentified: tuple[Sentence, ...]
    weak: tuple[Sentence, ...]
    by_nominal: float
    undetermined_shift: float = 0.0
    n_harmless: int = 0
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
    options: UnidentifiedOptions = UNIDENTIFIED,
) -> Identification:
    """Identification of an estimate: what the data determine, with sentences on the rest.

    The displacements and numbers of changes, on which a verdict depends, are computed from the
    whole null space; named motions are used for the sentences only.

    visible : (S, L) legs that each station measures; stations that a board on the base joins count
        as one, see :func:`observed_by_boards`.
    bed : predicted flatness, if only heights were measured.
    """
    machine, table = estimate.machine, estimate.machine.parameters
    # situation of the session, and effect of the parameters on the platform
    poses = estimate.state.T_base_platform[estimate.configurations]
    imaged = estimate.edge_weights.size > 0
    heights = estimate.purpose is Purpose.HEIGHT
    around = Situation(machine, visible, poses, imaged, heights, options)
    effect = platform_by_parameters(machine, poses)
    unseen = {id(d) for d in ranks.unidentified}

    def space(directions: tuple[ParameterDirection, ...]) -> tuple[Array, Array]:
        """Directions as rows, and their information."""
        reference = [0.0 if id(d) in unseen else d.information for d in directions]
        return direction_vectors(directions, machine), np.array(reference)

    def text(directions: tuple[ParameterDirection, ...]) -> tuple[Sentence, ...]:
        """Sentences on some directions."""
        return describe(around, *space(directions), effect)

    # a direction with information s, in units of the prior, has the posterior variance
    # 1 / (1 + s^2): 1 / (1 + s^2)^2 by the nominal model's errors, the rest by the data's noise
    left = ranks.directions / (1 + ranks.singular_values[:, None] ** 2)
    # sentences on undetermined directions, and on those that the nominal model determines better
    least = options.weak
    lost = (*ranks.unidentified, *(d for d in ranks.weak if d.information < least))
    weak = tuple(d for d in ranks.weak if d.information >= least)
    # Singular directions of poses and heights are mixtures of weakly identified and unidentified
    # motions, so only the whole space contains the named motions.
    sentences = (*text(lost), *text(weak)) if imaged else text((*lost, *weak))
    conventional, others = conventions_held(machine, effect)
    return Identification(
        ranks,
        tuple(s for s in sentences if not s.weak),
        tuple(s for s in sentences if s.weak),
        float(np.linalg.norm(effect @ (table.free_matrix() * table.tolerances_free()))),
        float(np.linalg.norm(effect @ left.T)),
        int(np.sum(_shifts(_open(around, *space(lost)), effect) <= negligible_shift(table))),
        conditions,
        conventional,
        others,
        bed,
    )


def identified(machine: Machine, covariance: Array) -> Booleans:
    """Whether the data determine each of the six numbers of poses, (..., 6).

    The others are conventions or starting values, and are not reported. A number is determined if
    its standard deviation is below half of its prior scale: the machine's size for positions, one
    radian for rotations.

    covariance : (..., 6, 6) of poses by (omega, tau), rad and m.
    """
    sigma = np.sqrt(np.maximum(np.einsum("...ii->...i", covariance), 0.0))
    return sigma < MAJORITY * np.repeat([1.0, machine_size(machine)], 3)


def direction_vectors(directions: tuple[ParameterDirection, ...], machine: Machine) -> Array:
    """Directions as rows (n, P), in the parameters' units."""
    return np.array([d.vector for d in directions]).reshape(-1, len(machine.parameters))


def observed_legs(edges: EdgeSet, weights: Array, n_stations: int, n_legs: int) -> Booleans:
    """Legs that each station measures, (S, L), without rejected edges; weights (N,)."""
    inliers = np.asarray(weights) >= INLIER_WEIGHT
    out = np.zeros((n_stations, n_legs), dtype=bool)
    out[edges.station[inliers], edges.leg[inliers]] = True
    return out


def observed_by_boards(visible: Booleans, measurements: Measurements) -> Booleans:
    """Legs by station (S, L), where stations that measure one board on the base count as one."""
    out, poses = visible.copy(), measurements.poses
    for k, mount in enumerate(measurements.mounts):
        stations = np.unique(poses.station[poses.mount == k])
        if mount.body == "base" and stations.size:
            out[stations] = out[stations].any(axis=0)
    return out


def conventions_held(machine: Machine, effect: Array) -> tuple[tuple[str, ...], int]:
    """Fixed parameters that are conventions, and number of combinations of other fixed ones that
    are.

    A fixed parameter is a convention if free parameters or frames reproduce its whole effect.
    effect : (r, P) displacements of the platform by the parameters, frames removed.
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
    # displacements are about as large as changes of the parameters, so the threshold is absolute
    alone = np.linalg.norm(residual, axis=0) < CONVENTION_NULL_SHARE
    names = tuple(name for name, is_alone in zip(table.fixed, alone, strict=True) if is_alone)
    others = residual[:, ~alone]
    kinds = np.unique(np.round(others / CONVENTION_NULL_SHARE), axis=1)  # tied ones count once
    rank = int(np.sum(np.linalg.svd(others, compute_uv=False) > CONVENTION_NULL_SHARE))
    return names, kinds.shape[1] - rank


# ------------------------------------------------------------------ directions to motions


class _Open(NamedTuple):
    """Space of changes that the data do not determine, in prior sigmas.

    rows : (n, P) orthonormal basis.
    covariance : (n, n) posterior in that basis.
    frames : (P, g) orthonormal frame changes.
    unit : (P,) prior sigmas.
    """

    rows: Array
    covariance: Array
    frames: Array
    unit: Array


def describe(
    around: Situation, null: Array, information: Array | None = None, effect: Array | None = None
) -> tuple[Sentence, ...]:
    """Sentences on a space of changes that the data do not determine.

    null : (n, P) changes of all parameters in their units, any basis.
    information : (n,) singular values of the data's information on each direction, in units of the
        prior, 0 by default. From ``UnidentifiedOptions.weak`` on, the sentence states that the
        nominal model determines the direction better; below, that it is free.
    effect : (r, P) as returned by :func:`platform_by_parameters`.
    """
    space = _open(around, null, information)
    if not len(space.rows):
        return ()
    if effect is None:
        effect = platform_by_parameters(around.machine, around.T_base_platform)
    results = _merged(around, _explained(around, space))
    text = [
        sentence(around, part, space.unit, *_moves(around, part, space, effect)) for part in results
    ]
    return few(text)


def _open(around: Situation, null: Array, information: Array | None) -> _Open:
    """Undetermined space in prior sigmas, without frames and, without images, without the tubes'
    radii.
    """
    space = _open_with_tubes(around.machine, null, information)
    if around.imaged or not len(space.rows):
        return space
    return _without(
        space, _within(_cosines(all_radii(around).columns, space), space, 1 - NEGLIGIBLE)
    )


def _shifts(space: _Open, effect: Array) -> Array:
    """Displacements (n,) of the platform by independent changes in the undetermined space, each one
    posterior standard deviation, m.
    """
    root = np.linalg.cholesky(space.covariance)
    shifts = np.linalg.svd(effect @ (space.unit[:, None] * (space.rows.T @ root)), compute_uv=False)
    return np.pad(shifts, (0, len(root) - len(shifts)))


def _open_with_tubes(machine: Machine, null: Array, information: Array | None) -> _Open:
    """Undetermined space in prior sigmas, frames removed."""
    # prior sigmas
    squares = machine.parameters.free_matrix() ** 2
    # tied parameters share one deviation
    shared = np.where(squares.sum(axis=1) > 0, squares @ squares.sum(axis=0), 1.0)
    unit = machine.parameters.tolerance * np.sqrt(np.maximum(shared, 1.0))
    # changes without frames, each of length one
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
    # posterior covariance in the basis
    mixed = np.linalg.lstsq(rows.T, basis.T, rcond=None)[0].T
    return _Open(basis, mixed / (1 + s**2) @ mixed.T, frames, unit)


def _orthonormal(rows: Array, least: float = 1e-6) -> Array:
    """Orthonormal basis (k, P) of the rows' space."""
    if rows.size == 0:
        return np.zeros((0, rows.shape[-1]))
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[s > least * max(float(s[0]), 1e-300)]


def _explained(around: Situation, space: _Open) -> list[OpenMotion]:
    """Motions that lie in the undetermined space, each with the part that no earlier motion
    explains.
    """
    parts: list[OpenMotion] = []
    options = around.options
    done = np.zeros((0, space.rows.shape[1]))
    all_motions, whole = list(candidates(around)), space
    last = len(all_motions) - 1
    cosines: dict[int, tuple[Array, Array]] = {}  # in the present space, by the motion's number
    for k, inside in [*((k, share) for share in options.inside for k in range(last)), (last, 0.0)]:
        if len(done) == len(whole.rows):
            break
        motion = all_motions[k]
        if k not in cosines:
            cosines[k] = _cosines(motion.columns, space)
        names = _within(cosines[k], space, inside)
        # the part that no earlier motion explains
        new = _directions(names - (names @ done.T) @ done, options)
        if len(new) == 0:
            continue
        if k == last:
            names = new
        done = _orthonormal(np.concatenate([done, new]))
        numbers = _coefficients(motion, space, names, options)
        own = numbers @ motion.columns.T / space.unit
        parts.append(OpenMotion(motion, motion.legs, names, numbers, own, len(new)))
        if motion.convention:
            space = _without(space, new)
            cosines.clear()
    return parts


def _without(space: _Open, directions: Array) -> _Open:
    """Undetermined space without the changes (k, P), which are treated as frame changes from now
    on.
    """
    complement = np.linalg.svd(space.rows @ directions.T)[0][:, len(directions) :].T
    frames = np.concatenate([space.frames, directions.T], axis=1)
    return _Open(
        complement @ space.rows,
        complement @ space.covariance @ complement.T,
        frames,
        space.unit,
    )


def _directions(rows: Array, options: UnidentifiedOptions) -> Array:
    """Orthonormal directions (k, P) of rows, those of negligible size removed."""
    if rows.size == 0:
        return rows[:0]
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[s > options.new_sine]


def _cosines(changes: Array, space: _Open) -> tuple[Array, Array]:
    """Principal angles between the undetermined space and a space of changes (P, m).

    Returns the principal directions (n, n), as columns in the basis of the undetermined space, and
    the cosines (n,) of their angles.
    """
    columns = (changes / space.unit[:, None]).T
    size = np.linalg.norm(columns, axis=1)
    columns = columns[size > 0] / size[size > 0, None]
    # pure frame changes are removed, with their rounding
    rest = columns - (columns @ space.frames) @ space.frames.T
    basis = _orthonormal(rest[np.linalg.norm(rest, axis=1) > PURE_FRAME_SINE], PURE_FRAME_SINE)
    u, s, _ = np.linalg.svd(space.rows @ basis.T)
    cosine = np.zeros(len(u))
    cosine[: len(s)] = s
    return u, cosine


def _within(cosines: tuple[Array, Array], space: _Open, inside: float) -> Array:
    """Orthonormal directions (k, P) of the undetermined space that lie in a space of changes.

    cosines : of the changes, by :func:`_cosines`. inside : least squared cosine.
    """
    directions, cosine = cosines
    return directions[:, cosine**2 > inside].T @ space.rows


def _coefficients(
    motion: NamedChanges, space: _Open, values: Array, options: UnidentifiedOptions
) -> Array:
    """Coefficients (k, m) of a motion for directions ``values`` (k, P), frames excluded.

    The coefficients are not unique, since frame changes may be added. For a single change those
    with the smallest L1 norm are taken, by iteratively reweighted least squares, so that a sentence
    has few numbers.
    """
    columns = motion.columns / space.unit[:, None]
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    m, both = len(scale), np.concatenate([columns / scale, space.frames], axis=1)
    weight = np.ones(both.shape[1])
    few = len(values) == 1 and m > 1 and not (motion.how or motion.convention)
    solved = np.linalg.lstsq(both, values.T, rcond=1e-6)[0]
    for _ in range(options.sparse_steps if few else 0):
        weight[:m] = np.sqrt(np.abs(solved[:m, 0]) / max(np.abs(solved[:m, 0]).max(), 1e-300))
        weight[m:] = options.frame_weight
        solved = np.linalg.lstsq(both * weight, values.T, rcond=1e-6)[0] * weight[:, None]
    return (solved[:m] / scale[:, None]).T


def _merged(around: Situation, parts: list[OpenMotion]) -> list[OpenMotion]:
    """Merge parts with the same sentence: of several legs, or of the same legs."""
    out: dict[tuple[object, ...], OpenMotion] = {}
    for part in parts:
        single = len(part.legs) == 1
        key = (part.motion.one, *((part.how(around), len(part.space)) if single else part.legs))
        out[key] = out[key].and_of(part) if key in out else part
    return [_with_last_leg(part, parts) for part in out.values()]


def _with_last_leg(part: OpenMotion, parts: list[OpenMotion]) -> OpenMotion:
    """Add the last leg to a part on sizes of all legs but one.

    If the common part of all legs is described too, the sizes of the last leg are undetermined as
    well.
    """
    same = [p.legs for p in parts if p.motion.labels == part.motion.labels and len(p.legs) > 1]
    single = bool(part.motion.labels) and len(part.motion.legs) == 1
    if single and same and len(part.legs) == len(same[0]) - 1:
        return replace(part, legs=same[0])
    return part


def _moves(around: Situation, part: OpenMotion, space: _Open, effect: Array) -> tuple[float, bool]:
    """Displacement of the platform by a motion, m, and whether the data contain information on
    it.
    """
    value = _directions(part.space, around.options)
    mixed = value @ space.rows.T
    shifted = effect @ (space.unit[:, None] * value.T)
    covariance = mixed @ space.covariance @ mixed.T
    # the posterior's information is the prior's, which is 1 in these units, plus the data's
    data = mixed @ (np.linalg.inv(space.covariance) - np.eye(len(space.rows))) @ mixed.T
    worst = float(np.sqrt(max(np.linalg.eigvalsh(data)[-1], 0.0)))
    return float(np.sqrt(np.sum((shifted @ covariance) * shifted))), worst >= around.options.weak
