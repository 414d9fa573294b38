"""Log-likelihoods of candidate poses of a hand-held image, by the joint estimate.

The localization of one image uses the nominal machine, whose errors of millimetres are pixels: a
machine of equal parts then fits nearly as well when it is turned by one of them. Here silhouettes
are measured from each candidate pose and the machine is estimated with the image at that pose, in
turns. The estimate takes up errors of the nominal model, at a cost by its prior sigmas; where other
images are placed already, by their marginal prior on the machine. The log-likelihood of the pose is
the log-likelihood ratio of the image with the machine so changed
(:mod:`pkmcal.observe.pose_likelihood`) less that cost. Between poses under which the machine lies
on the same legs, turned onto itself, half an edge counts as one measurement, as in the images of a
station; against other poses half a leg, for chance matches in an image full of edges are correlated
along a leg.
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
from pkmcal.geometry.rigid import angle_between
from pkmcal.identify.bundle import bundle, marginalize_to_machine
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.start import start_state
from pkmcal.measurements import EdgeSet, Measurements, of_stations
from pkmcal.observe import legs
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.image_localization import (
    SAME_PLACE_TURN,
    PoseHypotheses,
    distinct,
    finest_view,
    refine_local,
    symmetric_poses,
)
from pkmcal.observe.pose_likelihood import (
    StationView,
    correlation_length,
    distinct_silhouettes,
    refine_ml,
)
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.session.load import Session

CANDIDATES_RESCORED, MOST_BEHIND_BEST = 8, 12.0
"""Most candidate poses of an image that are evaluated, and by how many measurements of the search
one may be behind the best: others have odds of one in a hundred thousand."""
CANDIDATES_REFINED_LOCALLY = 4
"""Poses about which likelier ones are searched, once other images determine the machine."""
PASSES_FROM_NOMINAL, PASSES_FROM_PRIOR = 4, 2
"""Measurement passes of silhouettes, each from the estimate before: the nominal model is off by
pixels, a machine that images have determined is not."""
SILHOUETTE_SCATTER = legs.SEARCH_SIGMA
"""Largest scatter (px of the finest tables) of silhouettes about image edges: a whole leg is
measured to no less, and errors of the nominal model are taken up by then. By chance legs are near
edges, but not on them."""

ViewOf = Callable[[int, PriorScene], StationView]
"""The view of a station's one image under a scene."""


def register_images(
    session: Session,
    photographs: Mapping[int, Photographs],
    scene: PriorScene,
    places: Mapping[int, Array],
    boards: Boards,
) -> PriorScene:
    """The scene with images registered at poses T_camera_base (4, 4).

    Images that were placed before are measured again, for their edges depend on the machine by
    which they were predicted. photographs : by station. boards : seen in them. Raises a
    `PkmcalError` where there is no estimate.
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
    """The scene with one image at a candidate pose (4, 4), and the cost of that: half the squares
    of the changes of machine and readings, in prior sigmas.

    Placed images enter by their marginal prior on the machine, so the time does not depend on their
    number. Boards are left out: the legs alone decide on the pose. view : of the image. Raises a
    `PkmcalError` where too few legs are near their prediction.
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
    """The scene after a measurement pass, and its estimate."""

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
    """One measurement pass and estimate of images at poses; other images enter by their marginal
    prior only.
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
    """Candidate poses (n, 4, 4) of one image with log-likelihood ratios (n,) and costs (n,) of the
    machine's changes. failures : why further poses could not be tested.
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
    """Pose hypotheses of one image by the joint estimate, the likeliest first, with log-likelihood
    ratios in nats; and the scored poses.

    others : (n, 4, 4) candidates besides those by the search in the image. scores : of an earlier
    call with the same machine, whose poses are not evaluated again.
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
    """Pose hypotheses by their scores, the likeliest first."""
    at, log_likelihood_ratio, paid, _ = scores
    edge = correlation_length(view, at[np.argmax(log_likelihood_ratio)])
    by_edges, by_legs = log_likelihood_ratio / edge - paid, log_likelihood_ratio / unit - paid
    first = at[np.argmax(by_edges)]
    turned = angle_between(at[:, None], symmetric_poses(view, first[None])).min(
        axis=1, initial=np.inf
    )
    here = angle_between(at, first) < SAME_PLACE_TURN
    same = here | (turned < SAME_PLACE_TURN)
    worth = np.where(same, by_edges - by_edges.max() + by_legs[here].max(), by_legs)
    order = np.argsort(-worth, kind="stable")
    order = order[distinct(view, at[order])]
    return PoseHypotheses(at[order], worth[order], 1.0)
