"""Archive of earlier results: a result that is about to be replaced is copied to a dated folder.

The copy is made first and atomically; then the new result replaces the old one as usual. A run that
is killed between the two leaves the earlier result twice, and the next run finds its copy.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from pkmcal.calibration.file_names import CALIBRATION_DOCUMENT_FILE, CALIBRATION_REPORT_FILE
from pkmcal.files import entries, resolved, staged_folder


def keep_earlier(
    folder: Path,
    texts: Mapping[str, str | bytes],
    document: str = CALIBRATION_DOCUMENT_FILE,
    page: str = CALIBRATION_REPORT_FILE,
) -> Path | None:
    """Copy the result in ``folder`` to a folder beside it; returns that folder.

    None without an earlier result, or if the new one is the same except for its timings. The copy's
    name is that of the folder with the date of the earlier result, as calibration-2026-11-23T1502;
    a second one in the same minute ends in -2.

    texts : contents of the new result by file name.
    document : file that identifies a result.
    page : file that is made from the others, and is not compared.
    """
    folder = resolved(folder)
    names = entries(folder)
    if document not in names or _same(folder, names, texts, page):
        return None
    # first free name, unless a copy exists already
    written = datetime.fromtimestamp((folder / document).stat().st_mtime)
    stem = f"{folder.name}-{written:%Y-%m-%dT%H%M}"
    number, place = 1, folder.with_name(stem)
    while place.is_symlink() or place.is_file() or entries(place):
        if not place.is_symlink() and _copied(folder, names, place):
            return place
        number += 1
        place = folder.with_name(f"{stem}-{number}")
    with staged_folder(place) as stage:
        for name in names:
            shutil.copy2(folder / name, stage / name, follow_symlinks=False)
    return place


def _same(folder: Path, names: list[str], texts: Mapping[str, str | bytes], page: str) -> bool:
    """Whether the new result equals the result in the folder; the rendered page is not compared."""
    if {*names} - {page} != {*texts} - {page} or not _regular(folder, names):
        return False
    return all(
        _comparable(name, (folder / name).read_bytes()) == _comparable(name, texts[name])
        for name in names
        if name != page
    )


def _comparable(name: str, content: str | bytes) -> object:
    """Content of a file without the timings of the run."""
    raw = content if isinstance(content, bytes) else content.encode("utf-8")
    if name != CALIBRATION_DOCUMENT_FILE:
        return raw
    try:
        document = json.loads(raw)
    except (ValueError, RecursionError):  # edited or truncated: compared as bytes
        return raw
    if isinstance(document, dict):
        document.pop("timings", None)
    return document


def _copied(folder: Path, names: list[str], place: Path) -> bool:
    """Whether a folder holds copies of exactly these files."""
    same = entries(place) == names and _regular(folder, names) and _regular(place, names)
    return same and all(
        (folder / name).read_bytes() == (place / name).read_bytes() for name in names
    )


def _regular(folder: Path, names: list[str]) -> bool:
    """Whether all of these are regular files.

    The target of a link is neither read nor copied: it may be anything, including a file of another
    session.
    """
    return all((folder / name).is_file() and not (folder / name).is_symlink() for name in names)
