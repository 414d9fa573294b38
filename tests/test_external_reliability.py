"""Contribution of undetected wrong edges to the standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.error_correlation import covariance_of_correlated
from pkmcal.identify.external_reliability import (
    NOTICED_DISTANCE,
    WRONG_EDGE_REACH,
    covariance_of_undetected,
)
from test_edge_noise import shaded
from test_identify_scene import make_scene


def by_hand(rng, wrong, images=8, in_view=0.6, runs=1):
    """Scene of two images of each configuration, each from its own place."""
    scene = shaded(rng, 0.1, runs, images // 2, images)
    station, configuration = scene.index[:2]
    keep = (configuration == station // 2) & (rng.random(len(station)) < in_view)
    normal, middle, shading = (v[:, keep] for v in (scene.normal, scene.middle, scene.shading))
    scene = replace(
        scene,
        index=scene.index[:, keep],
        normal=normal,
        covariance=scene.covariance[keep],
        shift=scene.shift[keep],
        middle=middle,
        shading=shading,
    )
    return with_wrong(rng, scene, wrong)


def on_tripods(rng, wrong, runs=1, own=0.3):
    """A scene of two stations, polished, whose edges share what they are shaded by."""
    return with_wrong(rng, shaded(rng, own, runs, 8, 2, reach=0.3), wrong)


def with_wrong(rng, scene, share):
    """A share of all edges anywhere within the reach of a measurement pass."""
    off = rng.uniform(-WRONG_EDGE_REACH, WRONG_EDGE_REACH, scene.shading.shape)
    wrong = rng.random(scene.shading.shape) < share
    return replace(scene, shading=np.where(wrong, off, scene.shading))


def edge_by_edge(assembled, result, run):
    """Reference with all rows of all unknowns at once, from the module's formulas."""
    info, at = result.info, assembled.places.edges
    linear, data = info.linear, info.problem.data
    n_configurations, n_rows, na = linear.by_shared.shape[1:]
    d = linear.by_own.shape[-1]
    every = np.zeros((n_configurations, n_rows, na + n_configurations * d))
    every[..., :na] = linear.by_shared[run]
    for k in range(n_configurations):
        every[k, :, na + k * d : na + (k + 1) * d] = linear.by_own[run, k]
    prior = np.pad(linear.shared_by, ((0, 0), (0, n_configurations * d)))
    rows = np.concatenate([every.reshape(-1, every.shape[-1]), prior])
    inverse = np.linalg.inv(rows.T @ rows)

    def each(numbers):
        return at.taken(np.broadcast_to(numbers, (len(info.state.z), *at.shape))[run])

    v = at.taken(np.broadcast_to(data.by_shift, (len(info.state.z), *at.shape, 2))[run])
    size = np.linalg.norm(v, axis=-1)
    first, second = (every[at.row, 2 * at.place + k] for k in range(2))
    x, y = (v / size[:, None]).T[..., None]
    scale, own, inliers = each(data.scale), each(data.own), each(result.weight.edges)
    alone = own / np.sqrt(each(info.problem.blocks.n_effective))
    own_variance = [(alone * size) ** 2 + scale**2, scale**2]
    share = [own_variance[0] / ((own * size) ** 2 + scale**2), np.ones(len(own))]
    far = [
        WRONG_EDGE_REACH * size / np.sqrt(variance * part)
        for variance, part in zip(own_variance, (1, 3), strict=True)
    ]
    turned, tube = (x * first + y * second, x * second - y * first), each(info.problem.blocks.tube)
    remainder = [1 - np.einsum("na,ab,nb->n", part, inverse, part) for part in turned]
    unseen = [
        np.minimum(NOTICED_DISTANCE / r, most) for r, most in zip(remainder, far, strict=True)
    ]
    lost = np.sum(1 - inliers)
    p = (lost + 0.5) / (np.sum(inliers * (1 - unseen[0] / far[0])) + lost + 1)
    out = np.zeros_like(inverse)
    for part, r, u, most, similar in zip(turned, remainder, unseen, far, share, strict=True):
        square = u**3 / (3 * most)
        for number in range(tube.max() + 1):
            mine = tube == number
            irls_weight = inliers[mine]
            counted = min(
                p * np.sum(irls_weight * (r * square)[mine]) / np.sum(irls_weight * r[mine]), 1.0
            )
            by = part[mine] @ inverse
            out += (by.T * irls_weight * similar[mine] * (p * square[mine] - counted)) @ by
    return out[:na, :na], lost


@pytest.mark.parametrize("make", [by_hand, on_tripods])
def test_it_is_what_each_edge_could_do(make):
    rng = np.random.default_rng(1)
    assembled, truth = make(rng, 0.06, runs=2).batch(rng)
    result = solve_batch(assembled.problem, truth)
    value = covariance_of_undetected(result.info, result.weight.edges)
    for run in range(2):
        expected, lost = edge_by_edge(assembled, result, run)
        assert lost > 1
        np.testing.assert_allclose(value[run], expected, atol=1e-6 * np.abs(expected).max())


def test_where_images_share_a_station_it_is_little():
    """There all other edges contradict a wrong one, polished as they are; by hand, few."""
    added = []
    for make in (on_tripods, by_hand):
        rng = np.random.default_rng(2)
        assembled, truth = make(rng, 0.02).batch(rng)
        result = solve_batch(assembled.problem, truth)
        assert np.linalg.eigvalsh(result.covariance[0]).min() > 0
        similar = covariance_of_correlated(result.info)[0]
        share = np.linalg.solve(similar, result.covariance[0] - similar)
        added.append(float(np.trace(share)) / len(share))
    assert 0 <= added[0] < 0.02
    assert added[1] > 2 * added[0]


def test_nothing_is_added_where_light_moves_no_edge():
    rng = np.random.default_rng(3)
    assembled, truth = make_scene(rng, configurations=5).batch(rng)
    result = solve_batch(assembled.problem, truth)
    assert not covariance_of_undetected(result.info, result.weight.edges).any()
    np.testing.assert_array_equal(result.covariance, covariance_of_correlated(result.info))
