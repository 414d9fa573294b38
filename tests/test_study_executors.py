"""A stopped study continues from its finished batches: on other processes, and on a cluster."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest

from conftest import have_cores, run
from counting import COUNT_KEY, Counting
from faults import raises
from pkmcal.api.study import study
from pkmcal.errors import InputError, ResultError
from pkmcal.papers.paper_a import study_subject
from pkmcal.studies import cluster, engine, tasks
from pkmcal.studies.calibrations import (
    JOINT_ESTIMATE_KEY,
)
from pkmcal.studies.store import Store
from pkmcal.studies.study_report import runs_csv, study_document
from pkmcal.studies.sweep import cells_of
from pkmcal.studies.tasks import Job
from test_study import SMALL, batch_of

COMMAND = ("a", "--vary", "configurations=5,6", "--runs", "150")
LONGER = (*COMMAND[:-1], "600")


def started(out: Path, command: tuple[str, ...] = COMMAND) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", "pkmcal", "study", *command, "-o", str(out)]
    quiet = subprocess.DEVNULL
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}

    def heard() -> None:
        """Handle signals that a shell started in the background ignores."""
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    return subprocess.Popen(words, stdout=quiet, stderr=quiet, env=environment, preexec_fn=heard)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The command's study without a stop, by one process."""
    folder = tmp_path_factory.mktemp("study") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        have_cores(patch, 1)
        assert run("study", *COMMAND, "-o", folder).code == 0
    return folder


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no kill -9 here")
@pytest.mark.parametrize("how", ["SIGINT", pytest.param("SIGKILL", marks=pytest.mark.slow)])
def test_a_study_that_is_stopped_goes_on(tmp_path, how, whole, one_process):
    """The same numbers to the byte, no finished batch lost and none done twice; begun by one
    process for each core, ended by one.

    One that is killed keeps its batches, too: test_two_studies_do_not_work_in_one_folder_at_once.
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
    count = len(list(whole.glob("batches/*.npz")))
    assert 2 <= len(finished) < count
    assert not (stopped / "study.csv").exists()
    assert run("study", *COMMAND, "-o", stopped).code == 0
    for name in ("study.csv", "study.json"):
        assert (stopped / name).read_bytes() == (whole / name).read_bytes()
    # the page has the minute of its making
    pages = [(folder / "study.html").read_text() for folder in (stopped, whole)]
    pages, times = zip(
        *(re.subn(r"\d+ \w+ \d{4}, \d\d:\d\d", "", page) for page in pages), strict=True
    )
    assert pages[0] == pages[1]
    assert times == (1, 1)
    retained = {p.name: p.stat().st_mtime_ns for p in stopped.glob("batches/*.npz")}
    assert len(retained) == count
    assert finished.items() <= retained.items()
    assert not list(stopped.glob("batches/.*"))


def test_processes_that_die_are_replaced(monkeypatch):
    """All are killed in the middle: the same numbers, and no batch twice. The setting is larger
    than a pipe's buffer.
    """
    have_cores(monkeypatch, 2)
    shares, begun = [], set[int]()

    def report(_text, share):
        shares.append(share)
        begun.update(process.pid for process in active_children())
        if len(shares) == 20:
            for process in active_children():
                process.kill()

    # long enough for the pool in the place of the first to begin, too
    many = engine.run(Counting(takes=0.02, ballast=200_000), 200, 1, report)
    assert len(shares) == 40
    assert len(begun) == 4
    assert not active_children()
    have_cores(monkeypatch, 1)
    one = engine.run(Counting(), 200, 1)
    assert (many.workers, one.workers) == (2, 1)
    np.testing.assert_array_equal(*(r.values("x", *COUNT_KEY) for r in (many, one)))


@pytest.mark.slow
def test_a_batch_that_kills_every_process_ends_the_study(monkeypatch):
    have_cores(monkeypatch, 2)
    with raises(ResultError, code="study.workers_killed") as error:
        engine.run(Counting("dies"), 10, 0)
    assert error.value.found.startswith("3 times")


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_of_a_task_is_raised(monkeypatch, count):
    have_cores(monkeypatch, count)
    with raises(InputError, what="nothing to count"):
        engine.run(Counting("input"), 10, 0)
    assert not active_children()


def test_a_script_needs_no_guard(tmp_path):
    """Processes do not run the script again, which would start a study in each."""
    script = tmp_path / "script.py"
    script.write_text(
        "import os\n"
        "os.sched_getaffinity = lambda _pid: {0, 1}\n"
        "os.cpu_count = lambda: 2\n"
        "from pkmcal.studies import engine\n"
        "from pkmcal.papers.paper_a import JointByAxes\n"
        "print(engine.run(JointByAxes(poses=4, batch=2), 4, 0).workers)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    words = [sys.executable, str(script)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("2\n", "")


def test_what_is_kept_is_what_was_done(tmp_path):
    setting = Counting()
    task = Job(setting, batch_of(setting, 5))
    done = tasks.work(task)
    with Store.opened(tmp_path, "counting", [], 0) as store:
        store.save(0, 0, done)
        value = store.load(0, 0, task.batch)
        assert value.wall == done.wall
        np.testing.assert_array_equal(
            value.samples[COUNT_KEY].values["x"],
            done.samples[COUNT_KEY].values["x"],
        )
        assert store.load(0, 1, task.batch) is None
        assert store.load(0, 0, replace(task.batch, runs=4)) is None


def test_batches_of_other_code_are_refused(tmp_path):
    """The version stays the same between releases, so the digest contains the modules' text."""
    package = tmp_path / "source" / "pkmcal"
    whole = Path(engine.__file__).parents[1]
    shutil.copytree(whole, package, ignore=shutil.ignore_patterns("bundle", "__pycache__"))
    script = (
        "import sys; from pathlib import Path; from pkmcal.studies.store import Store\n"
        "with Store.opened(Path(sys.argv[1]), 'counting', [], 0) as store:\n"
        "    (store.folder / '000-00000.npz').touch()\n"
    )
    words = [sys.executable, "-c", script, str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}

    def opened() -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            words, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
        )

    assert [opened().returncode, opened().returncode] == [0, 0]
    with (package / "solver" / "kernels.py").open("a") as file:
        file.write("# changed\n")
    refused = opened()
    assert refused.returncode == 1
    assert "InputError" in refused.stderr


def test_two_studies_do_not_work_in_one_folder_at_once(tmp_path, one_process):
    """Neither another study nor the same again can start; once the first has ended, its command
    continues.
    """
    first = started(tmp_path, LONGER)
    deadline = time.monotonic() + 120
    while not (tmp_path / "batches" / "000-00000.npz").exists():  # requested below
        assert first.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for words in (LONGER, ("a", "--runs", "4")):
        done = run("study", *words, "-o", tmp_path, "--json")
        assert (done.code, done.json["code"]) == (2, "output.in_use")
    assert first.poll() is None
    first.kill()
    first.wait()
    with raises(InputError, code="study.another"):
        study("a", (), runs=4, out=tmp_path)
    settings = [cell.setting for cell in cells_of(study_subject(), {"configurations": (5, 6)})]
    with Store.opened(tmp_path, "the same", settings, 0) as store:
        assert store.load(0, 0, batch_of(settings[0], 1000)) is not None


def test_an_impossible_combination_is_named_before_the_others_are_done(tmp_path, one_process):
    vary = [SMALL[1], "stations=1", "focal=900", "distance=2,0.1"]
    with raises(InputError, code="station.sees_too_little") as caught:
        study("3-rpr", vary, runs=20, out=tmp_path)
    assert caught.value.where.endswith(", distance 0.1 m")
    assert len(list(tmp_path.glob("batches/*.npz"))) == 1


def test_a_folder_where_nothing_was_finished_is_free(tmp_path, one_process):
    """After a combination that cannot have images, the corrected command runs."""
    with raises(InputError, code="station.sees_too_little"):
        study("3-rpr", ["focal=900", "distance=0.1"], runs=2, out=tmp_path)
    assert study("3-rpr", ["stations=1", SMALL[1]], runs=2, out=tmp_path).runs == 2


# a cluster


def test_a_cluster_without_dask_is_reported(monkeypatch):
    monkeypatch.setattr(cluster, "find_spec", lambda _name: None)
    with raises(InputError, code="package.missing", where="--scheduler") as caught:
        study("a", (), runs=4, scheduler="tcp://127.0.0.1:1")
    assert "pip install '.[cluster]'" in caught.value.next_step


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_does_not_answer_is_reported():
    pytest.importorskip("distributed")
    run_on = cluster.on_cluster("tcp://127.0.0.1:1", timeout=1)
    with raises(InputError, where="--scheduler") as caught:
        run_on([], lambda *_: None)
    assert caught.value.found.startswith("tcp://127.0.0.1:1: ")


@pytest.mark.parametrize("address", ["", "nonsense", "host:port", "ftp://10.0.0.1:21", "tcp://:1"])
def test_what_is_no_address_is_reported_at_once(address):
    pytest.importorskip("distributed")
    with raises(InputError, where="--scheduler", found=f"'{address}'"):
        study("a", (), runs=4, scheduler=address)


@pytest.mark.filterwarnings("default")
def test_a_scheduler_that_goes_away_is_reported(tmp_path):
    """Batches finished by then are kept."""
    distributed, dask = (pytest.importorskip(name) for name in ("distributed", "dask"))
    local = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None,
        protocol="tcp",
    )  # fmt: skip
    with (
        local,
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        raises(ResultError, code="study.scheduler_gone"),
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


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_cluster_gives_the_same_numbers_though_a_worker_dies(tmp_path, one_process):
    distributed = pytest.importorskip("distributed")
    killed: list[int] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as local:

        def report(_text, share):
            if share > 0.2 and not killed:
                killed.append(next(iter(local.workers.values())).pid)
                os.kill(killed[0], signal.SIGKILL)

        many = study("a", ["configurations=5"], runs=200, scheduler=local.scheduler_address,
                     out=tmp_path / "cluster", progress=report)  # fmt: skip
    assert killed
    one = study("a", ["configurations=5"], runs=200)
    assert runs_csv(many) == runs_csv(one)
    assert str(study_document(many)) == str(study_document(one))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_in_the_place_of_a_batch_is_none(tmp_path, one_process):
    first = study("a", (), runs=4, out=tmp_path)
    batch = next(tmp_path.glob("batches/*.npz"))
    batch.unlink()
    os.mkfifo(batch)
    again = study("a", (), runs=4, out=tmp_path)
    one, two = (r.results[0].values("position", *JOINT_ESTIMATE_KEY) for r in (first, again))
    np.testing.assert_array_equal(one, two)
    assert batch.is_file()
