"""Every verb both ways: the command and the function of the same name give the same document and
the same files, from the same defaults; and what all results have in common.
"""

from __future__ import annotations

import inspect
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pkmcal
from conftest import have_cores, run
from faults import raises
from pkmcal.api.result import FolderResult, Result, printed_document
from pkmcal.commands.cli import command_named
from pkmcal.errors import InputError
from pkmcal.files import json_text
from pkmcal.outcome.finding import Finding
from pkmcal.placement.default_camera import default_camera
from pkmcal.planning.defaults import PLANNED_IMAGE_SIZE
from pkmcal.simulation import Settings
from printers import calibrated_cfg
from test_cli_camera import boards  # noqa: F401 - a fixture
from test_pose_sessions import make
from test_ranges import required_words

VERBS = (
    "new", "check", "camera", "board", "plan", "study", "simulate", "calibrate", "validate",
    "watch", "diff", "export", "servo", "reproduce",
)  # fmt: skip
PLACES = {"files", "file", "folder", "kept", "trial"}
"""Keys of the printed object with paths, which a result that is not saved has not."""
VOLATILE = {"timings", "seconds", "wall", "cpu", "solving", "workers", "time"}
"""Keys of durations and times."""
OWN_SUMMARY = {"calibrate", "study"}
"""Verbs whose results have a shorter summary than the command prints."""


@dataclass(frozen=True)
class Case:
    """A small case of a verb: arguments of the command, and a call of the function."""

    words: tuple[Any, ...]
    call: Callable[..., Result]
    progress: bool = True


@pytest.fixture(scope="module")
def work(tmp_path_factory, boards, quick_cameras):  # noqa: F811 - the fixture
    """Two sessions of a machine by a tracker, a calibration of the first, images of a board, a new
    session, and a printer's file.
    """
    folder = tmp_path_factory.mktemp("verbs")
    make(folder / "first", "gough-stewart")
    make(folder / "second", "gough-stewart", n=12)
    (folder / "printer.cfg").write_text(calibrated_cfg())
    pkmcal.new(board=True).save(folder / "mine")
    pkmcal.calibrate(folder / "first").save(folder / "held")
    (folder / "boards").mkdir()
    for name in ("board.yaml", "p0.png", "p1.png", "p2.png", "p3.png"):
        shutil.copy(boards / name, folder / "boards" / name)
    return folder


def case(verb: str, work: Path) -> Case:
    first, second, held = work / "first", work / "second", work / "held"
    quick = {"runs": 2, "rate": 6.0, "noise": 0.0, "joint_noise": 0.0, "duration": 8.0, "delay": 0}
    return {
        "new": lambda: Case(
            ("--printer", work / "printer.cfg"),
            lambda: pkmcal.new(printer=work / "printer.cfg"),
            progress=False,
        ),
        "check": lambda: Case((first,), lambda **more: pkmcal.check(first, **more)),
        "camera": lambda: Case(
            (work / "boards", "--model", "pinhole", "--to", "ros"),
            lambda **more: pkmcal.camera(work / "boards", model="pinhole", to=["ros"], **more),
        ),
        "board": lambda: Case(
            (work / "mine",), lambda: pkmcal.board(work / "mine"), progress=False
        ),
        "plan": lambda: Case(
            ("3-rpr", "-n", 2),
            lambda **more: pkmcal.plan("3-rpr", count=2, **more),
        ),
        "study": lambda: Case(
            ("a", "--runs", 2), lambda **more: pkmcal.study("a", runs=2, **more)
        ),
        "simulate": lambda: Case(
            ("--stations", 1, "--configurations", 2, "--size", "96x72", "--mechanism", "3-rpr"),
            lambda folder, **more: pkmcal.simulate(
                folder, "3-rpr", camera=(96, 72), stations=1, configurations=2, **more
            ),
        ),
        "calibrate": lambda: Case(
            (first, "--holdout", 2), lambda **more: pkmcal.calibrate(first, holdout=2, **more)
        ),
        "validate": lambda: Case(
            (held, second), lambda **more: pkmcal.validate(held, second, **more)
        ),
        "watch": lambda: Case(
            (held, second, "--alpha", 0.02),
            lambda **more: pkmcal.watch(held, second, alpha=0.02, **more),
        ),
        "diff": lambda: Case(
            (held, first / "mechanism.yaml"),
            lambda **more: pkmcal.diff(held, first / "mechanism.yaml", **more),
        ),
        "export": lambda: Case(
            (held, "--to", "json"), lambda: pkmcal.export(held, "json"), progress=False
        ),
        "servo": lambda: Case(
            ("3-rpr", "--runs", 2, "--rate", 6, "--noise", 0, "--joint-noise", 0,
             "--duration", 8, "--delay", 0, "--legs", "1,2,3"),
            lambda **more: pkmcal.servo("3-rpr", legs=[1, 2, 3], **quick, **more),
        ),
        "reproduce": lambda: Case(
            ("a", "--runs", 2), lambda **more: pkmcal.reproduce("a", runs=2, **more)
        ),
    }[verb]()  # fmt: skip


@dataclass(frozen=True)
class Both:
    """A verb's outputs: the command's object, text and folder, and the function's result."""

    verb: str
    document: dict[str, Any]
    folder: Path
    result: Result
    progress: list[tuple[str, float]]

    @property
    def has_progress(self) -> bool:
        return self.verb not in ("new", "board", "export")


@pytest.fixture(scope="module", params=VERBS)
def both(request, work) -> Both:
    verb, folder = request.param, work / "out" / request.param
    progress: list[tuple[str, float]] = []
    one = case(verb, work)
    first = [folder] if verb in ("new", "simulate") else []
    last = [] if first else ["-o", folder]
    with pytest.MonkeyPatch.context() as patch:
        have_cores(patch, 1)
        done = run(verb, *first, *one.words, *last, "--json")
        assert done.err == ""
        more = {"folder": work / "simulated"} if verb == "simulate" else {}
        if one.progress:
            more["progress"] = lambda text, share: progress.append((text, share))
        result = one.call(**more)
    assert done.code == result.exit_code
    return Both(verb, done.json, folder, result, progress)


def lasting(value: Any) -> Any:
    """A document without durations and times of files."""
    if isinstance(value, dict):
        return {key: lasting(item) for key, item in value.items() if key not in VOLATILE}
    return [lasting(item) for item in value] if isinstance(value, list) else value


def contents(path: Path) -> Any:
    """Content of a file that two runs have in common; of a page, that there is one."""
    if path.suffix == ".html":
        return path.read_text(encoding="utf-8").startswith("<!doctype html>")
    if path.suffix == ".json":
        return lasting(json.loads(path.read_text(encoding="utf-8")))
    return path.read_bytes()


def test_both_ways_give_the_same_document(both):
    printed = {key: item for key, item in both.document.items() if key not in PLACES}
    document = printed_document(both.result.outcome)
    value = {k: v for k, v in json.loads(json_text(document)).items() if k not in PLACES}
    assert lasting(value) == lasting(printed)
    assert printed["exit_code"] in (0, 1)


def test_both_ways_write_the_same_files(both, tmp_path):
    both.result.save(tmp_path / "out")
    for folder, other in ((both.folder, tmp_path / "out"), (tmp_path / "out", both.folder)):
        for path in folder.rglob("*.*"):
            if "batches" not in path.parts:
                assert contents(other / path.relative_to(folder)) == contents(path), path.name
    assert all((tmp_path / "out" / name).is_file() for name in both.result.file_list)


def test_a_result_is_findings_a_document_and_a_summary(both):
    result = both.result
    assert isinstance(result, Result)
    assert all(isinstance(one, Finding) and one.code for one in result.findings)
    assert json.loads(json_text(result.document))
    assert result.exit_code == result.outcome.exit_code
    assert result.summary().strip()
    assert "\x1b" not in result.summary()
    assert len(repr(result)) < 1000
    if both.verb not in OWN_SUMMARY:
        assert result.outcome.verdict.headline.split()[0] in result.summary()


def test_progress_goes_from_0_to_1_and_never_backwards(both):
    if not both.has_progress:
        assert "progress" not in inspect.signature(getattr(pkmcal, both.verb)).parameters
        return
    texts, shares = zip(*both.progress, strict=True)
    assert all(texts)
    assert (shares[0], shares[-1]) == (0, 1)
    assert list(shares) == sorted(shares)


def test_a_folder_with_other_files_is_left_alone(both, tmp_path):
    names = {"thesis.tex", *both.result.file_list}
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("mine")
    with pytest.raises(InputError):
        both.result.save(tmp_path)
    assert {(tmp_path / name).read_text() for name in names} == {"mine"}


def test_a_result_of_fixed_names_has_a_folder_that_can_be_checked_before_the_work(both):
    """The files of an export and of a board are named after the format and the board's file."""
    kind = type(both.result)
    checked = issubclass(kind, FolderResult)
    assert checked == (both.verb not in ("new", "board", "export", "simulate"))
    if checked:
        assert {*both.result.file_list} <= {*kind.own_files}
        assert kind.check_folder(both.folder)
    elif both.verb in ("board", "export"):
        assert not hasattr(kind, "check_folder")


def test_a_result_opens_its_page(both, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    place = both.result.show()
    assert place.exists()
    assert opened == [place.as_uri()]


# ------------------------------------------------------------------ defaults


FOR_OUTPUT = {"out", "as_json", "quiet", "force", "pictures", "no_browser", "port"}
"""Options of outputs, which are arguments of a result's ``save`` or ``show``."""
OTHERWISE = {"size": "camera", "folder": "folder"}
"""Options whose value becomes a part of an argument with another name."""


@pytest.mark.parametrize("verb", [*VERBS, "show", "view"])
def test_a_command_and_its_function_have_the_same_options_and_defaults(verb):
    command = command_named(verb)
    options = {one.name: one for one in command.params}
    values = command.make_context(verb, required_words(verb)).params
    function = inspect.signature(getattr(pkmcal, verb)).parameters
    arguments = {name: one.default for name, one in function.items()}
    if arguments.pop("settings", None):
        usual = {one.name: one.default for one in fields(Settings) if one.name in options}
        arguments = usual | arguments
    for name in options.keys() - arguments.keys() - FOR_OUTPUT:
        assert OTHERWISE[name] in arguments or verb == "new"
        if name == "size":
            usual = PLANNED_IMAGE_SIZE if verb == "plan" else default_camera().image_size
            assert "default: {}x{}".format(*usual) in options[name].help
    for name, option in options.items():
        if name not in arguments:
            continue
        usual = arguments.pop(name)
        if option.required:
            assert usual is inspect.Parameter.empty, name
        elif name == "hand_rotation":
            assert values[name] == pytest.approx(np.rad2deg(usual))
        elif verb == "reproduce" and name == "papers":
            assert set(option.type.choices) == set(usual)
        else:
            given = values[name]
            assert str(given) == str(usual) or not (given or usual), name
    assert set(arguments) <= {"progress"}
    assert "Parameters" in inspect.getdoc(getattr(pkmcal, verb))
    for name, argument in function.items():
        assert name in inspect.getdoc(getattr(pkmcal, verb))
        assert argument.annotation is not inspect.Parameter.empty


# ------------------------------------------------------------------ arguments and results in memory


@pytest.mark.parametrize("given", [None, 3, ["session"]], ids=repr)
@pytest.mark.parametrize(
    "call",
    [
        pkmcal.load_session, pkmcal.load_mechanism, pkmcal.load_camera, pkmcal.load_result,
        pkmcal.check, pkmcal.calibrate, pkmcal.show, pkmcal.view,
        lambda given: pkmcal.export(given, "json"), lambda given: pkmcal.diff(given, "3-rpr"),
        lambda given: pkmcal.validate(given, "session"), lambda given: pkmcal.watch(given, "s"),
        lambda given: pkmcal.servo(given),
    ],
)  # fmt: skip
def test_an_argument_of_another_type_is_refused(call, given):
    with raises(InputError, code="argument.not_a_path") as caught:
        call(given)
    assert type(given).__name__ in caught.value.found
    assert caught.value.expected


def test_a_result_in_memory_is_to_be_saved_where_a_folder_is_wanted(work):
    result = pkmcal.calibrate(work / "first")
    for call in (pkmcal.load_result, lambda it: pkmcal.export(it, "c"), pkmcal.show, pkmcal.view):
        with raises(InputError, code="argument.not_a_path") as caught:
            call(result)
        assert "CalibrationResult" in caught.value.found
        assert "save" in caught.value.next_step


def test_loaded_calibrations_and_machines_stand_for_their_files(work):
    saved, machine = pkmcal.load_result(work / "held"), pkmcal.load_mechanism("3-rpr")
    assert saved.findings == saved.verdict.findings
    loaded, there = pkmcal.export(saved, "json"), pkmcal.export(work / "held", "json")
    assert loaded.files == there.files
    assert pkmcal.show(saved).machine.name == saved.machine.name
    (in_memory,), (by_name,) = (pkmcal.study(it, runs=2).found for it in (machine, "3-rpr"))
    assert in_memory.position == by_name.position
    assert pkmcal.servo(machine, legs=3, runs=1, duration=1).plan.runs == 1


def test_arguments_of_other_shapes(work):
    with raises(InputError, where="start", expected="T_base_platform (4, 4), m"):
        pkmcal.servo("3-rpr", start=[0, 0, 0])
    with raises(InputError, code="images.none"):
        pkmcal.camera([])
    with raises(InputError, where="model", found="design"):
        pkmcal.calibrate(pkmcal.load_session(work / "first"), model="design")


def test_a_simulated_session_is_not_copied_into_itself(tmp_path):
    made = pkmcal.simulate(tmp_path / "s", "3-rpr", camera=(64, 48), stations=1, configurations=2)
    with raises(InputError, code="output.inside_session"):
        made.save(tmp_path / "s" / "copy")
    with raises(InputError, code="output.not_empty"):
        made.save(tmp_path)
    made.save(tmp_path / "copy")
    assert (tmp_path / "copy" / "truth.json").is_file()


def test_the_page_of_a_check_and_its_pictures_need_two_folders(demo, tmp_path):
    done = run("check", demo.session, "-o", tmp_path / "d", "--pictures", tmp_path / "d", "--json")
    assert (done.code, done.json["where"]) == (2, "--pictures")
