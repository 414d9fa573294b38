"""Progress messages of commands without a terminal."""

import re
import sys
import threading
import time
from contextlib import redirect_stderr

from conftest import run
from pkmcal.commands import console


class Heard:
    """A stream that is no terminal, and records the times of writing."""

    encoding = "utf-8"

    def __init__(self):
        self.text, self.written = "", threading.Event()

    def write(self, text):
        self.text += text
        self.written.set()
        return len(text)

    def flush(self):
        pass

    def isatty(self):
        return False


def test_a_long_step_is_reported_in_plain_lines(monkeypatch, capsys):
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    with redirect_stderr(Heard()) as heard, console.progress() as progress:
        progress("Finding the legs: 3 of 9 images", 0.35)
        assert heard.written.wait(60)
    line = r"Finding the legs: 3 of 9 images \(35%, \d+ s\)"
    assert all(re.fullmatch(line, x) for x in heard.text.splitlines())
    assert capsys.readouterr().out == ""


def test_nobody_speaks_where_nothing_is_wanted(monkeypatch):
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    count = threading.active_count()
    with redirect_stderr(Heard()) as heard, console.progress(quiet=True) as progress:
        progress("Finding the legs", 0.35)
        assert threading.active_count() == count
    assert heard.text == ""


def test_a_short_run_prints_nothing():
    with redirect_stderr(Heard()) as heard, console.progress() as progress:
        progress("Finding the legs", 0.35)
    assert heard.text == ""


def test_nothing_is_printed_before_there_is_a_message(monkeypatch):
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    with redirect_stderr(Heard()) as heard, console.progress():
        assert not heard.written.wait(0.2)


def test_a_calibration_reports_its_steps(demo, calibrating, tmp_path, monkeypatch):
    def again(*_, progress, **_more):
        for text, share in dict(calibrating.steps).items():
            progress(text, share)
            deadline = time.monotonic() + 60
            while text not in sys.stderr.getvalue() and time.monotonic() < deadline:
                time.sleep(0.005)
        return calibrating.result

    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    monkeypatch.setattr("pkmcal.api.calibrate.calibrate_session", again)
    text = run("calibrate", demo.session, "-o", tmp_path / "told")
    assert text.code == 0
    steps = dict.fromkeys(re.sub(r" \(\d+%, \d+ s\)", "", x) for x in text.err.splitlines())
    for step in ("Localizing", "Finding the legs", "Measuring edges", "Identifying"):
        assert any(x.startswith(step) for x in steps)
    assert not any(step in text.out for step in steps)


def test_what_is_to_be_silent_is(demo, calibrated, tmp_path, monkeypatch):
    def long(*_, progress, **_more):
        progress("Finding the legs", 0.35)
        time.sleep(0.2)
        return calibrated

    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    monkeypatch.setattr("pkmcal.api.calibrate.calibrate_session", long)
    words = ("calibrate", demo.session, "-o", tmp_path / "out")
    assert "Finding the legs" in run(*words).err
    for silent in ("--json", "--quiet"):
        assert run(*words, silent).err == ""
