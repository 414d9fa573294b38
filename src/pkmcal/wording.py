"""Words and numbers for people: lists, counts, magnitudes, parameters' names."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

MINUS_SIGN = "\N{MINUS SIGN}"
DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (180 / math.pi, "°")}
"""Factor and name of the unit that the report shows, by the unit inside."""

LARGEST_DECIMALS = 6
LEG_PARAMETER_NAME = re.compile(r"legs\[(\d+)\]\.(.+)")


def install_step(extra: str) -> str:
    """How to install what an extra of pyproject.toml names; no registry has a release of pkmcal."""
    return f"In a copy of pkmcal's sources: pip install '.[{extra}]'"


def decimals(sigma: float) -> int:
    """Decimals that show ``sigma`` with two significant digits; 3 where it has none."""
    if not math.isfinite(sigma) or sigma <= 0:
        return 3
    exponent = int(f"{sigma:.1e}".partition("e")[2])  # after rounding: 0.0996 is 0.10
    return min(max(0, 1 - exponent), LARGEST_DECIMALS)


def number(value: float, places: int, signed: bool = False) -> str:
    """A number with a true minus sign; never a negative zero; a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:.{places}f}"
    if float(text) == 0:
        return text.lstrip("-")
    if value < 0:
        return MINUS_SIGN + text[1:]
    return f"+{text}" if signed else text


def brief(value: float) -> str:
    """A positive magnitude with two significant digits, for headlines."""
    return number(value, decimals(value))


def amount(value: float, unit: str) -> str:
    """A positive magnitude in m or rad, as ``0.07 mm`` or ``0.3°``."""
    scale, name = DISPLAY_UNITS[unit]
    return with_unit(brief(value * scale), name)


def with_unit(text: str, unit: str) -> str:
    """``0.07 mm``, ``0.3°``."""
    return text + unit if unit == "°" else f"{text} {unit}"


def count(n: float, thing: str) -> str:
    """``1 edge``, ``12 345 edges``; thousands apart by a narrow space."""
    text = f"{round(n):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return f"{text} {thing}" if round(n) == 1 else f"{text} {thing}s"


def split_name(name: str) -> tuple[int | None, str]:
    """Leg number from 1 (None where the parameter has none) and what is left of the path."""
    match = LEG_PARAMETER_NAME.fullmatch(name)
    return (int(match[1]), match[2]) if match else (None, name)


def named(legs: Iterable[int], all_legs: int = 0) -> str:
    """``leg 3``, ``legs 1, 2 and 5``, ``legs 1 to 6``, from numbers that count from 0; ``all legs``
    where their number is given.
    """
    count = sorted({int(leg) + 1 for leg in legs})
    if len(count) == all_legs and all_legs > 1:
        return "all legs"
    if len(count) > 2 and count[-1] - count[0] == len(count) - 1:
        return f"legs {count[0]} to {count[-1]}"
    return ("leg " if len(count) == 1 else "legs ") + joined([str(n) for n in count])


def in_full(k: int) -> str:
    """Small numbers as words."""
    words = ("no", "one", "two", "three", "four", "five", "six")
    words += ("seven", "eight", "nine", "ten", "eleven", "twelve")
    return words[k] if k < len(words) else str(k)


def ways(k: int) -> str:
    """``in one way``, ``in six ways``."""
    return "in one way" if k == 1 else f"in {in_full(k)} ways"


def joined(words: Sequence[str]) -> str:
    """``a, b and c``."""
    return listed(words, len(words))


def listed(names: Sequence[str], longest: int = 6) -> str:
    """Join names for a sentence: "a, b and c", or "a, b, c and 12 more"."""
    if len(names) <= 1:
        return "".join(names)
    if len(names) <= longest:
        return f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{', '.join(names[: longest - 1])} and {len(names) - longest + 1} more"


def capital(text: str) -> str:
    """The beginning of a sentence."""
    return text[:1].upper() + text[1:]


def how_often(probability: float) -> str:
    """``once in 30 times``, or ``as a rule``."""
    return f"once in {1 / probability:.0f} times" if probability < 0.5 else "as a rule"


def percent(share: float) -> str:
    """A share as whole percent, never rounded up to a certainty it has not."""
    return f"{math.floor(100 * min(max(share, 0.0), 1.0))} %"


def ratio_in_per_cent(value: float, sigma: float) -> str:
    """The size of a ratio in per cent, with its standard deviation where that is known."""
    if not math.isfinite(sigma):
        return f"some {100 * abs(value):.1g} %"
    places = max(0, 1 - math.floor(math.log10(max(100 * sigma, 1e-6))))
    return f"{number(100 * abs(value), places)} ± {number(100 * sigma, places)} %"
