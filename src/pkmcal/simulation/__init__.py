"""Sessions with known truth: photographs, edges, joint readings; for tests, studies, demos.

Modules from bottom to top: shapes, surfaces and render make one photograph; drives says where
motors and guides are, and gives cylinders to drawings without any; scene draws the whole machine in
its room, board a calibration board in it; placement says where machine and cameras stand; truth
draws what is in a session, and session writes it; edges gives measurements without photographs;
demo holds the demonstration's settings.
"""

from pkmcal.simulation.board import board_for
from pkmcal.simulation.drives import to_simulate, with_forearms
from pkmcal.simulation.edges import EdgeNoise, simulate_edges
from pkmcal.simulation.placement import StationPlace
from pkmcal.simulation.render import Sensor
from pkmcal.simulation.session import simulate_session
from pkmcal.simulation.truth import Settings, Truth, draw_truth, load_truth, true_machine

__all__ = [
    "EdgeNoise",
    "Sensor",
    "Settings",
    "StationPlace",
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
