"""Progress of commands: its share, the bar of a terminal, and the lines of a log."""

import re
import sys
import threading
import time
from contextlib import redirect_stderr
from io import StringIO

import pytest

from conftest import run
from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.errors import InputError
from pkmcal.outcome import Table
from pkmcal.outcome.progress import part, whole
from test_pose_sessions import make


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


@pytest.fixture
def calls():
    """Calls of a progress callback."""
    return []


@pytest.fixture
def record(calls):
    return lambda text, share: calls.append((text, share))


def test_a_whole_task_goes_from_0_to_1_and_never_backwards(calls, record):
    with whole(record, "Reading") as report:
        for share in (0.3, 0.1, 1.7, 0.5):
            report("Measuring", share)
    assert calls == [("Reading", 0.0), ("Measuring", 0.3), ("Measuring", 0.3)] + 3 * [
        ("Measuring", 1.0)
    ]


def test_a_task_that_fails_does_not_end_at_1(calls, record):
    def task():
        with whole(record, "Reading") as report:
            report("Measuring", 0.25)
            raise InputError("no legs")

    with pytest.raises(InputError):
        task()
    assert calls[-1] == ("Measuring", 0.25)


def test_threads_report_in_any_order_and_the_share_does_not_decrease(calls):
    def slow(_text, share):
        time.sleep(0.001 if share < 0.5 else 0)
        calls.append(share)

    with whole(slow, "Measuring") as report:
        threads = [threading.Thread(target=report, args=("Measuring", k / 20)) for k in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert calls == sorted(calls)


def test_the_part_of_a_part_is_a_part_of_the_whole(calls, record):
    inner = part(part(record, 0.2, 0.6), 0.5, 1.0)
    for share in (0.0, 0.5, 1.0):
        inner("", share)
    assert [share for _, share in calls] == pytest.approx([0.4, 0.5, 0.6])


def test_the_work_and_the_files_of_a_command_are_one_task(calls, record, monkeypatch):
    """Shares of several tasks one after the other, such as those of the demonstration."""
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 3600.0)
    with redirect_stderr(Heard()), console.progress() as progress:
        joined = console.CommandProgress(record, progress.close)
        for first, last in ((0, 0.5), (0.5, 1)):
            with whole(part(joined.work, first, last), "Measuring") as report:
                report("Identifying", 0.5)
        joined.writing()
        joined.report("", 1.0)
    shares = [share for _, share in calls]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)


def test_the_remaining_time_is_that_of_the_work():
    """Loading the program has no share; what follows is as fast as before."""
    estimate = console.RemainingTime()
    assert [estimate.text(*at) for at in ((0, 0), (0, 8), (0.04, 18), (0.25, 9))] == [""] * 4
    assert estimate.text(0.25, 18) == "0:30 left"
    assert estimate.text(0.5, 158) == "2:30 left"
    assert estimate.text(1.0, 20) == "0:00 left"


def test_what_was_cached_promises_nothing():
    """Six tenths come from the cache; a step that lasts longer than expected leaves more time."""
    estimate = console.RemainingTime()
    assert [estimate.text(*at) for at in ((0, 0), (0, 1), (0.6, 1.5))] == [""] * 3
    assert estimate.text(0.7, 11) == "0:30 left"
    assert estimate.text(0.7, 21) == "1:00 left"


def drawn(text):
    """Text of a terminal without its control sequences, one frame of the bar a line."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).replace("\r", "\n")


def test_a_terminal_has_a_bar_with_the_remaining_time(monkeypatch, capsys):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(console, "SHORTEST_TIME_FOR_ESTIMATE", 0.0)
    with console.progress() as progress:
        progress.work("Measuring", 0.0)
        progress.work("Identifying", 0.5)
        progress.close()
        during = capsys.readouterr().err
        progress.close()
    bars = drawn(during).splitlines()
    assert any("━" in line and "left" in line and "Identifying" in line for line in bars)
    assert capsys.readouterr().err == ""  # it was over before anything else is printed


def test_a_long_step_is_reported_in_plain_lines(monkeypatch, capsys):
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    with redirect_stderr(Heard()) as heard, console.progress() as progress:
        progress.report("Finding the legs: 3 of 9 images", 0.35)
        heard.written.clear()
        assert heard.written.wait(60)
    line = r"(Starting|Finding the legs: 3 of 9 images) \(\d+ %, \d+ s\)"
    assert all(re.fullmatch(line, x) for x in heard.text.splitlines())
    assert "Finding the legs: 3 of 9 images (35 %, 0 s)" in heard.text
    assert capsys.readouterr().out == ""


def test_nobody_speaks_where_nothing_is_wanted(monkeypatch):
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.01)
    count = threading.active_count()
    with redirect_stderr(Heard()) as heard, console.progress(quiet=True) as progress:
        progress.report("Finding the legs", 0.35)
        assert threading.active_count() == count
    assert heard.text == ""


def test_a_short_run_prints_nothing():
    with redirect_stderr(Heard()) as heard, console.progress() as progress:
        progress.report("Finding the legs", 0.35)
    assert heard.text == ""


def test_a_calibration_reports_its_steps(calibrating, checked):
    """Without the guard of a whole task: each step has its own part of the range."""
    for one in (calibrating, checked):
        texts, shares = zip(*one.steps, strict=True)
        assert list(shares) == sorted(shares)
        assert 0 <= shares[0] <= shares[-1] <= 1
        for step in ("Localizing", "Finding the legs", "Measuring edges", "Identifying"):
            assert any(text.startswith(step) for text in texts)


def test_a_command_that_is_to_be_silent_is(tmp_path, monkeypatch):
    make(tmp_path / "session", "gough-stewart")
    monkeypatch.setattr(console, "PROGRESS_LINE_INTERVAL", 0.001)
    words = ("calibrate", tmp_path / "session", "-o", tmp_path / "out")
    assert "Identifying" in run(*words).err
    for silent in ("--json", "--quiet"):
        assert run(*words, silent).err == ""


def test_paths_are_links_on_a_terminal_alone(monkeypatch, tmp_path):
    (tmp_path / "rep ort.html").touch()
    monkeypatch.setenv("TERM", "xterm-256color")
    files = [(str(tmp_path / "rep ort.html"), "the page"), (str(tmp_path / "none"), "no file")]
    for value, link in (("1", f"\x1b\\{tmp_path / 'rep ort.html'}\x1b]8;;\x1b\\"), ("0", None)):
        monkeypatch.setenv("TTY_COMPATIBLE", value)
        monkeypatch.setattr(sys, "stdout", written := StringIO())
        terminal.print_files(terminal.out(), files)
        first, second = written.getvalue().splitlines()
        assert ("\x1b]8;" in first) == (link is not None)
        assert f"file://{tmp_path.as_posix()}/rep%20ort.html" in first or link is None
        assert link is None or link in first
        assert "\x1b]8;" not in second


@pytest.mark.parametrize("width", [60, 120])
def test_the_legend_of_a_table_is_as_wide_as_the_terminal(monkeypatch, capsys, width):
    monkeypatch.setenv("COLUMNS", str(width))
    table = Table("", ("a", "b"), (), legend="word " * 60)
    terminal.print_table(terminal.out(), table)
    lines = [line for line in capsys.readouterr().out.splitlines() if "word" in line]
    assert all(line.startswith("   word") for line in lines)
    assert width - 6 < max(map(len, lines)) <= width
