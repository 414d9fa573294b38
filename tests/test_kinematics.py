"""Closure, inverse and forward kinematics: identities, exact derivatives, singular poses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faults import raises
from pkmcal.errors import GeometryError, InputError
from pkmcal.files import parse_yaml, validated_document
from pkmcal.geometry.rigid import perturb, pose, rotation, rotation_vector
from pkmcal.mechanisms import (
    MechanismDocument,
    catalogue,
    kinematics,
    load_mechanism,
    machine_from_document,
)
from pkmcal.mechanisms.carriers.contract import base_carriers
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.mechanisms.kinematics import CONVERGED_CLOSURE_ERROR, NEAR_SINGULAR

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=4, deadline=None)


def machine_of(motion, legs, more=""):
    """A machine with spherical joints; legs are (A, B, length) as YAML."""
    text = f"name: made\nmotion: {motion}\n{more}legs:\n" + "".join(
        f"  - base: {{joint: spherical, center: [{a[0]}, {a[1]}, {a[2]}]}}\n"
        f"    platform: {{joint: spherical, center: [{b[0]}, {b[1]}, {b[2]}]}}\n"
        f"    length: {{{length}}}\n"
        for a, b, length in legs
    )
    return machine_from_document(
        validated_document(parse_yaml(text, Path("m.yaml")), MechanismDocument)
    )


def planar():
    """3-RPR: three legs in a plane, with offsets; turned, as the legs may not meet in a point."""
    return machine_of(
        "planar",
        [
            ((0, 0, 0), (-0.10, -0.06, 0), "actuated: true, offset: 0.01, range: [0.15, 0.6]"),
            ((0.6, 0, 0), (0.11, -0.05, 0), "actuated: true, range: [0.15, 0.6]"),
            ((0.3, 0.52, 0), (0, 0.12, 0), "actuated: true, range: [0.15, 0.6]"),
        ],
        "home: {position: [0.3, 0.18, 0.0], rotation_vector: [0.0, 0.0, 1.3]}\n",
    )


def tripod():
    """A platform that does not turn, on two actuated rods and one of constant length."""
    return machine_of(
        "translation",
        [
            ((0.3, 0, 0), (0.05, 0, 0), "actuated: true, range: [0.3, 0.6]"),
            ((-0.15, 0.26, 0), (-0.025, 0.04, 0), "actuated: false, constant: 0.45"),
            (
                (-0.15, -0.26, 0),
                (-0.025, -0.04, 0),
                "actuated: true, offset: -0.02, range: [0.3, 0.6]",
            ),
        ],
    )


def hexapod():
    """A Gough-Stewart platform of exact threefold symmetry, for exactly singular poses."""
    legs = []
    for corner in (0, 120, 240):
        for side in (1, -1):
            a, b = math.radians(corner + 4.25 * side), math.radians(corner + 54 * side)
            legs.append(
                (
                    (0.27 * math.cos(a), 0.27 * math.sin(a), 0.0),
                    (0.195 * math.cos(b), 0.195 * math.sin(b), 0.0),
                    "actuated: true, range: [0.345, 0.485]",
                )
            )
    return machine_of("spatial", legs)


def yawed(degrees, height=0.36):
    """The hexapod's platform turned about the vertical; at 90 degrees it is singular (Fichter)."""
    return pose(rotation(np.array([0, 0, math.radians(degrees)])), np.array([0, 0, height]))


MACHINES = {name: lambda name=name: load_mechanism(name) for name in catalogue()}
SMALL = {"planar": planar, "tripod": tripod, "hexapod": hexapod}


@pytest.fixture(params=[*MACHINES, *SMALL], scope="module")
def machine(request):
    return {**MACHINES, **SMALL}[request.param]()


def workspace(machine, count, seed):
    """Poses about home whose readings are in range, spread over the motion's freedoms."""
    rng = np.random.default_rng(seed)
    low, high = machine.joint_ranges.T
    size = np.sqrt(np.mean(np.sum(np.var(machine.base_centers(), axis=0))))
    spread = np.repeat([0.5, 0.3 * size], 3)
    tries = 100 * count + 1000
    if machine.layout.n_internal:
        # bars that only theta turns; from a tilt one comes to assemblies that home is not in
        spread[:2], spread[2:3], spread[3:], tries = 0.0, 0.35, 0.1, 4 * count
    freedoms = machine.layout.motion
    retained_rows = np.zeros((0, 4, 4))
    while len(retained_rows) < count:
        assert tries > 0
        steps = rng.uniform(-1, 1, (2 * count, 6)) * spread
        tries -= len(steps)
        poses = perturb(machine.home(), steps @ freedoms @ freedoms.T)
        # only poses that the constant rods and the axes allow
        value = kinematics.on_manifold(machine.layout, machine.values, poses)
        poses = value.T_base_platform[value.converged]
        readings = machine.inverse(poses)
        allowed = ~((readings < low) | (readings > high)).any(axis=-1)
        retained_rows = np.concatenate([retained_rows, poses[allowed]])
    return retained_rows[:count]


@given(seeds)
@few
def test_forward_undoes_inverse(machine, seed):
    """Over the workspace, from home: readings lead back to their pose.

    Closed to 1e-12 m with a singularity above 0.1, so the pose is right to 1e-11.
    """
    poses = workspace(machine, 40, seed)
    readings = machine.inverse(poses)
    fk = machine.forward_result(readings)
    assert fk.converged.all()
    assert fk.singularity.min() > 0.1
    np.testing.assert_allclose(fk.T_base_platform, poses, atol=1e-11)
    np.testing.assert_allclose(
        machine.inverse(fk.T_base_platform), readings, atol=CONVERGED_CLOSURE_ERROR
    )


def joint_distances(machine, T):
    """Length of every rod between fixed points, from the file's fields and with math alone."""
    lengths = []
    for leg in machine.to_document()["legs"]:
        p = leg["platform"]["center"]
        b = [sum(T[i][k] * p[k] for k in range(3)) + T[i][3] for i in range(3)]
        lengths.append(math.dist(b, leg["base"]["center"]))
    return lengths


def test_readings_are_the_distance_of_the_joints_less_the_offset(machine):
    """[B] eq. 4, against the file's own numbers."""
    if any(base_carriers()[leg.base.joint].driven for leg in machine.document.legs):
        pytest.skip("the other carriers have their derivatives' test")
    rng = np.random.default_rng(1)
    changed = machine.with_values(machine.values + 0.01 * rng.normal(size=len(machine.values)))
    for T in workspace(machine, 5, 2):
        lengths = joint_distances(changed, T)
        expected = [
            (length - leg["length"]["offset"]) / leg["scale"]
            for length, leg in zip(lengths, changed.to_document()["legs"], strict=True)
            if leg["length"].get("actuated")
        ]
        np.testing.assert_allclose(changed.inverse(T), expected, atol=1e-15)


# Derivatives

STENCIL = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))


def differences(function, count, step):
    """Sixth-order central differences of function(delta (count, count)), row by row, at zero."""
    by = step * np.eye(count)
    rows = sum(w * (function(i * by) - function(-i * by)) for i, w in STENCIL) / step
    return np.moveaxis(rows, 0, -1)


def assert_exact_derivatives(machine, readings, T, step=1e-3):
    """All three Jacobians of the closure against differences; a step leaves a few 1e-16 of the
    lengths over the step by rounding, and less by truncation."""
    layout, theta = machine.layout, machine.values
    c = closure(layout, theta, readings, T)
    tight = {"rtol": 0, "atol": 2e-15 * max(1.0, c.rows.distance.max()) / step}
    np.testing.assert_allclose(
        c.rows.by_pose,
        differences(lambda d: closure(layout, theta, readings, perturb(T, d)).rows.value, 6, step),
        **tight,
    )
    np.testing.assert_allclose(
        dense(c, len(theta)),
        differences(lambda d: closure(layout, theta + d, readings, T).rows.value, len(theta), step),
        **tight,
    )
    oracle = differences(
        lambda d: closure(layout, theta, readings + d, T).rows.value, machine.n_joints, step
    )
    values = np.zeros(oracle.shape)
    values[layout.driven_rows, layout.row_motor[layout.driven_rows]] = c.by_reading[
        layout.driven_rows
    ]
    np.testing.assert_allclose(values, oracle, **tight)


def test_closure_derivatives_at_home_and_at_random(machine):
    rng = np.random.default_rng(4)
    home = machine.home()
    assert_exact_derivatives(machine, machine.inverse(home), home)
    for T in workspace(machine, 4, 5):
        changed = machine.with_values(machine.values + 0.01 * rng.normal(size=len(machine.values)))
        readings = machine.inverse(T) + 0.01 * rng.normal(size=machine.n_joints)
        assert_exact_derivatives(changed, readings, T)


@pytest.mark.parametrize("degrees", [89.0, 90.0, -90.0])
def test_closure_derivatives_at_singular_poses(degrees):
    machine = hexapod()
    assert_exact_derivatives(machine, machine.inverse(yawed(degrees)), yawed(degrees))


def test_closure_derivatives_of_a_leg_of_a_millimetre():
    """Near A = B the direction turns quickly; there is nothing special but the step's size."""
    machine = hexapod()
    values = machine.values.copy()
    T = yawed(10)
    values[:3] = T[:3, :3] @ machine.platform_centers()[0] + T[:3, 3] + [6e-4, -6e-4, 5e-4]
    assert_exact_derivatives(machine.with_values(values), machine.inverse(T), T, step=5e-6)


# Singular poses


def scaled_inverse_jacobian(machine, T):
    """From readings alone: motions of 1 m, and turns that move the platform's joints by 1 m."""
    centres = machine.platform_centers()
    radius = np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1)))
    by_pose = differences(lambda d: machine.inverse(perturb(T, d)), 6, 1e-3)
    return by_pose / np.array([radius] * 3 + [1.0] * 3)


@pytest.mark.parametrize("degrees", [0, 60, 89, 91])
def test_singularity_is_the_least_gain_from_platform_to_readings(degrees):
    machine, T = hexapod(), yawed(degrees)
    least = np.linalg.svd(scaled_inverse_jacobian(machine, T), compute_uv=False)[-1]
    fk = machine.forward_result(machine.inverse(T), T).singularity
    assert fk == pytest.approx(least, rel=1e-8)


@pytest.mark.parametrize("degrees", [90, -90])
@pytest.mark.parametrize("height", [0.2, 0.36])
def test_a_quarter_turn_is_singular_at_any_height(degrees, height):
    """Fichter's singularity: all six legs belong to one linear complex about the vertical."""
    machine, T = hexapod(), yawed(degrees, height)
    # rounding of the file's centres, 1e-17, over the platform's size
    assert machine.forward_result(machine.inverse(T), T).singularity < 1e-14


def test_nearness_to_a_singular_pose_is_reported():
    """The singular value falls as the cosine of the yaw, so a tenth of a degree has a tenth."""
    machine = hexapod()
    near = [
        float(machine.forward_result(machine.inverse(T), T).singularity)
        for T in map(yawed, (0, 80, 89, 89.9))
    ]
    assert near[0] > 0.8
    assert near[1] > NEAR_SINGULAR > near[2]
    assert near[3] == pytest.approx(near[2] / 10, rel=0.01)


@pytest.mark.parametrize("short", [1.0, 0.1, 1e-2, 1e-4, 0.0])
def test_forward_near_a_singular_pose_is_honest(short):
    """Two solutions merge; either closes the machine, and is reported as uncertain."""
    machine, T = hexapod(), yawed(90 - short)
    readings = machine.inverse(T)
    steps = 0.02 * np.random.default_rng(0).normal(size=(30, 6))
    fk = machine.forward_result(readings, perturb(T, steps))
    assert fk.converged.any()
    assert np.all(fk.singularity < NEAR_SINGULAR)
    closed = np.abs(machine.inverse(fk.T_base_platform) - readings).max(axis=-1)
    np.testing.assert_array_equal(fk.converged, fk.error < CONVERGED_CLOSURE_ERROR)
    np.testing.assert_allclose(fk.error, closed, atol=1e-15)
    # the two yaws that belong to these readings are 90 -+ short; where they merge, an error of
    # 1e-12 m in the readings is one of its root in the pose
    yaws = np.degrees(rotation_vector(fk.T_base_platform[:, :3, :3])[fk.converged, 2])
    np.testing.assert_allclose(np.abs(yaws - 90), short, atol=1e-3)


def test_beyond_the_singular_pose_there_is_no_pose():
    """The legs' differences are largest at 90 degrees of yaw; more of it cannot be closed."""
    machine, T = hexapod(), yawed(90)
    longest = machine.inverse(T)
    outward = np.sign(longest - machine.inverse(yawed(60)))
    for more in (1e-4, 1e-8):
        readings = longest + more * outward
        fk = machine.forward_result(readings, yawed(89))
        assert not fk.converged
        assert more / 10 < fk.error < more
        with pytest.raises(GeometryError):
            machine.forward(readings, yawed(89))


# Assembly modes


def assert_modes(machine, readings, modes):
    """Every mode closes every rod, and no two are the same."""
    for T in modes:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
    lengths = np.array([joint_distances(machine, T) for T in modes])
    driven = machine.layout.actuated >= 0
    offsets = machine.values[machine.layout.rod[driven]]
    wanted = np.tile(readings + offsets, (len(modes), 1))
    np.testing.assert_allclose(lengths[:, driven], wanted, atol=CONVERGED_CLOSURE_ERROR)
    gaps = np.abs(modes[:, None] - modes[None, :]).max(axis=(-1, -2)) + np.eye(len(modes))
    assert gaps.min() > 1e-3


def among(T, modes):
    return np.min(np.abs(modes - T).max(axis=(-1, -2))) < 1e-9


@pytest.mark.parametrize("seed", [0, 1])
def test_assembly_modes_of_a_hexapod(seed):
    """Several, with home, and with every mode its mirror image in the base's plane: both base
    and platform are flat, so a reflection leaves all lengths alone."""
    machine = hexapod()
    for T in (machine.home(), workspace(machine, 1, seed)[0]):
        readings = machine.inverse(T)
        modes = machine.assembly_modes(readings, np.random.default_rng(seed))
        assert len(modes) >= 4
        assert_modes(machine, readings, modes)
        assert among(T, modes)
        flip = np.diag([1.0, 1.0, -1.0, 1.0])
        assert all(among(flip @ mode @ flip, modes) for mode in modes)


@pytest.mark.parametrize("seed", range(4))
def test_assembly_modes_of_the_planar_machine_with_six(seed):
    """The 3-RPR of Gosselin, Sefrioui and Richard (1992), whose six real solutions are known to
    be all that such a machine can have (lengths here in hundredths)."""
    side, turn = 0.2084, 0.8822
    legs = [
        ((0, 0, 0), (0, 0, 0)),
        ((0.1591, 0, 0), (0.1704, 0, 0)),
        ((0, 0.1, 0), (side * math.cos(turn), side * math.sin(turn), 0)),
    ]
    rod = "actuated: true, range: [0.05, 0.25]"
    machine = machine_of("planar", [(*leg, rod) for leg in legs])
    readings = np.array([0.1498, 0.1538, 0.12])
    modes = machine.assembly_modes(readings, np.random.default_rng(seed))
    assert len(modes) == 6
    assert_modes(machine, readings, modes)


def test_assembly_modes_of_a_tripod_are_home_and_its_mirror_image():
    machine = tripod()
    home = machine.home()
    modes = machine.assembly_modes(machine.inverse(home), np.random.default_rng(0))
    assert len(modes) == 2
    assert_modes(machine, machine.inverse(home), modes)
    assert among(home, modes)
    assert among(home * np.array([1, 1, -1, 1])[:, None] + np.diag([0, 0, 2, 0]), modes)


def test_the_files_home_decides_the_assembly():
    low = machine_of(
        "translation",
        [
            ((0.3, 0, 0), (0, 0, 0), "actuated: true"),
            ((-0.2, 0.2, 0), (0, 0, 0), "actuated: true"),
            ((-0.2, -0.2, 0), (0, 0, 0), "actuated: true"),
        ],
        "home: {position: [0.0, 0.0, -0.3]}\n",
    )
    below = pose(np.eye(3), np.array([0.02, 0.01, -0.4]))
    np.testing.assert_allclose(low.forward(low.inverse(below)), below, atol=1e-12)


# Restricted motions


def test_a_planar_machine_stays_in_its_plane():
    machine = planar()
    truth = workspace(machine, 50, 0)
    assert np.ptp(rotation_vector(truth[:, :3, :3])[:, 2]) > 0.5
    # readings in error, so that the solver has every reason to leave the plane
    readings = machine.inverse(truth) + 1e-3 * np.random.default_rng(1).normal(size=(50, 3))
    forward_kinematics = machine.forward(readings)
    np.testing.assert_array_equal(forward_kinematics[:, 2], np.tile([0, 0, 1, 0], (50, 1)))
    np.testing.assert_array_equal(forward_kinematics[:, :2, 2], 0)
    np.testing.assert_allclose(
        machine.inverse(forward_kinematics), readings, atol=CONVERGED_CLOSURE_ERROR
    )


def test_a_translational_machine_does_not_turn_and_its_rods_keep_their_length():
    machine = tripod()
    readings = machine.inverse(workspace(machine, 50, 0))
    readings += 1e-3 * np.random.default_rng(1).normal(size=readings.shape)
    forward_kinematics = machine.forward(readings)
    np.testing.assert_array_equal(forward_kinematics[:, :3, :3], np.tile(np.eye(3), (50, 1, 1)))
    lengths = np.array([joint_distances(machine, T) for T in forward_kinematics])
    np.testing.assert_allclose(lengths[:, 1], 0.45, atol=CONVERGED_CLOSURE_ERROR)
    np.testing.assert_allclose(
        lengths[:, [0, 2]] - [0, -0.02], readings, atol=CONVERGED_CLOSURE_ERROR
    )


# Batches


def test_a_batch_is_the_same_as_a_loop(machine):
    poses = workspace(machine, 12, 7)
    readings = machine.inverse(poses)
    looped = np.stack([machine.inverse(T) for T in poses])
    # several rods a motor are settled by iteration; a rod's reading is one formula
    tight = {"rtol": 0, "atol": 1e-13 if machine.layout.shares_motors else 0.0}
    np.testing.assert_allclose(readings, looped, **tight)
    forward_kinematics = machine.forward(readings)
    # rows differ by the rounding of batched matrix products only
    np.testing.assert_allclose(
        forward_kinematics, [machine.forward(q) for q in readings], atol=1e-13
    )
    again = machine.forward(readings.reshape(3, 4, -1), poses.reshape(3, 4, 4, 4)[:, :1])
    np.testing.assert_allclose(again.reshape(12, 4, 4), forward_kinematics, atol=1e-11)


def test_a_hard_row_does_not_disturb_its_neighbours():
    machine = hexapod()
    readings = np.stack([machine.inverse(yawed(10)), [0.4] * 5 + [3.0], machine.inverse(yawed(90))])
    fk = machine.forward_result(readings)
    assert fk.converged.tolist() == [True, False, True]
    alone = machine.forward_result(readings[0])
    np.testing.assert_allclose(fk.T_base_platform[0], alone.T_base_platform, atol=1e-13)
    assert fk.error[1] > 1.0


def test_machines_broadcast_too(machine):
    """A Monte-Carlo batch: theta (R, 1, P) against poses (N, 4, 4)."""
    rng = np.random.default_rng(8)
    poses = workspace(machine, 5, 9)
    theta = machine.values + 1e-3 * rng.normal(size=(3, 1, len(machine.values)))
    if machine.layout.shares_motors:  # a pose of one machine's rods is not another's
        theta = np.broadcast_to(machine.values, theta.shape)
    machines = [machine.with_values(row[0]) for row in theta]
    readings = kinematics.readings_at_poses(machine.layout, theta, poses)
    assert readings.shape == (3, 5, machine.n_joints)
    tight = {"rtol": 0, "atol": 1e-13 if machine.layout.shares_motors else 0.0}
    np.testing.assert_allclose(readings, [m.inverse(poses) for m in machines], **tight)
    fk = kinematics.forward(machine.layout, theta, readings, poses)
    assert fk.T_base_platform.shape == (3, 5, 4, 4)
    assert fk.converged.shape == fk.error.shape == fk.singularity.shape == (3, 5)
    assert fk.converged.all()
    looped = [m.forward_result(q, poses) for m, q in zip(machines, readings, strict=True)]
    for name in ("T_base_platform", "error", "singularity"):
        expected = np.stack([getattr(result, name) for result in looped])
        np.testing.assert_allclose(getattr(fk, name), expected, atol=1e-12)


# Errors


def test_readings_out_of_reach():
    """Five legs of 0.4 m hold the platform so near that the sixth cannot be 3 m long."""
    far = [0.4] * 5 + [3.0]
    found = "closure error 1.71e+03 mm"
    with raises(GeometryError, code="readings.unreachable", found=found) as caught:
        hexapod().forward([[0.4] * 6, far, far])
    assert "2 of 3 configurations, first at row 1" in caught.value.what


def test_wrong_shapes_and_numbers():
    machine = hexapod()
    with raises(InputError, found="(4, 5)", expected="(n, 6)") as caught:
        machine.forward(np.ones((4, 5)))
    assert caught.value.what.startswith("joints ")
    with raises(InputError, found="(3, 4)", expected="(n, 4, 4)") as caught:
        machine.inverse(np.ones((3, 4)))
    assert caught.value.what.startswith("T_base_platform ")
    with raises(InputError, code="array.not_finite") as caught:
        machine.forward([0.4] * 5 + [np.nan])
    assert caught.value.what.startswith("joints ")


def test_a_machine_without_a_way_to_its_home():
    legs = [((math.cos(a), math.sin(a), 0), (0, 0, 0), "actuated: true") for a in (0, 2, 4)]
    expected = "length.range on each actuated leg, or home: {position: [x, y, z]}"
    with raises(InputError, expected=expected):
        machine_of("translation", legs).home()


def test_a_machine_that_cannot_be_assembled():
    """Two feet 2 m apart, a point platform, and legs of a tenth of a metre."""
    legs = [((x, 0, 0), (0, 0, 0), "actuated: true, range: [0.1, 0.11]") for x in (-1, 1)]
    legs.append(((0, 1, 0), (0, 0, 0), "actuated: true, range: [0.1, 0.11]"))
    with raises(GeometryError, code="mechanism.not_assembled"):
        machine_of("translation", legs).home()
