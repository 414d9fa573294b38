"""The batched solver against dense algebra, and its ways of stopping."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.methods.registration import Dense, minimise_dense
from pkmcal.solver.elimination import Linear, eliminate, rows_on_shared
from pkmcal.solver.kernels import final_weights, geman_mcclure_weights
from pkmcal.solver.marquardt import Damping
from pkmcal.solver.ranks import column_space, inverse_root, normal_root
from pkmcal.solver.search import SearchOptions, Stop, minimise, of_runs, put, take
from pkmcal.solver.strips import Compact, StripLayout, Strips, compact, normal_equations
from test_identify_scene import guess, make_scene


def random_linear(rng, runs=3, k=4, r=9, na=5, d=3, c=4) -> Linear:
    return Linear(
        rng.normal(size=(runs, k, r)),
        rng.normal(size=(runs, k, r, na)),
        rng.normal(size=(runs, k, r, d)),
        np.ones((runs, k, r), dtype=bool),
        rng.normal(size=(runs, c)),
        rng.normal(size=(c, na)),
    )


def dense(linear: Linear, run: int) -> tuple[np.ndarray, np.ndarray]:
    """The whole Jacobian and residual of a run, own unknowns after the shared ones."""
    _, k, r, na = linear.by_shared.shape
    d, c = linear.by_own.shape[-1], linear.shared_value.shape[1]
    jac = np.zeros((k * r + c, na + k * d))
    jac[: k * r, :na] = linear.by_shared[run].reshape(-1, na)
    for j in range(k):
        jac[j * r : (j + 1) * r, na + j * d : na + (j + 1) * d] = linear.by_own[run, j]
    jac[k * r :, :na] = linear.shared_by
    return jac, np.concatenate([linear.value[run].ravel(), linear.shared_value[run]])


def damped_step(linear: Linear, damping: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A search's step: shared (B, na) and own (B, K, d)."""
    shared, own = normal_equations([compact(linear)], damping).step(damping)
    return shared, own[0]


def test_undamped_step_equals_dense_least_squares():
    linear = random_linear(np.random.default_rng(0))
    shared, own = damped_step(linear, np.zeros(3))
    for run in range(3):
        jac, value = dense(linear, run)
        step = -np.linalg.lstsq(jac, value, rcond=None)[0]
        np.testing.assert_allclose(
            np.concatenate([shared[run], own[run].ravel()]), step, atol=1e-11
        )


def test_damped_step_equals_dense_marquardt():
    """Each run has its own damping; shared unknowns are damped in the reduced problem."""
    linear = random_linear(np.random.default_rng(1))
    damping = np.array([0.0, 1e-3, 10.0])
    shared, own = damped_step(linear, damping)
    for run in range(3):
        jac, value = dense(linear, run)
        na = linear.by_shared.shape[-1]
        norms = np.linalg.norm(jac[:, na:], axis=0)
        damped = np.zeros((len(norms), jac.shape[1]))
        damped[:, na:] = np.sqrt(damping[run]) * np.diag(norms)
        full = np.concatenate([jac, damped])
        q, _ = np.linalg.qr(full[:, na:])
        reduced = full[:, :na] - q @ (q.T @ full[:, :na])
        scale = np.sqrt(damping[run]) * np.diag(np.linalg.norm(reduced, axis=0))
        full = np.concatenate([full, np.pad(scale, ((0, 0), (0, jac.shape[1] - na)))])
        right = np.concatenate([value, np.zeros(len(full) - len(value))])
        step = -np.linalg.lstsq(full, right, rcond=None)[0]
        np.testing.assert_allclose(
            np.concatenate([shared[run], own[run].ravel()]), step, atol=1e-10
        )


def test_reduced_normal_is_the_schur_complement():
    linear = random_linear(np.random.default_rng(2))
    rows, residual = rows_on_shared(linear, eliminate(linear))
    normal = rows.mT @ rows
    for run in range(3):
        jac, value = dense(linear, run)
        full, na = jac.T @ jac, 5
        schur = full[:na, :na] - full[:na, na:] @ np.linalg.solve(full[na:, na:], full[na:, :na])
        np.testing.assert_allclose(normal[run], schur, atol=1e-11)
        g = jac.T @ value
        g = g[:na] - full[:na, na:] @ np.linalg.solve(full[na:, na:], g[na:])
        np.testing.assert_allclose(rows[run].T @ residual[run], g, atol=1e-11)


def in_strips(rng, sharp, runs=2, k=11, own=3, na=9):
    """A problem whose first eight rows are two strips of four rows and three columns, one of them
    shared and one of them none, before five rows of all columns that are ``sharp`` times as sharp.
    One configuration has one strip alone, of one row and padding."""
    configuration = np.concatenate([np.arange(k), np.arange(k - 1)])
    rows = np.where(np.arange(2 * k - 1)[:, None] < k, np.arange(4), np.arange(4, 8))
    rows[k - 1, 1:] = -1
    groups, columns = [slice(0, k), slice(k, 2 * k - 1)], np.array([[0, 2, 4], [3, 2, na]])
    layout = StripLayout(na, own, k, configuration, rows, groups, columns)
    numbers = rng.normal(size=(runs, own + 3 + 1, 2 * k - 1, 4))
    numbers[:, :, rows < 0] = 0
    value = rng.normal(size=(runs, k, 13))
    value[:, :, :8] = 0
    value[:, configuration[:, None], rows] = numbers[:, -1]
    rest, by_own = rng.normal(size=(runs, k, 5, na)), rng.normal(size=(runs, k, 5, own))
    prior = rng.normal(size=(runs, 4)), rng.normal(size=(4, na))
    usable = np.ones(value.shape, dtype=bool)
    return Compact(value, usable, *prior, Strips(layout, numbers), sharp * rest, sharp * by_own)


def with_damping(linear, damping):
    """A problem with the rows that hold own unknowns by damping, and with these eliminated."""
    own = linear.by_own
    rows = np.sqrt(damping)[:, None, None, None] * np.linalg.norm(own, axis=2)[..., None]
    wide = linear._replace(
        value=np.pad(linear.value, ((0, 0), (0, 0), (0, own.shape[-1]))),
        by_shared=np.pad(linear.by_shared, ((0, 0), (0, 0), (0, own.shape[-1]), (0, 0))),
        by_own=np.concatenate([own, rows * np.eye(own.shape[-1])], axis=2),
    )
    return wide, eliminate(wide)


@pytest.mark.parametrize("sharp", [1.0, 1e6])
@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_products_of_strips_are_those_of_their_rows(damping, sharp):
    """Equal to the last digits, however sharp the rows in none of them."""
    rows, damping = in_strips(np.random.default_rng(12), sharp), np.full(2, damping)
    linear = rows.linear()
    assert np.all(linear.by_shared[:, :, :8, [1, 5, 6, 7, 8]] == 0)
    whole, (jac, remainder) = (
        normal_equations([rows], damping),
        rows_on_shared(*with_damping(linear, damping)),
    )
    normal, gradient = jac.mT @ jac, (jac.mT @ remainder[..., None])[..., 0]
    for item, by_rows in ((whole.matrix, normal), (whole.gradient, gradient)):
        np.testing.assert_allclose(item, by_rows, atol=1e-9 * np.abs(by_rows).max())
    steps = whole.step(damping), damped_step(linear, damping)
    np.testing.assert_allclose(steps[0][0], steps[1][0], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(steps[0][1][0], steps[1][1], rtol=1e-8, atol=1e-10)


def test_runs_of_a_batch_do_not_touch_each_other():
    """A run solved in a batch, among easier and harder ones, gives the same solution alone."""
    rng = np.random.default_rng(3)
    assembled, truth = make_scene(rng, runs=4, configurations=6).batch(rng)
    station = np.stack(
        [guess(rng, t, 0.01 * 4**i, 0.01) for i, t in enumerate(truth.T_camera_base)]
    )
    start = replace(truth, z=0 * truth.z, T_camera_base=station)
    together = solve_batch(assembled.problem, start, robust=False, scale_noise=False)
    assert len(set(together.solution.steps.tolist())) > 1
    for run in range(4):
        only = np.array([run])
        alone = solve_batch(
            assembled.problem.select(only),
            take(start, only),
            robust=False,
            scale_noise=False,
        )
        assert alone.solution.steps[0] == together.solution.steps[run]
        np.testing.assert_allclose(
            alone.solution.state.z[0], together.solution.state.z[run], atol=1e-11
        )


def test_typical_number_of_steps():
    rng = np.random.default_rng(4)
    assembled, truth = make_scene(rng, runs=20, configurations=8).batch(rng)
    start = replace(truth, z=0 * truth.z)
    solution = solve_batch(assembled.problem, start, robust=False, scale_noise=False)
    assert set(solution.solution.stop) == {Stop.CONVERGED}
    assert solution.solution.steps.max() <= 10


def rosenbrock(x, runs):
    value = np.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0]], axis=1)
    jac = np.zeros((len(x), 2, 2))
    jac[:, 0, 0], jac[:, 0, 1], jac[:, 1, 0] = -20 * x[:, 0], 10, -1
    return value, jac


def test_a_curved_valley_is_followed():
    actual_names = minimise_dense(rosenbrock, np.array([[-1.2, 1.0], [3.0, -4.0], [1.0, 1.0]]))
    assert set(actual_names.stop) == {Stop.CONVERGED}
    np.testing.assert_allclose(actual_names.state, 1, atol=1e-7)


def test_a_minimum_with_residual_left():
    """x^2 + 0.1 and x - 1 meet nowhere; the sum of squares is least at 2x(x^2 + 0.1) = 1 - x."""

    def rows(x, runs):
        value = np.concatenate([x**2 + 0.1, x - 1], axis=1)
        return value, np.stack([2 * x, np.ones_like(x)], axis=1)

    values = minimise_dense(rows, np.array([[5.0], [-3.0]]))
    x = values.state
    assert set(values.stop) == {Stop.CONVERGED}
    np.testing.assert_allclose(2 * x * (x**2 + 0.1), 1 - x, atol=1e-6)


def test_step_limit_is_reported():
    values = minimise_dense(rosenbrock, np.array([[-1.2, 1.0]]))
    assert values.steps[0] > 3
    limited = minimise(Dense(rosenbrock, np.arange(1)), np.array([[-1.2, 1.0]]), max_steps=2)
    assert limited.stop == (Stop.STEPS,)
    assert "step limit" in limited.stop[0].value


def test_damped_steps_are_smaller_and_lead_to_the_same_minimum():
    def line(x, runs):
        return 3 * x - 2, np.full((len(x), 1, 1), 3.0)

    problem, start = Dense(line, np.arange(1)), np.array([[5.0]])
    usual = minimise(problem, start)
    damped = minimise(problem, start, options=SearchOptions(least_damping=1e-3))
    assert damped.stop == usual.stop == (Stop.CONVERGED,)
    assert damped.steps[0] > usual.steps[0]
    np.testing.assert_allclose([damped.state, usual.state], 2 / 3, atol=1e-7)


def test_nothing_predictable_is_reported():
    """No pose is a number, so no row can be predicted."""
    rng = np.random.default_rng(5)
    assembled, truth = make_scene(rng).batch(rng)
    broken = replace(truth, T_base_platform=truth.T_base_platform * np.nan)
    solution = minimise(assembled.problem, broken)
    assert solution.stop == (Stop.NOT_FINITE,)


def test_an_uphill_jacobian_stalls():
    def rows(x, runs):
        value, jac = rosenbrock(x, runs)
        return value, -jac

    values = minimise_dense(rows, np.array([[-1.2, 1.0]]))
    assert values.stop == (Stop.STALLED,)
    np.testing.assert_array_equal(values.state, [[-1.2, 1.0]])


@pytest.mark.parametrize("column", [0, 3])
def test_a_parameter_without_data_stays_where_it_was(column):
    linear = random_linear(np.random.default_rng(6))
    linear.by_shared[..., column] = 0
    linear.shared_by[..., column] = 0
    shared, _ = damped_step(linear, np.full(3, 1e-9))
    np.testing.assert_array_equal(shared[:, column], 0)
    assert np.isfinite(shared).all()


def test_states_of_some_runs_are_taken_and_put():
    rng = np.random.default_rng(7)
    runs = np.array([2, 0])
    _, truth = make_scene(rng, runs=3).batch(rng)
    linear = random_linear(rng)
    for state in (truth, rng.normal(size=(3, 2)), linear._replace(shared_by=np.zeros((3, 1)))):
        part = take(state, runs)
        assert type(part) is type(state)
        swapped = put(state, runs[::-1], part)
        for old, new, both in zip(arrays(state), arrays(part), arrays(swapped), strict=True):
            np.testing.assert_array_equal(new, old[runs])
            np.testing.assert_array_equal(both, old[[2, 1, 0]])


def arrays(state) -> list[np.ndarray]:
    if isinstance(state, np.ndarray):
        return [state]
    return list(state) if isinstance(state, tuple) else list(vars(state).values())


def test_what_all_runs_share_stays():
    shared, own = np.ones((1, 4)), np.arange(6.0).reshape(3, 2)
    assert of_runs(shared, np.array([1, 2])) is shared
    np.testing.assert_array_equal(of_runs(own, np.array([1, 2])), own[1:])


def test_stacked_rows_are_the_reduced_problem():
    """Their least squares is the shared part of the whole problem's."""
    linear = random_linear(np.random.default_rng(8))
    rows, value = rows_on_shared(linear, eliminate(linear))
    for run in range(3):
        jac, residual = dense(linear, run)
        whole = np.linalg.lstsq(jac, residual, rcond=None)[0][:5]
        np.testing.assert_allclose(
            np.linalg.lstsq(rows[run], value[run], rcond=None)[0], whole, atol=1e-11
        )


@pytest.mark.parametrize("units", [1.0, 1e-6])
def test_inverses_do_not_mind_units(units):
    rows = np.random.default_rng(9).normal(size=(2, 8, 3))
    scaled = rows * np.array([1.0, units, 1 / units])
    wanted = np.linalg.inv(np.swapaxes(rows, 1, 2) @ rows)
    wanted = wanted / np.outer([1.0, units, 1 / units], [1.0, units, 1 / units])
    normal = np.swapaxes(scaled, 1, 2) @ scaled
    for loose in (True, False):
        by_rows = inverse_root(scaled, 1e-9, loose=loose)
        by_normal = normal_root(normal, 1e-12, loose=loose)
        for half in (by_rows, by_normal):
            np.testing.assert_allclose(half @ np.swapaxes(half, 1, 2), wanted, rtol=1e-9)


@pytest.mark.parametrize("rows", [8, 2])
def test_a_direction_that_nothing_knows_is_loose_or_exact(rows):
    """The first two unknowns enter as their sum alone; with two rows there is none to spare."""
    jac = np.random.default_rng(10).normal(size=(rows, 3))
    jac[:, 1] = jac[:, 0]
    apart = np.array([1.0, -1.0, 0.0])
    for half in (inverse_root(jac, 1e-9, loose=True), normal_root(jac.T @ jac, 1e-12, loose=True)):
        assert np.linalg.norm(apart @ half) > 1e5
    exact = inverse_root(jac, 1e-9, loose=False)
    np.testing.assert_allclose(apart @ exact, 0, atol=1e-9)
    np.testing.assert_allclose(exact @ exact.T, np.linalg.pinv(jac.T @ jac), atol=1e-9)


def test_column_space_of_columns_in_any_units():
    columns = np.random.default_rng(11).normal(size=(6, 3)) * np.array([1e-9, 1.0, 1e9])
    columns = np.column_stack([columns, columns[:, 0] * 3, np.zeros(6)])
    q = column_space(columns)
    assert q.shape == (6, 3)
    np.testing.assert_allclose(
        (columns - q @ (q.T @ columns)) / [1e-9, 1, 1e9, 1e-9, 1], 0, atol=1e-12
    )


def test_weights_fall_from_one_to_zero():
    distance = np.array([0.0, 4.0, 5.25, 6.5, 100.0, np.nan])
    np.testing.assert_allclose(final_weights(distance), [1, 1, 0.5, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(
        geman_mcclure_weights(np.array([0.0, 2.0, 6.0, np.nan]), 2.0), [1, 0.25, 0.01, 0]
    )


def test_many_small_problems_at_once_reach_what_scipy_reaches():
    """Amplitude and rate of noisy decays, from far starts; one problem has no data at all."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 2, 12)
    true = rng.uniform([1.0, 0.5], [3.0, 2.0], (30, 2))
    y = true[:, :1] * np.exp(-true[:, 1:] * t) + rng.normal(0, 0.01, (30, 12))
    used = np.ones((30, 1))
    used[-1] = 0

    def linear(p):
        decay = np.exp(-p[:, 1:] * t) * used
        return y * used - p[:, :1] * decay, np.stack([decay, -p[:, :1] * t * decay], axis=-1)

    p, damping = np.tile([0.3, 4.0], (30, 1)), Damping.first(30)
    residual, jac = linear(p)
    for _ in range(40):
        trial = p + damping.step(jac.mT @ jac, (jac.mT @ residual[..., None])[..., 0])
        better = np.sum(linear(trial)[0] ** 2, axis=1) < np.sum(residual**2, axis=1)
        p, damping = np.where(better[:, None], trial, p), damping.after(better)
        residual, jac = linear(p)
    for k in range(29):
        best = least_squares(lambda q, k=k: q[0] * np.exp(-q[1] * t) - y[k], true[k], xtol=1e-12)
        np.testing.assert_allclose(p[k], best.x, rtol=1e-6)
    np.testing.assert_array_equal(p[-1], [0.3, 4.0])
