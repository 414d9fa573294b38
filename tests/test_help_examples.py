"""The examples in the commands' help, run as they stand in a folder with the files they name."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from conftest import run
from pkmcal.cameras.files import load_camera
from pkmcal.commands.cli import COMMANDS_IN_ORDER
from pkmcal.mechanisms import load_mechanism
from pkmcal.simulation import load_truth
from printers import calibrated_cfg
from rendered import by_command
from test_watch_command import imaged

pytestmark = pytest.mark.slow
SHORTER = {"study": ("--runs", "2"), "reproduce": ("--runs", "3"), "servo": ("--runs", "2")}
"""Options added to the examples of commands that simulate many runs: the last value counts."""
JUDGES = {"diff", "reproduce", "servo", "validate", "watch"}
"""Commands that end with 1 where they find fault with the machine or, with few runs, the method."""
MADE = {"new": "my-machine", "camera": "camera"}
"""Folder that the examples of a command make, and that must not be there before."""
ON_PLATFORM = ("--on-platform", "--stations", "2", "--configurations", "10", "--size", "640x480")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Folder with a session whose cameras observe legs and a board, and what else examples name."""
    folder = tmp_path_factory.mktemp("examples")
    mine = with_front(by_command(folder / "my-machine", *ON_PLATFORM))
    assert run("calibrate", mine, "-o", folder / "out").code == 0
    for copy in (folder / "last-year", mine / "calibration"):
        shutil.copytree(folder / "out", copy)
    assert run("camera", mine, "-o", folder / "camera").code == 0
    assert run("plan", mine, "-o", folder / "plan", "-n", "3").code == 0
    (folder / "cameras").mkdir()
    (file,) = (mine / "cameras").iterdir()
    shutil.copy(file, folder / "cameras" / "front.yaml")
    shutil.copy(mine / "board.yaml", folder)
    for name in ("boards", "mirror"):
        shutil.copytree(mine / "images", folder / name)
        images = sorted((folder / name).rglob("*.png"))
        for image in images:
            image.rename(folder / name / f"{image.parent.name}-{image.name}")
        shutil.copy(mine / "board.yaml", folder / name)
    nominal = load_mechanism(mine / "mechanism.yaml")
    true, camera = load_truth(mine, nominal).machine, load_camera(file)
    with_front(imaged(folder / "today", nominal, true, camera, 34, configurations=6))
    shutil.copytree(folder / "today", folder / "new-images")
    (folder / "printer.cfg").write_text(calibrated_cfg(), encoding="utf-8")
    return folder


def with_front(session: Path) -> Path:
    """The session with its first station named as in the examples."""
    (session / "images" / "station1").rename(session / "images" / "front")
    for name in ("session.yaml", "truth.json"):
        if (session / name).exists():
            text = (session / name).read_text(encoding="utf-8")
            (session / name).write_text(text.replace("station1", "front"), encoding="utf-8")
    return session


@pytest.mark.parametrize("command", COMMANDS_IN_ORDER)
def test_the_examples_of_the_help_run(command, place, tmp_path, monkeypatch):
    monkeypatch.setenv("BROWSER", "true")  # a browser that shows nothing
    lines = run(command, "--help").out.split("Examples:\n")[1].split("\n\n")[0].splitlines()
    for k, line in enumerate(lines):
        words = [*shlex.split(line)[1:], *SHORTER.get(command, ())]
        work = shutil.copytree(place, tmp_path / str(k))
        if command in MADE:
            shutil.rmtree(work / MADE[command])
        monkeypatch.chdir(work)
        if command == "view" or (command == "show" and "-o" not in words):
            serve(words)
        else:
            done = run(*words)
            assert done.code in ((0, 1) if command in JUDGES else (0,)), (line, done.err)


def serve(words: list[str]) -> None:
    """Start a command that serves a page, and end it once the page was sent."""
    words = [one for n, one in enumerate(words) if "--port" not in (one, words[n - 1])]
    with subprocess.Popen(
        [sys.executable, "-m", "pkmcal", *words, "--json"],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "BROWSER": "true"},
    ) as served:  # fmt: skip
        assert served.stdout is not None
        url = json.loads(served.stdout.readline())["url"]
        with urllib.request.urlopen(url, timeout=60) as answer:
            assert answer.status == 200
        served.send_signal(signal.SIGINT)
        assert served.wait(60) == 0
