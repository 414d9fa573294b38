"""The one array type of the project, so that signatures stay readable, what it is told as, its
plain figures, and how many threads work on arrays.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Integers = NDArray[np.integer[Any]]
Booleans = NDArray[np.bool_]
THREADS = 2
"""Threads beside one another: decoding and array work release Python's lock."""


def rms(values: Array) -> float:
    """Root mean square of all values; NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def evenly(count: int, most: int) -> Integers:
    """Numbers of up to ``most`` of so many things in a row, evenly, the first and the last too."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def numbered(names: Iterable[Hashable]) -> Integers:
    """Numbers (n,) of things that may be alike, in the order in which each is first named."""
    number: dict[Hashable, int] = {}
    return np.array([number.setdefault(name, len(number)) for name in names], dtype=int)


LONGEST_VALUE = 40
"""Characters of a value that a short repr shows."""


def short_repr(self: Any) -> str:
    """The repr of a dataclass that holds arrays: of these their shapes, of what is long its kind.

    For use as ``__repr__`` in a dataclass's body.
    """
    parts = (f"{one.name}={_short(getattr(self, one.name))}" for one in fields(self) if one.repr)
    return f"{type(self).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<{' × '.join(map(str, value.shape)) or 'one number'}>"
    if is_dataclass(value):
        return f"<{type(value).__name__}>"
    if isinstance(value, Collection) and not isinstance(value, str | bytes):
        inside = next((item for item in value), None)
        if is_dataclass(inside) or len(repr(value)) > LONGEST_VALUE:
            return f"<{type(value).__name__} of {len(value)}>"
    text = repr(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 1]}…"
