"""How a study's figures are held against what a paper reports, or an independent prototype gave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pkmcal.outcome import Check
from pkmcal.studies.engine import Key, StudyResult
from pkmcal.studies.statistics import Summary
from pkmcal.wording import number

PrintedFigures = Mapping[Key, Mapping[str, str]]
"""A prototype's figures as it prints them, by what was estimated how and by quantity."""
ASIDE = ", its Monte-Carlo error aside"


class Compared(NamedTuple):
    """One figure in its printed unit with its Monte-Carlo error, and the prototype's.

    rounding : half of the prototype's last digit. tolerance : relative difference that is one of
    the setting, not of the method. held : whether the setting leaves the two comparable.
    """

    key: Key
    quantity: str
    found: Summary
    expected: float
    rounding: float
    tolerance: float
    held: bool = True

    @property
    def differs(self) -> bool:
        """By more than two standard errors of the difference of two such simulations."""
        return abs(self.found.value - self.expected) > 2 * 2**0.5 * self.found.error + self.rounding

    @property
    def tolerable(self) -> bool:
        """Whether the difference is one of the setting, Monte-Carlo error aside."""
        allowed = self.tolerance * self.expected + 2 * self.found.error
        return abs(self.found.value - self.expected) <= allowed


def compared(
    study: StudyResult[Any],
    prototype: PrintedFigures,
    tolerance: Callable[[Key, str], float],
    held: Callable[[Key], bool] = lambda _: True,
) -> list[Compared]:
    """Every figure that the prototype gives."""
    out: list[Compared] = []
    for key, figures in prototype.items():
        for quantity, printed in figures.items():
            found = study.of(*key)[quantity].times(study.setting.quantities[quantity].factor)
            rounding = 0.5 * 10.0 ** -len(printed.partition(".")[2])
            allowed = tolerance(key, quantity)
            out.append(Compared(key, quantity, found, float(printed), rounding, allowed, held(key)))
    return out


def prototype_check(figures: list[Compared], within: str) -> Check:
    """Whether all figures that are held against the prototype's agree; within : in words."""
    held = [f for f in figures if f.held]
    bad = [
        f"{', '.join(f.key)}, {f.quantity}: {f.found.value:.3g} against {f.expected:g}"
        for f in held
        if not f.tolerable
    ]
    text = "; ".join(bad) or f"{len(held)} of {len(held)}"
    return Check("figures of the independent prototype", text, within, not bad)


def at_most(what: str, unit: str, found: Summary, most: float, places: int) -> Check:
    """A figure that may exceed a limit by its Monte-Carlo error alone."""
    space = "" if unit == "°" else " "
    return Check(
        what,
        f"{number(found.value, places)} ± {number(found.error, places)}{space}{unit}",
        f"≤ {most:g}{space}{unit}{ASIDE}",
        found.value - 2 * found.error <= most,
    )
