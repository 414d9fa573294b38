"""Edges to sub-pixel: planes fitted to positions, and images to planes with covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.observe import legs as leg_edges
from pkmcal.observe.grey_levels import levels_at
from pkmcal.observe.image_batches import ImageWindow, Placed, StationImages
from pkmcal.observe.legs import (
    EDGE_OPTIONS,
    _segment_profiles,
    measure,
)
from pkmcal.observe.predict import edge_points, legs_in_camera, tubes_of
from pkmcal.observe.profiles import (
    EDGE_FIT_OPTIONS,
    PROFILE_OPTIONS,
    edge_set,
    fit_edges,
)
from test_observe_rendered_legs import (
    FRONT,
    camera_of,
    draw,
    machine,
    outward_to,
    poses,
    redrawn,
    rendered_images,
    true_normals,
    tubes_at,
)


def taken(pictures=None) -> StationImages:
    pictures = pictures or rendered_images()[0]
    readings = machine().inverse(poses())
    rows = np.arange(len(pictures))
    return StationImages(0, camera_of(), rows, readings[rows], pictures)


def errors(edges):
    """Error of each edge: shift in px, its two coordinates in rad, and half its chi squared."""
    truth = true_normals(edges.leg, edges.tube, edges.side, edges.configuration)
    turn = np.einsum("nij,ni->nj", edges.basis, edges.normal - truth)
    chi2 = np.einsum("ni,nij,nj->n", turn, np.linalg.inv(edges.covariance), turn)
    return turn[:, 0] / edges.shift[:, 0], turn, chi2 / 2


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# images to edges


@pytest.mark.parametrize(("seed", "spread"), [(0, 0.0), (0, 0.0005), (1, 0.0005), (1, 0.001)])
def test_edges_are_measured_to_hundredths_of_a_pixel(seed, spread):
    """From a nominal model whose joints are wrong by up to a millimetre (half a pixel to a whole
    one).

    0.03 px for an edge, of which 0.02 are common to all: blur and edge shift are interchangeable,
    and the identification has an edge shift for the rest.
    """
    value = measure(taken(), redrawn(seed, spread), FRONT, poses())
    edges = value.edges
    assert len(edges) > 95
    shift, turn, chi = errors(edges)
    assert abs(shift.mean()) < 0.03
    assert rms(shift) < 0.05
    assert np.abs(shift).max() < 0.3
    # one, were it not for surfaces that differ from the model, which the covariance allows for
    assert 0.1 < chi.mean() < 1.2
    assert np.mean(chi > 4.5) < 0.03
    np.testing.assert_allclose(np.linalg.norm(edges.normal, axis=1), 1, atol=1e-12)
    # the blur of lens, pixel and interpolation
    assert 0.62 < value.blur < 0.78
    assert np.all(np.abs(turn[:, 1]) < 5 * np.sqrt(edges.covariance[:, 1, 1]))


def test_profiles_are_one_a_pixel_of_what_is_clear():
    """Each segment's mean is that of profiles taken one by one; an end of an edge outside the image
    does not affect the rest.
    """
    mechanism, camera = redrawn(0, 0.0005), camera_of()
    visible = ImageWindow.of([Placed(taken(), FRONT, poses())])
    tubes, points, clear = leg_edges.predicted(
        visible, mechanism, EDGE_OPTIONS.segments * EDGE_OPTIONS.segment_points
    )
    clear[:, :, 7] = False
    width = (points.gain * mechanism.values[tubes.radius][:, None])[
        ..., 1 :: EDGE_OPTIONS.segment_points
    ]
    full, across = _segment_profiles(visible, points, clear, width, EDGE_OPTIONS)
    pitch = np.linalg.norm(np.diff(points.pixel, axis=2), axis=-1)
    kinds: set[int] = set()
    for n in np.random.default_rng(0).choice(full.sum(), 40, replace=False):
        k, e, segment = (where[n] for where in np.nonzero(full))
        first = EDGE_OPTIONS.segment_points * segment
        end = first + EDGE_OPTIONS.segment_points
        furthest = np.ceil(pitch[k, e, first : end - 1].max())
        each = int(np.clip(furthest, EDGE_OPTIONS.fewest_profiles, EDGE_OPTIONS.most_profiles))
        mine = [p for p in range(first, end) if clear[k, e, p]]
        step = points.point[k, e, 1] - points.point[k, e, 0]
        turns = (np.arange(each) + 0.5) / each - 0.5
        place = [points.point[k, e, p] + turn * step for p in mine for turn in turns]
        outward = np.repeat(points.outward[k, e, mine], each, axis=0)
        pixel = camera.project(np.array(place))[:, None]
        pixel = pixel + PROFILE_OPTIONS.sampled_offsets[:, None] * outward[:, None]
        grey = levels_at(visible.images[k], pixel[..., 0], pixel[..., 1], cubic=True).mean(axis=0)
        assert across.count[n] == len(place)
        # OpenCV 4 rounds places to a 32nd of a pixel
        np.testing.assert_allclose(across.grey[n], grey[-len(across.grey[n]) :], atol=1.0)
        kinds.add(each)
    assert len(kinds) > 1

    pixel = points.pixel.copy()
    pixel[:, :, 0] = np.nan
    clear[:, :, 0] = False
    nearer = _segment_profiles(visible, replace(points, pixel=pixel), clear, width, EDGE_OPTIONS)[1]
    _, _, segment = np.nonzero(full)
    np.testing.assert_array_equal(nearer.count[segment > 0], across.count[segment > 0])


def test_every_edge_is_measured_or_has_a_reason():
    value = measure(taken(), redrawn(0, 0.0005), FRONT, poses())
    edges = value.edges
    keys = (edges.configuration, edges.leg, edges.tube, edges.side)
    measured = set(zip(*(key.tolist() for key in keys), strict=True))
    rejected = {(r.configuration, r.leg, r.tube, r.side) for r in value.rejected}
    assert len(measured) == len(edges)
    assert not measured & rejected
    assert len(measured | rejected) == 6 * len(tubes_of(machine()))
    hidden = sum("hidden" in r.reason for r in value.rejected)
    assert hidden > 0.5 * len(rejected)


def test_the_points_lie_on_the_true_edges():
    """Each point supports its edge's number; all are within a tenth of a pixel or two."""
    value = measure(taken(), redrawn(1, 0.0005), FRONT, poses())
    edges, camera = value.edges, camera_of()
    assert value.points.shape == (len(value.point_edge), 2)
    assert set(value.point_edge) == set(range(len(edges)))
    truth = true_normals(edges.leg, edges.tube, edges.side, edges.configuration)
    normal = truth[value.point_edge]
    # across the edge: along the image of its normal
    ray = camera.ray(value.points)
    shifted = camera.project(ray + 1e-4 * normal) - value.points
    outward = shifted / np.linalg.norm(shifted, axis=1, keepdims=True)
    off = outward_to(normal, value.points[:, None], outward[:, None], camera)[:, 0]
    assert rms(off) < 0.06
    # a place supports an edge within three of its sigmas, which reach PROFILE_OPTIONS.faint_sigma
    assert np.abs(off).max() < 3 * PROFILE_OPTIONS.faint_sigma


def test_an_image_that_shows_no_leg_leaves_the_others_as_they_are():
    beside = poses().copy()
    beside[2] = np.nan  # readings outside the nominal model's range have no pose
    usual = measure(taken(), machine(), FRONT, poses(), 0.7).edges
    value = measure(taken(), machine(), FRONT, beside, 0.7)
    assert 2 not in value.edges.configuration
    np.testing.assert_allclose(
        value.edges.normal, usual.normal[usual.configuration != 2], atol=1e-9
    )


def test_spans_lie_on_the_tubes():
    edges = measure(taken(), machine(), FRONT, poses()).edges
    tubes = tubes_of(machine())
    at = 4 * edges.leg + 2 * edges.tube + edges.side
    assert np.all(edges.span[:, 0] >= tubes.start[at])
    assert np.all(edges.span[:, 1] <= tubes.stop[at])
    assert np.all(edges.span[:, 1] - edges.span[:, 0] > 0.02)


def test_a_known_blur_is_used_and_reported():
    count = measure(taken(), machine(), FRONT, poses(), blur=0.7)
    assert count.blur == 0.7
    assert rms(errors(count.edges)[0]) < 0.05


def test_overexposed_images_give_no_edges_rather_than_wrong_ones():
    """The wall at 290 of 255 levels, the tubes before it at 190 and less: no edge is left."""
    bright = [draw(tubes_at(machine(), T), background=290.0)[0] for T in poses()[:2]]
    count = measure(taken(bright), machine(), FRONT, poses()[:2])
    assert len(count.edges) == 0
    assert len(count.rejected) == 2 * len(tubes_of(machine()))


def test_images_of_nothing_give_no_edges():
    empty = [np.full((480, 640), 120, np.uint8)] * 2
    assert len(measure(taken(empty), machine(), FRONT, poses()[:2]).edges) == 0


# Positions to planes

SAMPLES = 8


def predicted():
    legs = legs_in_camera(machine(), FRONT, poses(), machine().inverse(poses()))
    tubes = tubes_of(machine())
    return tubes, edge_points(machine(), camera_of(), legs, tubes, SAMPLES)


def fitted(position, sigma=0.1, value=None):
    tubes, points = predicted()
    value = np.ones(position.shape, dtype=bool) if value is None else value
    fits = fit_edges(points, position, np.full(position.shape, sigma), value)
    station = np.zeros(6, dtype=int)
    return fits, edge_set(points, fits, tubes, station, np.arange(6), fits.good)


def positions_of(mechanism):
    """Intersections of a mechanism's edges with the outward lines of the predicted points,
    (K, E, n) px.
    """
    tubes, points = predicted()
    legs = legs_in_camera(mechanism, FRONT, poses(), machine().inverse(poses()))
    normal = edge_points(mechanism, camera_of(), legs, tubes, 2).normal
    return outward_to(normal, points.pixel, points.outward, camera_of()), normal


def test_exact_positions_give_the_exact_plane():
    """Half a pixel from the prediction: second order, a thousandth of a pixel, is what remains."""
    position, normal = positions_of(redrawn(2, 0.0005))
    assert 0.5 < np.abs(position).max() < 3
    fits, edges = fitted(position)
    assert fits.good.all()
    turn = np.einsum("nij,ni->nj", edges.basis, edges.normal - normal.reshape(-1, 3))
    shift = turn[:, 0] / edges.shift[:, 0]
    assert np.abs(shift).max() < 3e-3


def test_a_common_shift_of_all_points_is_what_shift_states():
    """The plane's change by a pixel outward at every point, for a lens with distortion."""
    tubes, points = predicted()
    still = fitted(np.zeros(points.along.shape))[1]
    shifted = fitted(np.full(points.along.shape, 0.1))[1]
    turn = np.einsum("nij,ni->nj", still.basis, shifted.normal - still.normal)
    scale = np.abs(still.shift[:, :1])
    np.testing.assert_allclose(turn / 0.1 / scale, still.shift / scale, atol=2e-3)
    np.testing.assert_allclose(still.normal, points.normal.reshape(-1, 3), atol=1e-15)
    np.testing.assert_array_equal(still.leg, np.tile(tubes.leg, 6))


def test_turns_are_those_of_weighted_least_squares():
    """Against NumPy's, edge by edge, from all places down to none; one or two places give no edge,
    and spoil nothing.
    """
    rng = np.random.default_rng(0)
    _, points = predicted()
    shape = points.along.shape
    values = rng.random(shape) < rng.uniform(0, 1, shape[:2])[..., None]
    basis = fitted(np.zeros(shape))[0].basis
    rows = points.by_normal() @ basis
    turn = 1e-3 * rng.normal(size=(*shape[:2], 2))
    fits = fit_edges(points, np.einsum("kenj,kej->ken", rows, turn), np.full(shape, 0.1), values)
    count = values.sum(axis=-1)
    assert set(count.ravel()) == set(range(SAMPLES + 1))
    np.testing.assert_array_equal(fits.good, count > 2)
    assert np.isfinite(fits.turn).all()
    variance = 0.1**2 + EDGE_FIT_OPTIONS.sigma_floor**2
    for k, e in zip(*np.nonzero(fits.good), strict=True):
        visible = values[k, e]
        mine = rows[k, e, visible]
        np.testing.assert_allclose(fits.turn[k, e], turn[k, e], rtol=1e-6, atol=1e-11)
        solution = np.linalg.pinv(mine)
        scale = np.abs(solution).max()
        np.testing.assert_allclose(fits.operator[k, e][:, visible], solution, atol=1e-6 * scale)
        assert not fits.operator[k, e][:, ~visible].any()
        expected = (
            solution @ solution.T * variance * max(count[k, e] / EDGE_FIT_OPTIONS.effective, 1)
        )
        np.testing.assert_allclose(fits.covariance[k, e], expected, rtol=1e-6)


def test_positions_on_a_highlight_do_not_pull_the_edge():
    """Two of eight places half a pixel inside: left out, and the edge stays within 0.03 px."""
    noise = 0.05 * np.random.default_rng(0).normal(size=(6, 24, SAMPLES))
    clean = fitted(noise, 0.05)[1]
    noise[..., [2, 3]] -= 0.5
    fits, spoiled = fitted(noise, 0.05)
    assert not fits.used[..., [2, 3]].any()
    turn = np.einsum("nij,ni->nj", clean.basis, spoiled.normal - clean.normal)
    assert rms(turn[:, 0] / clean.shift[:, 0]) < 0.03


def test_an_edge_counts_as_two_measurements_however_many_its_places():
    """Positions that err together, as shading has it: the shift's sigma is the place's over
    the root of EDGE_FIT_OPTIONS.effective, and errors that are common to an edge stay within it."""
    rng = np.random.default_rng(1)
    sigma = 0.1
    common = sigma / np.sqrt(EDGE_FIT_OPTIONS.effective) * rng.normal(size=(6, 24, 1))
    own = 0.02 * rng.normal(size=(6, 24, SAMPLES))
    _, points = predicted()
    _, edges = fitted(common + own, sigma)
    shift = np.sqrt(edges.covariance[:, 0, 0]) / np.abs(edges.shift[:, 0])
    expected = np.hypot(sigma, EDGE_FIT_OPTIONS.sigma_floor) / np.sqrt(EDGE_FIT_OPTIONS.effective)
    # tilt and shift are not quite independent, and weights differ a little along an edge
    np.testing.assert_allclose(shift, expected, rtol=0.15)
    turn = np.einsum("nij,ni->nj", edges.basis, edges.normal - points.normal.reshape(-1, 3))
    ratio = turn[:, 0] / np.sqrt(edges.covariance[:, 0, 0])
    # 144 edges: the rms of a normal law is 1 within 0.06
    assert rms(ratio) == pytest.approx(1.0, abs=0.2)


def test_scatter_beyond_the_stated_sigmas_widens_the_covariance():
    noise = np.random.default_rng(2).normal(size=(6, 24, SAMPLES))
    values = fitted(0.02 * noise, 0.05)[1]
    worse = fitted(0.10 * noise, 0.05)[1]
    wider = worse.covariance[:, 0, 0] / values.covariance[:, 0, 0]
    assert np.median(wider) > 1.5


def test_edges_with_too_few_places_are_not_good():
    valid = np.zeros((6, 24, SAMPLES), dtype=bool)
    valid[..., :2] = True
    valid[0] = True
    fits, edges = fitted(np.zeros(valid.shape), value=valid)
    assert fits.good[0].all()
    assert not fits.good[1:].any()
    assert set(edges.configuration) == {0}
