"""Joint centres by radius, angle and height in a mechanism file."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.errors import InputError
from pkmcal.mechanisms import load_mechanism, mechanism_text

ANGLES = np.array([15, 105, 135, 225, 255, 345])
PLATFORM_ANGLES = np.array([45, 75, 165, 195, 285, 315])
LEG = """\
  - base: {{joint: spherical, center: {base}}}
    platform: {{joint: spherical, center: {{radius: 12 cm, angle: {angle} deg}}}}
    length: {{actuated: true, range: [200 mm, 400 mm]}}
"""
SLIDER = """\
  - base: {{joint: slider, center: {center}, axis: [0, 0, 1], range: [200 mm, 500 mm]}}
    platform: {{joint: spherical, center: {{radius: 35 mm, angle: {angle} deg}}}}
    length: {{actuated: false, constant: 270 mm}}
"""
TOWERS = [90, 210, 330]
HEXAPOD = "name: hexapod\nmotion: spatial\nlegs:\n"


def load(folder, first=None):
    """Hexapod with polar centres; first : the base centre of leg 1 in their place."""
    legs = [
        LEG.format(base=f"{{radius: 300 mm, angle: {a} deg, z: -5 mm}}", angle=b)
        for a, b in zip(ANGLES, PLATFORM_ANGLES, strict=True)
    ]
    if first is not None:
        legs[0] = LEG.format(base=first, angle=PLATFORM_ANGLES[0])
    (folder / "mechanism.yaml").write_text(HEXAPOD + "".join(legs))
    return load_mechanism(folder / "mechanism.yaml")


def circle(radius, angles, z):
    a = np.deg2rad(angles)
    return np.column_stack([radius * np.cos(a), radius * np.sin(a), np.full(a.size, z)])


def test_centres_are_on_their_circles(tmp_path):
    machine = load(tmp_path)
    np.testing.assert_allclose(machine.base_centers(), circle(0.3, ANGLES, -0.005), atol=1e-15)
    expected = circle(0.12, PLATFORM_ANGLES, 0.0)
    np.testing.assert_allclose(machine.platform_centers(), expected, atol=1e-15)
    # what is written has x, y and z
    (tmp_path / "again.yaml").write_text(mechanism_text(machine))
    again = load_mechanism(tmp_path / "again.yaml")
    np.testing.assert_array_equal(again.base_centers(), machine.base_centers())


def test_carriages_have_polar_centres(tmp_path):
    legs = "".join(
        SLIDER.format(center=f"{{radius: 140 mm, angle: {a} deg}}", angle=a) for a in TOWERS
    )
    text = f"name: towers\nmotion: translation\nlegs:\n{legs}home: {{position: [0, 0, 100 mm]}}\n"
    (tmp_path / "mechanism.yaml").write_text(text)
    document = load_mechanism(tmp_path / "mechanism.yaml").document
    centers = [leg.base.center for leg in document.legs]
    np.testing.assert_allclose(centers, circle(0.14, TOWERS, 0.0), atol=1e-15)


@pytest.mark.parametrize(
    ("centre", "field", "value"),
    [
        ("{radius: 300 mm, angle: 15}", "angle", None),  # degrees without their unit
        ("{radius: 300 mm, angle: 400 deg}", "angle", None),
        ("{radius: 300 mm}", "angle", None),
        ("{radius: -300 mm, angle: 0}", "radius", "-300 mm"),
        ("{radius: 300 mm, angle: 0, x: 1}", "x", "x"),
        ("{radius: 300 mm, angle: 15 mm}", "angle", None),
    ],
)
def test_faults_are_named_by_field_in_the_files_units(centre, field, value, tmp_path):
    with pytest.raises(InputError) as error:
        load(tmp_path, centre)
    assert error.value.where.endswith(f"legs[1].base.center.{field}")
    assert value is None or value in str(error.value.found)
