"""A case by its number: which files are spoilt and how, and the command that reads them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from fuzz import trees
from fuzz.markup import SUFFIXES, spoil_xml
from fuzz.pictures import spoil_picture
from fuzz.texts import spoil_bytes, spoil_table

TREE = (".yaml", ".json")
PICTURES = (".png", ".jpg")


@dataclass(frozen=True)
class Task:
    """A command, and the files that it reads.

    words : SESSION, CALIBRATION and the like name copies of the bases; OUT the output folder, FILE
    the damaged file, if there is one by itself. files : patterns of files to damage. before : the
    base whose files are in OUT beforehand. often : its weight.
    """

    words: str
    files: tuple[str, ...]
    before: str = ""
    often: int = 2

    @property
    def quick(self) -> bool:
        """Whether it takes tenths of a second at most where the files are still good."""
        return self.words.startswith(QUICK)


QUICK = ("calibrate tracker", "check tracker", "validate", "watch", "export", "camera board/",
         "simulate OUT --plan", "read-camera", "new", "show")  # fmt: skip
OF_OURS = ("read-camera", "look-at")
"""No commands but what commands are made of."""
FIRST = 1000
"""Cases of smaller numbers have quick tasks only, for tests that are run often."""
OWN = ("session.yaml", "mechanism.yaml", "joints.csv", "cameras/*.yaml", "images/**/*.*")
LEGS = tuple(f"legs/{name}" for name in OWN)
HAND = ("hand/session.yaml", "hand/images/**/*.jpg", "hand/joints.csv")
TRACKER = tuple(
    f"tracker/{n}"
    for n in ("session.yaml", "mechanism.yaml", "joints.csv", "poses.csv", "distances.csv")
)
LATER = tuple(f"later/{n}" for n in ("session.yaml", "mechanism.yaml", "joints.csv", "poses.csv"))
BOARD = ("board/session.yaml", "board/board.yaml", "board/cameras/camera.yaml", "board/joints.csv",
         "board/images/*.png")  # fmt: skip
PRINTERS = tuple(
    f"printers/{n}" for n in ("printer.cfg", "config.g", "m503.txt", "configuration.txt")
)
POINTS = tuple(f"printers/{n}" for n in ("console.txt", "bed.g", "heightmap.txt", "points.csv"))
MODELS = tuple(f"models/{n}" for n in ("robot.xml", "robot.sdf", "robot.urdf", "copies.xml"))
RESULT = ("calibration/calibration.json",)
TASKS = (
    Task("calibrate legs -o OUT", LEGS, "calibration", 6),
    Task("calibrate tracker -o OUT", TRACKER, "calibration", 12),
    Task("calibrate hand -o OUT", HAND, "calibration", 1),
    Task("calibrate board -o OUT", BOARD, "calibration", 2),
    Task("check legs", LEGS, "check", 3),
    Task("check tracker -o OUT", TRACKER, "check", 6),
    Task("check board", BOARD, "check", 1),
    Task("check hand --pictures OUT", HAND, "", 1),
    Task("plan legs -n 2 -o OUT", LEGS[:4], "plan", 1),
    Task("plan tracker -n 2 --after calibration -o OUT", TRACKER[:3] + RESULT, "plan", 2),
    Task("plan FILE -n 2 -o OUT", ("machines/*.yaml",), "plan", 1),
    Task("plan 3-rpr --camera FILE -n 2 -o OUT", ("cameras/pinhole.yaml",), "plan", 1),
    Task("validate calibration later -o OUT", LATER + 4 * RESULT, "validation", 8),
    Task("watch calibration later -o OUT", LATER + 4 * RESULT, "watch", 8),
    Task("diff calibration machines/gough-stewart.yaml -o OUT", RESULT, "diff", 2),
    Task("diff FILE FILE -o OUT", ("machines/*.yaml",), "diff", 1),
    Task("export calibration --to json -o OUT", RESULT, "export", 4),
    Task("export calibration --to FORMAT -o OUT", RESULT, "", 4),
    Task("export calibration --to ros --session tracker -o OUT", RESULT + TRACKER[:1], "", 1),
    Task("export FILE --to FORMAT -o OUT", ("machines/*.yaml",), "", 6),
    Task("camera board -o OUT", BOARD[:2] + 2 * BOARD[-1:], "camera", 2),
    Task("camera board/images --board FILE -o OUT", ("board/board.yaml",), "camera", 2),
    Task("camera board/images --board board/board.yaml -o OUT", BOARD[-1:], "camera", 2),
    Task("show FILE -o OUT/page.html", ("machines/*.yaml",), "", 4),
    Task("servo calibration --camera cameras/pinhole.yaml --runs 1 --duration 1 -o OUT",
         (*RESULT, "cameras/pinhole.yaml"), "servo", 1),
    Task("simulate OUT --plan plan", ("plan/plan.json",), "", 3),
    Task("simulate OUT --machine FILE --size 64x64 --stations 1 --configurations 2",
         ("machines/*.yaml",), "", 1),
    Task("simulate OUT --camera FILE --stations 1 --configurations 2 --machine 3-rpr",
         ("cameras/pinhole.yaml", "cameras/unified.yaml", "cameras/fisheye.yaml"), "", 1),
    Task("study FILE --vary configurations=3 --runs 2 -o OUT", ("machines/*.yaml",), "study", 1),
    Task("study 3-rpr --vary camera=FILE --runs 2 -o OUT", ("cameras/pinhole.yaml",), "", 1),
    Task("study 3-rpr --vary configurations=3 --runs 2 -o study",
         ("study/batches/study.json", "study/batches/*.npz"), "", 1),
    Task("read-camera FILE", ("cameras/*.*",), "", 10),
    Task("new OUT --printer FILE", PRINTERS, "", 4),
    Task("new OUT --printer printers/printer.cfg --probed FILE", POINTS, "", 4),
    Task("new OUT --printer printers/printer.cfg --part FILE", ("printers/part.yaml",), "", 2),
    Task("new OUT --printer FILE", ("printers/mesh.cfg",), "", 2),
    Task("new OUT --printer printers/mesh.cfg", ("printers/towers.cfg",), "", 1),
    Task("new OUT --printer printers/printer.cfg --probed FILE", ("printers/part.log",), "", 2),
    Task("new OUT --printer printers/m503.txt --probed FILE", ("printers/grid.txt",), "", 1),
    Task("new OUT --from FILE", ("printers/rotary.cfg", "printers/winch.cfg"), "", 2),
    Task("new OUT --from FILE", MODELS, "", 6),
    Task("new OUT --from models/robot.urdf", ("models/robot.loops.yaml",), "", 1),
    Task("new OUT --from models/whole.xml", ("models/part.xml",), "", 1),
    Task("new OUT --from FILE --leg 0.3", ("models/centres.csv",), "", 1),
    Task("new OUT --from FILE --leg 0.3 --unit mm", ("models/pins.hal",), "", 1),
    Task("new OUT --from FILE", ("models/hangprinter.g", "models/maslow.log"), "", 1),
    Task("look-at legs", LEGS, "", 2),
    Task("look-at board", BOARD, "", 1),
    Task("look-at hand", HAND, "", 1),
)  # fmt: skip
"""Most often those that are quick, where most malformed files are refused."""
FORMATS = ("c", "json", "mujoco", "yaml")
"""Commands that take every machine."""
ALONE = ("machines/", "cameras/", "printers/", "models/")
"""Bases of which a task takes one file only."""


@dataclass(frozen=True)
class Case:
    """Case that was made.

    words : the command. out : where it may write. spoilt : (file, how, words of which the message
    of a refusal should have one, none where there is no such place).
    """

    number: int
    words: tuple[str, ...]
    out: str
    spoilt: tuple[tuple[str, str, tuple[str, ...]], ...]

    def __str__(self) -> str:
        how = "; ".join(f"{file}: {what}" for file, what, _ in self.spoilt)
        return f"case {self.number}: pkmcal {' '.join(self.words)}   [{how}]"

    @property
    def news(self) -> set[tuple[str, str]]:
        """Novelty of a case: a fault in a kind of file, and a file of a command."""
        actual_names = set()
        for file, how, _ in self.spoilt:
            path = Path(file)
            actual_names.add((path.suffix, how.split(" '")[0]))  # whatever it was renamed to
            actual_names.add((self.words[0], path.suffix if path.suffix in PICTURES else path.name))
        return actual_names


def telling(numbers: Iterable[int], bases: Path, scratch: Path) -> list[int]:
    """Cases that try something which none before them does."""
    met, chosen = set(), []
    for number in numbers:
        place = scratch / f"case-{number}"
        place.mkdir(parents=True)
        news = make(number, bases, place).news
        shutil.rmtree(place)
        if not news <= met:
            chosen.append(number)
        met |= news
    return chosen


def make(number: int, bases: Path, place: Path) -> Case:
    """Write the case's files into a new folder."""
    rng = Random(f"pkmcal {number}")
    tasks = [task for task in TASKS if task.quick or number >= FIRST]
    task = rng.choices(tasks, [task.often for task in tasks])[0]
    copied = {pattern.split("/")[0] for pattern in task.files}
    copied |= {word.split("/")[0] for word in task.words.split()} & {
        p.name for p in bases.iterdir()
    }
    for name in sorted(copied):
        shutil.copytree(bases / name, place / name, copy_function=os.link)
    spoilt = []
    words = task.words
    for _ in range(rng.choices([1, 2, 3], [8, 2, 1])[0]):
        pattern = rng.choice(task.files)
        files = sorted(path for path in place.glob(pattern) if path.is_file())
        if not files:
            continue
        path = rng.choice(files)
        if "FILE" in words:
            words = words.replace("FILE", str(path.relative_to(place)))
        if pattern.startswith(ALONE) and spoilt:
            break
        name = str(path.relative_to(place))
        fresh = name not in [file for file, _, _ in spoilt]
        spoilt.append((name, *spoil(path, bases, place, rng, fresh)))
    words = words.replace("FORMAT", rng.choice(FORMATS))
    out = "study" if "-o study" in words else "out"
    if task.before and rng.random() < 0.5:
        shutil.copytree(bases / task.before, place / "out", copy_function=os.link)
        if rng.random() < 0.1:
            (place / "out" / "mine.txt").write_text("nobody else's business")
    words = words.replace("OUT", "out").split()
    if rng.random() < 0.4 and words[0] not in OF_OURS:
        words.append("--json")
    return Case(number, tuple(words), out, tuple(spoilt))


def spoil(
    path: Path, bases: Path, place: Path, rng: Random, fresh: bool
) -> tuple[str, tuple[str, ...]]:
    """Put one fault into one file; returns its name, and the words of its place.

    fresh : whether the file is whole; a damaged file can be damaged further as bytes only.
    """
    if rng.random() < 0.07:
        return _as_entry(path, place, rng), ()
    data = path.read_bytes()
    values: tuple[str, ...] = ()
    if path.suffix in PICTURES and fresh:
        others = {p.name: p.read_bytes() for p in (bases / "pictures").iterdir()}
        how, new = spoil_picture(data, others, rng)
    elif path.suffix == ".csv" and fresh and rng.random() < 0.7:
        how, text, values = spoil_table(data.decode(), rng)
        new = text.encode("utf-8", "surrogatepass")
    elif path.suffix in TREE and fresh and not data.startswith(b"%YAML") and rng.random() < 0.75:
        tree = trees.read_tree(path)
        how, values = trees.spoil_tree(tree, rng, path.suffix)
        new = trees.written(tree, path.suffix).encode("utf-8", "surrogatepass")
    elif path.suffix in SUFFIXES and fresh and rng.random() < 0.75:
        how, text = spoil_xml(data.decode(), rng)
        new = text.encode("utf-8", "surrogatepass")
    else:
        how, new = _spoil_npz(data, rng) if path.suffix == ".npz" else spoil_bytes(data, rng)
    # The bases are linked, not copied.
    path.unlink()
    path.write_bytes(new)
    return how, values


def _spoil_npz(data: bytes, rng: Random) -> tuple[str, bytes]:
    how, new = spoil_bytes(data, rng) if rng.random() < 0.3 else ("bits", bytearray(data))
    if how == "bits":
        for _ in range(3):
            new[rng.randrange(len(new))] ^= 1 << rng.randrange(8)
    return how, bytes(new)


def _as_entry(path: Path, place: Path, rng: Random) -> str:
    """Another thing under the file's name, or the file under another name."""
    kind = rng.choice(ENTRIES)
    if kind == "renamed":
        name = rng.choice(["a b", "ä", "-n", "\n", "[x]", "0000", "0001.png", path.stem + "x", "*"])
        path.rename(path.with_name(name + path.suffix))
        return f"{kind} {name!r}"
    if kind == "stranger":
        os.link(path, path.with_name(rng.choice(["9999", "x y", "\udcff", "0"]) + path.suffix))
        return kind
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "dangling link":
        path.symlink_to("nowhere")
    elif kind == "circle":
        path.symlink_to(path.name)
    elif kind == "device":
        path.symlink_to(rng.choice(["/dev/zero", "/dev/null"]))
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "another":
        others = sorted(p for p in place.rglob("*") if p.is_file())
        if others:
            os.link(rng.choice(others), path)
    elif kind == "holes":
        with path.open("wb") as stream:
            stream.truncate(rng.choice([10**6, 3 * 10**7]))
    return kind


ENTRIES = (
    "missing", "missing", "folder", "dangling link", "circle", "device", "pipe", "another",
    "renamed", "stranger", "holes",
)  # fmt: skip
