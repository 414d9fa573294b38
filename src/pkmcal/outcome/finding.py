"""Findings: what a command reports, as a code with facts, and its sentence.

A finding is raised where it is computed, as code, level, subject and facts in SI units. Its
sentence is a template of ``sentences/AREA.toml``, AREA the code's first part; programs, tests and
benchmarks read codes and facts. A template has fields as :meth:`str.format` knows them, with these
formats besides:

=======================  =====================================================================
``{x:.2g mm}``           a number in m or rad, in another unit
``{x:amount m}``         the magnitude of a number in m or rad, two digits, in mm or degrees
``{x+unit:amount}``      the same of a number and its unit
``{x+s:ratio}``          the magnitude of a ratio and its standard deviation, in per cent
``{x+units:either .2g}`` a noise of readings that are lengths (m), turns (rad) or both
``{x:range}``            ``0.5 to 2``, or ``more than 0.5`` where the second number is None
``{x:size .1%}``         the magnitude of a number, by the format that follows
``{x:count edge}``       ``1 edge``, ``12 edges``
``{x:listed 4}``         names, of many the first; ``joined``: all of them
``{x:one is|are}``       the first for 1, or for a list of one
``{x:sign more|less}``   the first for a positive number
``{x:case a=this|b=}``   by the value of a text
``{x:often}``            a probability, as ``once in 30 times``
``{x:capital}``          the beginning of a sentence
=======================  =====================================================================

A part in ``[[ ]]`` is left out where one of its facts is missing or None; what follows ``||`` in it
then stands in its place.
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
from typing import Any

from pkmcal.errors import PkmcalError
from pkmcal.wording import (
    DISPLAY_UNITS,
    amount,
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
    """Severity of a finding: a reason against the result, a warning, or a note or advice."""

    WRONG = "wrong"
    DOUBTFUL = "doubtful"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One thing that a command reports.

    code : ``area.what``, such as readings.scale. facts : numbers in SI units, texts, and lists of
    these by name; where they exist, value and sigma, log_odds, and tool_shift (m) with
    tool_shift_sigmas. subject : the file, leg, column, station or configuration that it is about.
    error : of which it is made. saved_text, saved_next_step : of a finding that was read back, as
    the pkmcal that made it worded them.
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
        """The sentence, and what to do next."""
        return self.saved_text or " ".join(part for part in self._parts if part)

    @property
    def next_step(self) -> str:
        """What to do next, a sentence; empty where nothing is to be done."""
        return self._parts[1]

    @property
    def station(self) -> str | None:
        """The station that it is about."""
        return self.facts.get("station")

    def document(self) -> dict[str, Any]:
        """For programs; of an error with its parts."""
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
        if self.error is not None:
            return str(self.error), ""
        if self.saved_text:
            return self.saved_text, self.saved_next_step
        template = templates(self.code.partition(".")[0])[self.code]
        facts = {"subject": self.subject, **self.facts}
        return filled(template["text"], facts), filled(template.get("next_step", ""), facts)


def finding(code: str, level: Level, subject: str = "", **facts: Any) -> Finding:
    """A finding with its facts by name."""
    return Finding(code, level, facts, subject)


def wrong(code: str, subject: str = "", **facts: Any) -> Finding:
    """A reason against the result."""
    return Finding(code, Level.WRONG, facts, subject)


def doubtful(code: str, subject: str = "", **facts: Any) -> Finding:
    """A warning: what costs accuracy or should be looked at."""
    return Finding(code, Level.DOUBTFUL, facts, subject)


def note(code: str, subject: str = "", **facts: Any) -> Finding:
    """A note, or advice."""
    return Finding(code, Level.NOTE, facts, subject)


def of_error(error: PkmcalError, level: Level = Level.WRONG, station: str | None = None) -> Finding:
    """An error as a finding, under the error's code."""
    facts = {} if station is None else {"station": station}
    return Finding(error.code, level, facts, error.where or "", error)


def first_error(findings: Sequence[Finding]) -> dict[str, Any]:
    """The parts of the first error among findings, for a command's JSON; empty without one."""
    errors = (one.error for one in findings if one.error is not None)
    return next((_parts_of(error) for error in errors), {})


def _parts_of(error: PkmcalError) -> dict[str, Any]:
    """All but the exit code, which is the command's."""
    return {name: value for name, value in error.as_dict().items() if name != "exit_code"}


@cache
def templates(area: str) -> dict[str, dict[str, str]]:
    """Templates of an area's codes, each with its text and perhaps a next step."""
    file = files("pkmcal.outcome") / "sentences" / f"{area}.toml"
    if not file.is_file():
        return {}
    entries: dict[str, str | dict[str, str]] = tomllib.loads(file.read_text(encoding="utf-8"))
    return {
        f"{area}.{name}": {"text": entry} if isinstance(entry, str) else entry
        for name, entry in entries.items()
    }


def fields_of(template: str) -> tuple[set[str], set[str]]:
    """Facts that a template needs, and those that it uses where they are given."""
    optional = set[str]()
    for part in _OPTIONAL_PART.findall(template):
        optional |= _names(part)
    return _names(_OPTIONAL_PART.sub("", template)), optional


def _names(template: str) -> set[str]:
    fields = [name for _, name, _, _ in Formatter().parse(template) if name]
    return {name for joint in fields for name in joint.split("+")}


def filled(template: str, facts: Mapping[str, Any]) -> str:
    """A template with its facts."""

    def part(match: re.Match[str]) -> str:
        given, _, otherwise = match[1].partition("||")
        there = all(facts.get(name) is not None for name in _names(given))
        return given if there else otherwise

    return _Fields().vformat(_OPTIONAL_PART.sub(part, template), (), facts)


def _number(value: Any) -> float:
    """A number; the length of a list."""
    return value if isinstance(value, int | float) else len(value)


def _choice(first: bool, rest: str) -> str:
    one, _, other = rest.partition("|")
    return one if first else other


def _either(noise: tuple[float, Sequence[str]], spec: str) -> str:
    size, units = noise
    display = [DISPLAY_UNITS[unit] for unit in ("m", "rad") if unit in units]
    return " or ".join(with_unit(format(size * scale, spec), name) for scale, name in display)


def _range(ends: tuple[float, float | None], _rest: str) -> str:
    low, high = ends
    return f"more than {low:.2g}" if high is None else f"{low:.2g} to {high:.2g}"


_FORMATS: dict[str, Callable[[Any, str], str]] = {
    "size": lambda x, rest: _Fields().format_field(abs(x), rest),
    "one": lambda x, rest: _choice(_number(x) == 1, rest),
    "sign": lambda x, rest: _choice(x > 0, rest),
    "case": lambda x, rest: dict(pair.split("=", 1) for pair in rest.split("|"))[str(x)],
    "listed": lambda x, rest: listed([str(name) for name in x], int(rest or 6)),
    "joined": lambda x, _: joined([str(name) for name in x]),
    "count": lambda x, rest: count(_number(x), rest),
    "amount": lambda x, rest: amount(abs(x), rest) if rest else amount(abs(x[0]), x[1]),
    "ratio": lambda x, _: ratio_in_per_cent(*x),
    "either": _either,
    "range": _range,
    "often": lambda x, _: how_often(x),
    "capital": lambda x, _: capital(x),
}


class _Fields(Formatter):
    """Fields with the formats of the module's table."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        """A fact, or several of them as a tuple."""
        del args
        several = tuple(kwargs[name] for name in field_name.split("+"))
        return (several if len(several) > 1 else several[0]), field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        """One value as text."""
        first, _, rest = format_spec.partition(" ")
        if first in _FORMATS:
            return _FORMATS[first](value, rest)
        if rest in _UNITS:
            return with_unit(format(value * _UNITS[rest], first), rest)
        return format(value, format_spec)
