"""Storage of a study's finished batches, so that an interrupted study can be resumed.

A folder ``batches`` beside the results holds one file for each batch, written atomically, and
``study.json``, which identifies the study; one process at a time works there. A batch depends on
its own seed alone, so a resumed study gives the same numbers as an uninterrupted one, for any
number of workers. A study with more runs reuses the finished batches.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards.board import Board
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.files import (
    alone_in,
    check_regular,
    digest_of,
    json_text,
    json_value,
    write_bytes,
    write_text,
)
from pkmcal.mechanisms import Machine
from pkmcal.studies.tasks import Batch, Key, Sample, SolvedBatch, StudySetting

BATCHES_FOLDER = "batches"
STUDY_DESCRIPTION_FILE = "study.json"
ARRAY_NAME_SEPARATOR = "/"
"""Separator of key, kind and quantity in the names of a batch file's arrays."""


@dataclass(frozen=True)
class Store:
    """Batches of one study in their folder."""

    folder: Path

    @classmethod
    @contextmanager
    def opened(
        cls, out: Path, title: str, settings: Sequence[StudySetting], seed: int
    ) -> Generator[Store]:
        """Open or create the store in a results folder, exclusively for this process.

        title : the study in words. Raises InputError if the store holds finished batches of another
        study, or if another process works in the folder.
        """
        folder = out / BATCHES_FOLDER
        path = folder / STUDY_DESCRIPTION_FILE
        digest = digest_of([plainly(setting) for setting in settings], seed)
        own = {"study": title, "seed": seed, "pkmcal": version("pkmcal"), "digest": digest}
        with alone_in(folder, "study"):
            if any(folder.glob("*.npz")):
                before = _description(path)
                if before.get("digest") != own["digest"]:
                    raise InputError(
                        "the folder holds the batches of another study",
                        where=f"{path}, digest",
                        found=_description_text(before),
                        expected=_description_text(own),
                        next_step="Name another folder with -o, or remove this one",
                        code="study.another",
                    )
            else:
                write_text(path, json_text(own))
            yield cls(folder)

    def load(self, cell: int, number: int, batch: Batch) -> SolvedBatch | None:
        """Load a finished batch; None if it is missing, unreadable, or has another number of
        runs.
        """
        try:
            path = self._path(cell, number)
            check_regular(path, path.name)
            content = io.BytesIO(path.read_bytes())
            with np.load(content, allow_pickle=False) as file:
                runs, wall, cpu = file["done"].tolist()
                arrays = {name: file[name] for name in file.files if name != "done"}
        except (InputError, OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        if runs != batch.runs:
            return None
        parts: dict[Key, dict[str, dict[str, Array]]] = {}
        for name, array in arrays.items():
            *key, kind, quantity = name.split(ARRAY_NAME_SEPARATOR)
            own = parts.setdefault(tuple(key), {"values": {}, "sigma": {}})
            own[kind][quantity] = array
        return SolvedBatch(
            {key: Sample(p["values"], p["sigma"]) for key, p in parts.items()}, wall, cpu
        )

    def save(self, cell: int, number: int, done: SolvedBatch) -> None:
        """Save a finished batch."""
        arrays = {
            ARRAY_NAME_SEPARATOR.join((*key, kind, quantity)): array
            for key, sample in done.samples.items()
            for kind, those in (("values", sample.values), ("sigma", sample.sigma))
            for quantity, array in those.items()
        }
        runs = len(next(iter(arrays.values())))
        stream = io.BytesIO()
        np.savez(stream, allow_pickle=False, done=np.array([runs, done.wall, done.cpu]), **arrays)
        write_bytes(self._path(cell, number), stream.getvalue())

    def _path(self, cell: int, number: int) -> Path:
        return self.folder / f"{cell:03d}-{number:05d}.npz"


def plainly(value: Any) -> Any:
    """A setting as plain data, with everything that its numbers depend on."""
    if isinstance(value, Machine):
        return {"machine": json_value(value.to_document()), "model": list(value.parameters.fixed)}
    if isinstance(value, Camera | Board):
        return json_value(value.document() if isinstance(value, Camera) else value.document)
    if is_dataclass(value):
        own = {field.name: plainly(getattr(value, field.name)) for field in fields(value)}
        return {"kind": type(value).__name__, **own}
    if isinstance(value, Mapping):
        return {str(key): plainly(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plainly(item) for item in value]
    return json_value(value)


def _description(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        value = None
    if isinstance(value, dict):
        return value
    raise InputError(
        "this does not describe a study",
        where=str(path),
        next_step="Name another folder with -o, or remove this one",
        code="study.unreadable",
    )


def _description_text(description: Mapping[str, Any]) -> str:
    digest = str(description.get("digest"))[:8]
    return (
        f"{description.get('study')}, seed {description.get('seed')},"
        f" pkmcal {description.get('pkmcal')}, digest {digest}"
    )
