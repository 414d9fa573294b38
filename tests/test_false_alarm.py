"""All searches of a session together give a false alarm at most at the level of the session."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import pkmcal
from pkmcal.calibration.discrepancy_basis import discrepancy_components
from pkmcal.identify.covariance import Information
from pkmcal.identify.discrepancy import DiscrepancyOptions, discrepancy_of
from pkmcal.identify.false_alarm import FalseAlarm, Search
from pkmcal.identify.problem import Problem
from pkmcal.identify.score import ScoreTests
from pkmcal.measurements import Column
from pkmcal.solver.elimination import Linear
from test_discrepancy import right_session
from test_model_violations import plays, scales

LEVEL, SESSIONS = 0.2, 30


@dataclass(frozen=True)
class LinearProblem(Problem):
    """A problem of which the residuals are drawn, by the rows at one state."""

    drawn: Linear | None = None

    def linearize(self, state):
        return self.drawn

    @classmethod
    def of(cls, problem: Problem, rows: Linear, rng: np.random.Generator) -> LinearProblem:
        """White residuals, priors included."""
        value = np.where(rows.usable, rng.standard_normal(rows.value.shape), 0.0)
        shared = rng.standard_normal(rows.shared_value.shape)
        drawn = rows._replace(value=value, shared_value=shared)
        parts = {name: getattr(problem, name) for name in Problem.__dataclass_fields__}
        return cls(**parts, drawn=drawn)


def test_a_session_gives_a_false_alarm_at_most_at_its_level():
    """Linear sessions without any violation; the searches for violations, for a discrepancy, and,
    with p-values or residuals drawn for them, the others.
    """
    rng = np.random.default_rng(0)
    _, data, estimate, _ = right_session(5, 10)
    assembled, info = estimate.linearized
    rows = info.linear
    listed = [Column("test", readings=by) for by in scales(data) + plays(data)]
    families = [0] * 6 + [1] * 6
    components = discrepancy_components(data, estimate)
    level = FalseAlarm(LEVEL)
    alarms = np.zeros((SESSIONS, len(Search)), dtype=bool)
    for k in range(SESSIONS):
        problem = LinearProblem.of(info.problem, rows, rng)
        here = replace(assembled, problem=problem), Information(problem, info.state)
        tests = ScoreTests(*here, listed, families, singles=True, false_alarm=level)
        estimated = discrepancy_of(
            *here, components, options=DiscrepancyOptions(false_alarm=level, scales=31)
        )
        tubes, poses = rng.uniform(size=(2, 15))
        noise, camera = rng.normal(size=(2, 40)).std(axis=1)
        alarms[k] = (
            bool(tests.significant()),
            bool(estimated.scales),
            tubes.min() < level.of_test(Search.OUTLINES, 15),
            level.adjusted(Search.OUTLIERS, poses.min(), 15) < LEVEL,
            noise > level.scale(Search.NOISE, 39),
            camera > level.scale(Search.INTRINSICS, 39),
        )
    most = LEVEL * SESSIONS
    assert np.any(alarms, axis=1).sum() < most + 2 * np.sqrt(most * (1 - LEVEL))
    assert np.any(alarms)


def test_tests_of_one_search_share_its_level():
    level, search = FalseAlarm(0.01, {Search.VIOLATIONS: 0.5}), Search.VIOLATIONS
    assert level.of_test(search, 5) == 0.001
    assert level.of_test(search, 0) == 0.005
    adjusted = level.adjusted(search, np.array([1e-3, 0.5]), np.array([5, 5]))
    np.testing.assert_allclose(adjusted, [0.01, 1.0])


def test_every_search_that_uses_the_level_has_a_share_of_it():
    """A search names itself, in one module, where it uses the level; nothing else has a share."""
    used = [
        name
        for path in Path(pkmcal.__file__).parent.rglob("*.py")
        for name in set(re.findall(r"\bSearch\.([A-Z_]+)\b", path.read_text(encoding="utf-8")))
    ]
    assert sorted(used) == sorted(one.name for one in Search)
    assert sum(FalseAlarm().shares.values()) == pytest.approx(1)


@pytest.mark.parametrize("dof", [5, 60])
def test_noise_exceeds_its_scale_as_often_as_the_level_states(dof):
    level, runs = FalseAlarm(0.02, {Search.NOISE: 0.5}), 20000
    rng = np.random.default_rng(0)
    rms = np.sqrt(np.mean(rng.normal(size=(runs, dof)) ** 2, axis=1))
    assert np.mean(rms > level.scale(Search.NOISE, dof)) == pytest.approx(
        0.01, abs=4 * np.sqrt(0.01 / runs)
    )
