"""Calibrated machine of a session on the stage, with its cameras and poses."""

from __future__ import annotations

import numpy as np

from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.space import Space
from pkmcal.report.space import space_poses
from pkmcal.viewing.content import SessionContent
from pkmcal.web.motion import Postures
from pkmcal.web.stage import leg_rows, machine_shape


def calibrated_stage(content: SessionContent) -> Space:
    """Block of the stage at all configurations in use. Raises InputError without a calibration."""
    saved = content.saved
    machine, used = saved.machine, np.flatnonzero(saved.used)
    postures = Postures(saved.joints[used], saved.T_base_platform[used])
    first = Postures(*(part[:1] for part in postures)) if len(used) else None
    T_base_camera = {station.name: station.T_base_camera for station in saved.stations}
    cameras = {
        station.name: (content.calibrated_camera(s), T_base_camera[station.name])
        for s, station in enumerate(content.session.stations)
        if station.name in T_base_camera
    }
    return Space(
        title="",
        caption="The calibrated machine at the image's configuration, with its cameras.",
        alt="The calibrated machine in three dimensions with its cameras.",
        machine=machine_shape(machine, leg_rows(machine, saved.sigma), cameras, first),
        poses=space_poses(
            machine, postures, [saved.configurations[k] for k in used], configuration_key
        ),
    )
