"""Exceptions for faults that a user can cause or should read.

Each is a `PkmcalError`. It states what happened, where, the value that was found, the value that
was expected, and the next step; it renders as one sentence, followed by the next step if there is
one. The command line prints this text, or `as_dict` with ``--json``, and exits with `exit_code`.
Any other exception that escapes is a defect of pkmcal.
"""

from __future__ import annotations

import re
import unicodedata
from functools import partial
from typing import Any, ClassVar, Self

LONGEST_NAME = 255
"""Longest name in characters; file systems accept no longer ones."""
_LONG_NAME = re.compile(rf"[^\s/\\]{{{LONGEST_NAME + 1},}}")
_INVISIBLE_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Unicode categories of characters that are written as escapes: control characters, format
characters (direction marks, zero width), surrogates (from file names that are not UTF-8), line and
paragraph separators."""
LONGEST_VALUE_QUOTED = 500
"""Longest `found` value in characters: enough to recognise the value."""


class PkmcalError(Exception):
    """Base class of all errors of pkmcal; raise one of its subclasses.

    Attributes
    ----------
    what :
        The sentence's core, for example "the camera file does not exist".
    where :
        File, line or field, for example "session.yaml, line 12, stations.front.camera".
    found, expected :
        The value that was found, and the value or range that is valid.
    next_step :
        What the reader can do about the error, a sentence.
    code :
        Kind of fault for programs, such as readings.sign; `class_code` by default.
    rivals :
        Codes of other faults that the data do not exclude.

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
        rivals: tuple[str, ...] = (),
    ) -> None:
        self.code = code or self.class_code
        self.rivals = rivals
        self.what = _brief(what)
        self.where = None if where is None else _brief(where)
        written = _brief(str(found), LONGEST_VALUE_QUOTED) or "nothing"
        self.found = None if found is None else written
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
        # Worker processes pickle errors; Exception's own pickling drops keyword arguments.
        return partial(type(self), **self._fields()), ()

    def located(self, where: str) -> Self:
        """Copy of the error with `where` prepended, for callers that know the file and line."""
        return self.with_fields(where=where if self.where is None else f"{where}: {self.where}")

    def with_fields(self, **fields: Any) -> Self:
        """Copy of the error with other arguments of the constructor, by name."""
        return type(self)(**{**self._fields(), **fields})

    def as_input(self, where: str) -> InputError:
        """Copy of the error as an `InputError` at `where`, for example for the geometry of a
        nominal model.
        """
        return InputError(**self.located(where)._fields())

    def as_dict(self) -> dict[str, Any]:
        """All fields by name, with the class and the rendered message, for ``--json``."""
        return {
            "error": type(self).__name__,
            "exit_code": self.exit_code,
            "message": str(self),
            **self._fields(),
            "code": self.code,
        }

    def _fields(self) -> dict[str, Any]:
        """Arguments of the constructor by name."""
        return {
            "what": self.what,
            "where": self.where,
            "found": self.found,
            "expected": self.expected,
            "next_step": self.next_step,
            "code": None if self.code == self.class_code else self.code,
            "rivals": self.rivals,
        }


class InputError(PkmcalError):
    """Invalid input: a file, a line, a field or an option."""

    exit_code = 2
    class_code = "error.input"


class ResultError(PkmcalError):
    """The program ran, but its result must not be used."""

    class_code = "error.result"


class GeometryError(PkmcalError):
    """No usable solution: a leg through the camera, a singular pose, no convergence."""

    class_code = "error.geometry"


def legible(text: str, keep: str = "") -> str:
    r"""Text on one line with invisible characters escaped: ``\x1b`` for ESC, ``\u202e`` for a
    direction mark.

    All text that is printed or written into comments of files passes through this function.
    keep : characters that are not escaped.
    """
    if text.isprintable():
        return text
    return "".join(
        repr(c)[1:-1] if c not in keep and unicodedata.category(c) in _INVISIBLE_CATEGORIES else c
        for c in text
    )


def _brief(text: str, most: int | None = None) -> str:
    """Legible text with overlong names shortened to their beginning and end, and cut to ``most``
    characters.
    """
    text = _LONG_NAME.sub(lambda name: f"{name[0][:40]}…{name[0][-20:]}", legible(text))
    return text if most is None or len(text) <= most else f"{text[: most - 1]}…"


def _capitalised(sentence: str) -> str:
    """Sentence with a capital first letter, unless the first word is a name such as joints.csv."""
    first = sentence.partition(" ")[0]
    return sentence[:1].upper() + sentence[1:] if first.isalpha() else sentence
