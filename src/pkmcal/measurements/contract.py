"""Contract of a kind of measurement; one file a kind, found by enumeration.

A kind is a final subclass of one of four base classes:

- :class:`ImageKind`: measured in images, where a station observes it;
- :class:`TargetKind`: a table of a tracker, a measuring machine or a probe, which measures a target
  on the platform;
- :class:`LinkKind`: a table of numbers that link two configurations each, under a key of its own in
  session.yaml;
- :class:`MotorKind`: readings of the motors.

Rows, Jacobian and noise, in standard deviations, stand beside the kind: edges in
:mod:`~pkmcal.measurements.edges`, targets of boards and trackers in
:mod:`~pkmcal.measurements.poses`, readings in :mod:`~pkmcal.measurements.readings`, links in the
kind's own file.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.files import CsvTable, PairTable, Schema
from pkmcal.geometry.rigid import from_quaternion, pose, rotation
from pkmcal.measurements.links import LinkSet
from pkmcal.mechanisms import Machine
from pkmcal.wording import listed

POINT_COLUMNS, QUATERNION_COLUMNS, TURN_VECTOR_COLUMNS = (
    ("x", "y", "z"),
    ("qw", "qx", "qy", "qz"),
    ("rx", "ry", "rz"),
)
COLUMN_UNITS = dict.fromkeys(POINT_COLUMNS, "m") | dict.fromkeys(TURN_VECTOR_COLUMNS, "rad")
UNIT_QUATERNION_TOLERANCE = 1e-3
"""Allowed deviation of a quaternion's length from one: the rounding of three digits."""
DISPLAY_UNITS = {"m": ("mm", 1e3), "rad": ("°", 180 / np.pi), "px": ("px", 1.0)}
"""Unit in reports, and the factor to it, by a kind's unit."""
LEAST_NOISE = 1e-12
"""Smallest standard deviation of a measurement, m or rad: no instrument is better."""
NOISE_FIELD_RANGE = Field(ge=LEAST_NOISE, lt=10)
"""Range of a stated standard deviation, m or rad: no instrument measures better than the lower end,
and a measurement worse than the upper end is of no use."""


class MeasurementKind(ABC):
    """Kind of measurement.

    code : identifier in files and programs.
    one : name of one measurement in reports and messages.
    label : plural of the name.
    unit : unit of the numbers.
    numbers : largest number of residuals of one measurement.
    rows : group of the residuals, which has one noise scale.
    default_sigma : standard deviation where a session states none, in ``unit``; None where it has
        to be stated.
    own_sigma : source of the standard deviation of a user's own instrument, in words.
    """

    code: ClassVar[str]
    one: ClassVar[str]
    label: ClassVar[str]
    unit: ClassVar[Literal["px", "m", "rad", "m or rad"]]
    numbers: ClassVar[int]
    rows: ClassVar[Literal["edges", "poses", "readings", "links"]]
    default_sigma: ClassVar[float | None] = None
    own_sigma: ClassVar[str] = ""


class ImageKind(MeasurementKind):
    """Kind that is measured in images.

    observe : its keyword under ``stations.*.observe``.
    """

    observe: ClassVar[str]


class MotorKind(MeasurementKind):
    """Readings of the motors.

    key : key in session.yaml.
    """

    key: ClassVar[str]
    rows: ClassVar = "readings"


class TargetKind(MeasurementKind, ABC):
    """Table of a tracker, under ``stations.*.tracker``.

    headers : for each form of the table, the columns beside the configuration's, in any order.
    units : unit of each column that has one, m or rad.
    known : which of the six numbers (omega, tau) of T_tracker_target are measured.
    fewest_rows : smallest number of rows that determine the tracker's pose with redundancy.
    levels : whether ``level: true`` is allowed, which makes the tracker's z axis the base's.
    """

    headers: ClassVar[tuple[tuple[str, ...], ...]]
    units: ClassVar[Mapping[str, str]] = COLUMN_UNITS
    rows: ClassVar = "poses"
    known: ClassVar[tuple[int, ...]]
    fewest_rows: ClassVar[int]
    levels: ClassVar[bool] = False

    @classmethod
    def turns(cls) -> bool:
        """Whether rotations are measured, which need a stated noise."""
        return any(k < 3 for k in cls.known)

    @classmethod
    def shifts(cls) -> bool:
        """Whether positions are measured, which need a stated noise."""
        return any(k >= 3 for k in cls.known)

    @classmethod
    def T_tracker_target(cls, table: CsvTable) -> Array:
        """Measurements (N, 4, 4) of a table with one of the headers; components that are not
        measured are those of the identity.

        Raises `InputError` for a row that is no pose.
        """
        column = {head: table.values[:, k] for k, head in enumerate(table.columns)}
        zeros = np.zeros(len(table.names))
        shift = np.stack([column.get(axis, zeros) for axis in POINT_COLUMNS], axis=-1)
        return pose(_rotations(table, column), shift)

    @classmethod
    def whiten(cls, position: float | None, rotation: float | None) -> Array:
        """Whitening matrix (6, 6) of one measurement.

        position, rotation : standard deviations in m and rad. Rows of numbers that are not measured
        are zero.
        """
        sigma = np.repeat([rotation or 1.0, position or 1.0], 3)
        return np.diag(np.where(np.isin(np.arange(6), cls.known), 1 / sigma, 0.0))

    @classmethod
    @abstractmethod
    def start(cls, T_tracker_target: Array, T_base_platform: Array) -> Array | None:
        """Initial T_tracker_base (4, 4), or None for whole poses, which determine it directly.

        T_tracker_target : (N, 4, 4) measurements.
        T_base_platform : (N, 4, 4) by the nominal model, NaN where it has no solution.
        """

    @classmethod
    def lengths(cls, T_tracker_target: Array) -> Array:
        """Measured coordinates (N, n), m."""
        return T_tracker_target[:, [k - 3 for k in cls.known if k >= 3], 3]


class LinkKind(MeasurementKind, ABC):
    """Numbers that link two configurations, under a key of their own in session.yaml.

    Each measurement is one number with its own standard deviation, of a point on the platform that
    is estimated with the machine. All kinds of links share one noise scale, which is estimated if
    the residuals are larger than stated.

    The number of configurations is fixed: the table (:class:`~pkmcal.files.PairTable`), the
    derivatives (:class:`~pkmcal.measurements.links.LinkRows`), the columns of the problem
    (:mod:`pkmcal.identify.link_rows`), rejections and reports are those of two.

    key, schema : of session.yaml.
    """

    key: ClassVar[str]
    schema: ClassVar[type[Schema]]
    numbers: ClassVar = 1
    rows: ClassVar = "links"

    @classmethod
    @abstractmethod
    def table(cls, node: Any) -> str:
        """Name of the table's file in session.yaml; node : an instance of the schema."""

    @classmethod
    @abstractmethod
    def noise(cls, node: Any) -> float | None:
        """Standard deviation of a measurement as stated in session.yaml, None if not stated."""

    @classmethod
    @abstractmethod
    def read(cls, node: Any, path: Path, names: tuple[str, ...], machine: Machine) -> LinkSet:
        """Read the table; every fault raises `InputError` with line and column.

        node : an instance of the schema.
        path : of the file.
        names : configurations of the session.
        """

    @classmethod
    @abstractmethod
    def check_start(cls, links: LinkSet, T_base_platform: Array) -> None:
        """Raise `InputError` for faults, such as another unit, that appear with the nominal model's
        poses (K, 4, 4).
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
    """Subclasses that define a code, sorted by module name."""
    out: list[type[MeasurementKind]] = []
    for kind in base.__subclasses__():
        out += [kind] if "code" in vars(kind) else _concrete(kind)
    return sorted(out, key=lambda kind: kind.__module__)


def _rotations(table: CsvTable, column: Mapping[str, Array]) -> Array:
    """Rotations (N, 3, 3) of the rows, from a quaternion, a rotation vector or the identity."""
    if "qw" in column:
        q = np.stack([column[name] for name in QUATERNION_COLUMNS], axis=-1)
        length = np.linalg.norm(q, axis=1)
        bad = np.flatnonzero(np.abs(length - 1) > UNIT_QUATERNION_TOLERANCE)
        if bad.size:
            raise InputError(
                "the quaternion is not of length one",
                where=f"{table.where(int(bad[0]))}, columns {', '.join(QUATERNION_COLUMNS)}",
                found=f"{length[bad[0]]:.4g}",
                expected="1; the scalar part is qw",
            )
        return from_quaternion(q)
    if "rx" in column:
        vector = np.stack([column[name] for name in TURN_VECTOR_COLUMNS], axis=-1)
        size = np.linalg.norm(vector, axis=1)
        bad = np.flatnonzero(size > 2 * np.pi)
        if bad.size:
            raise InputError(
                "the rotation vector is longer than a whole turn",
                where=f"{table.where(int(bad[0]))}, columns {', '.join(TURN_VECTOR_COLUMNS)}",
                found=f"{size[bad[0]]:.4g}",
                expected="radians, at most 3.1416",
                next_step="If these are degrees, head the columns rx [deg], ry [deg], rz [deg]",
            )
        return rotation(vector)
    return np.broadcast_to(np.eye(3), (len(table.names), 3, 3))


def configuration_rows(table: CsvTable, names: tuple[str, ...]) -> Integers:
    """Rows of the readings that belong to a table's configurations, (N,), or (N, 2) for a table of
    pairs.

    Raises `InputError` for a configuration without joint readings.
    """
    number = {name: k for k, name in enumerate(names)}
    written = table.pairs if isinstance(table, PairTable) else tuple((n,) for n in table.names)
    for row, name in ((row, name) for row, each in enumerate(written) for name in each):
        if name not in number:
            short = {reading.lstrip("0"): reading for reading in names}.get(name.lstrip("0"))
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
