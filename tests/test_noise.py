"""The noise of readings as the data show it: found where stated wrong, left alone where not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.calibration.handheld import localize_case
from pkmcal.calibration.localization import boards_of
from pkmcal.calibration.refinement import identify_poses
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.covariance import Information
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.noise import (
    LEAST_NOISE_FREEDOM,
    NOISE,
    NoiseShares,
    components,
    noise_shares,
)
from pkmcal.identify.row_sums import LINK_ROWS, POSE_ROWS, READING_ROWS
from pkmcal.identify.start import start_state
from pkmcal.measurements.distances import DistanceSet
from pkmcal.measurements.rows import RowGroups
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome.progress import no_progress
from pkmcal.session.load import load_session
from pose_sessions import T_CAMERA_BASE, T_PLATFORM_BOARD, measured, upright
from test_identify_scene import JOINT_NOISE, exact, make_scene
from test_pose_sessions import make

RUNS = 8
WITHIN = [-0.1, -0.1, -0.525, -0.35], [0.1, 0.1, -0.375, 0.35]
"""Places and turns of an H4, m and rad."""


def batch(seed, true, stated, runs=RUNS, configurations=6, **options):
    """A problem of many runs whose readings have the noise ``true`` and state ``stated``, m."""
    rng = np.random.default_rng(seed)
    scene = make_scene(rng, runs=runs, configurations=configurations, n_stations=2, **options)
    exact = scene.joints
    assembled, truth = scene.batch(rng)
    data = assembled.problem.data
    joints = exact + true * rng.normal(size=exact.shape)
    problem = replace(
        assembled.problem, data=replace(data, joints=joints), joint_noise=np.array([stated])
    )
    return problem, truth


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_variances_are_as_their_shares_say(factor):
    """Readings whose noise is ``factor`` times what they count for, beside edges about as sharp:
    means over a hundred runs, and their scatter; z are independent of each other."""
    machine = exact("gough-stewart")
    problem, truth = batch(1, factor * 4e-5, 4e-5, runs=100, machine=machine)
    result = solve_batch(problem, truth, robust=False, scale_noise=False)
    value, shares = components(result.info, result.weight), result.reading_noise
    real = shares.fixed < 1  # no padding
    assert np.sum(shares.own**2, axis=1).mean() > LEAST_NOISE_FREEDOM  # there is a warning
    u = shares.z / np.sqrt(factor**2 * shares.own + shares.others + shares.fixed)
    assert np.mean(u[real] ** 2) == pytest.approx(1, abs=4 * np.sqrt(2 / real.sum()))
    for part in (shares.own < 0.2, shares.own > 0.8):  # of each kind by itself
        some = part & real
        assert np.mean(u[some] ** 2) == pytest.approx(1, abs=4 * np.sqrt(2 / some.sum()))
    assert np.mean(u[:, 1:] * u[:, :-1]) == pytest.approx(0, abs=4 / np.sqrt(real.sum()))
    if factor == 1:
        expected = value.freedom[:, READING_ROWS]
        assert np.mean(value.chi2[:, READING_ROWS] / expected) == pytest.approx(1, abs=0.1)


def coverage(configurations, true, chance, runs):
    """Shares of runs in which the interval of the readings' noise contains the truth, and in which
    each of its ends is finite.
    """
    problem, truth = batch(7, true, true, runs=runs, configurations=configurations)
    value = solve_batch(problem, truth, robust=False, scale_noise=False)
    low, high = value.reading_noise.interval(chance)
    return np.mean((low <= 1) & (high >= 1)), np.mean(low > 0), np.mean(np.isfinite(high))


def test_an_interval_of_95_per_cent_holds_the_truth_as_often():
    """Within four standard deviations of what chance makes of 150 runs."""
    share, low, high = coverage(8, 3e-4, 0.05, 150)
    assert abs(share - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 150)
    assert low == high == 1


@pytest.mark.slow
@pytest.mark.parametrize("configurations", [6, 15])
@pytest.mark.parametrize("true", [3e-6, 3e-5, 1e-4, 3e-4, 3e-3])
def test_intervals_hold_the_truth_as_often_as_they_state(configurations, true):
    """With edges that determine a pose to some 0.1 mm: readings far better, equal, and worse.

    An interval that begins at zero may contain the truth more often: there is no lower end.
    """
    share, low, _ = coverage(configurations, true, 0.05, 400)
    assert share > 0.92
    assert share < (0.98 if low > 0.5 else 1.0)
    assert coverage(configurations, true, NOISE.contradiction_chance, 400)[0] > 0.985


def tracked(folder):
    """Estimate of a tracker's session, without the tests of hypotheses of a calibration."""
    session = load_session(folder)
    case = localize_case(session, [], boards_of(session, []), np.random.default_rng(0))
    cameras = refinement_of(session, False)
    places = case.scene.T_camera_base
    return identify_poses(session, case.boards, places, cameras, no_progress).estimate


def test_intervals_of_tracked_poses_hold_the_truth_as_often(tmp_path):
    """Those of readings and of poses, of hexapods that a tracker measured."""
    right = []
    for seed in range(12):
        made = make(tmp_path / str(seed), "gough-stewart", n=16, seed=seed)
        estimate = tracked(made.folder)
        start = batch_of(estimate.machine, estimate.problem, estimate.state)
        result = solve_batch(estimate.problem.problem, start, scale_noise=False)
        for kind in (READING_ROWS, POSE_ROWS):
            low, high = result.noise_of(kind).interval(0.05)
            right.append(low[0] <= 1 <= high[0])
    # of 24 right ones of 95 %, four are wrong once in forty cases
    assert np.sum(right) > 20


def test_noise_of_edges_that_poses_take_up_is_not_that_of_readings():
    """Correlated edges, so that poses absorb half or twice of the error of independent ones.

    In each pose as if its edges were as much sharper or worse, while their own residuals show
    nothing of it. Readings a hundred times sharper than poses do not show their noise there, and
    nothing is concluded about it.
    """
    rng = np.random.default_rng(8)
    own = np.exp(rng.uniform(np.log(1e-5), np.log(0.05), (40, 90)))
    for factor in (0.5, 2.0):
        z = np.sqrt(own + factor**2 * (1 - own)) * rng.normal(size=own.shape)
        shares = NoiseShares(z, own, 1 - own, np.zeros_like(own))
        low, high = shares.interval(0.05)
        assert np.mean((low <= 1) & (high >= 1)) > 0.85
        assert not np.any(shares.contradicts())


@pytest.mark.parametrize(("true", "stated"), [(3e-6, 3e-3), (3e-4, 3e-6)])
def test_a_noise_that_is_stated_wrong_is_found(true, stated):
    """Stated noise wrong by a hundred or a thousand, either way: estimates are as accurate and as
    honest as with the right one, and edges are not reported.
    """
    problem, truth = batch(2, true, stated)
    right = replace(problem, joint_noise=np.array([true]))
    value, best = (solve_batch(p, truth) for p in (problem, right))
    low, high = value.reading_noise.interval()
    scale = value.reading_scale * stated / true  # of the noise in use, to the true one
    assert np.all((low * scale < 1) & (high * scale > 1))
    assert np.all(value.reading_scale != 1)
    np.testing.assert_array_less(value.noise_scale, 1.1)
    error, least = ((r.solution.state.z - truth.z) ** 2 for r in (value, best))
    assert error.sum() == pytest.approx(least.sum(), rel=0.1)
    promised, honest = (np.einsum("bii->bi", r.info.covariance).sum() for r in (value, best))
    assert promised == pytest.approx(honest, rel=0.1)  # which test_bundle holds against repeats


def test_a_noise_that_is_stated_right_is_left_alone():
    """One in a hundred may be flagged; among forty no more than two."""
    problem, truth = batch(3, JOINT_NOISE, JOINT_NOISE, runs=40)
    values = solve_batch(problem, truth)
    assert np.sum(values.reading_scale != 1) <= 2


def test_where_the_data_cannot_decide_nothing_is_claimed():
    """Edges determine the platform to some ten micrometres: they do not show whether readings have
    errors of three micrometres or of three hundredths, and it makes no difference.
    """
    problem, truth = batch(4, 3e-6, 3e-8)
    values = solve_batch(problem, truth)
    np.testing.assert_array_equal(values.reading_scale, 1.0)
    low, high = values.reading_noise.interval()
    assert np.all(low == 0)
    assert np.all(high > 100)


def test_too_few_degrees_of_freedom_decide_nothing():
    few = np.ones((1, 4))
    for z in (0.0, 100.0):
        shares = NoiseShares(z * few, few, 0 * few, 0 * few)
        assert shares.interval() == (0.0, np.inf)
        assert not shares.contradicts()


def test_a_table_whose_noise_is_stated_too_large_is_reported(tmp_path):
    """But not used: errors common to all of a tracker's measurements do not scatter."""
    folder = make(tmp_path / "session", "gough-stewart", "poses").folder
    text = (folder / "session.yaml").read_text(encoding="utf-8")
    wrong = text.replace("position: 2.0e-05", "position: 2.0e-4").replace(
        "rotation: 0.0001", "rotation: 0.001"
    )
    assert wrong != text
    for content, values in ((text, 0), (wrong, 1)):
        (folder / "session.yaml").write_text(content, encoding="utf-8")
        calibration = calibrate_session(folder)
        words = calibration.verdict.of("poses.noise")
        assert [one.facts["keys"] for one in words] == [["stations.tracker.tracker.noise"]] * values
        assert calibration.estimate.statistics.pose_scale == pytest.approx(1, abs=0.2)


def pose_problem(name, pairs=()):
    """A built-in machine's table of poses, at a state near the truth; pairs : of configurations
    between which a distance of the board was measured.
    """
    rng = np.random.default_rng(5)
    truth = load_mechanism(name)
    case = measured(truth, upright(rng.uniform(*WITHIN, (9, 4))), rng)
    data = case.measurements
    if pairs:
        ends, n = np.array(pairs), len(pairs)
        place = (case.poses @ T_PLATFORM_BOARD)[:, :3, 3]
        apart = np.linalg.norm(place[ends[:, 1]] - place[ends[:, 0]], axis=1)
        apart += 3e-5 * rng.normal(size=n)
        none = np.zeros(n, dtype=int)
        links = DistanceSet("distances.csv", ends, none, apart, np.full(n, 3e-5), none)
        data = replace(data, links=(links,))
    start = start_state(truth, data, T_CAMERA_BASE[None])
    assembled = assemble(truth, data, default_gauge(truth))
    return assembled.problem, batch_of(truth, assembled, start)


def test_directions_of_the_prior_alone_contradict_no_noise():
    """Nominal errors of degrees: their second order is in the residuals, and not in the shares."""
    z = np.random.default_rng(3).normal(size=(1, 60))
    own = np.full((1, 60), 0.9)
    z[:, :3], own[:, :3] = [39.0, 32.0, -9.0], 3e-7
    others = np.full((1, 60), 0.02)
    others[:, :3] = 1e-7
    shares = NoiseShares(z, own, others, 1 - own - others)
    assert not shares.contradicts()
    assert shares.best == pytest.approx(1, abs=0.3)
    assert shares.stated_chance(np.ones(1))[0] > 0.05


def test_a_noise_stated_far_too_small_is_estimated():
    """Where the prior has nearly all of the variance that is stated."""
    z = np.random.default_rng(4).normal(size=(1, 60))
    own, others = np.full((1, 60), 5e-3), np.full((1, 60), 1e-4)
    z *= np.sqrt(100**2 * own + others + 1 - own - others)
    shares = NoiseShares(z, own, others, 1 - own - others)
    assert shares.contradicts()
    assert shares.best == pytest.approx(100, rel=0.3)


@pytest.mark.parametrize("name", ["edges", "h4", "h4-rods", "h4 with distances"])
def test_traces_are_those_of_the_hat_matrix(name):
    """All rows as one dense matrix; h4-rods has two rods for a motor, of which half a row each is
    the reading's and the rest of no kind.
    """
    if name == "edges":
        problem, state = batch(4, 1e-4, 1e-4, runs=1)
    else:
        pairs = [(0, 3), (3, 5), (5, 0), (7, 2)] if name == "h4 with distances" else []
        problem, state = pose_problem(name.split()[0], pairs)
    linear = problem.linearize(state)
    _, k, r, na = linear.by_shared.shape
    d, c = linear.by_own.shape[-1], len(linear.shared_by)
    jac = np.zeros((k * r + c, na + k * d))
    jac[: k * r, :na], jac[k * r :, :na] = linear.by_shared[0].reshape(-1, na), linear.shared_by
    for j in range(k):
        jac[j * r : (j + 1) * r, na + j * d : na + (j + 1) * d] = linear.by_own[0, j]
    jac /= np.maximum(np.linalg.norm(jac, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(jac, full_matrices=False)
    q = u[: k * r, s > 1e-10 * s[0]]
    m, n = problem.layout.n_readings, problem.layout.n_equations
    pick = np.zeros((k, m, r))
    unit = np.broadcast_to(np.eye(n)[:, None], (n, k, n))
    pick[..., problem.closure_rows] = np.moveaxis(
        [problem.joint_rows(row[None], state)[0] for row in unit], 0, -1
    )
    every = np.eye(k * r).reshape(k, r, k * r)
    of = [*(every[:, kind.rows] for kind in problem.row_groups), pick @ every]
    of = [part.reshape(-1, k * r) for part in of]
    used = problem._in_use[0].ravel()
    of = [part[np.abs(part) @ used > 0] for part in of]
    weight = RowGroups(*(kind.present[None].astype(float) for kind in problem.row_groups))
    results = components(Information(problem, state), weight)
    residual = [[a @ b.T - (a @ q) @ (b @ q).T for b in of] for a in of]
    freedom = np.array([np.trace(residual[i][i]) for i in range(4)])
    np.testing.assert_allclose(results.freedom[0], freedom, atol=1e-5)
    for kind in (READING_ROWS, POSE_ROWS, LINK_ROWS):
        part = of[kind]
        shares = noise_shares(Information(problem, state), kind)
        if not part.size:
            assert not shares.z.size
            continue
        size, turn = np.linalg.eigh(residual[kind][kind])
        some = size > 1e-9
        # R is idempotent: what is left of a direction is its own part of the variance
        np.testing.assert_allclose(np.sort(shares.own[0])[-some.sum() :], size[some], atol=1e-5)
        z = part @ problem.linearize(state).value[0].ravel()
        distance = (turn[:, some].T @ z) ** 2 / size[some]
        assert np.sum(shares.z**2) == pytest.approx(distance.sum(), rel=1e-3)
        np.testing.assert_allclose(shares.own + shares.others + shares.fixed, 1, atol=1e-12)
    assert freedom[READING_ROWS] > 1e-3  # the data contain information on each kind
