"""Sessions whose readings' table has temperatures: growth of drives and frame."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.files import csv_text
from pkmcal.session.load import load_session
from test_pose_sessions import make

DRIVES, FRAME = 17e-6, 8e-6


def warmed(folder, drives, frame, seed=0, head="temperature [°C]", name="gough-stewart"):
    """A session in which the machine warms from 20 to 50 °C and cools again; grown exactly."""
    made = make(folder, name, n=40, seed=seed)
    machine, table = made.machine, made.machine.parameters
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
    text = (made.folder / "joints.csv").read_text(encoding="utf-8")
    rows = [row.rpartition(",")[0] for row in text.splitlines()]
    (made.folder / "joints.csv").write_text("\n".join(rows), encoding="utf-8")
    cold = calibrate_session(made.folder)
    assert not cold.verdict.of("readings.growth")
    chi2 = [one.estimate.statistics.chi2_as_stated for one in (result, cold)]
    assert chi2[0] < 0.8 * chi2[1]


@pytest.mark.parametrize("head", ["temperature", "temperature [K]", "temperature (°C)"])
def test_temperatures_are_the_last_column(head, tmp_path):
    made = warmed(tmp_path / "session", 0.0, 0.0, head=head)
    session = load_session(made.folder)
    assert session.joints.shape == (40, 6)
    assert np.ptp(session.temperature) == pytest.approx(30, abs=0.1)
