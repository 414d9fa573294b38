"""Names of legs and parameters, and counts, as sentences say them."""

from __future__ import annotations

import re
from collections.abc import Iterable

MOST_NAMES = 4
NAMES = {
    "length.offset": "offset",
    "length.constant": "length",
    "base.arm": "arm",
    "base.angle": "crank angle",
    "base.along": "place along its axis",
    "base.radial": "axis' distance from its centre",
}
"""What a leg's numbers are called."""


def named(legs: Iterable[int]) -> str:
    """``leg 3``, ``legs 1, 2 and 5``, ``legs 1 to 6``, from numbers that count from 0."""
    found = sorted({leg + 1 for leg in legs})
    if len(found) > 2 and found[-1] - found[0] == len(found) - 1:
        return f"legs {found[0]} to {found[-1]}"
    return ("leg " if len(found) == 1 else "legs ") + joined([str(n) for n in found])


def joined(words: list[str]) -> str:
    """``a, b and c``."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def parameter(name: str) -> str:
    """A parameter in words: ``z of leg 3's base joint``, ``leg 2's offset``."""
    match = re.fullmatch(r"legs\[(\d+)\]\.(.+)", name)
    if not match:
        return name
    leg, path = f"leg {match[1]}'s", match[2]
    if found := re.fullmatch(r"(base|platform)\.(center|axis)\.([xyz])", path):
        what = "joint" if found[2] == "center" else "axis"
        return f"{found[3]} of {leg} {found[1]} {what}"
    if found := re.fullmatch(r"tubes\[(\d+)\]\.radius", path):
        return f"the radius of {leg} tube {found[1]}"
    if found := re.fullmatch(r"platform\.hinge\.([xyz])", path):
        return f"{found[1]} of {leg} hinge"
    return f"{leg} {NAMES.get(path, path.replace('.', ' '))}"


def listed(names: tuple[str, ...]) -> str:
    """The first parameters in words, the others counted."""
    words = [parameter(name) for name in names[:MOST_NAMES]]
    if len(names) > MOST_NAMES:
        return f"{', '.join(words)} and {len(names) - MOST_NAMES} more"
    return joined(words)


def ways(k: int) -> str:
    """``in one way``, ``in six ways``."""
    return "in one way" if k == 1 else f"in {count(k)} ways"


def count(k: int) -> str:
    """Small numbers as words."""
    words = ("no", "one", "two", "three", "four", "five", "six")
    words += ("seven", "eight", "nine", "ten", "eleven", "twelve")
    return words[k] if k < len(words) else str(k)
