"""Hypotheses about a session: their posterior, the list for readings, and closure as evidence."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from math import exp, log

import numpy as np
import pytest
from scipy.optimize import least_squares

from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.localization import platform_poses
from pkmcal.calibration.pose_hypotheses import (
    CLOSURE,
    EXPLAINED_POSES_SHARE,
    closure_misfits,
    explain_closure,
    nominal_misfit,
)
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import perturb, pose_difference, rotation
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.reading_hypotheses import (
    range_hypotheses,
    range_ratios,
    reading_hypotheses,
)
from pkmcal.outcome.hypotheses import (
    HYPOTHESIS_THRESHOLDS,
    EvidenceLevel,
    Hypothesis,
    decide,
    estimate_level,
    harmless_misfit,
    likely,
    log_likelihood,
    parameter_cost,
    posterior,
    rivals_of,
)
from pkmcal.session.load import load_session
from pkmcal.simulation.truth import true_machine
from pose_sessions import T_CAMERA_BASE, T_PLATFORM_BOARD, measured
from test_pose_sessions import make, measured_poses, write_joints, write_poses


def named(code, subject="", log_prior=0.0, action="refuse"):
    return Hypothesis(code, subject, lambda data: data, log_prior, action)


def level(name, ratios, **options):
    """A level that gives each code its log-likelihood ratio, and the codes that it was given."""
    given = []

    def log_likelihood_ratios(hypotheses):
        given.append([one.code for one in hypotheses])
        return np.array([ratios[one.code] for one in hypotheses])

    return EvidenceLevel(name, log_likelihood_ratios, **options), given


# the posterior


def test_log_odds_are_those_of_bayes():
    """Three coins: a fair one is the null, of two that are not one is rarer."""
    heads, tosses = 9, 10
    chance = {"biased": 0.8, "two heads": 0.99}
    prior = {"biased": 0.1, "two heads": 0.001}
    ratios = {
        name: heads * log(p / 0.5) + (tosses - heads) * log((1 - p) / 0.5)
        for name, p in chance.items()
    }
    one, _ = level("tosses", ratios)
    ranked = posterior([named(name, log_prior=log(p)) for name, p in prior.items()], [one])
    odds = {item.hypothesis.code: exp(item.log_odds) for item in ranked}
    for name, p in chance.items():
        expected = prior[name] * p**heads * (1 - p) ** (tosses - heads) / 0.5**tosses
        assert odds[name] == pytest.approx(expected)


def test_the_cheapest_level_that_decides_is_the_last():
    cheap, _ = level("cheap", {"a": HYPOTHESIS_THRESHOLDS.act + 1, "b": -1.0})
    costly, given = level("costly", {"a": 0.0, "b": 0.0})
    ranked = posterior([named("a"), named("b")], [cheap, costly])
    assert decide(ranked).hypothesis.code == "a"
    assert ranked[0].level == "cheap"
    assert given == []


@pytest.mark.parametrize("other", [HYPOTHESIS_THRESHOLDS.act, 2.0])
def test_a_level_does_not_decide_between_explanations_that_it_cannot_distinguish(other):
    cheap, _ = level("cheap", {"a": HYPOTHESIS_THRESHOLDS.act + 1, "b": other})
    costly, given = level("costly", {"a": 1.0, "b": 20.0})
    ranked = posterior([named("a"), named("b")], [cheap, costly])
    assert given == [["a", "b"]]
    assert decide(ranked).hypothesis.code == "b"


def test_variants_of_one_explanation_are_no_rivals():
    cheap, _ = level("cheap", {"a": HYPOTHESIS_THRESHOLDS.act + 1})
    costly, given = level("costly", {"a": 0.0})
    ranked = posterior([named("a", "motor 1"), named("a", "motor 1")], [cheap, costly])
    assert given == []
    assert rivals_of(ranked) == []


def test_what_the_likelihood_drops_is_not_weighed_again():
    """The prior of a hypothesis alone drops none: more evidence may outweigh it."""
    cheap, _ = level(
        "cheap",
        {"best": 1.0, "rare": 0.5, "worse": -HYPOTHESIS_THRESHOLDS.beam, "none": -np.inf},
        decides=False,
    )
    costly, given = level("costly", {"best": 0.0, "rare": 100.0})
    ranked = posterior(
        [named("best"), named("rare", log_prior=-50.0), named("worse"), named("none")],
        [cheap, costly],
    )
    assert given == [["best", "rare"]]
    assert ranked[0].hypothesis.code == "rare"


def test_only_so_many_go_on():
    cheap, _ = level("cheap", {"a": 1.0, "b": 3.0, "c": 2.0}, decides=False, most=2)
    costly, given = level("costly", {"b": 0.0, "c": 0.0})
    posterior([named("a"), named("b"), named("c")], [cheap, costly])
    assert given == [["b", "c"]]


def test_a_repair_needs_more_than_a_report():
    between = 0.5 * (HYPOTHESIS_THRESHOLDS.report + HYPOTHESIS_THRESHOLDS.act)
    for action, limit in (
        ("refuse", HYPOTHESIS_THRESHOLDS.report),
        ("repair", HYPOTHESIS_THRESHOLDS.act),
    ):
        for odds in (HYPOTHESIS_THRESHOLDS.report - 0.1, between, HYPOTHESIS_THRESHOLDS.act + 0.1):
            one, _ = level("only", {"a": odds})
            assert (decide(posterior([named("a", action=action)], [one])) is not None) == (
                odds > limit
            )


def test_rivals_are_reported_that_are_likely_themselves():
    """What the first hypothesis does not exclude may still be less likely than no mistake."""
    first = HYPOTHESIS_THRESHOLDS.report + 1
    one, _ = level(
        "only",
        {
            "a": first,
            "b": HYPOTHESIS_THRESHOLDS.report + 0.5,
            "c": HYPOTHESIS_THRESHOLDS.report - 0.5,
        },
    )
    ranked = posterior([named("c"), named("a"), named("b")], [one])
    assert [each.hypothesis.code for each in likely(ranked)] == ["a", "b"]
    assert {each.hypothesis.code for each in rivals_of(ranked)} == {"b", "c"}
    weak, _ = level("only", {"a": HYPOTHESIS_THRESHOLDS.report - 0.1})
    assert likely(posterior([named("a")], [weak])) == []


def test_nothing_is_decided_of_no_hypotheses():
    one, _ = level("only", {})
    assert decide(posterior([], [one])) is None


def test_an_estimate_weighs_what_it_explains_and_lists_what_it_could_not_test():
    misfits, failures = {"right": 1.0, "worse": 9.0, "poor": 4.0}, []

    def misfit(one):
        if one.code not in misfits:
            raise ResultError("no convergence")
        return misfits[one.code]

    level = estimate_level(misfit, 8.0, 20, 4.0, lambda one, why: failures.append((one.code, why)))
    ranked = posterior([named(code) for code in ("none", "poor", "worse", "right")], [level])
    assert [one.hypothesis.code for one in ranked] == ["right"]
    assert ranked[0].log_odds == pytest.approx(20 * log(8.0))
    assert failures == [("none", "no convergence")]


@pytest.mark.parametrize("misfit", [0.3, 1.0, 7.0])
def test_the_log_likelihood_has_the_likeliest_scale(misfit):
    """Normal residuals, n of them, of any scale that is no smaller than stated."""
    n = 12
    scales = np.linspace(1.0, 10.0, 9001)
    each = -n * np.log(scales) - n * misfit**2 / (2 * scales**2)
    assert log_likelihood(np.array(misfit), n) == pytest.approx(each.max(), abs=1e-5)


@pytest.mark.parametrize("n", [8.0, 30.0])
@pytest.mark.parametrize("prior", [0.0, -4.0])
def test_nothing_can_be_reported_of_a_harmless_misfit(n, prior):
    least = harmless_misfit(n, prior)
    for factor, reported in ((0.99, False), (1.01, True)):
        null, explained = log_likelihood(np.array([factor * least, 1.0]), n)
        (best,) = posterior(
            [named("one", log_prior=prior)], [level("residuals", {"one": explained - null})[0]]
        )
        assert (decide([best]) is not None) == reported


def test_no_misfit_is_worse_than_an_infinite_one():
    np.testing.assert_array_equal(log_likelihood(np.array([np.inf, np.nan]), 9), -np.inf)


def test_free_parameters_cost_what_noise_gains_by_them():
    """BIC, beside what k numbers of noise explain on average, k / 2: no parameter gains by that."""
    for n in (10, 100):
        assert parameter_cost(6, n) < -3.0
    assert parameter_cost(0, 100) == 0.0


# readings


def test_every_order_of_columns_is_one_hypothesis():
    for count in (2, 3, 4, 6):
        joints = np.arange(float(5 * count)).reshape(5, count)
        orders = [
            tuple(one.apply(joints)[0])
            for one in reading_hypotheses(joints, np.full((count, 2), np.nan))
            if one.code in ("readings.exchanged", "readings.numbering_turned",
                            "readings.numbering_reversed")
        ]  # fmt: skip
        assert len(set(orders)) == len(orders)
        assert tuple(joints[0]) not in orders
        assert tuple(np.roll(joints[0], 1)) in orders
        assert tuple(joints[0, ::-1]) in orders


def test_reversed_readings_stay_in_their_range():
    rng = np.random.default_rng(0)
    ranges = np.array([[0.3, 0.5], [-1.0, 1.0], [np.nan, np.nan]])
    joints = np.column_stack(
        [rng.uniform(0.35, 0.4, 9), rng.uniform(-0.9, 0.9, 9), rng.uniform(0, 1, 9)]
    )
    for one in reading_hypotheses(joints, ranges):
        if one.code not in ("readings.reversed", "readings.sign"):
            continue
        (motor,) = one.facts["motors"]
        low, high = ranges[motor]
        values, slack = one.apply(joints)[:, motor], 0.05 * (high - low) + 1e-12
        np.testing.assert_allclose(values + joints[:, motor], one.facts["constant"], atol=1e-12)
        if np.isfinite(low):
            assert values.min() >= low - slack
            assert values.max() <= high + slack


# closure

SPOILT = {
    "readings.reversed": lambda joints: np.column_stack(
        [joints[:, 0].min() + joints[:, 0].max() + 0.01 - joints[:, 0], joints[:, 1:]]
    ),
    "readings.exchanged": lambda joints: joints[:, [1, 0, *range(2, joints.shape[1])]],
    "readings.numbering_turned": lambda joints: np.roll(joints, 1, axis=1),
    "readings.shifted": lambda joints: np.roll(joints, 1, axis=0),
}


@pytest.mark.parametrize("code", SPOILT)
@pytest.mark.parametrize(
    ("name", "kind"), [("gough-stewart", "poses"), ("gough-stewart", "points"), ("h4", "poses")]
)
def test_closure_finds_the_mistake(tmp_path, name, kind, code):
    """Without any estimate, as a session would be spoilt; of a right one it finds none."""
    make(tmp_path / "session", name, kind, n=24)
    session = load_session(tmp_path / "session")
    machine, right = session.machine, measurements_of(session, Boards())
    spoilt = replace(right, joints=SPOILT[code](right.joints))
    for measurements, expected in ((spoilt, code), (right, None)):
        hypotheses = reading_hypotheses(measurements.joints, machine.joint_ranges)
        cases = [replace(measurements, joints=one.apply(measurements.joints)) for one in hypotheses]
        null, *misfits = closure_misfits(machine, [measurements, *cases])
        best = int(np.argmin(misfits))
        if expected is None:  # a machine of equal thirds is the same turned by one
            assert misfits[best] > 0.9 * null
        else:
            assert hypotheses[best].code == expected
            assert misfits[best] < 0.2 * null
            if name == "gough-stewart" and code == "readings.numbering_turned":
                continue  # or turned by a third more, which is the same machine
            restored = hypotheses[best].apply(spoilt.joints)
            assert np.median(np.abs(restored - right.joints)) < 0.02


def test_closure_is_a_least_squares_registration():
    """Of a planar machine too, whose rotations about one axis leave positions to the rest.

    Nominal rotations are off by degrees, and closed forms, which use them first, by more.
    """
    rng = np.random.default_rng(2)
    nominal = load_mechanism("3-rpr")
    true = true_machine(nominal, 1.0, rng)
    poses = np.tile(true.home(), (24, 1, 1))
    poses[:, :3, :3] = rotation(np.eye(3)[2] * rng.uniform(-0.4, 0.4, (24, 1)))
    poses[:, :2, 3] += rng.uniform(-0.06, 0.06, (24, 2))
    data = measured(true, poses, rng).measurements
    body, target = nominal.forward(data.joints), data.poses

    def residuals(x):
        predicted = perturb(T_CAMERA_BASE, x[:6]) @ body @ perturb(T_PLATFORM_BOARD, x[6:])
        error = pose_difference(predicted, target.T_station_target)
        return (target.whiten @ error[..., None])[..., 0]

    best = least_squares(lambda x: residuals(x).ravel(), np.zeros(12), x_scale="jac").x
    squares = np.sort(np.mean(residuals(best) ** 2, axis=1))
    least = np.sqrt(np.mean(squares[: int(np.ceil(EXPLAINED_POSES_SHARE * len(squares)))]))
    assert closure_misfits(nominal, [data])[0] == pytest.approx(least, rel=1e-3)


def contradicted(machine, measurements, rng):
    """Whether poses and readings contradict each other."""
    (misfit,) = closure_misfits(machine, [measurements])
    return misfit > CLOSURE.most_nominal_error * nominal_misfit(machine, measurements, rng)


@pytest.mark.parametrize("name", ["gough-stewart", "delta"])
def test_a_reading_that_stands_still_contradicts_the_poses(tmp_path, name):
    """But not where the machine stood so in truth."""
    made = make(tmp_path / "session", name, n=24)
    session = load_session(tmp_path / "session")
    right = measurements_of(session, Boards())
    joints = right.joints.copy()
    joints[:, 1] = joints[0, 1]
    frozen, rng = replace(right, joints=joints), np.random.default_rng(0)
    assert contradicted(session.machine, frozen, rng)
    held = made.machine.forward_result(joints)
    body = held.T_base_platform[held.converged]
    rows = np.flatnonzero(held.converged)
    poses = right.poses.select(rows)
    there = right.poses.T_station_target[0] @ np.linalg.inv(body[0]) @ body
    still = replace(right, joints=joints[rows], poses=replace(
        poses, T_station_target=there, configuration=np.arange(len(rows))))  # fmt: skip
    assert not contradicted(session.machine, still, rng)


@pytest.mark.parametrize("name", ["gough-stewart", "h4", "delta"])
@pytest.mark.parametrize("kind", ["poses", "points"])
def test_right_readings_contradict_no_poses(tmp_path, name, kind):
    make(tmp_path / "session", name, kind, n=24)
    session = load_session(tmp_path / "session")
    right = measurements_of(session, Boards())
    assert not contradicted(session.machine, right, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["delta", "gough-stewart", "h4"])
def test_exchanged_columns_are_refused_before_any_estimate_of_them(tmp_path, name):
    """An estimate from them takes a thousand steps; one from the right order is made."""
    made = make(tmp_path / "session", name, n=24)
    write_joints(made.folder, made.joints[:, [1, 0, *range(2, made.joints.shape[1])]])
    error = explain_closure(load_session(made.folder), Boards()).error
    assert error.code == "readings.exchanged"


@pytest.mark.parametrize(("name", "scale"), [("delta", 3.0), ("delta", 10.0), ("h4", 2.0)])
def test_a_poor_nominal_model_is_no_mistake_in_the_readings(tmp_path, name, scale):
    """Its errors, of an unknown factor on the prior sigmas, are in all hypotheses alike."""
    for seed in range(2):
        made = make(tmp_path / f"session {seed}", name, n=24, seed=100 + seed, scale=scale)
        assert explain_closure(load_session(made.folder), Boards()).error is None


def test_two_mistakes_are_named_together(tmp_path):
    """Two motors that count the other way, and two rows exchanged, which hide neither."""
    made = make(tmp_path / "session", "gough-stewart", n=24)
    joints, constants = made.joints.copy(), []
    for motor in (0, 3):
        constants.append(joints[:, motor].min() + joints[:, motor].max() + 0.003)
        joints[:, motor] = constants[-1] - joints[:, motor]
    joints[[5, 9]] = joints[[9, 5]]
    write_joints(made.folder, joints)
    error = explain_closure(load_session(made.folder), Boards()).error
    assert error.code == "readings.reversed"
    assert re.findall(r"motor\d", error.what) == ["motor1", "motor4"]
    assert error.expected.count("times their noise") == 1
    named = [1e-3 * int(value) for value in re.findall(r"(\d+) mm, or", error.expected)]
    np.testing.assert_allclose(named, constants, atol=6e-3)


@pytest.mark.parametrize("name", ["linear-delta", pytest.param("6-rus", marks=pytest.mark.slow)])
def test_a_mistake_in_the_readings_hides_none_of_another_kind(tmp_path, name):
    """Two columns exchanged, and a target that moved on the platform."""
    made = make(tmp_path / "session", name, n=16)
    in_view = measured_poses(made)
    in_view[9:] = in_view[9:] @ perturb(np.eye(4), np.array([0.01, 0, 0.02, 0.002, 0, 0]))
    write_poses(made.folder, in_view)
    write_joints(made.folder, made.joints[:, [1, 0, *range(2, made.joints.shape[1])]])
    error = explain_closure(load_session(made.folder), Boards()).error
    assert error.code == "readings.exchanged"
    assert "between configuration 008 and 009" in error.what


def test_what_no_mistake_explains_is_left_to_the_estimate(tmp_path):
    """Readings of another movement of the machine."""
    made = make(tmp_path / "session", "gough-stewart", n=24)
    rng = np.random.default_rng(0)
    write_joints(made.folder, rng.permutation(made.joints))
    session = load_session(made.folder)
    assert explain_closure(session, Boards()).error is None


# legs that do not meet the platform


@pytest.mark.parametrize(("motors", "code"), [([2], "readings.sign"), ([2, 3], "error.input")])
def test_a_sign_is_named_where_the_legs_meet_with_the_other_one(tmp_path, motors, code):
    """By the readings alone; with two wrong signs no single one explains it."""
    make(tmp_path / "session", "h4", n=16)
    session = load_session(tmp_path / "session")
    joints = session.joints.copy()
    joints[:, motors] *= -1
    with pytest.raises(InputError) as caught:
        platform_poses(replace(session, joints=joints))
    assert caught.value.code == code
    platform_poses(session)


def test_signs_of_two_motors_are_not_taken_for_degrees(tmp_path):
    """More than half of the readings are out of range, and in range divided by 57."""
    made = make(tmp_path / "session", "h4", n=24)
    joints = made.joints.copy()
    joints[:, [0, 2]] *= -1
    write_joints(made.folder, joints)
    with pytest.raises(InputError) as caught:
        load_session(made.folder)
    assert caught.value.code == "readings.sign"
    assert "motor1 and motor3" in caught.value.what


# readings against their ranges


def table_of(ranges, rng, count=16):
    """Readings all over most of their ranges."""
    low, high = ranges.T
    return low + (high - low) * rng.uniform(0.05, 0.9, (count, len(ranges)))


def named_by_ranges(joints, ranges, unit):
    """Code and columns of the mistake that the ranges show, if any."""
    hypotheses = range_hypotheses(joints, ranges, [unit] * len(ranges))
    level = EvidenceLevel("ranges", partial(range_ratios, joints, ranges))
    best = decide(posterior(hypotheses, [level]))
    return best and (best.hypothesis.code, best.hypothesis.facts["motors"])


RANGES = {
    "m": np.tile([0.345, 0.485], (6, 1)),
    "rad": np.array([[-0.4, 1.3], [-0.4, 1.3], [0.2, 1.9], [-1.5, 1.6]]),
}


@pytest.mark.parametrize("unit", RANGES)
def test_ranges_show_what_is_wrong_with_whole_columns(unit):
    ranges, rng = RANGES[unit], np.random.default_rng(0)
    low, high = ranges.T
    every, stroke = tuple(range(len(ranges))), high - low
    for _ in range(20):
        right = table_of(ranges, rng)
        factor = {"m": 1e3, "rad": 180 / np.pi}[unit]
        assert named_by_ranges(factor * right, ranges, unit) == ("readings.units", every)
        column = int(rng.integers(len(ranges)))
        single = np.where(np.arange(len(ranges)) == column, factor, 1.0) * right
        assert named_by_ranges(single, ranges, unit) == ("readings.units", (column,))
        away = right - 2 * stroke.max()
        assert named_by_ranges(away, ranges, unit) == ("readings.zero", every)
        signs = np.where(np.arange(len(ranges)) % 2, 1.0, -1.0)
        code, motors = named_by_ranges(signs * right, ranges, unit)
        assert (code, set(motors) <= {0, 2, 4}) == ("readings.sign", True)


@pytest.mark.parametrize("unit", RANGES)
def test_ranges_show_nothing_of_slips_nor_of_a_range_that_is_too_narrow(unit):
    """Single readings of any size, and all readings of a stroke that is a fifth longer: some are
    beyond the margin, and all could be in range by one constant.
    """
    ranges, rng = RANGES[unit], np.random.default_rng(0)
    low, high = ranges.T
    for _ in range(100):
        right = table_of(ranges, rng)
        assert named_by_ranges(right, ranges, unit) is None
        slip = right.copy()
        slip[rng.integers(len(slip)), rng.integers(len(ranges))] *= rng.choice([-1, 10, 100, 1000])
        assert named_by_ranges(slip, ranges, unit) is None
        longer = ranges + np.outer(high - low, [0.0, 0.2])
        assert named_by_ranges(table_of(longer, rng), ranges, unit) is None
    assert named_by_ranges(1e3 * right, np.full((len(ranges), 2), np.nan), unit) is None
