"""YAML files and schemas: lines kept, every fault reported."""

import math
from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from faults import fault, raises, written
from pkmcal.errors import InputError
from pkmcal.files import (
    FieldError,
    Schema,
    closest,
    field_path,
    parse_yaml,
    quoted,
    read_csv,
    read_json,
    read_yaml,
    validated_document,
    yaml_text,
)
from pkmcal.wording import listed

# YAML

WORDS = """\
number: 1e-5
small: 3.0e-06
name: 010
on: no
day: 2024-01-01
time: 12:30
nothing: ~
flag: true
list: [1, 2.5, .inf]
"""


def test_scalars_follow_yaml_1_2(tmp_path):
    data = read_yaml(written(tmp_path / "a.yaml", WORDS)).data
    assert data == {
        "number": 1e-5,
        "small": 3e-6,
        "name": 10,
        "on": "no",
        "day": "2024-01-01",
        "time": "12:30",
        "nothing": None,
        "flag": True,
        "list": [1, 2.5, math.inf],
    }
    assert type(data["list"][0]) is int


def test_explicit_text_and_numbers(tmp_path):
    data = read_yaml(written(tmp_path / "a.yaml", "a: !!str 5\nb: '5'\nc: !!float 5\n5: x\n")).data
    assert data == {"a": "5", "b": "5", "c": 5.0, "5": "x"}


def test_lines_of_values_lists_and_missing_fields(tmp_path):
    document = read_yaml(written(tmp_path / "a.yaml", "a:\n  b:\n    - 1\n    - c: 2\n"))
    assert document.where("a", "b", 1, "c") == "a.yaml, line 4, a.b[2].c"
    assert document.where("a", "b", 0) == "a.yaml, line 3, a.b[1]"
    assert document.where("a", "missing") == "a.yaml, line 1, a.missing"
    assert document.where("missing") == "a.yaml, missing"
    assert document.where() == "a.yaml"


def test_aliases_and_merges(tmp_path):
    text = "- &leg {r: 1, s: 2}\n- <<: *leg\n  s: 3\n- *leg\n- &own\n  <<: *leg\n  s: 4\n- *own\n"
    document = read_yaml(written(tmp_path / "a.yaml", f"legs:\n{text}"))
    legs = document.data["legs"]
    assert legs[:4] == [{"r": 1, "s": 2}, {"r": 1, "s": 3}, {"r": 1, "s": 2}, {"r": 1, "s": 4}]
    assert legs[4] == legs[3]
    assert document.lines["legs", 1, "s"] == 4


def test_bom_and_windows_line_ends(tmp_path):
    path = written(tmp_path / "a.yaml", b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    assert read_yaml(path).data == {"a": 1, "b": 2}
    assert read_yaml(path).lines["b",] == 2


def test_a_label_stands_for_the_path(tmp_path):
    path = written(tmp_path / "b.yaml", "a: [1")
    with raises(InputError, where="cameras/b.yaml, line 1"):
        read_yaml(path, "cameras/b.yaml")


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ("", ["a.yaml: the file is empty", "expected keys and values"]),
        ("# only a comment\n", ["the file is empty"]),
        ("- 1\n- 2\n", ["the top of the file is not a mapping", "found [1, 2]", "key: value"]),
        ("a: 1\nb: [1, 2\nc: 3\n", ["a.yaml, line 3: not valid YAML", "Check indentation"]),
        ("a: 1\n\tb: 2\n", ["a.yaml, line 2: not valid YAML"]),
        ("a: 1\n---\nb: 2\n", ["not valid YAML"]),
        ("a:\n  x: 1\n  y: 2\n  x: 3\n", ["line 4, a.x: the key x occurs twice, on lines 2 and 4"]),
        ("a: !!python/object:os.system x\n", ["line 1: the tag", "is not allowed"]),
        ("a: !!set {x}\n", ["is not allowed"]),
        ("a: !!int many\n", ["'many' is not a usable int"]),
        ("? [1, 2]\n: x\n", ["a key is a list or a mapping"]),
        ("a: &a [*a]\n", ["repeats without end"]),
        ("a: " + "[" * 3000 + "\n", ["line 1: a is nested too deeply"]),
        ("b: 1\na: " + "[" * 240 + "]" * 240, ["line 2: a is nested too deeply"]),
        ('b: 1\na: ["x", "\\ud800"]\n', ["a.yaml, line 2, a[2]:", "cannot be written", "\\ud800"]),
        ('"\\ud800": 1\n', ["a.yaml, line 1, ?:", "cannot be written"]),
        ('a: "x\\0.png"\n', ["a.yaml, line 1, a:", "cannot be written", "\\u0000"]),
        ("a: {<<: 3}\n", ["line 1: << merges mappings"]),
        ("a: &a {<<: *a}\n", ["repeats without end"]),
        (b"a: 1\nb: caf\xe9\n", ["a.yaml, line 2: the file is not UTF-8", "0xe9", "Save it as"]),
        (b"b: 1\na: \x00\n", ["a.yaml, line 2: the file is not text", "a zero byte"]),
        (b"a: \x01\n", ["not a text file", "#x0001"]),
    ],
)  # fmt: skip
def test_yaml_faults(tmp_path, content, parts):
    message = fault(read_yaml, written(tmp_path / "a.yaml", content))
    for part in parts:
        assert part in message


def test_a_bomb_of_aliases_is_refused(tmp_path):
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    with raises(InputError, code="file.aliases", where="a.yaml, line 1"):
        read_yaml(written(tmp_path / "a.yaml", "\n".join(lines)))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (f"a: [{'1,' * 200_001}]", "file.too_many_values"),
        ("a: [" + ",".join(["x" * 1_000_000] * 11) + "]", "file.too_large"),
    ],
    ids=["values", "characters"],
)
def test_too_much_without_an_alias_is_not_blamed_on_aliases(tmp_path, text, code):
    with raises(InputError, code=code):
        read_yaml(written(tmp_path / "a.yaml", text))


def test_aliases_that_nest_ever_deeper_are_refused(tmp_path):
    lines = ["a0: &a0 [1]", *(f"a{n}: &a{n} [*a{n - 1}]" for n in range(1, 100))]
    with raises(InputError, code="file.nested_too_deeply"):
        read_yaml(written(tmp_path / "a.yaml", "\n".join(lines)))


def test_a_bomb_of_merges_is_no_more_than_its_keys(tmp_path):
    lines = ["a0: &a0 {x: 1, y: 2}"]
    lines += [f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 4)}]}}" for n in range(1, 40)]
    # 4**40 pairs, taken by their word
    document = read_yaml(written(tmp_path / "a.yaml", "\n".join(lines)))
    assert document.data["a39"] == {"x": 1, "y": 2}


def test_merges_that_repeat_much_are_refused(tmp_path):
    lines = ["d: &d {" + ", ".join(f"k{n}: {n}" for n in range(1000)) + "}"]
    lines += [f"e{n}: {{<<: *d}}" for n in range(300)]
    with raises(InputError, code="file.aliases"):
        read_yaml(written(tmp_path / "a.yaml", "\n".join(lines)))


def test_a_bomb_of_long_texts_is_refused(tmp_path):
    text = f"s: &s {'x' * 100_000}\nl: [{', '.join(['*s'] * 200)}]\n"
    with raises(InputError, code="file.aliases"):
        read_yaml(written(tmp_path / "a.yaml", text))


def test_json_that_cannot_be_written_again(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": {"b": [1, "\\ud800"]}}')
    with raises(InputError, where="a.json, a.b[2]", found=r"\ud800 in '\ud800'"):
        read_json(path)
    path.write_text('{"a": ' + "[" * 240 + "]" * 240 + "}")
    with raises(InputError, code="file.nested_too_deeply"):
        read_json(path)


def test_missing_file_names_its_neighbour(tmp_path):
    written(tmp_path / "session.yaml", "a: 1")
    with raises(InputError, code="file.missing", where="sesion.yaml") as caught:
        read_yaml(tmp_path / "sesion.yaml")
    assert "session.yaml" in caught.value.expected
    with raises(InputError, code="file.missing", where="a.yaml") as caught:
        read_yaml(tmp_path / "no" / "a.yaml")
    assert "folder" in caught.value.expected


def test_a_folder_is_no_file(tmp_path):
    with raises(InputError, code="file.irregular", where=tmp_path.name) as caught:
        read_yaml(tmp_path)
    assert "a folder" in caught.value.what


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.text(st.characters(exclude_categories=["Cs", "Cc"])), inner, max_size=4
        )
    ),
    max_leaves=20,
)


@settings(deadline=None)
@given(st.dictionaries(st.text("abcdef<0123e.-", min_size=1), plain, max_size=5))
def test_yaml_written_reads_back_the_same(data):
    back = parse_yaml(yaml_text(data), Path("a.yaml")).data if data else {}
    assert back == data
    assert repr(back) == repr(data)  # 1 and 1.0, True and 1 are equal, but not the same


def test_yaml_text_keeps_short_lists_on_one_line_and_the_order():
    assert yaml_text({"b": [0.5, 1.0], "a": {"c": 1e-6}}) == "b: [0.5, 1.0]\na: {c: 1.0e-06}\n"


# schemas


class Crank(Schema):
    """A crank."""

    joint: Literal["crank"]
    arm: Annotated[float, Field(gt=0)] = Field(description="the arm's length, m")


class Fixed(Schema):
    """A point."""

    joint: Literal["fixed"]
    center: tuple[float, float, float]


class Machine(Schema):
    """A machine of the tests."""

    name: str
    count: int = Field(description="how many, such as 6")
    legs: tuple[Annotated[Crank | Fixed, Field(discriminator="joint")], ...] = ()
    notes: dict[str, Fixed] = Field(default={})
    kind: Literal["a", "b"] = "a"
    limit: Annotated[float, Field(ge=0, le=1)] = 0.5
    pair: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    crank: Crank | None = None


BASE = "name: m\ncount: 2\n"


def check(tmp_path, text):
    return validated_document(read_yaml(written(tmp_path / "a.yaml", text)), Machine)


def test_a_valid_document_becomes_the_model(tmp_path):
    machine = check(tmp_path, BASE + "legs:\n- {joint: fixed, center: [1, 2, 3.5]}\n")
    assert machine.legs == (Fixed(joint="fixed", center=(1, 2, 3.5)),)


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("count: 2\n", {"where": "a.yaml, name", "expected": "a value"}),
        ("name: m\n", {"where": "a.yaml, count", "expected": "how many, such as 6"}),
        (
            BASE + "lgs: []\n",
            {
                "where": "a.yaml, line 3, lgs",
                "found": "lgs",
                "expected": "legs (known here: count, crank, kind, legs, limit, name, notes, pair)",
            },
        ),
        (
            BASE + "zzzzz: 1\n",
            {
                "where": "a.yaml, line 3, zzzzz",
                "found": "zzzzz",
                "expected": "count, crank, kind, legs, limit, name, notes and pair",
            },
        ),
        (
            BASE + "kind: c\n",
            {"where": "a.yaml, line 3, kind", "found": "'c'", "expected": "'a' or 'b'"},
        ),
        (
            BASE + "limit: 2\n",
            {"where": "a.yaml, line 3, limit", "found": "2", "expected": "a number of 1 or less"},
        ),
        (
            BASE + "limit: .nan\n",
            {"where": "a.yaml, line 3, limit", "found": "nan", "expected": "a number"},
        ),
        (
            BASE + "limit: true\n",
            {"where": "a.yaml, line 3, limit", "found": "true", "expected": "a number"},
        ),
        (
            BASE + "limit:\n",
            {"where": "a.yaml, line 3, limit", "found": "nothing", "expected": "a number"},
        ),
        (
            BASE + "limit: '0.5'\n",
            {"where": "a.yaml, line 3, limit", "found": "'0.5'", "expected": "a number"},
        ),
        (
            BASE + "pair: [1]\n",
            {"where": "a.yaml, line 3, pair", "found": "[1]", "expected": "at least 2"},
        ),
        (
            BASE + "pair: [1, 2, 3]\n",
            {"where": "a.yaml, line 3, pair", "found": "3 entries", "expected": "at most 2"},
        ),
        (
            BASE + "crank: {joint: crank}\n",
            {"where": "a.yaml, line 3, crank.arm", "expected": "the arm's length, m"},
        ),
        (
            BASE + "crank: 5\n",
            {"where": "a.yaml, line 3, crank", "found": "5", "expected": "keys and values"},
        ),
        (
            "name: 5\ncount: 2\n",
            {"where": "a.yaml, line 1, name", "found": "5", "expected": "text"},
        ),
        (
            "name: m\ncount: 2.5\n",
            {"where": "a.yaml, line 2, count", "found": "2.5", "expected": "a whole number"},
        ),
        (
            BASE + "legs: 3\n",
            {
                "where": "a.yaml, line 3, legs",
                "found": "3",
                "expected": "a list, such as [1, 2, 3]",
            },
        ),
        (
            BASE + "legs:\n- {joint: crnk}\n",
            {
                "where": "a.yaml, line 4, legs[1]",
                "found": "crnk",
                "expected": "one of crank, fixed",
            },
        ),
        (
            BASE + "legs:\n- {arm: 1}\n",
            {"where": "a.yaml, line 4, legs[1]", "expected": "one of crank, fixed"},
        ),
        (
            BASE + "legs:\n- joint: crank\n  arm: -1\n",
            {"where": "a.yaml, line 5, legs[1].arm", "found": "-1", "expected": "a number above 0"},
        ),
        (
            BASE + "legs:\n- joint: crank\n  arn: 1\n",
            {
                "where": "a.yaml, line 5, legs[1].arn",
                "found": "arn",
                "expected": "arm (known here: arm, joint)",
            },
        ),
        (
            BASE + "legs:\n- joint: fixed\n  center: [1, 2]\n",
            {"where": "a.yaml, line 5, legs[1].center", "found": "[1, 2]", "expected": "3 entries"},
        ),
        (
            BASE + "notes:\n  x: {joint: fixed}\n",
            {"where": "a.yaml, line 4, notes.x.center", "expected": "a value"},
        ),
    ],
)
def test_schema_faults(tmp_path, text, facts):
    with raises(InputError, **facts):
        check(tmp_path, text)


def test_all_faults_are_reported_in_the_order_of_the_file(tmp_path):
    message = fault(check, tmp_path, "count: x\nkind: c\nlimit: 3\nname: m\n")
    assert message.startswith("a.yaml, line 1, count")
    assert message.endswith("Then look at line 2, kind and line 3, limit.")


def test_a_validators_own_error_is_kept(tmp_path):
    class Ordered(Schema):
        low: float
        high: float

        def model_post_init(self, _context):
            if self.low >= self.high:
                raise FieldError("the order is wrong", found=self.low, expected="below high")

    class Outer(Schema):
        inner: Ordered

    document = read_yaml(written(tmp_path / "a.yaml", "inner:\n  low: 2\n  high: 1\n"))
    with raises(InputError, where="a.yaml, line 1, inner", found="2.0", expected="below high"):
        validated_document(document, Outer)


# words


def test_words_for_messages():
    assert field_path(("legs", 0, "base", "center", 2)) == "legs[1].base.center[3]"
    assert closest("Camrea", ["camera", "images"]) == "camera"
    assert closest("zzz", ["camera", "images"]) is None
    assert listed(["a"]) == "a"
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert listed([str(n) for n in range(20)]) == "0, 1, 2, 3, 4 and 15 more"
    assert quoted(None) == "nothing"
    assert len(quoted("x" * 500)) == 60


@pytest.mark.parametrize("text", ["1e300", "-2e15", "9" * 300])
def test_numbers_that_no_quantity_has(tmp_path, text):
    (tmp_path / "a.csv").write_text(f"configuration,x\na,{text}\n")
    with raises(InputError, where="a.csv, line 2, column x", expected="at most 1e+15"):
        read_csv(tmp_path / "a.csv")
    (tmp_path / "a.yaml").write_text(f"values:\n  - 1\n  - {text}\n")
    with raises(InputError, where="a.yaml, line 3, values[2]", expected="at most 1e+15"):
        validated_document(read_yaml(tmp_path / "a.yaml"), Numbers)


class Numbers(Schema):
    values: tuple[float, ...]
