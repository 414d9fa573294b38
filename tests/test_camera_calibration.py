"""Camera calibration: synthetic truth is recovered, its uncertainty is honest, misuse is
reported.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from faults import raises
from page_documents import page_blocks, page_document
from pkmcal.boards.board import Detection, board_from_document, chessboard
from pkmcal.boards.detect import detect_boards
from pkmcal.boards.fit import (
    board_poses,
    covariance_of,
    fit_camera,
    linear_poses,
    settled_poses,
    views_of,
)
from pkmcal.boards.shape import bend_of, board_columns, deviation
from pkmcal.camera_calibration.calibrate import CALIBRATION_CHECK_OPTIONS, calibrate_camera
from pkmcal.camera_calibration.model_selection import (
    CALIBRATED_MODELS,
    MODEL_SELECTION_OPTIONS,
    best_of,
    camera_candidates,
    first_fit,
    is_worse,
    line_offsets,
    positions,
    spread_of_views,
    starting_cameras,
)
from pkmcal.camera_calibration.uncertainty import board_motion, projection_covariance
from pkmcal.cameras import camera_models
from pkmcal.errors import InputError, ResultError
from pkmcal.files import Document
from pkmcal.geometry.rigid import apply, dot, pose, pose_difference, rotation
from pkmcal.judge.camera_difference import camera_difference
from pkmcal.report.camera import outcome_of
from pkmcal.web.report_page import report_page
from test_boards import CAMERAS, render, view

BOARD = chessboard((8, 6), 0.03)
SIZE = (1024, 768)


def camera_of(model, *values):
    kind = camera_models()[model]
    parameters = np.zeros(len(kind.parameter_names))
    parameters[: len(values)] = values
    return kind(SIZE, parameters)


TRUE = {
    "pinhole": camera_of("pinhole", 1050, 1052, 515, 378, -0.17, 0.07, 8e-4, -6e-4),
    "fisheye": camera_of("fisheye", 320, 321, 508, 390, 0.03, -0.012),
    "unified": camera_of("unified", 270, 269, 514, 383, 0.97),
}
DEPTH = {"pinhole": 0.42, "fisheye": 0.16, "unified": 0.2}
TERMS = {"pinhole": ("k1", "k2", "p1", "p2"), "fisheye": ("k1", "k2"), "unified": ()}


WIDE = {
    "rational": camera_of(
        "rational", 560, 561, 515, 378, 0.9, 0.2, 8e-4, -6e-4, 0.01, 1.2, 0.4, 0.05
    ),
    "extended_unified": camera_of("extended_unified", 420, 421, 508, 390, 0.62, 1.1),
    "double_sphere": camera_of("double_sphere", 330, 331, 508, 390, -0.18, 0.59),
}


ONE_MODEL = pytest.mark.parametrize(
    "true",
    [pytest.param(true, id=name, marks=() if name == "unified" else pytest.mark.slow)
     for name, true in TRUE.items()],
)  # fmt: skip
"""Checks that hold for all models, whatever their rays."""


def poses_for(camera, count, seed, tilt=0.6):
    """Poses with the whole board in the image, in many directions, tilted to all sides."""
    rng = np.random.default_rng(seed)
    results = []
    while len(results) < count:
        draws = [
            (
                rng.uniform([80, 80], [SIZE[0] - 80, SIZE[1] - 80]),
                rng.normal(0, tilt, 3),
                rng.uniform(0.8, 1.5),
            )
            for _ in range(100)
        ]
        pixel, turn, depth = (np.array(values) for values in zip(*draws, strict=True))
        ray = camera.ray(pixel)
        side = np.cross([0.0, 1.0, 0.0], ray)
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        facing = np.stack([side, np.cross(ray, side), ray], axis=-1)
        rot = rotation(turn) @ facing
        middle = ray * DEPTH.get(camera.model, 0.2) * depth[:, None]
        T = pose(rot, middle - rot @ BOARD.points.mean(axis=0))
        pixels = camera.project(apply(T[:, None], BOARD.points))
        whole = camera.in_image(pixels, 5).all(axis=-1)
        results += [*T[whole & (abs(dot(rot[..., 2], ray)) > 0.6)]]
    return np.stack(results[:count])


def detections(
    camera, T_camera_board, seed=0, noise=0.05, reference_values=True, wrong=0, points=BOARD.points
):
    """Corners of every pose with noise, the first ``wrong`` of each view 5 px off."""
    rng = np.random.default_rng(seed)
    out = []
    for k, T in enumerate(T_camera_board):
        pixels = camera.project(apply(T, points))
        pixels = pixels + rng.normal(0, noise, pixels.shape)
        pixels[:wrong] += 5.0
        ids = np.arange(len(pixels))
        sigma = np.full(len(ids), noise if reference_values else 0.0)
        out.append(Detection(f"p{k}.png", SIZE, ids, pixels, sigma))
    return out


def alone(*models):
    """Options to fit these models only; for a requested model, other models only show whether they
    fit better.
    """
    selection = replace(MODEL_SELECTION_OPTIONS, models=models)
    return replace(CALIBRATION_CHECK_OPTIONS, selection=selection)


@pytest.fixture(params=TRUE)
def true(request):
    return TRUE[request.param]


@pytest.fixture(scope="module")
def wide_views():
    return detections(TRUE["unified"], poses_for(TRUE["unified"], 10, 1), 2)


def calibration_of(name):
    """The model and the terms chosen by the views alone."""
    true = TRUE[name]
    return calibrate_camera(detections(true, poses_for(true, 10, 1), 2), BOARD)


@pytest.fixture(scope="module")
def wide_calibration():
    return calibration_of("unified")


def check_truth(value, true):
    """Model and terms are found, and every intrinsic within its uncertainty."""
    assert value.camera.model == true.model
    assert true.model != "pinhole" or set(TERMS["pinhole"]) <= set(value.terms)
    off = value.camera.parameters - true.parameters
    free = value.sigma > 0
    chi2 = off[free] @ np.linalg.inv(value.covariance[np.ix_(free, free)]) @ off[free]
    assert chi2 < 4 * free.sum()
    assert value.rms == pytest.approx(0.05 * np.sqrt(2), rel=0.1)
    assert value.rms < value.held_out.rms < 1.2 * value.rms
    assert value.held_out.straightness < 0.06
    assert value.spread == 1.0
    np.testing.assert_array_equal(value.camera.covariance, value.covariance)


def test_the_truth_comes_back(wide_calibration):
    check_truth(wide_calibration, TRUE["unified"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_the_truth_of_other_models_comes_back(name):
    check_truth(calibration_of(name), TRUE[name])


def test_every_camera_model_can_be_calibrated():
    assert set(CALIBRATED_MODELS) == set(camera_models())


@pytest.mark.parametrize("model", ["extended_unified", "double_sphere"])
def test_the_truth_of_wide_models_comes_back(model):
    true = WIDE[model]
    values = detections(true, poses_for(true, 12, 1), 2)
    check_truth(calibrate_camera(values, BOARD, model, alone(model)), true)


def test_a_rational_lens_comes_back():
    """Fewer terms than the truth has describe it as well, with other coefficients."""
    true = WIDE["rational"]
    values = detections(true, poses_for(true, 12, 1), 2)
    value = calibrate_camera(values, BOARD, "rational", alone("pinhole", "rational"))
    assert value.camera.model == "rational"
    off = (value.camera.parameters - true.parameters)[:4] / value.sigma[:4]
    assert np.abs(off).max() < 3
    assert value.held_out.rms < 1.1 * value.rms
    pinhole = min(c.robust for c in value.compared if c.model == "pinhole")
    assert pinhole > 1.2 * min(c.robust for c in value.compared)


def test_a_named_model_is_compared_with_simpler_ones():
    """Six parameters of the double sphere model against seven of the fisheye model: equal errors,
    and the one whose focal length depends on no other field is preferred.
    """
    true = WIDE["double_sphere"]
    pool = camera_candidates(
        views_of(detections(true, poses_for(true, 12, 1), 2), BOARD),
        SIZE,
        ("fisheye", "double_sphere"),
    )
    (sphere,) = (c for c in pool if c.model == "double_sphere")
    chosen = best_of(pool)
    assert chosen.model == "fisheye"
    assert chosen.parameters > sphere.parameters
    assert chosen.robust == pytest.approx(sphere.robust, rel=0.01)


def test_images_give_the_camera(tmp_path):
    """From rendered images, including the corners."""
    camera, board = CAMERAS["pinhole"], chessboard((8, 5), 0.03)
    turns = ((0.5, 0.1, 0.1), (-0.5, 0.2, 0.0), (0.1, 0.6, 0.3), (0.0, -0.6, 0.0), (0.3, 0.4, 1.0))
    at = ((0.05, 0.02), (-0.06, 0.0), (0.0, -0.05), (0.04, 0.05), (0.0, 0.0))
    paths = []
    for k, (turn, where) in enumerate(zip(turns, at, strict=True)):
        image = render(camera, view(board, turn, where, 0.38), board, seed=k)
        paths.append(tmp_path / f"p{k}.png")
        cv2.imwrite(str(paths[-1]), image)
    calibration = calibrate_camera(detect_boards(paths, board), board, "pinhole", alone("pinhole"))
    focal, sigma = calibration.camera.parameters[:2], calibration.sigma[:2]
    np.testing.assert_allclose(focal, camera.parameters[:2], rtol=2e-3)
    assert np.all(np.abs(focal - camera.parameters[:2]) < 4 * sigma)
    assert calibration.held_out.rms < 0.1


@ONE_MODEL
def test_sigma_is_honest(true):
    """Over many runs, deviations over sigma have the spread 1 that they should have."""
    poses = poses_for(true, 8, 5)
    free = positions(true, TERMS[true.model])
    scaled = []
    for seed in range(40):
        views = views_of(detections(true, poses, seed, reference_values=seed % 2 == 0), BOARD)
        fit = fit_camera(true, free, views, poses)
        sigma = np.sqrt(np.diag(covariance_of(fit, views)[0]))[free]
        scaled.append((fit.camera.parameters - true.parameters)[free] / sigma)
    # 40 runs: the spread is known to 11 %
    spread = np.sqrt(np.mean(np.square(scaled), axis=0))
    assert np.all((spread > 0.65) & (spread < 1.4)), spread
    assert np.mean(np.abs(scaled) < 1) == pytest.approx(0.68, abs=0.08)


@pytest.mark.parametrize("distance", [0.5, np.inf])
def test_the_uncertainty_of_projection_covers_the_truth(distance):
    """Over many calibrations from new noise, the pixel of a point that stands still relative to the
    boards scatters as stated, in the middle, at the border and beyond the corners.
    """
    true = TRUE["pinhole"]
    poses, free = poses_for(true, 8, 5), positions(true, TERMS["pinhole"])
    pixels = np.array([[512.0, 384.0], [100.0, 100.0], [990.0, 384.0], [1010.0, 755.0]])
    far = 1e7 if np.isinf(distance) else distance
    in_board = apply(np.linalg.inv(poses)[:, None], true.ray(pixels) * far)
    squares = []
    for seed in range(60):
        views = views_of(detections(true, poses, seed), BOARD)
        fit = fit_camera(true, free, views, poses)
        covariance, of_poses, by = covariance_of(fit, views)
        motion = board_motion(fit.T_camera_board, of_poses, by, covariance)
        stated = projection_covariance(fit.camera, covariance, motion, pixels, distance)
        point = apply(fit.T_camera_board[:, None], in_board).mean(axis=0)
        off = fit.camera.project(point) - pixels
        squares.append(np.einsum("ki,kij,kj->k", off, np.linalg.inv(stated), off))
    # chi-square with two degrees of freedom: mean 2, 68.3 % below 2.30 and 95.4 % below 6.18
    squares = np.array(squares)
    assert np.all(np.abs(squares.mean(axis=0) - 2) < 0.9)
    assert np.mean(squares < 2.30) == pytest.approx(0.683, abs=0.1)
    assert np.mean(squares < 6.18) == pytest.approx(0.954, abs=0.05)


def test_opencv_agrees():
    """cv2.calibrateCamera, with the same terms and equal weights, is the same least squares."""
    true = TRUE["pinhole"]
    value = detections(true, poses_for(true, 8, 3), 4, reference_values=False)
    views = views_of(value, BOARD)
    free = positions(true, TERMS["pinhole"])
    ours = fit_camera(true, free, views, settled_poses(true, views)).camera.parameters
    objects = [BOARD.points.astype(np.float32)] * 8
    pictures = [d.pixels.astype(np.float32).reshape(-1, 1, 2) for d in value]
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    _, k, d, *_ = cv2.calibrateCamera(
        objects, pictures, SIZE, None, None, flags=cv2.CALIB_FIX_K3, criteria=until
    )
    k, d = np.asarray(k), np.asarray(d).ravel()
    np.testing.assert_allclose(ours[:4], [k[0, 0], k[1, 1], k[0, 2], k[1, 2]], rtol=2e-4)
    np.testing.assert_allclose(ours[4:8], d[:4], atol=3e-3)


def test_a_tilted_sensor():
    """Angles and projection, against cv2.calibrateCamera's; without a tilt none is estimated."""
    true = TRUE["pinhole"].parameters
    tilt = camera_of("rational", *true, 0, 0, 0, 0, 0, 0, 0, 0.05, -0.08)
    poses = poses_for(tilt, 14, 31)
    value = detections(tilt, poses, 31)
    ours = calibrate_camera(value, BOARD, options=alone("pinhole", "rational"))
    assert {"tau.x", "tau.y"} <= set(ours.terms)
    off = ours.camera.parameters - tilt.parameters
    assert np.abs(off[-2:] / ours.sigma[-2:]).max() < 3
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-12)
    _, k, d, *_ = cv2.calibrateCamera(
        [BOARD.points.astype(np.float32)] * len(value),
        [one.pixels.astype(np.float32).reshape(-1, 1, 2) for one in value],
        SIZE, None, None, flags=cv2.CALIB_TILTED_MODEL, criteria=until,
    )  # fmt: skip
    theirs = camera_of("rational", *np.asarray(k)[[0, 1, 0, 1], [0, 1, 2, 2]], *np.ravel(d))
    mine, opencv = (np.nanmedian(camera_difference(tilt, c).lengths) for c in (ours.camera, theirs))
    assert mine < 1.2 * opencv
    flat = detections(TRUE["pinhole"], poses, 31)
    assert calibrate_camera(flat, BOARD, options=alone("pinhole", "rational")).camera.model == (
        "pinhole"
    )


def misnumbered(value, columns=8):
    """Detections whose corners of the first column bear the numbers of the row above."""
    out = []
    for one in value:
        ids = one.ids.copy()
        first = ids % columns == 0
        ids[first] -= columns
        retained = ids >= 0
        out.append(
            replace(one, ids=ids[retained], pixels=one.pixels[retained], sigma=one.sigma[retained])
        )
    return out


@pytest.mark.slow
def test_corners_with_wrong_numbers_are_no_lens():
    """All fit but those of one column: the board is another, however well the rest fits."""
    true = TRUE["pinhole"]
    value = detections(true, poses_for(true, 10, 1), 2)
    with raises(InputError, code="board.numbering") as caught:
        calibrate_camera(misnumbered(value), BOARD, "pinhole", alone("pinhole"))
    assert caught.value.found.startswith(f"{BOARD.counts[1] - 1} of {len(BOARD.points)} corners")


@pytest.mark.slow
def test_corners_at_others_places_in_one_view_are_outliers():
    """A detection that failed once does not reject the board."""
    true = TRUE["pinhole"]
    calibration = detections(true, poses_for(true, 10, 1), 2)
    calibration = calibrate_camera(
        [*misnumbered(calibration[:1]), *calibration[1:]], BOARD, "pinhole", alone("pinhole")
    )
    assert np.all(calibration.weight[1:] > 0)


def test_too_many_corners_off_are_refused():
    """Fourteen of forty-eight corners some 5 px off: the rest of a board would confirm itself."""
    true = TRUE["pinhole"]
    values, rng = detections(true, poses_for(true, 10, 1), 2), np.random.default_rng(3)
    for one in values:
        one.pixels[rng.permutation(48)[:14]] += rng.normal(0, 5, (14, 2))
    with raises(ResultError, code="lens.too_many_rejected") as caught:
        calibrate_camera(values, BOARD, "pinhole", alone("pinhole"))
    assert float(caught.value.found.partition("%")[0]) == pytest.approx(100 * 14 / 48, abs=2)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_narrow_lens_is_a_pinhole_where_a_mirror_fits_as_well(seed):
    """Thirteen images as by a webcam: xi takes the place of k1 and k2 with fewer parameters, with a
    focal length of 2000 px.
    """
    true, noise = camera_of("pinhole", 855, 854, 547, 376, -0.28, 0.1, 1e-3), (0.15, 0.3)[seed]
    values = detections(true, poses_for(true, 13, seed, 0.35), seed, noise=noise)
    pool = camera_candidates(views_of(values, BOARD), SIZE, ("pinhole", "unified"))
    best = min(pool, key=lambda c: c.robust)
    fewest = min((c for c in pool if not is_worse(c, best)), key=lambda c: c.parameters)
    assert fewest.model == "unified"
    assert fewest.fit.camera.focal[0] > 1900
    chosen = best_of(pool)
    assert chosen.model == "pinhole"
    np.testing.assert_allclose(chosen.fit.camera.focal, true.focal, rtol=2e-3)


def test_tangential_terms_of_very_sharp_images_are_tried():
    """Without them a pinhole lens leaves ten times the noise, 0.05 px, and is not hopeless."""
    true = TRUE["pinhole"]
    values = detections(true, poses_for(true, 10, 1), 2, noise=0.005)
    pool = camera_candidates(views_of(values, BOARD), SIZE, ("pinhole", "unified"))
    chosen = best_of(pool)
    assert chosen.model == "pinhole"
    assert {"p1", "p2"} <= set(chosen.terms)


def test_no_model_wins_by_giving_up_more():
    """A fit without a quarter of the corners, whose rest fits better, against one that has all."""
    true = TRUE["pinhole"]
    views = views_of(detections(true, poses_for(true, 10, 1), 2), BOARD)
    pool = camera_candidates(views, SIZE, ("pinhole",))
    best = best_of(pool)
    by_view = best.by_view
    assert best.robust == pytest.approx(best.left_out, rel=0.02)  # none is rejected
    offset = replace(best, left_out=best.left_out / 2, robust=2 * best.robust, by_view=4 * by_view)
    assert best_of((offset, best)) is best
    assert is_worse(offset, best)


@pytest.mark.parametrize(("ratio", "sure"), [(1.3, True), (1.5, False)])
def test_a_focal_length_that_the_views_do_not_determine(ratio, sure):
    """Such a model is chosen only if the others leave out more than the noise."""
    true = TRUE["pinhole"]
    views = views_of(detections(true, poses_for(true, 10, 1), 2), BOARD)
    best = best_of(camera_candidates(views, SIZE, ("pinhole",)))
    assert 0 < best.focal_share < 0.005
    unsure = replace(best, focal_share=0.16)
    other = replace(best, robust=ratio * best.robust, by_view=ratio**2 * best.by_view)
    assert is_worse(other, unsure)
    assert best_of((unsure, other)) is (other if sure else unsure)
    assert best_of((unsure,)) is unsure


@ONE_MODEL
def test_single_bad_corners_do_no_harm(true):
    calibration = calibrate_camera(
        detections(true, poses_for(true, 10, 1), 2, wrong=2), BOARD, true.model, alone(true.model)
    )
    free = calibration.sigma > 0
    assert np.all(calibration.weight[:, :2] < 0.1)
    assert np.mean(calibration.weight[:, 2:] > 0.99) > 0.97
    off = (calibration.camera.parameters - true.parameters)[free] / calibration.sigma[free]
    assert np.abs(off[:5]).max() < 4
    assert any("20 of 480 corners" in text for text in calibration.warnings)


@pytest.mark.parametrize("count", [4, 10])
def test_views_of_a_right_camera_do_not_disagree(count):
    """The changes without single views are far larger than sigma where there are few."""
    true = TRUE["pinhole"]
    free = positions(true, TERMS["pinhole"])
    spreads = []
    for seed in range(20):
        poses = poses_for(true, count, seed)
        views = views_of(detections(true, poses, seed), BOARD)
        spreads.append(spread_of_views(fit_camera(true, free, views, poses), views))
    assert np.sum(np.array(spreads) > 1) <= 1


def test_views_that_disagree_widen_sigma():
    """A board bent anew in every view: noise alone would promise too much."""
    true = TRUE["pinhole"]
    poses, rng = poses_for(true, 10, 1), np.random.default_rng(0)
    x, y = ((BOARD.points - BOARD.points.mean(axis=0)) / 0.1)[:, :2].T
    results = []
    for k, T in enumerate(poses):
        bent = BOARD.points.copy()
        bent[:, 2] += 1e-3 * (rng.normal() * x * x + rng.normal() * y * y + rng.normal() * x * y)
        pixels = true.project(apply(T, bent)) + rng.normal(0, 0.05, (48, 2))
        results.append(Detection(f"p{k}.png", SIZE, np.arange(48), pixels, np.full(48, 0.05)))
    result = calibrate_camera(results, BOARD, "pinhole", alone("pinhole"))
    assert result.spread > 1.5
    assert any("views disagree" in text for text in result.warnings)
    assert np.all(np.abs(result.camera.parameters - true.parameters)[:2] < 4 * result.sigma[:2])


def bent_detections(bend, poses, seed):
    """Corners of a board with a bend (2,) m in its middle."""
    points = BOARD.points + np.tensordot(np.array(bend), bend_of(BOARD).displacement, axes=1)
    return detections(TRUE["pinhole"], poses, seed, points=points)


def test_a_flat_board_is_not_bent():
    """The score tests have their distribution by chance."""
    true, poses = TRUE["pinhole"], poses_for(TRUE["pinhole"], 10, 1)
    free, chances = positions(true, TERMS["pinhole"]), []
    for seed in range(40):
        views = views_of(detections(true, poses, seed), BOARD)
        fit = fit_camera(true, free, views, poses)
        chances.append([deviation(fit, views, column).chance for column in board_columns(BOARD)])
    assert np.all(np.abs(np.mean(np.array(chances) < 0.5, axis=0) - 0.5) < 0.25)
    assert np.mean(np.array(chances) < 0.01) < 0.06


def test_a_bent_board_is_named_or_estimated():
    true, bend = TRUE["pinhole"], np.array([4e-4, -2e-4])
    views = bent_detections(bend, poses_for(true, 10, 1), 3)
    flat = calibrate_camera(views, BOARD, "pinhole", alone("pinhole"))
    assert flat.bend is None
    assert "lens.board_bend" in [finding.code for finding in flat.findings]
    bent = calibrate_camera(views, BOARD, "pinhole", alone("pinhole"), bend=True)
    assert bent.findings == ()
    off = bent.bend.value - bend
    assert off @ np.linalg.solve(bent.bend.covariance, off) < 12
    assert bent.rms < 0.5 * flat.rms
    assert bent.spread == 1.0
    errors = [np.abs(c.camera.focal - true.focal).max() for c in (flat, bent)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 4 * bent.sigma[0]


def test_gaps_between_markers_a_few_per_cent_off_are_named():
    """A grid of 30 mm markers with gaps of 9 mm that is described with 9.4 mm."""
    fields = {"type": "aruco_grid", "markers": [5, 3], "marker": 0.03, "gap": 0.009}
    right, wrong = (
        board_from_document(
            Document(Path(), "", {**fields, "gap": gap, "dictionary": "DICT_4X4_50"}, {})
        )
        for gap in (0.009, 0.0094)
    )
    true, poses = TRUE["pinhole"], poses_for(TRUE["pinhole"], 10, 1)
    values = detections(true, poses, 2, points=right.points)
    named = calibrate_camera(values, wrong, "pinhole", alone("pinhole"))
    (finding,) = (one for one in named.findings if one.code == "lens.board_gap")
    assert finding.facts["value"] == pytest.approx(-4e-4, abs=1e-4)
    clean = calibrate_camera(values, right, "pinhole", alone("pinhole"))
    assert "lens.board_gap" not in [one.code for one in clean.findings]


def test_linear_poses_are_exact(true):
    """Rays of noise-free corners give the poses, beyond 90 degrees too."""
    poses = poses_for(true, 12, 8)
    rays = true.ray(true.project(apply(poses[:, None], BOARD.points)))
    np.testing.assert_allclose(linear_poses(rays, BOARD.points), poses, atol=1e-7)


def test_board_poses_and_their_sigma(true):
    poses = poses_for(true, 40, 9)
    value = board_poses(true, views_of(detections(true, poses, 1), BOARD))
    off = pose_difference(value.T_camera_board, poses)
    scaled = np.linalg.solve(np.linalg.cholesky(value.covariance), off[..., None])
    assert np.sqrt(np.mean(scaled**2)) == pytest.approx(1, abs=0.2)
    # by intrinsics: a camera with another focal length moves the poses as foretold
    step = np.zeros(len(true.parameters))
    step[0] = step[1] = 0.05
    other = replace(true, parameters=true.parameters + step)
    shifted = board_poses(other, views_of(detections(true, poses, 1), BOARD)).T_camera_board
    foretold = value.by_intrinsics @ step
    error = np.linalg.norm(pose_difference(shifted, value.T_camera_board) - foretold, axis=1)
    assert np.median(error) < 0.1 * np.median(np.linalg.norm(foretold, axis=1))


def test_lines_are_great_circles(true):
    T = poses_for(true, 1, 3)[0]
    pixels = true.project(apply(T, BOARD.points))
    assert np.abs(line_offsets(true, pixels, BOARD.lines)).max() < 1e-6
    shifted = pixels.copy()
    shifted[10] += [0.3, 0.4]
    off = line_offsets(true, shifted, BOARD.lines)
    assert 0.1 < np.abs(off).max() < 0.5


# refusals and warnings


def test_a_model_that_does_not_fit(wide_views):
    with raises(InputError, code="lens.model_misfit") as caught:
        calibrate_camera(wide_views, BOARD, "pinhole", alone("pinhole", "unified"))
    assert caught.value.expected.startswith("unified")


def test_no_such_model(wide_views):
    with raises(InputError, found="fishey", expected="fisheye"):
        calibrate_camera(wide_views, BOARD, "fishey")


def test_too_few_views(wide_views):
    nothing = replace(wide_views[2], ids=np.zeros(0, dtype=int), reason="dark")
    with raises(InputError, code="lens.too_few_views", found="2 of 3"):
        calibrate_camera([*wide_views[:2], nothing], BOARD)


def test_views_that_are_all_alike():
    """All images face the camera at one distance: focal length and distance cannot be separated."""
    true = camera_of("pinhole", 1050, 1052, 515, 378)
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(8):
        rot = rotation(np.array([0.0, 0.0, rng.normal()]))
        middle = np.array([*rng.uniform(-0.05, 0.05, 2), 0.5])
        poses.append(pose(rot, middle - rot @ BOARD.points.mean(axis=0)))
    with raises(ResultError, code="lens.focal_unidentifiable") as caught:
        calibrate_camera(detections(true, np.stack(poses)), BOARD, "pinhole", alone("pinhole"))
    assert "tilted by" in caught.value.found


def test_corners_of_no_board(wide_views):
    rng = np.random.default_rng(0)
    wild = [replace(d, pixels=d.pixels + rng.normal(0, 25, d.pixels.shape)) for d in wide_views]
    with pytest.raises((ResultError, InputError)) as caught:
        calibrate_camera(wild, BOARD, options=alone("pinhole"))
    assert caught.value.code in ("lens.no_model_fits", "lens.focal_unidentifiable")


def test_an_image_without_a_board_is_not_dropped_silently(wide_views):
    nothing = replace(wide_views[0], name="dark.png", ids=np.zeros(0, dtype=int), reason="too dark")
    calibration = calibrate_camera([*wide_views, nothing], BOARD, "unified", alone("unified"))
    assert calibration.views == tuple(d.name for d in wide_views)
    assert "1 of 11 images are not used: dark.png (too dark)." in calibration.warnings
    assert calibration.as_dict()["not_used"] == {"dark.png": "too dark"}


def test_the_strong_correlation_of_xi_is_named():
    true = camera_of("unified", 1500, 1502, 515, 378, 0.9)
    near = replace(TRUE["pinhole"], parameters=TRUE["pinhole"].parameters * 1.0)
    views = detections(true, poses_for(near, 10, 1), 2)
    calibration = calibrate_camera(views, BOARD, "unified", alone("unified"))
    pairs = [pair for pair in calibration.correlations if "xi" in pair[:2]]
    assert pairs
    assert pairs[0][2] > 0.95
    assert "lens.own_correlated" in [finding.code for finding in calibration.findings]


# The page


def test_the_page(wide_calibration, tmp_path):
    value = wide_calibration
    path = tmp_path / "p0.png"
    cv2.imwrite(str(path), np.full((768, 1024), 120, dtype=np.uint8))
    document = page_document(report_page(outcome_of(value, [path])))
    assert document["verdict"]["tone"] == "good"
    (block,) = page_blocks(document, "images", "images")
    assert len(block["images"]) == 10
    assert [one["title"] for one in block["images"] if one["webp"]] == ["p0.png"]
    # the largest held-out error first
    order = np.argsort(-value.held_out.by_view, kind="stable")
    assert [one["title"] for one in block["images"]] == [value.views[v] for v in order]
    rings, arrows = (
        [shape for one in block["images"] for shape in one["overlays"][0]["layers"][k]["shapes"]]
        for k in (0, 1)
    )
    assert len(rings) == len(arrows) == 480
    off = np.array([arrow["displacement"] for arrow in arrows[:48]])
    np.testing.assert_allclose(off, value.residuals[order[0]], atol=1e-5)
    (field,) = page_blocks(document, "images", "field")
    assert field["images"][0]["overlays"][0]["layers"][0]["shapes"]


def test_importing_cameras_needs_no_opencv():
    code = "import sys, pkmcal.cameras; sys.exit('cv2' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_tries_that_do_not_see_a_whole_view_are_no_start(monkeypatch):
    # Some mirrors that are tried first have no ray at all for small views near the border.
    monkeypatch.setitem(DEPTH, "pinhole", 1.2)
    poses = poses_for(TRUE["pinhole"], 25, seed=5)
    views = views_of(detections(TRUE["pinhole"], poses), BOARD)
    finite = [
        np.isfinite(c.ray(views.pixels)).all(axis=-1) for c in starting_cameras("unified", SIZE)
    ]
    assert any((rays.sum(axis=-1) < 4).any() for rays in finite)
    fit = first_fit("unified", views, SIZE)
    assert fit is not None
    assert np.linalg.norm(fit.T_camera_board[:, :3, 3] - poses[:, :3, 3], axis=-1).max() < 0.1


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_board_that_no_ray_meets_has_a_pose_that_can_be_computed_with():
    rays = np.full((len(BOARD.points), 3), np.nan)
    pose_of_none = linear_poses(rays, BOARD.points)
    for camera in TRUE.values():
        camera.project(apply(pose_of_none, BOARD.points))
