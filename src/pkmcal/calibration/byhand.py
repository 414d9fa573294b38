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

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.closely import AT_LAST, join, look_closer
from pkmcal.calibration.known import KnownScene, SeenSession
from pkmcal.calibration.recognise import WORKERS, Progress, station_poses
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import dot, inverse, pose_difference
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet, Measurements
from pkmcal.observe import legs
from pkmcal.observe.alone import ALIKE, Alone, find_alone, turn_between
from pkmcal.observe.predict import LegsInCamera, legs_in_camera, tubes_of
from pkmcal.observe.stations import StationView
from pkmcal.observe.surroundings import Landmarks, Neighbour, Surroundings
from pkmcal.observe.tables import distance_tables
from pkmcal.session.load import Session
from pkmcal.session.photographs import label_of
from pkmcal.wording import listed

SURE = 0.05
"""Probability that any photograph of a session is believed to be where it is not; each has an equal
share of it."""
LIKELY = 4
"""Places of a photograph that are asked about again, whatever the picture says to a machine that is
known better: one in a wrong place spoils it."""
FEWEST_LEGS, FEWEST_EDGES = 4, 4
"""Legs of a photograph, if the machine has so many, and edges that tell its place. A pose and a
focal length are seven numbers: each edge tells two, and each leg little more, so of three legs none
contradicts another that was taken for something else."""


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
        if known.edges:
            at = {p.station: p for p in photographs}
            # what too few legs hold the joint estimate moves anywhere
            loose = {k for k, e in known.edges.items() if len(np.unique(e.leg)) < FEWEST_LEGS}
            sure = {k: known.T_camera_base[k] for k in known.edges}
            sure |= {k: found[k].T_camera_base[0] for k in loose & found.keys()}
            with suppress(PkmcalError):  # with all that is observed it is told better why
                known = join(session, at, known, sure, boards, AT_LAST)
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
    room = Surroundings(lambda k: (at[k].images[0], at[k].camera))
    joined = known
    found: dict[int, Alone] = {}
    # with the machine that the first of them tell; later ones change it by little
    looked: dict[int, Alone] = {}
    with ThreadPoolExecutor(WORKERS) as pool:
        alone = partial(_search, session, at, room, joined, {}, {}, {}, {})
        for k, (_, one) in zip(by_hand, pool.map(alone, by_hand), strict=True):
            found[k] = one
            if told is not None:
                told(f"Placing photographs by hand: {len(found)} of {len(by_hand)}", 0.25)
        found |= _on_board(found, boards)
        while True:
            believed = _believed(found, boards, known.T_camera_base)
            sure = {k: believed[k] for k in at if not np.isnan(believed[k]).any()}
            unsure = [k for k in by_hand if k not in sure]
            new = {k: T for k, T in sure.items() if k not in joined.edges}
            if not new:
                break
            if told is not None:
                count = len(by_hand) - len(unsure)
                told(f"Asking again, with {count} of {len(by_hand)} photographs placed", 0.3)
            try:
                joined = join(session, at, joined, new, boards)
            except PkmcalError:
                break  # with all that is observed it is told better why
            placed: dict[int, Neighbour] = {}
            for k in sorted(joined.edges):
                T = joined.T_camera_base[k]
                placed[k] = Neighbour(at[k].camera, T, _legs(session, at[k], joined, T)[0])
            landmarks = room.landmarks(placed)
            again = partial(_search, session, at, room, joined, placed, landmarks, looked, found)
            for k, (seen, one) in zip(unsure, pool.map(again, unsure), strict=True):
                looked[k], found[k] = seen, one
    for k in by_hand:
        if k in joined.edges:
            believed[k] = joined.T_camera_base[k]
    return found, joined._replace(T_camera_base=believed)


def _search(
    session: Session,
    photographs: Mapping[int, legs.Photographs],
    room: Surroundings,
    joined: KnownScene,
    placed: Mapping[int, Neighbour],
    landmarks: Mapping[int, Landmarks],
    looked: Mapping[int, Alone],
    found: Mapping[int, Alone],
    k: int,
) -> tuple[Alone, Alone]:
    """The places that photograph k could show: by the search in it alone, unless it was looked at,
    and those that were likely before, weighed by its legs and by what it shares of the room with
    those that are placed.
    """
    p = photographs[k]
    alone = looked.get(k)
    if alone is None:
        view = StationView(
            joined.machine, p.camera, tubes_of(session.machine), p.configuration, session.joints,
            joined.T_base_platform, distance_tables([p.images[0]]),
        )  # fmt: skip
        alone = find_alone(view, p.images[0])
    others = room.place(k, landmarks)
    if k in found:
        others = np.concatenate([others, found[k].T_camera_base[:LIKELY]])
    if placed:
        axes = _legs(session, p, joined, alone.T_camera_base)
        others = np.concatenate([others, room.about(alone, k, p.camera, axes, placed)])
    closer = look_closer(session, p, joined, alone, others)
    axes = _legs(session, p, joined, closer.T_camera_base)
    return alone, room.weighed(closer, k, p.camera, axes, placed)


def _legs(
    session: Session, photograph: legs.Photographs, joined: KnownScene, T_camera_base: Array
) -> LegsInCamera:
    """Leg axes (H, L, 3) of a photograph taken from places (H, 4, 4), or (1, L, 3) from one."""
    first = photograph.configuration[:1]
    pose, readings = joined.T_base_platform[first], session.joints[first]
    return legs_in_camera(joined.machine, T_camera_base, pose, readings)


def _on_board(found: Mapping[int, Alone], boards: Boards) -> dict[int, Alone]:
    """The places of the photographs that see a board on the base, weighed together: where it stands
    on the base is one unknown, and each of their places tells it.

    A photograph's place is its own where that agrees with the board, which knows the drawing no
    better, and the board's where none does.
    """
    T_camera_board = {
        k: seen.stood.T_camera_board
        for k, seen in boards.stations.items()
        if k in found and seen.stood is not None
    }
    if len(T_camera_board) < 2:
        return {}
    tell = [inverse(T) @ found[k].T_camera_base for k, T in T_camera_board.items()]
    T_board_base = np.concatenate(tell)
    total = np.zeros(len(T_board_base))
    own: dict[int, Array] = {}
    for k, T in T_camera_board.items():
        places, evidence = found[k].T_camera_base, found[k].evidence
        alike = turn_between((T @ T_board_base)[:, None], places) < ALIKE
        worth = np.where(alike, np.maximum(evidence, 0.0), 0.0)
        total += worth.max(axis=1)
        best = np.argmax(worth, axis=1)
        agrees = np.take_along_axis(worth, best[:, None], axis=1) > 0
        own[k] = np.where(agrees[..., None], places[best], T @ T_board_base)
    order = np.argsort(-total, kind="stable")
    near = turn_between(T_board_base[order], T_board_base[order[0]]) < ALIKE
    order = order[~near | (np.arange(len(order)) == 0)]
    return {k: Alone(T[order], total[order], 1.0) for k, T in own.items()}


def _believed(found: dict[int, Alone], boards: Boards, known: Array) -> Array:
    """Poses T_camera_base (S, 4, 4) with those of photographs of whose place there is little
    doubt, and those that a board on the base joins to them; NaN for the others.
    """
    out = known.copy()
    for k, one in found.items():
        if one.doubt * len(found) < SURE:
            out[k] = one.T_camera_base[0]
    seen = [None if np.isnan(T).any() else T for T in out]
    joined = boards.joined(seen)
    return np.stack([np.full((4, 4), np.nan) if T is None else T for T in joined])


def misplaced(
    session: Session, measurements: Measurements, estimate: Estimate, T_camera_base: Array
) -> list[int]:
    """Photographs by hand of which the joint estimate has given up most edges, has too few edges or
    legs to tell their place, or finds the camera looking another way than where it was placed,
    T_camera_base. A board that agrees with the others tells the place of its photograph whatever
    the edges do.
    """
    turn = pose_difference(estimate.state.T_camera_base, T_camera_base)[:, :3]
    astray = np.sqrt(dot(turn, turn)) > ALIKE / 2
    station = measurements.edges.station
    kept = np.bincount(station, estimate.edge_weights, len(session.stations))
    count = np.bincount(station, minlength=len(session.stations))
    poses = measurements.poses.station
    by_board = np.bincount(poses, estimate.pose_weights, len(session.stations)) >= 0.5
    shown = np.zeros((len(session.stations), session.machine.n_legs), dtype=bool)
    used = estimate.edge_weights >= 0.5
    shown[station[used], measurements.edges.leg[used]] = True
    few = shown.sum(axis=1) < min(FEWEST_LEGS, session.machine.n_legs)
    lost = ((2 * kept < count) | (kept < FEWEST_EDGES) | few) & ~by_board
    return [k for k, s in enumerate(session.stations) if s.handheld and (lost[k] or astray[k])]


def without_misplaced(
    seen: SeenSession, wrong: list[int], edges: EdgeSet, estimate: Estimate
) -> SeenSession:
    """What is seen without these photographs, each told, and what is known by an estimate of all.

    edges : from which it was made.
    """
    state = estimate.state
    mine = {p.station: edges.select(edges.station == p.station) for p in seen.photographs}
    known = KnownScene(estimate.machine, state.T_camera_base, state.T_base_platform, mine)
    why = dict.fromkeys(wrong, "too few of its edges agree with the other photographs")
    return _without(seen._replace(known=known), why)


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
    edges = {number[k]: found for k, found in known.edges.items() if k in number}
    return SeenSession(
        left,
        [replace(p, station=number[p.station]) for p in seen.photographs if p.station in number],
        seen.boards.of(np.array(kept, dtype=int)),
        known._replace(T_camera_base=T_camera_base, edges=edges, cost={}),
    )
