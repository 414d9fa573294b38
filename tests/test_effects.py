"""Effects on measurements: one entry makes an unknown with a prior, or a violation without one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.score import ScoreTests
from pkmcal.identify.start import start_state
from pkmcal.measurements import Column
from pkmcal.measurements.effects import EDGE_SHIFT, columns_of_effects
from test_identify_scene import make_scene

PRIOR = 1e-3


def tilted(prior):
    """A made-up effect: edges of the second station turn in their planes, by one number."""

    def effect(measurements):
        own = np.flatnonzero(measurements.edges.station == 1)
        turn = np.tile([0.0, 1.0], (len(own), 1))[..., None]
        yield Column("test.tilt", "station 2", edges=turn, edge_rows=own, prior=prior)

    return effect


def warm(prior):
    """A made-up effect: the first motor's readings drift with time, by one number."""

    def effect(measurements):
        by = np.zeros((*measurements.joints.shape, 1))
        by[:, 0, 0] = np.linspace(-1, 1, len(by))
        yield Column("test.drift", "leg 1", readings=by, prior=prior)

    return effect


def wrong_by(measurements, effect, number):
    """The measurements as they are where the effect is of that size."""
    (column,) = effect(measurements)
    edges, joints = measurements.edges, measurements.joints
    if column.readings is not None:
        joints = joints - column.readings[..., 0] * number
    if column.edges is not None:
        turn = (edges.basis[column.edge_rows] @ column.edges)[..., 0]
        normal, basis = edges.normal.copy(), edges.basis.copy()
        normal[column.edge_rows] -= number * turn
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        basis -= normal[..., None] * (normal[:, None] @ basis)
        edges = replace(edges, normal=normal, basis=np.linalg.qr(basis)[0])
        sign = np.sign(np.einsum("nij,nij->nj", edges.basis, measurements.edges.basis))
        edges = replace(edges, basis=edges.basis * sign[:, None])
    return replace(measurements, edges=edges, joints=joints)


@pytest.fixture(scope="module")
def scene():
    return make_scene(np.random.default_rng(2), configurations=10)


@pytest.mark.parametrize(("effect", "number"), [(tilted, 8e-4), (warm, 4e-4)])
def test_an_effect_with_a_prior_is_estimated(scene, effect, number):
    measurements = scene.measurements(np.random.default_rng(3))
    measurements = wrong_by(measurements, effect(None), number)
    start = start_state(scene.machine, measurements, scene.T_camera_base)
    with_prior = replace(measurements, effects=(effect(np.full((1, 1), PRIOR)),))
    estimate = bundle(scene.machine, with_prior, start)
    (code,) = estimate.state.columns.keys() - {EDGE_SHIFT}
    (value,), (sigma,) = estimate.state.columns[code], estimate.column_sigma(code)
    assert sigma < 0.3 * PRIOR
    assert abs(value - number) < 4 * sigma
    without = bundle(scene.machine, measurements, start)
    assert estimate.statistics.chi2_as_stated < without.statistics.chi2_as_stated


@pytest.mark.parametrize(("effect", "number"), [(tilted, 8e-4), (warm, 4e-4)])
def test_an_effect_without_a_prior_is_detected(scene, effect, number):
    measurements = scene.measurements(np.random.default_rng(3))
    tested = replace(measurements, effects=(effect(None),))
    for data, detected in ((tested, []), (wrong_by(tested, effect(None), number), [0])):
        start = start_state(scene.machine, data, scene.T_camera_base)
        estimate = bundle(scene.machine, data, start, scale_noise=False, robust=False)
        listed = [one for one in columns_of_effects(data) if one.prior is None]
        tests = ScoreTests(*estimate.linearized, listed)
        assert [k for k, _ in tests.significant()] == detected
        if detected:
            fit = tests.fitted(detected)[0]
            assert abs(fit.value[0] - number) < 4 * fit.sigma[0]


@pytest.mark.parametrize("effect", [tilted, warm])
def test_derivatives_of_an_effect_are_those_of_the_residuals(scene, effect):
    measurements = scene.measurements(np.random.default_rng(4))
    data = replace(measurements, effects=(effect(np.full((1, 1), PRIOR)),))
    assembled = assemble(scene.machine, data, ThreeCentres())
    start = start_state(scene.machine, data, scene.T_camera_base)
    problem, state = assembled.problem, batch_of(scene.machine, assembled, start)
    (code,) = (code for code, _ in problem.unknowns.codes if code != EDGE_SHIFT)
    (at,) = problem.unknowns.columns(code)
    change = np.zeros_like(state.columns)
    change[0, at - problem.unknowns.effects.start] = 1e-6
    ahead, behind = (
        problem.residuals(replace(state, columns=state.columns + sign * change)).value
        for sign in (1, -1)
    )
    by = problem.linearize(state).by_shared[..., at]
    np.testing.assert_allclose(by, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-3)
    assert np.abs(by).max() > 100


def test_a_prior_needs_effects_on_measurements(scene):
    """Motions are linear about a solution only."""

    def effect(measurements):
        motion = np.zeros((measurements.n_stations, len(measurements.joints), 6, 1))
        yield Column("test.motion", motion=motion, prior=np.eye(1))

    data = replace(scene.measurements(np.random.default_rng(5)), effects=(effect,))
    with raises(InputError, code="effect.prior_of_motion") as caught:
        assemble(scene.machine, data, ThreeCentres())
    assert "test.motion" in caught.value.what


def without_derivatives(prior):
    """A made-up effect that moves nothing where it is linearized."""

    def effect(measurements):
        own = np.flatnonzero(measurements.edges.station == 1)
        yield Column("test.none", edges=np.zeros((len(own), 2, 1)), edge_rows=own, prior=prior)

    return effect


def test_structure_does_not_depend_on_the_values_of_derivatives(scene):
    """A column of zeros has the places of one with values; its number keeps its prior, and nothing
    else changes.
    """
    measurements = scene.measurements(np.random.default_rng(6))
    prior = np.full((1, 1), PRIOR)
    zero, other = (
        replace(measurements, effects=(effect(prior),)) for effect in (without_derivatives, tilted)
    )
    one, two = (assemble(scene.machine, data, ThreeCentres()).problem for data in (zero, other))
    np.testing.assert_array_equal(one.blocks.column, two.blocks.column)
    assert one.data.columns.shape == two.data.columns.shape
    start = start_state(scene.machine, measurements, scene.T_camera_base)
    estimate, without = (bundle(scene.machine, data, start) for data in (zero, measurements))
    assert estimate.state.columns["test.none"] == pytest.approx(0, abs=1e-12)
    assert estimate.column_sigma("test.none") == pytest.approx(PRIOR, rel=1e-6)
    np.testing.assert_allclose(estimate.state.theta, without.state.theta, atol=1e-12)


def test_lines_keep_their_places_where_edges_do_not_shift(scene):
    """Each edge depends on the numbers of its camera and of its line, whatever its derivative."""
    measurements = scene.measurements(np.random.default_rng(6))
    edges = measurements.edges
    still = replace(edges, shift=np.zeros_like(edges.shift))
    shaded, zero = (replace(measurements, edges=one, shaded=True) for one in (edges, still))
    one, two = (assemble(scene.machine, data, ThreeCentres()).problem for data in (shaded, zero))
    np.testing.assert_array_equal(one.blocks.column, two.blocks.column)
    assert one.blocks.column.shape[-1] == 2
    (many,) = (
        column for column in columns_of_effects(shaded) if column.subject == "station 1, leg 0"
    )
    whole = many.edges_of(len(edges))
    assert np.count_nonzero(whole.any(axis=1), axis=1).max() == 1
    np.testing.assert_array_equal(whole.sum(axis=2)[many.edge_rows], many.edges[..., 0])
