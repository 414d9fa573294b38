"""Cranks with eccentric encoders."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.calibration.calibrate import calibrate_session
from test_pose_sessions import make, write_joints


def eccentric(folder, amplitude, seed=0, phase=0.5, name="delta"):
    """A session in which the second crank's encoder reads too much by a sine of its angle."""
    made = make(folder, name, n=60, seed=seed)
    readings = made.joints.copy()
    readings[:, 1] += amplitude * np.sin(readings[:, 1] + phase)
    write_joints(folder, readings)
    return folder


def test_an_eccentric_encoder_is_named(tmp_path):
    amplitude, phase = 1e-2, 0.5
    result = calibrate_session(eccentric(tmp_path / "session", amplitude, phase=phase))
    (one,) = result.violations
    assert (one.code, one.of) == ("readings.eccentric", "motor2")
    assert one.rivals == ()
    truth = -amplitude * np.array([np.cos(phase), np.sin(phase)])
    np.testing.assert_array_less(np.abs(one.value - truth), 4 * one.sigma)
    assert one.finding.facts["value"] == pytest.approx(amplitude, abs=0.5 * amplitude)


def test_a_centred_one_is_not(tmp_path):
    assert not calibrate_session(eccentric(tmp_path / "session", 0.0)).violations


@pytest.mark.parametrize("seed", [8, pytest.param(15, marks=pytest.mark.slow)])
def test_over_a_small_arc_a_scale_and_an_eccentric_encoder_are_both_named(seed, tmp_path):
    """The sine of 6-RUS cranks, which turn by 90 degrees, is nearly straight."""
    result = calibrate_session(eccentric(tmp_path / "session", 5e-3, seed=seed, name="6-rus"))
    (one,) = result.violations
    named = {one.code, *(rival.code for rival in one.rivals)}
    assert named == {"readings.scale", "readings.eccentric"}
    assert {one.of, *(rival.subject for rival in one.rivals)} == {"motor2"}
    assert {row["code"] for row in one.document()["rivals"]} == named - {one.code}
    assert len(one.finding.facts["rivals"]) == 1


@pytest.mark.slow
def test_a_scale_that_the_data_separate_is_named_alone(tmp_path):
    made = make(tmp_path / "session", "delta", n=60)
    readings = made.joints.copy()
    readings[:, 1] *= 1.02
    write_joints(made.folder, readings)
    (one,) = calibrate_session(made.folder).violations
    assert (one.code, one.of, one.rivals) == ("readings.scale", "motor2", ())
