"""Text files spoilt as bytes, and tables spoilt as tables."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random

from fuzz.trees import NUMBERS, TEXTS, misspelt

BYTES = (
    b"\0", b"\t", b"\xff", b"\xed\xa0\x80", b"\xc2\x85", b"\xe2\x80\xa8", b"\xef\xbb\xbf", b"\x1a",
    b"\r", b"\n", b'"', b"'", b"{", b"]", b":", b"- ", b"#", b"%", b"&a ", b"*a ", b"!", b"\x7f",
    b"\xf0\x9f\x98\x80", b"\xc3", b"\x1b[2J", b"\xe2\x80\xae", b"--- \n", b"...\n", b"\n\n\n",
)  # fmt: skip
COMMENTS = 20_000


@dataclass
class Bytes:
    """A file's bytes, a place in them, their lines and one of these."""

    data: bytes
    at: int
    lines: list[bytes]
    row: int


def spoil_bytes(data: bytes, rng: Random) -> tuple[str, bytes]:
    """(kind, the file's bytes as they are then)."""
    kind = rng.choice(BYTE_KINDS)
    at, lines = rng.randrange(len(data) + 1), data.split(b"\n")
    file = Bytes(data, at, lines, rng.randrange(len(lines)))
    if kind == "coding":
        coding = rng.choice(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "utf-7", "cp500"])
        text = data.decode("utf-8", "replace")
        return f"{kind} {coding}", text.encode(coding, "replace")
    return kind, OF_BYTES[kind](file, rng)


def _turned_bit(file, rng):
    at = min(file.at, max(len(file.data) - 1, 0))
    turned = bytes([file.data[at] ^ 1 << rng.randrange(8)]) if file.data else b""
    return file.data[:at] + turned + file.data[at + 1 :]


def _lines_exchanged(file, rng):
    lines = list(file.lines)
    lines[file.row], lines[0] = lines[0], lines[file.row]
    return b"\n".join(lines)


def _line(file, new):
    return b"\n".join([*file.lines[: file.row], *new, *file.lines[file.row + 1 :]])


OF_BYTES = {
    "cut": lambda f, rng: f.data[: f.at],
    "bit": _turned_bit,
    "put in": lambda f, rng: f.data[: f.at] + rng.choice(BYTES) + f.data[f.at :],
    "lost": lambda f, rng: f.data[: f.at] + f.data[f.at + rng.choice([1, 3, 40]) :],
    "line lost": lambda f, rng: _line(f, []),
    "line twice": lambda f, rng: _line(f, [f.lines[f.row]] * 2),
    "lines exchanged": _lines_exchanged,
    "indented": lambda f, rng: _line(f, [rng.choice([b" ", b"  ", b"\t"]) + f.lines[f.row]]),
    "outdented": lambda f, rng: _line(f, [f.lines[f.row].lstrip()]),
    "line ends": lambda f, rng: f.data.replace(
        b"\n", rng.choice([b"\r\n", b"\r", b"\n\r", b"\n\n", b"\x0b"])
    ),
    "umlaut": lambda f, rng: f.data[: f.at] + "ä".encode("latin-1") + f.data[f.at :],
    "twice": lambda f, rng: f.data + rng.choice([b"", b"\n---\n"]) + f.data,
    "comments": lambda f, rng: b"# a remark\n" * COMMENTS + f.data,
    "empty": lambda f, rng: rng.choice(
        [b"", b"\n", b" ", b"\xef\xbb\xbf", b"null\n", b"[]\n", b"3\n", b"{}\n"]
    ),
}


BYTE_KINDS = (
    "cut", "cut", "bit", "bit", "put in", "put in", "lost", "line lost", "line twice",
    "lines exchanged", "indented", "outdented", "coding", "line ends", "umlaut", "twice",
    "comments", "empty",
)  # fmt: skip


@dataclass
class Rows:
    """A table's cells, the header first, one of its other rows and one of its number columns."""

    table: list[list[str]]
    row: int
    column: int

    @property
    def cells(self):
        return self.table[self.row]


def spoil_table(text: str, rng: Random) -> tuple[str, str, tuple[str, ...]]:
    """(kind, text, words of which a message should hold one) of a CSV file."""
    table = [line.split(",") for line in text.splitlines()]
    kind = rng.choice(TABLE_KINDS)
    rows = Rows(table, rng.randrange(1, len(table)), rng.randrange(1, len(table[0])))
    if kind == "separator":
        separator = rng.choice([";", "\t", "|", " ", ", ", ",,"])
        lines = [separator.join(cells) for cells in table]
        if separator == ";" and rng.random() < 0.5:
            lines = [lines[0], *(line.replace(".", ",") for line in lines[1:])]
        return kind, "\n".join(lines) + "\n", ()
    OF_TABLES[kind](rows, rng)
    words = () if len(table) == 1 else tuple(table[0])  # of a table without rows there is no place
    return kind, "\n".join(",".join(cells) for cells in table) + "\n", words


def _cell(t, rng):
    t.cells[t.column] = rng.choice([*NUMBERS, *CELLS, "9" * 140_000])


def _name(t, rng):
    t.cells[0] = rng.choice(TEXTS).replace(",", " ")


def _name_misspelt(t, rng):
    t.cells[0] = misspelt(t.cells[0], rng)


def _header(t, rng):
    t.table[0][rng.randrange(len(t.table[0]))] = rng.choice(TEXTS)


def _header_misspelt(t, rng):
    at = rng.randrange(len(t.table[0]))
    t.table[0][at] = misspelt(t.table[0][at], rng)


def _header_lost(t, rng):
    del t.table[0]


def _header_twice(t, rng):
    t.table.insert(t.row, list(t.table[0]))


def _column_twice(t, rng):
    t.table[0][t.column] = t.table[0][rng.randrange(len(t.table[0]))]


def _row_twice(t, rng):
    t.table.insert(t.row, list(t.cells))


def _rows_exchanged(t, rng):
    t.table[t.row], t.table[1] = t.table[1], t.table[t.row]


def _names_exchanged(t, rng):
    t.cells[0], t.table[1][0] = t.table[1][0], t.cells[0]


def _rows_lost(t, rng):
    del t.table[rng.randrange(1, len(t.table)) :]


def _cell_lost(t, rng):
    del t.cells[t.column]


def _cell_more(t, rng):
    t.cells.insert(t.column, rng.choice(["", "0.4"]))


def _column_lost(t, rng):
    for cells in t.table:
        del cells[t.column]


def _column_more(t, rng):
    for k, cells in enumerate(t.table):
        cells.insert(t.column, "0.4" if k else "leg9")


def _columns_exchanged(t, rng):
    for cells in t.table:
        cells[t.column], cells[-1] = cells[-1], cells[t.column]


def _frozen(t, rng):
    for cells in t.table[1:]:
        cells[t.column] = t.table[1][t.column]


def _scaled(t, rng):
    factor = rng.choice([1e3, -1.0, 57.3, 1e300, 1e-300, 0.0])
    column = t.column
    if t.table[0][column] in ("from", "to"):
        column = len(t.table[0]) - 1  # names cannot be scaled
    for cells in t.table[1:]:
        cells[column] = repr(float(cells[column]) * factor)


def _long(t, rng):
    t.table += [[f"more{k}", *t.cells[1:]] for k in range(LONG)]


CELLS = ("", " ", "#N/A", "#VALUE!", '"0.4', '"0.4\n"', "0.4 m", "1e-3 ", "x" * 200)
LONG = 20_000
OF_TABLES = {
    "cell": _cell,
    "name": _name,
    "name misspelt": _name_misspelt,
    "header": _header,
    "header misspelt": _header_misspelt,
    "header lost": _header_lost,
    "header twice": _header_twice,
    "column twice": _column_twice,
    "row twice": _row_twice,
    "rows exchanged": _rows_exchanged,
    "rows lost": _rows_lost,
    "cell lost": _cell_lost,
    "cell more": _cell_more,
    "column lost": _column_lost,
    "column more": _column_more,
    "frozen": _frozen,
    "scaled": _scaled,
    "long": _long,
    "columns exchanged": _columns_exchanged,
    "names exchanged": _names_exchanged,
}
TABLE_KINDS = (
    "cell", "cell", "cell", "cell", "name", "name", "name misspelt", "header", "header misspelt",
    "header lost", "header twice", "column twice", "row twice", "rows exchanged", "rows lost",
    "cell lost", "cell more", "column lost", "column more", "frozen", "scaled", "long",
    "columns exchanged", "names exchanged", "separator",
)  # fmt: skip
