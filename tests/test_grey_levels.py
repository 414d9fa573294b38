"""Grey levels between pixels: those of the whole image, though only a part of it is used."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from pkmcal.cameras.response import light_in
from pkmcal.observe.grey_levels import POINTS_IN_ONE_ROW, levels_at

IMAGE = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)


def places(x, y, count=60):
    rng = np.random.default_rng(1)
    return tuple(rng.uniform(*ends, (5, count)) for ends in (x, y))


@pytest.mark.parametrize("blur", [0.0, 1.0])
@pytest.mark.parametrize(("x", "y"), [((20, 30), (15, 19)), ((1, 62), (1, 46)), ((50, 62), (2, 9))])
def test_levels_are_those_of_the_whole_image(x, y, blur):
    """Bilinear, after OpenCV's Gaussian of 9 x 9, which differs from SciPy's by hundredths."""
    x, y = places(x, y)
    whole = IMAGE.astype(float)
    if blur:
        whole = gaussian_filter(whole, blur, mode="mirror", truncate=4.0)
    values = levels_at(IMAGE, x, y, blur=blur)
    assert values.dtype == np.float32
    # OpenCV 4 rounds places to a 32nd of a pixel
    np.testing.assert_allclose(
        values, map_coordinates(whole, [y, x], order=1), atol=8 if not blur else 3
    )


def test_light_is_that_of_the_whole_images_levels():
    x, y = places((20, 30), (15, 19))
    value = levels_at(IMAGE, x, y, cubic=True, response="srgb")
    whole = levels_at(light_in(IMAGE, "srgb"), x, y, cubic=True)
    np.testing.assert_array_equal(value, whole)
    assert not np.allclose(value, levels_at(IMAGE, x, y, cubic=True), atol=5)


def test_outside_stands_the_border_and_what_is_no_number_does_not_harm():
    x = np.array([[-5.0, 900.0, 3.0, np.nan, 3.0]])
    y = np.array([[-9.0, 4.0, 70.0, 2.0, np.inf]])
    results = levels_at(IMAGE, x, y)
    assert results[0, :3].tolist() == [IMAGE[0, 0], IMAGE[4, 63], IMAGE[47, 3]]
    assert np.isfinite(results).all()


def test_of_no_places_there_are_no_levels():
    assert levels_at(IMAGE, np.zeros((0, 31)), np.zeros((0, 31)), blur=1.0).shape == (0, 31)


@pytest.mark.parametrize("shape", [(7,), (POINTS_IN_ONE_ROW + 3,), (3, 5, POINTS_IN_ONE_ROW // 3)])
def test_any_number_of_places_may_be_looked_up(shape):
    """In one row, or in rows that they do not fill."""
    rng = np.random.default_rng(2)
    x, y = (rng.integers(0, size, shape) for size in IMAGE.shape[::-1])
    np.testing.assert_array_equal(levels_at(IMAGE, x, y), IMAGE[y, x])
