"""Localization of all stations: those on tripods by all their images, hand-held images one by one.

Each hand-held image is localized by itself (:mod:`pkmcal.observe.image_localization`), for only the
machine joins it to others, and its candidate poses are scored by the joint estimate
(:mod:`pkmcal.calibration.pose_scoring`), the clearest image first. A board on the base places the
images that see it relative to one that is placed. Images with a sure pose determine the machine
better than the nominal model does, and with their prior the others are scored, again and again,
until none is added. Images without a sure pose are rejected with a reason, for one at a wrong pose
spoils the estimate; so are those in which legs cannot be measured where they are predicted, or of
which the joint estimate rejects most edges: their pose was wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array
from pkmcal.boards.views import Boards
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.calibration.localization import CalibrationProgress, Recognition, locate_stations
from pkmcal.calibration.pose_scoring import ScoredPoses, register_images, rescore_poses
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import angle_between, inverse
from pkmcal.identify.bundle import MarginalPrior
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet, Measurements
from pkmcal.observe import legs
from pkmcal.observe.background import Landmarks, Neighbour, Surroundings
from pkmcal.observe.distance_tables import distance_tables
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.image_localization import SAME_PLACE_TURN, PoseHypotheses, localize_image
from pkmcal.observe.pose_likelihood import StationView
from pkmcal.observe.predict import LegsInCamera, legs_in_camera
from pkmcal.outcome.finding import Finding, note
from pkmcal.session.load import Session
from pkmcal.wording import brief, listed

MISPLACED_PROBABILITY = 0.05
"""Probability that any image of a session is placed at a wrong pose."""
CANDIDATES_SCORED_AGAIN = 4
"""Candidate poses of an image that are scored again whatever their likelihood with a better
machine: one image at a wrong pose spoils that machine."""
RESCORING_GROWTH = 1.25
"""Growth of the number of placed images from which the others are scored anew."""
EDGES_DISAGREE_REASON = "too few of its edges agree with the other photographs"
CAMERA_TURNED_REASON = "all photographs together turn its camera by more than ten degrees"
"""Reasons for the rejection of images that were localized and have a wrong pose."""
MOST_TURN = SAME_PLACE_TURN / 2
"""Turn (rad) of the estimate from the localized pose from which this was wrong."""
FEWEST_LEGS, FEWEST_EDGES = 4, 4
"""Least number of legs of an image, if the machine has so many, and of edges, by which its pose is
determined. A pose and a focal length are seven numbers; each edge gives two, and each leg little
more, so with three legs no leg contradicts a wrong match of another."""


@dataclass(frozen=True)
class Localization:
    """Localization of a session's stations.

    recognition : of the machine in images on tripods, None where none was searched. places : pose
    hypotheses of each hand-held image, by its station's number. result : the case without rejected
    hand-held images, or the error for which there is none.
    """

    recognition: Recognition | None
    places: Mapping[int, PoseHypotheses]
    result: Case | PkmcalError


def localize_case(
    session: Session,
    photographs: list[Photographs],
    boards: Boards,
    rng: np.random.Generator,
    progress: CalibrationProgress | None = None,
) -> Case:
    """The case of a session with all stations localized, as of :func:`localize`.

    Raises `InputError`, or `ResultError`, where nothing determines the pose of a station that is
    not hand-held, and where no hand-held image is placed.
    """
    value = localize(session, photographs, boards, rng, progress).result
    if isinstance(value, PkmcalError):
        raise value
    return value


def localize(
    session: Session,
    photographs: list[Photographs],
    boards: Boards,
    rng: np.random.Generator,
    progress: CalibrationProgress | None = None,
) -> Localization:
    """Localize all stations; hand-held images that are not placed are rejected with a reason.

    photographs : of all stations that observe legs. progress : called with the step in words and
    the share done. Nothing is raised.
    """
    fixed = [p for p in photographs if not session.stations[p.station].handheld]
    search = locate_stations(session, fixed, boards, rng, progress)
    places: dict[int, PoseHypotheses] = {}
    if search.error is not None:
        return Localization(search.recognition, places, search.error)
    scene = PriorScene.as_drawn(session.machine, search.T_camera_base, session.joints)
    lost: dict[int, str] = {}
    if len(fixed) < len(photographs):
        places, scene = search_by_hand(session, photographs, boards, scene, progress)
        nowhere = {k for k in places if np.isnan(scene.T_camera_base[k]).any()}
        sure = _sure(places, len(places))
        lost = {k: EDGES_DISAGREE_REASON if k in sure else why_lost(places[k]) for k in nowhere}
        for k in sorted(places.keys() & scene.edges.keys()):
            turn = angle_between(scene.T_camera_base[k], places[k].T_camera_base[0])
            if turn > MOST_TURN and k in sure:
                lost[k] = CAMERA_TURNED_REASON
    case = Case(session, photographs, boards, scene)
    if len(fixed) < len(photographs):
        try:
            case = _without(case, lost)
        except PkmcalError as error:
            return Localization(search.recognition, places, error)
    return Localization(search.recognition, places, case)


def search_by_hand(
    session: Session,
    photographs: list[Photographs],
    boards: Boards,
    scene: PriorScene,
    progress: CalibrationProgress | None = None,
) -> tuple[dict[int, PoseHypotheses], PriorScene]:
    """Pose hypotheses of each hand-held image, by its station's number; and the scene with those
    that are accepted, T_camera_base NaN for the others.

    photographs : of all stations that observe legs. scene : of the nominal model, with
    T_camera_base of the stations that are placed already, NaN for the others. progress : called
    with the step in words and the share done.
    """
    first = np.zeros(1, dtype=int)  # of a camera on a tripod it stands for all
    at = {p.station: p.select(first) for p in photographs}
    by_hand = [k for k in at if session.stations[k].handheld]
    room = Surroundings(lambda k: (at[k].images[0], at[k].camera))
    answers: dict[int, _CachedHypotheses] = {}
    drawn = so_far = _LocalizationState(scene)

    def hypotheses() -> dict[int, PoseHypotheses]:
        return {k: answer.places for k, answer in answers.items() if answer.scores is not None}

    def step(text: str, share: float) -> None:
        if progress is not None:
            progress(text, share)

    def rescore(some: Sequence[int]) -> None:
        search = partial(_search, session, room, so_far)
        now = pool.map(search, [at[k] for k in some], [answers[k] for k in some])
        answers.update(zip(some, now, strict=True))

    def believed() -> Array:
        return _believed(hypotheses(), len(by_hand), boards, scene.T_camera_base)

    with ThreadPoolExecutor(THREADS) as pool:
        alone = pool.map(partial(_image_hypotheses, session, scene), [at[k] for k in by_hand])
        for k, one in zip(by_hand, alone, strict=True):
            answers[k] = _CachedHypotheses(one, one)
            step(f"Placing photographs by hand: {len(answers)} of {len(by_hand)}", 0.2)
        # the clearer half tells a machine, with which the others are asked
        clearer = sorted(by_hand, key=lambda k: answers[k].hypotheses.rival_probability)
        half = (len(clearer) + 1) // 2
        step(f"Asking the {half} clearest of {len(by_hand)} photographs", 0.25)
        rescore(clearer[:half])
        so_far = _with_sure(session, at, room, so_far, believed(), boards)
        step(f"Asking the others, with {len(so_far.placed)} photographs placed", 0.25)
        rescore(clearer[half:])
        for k, one in _on_board(hypotheses(), boards).items():
            answers[k] = replace(answers[k], places=one)
        before, so_far = drawn, _with_sure(session, at, room, so_far, believed(), boards)
        while so_far.scene is not before.scene:
            before, T = so_far, believed()
            unsure = [k for k in by_hand if np.isnan(T[k]).any() or k in so_far.bare]
            placed = len(by_hand) - len(unsure)
            step(f"Asking again, with {placed} of {len(by_hand)} photographs placed", 0.3)
            rescore(unsure)
            so_far = _with_sure(session, at, room, so_far, believed(), boards)
    out = believed()
    for k in by_hand:
        if k in so_far.scene.edges:
            out[k] = so_far.scene.T_camera_base[k]
        elif k in so_far.bare:
            out[k] = np.nan
    untested = tuple(_untested(session, so_far, answers, out))
    return hypotheses(), so_far.scene._replace(T_camera_base=out, findings=untested)


def _untested(
    session: Session,
    so_far: _LocalizationState,
    answers: Mapping[int, _CachedHypotheses],
    T_camera_base: Array,
) -> Iterator[Finding]:
    """Notes on hypotheses that could not be tested, for images without a pose in the end."""
    if so_far.failure:
        yield note("image.not_taken_together", why=so_far.failure.rstrip("."))
    for k, answer in answers.items():
        failures = answer.scores.failures if answer.scores else ()
        if failures and np.isnan(T_camera_base[k]).any():
            label, why = session.label(k), failures[0].rstrip(".")
            yield note("image.places_untested", label, number=len(failures), why=why)


class _LocalizationState(NamedTuple):
    """State of the joint localization: the scene, the placed images, and their landmarks.

    bare : images in which too few legs can be measured at their accepted pose. failure : why the
    last accepted images could not be estimated together with the others.
    """

    scene: PriorScene
    placed: Mapping[int, Neighbour] = MappingProxyType({})
    landmarks: Mapping[int, Landmarks] = MappingProxyType({})
    bare: frozenset[int] = frozenset()
    failure: str = ""


@dataclass(frozen=True)
class _CachedHypotheses:
    """Pose hypotheses of one image, cached.

    hypotheses : by the search in this image alone. places : by all evidence. scores : by the joint
    estimate, None where they were not scored. by : marginal prior on the machine with which they
    were scored, None for the nominal model; beside : number of images in that prior.
    """

    hypotheses: PoseHypotheses
    places: PoseHypotheses
    scores: ScoredPoses | None = None
    by: MarginalPrior | None = None
    beside: int = 0


def _with_sure(
    session: Session,
    photographs: Mapping[int, Photographs],
    room: Surroundings,
    so_far: _LocalizationState,
    believed: Array,
    boards: Boards,
) -> _LocalizationState:
    """The state with all accepted images; unchanged where there are no further ones."""
    scene = so_far.scene
    sure = {k: T for k, T in enumerate(believed) if k in photographs and not np.isnan(T).any()}
    new = {k: T for k, T in sure.items() if k not in scene.edges}
    if not new:
        return so_far
    try:
        joined = register_images(session, photographs, scene, new, boards)
        # silhouettes are found anywhere; legs can be measured where they are
        bare = frozenset(
            k
            for k in new
            if session.stations[k].handheld
            and k not in boards.stations
            and _too_few_edges(joined, photographs[k])
        )
        if bare == new.keys():
            return so_far._replace(bare=bare) if bare != so_far.bare else so_far
        if bare:
            rest = {k: T for k, T in new.items() if k not in bare}
            joined = register_images(session, photographs, scene, rest, boards)
        scene = joined
    except PkmcalError as error:
        return so_far._replace(failure=str(error))
    placed: dict[int, Neighbour] = {}
    for k in sorted(scene.edges):
        p, T = photographs[k], scene.T_camera_base[k]
        placed[k] = Neighbour(p.camera, T, _legs(session, p, scene, T)[0])
    return _LocalizationState(scene, placed, room.landmarks(placed), bare)


def _too_few_edges(scene: PriorScene, photograph: Photographs) -> bool:
    """Whether too few legs can be measured in an image at its pose."""
    p, machine = photograph, scene.machine
    T, poses = scene.T_camera_base[p.station], scene.T_base_platform[p.configuration]
    visible = np.unique(legs.measure(p, machine, T, poses).edges.leg)
    return len(visible) < min(FEWEST_LEGS, machine.n_legs)


def _image_hypotheses(
    session: Session, scene: PriorScene, photograph: Photographs
) -> PoseHypotheses:
    """Pose hypotheses of an image by the search in it alone."""
    p = photograph
    view = StationView(
        scene.machine, p.camera, p.configuration, session.joints, scene.T_base_platform,
        distance_tables([p.images[0]]),
    )  # fmt: skip
    return localize_image(view, p.images[0])


def _search(
    session: Session,
    room: Surroundings,
    so_far: _LocalizationState,
    photograph: Photographs,
    before: _CachedHypotheses,
) -> _CachedHypotheses:
    """Pose hypotheses of an image, earlier ones among them, by its legs and by the background that
    it shares with placed images.

    Once images determine the machine, the search is repeated with it, once: later ones change the
    machine by little. Poses that were scored with nearly the same machine are not scored again.
    """
    p, scene, placed, k = photograph, so_far.scene, so_far.placed, photograph.station
    alone, scores, by, beside = before.hypotheses, None, scene.prior, len(placed)
    if scene.prior is not None:
        if before.by is None:
            alone = _image_hypotheses(session, scene, p)
        elif len(placed) < RESCORING_GROWTH * before.beside and scene.prior.like(before.by):
            scores, by, beside = before.scores, before.by, before.beside
    likely = before.places.T_camera_base[:CANDIDATES_SCORED_AGAIN]
    others = np.concatenate([room.place(k, so_far.landmarks), likely])
    if placed:
        axes = _legs(session, p, scene, alone.T_camera_base)
        others = np.concatenate([others, room.about(alone, k, p.camera, axes, placed)])
    closer, scores = rescore_poses(session, p, scene, alone, others, scores)
    axes = _legs(session, p, scene, closer.T_camera_base)
    places = room.weighed(closer, k, p.camera, axes, placed)
    return _CachedHypotheses(alone, places, scores, by, beside)


def _legs(
    session: Session, photograph: Photographs, joined: PriorScene, T_camera_base: Array
) -> LegsInCamera:
    """Leg axes (H, L, 3) of an image from camera poses (H, 4, 4), or (1, L, 3) from one."""
    first = photograph.configuration[:1]
    pose, readings = joined.T_base_platform[first], session.joints[first]
    return legs_in_camera(joined.machine, T_camera_base, pose, readings)


def _on_board(
    hypotheses: Mapping[int, PoseHypotheses], boards: Boards
) -> dict[int, PoseHypotheses]:
    """Pose hypotheses of the images that see a board on the base, by all of them: the board's pose
    on the base is one unknown, for which each hypothesis of each image is a vote.

    The pose of an image is its own where that agrees with the board, and the board's where none
    does.
    """
    T_camera_board = {
        k: visible.stood.T_camera_board
        for k, visible in boards.stations.items()
        if k in hypotheses and visible.stood is not None
    }
    if len(T_camera_board) < 2:
        return {}
    candidates = [inverse(T) @ hypotheses[k].T_camera_base for k, T in T_camera_board.items()]
    T_board_base = np.concatenate(candidates)
    total = np.zeros(len(T_board_base))
    own: dict[int, Array] = {}
    for k, T in T_camera_board.items():
        places, log_likelihood_ratio = (
            hypotheses[k].T_camera_base,
            hypotheses[k].log_likelihood_ratio,
        )
        same = angle_between((T @ T_board_base)[:, None], places) < SAME_PLACE_TURN
        worth = np.where(same, np.maximum(log_likelihood_ratio, 0.0), 0.0)
        total += worth.max(axis=1)
        best = np.argmax(worth, axis=1)
        agrees = np.take_along_axis(worth, best[:, None], axis=1) > 0
        own[k] = np.where(agrees[..., None], places[best], T @ T_board_base)
    order = np.argsort(-total, kind="stable")
    near = angle_between(T_board_base[order], T_board_base[order[0]]) < SAME_PLACE_TURN
    order = order[~near | (np.arange(len(order)) == 0)]
    return {k: PoseHypotheses(T[order], total[order], 1.0) for k, T in own.items()}


def _sure(hypotheses: Mapping[int, PoseHypotheses], count: int) -> list[int]:
    """Numbers of the stations whose hand-held images are accepted: the surest of the localized
    ones, of ``count`` in all, as many as together have a small probability of error.
    """
    order = sorted(hypotheses, key=lambda k: hypotheses[k].rival_probability)
    together = np.cumsum([hypotheses[k].rival_probability for k in order])
    return [
        k
        for k, fault in zip(order, together, strict=True)
        if fault < MISPLACED_PROBABILITY * len(hypotheses) / count
    ]


def _believed(
    hypotheses: Mapping[int, PoseHypotheses], count: int, boards: Boards, prior_poses: Array
) -> Array:
    """Poses T_camera_base (S, 4, 4) with those of accepted images, and those that a board on the
    base joins to them; NaN for the others.

    count : of all hand-held images, some of which may not be localized yet.
    """
    out = prior_poses.copy()
    for k in _sure(hypotheses, count):
        out[k] = hypotheses[k].T_camera_base[0]
    visible = [None if np.isnan(T).any() else T for T in out]
    joined = boards.joined(visible)
    return np.stack([np.full((4, 4), np.nan) if T is None else T for T in joined])


def inconsistent_poses(
    session: Session, measurements: Measurements, estimate: Estimate, T_camera_base: Array
) -> dict[int, str]:
    """Reasons why poses T_camera_base of hand-held images are wrong, by the station's number: the
    joint estimate turns the camera away, rejects most edges, or has too few edges or legs to
    determine the pose. Images with a board that agrees with the others have their pose from it.
    """
    astray = angle_between(estimate.state.T_camera_base, T_camera_base) > MOST_TURN
    station = measurements.edges.station
    measured = ~measurements.edges.coarse  # silhouettes are found wherever they are looked for
    inliers = np.bincount(station, measured * estimate.edge_weights, len(session.stations))
    count = np.bincount(station, measured, len(session.stations))
    poses = measurements.poses.station
    # trackers have the numbers behind the cameras'
    by_board = np.bincount(poses, estimate.pose_weights, len(session.stations))
    by_board = by_board[: len(session.stations)] >= 0.5
    visible = np.zeros((len(session.stations), session.machine.n_legs), dtype=bool)
    used = measured & (estimate.edge_weights >= 0.5)
    visible[station[used], measurements.edges.leg[used]] = True
    few = visible.sum(axis=1) < min(FEWEST_LEGS, session.machine.n_legs)
    lost = ((2 * inliers < count) | (inliers < FEWEST_EDGES) | few) & ~by_board
    return {
        k: EDGES_DISAGREE_REASON if lost[k] else CAMERA_TURNED_REASON
        for k, station in enumerate(session.stations)
        if station.handheld and (lost[k] or astray[k])
    }


def without_misplaced(
    case: Case, wrong: Mapping[int, str], edges: EdgeSet, estimate: Estimate
) -> Case:
    """The case without some stations, each rejected for its reason, and with the scene of an
    estimate of all. edges : from which the estimate was made.
    """
    state = estimate.state
    mine = {p.station: edges.select(edges.station == p.station) for p in case.photographs}
    scene = case.scene._replace(
        machine=estimate.machine, T_camera_base=state.T_camera_base,
        T_base_platform=state.T_base_platform, edges=mine,
    )  # fmt: skip
    return _without(case._replace(scene=scene), wrong)


def why_lost(hypotheses: PoseHypotheses) -> str:
    """Why an image could not be placed, in words."""
    return (
        "its edges fit the legs nearly as well from another place, which with probability"
        f" {brief(hypotheses.rival_probability)} is the right one"
    )


def _without(case: Case, lost: Mapping[int, str]) -> Case:
    """The case without ``lost`` stations, each rejected for its reason, the others renumbered.

    Raises `InputError` where no hand-held image is left, or one configuration only.
    """
    session, scene = case.session, case.scene
    by_hand = [k for k, station in enumerate(session.stations) if station.handheld]
    if by_hand and lost.keys() >= set(by_hand):
        raise InputError(
            "the machine is recognised in none of the photographs by hand",
            where=f"session.yaml, stations.{session.stations[by_hand[0]].entry}",
            found=f"{session.label(by_hand[0])}: {lost[by_hand[0]]}",
            expected="one place for each where its legs lie on edges of the picture far oftener"
            " than elsewhere",
            next_step="Check that these photographs show this machine's legs, large and sharp, that"
            " each bears the name of its configuration, and that the drawing is this machine's",
        )
    retained = [k for k in range(len(session.stations)) if k not in lost]
    number = {k: new for new, k in enumerate(retained)}
    trackers = range(len(session.stations), len(scene.T_camera_base))
    remainder = session.without(lost)
    rows = {photo.configuration for s in remainder.stations for photo in s.photographs}
    if len(rows) < 2:
        names = [session.configurations[k] for k in sorted(rows)]
        raise InputError(
            "the photographs that are recognised show one configuration only",
            where=f"session.yaml, stations.{session.stations[(by_hand or [*lost])[0]].entry}",
            found=f"{listed(names)}; {remainder.rejected[0].finding.text}"
            if remainder.rejected
            else listed(names),
            expected="two at least",
            next_step="Take photographs in which all legs are large and before a plain background",
        )
    T_camera_base = scene.T_camera_base[[*retained, *trackers]]
    edges = {number[k]: results for k, results in scene.edges.items() if k in number}
    return Case(
        remainder,
        [replace(p, station=number[p.station]) for p in case.photographs if p.station in number],
        case.boards.of(np.array(retained, dtype=int)),
        scene._replace(T_camera_base=T_camera_base, edges=edges, prior=None),
    )
