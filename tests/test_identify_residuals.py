"""The joint residuals: exact Jacobians, signs, whitening, edges that cannot be predicted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import perturb, pose
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import Information, reduced_rows
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.start import start_state
from pkmcal.identify.unknowns import BatchState, Unknowns
from pkmcal.measurements.effects import EDGE_SHIFT, FOCAL_EXCESS, INTRINSICS, SHADING
from pkmcal.mechanisms import load_mechanism
from pkmcal.papers.paper_a import HexapodByAxes
from pkmcal.session.load import load_session
from pkmcal.studies.simulated import joint_problem
from pkmcal.studies.tasks import Batch
from test_identify_scene import FOCAL, guess, make_scene
from test_pose_sessions import make
from test_solver import damped_step


def derivatives(problem, state, shared, own, h=1e-4):
    """Sixth-order central differences along a direction; exact to about 1e-10 of the value."""
    weights = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    total = 0.0
    for k, w in weights.items():
        up = problem.residuals(problem.retract(state, k * h * shared, k * h * own))
        down = problem.residuals(problem.retract(state, -k * h * shared, -k * h * own))
        flat = np.concatenate([(up.value - down.value).ravel(), (up[1] - down[1]).ravel()])
        total = total + w * flat
    return total / h


def check(problem, state, rng, directions=4):
    linear = problem.linearize(state)
    assert np.isfinite(problem.residuals(state).value).all()
    for _ in range(directions):
        # one hundredth: radii are centimetres, so a unit step would leave the model's domain
        shared = 0.01 * rng.normal(size=(state.z.shape[0], problem.unknowns.count))
        own = 0.01 * rng.normal(size=linear.by_own.shape[:2] + linear.by_own.shape[-1:])
        exact = np.concatenate(
            [
                (
                    (linear.by_shared @ shared[:, None, :, None])[..., 0]
                    + (linear.by_own @ own[..., None])[..., 0]
                ).ravel(),
                (shared @ linear.shared_by.T).ravel(),
            ]
        )
        numeric = derivatives(problem, state, shared, own)
        scale = np.abs(exact).max()
        np.testing.assert_allclose(exact, numeric, atol=2e-8 * scale)


def test_jacobian_at_the_nominal_machine():
    rng = np.random.default_rng(0)
    assembled, truth = make_scene(rng, configurations=4, tolerance=0.0).batch(rng)
    check(assembled.problem, truth, rng)


def test_jacobian_at_random_points():
    rng = np.random.default_rng(1)
    assembled, truth = make_scene(rng, runs=3, configurations=4, tolerance=3.0).batch(rng)
    step = 0.02 * rng.normal(size=(3, 4, 6))
    shifted = replace(
        truth,
        T_base_platform=perturb(truth.T_base_platform, step),
        columns=rng.normal(size=(3, 1)),
    )
    check(assembled.problem, shifted, rng)


def test_jacobian_near_a_singular_pose_and_beside_a_leg():
    """The platform turned by 85 degrees, a camera 3 mm beside a leg's surface."""
    rng = np.random.default_rng(2)
    assembled, truth = make_scene(rng, configurations=3, n_stations=1).batch(rng)
    turned = perturb(truth.T_base_platform, np.array([0, 0, np.radians(85), 0, 0, 0]))
    check(assembled.problem, replace(truth, T_base_platform=turned), rng)
    problem = assembled.problem
    ends = problem.closure(truth)
    a, b = ends.a[0, 0, 0], ends.b[0, 0, 0]
    u = (b - a) / np.linalg.norm(b - a)
    lateral = np.cross(u, [0, 0, 1.0])
    beside = 0.5 * (a + b) + 0.017 * lateral / np.linalg.norm(lateral)
    rot = truth.T_camera_base[0, 0, :3, :3]
    near = replace(truth, T_camera_base=pose(rot, -rot @ beside)[None, None])
    linear = problem.linearize(near)
    assert np.isfinite(problem.residuals(near).value).all()
    # curvature grows with 1 / gap, so the differences' step has to shrink
    shared = 1e-5 * rng.normal(size=(1, problem.unknowns.count))
    exact = (linear.by_shared @ shared[:, None, :, None]).ravel()
    numeric = derivatives(problem, near, shared, np.zeros((1, 3, 6)), h=1e-2)[: exact.size]
    np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(exact).max())


def test_jacobian_with_fixed_and_tied_parameters():
    machine = load_mechanism("gough-stewart")
    table = machine.parameters.with_roles(
        fixed=("legs[1].base.center.z", "legs[2].length.offset"),
        tied=(
            ("legs[1].tubes[1].radius", "legs[2].tubes[1].radius", "legs[3].tubes[1].radius"),
            # two parameters of one leg, so that their derivatives add up in one row
            ("legs[4].base.center.x", "legs[4].platform.center.x"),
        ),
    )
    machine = replace(machine, parameters=table)
    rng = np.random.default_rng(3)
    assembled, truth = make_scene(rng, configurations=4, machine=machine).batch(rng)
    check(assembled.problem, truth, rng)


def test_jacobian_of_edges_that_are_whitened_in_pairs():
    rng = np.random.default_rng(4)
    data = HexapodByAxes(poses=3).draw(Batch("hexapod", 2, np.random.SeedSequence(4)))
    problem = joint_problem(data.machine, data, ThreeCentres())
    z = (data.theta - problem.nominal) @ np.linalg.pinv(problem.free).T
    T = np.broadcast_to(data.view.T_camera_base, (2, 3, 4, 4))
    check(problem, BatchState(z, T, data.T_base_platform, np.zeros((2, 1))), rng)


def test_jacobian_of_stations_whose_focal_lengths_breathe():
    """Outward shift of each edge by an unknown of its own, in its rows only."""
    rng = np.random.default_rng(5)
    scene = make_scene(rng, configurations=3)
    case = scene.measurements(rng)
    edges = replace(case.edges, by_focal=rng.normal(size=(len(case.edges), 2)))
    case = replace(case, edges=edges, focal_at=np.zeros(case.n_stations))
    assembled = assemble(scene.machine, case, ThreeCentres())
    stations = guess(rng, scene.T_camera_base)
    state = batch_of(scene.machine, assembled, start_state(scene.machine, case, stations))
    assert assembled.problem.unknowns.columns(FOCAL_EXCESS).size == case.n_stations == 3
    check(assembled.problem, state, rng)


@pytest.mark.parametrize("name", ["h4", "delta"])
def test_jacobian_of_cranks_with_the_noise_that_a_search_holds(name, tmp_path):
    """Away from the closures' zero, where the derivative of the noise matters."""
    make(tmp_path / "session", name, n=6)
    session = load_session(tmp_path / "session")
    measurements = measurements_of(session, Boards())
    start = start_state(session.machine, measurements, np.eye(4)[None])
    assembled = assemble(session.machine, measurements, ThreeCentres())
    state = batch_of(session.machine, assembled, start)
    rng = np.random.default_rng(4)
    turned = perturb(state.T_base_platform, 0.01 * rng.normal(size=(1, 6, 6)))
    held = assembled.problem.as_noisy_as_at(state)
    check(held, replace(state, T_base_platform=turned), rng)


def test_true_values_leave_no_residual():
    rng = np.random.default_rng(5)
    scene = make_scene(rng)
    scene = replace(scene, edge_shift=np.zeros(1))
    machine = scene.machine
    assembled = assemble(machine, scene.measurements(rng, noise=0), ThreeCentres())
    values = assembled.problem.residuals(batch_of(machine, assembled, scene.state()))
    assert np.abs(values.value).max() < 1e-9


def test_whitening_makes_the_noise_standard():
    """Residuals at the truth are the noise itself: unit covariance, [0] by [1] uncorrelated."""
    rng = np.random.default_rng(6)
    assembled, truth = make_scene(rng, runs=40).batch(rng)
    at = assembled.places.edges
    rows = assembled.problem.unweighted(truth).edges[:, at.row, at.place]
    rows = rows.reshape(-1, 2)
    bound = 5 / np.sqrt(len(rows))
    np.testing.assert_allclose(rows.T @ rows / len(rows), np.eye(2), atol=2 * bound)
    assert np.abs(rows.mean(axis=0)).max() < bound


def test_sign_of_the_edge_shift():
    """Image points moved outward by 0.4 px are found as +0.4: outward is away from the leg."""
    rng = np.random.default_rng(7)
    scene = make_scene(rng, configurations=15, tolerance=0.0)
    normal = scene.normal[0]
    basis = tangent_basis(normal, scene.middle[0])
    shift = np.einsum("nij,ni->nj", basis, (moved_outward(normal, scene.middle[0], 1e-3) - normal))
    clean = scene.measurements(rng, noise=0)
    shifted = moved_outward(normal, scene.middle[0], 0.4)
    edges = replace(
        clean.edges,
        normal=shifted,
        basis=tangent_basis(shifted, scene.middle[0]),
        shift=shift / 1e-3,
    )
    measurements = replace(clean, edges=edges)
    start = start_state(scene.machine, measurements, scene.T_camera_base)
    fit = bundle(scene.machine, measurements, start, robust=False, scale_noise=False)
    assert fit.state.columns[EDGE_SHIFT][0] == pytest.approx(0.4, abs=0.02)
    assert fit.state.columns[EDGE_SHIFT][0] / fit.column_sigma(EDGE_SHIFT)[0] > 10


def moved_outward(normal, middle, pixels):
    """Normals refitted to two image points of each edge, moved away from the leg's axis."""
    on_edge = middle - np.sum(middle * normal, axis=-1, keepdims=True) * normal
    across = np.cross(normal, on_edge)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    rays = np.stack([on_edge + s * 0.1 * across for s in (-1, 1)])
    image = rays[..., :2] / rays[..., 2:]
    line = normal[:, :2] / np.linalg.norm(normal[:, :2], axis=-1, keepdims=True)
    # the leg lies where n.p < 0, so its outside is along the normal's image part
    image = image + pixels / FOCAL * line
    rays = np.concatenate([image, np.ones((*image.shape[:-1], 1))], axis=-1)
    n = np.cross(rays[0], rays[1])
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return n * np.sign(np.sum(n * normal, axis=-1, keepdims=True))


def test_an_edge_that_cannot_be_predicted_counts_for_nothing():
    """A station inside a leg of the nominal model: its edges are NaN, all else is solved."""
    rng = np.random.default_rng(8)
    scene = make_scene(rng, configurations=6)
    measurements = scene.measurements(rng)
    assembled = assemble(scene.machine, measurements, ThreeCentres())
    state = batch_of(scene.machine, assembled, scene.state())
    ends = assembled.problem.closure(state)
    inside = 0.5 * (ends.a[0, 0, 0] + ends.b[0, 0, 0])
    T = state.T_camera_base.copy()
    T[0, 2, :3, 3] = -T[0, 2, :3, :3] @ inside
    linear = assembled.problem.linearize(replace(state, T_camera_base=T))
    assert not linear.usable.all()
    assert linear.usable.mean() > 0.5
    for part in (linear.value, linear.by_shared, linear.by_own):
        assert np.isfinite(part).all()
        assert not part[~linear.usable].any()


def test_unknowns_stand_one_after_the_other():
    codes = ((EDGE_SHIFT, 2), (INTRINSICS, 4), (SHADING, 4))
    unknowns = Unknowns(5, n_stations=2, codes=codes, n_mounts=1)
    parts = [
        unknowns.machine,
        unknowns.stations,
        unknowns.of_code(EDGE_SHIFT),
        unknowns.of_code(INTRINSICS),
        unknowns.of_code(SHADING),
        unknowns.mounts,
    ]
    assert [part.stop - part.start for part in parts] == [5, 12, 2, 4, 4, 6]
    columns = np.concatenate([np.arange(part.start, part.stop) for part in parts])
    np.testing.assert_array_equal(columns, np.arange(unknowns.count))
    assert unknowns.columns(EDGE_SHIFT).tolist() == [17, 18]
    assert unknowns.columns(INTRINSICS, "machine").tolist() == [*range(5), 19, 20, 21, 22]
    assert unknowns.columns(FOCAL_EXCESS).size == 0


def test_reduced_rows_are_the_least_squares_of_the_unknowns_kept():
    """The machine's step by them is its part of the whole problem's step, nothing known of it."""
    rng = np.random.default_rng(12)
    assembled, truth = make_scene(rng, configurations=8).batch(rng, use_prior=False)
    problem, state = assembled.problem, replace(truth, z=0 * truth.z)
    machine = problem.unknowns.machine
    info = Information(problem, state)
    rows, value = reduced_rows(info, ("machine",), silent=())
    step = -np.linalg.lstsq(rows, value, rcond=None)[0]
    whole, _ = damped_step(problem.linearize(state), np.zeros(1))
    np.testing.assert_allclose(step, whole[0, machine], atol=1e-7)
    queries, _ = reduced_rows(info, ("machine",))
    assert len(queries) == len(rows) - problem.prior[:, machine].any(axis=1).sum()


@pytest.mark.parametrize("direction", [0.02, 1e-5])
def test_a_long_step_ends_where_the_readings_allow_it(direction):
    """Legs become longer where their ends go across: there poses are moved back, and only there."""
    rng = np.random.default_rng(14)
    assembled, state = make_scene(rng, configurations=4).batch(rng)
    problem, noise = assembled.problem, assembled.problem.joint_noise.min()
    own = direction * rng.normal(size=(1, 4, 6))
    before = problem.closure(state).rows
    meant = before.value + (before.by_pose @ own[..., None])[..., 0]
    straight = replace(state, T_base_platform=perturb(state.T_base_platform, own))
    shifted = problem.retract(state, np.zeros((1, problem.unknowns.count)), own)
    bent = np.abs(problem.closure(straight).rows.value - meant).max() > 100 * noise
    assert bent == (direction > 1e-3)
    assert np.abs(problem.closure(shifted).rows.value - meant).max() < noise
    assert np.array_equal(shifted.T_base_platform, straight.T_base_platform) == (not bent)


def test_rows_by_held_parameters():
    """Opened, every parameter is an unknown; the residuals are what they were."""
    rng = np.random.default_rng(13)
    assembled, truth = make_scene(rng, configurations=4).batch(rng)
    problem = assembled.problem
    wide, there = problem.opened(truth)
    before, after = problem.linearize(truth), wide.linearize(there)
    np.testing.assert_allclose(after.value, before.value, atol=1e-9)
    np.testing.assert_allclose(after.shared_value, before.shared_value, atol=1e-9)
    by_free = after.by_shared[..., wide.unknowns.machine] @ problem.free
    scale = np.abs(by_free).max()
    np.testing.assert_allclose(
        by_free, before.by_shared[..., problem.unknowns.machine], atol=1e-12 * scale
    )
    np.testing.assert_array_equal(
        after.by_shared[..., wide.unknowns.stations],
        before.by_shared[..., problem.unknowns.stations],
    )
