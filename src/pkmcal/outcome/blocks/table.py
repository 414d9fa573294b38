"""Block of a table that can be sorted, filtered and copied."""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Key, Text
from pkmcal.outcome.finding import Mark


class Column(Schema):
    """Column of a table.

    form : text; number, to the right, ``a ± b`` with the second part small; leg, a chip with the
        leg's colour; share, a bar from 0 to 1 beside its text; shade, a number whose cell is the
        darker the larger it is among those of all such columns; chance, a probability in words,
        whose number is its tooltip.
    hint : explanation of the heading.
    by_size : sorted by the size of the values, whatever their sign, as changes are.
    """

    name: Text
    form: Literal["text", "number", "leg", "share", "shade", "chance"] = "number"
    hint: Text = ""
    by_size: bool = False


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
