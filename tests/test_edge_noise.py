"""The edges' noise as the data show it, and what edges that are shaded alike count for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkmcal.identify.assembly import assemble, crowd, lines
from pkmcal.identify.bundle import as_ended, bundle, solve_batch
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.rows import EdgeData
from pkmcal.measurements import OWN_SHADING, SHADING_ALIKE_ANGLE, concatenate
from pkmcal.solver.search import minimise
from test_identify_scene import make_scene

LINE = 0.05
"""px, of what all edges of a line have in common."""


def shaded(rng, own, runs=8, configurations=8, n_stations=2):
    """A scene whose edges are shaded line by line, and each by ``own`` px beside, alike where
    normals are near."""
    scene = make_scene(rng, runs=runs, configurations=configurations, n_stations=n_stations)
    line = np.unique(scene.index[[0, 2, 3, 4]], axis=1, return_inverse=True)[1].ravel()
    shift = (LINE * rng.normal(size=(runs, line.max() + 1)))[:, line]
    for run in range(runs):
        for number in range(line.max() + 1):
            mine = np.flatnonzero(line == number)
            normal = scene.normal[run, mine]
            angle = np.arccos(np.clip(normal @ normal.T, -1, 1))
            root = np.linalg.cholesky(
                np.exp(-angle / SHADING_ALIKE_ANGLE) + 1e-9 * np.eye(len(mine))
            )
            drawn = root @ rng.normal(size=len(mine))
            shift[run, mine] += own * drawn
    return replace(scene, shading=shift)


def off(result, truth):
    """Mean square of the errors in units of the stated deviations."""
    error = (result.solution.state.z - truth.z) ** 2
    variance = np.einsum("bii->bi", result.info.covariance)[:, : error.shape[1]]
    return float(np.mean(error / variance))


@pytest.mark.parametrize(
    "factor", [0.8, *(pytest.param(factor, marks=pytest.mark.slow) for factor in (1.0, 3.0))]
)
def test_scale_and_shading_are_found(factor):
    """Of noise that is stated a quarter too large or three times too small, beside shading."""
    rng = np.random.default_rng(4)
    assembled, truth = shaded(rng, 0.15).batch(rng)
    data = assembled.problem.data
    problem = replace(assembled.problem, data=replace(data, white=factor * data.white))
    result = solve_batch(problem, truth)
    np.testing.assert_allclose(np.median(result.edges.scale, axis=0), factor, rtol=0.1)
    np.testing.assert_allclose(np.median(result.edges.shading, axis=0), 0.15, rtol=0.15)
    assert np.median(result.edges.tails) >= 20
    assert off(result, truth) == pytest.approx(1, abs=0.2)


class Heavy:
    """Draws as a generator's, pairs of numbers with Student's distribution of ``tails``."""

    def __init__(self, rng, tails):
        self.rng, self.tails = rng, tails

    def normal(self, size):
        drawn = self.rng.normal(size=size)
        if size[-2:] != (2, 1):
            return drawn
        return drawn / np.sqrt(self.rng.chisquare(self.tails, (*size[:-2], 1, 1)) / self.tails)


def test_heavy_tails_are_found_and_deviations_hold():
    rng = np.random.default_rng(5)
    assembled, truth = shaded(rng, 0.02).batch(Heavy(rng, 3))
    result = solve_batch(assembled.problem, truth)
    # lighter than drawn, for the furthest are let go
    assert np.median(result.edges.tails) <= 10
    assert result.trust.min() < 0.3
    assert off(result, truth) == pytest.approx(1, abs=0.2)


def test_the_same_edge_many_times_tells_its_shading_once():
    """Of each edge eight times, each has eight times the variance of what it is shaded by."""
    rng = np.random.default_rng(10)
    scene = shaded(rng, 0.1, runs=1)
    one = scene.measurements(rng)
    n = len(one.joints)
    eight = [replace(one.edges, configuration=one.edges.configuration + k * n) for k in range(8)]
    many = replace(one, edges=concatenate(eight), joints=np.tile(one.joints, (8, 1)))
    gauge = default_gauge(scene.machine)
    found = [assemble(scene.machine, m, gauge) for m in (one, many)]
    own = [at.places.edges.taken(at.problem.data.own[0]) for at in found]
    np.testing.assert_allclose(own[1], np.sqrt(8) * np.tile(own[0], 8))
    assert (own[0] > OWN_SHADING).all()


def test_what_nothing_shades_keeps_the_least():
    rng = np.random.default_rng(7)
    assembled, truth = shaded(rng, 0.0).batch(rng)
    result = solve_batch(assembled.problem, truth)
    assert np.median(result.edges.shading) < 2 * OWN_SHADING
    np.testing.assert_allclose(np.median(result.edges.scale, axis=0), 1, rtol=0.1)
    assert off(result, truth) < 1.15


def test_a_tube_that_nobody_saw_keeps_what_is_stated():
    rng = np.random.default_rng(11)
    scene = shaded(rng, 0.1, runs=1)
    measurements = scene.measurements(rng)
    first = replace(measurements, edges=measurements.edges.select(measurements.edges.tube == 0))
    noise = bundle(scene.machine, first, scene.state()).edge_noise
    assert noise.scale[0] != 1
    assert (noise.scale[1], noise.shading[1], noise.tails[1]) == (1, OWN_SHADING, np.inf)


def test_a_crowd_is_the_sum_over_its_line():
    rng = np.random.default_rng(8)
    measurements = shaded(rng, 0.1, runs=1).measurements(rng)
    edges, number = measurements.edges, lines(measurements)[1]
    expected = np.empty(len(edges))
    for k in range(len(edges)):
        near = edges.normal[number == number[k]] @ edges.normal[k]
        expected[k] = np.exp(-np.arccos(np.clip(near, -1, 1)) / SHADING_ALIKE_ANGLE).sum()
    np.testing.assert_allclose(crowd(measurements, number), expected, rtol=0.05)
    same = replace(edges, normal=np.broadcast_to(edges.normal[0], edges.normal.shape))
    counted = np.bincount(number)[number]
    np.testing.assert_allclose(crowd(replace(measurements, edges=same), number), counted)


numbers = st.floats(-3, 3, allow_nan=False)


@given(
    st.lists(numbers, min_size=6, max_size=6), st.floats(0.1, 5), st.floats(0, 5),
)  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_the_whitening_is_a_root_of_the_inverse_cotold(entries, scale, own):
    root = np.array([[np.exp(entries[0]), 0.0], [entries[1], np.exp(entries[2])]])
    shift = np.array(entries[3:5])
    white = np.linalg.inv(root)
    data = EdgeData(
        np.zeros((1, 1, 1, 1, 3, 2)), white[None, None, None], shift[None, None, None, :, None],
        np.zeros((1, 1, 1)), np.ones((1, 1, 1)),
        scale=np.full((1, 1, 1), scale), own=np.full((1, 1, 1), own),
    )  # fmt: skip
    covariance = scale**2 * root @ root.T + own**2 * np.outer(shift, shift)
    found = data.whiten[0, 0, 0]
    np.testing.assert_allclose(found @ covariance @ found.T, np.eye(2), atol=1e-6)


def test_what_was_found_is_what_counts_afterwards():
    """The problem at an estimate's end has its minimum, and its covariance, where the estimate
    has them."""
    rng = np.random.default_rng(9)
    scene = shaded(rng, 0.15, runs=1)
    measurements = scene.measurements(rng)
    estimate = bundle(scene.machine, measurements, scene.state())
    assembled, info = as_ended(measurements, estimate)
    found = minimise(assembled.problem, info.state).state
    rows = assembled.places.edges.taken(assembled.problem.unweighted(found).edges[0])
    np.testing.assert_allclose(rows, estimate.edge_residuals, atol=0.02)
    alone = replace(measurements, shaded=False)
    edges = assemble(scene.machine, alone, default_gauge(scene.machine)).problem.data
    at = assembled.places.edges
    # that one edge's residual is in the deviations that it has by itself
    own = assembled.problem.data
    crowd = at.taken(assembled.problem.blocks.crowd)
    variance = at.taken(own.own[0]) ** 2 / crowd
    np.testing.assert_allclose(
        variance, estimate.edge_noise.shading[measurements.edges.tube] ** 2, rtol=1e-9
    )
    np.testing.assert_allclose(
        at.taken(edges.white[0]),
        at.taken(own.white[0]) * estimate.edge_noise.scale[measurements.edges.tube][:, None, None],
        rtol=1e-9,
        atol=1e-6,
    )
