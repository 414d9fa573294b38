"""A reading's scale: from the file through kinematics and estimates to words and files."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from export_sources import built, source_of, with_scales
from faults import raises
from pkmcal.calibration.faults import scale_notes
from pkmcal.calibration.machine_identity import _check_machine
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.exporters.contract import exporters
from pkmcal.judge.causes import single_causes
from pkmcal.mechanisms import catalogue, load_mechanism, machine_from_document, mechanism_text
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.mechanisms.kinematics import inverse_result, on_manifold
from test_nominal_model_checks import ROD, drawn

NAMES = sorted(catalogue())


def scales(machine):
    return machine.values[machine.parameters.of_kind("scale")]


def scaled(name):
    """Machine with nominal errors whose readings' scales are off by thousandths, each motor its
    own.
    """
    machine = built(name, share=1.0)
    values, table = machine.values.copy(), machine.parameters
    for leg, column in enumerate(machine.layout.actuated):
        if column >= 0:
            values[table.index(f"legs[{leg + 1}].scale")] = 1 + 2e-3 * (column + 1)
    return machine.with_values(values)


# The file


def test_readings_in_metres_have_a_scale_and_turns_are_exact():
    for name, count in (("gough-stewart", 6), ("linear-delta", 3), ("h4", 0), ("6-rus", 0)):
        table = load_mechanism(name).parameters
        assert table.tolerance[table.of_kind("scale")].tolist() == [0.0005] * count
    names = load_mechanism("gough-stewart").parameters.names
    assert names[6:8] == ("legs[1].length.offset", "legs[1].scale")


@pytest.mark.parametrize(("name", "tolerance", "count"), [("gough-stewart", 0, 0), ("h4", 1e-4, 4)])
def test_the_file_states_how_sure_scales_are(tmp_path, name, tolerance, count):
    machine = load_mechanism(
        drawn(tmp_path, name, ("tolerance: {", f"tolerance: {{scale: {tolerance}, "))
    )
    table = machine.parameters
    assert table.tolerance[table.of_kind("scale")].tolist() == [tolerance] * count


def test_a_scale_that_is_exact_still_counts(tmp_path):
    """tolerance 0: the scale is no parameter, and readings are scaled by it."""
    rod = f"{ROD}\n    scale: 1.002"
    changes = [(ROD, rod), ("tolerance: {", "tolerance: {scale: 0, ")]
    machine, plain = load_mechanism(drawn(tmp_path, "gough-stewart", *changes)), load_mechanism(
        "gough-stewart"
    )  # fmt: skip
    assert len(machine.parameters) == len(plain.parameters) - 6
    T = machine.home()[None]
    expected = plain.inverse(T)
    expected[:, 0] /= 1.002
    np.testing.assert_allclose(machine.inverse(T), expected, atol=1e-15)
    (tmp_path / "again.yaml").write_text(mechanism_text(machine))
    np.testing.assert_allclose(load_mechanism(tmp_path / "again.yaml").inverse(T), expected)


def test_legs_on_one_motor_have_one_scale():
    machine = with_scales(load_mechanism("h4-rods"), 1e-3)
    tied = [group for group in machine.parameters.tied if group[0].endswith(".scale")]
    assert [len(group) for group in tied] == [2] * 4


FAULTS = {
    "of no reading": (
        "constant-legs",
        [("length: {actuated: false", "scale: 1.001\n    length: {actuated: false")],
        (
            "line 14, legs[3].scale",
            "1.001",
            "scale on legs whose length, crank or slider a motor moves",
        ),
    ),
    "no ratio": (
        "gough-stewart",
        [(ROD, f"{ROD}\n    scale: 1000")],
        ("line 7, legs[1].scale", "1000", "a number below 2"),
    ),
    "a tolerance below zero": (
        "gough-stewart",
        [("tolerance: {", "tolerance: {scale: -1e-3, ")],
        ("line 28, tolerance.scale", "-0.001", "a number of 0 or more"),
    ),
    "two on a motor": (
        "h4-rods",
        [("length: {actuated: false", "scale: 1.001\n    length: {actuated: false")],
        ("line 8, legs[2].scale", "1.0", "1.001"),
    ),
}  # fmt: skip
"""Machine, changes of its file, and where the fault is, what is found and expected there."""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_scale_that_cannot_be_is_named(tmp_path, fault):
    name, changes, (where, found, expected) = FAULTS[fault]
    path = drawn(tmp_path, name, *changes)
    with raises(InputError, where=f"m.yaml, {where}", found=found, expected=expected):
        load_mechanism(path)


# Kinematics


@pytest.mark.parametrize("name", NAMES)
def test_readings_are_what_motors_move_over_the_scale(name):
    """The same machine without scales, at readings times the scales, has the same poses."""
    machine = scaled(name)
    table = machine.parameters
    values = machine.values.copy()
    values[table.of_kind("scale")] = 1.0
    plain = machine.with_values(values)
    poses = on_manifold(machine.layout, machine.values, machine.home()[None]).T_base_platform
    by_motor = 1 + 2e-3 * np.arange(1, machine.n_joints + 1)
    np.testing.assert_allclose(
        by_motor * machine.inverse(poses), plain.inverse(poses), rtol=1e-12, atol=1e-13
    )
    readings = machine.inverse(poses)
    np.testing.assert_allclose(machine.forward(readings, poses[0]), poses, atol=1e-10)
    rates = machine.inverse_jacobian(poses)
    np.testing.assert_allclose(by_motor[:, None] * rates, plain.inverse_jacobian(poses), atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_by_scales_and_readings(name):
    machine = scaled(name)
    layout, theta = machine.layout, machine.values
    T = on_manifold(layout, theta, machine.home()[None]).T_base_platform
    q, phi = inverse_result(layout, theta, T)
    c, h = closure(layout, theta, q, T, phi), 1e-6
    count = dense(c, len(theta))
    for k in machine.parameters.of_kind("scale"):
        step = h * np.eye(len(theta))[k]
        up, down = (closure(layout, theta + s * step, q, T, phi).rows.value for s in (1, -1))
        np.testing.assert_allclose(count[..., k], (up - down) / (2 * h), atol=1e-8)
    for m, step in enumerate(h * np.eye(machine.n_joints)):
        up, down = (closure(layout, theta, q + s * step, T, phi).rows.value for s in (1, -1))
        by = c.by_reading * layout.of_motor[:, m]
        np.testing.assert_allclose(by, (up - down) / (2 * h), atol=1e-8)


# Exports


@pytest.mark.parametrize(
    ("name", "to", "words"),
    [
        ("linear-delta", "klipper", "Multiply its rotation_distance by that."),
        ("delta", "klipper", "Divide its gear_ratio by that."),
        ("linear-delta", "marlin", "Divide its steps per mm (M92) by that."),
        ("linear-delta", "smoothie", "Divide its steps per mm (M92) by that."),
        ("linear-delta", "reprap", "Divide its steps per mm (M92) by that."),
        ("delta", "reprap", "Divide its steps per degree (M92) by that."),
        (
            "linear-delta",
            "linuxcnc",
            "Divide its SCALE in the INI file, steps or counts per unit,",
        ),
    ],
)
def test_a_firmware_without_scales_gets_the_settings_to_change(name, to, words):
    machine = built(name, seed=4)
    if to == "linuxcnc":  # whose own module a machine gets that is off in nothing but its scales
        off, machine = machine, with_scales(load_mechanism(name), 1e-3)
        own = np.array([entry.endswith(".scale") for entry in machine.parameters.names])
        machine = machine.with_values(np.where(own, off.values, machine.values))
    text = " ".join("".join(exporters()[to].files(source_of(machine)).values()).split())
    assert words in text
    factors = [f"{s:.9g}" for s in scales(machine)]
    assert all(f"goes {factor} times as far as its reading." in text for factor in factors)
    exact = with_scales(load_mechanism(name), 0.0)
    assert words not in "".join(exporters()[to].files(source_of(exact)).values())


# Words, and files of earlier versions


def test_scales_that_surely_differ_are_reported_once(demo):
    machine = load_mechanism("gough-stewart")
    table = machine.parameters
    rows = table.of_kind("scale")
    values, sigma = machine.values.copy(), np.zeros(len(table))
    values[rows[:3]] += [4e-4, -3e-4, 2e-4]
    sigma[rows] = [1e-4, 9e-5, 1e-4, 1e-4, 1e-4, 1e-4]
    estimate = SimpleNamespace(machine=machine.with_values(values), covariance=np.diag(sigma**2))
    columns = [f"leg{j}" for j in range(1, 7)]
    session = SimpleNamespace(machine=machine, document={"joints": {"columns": columns}})
    (names,) = scale_notes(session, estimate, ())
    assert (names.code, names.facts["columns"]) == ("readings.scale_estimates", ["leg1", "leg2"])
    assert names.facts["values"] == pytest.approx((4e-4, -3e-4), rel=1e-3)
    assert "0.040 ± 0.010 % larger (leg1) and 0.030 ± 0.009 % smaller (leg2)." in names.text
    (other,) = scale_notes(session, estimate, ("leg1",))
    assert other.facts["columns"] == ["leg2"]


def test_a_changed_lead_is_a_cause_of_its_own():
    leads = [c for c in single_causes(load_mechanism("gough-stewart")) if c.part == "lead"]
    assert [c.legs for c in leads] == [(j,) for j in range(6)]
    assert all(c.unit == "" and c.sizes.tolist() == [0.0005] for c in leads)


def test_a_calibration_from_before_scales_has_exact_ones(demo, tmp_path):
    folder = tmp_path / "old"
    shutil.copytree(demo.calibration, folder)
    path = folder / "calibration.json"
    data = json.loads(path.read_text())
    keep = [k for k, p in enumerate(data["parameters"]) if not p["name"].endswith(".scale")]
    n = len(data["parameters"])
    assert len(keep) == n - 6
    data["parameters"] = [data["parameters"][k] for k in keep]
    data["covariance"] = [[data["covariance"][i][k] for k in keep] for i in keep]
    reference_values = data["station_covariance"]
    own = [*keep, *range(n, n + len(reference_values["rows"]))]
    reference_values["rows"] = [[row[k] for k in own] for row in reference_values["rows"]]
    for leg in data["mechanism"]["legs"]:
        del leg["scale"]
    path.write_text(json.dumps(data))
    saved = load(folder)
    assert not any(name.endswith(".scale") for name in saved.machine.parameters.names)
    assert (saved.machine.layout.exact_scale == 1).all()
    assert not saved.machine.layout.unsure_scales.any()
    # a session's present nominal model is still that machine's, and another's is not
    now = load_mechanism("gough-stewart")
    _check_machine(saved, SimpleNamespace(machine=now))
    other = now.with_values(now.values + 0.1)
    table = replace(now.parameters, nominal=other.values)
    with raises(InputError, code="calibration.another_machine"):
        _check_machine(saved, SimpleNamespace(machine=replace(other, parameters=table)))
    again = machine_from_document(now.document)
    assert again.parameters.names == now.parameters.names
