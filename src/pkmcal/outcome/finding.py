"""Findings: messages of checks, each a code with facts, and the sentence made from them.

A finding is made where its fact is computed: code, level, subject and facts in SI units. The
sentence is a template in ``sentences/AREA.toml``, with AREA the first part of the code; programs,
tests and benchmarks read codes and facts. Templates have the fields of :meth:`str.format` and these
formats in addition:

- ``{x:.2g mm}``: a number in m or rad, in another unit
- ``{x:amount m}``: the magnitude of a number in m or rad, two digits, in mm or degrees
- ``{x+unit:amount}``: the same for a number with its unit
- ``{x:brief}``: a number with two significant digits or more, without an exponent
- ``{x+s:ratio}``: the magnitude of a ratio and its standard deviation, in per cent
- ``{x+units:either .2g}``: noise of readings that are lengths (m), angles (rad) or both
- ``{x:range}``: ``0.5 to 2``, or ``more than 0.5`` if the second number is None
- ``{x:size .1%}``: the magnitude of a number, in the format that follows
- ``{x:count edge}``: ``1 edge``, ``12 edges``
- ``{x:listed 4}``: names, of many the first; ``joined``: all of them
- ``{x:one is|are}``: the first word for 1, or for a list of one
- ``{x:sign more|less}``: the first word for a positive number
- ``{x:case a=this|b=}``: by the value of a text
- ``{x:often}``: a probability, as ``once in 30 times``
- ``{x:capital}``: the beginning of a sentence

A part in ``[[ ]]`` is omitted if one of its facts is missing or None, and replaced by the text
after ``||`` in the part, if there is one.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache, cached_property
from importlib.resources import files
from string import Formatter
from typing import Any, Literal

from pkmcal.errors import PkmcalError
from pkmcal.wording import (
    DISPLAY_UNITS,
    amount,
    brief,
    capital,
    count,
    how_often,
    joined,
    listed,
    ratio_in_per_cent,
    with_unit,
)

_OPTIONAL_PART = re.compile(r"\[\[([^\[\]]*)\]\]")
_UNITS = {name: scale for scale, name in DISPLAY_UNITS.values()}


class Level(StrEnum):
    """Severity of a finding: reason against the result, warning, or note (advice)."""

    WRONG = "wrong"
    DOUBTFUL = "doubtful"
    NOTE = "note"


Mark = Literal["good"] | Level
"""Sign before a row or a verdict: good, or the level of a finding."""


@dataclass(frozen=True)
class Finding:
    """Message of a check: a code with its facts.

    code : ``area.what``, such as readings.scale.
    level : severity.
    facts : numbers in SI units, texts, and lists of these, by name. Common names: value, sigma,
        log_odds, tool_shift (m), tool_shift_sigmas, and rivals, other explanations that the data do
        not exclude.
    subject : file, leg, column, station or configuration concerned.
    error : the error that the finding reports, if any.
    saved_text, saved_next_step : sentences of a finding that was read from a file, in the wording
        of the version that wrote it.
    """

    code: str
    level: Level
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    subject: str = ""
    error: PkmcalError | None = field(default=None, repr=False)
    saved_text: str = field(default="", repr=False)
    saved_next_step: str = field(default="", repr=False)

    @cached_property
    def text(self) -> str:
        """Sentence with the next step."""
        return self.saved_text or " ".join(part for part in self._parts if part)

    @property
    def next_step(self) -> str:
        """Sentence on what to do next; empty if nothing is to be done."""
        return self._parts[1]

    @property
    def station(self) -> str | None:
        """Name of the station concerned, None for none."""
        return self.facts.get("station")

    def document(self) -> dict[str, Any]:
        """Finding as plain data; for an error also the error's parts."""
        parts = {
            "code": self.code,
            "level": self.level.value,
            "subject": self.subject,
            "text": self.text,
            "next_step": self.next_step,
            "station": self.station,
            "facts": {} if self.error else dict(self.facts),
        }
        return parts if self.error is None else {**parts, **_parts_of(self.error)}

    @cached_property
    def _parts(self) -> tuple[str, str]:
        """Sentence and next step, of which :attr:`text` is made."""
        if self.error is not None:
            return str(self.error), ""
        if self.saved_text:
            return self.saved_text, self.saved_next_step
        template = templates(self.code.partition(".")[0])[self.code]
        facts = {"subject": self.subject, **self.facts}
        text = filled(template["text"], facts)
        if facts.get("rivals"):  # of any model violation
            text += " " + filled(templates("violation")["violation.rivals"]["text"], facts)
        return text, filled(template.get("next_step", ""), facts)


def finding(code: str, level: Level, subject: str = "", **facts: Any) -> Finding:
    """Finding with its facts as keyword arguments."""
    return Finding(code, level, facts, subject)


def wrong(code: str, subject: str = "", **facts: Any) -> Finding:
    """Finding that makes the result unusable."""
    return Finding(code, Level.WRONG, facts, subject)


def doubtful(code: str, subject: str = "", **facts: Any) -> Finding:
    """Warning: a finding that costs accuracy or needs attention."""
    return Finding(code, Level.DOUBTFUL, facts, subject)


def note(code: str, subject: str = "", **facts: Any) -> Finding:
    """Note or advice."""
    return Finding(code, Level.NOTE, facts, subject)


def of_error(error: PkmcalError, level: Level = Level.WRONG, station: str | None = None) -> Finding:
    """Finding that reports an error, under the error's code."""
    facts = {} if station is None else {"station": station}
    return Finding(error.code, level, facts, error.where or "", error)


def first_error(findings: Sequence[Finding]) -> dict[str, Any]:
    """Parts of the first error among findings, for a command's JSON; empty without an error."""
    errors = (one.error for one in findings if one.error is not None)
    return next((_parts_of(error) for error in errors), {})


def _parts_of(error: PkmcalError) -> dict[str, Any]:
    """Parts of an error without the exit code, which is the command's."""
    return {name: value for name, value in error.as_dict().items() if name != "exit_code"}


@cache
def templates(area: str) -> dict[str, dict[str, str]]:
    """Templates of an area by code, each with its text and, if it has one, its next step."""
    file = files("pkmcal.outcome") / "sentences" / f"{area}.toml"
    if not file.is_file():
        return {}
    entries: dict[str, str | dict[str, str]] = tomllib.loads(file.read_text(encoding="utf-8"))
    return {
        f"{area}.{name}": {"text": entry} if isinstance(entry, str) else entry
        for name, entry in entries.items()
    }


def fields_of(template: str) -> tuple[set[str], set[str]]:
    """Facts that a template requires, and facts that it uses if they are given."""
    optional = set[str]()
    for part in _OPTIONAL_PART.findall(template):
        optional |= _names(part)
    return _names(_OPTIONAL_PART.sub("", template)), optional


def _names(template: str) -> set[str]:
    """Names of the facts in a template; ``x+unit`` counts as two."""
    fields = [name for _, name, _, _ in Formatter().parse(template) if name]
    return {name for joint in fields for name in joint.split("+")}


def filled(template: str, facts: Mapping[str, Any]) -> str:
    """Template with the values of its facts, optional parts dropped where a fact is missing."""

    def part(match: re.Match[str]) -> str:
        given, _, otherwise = match[1].partition("||")
        there = all(facts.get(name) is not None for name in _names(given))
        return given if there else otherwise

    return _Fields().vformat(_OPTIONAL_PART.sub(part, template), (), facts)


def _number(value: Any) -> float:
    """The number itself, or the length of a list."""
    return value if isinstance(value, int | float) else len(value)


def _choice(first: bool, rest: str) -> str:
    """One of two alternatives that ``|`` separates."""
    one, _, other = rest.partition("|")
    return one if first else other


def _either(noise: tuple[float, Sequence[str]], spec: str) -> str:
    """Noise of readings in the unit of each kind of reading that has it."""
    size, units = noise
    display = [DISPLAY_UNITS[unit] for unit in ("m", "rad") if unit in units]
    return " or ".join(with_unit(format(size * scale, spec), name) for scale, name in display)


def _range(ends: tuple[float, float | None], _rest: str) -> str:
    """Interval with two digits; open upwards if the second end is None."""
    # rounded first: two digits alone would give 1.2e+02
    low, *high = (f"{float(f'{end:.2g}'):g}" for end in ends if end is not None)
    return f"{low} to {high[0]}" if high else f"more than {low}"


_FORMATS: dict[str, Callable[[Any, str], str]] = {
    "size": lambda x, rest: _Fields().format_field(abs(x), rest),
    "one": lambda x, rest: _choice(_number(x) == 1, rest),
    "sign": lambda x, rest: _choice(x > 0, rest),
    "case": lambda x, rest: dict(pair.split("=", 1) for pair in rest.split("|"))[str(x)],
    "listed": lambda x, rest: listed([str(name) for name in x], int(rest or 6)),
    "joined": lambda x, _: joined([str(name) for name in x]),
    "count": lambda x, rest: count(_number(x), rest),
    "amount": lambda x, rest: amount(abs(x), rest) if rest else amount(abs(x[0]), x[1]),
    "brief": lambda x, _: brief(x),
    "ratio": lambda x, _: ratio_in_per_cent(*x),
    "either": _either,
    "range": _range,
    "often": lambda x, _: how_often(x),
    "capital": lambda x, _: capital(x),
}


class _Fields(Formatter):
    """Formatter with the formats of the module's table."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """Value of a fact, or a tuple of the facts that ``+`` joins."""
        del args
        several = tuple(kwargs[name] for name in field_name.split("+"))
        return (several if len(several) > 1 else several[0]), field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        """Value as text."""
        first, _, rest = format_spec.partition(" ")
        if first in _FORMATS:
            return _FORMATS[first](value, rest)
        if rest in _UNITS:
            return with_unit(format(value * _UNITS[rest], first), rest)
        if format_spec.endswith("%"):
            return f"{format(value, format_spec).removesuffix('%')} %"
        return format(value, format_spec)
