"""Where all stations stand: those on a tripod as recognised, photographs by hand one by one.

Each photograph by hand is searched by itself (:mod:`pkmcal.observe.image_localization`), for
nothing but the machine joins it to others, and from the places that it could show it is looked at
more closely (:mod:`pkmcal.calibration.pose_scoring`), the clearest first. A board on the base
places those that see it beside one that is placed. Those that are sure tell the machine better than
its drawing, and with that the others are asked, and asked again, until none is added. What stays
unsure is left out and told, for one photograph in a wrong place spoils the rest; so is one in which
legs cannot be measured where they should be, or of which the joint estimate gives up most edges: it
was in a wrong place.
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
from pkmcal.observe.image_localization import PoseHypotheses, localize_image
from pkmcal.observe.pose_candidates import SAME_POSE_TURN, same_pose
from pkmcal.observe.pose_likelihood import StationView
from pkmcal.observe.predict import LegsInCamera, legs_in_camera
from pkmcal.outcome.finding import Finding, note
from pkmcal.session.load import Session
from pkmcal.wording import brief, listed

MISPLACED_PROBABILITY = 0.05
"""Probability that any photograph of a session is believed to be where it is not."""
CANDIDATES_SCORED_AGAIN = 4
"""Places of a photograph that are asked about again, whatever the picture says to a machine that is
known better: one in a wrong place spoils it."""
RESCORING_GROWTH = 1.25
"""By what factor more photographs have told a machine when the others are asked all over again."""
EDGES_DISAGREE_REASON = "too few of its edges agree with the other photographs"
CAMERA_TURNED_REASON = "all photographs together turn its camera by more than ten degrees"
"""Why one is left out that was found in one place and does not belong there."""
MOST_TURN = SAME_POSE_TURN / 2
"""Turn (rad) from where a photograph was placed from which on it does not belong there."""
FEWEST_LEGS, FEWEST_EDGES = 4, 4
"""Legs of a photograph, if the machine has so many, and edges that tell its place. A pose and a
focal length are seven numbers: each edge tells two, and each leg little more, so of three legs none
contradicts another that was taken for something else."""


@dataclass(frozen=True)
class Localization:
    """Where the stations of a session stand, by what their photographs show; nothing raised.

    recognition : of the machine in the photographs on tripods, None where none was searched. places
    : that each photograph by hand could show, by its station's number. result : what is known,
    without the rejected photographs by hand, or why nothing is.
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
    """Where all stations stand, as of :func:`localize`.

    Raises `InputError`, or `ResultError`, where nothing tells where a station stands that is not by
    hand, and where no photograph by hand is placed.
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
    """Where all stations stand; photographs by hand that are not found are rejected, with a reason.

    photographs : of all stations that observe legs. progress : called with the step in words and
    the share done.
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
    """The places that each photograph by hand could show, by its station's number; and what is
    known with those that are believed, T_camera_base NaN for the others.

    photographs : of all stations that observe legs. scene : by the drawing, T_camera_base of the
    stations that are placed already, NaN for the others. progress : called with the step in words
    and the share done.
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
    """Notes on what could not be tested, of the photographs that have no place in the end."""
    if so_far.failure:
        yield note("image.not_taken_together", why=so_far.failure.rstrip("."))
    for k, answer in answers.items():
        failures = answer.scores.failures if answer.scores else ()
        if failures and np.isnan(T_camera_base[k]).any():
            label, why = session.label(k), failures[0].rstrip(".")
            yield note("image.places_untested", label, number=len(failures), why=why)


class _LocalizationState(NamedTuple):
    """What is known when a photograph is asked: the scene, the photographs that are placed, and
    what they show of the room; bare : those in which too few legs can be measured from where they
    were believed to be. failure : why the last photographs that were believed could not be taken
    together with the others.
    """

    scene: PriorScene
    placed: Mapping[int, Neighbour] = MappingProxyType({})
    landmarks: Mapping[int, Landmarks] = MappingProxyType({})
    bare: frozenset[int] = frozenset()
    failure: str = ""


@dataclass(frozen=True)
class _CachedHypotheses:
    """What is known of the places of one photograph.

    hypotheses : by the search in it alone. places : weighed with all that is known. scores : what
    was found out of them, None where they were not asked about. by : the machine that was known
    then, None where it was as drawn; beside : how many photographs had told it.
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
    """What is known with all photographs that are believed; the same where there are no others."""
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
    """Whether too few legs can be measured in a photograph where it is."""
    p, machine = photograph, scene.machine
    T, poses = scene.T_camera_base[p.station], scene.T_base_platform[p.configuration]
    visible = np.unique(legs.measure(p, machine, T, poses).edges.leg)
    return len(visible) < min(FEWEST_LEGS, machine.n_legs)


def _image_hypotheses(
    session: Session, scene: PriorScene, photograph: Photographs
) -> PoseHypotheses:
    """The places of a photograph by the search in it alone."""
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
    """The places that a photograph could show, those of before among them, weighed by its legs and
    by what it shares of the room with those that are placed.

    As soon as photographs have told a machine, it is searched again, once, with that: later ones
    change it by little. Places that were asked with a machine like this one are not asked again.
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
    """Leg axes (H, L, 3) of a photograph taken from places (H, 4, 4), or (1, L, 3) from one."""
    first = photograph.configuration[:1]
    pose, readings = joined.T_base_platform[first], session.joints[first]
    return legs_in_camera(joined.machine, T_camera_base, pose, readings)


def _on_board(
    hypotheses: Mapping[int, PoseHypotheses], boards: Boards
) -> dict[int, PoseHypotheses]:
    """The places of the photographs that see a board on the base, weighed together: where it stands
    on the base is one unknown, and each of their places tells it.

    A photograph's place is its own where that agrees with the board, which knows the drawing no
    better, and the board's where none does.
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


def _sure(hypotheses: Mapping[int, PoseHypotheses], count: int) -> list[int]:
    """The photographs whose places are believed, by the station's number: of those that were found,
    of ``count`` by hand, the surest, as many as together leave little doubt.
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
    """Poses T_camera_base (S, 4, 4) with those of photographs of whose place there is little
    doubt, and those that a board on the base joins to them; NaN for the others.

    count : of all photographs by hand, some of which may not be found yet.
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
    """Why photographs by hand do not belong where they were placed, T_camera_base, by the station's
    number: the joint estimate finds the camera looking another way, has given up most edges, or has
    too few edges or legs to tell the place. A board that agrees with the others tells the place of
    its photograph whatever the edges do.
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
    """What is seen without these stations, each told why, and what is known by an estimate of all.
    edges : from which it was made.
    """
    state = estimate.state
    mine = {p.station: edges.select(edges.station == p.station) for p in case.photographs}
    scene = case.scene._replace(
        machine=estimate.machine, T_camera_base=state.T_camera_base,
        T_base_platform=state.T_base_platform, edges=mine,
    )  # fmt: skip
    return _without(case._replace(scene=scene), wrong)


def why_lost(hypotheses: PoseHypotheses) -> str:
    """Why a photograph could not be placed, in words."""
    return (
        "its edges fit the legs nearly as well from another place, which with probability"
        f" {brief(hypotheses.rival_probability)} is the right one"
    )


def _without(case: Case, lost: Mapping[int, str]) -> Case:
    """What is seen without the stations that are lost, each rejected for a reason, the others
    numbered anew; an error where no photograph by hand is left.
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
