"""Distances on a printed part, typed from its drawing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import distance_sessions
import pkmcal
import printers
from conftest import run
from dialects import Ideal
from pkmcal.calibration.machine_source import MachineSource, load_source
from pkmcal.errors import InputError
from pkmcal.files import parse_yaml, read_csv, validated_document
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.klipper import Klipper
from pkmcal.firmware.part import read_part
from pkmcal.firmware.session import write_printer_session
from pkmcal.mechanisms import MechanismDocument, machine_from_document
from pkmcal.session.load import load_session

SAYS = printers.Settings(radius=105.4, angle=(210.2, 329.9, 90.1), rod=(270.2, 269.9, 270.1))
PART = """\
unit: mm
marks:
  middle: [0, 0, 5]
  a: [60, 10.5, 5]
  b: [-30, 51.9, 6]
distances:
  - {between: [middle, a], outside: 70.0, inside: 51.4}
  - {between: [a, b], apart: 98.7}
"""


@pytest.fixture(scope="module")
def printer(tmp_path_factory):
    path = tmp_path_factory.mktemp("printer") / "printer.cfg"
    path.write_text(printers.printer_cfg(SAYS, printers.workshop(9)))
    return read_printer(path)


def part_of(printer, folder, text):
    (folder / "part.yaml").write_text(text)
    return read_part(folder / "part.yaml", printer)


def test_a_list_whose_only_entry_is_wrong_is_not_too_short(printer, tmp_path):
    """The fault of the entry is named, in its line."""
    text = PART[: PART.index("distances:")] + "distances:\n  - {from: middle, apart: 1}\n"
    with pytest.raises(InputError) as refused:
        part_of(printer, tmp_path, text)
    assert "distances[1]" in refused.value.where


def test_the_carriages_are_those_that_the_firmware_commanded(printer, tmp_path):
    """Spheres about the rods' upper ends meet at the drawing's positions."""
    part = part_of(printer, tmp_path, PART)
    assert part.names == ("middle", "a", "b")
    firmware = Ideal(SAYS.radius, np.array(SAYS.angle), np.array(SAYS.rod), SAYS.homed)
    tool = firmware.tool(part.carriages)
    np.testing.assert_allclose(tool, [[0, 0, 5], [60, 10.5, 5], [-30, 51.9, 6]], atol=1e-9)
    assert part.between.tolist() == [[0, 1], [1, 2]]
    np.testing.assert_allclose(part.distance, [60.7, 98.7])
    assert part.noise is None


def test_shrinkage_is_undone(printer, tmp_path):
    part = part_of(printer, tmp_path, PART + "shrinkage: 0.2 %\nnoise: 0.05\n")
    np.testing.assert_allclose(part.distance, np.array([60.7, 98.7]) / 0.998)
    assert part.noise == 0.05


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("unit: mm\n", "", "part.yaml", "unit"),
        ("unit: mm", "unit: inch", "unit", "inch"),
        ("[a, b]", "[a, c]", "line 8, distances[2].between", "c"),
        ("[a, b]", "[a, a]", "line 8, distances[2].between", "a twice"),
        ("apart: 98.7", "apart: 78.9", "distances[2]", "78.9 mm"),
        ("apart: 98.7", "apart: 98.7, inside: 80", "distances[2]", "apart and inside"),
        ("apart: 98.7", "inside: 98.7", "distances[2]", "inside"),
        (", apart: 98.7", "", "distances[2]", "no number"),
        ("apart: 98.7", "apart: -98.7", "distances[2].apart", "-98.7"),
        (
            "outside: 70.0, inside: 51.4",
            "outside: 51.4, inside: 70",
            "distances[1]",
            "outside 51.4",
        ),
        ("[60, 10.5, 5]", "[600, 10.5, 5]", "part.yaml", "x 600"),
        ("[60, 10.5, 5]", "[60, 10.5]", "marks.a", "3"),
        ("  a: [", "  1a: [", "marks.1a", "a letter first"),
        ("marks:", "features:", "marks", "missing"),
        ("unit: mm", "unit: mm\nshrinkage: 20 %", "shrinkage", "20 %"),
        ("unit: mm", "unit: mm\nnoise: 0", "noise", "0"),
    ],
)
def test_faults_are_named(printer, tmp_path, old, new, line, words):
    assert PART.count(old) == 1
    with pytest.raises(InputError) as caught:
        part_of(printer, tmp_path, PART.replace(old, new))
    assert line in caught.value.where
    assert words in str(caught.value)


def test_the_command_makes_a_session_that_is_calibrated(tmp_path):
    (tmp_path / "printer.cfg").write_text(printers.calibrated_cfg())
    (tmp_path / "part.yaml").write_text(PART)
    kit = tmp_path / "kit"
    done = run("new", kit, "--printer", tmp_path / "printer.cfg", "--part", tmp_path / "part.yaml")
    assert done.code == 0, done.err
    assert "distances.csv" in done.out
    table = read_csv(kit / "joints.csv")
    assert table.names[-3:] == ("middle", "a", "b")
    (links,) = load_session(kit).links
    assert links.by_default
    np.testing.assert_allclose(links.sigma, 30e-6)
    np.testing.assert_allclose(links.value, [0.0607, 0.0987])
    done = run("calibrate", kit)
    checked = pkmcal.check(kit).findings
    assert [one.facts["number"] for one in checked if one.code == "session.links"] == [3]
    # the bed determines how much of their ranges the motors use
    assert not any(one.code == "readings.crowded" for one in checked)
    saved = json.loads((kit / "calibration" / "calibration.json").read_text())
    assert saved["statistics"]["n_links"] == pytest.approx(2, abs=0.5)


@pytest.mark.parametrize("beside", [["--board", "--printer", "printer.cfg"], []])
def test_a_part_is_of_a_printer_beside_heights(tmp_path, beside):
    (tmp_path / "part.yaml").write_text(PART)
    (tmp_path / "printer.cfg").write_text(printers.calibrated_cfg())
    words = [tmp_path / word if word == "printer.cfg" else word for word in beside]
    done = run("new", tmp_path / "kit", *words, "--part", tmp_path / "part.yaml")
    assert done.code == 2
    assert "--part" in done.err or "--printer" in done.err


def prior_machine(rng):
    """A printer off its firmware's values by the prior sigmas of its session."""
    nominal = printers.Settings()
    a = np.deg2rad(nominal.angle)
    towers = nominal.radius * np.column_stack([np.cos(a), np.sin(a), 0 * a])
    towers = 1e-3 * (towers + 2.0 * rng.normal(size=(3, 3)))
    rods = 1e-3 * (270 + 0.5 * rng.normal(size=3))
    legs = [
        {
            "base": {"joint": "slider", "center": c, "axis": [0, 0, 1], "range": [0.1, 0.5487469]},
            "platform": {"joint": "spherical", "center": [0, 0, 0]},
            "length": {"actuated": False, "constant": rod},
        }
        for c, rod in zip(towers.tolist(), rods.tolist(), strict=True)
    ]
    home = {"position": [0.0, 0.0, 0.1]}
    text = json.dumps({"name": "printer", "motion": "translation", "legs": legs, "home": home})
    document = parse_yaml(text, Path("m.yaml"))
    return machine_from_document(validated_document(document, MechanismDocument))


def direction(machine):
    """Direction of the line from the first tower to the second, degrees; the frame's in a gauge."""
    table = machine.parameters
    first, second = (
        np.array([machine.values[table.index(f"legs[{k}].base.center.{c}")] for c in "xy"])
        for k in (1, 2)
    )
    return np.rad2deg(np.arctan2(*(second - first)[::-1]))


@pytest.mark.slow
def test_sigmas_of_a_firmwares_values_hold(tmp_path):
    """Twenty printers, thirteen heights to 0.02 mm, with and without eighteen distances to 0.03 mm:
    errors over standard deviations, and what the distances determine.
    """
    klipper, rng = Klipper(), np.random.default_rng(1)
    z, sigma = {False: [], True: []}, {False: [], True: []}
    for k in range(20):
        true, folder = prior_machine(rng), tmp_path / str(k)
        folder.mkdir()
        readings = printers.felt(true, printers.bed(13), 0.02, rng)
        (folder / "printer.cfg").write_text(printers.printer_cfg(printers.Settings(), readings))
        (folder / "part.yaml").write_text(
            distance_sessions.part(true, rng, printers.Settings(), 0.03)
        )
        exact = klipper.values(MachineSource(true, bed=0.0))
        for beside in (False, True):
            kit = folder / f"kit-{beside}"
            part = folder / "part.yaml" if beside else None
            write_printer_session(kit, folder / "printer.cfg", part=part)
            result = pkmcal.calibrate(kit)
            result.save(kit / "calibration")
            source = load_source(kit / "calibration")
            turn = direction(source.machine) - direction(true)
            values = klipper.values(source)
            z[beside].append(
                [
                    (one.value - right.value - turn * (one.unit == "degrees")) / one.sigma
                    for one, right in zip(values, exact, strict=True)
                ]
            )
            sigma[beside].append({one.name: one.sigma for one in values})
    for beside in (False, True):
        every = np.array(z[beside])
        # ten values, of which some are correlated
        assert np.mean(every**2) == pytest.approx(1, abs=4 * np.sqrt(2 / 20 / 4))
        assert np.mean(np.abs(every) < 2) > 0.9
    rods = [
        np.mean([row[f"stepper_{s}.arm_length"] for row in sigma[beside] for s in "abc"])
        for beside in (False, True)
    ]
    assert rods[1] < 0.7 * rods[0]
