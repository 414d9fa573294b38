"""What a carrier of limb ends offers; a new kind is one file in this folder.

A limb is a rod between a point A on the base side and a point B on the platform side,
``|B(X; theta) - A(q; theta)| = length(q; theta)``. The base carrier gives A, the platform
carrier gives B. A carrier names the joint kinds it serves in mechanism files, the schema of
its fields, its parameters, and the point with its exact derivatives, for any number of legs
and configurations at once.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from functools import cache
from typing import ClassVar, NamedTuple

from pkmcal.arrays import Array
from pkmcal.files import Schema


class ParameterKind(NamedTuple):
    """One parameter of a part: path below the part, unit, and the drawing's tolerance for it."""

    path: str
    unit: str
    tolerance: str


class CarriedPoint(NamedTuple):
    """A limb's end and its derivatives.

    value : (..., 3) m, base frame.
    by_motion : (...,) reading's column (..., 3) on the base side, or the platform pose's six
        numbers (..., 3, 6) on the platform side.
    by_parameters : (..., 3, n).
    """

    value: Array
    by_motion: Array
    by_parameters: Array


class BaseCarrier(ABC):
    """Gives A, the limb's end on the base side, as a function of the joint reading.

    driven : the reading moves A; the rod then has a length of its own.
    """

    driven: ClassVar[bool] = False
    joints: ClassVar[tuple[str, ...]]
    schema: ClassVar[type[Schema]]
    parameters: ClassVar[tuple[ParameterKind, ...]]

    @staticmethod
    @abstractmethod
    def point(parameters: Array, readings: Array) -> CarriedPoint:
        """A for parameters (..., n) and readings (...,) (m or rad)."""


class PlatformCarrier(ABC):
    """Gives B, the limb's end on the platform side, as a function of the platform's pose."""

    joints: ClassVar[tuple[str, ...]]
    schema: ClassVar[type[Schema]]
    parameters: ClassVar[tuple[ParameterKind, ...]]

    @staticmethod
    @abstractmethod
    def point(parameters: Array, T_base_platform: Array) -> CarriedPoint:
        """B for parameters (..., n) and poses (..., 4, 4)."""


@cache
def base_carriers() -> dict[str, type[BaseCarrier]]:
    """The base carrier of every joint kind known to mechanism files."""
    _import_all()
    return {joint: cls for cls in BaseCarrier.__subclasses__() for joint in cls.joints}


@cache
def platform_carriers() -> dict[str, type[PlatformCarrier]]:
    """The platform carrier of every joint kind known to mechanism files."""
    _import_all()
    return {joint: cls for cls in PlatformCarrier.__subclasses__() for joint in cls.joints}


def _import_all() -> None:
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
