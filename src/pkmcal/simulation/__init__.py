"""Simulated sessions with known truth: images, edges and joint readings for tests and studies.

Modules from bottom to top: `shapes`, `surfaces` and `render` make one image; `drives` locates
motors and guides, and adds cylinders to nominal models without any; `scene` builds the whole
machine in its room, `board` a calibration board in that room; `placement` chooses configurations
and camera poses; `truth` draws the true values of a session, and `session` writes the session;
`edges` simulates measured edges without images; `demo` holds the settings of the demonstration.
"""

from pkmcal.simulation.board import board_for
from pkmcal.simulation.drives import to_simulate, with_forearms
from pkmcal.simulation.edges import EdgeNoise, simulate_edges
from pkmcal.simulation.placement import StationPose
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
