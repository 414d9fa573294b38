"""Whether the edges that were measured are the machine's, or what chance offers anywhere.

Some edge lies within reach of any place in a picture. A machine that is not the one before the
camera, recognised all the same, is given a tenth of its edges by that, and the joint estimate makes
them agree with it, in large deviations. So where few of the edges that should be seen were
measured, they are looked for again with the whole picture moved aside, in several directions: there
no leg is where it should be, and what is found is chance's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.turns import FEW_MEASURED, Turns
from pkmcal.observe import legs
from pkmcal.observe.repeats import combined
from pkmcal.observe.stations import BY_CHANCE
from pkmcal.wording import how_often

MOVED_ASIDE = 2 * legs.LEG_SEARCH_REACH
"""Pixels by which the picture is moved: further than legs were looked for."""
DIRECTIONS_MOVED = 8
"""Directions in which it is, evenly: the chance that is told is that of one more draw."""


def chance_doubt(turns: Turns) -> tuple[str, ...]:
    """Why the result is not to be used, if chance may have offered the edges by which it is told;
    asked only where less than a third of the edges in sight were measured.
    """
    seen = turns.observation
    measured = int(np.sum(~seen.edges.coarse))
    missed = sum(r.side >= 0 and r.reason != legs.OUT_OF_SIGHT_REASON for r in seen.rejected)
    given_up = int(np.sum(turns.estimate.edge_weights < 0.5))  # which are among both
    in_sight = len(seen.edges) + missed - given_up
    if not turns.photographs or measured >= FEW_MEASURED * in_sight:
        return ()
    angle = 2 * np.pi * np.arange(DIRECTIONS_MOVED) / DIRECTIONS_MOVED
    aside = MOVED_ASIDE * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    counts = np.array([_count(turns, away) for away in aside])
    mean, spread = float(counts.mean()), float(counts.std(ddof=1))
    apart = (_count(turns, np.zeros(2)) - mean) / max(spread * np.sqrt(1 + 1 / len(counts)), 1.0)
    from scipy.special import stdtr

    chance = float(stdtr(len(counts) - 1, -apart))
    if chance < BY_CHANCE:
        return ()
    return (
        f"Of {in_sight} edges in sight only {measured} were measured where the machine has"
        f" them, and about {mean:.0f} are where nothing of it is, {MOVED_ASIDE:.0f} px aside:"
        f" chance offers as many {how_often(chance)}. So this may not be the machine in"
        " the photographs, or hardly anything of it shows: check the drawing, the order of its"
        " legs, and the photographs' names; `pkmcal check` shows the drawing laid over them.",
    )


def _count(turns: Turns, aside: Array) -> int:
    """Edges measured with the pictures moved ``aside`` (2,), in the pixels that edges are in."""
    state, total = turns.estimate.state, 0
    for p in turns.photographs:
        parameters = p.camera.parameters.copy()
        parameters[2:4] += p.binning * aside  # the centre, always third and fourth
        look = legs.measure(
            replace(p, camera=replace(p.camera, parameters=parameters)),
            turns.estimate.machine,
            state.T_camera_base[p.station],
            state.T_base_platform[p.configuration],
            turns.blur.get(p.station),
        )
        total += len(combined(look).edges)  # as those that were measured
    return total
