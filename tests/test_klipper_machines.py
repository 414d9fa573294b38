"""Sessions of Klipper's rotary deltas and winches, from their configuration."""

from __future__ import annotations

import re

import numpy as np
import pytest

import pkmcal
from conftest import run
from export_sources import source_of
from pkmcal.errors import InputError
from pkmcal.exporters.contract import make_export
from pkmcal.geometry.rigid import pose
from pkmcal.mechanisms import load_mechanism

ARMS, RODS = (170.0, 170.5, 169.5), (320.0, 321.0, 319.0)
ANGLES, ENDS = (30.0, 151.0, 269.0), (250.0, 251.0, 252.0)
RADIUS, HEIGHT = 33.9, 412.9
ROTARY = f"""\
[printer]
kinematics: rotary_delta
shoulder_radius: {RADIUS}
shoulder_height: {HEIGHT}
""" + "".join(
    f"[stepper_{s}]\ngear_ratio: 107:16, 60:16\nupper_arm_length: {ARMS[k]}\n"
    f"lower_arm_length: {RODS[k]}\nangle: {ANGLES[k]}\nposition_endstop: {ENDS[k]}\n"
    for k, s in enumerate("abc")
)
ANCHORS = [(0, -2000, -100), (2000, 1000, -100), (-2000, 1000, -100), (0, 0, 3000)]
WINCH = "[printer]\nkinematics: winch\n" + "".join(
    f"[stepper_{s}]\nrotation_distance: 40\nmicrosteps: 16\n"
    + "".join(f"anchor_{c}: {value}\n" for c, value in zip("xyz", anchor, strict=True))
    for s, anchor in zip("abcd", ANCHORS, strict=True)
)


def model(text, folder):
    """The machine of a session made from a configuration."""
    (folder / "printer.cfg").write_text(text)
    texts = pkmcal.new(from_file=folder / "printer.cfg").texts
    (folder / "mechanism.yaml").write_text(texts["mechanism.yaml"])
    return load_mechanism(folder / "mechanism.yaml"), texts


def elbows(degrees):
    """Elbows (3, 3) mm of arms at angles above the horizontal."""
    a, up = np.deg2rad(ANGLES), np.deg2rad(degrees)
    out = RADIUS + np.array(ARMS) * np.cos(up)
    return np.column_stack([out * np.cos(a), out * np.sin(a), HEIGHT + np.array(ARMS) * np.sin(up)])


def test_arms_are_where_klipper_has_them(tmp_path):
    """Every rod has its length between the nozzle and the elbow at the model's reading; the file
    has micrometres.
    """
    machine, texts = model(ROTARY, tmp_path)
    points = np.array([[0, 0, 0], [60, -30, 20], [-50, 80, 100], [10, -20, 200.0]])
    readings = np.rad2deg(machine.inverse(pose(np.eye(3), 1e-3 * points)))
    for point, degrees in zip(points, readings, strict=True):
        rods = np.linalg.norm(elbows(degrees) - point, axis=1)
        np.testing.assert_allclose(rods, RODS, atol=1e-3)
    # a range ends where the arm's switch triggers: the nozzle on the axis at position_endstop
    ends = np.rad2deg(machine.joint_ranges[:, 1])
    for k, height in enumerate(ENDS):
        assert np.linalg.norm(elbows(ends)[k] - [0, 0, height]) == pytest.approx(RODS[k], abs=1e-3)
    assert "board.yaml" in texts


def test_a_rotary_delta_is_written_back(tmp_path):
    machine, _ = model(ROTARY, tmp_path)
    (text,) = make_export(source_of(machine), "klipper").files.values()
    values = dict(line.split(": ") for line in text.splitlines() if line[:1].islower())
    assert float(values["shoulder_radius"]) == pytest.approx(RADIUS, abs=1e-3)
    assert float(values["shoulder_height"]) == pytest.approx(HEIGHT, abs=1e-3)
    # of the three steppers' values, the last one's
    assert float(values["upper_arm_length"]) == pytest.approx(ARMS[2], abs=1e-3)
    assert float(values["lower_arm_length"]) == pytest.approx(RODS[2], abs=1e-3)
    assert float(values["angle"]) == pytest.approx(ANGLES[2], abs=1e-3)
    assert float(values["position_endstop"]) == pytest.approx(ENDS[2], abs=1e-2)


def test_defaults_and_includes_of_a_rotary_delta(tmp_path):
    """Arms b and c default to a, and the directions to Klipper's."""
    stepper = "[stepper_a]\nupper_arm_length: 170\nlower_arm_length: 320\nposition_endstop: 252\n"
    (tmp_path / "a.cfg").write_text(stepper)
    head = ROTARY.partition("[stepper_a]")[0]
    machine, _ = model("[include a.cfg]\n" + head, tmp_path)
    centers = [leg.base.center for leg in machine.document.legs]
    a = np.deg2rad([30, 150, 270])
    want = 1e-3 * np.column_stack([RADIUS * np.cos(a), RADIUS * np.sin(a), 3 * [HEIGHT]])
    np.testing.assert_allclose(centers, want, atol=1e-6)


def test_anchors_in_metres_are_named(tmp_path):
    text = WINCH
    for x in {abs(value) for anchor in ANCHORS for value in anchor} - {0}:
        text = text.replace(f"{x}\n", f"{x / 1000}\n")
    with pytest.raises(InputError) as caught:
        model(text, tmp_path)
    assert "3 mm" in caught.value.found
    assert "1000" in caught.value.next_step


def test_a_winchs_cables_lead_to_the_nozzle(tmp_path):
    machine, texts = model(WINCH, tmp_path)
    points = np.array([[0, 0, 0], [300, -200, 500.0], [-400, 100, 50]])
    lengths = 1e3 * machine.inverse(pose(np.eye(3), 1e-3 * points))
    want = np.linalg.norm(np.array(ANCHORS) - points[:, None], axis=-1)
    np.testing.assert_allclose(lengths, want, atol=1e-6)
    # four lengths of three degrees of freedom need no camera
    assert "cameras/front.yaml" not in texts
    three, texts = model(WINCH.partition("[stepper_d]")[0], tmp_path)
    assert (three.n_joints, "board.yaml" in texts) == (3, True)


WRONG = {
    "[printer]\nkinematics: deltesian\n": "a deltesian",
    "[printer]\nkinematics: delta\n": "--printer FILE",
    "[printer]\nkinematics: corexy\n": "not those of a parallel machine",
    "[printer]\n": "not those of a parallel machine",
    ROTARY.replace("shoulder_radius", "#"): "missing: shoulder_radius",
    ROTARY.replace("lower_arm_length: 320", "lower_arm_length: 20"): "do not reach",
    ROTARY.replace("position_endstop: 250", "position_endstop: 2500"): "do not reach",
    ROTARY.replace("position_endstop: 250", "position_endstop: -10"): "do not reach",
    WINCH.replace("anchor_z: 3000", "anchor_z: 60000"): "no lengths of a machine in mm",
    WINCH.replace("anchor_z: 3000", "anchor_z: 0"): "no length with the tool in the origin",
    WINCH.replace("anchor_z: 3000", ""): "missing: anchor_z",
    re.sub(r"(_(?:radius|height|length|endstop): )(\d+)", r"\g<1>0.\2", ROTARY): "in mm",
    re.sub(r"shoulder_height: \d+", "shoulder_height: 4", ROTARY): "do not reach the platform",
    WINCH.partition("[stepper_d]")[0].replace("anchor_z: -100", "anchor_z: 0"): "singular",
}


@pytest.mark.parametrize("text", WRONG, ids=WRONG.values())
def test_machines_that_cannot_be_described(text, tmp_path):
    (tmp_path / "printer.cfg").write_text(text)
    done = run("new", tmp_path / "kit", "--from", tmp_path / "printer.cfg")
    assert done.code == 2
    assert WRONG[text] in " ".join(done.err.split())


@pytest.mark.parametrize("given", [{"leg": 0.3}, {"unit": "mm"}])
def test_a_configuration_has_all_dimensions(given, tmp_path):
    (tmp_path / "printer.cfg").write_text(ROTARY)
    with pytest.raises(InputError) as refused:
        pkmcal.new(from_file=tmp_path / "printer.cfg", **given)
    assert refused.value.where == "--from"
    assert refused.value.found == "--" + next(iter(given))


def test_a_printers_option_names_the_other(tmp_path):
    (tmp_path / "printer.cfg").write_text(ROTARY)
    done = run("new", tmp_path / "kit", "--printer", tmp_path / "printer.cfg")
    assert done.code == 2
    assert "--from" in done.err
