"""The page of images: access, responses, written files, and a browser on it."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import run
from pkmcal.cameras.files import camera_text
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, inverse, perturb, pose, pose_difference, rotation
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.session.load import load_session
from pkmcal.simulation import load_truth
from pkmcal.view import server
from pkmcal.view.content import Viewed
from pkmcal.view.pose_file import PoseFile
from pkmcal.web import serving
from rendered import BOARD_SESSION, by_command
from test_report_page import CHROMIUM, PageParts

PORT, TOKEN = 4711, "the-token"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    content: bytes

    @property
    def text(self):
        return self.content.decode()

    def json(self):
        return json.loads(self.content)


class Page:
    """A page that is served, and its questions, as the server passes them on."""

    def __init__(self, folder, calibration=None):
        self.subject = Viewed(load_session(folder), calibration)
        self.app = server.application(self.subject, TOKEN, PORT)

    def request(self, path, content=None, kind="http", **headers):
        text = {"host": f"127.0.0.1:{PORT}", **headers}
        scope = {
            "type": kind, "method": "GET" if content is None else "POST", "path": path,
            "raw_path": path.encode(), "query_string": b"", "root_path": "", "scheme": "http",
            "headers": [(k.encode(), v.encode()) for k, v in text.items()],
            "http_version": "1.1", "client": None, "server": ("127.0.0.1", PORT),
            "extensions": {"websocket.http.response": {}},
        }  # fmt: skip
        sent = []

        async def receive():
            return {"type": "http.request", "body": content or b""}

        async def send(message):
            sent.append(message)

        asyncio.run(self.app(scope, receive, send))
        start = sent[0]
        headers = {k.decode(): v.decode() for k, v in start["headers"]}
        return Answer(start["status"], headers, b"".join(m.get("body", b"") for m in sent[1:]))

    def get(self, path="", token=TOKEN, **headers):
        return self.request(f"/{token}/{path}", **headers)

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


@pytest.mark.parametrize("path", ["", "view.js", "image/0/0", "nowhere"])
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
            assert attributes.get(name) in (None, "data:,", "view.js", "view.css")
    assert not re.search(r"\bon[a-z]+=|<style|style=", text)  # which the policy would block
    assert not re.search(r"https?:|@import|url\(", page.get("view.css").text)


# ------------------------------------------------------------------ what is shown


def test_all_images_are_named(page, demo):
    text = PageParts(page.get().text).text
    session = page.subject.session
    assert all(name in text for name in (*session.configurations, *session.station_names))


def test_an_image_is_sent(page):
    image = cv2.imdecode(np.frombuffer(page.get("image/1/2").content, np.uint8), 0)
    assert image.shape[::-1] == page.subject.station(1).camera.image_size
    assert np.abs(image.astype(int) - page.subject.image(1, 2)).mean() < 3


def test_nothing_is_decoded_before_it_is_looked_at(demo):
    opened = Page(demo.session)
    opened.get()
    opened.get("image/0/1")
    opened.ask("overlay", image=1)
    assert opened.subject.image.cache_info().misses == 1


def test_a_large_image_is_sent_at_the_screens_size(page):
    for widest in (100, 10_000):
        jpeg = np.frombuffer(page.subject.jpeg(0, 0, widest), np.uint8)
        width = page.subject.station(0).camera.image_size[0]
        assert cv2.imdecode(jpeg, 0).shape[1] == min(widest, width)


def test_faults_are_reported_in_words(page, session):
    (session / "images" / "station1").mkdir(exist_ok=True)
    broken = load_session(session).stations[0].images[0].path
    broken.write_bytes(broken.read_bytes()[:-40])
    answer = Page(session).get("image/0/0")
    assert answer.status == 422
    assert answer.json()["message"].startswith(f"{broken.relative_to(session)}: the image")
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
    assert "not valid JSON" in page.post("fit", b"{").json()["message"]
    assert "no JSON object" in page.post("fit", b"[]").json()["message"]


def test_a_defect_is_reported_as_one(page, monkeypatch):
    monkeypatch.setattr(Viewed, "jpeg", lambda *_: 1 / 0)
    answer = page.get("image/0/0")
    assert answer.status == 500
    assert "a defect of pkmcal" in answer.json()["message"]


def test_the_overlay_is_where_the_machine_is(page, truth):
    """At the true pose, the joints are at their pixels."""
    T = truth.T_camera_base[0]
    answer = page.ask("overlay", pose=T.tolist())
    pane = page.subject.drawn(0, 0)
    for joint in answer["joints"]:
        point = pane.points[("base", "platform").index(joint["end"]), joint["leg"] - 1]
        np.testing.assert_allclose(
            [joint["x"], joint["y"]], pane.camera.project(apply(T, point)), atol=0.051
        )
    assert {leg["leg"] for leg in answer["legs"]} == {1, 2, 3, 4, 5, 6}
    assert len(answer["joints"]) == 12


def test_a_joint_comes_to_where_it_is_pulled(page):
    """One joint, then another in a second image: both stay pinned."""
    first = {"image": 0, "end": "platform", "leg": 2, "pixel": [300, 200]}
    answer = page.ask("overlay", pins=[first])
    shifted = next(j for j in answer["joints"] if (j["end"], j["leg"]) == ("platform", 2))
    assert (shifted["x"], shifted["y"]) == (300, 200)
    base = page.ask("overlay", image=1, pose=answer["pose"])["joints"]
    other = next(j for j in base if (j["end"], j["leg"]) == ("base", 5))
    second = {"image": 1, "end": "base", "leg": 5, "pixel": [other["x"] + 20, other["y"] - 9]}
    answer = page.ask("overlay", pose=answer["pose"], pins=[first, second])
    for image, pin in ((0, first), (1, second)):
        joints = page.ask("overlay", image=image, pose=answer["pose"])["joints"]
        at = next(j for j in joints if (j["end"], j["leg"]) == (pin["end"], pin["leg"]))
        np.testing.assert_allclose([at["x"], at["y"]], pin["pixel"], atol=0.051)


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
            assert page.ask("found", pose=T)["told"]


# ------------------------------------------------------------------ what is found


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
    value = page.ask("fit", pose=rough.tolist())
    assert value["recognised"]
    assert value["said"].startswith("Recognised in 4 images")
    angle, distance = off(value["pose"], true)
    assert angle < 1.0
    assert distance < 15
    visible = page.ask("found", pose=value["pose"])
    assert visible["told"][0].startswith("It fits: ")
    assert len(visible["edges"]) > 2 * len(visible["missed"])
    assert page.ask("found", pose=rough.tolist())["told"][0].startswith("It does not fit: ")


def test_the_machine_is_found_from_nowhere(page, truth):
    away = pose(np.eye(3), np.array([0.0, 0.0, 3.0]))
    value = page.ask("fit", pose=away.tolist(), anywhere=True)
    assert value["recognised"]
    assert off(value["pose"], truth.T_camera_base[0])[0] < 1.0


def test_a_machine_that_is_not_there_stays_where_it_was_put(session):
    loaded = load_session(session)
    rng = np.random.default_rng(3)
    for photo in loaded.stations[0].images:
        image = cv2.imread(str(photo.path), 0)
        noise = rng.normal(128, 40, (image.shape[0] // 8, image.shape[1] // 8))
        cv2.imwrite(str(photo.path), cv2.resize(noise, image.shape[::-1]).clip(0, 255).astype("u1"))
    opened = Page(session)
    before = opened.ask("overlay")["pose"]
    value = opened.ask("fit")
    assert not value["recognised"]
    assert value["said"].startswith("Not ")
    assert value["pose"] == before


def test_what_a_calibration_found_is_shown_with_its_judgement(page, demo):
    visible = page.ask("found", shown="calibration")
    assert visible["median"] < 0.5
    saved = page.subject.saved.document
    rows = {tuple(r[2:5]): r for r in saved["residuals"]["edges"] if r[:2] == [1, 1]}
    assert rows
    values = [edge["tip"] for edge in visible["edges"] if "residual" in edge["tip"]]
    assert len(values) > 0.8 * len(rows)
    _, _, leg, tube, side, weight, *_ = next(iter(rows.values()))
    tip = next(
        t for t in values if t.startswith(f"Leg {leg}, tube {tube}, {['right', 'left'][side - 1]}")
    )
    assert tip.endswith(f"weight {weight:.2f}")


def test_reasons_of_what_was_left_out_are_reported(page, monkeypatch):
    saved = page.subject.saved
    name, configuration = saved.stations[0].name, saved.configurations[0]
    group = {"reason": "a cable hangs there", "cases": [[name, configuration, 3, 1, 2]]}
    document = {**saved.document, "rejected": [group]}
    monkeypatch.setitem(page.subject.__dict__, "saved", replace(saved, document=document))
    visible = page.ask("found", shown="calibration")
    rows = [
        e["tip"]
        for e in (*visible["edges"], *visible["missed"])
        if "a cable hangs there" in e["tip"]
    ]
    assert len(rows) == 1
    assert rows[0].startswith("Leg 3, tube 1, left edge: ")


def test_a_boards_corners_are_shown(tmp_path):
    folder = by_command(tmp_path / "session", *BOARD_SESSION)
    text = (folder / "session.yaml").read_text().replace("fixed_to: base", "fixed_to: platform")
    (folder / "session.yaml").write_text(re.sub(r"observe: .*", "observe: board", text))
    opened = Page(folder)
    visible = opened.ask("found")
    assert len(visible["corners"]) > 5
    assert visible["told"] == [f"The board: {len(visible['corners'])} corners found."]
    assert "no legs to be recognised" in opened.post("fit").json()["message"]


def test_a_calibration_of_another_session_is_refused(page, demo, session):
    table = (session / "joints.csv").read_text().splitlines()
    (session / "joints.csv").write_text("\n".join([table[0], *table[2:], table[1]]) + "\n")
    answer = Page(session, demo.calibration).post("overlay", shown="calibration")
    assert answer.status == 422
    assert "the calibration of another session" in answer.json()["message"]
    message = Page(session).post("overlay", shown="calibration").json()["message"]
    assert "there is no calibration of this session" in message


def test_a_station_that_was_left_out_is_reported(page, monkeypatch):
    saved = page.subject.saved
    others = replace(saved, stations=saved.stations[1:])
    monkeypatch.setitem(page.subject.__dict__, "saved", others)
    message = page.post("overlay", shown="calibration").json()["message"]
    assert "the calibration has no station station1" in message
    assert page.ask("overlay", station=1, shown="calibration")["pose"]


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
    words = opened.ask("save", pose=true.tolist())["said"]
    assert words == "The pose of station1 is in session.yaml; nothing else in it changed."
    number = re.compile(r"(?<=[\[ ,])-?\d+\.\d+(?=[\],])")
    before, after = text + "# the end\n", file.read_text()
    assert number.sub("#", after) == number.sub("#", before)
    angle, distance = off(load_session(session).stations[0].T_camera_base, true)
    assert angle < 0.02
    assert distance < 0.2
    same = load_session(session).stations[1].T_camera_base
    np.testing.assert_array_equal(same, opened.subject.station(1).T_camera_base)
    opened.ask("save", pose=true.tolist())  # again, on its own writing


def test_somebody_elses_change_is_not_written_over(session, truth):
    opened, file = Page(session), session / "session.yaml"
    file.write_text(file.read_text() + "# mine\n")
    text = file.read_text()
    answer = opened.post("save", pose=truth.T_camera_base[0].tolist())
    assert answer.status == 422
    assert "was changed by somebody else" in answer.json()["message"]
    assert file.read_text() == text


def test_a_camera_by_hand_has_no_pose_to_be_written(session, truth):
    station = replace(load_session(session).stations[0], handheld=True)
    before = (session / "session.yaml").read_bytes()
    with pytest.raises(InputError, match="hand-held camera has no single pose"):
        PoseFile(session).write(station, truth.T_camera_base[0])
    assert (session / "session.yaml").read_bytes() == before


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
    done = run("view", demo.session, "--calibration", tmp_path)
    assert (done.code, "there is no calibration here" in done.err) == (2, True)
    assert run("view", tmp_path / "nowhere").code == 2
    names = load_session(session).configurations
    rows = [f"{name},0,0,0.3{k},1,0,0,0" for k, name in enumerate(names)]
    (session / "poses.csv").write_text("\n".join(["configuration,x,y,z,qw,qx,qy,qz", *rows]))
    text = (session / "session.yaml").read_text().partition("stations:")[0]
    tracker = "{poses: poses.csv, noise: {position: 1.0e-5, rotation: 1.0e-5}}"
    (session / "session.yaml").write_text(f"{text}stations: {{t: {{tracker: {tracker}}}}}\n")
    done = run("view", session)
    assert (done.code, "there are no images to be shown" in done.err) == (2, True)


# ------------------------------------------------------------------ in a browser

ACT = """
const faults = [];
addEventListener("error", (event) => { if (event.message) faults.push(event.message); });
addEventListener("unhandledrejection", (event) => faults.push(String(event.reason)));
document.addEventListener("securitypolicyviolation", (event) => {
  faults.push(`blocked ${event.blockedURI}`);
});
SVGElement.prototype.setPointerCapture = () => {};  // knows no pointer of a script
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const settled = async () => {
  do { await wait(50); } while (asking || finding || $("told").textContent === "…");
};
const key = (name, more = {}) => {
  dispatchEvent(new KeyboardEvent("keydown", { key: name, cancelable: true, ...more }));
};
const joint = (end, leg) => document.querySelector(`.hit[data-end=${end}][data-leg="${leg}"]`);
const at = (mark) => [+mark.getAttribute("cx"), +mark.getAttribute("cy")];
async function pulled(target, from, to) {
  const send = (type, [x, y]) => {
    const point = new DOMPoint(x, y).matrixTransform($("shot").getScreenCTM());
    const where = { clientX: point.x, clientY: point.y, button: 0, pointerId: 1 };
    const there = target.isConnected ? target : $("shot");
    there.dispatchEvent(new PointerEvent(type, { bubbles: true, cancelable: true, ...where }));
  };
  send("pointerdown", from);
  for (let k = 1; k <= 8; k += 1) send("pointermove", from.map((v, i) => v + (to[i] - v) * k / 8));
  send("pointerup", to);
  await settled();
}
(async () => {
  const out = document.documentElement.dataset;
  await settled();
  key("ArrowRight");
  await settled();
  out.walked = $("where").textContent;
  key("ArrowLeft"); key("ArrowDown"); key("ArrowUp");
  await settled();
  out.back = $("where").textContent;
  const before = at(joint("platform", 2)), to = before.map((v) => v + 25);
  await pulled(joint("platform", 2), before, to);
  out.pulled = JSON.stringify([to, at(joint("platform", 2))]);
  key("z", { ctrlKey: true });
  await settled();
  out.undone = JSON.stringify([before, at(joint("platform", 2))]);
  for (const [end, leg, place] of PLACES) await pulled(joint(end, leg), at(joint(end, leg)), place);
  out.said = $("said").textContent;
  out.told = $("told").textContent;
  await save();
  out.saved = $("said").textContent;
  document.querySelector("[data-shown=calibration]").click();
  await settled();
  out.calibrated = $("told").textContent;
  out.overhang = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  out.faults = faults.join("; ");
  out.done = "yes";
})();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="NO CHROMIUM: the page was not opened in a browser")
@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.slow)])
def test_the_page_works_in_a_browser(session, demo, truth, tmp_path, monkeypatch, width):
    """A user walks, pulls, undoes, pins two joints, and the machine snaps to its pose."""
    template, before = server._template, (session / "session.yaml").read_text()
    with serving.listening_socket(0) as socket_:
        port = socket_.getsockname()[1]
        subject = Viewed(load_session(session), demo.calibration)
        pane = subject.drawn(0, 0)
        visible = pane.camera.project(apply(truth.T_camera_base[0], pane.points)).round(1).tolist()
        places = [["platform", 2, visible[1][1]], ["base", 5, visible[0][4]]]
        more = {"view.js": f"const PLACES = {json.dumps(places)};{ACT}"}
        monkeypatch.setattr(server, "_template", lambda name: template(name) + more.get(name, ""))
        app = server.application(subject, TOKEN, port)
        # a thread of its own has no signals to be ended by: it ends with the tests
        threading.Thread(
            target=serving.serve_until_interrupted, args=(app, socket_), daemon=True
        ).start()
        done = subprocess.run(
            [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
             "--disable-background-networking", f"--user-data-dir={tmp_path / 'profile'}",
             "--enable-logging=stderr", "--v=0", f"--window-size={width},900",
             "--virtual-time-budget=60000", "--dump-dom", f"http://127.0.0.1:{port}/{TOKEN}/"],
            capture_output=True, text=True, timeout=240, check=True,
        )  # fmt: skip
    assert not re.search(r"ERROR:CONSOLE|Uncaught|Refused", done.stderr), done.stderr
    root = PageParts(done.stdout).tags[0][1]
    assert root.get("data-done") == "yes", root
    assert root["data-faults"] == ""
    assert root["data-overhang"] == "0"
    station, names = "station1", subject.session.configurations
    assert root["data-walked"] == f"{station} / {names[1]}"
    assert root["data-back"] == f"{station} / {names[0]}"
    for name in ("pulled", "undone"):
        wanted, there = json.loads(root[f"data-{name}"])
        np.testing.assert_allclose(there, wanted, atol=0.2)  # of a tenth, and of the screen's grid
    assert root["data-said"].startswith("Recognised in")
    assert root["data-told"].startswith("It fits")
    assert root["data-saved"].startswith(f"The pose of {station} is in session.yaml")
    assert "px from the calibrated machine" in root["data-calibrated"]
    assert (session / "session.yaml").read_text() != before
    load_session(session)
