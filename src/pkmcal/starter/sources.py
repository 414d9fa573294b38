"""Contract of the files that ``pkmcal new --from`` reads.

A source is one final class in a module of SOURCE_PACKAGES: it recognises its files, and makes the
nominal model or the complete session of one of them.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import ClassVar

from pkmcal.errors import InputError
from pkmcal.files import quoted, read_text
from pkmcal.starter.nominal import NominalModel, option_of
from pkmcal.wording import listed

SOURCE_PACKAGES = ("pkmcal.starter", "pkmcal.firmware", "pkmcal.exporters")
"""Folders, each module of which may define a source."""

SessionTexts = dict[str, str]
"""Texts of a complete session by file name."""


class StarterSource(ABC):
    """Kind of file. Sources are stateless.

    title : what a file is, in words.
    recognised : how its files are recognised, in words.
    options : names of the options that complete a file, ``unit`` or of dimensions.
    """

    title: ClassVar[str]
    recognised: ClassVar[str]
    options: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def claims(self, text: str, path: Path) -> bool:
        """Whether the text of a file is of this kind."""

    @abstractmethod
    def read(
        self, text: str, path: Path, unit: str | None, given: Mapping[str, float]
    ) -> NominalModel | SessionTexts:
        """Nominal model, or the texts of a complete session.

        unit, given : unit, and dimensions in m, of `options` alone. Raises InputError for values
        that are missing or impossible.
        """


@cache
def starter_sources() -> tuple[StarterSource, ...]:
    """All sources of SOURCE_PACKAGES, by title."""
    for package in SOURCE_PACKAGES:
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
            importlib.import_module(f"{package}.{module.name}")
    kinds: list[Callable[[], StarterSource]] = list(StarterSource.__subclasses__())
    return tuple(sorted((make() for make in kinds), key=lambda one: one.title))


def read_source(
    path: Path, unit: str | None, given: Mapping[str, float]
) -> NominalModel | SessionTexts:
    """Nominal model or complete session of a file.

    unit : of its lengths, None unless the user named it. given : dimensions by name, m.

    Raises InputError for a file that no source or more than one claims, for options that its
    source does not take, and for a machine that does not reach its home or is singular there.
    """
    text = read_text(path)
    claiming = [one for one in starter_sources() if one.claims(text, path)]
    if len(claiming) != 1:
        raise InputError(
            "the file is of several kinds" if claiming else "the file is of no kind that is read",
            where=path.name,
            found=listed([one.title for one in claiming])
            or quoted(next((line for line in text.splitlines() if line.strip()), "an empty file")),
            expected=", or ".join(one.recognised for one in claiming or starter_sources()),
        )
    (source,) = claiming
    named = [*given, *([] if unit is None else ["unit"])]
    if extra := [name for name in named if name not in source.options]:
        raise InputError(
            f"this option does not apply to {source.title}",
            where="--from",
            found=listed([option_of(name) for name in extra]),
            expected=f"besides --from {path.name} only "
            + listed([option_of(name) for name in source.options])
            if source.options
            else f"--from {path.name} alone",
            code="option.not_applicable",
        )
    out = source.read(text, path, unit, given)
    if isinstance(out, NominalModel):
        out.check_home(path.name)
    return out
