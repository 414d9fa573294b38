"""Photographs of a session: found by their names, and their sizes read without decoding them."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Formatter

from pkmcal.errors import InputError
from pkmcal.files import (
    IMAGE_FILE_ENDINGS,
    MOST_IMAGES,
    check_count,
    check_regular,
    closest,
    open_image,
    quoted,
    sensor_size,
)
from pkmcal.wording import listed

_FIELDS = ("configuration", "repeat")


@dataclass(frozen=True)
class Photograph:
    """One image file.

    configuration : row of the session's joints that it belongs to.
    repeat : the pattern's {repeat} part, where it has one.
    """

    configuration: int
    repeat: str | None
    path: Path


def find_photographs(
    folder: Path, pattern: str, names: Sequence[str], where: str, *, needed: bool = True
) -> tuple[Photograph, ...]:
    """Find the files that a pattern such as ``images/front/{configuration}.png`` stands for.

    pattern : relative to `folder`, or absolute.
    names : configurations in joints.csv; a file is paired with its row by name alone, never by
        order, so that one missing photograph cannot shift the others.
    where : place of the pattern in session.yaml, for messages. needed : whether none is a fault.
    Returns photographs by configuration and repeat. A configuration without one is no fault.
    """
    parts = _parts(pattern, where)
    wildcard = "".join(glob.escape(text) if field is None else "*" for text, field in parts)
    rows = {name: row for row, name in enumerate(names)}
    lengths = sorted({len(name) for name in names}, reverse=True)

    def above_limit(path: str) -> re.Match[str] | None:
        """The path as the pattern's, of a configuration that there is; the longest name first."""
        # only names that stand in it: thousands as one expression would be tried one by one
        within = (path[at : at + n] for n in lengths for at in range(len(path) - n + 1))
        some = dict.fromkeys(name for name in within if name in rows)
        return re.fullmatch(_regex(parts, "|".join(map(re.escape, some))), path) if some else None

    matches = glob.glob(wildcard, root_dir=folder)
    check_count(len(matches), MOST_IMAGES, "files under this pattern", where)
    files = [
        path
        for path in (Path(name).as_posix() for name in matches)
        # A folder or a pipe that has a photograph's name is told; others are nobody's business.
        if (folder / path).is_file() or above_limit(path)
    ]
    if not files and not needed:
        return ()
    if not files:
        raise _no_images_error(folder, wildcard, pattern, where)
    results: list[Photograph] = []
    strangers: list[str] = []
    for name in sorted(files):
        match = above_limit(name)
        if match is None:
            strangers.append(name)
            continue
        fields = match.groupdict()
        row = rows[fields["configuration"]]
        results.append(Photograph(row, fields.get("repeat"), folder / name))
    if strangers:
        raise _stranger(strangers, parts, names, where)
    return tuple(sorted(results, key=lambda photo: (photo.configuration, photo.repeat or "")))


def photograph_header(path: Path | str, label: str | None = None) -> tuple[int, int]:
    """(width, height) in pixels of an image file, as the sensor has it, before EXIF's orientation.

    label : the file's name in messages; the path by default.
    Raises InputError for what is no file, no image, or has a size that its bytes cannot fill.
    """
    path = Path(path)
    label = label or str(path)
    try:
        check_regular(path, label)
        with path.open("rb") as stream:
            return sensor_size(open_image(stream, label))
    except OSError as error:
        raise InputError(f"the image cannot be read ({error.strerror})", where=label) from None


def label_of(folder: Path, path: Path) -> str:
    """A photograph's name in messages: its path inside the session, as session.yaml writes it."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _parts(pattern: str, where: str) -> list[tuple[str, str | None]]:
    """Split a pattern into (text, None) and ("", field)."""
    try:
        pieces = list(Formatter().parse(Path(pattern).as_posix()))
    except ValueError:
        raise InputError("the braces do not match", where=where, found=pattern) from None
    parts: list[tuple[str, str | None]] = []
    for text, field, _, _ in pieces:
        parts.append((text, None))
        if field is None:
            continue
        if field not in _FIELDS:
            guess = closest(field, _FIELDS)
            raise InputError(
                "this placeholder is not known",
                where=where,
                found=f"{{{field}}}",
                expected=f"{{{guess}}}" if guess else "{configuration} or {repeat}",
            )
        parts.append(("", field))
    if ("", "configuration") not in parts:
        raise InputError(
            "the pattern does not say where the configuration's name stands",
            where=where,
            found=quoted(pattern),
            expected="a pattern with {configuration}, such as images/front/{configuration}.png",
        )
    return parts


def _regex(parts: Sequence[tuple[str, str | None]], configuration: str) -> str:
    """The pattern as a regular expression; a field's second occurrence repeats its first."""
    bodies = {"configuration": configuration, "repeat": "[^/]+?"}
    names_so_far: set[str] = set()
    text = ""
    for literal, field in parts:
        if field is None:
            text += re.escape(literal)
        elif field in names_so_far:
            text += f"(?P={field})"
        else:
            names_so_far.add(field)
            text += f"(?P<{field}>{bodies[field]})"
    return text


def _no_images_error(folder: Path, wildcard: str, pattern: str, where: str) -> InputError:
    """Say what stands where the photographs should be."""
    place = folder / wildcard
    while "*" in str(place):
        place = place.parent
    value = f"no folder {place}"
    try:
        standing = place.is_dir()
    except OSError:  # such as a name that no folder can have
        standing = False
    if standing:
        entries = sorted(entry.name for entry in place.iterdir())
        others = f"{len(entries)} other entries, such as" if len(entries) > 1 else "only"
        value = f"{others} {entries[0]} in {place}" if entries else f"nothing in {place}"
    ending = Path(pattern).suffix
    same = Counter(_endings(folder, wildcard.removesuffix(ending)))
    others = [other for other, _ in same.most_common() if other != ending]
    return InputError(
        "there is no photograph under this pattern",
        where=where,
        found=value,
        expected=f"files {pattern}",
        next_step=f"Photographs there end in {others[0]}: write"
        f" {pattern.removesuffix(ending)}{others[0]}"
        if others
        else None,
    )


def _endings(folder: Path, wildcard: str) -> list[str]:
    """Those of the photographs under a pattern without its ending, .JPG and the like."""
    try:
        names = glob.glob(f"{wildcard}.*", root_dir=folder)
    except (OSError, ValueError):  # such as a name that no folder can have
        return []
    return [ending for name in names if (ending := Path(name).suffix).lower() in IMAGE_FILE_ENDINGS]


def _stranger(
    files: Sequence[str], parts: Sequence[tuple[str, str | None]], names: Sequence[str], where: str
) -> InputError:
    """A photograph whose configuration has no readings."""
    match = re.fullmatch(_regex(parts, "[^/]+?"), files[0])
    name = match["configuration"] if match else files[0]
    more = f" (one of {len(files)} such files)" if len(files) > 1 else ""
    short = {reference_values.lstrip("0"): reference_values for reference_values in names}
    next_step = "Add its readings to the table, or move the photograph away"
    if name.lstrip("0") in short:
        next_step = (
            f"The table has {short[name.lstrip('0')]} where the photograph says {name}: "
            "write the names alike; spreadsheets drop leading zeros"
        )
    return InputError(
        f"{files[0]} is of a configuration without joint readings{more}",
        where=where,
        found=f"configuration {name}",
        expected=f"one of the table's {len(names)}: {listed(names)}",
        next_step=next_step,
    )
