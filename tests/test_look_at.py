"""The rough pose that a session gives by hand."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pkmcal.errors import InputError
from pkmcal.geometry.rigid import look_at

coordinate = st.floats(-10, 10)
point = st.tuples(coordinate, coordinate, coordinate)


@settings(deadline=None)
@given(point, point, point)
def test_look_at_gives_a_rotation_that_sees_the_target_upright(position, target, up):
    eye, middle, above = map(np.array, (position, target, up))
    view = middle - eye
    assume(np.linalg.norm(view) > 1e-5)
    assume(np.linalg.norm(above) > 1e-5)
    cosine = view @ above / np.linalg.norm(view) / np.linalg.norm(above)
    assume(abs(cosine) < np.cos(np.deg2rad(2)))
    T_camera_base = look_at(position, target, up)
    rotation = T_camera_base[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(T_camera_base[3], [0, 0, 0, 1])
    np.testing.assert_allclose((T_camera_base @ [*eye, 1])[:3], 0, atol=1e-12 * 100)
    in_view = (T_camera_base @ [*middle, 1])[:3]
    np.testing.assert_allclose(in_view, [0, 0, np.linalg.norm(view)], atol=1e-9)
    # y points down, and up has no part across the image's vertical.
    assert rotation[1] @ above < 0
    assert abs(rotation[0] @ above) < 1e-9 * np.linalg.norm(above)


def test_just_under_a_degree_is_refused_and_two_are_not():
    def turned(degrees):
        return (np.sin(np.deg2rad(degrees)), 0.0, np.cos(np.deg2rad(degrees)))

    look_at((0, 0, 0), (0, 0, 1), turned(2.0))
    for degrees in (0.9, 179.1):
        with pytest.raises(InputError) as caught:
            look_at((0, 0, 0), (0, 0, 1), turned(degrees))
        assert caught.value.found.startswith("up [")
        assert "0.9 degrees" in caught.value.found
