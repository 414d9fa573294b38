"""Verdict on a result: unidentifiable directions count if they move the platform."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from kit_sessions import probe_kit
from pkmcal.calibration.results import identifiability_of
from pkmcal.files import json_text
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.bundle import bundle
from pkmcal.identify.centres import joint_centres
from pkmcal.identify.conditions import conditions
from pkmcal.identify.covariance import ParameterDirection, identifiability
from pkmcal.identify.motions import UNIDENTIFIED
from pkmcal.identify.sentences import Sentence
from pkmcal.identify.tool import centres_and_tool, platform_by_parameters, platform_sigma
from pkmcal.identify.unidentified import Identification, explain, observed_legs
from pkmcal.identify.verdict import VERDICT, VerdictOptions, assess, no_gain
from pkmcal.measurements import Observation
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome.finding import Level
from pkmcal.report.parameters import unidentified
from pose_sessions import POSE_SIGMA, estimated, measured
from test_words import heaved, make, moved


def judged(scene, *views):
    """Estimate, findings and verdict of a scene with noise, each station seeing some legs."""
    machine, rng = scene.machine, np.random.default_rng(4)
    measurements = scene.measurements(rng)
    if views:
        edges = measurements.edges
        keep = [leg + 1 in views[s] for s, leg in zip(edges.station, edges.leg, strict=True)]
        measurements = replace(measurements, edges=edges.select(np.array(keep)))
    start = replace(scene.state(), theta=machine.values)
    estimate = bundle(machine, measurements, start)
    edges = measurements.edges
    observation = Observation(
        edges, (), np.zeros((0, 2)), np.zeros(0, int), estimate.state.T_camera_base
    )
    values = identifiability(estimate.linearized.info, estimate.machine)
    observed = observed_legs(edges, estimate.edge_weights, measurements.n_stations, machine.n_legs)
    findings = explain(values, estimate, observed, conditions(machine, observed))
    return observation, estimate, findings, assess(observation, estimate, findings)


@pytest.fixture(scope="module")
def whole():
    return judged(make("gough-stewart"))


def test_headline_is_the_tool_error_before_and_after(whole):
    """Means over the poses: nominal from calibrated at the same readings, and standard deviation;
    the first by forward kinematics of both machines, with frames laid over each other.
    """
    _, estimate, _, verdict = whole
    numbers = [float(text) for text in re.findall(r"[\d.]*\d", verdict.headline)]
    before_mm, after_mm, times, before_degrees, after_degrees = numbers
    machine, used = estimate.machine, estimate.configurations
    nominal = machine.with_values(machine.parameters.nominal)
    poses = estimate.state.T_base_platform[used]
    base, platform = (
        side.T_calibrated_nominal
        for side in joint_centres(nominal, machine, np.zeros_like(estimate.covariance))
    )
    off = base @ nominal.forward(machine.inverse(poses), poses) @ inverse(platform)
    change = pose_difference(off, poses)
    turn, place = (np.linalg.norm(part, axis=-1).mean() for part in (change[:, :3], change[:, 3:]))
    assert before_mm == pytest.approx(1e3 * place, rel=0.06)  # two digits
    assert before_degrees == pytest.approx(np.rad2deg(turn), rel=0.06)
    assert times == pytest.approx(before_mm / after_mm, rel=0.12)
    tool = centres_and_tool(nominal, estimate, None)[1]
    assert after_mm == pytest.approx(1e3 * tool.position.mean(), rel=0.06)
    assert after_degrees == pytest.approx(np.rad2deg(tool.orientation.mean()), rel=0.06)


NAMING = (
    *({"new_sine": value} for value in (0.05, 0.1, 0.22, 0.5)),
    {"inside": (0.9999, 0.99)},
    {"inside": (0.99, 0.8)},
    {"sparse_steps": 0},
    {"frame_weight": 1.0},
)
"""Limits that choose names of motions."""


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Observation, estimate, legs by station, bed, ranks and verdict of sessions that leave much
    undetermined.

    Of the three-legged ones, other names for motions once refused the first and the third.
    """
    out = []

    def add(observation, estimate, bed=None):
        observed = np.ones((1, estimate.machine.n_legs), bool)
        ranks = identifiability(estimate.linearized.info, estimate.machine)
        verdict = assess(observation, estimate, explain(ranks, estimate, observed, bed=bed))
        out.append((observation, estimate, observed, bed, ranks, usable_and_codes(verdict)))

    legs = (("3-rps", 5, 7), ("3-rps", 8, 3), ("3-rps", 8, 7), ("gough-stewart", 5, 3))
    for name, n, seed in legs:
        observation, estimate, _, _ = judged(make(name, n=n, n_stations=1, seed=seed))
        add(observation, estimate)
    heights = probe_kit(tmp_path_factory.mktemp("heights") / "session", n=7).calibrated()
    add(heights.observation, heights.estimate, heights.identification.bed)
    rng = np.random.default_rng(1)
    for name, count in (("linear-delta", 8), ("gough-stewart", 12)):
        machine = load_mechanism(name)
        case = measured(machine, moved(machine, rng, count), rng)
        points = np.diag(np.r_[np.zeros(3), 1 / POSE_SIGMA[3:]])
        whiten = np.broadcast_to(points, (count, 6, 6)).copy()
        poses = replace(case.measurements.poses, whiten=whiten)
        tracked = case._replace(measurements=replace(case.measurements, poses=poses))
        add(heights.observation, estimated(machine, tracked, rng))
    assert {usable for *_, (usable, _) in out} == {True, False}
    return out


@pytest.fixture(scope="module")
def apart():
    poses = moved(load_mechanism("gough-stewart"), np.random.default_rng(1), 10, turn=0.0)
    scene = make("gough-stewart", poses=poses)
    return judged(scene, (1, 3, 4, 6), (1, 3, 4, 6), (2, 5))


def test_a_whole_session_may_be_used(whole):
    _, _, findings, verdict = whole
    assert verdict.usable
    assert findings.identifiability.unidentified == ()
    assert verdict.warnings == ()


def test_the_limits_of_a_verdict_are_its_options(whole):
    observation, estimate, findings, _ = whole
    used = int(estimate.configurations.sum())

    def codes(**limits):
        return assess(observation, estimate, findings, options=VerdictOptions(**limits)).codes

    assert "configurations.few" not in codes(few_configurations=used)
    assert "configurations.few" in codes(few_configurations=used + 1)
    scale = estimate.statistics.noise_scale
    assert "data.misfit" not in codes(too_noisy=scale)
    assert "data.misfit" in codes(too_noisy=np.nextafter(scale, 0))


def test_edges_that_a_method_of_the_papers_leaves_far_off_are_its_own_misfit(whole):
    observation, estimate, findings, _ = whole
    noisy = VerdictOptions(too_noisy=np.nextafter(estimate.statistics.noise_scale, 0))
    for method, other in (("bundle", "four-step"), ("four-step", "bundle")):
        codes = assess(observation, estimate, findings, method=method, options=noisy).codes
        expected = {"bundle": "data.misfit", "four-step": "estimate.method_misfit"}
        assert expected[method] in codes
        assert expected[other] not in codes


def test_light_that_moves_single_edges_is_warned_of(whole):
    observation, estimate, findings, _ = whole

    def sentences_of(*shading):
        noise = replace(estimate.edge_noise, shading=np.array(shading))
        verdict = assess(observation, replace(estimate, edge_noise=noise), findings)
        return verdict.of("edges.polished")

    (text,) = sentences_of(0.08, 0.2)
    assert text.facts["value"] == 0.08
    assert sentences_of(0.02, 0.2) == ()  # painted tubes are enough beside polished rods


def test_stations_apart_are_refused_with_words_and_advice(apart):
    _, _, findings, verdict = apart
    assert not verdict.usable
    # the poses' noise turns the platform a little, so that the rank is full but for a trace
    assert findings.identifiability.weak[-1].information < 0.05
    assert findings.unidentified[0].dimensions == 3
    reason = next(r for r in verdict.reasons if r.startswith("Legs 2 and 5 are never seen"))
    assert "Within the nominal model's tolerances this moves the platform by" in reason
    assert "Add a station that sees legs 2 and 5 together with" in reason
    assert "observe: [legs, board]" in reason


@pytest.mark.parametrize("name", ["gough-stewart", "3-rpr", "3-rps"])
def test_one_configuration_is_refused(name):
    scene = make(name, n=1, n_stations=3)
    _, _, findings, verdict = judged(scene)
    assert findings.identifiability.unidentified
    assert not verdict.usable
    assert any("Take images of more configurations" in r for r in verdict.reasons)


def test_heave_alone_is_stated():
    scene = make("gough-stewart", poses=heaved(load_mechanism("gough-stewart"), 12))
    _, _, _, verdict = judged(scene)
    text = " ".join(verdict.reasons + verdict.warnings)
    assert "How far apart the legs stand and how thick their tubes are" in text
    assert "Turn the platform in some configurations" in text


def test_what_does_not_move_the_platform_is_a_note():
    """A passive leg without images: its own values are unidentified, the platform is not."""
    scene = make("6-spu-passive")
    _, _, _, verdict = judged(scene, *[(1, 2, 3, 4, 5, 6)] * 3)
    assert verdict.usable, verdict.reasons
    assert any("leg 7 is in no image" in a for a in verdict.advice)


def test_axes_that_nothing_shows_do_not_refuse_a_3_upu():
    machine = load_mechanism("3-upu")
    poses = moved(machine, np.random.default_rng(1), 15, turn=0.0)
    _, _, findings, verdict = judged(make("3-upu", poses=poses, errors=0.2))
    assert verdict.usable, verdict.reasons
    turns = [s for s in (*findings.unidentified, *findings.weak) if "common direction" in s.text]
    assert sum(s.dimensions for s in turns) == 6


def sentence(moves, *names, matters=True):
    return Sentence("It is open.", "Do something.", names, 1, moves, matters)


def with_open(findings, *open_):
    """Findings with other undetermined motions, which are independent."""
    shift = np.sqrt(sum(s.moves_platform**2 for s in open_ if s.matters))
    return replace(findings, unidentified=open_, undetermined_shift=float(shift))


def test_the_share_of_the_nominal_error_decides(whole):
    observation, estimate, findings, _ = whole
    least = VERDICT.undetermined_share * findings.by_nominal

    def verdict(*open_):
        return assess(observation, estimate, with_open(findings, *open_))

    below, above = verdict(sentence(0.9 * least)), verdict(sentence(1.1 * least))
    assert below.usable
    assert below.warnings == ("It is open. Do something.",)
    assert not above.usable
    assert above.reasons == ("It is open. Do something.",)
    assert above.warnings == ()
    # many small ones add up, and each that is large enough is named
    assert len(verdict(*[sentence(0.6 * least, str(k)) for k in range(4)]).reasons) == 4
    assert verdict(*[sentence(50 * least, str(k), matters=False) for k in range(4)]).usable


def test_what_is_open_does_not_refuse_a_result_that_is_worse_anyhow(whole):
    """Few images: the standard deviation shows it, and unidentified directions are a small part of
    it.
    """
    observation, estimate, findings, _ = whole
    open_ = sentence(2 * VERDICT.undetermined_share * findings.by_nominal)
    findings = with_open(findings, open_)
    assert not assess(observation, estimate, findings).usable
    unsure = replace(estimate, joint_covariance=1e3 * estimate.joint_covariance)
    assert assess(observation, unsure, findings).usable


def test_a_result_that_is_no_gain_is_refused(whole):
    """Legs are judged as heights are: by a share of what the prior sigmas let expect."""
    observation, estimate, findings, _ = whole
    sigma = platform_sigma(estimate)
    for share, usable in ((0.9, True), (1.1, False)):
        factor = share * VERDICT.nominal_error_share * findings.by_nominal / sigma
        unsure = replace(estimate, joint_covariance=factor**2 * estimate.joint_covariance)
        value = assess(observation, unsure, findings)
        assert value.usable == usable
        assert len(value.reasons) == (not usable)
    assert no_gain(np.nan, 1.0)
    assert not no_gain(0.0, 0.0)


def test_a_result_at_the_limit_is_worse_than_the_nominal_model_in_one_of_twenty_cases():
    """The squared errors of a pose's six numbers, drawn for both."""
    rng = np.random.default_rng(0)
    nominal, result = (np.sum(rng.normal(size=(100_000, 6)) ** 2, axis=1) for _ in range(2))
    worse = VERDICT.nominal_error_share**2 * result > nominal
    assert np.mean(worse) == pytest.approx(0.05, abs=0.003)


def test_without_a_degree_of_freedom_it_is_refused(whole):
    observation, estimate, findings, _ = whole
    for dof in (0.0, -4.0, 1.0):
        other = replace(estimate, statistics=replace(estimate.statistics, dof=dof))
        assert assess(observation, other, findings).usable == (dof > 0)


def test_what_the_prior_determines_better_counts_as_far_as_data_leave_it(whole):
    """The more the data determine, the less a direction counts; nothing jumps."""
    observation, estimate, findings, _ = whole
    ranks, machine = findings.identifiability, estimate.machine
    effect = platform_by_parameters(machine, estimate.state.T_base_platform)
    shifts = np.linalg.norm(effect @ ranks.directions.T, axis=0)
    first = int(np.argmax(shifts))
    observed = np.ones((3, machine.n_legs), bool)

    def with_information(value):
        values = ranks.singular_values.copy()
        values[first] = value
        direction = ParameterDirection(("",), (1.0,), value, ranks.directions[first])
        changed = replace(ranks, singular_values=values, weak=(direction,))
        return explain(changed, estimate, observed)

    def left(value):
        return with_information(value).undetermined_shift / shifts[first]

    assert left(0.0) == pytest.approx(1.0, rel=1e-4)
    assert left(1.0) == pytest.approx(0.5, rel=1e-4)
    assert left(10.0) == pytest.approx(1 / 101, rel=0.1)
    # noise, which makes the rest of the estimate's variance: refused, a warning, no finding
    half, few = with_information(1.0), VERDICT.least_noise_share
    largest = max(s.moves_platform for s in (*half.unidentified, *half.weak))
    refused, warned = (half.undetermined_shift / np.sqrt(1 - k * few) for k in (0.9, 1.1))
    silent = 1.1 * largest / VERDICT.worth_reporting
    for sigma, level in ((refused, Level.WRONG), (warned, Level.DOUBTFUL), (silent, None)):
        scale = (sigma / platform_sigma(estimate)) ** 2
        other = replace(estimate, joint_covariance=scale * estimate.joint_covariance)
        findings = assess(observation, other, half).findings
        found = {one.level for one in findings if one.code == "machine.undetermined"}
        assert found == ({level} if level else set())


@pytest.mark.parametrize("option", NAMING)
def test_no_verdict_depends_on_how_motions_are_named(sessions, option):
    for observation, estimate, observed, bed, ranks, expected in sessions:
        findings = explain(
            ranks, estimate, observed, bed=bed, options=replace(UNIDENTIFIED, **option)
        )
        assert usable_and_codes(assess(observation, estimate, findings)) == expected


def usable_and_codes(verdict):
    return verdict.usable, {(one.code, one.level) for one in verdict.findings}


def test_other_limits_choose_other_names(sessions):
    _, estimate, observed, _, ranks, _ = sessions[0]
    texts = set()
    for option in NAMING:
        options = replace(UNIDENTIFIED, **option)
        findings = explain(ranks, estimate, observed, options=options)
        texts.add(tuple(s.text for s in (*findings.unidentified, *findings.weak)))
    assert len(texts) > 2


def test_what_is_not_identified_stands_in_the_file(apart):
    _, estimate, findings, _ = apart
    document = identifiability_of(findings)
    assert document["rank"] + len(findings.identifiability.unidentified) == (
        document["n_parameters"] - document["n_frames"]
    )
    first = document["unidentified"][0]
    assert {"text", "advice", "moves_platform", "parameters"} <= set(first)
    assert set(first["parameters"]) <= set(estimate.machine.parameters.names)
    assert {"equation", "needed", "available", "met", "text"} == set(document["conditions"][0])
    assert "never seen together" in json_text(document)
    text = unidentified(estimate, findings)
    assert text[0] == f"{first['text']} {first['advice']}"
    assert isinstance(findings, Identification)
