"""Values under a firmware's own names, with standard deviations: against whole exports beside."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import pkmcal
import printers
from conftest import run
from export_sources import source_of
from pkmcal.calibration.machine_source import load_source
from pkmcal.firmware.contract import firmwares
from pkmcal.mechanisms import machine_from_document
from pkmcal.outcome.finding import Level
from test_export_firmware import ideal_linear, ideal_rotary

ENTRIES = {"height_offset": 0.001, "steps_per_mm": 3 * (80.0,)}
STEP = 1e-6
CASES = [(one, "linear") for one in firmwares()]
CASES += [(one, "rotary") for one in firmwares() if one.rotary is not None]


def with_entries(machine):
    document = machine.document.model_copy(update=ENTRIES)
    return machine_from_document(document).with_values(machine.values)


@pytest.mark.parametrize(("firmware", "kind"), CASES, ids=lambda one: getattr(one, "name", one))
def test_sigmas_are_the_changes_of_a_whole_export(firmware, kind):
    """Of a covariance v v^T the standard deviations are the values' derivatives along v."""
    machine = with_entries(ideal_linear() if kind == "linear" else ideal_rotary())
    if kind == "rotary":  # Klipper has one height for all arms
        heights = [f"legs[{leg}].base.center.z" for leg in (1, 2, 3)]
        values = machine.values.copy()
        values[[machine.parameters.index(name) for name in heights]] = 0.0
        machine = machine.with_values(values)
    table, rng = machine.parameters, np.random.default_rng(3)
    v = np.where(np.isin(table.kinds, ["center", "offset", "axis"]), 1e-4, 0.0)
    v *= rng.normal(size=len(v))
    bed = -0.2
    by_bed = rng.normal(size=len(v))
    exported = {
        "covariance": np.outer(v, v), "bed": bed, "bed_by_parameters": by_bed, "bed_sigma": 0.0,
    }  # fmt: skip
    values = firmware.values(source_of(machine, **exported))
    beside = [
        firmware.values(
            source_of(
                machine.with_values(machine.values + sign * STEP * v / 1e-4),
                bed=bed + sign * STEP * float(by_bed @ v) / 1e-4,
            )
        )
        for sign in (1, -1)
    ]
    assert all(one.sigma is None for one in beside[0])
    for one, plus, minus in zip(values, *beside, strict=True):
        assert one.name == plus.name == minus.name
        change = abs(plus.value - minus.value) / (2 * STEP / 1e-4)
        assert one.sigma == pytest.approx(change, rel=2e-2, abs=2e-4)
    assert sum(one.sigma > 1e-3 for one in values) >= 8


@pytest.mark.parametrize("firmware", firmwares(), ids=lambda one: one.name)
def test_the_text_has_the_values(firmware):
    """Each value is, rounded, a number of the code; its standard deviation a comment."""
    machine = with_entries(ideal_linear())
    n = len(machine.values)
    source = source_of(machine, covariance=1e-10 * np.eye(n), bed=0.0, bed_sigma=1e-5)
    (text,) = firmware.files(source).values()
    lines = text.splitlines()
    code = [line.partition(firmware.comment)[0] for line in lines]
    numbers = [float(word) for line in code for word in re.findall(r"-?\d+\.?\d*", line)]
    comments = [line for line in lines if line.startswith(firmware.comment)]
    for one in firmware.values(source):
        assert min(abs(number - one.value) for number in numbers) < (
            0.51 if one.unit == "steps" else 2e-4
        )
        of_value = f"{firmware.comment} {one.name} ="
        stating = [line for line in comments if line.startswith(of_value)]
        (line,) = (line for line in stating if "sigma" in line or line.endswith("exact"))
        stated = 0.0 if line.endswith("exact") else float(line.rpartition("sigma ")[2])
        assert stated == pytest.approx(one.sigma, rel=0.06, abs=1e-12)


def test_a_nominal_model_has_values_without_sigma():
    klipper = next(one for one in firmwares() if one.name == "klipper")
    source = source_of(ideal_linear())
    assert all(one.sigma is None for one in klipper.values(source))
    (text,) = klipper.files(source).values()
    assert "sigma" not in text


def test_the_command_shows_them(tmp_path):
    (tmp_path / "printer.cfg").write_text(printers.printer_cfg(printers.Settings()))
    (tmp_path / "probed.txt").write_text(printers.console(15))
    kit = tmp_path / "kit"
    run("new", kit, "--printer", tmp_path / "printer.cfg", "--probed", tmp_path / "probed.txt")
    assert run("calibrate", kit).code == 0
    done = run("export", kit / "calibration", "--to", "klipper", "--json")
    document = json.loads(done.out)
    by_name = {one["name"]: one for one in document["values"]}
    assert by_name["delta_radius"]["value"] == pytest.approx(105.4, abs=0.3)
    # heights leave the rods to the nominal model, whose sigma is 0.5 mm
    assert 0.3 < by_name["stepper_a.arm_length"]["sigma"] < 0.5
    assert by_name["stepper_a.angle"]["unit"] == "degrees"
    assert "stepper_c.position_endstop" in run(
        "export", kit / "calibration", "--to", "klipper", "-o", tmp_path / "out"
    ).out  # fmt: skip
    source = load_source(kit / "calibration")
    # a mean of fifteen heights, each to 0.02 mm by default
    assert source.bed_sigma == pytest.approx(20e-6 / np.sqrt(15), rel=0.05)


def weak_session(folder, part):
    """Session of seven heights, and of three distances beside them."""
    (folder / "printer.cfg").write_text(printers.calibrated_cfg())
    more = []
    if part:
        marks = {"m": (0, 0), "a": (60, 0), "b": (-30, 52), "c": (-30, -52)}
        lines = ["unit: mm", "marks:", *(f"  {k}: [{x}, {y}, 0.3]" for k, (x, y) in marks.items())]
        lines += ["distances:", *(f"  - {{between: [m, {k}], apart: 60.1}}" for k in "abc")]
        (folder / "part.yaml").write_text("\n".join(lines) + "\n")
        more = ["--part", folder / "part.yaml"]
    run("new", folder / "kit", "--printer", folder / "printer.cfg", *more)
    return folder / "kit"


@pytest.mark.parametrize("part", [False, True], ids=["heights", "heights and distances"])
def test_values_that_the_nominal_model_decides_are_named(tmp_path, part):
    """In the table, in a finding and in the file; the values that the data determine are not."""
    kit = weak_session(tmp_path, part)
    run("calibrate", kit)
    exported = pkmcal.export(kit / "calibration", "marlin", force=True)
    rods = {"M665 L", "M665 A", "M665 B", "M665 C"}
    by_nominal = {one.name for one in exported.values if one.by_nominal}
    assert by_nominal
    assert by_nominal <= rods
    (finding,) = (one for one in exported.notes if one.code == "export.by_nominal")
    assert finding.level is Level.DOUBTFUL
    assert set(finding.facts["names"]) == by_nominal
    # share of the variance that the prior sigma of 0.5 mm leaves
    least = min(exported.values, key=lambda one: 1.0 if one.data_share is None else one.data_share)
    assert 0 <= least.data_share < 0.5
    (text,) = exported.contents().values()
    first, *lines = text.splitlines()
    assert all(name in first for name in by_nominal)
    named = [line for line in lines if line.startswith("; M665") and "nominal model" in line]
    assert len(named) == len(by_nominal)
    assert {one.name: one.data_share > 0.9 for one in exported.values if "R" in one.name} == {
        "M665 R": True
    }


def test_values_that_the_file_fixes_have_no_share_of_the_data(tmp_path):
    kit = weak_session(tmp_path, part=False)
    mechanism = kit / "mechanism.yaml"
    text = mechanism.read_text()
    assert 'fixed: ["legs' in text
    mechanism.write_text(
        text.replace('fixed: ["legs', 'fixed: ["legs[*].length.constant", "legs', 1)
    )
    run("calibrate", kit)
    values = pkmcal.export(kit / "calibration", "klipper").values
    by_name = {one.name: one for one in values}
    assert by_name["stepper_a.arm_length"].data_share is None
    assert by_name["delta_radius"].data_share > 0.9
    assert not any(one.by_nominal for one in values)
