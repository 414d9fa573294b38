"""From a machine and its measurements to the least-squares problem, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.identify.gauge import Gauge, freedoms
from pkmcal.identify.problem import Measurements, State
from pkmcal.identify.residuals import SHIFT_SIGMA, BatchState, Blocks, Data, Problem
from pkmcal.mechanisms import Machine
from pkmcal.observe.edges import EdgeSet


@dataclass(frozen=True)
class Assembled:
    """A problem and where its rows come from.

    seen : (K,) configurations with at least one edge; only they are in the problem.
    row, place : (N,) of each edge: its configuration among the seen ones, its block there.
    priors : names of the kinds of the prior rows, (c,): drawing, camera or gauge.
    """

    problem: Problem
    seen: Booleans
    row: Integers
    place: Integers
    priors: tuple[str, ...]


def assemble(
    machine: Machine,
    measurements: Measurements,
    gauge: Gauge,
    *,
    use_drawing: bool = True,
    radius_prior: bool = True,
) -> Assembled:
    """The joint problem of one session (B = 1), every edge a block of its own."""
    edges = measurements.edges
    _check(machine, measurements)
    seen = np.bincount(edges.configuration, minlength=len(measurements.joints)) > 0
    row, place = _places(edges, seen)
    shape = (int(seen.sum()), int(place.max()) + 1)
    n_cameras = int(measurements.camera_of_station.max()) + 1
    prior, target, kinds = prior_rows(
        machine,
        gauge,
        measurements.n_stations,
        n_cameras,
        use_drawing,
        radius_prior,
        intrinsics=measurements.intrinsics_factor.shape[-1],
    )
    if measurements.intrinsics_at.size:
        camera = np.array([kind == "camera" for kind in kinds])
        target[camera] = np.pad(-measurements.intrinsics_at, ((0, 0), (1, 0))).ravel()
    blocks = _blocks(machine, measurements, row, place, shape)
    problem = Problem(
        layout=machine.layout,
        drawing=machine.parameters.drawing,
        free=machine.parameters.free_matrix(),
        blocks=blocks,
        data=_data(measurements, seen, blocks, row, place),
        joint_noise=measurements.joint_noise,
        n_stations=measurements.n_stations,
        n_cameras=n_cameras,
        prior=prior,
        prior_target=target,
        frames=freedoms(machine),
    )
    return Assembled(problem, seen, row, place, kinds)


def _check(machine: Machine, measurements: Measurements) -> None:
    edges, joints = measurements.edges, measurements.joints
    if len(edges) == 0:
        raise InputError(
            what="there is no edge to calibrate from",
            next_step="check the photographs, the stations' poses and the tubes of the drawing",
        )
    if joints.shape[-1] != machine.n_joints:
        raise InputError(
            what="the readings do not belong to this machine",
            found=f"{joints.shape[-1]} columns",
            expected=f"{machine.n_joints}, one an actuated leg",
        )
    if edges.configuration.max() >= len(joints) or edges.station.max() >= measurements.n_stations:
        raise InputError(
            what="an edge names a configuration or station that does not exist",
            found=f"{edges.configuration.max()}, {edges.station.max()}",
            expected=f"below {len(joints)}, {measurements.n_stations}",
        )


def _places(edges: EdgeSet, seen: Booleans) -> tuple[Integers, Integers]:
    """Row (configuration among the seen) and place in it of each edge."""
    row = (np.cumsum(seen) - 1)[edges.configuration]
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], row[order])
    place = np.empty(len(edges), dtype=int)
    place[order] = np.arange(len(edges)) - first
    return row, place


def _blocks(
    machine: Machine,
    measurements: Measurements,
    row: Integers,
    place: Integers,
    shape: tuple[int, int],
) -> Blocks:
    edges = measurements.edges
    radius = np.array(
        [machine.layout.radius[j][t] for j, t in zip(edges.leg, edges.tube, strict=True)]
    )

    def spread(values: Integers) -> Integers:
        out = np.zeros(shape, dtype=int)
        out[row, place] = values
        return out

    # padding needs any existing radius; its weight is zero
    tube_radius = np.full(shape, radius[0])
    tube_radius[row, place] = radius
    return Blocks(
        leg=spread(edges.leg),
        station=spread(edges.station),
        camera=spread(np.asarray(measurements.camera_of_station)[edges.station]),
        radius=tube_radius,
        side=spread(edges.side)[..., None],
        present=spread(np.ones(len(edges), dtype=int)).astype(bool),
    )


def _data(
    measurements: Measurements, seen: Booleans, blocks: Blocks, row: Integers, place: Integers
) -> Data:
    edges, shape = measurements.edges, blocks.leg.shape
    factor = measurements.intrinsics_factor
    basis = np.zeros((1, *shape, 1, 3, 2))
    whiten = np.zeros((1, *shape, 2, 2))
    optics = np.zeros((1, *shape, 2, 1 + factor.shape[-1]))
    basis[0, row, place, 0] = edges.basis
    whiten[0, row, place] = np.linalg.inv(np.linalg.cholesky(edges.covariance))
    optics[0, row, place, :, 0] = edges.shift
    if factor.shape[-1]:
        # the measured normals move with the intrinsics; residuals are predicted less measured
        camera = measurements.camera_of_station[edges.station]
        optics[0, row, place, :, 1:] = -edges.by_intrinsics @ factor[camera]
    joints = measurements.joints[None, seen]
    return Data(basis, whiten, optics, joints, blocks.present[None].astype(float))


def prior_rows(
    machine: Machine,
    gauge: Gauge,
    n_stations: int,
    n_cameras: int,
    use_drawing: bool,
    radius_prior: bool = True,
    intrinsics: int = 0,
) -> tuple[Array, Array, tuple[str, ...]]:
    """Rows (c, na) on the shared unknowns, their targets (c,) and kinds.

    Without the drawing the frames are free, so the gauge's constraints stand in as rows: they
    can be met exactly, hence fix the frames and pull on nothing else. ``intrinsics`` unknowns a
    camera stand in units of their prior.
    """
    table, free = machine.parameters, machine.parameters.free_matrix()
    nz = free.shape[1]
    na = nz + 6 * n_stations + n_cameras * (1 + intrinsics)
    first = np.argmax(free, axis=0)
    radius = np.array([table.kinds[k] == "radius" for k in first], dtype=bool)
    held = (radius & radius_prior) | (~radius & use_drawing)
    drawing = np.zeros((int(held.sum()), na))
    drawing[np.arange(len(drawing)), np.flatnonzero(held)] = 1 / table.tolerance[first[held]]
    optics = np.zeros((n_cameras * (1 + intrinsics), na))
    sigma = np.tile([SHIFT_SIGMA] + [1.0] * intrinsics, n_cameras)
    optics[:, nz + 6 * n_stations :] = np.diag(1 / sigma)
    rows, kinds = [drawing, optics], ["drawing"] * len(drawing) + ["camera"] * len(optics)
    if not use_drawing and freedoms(machine).shape[1]:
        c = gauge.constraints(machine) @ free / float(np.mean(table.tolerance[first[~radius]]))
        rows.append(np.concatenate([c, np.zeros((len(c), na - nz))], axis=1))
        kinds += ["gauge"] * len(c)
    prior = np.concatenate(rows)
    return prior, np.zeros(len(prior)), tuple(kinds)


def batch_of(machine: Machine, assembled: Assembled, state: State) -> BatchState:
    """A state as a batch of one, free parameters only."""
    free = machine.parameters.free_matrix()
    z = np.linalg.lstsq(free, state.theta - machine.parameters.drawing, rcond=None)[0]
    width = assembled.problem.n_optics - 1
    known = state.intrinsics if state.intrinsics.shape[-1] == width else np.zeros((0, width))
    intrinsics = np.zeros((len(state.edge_shift), width))
    intrinsics[: len(known)] = known
    return BatchState(
        z[None],
        state.T_camera_base[None],
        state.T_base_platform[assembled.seen][None],
        np.concatenate([state.edge_shift[:, None], intrinsics], axis=1)[None],
    )


def state_of(assembled: Assembled, batch: BatchState, start: State) -> State:
    """The first run of a batch as a state; unseen configurations keep the start's pose."""
    poses = start.T_base_platform.copy()
    poses[assembled.seen] = batch.T_base_platform[0]
    return State(
        assembled.problem.theta(batch)[0],
        batch.T_camera_base[0],
        poses,
        batch.optics[0, :, 0],
        batch.optics[0, :, 1:],
    )
