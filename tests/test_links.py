"""Measurements that link two configurations: their rows, and unknowns that two of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pkmcal.geometry.rigid import look_at, perturb, pose
from pkmcal.identify import problem as problems
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import Information
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.noise import components
from pkmcal.identify.reduced_edges import reduced_edges
from pkmcal.identify.row_sums import EDGE_ROWS, LINK_ROWS, POSE_ROWS, READING_ROWS
from pkmcal.identify.start import start_state
from pkmcal.measurements import (
    EdgeSet,
    LinkRows,
    LinkSet,
    Measurements,
    Mount,
    PoseSet,
)
from pkmcal.measurements.distances import DistanceSet
from pkmcal.measurements.rows import RowGroups
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.solver import search
from pkmcal.solver.strips import normal_equations
from test_identify_scene import make_scene

POINT = np.array([0.02, -0.01, 0.05])
SIGMA, READING_NOISE = 3e-5, 1e-5
POSE_SIGMA = np.repeat([1e-3, 3e-4], 3)
T_TRACKER_BASE = look_at(np.array([0.9, 0.2, 0.4]), np.array([0.0, 0.0, 0.3]), np.eye(3)[2])


def marks(T, point=POINT):
    """Places (n, 3) of a tool's point at poses (n, 4, 4)."""
    return T[:, :3, :3] @ point + T[:, :3, 3]


def measured(machine, poses, pairs, rng, noise=1.0, target=True):
    """Distances of the tool's point between pairs, readings, and a target's poses at all."""
    n, pairs = len(poses), np.array(pairs)
    at = marks(poses)
    value = np.linalg.norm(at[pairs[:, 1]] - at[pairs[:, 0]], axis=1)
    value = value + noise * SIGMA * rng.normal(size=len(pairs))
    mount = np.full(len(pairs), int(target))
    links = DistanceSet(
        "distances.csv", pairs, mount, value, np.full(len(pairs), SIGMA), 2 + np.arange(len(pairs))
    )
    joints = machine.inverse(poses)
    joints = joints + noise * READING_NOISE * rng.normal(size=joints.shape)
    none = np.zeros(n if target else 0, dtype=int)
    error = noise * POSE_SIGMA * rng.normal(size=(len(none), 6))
    in_view = perturb(T_TRACKER_BASE @ poses[: len(none)], error)
    whiten = np.broadcast_to(np.diag(1 / POSE_SIGMA), (len(none), 6, 6))
    mounts = (Mount("target", "platform"), Mount("distances", "platform"))[1 - int(target) :]
    return Measurements(
        EdgeSet.empty(), joints, READING_NOISE, int(target), np.zeros(int(target), dtype=int),
        poses=PoseSet(none, np.arange(len(none)), none, in_view, whiten), mounts=mounts,
        links=(links,),
    )  # fmt: skip


@pytest.fixture(scope="module")
def machine():
    return load_mechanism("gough-stewart")


@pytest.fixture(scope="module")
def case(machine):
    """Twelve configurations, of which five are linked; a state beside the solution."""
    rng = np.random.default_rng(3)
    poses = perturb(machine.home(), rng.normal(size=(12, 6)) * np.repeat([0.1, 0.03], 3))
    data = measured(machine, poses, [(0, 3), (3, 7), (7, 0), (9, 3), (11, 0)], rng)
    start = start_state(machine, data, T_TRACKER_BASE[None])
    assembled = assemble(machine, data, default_gauge(machine))
    batch = batch_of(machine, assembled, start)
    u = assembled.problem.unknowns
    step = np.zeros((1, u.count))
    step[:, u.mounts] = 1e-2 * rng.normal(size=(1, u.mounts.stop - u.mounts.start))
    step[:, u.linked] = 1e-3 * rng.normal(size=(1, u.n_linked))
    own = 1e-3 * rng.normal(size=(1, 12, 6))
    return assembled, assembled.problem.retract(batch, step, own), data


def test_the_residual_is_the_distance_of_the_marks(case):
    assembled, state, data = case
    links, T = data.links[0], state.T_base_platform[0]
    at = marks(T, state.T_mount[0, 1, :3, 3])
    apart = np.linalg.norm(at[links.configuration[:, 1]] - at[links.configuration[:, 0]], axis=1)
    rows = assembled.problem.unweighted(state).links[0]
    values = assembled.places.links.taken(rows)[:, 0]
    np.testing.assert_allclose(values, (apart - links.value) / SIGMA, rtol=1e-9, atol=1e-7)


def test_jacobian_against_differences(case):
    """All rows by all unknowns, shared and own, against central differences of the residuals."""
    assembled, state, _ = case
    problem = assembled.problem
    linear = problem.linearize(state)
    na, (count, d) = problem.unknowns.count, linear.by_own.shape[1::2]

    def value(step):
        shared, own = step[:na][None], step[na:].reshape(1, count, d)
        return problem.residuals(problem.retract(state, shared, own)).value[0]

    # a linked configuration's own unknowns are shared, and no others
    linked = problem.link_blocks.linked
    assert linked.tolist() == [0, 3, 7, 9, 11]
    assert not linear.by_own[0, linked].any()
    assert problem.unknowns.n_linked == 6 * len(linked)
    h, u = 1e-6, problem.unknowns
    columns = [*range(u.mounts.start, u.linked.stop), *range(na, na + count * d)]
    for k in columns:
        step = np.zeros(na + count * d)
        step[k] = h
        by = (value(step) - value(-step)) / (2 * h)
        if k < na:
            expected = linear.by_shared[0, ..., k]
        else:
            expected = np.zeros_like(by)
            row, own = divmod(k - na, d)
            expected[row] = linear.by_own[0, row, :, own]
        size = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(by, expected, atol=2e-6 * size)


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_links_of_every_machine(name):
    """Derivatives of distances alone against differences, hinges and cranks included."""
    machine, rng = load_mechanism(name), np.random.default_rng(1)
    reach = np.where(np.array(machine.joint_units) == "m", 0.01, 0.06)
    joints = machine.inverse(machine.home()[None]) + reach * rng.normal(size=(7, machine.n_joints))
    if machine.redundancy:  # whose readings have to agree
        joints = machine.inverse(machine.forward(joints))
    fk = machine.forward_result(joints)
    joints, poses = joints[fk.converged][:5], fk.T_base_platform[fk.converged][:5]
    assert len(joints) == 5
    data = measured(machine, poses, [(0, 3), (3, 1), (4, 0)], rng, noise=0.0, target=False)
    data = replace(data, joints=joints)
    start = start_state(machine, data, np.zeros((0, 4, 4)))
    start = replace(start, T_mount=pose(np.eye(3), POINT)[None])
    assembled = assemble(machine, data, default_gauge(machine))
    problem = assembled.problem
    state, u, rows = (
        batch_of(machine, assembled, start),
        problem.unknowns,
        problem.row_groups.links.rows,
    )
    np.testing.assert_allclose(problem.residuals(state).value[0][:, rows], 0, atol=1e-6)
    own = np.zeros((1, 5, problem.layout.own_motion.shape[1]))
    step = np.zeros((1, u.count))
    step[:, u.mounts.start : u.linked.stop] = 1e-4 * rng.normal(size=u.linked.stop - u.mounts.start)
    here = problem.retract(state, step, own)
    step = 1e-3 * step[:, ::-1].copy() + 1e-3 * step
    ahead, back = (
        problem.residuals(problem.retract(here, sign * step, own)).value[0] for sign in (1, -1)
    )
    expected = (ahead - back)[:, rows] / 2
    by = (problem.linearize(here).by_shared[0] @ step[0])[:, rows]
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(by, expected, atol=1e-6 * np.abs(expected).max())


def dense(problem, state):
    """The whole Jacobian (n, m), nothing eliminated, by the unknowns (na + K d,) that do anything:
    linked configurations have no own ones.
    """
    linear = problem.linearize(state)
    _, count, r, d = linear.by_own.shape
    na = problem.unknowns.count
    whole = np.zeros((count * r + len(linear.shared_by), na + count * d))
    whole[: count * r, :na] = linear.by_shared[0].reshape(-1, na)
    whole[count * r :, :na] = linear.shared_by
    for k in range(count):
        whole[k * r : (k + 1) * r, na + k * d : na + (k + 1) * d] = linear.by_own[0, k]
    used = whole.any(axis=0)
    return whole[:, used], used


def test_covariance_and_step_are_those_of_the_whole_problem(machine, case):
    """Elimination changes nothing: covariance, rows and degrees of freedom as of all unknowns."""
    assembled, state, data = case
    problem = assembled.problem
    whole, used = dense(problem, state)
    covariance = np.linalg.inv(whole.T @ whole)
    shared = np.flatnonzero(used[: problem.unknowns.count])
    na = len(shared)
    scale = np.sqrt(np.diag(covariance)[:na])
    scale = np.outer(scale, scale)
    info = Information(problem, state)
    np.testing.assert_allclose(
        info.covariance[0][np.ix_(shared, shared)] / scale, covariance[:na, :na] / scale, atol=2e-5
    )
    hat = np.einsum("ij,jk,ik->i", whole, covariance, whole)
    weight = RowGroups(*(kind.present[None].astype(float) for kind in problem.row_groups))
    freedom = components(info, weight).freedom[0]
    _, count, r, _ = problem.linearize(state).by_own.shape
    remainder = (1 - hat[: count * r]).reshape(count, r)
    links = problem.row_groups.links
    expected = remainder[:, links.rows][links.present].sum()
    assert 0 < expected < len(data.links[0])
    assert freedom[LINK_ROWS] == pytest.approx(expected, rel=1e-5)
    poses = remainder[:, problem.row_groups.poses.rows].sum()
    assert freedom[POSE_ROWS] == pytest.approx(poses, rel=1e-5)
    assert freedom[READING_ROWS] == pytest.approx(
        remainder[:, problem.closure_rows].sum(), rel=1e-4
    )


def test_pieces_say_what_the_whole_states(case):
    """With three configurations at a time, links lead from one piece into another."""
    assembled, state, _ = case
    problem = assembled.problem
    one = search.minimise(problem, state)
    before = Information(problem, state)
    expected = before.rows[0][0].T @ before.rows[0][0], before.by_kind.trace
    problem = replace(problem, rows_at_once=3 * problem.n_rows)
    info = Information(problem, state)
    assert len(list(info.pieces())) == 4
    normal = info.rows[0][0].T @ info.rows[0][0]
    np.testing.assert_allclose(normal, expected[0], rtol=1e-8, atol=1e-8 * np.abs(normal).max())
    np.testing.assert_allclose(info.by_kind.trace, expected[1], rtol=1e-9)
    other = search.minimise(problem, state)
    assert other.cost[0] == pytest.approx(one.cost[0], rel=1e-9)
    np.testing.assert_allclose(other.state.z, one.state.z, atol=1e-9)


@pytest.fixture(scope="module")
def with_edges():
    """Edges of tied and of free machines, two distances, and a mount: a problem and its state."""
    rng = np.random.default_rng(5)
    scene = make_scene(rng, configurations=6, n_stations=2)
    plain, poses = scene.measurements(rng), scene.poses[0]
    pairs = np.array([(1, 4), (4, 2)])
    at = marks(poses)
    value = np.linalg.norm(at[pairs[:, 1]] - at[pairs[:, 0]], axis=1) + SIGMA
    sigma = np.full(2, SIGMA)
    links = DistanceSet("d.csv", pairs, np.zeros(2, dtype=int), value, sigma, np.array([2, 3]))
    data = replace(plain, links=(links,), mounts=(Mount("distances", "platform"),), shaded=True)
    start = start_state(scene.machine, data, scene.T_camera_base)
    start = replace(start, T_mount=pose(np.eye(3), POINT)[None])
    return scene.machine, data, start


def test_edges_of_linked_configurations(with_edges):
    """Strips of edges by unknowns that are shared: as with the whole Jacobian in memory."""
    machine, data, start = with_edges
    assembled = assemble(machine, data, default_gauge(machine))
    problem, state = assembled.problem, batch_of(machine, assembled, start)
    compact = problem.compact(state)
    normal = normal_equations([compact], np.zeros(1))
    whole, used = dense(problem, state)
    linear = compact.linear()
    value = np.concatenate([linear.value[0].ravel(), linear.shared_value[0]])
    shared = np.flatnonzero(used[: problem.unknowns.count])
    na = len(shared)
    j, own = whole[:, :na], whole[:, na:]
    q = np.linalg.qr(own)[0]
    residual = j - q @ (q.T @ j)
    matrix, size = normal.matrix[0][np.ix_(shared, shared)], np.linalg.norm(residual, axis=0)
    scale = np.outer(size, size)
    np.testing.assert_allclose(matrix / scale, residual.T @ residual / scale, atol=1e-9)
    gradient = normal.gradient[0][shared]
    np.testing.assert_allclose(gradient / size, residual.T @ value / size, rtol=1e-6, atol=1e-5)
    info = Information(problem, state)
    weight = RowGroups(*(kind.present[None].astype(float) for kind in problem.row_groups))
    unit = whole / np.linalg.norm(whole, axis=0)
    inverse = np.linalg.inv(unit.T @ unit)
    hat = np.einsum("ij,jk,ik->i", unit, inverse, unit)
    _, count, r, _ = linear.by_own.shape
    residual = (1 - hat[: count * r]).reshape(count, r)
    freedom = components(info, weight).freedom[0]
    edges, links = problem.row_groups.edges, problem.row_groups.links
    of_edges = residual[:, edges.rows][np.repeat(edges.present, 2, axis=1)].sum()
    assert freedom[EDGE_ROWS] == pytest.approx(of_edges, rel=1e-5)
    of_links = residual[:, links.rows][links.present].sum()
    assert freedom[LINK_ROWS] == pytest.approx(of_links, rel=1e-4, abs=1e-6)
    taken = sum(
        float(np.sum(piece.own**2)) + sum(float(np.sum(t**2)) for _, t in piece.shared(info.root))
        for piece in reduced_edges(info)
    )
    assert taken == pytest.approx(weight.edges.sum() * 2 - freedom[EDGE_ROWS], rel=1e-5)


@dataclass(frozen=True)
class Steps(LinkSet):
    """Differences of height of the tool's point, m: a second kind of link, of these tests only."""

    @property
    def kind(self):
        return "steps"

    def rows(self, first, second, mount):
        point = mount[..., :3, 3:]
        arms = [(T[..., :3, :3] @ point)[..., 0] for T in (first, second)]
        rise = (arms[1] + second[..., :3, 3] - arms[0] - first[..., :3, 3])[..., 2]
        e = np.broadcast_to(np.eye(3)[2], arms[0].shape) / self.sigma[:, None]
        by = [np.concatenate([np.cross(arm, e), e], axis=-1) for arm in arms]
        turned = (second[..., :3, :3] - first[..., :3, :3]).mT @ e[..., None]
        by_mount = np.concatenate([np.zeros_like(e), turned[..., 0]], axis=-1)
        return LinkRows((rise - self.value) / self.sigma, -by[0], by[1], by_mount)


def test_two_kinds_of_links_stand_side_by_side(machine):
    """Each link has its own row and number, also where some configurations are left out."""
    rng = np.random.default_rng(11)
    poses = perturb(machine.home(), rng.normal(size=(12, 6)) * np.repeat([0.1, 0.03], 3))
    data = measured(machine, poses, [(0, 3), (3, 7), (7, 0)], rng, noise=0.0)
    pairs = np.array([(3, 0), (5, 7)])
    rise = marks(poses)[pairs[:, 1], 2] - marks(poses)[pairs[:, 0], 2]
    rise[1] += 1e-3  # twenty deviations
    steps = Steps("s.csv", pairs, np.ones(2, dtype=int), rise, np.full(2, 5e-5), np.arange(2))
    data = replace(data, links=(*data.links, steps))
    start = start_state(machine, data, T_TRACKER_BASE[None])
    start = replace(start, T_mount=np.stack([start.T_mount[0], pose(np.eye(3), POINT)]))
    assembled = assemble(machine, data, default_gauge(machine))
    rows = assembled.problem.unweighted(batch_of(machine, assembled, start)).links[0]
    np.testing.assert_allclose(
        assembled.places.links.taken(rows)[:, 0], [0, 0, 0, 0, -20], atol=1e-3
    )
    value, number = data.link_at(4)
    assert value.kind == "steps"
    assert number == 1
    estimate = bundle(machine, data, start)
    assert estimate.link_residuals.shape == estimate.link_weights.shape == (5,)
    keep = np.ones(12, dtype=bool)
    keep[7] = False
    part = data.with_links(data.links_among(keep))
    assert [len(links) for links in part.links] == [1, 1]
    less = assemble(machine, part, default_gauge(machine))
    assert less.problem.unknowns.n_linked == 12
    piece = assembled.problem.among(slice(4, 12))
    assert [len(one) for one in piece.link_blocks.sets] == [1, 1]


def test_the_tool_point_of_a_machine_that_turns_is_estimated(machine):
    """Distances of new pairs are predicted, with the point where it is to half a millimetre."""
    rng = np.random.default_rng(8)
    poses = perturb(machine.home(), rng.normal(size=(40, 6)) * np.repeat([0.1, 0.03], 3))
    pairs = [(k, k + 1) for k in range(39)] + [(k, k + 7) for k in range(33)]
    data = measured(machine, poses, pairs, rng)
    estimate = bundle(machine, data, start_state(machine, data, T_TRACKER_BASE[None]))
    assert estimate.statistics.link_scale < 1.3
    assert np.sqrt(np.diag(estimate.mount_covariance[1])[3:]).max() < 5e-4
    T = perturb(machine.home(), rng.normal(size=(20, 6)) * np.repeat([0.1, 0.03], 3))
    forward_kinematics = estimate.machine.forward(machine.inverse(T))
    at, expected = marks(forward_kinematics, estimate.state.T_mount[1, :3, 3]), marks(T)
    apart, above_limit = (np.linalg.norm(x[1:] - x[:-1], axis=1) for x in (at, expected))
    assert np.sqrt(np.mean((apart - above_limit) ** 2)) < SIGMA


def test_without_links_a_configuration_is_eliminated(machine, case):
    """The same data without links: no unknown is shared, and the estimate differs."""
    _, _, data = case
    plain = assemble(machine, replace(data, links=()), default_gauge(machine)).problem
    assert plain.unknowns.n_linked == 0
    assert plain.structure.strips.linked is None
    assert problems.Problem is type(plain)
