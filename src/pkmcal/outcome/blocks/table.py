"""Block of a table that can be sorted, filtered and copied."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Key, Text
from pkmcal.outcome.finding import Level, Mark
from pkmcal.wording import MINUS_SIGN

if TYPE_CHECKING:
    from pkmcal import outcome

_LEADING_NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_THOUSANDS = str.maketrans({MINUS_SIGN: "-", "\N{NARROW NO-BREAK SPACE}": None})


class Column(Schema):
    """Column of a table.

    form : text; number, to the right, ``a ± b`` with the second part small; leg, a chip with the
        leg's colour; share, a bar from 0 to 1 beside its text.
    hint : explanation of the heading.
    """

    name: Text
    form: Literal["text", "number", "leg", "share"] = "number"
    hint: Text = ""


class TableRow(Schema):
    """Row of a table.

    cells : text of each column.
    values : number of each cell, by which the column is sorted and which a copy holds; null where
        the cell is a text.
    name : for copies, before all columns, where the cells have only a short one.
    tags : filters that the row passes.
    quiet : in a muted colour.
    """

    cells: tuple[Text, ...]
    values: tuple[float | None, ...]
    key: Key = ""
    name: Text = ""
    hint: Text = ""
    mark: Mark | None = None
    source: Literal["paper", "prototype", "ours"] = "ours"
    tags: tuple[str, ...] = ()
    quiet: bool = False


class Filter(Schema):
    """Button that filters rows by a tag.

    group : name of the filters of which a row has to pass one, such as legs; filters of several
        groups have to be passed all.
    hides : rows with the tag are hidden until the button is pressed.
    """

    tag: str
    label: Text
    group: Text = ""
    hides: bool = False


class DataTable(Schema):
    """Table; folded : collapsed until it is opened."""

    kind: Literal["table"] = "table"
    title: Text
    columns: tuple[Column, ...]
    rows: tuple[TableRow, ...]
    note: Text = ""
    folded: bool = False
    filters: tuple[Filter, ...] = ()


def table_block(table: outcome.Table) -> DataTable:
    """Block of a table that the terminal prints as well."""
    marks = {row.mark for row in table.rows}
    # rows of one mark are all alike: then no sign is shown
    marked = len(marks) > 1 or marks == {Level.WRONG}
    return DataTable(
        title=table.title,
        columns=tuple(
            Column(name=name, form="text" if k == 0 or k in table.words else "number")
            for k, name in enumerate(table.columns)
        ),
        rows=tuple(
            TableRow(
                cells=(row.name, *row.cells),
                values=tuple(map(leading_number, (row.name, *row.cells))),
                key=row.key,
                mark=row.mark if marked else None,
                source=row.source,
            )
            for row in table.rows
        ),
        note=table.note,
        folded=table.folded,
    )


def leading_number(text: str) -> float | None:
    """Number with which a text begins, such as that of ``−0.3 ± 0.1``; None without one."""
    match = _LEADING_NUMBER.match(text.translate(_THOUSANDS))
    return float(match[0]) if match else None
