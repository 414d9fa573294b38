"""How the platform turns, by the measured poses alone; [C] III.B, in words."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Booleans
from pkmcal.identify.verdict import POOR
from pkmcal.observe.poses import PoseSet
from pkmcal.papers.rotation_axis import RotationAxis, rotation_axis
from pkmcal.session import Session

FEWEST = 4
"""Whole poses of one station from which the platform's turning is tested."""
KEPT = {"one axis": "turn about one axis", "none": "do not turn"}


def turning(session: Session, poses: PoseSet, on_platform: Booleans) -> list[tuple[bool, str]]:
    """Whether the platform turns as the mechanism file says, by every station that saw it whole: in
    doubt or not, and the words. on_platform : (M,) of the mounts.
    """
    motion = session.machine.document.motion
    if motion == "spatial" or not len(poses):
        return []
    whole = (poses.rows == 6) & on_platform[poses.mount]
    out: list[tuple[bool, str]] = []
    for s in np.unique(poses.station[whole]).tolist():
        part = poses.select(whole & (poses.station == s))
        if len(part) >= FEWEST:
            found = rotation_axis(part, motion)
            doubt = _doubt(found)
            said = found.sentence if doubt or found.tenable else _nearly(found)
            out.append((doubt, f"{session.station_names[s]}: {said}"))
    return out


def _doubt(found: RotationAxis) -> bool:
    """Noise that is stated a little too small is no reason to doubt a mechanism."""
    return not found.tenable and found.chi2 > POOR**2 * found.dof


def _nearly(found: RotationAxis) -> str:
    off, noise = (np.rad2deg(np.sqrt(np.mean(x**2))) for x in (found.tilt, found.expected_tilt))
    return (
        f"The boards {KEPT[found.hypothesis]} but for {off:.3f}°, where their stated noise alone"
        f" gives {noise:.3f}°."
    )
