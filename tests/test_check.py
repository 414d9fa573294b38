"""Findings of the check in images and configurations, and its verdict."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import run
from pkmcal.calibration.leg_numbering import equal_numberings, numbering_note
from pkmcal.checks.check import BROKEN_IMAGES_NAMED, _kinematics, check_session
from pkmcal.checks.results import JointCheck, SessionCheck, StationCheck
from pkmcal.checks.sentences import joint_findings, outcome_of, station_findings
from pkmcal.geometry.rigid import pose, rotation
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.outcome import Level
from pkmcal.session.load import load_session
from test_bad_input import only

GOOD = StationCheck("front", 15, True, 0.2, 0.04, 0.08, 5.5, 0.05, 0.01, 0.8)


def changed(session, change, station="*"):
    """All images of a station (or of all), changed by a function of the image."""
    for path in sorted((session / "images").glob(f"{station}/*.png")):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert cv2.imwrite(str(path), np.clip(change(picture), 0, 255).astype(np.uint8))


def texts(value, level):
    return [finding.text for finding in value.findings if finding.level is level]


# whole sessions


def test_a_good_session(checked):
    count = checked.result
    assert count.exit_code == 0
    assert texts(count, Level.WRONG) == texts(count, Level.DOUBTFUL) == []
    assert (count.n_legs, count.configurations) == (6, 12)
    assert count.singularity > 0.5
    assert count.assemblies >= 2
    for station in count.stations:
        assert station.recognised
        assert station.mismatch < 0.3
        # the simulation's poses by hand are 5 cm and 5 degrees off
        assert 0.03 < station.moved < 0.07
        assert np.deg2rad(3) < station.turned < np.deg2rad(7)
        assert station.legs > 4.5
        assert 0.5 < station.blur < 1.2
        assert station.saturated < 0.1
        assert station.black < 0.1
    assert all(0.6 < joint.used < 1 for joint in count.joints)


def test_a_workspace_blurred_and_overexposed_images(session):
    """Three cases that are no mistakes, and do not stop the check."""
    with (session / "session.yaml").open("a") as file:
        file.write("workspace: {z: [1.0, 2.0]}\n")
    changed(session, lambda picture: cv2.GaussianBlur(picture, (0, 0), 1.8), "station1")
    changed(session, lambda picture: picture * 2.5, "station2")
    check = check_session(session)
    assert check.exit_code == 1
    faults = texts(check, Level.DOUBTFUL)
    (text,) = [text for text in faults if text.startswith("session.yaml")]
    assert text.startswith("session.yaml, workspace: the machine does not come to the workspace")
    assert "found z from 1 to 2 m" in text
    (text,) = [text for text in faults if text.startswith("station1: The edges")]
    assert text.startswith("station1: The edges are blurred over 1.")
    assert check.stations[0].blur > 1.7
    assert check.stations[2].blur < 1.2
    assert any(
        text.startswith("station2: ") and "are overexposed: edges vanish in white" in text
        for text in faults
    )
    assert not [text for text in faults if text.startswith("station3")]


@pytest.mark.slow
def test_black_images_of_nothing(session):
    only(session, "station1", "station3")
    changed(session, lambda picture: picture * 0, "station3")
    check = check_session(session)
    assert check.exit_code == 2
    assert "station3: 100 % of the pictures are black" in texts(check, Level.DOUBTFUL)[0]
    assert "not localized in the images of station3" in texts(check, Level.WRONG)[0]
    assert [station.recognised for station in check.stations] == [True, False]


def test_all_broken_images_are_named(session):
    broken = sorted((session / "images" / "station1").iterdir())[:2]
    names = [f"images/station1/{path.name}: the image cannot be decoded" for path in broken]
    for path in broken:
        path.write_bytes(path.read_bytes()[:-300])
    check = check_session(session)
    assert check.exit_code == 2
    assert [text.partition(";")[0] for text in texts(check, Level.WRONG)] == names
    assert check.stations[0].recognised  # by its other images


def test_a_station_whose_images_are_all_broken(session):
    for path in (session / "images" / "station1").iterdir():
        path.write_bytes(path.read_bytes()[:-300])
    check = check_session(session)
    assert len(texts(check, Level.WRONG)) == 4
    assert not any(station.recognised for station in check.stations)


def test_of_many_broken_images_some_are_named(session):
    images = session / "images" / "station1"
    content = min(images.iterdir()).read_bytes()[:-300]
    for name in load_session(session).configurations:
        (images / f"{name}.png").write_bytes(content)
    *first, others = texts(check_session(session), Level.WRONG)
    assert len(first) == BROKEN_IMAGES_NAMED == 10
    assert all("cannot be decoded" in text for text in first)
    assert "stations.station1: images cannot be decoded; found 2 more of this" in others


@pytest.mark.slow
def test_a_station_without_a_pose_is_found_anywhere(session):
    text = (session / "session.yaml").read_text()
    start, end = text.index("    pose:"), text.index("  station2:")
    (session / "session.yaml").write_text(text[:start] + text[end:])
    check = check_session(session)
    assert check.exit_code == 0
    assert check.stations[0].recognised
    assert np.isnan(check.stations[0].moved)
    assert check.stations[0].by_chance < 1e-3


def test_what_cannot_be_observed_is_reported(session):
    text = (session / "mechanism.yaml").read_text()
    lines = [line for line in text.splitlines() if "tubes:" not in line and "radius:" not in line]
    (session / "mechanism.yaml").write_text("\n".join(lines) + "\n")
    check = check_session(session)
    assert check.exit_code == 2
    assert "no leg of the nominal model has visible cylinders" in texts(check, Level.WRONG)[0]


@pytest.mark.parametrize(
    ("x", "where", "message"),
    [
        ("0.55", "joints.csv, configuration ", "its legs do not meet the platform"),
        ("1.27", "mechanism.yaml: ", "cannot be assembled with its legs at mid-range"),
    ],
)
def test_readings_that_the_nominal_model_cannot_take(session, x, where, message):
    path = session / "mechanism.yaml"
    path.write_text(path.read_text().replace("[0.2693, 0.02,", f"[{x}, 0.02,"))
    check = check_session(session)
    assert check.exit_code == 2
    text = texts(check, Level.WRONG)[0]
    assert text.startswith(where)
    assert message in text
    assert run("calibrate", session).err == f"Error: {text}\n"


# single judgements


@pytest.mark.parametrize(("handheld", "counted"), [(False, "stations"), (True, "images")])
def test_a_cards_unit_is_what_was_searched(handheld, counted):
    """Of hand-held images each is a station of its own, which no user calls so."""
    station = replace(GOOD, by_chance=1e-6, handheld=handheld)
    searched = (station, replace(station, recognised=False))
    check = SessionCheck("session", (), "3-rps", 3, 15, searched)
    assert outcome_of(check).figures[0].values == (("1 of 2", counted),)


@pytest.mark.parametrize(
    ("station", "message"),
    [
        (GOOD, None),
        (replace(GOOD, saturated=0.3), "30 % of the legs are overexposed"),
        (replace(GOOD, saturated=0.3, recognised=False), "30 % of the images are overexposed"),
        (replace(GOOD, black=0.6), "60 % of the legs are black"),
        (replace(GOOD, blur=1.9), "blurred over 1.9 px"),
        (replace(GOOD, blur=float("nan")), None),
        (replace(GOOD, legs=2.5), "Only 2.5 of 6 legs"),
    ],
)
def test_a_stations_findings(station, message):
    count = station_findings(station, 6)
    assert (message is None and not count) or (len(count) == 1 and message in count[0].text)


def test_crowded_and_few_configurations(demo):
    session = load_session(demo.session)
    joints = (
        JointCheck("leg1", "m", 0.4, 0.41, 0.07, (0, 0)),
        JointCheck("leg2", "m", 0.35, 0.48, 0.9, (3, 3)),
    )
    results = joint_findings(replace(session, configurations=("a", "b")), joints)
    assert [finding.level for finding in results] == [Level.NOTE] * 2
    assert results[0].text.startswith("leg1 used little of the range (down to 7 %)")
    assert results[1].text.startswith("There are only 2 configurations")


def test_a_pose_under_several_names_is_reported(demo):
    """0001 and 0002 at one station, or each at a station of its own, with the readings of 0000."""
    session = load_session(demo.session)
    joints = session.joints.copy()
    assert joint_findings(session, ()) == []
    noise = session.joint_noise * np.random.default_rng(0).normal(size=(2, joints.shape[1]))
    joints[1:3] = joints[0] + noise
    photos = [p for p in session.stations[0].images if p.configuration > 2]

    def report(*in_view):
        """Findings if stations see these of the first three configurations."""
        stations = tuple(
            replace(s, images=(*(replace(photos[0], configuration=k) for k in rows), *photos))
            for s, rows in zip(session.stations, in_view, strict=True)
        )
        (finding,) = joint_findings(replace(session, joints=joints, stations=stations), ())
        assert finding.level is Level.NOTE
        assert finding.text.startswith(
            "12 configurations are of 10 poses: the readings of 0000, 0001 and 0002 are equal"
            " within their noise. --holdout"
        )
        return finding.text.partition("one pose: ")[2]

    assert report((0, 1, 2), (), ()) == (
        "at station1 name its images images/station1/0000_1.png and"
        " images/station1/0000_2.png, with images: images/station1/{configuration}_{repeat}.png,"
        " and keep one of its rows in joints.csv."
    )
    assert report((0,), (1,), (2,)) == (
        "its images bear one name at all stations, such as 0000, and it has one row in joints.csv."
    )


def test_the_first_leg_is_open_where_no_pose_decides(demo):
    session = load_session(demo.session)
    assert [*numbering_note(session)] == []
    stations = tuple(replace(s, T_camera_base=None) for s in session.stations)
    (value,) = numbering_note(replace(session, stations=stations))
    assert (value.code, value.subject) == ("readings.first_leg_unknown", "joints.csv")
    assert value.facts["columns"] == ["leg3", "leg5"]
    placed = replace(session, stations=(session.stations[0], *stations[1:]))
    assert [*numbering_note(placed)] == []
    board = tuple(replace(s, observe=("board",)) for s in stations)
    assert [*numbering_note(replace(session, stations=board))] == []


@pytest.mark.parametrize(
    ("name", "firsts"),
    [("gough-stewart", [2, 4]), ("3-rps", [1, 2]), ("delta", [1, 2]), ("hexaglide", []),
     ("four-belt", [1, 2, 3])],
)  # fmt: skip
def test_numberings_that_nothing_distinguishes(name, firsts):
    """The machines of the two configurations differ by one rotation of everything, except for tubes
    and unequal joints. A plane machine's may turn it over: its legs are then counted backwards.
    """
    machine = load_mechanism(name)
    joints = machine.inverse(poses_in(machine.limits(), Region(), 8))
    assert [order[0] for order in equal_numberings(machine, joints)] == firsts
    for part in ("base.center.x", "tubes[1].radius"):
        k = next((k for k, n in enumerate(machine.parameters.names) if n == f"legs[2].{part}"), -1)
        if k >= 0:
            values = machine.values.copy()
            values[k] += 5 * np.sqrt(machine.n_legs) * machine.parameters.tolerance[k]
            assert equal_numberings(machine.with_values(values), joints) == ()


@pytest.mark.parametrize(("about", "degrees", "near"), [("x", 5, False), ("z", 82, True)])
def test_another_assembly_mode_nearby_is_named(demo, about, degrees, near):
    """The mirror image below the base is turned by 10 degrees, but far away; the pose beyond
    Fichter's singularity, a quarter turn about the vertical, by 16.
    """
    session = load_session(demo.session)
    turned = pose(rotation(np.radians(degrees) * np.eye(3)["xyz".index(about)]), np.zeros(3))
    joints = session.joints.copy()
    joints[0] = session.machine.inverse(session.machine.home() @ turned)
    session = replace(session, joints=joints)
    findings = _kinematics(session, np.random.default_rng(0)).findings
    named = [f for f in findings if f.code == "configurations.other_assembly"]
    assert len(named) == near
    for finding in named:
        assert finding.facts["turn"] == pytest.approx(np.radians(16), rel=0.2)


def test_a_first_configuration_that_the_nominal_legs_do_not_reach(demo):
    """By less than the prior sigmas allow: it has no assembly mode, and the check goes on."""
    session = load_session(demo.session)
    machine = session.machine
    joints = session.joints.copy()
    joints[0] = machine.inverse(machine.home())
    joints[0, 0] += 0.3
    session = replace(session, joints=joints)
    assert 1e-3 < session.forward.error[0] < 5e-3
    kinematics = _kinematics(session, np.random.default_rng(0))
    assert kinematics.assemblies == 0
    assert "configurations.other_assembly" not in [f.code for f in kinematics.findings]
    assert kinematics.poses is not None


def test_nearly_singular_configurations_are_named(demo):
    """The fourth one a degree from Fichter's singularity, a quarter turn about the vertical."""
    session = load_session(demo.session)
    joints = session.joints.copy()
    turned = pose(rotation(np.radians([0.0, 0.0, 89.0])), np.zeros(3))
    joints[3] = session.machine.inverse(session.machine.home() @ turned)
    session = replace(session, joints=joints)
    (finding,) = _kinematics(session, np.random.default_rng(0)).findings
    assert finding.level is Level.DOUBTFUL
    name = session.configurations[3]
    assert finding.text.startswith(f"Near a singular pose in configuration {name}: ")
