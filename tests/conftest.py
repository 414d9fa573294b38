"""Shared by the tests of commands: one demonstration, rendered once, and the command line."""

from __future__ import annotations

import gc
import io
import json
import os
import pickle
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import pytest
from hypothesis import settings

from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.refinement import RefinementOptions
from pkmcal.camera_calibration.calibrate import CALIBRATION_CHECK_OPTIONS, calibrate_camera
from pkmcal.camera_calibration.model_selection import MODEL_SELECTION_OPTIONS
from pkmcal.commands import console
from pkmcal.commands.cli import main
from pkmcal.planning.plan import PlanOptions, plan_measurements
from rendered import once

# Examples of a property, unless its test says how many.
settings.register_profile("quick", max_examples=40)
settings.load_profile("quick")

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration
    from pkmcal.checks.results import SessionCheck

Result = TypeVar("Found")


@dataclass(frozen=True)
class Run:
    """Result of one command: exit code and output."""

    code: int
    out: str
    err: str

    @property
    def json(self):
        """The one object on stdout."""
        return json.loads(self.out, parse_constant=pytest.fail)


@pytest.fixture(autouse=True)
def cache_of_one_test(tmp_path_factory, monkeypatch, request):
    """A cache folder of its own: no result depends on another test's."""
    number = format(abs(hash(request.node.nodeid)), "x")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache" / number))


def run(*words) -> Run:
    """One command through the real entry point, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(word) for word in words])
    return Run(code, out.getvalue(), err.getvalue())


LONG = (
    "test_cli", "test_camera_calibration", "test_board_session", "test_watch_command",
    "test_cables", "test_view", "test_study_executors", "test_chance_matches", "test_handheld",
    "test_fuzz", "test_docs", "test_silhouettes", "test_boards", "test_plan",
    "test_calibrate_board", "test_calibration", "test_diagnose", "test_observe_search",
    "test_paper_a", "test_verbs", "test_validate", "test_noise", "test_real", "test_heights",
    "test_pose_sessions", "test_dialects", "test_from_bodies", "test_repeats", "test_study",
    "test_show", "test_marlin", "test_paper_c", "test_export_mujoco", "test_servo", "test_bundle",
    "test_reproduce_b", "test_eccentric_encoders", "test_hostile", "test_cameras",
    "test_export_trees", "test_site", "test_export_firmware", "test_export", "test_accepted_inputs",
    "test_profiles", "test_export_c", "test_hypotheses", "test_model_violations",
    "test_report_page", "test_firmware_values", "test_accessibility", "test_simulate",
    "test_legible", "test_writing", "test_response", "test_edge_noise", "test_check_forecast",
    "test_cli_camera", "test_discrepancy", "test_readings_alone", "test_check", "test_python",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """The files that take longest first: a worker that is left alone with one of them at the end
    leaves the other without work.
    """
    items.sort(key=lambda item: LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG))


def pytest_collection_finish():
    """Imported modules stay until the end, so the garbage collector need not scan them: that took
    one second of thirty.
    """
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """No line about the progress on stderr, which tests compare, however slow the machine is."""
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 3600.0)


FEW_IMPUTATIONS = RefinementOptions(imputations=2)
"""For calibrations whose variance between imputations is not tested: by default these measurement
passes take half of a calibration's time."""


def slow_but(few: Collection[str], names: Iterable[str]) -> list:
    """Names as parameters of a test: a few that differ in kind, the others as slow tests."""
    return [name if name in few else pytest.param(name, marks=pytest.mark.slow) for name in names]


@dataclass(frozen=True)
class Demo:
    """A finished demonstration: its folders, and its output; tests must not write into them."""

    folder: Path
    run: Run

    @property
    def session(self) -> Path:
        return self.folder / "session"

    @property
    def calibration(self) -> Path:
        return self.folder / "calibration"


@pytest.fixture(scope="session")
def common(tmp_path_factory) -> Path:
    """A folder that all workers of a run of the tests share."""
    root = tmp_path_factory.getbasetemp()
    return (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "common"


def made_once(folder: Path, make: Callable[[], Any]) -> Any:
    """Result of ``make``, computed by the first worker that needs it; other workers read it from
    the folder.
    """

    def write(part: Path) -> None:
        part.mkdir()
        (part / "made.pickle").write_bytes(pickle.dumps(make()))

    return pickle.loads((once(folder, write) / "made.pickle").read_bytes())


@dataclass(frozen=True)
class WithProgress(Generic[Result]):
    """Result of a function for the demonstration's session, and its progress messages."""

    result: Result
    steps: list[tuple[str, float]]


@pytest.fixture(scope="session")
def demo(common) -> Demo:
    """One demonstration for a run of the tests: its folders and output."""
    words = ("demo", "-o", common / "demo", "--fast", "--no-open", "--json")
    return Demo(common / "demo", made_once(common / "demonstrated", lambda: run(*words)))


@pytest.fixture(scope="session")
def calibrating(demo, common) -> WithProgress[Calibration]:
    """The demonstration's session, calibrated from Python, with the progress messages."""

    def make() -> WithProgress[Calibration]:
        progress: list[tuple[str, float]] = []
        calibration = calibrate_session(
            demo.session, progress=lambda text, share: progress.append((text, share))
        )
        return WithProgress(calibration, progress)

    return made_once(common / "calibrated", make)


@pytest.fixture(scope="session")
def calibrated(calibrating) -> Calibration:
    """That calibration without its messages."""
    return calibrating.result


@pytest.fixture(scope="session")
def checked(demo, common) -> WithProgress[SessionCheck]:
    """The demonstration's session, checked from Python."""
    from pkmcal.checks.check import check_session

    def make() -> WithProgress[SessionCheck]:
        progress: list[tuple[str, float]] = []
        check = check_session(
            demo.session, progress=lambda text, share: progress.append((text, share))
        )
        return WithProgress(check, progress)

    return made_once(common / "checked", make)


@pytest.fixture(scope="session", autouse=True)
def one_core_a_worker():
    """A study uses one core where the tests take all: another process takes a second to start."""
    with pytest.MonkeyPatch.context() as patch:
        if "PYTEST_XDIST_WORKER" in os.environ:
            have_cores(patch, 1)
        yield


def have_cores(patch: pytest.MonkeyPatch, count: int) -> None:
    """A computer with so many processors."""
    patch.setattr(os, "cpu_count", lambda: count)
    patch.setattr(os, "sched_getaffinity", lambda _pid: set(range(count)), raising=False)


@pytest.fixture
def one_process(monkeypatch):
    """Studies in this process: other ones take a second to start."""
    have_cores(monkeypatch, 1)


FEW_CANDIDATES = PlanOptions(candidates=60, work_poses=20, rounds=1)
"""For plans whose quality is not tested."""


@pytest.fixture(scope="module")
def quick_plans():
    """Plans of the command and of Python's function, which have no such options, among few
    candidates.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "pkmcal.api.plan.plan_measurements", partial(plan_measurements, options=FEW_CANDIDATES)
        )
        yield


@contextmanager
def two_camera_models() -> Iterator[None]:
    """Calibrations of a camera, by the command and by Python's function, compare two models only:
    all of them take seconds.
    """
    selection = replace(MODEL_SELECTION_OPTIONS, models=("pinhole", "unified"))
    options = replace(CALIBRATION_CHECK_OPTIONS, selection=selection)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "pkmcal.camera_calibration.calibrate.calibrate_camera",
            partial(calibrate_camera, options=options),
        )
        yield


@pytest.fixture(scope="module")
def quick_cameras():
    """Calibrations of cameras whose model is not tested."""
    with two_camera_models():
        yield


@pytest.fixture
def session(demo, tmp_path) -> Path:
    """A copy of the demonstration's session, to spoil; without its truth."""
    folder = tmp_path / "session"
    shutil.copytree(demo.session, folder)
    (folder / "truth.json").unlink()
    return folder
