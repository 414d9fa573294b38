"""Sessions whose readings' table has temperatures: growth of drives and frame."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

import pkmcal
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.saved_calibration import load
from pkmcal.errors import InputError
from pkmcal.files import csv_text, yaml_text
from pkmcal.judge.validate import validate_calibration
from pkmcal.judge.watch import watch_machine
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.disturbances import growth_by_readings
from pkmcal.report.calibration import save
from pkmcal.session.load import load_session
from pkmcal.simulation import load_truth
from test_pose_sessions import make

DRIVES, FRAME = 17e-6, 8e-6


def warmed(folder, drives, frame, seed=0, head="temperature [°C]", name="gough-stewart", T=None):
    """A session in which the machine warms from 20 to 50 °C and cools again; grown exactly.

    T : (K,) other temperatures.
    """
    made = make(folder, name, n=40 if T is None else len(T), seed=seed)
    machine, table = made.machine, made.machine.parameters
    if T is None:
        T = 35 - 15 * np.cos(np.linspace(0, 2 * np.pi, len(made.T)))
    lengths = np.array(table.units) == "m"
    zeros = np.array([part == "zero" for part in table.parts])
    readings = []
    for pose, noisy, warm in zip(made.T, made.joints, T - T.mean(), strict=True):
        values = machine.values.copy()
        values[lengths & ~zeros] *= 1 + frame * warm
        values[lengths & zeros] *= 1 + drives * warm
        grown = machine.with_values(values).inverse(pose)
        noise = noisy - machine.inverse(pose)
        # what moves by scale * reading grows with the drives
        moved = np.array([unit == "m" for unit in machine.joint_units])
        readings.append(np.where(moved, grown / (1 + drives * warm), grown) + noise)
    names = [f"{k:03d}" for k in range(len(T))]
    columns = [f"leg{k + 1}" for k in range(len(readings[0]))]
    text = csv_text([*columns, head], names, np.column_stack([readings, T]))
    (folder / "joints.csv").write_text(text, encoding="utf-8")
    return made


@pytest.mark.parametrize(
    "name", ["hexaglide", pytest.param("gough-stewart", marks=pytest.mark.slow)]
)
def test_growth_is_estimated(name, tmp_path):
    made = warmed(tmp_path / "session", DRIVES, FRAME, name=name)
    result = calibrate_session(made.folder)
    assert result.verdict.usable
    assert not result.violations
    (growth,) = result.verdict.of("readings.growth")
    facts = growth.facts
    assert facts["mean"] == pytest.approx(35, abs=0.5)
    for subject, truth in (("drives", DRIVES), ("frame", FRAME)):
        assert facts[subject] == pytest.approx(1e6 * truth, abs=4 * facts[f"sigma_{subject}"])
        assert facts[f"sigma_{subject}"] < 6
    # without the temperatures the noise contains the growth
    cold = calibrate_session(without_temperatures(made.folder))
    assert not cold.verdict.of("readings.growth")
    chi2 = [one.estimate.statistics.chi2_as_stated for one in (result, cold)]
    assert chi2[0] < 0.8 * chi2[1]


@pytest.mark.parametrize("head", ["temperature", "temperature [K]", "temperature (°C)"])
def test_temperatures_are_the_last_column(head, tmp_path):
    T = 35 - 15 * np.cos(np.linspace(0, 2 * np.pi, 40)) + 273.15 * ("K" in head)
    made = warmed(tmp_path / "session", 0.0, 0.0, head=head, T=T)
    session = load_session(made.folder)
    assert session.joints.shape == (40, 6)
    assert np.ptp(session.temperature) == pytest.approx(30, abs=0.1)
    assert session.temperature.mean() == pytest.approx(35, abs=0.5)


@pytest.mark.parametrize(("head", "shift"), [("temperature", 273.15), ("temperature [K]", -20.0)])
def test_temperatures_in_another_unit_than_their_head(head, shift, tmp_path):
    made = warmed(tmp_path / "session", 0.0, 0.0, head=head, T=np.linspace(20, 21, 10) + shift)
    with pytest.raises(InputError) as caught:
        load_session(made.folder)
    assert caught.value.code == "readings.temperature_unit"


def part(folder, other, rows):
    """A session of some rows of both tables of another session."""
    shutil.copytree(other, folder)
    for name in ("joints.csv", "poses.csv"):
        head, *lines = (folder / name).read_text(encoding="utf-8").splitlines()
        (folder / name).write_text("\n".join([head, *lines[rows]]) + "\n", encoding="utf-8")
    return folder


def without_temperatures(folder):
    path = folder / "joints.csv"
    rows = [row.rpartition(",")[0] for row in path.read_text(encoding="utf-8").splitlines()]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


def test_a_calibration_applies_to_a_warmer_session(tmp_path):
    """Calibrated from 20 to 50 °C, watched and validated at 120 to 130 °C."""
    T = np.concatenate([35 - 15 * np.cos(np.linspace(0, 2 * np.pi, 40)), np.linspace(120, 130, 20)])
    whole = warmed(tmp_path / "whole", DRIVES, FRAME, name="hexaglide", T=T).folder
    cold = part(tmp_path / "cold", whole, slice(40))
    out = tmp_path / "out"
    result = calibrate_session(cold)
    save(result, out)
    growth = load(out).machine.document.growth
    assert growth.temperature == pytest.approx(35, abs=0.5)
    assert 1e6 * growth.drives == pytest.approx(
        result.verdict.of("readings.growth")[0].facts["drives"]
    )
    hot = part(tmp_path / "hot", whole, slice(40, None))
    validated, watched = validate_calibration(out, hot), watch_machine(out, hot)
    assert validated.verdict.usable
    assert watched.verdict.usable
    for verdict in (validated.verdict, watched.verdict):
        (applied,) = verdict.of("readings.growth_applied")
        assert applied.facts["high"] == pytest.approx(130)
    # what the temperatures are worth
    without_temperatures(hot)
    blind = validate_calibration(out, hot)
    assert blind.verdict.of("readings.growth_not_applied")
    errors = [np.sqrt(np.mean(one.judged.after**2)) for one in (validated, blind)]
    assert errors[0] < 0.5 * errors[1]
    assert not watch_machine(out, hot).verdict.usable


def test_a_calibration_without_growth_is_noted(tmp_path):
    T = np.linspace(20, 21, 60)
    whole = warmed(tmp_path / "whole", 0.0, 0.0, name="hexaglide", T=T).folder
    cold, out = part(tmp_path / "a", whole, slice(40)), tmp_path / "out"
    save(calibrate_session(without_temperatures(cold)), out)
    result = validate_calibration(out, part(tmp_path / "b", whole, slice(40, None)))
    (unknown,) = result.verdict.of("readings.growth_unknown")
    assert unknown.facts["mean"] == pytest.approx(20.8, abs=0.1)


def test_a_plan_counts_the_growth_that_is_estimated(tmp_path):
    """It is an unknown: what is left of the tool's accuracy is less."""
    folder = warmed(tmp_path / "session", DRIVES, FRAME, name="hexaglide").folder
    warm = pkmcal.plan(folder).promised
    cold = pkmcal.plan(without_temperatures(folder)).promised
    assert 1.02 < warm.position / cold.position < 1.5


def test_simulated_sessions_warm(tmp_path):
    settings = {"stations": 1, "configurations": 6, "camera": (64, 48), "seed": 2}
    cold = pkmcal.simulate(tmp_path / "cold", "gough-stewart", **settings)
    warm = pkmcal.simulate(tmp_path / "warm", "gough-stewart", warming=30.0, **settings)
    assert cold.temperature is None
    T, effects = warm.temperature, load_truth(warm.folder).effects
    assert np.ptp(T) == pytest.approx(30)
    np.testing.assert_allclose(effects.temperature, T)
    assert np.max(np.abs(effects.growth)) < 5 * 11.5e-6
    # to first order, the readings are those of a cold machine by the columns of the estimate
    truth = warm.truth
    by = growth_by_readings(truth.machine, truth.joints, truth.T_base_platform)
    grown = by @ effects.growth * (T - T.mean())[:, None]
    assert np.max(np.abs(grown)) > 2e-5
    np.testing.assert_allclose(cold.joints - warm.joints, grown, atol=1e-7)


@pytest.mark.parametrize("name", ["gough-stewart", "delta"])
def test_a_difference_between_two_temperatures(name, tmp_path):
    """A machine that grows evenly becomes a similar one: the tool moves along with the frame."""
    fields, paths = load_mechanism(name).to_document(), {}
    for temperature in (20, 60):
        fields["growth"] = {
            "temperature": temperature, "drives": 1e-5, "frame": 1e-5, "sigma": [1e-12, 1e-12],
        }  # fmt: skip
        paths[temperature] = tmp_path / f"{temperature}.yaml"
        paths[temperature].write_text(yaml_text(fields), encoding="utf-8")
    result = pkmcal.diff(paths[20], paths[60])
    (found,) = result.verdict.of("difference.temperature")
    facts = found.facts
    assert (facts["temperature_a"], facts["temperature_b"]) == (20, 60)
    places = result.tool.evenly[1].T_base_platform[:, :3, 3]
    moved = 40 * 1e-5 * np.sqrt(np.mean(np.sum(places**2, axis=1)))
    assert facts["tool_shift"] == pytest.approx(moved, rel=1e-3)
    assert not pkmcal.diff(paths[20], paths[20]).verdict.findings


def test_calibrations_at_two_temperatures(tmp_path):
    """The growth of 95 K is more than chance; that of 2 K is not."""
    T = np.concatenate([35 - 15 * np.cos(np.linspace(0, 2 * np.pi, 40)), np.linspace(120, 140, 40)])
    whole = warmed(tmp_path / "whole", DRIVES, FRAME, name="hexaglide", T=T).folder
    for part_of, rows in (("a", slice(0, 40)), ("b", slice(40, 80)), ("c", slice(2, 40))):
        session = part(tmp_path / f"session-{part_of}", whole, rows)
        save(calibrate_session(session), tmp_path / part_of)
    a, b, c = (tmp_path / name for name in "abc")
    (found,) = pkmcal.diff(a, b).verdict.of("difference.temperature")
    warmer = found.facts["temperature_b"] - found.facts["temperature_a"]
    assert warmer == pytest.approx(95, abs=1)
    assert found.facts["tool_shift"] > found.facts["sigma"] > 0
    assert not pkmcal.diff(a, c).verdict.of("difference.temperature")
