"""Where a photograph by hand was taken from, asked of the joint estimate.

A search in the picture alone knows the machine by its drawing, whose errors of millimetres are
pixels: a machine of equal parts then fits nearly as well when it is turned by one of them. Here the
photograph is measured from each of the places that it could show, and the machine is estimated with
it there. What the drawing has wrong is explained by that, and paid for by the drawing's tolerances;
where photographs that are placed already know the machine, by what they know of it. How well the
machine, so changed, lies on the picture (the evidence of :mod:`pkmcal.observe.evidence`) less what
was paid is the log likelihood of the place. Between places from which the machine lies on the same
legs, turned onto itself, half an edge counts as one measurement, as it does in a station's
photographs; against other places half a leg, since what chance puts under a leg in a picture full
of edges, it puts under all of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.gather import measurements_of
from pkmcal.calibration.known import KnownScene
from pkmcal.errors import PkmcalError
from pkmcal.geometry.rigid import angle_between
from pkmcal.identify.bundle import bundle, machine_told
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.start import start_state
from pkmcal.measurements import EdgeSet, Measurements, of_stations
from pkmcal.observe import legs
from pkmcal.observe.alone import FINEST_TABLES, SAME_PLACE_TURN, Alone, distinct, turned_about
from pkmcal.observe.evidence import StationView, distinct_silhouettes, grain, settle_by_evidence
from pkmcal.observe.tables import distance_tables
from pkmcal.session.load import Session

PLACES_LOOKED_AT_CLOSER, MOST_BEHIND_BEST = 8, 12.0
"""Most places of a photograph that are asked about, and by how many measurements of the search one
may be behind the best: what is further behind has odds of one in a hundred thousand."""
LOOKS_BY_DRAWING: tuple[float | None, ...] = (
    legs.LEG_SEARCH_REACH,
    legs.REPEATED_SEARCH_REACH,
    None,
    None,
)
LOOKS_BY_TOLD_MACHINE: tuple[float | None, ...] = (legs.LEG_SEARCH_REACH, None)
AT_LAST: tuple[float | None, ...] = (legs.REPEATED_SEARCH_REACH, None)
"""Pixels within which legs are looked for, one look after the other; None: edges are measured. The
drawing is off by pixels, a machine that photographs have told is not. AT_LAST follows where all are
measured already: they are where all together say."""
SILHOUETTE_SCATTER = legs.SEARCH_SIGMA
"""Pixels (of the finest tables) within which silhouettes scatter about the picture's edges: a whole
leg is found to no less, and what is wrong of the drawing is explained by then. Chance offers legs
that lie near something; it does not offer legs that lie on it."""


def join(
    session: Session,
    photographs: Mapping[int, legs.Photographs],
    known: KnownScene,
    places: Mapping[int, Array],
    boards: Boards,
    measured: Mapping[int, EdgeSet] = MappingProxyType({}),
) -> KnownScene:
    """What is known together with photographs at places T_camera_base (4, 4).

    photographs : by station. boards : what they show of a board. measured : what was measured
    already in some of them, from where they are; with that they are joined first, and looked at
    again from where all put them. Raises a `PkmcalError` where there is nothing to be estimated.
    """
    looks = (
        (legs.LEG_SEARCH_REACH, *AT_LAST)
        if measured
        else LOOKS_BY_TOLD_MACHINE
        if known.edges
        else LOOKS_BY_DRAWING
    )
    last = _looked(session, photographs, known, places, boards, looks, measured)
    return last.known._replace(told=machine_told(last.measurements, last.estimate))


def ask(
    session: Session, photograph: legs.Photographs, known: KnownScene, T_camera_base: Array
) -> tuple[KnownScene, float]:
    """What one photograph would make of what is known, if it were taken from a place (4, 4); and
    what is paid for that, half the squares by which the machine and the readings are moved.

    Those that are placed say what they know of the machine once and for all, so a question costs
    the same however many they are. Boards are left out: what a place is asked is how the legs look
    from there. Raises a `PkmcalError` where too few legs are where they should be.
    """
    k, looks = photograph.station, LOOKS_BY_TOLD_MACHINE if known.edges else LOOKS_BY_DRAWING
    alone, places = known._replace(edges={}), {k: T_camera_base}
    last = _looked(session, {k: photograph}, alone, places, Boards(), looks)
    squares = last.estimate.statistics.chi2_drawing + last.estimate.statistics.chi2_joints
    return last.known, squares / 2


class _Look(NamedTuple):
    """What is known after a look, and the estimate that says so."""

    known: KnownScene
    measurements: Measurements
    estimate: Estimate


def _looked(
    session: Session,
    photographs: Mapping[int, legs.Photographs],
    known: KnownScene,
    places: Mapping[int, Array],
    boards: Boards,
    looks: tuple[float | None, ...],
    measured: Mapping[int, EdgeSet] = MappingProxyType({}),
) -> _Look:
    """What is known once photographs were looked at from places, each look from the estimate
    before, and the last of these. What was measured in others takes part; without any, what they
    told of the machine. measured : in place of the first look.
    """
    stations = sorted({*known.edges, *places})
    told = None if known.edges else known.told
    only = replace(session.of_stations(stations), trackers=())
    shown = boards.of(np.array(stations, dtype=int))
    at, edges = known.T_camera_base.copy(), dict(known.edges)
    for k, T in places.items():
        at[k] = T
    found: list[_Look] = []
    for reach in looks:
        for k in places:
            if not found and k in measured:
                edges[k] = measured[k]
                continue
            p = photographs[k]
            seen = known.machine, at[k], known.T_base_platform[p.configuration]
            look = legs.measure(p, *seen) if reach is None else legs.search(p, *seen, reach)
            edges[k] = look.edges
        numbered = of_stations({n: edges[k] for n, k in enumerate(stations)})
        measurements = measurements_of(only, shown, numbered)
        if found:
            start = found[-1].estimate.state
        else:
            start = start_state(known.machine, measurements, at[stations])
        estimate = bundle(session.machine, measurements, start, told=told)
        at[stations] = estimate.state.T_camera_base
        poses = estimate.state.T_base_platform
        known = KnownScene(estimate.machine, at.copy(), poses, dict(edges))
        found.append(_Look(known, measurements, estimate))
    return found[-1]


class AskedPlaces(NamedTuple):
    """What is known of places (n, 4, 4) of one photograph: the evidence (n,) that it shows the
    machine from there, what was paid (n,) for the machine, and what was measured in it; None where
    too few legs are where they should be, or nothing was asked.
    """

    T_camera_base: Array
    evidence: Array
    paid: Array
    edges: tuple[EdgeSet | None, ...]

    @classmethod
    def nothing(cls) -> AskedPlaces:
        return cls(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0), ())

    def measured_from(self, T_camera_base: Array) -> EdgeSet | None:
        """What was measured from one of the places (4, 4)."""
        here = np.all(self.T_camera_base == T_camera_base, axis=(1, 2))
        return next((self.edges[k] for k in np.flatnonzero(here)), None)


def look_closer(
    session: Session,
    photograph: legs.Photographs,
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
    view = StationView(
        before.machine, p.camera, p.configuration, session.joints, before.T_base_platform,
        distance_tables(p.images, *FINEST_TABLES),
    )  # fmt: skip
    near = found.evidence > found.evidence[0] - MOST_BEHIND_BEST * found.unit
    places = np.concatenate([found.T_camera_base[near][:PLACES_LOOKED_AT_CLOSER], others])
    # the machine as it is known; where it fits better changed, that is taken
    settled, evidence = settle_by_evidence(view, places, one, 16, 6, SILHOUETTE_SCATTER)
    seen = AskedPlaces.nothing() if asked is None else asked
    order = np.argsort(-evidence, kind="stable")
    both = np.concatenate([seen.T_camera_base, settled[order]])
    count = len(seen.T_camera_base)
    order = order[[k - count for k in distinct_silhouettes(view, both, one) if k >= count]]
    at, fits = [*seen.T_camera_base, *settled[order]], [*seen.evidence, *evidence[order]]
    paid, edges = [*seen.paid, *np.zeros(len(order))], [*seen.edges, *[None] * len(order)]
    for number, T in enumerate(places[order], start=count):
        best = max(fit / found.unit - cost for fit, cost in zip(fits, paid, strict=True))
        if before.edges and fits[number] / found.unit < best - MOST_BEHIND_BEST:
            break  # what is known of the machine already does not change by so much
        try:
            known, cost = ask(session, p, before, T)
        except PkmcalError:
            continue  # too few legs are where they should be
        changed = replace(view, machine=known.machine, all_poses=known.T_base_platform)
        there, fit = settle_by_evidence(
            changed, known.T_camera_base[[p.station]], one, 16, 6, SILHOUETTE_SCATTER
        )
        at, fits, paid = [*at, there[0]], [*fits, float(fit[0])], [*paid, cost]
        edges[number] = known.edges[p.station]
        edges.append(edges[number])
    seen = AskedPlaces(np.stack(at), np.array(fits), np.array(paid), tuple(edges))
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
