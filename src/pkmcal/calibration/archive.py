"""Archive of an earlier result that a new one replaces: a folder beside it, under its date.

The copy is made first, atomically; then the new result is written to the folder. A run that is
killed between the two leaves the earlier result twice, and the next run finds its copy there.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from pkmcal.calibration.results import CALIBRATION_DOCUMENT_FILE, CALIBRATION_REPORT_FILE
from pkmcal.files import entries, resolved, staged_folder


def keep_earlier(
    folder: Path,
    texts: Mapping[str, str | bytes],
    document: str = CALIBRATION_DOCUMENT_FILE,
    page: str = CALIBRATION_REPORT_FILE,
) -> Path | None:
    """Copy the result in ``folder`` to a folder beside it, and return that.

    texts : the new result's, by file name. document : the file by which a result is recognised;
    page : the file that is made from it. None where there is no earlier result, or the new one
    differs in its timings only. The copy's name is the folder's with the earlier result's date,
    such as calibration-2026-11-23T1502; a second one of the same minute ends in -2.
    """
    folder = resolved(folder)
    names = entries(folder)
    if document not in names or _same(folder, names, texts, page):
        return None
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
    """Whether the new result equals the one in the folder; pages are made from these files."""
    if {*names} - {page} != {*texts} - {page} or not _regular(folder, names):
        return False
    return all(
        _comparable(name, (folder / name).read_bytes()) == _comparable(name, texts[name])
        for name in names
        if name != page
    )


def _comparable(name: str, content: str | bytes) -> object:
    """Content of a file without timings."""
    raw = content if isinstance(content, bytes) else content.encode("utf-8")
    if name != CALIBRATION_DOCUMENT_FILE:
        return raw
    try:
        document = json.loads(raw)
    except (ValueError, RecursionError):  # changed by hand, or cut short: kept all the same
        return raw
    if isinstance(document, dict):
        document.pop("timings", None)
    return document


def _copied(folder: Path, names: list[str], place: Path) -> bool:
    """Whether a folder holds these files already."""
    same = entries(place) == names and _regular(folder, names) and _regular(place, names)
    return same and all(
        (folder / name).read_bytes() == (place / name).read_bytes() for name in names
    )


def _regular(folder: Path, names: list[str]) -> bool:
    """Whether all of these are regular files. Targets of links are neither read nor copied: they
    may be any file, in another user's session.
    """
    return all((folder / name).is_file() and not (folder / name).is_symlink() for name in names)
