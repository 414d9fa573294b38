"""The commands as a person types them, and what they promise to programs."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import pkmcal
from conftest import run
from document_keys import assert_keys
from faults import raises
from pkmcal.api.calibrate import CalibrationResult
from pkmcal.api.check import CheckResult
from pkmcal.boards.board import load_board
from pkmcal.calibration.saved_calibration import load
from pkmcal.cameras import load_camera
from pkmcal.commands import cli, console
from pkmcal.commands.cli import main
from pkmcal.commands.finish import answer, finish
from pkmcal.errors import InputError
from pkmcal.files import json_text, read_csv
from pkmcal.geometry.rigid import inverse
from pkmcal.identify.verdict import assess
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.outcome.finding import Finding, Level
from pkmcal.session.load import load_session
from pkmcal.simulation import load_truth
from pkmcal.starter import TO_FILL, session_texts, untouched_files
from pkmcal.studies.varied import DESIGN_NAMES_VARIED, PAPER_NAMES_VARIED
from test_pose_sessions import make
from test_report_page import PageParts

COMMANDS = (
    *("demo", "new", "show", "check", "view", "board", "camera", "plan", "calibrate", "validate"),
    *("servo", "export", "watch", "diff", "simulate", "study", "reproduce"),
)


def python(*words, **options):
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


# the entry point


def test_the_installed_command_is_main():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    place = project["scripts"]["pkmcal"]
    assert EntryPoint("pkmcal", place, "console_scripts").load() is main


def test_as_a_module():
    for option in ("--version", "-V"):
        done = python("-m", "pkmcal", option)
        assert (done.returncode, done.stdout) == (0, f"pkmcal {pkmcal.__version__}\n")


def test_help_imports_nothing_heavy():
    """Of the libraries, the help of the program and of every command needs click alone."""
    heavy = ("numpy", "scipy", "cv2", "pydantic", "yaml", "ruamel", "rich", "pkmcal.api")
    code = f"""
import sys
from pkmcal.commands import cli
for words in ([], *([name] for name in cli.COMMANDS_IN_ORDER)):
    assert cli.main([*words, "--help"]) == 0
    print(words, [m for m in {heavy} if m in sys.modules], file=sys.stderr)
"""
    lines = python("-c", code).stderr.splitlines()
    assert lines == [f"{words} []" for words in ([], *([name] for name in COMMANDS))]


def test_the_first_bar_is_drawn_before_anything_heavy_is_imported():
    """Each command ends at the first character that it writes to a terminal."""
    cases = [
        ["demo"], ["check", "none"], ["board"], ["camera", "none"], ["plan", "none"],
        ["calibrate", "none"], ["validate", "none", "none"], ["servo", "none"],
        ["export", "none", "--to", "c"], ["watch", "none", "none"], ["diff", "none", "none"],
        ["simulate", "none"], ["study", "none"], ["reproduce"],
    ]  # fmt: skip
    heavy = ("numpy", "scipy", "cv2", "yaml", "pkmcal.api", "pkmcal.files", "pkmcal.session")
    code = f"""
import sys
from pkmcal.commands import cli

class Drawn(BaseException):
    pass

class Terminal:
    encoding = "utf-8"
    def isatty(self):
        return True
    def flush(self):
        pass
    def write(self, text):
        raise Drawn

sys.stderr = Terminal()
for words in {cases}:
    try:
        cli.main(words)
    except Drawn:
        print(words[0], "rich.progress" in sys.modules, [m for m in {heavy} if m in sys.modules])
"""
    done = python("-c", code, env={**os.environ, "TERM": "xterm"})
    assert done.stdout.splitlines() == [f"{words[0]} True []" for words in cases]
    assert {words[0] for words in cases} == {*COMMANDS} - {"new", "show", "view"}


def test_a_command_loads_no_other():
    script = "cli.main(['calibrate', '--help'])"
    report = (
        "print([m[16:] for m in sys.modules if m[16:] in cli.COMMANDS_IN_ORDER], file=sys.stderr)"
    )
    code = f"import sys; from pkmcal.commands import cli; {script}; {report}"
    assert python("-c", code).stderr == "['calibrate']\n"


def test_no_arguments_show_the_help():
    done = run()
    assert done == run("--help")
    assert done.code == 0
    assert all(f"\n  {command} " in done.out for command in COMMANDS)
    assert "..." not in done.out.partition("Commands:")[2]  # no description is cut off


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_and_json(command, monkeypatch):
    done = run(command, "--help")
    assert done.code == 0
    assert "--json" in done.out
    assert max(map(len, done.out.splitlines())) <= 80
    monkeypatch.setenv("COLUMNS", "200")
    widest = max(map(len, run(command, "--help").out.splitlines()))
    assert widest <= 120
    assert widest > 80 or command in ("board", "demo", "reproduce")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_has_three_examples_that_parse(command):
    examples = run(command, "--help").out.split("Examples:\n")[1].split("\n\n")[0].splitlines()
    assert len(examples) == 3
    for line in examples:
        program, name, *words = shlex.split(line)
        assert (program, name) == ("pkmcal", command)
        assert cli.command_named(command).make_context(command, words).params


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["servo", "h4", "--hand-rotation", "90 arcmin"], "hand_rotation", 1.5),
        (["servo", "h4", "--hand-rotation", "2"], "hand_rotation", 2.0),
        (["servo", "h4", "--hand-position", "12.5 mm"], "hand_position", 0.0125),
        (["servo", "h4", "--duration", "500 ms"], "duration", 0.5),
        (["servo", "h4", "--rate", "0.05 kHz"], "rate", 50.0),
        (["servo", "h4", "--noise", "0.5 px"], "noise", 0.5),
        (["plan", "h4", "--edge-noise", "2 pixels"], "edge_noise", 2.0),
        (["simulate", "s", "--warming", "9 degF"], "warming", 5.0),
        (["watch", "a", "b", "--alpha", "1 %"], "alpha", 0.01),
        (["new", "s", "--arm-angle", "-180 deg"], "arm_angle", -np.pi),
    ],
)
def test_numbers_of_options_take_units_as_in_files(words, name, value):
    command, *rest = words
    params = cli.command_named(command).make_context(command, rest).params
    assert params[name] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("words", "where", "found", "expected"),
    [
        (["servo", "h4", "--hand-rotation", "4 rad"], "--hand-rotation", "4 rad", "3.14159 rad"),
        (["servo", "h4", "--hand-position=-2 mm"], "--hand-position", "-2 mm", "0 to 100000 mm"),
        (["servo", "h4", "--duration", ""], "--duration", "nothing", "over 0 to 3600 s"),
        (["plan", "h4", "--edge-noise", "0.5 mm"], "--edge-noise", "0.5 mm", "over 0 to 100 px"),
        (["plan", "h4", "-n", "4.5"], "--configurations", "4.5", "a whole number, 2 to 200"),
        (["new", "s", "--base-radius", "3 px"], "--base-radius", "3 px", "over 0 to 50 m"),
        (["new", "s", "--base-radius", "300"], "--base-radius", "300", "over 0 to 50 m"),
        (["new", "s", "--arm-angle", "200 deg"], "--arm-angle", "200 deg", "-180 to 180 deg"),
        (["watch", "a", "b", "--alpha", "30 %"], "--alpha", "30 %", "0.0001 to 20 %"),
        (["plan", "3-rpr", "--joint-noise", "2 m"], "--joint-noise", "2 m", "over 0 to 1 m"),
        (["plan", "3-rpr", "--tracker", "20 m"], "--tracker", "20 m", "over 0 to 1"),
        (["study", "3-rpr", "--vary", "elevation=90 deg"], "--vary", "90 deg", "-85 to 85 deg"),
    ],
)  # fmt: skip
def test_a_number_is_refused_in_the_unit_in_which_it_is_given(words, where, found, expected):
    done = run(*words, "--json")
    assert (done.code, done.json["where"], done.json["found"]) == (2, where, found)
    assert expected in done.json["expected"]


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (["plan", "3-rpr", "--joint-noise", "2 deg"], "2 deg"),
        (["servo", "gough-stewart", "--joint-noise", "2 deg"], "2 deg"),
        (["servo", "gough-stewart", "--speed", "100 rpm"], "100 rpm"),
        (["simulate", "s", "--joint-noise", "2 deg"], "2 deg"),
        (["study", "h4", "--vary", "play=1 um"], "1 um"),
    ],
)
def test_a_number_of_joints_has_a_unit_of_the_machines_joints(words, value, tmp_path, monkeypatch):
    """As in session.yaml: a leg's length has no noise in degrees, a motor's angle none in µm."""
    monkeypatch.chdir(tmp_path)
    done = run(*words, "--json")
    assert (done.code, done.json["found"]) == (2, value)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("option", "text"),
    [("--hand-rotation", "1 mm"), ("--hand-position", "1 deg"), ("--joint-noise", "1 kg"),
     ("--start", "1 deg,0,0,0,0,0"), ("--goal", "0,0,0.3")],
)  # fmt: skip
def test_a_unit_of_another_kind_is_refused(option, text, tmp_path):
    done = run("servo", "3-rpr", option, text, "-o", tmp_path / "out", "--json")
    assert done.code == 2
    assert (done.json["where"], done.json["found"]) == (option, text)


def test_the_help_of_a_study_names_what_can_be_varied():
    text = run("study", "--help").out
    assert {*DESIGN_NAMES_VARIED, *PAPER_NAMES_VARIED} <= set(re.findall(r"^  (\w+) ", text, re.M))


def test_the_documentation_covers_all_commands_and_options():
    text = (Path(__file__).parents[1] / "docs" / "commands.md").read_text()
    options = {
        option
        for command in ("", *COMMANDS)
        for option in re.findall(r"--[a-z-]+", run(*command.split(), "--help").out)
    }
    documented = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))
    assert documented <= options
    assert options - {"--out", "--version"} <= documented
    assert re.findall(r"^## pkmcal (\w+)", text, re.MULTILINE) == list(COMMANDS)


TELLS = """
import sys
from pkmcal import terminal
from pkmcal.commands import cli, console

@cli.app.command("tell")
def tell() -> int:
    for _ in range(3_000):
        terminal.out().print("some thing that was found")
    console.print_json({"verdict": "not to be used"})
    return 1

sys.exit(cli.main(["tell"]))
"""
"""A command with more output than a pipe holds, for a result that should not be used."""


@pytest.mark.parametrize("unbuffered", ["", pytest.param("1", marks=pytest.mark.slow)])
def test_a_reader_that_leaves_changes_nothing(unbuffered, monkeypatch):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    for merged in (subprocess.PIPE, subprocess.STDOUT):
        with subprocess.Popen(
            [sys.executable, "-c", TELLS], stdout=subprocess.PIPE, stderr=merged, text=True
        ) as values:
            assert values.stdout.readline() == "some thing that was found\n"
            values.stdout.close()
            if values.stderr:
                assert values.stderr.read() == ""
        assert values.returncode == 1  # the command's own


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device here that is always full")
@pytest.mark.parametrize(
    ("words", "end", "reason"),
    [
        (["--help"], ">/dev/full", "No space left"),
        (["new", "NEW"], ">/dev/full", "No space left"),
        (["new", "NEW", "--json"], ">&-", "Bad file"),
    ],
)
def test_an_answer_that_cannot_be_given_is_reported_once(words, end, reason, tmp_path):
    words = [str(tmp_path / "new") if word == "NEW" else word for word in words]
    done = shell(words, end)
    assert done.returncode == 2
    assert done.stderr.startswith(f"Error: standard output cannot be written ({reason}")
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device here that is always full")
@pytest.mark.parametrize(("end", "words"), [(">/dev/full", ["--json"]), (">&-", [])])
def test_a_mistake_is_reported_where_an_answer_cannot_be_given(end, words):
    done = shell(["board", "nowhere", *words], end)
    assert done.returncode == 2
    assert done.stderr == "Error: nowhere: the file does not exist; expected a file nowhere.\n"


@pytest.mark.skipif(os.name == "nt", reason="closing by the shell's own words")
def test_nobody_needs_to_hear_of_a_mistake():
    assert shell(["board", "nowhere"], "<&- >&- 2>&-").returncode == 2


def shell(words, end):
    """One command as a shell runs it, with redirected streams."""
    line = shlex.join([sys.executable, "-m", "pkmcal", *words]) + " " + end
    return subprocess.run(line, shell=True, capture_output=True, text=True, check=False)


# demo


def test_demo(demo):
    result = demo.run.json
    assert demo.run.code == result["exit_code"] == 0
    assert demo.run.err == ""
    assert_keys("demo --json", result)
    before, after = result["comparison"]["drawing"], result["comparison"]["calibrated"]
    assert after["centre"] < before["centre"] / 3
    assert after["position"] < before["position"] / 2
    assert after["orientation"] < before["orientation"] / 2
    # 44 values, correlated: 95 % expected within two deviations, 80 % is far off
    assert result["comparison"]["within"] > 0.8 * result["comparison"]["count"]
    assert load(demo.calibration).verdict.usable


def test_demo_in_words(demo, tmp_path, monkeypatch, calibrated):
    monkeypatch.setattr(
        "pkmcal.api.simulate.simulate_session",
        lambda folder, machine, *_, **_more: load_truth(folder, machine),
    )
    monkeypatch.setattr("pkmcal.api.calibrate.calibrate_session", lambda *_, **_more: calibrated)
    monkeypatch.setattr("pkmcal.commands.demo.DEMO_SESSION_NAME", str(demo.session))
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr("pkmcal.commands.console.can_show", lambda: True)
    done = run("demo", "-o", tmp_path / "out")
    assert done.code == 0
    assert "times nearer" in done.out
    assert "within two of their standard deviations" in " ".join(done.out.split())
    assert opened == [(tmp_path / "out" / "calibration" / "report.html").as_uri()]
    assert run("demo", "-o", tmp_path / "other", "--no-open").code == 0
    assert len(opened) == 1


@pytest.mark.parametrize(
    ("variables", "opens"),
    [({"DISPLAY": ":0"}, True), ({"DISPLAY": ":0", "CI": "1"}, False), ({}, False)],
)
def test_a_browser_opens_for_people_only(variables, opens, monkeypatch):
    from pkmcal.commands.console import can_show

    for name in ("CI", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert can_show() is opens


def test_demo_replaces_only_a_demo(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    done = run("demo", "-o", tmp_path, "--fast", "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")
    assert done.json["found"] == "thesis.tex"
    assert (tmp_path / "thesis.tex").exists()


def test_an_earlier_demo_is_removed(tmp_path):
    from pkmcal.commands.demo import _make_room

    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "truth.json").touch()
    (tmp_path / "calibration").mkdir()
    _make_room(tmp_path)
    assert list(tmp_path.iterdir()) == []


# new


def test_new_then_check_states_what_is_missing(tmp_path):
    done = run("new", tmp_path / "mine")
    assert done.code == 0
    assert all(name in done.out for name in session_texts())
    assert "pkmcal check" in done.out
    value = run("check", tmp_path / "mine")
    text = " ".join(value.out.split())
    assert value.code == 2
    assert "there is no image under this pattern; found only README.txt in" in text
    for name, what in ((n, w) for n, w in TO_FILL.items() if n in session_texts()):
        assert f"{name} is still the example of pkmcal new: {what}" in text


def test_new_files_load(tmp_path):
    folder = tmp_path / "mine"
    done = run("new", folder, "--json")
    assert sorted(done.json["files"]) == sorted(session_texts())
    machine = load_mechanism(folder / "mechanism.yaml")
    assert machine.n_legs == 6
    assert load_camera(folder / "cameras" / "front.yaml").image_size == (1024, 768)
    readings = read_csv(folder / "joints.csv")
    assert machine.forward_result(readings.values).converged.all()
    for name in ("session.yaml", "mechanism.yaml", "cameras/front.yaml"):
        assert (folder / name).read_text().startswith("# ")


@pytest.mark.parametrize("options", [(), ("--machine", "3-rps", "--places", 2)])
def test_a_new_session_has_no_pose_of_its_camera(tmp_path, options):
    """The pose is optional; a rough one takes one uncommented line."""
    folder = tmp_path / "mine"
    assert run("new", folder, *options).code == 0
    stations = load_session(folder, measured=False).stations
    assert {station.T_camera_base is None for station in stations} == {True}
    text = (folder / "session.yaml").read_text()
    assert text.count("    # pose: {") == 1
    (folder / "session.yaml").write_text(text.replace("    # pose: {", "    pose: {"))
    front = load_session(folder, measured=False).stations[0]
    assert np.allclose(inverse(front.T_camera_base)[:3, 3], [0, -0.85, 0.2])


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_a_new_session_of_any_machine_lacks_its_images_alone(name, tmp_path):
    done = run("new", tmp_path / "mine", "--machine", name, "--json")
    assert done.code == 0
    drawn, folder = load_mechanism(name), tmp_path / "mine"
    assert load_mechanism(folder / "mechanism.yaml").parameters.names == drawn.parameters.names
    readings = read_csv(folder / "joints.csv").values
    assert drawn.forward_result(readings).converged.all()
    assert np.ptp(readings, axis=0).max() > 0
    text = (folder / "session.yaml").read_text()
    if drawn.redundancy:
        assert "\nstations:" not in text
        session = load_session(folder)
    else:
        in_view = "legs" if drawn.document.legs[0].tubes else "board"
        assert f"observe: {in_view}\n" in text
        with raises(InputError, expected="files images/front/{configuration}.png") as caught:
            load_session(folder)
        assert caught.value.where.endswith("stations.front.images")
        session = load_session(folder, measured=False)
        assert (session.board is None) == (in_view == "legs")
    assert session.machine.n_joints == drawn.n_joints
    untouched = " ".join(one.text for one in untouched_files(folder))
    assert all(f"{what}" in untouched for what in TO_FILL if (folder / what).exists())


def test_a_new_session_with_a_board_and_places(tmp_path):
    folder = tmp_path / "mine"
    options = ("--board", "--legs", "--places", "5", "--machine", "gough-stewart")
    assert run("new", folder, *options).code == 0
    session = load_session(folder, measured=False)
    assert [s.name for s in session.stations] == ["front", "left", "right", "back", "place5"]
    assert {s.observe for s in session.stations} == {("legs", "board")}
    assert load_board(session.board).tolerance == 0.001
    assert "board.yaml is still the example" in " ".join(
        one.text for one in untouched_files(folder)
    )
    refused = run("new", tmp_path / "delta", "--machine", "delta", "--legs", "--json")
    assert (refused.code, refused.json["code"]) == (2, "session.no_tubes")
    assert not (tmp_path / "delta").exists()


def test_new_asks_on_a_terminal(tmp_path, monkeypatch):
    answers = iter(["gough-stewart", "both", "3", "linear-delta", "1"])
    monkeypatch.setattr("pkmcal.commands.new.on_terminal", lambda: True)
    monkeypatch.setattr("rich.prompt.PromptBase.get_input", lambda *_a, **_k: next(answers))
    assert run("new", tmp_path / "mine").code == 0
    assert len(load_session(tmp_path / "mine", measured=False).stations) == 3
    assert run("new", tmp_path / "delta").code == 0
    assert (tmp_path / "delta" / "board.yaml").exists()


def test_new_in_a_folder_that_is_not_empty(demo):
    done = run("new", demo.session, "--json")
    assert (done.code, done.json["code"]) == (2, "output.not_empty")


# check


def test_check_of_a_good_session(demo, checked):
    result = CheckResult.of(checked.result)
    assert result.exit_code == 0
    lines = result.summary().splitlines()
    assert "Nothing is wrong. Next: pkmcal calibrate" in result.summary()
    rows = [line for line in lines if line[1:].startswith("  station")]
    assert len(rows) == 3
    assert all(row.startswith("✓") for row in rows)
    assert max(map(len, lines)) <= 80 + len(str(demo.session))
    assert "Wander" not in result.summary()  # of a board, where there is none


def test_check_here_is_called_by_the_folders_name(session, monkeypatch, tmp_path):
    monkeypatch.chdir(session)
    (session / "joints.csv").unlink()  # refused at once
    assert run("check", ".", "-o", tmp_path / "c").code == 2
    title = PageParts((tmp_path / "c" / "check.html").read_text()).text
    assert f"Check of {session.name}" in title
    assert "Check of ." not in title


def test_check_as_json(checked):
    count = json.loads(json_text(CheckResult.of(checked.result).document))
    assert count["exit_code"] == 0
    assert_keys("check --json", count)
    names = [station["name"] for station in count["stations"]]
    assert names == ["station1", "station2", "station3"]
    assert all(station["recognised"] for station in count["stations"])
    assert len(count["joints"]) == 6


def test_check_reports_errors_as_every_command_does(session, tmp_path):
    shape = {"error", "exit_code", "message", "what", "where", "found", "expected", "next_step"}
    nowhere = run("check", tmp_path / "none", "--json").json
    assert run("calibrate", tmp_path / "none", "--json").json.items() <= nowhere.items()
    image = min((session / "images" / "station1").iterdir())
    image.write_bytes(image.read_bytes()[:1000])
    actual_names = run("check", session, "--json").json
    assert shape <= set(actual_names)
    assert actual_names["exit_code"] == 2
    assert actual_names["what"] == "the image cannot be decoded"
    broken, *others = actual_names["findings"]
    assert broken.items() >= {key: actual_names[key] for key in shape - {"exit_code"}}.items()
    assert broken["station"] == "station1"
    assert all(set(finding) == {"level", "text", "station"} for finding in others)


# calibrate


def test_calibrate(session, demo):
    assert not (session / "truth.json").exists()
    done = run("calibrate", session)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("✓ Tool error ")
    assert "How well is the platform's pose known?" in done.out
    folder = session / "calibration"
    assert {path.name for path in folder.iterdir()} == {
        "mechanism.yaml",
        "calibration.json",
        "report.html",
    }
    machine = load_mechanism(folder / "mechanism.yaml")
    assert np.array_equal(machine.values, load(folder).machine.values)
    # the same seed, and the demonstration did not need the truth
    assert np.array_equal(machine.values, load(demo.calibration).machine.values)


def test_calibrate_again_keeps_the_result(demo, calibrated, tmp_path, monkeypatch, capsys):
    def finished(seed, folder, **options):
        """Exit code and text of the command with a result of this seed."""
        result = CalibrationResult.of(replace(calibrated, seed=seed, images={}))
        with console.progress(quiet=True) as progress:
            code = finish(result, folder, progress, **options)
        return code, capsys.readouterr().out

    out = shutil.copytree(demo.calibration, tmp_path / "result")
    assert load(out).seed == 0
    assert finished(5, out, quiet=True) == (0, "")
    assert load(out).seed == 5
    (retained,) = tmp_path.glob("result-*")
    assert load(retained).seed == 0
    # the same again: nothing is kept, and no note
    assert "kept" not in json.loads(finished(5, out, as_json=True)[1])
    assert len(list(tmp_path.glob("result-*"))) == 1
    value = json.loads(finished(0, out, as_json=True)[1])
    assert load(value["kept"]).seed == 5
    before = set(tmp_path.iterdir())
    assert finished(6, out, force=True, quiet=True) == (0, "")
    assert set(tmp_path.iterdir()) == before
    monkeypatch.chdir(tmp_path)
    _, text = finished(0, Path("result"))
    assert re.search(r"^  result-\S+ +the earlier result, kept$", text, re.MULTILINE)


def test_calibrate_as_json_in_a_process_of_its_own(tmp_path):
    """Poses from a tracker, which takes a second; images are tested above."""
    session, out = make(tmp_path / "session", "gough-stewart").folder, tmp_path / "result"
    done = python("-m", "pkmcal", "calibrate", session, "-o", out, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    result = json.loads(done.stdout)
    assert result["verdict"]["usable"] is True
    assert result["files"]["report.html"] == str(out / "report.html")
    assert 0 < result["figures"]["joint_centre_sigma"] < 1e-3


@pytest.mark.slow
def test_the_four_steps_on_four_configurations_a_station(session):
    """Barely enough for the methods: marked as comparison, or refused with [A]'s own condition."""
    done = run("calibrate", session, "--method", "four-step", "--json")
    assert done.code == 1
    if (session / "calibration").exists():
        assert load(session / "calibration").method == "four-step"
        assert "four-step method leaves" in " ".join(done.json["verdict"]["reasons"])
    else:
        assert re.search(r"leg \d of 6 is seen by no station well enough", done.json["what"])
        assert "[A] 3.3" in done.json["expected"]


def test_an_unusable_result_is_reported_and_written(calibrated, tmp_path, capsys):
    value, folder = calibrated, tmp_path / "calibration"
    others = (Finding("machine.other", Level.WRONG, saved_text="Somebody ran into the machine."),)
    verdict = assess(value.observation, value.estimate, value.identification, others=others)
    result = CalibrationResult.of(replace(value, verdict=verdict, images={}))
    with console.progress(quiet=True) as progress:
        assert finish(result, folder, progress) == 1
    display = capsys.readouterr().out
    assert "This calibration should not be used" in display
    assert "Written all the same" in display
    assert not load(folder).verdict.usable
    assert "# NOT TO BE USED: " in (folder / "mechanism.yaml").read_text()
    assert answer(result, folder, quiet=True) == 1
    quiet = capsys.readouterr()
    assert quiet.out == ""
    assert quiet.err.startswith("Error: This calibration should not be used")


def test_an_output_folder_with_other_things_is_left_alone(session):
    nominal = (session / "mechanism.yaml").read_bytes()
    done = run("calibrate", session, "-o", session, "--json")
    assert (done.code, done.json["code"]) == (2, "output.foreign_files")
    assert (session / "mechanism.yaml").read_bytes() == nominal


# simulate


def small(folder, *more):
    words = ("--stations", 1, "--configurations", 2, "--size", "128x96", *more)
    return run("simulate", folder, *words)


def test_simulate(tmp_path):
    done = small(tmp_path / "a", "--json")
    assert done.json["photographs"] == 2
    assert "pkmcal calibrate" in small(tmp_path / "b").out
    small(tmp_path / "c", "--seed", 1)
    texts = [(tmp_path / name / "truth.json").read_text() for name in "abc"]
    assert texts[0] == texts[1] != texts[2]
    session = pkmcal.load_session(tmp_path / "a")
    assert session.stations[0].camera.image_size == (128, 96)


def test_simulate_a_machine_and_a_camera_of_ones_own(tmp_path, demo):
    words = ("--machine", demo.session / "mechanism.yaml", "--stations", 1)
    camera = demo.session / "cameras" / "camera.yaml"
    done = run("simulate", tmp_path / "s", *words, "--configurations", 2, "--camera", camera)
    assert done.code == 0
    assert (tmp_path / "s" / "cameras" / "camera.yaml").read_bytes() == camera.read_bytes()


@pytest.mark.parametrize(
    ("option", "value", "facts"),
    [
        ("--size", "3x4", {"where": "--size", "found": "3x4"}),
        ("--size", "large", {"where": "--size", "found": "large"}),
        ("--joint-noise", "0", {"where": "--joint-noise", "found": "0"}),
        ("--joint-noise", "nan", {"where": "--joint-noise", "found": "nan"}),
        ("--machine", "gough-stuart", {"found": "gough-stuart", "expected": "gough-stewart"}),
        ("--machine", "mine.yaml", {"code": "file.missing", "where": "mine.yaml"}),
        ("--camera", "eye.yaml", {"code": "file.missing", "where": "eye.yaml"}),
        ("--stations", "0", {"where": "--stations", "found": "0"}),
    ],
)
def test_simulate_refuses(tmp_path, option, value, facts):
    done = run("simulate", tmp_path / "s", option, value, "--json")
    assert done.code == 2
    assert {name: done.json[name] for name in facts} == facts
    assert not (tmp_path / "s").exists()


# what goes wrong


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["chek"], "No such command 'chek', did you mean check. See pkmcal --help."),
        (["chek", "--json"], "No such command 'chek', did you mean check. See pkmcal --help."),
        (["view-from-above"], "No such command 'view-from-above'. See pkmcal --help."),
        (["check"], "Missing argument 'SESSION'. See pkmcal check --help."),
        (["check", "a", "b"], "unexpected extra argument"),
        (["calibrate", "s", "--sed", "1"], "No such option: --sed, did you mean --seed. See"),
        (["calibrate", "s", "--foo"], "No such option: --foo. See pkmcal calibrate --help."),
        (["calibrate", "s", "-x"], "No such option: -x. See pkmcal calibrate --help."),
        (["calibrate", "s", "--seed", "many"], "--seed: this number cannot be used; found many"),
        (["calibrate", "s", "--seed", "-1"], "--seed: this number cannot be used; found -1"),
        (["calibrate", "s", "--method", "best"], "'bundle', 'four-step', 'linear'"),
        (["calibrate", "s", "--method", "bundel"], "'inverse-kinematic', did you mean bundle. See"),
        (["reproduce", "d"], "'d' is not one of 'a', 'b', 'c'. See pkmcal reproduce --help."),
    ],
)
def test_usage_errors(words, message):
    done = run(*[word for word in words if word != "--json"])
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert done.err.startswith("Error: ")
    assert not re.search("Value error|Input should|Possible options", done.err)
    values = run(*words, "--json").json
    assert values["exit_code"] == 2
    assert done.err == f"Error: {values['message']}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["servo", "gough"], "expected gough-stewart."),
        (["study", "stewart"], "expected gough-stewart."),
        (["simulate", "DIR/new", "--machine", "four"], "expected four-belt."),
        (["calibrate", "DIR/sesion"], "There is DIR/session."),
        (["calibrate", "DIR/nothing-like-it"], "there is no such session folder.\n"),
    ],
)
def test_what_was_meant_is_stated_where_it_is_likely(words, message, tmp_path):
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "session.yaml").touch()
    (tmp_path / "letters").mkdir()  # like it, but no session
    there = [word.replace("DIR", str(tmp_path)) for word in words]
    done = run(*there)
    assert done.code == 2
    assert message.replace("DIR", str(tmp_path)) in done.err


def test_completion_knows_commands_and_options():
    words = {"COMP_WORDS": "pkmcal cal", "COMP_CWORD": "1", "_PKMCAL_COMPLETE": "bash_complete"}
    assert python("-m", "pkmcal", env=os.environ | words).stdout.split() == ["plain,calibrate"]
    words |= {"COMP_WORDS": "pkmcal calibrate --hold", "COMP_CWORD": "2"}
    assert python("-m", "pkmcal", env=os.environ | words).stdout.split() == ["plain,--holdout"]
    for shell in cli.SHELLS:
        done = run("--completion", shell)
        assert (done.code, f"_PKMCAL_COMPLETE={shell}_complete" in done.out) == (0, True)


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (MemoryError(), 2, "there is not enough memory. Close other programs"),
        (OSError(errno.ENOSPC, "No space left on device", "x.png"), 2,
         "x.png: the operating system refused: no space left on device. Free space"),
        (PermissionError(errno.EACCES, "Permission denied", "s"), 2, "s: the operating system"),
        (KeyboardInterrupt(), 130, "interrupted; what was not finished was not written"),
        (ZeroDivisionError("by zero"), 70,
         "this is a defect of pkmcal, not of your session: ZeroDivisionError: by zero."
         " Set PKMCAL_DEBUG=1, run the command again, and report what it then prints."),
    ],
)  # fmt: skip
def test_no_traceback_whatever_happens(error, code, message, tmp_path, monkeypatch):
    def fail(*_words):
        raise error

    monkeypatch.setattr("pkmcal.api.new.session_texts", fail)
    monkeypatch.delenv("PKMCAL_DEBUG", raising=False)
    done = run("new", tmp_path)
    assert (done.code, done.out) == (code, "")
    assert message in done.err
    assert "Traceback" not in done.err
    assert run("new", tmp_path, "--json").json["exit_code"] == code
    monkeypatch.setenv("PKMCAL_DEBUG", "1")
    if code == 70:
        assert "Traceback" in run("new", tmp_path).err


def test_errors_as_json(tmp_path):
    done = run("calibrate", tmp_path / "none", "--json")
    assert (done.code, done.err) == (2, "")
    assert done.json["what"] == "there is no such session folder"
    assert done.json["where"] == str(tmp_path / "none")
    assert done.json["message"].endswith("there is no such session folder.")


def test_an_error_on_a_terminal_is_wrapped(monkeypatch, capsys):
    from pkmcal.commands.console import print_error

    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "40")
    print_error("joints.csv, line 4: a sentence that is longer than forty columns are wide.")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 1
    assert "\x1b[1;31mError:" in lines[0]
    assert all(line.startswith("       ") for line in lines[1:])
