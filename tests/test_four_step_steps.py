"""Each of [A]'s four steps alone: exact on axes made here, Jacobians, printed and corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.geometry.rigid import apply, dot, perturb, pose, rotation
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.methods.four_step_base import (
    Items,
    base_by_products,
    base_by_registration,
    joined_by_boards,
    mean_pose,
    with_signs,
)
from pkmcal.identify.methods.four_step_platform import (
    joint_distance_deviations,
    joint_distance_offsets,
    passive_centres,
    platform_axes,
    platform_by_distances,
    platform_by_registration,
    torsion,
    universal_axes,
)
from pkmcal.identify.methods.leg_axes import (
    Axes,
    in_base,
    nearest_points,
    plane_normals,
    revolute_axes,
)
from pkmcal.identify.methods.registration import fixes_pose, loose, poses_laying_items
from pkmcal.measurements import PoseSet
from test_four_step_machines import make_scene

SPATIAL, PLANAR, TRANSLATION = np.eye(6), np.eye(6)[:, [2, 3, 4]], np.eye(6)[:, 3:]


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_poses(rng, *shape, turn=0.4):
    scale = np.array([turn] * 3 + [0.1] * 3)
    return perturb(np.eye(4), scale * rng.normal(size=(*shape, 6)))


def random_rotations(rng, *shape):
    return rotation(rng.normal(size=(*shape, 3)))


# step 1 ------------------------------------------------------------------------------------


def test_centres_are_where_the_axes_meet():
    """[A] 6, several runs, stations and legs at once; one direction is not enough."""
    rng = np.random.default_rng(1)
    a = rng.normal(size=(3, 2, 4, 3))
    group = np.array([0, 0, 1, 1, 1])
    u = unit(rng.normal(size=(3, 5, 4, 3)))
    u[:, 1, 3] = u[:, 0, 3]  # leg 4 of station 1 does not turn
    point = a[:, group] + rng.normal(size=(3, 5, 4, 1)) * u
    visible = np.ones((5, 4), dtype=bool)
    visible[0, 1] = False  # leg 2 of station 1 is seen once
    values, reference_values = nearest_points(u, point, visible, group, 2)
    np.testing.assert_array_equal(reference_values, [[True, False, True, False], [True] * 4])
    np.testing.assert_allclose(values[:, reference_values], a[:, reference_values], atol=1e-12)


def test_revolute_axes_are_square_to_the_leg():
    """[A] 7: up to the sign; legs that turn by less than 10 mrad are left out."""
    rng = np.random.default_rng(2)
    v = unit(rng.normal(size=(2, 2, 3, 3)))
    group = np.repeat([0, 1], 6)
    u = unit(np.cross(v[:, group], rng.normal(size=(2, 12, 3, 3))))
    u[:, :6, 2] = unit(u[:, :1, 2] + 1e-3 * u[:, :6, 2])
    visible = np.ones((12, 3), dtype=bool)
    values, reference_values = revolute_axes(u, visible, group, 2)
    np.testing.assert_array_equal(reference_values, [[True, True, False], [True] * 3])
    np.testing.assert_allclose(np.abs(dot(values, v))[:, reference_values], 1, atol=1e-12)


def test_revolute_axes_weigh_the_line_of_sight():
    """Directions ten times worse along the line of sight: weights take out most of that."""
    rng = np.random.default_rng(3)
    v = unit(np.array([0.3, 0.1, 1.0]))
    sight = unit(rng.normal(size=(400, 12, 1, 3)))
    u = unit(np.cross(v, rng.normal(size=(400, 12, 1, 3))))
    lateral = unit(np.cross(sight, u))
    deep = np.cross(u, lateral)
    noise = rng.normal(size=(2, 400, 12, 1, 1))
    measured = unit(u + 1e-3 * noise[0] * lateral + 2e-2 * noise[1] * deep)
    information = 1e6 * lateral[..., :, None] * lateral[..., None, :]
    information = information + 2.5e3 * deep[..., :, None] * deep[..., None, :]
    visible, group = np.ones((12, 1), dtype=bool), np.zeros(12, dtype=int)

    def error(*args):
        values = revolute_axes(measured, visible, group, 1, *args)[0][:, 0, 0]
        return np.median(np.linalg.norm(np.cross(values, v), axis=-1))

    assert error(information) < 0.5 * error()


def test_normal_of_a_plane_from_all_legs_together():
    """One direction of each of two legs determines the axis, which neither leg alone would."""
    rng = np.random.default_rng(4)
    n = unit(rng.normal(size=(5, 3)))
    u = unit(np.cross(n[:, None, None], rng.normal(size=(5, 1, 2, 3))))
    valid, reference_values = plane_normals(
        u, np.ones((1, 2), dtype=bool), np.zeros(1, dtype=int), 1
    )
    assert reference_values.all()
    np.testing.assert_allclose(np.abs(dot(valid[:, 0, 0], n)), 1, atol=1e-12)


# step 2 ------------------------------------------------------------------------------------


def base_views(rng, in_view, directions_visible, noise=0.0):
    """Items of views with every third direction of the other sign, and the truth."""
    n_views, n = in_view.shape
    d = directions_visible.shape[1]
    drawn = rng.normal(size=(n, 3))
    drawn_directions = unit(rng.normal(size=(d, 3)))
    base = drawn + 2e-3 * rng.normal(size=(4, n, 3))
    directions = unit(drawn_directions + 5e-3 * rng.normal(size=(4, d, 3)))
    T = random_poses(rng, 4, n_views, turn=1.0)
    centres = apply(T[:, :, None], base[:, None]) + noise * rng.normal(size=(4, n_views, n, 3))
    turned = (T[:, :, None, :3, :3] @ directions[:, None, :, :, None])[..., 0]
    sign = np.where(rng.random((4, n_views, d, 1)) < 0.3, -1.0, 1.0)
    items = Items(centres, in_view, sign * turned, directions_visible, drawn, drawn_directions)
    return items, T, base, directions


def laid_on(value, truth, T_estimate, T_true):
    """Both forms determine the base up to its frame: compare after fitting one to the other."""
    e = poses_laying_items(value, truth, np.ones(value.shape[:2]))
    np.testing.assert_allclose(T_true @ e[:, None], T_estimate, atol=1e-8)
    return e, apply(e[:, None], value)


@pytest.mark.parametrize("join", [base_by_registration, base_by_products])
def test_views_that_share_legs_and_axes(join):
    """[A] 9: centres and axes of five legs over three views; two of them see three centres."""
    rng = np.random.default_rng(5)
    visible = np.array([[1, 1, 1, 0, 0], [0, 1, 1, 1, 1], [1, 0, 0, 1, 1]], dtype=bool)
    axes = np.array([[1, 1], [1, 0], [1, 1]], dtype=bool)
    items, T, base, directions = base_views(rng, visible, axes)
    items = with_signs(items, T[..., :3, :3])
    gauge = _frame_rows(items)
    value = join(items, gauge)
    e, centres = laid_on(value.centres, base, value.T_view_base, T)
    np.testing.assert_allclose(centres, base, atol=1e-9)
    turned = (e[:, None, :3, :3] @ value.directions[..., None])[..., 0]
    np.testing.assert_allclose(turned, directions, atol=1e-9)
    np.testing.assert_allclose(
        (value.centres - items.drawn).reshape(4, -1) @ gauge[:, :15].T, 0, atol=1e-9
    )


def _frame_rows(items):
    """Rows that hold the sum of the centres and of their turns."""
    p = items.drawn - items.drawn.mean(axis=0)
    n = len(p)
    rows = np.zeros((6, len(items.nominal), 3))
    for k in range(3):
        rows[k, :n, k] = 1
        rows[3 + k, :n] = np.cross(np.eye(3)[k], p)
    return rows.reshape(6, -1)


def test_axes_replace_centres_that_views_do_not_share():
    """Two centres and one axis fix a view as three centres do; two centres alone do not."""
    rng = np.random.default_rng(6)
    in_view = np.array([[1, 1, 1, 1], [1, 1, 0, 0]], dtype=bool)
    items, T, base, _ = base_views(rng, in_view, np.array([[True], [True]]))
    items = with_signs(items, T[..., :3, :3])
    np.testing.assert_array_equal(items.fixed(), [True, True])
    value = base_by_registration(items, _frame_rows(items))
    laid_on(value.centres, base, value.T_view_base, T)
    without = items._replace(directions_visible=np.zeros((2, 1), dtype=bool))
    np.testing.assert_array_equal(without.fixed(), [True, False])


def test_products_leave_the_depth_of_coplanar_centres_open_and_axes_close_it():
    """Errata, A 9: rank 9 of 12 for six coplanar centres; an axis across makes them first order."""
    rng = np.random.default_rng(7)
    visible = np.ones((2, 6), dtype=bool)
    worst = []
    for d in (0, 1):
        items, T, _, _ = base_views(rng, visible, np.ones((2, d), dtype=bool))
        flat = items.drawn * [1, 1, 0]
        base = flat + 2e-3 * rng.normal(size=(4, 6, 3))
        items = items._replace(centres=apply(T[:, :, None], base[:, None]), drawn=flat)
        items = with_signs(items, T[..., :3, :3])
        for join in (base_by_products, base_by_registration):
            values = join(items, _frame_rows(items)).centres
            e = poses_laying_items(values, base, np.ones(values.shape[:2]))
            worst.append(np.abs(apply(e[:, None], values) - base).max())
    printed, corrected, printed_with_axis, corrected_with_axis = worst
    assert printed > 5e-4
    assert max(corrected, corrected_with_axis, printed_with_axis) < 1e-8


def test_one_sign_over_all_views():
    """Errata, A 9: without a common sign, an axis with either sign biases the registration."""
    rng = np.random.default_rng(8)
    items, T, _, directions = base_views(rng, np.ones((3, 4), dtype=bool), np.ones((3, 2), bool))
    turned = (T[:, :, None, :3, :3] @ directions[:, None, :, :, None])[..., 0]
    right = with_signs(items, T[..., :3, :3])
    np.testing.assert_allclose(right.directions, turned, atol=1e-12)
    flipped = dot(items.directions, turned) < 0
    mixed = np.any(flipped != flipped[:, :1], axis=(1, 2))
    assert mixed.sum() > 1
    gauge = _frame_rows(items)
    wrong = base_by_registration(items, gauge).directions
    change = np.abs(wrong - base_by_registration(right, gauge).directions).max(axis=(1, 2))
    assert change[mixed].min() > 1e-2


def test_boards_chain_stations_and_are_averaged():
    """Stations 1 and 2 see board 1, 2 and 3 see board 2; station 4 sees neither."""
    rng = np.random.default_rng(9)
    T_camera_base, T_base_board = random_poses(rng, 4, turn=1.0), random_poses(rng, 3, turn=1.0)
    pairs = np.array([(0, 0), (1, 0), (1, 1), (2, 1), (3, 2), (0, 0)])
    station, mount = pairs.T
    T = T_camera_base[station] @ T_base_board[mount]
    whiten = np.tile(np.eye(6), (6, 1, 1))
    poses = PoseSet(station, np.zeros(6, dtype=int), mount, T, whiten)
    views = joined_by_boards(poses, np.array([True, True, False]), 4)
    np.testing.assert_array_equal(views.of_station, [0, 0, 0, 1])
    view = np.linalg.inv(T_camera_base[0]) @ views.T_camera_view[0]
    np.testing.assert_allclose(views.T_camera_view[:3], T_camera_base[:3] @ view, atol=1e-12)


def test_mean_pose_weighs_by_the_covariances():
    rng = np.random.default_rng(10)
    truth = random_poses(rng, 2, turn=1.0)
    group = np.repeat([0, 1], 200)
    sigma = np.where(rng.random(400) < 0.5, 1e-3, 1e-1)
    T = perturb(truth[group], sigma[:, None] * rng.normal(size=(400, 6)))
    values = mean_pose(T, np.eye(6) / sigma[:, None, None], group, 2)
    np.testing.assert_allclose(values, truth, atol=5e-4)  # 1e-3 / sqrt(100), four deviations
    equal = mean_pose(T, np.tile(np.eye(6), (400, 1, 1)), group, 2)
    assert np.abs(equal - truth).max() > 2e-3


# step 3 ------------------------------------------------------------------------------------


def body_axes(rng, runs=3, photos=12, legs=4, constant=()):
    """Leg axes of a body in random poses, base frame, and true offsets."""
    base = rng.normal(size=(runs, legs, 3)) * 0.3
    body = rng.normal(size=(runs, legs, 3)) * 0.2
    T = random_poses(rng, runs, photos)
    T[..., 2, 3] += 1.0
    b = apply(T[:, :, None], body[:, None])
    line = b - base[:, None]
    length = np.linalg.norm(line, axis=-1)
    q0 = 0.02 * rng.normal(size=(runs, legs))
    readings = length - q0[:, None]
    station = np.repeat([0, 1], photos // 2)
    visible = np.ones((photos, legs), dtype=bool)
    axes = Axes(station, np.arange(photos), visible, line / length[..., None], 0 * line, readings)
    return axes, base, body, T, q0


@pytest.mark.parametrize("form", ["corrected", "printed"])
def test_offsets_keep_the_distances(form):
    """[A] 14; a leg that is not in ``seen`` (a passive one) keeps its start."""
    rng = np.random.default_rng(11)
    axes, base, _, _, q0 = body_axes(rng)
    a = np.broadcast_to(base[:, None], axes.u.shape)
    np.testing.assert_allclose(joint_distance_offsets(axes, a, np.zeros(4), form), q0, atol=1e-9)
    passive = replace(axes, visible=axes.visible & [True, True, True, False])
    values = joint_distance_offsets(passive, a, np.array([0, 0, 0, 0.7]), form)
    np.testing.assert_allclose(values[:, :3], q0[:, :3], atol=1e-9)
    np.testing.assert_array_equal(values[:, 3], 0.7)


@pytest.mark.parametrize("form", ["corrected", "printed"])
def test_slopes_of_the_distances(form):
    rng = np.random.default_rng(12)
    axes, base, _, _, q0 = body_axes(rng)
    axes = replace(axes, visible=rng.random(axes.visible.shape) < 0.8)
    a = np.broadcast_to(base[:, None], axes.u.shape)
    for at in (q0, q0 + 0.05, 0 * q0 - 1.0):
        value, slope = joint_distance_deviations(axes, a, at, form)
        for j in range(4):
            step = 1e-6 * np.eye(4)[j]
            numeric = (
                joint_distance_deviations(axes, a, at + step, form)[0]
                - joint_distance_deviations(axes, a, at - step, form)[0]
            ) / 2e-6
            np.testing.assert_allclose(slope[..., j], numeric, atol=1e-8)
        assert value.shape == slope.shape[:-1]


def constant_legs(rng):
    """Three legs of constant length 1 about fixed centres: a body that they carry."""
    scene = make_scene("constant-legs", rng, 30)
    machine = scene.machine
    from pkmcal.mechanisms.closure import joint_values, limb_ends

    ends = limb_ends(
        machine.layout, machine.values, scene.measurements.joints, scene.truth.T_base_platform
    )
    line = ends.b - ends.a
    u = line / np.linalg.norm(line, axis=-1, keepdims=True)
    photos = np.arange(30)
    readings = joint_values(machine.layout, machine.values, scene.measurements.joints)
    visible = np.ones((30, 6), dtype=bool)
    axes = Axes(0 * photos, photos, visible, u[None], 0 * u[None], readings[None])
    return machine, axes, np.broadcast_to(ends.a, u.shape)[None]


def test_constant_lengths_and_their_false_minimum():
    """[A] 14 with q = 0: the nominal length leads to the true one.

    Both struts at length zero fit the distance between them exactly, wherever the legs go (errata).
    """
    machine, axes, a = constant_legs(np.random.default_rng(13))
    rod = machine.layout.rod
    start = machine.parameters.nominal[rod]
    truth = machine.values[rod]
    for form in ("corrected", "printed"):
        np.testing.assert_allclose(
            joint_distance_offsets(axes, a, start, form)[0], truth, atol=1e-8
        )
    struts = replace(axes, visible=axes.visible & (machine.layout.actuated < 0))
    value, _ = joint_distance_deviations(struts, a, np.zeros((1, 6)), "corrected")
    np.testing.assert_allclose(value, 0, atol=1e-15)


def test_printed_differences_collapse_on_a_smooth_path():
    """Errata, A 14: consecutive differences are all noise if neighbours are similar."""
    rng = np.random.default_rng(14)
    axes, base, body, _, q0 = body_axes(rng, runs=40, photos=60)
    step = np.linspace(0, 1, 60)[None, :, None]
    swing = rng.uniform(0.2, 0.5, (40, 1, 6)) * np.sin(2 * np.pi * step + rng.random((40, 1, 6)))
    T = perturb(pose(np.eye(3), np.array([0, 0, 1.0])), swing * [1, 1, 1, 0.3, 0.3, 0.3])
    line = apply(T[:, :, None], body[:, None]) - base[:, None]
    length = np.linalg.norm(line, axis=-1)
    u = unit(line / length[..., None] + 1e-3 * rng.normal(size=line.shape))
    path = replace(axes, u=u, readings=length - q0[:, None], station=0 * axes.station)
    a = np.broadcast_to(base[:, None], u.shape)
    bias = {
        form: np.mean(joint_distance_offsets(path, a, np.zeros(4), form) - q0)
        for form in ("corrected", "printed")
    }
    assert abs(bias["printed"]) > 5 * abs(bias["corrected"])


# step 4 ------------------------------------------------------------------------------------


def test_platform_centres_by_registration_and_by_distances():
    """[A] 16 in both forms, platform not flat: the same body."""
    rng = np.random.default_rng(15)
    axes, base, body, T, q0 = body_axes(rng)
    b = base[:, None] + (axes.readings + q0[:, None])[..., None] * axes.u
    nominal = body[0] + 1e-3 * rng.normal(size=(4, 3))
    body = body[:1]
    b = apply(T[:, :, None], body[:, None])
    items = Items(b, axes.visible, b[:, :, :0], axes.visible[:, :0], nominal, np.zeros((0, 3)))
    gauge = _frame_rows(items)
    for item in (
        platform_by_registration(b, axes.visible, nominal, gauge),
        platform_by_distances(b, axes.visible, axes.station, nominal, gauge),
    ):
        e = poses_laying_items(item, np.broadcast_to(body, item.shape), np.ones(item.shape[:2]))
        np.testing.assert_allclose(
            apply(e[:, None], item), np.broadcast_to(body, item.shape), atol=1e-9
        )


@pytest.mark.parametrize("motion", [PLANAR, TRANSLATION])
def test_a_platform_that_moves_less_needs_fewer_legs(motion):
    """Planar: two legs at once; translation: one. No frame sees all four."""
    rng = np.random.default_rng(16)
    body = 0.2 * rng.normal(size=(2, 4, 3))
    T = perturb(np.eye(4), (0.4 * rng.normal(size=(2, 9, 6))) @ motion @ motion.T)
    visible = np.zeros((9, 4), dtype=bool)
    k = np.arange(9)
    width = 2 if motion is PLANAR else 1
    for step in range(width + 1):
        visible[k, (k + step) % 4] = True
    visible[8, 1:] = False
    visible[8, 0] = motion is TRANSLATION
    b = apply(T[:, :, None], body[:, None])
    nominal = body[0] + 1e-3 * rng.normal(size=(4, 3))
    fixed = fixes_pose(nominal, visible, motion=motion)
    np.testing.assert_array_equal(fixed, k < 8 if motion is PLANAR else k < 9)
    assert not fixes_pose(nominal, visible[:8], motion=SPATIAL).any() or motion is PLANAR
    assert loose(nominal, visible, motion=motion).shape[-1] == 0
    x = (nominal - nominal.mean(axis=0))[:, :2]
    rows = np.zeros((6, 4, 3))
    rows[2, :, 0], rows[2, :, 1] = -x[:, 1], x[:, 0]
    rows[3:] = np.eye(3)[:, None]
    gauge = motion.T @ rows.reshape(6, 12)
    values = platform_by_registration(b[:, fixed], visible[fixed], nominal, gauge, motion)
    e = poses_laying_items(values, body, np.ones((2, 4)), motion=motion)
    np.testing.assert_allclose(apply(e[:, None], values), body, atol=1e-9)
    if motion is TRANSLATION:
        np.testing.assert_array_equal(e[:, :3, :3], np.broadcast_to(np.eye(3), (2, 3, 3)))


def test_loose_ways_are_the_ones_that_exist():
    """Two groups that share two points hinge about them: one way to move, and it turns there."""
    rng = np.random.default_rng(17)
    p = rng.normal(size=(6, 3))
    in_view = np.array([[1, 1, 1, 1, 0, 0], [1, 1, 0, 0, 1, 1]], dtype=bool)
    free = loose(p, in_view)
    assert free.shape == (6, 3, 1)
    sense = free[..., 0]
    # take out the body's own turn that the first group makes: the others then turn about the hinge
    rates = dot(p[:, None] - p, sense[:, None] - sense)
    np.testing.assert_allclose(rates[:4, :4], 0, atol=1e-9)
    assert np.abs(rates[2:4, 4:]).max() > 1e-2
    shared = np.array([[1, 1, 1, 1, 0, 0], [1, 1, 1, 0, 1, 1]], dtype=bool)
    assert loose(p, shared).shape[-1] == 0
    # a common axis, not along the hinge, closes it too
    items = np.concatenate([p, [[0.3, -0.5, 0.8]]])
    assert loose(items, np.pad(in_view, ((0, 0), (0, 1)), constant_values=True), 1).shape[-1] == 0


def test_revolute_axes_and_passive_legs_on_the_platform():
    """[A] 18 with 7, and 19: axis and centre in the platform frame."""
    rng = np.random.default_rng(18)
    T = random_poses(rng, 2, 8)
    w = unit(rng.normal(size=(2, 3, 3)))
    local = unit(np.cross(w[:, None], rng.normal(size=(2, 8, 3, 3))))
    u = (T[:, :, None, :3, :3] @ local[..., None])[..., 0]
    visible = np.ones((8, 3), dtype=bool)
    visible[1:, 2] = False
    values, reference_values = platform_axes(u, visible, T)
    np.testing.assert_array_equal(reference_values, [True, True, False])
    np.testing.assert_allclose(np.abs(dot(values, w))[:, :2], 1, atol=1e-12)
    b, base = rng.normal(size=(2, 2, 3, 3))
    u = unit(apply(T[:, :, None], b[:, None]) - base[:, None])
    values, reference_values = passive_centres(u, base, visible, T)
    np.testing.assert_array_equal(reference_values, [True, True, False])
    np.testing.assert_allclose(values[:, :2], b[:, :2], atol=1e-10)


def test_torsion_and_its_slopes():
    rng = np.random.default_rng(19)
    u, v, w = unit(rng.normal(size=(3, 20, 3)))
    rot = random_rotations(rng, 20)
    value, by_v, by_w = torsion(u, rot, v, w)
    turned = (rot @ w[..., None])[..., 0]
    np.testing.assert_allclose(value, dot(u, np.cross(v, turned)), atol=1e-14)
    for by, k in ((by_v, 0), (by_w, 1)):
        for axis in np.eye(3):
            shifted = [v + 1e-30j * axis, w] if k == 0 else [v, w + 1e-30j * axis]
            c = (rot @ shifted[1][..., None])[..., 0]
            complex_value = dot(u, np.cross(shifted[0], c))
            np.testing.assert_allclose(dot(by, axis), complex_value.imag / 1e-30, atol=1e-14)


def universal_legs(rng, turn, runs=2, photos=30, legs=3):
    """Directions of universal-universal legs whose platform turns by ``turn`` rad or so."""
    v, w = unit(rng.normal(size=(2, runs, legs, 3)))
    rot = rotation(turn * rng.normal(size=(runs, photos, 3)))
    # u is square to v x R w; any direction in that plane
    normal = np.cross(v[:, None], (rot[:, :, None] @ w[:, None, ..., None])[..., 0])
    u = unit(np.cross(normal, rng.normal(size=normal.shape)))
    return v, w, rot, u


def test_universal_axes_of_a_platform_that_turns():
    """All four degrees of freedom of each leg, from a nominal model with errors of 5 mrad."""
    rng = np.random.default_rng(20)
    v, w, rot, u = universal_legs(rng, 0.5)
    drawn = tuple(unit(a + 5e-3 * rng.normal(size=a.shape)) for a in (v, w))
    visible = np.ones((30, 3), dtype=bool)
    values = universal_axes(u, rot, visible, drawn, np.full(3, 0.005))
    for got, true in zip(values, (v, w), strict=True):
        np.testing.assert_allclose(got, true, atol=1e-9)


def test_universal_axes_of_a_platform_that_does_not_turn():
    """v = v': the difference is estimated, the common rotation is nominal to the last digit."""
    rng = np.random.default_rng(21)
    v = unit(rng.normal(size=(2, 3, 3)))
    rot = np.broadcast_to(np.eye(3), (2, 30, 3, 3))
    u = unit(rng.normal(size=(2, 30, 3, 3)))
    drawn = tuple(unit(v + 5e-3 * rng.normal(size=v.shape)) for _ in range(2))
    valid = universal_axes(u, rot, np.ones((30, 3), dtype=bool), drawn, np.full(3, 0.005))
    np.testing.assert_allclose(valid[0], valid[1], atol=1e-10)
    middle = unit(drawn[0] + drawn[1])
    np.testing.assert_allclose(valid[0], middle, atol=1e-5)  # to second order of 5 mrad
    assert np.abs(valid[0] - v).max() > 2e-3


def test_noise_leaves_weak_directions_to_the_prior():
    """A platform that turns by 5 mrad only: the common turn would cost 0.1 rad from data alone."""
    rng = np.random.default_rng(22)
    v, w, rot, u = universal_legs(rng, 0.005, runs=20)
    w = v
    normal = np.cross(v[:, None], (rot[:, :, None] @ w[:, None, ..., None])[..., 0])
    u = unit(np.cross(normal, rng.normal(size=normal.shape)))
    u = unit(u + 1e-3 * rng.normal(size=u.shape))
    noisy = rotation(1e-3 * rng.normal(size=(20, 30, 3))) @ rot
    drawn = (v, w)
    valid = universal_axes(u, noisy, np.ones((30, 3), dtype=bool), drawn, np.full(3, 0.005))
    for got in valid:
        assert np.sqrt(np.mean(np.sum((got - v) ** 2, axis=-1))) < 0.005


def test_several_images_of_one_configuration_count_as_one():
    """Weighted mean direction: each station determines it across its line of sight only."""
    rng = np.random.default_rng(23)
    T = random_poses(rng, 1, 2, turn=1.0)
    truth = unit(rng.normal(size=(1, 3, 2, 3)))
    station, configuration = np.array([0, 0, 0, 1, 1]), np.array([4, 5, 7, 4, 7])
    row = np.searchsorted([4, 5, 7], configuration)
    u = (T[:, station, None, :3, :3] @ truth[:, row, :, :, None])[..., 0]
    sight = unit(rng.normal(size=(1, 5, 2, 3)))
    lateral = unit(np.cross(sight, u))
    deep = np.cross(u, lateral)
    measured = unit(u + 0.02 * rng.normal(size=(1, 5, 2, 1)) * deep)
    information = lateral[..., :, None] * lateral[..., None, :]
    visible = np.ones((5, 2), dtype=bool)
    readings = rng.normal(size=(1, 3, 2))[:, row]
    axes = Axes(station, configuration, visible, measured, 0 * u, readings, information)
    values = in_base(axes, T)
    np.testing.assert_array_equal(values.configuration, [4, 5, 7])
    np.testing.assert_allclose(values.u[:, [0, 2]], truth[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(values.readings, readings[:, [0, 1, 2]], atol=0)
    alone = in_base(replace(axes, information=None), T)
    assert np.abs(alone.u - truth)[:, [0, 2]].max() > 1e-3


def test_three_centres_stay_the_frame_of_a_spatial_machine():
    """The result of the steps obeys the gauge's constraints."""
    from pkmcal.identify.methods.four_step import four_step

    scene = make_scene("6-spu-passive", np.random.default_rng(24), 20)
    value = four_step(scene.nominal, scene.measurements)
    rows = ThreeCentres().constraints(scene.nominal)
    np.testing.assert_allclose(
        rows @ (value.theta - scene.nominal.parameters.nominal), 0, atol=1e-9
    )
