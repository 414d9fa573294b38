"""Image files of a session: found by name patterns, their sizes read without decoding."""

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
class Image:
    """One image file.

    configuration : row of the session's joint readings that the image belongs to.
    repeat : text matched by the pattern's {repeat}, None without this placeholder.
    """

    configuration: int
    repeat: str | None
    path: Path


def find_images(
    folder: Path, pattern: str, names: Sequence[str], where: str, *, needed: bool = True
) -> tuple[Image, ...]:
    """Find the image files of a pattern such as ``images/front/{configuration}.png``.

    folder : the session's folder.
    pattern : relative to `folder`, or absolute.
    names : configurations in joints.csv. A file is paired with its row by name only, never by
        order, so one missing image cannot shift the others.
    where : location of the pattern in session.yaml, for messages.
    needed : whether finding no file is an error.
    Returns images sorted by configuration and repeat; configurations may be without an image.
    Raises InputError for an invalid pattern and for images of unknown configurations.
    """
    parts = _pattern_parts(pattern, where)
    wildcard = "".join(glob.escape(text) if field is None else "*" for text, field in parts)
    rows = {name: row for row, name in enumerate(names)}
    lengths = sorted({len(name) for name in names}, reverse=True)

    def matched(path: str) -> re.Match[str] | None:
        """Match of a path with the pattern for any configuration, longest names first."""
        # Only names that occur in the path: an alternation of thousands is matched one by one.
        within = (path[at : at + n] for n in lengths for at in range(len(path) - n + 1))
        some = dict.fromkeys(name for name in within if name in rows)
        return re.fullmatch(_regex(parts, "|".join(map(re.escape, some))), path) if some else None

    matches = glob.glob(wildcard, root_dir=folder)
    check_count(len(matches), MOST_IMAGES, "files under this pattern", where)
    files = [
        path
        for path in (Path(name).as_posix() for name in matches)
        # A folder or pipe with an image's name is kept, and refused when its header is read.
        if (folder / path).is_file() or matched(path)
    ]
    if not files and not needed:
        return ()
    if not files:
        raise _no_images_error(folder, wildcard, pattern, where)
    images: list[Image] = []
    unknown: list[str] = []
    for name in sorted(files):
        match = matched(name)
        if match is None:
            unknown.append(name)
            continue
        fields = match.groupdict()
        row = rows[fields["configuration"]]
        images.append(Image(row, fields.get("repeat"), folder / name))
    if unknown:
        raise _unknown_configuration(unknown, parts, names, where)
    return tuple(sorted(images, key=lambda image: (image.configuration, image.repeat or "")))


def image_header(path: Path | str, label: str | None = None) -> tuple[int, int]:
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
        raise InputError(
            f"the image cannot be read ({error.strerror})", where=label, code="file.unreadable"
        ) from None


def label_of(folder: Path, path: Path) -> str:
    """Name of an image in messages: its path relative to the session, as in session.yaml."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _pattern_parts(pattern: str, where: str) -> list[tuple[str, str | None]]:
    """Split a pattern into (text, None) and ("", placeholder); raises InputError for unknown or
    missing placeholders.
    """
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
            "the pattern has no place for the configuration's name",
            where=where,
            found=quoted(pattern),
            expected="a pattern with {configuration}, such as images/front/{configuration}.png",
        )
    return parts


def _regex(parts: Sequence[tuple[str, str | None]], configuration: str) -> str:
    """Pattern as a regular expression. A placeholder's second occurrence repeats its first.

    configuration : expression for the configuration's name.
    """
    bodies = {"configuration": configuration, "repeat": "[^/]+?"}
    used: set[str] = set()
    text = ""
    for literal, field in parts:
        if field is None:
            text += re.escape(literal)
        elif field in used:
            text += f"(?P={field})"
        else:
            used.add(field)
            text += f"(?P<{field}>{bodies[field]})"
    return text


def _no_images_error(folder: Path, wildcard: str, pattern: str, where: str) -> InputError:
    """Error about a pattern without files, with the content of its folder and other suffixes of
    images there.
    """
    parent = folder / wildcard
    while "*" in str(parent):
        parent = parent.parent
    content = f"no folder {parent}"
    try:
        exists = parent.is_dir()
    except OSError:  # e.g. an invalid folder name
        exists = False
    if exists:
        entries = sorted(entry.name for entry in parent.iterdir())
        number = f"{len(entries)} other entries, such as" if len(entries) > 1 else "only"
        content = f"{number} {entries[0]} in {parent}" if entries else f"nothing in {parent}"
    suffix = Path(pattern).suffix
    counts = Counter(_image_suffixes(folder, wildcard.removesuffix(suffix)))
    others = [other for other, _ in counts.most_common() if other != suffix]
    return InputError(
        "there is no image under this pattern",
        where=where,
        found=content,
        expected=f"files {pattern}",
        next_step=f"Images there end in {others[0]}: write"
        f" {pattern.removesuffix(suffix)}{others[0]}"
        if others
        else None,
        code="images.none",
    )


def _image_suffixes(folder: Path, wildcard: str) -> list[str]:
    """Suffixes of the images that match a pattern apart from its own suffix, such as .JPG."""
    try:
        names = glob.glob(f"{wildcard}.*", root_dir=folder)
    except (OSError, ValueError):  # e.g. an invalid folder name
        return []
    return [ending for name in names if (ending := Path(name).suffix).lower() in IMAGE_FILE_ENDINGS]


def _unknown_configuration(
    files: Sequence[str], parts: Sequence[tuple[str, str | None]], names: Sequence[str], where: str
) -> InputError:
    """Error about an image whose configuration has no joint readings."""
    match = re.fullmatch(_regex(parts, "[^/]+?"), files[0])
    name = match["configuration"] if match else files[0]
    more = f" (one of {len(files)} such files)" if len(files) > 1 else ""
    short = {entry.lstrip("0"): entry for entry in names}
    next_step = "Add its readings to the table, or move the image away"
    if name.lstrip("0") in short:
        next_step = (
            f"The table has {short[name.lstrip('0')]} where the image has {name}: "
            "use equal names; spreadsheets drop leading zeros"
        )
    return InputError(
        f"{files[0]} is of a configuration without joint readings{more}",
        where=where,
        found=f"configuration {name}",
        expected=f"one of the table's {len(names)}: {listed(names)}",
        next_step=next_step,
    )
