"""Starter session: the files that ``pkmcal new`` writes, each with comments for a newcomer.

The template is a hexapod whose legs one camera observes from one station. Sessions of other
machines, with a board, or with several stations are derived from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import csv_text, entries, read_text, staged_folder
from pkmcal.mechanisms import Machine, catalogue, load_mechanism
from pkmcal.mechanisms.document import MOTION_DIRECTIONS
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.starter.nominal import NominalModel

ObservedChoice = Literal["legs", "board", "both", "readings"]
OBSERVED_CHOICES: tuple[ObservedChoice, ...] = ("legs", "board", "both", "readings")
"""Observations that a starter session can have."""
SESSION_TEMPLATE_FOLDER = Path(__file__).parent / "session"
TO_FILL = {
    "mechanism.yaml": "write the nominal model of your machine into it",
    "cameras/front.yaml": "write the calibration of your camera into it",
    "session.yaml": "write down how good the readings are, and each place that the camera stood in",
    "joints.csv": "write one row of readings for each configuration into it",
    "board.yaml": "write down which board it is, and measure its squares",
}
"""Task that remains for the user in each file."""
STARTER_STATION_NAMES = ("front", "left", "right", "back")
OBSERVE_ENTRY_VALUES = {"legs": "legs", "board": "board", "both": "[legs, board]"}
STARTER_BOARD_TEXT = """\
# The board on the platform: a ChArUco board printed on something stiff and flat. Other kinds, and
# what each key means: docs/files.md, board.yaml.
type: charuco
squares: [7, 5]           # columns and rows of squares
square: {square:<17} # the side of a square: measure over all of them, and divide
marker: {marker:<17} # the side of a marker
dictionary: DICT_5X5_100
tolerance: 0.1 %          # how well you measured: paper changes its size by as much
"""
STARTER_SQUARES = (7, 5)
STARTER_SQUARE_CHOICES = range(8, 31)
"""Sides of the board's squares, mm, that can be chosen: from markers that a camera resolves to a
sheet of A4."""
ON_PLATFORM = """\

board:
  file: board.yaml
  fixed_to: platform          # it must not move on it; where it sits need not be known
"""
MOVED_STATION_TEXT = """\
  {name}:
    camera: cameras/front.yaml  # the same camera, moved there later
    images: images/{name}/{{configuration}}.png
    observe: {observe}
"""
READINGS_ALONE_HEADER_TEXT = """\
# A calibration session: which machine, which readings.
#
# What to do, in this order:
#   1. mechanism.yaml      the nominal model of your machine
#   2. Move the machine to a configuration, wait until it stands still, and note what the encoders
#      read, not what was commanded. 30 configurations or more, all over what it reaches.
#   3. joints.csv          the readings: one row a configuration, in the heads' units, or in metres
#      and radians
#   4. pkmcal check, in this folder's place, until it finds nothing wrong; then pkmcal calibrate
"""
READINGS_ALONE_TEXT = """\
# No stations: this machine has more readings than freedoms, and they alone determine its geometry.
# Spread the configurations over all that it reaches.
"""
EXAMPLE_UNIT_FACTORS = {"[deg]": np.rad2deg(1.0), "[mm]": 1e3}
"""Factors from SI units to those named in the headers of example readings."""
LEGS_TEXT = " - The machine stands still."
BOARD_TEXT = """\
 - The machine stands still. The board sharp, whole in the picture, neither white nor black, and
   not always seen from the same side.
"""
DRIVE_NOISE_TEXT = """\
  # Standard deviation of a reading: about a third of the encoder's repeatability. A hobby servo has
  # none, its readings are commands: state what a command leaves open, such as 0.5 deg.
  noise: 0.001 deg
"""

TURNING_ADVICE = (
    "legs near their\n#      shortest and longest help most.",
    "readings\n#      near both ends of their ranges help most.",
)
"""What the template advises on configurations, and what of a machine whose motors turn."""


def write_texts(folder: Path | str, texts: dict[str, str]) -> tuple[str, ...]:
    """Write a session's files, by name, into a new or empty folder, atomically."""
    check_new_folder(folder)
    folder = Path(folder)
    with staged_folder(folder) as stage:
        for name, text in texts.items():
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).write_bytes(text.encode("utf-8"))
    return tuple(texts)


def check_new_folder(folder: Path | str) -> None:
    """Raise InputError for a folder that is not empty."""
    if entries(Path(folder)):
        raise InputError(
            "the folder for the new session is not empty",
            where=str(folder),
            expected="a new or empty folder",
            next_step="Name another folder; nothing was written into this one",
            code="output.not_empty",
        )


def session_texts(
    machine: NominalModel | str | None = None,
    what: ObservedChoice | None = None,
    places: int = 1,
) -> dict[str, str]:
    """Texts of a starter session's files by name.

    machine : a built-in machine's name, a mechanism file, or a nominal model of few numbers; by
        default a hexapod to be edited.
    what : what the camera observes; by default the legs, or a board if the nominal model has no
        tubes, or nothing if readings alone determine the geometry.
    places : number of stations of the camera.
    Raises InputError for legs without tubes.
    """
    files = sorted(path for path in SESSION_TEMPLATE_FOLDER.rglob("*") if path.is_file())
    texts = {
        path.relative_to(SESSION_TEMPLATE_FOLDER).as_posix(): path.read_text("utf-8")
        for path in files
    }
    turns, platform = False, None
    if machine is not None:
        generated = isinstance(machine, NominalModel)
        model = machine.machine() if generated else load_mechanism(machine)
        has_tubes = any(leg.tubes for leg in model.document.legs)
        if not has_tubes and what in ("legs", "both"):
            raise InputError(
                f"the nominal model of {model.name} has no cylinders that a camera could see",
                where=None if generated else machine,
                expected="a board on the platform, or tubes on its legs",
                next_step="Ask for a board alone, or "
                + (
                    "give --tube-radius"
                    if generated
                    else "give the legs of a copy of the nominal model tubes"
                ),
                code="session.no_tubes",
            )
        if what is None and not has_tubes:
            what = "readings" if model.redundancy > 0 else "board"
        texts["mechanism.yaml"] = (
            machine.text() if generated else read_text(catalogue().get(machine, Path(machine)))
        )
        texts["joints.csv"] = example_readings(model)
        turns = set(model.joint_units) == {"rad"}
        if model.document.motion == "spatial":  # beyond its joints it meets the legs as it tilts
            platform = 2 * float(np.linalg.norm(model.platform_centers()[:, :2], axis=-1).max())
    what = what or "legs"
    texts["session.yaml"] = _session_text(
        texts["session.yaml"], machine is None, turns, what, places
    )
    if what in ("board", "both"):
        texts["board.yaml"] = board_text(platform)
    readme = texts.pop("images/front/README.txt")
    if what == "board":
        readme = readme[: readme.index(LEGS_TEXT)] + BOARD_TEXT
    if what == "readings":
        del texts["cameras/front.yaml"]
        return texts
    for name in _station_names(places):
        texts[f"images/{name}/README.txt"] = readme.replace('"front"', f'"{name}"')
    return texts


def board_text(diameter: float | None = None) -> str:
    """Text of the example board.yaml.

    diameter : of the circle in which the board's corners lie, m, within the sides that can be
        chosen; None for the largest.
    """
    least, most = STARTER_SQUARE_CHOICES[0], STARTER_SQUARE_CHOICES[-1]
    square = most if diameter is None else int(1e3 * diameter / np.hypot(*STARTER_SQUARES))
    return _board_text(min(max(square, least), most))


def _board_text(square: int) -> str:
    """Text of the example board.yaml. square : mm."""
    return STARTER_BOARD_TEXT.format(square=f"{square} mm", marker=f"{round(0.73 * square)} mm")


def _station_names(count: int) -> list[str]:
    """Names of the stations."""
    return [
        *STARTER_STATION_NAMES,
        *(f"place{k + 1}" for k in range(len(STARTER_STATION_NAMES), count)),
    ][:count]


def example_readings(machine: Machine, heads: Sequence[str] | None = None) -> str:
    """Two rows of joints.csv: readings of the home pose, and of a pose beside it.

    heads : headers of the columns, such as ``stepper_a [mm]``, with values in mm or degrees if they
        name these; by default the joints' names.
    """
    poses = np.repeat(machine.home()[None], 2, axis=0)
    lengths = machine.parameters.nominal[np.array(machine.parameters.units) == "m"]
    # Shift the second pose along the motion's last translation, by a part of the machine's size.
    motions = MOTION_DIRECTIONS[machine.document.motion]
    slide = next(c for c in motions.T[::-1] if not c[:3].any())[3:]
    poses[1, :3, 3] += slide * np.abs(lengths).max() / 30
    rows = machine.inverse(poses)
    rows = np.where(np.isfinite(rows), rows, rows[:1])
    heads = heads or [
        f"{name} [deg]" if unit == "rad" else name
        for name, unit in zip(machine.joint_names, machine.joint_units, strict=True)
    ]
    rows *= [
        next((k for mark, k in EXAMPLE_UNIT_FACTORS.items() if head.endswith(mark)), 1.0)
        for head in heads
    ]
    return csv_text(heads, ["0001", "0002"], rows.round(4))


def _session_text(text: str, hexapod: bool, turns: bool, what: ObservedChoice, places: int) -> str:
    """Text of session.yaml for another machine, another observation, or more stations."""
    if turns:
        start, end = text.index("  # Standard deviation"), text.index("\n# One entry")
        text = text[:start] + DRIVE_NOISE_TEXT + text[end:]
        text = text.replace(*TURNING_ADVICE)
    if what == "readings":
        text = text[text.index("pkmcal: 1") : text.index("# One entry")]
        return READINGS_ALONE_HEADER_TEXT + text + READINGS_ALONE_TEXT
    start, end = text.index("    observe: legs"), text.index("#  left:")
    first = f"    observe: {OBSERVE_ENTRY_VALUES[what]}\n"
    if what == "legs":
        first += text[start:end].partition("\n")[2]
    further = [
        MOVED_STATION_TEXT.format(name=n, observe=OBSERVE_ENTRY_VALUES[what])
        for n in _station_names(places)[1:]
    ]
    rest = text[end:] if places == 1 and what == "legs" and hexapod else ""
    board = "" if what == "legs" else ON_PLATFORM
    return text[:start] + first + "".join(further) + rest + board


def untouched_files(folder: Path | str) -> tuple[Finding, ...]:
    """Warnings about files of a session that are still as `pkmcal new` wrote them.

    Files that session.yaml does not name are not the session's.
    """
    session = Path(folder) / "session.yaml"
    try:
        lines = session.read_text("utf-8").splitlines() if session.is_file() else []
    except (OSError, UnicodeDecodeError):
        lines = list[str]()
    entries = "\n".join(line.partition("#")[0] for line in lines)
    return tuple(
        doubtful("session.example_file", name, what=what)
        for name, what in TO_FILL.items()
        if (name in entries or name == "session.yaml") and _is_untouched(Path(folder) / name, name)
    )


def _is_untouched(path: Path, name: str) -> bool:
    """Whether a file equals any starter text, compared by lines because editors may change line
    ends.
    """
    try:
        lines = path.read_text("utf-8").splitlines() if path.is_file() else []
    except (OSError, UnicodeDecodeError):
        return False
    # of readings, only examples have two rows
    if not lines or (name == "joints.csv" and len(lines) != 3):
        return False
    examples = _starter_texts(name)
    if name == "joints.csv":
        examples = (*examples, *_readings_of_machine(path.parent, lines[0].split(",")[1:]))
    return any(lines == text.splitlines() for text in examples)


def _readings_of_machine(folder: Path, heads: Sequence[str]) -> tuple[str, ...]:
    """Example readings of the folder's own machine; none if its file is invalid."""
    try:
        machine = load_mechanism(folder / "mechanism.yaml")
        return (example_readings(machine, heads),) if len(heads) == machine.n_joints else ()
    except PkmcalError:  # reported when the session is loaded
        return ()


@cache
def _starter_texts(name: str) -> tuple[str, ...]:
    """All texts that a file of a starter session can have."""
    if name == "board.yaml":
        return tuple(_board_text(square) for square in STARTER_SQUARE_CHOICES)
    template = (SESSION_TEMPLATE_FOLDER / name).read_text("utf-8")
    if name == "mechanism.yaml":
        return template, *(read_text(path) for path in catalogue().values())
    if name == "joints.csv":
        return template, *(example_readings(load_mechanism(machine)) for machine in catalogue())
    if name == "session.yaml":
        return tuple(
            _session_text(template, *given)
            for given in product(
                (True, False),
                (True, False),
                OBSERVED_CHOICES,
                range(1, len(STARTER_STATION_NAMES) + 1),
            )
        )
    return (template,)
