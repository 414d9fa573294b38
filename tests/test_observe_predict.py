"""Predicted edges: on the true silhouettes, with exact derivatives, and not behind other legs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from pkmcal.geometry.rigid import look_at
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.observe.predict import (
    JOINT_MARGIN,
    edge_points,
    legs_in_camera,
    tubes_of,
    unobstructed,
)
from test_observe_rendered_legs import (
    FRONT,
    camera_of,
    drawn_image,
    machine,
    meet,
    outward_to,
    poses,
    redrawn,
    true_normals,
    tubes_at,
)

SAMPLES = 25


def predicted(distorted=True, mechanism=None, samples=SAMPLES, T_camera_base=FRONT):
    mechanism = mechanism or machine()
    readings = machine().inverse(poses())
    legs = legs_in_camera(mechanism, T_camera_base, poses(), readings)
    tubes = tubes_of(mechanism)
    return legs, tubes, edge_points(mechanism, camera_of(distorted), legs, tubes, samples)


def beside(legs, tubes, rays):
    """Distance (K, E, n) m between the lines of sight and their leg's axis."""
    a, u = legs.a[:, tubes.leg][..., None, :], legs.u[:, tubes.leg][..., None, :]
    across = np.cross(rays, u)
    return np.abs(np.sum(a * across, axis=-1)) / np.linalg.norm(across, axis=-1)


def test_every_tube_of_the_nominal_model_has_two_edges():
    tubes = tubes_of(machine())
    assert len(tubes) == 6 * 2 * 2
    names = [
        f"legs[{j + 1}].tubes[{t + 1}].radius" for j, t in zip(tubes.leg, tubes.tube, strict=True)
    ]
    assert [machine().parameters.names[k] for k in tubes.radius] == names
    assert tubes.side.tolist() == [0, 1] * 12
    assert tubes.start.tolist() == [0.02, 0.02, 0.249, 0.249] * 6


@pytest.mark.parametrize("distorted", [False, True])
def test_predicted_points_lie_on_the_silhouette(distorted):
    """A line of sight through them touches the cylinder: within 1e-6 px, with the lens's
    distortion in between (its inverse is good to 1e-9 px)."""
    legs, tubes, points = predicted(distorted)
    assert points.valid.all()
    rays = camera_of(distorted).ray(points.pixel)
    radius = machine().values[tubes.radius][:, None]
    off = (beside(legs, tubes, rays) - radius) * points.gain
    assert np.abs(off).max() < 1e-6
    k, e, _ = np.indices(points.valid.shape)
    flat = (v[..., 0].ravel() for v in (tubes.leg[e], tubes.tube[e], tubes.side[e], k))
    truth = true_normals(*flat).reshape(points.normal.shape)
    np.testing.assert_allclose(points.normal, truth, atol=1e-14)


@pytest.mark.parametrize("distorted", [False, True])
def test_outward_leads_away_from_the_leg_by_the_gain(distorted):
    legs, tubes, points = predicted(distorted)
    np.testing.assert_allclose(np.linalg.norm(points.outward, axis=-1), 1, atol=1e-14)
    radius = machine().values[tubes.radius][:, None]
    for step in (-0.5, 0.5):
        rays = camera_of(distorted).ray(points.pixel + step * points.outward)
        # a pixel is a millimetre and a half: the second order of it is a per cent
        shifted = (beside(legs, tubes, rays) - radius) * points.gain
        np.testing.assert_allclose(shifted, step, rtol=0.02)


def test_points_are_spread_over_the_visible_stretch():
    """From the margin at the tube's lower end to that at its upper end, or at the leg's."""
    _, tubes, points = predicted(samples=400)
    ends = limb_ends(machine().layout, machine().values, machine().inverse(poses()), poses())
    length = np.linalg.norm(ends.b - ends.a, axis=-1)[:, tubes.leg]
    first, last = tubes.start + JOINT_MARGIN, np.minimum(tubes.stop, length) - JOINT_MARGIN
    spacing = (last - first) / 400
    np.testing.assert_allclose(points.along[..., 0], first + spacing / 2, atol=1e-12)
    np.testing.assert_allclose(points.along[..., -1], last - spacing / 2, atol=1e-12)


def test_across_is_the_outward_motion_by_the_point():
    _, _, points = predicted()
    project, step = camera_of().project, 1e-5
    for axis in np.eye(3):
        # central: the second order of 10 um cancels, rounding leaves 1e-13 px over the step
        shifted = (project(points.point + step * axis) - project(points.point - step * axis)) / 2
        oracle = np.sum(shifted * points.outward, axis=-1) / step
        np.testing.assert_allclose(points.across @ axis, oracle, atol=1e-5)


@pytest.mark.parametrize("distorted", [False, True])
def test_by_normal_predicts_where_a_turned_edge_passes(distorted):
    """Against cylinders moved and widened by hundredths of a millimetre: up to 0.05 px, found on
    the image by secants; the second order is a ten-thousandth of it.
    """
    _, _, points = predicted(distorted)
    shifted = redrawn(3, 2e-5)
    _, _, others = predicted(distorted, shifted)
    truth = outward_to(others.normal, points.pixel, points.outward, camera_of(distorted))
    assert 0.01 < np.abs(truth).max() < 0.2
    turn = (others.normal - points.normal)[..., None]
    values = (points.by_normal() @ turn)[..., 0]
    np.testing.assert_allclose(values, truth, atol=1e-4 * np.abs(truth).max())


def test_what_is_behind_the_camera_is_not_valid():
    """A camera in the middle of the legs: no image, no warning, no number."""
    inside = look_at(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.2]), np.array([0, 0, 1.0]))
    legs, tubes, points = predicted(T_camera_base=inside)
    behind = points.point[..., 2] < 0
    assert behind.any()
    assert not points.valid[behind].any()
    assert np.isfinite(points.pixel[points.valid]).all()
    assert np.isfinite(points.gain[points.valid]).all()
    clear = unobstructed(machine(), camera_of(), legs, tubes, points, 5.0)
    assert not clear[behind].any()


# Legs before legs


def hidden_by_another(points, tubes, k):
    """(E, n) True where another leg's surface is met before the point."""
    hidden = np.zeros(points.along[k].shape, dtype=bool)
    for tube in tubes_at(machine(), poses()[k]):
        distance, _ = meet(tube, FRONT, points.point[k])
        hidden |= (distance < 0.999) & (tubes.leg != tube.leg)[:, None]
    return hidden


def stretched(tubes, by):
    """A leg's tubes, the lowest and the uppermost prolonged by metres."""
    first, *between, last = tubes
    return [
        replace(first, start=first.start - by * first.axis, length=first.length + by),
        *between,
        replace(last, length=last.length + by),
    ]


def thickest(tubes):
    """A leg from joint to joint, as wide as its widest tube."""
    widest = max(tube.radius for tube in tubes)
    return [replace(tube, radius=widest) for tube in stretched(tubes, 0.03)]


def outline_away(shape, tubes, points, k):
    """(E, n) px to the nearest outline of another leg rendered alone, negative inside of it.

    shape : of each leg's tubes, the ones to render. Accurate to a pixel or two.
    """
    away = np.full(points.along[k].shape, np.inf)
    x, y = np.rint(points.pixel[k]).astype(int).clip(0, (639, 479)).transpose(2, 0, 1)
    for other in range(machine().n_legs):
        alone = [t for t in tubes_at(machine(), poses()[k]) if t.leg == other]
        mask = drawn_image(shape(alone)) >= 0
        signed = distance_transform_edt(~mask) - distance_transform_edt(mask)
        mine = (tubes.leg == other)[:, None]
        away = np.where(~mine & (np.abs(signed[y, x]) < np.abs(away)), signed[y, x], away)
    return away


@pytest.mark.parametrize("clearance", [pytest.param(0.0, marks=pytest.mark.slow), 5.0])
def test_obstructed_points_are_those_behind_or_beside_other_legs(clearance):
    legs, tubes, points = predicted()
    clear = unobstructed(machine(), camera_of(), legs, tubes, points, clearance)
    counts = np.zeros(3, dtype=int)
    for k in (0, 1):
        hidden = hidden_by_another(points, tubes, k)
        drawn = outline_away(list, tubes, points, k)
        # ends of legs, where joints are, have no outline that would be kept free
        endless = outline_away(lambda leg: stretched(leg, 0.1), tubes, points, k)
        # pixels at the point's depth; other legs are at 0.6 to 1.6 times it
        beside = (np.abs(drawn) < 0.5 * clearance) & (np.abs(endless) < 0.5 * clearance)
        free = ~hidden & (outline_away(thickest, tubes, points, k) > 1.7 * clearance + 2)
        assert not clear[k][hidden].any()
        assert not clear[k][beside].any()
        assert clear[k][free].all()
        counts += [hidden.sum(), (beside & ~hidden).sum(), free.sum()]
    assert counts[0] > 100
    assert counts[1] > 50 or clearance == 0
    assert counts[2] > 500


def test_a_leg_before_another_is_clear_where_it_crosses():
    """The nearer leg's edges are visible in front of the middle of the other; the other's are
    hidden.
    """
    legs, tubes, points = predicted()
    clear = unobstructed(machine(), camera_of(), legs, tubes, points, 0.0)
    before, behind = 0, 0
    for k in (0, 1, 2):
        hidden = hidden_by_another(points, tubes, k)
        drawn = outline_away(list, tubes, points, k)
        # 6 px inside a tube of 10: within the radius of the rod, which counts for the whole leg
        crossing = ~hidden & (drawn < -6)
        assert clear[k][crossing].all()
        assert not clear[k][hidden & (drawn < -6)].any()
        before, behind = before + crossing.sum(), behind + (hidden & (drawn < -6)).sum()
    assert min(before, behind) > 5


def test_points_outside_the_picture_are_not_clear():
    offset = look_at(np.array([0.1, -0.85, 0.32]), np.array([0.35, 0, 0.18]), np.array([0, 0, 1.0]))
    legs, tubes, points = predicted(T_camera_base=offset)
    clear = unobstructed(machine(), camera_of(), legs, tubes, points, 0.0)
    outside = ~camera_of().in_image(points.pixel, margin=4.0)
    assert outside.mean() > 0.05
    assert not clear[outside].any()
    assert clear.any()
