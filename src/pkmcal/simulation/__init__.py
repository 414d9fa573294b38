"""Sessions with known truth: photographs, edges, joint readings; for tests, studies, demos.

Modules from bottom to top: shapes, surfaces, casting and render make one photograph; drives says
where motors and guides are, driven_parts draws them, and scene the whole machine in its room;
stations, configurations and truth draw what is in a session; session writes it; forearms gives
cylinders to drawings without any; edges gives measurements without photographs; demo holds the
demonstration's settings.
"""

from pkmcal.simulation.board import board_for
from pkmcal.simulation.edges import EdgeNoise, simulate_edges
from pkmcal.simulation.forearms import with_forearms
from pkmcal.simulation.render import Sensor
from pkmcal.simulation.session import simulate_session
from pkmcal.simulation.stations import StationPose
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
    "true_machine",
    "with_forearms",
]
