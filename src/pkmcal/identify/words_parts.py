"""What was found of the space that data leave open, put together where it makes one sentence."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.words_families import Family
from pkmcal.identify.words_text import naming


class Part(NamedTuple):
    """Families with one text.

    space : (k, P) changes that they explain, scaled. coefficients : (k, m) the family's own numbers
    for them; own : (k, P) what these change, scaled, which differs from ``space`` by frames.
    new : how many of the k nobody said before.
    """

    families: tuple[Family, ...]
    space: Array
    coefficients: Array
    own: Array
    new: int


ONE_SENTENCE = (
    "unseen",
    "common turn",
    "axis",
    "slide",
    "rod",
    "centre",
    "leg",
    "radius",
    "depth",
    "leg sizes",
    "lean",
)
"""Kinds that are said of several legs at once where they say the same of each."""


def merged(parts: list[Part]) -> list[Part]:
    """Parts of one kind for several legs as one."""
    out: dict[tuple[object, ...], Part] = {}
    for place, part in enumerate(parts):
        family = part.families[0]
        key: tuple[object, ...] = (place,)
        if family.kind in ONE_SENTENCE:
            key = (family.kind, family.among, len(part.space), naming(family, part.coefficients))
        if key not in out:
            out[key] = part
            continue
        old = out[key]
        space = np.concatenate([old.space, part.space])
        numbers = _stacked(old.coefficients, part.coefficients)
        own = np.concatenate([old.own, part.own])
        out[key] = Part(old.families + part.families, space, numbers, own, old.new + part.new)
    return [_with_last_leg(part, parts) for part in out.values()]


def _with_last_leg(part: Part, parts: list[Part]) -> Part:
    """Sizes of all legs but one, of which the common part was said before, are those of all."""
    first, legs = part.families[0], {leg for family in part.families for leg in family.legs}
    whole = [p.families[0] for p in parts if p.families[0].kind == "sizes"]
    alike = next((family.legs for family in whole if family.among == first.among), ())
    if first.kind != "leg sizes" or len(legs) != len(alike) - 1:
        return part
    last = replace(first, legs=tuple(leg for leg in alike if leg not in legs))
    return part._replace(families=(*part.families, last))


def _stacked(a: Array, b: Array) -> Array:
    """Rows of both; legs may differ in their numbers: of tubes, and passive ones have no length."""
    width = max(a.shape[1], b.shape[1])
    return np.concatenate([np.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in (a, b)])
