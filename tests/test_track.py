"""Edges of legs from one image: fast, and lost rather than guessed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.control.laws import task_of
from pkmcal.control.machine_view import legs_at, machine_view, true_edges
from pkmcal.control.track import (
    Sight,
    corrected_pose,
    edge_misfits,
    first_track_state,
    leg_lines,
    track,
    weighted_task,
)
from pkmcal.errors import InputError
from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import apply, perturb, pose_difference
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.observe.legs import first_binning
from pkmcal.observe.predict import tubes_of
from servo_lab import BESIDE, MIRROR, PERSPECTIVE, WITHIN, Lab

MACHINE = load_mechanism("gough-stewart")
AT = perturb(MACHINE.home(), np.array([0.03, -0.02, 0.05, 0.01, -0.008, 0.01]))
READINGS = MACHINE.inverse(AT[None])[0]
PIXEL = 1 / 564.0


@pytest.fixture(scope="module", params=["perspective", "mirror"])
def view(request):
    """A lab, its image at AT, and the sight of the tracker."""
    camera, T = (PERSPECTIVE, BESIDE) if request.param == "perspective" else (MIRROR, WITHIN)
    lab = Lab(MACHINE, camera, T)
    return lab, lab.image(AT, READINGS), Sight(machine_view(MACHINE, T), camera)


def root(lines):
    """Covariance of each edge alone, (L, 2, 2, 2) rad."""
    own = np.stack([lines.joint[:, :2, :2], lines.joint[:, 2:, 2:]], axis=1)
    return np.linalg.cholesky(own)


# ------------------------------------------------------------------ from images


def test_edges_are_found_within_their_sigma(view):
    lab, image, sight = view
    value = track(sight, first_track_state(sight.view), image, READINGS)
    assert value.valid.sum() >= 5
    truth = true_edges(sight.view, AT)[value.valid]
    lines = value.lines
    turn = np.swapaxes(lines.basis[value.valid], -1, -2) @ truth[..., None]
    whitened = np.linalg.solve(root(lines)[value.valid], turn)[..., 0]
    assert np.abs(whitened).max() < 4.5
    assert np.sqrt(np.mean(whitened**2)) < 1.5
    # no more than a pixel and a half, where a leg was seen at all
    focal = lab.camera.parameters[0]
    assert np.abs(turn[..., 0, 0]).max() * focal < 1.5
    off = pose_difference(value.T_base_platform, AT)
    assert np.linalg.norm(off[3:]) < 1.2e-3
    assert np.rad2deg(np.linalg.norm(off[:3])) < 0.3


def test_large_images_are_binned():
    """With three times as many pixels across, each edge blurred over as many: the same legs."""
    import cv2

    small = Lab(MACHINE, PERSPECTIVE, BESIDE).image(AT, READINGS)
    image = cv2.resize(small, (1920, 1440), interpolation=cv2.INTER_LINEAR)
    larger = PERSPECTIVE.parameters * np.r_[3.0, 3, 3, 3, np.ones(len(PERSPECTIVE.parameters) - 4)]
    larger[2:4] += 1
    camera = replace(PERSPECTIVE, image_size=(1920, 1440), parameters=larger)
    truth, outward = true_edges(machine_view(MACHINE, BESIDE), AT), []
    for picture, eye, shift in ((small, PERSPECTIVE, 0.2), (image, camera, 0.6)):
        view, pixels = machine_view(MACHINE, BESIDE), first_binning(eye.image_size)
        sight = Sight(view, eye, shift, pixels)
        at = track(sight, first_track_state(sight.view), picture, READINGS)
        assert at.valid.sum() >= 5
        outward.append(np.sum(at.lines.basis[..., 0] * (at.lines.normal - truth), axis=-1) / PIXEL)
    apart = np.abs(outward[0] - outward[1])
    assert np.nanmax(apart) < 0.25
    assert np.nanmedian(apart) < 0.1  # the shift that is taken off is of whole pixels


def test_an_image_late_by_a_millimetre_is_followed(view):
    """The readings have changed; the next image uses the correction of this one."""
    _, image, sight = view
    later = READINGS + np.array([1, -1, 1, 1, -1, 1]) * 1.5e-3
    first = track(sight, first_track_state(sight.view), image, later)
    second = track(sight, first.state, image, later)
    truth = true_edges(sight.view, AT)
    for at in (first, second):
        assert at.valid.sum() >= 4
        turn = np.swapaxes(at.lines.basis, -1, -2) @ truth[..., None]
        whitened = np.linalg.solve(root(at.lines)[at.valid], turn[at.valid])
        assert np.abs(whitened).max() < 4.5
    miss, start = (
        np.linalg.norm(MACHINE.inverse(T[None])[0] - READINGS)
        for T in (second.T_base_platform, second.state.T_base_platform)
    )
    assert miss < 0.7 * start


def test_a_first_image_several_pixels_off_is_searched():
    lab = Lab(MACHINE, PERSPECTIVE, BESIDE)
    image = lab.image(AT, READINGS)
    sight = Sight(machine_view(MACHINE, BESIDE), PERSPECTIVE)
    # a centimetre and two degrees aside: up to nine pixels
    shifted = MACHINE.inverse(perturb(AT, np.array([0, 0, 0.03, 0.01, 0.008, 0]))[None])[0]
    value = track(sight, first_track_state(sight.view), image, shifted)
    assert value.state.searched
    assert value.valid.sum() >= 4
    assert value.beside > 2e-3  # with a reason
    truth = true_edges(sight.view, AT)
    off = np.linalg.norm((value.lines.normal - truth)[value.valid], axis=-1)
    assert np.median(off) < 1.5 * PIXEL


def test_a_leg_painted_over_is_lost_and_the_others_are_not(view):
    lab, image, sight = view
    whole = track(sight, first_track_state(sight.view), image, READINGS)
    leg = int(np.flatnonzero(whole.valid)[0])
    painted = lab.painted(image, AT, READINGS, [leg])
    value = track(sight, whole.state, painted, READINGS)
    assert not value.valid[leg]
    assert value.valid.sum() >= whole.valid.sum() - 2  # painting may cover a neighbour
    assert "clear edge" in value.reasons[leg] or "one edge" in value.reasons[leg]
    assert np.isnan(value.lines.normal[leg]).all()


def test_an_empty_image_finds_nothing_and_keeps_to_the_readings(view):
    _, image, sight = view
    state = track(sight, first_track_state(sight.view), image, READINGS).state
    empty = np.full_like(image, 90)
    value = track(sight, state, empty, READINGS)
    assert not value.valid.any()
    assert all(value.reasons)
    np.testing.assert_allclose(value.T_base_platform, AT, atol=1e-9)
    again = track(sight, value.state, image, READINGS)
    assert again.valid.sum() >= 4


def test_readings_that_close_no_machine_are_no_edges(view):
    _, image, sight = view
    value = track(sight, first_track_state(sight.view), image, READINGS * [2, 1, 1, 0.2, 1, 1])
    assert not value.closed
    assert not value.valid.any()


@pytest.mark.parametrize(
    ("image", "found"),
    [
        (np.zeros((480, 640, 3), np.uint8), "uint8 of shape (480, 640, 3)"),
        (np.zeros((480, 640)), "float64 of shape (480, 640)"),
        (np.zeros((240, 320), np.uint8), "320x240 pixels"),
    ],
)
def test_images_that_are_none_are_named(image, found):
    sight = Sight(machine_view(MACHINE, BESIDE), PERSPECTIVE)
    with raises(InputError, found=found):
        track(sight, first_track_state(sight.view), image, READINGS)


# ------------------------------------------------------------------ edges to lines, exactly


def edges_of(T_base_platform, readings, rng=None, sigma=2e-4):
    """All edges that MACHINE shows at a pose, with the tangent noise of their covariance."""
    tubes = tubes_of(MACHINE)
    ends = limb_ends(MACHINE.layout, MACHINE.values, readings, T_base_platform)
    a, b = (apply(BESIDE, p)[tubes.leg] for p in (ends.a, ends.b))
    normal = edge_normal_jacobians(a, b, MACHINE.values[tubes.radius], tubes.side).n
    middle = (a + b) / 2
    basis = tangent_basis(normal, middle / np.linalg.norm(middle, axis=1)[:, None])
    count = len(tubes)
    covariance = np.tile(np.diag([sigma**2, (4 * sigma) ** 2]), (count, 1, 1))
    zeros = np.zeros(count, dtype=int)
    shift = np.tile([PIXEL, 0.0], (count, 1))
    edges = EdgeSet(
        zeros, zeros, tubes.leg, tubes.tube, tubes.side, normal, basis, covariance, shift,
        np.zeros((count, 2)),
    )  # fmt: skip
    if rng is None:
        return edges
    return turned(edges, rng.normal(size=(count, 2)) * np.array([1, 4]) * sigma)


def turned(edges, turn):
    """The edges with their normals turned by (M, 2) in their bases, rad."""
    normal = edges.normal + (edges.basis @ turn[..., None])[..., 0]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return replace(edges, normal=normal, basis=tangent_basis(normal, edges.basis[..., 0]))


VIEW = machine_view(MACHINE, BESIDE)
NEAR = perturb(AT, np.array([1e-3, -1e-3, 1e-3, 5e-4, -5e-4, 3e-4]))
NEAR_READINGS = MACHINE.inverse(NEAR[None])[0]


def test_lines_of_exact_edges_are_exact_to_second_order():
    rows = edge_misfits(VIEW, NEAR_READINGS, NEAR, edges_of(AT, READINGS, sigma=1e-7), 0.0)
    rows = replace(rows, information=np.tile(np.eye(2) / 1e-14, (len(rows.leg), 1, 1)))
    lines = leg_lines(VIEW, rows)
    assert lines.valid.all()
    np.testing.assert_allclose(lines.normal, true_edges(VIEW, AT), atol=1e-5)


def test_lines_scatter_as_their_covariance_states():
    rng = np.random.default_rng(0)
    truth, whitened = true_edges(VIEW, AT), []
    for _ in range(60):
        rows = edge_misfits(VIEW, READINGS, AT, edges_of(AT, READINGS, rng), 0.0)
        rows = replace(rows, information=np.linalg.inv(edges_of(AT, READINGS).covariance))
        lines = leg_lines(VIEW, rows)
        turn = np.swapaxes(lines.basis, -1, -2) @ truth[..., None]
        whitened.append(np.linalg.solve(root(lines), turn))
    assert np.mean(np.square(whitened)) == pytest.approx(1.0, abs=0.12)
    assert lines.agrees.all()


def test_an_edge_of_something_else_costs_the_leg_and_not_the_truth():
    edges = edges_of(AT, READINGS)
    turn = np.zeros((len(edges), 2))
    turn[0, 0] = 3 * PIXEL  # leg 1, one of its four edges
    rows = edge_misfits(VIEW, READINGS, AT, turned(edges, turn), 0.0)
    lines = leg_lines(VIEW, rows)
    assert not lines.agrees[0]
    assert lines.valid.tolist() == [False, True, True, True, True, True]
    assert np.isnan(lines.normal[0]).all()


def test_one_side_alone_is_no_leg():
    edges = edges_of(AT, READINGS)
    rows = edge_misfits(VIEW, READINGS, AT, edges.select((edges.leg != 2) | (edges.side == 0)), 0.0)
    assert leg_lines(VIEW, rows).valid.tolist() == [True, True, False, True, True, True]


def test_only_the_legs_that_count_are_answered():
    view = machine_view(MACHINE, BESIDE, np.array([4, 1]))
    lines = leg_lines(view, edge_misfits(view, READINGS, AT, edges_of(AT, READINGS), 0.0))
    np.testing.assert_allclose(lines.normal, true_edges(VIEW, AT)[[4, 1]], atol=1e-6)


def test_the_constant_shift_of_a_camera_is_taken_off():
    edges = edges_of(AT, READINGS)
    outward = turned(edges, 0.3 * edges.shift)
    rows = edge_misfits(VIEW, READINGS, AT, outward, 0.3)
    np.testing.assert_allclose(leg_lines(VIEW, rows).normal, true_edges(VIEW, AT), atol=1e-6)
    raw = leg_lines(VIEW, edge_misfits(VIEW, READINGS, AT, outward, 0.0))
    assert np.abs(raw.normal - true_edges(VIEW, AT)).max() > 1e-4


def test_the_pose_of_exact_edges_is_found_with_and_without_one_bad_leg():
    every = np.ones(6, dtype=bool)
    edges = edges_of(AT, READINGS)
    for bad in (False, True):
        if bad:
            sides = np.where(edges.side == 0, 3 * PIXEL, -3 * PIXEL)  # leg 4 as a whole aside
            turn = np.stack([sides * (edges.leg == 3), 0 * sides], axis=1)
            edges = turned(edges, turn)
        T = NEAR
        for _ in range(4):
            T = corrected_pose(VIEW, T, edge_misfits(VIEW, READINGS, T, edges, 0.0), every)
        # a leg of six that is 3 px aside would carry the pose along by ten times as much
        limit = 3e-3 if bad else 1e-6
        assert np.abs(pose_difference(T, AT)).max() < limit


def test_a_pose_without_edges_stays():
    rows = edge_misfits(VIEW, READINGS, AT, edges_of(AT, READINGS), 0.0)
    assert corrected_pose(VIEW, AT, rows, np.zeros(6, dtype=bool)) is AT


@pytest.mark.parametrize("law", ["edges", "directions"])
def test_weights_make_errors_white(law):
    """Errors of measured edges, drawn with their covariance, come out of one size in all rows."""
    rng = np.random.default_rng(3)
    goal, legs, every = true_edges(VIEW, AT), legs_at(VIEW, AT), np.ones(6, dtype=bool)
    lines = leg_lines(VIEW, edge_misfits(VIEW, READINGS, AT, edges_of(AT, READINGS), 0.0))
    factor = 1e-2 * np.linalg.cholesky(lines.joint)  # small, so that all is linear
    rows = []
    for _ in range(400):
        turn = (factor @ rng.normal(size=(6, 4, 1))).reshape(6, 2, 2, 1)
        normals = lines.normal + (lines.basis @ turn)[..., 0]
        normals /= np.linalg.norm(normals, axis=-1)[..., None]
        task, noise = weighted_task(law, task_of(law, VIEW, normals, goal, legs), lines, every)
        rows.append(task.error / (1e-2 * noise))
    spread = np.cov(np.array(rows).T)
    assert len(spread) == (24 if law == "edges" else 12)
    np.testing.assert_allclose(spread, np.eye(len(spread)), atol=0.25)
    assert np.mean(np.diag(spread)) == pytest.approx(1.0, abs=0.05)
