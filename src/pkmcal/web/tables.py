"""Tables of outcomes, which the terminal prints as well, as blocks of the page."""

from __future__ import annotations

import math
import re
from itertools import zip_longest
from typing import Literal

from pkmcal.outcome import Table
from pkmcal.outcome.blocks.table import Column, DataTable, TableRow
from pkmcal.outcome.finding import Level
from pkmcal.wording import MINUS_SIGN, Chance

_LEADING_NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_PLAIN_DIGITS = str.maketrans({MINUS_SIGN: "-", "\N{NARROW NO-BREAK SPACE}": None})


def table_block(table: Table) -> DataTable:
    """Block of a table that the terminal prints as well."""
    marks = {row.mark for row in table.rows}
    # rows of one mark are all alike: then no sign is shown
    marked = len(marks) > 1 or marks == {Level.WRONG}
    return DataTable(
        title=table.title,
        columns=tuple(
            Column(name=name, form=_form(table, k), hint=hint)
            for k, (name, hint) in enumerate(zip_longest(table.columns, table.hints, fillvalue=""))
        ),
        rows=tuple(
            TableRow(
                cells=(row.name, *row.cells),
                values=tuple(map(_value, (row.name, *row.cells))),
                key=row.key,
                mark=row.mark if marked else None,
            )
            for row in table.rows
        ),
        note=table.note,
        folded=table.folded,
    )


def _form(table: Table, k: int) -> Literal["text", "number", "shade", "chance"]:
    """Form of a column."""
    if k == 0 or k in table.words:
        return "text"
    if any(isinstance(row.cells[k - 1], Chance) for row in table.rows):
        return "chance"
    return "shade" if k in table.shaded else "number"


def _value(text: str) -> float | None:
    """Number of a cell; None without one."""
    if isinstance(text, Chance):
        return text.value if math.isfinite(text.value) else None
    return leading_number(text)


def leading_number(text: str) -> float | None:
    """Number with which a text begins, such as that of ``−0.3 ± 0.1``; None without one."""
    match = _LEADING_NUMBER.match(text.translate(_PLAIN_DIGITS))
    value = float(match[0]) if match else math.nan
    return value if math.isfinite(value) else None
