"""Plans: that they promise what an estimate states, and are better than chance."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import FEW_CANDIDATES, run
from document_keys import assert_keys
from faults import raises
from page_documents import page_blocks, page_document
from pkmcal.calibration.saved_calibration import CalibrationPrior, load
from pkmcal.errors import InputError
from pkmcal.files import csv_text, read_csv
from pkmcal.identify.bundle import bundle
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.covariance import machine_covariance
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.start import start_state
from pkmcal.identify.tool import tool_error
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.placement.configurations import READING_RANGE_SHARES, draw_configurations, usable
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.planning.exchange import exchanged, greedy, tool_variance, tool_weight
from pkmcal.planning.first import FirstEdges, first_edges
from pkmcal.planning.information import CandidateRows, Candidates, information_of
from pkmcal.planning.plan import PLAN, plan_measurements
from pkmcal.planning.rig import At, BoardFrom, all_pairs
from pkmcal.planning.route import length, motor_distances, shortest_path
from pkmcal.planning.subject import of_machine
from pkmcal.session.load import load_session, load_session_to_plan
from pkmcal.simulation import Settings, board_for, draw_truth
from pkmcal.simulation.rehearsal import rehearsal_of
from pkmcal.simulation.truth import RequestedConfigurations

SIZE = (640, 480)


def hexapod(places=2, **more):
    machine = load_mechanism("gough-stewart")
    return of_machine(machine, [camera_of_size(SIZE)] * places, machine.joint_names, **more)


def small(subject, options=FEW_CANDIDATES, **more):
    """A plan among few candidates, for tests' time."""
    return plan_measurements(subject, count=5, options=options, **more)


@pytest.fixture(scope="module")
def planned():
    """Plan for a hexapod's legs from two places."""
    return small(hexapod())


def test_more_pixels_than_a_lens_resolves_promise_nothing():
    """Plan for a camera without any images."""
    machine = load_mechanism("gough-stewart")
    rows = []
    for size in ((1024, 768), (4096, 3072)):
        camera = camera_of_size(size)
        (one,) = of_machine(machine, [camera], machine.joint_names).rig.instruments
        assert one.camera is camera  # which plan.json names
        edges = one.measure(At(machine, None, machine.home()[None]), np.zeros(1, int), None)
        rows.append(np.sqrt(np.trace(edges.covariance, axis1=-2, axis2=-1)).mean())
    assert rows[1] == pytest.approx(rows[0], rel=0.02)


# ------------------------------------------------------------------ the promise


def stated_by(rig, measurements, work):
    """The tool's deviations (m, rad) as the joint estimate of the measurements states them."""
    machine = rig.machine
    start = start_state(machine, measurements, rig.T_station_base)
    if rig.T_mount is not None and len(rig.mounts):
        start = replace(start, T_mount=rig.T_mount)
    estimate = bundle(machine, measurements, start, scale_noise=False)
    assembled, info = estimate.linearized
    gauge = default_gauge(machine)
    by_itself = machine_covariance(
        assembled.problem, machine, estimate.state, info.covariance[0], gauge
    )
    in_view = len(measurements.edges) > 0
    rows = []
    for joint in (by_itself, estimate.joint_covariance):
        parameters = joint[: len(machine.parameters), : len(machine.parameters)]
        covariance = free_of_gauge(estimate.machine, parameters)
        error = tool_error(machine, estimate.machine, covariance, work, legs_observed=in_view)
        rows.append((error.position.mean(), error.orientation.mean()))
    return rows


@pytest.mark.parametrize("target", ["legs", "board", "points", "together"])
def test_what_is_promised_is_what_the_estimate_states(target, planned):
    if target == "board":
        machine = load_mechanism("h4")
        board = board_for(machine, "platform")
        subject = of_machine(machine, [camera_of_size(SIZE)], machine.joint_names, board=board)
    elif target == "points":
        machine = load_mechanism("linear-delta")
        subject = of_machine(machine, [], machine.joint_names, tracker=(2e-5, None))
    else:
        subject = hexapod()
    count = planned if target == "legs" else small(subject, together=target == "together")
    rig, n = count.subject.rig, len(count.names)
    numbers = {name: k for k, name in enumerate(rig.names)}
    pairs = np.array([(numbers[s], k) for k in range(n) for s in count.stations[k]])
    data = rig.measured(count.joints, count.T_base_platform, pairs)
    (position, orientation), stated = stated_by(rig, data, count.work)
    # the means of edges are drawn one by one for the prediction: here they are all equal
    assert count.promised.position == pytest.approx(position, rel=2e-3)
    assert count.promised.orientation == pytest.approx(orientation, rel=2e-3, abs=1e-9)
    # plans ignore the error correlation
    assert count.promised.position == pytest.approx(stated[0], rel=0.03)
    assert count.promised.orientation == pytest.approx(stated[1], rel=0.03, abs=1e-9)


def test_a_plan_is_far_better_than_chance(planned):
    assert planned.promised.position < 0.5 * planned.by_chance.position
    assert planned.now.position > 5 * planned.by_chance.position


def test_configurations_are_possible_and_their_way_is_short(planned):
    value = planned
    machine = value.subject.rig.machine
    low, high = machine.joint_ranges.T
    margin = READING_RANGE_SHARES[0] * (high - low) - 1e-9
    assert np.all(value.joints >= low + margin)
    assert np.all(value.joints <= high - margin)
    assert usable(machine, value.T_base_platform, value.joints).all()
    np.testing.assert_allclose(machine.inverse(value.T_base_platform), value.joints, atol=1e-9)
    assert value.travel[0] <= value.travel[1]
    assert sorted(value.names) == ["a01", "a02", "a03", "a04", "a05", "b01", "b02", "b03", "b04",
                                   "b05"]  # fmt: skip
    assert sorted(value.rank.tolist()) == sorted([*range(1, 6)] * 2)


def test_more_configurations_never_increase_the_sigma(planned):
    positions = [a.position for a in planned.curve]
    assert all(after < before for before, after in itertools.pairwise(positions))
    # noise of images alone would fall with the root; errors common to all fall more slowly
    assert planned.curve[-1].position > 0.4 * planned.promised.position


# ------------------------------------------------------------------ the choice


def toy(seed=0, n=14, p=3):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n, 2, p + 2))
    reference_values = np.eye(p + 2) * 0.1
    reference_values[:p, :p] += np.eye(p) * 0.9
    machine = np.eye(p, p + 2)
    where = np.arange(n, dtype=float)[:, None]
    return CandidateRows(
        rows, np.zeros(n, int), where, reference_values, machine, rng.normal(size=(5, 6, p))
    )


def test_exchange_comes_near_the_best_of_all_subsets():
    better = []
    for seed in range(4):
        info = toy(seed)
        weight = tool_weight(info)

        def variance(subset, info=info, weight=weight):
            return float(tool_variance(weight, info.covariance(info.of(np.array(subset)))))

        every = [variance(c) for c in itertools.combinations(range(14), 4)]
        value = variance(exchanged(info, greedy(info, 4).chosen))
        better.append(np.sum(np.array(every) < value - 1e-12))
    # Exchanges one by one end in one of the best two hundredths of 1001 subsets.
    assert max(better) < 20


def test_no_configuration_is_measured_twice():
    info = toy(3)
    rows = np.repeat(info.rows[:7], 2, axis=0)
    rows[0:2] *= 50.0  # by far the best, and the same twice
    where = np.repeat(np.arange(7.0), 2)[:, None] + np.tile([0.0, 0.05], 7)[:, None]
    info = replace(info, rows=rows, where=where)
    chosen = greedy(info, 5).chosen
    for actual_names in (chosen, exchanged(info, chosen)):
        assert len(set(actual_names // 2)) == 5
        assert 0 in actual_names // 2


def test_the_weight_gives_the_mean_variance_of_the_tool():
    info = toy(1)
    covariance = info.covariance(info.of(np.arange(6)))
    shift = info.work[:, 3:]
    expected = np.mean([np.trace(rows @ covariance @ rows.T) for rows in shift])
    assert tool_variance(tool_weight(info), covariance) == pytest.approx(expected, rel=1e-12)


def test_the_greedy_path_is_that_of_its_choice():
    info = toy(2)
    value = greedy(info, 5)
    for k in range(1, 6):
        whole = info.covariance(info.of(value.chosen[:k]))
        np.testing.assert_allclose(value.path[k - 1], whole, rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------ what is known already


def test_what_a_calibration_knows_counts_as_its_data_would():
    """Two campaigns have the information of one, with stations at rest."""
    subject = hexapod()
    rig, machine = subject.rig, subject.rig.machine
    poses, _ = draw_configurations(machine, 16, 0.5, np.random.default_rng(1))
    poses = poses[:16]
    joints, groups = machine.inverse(poses), ((0,), (1,))
    work = poses_in(machine.limits(), Region(), 20)
    first, second = np.arange(8), np.arange(8, 16)
    # stations and machine, and lines' shading left out of it as calibrations do
    bare = replace(
        rig,
        shading=1e-7,
        instruments=tuple(
            replace(one, pools=tuple(pool._replace(shading=0.0) for pool in one.pools))
            for one in rig.instruments
        ),
    )
    everything = information_of(bare, Candidates.of_all(groups, joints, poses), work)
    one = np.concatenate([first, 16 + first])
    two = np.concatenate([second, 16 + second])
    direct = everything.tool(everything.covariance(everything.of(np.concatenate([one, two]))))

    pairs = np.concatenate([all_pairs([s], first) for s in (0, 1)])
    data = bare.measured(joints, poses, pairs)
    start = start_state(machine, data, rig.T_station_base)
    estimate = bundle(machine, replace(data, shaded=False), start, scale_noise=False)
    n = len(machine.values)
    reference_values = CalibrationPrior(
        estimate.joint_covariance[: n + 12, : n + 12], (0, 1), np.zeros((2, 4, 4))
    )
    later = information_of(bare, Candidates.of_all(groups, joints, poses), work, reference_values)
    in_turn = later.tool(later.covariance(later.of(two)))
    np.testing.assert_allclose(in_turn, direct, rtol=0.02)
    shifted = reference_values.only(())
    anew = information_of(bare, Candidates.of_all(groups, joints, poses), work, shifted)
    assert anew.tool(anew.covariance(anew.of(two)))[0] > in_turn[0]


# ------------------------------------------------------------------ places


def test_places_stand_apart_and_better_one_alone():
    few_stations = replace(FEW_CANDIDATES, poses_a_ring=6, for_stations=8)
    results = small(hexapod(1), few_stations, free_stations=2)
    chosen = [tried for tried in results.tried if tried.chosen]
    eyes = np.array([tried.place.position for tried in chosen])
    middle = results.subject.rig.machine.home()[:3, 3]
    ways = (eyes - middle) / np.linalg.norm(eyes - middle, axis=1, keepdims=True)
    assert len(chosen) == 2
    assert abs(ways[0] @ ways[1]) < 0.9  # not along one line
    assert results.promised.position < min(tried.alone for tried in results.tried)


def test_a_board_is_seen_from_its_face_only():
    machine = load_mechanism("h4")
    board = board_for(machine, "platform")
    subject = of_machine(machine, [camera_of_size(SIZE)], machine.joint_names, board=board)
    (one,) = subject.rig.instruments
    assert isinstance(one, BoardFrom)
    home = machine.home()[None]
    at = At(machine, machine.inverse(home), home)
    assert len(one.measure(at, np.arange(1), None)) == 1
    turned = one.T_body_board @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert len(replace(one, T_body_board=turned).measure(at, np.arange(1), None)) == 0
    in_a_row = one.points[:1] + np.linspace(0, 0.05, 20)[:, None] * [1.0, 0.0, 0.0]
    assert len(replace(one, points=in_a_row).measure(at, np.arange(1), None)) == 0


# ------------------------------------------------------------------ the way


@given(st.integers(2, 7), st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_the_way_is_nearly_the_shortest(n, seed):
    joints = np.random.default_rng(seed).random((n, 3))
    apart = motor_distances(joints, np.tile([0.0, 1.0], (3, 1)))
    first = np.abs(joints - 0.5).max(axis=1)
    path = shortest_path(apart, first)
    assert sorted(path) == list(range(n))
    least = min(length(np.array(order), apart, first) for order in itertools.permutations(range(n)))
    assert length(path, apart, first) <= 1.15 * least


def test_barred_steps_are_avoided():
    joints = np.arange(6.0)[:, None]
    apart = motor_distances(joints, np.array([[0.0, 5.0]]))
    barred = np.zeros((6, 6), dtype=bool)
    barred[2, 3] = barred[3, 2] = True
    path = shortest_path(apart, None, barred)
    assert not barred[path[:-1], path[1:]].any()


# ------------------------------------------------------------------ the command


def test_a_session_planned_and_planned_again(demo, quick_plans, tmp_path, monkeypatch):
    measured: list[FirstEdges] = []

    def once(*inputs):
        measured[:] = measured or [first_edges(*inputs)]
        return measured[0]

    # the edges' accuracy in the same images, for all three plans
    monkeypatch.setattr("pkmcal.planning.subject.first_edges", once)
    session = tmp_path / "session"
    shutil.copytree(demo.session, session)
    (session / "truth.json").unlink()
    result = run("plan", str(session), "-n", "4")
    assert result.code == 0, result.out + result.err
    values = json.loads((session / "plan" / "plan.json").read_text())
    assert_keys("plan.json", values)
    table = read_csv(session / "plan" / "plan.csv")
    loaded = load_session(session)
    assert len(table.names) == 12
    assert list(table.columns) == loaded.document["joints"]["columns"]
    assert not set(table.names) & set(loaded.configurations)
    assert "The accuracy of edges is measured in 12 of the images" in (
        result.out + result.err
    ).replace("\n  ", " ")
    np.testing.assert_allclose(
        table.values, [c["joints"] for c in values["configurations"]], atol=1e-6
    )
    document = page_document((session / "plan" / "plan.html").read_text())
    sections = [section["name"] for section in document["sections"]]
    assert sections.index("curve") < sections.index("where") < sections.index("order")
    (curve,) = (plot for plot in page_blocks(document, "plot") if plot["name"] == "curve")
    assert min(len(curve[axis]["ticks"]) for axis in "xy") >= 3
    (stage,) = page_blocks(document, "space", "where")
    assert [pose["label"] for pose in stage["poses"]] == list(table.names)
    assert sum(len(points["points"]) for points in stage["points"]) == len(table.names)
    # with a calibration beside it, what is known counts
    shutil.copytree(demo.calibration, session / "calibration")
    after = run("plan", str(session), "-n", "4", "-o", str(tmp_path / "after"))
    assert after.code == 0, after.err
    later = json.loads((tmp_path / "after" / "plan.json").read_text())
    assert later["now"]["position"] < 0.2 * values["now"]["position"]
    assert later["promised"]["position"] < values["promised"]["position"]
    still = run("plan", str(session), "-n", "4", "--same-place", "-o", str(tmp_path / "still"))
    retained = json.loads((tmp_path / "still" / "plan.json").read_text())
    assert still.code == 0
    assert retained["promised"]["position"] < later["promised"]["position"]


def test_a_session_before_any_image(demo, quick_plans, tmp_path):
    session = tmp_path / "session"
    shutil.copytree(demo.session, session, ignore=shutil.ignore_patterns("images", "truth.json"))
    (session / "joints.csv").unlink()
    result = run("plan", str(session), "-n", "3", "--best-of", "2", "--json")
    assert result.code == 0, result.out + result.err
    values = result.json
    assert sum(place["chosen"] for place in values["places_tried"]) == 2
    assert "no image determines it yet" in values["assumptions"][0]
    assert (session / "plan" / "stations.yaml").is_file()
    # and calibrate still needs images
    assert run("calibrate", str(session)).code == 2


def test_a_plan_in_the_units_and_steps_of_the_readings(demo, quick_plans, tmp_path):
    session = tmp_path / "session"
    shutil.copytree(demo.session, session, ignore=shutil.ignore_patterns("images", "truth.json"))
    document = yaml.safe_load((session / "session.yaml").read_text())
    document["joints"]["noise"] = 7e-6
    (session / "session.yaml").write_text(yaml.safe_dump(document))
    table = read_csv(session / "joints.csv")
    hundredths = np.round(1e5 * table.values) / 100
    (session / "joints.csv").write_text(
        csv_text([f"{name} [mm]" for name in table.columns], table.names, hundredths)
    )
    assert run("plan", str(session), "-n", "3").code == 0
    text = (session / "plan" / "plan.csv").read_text()
    assert text.startswith("configuration,leg1 [mm],leg2 [mm],leg3 [mm]")
    planned = read_csv(session / "plan" / "plan.csv")
    steps = 1e5 * planned.values
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    # its rehearsal has its names, its noise and its configurations
    rehearsal = rehearsal_of(session / "plan")
    loaded = load_session_to_plan(session)
    assert rehearsal.requested.names == planned.names
    assert rehearsal.requested.stations == loaded.station_names
    assert (rehearsal.joint_noise, rehearsal.observe) == (7e-6, ("legs",))
    np.testing.assert_allclose(rehearsal.requested.joints, planned.values, atol=1e-9)


def test_a_rehearsal_leaves_out_what_the_true_machine_cannot_take():
    machine = load_mechanism("gough-stewart")
    cameras = (camera_of_size(SIZE),)
    truth = draw_truth(machine, cameras, Settings(stations=1, configurations=4), 0)
    joints = np.concatenate([truth.joints[:1], [[9.0] + [0.5] * 5], truth.joints[1:]])
    pairs = np.stack([np.zeros(5, dtype=int), np.arange(5)], axis=-1)
    requested = RequestedConfigurations(tuple("abcde"), joints, ("front",), pairs)
    drawn = draw_truth(machine, cameras, Settings(stations=1, requested=requested), 0)
    assert (drawn.stations, drawn.configurations) == (("front",), tuple("acde"))
    assert drawn.unreachable == ("b",)
    assert drawn.images.tolist() == [[0, 0], [0, 1], [0, 2], [0, 3]]
    assert len(drawn.readings) == len(drawn.T_base_platform) == 4


def test_a_session_without_places(demo, quick_plans, tmp_path):
    session = tmp_path / "session"
    shutil.copytree(demo.session, session, ignore=shutil.ignore_patterns("images", "truth.json"))
    text = (session / "session.yaml").read_text()
    head, _, rest = text.partition("    pose:")
    (session / "session.yaml").write_text(head + rest[rest.index("  station2") :])
    result = run("plan", str(session))
    assert result.code == 2
    assert "the pose of station station1 is not determined" in (result.out + result.err).replace(
        "\n", " "
    )


def test_steps_and_play_of_readings_count_as_noise(planned):
    """A step is uniformly distributed, play half of it to either side; commands are steps."""
    coarse = hexapod(joint_noise=3e-6, reading_resolution=1e-4, play=5e-5)
    sigma = np.sqrt(3e-6**2 + 1e-4**2 / 12 + 5e-5**2 / 4)
    np.testing.assert_allclose(coarse.rig.joint_noise, sigma, rtol=1e-12)
    assert len(coarse.words) == len(hexapod().words) + 1  # play is an offset from one side
    by_steps = small(coarse)
    steps = by_steps.joints / 1e-4
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert by_steps.promised.position > planned.promised.position


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["gough-stewart", "-n", "1"], "--configurations: this number cannot be used"),
        (["gough-stewart", "--after", "x"], "this option is for a session"),
        (["gough-stewart", "--tracker", "far"], "this tracker noise cannot be used"),
        (["gough-stewart", "--tracker", "2e-5", "--places", "2"], "no camera whose place"),
        (["gough-stewart", "--edge-noise", "0"], "over 0 to 100"),
        (["gough-stewart", "--joint-noise", "2"], "--joint-noise: this number cannot be used"),
        (["gough-stewart", "--play", "1 deg"], "--play"),
        (["h4"], "no leg of the nominal model has visible cylinders"),
        (["nothing-like-it"], "nothing-like-it"),
    ],
)
def test_what_cannot_be_planned(options, sentence, quick_plans, tmp_path):
    result = run("plan", *options, "-o", str(tmp_path / "out"))
    assert result.code == 2
    assert sentence in " ".join((result.out + result.err).split())
    assert not (tmp_path / "out").exists()


def test_a_camera_that_sees_nothing():
    subject = hexapod(1)
    (one,) = subject.rig.instruments
    away = np.diag([1.0, -1.0, -1.0, 1.0]) @ one.T_camera_base  # directed away from the machine
    rig = replace(
        subject.rig,
        T_station_base=away[None],
        instruments=(replace(one, T_camera_base=away),),
    )
    with raises(
        InputError, code="station.sees_too_little", found="no leg, or board, in the picture"
    ):
        small(replace(subject, rig=rig))


def test_two_images_of_each_configuration_by_hand():
    """Each image has its own place; the plan is better than chance, and is what it promises."""
    subject = replace(hexapod(1), localized=1.0)
    plan = small(subject)
    assert len(plan.names) == 5
    assert plan.stations == tuple((f"{name}-1", f"{name}-2") for name in plan.names)
    rig = plan.subject.rig
    assert rig.names == tuple(image for images in plan.stations for image in images)
    assert plan.promised.position < plan.by_chance.position < plan.now.position
    assert len({tuple(T[:3, 3].round(6)) for T in rig.T_station_base}) > 5
    fewer = small(replace(subject, localized=0.5))
    assert plan.promised.position < fewer.promised.position < 2 * plan.promised.position


def test_what_an_image_determines_by_itself():
    subject = hexapod(1)
    machine = subject.rig.machine
    poses, joints = draw_configurations(machine, 4, 0.5, np.random.default_rng(0))
    work = poses_in(machine.limits(), Region(), 10, 0)
    info = information_of(subject.rig, Candidates.of_all(((0,),), joints, poses), work)
    alone, half = info.alone(1.0), info.alone(0.5)
    none = alone.covariance(alone.information)
    for k in range(4):
        one = np.array([k])
        expected = info.covariance(info.of(one))
        np.testing.assert_allclose(alone.covariance(alone.of(one)), expected, atol=1e-6)
        assert np.trace(expected) < np.trace(half.covariance(half.of(one))) < np.trace(none)


def test_a_hand_held_session_is_planned_and_rehearsed(demo, quick_plans, tmp_path):
    session = tmp_path / "session"
    shutil.copytree(demo.session, session, ignore=shutil.ignore_patterns("images", "truth.json"))
    document = yaml.safe_load((session / "session.yaml").read_text())
    (camera,) = {station["camera"] for station in document["stations"].values()}
    document["stations"] = {
        "phone": {
            "camera": camera, "images": "images/{configuration}-{repeat}.jpg", "observe": "legs",
            "handheld": True,
        }
    }  # fmt: skip
    (session / "session.yaml").write_text(yaml.safe_dump(document))
    result = run("plan", str(session), "-n", "3", "--json")
    assert result.code == 0, result.out + result.err
    assert result.json["handheld"]
    assert [one["stations"] for one in result.json["configurations"]] == [
        [f"{one['name']}-1", f"{one['name']}-2"] for one in result.json["configurations"]
    ]
    rehearsal = rehearsal_of(session / "plan")
    settings = Settings(stations=rehearsal.places, requested=rehearsal.requested, handheld=True)
    truth = draw_truth(rehearsal.machine, rehearsal.cameras, settings, 0)
    assert truth.stations == tuple(f"phone-{image}" for image in rehearsal.requested.stations)
    assert len(truth.focal_scale) == 6


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_promise_is_kept_by_images(seed, tmp_path):
    """A few images, the plan made from them, its images, and the accuracy from calibrate."""
    few, whole = tmp_path / "few", tmp_path / "whole"
    size = ["--size", "640x480", "--seed", str(seed)]
    assert run("simulate", str(few), "--configurations", "4", *size).code == 0
    assert run("plan", str(few), "-n", "8").code == 0
    # by the same seed it is the same machine in the same room, its cameras set up once more
    made = run("simulate", str(whole), "--plan", str(few / "plan"), "--seed", str(seed))
    assert made.code == 0, made.err
    out = tmp_path / "out"
    assert run("calibrate", str(whole), "-o", str(out)).code == 0
    saved, values = load(out), json.loads((few / "plan" / "plan.json").read_text())
    work = poses_in(saved.machine.limits(), Region(), PLAN.work_poses, 0)
    stated = float(saved.tool_error(work).position.mean())
    assert values["promised"]["position"] == pytest.approx(stated, rel=0.15)
