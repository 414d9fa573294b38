"""Every regular expression in the tree takes time in proportion to the text, whatever the text."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import pkmcal
from backtracking import ambiguity

SOURCE = Path(pkmcal.__file__).parent
METHODS = ("match", "fullmatch", "search", "findall", "finditer", "split", "sub", "subn")
PLACES_OF_FLAGS = {"compile": 1, "split": 3, "sub": 4, "subn": 4}
"""Number of arguments before a pattern's text in functions of `re`; two for the others."""
MADE = {
    "files/documents.py: f'(?:{_pattern})\\\\Z'": "[rf'(?:{p})\\Z' for _, p, _ in _SCALARS]",
}
"""Arguments that are not written where they are used, and how to make all that they stand for."""
BOUNDED = {
    "session/image_files.py: _regex(parts, '|'.join(map(re.escape, some)))":
        r"a/(?P<configuration>x|xy)_(?P<repeat>[^/]+?)\.png",
    "session/image_files.py: _regex(parts, '[^/]+?')":
        r"a/(?P<configuration>[^/]+?)_(?P<repeat>[^/]+?)\.png",
}  # fmt: skip
"""Patterns with an example, for texts that are no longer than a file's name: may be polynomial."""
METHOD_BY_OWNER = {"files/documents.py: f'(?:{_pattern})\\\\Z'": "match"}
"""Uses of patterns that are passed to another library: PyYAML's resolver."""


class Use(NamedTuple):
    """One use of a pattern; key : its file and the text of its argument."""

    key: str
    line: int
    pattern: str | bytes
    flags: int
    method: str


def uses_of(path: Path) -> list[Use]:
    """Every use of a pattern in a file; one that is compiled counts by each method called on it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if "re" not in {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}:
        return []
    place = path.relative_to(SOURCE).as_posix()
    names = vars(import_module("pkmcal." + place.removesuffix(".py").replace("/", ".")))

    def value(node: ast.expr) -> Any:
        return eval(compile(ast.Expression(node), place, "eval"), names)

    calls = [
        (node, node.func.value.id, node.func.attr)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
    ]
    constants = {
        id(node.value): node.targets[0].id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    out = []
    for node, owner, method in calls:
        if owner != "re" or method not in (*METHODS, "compile"):
            continue
        key = f"{place}: {ast.unparse(node.args[0])}"
        if key in MADE:
            patterns = value(ast.parse(MADE[key], mode="eval").body)
        else:
            patterns = [BOUNDED[key] if key in BOUNDED else value(node.args[0])]
        at = PLACES_OF_FLAGS.get(method, 2)
        given = [k.value for k in node.keywords if k.arg == "flags"] or node.args[at : at + 1]
        flags = int(value(given[0])) if given else 0
        methods = {method}
        if method == "compile":
            name = constants.get(id(node))
            methods = {m for _, other, m in calls if other == name and m in METHODS}
            methods = methods or {METHOD_BY_OWNER[key]}
        out += [Use(key, node.lineno, p, flags, m) for p in patterns for m in sorted(methods)]
    return out


FILES = [path for path in sorted(SOURCE.rglob("*.py")) if "re." in path.read_text(encoding="utf-8")]


def test_every_pattern_takes_linear_time():
    uses = [use for path in FILES for use in uses_of(path)]
    slow = {f"{use.key} ({use.method}, line {use.line})": value
            for use in uses
            if (value := ambiguity(use.pattern, use.flags, use.method))
            and not (use.key in BOUNDED and value == "polynomial")}  # fmt: skip
    assert not slow
    assert {use.key for use in uses} >= {*MADE, *BOUNDED}  # what is no longer there goes


@pytest.mark.parametrize(("pattern", "flags", "method", "growth"), [
    (rb"P[2356]\s+(?:#.*\s+)*(\d{1,9})\s+(?:#.*\s+)*(\d{1,9})\s", 0, "match", "exponential"),
    (r"(a*)*b", 0, "match", "exponential"),
    (r"(a|a)*b", 0, "match", "exponential"),
    (r"(?:a+)+$", 0, "match", "exponential"),
    (r"(ab|a|b)*c", 0, "match", "exponential"),
    (r"(a|b)*c", 0, "match", None),
    (r"(a?b?)*c", 0, "match", None),
    (r"a*a*b", 0, "match", "polynomial"),
    (r".*.*=", 0, "match", "polynomial"),
    (r"\d+\.?\d*x", 0, "match", "polynomial"),
    (r"\d+(\.\d*)?x", 0, "match", None),
    (r"x*y", 0, "match", None),
    (r"x*y", 0, "search", "polynomial"),
    (r"\s+", 0, "search", None),
    (r"\s+$", 0, "search", "polynomial"),
    (r"^\s*G30", re.MULTILINE, "findall", "polynomial"),
    (r"^[ \t]*G30", re.MULTILINE, "findall", None),
    (r"[^/]{256,}", 0, "sub", None),
])  # fmt: skip
def test_growth_of_patterns_is_identified(pattern, flags, method, growth):
    assert ambiguity(pattern, flags, method) == growth


def test_what_is_called_exponential_is():
    """The number of steps itself, by an engine that tries what `re` tries."""

    def steps(pattern, text):
        tried = 0

        def match(nodes, at, rest):
            nonlocal tried
            tried += 1
            if not nodes:
                return rest(at)
            head, tail = nodes[0], nodes[1:]
            if isinstance(head, str):
                return at < len(text) and text[at] == head and match(tail, at + 1, rest)

            def again(there):
                return there > at and match(nodes, there, rest)

            return any(match(body, at, again) for body in head) or match(tail, at, rest)

        match(pattern, 0, lambda _: True)
        return tried

    plain, twice = [["a", "b"], "c"], [[[["a"]]], "c"]  # (a|b)*c and (a*)*c
    assert steps(plain, "a" * 16) < 2.5 * steps(plain, "a" * 8)
    assert steps(twice, "a" * 16) > 100 * steps(twice, "a" * 8)
    assert ambiguity("(a|b)*c", 0, "match") is None
    assert ambiguity("(a*)*c", 0, "match") == "exponential"
