"""Checks of [A]'s four steps, before or after a step, with messages for people.

The papers count equations (``conditions``); these are the tests themselves, the rank of each step's
Jacobian at the nominal model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import ResultError
from pkmcal.identify.methods.four_step_base import Items, StationViews
from pkmcal.identify.methods.four_step_platform import (
    COLLAPSED_LENGTH_SHARE,
    joint_distance_deviations,
)
from pkmcal.identify.methods.leg_axes import Axes, in_base
from pkmcal.identify.methods.registration import fixes_pose, loose, parts_of
from pkmcal.identify.nominal_joints import NominalJoints, nominal_joints
from pkmcal.levels import MAJORITY, NAMED_SHARE, ROUNDING
from pkmcal.mechanisms import Machine
from pkmcal.wording import named

USE_JOINT_METHOD = "use the joint method (bundle)"


def can_be_tried(machine: Machine, edges: int) -> None:
    """Raise ResultError for a machine with moving base joints, and for a session without edges.

    [A] treats legs with one joint fixed to each body, in images of the legs.
    """
    carried = any(group.carrier.driven for group in machine.layout.base)
    for group in machine.layout.platform:
        carried |= group.carrier.turns or group.carrier.floats
    if carried:
        raise ResultError(
            what="the four steps are for legs with one joint on the base and one on the platform",
            found=f"mechanism {machine.name!r} with joints that move on cranks, slides or bars",
            next_step=USE_JOINT_METHOD,
            code="method.other_joints",
        )
    if not edges:
        raise ResultError(
            what="the four steps need images of the legs, and no edge of one was measured",
            next_step=f"take images of the legs, or {USE_JOINT_METHOD} with a board on the"
            " platform",
            code="method.no_edges",
        )


def every_leg_visible(machine: Machine, valid: Booleans) -> None:
    """Raise ResultError for a leg without a base centre, valid (S, L); [A] 3.3, first condition."""
    lost = np.flatnonzero(~valid.any(axis=0))
    if lost.size:
        raise ResultError(
            what=f"leg {lost[0] + 1} of {machine.n_legs} is seen by no station well enough",
            expected="every leg seen in two directions at least, [A] 3.3",
            next_step=f"add configurations or a station, or {USE_JOINT_METHOD}",
            code="method.leg_not_visible",
        )


def stations_are_fixed(items: Items, views: StationViews, machine: Machine) -> None:
    """Raise ResultError for a station that sees too little of the base to determine its pose."""
    few = np.flatnonzero(~items.fixed()[views.of_station])
    if not few.size:
        return
    visible = items.centres_visible[views.of_station[few[0]]]
    which = f" ({named(np.flatnonzero(visible))})" if visible.any() else ""
    need = (
        "two or more"
        if nominal_joints(machine).planar
        else "three or more that are not on one line"
    )
    raise ResultError(
        what=f"station {few[0] + 1} sees too few legs for the four steps",
        found=f"{visible.sum()} base centres{which}",
        expected=f"{need}, each leg seen in two directions",
        next_step=f"give the station's pose, fix a board to the base, or {USE_JOINT_METHOD}",
        code="method.few_legs",
    )


def stations_are_joined(items: Items, views: StationViews) -> None:
    """Raise ResultError for stations that share too few legs, and no board, to be joined
    ([A] 3.3).
    """
    free = free_ways(items)
    if not free.shape[-1]:
        return
    in_view = items.visible[items.fixed()]
    parts = parts_of(items.nominal, in_view, free, items.n_directions)
    a, b = (np.flatnonzero(part[: len(items.drawn)]) for part in parts)
    sees = [
        f"station {s + 1} sees {named(np.flatnonzero(items.centres_visible[view]))}"
        for s, view in enumerate(views.of_station)
    ]
    raise ResultError(
        what=f"the stations share too few legs: the base joints of {named(a)} can "
        f"move against those of {named(b)}",
        found="; ".join(sees),
        expected="stations that share three legs, or fewer with revolute axes, [A] 3.3",
        next_step="fix a calibration board to the base where the stations see it, or let a "
        f"station see more legs, or {USE_JOINT_METHOD} with the stations' poses",
        code="method.stations_apart",
    )


def free_ways(items: Items) -> Array:
    """Unidentifiable directions (L + D, 3, f): motions of base joints against others in
    all views.
    """
    return loose(items.nominal, items.visible[items.fixed()], items.n_directions)


def platform_is_identifiable(machine: Machine, axes: Axes, usable: Booleans, form: str) -> None:
    """Raise ResultError unless enough legs with a length are seen together, [A] 3.5."""
    legs = nominal_joints(machine)
    visible = axes.visible & usable[axes.station][:, None]
    if form == "corrected":
        configurations, row = np.unique(axes.configuration, return_inverse=True)
        together = np.zeros((len(configurations), visible.shape[1]), dtype=bool)
        np.logical_or.at(together, row, visible)
        visible = together
    at_once = visible & legs.closing
    posed = fixes_pose(legs.platform, at_once, motion=legs.motion)
    if not posed.any():
        _too_few_at_once(legs, at_once)
    closing_data = (legs.platform[legs.closing], at_once[np.ix_(posed, legs.closing)])
    free = loose(*closing_data, motion=legs.motion)
    if free.shape[-1]:
        a, b = parts_of(*closing_data, free, motion=legs.motion)
        names = np.flatnonzero(legs.closing)
        raise ResultError(
            what=f"the platform joints of {named(names[a])} can move against those of "
            f"{named(names[b])}",
            found="no configurations that show enough of both at once",
            expected="each leg seen at once with others that fix the platform, [A] 3.5",
            next_step=f"take images of the same configurations from more stations,"
            f" or {USE_JOINT_METHOD}",
            code="method.legs_apart",
        )
    _needs_poses(legs, visible & posed[:, None])


def _too_few_at_once(legs: NominalJoints, at_once: Booleans) -> None:
    turns = np.any(legs.motion[:3], axis=1)
    need = "three or more, not on one line" if turns.all() else "one or more"
    if turns.any() and not turns.all():  # rotation about z only
        need = "two or more" + ("" if legs.planar else ", not one above the other")
    raise ResultError(
        what="no configuration shows enough legs with a length at once to place the platform",
        found=f"{at_once.sum(axis=1).max(initial=0)} at most",
        expected=f"{need}, [A] 3.5",
        next_step=f"let a station see more legs, image one configuration from several "
        f"stations, or {USE_JOINT_METHOD}",
        code="method.few_legs_at_once",
    )


def _needs_poses(legs: NominalJoints, visible: Booleans) -> None:
    """Raise ResultError for a passive leg or revolute axis seen in fewer than two poses."""
    for which, what in (
        (~legs.closing, "passive leg {}'s platform joint"),
        (legs.platform_revolute, "the revolute axis of leg {} on the platform"),
    ):
        short = np.flatnonzero(which & (visible.sum(axis=0) < 2))
        if short.size:
            raise ResultError(
                what=what.format(short[0] + 1) + " cannot be found",
                found=f"seen in {visible[:, short[0]].sum()} configurations together with enough "
                "legs with a length",
                expected="two directions at least, with three legs with a length at once, [A] 3.5",
                next_step=f"add configurations or a station that sees it, or {USE_JOINT_METHOD}",
                code="method.joint_unidentifiable",
            )


def lengths_are_fixed(
    machine: Machine, axes: Axes, usable: Booleans, base: Array, T_camera_base: Array, q0: Array
) -> None:
    """Raise ResultError for unidentifiable lengths, [A] 3.4.

    A length is unidentifiable if the distances between platform joints do not depend on it.
    base : (1, L, 3), T_camera_base : (1, S, 4, 4) and offsets q0 : (1, L), results of the steps.
    """
    legs = nominal_joints(machine)
    not_collapsed(legs, q0[0])
    case = axes.visible & usable[axes.station][:, None] & legs.closing
    merged = in_base(replace(axes, visible=case), T_camera_base)
    a = np.broadcast_to(base[:, None], merged.u.shape)
    value, slopes = (rows[0] for rows in joint_distance_deviations(merged, a, q0, "corrected"))
    freedom = max(np.count_nonzero(np.any(slopes, axis=1)) - int(legs.closing.sum()), 1)
    values, vectors = np.linalg.eigh(slopes[:, legs.closing].T @ slopes[:, legs.closing])
    sigma = np.sqrt(np.sum(value**2) / freedom / np.maximum(values, 1e-300))
    length = float(np.mean(legs.rod[legs.closing] + merged.readings[0][:, legs.closing]))
    # no derivative but rounding (each image's is at most 1), or more noise than length
    free = (values < ROUNDING * len(merged.configuration)) | (sigma > MAJORITY * length)
    if not free.any():
        return
    part = np.abs(vectors[:, free]).max(axis=1)
    names = np.flatnonzero(legs.closing)[part > NAMED_SHARE * part.max()]
    raise ResultError(
        what=f"the images do not determine the lengths of {named(names)}",
        found="distances between platform joints that do not depend on a combination of them",
        expected="legs that change their directions against each other, seen at once, [A] 3.4",
        next_step=f"add configurations that tilt and turn the platform more, or {USE_JOINT_METHOD}",
        code="method.lengths_unidentifiable",
    )


def not_collapsed(legs: NominalJoints, q0: Array) -> None:
    """Raise ResultError for a constant length in the false minimum of [A] 14, where B = A."""
    short = np.flatnonzero(legs.constant & (q0 < COLLAPSED_LENGTH_SHARE * legs.rod))
    if short.size:
        raise ResultError(
            what=f"leg {short[0] + 1} of constant length shrank to nothing in the third step",
            found=f"{1e3 * q0[short[0]]:.0f} mm",
            expected=f"about {1e3 * legs.rod[short[0]]:.0f} mm as drawn; at zero length both its "
            "joints fall together, which fits the images for a wrong reason",
            next_step=f"check the nominal model's length, add configurations, or"
            f" {USE_JOINT_METHOD}",
            code="method.length_collapsed",
        )


def passive_legs_are_fixed(machine: Machine, platform: Array) -> None:
    """Raise ResultError for a passive leg (NaN centre) with a single direction on the platform, [A]
    19.
    """
    lost = np.flatnonzero(np.isnan(platform[0, :, 0]))
    if lost.size:
        raise ResultError(
            what=f"passive leg {lost[0] + 1} of {machine.n_legs} does not change its direction "
            "on the platform, so its joint could lie anywhere along it",
            expected="two directions at least, [A] 3.5",
            next_step=f"add configurations that tilt or shift the platform, or {USE_JOINT_METHOD}",
            code="method.leg_one_direction",
        )
