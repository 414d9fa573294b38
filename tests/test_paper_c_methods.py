"""[C]'s estimators at measured poses, on any machine: Jacobians, ranks, recovery, the axis test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import inverse, perturb, pose, pose_difference, rotation
from pkmcal.identify.bundle import bundle
from pkmcal.identify.hand_eye import start_from_poses
from pkmcal.identify.measured_platform import measured_platform, taken
from pkmcal.identify.methods.inverse_kinematic import (
    inverse_kinematic,
    pose_problem,
    turn_between,
)
from pkmcal.identify.rotation_axis import (
    MOST_TURN_PAIRS,
    _pairs,
    axis_frames,
    facing,
    rotation_axis,
)
from pkmcal.measurements import Mount, PoseSet
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.document import MOTION_DIRECTIONS
from pkmcal.papers.paper_c import Deviations, H4ByBoard, at_poses, model, start
from pkmcal.studies.simulated import measurements
from test_hand_eye import anywhere, measured, platform_poses, simulated_poses, true_machine

H = 1e-6
QUIET = H4ByBoard(turn=1e-9, shift=1e-9, joint_noise=1e-9)


# ------------------------------------------------------------------ the pose from the board


def test_the_platform_from_the_board():
    """[C] eq. 6 and its derivatives, against differences."""
    rng = np.random.default_rng(0)
    camera, board, mount = (anywhere(rng, 1.0) for _ in range(3))
    values = measured_platform(camera, board, mount)
    np.testing.assert_allclose(camera @ values.pose @ mount, board, atol=1e-12)

    def slope(of):
        return np.stack([pose_difference(of(H * e), values.pose) / H for e in np.eye(6)], -1)

    np.testing.assert_allclose(
        values.by_station,
        slope(lambda d: measured_platform(inverse(perturb(inverse(camera), d)), board, mount).pose),
        atol=1e-5,
    )
    np.testing.assert_allclose(
        values.by_mount,
        slope(lambda d: measured_platform(camera, board, perturb(mount, d)).pose),
        atol=1e-5,
    )
    np.testing.assert_allclose(
        values.by_measured,
        slope(lambda d: measured_platform(camera, perturb(board, d), mount).pose),
        atol=1e-5,
    )


@pytest.mark.parametrize("name", MOTION_DIRECTIONS)
@pytest.mark.parametrize("tilt", [0.0, 1e-7, 0.3])
def test_what_a_machine_can_take_of_a_pose(name, tilt):
    rng = np.random.default_rng(1)
    motion = MOTION_DIRECTIONS[name]
    own = perturb(np.eye(4), rng.normal(size=6) @ motion @ motion.T)
    whole = perturb(own, tilt * rng.normal(size=6))
    value = taken(motion, whole)
    can = motion.any(axis=1)
    assert value.off.shape == (6 - motion.shape[1],)
    if not tilt:
        np.testing.assert_allclose(value.pose, own, atol=1e-12)
        np.testing.assert_allclose(value.off, 0, atol=1e-12)
    assert np.abs(pose_difference(value.pose, np.eye(4))[~can]).max(initial=0) < 1e-12
    for e in np.eye(6):
        shifted = taken(motion, perturb(whole, H * e))
        by = pose_difference(shifted.pose, value.pose) / H
        np.testing.assert_allclose(value.by @ e, by, atol=1e-5)
        np.testing.assert_allclose(value.off_by @ e, (shifted.off - value.off) / H, atol=1e-5)


def test_turns_between_directions():
    rng = np.random.default_rng(0)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 20, 3)))
    np.testing.assert_allclose((turn_between(a, b) @ a[..., None])[..., 0], b, atol=1e-12)
    np.testing.assert_allclose(turn_between(a, a), np.broadcast_to(np.eye(3), (20, 3, 3)))
    np.testing.assert_allclose(facing(a)[..., 2], a)
    np.testing.assert_allclose(np.linalg.det(facing(a)), 1)


# ------------------------------------------------------------------ the rows


def session(name, rng, chosen=None, noise=1.0):
    """Nominal model, truth and measurements of a machine with one board."""
    nominal = load_mechanism(name, model=chosen)
    truth = true_machine(nominal, rng, shift=5e-4, turn=2e-3)
    body, joints = platform_poses(truth, rng, 40)
    data = measured(simulated_poses(anywhere(rng, 1.0), body, anywhere(rng, 0.05), rng), joints)
    exact = data.poses.T_station_target if noise else None
    return nominal, truth, data, exact


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("gough-stewart", "joint"),
        ("gough-stewart", "implicit"),
        ("3-rps", "implicit"),
        ("3-rpr", "joint"),
        ("constant-legs", "implicit"),
        ("h4", "joint"),
        ("h4", "implicit"),
        ("h4-rods", "implicit"),
        ("delta", "joint"),
        ("linear-delta", "implicit"),
    ],
)
def test_jacobians(name, form):
    """Exact derivatives, against central differences, off the solution."""
    rng = np.random.default_rng(3)
    nominal, _, data, _ = session(name, rng)
    start = start_from_poses(nominal, data)
    in_view, joints = data.poses.T_station_target, data.joints[data.poses.configuration]
    problem, state = pose_problem(nominal, data, in_view[None], joints[None], start, form)
    rows = problem.layout.n_equations + 6 - problem.layout.motion.shape[1]
    problem = replace(problem, weigh=np.eye(rows)[None, None])
    linear = problem.linearize(state)
    n, own = problem.keep.size, state.internal.shape[-1]
    for k in range(n + own):
        step, inner = np.zeros((1, n)), np.zeros((1, 1, own))
        (step[0] if k < n else inner[0, 0])[k if k < n else k - n] = H
        plus = problem.residuals(problem.retract(state, step, inner)).value
        minus = problem.residuals(problem.retract(state, -step, -inner)).value
        wanted = linear.by_shared[..., k] if k < n else linear.by_own[..., k - n]
        np.testing.assert_allclose((plus - minus) / (2 * H), wanted, atol=2e-6)


def test_whitened_rows_have_unit_variance():
    """Rows at the truth, whitened by the noise."""
    truth = H4ByBoard().simulated("calibration", 30, np.random.default_rng(0))
    machine, n = truth.machine, truth.count
    problem, state = pose_problem(
        machine,
        measurements(truth),
        truth.T_camera_board[:, :n],
        truth.joints[:, :n],
        replace_start(machine, truth),
        "implicit",
    )
    z = (truth.theta - machine.parameters.nominal) @ np.linalg.pinv(problem.free).T
    state = state._replace(z=z)
    noise = np.broadcast_to(np.diag(truth.noise.pose**2), (n, 6, 6))
    whitened = replace(problem, weigh=problem.whitening(state, noise, truth.noise.reading))
    rows = whitened.residuals(state).value.reshape(-1, 6)
    covariance = rows.T @ rows / len(rows)
    assert np.abs(covariance - np.eye(6)).max() < 5 * np.sqrt(2 / len(rows))


def replace_start(machine, truth):
    """State with the true poses of camera and board, to evaluate rows, not to estimate."""
    from pkmcal.identify.state import State

    return State(
        machine.parameters.nominal,
        truth.view.T_camera_base,
        np.zeros((0, 4, 4)),
        T_mount=truth.view.T_platform_board[None],
        on_platform=np.ones(1, dtype=bool),
    )


# ------------------------------------------------------------------ the estimates


@pytest.mark.parametrize("whitened", [False, True])
@pytest.mark.parametrize("form", ["joint", "implicit"])
@pytest.mark.parametrize("kind", ["design", "calibration"])
def test_without_noise_every_form_finds_the_machine(kind, form, whitened):
    """And the unidentifiable unknowns are those of the errata."""
    truth = QUIET.simulated(kind, 1, np.random.default_rng(2))
    machine = model(kind)
    fit = at_poses(machine, truth, start(machine, truth), form, whitened=whitened)
    state = fit.solution.state
    solved = machine.with_values(fit.problem.theta(state)[0])
    control = truth.count
    poses = solved.forward(truth.joints[0, control:])
    predicted = state.T_camera_base[0, 0] @ poses @ state.T_mount[0, 0]
    off = pose_difference(predicted, truth.T_camera_board[0, control:])
    # as printed the axis was found beforehand, exactly here
    assert np.abs(off).max() < 1e-6
    wanted = {"design": (21, 23), "calibration": (38, 40)}[kind][whitened]
    assert fit.rank == wanted
    assert fit.problem.keep.sum() == (wanted if whitened else wanted - 2)


def test_whitened_is_the_joint_estimate():
    """The two differ by far less than either errs."""
    truth = H4ByBoard().simulated("calibration", 1, np.random.default_rng(4))
    machine, data = model("calibration"), measurements(truth)
    start = start_from_poses(machine, data)
    one = inverse_kinematic(machine, data, start)
    other = bundle(machine, data, start, robust=False, scale_noise=False)
    readings = truth.joints[0, truth.count :]

    def board(theta, state):
        poses = machine.with_values(theta).forward(readings)
        return state.T_camera_base[0] @ poses @ state.T_mount[0]

    off = pose_difference(board(one.theta, one), board(other.machine.values, other.state))
    assert np.abs(off[:, 3:]).max() < 5e-6
    assert np.abs(off[:, :3]).max() < 2e-5


@pytest.mark.parametrize("name", ["gough-stewart", "3-rps", "3-rpr", "delta", "linear-delta", "h4"])
def test_any_machine_with_a_board(name):
    """From the nominal model to the noise: the predicted boards of new configurations."""
    rng = np.random.default_rng(6)
    nominal = load_mechanism(name)
    truth = true_machine(nominal, rng, shift=1e-3, turn=3e-3)
    body, joints = platform_poses(truth, rng, 60)
    camera, mount = anywhere(rng, 1.0), anywhere(rng, 0.05)
    first = simulated_poses(camera, body[:40], mount, rng)
    data = measured(first, joints[:40])
    begin = start_from_poses(nominal, data)
    state = inverse_kinematic(nominal, data, begin)
    solved = nominal.with_values(state.theta)

    def apart(machine, start):
        poses = machine.forward_result(joints[40:]).T_base_platform
        predicted = start.T_camera_base[0] @ poses @ start.T_mount[0]
        off = pose_difference(predicted, camera @ body[40:] @ mount)
        return np.sqrt(np.mean(np.sum(off[:, 3:] ** 2, axis=1)))

    after = apart(solved, state)
    before = apart(nominal, begin)
    assert after < 3e-4
    assert after < before  # of a planar machine, too, though the start takes up most there


def test_rods_by_the_implicit_form_alone():
    truth = H4ByBoard().simulated("rods", 1, np.random.default_rng(1))
    machine, data = model("rods"), measurements(truth)
    with raises(InputError, expected="the implicit form"):
        at_poses(machine, truth, start(machine, truth), "joint", whitened=True)
    state = inverse_kinematic(machine, data, start_from_poses(machine, data))
    readings = truth.joints[0, truth.count :]
    poses = machine.with_values(state.theta).forward(readings)
    predicted = state.T_camera_base[0] @ poses @ state.T_mount[0]
    view, there = truth.view, truth.T_base_platform[0, truth.count :]
    exact = view.T_camera_base @ there @ view.T_platform_board
    off = pose_difference(predicted, exact)
    assert np.sqrt(np.mean(np.sum(off[:, 3:] ** 2, axis=1))) < 3e-4


def test_without_a_board_on_the_platform():
    rng = np.random.default_rng(0)
    machine = load_mechanism("gough-stewart")
    body, joints = platform_poses(machine, rng)
    still = np.broadcast_to(np.eye(4), body.shape)
    poses = simulated_poses(anywhere(rng, 1.0), still, anywhere(rng, 0.1), rng)
    data = measured(poses, joints, mounts=(Mount("board", "base"),))
    start = start_from_poses(machine, data, np.eye(4)[None])
    with raises(InputError, code="method.no_platform_poses", found="none"):
        inverse_kinematic(machine, data, start)


def test_runs_do_not_touch_one_another():
    truth = H4ByBoard().simulated("design", 3, np.random.default_rng(0))
    machine = model("design")
    every = at_poses(machine, truth, start(machine, truth), "implicit", whitened=True)
    names = ("theta", "T_base_platform", "joints", "T_camera_board")
    one = replace(truth, **{name: getattr(truth, name)[2:] for name in names})
    alone = at_poses(machine, one, start(machine, one), "implicit", whitened=True)
    np.testing.assert_allclose(every.solution.cost[2], alone.solution.cost[0], rtol=1e-6)


# ------------------------------------------------------------------ the axis of rotation


def boards(turns, rng, sigma=5e-4):
    """Poses with these rotations, with noise."""
    n = len(turns)
    whiten = np.diag(1 / np.repeat([sigma, 2e-4], 3))
    exact = anywhere(rng, 1.0) @ pose(rotation(turns), rng.normal(size=(n, 3)) * 0.1)
    exact = exact @ anywhere(rng, 0.1)
    visible = perturb(exact, np.repeat([sigma, 2e-4], 3) * rng.normal(size=(n, 6)))
    none = np.zeros(n, dtype=int)
    return PoseSet(none, np.arange(n), none, visible, np.broadcast_to(whiten, (n, 6, 6)))


@pytest.mark.parametrize("n", [0, 1, 2, 3, 40, 700])
def test_pairs_of_many_poses_are_an_even_choice_of_all(n):
    i, j = np.triu_indices(n, 1)
    if len(i) > MOST_TURN_PAIRS:
        pick = np.linspace(0, len(i) - 1, MOST_TURN_PAIRS).astype(int)
        i, j = i[pick], j[pick]
    np.testing.assert_array_equal(_pairs(n), (i, j))


def test_one_axis_is_found_and_tested():
    """chi2 has its mean and scatter; a tilt of the noise's size is found out."""
    z = np.array([0, 0, 1.0])
    ratios, results = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        angles = np.radians(rng.choice([-20.0, 0, 20], 71))[:, None] * z
        axis = rotation_axis(boards(angles, rng), "schoenflies")
        ratios.append(axis.chi2)
        results.append(axis.tenable)
        assert axis.dof == 2 * 71 - 4
        assert axis.spread == pytest.approx(axis.expected_spread, rel=0.25)
        assert axis.expected_spread > np.radians(0.1)
    assert all(results)
    assert np.mean(ratios) == pytest.approx(138, abs=4 * np.sqrt(2 * 138 / 40))
    assert np.std(ratios) == pytest.approx(np.sqrt(2 * 138), rel=0.4)
    rng = np.random.default_rng(0)
    loud = boards(angles, rng)
    optimistic = rotation_axis(replace(loud, whiten=1.25 * loud.whiten), "schoenflies")
    assert optimistic.p_value < 1e-3
    assert optimistic.tenable  # an image's noise is less accurate
    tilted = angles + 8e-4 * rng.normal(size=(71, 3))
    axis = rotation_axis(boards(tilted, rng), "schoenflies")
    assert not axis.tenable
    assert "do not turn about one axis alone" in axis.sentence


def test_the_spread_of_axes_is_that_of_their_noise_at_any_angles():
    """Small turns, whose axes are uncertain, do not decide it."""
    rng, squares = np.random.default_rng(1), []
    for _ in range(40):
        angles = np.radians(rng.uniform(-60, 60, 25))[:, None] * np.array([0, 0, 1.0])
        axis = rotation_axis(boards(angles, rng), "schoenflies")
        squares.append((axis.spread / axis.expected_spread) ** 2)
        assert axis.expected_spread < np.radians(0.2)
    # 48 tilts less the two numbers of the mean axis
    assert np.mean(squares) == pytest.approx(1 - 2 / 48, abs=0.1)


def test_the_axis_in_both_frames():
    rng = np.random.default_rng(3)
    truth = H4ByBoard().simulated("design", 1, rng)
    poses = measurements(truth).poses
    frames = axis_frames(poses.T_station_target[:, :3, :3])
    for own, frame in (
        (frames.camera[:, 2], truth.view.T_camera_base[0, :3, 2]),
        (frames.board[2], truth.view.T_platform_board[2, :3]),
    ):
        assert abs(own @ frame) > np.cos(np.radians(0.1))
    axis = rotation_axis(poses, "schoenflies")
    assert axis.hypothesis == "one axis"


def test_machines_that_should_not_turn_and_those_that_may():
    rng = np.random.default_rng(2)
    still = rotation_axis(boards(np.zeros((30, 3)), rng), "translation")
    assert still.tenable
    assert still.dof == 87
    assert np.isnan(still.spread)
    assert "do not turn" in still.sentence
    turned = rotation_axis(boards(3e-3 * rng.normal(size=(30, 3)), rng), "translation")
    assert not turned.tenable
    assert "should not" in turned.sentence
    free = rotation_axis(boards(0.3 * rng.normal(size=(30, 3)), rng), "spatial")
    assert (free.hypothesis, free.chi2, free.dof, free.p_value) == ("any", 0.0, 0, 1.0)
    assert "nothing to test" in free.sentence


def test_a_machine_with_rods_is_found_out():
    """[C] IV.B: the hypothesis of four freedoms can fail."""
    setting = H4ByBoard(deviations=Deviations(rods=2e-3))
    truth = setting.simulated("rods", 1, np.random.default_rng(0))
    axis = rotation_axis(measurements(truth).poses, "schoenflies")
    assert not axis.tenable
