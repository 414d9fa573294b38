"""Images of the report: strips along edges, layers, and the inspector in a browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.special import ndtr

from page_documents import page_blocks, page_document
from pkmcal.identify.centres import joint_centres
from pkmcal.identify.tool import centres_and_tool
from pkmcal.observe.images import Pictures, upright_turns
from pkmcal.outcome import Verdict
from pkmcal.report import pictures
from pkmcal.report.calibration import report_of
from pkmcal.report.residuals import outward_shift
from pkmcal.report.strips import STRIP_ROWS, edge_lines, sampled_strip, strips_of_image
from pkmcal.web.report_page import report_page
from test_report_case import OUTWARD, Case, calibration, make_case

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
MIDDLE = (STRIP_ROWS - 1) / 2
BLUR = 0.8
"""Standard deviation (px) of the blur of the synthetic edges."""


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    return make_case(tmp_path_factory.mktemp("session"))


def decoded(webp: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(webp), np.uint8), cv2.IMREAD_GRAYSCALE)


def image_of_edge(curve, outward, size) -> np.ndarray:
    """Edge of a bright tube on a dark background, by the distance of each pixel from its curve.

    outward : unit vector to the dark side.
    """
    width, height = size
    at = np.linspace(0, len(curve) - 1, 600)
    dense = np.stack([np.interp(at, np.arange(len(curve)), x) for x in curve.T], axis=-1)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    apart, near = cKDTree(dense).query(pixels, distance_upper_bound=STRIP_ROWS)
    pixels, near, inside = pixels[np.isfinite(apart)], near[np.isfinite(apart)], np.isfinite(apart)
    tangent = np.gradient(dense, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    normal *= np.sign(normal @ outward)[:, None] / np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.sum((pixels - dense[near]) * normal[near], axis=1)
    image = np.zeros(width * height, np.uint8)
    image[inside] = np.rint(30 + 200 * ndtr(-distance / BLUR))
    return image.reshape(height, width)


def step_rows(strip) -> np.ndarray:
    """Row of the first crossing of half the step in each column, from the outside."""
    half = (float(strip.min()) + float(strip.max())) / 2
    rows = []
    for column in strip.T.astype(float):
        k = int(np.argmax(column > half)) - 1
        rows.append(k + (half - column[k]) / (column[k + 1] - column[k]))
    return np.array(rows)


@pytest.mark.parametrize("tilt", [-0.02, 0.0, 0.01])
def test_a_step_lies_in_its_strip_where_it_lies_in_the_image(tilt):
    """A step 1.3 px outward in the middle of a predicted edge, at several angles to it."""
    for angle in np.deg2rad([0.0, 17.0, 225.0]):
        along, outward = (np.array([np.cos(a), np.sin(a)]) for a in (angle, angle - np.pi / 2))
        place = np.linspace(-70.2, 70.2, 65)
        curve = np.array([90.3, 89.6]) + place[:, None] * along
        offset = 1.3 + tilt * place
        image = image_of_edge(curve + offset[:, None] * outward, outward, (180, 180))
        strip, columns = sampled_strip(image, curve, np.tile(outward, (65, 1)))
        assert strip.shape == (STRIP_ROWS, 142)
        expected = MIDDLE - np.interp(np.arange(142), columns, offset)
        # the image's step ends where the curve does
        np.testing.assert_allclose(step_rows(strip)[3:-3], expected[3:-3], atol=0.05)


def test_the_fitted_line_lies_on_the_edge_in_the_strip(case):
    """Of edges as a lens bends them, by the strips that the page holds."""
    c = calibration(case.session, case.observation, case.estimate)
    size = case.session.stations[0].camera.image_size
    edges = case.observation.edges
    mine = np.flatnonzero((edges.station == 0) & (edges.configuration == 0) & (edges.tube == 0))
    lines = edge_lines(c, mine, 0)
    np.testing.assert_allclose(lines.offset.mean(axis=1), OUTWARD, atol=2e-3)
    curves = pictures.edge_curves(c, mine, 0)
    for k in range(0, len(mine), 3):
        tube = image_of_edge(curves[k], lines.normal[k].mean(axis=0), size)
        (strip,), webp = strips_of_image(tube, lines.select(mine == mine[k]))
        level = decoded(webp)
        assert level.shape == (STRIP_ROWS, strip.length)
        at = np.linspace(0, strip.length - 1, len(strip.offset))
        expected = MIDDLE - np.interp(np.arange(strip.length), at, strip.offset)
        # with the noise of the compression
        np.testing.assert_allclose(step_rows(level)[3:-3], expected[3:-3], atol=0.1)


def test_sigma_of_a_fitted_line_is_the_scatter_of_its_normal(case):
    c = calibration(case.session, case.observation, case.estimate)
    edges, n = case.observation.edges, 400
    rng = np.random.default_rng(3)
    one = int(np.flatnonzero(edges.station == 0)[5])
    noise = rng.multivariate_normal(np.zeros(2), edges.covariance[one], n)
    scale = case.estimate.statistics.noise_scale
    many = edges.select(np.full(n, one))
    normal = many.normal + scale * noise @ many.basis[0].T
    drawn = replace(case.observation, edges=replace(many, normal=normal))
    moved = edge_lines(calibration(case.session, drawn, case.estimate), np.arange(n), 0)
    (sigma,) = edge_lines(c, np.array([one]), 0).sigma
    # 400 draws: 3.5 % each
    np.testing.assert_allclose(moved.offset.std(axis=0), sigma, rtol=0.15)


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 1), (8, 3)])
def test_images_are_upright_by_exif(tmp_path, orientation, turns):
    from pkmcal.files.images import Exif, with_exif

    grey = np.zeros((24, 32), np.uint8)
    path = tmp_path / "a.jpg"
    path.write_bytes(with_exif(cv2.imencode(".jpg", grey)[1].tobytes(), Exif(orientation)))
    assert upright_turns(path, (32, 24)) == turns
    # the decoder has turned it, where the camera file has the two exchanged
    assert upright_turns(path, (24, 32)) == 0
    assert upright_turns(tmp_path / "absent.jpg", (32, 24)) == 0


def test_a_mean_image_is_the_mean_of_those_that_can_be_read(tmp_path):
    from pkmcal.report.field import mean_image

    for k, level in enumerate((10, 40, 100)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((24, 32), level, np.uint8))
    names = ["0.png", "1.png", "absent.png", "2.png"]
    images = Pictures([tmp_path / name for name in names], (32, 24), names)
    mean = mean_image(images)
    assert mean is not None
    assert np.all(mean == 50)
    assert mean_image([]) is None


# ------------------------------------------------------------------ the page


@pytest.fixture(scope="module")
def page(case) -> str:
    verdict = Verdict(True, "Good to use.")
    value = calibration(case.session, case.observation, case.estimate, verdict)
    return report_page(report_of(value))


def test_strips_are_shown_as_far_as_there_is_room(case):
    value = calibration(case.session, case.observation, case.estimate)
    shifts = np.zeros(len(case.observation.edges))
    centres, _ = centres_and_tool(case.session.machine, case.estimate, case.session.joints)
    few = pictures.AlbumSize(strip_characters=30_000)
    with_strips = [bool(one.strips) for one in pictures.album(value, shifts, centres, few).images]
    n = sum(with_strips)
    assert 0 < n < 15
    assert with_strips == [True] * n + [False] * (15 - n)


def test_the_page_holds_each_image_once_with_its_strips(page, case):
    (block,) = page_blocks(page_document(page), "images", "photographs")
    images = block["images"]
    assert len(images) == 15
    assert all(one["strips"] for one in images)
    size = case.session.stations[0].camera.image_size
    for image in images:
        assert page.count(image["webp"]) >= 1
        assert decoded(image["webp"]).shape == size[::-1]
        (overlay,) = image["overlays"]
        layers = {layer["name"]: layer["shapes"] for layer in overlay["layers"]}
        assert len(layers["joints"]) == len(layers["nominal"]) == 12
        with_strip = [line["strip"] for line in layers["edges"] if "strip" in line]
        assert with_strip == list(range(len(image["strips"])))
        assert decoded(image["strip_webp"]).shape == (
            len(image["strips"]) * STRIP_ROWS, max(one["length"] for one in image["strips"]),
        )  # fmt: skip
        assert image["strip_rows"] == STRIP_ROWS
        for line in layers["edges"]:
            if "strip" in line:
                offset = image["strips"][line["strip"]]["offset"]
                assert stated_offset(line["tip"]) == offset[len(offset) // 2]
    assert any(line.get("dashed") for one in images for line in edges_of_image(one))
    # keys are those of the selection
    assert images[0]["key"] == "image:" + images[0]["title"].replace(" / ", "/")


def stated_offset(tip: str) -> float:
    """Displacement (px) in the tooltip of an edge."""
    text = tip.partition(": ")[2].partition(" px")[0].partition(" ±")[0]
    return float(text.replace("\N{MINUS SIGN}", "-"))


def edges_of_image(image):
    layers = image["overlays"][0]["layers"]
    return next(layer["shapes"] for layer in layers if layer["name"] == "edges")


def test_arrows_of_the_field_lead_to_images(page):
    document = page_document(page)
    (field,) = page_blocks(document, "images", "field")
    (block,) = page_blocks(document, "images", "photographs")
    keys = {image["key"] for image in block["images"]}
    arrows = [
        shape
        for image in field["images"]
        for shape in image["overlays"][0]["layers"][0]["shapes"]
        if shape["shape"] == "arrow" and "label" not in shape
    ]
    assert arrows
    assert {arrow["key"] for arrow in arrows} <= keys
    # the scale is 1, 2 or 5 times a power of ten, and a tenth to a fifth of the image as drawn
    for image in field["images"]:
        (layer,) = image["overlays"][0]["layers"]
        (scale,) = [one for one in layer["shapes"] if one.get("label")]
        length = scale["displacement"][0]
        assert f"{length:e}"[0] in "125"
        assert scale["label"] == f"{length:g} px"
        assert 0.07 < length * layer["enlargement"] / image["width"] <= 0.2


def test_corners_and_joints_are_apart_in_layers(case):
    estimate = case.estimate
    centres = joint_centres(case.session.machine, estimate.machine, estimate.covariance)
    value = calibration(case.session, case.observation, estimate)
    album = pictures.album(value, np.zeros(len(case.observation.edges)), centres)
    names = {
        layer.name for image in album.images for layer in image.overlays[0].layers if layer.shapes
    }
    assert names == {"edges", "residuals", "rejected", "joints", "nominal"}


def test_residual_arrows_lead_from_their_edges_to_those_of_the_machine(case):
    """Their tails are on the measured lines, and their lengths are the stated shifts."""
    estimate, observation = case.estimate, case.observation
    value = calibration(case.session, observation, estimate)
    centres = joint_centres(case.session.machine, estimate.machine, estimate.covariance)
    shifts = outward_shift(
        observation.edges, estimate, case.session.joints, case.session.camera_of_station
    )
    pairs = []
    for image in pictures.album(value, shifts, centres).images:
        layers = {layer.name: layer.shapes for layer in image.overlays[0].layers}
        lines = layers["edges"]
        n, ends = zip(
            *((n, two) for n, one in enumerate(lines) for two in pairwise(one.points)), strict=True
        )
        start, along = np.array(ends)[:, 0], np.diff(ends, axis=1)[:, 0]
        normal = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1)[:, None]
        for arrow in layers.get("residuals", ()):
            off, displacement = np.array(arrow.at) - start, np.array(arrow.displacement)
            share = np.sum(off * along, axis=1) / np.sum(along**2, axis=1)
            distance = np.abs(np.sum(off * normal, axis=1))
            k = int(np.where(np.abs(share - 0.5) < 0.5, distance, np.inf).argmin())
            assert distance[k] < 0.17  # lines are straight to 0.1 px, and tails are rounded
            stated = stated_offset(lines[n[k]].tip)
            across = displacement @ normal[k]
            assert abs(np.hypot(*displacement) - abs(across)) < 2e-3
            pairs.append((abs(across), abs(stated)))
    assert len(pairs) > 100
    drawn, stated = np.array(pairs).T
    np.testing.assert_allclose(drawn, stated, atol=0.02)


INSPECTED = """
  const tell = document.documentElement.dataset;
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  const $ = (query) => document.querySelector(query);
  const grid = "#photographs .images";
  const buttons = () => [...document.querySelectorAll(`${grid} .enlarge`)];
  const caption = () => $(".inspector-caption b").textContent;
  const picture = () => $(".inspected svg");
  const box = () => picture().getAttribute("viewBox").split(" ").map(Number);
  const key = (name) => picture().dispatchEvent(
    new KeyboardEvent("keydown", { key: name, bubbles: true, cancelable: true }));
  (async () => {
    tell.few = buttons().length;
    [...document.querySelectorAll("#photographs .images-bar button")].at(-1).click();
    tell.all = buttons().length;
    tell.captions = JSON.stringify([...document.querySelectorAll(`${grid} figcaption b`)]
      .map((one) => one.textContent));
    buttons()[0].click();
    await wait(200);
    tell.first = caption();
    tell.whole = JSON.stringify(box());
    const host = $(".inspected").getBoundingClientRect();
    const part = (from, size, share) => Math.round(from + share * size);  // a wheel's are whole
    const at = {
      clientX: part(host.left, host.width, 0.7), clientY: part(host.top, host.height, 0.4),
    };
    const under = () => {  // pixel of the image under the pointer
      const point = new DOMPoint(at.clientX, at.clientY);
      const { x, y } = point.matrixTransform(picture().getScreenCTM().inverse());
      return [x, y];
    };
    const before = under();
    const turn = { deltaY: -900, cancelable: true, bubbles: true, ...at };
    $(".inspected").dispatchEvent(new WheelEvent("wheel", turn));
    tell.under = JSON.stringify([before, under()]);
    tell.near = JSON.stringify(box());
    for (let k = 0; k < 9; k += 1) $(".inspected").dispatchEvent(new WheelEvent("wheel", turn));
    tell.pixel = host.width / box()[2];
    tell.sharp = getComputedStyle(picture().querySelector("image")).imageRendering;
    const hidden = (name) =>
      getComputedStyle(picture().querySelector(`[data-layer=${name}]`)).display === "none";
    key("e");
    tell.edges = hidden("edges");
    key("n");
    tell.crosses = [hidden("nominal"), hidden("joints")].join();
    const gamma = $(".inspector-gamma input");
    gamma.value = 0.45;
    gamma.dispatchEvent(new Event("input"));
    const exponent = () => {
      const [filter] = picture().querySelector("image").style.filter.match(/#[\\w-]+/);
      return $(`${filter} feFuncG`).getAttribute("exponent");
    };
    await wait(50);
    tell.gamma = exponent();
    key("x");
    key("x");
    const strip = $(".strip-image");
    const title = $(".strip-title").firstChild.data;
    tell.strip = [title, strip.getBoundingClientRect().height].join("|");
    tell.rows = strip.viewBox.baseVal.height;
    $(".strip-title button:last-of-type").click();
    tell.fine = $(".strip-image").viewBox.baseVal.height;
    key("ArrowRight");
    tell.second = caption();
    await wait(50);
    tell.again = [hidden("edges"), exponent(), $(".strip")].join();
    await wait(100);
    tell.fitted = JSON.stringify(box());
    key("ArrowLeft"); key("ArrowLeft");
    tell.last = caption();
    $(".inspector-close").click();
    await wait(100);
    $("#field details").open = true;
    await wait(200);
    // an arrow of the field leads to its image
    const arrow = $("#field .residuals [data-key]");
    arrow.dispatchEvent(new MouseEvent("click", { bubbles: true }));
    await wait(200);
    tell.led = [arrow.dataset.key, caption()].join("|");
    // the image stays under a pointer that moves, and keys act after a button that is gone
    const layer = $(".inspector-bar [data-layer]");
    layer.focus();
    key("ArrowRight");
    tell.focused = document.activeElement.className;
    tell.stepped = caption();
    $(`${grid} [data-key]`).dispatchEvent(new PointerEvent("pointerover", { bubbles: true }));
    await wait(50);
    tell.stayed = caption();
    tell.dialogs = document.querySelectorAll("dialog").length;
    tell.overhang = document.documentElement.scrollWidth - document.documentElement.clientWidth;
    tell.done = "yes";
  })();"""


@pytest.mark.skipif(CHROMIUM is None, reason="NO CHROMIUM: the page was not opened in a browser")
def test_images_are_inspected(page, tmp_path):
    """The wheel zooms about the pointer to single pixels; keys switch layers, images, strips."""
    act = f'<script>addEventListener("load", () => {{{INSPECTED}}});</script></body>'
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    file = tmp_path / "page.html"
    file.write_text(text.replace("</body>", act), encoding="utf-8")
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
         "--no-first-run", f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr",
         "--v=0", "--window-size=1280,900", "--virtual-time-budget=20000", "--dump-dom",
         file.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    faults = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not re.search(r"ERROR:CONSOLE|Uncaught|Refused", "\n".join(faults)), faults
    head = re.search(r"<html[^>]*>", done.stdout)
    assert head is not None
    root = {
        name: value.replace("&quot;", '"')
        for name, value in re.findall(r'data-(\w+)="([^"]*)"', head[0])
    }
    assert root.get("done") == "yes", root
    assert (root["few"], root["all"], root["overhang"]) == ("12", "15", "0")
    captions = json.loads(root["captions"])
    assert [root[name] for name in ("first", "second", "last")] == [
        captions[0], captions[1], captions[-1],
    ]  # fmt: skip
    before, after = json.loads(root["under"])
    np.testing.assert_allclose(after, before, atol=0.05)
    whole, near, fitted = (json.loads(root[name]) for name in ("whole", "near", "fitted"))
    assert near[2] == pytest.approx(whole[2] * np.exp(-1.8), rel=1e-3)
    assert fitted == pytest.approx(whole)
    assert float(root["pixel"]) == pytest.approx(80, rel=1e-3)
    assert root["sharp"] == "pixelated"
    assert root["edges"] == "true"
    assert root["crosses"] == "true,false"
    assert root["gamma"] == "0.45"
    assert root["again"] == "true,0.45,"
    # the second edge's strip, eight screen pixels for one across it
    (block,) = page_blocks(page_document(page), "images", "photographs")
    title, height = root["strip"].split("|")
    lines = edges_of_image(block["images"][0])
    assert title.replace("&nbsp;", " ") == next(x["tip"] for x in lines if x.get("strip") == 1)
    assert float(height) == 8 * STRIP_ROWS
    assert (float(root["rows"]), float(root["fine"])) == (STRIP_ROWS, STRIP_ROWS / 8)
    key, led = root["led"].split("|")
    assert key == "image:" + led.replace(" / ", "/")
    assert root["focused"] == "inspector"
    assert root["stayed"] == root["stepped"] != led
    assert root["dialogs"] == "1"
