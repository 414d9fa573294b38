"""Beds that are not flat are no fault of the machine; a fault that explains more is still named."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import printers
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.discrepancy_basis import UNEVEN_BED
from pkmcal.calibration.faults import scale_fault
from pkmcal.calibration.machine_source import load_source
from pkmcal.calibration.results import calibration_document
from pkmcal.calibration.saved_calibration import load
from pkmcal.checks.check import check_session
from pkmcal.files import json_value
from pkmcal.firmware.session import write_printer_session
from pkmcal.geometry.rigid import pose
from pkmcal.outcome import Level
from pkmcal.report.calibration import report_of, save
from pkmcal.session.station_movement import how_far

SAYS = printers.Settings()
POINTS, NOISE = 49, 0.008
SIZE, LENGTH = 0.05, 50.0
"""mm, of a bed: standard deviation and correlation length."""


def surface(xy, seed):
    """Heights (n,) mm of an uneven bed at places (n, 2) mm."""
    square = ((xy[:, None] - xy[None]) ** 2).sum(axis=-1)
    covariance = SIZE**2 * (np.exp(-square / 2 / LENGTH**2) + 1e-8 * np.eye(len(xy)))
    return np.linalg.cholesky(covariance) @ np.random.default_rng(seed).normal(size=len(xy))


def kit_of(folder, *, bed=0.0, scale=(1.0, 1.0, 1.0), seed=0):
    """Session of a printer with its firmware's values except for its motors' scales; bed : (n,) mm
    above the plane.
    """
    true = printers.machine(SAYS, scale=scale)
    readings = printers.felt(true, printers.bed(POINTS), NOISE, np.random.default_rng(seed))
    readings = readings + np.broadcast_to(bed, POINTS)[:, None]
    (folder / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
    write_printer_session(folder / "kit", folder / "printer.cfg")
    return folder / "kit"


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """An uneven bed, the session in which it was probed, and its calibration; its residuals look
    like a wrong scale of a motor.
    """
    heights = surface(printers.bed(POINTS), 2)
    kit = kit_of(tmp_path_factory.mktemp("uneven"), bed=heights)
    return heights, kit, calibrate_session(kit)


def flatness(value):
    """Root mean square height (m) of the true tool over the probed disc, for the calibrated
    machine's readings along a plane, without the plane's own tilt and height.
    """
    k = np.arange(200)
    r, a = value.identification.bed.radius * np.sqrt((k + 0.5) / 200), k * np.pi * (3 - np.sqrt(5))
    xy = np.column_stack([r * np.cos(a), r * np.sin(a)])
    there = pose(np.eye(3), np.column_stack([xy, np.zeros(200)]))
    z = printers.machine(SAYS).forward(value.machine.inverse(there))[:, 2, 3]
    plane = np.column_stack([xy, np.ones(200)])
    return float(np.sqrt(np.mean((z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]) ** 2)))


def test_an_uneven_bed_is_accepted_and_blamed_on_no_motor(uneven):
    _, _, value = uneven
    assert value.verdict.usable
    assert value.violations == ()
    (error,) = value.model_errors
    assert (error.code, error.sure) == (UNEVEN_BED, True)
    assert 1e-3 * SIZE / 3 < error.scale < 3e-3 * SIZE
    assert 1e-3 * LENGTH / 3 < error.length < 3e-3 * LENGTH
    assert f"discrepancy.{UNEVEN_BED}" in value.verdict.codes


def test_heights_blame_no_scale_of_the_machine(uneven):
    """They leave sizes to the nominal model; distances on a printed part would determine them."""
    estimate, table = uneven[2].estimate, uneven[2].estimate.machine.parameters
    lengths = np.array([unit == "m" for unit in table.units])
    larger = estimate.machine.with_values(np.where(lengths, 1.05, 1.0) * table.nominal)
    assert not [*scale_fault(uneven[2].session, replace(estimate, machine=larger))]
    measured = replace(estimate, machine=larger, link_weights=np.ones(3))
    (fault,) = scale_fault(uneven[2].session, measured)
    assert fault.facts["value"] == pytest.approx(0.05, rel=1e-6)


def test_deviations_contain_the_unevenness(uneven):
    """Errors of the future bed, and of the parameters, all of which are right from the first."""
    _, _, value = uneven
    assert flatness(value) < 3 * value.identification.bed.sigma
    sigma = np.sqrt(np.diag(value.estimate.covariance))
    off = np.abs(value.machine.values - value.session.machine.values)
    assert np.all(off <= 3 * sigma + 1e-12)


def test_the_map_is_the_bed_as_far_as_its_deviations_say(uneven):
    heights, _, value = uneven
    document = json_value(calibration_document(value))
    (error,) = document["model_errors"]
    assert error["code"] == UNEVEN_BED
    table = {name: np.array(values) for name, values in error["surface"].items()}
    # what is of a plane, and the mean, is no unevenness
    order = table["configuration"]
    plane = np.column_stack([table["x"], table["y"], np.ones(POINTS)])
    off = table["height"] - 1e-3 * heights[order]
    off = off - plane @ np.linalg.lstsq(plane, off, rcond=None)[0]
    assert np.sqrt(np.mean((off / table["sigma"]) ** 2)) < 2
    np.testing.assert_allclose(1e3 * plane[:, :2], printers.bed(POINTS)[order], atol=1.0)
    assert "bed" in [part.name for part in report_of(value).parts]


def test_check_finds_what_calibrate_finds(uneven):
    _, kit, check = uneven
    findings = check_session(kit).findings
    assert all(one.level is not Level.WRONG for one in findings)
    (warning,) = check.verdict.of(f"discrepancy.{UNEVEN_BED}")
    assert warning.text in [one.text for one in findings if one.code == warning.code]


def test_a_flat_bed_is_flat(tmp_path):
    calibration = calibrate_session(kit_of(tmp_path))
    assert calibration.verdict.usable
    assert calibration.violations == calibration.model_errors == ()
    assert "bed" not in [part.name for part in report_of(calibration).parts]


def test_a_wrong_motor_is_named_where_it_explains_more_than_an_uneven_bed(tmp_path):
    kit = kit_of(tmp_path, scale=(1.0, 1.0, 1.03))
    calibration = calibrate_session(kit)
    (violation,) = calibration.violations
    assert (violation.code, violation.of) == ("readings.scale", "stepper_c")
    assert abs(violation.value[0] - 0.03) < 4 * violation.sigma[0]
    assert violation.against
    assert not calibration.verdict.usable
    assert violation.finding.text in [one.text for one in check_session(kit).findings]


# ------------------------------------------------------------------ what is not determined


@pytest.fixture(scope="module")
def dropped(tmp_path_factory):
    """A bed that sank by half a millimetre while it was probed."""
    fell = np.where(np.arange(POINTS) < 25, 0.0, -0.5)
    return calibrate_session(kit_of(tmp_path_factory.mktemp("dropped"), bed=fell))


def test_a_bed_that_moved_has_no_numbers_that_heights_do_not_determine(dropped):
    (violation,) = dropped.violations
    assert violation.code == "station.moved"
    rx, ry, turn, x, y, z = violation.value
    assert np.isnan([turn, x, y]).all()
    assert np.isinf(violation.sigma[2:5]).all()
    assert np.isfinite([rx, ry]).all()
    assert abs(z) == pytest.approx(0.5e-3, abs=4 * violation.sigma[5])
    assert violation.score.dof == 3
    document = json_value(violation.document())
    assert document["value"][2:5] == document["sigma"][2:5] == [None] * 3
    assert violation.finding.facts["shift"] is violation.finding.facts["turn"] is None


def test_no_text_has_a_number_of_absurd_size(dropped, uneven):
    """The surface is neither in a verdict nor in any table of the report."""
    for item in (dropped, uneven[2]):
        verdict, parts = item.verdict, report_of(item).parts
        texts = [verdict.headline, *verdict.reasons, *verdict.warnings, *verdict.advice]
        for part in parts:
            texts += part.text
            texts += [str(c) for table in part.tables for row in table.rows for c in row.cells]
        assert not [text for text in texts if re.search(r"\d{7}", text)]
        assert not [text for text in texts if re.search(r"\bnan\b|\binf\b", text)]


def test_a_bed_stands_nowhere_along_itself(uneven, tmp_path):
    """Neither the bed's x, y and turn nor the tool's are numbers with a standard deviation."""
    _, _, value = uneven
    document = json_value(calibration_document(value))
    (station,), (target,) = document["stations"], document["targets"]
    for one in (station, target):
        assert one["sigma_translation"][:2] == [None, None]
        assert one["sigma_rotation"][2] is None
    save(value, tmp_path / "result")
    loaded = load(tmp_path / "result").stations[0]
    assert np.isinf(loaded.sigma_translation[:2]).all()
    assert dict(load_source(tmp_path / "result").T_base_camera) == {}
    assert "stations" not in [part.name for part in report_of(value).parts]


def test_a_movement_is_a_number_where_it_is_determined():
    change = np.array([1e-3, 0, 0, 3e-3, 4e-3, 0])
    assert how_far(change) == ", by some 5.0 mm and 0.057°"
    nowhere = np.full(6, np.nan)
    assert not re.search(r"\d", how_far(nowhere))
    for part in (slice(0, 3), slice(3, 6)):
        some = change.copy()
        some[part] = np.nan
        assert ("mm" in how_far(some)) == (part.start == 0)
        assert ("°" in how_far(some)) == (part.start == 3)
