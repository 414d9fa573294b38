"""Localization of all stations: those on tripods jointly, hand-held images one by one.

Each hand-held image is localized by itself (:mod:`pkmcal.observe.image_localization`), because only
the machine connects it to other images. Its candidate poses are then scored by the joint estimate
(:mod:`pkmcal.calibration.pose_scoring`), beginning with the least ambiguous images. A board on the
base connects the images in which it is visible.

Images whose pose is certain determine the machine better than the nominal model does. With that
machine the other images are scored, and scored again, until no image is added. Images that stay
ambiguous are rejected with a reason, because a single wrong pose corrupts the estimate; so are
images in which legs cannot be measured at their predicted positions, or most of whose edges the
joint estimate rejects: their pose was wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.calibration.localization import LegLocalization, locate_stations
from pkmcal.calibration.localization_cache import (
    Localized,
    image_name,
    remember_image,
    remember_session,
    remembered_image,
    remembered_session,
    session_name,
)
from pkmcal.calibration.pose_scoring import (
    PoseScoringOptions,
    ScoredPoses,
    register_images,
    rescore_poses,
)
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import angle_between, inverse
from pkmcal.identify.bundle import MarginalPrior
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet, Measurements
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.background import Landmarks, Neighbour, Surroundings
from pkmcal.observe.distance_tables import DistanceTables, distance_tables
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.image_localization import (
    IMAGE_LOCALIZATION_OPTIONS,
    PoseHypotheses,
    finest_tables,
    finest_view,
    localize_along,
    localize_image,
    localize_near,
)
from pkmcal.observe.pose_candidates import SAME_POSE_TURN, same_pose
from pkmcal.observe.pose_likelihood import StationView
from pkmcal.observe.predict import LegsInCamera, legs_in_camera
from pkmcal.outcome.finding import Finding, note
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import brief, listed


@dataclass(frozen=True)
class HandheldOptions:
    """Constants of the localization of hand-held images."""

    # largest probability that any image of a session is accepted with a wrong pose: 1/20, that of a
    # false report
    wrong_acceptance: float = math.exp(-HYPOTHESIS_THRESHOLDS.report)
    # number of an image's best poses that are always scored again when the machine is known better,
    # whatever their score by the image alone, because a wrong pose corrupts the estimate
    scored_again: int = 4
    # largest number of images that are scored with the nominal model, which takes twice as long as
    # with a machine from images
    most_from_nominal: int = 12
    # largest number of rounds in which images without an accepted pose are scored again: by their
    # neighbours, by more hypotheses, and with the images that these two have added
    most_rounds: int = 3
    # ratio by which the number of images that determine the machine must grow before the poses of
    # an image are scored anew
    rescoring_growth: float = PoseScoringOptions.refined_again_growth
    # factor on the number of hypotheses with which an ambiguous image is localized once more
    wider: int = 3
    # distances from the camera of a neighbour that are tried for an image, relative to the median
    # distance of the cameras from the base: from a step to the opposite side; their ratio is that
    # of the search of a single image
    apart: Array = field(default_factory=lambda: np.geomspace(0.15, 2.5, 18))
    # largest rotation (rad) by which the joint estimate may change an image's localized pose
    most_turn: float = SAME_POSE_TURN / 2
    # fewest legs of an image, if the machine has so many, and fewest edges that determine its pose.
    # Pose and focal length are seven numbers: each edge gives two, and each leg little more, so
    # among three legs a wrong match contradicts none of the others
    fewest_legs: int = 4
    fewest_edges: int = 4


_OPTIONS = HandheldOptions()

EDGES_DISAGREE_REASON = "too few of its edges agree with the other images"
"""Reason for rejecting an image with a certain pose whose edges the joint estimate rejects."""
CAMERA_TURNED_REASON = (
    "all images together turn its camera by more than"
    f" {brief(math.degrees(_OPTIONS.most_turn))} degrees"
)
"""Reason for rejecting an image that has a single candidate pose and does not belong there."""


def few_legs_reason(machine: Machine) -> str:
    """Reason for rejecting an image with a certain pose at which too few legs can be measured."""
    return f"fewer than {_fewest_legs(machine)} legs can be measured at its pose"


def _fewest_legs(machine: Machine) -> int:
    """Smallest number of legs of an image that determine its pose."""
    return min(_OPTIONS.fewest_legs, machine.n_legs)


@dataclass(frozen=True)
class Localization:
    """Poses of all stations of a session, from their images; no error is raised.

    leg_localization : of the images on tripods, None if none was searched.
    places : pose hypotheses of each hand-held image, by station number.
    result : the case without the rejected hand-held images, or the error if there is none.
    """

    leg_localization: LegLocalization | None
    places: Mapping[int, PoseHypotheses]
    result: Case | PkmcalError


def localization_share(session: Session) -> float:
    """Share of a calibration's time that the localization of its images takes, about."""
    by_hand = [station.handheld for station in session.stations]
    return 0.25 + 0.65 * sum(by_hand) / max(len(by_hand), 1)


def localize_case(
    session: Session,
    images: list[StationImages],
    boards: Boards,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> Case:
    """Case with the poses of all stations, by :func:`localize`.

    Raises `InputError` or `ResultError` if the pose of a station on a tripod is undetermined, or if
    no hand-held image is localized.
    """
    value = localize(session, images, boards, rng, progress).result
    if isinstance(value, PkmcalError):
        raise value
    return value


def localize(
    session: Session,
    images: list[StationImages],
    boards: Boards,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> Localization:
    """Poses of all stations; hand-held images that are not localized are rejected with a reason.

    images : images of all stations that observe legs.
    progress : called with the step as text and the share done.
    """
    # stations on tripods first; if they fail, hand-held images are not searched
    fixed = [p for p in images if not session.stations[p.station].handheld]
    by_hand = 1 - len(fixed) / max(len(images), 1)
    search = locate_stations(session, fixed, boards, rng, part(progress, 0, 1 - by_hand))
    places: dict[int, PoseHypotheses] = {}
    if search.error is not None:
        return Localization(search.leg_localization, places, search.error)
    scene = PriorScene.as_drawn(session, search.T_camera_base)
    # hand-held images, and the reasons of those without a pose or with a contradictory one
    lost: dict[int, str] = {}
    if len(fixed) < len(images):
        places, scene = search_by_hand(
            session, images, boards, scene, part(progress, 1 - by_hand, 1)
        )
        nowhere = {k for k in places if np.isnan(scene.T_camera_base[k]).any()}
        apart = _apart(session, boards)
        sure = _sure(places, len(places), apart)
        rivals = _rival_probabilities(places, apart)
        # an image with a certain pose has none in the scene if too few legs were measured there
        few_legs = few_legs_reason(scene.machine)
        lost = {k: few_legs if k in sure else why_lost(places[k], rivals[k]) for k in nowhere}
        for k in sorted(places.keys() & scene.edges.keys()):
            turn = angle_between(scene.T_camera_base[k], places[k].T_camera_base[0])
            if turn > _OPTIONS.most_turn and k in sure:
                lost[k] = CAMERA_TURNED_REASON
    # remove the rejected images
    case = Case(session, images, boards, scene)
    if len(fixed) < len(images):
        try:
            tried = {k: places[k].T_camera_base[0] for k in lost if len(places[k].T_camera_base)}
            case = _without(case, lost, tried)
        except PkmcalError as error:
            return Localization(search.leg_localization, places, error)
    return Localization(search.leg_localization, places, case)


def search_by_hand(
    session: Session,
    images: list[StationImages],
    boards: Boards,
    scene: PriorScene,
    progress: Progress = no_progress,
) -> tuple[dict[int, PoseHypotheses], PriorScene]:
    """Pose hypotheses of each hand-held image, by station number, and the scene with accepted
    poses; from the cache where the same images were localized before.

    T_camera_base of the scene is NaN for images without an accepted pose.

    images : images of all stations that observe legs.
    scene : of the nominal model, with T_camera_base of the stations localized already and NaN for
        the others.
    progress : called with the step as text and the share done.
    """
    name = session_name(session, [p.station for p in images], boards, scene)
    localized = remembered_session(name, session.machine)
    if localized is None:
        localized = _searched(session, images, boards, scene, progress)
        remember_session(name, localized)
    return localized


def _searched(
    session: Session,
    images: list[StationImages],
    boards: Boards,
    scene: PriorScene,
    progress: Progress,
) -> Localized:
    """Localization by :func:`search_by_hand`, without the cache."""
    first = np.zeros(1, dtype=int)  # one image represents a camera on a tripod
    at = {p.station: p.select(first) for p in images}
    stated, scene = _with_stated(session, scene, at)
    by_hand = [k for k in at if session.stations[k].handheld and k not in stated]
    apart = _apart(session, boards)
    room = Surroundings(list(at), lambda k: (at[k].images[0], at[k].camera))
    answers: dict[int, _CachedHypotheses] = {}
    so_far = _LocalizationState(scene)

    def hypotheses() -> dict[int, PoseHypotheses]:
        scored = {k: answer.places for k, answer in answers.items() if answer.scores is not None}
        return stated | scored

    def search(
        one: Callable[[int], _CachedHypotheses], some: Sequence[int], text: str, progress: Progress
    ) -> None:
        """Search images side by side; each is counted when it is ready."""
        progress(text, 0.0)
        tasks = {k: pool.submit(one, k) for k in some}
        try:
            for done, task in enumerate(as_completed(tasks.values()), start=1):
                task.result()
                progress(f"{text}: {done} of {len(some)}", done / len(some))
        finally:  # after an error, images that have not begun are not searched
            for task in tasks.values():
                task.cancel()
        answers.update((k, task.result()) for k, task in tasks.items())

    def rescore(some: Sequence[int], text: str, progress: Progress) -> None:
        state = so_far
        search(lambda k: _search(session, room, state, at[k], answers[k]), some, text, progress)

    def register(progress: Progress) -> _LocalizationState:
        return _with_sure(session, at, room, so_far, accepted_poses(), boards, progress)

    def accepted_poses() -> Array:
        return _accepted_poses(
            hypotheses(), len(by_hand) + len(stated), apart, boards, scene.T_camera_base
        )

    with ThreadPoolExecutor(THREADS) as pool:
        # each image by itself
        text = "Localizing hand-held images"
        search(lambda k: _alone(session, scene, room, at[k]), by_hand, text, part(progress, 0, 0.3))
        # score the less ambiguous half, estimate the machine, then score the others with it
        clearer = sorted(by_hand, key=lambda k: answers[k].hypotheses.rival_probability)
        half = min((len(clearer) + 1) // 2, _OPTIONS.most_from_nominal)
        rescore(clearer[:half], "Scoring the least ambiguous images", part(progress, 0.3, 0.36))
        so_far = register(part(progress, 0.36, 0.43))
        text = f"Scoring the others, with {len(so_far.placed)} images localized"
        rescore(clearer[half:], text, part(progress, 0.43, 0.56))
        # join the images of a board, and score images without an accepted pose again
        joint = _on_board(hypotheses(), boards)  # poses that the session states remain
        answers |= {k: replace(answers[k], places=joint[k]) for k in answers.keys() & joint.keys()}
        so_far = register(part(progress, 0.56, 0.6))
        rest = part(progress, 0.6, 1)
        for _ in range(_OPTIONS.most_rounds):
            T = accepted_poses()
            unsure = [k for k in by_hand if np.isnan(T[k]).any() or k in so_far.with_few_legs]
            if not so_far.placed or not unsure:
                break
            before, placed = so_far, len(by_hand) - len(unsure)
            text = f"Scoring again, with {placed} of {len(by_hand)} images localized"
            rescore(unsure, text, part(rest, 0, 0.7))
            so_far = register(part(rest, 0.7, 0.8))
            rest = part(rest, 0.8, 1)
            if so_far is before and all(answers[k].anew for k in unsure):
                break  # nothing that a further round could use is new
    out = _final_poses(so_far, accepted_poses(), (*by_hand, *stated))
    untested = tuple(_untested(session, so_far, answers, out))
    return hypotheses(), so_far.scene._replace(T_camera_base=out, findings=untested)


def _with_stated(
    session: Session, scene: PriorScene, at: Mapping[int, StationImages]
) -> tuple[dict[int, PoseHypotheses], PriorScene]:
    """Hand-held images whose pose the session states: the likeliest pose near it, alone, by
    station; and the scene with these poses.
    """
    T_camera_base = scene.T_camera_base.copy()
    stated: dict[int, PoseHypotheses] = {}
    for k, p in at.items():
        T = session.stations[k].T_camera_base
        if T is None or not session.stations[k].handheld:
            continue
        view = finest_view(scene.machine, p, session.joints, scene.T_base_platform)
        near = localize_near(view, p.images[0], T)
        stated[k] = PoseHypotheses(near.T_camera_base[:1], near.log_likelihood_ratio[:1], near.unit)
        T_camera_base[k] = near.T_camera_base[0]
    return stated, scene._replace(T_camera_base=T_camera_base)


def _apart(session: Session, boards: Boards) -> set[int]:
    """Numbers of the stations whose poses a board or a person determines beside the legs."""
    stated = {k for k, one in enumerate(session.stations) if one.T_camera_base is not None}
    return stated | boards.stations.keys()


def _final_poses(so_far: _LocalizationState, T_camera_base: Array, by_hand: Sequence[int]) -> Array:
    """Poses (S, 4, 4): estimated ones for registered images, NaN for images that are not accepted
    any more and for those in which too few legs can be measured.

    T_camera_base : (S, 4, 4) accepted poses, NaN for images without.
    by_hand : station numbers of the hand-held images.
    """
    out = T_camera_base.copy()
    for k in by_hand:
        if k in so_far.scene.edges and not np.isnan(out[k]).any():
            out[k] = so_far.scene.T_camera_base[k]
        elif k in so_far.with_few_legs:
            out[k] = np.nan
    return out


def _untested(
    session: Session,
    so_far: _LocalizationState,
    answers: Mapping[int, _CachedHypotheses],
    T_camera_base: Array,
) -> Iterator[Finding]:
    """Notes on candidate poses that could not be tested, for images without a pose in the end."""
    if so_far.failure:
        yield note("image.not_taken_together", why=so_far.failure.rstrip("."))
    for k, answer in answers.items():
        failures = answer.scores.failures if answer.scores else ()
        if failures and np.isnan(T_camera_base[k]).any():
            label, why = session.label(k), failures[0].rstrip(".")
            yield note("image.places_untested", label, number=len(failures), why=why)


class _LocalizationState(NamedTuple):
    """State in which images are scored.

    scene : with the machine estimated so far.
    placed : images with accepted poses.
    landmarks : background points of these images.
    with_few_legs : images in which too few legs can be measured at their assumed pose.
    failure : why the last accepted images could not be estimated together with the others.
    """

    scene: PriorScene
    placed: Mapping[int, Neighbour] = MappingProxyType({})
    landmarks: Mapping[int, Landmarks] = MappingProxyType({})
    with_few_legs: frozenset[int] = frozenset()
    failure: str = ""


@dataclass(frozen=True)
class _CachedHypotheses:
    """Hypotheses of one image, cached with the state in which they were scored.

    hypotheses : by localization from the image alone.
    places : weighted by all evidence.
    scores : by the joint estimate, None before it.
    by : marginal prior of the machine at that time, None for the nominal model.
    beside : number of images that determined the machine.
    by_neighbours : whether poses by the background of single neighbours have been tried.
    anew : whether ``hypotheses`` are by a machine from images.
    """

    hypotheses: PoseHypotheses
    places: PoseHypotheses
    scores: ScoredPoses | None = None
    by: MarginalPrior | None = None
    beside: int = 0
    by_neighbours: bool = False
    anew: bool = False


def _with_sure(
    session: Session,
    images: Mapping[int, StationImages],
    room: Surroundings,
    so_far: _LocalizationState,
    T_camera_base: Array,
    boards: Boards,
    progress: Progress,
) -> _LocalizationState:
    """State with all accepted images registered; unchanged without new ones.

    T_camera_base : (S, 4, 4), NaN for images without an accepted pose.
    progress : called after each image that is measured.
    """
    scene = so_far.scene
    sure = {k: T for k, T in enumerate(T_camera_base) if k in images and not np.isnan(T).any()}
    new = {k: T for k, T in sure.items() if k not in scene.edges}
    if not new:
        return so_far
    try:
        joined = register_images(session, images, scene, new, boards, progress)
        # silhouettes match anywhere, legs can be measured at the correct pose only
        with_few_legs = frozenset(
            k
            for k in new
            if session.stations[k].handheld
            and k not in boards.stations
            and _too_few_legs(joined, images[k])
        )
        if with_few_legs == new.keys():
            return so_far._replace(with_few_legs=with_few_legs)
        if with_few_legs:  # the others again, from where they are now
            rest = {k: edges for k, edges in joined.edges.items() if k not in with_few_legs}
            joined = register_images(session, images, joined._replace(edges=rest), {}, boards)
        scene = joined
    except PkmcalError as error:
        return so_far._replace(failure=str(error))
    # legs and landmarks of all accepted images with the new machine
    placed: dict[int, Neighbour] = {}
    for k in sorted(scene.edges):
        p, T = images[k], scene.T_camera_base[k]
        placed[k] = Neighbour(p.camera, T, _legs(session, p, scene, T)[0])
    return _LocalizationState(scene, placed, room.landmarks(placed), with_few_legs)


def _too_few_legs(scene: PriorScene, image: StationImages) -> bool:
    """Whether too few legs can be measured in an image at its pose."""
    p, machine = image, scene.machine
    T, poses = scene.T_camera_base[p.station], scene.T_base_platform[p.configuration]
    visible = np.unique(legs.measure(p, machine, T, poses).edges.leg)
    return len(visible) < _fewest_legs(machine)


def _alone(
    session: Session, scene: PriorScene, room: Surroundings, image: StationImages
) -> _CachedHypotheses:
    """Hypotheses from one image alone, from the cache where it was localized before."""
    room.texture(image.station)  # for later steps, here on several threads
    name = image_name(session, scene.machine, image.station)
    hypotheses = remembered_image(name)
    if hypotheses is None:
        hypotheses = _image_hypotheses(session, scene, image)
        remember_image(name, hypotheses)
    return _CachedHypotheses(hypotheses, hypotheses)


def _image_hypotheses(
    session: Session, scene: PriorScene, image: StationImages, wider: int = 1
) -> PoseHypotheses:
    """Pose hypotheses from one image alone.

    wider : factor on the number of hypotheses that are refined.
    """
    p = image
    view = StationView(
        scene.machine, p.camera, p.configuration, session.joints, scene.T_base_platform,
        distance_tables([p.images[0]]),
    )  # fmt: skip
    return localize_image(view, p.images[0], IMAGE_LOCALIZATION_OPTIONS.wider(wider))


def _search(
    session: Session,
    room: Surroundings,
    so_far: _LocalizationState,
    image: StationImages,
    before: _CachedHypotheses,
) -> _CachedHypotheses:
    """Pose hypotheses of an image, weighted by its legs and by the background.

    The background is compared with that of the images with accepted poses; earlier hypotheses are
    among the candidates. An image that stays ambiguous is localized with the machine from images:
    by the background of each of its neighbours and, if that does not suffice, once by itself among
    more hypotheses, because later images change the machine little. Poses that were scored with a
    similar machine are not scored again.
    """
    p, scene, placed, k = image.decoded(), so_far.scene, so_far.placed, image.station
    alone, scores, by, beside = before.hypotheses, None, scene.prior, len(placed)
    by_neighbours = scene.prior is not None and before.scores is not None
    anew = before.anew or before.by_neighbours
    if anew and not before.anew:
        alone = _image_hypotheses(session, scene, p, _OPTIONS.wider)
    elif (
        scene.prior is not None
        and before.by is not None
        and len(placed) < _OPTIONS.rescoring_growth * before.beside
        and scene.prior.like(before.by)
    ):
        scores, by, beside = before.scores, before.by, before.beside
    tables = finest_tables(p)
    # further candidates: from landmarks, from the last scoring, and from the background
    likely = before.places.T_camera_base[: _OPTIONS.scored_again]
    others = np.concatenate([room.place(k, so_far.landmarks), likely])
    if placed:
        axes = _legs(session, p, scene, alone.T_camera_base)
        others = np.concatenate([others, room.about(alone, k, p.camera, axes, placed)])
    if placed and by_neighbours:
        others = np.concatenate([others, _by_neighbours(session, room, so_far, p, tables)])
    # joint estimate, then the background
    closer, scores = rescore_poses(session, p, scene, alone, others, scores, tables)
    axes = _legs(session, p, scene, closer.T_camera_base)
    places = room.weighed(closer, k, p.camera, axes, placed)
    return _CachedHypotheses(alone, places, scores, by, beside, by_neighbours, anew)


def _by_neighbours(
    session: Session,
    room: Surroundings,
    so_far: _LocalizationState,
    image: StationImages,
    tables: DistanceTables,
) -> Array:
    """Poses (n, 4, 4) of an image by the background of each of its neighbours, at the distance
    from it at which the legs match best.
    """
    p, scene = image, so_far.scene
    away = [np.linalg.norm(one.T_camera_base[:3, 3]) for one in so_far.placed.values()]
    lines = room.relative(p.station, so_far.placed, _OPTIONS.apart * float(np.median(away)))
    view = finest_view(scene.machine, p, session.joints, scene.T_base_platform, tables)
    return localize_along(view, lines, legs.LEG_SEARCH_OPTIONS.sigma)


def _legs(
    session: Session, image: StationImages, joined: PriorScene, T_camera_base: Array
) -> LegsInCamera:
    """Leg axes (H, L, 3) in the frames of an image's candidate poses (H, 4, 4), or (1, L, 3) for
    one.
    """
    first = image.configuration[:1]
    pose, readings = joined.T_base_platform[first], session.joints[first]
    return legs_in_camera(joined.machine, T_camera_base, pose, readings)


def _on_board(
    hypotheses: Mapping[int, PoseHypotheses], boards: Boards
) -> dict[int, PoseHypotheses]:
    """Joint pose hypotheses of the images in which a board on the base is visible.

    The pose of the board on the base is one unknown, and each hypothesis of each image gives a
    value. An image takes its own pose where that agrees with the board's, which relies on the
    nominal model equally, and otherwise the pose that follows from the board.
    """
    T_camera_board = {
        k: visible.stood.T_camera_board
        for k, visible in boards.stations.items()
        if k in hypotheses and visible.stood is not None
    }
    if len(T_camera_board) < 2:
        return {}
    # every hypothesis as a pose of the board, scored by all images
    candidates = [inverse(T) @ hypotheses[k].T_camera_base for k, T in T_camera_board.items()]
    T_board_base = np.concatenate(candidates)
    total = np.zeros(len(T_board_base))
    own: dict[int, Array] = {}
    for k, T in T_camera_board.items():
        places, log_likelihood_ratio = (
            hypotheses[k].T_camera_base,
            hypotheses[k].log_likelihood_ratio,
        )
        same = same_pose((T @ T_board_base)[:, None], places)
        worth = np.where(same, np.maximum(log_likelihood_ratio, 0.0), 0.0)
        total += worth.max(axis=1)
        best = np.argmax(worth, axis=1)
        agrees = np.take_along_axis(worth, best[:, None], axis=1) > 0
        own[k] = np.where(agrees[..., None], places[best], T @ T_board_base)
    order = np.argsort(-total, kind="stable")
    near = same_pose(T_board_base[order], T_board_base[order[0]])
    order = order[~near | (np.arange(len(order)) == 0)]
    return {k: PoseHypotheses(T[order], total[order], 1.0) for k, T in own.items()}


def _rival_probabilities(
    hypotheses: Mapping[int, PoseHypotheses], apart: Collection[int] = ()
) -> dict[int, float]:
    """Probability of each image that its first hypothesis is not the correct one.

    The rival is its second hypothesis, or one that the search missed: if the correct pose is not
    among the hypotheses, the first is the likeliest wrong one, and no likelier than the likeliest
    wrong ones of the other images usually are, their second hypotheses.

    apart : images whose hypotheses are weighed by other evidence too, a board or a person; they are
        compared with their own second one only.
    """
    rivals = [
        one.log_likelihood_ratio[1] / one.unit
        for k, one in hypotheses.items()
        if k not in apart and len(one.T_camera_base) > 1
    ]
    usual = float(np.median(rivals)) if rivals else 0.0
    out: dict[int, float] = {}
    for k, one in hypotheses.items():
        out[k] = one.rival_probability
        if k not in apart:
            gain = float(one.log_likelihood_ratio[0] / one.unit) - usual
            out[k] = max(out[k], 1 / (1 + float(np.exp(min(gain, 500.0)))))
    return out


def _sure(
    hypotheses: Mapping[int, PoseHypotheses], count: int, apart: Collection[int] = ()
) -> list[int]:
    """Station numbers of the images whose poses are accepted.

    These are the images with the smallest rival probabilities, as long as their sum stays below
    ``HandheldOptions.wrong_acceptance``, in proportion to the images scored so far among ``count``.

    apart : as of :func:`_rival_probabilities`.
    """
    probability = _rival_probabilities(hypotheses, apart)
    order = sorted(probability, key=lambda k: probability[k])
    together = np.cumsum([probability[k] for k in order])
    return [
        k
        for k, fault in zip(order, together, strict=True)
        if fault < _OPTIONS.wrong_acceptance * len(hypotheses) / count
    ]


def _accepted_poses(
    hypotheses: Mapping[int, PoseHypotheses],
    count: int,
    apart: Collection[int],
    boards: Boards,
    prior_poses: Array,
) -> Array:
    """Poses T_camera_base (S, 4, 4) of the accepted images and those connected to them by a board.

    NaN for the others.

    count : number of hand-held images, some of which may not be scored yet.
    apart : as of :func:`_rival_probabilities`.
    prior_poses : (S, 4, 4) of the stations localized before.
    """
    out = prior_poses.copy()
    for k in _sure(hypotheses, count, apart):
        out[k] = hypotheses[k].T_camera_base[0]
    visible = [None if np.isnan(T).any() else T for T in out]
    joined = boards.joined(visible)
    return np.stack([np.full((4, 4), np.nan) if T is None else T for T in joined])


def inconsistent_poses(
    session: Session, measurements: Measurements, estimate: Estimate, T_camera_base: Array
) -> dict[int, str]:
    """Reasons why hand-held images do not belong at their localized poses, by station number.

    The joint estimate rotates the camera, rejects most edges, or leaves too few edges or legs to
    determine the pose. A board that agrees with the others determines the pose of its image
    whatever the edges do.

    T_camera_base : (S, 4, 4) localized poses.
    """
    astray = angle_between(estimate.state.T_camera_base, T_camera_base) > _OPTIONS.most_turn
    station = measurements.edges.station
    measured = ~measurements.edges.coarse  # silhouettes match anywhere
    inliers = np.bincount(station, measured * estimate.edge_weights, len(session.stations))
    count = np.bincount(station, measured, len(session.stations))
    poses = measurements.poses.station
    # trackers are numbered after the cameras
    by_board = np.bincount(poses, estimate.pose_weights, len(session.stations))
    by_board = by_board[: len(session.stations)] >= INLIER_WEIGHT
    visible = np.zeros((len(session.stations), session.machine.n_legs), dtype=bool)
    used = measured & (estimate.edge_weights >= INLIER_WEIGHT)
    visible[station[used], measurements.edges.leg[used]] = True
    few = visible.sum(axis=1) < _fewest_legs(session.machine)
    lost = ((2 * inliers < count) | (inliers < _OPTIONS.fewest_edges) | few) & ~by_board
    return {
        k: EDGES_DISAGREE_REASON if lost[k] else CAMERA_TURNED_REASON
        for k, station in enumerate(session.stations)
        if station.handheld and (lost[k] or astray[k])
    }


def without_stations(
    case: Case, wrong: Mapping[int, str], edges: EdgeSet, estimate: Estimate
) -> Case:
    """Case without some stations, with the scene of an estimate that included them.

    wrong : reasons by station number.
    edges : measurements of the estimate.
    """
    state = estimate.state
    mine = {p.station: edges.select(edges.station == p.station) for p in case.images}
    scene = case.scene._replace(
        machine=estimate.machine, T_camera_base=state.T_camera_base,
        T_base_platform=state.T_base_platform, edges=mine,
    )  # fmt: skip
    return _without(case._replace(scene=scene), wrong, dict(enumerate(scene.T_camera_base)))


def why_lost(hypotheses: PoseHypotheses, probability: float) -> str:
    """Reason, as text, why an image could not be localized.

    probability : of a rival, by :func:`_rival_probabilities`.
    """
    if probability > hypotheses.rival_probability:
        return (
            "its edges fit the legs no better than other images' edges fit from wrong places;"
            f" the right one was missed with probability {brief(probability)}"
        )
    return (
        "its edges fit the legs nearly as well from another place, which with probability"
        f" {brief(probability)} is the right one"
    )


def _without(case: Case, lost: Mapping[int, str], tried: Mapping[int, Array]) -> Case:
    """Case without rejected stations, the others renumbered.

    Raises `InputError` if no hand-held image remains, or only one configuration.

    lost : reasons by station number. tried : most likely T_camera_base of these.
    """
    session, scene = case.session, case.scene
    by_hand = [k for k, station in enumerate(session.stations) if station.handheld]
    # an error if no hand-held image, or a single configuration, remains
    if by_hand and lost.keys() >= set(by_hand):
        raise InputError(
            "the machine was localized in none of the hand-held images",
            where=f"session.yaml, stations.{session.stations[by_hand[0]].entry}",
            found=f"{session.label(by_hand[0])}: {lost[by_hand[0]]}",
            expected="one place for each where its legs lie on image edges far oftener"
            " than elsewhere",
            next_step="Check that these images show this machine's legs, large and sharp, that"
            " each bears the name of its configuration, and that the nominal model is this"
            " machine's",
        )
    # new station numbers, and the parts of session, images, boards and scene
    retained = [k for k in range(len(session.stations)) if k not in lost]
    number = {k: new for new, k in enumerate(retained)}
    trackers = range(len(session.stations), len(scene.T_camera_base))
    remainder = session.without(lost, tried)
    rows = {photo.configuration for s in remainder.stations for photo in s.images}
    if len(rows) < 2:
        names = [session.configurations[k] for k in sorted(rows)]
        raise InputError(
            "the localized images show one configuration only",
            where=f"session.yaml, stations.{session.stations[(by_hand or [*lost])[0]].entry}",
            found=f"{listed(names)}; {remainder.rejected[0].finding.text}"
            if remainder.rejected
            else listed(names),
            expected="two at least",
            next_step="Take images in which all legs are large and before a plain background",
        )
    T_camera_base = scene.T_camera_base[[*retained, *trackers]]
    edges = {number[k]: results for k, results in scene.edges.items() if k in number}
    return Case(
        remainder,
        [replace(p, station=number[p.station]) for p in case.images if p.station in number],
        case.boards.of(np.array(retained, dtype=int)),
        scene._replace(T_camera_base=T_camera_base, edges=edges, prior=None),
    )
