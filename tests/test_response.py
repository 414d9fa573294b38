"""How photographs code light: the curve, what is usual for files of a kind, what edges tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.coded import CodeTold
from pkmcal.calibration.results import refined_camera, texts_of
from pkmcal.cameras.response import levels_of_light, light_in, light_of_levels
from pkmcal.errors import InputError
from pkmcal.observe.legs import measure
from pkmcal.session.load import load_session
from test_calibration import check_found
from test_observe_drawing import FRONT, camera_of, photographs, poses, redrawn
from test_observe_measure import errors, rms, taken

SRGB = np.rint(levels_of_light(np.arange(256.0), "srgb")).astype(np.uint8)


def recode(folder: Path, kind: str, table=None) -> None:
    """A session's photographs as files of a kind, their levels changed by a table."""
    for path in sorted((folder / "images").rglob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        coded = image if table is None else cv2.LUT(image, table)
        path.unlink()
        quality = [cv2.IMWRITE_JPEG_QUALITY, 97] if kind == ".jpg" else []
        assert cv2.imwrite(str(path.with_suffix(kind)), coded, quality)
    text = (folder / "session.yaml").read_text()
    (folder / "session.yaml").write_text(text.replace(".png", kind))


def stated(folder: Path, response: str) -> None:
    for path in (folder / "cameras").glob("*.yaml"):
        path.write_text(path.read_text() + f"response: {response}\n")


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


@pytest.mark.parametrize("response", ["linear", None])
def test_linear_photographs_are_their_own_light(response):
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert light_in(image, response) is image


# edges


def test_a_blurred_edge_is_where_it_is_by_the_right_code_alone():
    """Painted legs before a darker room: by the wrong code they are wider by tenths of a pixel."""
    pictures = [cv2.LUT(image, SRGB) for image in photographs()[0]]
    there = redrawn(0, 0.0005), FRONT, poses()
    shift = {}
    for response in ("srgb", "linear"):
        camera = replace(camera_of(), response=response)
        found = measure(replace(taken(pictures), camera=camera), *there)
        shift[response] = errors(found.edges)[0]
    assert rms(shift["srgb"]) < 0.05
    assert abs(shift["srgb"].mean()) < 0.03
    assert rms(shift["linear"]) > 2 * rms(shift["srgb"])


def test_light_that_is_cut_off_is_so_by_any_code():
    """Bright legs, overexposed: levels from 250 on say nothing, whatever light they stand for."""
    table = np.minimum(1.6 * (255 - np.arange(256)), 255).astype(np.uint8)
    clipped = [cv2.LUT(image, table) for image in photographs()[0]]
    there = redrawn(0, 0.0005), FRONT, poses()
    usual = measure(taken(clipped), *there).edges
    coded = taken([cv2.LUT(image, SRGB) for image in clipped])
    found = measure(replace(coded, camera=replace(camera_of(), response="srgb")), *there).edges
    assert 60 < len(usual) < 110
    assert abs(len(found) - len(usual)) < 0.1 * len(usual)
    assert rms(errors(found)[0]) < 1.2 * rms(errors(usual)[0]) + 0.01


# what a session takes for granted


@pytest.mark.parametrize(("kind", "usual"), [(".png", "linear"), (".jpg", "srgb")])
def test_files_of_a_kind_are_taken_for_what_is_usual(session, kind, usual):
    recode(session, kind)
    stations = load_session(session).stations
    assert {station.camera.response for station in stations} == {usual}
    assert not any(station.response_told for station in stations)


def test_what_the_camera_file_says_holds(session):
    stated(session, "srgb")
    stations = load_session(session).stations
    assert {station.camera.response for station in stations} == {"srgb"}
    assert all(station.response_told for station in stations)


def test_a_response_that_there_is_not(session):
    stated(session, "log")
    with pytest.raises(InputError) as caught:
        load_session(session)
    message = str(caught.value)
    assert "response" in message
    assert "log" in message
    assert "linear" in message


# what edges tell


def test_a_session_that_is_as_usual_says_nothing(calibrated):
    assert not any("code light" in hint for hint in calibrated.verdict.advice)


@pytest.mark.parametrize(
    ("kind", "table", "found", "usual"),
    [
        (".png", SRGB, "as sRGB, as telephones do", "linearly, as sensors count it"),
        (".jpg", None, "linearly, as sensors count it", "as sRGB, as telephones do"),
    ],
)  # fmt: skip
def test_the_edges_overrule_what_is_usual(demo, session, kind, table, found, usual):
    """And the machine is found as well as where it is as usual."""
    recode(session, kind, table)
    calibration = calibrate_session(session)
    (hint,) = [text for text in calibration.verdict.advice if "code light" in text]
    assert f"code light {found}, not {usual}, which is usual" in hint
    check_found(calibration, demo.session, 0.2e-3 * np.sqrt(18 / 12) * 640 / 480)
    response = {station.camera.response for station in calibration.session.stations}
    assert response == {"srgb" if table is not None else "linear"}


def test_a_stated_response_is_not_asked_about(session):
    recode(session, ".png", SRGB)
    stated(session, "srgb")
    calibration = calibrate_session(session)
    assert calibration.verdict.usable
    assert not any("code light" in hint for hint in calibration.verdict.advice)


@pytest.mark.parametrize(("gain", "sure"), [(30.0, True), (13.0, False), (-5.0, False)])
def test_edges_that_do_not_tell_are_a_caution_with_what_to_do(gain, sure):
    told = CodeTold("cameras/front.yaml", "linear", gain)
    assert told.sure == sure
    assert told.response == ("srgb" if sure else "linear")
    if sure:
        assert "by 30 of χ². They are measured so; write response: srgb into" in told.sentence
    else:
        assert "their edges do not tell; in the other case errors are larger" in told.sentence
        assert "Write response: linear or response: srgb into cameras/front.yaml" in told.sentence


def test_a_refined_camera_keeps_what_is_told_and_no_more(session):
    """What is only usual for files of a kind is asked again of other photographs."""
    usual = calibrate_session(session, refine_camera=True)
    recode(session, ".png", SRGB)
    told = calibrate_session(session, refine_camera=True)
    written = [
        texts_of(one, {})[name]
        for one in (usual, told)
        for name in [refined_camera(one.cameras.files[0])]
    ]
    assert "response" not in written[0]
    assert "response: srgb" in written[1]
