"""Rejected poses are judged by their innovation, which another estimate with them confirms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.identify.covariance import Information
from pkmcal.identify.innovation_test import innovations
from pkmcal.identify.robust import as_pairs, norms
from pkmcal.measurements.rows import RowGroups
from pkmcal.solver.search import minimise
from test_noise import pose_problem

REJECTED = 4
COARSE = np.deg2rad(0.2)


def rejected_pose(readings_off):
    """The problem of an H4's table whose readings are coarse, at its solution without one pose."""
    problem, state = pose_problem("h4")
    rng = np.random.default_rng(2)
    joints = problem.data.joints + COARSE * rng.normal(size=problem.data.joints.shape)
    joints[..., REJECTED, :] += readings_off
    problem = replace(
        problem, data=replace(problem.data, joints=joints), joint_noise=np.array([COARSE])
    )
    every = RowGroups(*(kind.present[None].astype(float) for kind in problem.row_groups))
    weight = every.poses.copy()
    weight[0, REJECTED] = 0.0
    without = problem.weighted(every._replace(poses=weight))
    return problem.weighted(every), without, weight, minimise(without, state)


@pytest.mark.parametrize("readings_off", [0.0, 20 * COARSE])
def test_the_innovation_is_what_the_pose_would_cost(readings_off):
    """With noisy readings, and with wrong ones; in the pose's own noise both look wrong."""
    whole, without, weight, value = rejected_pose(readings_off)
    plain = norms(whole, whole.unweighted(value.state)).poses
    info = Information(without, value.state)
    judged = innovations(info, plain, weight, np.ones(1))
    others = np.arange(judged.shape[1]) != REJECTED
    np.testing.assert_array_equal(judged[:, others], plain[:, others])
    factor = as_pairs(whole.row_groups.poses)[REJECTED, 0]
    square = (judged[0, REJECTED, 0] / factor) ** 2
    again = minimise(whole, value.state)
    assert square == pytest.approx(again.cost[0] - value.cost[0], rel=0.05)
    assert plain[0, REJECTED, 0] > 10
    assert (judged[0, REJECTED, 0] < 4) == (readings_off == 0)
