"""Information of edges, estimated from a session's first images, for the prediction of further
images.

A station's first images are measured as `calibrate` measures them. The distribution of the
information of their edges, in pixels and with lost edges as zero, predicts that of edges in further
images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly, numbered
from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.errors import ResultError
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.start import start_state
from pkmcal.levels import FEWEST_EDGES, MAJORITY, NEGLIGIBLE
from pkmcal.measurements import OWN_SHADING, EdgeSet, Measurements, concatenate
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages, placed_at
from pkmcal.observe.predict import tubes_of
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT

FIRST_IMAGES_A_STATION = 3
"""Number of first images of a station that are measured, as users take them before the main
capture.
"""
FIRST_IMAGES_MEASURED = 6
"""Number of measured images of all stations together: those of a hexapod contain forty edges of
each kind, which determine their scatter to a tenth.
"""
SHARED_EDGES_WEIGHT = 2.0
"""Weight, as a number of edges, of the edges of the same kind of all legs at a station, beside
those of the leg itself: it limits the influence of chance in three images.
"""
EXACT_EDGE_NOISE = EdgeNoise(1e-3, 1e-3)
"""Negligible noise (px) of edges that are simulated for their position and their turn by a
pixel.
"""
FIRST_EDGES_SEED = 7


class EdgePool(NamedTuple):
    """Samples of the information of an edge.

    information : (n, 2, 2), px^-2 of shift and tilt.
    weight : (n,) of the samples.
    length : (n,) of the sampled edges, px.
    shading : px, standard deviation of each edge's own shading.
    """

    information: Array
    weight: Array
    length: Array
    shading: float = OWN_SHADING

    def chances(self, length: Array) -> Array:
        """Probabilities (m, n) of each sample, for edges of m lengths in px.

        Long edges are detected more often and have more information, so samples are weighted by a
        Gaussian kernel over the logarithm of the length (bandwidth by Scott's rule).
        """
        at = np.log(self.length)
        mean = np.average(at, weights=self.weight)
        spread = np.sqrt(np.average((at - mean) ** 2, weights=self.weight))
        effective = self.weight.sum() ** 2 / np.sum(self.weight**2)
        width = max(spread * effective**-0.2, NEGLIGIBLE)  # for edges of equal length
        far = ((np.log(length)[:, None] - at) / width) ** 2 / 2
        # subtracting far.min() assigns lengths outside the sampled range to the nearest samples
        chance = self.weight * np.exp(far.min(axis=1, keepdims=True) - far)
        return chance / chance.sum(axis=1, keepdims=True)


Pools = tuple[EdgePool, ...]
"""Pools of a station's edges, in the order of :func:`~pkmcal.observe.predict.tubes_of`."""


@dataclass(frozen=True)
class EdgesOf:
    """Edges (k, E) of a station's first images, in the order of ``tubes_of``.

    images : (k,) numbers of the images.
    expected : edges whose larger part is visible.
    valid : expected edges that were measured and are inliers.
    """

    images: Integers
    expected: Booleans
    valid: Booleans


@dataclass(frozen=True)
class FirstEdges:
    """Estimate from the first images, and the information of their edges.

    estimate : from these images only.
    pools, edges : by station.
    sigma : (S, L) median standard deviation of a leg's edges, px across.
    """

    estimate: Estimate
    pools: tuple[Pools, ...]
    sigma: Array
    edges: tuple[EdgesOf, ...]


def spread_over(
    configuration: Integers, n_stations: int = 1, most: int = FIRST_IMAGES_A_STATION
) -> Integers:
    """Indices of the images of a station to be measured, of configurations spread over all.

    configuration : (n,) of the images.
    most : maximum for each station. The maximum for all stations together is larger by the ratio of
        FIRST_IMAGES_MEASURED to FIRST_IMAGES_A_STATION.
    """
    most = min(most, -(-most * FIRST_IMAGES_MEASURED // (FIRST_IMAGES_A_STATION * n_stations)))
    first = np.sort(np.unique(configuration, return_index=True)[1])
    return first[evenly(len(first), most)]


def first_edges(
    session: Session,
    station_images: Sequence[StationImages],
    rows: Sequence[Integers],
    T_camera_base: Array,
    poses: Array,
    passes: int = 1,
) -> FirstEdges:
    """Measure the edges of the first images, by a search and measurement passes.

    station_images : of S stations.
    rows : indices of the images to be measured, by station.
    T_camera_base : (S, 4, 4) localized poses.
    poses : T_base_platform (K, 4, 4) by the nominal model.
    passes : measurement passes, each from the estimate by the one before: edges that were predicted
        too far off are lost.

    Raises PkmcalError if there are too few edges for an estimate.
    """
    machine = session.machine
    numbers = numbered(session.camera_of_station[[p.station for p in station_images]])
    images = [
        replace(p.select(own), station=number)
        for number, (p, own) in enumerate(zip(station_images, rows, strict=True))
    ]

    def measurements(edges: EdgeSet) -> Measurements:
        if len(edges) < FEWEST_EDGES:
            raise ResultError("too few edges to predict the accuracy of others", found=len(edges))
        return Measurements(
            edges, session.joints, session.joint_noise, len(images), numbers, shaded=True
        )

    # Coarse edges by a search from the nominal model, and an estimate by them.
    found = legs.search_stations(placed_at(images, T_camera_base, poses), machine)
    coarse = replace(measurements(concatenate([one.edges for one in found])), shaded=False)
    # The accuracy of the search is a pixel, so its noise is not estimated.
    start = start_state(machine, coarse, T_camera_base)
    estimate = bundle(machine, coarse, start, scale_noise=False)
    # Measurement passes from there, and the final estimate.
    held, fine = refinement_of(session, refine=False), coarse
    for _ in range(passes):
        state = estimate.state
        placed = placed_at(images, state.T_camera_base, state.T_base_platform)
        found = legs.measure_stations(placed, estimate.machine, {})
        fine = measurements(concatenate([one.edges for one in found]))
        fine = replace(fine, intrinsics_factor=held.factor, intrinsics_at=held.at)
        start = replace(state, columns={EDGE_SHIFT: state.columns[EDGE_SHIFT]})
        estimate = bundle(machine, fine, start)
    return _edge_information(images, rows, estimate, fine.edges)


def _edge_information(
    images: Sequence[StationImages], rows: Sequence[Integers], estimate: Estimate, edges: EdgeSet
) -> FirstEdges:
    """Information of each expected edge; lost edges have none."""
    machine, state = estimate.machine, estimate.state
    tubes = tubes_of(machine)
    n_edges, n_legs = len(tubes), machine.n_legs
    # Exact edges of the estimate, in the order of ``tubes_of``.
    number = np.full((n_legs, int(tubes.tube.max()) + 1, 2), -1)
    number[tubes.leg, tubes.tube, tubes.side] = np.arange(n_edges)
    pairs = np.array([(p.station, k) for p in images for k in p.configuration])
    ideal, _ = simulate_edges(
        machine,
        state.T_camera_base,
        tuple(p.camera.binned(p.binning) for p in images),
        state.T_base_platform,
        EXACT_EDGE_NOISE,
        np.random.default_rng(FIRST_EDGES_SEED),
        images=pairs,
    )

    shape = (len(images), len(state.T_base_platform), n_edges)

    def place(some: EdgeSet) -> tuple[Integers, Integers, Integers]:
        return some.station, some.configuration, number[some.leg, some.tube, some.side]

    # Expected edges by station, configuration and edge, and the inliers among them.
    expected, inlier, whole = (np.zeros(shape, dtype=bool) for _ in range(3))
    expected[place(ideal)] = True
    # Edges that are hidden for the most part are not expected, so their loss does not count.
    length = np.ptp(ideal.span, axis=1)
    longest = np.zeros(n_edges)
    np.maximum.at(longest, place(ideal)[2], length)
    whole[place(ideal)] = length > MAJORITY * longest[place(ideal)[2]]
    inlier[place(edges.select(estimate.edge_weights > INLIER_WEIGHT))] = True
    inlier &= expected
    # Information of each edge in px^-2 of shift and tilt.
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
        _pools(information[s], long[s], expected[s], kind, own_shading) for s in range(len(images))
    )
    # Standard deviation of the shift of each leg's edges, px: noise and individual shading.
    sigma = np.full((len(images), n_legs), np.nan)
    pixel = np.linalg.norm(edges.shift, axis=-1)
    across = np.hypot(
        scale * np.sqrt(edges.covariance[:, 0, 0]) / pixel, estimate.edge_noise.shading[edges.tube]
    )
    for s, j in np.ndindex(len(images), n_legs):
        mine = (edges.station == s) & (edges.leg == j) & (estimate.edge_weights > INLIER_WEIGHT)
        sigma[s, j] = np.median(across[mine]) if mine.any() else np.nan
    by_station = tuple(
        EdgesOf(own, whole[s, p.configuration], (inlier & whole)[s, p.configuration])
        for s, (own, p) in enumerate(zip(rows, images, strict=True))
    )
    return FirstEdges(estimate, pools, sigma, by_station)


def _pools(
    values: Array, length: Array, expected: Booleans, kind: Integers, shading: Array
) -> Pools:
    """Pools of a station's edges (E,): samples of the tube's own edge and of all edges of its kind.

    values : (K, E, 2, 2) information, zero if lost.
    length : (K, E), px.
    expected : (K, E).
    kind : (E, 2) tube and side.
    shading : (E,) px.

    Samples are kept instead of their mean: edges of which some have much information and others
    none determine a pose less well than edges with the mean information.
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


def joined_pools(pools: Sequence[Pools]) -> Pools:
    """Pools of several stations' edges as one station's, such as of hand-held images."""
    out: list[EdgePool] = []
    for own in zip(*pools, strict=True):
        there = [pool for pool in own if len(pool.information)]
        information, weight, length = (
            np.concatenate([getattr(pool, name) for pool in there or own])
            for name in ("information", "weight", "length")
        )
        shading = float(np.mean([pool.shading for pool in own]))
        out.append(EdgePool(information, weight, length, shading))
    return tuple(out)


def drawn_edges(
    machine: Machine, edges: EdgeSet, pools: Sequence[Pools], rng: np.random.Generator | None
) -> EdgeSet:
    """Edges with the noise :data:`EXACT_EDGE_NOISE` replaced by information drawn at random from
    the pools.

    Edges with no information are removed. Without ``rng`` each edge has the mean information of its
    pool.
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
                below = rng.random((len(mine), 1)) > np.cumsum(chance, axis=1)
                own[mine] = pool.information[
                    np.minimum(below.sum(axis=1), len(pool.information) - 1)
                ]
    informative = np.linalg.eigvalsh(own)[:, 0] > 0
    edges, own = replace(edges, shading=shading).select(informative), own[informative]
    unit = pixel_turns(edges)
    return replace(edges, covariance=unit @ np.linalg.inv(own) @ unit.mT)


def pixel_turns(edges: EdgeSet) -> Array:
    """Turns (N, 2, 2) of simulated edges' normals by one pixel of shift and of tilt, in columns.

    This is the Cholesky factor of their covariance, as their bases have the shift first.
    """
    return np.linalg.cholesky(edges.covariance) / EXACT_EDGE_NOISE.shift


def pixel_lengths(edges: EdgeSet) -> Array:
    """Lengths (N,) in px of simulated edges, from their turn by one pixel of tilt."""
    return 2 / np.linalg.norm(pixel_turns(edges)[:, :, 1], axis=1)
