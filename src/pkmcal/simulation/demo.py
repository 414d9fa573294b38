"""Settings of the demonstration session, small enough to be rendered while the user waits."""

from __future__ import annotations

from pkmcal.simulation.truth import Settings

DEMO_MECHANISM = "gough-stewart"
DEMO_SEED = 7
DEMO_SETTINGS = Settings(stations=3, configurations=6)
