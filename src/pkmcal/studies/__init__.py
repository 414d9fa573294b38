"""The papers' own figures, computed again: one module ``paper_x`` a paper.

Each has ``reproduce(options) -> Reproduction``; ``pkmcal reproduce`` shows what it returns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from pkmcal.report.reproduction import Reproduction


def _silent(_text: str, _share: float) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Options:
    """What a person may choose. runs : of the Monte-Carlo simulation. long : also what takes
    minutes. photographs : also what is measured on rendered photographs. told : called with
    the step in words and the share done.
    """

    runs: int = 100
    seed: int = 0
    long: bool = False
    photographs: bool = False
    told: Callable[[str, float], None] = _silent


def reproduce(paper: str, options: Options) -> Reproduction:
    """One paper's figures beside ours. paper : its letter, small."""
    return import_module(f"pkmcal.reproduce.paper_{paper}").reproduce(options)
