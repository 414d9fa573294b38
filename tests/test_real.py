"""Real data of other people: every folder of ``tests/real``, whose README says where it is from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

import pkmcal
from pkmcal.cameras.files import load_camera
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.session import write_printer_session
from pkmcal.geometry.rigid import from_roll_pitch_yaw, rotation
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
    assert folders == sorted(cases("camera") + cases("heights") + cases("servo"))
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
