"""pkmcal study: varied settings, the simulation, and the command."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import run
from document_keys import assert_keys
from faults import raises
from page_documents import page_blocks, page_document
from pkmcal.api.study import study
from pkmcal.errors import InputError
from pkmcal.mechanisms import load_mechanism
from pkmcal.papers.paper_a import study_subject
from pkmcal.studies import engine
from pkmcal.studies.calibrations import (
    JOINT_ESTIMATE_KEY,
    SimulatedCalibrations,
    judged,
    tool_error_and_sigma,
)
from pkmcal.studies.capture import captured
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.findings import SweepResult, clustered, with_error
from pkmcal.studies.statistics import Summary, covered
from pkmcal.studies.store import plainly
from pkmcal.studies.study_report import study_document
from pkmcal.studies.sweep import cells_of, parsed, scaled, subject_of
from pkmcal.studies.varied import DESIGN_NAMES_VARIED
from pkmcal.wording import brief

SMALL = ("--vary", "configurations=6", "--vary", "stations=1,2")
"""Study of 3-rpr: two combinations in a second or two."""


def design_of(name, *vary):
    subject = subject_of(name)
    return cells_of(subject, parsed(subject, vary))[0].setting.design


def batch_of(setting, runs=4, seed=0):
    return engine.batches(setting, runs, seed)[0]


# what is studied


def test_a_grid_has_every_combination():
    subject = subject_of("gough-stewart")
    cells = cells_of(subject, parsed(subject, ["stations=1,2,3", "edge_noise=0.1,0.2"]))
    assert [tuple(cell.values.values()) for cell in cells] == [
        (s, e) for s in (1, 2, 3) for e in (0.1, 0.2)
    ]
    assert cells[3].setting.design.stations == 2
    assert cells[3].setting.design.edge_noise == 0.2


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        (["station=1"], {"found": "station=1", "expected": "stations"}),
        (["stations"], {"found": "stations", "expected": "stations=V1,V2"}),
        (["stations="], {"found": "stations=", "expected": "stations=V1,V2"}),
        (["stations=1,,2"], {"found": "stations=1,,2", "expected": "stations=V1,V2"}),
        (["stations=1,x"], {"found": "x", "expected": "a whole number of 1 to 100"}),
        (["stations=1.5"], {"found": "1.5", "expected": "a whole number of 1 to 100"}),
        (["edge_noise=-1"], {"found": "-1", "expected": "0.0001 to 100 px"}),
        (["stations=1,1"], {"code": "study.value_twice", "found": "stations=1,1"}),
        (["stations=1", "stations=2"], {"code": "study.name_twice", "found": "stations"}),
        (
            ["camera=telescope"],
            {"found": "telescope", "expected": "pinhole, mirror or a camera's file"},
        ),
        (["observe=arms"], {"found": "arms", "expected": "legs, board or legs+board"}),
    ],
)
def test_what_cannot_be_varied_is_reported(words, facts):
    with raises(InputError, where="--vary", **facts):
        parsed(subject_of("3-rpr"), words)


@pytest.mark.parametrize(
    ("machine", "words", "value", "text"),
    [
        ("3-rpr", "play=0.1 mm", 1e-4, "play 0.1 mm"),
        ("3-rpr", "reading-noise=3e-6", 3e-6, "reading noise 0.003 mm"),
        ("delta", "play=0.1 deg", np.deg2rad(0.1), "play 0.1°"),
        ("delta", "distance=40 cm", 0.4, "distance 0.4 m"),
        ("delta", "elevation=0.5 rad", np.rad2deg(0.5), "elevation 28.6479°"),
        ("a", "reading_noise=3 um", 3e-6, "reading noise 3e-06 m"),
    ],
)
def test_values_with_units(machine, words, value, text):
    """Readings are shown in mm or degrees, by the machine's joints."""
    subject = study_subject() if machine == "a" else subject_of(machine)
    varied = parsed(subject, [words])
    assert [*varied.values()] == [(pytest.approx(value),)]
    assert subject.in_words({name: values[0] for name, values in varied.items()}) == text


@pytest.mark.parametrize(("machine", "words"), [("3-rpr", "play=1 deg"), ("delta", "play=1 mm")])
def test_a_reading_in_the_unit_of_another_joint_is_refused(machine, words):
    with raises(InputError, where="--vary", found=words.partition("=")[2]):
        parsed(subject_of(machine), [words])


def test_names_that_can_be_varied_are_listed():
    with raises(InputError, where="--vary", found="colour=1") as caught:
        parsed(subject_of("3-rpr"), ["colour=1"])
    assert caught.value.expected.startswith("NAME=V1,V2 ")


@pytest.mark.parametrize(
    "vary", ["legs=3", ["legs=3"], {"legs": [3]}, {"legs": 3}, {"legs": np.array([3])}]
)
def test_one_value_may_stand_alone(vary, one_process):
    assert study("a", vary, runs=2).varied == {"legs": (3,)}


def test_a_camera_by_its_name_is_one_value():
    with raises(InputError, where="--vary", found="telescope"):
        study("3-rpr", {"camera": "telescope"}, runs=2)


def test_too_many_combinations_are_refused():
    subject = subject_of("3-rpr")
    values = ",".join(str(k) for k in range(11, 41))
    with raises(InputError, where="--vary", found="900", expected="at most 500"):
        cells_of(subject, parsed(subject, [f"stations={values}", f"focal={values}"]))


def test_an_unknown_subject_is_reported():
    with raises(InputError, found="gough", expected="gough-stewart"):
        subject_of("gough")


def test_hinged_bars_are_reported():
    with raises(InputError, expected="platform joints other than hinged-bar") as caught:
        subject_of("h4-rods")
    assert "'h4-rods'" in caught.value.what


@pytest.mark.parametrize("name", ["gough-stewart", "h4", "hexaglide", "delta", "3-rpr"])
def test_a_machine_of_another_size_is_the_same_machine(name):
    """Twice as large, it reaches twice as far with the same angles and twice the lengths."""
    one = load_mechanism(name)
    two = scaled(one, 2.0)
    lengths = np.array(one.joint_units) == "m"
    readings = one.inverse(one.home()[None])
    expected = one.forward(readings)
    expected[..., :3, 3] *= 2
    forward_kinematics = two.forward(np.where(lengths, 2.0, 1.0) * readings)
    np.testing.assert_allclose(forward_kinematics, expected, atol=1e-9)
    factor = np.where(lengths, 2.0, 1.0)[:, None]
    np.testing.assert_allclose(two.joint_ranges, factor * one.joint_ranges)
    np.testing.assert_array_equal(two.parameters.tolerance, one.parameters.tolerance)


ANOTHER_VALUE = {
    "resolution": 800, "focal": 900, "distance": 1.7, "elevation": 35, "stations": 2,
    "configurations": 3, "edge_noise": 0.2, "corner_noise": 0.1, "shading": 0.1,
    "reading_noise": 1e-5, "reading_resolution": 1e-3, "play": 1e-4, "radius": 1.2, "size": 1.1,
    "tolerance": 0.5, "extreme": 1, "observe": "legs+board", "camera": "mirror",
}  # fmt: skip
"""Value of each name other than that of the usual design."""


@pytest.mark.parametrize("name", DESIGN_NAMES_VARIED)
def test_each_name_changes_the_simulated_session(name):
    observed = "legs+board" if name == "corner_noise" else "legs"
    usual = {"observe": observed, "configurations": 2, "stations": 1}
    assert drawn(usual | {name: ANOTHER_VALUE[name]}) != drawn(usual)


def drawn(vary):
    """Truth and measurements of a simulated session."""
    design = design_of("gough-stewart", *(f"{name}={value}" for name, value in vary.items()))
    setting = SimulatedCalibrations(design)
    data = setting.draw(batch_of(setting, runs=1))
    problem = data.assembled.problem
    return plainly([data.theta, data.poses, problem.data, problem.pose_data])


def test_readings_have_play_and_steps():
    """Their scatter about the drives' positions is what a session states."""
    design = design_of("3-rpr", "reading_noise=2e-5", "reading_resolution=1e-4", "play=6e-5")
    rng = np.random.default_rng(3)
    joints = rng.uniform(0.1, 0.4, (50, 200, 3))
    readings = design.readings(joints, rng)
    steps = readings / 1e-4
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.std(readings - joints) == pytest.approx(design.reading_sigma, rel=0.02)
    risen = joints > np.roll(joints, 1, axis=1)
    ahead = [(readings - joints)[side].mean() for side in (risen, ~risen)]
    np.testing.assert_allclose(ahead, [3e-5, -3e-5], atol=2e-6)


def test_cameras_change_as_stated():
    usual = design_of("gough-stewart").cameras[0]
    fine = design_of("gough-stewart", "resolution=2048").cameras[0]
    assert fine.image_size == (2048, 1536)
    points = np.random.default_rng(0).normal(0, 0.2, (20, 3)) + np.eye(3)[2]
    there = usual.project(points)
    np.testing.assert_allclose(fine.project(points) + 0.5, 2 * (there + 0.5), atol=1e-9)
    long = design_of("gough-stewart", "focal=2000").cameras[0]
    assert long.image_size == usual.image_size
    assert long.parameters[0] == 2000
    assert design_of("gough-stewart", "camera=mirror").cameras[0].model == "unified"


def test_places_are_where_they_are_asked_for():
    design = design_of("gough-stewart", "distance=1.6", "elevation=30", "configurations=3")
    plan = captured(design, np.random.default_rng(0))
    eyes = np.linalg.inv(plan.T_camera_base)[:, :3, 3]
    machine = design.machine
    ends = np.concatenate([machine.base_centers(), machine.platform_centers()])
    middle = np.array([0.0, 0.0, (machine.home()[2, 3] + ends[0, 2]) / 2])
    away = np.linalg.norm(eyes - middle, axis=1)
    np.testing.assert_allclose(away, 1.6, atol=0.05)
    above = np.degrees(np.arcsin((eyes - middle)[:, 2] / away))
    np.testing.assert_allclose(above, 30, atol=2)


def test_a_camera_that_sees_too_little_is_reported():
    design = design_of("gough-stewart", "distance=0.4", "focal=3000")
    with raises(InputError, code="station.sees_too_little", found="0 at station 1"):
        captured(design, np.random.default_rng(0))


def test_a_session_gives_its_cameras_stations_and_noise(demo):
    subject = subject_of(str(demo.session))
    design = subject.design
    assert (design.stations, design.configurations, design.observe) == (3, 4, ("legs",))
    assert design.reading_noise == 3e-6
    assert design.T_camera_base.shape == (3, 4, 4)
    plan = captured(design, np.random.default_rng(0))
    np.testing.assert_array_equal(plan.T_camera_base, design.T_camera_base)
    shifted = cells_of(subject, parsed(subject, ["stations=2"]))[0].setting.design
    assert shifted.T_camera_base is None


def test_a_session_without_images_can_be_studied(session):
    """Before any images exist: fifteen from each place; and its workspace is reported as
    ignored.
    """
    shutil.rmtree(session / "images")
    with (session / "session.yaml").open("a") as file:
        file.write("workspace: {turn: 0.1}\n")
    for named in (session, session / "session.yaml"):
        subject = subject_of(str(named))
        assert subject.design.configurations == 15
        assert not subject.design.shared
        assert subject.design.T_camera_base.shape == (3, 4, 4)
        reach, images = subject.findings
        assert reach.code == "study.whole_reach"
        assert (images.code, images.facts) == ("study.no_images", {"number": 15})


def test_a_folder_called_like_a_machine_is_not_taken_for_a_session(tmp_path, monkeypatch, demo):
    monkeypatch.chdir(tmp_path)
    Path("delta").mkdir()
    assert subject_of("delta").name == "delta"
    shutil.copytree(demo.session, "h4")
    assert subject_of("h4").name == "the session h4"
    Path("mine").mkdir()
    with raises(InputError, code="session.missing", where="mine"):
        subject_of("mine")


# what is simulated


def test_the_tool_of_the_truth_is_not_off():
    """In any frames of the truth: only effects on the tool count."""
    design = design_of("gough-stewart", "configurations=5")
    setting = SimulatedCalibrations(design)
    data = setting.draw(batch_of(setting, 2))
    from pkmcal.identify.gauge import changed_frames
    from pkmcal.studies.calibrations import _truth

    machine, true = data.capture.machine, _truth(data, 0)
    turn = np.eye(4)
    turn[:3, 3] = 0.01, -0.02, 0.005
    other = changed_frames(machine.layout, true, turn, np.linalg.inv(turn))
    covariance = 1e-8 * np.eye(len(true.theta))
    joints = data.capture.joints[:4]
    off, sigma = tool_error_and_sigma(machine, true.theta, covariance, other, joints, every=False)
    assert np.abs(off).max() < 1e-9
    assert np.isfinite(sigma).all()
    worse = replace(true, theta=true.theta + 1e-4 * np.eye(len(true.theta))[20])
    off, _ = tool_error_and_sigma(machine, true.theta, covariance, worse, joints, every=False)
    assert np.abs(off).max() > 1e-6


@pytest.mark.parametrize(
    ("subject", "vary"),
    [
        ("3-rpr", ["stations=1", "configurations=10"]),
        pytest.param("h4", ["observe=board", "stations=1", "configurations=12"],
                     marks=pytest.mark.slow),  # boards are in the row after the next, too
        ("gough-stewart", ["camera=mirror", "stations=1", "configurations=10"]),
        ("gough-stewart", ["observe=legs+board", "stations=1", "configurations=5"]),
        ("a", []),
    ],
)  # fmt: skip
def test_stated_deviations_hold(subject, vary, one_process):
    """A few runs: errors over stated deviations are about one, for parameters and tool."""
    value = study(subject, vary, runs=10)
    cell, sample = value.found[0], value.results[0].samples[JOINT_ESTIMATE_KEY]
    assert cell.failed.value == 0
    assert 0.7 < cell.chi2 < 1.1
    for name in ("parameters", "tool"):
        ratio = sample.values[name] / sample.sigma[name]
        assert 0.7 < np.sqrt(np.nanmean(ratio**2)) < 1.4, name
    assert cell.honest


@pytest.mark.slow
@pytest.mark.parametrize(
    ("subject", "vary"),
    [
        ("3-rpr", ["stations=1", "configurations=20"]),
        ("h4", ["observe=board", "stations=1", "configurations=20"]),
        ("gough-stewart", ["camera=mirror", "stations=1", "configurations=20"]),
        ("gough-stewart", ["stations=3", "configurations=15"]),
    ],
)
def test_coverage(subject, vary):
    """95 % intervals of all parameters and of the tool's pose cover 93 to 97 %."""
    cell = study(subject, vary, runs=500).found[0]
    for item in (cell.covered, cell.covered_tool):
        assert 0.93 <= item.value <= 0.97


@pytest.mark.slow
def test_play_that_is_stated_as_noise_is_reported():
    """Its sign follows the readings, so the intervals are too short."""
    cell = study("3-rpr", ["configurations=20", "play=3e-4"], runs=200).found[0]
    assert cell.covered.value < 0.85
    assert not cell.honest


def test_edges_that_scatter_more_than_stated_are_reported():
    """Ten times as much, which no session's judgement would let pass."""
    setting = SimulatedCalibrations(design_of("gough-stewart", "configurations=8"))
    batch = batch_of(setting, 2)
    data = setting.draw(batch)
    problem = data.assembled.problem
    sharp = replace(problem.data, white=10 * problem.data.white)
    assembled = replace(data.assembled, problem=replace(problem, data=sharp))
    usual, noisy = (
        setting.solve(batch, one)[JOINT_ESTIMATE_KEY].extra
        for one in (data, replace(data, assembled=assembled))
    )
    np.testing.assert_allclose(usual["scale"], 1, atol=0.25)
    assert (usual["scale"] != 1).all()
    assert not usual["failed"].any()
    assert (noisy["scale"] > 4).all()
    assert noisy["failed"].all()


def test_wrong_deviations_are_reported():
    """Half of the true standard deviations: the study reports it, in exit code and page."""
    rng = np.random.default_rng(0)
    sigma = np.ones((40, 30))
    error = rng.normal(size=sigma.shape)
    assert abs(covered(error, sigma).mean() - 0.95) < 0.02
    assert covered(error, 0.5 * sigma).mean() < 0.75
    tool = rng.normal(size=(40, 5, 6))
    sample = judged(np.stack([error, 0.5 * sigma]), np.stack([tool, np.ones_like(tool)]),
                    Fitted(error, extra={"chi2": np.ones(40), "failed": np.zeros(40)}))  # fmt: skip
    assert sample.values["covered"].mean() < 0.75
    assert sample.values["covered_tool"].mean() > 0.9


def test_standard_errors_know_of_batches():
    """Equal runs of a batch count as one."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(400, 25))
    batch = np.repeat(np.arange(25), 8)
    errors = [clustered(np.repeat(row, 8), batch).error for row in means]
    assert np.mean(np.square(errors)) == pytest.approx(1 / 25, rel=0.05)


def test_calibrations_that_all_fail_are_reported(tmp_path, one_process):
    """A thousand times the noise of [A] Table 1: no calibration can be used, and the study reports
    it.
    """
    done = run("study", "a", "--vary", "axis_noise=1,1000", "--runs", 4, "-o", tmp_path)
    assert done.code == 1, done.err
    assert "Too few calibrations of some combinations can be used" in done.out
    assert "axis noise 1000: 100 % of the calibrations fail" in done.out
    assert "nan" not in done.out
    values = json.loads((tmp_path / "study.json").read_text())
    good, bad = values["combinations"]
    assert_keys("study.json", values)
    assert good["deviations_hold"] is True
    assert bad["deviations_hold"] is None
    assert bad["position"] == {"value": None, "standard_error": None}
    assert values["gains"] == []
    document = page_document((tmp_path / "study.html").read_text())
    plots = [plot for block in page_blocks(document, "panels") for plot in block["plots"]]
    assert [plot["name"] for plot in plots] == ["by-axis-noise", "held"]
    (error,) = (mark for mark in plots[0]["marks"] if mark["name"] == "error")
    assert [point["x"] for point in error["points"]] == ["1"]


def test_a_platform_that_does_not_turn_has_no_rotations_in_its_table(tmp_path, one_process):
    out = tmp_path / "out"
    done = run("study", "delta", *SMALL[:2], "--vary", "stations=1", "--runs", 4, "-o", out)
    assert done.code == 0, done.err
    assert re.search(r"Calibrations leave \S+ mm at the tool", done.out)
    document = page_document((out / "study.html").read_text())
    assert all(unit != "°" for card in document["cards"] for _, unit in card["values"])


def test_one_run_has_no_standard_error():
    one = clustered(np.array([0.3]), np.array([5]))
    assert one.value == 0.3
    assert np.isnan(one.error)


def test_parameters_keep_their_names_where_legs_and_boards_are_compared(one_process):
    """With legs the tubes' radii are parameters as well, between the others."""
    results = study("h4", ["observe=board,legs", "stations=1", "configurations=6"], runs=2)
    entries = [cell["covered_by_parameter"] for cell in study_document(results)["combinations"]]
    for names, cell in zip(entries, results.cells, strict=True):
        assert list(names) == [name for name, _ in cell.setting.parameters]
    radius = "legs[1].tubes[1].radius"
    assert radius in entries[1]
    assert radius not in entries[0]
    head, *lines = results.summary().splitlines()
    assert head == f"{results.subject.name}, 2 calibrations a combination"
    for line, cell in zip(lines, results.found, strict=True):
        assert line.startswith(f"  {results.subject.in_words(cell.values)}: tool ")
        assert f"stated {brief(1e3 * cell.position_sigma)} mm, " in line


def test_what_chance_does_is_no_gain():
    """Three values that do not matter, each from two batches of runs: one study in twenty may call
    the largest difference a gain, and two standard errors would do so in half of them.
    """
    rng = np.random.default_rng(4)
    cell = study("a", (), runs=2).found[0]
    calls = 0
    for means in rng.normal(1.0, 0.1, (400, 3, 2)):
        cells = tuple(
            replace(cell, values={"legs": k}, freedom=1,
                    position=Summary(pair.mean(), abs(np.diff(pair)[0]) / 2))
            for k, pair in zip((3, 4, 5), means, strict=True)
        )  # fmt: skip
        subject = study_subject()
        calls += SweepResult(subject, {"legs": (3, 4, 5)}, (), (), cells, 20, 0).gains[0].sure
    assert calls <= 0.05 * 400


def test_a_standard_error_of_few_batches_is_not_printed():
    """Student's distribution has a standard deviation from three degrees of freedom on."""
    cell = study("a", (), runs=2).found[0]
    for freedom, printed in ((1, False), (2, False), (3, True)):
        few = replace(cell, freedom=freedom)
        assert ("±" in with_error(few.with_usable_error(Summary(1.0, 0.1)))) == printed


# the command


def test_the_command_prints_and_writes(tmp_path, one_process):
    out = tmp_path / "study"
    done = run("study", "3-rpr", *SMALL, "--runs", 8, "-o", out)
    assert done.code == 0, done.err
    assert "The stated deviations hold" in " ".join(done.out.split())
    assert "stations 1" in done.out
    with (out / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 16
    assert [row["run"] for row in rows[:8]] == [str(k) for k in range(8)]
    assert {row["stations"] for row in rows} == {"1", "2"}
    assert all(float(row["position"]) > 0 for row in rows)
    assert all(row["worst_parameter"].startswith("legs[") for row in rows)
    document = page_document((out / "study.html").read_text())
    assert [[unit for _, unit in card["values"]] for card in document["cards"][:2]] == [
        ["mm", "°"], ["mm", "°"],
    ]  # fmt: skip
    plot, _ = (one for block in page_blocks(document, "panels") for one in block["plots"])
    # two values are places without a line between them
    assert plot["title"] == "By stations"
    assert plot["x"]["categories"] == ["1", "2"]
    assert {mark["mark"] for mark in plot["marks"]} == {"dots"}
    again = run("study", "3-rpr", *SMALL, "--runs", 8, "-o", out, "--json").json
    assert again["exit_code"] == 0
    assert len(again["combinations"]) == 2
    assert again["combinations"][0]["covered"]["value"] > 0.85
    assert [gain["name"] for gain in again["gains"]] == ["stations"]


def test_more_runs_go_on_from_the_finished_ones(tmp_path, one_process):
    few = study("3-rpr", SMALL[1:2], runs=10, out=tmp_path)
    before = sorted(p.stat().st_mtime_ns for p in tmp_path.glob("batches/*.npz"))
    more = study("3-rpr", SMALL[1:2], runs=20, out=tmp_path)
    after = sorted(p.stat().st_mtime_ns for p in tmp_path.glob("batches/*.npz"))
    assert after[:1] == before
    first, both = (r.results[0].values("position", *JOINT_ESTIMATE_KEY) for r in (few, more))
    np.testing.assert_array_equal(both[:10], first)


def test_another_study_in_the_same_folder_is_refused(tmp_path, one_process):
    study("a", (), runs=4, out=tmp_path)
    done = run("study", "a", "--vary", "legs=5", "--runs", 4, "-o", tmp_path, "--json")
    assert (done.code, done.json["code"]) == (2, "study.another")
    assert done.json["found"].startswith("a, seed 0")
    (tmp_path / "batches" / "study.json").write_text("nonsense")
    done = run("study", "a", "--runs", 4, "-o", tmp_path, "--json")
    assert (done.code, done.json["code"]) == (2, "study.unreadable")


def test_a_file_that_is_spoilt_is_done_again(tmp_path, one_process):
    one = study("a", (), runs=4, out=tmp_path)
    (path,) = tmp_path.glob("batches/*.npz")
    path.write_bytes(path.read_bytes()[:500])
    two = study("a", (), runs=4, out=tmp_path)
    np.testing.assert_array_equal(
        *(r.results[0].values("position", *JOINT_ESTIMATE_KEY) for r in (one, two))
    )
