"""Distances between two positions of the tool, as calipers measure them on a printed part.

The tool leaves a mark at two configurations, and the distance d of the marks is measured. With the
tool's point m, fixed to the platform, the marks are ``p_k = R_k m + t_k`` and the residual is

    (|p_2 - p_1| - d) / sigma.

With the unit vector e from the first mark to the second, a perturbation (omega, tau) of the second
pose changes the distance by ``e . (omega x R_2 m + tau)``, the same perturbation of the first pose
by ``-e . (omega x R_1 m + tau)``, and a shift tau of the tool's point by ``e . (R_2 - R_1) tau``.

Distances determine the size of a machine, which heights of a bed do not determine. Klipper's
``DELTA_ANALYZE`` uses distances in the same way, from a part of a fixed shape
(https://www.klipper3d.org/Delta_Calibrate.html).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Metres, PairTable, Schema, read_pairs
from pkmcal.measurements.contract import (
    LEAST_NOISE,
    NOISE_FIELD_RANGE,
    LinkKind,
    configuration_rows,
)
from pkmcal.measurements.links import LinkRows, LinkSet
from pkmcal.mechanisms import Machine, check_plausible

END_COLUMNS, VALUE_COLUMN, SIGMA_COLUMN = ("from", "to"), "distance", "sigma"
LONGEST_IN_SIZES = 4.0
"""Largest plausible distance, relative to the machine's size: a tool reaches no further than the
machine's size to either side, and a nominal model may be wrong by a factor of two."""
OTHER_UNIT_RATIO = 10.0
"""Ratio of measured to nominal distances, or its inverse, beyond which all of them are in another
unit: inches for millimetres make 25.4, and no nominal model is wrong by a factor of ten."""


class DistancesDocument(Schema):
    """``distances``: file of the table, and noise of the distances."""

    file: str = Field(description="the table of distances, for example distances.csv")
    noise: Annotated[Metres, NOISE_FIELD_RANGE] | None = Field(
        default=None,
        description="the standard deviation of a distance in metres, such as 3.0e-5, the default",
    )


@dataclass(frozen=True)
class DistanceSet(LinkSet):
    """N distances, m; the mount's origin is the tool's point."""

    @property
    def kind(self) -> str:
        """Code of the kind."""
        return Distances.code

    def rows(self, first: Array, second: Array, mount: Array) -> LinkRows:
        """Residuals and derivatives; equations in the module's docstring."""
        point = mount[..., :3, 3:]
        arms = [(T[..., :3, :3] @ point)[..., 0] for T in (first, second)]
        apart = arms[1] + second[..., :3, 3] - arms[0] - first[..., :3, 3]
        distance = np.linalg.norm(apart, axis=-1)
        # where both marks coincide the distance has no derivative
        e = apart / np.where(distance > 0, distance, 1.0)[..., None] / self.sigma[:, None]
        by_poses = [np.concatenate([np.cross(arm, e), e], axis=-1) for arm in arms]
        turned = (second[..., :3, :3] - first[..., :3, :3]).mT @ e[..., None]
        by_mount = np.concatenate([np.zeros_like(e), turned[..., 0]], axis=-1)
        return LinkRows((distance - self.value) / self.sigma, -by_poses[0], by_poses[1], by_mount)


@final
class Distances(LinkKind):
    """Distances between two positions of the tool."""

    code: ClassVar = "distances"
    one: ClassVar = "distance"
    label: ClassVar = "distances"
    unit: ClassVar = "m"
    default_sigma: ClassVar[float] = 3e-5
    own_sigma: ClassVar = "measuring some of them twice shows yours"
    key: ClassVar = "distances"
    schema: ClassVar = DistancesDocument

    @classmethod
    def table(cls, node: DistancesDocument) -> str:
        """Name of the table's file."""
        return node.file

    @classmethod
    def noise(cls, node: DistancesDocument) -> float | None:
        """Standard deviation of a distance, m, None if not stated."""
        return node.noise

    @classmethod
    def read(
        cls, node: DistancesDocument, path: Path, names: tuple[str, ...], machine: Machine
    ) -> DistanceSet:
        """Read the table; every fault raises `InputError` with line and column."""
        table = read_pairs(path, END_COLUMNS, (VALUE_COLUMN,), (SIGMA_COLUMN,), label=node.file)
        table.check_kinds(["m"] * len(table.columns))
        rows = configuration_rows(table, names)
        column = dict(zip(table.columns, table.values.T, strict=True))
        by_default = SIGMA_COLUMN not in column and node.noise is None
        common = cls.default_sigma if node.noise is None else node.noise
        sigma = column.get(SIGMA_COLUMN, np.full(len(rows), common))
        for k, value in enumerate(column[VALUE_COLUMN].tolist()):
            _check_row(table, k, value, float(sigma[k]), machine)
        none = np.zeros(len(rows), dtype=int)
        value, lines = column[VALUE_COLUMN], np.array(table.lines)
        return DistanceSet(table.label, rows, none, value, sigma, lines, by_default)

    @classmethod
    def check_start(cls, links: LinkSet, T_base_platform: Array) -> None:
        """Raise `InputError` where all distances are in another unit than the machine.

        T_base_platform : (K, 4, 4) by the nominal model, NaN where it has no pose.
        """
        place = T_base_platform[:, :3, 3]
        apart = place[links.configuration[:, 1]] - place[links.configuration[:, 0]]
        ratio = links.value / np.maximum(np.linalg.norm(apart, axis=-1), 1e-9)
        ratio = ratio[np.isfinite(ratio)]
        large, small = ratio > OTHER_UNIT_RATIO, ratio < 1 / OTHER_UNIT_RATIO
        if not ratio.size or not (large.all() or small.all()):
            return
        raise InputError(
            "the distances are in another unit than the machine",
            where=links.label,
            found=f"distances of {float(np.median(ratio)):.3g} times those by the readings",
            expected="metres, or a unit in the header",
            next_step=f"Head the column {VALUE_COLUMN} [mm], if these are millimetres",
        )


def _check_row(table: PairTable, k: int, value: float, sigma: float, machine: Machine) -> None:
    """Raise `InputError` for an impossible distance: not positive, too long, between a
    configuration and itself, or with an impossible standard deviation.
    """
    first, second = table.pairs[k]
    where = table.where(k, table.columns.index(VALUE_COLUMN))
    if first == second:
        raise InputError(
            "a distance leads from one configuration to another",
            where=table.where(k),
            found=f"{first} twice",
            expected="two different configurations",
        )
    # value
    if value <= 0:
        raise InputError(
            "a distance is a positive number", where=where, found=f"{value:g} m", expected="above 0"
        )
    most = LONGEST_IN_SIZES * machine.size
    if value > most:
        raise InputError(
            "this distance is longer than the machine reaches",
            where=where,
            found=f"{value:g} m",
            expected=f"at most {most:.3g} m, four times the machine's largest length",
            next_step=f"Head the column {VALUE_COLUMN} [mm], if this is in millimetres"
            if value <= 1e3 * most
            else None,
        )
    # standard deviation
    if SIGMA_COLUMN not in table.columns:
        return
    where = table.where(k, table.columns.index(SIGMA_COLUMN))
    if not sigma >= LEAST_NOISE:
        raise InputError(
            "a standard deviation is a positive number",
            where=where,
            found=f"{sigma:g} m",
            expected=f"{LEAST_NOISE:g} m or more",
        )
    check_plausible(sigma, machine, where, "a standard deviation")
