"""A joint estimate of many configurations takes them in pieces: the same, piece by piece."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.covariance import Information, identifiability, reduced_rows
from pkmcal.identify.methods import linear
from pkmcal.identify.noise import components
from pkmcal.measurements.rows import RowGroups
from pkmcal.solver import elimination
from pkmcal.solver.elimination import condensed, rows_on_shared
from test_identify_scene import make_scene

CONFIGURATIONS = 7


def problem_of(runs=1):
    rng = np.random.default_rng(3)
    scene = make_scene(rng, runs=runs, configurations=CONFIGURATIONS, n_stations=2)
    assembled, truth = scene.batch(rng)
    return assembled.problem, truth, scene.machine


def in_pieces(problem):
    """The problem with two configurations, or runs, linearized together."""
    return replace(problem, rows_at_once=2 * problem.n_rows)


@pytest.mark.parametrize("runs", [1, 3])
def test_noise_and_estimate_are_the_same(runs):
    problem, truth, _ = problem_of(runs)
    whole = solve_batch(problem, truth)
    at_whole = components(whole.info, whole.weight)
    problem = in_pieces(problem)
    value = solve_batch(problem, truth)
    pieces = list(value.info.pieces())
    counts = [piece.state.T_base_platform.shape[1] for piece in pieces]
    assert counts == [2, 2, 2, 1]
    assert all(piece.linear.by_shared.shape[1] <= 2 for piece in pieces)
    at = components(whole.info, whole.weight)
    for name in ("chi2", "freedom"):
        np.testing.assert_allclose(getattr(at, name), getattr(at_whole, name), rtol=1e-9)
    np.testing.assert_array_equal(value.info.by_kind.value.shape, whole.info.by_kind.value.shape)
    np.testing.assert_allclose(value.solution.state.z, whole.solution.state.z, atol=1e-8)
    np.testing.assert_allclose(value.noise_scale, whole.noise_scale, rtol=1e-6)


@pytest.mark.parametrize("runs", [1, 3])
def test_residuals_by_themselves_are_the_same(runs):
    problem, truth, _ = problem_of(runs)
    whole = problem.unweighted(truth)
    problem = in_pieces(problem)
    for item, expected in zip(problem.unweighted(truth), whole, strict=True):
        np.testing.assert_allclose(item, expected, atol=1e-9)


def test_what_weights_do_not_change_is_kept():
    problem, truth, _ = problem_of()
    weights = 0.5 * problem.data.weight, problem.pose_data.weight, problem.link_data.weight
    weighted = problem.weighted(RowGroups(*weights))
    assert weighted.structure is problem.structure
    part = problem.among(slice(0, 2))
    assert part.structure is weighted.among(slice(0, 2)).structure is not problem.structure
    wide, _ = problem.opened(truth)
    assert wide.structure is not problem.structure


def test_the_rows_of_pieces_say_the_same():
    problem, truth, machine = problem_of()
    names = ("machine", "stations")
    whole = Information(problem, truth)
    rows, residual = reduced_rows(whole, names)
    every, value = rows_on_shared(whole.linear, whole.reduced)
    spectrum = identifiability(whole, machine).singular_values
    problem = in_pieces(problem)
    pieces = Information(problem, truth)
    few, rest = reduced_rows(pieces, names)
    assert len(few) <= 4 * (problem.unknowns.count + 1) + len(problem.prior)
    for (a, x), (b, y) in (((rows, residual), (few, rest)), (
        (every[0], value[0]), tuple(part[0] for part in pieces.rows)),
    ):  # fmt: skip
        size = np.abs(a.T @ a).max()
        np.testing.assert_allclose(b.T @ b, a.T @ a, atol=1e-9 * size)
        np.testing.assert_allclose(b.T @ y, a.T @ x, atol=1e-9 * np.abs(a.T @ x).max())
        assert y @ y == pytest.approx(x @ x, rel=1e-9)
    again = identifiability(pieces, machine).singular_values
    np.testing.assert_allclose(again, spectrum, atol=1e-8 * spectrum[0])


@pytest.mark.parametrize("n", [50, 5 * elimination.TALL_BLOCK_ROWS + 7])
def test_condensed_rows_say_the_same(n):
    rng = np.random.default_rng(0)
    rows, value = rng.normal(size=(2, n, 4)), rng.normal(size=(2, n))
    few, rest = condensed(rows, value)
    assert few.shape == (2, 5, 4)
    atol = 1e-14 * n
    np.testing.assert_allclose(few.mT @ few, rows.mT @ rows, atol=atol)
    np.testing.assert_allclose(few.mT @ rest[..., None], rows.mT @ value[..., None], atol=atol)
    np.testing.assert_allclose(np.sum(rest**2, axis=1), np.sum(value**2, axis=1))


@pytest.mark.parametrize("noisy", [False, True])
def test_least_median_leg_after_leg(noisy):
    rng = np.random.default_rng(1)
    n = rng.normal(size=(2, 3, 20, 3))
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    present = (rng.random((2, 3, 20)) < 0.8).astype(float)
    noise = np.broadcast_to(1e-6 * np.eye(3), (2, 3, 20, 3, 3)) if noisy else None
    radius = -np.sum(n * rng.normal(size=(2, 3, 1, 3)), axis=-1) + 1e-3 * rng.normal(
        size=n.shape[:-1]
    )

    def values(**options):
        rng = np.random.default_rng(0)
        return linear.least_median(n, radius, present, rng, noise=noise, **options)

    whole = values()
    assert np.isfinite(whole).all()
    np.testing.assert_array_equal(values(residuals_at_once=1), whole)
