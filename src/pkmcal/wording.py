"""Text for people: lists, counts, magnitudes with units, names of parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from datetime import datetime

MINUS_SIGN = "\N{MINUS SIGN}"
DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (180 / math.pi, "°")}
"""Factor and name of the unit shown in reports, by the SI unit used inside."""

LARGEST_DECIMALS = 6
"""Most decimals of a number."""
LEG_PARAMETER_NAME = re.compile(r"legs\[(\d+)\]\.(.+)")
"""Name of a leg's parameter: the leg's number and the rest of the path."""


def install_step(extra: str) -> str:
    """Instruction to install an optional dependency group of pyproject.toml; pkmcal is on no
    package index.
    """
    return f"In a copy of pkmcal's sources: pip install '.[{extra}]'"


def decimals(sigma: float) -> int:
    """Number of decimals that show ``sigma`` with two significant digits; 3 if it is not a positive
    number.
    """
    if not math.isfinite(sigma) or sigma <= 0:
        return 3
    exponent = int(f"{sigma:.1e}".partition("e")[2])  # after rounding: 0.0996 is 0.10
    return min(max(0, 1 - exponent), LARGEST_DECIMALS)


def number(value: float, places: int, signed: bool = False) -> str:
    """Number with a true minus sign and without negative zeros; a dash if it is not finite."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:.{places}f}"
    if float(text) == 0:
        return text.lstrip("-")
    if value < 0:
        return MINUS_SIGN + text[1:]
    return f"+{text}" if signed else text


def brief(value: float) -> str:
    """Positive magnitude with two significant digits, for headlines."""
    return number(value, decimals(value))


def amount(value: float, unit: str) -> str:
    """Positive magnitude in m or rad in its display unit, such as ``0.07 mm`` or ``0.3°``."""
    scale, name = DISPLAY_UNITS[unit]
    return with_unit(brief(value * scale), name)


def with_unit(text: str, unit: str) -> str:
    """Number and unit: ``0.07 mm``, ``0.3°``."""
    return text + unit if unit == "°" else f"{text} {unit}"


def count(n: float, thing: str) -> str:
    """Number of things: ``1 edge``, ``12 345 edges``, with narrow spaces between thousands."""
    text = f"{round(n):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return f"{text} {thing}" if round(n) == 1 else f"{text} {thing}s"


def split_name(name: str) -> tuple[int | None, str]:
    """Leg number, counted from 1 (None for a parameter of the whole machine), and the rest of a
    parameter's path.
    """
    match = LEG_PARAMETER_NAME.fullmatch(name)
    return (int(match[1]), match[2]) if match else (None, name)


def named(legs: Iterable[int], all_legs: int = 0) -> str:
    """Legs as text, ``leg 3``, ``legs 1, 2 and 5``, ``legs 1 to 6``, from indices that count from
    0.

    all_legs : number of legs of the machine; if given, a complete list becomes ``all legs``.
    """
    count = sorted({int(leg) + 1 for leg in legs})
    if len(count) == all_legs and all_legs > 1:
        return "all legs"
    if len(count) > 2 and count[-1] - count[0] == len(count) - 1:
        return f"legs {count[0]} to {count[-1]}"
    return ("leg " if len(count) == 1 else "legs ") + joined([str(n) for n in count])


def in_full(k: int) -> str:
    """Integer as a word up to twelve, above as digits."""
    words = ("no", "one", "two", "three", "four", "five", "six")
    words += ("seven", "eight", "nine", "ten", "eleven", "twelve")
    return words[k] if k < len(words) else str(k)


def ways(k: int) -> str:
    """Count of ways: ``in one way``, ``in six ways``."""
    return "in one way" if k == 1 else f"in {in_full(k)} ways"


def joined(words: Sequence[str]) -> str:
    """Words joined as ``a, b and c``."""
    return listed(words, len(words))


def listed(names: Sequence[str], longest: int = 6) -> str:
    """Names joined as "a, b and c", or as "a, b, c and 12 more" beyond ``longest``."""
    if len(names) <= 1:
        return "".join(names)
    if len(names) <= longest:
        return f"{', '.join(names[:-1])} and {names[-1]}"
    return f"{', '.join(names[: longest - 1])} and {len(names) - longest + 1} more"


def capital(text: str) -> str:
    """Text with its first letter as a capital."""
    return text[:1].upper() + text[1:]


def how_often(probability: float) -> str:
    """Frequency of a probability, ``once in 30 times``, or ``as a rule`` from one half on."""
    return f"once in {1 / probability:.0f} times" if probability < 0.5 else "as a rule"


def date_text(moment: datetime) -> str:
    """Day and time of a moment, ``30 November 2026, 14:05``."""
    return f"{moment.day} {moment:%B %Y, %H:%M}"


class Chance(str):
    """Text of a probability: ``34 %``, ``1 in 250``, ``< 1 in 10⁶``; a dash for NaN.

    value : the probability.
    """

    def __new__(cls, probability: float) -> Chance:
        """Text of a probability."""
        if not math.isfinite(probability):
            text = "–"
        elif probability >= 0.1:
            text = percentage(probability)
        elif probability >= 1e-6:
            often = 1 / probability
            places = max(0, math.floor(math.log10(often)) - 1)  # two significant digits
            text = f"1 in {round(often, -places):,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")
        else:
            text = f"{'<' if probability > 1e-7 else '≪'} 1 in 10⁶"
        return super().__new__(cls, text)

    def __init__(self, probability: float) -> None:
        self.value = probability

    def __getnewargs__(self) -> tuple[float]:  # type: ignore[override]
        """Argument with which a copy is made."""
        return (self.value,)


def percentage(share: float, decimals: int = 0) -> str:
    """Share in per cent, ``34 %``; a dash for NaN."""
    return f"{100 * share:.{decimals}f} %" if math.isfinite(share) else "–"


def percent(share: float) -> str:
    """Share as whole percent, rounded down so that it never claims certainty."""
    return f"{math.floor(100 * min(max(share, 0.0), 1.0))} %"


def ratio_in_per_cent(value: float, sigma: float) -> str:
    """Magnitude of a ratio in per cent, with its standard deviation if that is finite."""
    if not math.isfinite(sigma):
        return f"some {100 * abs(value):.1g} %"
    places = max(0, 1 - math.floor(math.log10(max(100 * sigma, 1e-6))))
    return f"{number(100 * abs(value), places)} ± {number(100 * sigma, places)} %"
