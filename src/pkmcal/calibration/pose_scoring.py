"""Scores of candidate poses of a hand-held image by the joint estimate.

Localization from the image alone uses the nominal model, whose errors of millimetres are pixels: a
machine of equal parts then fits nearly as well after a rotation by one of them. Here the
silhouettes are measured from each candidate pose, and the machine is estimated with the camera
there, in alternation. Errors of the nominal model are thereby explained, at a cost given by its
prior sigmas or, if images with accepted poses have determined the machine already, by their
marginal prior. The log-likelihood of a pose is the log-likelihood ratio of the changed machine in
the image (:mod:`pkmcal.observe.pose_likelihood`) minus that cost.

Among poses from which the machine, rotated onto itself, covers the same legs, half an edge counts
as one measurement, as in a station's images. Against other poses half a leg counts as one, because
in a cluttered image a chance match of a leg matches all of it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Integers
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.case import PriorScene
from pkmcal.errors import PkmcalError
from pkmcal.identify.bundle import BATCH, Fit, fit_state, fit_states, marginalize_to_machine
from pkmcal.identify.start import start_state
from pkmcal.identify.state import State
from pkmcal.measurements import EdgeSet, of_stations
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.distance_tables import DistanceTables
from pkmcal.observe.image_batches import StationImages
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
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.session.load import Session


@dataclass(frozen=True)
class PoseScoringOptions:
    """Constants of the scores of an image's candidate poses with a known machine."""

    # largest number of candidate poses that are scored, and their largest difference from the best
    # log-likelihood ratio, in measurements
    candidates: int = 8
    most_behind_best: float = HYPOTHESIS_THRESHOLDS.beam
    # number of poses that are refined locally, once other images have determined the machine
    refined_locally: int = 4
    # ratio by which the number of images that determine the machine must grow before likelier poses
    # are searched around those of all of them, instead of the new ones only
    refined_again_growth: float = 1.25
    # measurement passes of silhouettes, each from the previous estimate: from the nominal model,
    # which has errors of pixels, and from a machine that images have determined
    passes_from_nominal: int = 4
    passes_from_prior: int = 2
    # largest scatter of silhouettes about image edges, pixels of the finest tables: the accuracy of
    # the search of a whole leg. Errors of the nominal model are explained before, and chance
    # matches have a larger scatter
    silhouette_scatter: float = legs.LEG_SEARCH_OPTIONS.sigma


_OPTIONS = PoseScoringOptions()


def register_images(
    session: Session,
    images: Mapping[int, StationImages],
    scene: PriorScene,
    places: Mapping[int, Array],
    boards: Boards,
    progress: Progress = no_progress,
) -> PriorScene:
    """Scene estimated with further images at poses ``places``, T_camera_base (4, 4) by station.

    If these are many, they change the machine, and the silhouettes of images registered earlier are
    measured again too. Raises a `PkmcalError` if nothing can be estimated.

    images : by station.
    boards : boards in these images.
    """
    n_passes = _OPTIONS.passes_from_prior if scene.edges else _OPTIONS.passes_from_nominal
    near = {k: scene.T_camera_base[k] for k in scene.edges} | dict(places)
    again = len(near) >= _OPTIONS.refined_again_growth * len(scene.edges)
    measured = refined = (near if again else places).keys()
    scene = scene._replace(prior=None)
    for number in range(n_passes):
        own = part(progress, number / n_passes, (number + 1) / n_passes)
        places = {k: near[k] for k in measured}
        places, edges = _silhouettes(session, images, scene, places, refined, own)
        last, fit = _joint_fit(session, scene, near | places, {**scene.edges, **edges}, boards)
        # scatter of the silhouettes from their residuals, relative to the stated sigmas
        scene = last._replace(
            scatter=scene.scatter * fit.edge_scale,
            edges={k: one.scaled(fit.edge_scale) for k, one in last.edges.items()},
        )
        if number + 1 == n_passes:
            scene = scene._replace(prior=marginalize_to_machine(fit.info))
        near, refined = {k: scene.T_camera_base[k] for k in near}, ()
    return scene


def _silhouettes(
    session: Session,
    images: Mapping[int, StationImages],
    scene: PriorScene,
    places: Mapping[int, Array],
    refined: Collection[int],
    progress: Progress,
) -> tuple[dict[int, Array], dict[int, EdgeSet]]:
    """Poses T_camera_base (4, 4) and silhouettes of images, by station, several images at a time.

    places : poses by station. refined : stations of which the likeliest pose near it is taken.
    progress : called after each image.
    """

    def measure(k: int) -> tuple[Array, EdgeSet]:
        # the distance tables of an image serve both, and are too large to be retained
        view = finest_view(scene.machine, images[k], session.joints, scene.T_base_platform)
        T = places[k]
        if k in refined:
            T = refine_local(view, T[None], _OPTIONS.silhouette_scatter)[0][0]
        return T, silhouette_edges(view, T, k).edges.scaled(scene.scatter)

    poses, edges, stations = dict[int, Array](), dict[int, EdgeSet](), sorted(places)
    count = len(scene.edges.keys() | places.keys())
    text = f"Estimating {count} localized images together"
    with ThreadPoolExecutor(THREADS) as pool:
        for k, one in zip(stations, pool.map(measure, stations), strict=True):
            poses[k], edges[k] = one
            progress(text, len(poses) / len(stations))
    return poses, edges


class EvaluatedPose(NamedTuple):
    """Estimate with one image at a camera pose.

    state : of this image alone; poses of other configurations are those of the start.
    edges : silhouettes of the image.
    cost : of the machine, half the sum of squares by which the parameters and the joint
        readings are moved.
    """

    machine: Machine
    state: State
    edges: EdgeSet
    cost: float

    @property
    def T_camera_base(self) -> Array:
        """Pose (4, 4) of the camera."""
        return self.state.T_camera_base[0]

    def view_in(self, view: StationView) -> StationView:
        """View of the image with this machine."""
        return replace(view, machine=self.machine, all_poses=self.state.T_base_platform)


def evaluate_poses(
    session: Session, scene: PriorScene, station: int, T_camera_base: Array, view: StationView
) -> list[EvaluatedPose | PkmcalError]:
    """The scene estimated with one image at each of several camera poses (n, 4, 4), as runs of one
    batch; the error of each that has none, because too few legs are measured.

    Images with accepted poses enter by their marginal prior, so the effort does not depend on their
    number. Boards are left out: the score is about the legs.

    view : of this image.
    """
    only = replace(session.of_stations([station]), trackers=(), links=())
    nothing = measurements_of(only, Boards())
    begin = start_state(scene.machine, nothing, T_camera_base[:1])
    results: list[EvaluatedPose | PkmcalError] = [
        EvaluatedPose(scene.machine, replace(begin, T_camera_base=T[None]), EdgeSet.empty(), 0.0)
        for T in T_camera_base
    ]
    n_passes = _OPTIONS.passes_from_prior if scene.edges else _OPTIONS.passes_from_nominal
    for number in range(n_passes):
        # while edges are matched from errors of pixels, weights and noise need not converge
        rough = number < n_passes - _OPTIONS.passes_from_prior
        options = replace(BATCH, most_rounds=0) if rough else BATCH
        before = {k: one for k, one in enumerate(results) if isinstance(one, EvaluatedPose)}
        edges = [
            silhouette_edges(one.view_in(view), one.T_camera_base, 0).edges.scaled(scene.scatter)
            for one in before.values()
        ]
        measurements = [replace(nothing, edges=own) for own in edges]
        starts = [one.state for one in before.values()]
        fits = fit_states(session.machine, measurements, starts, scene.prior, options)
        for k, own, fit in zip(before, edges, fits, strict=True):
            failed = isinstance(fit, PkmcalError)
            results[k] = fit if failed else EvaluatedPose(fit.machine, fit.state, own, fit.change)
    return results


def _joint_fit(
    session: Session,
    scene: PriorScene,
    places: Mapping[int, Array],
    edges: Mapping[int, EdgeSet],
    boards: Boards,
) -> tuple[PriorScene, Fit]:
    """Estimate the scene from silhouettes, by station, that were measured from the given poses.

    Other images enter by the marginal prior of the machine only.
    """
    stations = sorted(places)
    only = replace(session.of_stations(stations), trackers=(), links=())
    visible = boards.of(np.array(stations, dtype=int))
    numbered = of_stations({n: edges[k] for n, k in enumerate(stations)})
    measurements = measurements_of(only, visible, numbered)
    start = start_state(scene.machine, measurements, np.stack([places[k] for k in stations]))
    fit = fit_state(session.machine, measurements, start, scene.prior)
    # results back into the scene of all stations
    at = scene.T_camera_base.copy()
    at[stations] = fit.state.T_camera_base
    poses = fit.state.T_base_platform
    now = scene._replace(
        machine=fit.machine, T_camera_base=at, T_base_platform=poses, edges=dict(edges)
    )
    return now, fit


class ScoredPoses(NamedTuple):
    """Scored poses (n, 4, 4) of one image.

    scores : (n,) log-likelihood ratio of the machine at each pose.
    cost : (n,), of the machine.
    failures : why further poses could not be tested.
    """

    T_camera_base: Array
    scores: Array
    cost: Array
    failures: tuple[str, ...] = ()

    @classmethod
    def nothing(cls) -> ScoredPoses:
        """No poses."""
        return cls(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))


def rescore_poses(
    session: Session,
    image: StationImages,
    before: PriorScene,
    hypotheses: PoseHypotheses,
    others: Array,
    scores: ScoredPoses | None = None,
    tables: DistanceTables | None = None,
) -> tuple[PoseHypotheses, ScoredPoses]:
    """Pose hypotheses of one image, weighted by the present knowledge of the machine, and their
    scores.

    The hypotheses are sorted; their log-likelihood ratios are in unit 1.

    before : scene without the image.
    hypotheses : from localization.
    others : (n, 4, 4) further poses to score.
    scores : earlier ones with the same machine; their poses are not scored again.
    tables : finest distance tables of the image, computed if None.
    """
    p = image.decoded()
    first, scatter = np.zeros(1, dtype=int), _OPTIONS.silhouette_scatter
    view = finest_view(before.machine, p, session.joints, before.T_base_platform, tables)
    # candidates, refined with the machine as it is known
    near = (
        hypotheses.log_likelihood_ratio
        > hypotheses.log_likelihood_ratio[0] - _OPTIONS.most_behind_best * hypotheses.unit
    )
    places = np.concatenate([hypotheses.T_camera_base[near][: _OPTIONS.candidates], others])
    # maximum likelihood with the machine unchanged; a changed machine is tried below
    settled, log_likelihood_ratio = refine_ml(view, places, first, 16, 6, scatter)
    previous = ScoredPoses.nothing() if scores is None else scores
    count = len(previous.T_camera_base)

    def unscored() -> Integers:
        """Rows of the distinct poses that were not scored before, the likeliest first."""
        order = np.argsort(-log_likelihood_ratio, kind="stable")
        both = np.concatenate([previous.T_camera_base, settled[order]])
        return order[[k - count for k in distinct_silhouettes(view, both, first) if k >= count]]

    if before.edges:  # the machine changes little: search around the likeliest poses
        best = unscored()[: _OPTIONS.refined_locally]
        settled[best], log_likelihood_ratio[best] = refine_local(view, settled[best], scatter)
        places = settled
    order = unscored()
    at, fits = (
        [*previous.T_camera_base, *settled[order]],
        [*previous.scores, *log_likelihood_ratio[order]],
    )
    cost = [*previous.cost, *np.zeros(len(order))]
    failures = [*previous.failures]
    # estimate the machine with the camera at each remaining pose
    tried = places[order]
    if before.edges:  # the prior allows no large change
        worth = np.array(fits) / hypotheses.unit - cost
        tried = tried[worth[count:] >= worth.max() - _OPTIONS.most_behind_best]
    for one in evaluate_poses(session, before, p.station, tried, view):
        if isinstance(one, PkmcalError):  # such as too few legs measured
            failures.append(str(one))
            continue
        T, changed = one.T_camera_base[None], one.view_in(view)
        there, fit = refine_ml(changed, T, first, 16, 6, scatter)
        at, fits, cost = (
            [*at, there[0]],
            [*fits, float(fit[0])],
            [*cost, one.cost],
        )
    previous = ScoredPoses(np.stack(at), np.array(fits), np.array(cost), tuple(failures))
    return _weighed(view, previous, hypotheses.unit), previous


def _weighed(view: StationView, scores: ScoredPoses, unit: float) -> PoseHypotheses:
    """Pose hypotheses from scored poses, best first.

    Poses equal to the best one, or symmetric to it, are compared by edges, the others by legs.
    """
    at, log_likelihood_ratio, cost, _ = scores
    edge = correlation_length(view, at[np.argmax(log_likelihood_ratio)])
    by_edges, by_legs = (
        log_likelihood_ratio / edge - cost,
        log_likelihood_ratio / unit - cost,
    )
    first = at[np.argmax(by_edges)]
    here = same_pose(at, first)
    same = here | same_pose(at[:, None], symmetric_poses(view, first[None])).any(axis=1)
    worth = np.where(same, by_edges - by_edges.max() + by_legs[here].max(), by_legs)
    order = np.argsort(-worth, kind="stable")
    order = order[distinct(view, at[order])]
    return PoseHypotheses(at[order], worth[order], 1.0)
