"""Where a photograph by hand was taken from, asked of the joint estimate.

A search in the picture alone knows the machine by its drawing, whose errors of millimetres are
pixels: a machine of equal parts then fits nearly as well when it is turned by one of them. Here the
photograph is measured from each of the places that it could show, and the machine is estimated with
it there. What the drawing has wrong is explained by that, and paid for by the drawing's tolerances;
what photographs that are placed already know of the machine is paid for as well. How well the
machine, so changed, lies on the picture (the evidence of :mod:`pkmcal.observe.stations`) less what
was paid is the log likelihood of the place. Between places from which the machine lies on the same
legs, turned onto itself, half an edge counts as one measurement, as it does in a station's
photographs; against other places half a leg, since what chance puts under a leg in a picture full
of edges, it puts under all of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.boards.views import Boards
from pkmcal.calibration.gather import measurements_of
from pkmcal.calibration.known import KnownScene
from pkmcal.errors import PkmcalError
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate, State
from pkmcal.identify.start import start_state
from pkmcal.measurements import concatenate
from pkmcal.observe import legs
from pkmcal.observe.alone import ALIKE, FINEST, Alone, distinct, turn_between, turned_about
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.stations import StationView, grain, settle
from pkmcal.observe.tables import distance_tables
from pkmcal.session.load import Session

CLOSER, BEHIND = 8, 12.0
"""Most places of a photograph that are asked about, and by how many measurements of the search one
may be behind the best: what is further behind has odds of one in a hundred thousand."""
FIRST: tuple[float | None, ...] = (legs.REACH, legs.AGAIN, None, None)
LATER: tuple[float | None, ...] = (legs.REACH, None)
AT_LAST: tuple[float | None, ...] = (legs.AGAIN, None)
"""Pixels within which legs are looked for, one look after the other; None: edges are measured. The
drawing is off by pixels, a machine that photographs have told is not. When all have told it, the
first of them are where it says."""
NEAR = legs.SEARCH_SIGMA
"""Pixels (of the finest tables) within which silhouettes scatter about the picture's edges: a whole
leg is found to no less, and what is wrong of the drawing is explained by then. Chance offers legs
that lie near something; it does not offer legs that lie on it."""
GIVEN_UP = 9.0
"""What an edge costs at least that the estimate gives up: three standard deviations."""


def join(
    session: Session,
    photographs: Mapping[int, legs.Photographs],
    known: KnownScene,
    places: Mapping[int, Array],
    boards: Boards,
    looks: tuple[float | None, ...] | None = None,
) -> KnownScene:
    """What is known together with photographs at places T_camera_base (4, 4).

    photographs : by station. boards : what they show of a board. looks : as FIRST, which they are
    where nothing but the drawing is known, and LATER elsewhere. Raises a `PkmcalError` where there
    is nothing to be estimated.
    """
    at, stations = known.T_camera_base.copy(), sorted({*known.edges, *places})
    for k, T in places.items():
        at[k] = T
    only = replace(session.of_stations(stations), trackers=())
    shown = boards.of(np.array(stations, dtype=int))
    edges = dict(known.edges)
    state: State | None = None
    for reach in looks or (LATER if edges else FIRST):
        for k in places:
            p = photographs[k]
            seen = known.machine, at[k], known.T_base_platform[p.configuration]
            look = legs.measure(p, *seen) if reach is None else legs.search(p, *seen, reach)
            edges[k] = look.edges
        numbered = [
            replace(edges[k], station=np.full(len(edges[k]), n)) for n, k in enumerate(stations)
        ]
        measurements = measurements_of(only, shown, concatenate(numbered))
        start = state or start_state(known.machine, measurements, at[stations])
        estimate = bundle(session.machine, measurements, start)
        state = estimate.state
        at = at.copy()
        at[stations] = state.T_camera_base
        known = KnownScene(
            estimate.machine, at, state.T_base_platform, edges,
            _costs(estimate, measurements.edges.station, stations),
            (estimate.statistics.chi2_drawing + estimate.statistics.chi2_joints) / 2,
        )  # fmt: skip
    return known


def _costs(estimate: Estimate, station: Integers, stations: Sequence[int]) -> dict[int, float]:
    """Half the squares of each station's edges; one that is given up costs GIVEN_UP at least."""
    weight = estimate.edge_weights
    square = estimate.edge_trust * np.sum(estimate.edge_residuals**2, axis=-1)
    cost = (weight * square + (1 - weight) * GIVEN_UP) / 2
    sums = np.bincount(station, cost, len(stations)).tolist()
    return dict(zip(stations, sums, strict=True))


def look_closer(
    session: Session, photograph: legs.Photographs, before: KnownScene, found: Alone, others: Array
) -> Alone:
    """The places of one photograph, weighed with what is known of the machine, the likeliest first;
    evidence is then a log likelihood against chance.

    others : (n, 4, 4) places that are asked about beside those found in the picture.
    """
    p = photograph.decoded()
    one = np.zeros(1, dtype=int)
    view = StationView(
        session.machine, p.camera, tubes_of(session.machine), p.configuration, session.joints,
        before.T_base_platform, distance_tables(p.images, *FINEST),
    )  # fmt: skip
    near = found.evidence > found.evidence[0] - BEHIND * found.unit
    weighed: list[tuple[float, float]] = []  # evidence and what was paid
    places: list[Array] = []

    def weigh(known: KnownScene, T: Array) -> None:
        seen = replace(view, machine=known.machine, all_poses=known.T_base_platform)
        settled, evidence = settle(seen, T[None], one, 16, 6, NEAR)
        weighed.append((float(evidence[0]), known.paid(but=p.station) - before.paid(but=p.station)))
        places.append(settled[0])

    for T in (*found.T_camera_base[near][:CLOSER], *others):
        weigh(before, T)  # the machine as it is known; where it fits better changed, that is taken
        try:
            # without boards: what a place is asked is how the legs look from there
            known = join(session, {p.station: p}, before, {p.station: T}, Boards())
        except PkmcalError:
            continue  # too few legs are where they should be
        weigh(known, known.T_camera_base[p.station])
    at, (evidence, paid) = np.stack(places), np.array(weighed).T
    edge = grain(view, at[np.argmax(evidence)])
    by_edges, by_legs = evidence / edge - paid, evidence / found.unit - paid
    first = at[np.argmax(by_edges)]
    turned = turn_between(at[:, None], turned_about(view, first[None])).min(axis=1, initial=np.inf)
    here = turn_between(at, first) < ALIKE
    same = here | (turned < ALIKE)
    worth = np.where(same, by_edges - by_edges.max() + by_legs[here].max(), by_legs)
    order = np.argsort(-worth, kind="stable")
    order = order[distinct(view, at[order])]
    return Alone(at[order], worth[order], 1.0)
