"""Localization of a station in its images from a pose set by hand, as `calibrate` begins."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.observe.distance_tables import distance_tables
from pkmcal.observe.image_localization import localize_image, localize_near, weighed_poses
from pkmcal.observe.pose_likelihood import StationView
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.station_localization import LOCALIZATION_OPTIONS, find_station
from pkmcal.viewing.content import SessionContent
from pkmcal.viewing.overlay import (
    overlay_after_gesture,
    pane_of,
    pin_offsets,
    placed_by_hand,
    pose_rows,
)
from pkmcal.web.session_document import LocalizationAnswer, ViewRequest
from pkmcal.wording import brief, count

FIT_IMAGES = 16
"""Images of a station that are used.

A search uses eight and verifies with the others, in about a second; `calibrate` uses up to 64.
"""
FEWEST_FITTED_TOGETHER = 2
"""Fewest images of which some can verify the pose that the others give."""
LEAST_CHANCE_DISPLAYED = 1e-9
"""Probability below which no digits are displayed."""


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
    unplaced = station.T_camera_base is None and np.allclose(
        start, pane_of(content, request).T_camera_base
    )
    near = None if request.anywhere or unplaced else start
    # several images verify each other
    view = _search_view(content, request.station)
    many = len(view.configuration) >= FEWEST_FITTED_TOGETHER
    if many:
        localized, sure, text = _from_images(view, None if request.anywhere else start)
    else:
        image = content.image(request.station, request.image)
        localized, sure, text = _from_one_image(view, image, near)
    if sure and request.pins:
        # a leg's silhouettes allow it to slide along itself; the joints that a person placed do not
        off = pin_offsets(content, request, localized)
        off = off[off > pin_offsets(content, request, start)]
        if off.size:
            sure, text = (
                False,
                (
                    f"Not placed: the best fit moves a joint that you placed by {off.max():.0f} px"
                    " more than your hand and the nominal model allow, so your place is retained."
                ),
            )
    pose = localized if sure else start
    # overlay at the localized pose, without the gesture and pins that led to the start
    plain = {"pose": pose_rows(pose), "gesture": None, "pins": ()}
    overlay = overlay_after_gesture(content, request.model_copy(update=plain))
    return LocalizationAnswer(localized=sure, text=text, overlay=overlay)


def _from_images(view: StationView, start: Array | None) -> tuple[Array, bool, str]:
    """Localization from several images: pose, success, and a sentence."""
    pose = find_station(view, start, np.random.default_rng(0))
    shots = count(len(view.configuration), "image")
    if pose.good:
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
    return pose.T_camera_base, pose.good, text


def _from_one_image(
    view: StationView, image: Integers, start: Array | None
) -> tuple[Array, bool, str]:
    """Localization from one image, everywhere and near a start: pose, success, and a sentence."""
    anywhere = localize_image(view, image)
    if start is None:
        near, best = anywhere, anywhere
    else:
        near = localize_near(view, image, start)
        both = np.concatenate([near.T_camera_base, anywhere.T_camera_base])
        best = weighed_poses(view, image, both)
    if best.rival_probability < LOCALIZATION_OPTIONS.rival:
        text = "Placed: from no other place does the machine fit as well."
        return best.T_camera_base[0], True, text
    if start is not None and near.rival_probability < LOCALIZATION_OPTIONS.rival:
        # one image has edges enough for a machine elsewhere; the person knows where it is
        return (
            near.T_camera_base[0],
            True,
            (
                "Placed where it fits best near your place. One image does not exclude others: see"
                " whether the lines lie on the legs."
            ),
        )
    why = f"with probability {brief(best.rival_probability)} another place is the right one"
    return (
        best.T_camera_base[0],
        False,
        f"Not sure: {why}. Bring it to where it is, joint by joint.",
    )


def _search_view(content: SessionContent, s: int) -> StationView:
    """Data of a station for the search, cached because the user fits repeatedly."""
    views: dict[int, StationView] = content.views
    if s not in views:
        session, station = content.session, content.station(s)
        rows = np.array([photo.configuration for photo in station.images])
        few = np.unique(np.linspace(0, len(rows) - 1, min(FIT_IMAGES, len(rows))).astype(int))
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
