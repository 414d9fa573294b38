"""Drives that yield under a load: statics, the correction, its estimate, and what names it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.optimize import minimize

import pkmcal
from export_sources import source_of
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.exporters.samples import samples
from pkmcal.files import yaml_text
from pkmcal.geometry.rigid import perturb
from pkmcal.judge.validate import validate_calibration
from pkmcal.judge.watch import watch_machine
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.disturbances import sag, weight_on_readings
from pkmcal.outcome.finding import Level
from pkmcal.report.calibration import save
from pkmcal.simulation import load_truth
from test_pose_sessions import make, write_joints
from test_thermal_growth import part

STIFFNESS, MASS, CENTER = 4e5, 60.0, (0.02, -0.01, 0.08)
SAG_NOTE = "export.without_sag"
UNITS = {"gough-stewart": 1.0, "6-rus": 0.05**2, "h4": 0.1}
"""Stiffness relative to STIFFNESS: that of cranks is by their angle."""


def loaded(folder, name="gough-stewart", stiffness=STIFFNESS, **load_fields):
    """A mechanism file with a load, and with a stiffness of each drive unless it is None."""
    fields = load_mechanism(name).to_document()
    fields["load"] = {"mass": MASS, "center": list(CENTER), **load_fields}
    if stiffness is not None:
        for leg in fields["legs"]:
            leg["stiffness"] = stiffness
    path = folder / "loaded.yaml"
    path.write_text(yaml_text(fields))
    return path


def leg_forces(machine, T):
    """Forces (6,) along a hexapod's legs, N, that balance the load, by forces and moments."""
    document = machine.to_document()
    a, b = (np.array([leg[end]["center"] for leg in document["legs"]])
            for end in ("base", "platform"))  # fmt: skip
    b = b @ T[:3, :3].T + T[:3, 3]
    u = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    weight, at = np.array([0, 0, -9.81]) * MASS, T[:3, :3] @ CENTER + T[:3, 3]
    balance = np.concatenate([u, np.cross(b, u)], axis=1).T
    return np.linalg.solve(balance, -np.concatenate([weight, np.cross(at, weight)]))


def sagging(folder, stiffness, stated, seed=0, n=40):
    """A session of a hexapod whose legs yield by ``stiffness``; its file states ``stated``."""
    folder.mkdir()
    made = make(folder / "session", loaded(folder, stiffness=stated), n=n, seed=seed)
    forces = np.array([leg_forces(made.machine, T) for T in made.T])
    scale = np.array([leg["scale"] for leg in made.machine.to_document()["legs"]])
    if stiffness is not None:
        write_joints(made.folder, made.joints + forces / stiffness * scale)
    return made.folder


def test_legs_carry_the_load(tmp_path):
    machine = load_mechanism(loaded(tmp_path))
    poses, _ = samples(machine, 10)
    scale = np.array([leg["scale"] for leg in machine.to_document()["legs"]])
    forces = np.array([leg_forces(machine, T) for T in poses])
    np.testing.assert_allclose(weight_on_readings(machine, poses), -forces * scale, rtol=1e-9)


@pytest.mark.parametrize("name", UNITS)
def test_the_platform_rests_where_the_energy_is_least(name, tmp_path):
    """Of springs in the drives and of the weight, against forward kinematics with the sag."""
    stiffness = STIFFNESS * UNITS[name]
    machine = load_mechanism(loaded(tmp_path, name, stiffness, mass=5.0))
    directions = machine.layout.motion
    poses, joints = samples(machine, 3)
    for T, q in zip(poses, joints, strict=True):

        def energy(step, T=T, q=q):
            there = perturb(T, directions @ step * 1e-3)
            height = (there @ [*CENTER, 1.0])[2]
            return 5.0 * 9.81 * height + 0.5 * stiffness * np.sum((machine.inverse(there) - q) ** 2)

        rest = minimize(
            energy, np.zeros(directions.shape[1]), method="BFGS", options={"gtol": 1e-9}
        )
        there = perturb(T, directions @ rest.x * 1e-3)
        expected = machine.forward(q + sag(machine, there), there)
        moved = np.linalg.norm((there - T)[:3, 3])
        assert np.linalg.norm((there - expected)[:3, 3]) < 2e-3 * moved


def test_the_stiffness_is_estimated(tmp_path):
    """From a file that states it a third too large; the calibrated file has it."""
    result = calibrate_session(sagging(tmp_path / "right", STIFFNESS, STIFFNESS / 0.75))
    assert result.verdict.usable
    assert not result.violations
    (one,) = result.verdict.of("machine.compliance")
    facts = one.facts
    assert facts["value"] == pytest.approx(1 / 0.75, abs=3 * facts["sigma"])
    assert facts["sigma"] < 0.1 < facts["prior"]
    leg = load_mechanism(save_in(result, tmp_path)).document.legs[0]
    assert leg.stiffness == pytest.approx(STIFFNESS / 0.75 / facts["value"])


def save_in(result, folder):
    save(result, folder / "out")
    assert load(folder / "out").machine.document.load.mass == MASS
    return folder / "out" / "mechanism.yaml"


def test_a_calibration_applies_to_later_sessions(tmp_path):
    whole, out = sagging(tmp_path / "whole", STIFFNESS, STIFFNESS / 0.75, n=60), tmp_path / "out"
    save(calibrate_session(part(tmp_path / "first", whole, slice(40))), out)
    later = part(tmp_path / "later", whole, slice(40, None))
    validated = validate_calibration(out, later)
    assert validated.verdict.usable
    assert np.sqrt(np.mean(validated.judged.after**2)) < 4e-5
    assert watch_machine(out, later).verdict.usable
    # without its stiffness the calibrated machine is off
    document = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    for leg in document["mechanism"]["legs"]:
        del leg["stiffness"]
    (out / "calibration.json").write_text(json.dumps(document), encoding="utf-8")
    assert not watch_machine(out, later).verdict.usable


def test_a_load_without_a_stiffness_is_tested(tmp_path):
    result = calibrate_session(sagging(tmp_path / "soft", STIFFNESS, None))
    (one,) = result.violations
    assert (one.code, one.of) == ("machine.sag", "drives")
    facts = one.finding.facts
    assert facts["value"] == pytest.approx(1 / STIFFNESS, abs=4 * facts["sigma"])
    assert facts["stiffness"] == pytest.approx(STIFFNESS, rel=0.2)
    assert 1e-5 < abs(facts["sinks"]) < 1e-3


def test_a_stiff_machine_is_not_named(tmp_path):
    result = calibrate_session(sagging(tmp_path / "stiff", None, None))
    assert result.verdict.usable
    assert not result.violations


@pytest.mark.slow
def test_the_estimate_is_as_sure_as_it_states(tmp_path):
    errors, named = [], 0
    for seed in range(20):
        folder = sagging(tmp_path / f"{seed}", STIFFNESS, STIFFNESS, seed)
        (one,) = calibrate_session(folder).verdict.of("machine.compliance")
        errors.append((one.facts["value"] - 1) / one.facts["sigma"])
        stiff = sagging(tmp_path / f"{seed}-stiff", None, None, seed)
        named += bool(calibrate_session(stiff).violations)
    assert np.max(np.abs(errors)) < 3.5
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert not named


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda d: d["legs"][2].pop("stiffness"), "legs[3].stiffness"),
        (lambda d: [leg.update(stiffness=200.0) for leg in d["legs"]], "load"),  # N/um
    ],
)
def test_incomplete_loads_are_refused(change, field, tmp_path):
    fields = load_mechanism(loaded(tmp_path)).to_document()
    change(fields)
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml_text(fields))
    with pytest.raises(InputError) as error:
        load_mechanism(path)
    assert field in error.value.where


def test_simulated_drives_yield(tmp_path):
    settings = {"stations": 1, "configurations": 4, "camera": (64, 48), "seed": 2}
    stiff = pkmcal.simulate(tmp_path / "stiff", loaded(tmp_path, stiffness=None), **settings)
    soft = pkmcal.simulate(tmp_path / "soft", loaded(tmp_path), **settings)
    truth = load_truth(soft.folder)
    assert 0.3 < truth.effects.compliance < 3
    forces = np.array([leg_forces(truth.machine, T) for T in truth.T_base_platform])
    scale = np.array([leg["scale"] for leg in truth.machine.to_document()["legs"]])
    expected = forces / STIFFNESS * truth.effects.compliance * scale
    np.testing.assert_allclose(soft.joints - stiff.joints, expected, rtol=1e-6)


@pytest.mark.parametrize(("to", "noted"), [("c", True), ("mujoco", True), ("yaml", False)])
def test_an_export_leaves_the_sag_out(to, noted, tmp_path):
    machine = load_mechanism(loaded(tmp_path))
    notes = [one for one in make_export(source_of(machine), to).notes if one.code == SAG_NOTE]
    assert bool(notes) == noted
    for note in notes:
        poses, joints = samples(machine)
        sunk = machine.forward(joints + sag(machine, poses), poses) - poses
        largest = np.linalg.norm(sunk[:, :3, 3], axis=1).max()
        assert note.facts["largest"] == pytest.approx(largest, rel=1e-2)
        assert note.level is Level.DOUBTFUL


def test_a_sag_that_hardly_counts_is_no_warning(tmp_path):
    made = make_export(source_of(load_mechanism(loaded(tmp_path, stiffness=1e8))), "c")
    (note,) = (one for one in made.notes if one.code == SAG_NOTE)
    assert (note.level, note.facts["largest"] < 5e-5) == (Level.NOTE, True)


def test_a_compliance_is_positive(tmp_path):
    """Drives that rise under the load, as with gravity in the wrong direction: nothing named sag,
    and no result where the file states a stiffness.
    """
    unstated = calibrate_session(sagging(tmp_path / "unstated", -STIFFNESS, None))
    assert "machine.sag" not in {one.code for one in unstated.violations}
    stated = calibrate_session(sagging(tmp_path / "stated", -STIFFNESS, STIFFNESS))
    assert not stated.verdict.usable
    (one,) = stated.verdict.of("machine.compliance_negative")
    assert one.facts["value"] == pytest.approx(-1, abs=0.1)
