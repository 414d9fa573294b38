"""The joint estimate: truth recovered, uncertainty that repeats confirm, wrong edges let go."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, pose_difference, register
from pkmcal.identify.assembly import assemble, batch_of, state_of
from pkmcal.identify.bundle import (
    bundle,
    marginalize_to_machine,
    solve_batch,
)
from pkmcal.identify.covariance import (
    Information,
    covariance_by_noise,
    identifiability,
    machine_covariance,
)
from pkmcal.identify.gauge import BestFit, ThreeCentres, centre_index, in_gauge
from pkmcal.identify.start import start_state
from pkmcal.measurements import Measurements
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.mechanisms import load_mechanism
from pkmcal.solver.search import Stop, take
from test_identify_scene import JOINT_NOISE, exact, guess, make_scene


def estimate(scene, measurements, rng, **options):
    start = start_state(scene.machine, measurements, guess(rng, scene.T_camera_base))
    return bundle(scene.machine, measurements, start, **options)


def registered_error(machine, theta, theta_true):
    """Largest distance of a joint centre from its true place, frames laid on each other, m."""
    worst = 0.0
    for index in centre_index(machine.layout):
        T = register(theta[index], theta_true[index])
        worst = max(worst, np.abs(apply(T, theta[index]) - theta_true[index]).max())
    return worst


def without_noise(rng, scene):
    clean = scene.measurements(rng, noise=0)
    return replace(clean, edges=replace(clean.edges, covariance=scene.covariance))


def stated_radii(scene):
    """Scene with true radii in the nominal model and no edge shift, so that nothing biases the
    estimate.
    """
    machine = scene.machine
    radius = machine.parameters.of_kind("radius")
    nominal = machine.parameters.nominal.copy()
    nominal[radius] = scene.theta[0, radius]
    machine = replace(machine, parameters=replace(machine.parameters, nominal=nominal))
    return replace(scene, machine=machine, edge_shift=np.zeros(1))


@pytest.mark.parametrize("robust", [False, True])
def test_truth_is_recovered_to_rounding(robust):
    rng = np.random.default_rng(0)
    # without the nominal model the readings' scales cannot be separated from the size of everything
    scene = make_scene(rng, machine=exact("gough-stewart"))
    scene = replace(scene, edge_shift=np.zeros(1))
    scene = stated_radii(scene)
    # edges drawn without shift, since the scene's own shift is now zero
    value = estimate(
        scene,
        without_noise(rng, scene),
        rng,
        use_prior=False,
        robust=robust,
        scale_noise=False,
    )
    truth = in_gauge(scene.machine, scene.state(), ThreeCentres())
    np.testing.assert_allclose(value.state.theta, truth.theta, atol=1e-11)
    np.testing.assert_allclose(value.state.T_camera_base, truth.T_camera_base, atol=1e-11)
    np.testing.assert_allclose(value.state.T_base_platform, truth.T_base_platform, atol=1e-11)
    assert value.statistics.chi2 < 1e-8
    assert value.statistics.stopped == Stop.CONVERGED.value


def test_uncertainty_is_what_repeats_show():
    """One hundred runs: errors divided by their covariance are standard normal, all of them
    together; so are chi2 and the estimated noise scale."""
    rng = np.random.default_rng(1)
    runs = 100
    scene = make_scene(rng, runs=runs, configurations=8, n_stations=2, in_view=0.6)
    assembled, truth = scene.batch(rng)
    start = replace(truth, z=0 * truth.z, columns=0 * truth.columns)
    result = solve_batch(assembled.problem, start, robust=False, scale_noise=False)
    assert set(result.solution.stop) == {Stop.CONVERGED}
    solution = result.solution.state
    whitened, single = [], []
    for run in range(runs):
        before = state_of(assembled, take(solution, np.array([run])), scene.state(run))
        shared = result.info.covariance[run]
        c = machine_covariance(assembled.problem, scene.machine, before, shared, ThreeCentres())
        rows = [in_gauge(scene.machine, s, ThreeCentres()) for s in (before, scene.state(run))]
        stations = pose_difference(rows[0].T_camera_base, rows[1].T_camera_base)
        error = np.concatenate([rows[0].theta - rows[1].theta, stations.ravel()])
        above_limit = np.diag(c) > 0
        error, c = error[above_limit], c[np.ix_(above_limit, above_limit)]
        scale = np.sqrt(np.diag(c))
        values, vectors = np.linalg.eigh(c / np.outer(scale, scale))
        keep = values > 1e-9  # the frames' second leg holds two combinations of three numbers
        whitened.append((vectors.T @ (error / scale))[keep] / np.sqrt(values[keep]))
        single.append(error / scale)
    whitened = np.array(whitened)
    n = whitened.shape[1]
    assert n == 60 + 12 - 12
    mean_square = np.sum(whitened**2) / (runs * n)
    assert mean_square == pytest.approx(1, abs=4 * np.sqrt(2 / (runs * n)))
    # no direction is over- or underestimated: eigenvalues within chance
    values = np.linalg.eigvalsh(whitened.T @ whitened / runs)
    edge = np.sqrt(n / runs)
    assert values.max() < (1 + edge) ** 2 * 1.15
    assert values.min() > (1 - edge) ** 2 * 0.7
    assert np.mean(np.abs(single) < 1.959964) == pytest.approx(0.95, abs=0.01)
    n = truth.z.shape[1] + 12 + 1
    dof = assembled.problem.data.weight.sum() * 2 + 8 * 6 + len(assembled.problem.prior) - n - 48
    assert np.mean(result.solution.cost) / dof == pytest.approx(1, abs=0.02)


def test_noise_scale_is_found():
    """Edges stated three times too sharp: the factor is found, and the covariance holds."""
    rng = np.random.default_rng(2)
    scene = make_scene(rng, runs=40, configurations=8, n_stations=2)
    assembled, truth = scene.batch(rng)
    data = assembled.problem.data
    problem = replace(assembled.problem, data=replace(data, white=3 * data.white))
    for robust in (False, True):
        result = solve_batch(problem, truth, robust=robust)
        n_edges = data.weight.sum() * 2
        assert result.noise_scale.mean() == pytest.approx(3, rel=0.01)
        assert result.noise_scale.std() == pytest.approx(3 / np.sqrt(2 * n_edges), rel=0.4)
        error = (result.solution.state.z - truth.z) ** 2
        variance = np.einsum("bii->bi", result.info.covariance)[:, : error.shape[1]]
        assert np.mean(error / variance) == pytest.approx(1, abs=0.15)


def shaded(scene, sigma, rng):
    """The scene with a shift (px) of its own for each side of a tube at each station."""
    lines = np.unique(scene.index[[0, 2, 3, 4]], axis=1, return_inverse=True)[1].ravel()
    shift = sigma * rng.normal(size=(len(scene.theta), lines.max() + 1))
    return replace(scene, shading=shift[:, lines])


@pytest.mark.parametrize("sigma", [pytest.param(0.03, marks=pytest.mark.slow), 0.3])
def test_shading_is_as_large_as_the_edges_say(sigma):
    """Shading as small as its prior, or ten times that, as in hard light on polished metal: it is
    estimated, and the standard deviations are right with either.
    """
    rng = np.random.default_rng(8)
    scene = shaded(make_scene(rng, runs=8, configurations=6, n_stations=2), sigma, rng)
    assembled, truth = scene.batch(rng)
    result = solve_batch(assembled.problem, truth)
    values = np.sqrt(np.mean(result.info.problem.shading**2))
    assert values == pytest.approx(sigma, rel=0.1)
    error = (result.solution.state.z - truth.z) ** 2
    variance = np.einsum("bii->bi", result.covariance)[:, : error.shape[1]]
    assert np.mean(error / variance) == pytest.approx(1, abs=0.15)


def test_a_line_that_is_another_things_edge_is_let_go():
    """One tube's side is measured at a highlight's border, 3 px inside, in every image: the shading
    of all others is not enlarged, and the errors are as stated.
    """
    rng = np.random.default_rng(8)
    scene = shaded(make_scene(rng, runs=20, configurations=6, n_stations=2), 0.1, rng)
    lines = scene.index[[0, 2, 3, 4]]
    wrong = np.all(lines == lines[:, :1], axis=0)
    scene = replace(scene, shading=np.where(wrong, -3.0, scene.shading))
    assembled, truth = scene.batch(rng)
    result = solve_batch(assembled.problem, truth)
    assert np.median(result.info.problem.shading) == pytest.approx(0.1, rel=0.2)
    error = (result.solution.state.z - truth.z) ** 2
    variance = np.einsum("bii->bi", result.info.covariance)[:, : error.shape[1]]
    assert np.mean(error / variance) == pytest.approx(1, abs=0.25)


def test_stated_noise_is_kept_when_asked():
    rng = np.random.default_rng(3)
    scene = make_scene(rng)
    assert (
        estimate(scene, scene.measurements(rng), rng, scale_noise=False).statistics.noise_scale == 1
    )


@pytest.mark.parametrize("share", [pytest.param(0.05, marks=pytest.mark.slow), 0.2])
def test_wrong_edges_change_nothing_that_matters(share):
    """Edges replaced by another leg's: the same answer within 1.5 of its standard deviations."""
    scene = make_scene(np.random.default_rng(10), configurations=20)
    rng = np.random.default_rng(0)
    clean = estimate(scene, scene.measurements(np.random.default_rng(100)), rng)
    dirty_data = scene.measurements(np.random.default_rng(100), wrong=share)
    dirty = estimate(scene, dirty_data, rng)
    sigma = np.sqrt(np.diag(dirty.covariance))
    above_limit = sigma > 1e-9
    change = (dirty.state.theta - clean.state.theta)[above_limit] / sigma[above_limit]
    assert np.abs(change).max() < 1.5
    wrong = np.any(
        dirty_data.edges.normal != scene.measurements(np.random.default_rng(100)).edges.normal,
        axis=1,
    )
    far = np.linalg.norm(dirty_data.edges.normal - scene.normal[0], axis=1) > 0.005
    assert np.all(dirty.edge_weights[wrong & far] < 0.05)
    assert np.mean(dirty.edge_weights[~wrong] > 0.9) > 0.995


def test_robustness_costs_nothing_on_clean_edges():
    rng = np.random.default_rng(4)
    scene = make_scene(rng, runs=60, configurations=8, n_stations=2)
    assembled, truth = scene.batch(rng)
    plain = solve_batch(assembled.problem, truth, robust=False)
    robust = solve_batch(assembled.problem, truth, robust=True)
    nz = truth.z.shape[1]
    sigma = np.sqrt(np.einsum("bii->bi", plain.info.covariance)[:, :nz])
    loss = np.mean(((robust.solution.state.z - truth.z) / sigma) ** 2)
    loss = loss / np.mean(((plain.solution.state.z - truth.z) / sigma) ** 2) - 1
    assert loss < 0.01


def test_starts_far_away_find_the_same_answer():
    """Parameters 5 mm off, stations 5 degrees and 50 mm off."""
    rng = np.random.default_rng(5)
    scene = make_scene(rng, runs=30, configurations=10)
    assembled, truth = scene.batch(rng)
    centres = assembled.problem.free.T @ (scene.machine.parameters.nominal * 0 + 1) > 0
    z = truth.z + rng.uniform(-0.005, 0.005, truth.z.shape) * centres * (
        np.array(scene.machine.parameters.kinds) != "radius"
    )
    stations = np.stack([guess(rng, T, 0.09, 0.05) for T in truth.T_camera_base])
    start = replace(truth, z=z, T_camera_base=stations)
    for robust in (False, True):
        far = solve_batch(assembled.problem, start, robust=robust, scale_noise=False)
        near = solve_batch(assembled.problem, truth, robust=robust, scale_noise=False)
        np.testing.assert_allclose(far.solution.cost, near.solution.cost, rtol=1e-3)
        np.testing.assert_allclose(far.solution.state.z, near.solution.state.z, atol=3e-6)


def test_configurations_that_nobody_imaged():
    """Configurations without inliers do not enter the estimate; their poses follow from the
    readings.
    """
    rng = np.random.default_rng(6)
    scene = make_scene(rng, configurations=10)
    full = scene.measurements(rng)
    unseen = np.array([2, 7])
    part = replace(full, edges=full.edges.select(~np.isin(full.edges.configuration, unseen)))
    value = estimate(scene, part, rng)
    assert not value.configurations[unseen].any()
    assert value.configurations.sum() == 8
    assert not value.joint_residuals[unseen].any()
    keep = np.setdiff1d(np.arange(10), unseen)
    row = np.searchsorted(keep, part.edges.configuration)
    only = replace(part, joints=part.joints[keep], edges=replace(part.edges, configuration=row))
    same = estimate(scene, only, rng)
    # the starts differ, so the robust weights may stop a hair apart
    np.testing.assert_allclose(value.state.theta, same.state.theta, atol=1e-7)
    poses = value.machine.forward(part.joints[unseen])
    np.testing.assert_allclose(value.state.T_base_platform[unseen], poses, atol=1e-9)


@pytest.mark.parametrize("edges_left", [0, 1, 4])
def test_a_station_that_sees_almost_nothing_does_no_harm(edges_left):
    rng = np.random.default_rng(7)
    scene = make_scene(rng)
    full = scene.measurements(rng)
    keep = full.edges.station != 1
    without = estimate(scene, replace(full, edges=full.edges.select(keep)), rng)
    keep = keep.copy()
    keep[np.flatnonzero(~keep)[:edges_left]] = True
    values = estimate(scene, replace(full, edges=full.edges.select(keep)), rng)
    sigma = np.sqrt(np.diag(without.covariance))
    change = (values.state.theta - without.state.theta)[sigma > 1e-9] / sigma[sigma > 1e-9]
    assert np.abs(change).max() < (0.3 if edges_left else 1e-3)
    assert np.isfinite(values.covariance).all()
    width = np.sqrt(np.einsum("sii->si", values.station_covariance)).max(axis=1)
    assert width[1] > 1.0  # metres or radians: unknown
    assert width[[0, 2]].max() < 0.01


def test_result_statistics_add_up():
    rng = np.random.default_rng(8)
    scene = make_scene(rng)
    value = estimate(scene, scene.measurements(rng), rng)
    s = value.statistics
    assert s.chi2 == pytest.approx(s.chi2_edges + s.chi2_joints + s.chi2_drawing)
    assert s.chi2 / s.dof == pytest.approx(1, abs=0.1)
    weighted = np.sum(value.edge_weights * np.sum(value.edge_residuals**2, axis=1))
    assert weighted == pytest.approx(s.chi2_edges, rel=1e-6)
    assert np.sum(value.joint_residuals**2) == pytest.approx(s.chi2_joints)
    readings = value.machine.inverse(value.state.T_base_platform)
    measured = scene.measurements(np.random.default_rng(8)).joints
    assert np.abs(readings - measured).max() < 5 * JOINT_NOISE * 10
    held = np.diag(value.covariance) == 0
    assert held.sum() >= 6
    assert np.all(value.data_share[~held] <= 1)
    assert np.median(value.data_share) > 0.9


def test_chi2_shows_noise_that_was_stated_seven_times_too_small():
    """The noise as found makes chi2 one whatever was stated."""
    rng = np.random.default_rng(8)
    scene = make_scene(rng)
    full = scene.measurements(rng)
    honest = estimate(scene, full, rng).statistics
    assert honest.chi2_as_stated == pytest.approx(1, abs=0.15)
    edges = replace(full.edges, covariance=full.edges.covariance / 49)
    s = estimate(scene, replace(full, edges=edges), rng).statistics
    assert s.chi2 / s.dof == pytest.approx(1, abs=0.1)
    assert s.chi2_as_stated == pytest.approx(s.chi2_edges * 49 / s.dof, rel=0.2)


def test_constraints_on_a_machine_replace_the_data_behind_them():
    """One station's edges with a marginal prior of the machine from the other's, against both
    jointly.
    """
    rng = np.random.default_rng(20)
    scene = make_scene(rng, configurations=12, n_stations=2)
    both = scene.measurements(rng)
    first = (both.edges.station == 0) & (both.edges.configuration < 6)
    second = (both.edges.station == 1) & (both.edges.configuration >= 6)
    # nothing but the machine, and a little the camera, is in common
    one, other, all_ = (
        replace(both, edges=both.edges.select(part)) for part in (first, second, first | second)
    )
    start = start_state(scene.machine, both, guess(rng, scene.T_camera_base))
    plain = {"robust": False, "scale_noise": False}
    before = bundle(scene.machine, one, start, **plain)
    information = marginalize_to_machine(before.linearized.info)
    start = replace(start, theta=before.state.theta)
    fit = bundle(scene.machine, other, start, marginal_prior=information, **plain)
    together = bundle(scene.machine, all_, start, **plain)
    sigma = np.sqrt(np.diag(together.covariance))
    above_limit = sigma > 0
    off = (fit.state.theta - together.state.theta)[above_limit] / sigma[above_limit]
    assert np.abs(off).max() < 0.5
    alone = bundle(scene.machine, other, start, **plain)
    shifted = (alone.state.theta - together.state.theta)[above_limit] / sigma[above_limit]
    assert np.sqrt(np.mean(off**2)) < 0.2 * np.sqrt(np.mean(shifted**2))
    ratio = np.sqrt(np.diag(fit.covariance))[above_limit] / sigma[above_limit]
    np.testing.assert_allclose(ratio, 1, atol=0.05)
    # with the nominal model as prior; without it the result still has the requested gauge
    without = bundle(
        scene.machine, other, start, marginal_prior=information, use_prior=False, **plain
    )
    np.testing.assert_array_equal(without.state.theta, fit.state.theta)
    # a motion below its standard deviation changes nothing; by the nominal model alone it did
    after = marginalize_to_machine(together.linearized.info)
    assert after.like(after)
    assert not after.like(replace(information, free=np.zeros_like(information.free)))


def test_fixed_and_tied_parameters():
    machine = load_mechanism("gough-stewart")
    names = machine.parameters.names
    radii = tuple(n for n in names if n.endswith("tubes[1].radius"))
    table = machine.parameters.with_roles(fixed=("legs[3].length.offset",), tied=(radii,))
    machine = replace(machine, parameters=table)
    rng = np.random.default_rng(9)
    scene = make_scene(rng, machine=machine)
    value = estimate(scene, scene.measurements(rng), rng)
    fixed = table.index("legs[3].length.offset")
    assert value.state.theta[fixed] == table.nominal[fixed]
    assert value.covariance[fixed].max() == 0
    tied = [table.index(n) for n in radii]
    change = value.state.theta[tied] - table.nominal[tied]
    np.testing.assert_allclose(change, change[0], atol=1e-15)
    np.testing.assert_allclose(np.diag(value.covariance)[tied], value.covariance[tied[0], tied[1]])
    truth = in_gauge(machine, scene.state(), ThreeCentres())
    sigma = np.sqrt(np.diag(value.covariance))
    above_limit = sigma > 1e-9
    assert np.abs((value.state.theta - truth.theta)[above_limit] / sigma[above_limit]).max() < 4.5


def test_full_rank_of_a_good_session():
    rng = np.random.default_rng(20)
    scene = make_scene(rng)
    assembled = assemble(scene.machine, scene.measurements(rng), ThreeCentres())
    state = batch_of(scene.machine, assembled, scene.state())
    value = identifiability(Information(assembled.problem, state), scene.machine)
    assert value.n_frames == 12
    # the common scale of radii against the edge shift is soft, but nothing is lost
    assert value.rank == value.n_parameters - 12
    assert not value.unidentified


def test_what_cannot_be_identified_is_named():
    """A tube that no edge shows: its radius, and nothing else."""
    rng = np.random.default_rng(21)
    scene = make_scene(rng)
    full = scene.measurements(rng)
    hidden = (full.edges.leg == 3) & (full.edges.tube == 1)
    part = replace(full, edges=full.edges.select(~hidden))
    assembled = assemble(scene.machine, part, ThreeCentres())
    state = batch_of(scene.machine, assembled, scene.state())
    results = identifiability(Information(assembled.problem, state), scene.machine)
    assert [d.names for d in results.unidentified] == [("legs[4].tubes[2].radius",)]
    result = estimate(scene, part, rng)
    radius = scene.machine.parameters.index("legs[4].tubes[2].radius")
    info = result.linearized.info
    assert identifiability(info, result.machine).unidentified[0].names == (
        "legs[4].tubes[2].radius",
    )
    assert result.data_share[radius] == pytest.approx(0, abs=1e-9)
    assert result.state.theta[radius] == pytest.approx(scene.machine.parameters.nominal[radius])


def test_one_configuration_is_singular_and_two_suffice():
    """Errata, A: one configuration alone leaves directions open."""
    rng = np.random.default_rng(22)
    for configurations, complete in ((1, False), (2, True)):
        machine = exact("gough-stewart")
        scene = make_scene(rng, configurations=configurations, in_view=1.0, machine=machine)
        assembled = assemble(scene.machine, scene.measurements(rng), ThreeCentres())
        state = batch_of(scene.machine, assembled, scene.state())
        value = identifiability(Information(assembled.problem, state), scene.machine)
        assert (not value.unidentified) == complete


def test_every_configuration_seen_from_one_station_only():
    rng = np.random.default_rng(23)
    scene = make_scene(rng, configurations=24)
    full = scene.measurements(rng)
    keep = full.edges.station == full.edges.configuration % 3
    value = estimate(scene, replace(full, edges=full.edges.select(keep)), rng)
    truth = in_gauge(scene.machine, scene.state(), ThreeCentres())
    sigma = np.sqrt(np.diag(value.covariance))
    above_limit = sigma > 1e-9
    assert np.abs((value.state.theta - truth.theta)[above_limit] / sigma[above_limit]).max() < 4.5
    assert value.statistics.chi2 / value.statistics.dof == pytest.approx(1, abs=0.1)


def test_two_cameras_have_their_own_edge_shift():
    rng = np.random.default_rng(24)
    scene = make_scene(rng, configurations=20, tolerance=0.3)
    m = scene.measurements(rng)
    m = replace(m, camera_of_station=np.array([0, 1, 0]))
    value = estimate(scene, m, rng)
    assert value.state.columns[EDGE_SHIFT].shape == (2,)
    np.testing.assert_allclose(
        value.state.columns[EDGE_SHIFT],
        scene.edge_shift[0],
        atol=4 * value.column_sigma(EDGE_SHIFT).max(),
    )


def test_wrong_inputs_are_reported():
    rng = np.random.default_rng(25)
    scene = make_scene(rng)
    good = scene.measurements(rng)
    start = scene.state()
    with raises(InputError, code="measurements.none"):
        bundle(scene.machine, replace(good, edges=good.edges.select(np.zeros(0, int))), start)
    with raises(InputError, found="5 columns"):
        bundle(scene.machine, replace(good, joints=good.joints[:, :5]), start)
    with raises(InputError, found="11, 2", expected="below 4, 3"):
        bundle(scene.machine, replace(good, joints=good.joints[:4]), start)


@pytest.mark.parametrize("gauge", [ThreeCentres(), ThreeCentres((1, 3, 5)), BestFit()])
def test_results_do_not_depend_on_the_gauge(gauge):
    """Without nominal values the solver itself uses the gauge's rows; distances must not depend on
    them.
    """
    rng = np.random.default_rng(26)
    scene = make_scene(rng)
    m = scene.measurements(rng)
    start = start_state(scene.machine, m, scene.T_camera_base)
    options = {"use_prior": False, "robust": False, "scale_noise": False}
    reference = bundle(scene.machine, m, start, **options)
    other = bundle(scene.machine, m, start, gauge=gauge, **options)
    assert registered_error(scene.machine, other.state.theta, reference.state.theta) < 1e-11
    assert other.statistics.chi2 == pytest.approx(reference.statistics.chi2, rel=1e-9)
    for index in centre_index(scene.machine.layout):
        i, j = np.triu_indices(6, 1)
        for a, b in zip(index[i], index[j], strict=True):
            assert distance_sigma(other, a, b) == pytest.approx(distance_sigma(reference, a, b))


def distance_sigma(value, a, b):
    """Standard deviation of the distance between two centres: the same in every frame."""
    e = value.state.theta[a] - value.state.theta[b]
    e = e / np.linalg.norm(e)
    c = value.covariance
    spread = c[np.ix_(a, a)] + c[np.ix_(b, b)] - c[np.ix_(a, b)] - c[np.ix_(b, a)]
    return np.sqrt(e @ spread @ e)


def test_measurements_are_not_changed():
    rng = np.random.default_rng(27)
    scene = make_scene(rng)
    m = scene.measurements(rng)
    copy = Measurements(
        replace(m.edges, normal=m.edges.normal.copy()),
        m.joints.copy(),
        m.joint_noise,
        m.n_stations,
        m.camera_of_station.copy(),
    )
    estimate(scene, m, rng)
    np.testing.assert_array_equal(m.edges.normal, copy.edges.normal)
    np.testing.assert_array_equal(m.joints, copy.joints)


def test_what_noise_makes_of_a_covariance_is_not_what_was_known_before():
    """Least squares with measured rows J and prior rows P."""
    rng = np.random.default_rng(0)
    J, P = rng.normal(size=(2, 9, 4)), rng.normal(size=(3, 4))
    C = np.linalg.inv(J.mT @ J + P.T @ P)
    info = SimpleNamespace(problem=SimpleNamespace(prior=P), covariance=C)
    np.testing.assert_allclose(covariance_by_noise(info), C @ (J.mT @ J) @ C, rtol=1e-9)


def test_what_looks_scatter_by_is_in_the_deviations_and_nowhere_else():
    rng = np.random.default_rng(3)
    scene = make_scene(rng)
    measurements = scene.measurements(rng)
    fit = bundle(scene.machine, measurements, scene.state())
    measurements = replace(measurements, imputation_covariance=0.5)
    more = bundle(scene.machine, measurements, scene.state())
    np.testing.assert_array_equal(more.state.theta, fit.state.theta)
    np.testing.assert_array_equal(more.edge_residuals, fit.edge_residuals)
    assert more.statistics.look_scatter == pytest.approx(np.sqrt(0.5))
    assert fit.statistics.look_scatter == 0
    larger = np.linalg.eigvalsh(more.joint_covariance - fit.joint_covariance)
    assert larger.min() > -1e-9 * larger.max()
    n = len(fit.data_share)
    before, after = (np.diag(e.joint_covariance)[:n] for e in (fit, more))
    values, drawn = fit.data_share > 0.99, (fit.data_share < 0.01) & (before > 0)
    assert values.any()
    # readings' scales, radii and shading are determined partly by edges, and are drawn in part
    assert np.all(after[values] > 1.1 * before[values])
    assert np.all(after <= 1.5001 * before)
    np.testing.assert_allclose(after[drawn], before[drawn], rtol=0.02)
    assert np.all(more.data_share > -0.01)  # no less is known than was drawn
    assert np.all(more.column_sigma(EDGE_SHIFT) >= fit.column_sigma(EDGE_SHIFT))
    assert np.all(more.line_shift_sigma >= fit.line_shift_sigma)
