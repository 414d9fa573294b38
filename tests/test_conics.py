"""[B] eq. 1-3, 10-11 and three ways of fitting an edge's plane, on mirror images."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkmcal.cameras import camera_models
from pkmcal.geometry.cylinders import edge_normals, tangent_basis
from pkmcal.geometry.rigid import apply as move
from pkmcal.geometry.rigid import cross, dot, look_at, perturb
from pkmcal.mechanisms import load_mechanism
from pkmcal.papers import conics

FOCAL, CENTER = np.array([173.6, 173.3]), np.array([319.8, 240.2])


def mirror(xi=1.0):
    parameters = np.concatenate([FOCAL, CENTER, [xi], np.zeros(4)])
    return camera_models()["unified"]((640, 480), parameters)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.floats(0, 1.4),
    st.integers(0, 2**32 - 1),
)
def test_points_of_a_line_lie_on_its_conic(normal, xi, seed):
    """Eq. 1 and 2: every ray in the plane has its image on the conic, pixels too."""
    rng = np.random.default_rng(seed)
    normal = unit(np.array(normal))
    rays = rng.normal(size=(20, 3))
    rays = unit(rays - dot(rays, normal)[:, None] * normal)
    rays = rays[rays[:, 2] > 0.1 - xi / 2]
    plane = conics.on_plane(rays, xi)
    point = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    omega = conics.line_conic(normal, xi)
    scale = np.sum(point**2, axis=-1)
    assert np.all(np.abs(dot(point @ omega, point)) < 1e-12 * scale)
    pixel = np.concatenate([plane * FOCAL + CENTER, np.ones((len(plane), 1))], axis=-1)
    in_pixels = conics.to_pixels(omega, FOCAL, CENTER)
    assert np.all(np.abs(dot(pixel @ in_pixels, pixel)) < 1e-9 * scale)
    np.testing.assert_allclose(conics.from_pixels(in_pixels, FOCAL, CENTER), omega, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.4))
def test_normals_and_direction_come_back_from_conics(seed, xi):
    """Eq. 3, 10 (with its sign) and 11: the cylinder's own normals and direction."""
    rng = np.random.default_rng(seed)
    a, u = rng.normal(size=3) + np.array([0, 0, 0.5]), unit(rng.normal(size=3))
    radius = 0.3 * np.linalg.norm(np.cross(a, u)) + 1e-3
    normals = edge_normals(a, u, np.array(radius))
    # eq. 10 loses a plane that holds the camera's axis
    if np.min(np.abs(normals[:, 2])) < 1e-2:
        return
    leg = unit(a - dot(a, u) * u)
    omega = conics.cylinder_conics(a, u, np.array(radius), xi)
    back = conics.normal_from_conic(omega, leg)
    np.testing.assert_allclose(back, normals, atol=1e-9)
    np.testing.assert_allclose(conics.direction_from_normals(*back), u, atol=1e-8)


def test_without_the_mirror_the_conic_is_the_line_twice():
    """xi = 0: rank one, the pinhole's image line squared."""
    omega = conics.line_conic(unit(np.array([0.3, -0.5, 0.6])), 0.0)
    assert np.linalg.matrix_rank(omega, tol=1e-12) == 1


@pytest.fixture(scope="module")
def legs():
    """Edges of a hexapod's legs around a mirror: normals (n, 3), exact pixels, mean leg rays."""
    machine, rng = load_mechanism("gough-stewart"), np.random.default_rng(3)
    T = look_at(np.array([0.01, -0.02, 0.06]), np.array([0.01, -0.02, 0.5]), np.array([0, -1.0, 0]))
    poses = perturb(machine.home(), rng.normal(size=(200, 6)) * np.repeat([0.15, 0.03], 3))
    b = move((T @ poses)[:, None], machine.platform_centers())
    a = np.broadcast_to(move(T, machine.base_centers()), b.shape)
    length = np.linalg.norm(b - a, axis=-1, keepdims=True)
    u = (b - a) / length
    normal = edge_normals(a, u, np.full(a.shape[:-1], 0.014)).reshape(-1, 3)
    along = 0.02 + (length - 0.04) * np.linspace(0, 1, 150)
    two = [np.repeat(v.reshape(-1, v.shape[-1]), 2, axis=0) for v in (a, u, along)]
    points = (two[0] + 0.014 * normal)[:, None] + two[2][..., None] * two[1][:, None]
    return normal, mirror().project(points), unit(two[0] + 0.2 * two[1])


def rms_mrad(found, normal):
    return 1e3 * np.sqrt(np.mean(np.sum(cross(found, normal) ** 2, axis=-1)))


def test_three_fits_of_an_edge(legs):
    """At 0.2 px: the weighted circle is at its bound; a free conic is useless, as errata has it."""
    normal, pixel, leg = legs
    camera, rng = mirror(), np.random.default_rng(0)
    noisy = pixel + 0.2 * rng.normal(size=pixel.shape)
    rays, plane = camera.ray(noisy), conics.on_plane(camera.ray(noisy), 1.0)
    plain = conics.plain(rays, leg)
    best, covariance = conics.weighted(rays, camera.ray_jacobians(noisy)[0], leg)
    free = conics.free_conic(plane, leg)
    bound = 1e3 * 0.2 * np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))
    # 2400 edges: the rms is known to 2 %
    assert rms_mrad(best, normal) == pytest.approx(bound, rel=0.06)
    assert bound < 0.4
    assert rms_mrad(plain, normal) > 1.03 * bound
    assert rms_mrad(free, normal) > 50


def test_covariance_of_the_weighted_circle(legs):
    """Whitened errors are white: the stated covariance is the scatter's."""
    normal, pixel, leg = legs
    camera, rng = mirror(), np.random.default_rng(1)
    noisy = pixel + 0.3 * rng.normal(size=pixel.shape)
    rays = camera.ray(noisy)
    found, covariance = conics.weighted(rays, camera.ray_jacobians(noisy)[0], leg)
    basis = tangent_basis(found, rays.mean(axis=1))
    error = (np.swapaxes(basis, -1, -2) @ normal[..., None])[..., 0] / 0.3
    white = np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0]
    np.testing.assert_allclose(np.cov(white.T), np.eye(2), atol=0.1)


def test_edges_far_behind_the_image_plane():
    """More than 90 degrees from the axis: the plane is found as well as in front."""
    camera, normal = mirror(), unit(np.array([0.2, 0.9, 0.35]))
    basis = tangent_basis(normal, np.array([1.0, 0.3, -0.5]))
    angle = np.linspace(-0.4, 0.4, 100)
    rays = np.cos(angle)[:, None] * basis[:, 0] + np.sin(angle)[:, None] * basis[:, 1]
    assert rays[:, 2].max() < 0
    pixel = camera.project(rays)
    leg = -normal * 0.05 + basis[:, 0]
    found, _ = conics.weighted(camera.ray(pixel), camera.ray_jacobians(pixel)[0], leg)
    np.testing.assert_allclose(found, normal, atol=1e-9)
