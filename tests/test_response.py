"""Response of images to light: the curve, the default for kinds of files, detection from edges."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import FEW_IMPUTATIONS
from faults import raises
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.camera_responses import (
    LEAST_RESPONSE_GAIN,
    ResponseComparison,
    _scored,
    other_response,
    responses_by_edges,
)
from pkmcal.calibration.localization import read_images
from pkmcal.calibration.saved_calibration import load
from pkmcal.cameras.response import levels_of_light, light_in, light_of_levels
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.identify.bundle import bundle
from pkmcal.judge.new_data import _as_calibrated
from pkmcal.observe.legs import measure
from pkmcal.outcome.hypotheses import Ranked
from pkmcal.report.calibration import save
from pkmcal.session.load import load_session
from test_calibration import check_calibration
from test_observe_measure import errors, rms, taken
from test_observe_rendered_legs import FRONT, poses, redrawn, rendered_images

SRGB = np.rint(levels_of_light(np.arange(256.0), "srgb")).astype(np.uint8)


def recode(folder: Path, kind: str, table=None) -> None:
    """A session's images as files of a kind, their levels changed by a table."""
    for path in sorted((folder / "images").rglob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        coded = image if table is None else cv2.LUT(image, table)
        path.unlink()
        quality = [cv2.IMWRITE_JPEG_QUALITY, 97] if kind == ".jpg" else []
        assert cv2.imwrite(str(path.with_suffix(kind)), coded, quality)
    text = (folder / "session.yaml").read_text()
    (folder / "session.yaml").write_text(text.replace(".png", kind))


def stated(folder: Path, response: str) -> None:
    text = (folder / "session.yaml").read_text()
    words = re.sub(r"^( +)(observe: legs.*)$", rf"\1\2\n\1response: {response}", text, flags=re.M)
    assert words != text
    (folder / "session.yaml").write_text(words)


# the curve


def test_the_curve_is_the_standards():
    """IEC 61966-2-1: black and white stay, level 188 is half the light, 10.31 the straight part's
    end, where both parts of the curve agree."""
    light = light_of_levels("srgb")
    assert light[0] == 0
    assert light[255] == 255
    assert light[188] / 255 == pytest.approx(0.503, abs=1e-3)
    assert light[10] == pytest.approx(10 / 12.92)
    assert light[11] == pytest.approx(255 * ((11 / 255 + 0.055) / 1.055) ** 2.4, rel=1e-6)
    np.testing.assert_array_equal(light_of_levels("linear"), np.arange(256))


@given(st.integers(0, 255), st.sampled_from(["linear", "srgb"]))
def test_levels_and_light_are_inverse(level, response):
    assert levels_of_light(light_of_levels(response)[level], response) == pytest.approx(
        level, abs=1e-2
    )


@given(st.lists(st.integers(0, 255), min_size=2, max_size=2))
def test_more_light_has_the_higher_level(pair):
    low, high = sorted(pair)
    light = light_in(np.array([[low, high]], np.uint8), "srgb")
    assert (light[0, 0] < light[0, 1]) == (low < high)


def test_linear_images_are_their_own_light():
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert light_in(image, "linear") is image


# edges


def test_a_blurred_edge_is_where_it_is_by_the_right_code_alone():
    """Painted legs before a darker room: by the wrong code they are wider by tenths of a pixel."""
    pictures = [cv2.LUT(image, SRGB) for image in rendered_images()[0]]
    there = redrawn(0, 0.0005), FRONT, poses()
    shift = {}
    for response in ("srgb", "linear"):
        value = measure(replace(taken(pictures), response=response), *there)
        shift[response] = errors(value.edges)[0]
    assert rms(shift["srgb"]) < 0.05
    assert abs(shift["srgb"].mean()) < 0.03
    assert rms(shift["linear"]) > 2 * rms(shift["srgb"])


def test_light_that_is_cut_off_is_so_by_any_code():
    """Bright legs, overexposed: levels above 250 carry no information, whatever light they
    represent.
    """
    table = np.minimum(1.6 * (255 - np.arange(256)), 255).astype(np.uint8)
    clipped = [cv2.LUT(image, table) for image in rendered_images()[0]]
    there = redrawn(0, 0.0005), FRONT, poses()
    usual = measure(taken(clipped), *there).edges
    coded = taken([cv2.LUT(image, SRGB) for image in clipped])
    count = measure(replace(coded, response="srgb"), *there).edges
    assert 60 < len(usual) < 110
    assert abs(len(count) - len(usual)) < 0.1 * len(usual)
    assert rms(errors(count)[0]) < 1.2 * rms(errors(usual)[0]) + 0.01


# what a session takes for granted


@pytest.mark.parametrize(("kind", "usual"), [(".png", "linear"), (".jpg", "srgb")])
def test_files_of_a_kind_are_taken_for_what_is_usual(session, kind, usual):
    recode(session, kind)
    stations = load_session(session).stations
    assert {station.response for station in stations} == {usual}
    assert not any(station.response_given for station in stations)


def test_what_the_session_states_holds(session):
    stated(session, "srgb")
    stations = load_session(session).stations
    assert {station.response for station in stations} == {"srgb"}
    assert all(station.response_given for station in stations)


def test_a_response_that_there_is_not(session):
    stated(session, "log")
    with raises(InputError, found="'log'") as caught:
        load_session(session)
    assert caught.value.where.endswith("response")
    assert "linear" in caught.value.expected


# detection from edges


def test_a_usual_session_has_no_finding(calibrated):
    assert not calibrated.verdict.of("image.response")


@pytest.fixture(scope="module")
def coded(demo, tmp_path_factory):
    """The demonstration's images with a response unusual for PNG files, and its detection."""
    folder = shutil.copytree(demo.session, tmp_path_factory.mktemp("coded") / "session")
    recode(folder, ".png", SRGB)
    calibration = calibrate_session(folder, options=FEW_IMPUTATIONS)
    return SimpleNamespace(folder=folder, calibration=calibration)


def check_overruled(calibration, value, usual, demo, worse=1.0):
    """And the machine is as accurate as with the default response, except for the effect of the
    kind of file: errors that are so many times as large.
    """
    (hint,) = calibration.verdict.of("image.response")
    assert (hint.facts["other"], hint.facts["usual"]) == (value, usual)
    check_calibration(calibration, demo.session, 0.2e-3 * np.sqrt(18 / 12) * 640 / 480 * worse)
    assert {station.response for station in calibration.session.stations} == {value}


def test_the_edges_overrule_what_is_usual_for_png_files(demo, coded):
    check_overruled(coded.calibration, "srgb", "linear", demo)


@pytest.mark.slow
def test_the_edges_overrule_what_is_usual_for_jpeg_files(demo, session):
    recode(session, ".jpg")
    # over eight such sessions JPEG's own noise makes errors a fifth larger (0.56 mm for 0.46)
    check_overruled(calibrate_session(session), "linear", "srgb", demo, worse=1.2)


def displaced(edges, px):
    """Edges moved outward by px (N,)."""
    normal = edges.normal + np.einsum("nij,nj->ni", edges.basis, px[:, None] * edges.shift)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return replace(edges, normal=normal, basis=tangent_basis(normal, edges.basis[..., 0]))


def painted(estimate):
    """An estimate whose edges no light moves, as those of painted legs."""
    noise = replace(estimate.edge_noise, shading=np.zeros_like(estimate.edge_noise.shading))
    return replace(estimate, edge_noise=noise)


def response_of(calibrated, measurements, estimate, other):
    """Edges (N,) of the first test, and whether all are tested then. other : edges measured with
    the other response.
    """
    edges, every = other, []
    some = np.zeros(len(edges), dtype=bool)

    def roughly(few):
        for p in few:
            own = np.isin(edges.configuration, p.configuration)
            some[own & (edges.station == p.station)] = True
        return edges.select(some)

    def measured(_):
        every.append(True)
        raise ResultError("no edge was measured")

    responses_by_edges(
        calibrated.session,
        read_images(calibrated.session),
        measurements,
        painted(estimate),
        roughly,
        measured,
        lambda edges: replace(measurements, edges=edges),
    )
    return some, bool(every)


@pytest.mark.parametrize("seed", range(2))
def test_edges_that_are_not_asked_do_not_hold_back_those_that_are(calibrated, seed):
    """For a common machine they would: it has absorbed most of a wrong response's effect on all of
    them, and for a part alone no other would fit. Here it moves each line by itself.
    """
    right = calibrated.measurements.edges
    sign = np.random.default_rng(seed).choice([-0.6, 0.6], (3, 6, 2, 2))
    px = sign[right.station, right.leg, right.tube, right.side]
    wrong = replace(calibrated.measurements, edges=displaced(right, px))
    estimate = bundle(calibrated.session.machine, wrong, calibrated.estimate.state)
    some, every = response_of(calibrated, wrong, estimate, right)
    assert 0.2 < np.mean(some) < 0.8
    assert every
    few = {("cameras/camera.yaml", "linear"): right.select(some)}
    weights = np.where(some, estimate.edge_weights, 0.0)
    (gain,) = _scored(wrong, replace(estimate, edge_weights=weights), few)[0].values()
    (held_back,) = _scored(wrong, estimate, few)[0].values()
    assert gain > 5 * LEAST_RESPONSE_GAIN
    assert gain > 5 * held_back


def test_right_images_are_seldom_all_asked(calibrated):
    """Edges of some configurations show no gain: one session of ten has as much by chance, so of
    twenty no more than six.
    """
    right, times = calibrated.measurements.edges, 0
    for seed in range(20):
        px = np.random.default_rng(seed).choice([-0.25, 0.25], len(right))
        other = displaced(right, px)
        some, every = response_of(calibrated, calibrated.measurements, calibrated.estimate, other)
        assert 0 < np.mean(some) < 1
        times += every
    assert times <= 6


def test_a_response_by_which_hardly_an_edge_is_found_is_not_the_images(calibrated):
    """In the dark the wrong response leaves three of a hundred, which do not decide, and the
    message says so.
    """
    few = calibrated.measurements.edges.select(np.arange(3))
    values = responses_by_edges(
        calibrated.session,
        read_images(calibrated.session),
        calibrated.measurements,
        calibrated.estimate,
        lambda _: few,
        lambda _: few,
        lambda edges: replace(calibrated.measurements, edges=edges),
    )
    assert values == ResponseComparison()


def test_stations_whose_response_is_stated_are_not_asked_about(calibrated):
    session = calibrated.session
    stations = tuple(replace(station, response_given=True) for station in session.stations)

    def query(_):
        pytest.fail("its images were measured otherwise")

    values = responses_by_edges(
        replace(session, stations=stations), read_images(session), calibrated.measurements,
        calibrated.estimate, query, query, query,
    )  # fmt: skip
    assert values == ResponseComparison()


@pytest.mark.slow
def test_a_stated_response_is_not_asked_about(session):
    recode(session, ".png", SRGB)
    stated(session, "srgb")
    calibration = calibrate_session(session)
    assert calibration.verdict.usable
    assert not calibration.verdict.of("image.response")


@pytest.mark.parametrize(("gain", "sure"), [(30.0, True), (13.0, False), (-5.0, False)])
def test_undecided_edges_are_a_warning_with_a_next_step(gain, sure):
    ranked = Ranked(other_response(("front", "left"), "linear"), gain / 2)
    values = ResponseComparison((ranked,))
    assert values.by_entry == (dict.fromkeys(("front", "left"), "srgb") if sure else {})
    (finding,) = values.findings
    if sure:
        assert finding.code == "image.response"
        assert "odds of more than 1000 to 1. They are measured so" in finding.text
        assert "write response: srgb in session.yaml, under the stations front" in finding.text
    else:
        assert finding.code == "image.response_unknown"
        assert "levels of the images of front and left are linear" in finding.text
        assert "Write response: linear or response: srgb in session.yaml, under the" in finding.text


@pytest.mark.slow
def test_each_camera_is_asked_by_itself(session):
    """One station's images by a camera of its own, coded; the others' not."""
    names = sorted(path.name for path in (session / "images").iterdir())
    for path in sorted((session / "images" / names[0]).glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert cv2.imwrite(str(path), cv2.LUT(image, SRGB))
    (camera,) = (session / "cameras").glob("*.yaml")
    (session / "cameras" / "own.yaml").write_text(camera.read_text())
    text = (session / "session.yaml").read_text()
    changed = text.replace(f"cameras/{camera.name}", "cameras/own.yaml", 1)
    (session / "session.yaml").write_text(changed)
    calibration = calibrate_session(session)
    entries = {station.camera_file: station.response for station in calibration.session.stations}
    assert entries == {"cameras/own.yaml": "srgb", f"cameras/{camera.name}": "linear"}
    assert [one.facts["other"] for one in calibration.verdict.of("image.response")] == ["srgb"]


def test_new_images_are_measured_as_the_calibration_found_them_to_be(coded, tmp_path):
    save(coded.calibration, tmp_path / "calibration")
    saved = load(tmp_path / "calibration")
    assert {row["response"] for row in saved.document["stations"]} == {"srgb"}
    fresh = _as_calibrated(saved, load_session(coded.folder))
    assert {station.response for station in fresh} == {"srgb"}
    assert all(station.response_given for station in fresh)
