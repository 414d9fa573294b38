"""Calibration logs of a Maslow 4, read as sessions and calibrated."""

from __future__ import annotations

import re

import numpy as np
import pytest

import pkmcal
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.errors import InputError
from pkmcal.firmware.maslow import belt_lengths
from pkmcal.mechanisms import load_mechanism

ANCHORS = {"bl": (0.0, 0.0), "br": (2978.5, 0.0), "tr": (2969.2, 2150.3), "tl": (-27.6, 2163.8)}
NAMES = {"tlX": 0.0, "tlY": 2150.0, "trX": 3000.0, "trY": 2150.0, "brX": 3000.0}


def points(n=36):
    x, y = np.meshgrid(np.linspace(700, 2300, 6), np.linspace(500, 1700, n // 6))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def log(noise=0.3, seed=0, anchors=True):
    """Log in two batches, of which the second repeats the first."""
    rng = np.random.default_rng(seed)
    each = []
    for p in points():
        lengths = {k: np.hypot(*(p - a)) + noise * rng.normal() for k, a in ANCHORS.items()}
        each.append("{" + ",   ".join(f"{k}:{v:.2f}" for k, v in lengths.items()) + "}")
    lines = ["[MSG:INFO: Measured waypoint 0]"]
    if anchors:
        lines += [f"$/Maslow_{name}={value:.2f}" for name, value in NAMES.items()]
    lines += [f"CLBM:[{','.join(part)},]" for part in (each[:9], each)]
    return "\n".join(lines) + "\n"


def written(folder, text):
    (folder / "log.txt").write_text(text, encoding="utf-8")
    return pkmcal.new(from_file=folder / "log.txt")


def test_positions_of_repeated_batches_count_once():
    lengths = belt_lengths(log(), "log")
    assert lengths.shape == (36, 4)
    expected = [np.hypot(*(points()[0] - ANCHORS[k])) for k in ("bl", "br", "tr", "tl")]
    np.testing.assert_allclose(1e3 * lengths[0], expected, atol=2)


def test_the_anchors_of_a_log_are_calibrated(tmp_path):
    """The frame's shape to its stated deviations; its size is that of the belts' millimetres."""
    result = written(tmp_path, log())
    assert result.complete
    assert "image" not in result.texts["session.yaml"]
    result.save(tmp_path / "session")
    calibration = calibrate_session(tmp_path / "session")
    estimate = calibration.estimate
    table = estimate.machine.parameters
    sigma = np.sqrt(np.diag(estimate.covariance))
    for j, k in enumerate(("bl", "br", "tr", "tl"), 1):
        for axis, true in zip("xy", ANCHORS[k], strict=True):
            at = table.index(f"legs[{j}].base.center.{axis}")
            off = abs(1e3 * estimate.machine.values[at] - true)
            assert off < max(4e3 * sigma[at], 0.01)
    assert 0.1e-3 < calibration.session.joint_noise * estimate.statistics.reading_scale < 1.2e-3


def test_a_log_without_anchors_leaves_them_to_the_belts(tmp_path):
    """The built-in frame's are no measurements of this one, so they hardly count."""
    written(tmp_path, log(anchors=False)).save(tmp_path / "session")
    machine = load_mechanism(tmp_path / "session" / "mechanism.yaml")
    assert machine.document.tolerance.center == 0.5
    estimate = calibrate_session(tmp_path / "session").estimate
    sigma = np.sqrt(np.diag(estimate.covariance))
    at = estimate.machine.parameters.index("legs[2].base.center.x")
    assert abs(1e3 * estimate.machine.values[at] - ANCHORS["br"][0]) < 4e3 * sigma[at] < 20


@pytest.mark.parametrize(
    "text",
    [
        "CLBM:[{bl:1000, br:2000, tr:2000}]",
        "CLBM:[{bl:1000, br:2000, tr:2000, tl:nan}]",
        "CLBM:[{bl:1000, br:2000, tr:2000, tl:-5}]",
        "CLBM:[{bl:1000, br:2000, tr:2000, tl:1e9}]",
        "CLBM:[{bl:1000, br:2000, tr:2000, tl:1000}]",
        log().replace("Maslow_brX=3000.00", "Maslow_brX=1e30"),
        log().replace("$/Maslow_brX=3000.00\n", ""),  # a part of the anchors
        re.sub(r"Maslow_(\w+)=(\d+)", lambda m: f"Maslow_{m[1]}={int(m[2]) / 1e3}", log()),
        re.sub(r"(bl|br|tr|tl):(\d+)", lambda m: f"{m[1]}:{int(m[2]) / 1e6:.7f}", log()),
    ],
)
def test_logs_that_are_none(tmp_path, text):
    with pytest.raises(InputError):
        written(tmp_path, text)


def test_a_check_of_readings_alone_names_no_images(tmp_path):
    written(tmp_path, log()).save(tmp_path / "session")
    checked = pkmcal.check(tmp_path / "session")
    assert "image" not in checked.outcome.subject
    assert "36 configurations" in checked.outcome.subject
