"""Forecast of a full capture by the check, its advice, and its pictures."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from conftest import run
from faults import raises
from pkmcal.api.check import CheckResult
from pkmcal.calibration.localization import platform_poses, read_images
from pkmcal.checks import advice as words
from pkmcal.checks.check import check_session
from pkmcal.checks.forecast import A4_BOARD, Forecast, LegForecast, forecast
from pkmcal.checks.inspection import Inspection, StationInspection
from pkmcal.checks.pictures import (
    CAPTION_BAR_HEIGHT,
    PANE_GAP,
    RGB,
    picture,
    picture_names,
    with_pictures,
    write_pictures,
)
from pkmcal.checks.sentences import outcome_of
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import inverse, pose, rotation
from pkmcal.identify.tool import centres_and_tool
from pkmcal.mechanisms import load_mechanism
from pkmcal.observe.images import binned
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.quality import quality
from pkmcal.outcome import Level
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.placement.stations import StationPose
from pkmcal.planning.first import EdgesOf
from pkmcal.session.load import load_session
from pkmcal.simulation import Settings
from pkmcal.simulation.truth import load_truth
from rendered import rendered


@pytest.fixture
def checked_session(checked):
    return checked.result


@pytest.fixture(scope="module")
def alone(demo, tmp_path_factory):
    """Three images of one station."""
    folder = tmp_path_factory.mktemp("alone") / "session"
    shutil.copytree(demo.session, folder)
    (folder / "truth.json").unlink()
    document = yaml.safe_load((folder / "session.yaml").read_text())
    document["stations"] = {"station1": document["stations"]["station1"]}
    (folder / "session.yaml").write_text(yaml.safe_dump(document, sort_keys=False))
    rows = (folder / "joints.csv").read_text().splitlines()
    (folder / "joints.csv").write_text("\n".join(rows[:4]) + "\n")
    retained = {row.split(",")[0] for row in rows[1:4]}
    for path in (folder / "images").glob("*/*.png"):
        if path.stem not in retained:
            path.unlink()
    return folder


# ------------------------------------------------------------------ the forecast


def test_the_forecast_is_what_calibrate_then_states(checked_session, calibrated):
    """From two images of each of three stations, for the four of each that exist."""
    each = len(calibrated.session.stations[0].images)
    values = forecast(checked_session.look, each)
    _, tool = centres_and_tool(
        calibrated.session.machine, calibrated.estimate, calibrated.session.joints
    )
    # four configurations a station are few: which they are makes a third of it
    assert values.position == pytest.approx(tool.position.mean(), rel=0.5)
    assert values.orientation == pytest.approx(tool.orientation.mean(), rel=0.5)


def by_hand(look, count):
    """The first images of an inspection, each as one by hand."""
    stations, parts = [], []
    for part in look.stations:
        whole = look.session.stations[part.images.station]
        for k in range(len(part.images.configuration)):
            images = replace(part.images.select(np.array([k])), station=len(stations))
            quality = replace(part.quality, hidden=part.quality.hidden[[k]])
            name = f"{whole.name}-{k}"
            parts.append(replace(part, name=name, images=images, quality=quality))
            photo = whole.images[k]
            stations.append(
                replace(whole, name=name, entry="phone", images=(photo,), handheld=True)
            )
    session = replace(look.session, stations=tuple(stations))
    return replace(look, session=session, stations=tuple(parts[:count]))


def test_the_forecast_of_images_by_hand(checked_session):
    """Each has a pose of its own, so they give less than as many on tripods."""
    look = checked_session.look
    four, six = forecast(by_hand(look, 4)), forecast(by_hand(look, 6))
    assert (four.handheld, four.photographs, six.photographs) == (True, 4, 6)
    assert six.position < four.position
    assert {(leg.station, leg.leg) for leg in six.legs} == {("phone", j) for j in range(1, 7)}
    assert sum(leg.tells for leg in six.legs) == pytest.approx(1)
    assert six.position > forecast(look, 2).position
    assert six.with_board <= six.position
    useful = replace(six, with_board=six.position / 2)
    codes = [{one.code for one in words.advice(by_hand(look, 6), one)} for one in (six, useful)]
    assert ["images.base_board" in some for some in codes] == [False, True]


def test_a_board_on_the_base_locates_the_cameras(tmp_path):
    """From below the platform, where a flat board that stands still on the base is in view, and one
    that moved with the platform would be not; a session that has it has the same forecast.
    """
    places = tuple(
        StationPose(eye, (0.0, 0.0, 0.1))
        for eye in ((0.55, 0.2, 0.28), (-0.4, 0.45, 0.28), (0.2, -0.57, 0.28))
    )
    settings = Settings(stations=places, configurations=2, tolerance=0.0, finish="matte")
    folder, machine = tmp_path / "session", load_mechanism("gough-stewart")
    rendered(folder, machine, camera_of_size((640, 480)), settings, seed=7)
    session = load_session(folder)
    T_camera_base, poses = load_truth(folder, machine).T_camera_base, platform_poses(session)
    assert max(place.position[2] for place in places) < poses[:, 2, 3].min()
    stations = tuple(
        StationInspection(str(images.station), images, None, T, quality(images, machine, T, own))
        for images, T in zip(read_images(session), T_camera_base, strict=True)
        for own in [poses[images.configuration]]
    )
    look = by_hand(Inspection(session, poses, stations), 6)
    alone = forecast(look)
    assert alone.with_board < 0.9 * alone.position
    (tmp_path / "board.yaml").write_text(yaml.safe_dump(A4_BOARD.document))
    session = replace(look.session, board=tmp_path / "board.yaml", board_body="base")
    on_base = forecast(replace(look, session=session))
    assert on_base.position == alone.with_board
    assert np.isnan(on_base.with_board)


def test_more_images_reduce_the_forecast(checked_session):
    few, many = forecast(checked_session.look, 8), forecast(checked_session.look, 32)
    # independent errors would halve; what shading does to a side stays
    assert 0.4 < many.position / few.position < 0.85


def test_shares_are_parts_of_a_whole(checked_session):
    values = checked_session.forecast
    assert sum(leg.tells for leg in values.legs) == pytest.approx(1)
    legs = sum(leg.variance for leg in values.legs)
    assert legs + values.readings + values.drawing == pytest.approx(1)
    assert legs > 0.5
    assert [(leg.station, leg.leg) for leg in values.legs[:2]] == [("station1", 1), ("station1", 2)]
    assert len(values.legs) == 18
    for leg in values.legs:
        assert 0 <= leg.tells < 1
        assert 0 <= leg.seen <= 1
    assert np.isnan(values.second)
    assert "edges" not in checked_session.as_dict()["forecast"]
    assert "look" not in checked_session.as_dict()


@pytest.fixture(scope="module")
def alone_checked(alone):
    return check_session(alone)


def test_three_images_of_one_station(alone_checked):
    check = alone_checked
    assert not [f for f in check.findings if f.level is Level.WRONG]
    rows = check.forecast
    assert [leg.leg for leg in rows.legs] == [1, 2, 3, 4, 5, 6]
    # from one place the line of sight is determined badly
    assert rows.second < rows.position
    text = outcome_of(check).parts[-1].terminal_text
    assert "by the edges of 3 images" in text[0]


def test_no_forecast_where_a_station_is_not_localized(checked_session):
    edges = checked_session.look
    lost = replace(edges, stations=(*edges.stations[:2], replace(edges.stations[2], quality=None)))
    assert forecast(lost) is None


def test_no_forecast_of_images_without_edges(checked_session):
    edges = checked_session.look
    grey = [replace(s.images, images=[np.full_like(i, 90) for i in s.images.images])
            for s in edges.stations]  # fmt: skip
    stations = [replace(s, images=p) for s, p in zip(edges.stations, grey, strict=True)]
    with pytest.raises(ResultError):
        forecast(replace(edges, stations=tuple(stations)))


@pytest.mark.parametrize(
    ("visible", "checked_session", "why"),
    [(0.3, 0.9, "70 % hidden from front"), (0.9, 0.4, "60 % of its edges lost at front")],
)
def test_an_uninformative_leg_is_named_with_its_reason(visible, checked_session, why):
    legs = [LegForecast("front", j, 0.9, 0.95, 0.1, 0.19, 0.1) for j in range(1, 6)]
    legs.append(LegForecast("front", 6, visible, checked_session, 0.2, 0.02, 0.4))
    values = Forecast(15, 2e-4, 1e-3, 0.0, 0.03, float("nan"), tuple(legs))
    part = words.forecast_part(values)
    assert (
        part.terminal_text[1] == f"Leg 6 contributes little, 2 % of the edges' information: {why}."
    )
    marks = [row.mark for row in part.tables[0].rows]
    assert marks == ["good"] * 5 + [Level.NOTE]


# ------------------------------------------------------------------ advice


def test_a_second_place_is_advised_where_it_is_worth_it(checked_session):
    def advised(second):
        values = replace(checked_session.forecast, position=2e-4, second=second)
        findings = words.advice(checked_session.look, values)
        return [one.facts for one in findings if one.code == "images.second_place"]

    assert advised(1e-4) == [{"number": 15, "tool_sigma": 1e-4, "tool_sigma_before": 2e-4}]
    assert advised(1.8e-4) == advised(float("nan")) == []


def test_stations_on_one_side_are_reported(checked_session):
    first = checked_session.look.stations[0]
    middle = checked_session.look.poses[:, :3, 3].mean(axis=0)
    turn = rotation(np.array([0, 0, np.deg2rad(25)]))
    beside = first.T_camera_base @ inverse(pose(turn, middle - turn @ middle))
    near = replace(
        checked_session.look, stations=(first, replace(first, name="b", T_camera_base=beside))
    )
    (text,) = words._from_one_side(near)
    assert text.code == "images.one_side"
    assert 20 < text.facts["degrees"] < 25.5
    assert words._from_one_side(checked_session.look) == []


def test_slim_tubes_are_reported(checked_session):
    """Advice by the nominal width in the images; wide tubes need none."""
    assert words._slim_tubes(checked_session.look) == []
    first, *others = checked_session.look.stations
    half_width = np.where(tubes_of(checked_session.look.session.machine).tube == 1, 2.25, 9.0)
    every = np.broadcast_to(half_width, first.quality.half_width.shape)
    slim = replace(first, quality=replace(first.quality, half_width=every))
    (text,) = words._slim_tubes(replace(checked_session.look, stations=(slim, *others)))
    assert (text.code, text.station) == ("images.slim", first.name)
    assert text.facts["tubes"] == ["tube 2 4.5 px"]


def test_hidden_legs_are_reported_where_no_station_sees_them(checked_session):
    def hiding(station, leg, share):
        hidden = np.full(station.quality.hidden.shape, 0.1)
        hidden[:, leg] = share
        return replace(station, quality=replace(station.quality, hidden=hidden))

    stations = checked_session.look.stations
    one = replace(
        checked_session.look, stations=(hiding(stations[0], 3, 0.8), hiding(stations[1], 0, 0.8))
    )
    assert words._hidden_legs(one) == []
    every = replace(checked_session.look, stations=tuple(hiding(s, 3, 0.8) for s in stations))
    (text,) = words._hidden_legs(every)
    assert (text.code, text.subject, text.station) == ("images.hidden", "leg 4", "station1")
    assert text.facts["share"] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("level", "behind", "code"),
    [
        (255.0, 100.0, "images.lost_white"),
        (4.0, 2.0, "images.lost_black"),
        (200.0, 195.0, "images.lost_faint"),
        (200.0, 90.0, "images.lost_clear"),
    ],
)
def test_why_edges_are_lost(checked_session, level, behind, code):
    """Half of all edges lost for this reason; the other legs are white in front of a grey wall."""
    station = checked_session.look.stations[0]
    shape = station.quality.level.shape
    lost = np.zeros((1, shape[1]), dtype=bool)
    lost[:, ::2] = True
    own, other = np.full(shape, 200.0), np.full(shape, 90.0)
    own[:, ::2], other[:, ::2] = level, behind
    station = replace(station, quality=replace(station.quality, level=own, behind=other))
    edges = EdgesOf(np.array([0]), np.ones_like(lost), ~lost)
    (one,) = words._lost_edges(checked_session.look, station, edges)
    assert (one.code, one.station) == (code, "station1")
    assert one.facts["share"] == pytest.approx(0.5)
    assert one.facts.get("sheet", "dark") == "dark"
    assert (
        words._lost_edges(checked_session.look, station, replace(edges, valid=np.ones_like(lost)))
        == []
    )


# ------------------------------------------------------------------ pictures


def test_pictures_of_all_images(checked_session, tmp_path):
    write_pictures(checked_session.look, tmp_path / "pictures")
    names = sorted(path.name for path in (tmp_path / "pictures").iterdir())
    assert names == sorted(picture_names(checked_session.look).values())
    assert len(names) == sum(station.photographs for station in checked_session.stations)
    station = checked_session.look.stations[0]
    width, height = station.images.camera.image_size
    drawn = cv2.imread(str(tmp_path / "pictures" / names[0]))
    assert drawn.shape == (height + CAPTION_BAR_HEIGHT, 2 * width + PANE_GAP, 3)
    # beside the lines the image is unchanged, and all legs' colours are in it
    after = drawn[CAPTION_BAR_HEIGHT:, width + PANE_GAP :]
    plain = cv2.cvtColor(station.images.images[0], cv2.COLOR_GRAY2BGR)
    assert np.mean(np.any(after != plain, axis=-1)) < 0.2
    for colour in [*RGB.values()][:6]:  # thin lines are blended with what they cross
        bgr = colour & 255, colour >> 8 & 255, colour >> 16
        assert np.abs(after.astype(int) - bgr).max(axis=-1).min() < 60


def test_pictures_of_large_images_are_binned(checked_session):
    station = checked_session.look.stations[0]
    large = replace(station, images=replace(station.images, binning=2))
    width, height = station.images.camera.image_size
    size = width // 2, height // 2
    drawn = []
    for edges, grey in (
        (station, photo := station.images.images[0]),
        (large, binned(photo, 2)),
    ):
        pane = picture(checked_session.look, edges, 0)[CAPTION_BAR_HEIGHT:, : grey.shape[1]]
        changed = np.any(np.abs(pane.astype(int) - grey[..., None]) > 40, axis=-1)
        drawn.append(cv2.resize(changed.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0)
    # what is drawn lies where it lay
    near = cv2.dilate(drawn[0].astype(np.uint8), np.ones((5, 5))) > 0
    assert np.mean(near[drawn[1]]) > 0.9


def test_the_nominal_model_lies_on_the_legs_by_the_pose_found(checked_session, calibrated):
    """Under its lines the image changes; under those at the rough pose, which are off, less."""
    from pkmcal.checks.pictures import nominal_over_image

    def strength(T_camera_base, k):
        image = station.images.images[k].astype(np.float32)
        slope = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1))
        slope = cv2.dilate(slope, np.ones((5, 5)))
        mask = np.zeros(image.shape, np.uint8)
        for edge in nominal_over_image(
            checked_session.look, station, station.images.camera, T_camera_base, k
        )[0]:
            cv2.polylines(mask, [np.rint(edge.points).astype(np.int32)], False, 255)
        return float(np.median(slope[mask > 0]))

    for station in checked_session.look.stations:
        assert strength(station.T_camera_base, 0) > 1.15 * strength(station.by_hand, 0)


def test_each_number_stands_once_and_apart(checked_session):
    from pkmcal.checks.pictures import nominal_over_image

    station = checked_session.look.stations[0]
    eye = station.images.camera
    _, spots = nominal_over_image(checked_session.look, station, eye, station.T_camera_base, 0)
    numbered = [spot for spot in spots if spot.labelled]
    assert sorted(spot.leg for spot in numbered) == [1, 2, 3, 4, 5, 6]


def test_colours_are_those_of_the_viewer():
    style = Path(__file__).parents[1] / "viewer" / "src" / "overlay.css"
    colours = dict(re.findall(r"--leg(\d): #([0-9a-f]{6})", style.read_text()))
    assert [int(colours[str(k + 1)], 16) for k in range(len(colours))] == list(RGB.values())


def test_a_page_with_images(checked_session):
    part = with_pictures(checked_session.look)
    (block,) = [one for one in part.blocks if one.kind == "images"]
    assert len(block.images) == sum(station.photographs for station in checked_session.stations)
    assert block.first == 9
    assert len({image.group for image in block.images[:9]}) == 3
    for image in block.images:
        assert [overlay.title for overlay in image.overlays] == ["Pose found", "Pose by hand"]
        for overlay in image.overlays:
            assert [layer.name for layer in overlay.layers] == ["edges", "joints"]
    lost = checked_session.look.stations[0]
    edges = replace(checked_session.look, stations=(replace(lost, quality=None, by_hand=None),))
    block = next(one for one in with_pictures(edges).blocks if one.kind == "images")
    (overlay,) = block.images[0].overlays
    assert overlay.title == "Best candidate pose, not localized"
    assert len(block.images) == len(lost.images.images)


def test_a_check_writes_page_and_pictures(alone_checked, tmp_path):
    result = CheckResult.of(alone_checked)
    result.save(tmp_path / "out")
    assert result.save_pictures(tmp_path / "drawn")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "check.html",
        "check.json",
    ]
    assert len(list((tmp_path / "drawn").iterdir())) == 3
    page = (tmp_path / "out" / "check.html").read_text()
    assert "The nominal model over the images" in page
    assert "What a full capture would give" in page
    # again, over the same; but not beside what is somebody's
    assert result.save_pictures(tmp_path / "drawn")
    (tmp_path / "drawn" / "mine.txt").write_text("mine")
    with raises(InputError, code="output.foreign_files", found="mine.txt"):
        result.save_pictures(tmp_path / "drawn")


def test_without_these_options_nothing_is_drawn(alone):
    before = sorted(alone.rglob("*"))
    assert run("check", alone).code < 2
    assert sorted(alone.rglob("*")) == before


def test_pictures_whole_or_not_at_all(checked_session, tmp_path):
    """The images of the last station are missing."""
    *others, last = checked_session.look.stations
    broken = replace(last, images=replace(last.images, images=[]))
    with pytest.raises(IndexError):
        write_pictures(
            replace(checked_session.look, stations=(*others, broken)), tmp_path / "pictures"
        )
    assert list(tmp_path.iterdir()) == []
