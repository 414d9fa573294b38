"""Mechanism files, the catalogue, carriers and the parameter table."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.files import parse_yaml, validated_document
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import (
    MechanismDocument,
    catalogue,
    load_mechanism,
    machine_from_document,
    mechanism_text,
)
from pkmcal.mechanisms.carriers.contract import base_carriers, by_pose, platform_carriers
from pkmcal.mechanisms.document import MOTION_DIRECTIONS, ActuatedLength, ConstantLength


@pytest.fixture(params=sorted(catalogue()), scope="module")
def machine(request):
    return load_mechanism(request.param)


def read(text):
    return machine_from_document(
        validated_document(parse_yaml(text, Path("m.yaml")), MechanismDocument)
    )


# The catalogue


def test_catalogue_machines_carry_their_files_name(machine):
    assert machine.name in catalogue()
    assert load_mechanism(catalogue()[machine.name]).name == machine.name


def test_catalogue_machines_can_be_assembled(machine):
    """Home closes at readings in range, far from a singular pose."""
    home = machine.home()
    readings = machine.inverse(home)
    fk = machine.forward_result(readings)
    assert fk.converged
    assert fk.singularity > 0.1
    np.testing.assert_allclose(fk.T_base_platform, home, atol=1e-11)
    low, high = machine.joint_ranges.T
    assert not ((readings < low) | (readings > high)).any()


def test_catalogue_tubes_are_as_long_as_the_legs(machine):
    """A leg whose edges are measured exists over the whole range of its length."""
    for leg in machine.document.legs:
        for tube in leg.tubes:
            assert tube.radius < 0.1
            if isinstance(leg.length, ActuatedLength) and leg.length.range:
                assert tube.start < leg.length.range[0]
            if isinstance(leg.length, ConstantLength):
                assert tube.start < leg.length.constant


# Files there and back


def test_a_written_mechanism_is_the_same(machine, tmp_path):
    text = mechanism_text(machine)
    (tmp_path / "m.yaml").write_text(text)
    again = load_mechanism(tmp_path / "m.yaml")
    assert again.document == machine.document
    assert again.parameters.names == machine.parameters.names
    np.testing.assert_array_equal(again.values, machine.values)
    assert mechanism_text(again) == text


def test_calibrated_values_come_back_to_the_last_bit(machine, tmp_path):
    rng = np.random.default_rng(0)
    changed = machine.with_values(built(machine, 1e-3 * rng.normal(size=len(machine.values)) ** 2))
    (tmp_path / "m.yaml").write_text(mechanism_text(changed))
    again = load_mechanism(tmp_path / "m.yaml")
    np.testing.assert_array_equal(again.values, changed.values)
    np.testing.assert_array_equal(machine.values, machine.parameters.nominal)


def built(machine, steps):
    """Values (P,) of a machine that can be: ties kept, axes of length one."""
    table = machine.parameters
    free = table.free_matrix()
    return table.unit_axes(table.nominal + free @ (free.T @ steps))


def at_path(document, name):
    """Value of a file's fields at a parameter's name, by the rule of docs/files.md."""
    node = document
    for key, number in re.findall(r"([a-z]+)|\[(\d+)\]", name):
        if number:
            node = node[int(number) - 1]
        elif isinstance(node, list):
            node = node["xyz".index(key)]
        else:
            node = node[key]
    return node


def test_parameter_names_are_paths_in_the_file(machine):
    """Each value is at its own place: every parameter gets another value."""
    unlike = machine.parameters.unit_axes(
        machine.values + 1e-3 * np.arange(1, len(machine.values) + 1)
    )
    names = machine.parameters.names
    assert len(set(names)) == len(names)
    for values in (machine.values, unlike):
        document = machine.with_values(values).to_document()
        assert [at_path(document, name) for name in names] == values.tolist()


def test_every_number_of_the_nominal_model_is_a_parameter():
    """A hexapod's file holds 6 (3 + 3 + 1) kinematic numbers, a scale and two radii a leg."""
    machine = load_mechanism("gough-stewart")
    table = machine.parameters
    assert len(table) == 6 * (3 + 3 + 1 + 1 + 2)
    kinds = ("center", "offset", "radius", "scale")
    assert [len(table.of_kind(kind)) for kind in kinds] == [36, 6, 12, 6]
    assert [table.units[k] for k in table.of_kind("scale")] == [""] * 6
    assert set(table.units) == {"m", ""}
    assert table.names[:3] == tuple(f"legs[1].base.center.{axis}" for axis in "xyz")
    tolerances = [table.tolerance[table.of_kind(k)].tolist() for k in kinds]
    assert tolerances == [[0.002] * 36, [0.002] * 6, [0.0001] * 12, [0.0005] * 6]


# A small machine with everything in it

SMALL = """\
name: small
motion: planar
legs:
  - base: {joint: spherical, center: [0.0, 0.1, 0.2]}
    platform: {joint: universal, center: [0.3, 0.4, 0.5]}
    length: {actuated: true, offset: 0.05, range: [0.2, 0.6]}
    tubes: [{radius: 0.01, from: 0.02, to: 0.2}, {radius: 0.008, from: 0.2, to: 0.4}]
  - base: {joint: universal, center: [1.0, 1.1, 1.2]}
    platform: {joint: spherical, center: [1.3, 1.4, 1.5]}
    length: {actuated: false, constant: 0.7}
  - base: {joint: universal, center: [2.0, 2.1, 2.2]}
    platform: {joint: spherical, center: [2.3, 2.4, 2.5]}
    length: {actuated: true}
    tubes: [{radius: 0.006, from: 0.0, to: 0.1}]
"""


def test_properties_of_a_machine():
    machine = read(SMALL)
    assert (machine.n_legs, machine.n_joints) == (3, 2)
    np.testing.assert_array_equal(
        machine.base_centers(), [[0, 0.1, 0.2], [1, 1.1, 1.2], [2, 2.1, 2.2]]
    )
    np.testing.assert_array_equal(
        machine.platform_centers(), [[0.3, 0.4, 0.5], [1.3, 1.4, 1.5], [2.3, 2.4, 2.5]]
    )
    assert [r.tolist() for r in machine.radii()] == [[0.01, 0.008], [], [0.006]]
    # a range is of the leg's length, a reading is without the offset
    np.testing.assert_allclose(machine.joint_ranges, [[0.15, 0.55], [np.nan, np.nan]])
    assert [n for n in machine.parameters.names if "length" in n] == [
        "legs[1].length.offset",
        "legs[2].length.constant",
        "legs[3].length.offset",
    ]


def test_a_missing_tolerance_has_its_documented_value():
    table = read(SMALL).parameters
    assert dict(zip(table.kinds, table.tolerance.tolist(), strict=True)) == {
        "center": 0.002,
        "offset": 0.002,
        "radius": 0.0001,
        "scale": 0.0005,
    }


# Fixed and tied parameters

NAMES = ("legs[1].length.offset", "legs[3].length.offset", "legs[2].length.constant")


def roles(fixed=(), tied=()):
    return read(SMALL).parameters.with_roles(fixed, tied)


def together(matrix, table):
    """Which of NAMES move with which, as the free matrix has it; None where held."""
    rows = matrix[[table.index(name) for name in NAMES]]
    return [int(np.argmax(row)) if row.any() else None for row in rows]


def test_without_roles_every_parameter_is_free():
    table = roles()
    np.testing.assert_array_equal(table.free_matrix(), np.eye(len(table)))


def test_fixed_parameters_have_no_column():
    table = roles(fixed=NAMES[:2])
    matrix = table.free_matrix()
    assert matrix.shape == (len(table), len(table) - 2)
    assert not matrix[[table.index(n) for n in NAMES[:2]]].any()
    np.testing.assert_array_equal(matrix.sum(axis=0), 1)


def test_tied_parameters_change_by_the_same_amount():
    table = roles(tied=(NAMES[:2],))
    matrix = table.free_matrix()
    assert matrix.shape == (len(table), len(table) - 1)
    values = table.nominal + matrix @ np.arange(1.0, matrix.shape[1] + 1)
    shifted = values - table.nominal
    a, b, c = (shifted[table.index(name)] for name in NAMES)
    assert a == pytest.approx(b)
    assert a != pytest.approx(c)
    assert np.linalg.matrix_rank(matrix) == matrix.shape[1]


@pytest.mark.parametrize(
    "tied",
    [
        (NAMES,),
        ((NAMES[0], NAMES[1]), (NAMES[1], NAMES[2])),
        ((NAMES[1], NAMES[2]), (NAMES[0], NAMES[1])),
        ((NAMES[2], NAMES[0]), (NAMES[1], NAMES[2])),
    ],
)
def test_ties_that_share_a_name_are_one_tie(tied):
    table = roles(tied=tied)
    matrix = table.free_matrix()
    assert matrix.shape[1] == len(table) - 2
    assert len(set(together(matrix, table))) == 1


def test_a_tie_to_a_fixed_parameter_is_fixed():
    table = roles(fixed=NAMES[1:2], tied=(NAMES[:2],))
    first, second, third = together(table.free_matrix(), table)
    assert first is second is None
    assert third is not None


def test_roles_in_a_file():
    text = SMALL + f"fixed: ['{NAMES[2]}']\ntied: [['{NAMES[0]}', '{NAMES[1]}']]\n"
    table = read(text).parameters
    first, second, third = together(table.free_matrix(), table)
    assert first == second
    assert third is None


def test_an_unknown_name_is_reported_with_the_nearest():
    found, expected = "'legs[1].length.ofset'", "a name such as 'legs[1].length.offset'"
    with raises(InputError, found=found, expected=expected):
        roles(fixed=("legs[1].length.ofset",))


# Carriers: one conformance test for every kind

CARRIERS = sorted(
    {("base", c) for c in base_carriers().values()}
    | {("platform", c) for c in platform_carriers().values()},
    key=lambda pair: (pair[0], pair[1].__name__),
)


@pytest.mark.parametrize(("side", "carrier"), CARRIERS)
def test_carriers_have_exact_derivatives(side, carrier):
    """Sixth-order differences with steps of 1e-3: 1e-13 by rounding of lengths about a metre."""
    rng = np.random.default_rng(0)
    parameters = rng.normal(size=(5, len(carrier.parameters)))
    motion = rng.normal(size=(4, 1)) if side == "base" else perturb(np.eye(4), rng.normal(size=6))
    by_parameters = carrier.by_parameters(parameters, motion)
    shifted = np.broadcast_to(carrier.place(parameters, motion)[1], by_parameters.shape[:-1])

    def differences(of, step=1e-3):
        weights = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
        return sum(w * (of(i * step)[0] - of(-i * step)[0]) for i, w in weights) / step

    for k, by in enumerate(np.eye(parameters.shape[1])):
        oracle = differences(lambda d, by=by: carrier.place(parameters + d * by, motion))
        np.testing.assert_allclose(by_parameters[..., k] - oracle, 0.0, atol=1e-11)
    if side == "base":
        oracle = differences(lambda d: carrier.place(parameters, motion + d))
        np.testing.assert_allclose(shifted - oracle, 0.0, atol=1e-11)
        return
    for k, by in enumerate(np.eye(6)):
        oracle = differences(lambda d, by=by: carrier.place(parameters, perturb(motion, d * by)))
        np.testing.assert_allclose(by_pose(shifted)[..., k], oracle, atol=1e-11)


@pytest.mark.parametrize(("side", "carrier"), CARRIERS)
def test_carriers_broadcast(side, carrier):
    """Legs last, configurations and machines before them; a batch equals its members."""
    rng = np.random.default_rng(1)
    parameters = rng.normal(size=(2, 1, 3, len(carrier.parameters)))
    tail = () if side == "base" else (4, 4)
    motion = (
        rng.normal(size=(4, 3))
        if side == "base"
        else np.stack([perturb(np.eye(4), d) for d in rng.normal(size=(4, 6))])[:, None]
    )

    def report(parameters, motion):
        return (*carrier.place(parameters, motion), carrier.by_parameters(parameters, motion))

    batch = report(parameters, motion)
    spread = np.broadcast_to(motion, (4, 3, *tail))
    for r, k, leg in np.ndindex(2, 4, 3):
        one = report(parameters[r, 0, leg], np.asarray(spread[k, leg]))
        for got, single in zip(batch, one, strict=True):
            full = np.broadcast_to(got, (2, 4, 3, *got.shape[3:]))
            np.testing.assert_allclose(full[r, k, leg], single, atol=1e-15)


# Faults of files


@pytest.mark.parametrize(
    ("text", "instead", "facts"),
    [
        (
            "from: 0.02, to: 0.2}",
            "from: 0.02, to: 0.01}",
            {
                "where": "m.yaml, line 7, legs[1].tubes[1]",
                "found": "from 0.02 to 0.01",
                "expected": "'to' greater than 'from'",
            },
        ),
        (
            "radius: 0.008",
            "radius: -0.008",
            {
                "where": "m.yaml, line 7, legs[1].tubes[2].radius",
                "found": "-0.008",
                "expected": "a number above 0",
            },
        ),
        (
            "[0.2, 0.6]",
            "[0.6, 0.2]",
            {
                "where": "m.yaml, line 6, legs[1].length.range",
                "found": "[0.6, 0.2]",
                "expected": "two increasing positive lengths [min, max]",
            },
        ),
        (
            "motion: planar\n",
            "motion: planar\nmotion: spatial\n",
            {"where": "m.yaml, line 3, motion", "code": "file.key_twice"},
        ),
        (
            "name: small\nmotion: planar",
            "nam: small\nmotoin: planar",
            {
                "where": "m.yaml, line 1, nam",
                "found": "nam",
                "expected": "name (known here: fixed, growth, height_offset, home, legs, load, "
                "models, motion, name, steps_per_mm, tied, tolerance, "
                "workspace_radius)",
                "next_step": "Then look at line 2, motoin",
            },
        ),
        (
            "[0.0, 0.1, 0.2]",
            "[0.0, .nan, 0.2]",
            {
                "where": "m.yaml, line 4, legs[1].base.center[2]",
                "found": "nan",
                "expected": "a number",
            },
        ),
        (
            "[0.0, 0.1, 0.2]",
            "[0.0, 0.1]",
            {
                "where": "m.yaml, line 4, legs[1].base.center",
                "found": "[0.0, 0.1]",
                "expected": "3 entries",
            },
        ),
        (
            "constant: 0.7",
            "constant: 0",
            {
                "where": "m.yaml, line 10, legs[2].length.constant",
                "found": "0",
                "expected": "a number above 0",
            },
        ),
        (
            "actuated: true, offset",
            "actuated: false, offset",
            {
                "where": "m.yaml, line 6, legs[1].length.constant",
                "expected": "the rod's length in metres",
                "next_step": "Then look at line 6, legs[1].length.offset and line 6, "
                "legs[1].length.range",
            },
        ),
        (
            "motion: planar",
            "motion: planar\ntied: [['legs[1].length.offset']]",
            {
                "where": "m.yaml, line 3, tied[1]",
                "found": "['legs[1].length.offset']",
                "expected": "at least 2",
            },
        ),
        (
            "motion: planar",
            "motion: planar\nfixed: ['legs[3].base.centre.z']",
            {
                "where": "m.yaml, line 3, fixed[1]",
                "found": "'legs[3].base.centre.z'",
                "expected": "a name such as 'legs[3].base.center.z'",
            },
        ),
        (
            "motion: planar",
            'motion: planar\nfixed: ["\\x85"]',
            {
                "where": "m.yaml, line 3, fixed[1]",
                "found": "'\\x85'",
                "expected": "a name such as 'legs[1].base.center.x'",
            },
        ),
        (
            "name: small\n",
            "name: small\ntolerance: {center: 0.0}\n",
            {
                "where": "m.yaml, line 2, tolerance.center",
                "found": "0.0",
                "expected": "a number of 1e-12 or more",
            },
        ),
    ],
)
def test_faults_of_mechanism_files(tmp_path, text, instead, facts):
    assert text in SMALL
    (tmp_path / "m.yaml").write_text(SMALL.replace(text, instead, 1))
    with raises(InputError, **facts):
        load_mechanism(tmp_path / "m.yaml")


def refused(source):
    with pytest.raises(InputError) as caught:
        load_mechanism(source)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "instead", "place", "expected"),
    [
        ("joint: spherical", "joint: ball", "m.yaml, line 4, legs[1].base", base_carriers()),
        (
            "joint: universal",
            "joint: ball",
            "m.yaml, line 5, legs[1].platform",
            platform_carriers(),
        ),
        ("motion: planar", "motion: flat", "m.yaml, line 2, motion", MOTION_DIRECTIONS),
    ],
)
def test_kinds_that_are_not_known_are_reported_with_those_that_are(
    tmp_path, text, instead, place, expected
):
    (tmp_path / "m.yaml").write_text(SMALL.replace(text, instead, 1))
    message = refused(tmp_path / "m.yaml")
    assert message.startswith(place)
    assert instead.split()[-1] in message
    assert all(name in message for name in expected)


def test_a_machine_has_two_legs_and_one_that_is_driven(tmp_path):
    top, *legs = SMALL.split("  - ")
    for few, facts in (
        (legs[:1], {"found": "1", "expected": "two or more"}),
        ([legs[1]] * 2, {"found": "none of 2 legs", "expected": "a leg with actuated: true"}),
    ):
        (tmp_path / "m.yaml").write_text("  - ".join([top, *few]))
        with raises(InputError, where="m.yaml, line 3, legs", **facts):
            load_mechanism(tmp_path / "m.yaml")


def test_sources_that_are_not_there(tmp_path):
    assert refused("gough-stuart") == (
        "no built-in machine and no file has this name; found gough-stuart, expected gough-stewart."
    )
    message = refused("nothing like it")
    assert all(name in message for name in catalogue())
    (tmp_path / "machine.yaml").write_text(SMALL)
    assert refused(tmp_path / "machin.yaml") == (
        f"machin.yaml: the file does not exist; expected a file {tmp_path / 'machin.yaml'} "
        "(there is machine.yaml)."
    )
