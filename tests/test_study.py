"""pkmcal study: simulated calibrations, stopped and resumed, on processes and clusters."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import run
from pkmcal.errors import InputError, ResultError
from pkmcal.mechanisms import load_mechanism
from pkmcal.report.study import document_of, runs_bytes
from pkmcal.studies import cluster, engine, tasks, workers
from pkmcal.studies.calibrations import (
    ESTIMATE,
    SimulatedCalibrations,
    covered,
    judged,
    tool_difference,
)
from pkmcal.studies.capture import captured
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.findings import SweepResult, clustered, study
from pkmcal.studies.paper_a_joint import JointByAxes
from pkmcal.studies.statistics import Summary
from pkmcal.studies.store import Store
from pkmcal.studies.sweep import cells_of, in_words, parsed, scaled, subject_of
from pkmcal.studies.tasks import Batch, Job, Population, Sample
from pkmcal.wording import brief

SMALL = ("--vary", "configurations=6", "--vary", "stations=1,2")
"""Of 3-rpr: two combinations in a second or two."""


@pytest.fixture
def alone(monkeypatch):
    """This process alone: other ones take a second to start."""
    monkeypatch.setattr(workers, "cores", lambda: 1)


def design_of(name, *vary):
    subject = subject_of(name)
    return cells_of(subject, parsed(subject, vary))[0].setting.design


def batch_of(setting, runs=4, seed=0):
    return engine.batches(setting, runs, seed)[0]


# ------------------------------------------------------------------ what is studied


def test_a_grid_has_every_combination():
    subject = subject_of("gough-stewart")
    cells = cells_of(subject, parsed(subject, ["stations=1,2,3", "edge_noise=0.1,0.2"]))
    assert [tuple(cell.values.values()) for cell in cells] == [
        (s, e) for s in (1, 2, 3) for e in (0.1, 0.2)
    ]
    assert cells[3].setting.design.stations == 2
    assert cells[3].setting.design.edge_noise == 0.2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["station=1"], "this cannot be varied.*expected stations"),
        (["colour=1"], "this cannot be varied.*NAME=V1,V2"),
        (["stations"], "a value is missing; found stations, expected stations=V1,V2"),
        (["stations="], "a value is missing"),
        (["stations=1,,2"], "a value is missing"),
        (["stations=1,x"], "stations cannot be this.*a whole number of 1 to 100"),
        (["stations=1.5"], "stations cannot be this"),
        (["edge_noise=-1"], "edge_noise cannot be this.*px"),
        (["stations=1,1"], "a value stands twice"),
        (["stations=1", "stations=2"], "varied twice"),
        (["camera=telescope"], "no such camera.*a camera's file"),
        (["observe=arms"], "no such observe.*legs, board and legs\\+board"),
    ],
)
def test_what_cannot_be_varied_is_told(words, message):
    with pytest.raises(InputError) as caught:
        parsed(subject_of("3-rpr"), words)
    assert re.search(message, str(caught.value))


@pytest.mark.parametrize(
    "vary", ["legs=3", ["legs=3"], {"legs": [3]}, {"legs": 3}, {"legs": np.array([3])}]
)
def test_one_value_may_stand_alone(vary, alone):
    assert study("a", vary, runs=2).varied == {"legs": (3,)}


def test_a_camera_by_its_name_is_one_value():
    with pytest.raises(InputError, match=r"no such camera.*found telescope"):
        study("3-rpr", {"camera": "telescope"}, runs=2)


def test_too_many_combinations_are_refused():
    subject = subject_of("3-rpr")
    values = ",".join(str(k) for k in range(11, 41))
    with pytest.raises(InputError, match=r"too many combinations.*900"):
        cells_of(subject, parsed(subject, [f"stations={values}", f"focal={values}"]))


def test_an_unknown_subject_is_told():
    with pytest.raises(InputError, match=r"there is nothing of this name to study.*gough-stewart"):
        subject_of("gough")


def test_hinged_bars_are_told():
    with pytest.raises(InputError, match=r"'h4-rods' has side bars.*one rod a forearm, such as h4"):
        subject_of("h4-rods")


@pytest.mark.parametrize("name", ["gough-stewart", "h4", "hexaglide", "delta", "3-rpr"])
def test_a_machine_of_another_size_is_the_same_machine(name):
    """Twice as large, it reaches twice as far with the same angles and twice the lengths."""
    one = load_mechanism(name)
    two = scaled(one, 2.0)
    lengths = np.array(one.joint_units) == "m"
    readings = one.inverse(one.home()[None])
    expected = one.forward(readings)
    expected[..., :3, 3] *= 2
    found = two.forward(np.where(lengths, 2.0, 1.0) * readings)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    factor = np.where(lengths, 2.0, 1.0)[:, None]
    np.testing.assert_allclose(two.joint_ranges, factor * one.joint_ranges)
    np.testing.assert_array_equal(two.parameters.tolerance, one.parameters.tolerance)


def test_cameras_change_as_told():
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


def test_a_camera_that_sees_too_little_is_told():
    design = design_of("gough-stewart", "distance=0.4", "focal=3000")
    with pytest.raises(InputError, match="does not see the machine"):
        captured(design, np.random.default_rng(0))


def test_a_session_gives_its_cameras_stations_and_noise(demo):
    subject = subject_of(str(demo.session))
    design = subject.design
    assert (design.stations, design.configurations, design.observe) == (3, 4, ("legs",))
    assert design.reading_noise == 3e-6
    assert design.T_camera_base.shape == (3, 4, 4)
    plan = captured(design, np.random.default_rng(0))
    np.testing.assert_array_equal(plan.T_camera_base, design.T_camera_base)
    moved = cells_of(subject, parsed(subject, ["stations=2"]))[0].setting.design
    assert moved.T_camera_base is None


def test_a_session_without_photographs_can_be_studied(session):
    """Before any is taken: fifteen from each place; and its workspace is said to be left out."""
    shutil.rmtree(session / "images")
    with (session / "session.yaml").open("a") as file:
        file.write("workspace: {turn: 0.1}\n")
    for named in (session, session / "session.yaml"):
        subject = subject_of(str(named))
        assert subject.design.configurations == 15
        assert not subject.design.shared
        assert subject.design.T_camera_base.shape == (3, 4, 4)
        assert "over the whole reach, not over its workspace" in subject.warnings[0]
        assert "There are no photographs yet: 15 are taken" in subject.warnings[1]


def test_a_folder_called_like_a_machine_is_not_taken_for_a_session(tmp_path, monkeypatch, demo):
    monkeypatch.chdir(tmp_path)
    Path("delta").mkdir()
    assert subject_of("delta").name == "delta"
    shutil.copytree(demo.session, "h4")
    assert subject_of("h4").name == "the session h4"
    Path("mine").mkdir()
    with pytest.raises(InputError, match=r"mine: the folder holds no session.yaml"):
        subject_of("mine")


# ------------------------------------------------------------------ what is simulated


def test_the_tool_of_the_truth_is_not_off():
    """Whatever frames the truth is told in: only what moves the tool counts."""
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
    off, sigma = tool_difference(machine, true.theta, covariance, other, joints, every=False)
    assert np.abs(off).max() < 1e-9
    assert np.isfinite(sigma).all()
    worse = replace(true, theta=true.theta + 1e-4 * np.eye(len(true.theta))[20])
    off, _ = tool_difference(machine, true.theta, covariance, worse, joints, every=False)
    assert np.abs(off).max() > 1e-6


@pytest.mark.parametrize(
    ("subject", "vary"),
    [
        ("3-rpr", ["stations=1", "configurations=10"]),
        ("h4", ["observe=board", "stations=1", "configurations=12"]),
        ("gough-stewart", ["camera=mirror", "stations=1", "configurations=10"]),
        ("gough-stewart", ["observe=legs+board", "stations=1", "configurations=5"]),
        ("a", []),
    ],
)
def test_stated_deviations_hold(subject, vary, alone):
    """A few runs: errors over stated deviations are about one, for parameters and tool."""
    found = study(subject, vary, runs=10)
    cell, sample = found.found[0], found.results[0].samples[ESTIMATE]
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
    for found in (cell.covered, cell.covered_tool):
        assert 0.93 <= found.value <= 0.97


def test_wrong_deviations_are_told():
    """Half of the true deviations: the study says so, and exit code and page with it."""
    rng = np.random.default_rng(0)
    sigma = np.ones((40, 30))
    error = rng.normal(size=sigma.shape)
    assert abs(covered(error, sigma).mean() - 0.95) < 0.02
    assert covered(error, 0.5 * sigma).mean() < 0.75
    tool = rng.normal(size=(40, 5, 6))
    sample = judged(np.stack([error, 0.5 * sigma]), np.stack([tool, np.ones_like(tool)]),
                    Fitted(error, told={"chi2": np.ones(40), "failed": np.zeros(40)}))  # fmt: skip
    assert sample.values["covered"].mean() < 0.75
    assert sample.values["covered_tool"].mean() > 0.9


def test_standard_errors_know_of_batches():
    """Runs of a batch that are alike count as one."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(400, 25))
    batch = np.repeat(np.arange(25), 8)
    errors = [clustered(np.repeat(row, 8), batch).error for row in means]
    assert np.mean(np.square(errors)) == pytest.approx(1 / 25, rel=0.05)


def test_calibrations_that_all_fail_are_told(tmp_path, alone):
    """A thousand times the noise of [A] Table 1: no calibration can be used, and that is said."""
    done = run("study", "a", "--vary", "axis_noise=1,1000", "--runs", 4, "-o", tmp_path)
    assert done.code == 1, done.err
    assert "Too few calibrations of some combinations can be used" in done.out
    assert "axis noise 1000: 100 % of the calibrations fail" in done.out
    assert "nan" not in done.out
    told = json.loads((tmp_path / "study.json").read_text())
    good, bad = told["combinations"]
    assert good["deviations_hold"] is True
    assert bad["deviations_hold"] is None
    assert bad["position"] == {"value": None, "standard_error": None}
    assert told["gains"] == []
    page = (tmp_path / "study.html").read_text()  # of which a browser reads every plot
    figures = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.DOTALL)
    assert len(figures) == 2
    assert all("NaN" not in figure for figure in figures)


def test_a_platform_that_does_not_turn_is_told_no_turns(tmp_path, alone):
    out = tmp_path / "out"
    done = run("study", "delta", *SMALL[:2], "--vary", "stations=1", "--runs", 4, "-o", out)
    assert done.code == 0, done.err
    assert re.search(r"Calibrations leave \S+ mm at the tool", done.out)
    assert "mrad" not in re.sub("<script.*?</script>", "", (out / "study.html").read_text())


def test_one_run_tells_no_standard_error():
    one = clustered(np.array([0.3]), np.array([5]))
    assert one.value == 0.3
    assert np.isnan(one.error)


def test_parameters_keep_their_names_where_legs_and_boards_are_compared(alone):
    """With legs the tubes' radii are parameters as well, between the others."""
    found = study("h4", ["observe=board,legs", "stations=1", "configurations=6"], runs=2)
    told = [cell["covered_by_parameter"] for cell in document_of(found)["combinations"]]
    for names, cell in zip(told, found.cells, strict=True):
        assert list(names) == [name for name, _ in cell.setting.parameters]
    radius = "legs[1].tubes[1].radius"
    assert radius in told[1]
    assert radius not in told[0]
    head, *lines = found.summary().splitlines()
    assert head == f"{found.subject.name}, 2 calibrations a combination"
    for line, cell in zip(lines, found.found, strict=True):
        assert line.startswith(f"  {in_words(cell.values)}: tool ")
        assert f"stated {brief(1e3 * cell.position_sigma)} mm, " in line


def test_what_chance_does_is_no_gain():
    """Three values that do not matter, each told from two batches of runs: one study in twenty may
    call the largest difference a gain, and two standard errors would do so in half of them."""
    rng = np.random.default_rng(4)
    cell = study("a", (), runs=2).found[0]
    calls = 0
    for means in rng.normal(1.0, 0.1, (400, 3, 2)):
        cells = tuple(
            replace(cell, values={"legs": k}, freedom=1,
                    position=Summary(pair.mean(), abs(np.diff(pair)[0]) / 2))
            for k, pair in zip((3, 4, 5), means, strict=True)
        )  # fmt: skip
        subject = subject_of("a")
        calls += SweepResult(subject, {"legs": (3, 4, 5)}, (), (), cells, 20, 0).gains[0].sure
    assert calls <= 0.05 * 400


# ------------------------------------------------------------------ the command


def test_the_command_tells_and_writes(tmp_path, alone):
    out = tmp_path / "study"
    done = run("study", "3-rpr", *SMALL, "--runs", 12, "-o", out)
    assert done.code == 0, done.err
    assert "The stated deviations hold" in done.out
    assert "stations 1" in done.out
    with (out / "study.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 24
    assert [row["run"] for row in rows[:12]] == [str(k) for k in range(12)]
    assert {row["stations"] for row in rows} == {"1", "2"}
    assert all(float(row["position"]) > 0 for row in rows)
    assert all(row["worst_parameter"].startswith("legs[") for row in rows)
    page = (out / "study.html").read_text()
    assert "By stations" in page
    again = run("study", "3-rpr", *SMALL, "--runs", 12, "-o", out, "--json").json
    assert again["exit_code"] == 0
    assert len(again["combinations"]) == 2
    assert again["combinations"][0]["covered"]["value"] > 0.85
    assert [gain["name"] for gain in again["gains"]] == ["stations"]


def test_more_runs_go_on_from_the_finished_ones(tmp_path, alone):
    few = study("3-rpr", SMALL[1:2], runs=10, out=tmp_path)
    before = sorted(p.stat().st_mtime_ns for p in tmp_path.glob("batches/*.npz"))
    more = study("3-rpr", SMALL[1:2], runs=20, out=tmp_path)
    after = sorted(p.stat().st_mtime_ns for p in tmp_path.glob("batches/*.npz"))
    assert after[:1] == before
    first, both = (r.results[0].values("position", *ESTIMATE) for r in (few, more))
    np.testing.assert_array_equal(both[:10], first)


def test_another_study_in_the_same_folder_is_refused(tmp_path, alone):
    study("a", (), runs=4, out=tmp_path)
    done = run("study", "a", "--vary", "legs=5", "--runs", 4, "-o", tmp_path)
    assert done.code == 2
    assert "the batches of another study" in done.err
    assert "found a, seed 0" in done.err
    (tmp_path / "batches" / "study.json").write_text("nonsense")
    done = run("study", "a", "--runs", 4, "-o", tmp_path)
    assert done.code == 2
    assert "does not describe a study" in done.err


def test_a_file_that_is_spoilt_is_done_again(tmp_path, alone):
    one = study("a", (), runs=4, out=tmp_path)
    (path,) = tmp_path.glob("batches/*.npz")
    path.write_bytes(path.read_bytes()[:500])
    two = study("a", (), runs=4, out=tmp_path)
    np.testing.assert_array_equal(*(r.results[0].values("position", *ESTIMATE) for r in (one, two)))


def test_parquet(tmp_path, alone, monkeypatch):
    words = ("study", "a", "--runs", 4, "-o", tmp_path / "out", "--table", "parquet")
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    done = run(*words)
    assert done.code == 2
    assert "pip install 'pkmcal[parquet]'" in done.err
    monkeypatch.undo()
    parquet = pytest.importorskip("pyarrow.parquet")
    assert run(*words).code == 0
    table = parquet.read_table(tmp_path / "out" / "study.parquet").to_pydict()
    assert table["run"] == [0, 1, 2, 3]
    assert all(np.array(table["position"]) > 0)


# ------------------------------------------------------------------ stopped and resumed

COMMAND = ("a", "--vary", "configurations=5,6", "--runs", "225")
BATCHES = 7
LONGER = (*COMMAND[:-1], "600")


def started(out: Path, command: tuple[str, ...] = COMMAND) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", "pkmcal", "study", *command, "-o", str(out)]
    quiet = subprocess.DEVNULL
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}

    def heard() -> None:
        """What a shell started in the background ignores is heard again."""
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    return subprocess.Popen(words, stdout=quiet, stderr=quiet, env=environment, preexec_fn=heard)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The command's study without a stop, by one process."""
    folder = tmp_path_factory.mktemp("study") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "cores", lambda: 1)
        assert run("study", *COMMAND, "-o", folder).code == 0
    return folder


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no kill -9 here")
@pytest.mark.parametrize("how", ["SIGKILL", "SIGINT"])
def test_a_study_that_is_stopped_goes_on(tmp_path, how, whole, alone):
    """The same numbers to the byte, no finished batch lost and none done twice; begun by one
    process a core, ended by one.
    """
    stopped = tmp_path / "stopped"
    process = started(stopped)
    deadline = time.monotonic() + 120
    while len(list(stopped.glob("batches/*.npz"))) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(getattr(signal, how))
    process.wait()
    finished = {p.name: p.stat().st_mtime_ns for p in stopped.glob("batches/*.npz")}
    assert 2 <= len(finished) < BATCHES
    assert not (stopped / "study.csv").exists()
    assert run("study", *COMMAND, "-o", stopped).code == 0
    for name in ("study.csv", "study.json"):
        assert (stopped / name).read_bytes() == (whole / name).read_bytes()
    # the page tells to the minute when it was made
    pages = [(folder / "study.html").read_text() for folder in (stopped, whole)]
    pages, times = zip(
        *(re.subn(r"\d+ \w+ \d{4}, \d\d:\d\d", "", page) for page in pages), strict=True
    )
    assert pages[0] == pages[1]
    assert times == (1, 1)
    kept = {p.name: p.stat().st_mtime_ns for p in stopped.glob("batches/*.npz")}
    assert len(kept) == BATCHES
    assert finished.items() <= kept.items()
    assert not list(stopped.glob("batches/.*"))


class Counting:
    """A setting whose runs are their own random numbers."""

    doing = "Counting"
    quantities = {"x": tasks.Quantity("mean")}  # noqa: RUF012 - a test's

    def __init__(self, fails: str = "", takes: float = 0.0) -> None:
        self.fails, self.takes = fails, takes

    def populations(self, runs):
        return [Population("numbers", runs, 5)]

    def draw(self, batch: Batch):
        if self.fails == "input":
            raise InputError("nothing to count")
        if self.fails == "dies" and os.environ.get("PKMCAL_TEST_PARENT") != str(os.getpid()):
            os._exit(9)
        return batch.generator(0).random(batch.runs)

    def solve(self, batch, data):
        return {ESTIMATE: data}

    def judge(self, batch, data, found):
        time.sleep(self.takes)
        return {ESTIMATE: Sample({"x": found[ESTIMATE]})}


def test_workers_that_die_are_replaced(monkeypatch):
    """One is killed in the middle: the same numbers, and no batch twice."""
    begun: list[subprocess.Popen[bytes]] = []
    real = subprocess.Popen

    def recorded(*words, **options):
        begun.append(real(*words, **options))
        return begun[-1]

    monkeypatch.setattr(workers.subprocess, "Popen", recorded)
    monkeypatch.setattr(workers, "cores", lambda: 2)
    done: list[float] = []

    def told(_text, share):
        done.append(share)
        if len(done) == 50:
            begun[0].kill()

    setting = JointByAxes(replace(JointByAxes().axes, poses=4, batch=2))
    # long enough for the one in its place to begin, too
    many = engine.run(Counting(takes=0.04), 1500, 1, told)
    assert len(done) == 300
    assert len(begun) == 2  # beside this process one, and the one in its place
    monkeypatch.setattr(workers, "cores", lambda: 1)
    one = engine.run(Counting(), 1500, 1)
    np.testing.assert_array_equal(*(r.values("x", *ESTIMATE) for r in (many, one)))
    assert engine.run(setting, 4, 0).values("position", *ESTIMATE).shape == (4,)


def test_a_batch_that_kills_every_worker_ends_the_study(monkeypatch):
    monkeypatch.setenv("PKMCAL_TEST_PARENT", str(os.getpid()))
    pool = workers._Pool([Job(Counting("dies"), batch_of(Counting()))], lambda _k, _done: None)
    pool.elsewhere()
    assert isinstance(pool.failure, ResultError)
    assert "killed again and again" in str(pool.failure)


def test_an_error_in_another_process_is_told():
    pool = workers._Pool([Job(Counting("input"), batch_of(Counting()))], lambda _k, _done: None)
    pool.elsewhere()
    assert isinstance(pool.failure, InputError)
    assert str(pool.failure) == "nothing to count."


def test_an_error_here_is_told(alone):
    with pytest.raises(InputError, match="nothing to count"):
        engine.run(Counting("input"), 10, 0)


def test_what_is_kept_is_what_was_done(tmp_path):
    setting = Counting()
    task = Job(setting, batch_of(setting, 5))
    done = tasks.work(task)
    with Store.opened(tmp_path, "counting", [], 0) as store:
        store.save(0, 0, done)
        found = store.load(0, 0, task.batch)
        assert found.wall == done.wall
        np.testing.assert_array_equal(
            found.samples[ESTIMATE].values["x"], done.samples[ESTIMATE].values["x"]
        )
        assert store.load(0, 1, task.batch) is None
        assert store.load(0, 0, replace(task.batch, runs=4)) is None


def test_two_studies_do_not_work_in_one_folder_at_once(tmp_path, alone):
    """Neither another one nor the same again; once the first has ended, its command goes on."""
    first = started(tmp_path, LONGER)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("batches/*.npz")):
        assert first.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for words in (LONGER, ("a", "--runs", "4")):
        done = run("study", *words, "-o", tmp_path)
        assert done.code == 2
        assert "another study works in this folder. Wait until it has ended" in done.err
    assert first.poll() is None
    first.kill()
    first.wait()
    with pytest.raises(InputError, match="the batches of another study"):
        study("a", (), runs=4, out=tmp_path)
    settings = [cell.setting for cell in cells_of(subject_of("a"), {"configurations": (5, 6)})]
    with Store.opened(tmp_path, "the same", settings, 0) as store:
        assert store.load(0, 0, batch_of(settings[0], 1000)) is not None


def test_an_impossible_combination_is_named_before_the_others_are_done(tmp_path, alone):
    vary = [SMALL[1], "stations=1", "focal=900", "distance=2,0.1"]
    with pytest.raises(InputError, match=r"distance 0.1: a camera does not see the machine"):
        study("3-rpr", vary, runs=200, out=tmp_path)
    assert len(list(tmp_path.glob("batches/*.npz"))) == 1


def test_a_folder_where_nothing_was_finished_is_free(tmp_path, alone):
    """After a combination that nobody can photograph, the command is mended, and runs."""
    with pytest.raises(InputError, match=r"does not see the machine"):
        study("3-rpr", ["focal=900", "distance=0.1"], runs=2, out=tmp_path)
    assert study("3-rpr", ["stations=1", SMALL[1]], runs=2, out=tmp_path).runs == 2


# ------------------------------------------------------------------ a cluster


def test_a_cluster_without_dask_is_told(monkeypatch):
    monkeypatch.setattr(cluster, "find_spec", lambda _name: None)
    with pytest.raises(InputError, match=r"dask.distributed.*pip install 'pkmcal\[cluster\]'"):
        study("a", (), runs=4, scheduler="tcp://127.0.0.1:1")


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_does_not_answer_is_told(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "TIMEOUT", 1)
    with pytest.raises(InputError, match=r"no Dask scheduler answers.*127.0.0.1:1"):
        study("a", (), runs=4, scheduler="tcp://127.0.0.1:1")


@pytest.mark.parametrize("address", ["", "nonsense", "host:port", "ftp://10.0.0.1:21", "tcp://:1"])
def test_what_is_no_address_is_told_at_once(address):
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match=r"no address of a Dask scheduler.*tcp://10.0.0.1:8786"):
        study("a", (), runs=4, scheduler=address)


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_goes_away_is_told(tmp_path):
    """What was finished by then is kept."""
    distributed, dask = (pytest.importorskip(name) for name in ("distributed", "dask"))
    local = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None,
        protocol="tcp",
    )  # fmt: skip
    with (
        local,
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(ResultError, match="the scheduler of the cluster is gone"),
    ):
        study(
            "a",
            ["configurations=5"],
            runs=2000,
            scheduler=local.scheduler_address,
            out=tmp_path,
            progress=lambda _text, share: share > 0.1 and local.close(),
        )
    assert list(tmp_path.glob("batches/*.npz"))


@pytest.mark.filterwarnings("default")
def test_a_cluster_gives_the_same_numbers_though_a_worker_dies(tmp_path, alone):
    distributed = pytest.importorskip("distributed")
    killed: list[int] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as local:

        def told(_text, share):
            if share > 0.2 and not killed:
                killed.append(next(iter(local.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        many = study("a", ["configurations=5"], runs=300, scheduler=local.scheduler_address,
                     out=tmp_path / "cluster", progress=told)  # fmt: skip
    assert killed
    one = study("a", ["configurations=5"], runs=300)
    assert runs_bytes(many, "study.csv") == runs_bytes(one, "study.csv")
    assert str(document_of(many)) == str(document_of(one))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_in_the_place_of_a_batch_is_none(tmp_path):
    first = study("3-rpr", SMALL[1:2], runs=10, out=tmp_path)
    batch = next(tmp_path.glob("batches/*.npz"))
    batch.unlink()
    os.mkfifo(batch)
    again = study("3-rpr", SMALL[1:2], runs=10, out=tmp_path)
    one, two = (r.results[0].values("position", *ESTIMATE) for r in (first, again))
    np.testing.assert_array_equal(one, two)
    assert batch.is_file()
