"""Malformed sessions: each refused in a sentence with the place, or used, without harm.

`fuzz` has the changes and the rules; here it is run as a program of its own, from which each case
is forked with bounds of memory and time.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.cases import FIRST, Case
from fuzz.run import judged

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="cases are forked")
TESTS = Path(__file__).parent
FEW, MANY = 90, 10_000


def fuzzed(count, *options):
    done = subprocess.run(
        [sys.executable, "-m", "fuzz", str(count), *options],
        cwd=TESTS,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_malformed_sessions_of_every_way():
    """Those of the first 90 cases with a new fault in a kind of file, or in a command's file."""
    text = fuzzed(FEW, "--telling")
    assert int(text.split(" cases")[0].split()[-1]) > 60
    assert "with faults 0" in text


@pytest.mark.slow
def test_ten_thousand_malformed_sessions():
    assert "with faults 0" in fuzzed(MANY, "--first", str(FIRST))


CASE = Case(0, ("calibrate", "s", "-o", "out"), "out", (("s/joints.csv", "cell", ("leg3",)),))
GOOD = "Error: joints.csv, line 4, column leg3: this is not a number; found 'x'.\n"


def faults(code=2, kilobytes=0, out="", err=GOOD, after=None):
    return judged(CASE, code, 0.0, kilobytes, out, err, {}, after or {}).faults


def test_a_proper_refusal_has_no_faults():
    assert faults() == ()
    assert faults(0, err="") == ()
    # progress of a long command, with the time that it still takes
    for line in ("Rendering (0 %, 10 s)", "Testing for changes (86 %, 10 s, 0:01 left)"):
        assert faults(0, err=f"{line}\n") == ()
        assert faults(err=f"{line}\n{GOOD}") == ()


@pytest.mark.parametrize(
    ("case", "fault"),
    [
        ({"code": 70}, "exit code 70"),
        ({"code": -9, "err": ""}, "exit code -9"),
        ({"kilobytes": 2 << 20}, "2048 MB"),
        ({"err": "libpng error: bad\n" + GOOD}, "internals: libpng"),
        ({"err": GOOD.replace("x", "<class 'str'>")}, "internals: <class"),
        ({"err": GOOD + GOOD}, "on standard error"),
        ({"err": ""}, "exit code 2 without an error"),
        ({"err": "Error: line 4, column leg3: not a number.\n"}, "no file named"),
        ({"err": "Error: joints.csv: not a table.\n"}, "no field, line or column named"),
        ({"err": GOOD.replace("x", "x" * 3000)}, "an error of 30"),
        ({"err": GOOD.replace("x", "\x1b[2J")}, "characters that cannot be seen"),
        ({"after": {"s/new": (1,)}}, "written outside the output: ['s/new']"),
        ({"after": {"out/report.html": (1,)}}, "refused, but written"),
        ({"code": 0, "err": "", "after": {"out/.a.part": (1,)}}, "left over"),
    ],
)
def test_the_judge_sees(case, fault):
    assert any(value.startswith(fault) for value in faults(**case)), faults(**case)
