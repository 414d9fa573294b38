"""[B] 14 for all legs and stations jointly, with priors on base, radii and edge shifts.

Leg by leg, the distance of a base centre follows from the apparent width of its tube only: a shift
of both edges by a thousandth of that width changes the distance by a thousandth. Edges have such
shifts, from blur and shading, and no edge of the same leg separates them from distance. The other
legs do: a shift common to all edges scales the whole base, and the nominal model determines the
base to a few thousandths. This is the paper's first way, "solving simultaneously (14) together with
constraints linking the attachment points", with the nominal values and their prior sigmas as
constraints. It contains 15, the stations' poses, and 16, the scale, whose cause (shift or radii)
the data decide. The problem is not linear; the solution leg by leg, which needs no start and
rejects wrong edges, is its start. No reading and nothing that moves enters: platform and offsets
keep their nominal values and prior sigmas.

Rows of the system:

                   machine z   stations   edge shifts (cameras, lines)
    edges       [      X           X             X      ]   n.A + R = 0
    priors      [      1                                ]   nominal model
                [                                1      ]   shifts
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import apply as move
from pkmcal.geometry.rigid import cross, dot, perturb, register
from pkmcal.identify.bundle import BATCH
from pkmcal.identify.gauge import centre_index
from pkmcal.identify.line_shading import common_shading
from pkmcal.identify.methods import linear
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.robust import CLEAN_TAIL_SHARE, LEAST_SCALE, clean_norm
from pkmcal.identify.unknowns import Unknowns
from pkmcal.measurements import SHADING_SIGMA, EdgeSet, Measurements
from pkmcal.measurements.effects import EDGE_SHIFT, SHADING, SHIFT_SIGMA
from pkmcal.mechanisms import Machine
from pkmcal.solver.kernels import FULL_WEIGHT_DISTANCE, NO_WEIGHT_DISTANCE, final_weights

MOST_GAUSS_NEWTON_STEPS, MOST_VARIANCE_ROUNDS = 30, 30
"""Maximum number of Gauss-Newton steps with given variances, and of updates of the variances."""
PREDICTED_MOVE_SETTLED = 1e-6
"""Predicted change of the rows in the last step, relative to the residuals."""
USE_DEFAULT_METHOD = "Use the joint method (bundle), which is the default"
ONE_RESIDUAL_FACTOR = FULL_WEIGHT_DISTANCE / float(
    clean_norm(CLEAN_TAIL_SHARE, np.ones((), dtype=int))
)
"""Factor on the magnitude of one residual, so that as many clean residuals as clean pairs exceed
FULL_WEIGHT_DISTANCE."""


@dataclass(frozen=True)
class BaseSolution:
    """Joint solution of the edges with the nominal model.

    theta : (P,) all parameters; those without edges are nominal.
    T_camera_base : (S, 4, 4).
    spread : (P + 6 S, m) square root of the covariance of parameters and stations (omega, tau), in
        theta's frames.
    edge_shift, edge_shift_sigma : (C,) px.
    shading : (n,) px, standard deviation of each line's own shift.
    weights : (N,) of the edges.
    scale : factor on the edges' stated noise.
    """

    theta: Array
    T_camera_base: Array
    spread: Array
    edge_shift: Array
    edge_shift_sigma: Array
    shading: Array
    weights: Array
    scale: float


def base_together(machine: Machine, measurements: Measurements) -> BaseSolution:
    """Base centres, radii, stations and edge shifts by [B] 14 on all edges, maximum likelihood.

    One equation for each edge, ``n.A + R = 0`` with A = T_camera_base P, its normal n corrected by
    the camera's edge shift and the line's shading, divided by the standard deviation of n.A.
    Priors: the nominal model, 0.3 px for a camera's shift, and for the lines' shifts their common
    standard deviation, which is estimated as in the joint estimate, but for each tube and with a
    lower bound. Raises ResultError if a station sees fewer than three legs in two directions each,
    or if the legs' joints on the base move.
    """
    system = _system(machine, measurements)
    now = system.start
    weight = final_weights(_distance(system, now) * ONE_RESIDUAL_FACTOR) * system.used
    scale = LEAST_SCALE
    shading = np.full(system.unknowns.columns(SHADING).size, SHIFT_SIGMA)
    for _ in range(MOST_VARIANCE_ROUNDS):
        now, half = _solved(system, now, weight, scale, shading)
        residual, jac = _rows(system, now)
        # the noise scale makes chi2 equal to its degrees of freedom, as in the joint estimate
        freedom = np.sum(weight) - np.sum(weight[:, None] * (jac @ half) ** 2) / scale**2
        before = weight, scale, shading
        if freedom > LEAST_NOISE_FREEDOM:
            scale = float(np.sqrt(np.sum(weight * residual**2) / freedom))
            scale = max(scale, LEAST_SCALE)
        # standard deviation of the lines' shading
        if shading.size:
            lines = system.unknowns.of_code(SHADING)
            covariance = half[lines] @ half[lines].T
            shift = now.shifts[measurements.n_cameras :]
            given = shift[None], covariance[None], np.eye(len(shift)), shading[None]
            shading = common_shading(*given, SHADING_SIGMA)[0]
        # weights at the new scale, and convergence of scale, shading and weights
        weight = final_weights(np.abs(residual) / scale * ONE_RESIDUAL_FACTOR) * system.used
        change = np.abs(shading / before[2] - 1).max(initial=0.0) / BATCH.shading_change
        change = max(change, np.abs(weight - before[0]).max() / 1e-2)
        if max(change, abs(scale / before[1] - 1) / 1e-3) < 1:
            break
    now, half = _solved(system, now, weight, scale, shading)
    u = system.unknowns
    return BaseSolution(
        theta=system.theta(now),
        T_camera_base=now.T_camera_base,
        spread=np.concatenate(
            [machine.parameters.free_matrix() @ half[u.machine], half[u.stations]]
        ),
        edge_shift=now.shifts[: measurements.n_cameras],
        edge_shift_sigma=np.sqrt(np.sum(half[u.of_code(EDGE_SHIFT)] ** 2, axis=1)),
        shading=shading,
        weights=weight,
        scale=scale,
    )


class _State(NamedTuple):
    """State of the iteration.

    z : (nz,) deviations of the free parameters from the nominal model.
    T_camera_base : (S, 4, 4).
    shifts : (C + n,) px outward, of cameras and then of lines.
    """

    z: Array
    T_camera_base: Array
    shifts: Array

    def retract(self, step: Array, u: Unknowns) -> _State:
        """Retract the state along a step (na,) of all unknowns."""
        turns = step[u.stations].reshape(-1, 6)
        shifts = self.shifts + step[u.effects]
        return _State(self.z + step[u.machine], perturb(self.T_camera_base, turns), shifts)


@dataclass(frozen=True)
class _System:
    """Constant data of [B] 14: N edges and their columns among parameters and unknowns.

    centre, radius : (N, 3) and (N,) columns of theta.
    shifts : (N, 1 or 2) columns of each edge's shifts.
    noise : (N, 3, 3) covariances of the normals.
    by_shift : (N, 3) their derivatives by an outward shift, per px.
    used : (N,) edges of legs that their station determines.
    start : the first state.
    """

    machine: Machine
    unknowns: Unknowns
    edges: EdgeSet
    centre: Integers
    radius: Integers
    shifts: Integers
    noise: Array
    by_shift: Array
    used: Booleans
    start: _State

    def theta(self, state: _State) -> Array:
        """All parameters, (P,)."""
        table = self.machine.parameters
        return table.nominal + table.free_matrix() @ state.z

    @property
    def believed(self) -> Integers:
        """Columns (c,) of the unknowns with a prior."""
        return np.r_[self.unknowns.machine, self.unknowns.effects]

    def prior(self, shading: Array) -> Array:
        """Prior sigmas (c,) of these unknowns; shading : (n,) px of the lines."""
        shift = np.full(self.unknowns.columns(EDGE_SHIFT).size, SHIFT_SIGMA)
        return np.concatenate([self.machine.parameters.tolerances_free(), shift, shading])


def _system(machine: Machine, measurements: Measurements) -> _System:
    """System with its start: nominal model, stations registered to the leg-by-leg solutions (15).

    Raises ResultError for a machine with moving base joints, and for a station with fewer than
    three legs.
    """
    if any(group.carrier.driven for group in machine.layout.base):
        raise ResultError(
            "[B]'s linear method is for legs that turn about points of the base",
            found=f"mechanism {machine.name!r} with joints on cranks or slides",
            next_step=USE_DEFAULT_METHOD,
            code="method.other_joints",
        )
    edges = measurements.edges
    alone = linear.centres(machine, measurements, "robust")
    finite: Booleans = np.all(np.isfinite(alone.centres), axis=-1)
    if (finite.sum(axis=1) < 3).any():
        raise ResultError(
            "[B]'s linear method needs three legs, each in two directions, at every station",
            found=f"{finite.sum(axis=1).min()} legs at one of them",
            next_step=USE_DEFAULT_METHOD,
            code="method.few_legs",
        )
    # columns of each edge's shifts: its camera's, and its line's if lines are shaded
    n_cameras = measurements.n_cameras
    camera = np.asarray(measurements.camera_of_station)[edges.station]
    shifts = camera[:, None]
    if measurements.shaded:
        keys = np.stack([edges.station, edges.leg, edges.tube, edges.side], axis=1)
        line = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        shifts = np.stack([camera, n_cameras + line], axis=1)
    n_shifts = int(shifts.max()) + 1
    table = machine.parameters
    n_free = table.free_matrix().shape[1]
    system = _System(
        machine=machine,
        unknowns=Unknowns(
            n_free,
            measurements.n_stations,
            ((EDGE_SHIFT, n_cameras), (SHADING, max(n_shifts - n_cameras, 0))),
        ),
        edges=edges,
        centre=centre_index(machine.layout)[0][edges.leg],
        radius=machine.layout.radius_of(edges.leg, edges.tube),
        shifts=shifts,
        noise=edges.basis @ edges.covariance @ edges.basis.mT,
        by_shift=(edges.basis @ edges.shift[..., None])[..., 0],
        used=finite[edges.station, edges.leg],
        start=_State(
            table.to_free(machine.values),
            np.tile(np.eye(4), (measurements.n_stations, 1, 1)),
            np.zeros(n_shifts),
        ),
    )
    return _registered(system, alone.centres, finite)


def _registered(system: _System, centres: Array, valid: Booleans) -> _System:
    """System with each station at the pose that explains the most edges.

    Candidates are registrations of the nominal model to all legs' centres and to those of every
    three legs (15): with few configurations a leg may be an outlier, which would pull a station
    that is fitted to all legs. centres : (S, L, 3) leg by leg. valid : (S, L).
    """
    edges, start = system.edges, system.start
    nominal = system.theta(start)[centre_index(system.machine.layout)[0]]
    best, least = start.T_camera_base.copy(), np.full(len(valid), np.inf)
    # all legs first, then every three legs
    for legs in ((), *combinations(range(len(nominal)), 3)):
        three = np.isin(np.arange(len(nominal)), legs) if legs else np.ones(len(nominal), bool)
        for s, (a, there) in enumerate(zip(centres, valid & three, strict=True)):
            if there.sum() < 3 or (legs and not valid[s][list(legs)].all()):
                continue
            trial = start.T_camera_base.copy()
            trial[s] = register(nominal[there], a[there])
            far = _distance(system, start._replace(T_camera_base=trial))
            cost = np.sum(
                np.minimum(far, NO_WEIGHT_DISTANCE)[system.used & (edges.station == s)] ** 2
            )
            if cost < least[s]:
                best[s], least[s] = trial[s], cost
    start = start._replace(T_camera_base=best)
    return replace(system, start=start)


def _distance(system: _System, state: _State) -> Array:
    """|n.A + R| (N,) in standard deviations at the start.

    The variance is that of the edge's noise, the nominal model's prior sigmas and the edge's
    possible shifts.
    """
    residual, jac = _rows(system, state)
    lines = system.unknowns.columns(SHADING)
    prior = np.square(system.prior(np.full(lines.size, SHIFT_SIGMA)))
    return np.abs(residual) / np.sqrt(1 + jac[:, system.believed] ** 2 @ prior)


def _rows(system: _System, state: _State) -> tuple[Array, Array]:
    """Whitened residuals n.A + R (N,) and their derivatives (N, na).

    The standard deviation of n.A, from the normal's noise, grows with A: without its derivative A
    is biased towards the camera, as in :func:`pkmcal.identify.methods.linear.errors_in_variables`.
    """
    edges, u, theta = system.edges, system.unknowns, system.theta(state)
    station = state.T_camera_base[edges.station]
    point = theta[system.centre]
    a = move(station, point)
    outward = np.sum(state.shifts[system.shifts], axis=1)
    n = edges.normal - outward[:, None] * system.by_shift
    spread = (system.noise @ a[..., None])[..., 0]
    sigma = np.sqrt(np.maximum(dot(a, spread), np.finfo(float).tiny))
    value = (dot(n, a) + theta[system.radius]) / sigma
    by_a = (n - (value / sigma)[:, None] * spread) / sigma[:, None]
    free = system.machine.parameters.free_matrix()
    turn = station[:, :3, :3]
    by = np.zeros((len(value), u.count))
    by[:, u.machine] = free[system.radius] / sigma[:, None]
    by[:, u.machine] += np.einsum("na,nab,nbz->nz", by_a, turn, free[system.centre])
    at = np.arange(len(value))
    arm = (turn @ point[..., None])[..., 0]
    columns = u.stations.start + 6 * edges.station[:, None] + np.arange(6)
    # derivative of A by the station: omega x arm + tau
    by[at[:, None], columns] = np.concatenate([cross(arm, by_a), by_a], axis=1)
    by[at[:, None], u.effects.start + system.shifts] = (-dot(system.by_shift, a) / sigma)[:, None]
    return value, by


def _solved(
    system: _System, state: _State, weight: Array, scale: float, shading: Array
) -> tuple[_State, Array]:
    """Solution for given variances, and a square root (na, na) of its covariance.

    weight : (N,) of the edges.
    scale : of their noise.
    shading : (n,) px of the lines.

    Raises ResultError if the Gauss-Newton steps do not converge.
    """
    u, prior = system.unknowns, system.prior(shading)
    beliefs = np.zeros((len(prior), u.count))
    beliefs[np.arange(len(prior)), system.believed] = 1 / prior
    root = np.sqrt(weight)[:, None] / scale
    for _ in range(MOST_GAUSS_NEWTON_STEPS):
        value, by = _rows(system, state)
        rows = np.concatenate([by * root, beliefs])
        right = np.concatenate([value * root[:, 0], np.append(state.z, state.shifts) / prior])
        size = np.linalg.norm(rows, axis=0)
        q, r = np.linalg.qr(rows / size)
        half = np.linalg.inv(r) / size[:, None]
        step = -half @ (q.T @ right)
        state = state.retract(step, u)
        if np.linalg.norm(q.T @ right) < PREDICTED_MOVE_SETTLED * max(1.0, np.linalg.norm(right)):
            return state, half
    raise ResultError(
        "[B]'s equations of all legs together found no solution",
        found=f"steps that had not settled after {MOST_GAUSS_NEWTON_STEPS}",
        next_step=USE_DEFAULT_METHOD,
    )
