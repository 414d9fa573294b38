"""Nominal models that cannot be a machine's: one sentence each, with the place in the file."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from conftest import run
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


def sentence(path):
    with pytest.raises(InputError) as caught:
        load_mechanism(path)
    return str(caught.value)


FAULTS = {
    "a revolute joint without an axis": (
        "3-rps",
        [(", axis: [-1, 0, 0]", "")],
        "m.yaml, line 4, legs[1].base: leg 1 has a revolute joint without an axis; expected axis: "
        "[x, y, z] in the base frame, the direction that it turns about.",
    ),
    "a spherical joint with one": (
        "3-rps",
        [("[0.0000, 0.1800, 0.0000]", "[0.0000, 0.1800, 0.0000], axis: [0, 0, 1]")],
        "m.yaml, line 5, legs[1].platform.axis: leg 1 has a spherical joint with an axis; expected "
        "no axis, or joint: universal or revolute.",
    ),
    "an axis of length zero": (
        "3-rps",
        [("axis: [-1, 0, 0]", "axis: [0, 0, 0]")],
        "m.yaml, line 4, legs[1].base.axis: an axis of length zero is no direction; write one such "
        "as [0, 0, 1].",
    ),
    "an axis of two numbers": (
        "3-rps",
        [("axis: [-1, 0, 0]", "axis: [-1, 0]")],
        "m.yaml, line 4, legs[1].base.axis: this has too few entries; found [-1, 0], expected 3 "
        "entries.",
    ),
    "a planar machine's axis out of the normal": (
        "3-rpr",
        [("0.3200, 0.1000]", "0.3200, 0.1000], axis: [0, 0.75, 1]")],
        "m.yaml, line 4, legs[1].base.axis: leg 1 of a planar machine turns about an axis that is "
        "not the plane's; found [0, 0.6, 0.8], expected [0, 0, 1]: a planar machine moves in the "
        "base frame's x-y plane.",
    ),
    "a planar machine's leg out of its plane": (
        "3-rpr",
        [("0.3200, 0.1000]", "0.3200, 0.1010]")],
        "m.yaml, line 5, legs[1].platform.center: leg 1 of a planar machine leaves its plane; "
        "found its platform joint -1 mm above its base joint, expected the same height (z) "
        "for both ends of a leg, at the home pose. Draw the leg in its plane, or write motion: "
        "spatial.",
    ),
    "a later leg out of its plane": (
        "3-rpr",
        [("0.0208, -0.0978, 0.1000]", "0.0208, -0.0978, 0.1030]")],
        "m.yaml, line 9, legs[2].platform.center: leg 2 of a planar machine leaves its plane; "
        "found its platform joint +3 mm above its base joint, expected the same height (z) for "
        "both ends of a leg, at the home pose. Draw the leg in its plane, or write motion: "
        "spatial.",
    ),
    "a planar machine's home out of the plane": (
        "3-rpr",
        [("legs:", "home: {position: [0, 0, 0.002]}\nlegs:")],
        "m.yaml, line 6, legs[1].platform.center: leg 1 of a planar machine leaves its plane; "
        "found its platform joint +2 mm above its base joint, expected the same height (z) for "
        "both ends of a leg, at the home pose. Draw the leg in its plane, or write motion: "
        "spatial.",
    ),
    "a planar machine's home turned": (
        "3-rpr",
        [("legs:", "home: {position: [0, 0, 0], rotation_vector: [0.01, 0, 0]}\nlegs:")],
        "m.yaml, line 3, home.rotation_vector: the home pose of a planar machine is turned out of "
        "its plane; expected [0, 0, angle].",
    ),
    "axes that would turn a translating platform": (
        "3-upu",
        [("motion: spatial", "motion: translation"), ("axis: [-1, 0, 0]", "axis: [-1, 0.01, 0]")],
        "m.yaml, line 5, legs[1].platform.axis: the universal joints of leg 1 have axes that are "
        "not parallel, so they would turn the platform; expected the axis of its base joint. Write "
        "motion: spatial, and the turn will be computed.",
    ),
    "a passive leg that is needed": (
        "gough-stewart",
        [(ROD, PASSIVE)],
        "m.yaml, line 3, legs: the legs do not hold the platform: 5 equations for 6 freedoms; leg "
        "1, passive, holds nothing; expected one equation a leg with a length, one a revolute "
        "joint, one a pair of universal joints with axes; 6 for motion: spatial. Add legs or axes, "
        "or correct motion. Only a session in which a tracker measured every pose of the platform "
        "does without.",
    ),
    "two of them": (
        "gough-stewart",
        [(ROD, PASSIVE), (ROD, PASSIVE)],
        "m.yaml, line 3, legs: the legs do not hold the platform: 4 equations for 6 freedoms; legs "
        "1 and 2, passive, hold nothing; expected one equation a leg with a length, one a revolute "
        "joint, one a pair of universal joints with axes; 6 for motion: spatial. Add legs or axes, "
        "or correct motion. Only a session in which a tracker measured every pose of the platform "
        "does without.",
    ),
    "a universal axis left out": (
        "3-upu",
        [("0.0000], axis: [-1, 0, 0]", "0.0000]")],
        "m.yaml, line 3, legs: the legs do not hold the platform: 5 equations for 6 freedoms; "
        "expected one equation a leg with a length, one a revolute joint, one a pair of universal "
        "joints with axes; 6 for motion: spatial. Add legs or axes, or correct motion. Only a "
        "session in which a tracker measured every pose of the platform "
        "does without.",
    ),
    "half an axis held": (
        "3-upu",
        [("legs:", 'fixed: ["legs[1].base.axis.x"]\nlegs:')],
        "m.yaml, line 3, fixed[1]: "
        "legs[1].base.axis.x cannot be held alone: an axis is one direction; expected the "
        "whole axis, 'legs[1].base.axis'.",
    ),
    "half an axis tied": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].base.axis.x", "legs[1].platform.axis.x"]]\nlegs:')],
        "m.yaml, line 3, tied[1][1]: "
        "legs[1].base.axis.x cannot be held alone: an axis is one direction; expected the "
        "whole axis, 'legs[1].base.axis'.",
    ),
    "axes that differ tied": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].base.axis", "legs[2].base.axis"]]\nlegs:')],
        "m.yaml, line 3, tied[1][1]: axes that differ in the nominal model are tied; found"
        " legs[1].base.axis, legs[2].base.axis, expected whole axes with the same direction in"
        " their bodies' frames.",
    ),
    "an axis tied to a number": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].base.axis", "legs[1].length.offset"]]\nlegs:')],
        "m.yaml, line 3, tied[1][1]: "
        "a whole centre or axis is tied to a single number; found legs[1].base.axis, "
        "legs[1].length.offset, expected entries of one kind, each once.",
    ),
    "a centre tied to an axis": (
        "3-upu",
        [("legs:", 'tied: [["legs[2].base.center", "legs[1].base.axis"]]\nlegs:')],
        "m.yaml, line 3, tied[1][1]: "
        "an axis is tied to a centre; found legs[2].base.center, legs[1].base.axis, "
        "expected entries of one kind, each once.",
    ),
    "a number tied to its opposite": (
        "3-upu",
        [("legs:", 'tied: [["legs[1].length.offset", "-legs[1].length.offset"]]\nlegs:')],
        "m.yaml, line 3, tied[1][1]: "
        "a parameter is tied to itself; found legs[1].length.offset, "
        "-legs[1].length.offset, expected entries of one kind, each once.",
    ),
    "an axis that is no parameter": (
        "gough-stewart",
        [("legs:", 'fixed: ["legs[1].base.axis"]\nlegs:')],
        "m.yaml, line 3, fixed[1]: "
        "there is no parameter 'legs[1].base.axis'; expected a name such as "
        "'legs[1].base.center.x'. Write the parameter as its path in the mechanism file, legs "
        "from 1.",
    ),
    "a passive leg with a range": (
        "6-spu-passive",
        [("{passive: true}", "{passive: true, range: [0.3, 0.5]}")],
        "m.yaml, line 30, legs[7].length.range: this key is not known; found range.",
    ),
    "an offset of a leg that has none": (
        "6-spu-passive",
        [("legs:", 'fixed: ["legs[7].length.offset"]\nlegs:')],
        "m.yaml, line 3, fixed[1]: "
        "there is no parameter 'legs[7].length.offset'; expected a name such as "
        "'legs[6].length.offset'. Write the parameter as its path in the mechanism file, legs "
        "from 1.",
    ),
    "a strut shorter than nothing": (
        "constant-legs",
        [("constant: 0.415", "constant: -0.415")],
        "m.yaml, line 14, legs[3].length.constant: this value cannot be used; found -0.415, "
        "expected a number above 0.",
    ),
}


@pytest.mark.parametrize(("name", "changes", "message"), FAULTS.values(), ids=FAULTS)
def test_faults_of_nominal_models(tmp_path, name, changes, message):
    assert sentence(drawn(tmp_path, name, *changes)) == message


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
    values = run("simulate", tmp_path / "session", "--mechanism", nominal)
    assert values.code == 2
    assert UNASSEMBLED in " ".join(values.err.split())
    assert not (tmp_path / "session").exists()


def test_simulate_refuses_a_home_far_from_any_configuration(tmp_path):
    nominal = drawn(
        tmp_path, "constant-legs", ("legs:", "home: {position: [0, 0, 5]}\nlegs:"), *SHORT
    )
    values = run("simulate", tmp_path / "session", "--mechanism", nominal, "--json")
    assert (values.code, values.json["code"]) == (2, "mechanism.few_configurations")


@pytest.fixture(scope="module")
def small_session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawings") / "session"
    words = ("--mechanism", "constant-legs", "--stations", "1", "--configurations", "3")
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
