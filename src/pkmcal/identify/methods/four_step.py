"""[A] section 3: four steps from leg axes to the machine, as printed and corrected.

1. base joints in each station's camera frame: centres ([A] 6, or [B] 14 on the edges
   themselves), revolute axes (7) — ``leg_axes``;
2. base joints in one frame (8-9), or by a board on the base (3.3) — ``four_step_base``;
3. offsets of the readings and constant lengths (13-14) and
4. platform joints: centres (16), revolute axes (18, 7), passive legs (19), universal axes by
   the inverse kinematics — ``four_step_platform``.

``corrected`` follows the errata: stations and images are joined by rigid registration, offsets
minimize the deviations from each pair's mean distance, and legs that several stations see in one
configuration count as seen together. ``printed`` uses products of distances, consecutive
differences and averaged distances as in the paper.

Arrays: B runs, S stations, C images (one station, one configuration), L legs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import dot, nearest_rotation
from pkmcal.identify.gauge import BestFit, centre_index, default_gauge, in_gauge
from pkmcal.identify.methods import four_step_checks as checks
from pkmcal.identify.methods import linear
from pkmcal.identify.methods.four_step_base import (
    Base,
    Items,
    StationViews,
    base_by_products,
    base_by_registration,
    gathered_directions,
    gathered_points,
    joined_by_boards,
    rough_rotations,
    stations_apart,
    stations_together,
    with_boards,
    with_signs,
)
from pkmcal.identify.methods.four_step_platform import (
    joint_distance_offsets,
    passive_centres,
    platform_axes,
    platform_by_distances,
    platform_by_registration,
    universal_axes,
)
from pkmcal.identify.methods.leg_axes import (
    Axes,
    axes_from_edges,
    centres_from_axes,
    in_base,
    plane_normals,
    revolute_axes,
    through_centres,
)
from pkmcal.identify.methods.registration import (
    RegisteredBody,
    extent,
    fixes_pose,
    poses_laying_items,
)
from pkmcal.identify.nominal_joints import NominalJoints, base_gauge, nominal_joints, platform_gauge
from pkmcal.identify.state import State
from pkmcal.levels import NEGLIGIBLE
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine

FourStepForm = Literal["corrected", "printed"]
VAGUE_CENTRE_SHARE = NEGLIGIBLE**0.5
"""Standard deviation of a base centre, relative to the base's size, above which it is rejected: the
distance of such a centre from another one is biased by the square of this share."""


@dataclass(frozen=True)
class FourSteps:
    """Results of the steps; the frames of a spatial machine are those of three centres.

    base, platform : (B, L, 3) m, the latter NaN for passive legs that are unidentifiable.
    offsets : (B, L) m, zero for passive legs.
    T_camera_base : (B, S, 4, 4).
    base_axes, platform_axes : (B, L, 3) unit, NaN where the machine has none; nominal where
        unidentifiable.
    T_base_platform : (B, K, 4, 4) of the configurations ``configuration`` (K,).
    posed : (K,) whether enough legs with a length were seen together for that pose.
    """

    base: Array
    offsets: Array
    platform: Array
    T_camera_base: Array
    base_axes: Array
    platform_axes: Array
    T_base_platform: Array
    configuration: Integers
    posed: Booleans


# ------------------------------------------------------------------ the steps on leg axes


def base_items(
    machine: Machine, axes: Axes, a_camera: Array, valid: Booleans, views: StationViews
) -> Items:
    """Items of the base in each view: centres, and revolute axes ([A] 7) with their signs.

    a_camera : (B, S, L, 3) centres in the camera frames. valid : (S, L).
    """
    legs, n = nominal_joints(machine), len(valid)
    centres, visible = gathered_points(a_camera, valid, views)
    if legs.planar:
        v, v_valid = plane_normals(axes.u, axes.visible, axes.station, n, axes.information)
    else:
        some = axes.of_legs(np.flatnonzero(legs.base_revolute))
        v, v_valid = revolute_axes(some.u, some.visible, axes.station, n, some.information)
    v, v_valid = gathered_directions(v, v_valid, views)
    items = Items(centres, visible, v, v_valid, legs.base, legs.directions)
    if not items.n_directions:
        return items
    return with_signs(items, rough_rotations(machine, axes, items, views))


def solve_from_centres(
    machine: Machine,
    axes: Axes,
    a_camera: Array,
    valid: Booleans,
    form: FourStepForm,
    views: StationViews | None = None,
) -> FourSteps:
    """Steps 2 to 4 from the base centres in the camera frames, all runs together.

    a_camera : (B, S, L, 3) centres, valid (S, L); the nominal values start the search. views :
    stations that are joined already; by default each station is a view of its own.
    """
    # step 2: base joints in one frame
    legs = nominal_joints(machine)
    views = stations_apart(len(valid)) if views is None else views
    items = base_items(machine, axes, a_camera, valid, views)
    join = base_by_registration if form == "corrected" else base_by_products
    base = join(items, base_gauge(machine, legs))
    T_camera_base = views.T_camera_view @ base.T_view_base[:, views.of_station]
    usable = items.fixed()[views.of_station][axes.station]
    axes = replace(axes, visible=axes.visible & usable[:, None])
    # steps 3 and 4: offsets and platform centres
    merged = in_base(axes, T_camera_base)
    if form == "corrected":
        q0, platform = _ends(machine, legs, merged, base.centres)
    else:
        a_photo = np.where(valid[..., None], a_camera, 0.0)[:, axes.station]
        q0, platform = _ends_printed(machine, legs, axes, a_photo)
    if legs.planar:  # a leg is level, so both its ends have one height
        rise = legs.platform[:, 2] - legs.base[:, 2]
        platform[..., 2] = base.centres[..., 2] + rise

    # pose of each configuration ([A] 18), by the legs with a length
    visible = merged.visible & legs.closing
    b = base.centres[:, None] + (merged.readings + q0[:, None])[..., None] * merged.u
    posed = fixes_pose(legs.platform, visible, motion=legs.motion)
    weight = np.broadcast_to(visible, b.shape[:-1]).astype(float)
    if form == "printed" and legs.motion.shape[1] == 3 and not legs.planar:
        # distances do not determine the rotation of a translating platform against the base frame
        registered = poses_laying_items(platform[:, None], b[:, posed], weight[:, posed])
        rot = registered[..., :3, :3].mean(axis=1)
        platform = platform @ nearest_rotation(rot).mT
    T = poses_laying_items(platform[:, None], b, weight, motion=legs.motion)
    if legs.planar:  # the platform frame keeps its nominal height
        T[..., 2, 3] = np.mean(legs.base[:, 2] - legs.platform[:, 2])
    # passive legs ([A] 19) and joint axes
    if not legs.closing.all():
        rows = merged.visible & posed[:, None]
        passive, determined = passive_centres(merged.u, base.centres, rows, T)
        passive = np.where(determined[:, None], passive, np.nan)
        platform = np.where(legs.closing[:, None], platform, passive)
    v, w = _axes(machine, legs, merged, posed, base, RegisteredBody(platform, T), form)
    return FourSteps(
        base.centres, q0, platform, T_camera_base, v, w, T, merged.configuration, posed
    )


def _ends(machine: Machine, legs: NominalJoints, merged: Axes, base: Array) -> tuple[Array, Array]:
    """Offsets (B, L) and platform centres (B, L, 3), corrected: in the base frame."""
    with_length = replace(merged, visible=merged.visible & legs.closing)
    a = np.broadcast_to(base[:, None], merged.u.shape)
    q0 = joint_distance_offsets(with_length, a, legs.rod, "corrected")
    b = a + (merged.readings + q0[:, None])[..., None] * merged.u
    posed = fixes_pose(legs.platform, with_length.visible, motion=legs.motion)
    gauge = platform_gauge(machine, legs)
    platform = platform_by_registration(
        b[:, posed], with_length.visible[posed], legs.platform, gauge, legs.motion
    )
    return q0, platform


def _ends_printed(
    machine: Machine, legs: NominalJoints, axes: Axes, a_photo: Array
) -> tuple[Array, Array]:
    """Offsets and platform centres as printed: in each image's camera frame; a_photo (B,
    C, L, 3).
    """
    with_length = replace(axes, visible=axes.visible & legs.closing)
    q0 = joint_distance_offsets(with_length, a_photo, legs.rod, "printed")
    b = a_photo + (axes.readings + q0[:, None])[..., None] * axes.u
    gauge = platform_gauge(machine, replace(legs, motion=np.eye(6)))
    if legs.planar:  # distances do not depend on the heights, which are the base's
        heights = np.eye(legs.platform.size)[2::3]
        gauge = np.concatenate([platform_gauge(machine, legs), heights])
    return q0, platform_by_distances(b, with_length.visible, axes.station, legs.platform, gauge)


def _axes(
    machine: Machine,
    legs: NominalJoints,
    merged: Axes,
    posed: Booleans,
    base: Base,
    body: RegisteredBody,
    form: FourStepForm,
) -> tuple[Array, Array]:
    """Axes on base and platform (B, L, 3): revolute by [A] 7, universal by the torsion.

    body : platform centres and its poses, valid where ``posed`` (K,).
    """
    u, visible = merged.u, merged.visible & posed[:, None]
    v = _as_drawn(machine, legs.base_axes, legs.base, base.centres)
    w = _as_drawn(machine, legs.platform_axes, legs.platform, body.points)
    if legs.base_revolute.any():
        v[:, legs.base_revolute] = base.directions
        if form == "corrected":  # more accurate than one station
            valid, determined = revolute_axes(
                u, merged.visible, merged.station, 1, merged.information
            )
            v = _where(determined[0] & legs.base_revolute, valid[:, 0], v)
    if legs.platform_revolute.any():
        valid, determined = platform_axes(u, visible, body.poses, merged.information)
        w = _where(determined & legs.platform_revolute, valid, w)
    j = np.flatnonzero(legs.torsion)
    if j.size:
        tolerance = machine.parameters.tolerance[machine.layout.base_axis[j, 0]]
        drawn, rot = (v[:, j], w[:, j]), body.poses[..., :3, :3]
        v[:, j], w[:, j] = universal_axes(u[:, :, j], rot, visible[:, j], drawn, tolerance)
    return v, w


def _where(legs: Booleans, values: Array, axes: Array) -> Array:
    """Axes (B, L, 3) with some legs' axes replaced by their estimates, on the same side."""
    side = np.where(dot(values, axes) < 0, -1.0, 1.0)[..., None]
    return np.where(legs[:, None], side * values, axes)


def _as_drawn(machine: Machine, axes: Array, drawn: Array, centres: Array) -> Array:
    """Nominal axes (L, 3) in the frame of the estimated centres (B, L, 3), (B, L, 3).

    The nominal model is fitted to all centres: a frame of three centres would add their errors to
    the rotation.
    """
    out = np.tile(axes, (len(centres), 1, 1))
    if np.isnan(axes).all() or isinstance(default_gauge(machine), BestFit):
        return out
    finite = np.isfinite(centres[..., 0]).astype(float)
    rot = poses_laying_items(np.broadcast_to(drawn, centres.shape), np.nan_to_num(centres), finite)
    return (rot[:, None, :3, :3] @ out[..., None])[..., 0]


def parameters_of(machine: Machine, steps: FourSteps) -> Array:
    """Parameters (B, P) of the machine with the results of the steps."""
    layout, theta = machine.layout, np.tile(machine.values, (len(steps.base), 1))
    base_index, platform_index = centre_index(layout)
    theta[:, base_index], theta[:, platform_index] = steps.base, steps.platform
    closing = layout.rod >= 0
    theta[:, layout.rod[closing]] = steps.offsets[:, closing]
    for index, axes in (
        (layout.base_axis, steps.base_axes),
        (layout.platform_axis, steps.platform_axes),
    ):
        has = index[:, 0] >= 0
        theta[:, index[has]] = axes[:, has]
    return theta


# ------------------------------------------------------------------ the steps on a session


def four_step(
    machine: Machine,
    measurements: Measurements,
    *,
    form: FourStepForm = "corrected",
    T_camera_base_guess: Array | None = None,
    rng: np.random.Generator | None = None,
) -> State:
    """[A]'s four steps on a session; the state is an estimate or a start of the bundle.

    The corrected form estimates the base centres from the edges themselves and is robust against
    wrong edges. T_camera_base_guess : (S, 4, 4) for stations that see too few legs well enough, and
    for all stations if they share too few; without a guess, and without a board on the base, such
    stations are an error. Poses follow from the readings by forward kinematics. Frames are those of
    three centres. Raises ResultError where the data do not allow a step, with [A]'s condition in
    words.
    """
    edges = measurements.edges
    checks.can_be_tried(machine, len(edges))
    linear_mask = linear.centres(machine, measurements, "robust", rng)
    if form == "corrected":
        edges = through_centres(machine, edges, linear_mask.centres)
    axes = axes_from_edges(machine, replace(measurements, edges=edges), linear_mask.weights)
    values = _determined_mask(linear_mask, machine)
    a_camera = np.where(values[..., None], linear_mask.centres, 0.0)[None]
    if form == "printed":
        a_camera, values = centres_from_axes(axes, measurements.n_stations)
    checks.every_leg_visible(machine, values)
    views = _views(machine, measurements, axes, a_camera, values, T_camera_base_guess)
    usable = base_items(machine, axes, a_camera, values, views).fixed()[views.of_station]
    checks.platform_is_identifiable(machine, axes, usable, form)
    steps = solve_from_centres(machine, axes, a_camera, values, form, views)
    checks.lengths_are_fixed(machine, axes, usable, steps.base, steps.T_camera_base, steps.offsets)
    checks.passive_legs_are_fixed(machine, steps.platform)
    stations = steps.T_camera_base[0]
    if T_camera_base_guess is not None:
        stations = np.where(usable[:, None, None], stations, T_camera_base_guess)
    theta = parameters_of(machine, steps)[0]
    poses = _poses(machine.with_values(theta), measurements, steps, machine.home())
    state = with_boards(measurements, theta, stations, poses)
    if nominal_joints(machine).framed:
        return state  # already in the machine's own frames
    return in_gauge(machine, state, default_gauge(machine))


def _determined_mask(value: linear.LinearCentres, machine: Machine) -> Booleans:
    """(S, L) base centres whose standard deviation is below VAGUE_CENTRE_SHARE of the base's
    size.
    """
    size = extent(machine.base_centers())
    finite = np.all(np.isfinite(value.centres), axis=-1)
    covariance = np.where(finite[..., None, None], value.covariance, np.eye(3))
    return finite & (np.linalg.eigvalsh(covariance)[..., -1] < (VAGUE_CENTRE_SHARE * size) ** 2)


def _views(
    machine: Machine,
    measurements: Measurements,
    axes: Axes,
    a_camera: Array,
    valid: Booleans,
    guess: Array | None,
) -> StationViews:
    """Views of the stations: joined by boards on the base, by shared legs, or by the guess."""
    on_base = ~measurements.on_platform
    views = joined_by_boards(measurements.poses, on_base, len(valid))
    items = base_items(machine, axes, a_camera, valid, views)
    if guess is None:
        checks.stations_are_fixed(items, views, machine)
        checks.stations_are_joined(items, views)
    elif checks.free_ways(items).shape[-1]:
        return stations_together(guess)
    return views


def _poses(machine: Machine, measurements: Measurements, steps: FourSteps, home: Array) -> Array:
    """Platform poses (K, 4, 4) by forward kinematics from home, else from the pose of step 4.

    home : (4, 4) of the nominal model; the estimated machine need not assemble at mid-range.
    """
    fk = machine.forward_result(measurements.joints, home)
    poses = fk.T_base_platform
    visible = np.zeros(len(poses), dtype=bool)
    visible[steps.configuration[steps.posed]] = True
    lost = ~fk.converged & visible
    if lost.any():
        start = poses.copy()
        start[steps.configuration] = steps.T_base_platform[0]
        poses = poses.copy()
        poses[lost] = machine.forward_result(measurements.joints[lost], start[lost]).T_base_platform
    return poses
