"""Progress of a command: a text and the share done, from 0 to 1, which never decreases.

A task divides its range among its steps by :func:`part`; each step reports its own share, from 0 to
1, independent of its place in the whole. A step that is repeated until it converges gives each
repetition a part of what remains. The outermost task is a :func:`whole` one.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from threading import Lock

Progress = Callable[[str, float], None]
"""Callback with a text and the share done, 0 to 1."""


def no_progress(text: str, share: float) -> None:
    """Progress callback that does nothing."""


def part(progress: Progress, first: float, last: float) -> Progress:
    """Progress of a step that takes its task from the share ``first`` to ``last``."""
    return lambda text, share: progress(text, first + (last - first) * share)


@contextmanager
def whole(progress: Progress | None, text: str) -> Generator[Progress]:
    """Context of a whole task: its shares begin at 0, with ``text``, never decrease, and end at 1.

    The callback is called by one thread at a time. A task that raises ends below 1.
    """
    call, lock = progress or no_progress, Lock()
    now = (text, 0.0)

    def report(text: str, share: float) -> None:
        nonlocal now
        with lock:  # threads that work side by side report in any order
            now = text, min(max(share, now[1]), 1.0)
            call(*now)

    report(*now)
    yield report
    report(now[0], 1.0)
