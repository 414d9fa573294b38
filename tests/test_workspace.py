"""Workspaces: reasons, extents, grids and paths, against geometry that is known otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose, pose_difference, rotation
from pkmcal.mechanisms import catalogue, load_mechanism
from test_kinematics import SMALL, hexapod, machine_of, planar, tripod, yawed

NAMES = sorted(catalogue())


@pytest.fixture(params=[*NAMES, *SMALL], scope="module")
def machine(request):
    return SMALL[request.param]() if request.param in SMALL else load_mechanism(request.param)


def cube():
    """Three rods of 1000 m along the axes: readings are coordinates, 0.1 m to either side."""
    rod = "actuated: true, range: [999.9, 1000.1]"
    legs = [((1000, 0, 0), (0, 0, 0), rod), ((0, 1000, 0), (0, 0, 0), rod)]
    legs.append(((0, 0, 1000), (0, 0, 0), rod))
    return machine_of("translation", legs, "home: {position: [0.0, 0.0, 0.0]}\n")


def shifted(T, *tau):
    return perturb(T, np.array([0, 0, 0, *tau]))


# Reachable poses


def test_home_belongs_to_every_workspace(machine):
    reach = machine.reachable(machine.home())
    assert reach.inside
    assert reach.why() == ()
    np.testing.assert_array_equal(reach.readings, machine.inverse(machine.home()))


def test_poses_of_readings_in_range_are_inside_and_others_are_not(machine):
    """Forward kinematics near home gives the truth; each reading beyond its range is named."""
    rng = np.random.default_rng(0)
    home = machine.inverse(machine.home())
    low, high = machine.joint_ranges.T
    low, high = np.where(np.isfinite(low), low, -np.inf), np.where(np.isfinite(high), high, np.inf)
    near = home + 0.02 * rng.uniform(-1, 1, (40, machine.n_joints))
    near = np.clip(near, low + 1e-9, high - 1e-9)
    poses = machine.forward(near)
    if machine.redundancy:  # readings are not free: those of a pose that there is
        near = machine.inverse(poses)
    value = machine.reachable(poses)
    assert value.inside.all()
    np.testing.assert_allclose(value.readings, near, atol=1e-9)
    if not np.isfinite(low).all():
        return
    for j in range(machine.n_joints):
        for edge, name in ((low[j], "too_short"), (high[j], "too_long")):
            outside = home.copy()
            outside[j] = edge + (1e-4 if name == "too_long" else -1e-4)
            result = machine.forward_result(outside)
            if not result.converged:
                continue
            reach = machine.reachable(result.T_base_platform)
            if reach.lost.any():
                continue
            flags = getattr(reach, name)
            np.testing.assert_array_equal(flags, np.arange(machine.n_joints) == j)
            assert not reach.inside
            assert reach.why()[0].startswith(f"motor {j + 1} would stand at ")


def test_the_reasons_in_words():
    machine = hexapod()
    low = yawed(0, 0.25)
    length = float(machine.inverse(low)[0])  # all six equal
    assert machine.reachable(low).why() == tuple(
        f"motor {j} would stand at {length:.4g} m, below its range, which begins at 0.345 m"
        for j in range(1, 7)
    )
    near = machine.reachable(yawed(89.5, 0.25))
    assert near.singular
    expected = f"the pose is singular or nearly so: {float(near.singularity):.2g}, where at least"
    assert f"{expected} 0.02 is wanted" in near.why()
    beyond = machine.reachable(yawed(120, 0.25))
    assert beyond.crossed
    assert not beyond.singular
    assert "the pose lies beyond a singular one, in another assembly than home" in beyond.why()


def test_each_pose_of_a_batch_has_its_own_reasons():
    machine = hexapod()
    poses = np.stack([[machine.home(), yawed(90, 0.3)], [yawed(120, 0.3), yawed(5)]])
    reach = machine.reachable(poses)
    np.testing.assert_array_equal(reach.inside, [[True, False], [False, True]])
    assert reach.why(0, 0) == ()
    assert any("singular or nearly so" in text for text in reach.why(0, 1))
    assert any("beyond a singular one" in text for text in reach.why(1, 0))


def test_a_crank_that_cannot_reach_is_named():
    machine = load_mechanism("delta")
    reach = machine.reachable(shifted(machine.home(), 0.4, 0, 0))
    assert reach.lost.any()
    assert not reach.inside
    assert not reach.singular  # nothing is known of it
    named = [text for text in reach.why() if text.endswith("cannot reach")]
    assert named == [f"the limb of motor {j + 1} cannot reach" for j in np.flatnonzero(reach.lost)]


def test_a_joint_on_a_joint_is_no_pose_and_no_warning():
    """The rod has no direction there."""
    machine = cube()
    on_it = shifted(machine.home(), 1000, 0, 0)
    reach = machine.reachable(on_it)
    assert reach.singular
    assert reach.too_short[0]


def test_an_h4_of_rods_reads_as_one_of_parallelograms_at_any_turn():
    """Bars that keep their direction close the ideal machine; the other elbow is not taken."""
    rods, ideal = load_mechanism("h4-rods"), load_mechanism("h4")
    turns = np.linspace(-1.6, 1.6, 9)
    poses = np.stack([perturb(ideal.home(), np.array([0, 0, a, 0.02, -0.01, 0.01])) for a in turns])
    np.testing.assert_allclose(rods.inverse(poses), ideal.inverse(poses), atol=1e-14)


def test_what_no_drive_allows_is_reported():
    three = load_mechanism("3-rps")
    reach = three.reachable(shifted(three.home(), 0.003, 0, 0))
    assert reach.forbidden
    assert reach.off == pytest.approx(0.003, rel=0.5)
    assert (
        "the rods of constant length and the joints' axes do not allow the pose" in reach.why()[0]
    )
    flat = planar()
    lifted = flat.reachable(shifted(flat.home(), 0, 0, 1e-3))
    assert lifted.forbidden
    assert "the machine cannot turn or move in this way" in lifted.why()


def test_same_assembly_rejects_the_mirror_image_and_never_home():
    machine = hexapod()
    mirror = machine.home()
    mirror[2, 3] *= -1
    values = machine.same_assembly(np.stack([machine.home(), mirror, yawed(30), yawed(120)]))
    np.testing.assert_array_equal(values, [True, False, True, False])
    np.testing.assert_array_equal(machine.same_assembly(yawed(150), yawed(120)), True)


def test_a_start_in_the_wrong_assembly_is_detected():
    """Forward kinematics from below finds the mirror image, whose sign is the other."""
    machine = hexapod()
    readings = machine.inverse(yawed(10))
    below = machine.home()
    below[2, 3] *= -1
    wrong = machine.forward(readings, below)
    assert wrong[2, 3] < 0
    assert not machine.same_assembly(wrong)
    assert machine.same_assembly(machine.forward(readings))


# Extents


def test_extents_of_a_cube_are_its_walls():
    """Along the diagonal the wall is root 3 times as far; a rod of 1000 m bends by 2e-5."""
    machine = cube()
    directions = np.array([[1, 0, 0], [0, -2, 0], [0, 0, 1], [1, 1, 1]])
    values = machine.extents(directions)
    np.testing.assert_allclose(values.distance, [0.1, 0.1, 0.1, 0.1 * np.sqrt(3)], atol=4e-5)
    assert values.why[0] == ("motor 1 is at the end of its range, 999.9 m",)
    assert values.why[1] == ("motor 2 is at the end of its range, 1000 m",)
    assert len(values.why[3]) >= 1
    assert machine.reachable(values.poses).inside.all()


def test_extents_end_where_something_stands_against_them(machine):
    """Just inside all is well, just outside something is not; a range is met to a digit."""
    own = np.linalg.svd(machine.forward_jacobian(machine.home()))[0]
    own = own[:, : machine.n_joints - machine.redundancy].T
    reach = machine.extents(np.concatenate([own, -own]))
    inside = machine.reachable(reach.poses)
    assert inside.inside.all()
    assert reach.distance.min() > 1e-3  # freedoms that it has
    low, high = machine.joint_ranges.T
    for reasons, q in zip(reach.why, inside.readings, strict=True):
        assert reasons
        if all("range" in text for text in reasons):
            assert min(np.min(q - low), np.min(high - q)) < 1e-7


def test_a_rod_of_constant_length_bends_the_way():
    """The leg's end runs on a sphere; the distance along the direction is kept all the same."""
    machine = tripod()
    own = np.linalg.svd(machine.forward_jacobian(machine.home()))[0][:, 0]
    value = machine.extents([own])
    shifted = pose_difference(value.poses[0], machine.home())
    assert shifted @ own == pytest.approx(value.distance[0], rel=0.01)
    assert value.distance[0] > 0.05
    assert np.linalg.norm(shifted) > 1.01 * value.distance[0]
    assert "range" in value.why[0][0]


def test_a_turn_ends_before_the_singular_pose():
    """The hexapod without ranges yaws to where its measure, cos(yaw) of home's, is 0.02."""
    machine = hexapod()
    free = machine_of_legs_without_ranges()
    reach = free.extents([[0, 0, 1, 0, 0, 0]], start=yawed(0))
    at = float(machine.reachable(yawed(0)).singularity)
    assert "singular" in reach.why[0][0]
    assert reach.distance[0] == pytest.approx(np.arccos(0.02 / at), abs=2e-3)


def machine_of_legs_without_ranges():
    legs = hexapod()
    rows = [
        (tuple(a), tuple(b), "actuated: true")
        for a, b in zip(legs.base_centers().tolist(), legs.platform_centers().tolist(), strict=True)
    ]
    return machine_of("spatial", rows, "home: {position: [0.0, 0.0, 0.36]}\n")


def test_where_the_search_ends_nothing_stands_against_it():
    value = cube().extents([[1, 0, 0]], most=0.05)
    assert value.distance[0] == pytest.approx(0.05)
    assert value.why == ((),)


def test_extents_refuse_a_start_outside_and_no_direction():
    machine = hexapod()
    with raises(InputError, code="pose.outside_workspace"):
        machine.extents(np.eye(3), start=yawed(90))
    with raises(InputError, expected="directions [x, y, z], or twists of six numbers"):
        machine.extents([[0, 0, 0]])
    with raises(InputError, found="(2,)", expected="(n, 3)"):
        machine.extents([1.0, 2.0])


# Grids


def test_the_volume_of_a_cube():
    value = cube().grid(count=20)
    assert value.size == pytest.approx(0.2**3, rel=0.15)
    assert value.inside.ndim == 3
    assert value.inside.shape == tuple(len(axis) for axis in value.axes)
    # a corner of the grid is a tenth outside
    assert not value.inside[0, 0, 0]


def test_a_section_of_a_planar_machine_is_where_its_three_rings_meet():
    """Each rod's length is a ring about its base joint, shifted by the turned platform joint."""
    machine = planar()
    count = machine.grid(count=60)
    assert len(count.axes) == 2
    T = machine.home()
    x, y = np.meshgrid(*(axis + T[k, 3] for k, axis in enumerate(count.axes)), indexing="ij")
    arms = machine.platform_centers() @ T[:3, :3].T
    ok = np.ones(x.shape, dtype=bool)
    offsets = machine.values[machine.layout.rod]
    for a, arm, (low, high), offset in zip(
        machine.base_centers(), arms, machine.joint_ranges, offsets, strict=True
    ):
        length = np.hypot(x + arm[0] - a[0], y + arm[1] - a[1]) - offset
        ok &= (length >= low) & (length <= high)
    # the section is the part of it about home on home's side of the singular curve
    assert np.all(ok[count.inside])
    usable = machine.reachable(pose(T[:3, :3], np.stack([x, y, np.zeros_like(x)], axis=-1)))
    np.testing.assert_array_equal(usable.inside & count.inside, count.inside)
    assert np.count_nonzero(usable.inside) >= np.count_nonzero(count.inside) > 500
    cell = count.axes[0][1] - count.axes[0][0]
    assert count.size == pytest.approx(np.count_nonzero(count.inside) * cell**2)


def test_finer_grids_agree():
    machine = load_mechanism("delta")
    coarse, fine = machine.grid(count=14).size, machine.grid(count=28).size
    assert coarse == pytest.approx(fine, rel=0.05)


def test_a_grid_without_extent_is_refused():
    with raises(InputError, found="direction [1, 0, 0]"):
        load_mechanism("3-rps").grid(count=5)


# Paths


def test_a_path_inside_is_usable(machine):
    home = machine.home()
    free = np.eye(6)[machine.layout.free][-1]
    ends = machine.extents(np.stack([free, -free]))
    direction = np.array([-0.5 * ends.distance[1], 0, 0.5 * ends.distance[0]])
    poses = perturb(home, direction[:, None] * free)
    value = machine.check_path(poses)
    assert value.usable, str(value)
    assert value.inside.all()
    assert str(value).startswith("the path stays in the workspace")
    np.testing.assert_array_equal(value.readings, machine.inverse(poses))


@pytest.mark.parametrize("steps", [2, 7])
def test_crossing_a_singular_pose_is_found_where_it_is(steps):
    """From 60 to 150 degrees of yaw: a third of the way is 90."""
    machine = machine_of_legs_without_ranges()
    yaws = np.linspace(60, 150, steps)
    values = machine.check_path(np.stack([yawed(x) for x in yaws]))
    assert not values.usable
    assert len(values.crossings) == 1
    assert values.crossings[0] == pytest.approx((steps - 1) / 3, abs=1e-7)
    assert str(values).startswith("the path crosses a singular pose at ")
    # it leaves before, where the pose is too near
    at = float(machine.reachable(yawed(0)).singularity)
    near = np.degrees(np.arccos(0.02 / at))
    assert values.leaves == pytest.approx((near - 60) / 90 * (steps - 1), abs=2e-3 * steps)
    assert values.closest[1] < 0.1


def test_there_and_back_crosses_twice():
    machine = machine_of_legs_without_ranges()
    values = machine.check_path(np.stack([yawed(60), yawed(120), yawed(60)]))
    np.testing.assert_allclose(values.crossings, [0.5, 1.5], atol=1e-7)


def test_leaving_the_range_is_found_where_it_is():
    """A cube's wall at 0.1 m, on a path of 0.3 m in three parts."""
    machine = cube()
    path = np.stack([shifted(machine.home(), x, 0, 0) for x in (0.0, 0.04, 0.3)])
    value = machine.check_path(path)
    assert value.leaves == pytest.approx(1 + 0.06 / 0.26, abs=1e-5)
    np.testing.assert_array_equal(value.inside, [True, True, False])
    assert value.crossings == ()
    assert str(value).endswith("motor 1 is at the end of its range, 999.9 m")


def test_a_path_that_begins_outside():
    machine = cube()
    count = machine.check_path(np.stack([shifted(machine.home(), x, 0, 0) for x in (0.2, 0.0)]))
    assert count.leaves == 0.0
    assert len(count.why) == 1


def test_a_path_of_one_pose_is_none():
    with raises(InputError, found="an array of shape (1, 4, 4)"):
        hexapod().check_path(np.eye(4)[None])


def test_a_path_through_a_turn_of_the_base_frame():
    """A pose is a pose: rotation about x as well as about z."""
    machine = hexapod()
    tilted = machine.home()
    tilted[:3, :3] = rotation(np.array([0.1, 0, 0]))
    assert machine.check_path(np.stack([machine.home(), tilted])).usable
