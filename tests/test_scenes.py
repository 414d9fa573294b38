"""The benchmark of scenes with known truth: is its own arithmetic right?"""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pkmcal.geometry.rigid import apply, pose, rotation

FILE = Path(__file__).parents[1] / "benchmarks" / "scenes.py"
DRAWS = 100


@pytest.fixture(scope="module")
def scenes():
    spec = importlib.util.spec_from_file_location("scenes", FILE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["scenes"] = module  # dataclasses resolve their module by name
    spec.loader.exec_module(module)
    yield module
    del sys.modules["scenes"]


@pytest.fixture(scope="module")
def case(scenes, calibrated, demo):
    """An estimate's parts, its covariance and its truth."""
    numbers = scenes.numbers_of(calibrated.machine)
    parts = scenes.parts_of(calibrated.machine.values[numbers])
    truth = scenes.read_truth(demo.session, calibrated.session.machine)
    return parts, calibrated.estimate.covariance[np.ix_(numbers, numbers)], truth


def drawn(case, rng):
    """Truths distributed about the estimate by its covariance."""
    parts, covariance, truth = case
    value, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(value, 0))
    x = np.concatenate([part.ravel() for part in parts])
    for _ in range(DRAWS):
        y = x + root @ rng.normal(size=len(x))
        yield replace(truth, a=y[:18].reshape(6, 3), b=y[18:36].reshape(6, 3), offset=y[36:])


def test_errors_drawn_from_the_covariance_whiten_to_one(scenes, case):
    parts, covariance, _ = case
    results = [
        scenes.errors_of(*parts, covariance, t) for t in drawn(case, np.random.default_rng(0))
    ]
    assert {e.dof for e in results} == {30}  # 42 numbers less two bodies' frames
    # the mean of NEES / dof over n draws has the standard deviation sqrt(2 / (n dof))
    share = np.mean([e.nees for e in results]) / 30
    assert share == pytest.approx(1, abs=4 * np.sqrt(2 / (30 * DRAWS)))
    low, high = scenes.honest(30, 0.95)
    inside = np.mean([low < e.whitened < high for e in results])
    assert inside == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / DRAWS))
    # and the tool's z by the same covariance
    assert np.mean([e.tool_z**2 for e in results]) == pytest.approx(1, abs=0.2)


def test_a_covariance_that_promises_too_much_is_reported(scenes, case):
    parts, covariance, truth = case
    honest = scenes.errors_of(*parts, covariance, truth)
    bold = scenes.errors_of(*parts, covariance / 4, truth)
    assert bold.whitened == pytest.approx(2 * honest.whitened)
    assert bold.tool_z == pytest.approx(2 * honest.tool_z)
    assert bold.tool == honest.tool


def test_frames_are_conventions(scenes, case, calibrated):
    parts, covariance, truth = case
    here = calibrated.estimate.state.T_camera_base
    rng = np.random.default_rng(1)
    e, f = (pose(rotation(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
    other = replace(
        truth,
        a=apply(e, truth.a),
        b=apply(f, truth.b),
        T_camera_base=truth.T_camera_base @ np.linalg.inv(e),
        T_base_platform=e @ truth.T_base_platform @ np.linalg.inv(f),
    )
    first = scenes.errors_of(*parts, covariance, truth, here)
    again = scenes.errors_of(*parts, covariance, other, here)
    assert again.nees == pytest.approx(first.nees, rel=1e-6)
    assert again.a == pytest.approx(first.a, rel=1e-6)
    assert again.station == pytest.approx(first.station, rel=1e-6)
    assert len(first.station) == 3
    assert max(first.station) < 5e-3  # coarse images, but the camera is localized


def test_a_whole_session_is_scored_and_its_truth_not_shown(
    scenes, demo, calibrated, capsys, monkeypatch
):
    def calibrate(session, **_options):
        assert session.folder != demo.session
        assert not list(session.folder.rglob("truth.json"))
        return calibrated

    monkeypatch.setattr("pkmcal.calibration.calibrate.calibrate_session", calibrate)
    scenes.main([str(demo.session), "--json"])
    value = json.loads(capsys.readouterr().out)
    (row,) = value["sessions"]
    assert row["usable"]
    assert row["errors"]["tool"] < 3 * row["errors"]["tool_stated"]
    assert value["dof"] == row["errors"]["dof"] == 30
    assert value["whitened"] == pytest.approx(row["errors"]["whitened"])
    assert (demo.session / "truth.json").exists()


def test_what_is_refused_has_its_sentence(scenes, session, demo, capsys):
    """Images without content, under a truth that is never read."""
    (session / "truth.json").write_text((demo.session / "truth.json").read_text())
    for path in (session / "images").glob("*/*.png"):
        path.unlink()
    scenes.main([str(session)])
    text = capsys.readouterr().out
    assert "refused" in text
    (line,) = [line for line in text.splitlines() if line.startswith("session: ")]
    assert "expected files images/station1/{configuration}.png" in line


def test_poses_are_spoilt_by_what_was_asked(scenes):
    pose_ = {"position": [0.0, -1.0, 0.2], "look_at": [0.0, 0.0, 0.2], "up": [0.0, 0.0, 1.0]}
    document = {"stations": {"front": {"pose": dict(pose_)}, "board": {}}}
    scenes.spoilt(document, (0.3, np.deg2rad(30)), np.random.default_rng(0))
    new = {key: np.array(value) for key, value in document["stations"]["front"]["pose"].items()}
    old = {key: np.array(value) for key, value in pose_.items()}
    assert np.linalg.norm(new["position"] - old["position"]) == pytest.approx(0.3, abs=2e-4)
    ways = [(p["look_at"] - p["position"], p["up"]) for p in (old, new)]
    frames = [np.stack([v, u, np.cross(v, u)]) for v, u in ways]
    angle = np.arccos((np.trace(frames[0] @ frames[1].T) - 1) / 2)
    assert np.rad2deg(angle) == pytest.approx(30, abs=0.05)
    assert "pose" not in document["stations"]["board"]
