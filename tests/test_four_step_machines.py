"""[A]'s four steps, the whole chain, on every kind of machine: exact without noise.

The scene here is a machine with errors drawn from its tolerances, moved by its own readings, so
that its joints' equations hold; edges without noise, as planes. Other modules import it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from conftest import slow_but
from faults import raises
from pkmcal.calibration.refinement import initial_guess
from pkmcal.errors import ResultError
from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import apply, look_at, perturb
from pkmcal.identify.bundle import bundle
from pkmcal.identify.gauge import centre_index, default_gauge, in_gauge
from pkmcal.identify.methods import estimates
from pkmcal.identify.methods.four_step import four_step
from pkmcal.identify.start import edge_misfit, start_state
from pkmcal.identify.state import State
from pkmcal.measurements import EdgeSet, Measurements, Mount, PoseSet
from pkmcal.mechanisms import (
    Machine,
    catalogue,
    load_mechanism,
    machine_from_document,
    mechanism_text,
    with_exact_scales,
)
from pkmcal.mechanisms.closure import limb_ends

MACHINES = ("gough-stewart", "3-rpr", "3-rps", "3-upu", "6-spu-passive", "constant-legs")
NOISE = 1e-4
JOINT_NOISE = 3e-6


@dataclass(frozen=True)
class Scene:
    """Nominal model, true machine, all true unknowns, and their measurements."""

    nominal: Machine
    truth: State
    measurements: Measurements

    @property
    def machine(self) -> Machine:
        """The true machine."""
        return self.nominal.with_values(self.truth.theta)

    def select(self, keep) -> Measurements:
        """The measurements with the edges that a mask picks."""
        return replace(self.measurements, edges=self.measurements.edges.select(keep))


def true_machine(nominal: Machine, rng, size: float = 1.0, parallel: bool = True) -> Machine:
    """Errors of ``size`` tolerances on all but the radii.

    parallel : both axes of a universal-universal leg are rotated equally, so that the machine
    translates.
    """
    table = nominal.parameters
    free = table.free_matrix()
    z = size * table.tolerances_free() * rng.normal(size=free.shape[1])
    z[[table.kinds[k] == "radius" for k in table.first_of_free()]] = 0
    theta = table.nominal + free @ z
    both = (nominal.layout.base_axis[:, 0] >= 0) & (nominal.layout.platform_axis[:, 0] >= 0)
    if parallel and both.any():
        theta[nominal.layout.platform_axis[both]] = theta[nominal.layout.base_axis[both]]
    return nominal.with_values(table.unit_axes(theta))


def stations(machine: Machine, n: int, distance: float = 0.9) -> np.ndarray:
    """Cameras on a circle, directed at the machine from above."""
    middle = 0.5 * machine.home()[:3, 3] + np.array([0, 0, 0.05])
    angles = 0.3 + np.arange(n) * 2 * np.pi / n
    places = distance * np.stack([np.cos(angles), np.sin(angles), 0.7 + 0 * angles], axis=-1)
    return np.stack([look_at(middle + p, middle, np.array([0, 0, 1.0])) for p in places])


def readings_of(machine: Machine, rng, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (n, m) in the ranges at which the machine closes, and its poses there."""
    low, high = machine.joint_ranges.T
    q = rng.uniform(low, high, (6 * n, len(low)))
    fk = machine.forward_result(q)
    good = np.flatnonzero(fk.converged & (fk.singularity > 0.1))[:n]
    assert len(good) == n
    return q[good], fk.T_base_platform[good]


def make_scene(
    name, rng, configurations=12, n_stations=3, shared=True, joints=None, **errors
) -> Scene:
    """Images of the session; shared : all stations have images of every configuration, else each
    its own.
    """
    nominal = name if isinstance(name, Machine) else load_mechanism(name)
    # the four steps have no scales
    nominal = machine_from_document(with_exact_scales(nominal.document))
    machine = true_machine(nominal, rng, **errors)
    if joints is None:
        joints, poses = readings_of(machine, rng, configurations)
    else:
        configurations, poses = len(joints), machine.forward(joints)
    T = stations(nominal, n_stations)
    grid = np.meshgrid(
        np.arange(n_stations),
        np.arange(configurations),
        np.arange(machine.n_legs),
        [0, 1],
        indexing="ij",
    )
    station, configuration, leg, side = (g.ravel() for g in grid)
    if not shared:
        own = configuration % n_stations == station
        station, configuration, leg, side = (g[own] for g in (station, configuration, leg, side))
    edges = true_edges(machine, T, joints, poses, (station, configuration, leg, side))
    measurements = Measurements(
        edges, joints, JOINT_NOISE, n_stations, np.zeros(n_stations, dtype=int)
    )
    truth = State(machine.values, T, poses)
    return Scene(nominal, in_gauge(nominal, truth, default_gauge(nominal)), measurements)


def true_edges(machine, T, joints, poses, index) -> EdgeSet:
    station, configuration, leg, side = index
    ends = limb_ends(machine.layout, machine.values, joints, poses)
    a = apply(T[station], np.broadcast_to(ends.a, ends.b.shape)[configuration, leg])
    b = apply(T[station], ends.b[configuration, leg])
    radius = np.array([r[0] for r in machine.radii()])[leg]
    normal = edge_normal_jacobians(a, b, radius, side).n
    n = len(station)
    return EdgeSet(
        station,
        configuration,
        leg,
        np.zeros(n, dtype=int),
        side,
        normal,
        tangent_basis(normal, 0.5 * (a + b)),
        np.tile(NOISE**2 * np.eye(2), (n, 1, 1)),
        np.zeros((n, 2)),
        np.zeros((n, 2)),
    )


def noisy(measurements: Measurements, rng, size: float = 1.0) -> Measurements:
    """The measurements with the noise that they state."""
    edges = measurements.edges
    move = (edges.basis @ (size * NOISE * rng.normal(size=(len(edges), 2, 1))))[..., 0]
    normal = edges.normal + move
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    joints = measurements.joints + size * JOINT_NOISE * rng.normal(size=measurements.joints.shape)
    return replace(measurements, edges=replace(edges, normal=normal), joints=joints)


def with_boards(scene: Scene, T_body_board, bodies, sees) -> Measurements:
    """Poses of boards fixed to ``bodies``; ``sees`` are pairs (station, board)."""
    truth = scene.truth
    rows = [(s, k, m) for s, m in sees for k in range(len(truth.T_base_platform))]
    station, configuration, mount = np.array(rows).T
    moving = np.array([body == "platform" for body in bodies])[mount]
    body = np.where(moving[:, None, None], truth.T_base_platform[configuration], np.eye(4))
    T = truth.T_camera_base[station] @ body @ np.asarray(T_body_board)[mount]
    poses = PoseSet(station, configuration, mount, T, np.tile(1e4 * np.eye(6), (len(T), 1, 1)))
    mounts = tuple(Mount(f"board {m}", body) for m, body in enumerate(bodies))
    return replace(scene.measurements, poses=poses, mounts=mounts)


def assert_same(value: State, truth: State, atol=1e-8):
    np.testing.assert_allclose(value.theta, truth.theta, atol=atol)
    np.testing.assert_allclose(value.T_camera_base, truth.T_camera_base, atol=atol)
    np.testing.assert_allclose(value.T_base_platform, truth.T_base_platform, atol=atol)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("name", [m for m in MACHINES if m != "3-upu"])
def test_the_chain_is_exact_without_noise(name, shared):
    scene = make_scene(name, np.random.default_rng(1), 24, shared=shared)
    value = four_step(scene.nominal, scene.measurements)
    assert_same(value, scene.truth)
    # and the errors that it found are those of the tolerances, not nothing
    assert np.abs(scene.truth.theta - scene.nominal.values).max() > 1e-3


def test_three_upu():
    """Centres, offsets and the difference of each leg's axes; their common turn stays drawn."""
    scene = make_scene("3-upu", np.random.default_rng(2), 24)
    value = four_step(scene.nominal, scene.measurements)
    layout, theta, truth = scene.nominal.layout, value.theta, scene.truth.theta
    plain = np.array([kind != "axis" for kind in scene.nominal.parameters.kinds])
    np.testing.assert_allclose(theta[plain], truth[plain], atol=1e-8)
    np.testing.assert_allclose(value.T_camera_base, scene.truth.T_camera_base, atol=1e-8)
    # the platform of this machine does not turn: its frame stands at one angle to the base's
    rot = scene.truth.T_base_platform[:, :3, :3]
    np.testing.assert_allclose(rot, np.broadcast_to(rot[0], rot.shape), atol=1e-12)

    def axes(values):
        return values[layout.base_axis], values[layout.platform_axis] @ rot[0].T

    v, w = axes(theta)
    true_v, true_w = axes(truth)
    np.testing.assert_allclose(v - w, true_v - true_w, atol=1e-8)
    for drawn, wrong in ((v, true_v), (w, true_w)):
        assert np.abs(drawn - wrong).max() > 2e-3
    np.testing.assert_allclose(value.T_base_platform, scene.truth.T_base_platform, atol=1e-8)


def test_three_upu_whose_platform_turns():
    """Axes that are not parallel rotate the platform a little, and without noise that determines
    all.
    """
    scene = make_scene("3-upu", np.random.default_rng(5), 40, parallel=False)
    assert_same(four_step(scene.nominal, scene.measurements), scene.truth, atol=1e-6)


@pytest.mark.parametrize("name", MACHINES)
def test_the_printed_form_runs_on_every_machine(name):
    """Noise-free, its lengths are right; what lies across coplanar joints need not be."""
    scene = make_scene(name, np.random.default_rng(3), 24, parallel=True)
    value = four_step(scene.nominal, scene.measurements, form="printed")
    rod = scene.nominal.layout.rod
    rod = rod[rod >= 0]
    np.testing.assert_allclose(value.theta[rod], scene.truth.theta[rod], atol=1e-7)
    flat = centre_index(scene.nominal.layout)[0][:, :2]
    np.testing.assert_allclose(value.theta[flat], scene.truth.theta[flat], atol=2e-3)


@pytest.mark.parametrize("name", MACHINES)
def test_a_start_from_anywhere(name):
    """No first guess: the base frame of the cameras may lie anywhere."""
    scene = make_scene(name, np.random.default_rng(4), 16)
    turn = perturb(np.eye(4), np.array([0.4, -0.8, 1.1, 0, 0, 0]))[:3, :3]
    edges = scene.measurements.edges
    turned = replace(edges, normal=edges.normal @ turn.T, basis=turn @ edges.basis)
    values = four_step(scene.nominal, replace(scene.measurements, edges=turned))
    np.testing.assert_allclose(
        values.T_camera_base[:, :3, :3], turn @ scene.truth.T_camera_base[:, :3, :3], atol=1e-7
    )


def machine_from(text: str, folder) -> Machine:
    path = folder / "machine.yaml"
    path.write_text(text)
    return load_mechanism(path)


def variant(name: str, folder, *changes) -> Machine:
    """A catalogue machine with parts of its file's text replaced."""
    text = catalogue()[name].read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return machine_from(text, folder)


def three_spr(folder) -> Machine:
    """A 3-RPS upside down: spherical joints on the base, revolute ones on the platform."""
    return variant(
        "3-rps",
        folder,
        ("joint: spherical", "joint: BALL"),
        ("joint: revolute", "joint: HINGE"),
        ("base:", "OTHER:"),
        ("platform:", "base:"),
        ("OTHER:", "platform:"),
        ("joint: BALL", "joint: spherical"),
        ("joint: HINGE", "joint: revolute"),
    )


def test_revolute_axes_on_the_platform(tmp_path):
    scene = make_scene(three_spr(tmp_path), np.random.default_rng(6), 24)
    assert np.isfinite(scene.nominal.platform_axes()).all()
    assert_same(four_step(scene.nominal, scene.measurements), scene.truth)


@pytest.mark.parametrize("name", ["3-rpr", "3-rps", "3-spr"])
def test_a_passive_leg_on_machines_with_axes(name, tmp_path):
    """A fourth leg without a motor, on a machine of three."""
    fourth = (
        "  - base: {joint: spherical, center: [0.05, 0.02, 0.0]}\n"
        "    platform: {joint: universal, center: [0.02, -0.05, 0.0]}\n"
        "    length: {passive: true}\n"
        "    tubes: [{radius: 0.01, from: 0.02, to: 0.2}]\ntolerance:"
    )
    if name == "3-rpr":
        fourth = fourth.replace("0.02, 0.0]", "0.02, 0.1]").replace("-0.05, 0.0]", "-0.05, 0.1]")
        fourth = fourth.replace("spherical", "revolute").replace("universal", "revolute")
    text = catalogue()["3-rpr" if name == "3-rpr" else "3-rps"].read_text()
    if name == "3-spr":
        three_spr(tmp_path)
        text = (tmp_path / "machine.yaml").read_text()
    nominal = machine_from(text.replace("tolerance:", fourth), tmp_path)
    scene = make_scene(nominal, np.random.default_rng(15), 24)
    assert_same(four_step(scene.nominal, scene.measurements), scene.truth)


def test_a_planar_machine_whose_legs_and_frames_stand_at_different_heights(tmp_path):
    nominal = variant(
        "3-rpr",
        tmp_path,
        ("0.3200, 0.1000]", "0.3200, 0.2500]"),
        ("0.0309, 0.1000]", "0.0309, 0.0500]"),
        ("-0.0978, 0.1000]", "-0.0978, -0.1000]"),
        ("0.0669, 0.1000]", "0.0669, -0.1000]"),
        ("tolerance:", "home: {position: [0, 0, 0.2]}\ntolerance:"),
    )
    scene = make_scene(nominal, np.random.default_rng(7), 24)
    assert_same(four_step(scene.nominal, scene.measurements), scene.truth)


def test_a_machine_that_translates(tmp_path):
    """Motion by definition: each image may then have a single leg."""
    nominal = variant("3-upu", tmp_path, ("motion: spatial", "motion: translation"))
    scene = make_scene(nominal, np.random.default_rng(8), 24)
    assert_same(four_step(scene.nominal, scene.measurements), scene.truth)
    flat = four_step(scene.nominal, scene.measurements, form="printed")
    rod = nominal.layout.rod
    np.testing.assert_allclose(flat.theta[rod], scene.truth.theta[rod], atol=1e-7)
    rot = flat.T_base_platform[:, :3, :3]
    np.testing.assert_allclose(rot, np.broadcast_to(rot[0], rot.shape), atol=1e-12)


def test_stations_that_see_two_legs_of_a_planar_machine():
    """Two centres and the plane's normal determine a planar station; the nominal model determines
    its side.
    """
    scene = make_scene("3-rpr", np.random.default_rng(9), 24)
    edges = scene.measurements.edges
    for hidden in ([0, 1, 2], [2, 0, 1]):
        part = scene.select(edges.leg != np.array(hidden)[edges.station])
        assert_same(four_step(scene.nominal, part), scene.truth)


THREE_BY_TWO = np.array([[0, 1], [2, 3], [4, 5]])
THREE_BY_THREE = np.array([[0, 1, 2], [2, 3, 4], [4, 5, 0]])


def visible_legs(scene: Scene, legs) -> np.ndarray:
    edges = scene.measurements.edges
    return (edges.leg[:, None] == legs[edges.station]).any(axis=1)


def test_a_board_on_the_base_joins_stations_that_share_no_legs():
    """[A] 3.3: refused without the board, exact with it; the board's place is found too."""
    rng = np.random.default_rng(10)
    scene = make_scene("gough-stewart", rng, 24)
    boards = perturb(np.eye(4), rng.normal(size=(2, 6)))
    sees = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1)]
    measurements = with_boards(scene, boards, ("base", "platform"), sees)
    for legs, code in (
        (THREE_BY_TWO, "method.few_legs"),
        (THREE_BY_THREE, "method.stations_apart"),
    ):
        edges = measurements.edges.select(visible_legs(scene, legs))
        without = replace(scene.measurements, edges=edges)
        with raises(ResultError, code=code):
            four_step(scene.nominal, without)
        value = four_step(scene.nominal, replace(measurements, edges=edges))
        assert_same(value, scene.truth)
        np.testing.assert_allclose(value.T_mount, boards, atol=1e-7)
        np.testing.assert_array_equal(value.on_platform, [False, True])


def test_two_boards_in_a_chain():
    rng = np.random.default_rng(11)
    scene = make_scene("6-spu-passive", rng, 24)
    boards = perturb(np.eye(4), rng.normal(size=(2, 6)))
    sees = [(0, 0), (1, 0), (1, 1), (2, 1)]
    measurements = with_boards(scene, boards, ("base", "base"), sees)
    legs = np.array([[0, 1, 6], [2, 3, 3], [4, 5, 5]])
    part = replace(measurements, edges=measurements.edges.select(visible_legs(scene, legs)))
    value = four_step(scene.nominal, part)
    assert_same(value, scene.truth)
    np.testing.assert_allclose(value.T_mount, boards, atol=1e-7)


def test_given_poses_join_stations_that_share_no_legs():
    scene = make_scene("gough-stewart", np.random.default_rng(12), 24)
    part = scene.select(visible_legs(scene, THREE_BY_THREE))
    value = four_step(scene.nominal, part, T_camera_base_guess=scene.truth.T_camera_base)
    assert_same(value, scene.truth)


@pytest.mark.parametrize("name", slow_but(("gough-stewart", "3-rps", "6-spu-passive"), MACHINES))
def test_the_bundle_starts_from_the_steps(name):
    """With noise the steps are a start: better than a nominal model with large errors,
    and not NaN.
    """
    rng = np.random.default_rng(13)
    scene = make_scene(name, rng, 24)
    measurements = noisy(scene.measurements, rng)
    values = four_step(scene.nominal, measurements)
    assert np.isfinite(values.theta).all()
    assert np.abs(values.theta - scene.truth.theta).max() < 0.03
    far = scene.nominal.with_values(values.theta)
    reference_values = start_state(scene.nominal, measurements, scene.truth.T_camera_base)
    start = initial_guess(scene.nominal, measurements, reference_values)
    assert edge_misfit(scene.nominal, measurements, start) <= edge_misfit(
        scene.nominal, measurements, reference_values
    )
    best = bundle(scene.nominal, measurements, start)
    again = bundle(scene.nominal, measurements, four_step(far, measurements))
    np.testing.assert_allclose(again.state.theta, best.state.theta, atol=1e-5)


@pytest.mark.parametrize("name", slow_but(("3-rps",), ["3-rpr", "3-rps", "6-spu-passive"]))
def test_the_method_as_a_result_of_its_own(name, tmp_path):
    """``--method four-step``: deviations by repetition, residuals, a mechanism that can be read."""
    rng = np.random.default_rng(14)
    scene = make_scene(name, rng, 24)
    board = perturb(np.eye(4), rng.normal(size=(1, 6)))
    measurements = with_boards(scene, board, ("base",), [(0, 0), (1, 0), (2, 0)])
    measurements = noisy(measurements, rng)
    reference_values = start_state(scene.nominal, measurements, scene.truth.T_camera_base)
    joint = bundle(scene.nominal, measurements, reference_values)
    values = estimates.by_method("four-step", scene.nominal, measurements, joint, repetitions=20)
    sigma = np.sqrt(np.diag(values.covariance))
    free = sigma > 1e-9
    ratio = ((values.state.theta - scene.truth.theta)[free] / sigma[free]) ** 2
    # one draw of correlated parameters: 0.5 to 1.9 over seeds
    assert 0.3 < np.sqrt(np.mean(ratio)) < 2.2
    assert values.pose_residuals.shape == (len(measurements.poses), 6)
    again = machine_from(mechanism_text(values.machine), tmp_path)
    np.testing.assert_allclose(again.values, values.state.theta, atol=1e-12)
