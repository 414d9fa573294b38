"""The machine recognised in a station's photographs from a pose by hand, as `calibrate` begins."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.observe.alone import find_alone
from pkmcal.observe.evidence import StationView
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.stations import SECOND_PLACE_DOUBT, find_station
from pkmcal.observe.tables import distance_tables
from pkmcal.view.overlay import overlay_after_gesture, placed_by_hand
from pkmcal.view.requests import LookRequest
from pkmcal.view.viewed import Viewed
from pkmcal.wording import brief, count

FIT_PHOTOGRAPHS = 16
"""Photographs of a station that take part: a search looks at eight and asks the others, in about a
second; `calibrate` asks up to 64."""
FEWEST_FITTED_TOGETHER = 2
"""Photographs from which some can be asked what the others found."""
LEAST_CHANCE_TOLD = 1e-9
"""Probability below which no digits are told."""


def recognised_overlay(viewed: Viewed, look: LookRequest) -> dict[str, Any]:
    """The pose at which the machine is recognised, from the one given or from anywhere, what it
    lays over, and how sure that is, in words; where it is not recognised, the pose stays.
    """
    station = viewed.station(look.station)
    if "legs" not in station.observe or not len(tubes_of(viewed.session.machine)):
        raise InputError(
            "there are no legs to be recognised at this station",
            where=f"session.yaml, stations.{station.entry}",
            found="observe: board" if "legs" not in station.observe else "legs without tubes",
            next_step="Its place is found from the board when you calibrate",
        )
    start = placed_by_hand(viewed, look).T_camera_base
    view = _view(viewed, look.station)
    many = len(view.configuration) >= FEWEST_FITTED_TOGETHER
    if many:
        found, sure, said = _together(view, None if look.anywhere else start)
    else:
        found, sure, said = _alone(view, viewed.image(look.station, look.photograph))
    pose = found if sure else start
    plain = {"pose": tuple(map(tuple, pose.tolist())), "gesture": None, "pins": ()}
    return {
        **overlay_after_gesture(viewed, look.model_copy(update=plain)),
        "recognised": sure,
        "said": said,
    }


def _together(view: StationView, start: Array | None) -> tuple[Array, bool, str]:
    """From several photographs."""
    found = find_station(view, start, np.random.default_rng(0))
    shots = count(len(view.configuration), "photograph")
    if found.good:
        chance = (
            f"{found.by_chance:.0e}"
            if found.by_chance > LEAST_CHANCE_TOLD
            else f"less than {LEAST_CHANCE_TOLD:.0e}"
        )
        said = f"Recognised in {shots}: as good a fit by chance has probability {chance}."
    elif found.second >= SECOND_PLACE_DOUBT:
        said = (
            f"Not sure: from another place the machine fits {shots} nearly as well. Bring it to"
            " where it is, joint by joint."
        )
    else:
        said = (
            f"Not recognised in {shots} about this pose. Bring two or three joints to their places"
            " and try again, or look whether drawing, readings and photographs belong together."
        )
    return found.T_camera_base, found.good, said


def _alone(view: StationView, image: Integers) -> tuple[Array, bool, str]:
    """From one photograph, which is searched from everywhere."""
    found = find_alone(view, image)
    best = found.T_camera_base[0]
    if found.doubt < SECOND_PLACE_DOUBT:
        return best, True, "Placed: from no other place does the machine fit as well."
    why = f"with probability {brief(found.doubt)} another place is the right one"
    return best, False, f"Not sure: {why}. Bring it to where it is, joint by joint."


def _view(viewed: Viewed, s: int) -> StationView:
    """What the search looks at; kept, for one fits again and again."""
    kept: dict[int, StationView] = viewed.views
    if s not in kept:
        session, station = viewed.session, viewed.station(s)
        rows = np.array([photo.configuration for photo in station.photographs])
        few = np.unique(np.linspace(0, len(rows) - 1, min(FIT_PHOTOGRAPHS, len(rows))).astype(int))
        tables = distance_tables([viewed.image(s, int(k)) for k in few])
        kept[s] = StationView(
            session.machine,
            station.camera,
            rows[few],
            session.joints,
            viewed.poses,
            tables,
        )
    return kept[s]
