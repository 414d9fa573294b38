"""The servoing loop in simulation, its ends, and the analysis of visibility."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.cameras import camera_models
from pkmcal.control.analysis import Visibility, matrix_at, visibility
from pkmcal.control.image import Eye, edge_responses
from pkmcal.control.laws import limited
from pkmcal.control.machine_view import machine_view, true_edges
from pkmcal.control.sentences import judgement
from pkmcal.control.simulation import (
    End,
    LoopSettings,
    loop_factor,
    one_image,
    platform_joints,
    simulate_servo_runs,
)
from pkmcal.control.study import (
    Plan,
    Plant,
    Uncertainty,
    check_loop,
    check_pose,
    estimates,
    study_servoing,
)
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, inverse, perturb
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.placement.configurations import draw_configurations
from pkmcal.placement.default_camera import default_camera
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.placement.stations import default_stations

QUIET = EdgeNoise(0.0, 0.0)
CLEAN = LoopSettings(noise=QUIET, joint_noise=0.0, rate=10.0, delay=0, duration=8.0)


def mirror():
    parameters = np.array([160.0, 160.0, 319.5, 239.5, 1.0, 0, 0, 0, 0])
    return camera_models()["unified"]((640, 480), parameters)


def eye_of(camera, name: str = "gough-stewart", legs=None) -> Eye:
    machine = load_mechanism(name)
    place = default_stations(machine, (camera,), np.random.default_rng(3))[0]
    numbers = None if legs is None else np.array(legs)
    return Eye.of(machine_view(machine, place.T_camera_base(), numbers), camera)


@pytest.fixture(scope="module")
def eye() -> Eye:
    return eye_of(default_camera())


def ways_of(eye: Eye, n: int):
    """Starts and goals with readings in the middle three fifths of their ranges."""
    machine = eye.true.machine
    low, high = machine.joint_ranges.T
    poses, joints = draw_configurations(machine, 40 * n, 0.0, np.random.default_rng(5))
    good = np.all(np.abs(joints - (low + high) / 2) < 0.3 * (high - low), axis=-1)
    return poses[good][:n], poses[good][n : 2 * n]


def by_hand(eye: Eye, position: float, degrees: float, runs: int):
    none = Uncertainty(np.zeros((len(eye.true.theta),) * 2), np.zeros(3), np.zeros(3))
    rng = np.random.default_rng(6)
    values = estimates(eye.true, eye.true.theta, none, runs, rng, position, np.deg2rad(degrees))
    return values[3].view


# ------------------------------------------------------------------ the camera


@pytest.mark.parametrize("camera", [default_camera(), mirror()], ids=["pinhole", "mirror"])
def test_noise_is_that_of_simulated_edges(camera):
    """The same shift and tilt give the same covariance as the edges of whole sessions have."""
    eye = eye_of(camera)
    poses, joints = (x[:1] for x in draw_configurations(eye.true.machine, 4, 0.0,
                                                        np.random.default_rng(1)))  # fmt: skip
    T = eye.true.T_camera_base
    edges, _ = simulate_edges(
        eye.true.machine, T[None], camera, poses, EdgeNoise(0.1, 0.1), np.random.default_rng(0)
    )
    points = eye.points(poses, joints, 24)
    by_shift, by_tilt, _ = edge_responses(points)
    parts = 0.1 * np.stack([by_shift, by_tilt], axis=-1)
    own = np.linalg.det(parts @ np.swapaxes(parts, -1, -2))[0]
    checked = 0
    for e in range(len(edges)):
        whole = edges.span[e, 1] - edges.span[e, 0]
        same = (eye.tubes.leg == edges.leg[e]) & (eye.tubes.tube == edges.tube[e])
        row = np.flatnonzero(same & (eye.tubes.side == edges.side[e]))
        if not row.size or whole < 0.95 * (eye.tubes.stop - eye.tubes.start)[row[0]] - 0.012:
            continue  # another tube, or a stretch that is hidden in part
        # areas of the error ellipses, which no choice of the basis changes
        assert own[row[0]] == pytest.approx(np.linalg.det(edges.covariance[e]), rel=0.15)
        checked += 1
    assert checked >= 4


def test_measured_normals_are_true_ones_without_noise(eye):
    poses, _ = ways_of(eye, 3)
    joints = eye.true.machine.inverse(poses)
    measured = eye.normals(eye.points(poses, joints), QUIET, np.random.default_rng(0))
    np.testing.assert_allclose(measured, true_edges(eye.true, poses), atol=1e-12)


def test_noise_has_the_size_that_was_asked_for(eye):
    poses = np.repeat(ways_of(eye, 1)[0], 400, axis=0)
    points = eye.points(poses, eye.true.machine.inverse(poses))
    off = eye.normals(points, EdgeNoise(0.1, 0.0), np.random.default_rng(0))
    off = (off - true_edges(eye.true, poses)).reshape(400, -1, 1, 3)
    pixels = np.sum(points.by_normal() * off, axis=-1)
    assert np.std(pixels) == pytest.approx(0.1, rel=0.05)
    assert np.abs(pixels - pixels.mean(axis=-1, keepdims=True)).max() < 0.01


# ------------------------------------------------------------------ runs that arrive


@pytest.mark.parametrize(
    ("camera", "law"),
    [(default_camera(), "directions"), (mirror(), "edges")],
    ids=["pinhole", "mirror"],
)
def test_true_geometry_arrives_exponentially(camera, law):
    eye = eye_of(camera)
    starts, goals = ways_of(eye, 4)
    runs = simulate_servo_runs(
        eye, eye.true, starts, goals, replace(CLEAN, law=law), np.random.default_rng(0)
    )
    assert set(runs.end) == {End.REACHED}
    assert runs.past.max() < 0.02
    # (1 - gain / rate) a sample, near the goal where the law is linear
    late = runs.error[:, 60] / runs.error[:, 40]
    np.testing.assert_allclose(late, 0.9**20, rtol=0.1)


def test_wrong_geometry_changes_the_way_and_not_the_end(eye):
    starts, goals = ways_of(eye, 6)
    loop = replace(CLEAN, rate=4.0, duration=16.0)
    runs = simulate_servo_runs(
        eye, by_hand(eye, 0.03, 3, 6), starts, goals, loop, np.random.default_rng(0)
    )
    assert set(runs.end) == {End.REACHED}
    assert runs.travel[:, -1].max() < 1e-6
    exact = simulate_servo_runs(eye, eye.true, starts, goals, loop, np.random.default_rng(0))
    assert np.abs(runs.travel - exact.travel).max() > 1e-3


def test_large_rotation_errors_break_it(eye):
    starts, goals = ways_of(eye, 8)
    loop = replace(CLEAN, law="directions")
    reached = [
        simulate_servo_runs(eye, by_hand(eye, 0.0, deg, 8), starts, goals, loop,
                 np.random.default_rng(0)).reached.sum()
        for deg in (10, 60)
    ]  # fmt: skip
    assert reached[0] == 8
    assert reached[1] < 4


def test_runs_do_not_depend_on_each_other(eye):
    starts, goals = ways_of(eye, 3)
    rng = np.random.default_rng
    together = simulate_servo_runs(eye, eye.true, starts, goals, CLEAN, rng(0))
    alone = simulate_servo_runs(eye, eye.true, starts[1:2], goals[1:2], CLEAN, rng(0))
    np.testing.assert_allclose(together.T_base_platform[1], alone.T_base_platform[0], atol=1e-9)


def test_delay_and_rate_limit(eye):
    starts, goals = ways_of(eye, 3)
    loop = replace(CLEAN, delay=3, duration=2.0, speed=np.array([0.01]))
    runs = simulate_servo_runs(eye, eye.true, starts, goals, loop, np.random.default_rng(0))
    still = np.abs(runs.readings[:, :4] - runs.readings[:, :1])
    assert still.max() == 0.0  # nothing moves before the first answer
    fastest = np.abs(np.diff(runs.readings, axis=1)).max() * loop.rate
    assert fastest == pytest.approx(0.01, rel=1e-6)
    assert set(runs.end) == {End.SLOW}


def test_limits_keep_the_direction():
    speeds = np.array([[0.1, -0.4], [0.01, 0.02]])
    np.testing.assert_allclose(limited(speeds, np.array([0.2, 0.2])), [[0.05, -0.2], [0.01, 0.02]])
    assert limited(speeds, None) is speeds


# ------------------------------------------------------------------ standing still


@pytest.mark.parametrize("delay", [pytest.param(0, marks=pytest.mark.slow), 2])
def test_predicted_stillness_is_what_the_loop_does(eye, delay):
    goals = np.repeat(ways_of(eye, 1)[1], 32, axis=0)
    noise = EdgeNoise(0.05, 0.05)
    loop = LoopSettings(
        noise=noise, joint_noise=0.0, rate=10.0, gain=2.0, delay=delay, duration=25.0
    )
    runs = simulate_servo_runs(eye, eye.true, goals, goals, loop, np.random.default_rng(0))
    measured = np.sqrt(np.mean(runs.travel[:, 30:] ** 2))
    joints = eye.true.machine.inverse(goals)
    rng = np.random.default_rng(1)
    still = one_image(eye, eye.true, "edges", goals, joints, noise, rng).held(0.2, delay)
    assert measured == pytest.approx(np.sqrt(np.mean(still.joints**2)), rel=0.12)


def test_loop_factor():
    assert loop_factor(0.04, 0) == pytest.approx(np.sqrt(0.04 / 1.96))
    assert loop_factor(2.1, 0) == float("inf")
    # one sample of delay is unstable from 1 on
    assert np.isfinite(loop_factor(0.99, 1))
    assert loop_factor(1.01, 1) == float("inf")


def test_edges_hold_steadier_than_directions(eye):
    goals = ways_of(eye, 6)[1]
    joints, rng = eye.true.machine.inverse(goals), np.random.default_rng(1)
    noise = EdgeNoise(0.02, 0.02)
    of = {law: one_image(eye, eye.true, law, goals, joints, noise, rng)
          for law in ("edges", "directions")}  # fmt: skip
    assert np.mean(of["directions"].position) > 4 * np.mean(of["edges"].position)
    assert np.mean(of["directions"].turn) > 4 * np.mean(of["edges"].turn)


def test_unstable_loops_are_refused():
    check_loop(LoopSettings(gain=5.0, rate=25.0, delay=3))
    with raises(InputError, where="--gain") as caught:
        check_loop(LoopSettings(gain=12.0, rate=25.0, delay=3))
    assert caught.value.expected.startswith("less than 11.1/s")


# ------------------------------------------------------------------ runs that fail


def test_leaving_the_workspace(eye):
    """The way of the image is no straight line of the readings; by a wrong camera still less."""
    starts, goals = ways_of(eye, 8)
    runs = simulate_servo_runs(
        eye, by_hand(eye, 0.0, 70, 8), starts, goals, CLEAN, np.random.default_rng(0)
    )
    remainder = [k for k, end in enumerate(runs.end) if end is End.OUTSIDE_WORKSPACE]
    assert remainder
    low, high = eye.true.machine.joint_ranges.T
    assert np.all((runs.readings >= low - 1e-9) & (runs.readings <= high + 1e-9))
    k = remainder[0]
    stopped = runs.readings[k, runs.last[k] :]
    np.testing.assert_array_equal(stopped, np.broadcast_to(stopped[0], stopped.shape))
    assert "end of its range" in End.OUTSIDE_WORKSPACE.sentence


def turned_home(machine, angle: float):
    return perturb(machine.home(), np.array([0, 0, angle, 0, 0, 0]))[None]


def wide() -> Eye:
    """The hexapod without limits, so that a turn may go through a singular pose."""
    eye = eye_of(default_camera())
    document = eye.true.machine.document
    legs = tuple(
        leg.model_copy(update={"length": leg.length.model_copy(update={"range": (0.1, 2.0)})})
        for leg in document.legs
    )
    machine = replace(eye.true.machine, document=document.model_copy(update={"legs": legs}))
    return replace(eye, true=replace(eye.true, machine=machine))


def test_coming_to_a_singular_pose():
    eye = wide()
    machine = eye.true.machine
    start = turned_home(machine, 0.0)
    angles = np.linspace(0.0, 2.0, 200)
    turned = np.concatenate([turned_home(machine, a) for a in angles])
    weak = machine.forward_result(machine.inverse(turned), turned).singularity
    first = int(np.argmax(weak < NEAR_SINGULAR / 2))
    goal = turned[first : first + 1]
    assert machine.same_assembly(start[0], goal[0])
    runs = simulate_servo_runs(eye, eye.true, start, goal, CLEAN, np.random.default_rng(0))
    assert runs.end == (End.SINGULAR,)
    assert runs.last[0] > 3
    assert "singular pose" in End.SINGULAR.sentence


def test_wrong_assembly_as_start():
    eye = wide()
    machine = eye.true.machine
    goal = turned_home(machine, 0.0)
    readings = machine.inverse(goal)[0]
    modes = machine.assembly_modes(readings, np.random.default_rng(0))
    start = next(m for m in modes if not machine.same_assembly(m, goal[0]))
    runs = simulate_servo_runs(eye, eye.true, start[None], goal, CLEAN, np.random.default_rng(0))
    assert runs.end == (End.WRONG_ASSEMBLY,)
    assert runs.last[0] == 0
    assert "another assembly than the goal" in End.WRONG_ASSEMBLY.sentence


def test_losing_a_leg(eye):
    """The machine is near the image's border, and some paths lead out of it."""
    starts, goals = ways_of(eye, 12)
    parameters = eye.camera.parameters.copy()
    parameters[2] += 250
    offset = replace(eye, camera=replace(eye.camera, parameters=parameters))
    loop = replace(CLEAN, duration=3.0)
    runs = simulate_servo_runs(offset, eye.true, starts, goals, loop, np.random.default_rng(0))
    lost = [k for k, end in enumerate(runs.end) if end is End.LOST_LEG and runs.last[k] > 0]
    assert lost
    assert len(lost) < 12
    k = lost[0]
    points = offset.points(runs.T_base_platform[k, -1:], runs.readings[k, -1:])
    assert not offset.in_view(points).all()
    assert "left the camera's view" in End.LOST_LEG.sentence


def test_noise_that_keeps_the_goal_away(eye):
    eye = Eye.of(eye.true.only(np.array([0, 2, 4])), eye.camera)
    starts, goals = ways_of(eye, 6)
    loop = LoopSettings(law="directions", rate=10.0, duration=6.0, noise=EdgeNoise(0.3, 0.3))
    runs = simulate_servo_runs(eye, eye.true, starts, goals, loop, np.random.default_rng(0))
    assert not runs.reached.any()


def test_every_end_has_a_sentence():
    words = [end.word for end in End]
    assert len(set(words)) == len(words)
    for end in End:
        assert end.sentence.endswith(".")
        assert end.good == (end is End.REACHED)
        assert end.good or end.help


# ------------------------------------------------------------------ analysis


def test_visibility_of_few_legs(eye):
    poses = draw_configurations(eye.true.machine, 20, 0.2, np.random.default_rng(2))[0][:20]
    matrix = matrix_at(eye.true, "directions", poses)
    every, three = Visibility.of(matrix), Visibility.of(matrix[:, [0, 2, 4]])
    assert every.worst > 0.2
    assert not every.blind
    assert not every.fading
    assert three.fading
    assert not three.blind
    assert three.worst < every.worst / 50
    # two rows a leg: two legs cannot show six freedoms
    assert Visibility.of(matrix[:, :2]).blind
    assert visibility(matrix[:, :2]).max() < 1e-9


def test_directions_of_parallel_sliders_are_blind():
    machine = load_mechanism("hexaglide")
    case = replace(
        eye_of(default_camera()).true, machine=machine, legs=np.arange(6), radius=np.full(6, 0.004)
    )
    poses = draw_configurations(machine, 5, 0.2, np.random.default_rng(2))[0][:5]
    assert visibility(matrix_at(case, "directions", poses)).max() < 1e-6
    assert visibility(matrix_at(case, "edges", poses)).min() > 1e-4


# ------------------------------------------------------------------ estimates and studies


def test_estimates_have_the_errors_asked_for(eye):
    table = eye.true.machine.parameters
    sigma = np.where(np.array(table.units) == "m", 6e-5, 0.0)
    unsure = Uncertainty(np.diag(sigma**2), np.full(3, 1e-4), np.full(3, 2e-4))
    nominal = eye.true.theta + 1e-3 * np.sin(np.arange(len(sigma)))
    rng = np.random.default_rng(0)
    true, identified, cad, hand = estimates(eye.true, nominal, unsure, 300, rng, 0.05, 0.1)
    assert np.all(true.view.theta == eye.true.theta)
    off = identified.view.theta - eye.true.theta
    np.testing.assert_allclose(off.std(axis=0), sigma, rtol=0.2)
    np.testing.assert_allclose(cad.view.theta, nominal)
    # eq. 15: the nominal model fits the identified base centres as well as possible
    index = [table.names.index(f"legs[{j}].base.center.{x}") for j in range(1, 7) for x in "xyz"]
    a = [apply(e.view.T_camera_base[:, None], e.view.theta[..., index].reshape(-1, 6, 3))
         for e in (identified, cad)]  # fmt: skip
    gap = a[1] - a[0]
    assert np.abs(gap.mean(axis=1)).max() < 1e-12
    assert np.sqrt(np.mean(gap**2)) < 1.2e-3
    place = inverse(hand.view.T_camera_base)
    exact = inverse(estimates(eye.true, nominal, unsure, 2, rng, 0.0, 0.0)[3].view.T_camera_base)
    np.testing.assert_allclose(
        np.linalg.norm(place[:, :3, 3] - exact[0, :3, 3], axis=-1), 0.05, atol=1e-9
    )
    cosine = (np.trace(place[:, :3, :3] @ exact[0, :3, :3].T, axis1=1, axis2=2) - 1) / 2
    np.testing.assert_allclose(np.arccos(cosine), 0.1, atol=1e-6)


def scene_of(eye: Eye, legs=None) -> Plant:
    n = len(eye.true.theta)
    unsure = Uncertainty(1e-9 * np.eye(n), np.full(3, 3e-4), np.full(3, 2e-4))
    machine = eye.true.machine
    return Plant(machine, machine.values, unsure, eye.camera, eye.true.T_camera_base, legs)


SHORT = replace(CLEAN, rate=4.0, duration=8.0)


def test_a_study_that_is_well(eye):
    results = study_servoing(scene_of(eye), Plan(SHORT, runs=6))
    assert [o.reached for o in results.outcomes] == [6, 6, 6, 6]
    words = judgement(results)
    assert words.usable
    assert "6 of 6 runs" in words.headline
    assert not words.reasons
    settled = results.trials("identified").settling
    assert np.all(np.abs(settled - np.log(50)) < 1.0)


def test_how_far_a_platform_leaves_its_way(eye):
    """Hand-measured poses are millimetres off the path, which neither its end nor the time shows;
    and zero by definition with the true geometry.
    """
    value = study_servoing(scene_of(eye), Plan(SHORT, runs=6))
    true, identified, _, hand = (o.astray for o in value.outcomes)
    assert true.max() == 0
    assert 1e-3 < np.median(hand) < 10e-3
    assert np.median(identified) < np.median(hand) / 10
    # of a run by itself: the farthest of its samples from all of the true one's
    runs, ideal = (value.trials(name).runs.T_base_platform[0] for name in ("hand", "true"))
    machine = eye.true.machine
    here, there = (platform_joints(machine, T) for T in (runs, ideal))
    nearest = [min(np.sqrt(np.mean(np.sum((p - q) ** 2, axis=-1))) for q in there) for p in here]
    assert hand[0] == pytest.approx(max(nearest), rel=1e-12)
    assert judgement(value).of("servo.by_hand_astray")


def test_the_seed_decides(eye):
    legs = (0, 2, 3, 4)
    loop = replace(SHORT, duration=1.0, noise=EdgeNoise(0.1, 0.1))
    ways = [
        study_servoing(scene_of(eye, legs), Plan(loop, runs=2, seed=seed)).outcomes[1].runs.travel
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(ways[0], ways[1])
    assert np.abs(ways[0] - ways[2]).max() > 1e-3


def test_three_legs_are_warned_of(eye):
    value = study_servoing(scene_of(eye, (0, 1, 2)), Plan(replace(SHORT, law="directions"), runs=8))
    words = judgement(value)
    assert not words.usable
    assert "legs 1 to 3 should not be used" in words.headline
    assert words.of("servo.fading")


def test_two_legs_are_blind(eye):
    value = study_servoing(scene_of(eye, (0, 3)), Plan(replace(SHORT, law="directions"), runs=2))
    words = judgement(value)
    assert not words.usable
    assert "do not show every motion" in words.headline
    assert words.of("servo.blind")


def test_poses_that_cannot_be_are_refused(eye):
    machine = eye.true.machine
    check_pose(machine, machine.home(), "--start")
    high = perturb(machine.home(), np.array([0, 0, 0, 0, 0, 0.2]))
    with raises(InputError, code="pose.outside_workspace", where="--goal"):
        check_pose(machine, high, "--goal")
    rps = load_mechanism("3-rps")
    offset = perturb(rps.home(), np.array([0, 0, 0, 0.03, 0, 0]))
    with raises(InputError, code="pose.not_admissible", where="--start"):
        check_pose(rps, offset, "--start")


def test_a_camera_that_sees_too_little_is_refused(eye):
    parameters = eye.camera.parameters.copy()
    parameters[:2] *= 4
    scene = replace(scene_of(eye), camera=replace(eye.camera, parameters=parameters))
    with raises(InputError, code="station.sees_too_little", expected="6"):
        study_servoing(scene, Plan(SHORT, runs=3))


def test_platform_joints_are_the_machines(eye):
    poses, _ = ways_of(eye, 2)
    machine = eye.true.machine
    expected = apply(poses[:, None], machine.platform_centers())
    np.testing.assert_allclose(platform_joints(machine, poses), expected, atol=1e-12)
