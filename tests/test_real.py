"""Real data of other people: every folder of ``tests/real``, whose README says where it is from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

import pkmcal
from pkmcal.cameras.files import load_camera
from pkmcal.files import parse_yaml, validated_document
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.session import write_printer_session
from pkmcal.geometry.rigid import from_roll_pitch_yaw, rotation
from pkmcal.mechanisms import MechanismDocument, checked_machine
from pkmcal.starter.families import family_model

REAL = Path(__file__).with_name("real")
CASES = {path.parent.name: yaml.safe_load(path.read_text()) for path in REAL.glob("*/case.yaml")}
PIXEL_ROUNDING = 1e-4
"""px, of the pixels in the case files."""
CENTRE_ROUNDING = 1e-3
"""mm, of the joint centres in a nominal model's file."""
MAP_ROUNDING = 6e-4
"""mm, of the mean and the standard deviation that RepRapFirmware prints."""


def cases(kind):
    """Names of the cases of a kind."""
    return sorted(name for name, case in CASES.items() if case["kind"] == kind)


def test_every_case_has_a_kind_and_its_origin():
    origins = (REAL / "README.md").read_text()
    folders = sorted(path.name for path in REAL.iterdir() if path.is_dir())
    kinds = ("camera", "heights", "joint_centres", "printer", "servo")
    assert folders == sorted(name for kind in kinds for name in cases(kind))
    assert all(f"| `{name}` |" in origins for name in folders)


@pytest.mark.parametrize("name", cases("camera"))
def test_cameras_project_as_the_numbers_of_their_files(name):
    """Against pixels that OpenCV computed from the same numbers."""
    case = CASES[name]
    camera = load_camera(REAL / name / case["file"])
    points = np.array(case["points"])
    assert camera.model == case["model"]
    np.testing.assert_allclose(camera.project(points[:, :3]), points[:, 3:], atol=PIXEL_ROUNDING)


@pytest.mark.parametrize("name", cases("heights"))
def test_probed_beds_of_printers(name, tmp_path):
    """The verdict, and no finding but those that a person judged to be right."""
    case = CASES[name]
    path = REAL / name / case["file"]
    printer = read_printer(path)
    assert printer.radius == case["radius"]
    np.testing.assert_array_equal(printer.rod, case["rod"])
    probed = REAL / name / case["probed"] if "probed" in case else None
    write_printer_session(tmp_path / "session", path, probed)
    session = pkmcal.load_session(tmp_path / "session")
    z = 1e3 * session.machine.forward(session.joints)[:, 2, 3]
    if probed is not None:  # RepRapFirmware's own statistics of its map
        assert z.mean() == pytest.approx(case["mean"], abs=MAP_ROUNDING)
        assert z.std() == pytest.approx(case["deviation"], abs=MAP_ROUNDING)
    check = pkmcal.check(tmp_path / "session")
    result = pkmcal.calibrate(tmp_path / "session")
    assert len(result.heights) == case["points"]
    assert result.verdict.usable == case["usable"]
    assert {*(one.code for one in check.findings), *result.verdict.codes} == {*case["codes"]}


@pytest.mark.parametrize("name", cases("servo"))
def test_servo_hexapods_of_few_numbers_move_as_by_their_owners_code(name):
    """Home, and the angles of the arms at poses, which owners computed in other ways."""
    case = CASES[name]
    numbers = {
        key: np.deg2rad(value) if key == "arm_angle" else value / 1e3
        for key, value in case["numbers"].items()
    }
    machine = family_model("rotary-hexapod", numbers).machine()
    if "home" in case:
        assert 1e3 * machine.home()[2, 3] == pytest.approx(case["home"], abs=CENTRE_ROUNDING)
    pair = rotation([0, 0, np.deg2rad(case["pair"])])
    for pose_at, angles in zip(case["poses"], case["angles"], strict=True):
        T = np.eye(4)
        T[:3, :3] = pair.T @ from_roll_pitch_yaw(np.deg2rad(pose_at[3:])) @ pair
        T[:3, 3] = pair.T @ np.add(pose_at[:3], [0, 0, case["height"]]) / 1e3
        ours = np.rad2deg(machine.inverse(T[None])[0])[np.array(case["legs"]) - 1]
        rounding = np.rad2deg(CENTRE_ROUNDING / case["numbers"]["arm"])
        np.testing.assert_allclose(ours, angles, atol=rounding)


@pytest.mark.parametrize("name", cases("joint_centres"))
def test_hexapods_have_their_files_joint_centres(name):
    """Home, and the legs' lengths at poses, as distances of the file's centres."""
    case = CASES[name]
    unit = {"inch": 0.0254, "mm": 1e-3}[case["unit"]]
    options = {"from_file": REAL / name / case["file"], "unit": case["unit"]}
    text = pkmcal.new(**options, leg=case["leg"] * unit).texts["mechanism.yaml"]
    document = parse_yaml(text, Path("mechanism.yaml"))
    machine = checked_machine(validated_document(document, MechanismDocument), document)
    home = machine.home()
    np.testing.assert_allclose(home[:3, 3] / unit, [0, 0, case["home"]], atol=1e-4)
    for pose_at, legs in zip(case["poses"], case["legs"], strict=True):
        T = np.eye(4)
        T[:3, :3] = from_roll_pitch_yaw(np.deg2rad(pose_at[3:]))
        T[:3, 3] = unit * np.array(pose_at[:3])
        ends = machine.ends_at(machine.inverse(T[None])[0], T)
        np.testing.assert_allclose(
            np.linalg.norm(ends.b - ends.a, axis=1) / unit, legs, atol=CENTRE_ROUNDING / 25.4 * 4
        )


@pytest.mark.parametrize("name", cases("printer"))
def test_printers_have_their_firmwares_numbers(name):
    """Also the carriages at points, and at home, by the firmware's own formulas."""
    case = CASES[name]
    printer = read_printer(REAL / name / case["file"])
    assert type(printer.firmware).__name__ == case["firmware"]
    # towers with radii of their own are on one circle, which no file states
    assert printer.radius == pytest.approx(case["radius"], abs=1e-9)
    np.testing.assert_array_equal(printer.rod, case["rod"])
    np.testing.assert_allclose(printer.angle, case["angle"], atol=1e-9)
    np.testing.assert_allclose(printer.homed, case["homed"], atol=1e-6)
    assert (None if printer.steps is None else printer.steps.tolist()) == case["steps"]
    carriages = printer.carriages(np.array(case["points"], dtype=float))
    np.testing.assert_allclose(carriages, case["carriages"], atol=1e-6)
