"""Scene that the identification's tests share, made here from first principles.

A batch of B machines with errors drawn from the prior sigmas, and cameras around them: edges with
correlated noise, readings with noise. Importable by the other test modules.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import apply, dot, look_at, perturb
from pkmcal.identify.assembly import Assembled, assemble
from pkmcal.identify.gauge import ThreeCentres
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import EdgeSet, Measurements
from pkmcal.measurements.effects import EDGE_SHIFT, SHADING
from pkmcal.mechanisms import (
    Machine,
    load_mechanism,
    machine_from_document,
    with_exact_scales,
)
from pkmcal.mechanisms.closure import limb_ends, scales

FOCAL = 889.0
JOINT_NOISE = 3e-6


@dataclass(frozen=True)
class Scene:
    """Batch of true machines and their measurements.

    machine : nominal model. theta (B, P), T_camera_base (S, 4, 4), poses (B, K, 4, 4), joints
    (B, K, 6), edge_shift (B,). index : station, configuration, leg, tube, side, (5, N). normal
    (B, N, 3), basis (B, N, 3, 2), covariance (N, 2, 2), shift (N, 2). shading (B, N) px. turned
    (B, N, 2) further rotations of the normals, in that basis.
    """

    machine: Machine
    theta: np.ndarray
    T_camera_base: np.ndarray
    poses: np.ndarray
    joints: np.ndarray
    edge_shift: np.ndarray
    index: np.ndarray
    normal: np.ndarray
    covariance: np.ndarray
    shift: np.ndarray
    middle: np.ndarray
    shading: np.ndarray | None = None
    turned: np.ndarray | float = 0.0

    def state(self, run: int = 0) -> State:
        return State(
            self.theta[run],
            self.T_camera_base,
            self.poses[run],
            {EDGE_SHIFT: self.edge_shift[run : run + 1]},
        )

    def measurements(self, rng, noise: float = 1.0, wrong: float = 0.0, run: int = 0):
        """One run's measurements; ``wrong`` is the share replaced by another leg's edge."""
        normal = self.noisy(rng, noise)[run]
        if wrong:
            normal = self._with_wrong(rng, normal, wrong, run)
        edges = EdgeSet(
            *self.index,
            normal,
            tangent_basis(normal, self.middle[run]),
            self.covariance,
            self.shift,
            np.zeros((len(normal), 2)),
        )
        joints = self.joints[run] + noise * JOINT_NOISE * rng.normal(size=self.joints[run].shape)
        n = len(self.T_camera_base)
        shaded = self.shading is not None
        return Measurements(edges, joints, JOINT_NOISE, n, np.zeros(n, dtype=int), shaded=shaded)

    def noisy(self, rng, noise: float = 1.0) -> np.ndarray:
        """Normals (B, N, 3) with the edge shift and noise drawn from the covariances."""
        basis = tangent_basis(self.normal, self.middle)
        pixels = self.edge_shift[:, None] + (0.0 if self.shading is None else self.shading)
        move = self.shift * pixels[..., None] + self.turned
        chol = np.linalg.cholesky(self.covariance)
        draw = rng.normal(size=(*self.normal.shape[:2], 2, 1))
        move = move + noise * (chol @ draw)[..., 0]
        shifted = self.normal + (basis @ move[..., None])[..., 0]
        return shifted / np.linalg.norm(shifted, axis=-1, keepdims=True)

    def _with_wrong(self, rng, normal, share, run):
        station, configuration, leg = self.index[:3]
        out = normal.copy()
        for i in np.flatnonzero(rng.random(len(normal)) < share):
            same = (station == station[i]) & (configuration == configuration[i])
            others = np.flatnonzero(same & (leg != leg[i]))
            if others.size:
                out[i] = self.normal[run, rng.choice(others)]
        return out

    def batch(self, rng, **options) -> tuple[Assembled, BatchState]:
        """All runs as one problem, and their true states."""
        assembled = assemble(self.machine, self.measurements(rng), ThreeCentres(), **options)
        normal = self.noisy(rng)
        basis = np.zeros((len(normal), *assembled.problem.blocks.present.shape, 1, 3, 2))
        at = assembled.places.edges
        basis[:, at.row, at.place, 0] = tangent_basis(normal, self.middle)
        old = assembled.problem.data
        joints = self.joints + JOINT_NOISE * rng.normal(size=self.joints.shape)
        data = replace(old, basis=basis, joints=joints)
        problem = replace(assembled.problem, data=data)
        z = (self.theta - self.machine.parameters.nominal) @ np.linalg.pinv(problem.free).T
        stations = np.broadcast_to(self.T_camera_base, (len(z), *self.T_camera_base.shape))
        lines = np.zeros((len(z), assembled.problem.unknowns.columns(SHADING).size))
        columns = np.concatenate([self.edge_shift[:, None], lines], axis=1)
        truth = BatchState(z, stations, self.poses, columns)
        return replace(assembled, problem=problem), truth


def stations(n: int, distance: float = 0.9) -> np.ndarray:
    angles = 0.3 + np.arange(n) * 2 * np.pi / n
    return np.stack(
        [
            look_at(
                distance * np.array([np.cos(a), np.sin(a), 0.25]),
                np.array([0, 0, 0.2]),
                np.array([0, 0, 1.0]),
            )
            for a in angles
        ]
    )


def exact(name):
    """Built-in machine with exact readings' scales."""
    return machine_from_document(with_exact_scales(load_mechanism(name).document))


def make_scene(
    rng,
    runs: int = 1,
    configurations: int = 12,
    n_stations: int = 3,
    in_view: float = 0.7,
    tolerance: float = 1.0,
    machine: Machine | None = None,
    noise: float = 1.0,
    reach: float = 1.0,
) -> Scene:
    """Machines with errors of ``tolerance`` times the prior sigmas, in random poses; reach :
    distance from home, in times of 0.25 rad and 40 mm.
    """
    machine = machine or load_mechanism("gough-stewart")
    table = machine.parameters
    free = table.free_matrix()
    sigma = table.tolerance[np.argmax(free, axis=0)]
    theta = table.nominal + (tolerance * sigma * rng.normal(size=(runs, len(sigma)))) @ free.T
    turn = reach * rng.uniform(-0.25, 0.25, (runs, configurations, 3))
    move = reach * rng.uniform(-0.04, 0.04, (runs, configurations, 3))
    poses = perturb(machine.home(), np.concatenate([turn, move], axis=-1))
    ends = limb_ends(machine.layout, theta[:, None], np.zeros((configurations, 6)), poses)
    length = np.linalg.norm(ends.b - ends.a, axis=-1)
    scale_of = scales(machine.layout, theta[:, None])
    index = _index(rng, machine, configurations, n_stations, in_view)
    normal, middle = _edges(machine, theta, stations(n_stations), ends, index)
    n = index.shape[1]
    scale = noise * rng.uniform(0.5, 2.0, (n, 2)) * np.array([0.05, 0.2]) / FOCAL
    covariance = np.zeros((n, 2, 2))
    covariance[:, [0, 1], [0, 1]] = scale**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = 0.4 * scale[:, 0] * scale[:, 1]
    shift = np.stack([rng.uniform(-1.2, -0.8, n), rng.uniform(-0.3, 0.3, n)], axis=-1) / FOCAL
    return Scene(
        machine,
        theta,
        stations(n_stations),
        poses,
        (length - theta[:, None, machine.layout.rod]) / scale_of,
        0.3 * tolerance * rng.normal(size=runs),
        index,
        normal,
        covariance,
        shift,
        middle,
    )


def _index(rng, machine, configurations, n_stations, in_view):
    legs = machine.n_legs
    grid = np.meshgrid(
        np.arange(n_stations),
        np.arange(configurations),
        np.arange(legs),
        [0, 1],
        [0, 1],
        indexing="ij",
    )
    index = np.stack([g.ravel() for g in grid])
    keep = (rng.random((n_stations, configurations, legs)) < in_view)[index[0], index[1], index[2]]
    return index[:, keep]


def _edges(machine, theta, T, ends, index):
    station, configuration, leg, tube, side = index
    a = apply(T[station], ends.a[:, configuration, leg])
    b = apply(T[station], ends.b[:, configuration, leg])
    where = np.array([machine.layout.radius[j][t] for j, t in zip(leg, tube, strict=True)])
    return edge_normal_jacobians(a, b, theta[:, where], side).n, 0.5 * (a + b)


def guess(rng, T: np.ndarray, turn: float = 0.03, move: float = 0.02) -> np.ndarray:
    """Station poses as a person would give them."""
    scale = np.array([turn] * 3 + [move] * 3)
    return perturb(T, scale * rng.normal(size=(len(T), 6)))


def test_scene_edges_touch_the_legs():
    scene = make_scene(np.random.default_rng(0))
    machine = scene.machine.with_values(scene.theta[0])
    a = apply(scene.T_camera_base[scene.index[0]], machine.base_centers()[scene.index[2]])
    radii = machine.radii()
    radius = np.array([radii[j][t] for j, t in zip(scene.index[2], scene.index[3], strict=True)])
    np.testing.assert_allclose(dot(scene.normal[0], a), -radius, atol=1e-14)
