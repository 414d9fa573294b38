"""Tables of poses of the platform, measured by a laser tracker, a measuring machine or a probe.

One row for each configuration: poses (x, y, z and a quaternion qw, qx, qy, qz or a rotation vector
rx, ry, rz), points (x, y, z), or heights above a flat bed (z). Lengths in metres and angles in
radians, in the tracker's own frame, which is arbitrary; the bed's frame has its z axis upwards, as
the base. The measured target is fixed to the platform; its place on the platform is estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.errors import InputError
from pkmcal.files import CsvTable, closest, read_csv
from pkmcal.geometry.rigid import from_quaternion, pose, rotation
from pkmcal.measurements import PoseSet
from pkmcal.measurements.contract import (
    POINT_COLUMNS,
    QUATERNION_COLUMNS,
    TURN_VECTOR_COLUMNS,
    TargetKind,
    configuration_rows,
    kinds_of,
)
from pkmcal.measurements.tracker_points import TrackerPoints
from pkmcal.measurements.tracker_poses import TrackerPoses
from pkmcal.wording import listed

UNIT_QUATERNION_TOLERANCE = 1e-3
"""Allowed deviation of a quaternion's length from one: the rounding of three digits."""
OTHER_UNIT_SPREAD_FACTOR = 30.0
"""Ratio of a table's spread to the machine's own motion above which its lengths are in another
unit."""


@dataclass(frozen=True)
class PoseTable:
    """Measurements of one tracker.

    name : of the station.
    label : the table's name in messages.
    kind : code of the kind of measurement.
    configuration : (N,) rows of the session's readings.
    T : (N, 4, 4) T_tracker_target. The rotation of a point, and all but z of a height, are
        placeholders.
    position, rotation : standard deviations, m and rad.
    level : whether the tracker's z axis is exactly the base's.
    """

    name: str
    label: str
    kind: str
    configuration: Integers
    T: Array
    position: float
    rotation: float | None
    level: bool = False

    __repr__ = short_repr

    @classmethod
    def to_come(cls, name: str, label: str, position: float, rotation: float | None) -> PoseTable:
        """Empty table of a tracker that has not measured yet: of poses, or of points without
        rotation noise.
        """
        kind = TrackerPoints.code if rotation is None else TrackerPoses.code
        none = np.zeros(0, dtype=int)
        return cls(name, label, kind, none, np.zeros((0, 4, 4)), position, rotation)

    @property
    def target(self) -> type[TargetKind]:
        """Kind of measurement."""
        return kinds_of(TargetKind)[self.kind]

    @property
    def whiten(self) -> Array:
        """Whitening matrix (6, 6) of a measurement, see :class:`~pkmcal.measurements.PoseSet`."""
        return self.target.whiten(self.position, self.rotation)

    def poses(self, station: int, mount: int) -> PoseSet:
        """Measurements as a set; components that are not measured have zero rows in the whitening
        matrices.

        station, mount : indices of the tracker's station and of the target.
        """
        n = len(self.configuration)
        return PoseSet(
            station=np.full(n, station),
            configuration=self.configuration,
            mount=np.full(n, mount),
            T_station_target=self.T,
            whiten=np.broadcast_to(self.whiten, (n, 6, 6)).copy(),
        )

    def start(self, T_base_platform: Array) -> Array | None:
        """Initial T_tracker_base (4, 4) from the platform's nominal poses (K, 4, 4); None for full
        poses, which need none.
        """
        return self.target.start(self.T, T_base_platform[self.configuration, :3, 3])


def read_poses(
    path: Path,
    label: str,
    names: tuple[str, ...],
    position: float,
    rotation_noise: float | None,
    name: str = "tracker",
    *,
    level: bool = False,
) -> PoseTable:
    """Read a table of a tracker; raises InputError with line and column.

    names : configurations of the session.
    position, rotation_noise : standard deviations, m and rad.
    name : of the station.
    level : as in :class:`PoseTable`.
    """
    table = read_csv(path, label=label)
    kind = _kind(table)
    lengths, turns = dict.fromkeys(POINT_COLUMNS, "m"), dict.fromkeys(TURN_VECTOR_COLUMNS, "rad")
    table.check_kinds([(lengths | turns).get(name, "") for name in table.columns])
    if kind.turns() and rotation_noise is None:
        raise InputError(
            "the poses' orientations have no stated noise",
            where=label,
            found=f"columns {', '.join(table.columns)}",
            expected="noise: {position: ..., rotation: ...} of the tracker, in radians",
            next_step="Leave the columns of the turn out, if only points were measured",
        )
    rows = configuration_rows(table, names)
    if len(rows) < kind.fewest_rows:
        raise InputError(
            f"too few {kind.label} to say where the tracker stands",
            where=label,
            found=f"{len(rows)} rows",
            expected=f"{kind.fewest_rows} at least",
        )
    column = {head: table.values[:, k] for k, head in enumerate(table.columns)}
    zeros = np.zeros(len(rows))
    t = np.stack([column.get(axis, zeros) for axis in POINT_COLUMNS], axis=-1)
    T = pose(_rotations(table, column), t)
    if level and not kind.levels:
        raise InputError(
            "only of heights can be said that the bed is level",
            where=label,
            found=f"columns {', '.join(table.columns)}",
            expected="configuration and z",
            next_step="Leave level out: how such a tracker stands is found out",
        )
    return PoseTable(name, label, kind.code, rows, T, position, rotation_noise, level)


def _kind(table: CsvTable) -> type[TargetKind]:
    """Kind of measurement, from the table's header."""
    header, kinds = set(table.columns), kinds_of(TargetKind)
    for kind in kinds.values():
        if any(header == set(columns) for columns in kind.headers):
            return kind
    headers = sorted((h for kind in kinds.values() for h in kind.headers), key=len, reverse=True)
    names = sorted({name for columns in headers for name in columns})
    unknown = [name for name in table.columns if name not in names]
    guess = closest(unknown[0], names) if unknown else None
    raise InputError(
        "this column is not known" if unknown else "these columns together mean nothing",
        where=f"{table.label}, line 1",
        found=unknown[0] if unknown else listed(table.columns, 12),
        expected=guess or "configuration and " + "; or ".join(", ".join(c) for c in headers),
    )


def _rotations(table: CsvTable, column: dict[str, Array]) -> Array:
    """Rotations (N, 3, 3) of the rows; identity for points and heights."""
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


def check_lengths(table: PoseTable, T_base_platform: Array) -> None:
    """Raise InputError if the table's lengths are not in metres.

    T_base_platform : (K, 4, 4) nominal poses, NaN where the nominal model has no solution.
    """
    nominal = T_base_platform[table.configuration, :3, 3]
    motion = float(np.nanmax(np.nanstd(nominal, axis=0)))
    measured = table.target.lengths(table.T)
    spread = float(np.max(np.std(measured, axis=0)))
    if spread <= OTHER_UNIT_SPREAD_FACTOR * max(motion, 1e-6):
        return
    raise InputError(
        "the table's lengths look like millimetres",
        where=table.label,
        found=f"positions that vary by {spread:.4g}",
        expected=f"metres; the platform itself moves by {motion:.3g} by its readings",
        next_step="Divide x, y and z by 1000, or head them x [mm], y [mm], z [mm]",
        code="poses.units",
    )
