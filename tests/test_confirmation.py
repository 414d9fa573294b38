"""Whether other measurements confirm a rejection: against solutions of each hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import printers
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.firmware.session import write_printer_session
from pkmcal.identify.bed import bed_by_parameters
from pkmcal.identify.confirmation import rejections_of
from pkmcal.identify.robust import CLEAN_TAIL_SHARE
from pkmcal.levels import CONTRADICTION_SIGMAS
from pkmcal.measurements.rows import RowGroups
from pkmcal.solver.kernels import FULL_WEIGHT_DISTANCE, NO_WEIGHT_DISTANCE, final_loss
from pkmcal.solver.search import minimise

SAYS = printers.Settings(radius=118.0, rod=(240.0,) * 3, endstop=(260.0,) * 3)
WRONG = 3
"""The height that is 0.4 mm too high."""


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The calibration of a printer from ten heights, one of which is rejected."""
    folder = tmp_path_factory.mktemp("printer")
    true = printers.machine(replace(SAYS, radius=118.3))
    readings = printers.felt(true, printers.bed(10, 75.0), 0.015, np.random.default_rng(0))
    readings[WRONG] += 0.4
    (folder / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
    write_printer_session(folder / "kit", folder / "printer.cfg")
    return calibrate_session(folder / "kit")


def test_hypotheses_weigh_as_their_solutions_do(example):
    """Solutions of each hypothesis, not to first order, with prior sigmas five times as wide."""
    measurements, estimate = example.measurements, example.estimate
    assert np.flatnonzero(estimate.pose_weights < 0.5).tolist() == [WRONG]
    assembled, info = estimate.linearized
    drawn = np.array(assembled.priors) == "nominal"
    wider = np.where(drawn, 1 / CONTRADICTION_SIGMAS, 1.0)
    problem = replace(
        info.problem,
        prior=wider[:, None] * info.problem.prior,
        prior_target=wider * info.problem.prior_target,
    )
    n, in_use = len(estimate.pose_weights), 1 / estimate.statistics.pose_scale**2

    def solved(rejected):
        weight = np.full(n, in_use)
        weight[rejected] = 0.0
        weights = RowGroups(np.zeros(0), weight, np.zeros(0))
        other = assembled.trusting(weights)
        other = replace(other, prior=problem.prior, prior_target=problem.prior_target)
        one = minimise(other.as_noisy_as_at(info.state), info.state)
        # one number's loss, of which as many clean ones are beyond as of a pair's
        unit = FULL_WEIGHT_DISTANCE / normal_beyond(CLEAN_TAIL_SHARE)
        lost = final_loss(np.array(NO_WEIGHT_DISTANCE)) / unit**2
        return one.cost[0] + lost * len(rejected), problem.theta(one.state)[0]

    base, theta = solved([WRONG])
    others = [solved([])] + [solved([k]) for k in range(n) if k != WRONG]
    weight = np.array([np.exp(-(cost - base) / 2) for cost, _ in others])
    share = weight / (1 + weight.sum())
    tool = bed_by_parameters(estimate)
    shift = np.array([np.linalg.norm(tool @ (other - theta)) for _, other in others])
    expected = np.sqrt(np.sum(share * shift**2))
    result = rejections_of(measurements, estimate, tool)
    (unit,) = result.units
    assert unit.pose == WRONG
    assert share.sum() > 1e-4  # ten heights leave it open
    assert unit.right == pytest.approx(share.sum(), rel=0.05)
    assert unit.shift == pytest.approx(expected, rel=0.05)
    assert result.shift == pytest.approx(unit.shift)


def normal_beyond(share):
    """The distance beyond which a share of normal numbers lies."""
    from scipy.special import ndtri

    return -ndtri(share / 2)


def test_nothing_rejected_is_nothing_to_confirm(example):
    estimate = replace(example.estimate, pose_weights=np.ones(10))
    result = rejections_of(example.measurements, estimate, bed_by_parameters(estimate))
    assert result.units == ()
    assert result.shift == 0
