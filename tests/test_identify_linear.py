"""[B] 14-16 and [A]'s four steps on edges: exact without noise, unmoved by wrong edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import apply, perturb
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import ThreeCentres, centre_index, in_gauge
from pkmcal.identify.methods.four_step import four_step
from pkmcal.identify.methods.linear import centres, procrustes_scale, scale_ratio
from test_identify_scene import exact, guess
from test_identify_scene import make_scene as scene_of

METHODS = ["plain", "huber", "tukey", "least-median", "robust", "errors-in-variables"]


def make_scene(rng, **options):
    """The papers' methods have no scales of readings."""
    return scene_of(rng, **{"machine": exact("gough-stewart"), **options})


def true_radii(scene):
    """Nominal model with the run's true radii and no edge shift, as [B] assumes."""
    radius = scene.machine.parameters.of_kind("radius")
    values = scene.machine.values.copy()
    values[radius] = scene.theta[0, radius]
    return scene.machine.with_values(values)


def setup(seed, configurations=40, wrong=0.0, noise=1.0):
    rng = np.random.default_rng(seed)
    scene = replace(make_scene(rng, configurations=configurations), edge_shift=np.zeros(1))
    machine = true_radii(scene)
    base = scene.theta[0][centre_index(machine.layout)[0]]
    truth = apply(scene.T_camera_base[:, None], base)
    return scene, machine, truth, scene.measurements(rng, noise=noise, wrong=wrong)


@pytest.mark.parametrize("method", METHODS)
def test_exact_without_noise(method):
    _, machine, truth, m = setup(0, noise=0)
    np.testing.assert_allclose(centres(machine, m, method).centres, truth, atol=1e-10)


@pytest.mark.parametrize("method", ["robust", "errors-in-variables"])
def test_uncertainty_of_the_centres(method):
    """Errors over many stations and legs agree with their covariance."""
    squares = []
    for seed in range(12):
        _, machine, truth, m = setup(seed)
        value = centres(machine, m, method)
        error = value.centres - truth
        inverse = np.linalg.inv(value.covariance)
        squares.append(np.einsum("sli,slij,slj->sl", error, inverse, error))
    n = np.size(squares)
    assert np.mean(squares) == pytest.approx(3, abs=4 * np.sqrt(6 / n))


def test_no_shrinkage_towards_the_camera():
    """Plain least squares pulls A to the camera under strong noise, errors-in-variables not."""
    bias = {}
    for method in ("plain", "errors-in-variables"):
        radial = []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            scene = make_scene(rng, configurations=60, noise=6.0)
            scene = replace(scene, edge_shift=np.zeros(1))
            machine = true_radii(scene)
            base = scene.theta[0][centre_index(machine.layout)[0]]
            truth = apply(scene.T_camera_base[:, None], base)
            error = centres(machine, scene.measurements(rng), method).centres - truth
            radial.append(np.sum(error * truth, axis=-1) / np.linalg.norm(truth, axis=-1))
        bias[method] = np.mean(radial), np.std(radial) / np.sqrt(np.size(radial))
    mean, sigma = bias["plain"]
    assert mean < -5 * sigma
    mean, sigma = bias["errors-in-variables"]
    assert abs(mean) < 4 * sigma


@pytest.mark.parametrize("wrong", [0.01, 0.2, 0.35])
def test_wrong_edges(wrong):
    """Errata, B: M-estimators that start from least squares collapse, least median holds."""
    _, machine, truth, clean = setup(3)
    _, _, _, dirty = setup(3, wrong=wrong)
    errors = {
        method: np.abs(centres(machine, dirty, method).centres - truth).max() for method in METHODS
    }
    reference = np.abs(centres(machine, clean, "robust").centres - truth).max()
    assert errors["robust"] < 2.5 * reference
    assert errors["least-median"] < 0.02
    assert errors["plain"] > 0.05
    if wrong > 0.1:
        assert min(errors["huber"], errors["tukey"]) > 0.3


def test_legs_that_were_not_seen_are_nan():
    _, machine, _, m = setup(4, configurations=6)
    hidden = (m.edges.station == 0) & (m.edges.leg == 2)
    once = (m.edges.station == 1) & (m.edges.leg == 3) & (m.edges.configuration > 0)
    m = replace(m, edges=m.edges.select(~hidden & ~once))
    for method in METHODS:
        values = centres(machine, m, method)
        assert np.isnan(values.centres[0, 2]).all()
        assert np.isnan(values.centres[1, 3]).all()
        assert np.isfinite(values.centres[2]).all()


def test_scale_of_the_radius():
    """[B] 16: a stated radius 2 % too large scales all centres by 1.02; both forms find it."""
    scene, machine, truth, m = setup(5, noise=0)
    radius = machine.parameters.of_kind("radius")
    values = machine.values.copy()
    values[radius] *= 1.02
    value = centres(machine.with_values(values), m, "plain").centres[0]
    np.testing.assert_allclose(value, 1.02 * truth[0], rtol=1e-9)
    base = scene.theta[0][centre_index(machine.layout)[0]]
    assert scale_ratio(value, base) == pytest.approx(1.02)
    assert procrustes_scale(value, base) == pytest.approx(1.02)
    # the pairs 40 mm apart dominate the mean of ratios once the nominal model is a little wrong
    rng = np.random.default_rng(6)
    nominals = base + 5e-4 * rng.normal(size=(200, 6, 3))
    spread = [np.std([f(value, d) for d in nominals]) for f in (scale_ratio, procrustes_scale)]
    assert spread[0] > 1.5 * spread[1]


def four_step_error(scene, value):
    truth = in_gauge(scene.machine, scene.state(), ThreeCentres())
    return np.abs(value.theta - truth.theta)[scene.machine.parameters.of_kind("center")].max()


def test_four_steps_are_exact_without_noise():
    scene, machine, _, m = setup(7, noise=0)
    value = four_step(machine, m)
    truth = in_gauge(scene.machine, scene.state(), ThreeCentres())
    np.testing.assert_allclose(value.theta, truth.theta, atol=1e-9)
    np.testing.assert_allclose(value.T_camera_base, truth.T_camera_base, atol=1e-9)
    np.testing.assert_allclose(value.T_base_platform, truth.T_base_platform, atol=1e-9)


def test_products_of_distances_leave_depth_open():
    """Errata, A 9 and 16: as printed, the noise-free solution keeps the nominal error in z."""
    scene, machine, _, m = setup(8, noise=0)
    value = four_step(machine, m, form="printed")
    truth = in_gauge(scene.machine, scene.state(), ThreeCentres())
    for index in centre_index(machine.layout):
        error = np.abs((value.theta - truth.theta)[index])
        assert error[:, 2].max() > 5e-4
        assert error[:, :2].max() < 0.2 * error[:, 2].max()
    np.testing.assert_allclose(
        value.theta[machine.layout.rod], truth.theta[machine.layout.rod], atol=1e-8
    )


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_four_steps_start_the_bundle(wrong):
    """Robust enough that the joint estimate ends where it ends from the truth."""
    scene, machine, _, m = setup(9, wrong=wrong)
    start = four_step(machine, m)
    assert four_step_error(scene, start) < 0.03
    fit = bundle(scene.machine, m, start)
    best = bundle(scene.machine, m, scene.state())
    np.testing.assert_allclose(fit.state.theta, best.state.theta, atol=5e-6)
    assert fit.statistics.chi2 / fit.statistics.dof == pytest.approx(1, abs=0.05)


def test_four_steps_with_four_legs_a_station_and_one_station_a_configuration():
    scene, machine, _, m = setup(10, configurations=60, noise=0.2)
    edges = m.edges
    legs = np.array([[0, 1, 2, 3], [2, 3, 4, 5], [4, 5, 0, 1]])
    keep = (edges.leg[:, None] == legs[edges.station]).any(axis=1)
    keep &= edges.station == edges.configuration % 3
    part = replace(m, edges=edges.select(keep))
    start = four_step(machine, part)
    assert four_step_error(scene, start) < 0.03
    exact = setup(10, configurations=60, noise=0)[3]
    exact = replace(exact, edges=exact.edges.select(keep))
    assert four_step_error(scene, four_step(machine, exact)) < 1e-8
    fit = bundle(scene.machine, part, start)
    assert fit.statistics.stopped == "converged"


def test_a_station_with_two_legs_needs_its_pose():
    scene, machine, _, m = setup(11)
    keep = (m.edges.station != 1) | (m.edges.leg < 2)
    part = replace(m, edges=m.edges.select(keep))
    with raises(ResultError, code="method.few_legs") as caught:
        four_step(machine, part)
    assert caught.value.what.startswith("station 2 ")
    rough = guess(np.random.default_rng(0), scene.T_camera_base, 0.01, 0.01)
    values = four_step(machine, part, T_camera_base_guess=rough)
    np.testing.assert_array_equal(values.T_camera_base[1], rough[1])
    assert four_step_error(scene, values) < 0.03


def test_a_leg_that_no_station_sees_is_reported():
    _, machine, _, m = setup(12)
    part = replace(m, edges=m.edges.select(m.edges.leg != 4))
    with raises(ResultError, code="method.leg_not_visible") as caught:
        four_step(machine, part)
    assert caught.value.what.startswith("leg 5 ")


def test_answers_do_not_depend_on_where_the_camera_frame_lies():
    """The same scene with rotated cameras' axes: the centres rotate along."""
    _, machine, _, m = setup(13)
    turn = perturb(np.eye(4), np.array([0.4, -0.8, 1.1, 0, 0, 0]))[:3, :3]
    turned = replace(m.edges, normal=m.edges.normal @ turn.T, basis=turn @ m.edges.basis)
    rng = [np.random.default_rng(1) for _ in range(2)]
    plain = centres(machine, m, "robust", rng[0]).centres
    other = centres(machine, replace(m, edges=turned), "robust", rng[1]).centres
    np.testing.assert_allclose(other, plain @ turn.T, atol=1e-9)
