"""Nominal models that cannot be a machine's: one sentence each, with the place in the file."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from conftest import run
from faults import raises
from pkmcal.errors import InputError
from pkmcal.mechanisms import catalogue, load_mechanism

ROD = "length: {actuated: true, offset: 0.0, range: [0.345, 0.485]}"
PASSIVE = "length: {passive: true}"


def drawn(folder, name, *changes):
    """A catalogue machine's file without comments, parts of its text replaced, each once."""
    lines = catalogue()[name].read_text().splitlines(keepends=True)
    text = "".join(line for line in lines if not line.startswith("#"))
    for before, after in changes:
        assert before in text
        text = text.replace(before, after, 1)
    path = folder / "m.yaml"
    path.write_text(text)
    return path


FAULTS = {
    "a revolute joint without an axis": (
        "3-rps",
        [(", axis: [-1, 0, 0]", "")],
        {
            "where": "m.yaml, line 4, legs[1].base",
            "expected": "axis: [x, y, z] in the base frame, the direction that it turns about",
        },
    ),
    "a spherical joint with one": (
        "3-rps",
        [("[0.0000, 0.1800, 0.0000]", "[0.0000, 0.1800, 0.0000], axis: [0, 0, 1]")],
        {
            "where": "m.yaml, line 5, legs[1].platform.axis",
            "expected": "no axis, or joint: universal or revolute",
        },
    ),
    "an axis of length zero": (
        "3-rps",
        [("axis: [-1, 0, 0]", "axis: [0, 0, 0]")],
        {
            "where": "m.yaml, line 4, legs[1].base.axis",
            "found": "[0.0, 0.0, 0.0]",
            "expected": "one such as [0, 0, 1]",
        },
    ),
    "an axis of two numbers": (
        "3-rps",
        [("axis: [-1, 0, 0]", "axis: [-1, 0]")],
        {"where": "m.yaml, line 4, legs[1].base.axis", "found": "[-1, 0]", "expected": "3 entries"},
    ),
    "a planar machine's axis out of the normal": (
        "3-rpr",
        [("0.3200, 0.1000]", "0.3200, 0.1000], axis: [0, 0.75, 1]")],
        {
            "where": "m.yaml, line 4, legs[1].base.axis",
            "found": "[0, 0.6, 0.8]",
            "expected": "[0, 0, 1]: a planar machine moves in the base frame's x-y plane",
        },
    ),
    "a planar machine's leg out of its plane": (
        "3-rpr",
        [("0.3200, 0.1000]", "0.3200, 0.1010]")],
        {
            "where": "m.yaml, line 5, legs[1].platform.center",
            "found": "its platform joint -1 mm above its base joint",
            "expected": "the same height (z) for both ends of a leg, at the home pose",
        },
    ),
    "a later leg out of its plane": (
        "3-rpr",
        [("0.0208, -0.0978, 0.1000]", "0.0208, -0.0978, 0.1030]")],
        {
            "where": "m.yaml, line 9, legs[2].platform.center",
            "found": "its platform joint +3 mm above its base joint",
            "expected": "the same height (z) for both ends of a leg, at the home pose",
        },
    ),
    "a planar machine's home out of the plane": (
        "3-rpr",
        [("legs:", "home: {position: [0, 0, 0.002]}\nlegs:")],
        {
            "where": "m.yaml, line 6, legs[1].platform.center",
            "found": "its platform joint +2 mm above its base joint",
            "expected": "the same height (z) for both ends of a leg, at the home pose",
        },
    ),
    "a planar machine's home turned": (
        "3-rpr",
        [("legs:", "home: {position: [0, 0, 0], rotation_vector: [0.01, 0, 0]}\nlegs:")],
        {"where": "m.yaml, line 3, home.rotation_vector", "expected": "[0, 0, angle]"},
    ),
    "axes that would turn a translating platform": (
        "3-upu",
        [("motion: spatial", "motion: translation"), ("axis: [-1, 0, 0]", "axis: [-1, 0.01, 0]")],
        {
            "where": "m.yaml, line 5, legs[1].platform.axis",
            "expected": "the axis of its base joint",
        },
    ),
    "a passive leg that is needed": (
        "gough-stewart",
        [(ROD, PASSIVE)],
        {
            "code": "mechanism.not_held",
            "where": "m.yaml, line 3, legs",
            "found": "5 equations for 6 freedoms; passive leg 1 holds nothing",
            "expected": "one equation a leg with a length, one a revolute joint, one a pair of "
            "universal joints with axes; 6 for motion: spatial",
        },
    ),
    "two of them": (
        "gough-stewart",
        [(ROD, PASSIVE), (ROD, PASSIVE)],
        {
            "code": "mechanism.not_held",
            "where": "m.yaml, line 3, legs",
            "found": "4 equations for 6 freedoms; passive legs 1 and 2 hold nothing",
            "expected": "one equation a leg with a length, one a revolute joint, one a pair of "
            "universal joints with axes; 6 for motion: spatial",
        },
    ),
    "a universal axis left out": (
        "3-upu",
        [("0.0000], axis: [-1, 0, 0]", "0.0000]")],
        {
            "code": "mechanism.not_held",
            "where": "m.yaml, line 3, legs",
            "found": "5 equations for 6 freedoms",
            "expected": "one equation a leg with a length, one a revolute joint, one a pair of "
            "universal joints with axes; 6 for motion: spatial",
        },
    ),
    "half an axis held": (
        "3-upu",
        [("legs:", 'fixed: ["legs[1].base.axis.x"]\nlegs:')],
        {"where": "m.yaml, line 3, fixed[1]", "expected": "the whole axis, 'legs[1].base.axis'"},
    ),
    "half an axis tied": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].base.axis.x", "legs[1].platform.axis.x"]]\nlegs:')],
        {"where": "m.yaml, line 3, tied[1][1]", "expected": "the whole axis, 'legs[1].base.axis'"},
    ),
    "axes that differ tied": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].base.axis", "legs[2].base.axis"]]\nlegs:')],
        {
            "where": "m.yaml, line 3, tied[1][1]",
            "found": "legs[1].base.axis, legs[2].base.axis",
            "expected": "whole axes with the same direction in their bodies' frames",
        },
    ),
    "an axis tied to a number": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].base.axis", "legs[1].length.offset"]]\nlegs:')],
        {
            "where": "m.yaml, line 3, tied[1][1]",
            "found": "legs[1].base.axis, legs[1].length.offset",
            "expected": "entries of one kind, each once",
        },
    ),
    "a centre tied to an axis": (
        "3-upu",
        [("legs:", 'tied: [["legs[2].base.center", "legs[1].base.axis"]]\nlegs:')],
        {
            "where": "m.yaml, line 3, tied[1][1]",
            "found": "legs[2].base.center, legs[1].base.axis",
            "expected": "entries of one kind, each once",
        },
    ),
    "a number tied to its opposite": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].length.offset", "-legs[1].length.offset"]]\nlegs:')],
        {
            "where": "m.yaml, line 3, tied[1][1]",
            "found": "legs[1].length.offset, -legs[1].length.offset",
            "expected": "entries of one kind, each once",
        },
    ),
    "an axis that is no parameter": (
        "gough-stewart",
        [("legs:", 'fixed: ["legs[1].base.axis"]\nlegs:')],
        {
            "where": "m.yaml, line 3, fixed[1]",
            "found": "'legs[1].base.axis'",
            "expected": "a name such as 'legs[1].base.center.x'",
        },
    ),
    "a passive leg with a range": (
        "6-spu-passive",
        [("{passive: true}", "{passive: true, range: [0.3, 0.5]}")],
        {"where": "m.yaml, line 30, legs[7].length.range", "found": "range"},
    ),
    "an offset of a leg that has none": (
        "6-spu-passive",
        [("legs:", 'fixed: ["legs[7].length.offset"]\nlegs:')],
        {
            "where": "m.yaml, line 3, fixed[1]",
            "found": "'legs[7].length.offset'",
            "expected": "a name such as 'legs[6].length.offset'",
        },
    ),
    "a strut shorter than nothing": (
        "constant-legs",
        [("constant: 0.415", "constant: -0.415")],
        {
            "where": "m.yaml, line 14, legs[3].length.constant",
            "found": "-0.415",
            "expected": "a number above 0",
        },
    ),
}


@pytest.mark.parametrize(("name", "changes", "facts"), FAULTS.values(), ids=FAULTS)
def test_faults_of_nominal_models(tmp_path, name, changes, facts):
    with raises(InputError, **facts):
        load_mechanism(drawn(tmp_path, name, *changes))


def test_whole_axes_may_be_held_or_tied(tmp_path):
    """An axis is two unknowns: held they go, tied in one leg they are common."""
    free = load_mechanism("3-upu").parameters.free_matrix().shape[1]
    roles = [
        ('fixed: ["legs[1].base.axis"]', 2),
        ('fixed: ["legs[1].base.axis", "legs[2].base.center"]', 5),
        ('tied: [["legs[1].base.axis", "legs[1].platform.axis"]]', 2),
    ]
    for role, fewer in roles:
        table = load_mechanism(drawn(tmp_path, "3-upu", ("legs:", f"{role}\nlegs:"))).parameters
        assert table.free_matrix().shape[1] == free - fewer


def test_an_axis_of_any_length_is_a_direction(tmp_path):
    path = drawn(tmp_path, "3-rps", ("axis: [-1, 0, 0]", "axis: [-1.0e+200, 0, 0]"))
    values = load_mechanism(path)
    np.testing.assert_array_equal(values.base_axes()[0], [-1, 0, 0])


# nominal models that pass these checks and still cannot be assembled

SHORT = [("constant: 0.415", "constant: 0.1")] * 2
UNASSEMBLED = (
    "mechanism 'constant-legs' cannot be assembled with its legs at mid-range; found closure "
    "error 125 mm, expected a platform that all legs reach. Check the nominal model's centres and "
    "ranges, or give home: {position: ...}."
)


def test_simulate_refuses_a_nominal_model_that_cannot_be_assembled(tmp_path):
    nominal = drawn(tmp_path, "constant-legs", *SHORT)
    values = run("simulate", tmp_path / "session", "--machine", nominal)
    assert values.code == 2
    assert UNASSEMBLED in " ".join(values.err.split())
    assert not (tmp_path / "session").exists()


def test_simulate_refuses_a_home_far_from_any_configuration(tmp_path):
    nominal = drawn(
        tmp_path, "constant-legs", ("legs:", "home: {position: [0, 0, 5]}\nlegs:"), *SHORT
    )
    values = run("simulate", tmp_path / "session", "--machine", nominal, "--json")
    assert (values.code, values.json["code"]) == (2, "mechanism.few_configurations")


@pytest.fixture(scope="module")
def small_session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawings") / "session"
    words = ("--machine", "constant-legs", "--stations", "1", "--configurations", "3")
    assert run("simulate", folder, *words, "--size", "200x150").code == 0
    return folder


@pytest.mark.parametrize("command", ["check", "calibrate"])
def test_sessions_with_such_a_nominal_model_are_refused(small_session, tmp_path, command):
    session = tmp_path / "session"
    shutil.copytree(small_session, session)
    drawn(tmp_path, "constant-legs", *SHORT).replace(session / "mechanism.yaml")
    values = run(command, session, "--json")
    assert values.code == 2
    assert f"mechanism.yaml: {UNASSEMBLED}" in values.out + values.err
