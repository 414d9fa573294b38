"""Findings: their codes, facts and sentences, the tree against the data files."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import pkmcal
from pkmcal.errors import InputError, ResultError
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import (
    Finding,
    Level,
    doubtful,
    fields_of,
    filled,
    note,
    of_error,
    templates,
    wrong,
)

SOURCE = Path(pkmcal.__file__).parent
AREAS = sorted(path.stem for path in (SOURCE / "outcome" / "sentences").glob("*.toml"))
ENTRIES = {code: entry for area in AREAS for code, entry in templates(area).items()}
FIELDS = {
    code: set().union(*(part for text in entry.values() for part in fields_of(text)))
    for code, entry in ENTRIES.items()
}
MAKERS = {"finding", "wrong", "doubtful", "note"}
VIOLATION_FACTS = ("calibration/model_violations.py", "cameras/contract.py", "session/readings.py")


VIOLATIONS = {code for code in ENTRIES if "tool_shift_sigmas" in FIELDS[code]}
FACTS_OF_VIOLATIONS = set[str]().union(*(FIELDS[code] for code in VIOLATIONS))


def keys(tree: ast.AST) -> set[str]:
    """Names of facts that code may give: keys of dictionaries, and of assignments to them."""
    results = {k.value for n in ast.walk(tree) if isinstance(n, ast.Dict) for k in n.keys
             if isinstance(k, ast.Constant)}  # fmt: skip
    results |= {n.slice.value for n in ast.walk(tree)
              if isinstance(n, ast.Subscript) and isinstance(n.slice, ast.Constant)}  # fmt: skip
    results |= {k.arg for n in ast.walk(tree) if isinstance(n, ast.Call) for k in n.keywords
              if k.arg}  # fmt: skip
    return {key for key in results if isinstance(key, str)}


def codes_of(code: ast.expr, facts: set[str]) -> set[str]:
    """Codes that an argument may be, of a formatted text those with a sentence for the facts."""
    if isinstance(code, ast.Constant):
        return {str(code.value)}
    if isinstance(code, ast.IfExp):
        return codes_of(code.body, facts) | codes_of(code.orelse, facts)
    if isinstance(code, ast.JoinedStr):
        parts = [re.escape(p.value) if isinstance(p, ast.Constant) else r"[\w.]+"
                 for p in code.values]  # fmt: skip
        pattern = re.compile("".join(parts))
        return {c for c in ENTRIES if pattern.fullmatch(c) and FIELDS[c] <= facts}
    return set()


def makes_finding(call: ast.Call) -> bool:
    """Whether it makes a column whose facts are those of a finding."""
    return getattr(call.func, "id", "") == "Column" and any(k.arg == "facts" for k in call.keywords)


@cache
def calls() -> list[tuple[str, set[str], set[str]]]:
    """Every place where a finding is made: its file and line, codes, and the facts given."""
    texts = {path: path.read_text(encoding="utf-8") for path in SOURCE.rglob("*.py")}
    trees = {
        p: ast.parse(text) for p, text in texts.items() if re.search(r"finding|\bColumn\(", text)
    }
    del trees[SOURCE / "outcome" / "finding.py"]
    detections = set[str]().union(*(keys(trees[SOURCE / name]) for name in VIOLATION_FACTS))
    out: list[tuple[str, set[str], set[str]]] = []
    for path, tree in trees.items():
        nodes = [n for n in ast.walk(tree) if isinstance(n, ast.Call)]
        made = [n for n in nodes if getattr(n.func, "id", "") in MAKERS or makes_finding(n)]
        inside = keys(tree) if made else set[str]()
        for node in made:
            facts = {k.arg for k in node.keywords if k.arg} | {"subject"}
            others = any(k.arg is None for k in node.keywords)
            if others or makes_finding(node):
                facts |= inside | detections
            where = f"{path.relative_to(SOURCE)}:{node.lineno}"
            out.append((where, codes_of(node.args[0], facts), facts))
    return out


def test_every_code_has_a_sentence_and_every_sentence_a_use():
    used: set[str] = set()
    for where, codes, _ in calls():
        assert codes, f"{where}: the code is not written where the finding is made"
        assert codes <= ENTRIES.keys(), f"{where}: no sentence"
        used |= codes
    # a finding's own, appended to the sentence of any violation that has rivals
    assert ENTRIES.keys() - used == {"violation.rivals"}


def test_every_placeholder_is_given():
    for where, codes, facts in calls():
        for code in codes:
            assert FIELDS[code] <= facts, f"{where}: {code} without its facts"


def test_entries_hold_a_text_and_perhaps_a_next_step():
    for code, entry in ENTRIES.items():
        assert {"text"} <= entry.keys() <= {"text", "next_step"}, code
        assert entry["text"] == entry["text"].strip(), code


FAILURES = {"PkmcalError", "ResultError", "GeometryError", "NO_ESTIMATE"}
STARTS = {"initial_guess", "_tracker_starts"}
"""Choose where a search starts; without another start nothing is missing from its result."""


def test_no_failure_is_dropped():
    """Each handler of a pkmcal error raises again, or uses the error: for a finding, a reason, a
    page.
    """
    for folder in ("calibration", "checks", "judge", "api"):
        paths = list((SOURCE / folder).rglob("*.py"))
        assert paths, folder
        for path in paths:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            exempt = {
                handler
                for node in ast.walk(tree)
                if isinstance(node, ast.FunctionDef) and node.name in STARTS
                for handler in ast.walk(node)
            }
            for node in ast.walk(tree):
                if not isinstance(node, ast.ExceptHandler) or node.type is None or node in exempt:
                    continue
                kinds = {n.id for n in ast.walk(node.type) if isinstance(n, ast.Name)}
                if kinds.isdisjoint(FAILURES):
                    continue
                inside = [n for part in node.body for n in ast.walk(part)]
                used = any(isinstance(n, ast.Name) and n.id == node.name for n in inside)
                raised = any(isinstance(n, ast.Raise) for n in inside)
                assert used or raised, f"{path.relative_to(SOURCE)}:{node.lineno}"


def test_violations_have_kinds_for_files():
    """A column with facts says its kind, and each violation's sentence has such a column."""
    codes = set[str]()
    for path in SOURCE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "Column(" in text else ():
            if isinstance(node, ast.Call) and makes_finding(node):
                assert len(node.args) == 3, f"{path}:{node.lineno}: a column without its kind"
                codes |= codes_of(node.args[0], FACTS_OF_VIOLATIONS)
    assert codes >= VIOLATIONS


@pytest.mark.parametrize(
    ("template", "facts", "text"),
    [
        ("{x:.2g mm} of {n}", {"x": 0.00123, "n": 3}, "1.2 mm of 3"),
        ("{x:amount m}, {y+unit:amount}", {"x": -7e-5, "y": 0.1, "unit": "rad"}, "0.070 mm, 5.7°"),
        ("{x:size .1%} {x:sign more|less}", {"x": -0.0123}, "1.2 % less"),
        ("{x+s:ratio}", {"x": 0.0123, "s": 0.001}, "1.23 ± 0.10 %"),
        ("{legs:count leg} {legs:one is|are}", {"legs": [1, 2]}, "2 legs are"),
        ("{names:listed 3}", {"names": ["a", "b", "c", "d"]}, "a, b and 2 more"),
        ("{names:joined}", {"names": ("a", "b", "c")}, "a, b and c"),
        ("{kind:case a=this|b=that}", {"kind": "b"}, "that"),
        ("{noise+units:either .2g}", {"noise": 1e-3, "units": ["m", "rad"]}, "1 mm or 0.057°"),
        ("{a:range} {b:range}", {"a": (0.5, 2), "b": (0.5, None)}, "0.5 to 2 more than 0.5"),
        ("{x:often} {y:capital}", {"x": 0.01, "y": "legs"}, "once in 100 times Legs"),
        ("A[[ with {m}]].", {"m": None}, "A."),
        ("A[[ with {m}||, alone]].", {}, "A, alone."),
        ("A[[ with {m}||, alone]].", {"m": 0}, "A with 0."),
    ],
)
def test_templates(template, facts, text):
    assert filled(template, facts) == text


def test_a_verdict_has_findings_by_level_and_their_document():
    few = note("configurations.few", number=4)
    rare = wrong("edges.leg_seldom_seen", leg=3)
    verdict = Verdict(False, "No.", (rare, doubtful("edges.polished", value=0.1), few))
    assert verdict.codes == ("edges.leg_seldom_seen", "edges.polished", "configurations.few")
    assert [one.code for one in verdict.of("edges")] == ["edges.leg_seldom_seen", "edges.polished"]
    assert (verdict.reasons, verdict.advice) == ((rare.text,), (few.text,))
    assert len(verdict.warnings) == 1
    document = verdict.document()
    assert document["reasons"] == (rare.text,)
    first = document["findings"][0]
    assert (first["code"], first["level"], first["text"]) == (
        "edges.leg_seldom_seen",
        "wrong",
        rare.text,
    )
    assert first["facts"] == {"leg": 3}


def test_an_error_is_a_finding_under_its_code():
    error = InputError("is turned", where="joints.csv", code="readings.sign")
    value = of_error(error, station="front")
    assert (value.code, value.level, value.station) == ("readings.sign", Level.WRONG, "front")
    assert value.text == str(error)
    assert value.document()["where"] == "joints.csv"
    assert of_error(ResultError("none"), Level.DOUBTFUL).code == "error.result"
    assert error.located("folder").code == error.code


def test_a_finding_that_was_read_back_keeps_its_words():
    old = Finding("edges.retired", Level.NOTE, {"x": 1}, saved_text="It was so.")
    assert old.text == "It was so."
    assert old.next_step == ""
