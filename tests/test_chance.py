"""Edges that chance offers tell no machine."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pkmcal.calibration import chance
from pkmcal.calibration.chance import MOVED_ASIDE, chance_doubt
from pkmcal.calibration.turns import Turns
from pkmcal.measurements import Observation
from pkmcal.observe.legs import OUT_OF_SIGHT_REASON, measure
from pkmcal.observe.profiles import USUAL_BLUR
from test_observe_drawing import FRONT, machine, poses
from test_observe_measure import taken


def turns_of(photographs, keep=1.0):
    """What a look left, or a share of it; the rest as if it had not been found."""
    state = SimpleNamespace(T_camera_base=FRONT[None], T_base_platform=poses())
    look = measure(photographs, machine(), FRONT, poses())
    count = round(keep * len(look.edges))
    lost = tuple(look.edges.rejection(k, "faint") for k in range(count, len(look.edges)))
    edges = look.edges.select(np.arange(count))
    seen = Observation(
        edges, look.rejected + lost, look.points, look.point_edge, FRONT[None], None, np.ones(1)
    )
    estimate = SimpleNamespace(machine=machine(), state=state, edge_weights=np.ones(count))
    return Turns(seen, None, estimate, None, photographs=[photographs], blur={0: None})


def aside(photographs, px):
    """As if the machine were elsewhere in the picture."""
    parameters = photographs.camera.parameters.copy()
    parameters[2] += px
    return replace(photographs, camera=replace(photographs.camera, parameters=parameters))


def test_few_edges_of_the_right_machine_are_no_chance():
    assert chance_doubt(turns_of(taken(), keep=0.2)) == ()


def test_edges_of_a_machine_that_is_elsewhere_are():
    (why,) = chance_doubt(turns_of(aside(taken(), 2.5 * MOVED_ASIDE)))
    assert "may not be the machine in the photographs" in why
    seen = turns_of(aside(taken(), 2.5 * MOVED_ASIDE)).observation
    hidden = sum(r.reason == OUT_OF_SIGHT_REASON for r in seen.rejected)
    in_sight = len(seen.edges) + len(seen.rejected) - hidden
    assert f"Of {in_sight} edges in sight only {len(seen.edges)} were measured" in why


def test_nothing_is_asked_where_most_were_measured(monkeypatch):
    def asked(*_):
        pytest.fail("asked")

    monkeypatch.setattr(chance, "_count", asked)
    assert chance_doubt(turns_of(taken())) == ()


def test_repeats_count_once():
    """Aside as where the machine is: what was measured is told after repeats were averaged."""
    once = aside(taken(), 2.5 * MOVED_ASIDE)
    twice = once.select(np.repeat(np.arange(len(once.images)), 2))
    turns = turns_of(once)._replace(blur={0: USUAL_BLUR})
    assert chance_doubt(turns._replace(photographs=[twice])) == chance_doubt(turns) != ()


def test_chance_that_offers_more_is_told_in_words(monkeypatch):
    """A chance of a half or more is not "once in 1 times"."""
    few = turns_of(aside(taken(), 2.5 * MOVED_ASIDE))
    counts = iter([9, 8, 10, 9, 9, 8, 10, 9, 9])
    monkeypatch.setattr(chance, "_count", lambda *_: next(counts))
    (why,) = chance_doubt(few)
    assert "chance offers as many as a rule" in why
