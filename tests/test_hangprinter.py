"""Hangprinters: RepRapFirmware's M669 K6 and M666, read, written and compared with its formulas."""

from __future__ import annotations

import re

import numpy as np
import pytest

from export_sources import source_of
from hangprinters import CONFIG, machine_of
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.geometry.rigid import pose
from pkmcal.mechanisms import load_mechanism
from pkmcal.simulation.truth import true_machine


def firmware_steps(text, points, microsteps=16):
    """Motor steps at points (n, 3) mm, as CartesianToMotorSteps has them for a mover without
    weight, and steps of one turn of each motor.
    """
    m669, m666 = (re.search(rf"^{code} (.*)$", text, re.MULTILINE)[1] for code in ("M669", "M666"))
    anchors = [re.search(rf"\b{c}([-\d.:]+)", m669.replace("K6", ""))[1] for c in "ABCD"]
    anchors = np.array([[float(x) for x in a.split(":")] for a in anchors])

    def of(letter):
        return np.array([float(x) for x in re.search(rf"\b{letter}([\d.:]+)", m666)[1].split(":")])

    full_steps = of("J") if " J" in m666 else np.full(4, 25.0)
    times_r = of("U") * full_steps * microsteps * of("H") / (2 * np.pi * of("L"))
    k2 = -of("U") * of("O") * of("Q")
    k0 = 2 * times_r / k2
    position = np.linalg.norm(points[:, None] - anchors, axis=-1) - np.linalg.norm(anchors, axis=-1)
    return k0 * (np.sqrt(of("R") ** 2 + position * k2) - of("R")), full_steps * microsteps


def poses_at(points):
    return pose(np.broadcast_to(np.eye(3), (len(points), 3, 3)), 1e-3 * points)


def some_points(seed=0):
    return np.random.default_rng(seed).uniform([-500, -500, 0], [500, 500, 1500], (50, 3))


def test_readings_are_the_firmwares_turns(tmp_path):
    machine, points = machine_of(CONFIG, tmp_path), some_points()
    steps, a_turn = firmware_steps(CONFIG, points)
    turns = machine.inverse(poses_at(points)) - machine.inverse(poses_at(np.zeros((1, 3))))
    # offsets are written to a micrometre
    np.testing.assert_allclose(turns, 2 * np.pi * steps / a_turn, atol=1e-3)


def test_twenty_calibrated_machines_go_where_the_firmware_goes(tmp_path):
    """Anchors and spools off by their prior sigmas; what is written puts the firmware's motors to
    within 2 µm of line.
    """
    nominal, rng = machine_of(CONFIG, tmp_path), np.random.default_rng(1)
    points = some_points(2)
    for _ in range(20):
        machine = true_machine(nominal, 1.0, rng)
        export = make_export(source_of(machine), "hangprinter")
        steps, a_turn = firmware_steps(export.files["hangprinter.g"], points)
        turns = machine.inverse(poses_at(points)) - machine.inverse(poses_at(np.zeros((1, 3))))
        # 75 mm of spool, geared 12.75, for two lines or four
        line = 0.075 / 12.75 / 2 * (turns - 2 * np.pi * steps / a_turn)
        assert np.abs(line).max() < 2e-6


def test_written_and_read_again(tmp_path):
    text = make_export(source_of(machine_of(CONFIG, tmp_path)), "hangprinter").files
    again = machine_of(text["hangprinter.g"], tmp_path)
    first = machine_of(CONFIG, tmp_path)
    np.testing.assert_allclose(again.values, first.values, atol=2e-6)


def test_spools_without_build_up_are_not_written(tmp_path):
    """The firmware divides by Q: its motors would stand still."""
    machine = machine_of(CONFIG.replace("Q0.038", "Q0"), tmp_path)
    with pytest.raises(InputError) as caught:
        make_export(source_of(machine), "hangprinter")
    assert caught.value.found == "a spool without build-up"


def test_lines_without_spools_are_read_as_positions(tmp_path):
    machine = machine_of(CONFIG.partition("M666")[0], tmp_path)
    assert set(machine.joint_units) == {"m"}
    np.testing.assert_allclose(machine.inverse(poses_at(np.zeros((1, 3)))), 0.0, atol=1e-6)
    export = make_export(source_of(machine), "hangprinter")
    assert "M666" not in "".join(
        line for line in export.files["hangprinter.g"].splitlines() if not line.startswith(";")
    )


@pytest.mark.parametrize(
    "text",
    [
        "M669 K6\n",
        CONFIG.replace(" N4", "").replace("C-1415.75:707.5:-121.75", ""),
        CONFIG.replace("C-1415.75:707.5:-121.75", "C-1415.75:707.5"),
        CONFIG.replace("R75.1:74.9:75.2:75.05", "R75.1:74.9"),
        CONFIG.replace("R75.1", "R-75.1"),
        CONFIG.replace(" U2:2:2:4", ""),
    ],
)
def test_configurations_without_what_is_needed(tmp_path, text):
    with pytest.raises(InputError):
        machine_of(text, tmp_path)


METRES = "M669 K6 A0:-1.61:-0.13 B1.29:1.13:-0.15 C-1.41:0.7:-0.12 D0:0:1.9\n"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (CONFIG.replace("R75.1:", "R75,1:"), "'75,1:"),
        (METRES, "1.9"),
        (CONFIG.replace("N4", "N5"), "N5"),
        (CONFIG.replace("D18.25:-0.25:2299.5", "D0:0:0"), "0, 0, 0 mm"),
        (CONFIG.replace("Q0.038", "Q-0.05"), "'-0.05'"),
        (CONFIG.replace("-131.5 ", "-131,5mm "), "'mm'"),
    ],
    ids=["decimal comma", "metres", "number of anchors", "no line", "build-up", "unit"],
)
def test_the_wrong_value_is_named(tmp_path, text, found):
    with pytest.raises(InputError) as refused:
        machine_of(text, tmp_path)
    assert str(refused.value.found).startswith(found)


@pytest.mark.parametrize("name", ["linear-delta", "gough-stewart", "four-belt"])
def test_other_machines_are_no_hangprinters(name):
    with pytest.raises(InputError):
        make_export(source_of(load_mechanism(name)), "hangprinter")
