"""The demonstration: session, truth and calibration, each made when it is needed."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

import pkmcal
from pkmcal.arrays import Array
from pkmcal.calibration.calibrate import Calibration
from pkmcal.calibration.localization import localize_by_legs, platform_poses, read_images
from pkmcal.observe.image_batches import StationImages
from pkmcal.placement.default_camera import default_camera
from pkmcal.session.load import Session, load_session
from pkmcal.simulation import Truth, load_truth, simulate_session
from pkmcal.simulation.demo import DEMO_MECHANISM, DEMO_SEED, DEMO_SETTINGS


class Case:
    """The demonstration's session with its truth and its calibration."""

    def __init__(self, work: Path) -> None:
        self.work = work

    @cached_property
    def folder(self) -> Path:
        """The session's folder."""
        return simulated(self.work / "demo", DEMO_SEED)

    @cached_property
    def session(self) -> Session:
        """The session as a user would load it."""
        return load_session(self.folder)

    @cached_property
    def truth(self) -> Truth:
        """The simulation's truth."""
        return load_truth(self.folder, self.session.machine)

    @cached_property
    def images(self) -> list[StationImages]:
        """Decoded images by station."""
        return read_images(self.session)

    @cached_property
    def result(self) -> Calibration:
        """The calibration."""
        return pkmcal.calibrate(self.session)

    @cached_property
    def pose_passes(self) -> list[Array]:
        """Rough and localized poses of the stations, T_camera_base (S, 4, 4) each."""
        poses = platform_poses(self.session)
        rngs = np.random.default_rng(0).spawn(len(self.images) + 1)
        results = localize_by_legs(self.session, self.images, poses, rngs[1:])
        by_hand = [s.T_camera_base for s in self.session.stations if s.T_camera_base is not None]
        return [np.stack(by_hand), np.stack([f.T_camera_base for f in results.localizations])]


def simulated(folder: Path, seed: int) -> Path:
    """A session like the demonstration's, made where it is not there yet."""
    if not folder.exists():
        machine = pkmcal.load_mechanism(DEMO_MECHANISM)
        simulate_session(folder, machine, default_camera(), DEMO_SETTINGS, seed=seed)
    return folder
