"""What wrong edges that go unnoticed add to the deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.identify.alike import covariance_of_alike
from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.unnoticed import NOTICED_DISTANCE, WRONG_EDGE_REACH, covariance_of_unnoticed
from test_edge_noise import shaded
from test_identify_scene import make_scene


def by_hand(rng, wrong, photographs=8, seen=0.6, runs=1):
    """A scene of two photographs a configuration, each from its own place, with a share of all
    edges anywhere within the reach of a look."""
    scene = shaded(rng, 0.1, runs, photographs // 2, photographs)
    station, configuration = scene.index[:2]
    keep = (configuration == station // 2) & (rng.random(len(station)) < seen)
    normal, middle, shading = (v[:, keep] for v in (scene.normal, scene.middle, scene.shading))
    off = rng.uniform(-WRONG_EDGE_REACH, WRONG_EDGE_REACH, shading.shape)
    return replace(
        scene,
        index=scene.index[:, keep],
        normal=normal,
        covariance=scene.covariance[keep],
        shift=scene.shift[keep],
        middle=middle,
        shading=np.where(rng.random(shading.shape) < wrong, off, shading),
    )


def edge_by_edge(assembled, result, run):
    """The same by all rows of all unknowns at once, from the module's formulas."""
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
    scale, own, kept = each(data.scale), each(data.own), each(result.weight.edges)
    far = [
        WRONG_EDGE_REACH * size / np.hypot(scale, own * size),
        WRONG_EDGE_REACH * size / np.sqrt(3) / scale,
    ]
    turned, used, tube = (x * first + y * second, x * second - y * first), kept > 0, each(
        info.problem.blocks.tube
    )  # fmt: skip
    left = [1 - np.einsum("na,ab,nb->n", part, inverse, part) for part in turned]
    unseen = [np.minimum(NOTICED_DISTANCE / r, most) for r, most in zip(left, far, strict=True)]
    lost = np.sum(1 - kept)
    p = (lost + 0.5) / (np.sum(1 - (unseen[0] / far[0])[used]) + lost + 1)
    out = np.zeros_like(inverse)
    for part, r, u, most in zip(turned, left, unseen, far, strict=True):
        square = u**3 / (3 * most)
        for number in range(tube.max() + 1):
            mine = used & (tube == number)
            counted = min(p * np.sum((r * square)[mine]) / np.sum(r[mine]), 1.0)
            by = part[mine] @ inverse
            out += (by.T * (p * square[mine] - counted)) @ by
    return out[:na, :na], lost


def test_it_is_what_each_edge_could_do():
    rng = np.random.default_rng(1)
    assembled, truth = by_hand(rng, 0.06, runs=2).batch(rng)
    result = solve_batch(assembled.problem, truth)
    found = covariance_of_unnoticed(result.info, result.weight.edges)
    for run in range(2):
        expected, lost = edge_by_edge(assembled, result, run)
        assert lost > 1
        np.testing.assert_allclose(found[run], expected, atol=1e-6 * np.abs(expected).max())


def test_where_photographs_share_a_station_it_is_next_to_nothing():
    """There all other edges contradict a wrong one; by hand, few."""
    added = []
    for make in (lambda rng: shaded(rng, 0.1, 1, 12, 2), lambda rng: by_hand(rng, 0.0)):
        rng = np.random.default_rng(2)
        assembled, truth = make(rng).batch(rng)
        result = solve_batch(assembled.problem, truth)
        alike = covariance_of_alike(result.info)[0]
        share = np.linalg.solve(alike, result.covariance[0] - alike)
        added.append(float(np.trace(share)) / len(share))
    assert 0 <= added[0] < 0.001 < added[1]


def test_nothing_is_added_where_light_moves_no_edge():
    rng = np.random.default_rng(3)
    assembled, truth = make_scene(rng, configurations=5).batch(rng)
    result = solve_batch(assembled.problem, truth)
    assert not covariance_of_unnoticed(result.info, result.weight.edges).any()
    np.testing.assert_array_equal(result.covariance, covariance_of_alike(result.info))
