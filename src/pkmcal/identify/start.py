"""Where the joint estimate starts: the better of what is known and the papers' own solution."""

from __future__ import annotations

import numpy as np

from pkmcal.errors import PkmcalError
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.robust import norms
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.papers.four_step import four_step


def better_start(machine: Machine, measurements: Measurements, known: State) -> State:
    """``known``, or [A]'s four steps on the edges where these explain the edges better.

    The four steps need no first guess, so they find the way back when the drawing or an earlier
    estimate has gone astray. Judged by the median misfit, which wrong edges do not move. Any
    machine: the steps refuse in words where the data do not allow them, and ``known`` remains.
    """
    try:
        steps = four_step(machine, measurements, T_camera_base_guess=known.T_camera_base)
    except (PkmcalError, np.linalg.LinAlgError):  # too few legs, directions or configurations
        return known
    return min(known, steps, key=lambda state: misfit(machine, measurements, state))


def misfit(machine: Machine, measurements: Measurements, state: State) -> float:
    """Median Mahalanobis distance of the edges from their prediction; infinite where none is."""
    assembled = assemble(machine, measurements, default_gauge(machine))
    distance = norms(assembled.problem, batch_of(machine, assembled, state))
    found = distance[np.isfinite(distance)]
    return float(np.median(found)) if found.size else np.inf
