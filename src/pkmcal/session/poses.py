"""Tables of targets on the platform, measured by a laser tracker, a measuring machine or a probe.

One row for each configuration; its columns tell the kind of measurement
(:class:`~pkmcal.measurements.contract.TargetKind`). Lengths in metres and angles in radians, in the
tracker's own frame, which is arbitrary. The measured target is fixed to the platform; its pose on
the platform is estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.errors import InputError
from pkmcal.files import CsvTable, closest, read_csv
from pkmcal.levels import OTHER_UNIT_RATIO
from pkmcal.measurements import PoseSet
from pkmcal.measurements.contract import TargetKind, configuration_rows, kinds_of
from pkmcal.wording import listed


@dataclass(frozen=True)
class PoseTable:
    """Measurements of one tracker.

    name : of the station.
    label : the table's name in messages.
    kind : code of the kind of measurement.
    configuration : (N,) rows of the session's readings.
    T : (N, 4, 4) T_tracker_target; what the kind does not measure is a placeholder.
    position, rotation : standard deviations, m and rad; None if not stated.
    level : whether the tracker's z axis is exactly the base's.
    by_default : whether `position` is the kind's default, for the session states none.
    """

    name: str
    label: str
    kind: str
    configuration: Integers
    T: Array
    position: float | None
    rotation: float | None
    level: bool = False
    by_default: bool = False

    __repr__ = short_repr

    @classmethod
    def to_come(
        cls, name: str, label: str, position: float | None, rotation: float | None
    ) -> PoseTable:
        """Empty table of a tracker that has not measured yet; its kind is the one with most numbers
        of those whose noise is stated.

        Raises InputError if no noise is stated.
        """
        stated = {
            code: target.numbers
            for code, target in kinds_of(TargetKind).items()
            if target.turns() <= (rotation is not None)
            and target.shifts() <= (position is not None)
        }
        if not stated:
            raise InputError(
                "the tracker has no stated noise",
                where=f"session.yaml, stations.{name}.tracker.noise",
                found="neither position nor rotation",
                expected="{position: 2.0e-5} in metres, {rotation: 1.0e-4} in radians, or both",
                code="poses.no_noise",
            )
        kind = max(stated, key=stated.__getitem__)
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
        return self.target.start(self.T, T_base_platform[self.configuration])


def read_poses(
    path: Path,
    label: str,
    names: tuple[str, ...],
    position: float | None,
    rotation: float | None,
    name: str = "tracker",
    *,
    level: bool = False,
) -> PoseTable:
    """Read a table of a tracker; raises InputError with line and column.

    names : configurations of the session.
    position, rotation : standard deviations, m and rad; None if not stated.
    name : of the station.
    level : as in :class:`PoseTable`.
    """
    table = read_csv(path, label=label)
    kind = _kind(table)
    table.check_kinds([kind.units.get(name, "") for name in table.columns])
    if level and not kind.levels:
        raise InputError(
            "level applies to heights only",
            where=label,
            found=f"columns {', '.join(table.columns)}",
            expected="configuration and z",
            next_step="Leave level out: the orientation of such a tracker is estimated",
        )
    by_default = position is None and kind.default_sigma is not None
    position = kind.default_sigma if by_default else position
    for measured, sigma, what, unit, stated in (
        (kind.turns(), rotation, "orientations", "rotation", "radians"),
        (kind.shifts(), position, "positions", "position", "metres"),
    ):
        if measured and sigma is None:
            raise InputError(
                f"the {what} have no stated noise",
                where=label,
                found=f"columns {', '.join(table.columns)}",
                expected=f"noise: {{{unit}: ...}} of the tracker, in {stated}",
                next_step=f"Leave these columns out, if no {what} were measured",
                code="poses.no_noise",
            )
    rows = configuration_rows(table, names)
    if len(rows) < kind.fewest_rows:
        raise InputError(
            f"too few {kind.label} to determine the tracker's pose",
            where=label,
            found=f"{len(rows)} rows",
            expected=f"{kind.fewest_rows} at least",
        )
    T = kind.T_tracker_target(table)
    return PoseTable(name, label, kind.code, rows, T, position, rotation, level, by_default)


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
        "this column is not known" if unknown else "this combination of columns has no meaning",
        where=f"{table.label}, line 1",
        found=unknown[0] if unknown else listed(table.columns, 12),
        expected=guess or "configuration and " + "; or ".join(", ".join(c) for c in headers),
    )


def check_lengths(table: PoseTable, T_base_platform: Array) -> None:
    """Raise InputError if the table's lengths are not in metres.

    T_base_platform : (K, 4, 4) nominal poses, NaN where the nominal model has no solution.
    """
    nominal = T_base_platform[table.configuration, :3, 3]
    motion = float(np.nanmax(np.nanstd(nominal, axis=0)))
    if not table.target.shifts():
        return
    measured = table.target.lengths(table.T)
    spread = float(np.max(np.std(measured, axis=0)))
    if spread <= OTHER_UNIT_RATIO * max(motion, 1e-6):
        return
    raise InputError(
        "the table's lengths look like millimetres",
        where=table.label,
        found=f"positions that vary by {spread:.4g}",
        expected=f"metres; the platform itself moves by {motion:.3g} by its readings",
        next_step="Divide x, y and z by 1000, or head them x [mm], y [mm], z [mm]",
        code="poses.units",
    )
