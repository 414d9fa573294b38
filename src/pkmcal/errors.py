"""One family of errors: what happened, where, found and expected, next step.

Every error that a user can cause or should read is a `PkmcalError`. It renders as one sentence,
or two where there is a next step; the command line prints that, or `as_dict` under ``--json``,
and leaves with `exit_code`. Anything else that escapes is a defect of pkmcal.
"""

from __future__ import annotations

import re
import unicodedata
from functools import partial
from typing import Any, ClassVar, Self

LONGEST_NAME = 255
"""Characters of a name; file systems take no longer ones."""
_LONG_NAME = re.compile(rf"[^\s/\\]{{{LONGEST_NAME + 1},}}")
_INVISIBLE_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Of Unicode: what moves a terminal's cursor, turns the direction of writing, has no width, breaks
lines, or is half of a character, as a file's name that is not UTF-8 holds it."""
LONGEST_VALUE_QUOTED = 500
"""Characters of what was found: enough to recognise it by."""


class PkmcalError(Exception):
    """Base of the family; raise one of its subclasses.

    Attributes
    ----------
    what :
        The sentence's core, for example "the camera file does not exist".
    where :
        File, line or field, for example "session.yaml, line 12, stations.front.camera".
    found, expected :
        What was there, and what should have been.
    next_step :
        What the reader can do about it, a sentence.
    code :
        What kind of fault it is, for programs, such as readings.sign; of its class unless given.

    """

    exit_code: ClassVar[int] = 1
    class_code: ClassVar[str] = "error.other"

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        found: object = None,
        expected: object = None,
        next_step: str | None = None,
        code: str | None = None,
    ) -> None:
        self.code = code or self.class_code
        self.what = _brief(what)
        self.where = None if where is None else _brief(where)
        self.found = None if found is None else _brief(str(found), LONGEST_VALUE_QUOTED)
        self.expected = None if expected is None else _brief(str(expected))
        self.next_step = None if next_step is None else _brief(next_step)
        super().__init__(self.what)

    def __str__(self) -> str:
        sentence = f"{self.where}: {self.what}" if self.where else self.what
        sentence = sentence.rstrip(".")
        facts = [
            f"{label} {text}"
            for label, text in (("found", self.found), ("expected", self.expected))
            if text is not None
        ]
        if facts:
            sentence += "; " + ", ".join(facts)
        sentence += "."
        if self.next_step:
            sentence += " " + _capitalised(self.next_step.rstrip(".")) + "."
        return sentence

    def __reduce__(self) -> tuple[Any, ...]:
        # Keyword arguments do not survive Exception's own pickling, and worker processes pickle.
        return partial(type(self), **self._fields()), ()

    def located(self, where: str) -> Self:
        """Return the same error with `where` added, for callers that know the file and line."""
        place = where if self.where is None else f"{where}: {self.where}"
        return type(self)(**{**self._fields(), "where": place})

    def as_input(self, where: str) -> InputError:
        """Return the same as a fault of the input at `where`, such as a drawing's geometry."""
        return InputError(**self.located(where)._fields())

    def as_dict(self) -> dict[str, Any]:
        """Everything above under its name, for ``--json``."""
        return {
            "error": type(self).__name__,
            "exit_code": self.exit_code,
            "message": str(self),
            **self._fields(),
            "code": self.code,
        }

    def _fields(self) -> dict[str, Any]:
        return {
            "what": self.what,
            "where": self.where,
            "found": self.found,
            "expected": self.expected,
            "next_step": self.next_step,
            "code": None if self.code == self.class_code else self.code,
        }


class InputError(PkmcalError):
    """The input is wrong: a file, a line, a field or an option."""

    exit_code = 2
    class_code = "error.input"


class ResultError(PkmcalError):
    """The program ran, but its result should not be used."""

    class_code = "error.result"


class GeometryError(PkmcalError):
    """No usable answer here: a leg through the camera, a singular pose, no convergence."""

    class_code = "error.geometry"


def legible(text: str, keep: str = "") -> str:
    r"""Text with every character spelt out that cannot be read: ``\x1b`` for ESC, ``\u202e``.

    All that is printed, and all that is written into comments, goes through here; what stays is of
    one line. keep : characters that stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(
        repr(c)[1:-1] if c not in keep and unicodedata.category(c) in _INVISIBLE_CATEGORIES else c
        for c in text
    )


def _brief(text: str, most: int | None = None) -> str:
    """Legible text without what is too long to be a name, of which both ends are enough to
    recognise it.
    """
    text = _LONG_NAME.sub(lambda name: f"{name[0][:40]}…{name[0][-20:]}", legible(text))
    return text if most is None or len(text) <= most else f"{text[: most - 1]}…"


def _capitalised(sentence: str) -> str:
    """Begin with a capital, unless the first word is a name such as joints.csv."""
    first = sentence.partition(" ")[0]
    return sentence[:1].upper() + sentence[1:] if first.isalpha() else sentence
