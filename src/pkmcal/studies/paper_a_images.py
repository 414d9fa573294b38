"""Noise of [A] Table 1 on rendered images: six configurations with five images each."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pkmcal.identify.axis_measurements import AxisNoise
from pkmcal.judge.repeatability import LegScatter, study_repeats
from pkmcal.mechanisms import load_mechanism, machine_from_document, with_exact_scales
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.simulation import Settings, simulate_session
from pkmcal.simulation.demo import DEMO_MECHANISM

PAPER_A_PICTURE_SIZE = (1024, 768)
"""[A] 4.2: pixels; its lens of 6 mm is also that of the demonstration."""
PAPER_A_SESSION_SETTINGS = Settings(stations=3, configurations=6, repeats=5)
"""Six orientations of the legs, [A] 4.2, at three stations, so that the session can be
calibrated.
"""
RENDERING_PROGRESS_SHARE = 0.8


class MeasuredNoise(NamedTuple):
    """Standard deviations in a single image of a leg: median and largest over the legs.

    edge : of the shift of an edge, px, median.
    """

    middle: AxisNoise
    bound: AxisNoise
    edge: float


def measured_noise(seed: int, progress: Callable[[str, float], None]) -> MeasuredNoise:
    """Render the images, calibrate the session, and compute the scatter of the axes."""

    def rendered(done: int, total: int) -> None:
        progress(f"Image {done} of {total}", RENDERING_PROGRESS_SHARE * done / total)

    with tempfile.TemporaryDirectory(prefix="pkmcal-") as name:
        folder = Path(name) / "session"
        machine = machine_from_document(with_exact_scales(load_mechanism(DEMO_MECHANISM).document))
        simulate_session(
            folder,
            machine,
            camera_of_size(PAPER_A_PICTURE_SIZE),
            PAPER_A_SESSION_SETTINGS,
            seed=seed,
            progress=rendered,
        )
        repeats = study_repeats(
            folder,
            seed=seed,
            progress=lambda text, share: progress(
                text, RENDERING_PROGRESS_SHARE + (1 - RENDERING_PROGRESS_SHARE) * share
            ),
        )
    return MeasuredNoise(_noise(repeats.middle), _noise(repeats.bound), repeats.middle.shift)


def _noise(row: LegScatter) -> AxisNoise:
    return AxisNoise(row.psi, row.theta, row.x, row.z, images=1)
