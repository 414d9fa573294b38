"""Intrinsics in the files of mrcal, COLMAP and ViSP.

:mod:`pkmcal.cameras.mrcal`, ``colmap`` and ``visp`` read :class:`Intrinsics` from a text;
:mod:`pkmcal.cameras.files` makes a validated camera of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from pkmcal.errors import InputError
from pkmcal.wording import listed

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class Intrinsics:
    """Numbers of another program's camera.

    model : pkmcal's camera model; rational also for a pinhole camera. image_size : (width, height),
    px. focal, center : px, pixel centres at integers. distortion : coefficients in the model's
    order. where : file and place for messages.
    """

    model: str
    image_size: tuple[float, float]
    focal: tuple[float, float]
    center: tuple[float, float]
    distortion: tuple[float, ...]
    where: str


def named_entry(entries: Mapping[str, Entry], name: str | None, label: str) -> Entry:
    """Entry of a file of several cameras, by the name behind the # of its path.

    entries : camera names and their content. name : None if the path has no #.
    Raises InputError if the file has no camera, none of this name, or several without a name.
    """
    if name is None and len(entries) == 1:
        return next(iter(entries.values()))
    if name is None and entries:
        raise InputError(
            "the file holds several cameras",
            where=label,
            found=listed(list(entries)),
            next_step=f"Name one behind a #, such as {label}#{list(entries)[-1]}",
            code="camera.several",
        )
    if name is None or name not in entries:
        raise InputError(
            "the file has no such camera" if entries else "the file holds no camera",
            where=label,
            found=name,
            expected=listed(list(entries)) or "a camera",
        )
    return entries[name]
