"""Smooth errors of the model: found, scaled and contained in the covariance; none where none is."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from pkmcal.calibration.calibrate import calibrate_measurements
from pkmcal.calibration.camera_refinement import edges_by_camera
from pkmcal.calibration.discrepancy_basis import (
    DISCREPANCY_BASIS,
    discrepancy_components,
    smooth_functions,
    with_discrepancy,
)
from pkmcal.calibration.faults import WRONG_MODEL_READING_SCALE, noise_fault
from pkmcal.calibration.model_violations import model_violations
from pkmcal.geometry.cylinders import line_through, tangent_basis
from pkmcal.identify.bundle import bundle
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.discrepancy import Component, discrepancy_of
from pkmcal.identify.row_sums import READING_ROWS
from pkmcal.identify.score import ScoreTests, columns_of
from pkmcal.identify.start import start_state
from pkmcal.identify.tool import tool_error
from pkmcal.measurements import Column
from test_model_violations import measured, scales

FEW = 14
"""Configurations of sessions that dense algebra takes whole."""


def session_estimate(seed, change=None, count=30):
    """Nominal model, measurements, estimate and its final problem, of a session whose readings a
    function has changed.
    """
    if change is None:
        return right_session(seed, count)
    nominal, data, where = measured(seed, count=count)
    true = data.joints.copy()
    data = replace(data, joints=true + change(true))
    estimate = bundle(nominal, data, start_state(nominal, data, where))
    return nominal, data, estimate, true


@lru_cache(4)
def right_session(seed, count):
    """Session with unchanged readings."""
    nominal, data, where = measured(seed, count=count)
    return nominal, data, bundle(nominal, data, start_state(nominal, data, where)), data.joints


def scales_in_use(estimate):
    return estimate.statistics.reading_scale, estimate.statistics.pose_scale


def discrepancy_in(data, estimate, named=()):
    return discrepancy_of(
        *estimate.linearized,
        discrepancy_components(data, estimate),
        named,
        scales_in_use(estimate),
    )


def dense(assembled, info, effects):
    """Jacobian (n, p) of all unknowns, residuals (n,) and the effects' columns (n, k)."""
    own, shared = info.problem.linearize(info.state), info.problem.unknowns.count
    count = len(own.value[0])
    by_own = np.zeros((count, own.value.shape[-1], count, own.by_own.shape[-1]))
    by_own[np.arange(count), :, np.arange(count)] = own.by_own[0]
    rows = own.value.size
    J = np.concatenate([own.by_shared[0].reshape(rows, -1), by_own.reshape(rows, -1)], axis=1)
    prior = np.pad(own.shared_by, ((0, 0), (0, J.shape[1] - shared)))
    columns = columns_of(assembled, info.state, effects)(slice(0, count), own)
    G = np.where(own.usable[0][..., None], columns, 0.0).reshape(rows, -1)
    r = np.append(own.value[0].ravel(), own.shared_value[0])
    return np.concatenate([J, prior]), r, np.pad(G, ((0, len(prior)), (0, 0)))


def test_scale_and_covariance_are_those_of_dense_algebra():
    """Against the restricted likelihood of all rows at once, and the gain of least squares."""
    rng = np.random.default_rng(5)
    functions = rng.standard_normal((FEW, 6, 3))
    _, _, estimate, _ = session_estimate(
        5, lambda _: 3e-4 * functions @ [0.5, -1.0, 0.4], count=FEW
    )
    assembled, info = estimate.linearized
    root = np.array([[1.0, 0, 0], [0.5, 1, 0], [0, 0, 2.0]])
    one = Component(Column("functions", readings=functions), (root,))
    result = discrepancy_of(assembled, info, [one])
    (scaled,) = result.scales

    J, r, G = dense(assembled, info, [one.column])
    length = np.maximum(np.linalg.norm(J, axis=0), 1e-30)
    u, s, _ = np.linalg.svd(J / length, full_matrices=True)
    residual = u[:, np.sum(s > 1e-10 * s[0]) :]
    H, y = residual.T @ G @ root, residual.T @ r

    def likelihood(scale):
        V = np.eye(len(y)) + scale**2 * H @ H.T
        return -0.5 * (np.linalg.slogdet(V)[1] + y @ np.linalg.solve(V, y))

    ratio = 2 * (likelihood(scaled.scale) - likelihood(0.0))
    assert ratio == pytest.approx(scaled.ratio, rel=1e-3)
    for factor in (0.8, 1.25):
        assert likelihood(scaled.scale) > likelihood(factor * scaled.scale)
    D = scaled.scale * G @ root
    gain = (np.linalg.pinv(J / length, rcond=1e-10) / length[:, None]) @ D
    gain = gain[: info.problem.unknowns.count]
    inside = np.linalg.inv(np.eye(3) + scaled.scale**2 * H.T @ H)
    mean = -inside @ (scaled.scale * H.T @ y)
    expected = gain @ (np.outer(mean, mean) + inside) @ gain.T
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(result.shared, expected, atol=2e-3 * np.max(size) ** 2, rtol=0.02)


def test_scores_beside_random_effects_are_those_of_correlated_noise():
    rng = np.random.default_rng(6)
    _, data, estimate, _ = session_estimate(6, lambda q: 2e-3 * q * (np.arange(6) == 1), count=FEW)
    assembled, info = estimate.linearized
    root = 2e-4 * np.array([[1.0, 0.0], [0.3, 0.7]])
    random = Column("random", readings=rng.standard_normal((FEW, 6, 2)), prior=root)
    tests = [Column("test", readings=by) for by in scales(data)[:2]]
    scores = ScoreTests(assembled, info, tests, beside=[random]).scores()
    J, r, G = dense(assembled, info, [*tests, random])
    V = np.eye(len(r)) + G[:, 2:] @ root @ root.T @ G[:, 2:].T
    white = np.linalg.inv(np.linalg.cholesky(V))
    A = white @ J
    u, s, _ = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=0), 1e-30), full_matrices=False)
    u = u[:, s > 1e-10 * s[0]]
    for k, score in enumerate(scores):
        g, y = (x - u @ (u.T @ x) for x in (white @ G[:, k], white @ r))
        assert score.chi2 == pytest.approx((g @ y) ** 2 / (g @ g), rel=1e-3)


def loads(nominal, data, estimate):
    """Forces (K, m) in the legs under the platform's weight, less their mean, mean size one."""
    ends = nominal.ends_at(data.joints, estimate.state.T_base_platform)
    u = line_through(ends.a, ends.b)[0]
    arm = np.cross(ends.b - estimate.state.T_base_platform[:, None, :3, 3], u)
    rows = np.concatenate([u, arm], axis=-1).swapaxes(1, 2)
    force = np.linalg.solve(rows, np.tile([0, 0, 1.0, 0, 0, 0], (len(u), 1))[..., None])[..., 0]
    force = force / np.mean(np.abs(force))
    return force - force.mean(axis=0)


def tool_in_sigmas(truth, estimate, joints):
    """Error of the tool at true poses and readings, in its standard deviations."""
    machine = estimate.machine
    covariance = free_of_gauge(machine, estimate.covariance)
    off = tool_error(truth[0], machine, covariance, truth[1], joints)
    return float(np.sqrt(np.mean(off.off_position**2) / np.mean(off.position**2)))


def test_legs_that_give_way_are_found_and_contained():
    """Session with a right one's estimate as truth, and readings shortened by the legs' load."""
    nominal, data, right, true = session_estimate(1)
    sag = 2e-4 * loads(nominal, data, right)
    truth = right.machine, right.state.T_base_platform
    data = replace(data, joints=true + sag)
    estimate = bundle(nominal, data, right.state)
    result = discrepancy_in(data, estimate)
    assert result.scales[0].code == "readings.workspace"
    contained = with_discrepancy(estimate, result)
    before, after = (tool_in_sigmas(truth, x, true) for x in (estimate, contained))
    assert before > 3
    assert after < 3


def test_readings_that_lag_are_reported_by_their_steps():
    lag = 0.02

    def change(q):
        return -lag * np.diff(q, axis=0, prepend=q[:1])

    _, data, estimate, _ = session_estimate(2, change)
    result = discrepancy_in(data, estimate)
    assert result.scales[0].code == "readings.step"
    step = np.std(change(data.joints))
    assert step / 3 < result.scales[0].scale < 3 * step


@pytest.mark.parametrize(
    "seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (4, 5))]
)
def test_a_right_session_has_no_discrepancy(seed):
    _, data, estimate, _ = session_estimate(seed)
    assert discrepancy_in(data, estimate).scales == ()


@pytest.mark.slow
def test_right_sessions_seldom_have_one():
    results = [discrepancy_in(*session_estimate(seed)[1:3]).scales for seed in range(100, 140)]
    assert sum(map(bool, results)) <= 2


def test_noisy_readings_are_noise_and_hardly_more():
    """White noise that is stated a tenth: the smooth part adds little to the covariance."""
    rng = np.random.default_rng(0)
    _, data, estimate, _ = session_estimate(9, lambda q: 3e-5 * rng.standard_normal(q.shape))
    assert estimate.statistics.reading_scale > 3
    result = discrepancy_in(data, estimate)
    contained = with_discrepancy(estimate, result)
    offsets = estimate.machine.parameters.of_kind("offset")
    more, before = (np.diag(x.covariance)[offsets].sum() for x in (contained, estimate))
    assert more < 2 * before


def test_smooth_functions_are_orthonormal_and_have_unit_size():
    points = np.random.default_rng(1).standard_normal((40, 6)) * [1, 1, 1, 0.2, 0.2, 0.2]
    functions, roots = smooth_functions(points)
    np.testing.assert_allclose(functions.T @ functions / 40, np.eye(functions.shape[1]), atol=1e-9)
    np.testing.assert_allclose(functions.mean(axis=0), 0, atol=1e-9)
    assert len(roots) == len(DISCREPANCY_BASIS.lengths)
    straight = points - points.mean(axis=0)
    straight = np.linalg.qr(straight)[0]
    shares = []
    for root in roots:
        values = functions @ root
        assert np.mean(np.sum(values**2, axis=1)) == pytest.approx(1)
        shares.append(np.sum((straight.T @ values) ** 2) / np.sum(values**2))
    assert shares[0] < 0.6
    assert shares[-1] > 0.9
    assert shares == sorted(shares)


def test_one_pose_has_no_smooth_functions():
    functions, roots = smooth_functions(np.zeros((5, 6)))
    assert functions.shape == (5, 0)
    assert roots == ()


def through_lens(calibrated, change, stations):
    """Discrepancy if some stations' images were taken by a camera whose parameters differ by
    ``change`` (n,) from the file's.
    """
    session, observation = calibrated.session, calibrated.observation
    edges = calibrated.measurements.edges
    by = edges_by_camera(observation, [station.camera for station in session.stations])
    turn = -np.where(np.isin(edges.station, stations)[:, None], by @ change, 0.0)
    normal = edges.normal + (edges.basis @ turn[..., None])[..., 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    basis = tangent_basis(normal, edges.basis[..., 0])
    edges = replace(edges, normal=normal, basis=basis)
    measurements = replace(calibrated.measurements, edges=edges)
    estimate = bundle(session.machine, measurements, calibrated.estimate.state)
    observation = replace(observation, edges=edges)
    return model_violations(session, observation, measurements, estimate)


def test_pixels_that_are_not_square_are_named(calibrated):
    camera = calibrated.session.stations[0].camera
    stations = list(range(len(calibrated.session.stations)))
    value = through_lens(calibrated, 0.006 * camera.aspect_part, stations)
    first = value.violations[0]
    assert (first.code, first.of) == ("camera.aspect", "cameras/camera.yaml")
    assert abs(first.value[0] - 0.006) < 4 * first.sigma[0]


def test_a_station_with_another_lens_than_its_file_is_named(calibrated):
    camera = calibrated.session.stations[1].camera
    value = through_lens(calibrated, 0.02 * camera.aspect_part, [1])
    first = value.violations[0]
    name = calibrated.session.station_names[1]
    assert (first.code, first.of) == ("station.aspect", name)
    assert first.value[0] == pytest.approx(0.02, abs=4 * first.sigma[0] + 4e-3)


def test_a_right_session_has_no_errors_left_out(calibrated):
    assert calibrated.model_errors == ()
    assert calibrated.verdict.of("discrepancy") == ()


def test_readings_far_beyond_their_noise_are_no_noise(calibrated):
    def reasons(factor):
        statistics = replace(calibrated.estimate.statistics, reading_scale=factor)
        value = replace(calibrated.estimate, statistics=statistics)
        return [one.code for one in noise_fault(calibrated.session, value)]

    tolerance = calibrated.session.machine.document.tolerance.offset
    assert WRONG_MODEL_READING_SCALE * calibrated.session.joint_noise < tolerance
    assert reasons(0.9 * WRONG_MODEL_READING_SCALE) == []
    assert reasons(1.1 * WRONG_MODEL_READING_SCALE) == ["readings.noise_beyond_encoders"]


def test_edges_measured_elsewhere_give_the_same_machine(calibrated):
    """Of a session with other readings, such as other configurations."""
    state, session = calibrated.estimate.state, calibrated.session
    session = replace(session, joints=np.roll(session.joints, 3, axis=0))
    other = calibrate_measurements(
        session, calibrated.observation, calibrated.measurements, state.T_camera_base
    )
    off = other.machine.values - calibrated.machine.values
    sigma = np.sqrt(np.diag(calibrated.estimate.covariance))
    assert np.all(np.abs(off) <= 0.05 * sigma + 1e-9)
    assert other.verdict.usable == calibrated.verdict.usable


def test_components_act_in_the_readings_units():
    _, data, estimate, _ = session_estimate(3)
    components = discrepancy_components(data, estimate)
    codes = [one.code for one in components]
    assert len(set(codes)) == len(codes)
    for one in components:
        assert one.column.count == len(one.roots[0])
        if READING_ROWS in one.inflates:
            for root in one.roots:
                size = np.sum((one.column.readings @ root) ** 2, axis=-1)
                assert np.mean(size) == pytest.approx(1, rel=0.2)
