"""What a kind of measurement has to say of itself: one file a kind, found by enumeration.

A kind is a final subclass of one of four:

- :class:`ImageKind`: measured in images, where a station observes it;
- :class:`TargetKind`: a table of what a tracker, a measuring machine or a probe measured of a
  target on the platform;
- :class:`LinkKind`: a table of numbers that link two configurations each, under a key of its own in
  session.yaml;
- :class:`MotorKind`: what the motors read.

Rows, Jacobian and noise stand beside the kind, in standard deviations: edges in
:mod:`~pkmcal.measurements.edges`, targets of boards and trackers alike in
:mod:`~pkmcal.measurements.poses`, readings in :mod:`~pkmcal.measurements.readings`, links in the
kind's own file.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.files import CsvTable, PairTable, Schema
from pkmcal.measurements.links import LinkSet
from pkmcal.mechanisms import Machine
from pkmcal.wording import listed

POINT_COLUMNS, QUATERNION_COLUMNS, TURN_VECTOR_COLUMNS = (
    ("x", "y", "z"),
    ("qw", "qx", "qy", "qz"),
    ("rx", "ry", "rz"),
)
DISPLAY_UNITS = {"m": ("mm", 1e3), "px": ("px", 1.0)}
"""Unit in reports and the factor to it, by a kind's own unit."""
LEAST_NOISE = 1e-12
NOISE_FIELD_RANGE = Field(ge=LEAST_NOISE, lt=10)
"""m or rad; nothing measures better, nor is of any use that measures worse."""


class MeasurementKind(ABC):
    """A kind of measurement.

    code : for programs. one : what one of them is called, label : its plural, in reports and
    messages. unit : of its numbers. numbers
    : how many each measurement has at most. joins : configurations that each depends on.
    """

    code: ClassVar[str]
    one: ClassVar[str]
    label: ClassVar[str]
    unit: ClassVar[Literal["px", "m", "m or rad"]]
    numbers: ClassVar[int]
    joins: ClassVar[int] = 1


class ImageKind(MeasurementKind):
    """Measured in images. observe : the word under ``stations.*.observe``."""

    observe: ClassVar[str]


class MotorKind(MeasurementKind):
    """What the motors read. key : in session.yaml."""

    key: ClassVar[str]


class TargetKind(MeasurementKind, ABC):
    """A tracker's table, under ``stations.*.tracker``.

    headers : columns beside the configuration's, in any order, of each form of the table. known :
    which of (omega, tau) of T_tracker_target are measured. fewest_rows : that fix the tracker's
    place and leave something that is known. levels : whether the tracker's z axis may be stated to
    be the base's.
    """

    headers: ClassVar[tuple[tuple[str, ...], ...]]
    known: ClassVar[tuple[int, ...]]
    fewest_rows: ClassVar[int]
    levels: ClassVar[bool] = False

    @classmethod
    def turns(cls) -> bool:
        """Whether turns are measured, which need a stated noise."""
        return any(k < 3 for k in cls.known)

    @classmethod
    def whiten(cls, position: float, rotation: float | None) -> Array:
        """Whitening (6, 6) of one measurement, by standard deviations in m and rad; rows of zeros
        for what is not measured.
        """
        sigma = np.repeat([rotation or 1.0, position], 3)
        return np.diag(np.where(np.isin(np.arange(6), cls.known), 1 / sigma, 0.0))

    @classmethod
    @abstractmethod
    def start(cls, T_tracker_target: Array, platform: Array) -> Array | None:
        """A first T_tracker_base (4, 4) from measurements (N, 4, 4) and the platform's places
        (N, 3) by the nominal model; None where whole poses tell it themselves.
        """

    @classmethod
    def lengths(cls, T_tracker_target: Array) -> Array:
        """The measured lengths (N, n), m."""
        return T_tracker_target[:, [k - 3 for k in cls.known if k >= 3], 3]


class LinkKind(MeasurementKind, ABC):
    """Numbers that link two configurations, under a key of their own in session.yaml.

    key, schema : of session.yaml. Each measurement is one number with a standard deviation of its
    own, and hangs on a point of the platform that is estimated with the machine. Where residuals
    ask for larger deviations, all kinds of links share one factor.
    """

    key: ClassVar[str]
    schema: ClassVar[type[Schema]]
    numbers: ClassVar = 1
    joins: ClassVar = 2

    @classmethod
    @abstractmethod
    def table(cls, node: Any) -> str:
        """The table's file as session.yaml names it. node : of the schema."""

    @classmethod
    @abstractmethod
    def noise(cls, node: Any) -> float | None:
        """The standard deviation of a measurement as session.yaml states it."""

    @classmethod
    @abstractmethod
    def read(cls, node: Any, path: Path, names: tuple[str, ...], machine: Machine) -> LinkSet:
        """Read the table; every fault is an InputError with line and column.

        node : of the schema. path : of the file. names : the session's configurations.
        """

    @classmethod
    @abstractmethod
    def check_start(cls, links: LinkSet, T_base_platform: Array) -> None:
        """Raise `InputError` for what the nominal model's poses (K, 4, 4) show to be wrong, such as
        another unit.
        """


Kind = TypeVar("Kind", bound=MeasurementKind)


@cache
def measurement_kinds() -> dict[str, type[MeasurementKind]]:
    """Every kind of this folder, by its code."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
    return {kind.code: kind for kind in _concrete(MeasurementKind)}


def kinds_of(base: type[Kind]) -> dict[str, type[Kind]]:
    """Those of one sort, by their codes."""
    return {code: kind for code, kind in measurement_kinds().items() if issubclass(kind, base)}


def _concrete(base: type[MeasurementKind]) -> list[type[MeasurementKind]]:
    """Subclasses that have a code, in the order of their files."""
    out: list[type[MeasurementKind]] = []
    for kind in base.__subclasses__():
        out += [kind] if "code" in vars(kind) else _concrete(kind)
    return sorted(out, key=lambda kind: kind.__module__)


def configuration_rows(table: CsvTable, names: tuple[str, ...]) -> Integers:
    """Rows (N,) of the readings of the configurations that a table names, (N, 2) of pairs. Raises
    `InputError` for one that has no readings.
    """
    number = {name: k for k, name in enumerate(names)}
    written = table.pairs if isinstance(table, PairTable) else tuple((n,) for n in table.names)
    for row, name in ((row, name) for row, each in enumerate(written) for name in each):
        if name not in number:
            short = {
                reference_values.lstrip("0"): reference_values for reference_values in names
            }.get(name.lstrip("0"))
            raise InputError(
                "this configuration has no joint readings",
                where=table.where(row),
                found=name,
                expected=short or f"one of the readings' {len(names)}: {listed(names)}",
                next_step="Write the names alike; spreadsheets drop leading zeros"
                if short
                else None,
            )
    rows = np.array([[number[name] for name in each] for each in written], dtype=int)
    return rows if isinstance(table, PairTable) else rows[:, 0]
