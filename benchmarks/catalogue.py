"""Commands on sessions without a mistake, of every machine of the catalogue.

    OPENBLAS_NUM_THREADS=1 python benchmarks/catalogue.py [--sessions 5] [--machines NAME ...]
                                                          [--kind legs|board] [--workers 2]

Each session is simulated with its own machine, rendered, and divided: calibrate and calibrate
--holdout get the first configurations, validate and watch five each of the others. For each machine
and kind of image, and each command: sessions in which it works, asks for more configurations, is
refused, or is accepted and wrong; then the findings, with their codes, of all that are not plain
acceptances. Wrong is a tool that is off by more than three of its stated standard deviations, and
for watch a change that it claims.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from right_sessions import Session, off_by

HINGED = ("h4-rods",)
"""Machines that cannot be simulated: how far their side bars turn is not known."""
COMMANDS = ("calibrate", "holdout", "validate", "watch")
CONFIGURATIONS, LEFT_OUT = 24, 5
"""Configurations to calibrate from; of each, besides: held out, validated with, watched with."""
STATIONS = {"legs": (2, (640, 480)), "board": (1, (1280, 960))}
"""Stations of a kind of image, and the images' size."""
NOISE = 1e-5
"""m or rad, of a reading."""
TOO_FEW = ("watch.leg_weak", "watch.leg_blind")
"""Findings by which a watch asks for more configurations, as its page says how many may."""
FAR = 3.0
"""Stated standard deviations beyond which an error is not to be accepted."""


class Answer(NamedTuple):
    """A command's answer: works, asks for more, refused or wrong; codes of warnings and errors."""

    word: str
    codes: tuple[str, ...]


def catalogue() -> list[str]:
    """Names of the built-in machines that can be simulated."""
    from importlib.resources import files

    names = sorted(Path(str(f)).stem for f in (files("pkmcal") / "mechanisms/catalog").iterdir())
    return [name for name in names if name not in HINGED]


def divided(folder: Path, name: str, rows: slice) -> Path:
    """Copy of a session with some of its configurations."""
    part = folder.with_name(name)
    shutil.copytree(folder, part, ignore=shutil.ignore_patterns("truth.json"))
    with (folder / "joints.csv").open(newline="") as file:
        head, *body = csv.reader(file)
    with (part / "joints.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *body[rows]])
    chosen = {row[0] for row in body[rows]}
    for image in part.glob("images/**/*.png"):
        if image.stem not in chosen:
            image.unlink()
    return part


def answer(run: Callable[[], Any], wrong: Callable[[Any], bool]) -> tuple[Answer, Any]:
    """A command's answer, and its result."""
    from pkmcal.errors import PkmcalError

    try:
        result = run()
        codes = tuple(f.code for f in result.findings if f.level != "note")
    except PkmcalError as error:
        return Answer("refused", (f"{type(error).__name__}: {error}",)), None
    if result.exit_code:
        more = bool(codes) and all(code.startswith(TOO_FEW) for code in codes)
        return Answer("asks for more" if more else "refused", codes), result
    return Answer("wrong" if wrong(result) else "works", codes), result


def answers(machine: str, kind: str, seed: int) -> dict[str, Answer]:
    """Answers of all commands on one session."""
    import pkmcal
    from pkmcal.simulation import load_truth

    stations, size = STATIONS[kind]
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary) / "session", Path(temporary) / "result"
        observed = {"board": True, "on_platform": True, "observe": ("board",)}
        pkmcal.simulate(
            folder, machine, camera=size, stations=stations,
            configurations=CONFIGURATIONS + 3 * LEFT_OUT, shared=True, joint_noise=NOISE,
            seed=seed, **(observed if kind == "board" else {}),
        )  # fmt: skip
        truth = load_truth(folder)
        true = Session(folder, truth.machine, truth.T_base_platform, truth.joints)
        first = divided(folder, "first", slice(None, -2 * LEFT_OUT))
        others = {
            "validate": divided(folder, "others", slice(-2 * LEFT_OUT, -LEFT_OUT)),
            "watch": divided(folder, "today", slice(-LEFT_OUT, None)),
        }
        far: Callable[[Any], bool] = lambda result: off_by(result, true) > FAR  # noqa: E731
        out_of: dict[str, Answer] = {}
        out_of["calibrate"], result = answer(lambda: pkmcal.calibrate(first), far)
        out_of["holdout"], _ = answer(lambda: pkmcal.calibrate(first, holdout=LEFT_OUT), far)
        if result is None:
            return out_of
        result.save(out)
        for name, session in others.items():
            command = getattr(pkmcal, name)
            out_of[name], _ = answer(lambda c=command, s=session: c(out, s), lambda _: False)
    return out_of


def main() -> None:
    """A line a machine and kind of image, then the findings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=5, help="of each machine and kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--machines", nargs="*", metavar="NAME", help="these machines alone")
    parser.add_argument("--kind", choices=list(STATIONS), help="these images alone")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.sessions)
    print(f"{'':24}" + "".join(f"{name:>22}" for name in COMMANDS))
    words: list[str] = []
    with ProcessPoolExecutor(options.workers) as pool:
        for machine in options.machines or catalogue():
            for kind in [options.kind] if options.kind else STATIONS:
                jobs = [(machine, kind, seed) for seed in seeds]
                results = list(pool.map(answers, *zip(*jobs, strict=True)))
                cells = []
                for name in COMMANDS:
                    counts = Counter(r[name].word if name in r else "not run" for r in results)
                    cells.append(", ".join(f"{n} {word}" for word, n in counts.most_common()))
                print(
                    f"{machine + ', ' + kind:24}" + "".join(f"{c:>22}" for c in cells), flush=True
                )
                words += [
                    f"{machine}, {kind}, {seed}: {name} {a.word}: {', '.join(a.codes)}"
                    for seed, result in zip(seeds, results, strict=True)
                    for name, a in result.items()
                    if a.word != "works" or a.codes
                ]
    print("\n" + "\n".join(words))


if __name__ == "__main__":
    main()
