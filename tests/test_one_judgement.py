"""check and calibrate are one judgement: what calibrate refuses is a finding of check, word for
word, and a session in which check finds nothing wrong is calibrated.
"""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from conftest import run
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.checks.check import check_session
from pkmcal.errors import PkmcalError
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome import Level
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.simulation import Settings
from rendered import rendered
from test_bad_input import only

BY_HAND = """\
pkmcal: 1
mechanism: gough-stewart
joints: {file: joints.csv, noise: 1.0e-5}
stations:
  phone:
    camera: camera.yaml
    images: "images/{configuration}-{repeat}.png"
    observe: legs
    handheld: true
"""
CAMERA = "model: pinhole\nimage_size: [160, 120]\nfocal: [140.0, 140.0]\ncenter: [79.5, 59.5]\n"
JOINTS = "configuration,leg1,leg2,leg3,leg4,leg5,leg6\n01,0.41,0.37,0.41,0.37,0.41,0.37\n" \
    "02,0.46,0.41,0.46,0.41,0.46,0.41\n"  # fmt: skip


def lines_alone(folder):
    """Two hand-held images of lines, without a machine."""
    (folder / "images").mkdir(parents=True)
    (folder / "session.yaml").write_text(BY_HAND)
    (folder / "camera.yaml").write_text(CAMERA)
    (folder / "joints.csv").write_text(JOINTS)
    rng = np.random.default_rng(3)
    for name in ("01-1", "02-1"):
        picture = np.full((120, 160), 90, np.uint8)
        for x, y, u, v in rng.integers(0, 120, (12, 4)).tolist():
            cv2.line(picture, (x, y), (u, v), int(rng.integers(150, 250)), 3, cv2.LINE_AA)
        cv2.imwrite(str(folder / "images" / f"{name}.png"), picture)
    return folder


def exchanged_stations(session):
    """The images of two stations exchanged."""
    one, other = (session / "images" / name for name in ("station1", "station2"))
    names = sorted(path.name for path in one.iterdir()), sorted(p.name for p in other.iterdir())
    for first, second in zip(*names, strict=True):
        a, b = (one / first).read_bytes(), (other / second).read_bytes()
        (one / first).write_bytes(b)
        (other / second).write_bytes(a)
    return session


def one_black(session):
    """One image without any content."""
    path = min((session / "images" / "station1").iterdir())
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(path), np.zeros_like(picture))
    return session


def readings_of_another(session):
    """Two columns of the readings exchanged."""
    path = session / "joints.csv"
    head, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    rows = [",".join([c[0], c[2], c[1], *c[3:]]) for c in cells]
    path.write_text("\n".join([head, *rows]) + "\n")
    return session


def calibrated_code(folder):
    """Exit code of `calibrate`, and its error."""
    try:
        return (0 if calibrate_session(folder).verdict.usable else 1), None
    except PkmcalError as error:
        return error.exit_code, str(error)


def hold_together(value, code, message):
    """The verdict of one command implies the other's."""
    assert (value.exit_code == 2) == (code == 2)
    refused = [f.text for f in value.findings if f.error is not None]
    assert refused == [message] if message else not refused


def test_a_good_session(checked, calibrating):
    assert calibrating.result.verdict.usable
    hold_together(checked.result, 0, None)


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(exchanged_stations, marks=pytest.mark.slow),
        one_black,
        pytest.param(readings_of_another, marks=pytest.mark.slow),
    ],
)
def test_a_spoilt_session(session, spoil):
    spoil(session)
    if spoil is one_black:
        only(session, "station1")
    check = check_session(session)
    hold_together(check, *calibrated_code(session))


@pytest.mark.slow
def test_images_by_hand_without_a_machine(tmp_path):
    """Both are refused, with one finding; `check` once accepted it."""
    folder = lines_alone(tmp_path / "session")
    done, other = run("check", folder, "--json"), run("calibrate", folder, "--json")
    assert done.code == other.code == 2
    assert done.json["message"] == other.json["message"]
    assert done.json["what"] == "the machine was localized in none of the hand-held images"
    (wrong,) = [f for f in done.json["findings"] if f["level"] == Level.WRONG]
    assert wrong["text"] == other.json["message"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_images_by_hand(tmp_path, seed):
    """Rejected images are the same in both, with the same reason."""
    folder = tmp_path / "session"
    settings = Settings(configurations=3, repeats=2, handheld=True)
    machine = load_mechanism("gough-stewart")
    rendered(folder, machine, camera_of_size((640, 480)), settings, seed=seed)
    path = min((folder / "images").rglob("*.jpg"))
    shutil.copy(max((folder / "images").rglob("*.jpg")), path)  # it shows another configuration
    check = check_session(folder)
    try:
        result = calibrate_session(folder)
    except PkmcalError as error:
        hold_together(check, error.exit_code, str(error))
        return
    hold_together(check, 0 if result.verdict.usable else 1, None)
    lost = {one.station.name: one.finding.text for one in result.session.rejected}
    assert {f.station: f.text for f in check.findings if f.station in lost} == lost
    assert {s.name for s in check.stations if not s.recognised} == lost.keys()
