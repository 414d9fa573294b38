"""[B]'s hexapod around a mirror: its linear method with wrong edges, and the joint one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pkmcal
from pkmcal.cameras import camera_models
from pkmcal.geometry.cylinders import edge_normal_jacobians, line_through, tangent_basis
from pkmcal.geometry.rigid import apply, dot, look_at, perturb
from pkmcal.identify.methods import linear
from pkmcal.judge.against_truth import compare_with_truth
from pkmcal.placement.stations import StationPose
from pkmcal.simulation import Settings
from rendered import rendered

RADIUS = 0.014
CONFIGURATIONS, LEGS = 60, 6


def mirror():
    parameters = np.array([173.6, 173.3, 319.8, 240.2, 1.0, 0, 0, 0, 0])
    return camera_models()["unified"]((640, 480), parameters)


def plane_of(rays, by_pixel, leg_ray):
    """Normals (..., 3) of the planes of an edge's rays (..., n, 3), away from the leg, and their
    covariance (..., 2, 2) in :func:`tangent_basis` at the mean ray for noise of 1 px: maximum
    likelihood by Gauss-Newton, weights 1 / (n' J J' n), by_pixel J (..., n, 3, 2).
    """
    normal = np.linalg.svd(rays.mT @ rays)[2][..., -1, :]
    normal = -normal * np.sign(dot(normal, leg_ray))[..., None]
    for _ in range(6):
        basis = tangent_basis(normal, rays.mean(axis=-2))
        slope = (normal[..., None, None, :] @ by_pixel)[..., 0, :]
        rows = rays @ basis
        weighted = (rows / dot(slope, slope)[..., None]).mT
        misfit = dot(rays, normal[..., None, :])[..., None]
        turn = np.linalg.solve(weighted @ rows, weighted @ misfit)
        normal = normal - (basis @ turn)[..., 0]
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal, np.linalg.inv(weighted @ rows)


def edges_around_a_mirror(rng):
    """Fitted normals (6, 120, 3) at 0.2 px, their covariances and the true base centres."""
    camera, machine = mirror(), pkmcal.load_mechanism("gough-stewart")
    T = look_at(np.array([0.01, -0.02, 0.06]), np.array([0.01, -0.02, 0.5]), np.array([0, -1.0, 0]))
    spread = np.array([0.4, 0.4, 0.4, 0.07, 0.07, 0.05])
    poses = perturb(machine.home(), rng.uniform(-1, 1, (CONFIGURATIONS, 6)) * spread)
    centres = apply(T, machine.base_centers())
    b = apply((T @ poses)[None], machine.platform_centers()[:, None])
    a = np.broadcast_to(centres[:, None], b.shape)
    u, _ = line_through(a, b)
    n = edge_normal_jacobians(a[..., None, :], b[..., None, :], np.array(RADIUS), np.arange(2)).n
    length = np.linalg.norm(b - a, axis=-1)[..., None]
    along = (0.02 + (length - 0.04) * np.linspace(0, 1, 100))[:, :, None]
    points = (a[:, :, None] + RADIUS * n)[..., None, :] + along[..., None] * u[:, :, None, None]
    pixel = camera.project(points) + 0.2 * rng.normal(size=(*points.shape[:-1], 2))
    rays = camera.ray(pixel)
    leg = (a + 0.2 * u)[:, :, None] * np.ones((1, 1, 2, 1))
    normal, covariance = plane_of(rays, camera.ray_jacobians(pixel)[0], leg)
    basis = tangent_basis(normal, rays.mean(axis=-2))
    spread = basis @ (0.04 * covariance) @ np.swapaxes(basis, -1, -2)
    return normal.reshape(LEGS, -1, 3), spread.reshape(LEGS, -1, 3, 3), centres


def errors(method, share, runs=8):
    """Root mean square error (m) of the base centres with a share of another leg's edges."""
    squares = []
    for run in range(runs):
        rng = np.random.default_rng(run)
        normal, noise, centres = edges_around_a_mirror(rng)
        wrong, noise_of = normal.copy(), noise.copy()
        for leg in range(LEGS):
            bad = np.flatnonzero(rng.random(normal.shape[1]) < share)
            other = (leg + rng.integers(1, LEGS, len(bad))) % LEGS
            place = rng.integers(0, normal.shape[1], len(bad))
            wrong[leg, bad], noise_of[leg, bad] = normal[other, place], noise[other, place]
        radius, present = np.full(wrong.shape[:2], RADIUS), np.ones(wrong.shape[:2])
        values, _, _ = linear.solve_regressions(wrong, radius, present, noise_of, method, rng)
        squares.append(np.mean(np.sum((values - centres) ** 2, axis=-1)))
    return float(np.sqrt(np.mean(squares)))


@pytest.fixture(scope="module")
def clean():
    return errors("robust", 0.0)


def test_linear_method_on_clean_edges(clean):
    """Two tenths of a millimetre at 0.2 px: distance comes from the leg's apparent width alone."""
    assert clean < 0.25e-3
    assert errors("plain", 0.0, 4) < 0.3e-3


@pytest.mark.parametrize(
    "share", [*(pytest.param(share, marks=pytest.mark.slow) for share in (0.05, 0.2)), 0.35]
)
def test_least_median_holds_with_wrong_edges(clean, share):
    """Within 1.3 of the clean result, as good as the edges that are left can be."""
    assert errors("robust", share) < 1.3 * clean


@pytest.mark.parametrize("method", ["plain", "huber", "tukey"])
def test_plain_and_m_regressions_collapse(method):
    """5 % of wrong edges: the solution falls into the camera, where every residual is only R."""
    assert errors(method, 0.05, 2) > 50e-3


@pytest.mark.slow
def test_a_hexapod_seen_through_a_mirror(tmp_path):
    """Rendered images from between the legs, one place, to a fifth of the nominal error."""
    folder = Path(tmp_path) / "session"
    station = StationPose((0.01, -0.02, 0.07), (0.01, -0.02, 0.4), (0.0, -1.0, 0.0))
    settings = Settings(
        stations=(station,), configurations=8, rough_position=0.02, rough_angle=0.05
    )
    rendered(folder, pkmcal.load_mechanism("gough-stewart"), mirror(), settings, seed=3)
    value = pkmcal.calibrate(folder)
    result = compare_with_truth(value, folder)
    assert result.calibrated.centre < result.drawing.centre / 5
    assert result.calibrated.position < result.drawing.position / 5
    # 44 correlated values: 95 % expected within two deviations
    assert result.within > 0.8 * result.count
