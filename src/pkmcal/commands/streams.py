"""Standard output and standard error that tolerate closed pipes and missing streams.

Output must not change the work nor the exit code: a reader such as ``head`` may leave, and the rest
is discarded; standard error may go nowhere. Only a result that cannot be written, to a full disk or
a closed standard output, is an error, which is raised once.
"""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from pkmcal.errors import InputError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

READER_GONE_ERRORS = {errno.EPIPE} | ({errno.EINVAL} if os.name == "nt" else set())
"""Errors of a pipe whose reader has left; Windows has its own."""


class LostOutput(InputError):
    """Standard output cannot be written any more."""


@contextmanager
def withstanding() -> Generator[None]:
    """Context in which sys.stdout and sys.stderr tolerate such failures.

    Terminals and streams that a caller has set are kept. In a program that is started with one of
    them closed, Python has None there, and the next file to be opened would get its descriptor.
    """
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _robust_stream(sys.stdout, 1), _robust_stream(sys.stderr, 2)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def _robust_stream(stream: TextIO | None, number: int) -> TextIO:
    raises = number == 1
    if stream is None:
        while (taken := os.open(os.devnull, os.O_RDONLY)) < number:
            pass
        if taken > number:
            os.close(taken)
        return _text(_Stream(number, raises=raises), "utf-8")
    if isinstance(stream, io.TextIOWrapper):
        # a character that the terminal lacks becomes ?, rather than an error
        stream.reconfigure(errors="replace")
        # raw is below the buffer, which PYTHONUNBUFFERED removes
        raw = getattr(stream.buffer, "raw", stream.buffer)
        if isinstance(raw, io.FileIO) and not stream.isatty():
            stream.flush()
            return _text(_Stream(stream.fileno(), raises=raises), stream.encoding)
    return stream


class _Stream(io.FileIO):
    """File that fails at most once. raises : whether the failure is raised as LostOutput."""

    def __init__(self, number: int, *, raises: bool) -> None:
        super().__init__(number, "w", closefd=False)
        self._raises = raises

    def write(self, data: ReadableBuffer, /) -> int:
        """Write data; after a failure, discard them."""
        try:
            return super().write(data)
        except OSError as error:
            raises, self._raises = self._raises, False
            os.dup2(nowhere := os.open(os.devnull, os.O_WRONLY), self.fileno())
            os.close(nowhere)
            if raises and error.errno not in READER_GONE_ERRORS:
                raise LostOutput(
                    f"standard output cannot be written ({error.strerror})",
                    next_step="Make room, or send it elsewhere; files that were written are whole",
                ) from None
            return memoryview(data).nbytes


def _text(raw: _Stream, encoding: str) -> TextIO:
    return io.TextIOWrapper(io.BufferedWriter(raw), encoding, "replace", line_buffering=True)
