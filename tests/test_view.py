"""The pages of `view`: access, responses, written files, results and folders, and browsers."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

import pkmcal
from browsers import DARK, FRAME, SOFTWARE, PageParts, browse
from conftest import run
from fuzz.run import listing
from page_documents import page_document
from pkmcal.cameras.files import camera_text
from pkmcal.errors import InputError
from pkmcal.files import read_yaml
from pkmcal.geometry.rigid import (
    apply,
    inverse,
    look_at,
    perturb,
    pose,
    pose_difference,
    rotation,
)
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.session.load import load_session
from pkmcal.simulation import load_truth
from pkmcal.viewing.content import SessionContent
from pkmcal.viewing.pose_file import PoseFile
from pkmcal.viewing.server import session_document, session_routes
from pkmcal.viewing.sources import MOST_ENTRIES
from pkmcal.web import serving
from pkmcal.web.bundle_files import SCRIPT_FILE, bundle_file
from pkmcal.web.page import DOCUMENT_START, PAGE_MARK
from rendered import BOARD_SESSION, by_command
from served_pages import PORT, TOKEN, ServedPage
from test_report_page import HOSTILE


class Page(ServedPage):
    """A session's page, and its questions."""

    def __init__(self, folder, calibration=None, fewest=2):
        self.subject = SessionContent(load_session(folder, fewest=fewest), calibration)
        routes = session_routes(self.subject, lambda: session_document(self.subject))
        self.app = serving.application(routes, TOKEN, PORT)

    def post(self, what, content=None, **body):
        text = json.dumps({"station": 0, "image": 0, **body}).encode()
        return self.request(f"/{TOKEN}/{what}", text if content is None else content)

    def ask(self, what, **body):
        answer = self.post(what, **body)
        assert answer.status == 200, answer.text
        return answer.json()


@pytest.fixture(scope="module")
def page(demo):
    return Page(demo.session, demo.calibration)


@pytest.fixture(scope="module")
def truth(demo, page):
    return load_truth(demo.session, page.subject.session.machine)


# ------------------------------------------------------------------ access


def test_the_page_opens_with_its_token(page):
    answer = page.get()
    assert answer.status == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert page.get(host=f"localhost:{PORT}").status == 200
    assert page.get(origin=f"http://127.0.0.1:{PORT}").status == 200


@pytest.mark.parametrize(
    "path", ["", "viewer.js", "image/0/0", "thumbnail/0/0", "stage", "nowhere"]
)
@pytest.mark.parametrize("token", ["", "the-toke", "the-tokens", "é"])
def test_without_the_token_nothing_is_reported(page, path, token):
    answer = page.get(path, token)
    assert answer.status == 403
    assert answer.text == (
        "This page opens with the whole address that pkmcal printed, token included.\n"
    )


@pytest.mark.parametrize(
    "headers",
    [
        {"host": "example.org"},
        {"host": f"example.org:{PORT}"},
        {"host": "127.0.0.1:80"},
        {"origin": "http://example.org"},
        {"origin": "null"},
    ],
)
def test_a_page_of_somebody_else_is_refused(page, headers):
    assert page.get(**headers).status == 403
    query = b'{"station": 0, "image": 0}'
    assert page.request(f"/{TOKEN}/save", query, **headers).status == 403


def test_sockets_are_refused(page):
    assert page.request(f"/{TOKEN}/", kind="websocket").status == 403


def test_the_page_asks_for_nothing_outside(page):
    text = page.get().text
    for tag, attributes in PageParts(text).tags:
        assert tag not in ("iframe", "object", "embed", "base")
        for name in ("src", "href"):
            assert attributes.get(name) in (None, "data:,", "viewer.js", "viewer.css")
    assert not re.search(r"\bon[a-z]+=|<style|style=", text)  # which the policy would block


# ------------------------------------------------------------------ what is shown


def test_all_images_are_named(page, demo):
    text = PageParts(page.get().text).text
    session = page.subject.session
    assert all(name in text for name in (*session.configurations, *session.station_names))


def test_an_image_is_sent(page):
    image = cv2.imdecode(np.frombuffer(page.get("image/1/2").content, np.uint8), 0)
    assert image.shape[::-1] == page.subject.station(1).camera.image_size
    assert np.abs(image.astype(int) - page.subject.image(1, 2)).mean() < 1


def test_nothing_is_decoded_before_it_is_looked_at(demo):
    opened = Page(demo.session)
    opened.get()
    opened.get("image/0/1")
    opened.ask("overlay", image=1)
    assert opened.subject.image.cache_info().misses == 1


def test_a_thumbnail_is_small_and_upright(page, session):
    size = page.subject.station(0).camera.image_size
    image = cv2.imdecode(np.frombuffer(page.get("thumbnail/0/0").content, np.uint8), 0)
    assert image.shape[1] < size[0] / 2
    path = load_session(session).stations[0].images[0].path
    with Image.open(path) as picture:
        exif = picture.getexif()
        exif[0x0112] = 6  # to be turned clockwise
        picture.save(path, exif=exif)
    turned = Page(session)
    (first, *_), *_ = (s["images"] for s in page_document(turned.get().text)["stations"])
    assert first["quarter_turns"] == 1
    small = cv2.imdecode(np.frombuffer(turned.get("thumbnail/0/0").content, np.uint8), 0)
    assert small.shape[0] > small.shape[1]
    corner = image[: image.shape[0] // 3, : image.shape[1] // 3].mean()
    other = small[: small.shape[0] // 3, -(small.shape[1] // 3) :].mean()
    assert other == pytest.approx(corner, abs=8)


def test_faults_are_reported_in_words(page, session):
    (session / "images" / "station1").mkdir(exist_ok=True)
    broken = load_session(session).stations[0].images[0].path
    broken.write_bytes(broken.read_bytes()[:-40])
    answer = Page(session).get("image/0/0")
    assert answer.status == 422
    assert answer.json()["code"] == "image.damaged"
    assert answer.json()["where"] == broken.relative_to(session).as_posix()
    assert page.get("image/0/99").json()["found"] == "100"
    for body, words in (
        ({"station": 9}, "there is no such station"),
        ({"pose": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "no rotation"),
        ({"gesture": {"kind": "jump", "start": [0, 0], "end": [1, 1]}}, "gesture.kind"),
        ({"pose": 7}, "the page, pose"),
        ({"pins": [{"image": 0, "end": "base", "leg": 7, "pixel": [1, 2]}]}, "pins[1]"),
    ):
        answer = page.post("overlay", **body)
        assert answer.status == 422
        assert words in answer.json()["message"]
    assert "not valid JSON" in page.post("localize", b"{").json()["message"]
    assert "no JSON object" in page.post("localize", b"[]").json()["message"]


def test_a_defect_is_reported_as_one(page, monkeypatch):
    monkeypatch.setattr(SessionContent, "jpeg", lambda *_: 1 / 0)
    answer = page.get("image/0/0")
    assert answer.status == 500
    assert "a defect of pkmcal" in answer.json()["message"]


def test_the_overlay_is_where_the_machine_is(page, truth):
    """At the true pose, the joints are at their pixels."""
    T = truth.T_camera_base[0]
    answer = page.ask("overlay", pose=T.tolist())
    pane = page.subject.nominal(0, 0)
    for joint in answer["joints"]:
        point = pane.points[("base", "platform").index(joint["end"]), joint["leg"] - 1]
        np.testing.assert_allclose(joint["at"], pane.camera.project(apply(T, point)), atol=0.051)
    (machine,) = (layer for layer in answer["layers"] if layer["name"] == "machine")
    assert {shape["key"] for shape in machine["shapes"]} == {f"leg:{n}" for n in range(1, 7)}
    assert len(answer["joints"]) == 12


def test_a_joint_comes_to_where_it_is_pulled(page):
    """One joint, then another in a second image: both stay pinned."""
    first = {"image": 0, "end": "platform", "leg": 2, "pixel": [300, 200]}
    answer = page.ask("overlay", pins=[first])
    shifted = next(j for j in answer["joints"] if (j["end"], j["leg"]) == ("platform", 2))
    assert shifted["at"] == [300, 200]
    base = page.ask("overlay", image=1, pose=answer["pose"])["joints"]
    other = next(j for j in base if (j["end"], j["leg"]) == ("base", 5))
    second = {
        "image": 1,
        "end": "base",
        "leg": 5,
        "pixel": [other["at"][0] + 20, other["at"][1] - 9],
    }
    answer = page.ask("overlay", pose=answer["pose"], pins=[first, second])
    for image, pin in ((0, first), (1, second)):
        joints = page.ask("overlay", image=image, pose=answer["pose"])["joints"]
        at = next(j for j in joints if (j["end"], j["leg"]) == (pin["end"], pin["leg"]))
        np.testing.assert_allclose(at["at"], pin["pixel"], atol=0.051)


@pytest.mark.parametrize("kind", ["aim", "turn", "roll", "distance"])
def test_every_gesture_moves_the_machine(page, kind):
    before = page.ask("overlay")
    gesture = {"kind": kind, "start": [200, 150], "end": [230, 160], "factor": 1.1}
    after = page.ask("overlay", pose=before["pose"], gesture=gesture)
    assert np.abs(np.subtract(after["pose"], before["pose"])).max() > 0.01


def test_a_station_without_a_pose_begins_with_the_machine_in_the_picture(session):
    text = (session / "session.yaml").read_text()
    bare = re.sub(r"\n    pose:(\n      .*)+", "", text)
    assert bare != text
    (session / "session.yaml").write_text(bare)
    opened = Page(session)
    assert opened.subject.station(0).T_camera_base is None
    assert len(opened.ask("overlay")["joints"]) == 12


def test_no_pose_is_too_odd(page):
    """Cameras among the legs, behind the machine, kilometres away: lines and words, no warnings."""
    rng = np.random.default_rng(0)
    for away in (0.0, 0.01, 0.3, 1.0, 1e6):
        for _ in range(4):
            T = pose(rotation(2 * rng.normal(size=3)), away * rng.normal(size=3)).tolist()
            start, end = rng.uniform(-800, 1600, (2, 2)).tolist()
            pin = {"image": 0, "end": "base", "leg": 3, "pixel": end}
            for more in (
                {},
                {"gesture": {"kind": "turn", "start": start, "end": end}},
                {"pins": [pin, {**pin, "leg": 4, "pixel": start}]},
            ):
                assert np.isfinite(page.ask("overlay", pose=T, **more)["pose"]).all()
            assert page.ask("edges", pose=T)["texts"]


# ------------------------------------------------------------------ what is found


def shapes(answer, name):
    """Shapes of a layer."""
    return next(layer["shapes"] for layer in answer["layers"] if layer["name"] == name)


def off(value, true):
    """Angle (degrees) and distance (mm) of a pose from the truth."""
    error = pose_difference(inverse(np.array(value)), inverse(true))
    return np.rad2deg(np.linalg.norm(error[:3])), 1e3 * np.linalg.norm(error[3:])


def test_the_machine_snaps_to_its_place(page, truth):
    """From a pose that is off by some centimetres and degrees, to the accuracy of the nominal
    model: 2 mm of its centres on a base of half a metre are half a degree, and half of that at a
    metre.
    """
    true = truth.T_camera_base[0]
    rough = perturb(true, np.array([0.03, -0.04, 0.05, 0.03, -0.02, 0.05]))
    assert off(rough, true)[1] > 50
    value = page.ask("localize", pose=rough.tolist())
    assert value["localized"]
    angle, distance = off(value["overlay"]["pose"], true)
    assert angle < 1.0
    assert distance < 15
    visible = page.ask("edges", pose=value["overlay"]["pose"])
    assert visible["mark"] == "good"
    assert len(shapes(visible, "edges")) > 2 * len(shapes(visible, "rejected"))
    counts = [(one["measured"], one["predicted"]) for one in visible["legs"]]
    measured, predicted = map(sum, zip(*counts, strict=True))
    assert measured == len(shapes(visible, "edges"))
    assert predicted == measured + len(shapes(visible, "rejected"))
    assert page.ask("edges", pose=rough.tolist())["mark"] == "wrong"


def test_every_edge_that_is_not_measured_has_its_reason(page):
    visible = page.ask("edges")
    tips = [shape["tip"].split(": ", 1)[1] for shape in shapes(visible, "rejected")]
    assert tips
    assert all(any(reason in text for text in visible["reasons"]) for reason in tips)
    assert len({*tips}) == len(visible["reasons"])


def test_a_session_of_one_image_is_viewed_and_placed(session, truth):
    """A calibration needs two; a person begins with one."""
    first, *others = load_session(session).stations[0].images
    for image in others:
        image.path.unlink()
    table = (session / "joints.csv").read_text().splitlines()
    rows = [table[0], table[1 + first.configuration]]
    (session / "joints.csv").write_text("\n".join(rows) + "\n")
    document = yaml.safe_load((session / "session.yaml").read_text())
    document["stations"] = dict([next(iter(document["stations"].items()))])
    (session / "session.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(InputError):
        load_session(session)
    opened = Page(session, fewest=1)
    true = truth.T_camera_base[0]
    rough = perturb(true, np.array([0.03, -0.04, 0.05, 0.03, -0.02, 0.05]))
    value = opened.ask("localize", pose=rough.tolist())
    assert value["localized"]
    angle, distance = off(value["overlay"]["pose"], true)
    assert angle < 1.5
    assert distance < 25
    assert not value["places"]
    # another leg taken for leg 1, and then beside the place: right, or offered among other places
    for turn in (2 * np.pi / 3, 0.2):
        mistaken = rough @ pose(rotation(turn * np.array([0.0, 0.0, 1.0])), np.zeros(3))
        value = opened.ask("localize", pose=mistaken.tolist())
        places = value["places"] or [value["overlay"]["pose"]]
        assert min(off(place, true)[0] for place in places) < 1.5
        assert not value["localized"] or off(value["overlay"]["pose"], true)[0] < 1.5
    # a leg that a person numbers: where it is, and where another leg is
    joints = opened.ask("overlay", pose=true.tolist())["joints"]
    first, fourth = (
        {"image": 0, "leg": 1, "end": "axis", "pixel": np.mean(ends, axis=0).tolist()}
        for ends in ([one["at"] for one in joints if one["leg"] == leg] for leg in (1, 4))
    )
    value = opened.ask("localize", pose=rough.tolist(), pins=[first])
    assert value["localized"]
    assert off(value["overlay"]["pose"], true)[0] < 1.5
    value = opened.ask("localize", pose=rough.tolist(), pins=[fourth])
    assert not value["localized"]
    assert all(off(place, true)[0] > 10 for place in value["places"])
    # three joints at their places, and no pose but the files' own
    pins = [
        {"image": 0, "leg": one["leg"], "end": one["end"], "pixel": one["at"]}
        for one in (joints[k] for k in (0, 3, 8))
    ]
    value = opened.ask("localize", pins=pins)
    assert value["localized"]
    assert off(value["overlay"]["pose"], true)[0] < 1.5
    assert pkmcal.view(session).document["kind"] == "session"


def test_the_machine_is_found_from_nowhere(page, truth):
    away = pose(np.eye(3), np.array([0.0, 0.0, 3.0]))
    value = page.ask("localize", pose=away.tolist(), anywhere=True)
    assert value["localized"]
    assert off(value["overlay"]["pose"], truth.T_camera_base[0])[0] < 1.0


@pytest.mark.parametrize("away", [0.0, 80.0])
def test_a_fit_moves_no_joint_away_from_where_it_was_placed(page, truth, away):
    """Both pins are moved by ``away`` px, so the machine is placed beside where it is."""
    true = truth.T_camera_base[0].tolist()
    joints = page.ask("overlay", pose=true)["joints"][:4:3]
    pins = [
        {
            "image": 0,
            "leg": one["leg"],
            "end": one["end"],
            "pixel": [one["at"][0] + away, one["at"][1]],
        }
        for one in joints
    ]
    value = page.ask("localize", pose=true, pins=pins)
    assert value["localized"] == (away == 0)
    placed = page.ask("overlay", pose=true, pins=pins)["pose"]
    angle, distance = off(value["overlay"]["pose"], np.array(placed))
    assert (angle < 1e-9 and distance < 1e-9) == (away > 0)


@pytest.mark.parametrize("number", [1, 4])
def test_a_machine_that_is_not_there_stays_where_it_was_put(session, number):
    loaded = load_session(session)
    rng = np.random.default_rng(3)
    for photo in loaded.stations[0].images[number:]:
        photo.path.unlink()
    for photo in loaded.stations[0].images[:number]:
        image = cv2.imread(str(photo.path), 0)
        noise = rng.normal(128, 40, (image.shape[0] // 8, image.shape[1] // 8))
        cv2.imwrite(str(photo.path), cv2.resize(noise, image.shape[::-1]).clip(0, 255).astype("u1"))
    opened = Page(session)
    before = np.array(opened.ask("overlay")["pose"])
    # of one image, a pose set by hand is evidence too, but not of a machine that is not there
    for turn in (0.0, 0.1, 0.2):
        start = before @ pose(rotation(np.array([0.0, turn, turn])), np.zeros(3))
        start = opened.ask("overlay", pose=start.tolist())["pose"]
        value = opened.ask("localize", pose=start)
        assert not value["localized"]
        assert value["overlay"]["pose"] == start


def test_what_a_calibration_found_is_shown_with_its_judgement(page, demo):
    visible = page.ask("edges", machine="calibration")
    assert (visible["median"] < 0.5, visible["mark"]) == (True, "good")
    saved = page.subject.saved.document
    rows = {tuple(r[2:5]): r for r in saved["residuals"]["edges"] if r[:2] == [1, 1]}
    assert rows
    values = [edge["tip"] for edge in shapes(visible, "edges") if "residual" in edge["tip"]]
    assert len(values) > 0.8 * len(rows)
    _, _, leg, tube, side, weight, *_ = next(iter(rows.values()))
    tip = next(
        t for t in values if t.startswith(f"Leg {leg}, tube {tube}, {['right', 'left'][side - 1]}")
    )
    assert tip.endswith(f"weight {weight:.2f}")


def test_reasons_of_what_was_left_out_are_reported(demo, tmp_path):
    """Read anew where the file changes under an open page."""
    own = shutil.copytree(demo.calibration, tmp_path / "calibration")
    opened = Page(demo.session, own)
    saved = opened.subject.saved
    name, configuration = saved.stations[0].name, saved.configurations[0]
    group = {"reason": "a cable hangs there", "cases": [[name, configuration, 3, 1, 2]]}
    text = json.dumps({**saved.document, "rejected": [group]})
    (own / "calibration.json").write_text(text)
    visible = opened.ask("edges", machine="calibration")
    rows = [
        e["tip"]
        for e in (*shapes(visible, "edges"), *shapes(visible, "rejected"))
        if "a cable hangs there" in e["tip"]
    ]
    assert len(rows) == 1
    assert rows[0].startswith("Leg 3, tube 1, left edge: ")


def test_a_boards_corners_are_shown(tmp_path):
    folder = by_command(tmp_path / "session", *BOARD_SESSION)
    text = (folder / "session.yaml").read_text().replace("fixed_to: base", "fixed_to: platform")
    (folder / "session.yaml").write_text(re.sub(r"observe: .*", "observe: board", text))
    opened = Page(folder)
    visible = opened.ask("edges")
    assert len(shapes(visible, "corners")) > 5
    assert visible["mark"] == "good"
    assert f"{len(shapes(visible, 'corners'))} corners" in visible["texts"][0]
    assert opened.post("localize").json()["found"] == "observe: board"


def test_a_calibration_of_another_session_is_refused(page, demo, session):
    table = (session / "joints.csv").read_text().splitlines()
    (session / "joints.csv").write_text("\n".join([table[0], *table[2:], table[1]]) + "\n")
    answer = Page(session, demo.calibration).post("overlay", machine="calibration")
    assert answer.status == 422
    assert answer.json()["code"] == "calibration.another_session"
    answer = Page(session).post("overlay", machine="calibration")
    assert answer.json()["code"] == "calibration.missing"


def test_a_station_that_was_left_out_is_reported(session, demo):
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(text.replace("  station1:", "  another:"))
    opened = Page(session, demo.calibration)
    answer = opened.post("overlay", machine="calibration")
    assert answer.json()["code"] == "calibration.no_station"
    assert opened.ask("overlay", station=1, machine="calibration")["pose"]


def test_cameras_are_those_that_the_calibration_left(demo, session, tmp_path):
    """Under the names that it gives them: here the session's own lie in another folder than usual,
    which is part of the name.
    """
    (session / "cameras").rename(session / "lenses")
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(text.replace("cameras/", "lenses/"))
    folder = tmp_path / "calibration"
    shutil.copytree(demo.calibration, folder)
    camera = camera_of_size((320, 240))
    file = Path(load_session(session).stations[0].camera_file)
    (folder / f"camera-lenses-{file.stem}.yaml").write_text(camera_text(camera))
    document = json.loads((folder / "calibration.json").read_text())
    document["stations"][0]["focal_scale"] = 1.01
    (folder / "calibration.json").write_text(json.dumps(document))
    visible = Page(session, folder).subject.calibrated(0, 0).camera
    np.testing.assert_allclose(visible.parameters[:2], 1.01 * camera.parameters[:2])
    np.testing.assert_array_equal(visible.parameters[2:], camera.parameters[2:])


# ------------------------------------------------------------------ what is written


def test_the_pose_is_written_and_nothing_else(session, truth):
    file = session / "session.yaml"
    text = file.read_text().replace("    pose:", "    # with a tape\n    pose:   # roughly", 1)
    file.write_text(text + "# the end\n")
    opened = Page(session)
    true = truth.T_camera_base[0]
    words = opened.ask("save", pose=true.tolist())["text"]
    assert words == "The pose of station1 is in session.yaml; nothing else in it changed."
    number = re.compile(r"(?<=[\[ ,])-?\d+\.\d+(?=[\],])")
    before, after = text + "# the end\n", file.read_text()
    assert number.sub("#", after) == number.sub("#", before)
    angle, distance = off(load_session(session).stations[0].T_camera_base, true)
    assert angle < 0.02
    assert distance < 0.2
    again = opened.ask("overlay")  # as a page that is opened again requests it
    np.testing.assert_array_equal(again["pose"], opened.ask("overlay", pose=true.tolist())["pose"])
    same = load_session(session).stations[1].T_camera_base
    np.testing.assert_array_equal(same, opened.subject.station(1).T_camera_base)
    opened.ask("save", pose=true.tolist())  # again, on its own writing


def test_somebody_elses_change_is_not_written_over(session, truth):
    opened, file = Page(session), session / "session.yaml"
    file.write_text(file.read_text() + "# mine\n")
    text = file.read_text()
    answer = opened.post("save", pose=truth.T_camera_base[0].tolist())
    assert answer.status == 422
    assert answer.json()["code"] == "session.changed"
    assert file.read_text() == text


def test_the_pose_of_an_image_by_hand_is_written_under_its_name(session, truth):
    file = session / "session.yaml"
    before = read_yaml(file).data
    first, T = load_session(session).stations[0], truth.T_camera_base[0]
    image = f"{first.images[0].path.stem}"
    station = replace(first, name=f"{first.name}-{image}", handheld=True)
    PoseFile(session).write(station, T)
    entry = read_yaml(file).data["stations"][first.name]
    assert list(entry["poses"]) == [image]
    there = entry["poses"][image]
    written = look_at(there["position"], there["look_at"], there["up"])
    np.testing.assert_allclose(written, T, atol=1e-3)  # as many digits as are written
    after = read_yaml(file).data
    del after["stations"][first.name]["poses"]
    assert after == before


def test_nothing_is_written_through_a_link(session, tmp_path, truth):
    """Which somebody else's session may hold, to any file of ours."""
    real = tmp_path / "elsewhere.yaml"
    shutil.move(session / "session.yaml", real)
    (session / "session.yaml").symlink_to(real)
    text = real.read_text()
    answer = Page(session).post("save", pose=truth.T_camera_base[0].tolist())
    assert answer.status == 422
    assert str(real) in answer.json()["found"]
    assert (session / "session.yaml").is_symlink()
    assert real.read_text() == text


# ------------------------------------------------------------------ the command


def test_the_command_serves_until_it_is_interrupted(demo):
    words = [sys.executable, "-m", "pkmcal", "view", str(demo.session), "--json"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as values:
        url = json.loads(values.stdout.readline())["url"]
        host, _, token = url.removeprefix("http://").rstrip("/").partition("/")
        assert host.startswith("127.0.0.1:")
        assert len(token) >= 32
        with urllib.request.urlopen(url, timeout=60) as answer:
            assert answer.status == 200
        values.send_signal(signal.SIGINT)
        assert values.wait(60) == 0
        assert values.stdout.read() == values.stderr.read() == ""


def test_a_page_without_a_browser_prints_its_address(demo):
    code = "import sys, pkmcal; pkmcal.view(sys.argv[1]).show()"
    hidden = ("DISPLAY", "WAYLAND_DISPLAY")
    env = {k: v for k, v in os.environ.items() if k not in hidden} | {"BROWSER": "false"}
    with subprocess.Popen(
        [sys.executable, "-uc", code, str(demo.calibration)], stdout=subprocess.PIPE, text=True,
        env=env,
    ) as served:  # fmt: skip
        with urllib.request.urlopen(served.stdout.readline().strip(), timeout=60) as answer:
            assert answer.status == 200
        served.send_signal(signal.SIGINT)
        assert served.wait(60) == 0


def test_answers_are_sent_at_once():
    """asyncio sends without delay (TCP_NODELAY) if the protocol is registered, else 40 ms later."""
    with serving.listening_socket(0) as socket_:
        assert socket_.getsockname()[0] == "127.0.0.1"
        assert socket_.proto == socket.IPPROTO_TCP


def test_what_cannot_be_shown_is_reported_before(demo, session, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run("view", demo.session, "--port", port)
    assert done.code == 2
    assert done.err.startswith(f"Error: --port: the page cannot be served on port {port}")
    done = run("view", demo.session, "--calibration", tmp_path, "--json")
    assert (done.code, done.json["code"]) == (2, "calibration.missing")
    assert run("view", tmp_path / "nowhere").code == 2
    names = load_session(session).configurations
    rows = [f"{name},0,0,0.3{k},1,0,0,0" for k, name in enumerate(names)]
    (session / "poses.csv").write_text("\n".join(["configuration,x,y,z,qw,qx,qy,qz", *rows]))
    text = (session / "session.yaml").read_text().partition("stations:")[0]
    tracker = "{poses: poses.csv, noise: {position: 1.0e-5, rotation: 1.0e-5}}"
    (session / "session.yaml").write_text(f"{text}stations: {{t: {{tracker: {tracker}}}}}\n")
    done = run("view", session, "--json")
    assert (done.code, done.json["code"]) == (2, "images.none")


# ------------------------------------------------------------------ the stage


def test_the_stage_has_the_calibrated_machine_and_its_cameras(page, demo):
    block, saved = page.get("stage").json(), page.subject.saved
    assert [one["label"] for one in block["poses"]] == [*saved.configurations]
    for one, T in zip(block["poses"], saved.T_base_platform, strict=True):
        np.testing.assert_allclose(one["configuration"]["T_base_platform"], T, atol=1e-6)
    for camera, station in zip(block["machine"]["cameras"], saved.stations, strict=True):
        np.testing.assert_allclose(camera["position"], station.T_base_camera[:3, 3], atol=1e-6)
    answer = Page(demo.session).get("stage")
    assert answer.status == 422
    assert answer.json()["code"] == "calibration.missing"


# ------------------------------------------------------------------ results and folders


class Opened(Page):
    """The page of whatever a path holds."""

    def __init__(self, path, calibration=None):
        self.app = pkmcal.view(path, calibration=calibration).application(TOKEN, PORT)

    def document(self, path=""):
        return page_document(self.get(path).text)


@pytest.fixture(scope="module")
def results(demo, tmp_path_factory):
    """A folder with a session, its calibration, a difference, a machine's page, a page that is
    older, another file of HTML, and a broken session.
    """
    folder = tmp_path_factory.mktemp("results") / "all"
    shutil.copytree(demo.session, folder / "bench")
    shutil.copytree(demo.calibration, folder / "bench" / "calibration")
    pkmcal.diff(demo.calibration, demo.session / "mechanism.yaml").save(folder / "diff")
    pkmcal.show("3-rpr").save(folder / "machine.html")
    text = (folder / "diff" / "diff.html").read_text(encoding="utf-8")
    older = text.replace('"version":1', '"version":0')
    assert older != text
    (folder / "older.html").write_text(older)
    (folder / "mine.html").write_text("<p>mine</p>")
    (folder / "broken").mkdir()
    (folder / "broken" / "session.yaml").write_text("pkmcal: [")
    (folder / ".hidden").mkdir()
    shutil.copy(folder / "machine.html", folder / ".hidden")
    (folder / "link").symlink_to(demo.folder, target_is_directory=True)
    return folder


@pytest.mark.parametrize("name", ["", "report.html", "calibration.json"])
def test_a_calibration_opens_as_its_report(demo, name):
    stored = page_document((demo.calibration / "report.html").read_text(encoding="utf-8"))
    opened = Opened(demo.calibration / name)
    assert opened.document() == stored
    assert opened.get("viewer.js").status == 200
    assert opened.get(token="other").status == 403


def test_other_results_open_as_their_pages(results):
    for path in (results / "diff", results / "diff" / "diff.json", results / "diff" / "diff.html"):
        assert Opened(path).document()["title"] == Opened(results / "diff").document()["title"]
    assert Opened(results / "machine.html").document()["kind"] == "machine"


def test_a_folder_lists_sessions_and_results(results):
    document = Opened(results).document()
    rows = {one["name"]: one for one in document["entries"]}
    assert list(rows) == [
        "machine.html", "older.html", "bench", "bench/calibration/report.html", "broken",
        "diff/diff.html",
    ]  # fmt: skip
    report = Opened(results / "bench" / "calibration").document()
    row = rows["bench/calibration/report.html"]
    assert (row["mark"], row["title"]) == ("good", report["title"])
    assert row["date"] == report["origin"][0]
    magnitudes = {one["role"]: one["text"] for one in report["verdict"]["comparison"]["magnitudes"]}
    assert (row["before"], row["after"]) == (magnitudes["nominal"], magnitudes["calibrated"])
    # a page that this version cannot show is listed with the reason
    assert (rows["older.html"]["href"], rows["older.html"]["mark"]) == ("", "wrong")
    assert rows["diff/diff.html"]["before"] == rows["machine.html"]["date"] == ""
    # a session has the date of its newest image, and whether it has a calibration
    assert rows["bench"]["text"].endswith("; calibrated")
    assert rows["broken"]["mark"] == "wrong"


def test_a_session_in_a_list_has_the_date_of_its_newest_image(session):
    images = sorted((session / "images").rglob("*.png"))
    for path in (*images, session / "joints.csv"):
        os.utime(path, (1e9, 1e9))
    newest = datetime(2026, 11, 30, 14, 5)
    os.utime(images[0], (newest.timestamp(),) * 2)
    (row,) = Opened(session.parent).document()["entries"]
    assert (row["date"], row["mark"]) == ("30 November 2026, 14:05", None)
    assert row["text"] == f"{len(images)} images; not calibrated"


def test_a_page_that_is_written_again_is_read_again(results, tmp_path):
    """Opened by itself and from a list; what cannot be read meanwhile is reported."""
    for name in ("one", "other"):
        pkmcal.show("3-rpr").save(tmp_path / f"{name}.html")
    alone, listed = Opened(tmp_path / "one.html"), Opened(tmp_path)
    before = alone.document()
    assert listed.document("0/") == before
    pkmcal.show("delta").save(tmp_path / "one.html")
    for document in (alone.document(), listed.document("0/")):
        assert document["title"] != before["title"]
    (tmp_path / "one.html").unlink()
    assert "one.html" in alone.document()["note"]


def test_what_is_written_later_is_listed_at_the_next_request(tmp_path, demo):
    """In its place; addresses of the entries before stay."""

    def rows():
        return {one["name"]: one for one in opened.document()["entries"]}

    for name in ("b", "c"):
        pkmcal.show("3-rpr").save(tmp_path / f"{name}.html")
    opened = Opened(tmp_path)
    before = rows()
    pkmcal.show("delta").save(tmp_path / "a.html")
    shutil.copytree(demo.session, tmp_path / "bench")
    assert list(rows()) == ["a.html", "b.html", "c.html", "bench"]
    assert rows()["b.html"] == before["b.html"]
    assert opened.document(rows()["a.html"]["href"])["title"] == "delta"
    bench = rows()["bench"]["href"]
    assert opened.document(bench)["calibration"] == opened.document(bench)["report"] == ""
    assert rows()["bench"]["text"].endswith("; not calibrated")
    # a session that is calibrated while its page is open
    shutil.copytree(demo.calibration, tmp_path / "bench" / "calibration")
    assert rows()["bench"]["text"].endswith("; calibrated")
    assert opened.document(bench)["calibration"]
    report = opened.document(bench)["report"]
    assert opened.document(f"{bench}{report}")["kind"] == "report"
    # another page of the same name, and none at all
    shutil.copy(tmp_path / "a.html", tmp_path / "b.html")
    assert rows()["b.html"]["title"] == rows()["a.html"]["title"] != before["b.html"]["title"]
    for name in ("a.html", "b.html", "c.html"):
        (tmp_path / name).unlink()
    shutil.rmtree(tmp_path / "bench")
    assert rows() == {}
    assert str(tmp_path) in opened.document()["note"]


def test_each_entry_of_a_folder_opens(results):
    opened = Opened(results)
    kinds = {}
    for one in opened.document()["entries"]:
        if one["href"]:
            kinds[one["name"]] = opened.document(one["href"])["kind"]
            assert opened.get(f"{one['href']}viewer.css").status == 200
    assert kinds == {
        "machine.html": "machine", "bench": "session", "bench/calibration/report.html": "report",
        "broken": "folder", "diff/diff.html": "report",
    }  # fmt: skip
    names = [one["name"] for one in opened.document()["entries"]]
    bench, broken = names.index("bench"), names.index("broken")
    assert opened.get(f"{bench}/image/0/0").headers["content-type"] == "image/jpeg"
    assert opened.document(f"{bench}/report/")["kind"] == "report"
    # one that cannot be opened is a page with the reason, also in its place of the list
    assert "broken" in opened.document(f"{broken}/")["note"]
    assert opened.document("99/")["note"]
    assert opened.get("0/nowhere").status == 404


def test_a_session_leads_to_its_calibration_and_report(results, demo):
    document = Opened(results / "bench").document()
    assert document["calibration"] == str(results / "bench" / "calibration")
    assert document["report"] == "report/"
    assert Opened(demo.session).document()["calibration"] == ""
    named = Opened(demo.session, demo.calibration).document()
    assert named["calibration"] == str(demo.calibration)
    assert Opened(results / "bench" / "session.yaml").document() == document


def test_only_the_first_sessions_of_many_are_listed(tmp_path):
    for n in range(MOST_ENTRIES + 1):
        (tmp_path / f"{n:03d}").mkdir()
        (tmp_path / f"{n:03d}" / "session.yaml").touch()
    document = Opened(tmp_path).document()
    assert len(document["entries"]) == MOST_ENTRIES
    assert str(MOST_ENTRIES) in document["note"]


def test_reading_results_writes_nothing(results):
    before = listing(results)
    opened = Opened(results)
    for one in opened.document()["entries"]:
        opened.get(one["href"] or "0/")
    opened.get("2/image/0/0")
    assert listing(results) == before


def test_what_holds_nothing_to_view_is_reported(results, demo, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare").mkdir()
    shutil.copy(demo.calibration / "calibration.json", tmp_path / "bare")
    os.mkfifo(tmp_path / "empty" / "pipe.html")
    (tmp_path / "cut.html").write_text(PAGE_MARK + DOCUMENT_START + "{")
    (tmp_path / "binary.html").write_bytes(PAGE_MARK.encode() + b"\xff")
    for path in (
        tmp_path / "empty", tmp_path / "bare", tmp_path / "nowhere", tmp_path / "cut.html",
        tmp_path / "binary.html", tmp_path / "empty" / "pipe.html", results / "mine.html",
        results / "older.html", results / "bench" / "joints.csv",
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            pkmcal.view(path)
        assert str(path.name) in str(caught.value)
    with pytest.raises(InputError) as caught:
        pkmcal.view(demo.calibration, calibration=demo.calibration)
    assert caught.value.where == "--calibration"


def test_a_hostile_page_stays_text(demo, tmp_path):
    """Of a stored page only the document is served, and of that only texts."""
    text = (demo.calibration / "report.html").read_text(encoding="utf-8")
    title = json.dumps(HOSTILE).replace("<", "\\u003c")
    text = text.replace('"title":"Calibration of gough-stewart"', f'"title":{title}', 1)
    (tmp_path / "report.html").write_text(text.replace("<body>", f"<body>{HOSTILE}"))
    served = Opened(tmp_path).get().text
    assert page_document(served)["title"] == HOSTILE
    tags = PageParts(served).tags
    assert [tag for tag, _ in tags].count("script") == 2
    assert not [1 for tag, attributes in tags if tag == "img" or "onerror" in attributes]


def test_a_result_in_a_notebook_shows_itself(demo):
    view = pkmcal.view(demo.calibration)
    frame = view._repr_html_()
    assert frame is not None
    assert frame.startswith('<iframe srcdoc="&lt;!doctype html&gt;')
    assert pkmcal.view(demo.session)._repr_html_() is None
    assert view.document["kind"] == "report"


# ------------------------------------------------------------------ in a browser


SCRIPTS = Path(__file__).parent / "browser_scripts"


def act(name):
    """A script of ``browser_scripts``, behind what all of them use."""
    return "".join((SCRIPTS / f"{one}.js").read_text() for one in ("common", name))


def served_with(app, script, width):
    """The application with a script before its bundle, and a page with it in a frame, which it
    allows; browsers have no window as narrow as a phone.
    """
    from starlette.datastructures import MutableHeaders
    from starlette.responses import HTMLResponse, Response

    frame = FRAME.replace("page.html", "./").replace("WIDTH", str(width))

    async def both(scope, receive, send):
        async def framed(message):
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                policy = headers["content-security-policy"]
                headers["content-security-policy"] = policy.replace(
                    "frame-ancestors 'none'", "frame-ancestors 'self'"
                )
            await send(message)

        if scope["path"] == f"/{TOKEN}/frame":
            await HTMLResponse(frame)(scope, receive, send)
        elif scope["path"].endswith(SCRIPT_FILE):
            content = script + bundle_file(SCRIPT_FILE)
            await Response(content, media_type="text/javascript")(scope, receive, send)
        else:
            await app(scope, receive, framed)

    return both


def browsed(view, script, width, folder, *options):
    """Data that the script left on the root element of the page in a frame."""
    with serving.listening_socket(0) as socket_:
        port = socket_.getsockname()[1]
        app = served_with(view.application(TOKEN, port), script, width)
        # a thread of its own has no signals to be ended by: it ends with the tests
        threading.Thread(
            target=serving.serve_until_interrupted, args=(app, socket_), daemon=True
        ).start()
        return browse(f"http://127.0.0.1:{port}/{TOKEN}/frame", folder, 1500, *options)


def pairs(root, *names):
    """Two pixels of each name."""
    return [np.array(json.loads(root[name])) for name in names]


@pytest.mark.parametrize("width", [1440, pytest.param(390, marks=pytest.mark.slow)])
def test_a_session_is_worked_on_in_a_browser(session, demo, truth, tmp_path, width):
    """A user walks, zooms, drags, undoes, places two joints, and saves the localized pose."""
    before = (session / "session.yaml").read_text()
    loaded = load_session(session)
    pane = SessionContent(loaded, demo.calibration).nominal(0, 0)
    pixels = pane.camera.project(apply(truth.T_camera_base[0], pane.points)).round(1).tolist()
    places = [["platform", 2, pixels[1][1]], ["base", 5, pixels[0][4]]]
    script = f"const PLACES = {json.dumps(places)};{act('session')}"
    options = (*SOFTWARE, DARK) if width == 390 else SOFTWARE
    root = browsed(
        pkmcal.view(session, calibration=demo.calibration), script, width, tmp_path, *options
    )
    assert (root["faults"], root["overhang"]) == ("", "0")
    station, images = loaded.stations[0], sum(len(one.images) for one in loaded.stations)
    names = [loaded.configurations[one.configuration] for one in station.images]
    assert root["first"] == "Calibrated"
    assert root["next"] == f"{station.name} / {names[1]}"
    assert root["back"] == f"{station.name} / {names[0]}"
    # the image has all its pixels; every image is in the list, with its mark
    assert root["size"] == "{}x{}".format(*station.camera.image_size)
    assert int(root["thumbnails"]) == images
    marks = json.loads(root["marks"])
    assert len(marks) == images
    assert "wrong" in marks
    number = re.compile(r"-?\d+(?:\.\d+)?")
    whole, zoomed = (
        [float(x) for x in number.findall(text.replace("\u2212", "-"))]
        for text in json.loads(root["zoomed"])
    )
    np.testing.assert_allclose(zoomed[:2], whole[:2], atol=0.11)  # of a tenth each
    assert zoomed[2] > 5 * whole[2]
    for wanted, there in pairs(root, "unmoved", "pulled", "undone", "pinched", "panned"):
        np.testing.assert_allclose(there, wanted, atol=0.2)  # of a tenth, and of the screen's grid
    ((old, new),) = pairs(root, "farther")
    assert np.abs(new - old).max() > 1
    assert int(root["measured"]) > 0
    assert (root["ghosts"], root["during"].strip(), root["filled"]) == ("0", "session-fit", "1")
    assert root["changed"] == "true"
    assert json.loads(root["numbered"]) == ["You: leg 2 is here"]
    assert (root["number_moves"], root["unnumbered"]) == ("false", "0")
    assert (root["refused"], root["offered"]) == ("session-status bad", "0")
    # then all images of the station fit
    assert root["status"] == root["saved"] == "session-status good"
    assert root["fitted"] == root["calibrated"] == "session-fit good"
    marks = json.loads(root["remarks"])[: len(station.images)]
    assert "wrong" not in marks
    assert root["stage"] == "true"
    # the image fills the window again
    assert float(root["scale"]) == pytest.approx(float(root["whole"]), abs=0.06)
    assert min(json.loads(root["window"])) > 250
    assert (session / "session.yaml").read_text() != before
    angle, _ = off(load_session(session).stations[0].T_camera_base, truth.T_camera_base[0])
    assert angle < 1.0


@pytest.mark.parametrize("width", [1440, pytest.param(390, marks=pytest.mark.slow)])
def test_a_folder_leads_to_a_report_in_a_browser(results, tmp_path, width):
    root = browsed(pkmcal.view(results), act("folder"), width, tmp_path, *SOFTWARE)
    assert (root["faults"], root["overhang"], root["wide"]) == ("", "0", "0")
    row = json.loads(root["row"])
    assert row[0] == "bench/calibration/report.html"
    assert row[1] == root["title"]
    assert "\u2192" in row[4]
    assert root["images"] == "true"
