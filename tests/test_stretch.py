"""Legs that stretch under measured forces: the correction, its estimate, and what names it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

import pkmcal
from export_sources import source_of
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.files import csv_text, yaml_text
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.disturbances import compliance, sag
from pkmcal.session.load import load_session
from pkmcal.simulation import load_truth
from test_cables import around_home, cables
from test_pose_sessions import make, write_joints

RIGIDITY = 2e4
TENSION = 60.0


def elastic(folder, kind="pulley", rigidity=RIGIDITY, machine=None, **more):
    """A mechanism file of a robot with eight cables, of an axial rigidity unless it is None."""
    fields = (machine or cables(folder, kind)).to_document()
    for leg in fields["legs"]:
        leg |= more if rigidity is None else {"axial_rigidity": rigidity, **more}
    path = folder / "elastic.yaml"
    path.write_text(yaml_text(fields), encoding="utf-8")
    return path


def stretched(folder, rigidity, stated, seed=0, n=30, logged=True):
    """A tracked session of elastic cables whose tensions are known; its file states ``stated``."""
    folder.mkdir()
    made = make(folder / "session", elastic(folder, rigidity=stated), n=n, seed=seed)
    tension = TENSION * np.random.default_rng([seed, 1]).uniform(0.5, 1.5, made.joints.shape)
    readings = made.joints
    if rigidity is not None:
        machine = made.machine
        at = closure(machine.layout, machine.values, made.joints, made.T)
        readings = made.joints - tension * at.rows.distance / rigidity
    write_joints(made.folder, readings)
    if logged:
        log_forces(made.folder, readings, tension)
    return made.folder


def log_forces(folder, readings, forces, unit=" [N]"):
    """joints.csv with the forces behind the readings."""
    motors = [f"motor{k + 1}" for k in range(readings.shape[1])]
    heads = (*motors, *(f"{motor} tension{unit}" for motor in motors))
    names = [f"{k:03d}" for k in range(len(readings))]
    (folder / "joints.csv").write_text(csv_text(heads, names, np.hstack([readings, forces])))


@pytest.mark.parametrize("kind", ["pulley", "spool", "spool over pulley"])
def test_a_cable_is_a_spring_of_its_length(kind, tmp_path):
    """Against the reading at which the unstretched cable would be paid out, by root search."""
    machine = load_mechanism(elastic(tmp_path, kind))
    layout, theta = machine.layout, machine.values
    for T in around_home(3):
        q = machine.inverse(T[None])[0]
        at = closure(layout, theta, q, T)
        slope, distance = -at.by_reading, at.rows.distance  # of the lengths by the readings
        yields = sag(machine, T[None], TENSION * slope[None])[0]
        for leg in range(machine.n_joints):

            def unstretched(x, leg=leg, q=q, T=T, stretch=distance[leg] * TENSION / RIGIDITY):
                moved = np.where(np.arange(len(q)) == leg, x, q)
                return closure(layout, theta, moved, T).rows.value[leg] - stretch

            reach = 5 * abs(yields[leg])
            reading = brentq(unstretched, q[leg] - reach, q[leg] + reach, xtol=1e-13)
            assert q[leg] - reading == pytest.approx(yields[leg], rel=0.01)


def test_a_drive_and_its_cable_are_in_series(tmp_path):
    poses = around_home(4)
    alone = compliance(load_mechanism(elastic(tmp_path)), poses)
    drive = compliance(load_mechanism(elastic(tmp_path, rigidity=None, stiffness=5e5)), poses)
    both = compliance(load_mechanism(elastic(tmp_path, stiffness=5e5)), poses)
    np.testing.assert_allclose(drive, 2e-6)
    np.testing.assert_allclose(both, alone + 2e-6)


def test_the_rigidity_is_estimated(tmp_path):
    """From a file that states it a third too large; the result's machine has it."""
    folder = stretched(tmp_path / "right", RIGIDITY, RIGIDITY / 0.75)
    result = calibrate_session(folder)
    assert result.verdict.usable
    assert not result.violations
    (one,) = result.verdict.of("machine.compliance")
    facts = one.facts
    assert facts["by"] == "forces"
    assert facts["value"] == pytest.approx(1 / 0.75, abs=3 * facts["sigma"])
    assert facts["sigma"] < 0.1 < facts["prior"]
    leg = result.machine.document.legs[0]
    assert leg.axial_rigidity == pytest.approx(RIGIDITY / 0.75 / facts["value"])


def test_forces_without_a_rigidity_are_tested(tmp_path):
    rigidity = 10 * RIGIDITY  # 1 mm; without 11 mm in the model the search may fail
    result = calibrate_session(stretched(tmp_path / "soft", rigidity, None))
    (one,) = result.violations
    assert one.code == "machine.sag"
    facts = one.finding.facts
    assert (facts["by"], facts["mass"]) == ("forces", None)
    assert facts["value"] == pytest.approx(3.6 / rigidity, rel=0.2)  # a cable is some 3.6 m long


def test_stiff_cables_are_not_named(tmp_path):
    result = calibrate_session(stretched(tmp_path / "stiff", None, None))
    assert result.verdict.usable
    assert not result.violations


def test_forces_of_the_other_sign_are_refused(tmp_path):
    result = calibrate_session(stretched(tmp_path / "wrong", -RIGIDITY, RIGIDITY))
    assert not result.verdict.usable
    (one,) = result.verdict.of("machine.compliance_negative")
    assert one.facts["by"] == "forces"


def test_a_rigidity_without_forces_is_a_warning(tmp_path):
    folder = stretched(tmp_path / "bare", RIGIDITY, RIGIDITY, logged=False)
    codes = {one.code for one in load_session(folder).findings}
    assert "readings.forces_unknown" in codes


@pytest.mark.parametrize(
    ("change", "code", "found"),
    [
        (lambda text: text.replace("motor8 t", "motor9 t"), "readings.forces", "motor9"),
        (lambda text: text.replace("[N]", "[N m]"), "readings.force_unit", "N m"),
        (lambda text: text.replace("[N]", "[kN]"), "readings.forces", "m at home"),
    ],
)  # fmt: skip
def test_wrong_forces_are_refused(change, code, found, tmp_path):
    folder = stretched(tmp_path / "wrong", RIGIDITY, RIGIDITY)
    path = folder / "joints.csv"
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError) as error:
        load_session(folder)
    assert error.value.code == code
    assert error.value.where.startswith("joints.csv, line ")
    assert found in error.value.found


def test_simulated_cables_stretch(tmp_path):
    settings = {"stations": 1, "configurations": 4, "camera": (64, 48), "seed": 2}
    stiff = pkmcal.simulate(tmp_path / "stiff", elastic(tmp_path, rigidity=None), **settings)
    made = pkmcal.simulate(tmp_path / "soft", elastic(tmp_path), force=TENSION, **settings)
    truth, session = load_truth(made.folder), load_session(made.folder, measured=False)
    np.testing.assert_allclose(session.forces, truth.effects.forces, rtol=1e-6)
    assert np.all(np.abs(session.forces / TENSION - 1) <= 0.5)
    at = closure(truth.machine.layout, truth.machine.values, truth.joints, truth.T_base_platform)
    expected = session.forces * at.rows.distance / RIGIDITY * truth.effects.compliance
    np.testing.assert_allclose(stiff.joints - made.joints, expected, rtol=0.01)


@pytest.mark.parametrize(("to", "noted"), [("c", True), ("yaml", False)])
def test_an_export_leaves_the_stretch_out(to, noted, tmp_path):
    path = elastic(tmp_path, machine=load_mechanism("gough-stewart"))
    made = make_export(source_of(load_mechanism(path)), to)
    assert ("export.without_stretch" in {one.code for one in made.notes}) == noted


@pytest.mark.slow
def test_the_estimate_is_as_sure_as_it_states(tmp_path):
    errors, named = [], 0
    for seed in range(20):
        folder = stretched(tmp_path / f"{seed}", RIGIDITY, RIGIDITY, seed)
        (one,) = calibrate_session(folder).verdict.of("machine.compliance")
        errors.append((one.facts["value"] - 1) / one.facts["sigma"])
        stiff = stretched(tmp_path / f"{seed}-stiff", None, None, seed)
        named += bool(calibrate_session(stiff).violations)
    assert np.max(np.abs(errors)) < 3.5
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert not named
