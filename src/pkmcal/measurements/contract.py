"""The contract of a kind of measurement: one file a kind, found by enumeration.

A kind is a final subclass of one of four:

- :class:`ImageKind`: measured in images, where a station observes it;
- :class:`TargetKind`: a table of measurements of a target on the platform by a tracker, a measuring
  machine or a probe;
- :class:`LinkKind`: a table of numbers that link two configurations each, under a key of its own in
  session.yaml;
- :class:`MotorKind`: joint readings of the motors.

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
"""Range of a stated standard deviation, m or rad: no instrument is better, none that is worse is of
use."""


class MeasurementKind(ABC):
    """A kind of measurement.

    code : for programs. one, label : name of a measurement and its plural, in reports and messages.
    unit : of its numbers. numbers : most numbers of a measurement. joins : configurations that each
    measurement depends on.
    """

    code: ClassVar[str]
    one: ClassVar[str]
    label: ClassVar[str]
    unit: ClassVar[Literal["px", "m", "m or rad"]]
    numbers: ClassVar[int]
    joins: ClassVar[int] = 1


class ImageKind(MeasurementKind):
    """A kind that is measured in images. observe : its word under ``stations.*.observe``."""

    observe: ClassVar[str]


class MotorKind(MeasurementKind):
    """Joint readings. key : of session.yaml."""

    key: ClassVar[str]


class TargetKind(MeasurementKind, ABC):
    """A kind that is the table of a tracker, under ``stations.*.tracker``.

    headers : columns beside the configuration's, in any order, of each form of the table. known :
    which of (omega, tau) of T_tracker_target are measured. fewest_rows : least number of rows that
    determine the tracker's pose and leave information about the machine. levels : whether the z
    axis of the tracker may be stated to be that of the base.
    """

    headers: ClassVar[tuple[tuple[str, ...], ...]]
    known: ClassVar[tuple[int, ...]]
    fewest_rows: ClassVar[int]
    levels: ClassVar[bool] = False

    @classmethod
    def turns(cls) -> bool:
        """Whether rotations are measured, which need a stated noise."""
        return any(k < 3 for k in cls.known)

    @classmethod
    def whiten(cls, position: float, rotation: float | None) -> Array:
        """Whitening matrix (6, 6) of a measurement, from standard deviations in m and rad; zero
        rows for numbers that are not measured.
        """
        sigma = np.repeat([rotation or 1.0, position], 3)
        return np.diag(np.where(np.isin(np.arange(6), cls.known), 1 / sigma, 0.0))

    @classmethod
    @abstractmethod
    def start(cls, T_tracker_target: Array, platform: Array) -> Array | None:
        """Initial T_tracker_base (4, 4) from measurements (N, 4, 4) and the platform's positions
        (N, 3) by the nominal model; None where whole poses determine it.
        """

    @classmethod
    def lengths(cls, T_tracker_target: Array) -> Array:
        """Measured lengths (N, n), m."""
        return T_tracker_target[:, [k - 3 for k in cls.known if k >= 3], 3]


class LinkKind(MeasurementKind, ABC):
    """A kind whose numbers link two configurations each, under a key of its own in session.yaml.

    key, schema : of session.yaml. Each measurement is one number with its own standard deviation
    and refers to a point of the platform that is estimated with the machine. Where residuals
    require larger standard deviations, all kinds of links share one factor.
    """

    key: ClassVar[str]
    schema: ClassVar[type[Schema]]
    numbers: ClassVar = 1
    joins: ClassVar = 2

    @classmethod
    @abstractmethod
    def table(cls, node: Any) -> str:
        """File of the table as session.yaml names it. node : of the schema."""

    @classmethod
    @abstractmethod
    def noise(cls, node: Any) -> float | None:
        """Standard deviation of a measurement as session.yaml states it."""

    @classmethod
    @abstractmethod
    def read(cls, node: Any, path: Path, names: tuple[str, ...], machine: Machine) -> LinkSet:
        """Read the table. Raises `InputError` with line and column for every fault.

        node : of the schema. path : of the file. names : configurations of the session.
        """

    @classmethod
    @abstractmethod
    def check_start(cls, links: LinkSet, T_base_platform: Array) -> None:
        """Raise `InputError` for faults that the nominal model's poses (K, 4, 4) show, such as
        another unit.
        """


Kind = TypeVar("Kind", bound=MeasurementKind)


@cache
def measurement_kinds() -> dict[str, type[MeasurementKind]]:
    """All kinds of this folder, by code."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
    return {kind.code: kind for kind in _concrete(MeasurementKind)}


def kinds_of(base: type[Kind]) -> dict[str, type[Kind]]:
    """Kinds that are subclasses of ``base``, by code."""
    return {code: kind for code, kind in measurement_kinds().items() if issubclass(kind, base)}


def _concrete(base: type[MeasurementKind]) -> list[type[MeasurementKind]]:
    """Subclasses with a code, in the order of their files."""
    out: list[type[MeasurementKind]] = []
    for kind in base.__subclasses__():
        out += [kind] if "code" in vars(kind) else _concrete(kind)
    return sorted(out, key=lambda kind: kind.__module__)


def configuration_rows(table: CsvTable, names: tuple[str, ...]) -> Integers:
    """Rows (N,) of the readings, for the configurations named in a table; (N, 2) for pairs. Raises
    `InputError` for a configuration without readings.
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
