"""One conformance test for every camera model, and the camera files.

A new model is found by enumeration; it needs example cameras in `EXAMPLES`, and in `OPENCV` the
same mathematics from cv2, if cv2 has it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from faults import raises
from pkmcal.cameras import camera_models, load_camera
from pkmcal.cameras.files import camera_text
from pkmcal.errors import InputError


class Example(NamedTuple):
    """Camera and its field of view.

    fields : of its file, without model. imaged : least share of the image with rays. outside :
    points of the camera frame that it cannot see, inside : points that it can.
    """

    fields: dict
    imaged: float = 1.0
    outside: tuple = ()
    inside: tuple = ((0.0, 0.0, 1.0), (0.2, -0.1, 1.0))


BEHIND = ((0.0, 0.0, -1.0), (0.1, -0.2, -1.0), (0.3, 0.1, 0.0), (0.0, 0.0, 0.0), (np.nan, 0, 1))


def pinhole(*distortion, imaged=1.0, outside=(), inside=()):
    size = {"image_size": (1024, 768), "focal": (500.0, 510.0), "center": (515.5, 380.5)}
    fields = {**size, "distortion": distortion}
    return Example(fields, imaged, BEHIND + outside, Example({}).inside + inside)


def wide(*distortion, imaged=1.0, behind=(0.0, 0.0, -1.0), beyond=(0.5, 0.1, 1.0), **fields):
    """A model that may reach beyond 90 degrees: ``beyond`` is in its field, ``behind`` is not."""
    size = {"image_size": (1024, 768), "center": (515.5, 380.5)}
    outside = (behind, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (np.nan, 0, 1))
    inside = (*Example({}).inside, beyond)
    return Example({**size, **fields, "distortion": distortion}, imaged, outside, inside)


# k1 alone folds where 1 + 3 k1 r^2 = 0: at 0.8607 for -0.45
FOLD = float(np.sqrt(1 / 1.35))

EXAMPLES = {
    "pinhole": {
        "no lens": pinhole(),
        "usual": pinhole(-0.2, 0.08, 1e-3, -2e-3),
        "strong barrel": pinhole(-0.38, 0.17, 2e-3, -1e-3, -0.03, imaged=0.85),
        "pincushion": pinhole(0.35, 0.2, -3e-3, 2e-3, 0.1),
        "tangential": pinhole(-0.05, 0.0, 0.02, -0.03, imaged=0.98),
        "folding": pinhole(
            -0.45,
            imaged=0.3,
            outside=((0.0, FOLD + 1e-6, 1.0), (0.0, 3.0, 1.0), (2.0, -2.0, 1.0)),
            inside=((0.0, FOLD - 1e-6, 1.0),),
        ),
        # Newton's method from the distorted point leaps over the folds of these two
        "barrel that turns": pinhole(-0.462, -0.132, 4e-3, 0.0, 0.16, imaged=0.5),
        "pincushion that turns": pinhole(0.417, -0.253, -2e-3, -4e-3, -0.043, imaged=0.75),
    },
    "rational": {
        "no lens": pinhole(),
        "usual": pinhole(0.5, 0.1, 1e-3, -2e-3, 0.01, 0.7, 0.15, 0.01),
        "thin prism": pinhole(
            -0.2, 0.08, 1e-3, -2e-3, 0, 0, 0, 0, 4e-3, -2e-3, -3e-3, 1e-3, imaged=0.95
        ),
        "tilted": pinhole(
            *(0.3, 0.1, 1e-3, -2e-3, 0.01, 0.5, 0.1, 0.02, 1e-3, 5e-4, -1e-3, 2e-4, 0.06, -0.09)
        ),
        # the radial factor has a pole at s = 2; the image grows without end before it
        "pole": pinhole(
            *(0, 0, 0, 0, 0, -0.5),
            outside=((1.4143, 0.0, 1.0), (0.0, 3.0, 1.0)),
            inside=((0.0, 1.4141, 1.0),),
        ),
        # r (1 - s / 5) / (1 + s / 5) stops growing where 1 - 0.8 s - 0.04 s^2 = 0
        "folding": pinhole(
            *(-0.2, 0, 0, 0, 0, 0.2),
            imaged=0.4,
            outside=((1.087, 0.0, 1.0),),
            inside=((0.0, 1.086, 1.0),),
        ),
    },
    "double_sphere": {
        "usual": wide(xi=-0.2, alpha=0.58, focal=(280.0, 281.0), beyond=(1.0, 0.5, -0.3)),
        "two spheres": wide(
            xi=0.6, alpha=0.3, focal=(400.0, 402.0), beyond=(1.0, 0.5, -0.5), behind=(0.1, 0, -0.9)
        ),
        "no spheres": wide(xi=0.0, alpha=0.0, focal=(500.0, 510.0), behind=(1.0, 0.0, -1e-3)),
    },
    "extended_unified": {
        "usual": wide(
            alpha=0.6, beta=1.1, focal=(280.0, 281.0), beyond=(1.0, 0.5, -0.3), imaged=0.98
        ),
        "flat": wide(alpha=0.3, beta=2.0, focal=(400.0, 402.0), beyond=(1.0, 0.5, -0.4)),
        "no ellipsoid": wide(alpha=0.0, beta=1.0, focal=(500.0, 510.0), behind=(1.0, 0.0, -1e-3)),
    },
    "fisheye": {
        "equidistant": wide(focal=(450.0, 452.0), beyond=(0.0, 1.0, -1.0)),
        "usual": wide(-0.03, 0.01, -4e-3, 3e-4, focal=(480.0, 481.0), beyond=(0.1, 1.0, -0.2)),
        # stops growing where 1 + 3 k1 t^2 = 0: at 46.8 degrees for -0.5
        "ends before 90 degrees": wide(
            -0.5, focal=(600.0, 600.0), behind=(1.07, 0.0, 1.0), beyond=(1.06, 0.0, 1.0), imaged=0.4
        ),
    },
    "unified": {
        "parabolic mirror": wide(xi=1.0, focal=(220.0, 221.0), beyond=(1.0, 0.5, -1.0)),
        "hyperbolic mirror": wide(
            xi=0.8, focal=(240.0, 239.0), beyond=(1.0, 0.5, -0.5), behind=(0.1, 0.2, -0.9)
        ),
        "wide lens": wide(
            *(-0.1, 0.02, 1e-3, -8e-4),
            xi=1.7,
            focal=(420.0, 424.0),
            beyond=(1.0, 1.0, -0.3),
            behind=(0.3, 0.3, -0.7),
            imaged=0.3,
        ),
        "no mirror": wide(
            -0.2, 0.08, 1e-3, -2e-3, xi=0.0, focal=(500.0, 510.0), behind=(1.0, 0.0, 0.0)
        ),
    },
}


def opencv_pinhole_project(fields, points):
    matrix, distortion = opencv_matrix(fields)
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, matrix, distortion)[0].reshape(-1, 2)


def opencv_pinhole_undistort(fields, pixels):
    matrix, distortion = opencv_matrix(fields)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4; in 5 the short name takes criteria
        value = cv2.undistortPointsIter(pixels, matrix, distortion, None, None, until)
    else:
        value = cv2.undistortPoints(pixels, matrix, distortion, criteria=until)
    return value.reshape(-1, 2)


def opencv_matrix(fields):
    (fx, fy), (cx, cy) = fields["focal"], fields["center"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return matrix, np.array([*fields["distortion"], *np.zeros(14)])[:14].astype(float)


OPENCV = dict.fromkeys(("pinhole", "rational"), (opencv_pinhole_project, opencv_pinhole_undistort))

ALL = [(model, name) for model, examples in EXAMPLES.items() for name in examples]


def made(model, name):
    example, kind = EXAMPLES[model][name], camera_models()[model]
    return example, kind.from_document(kind.schema(model=model, **example.fields))


@pytest.fixture(params=ALL, ids=": ".join)
def case(request):
    return made(*request.param)


def test_every_model_has_examples():
    missing = sorted(set(camera_models()) - set(EXAMPLES))
    assert not missing, f"add example cameras to EXAMPLES in tests/test_cameras.py for {missing}"


def picture_pixels(camera, count=60):
    """A grid over the whole image, its border included."""
    width, height = camera.image_size
    x, y = np.meshgrid(np.linspace(0, width - 1, count), np.linspace(0, height - 1, count))
    return np.stack([x, y], axis=-1)


def visible_points(camera, seed, count=400):
    """Points of the camera frame that project into the image, at all depths."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(40 * count, 3)) * np.exp(rng.normal(size=(40 * count, 1)))
    visible = camera.in_image(camera.project(points))
    return points[visible][:count]


def near_border(camera, share):
    """Rays a ``share`` of the way from the middle of the field to its end, in 24 directions."""
    angle = np.arange(24) * (np.pi / 12) + 0.1
    side = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    forward = np.array([0.0, 0.0, 1.0])

    def ray(theta):
        return np.cos(theta)[:, None] * forward + np.sin(theta)[:, None] * side

    low, high = np.zeros(24), np.full(24, np.pi)
    for _ in range(50):
        middle = (low + high) / 2
        held = camera.in_image(camera.project(ray(middle)))
        low, high = np.where(held, middle, low), np.where(held, high, middle)
    return ray(share * low)


def test_round_trips(case):
    """Pixel to ray to pixel: 1e-9 px, a thousand times the rounding of a pixel coordinate."""
    example, camera = case
    pixels = picture_pixels(camera)
    rays = camera.ray(pixels)
    imaged = np.isfinite(rays).all(axis=-1)
    assert imaged.mean() >= example.imaged
    np.testing.assert_allclose(np.linalg.norm(rays[imaged], axis=-1), 1, atol=1e-14)
    np.testing.assert_allclose(camera.project(rays[imaged]), pixels[imaged], atol=1e-9, rtol=0)


def test_points_come_back_as_their_directions(case):
    """No imaged point is lost or found in another place, whatever its depth."""
    _, camera = case
    points = visible_points(camera, 0)
    assert len(points) > 100
    pixels = camera.project(points)
    np.testing.assert_allclose(camera.project(7.0 * points), pixels, atol=1e-9, rtol=0)
    direction = points / np.linalg.norm(points, axis=-1, keepdims=True)
    off = np.linalg.norm(camera.ray(pixels) - direction, axis=-1)
    # near a fold, a pixel's rounding of 1e-13 turns the ray by its root
    assert off.max() < 1e-6
    assert np.median(off) < 1e-14


def test_shapes_follow_the_input(case):
    _, camera = case
    n = len(camera.parameter_names)
    assert camera.parameters.shape == (n,)
    for lead in ((), (3,), (2, 0), (2, 3)):
        points = np.broadcast_to([0.05, 0.02, 1.0], (*lead, 3))
        pixels = camera.project(points)
        assert pixels.shape == (*lead, 2)
        assert camera.in_image(pixels).shape == lead
        assert [j.shape for j in camera.project_jacobians(points)] == [
            (*lead, 2, 3),
            (*lead, 2, n),
        ]
        assert camera.ray(pixels).shape == (*lead, 3)
        assert [j.shape for j in camera.ray_jacobians(pixels)] == [(*lead, 3, 2), (*lead, 3, n)]


# Weights of a first derivative, exact to the sixth order: a step h leaves h^6 / 140 of the seventh
# derivative, and 1e-16 / h by rounding.
STENCIL = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))


def differences(function, x, steps):
    """Central differences of function(x) (..., m) by x (..., n), steps (..., n).

    Another way than the code's own chain rule; complex steps are no way where a model compares.
    """
    columns = []
    for k in range(x.shape[-1]):
        by = np.zeros(x.shape)
        by[..., k] = steps[..., k]
        total = sum(w * (function(x + i * by) - function(x - i * by)) for i, w in STENCIL)
        columns.append(total / steps[..., k, None])
    return np.stack(columns, axis=-1)


def agrees(value, oracle, tolerance):
    """Equal to a share of the largest entry of each matrix."""
    assert np.isfinite(value).all()
    scale = np.abs(oracle).max(axis=(-1, -2), keepdims=True)
    assert np.max(np.abs(value - oracle) / scale) < tolerance


class Place(NamedTuple):
    """Points where derivatives are tested.

    Towards the border of image or field, the fold among them, the inverse's higher derivatives
    grow, so steps shrink, and rounding takes more of the oracle.
    """

    share: tuple[float, float]
    step: float
    tolerance: float


PLACES = {
    "nominal": Place((0.0, 0.1), 1.0, 1e-9),
    "random": Place((0.1, 0.9), 0.05, 1e-8),
    "border": Place((0.99, 0.99), 0.002, 1e-8),
}


@pytest.fixture(params=PLACES)
def place(request):
    return PLACES[request.param]


def rays_at(camera, place):
    rng = np.random.default_rng(1)
    return near_border(camera, rng.uniform(*place.share, 24)) * rng.uniform(0.5, 2, (24, 1))


def by_parameters_of(method, camera, at, place):
    """Differences of a camera's method at given points by the camera's parameters."""
    steps = place.step * 1e-3 * np.maximum(1.0, np.abs(camera.parameters))

    def of(rows):
        return np.stack([getattr(replace(camera, parameters=p), method)(at) for p in rows])

    columns = []
    for by in np.diag(steps):
        up, down = (of([camera.parameters + sign * i * by for i, _ in STENCIL]) for sign in (1, -1))
        columns.append(np.tensordot([w for _, w in STENCIL], up - down, 1) / by.sum())
    return np.stack(columns, axis=-1)


def test_derivatives_of_project(case, place):
    _, camera = case
    points = rays_at(camera, place)
    by_point, by_parameters = camera.project_jacobians(points)
    steps = place.step * 1e-3 * np.linalg.norm(points, axis=-1, keepdims=True) * np.ones(3)
    agrees(by_point, differences(camera.project, points, steps), place.tolerance)
    value = by_parameters_of("project", camera, points, place)
    agrees(by_parameters, value, place.tolerance)


def test_the_projection_with_its_motion_along_directions(case, place):
    """To rounding: a model may compute value and derivatives in one pass through its lens."""
    _, camera = case
    points = np.concatenate([rays_at(camera, place), [[0.0, 0.0, 0.0]]])
    directions = np.random.default_rng(0).normal(size=(2, *points.shape))
    pixels, *shifted = camera.project_along(points, *directions)
    np.testing.assert_array_equal(pixels, camera.project(points))
    by_point = camera.project_jacobians(points)[0]
    for item, direction in zip(shifted, directions, strict=True):
        values = (by_point @ direction[..., None])[..., 0]
        # what is rounded are the terms of sums that may cancel
        size = np.linalg.norm(by_point, axis=(1, 2)) * np.linalg.norm(direction, axis=1)
        assert (np.abs(item - values).max(axis=1)[:-1] < 1e-12 * size[:-1]).all()
        assert np.isnan(item[-1]).all()


def test_a_search_may_ask_in_single_precision(case, place):
    _, camera = case
    points = rays_at(camera, place)
    u = np.random.default_rng(1).normal(size=points.shape)
    single = camera.project_along(points.astype(np.float32), u.astype(np.float32))
    for item, entries in zip(single, camera.project_along(points, u), strict=True):
        scale = np.nanmax(np.abs(entries))
        np.testing.assert_allclose(item, entries, rtol=1e-3, atol=1e-4 * scale)


def test_derivatives_of_ray(case, place):
    _, camera = case
    pixels = camera.project(rays_at(camera, place))
    by_pixel, by_parameters = camera.ray_jacobians(pixels)
    steps = np.full(pixels.shape, 0.3 * place.step)
    agrees(by_pixel, differences(camera.ray, pixels, steps), place.tolerance)
    value = by_parameters_of("ray", camera, pixels, place)
    agrees(by_parameters, value, place.tolerance)


def test_derivatives_of_ray_undo_those_of_project(case, place):
    """Near a fold, which differences do not resolve: one map's derivatives against the other's."""
    _, camera = case
    rays = rays_at(camera, place)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    pixels = camera.project(rays)
    forth, back = camera.project_jacobians(rays), camera.ray_jacobians(pixels)
    # rounding of the ray, 1e-16, times the second derivative near the fold
    np.testing.assert_allclose(forth[0] @ back[0], np.eye(2) * np.ones((24, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(forth[0] @ back[1] + forth[1], 0, atol=1e-6)
    for turn in back:
        np.testing.assert_allclose(rays[:, None] @ turn, 0, atol=1e-12 * np.abs(turn).max())


def test_a_binned_camera_sees_the_same_in_larger_pixels(case):
    _, camera = case
    points, small = visible_points(camera, 0), camera.binned(3)
    assert small.image_size == tuple(n // 3 for n in camera.image_size)
    pixels = (camera.project(points) + 0.5) / 3 - 0.5
    np.testing.assert_allclose(small.project(points), pixels, atol=1e-9, rtol=0)
    (by_point, by_own), (whole, by_whole) = (c.project_jacobians(points) for c in (small, camera))
    np.testing.assert_allclose(by_point, whole / 3, rtol=1e-9, atol=1e-12)
    by_own[..., :4] /= 3  # focal lengths and centre are smaller by three
    np.testing.assert_allclose(by_own, by_whole / 3, rtol=1e-9, atol=1e-9)
    assert camera.binned(1) is camera


def test_a_shifted_camera_sees_the_same_at_shifted_pixels(case):
    _, camera = case
    points, offset = visible_points(camera, 0), np.array([3.0, -7.5])
    shifted = camera.shifted(offset)
    np.testing.assert_allclose(shifted.center, camera.center + offset)
    np.testing.assert_allclose(shifted.project(points), camera.project(points) + offset, atol=1e-9)
    np.testing.assert_array_equal(shifted.focal, camera.focal)


def test_a_camera_turned_by_half_takes_the_same_picture_upside_down(case):
    """With its whole covariance; turned twice the camera is itself."""
    _, camera = case
    camera = replace(camera, covariance=np.diag(np.arange(1.0, len(camera.parameters) + 1)) + 0.1)
    points, turned = visible_points(camera, 0), camera.turned_by_half()
    upside_down = np.array(camera.image_size) - 1 - camera.project(points * [-1, -1, 1])
    np.testing.assert_allclose(turned.project(points), upside_down, atol=1e-9, rtol=0)
    again = turned.turned_by_half()
    np.testing.assert_allclose(again.parameters, camera.parameters, atol=1e-12)
    np.testing.assert_array_equal(again.covariance, camera.covariance)
    # displacement of the image by the parameters, with their standard deviations
    (_, own), (_, other) = (
        c.project_jacobians(p) for c, p in ((camera, points * [-1, -1, 1]), (turned, points))
    )
    np.testing.assert_allclose(
        other @ turned.covariance @ other.mT, own @ camera.covariance @ own.mT, rtol=1e-8, atol=1e-8
    )


@pytest.mark.parametrize(("model", "name"), [pair for pair in ALL if pair[0] in OPENCV])
def test_opencv_agrees(model, name):
    example, camera = made(model, name)
    project, undistort = OPENCV[model]
    points = np.concatenate([visible_points(camera, 2), near_border(camera, 0.9)])
    pixels = camera.project(points)
    np.testing.assert_allclose(project(example.fields, points), pixels, atol=1e-9, rtol=0)
    # cv2's fixed-point iteration only converges in the middle of a strong lens
    middle = near_border(camera, 0.4)
    values = undistort(example.fields, camera.project(middle))
    np.testing.assert_allclose(values, middle[:, :2] / middle[:, 2:], atol=1e-10)
    ray = camera.ray(camera.project(middle))
    np.testing.assert_allclose(values, ray[:, :2] / ray[:, 2:], atol=1e-10)


def test_the_field_ends_where_the_model_does(case):
    example, camera = case
    for points, expected in ((example.inside, True), (example.outside, False)):
        array = np.array(points, dtype=float).reshape(-1, 3)
        pixels = camera.project(array)
        np.testing.assert_array_equal(np.isfinite(pixels).all(axis=-1), expected)
        for jacobian in camera.project_jacobians(array):
            np.testing.assert_array_equal(np.isfinite(jacobian).all(axis=(-1, -2)), expected)
        assert not camera.in_image(pixels)[~np.isfinite(pixels).all(axis=-1)].any()


def test_before_its_end_the_field_does_not_fold(case):
    """Throughout the field the image keeps its orientation; a mirror image would be a fold."""
    _, camera = case
    points = np.random.default_rng(3).normal(size=(4000, 3))
    points = points[np.isfinite(camera.project(points)).all(axis=-1)]
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    by_point = camera.project_jacobians(rays)[0]
    turn = np.linalg.det(np.concatenate([by_point, rays[:, None, :]], axis=1))
    assert np.all(turn > 0)


def test_pixels_that_no_ray_meets():
    _, camera = made("pinhole", "folding")
    corner = camera.ray(np.array([[0.0, 0.0], [np.nan, 5.0]]))
    assert np.isnan(corner).all()
    assert np.isnan(camera.ray_jacobians(np.array([0.0, 0.0]))[0]).all()


def test_in_image_and_its_margin(case):
    _, camera = case
    width, height = camera.image_size
    pixels = np.array([[0, 0], [width - 1, height - 1], [-0.01, 5], [5, height - 0.99]])
    assert camera.in_image(pixels).tolist() == [True, True, False, False]
    edge = np.array([[4.0, 4.0], [3.99, 4.0], [width - 5.0, 10.0], [width - 4.99, 10.0]])
    assert camera.in_image(edge, margin=4.0).tolist() == [True, False, True, False]


# Camera files


def test_a_saved_camera_is_the_same(case, tmp_path):
    _, camera = case
    (tmp_path / "a.yaml").write_text(camera_text(camera))
    again = load_camera(tmp_path / "a.yaml")
    assert type(again) is type(camera)
    assert again.image_size == camera.image_size
    np.testing.assert_array_equal(again.parameters, camera.parameters)


GOOD = """\
model: pinhole
image_size: [640, 480]
focal: [600, 601.5]
center: [319.5, 239.5]
distortion: [-0.2, 0.1]
"""


def test_the_parameters_of_a_file_stand_in_their_order(tmp_path):
    (tmp_path / "a.yaml").write_text(GOOD)
    camera = load_camera(tmp_path / "a.yaml")
    assert camera.image_size == (640, 480)
    named = dict(zip(camera.parameter_names, camera.parameters.tolist(), strict=True))
    assert named == {
        "focal.x": 600, "focal.y": 601.5, "center.x": 319.5, "center.y": 239.5,
        "k1": -0.2, "k2": 0.1, "p1": 0, "p2": 0, "k3": 0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("line", "instead", "facts"),
    [
        (
            "model: pinhole",
            "model: pinhol",
            {"where": "a.yaml, line 1, model", "found": "pinhol", "expected": "pinhole"},
        ),
        (
            "model: pinhole\n",
            "",
            {
                "where": "a.yaml, model",
                "expected": "double_sphere or extended_unified or fisheye or pinhole or rational "
                "or unified",
            },
        ),
        (
            "model: pinhole",
            "model: 5",
            {"where": "a.yaml, line 1, model", "found": "5"},
        ),
        (
            "focal: [600, 601.5]",
            "focal: [600, -601.5]",
            {
                "where": "a.yaml, line 3, focal[2]",
                "found": "-601.5",
                "expected": "a number above 0",
            },
        ),
        (
            "focal: [600, 601.5]",
            "focal: [6.0, 6.0]",
            {
                "where": "a.yaml, line 3, focal",
                "found": "[6.0, 6.0]",
                "expected": "pixels, which is millimetres divided by the size of a pixel in mm",
            },
        ),
        (
            "center: [319.5, 239.5]\ndistortion: [-0.2, 0.1]",
            "center: [0, 0]\ndistortion: [-90, 0]",
            {
                "where": "a.yaml",
                "found": "image_size [640, 480], and lens numbers by which no ray of light ends "
                "there",
                "expected": "focal, center and distortion of images of this size",
            },
        ),
        (
            "center: [319.5, 239.5]\n",
            "",
            {
                "where": "a.yaml, center",
                "expected": "[cx, cy] in pixels, pixel centres at integers",
            },
        ),
        (
            "distortion: [-0.2, 0.1]",
            "distortion: [1, 2, 3, 4, 5, 6, 7, 8]",
            {"where": "a.yaml, line 5, distortion", "found": "8 entries", "expected": "at most 5"},
        ),
        (
            "[640, 480]",
            "[640.5, 480]",
            {
                "where": "a.yaml, line 2, image_size[1]",
                "found": "640.5",
                "expected": "a whole number",
            },
        ),
        (
            "[640, 480]",
            "640x480",
            {
                "where": "a.yaml, line 2, image_size",
                "found": "'640x480'",
                "expected": "a list, such as [1, 2, 3]",
            },
        ),
        (
            "[640, 480]",
            "[640]",
            {
                "where": "a.yaml, line 2, image_size",
                "found": "[640]",
                "expected": "[width, height] in pixels",
            },
        ),
        (
            "center:",
            "centre:",
            {
                "where": "a.yaml, line 4, centre",
                "found": "centre",
                "expected": "center (known here: center, covariance, distortion, focal, "
                "image_size, model)",
            },
        ),
        (
            "239.5",
            ".nan",
            {"where": "a.yaml, line 4, center[2]", "found": "nan", "expected": "a number"},
        ),
    ],
)
def test_faults_of_camera_files(tmp_path, line, instead, facts):
    assert line in GOOD
    (tmp_path / "a.yaml").write_text(GOOD.replace(line, instead, 1))
    with raises(InputError, **facts):
        load_camera(tmp_path / "a.yaml")


def test_a_changed_aspect_leaves_the_mean_focal_length(case):
    """For every model: fx / fy grows by the number, and fx fy stays, to first order."""
    camera, share = case[1], 1e-4
    other = camera.parameters + share * camera.aspect_part
    ratio = (other[0] / other[1]) / (camera.parameters[0] / camera.parameters[1])
    assert ratio - 1 == pytest.approx(share, rel=1e-3)
    assert other[0] * other[1] == pytest.approx(np.prod(camera.parameters[:2]), rel=share**2)
    np.testing.assert_array_equal(other[2:], camera.parameters[2:])
    parts = camera.violations()
    assert len({part.code for part in parts}) == len(parts)
    every = np.concatenate([part.columns for part in parts], axis=1)
    assert np.linalg.matrix_rank(every[:4] / camera.image_size[0]) == 4
