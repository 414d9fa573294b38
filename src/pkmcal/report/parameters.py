"""Report sections on the parameters: their table, their correlations, and unidentified ones."""

from __future__ import annotations

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
from pkmcal.identify.unidentified import Identification
from pkmcal.levels import INSEPARABLE_CORRELATION, OUTLIER_SIGMAS, ROUNDING
from pkmcal.mechanisms import Machine, ParameterTable
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import leg_key
from pkmcal.outcome.blocks.table import Column, DataTable, Filter, TableRow
from pkmcal.outcome.blocks.text import Download, Downloads
from pkmcal.outcome.finding import Level
from pkmcal.report.parameter_changes import changes
from pkmcal.wording import (
    DISPLAY_UNITS,
    capital,
    decimals,
    joined,
    listed,
    named,
    number,
    percent,
    split_name,
)

MOST_TIGHT_PAIRS = 6
MOST_BY_NOMINAL = 12
"""Names in the sentence on parameters that the nominal model decides."""
PARAMETER_SOURCES = {
    "data": "data",
    "drawing": "nominal",
    "frame": "frame",
    "fixed": "fixed",
}
"""Mark in the table by the source's key."""
HELD_SOURCES = ("frame", "fixed")
HELD_TAG, SIGNIFICANT_TAG = "held", "significant"
PARAMETER_KIND_NAMES = {
    "center": "centres",
    "offset": "offsets",
    "scale": "scales",
    "radius": "radii",
    "axis": "axes",
    "arm": "arms",
    "angle": "angles",
}


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
    def mark_text(self) -> str:
        """Mark of the source in the table."""
        return PARAMETER_SOURCES[self.source]

    @property
    def share_text(self) -> str:
        """Share in percent, empty where it is not defined."""
        return percent(self.share) if np.isfinite(self.share) else ""


def section(nominal: Machine, estimate: Estimate) -> Part:
    """Section with the table of parameters."""
    estimates = parameter_estimates(
        nominal.values, estimate.machine, estimate.covariance, estimate.data_share
    )
    files = Downloads(
        files=(
            Download(
                name="parameters.csv", media_type="text/csv", content=parameters_csv(estimates)
            ),
            Download(
                name="parameters.json",
                media_type="application/json",
                content=json_text({"parameters": estimates.records()}),
            ),
        )
    )
    return Part(
        "parameters",
        "Parameters",
        _by_nominal(estimates),
        blocks=(*changes(estimates), parameter_table(estimates, estimate.gauge), files),
    )


def _by_nominal(estimates: ParameterEstimates) -> tuple[str, ...]:
    """Sentence on the parameters that the nominal model decides more than the data do."""
    names = tuple(one.name for one in estimates if one.decided_by == "drawing")
    if not names:
        return ()
    words = listed(grouped(estimates.table, names), MOST_BY_NOMINAL)
    return (
        "The data determine these less than the nominal model's tolerances do, so their values"
        f" are mostly the nominal ones: {words}.",
    )


def parameter_table(estimates: ParameterEstimates, gauge: str) -> DataTable:
    """Table of all parameters in the order of the file; gauge : of the result, in words.

    Values that define the frames or that the file fixes are hidden at first.
    """
    rows = [_row(estimates.table, k, one) for k, one in enumerate(estimates)]
    legs = dict.fromkeys(row.leg for row in rows if row.leg)
    kinds = dict.fromkeys(estimates.table.kinds)
    filters = [
        *(Filter(tag=f"leg {leg}", label=f"Leg {leg}", group="leg") for leg in legs),
        *(
            Filter(tag=kind, label=PARAMETER_KIND_NAMES.get(kind, kind), group="kind")
            for kind in kinds
        ),
        Filter(tag=SIGNIFICANT_TAG, label=f"|change| > {OUTLIER_SIGMAS:g} σ"),
    ]
    if any(row.source in HELD_SOURCES for row in rows):
        filters.append(Filter(tag=HELD_TAG, label="also frame and fixed values", hides=True))
    return DataTable(
        title="",
        columns=(
            Column(name="Leg", form="leg"),
            Column(name="Parameter", form="text"),
            Column(name="Nominal"),
            Column(name="Calibrated"),
            Column(name="Change", by_size=True),
            Column(name="σ", hint="Standard deviation of the calibrated value"),
            Column(
                name="Change/σ",
                hint="Change in standard deviations of the calibrated value",
                by_size=True,
            ),
            Column(name="Unit", form="text"),
            Column(
                name="Source", form="share", hint="What decides the value, and the data's share"
            ),
        ),
        rows=tuple(
            _table_row(row, kind) for row, kind in zip(rows, estimates.table.kinds, strict=True)
        ),
        note=f"The frames of base and platform are conventions ({gauge}): coordinates that define"
        " them have no uncertainty of their own. Source nominal: the data determine less than the"
        " nominal model's tolerance already did. Copies hold all digits, in the units shown, and"
        " the names of the mechanism file.",
        filters=tuple(filters),
    )


def _table_row(row: ParameterRow, kind: str) -> TableRow:
    """Row of the table; kind : of the parameter."""
    change, sigma = row.numbers[2:]
    in_sigmas = change / sigma if sigma else None
    significant = in_sigmas is not None and abs(in_sigmas) > OUTLIER_SIGMAS
    held = row.source in HELD_SOURCES
    share = row.share if np.isfinite(row.share) else None
    return TableRow(
        cells=(
            str(row.leg or "–"),
            f"{row.label} (tied)" if row.note else row.label,
            row.nominal,
            row.calibrated,
            row.change,
            row.sigma,
            number(in_sigmas, 1, signed=True) if in_sigmas is not None else "–",
            row.unit,
            f"{row.mark_text} {row.share_text}".strip(),
        ),
        values=(row.leg, None, *row.numbers[:3], sigma or None, in_sigmas, None, share),
        key=leg_key(row.leg),
        name=row.name,
        hint=f"{row.name}; {row.note}" if row.note else row.name,
        mark=Level.DOUBTFUL if row.source == "drawing" else None,
        tags=tuple(
            tag
            for tag, has in (
                (f"leg {row.leg}", row.leg is not None),
                (kind, True),
                (SIGNIFICANT_TAG, significant),
                (HELD_TAG, held),
            )
            if has
        ),
        quiet=held,
    )


def parameters_csv(estimates: ParameterEstimates) -> str:
    """CSV table in SI units with all digits."""
    stream, rows = io.StringIO(), estimates.records()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


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


def unidentified(estimate: Estimate, identification: Identification) -> tuple[str, ...]:
    """Sentences on unidentifiable and weakly determined directions, then on correlated pairs."""
    out = (f"{s.text} {s.advice}" for s in (*identification.unidentified, *identification.weak))
    return (*out, *bound_together(estimate, identification))


def bound_together(
    estimate: Estimate, identification: Identification | None = None
) -> tuple[str, ...]:
    """Sentences on tightly correlated pairs.

    Pairs that a finding already names together are left out.
    """
    table = estimate.machine.parameters
    names = table.names
    unidentified_directions = () if identification is None else identification.unidentified
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
    """Pairs of parameters (i, j, correlation) that are hardly distinguished, the tightest first."""
    free, rho, pairs = correlations(estimate)
    i, j = np.nonzero(pairs & (np.abs(rho) > INSEPARABLE_CORRELATION))
    order = np.argsort(-np.abs(rho[i, j]), kind="stable")
    return [(int(free[i[n]]), int(free[j[n]]), float(rho[i[n], j[n]])) for n in order]
