"""Chance matches of edges determine no machine."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pkmcal.boards.views import Boards
from pkmcal.calibration import calibrate
from pkmcal.calibration.calibrate import Clock, settle
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.calibration.chance_matches import (
    IMAGE_OFFSET,
    chance_match_reason,
    chance_of_count,
    misplaced_stations,
)
from pkmcal.calibration.localization import read_images
from pkmcal.calibration.refinement import RefinementResult
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import pose, rotation
from pkmcal.judge.against_truth import compare_with_truth
from pkmcal.measurements import Observation, concatenate
from pkmcal.observe.legs import measure
from pkmcal.observe.profiles import PROFILE_OPTIONS
from pkmcal.session.load import load_session
from pkmcal.wording import how_often
from test_observe_measure import taken
from test_observe_rendered_legs import FRONT, machine, poses


def turns_of(images, keep=1.0):
    """Result of a measurement pass with a share of its edges; the others count as not found."""
    state = SimpleNamespace(T_camera_base=FRONT[None], T_base_platform=poses())
    station_edges = measure(images, machine(), FRONT, poses())
    count = round(keep * len(station_edges.edges))
    lost = tuple(
        station_edges.edges.rejection(k, "faint") for k in range(count, len(station_edges.edges))
    )
    edges = station_edges.edges.select(np.arange(count))
    visible = Observation(
        edges,
        station_edges.rejected + lost,
        station_edges.points,
        station_edges.point_edge,
        FRONT[None],
        None,
        np.ones(1),
    )
    estimate = SimpleNamespace(machine=machine(), state=state, edge_weights=np.ones(count))
    return RefinementResult(visible, None, estimate, None, images=[images], blur={})


def displaced(images, px):
    """Edges as if the machine were elsewhere in the image."""
    parameters = images.camera.parameters.copy()
    parameters[2] += px
    return replace(images, camera=replace(images.camera, parameters=parameters))


def test_few_edges_of_the_right_machine_are_no_chance():
    assert chance_match_reason(turns_of(taken(), keep=0.2)) == ()


def test_edges_of_a_machine_that_is_elsewhere_are():
    (why,) = chance_match_reason(turns_of(displaced(taken(), 2.5 * IMAGE_OFFSET)))
    assert "may not be the machine in the images" in why.text
    in_view = turns_of(displaced(taken(), 2.5 * IMAGE_OFFSET)).observation
    hidden = sum(r.code == "edges.out_of_sight" for r in in_view.rejected)
    in_sight = len(in_view.edges) + len(in_view.rejected) - hidden
    assert f"Of {in_sight} edges in sight only {len(in_view.edges)} were measured" in why.text


def test_a_rejected_edge_is_one_edge_in_sight():
    """Whether the estimate rejected it, or one of its repeats was an outlier."""
    turns = turns_of(displaced(taken(), 2.5 * IMAGE_OFFSET))
    (before,) = chance_match_reason(turns)
    edges, in_view = turns.observation.edges, turns.observation
    outlier = edges.rejection(0, "disagrees with all other edges")
    repeats = [edges.rejection(1, f"{k} sigmas away", "repeats.outlier") for k in (7, 8)]
    rejected = (*in_view.rejected, outlier, *repeats)
    weights = np.where(np.arange(len(edges)) == 0, 0.0, 1.0)
    estimate = SimpleNamespace(**{**vars(turns.estimate), "edge_weights": weights})
    (after,) = chance_match_reason(
        turns._replace(observation=replace(in_view, rejected=rejected), estimate=estimate)
    )
    assert after.facts == before.facts


def test_most_edges_of_the_right_machine_are_no_chance():
    assert chance_match_reason(turns_of(taken())) == ()


def test_repeats_count_once():
    """As many matches in shifted images as at the machine; the edges count after repeats were
    averaged.
    """
    once = displaced(taken(), 2.5 * IMAGE_OFFSET)
    twice = once.select(np.repeat(np.arange(len(once.images)), 2))
    turns = turns_of(once)._replace(blur={0: PROFILE_OPTIONS.usual_blur})
    assert chance_match_reason(turns._replace(images=[twice])) == chance_match_reason(turns) != ()


def test_chance_that_offers_more_is_reported_in_words():
    """A chance of a half or more is not "once in 1 times"."""
    counts = np.array([9, 8, 10, 9, 9, 8, 10, 9])
    assert chance_of_count(9, counts) == pytest.approx(0.5)
    assert chance_of_count(20, counts) < 0.01
    assert how_often(chance_of_count(9, counts)) == "as a rule"


def two_stations(second, **values):
    """The turns of two stations, of which the first is right, and their session."""
    one, other = turns_of(taken()), turns_of(second)
    at, in_view = other.observation.edges, other.observation
    in_view = Observation(
        concatenate([one.observation.edges, replace(at, station=at.station + 1)]),
        one.observation.rejected + tuple(replace(r, station=1) for r in in_view.rejected),
        one.observation.points, one.observation.point_edge, np.stack([FRONT, FRONT]), None,
        np.ones(2),
    )  # fmt: skip
    state = SimpleNamespace(T_camera_base=np.stack([FRONT, FRONT]), T_base_platform=poses())
    estimate = SimpleNamespace(
        machine=machine(), state=state, edge_weights=np.ones(len(in_view.edges))
    )
    both = [*one.images, replace(second, station=1)]
    measured = SimpleNamespace(poses=SimpleNamespace(station=np.array(values.pop("boards", []))))
    turns = RefinementResult(in_view, measured, estimate, None, images=both, blur={})
    station = SimpleNamespace(**{"handheld": False, "T_camera_base": None, **values})
    return SimpleNamespace(stations=(station, station)), turns


def test_a_station_that_may_stand_elsewhere_is_reported_with_why():
    session, turns = two_stations(displaced(taken(), 2.5 * IMAGE_OFFSET))
    ((number, why),) = misplaced_stations(session, turns).items()
    assert number == 1
    (measured,) = {int(np.sum(turns.observation.edges.station == 1))}
    assert why.startswith(f"only {measured} of ")
    assert why.endswith("it may stand elsewhere; a pose by hand would decide")
    session, turns = two_stations(displaced(taken(), 2.5 * IMAGE_OFFSET), T_camera_base=FRONT)
    assert misplaced_stations(session, turns)[1].endswith("it may stand elsewhere")


def test_a_station_is_kept_that_shows_the_machine_or_whose_pose_is_determined_otherwise():
    wrong = displaced(taken(), 2.5 * IMAGE_OFFSET)
    assert misplaced_stations(*two_stations(taken())) == {}
    assert misplaced_stations(*two_stations(wrong, boards=[1])) == {}
    assert misplaced_stations(*two_stations(wrong, handheld=True)) == {}


def test_the_only_station_is_not_left_out_but_reported_as_unsure():
    session, turns = two_stations(taken())
    alone = turns_of(displaced(taken(), 2.5 * IMAGE_OFFSET))
    alone = alone._replace(measurements=turns.measurements)
    assert misplaced_stations(session, alone) == {}
    assert chance_match_reason(alone)


@pytest.mark.slow
def test_the_machine_is_identified_by_the_other_stations(demo, monkeypatch):
    """A station that may stand elsewhere is left out with its reason, and the rest identified."""
    item = iter([{1: "it may stand elsewhere"}])
    monkeypatch.setattr(calibrate, "misplaced_stations", lambda *_: next(item, {}))
    calibration = calibrate.calibrate_session(demo.session)
    assert [station.name for station in calibration.session.stations] == ["station1", "station3"]
    assert "station2: left out, for it may stand elsewhere." in calibration.session.warnings
    assert compare_with_truth(calibration, demo.session).calibrated.centre < 1e-3


def test_a_localization_confirmed_by_chance_is_compared_with_mistakes(demo):
    """Readings in the opposite order, and a pose at which edges match by chance."""
    session = load_session(demo.session).of_stations([0])
    reversed_readings = replace(session, joints=session.joints[:, ::-1].copy())
    images = read_images(session)
    station = session.stations[0].T_camera_base
    T_displaced = station @ pose(rotation(np.array([0.0, 0.0, 0.5])), np.array([0.1, 0.05, 0.0]))
    scene = PriorScene.as_drawn(reversed_readings, T_displaced[None])
    case = Case(reversed_readings, images, Boards(), scene)
    with pytest.raises(InputError) as error:
        settle(reversed_readings, case, refine_camera=False, seed=0, clock=Clock())
    assert error.value.code == "readings.numbering_reversed"
