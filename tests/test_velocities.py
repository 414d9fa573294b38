"""Velocities and amplification: against differences, at singular poses, and for every machine."""

from __future__ import annotations

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose_difference, skew
from pkmcal.mechanisms import catalogue, kinematics, load_mechanism
from pkmcal.mechanisms.velocities import LEAST_GAIN_FOR_RATES, inverse_jacobian
from test_kinematics import SMALL, differences, hexapod, planar, tripod, yawed

NAMES = sorted(catalogue())


@pytest.fixture(params=[*NAMES, *SMALL], scope="module")
def machine(request):
    return SMALL[request.param]() if request.param in SMALL else load_mechanism(request.param)


def poses_of(machine, count, seed=0):
    """Poses about home that the machine can take, readings within reach."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(-1, 1, (20 * count, 6)) * np.repeat([0.15, 0.03], 3)
    if machine.layout.n_internal:
        steps[:, :2] = 0.0
    freedoms = machine.layout.motion
    poses = perturb(machine.home(), steps @ freedoms @ freedoms.T)
    valid = kinematics.on_manifold(machine.layout, machine.values, poses)
    good = valid.converged & (valid.singularity > 0.1)
    good &= np.isfinite(machine.inverse(valid.T_base_platform)).all(axis=-1)
    assert good.sum() >= count
    return valid.T_base_platform[good][:count]


def test_the_inverse_jacobian_is_the_inverse_kinematics_derivative(machine):
    """Sixth-order differences; cranks near their limit bend as the root does."""
    for T in [machine.home(), *poses_of(machine, 3)]:
        oracle = differences(lambda d, T=T: machine.inverse(perturb(T, d)), 6, 2e-4)
        value = machine.inverse_jacobian(T)
        assert value.shape == (machine.n_joints, 6)
        np.testing.assert_allclose(value, oracle, rtol=1e-8, atol=1e-8 * np.abs(oracle).max())


def test_the_forward_jacobian_is_the_forward_kinematics_derivative(machine):
    for T in [machine.home(), *poses_of(machine, 3, 1)]:
        readings = machine.inverse(T)

        def shifted(d, T=T, readings=readings):
            return pose_difference(machine.forward(readings + d, T), T)

        oracle = differences(shifted, machine.n_joints, 2e-4)
        value = machine.forward_jacobian(T)
        assert value.shape == (6, machine.n_joints)
        np.testing.assert_allclose(value, oracle, rtol=1e-8, atol=1e-8 * np.abs(oracle).max())


def test_the_two_jacobians_undo_each_other(machine):
    """Readings' rates survive; of a machine with six freedoms the twist does too."""
    poses = poses_of(machine, 6, 2)
    there, back = machine.inverse_jacobian(poses), machine.forward_jacobian(poses)
    assert there.shape == (6, machine.n_joints, 6)
    if machine.redundancy:  # rates that no twist gives do not survive; every twist does
        motion = machine.layout.motion
        own = motion.T @ back @ there @ motion
        np.testing.assert_allclose(own, np.broadcast_to(np.eye(2), own.shape), atol=1e-12)
        return
    eye = np.broadcast_to(np.eye(machine.n_joints), (6, machine.n_joints, machine.n_joints))
    np.testing.assert_allclose(there @ back, eye, atol=1e-12)
    if machine.n_joints == 6:
        np.testing.assert_allclose(back @ there, eye, atol=1e-10)


def test_what_no_motor_moves_stays(machine):
    """Every column of the forward Jacobian keeps constant rods, axes and the file's motion."""
    for T in poses_of(machine, 2, 3):
        jac = machine.forward_jacobian(T)
        np.testing.assert_array_equal(jac[~machine.layout.free], 0.0)
        step = 1e-5
        for column in jac.T:
            twist = column / np.abs(column).max()
            offs = []
            for sign in (-1, 1):
                shifted = perturb(T, sign * step * twist)
                c = kinematics.closure_at(machine.layout, machine.values, shifted)
                offs.append(kinematics.undriven(c)[0])
            # a twist that the machine cannot make would leave 1e-5 here
            assert np.abs(np.array(offs)).max(initial=0.0) < 100 * step**2


def test_a_batch_of_machines(machine):
    """Parameters (R, 1, P) against poses (N, 4, 4)."""
    rng = np.random.default_rng(4)
    poses = poses_of(machine, 3, 5)
    theta = machine.values + 1e-4 * rng.normal(size=(2, 1, len(machine.values)))
    if machine.layout.shares_motors:  # a pose of one machine's rods is not another's
        theta = np.broadcast_to(machine.values, theta.shape)
    results = inverse_jacobian(machine.layout, theta, poses)
    looped = [machine.with_values(row[0]).inverse_jacobian(poses) for row in theta]
    np.testing.assert_allclose(results, looped, rtol=1e-10, atol=1e-12)


def test_a_hexapods_rows_are_the_papers():
    """[B] eq. 7 about the base's origin: (u, A x u); here the twist is of the platform's origin and
    begins with the turn: (b x u, u), b the turned joint."""
    machine = hexapod()
    T = perturb(yawed(12), np.array([0.1, -0.2, 0, 0.01, 0.02, 0.03]))
    arms = machine.platform_centers() @ T[:3, :3].T
    u = arms + T[:3, 3] - machine.base_centers()
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    expected = np.concatenate([np.cross(arms, u), u], axis=1)
    np.testing.assert_allclose(machine.inverse_jacobian(T), expected, atol=1e-15)
    paper = np.concatenate([u, np.cross(machine.base_centers(), u)], axis=1)
    # the same motion at the base's origin: v = tau - omega x t
    twist = np.random.default_rng(0).normal(size=6)
    at_base = np.concatenate([twist[3:] - np.cross(twist[:3], T[:3, 3]), twist[:3]])
    np.testing.assert_allclose(paper @ at_base, expected @ twist, atol=1e-14)


# Singular poses


@pytest.mark.parametrize("degrees", [89.0, 89.99])
def test_near_a_singular_pose_the_jacobian_is_still_right(degrees):
    """A tenth of a degree from Fichter's pose: large, and exact to what the pose is."""
    machine, T = hexapod(), yawed(degrees)
    there, back = machine.inverse_jacobian(T), machine.forward_jacobian(T)
    assert np.abs(back).max() > 50
    np.testing.assert_allclose(there @ back, np.eye(6), atol=1e-13 * np.abs(back).max())


def test_at_a_singular_pose_there_is_no_forward_jacobian_and_its_neighbours_keep_theirs():
    machine = hexapod()
    back = machine.forward_jacobian(np.stack([yawed(10), yawed(90), yawed(20)]))
    assert np.isnan(back[1]).all()
    assert np.isfinite(back[[0, 2]]).all()
    assert np.isfinite(machine.inverse_jacobian(yawed(90))).all()
    # just above what counts as lost
    assert np.isfinite(
        machine.forward_jacobian(yawed(90 - np.degrees(10 * LEAST_GAIN_FOR_RATES)))
    ).all()


def test_at_a_serial_singularity_the_twist_determines_no_rate():
    """A slider whose rod stands square to its guide: moving it changes the length by nothing."""
    machine = load_mechanism("linear-delta")
    group = machine.layout.base[0]
    own = group.of(machine.values)[0]
    centre, axis = own[:3], own[3:] / np.linalg.norm(own[3:])
    q = float(machine.joint_ranges[0].mean())
    rod = float(machine.values[machine.layout.rod[0]])
    side = np.cross(axis, [0.3, 0.4, 0.5])
    side /= np.linalg.norm(side)
    b = centre + q * axis + rod * side
    T = machine.home()
    T[:3, 3] = b - T[:3, :3] @ machine.platform_centers()[0]
    shifted = perturb(T, np.concatenate([np.zeros(3), -1e-4 * side]))
    at, near = machine.inverse_jacobian(T)[0], machine.inverse_jacobian(shifted)[0]
    assert np.isnan(at).all() or np.abs(at).max() > 1e6  # rounding decides on which side T lies
    assert np.isfinite(near).all()
    assert np.abs(near).max() > 20
    beyond = perturb(T, np.concatenate([np.zeros(3), 1e-4 * side]))
    assert np.isnan(machine.inverse_jacobian(beyond)[0]).all()


def test_out_of_reach_gives_nothing_and_no_warning():
    machine = load_mechanism("delta")
    far = machine.home()
    far[2, 3] -= 5.0
    assert np.isnan(machine.inverse_jacobian(far)).all()
    assert np.isnan(machine.forward_jacobian(far)).all()
    assert np.isnan(machine.amplification(far).fastest)


def test_a_wrong_shape_is_named():
    with raises(InputError, found="(3, 3)", expected="(n, 4, 4)"):
        hexapod().forward_jacobian(np.eye(3))


# Amplification


def test_amplification_is_the_most_and_least_over_all_directions(machine):
    """Against many random motor rates of length 1, and many wrenches."""
    rng = np.random.default_rng(6)
    T = poses_of(machine, 1, 7)[0]
    point = np.array([0.02, -0.01, 0.03])
    value = machine.amplification(T, point)
    rates = rng.normal(size=(20_000, machine.n_joints))
    rates /= np.linalg.norm(rates, axis=1, keepdims=True)
    twist = rates @ machine.forward_jacobian(T).T
    speed = np.linalg.norm(twist[:, 3:] + np.cross(twist[:, :3], T[:3, :3] @ point), axis=1)
    turning = np.linalg.norm(twist[:, :3], axis=1)
    assert speed.max() <= value.fastest * (1 + 1e-9)
    assert speed.max() > 0.9 * value.fastest
    assert turning.max() <= value.quickest_turn * (1 + 1e-9) + 1e-12
    assert turning.max() >= 0.85 * value.quickest_turn - 1e-12
    if machine.n_joints == machine.layout.free[3:].sum():
        assert speed.min() >= value.slowest * (1 - 1e-9)
        assert speed.min() < 1.3 * value.slowest + 1e-3 * value.fastest
    # the motors' power is the platform's: forces by J^T, about the point
    shift = np.eye(6)
    shift[3:, :3] = -skew(T[:3, :3] @ point)
    at_point = shift @ machine.forward_jacobian(T)
    forces = rng.normal(size=(20_000, 3))
    forces /= np.linalg.norm(forces, axis=1, keepdims=True)
    felt = np.abs(forces @ at_point[3:]).max(axis=0)
    assert np.all(felt <= value.force * (1 + 1e-9))
    assert np.all(felt >= 0.98 * value.force)
    np.testing.assert_allclose(
        value.torque, np.linalg.norm(at_point[:3], axis=0), rtol=1e-12, atol=1e-15
    )
    assert value.condition >= 1


def test_a_machine_of_three_square_guides_amplifies_nothing():
    """Rods so long that each reading is a coordinate: speed 1 in all directions, condition 1."""
    from test_kinematics import machine_of

    rod = "actuated: true, range: [99, 101]"
    legs = [
        ((100, 0, 0), (0, 0, 0), rod),
        ((0, 100, 0), (0, 0, 0), rod),
        ((0, 0, 100), (0, 0, 0), rod),
    ]
    machine = machine_of("translation", legs, "home: {position: [0.0, 0.0, 0.0]}\n")
    values = machine.amplification(machine.home())
    np.testing.assert_allclose([values.fastest, values.slowest, values.condition], 1.0, atol=1e-12)
    np.testing.assert_allclose(values.force, 1.0, atol=1e-12)
    assert values.quickest_turn == values.slowest_turn == 0.0


def test_the_map_grows_without_bound_towards_a_singular_pose():
    machine = hexapod()
    poses = np.stack([yawed(degrees) for degrees in (0, 60, 89, 89.9, 90)])
    values = machine.amplification(poses)
    assert np.all(np.diff(values.condition[:4]) > 0)
    assert values.condition[3] == pytest.approx(10 * values.condition[2], rel=0.02)
    assert np.isnan(values.condition[4])
    assert np.isnan(values.force[4]).all()


def test_small_machines_amplify_in_their_own_freedoms():
    """A planar machine neither lifts nor tilts, a tripod does not turn."""
    flat, three = planar(), tripod()
    value = flat.amplification(flat.home())
    assert value.slowest > 0.1
    assert value.quickest_turn == value.slowest_turn > 0
    assert three.amplification(three.home()).quickest_turn == 0.0
