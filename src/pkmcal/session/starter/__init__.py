"""A session to fill in: the files that ``pkmcal new`` writes, each with comments for a newcomer.

The starter session is a hexapod seen by its legs from one place; one of another machine, or with a
board, or from several places, is made of it.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files import csv_text, entries, read_text, staged_folder
from pkmcal.mechanisms import Machine, catalogue, load_mechanism
from pkmcal.mechanisms.document import MOTIONS

Seen = Literal["legs", "board", "both", "readings"]
SEEN: tuple[Seen, ...] = ("legs", "board", "both", "readings")
TEMPLATE = Path(__file__).parent / "session"
TO_FILL = {
    "mechanism.yaml": "write the drawing of your machine into it",
    "cameras/front.yaml": "write the calibration of your camera into it",
    "session.yaml": "write down how good the readings are, and each place that the camera stood in",
    "joints.csv": "write one row of readings for each configuration into it",
    "board.yaml": "write down which board it is, and measure its squares",
}
"""What a person still has to do in each file."""
PLACES = ("front", "left", "right", "back")
OBSERVE = {"legs": "legs", "board": "board", "both": "[legs, board]"}
BOARD = """\
# The board on the platform: a ChArUco board printed on something stiff and flat. Other kinds, and
# what each key means: docs/files.md, board.yaml.
type: charuco
squares: [7, 5]           # columns and rows of squares
square: 30 mm             # the side of a square: measure over all of them, and divide
marker: 22 mm             # the side of a marker
dictionary: DICT_5X5_100
tolerance: 0.1 %          # how well you measured: paper changes its size by as much
"""
ON_PLATFORM = """\

board:
  file: board.yaml
  fixed_to: platform          # it must not move on it; where it sits need not be known
"""
MOVED = """\
  {name}:
    camera: cameras/front.yaml  # the same camera, moved there later
    images: images/{name}/{{configuration}}.png
    observe: {observe}
"""
ALONE = """\
# No stations: this machine has more readings than freedoms, and they alone tell its geometry.
# Spread the configurations over all that it reaches.
"""
DRIVES = """\
  # Standard deviation of a reading: about a third of the encoder's repeatability.
  noise: 0.001 deg
"""


def write_session(
    folder: Path | str, machine: str | None = None, seen: Seen | None = None, places: int = 1
) -> tuple[str, ...]:
    """Write a session into a new or empty folder; returns its files.

    machine : a built-in machine's name or a mechanism file; without one a hexapod to be changed.
    seen : what the camera sees of it; the legs unless told, or a board where the drawing gives them
    no cylinders, or nothing where readings alone tell the geometry. places : that the camera stands
    in, one after another. Raises InputError for a folder that is not empty, and for legs that
    cannot be seen.
    """
    return write_texts(folder, session_texts(machine, seen, places))


def write_texts(folder: Path | str, texts: dict[str, str]) -> tuple[str, ...]:
    """Write a session's files, by their names, into a new or empty folder, whole or not at all."""
    folder = Path(folder)
    if entries(folder):
        raise InputError(
            "the folder for the new session is not empty",
            where=str(folder),
            expected="a new or empty folder",
            next_step="Name another folder; nothing was written into this one",
        )
    with staged_folder(folder) as stage:
        for name, text in texts.items():
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).write_bytes(text.encode("utf-8"))
    return tuple(texts)


def session_texts(
    machine: str | None = None, seen: Seen | None = None, places: int = 1
) -> dict[str, str]:
    """The session's files by their names, as of :func:`write_session`."""
    files = sorted(path for path in TEMPLATE.rglob("*") if path.is_file())
    texts = {path.relative_to(TEMPLATE).as_posix(): path.read_text("utf-8") for path in files}
    turns = False
    if machine is not None:
        drawn = load_mechanism(machine)
        visible = any(leg.tubes for leg in drawn.document.legs)
        if not visible and seen in ("legs", "both"):
            raise InputError(
                f"the drawing of {drawn.name} has no cylinders that a camera could see",
                where=machine,
                expected="a board on the platform, or tubes on its legs",
                next_step="Ask for a board alone, or give the legs of a copy of the drawing tubes",
            )
        if seen is None and not visible:
            seen = "readings" if drawn.redundancy > 0 else "board"
        texts["mechanism.yaml"] = read_text(catalogue().get(machine, Path(machine)))
        texts["joints.csv"] = _readings(drawn)
        turns = set(drawn.joint_units) == {"rad"}
    seen = seen or "legs"
    texts["session.yaml"] = _session(texts["session.yaml"], machine is None, turns, seen, places)
    if seen in ("board", "both"):
        texts["board.yaml"] = BOARD
    where_to = texts.pop("images/front/README.txt")
    if seen == "readings":
        del texts["cameras/front.yaml"]
        return texts
    for name in _places(places):
        texts[f"images/{name}/README.txt"] = where_to.replace('"front"', f'"{name}"')
    return texts


def _places(count: int) -> list[str]:
    return [*PLACES, *(f"place{k + 1}" for k in range(len(PLACES), count))][:count]


def _readings(machine: Machine) -> str:
    """Two rows: the home pose's, and one's beside it."""
    poses = np.repeat(machine.home()[None], 2, axis=0)
    lengths = machine.parameters.drawing[np.array(machine.parameters.units) == "m"]
    # along the last of its motions that is no turn, by a part of its size
    motions = MOTIONS[machine.document.motion]
    slide = next(c for c in motions.T[::-1] if not c[:3].any())[3:]
    poses[1, :3, 3] += slide * np.abs(lengths).max() / 30
    rows = machine.inverse(poses)
    rows = np.where(np.isfinite(rows), rows, rows[:1])
    turns = np.array([unit == "rad" for unit in machine.joint_units])
    rows[:, turns] = np.rad2deg(rows[:, turns])
    heads = [
        f"{name} [deg]" if turn else name
        for name, turn in zip(machine.joint_names, turns, strict=True)
    ]
    return csv_text(heads, ["0001", "0002"], rows.round(4))


def _session(text: str, hexapod: bool, turns: bool, seen: Seen, places: int) -> str:
    """The starter session.yaml for another machine, another thing that is seen, more places."""
    if turns:
        start, end = text.index("  # Standard deviation"), text.index("\n# One entry")
        text = text[:start] + DRIVES + text[end:]
    if seen == "readings":
        return text[: text.index("# One entry")] + ALONE
    start, end = text.index("    observe: legs"), text.index("#  left:")
    first = f"    observe: {OBSERVE[seen]}\n"
    if seen == "legs":
        first += text[start:end].partition("\n")[2]
    moved = [MOVED.format(name=n, observe=OBSERVE[seen]) for n in _places(places)[1:]]
    rest = text[end:] if places == 1 and seen == "legs" and hexapod else ""
    board = "" if seen == "legs" else ON_PLATFORM
    return text[:start] + first + "".join(moved) + rest + board


def untouched_files(folder: Path | str) -> tuple[str, ...]:
    """Sentences about the files of a session that are still as `write_session` left them."""
    return tuple(
        f"{name} is still the example of pkmcal new: {what}."
        for name, what in TO_FILL.items()
        if _untouched(Path(folder) / name, name)
    )


def _untouched(path: Path, name: str) -> bool:
    """Compared by lines: an editor may change the line ends of a file that it only looked at."""
    try:
        lines = path.read_text("utf-8").splitlines() if path.is_file() else []
    except (OSError, UnicodeDecodeError):
        return False
    # readings of a machine in motion are many: only examples have two rows
    if not lines or (name == "joints.csv" and len(lines) != 3):
        return False
    return any(lines == text.splitlines() for text in _examples(name))


@cache
def _examples(name: str) -> tuple[str, ...]:
    """Every text that a file of a new session can begin as."""
    if name == "board.yaml":
        return (BOARD,)
    template = (TEMPLATE / name).read_text("utf-8")
    if name == "mechanism.yaml":
        return template, *(read_text(path) for path in catalogue().values())
    if name == "joints.csv":
        return template, *(_readings(load_mechanism(machine)) for machine in catalogue())
    if name == "session.yaml":
        return tuple(
            _session(template, *given)
            for given in product((True, False), (True, False), SEEN, range(1, len(PLACES) + 1))
        )
    return (template,)
