"""From a machine and its measurements to the least-squares problem, and back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import Gauge, exact_moves, frame_rows, freedoms
from pkmcal.identify.link_rows import LinkBlocks, LinkData
from pkmcal.identify.places import Places
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState, Unknowns
from pkmcal.measurements import BREATHING_SIGMA, SHADING_SIGMA, TUBE_CORRELATION, Measurements
from pkmcal.measurements.edges import EdgeBlocks, EdgeData
from pkmcal.measurements.line_cells import LineCells
from pkmcal.measurements.poses import PoseBlocks, PoseData
from pkmcal.measurements.rows import Kinds
from pkmcal.mechanisms import Machine

SHIFT_SIGMA = 0.3
"""Standard deviation (px) of a camera's constant edge shift before any data: errata, B."""
LEVEL_SIGMA = 1e-6
"""rad, of a bed that is level by definition: a tenth of a micrometre over a printer's bed."""


@dataclass(frozen=True)
class Assembled:
    """A problem and where its rows come from.

    observed : (K,) configurations with at least one edge, link, or pose of a board on the platform,
    or all without a station; only they are in the problem. places : where each kind's measurements
    stand among the seen ones. priors : names of the kinds of the prior rows, (c,): drawing, camera,
    shading, breathing, size, mount, level or gauge.
    """

    problem: Problem
    observed: Booleans
    places: Kinds[Places]
    priors: tuple[str, ...]

    def trusting(self, weights: Kinds[Array]) -> Problem:
        """The problem with weights (N,) of its measurements; see
        :meth:`~pkmcal.identify.problem.Problem.weighted`.
        """
        placed = zip(self.places, weights, strict=True)
        return self.problem.weighted(Kinds(*(at.filled(weight)[None] for at, weight in placed)))


def assemble(
    machine: Machine,
    measurements: Measurements,
    gauge: Gauge,
    *,
    use_drawing: bool = True,
    shading: float | Array = SHADING_SIGMA,
    share: float = 1.0,
) -> Assembled:
    """The joint problem of one session (B = 1), every edge a block of its own.

    shading : px, standard deviation of the lines' shading, of all or of each (n,), where an
    estimate has told it. share : of the configurations how many are to count together in the end,
    where these are candidates, for the edges that share their shading.
    """
    _check(machine, measurements)
    observed, (keys, line) = observed_configurations(measurements), lines(measurements)
    side = np.unique(keys[:, [0, 1, 3]], axis=0, return_inverse=True)[1].reshape(-1)
    edges = _places(measurements.edges.configuration, observed, measurements.edges.leg)
    # boards on the base hang on no configuration, so the nearest row serves where theirs is unseen
    one = np.zeros(len(measurements.poses), dtype=int)
    poses = _places(measurements.poses.configuration, observed, one)
    link_blocks, link_data = _links(measurements, observed)
    unknowns = Unknowns(
        n_free=machine.parameters.free_matrix().shape[1],
        n_stations=measurements.n_stations,
        n_cameras=measurements.n_cameras,
        n_optics=1 + measurements.intrinsics_factor.shape[-1],
        n_lines=int(line.max(initial=-1)) + 1,
        n_mounts=len(measurements.mounts),
        n_breathing=len(measurements.breathing_at),
        n_sizes=sum(mount.tolerance > 0 for mount in measurements.mounts),
        n_linked=len(link_blocks.linked) * machine.layout.own_motion.shape[1],
    )
    prior, target, kinds = prior_rows(
        machine,
        gauge,
        unknowns,
        use_drawing=use_drawing,
        on_platform=measurements.on_platform,
        level=measurements.level,
        side=side,
    )
    if measurements.intrinsics_at.size:
        camera = np.array([kind == "camera" for kind in kinds])
        target[camera] = np.pad(-measurements.intrinsics_at, ((0, 0), (1, 0))).ravel()
    target[[kind == "breathing" for kind in kinds]] = -measurements.breathing_at
    blocks, data = _edges(machine, measurements, edges, line, side, observed, share)
    data = replace(data, shading=np.atleast_2d(shading).astype(float))
    pose_blocks, pose_data = _poses(measurements, poses)
    problem = Problem(
        layout=machine.layout,
        drawing=machine.parameters.drawing,
        free=machine.parameters.free_matrix(),
        unknowns=unknowns,
        blocks=blocks,
        data=data,
        joint_noise=np.array([measurements.joint_noise]),
        prior=prior,
        prior_target=target,
        frames=exact_moves(machine),
        pose_blocks=pose_blocks,
        pose_data=pose_data,
        link_blocks=link_blocks,
        link_data=link_data,
    )
    return Assembled(problem, observed, Kinds(edges, poses, link_blocks.at), kinds)


def observed_configurations(measurements: Measurements) -> Booleans:
    """(K,) configurations of which something was seen that depends on the platform's pose; all
    where nothing but readings was measured, which then stand against each other.
    """
    poses, n = measurements.poses, len(measurements.joints)
    if not measurements.n_stations:
        return np.ones(n, dtype=bool)
    on_platform = measurements.on_platform[poses.mount]
    linked = [links.configuration.ravel() for links in measurements.links]
    rows = [measurements.edges.configuration, poses.configuration[on_platform], *linked]
    rows = np.concatenate(rows)
    return np.bincount(rows, minlength=n) > 0


def _check(machine: Machine, measurements: Measurements) -> None:
    edges, joints = measurements.edges, measurements.joints
    in_view = len(edges) + len(measurements.poses) + measurements.n_links
    if measurements.n_stations and not in_view:
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
    for links in measurements.links:
        if int(links.configuration.max(initial=-1)) >= len(joints):
            raise InputError(
                what="a link names a configuration that does not exist",
                found=str(int(links.configuration.max())),
                expected=f"below {len(joints)}",
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


def _places(configuration: Integers, visible: Booleans, kind: Integers) -> Places:
    """Measurements of one configuration after the other in a row of its own, where each kind (N,)
    of them has as many places as every other, side by side.
    """
    row = np.maximum(np.cumsum(visible) - 1, 0)[configuration]
    kinds, number = np.unique(kind, return_inverse=True)
    key = len(kinds) * row + number
    order = np.argsort(key, kind="stable")
    first = np.searchsorted(key[order], key[order])
    place = np.empty(len(row), dtype=int)
    place[order] = np.arange(len(row)) - first
    each = int(place.max(initial=-1)) + 1
    return Places(row, each * number + place, (int(visible.sum()), each * len(kinds)))


def lines(measurements: Measurements) -> tuple[Integers, Integers]:
    """Each line's station, leg, tube and side (n, 4), and the number (N,) of each edge's line; none
    if nothing is shaded, and -1 at stations of one photograph, where each edge is a line of its
    own.
    """
    e = measurements.edges
    if not measurements.shaded or not len(e):
        return np.zeros((0, 4), dtype=int), np.zeros(0, dtype=int)
    number = np.full(len(e), -1)
    many = ~_alone(measurements)
    keys = np.stack([e.station, e.leg, e.tube, e.side], axis=1)[many]
    keys, own = np.unique(keys, axis=0, return_inverse=True)
    number[many] = own.reshape(-1)
    return keys, number


def _alone(measurements: Measurements) -> Booleans:
    """(N,) edges of stations that saw one configuration alone, as photographs by hand do."""
    pair = np.unique(
        np.stack([measurements.edges.station, measurements.edges.configuration], axis=1), axis=0
    )
    count = np.bincount(pair[:, 0], minlength=measurements.n_stations)
    return count[measurements.edges.station] == 1


def _edges(
    machine: Machine,
    measurements: Measurements,
    at: Places,
    line: Integers,
    side: Integers,
    visible: Booleans,
    share: float,
) -> tuple[EdgeBlocks, EdgeData]:
    """The edges at their places, and the readings of the seen configurations."""
    edges, factor = measurements.edges, measurements.intrinsics_factor
    radius = machine.layout.radius_of(edges.leg, edges.tube)
    camera = np.asarray(measurements.camera_of_station)[edges.station]
    optics = np.zeros((len(edges), 2, 1 + factor.shape[-1]))
    optics[..., 0] = edges.shift
    if factor.shape[-1] and len(edges):
        # the measured normals move with the intrinsics; residuals are predicted less measured
        optics[..., 1:] = -edges.by_intrinsics @ factor[camera]
    own, crowded = np.zeros((2, len(edges)))
    cells = LineCells.of(edges.normal, line if len(line) else np.full(len(edges), -1), side)
    if len(line):
        # what one edge alone is shaded by is noise of its own: no unknown could tell it from that
        alone = np.where(line < 0, SHADING_SIGMA, 0.0)
        crowded = 1 + share * (cells.n_effective - 1)
        own = np.hypot(edges.shading * np.sqrt(crowded), alone)
    legs = np.unique(edges.leg)
    leg = np.repeat(legs, at.shape[1] // max(len(legs), 1))
    first: Integers = np.array([machine.layout.radius[j][0] for j in leg], dtype=int)
    blocks = EdgeBlocks(
        leg=leg[None],
        station=at.filled(edges.station),
        camera=at.filled(camera),
        # padding needs any existing radius; its weight is zero
        radius=np.where(at.present, at.filled(radius), first),
        side=at.filled(edges.side)[..., None],
        present=at.present,
        line=at.filled(line) if len(line) else np.zeros((0, 0), dtype=int),
        tube=at.filled(edges.tube),
        n_effective=at.filled(crowded),
        cell=np.where(at.present, at.filled(cells.cell), -1),
        cells=cells,
    )
    data = EdgeData(
        basis=at.filled(edges.basis)[None, :, :, None],
        white=at.filled(np.linalg.inv(np.linalg.cholesky(edges.covariance)))[None],
        optics=at.filled(optics)[None],
        joints=measurements.joints[None, visible],
        weight=at.present[None].astype(float),
    )
    if len(measurements.breathing_at):
        breathing = at.filled(-BREATHING_SIGMA * edges.by_focal[..., None])[None]
        data = replace(data, breathing=breathing)
    return blocks, replace(data, own=at.filled(own)[None]) if len(line) else data


def _poses(measurements: Measurements, at: Places) -> tuple[PoseBlocks, PoseData]:
    """The boards' poses at their places."""
    poses, factor = measurements.poses, measurements.intrinsics_factor
    camera = np.asarray(measurements.camera_of_station)[poses.station]
    n = poses.by_intrinsics.shape[-1]
    optics = np.zeros((len(poses), 6, 1 + factor.shape[-1]))  # an edge shift moves no corner
    if factor.shape[-1] and n:
        optics[..., 1:] = -poses.by_intrinsics @ factor[camera, :n]
    blocks = PoseBlocks(
        station=at.filled(poses.station),
        mount=at.filled(poses.mount),
        present=at.present,
        on_platform=measurements.on_platform,
        camera=at.filled(camera),
        tolerance=np.array([mount.tolerance for mount in measurements.mounts], dtype=float),
    )
    target = at.filled(poses.T_station_target)
    target[~at.present] = np.eye(4)
    whiten, weight = at.filled(poses.whiten), at.present.astype(float)
    breathing = at.filled(-BREATHING_SIGMA * poses.by_focal[..., None])[None]
    return blocks, PoseData(
        target[None], whiten[None], weight[None], at.filled(optics)[None], breathing
    )


def _links(measurements: Measurements, visible: Booleans) -> tuple[LinkBlocks, LinkData]:
    """The links, each among the rows of its second configuration."""
    rows = np.cumsum(visible) - 1  # of each configuration among the seen ones
    ends = [np.zeros((0, 2), dtype=int), *(one.configuration for one in measurements.links)]
    ends = np.concatenate(ends)
    linked = np.unique(ends)
    number = np.full(len(visible), -1)
    number[linked] = np.arange(len(linked))
    sets = tuple(
        replace(one, configuration=number[one.configuration]) for one in measurements.links
    )
    at = _places(ends[:, 1], visible, np.zeros(len(ends), dtype=int))
    sigma = np.concatenate([np.zeros(0), *(one.sigma for one in measurements.links)])
    blocks = LinkBlocks(sets, rows[linked], number[visible], at)
    whiten = at.filled(1 / sigma)[None, ..., None, None]
    return blocks, LinkData(at.present[None].astype(float), whiten)


def prior_rows(
    machine: Machine,
    gauge: Gauge,
    unknowns: Unknowns,
    *,
    use_drawing: bool,
    on_platform: Booleans,
    level: Booleans,
    side: Integers,
) -> tuple[Array, Array, tuple[str, ...]]:
    """Rows (c, na) on the shared unknowns, their targets (c,) and kinds.

    Without the drawing the frames are free, so the gauge's constraints stand in as rows: they
    can be met exactly, hence fix the frames and pull on nothing else. Intrinsics, shading,
    breathing and sizes stand in units of their prior. on_platform : (M,) mounts. level : (S,)
    stations that do not tilt against the base. side : (n,) number of the leg's side at a station
    that each line is on: what shades two tubes there is alike by TUBE_CORRELATION.

    What is on a platform is as near its start as the machine is large. Where a platform turns about
    one axis, nothing tells along it how high the board sits; its tilt by a tenth of a degree then
    seems to, and would carry the board off by metres.
    """
    table, u = machine.parameters, unknowns
    first, tolerance = table.first_of_free(), table.tolerances_free()
    radius = np.array([table.kinds[k] == "radius" for k in first], dtype=bool)
    held = np.flatnonzero(radius | use_drawing)
    optics = np.tile([SHIFT_SIGMA] + [1.0] * (u.n_optics - 1), u.n_cameras)
    shaded = np.where(side[:, None] == side, TUBE_CORRELATION, 0.0) + (
        1 - TUBE_CORRELATION
    ) * np.eye(len(side))
    moving = np.flatnonzero(on_platform)
    places = (u.mounts.start + 6 * moving[:, None] + [3, 4, 5]).ravel()
    upright = np.flatnonzero(level)
    tilts = (u.stations.start + 6 * upright[:, None] + [0, 1]).ravel()
    reference_values = (
        ("drawing", held, tolerance[held]),
        ("camera", u.columns("optics"), optics),
        ("shading", u.columns("shading"), np.linalg.cholesky(shaded)),
        ("breathing", u.columns("breathing"), np.ones(u.n_breathing)),
        ("size", u.columns("sizes"), np.ones(u.n_sizes)),
        ("mount", places, np.full(len(places), machine_size(machine) if len(places) else 1.0)),
        ("level", tilts, np.full(len(tilts), LEVEL_SIGMA)),
    )
    rows: list[Array] = []
    kinds: list[str] = []
    for kind, columns, sigma in reference_values:
        part = np.zeros((len(columns), u.count))
        part[:, columns] = np.diag(1 / sigma) if sigma.ndim == 1 else np.linalg.inv(sigma)
        rows.append(part)
        kinds += [kind] * len(part)
    if not use_drawing and freedoms(machine).shape[1]:
        c = frame_rows(machine, gauge) @ table.free_matrix() / float(np.mean(tolerance[~radius]))
        rows.append(np.pad(c, ((0, 0), (0, u.count - u.n_free))))
        kinds += ["gauge"] * len(c)
    prior = np.concatenate(rows)
    return prior, np.zeros(len(prior)), tuple(kinds)


def machine_size(machine: Machine) -> float:
    """How large a machine is, m: from the platform to the farthest joint on the base, and from the
    tool to the farthest on the platform.
    """
    base = np.linalg.norm(machine.base_centers() - machine.home()[:3, 3], axis=-1)
    platform = np.linalg.norm(machine.platform_centers(), axis=-1)
    return float(base.max() + platform.max())


def batch_of(machine: Machine, assembled: Assembled, state: State) -> BatchState:
    """A state as a batch of one, free parameters only."""
    u = assembled.problem.unknowns
    optics = np.zeros((len(state.edge_shift), u.n_optics))
    optics[:, 0] = state.edge_shift
    if state.intrinsics.shape[-1] == u.n_optics - 1:
        optics[: len(state.intrinsics), 1:] = state.intrinsics
    breathing = state.breathing if len(state.breathing) else np.zeros(u.n_breathing)
    sizes = state.sizes if len(state.sizes) == u.n_sizes else np.zeros(u.n_sizes)
    internal = np.zeros((len(state.T_base_platform), machine.layout.n_internal))
    if state.internal.shape == internal.shape:
        internal = state.internal
    return BatchState(
        machine.parameters.to_free(state.theta)[None],
        state.T_camera_base[None],
        state.T_base_platform[assembled.observed][None],
        optics[None],
        state.T_mount[None],
        internal[assembled.observed][None],
        np.zeros((1, u.n_lines)),
        breathing[None],
        sizes[None],
    )


def state_of(assembled: Assembled, batch: BatchState, start: State) -> State:
    """The first run of a batch as a state; unseen configurations keep the start's pose."""
    poses = start.T_base_platform.copy()
    poses[assembled.observed] = batch.T_base_platform[0]
    internal = np.zeros((len(poses), batch.internal.shape[-1]))
    if start.internal.shape == internal.shape:
        internal[:] = start.internal
    internal[assembled.observed] = batch.internal[0]
    return State(
        assembled.problem.theta(batch)[0],
        batch.T_camera_base[0],
        poses,
        batch.optics[0, :, 0],
        batch.optics[0, :, 1:],
        batch.T_mount[0],
        assembled.problem.pose_blocks.on_platform,
        internal,
        batch.breathing[0],
        batch.sizes[0],
    )
