"""Where all stations stand: those on a tripod as recognised, photographs by hand one by one.

Each photograph by hand is searched by itself (:mod:`pkmcal.observe.alone`), for nothing but the
machine joins it to others, and from the places that it could show it is looked at more closely
(:mod:`pkmcal.calibration.closely`). A board on the base places those that see it beside one that is
placed. Those that are sure tell the machine better than its drawing, and with that the others are
asked again, until none is added. What stays unsure is left out and told, for one photograph in a
wrong place spoils the rest; and where the joint estimate gives up most of a photograph's edges, it
was in a wrong place.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.closely import join, look_closer
from pkmcal.calibration.known import KnownScene, SeenSession
from pkmcal.calibration.recognise import WORKERS, Progress, station_poses
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import dot, pose_difference
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import Measurements
from pkmcal.observe import legs
from pkmcal.observe.alone import ALIKE, Alone, find_alone
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.stations import StationView
from pkmcal.observe.tables import distance_tables
from pkmcal.session.load import Session
from pkmcal.session.photographs import label_of
from pkmcal.wording import listed

SURE = 1e-2
"""Probability that a photograph shows the machine from another place, below which it is believed:
of a hundred one may be wrong, and the joint estimate finds that one out."""
FEWEST_EDGES = 4
"""Edges of a photograph that tell its place: two numbers each, of which a pose and a focal length
take seven."""


def place(
    session: Session,
    photographs: list[legs.Photographs],
    boards: Boards,
    rng: np.random.Generator,
    told: Progress | None = None,
) -> SeenSession:
    """Where all stations stand; photographs by hand that are not found are left out and told.

    photographs : of all stations that observe legs. told : called with the step in words and the
    share done. Raises `InputError`, or `ResultError`, where nothing tells where a station stands
    that is not by hand, and where no photograph by hand is placed.
    """
    fixed = [p for p in photographs if not session.stations[p.station].handheld]
    stations = station_poses(session, fixed, boards, rng, told)
    known = KnownScene.as_drawn(session.machine, stations, session.joints)
    if len(fixed) < len(photographs):
        found, known = search_by_hand(session, photographs, boards, known, told)
        nowhere = {k for k in found if np.isnan(known.T_camera_base[k]).any()}
        lost = {k: why_lost(found[k]) for k in found if k in nowhere}
        return _without(SeenSession(session, photographs, boards, known), lost)
    return SeenSession(session, photographs, boards, known)


def search_by_hand(
    session: Session,
    photographs: list[legs.Photographs],
    boards: Boards,
    known: KnownScene,
    told: Progress | None = None,
) -> tuple[dict[int, Alone], KnownScene]:
    """The places that each photograph by hand could show, by its station's number; and what is
    known with those that are believed, T_camera_base NaN for the others.

    photographs : of all stations that observe legs. known : by the drawing, T_camera_base of the
    stations that are placed already, NaN for the others. told : called with the step in words and
    the share done.
    """
    at = {p.station: p for p in photographs}
    by_hand = [k for k in at if session.stations[k].handheld]
    tubes = tubes_of(session.machine)

    def search(joined: KnownScene, k: int) -> Alone:
        p, image = at[k], at[k].images[0]
        view = StationView(
            joined.machine, p.camera, tubes, p.configuration, session.joints,
            joined.T_base_platform, distance_tables([image]),
        )  # fmt: skip
        return look_closer(session, p, joined, find_alone(view, image))

    joined = known
    found: dict[int, Alone] = {}
    with ThreadPoolExecutor(WORKERS) as pool:
        for k, one in zip(by_hand, pool.map(partial(search, joined), by_hand), strict=True):
            found[k] = one
            if told is not None:
                told(f"Placing photographs by hand: {len(found)} of {len(by_hand)}", 0.25)
        while True:
            believed = _believed(found, boards, known.T_camera_base)
            sure = {k: believed[k] for k in at if not np.isnan(believed[k]).any()}
            unsure = [k for k in by_hand if k not in sure]
            new = {k: T for k, T in sure.items() if k not in joined.edges}
            if not new:
                break
            if told is not None:
                placed = len(by_hand) - len(unsure)
                told(f"Asking again, with {placed} of {len(by_hand)} photographs placed", 0.3)
            try:
                joined = join(session, at, joined, new)
            except PkmcalError:
                break  # with all that is observed it is told better why
            found |= zip(unsure, pool.map(partial(search, joined), unsure), strict=True)
    for k in by_hand:
        if k in joined.edges:
            believed[k] = joined.T_camera_base[k]
    return found, joined._replace(T_camera_base=believed)


def _believed(found: dict[int, Alone], boards: Boards, known: Array) -> Array:
    """Poses T_camera_base (S, 4, 4) with those of photographs of whose place there is little
    doubt, and those that a board on the base joins to them; NaN for the others.
    """
    out = known.copy()
    for k, one in found.items():
        if one.doubt < SURE:
            out[k] = one.T_camera_base[0]
    seen = [None if np.isnan(T).any() else T for T in out]
    joined = boards.joined(seen)
    return np.stack([np.full((4, 4), np.nan) if T is None else T for T in joined])


def misplaced(
    session: Session, measurements: Measurements, estimate: Estimate, T_camera_base: Array
) -> list[int]:
    """Photographs by hand of which the joint estimate has given up most edges, has too few to tell
    their place, or finds the camera looking another way than where it was placed, T_camera_base.
    """
    turn = pose_difference(estimate.state.T_camera_base, T_camera_base)[:, :3]
    astray = np.sqrt(dot(turn, turn)) > ALIKE / 2
    station = measurements.edges.station
    kept = np.bincount(station, estimate.edge_weights, len(session.stations))
    count = np.bincount(station, minlength=len(session.stations))
    lost = (2 * kept < count) | (kept < FEWEST_EDGES)
    return [k for k, s in enumerate(session.stations) if s.handheld and (lost[k] or astray[k])]


def without_misplaced(seen: SeenSession, wrong: list[int]) -> SeenSession:
    """What is seen without these photographs, each told."""
    why = dict.fromkeys(wrong, "too few of its edges agree with the other photographs")
    return _without(seen, why)


def why_lost(found: Alone) -> str:
    """Why a photograph could not be placed, in words."""
    return (
        "its edges fit the legs nearly as well from another place, which with probability"
        f" {found.doubt:.2f} is the right one"
    )


def _without(seen: SeenSession, lost: dict[int, str]) -> SeenSession:
    """What is seen without the photographs that are lost, each told, the other stations numbered
    anew; an error where none is left.
    """
    session, known = seen.session, seen.known
    by_hand = [k for k, station in enumerate(session.stations) if station.handheld]

    def label(k: int) -> str:
        return label_of(session.folder, session.stations[k].photographs[0].path)

    if len(lost) == len(by_hand):
        raise InputError(
            "the machine is recognised in none of the photographs by hand",
            where=f"session.yaml, stations.{session.stations[by_hand[0]].entry}",
            found=f"{label(by_hand[0])}: {lost[by_hand[0]]}",
            expected="one place for each where its legs lie on edges of the picture far oftener"
            " than elsewhere",
            next_step="Check that these photographs show this machine's legs, large and sharp, that"
            " each bears the name of its configuration, and that the drawing is this machine's",
        )
    warnings = tuple(f"{label(k)}: left out, for {why}." for k, why in lost.items())
    kept = [k for k in range(len(session.stations)) if k not in lost]
    number = {k: new for new, k in enumerate(kept)}
    trackers = range(len(session.stations), len(known.T_camera_base))
    left = session.of_stations(kept, warnings)
    rows = {photo.configuration for s in left.stations for photo in s.photographs}
    if len(rows) < 2:
        names = [session.configurations[k] for k in sorted(rows)]
        raise InputError(
            "the photographs that are recognised show one configuration only",
            where=f"session.yaml, stations.{session.stations[by_hand[0]].entry}",
            found=f"{listed(names)}; {warnings[0]}" if warnings else listed(names),
            expected="two at least",
            next_step="Take photographs in which all legs are large and before a plain background",
        )
    T_camera_base = known.T_camera_base[[*kept, *trackers]]
    return SeenSession(
        left,
        [replace(p, station=number[p.station]) for p in seen.photographs if p.station in number],
        seen.boards.of(np.array(kept, dtype=int)),
        KnownScene(known.machine, T_camera_base, known.T_base_platform),
    )
