"""CSV tables with one row a configuration: a name, then numbers; errors have the file's line."""

from __future__ import annotations

import csv
import io
import math
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import LONGEST_NAME, InputError
from pkmcal.files.documents import LARGEST_WRITTEN_NUMBER, closest, quoted, text_blocks
from pkmcal.files.limits import MOST_COLUMNS, MOST_ROWS, check_count
from pkmcal.files.quantities import Unit, split_head
from pkmcal.wording import listed

CONFIGURATION_COLUMN = "configuration"
"""Name of the first column."""
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_PLAIN = re.compile(r"[-+.0-9eE]*", re.ASCII)
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)|#.*", re.IGNORECASE)
"""Words for "no number" that programs write into cells; spreadsheets write #N/A or #VALUE!."""

_KINDS = {"m": "a length, such as mm", "rad": "an angle, such as deg", "": "plain numbers"}


@dataclass(frozen=True)
class CsvTable:
    """CSV file of named rows.

    label : the file's name in messages.
    columns : names of the m number columns, in the file's order.
    names : first column, one name a row, all different.
    values : (K, m) numbers, in SI where the column's head names a unit, else in the file's unit.
    lines : line of each row in the file, from 1.
    """

    label: str
    columns: tuple[str, ...]
    names: tuple[str, ...]
    values: Array
    lines: tuple[int, ...]
    units: tuple[Unit | None, ...] = ()
    """Unit in each column's head, such as ``leg1 [mm]``, or None."""

    def check_kinds(self, kinds: Sequence[str]) -> None:
        """Raise `InputError` where a column's head names a unit of another kind than "m", "rad" or
        "" for numbers without a unit.
        """
        for name, names, kind in zip(self.columns, self.units, kinds, strict=False):
            if names is not None and names.kind != kind:
                raise InputError(
                    "this column is in another kind of unit than what it holds",
                    where=f"{self.label}, line 1, column {name}",
                    found=_KINDS[names.kind],
                    expected=_KINDS[kind],
                )

    def where(self, row: int, column: int | None = None) -> str:
        """File, line and column for a message, as in "joints.csv, line 4, column leg2"."""
        place = f"{self.label}, line {self.lines[row]}"
        return place if column is None else f"{place}, column {self.columns[column]}"


def read_csv(
    path: Path | str,
    columns: Sequence[str] | None = None,
    label: str | None = None,
) -> CsvTable:
    """Read a table whose header is CONFIGURATION_COLUMN and then one name for each number column.

    columns : the columns of the table, all of them needed, in any order; None allows any. Values
    are returned in the file's order of columns. A byte-order mark, any line ends, empty lines and
    blanks around a cell are accepted.
    """
    path = Path(path)
    label = label or path.name
    text = (line for block in text_blocks(path, label) for line in io.StringIO(block))
    rows = _rows(text, label)
    header_line, header = next(rows, (0, None))
    if header is None:
        raise InputError(
            "the file is empty", where=label, expected=f"a header: {CONFIGURATION_COLUMN},…"
        )
    # header: names and units of the columns
    heads = [split_head(head) for head in header[1:]]
    header[1:] = [name for name, _ in heads]
    _check_header(header, columns, f"{label}, line {header_line}", (CONFIGURATION_COLUMN,))
    check_count(len(header), MOST_COLUMNS, "columns", f"{label}, line {header_line}")
    # rows; plain ones are read quickly
    lines: dict[str, int] = {}
    values = array("d")
    for line, cells in rows:
        numbers = _quickly(cells) if len(cells) == len(header) else None
        values.extend(
            _numbers(cells, header, f"{label}, line {line}") if numbers is None else numbers
        )
        name = cells[0]
        if len(name) > LONGEST_NAME:
            _check_length([name], f"{label}, line {line}")
        if (first := lines.setdefault(name, line)) != line:
            raise InputError(
                f"the {CONFIGURATION_COLUMN} {name} occurs twice, on lines {first} and {line}",
                where=f"{label}, line {line}",
                next_step="Give each row its own name, or remove one of the two",
            )
        if len(lines) > MOST_ROWS:
            raise InputError(
                "there are too many rows",
                where=label,
                found=f"more on line {line}",
                expected=f"at most {MOST_ROWS}",
            )
    if not lines:
        raise InputError("there are no rows under the header", where=label)
    # values in SI
    each = np.array(values).reshape(len(lines), len(header) - 1)
    units = tuple(results for _, results in heads)
    each *= [results.factor if results else 1.0 for results in units]
    return CsvTable(label, tuple(header[1:]), tuple(lines), each, tuple(lines.values()), units)


@dataclass(frozen=True)
class PairTable(CsvTable):
    """Rows that name two configurations each, ``pairs``; ``names`` joins both names, and may
    repeat.
    """

    pairs: tuple[tuple[str, str], ...] = ()


def read_pairs(
    path: Path | str,
    heads: tuple[str, str],
    columns: Sequence[str],
    optional: Sequence[str] = (),
    label: str | None = None,
) -> PairTable:
    """Read a table whose rows name two configurations, under ``heads``, followed by numbers.

    columns : needed; optional : allowed besides; in any order.
    """
    path = Path(path)
    label = label or path.name
    rows = _rows((line for block in text_blocks(path, label) for line in io.StringIO(block)), label)
    example = ",".join((*heads, *columns))
    header_line, header = next(rows, (0, None))
    if header is None:
        raise InputError("the file is empty", where=label, expected=f"a header: {example}")
    # header: names and units of the columns
    results = [split_head(head) for head in header[2:]]
    header[2:] = [name for name, _ in results]
    _check_header(
        header, [*columns, *(c for c in optional if c in header)], f"{label}, line {header_line}",
        heads,
    )  # fmt: skip
    # rows
    pairs, lines, values = list[tuple[str, str]](), list[int](), list[list[float]]()
    for line, cells in rows:
        where = f"{label}, line {line}"
        numbers = _numbers(cells, header, where, len(heads))
        _check_length(cells[:2], where)
        factors = (unit.factor if unit else 1.0 for _, unit in results)
        values.append([x * factor for x, factor in zip(numbers, factors, strict=True)])
        pairs.append((cells[0], cells[1]))
        lines.append(line)
        check_count(len(lines), MOST_ROWS, "rows", where)
    if not lines:
        raise InputError("there are no rows under the header", where=label)
    names = tuple(f"{a} to {b}" for a, b in pairs)
    units = tuple(unit for _, unit in results)
    numbers = np.array(values)
    return PairTable(label, tuple(header[2:]), names, numbers, tuple(lines), units, tuple(pairs))


def csv_text(columns: Sequence[str], names: Sequence[str], values: Array) -> str:
    """Table (names K, values (K, m)) as text that `read_csv` reads back exactly."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([CONFIGURATION_COLUMN, *columns])
    rows = np.asarray(values, dtype=float).reshape(len(names), len(columns)).tolist()
    writer.writerows([name, *map(repr, row)] for name, row in zip(names, rows, strict=True))
    return stream.getvalue()


def _rows(lines: Iterable[str], label: str) -> Iterator[tuple[int, list[str]]]:
    """Non-empty rows as (line, cells without surrounding blanks)."""
    reader = csv.reader(lines, strict=True)
    before = 0
    try:
        for cells in reader:
            stripped = [cell.strip() for cell in cells]
            if any(stripped):
                yield before + 1, stripped
            before = reader.line_num
    except csv.Error as error:
        raise InputError(
            f"not valid CSV ({error})",
            where=f"{label}, line {before + 1}",  # where a quote that never ends begins
            next_step="Check the quotes on this line",
        ) from None


def _check_header(
    header: list[str], columns: Sequence[str] | None, where: str, first: tuple[str, ...]
) -> None:
    """Raise `InputError` for a faulty header; first : names of the columns that name
    configurations.
    """
    # other separators than commas
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and separator in header[0]:
            raise InputError(
                f"the columns are separated by {name}",
                where=where,
                found=quoted(header[0]),
                expected="commas between columns and points in numbers",
                next_step="Save it as CSV (comma delimited); a spreadsheet with English settings"
                " does so",
            )
    # names of the first columns
    if tuple(header[: len(first)]) != first:
        several = len(first) > 1
        other = "columns have other names" if several else "column has another name"
        raise InputError(
            f"the header's first {other}" if len(header) > 1 else "no header",
            where=where,
            found=quoted(",".join(header[: len(first)])),
            expected=",".join(first),
            next_step=f"Begin the file with the line {','.join(first)},"
            + (",".join(columns or ()) if several else "<one column a number>"),
        )
    _check_length(header, where)
    # names of all columns
    if "" in header:
        number = header.index("") + 1
        raise InputError(f"column {number} of the header has no name", where=where)
    twice = [name for name, times in Counter(header).items() if times > 1]
    if twice:
        raise InputError(
            f"the header names {listed(twice)} twice", where=where, code="table.column_twice"
        )
    if len(header) == len(first):
        raise InputError("there is no column of numbers", where=where, found=",".join(first))
    if columns is not None:
        _check_columns(header[len(first) :], columns, where)


def _check_columns(actual_names: Sequence[str], names: Sequence[str], where: str) -> None:
    """Raise `InputError` for unknown or missing columns."""
    missing = [name for name in names if name not in actual_names]
    for name in actual_names:
        if name not in names:
            guess = closest(name, missing)
            raise InputError(
                "this column is not known", where=where, found=name,
                expected=guess or listed(names, 12),
            )  # fmt: skip
    if missing:
        raise InputError(
            f"column {listed(missing)} is missing", where=where, found=listed(actual_names, 12)
        )


def _quickly(cells: list[str]) -> list[float] | None:
    """Numbers (m,) of a row of plain numbers; None where each cell has to be read by itself. Of
    these characters Python accepts as a number nothing that :func:`_number` refuses.
    """
    if not (cells[0] and _PLAIN.fullmatch("".join(cells[1:]))):
        return None
    try:
        numbers = list(map(float, cells[1:]))
    except ValueError:
        return None
    return numbers if max(map(abs, numbers), default=0.0) <= LARGEST_WRITTEN_NUMBER else None


def _numbers(cells: list[str], header: list[str], where: str, first: int = 1) -> list[float]:
    """Numbers (m,) of a row after the ``first`` cells, which are names."""
    if len(cells) != len(header):
        raise InputError(
            "the row has another number of cells than the header",
            where=where,
            found=f"{len(cells)} cells",
            expected=f"{len(header)} ({', '.join(header)})",
        )
    for cell, column in zip(cells[:first], header[:first], strict=True):
        if not cell:
            who = f"the {column}" if first == 1 else f"the configuration under {column}"
            raise InputError(f"{who} has no name", where=where)
    return [
        _number(cell, f"{where}, column {column}")
        for cell, column in zip(cells[first:], header[first:], strict=True)
    ]


def _number(cell: str, where: str) -> float:
    """Number in a cell. Raises `InputError` for any other text."""
    if not cell:
        raise InputError(
            "the cell is empty",
            where=where,
            expected="a number",
            next_step="Leave the whole row out if the reading was not taken",
        )
    value = float(cell) if _NUMBER.fullmatch(cell) else math.nan
    if abs(value) <= LARGEST_WRITTEN_NUMBER:
        return value
    if math.isfinite(value):
        what, expected = (
            "this number is too large for any quantity",
            f"at most {LARGEST_WRITTEN_NUMBER:g}",
        )
    elif _NOT_FINITE.fullmatch(cell) or math.isinf(value):
        what, expected = "this is not a finite number", "a number"
    elif _NUMBER.fullmatch(cell.replace(",", ".")):
        what, expected = "this number has a decimal comma", cell.replace(",", ".")
    else:
        what, expected = "this is not a number", "a number, such as 0.3476 or 1.2e-3"
    raise InputError(what, where=where, found=quoted(cell), expected=expected)


def _check_length(names: Sequence[str], where: str) -> None:
    """Raise `InputError` for a name that is longer than file systems allow."""
    for name in names:
        if len(name) > LONGEST_NAME:
            raise InputError(
                "this name is too long",
                where=where,
                found=f"{quoted(name)} of {len(name)} characters",
                expected=f"at most {LONGEST_NAME}, as file systems take",
            )
