"""Runs cases and prints their summary; exit code 1 where pkmcal did something wrong."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from contextlib import nullcontext, redirect_stdout, suppress
from io import StringIO
from pathlib import Path

# Threads would be lost in a fork, and are slow on one core; OpenCV is set as by the command line.
# Libraries read these variables when they are imported.
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "COLUMNS": "80"}
os.environ["OPENCV_LOG_LEVEL"] = "SILENT"

from fuzz.bases import make, one_camera_model
from fuzz.cases import FIRST, telling
from fuzz.run import Summary, run, warm


def main() -> int:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("count", nargs="?", type=int, default=300, help="of cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--only", type=int, nargs="+", help="these cases; their folders are kept")
    values = "only those of them that try something which none before them does"
    parser.add_argument("--telling", action="store_true", help=values)
    parser.add_argument("--bases", type=Path, help="made by an earlier run, to go on with")
    given = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # one core, so that a study has one worker: this process
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    place = Path(tempfile.mkdtemp(prefix="pkmcal-fuzz-")).resolve()
    try:
        summary = fuzz(given, place)
    finally:
        if not given.only:
            shutil.rmtree(place, ignore_errors=True)
    if given.only:
        print(f"kept in {place}")
    print(summary.text())
    return 1 if summary.wrong else 0


def fuzz(given, place: Path) -> Summary:
    """The requested cases, or those until Ctrl-C."""
    bases = given.bases or place / "bases"
    warm()
    if not bases.exists():
        # in a process of its own: it starts threads, which later forks would lose
        child = os.fork()
        if not child:
            with redirect_stdout(StringIO()):
                make(bases)
            os._exit(0)
        if os.waitpid(child, 0)[1]:
            raise SystemExit("the files to spoil could not be made")
    summary = Summary()
    numbers = given.only or range(given.first, given.first + given.count)
    if given.telling:
        numbers = telling(numbers, bases, place)
    # quick cases do not compare all models of a camera
    models = one_camera_model() if max(numbers) < FIRST else nullcontext()
    with suppress(KeyboardInterrupt), models:
        for number in numbers:
            result = run(number, bases, place, keep=bool(given.only))
            summary.add(result)
            if result.faults or given.only:
                show(result)
    return summary


def show(result) -> None:
    """A case, its violations of the rules, and the beginning of its output."""
    print(f"{result.case}\n  exit {result.code}: {'; '.join(result.faults) or 'good'}")
    for text in (result.err, result.out):
        print("".join(f"    {line[:400]}\n" for line in text.splitlines()[:6]), end="")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main())
