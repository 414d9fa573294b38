"""Machines with more readings than freedoms, calibrated from their readings alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from faults import raises
from page_documents import page_blocks, page_section, page_text
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.commands.cli import app
from pkmcal.errors import InputError, ResultError
from pkmcal.files import csv_text, parse_yaml, validated_document, yaml_text
from pkmcal.identify.bundle import bundle
from pkmcal.identify.start import start_state
from pkmcal.judge.watch import watch_machine
from pkmcal.levels import FALSE_ALARM
from pkmcal.measurements import EdgeSet, Measurements
from pkmcal.mechanisms import (
    MechanismDocument,
    catalogue,
    load_mechanism,
    machine_from_document,
    mechanism_text,
)
from pkmcal.placement.configurations import draw_configurations
from pkmcal.report.calibration import outcome_of, save
from pkmcal.session.load import load_session, load_session_to_plan
from pkmcal.session.readings import unmoved_readings
from pkmcal.simulation.truth import true_machine
from pkmcal.web.report_page import report_document

NOISE = 1e-3


def four_rpr():
    """The catalogue's 3-RPR with a fourth leg: four readings for three freedoms."""
    text = catalogue()["3-rpr"].read_text(encoding="utf-8")
    leg = """  - base: {joint: revolute, center: [0.10, -0.32, 0.1000]}
    platform: {joint: revolute, center: [0.06, -0.075, 0.1000]}
    length: {actuated: true, offset: 0.0, range: [0.15, 0.36]}
"""
    text = text.replace("tolerance:", leg + "tolerance:")
    return machine_from_document(
        validated_document(parse_yaml(text, Path("4-rpr.yaml")), MechanismDocument)
    )


def seven_legs():
    """A hexapod with a seventh leg in its middle."""
    text = catalogue()["gough-stewart"].read_text(encoding="utf-8")
    leg = """  - base: {joint: spherical, center: [0.02, 0.03, 0.0]}
    platform: {joint: universal, center: [0.01, -0.02, 0.0]}
    length: {actuated: true, offset: 0.0, range: [0.25, 0.45]}
"""
    text = text.replace("tolerance:", leg + "tolerance:")
    return machine_from_document(
        validated_document(parse_yaml(text, Path("7-legs.yaml")), MechanismDocument)
    )


def readings(machine, n, rng):
    """Exact readings (n, m) of poses spread over the workspace."""
    return draw_configurations(machine, n, 0.0, rng)[1][:n]


def alone(joints, noise):
    return Measurements(EdgeSet.empty(), joints, noise, 0, np.zeros(0, dtype=int))


def estimate(nominal, joints, noise):
    given = alone(joints, noise)
    return bundle(nominal, given, start_state(nominal, given, np.zeros((0, 4, 4))))


def whitened(value, truth):
    """The parameters' errors in the result's frames, along the covariance's axes, in sigmas."""
    from pkmcal.identify.gauge import default_gauge, in_gauge

    nominal = value.machine.with_values(value.machine.parameters.nominal)
    true = in_gauge(nominal, replace(value.state, theta=truth.values), default_gauge(nominal)).theta
    error, c = value.machine.values - true, value.covariance
    above_limit = np.flatnonzero(np.diag(c) > 0)
    error, c = error[above_limit], c[np.ix_(above_limit, above_limit)]
    scale = np.sqrt(np.diag(c))
    values, vectors = np.linalg.eigh(c / np.outer(scale, scale))
    keep = values > 1e-9
    return (vectors.T @ (error / scale))[keep] / np.sqrt(values[keep])


@pytest.mark.parametrize(
    ("make", "noise", "n"),
    [
        (lambda: load_mechanism("four-belt"), NOISE, 25),
        pytest.param(four_rpr, 1e-4, 40, marks=pytest.mark.slow),
        pytest.param(seven_legs, 1e-4, 40, marks=pytest.mark.slow),
    ],
    ids=["four-belt", "4-rpr", "7 legs"],
)
def test_the_truth_is_within_the_stated_deviations(make, noise, n):
    """Twelve machines with errors as large as the prior sigmas; the noise is stated three times
    too large, three times too small, and right, and is estimated.
    """
    nominal, rng = make(), np.random.default_rng(3)
    assert nominal.redundancy == nominal.n_joints - nominal.layout.own_motion.shape[1] > 0
    errors, scales = [], []
    poses = draw_configurations(nominal, n, 0.0, rng)[0][:n]
    for run in range(12):
        truth = true_machine(nominal, 1.0, rng)
        joints = truth.inverse(poses)
        joints = joints + noise * rng.standard_normal(joints.shape)
        stated = (3.0, 1 / 3, 1.0)[run % 3]
        value = estimate(nominal, joints, noise * stated)
        errors.append(whitened(value, truth))
        scales.append(value.statistics.reading_scale * stated)
        low, high = value.statistics.reading_range
        assert low < 1 / stated < high
    errors = np.array(errors)
    # the noise's own uncertainty, some five per cent, widens both a little
    assert np.mean(errors**2) == pytest.approx(1, abs=4 * np.sqrt(2 / errors.size) + 0.05)
    assert np.mean(np.abs(errors) < 1.96) == pytest.approx(0.95, abs=0.04)
    dof = value.statistics.dof_joints
    assert np.mean(scales) == pytest.approx(1, abs=4 / np.sqrt(2 * dof * len(scales)))


def test_without_a_nominal_model_worth_the_name():
    """Tolerances of half a metre: the data determine all but the frame."""
    nominal = load_mechanism("four-belt")
    document = nominal.document.model_copy(
        update={"tolerance": nominal.document.tolerance.model_copy(update={"center": 0.5})}
    )
    nominal = machine_from_document(document)
    rng = np.random.default_rng(4)
    truth = true_machine(nominal, 0.2, rng)
    joints = readings(truth, 25, rng)
    values = estimate(nominal, joints, 1e-6)
    np.testing.assert_allclose(whitened(values, truth), 0, atol=1e4)
    a = truth.base_centers()
    b = values.machine.base_centers()

    def sides(x):
        return np.linalg.norm(x[:, None] - x[None], axis=-1)

    np.testing.assert_allclose(sides(b), sides(a), atol=1e-9)


# ------------------------------------------------------------------ sessions


def write(folder, nominal, joints, noise):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal), encoding="utf-8")
    names = [f"{k:03d}" for k in range(len(joints))]
    columns = [f"leg{k + 1}" for k in range(joints.shape[1])]
    (folder / "joints.csv").write_text(csv_text(columns, names, joints), encoding="utf-8")
    document = {
        "pkmcal": 1,
        "mechanism": "mechanism.yaml",
        "joints": {"file": "joints.csv", "noise": noise},
    }
    (folder / "session.yaml").write_text(yaml_text(document), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def belts(tmp_path_factory):
    """Folder and truth of a session of 30 poses, whose noise is stated ten times too small."""
    nominal, rng = load_mechanism("four-belt"), np.random.default_rng(5)
    truth = true_machine(nominal, 1.0, rng)
    joints = readings(truth, 30, rng)
    joints = joints + NOISE * rng.standard_normal(joints.shape)
    folder = tmp_path_factory.mktemp("alone") / "belts"
    return write(folder, nominal, joints, NOISE / 10), truth


def test_a_session_of_readings_is_calibrated_from_the_command_line(belts):
    folder, truth = belts
    done = CliRunner().invoke(app, ["calibrate", str(folder)])
    assert done.exit_code == 0, done.output
    out = json.loads((folder / "calibration" / "calibration.json").read_text(encoding="utf-8"))
    assert out["verdict"]["usable"]
    assert out["stations"] == []
    assert out["statistics"]["reading_scale"] == pytest.approx(10, rel=0.25)
    low, high = out["statistics"]["reading_range"]
    assert low < 10 < high
    (rows,) = [text for text in out["verdict"]["warnings"] if "scatter" in text]
    assert "joints.noise in session.yaml states 0.1 mm" in rows
    values = {p["name"]: p for p in out["parameters"]}
    width = values["legs[2].base.center.x"]
    true = truth.base_centers()
    assert width["value"] == pytest.approx(
        np.linalg.norm(true[1] - true[0]) + values["legs[1].base.center.x"]["value"],
        abs=4 * width["sigma"],
    )
    assert values["legs[1].base.center.x"]["sigma"] == 0
    page = (folder / "calibration" / "report.html").read_text(encoding="utf-8")
    assert "4 readings of each, 2 more than the machine has freedoms" in page


def test_new_readings_decide_whether_the_machine_changed(belts, tmp_path):
    folder, truth = belts
    save(calibrate_session(folder), tmp_path / "out")
    rng = np.random.default_rng(6)
    verdicts = []
    for shift in (0.0, 0.01):
        values = truth.values.copy()
        values[truth.parameters.index("legs[3].base.center.x")] += shift
        joints = readings(truth.with_values(values), 10, rng)
        joints = joints + NOISE * rng.standard_normal(joints.shape)
        new = write(tmp_path / f"new{shift}", load_mechanism("four-belt"), joints, NOISE / 10)
        verdicts.append(watch_machine(tmp_path / "out", new).verdict.usable)
    assert verdicts == [True, False]


def test_repeats_of_a_pose_count_once(tmp_path):
    """The model's error is the same in all repeats: four of each do not halve sigma."""
    nominal, rng = load_mechanism("four-belt"), np.random.default_rng(7)
    truth = true_machine(nominal, 1.0, rng)
    joints = readings(truth, 20, rng)
    joints = joints + NOISE * rng.standard_normal(joints.shape)
    again = np.repeat(joints, 4, axis=0) + 1e-4 * rng.standard_normal((80, 4))
    session = load_session(write(tmp_path / "repeats", nominal, again, NOISE))
    assert session.configurations == tuple(f"{4 * k:03d}" for k in range(20))
    np.testing.assert_allclose(session.joints, again.reshape(20, 4, 4).mean(axis=1), atol=1e-15)
    (values,) = session.findings
    assert values.code == "readings.repeated_poses"
    assert (values.facts["number"], values.facts["poses"]) == (80, 20)
    once = calibrate_session(write(tmp_path / "once", nominal, joints, NOISE)).estimate
    calibration = calibrate_session(session).estimate
    sigma = [np.sqrt(np.trace(e.covariance)) for e in (once, calibration)]
    assert sigma[1] == pytest.approx(sigma[0], rel=0.1)


@pytest.mark.parametrize("count", [3, 20, 200])
def test_readings_that_repeat_have_moved_once_in_two_hundred(count):
    """The range of noise grows with the number of readings."""
    joints = np.random.default_rng(3).normal(0, NOISE, (count, 4000))
    assert np.mean(~unmoved_readings(joints, NOISE)) == pytest.approx(FALSE_ALARM, abs=0.0035)


def test_a_machine_without_redundancy_is_refused(tmp_path):
    nominal = load_mechanism("3-rpr")
    joints = readings(nominal, 10, np.random.default_rng(0))
    folder = write(tmp_path / "three", nominal, joints, 1e-5)
    with raises(InputError, where="session.yaml, stations", found="3 readings for 3 freedoms"):
        load_session(folder)


def test_readings_that_scatter_more_than_the_nominal_model_is_off_are_refused(tmp_path):
    """A centimetre, where an offset is drawn to five millimetres."""
    nominal, rng = load_mechanism("four-belt"), np.random.default_rng(8)
    joints = readings(nominal, 20, rng)
    joints = joints + 0.01 * rng.standard_normal(joints.shape)
    calibration = calibrate_session(write(tmp_path / "wild", nominal, joints, NOISE))
    assert not calibration.verdict.usable
    assert calibration.verdict.of("readings.noise_beyond_tolerance")


def test_what_needs_a_camera_states_so(belts):
    folder, _ = belts
    with raises(ResultError, code="method.no_edges"):
        calibrate_session(folder, method="four-step")
    with raises(InputError, code="camera.none_to_refine"):
        calibrate_session(folder, refine_camera=True)
    with pytest.raises(InputError) as caught:
        calibrate_session(folder, holdout=5)
    assert caught.value.found == "readings alone"
    with raises(InputError, code="session.no_station"):
        load_session_to_plan(folder)


def test_the_page_holds_no_section_of_cameras(belts):
    document = report_document(outcome_of(calibrate_session(belts[0]))).model_dump(mode="json")
    assert not page_blocks(document, "table", "stations")
    assert "χ² of the readings" in page_text(page_section(document, "how"))
