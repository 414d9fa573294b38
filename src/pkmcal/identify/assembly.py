"""From a machine and its measurements to the least-squares problem, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import Gauge, exact_moves, frame_rows, freedoms
from pkmcal.identify.problem import Problem
from pkmcal.identify.rows import Blocks, Data, PoseBlocks, PoseData
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine


@dataclass(frozen=True)
class Assembled:
    """A problem and where its rows come from.

    seen : (K,) configurations with at least one edge, or pose of a board on the platform; only
    they are in the problem. row, place : (N,) of each edge: its configuration among the seen ones,
    its block there. pose_row, pose_place : the same of the boards' poses.
    priors : names of the kinds of the prior rows, (c,): drawing, camera or gauge.
    """

    problem: Problem
    seen: Booleans
    row: Integers
    place: Integers
    pose_row: Integers
    pose_place: Integers
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
    seen = seen_configurations(measurements)
    row, place = _places(edges.configuration, seen)
    line = _lines(measurements)
    shape = (int(seen.sum()), int(place.max(initial=-1)) + 1)
    pose_row, pose_place = _pose_places(measurements, seen)
    n_cameras = int(measurements.camera_of_station.max()) + 1
    prior, target, kinds = prior_rows(
        machine,
        gauge,
        measurements.n_stations,
        n_cameras,
        use_drawing,
        radius_prior,
        intrinsics=measurements.intrinsics_factor.shape[-1],
        on_platform=measurements.on_platform,
        n_lines=int(line.max(initial=-1)) + 1,
    )
    if measurements.intrinsics_at.size:
        camera = np.array([kind == "camera" for kind in kinds])
        target[camera] = np.pad(-measurements.intrinsics_at, ((0, 0), (1, 0))).ravel()
    blocks = _blocks(machine, measurements, row, place, shape, line)
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
        frames=exact_moves(machine),
        pose_blocks=_pose_blocks(measurements, pose_row, pose_place, shape[0]),
        pose_data=_pose_data(measurements, pose_row, pose_place, shape[0]),
        n_lines=int(line.max(initial=-1)) + 1,
    )
    return Assembled(problem, seen, row, place, pose_row, pose_place, kinds)


def seen_configurations(measurements: Measurements) -> Booleans:
    """(K,) configurations of which something was seen that depends on the platform's pose."""
    poses, n = measurements.poses, len(measurements.joints)
    on_platform = measurements.on_platform[poses.mount]
    rows = np.concatenate([measurements.edges.configuration, poses.configuration[on_platform]])
    return np.bincount(rows, minlength=n) > 0


def _check(machine: Machine, measurements: Measurements) -> None:
    edges, joints = measurements.edges, measurements.joints
    if len(edges) == 0 and len(measurements.poses) == 0:
        raise InputError(
            what="there is neither an edge nor a board's pose to calibrate from",
            next_step="check the photographs, the stations' poses and the tubes of the drawing",
        )
    if joints.shape[-1] != machine.n_joints:
        raise InputError(
            what="the readings do not belong to this machine",
            found=f"{joints.shape[-1]} columns",
            expected=f"{machine.n_joints}, one an actuated leg",
        )
    for items in (edges, measurements.poses):
        configuration = int(items.configuration.max(initial=-1))
        station = int(items.station.max(initial=-1))
        if configuration >= len(joints) or station >= measurements.n_stations:
            raise InputError(
                what="a measurement names a configuration or station that does not exist",
                found=f"{configuration}, {station}",
                expected=f"below {len(joints)}, {measurements.n_stations}",
            )


def _places(configuration: Integers, seen: Booleans) -> tuple[Integers, Integers]:
    """Row (configuration among the seen) and place in it of each measurement."""
    row = np.maximum(np.cumsum(seen) - 1, 0)[configuration]
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], row[order])
    place = np.empty(len(row), dtype=int)
    place[order] = np.arange(len(row)) - first
    return row, place


def _pose_places(measurements: Measurements, seen: Booleans) -> tuple[Integers, Integers]:
    """The same of boards' poses; those on the base hang on no configuration, so the nearest row
    serves where theirs is not seen.
    """
    return _places(measurements.poses.configuration, seen)


def _pose_blocks(
    measurements: Measurements, row: Integers, place: Integers, n_rows: int
) -> PoseBlocks:
    shape = (n_rows, int(place.max(initial=-1)) + 1)
    station, mount, camera = np.zeros((3, *shape), dtype=int)
    present = np.zeros(shape, dtype=bool)
    station[row, place] = measurements.poses.station
    mount[row, place] = measurements.poses.mount
    camera[row, place] = measurements.camera_of_station[measurements.poses.station]
    present[row, place] = True
    return PoseBlocks(station, mount, present, measurements.on_platform, camera)


def _pose_data(measurements: Measurements, row: Integers, place: Integers, n_rows: int) -> PoseData:
    shape = (1, n_rows, int(place.max(initial=-1)) + 1)
    target = np.broadcast_to(np.eye(4), (*shape, 4, 4)).copy()
    whiten, weight = np.zeros((*shape, 6, 6)), np.zeros(shape)
    target[0, row, place] = measurements.poses.T_station_target
    whiten[0, row, place] = measurements.poses.whiten
    weight[0, row, place] = 1.0
    return PoseData(target, whiten, weight, _pose_optics(measurements, row, place, shape))


def _pose_optics(
    measurements: Measurements, row: Integers, place: Integers, shape: tuple[int, ...]
) -> Array:
    """Change of the poses' errors by their camera's unknowns; its edge shift moves no corner."""
    poses, factor = measurements.poses, measurements.intrinsics_factor
    out = np.zeros((*shape, 6, 1 + factor.shape[-1]))
    n = poses.by_intrinsics.shape[-1]
    if factor.shape[-1] and n:
        camera = np.asarray(measurements.camera_of_station)[poses.station]
        out[0, row, place, :, 1:] = -poses.by_intrinsics @ factor[camera, :n]
    return out


def _lines(measurements: Measurements) -> Integers:
    """Number (N,) of each edge's line: station, leg, tube and side; none if nothing is shaded."""
    if not measurements.shaded:
        return np.zeros(0, dtype=int)
    e = measurements.edges
    keys = np.stack([e.station, e.leg, e.tube, e.side], axis=1)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def _blocks(
    machine: Machine,
    measurements: Measurements,
    row: Integers,
    place: Integers,
    shape: tuple[int, int],
    line: Integers,
) -> Blocks:
    edges = measurements.edges
    radius = np.array(
        [machine.layout.radius[j][t] for j, t in zip(edges.leg, edges.tube, strict=True)],
        dtype=int,
    )

    def spread(values: Integers) -> Integers:
        out = np.zeros(shape, dtype=int)
        out[row, place] = values
        return out

    # padding needs any existing radius; its weight is zero
    tube_radius = np.full(shape, radius[0] if len(radius) else 0)
    tube_radius[row, place] = radius
    return Blocks(
        leg=spread(edges.leg),
        station=spread(edges.station),
        camera=spread(np.asarray(measurements.camera_of_station)[edges.station]),
        radius=tube_radius,
        side=spread(edges.side)[..., None],
        present=spread(np.ones(len(edges), dtype=int)).astype(bool),
        line=spread(line) if len(line) else np.zeros((0, 0), dtype=int),
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
    if factor.shape[-1] and len(edges):
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
    on_platform: Booleans | None = None,
    n_lines: int = 0,
) -> tuple[Array, Array, tuple[str, ...]]:
    """Rows (c, na) on the shared unknowns, their targets (c,) and kinds.

    Without the drawing the frames are free, so the gauge's constraints stand in as rows: they
    can be met exactly, hence fix the frames and pull on nothing else. ``intrinsics`` unknowns a
    camera stand in units of their prior. on_platform : (M,) mounts; see :func:`_mount_rows`.
    """
    moving = np.zeros(0, dtype=bool) if on_platform is None else on_platform
    table, free = machine.parameters, machine.parameters.free_matrix()
    nz = free.shape[1]
    lines_at = nz + 6 * n_stations + n_cameras * (1 + intrinsics)
    mounts_at = lines_at + n_lines
    na = mounts_at + 6 * len(moving)
    first, tolerance = table.first_of_free(), table.tolerances_free()
    radius = np.array([table.kinds[k] == "radius" for k in first], dtype=bool)
    held = (radius & radius_prior) | (~radius & use_drawing)
    drawing = np.zeros((int(held.sum()), na))
    drawing[np.arange(len(drawing)), np.flatnonzero(held)] = 1 / tolerance[held]
    optics = np.zeros((n_cameras * (1 + intrinsics), na))
    sigma = np.tile([SHIFT_SIGMA] + [1.0] * intrinsics, n_cameras)
    optics[:, nz + 6 * n_stations : lines_at] = np.diag(1 / sigma)
    shading = np.zeros((n_lines, na))
    shading[:, lines_at:mounts_at] = np.eye(n_lines) / SHADING_SIGMA
    mounts = _mount_rows(machine, moving, na)
    rows = [drawing, optics, shading, mounts]
    kinds = ["drawing"] * len(drawing) + ["camera"] * len(optics) + ["shading"] * n_lines
    kinds += ["mount"] * len(mounts)
    if not use_drawing and freedoms(machine).shape[1]:
        c = frame_rows(machine, gauge) @ free / float(np.mean(tolerance[~radius]))
        rows.append(np.concatenate([c, np.zeros((len(c), na - nz))], axis=1))
        kinds += ["gauge"] * len(c)
    prior = np.concatenate(rows)
    return prior, np.zeros(len(prior)), tuple(kinds)


def _mount_rows(machine: Machine, on_platform: Booleans, na: int) -> Array:
    """What is on a platform is as near its start as the machine is large, rows (3 M', na).

    Where a platform turns about one axis, nothing tells along it how high the board sits; its tilt
    by a tenth of a degree then seems to, and would carry the board off by metres.
    """
    moving = np.flatnonzero(on_platform)
    rows = np.zeros((3 * len(moving), na))
    if not len(moving):
        return rows
    lift = machine.home()[:3, 3] - machine.base_centers().mean(axis=0)
    size = np.linalg.norm(lift) + np.linalg.norm(machine.platform_centers(), axis=-1).max()
    at = na - 6 * len(on_platform) + 6 * moving[:, None] + [3, 4, 5]
    rows[np.arange(len(rows)), at.ravel()] = 1 / size
    return rows


def batch_of(machine: Machine, assembled: Assembled, state: State) -> BatchState:
    """A state as a batch of one, free parameters only."""
    z = machine.parameters.to_free(state.theta)
    width = assembled.problem.n_optics - 1
    known = state.intrinsics if state.intrinsics.shape[-1] == width else np.zeros((0, width))
    intrinsics = np.zeros((len(state.edge_shift), width))
    intrinsics[: len(known)] = known
    return BatchState(
        z[None],
        state.T_camera_base[None],
        state.T_base_platform[assembled.seen][None],
        np.concatenate([state.edge_shift[:, None], intrinsics], axis=1)[None],
        state.T_mount[None],
        _internal(machine, state)[assembled.seen][None],
        np.zeros((1, assembled.problem.n_lines)),
    )


def _internal(machine: Machine, state: State) -> Array:
    """The state's internal coordinates (K, n), zero where it has none."""
    shape = (len(state.T_base_platform), machine.layout.n_internal)
    return state.internal if state.internal.shape == shape else np.zeros(shape)


def state_of(assembled: Assembled, batch: BatchState, start: State) -> State:
    """The first run of a batch as a state; unseen configurations keep the start's pose."""
    poses = start.T_base_platform.copy()
    poses[assembled.seen] = batch.T_base_platform[0]
    internal = np.zeros((len(poses), batch.internal.shape[-1]))
    if start.internal.shape == internal.shape:
        internal[:] = start.internal
    internal[assembled.seen] = batch.internal[0]
    return State(
        assembled.problem.theta(batch)[0],
        batch.T_camera_base[0],
        poses,
        batch.optics[0, :, 0],
        batch.optics[0, :, 1:],
        batch.T_mount[0],
        assembled.problem.pose_blocks.on_platform,
        internal,
    )
