"""``c``: a C99 header and source with the machine's values and kinematics, and a self-test."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.export.c_header import HEADER, SELFTEST, SOURCE, header_text, selftest_text
from pkmcal.export.c_read import closure, constants
from pkmcal.export.c_source import source_text
from pkmcal.export.c_tables import tables_of
from pkmcal.export.contract import Difference, Exporter
from pkmcal.export.samples import samples
from pkmcal.export.source import Source
from pkmcal.mechanisms.kinematics import inverse_result
from pkmcal.outcome import Finding, Level

PAIRS = 12
ROUNDING = 1e-12
"""m, rad: a thousand times the rounding of a double at 1 m; poses themselves close to it."""


@final
class CSource(Exporter):
    """The machine's kinematics as C99, without dependencies."""

    name: ClassVar = "c"
    title: ClassVar = "C99 header and source: inverse and forward kinematics"

    def files(self, source: Source) -> dict[str, str]:
        """Header, source and self-test."""
        tables = tables_of(source.machine)
        poses, joints = samples(source.machine, PAIRS)
        return {
            HEADER: header_text(source, tables),
            SOURCE: source_text(source, tables),
            SELFTEST: selftest_text(source, poses, joints),
        }

    def check(self, files: dict[str, str], source: Source) -> list[Difference]:
        """The constants as they stand in the text close the machine where it closes."""
        machine = source.machine
        found, test = constants(files[SOURCE]), constants(files[SELFTEST])
        poses, joints = samples(machine)
        hinges = inverse_result(machine.layout, machine.values, poses)[1]
        off = _largest(closure(found, poses, joints, hinges))
        home = np.concatenate([machine.home()[:3, :3].ravel(), machine.home()[:3, 3]])
        ranges = machine.joint_ranges.copy()
        ranges = np.where(np.isfinite(ranges), ranges, np.array([-np.inf, np.inf]))
        same = np.array_equal(found["home"], home) and np.array_equal(
            found["range"], ranges.ravel()
        )
        pairs = test["POSES"].reshape(-1, 12)
        transform = np.tile(np.eye(4), (len(pairs), 1, 1))
        transform[:, :3, :3], transform[:, :3, 3] = pairs[:, :9].reshape(-1, 3, 3), pairs[:, 9:]
        readings = test["READINGS"].reshape(-1, machine.n_joints)
        return [
            Difference(
                f"closure of the constants read again, at {len(poses)} poses", off, ROUNDING
            ),
            Difference("home pose and ranges read again", 0.0 if same else np.inf, 0.0),
            Difference(
                f"readings of the self-test's {len(pairs)} poses",
                _largest(machine.inverse(transform) - readings),
                ROUNDING,
                "m or rad",
            ),
        ]

    def notes(self, files: dict[str, str], source: Source) -> tuple[Finding, ...]:
        """How to run the self-test, and what is not in the source."""
        del files
        out = [
            Finding(
                Level.NOTE,
                f"Test on the controller: cc -std=c99 -O2 {SELFTEST}"
                f" {SOURCE} -lm && ./a.out prints PASS.",
            )
        ]
        passive = np.flatnonzero(~source.machine.layout.closing) + 1
        if passive.size:
            names = ", ".join(map(str, passive))
            out.append(Finding(Level.NOTE, f"Passive legs ({names}) are not in the source."))
        if source.machine.layout.shares_motors:
            out.append(
                Finding(
                    Level.NOTE,
                    "Several rods share a motor: the source has no pkmcal_inverse_jacobian.",
                )
            )
        return tuple(out)


def _largest(values: Array) -> float:
    return float(np.abs(values).max(initial=0.0))
