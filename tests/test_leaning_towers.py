"""Towers that lean: a model violation by two angles each, estimated on request."""

from __future__ import annotations

import numpy as np
import pytest

import printers
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.files import csv_text
from pkmcal.firmware.session import write_printer_session
from pkmcal.outcome import Level
from pkmcal.session.load import load_session

SAYS = printers.Settings()
LEAN = np.deg2rad(0.4)
SESSION = """\
pkmcal: 1
mechanism: mechanism.yaml
joints: {file: joints.csv, noise: 0.004 mm}
stations:
  laser:
    tracker: {poses: poses.csv, noise: {position: 0.01 mm}}
"""


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A printer whose second tower leans along y about its middle, and points of its tool."""
    folder, rng = tmp_path_factory.mktemp("printer"), np.random.default_rng(4)
    true = printers.machine(SAYS, lean=np.array([[0, 0], [0, LEAN], [0, 0]]))
    values = true.values.copy()
    values[true.parameters.index("legs[2].base.center.y")] -= 0.35 * LEAN
    true = true.with_values(values)
    (folder / "printer.cfg").write_text(printers.printer_cfg(SAYS, printers.workshop(9)))
    write_printer_session(folder / "kit", folder / "printer.cfg")
    a, r = rng.uniform(0, 2 * np.pi, 80), 85 * np.sqrt(rng.uniform(size=80))
    points = np.column_stack([r * np.cos(a), r * np.sin(a), rng.uniform(0, 150, 80)])
    readings = SAYS.carriages(points) + 0.004 * rng.normal(size=(80, 3))
    there = 1e3 * true.forward(1e-3 * SAYS.carriages(points))[:, :3, 3]
    names = [f"{k:03d}" for k in range(80)]
    kit = folder / "kit"
    (kit / "session.yaml").write_text(SESSION)
    (kit / "joints.csv").write_text(csv_text([f"{c} [mm]" for c in "abc"], names, readings))
    measured = there + 0.01 * rng.normal(size=there.shape)
    (kit / "poses.csv").write_text(csv_text([f"{c} [mm]" for c in "xyz"], names, measured))
    return kit


def test_a_tower_that_leans_is_named_with_the_model_that_frees_it(tracked):
    result = calibrate_session(tracked)
    (one,) = result.violations
    assert (one.code, one.of, one.finding.level) == ("machine.lean", "leg 2", Level.DOUBTFUL)
    assert one.finding.facts["value"] == pytest.approx(LEAN, abs=4 * one.finding.facts["sigma"])
    assert one.finding.facts["sigma"] < LEAN / 5
    (misfit,) = result.verdict.of("data.misfit")
    assert misfit.facts["model"] == "leaning"


def test_its_direction_is_estimated_on_request(tracked):
    result = calibrate_session(load_session(tracked, "leaning"))
    assert result.verdict.usable
    assert not result.violations
    table = result.machine.parameters
    axes = np.array(
        [
            [result.machine.values[table.index(f"legs[{k}].base.axis.{c}")] for c in "xyz"]
            for k in (1, 2, 3)
        ]
    )
    # the second against the two others, whatever the frame
    across = np.arccos(np.clip(axes @ axes.T, -1, 1))
    assert across[0, 2] < 0.1 * LEAN
    assert across[1, [0, 2]] == pytest.approx(LEAN, rel=0.1)
