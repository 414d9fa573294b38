"""Readings that scatter more than stated and are round numbers: rounding, or commands."""

from __future__ import annotations

import numpy as np
import pytest

import pkmcal
from pkmcal.files import csv_text
from pkmcal.session.readings import rounding_step
from test_pose_sessions import make


@pytest.mark.parametrize(
    ("unit", "step"),
    [("m", 1e-3), ("m", 5e-4), ("rad", np.deg2rad(0.1)), ("rad", 2e-3), ("m", None)],
)
def test_the_largest_step_of_round_numbers(unit, step):
    readings = np.random.default_rng(0).uniform(0.3, 0.6, size=(15, 6))
    if step is not None:
        readings = step * np.round(readings / step)
        assert rounding_step(readings, unit, 1.01 * step) is None
    assert rounding_step(readings, unit, 1e-7) == (None if step is None else pytest.approx(step))


@pytest.mark.parametrize(
    ("following", "fact"), [(0.0, "rounded_to"), (1e-3, "round_command"), (None, None)]
)
def test_round_readings_are_named_where_they_scatter(tmp_path, following, fact):
    """Rounded to 0.2 mm, or commands from which motors are 1 mm off; None: off without rounding."""
    made = make(tmp_path / "session", "gough-stewart", n=40)
    rng = np.random.default_rng(1)
    readings = made.joints
    if following != 0:
        readings = readings + (following or 1e-3) * rng.normal(size=readings.shape)
    if following is not None:
        readings = 2e-4 * np.round(readings / 2e-4)
    names = [f"{k:03d}" for k in range(len(readings))]
    columns = [f"leg{k + 1}" for k in range(readings.shape[1])]
    (made.folder / "joints.csv").write_text(csv_text(columns, names, readings.round(9)))
    findings = pkmcal.calibrate(made.folder).findings
    (noise,) = (one for one in findings if one.code.startswith("readings.noise"))
    true, (low, high) = np.sqrt(np.mean((readings - made.joints) ** 2)), noise.facts["range"]
    assert low < true / noise.facts["stated"] < high
    assert noise.facts["noise"] == pytest.approx(true, rel=0.25)
    named = {name: noise.facts.get(name) for name in ("rounded_to", "round_command")}
    assert {k for k, value in named.items() if value} == ({fact} if fact else set())
    if fact:
        assert named[fact] == pytest.approx(2e-4)
        assert "whole multiples" in noise.text
