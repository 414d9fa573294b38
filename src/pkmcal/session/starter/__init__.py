"""A session to fill in: the files that ``pkmcal new`` writes, each with comments for a newcomer."""

from __future__ import annotations

from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files import entries, staged_folder

TEMPLATE = Path(__file__).parent / "session"
TO_FILL = {
    "mechanism.yaml": "write the drawing of your machine into it",
    "cameras/front.yaml": "write the calibration of your camera into it",
    "session.yaml": "write down where the camera stands and how good the readings are",
    "joints.csv": "write one row of readings for each configuration into it",
}
"""What a person still has to do in each file."""


def template_files() -> tuple[str, ...]:
    """The starter session's files, paths inside it."""
    files = (path for path in TEMPLATE.rglob("*") if path.is_file())
    return tuple(sorted(path.relative_to(TEMPLATE).as_posix() for path in files))


def write_session(folder: Path | str) -> tuple[str, ...]:
    """Write the starter session into a new or empty folder; returns its files."""
    folder = Path(folder)
    if entries(folder):
        raise InputError(
            "the folder for the new session is not empty",
            where=str(folder),
            expected="a new or empty folder",
            next_step="Name another folder; nothing was written into this one",
        )
    names = template_files()
    with staged_folder(folder) as stage:
        for name in names:
            (stage / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).write_bytes((TEMPLATE / name).read_bytes())
    return names


def untouched_files(folder: Path | str) -> tuple[str, ...]:
    """Sentences about the files of a session that are still as `write_session` left them."""
    return tuple(
        f"{name} is still the example of pkmcal new: {what}."
        for name, what in TO_FILL.items()
        if _same(Path(folder) / name, TEMPLATE / name)
    )


def _same(path: Path, template: Path) -> bool:
    # Compared by lines: an editor may change the line ends of a file that it only looked at.
    return path.is_file() and path.read_bytes().splitlines() == template.read_bytes().splitlines()
