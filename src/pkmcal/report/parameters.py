"""Report sections on the parameters: their table, their correlations, and unidentified ones."""

from __future__ import annotations

import base64
import csv
import io
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.files import json_text
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.parameter_estimates import (
    ParameterEstimate,
    ParameterEstimates,
    parameter_estimates,
)
from pkmcal.identify.unidentified import Findings
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms import Machine, ParameterTable
from pkmcal.outcome import Part
from pkmcal.pages import page
from pkmcal.report.parameter_changes import changes
from pkmcal.wording import (
    DISPLAY_UNITS,
    capital,
    decimals,
    joined,
    named,
    number,
    percent,
    split_name,
)

TIGHT_CORRELATION = 0.95
"""Correlation of two parameters above which a sentence reports it.

At this value their combination is known 3.2 times better than each alone.
"""
MOST_TIGHT_PAIRS = 6
PARAMETER_SOURCES = {
    "data": ("data", "the data decide"),
    "drawing": ("nominal", "the nominal model decides more than the data"),
    "frame": ("frame", "defines the frame"),
    "fixed": ("fixed", "kept at the nominal model's value"),
}
"""Mark in the table, and sentence, by the source's key."""


@dataclass(frozen=True)
class ParameterRow:
    """Parameter as the table shows it; texts have meaningful digits, numbers are for sorting.

    leg : from 1, None for parameters of no leg.
    source : key of ``PARAMETER_SOURCES``.
    share : share of the information that comes from the data; NaN where it is not defined.
    note : ties, in words.
    """

    name: str
    leg: int | None
    label: str
    unit: str
    nominal: str
    calibrated: str
    change: str
    sigma: str
    numbers: tuple[float, float, float, float]
    source: str
    share: float
    note: str

    @property
    def source_text(self) -> str:
        """Source in words."""
        return PARAMETER_SOURCES[self.source][1]

    @property
    def mark_text(self) -> str:
        """Mark of the source in the table."""
        return PARAMETER_SOURCES[self.source][0]

    @property
    def share_text(self) -> str:
        """Share in percent, empty where it is not defined."""
        return percent(self.share) if np.isfinite(self.share) else ""


@dataclass(frozen=True)
class ParameterGroup:
    """Rows of one leg, or of the machine for leg None."""

    leg: int | None
    rows: tuple[ParameterRow, ...]


def section(nominal: Machine, estimate: Estimate) -> Part:
    """Section with the table of parameters."""
    estimates = parameter_estimates(
        nominal.values, estimate.machine, estimate.covariance, estimate.data_share
    )
    groups = parameter_groups(estimates)
    html = page.filled_template(
        "parameters.html.j2",
        groups=groups,
        downloads={
            "parameters.csv": _data_url("text/csv", parameters_csv(estimates)),
            "parameters.json": _data_url(
                "application/json", json_text({"parameters": estimates.records()})
            ),
        },
        gauge=estimate.gauge,
    )
    return Part("parameters", "Parameters", blocks=changes(estimates), html=html)


def parameters_csv(estimates: ParameterEstimates) -> str:
    """CSV table in SI units with all digits."""
    stream, rows = io.StringIO(), estimates.records()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def _data_url(kind: str, text: str) -> str:
    """Data URL of a text."""
    packed = base64.b64encode(text.encode("utf-8")).decode("ascii")
    return f"data:{kind};charset=utf-8;base64,{packed}"


def parameter_groups(estimates: ParameterEstimates) -> tuple[ParameterGroup, ...]:
    """All parameters, grouped by leg, in the order of the file."""
    rows = [_row(estimates.table, k, one) for k, one in enumerate(estimates)]
    legs = list(dict.fromkeys(row.leg for row in rows))
    return tuple(ParameterGroup(leg, tuple(r for r in rows if r.leg == leg)) for leg in legs)


def _row(table: ParameterTable, k: int, one: ParameterEstimate) -> ParameterRow:
    """Row of a parameter."""
    factor, unit = DISPLAY_UNITS.get(one.unit, (1.0, one.unit.replace("1", "")))
    sigma = one.sigma if one.sigma > ROUNDING else 0.0
    numbers = (one.drawing * factor, one.value * factor, one.change * factor, sigma * factor)
    places = decimals(numbers[3])
    others = [n for group in table.tied if one.name in group for n in group if n != one.name]
    return ParameterRow(
        name=one.name,
        leg=split_name(one.name)[0],
        label=table.labels[k],
        unit=unit,
        nominal=number(numbers[0], places),
        calibrated=number(numbers[1], places),
        change=number(numbers[2], places, signed=True),
        sigma=number(numbers[3], places) if sigma else "–",
        numbers=numbers,
        source=one.decided_by,
        share=one.data_share if sigma else float("nan"),
        note=f"changes together with {joined(others)}" if others else "",
    )


def unidentified(estimate: Estimate, findings: Findings) -> tuple[str, ...]:
    """Sentences on unidentifiable and weakly determined directions, then on correlated pairs."""
    out = (f"{s.text} {s.advice}" for s in (*findings.unidentified, *findings.weak))
    return (*out, *bound_together(estimate, findings))


def bound_together(estimate: Estimate, findings: Findings | None = None) -> tuple[str, ...]:
    """Sentences on tightly correlated pairs.

    Pairs that a finding already names together are left out.
    """
    table = estimate.machine.parameters
    names = table.names
    unidentified_directions = () if findings is None else findings.unidentified
    named_together = [{_whole_axis(name) for name in s.parameters} for s in unidentified_directions]
    pairs = [
        (names[i], names[j], rho)
        for i, j, rho in tight_pairs(estimate)
        if not any({_whole_axis(names[i]), _whole_axis(names[j])} <= s for s in named_together)
    ]
    return tuple(
        f"{capital(table.in_words(first))} and {table.in_words(second)} move together (correlation "
        f"{number(rho, 3)}): their {'difference' if rho > 0 else 'sum'} is known far better than"
        " each alone."
        for first, second, rho in pairs[:MOST_TIGHT_PAIRS]
    )


def _whole_axis(name: str) -> str:
    """Axis of which a parameter is a component; other parameters unchanged."""
    whole = name.rpartition(".")[0]
    return whole if whole.endswith("axis") else name


def grouped(table: ParameterTable, names: tuple[str, ...]) -> list[str]:
    """Names in words, with a common entry for three or more legs: ``hinge y of legs 1 to 4``."""
    legs: dict[str, list[int]] = {}
    for name in names:
        leg, path = split_name(name)
        legs.setdefault(path, []).append(leg or 0)
    out: list[str] = []
    for name in names:
        leg, path = split_name(name)
        several = len(legs[path]) > 2
        if not several:
            out.append(table.in_words(name))
        elif leg == legs[path][0]:
            label = table.labels[table.index(name)]
            out.append(f"{label} of {named(j - 1 for j in legs[path])}")
    return out


def correlations(estimate: Estimate) -> tuple[Integers, Array, Booleans]:
    """Free parameters (n,), their correlations (n, n), and a mask (n, n) of the pairs that matter.

    The mask has each pair once, i < j. Of tied parameters the first stands for all; correlations
    among the components of one axis are excluded, since its unit length implies them.
    """
    table, sigma = estimate.machine.parameters, np.sqrt(np.diag(estimate.covariance).clip(0))
    again = {name for group in table.tied for name in group[1:]}
    own = np.array([name not in again for name in table.names], dtype=bool)
    # parameters with a standard deviation, the first of each tie
    free = np.flatnonzero((sigma > ROUNDING) & own)
    rho = estimate.covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free])
    whole = np.array([_whole_axis(table.names[k]) for k in free])
    return free, rho, np.triu(whole[:, None] != whole, 1)


def tight_pairs(estimate: Estimate) -> list[tuple[int, int, float]]:
    """Pairs of parameters (i, j, correlation) above ``TIGHT_CORRELATION``, the tightest first."""
    free, rho, pairs = correlations(estimate)
    i, j = np.nonzero(pairs & (np.abs(rho) > TIGHT_CORRELATION))
    order = np.argsort(-np.abs(rho[i, j]), kind="stable")
    return [(int(free[i[n]]), int(free[j[n]]), float(rho[i[n], j[n]])) for n in order]
