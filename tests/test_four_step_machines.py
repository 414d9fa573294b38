"""[A]'s four steps, the whole chain, on every kind of machine: exact without noise.

The scene here is a machine with errors drawn from its tolerances, moved by its own readings, so
that its joints' equations hold; edges without noise, as planes. Other modules import it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import apply, look_at, perturb
from pkmcal.identify.four_step import four_step
from pkmcal.identify.gauge import apply as in_gauge
from pkmcal.identify.gauge import centre_index, default_gauge
from pkmcal.identify.problem import Measurements, Mount, State
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.mechanisms.limbs import limb_ends
from pkmcal.observe.edges import EdgeSet
from pkmcal.observe.poses import PoseSet

MACHINES = ("gough-stewart", "3-rpr", "3-rps", "3-upu", "6-spu-passive", "constant-legs")
NOISE = 1e-4
JOINT_NOISE = 3e-6


@dataclass(frozen=True)
class Scene:
    """The drawing, the true machine, all true unknowns, and what was measured of them."""

    drawing: Machine
    truth: State
    measurements: Measurements

    @property
    def machine(self) -> Machine:
        """The true machine."""
        return self.drawing.with_values(self.truth.theta)

    def select(self, keep) -> Measurements:
        """The measurements with the edges that a mask picks."""
        return replace(self.measurements, edges=self.measurements.edges.select(keep))


def true_machine(drawing: Machine, rng, size: float = 1.0, parallel: bool = True) -> Machine:
    """Errors of ``size`` tolerances on all but the radii. ``parallel`` : both axes of a
    universal-universal leg turn alike, so that the machine translates."""
    table = drawing.parameters
    free = table.free_matrix()
    z = size * table.tolerances_free() * rng.normal(size=free.shape[1])
    z[[table.kinds[k] == "radius" for k in table.first_of_free()]] = 0
    theta = table.drawing + free @ z
    both = (drawing.layout.base_axis[:, 0] >= 0) & (drawing.layout.platform_axis[:, 0] >= 0)
    if parallel and both.any():
        theta[drawing.layout.platform_axis[both]] = theta[drawing.layout.base_axis[both]]
    return drawing.with_values(table.unit_axes(theta))


def stations(machine: Machine, n: int, distance: float = 0.9) -> np.ndarray:
    """Cameras on a circle that look at the machine from above."""
    middle = 0.5 * machine.home()[:3, 3] + np.array([0, 0, 0.05])
    angles = 0.3 + np.arange(n) * 2 * np.pi / n
    places = distance * np.stack([np.cos(angles), np.sin(angles), 0.7 + 0 * angles], axis=-1)
    return np.stack([look_at(middle + p, middle, np.array([0, 0, 1.0])) for p in places])


def readings_of(machine: Machine, rng, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (n, m) in the ranges at which the machine closes, and its poses there."""
    low, high = machine.joint_ranges.T
    q = rng.uniform(low, high, (6 * n, len(low)))
    found = machine.forward_result(q)
    good = np.flatnonzero(found.converged & (found.singularity > 0.1))[:n]
    assert len(good) == n
    return q[good], found.T_base_platform[good]


def make_scene(name, rng, configurations=12, n_stations=3, shared=True, **errors) -> Scene:
    """``shared`` : all stations photograph every configuration, else each its own."""
    drawing = name if isinstance(name, Machine) else load_mechanism(name)
    machine = true_machine(drawing, rng, **errors)
    joints, poses = readings_of(machine, rng, configurations)
    T = stations(drawing, n_stations)
    grid = np.meshgrid(
        np.arange(n_stations), np.arange(configurations), np.arange(machine.n_legs), [0, 1],
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
    truth = State(machine.values, T, poses, np.zeros(1))
    return Scene(drawing, in_gauge(drawing, truth, default_gauge(drawing)), measurements)


def true_edges(machine, T, joints, poses, index) -> EdgeSet:
    station, configuration, leg, side = index
    ends = limb_ends(machine.layout, machine.values, joints, poses)
    a = apply(T[station], np.broadcast_to(ends.a, ends.b.shape)[configuration, leg])
    b = apply(T[station], ends.b[configuration, leg])
    radius = np.array([r[0] for r in machine.radii()])[leg]
    normal = edge_normal_jacobians(a, b, radius, side).n
    n = len(station)
    return EdgeSet(
        station, configuration, leg, np.zeros(n, dtype=int), side, normal,
        tangent_basis(normal, 0.5 * (a + b)), np.tile(NOISE**2 * np.eye(2), (n, 1, 1)),
        np.zeros((n, 2)), np.zeros((n, 2)),
    )


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


def assert_same(found: State, truth: State, atol=1e-8):
    np.testing.assert_allclose(found.theta, truth.theta, atol=atol)
    np.testing.assert_allclose(found.T_camera_base, truth.T_camera_base, atol=atol)
    np.testing.assert_allclose(found.T_base_platform, truth.T_base_platform, atol=atol)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("name", [m for m in MACHINES if m != "3-upu"])
def test_the_chain_is_exact_without_noise(name, shared):
    scene = make_scene(name, np.random.default_rng(1), 24, shared=shared)
    found = four_step(scene.drawing, scene.measurements)
    assert_same(found, scene.truth)
    # and the errors that it found are those of the tolerances, not nothing
    assert np.abs(scene.truth.theta - scene.drawing.values).max() > 1e-3


def test_three_upu():
    """Centres, offsets and the difference of each leg's axes; their common turn stays drawn."""
    scene = make_scene("3-upu", np.random.default_rng(2), 24)
    found = four_step(scene.drawing, scene.measurements)
    layout, theta, truth = scene.drawing.layout, found.theta, scene.truth.theta
    plain = np.array([kind != "axis" for kind in scene.drawing.parameters.kinds])
    np.testing.assert_allclose(theta[plain], truth[plain], atol=1e-8)
    np.testing.assert_allclose(found.T_camera_base, scene.truth.T_camera_base, atol=1e-8)
    # the platform of this machine does not turn: its frame stands at one angle to the base's
    rot = scene.truth.T_base_platform[:, :3, :3]
    np.testing.assert_allclose(rot, np.broadcast_to(rot[0], rot.shape), atol=1e-12)

    def axes(values):
        return values[layout.base_axis], values[layout.platform_axis] @ rot[0].T

    v, w = axes(theta)
    true_v, true_w = axes(truth)
    np.testing.assert_allclose(v - w, true_v - true_w, atol=1e-8)
    drawn_v, drawn_w = axes(scene.drawing.values)
    np.testing.assert_allclose(v + w, drawn_v + drawn_w, atol=2e-4)
    assert np.abs(true_v + true_w - drawn_v - drawn_w).max() > 2e-3
    np.testing.assert_allclose(found.T_base_platform, scene.truth.T_base_platform, atol=1e-8)


def test_three_upu_whose_platform_turns():
    """Axes that are not parallel turn the platform a little, and without noise that tells all."""
    scene = make_scene("3-upu", np.random.default_rng(5), 40, parallel=False, size=4.0)
    assert_same(four_step(scene.drawing, scene.measurements), scene.truth, atol=1e-6)


@pytest.mark.parametrize("name", MACHINES)
def test_the_printed_form_runs_on_every_machine(name):
    """Noise-free, its lengths are right; what lies across coplanar joints need not be."""
    scene = make_scene(name, np.random.default_rng(3), 24, parallel=True)
    found = four_step(scene.drawing, scene.measurements, form="printed")
    rod = scene.drawing.layout.rod
    rod = rod[rod >= 0]
    np.testing.assert_allclose(found.theta[rod], scene.truth.theta[rod], atol=1e-7)
    flat = centre_index(scene.drawing.layout)[0][:, :2]
    np.testing.assert_allclose(found.theta[flat], scene.truth.theta[flat], atol=2e-3)


@pytest.mark.parametrize("name", MACHINES)
def test_a_start_from_anywhere(name):
    """No first guess: the base frame of the cameras may lie anywhere."""
    scene = make_scene(name, np.random.default_rng(4), 16)
    turn = perturb(np.eye(4), np.array([0.4, -0.8, 1.1, 0, 0, 0]))[:3, :3]
    edges = scene.measurements.edges
    turned = replace(edges, normal=edges.normal @ turn.T, basis=turn @ edges.basis)
    found = four_step(scene.drawing, replace(scene.measurements, edges=turned))
    np.testing.assert_allclose(
        found.T_camera_base[:, :3, :3], turn @ scene.truth.T_camera_base[:, :3, :3], atol=1e-7
    )
