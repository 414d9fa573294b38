"""The noise of readings as the data show it: found where stated wrong, left alone where not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.calibration.calibrate import calibrate
from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.noise import EDGES, FEWEST, READINGS, Components, components
from test_identify_scene import JOINT_NOISE, exact, make_scene
from test_pose_sessions import make

RUNS = 8


def batch(seed, true, stated, runs=RUNS, **options):
    """A problem of many runs whose readings have the noise ``true`` and state ``stated``, m."""
    rng = np.random.default_rng(seed)
    scene = make_scene(rng, runs=runs, configurations=6, n_stations=2, **options)
    exact = scene.joints
    assembled, truth = scene.batch(rng)
    data = assembled.problem.data
    joints = exact + true * rng.normal(size=exact.shape)
    problem = replace(
        assembled.problem, data=replace(data, joints=joints), joint_noise=np.array([stated])
    )
    return problem, truth


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_sums_of_squares_are_as_their_traces_say(factor):
    """Readings whose noise is ``factor`` times what they count for, beside edges about as sharp:
    means over a hundred runs, and with the stated noise their scatter."""
    machine = exact("gough-stewart")
    problem, truth = batch(1, factor * 4e-5, 4e-5, runs=100, machine=machine)
    result = solve_batch(problem, truth, robust=False, scale_noise=False)
    found = components(result.info, result.weight)
    own = found.square[:, READINGS, READINGS]
    assert own.mean() > FEWEST  # they do say something of it
    expected = found.freedom[:, READINGS] + (factor**2 - 1) * own
    ratio = found.chi2[:, READINGS] / expected
    assert ratio.mean() == pytest.approx(1, abs=4 * ratio.std() / np.sqrt(100))
    beside = found.freedom[:, EDGES] + (factor**2 - 1) * found.square[:, EDGES, READINGS]
    assert np.mean(found.chi2[:, EDGES] / beside) == pytest.approx(1, abs=0.01)
    if factor == 1:
        spread = np.std(found.chi2[:, READINGS] - found.freedom[:, READINGS])
        assert spread == pytest.approx(np.sqrt(2 * own.mean()), rel=0.3)


@pytest.mark.parametrize(("true", "stated"), [(3e-6, 3e-3), (3e-4, 3e-6), (3e-4, 3e-2)])
def test_a_noise_that_is_stated_wrong_is_found(true, stated):
    """By a hundred or a thousand, either way: estimates are as good as with the right one, and as
    honest, and edges are not blamed."""
    problem, truth = batch(2, true, stated)
    right = replace(problem, joint_noise=np.array([true]))
    found, best = (solve_batch(p, truth) for p in (problem, right))
    low, high = components(found.info, found.weight).interval(READINGS)
    scale = found.reading_scale * stated / true  # of the noise in use, to the true one
    assert np.all((low * scale < 1) & (high * scale > 1))
    assert np.all(found.reading_scale != 1)
    np.testing.assert_array_less(found.scale.edges, 1.1)
    error, least = ((r.solution.state.z - truth.z) ** 2 for r in (found, best))
    assert error.sum() == pytest.approx(least.sum(), rel=0.1)
    promised, honest = (np.einsum("bii->bi", r.info.covariance).sum() for r in (found, best))
    assert promised == pytest.approx(honest, rel=0.1)  # which test_bundle holds against repeats


def test_a_noise_that_is_stated_right_is_left_alone():
    """One in a hundred may be doubted; among forty no more than two."""
    problem, truth = batch(3, JOINT_NOISE, JOINT_NOISE, runs=40)
    found = solve_batch(problem, truth)
    assert np.sum(found.reading_scale != 1) <= 2


def test_where_the_data_cannot_tell_nothing_is_claimed():
    """Edges see the platform to some ten micrometres: whether readings are off by three or by three
    hundredths, they do not know, and it makes no difference."""
    problem, truth = batch(4, 3e-6, 3e-8)
    found = solve_batch(problem, truth)
    np.testing.assert_array_equal(found.reading_scale, 1.0)
    low, high = components(found.info, found.weight).interval(READINGS)
    assert np.all(low == 0)
    assert np.all(high > 100)


def test_too_few_degrees_of_freedom_tell_nothing():
    nothing = Components(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3, 3)))
    assert nothing.interval(READINGS) == (0.0, np.inf)
    assert not nothing.contradicts(READINGS)


def test_a_table_whose_noise_is_stated_too_large_is_told(tmp_path):
    """But not used: what all of a tracker's measurements share does not scatter."""
    folder = make(tmp_path / "session", "gough-stewart", "poses").folder
    text = (folder / "session.yaml").read_text(encoding="utf-8")
    wrong = text.replace("position: 2.0e-05", "position: 2.0e-4").replace(
        "rotation: 0.0001", "rotation: 0.001"
    )
    assert wrong != text
    for content, told in ((text, 0), (wrong, 1)):
        (folder / "session.yaml").write_text(content, encoding="utf-8")
        found = calibrate(folder)
        said = [w for w in found.verdict.warnings if "stations.tracker.tracker.noise" in w]
        assert len(said) == told
        assert found.estimate.statistics.pose_scale == pytest.approx(1, abs=0.2)
