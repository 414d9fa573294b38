"""The parameters of a calibrated machine as a table: one row each, for people and for pandas."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.mechanisms import Machine, ParameterTable
from pkmcal.wording import LARGEST_DECIMALS, decimals, number

if TYPE_CHECKING:
    from pandas import DataFrame


PARAMETER_ESTIMATE_COLUMNS = (
    "name", "unit", "drawing", "value", "change", "sigma", "data_share", "decided_by",
)  # fmt: skip
REPR_ROWS = 12
"""Rows of the table that its repr shows."""
Decider = Literal["data", "drawing", "frame", "fixed"]

DATA_DECIDES_SHARE = 0.5
"""Share of what is known that has to come from the data for the value to be theirs."""
ROUNDING_SIGMA = 1e-9
"""Standard deviations (m or rad) below this are zero but for rounding: a nanometre."""


def decided_by(table: ParameterTable, covariance: Array, data_share: Array) -> tuple[Decider, ...]:
    """What decides each of the parameters: covariance (P, P), and the data's share (P,).

    frame : the value only defines the result's frames. fixed : the mechanism file holds it.
    """
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return tuple(
        "fixed" if name in table.fixed
        else "frame" if sigma[k] <= ROUNDING_SIGMA
        else "data" if data_share[k] >= DATA_DECIDES_SHARE
        else "drawing"
        for k, name in enumerate(table.names)
    )  # fmt: skip


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter, m, rad, or 1 of a direction's components and of ratios.

    drawing, value, sigma : before, as calibrated, and its standard deviation in the result's
    frames. data_share : of what is known, from the data; NaN where that means nothing.
    decided_by : data, drawing, frame (of the result) or fixed.
    """

    name: str
    unit: str
    drawing: float
    value: float
    sigma: float
    data_share: float
    decided_by: Decider

    @property
    def change(self) -> float:
        """Calibrated less drawing."""
        return self.value - self.drawing


@dataclass(frozen=True, repr=False)
class ParameterEstimates(Sequence[ParameterEstimate]):
    """All parameters in the order of the mechanism file; by number, or by name."""

    rows: tuple[ParameterEstimate, ...]
    table: ParameterTable

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[ParameterEstimate]:
        return iter(self.rows)

    @overload
    def __getitem__(self, index: int | str) -> ParameterEstimate: ...
    @overload
    def __getitem__(self, index: slice) -> ParameterEstimates: ...
    def __getitem__(self, index: int | str | slice) -> ParameterEstimate | ParameterEstimates:
        """A row by its place or its name, such as ``legs[1].base.center.z``; InputError names the
        closest name otherwise. Of a slice, those rows.
        """
        if isinstance(index, str):
            return self.rows[self.table.index(index)]
        if isinstance(index, slice):
            return ParameterEstimates(self.rows[index], self.table)
        return self.rows[index]

    def to_pandas(self) -> DataFrame:
        """A DataFrame, one row a parameter by its name, in m and rad. Needs pandas."""
        try:
            import pandas as pd
        except ImportError:
            raise InputError(
                "this table as a DataFrame needs pandas",
                next_step="Install it with: pip install pandas",
            ) from None
        return pd.DataFrame(self.records(), columns=list(PARAMETER_ESTIMATE_COLUMNS)).set_index(
            "name"
        )

    def records(self) -> list[dict[str, str | float]]:
        """One mapping a row, by PARAMETER_ESTIMATE_COLUMNS."""
        return [
            {name: getattr(row, name) for name in PARAMETER_ESTIMATE_COLUMNS} for row in self.rows
        ]

    def __str__(self) -> str:
        return self._text(len(self.rows))

    def __repr__(self) -> str:
        return self._text(REPR_ROWS)

    def _text(self, most: int) -> str:
        """The first rows as text, in columns."""
        head, *rows = self._cells()
        wide = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
        remainder = (0, len(head) - 1)
        lines = [
            "  ".join(
                cell.ljust(wide[k]) if k in remainder else cell.rjust(wide[k])
                for k, cell in enumerate(row)
            ).rstrip()
            for row in (head, *rows[:most])
        ]
        if len(rows) > most:
            lines.append(f"… and {len(rows) - most} more; print() shows all")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        head, *rows = self._cells()
        body = "".join(f"<tr>{_html_cells('td', row)}</tr>" for row in rows)
        return (
            f"<table><thead><tr>{_html_cells('th', head)}</tr></thead><tbody>{body}</tbody></table>"
        )

    def _cells(self) -> list[tuple[str, ...]]:
        """The heading and all rows as text, with digits that mean something."""
        out: list[tuple[str, ...]] = [
            ("parameter", "drawing", "calibrated", "sigma", "unit", "decided by")
        ]
        for row in self.rows:
            places = decimals(row.sigma) if row.sigma else LARGEST_DECIMALS
            out.append(
                (
                    row.name,
                    number(row.drawing, places),
                    number(row.value, places),
                    number(row.sigma, places) if row.sigma else "",
                    row.unit,
                    row.decided_by,
                )
            )
        return out


def _html_cells(kind: str, row: tuple[str, ...]) -> str:
    return "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row)


def parameter_estimates(
    drawing: Array, machine: Machine, covariance: Array, data_share: Array
) -> ParameterEstimates:
    """The table. drawing : (P,) values before. covariance : (P, P). data_share : (P,)."""
    table = machine.parameters
    source = decided_by(table, covariance, data_share)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = (
        ParameterEstimate(
            name=name,
            unit=table.units[k],
            drawing=float(drawing[k]),
            value=float(machine.values[k]),
            sigma=float(sigma[k]),
            data_share=float(data_share[k]),
            decided_by=source[k],
        )
        for k, name in enumerate(table.names)
    )
    return ParameterEstimates(tuple(rows), table)
