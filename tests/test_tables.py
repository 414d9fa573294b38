"""CSV tables: accepted variants, and every fault with its line."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faults import fault, raises, written
from pkmcal.errors import InputError
from pkmcal.files import csv_text, documents, read_csv, read_pairs, write_text
from pkmcal.files.limits import MOST_ROWS

HEADER = "configuration,leg1,leg2\n"


def test_a_table(tmp_path):
    path = written(
        tmp_path / "t.csv",
        b"\xef\xbb\xbfconfiguration, leg1 ,leg2\r\n\r\n001,1e-3,-.5\r\n02,2,3.\r\n",
    )
    table = read_csv(path)
    assert table.columns == ("leg1", "leg2")
    assert table.names == ("001", "02")
    assert table.lines == (3, 4)
    np.testing.assert_array_equal(table.values, [[1e-3, -0.5], [2, 3]])
    assert table.where(1, 0) == "t.csv, line 4, column leg1"


def test_lines_count_through_quoted_cells(tmp_path):
    table = read_csv(written(tmp_path / "t.csv", 'configuration,x\n"a\nb",1\nc,2\n'))
    assert table.names == ("a\nb", "c")
    assert table.lines == (2, 4)


@pytest.mark.parametrize(
    ("content", "facts"),
    [
        ("", {"where": "t.csv", "expected": "a header: configuration,…"}),
        ("\n\n", {"where": "t.csv", "expected": "a header: configuration,…"}),
        (HEADER, {"where": "t.csv"}),
        (
            "configuration;leg1;leg2\n1;0,3;0,4\n",
            {
                "where": "t.csv, line 1",
                "found": "'configuration;leg1;leg2'",
                "expected": "commas between columns and points in numbers",
            },
        ),
        (
            "configuration\tleg1\n1\t0.3\n",
            {
                "where": "t.csv, line 1",
                "found": "'configuration\\tleg1'",
                "expected": "commas between columns and points in numbers",
            },
        ),
        (
            "leg1,leg2\n1,2\n",
            {"where": "t.csv, line 1", "found": "'leg1'", "expected": "configuration"},
        ),
        ("configuration\n1\n", {"where": "t.csv, line 1", "found": "configuration"}),
        (
            "configuration,leg1,leg1\n1,2,3\n",
            {"code": "table.column_twice", "where": "t.csv, line 1"},
        ),
        ("configuration,leg1,\n1,2,3\n", {"where": "t.csv, line 1"}),
        (
            HEADER + "1,2\n",
            {
                "where": "t.csv, line 2",
                "found": "2 cells",
                "expected": "3 (configuration, leg1, leg2)",
            },
        ),
        (
            HEADER + "1,2,3,4\n",
            {
                "where": "t.csv, line 2",
                "found": "4 cells",
                "expected": "3 (configuration, leg1, leg2)",
            },
        ),
        (HEADER + ",2,3\n", {"where": "t.csv, line 2"}),
        (HEADER + "1,,3\n", {"where": "t.csv, line 2, column leg1", "expected": "a number"}),
        (
            HEADER + "1,2,nan\n",
            {"where": "t.csv, line 2, column leg2", "found": "'nan'", "expected": "a number"},
        ),
        (
            HEADER + "1,2,-Inf\n",
            {"where": "t.csv, line 2, column leg2", "found": "'-Inf'", "expected": "a number"},
        ),
        (
            HEADER + "1,2,1e999\n",
            {"where": "t.csv, line 2, column leg2", "found": "'1e999'", "expected": "a number"},
        ),
        (
            HEADER + "1,2,#N/A\n",
            {"where": "t.csv, line 2, column leg2", "found": "'#N/A'", "expected": "a number"},
        ),
        (
            HEADER + "1,2,abc\n",
            {
                "where": "t.csv, line 2, column leg2",
                "found": "'abc'",
                "expected": "a number, such as 0.3476 or 1.2e-3",
            },
        ),
        (
            HEADER + "1,2,1_000\n",
            {
                "where": "t.csv, line 2, column leg2",
                "found": "'1_000'",
                "expected": "a number, such as 0.3476 or 1.2e-3",
            },
        ),
        (
            HEADER + '1,2,"0,35"\n',
            {"where": "t.csv, line 2, column leg2", "found": "'0,35'", "expected": "0.35"},
        ),
        (
            HEADER + "1,2,3\n2,2,3\n1,4,5\n",
            {"where": "t.csv, line 4"},
        ),
        (HEADER + '1,2,"3\n', {"where": "t.csv, line 2"}),
    ],
)
def test_csv_faults(tmp_path, content, facts):
    with raises(InputError, **facts):
        read_csv(written(tmp_path / "t.csv", content))


def test_csv_columns_that_are_asked_for(tmp_path):
    path = written(tmp_path / "t.csv", HEADER + "1,2,3\n")
    assert read_csv(path, columns=["leg2", "leg1"]).columns == ("leg1", "leg2")
    with raises(InputError, where="t.csv, line 1", found="leg1 and leg2") as caught:
        read_csv(path, columns=["leg1", "leg2", "leg3"])
    assert "leg3" in caught.value.what
    with raises(InputError, where="t.csv, line 1", found="leg2", expected="lag2"):
        read_csv(path, columns=["leg1", "lag2"])


cells = st.text(st.characters(exclude_categories=["Cs", "Cc", "Zs", "Zl", "Zp"]), min_size=1)


@settings(deadline=None)
@given(
    st.lists(cells, unique=True, min_size=1, max_size=4).filter(lambda c: "configuration" not in c),
    st.lists(cells, unique=True, min_size=1, max_size=6),
    st.randoms(use_true_random=False),
)
def test_csv_written_reads_back_the_same(tmp_path_factory, columns, names, random):
    values = np.array([[random.gauss(0, 10.0 ** random.randint(-9, 9)) for _ in columns]
                       for _ in names])  # fmt: skip
    values = np.clip(values, -1e15, 1e15)  # what a quantity can be
    path = tmp_path_factory.mktemp("csv") / "t.csv"
    write_text(path, csv_text(columns, names, values))
    table = read_csv(path)
    assert table.columns == tuple(columns)
    assert table.names == tuple(names)
    np.testing.assert_array_equal(table.values, values)


@settings(deadline=None)
@given(
    st.lists(st.sampled_from(["a,1", '"b\nb",2', "", "ü,3", " c , 4 ", "\ufeffd,5"]), max_size=8),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.integers(1, 40),
)
def test_a_text_in_blocks_is_the_text(tmp_path_factory, lines, end, block):
    path = tmp_path_factory.mktemp("text") / "t.txt"
    text = "\ufeff" + end.join(["header", *lines, ""])
    path.write_bytes(text.encode())
    value = list(documents.text_blocks(path, "t.csv", block_bytes=block))
    whole = text[1:].replace("\r\n", "\n").replace("\r", "\n")
    assert "".join(value) == whole
    assert all(part.endswith("\n") for part in value[:-1])


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"x,1,2,3\n", "line {}: the row has another number of cells"),
        (b"x,1,\n", "line {}, column leg2: the cell is empty"),
        (b"x,1,2 000\n", "line {}, column leg2: this is not a number"),
        (b"x,1,2e308\n", "line {}, column leg2: this is not a finite number"),
        (b"000000,1,2\n", "line {0}: the configuration 000000 occurs twice, on lines 2 and {0}"),
        (b"x,1,\xff\n", "line {}: the file is not UTF-8 text"),
        (b"x,1,\0\n", "line {}: the file is not text"),
        (b'x,1,"2\n', "line {}: not valid CSV"),
    ],
)
def test_a_bad_line_of_a_large_table_is_named(tmp_path, line, reason):
    """For a table that is read in several blocks, because its numbers are long."""
    zeros = b"0" * 800
    rows = [b"%06d,0.%06d%b,1e-3\n" % (k, k, zeros) for k in range(3000)]
    rows.insert(2400, line)
    path = written(tmp_path / "t.csv", HEADER.encode() + b"".join(rows))
    assert path.stat().st_size > 2 * documents.TEXT_BLOCK_BYTES
    assert fault(read_csv, path).startswith("t.csv, " + reason.format(2402))


def test_a_large_table(tmp_path):
    names = [f"{k:06d}" for k in range(MOST_ROWS)]
    values = np.random.default_rng(0).normal(size=(len(names), 15))
    legs = [f"leg{k}" for k in range(15)]
    path = written(tmp_path / "t.csv", csv_text(legs, names, values))
    assert path.stat().st_size > 2 * documents.TEXT_BLOCK_BYTES
    table = read_csv(path)
    assert (table.names, table.lines) == (tuple(names), tuple(range(2, len(names) + 2)))
    np.testing.assert_array_equal(table.values, values)


@pytest.mark.parametrize("cell", ["1e308", "-1.5e308", "2e15"])
def test_a_number_beyond_any_quantity_is_named_however_plain(tmp_path, cell):
    path = written(tmp_path / "t.csv", HEADER + f"1,1,2\n2,1,{cell}\n")
    with raises(InputError, where="t.csv, line 3, column leg2", expected="at most 1e+15"):
        read_csv(path)


def test_pairs_of_configurations_are_read_as_tables_are(tmp_path):
    """A byte-order mark, Windows line ends, blanks, quotes, empty lines, a unit in the head."""
    text = '\ufefffrom,to, distance [mm]\r\n\r\n0001 ,"0002",40.5\r\n0002,0001,40.25\r\n'
    (tmp_path / "pairs.csv").write_bytes(text.encode("utf-8"))
    table = read_pairs(tmp_path / "pairs.csv", ("from", "to"), ("distance",), ("sigma",))
    assert table.pairs == (("0001", "0002"), ("0002", "0001"))
    assert table.columns == ("distance",)
    np.testing.assert_allclose(table.values, [[0.0405], [0.04025]], rtol=1e-15)
    assert table.where(1, 0) == "pairs.csv, line 4, column distance"
