"""Output to the terminal: results to stdout, progress and errors to stderr."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pkmcal.errors import InputError, legible
from pkmcal.outcome.progress import Progress, no_progress, part, whole
from pkmcal.terminal import err, print_points
from pkmcal.wording import percentage

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.api.result import FolderResult

SMALLEST_PICTURE_SIDE, LARGEST_PICTURE_SIDE = 64, 8192
"""Limits of an image's width and height in px: below, legs are too narrow to have edges; above,
memory does not suffice.
"""
PROGRESS_LINE_INTERVAL = 10.0
"""Seconds between two lines of progress without a terminal."""
WORK_SHARE = 0.95
"""Share of a command's progress before its files are written."""
SMALLEST_SHARE_FOR_ESTIMATE, SHORTEST_TIME_FOR_ESTIMATE = 0.05, 2.0
"""Share and seconds from which on the remaining time is estimated."""


def parsed_size(text: str) -> tuple[int, int]:
    """(width, height) from a text such as 800x600."""
    match = re.fullmatch(r"(\d{1,6})\s*[xX×]\s*(\d{1,6})(?:\s*px)?", text.strip())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(size) < SMALLEST_PICTURE_SIDE or max(size) > LARGEST_PICTURE_SIDE:
        raise InputError(
            "this is not an image size",
            where="--size",
            found=text,
            expected=f"width x height, each {SMALLEST_PICTURE_SIDE} to {LARGEST_PICTURE_SIDE},"
            f" such as 800x600",
        )
    return size


def output_folder(
    out: Path | None, usual: Path, kind: type[FolderResult], *, force: bool = False
) -> Path:
    """Folder of a result, ``usual`` if none is given, checked before the work.

    Raises InputError where it cannot be written, or holds anything but an earlier result of this
    kind. force : the earlier result need not be kept.
    """
    from pkmcal.files import default_output

    folder = out or default_output(usual)
    kind.check_folder(folder, force=force)
    return folder


def print_error(sentence: str) -> None:
    """Print an error to stderr: wrapped and coloured on a terminal, in one line elsewhere."""
    console = err()
    if console.is_terminal:
        print_points(console, [("[bold red]Error:[/]", sentence)])
    else:
        sys.stderr.write(f"Error: {legible(sentence)}\n")


def print_json(data: Mapping[str, Any]) -> None:
    """Print the single JSON object of a command."""
    from pkmcal.files import json_text

    sys.stdout.write(json_text(data))


@dataclass(frozen=True)
class CommandProgress:
    """Progress of a whole command: its work, and the writing of its files.

    report : callback for the whole command. close : ends the progress, before anything is printed.
    """

    report: Progress
    close: Callable[[], None]

    @property
    def work(self) -> Progress:
        """Callback for the work before the files are written."""
        return part(self.report, 0.0, WORK_SHARE)

    def writing(self) -> None:
        """Report that the files are written."""
        self.report("Writing the report", WORK_SHARE)


@contextmanager
def progress(quiet: bool = False) -> Generator[CommandProgress]:
    """Context of a command with its progress, drawn as a bar on stderr.

    A command opens it before it imports what it needs, which takes a second. If stderr is not a
    terminal but a log or a pipe, a plain line is printed every PROGRESS_LINE_INTERVAL seconds.
    """
    with ExitStack() as stack:
        draw = no_progress
        if not quiet:
            console = err()
            lines = _progress_bar(console) if console.is_terminal else _progress_lines()
            draw = stack.enter_context(lines)
        report = stack.enter_context(whole(draw, "Starting"))
        yield CommandProgress(report, stack.close)


@contextmanager
def _progress_bar(console: Console) -> Generator[Progress]:
    """Context with a progress callback that draws a bar, the time and the remaining time."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    estimate = RemainingTime()
    columns = (
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.fields[remaining]}", style="dim", markup=False),
        TextColumn("{task.description}", markup=False),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0, remaining="")

        def report(text: str, share: float) -> None:
            remaining = estimate.text(share, time.monotonic())
            bar.update(task, description=text, completed=share, remaining=remaining)

        yield report


@contextmanager
def _progress_lines() -> Generator[Progress]:
    """Context with a progress callback that prints lines at intervals; short commands print
    none.
    """
    begin, over, step = time.monotonic(), threading.Event(), [("", 0.0)]
    estimate = RemainingTime()

    def report(text: str, share: float) -> None:
        step[0] = text, share
        estimate.text(share, time.monotonic())

    def print_lines() -> None:
        while not over.wait(PROGRESS_LINE_INTERVAL):
            text, share = step[0]
            if text:
                # again, because a long step leaves more time than its beginning promised
                remaining = estimate.text(share, time.monotonic())
                times = [f"{time.monotonic() - begin:.0f} s", *([remaining] if remaining else [])]
                sys.stderr.write(f"{legible(text)} ({', '.join([percentage(share), *times])})\n")

    # in a thread, because a step may take minutes without a call of report
    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        over.set()
        thread.join()


class RemainingTime:
    """Estimate of a task's remaining time from the time since its first step.

    Until that step the program is loaded, which takes no share. A large share that is done in no
    time was cached, and does not show how long the rest takes.
    """

    def __init__(self) -> None:
        self._began: float | None = None
        self._last, self._cached = (0.0, 0.0), 0.0

    def text(self, share: float, now: float) -> str:
        """Remaining time in words, empty where too little is done; now : clock, s."""
        began = self._began
        if began is None or not share:
            self._began, self._last = now, (share, now)
            return ""
        step, wait = share - self._last[0], now - self._last[1]
        if step > SMALLEST_SHARE_FOR_ESTIMATE and 0 <= wait < SHORTEST_TIME_FOR_ESTIMATE:
            self._cached += step
        if step:
            self._last = share, now
        passed, done = now - began, share - self._cached
        if done < SMALLEST_SHARE_FOR_ESTIMATE or passed < SHORTEST_TIME_FOR_ESTIMATE:
            return ""
        minutes, seconds = divmod(round(passed * (1 - share) / done), 60)
        return f"{minutes}:{seconds:02d} left"


def can_show() -> bool:
    """Whether there is a user with a screen and a browser."""
    if os.environ.get("CI") or not sys.stdout.isatty():
        return False
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
