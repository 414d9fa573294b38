"""Images with more pixels than their lens resolves are binned, less so if the lens is sharp."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import yaml

from conftest import FEW_IMPUTATIONS
from pkmcal.boards.views import Boards
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.refinement import observation_of
from pkmcal.calibration.results import calibration_document
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.images import binned
from pkmcal.observe.legs import first_binning, measure, sharp_binning
from pkmcal.observe.profiles import PROFILE_OPTIONS
from test_observe_measure import taken
from test_observe_rendered_legs import FRONT, machine, poses

TIMES = 2


def larger():
    """Images in which each pixel is repeated 2 by 2, through a camera of that resolution."""
    small = taken()
    images = [np.kron(image, np.ones((TIMES, TIMES), np.uint8)) for image in small.images]
    parameters = small.camera.parameters.copy()
    parameters[:2] *= TIMES
    parameters[2:4] = (parameters[2:4] + 0.5) * TIMES - 0.5
    size = tuple(TIMES * n for n in small.camera.image_size)
    camera = replace(small.camera, image_size=size, parameters=parameters)
    return replace(small, camera=camera, images=images, binning=TIMES)


def test_pixels_are_averaged():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (13, 8), dtype=np.uint8)
    mean = image[:12, :6].reshape(4, 3, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(binned(image, 3), mean, atol=0.5)
    np.testing.assert_array_equal(binned(image, 1), image)


@pytest.mark.parametrize(
    ("size", "count"),
    [((640, 480), 1), ((1280, 720), 1), ((1920, 1080), 2), ((3000, 4000), 4), ((20, 10), 1)],
)
def test_the_longer_side_determines_the_number(size, count):
    assert first_binning(size) == count


def test_what_is_sharper_is_binned_less():
    """A lens of 1.6 px is as sharp as usual over two pixels; one of 0.6 px over one. Nothing is
    binned more than before but where profiles do not reach.
    """
    blur = np.arange(0.3, PROFILE_OPTIONS.blurs[-1] - 0.01, 0.05)
    for binning in (1, 2, 4):
        next_ones = [sharp_binning(binning, b) for b in blur]
        assert all(1 <= n <= binning for n in next_ones)
        assert all(one <= two for one, two in pairwise(next_ones))
    assert sharp_binning(4, 1.63 / 4) == 2
    assert sharp_binning(2, 1.63 / 2) == 2
    assert sharp_binning(2, 0.45) == 1
    assert [sharp_binning(k, PROFILE_OPTIONS.blurs[-1]) for k in (1, 2)] == [2, 4]


def test_binned_images_give_the_edges_of_small_ones():
    small, large = (measure(p, machine(), FRONT, poses()) for p in (taken(), larger()))
    assert len(small.edges) > 50
    np.testing.assert_array_equal(large.edges.leg, small.edges.leg)
    np.testing.assert_allclose(large.edges.normal, small.edges.normal, atol=1e-9)
    np.testing.assert_allclose(large.edges.covariance, small.edges.covariance, rtol=1e-6)
    np.testing.assert_allclose(large.points, (small.points + 0.5) * TIMES - 0.5, atol=1e-5)


def test_edges_move_with_the_parameters_of_the_whole_camera():
    """Derivatives by each parameter, against planes through an edge's two ends that are fixed in
    the image.
    """
    p = larger()
    station_edges = measure(p, machine(), FRONT, poses(), refine_camera=True)

    def normals(camera):
        """Normals of the planes through each edge's first and last sample (N, 3)."""
        first, last = (
            np.array(
                [
                    station_edges.points[station_edges.point_edge == k][end]
                    for k in range(len(station_edges.edges))
                ]
            )
            for end in (0, -1)
        )
        n = np.cross(camera.ray(first), camera.ray(last))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        return n * np.sign(np.sum(n * station_edges.edges.normal, axis=1, keepdims=True))

    for k, step in enumerate((1.0, 1.0, 1.0, 1.0, 1e-3)):
        both = [
            replace(p.camera, parameters=p.camera.parameters + sign * step * np.eye(9)[k])
            for sign in (1, -1)
        ]
        by = (normals(both[0]) - normals(both[1])) / (2 * step)
        in_view = np.einsum("nij,ni->nj", station_edges.edges.basis, by)
        size = np.abs(in_view).max()
        # planes are fitted to all places, weighted, and not to the ends alone
        off = np.abs(station_edges.edges.by_intrinsics[..., k] - in_view).max(axis=1)
        assert np.median(off) < 0.05 * size


@pytest.fixture
def blurred(session):
    """The demonstration's session with four times as many pixels in each image, without more
    detail.
    """
    times = 4
    for file in (session / "cameras").glob("*.yaml"):
        document = yaml.safe_load(file.read_text())
        document["image_size"] = [times * n for n in document["image_size"]]
        document["focal"] = [times * f for f in document["focal"]]
        document["center"] = [(c + 0.5) * times - 0.5 for c in document["center"]]
        document.pop("covariance", None)
        file.write_text(yaml.safe_dump(document))
    for path in (session / "images").rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), cv2.resize(image, None, fx=times, fy=times))
    return session


def away(value, other):
    """Differences of two calibrations' machines, in the deviations of one."""
    sigma = np.sqrt(np.diag(other.estimate.covariance))
    return np.abs(value.machine.values - other.machine.values)[sigma > 0] / sigma[sigma > 0]


def test_images_larger_than_sharp(blurred, calibrated):
    """Binned images give the machine of the sharp small images, to the scatter of other images.

    Without binning their edges are blurred over three pixels, and hardly one is found.
    """
    calibration = calibrate_session(blurred, options=FEW_IMPUTATIONS)
    np.testing.assert_array_equal(calibration.observation.binning, 2)
    assert calibration.verdict.usable
    assert np.sqrt(np.mean(away(calibration, calibrated) ** 2)) < np.sqrt(2)
    # results about cameras are in pixels of the images
    document = calibration_document(calibration)
    assert [station["binning"] for station in document["stations"]] == [2, 2, 2]
    shift = document["cameras"][0]["edge_shift"]
    assert shift == pytest.approx(2 * calibration.estimate.state.columns[EDGE_SHIFT][0])


def test_stations_of_one_camera_are_binned_alike(calibrated):
    """A leg without images, too: the camera's edge shift is in binned pixels."""
    c = calibrated
    taken = [StationImages(0, c.session.stations[0].camera, *[np.zeros(0, int)] * 2, [], binning=2)]
    count = observation_of(c.session, [], Boards(), c.measurements, c.estimate, taken)
    assert len({station.camera_file for station in c.session.stations}) == 1
    np.testing.assert_array_equal(count.binning, 2)


@pytest.mark.parametrize("spread", [1.6, pytest.param(2.4, marks=pytest.mark.slow)])
def test_images_out_of_focus(session, calibrated, spread):
    """Profiles do not explain edges blurred over so much; of half the pixels they do. What is lost
    is stated.
    """
    for path in (session / "images").rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), cv2.GaussianBlur(image, (0, 0), spread))
    calibration = calibrate_session(session, options=FEW_IMPUTATIONS)
    np.testing.assert_array_equal(calibration.observation.binning, 2)
    assert calibration.verdict.usable
    sigma, sharp = (c.estimate.covariance.diagonal() ** 0.5 for c in (calibration, calibrated))
    assert np.median(sigma[sharp > 0] / sharp[sharp > 0]) > 1.5
    assert away(calibrated, calibration).max() < 3


@pytest.mark.slow
def test_sharp_images_end_unbinned(session, calibrated, monkeypatch):
    """Measured at first with half the resolution; the last measurement passes use all pixels."""
    width = calibrated.session.stations[0].camera.image_size[0]
    monkeypatch.setattr(legs, "USUAL_PICTURE_LENGTH", width // 2)
    calibration = calibrate_session(session)
    np.testing.assert_array_equal(calibration.observation.binning, 1)
    # further measurement passes find some edges a tenth of a pixel beside, as elsewhere
    assert away(calibration, calibrated).max() < 1
