"""The page of a machine: its document against the kinematics, its server, and browsers."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError

import pkmcal
from browsers import DARK, FRAME, NO_GL, SOFTWARE, PageParts, browse
from conftest import run
from pkmcal.api.show import show
from pkmcal.errors import InputError
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.web import serving
from pkmcal.web.bundle_files import SCRIPT_FILE, bundle_file
from pkmcal.web.document import MachineDocument
from pkmcal.web.machine_page import (
    PoseRequest,
    application,
    configuration_at,
    machine_document,
)
from pkmcal.web.motion import Postures, moved
from pkmcal.web.page import standalone_page
from served_pages import PORT, TOKEN, Answer, ServedPage
from test_report_page import HOSTILE

ROUNDING = 2e-6
"""m, of points written to a micrometre."""
MACHINES = sorted(catalogue())


@cache
def document(name: str) -> dict:
    return machine_document(load_mechanism(name), origin="A machine").model_dump(mode="json")


def every_configuration(name: str) -> list[tuple[int | None, float, dict]]:
    """Reading that changed, its value, and the configuration."""
    content = document(name)
    out = [(None, 0.0, content["machine"]["home"])]
    for k, sweep in enumerate(content["sweeps"]):
        pairs = zip(sweep["values"], sweep["configurations"], strict=True)
        out += [(k, value, one) for value, one in pairs if one is not None]
    return out


# ------------------------------------------------------------------ the document


@pytest.mark.parametrize("name", MACHINES)
def test_configurations_agree_with_inverse_kinematics(name):
    """Readings, poses and the drawn ends of all legs belong together."""
    machine = load_mechanism(name)
    changed, values, each = zip(*every_configuration(name), strict=True)
    poses = np.array([one["T_base_platform"] for one in each])
    readings = np.array([one["readings"] for one in each])
    # near the readings: a crank or slider has two solutions
    np.testing.assert_allclose(machine.inverse(poses, readings), readings, atol=ROUNDING)
    lengths = np.array(
        [[np.subtract(leg["platform"][-1], leg["base"][-1]) for leg in one["legs"]] for one in each]
    )
    lengths = np.linalg.norm(lengths, axis=-1)
    scale_one = readings[:, np.maximum(machine.layout.actuated, 0)]
    rods = machine.values[machine.layout.rod] + np.where(machine.layout.rod_reads, scale_one, 0)
    closing = machine.layout.closing
    np.testing.assert_allclose(lengths[:, closing], rods[:, closing], atol=ROUNDING)
    home = readings[0]
    for k, value, row in zip(changed, values, readings, strict=True):
        if k is None:
            continue
        assert row[k] == pytest.approx(value, abs=1e-8)
        if not machine.redundancy:
            np.testing.assert_allclose(np.delete(row, k), np.delete(home, k), atol=1e-8)


@pytest.mark.parametrize("name", MACHINES)
def test_sliders_span_the_ranges_and_hold_home(name):
    machine, content = load_mechanism(name), document(name)["machine"]
    for k, (low, high) in enumerate(machine.joint_ranges):
        reading, values = content["readings"][k], document(name)["sweeps"][k]["values"]
        assert reading["stated"]
        assert (reading["low"], reading["high"]) == pytest.approx((low, high))
        assert values == sorted(values)
        assert min(abs(v - content["home"]["readings"][k]) for v in values) < 1e-8
        assert reading["legs"] == np.flatnonzero(machine.layout.actuated == k).tolist()


@pytest.mark.parametrize("name", MACHINES)
def test_arrows_point_where_readings_grow(name):
    """Between neighbours of a sweep, legs grow and carried ends move along their arrows."""
    machine, content = load_mechanism(name), document(name)
    for k, sweep in enumerate(content["sweeps"]):
        present = [one for one in sweep["configurations"] if one is not None]
        for before, after in pairwise(present):
            for j in content["machine"]["readings"][k]["legs"]:
                old, new = before["legs"][j], after["legs"][j]
                arrow = np.subtract(*np.array(old["positive"])[[1, 0]])
                if machine.layout.rod_reads[j]:
                    travel = np.subtract(old["platform"][-1], old["base"][-1])
                else:
                    travel = np.subtract(new["base"][-1], old["base"][-1])
                assert arrow @ travel > 0.9 * np.linalg.norm(arrow) * np.linalg.norm(travel)


def test_zeros_are_those_of_the_files():
    """H4: an arm of 260 mm on an axis 140 mm outside 60 mm, outwards at zero; a linear delta's
    carriages at zero on the bed.
    """
    zero = document("h4")["machine"]["home"]["legs"][0]["zero"]
    np.testing.assert_allclose(zero, [[0.2, 0.06, 0], [0.46, 0.06, 0]], atol=ROUNDING)
    reading = document("h4")["machine"]["readings"][0]
    assert (reading["direction"], reading["zero"]) == ("turns about +y", "arm along +x")
    feet = [leg["zero"] for leg in document("linear-delta")["machine"]["home"]["legs"]]
    np.testing.assert_allclose(
        feet, [[[-0.1212, -0.07, 0]], [[0.1212, -0.07, 0]], [[0, 0.14, 0]]], atol=ROUNDING
    )


def test_a_leg_s_length_counts_from_its_offset():
    machine = load_mechanism("3-rpr")
    values = machine.values.copy()
    values[machine.parameters.index("legs[1].length.offset")] = 0.05
    content = machine_document(machine.with_values(values), origin="", sweeps=False)
    leg = content.machine.home.legs[0]
    assert np.linalg.norm(np.subtract(leg.zero[-1], leg.base[-1])) == pytest.approx(0.05, abs=1e-5)
    assert content.machine.readings[0].zero == "leg length 50.00 mm"


@pytest.mark.parametrize("name", ["gough-stewart", "3-rps", "four-belt"])
def test_workspace_points_can_be_reached(name):
    machine = load_mechanism(name)
    points = np.array(document(name)["machine"]["workspace"])
    assert len(points) > 50
    if name == "four-belt":  # at the orientation of home
        poses = np.tile(machine.home(), (len(points), 1, 1))
        poses[:, :3, 3] = points
        assert machine.reachable(poses).inside.all()


def test_readings_without_a_range_have_an_assumed_one():
    """Which the page says."""
    machine = load_mechanism("delta")
    legs = tuple(
        leg.model_copy(update={"base": leg.base.model_copy(update={"range": None})})
        for leg in machine.document.legs
    )
    free = replace(machine, document=machine.document.model_copy(update={"legs": legs}))
    content = machine_document(free, origin="", sweeps=False)
    assert not any(reading.stated for reading in content.machine.readings)
    assert len(content.notes) == 1
    assert content.machine.workspace == ()


def test_readings_of_a_redundant_machine_follow():
    machine, content = load_mechanism("four-belt"), document("four-belt")
    assert content["redundant"]
    home = content["machine"]["home"]
    present = {name: home[name] for name in ("readings", "T_base_platform")}
    body = {"index": 0, "value": home["readings"][0] + 0.1, **present}
    request = PoseRequest.model_validate_json(json.dumps(body))
    after = configuration_at(machine, request).configuration
    assert after is not None
    assert after.readings[0] == pytest.approx(home["readings"][0] + 0.1)
    moved = np.subtract(after.T_base_platform, home["T_base_platform"])[:3, 3]
    # the least motion is along the belt
    belt = np.array([1.5, 1.1, 0.0])
    np.testing.assert_allclose(
        moved / np.linalg.norm(moved), belt / np.linalg.norm(belt), atol=0.02
    )


def test_tables_of_legs_have_values_and_sigmas():
    rows = {r["label"]: r["value"] for r in document("gough-stewart")["machine"]["legs"][0]["rows"]}
    assert rows["Base centre"] == "269.30, 20.00, 0.00 mm ± 2 mm"
    assert rows["Tube 1 radius"] == "14.00 mm ± 0.1 mm"


def test_the_document_is_strict():
    content = document("3-rpr")
    assert json.loads(MachineDocument.model_validate_json(json.dumps(content)).model_dump_json())
    with pytest.raises(ValidationError):
        MachineDocument.model_validate_json(json.dumps({**content, "more": 1}))


# ------------------------------------------------------------------ the page


def test_the_page_allows_its_own_scripts_and_nothing_else():
    page = standalone_page(MachineDocument.model_validate_json(json.dumps(document("3-rpr"))))
    tags = PageParts(page).tags
    policy = next(a["content"] for _, a in tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; ")
    assert "unsafe" not in policy
    for tag in ("script", "style"):
        (text,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.S)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    for tag, attributes in tags:
        assert tag not in ("iframe", "object", "embed", "base", "img")
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:")
    assert len(page) < 2e6


def test_hostile_names_stay_text():
    machine = load_mechanism("3-rpr")
    name = HOSTILE + "\u202e\x1b"
    machine = replace(machine, document=machine.document.model_copy(update={"name": name}))
    page = standalone_page(machine_document(machine, origin=HOSTILE))
    tags = PageParts(page).tags
    assert "<script>alert" not in page
    assert [tag for tag, _ in tags].count("script") == 2
    assert not [a for _, a in tags if "onerror" in a]
    text = re.search(r'id="document">(.*?)</script>', page, re.S)
    assert text is not None
    title = json.loads(text[1])["title"]
    assert title.startswith(HOSTILE)
    assert "\\u202e\\x1b" in title


class Page(ServedPage):
    """The page of a machine as it is served."""

    def __init__(self, name):
        machine = load_mechanism(name)
        content = machine_document(machine, origin="", sweeps=False)
        self.app = application(machine, content, TOKEN, PORT)

    def ask(self, **body) -> Answer:
        return self.request(f"/{TOKEN}/pose", json.dumps(body).encode())


def test_poses_are_computed_by_the_program():
    page, home = Page("h4"), document("h4")["machine"]["home"]
    assert page.get().status == 200
    assert page.get("viewer.js").content.startswith(b"/*! pkmcal viewer;")
    assert page.get("viewer.css").headers["content-type"].startswith("text/css")
    assert page.get("", "another").status == 403
    present = {"readings": home["readings"], "T_base_platform": home["T_base_platform"]}
    after = page.ask(index=1, value=0.7, **present).json()["configuration"]
    T = load_mechanism("h4").forward(np.array([[home["readings"][0], 0.7, *home["readings"][2:]]]))
    np.testing.assert_allclose(after["T_base_platform"], T[0], atol=1e-7)
    # from where the sweep has no pose onwards, there is none
    k = next(k for k, s in enumerate(document("h4")["sweeps"]) if None in s["configurations"])
    sweep = document("h4")["sweeps"][k]
    value = sweep["values"][sweep["configurations"].index(None)]
    assert page.ask(index=k, value=value, **present).json() == {"configuration": None}


@pytest.mark.parametrize(
    "change",
    [{"index": 9}, {"index": -1}, {"value": 99.0}, {"value": None}, {"readings": [0.1]},
     {"T_base_platform": np.zeros((4, 4)).tolist()}, {"more": 1}],
    ids=str,
)  # fmt: skip
def test_other_requests_are_refused(change):
    home = document("h4")["machine"]["home"]
    body = {"index": 0, "value": 0.6, "readings": home["readings"],
            "T_base_platform": home["T_base_platform"], **change}  # fmt: skip
    answer = Page("h4").ask(**body)
    assert answer.status == 422
    assert answer.json()["message"]


# ------------------------------------------------------------------ the command, and Python


def test_the_command_writes_a_page(tmp_path):
    target = tmp_path / "new" / "delta.html"
    done = run("show", "delta", "-o", target, "--json")
    assert (done.code, json.loads(done.out)["file"]) == (0, str(target))
    first = target.read_bytes()
    assert run("show", "delta", "-o", target).code == 0  # over its own
    assert target.read_bytes() == first
    target.write_text("mine")
    done = run("show", "delta", "-o", target)
    assert (done.code, target.read_text()) == (2, "mine")


def test_what_cannot_be_shown_is_an_input_error(tmp_path):
    assert run("show", "dleta").code == 2
    assert "delta" in run("show", "dleta").err
    assert run("show", tmp_path / "none.yaml").code == 2
    text = catalogue()["delta"].read_text().replace("constant: 0.22", "constant: 0.02")
    (tmp_path / "apart.yaml").write_text(text)
    done = run("show", tmp_path / "apart.yaml", "-o", tmp_path / "apart.html", "--json")
    assert done.code == 2
    assert "apart.yaml" in json.loads(done.out)["where"]
    assert not (tmp_path / "apart.html").exists()


def test_the_command_serves_until_it_is_interrupted():
    words = [sys.executable, "-m", "pkmcal", "show", "3-rpr", "--json"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        url = json.loads(process.stdout.readline())["url"]
        with urllib.request.urlopen(url, timeout=60) as answer:
            assert b'id="document"' in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert process.stdout.read() == process.stderr.read() == ""


def test_a_session_and_a_calibration_have_their_cameras(demo):
    session = pkmcal.load_session(demo.session)
    names = [station.name for station in session.stations]
    assert list(show(demo.session).cameras) == names
    calibrated = show(demo.calibration)
    assert list(calibrated.cameras) == names
    shapes = calibrated.served().machine.cameras
    assert [len(shape.lines) for shape in shapes] == [5] * len(names)
    for shape in shapes:
        T = calibrated.cameras[shape.name][1]
        np.testing.assert_allclose(shape.position, T[:3, 3], atol=ROUNDING)
    assert calibrated.sigma is not None


def test_a_session_is_shown_before_anything_was_measured(tmp_path):
    pkmcal.new("gough-stewart").save(tmp_path / "mine")
    document = pkmcal.show(tmp_path / "mine").document
    assert document["machine"]["name"] == "gough-stewart"
    assert len(document["machine"]["legs"]) == 6


def test_a_view_in_python(tmp_path):
    view = pkmcal.show("3-rpr")
    assert view.document["machine"]["name"] == "3-rpr"
    frame = view._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!doctype html&gt;')
    assert 'sandbox="allow-scripts allow-downloads"' in frame
    assert pkmcal.show(load_mechanism("3-rpr")).document["machine"] == view.document["machine"]
    (tmp_path / "mine.html").write_text("mine")
    with pytest.raises(InputError):
        view.save(tmp_path / "mine.html")


# ------------------------------------------------------------------ in a browser

ACT = """
const faults = [];
addEventListener("error", (event) => { if (event.message) faults.push(event.message); });
addEventListener("unhandledrejection", (event) => faults.push(String(event.reason)));
document.addEventListener("securitypolicyviolation", (event) => {
  faults.push(`blocked ${event.blockedURI} ${event.violatedDirective}`);
});
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
addEventListener("load", async () => {
  const out = document.documentElement.dataset, $ = (query) => document.querySelector(query);
  const canvas = $(".stage canvas");
  const cells = () =>
    [...document.querySelectorAll(".platform tbody td")].map((cell) => cell.textContent);
  const drawn = async () => { await wait(1000); return canvas ? canvas.toDataURL() : ""; };
  const set = async (selector, value) => {
    const input = $(selector);
    input.value = value;
    input.dispatchEvent(new Event(input.type === "range" ? "input" : "change"));
    return drawn();
  };
  const first = await drawn();
  out.canvas = canvas ? `${canvas.clientWidth} ${canvas.clientHeight}` : "none";
  out.home = JSON.stringify(cells());
  const second = await set('[data-reading="0"] input[type=range]', MOVED);
  out.moved = JSON.stringify(cells());
  out.redrawn = first !== second;
  out.readings = JSON.stringify(
    [...document.querySelectorAll(".readings input[type=range]")].map((one) => one.valueAsNumber));
  const boxes = [...document.querySelectorAll(".labels span")]
    .filter((label) => label.style.visibility === "visible")
    .map((label) => label.getBoundingClientRect());
  out.labels = boxes.length;
  out.overlaps = boxes.filter((a, k) => boxes.slice(0, k).some((b) =>
    a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)).length;
  if (REFUSED !== null) {
    const slider = `[data-reading="${REFUSED[0]}"] input[type=range]`;
    await set(slider, REFUSED[1]);
    out.status = $(".status").textContent;
    out.invalid = $(slider).getAttribute("aria-invalid");
  }
  $("aside button").click();
  await drawn();
  out.again = JSON.stringify(cells());
  $(".leg-buttons button").click();
  out.rows = document.querySelectorAll(".values tr").length;
  if (canvas) {
    const before = await drawn();
    canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" }));
    out.turned = before !== await drawn();
  }
  out.paper = getComputedStyle(document.body).backgroundColor;
  out.overhang = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  out.faults = faults.join("; ");
  out.done = "yes";
  parent.postMessage({ ...out }, "*");
});
"""


def acting(page: str, script: str) -> str:
    """The page with a script that its policy allows, before its own."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = page.replace("script-src ", f"script-src 'sha256-{digest}' ", 1)
    return page.replace('<div id="viewer">', f'<script>{script}</script><div id="viewer">', 1)


def fine(root: dict[str, str]) -> None:
    assert root["faults"] == ""
    assert root["overhang"] == "0"
    assert json.loads(root["home"]) == json.loads(root["again"])
    assert json.loads(root["home"]) != json.loads(root["moved"])
    assert int(root["rows"]) > 3


@pytest.mark.parametrize(("width", "dark"), [(1440, False), (390, True)])
def test_a_written_page_works_in_a_browser(tmp_path, width, dark):
    """Sliders move the machine on the sweeps; a reading without a pose is said."""
    content = document("h4")
    k = next(k for k, s in enumerate(content["sweeps"]) if None in s["configurations"])
    empty = content["sweeps"][k]["values"][content["sweeps"][k]["configurations"].index(None)]
    page = standalone_page(MachineDocument.model_validate_json(json.dumps(content)))
    script = f"const MOVED = 0.8, REFUSED = {json.dumps([k, empty])};{ACT}"
    (tmp_path / "page.html").write_text(acting(page, script), encoding="utf-8")
    (tmp_path / "frame.html").write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    options = (*SOFTWARE, DARK) if dark else SOFTWARE
    root = browse((tmp_path / "frame.html").as_uri(), tmp_path, 1500, *options)
    fine(root)
    assert root["redrawn"] == root["turned"] == "true"
    assert (root["invalid"], bool(root["status"])) == ("true", True)
    assert int(root["labels"]) > 4
    assert root["overlaps"] == "0"
    drawn_width, height = map(int, root["canvas"].split())
    assert 0.6 * width - 20 < drawn_width <= width
    assert height > 250
    assert root["paper"] == ("rgb(20, 23, 27)" if dark else "rgb(244, 245, 247)")
    # the sweep's nearest value, with the others at home
    readings, home = json.loads(root["readings"]), content["machine"]["home"]["readings"]
    assert readings[0] == pytest.approx(0.8, abs=0.02)
    np.testing.assert_allclose(readings[1:], home[1:], atol=0.005)  # a slider's step


def with_act(app, script: str):
    """The application with a script before its bundle."""
    from starlette.responses import Response

    async def both(scope, receive, send):
        if scope["type"] == "http" and scope["path"] == f"/{TOKEN}/{SCRIPT_FILE}":
            content = script + bundle_file(SCRIPT_FILE)
            await Response(content, media_type="text/javascript")(scope, receive, send)
        else:
            await app(scope, receive, send)

    return both


def test_a_served_page_works_in_a_browser_without_webgl(tmp_path):
    """A sentence stands in the stage's place; readings and values work as before."""
    machine = load_mechanism("gough-stewart")
    content = machine_document(machine, origin="", sweeps=False)
    with serving.listening_socket(0) as socket_:
        port = socket_.getsockname()[1]
        app = with_act(
            application(machine, content, TOKEN, port), f"const MOVED = 0.45, REFUSED = null;{ACT}"
        )
        # a thread of its own has no signals to be ended by: it ends with the tests
        threading.Thread(
            target=serving.serve_until_interrupted, args=(app, socket_), daemon=True
        ).start()
        root = browse(f"http://127.0.0.1:{port}/{TOKEN}/", tmp_path, 1440, *NO_GL)
    fine(root)
    assert root["canvas"] == "none"
    home = content.machine.home.readings
    T = machine.forward(np.array([[0.45, *home[1:]]]))[0]
    position = [float(text.replace("\u2212", "-")) for text in json.loads(root["moved"])[:3]]
    np.testing.assert_allclose(position, 1e3 * T[:3, 3], atol=0.2)  # a slider's step


def test_another_page_with_the_bundle_is_left_alone(tmp_path):
    page = tmp_path / "report.html"
    page.write_text(f"<script>{bundle_file('viewer.js')}</script>")
    before = page.read_bytes()
    done = run("show", "3-rpr", "-o", page, "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")
    assert page.read_bytes() == before


@pytest.mark.parametrize("option", ["--port=8000", "--no-browser"])
def test_options_of_a_served_page_are_refused_with_a_file(tmp_path, option):
    done = run("show", "3-rpr", "-o", tmp_path / "page.html", option, "--json")
    assert (done.code, done.json["where"]) == (2, option.partition("=")[0])
    assert not (tmp_path / "page.html").exists()


def test_a_motion_far_beyond_the_range_has_no_pose():
    machine = load_mechanism("3-rpr")
    home = Postures(machine.inverse(machine.home()[None]), machine.home()[None])
    assert np.isnan(moved(machine, home, 0, 1e9, 0.1).readings).all()
    assert np.isfinite(
        moved(machine, home, 0, float(home.readings[0, 0]) + 0.01, 0.1).readings
    ).all()
