"""Table of a calibrated machine's parameters: one row each, as text, HTML or a DataFrame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.levels import MAJORITY, ROUNDING
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


def decided_by(table: ParameterTable, covariance: Array, data_share: Array) -> tuple[Decider, ...]:
    """Source of each parameter's value: data, drawing (the nominal model), frame or fixed.

    frame : the value only defines the result's frames.
    fixed : the mechanism file fixes it.

    covariance : (P, P).
    data_share : (P,) share of the information that comes from the data.
    """
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return tuple(
        "fixed" if name in table.fixed
        else "frame" if sigma[k] <= ROUNDING
        else "data" if data_share[k] >= MAJORITY
        else "drawing"
        for k, name in enumerate(table.names)
    )  # fmt: skip


@dataclass(frozen=True)
class ParameterEstimate:
    """One parameter: m, rad, or 1 for components of a direction and for ratios.

    drawing, value, sigma : nominal and calibrated value, and its standard deviation in the
    gauge of the result.
    data_share : share of the information that comes from the data; NaN where that is undefined.
    decided_by : see :func:`decided_by`.
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
        """Calibrated minus nominal value."""
        return self.value - self.drawing


@dataclass(frozen=True, repr=False)
class ParameterEstimates(Sequence[ParameterEstimate]):
    """All parameters in the order of the mechanism file, by number or by name."""

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
        """Row at a position or with a name, such as ``legs[1].base.center.z``; a table of the rows
        of a slice.

        Raises InputError, with the closest name, for an unknown name.
        """
        if isinstance(index, str):
            return self.rows[self.table.index(index)]
        if isinstance(index, slice):
            return ParameterEstimates(self.rows[index], self.table)
        return self.rows[index]

    def to_pandas(self) -> DataFrame:
        """DataFrame with one row a parameter, indexed by name, in m and rad. Needs pandas."""
        try:
            import pandas as pd
        except ImportError:
            raise InputError(
                "this table as a DataFrame needs pandas",
                next_step="Install it with: pip install pandas",
                code="package.missing",
            ) from None
        return pd.DataFrame(self.records(), columns=list(PARAMETER_ESTIMATE_COLUMNS)).set_index(
            "name"
        )

    def records(self) -> list[dict[str, str | float]]:
        """One mapping a row, with the keys PARAMETER_ESTIMATE_COLUMNS."""
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
        """Table as HTML, for notebooks."""
        head, *rows = self._cells()
        body = "".join(f"<tr>{_html_cells('td', row)}</tr>" for row in rows)
        return (
            f"<table><thead><tr>{_html_cells('th', head)}</tr></thead><tbody>{body}</tbody></table>"
        )

    def _cells(self) -> list[tuple[str, ...]]:
        """Heading and all rows as text, with as many digits as the standard deviations warrant."""
        out: list[tuple[str, ...]] = [
            ("parameter", "nominal", "calibrated", "sigma", "unit", "decided by")
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
                    "nominal model" if row.decided_by == "drawing" else row.decided_by,
                )
            )
        return out


def _html_cells(kind: str, row: tuple[str, ...]) -> str:
    """Cells of one row as HTML."""
    return "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row)


def parameter_estimates(
    nominal: Array, machine: Machine, covariance: Array, data_share: Array
) -> ParameterEstimates:
    """Table of a machine's parameters.

    nominal : (P,) nominal values.
    covariance : (P, P).
    data_share : (P,).
    """
    table = machine.parameters
    source = decided_by(table, covariance, data_share)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = (
        ParameterEstimate(
            name=name,
            unit=table.units[k],
            drawing=float(nominal[k]),
            value=float(machine.values[k]),
            sigma=float(sigma[k]),
            data_share=float(data_share[k]),
            decided_by=source[k],
        )
        for k, name in enumerate(table.names)
    )
    return ParameterEstimates(tuple(rows), table)
