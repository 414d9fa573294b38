"""Rigid motions and cylinders: properties over many inputs, exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from pkmcal.geometry import cylinders, rigid

# a shared machine is slow now and then; that is no defect
settings.register_profile("geometry", deadline=None)
settings.load_profile("geometry")

numbers = st.floats(-2, 2, allow_subnormal=False)
vectors = arrays(float, 3, elements=numbers)
six = arrays(float, 6, elements=numbers)
seeds = st.integers(0, 2**32 - 1)


@given(vectors)
def test_rotation_vector_round_trip(omega):
    angle = np.linalg.norm(omega)
    rot = rigid.rotation(omega)
    np.testing.assert_allclose(rot @ rot.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rot) == pytest.approx(1)
    # the same rotation with an angle of at most pi
    back = rigid.rotation_vector(rot)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    np.testing.assert_allclose(rigid.rotation(back), rot, atol=1e-12)
    if angle < np.pi - 1e-3:
        np.testing.assert_allclose(back, omega, atol=1e-9)


def test_quaternions():
    rng = np.random.default_rng(0)
    turns = rigid.rotation(rng.normal(size=(50, 3)) * 2)
    count = rigid.quaternion(turns)
    assert np.all(count[:, 0] >= 0)
    np.testing.assert_allclose(np.linalg.norm(count, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(rigid.from_quaternion(count), turns, atol=1e-12)
    np.testing.assert_allclose(rigid.from_quaternion(-3 * count), turns, atol=1e-12)
    np.testing.assert_allclose(rigid.quaternion(np.eye(3)), [1, 0, 0, 0])
    by_scipy = Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]
    by_scipy *= np.sign(by_scipy[:, :1])
    np.testing.assert_allclose(count, by_scipy, atol=1e-14)


def test_a_quaternion_of_half_a_turn():
    for axis in np.eye(3):
        rot = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(rigid.quaternion(rot)), [0.0, *axis], atol=1e-15)


@pytest.mark.parametrize("angle", [1e-3, 1e-4 * 1.001, 1e-4 * 0.999, 1e-6, 1e-12, 0.0])
def test_rotation_is_smooth_through_its_series(angle):
    axis = np.array([0.6, -0.48, 0.64])
    k = rigid.skew(axis)
    exact = np.eye(3) + np.sin(angle) * k + 2 * np.sin(angle / 2) ** 2 * (k @ k)
    np.testing.assert_allclose(rigid.rotation(angle * axis), exact, atol=1e-15)


@given(six, vectors)
def test_inverse_and_apply(delta, point):
    T = rigid.perturb(np.eye(4), delta)
    np.testing.assert_allclose(T @ rigid.inverse(T), np.eye(4), atol=1e-13)
    back = rigid.apply(rigid.inverse(T), rigid.apply(T, point))
    np.testing.assert_allclose(back, point, atol=1e-13)


@given(six, arrays(float, 6, elements=st.floats(-1, 1, allow_subnormal=False)))
def test_pose_difference_undoes_perturb(start, delta):
    reference = rigid.perturb(np.eye(4), start)
    shifted = rigid.perturb(reference, delta)
    np.testing.assert_allclose(rigid.pose_difference(shifted, reference), delta, atol=1e-9)


@given(seeds, six)
def test_register_finds_the_motion(seed, delta):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(5, 3))
    T = rigid.perturb(np.eye(4), delta)
    values = rigid.register(source, rigid.apply(T, source), rng.uniform(0.1, 1, 5))
    np.testing.assert_allclose(values, T, atol=1e-7)


def test_register_never_mirrors():
    """Points in a plane fit a mirror image as well as a turn; the answer must be a turn."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.normal(size=(40, 6, 2)), np.zeros((40, 6, 1))], axis=-1)
    target = flat * np.array([1, 1, -1]) + 1e-3 * rng.normal(size=flat.shape)
    assert np.all(np.linalg.det(rigid.register(flat, target)[:, :3, :3]) > 0.999)


def leg(seed: int, distance: float | None = None):
    """A leg before a camera: ends, radius; ``distance`` of its axis in radii."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=3)
    u /= np.linalg.norm(u)
    foot = np.cross(u, rng.normal(size=3))
    radius = rng.uniform(0.005, 0.03)
    foot *= (radius * distance if distance else rng.uniform(0.2, 2)) / np.linalg.norm(foot)
    start = rng.uniform(-0.5, 0.5)
    return foot + start * u, foot + (start + rng.uniform(0.1, 0.6)) * u, radius


@given(seeds, st.floats(1.05, 100))
def test_edges_touch_the_cylinder(seed, distance):
    """[B] 12-13: both normals are unit and pass every point of the axis at -R."""
    a, b, radius = leg(seed, distance)
    u, m = cylinders.line_through(a, b)
    n = cylinders.edge_normal(u, m, np.array(radius), cylinders.SIDE_SIGNS)
    np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1, atol=1e-14)
    for s in (-1.0, 0.0, 0.7):
        np.testing.assert_allclose(n @ (a + s * u), -radius, atol=1e-13)
    e = cylinders.edge_normal_jacobians(a, b, np.array(radius), np.arange(2))
    np.testing.assert_allclose(e.n, n, atol=1e-12)


def test_the_point_of_an_edge_lies_on_its_plane_and_on_the_cylinder():
    a, b, radius = leg(3)
    u, m = cylinders.line_through(a, b)
    for n in cylinders.edge_normal(u, m, np.array(radius), cylinders.SIDE_SIGNS):
        p = cylinders.contour_point(a, u, n, np.array(radius), np.array([0.1, 0.2]))
        np.testing.assert_allclose(p @ n, 0, atol=1e-14)
        gap = np.linalg.norm(np.cross(p, u) - m, axis=-1)
        np.testing.assert_allclose(gap, radius, atol=1e-14)


# 1.02 radii: the camera all but touches the leg, where the derivatives grow without bound
@pytest.mark.parametrize("distance", [None, 1.02, 1.2, 3.0, 100.0])
@pytest.mark.parametrize("side", [0, 1])
def test_edge_derivatives_against_complex_steps(distance, side):
    for seed in range(10):
        a, b, radius = leg(seed, distance)
        e = cylinders.edge_normal_jacobians(a, b, np.array(radius), np.array(side))
        x = np.concatenate([a, b, [radius]])
        exact = np.concatenate([e.dn_da, e.dn_db, (e.by_a + e.by_b)[:, None]], axis=1)
        step = 1e-30
        for k in range(7):
            shifted = x.astype(complex)
            shifted[k] += 1j * step
            n = complex_normal(shifted[:3], shifted[3:6], shifted[6], side)
            scale = np.abs(exact).max()
            np.testing.assert_allclose(n.imag / step, exact[:, k], atol=1e-10 * scale)


def complex_normal(a, b, radius, side):
    """[B] eq. 3 written out again, so that the test does not use the code's own formulas."""
    u = (b - a) / np.sqrt(np.sum((b - a) ** 2))
    m = np.cross(a, u)
    distance = np.sqrt(np.sum(m**2))
    sin = radius / distance
    cos = np.sqrt(1 - sin**2)
    return (cos if side == 0 else -cos) * m / distance - sin * np.cross(u, m / distance)


def test_a_camera_inside_a_leg_is_reported():
    a, b, radius = leg(1, 0.8)
    assert not cylinders.has_silhouette(cylinders.line_through(a, b)[1], np.array(radius))
    inside = cylinders.edge_normal_jacobians(a, b, np.array(radius), np.array(0))
    assert np.isnan(inside.n).all()


@given(seeds)
@settings(max_examples=50)
def test_tangent_basis(seed):
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(4, 3))
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    basis = cylinders.tangent_basis(n, rng.normal(size=(4, 3)))
    gram = np.swapaxes(basis, -1, -2) @ basis
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(2), gram.shape), atol=1e-12)
    np.testing.assert_allclose(np.einsum("ij,ijk->ik", n, basis), 0, atol=1e-12)


@pytest.mark.parametrize("parallel", [False, True])
def test_distance_of_segments_against_dense_points(parallel):
    rng = np.random.default_rng(3)
    p0, p1, q0 = rng.normal(size=(3, 50, 3))
    q1 = q0 + (rng.uniform(0.1, 2, (50, 1)) * (p1 - p0) if parallel else rng.normal(size=(50, 3)))
    share = np.linspace(0, 1, 801)[:, None]
    p, q = ((1 - share) * a[:, None] + share * b[:, None] for a, b in ((p0, p1), (q0, q1)))
    dense = np.array([cdist(*pair).min() for pair in zip(p, q, strict=True)])
    nearest = cylinders.segment_distance(p0, p1, q0, q1)
    assert np.all(nearest <= dense + 1e-12)
    np.testing.assert_allclose(nearest, dense, atol=6e-3)


def test_segments_that_cross_have_no_distance():
    p0, p1, q0, q1 = np.array([[-1, 0, 0], [1, 0, 0], [0.5, -2, 0], [0.5, 1, 0.0]])
    assert cylinders.segment_distance(p0, p1, q0, q1) == pytest.approx(0, abs=1e-15)
