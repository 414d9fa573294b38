"""Interaction matrices and laws of control by the legs, [B] 4-9 with the errata."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.control.laws import (
    CONTROL_LAWS,
    direction_interaction,
    edge_interaction,
    joint_velocities,
    law_named,
    rates,
    solution,
    task_of,
)
from pkmcal.control.machine_view import (
    MachineView,
    directions_of,
    legs_at,
    legs_from_image,
    machine_view,
    moved_to,
    true_edges,
    twist_change,
)
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, inverse, look_at, perturb, rotation, skew
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.velocities import forward_jacobian, inverse_jacobian
from pkmcal.placement.configurations import draw_configurations

OUTSIDE = look_at(np.array([0.1, -1.2, 0.25]), np.array([0, 0, 0.1]), np.array([0, 0, 1.0]))
INSIDE = look_at(np.array([0.01, -0.02, 0.05]), np.array([0, 0, 0.4]), np.array([0, 1.0, 0.0]))
"""A perspective camera's place, and a mirror's between the legs."""
STEP = 1e-6
SMOOTH = 2e-7
"""Central differences with STEP are good to 1e-8 of the third derivatives."""


def before(name: str, T_camera_base=OUTSIDE, legs=None, radius=0.004) -> MachineView:
    machine = load_mechanism(name)
    numbers = np.arange(machine.n_legs) if legs is None else np.array(legs)
    return MachineView(machine, T_camera_base, numbers, np.full(len(numbers), radius))


def poses_of(view: MachineView, n: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    poses, joints = draw_configurations(view.machine, n, 0.5, rng)
    return poses[:n], joints[:n]


def differences(view: MachineView, poses, joints):
    """Rates of normals and directions by each reading, with the platform following exactly."""
    normals, directions = [], []
    for k in range(view.machine.n_joints):
        ends = []
        for sign in (1, -1):
            q = joints + sign * STEP * np.eye(view.machine.n_joints)[k]
            shifted = view.machine.forward_result(q, poses).T_base_platform
            ends.append(true_edges(view, shifted, q))
        normals.append((ends[0] - ends[1]) / (2 * STEP))
        directions.append((directions_of(ends[0]) - directions_of(ends[1])) / (2 * STEP))
    return np.stack(normals, axis=-1), np.stack(directions, axis=-1)


# ------------------------------------------------------------------ interaction matrices


@pytest.mark.parametrize("place", [OUTSIDE, INSIDE], ids=["outside", "inside"])
@pytest.mark.parametrize("name", sorted(catalogue()))
def test_interaction_is_the_derivative_of_what_is_seen(name, place):
    """For every machine: cranks and sliders move A as well, and some twists are forbidden."""
    in_view = before(name, place)
    poses, joints = poses_of(in_view, 3)
    legs = legs_at(in_view, poses)
    twists = forward_jacobian(in_view.machine.layout, in_view.theta, poses)
    by_normal, by_direction = differences(in_view, poses, joints)
    normals = true_edges(in_view, poses)
    values = edge_interaction(in_view, legs, normals) @ twists[:, None, None]
    scale = max(1.0, np.abs(by_normal).max())
    assert np.abs(values - by_normal).max() < SMOOTH * scale
    values = direction_interaction(in_view, legs) @ twists[:, None]
    assert np.abs(values - by_direction).max() < SMOOTH * max(1.0, np.abs(by_direction).max())


def test_interaction_near_a_singular_pose():
    """The platform near a pose where the motors hardly hold it: the twist still determines the
    legs.
    """
    in_view = before("gough-stewart")
    home = in_view.machine.home()
    angles = np.linspace(0, 2.0, 400)
    turned = perturb(home, np.stack([0 * angles, 0 * angles, angles, *np.zeros((3, 400))], -1))
    weak = in_view.machine.forward_result(in_view.machine.inverse(turned), turned).singularity
    pose = turned[int(np.argmin(weak))][None]
    assert weak.min() < 0.01
    legs, normals = legs_at(in_view, pose), true_edges(in_view, pose)
    by_edge, by_u = edge_interaction(in_view, legs, normals), direction_interaction(in_view, legs)
    for k in range(6):
        d = STEP * np.eye(6)[k]
        plus, minus = (true_edges(in_view, perturb(pose, s * d)) for s in (1, -1))
        assert np.abs((plus - minus) / (2 * STEP) - by_edge[..., k]).max() < SMOOTH * 10
        off = (directions_of(plus) - directions_of(minus)) / (2 * STEP) - by_u[..., k]
        assert np.abs(off).max() < SMOOTH * 10


def paper_twist(view: MachineView, pivot):
    """(..., 6, 6): [B]'s twist (velocity, turn) at the camera's centre in the camera frame, from
    the project's at a pivot.
    """
    rot = view.T_camera_base[:3, :3]
    at_camera = twist_change(inverse(view.T_camera_base)[:3, 3] - pivot)
    turned = np.zeros((6, 6))
    turned[:3, 3:], turned[3:, :3] = rot, rot
    return turned @ at_camera


@pytest.mark.parametrize("place", [OUTSIDE, INSIDE], ids=["outside", "inside"])
def test_hexapod_is_equation_9(place):
    """L = (I - u u^T) / q (I, -[A + q u]x) in the camera frame, velocity first."""
    in_view = before("gough-stewart", place)
    poses, _ = poses_of(in_view, 5)
    legs = legs_at(in_view, poses)
    change = paper_twist(in_view, legs.pivot)
    a = apply(in_view.T_camera_base, legs.a)
    u = legs.u @ in_view.T_camera_base[:3, :3].T
    across = np.eye(3) - u[..., :, None] * u[..., None, :]
    lever = np.concatenate(
        [np.broadcast_to(np.eye(3), (*u.shape, 3)), -skew(a + legs.length[..., None] * u)], axis=-1
    )
    paper = across / legs.length[..., None, None] @ lever
    np.testing.assert_allclose(
        direction_interaction(in_view, legs), paper @ change[:, None], atol=1e-13
    )


def test_hexapod_is_equation_7():
    """D has rows (u^T, (A x u)^T) in the camera frame, velocity first."""
    in_view = before("gough-stewart")
    poses, _ = poses_of(in_view, 5)
    legs = legs_at(in_view, poses)
    change = paper_twist(in_view, legs.pivot)
    a = apply(in_view.T_camera_base, legs.a)
    u = legs.u @ in_view.T_camera_base[:3, :3].T
    paper = np.concatenate([u, np.cross(a, u)], axis=-1)
    np.testing.assert_allclose(rates(in_view, legs).readings, paper @ change, atol=1e-13)


def test_fixed_base_is_the_erratas_j():
    """J = -(A x n) n^T / (u . (A x n)) times the direction's matrix."""
    in_view = before("gough-stewart", INSIDE)
    poses, _ = poses_of(in_view, 5)
    legs, n = legs_at(in_view, poses), true_edges(in_view, poses)
    a = apply(in_view.T_camera_base, legs.a)[..., None, :]
    u = (legs.u @ in_view.T_camera_base[:3, :3].T)[..., None, :]
    side = np.cross(a, n)
    J = -side[..., :, None] * n[..., None, :] / np.sum(u * side, axis=-1)[..., None, None]
    by_u = direction_interaction(in_view, legs)[..., None, :, :]
    np.testing.assert_allclose(edge_interaction(in_view, legs, n), J @ by_u, atol=1e-12)


@pytest.mark.parametrize("name", ["gough-stewart", "6-rus", "hexaglide", "3-rps", "h4", "h4-rods"])
def test_rates_agree_with_the_kinematics(name):
    in_view = before(name)
    poses, _ = poses_of(in_view, 4)
    rate = rates(in_view, legs_at(in_view, poses))
    twists = forward_jacobian(in_view.machine.layout, in_view.theta, poses)
    direct = inverse_jacobian(in_view.machine.layout, in_view.theta, poses)
    np.testing.assert_allclose(rate.readings @ twists, direct @ twists, atol=1e-10)
    assert rate.free.shape[-1] == in_view.machine.n_joints
    # the free twists are those that the drives can make
    back = twists @ (rate.readings @ rate.free)
    np.testing.assert_allclose(back, rate.free, atol=1e-9)


def test_matrix_of_each_law_is_the_derivative_of_its_error():
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 4)
    goal = np.roll(true_edges(in_view, poses), 1, axis=0)
    for law, kind in CONTROL_LAWS.items():
        legs = legs_at(in_view, poses)
        task = task_of(law, in_view, true_edges(in_view, poses), goal, legs)
        for k in range(6):
            move = STEP * task.twist[..., k]
            plus, minus = (
                kind.error(true_edges(in_view, perturb(poses, s * move)), goal) for s in (1, -1)
            )
            off = ((plus - minus) / (2 * STEP)).reshape(4, -1) - task.matrix[..., k]
            assert np.abs(off).max() < SMOOTH * 10
    assert joints.shape == (4, 6)


# ------------------------------------------------------------------ what the controller takes


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_image_and_readings_give_the_limbs(name):
    in_view = before(name)
    poses, joints = poses_of(in_view, 4)
    exact = legs_at(in_view, poses)
    value = legs_from_image(in_view, directions_of(true_edges(in_view, poses)), joints)
    for part in ("a", "b", "u"):
        np.testing.assert_allclose(getattr(value, part), getattr(exact, part), atol=1e-9)
    there = moved_to(exact, value.pivot)
    np.testing.assert_allclose(value.rows, there.rows, atol=1e-9)


def test_three_visible_legs_determine_the_hidden_ones():
    in_view = before("gough-stewart", legs=[4, 0, 2])
    assert not in_view.by_image_alone
    poses, joints = poses_of(in_view, 6)
    values = legs_from_image(in_view, directions_of(true_edges(in_view, poses)), joints)
    np.testing.assert_allclose(values.b, legs_at(in_view, poses).b, atol=1e-9)


def test_order_of_the_seen_legs_does_not_matter():
    poses, joints = poses_of(before("gough-stewart"), 3)
    goal = poses[[1, 2, 0]]
    speeds = []
    for legs in ([0, 1, 2, 3, 4, 5], [3, 5, 0, 2, 1, 4]):
        in_view = before("gough-stewart", legs=legs)
        n, wanted = true_edges(in_view, poses), true_edges(in_view, goal)
        speeds.append(joint_velocities("edges", in_view, n, wanted, joints, 1.0))
    np.testing.assert_allclose(*speeds, atol=1e-12)


def test_control_by_image_needs_no_platform():
    """[B]: the law depends on A and the readings only; the platform's centres may be anything."""
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 3)
    n = true_edges(in_view, poses)
    table = in_view.machine.parameters
    wrong = in_view.machine.values.copy()
    wrong[[k for k, name in enumerate(table.names) if ".platform." in name]] += 0.05
    other = replace(in_view, machine=in_view.machine.with_values(wrong))
    for law in CONTROL_LAWS:
        speeds = [joint_velocities(law, s, n, n[[1, 2, 0]], joints, 1.0) for s in (in_view, other)]
        np.testing.assert_allclose(*speeds, atol=1e-13)


# ------------------------------------------------------------------ laws


@pytest.mark.parametrize("law", sorted(CONTROL_LAWS))
@pytest.mark.parametrize(
    "name", ["gough-stewart", "6-rus", "delta", "3-rps", "h4", "constant-legs", "3-rpr"]
)
def test_rates_lead_to_a_goal_nearby(name, law):
    """Velocities of the readings: to first order gain times their difference from the goal's."""
    in_view = before(name)
    poses, joints = poses_of(in_view, 3)
    aim = joints + 1e-5 * np.random.default_rng(1).standard_normal(joints.shape)
    goals = in_view.machine.forward(aim, poses)
    n, wanted = true_edges(in_view, poses), true_edges(in_view, goals, aim)
    speeds = joint_velocities(law, in_view, n, wanted, joints, 2.0)
    np.testing.assert_allclose(speeds, 2.0 * (aim - joints), atol=1e-6)
    at_rest = joint_velocities(law, in_view, wanted, wanted, aim, 2.0)
    assert np.abs(at_rest).max() < 1e-12


@pytest.mark.parametrize("at", ["goal", "mean"])
def test_matrix_at_the_goal(at):
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 3)
    goals, aim = poses[[1, 2, 0]], joints[[1, 2, 0]]
    n, wanted = true_edges(in_view, poses), true_edges(in_view, goals)
    values = joint_velocities("edges", in_view, n, wanted, joints, 1.0, at=at, goal_readings=aim)
    assert np.isfinite(values).all()
    assert np.abs(values - joint_velocities("edges", in_view, n, wanted, joints, 1.0)).max() > 1e-4
    # near the goal all choices agree
    near = perturb(goals, np.full(6, 1e-6))
    q = in_view.machine.inverse(near)
    both = [
        joint_velocities("edges", in_view, true_edges(in_view, near), wanted, q, 1.0, at=place,
                         goal_readings=aim)
        for place in (at, "measured")
    ]  # fmt: skip
    np.testing.assert_allclose(*both, atol=1e-9)
    with raises(InputError, expected="goal_readings, or the interaction as measured"):
        joint_velocities("edges", in_view, n, wanted, joints, 1.0, at=at)


def test_common_shift_of_the_base_changes_nothing_by_directions():
    """Errata: a common translation error of A has no effect with directions; it has with edges."""
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 3)
    n, wanted = true_edges(in_view, poses), true_edges(in_view, poses[[1, 2, 0]])
    T = inverse(in_view.T_camera_base)
    T[:3, 3] += [0.2, -0.1, 0.15]
    shifted = replace(in_view, T_camera_base=inverse(T))
    change = {
        law: np.abs(np.subtract(*(joint_velocities(law, s, n, wanted, joints, 1.0)
                                  for s in (in_view, shifted)))).max()
        for law in CONTROL_LAWS
    }  # fmt: skip
    assert change["directions"] < 1e-13
    assert change["edges"] > 1e-3


def test_batches_are_single_calls_together():
    """Every run has its own values and its own camera."""
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 4)
    n, wanted = true_edges(in_view, poses), true_edges(in_view, poses[::-1])
    rng = np.random.default_rng(3)
    values = in_view.theta + 1e-3 * rng.standard_normal((4, len(in_view.theta)))
    T = in_view.T_camera_base @ perturb(np.eye(4), 0.05 * rng.standard_normal((4, 6)))
    many = replace(in_view, machine=in_view.machine.with_values(values), T_camera_base=T)
    together = joint_velocities("edges", many, n, wanted, joints, 1.0)
    for k in range(4):
        one = replace(in_view, machine=in_view.machine.with_values(values[k]), T_camera_base=T[k])
        alone = joint_velocities("edges", one, n[k], wanted[k], joints[k], 1.0)
        np.testing.assert_allclose(together[k], alone, atol=1e-13)


def test_unseen_motion_stays_at_rest():
    """Sliders that move together keep all directions of a hexaglide: no motion is commanded."""
    in_view = before("hexaglide")
    poses, joints = poses_of(in_view, 3)
    n, wanted = true_edges(in_view, poses), true_edges(in_view, poses[[1, 2, 0]])
    task = task_of("directions", in_view, n, wanted, legs_at(in_view, poses))
    least = np.linalg.svd(task.matrix)[2][:, -1]
    blind = np.sum(solution(task) * least, axis=-1)
    assert np.linalg.svd(task.matrix, compute_uv=False)[:, -1].max() < 1e-9
    assert np.abs(blind).max() < 1e-9
    speeds = joint_velocities("directions", in_view, n, wanted, joints, 1.0)
    assert np.isfinite(speeds).all()


def test_a_lost_edge_gives_no_rates():
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 2)
    n, wanted = true_edges(in_view, poses), true_edges(in_view, poses[::-1])
    n[0, 3, 1] = np.nan
    speeds = joint_velocities("edges", in_view, n, wanted, joints, 1.0)
    assert np.isnan(speeds[0]).all()
    assert np.isfinite(speeds[1]).all()


# ------------------------------------------------------------------ who may be seen


def test_seen_machine_takes_the_longest_tube():
    machine = load_mechanism("gough-stewart")
    view = machine_view(machine, OUTSIDE, np.array([1, 4]))
    assert view.legs.tolist() == [1, 4]
    assert view.radius.tolist() == [0.014, 0.014]
    n = true_edges(view, machine.home()[None])
    a = apply(OUTSIDE, machine.base_centers()[[1, 4]])
    np.testing.assert_allclose(np.sum(n[0] * a[:, None], axis=-1), -0.014, atol=1e-12)


def test_a_camera_inside_a_leg_sees_no_edge():
    in_view = before("gough-stewart", radius=0.02)
    pose = in_view.machine.home()[None]
    ends = legs_at(in_view, pose)
    T = np.eye(4)
    T[:3, 3] = -(ends.a[0, 2] + ends.b[0, 2]) / 2
    n = true_edges(replace(in_view, T_camera_base=T), pose)
    assert np.isnan(n[0, 2]).all()
    assert np.isfinite(n[0, [0, 1, 3, 4, 5]]).all()


@pytest.mark.parametrize(
    ("name", "legs", "found", "expected"),
    [
        ("gough-stewart", [0, 6], "legs 1, 7", "some of 1, 2, 3, 4, 5, 6"),
        ("gough-stewart", [1, 1], "legs 2, 2", "some of 1, 2, 3, 4, 5, 6"),
        ("gough-stewart", [], "none", "some of 1, 2, 3, 4, 5, 6"),
        ("delta", None, "none", "tubes"),
    ],
)
def test_legs_that_cannot_be_seen_are_refused(name, legs, found, expected):
    machine = load_mechanism(name)
    with raises(InputError, found=found, expected=expected):
        machine_view(machine, OUTSIDE, None if legs is None else np.array(legs, dtype=int))


def test_unknown_law():
    with raises(InputError, found="points", expected="edges or directions"):
        law_named("points")


def test_rotation_of_the_base_frame_changes_nothing():
    """The law is the same in every base frame: machine and camera moved together."""
    in_view = before("gough-stewart")
    poses, joints = poses_of(in_view, 2)
    n, wanted = true_edges(in_view, poses), true_edges(in_view, poses[::-1])
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = rotation(np.array([0.3, -0.2, 0.5])), [0.1, 0.2, -0.3]
    legs = in_view.machine.base_centers()
    values = in_view.machine.values.copy()
    names = in_view.machine.parameters.names
    for j, centre in enumerate(apply(E, legs)):
        for k, axis in enumerate("xyz"):
            values[names.index(f"legs[{j + 1}].base.center.{axis}")] = centre[k]
    shifted = replace(
        in_view,
        machine=in_view.machine.with_values(values),
        T_camera_base=in_view.T_camera_base @ inverse(E),
    )
    for law in CONTROL_LAWS:
        speeds = [joint_velocities(law, s, n, wanted, joints, 1.0) for s in (in_view, shifted)]
        np.testing.assert_allclose(*speeds, atol=1e-12)
