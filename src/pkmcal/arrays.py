"""Array types, short reprs of dataclasses that hold arrays, small array helpers, and the number of
worker threads.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Integers = NDArray[np.integer[Any]]
Booleans = NDArray[np.bool_]
THREADS = 2
"""Worker threads for decoding images and for array work, both of which release Python's lock."""


def rms(values: Array) -> float:
    """Root mean square over all elements; NaN for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def with_zero(values: Array) -> Array:
    """Values (B, n) followed by a zero, (B, n + 1): index n stands for no value.

    As ``np.pad`` does, at a tenth of its time for short rows.
    """
    return np.concatenate([values, np.zeros((len(values), 1))], axis=1)


def evenly(count: int, most: int) -> Integers:
    """Indices of at most ``most`` of ``count`` items, evenly spaced, first and last included."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def numbered(names: Iterable[Hashable]) -> Integers:
    """Integer labels (n,) of possibly repeated items, numbered in the order of first occurrence."""
    number: dict[Hashable, int] = {}
    return np.array([number.setdefault(name, len(number)) for name in names], dtype=int)


LONGEST_VALUE = 40
"""Longest value, in characters, that a short repr shows in full."""


def short_repr(self: Any) -> str:
    """Short repr of a dataclass: arrays are shown by their shape, long collections and dataclasses
    by their type.

    For use as ``__repr__`` in a dataclass's body.
    """
    parts = (f"{one.name}={_short(getattr(self, one.name))}" for one in fields(self) if one.repr)
    return f"{type(self).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    """Repr of one field's value, at most LONGEST_VALUE characters."""
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


def enlargement(lengths: Array, wanted: float) -> float:
    """Round magnification for lengths (n,): 1, 2 or 5 times a power of ten, at least 1.

    The 90 % quantile comes as near ``wanted`` as it can from below.
    """
    large = float(np.quantile(lengths, 0.9)) if lengths.size else wanted
    ratio = max(wanted / max(large, 1e-9), 1.0)
    power = 10.0 ** math.floor(math.log10(ratio))
    return max(m * power for m in (1, 2, 5) if m * power <= ratio * (1 + 1e-9))
