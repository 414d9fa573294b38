"""Verdicts on other people's files: printers with their height maps, cameras, images of boards.

    OPENBLAS_NUM_THREADS=1 python benchmarks/public.py FOLDER [--only PART] [--write]

FOLDER holds files as their owners publish them: each repository of GitHub in a folder
``OWNER+NAME``, with the repository's own paths in it. None of them belongs to pkmcal, and few have
a licence, so fetch them yourself: ``public.csv`` beside this program lists repositories and paths,
with the verdicts of the last run. Files are taken by their names:

- printer: configuration of a firmware. Where it or a height map in its folder has probed points,
  the session of these is checked and calibrated.
- camera: file of ROS, Kalibr, OpenCV, mrcal, COLMAP or ViSP.
- board: folder of images with a ``board.yaml``, written by hand after the owner's description; its
  camera is calibrated.

Printed: verdict, codes of the findings or the refusal, and seconds of each file; then the number of
files of each kind and verdict, the files of each code, and what differs from ``public.csv``. A
person judged there whether a verdict and its codes are right (``yes``), or false alarms (``no``);
these are counted. --write : replace the verdicts of ``public.csv``, with the judgements of those
that are the same.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pkmcal
from pkmcal.errors import InputError, PkmcalError
from pkmcal.firmware.contract import read_printer
from pkmcal.firmware.session import write_printer_session

LEDGER = Path(__file__).with_name("public.csv")
IMAGES = {".png", ".jpg", ".jpeg"}
CAMERA_NAMES = (
    "*.cameramodel", "*camera*.xml", "cameras.txt", "ost.yaml", "*camera_info.yaml",
    "*chain.yaml",
)  # fmt: skip
PRINTER_NAMES = (
    "printer*.cfg", "*delta*.cfg", "*kossel*.cfg", "config.g", "Configuration.h", "config", "*.epr",
)  # fmt: skip
COLUMNS = "file", "kind", "verdict", "codes", "right"


class Row(NamedTuple):
    """Verdict on one file.

    verdict : usable, unusable, read, or refused. codes : of findings, or the refusal's words.
    right : yes, no, or empty where nobody judged.
    """

    file: str
    kind: str
    verdict: str
    codes: str
    right: str = ""


def camera(path: Path) -> tuple[str, str]:
    """Of the only camera, or the first one of Kalibr's several."""
    pkmcal.load_camera(path.with_name(f"{path.name}#cam0") if path.match("*chain.yaml") else path)
    return "read", ""


def printer(path: Path) -> tuple[str, str]:
    read_printer(path)
    maps = sorted(path.parent.glob("heightmap*.csv")) if path.name == "config.g" else []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "session"
        try:
            write_printer_session(folder, path, maps[0] if maps else None)
        except InputError:
            if maps:
                raise
            return "read", ""
        check, result = pkmcal.check(folder), pkmcal.calibrate(folder)
    codes = {one.code for one in check.findings} | set(result.verdict.codes)
    return "usable" if result.verdict.usable else "unusable", " ".join(sorted(codes))


def board(path: Path) -> tuple[str, str]:
    images = sorted(one for one in path.parent.iterdir() if one.suffix.lower() in IMAGES)
    result = pkmcal.camera(images, board=path)
    codes = " ".join(sorted(set(result.outcome.verdict.codes)))
    return "usable" if result.outcome.verdict.usable else "unusable", codes


READERS: dict[str, Callable[[Path], tuple[str, str]]] = {
    "printer": printer,
    "camera": camera,
    "board": board,
}


def kind_of(path: Path) -> str | None:
    if path.name == "board.yaml":
        return "board"
    if any(path.match(name) for name in PRINTER_NAMES):
        return "printer"
    return "camera" if any(path.match(name) for name in CAMERA_NAMES) else None


def by_codes(rows: Iterable[Row]) -> Counter[tuple[str, str]]:
    """Number of files by judgement (yes, no, or nobody's) and code, or refusal."""
    out: Counter[tuple[str, str]] = Counter()
    for row in rows:
        codes = [row.codes] if row.verdict == "refused" else row.codes.split()
        out.update((row.right or "not judged", code) for code in codes)
    return out


def rows_of(folder: Path, only: str) -> Iterator[tuple[Row, float]]:
    """Verdicts on the files of a folder, with their seconds."""
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        kind = kind_of(path) if path.is_file() and only in name else None
        if kind is None:
            continue
        start = time.perf_counter()
        try:
            verdict, codes = READERS[kind](path)
        except PkmcalError as error:
            verdict, codes = "refused", error.what
        yield Row(name, kind, verdict, codes), time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="part of the paths of the files to read")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    with LEDGER.open(encoding="utf-8", newline="") as lines:
        before = {one["file"]: Row(**one) for one in csv.DictReader(lines)}
    rows, changed = list[Row](), list[str]()
    for read, seconds in rows_of(args.folder, args.only):
        row, old = read, before.get(read.file)
        if old is not None and old[:-1] == read[:-1]:
            row = old
        elif old is not None:
            changed.append(f"{old.file}: was {old.verdict}, {old.codes or 'no finding'}")
        print(
            f"{row.file}: {row.kind}, {row.verdict}, {row.codes or '-'}, {seconds:.1f} s",
            flush=True,
        )
        rows.append(row)
    print("\nfiles by kind and verdict")
    for (kind, verdict), number in sorted(Counter((r.kind, r.verdict) for r in rows).items()):
        print(f"{number:5} {kind}, {verdict}")
    print("\nfiles by judgement and finding")
    for (right, code), number in sorted(by_codes(rows).items()):
        print(f"{number:5} {right:11} {code}")
    print(f"\nfalse alarms: {sum(r.right == 'no' for r in rows)} of {len(rows)} files")
    print("changed:", *(changed or ["none"]), sep="\n  ")
    if args.write:
        others = [row for name, row in before.items() if name not in {r.file for r in rows}]
        with LEDGER.open("w", encoding="utf-8", newline="") as out:
            writer = csv.writer(out, lineterminator="\n")
            writer.writerows([COLUMNS, *sorted([*others, *rows])])


if __name__ == "__main__":
    main()
