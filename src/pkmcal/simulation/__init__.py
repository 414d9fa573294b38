"""Simulated sessions with known truth: images and joint readings for tests and studies.

Modules from bottom to top: `shapes`, `surfaces` and `render` make one image; `cylinders` adds rods
to nominal models without any; `scene` builds the whole machine in its room, `board` a calibration
board in that room; `truth` draws the true values of a session, and `session` writes the session;
`demo` holds the settings of the demonstration. Configurations, stations and edges without images
are those of :mod:`pkmcal.placement`.
"""

from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.placement.stations import StationPose
from pkmcal.simulation.board import board_for
from pkmcal.simulation.cylinders import to_simulate, with_forearms
from pkmcal.simulation.render import Sensor
from pkmcal.simulation.session import simulate_session
from pkmcal.simulation.truth import Settings, Truth, draw_truth, load_truth, true_machine

__all__ = [
    "EdgeNoise",
    "Sensor",
    "Settings",
    "StationPose",
    "Truth",
    "board_for",
    "draw_truth",
    "load_truth",
    "simulate_edges",
    "simulate_session",
    "to_simulate",
    "true_machine",
    "with_forearms",
]
