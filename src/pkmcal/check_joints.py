"""Where the machine was measured, by its joint readings, as `pkmcal check` reports it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.outcome import Finding, Level
from pkmcal.session.load import Session
from pkmcal.wording import listed

LITTLE_USED = 0.5
"""Share of a joint's range below which its configurations are crowded."""
END = 0.15
"""Part of a joint's range, at either end, in which a reading is an extreme one."""
FEW_CONFIGURATIONS = 8
"""Configurations below which standard deviations are large and mistakes go unnoticed."""


@dataclass(frozen=True)
class JointCheck:
    """One joint's readings, m or rad; used : share of its range, ends : readings near either end
    of it (NaN and 0 where the mechanism file gives no range).
    """

    name: str
    low: float
    high: float
    used: float
    ends: tuple[int, int]


def joint_checks(session: Session) -> tuple[JointCheck, ...]:
    """All joints' readings."""
    return tuple(_joint(session, k) for k in range(session.joints.shape[1]))


def _joint(session: Session, column: int) -> JointCheck:
    values = session.joints[:, column]
    low, high = session.machine.joint_ranges[column]
    stroke = high - low
    ends = (int(np.sum(values < low + END * stroke)), int(np.sum(values > high - END * stroke)))
    return JointCheck(
        name=session.document["joints"]["columns"][column],
        low=float(values.min()),
        high=float(values.max()),
        used=float(np.ptp(values) / stroke),
        ends=ends,
    )


def joint_findings(session: Session, joints: tuple[JointCheck, ...]) -> list[Finding]:
    """What is doubtful, or worth knowing, about where the machine was photographed."""
    findings: list[Finding] = []
    crowded = [joint for joint in joints if joint.used < LITTLE_USED]
    if crowded:
        findings.append(
            Finding(
                Level.NOTE,
                f"{listed([joint.name for joint in crowded])} used little of the range (down to"
                f" {min(joint.used for joint in crowded):.0%}): readings near both ends of it"
                " halve the standard deviations of the offsets.",
            )
        )
    count = len(session.configurations)
    if count < FEW_CONFIGURATIONS:
        findings.append(
            Finding(
                Level.NOTE,
                f"There are only {count} configurations: standard deviations will be large and"
                " mistakes hard to notice. 15 or more are usual.",
            )
        )
    return findings
