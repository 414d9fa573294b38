"""Localization of a station in its images from a pose set by hand, as `calibrate` begins."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, evenly
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import angle_between
from pkmcal.levels import OUTLIER_SIGMAS
from pkmcal.observe.distance_tables import distance_tables
from pkmcal.observe.image_localization import (
    localize_image,
    localize_near,
    log_prior_by_hand,
    symmetric_poses,
    with_neighbours,
)
from pkmcal.observe.pose_likelihood import StationView
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.station_localization import LOCALIZATION_OPTIONS, LocalizedPose, find_station
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS
from pkmcal.viewing.content import SessionContent
from pkmcal.viewing.gestures import HAND_POSE_SIGMA
from pkmcal.viewing.overlay import (
    overlay_after_gesture,
    pane_of,
    pin_distances,
    placed_by_hand,
    pose_rows,
    poses_by_pins,
)
from pkmcal.web.session_document import LocalizationAnswer, ViewRequest
from pkmcal.wording import brief, count

FIT_IMAGES = 16
"""Images of a station that are used.

A search uses eight and verifies with the others, in about a second; `calibrate` uses up to 64.
"""
FEWEST_FITTED_TOGETHER = 2
"""Fewest images of which some can verify the pose that the others give."""
MOST_PLACES = 5
"""Poses between which a person can choose."""
DISTINCT_DEGREES = 1.0
"""Rotation, degrees, from which two poses are told apart in words: a text has no decimals."""
LEAST_CHANCE_DISPLAYED = 1e-9
"""Probability below which no digits are displayed."""


class _Judgement(NamedTuple):
    """Poses (H, 4, 4), likeliest first, whether the machine is localized at the first, and the
    reason as text.
    """

    T_camera_base: Array
    localized: bool
    text: str


class _PlacedJoints(NamedTuple):
    """Joints that a person placed, with the pose (4, 4) at which they are, and numbered legs."""

    content: SessionContent
    request: ViewRequest
    start: Array

    def log_likelihood(self, T_camera_base: Array) -> float:
        """Log-likelihood, nats, of what was placed at a pose (4, 4)."""
        distance, sigma = pin_distances(self.content, self.request, T_camera_base)
        return -0.5 * float(np.sum((distance / sigma) ** 2))

    def contradiction(self, T_camera_base: Array) -> float:
        """Largest distance, px, by which a pose (4, 4) moves a joint farther than its error allows,
        beyond the same at the start, or has a leg beside its number; 0 for none.
        """
        # a leg's silhouettes allow it to slide along itself; the joints placed by hand do not
        off, at_start = (
            np.maximum(distance - OUTLIER_SIGMAS * sigma, 0.0)
            for distance, sigma in (
                pin_distances(self.content, self.request, T) for T in (T_camera_base, self.start)
            )
        )
        # numbers do not move the machine, so nothing is known of them at the start
        numbered = np.array([pin.end == "axis" for pin in self.request.pins], dtype=bool)
        return float(off[(off > at_start) | numbered].max(initial=0.0))


def localized_overlay(content: SessionContent, request: ViewRequest) -> LocalizationAnswer:
    """Localized pose with its overlay, and in words how certain the pose is.

    The search starts at the request's pose, or everywhere. Without success the pose remains
    unchanged. Raises InputError for a station without legs to be localized by.
    """
    station = content.station(request.station)
    if "legs" not in station.observe or not len(tubes_of(content.session.machine)):
        raise InputError(
            "there are no legs to be localized by at this station",
            where=f"session.yaml, stations.{station.entry}",
            found="observe: board" if "legs" not in station.observe else "legs without tubes",
            next_step="Its place is found from the board when you calibrate",
        )
    start = placed_by_hand(content, request).T_camera_base
    joints = _PlacedJoints(content, request, start)
    # several images verify each other
    view = _search_view(content, request.station)
    if len(view.configuration) >= FEWEST_FITTED_TOGETHER:
        judgement = _from_images(view, None if request.anywhere else start, joints)
    else:
        judgement = _from_one_image(view, joints)
    poses = judgement.T_camera_base
    # overlay at the localized pose, without the gesture and pins that led to the start
    pose = pose_rows(poses[0] if judgement.localized else start)
    plain = {"pose": pose, "gesture": None, "pins": ()}
    open_places = [T for T in poses if not judgement.localized and not joints.contradiction(T)]
    return LocalizationAnswer(
        localized=judgement.localized,
        text=judgement.text,
        overlay=overlay_after_gesture(content, request.model_copy(update=plain)),
        places=tuple(pose_rows(T) for T in open_places[:MOST_PLACES]),
    )


def _from_images(view: StationView, start: Array | None, joints: _PlacedJoints) -> _Judgement:
    """Localization from several images, near a start or everywhere."""
    pose = find_station(view, start, np.random.default_rng(0))
    shots = count(len(view.configuration), "image")
    moved = joints.contradiction(pose.T_camera_base)
    if pose.good and moved:
        text = _contradicted(moved)
    elif pose.good:
        chance = (
            f"{pose.p_value:.0e}"
            if pose.p_value > LEAST_CHANCE_DISPLAYED
            else f"less than {LEAST_CHANCE_DISPLAYED:.0e}"
        )
        text = f"Localized in {shots}: as good a fit by chance has probability {chance}."
    elif pose.second >= LOCALIZATION_OPTIONS.rival:
        text = (
            f"Not sure: from another place the machine fits {shots} nearly as well. Bring it to"
            " where it is, joint by joint."
        )
    else:
        text = (
            f"Not localized in {shots} about this pose. Bring two or three joints to their places"
            " and try again, or check whether nominal model, readings and images"
            " belong together."
        )
    return _Judgement(pose.T_camera_base[None], pose.good and not moved, text)


def _from_one_image(view: StationView, joints: _PlacedJoints) -> _Judgement:
    """Localization from the only image of a station, everywhere and near what a person placed.

    A pose set by hand is as likely as its symmetric poses: a person may take one leg of a machine
    of equal parts for another. Joints that a person placed decide between them.
    """
    content, request = joints.content, joints.request
    s, image = request.station, content.image(request.station, request.image)
    # the search everywhere takes most of the time, and the user fits repeatedly
    if s not in content.poses_anywhere:
        content.poses_anywhere[s] = localize_image(view, image).T_camera_base
    # starts: by the pins, and as the hand set the pose before, with the symmetric ones
    starts = poses_by_pins(content, request)
    by_hand = placed_by_hand(content, request.model_copy(update={"pins": ()})).T_camera_base
    unplaced = content.station(s).T_camera_base is None and np.allclose(
        by_hand, pane_of(content, request).T_camera_base
    )
    has_prior = not (request.anywhere or unplaced)
    if has_prior or request.pins:
        start = joints.start[None]
        starts = np.concatenate([starts, start, symmetric_poses(view, start)])
    near = [localize_near(view, image, T).T_camera_base for T in starts]
    poses = np.concatenate([*near, content.poses_anywhere[s]])

    def pin_evidence(poses: Array) -> Array:
        return np.array([joints.log_likelihood(T) for T in poses])

    def log_prior(poses: Array) -> Array:
        if not has_prior:
            return pin_evidence(poses)
        return pin_evidence(poses) + log_prior_by_hand(view, by_hand, poses, HAND_POSE_SIGMA)

    hypotheses = with_neighbours(view, image, poses, log_prior)
    # poses that a search near the first one reaches are told apart by further images
    first, reach = hypotheses.T_camera_base[0], LOCALIZATION_OPTIONS.near
    beside = np.array([reach.reaches(first, T) for T in hypotheses.T_camera_base])
    rivals = hypotheses.select(np.flatnonzero(~beside | (np.arange(len(beside)) == 0)))
    pose = LocalizedPose.of_image(rivals, has_prior=has_prior)
    equals = hypotheses.select(beside & (hypotheses.probabilities > LOCALIZATION_OPTIONS.rival))
    within = float(np.degrees(angle_between(equals.T_camera_base, first).max(initial=0.0)))
    # pins decide where the image leaves a choice, and do not overrule it
    nats = hypotheses.log_likelihood_ratio / hypotheses.unit - pin_evidence(
        hypotheses.T_camera_base
    )
    overruled = nats[~beside].max(initial=-np.inf) - nats[0] > HYPOTHESIS_THRESHOLDS.report
    probability = brief(pose.p_value)
    moved = joints.contradiction(first)
    if pose.good and moved:
        text = _contradicted(moved)
    elif pose.good and overruled:
        text = (
            "Not placed: at another place the legs fit this image much better than where you put"
            " the joints. Bring another joint to its place, or check the numbers of the legs."
        )
    elif pose.good and within < DISTINCT_DEGREES:
        text = "Placed: from no other place does the machine fit as well."
    elif pose.good:
        text = (
            "Placed: from no other place does the machine fit as well. Poses up to"
            f" {within:.0f}° from this one fit nearly as well; further images tell them apart."
        )
    elif len(rivals.T_camera_base) > 1:
        turn = np.degrees(angle_between(rivals.T_camera_base[1], first))
        text = (
            "Not placed: from several places the machine fits this image nearly as well. The second"
            f" best, turned by {turn:.0f}° against the best, is the right one with probability"
            f" {probability}. Look at them, or number a leg that you know, or bring its joints to"
            " their places: these decide."
        )
    else:
        text = (
            "Not placed: the best fit may be by chance, with probability"
            f" {probability}. Bring it to where it is, joint by joint."
        )
    return _Judgement(rivals.T_camera_base, pose.good and not (moved or overruled), text)


def _contradicted(moved: float) -> str:
    """Sentence on a fit that moves a joint placed by hand by ``moved`` px."""
    return (
        f"Not placed: the best fit moves a joint that you placed, or a leg that you numbered, by"
        f" {brief(moved)} px more than your hand and the nominal model allow, so your place is"
        " retained."
    )


def _search_view(content: SessionContent, s: int) -> StationView:
    """Data of a station for the search, cached because the user fits repeatedly."""
    views: dict[int, StationView] = content.views
    if s not in views:
        session, station = content.session, content.station(s)
        rows = np.array([photo.configuration for photo in station.images])
        few = evenly(len(rows), FIT_IMAGES)
        tables = distance_tables([content.image(s, int(k)) for k in few])
        views[s] = StationView(
            session.machine,
            station.camera,
            rows[few],
            session.joints,
            content.poses,
            tables,
        )
    return views[s]
