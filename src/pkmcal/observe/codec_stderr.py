"""What decoders say on standard error, which they do without asking, taken from there.

libpng and libjpeg tell faults to the process' standard error and not to their caller. For as long
as pictures are decoded that file stands for another one. Several are decoded at once; one that may
have told a fault is decoded again alone, so that nobody is blamed for another's. What others write
meanwhile, such as a progress bar, is passed on afterwards.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from threading import Condition
from typing import TypeVar

Decoded = TypeVar("Decoded")
STANDARD_ERROR = 2
_FAULT = re.compile(
    rb"(?:libpng error: |(?=Premature end of JPEG file|Inconsistent progression )"
    rb"|Corrupt JPEG data: (?!\d+ extraneous bytes before marker 0xd9|bad ICC marker))(.*)\n?"
)
"""What is wrong with the picture itself. Bytes between its last row and the end mark are none of
it: webcams fill up with these."""
_REMARK = re.compile(
    rb"libpng warning: .*\n?|Corrupt JPEG data: .*\n?|Unknown Adobe color transform .*\n?"
    rb"|Warning: unknown JFIF .*\n?|Invalid SOS parameters .*\n?"
)
"""What is wrong beside it, such as a colour profile, and nobody's business."""


class _Ear:
    """Standard error stands for a file of ours while anybody decodes; many may at once.

    Whose fault it was is told by decoding again alone, which only faulty pictures cost.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._busy, self._waiting = 0, 0
        self._held = ExitStack()
        self._heard: int | None = None

    @contextmanager
    def listening(self, alone: bool) -> Generator[Callable[[], bytes]]:
        """What was said since, by anybody who decoded meanwhile."""
        with self._changed:
            if alone:
                self._waiting += 1
                self._changed.wait_for(lambda: not self._busy)
                self._waiting -= 1
            else:
                self._changed.wait_for(lambda: self._busy >= 0 and not self._waiting)
            if not self._busy:
                self._begin()
            self._busy = -1 if alone else self._busy + 1
            start = self._size()
        try:
            yield lambda: self._since(start)
        finally:
            with self._changed:
                self._busy = 0 if alone else self._busy - 1
                if not self._busy:
                    self._held.close()
                self._changed.notify_all()

    def _begin(self) -> None:
        if sys.stderr is not None:
            sys.stderr.flush()
        try:
            own = os.dup(STANDARD_ERROR)
        except OSError:  # it is closed, and nobody hears them
            return
        self._held.callback(os.close, own)
        heard = self._held.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        self._heard = heard.fileno()
        os.dup2(self._heard, STANDARD_ERROR)
        self._held.callback(self._give_back, own)

    def _give_back(self, own: int) -> None:
        os.dup2(own, STANDARD_ERROR)
        rest = _REMARK.sub(b"", _FAULT.sub(b"", self._since(0)))
        if rest:
            os.write(own, rest)
        self._heard = None

    def _size(self) -> int:
        return 0 if self._heard is None else os.fstat(self._heard).st_size

    def _since(self, start: int) -> bytes:
        return b"" if self._heard is None else os.pread(self._heard, self._size() - start, start)


_ear = _Ear()


def decoded_and_fault(decode: Callable[[], Decoded]) -> tuple[Decoded, str]:
    """What `decode` returns, and the first fault of the picture that it told on standard error."""
    with _ear.listening(alone=False) as heard:
        value = decode()
        message = heard()
    if not _FAULT.search(message):
        return value, ""
    with _ear.listening(alone=True) as heard:
        value = decode()
        fault = _FAULT.search(heard())
    return value, fault[1].decode("utf-8", "replace").removesuffix(
        " (libpng)"
    ).strip() if fault else ""
