"""The tree's words are the field's: identifiers and files are nouns, by the glossary in
docs/conventions.md, and no participles or verbs of speech.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "pkmcal"

NO_WORDS = frozenset(
    {
        "told",
        "said",
        "seen",
        "found",
        "known",
        "asked",
        "shown",
        "looked",
        "kept",
        "alike",
        "aside",
        "crowd",
        "doubt",
        "doubts",
        "doubted",
        "departure",
        "departures",
        "departed",
        "byhand",
        "closely",
        "drawing",
        "drawings",
        "photograph",
        "photographs",
        "photographed",
        "recognise",
        "recognition",
    }
)
"""Words that are no part of an identifier: they do not name a quantity, or the glossary has another
word for it.
"""
NO_NAMES = NO_WORDS | {"left", "way", "looks", "says", "tells", "ask", "tell"}
"""No identifier by itself; as a part they have a meaning (``left_margin``, ``half_way``)."""
NO_TEST_WORDS = frozenset(
    {
        *("told", "said", "tell", "tells", "says", "drawing", "drawings", "departure"),
        *("departures", "doubted", "photograph", "photographs", "recognise", "recognised"),
    }
)
"""Words of no test's name, which is a sentence: ``is_found`` and ``are_kept`` are English there."""
ALLOWED = {
    "found": "what an error found (`pkmcal.errors`, and its JSON), and keys of other documents",
    "seen": "keys of the documents of `check` and `validate`",
    "tells": "a key of the document of `check`",
    "known": "an argument of `pkmcal.compare`",
    "left": "the opposite of right",
    "drawing": "a column of the public table of parameters, and keys of documents",
    "by_drawing": "a key of calibration.json",
    "chi2_drawing": "a key of calibration.json",
    "n_drawing": "a key of calibration.json",
    "from_drawing": "an option of `pkmcal plan`",
    "photographs": "a key of the documents of `check`",
    "rejected_photographs": "a key of calibration.json",
    "ask": "a message to a page in its test",
}
"""Names that are part of a file, of the command line or of Python's public interface."""


def words(name: str) -> set[str]:
    return set(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().split("_"))


BOUND = {
    ast.FunctionDef: "name",
    ast.ClassDef: "name",
    ast.arg: "arg",
    ast.Name: "id",
    ast.Attribute: "attr",
    ast.ExceptHandler: "name",
    ast.alias: "asname",
    ast.MatchAs: "name",
    ast.MatchStar: "name",
}
"""Nodes that bind an identifier, with its field; names and attributes where they are stored."""


@cache
def definitions(path: Path) -> tuple[tuple[str, int], ...]:
    """Identifiers that a file binds, with their lines."""
    return tuple(bindings(path))


def bindings(path: Path) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        field = BOUND.get(type(node))
        if field and isinstance(getattr(node, "ctx", ast.Store()), ast.Store):
            name = getattr(node, field)
            if name is not None:
                yield name, node.lineno


@cache
def is_banned(name: str) -> bool:
    if name.startswith("test_"):
        return bool(words(name) & NO_TEST_WORDS)
    return name.strip("_") in NO_NAMES or bool(words(name) & NO_WORDS)


def sources() -> list[Path]:
    return [
        path
        for folder in (SOURCE, *(ROOT / name for name in ("tests", "benchmarks", "tools")))
        for path in sorted(folder.rglob("*.py"))
    ]


def test_the_words_of_a_name_are_read():
    assert words("_ToldBy_x2Y") == {"", "told", "by", "x2", "y"}
    assert is_banned("_told")
    assert is_banned("FoundPose")
    assert is_banned("left")
    assert is_banned("test_a_fault_is_told")
    assert not is_banned("test_a_fault_is_found")
    assert not is_banned("left_margin")
    assert not is_banned("T_camera_base")


def test_identifiers_are_nouns_of_the_field():
    wrong = [
        f"{path.relative_to(ROOT)}:{line} {name}"
        for path in sources()
        for name, line in definitions(path)
        if is_banned(name) and name not in ALLOWED
    ]
    assert wrong == []


def test_files_are_named_by_what_they_hold():
    assert [
        str(path.relative_to(ROOT))
        for path in sources()
        if is_banned(path.stem) and path.name != "recognition.py"  # a published benchmark
    ] == []


def test_every_exception_is_still_needed():
    bound = {name for path in sources() for name, _ in definitions(path)}
    assert sorted(ALLOWED.keys() - bound) == []
    assert [name for name in ALLOWED if not is_banned(name)] == []


def test_the_glossary_names_files_that_there_are():
    text = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    table = text.split("## Glossary", 1)[1]
    named = re.findall(r"`([\w/]+\.py)`", table.split("| --- |", 1)[1])
    assert named
    assert [name for name in named if not (SOURCE / name).is_file()] == []
