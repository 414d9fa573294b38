"""What decoders say on standard error, which they do without asking, taken from there.

libpng and libjpeg tell faults to the process' standard error and not to their caller. For as long
as a picture is decoded that file stands for another one; one picture at a time, so that nobody is
blamed for another's. What others write meanwhile, such as a progress bar, is passed on afterwards.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Callable
from threading import Lock
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
_one_at_a_time = Lock()


def listening(decode: Callable[[], Decoded]) -> tuple[Decoded, str]:
    """What `decode` returns, and the first fault of the picture that it told on standard error."""
    with _one_at_a_time:
        if sys.stderr is not None:  # pyright: ignore[reportUnnecessaryComparison]
            sys.stderr.flush()
        try:
            own = os.dup(STANDARD_ERROR)
        except OSError:  # it is closed, and nobody hears them
            return decode(), ""
        try:
            with tempfile.TemporaryFile() as heard:
                os.dup2(heard.fileno(), STANDARD_ERROR)
                try:
                    found = decode()
                finally:
                    os.dup2(own, STANDARD_ERROR)
                heard.seek(0)
                said = heard.read()
            rest = _REMARK.sub(b"", _FAULT.sub(b"", said))
            if rest:
                os.write(own, rest)
        finally:
            os.close(own)
    fault = _FAULT.search(said)
    return found, fault[1].decode("utf-8", "replace").removesuffix(
        " (libpng)"
    ).strip() if fault else ""
