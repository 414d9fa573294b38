"""Watching a calibrated machine: false alarms as promised, changes found and named, and words."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.calibration.saved_calibration import CalibrationPrior
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import freedoms, generators
from pkmcal.identify.start import start_state
from pkmcal.judge.causes import (
    Cause,
    arms,
    common_scale,
    joined_causes,
    single_causes,
    whole_legs,
    whole_machine,
    zeros,
)
from pkmcal.judge.changes import (
    DETECTION_POWER,
    change,
    chi_square,
    common_level,
    detect_changes,
    detectable,
    explained,
    made_tests,
    twice_log_odds,
)
from pkmcal.judge.fixed_machine import Evidence, Trust, change_evidence, hold
from pkmcal.judge.sentences import ComparedSession, watch_verdict
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import load_mechanism
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.simulation import Settings
from pkmcal.simulation.truth import draw_truth, true_machine
from pkmcal.solver.search import Solution, Stop
from pose_sessions import T_CAMERA_BASE, measured, papers_case, papers_poses
from test_identify_scene import exact

ALPHA = 0.01
CAMERA = default_camera()
SESSIONS = 50
FEW = 4
"""Configurations of a session that watches."""


def made_calibration():
    """The estimate of a hexapod from three stations: its machine is the truth of these tests."""
    nominal = exact("gough-stewart")
    truth = draw_truth(nominal, (CAMERA,) * 3, Settings(stations=3, configurations=8), 1)
    edges, readings = simulate_edges(
        truth.machine, truth.T_camera_base, CAMERA, truth.T_base_platform, EdgeNoise(),
        np.random.default_rng(1), images=truth.images,
    )  # fmt: skip
    data = Measurements(edges, readings, 3e-6, 3, np.zeros(3, dtype=int))
    start = start_state(nominal, data, truth.T_camera_base)
    return bundle(nominal, data, start, robust=False, scale_noise=False)


def images_of(machine):
    """One camera and thirty poses, of which the watches use some."""
    settings = Settings(stations=1, configurations=30, tolerance=0.0)
    return draw_truth(machine, (CAMERA,), settings, 5)


def half_of(covariance):
    """H with H H^T the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


class Watched:
    """Hexapod with a calibration from three stations, and places for new images.

    Calibrations are drawn about the true machine by the covariance of an actual one.
    """

    def __init__(self):
        made = made_calibration()
        self.true, self.covariance = made.machine, made.covariance
        self.half = half_of(made.covariance)
        self.pool = images_of(self.true)

    def calibrated(self, rng):
        """The true machine with a calibration's errors."""
        return self.true.with_values(
            self.true.values + self.half @ rng.standard_normal(len(self.half))
        )

    def observe(self, machine, rng, few=FEW):
        """New measurements of a machine by one camera."""
        rows = rng.choice(30, few, replace=False)
        edges, readings = simulate_edges(
            machine, self.pool.T_camera_base, CAMERA, self.pool.T_base_platform[rows],
            EdgeNoise(), rng,
        )  # fmt: skip
        return Measurements(edges, readings, 3e-6, 1, np.zeros(1, dtype=int))

    def evidence(self, machine, rng, few=FEW):
        """Watch of one session of ``machine``, against a calibration of the true one."""
        calibrated, data = self.calibrated(rng), self.observe(machine, rng, few)
        start = start_state(calibrated, data, self.pool.T_camera_base)
        return change_evidence(
            hold(calibrated, data, start, Trust.full(data)), CalibrationPrior(self.covariance)
        )


@pytest.fixture(scope="module")
def watched():
    return Watched()


@pytest.fixture(scope="module")
def unchanged(watched):
    """Evidence of sessions of a machine that did not change."""
    return [watched.evidence(watched.true, np.random.default_rng([k, 7])) for k in range(SESSIONS)]


def moved(machine, **by):
    """A machine with parameters changed; names with __ for dots, after a leg's number."""
    values = machine.values.copy()
    for name, size in by.items():
        leg, _, path = name.removeprefix("leg").partition("_")
        values[machine.parameters.index(f"legs[{leg}].{path.replace('__', '.')}")] += size
    return machine.with_values(values)


def new_data(n=FEW):
    """The circumstances of n new configurations."""
    return ComparedSession(tuple("abcdefghijkl"[:n]), np.zeros(n, bool), np.ones(n, bool), 1.0)


def board_case(name, rng, **model):
    """A machine calibrated by a board on its platform: its truth and the estimate."""
    nominal = load_mechanism(name, **model)
    true = true_machine(nominal, 1.0, rng)
    case = papers_case(true, rng)
    start = start_state(nominal, case.measurements, T_CAMERA_BASE[None])
    return true, bundle(nominal, case.measurements, start)


def by_board(estimate, machine, poses, rng):
    """Evidence of a board on a machine's platform in some poses."""
    data = measured(machine, poses, rng).measurements
    start = start_state(estimate.machine, data, T_CAMERA_BASE[None])
    return change_evidence(
        hold(estimate.machine, data, start, Trust.full(data)), CalibrationPrior(estimate.covariance)
    )


@pytest.fixture(scope="module")
def h4():
    rng = np.random.default_rng(3)
    return (*board_case("h4", rng, model="calibration"), rng)


# false alarms


def test_an_unchanged_machine_gives_unit_noise(unchanged, watched):
    """w is noise of unit variance, calibration's errors included: chi-square as it should be."""
    every = whole_machine(watched.true)
    tests = [chi_square(results, every) for results in unchanged]
    dof = sum(t.dof for t in tests)
    assert dof > SESSIONS * 20
    assert abs(sum(t.chi2 for t in tests) - dof) < 4 * np.sqrt(2 * dof)
    chances = np.array([t.chance for t in tests])
    assert abs(chances.mean() - 0.5) < 4 * np.sqrt(1 / 12 / SESSIONS)


def test_each_legs_test_is_uniform_in_chance(unchanged, watched):
    legs = [*whole_legs(watched.true), *zeros(watched.true), common_scale(watched.true)]
    chances = np.array([[chi_square(f, c).chance for c in legs] for f in unchanged])
    assert np.abs(chances.mean(axis=0) - 0.5).max() < 4 * np.sqrt(1 / 12 / SESSIONS)
    for share in (0.1, 0.5):
        sigma = np.sqrt(share * (1 - share) / SESSIONS)
        assert np.abs((chances < share).mean(axis=0) - share).max() < 4 * sigma


def test_false_alarms_of_all_tests_together(unchanged, watched):
    """At a level of 0.2, of 50 machines that did not change 10 are flagged, give or take."""
    queries = [whole_machine(watched.true), *whole_legs(watched.true), *zeros(watched.true)]
    level = common_level(unchanged[0], queries)
    least = np.array([min(chi_square(f, c).chance for c in queries) for f in unchanged])
    flagged = int(np.sum(least < level.single(0.2)))
    assert abs(flagged - 10) < 4 * np.sqrt(SESSIONS * 0.2 * 0.8)
    assert level.single(0.2) > 0.2 / level.count  # Bonferroni would be too careful


def test_the_calibrations_errors_must_be_in_the_noise(watched):
    """Against a calibration without errors, an unchanged machine is flagged again and again, which
    the calibration's covariance prevents.
    """
    every, factor = whole_machine(watched.true), []
    for k in range(8):
        rng = np.random.default_rng([k, 8])
        calibrated, data = watched.calibrated(rng), watched.observe(watched.true, rng)
        start = start_state(calibrated, data, watched.pool.T_camera_base)
        held = hold(calibrated, data, start, Trust.full(data))
        exact = change_evidence(held, CalibrationPrior(0 * watched.covariance))
        value = chi_square(exact, every)
        factor.append(value.chi2 / value.dof)
    assert np.mean(factor) > 1.4


def test_other_frames_and_cameras_change_nothing(watched):
    """A test does not depend on the base frame and the camera's pose."""
    rng = np.random.default_rng(2)
    data, calibrated = watched.observe(watched.true, rng), watched.calibrated(rng)
    start = start_state(calibrated, data, watched.pool.T_camera_base)
    first = change_evidence(
        hold(calibrated, data, start, Trust.full(data)), CalibrationPrior(watched.covariance)
    )
    away = replace(start, T_camera_base=perturb(start.T_camera_base, 0.01 * rng.normal(size=6)))
    again = change_evidence(
        hold(calibrated, data, away, Trust.full(data)), CalibrationPrior(watched.covariance)
    )
    every = whole_machine(calibrated)
    assert chi_square(again, every).chi2 == pytest.approx(chi_square(first, every).chi2, abs=1e-4)
    frames = generators(calibrated.layout, calibrated.values) @ freedoms(calibrated)
    assert np.abs(first.by @ frames).max() < 1e-4 * np.abs(first.by).max()


# changes


@pytest.mark.parametrize("by", [2e-5, 1e-3])
def test_the_regression_predicts_what_a_change_does(watched, by):
    """The same data with a machine that has changed: w moves by X times the change."""
    rng = np.random.default_rng(6)
    data = watched.observe(watched.true, rng)
    start = start_state(watched.true, data, watched.pool.T_camera_base)
    in_view = [
        change_evidence(
            hold(machine, data, start, Trust.full(data)), CalibrationPrior(watched.covariance)
        )
        for machine in (watched.true, moved(watched.true, leg3_length__offset=-by))
    ]
    cause = whole_legs(watched.true)[2]
    changes = [change(results, cause) for results in in_view]
    off = changes[1].value - changes[0].value
    index = watched.true.parameters.index
    at = index("legs[3].length.offset") - index("legs[3].base.center.x")
    expected = by * np.eye(len(off))[at]
    worst = np.sqrt(np.diag(changes[0].covariance))
    assert (np.abs(off - expected) < 0.02 * worst + 0.02 * by).all()


def test_a_changed_offset_is_found_and_named(watched):
    rng = np.random.default_rng(21)
    judged = detect_changes(
        watched.evidence(moved(watched.true, leg3_length__offset=1e-3), rng), watched.true, ALPHA
    )
    verdict = watch_verdict(judged, new_data())
    assert judged.changed
    first = judged.findings[0].suspect
    assert (first.cause.part, first.cause.legs) == ("zero", (2,))
    assert abs(first.change.value[0] - 1e-3) < 4 * first.change.sigma[0]
    assert judged.rest.chance > 1e-3
    assert not verdict.usable
    assert "leg 3 has changed" in verdict.headline
    assert "the zero of leg 3's reading by +" in verdict.reasons[0]
    assert "encoder" in verdict.reasons[0]


def test_a_joint_that_moved(watched):
    rng = np.random.default_rng(22)
    now = moved(watched.true, leg2_base__center__x=2e-3, leg2_base__center__y=-1e-3)
    value = watched.evidence(now, rng, few=8)
    judged = detect_changes(value, watched.true, ALPHA)
    assert not judged.another_machine
    first = judged.findings[0].suspect
    assert (first.cause.part, first.cause.legs) == ("base", (1,))
    off = first.change.value - [2e-3, -1e-3, 0]
    assert off @ np.linalg.solve(first.change.covariance, off) < 20
    text = watch_verdict(judged, new_data(8)).reasons[0]
    assert "the base joint of leg 2 by 2." in text
    assert "mm in the base frame" in text


def test_two_changes_are_both_named(watched):
    """The first single cause that is found resembles both; all pairs decide."""
    rng = np.random.default_rng(23)
    now = moved(watched.true, leg3_length__offset=1.5e-3, leg5_length__offset=-1.5e-3)
    judged = detect_changes(watched.evidence(now, rng, few=8), watched.true, ALPHA)
    assert not judged.another_machine
    causes = {(f.suspect.cause.part, f.suspect.cause.legs) for f in judged.findings}
    assert causes == {("zero", (2,)), ("zero", (4,))}
    verdict = watch_verdict(judged, new_data(8))
    assert "legs 3 and 5 have changed" in verdict.headline
    assert verdict.reasons[1].startswith("Besides, the zero of")


@pytest.mark.parametrize("seed", [31, 32])
def test_another_machine_is_called_another_machine(watched, seed):
    """One that is built from the same nominal model: no parts are named."""
    rng = np.random.default_rng(seed)
    table = watched.true.parameters
    sigma = table.tolerances_free()
    shift = table.free_matrix() @ (sigma * rng.normal(size=len(sigma)))
    other = watched.true.with_values(watched.true.values + shift)
    judged = detect_changes(watched.evidence(other, rng, few=8), watched.true, ALPHA)
    assert judged.another_machine
    assert judged.findings == ()
    verdict = watch_verdict(judged, new_data(8))
    assert verdict.codes == ("watch.another_machine",)
    assert not verdict.usable


def test_warming_is_distinguished_from_a_leg(watched):
    machine = watched.true
    lengths = np.array([k not in ("radius", "scale") for k in machine.parameters.kinds])
    warm = machine.with_values(machine.values * np.where(lengths, 1 + 2e-3, 1.0))
    judged = detect_changes(watched.evidence(warm, np.random.default_rng(24)), machine, ALPHA)
    assert not judged.another_machine
    assert judged.findings[0].suspect.cause.part == "scale"
    assert abs(judged.scale_change.value[0] - 2e-3) < 4 * judged.scale_change.sigma[0]
    verdict = watch_verdict(judged, new_data())
    assert "all its lengths have another scale" in verdict.headline
    assert "K warmer" in verdict.reasons[0]


def test_causes_that_look_alike_are_all_named(watched):
    """Three configurations hardly separate a leg's offset from its joints."""
    rng = np.random.default_rng(26)
    now = moved(watched.true, leg4_platform__center__z=1.2e-3)
    judged = detect_changes(watched.evidence(now, rng, few=3), watched.true, ALPHA)
    finding = judged.findings[0]
    similar = {(s.cause.part, s.cause.legs) for s in (finding.suspect, *finding.others)}
    assert ("platform", (3,)) in similar
    assert len(similar) > 1
    assert watch_verdict(judged, new_data(3)).findings[0].facts["others"]


def test_detectable_changes_are_detected_so_often(watched):
    """Power by simulation of the regression: as many as promised."""
    values = watched.evidence(watched.true, np.random.default_rng(31))
    leg = whole_legs(watched.true)[2]
    along = zeros(watched.true)[2].columns[:, 0]
    level = ALPHA / 14
    size = detectable(values, leg, along, level)
    rng = np.random.default_rng(32)
    count = 400
    draws = [
        replace(values, w=values.by @ (size * along) + rng.standard_normal(len(values.w)))
        for _ in range(count)
    ]
    share = np.mean([chi_square(draw, leg).chance < level for draw in draws])
    assert abs(share - DETECTION_POWER) < 4 * np.sqrt(
        DETECTION_POWER * (1 - DETECTION_POWER) / count
    )


def test_what_is_not_seen_is_not_detected(watched):
    values = watched.evidence(watched.true, np.random.default_rng(31))
    frames = generators(watched.true.layout, watched.true.values)[:, 0]
    blind = Cause("zero", (0,), frames[:, None], np.array([1e-3]), "m")
    assert chi_square(values, blind).dof == 0
    assert chi_square(values, blind).chance == 1.0
    assert detectable(values, blind, frames, ALPHA) == np.inf
    assert change(values, blind).sigma[0] == np.inf


# tests made together


def flat(n=6, p=3):
    """Evidence of p parameters, each determined by a row of its own."""
    return Evidence(np.zeros(n), np.eye(n, p) * 1e6)


def test_chances_of_several_tests():
    one = [Cause("zero", (k,), np.eye(3)[:, [k]], np.array([1e-3]), "m") for k in range(3)]
    level = common_level(flat(), one)
    # of three independent tests: 1 - (1 - p)^3
    for p in (0.01, 0.1, 0.5):
        assert level.adjusted(p) == pytest.approx(1 - (1 - p) ** 3, rel=0.15)
        assert level.single(1 - (1 - p) ** 3) == pytest.approx(p, rel=0.15)
    assert level.adjusted(1e-9) == pytest.approx(3e-9)
    same = common_level(flat(), [one[0]] * 3)  # one test made three times is one test
    assert same.adjusted(0.1) == pytest.approx(0.1, rel=0.15)


def test_likelihood_prefers_the_usual_size():
    """Two causes that explain the same, one by 0.8 tolerances and one by 8."""
    values = replace(flat(), w=np.array([25.0, 0, 0, 0, 0, 0]))
    near = Cause("zero", (0,), np.eye(3)[:, [0]] * 3e-2, np.array([1e-3]), "m")
    far = Cause("zero", (1,), np.eye(3)[:, [0]] * 3e-3, np.array([1e-3]), "m")
    assert chi_square(values, near).chi2 == chi_square(values, far).chi2 == 625.0
    assert change(values, far).value[0] == pytest.approx(10 * change(values, near).value[0])
    assert twice_log_odds(values, near) > twice_log_odds(values, far) + 5
    wide = joined_causes([near, Cause("zero", (2,), np.eye(3)[:, [2]], np.array([1e-3]), "m")])
    assert twice_log_odds(values, wide) < twice_log_odds(values, near)


def test_nothing_explains_noise():
    causes = [Cause("zero", (k,), np.eye(3)[:, [k]], np.array([1e-3]), "m") for k in range(3)]
    assert explained(replace(flat(), w=np.full(6, 1.0)), causes, ALPHA) == ()


# machines


def test_parts_of_a_leg():
    machine = load_mechanism("h4")
    table = machine.parameters
    assert set(table.parts) - {""} == {"zero", "rod", "arm", "base", "platform", "hinge"}
    hexapod = load_mechanism("gough-stewart")
    table = hexapod.parameters
    assert table.parts[table.index("legs[1].tubes[1].radius")] == ""
    assert arms(hexapod) == tuple((k,) for k in range(6))
    pairs = {c.legs for c in single_causes(hexapod) if len(c.legs) == 2}
    assert len(pairs) == 6  # three mounts on the base, three on the platform


def test_rods_on_one_motor_are_one_arm():
    machine = load_mechanism("h4-rods")
    assert arms(machine) == ((0, 1), (2, 3), (4, 5), (6, 7))
    assert all(zero.columns.shape[1] == 1 for zero in zeros(machine))


def test_passive_legs_have_no_zero():
    machine = load_mechanism("6-spu-passive")
    own = zeros(machine)
    passive = [k for k, zero in enumerate(own) if zero is None]
    assert passive == np.flatnonzero(machine.layout.actuated < 0).tolist()


def test_an_h4_by_its_board(h4):
    true, estimate, rng = h4
    poses = papers_poses()[rng.permutation(81)]
    same = detect_changes(by_board(estimate, true, poses[:5], rng), estimate.machine, ALPHA)
    verdict = watch_verdict(same, new_data(5))
    assert verdict.usable, verdict
    assert "motor's zero by 0." in verdict.headline
    assert "°" in verdict.headline
    now = moved(true, leg2_base__angle=0.02)
    judged = detect_changes(by_board(estimate, now, poses[5:10], rng), estimate.machine, ALPHA)
    first = judged.findings[0].suspect
    assert (first.cause.part, first.cause.legs) == ("zero", (1,))
    assert abs(first.change.value[0] - 0.02) < 4 * first.change.sigma[0]


def test_too_few_poses_of_a_board(h4):
    """One pose of a board determines no more than the poses of camera and board."""
    true, estimate, rng = h4
    judged = detect_changes(
        by_board(estimate, true, papers_poses()[:1], rng), estimate.machine, ALPHA
    )
    verdict = watch_verdict(judged, new_data(1))
    assert not verdict.usable
    assert "too few to decide" in verdict.headline
    assert [one.facts["legs"] for one in verdict.of("watch.leg_blind")] == ["legs 1 to 4"]
    document = judged.document(estimate.machine)
    assert not document["changed"]
    assert len(document["legs"]) == 4


def test_a_planar_machine_by_its_board():
    rng = np.random.default_rng(12)
    nominal = load_mechanism("3-rpr")
    true = true_machine(nominal, 1.0, rng)
    truth = draw_truth(true, (CAMERA,), Settings(stations=1, configurations=60, tolerance=0.0), 2)
    poses = truth.T_base_platform
    case = measured(true, poses[:50], rng)
    start = start_state(nominal, case.measurements, T_CAMERA_BASE[None])
    estimate = bundle(nominal, case.measurements, start)
    same = detect_changes(by_board(estimate, true, poses[50:58], rng), estimate.machine, ALPHA)
    assert not same.changed
    now = moved(true, leg2_length__offset=3e-3)
    judged = detect_changes(by_board(estimate, now, poses[50:58], rng), estimate.machine, ALPHA)
    first = judged.findings[0]
    similar = {(s.cause.part, s.cause.legs) for s in (first.suspect, *first.others)}
    assert ("zero", (1,)) in similar


def test_three_poses_of_a_board_do_not_determine_a_hexapod():
    """They are reported as too few, with the detectable change."""
    rng = np.random.default_rng(5)
    nominal = load_mechanism("gough-stewart")
    true = true_machine(nominal, 1.0, rng)
    settings = Settings(stations=1, configurations=43, tolerance=0.0)
    poses = draw_truth(true, (CAMERA,), settings, 3).T_base_platform
    case = measured(true, poses[:40], rng)
    start = start_state(nominal, case.measurements, T_CAMERA_BASE[None])
    estimate = bundle(nominal, case.measurements, start)
    judged = detect_changes(by_board(estimate, true, poses[40:], rng), estimate.machine, ALPHA)
    verdict = watch_verdict(judged, new_data(3))
    assert not verdict.usable
    assert not judged.changed
    assert "which is more than the nominal model's tolerance" in verdict.reasons[0]


def test_poses_that_cannot_be_found(watched, monkeypatch):
    rng = np.random.default_rng(1)
    data = watched.observe(watched.true, rng)
    start = start_state(watched.true, data, watched.pool.T_camera_base)
    module = "pkmcal.judge.fixed_machine.minimise"
    monkeypatch.setattr(module, lambda *_, **__: Solution(None, None, None, (Stop.STALLED,), None))
    with raises(ResultError, code="poses.not_converged"):
        hold(watched.true, data, start, Trust.full(data))


def test_a_family_that_sees_nothing():
    machine = load_mechanism("gough-stewart")
    blind = Evidence(np.zeros(3), np.zeros((3, len(machine.parameters))))
    judged = detect_changes(blind, machine, ALPHA)
    assert judged.tests == ()
    assert not judged.changed
    verdict = watch_verdict(judged, new_data(1))
    assert not verdict.usable
    assert [one.facts["legs"] for one in verdict.of("watch.leg_blind")] == ["legs 1 to 6"]


# studies


def least_chance(watched, machine, k):
    """Smallest p-value over all tests of one session of a machine."""
    values = watched.evidence(machine, np.random.default_rng([k, 77]))
    legs, zero, _ = made_tests(values, watched.true)
    return min(t.adjusted for t in (*legs, *zero) if t and t.dof)


@pytest.mark.slow
def test_false_alarms_and_power_of_many_sessions(watched, capsys):
    """Of 1000 unchanged machines, alpha are flagged; changes by 0.1 to 1 mm ever more often."""
    lines: list[str] = []
    for off, count in ((0.0, 1000), (1e-4, 200), (2e-4, 200), (5e-4, 200), (1e-3, 200)):
        now = moved(watched.true, leg3_length__offset=off)
        least = np.array([least_chance(watched, now, k) for k in range(count)])
        shares = {alpha: float(np.mean(least < alpha)) for alpha in (0.01, 0.05, 0.1)}
        lines.append(f"{off * 1e3:.1f} mm: {shares}")
        if off == 0.0:
            for alpha, share in shares.items():
                assert abs(share - alpha) < 4 * np.sqrt(alpha * (1 - alpha) / count)
    with capsys.disabled():
        sys.stdout.write("\n" + "\n".join(lines) + "\n")
    assert shares[0.01] > 0.95
