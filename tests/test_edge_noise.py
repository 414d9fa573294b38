"""Noise of edges and lines estimated from the data, and the effect of correlated edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkmcal.identify.assembly import assemble
from pkmcal.identify.bundle import bundle, solve_batch
from pkmcal.identify.error_correlation import covariance_of_correlated
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.line_shading import LineShadingOptions, common_shading
from pkmcal.measurements import (
    OWN_SHADING,
    SHADING_CORRELATION_ANGLE,
    TUBE_CORRELATION,
    concatenate,
)
from pkmcal.measurements.edges import EdgeData
from pkmcal.measurements.effects import SHIFT_SIGMA, lines
from pkmcal.measurements.line_cells import LineCells
from pkmcal.solver.search import minimise
from test_identify_scene import make_scene

LINE = 0.05
"""px, of what all edges of a line have in common."""


def correlated_errors(rng, line, normal):
    """Correlated draws of unit variance (B, n) for edges with normals (B, n, 3) of a line, by the
    distance of their normals.
    """
    out = np.zeros(normal.shape[:2])
    for run, number in np.ndindex(len(normal), line.max() + 1):
        mine = np.flatnonzero(line == number)
        angle = np.arccos(np.clip(normal[run, mine] @ normal[run, mine].T, -1, 1))
        root = np.exp(-angle / SHADING_CORRELATION_ANGLE) + 1e-9 * np.eye(len(mine))
        out[run, mine] = np.linalg.cholesky(root) @ rng.normal(size=len(mine))
    return out


def shaded(rng, own, runs=8, configurations=8, n_stations=2, tilt=0.0, reach=1.0):
    """Scene whose edges have shading common to their line, and ``own`` px each, correlated by the
    distance of normals; and tilts with ``tilt`` standard deviations, correlated in the same way.
    """
    scene = make_scene(rng, runs, configurations, n_stations, reach=reach)
    line = np.unique(scene.index[[0, 2, 3, 4]], axis=1, return_inverse=True)[1].ravel()
    shift = (LINE * rng.normal(size=(runs, line.max() + 1)))[:, line]
    shift = shift + own * correlated_errors(rng, line, scene.normal)
    turned = 0.0
    if tilt:
        root = np.linalg.cholesky(scene.covariance)
        v = np.linalg.solve(root, scene.shift[..., None])[..., 0]
        across = np.stack([-v[:, 1], v[:, 0]], axis=-1) / np.linalg.norm(v, axis=-1)[:, None]
        drawn = tilt * correlated_errors(rng, line, scene.normal)
        turned = (root @ across[..., None])[..., 0] * drawn[..., None]
    return replace(scene, shading=shift, turned=turned)


def off(result, truth):
    """Mean square of the errors in units of the stated deviations."""
    error = (result.solution.state.z - truth.z) ** 2
    variance = np.einsum("bii->bi", result.covariance)[:, : error.shape[1]]
    return float(np.mean(error / variance))


@pytest.mark.parametrize(
    "factor", [0.8, *(pytest.param(factor, marks=pytest.mark.slow) for factor in (1.0, 3.0))]
)
def test_scale_and_shading_are_found(factor):
    """Stated noise a quarter too large or three times too small, with shading."""
    rng = np.random.default_rng(4)
    assembled, truth = shaded(rng, 0.15).batch(rng)
    data = assembled.problem.data
    problem = replace(assembled.problem, data=replace(data, white=factor * data.white))
    result = solve_batch(problem, truth)
    np.testing.assert_allclose(np.median(result.edges.scale, axis=0), factor, rtol=0.1)
    np.testing.assert_allclose(np.median(result.edges.shading, axis=0), 0.15, rtol=0.15)
    assert np.median(result.edges.dof) >= 20
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
    assert np.median(result.edges.dof) <= 10
    assert result.irls_weight.min() < 0.3
    assert off(result, truth) == pytest.approx(1, abs=0.2)


def test_the_same_edge_many_times_determines_its_shading_once():
    """Eight copies of each edge, each with eight times the variance of its shading."""
    rng = np.random.default_rng(10)
    scene = shaded(rng, 0.1, runs=1)
    one = scene.measurements(rng)
    n = len(one.joints)
    eight = [replace(one.edges, configuration=one.edges.configuration + k * n) for k in range(8)]
    many = replace(one, edges=concatenate(eight), joints=np.tile(one.joints, (8, 1)))
    gauge = default_gauge(scene.machine)
    results = [assemble(scene.machine, m, gauge) for m in (one, many)]
    own = [at.places.edges.taken(at.problem.data.own[0]) for at in results]
    np.testing.assert_allclose(own[1], np.sqrt(8) * np.tile(own[0], 8))
    assert (own[0] > OWN_SHADING).all()


def test_what_nothing_shades_keeps_the_least():
    rng = np.random.default_rng(7)
    assembled, truth = shaded(rng, 0.0).batch(rng)
    result = solve_batch(assembled.problem, truth)
    assert np.median(result.edges.shading) < 2 * OWN_SHADING
    np.testing.assert_allclose(np.median(result.edges.scale, axis=0), 1, rtol=0.1)
    assert off(result, truth) < 1.15


@pytest.mark.parametrize(("visible", "other"), [(0, 1), (1, 0)])
def test_a_tube_that_nobody_saw_keeps_what_is_stated(visible, other):
    rng = np.random.default_rng(11)
    scene = shaded(rng, 0.1, runs=1)
    measurements = scene.measurements(rng)
    there = measurements.edges.tube == visible
    alone = replace(measurements, edges=measurements.edges.select(there))
    noise = bundle(scene.machine, alone, scene.state()).edge_noise
    assert noise.scale[visible] != 1
    assert (noise.scale[other], noise.shading[other]) == (1, OWN_SHADING)
    assert noise.dof[other] == np.inf


def test_the_variance_of_a_mean_is_the_sum_over_its_line():
    rng = np.random.default_rng(8)
    measurements = shaded(rng, 0.1, runs=1).measurements(rng)
    edges, (keys, number) = measurements.edges, lines(measurements)
    side = np.unique(keys[:, [0, 1, 3]], axis=0, return_inverse=True)[1].ravel()
    expected = np.empty(len(edges))
    for k in range(len(edges)):
        near = edges.normal[number == number[k]] @ edges.normal[k]
        expected[k] = np.exp(-np.arccos(np.clip(near, -1, 1)) / SHADING_CORRELATION_ANGLE).sum()
    np.testing.assert_allclose(
        LineCells.of(edges.normal, number, side).n_effective, expected, rtol=0.01
    )
    same = np.broadcast_to(edges.normal[0], edges.normal.shape)
    counted = np.bincount(number)[number]
    np.testing.assert_allclose(LineCells.of(same, number, side).n_effective, counted)
    alone = np.where(number == 0, -1, number)
    np.testing.assert_array_equal(LineCells.of(same, alone, side).n_effective[number == 0], 1)


def test_what_edges_have_in_common_is_in_the_covariance():
    """Against the full covariance of all edges' errors, edge by edge."""
    rng = np.random.default_rng(12)
    scene = shaded(rng, 0.15, runs=1, configurations=5)
    measurements = scene.measurements(rng)
    assembled = assemble(scene.machine, measurements, default_gauge(scene.machine))
    result = solve_batch(assembled.problem, scene.batch(rng)[1])
    info, problem = result.info, result.info.problem
    at = assembled.places.edges
    rows = info.reduced.rows[0]
    jac = np.stack([rows[at.row, 2 * at.place + k] for k in range(2)], axis=1)
    data, edges = problem.data, measurements.edges
    v = at.taken(np.broadcast_to(data.by_shift, (1, *at.shape, 2))[0])
    size = np.linalg.norm(v, axis=-1)
    unit = v / size[:, None]
    along = np.einsum("nr,nra->na", unit, jac)
    across = unit[:, :1] * jac[:, 1] - unit[:, 1:] * jac[:, 0]
    number = lines(measurements)[1]
    angle = np.arccos(np.clip(edges.normal @ edges.normal.T, -1, 1))
    together = np.all([k[:, None] == k for k in (edges.station, edges.leg, edges.side)], axis=0)
    near = np.exp(-angle / SHADING_CORRELATION_ANGLE) * together
    shading_covariance = near * np.where(edges.tube[:, None] == edges.tube, 1.0, TUBE_CORRELATION)
    near = near * (number[:, None] == number)
    noise = at.taken(data.scale[0]) ** 2
    own = result.edges.shading[0][edges.tube] * size
    counted = noise + at.taken(data.own[0]) ** 2 * size**2
    shift = np.diag(noise / counted) + shading_covariance * np.outer(own, own) / np.sqrt(
        np.outer(counted, counted)
    )
    inverse, n = info.covariance[0], len(edges)
    shifted = {
        part: inverse @ (along.T @ (shift - np.eye(n)) @ along + part * tilts) @ inverse
        for part in (0.0, 1.0)
        for tilts in [across.T @ (near - np.eye(n)) @ across]
    }
    value = covariance_of_correlated(info)[0] - inverse
    # one parameter is free, the correlation of tilts
    part = np.sum((value - shifted[0]) * (shifted[1] - shifted[0])) / np.sum(
        (shifted[1] - shifted[0]) ** 2
    )
    assert 0 <= part <= 1
    expected = shifted[0] + part * (shifted[1] - shifted[0])
    assert np.abs(value - expected).max() < 0.03 * np.abs(expected).max()


@pytest.mark.parametrize("tilt", [pytest.param(0.0, marks=pytest.mark.slow), 2.0])
def test_deviations_hold_where_errors_of_edges_are_correlated(tilt):
    """With correlated tilts the inverse of the normal matrix alone is too small; with correlated
    shading only it is not, as in the tests above.
    """
    rng = np.random.default_rng(13)
    assembled, truth = shaded(rng, 0.1, runs=16, configurations=20, tilt=tilt, reach=0.15).batch(
        rng
    )
    result = solve_batch(assembled.problem, truth)
    assert off(result, truth) == pytest.approx(1, abs=0.15)
    machine = np.einsum("bii->bi", result.info.covariance)[:, : truth.z.shape[1]]
    by_itself = np.mean((result.solution.state.z - truth.z) ** 2 / machine)
    assert by_itself > 1.3 if tilt else by_itself == pytest.approx(1, abs=0.15)


def log_density(value, covariance):
    """Logarithm of the normal density, but for a constant; scipy.stats takes a second to import."""
    square = value @ np.linalg.solve(covariance, value)
    return -0.5 * (square + np.linalg.slogdet(covariance)[1])


def integrated(shift, covariance, sigma, least):
    """The mean of the lines' variance by quadrature, of normal shifts with one deviation."""
    tried = np.geomspace(least, 100 * least, 1000)
    inverse_covariance = np.linalg.inv(covariance) - np.diag(1 / sigma**2)
    best = np.linalg.solve(inverse_covariance, np.linalg.solve(covariance, shift))
    density = [
        log_density(best, np.linalg.inv(inverse_covariance) + s**2 * np.eye(len(shift)))
        for s in tried
    ]
    share = np.exp(density - np.max(density)) / (1 + (tried / SHIFT_SIGMA) ** 2)
    return np.sqrt(np.trapezoid(share * tried**2, tried) / np.trapezoid(share, tried))


@pytest.mark.parametrize(("line_sigma", "n"), [(0.01, 60), (0.3, 5)])
def test_the_lines_deviation_is_its_mean(line_sigma, n):
    """Near the true value if the data determine it; if hardly, well above the least."""
    normal = LineShadingOptions(freedom=1e9)
    rng = np.random.default_rng(14)
    true = rng.normal(0, 0.1, n)
    root = rng.normal(size=(n, n)) / np.sqrt(n)
    noise = line_sigma**2 * (root @ root.T + np.eye(n))
    measured = true + np.linalg.cholesky(noise) @ rng.normal(size=n)
    sigma = np.full(n, 0.2)
    covariance = np.linalg.inv(np.linalg.inv(noise) + np.diag(1 / sigma**2))
    shift = covariance @ np.linalg.solve(noise, measured)
    values = common_shading(shift[None], covariance[None], np.eye(n), sigma[None], 0.03, normal)[0]
    np.testing.assert_allclose(values, integrated(shift, covariance, sigma, 0.03), rtol=0.02)
    if line_sigma < 0.1:
        np.testing.assert_allclose(values, 0.1, rtol=0.2)
    else:
        assert np.all(values > 0.1)


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
        np.zeros((1, 1, 1, 1, 3, 2)), white[None, None, None], shift[None, None, None],
        np.zeros((1, 1, 1)), np.ones((1, 1, 1)),
        scale=np.full((1, 1, 1), scale), own=np.full((1, 1, 1), own),
    )  # fmt: skip
    covariance = scale**2 * root @ root.T + own**2 * np.outer(shift, shift)
    values = data.whiten[0, 0, 0]
    np.testing.assert_allclose(values @ covariance @ values.T, np.eye(2), atol=1e-6)


def test_what_was_found_is_what_counts_afterwards():
    """The problem at an estimate's end has its minimum, and its covariance, where the estimate
    has them."""
    rng = np.random.default_rng(9)
    scene = shaded(rng, 0.15, runs=1)
    measurements = scene.measurements(rng)
    estimate = bundle(scene.machine, measurements, scene.state())
    assembled, info = estimate.linearized
    solution = minimise(assembled.problem, info.state).state
    rows = assembled.places.edges.taken(assembled.problem.unweighted(solution).edges[0])
    np.testing.assert_allclose(rows, estimate.edge_residuals, atol=0.02)
    alone = replace(measurements, shaded=False)
    edges = assemble(scene.machine, alone, default_gauge(scene.machine)).problem.data
    at = assembled.places.edges
    # that one edge's residual is in the deviations that it has by itself
    own = assembled.problem.data
    n_effective = at.taken(assembled.problem.blocks.n_effective)
    variance = at.taken(own.own[0]) ** 2 / n_effective
    np.testing.assert_allclose(
        variance, estimate.edge_noise.shading[measurements.edges.tube] ** 2, rtol=1e-9
    )
    np.testing.assert_array_equal(edges.white, own.white)
    np.testing.assert_array_equal(
        at.taken(own.scale[0]), estimate.edge_noise.scale[measurements.edges.tube]
    )
