"""The tool's error over the workspace: against brute force, and on every machine."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from faults import raises
from pkmcal.calibration.saved_calibration import load
from pkmcal.calibration.toolmap import map_of
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.centres import free_of_gauge, laid_over
from pkmcal.identify.gauge import ThreeCentres, in_gauge
from pkmcal.identify.state import State
from pkmcal.identify.tool import tool_error
from pkmcal.judge.machine_errors import compare
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.report.calibration import save
from pkmcal.report.workspace import section
from pkmcal.simulation.truth import true_machine

NO_SLICES = {"3-rps", "constant-legs"}
"""Machines that cannot move aside without turning."""


def determined(machine, share=0.02):
    """A covariance of the free parameters, correlated."""
    root = machine.parameters.free_matrix() * machine.parameters.tolerances_free() * share
    mixed = root @ np.random.default_rng(4).normal(size=(root.shape[1],) * 2)
    return mixed @ mixed.T / root.shape[1]


@pytest.fixture(scope="module")
def small():
    """A hexapod whose nominal model is off, with a covariance, in a few poses."""
    nominal = load_mechanism("gough-stewart")
    machine = true_machine(nominal, 1.0, np.random.default_rng(2))
    poses = poses_in(machine.limits(), Region(turn=0.2), 12)
    return SimpleNamespace(
        nominal=nominal, machine=machine, poses=poses, covariance=determined(machine)
    )


def drawn_poses(case, draws=600):
    """Poses at the same readings of machines drawn by the covariance, as changes (draws, n, 6),
    each laid over the calibrated one by its joint centres.
    """
    rng = np.random.default_rng(5)
    machine, joints = case.machine, case.machine.inverse(case.poses)
    values, vectors = np.linalg.eigh(case.covariance)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    out = []
    for _ in range(draws):
        other = machine.with_values(machine.values + half @ rng.normal(size=len(half)))
        base = laid_over(other.base_centers(), machine.base_centers())
        platform = laid_over(other.platform_centers(), machine.platform_centers())
        forward_kinematics = other.forward(joints, inverse(base) @ case.poses @ platform)
        out.append(pose_difference(base @ forward_kinematics @ inverse(platform), case.poses))
    return np.array(out)


def test_sigma_is_the_scatter_of_machines_drawn_by_the_covariance(small):
    """Each drawn machine is laid over by all joint centres, with no word of derivatives."""
    values = tool_error(
        small.nominal, small.machine, free_of_gauge(small.machine, small.covariance), small.poses
    )
    count = drawn_poses(small)
    scatter = np.einsum("dni,dnj->nij", count, count) / len(count)
    scale = np.sqrt(np.einsum("nii->ni", values.covariance)) + 1e-15
    off = (scatter - values.covariance) / (scale[:, :, None] * scale[:, None])
    # 600 draws leave 5.8 % on a variance; four and a half of them, for 432 numbers
    assert np.abs(off).max() < 0.26
    drawn = np.sqrt(np.trace(scatter[:, 3:, 3:], axis1=1, axis2=2))
    np.testing.assert_allclose(values.position, drawn, rtol=0.06)


def test_what_frames_do_is_in_no_sigma_where_only_boards_saw_the_machine(small):
    """Errors that turn and shift the base as a whole: all of it is taken out, at every pose."""
    from pkmcal.identify.gauge import freedoms, generators

    by = generators(small.machine.layout, small.machine.values) @ freedoms(small.machine)
    covariance = 1e-6 * by @ by.T
    values = tool_error(small.nominal, small.machine, covariance, small.poses, legs_observed=False)
    loose = tool_error(small.nominal, small.machine, covariance, small.poses)
    assert loose.position.min() > 1e-4
    assert values.position.max() < 1e-9


def test_the_nominal_error_is_that_of_its_poses_at_the_same_readings(small):
    machine, nominal = small.machine, small.nominal
    values = tool_error(nominal, machine, small.covariance, small.poses)
    joints = machine.inverse(small.poses)
    base = laid_over(nominal.base_centers(), machine.base_centers())
    platform = laid_over(nominal.platform_centers(), machine.platform_centers())
    before = base @ nominal.forward(joints) @ inverse(platform)
    distance = np.linalg.norm(before[:, :3, 3] - small.poses[:, :3, 3], axis=1)
    np.testing.assert_allclose(values.off_position, distance, rtol=1e-9)
    assert distance.max() > 1e-4
    turn = before[:, :3, :3] @ small.poses[:, :3, :3].mT
    angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    np.testing.assert_allclose(values.off_orientation, angle, atol=1e-7)


def test_frames_by_some_of_the_poses(small):
    """Fitted on all poses or on those that are asked for alone, the same where these are all."""
    arguments = small.nominal, small.machine, small.covariance
    whole = tool_error(*arguments, small.poses, legs_observed=False)
    named = tool_error(*arguments, small.poses, legs_observed=False, fitted=np.arange(12))
    some = tool_error(*arguments, small.poses, legs_observed=False, fitted=np.arange(6))
    alone = tool_error(*arguments, small.poses[:6], legs_observed=False)
    np.testing.assert_array_equal(whole.position, named.position)
    np.testing.assert_allclose(some.position[:6], alone.position, rtol=1e-9)
    assert np.abs(some.position - whole.position).max() > 1e-3 * whole.position.max()


def test_poses_out_of_reach_are_nan(small):
    far = small.poses.copy()
    machine = load_mechanism("delta")
    far = np.stack([machine.home(), perturb(machine.home(), np.array([0, 0, 0, 2.0, 0, 0]))])
    values = tool_error(machine, machine, determined(machine), far)
    assert np.isfinite(values.position[0])
    assert np.isnan(values.position[1])
    assert np.isnan(values.off_position[1])


def test_from_a_calibration_and_from_its_file(calibrated, tmp_path):
    save(calibrated, tmp_path / "out")
    poses = calibrated.estimate.state.T_base_platform[:3]
    values, again = calibrated.tool_error(poses), load(tmp_path / "out").tool_error(poses)
    assert (values.position > 0).all()
    np.testing.assert_allclose(again.position, values.position, rtol=1e-9)
    np.testing.assert_allclose(again.off, values.off, rtol=1e-6, atol=1e-12)
    assert (values.off_position > 1.5 * values.position).all()  # the nominal model was off by more
    with raises(InputError, found="an array of shape (4, 4)"):
        calibrated.tool_error(poses[0])


# the map


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n == "h4-rods" else n for n in sorted(catalogue())],
)
def test_every_machine_has_a_map(name):
    nominal = load_mechanism(name)
    machine = true_machine(nominal, 0.2, np.random.default_rng(3))
    made = map_of(nominal, machine, determined(machine))
    assert made.spread == 250
    assert np.isfinite(made.after.position).all()
    assert (made.after.position > 0).all()
    assert bool(made.slices) == (name not in NO_SLICES)
    for cut in made.slices:
        there = cut.rows >= 0
        place = made.after.T_base_platform[cut.rows[there], :3, 3]
        u, v = np.broadcast_arrays(cut.u, cut.v[:, None])
        cell = cut.u[1] - cut.u[0]
        assert np.abs(place[:, cut.across] - u[there]).max() < 0.26 * cell
        assert np.abs(place[:, cut.up] - v[there]).max() < 0.26 * cell
        assert np.abs(place[:, cut.normal] - cut.level).max() < 0.26 * cell
    # by the nominal model's tolerances alone, fifty times what is known
    ratio = np.median(made.before.position) / np.median(made.after.position)
    assert 20 < ratio < 120


def test_a_map_of_a_region(small):
    """Inside it, and what its document tells."""
    region = Region(x=(-0.02, 0.03), y=(0.0, 0.04))
    made = map_of(small.nominal, small.machine, small.covariance, region)
    place = made.after.T_base_platform[:, :3, 3]
    assert place[:, 0].min() > -0.021
    assert place[:, 1].max() < 0.041
    entries = made.document()
    assert entries["region"] == {"x": (-0.02, 0.03), "y": (0.0, 0.04), "z": None, "turn": None}
    even = made.after.position[: made.spread]
    assert entries["sigma"]["position"]["worst"] == pytest.approx(even.max())
    assert entries["sigma"]["position"]["median"] == pytest.approx(np.median(even))
    assert entries["drawing_off"]["position"]["worst"] == pytest.approx(
        made.after.off_position[: made.spread].max()
    )


def mapped(name, **region):
    """Map of a machine built a little off its nominal model."""
    nominal = load_mechanism(name)
    machine = true_machine(nominal, 0.2, np.random.default_rng(3))
    return map_of(nominal, machine, determined(machine), Region(**region))


def page_of(name, **region):
    """The report's section of a machine whose map is made, and the map."""
    made = mapped(name, **region)
    state = SimpleNamespace(T_base_platform=made.after.T_base_platform[:4])
    estimate = SimpleNamespace(configurations=np.ones(4, dtype=bool), state=state)
    session = SimpleNamespace(configurations=tuple("abcd"))
    return section(session, estimate, made), made


def test_the_map_has_every_cell_and_every_pose():
    part, made = page_of("gough-stewart")
    (block,) = part.blocks
    assert len(block.slices) == len(made.slices) == 6
    kinds = [(one.name, one.component, one.better) for one in block.layers]
    assert kinds == [
        (name, component, better)
        for component in ("position", "orientation")
        for name, better in (("Error before", "small"), ("σ after", "small"), ("Gain", "large"))
    ]
    sources = {
        ("σ after", "position"): made.after.position * 1e3,
        ("Error before", "orientation"): np.rad2deg(made.after.off_orientation),
        ("Gain", "position"): made.after.off_position / made.after.position,
    }
    for layer in block.layers:
        expected = sources.get((layer.name, layer.component))
        if expected is None:
            continue
        for cut, own, grid in zip(made.slices, block.slices, layer.slices, strict=True):
            visible = np.array(grid, dtype=float)
            assert visible.shape == (len(own.v), len(own.u))
            there = cut.rows >= 0
            np.testing.assert_array_equal(np.isfinite(visible), there)
            np.testing.assert_allclose(visible[there], expected[cut.rows[there]], rtol=6e-3)
        np.testing.assert_allclose(layer.evenly, expected[:250], rtol=6e-3)
    # the limit of error and sigma is one, so that the shares of both compare
    limits = {(one.unit, one.limit) for one in block.layers if one.unit}
    assert len(limits) == 2
    keys = [pose.key for cut in block.slices for pose in cut.poses]
    assert set(keys) <= {f"configuration:{name}" for name in "abcd"}
    assert keys
    assert "known to" in part.text[0]
    assert [row.name for row in part.tables[0].rows][-1] == "Calibrated, σ"


@pytest.mark.parametrize(("name", "components"), [
    ("3-rpr", {"position", "orientation"}), ("3-rps", None), ("delta", {"position"}),
])  # fmt: skip
def test_machines_of_few_freedoms_are_mapped_by_what_they_do(name, components):
    part, _ = page_of(name)
    assert bool(part.blocks) == (components is not None)
    for block in part.blocks:
        assert {layer.component for layer in block.layers} == components
    turns = len(part.tables[0].columns) == 5
    assert turns == (name != "delta")


@pytest.mark.parametrize(
    ("name", "region", "slices", "message"),
    [
        ("gough-stewart", {"z": (0.36, 0.36)}, [(0, 1, 0.36)], "z 360 mm"),
        ("gough-stewart", {"x": (0.02, 0.02)}, [(1, 2, 0.02)], "x 20 mm"),
        ("gough-stewart", {"x": (0.01, 0.01), "y": (0.0, 0.0)}, [], "x 10 mm, y 0 mm"),
        ("3-rpr", {"y": (0.0, 0.0)}, [], "y 0 mm"),
        ("gough-stewart", {"x": (0.0, 0.0), "y": (0.0, 0.0), "z": (0.36, 0.36)}, [], "z 360 mm"),
    ],
)
def test_a_plane_a_line_and_a_point_are_regions_too(name, region, slices, message):
    """A plane is cut where it is, not at home; a line and a point have no slices, and say why."""
    part, made = page_of(name, **region)
    cuts = [(cut.across, cut.up, cut.level) for cut in made.slices]
    assert cuts == [(*plane[:2], pytest.approx(plane[2], abs=1e-6)) for plane in slices]
    assert all(np.count_nonzero(cut.rows >= 0) > 50 for cut in made.slices)
    assert message in part.text[0]
    assert any("extent along one axis at most" in text for text in part.text) == (not slices)


def test_a_machine_without_a_map_states_why():
    part = section(None, None, "There is no map of the workspace: out of reach.")
    assert part.text == ("There is no map of the workspace: out of reach.",)
    assert part.blocks == ()


# ------------------------------------------------------------------ beside a known machine


def test_frames_are_no_error(small):
    """Those by three joints in place of the truth's: other numbers, the same machine."""
    state = State(small.machine.values, np.eye(4)[None], small.poses)
    values = in_gauge(small.machine, state, ThreeCentres((0, 2, 4)))
    other = small.machine.with_values(values.theta)
    joints = small.machine.inverse(small.poses)
    plain = np.linalg.norm((other.forward(joints) - small.poses)[:, :3, 3], axis=1)
    assert plain.min() > 1e-4
    error = compare(other, small.machine, joints)
    assert error.centre.max() < 1e-12
    assert error.position.max() < 1e-9
    assert error.orientation.max() < 1e-9


def test_errors_beside_a_known_machine_are_those_of_its_poses(small):
    joints = small.machine.inverse(small.poses)
    error = compare(small.nominal, small.machine, joints)
    there = error.T_base @ small.nominal.forward(joints) @ inverse(error.T_platform)
    off = pose_difference(there, small.poses)
    np.testing.assert_allclose(error.position, np.linalg.norm(off[:, 3:], axis=1), atol=1e-12)
    np.testing.assert_allclose(error.orientation, np.linalg.norm(off[:, :3], axis=1), atol=1e-12)
    k = small.nominal.parameters.of_kind("offset")
    np.testing.assert_allclose(error.offset, (small.nominal.values - small.machine.values)[k])
    # by the poses too, where no legs tell where the joints are: never further apart
    by_poses = compare(small.nominal, small.machine, joints, legs_observed=False)
    assert np.sum(by_poses.position**2) < np.sum(error.position**2)


def test_machines_of_other_nominal_models_are_not_compared(small):
    found = "delta, 3 legs, 36 parameters"
    with raises(InputError, code="difference.machines", found=found):
        compare(load_mechanism("delta"), small.machine, np.zeros((1, 3)))
