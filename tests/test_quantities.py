"""Lengths and angles with a unit: read as the numbers in SI that they are, or refused in words."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from faults import raises
from pkmcal.errors import InputError
from pkmcal.files import Metres, Radians, Reading, Share, read_csv, written_unit
from pkmcal.files.quantities import in_joint_units
from pkmcal.mechanisms import catalogue, load_mechanism, mechanism_text

INCH = 0.0254


@settings(deadline=None)  # the first one reads the table of units
@given(st.decimals(-1000, 1000, places=4), st.sampled_from(["", " ", "  "]))
def test_millimetres_are_metres_to_the_last_digit(number, blank):
    plain = TypeAdapter(float).validate_json(f"{number:f}e-3")
    assert TypeAdapter(Metres).validate_python(f"{number:f}{blank}mm", strict=True) == plain


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (Metres, "2 in", 2 * INCH),
        (Metres, "-3.5um", -3.5e-6),
        (Metres, "3.5 µm", 3.5e-6),
        (Metres, ".5 m", 0.5),
        (Radians, "30 deg", math.pi / 6),
        (Radians, "-30°", -math.pi / 6),
        (Radians, "1e1 mrad", 0.01),
        (Share, "0.1 %", 0.001),
        (Reading, "0.01 mm", 1e-5),
        (Reading, "1 arcmin", math.pi / 180 / 60),
    ],
)
def test_units_that_people_write(kind, text, value):
    assert TypeAdapter(kind).validate_python(text, strict=True) == pytest.approx(value, rel=1e-15)
    assert written_unit(text) is not None


def test_units_of_a_machines_joints():
    for value, units, number in (
        (3e-6, ("rad",), 3e-6), ("3 um", ("m", "m"), 3e-6),
        ("0.18 deg", ("m", "rad"), math.pi / 1000),
    ):  # fmt: skip
        assert in_joint_units(value, "m or rad", units, "x") == pytest.approx(number, rel=1e-15)
    assert in_joint_units("60 rpm", "m/s or rad/s", ["rad"], "x") == pytest.approx(2 * math.pi)
    for value, units in (("3 um", ["rad"]), ("1 deg", ["m"]), ("a", ["m"]), ("3e-6", ["m"])):
        with raises(InputError, code="option.unit", where="x", found=value):
            in_joint_units(value, "m or rad", units, "x")


def scaled(node, where, path=()):
    """A mechanism's content with its lengths in mm and its angles in degrees, as texts."""
    if isinstance(node, dict):
        return {key: scaled(item, where, (*path, key)) for key, item in node.items()}
    if isinstance(node, list):
        return [scaled(item, where, path) for item in node]
    if isinstance(node, bool) or not isinstance(node, int | float):
        return node
    unit = where(path)
    return {"m": f"{node * 1000!r} mm", "rad": f"{math.degrees(node)!r} deg", "": node}[unit]


def unit_of(path, rod_range):
    """The unit of a number in a mechanism file by its keys, as docs/files.md has them."""
    last = path[-1]
    if last in ("axis", "zero", "motor", "bar", "scale") and path[0] != "tolerance":
        return ""
    if last in ("angle", "rotation_vector") or (path[0] == "tolerance" and last == "axis"):
        return "rad"
    if last == "range" and "length" not in path:
        return rod_range
    return "" if last == "scale" else "m"


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_a_machine_in_millimetres_and_degrees_is_the_same_machine(name, tmp_path):
    plain = load_mechanism(name)
    content = yaml.safe_load(mechanism_text(plain))
    slides = any(leg["base"]["joint"] == "slider" for leg in content["legs"])
    path = tmp_path / f"{name}.yaml"
    path.write_text(yaml.safe_dump(scaled(content, lambda p: unit_of(p, "m" if slides else "rad"))))
    again = load_mechanism(path)
    assert again.parameters.names == plain.parameters.names
    np.testing.assert_allclose(again.values, plain.values, rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(again.joint_ranges, plain.joint_ranges, rtol=1e-14, atol=1e-16)
    np.testing.assert_allclose(
        again.parameters.tolerance, plain.parameters.tolerance, rtol=1e-14, atol=1e-16
    )


@pytest.mark.parametrize(
    ("written", "facts"),
    [
        (
            "3 kg",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 kg'",
                "expected": "metres, or a number with its unit, such as 269.3 mm",
            },
        ),
        (
            "3 deg",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 deg'",
                "expected": "metres, or a number with its unit, such as 269.3 mm",
            },
        ),
        (
            "3 dB",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 dB'",
                "expected": "metres, or a number with its unit, such as 269.3 mm",
            },
        ),
        (
            "3 px",  # of a screen, for the library of units
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 px'",
                "expected": "metres, or a number with its unit, such as 269.3 mm",
            },
        ),
        (
            "3 mm/s",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 mm/s'",
                "expected": "metres, or a number with its unit, such as 269.3 mm",
            },
        ),
        (
            "3 mmm",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 mmm'",
                "expected": "metres, or a number with its unit, such as 269.3 mm",
            },
        ),
        (
            "3 mm mm",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'3 mm mm'",
                "expected": "a number",
            },
        ),
        (
            "1e99999 mm",
            {
                "where": "m.yaml, line 16, legs[1].tubes[1].radius",
                "found": "'1e99999 mm'",
                "expected": "a number",
            },
        ),
    ],
)
def test_what_is_no_length_is_reported_with_its_line(tmp_path, written, facts):
    text = mechanism_text(load_mechanism("gough-stewart"))
    (tmp_path / "m.yaml").write_text(re.sub(r"radius: [\d.]+", f"radius: {written}", text, count=1))
    with raises(InputError, **facts):
        load_mechanism(tmp_path / "m.yaml")


def test_a_nominal_model_in_millimetres_without_a_unit_is_reported(tmp_path):
    content = yaml.safe_load(mechanism_text(load_mechanism("gough-stewart")))
    only = {"m": "m"}
    text = yaml.safe_dump(scaled(content, lambda path: only.get(unit_of(path, "m"), "")))
    path = tmp_path / "m.yaml"
    path.write_text(text.replace(" mm", ""))
    with pytest.raises(InputError) as caught:
        load_mechanism(path)
    assert caught.value.code == "mechanism.units"
    assert caught.value.found.startswith("legs[")
    assert "Write each length with its unit, such as 269.3 mm" in caught.value.next_step
    path.write_text(text.replace(" mm", " m"))  # a machine of some hundred metres, in so many words
    assert np.abs(load_mechanism(path).values).max() > 100


def test_a_tables_heads_name_their_units(tmp_path):
    path = tmp_path / "joints.csv"
    path.write_text("configuration,leg1 [mm],leg2(deg),leg 3 [m],q [counts]\na,269.3,30,1,7\n")
    table = read_csv(path)
    assert table.columns == ("leg1", "leg2", "leg 3", "q [counts]")
    np.testing.assert_allclose(table.values, [[0.2693, math.pi / 6, 1, 7]], rtol=1e-15)
    where = "joints.csv, line 1, column leg2"
    found, expected = "an angle, such as deg", "a length, such as mm"
    with raises(InputError, where=where, found=found, expected=expected):
        table.check_kinds(["m", "m", "m", ""])
    path.write_text("configuration,leg1 [mm],leg1 [m]\na,1,1\n")
    with raises(InputError, code="table.column_twice", where="joints.csv, line 1") as caught:
        read_csv(path)
    assert "leg1" in caught.value.what
