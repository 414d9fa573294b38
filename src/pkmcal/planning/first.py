"""What the first photographs tell of the edges in all that follow.

A station's first photographs are measured as `calibrate` measures them. How much each edge tells
there, in pixels, and lost edges nothing, is what such edges will tell elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, numbered
from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.errors import ResultError
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.start import start_state
from pkmcal.measurements import OWN_SHADING, EdgeSet, Measurements, concatenate
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.image_batches import Photographs, placed_at
from pkmcal.observe.predict import tubes_of
from pkmcal.session.load import Session
from pkmcal.simulation.edges import EdgeNoise, simulate_edges

FIRST_PHOTOGRAPHS_A_STATION = 3
"""Photographs of a station that are looked at closely: what people take before the long capture."""
FIRST_PHOTOGRAPHS_MEASURED = 6
"""Photographs of all stations together whose edges are measured: a hexapod shows forty edges of
each kind in them, enough for their scatter to be known to a tenth."""
FEWEST_FIRST_EDGES = 24
"""Edges without which nothing is told: one photograph of a hexapod shows as many."""
SHARED_EDGES_WEIGHT = 2.0
"""Edges that all of a kind at a station count for beside the leg's own, so that chance among three
photographs does not make a leg."""
EXPECTED_EDGE_FREE_SHARE = 0.5
"""Part of an edge that has to be free for it to be expected: its place is fitted to as much."""
EXACT_EDGE_NOISE = EdgeNoise(1e-3, 1e-3)
"""px; errors of edges that are simulated for where they lie, and how they turn by a pixel."""
SAME_LENGTH = 0.01
"""Part of its length by which an edge may differ, and be as long: where all are."""
FIRST_EDGES_SEED = 7


class EdgePool(NamedTuple):
    """What one edge may tell: informations (n, 2, 2), px^-2 of shift and tilt, weights (n,), and
    lengths (n,) in px of the edges that told it. shading : px, its own.
    """

    information: Array
    weight: Array
    length: Array
    shading: float = OWN_SHADING

    def chances(self, length: Array) -> Array:
        """(m, n) chance of each, for edges of m lengths in px.

        Long edges are found more often and tell more: those of about the same length count most,
        by a Gaussian of the width that serves the density of the lengths best (Scott's rule).
        """
        at = np.log(self.length)
        mean = np.average(at, weights=self.weight)
        spread = np.sqrt(np.average((at - mean) ** 2, weights=self.weight))
        effective = self.weight.sum() ** 2 / np.sum(self.weight**2)
        width = max(spread * effective**-0.2, SAME_LENGTH)
        far = ((np.log(length)[:, None] - at) / width) ** 2 / 2
        # beyond the longest and the shortest it is these that are asked
        chance = self.weight * np.exp(far.min(axis=1, keepdims=True) - far)
        return chance / chance.sum(axis=1, keepdims=True)


Pools = tuple[EdgePool, ...]
"""Of a station's edges, in the order of :func:`~pkmcal.observe.predict.tubes_of`."""


@dataclass(frozen=True)
class EdgesOf:
    """Edges (k, E) of a station's first photographs, in the order of ``tubes_of``.

    photographs : (k,) their numbers. expected : of which nothing hides the most. valid : that were
    measured and agree with all others.
    """

    photographs: Integers
    expected: Booleans
    valid: Booleans


@dataclass(frozen=True)
class FirstEdges:
    """What the first photographs gave.

    estimate : from them alone. pools, edges : by station. sigma : (S, L) px across, median.
    """

    estimate: Estimate
    pools: tuple[Pools, ...]
    sigma: Array
    edges: tuple[EdgesOf, ...]


def spread_over(
    configuration: Integers, n_stations: int = 1, most: int = FIRST_PHOTOGRAPHS_A_STATION
) -> Integers:
    """Numbers of the few of a station's photographs that are measured, of different configurations
    and spread over all. configuration : (n,) of its photographs. most : of each station, and of all
    together as many times more as FIRST_PHOTOGRAPHS_MEASURED is of FIRST_PHOTOGRAPHS_A_STATION.
    """
    most = min(
        most, -(-most * FIRST_PHOTOGRAPHS_MEASURED // (FIRST_PHOTOGRAPHS_A_STATION * n_stations))
    )
    first = np.sort(np.unique(configuration, return_index=True)[1])
    return first[np.unique(np.linspace(0, len(first) - 1, min(most, len(first))).astype(int))]


def first_edges(
    session: Session,
    photographs: Sequence[Photographs],
    rows: Sequence[Integers],
    T_camera_base: Array,
    poses: Array,
) -> FirstEdges:
    """The first photographs' edges, by a look for the legs and one at the edges.

    photographs : of S stations. rows : numbers of those to be measured, by station. T_camera_base :
    (S, 4, 4) where the stations were found. poses : T_base_platform (K, 4, 4) by the drawing.
    Raises PkmcalError where they do not carry an estimate.
    """
    machine = session.machine
    numbers = numbered(session.camera_of_station[[p.station for p in photographs]])
    few = [
        replace(p.select(own), station=number)
        for number, (p, own) in enumerate(zip(photographs, rows, strict=True))
    ]

    def measurements(edges: EdgeSet) -> Measurements:
        if len(edges) < FEWEST_FIRST_EDGES:
            raise ResultError("too few edges to tell what others will give", found=len(edges))
        return Measurements(
            edges, session.joints, session.joint_noise, len(few), numbers, shaded=True
        )

    passes = legs.search_stations(placed_at(few, T_camera_base, poses), machine)
    coarse = replace(measurements(concatenate([one.edges for one in passes])), shaded=False)
    # a pixel is what the search is good to, so there is no noise to be estimated
    start = start_state(machine, coarse, T_camera_base)
    estimate = bundle(machine, coarse, start, scale_noise=False)
    state = estimate.state
    placed = placed_at(few, state.T_camera_base, state.T_base_platform)
    passes = legs.measure_stations(placed, estimate.machine, {})
    fine = measurements(concatenate([one.edges for one in passes]))
    held = refinement_of(session, refine=False)
    fine = replace(fine, intrinsics_factor=held.factor, intrinsics_at=held.at)
    start = replace(state, columns={EDGE_SHIFT: state.columns[EDGE_SHIFT]})
    estimate = bundle(machine, fine, start)
    return _edge_information(few, rows, estimate, fine.edges)


def _edge_information(
    few: Sequence[Photographs], rows: Sequence[Integers], estimate: Estimate, edges: EdgeSet
) -> FirstEdges:
    """What an edge that ought to be seen tells on average, lost ones with nothing."""
    machine, state = estimate.machine, estimate.state
    tubes = tubes_of(machine)
    n_edges, n_legs = len(tubes), machine.n_legs
    number = np.full((n_legs, int(tubes.tube.max()) + 1, 2), -1)
    number[tubes.leg, tubes.tube, tubes.side] = np.arange(n_edges)
    pairs = np.array([(p.station, k) for p in few for k in p.configuration])
    ideal, _ = simulate_edges(
        machine,
        state.T_camera_base,
        tuple(p.camera.binned(p.binning) for p in few),
        state.T_base_platform,
        EXACT_EDGE_NOISE,
        np.random.default_rng(FIRST_EDGES_SEED),
        photographs=pairs,
    )

    shape = (len(few), len(state.T_base_platform), n_edges)

    def place(some: EdgeSet) -> tuple[Integers, Integers, Integers]:
        return some.station, some.configuration, number[some.leg, some.tube, some.side]

    expected, retained_rows, whole = (np.zeros(shape, dtype=bool) for _ in range(3))
    expected[place(ideal)] = True
    # of a tube that is hidden for the most part nobody asks why its edges are lost
    length = np.ptp(ideal.span, axis=1)
    longest = np.zeros(n_edges)
    np.maximum.at(longest, place(ideal)[2], length)
    whole[place(ideal)] = length > EXPECTED_EDGE_FREE_SHARE * longest[place(ideal)[2]]
    retained_rows[place(edges.select(estimate.edge_weights > 0.5))] = True
    retained_rows &= expected
    unit = np.zeros((*shape, 2, 2))
    unit[place(ideal)] = pixel_turns(ideal)
    scale = estimate.edge_noise.scale[edges.tube]
    weight = estimate.edge_weights * estimate.edge_trust / scale**2
    own = unit[place(edges)]
    information = np.zeros((*shape, 2, 2))  # lost edges stay zero
    information[place(edges)] = (
        own.mT @ (np.linalg.inv(edges.covariance) * weight[:, None, None]) @ own
    )
    kind = np.stack([tubes.tube, tubes.side], axis=1)
    long = np.ones(shape)
    long[place(ideal)] = pixel_lengths(ideal)
    own_shading = estimate.edge_noise.shading[tubes.tube]
    pools = tuple(
        _pools(information[s], long[s], expected[s], kind, own_shading) for s in range(len(few))
    )
    sigma = np.full((len(few), n_legs), np.nan)
    pixel = np.linalg.norm(edges.shift, axis=-1)
    across = np.hypot(
        scale * np.sqrt(edges.covariance[:, 0, 0]) / pixel, estimate.edge_noise.shading[edges.tube]
    )
    for s, j in np.ndindex(len(few), n_legs):
        mine = (edges.station == s) & (edges.leg == j) & (estimate.edge_weights > 0.5)
        sigma[s, j] = np.median(across[mine]) if mine.any() else np.nan
    by_station = tuple(
        EdgesOf(own, whole[s, p.configuration], (retained_rows & whole)[s, p.configuration])
        for s, (own, p) in enumerate(zip(rows, few, strict=True))
    )
    return FirstEdges(estimate, pools, sigma, by_station)


def _pools(
    values: Array, length: Array, expected: Booleans, kind: Integers, shading: Array
) -> Pools:
    """What edges of a station may tell, by edge (E,): its tube's own, and that of all of its kind.

    values : (K, E, 2, 2), zero where lost; length : (K, E), px; expected : (K, E). kind : (E, 2)
    tube and side. shading : (E,) px. Edges differ: a mean would promise more than edges of which
    some tell much and others nothing.
    """
    out: list[EdgePool] = []
    for e in range(values.shape[1]):
        same = np.all(kind == kind[e], axis=1)
        mine, like = expected[:, e], expected[:, same]
        weight = np.concatenate(
            [np.ones(mine.sum()), np.full(like.sum(), SHARED_EDGES_WEIGHT / max(like.sum(), 1))]
        )
        out.append(
            EdgePool(
                np.concatenate([values[mine, e], values[:, same][like]]),
                weight,
                np.concatenate([length[mine, e], length[:, same][like]]),
                float(shading[e]),
            )
        )
    return tuple(out)


def drawn_edges(
    machine: Machine, edges: EdgeSet, pools: Sequence[Pools], rng: np.random.Generator | None
) -> EdgeSet:
    """Edges with :data:`EXACT_EDGE_NOISE` errors that tell as much as such edges did, drawn at
    random; those that tell nothing go. Without ``rng`` each tells what such an edge does on
    average.
    """
    tubes = tubes_of(machine)
    own, length = np.zeros((len(edges), 2, 2)), pixel_lengths(edges)
    shading = edges.shading.copy()
    for e in range(len(tubes)):
        same = (edges.leg == tubes.leg[e]) & (edges.tube == tubes.tube[e])
        same &= edges.side == tubes.side[e]
        for s, station in enumerate(pools):
            mine, pool = np.flatnonzero(same & (edges.station == s)), station[e]
            if not len(pool.information) or not mine.size:
                continue
            shading[mine] = pool.shading
            chance = pool.chances(length[mine])
            if rng is None:
                own[mine] = np.tensordot(chance, pool.information, axes=1)
            else:
                drawn = rng.random((len(mine), 1)) > np.cumsum(chance, axis=1)
                own[mine] = pool.information[
                    np.minimum(drawn.sum(axis=1), len(pool.information) - 1)
                ]
    informative = np.linalg.eigvalsh(own)[:, 0] > 0
    edges, own = replace(edges, shading=shading).select(informative), own[informative]
    unit = pixel_turns(edges)
    return replace(edges, covariance=unit @ np.linalg.inv(own) @ unit.mT)


def pixel_turns(edges: EdgeSet) -> Array:
    """Turns (N, 2, 2) of simulated edges' normals by a pixel of shift and of tilt, in columns.

    The Cholesky factor of their covariance: their bases have the shift first.
    """
    return np.linalg.cholesky(edges.covariance) / EXACT_EDGE_NOISE.shift


def pixel_lengths(edges: EdgeSet) -> Array:
    """Lengths (N,) in px of simulated edges, by how little they turn when an end moves by one."""
    return 2 / np.linalg.norm(pixel_turns(edges)[:, :, 1], axis=1)
