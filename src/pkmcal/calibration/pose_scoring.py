"""Where a photograph by hand was taken from, asked of the joint estimate.

A search in the picture alone knows the machine by its drawing, whose errors of millimetres are
pixels: a machine of equal parts then fits nearly as well when it is turned by one of them. Here the
silhouettes are looked for from each of the places that a photograph could show, and the machine is
estimated with it there, in turns. What the drawing has wrong is explained by that, and paid for by
the drawing's tolerances; where photographs that are placed already know the machine, by what they
know of it. How well the machine, so changed, lies on the picture (the evidence of
:mod:`pkmcal.observe.pose_likelihood`) less what was paid is the log likelihood of the place.
Between places from which the machine lies on the same legs, turned onto itself, half an edge counts
as one measurement, as it does in a station's photographs; against other places half a leg, since
what chance puts under a leg in a picture full of edges, it puts under all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.case import PriorScene
from pkmcal.errors import PkmcalError
from pkmcal.identify.bundle import bundle, marginalize_to_machine
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.start import start_state
from pkmcal.measurements import EdgeSet, Measurements, of_stations
from pkmcal.observe import legs
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.image_localization import (
    PoseHypotheses,
    distinct,
    finest_view,
    refine_local,
    symmetric_poses,
)
from pkmcal.observe.pose_candidates import same_pose
from pkmcal.observe.pose_likelihood import (
    StationView,
    correlation_length,
    distinct_silhouettes,
    refine_ml,
)
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.session.load import Session

CANDIDATES_RESCORED, MOST_BEHIND_BEST = 8, 12.0
"""Most places of a photograph that are asked about, and by how many measurements of the search one
may be behind the best: what is further behind has odds of one in a hundred thousand."""
CANDIDATES_REFINED_LOCALLY = 4
"""Places about which likelier ones are looked for, once others have told the machine."""
PASSES_FROM_NOMINAL, PASSES_FROM_PRIOR = 4, 2
"""Looks at silhouettes, each from the estimate before: the drawing is off by pixels, a machine that
photographs have told is not."""
SILHOUETTE_SCATTER = legs.SEARCH_SIGMA
"""Pixels (of the finest tables) within which silhouettes scatter about the picture's edges: a whole
leg is found to no less, and what is wrong of the drawing is explained by then. Chance offers legs
that lie near something; it does not offer legs that lie on it."""

ViewOf = Callable[[int, PriorScene], StationView]
"""The view of a station's one photograph with what is known."""


def register_images(
    session: Session,
    photographs: Mapping[int, Photographs],
    scene: PriorScene,
    places: Mapping[int, Array],
    boards: Boards,
) -> PriorScene:
    """What is known together with photographs at places T_camera_base (4, 4): those that were
    placed before are looked at again as well, for what the machine was taken for then, their edges
    were taken for.

    photographs : by station. boards : what they show of a board. Raises a `PkmcalError` where there
    is nothing to be estimated.
    """

    def view(k: int, scene: PriorScene) -> StationView:
        return finest_view(scene.machine, photographs[k], session.joints, scene.T_base_platform)

    n_passes = PASSES_FROM_PRIOR if scene.edges else PASSES_FROM_NOMINAL
    every = {k: scene.T_camera_base[k] for k in scene.edges} | dict(places)
    near = {k: refine_local(view(k, scene), T, SILHOUETTE_SCATTER)[0] for k, T in every.items()}
    updated_scene = scene._replace(prior=None)
    while True:
        last = _measurement_pass(session, updated_scene, near, boards, view)
        # how silhouettes scatter in these photographs, their residuals tell, more or less than each
        statistics = last.estimate.statistics
        freedom = statistics.dof_edges
        share = statistics.chi2_edges / freedom if freedom > LEAST_NOISE_FREEDOM else 1.0
        updated_scene = last.scene._replace(scatter=updated_scene.scatter * float(np.sqrt(share)))
        near = {k: updated_scene.T_camera_base[k] for k in near}
        n_passes -= 1
        if not n_passes:
            return updated_scene._replace(
                prior=marginalize_to_machine(last.measurements, last.estimate)
            )


def evaluate_pose(
    session: Session, scene: PriorScene, station: int, T_camera_base: Array, view: StationView
) -> tuple[PriorScene, float]:
    """What one photograph would make of what is known, if it were taken from a place (4, 4); and
    what is paid for that, half the squares by which the machine and the readings are moved.

    Those that are placed say what they know of the machine once and for all, so a question costs
    the same however many they are. Boards are left out: what a place is asked is how the legs look
    from there. view : of the photograph. Raises a `PkmcalError` where too few legs are where they
    should be.
    """

    def changed(_: int, now: PriorScene) -> StationView:
        return replace(view, machine=now.machine, all_poses=now.T_base_platform)

    paid = 0.0
    for _ in range(PASSES_FROM_PRIOR if scene.edges else PASSES_FROM_NOMINAL):
        last = _measurement_pass(session, scene, {station: T_camera_base}, Boards(), changed)
        scene, statistics = last.scene, last.estimate.statistics
        T_camera_base = scene.T_camera_base[station]
        paid = (statistics.chi2_drawing + statistics.chi2_joints) / 2
    return scene, paid


class _Pass(NamedTuple):
    """What is known after a look, and the estimate that says so."""

    scene: PriorScene
    measurements: Measurements
    estimate: Estimate


def _measurement_pass(
    session: Session,
    scene: PriorScene,
    places: Mapping[int, Array],
    boards: Boards,
    view: ViewOf,
) -> _Pass:
    """What is known once photographs were looked at from places, and nothing of others but what
    they told of the machine.
    """
    stations = sorted(places)

    def measure(k: int) -> EdgeSet:
        return silhouette_edges(view(k, scene), places[k], k).edges.scaled(scene.scatter)

    with ThreadPoolExecutor(THREADS) as pool:
        edges = dict(zip(stations, pool.map(measure, stations), strict=True))
    only = replace(session.of_stations(stations), trackers=(), links=())
    visible = boards.of(np.array(stations, dtype=int))
    numbered = of_stations({n: edges[k] for n, k in enumerate(stations)})
    measurements = measurements_of(only, visible, numbered)
    start = start_state(scene.machine, measurements, np.stack([places[k] for k in stations]))
    estimate = bundle(session.machine, measurements, start, marginal_prior=scene.prior)
    at = scene.T_camera_base.copy()
    at[stations] = estimate.state.T_camera_base
    poses = estimate.state.T_base_platform
    now = scene._replace(
        machine=estimate.machine, T_camera_base=at, T_base_platform=poses, edges=edges
    )
    return _Pass(now, measurements, estimate)


class ScoredPoses(NamedTuple):
    """What is known of places (n, 4, 4) of one photograph: the evidence (n,) that it shows the
    machine from there, and what was paid (n,) for the machine. failures : why further places could
    not be tested.
    """

    T_camera_base: Array
    scores: Array
    paid: Array
    failures: tuple[str, ...] = ()

    @classmethod
    def nothing(cls) -> ScoredPoses:
        return cls(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))


def rescore_poses(
    session: Session,
    photograph: Photographs,
    before: PriorScene,
    hypotheses: PoseHypotheses,
    others: Array,
    scores: ScoredPoses | None = None,
) -> tuple[PoseHypotheses, ScoredPoses]:
    """The places of one photograph, weighed with what is known of the machine, the likeliest first;
    evidence is then a log likelihood against chance. And what was found out for that.

    others : (n, 4, 4) places that are asked about beside those found in the picture. scores : what
    was found out already with the same machine; nothing is asked about one of its places again.
    """
    p = photograph.decoded()
    one = np.zeros(1, dtype=int)
    view = finest_view(before.machine, p, session.joints, before.T_base_platform)
    near = (
        hypotheses.log_likelihood_ratio
        > hypotheses.log_likelihood_ratio[0] - MOST_BEHIND_BEST * hypotheses.unit
    )
    places = np.concatenate([hypotheses.T_camera_base[near][:CANDIDATES_RESCORED], others])
    # the machine as it is known; where it fits better changed, that is taken
    settled, log_likelihood_ratio = refine_ml(view, places, one, 16, 6, SILHOUETTE_SCATTER)
    if before.edges:  # what is known of the machine changes little: look about the likeliest places
        for k in np.argsort(-log_likelihood_ratio, kind="stable")[:CANDIDATES_REFINED_LOCALLY]:
            settled[k], log_likelihood_ratio[k] = refine_local(view, settled[k], SILHOUETTE_SCATTER)
        places = settled
    previous = ScoredPoses.nothing() if scores is None else scores
    order = np.argsort(-log_likelihood_ratio, kind="stable")
    both = np.concatenate([previous.T_camera_base, settled[order]])
    count = len(previous.T_camera_base)
    order = order[[k - count for k in distinct_silhouettes(view, both, one) if k >= count]]
    at, fits = (
        [*previous.T_camera_base, *settled[order]],
        [*previous.scores, *log_likelihood_ratio[order]],
    )
    paid = [*previous.paid, *np.zeros(len(order))]
    failures = [*previous.failures]
    for number, T in enumerate(places[order], start=count):
        best = max(fit / hypotheses.unit - cost for fit, cost in zip(fits, paid, strict=True))
        if before.edges and fits[number] / hypotheses.unit < best - MOST_BEHIND_BEST:
            break  # what is known of the machine already does not change by so much
        try:
            reference_values, cost = evaluate_pose(session, before, p.station, T, view)
        except PkmcalError as error:  # such as too few legs where they should be from there
            failures.append(str(error))
            continue
        changed = replace(
            view, machine=reference_values.machine, all_poses=reference_values.T_base_platform
        )
        there, fit = refine_ml(
            changed, reference_values.T_camera_base[[p.station]], one, 16, 6, SILHOUETTE_SCATTER
        )
        at, fits, paid = [*at, there[0]], [*fits, float(fit[0])], [*paid, cost]
    previous = ScoredPoses(np.stack(at), np.array(fits), np.array(paid), tuple(failures))
    return _weighed(view, previous, hypotheses.unit), previous


def _weighed(view: StationView, scores: ScoredPoses, unit: float) -> PoseHypotheses:
    """Places by what was found out of them, the likeliest first."""
    at, log_likelihood_ratio, paid, _ = scores
    edge = correlation_length(view, at[np.argmax(log_likelihood_ratio)])
    by_edges, by_legs = log_likelihood_ratio / edge - paid, log_likelihood_ratio / unit - paid
    first = at[np.argmax(by_edges)]
    here = same_pose(at, first)
    same = here | same_pose(at[:, None], symmetric_poses(view, first[None])).any(axis=1)
    worth = np.where(same, by_edges - by_edges.max() + by_legs[here].max(), by_legs)
    order = np.argsort(-worth, kind="stable")
    order = order[distinct(view, at[order])]
    return PoseHypotheses(at[order], worth[order], 1.0)
