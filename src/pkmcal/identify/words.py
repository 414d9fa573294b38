"""What the data leave open, said so that people know what to do.

The null space of the data's information has no axes of its own: any rotation of it is as good.
So changes that people can picture (:mod:`pkmcal.identify.words_families`) are held against the
whole space, one after the other: what lies in it is taken out and said, the rest stays for the
next. All comparisons are made in units of the drawing's tolerances, with the frames' freedoms
taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.identify.problem import Estimate
from pkmcal.identify.words_advice import advice_on
from pkmcal.identify.words_driven import conventions_held
from pkmcal.identify.words_effect import platform_by_parameters
from pkmcal.identify.words_families import Circumstances, Family, all_radii, circumstances, families
from pkmcal.identify.words_parts import Part, merged
from pkmcal.identify.words_text import said_of
from pkmcal.mechanisms import Machine

if TYPE_CHECKING:
    from pkmcal.identify.covariance import Direction, Identifiability
    from pkmcal.measurements import EdgeSet, Measurements
    from pkmcal.papers.conditions import Condition

INSIDE = (0.999, 0.95)
"""Shares of a change (squared) that lie in the open space for it to explain part of that space:
first what fits exactly, since much looks alike once frames are taken out, then what fits in all
but name. The space is that of the estimate, whose poses' noise bends what would be exact."""
HARDLY = 1 / 3
"""Information below which a direction counts as not told: the data then decide less than a tenth
of its variance. Poses that only shift seem to turn by their noise, so directions that nothing fixes
come out with a trace of information."""
NEW = 0.1
"""Sine of the angle to what is said already below which a change says nothing new."""
MOVES = 0.01
"""Share of a joint centre's tolerance below which a platform counts as not moved: a hundredth
of what the drawing leaves open disappears beside any calibration's own deviations."""
MOST = 8
"""Sentences that people read."""


@dataclass(frozen=True)
class Sentence:
    """One thing that the data do not tell.

    text, advice : what, and what to do. parameters : the names that it is about, most first.
    dimensions : independent changes that it stands for. moves_platform : how far (m, root mean
    square over its joints and poses) the platform moves when these changes are as large as the
    drawing's tolerance lets expect. matters : whether that is more than nothing. weak : the data
    know it, yet less than the drawing does.
    """

    text: str
    advice: str
    parameters: tuple[str, ...]
    dimensions: int
    moves_platform: float
    matters: bool
    weak: bool = False


@dataclass(frozen=True)
class Findings:
    """What the data tell and do not tell: the test, its words, and the paper's conditions.

    told : rank and spectrum. unidentified : what such data do not tell, of ``told.unidentified``
    and of what they know ``HARDLY``. weak : what the drawing knows better. by_drawing : how far
    (m, as ``Sentence.moves_platform``) the platform moves when all parameters are as wrong as the
    drawing's tolerances let expect. conventional : held parameters for which any value would
    do; also_conventional : combinations of the other held ones.
    """

    told: Identifiability
    unidentified: tuple[Sentence, ...]
    weak: tuple[Sentence, ...]
    by_drawing: float
    conditions: tuple[Condition, ...] = ()
    conventional: tuple[str, ...] = ()
    also_conventional: int = 0


class _Open(NamedTuple):
    """What is left open, in units of the drawing's deviations: rows (n, P) orthonormal, their
    covariance (n, n) as the estimate leaves it, frames (P, g) orthonormal, unit (P,).
    """

    rows: Array
    covariance: Array
    frames: Array
    unit: Array


def explain(
    told: Identifiability,
    estimate: Estimate,
    seen: Booleans,
    conditions: tuple[Condition, ...] = (),
) -> Findings:
    """The findings of an estimate; seen : (S, L) legs that each station sees.

    Stations that a board on the base joins are one here, see :func:`joined_by_boards`.
    """
    machine, table = estimate.machine, estimate.machine.parameters
    poses = estimate.state.T_base_platform[estimate.configurations]
    effect = platform_by_parameters(machine, poses)
    photographed, heights = estimate.edge_weights.size > 0, only_heights(estimate)
    drawing = effect @ (table.free_matrix() * table.tolerances_free())
    lost = (*told.unidentified, *(d for d in told.weak if d.information < HARDLY))
    weak = tuple(d for d in told.weak if d.information >= HARDLY)

    def said(directions: tuple[Direction, ...]) -> tuple[Sentence, ...]:
        null = vectors(directions, machine)
        known = _information(directions, told)
        return describe(
            machine, seen, null, poses, known, photographed=photographed, heights=heights
        )

    # Poses and heights blend what they hardly see with what they do not: together it has names.
    sentences = (*said(lost), *said(weak)) if photographed else said((*lost, *weak))
    free = tuple(s for s in sentences if not s.weak)
    rest = tuple(s for s in sentences if s.weak)
    by_drawing = float(np.linalg.norm(drawing))
    held = conventions_held(machine, effect)
    return Findings(told, free, rest, by_drawing, conditions, *held)


def only_heights(estimate: Estimate) -> bool:
    """Whether nothing but heights was measured: what is not measured leaves no residual."""
    poses = estimate.pose_residuals
    return not estimate.edge_weights.size and len(poses) > 0 and not poses[:, :5].any()


def _information(directions: tuple[Direction, ...], told: Identifiability) -> Array:
    """What the data know of each direction, 0 where it is rounding only."""
    gone = {id(d) for d in told.unidentified}
    return np.array([0.0 if id(d) in gone else d.information for d in directions])


def vectors(directions: tuple[Direction, ...], machine: Machine) -> Array:
    """Directions as rows (n, P), in the parameters' units."""
    return np.array([d.vector for d in directions]).reshape(-1, len(machine.parameters))


def seen_legs(edges: EdgeSet, weights: Array, n_stations: int, n_legs: int) -> Booleans:
    """Legs that each station sees, (S, L); edges given up, of weight (N,) below a half, aside."""
    kept = np.asarray(weights) >= 0.5
    out = np.zeros((n_stations, n_legs), dtype=bool)
    out[edges.station[kept], edges.leg[kept]] = True
    return out


def joined_by_boards(seen: Booleans, measurements: Measurements) -> Booleans:
    """The same (S, L), where stations that see one board on the base count as one station."""
    out, poses = seen.copy(), measurements.poses
    for k, mount in enumerate(measurements.mounts):
        stations = np.unique(poses.station[poses.mount == k])
        if mount.body == "base" and stations.size:
            out[stations] = out[stations].any(axis=0)
    return out


def describe(
    machine: Machine,
    seen: Booleans,
    null: Array,
    T_base_platform: Array,
    information: Array | None = None,
    *,
    photographed: bool = True,
    heights: bool = False,
) -> tuple[Sentence, ...]:
    """Sentences for a space of changes that the data do not see.

    machine : at the estimate. seen : (S, L) legs that each station sees. null : (n, P) changes of
    all parameters in their units, any basis. T_base_platform : (K, 4, 4) the session's poses.
    information : (n,) singular values of what the data know of each after all, in units of the
    tolerance, 0 where absent: from ``HARDLY`` on it is said that the drawing knows it better, not
    that it is free. photographed : whether legs were, and not boards or poses only. heights :
    whether it was heights only.
    """
    space = _open(machine, null, information)
    if len(space.rows) == 0:
        return ()
    around = circumstances(machine, seen, T_base_platform, photographed, heights)
    if not photographed:  # nobody asks a board how thick legs are
        radii = _within(all_radii(around), space, INSIDE[0])
        space = _without(space, radii)
    effect = platform_by_parameters(machine, T_base_platform) * space.unit
    parts = merged(_explained(around, space))
    sentences = [_sentence(around, space, part, effect) for part in parts]
    return _few(sentences)


def _open(machine: Machine, null: Array, information: Array | None) -> _Open:
    """The open space without frames, in units of the drawing's deviations."""
    unit = _unit(machine)
    moved = generators(machine.layout, machine.values) @ freedoms(machine)
    frames = _orthonormal((moved / unit[:, None]).T).T
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


def _unit(machine: Machine) -> Array:
    """The drawing's deviations (P,), larger for tied ones, which share one deviation."""
    squares = machine.parameters.free_matrix() ** 2
    shared = np.where(squares.sum(axis=1) > 0, squares @ squares.sum(axis=0), 1.0)
    return machine.parameters.tolerance * np.sqrt(np.maximum(shared, 1.0))


def _orthonormal(rows: Array, least: float = 1e-6) -> Array:
    """An orthonormal basis (k, P) of the rows' space."""
    if rows.size == 0:
        return np.zeros((0, rows.shape[-1]))
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[s > least * max(float(s[0]), 1e-300)]


def _explained(around: Circumstances, space: _Open) -> list[Part]:
    """Families that lie in the open space, each with what it says anew."""
    parts: list[Part] = []
    done = np.zeros((0, space.rows.shape[1]))
    known, whole = list(families(around)), space
    for family, inside in [*((f, share) for share in INSIDE for f in known[:-1]), (known[-1], 0.0)]:
        if len(done) == len(whole.rows):
            break
        found = _within(family, space, inside)
        new = _directions(found - (found @ done.T) @ done)
        if len(new) == 0:
            continue
        if family.kind == "rest":
            found = new
        done = _orthonormal(np.concatenate([done, new]))
        numbers = _coefficients(family, space, found)
        own = numbers @ family.columns.T / space.unit
        parts.append(Part((family,), found, numbers, own, len(new)))
        if family.kind in EQUIVALENT:
            space = _without(space, new)
    return parts


def _without(space: _Open, said: Array) -> _Open:
    """The open space where changes (k, P) in it count for nothing, as frames do."""
    kept = np.linalg.svd(space.rows @ said.T)[0][:, len(said) :].T
    frames = np.concatenate([space.frames, said.T], axis=1)
    return _Open(kept @ space.rows, kept @ space.covariance @ kept.T, frames, space.unit)


def _directions(rows: Array) -> Array:
    """Orthonormal directions (k, P) that the rows still have, those that rounding left aside."""
    if rows.size == 0:
        return rows[:0]
    _, s, vt = np.linalg.svd(rows, full_matrices=False)
    return vt[s > NEW]


def _within(family: Family, space: _Open, inside: float) -> Array:
    """Directions (k, P) of the open space that the family can make, orthonormal."""
    columns = (family.columns / space.unit[:, None]).T
    size = np.linalg.norm(columns, axis=1)
    columns = columns[size > 0] / size[size > 0, None]
    # what only moves the frames changes nothing, whatever rounding leaves of it
    basis = _orthonormal(columns - (columns @ space.frames) @ space.frames.T, 1e-4)
    u, s, _ = np.linalg.svd(space.rows @ basis.T)
    s = np.pad(s, (0, len(space.rows) - len(s)))[: len(space.rows)]
    return u[:, s**2 > inside].T @ space.rows


def _coefficients(family: Family, space: _Open, found: Array) -> Array:
    """The family's own numbers (k, m) for each direction, frames aside."""
    columns = family.columns / space.unit[:, None]
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    both = np.concatenate([columns / scale, space.frames], axis=1)
    solved = np.linalg.lstsq(both, found.T, rcond=1e-6)[0]
    return (solved[: columns.shape[1]] / scale[:, None]).T


EQUIVALENT = ("against", "turn")
"""Kinds that are taken out of what is said afterwards: changes of the description, not of a leg."""


def _sentence(around: Circumstances, space: _Open, part: Part, effect: Array) -> Sentence:
    found = _directions(part.space)
    mixed = found @ space.rows.T
    weak = _known(space, mixed) >= HARDLY
    moved = effect @ found.T
    moved = float(np.sqrt(np.trace(moved @ (mixed @ space.covariance @ mixed.T) @ moved.T)))
    table = around.machine.parameters
    matters = moved > MOVES * float(table.tolerance[around.at.base].mean())
    size = np.linalg.norm(part.own, axis=0)
    order = np.argsort(-np.round(size, 6), kind="stable")
    names = tuple(table.names[k] for k in order[: int(np.sum(size > 0.15 * size.max()))])
    text = said_of(around, part.families, part.coefficients, names, weak)
    how_far = "This does not move the platform."
    if matters:
        how_far = (
            f"Within the drawing's tolerances this moves the platform by {moved * 1e3:.2g} mm."
        )
    return Sentence(
        f"{text}. {how_far}",
        advice_on(around, part.families, names, matters, weak),
        names,
        part.new,
        moved,
        matters,
        weak,
    )


def _known(space: _Open, mixed: Array) -> float:
    """What the data know at most of changes, rows (k, n) of coordinates in the open space."""
    # the estimate's information is the drawing's, one, and the data's
    data = mixed @ (np.linalg.inv(space.covariance) - np.eye(len(space.rows))) @ mixed.T
    return float(np.sqrt(max(np.linalg.eigvalsh(data)[-1], 0.0)))


def _few(sentences: list[Sentence]) -> tuple[Sentence, ...]:
    """At most ``MOST`` sentences, the rest counted in the last."""
    if len(sentences) <= MOST:
        return tuple(sentences)
    ranked = sorted(sentences, key=lambda s: -s.moves_platform)
    kept = [s for s in sentences if s in ranked[: MOST - 1]]
    rest = ranked[MOST - 1 :]
    moved = float(np.sqrt(sum(s.moves_platform**2 for s in rest)))
    last = replace(
        rest[0],
        text=f"And {len(rest)} more of this kind. {rest[0].text}",
        parameters=tuple(dict.fromkeys(name for s in rest for name in s.parameters)),
        dimensions=sum(s.dimensions for s in rest),
        moves_platform=moved,
    )
    return (*kept, last)
