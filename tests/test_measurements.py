"""The contract of kinds of measurement, held over all kinds of the folder.

Each kind has an example here: exact data of the nominal machine. A new kind needs one entry in
EXAMPLES.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.files import Schema
from pkmcal.geometry.rigid import look_at, perturb, pose
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.start import start_state
from pkmcal.identify.verdict import misfit
from pkmcal.levels import UNEXPLAINED_SCALE
from pkmcal.measurements import EdgeSet, Measurements, Mount, PoseSet
from pkmcal.measurements.contract import (
    DISPLAY_UNITS,
    ImageKind,
    LinkKind,
    MotorKind,
    TargetKind,
    kinds_of,
    measurement_kinds,
)
from pkmcal.measurements.distances import DistanceSet
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome import Level
from pkmcal.session.schema import OBSERVE_WORDS, session_schema
from test_identify_scene import make_scene

T_STATION_BASE = look_at(np.array([0.9, 0.2, 0.4]), np.array([0.0, 0.0, 0.3]), np.eye(3)[2])
T_MOUNT = pose(np.eye(3), np.array([0.02, -0.01, 0.05]))
SIGMA = np.repeat([1e-3, 3e-4], 3)
READING_NOISE = 1e-5
KINDS = sorted(measurement_kinds().items())


def named(kinds):
    return pytest.mark.parametrize("kind", [k for _, k in kinds], ids=[c for c, _ in kinds])


def poses_of(machine, count, rng):
    return perturb(machine.home(), rng.normal(size=(count, 6)) * np.repeat([0.1, 0.03], 3))


def of_targets(whiten, level=False):
    """A target on the platform, from one station; whiten (6, 6)."""

    def example(rng):
        machine = load_mechanism("gough-stewart")
        poses = poses_of(machine, 9, rng)
        T = pose(np.eye(3), np.array([0.0, 0.0, -0.1])) if level else T_STATION_BASE
        none, n = np.zeros(9, dtype=int), np.arange(9)
        items = PoseSet(
            none, n, none, T @ poses @ T_MOUNT, np.broadcast_to(whiten, (9, 6, 6)).copy()
        )
        data = Measurements(
            EdgeSet.empty(), machine.inverse(poses), READING_NOISE, 1, none[:1],
            poses=items, mounts=(Mount("target", "platform"),),
        )  # fmt: skip
        start = start_state(machine, data, T[None])
        return machine, data, replace(start, T_base_platform=poses, T_mount=T_MOUNT[None])

    return example


def of_edges(rng):
    scene = make_scene(rng, configurations=5, n_stations=2, tolerance=0.0)
    scene = replace(scene, edge_shift=np.zeros_like(scene.edge_shift))
    data = scene.measurements(rng, noise=0.0)
    start = start_state(scene.machine, data, scene.T_camera_base)
    return scene.machine, data, replace(start, T_base_platform=scene.poses[0])


def of_readings(rng):
    machine, data, start = of_targets(np.diag(1 / SIGMA))(rng)
    data = replace(data, poses=PoseSet.empty(), mounts=(), n_stations=0)
    return machine, data, replace(
        start, T_camera_base=np.zeros((0, 4, 4)), T_mount=np.zeros((0, 4, 4)),
        on_platform=np.zeros(0, dtype=bool),
    )  # fmt: skip


def of_links(made):
    """Links between nine configurations; made : the set of pairs (N, 2) and true poses."""

    def example(rng):
        machine, data, start = of_targets(np.diag(1 / SIGMA))(rng)
        pairs = np.array([(0, 4), (4, 7), (7, 0), (8, 1)])
        links = made(pairs, start.T_base_platform).at_mount(0)
        return machine, replace(data, links=(links,)), start

    return example


def distances(pairs, poses):
    at = (poses @ T_MOUNT)[:, :3, 3]
    apart = np.linalg.norm(at[pairs[:, 1]] - at[pairs[:, 0]], axis=1)
    n = len(pairs)
    return DistanceSet(
        "d.csv", pairs, np.zeros(n, dtype=int), apart, np.full(n, 2e-5), 2 + np.arange(n)
    )


def whitening(code):
    return kinds_of(TargetKind)[code].whiten(3e-4, 1e-3)


EXAMPLES = {
    "edges": of_edges,
    "boards": of_targets(np.diag(1 / SIGMA)),
    "poses": of_targets(whitening("poses")),
    "points": of_targets(whitening("points")),
    "heights": of_targets(whitening("heights"), level=True),
    "orientations": of_targets(whitening("orientations")),
    "readings": of_readings,
    "distances": of_links(distances),
}


def rows_of(kind, problem):
    """Rows of a kind in a problem's residuals."""
    if issubclass(kind, MotorKind):
        return problem.closure_rows
    kinds = problem.row_groups
    if issubclass(kind, LinkKind):
        return kinds.links.rows
    return kinds.edges.rows if kind.code == "edges" else kinds.poses.rows


@pytest.fixture(scope="module", params=[code for code, _ in KINDS])
def example(request):
    """A kind, its machine and data, the problem and its exact state."""
    machine, data, start = EXAMPLES[request.param](np.random.default_rng(4))
    assembled = assemble(machine, data, default_gauge(machine))
    state = batch_of(machine, assembled, start)
    return measurement_kinds()[request.param], machine, data, start, assembled, state


def test_every_kind_has_an_example():
    assert EXAMPLES.keys() == measurement_kinds().keys()
    sorts = (ImageKind, TargetKind, LinkKind, MotorKind)
    assert sum(len(kinds_of(sort)) for sort in sorts) == len(KINDS)


@named(KINDS)
def test_a_kind_stands_in_a_file_of_its_own(kind):
    others = [other for _, other in KINDS if other.__module__ == kind.__module__]
    assert others == [kind]
    assert kind.__doc__
    assert getattr(kind, "__final__", False)


@named(KINDS)
def test_words_of_a_kind(kind):
    assert kind.code.isidentifier()
    assert kind.one != kind.label
    assert kind.unit in ("px", "m", "rad", "m or rad")
    assert 1 <= kind.numbers <= 6
    assert len({other.one for _, other in KINDS}) == len(KINDS)


def test_headers_distinguish_the_kinds_of_tables():
    headers = [set(h) for kind in kinds_of(TargetKind).values() for h in kind.headers]
    assert all(headers.count(h) == 1 for h in headers)


@named(sorted(kinds_of(TargetKind).items()))
def test_a_target_is_whitened_where_it_is_measured(kind):
    whiten = kind.whiten(2e-4, 1e-3)
    measured = np.flatnonzero(np.diag(whiten))
    assert tuple(measured) == kind.known
    assert len(measured) == kind.numbers
    sigma = np.where(measured < 3, 1e-3, 2e-4)
    np.testing.assert_allclose(np.diag(whiten)[measured], 1 / sigma)
    assert kind.turns() == bool(np.any(measured < 3))
    assert kind.shifts() == bool(np.any(measured >= 3))


def test_words_and_keys_of_a_session_are_those_of_kinds():
    assert {kind.observe for kind in kinds_of(ImageKind).values()} == set(OBSERVE_WORDS)
    fields = session_schema().model_fields
    assert all(kind.key in fields for kind in kinds_of(MotorKind).values())


@named(sorted(kinds_of(LinkKind).items()))
def test_keys_of_links_are_in_the_session(kind):
    fields = session_schema().model_fields
    assert kind.key in fields
    assert issubclass(kind.schema, Schema)
    assert kind.unit in DISPLAY_UNITS
    assert not fields[kind.key].is_required()


def test_exact_data_leave_no_residual(example):
    kind, _, _, _, assembled, state = example
    problem = assembled.problem
    value = problem.residuals(state).value[0][:, rows_of(kind, problem)]
    assert value.size
    np.testing.assert_allclose(value, 0.0, atol=1e-6)


def test_derivatives_agree_with_differences(example):
    """Beside the exact state, in directions of all unknowns together."""
    kind, _, _, _, assembled, state = example
    problem, rng = assembled.problem, np.random.default_rng(6)
    linear = problem.linearize(state)
    na, (count, d) = problem.unknowns.count, linear.by_own.shape[1::2]
    size = np.full(na, 1e-4)
    free = problem.free.sum(axis=0) != 0
    size[problem.unknowns.machine] = np.where(free, 1e-4, 0.0)
    rows = rows_of(kind, problem)
    for _ in range(3):
        shared, own = size * rng.normal(size=(1, na)), 1e-4 * rng.normal(size=(1, count, d))
        here = problem.retract(state, shared, own)
        linear = problem.linearize(here)
        step = 1e-3 * size * rng.normal(size=(1, na)), 1e-7 * rng.normal(size=(1, count, d))
        ahead, back = (
            problem.residuals(problem.retract(here, s * step[0], s * step[1])).value[0]
            for s in (1.0, -1.0)
        )
        values = (linear.by_shared[0] @ step[0][0]) + np.einsum(
            "krd,kd->kr", linear.by_own[0], step[1][0]
        )
        linked = problem.link_blocks.linked
        assert not linear.by_own[0, linked].any()
        expected = (ahead - back) / 2
        scale = np.abs(expected[:, rows]).max()
        assert scale > 0
        np.testing.assert_allclose(values[:, rows], expected[:, rows], atol=2e-5 * scale)


def test_residuals_stand_in_standard_deviations(example):
    """With twice the noise, half the residual."""
    kind, machine, data, _, assembled, state = example
    rng = np.random.default_rng(2)
    problem = assembled.problem
    u = problem.unknowns
    own = 1e-4 * rng.normal(
        size=(1, len(state.T_base_platform[0]), problem.layout.own_motion.shape[1])
    )
    shared = np.zeros((1, u.count))
    shared[:, u.linked] = 1e-4 * rng.normal(size=(1, u.n_linked))
    away = problem.retract(state, shared, own)
    poses, edges = data.poses, data.edges
    noisy = replace(
        data,
        joint_noise=2 * data.joint_noise,
        poses=replace(poses, whiten=poses.whiten / 2),
        edges=replace(edges, covariance=4 * edges.covariance),
        links=tuple(replace(links, sigma=2 * links.sigma) for links in data.links),
    )
    other = assemble(machine, noisy, default_gauge(machine)).problem
    rows = rows_of(kind, problem)
    values, expected = (p.residuals(away).value[0][:, rows] for p in (other, problem))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(2 * values, expected, rtol=1e-6, atol=1e-6)


def test_an_estimate_that_starts_at_exact_data_ends_there(example):
    _, machine, data, start, _, _ = example
    estimate = bundle(machine, data, start, robust=False, scale_noise=False)
    assert estimate.statistics.chi2 < 1e-3
    np.testing.assert_allclose(estimate.machine.values, machine.values, atol=1e-6)


def test_data_of_every_kind_are_judged_by_their_group(example):
    """A noise scale far beyond the limit is a reason, under the kind's name."""
    kind, machine, data, start, _, _ = example
    estimate = bundle(machine, data, start, robust=False, scale_noise=False)
    groups = {group.name: group for group in estimate.statistics.groups}
    assert groups[kind.rows].n > 0
    if kind.rows not in estimate.weights:  # readings, whose noise the data give
        return
    scale = {"edges": "noise_scale", "poses": "pose_scale", "links": "link_scale"}[kind.rows]
    statistics = replace(estimate.statistics, **{scale: 2 * UNEXPLAINED_SCALE})
    (one,) = misfit(replace(estimate, statistics=statistics), {kind.rows: [kind.label]})
    assert (one.code, one.level, one.subject) == ("data.misfit", Level.WRONG, kind.label)
    assert kind.label in one.text
    assert not [*misfit(estimate)]
