"""Where a photograph by hand was taken from, asked of the joint estimate.

A search in the picture alone knows the machine by its drawing, whose errors of millimetres are
pixels: a machine of equal parts then fits nearly as well when it is turned by one of them. Here the
silhouettes are looked for from each of the places that a photograph could show, and the machine is
estimated with it there, in turns. What the drawing has wrong is explained by that, and paid for by
the drawing's tolerances; where photographs that are placed already know the machine, by what they
know of it. How well the machine, so changed, lies on the picture (the evidence of
:mod:`pkmcal.observe.evidence`) less what was paid is the log likelihood of the place. Between
places from which the machine lies on the same legs, turned onto itself, half an edge counts as one
measurement, as it does in a station's photographs; against other places half a leg, since what
chance puts under a leg in a picture full of edges, it puts under all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.gather import measurements_of
from pkmcal.calibration.known import KnownScene
from pkmcal.errors import PkmcalError
from pkmcal.geometry.rigid import angle_between
from pkmcal.identify.bundle import bundle, machine_told
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.start import start_state
from pkmcal.measurements import EdgeSet, Measurements, of_stations
from pkmcal.observe import legs
from pkmcal.observe.alone import (
    SAME_PLACE_TURN,
    Alone,
    distinct,
    finest_view,
    likeliest_near,
    turned_about,
)
from pkmcal.observe.evidence import StationView, distinct_silhouettes, grain, settle_by_evidence
from pkmcal.observe.photographs import Photographs
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.session.load import Session

PLACES_LOOKED_AT_CLOSER, MOST_BEHIND_BEST = 8, 12.0
"""Most places of a photograph that are asked about, and by how many measurements of the search one
may be behind the best: what is further behind has odds of one in a hundred thousand."""
PLACES_LOOKED_ABOUT = 4
"""Places about which likelier ones are looked for, once others have told the machine."""
LOOKS_BY_DRAWING, LOOKS_BY_TOLD_MACHINE = 4, 2
"""Looks at silhouettes, each from the estimate before: the drawing is off by pixels, a machine that
photographs have told is not."""
SILHOUETTE_SCATTER = legs.SEARCH_SIGMA
"""Pixels (of the finest tables) within which silhouettes scatter about the picture's edges: a whole
leg is found to no less, and what is wrong of the drawing is explained by then. Chance offers legs
that lie near something; it does not offer legs that lie on it."""

ViewOf = Callable[[int, KnownScene], StationView]
"""The view of a station's one photograph with what is known."""


def join(
    session: Session,
    photographs: Mapping[int, Photographs],
    known: KnownScene,
    places: Mapping[int, Array],
    boards: Boards,
) -> KnownScene:
    """What is known together with photographs at places T_camera_base (4, 4): those that were
    placed before are looked at again as well, for what the machine was taken for then, their edges
    were taken for.

    photographs : by station. boards : what they show of a board. Raises a `PkmcalError` where there
    is nothing to be estimated.
    """

    def view(k: int, known: KnownScene) -> StationView:
        return finest_view(known.machine, photographs[k], session.joints, known.T_base_platform)

    looks = LOOKS_BY_TOLD_MACHINE if known.edges else LOOKS_BY_DRAWING
    every = {k: known.T_camera_base[k] for k in known.edges} | dict(places)
    near = {k: likeliest_near(view(k, known), T, SILHOUETTE_SCATTER)[0] for k, T in every.items()}
    found = known._replace(told=None)
    while True:
        last = _looked(session, found, near, boards, view)
        # how silhouettes scatter in these photographs, their residuals tell, more or less than each
        statistics = last.estimate.statistics
        freedom = statistics.dof_edges
        share = statistics.chi2_edges / freedom if freedom > LEAST_NOISE_FREEDOM else 1.0
        found = last.known._replace(scatter=found.scatter * float(np.sqrt(share)))
        near = {k: found.T_camera_base[k] for k in near}
        looks -= 1
        if not looks:
            return found._replace(told=machine_told(last.measurements, last.estimate))


def ask(
    session: Session, known: KnownScene, station: int, T_camera_base: Array, view: StationView
) -> tuple[KnownScene, float]:
    """What one photograph would make of what is known, if it were taken from a place (4, 4); and
    what is paid for that, half the squares by which the machine and the readings are moved.

    Those that are placed say what they know of the machine once and for all, so a question costs
    the same however many they are. Boards are left out: what a place is asked is how the legs look
    from there. view : of the photograph. Raises a `PkmcalError` where too few legs are where they
    should be.
    """

    def changed(_: int, now: KnownScene) -> StationView:
        return replace(view, machine=now.machine, all_poses=now.T_base_platform)

    paid = 0.0
    for _ in range(LOOKS_BY_TOLD_MACHINE if known.edges else LOOKS_BY_DRAWING):
        last = _looked(session, known, {station: T_camera_base}, Boards(), changed)
        known, statistics = last.known, last.estimate.statistics
        T_camera_base = known.T_camera_base[station]
        paid = (statistics.chi2_drawing + statistics.chi2_joints) / 2
    return known, paid


class _Look(NamedTuple):
    """What is known after a look, and the estimate that says so."""

    known: KnownScene
    measurements: Measurements
    estimate: Estimate


def _looked(
    session: Session,
    known: KnownScene,
    places: Mapping[int, Array],
    boards: Boards,
    view: ViewOf,
) -> _Look:
    """What is known once photographs were looked at from places, and nothing of others but what
    they told of the machine.
    """
    stations = sorted(places)

    def look(k: int) -> EdgeSet:
        return silhouette_edges(view(k, known), places[k], k).edges.scaled(known.scatter)

    with ThreadPoolExecutor(THREADS) as pool:
        edges = dict(zip(stations, pool.map(look, stations), strict=True))
    only = replace(session.of_stations(stations), trackers=(), links=())
    shown = boards.of(np.array(stations, dtype=int))
    numbered = of_stations({n: edges[k] for n, k in enumerate(stations)})
    measurements = measurements_of(only, shown, numbered)
    start = start_state(known.machine, measurements, np.stack([places[k] for k in stations]))
    estimate = bundle(session.machine, measurements, start, told=known.told)
    at = known.T_camera_base.copy()
    at[stations] = estimate.state.T_camera_base
    poses = estimate.state.T_base_platform
    now = known._replace(
        machine=estimate.machine, T_camera_base=at, T_base_platform=poses, edges=edges
    )
    return _Look(now, measurements, estimate)


class AskedPlaces(NamedTuple):
    """What is known of places (n, 4, 4) of one photograph: the evidence (n,) that it shows the
    machine from there, and what was paid (n,) for the machine. failures : why further places could
    not be tested.
    """

    T_camera_base: Array
    evidence: Array
    paid: Array
    failures: tuple[str, ...] = ()

    @classmethod
    def nothing(cls) -> AskedPlaces:
        return cls(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))


def look_closer(
    session: Session,
    photograph: Photographs,
    before: KnownScene,
    found: Alone,
    others: Array,
    asked: AskedPlaces | None = None,
) -> tuple[Alone, AskedPlaces]:
    """The places of one photograph, weighed with what is known of the machine, the likeliest first;
    evidence is then a log likelihood against chance. And what was found out for that.

    others : (n, 4, 4) places that are asked about beside those found in the picture. asked : what
    was found out already with the same machine; nothing is asked about one of its places again.
    """
    p = photograph.decoded()
    one = np.zeros(1, dtype=int)
    view = finest_view(before.machine, p, session.joints, before.T_base_platform)
    near = found.evidence > found.evidence[0] - MOST_BEHIND_BEST * found.unit
    places = np.concatenate([found.T_camera_base[near][:PLACES_LOOKED_AT_CLOSER], others])
    # the machine as it is known; where it fits better changed, that is taken
    settled, evidence = settle_by_evidence(view, places, one, 16, 6, SILHOUETTE_SCATTER)
    if before.edges:  # what is known of the machine changes little: look about the likeliest places
        for k in np.argsort(-evidence, kind="stable")[:PLACES_LOOKED_ABOUT]:
            settled[k], evidence[k] = likeliest_near(view, settled[k], SILHOUETTE_SCATTER)
        places = settled
    seen = AskedPlaces.nothing() if asked is None else asked
    order = np.argsort(-evidence, kind="stable")
    both = np.concatenate([seen.T_camera_base, settled[order]])
    count = len(seen.T_camera_base)
    order = order[[k - count for k in distinct_silhouettes(view, both, one) if k >= count]]
    at, fits = [*seen.T_camera_base, *settled[order]], [*seen.evidence, *evidence[order]]
    paid = [*seen.paid, *np.zeros(len(order))]
    failures = [*seen.failures]
    for number, T in enumerate(places[order], start=count):
        best = max(fit / found.unit - cost for fit, cost in zip(fits, paid, strict=True))
        if before.edges and fits[number] / found.unit < best - MOST_BEHIND_BEST:
            break  # what is known of the machine already does not change by so much
        try:
            known, cost = ask(session, before, p.station, T, view)
        except PkmcalError as error:  # such as too few legs where they should be from there
            failures.append(str(error))
            continue
        changed = replace(view, machine=known.machine, all_poses=known.T_base_platform)
        there, fit = settle_by_evidence(
            changed, known.T_camera_base[[p.station]], one, 16, 6, SILHOUETTE_SCATTER
        )
        at, fits, paid = [*at, there[0]], [*fits, float(fit[0])], [*paid, cost]
    seen = AskedPlaces(np.stack(at), np.array(fits), np.array(paid), tuple(failures))
    return _weighed(view, seen, found.unit), seen


def _weighed(view: StationView, asked: AskedPlaces, unit: float) -> Alone:
    """Places by what was found out of them, the likeliest first."""
    at, evidence, paid, _ = asked
    edge = grain(view, at[np.argmax(evidence)])
    by_edges, by_legs = evidence / edge - paid, evidence / unit - paid
    first = at[np.argmax(by_edges)]
    turned = angle_between(at[:, None], turned_about(view, first[None])).min(axis=1, initial=np.inf)
    here = angle_between(at, first) < SAME_PLACE_TURN
    same = here | (turned < SAME_PLACE_TURN)
    worth = np.where(same, by_edges - by_edges.max() + by_legs[here].max(), by_legs)
    order = np.argsort(-worth, kind="stable")
    order = order[distinct(view, at[order])]
    return Alone(at[order], worth[order], 1.0)
