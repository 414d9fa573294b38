"""Assembly of the least-squares problem from a machine and its measurements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.errors import InputError
from pkmcal.identify.gauge import Gauge, exact_moves, frame_rows, freedoms
from pkmcal.identify.link_rows import LinkBlocks, LinkData
from pkmcal.identify.places import Places
from pkmcal.identify.problem import Problem
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import BatchState, Unknowns
from pkmcal.measurements import SHADING_SIGMA, Column, Measurements, edges_of_any
from pkmcal.measurements.edges import EdgeBlocks, EdgeData
from pkmcal.measurements.effects import SHADING, columns_of_effects, lines
from pkmcal.measurements.line_cells import LineCells
from pkmcal.measurements.poses import PoseBlocks, PoseData
from pkmcal.measurements.readings import ReadingColumns
from pkmcal.measurements.rows import RowGroups
from pkmcal.mechanisms import Machine

LEVEL_SIGMA = 1e-6
"""Standard deviation, rad, of a bed that is level by definition: a tenth of a micrometre over a
printer's bed."""


@dataclass(frozen=True)
class Assembled:
    """A least-squares problem and the origin of its rows.

    observed : (K,) configurations in the problem: those with at least one edge, link, or pose of a
        board on the platform, or all configurations of a session without stations.
    places : positions of the measurements of each kind among the observed configurations.
    priors : (c,) kind of each prior row: nominal, the code of an effect, mount, level or gauge.
    """

    problem: Problem
    observed: Booleans
    places: RowGroups[Places]
    priors: tuple[str, ...]
    __repr__ = short_repr

    def trusting(self, weights: RowGroups[Array]) -> Problem:
        """Problem with the weights (N,) of its measurements of each kind; see
        :meth:`~pkmcal.identify.problem.Problem.weighted`.
        """
        placed = zip(self.places, weights, strict=True)
        return self.problem.weighted(RowGroups(*(at.filled(weight)[None] for at, weight in placed)))


def assemble(
    machine: Machine,
    measurements: Measurements,
    gauge: Gauge,
    *,
    use_prior: bool = True,
    shading: float | Array = SHADING_SIGMA,
    share: float = 1.0,
) -> Assembled:
    """Joint problem of one session (B = 1); each edge is a block of its own.

    shading : px, standard deviation of the lines' shading from an earlier estimate, one for all or
        (n,), one for each line.
    share : share of the candidate configurations that will be measured. It scales the number of
        neighbouring edges that share their shading (:class:`LineCells`).

    Raises InputError if there is no measurement, or if readings and indices do not match the
    machine.
    """
    check_measurements(machine, measurements)
    # configurations in the problem, and the effects that are unknowns
    observed = observed_configurations(measurements)
    columns = _unknown_columns(measurements)
    codes = Counter[str]()
    for column in columns:
        codes[column.code] += column.count
    # positions of the measurements
    edges = _places(measurements.edges.configuration, observed, measurements.edges.leg)
    # A board on the base does not depend on the platform's pose: where its configuration is not in
    # the problem, its rows join those of the previous one.
    one = np.zeros(len(measurements.poses), dtype=int)
    poses = _places(measurements.poses.configuration, observed, one)
    link_blocks, link_data = _links(measurements, observed)
    # shared unknowns and their priors
    unknowns = Unknowns(
        n_free=machine.parameters.free_matrix().shape[1],
        n_stations=measurements.n_stations,
        codes=tuple(codes.items()),
        n_mounts=len(measurements.mounts),
        n_linked=len(link_blocks.linked) * machine.layout.own_motion.shape[1],
    )
    prior, target, kinds = prior_rows(
        machine,
        gauge,
        unknowns,
        columns,
        use_prior=use_prior,
        on_platform=measurements.on_platform,
        level=measurements.level,
    )
    # rows of each kind
    blocks, data = _edges(machine, measurements, columns, edges, observed, share)
    pose_blocks, pose_data = _poses(measurements, columns, poses)
    problem = Problem(
        layout=machine.layout,
        nominal=machine.parameters.nominal,
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
        reading_columns=_readings(columns, observed),
    )
    if unknowns.codes:
        n_lines = unknowns.columns(SHADING).size
        problem = problem.shaded(np.broadcast_to(shading, (1, n_lines)).astype(float))
    return Assembled(problem, observed, RowGroups(edges, poses, link_blocks.at), kinds)


def assemble_runs(
    machine: Machine, measurements: Sequence[Measurements], gauge: Gauge
) -> Assembled:
    """Joint problem of runs that differ in their edges, each as by :func:`assemble`.

    All runs have the edges of any of them. Where a run has not measured an edge, its whitening is
    zero (:attr:`RowGroup.measured`).
    """
    own = edges_of_any([one.edges for one in measurements])
    runs = [replace(one, edges=edges) for one, (edges, _) in zip(measurements, own, strict=True)]
    first, parts = assemble(machine, runs[0], gauge), list[EdgeData]()
    at = first.places.edges
    for one, (_, measured) in zip(runs, own, strict=True):
        data = _edges(machine, one, _unknown_columns(one), at, first.observed, share=1.0)[1]
        present = at.filled(measured.astype(float))[None, ..., None, None]
        parts.append(replace(data, white=data.white * present))
    names = [one.name for one in fields(EdgeData)]
    data = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return replace(first, problem=replace(first.problem, data=EdgeData(*data)))


def observed_configurations(measurements: Measurements) -> Booleans:
    """(K,) configurations with a measurement that depends on the platform's pose; all where only
    readings were measured.
    """
    poses, n = measurements.poses, len(measurements.joints)
    if not measurements.n_stations:
        return np.ones(n, dtype=bool)
    on_platform = measurements.on_platform[poses.mount]
    linked = [links.configuration.ravel() for links in measurements.links]
    rows = [measurements.edges.configuration, poses.configuration[on_platform], *linked]
    rows = np.concatenate(rows)
    return np.bincount(rows, minlength=n) > 0


def check_measurements(machine: Machine, measurements: Measurements) -> None:
    """Raise `InputError` if nothing is measured, or if readings and indices do not match the
    machine.
    """
    edges, joints = measurements.edges, measurements.joints
    in_view = len(edges) + len(measurements.poses) + measurements.n_links
    if measurements.n_stations and not in_view:
        raise InputError(
            what="there is neither an edge nor a board's pose to calibrate from",
            next_step="check the images, the stations' poses and the tubes of the nominal model",
            code="measurements.none",
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
    """Positions of N measurements: a row for each visible configuration, in which each kind has the
    same number of consecutive positions.

    configuration, kind : (N,) of each measurement. visible : (K,) configurations in the problem.
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


def _unknown_columns(measurements: Measurements) -> list[Column]:
    """The columns that have a prior."""
    columns = [one for one in columns_of_effects(measurements) if one.prior is not None]
    for one in columns:
        if one.motion is not None or one.station is not None:
            raise InputError(
                what=f"the effect {one.code} cannot have a prior: motions of stations are linear"
                " about a solution only",
                next_step="state what it does to edges, poses or readings, or leave its prior out",
                code="effect.prior_of_motion",
            )
    return columns


def _by_measurement(
    count: int,
    numbers_each: int,
    columns: Sequence[Column],
    parts: Sequence[tuple[Array | None, Integers | None, Integers | None]],
) -> tuple[Integers, Array]:
    """Sparse derivatives of N measurements of d numbers by the columns' numbers.

    count, numbers_each : N and d.
    parts : of each column its derivatives (n, d, k), the measurements (n,) that it affects, None
        for all, and the numbers (n, k) of the column that each derivative belongs to, None for all.

    Returns numbers (N, w), -1 for padding, and derivatives (N, d, w). The numbers do not depend on
    the values of the derivatives: where these are zero, the number is an unknown that the data do
    not determine, and keeps its position.
    """
    of, number, by = list[Integers](), list[Integers](), list[Array]()
    first = 0
    for column, (values, rows, own) in zip(columns, parts, strict=True):
        if values is not None:
            rows = np.arange(count) if rows is None else rows
            own = np.arange(column.count)[None] if own is None else own
            own = np.broadcast_to(first + own, (len(rows), own.shape[1]))
            of.append(np.repeat(rows, own.shape[1]))
            number.append(own.ravel())
            by.append(values.swapaxes(1, 2).reshape(-1, values.shape[1]))
        first += column.count
    if not by:
        return np.zeros((count, 0), int), np.zeros((count, numbers_each, 0))
    of, number, by = np.concatenate(of), np.concatenate(number), np.concatenate(by)
    order = np.lexsort((number, of))
    of, number, by = of[order], number[order], by[order]
    slot = np.arange(len(of)) - np.searchsorted(of, of)
    width = int(slot.max(initial=-1)) + 1
    column, derivative = np.full((count, width), -1), np.zeros((count, by.shape[1], width))
    column[of, slot], derivative[of, :, slot] = number, by
    return column, derivative


def _readings(columns: Sequence[Column], visible: Booleans) -> ReadingColumns:
    """Derivatives of the readings of visible configurations by the columns that change readings."""
    ends = np.cumsum([0, *(one.count for one in columns)]).tolist()
    parts = [(k, one.readings) for k, one in enumerate(columns) if one.readings is not None]
    number = [np.arange(*ends[k : k + 2]) for k, _ in parts]
    by = [part[visible] for _, part in parts]
    if not by:
        return ReadingColumns(np.zeros((int(visible.sum()), 0, 0)), np.zeros(0, dtype=int))
    return ReadingColumns(np.concatenate(by, axis=-1), np.concatenate(number))


def _edges(
    machine: Machine,
    measurements: Measurements,
    columns: Sequence[Column],
    at: Places,
    visible: Booleans,
    share: float,
) -> tuple[EdgeBlocks, EdgeData]:
    """Edges at their positions, with the readings of the observed configurations."""
    edges, (keys, line) = measurements.edges, lines(measurements)
    radius = machine.layout.radius_of(edges.leg, edges.tube)
    parts = [(one.edges, one.edge_rows, one.edge_numbers) for one in columns]
    column, by_columns = _by_measurement(len(edges), 2, columns, parts)
    # noise of the edges by shading: neighbouring edges of a line share it
    side = np.unique(keys[:, [0, 1, 3]], axis=0, return_inverse=True)[1].reshape(-1)
    own, alone, crowded = np.zeros((3, len(edges)))
    cells = LineCells.of(edges.normal, line if len(line) else np.full(len(edges), -1), side)
    if len(line):
        # a line of a single edge has no shading unknown: it could not be separated from the noise
        alone = np.where(line < 0, SHADING_SIGMA, 0.0)
        crowded = 1 + share * (cells.n_effective - 1)
        own = np.hypot(edges.shading * np.sqrt(crowded), alone)
    legs = np.unique(edges.leg)
    leg = np.repeat(legs, at.shape[1] // max(len(legs), 1))
    first: Integers = np.array([machine.layout.radius[j][0] for j in leg], dtype=int)
    blocks = EdgeBlocks(
        leg=leg[None],
        station=at.filled(edges.station),
        # padding needs any existing radius; its weight is zero
        radius=np.where(at.present, at.filled(radius), first),
        side=at.filled(edges.side)[..., None],
        present=at.present,
        column=np.where(at.present[..., None], at.filled(column), -1),
        alone=at.filled(alone),
        tube=at.filled(edges.tube),
        n_effective=at.filled(crowded),
        cell=np.where(at.present, at.filled(cells.cell), -1),
        cells=cells,
    )
    data = EdgeData(
        basis=at.filled(edges.basis)[None, :, :, None],
        white=at.filled(np.linalg.inv(np.linalg.cholesky(edges.covariance)))[None],
        shift=at.filled(edges.shift)[None],
        joints=measurements.joints[None, visible],
        weight=at.present[None].astype(float),
        # residuals are predicted less measured
        columns=-at.filled(by_columns)[None],
        unit=np.ones((1, sum(one.count for one in columns))),
    )
    return blocks, replace(data, own=at.filled(own)[None]) if len(line) else data


def _poses(
    measurements: Measurements, columns: Sequence[Column], at: Places
) -> tuple[PoseBlocks, PoseData]:
    """Measured poses at their positions."""
    poses = measurements.poses
    parts = [(one.poses, one.pose_rows, None) for one in columns]
    column, by_columns = _by_measurement(len(poses), 6, columns, parts)
    blocks = PoseBlocks(
        station=at.filled(poses.station),
        mount=at.filled(poses.mount),
        present=at.present,
        on_platform=measurements.on_platform,
        column=np.where(at.present[..., None], at.filled(column), -1),
    )
    target = at.filled(poses.T_station_target)
    target[~at.present] = np.eye(4)
    whiten, weight = at.filled(poses.whiten), at.present.astype(float)
    by_columns = -at.filled(by_columns)[None]
    return blocks, PoseData(target[None], whiten[None], weight[None], by_columns)


def _links(measurements: Measurements, visible: Booleans) -> tuple[LinkBlocks, LinkData]:
    """Links at their positions; each is a row of its second configuration."""
    rows = np.cumsum(visible) - 1  # of each configuration among the visible ones
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
    columns: Sequence[Column],
    *,
    use_prior: bool,
    on_platform: Booleans,
    level: Booleans,
) -> tuple[Array, Array, tuple[str, ...]]:
    """Prior rows (c, na) on the shared unknowns, their targets (c,) and kinds (c,).

    columns : effects, each with the square root of its prior covariance.
    use_prior : whether the nominal model is a prior. Without it the frames have no information, so
        the constraints of the gauge are added as rows. They can be satisfied exactly, hence define
        the frames and change no other result.
    on_platform : (M,) mounts on the platform.
    level : (S,) stations whose tilt against the base is zero by definition.

    The prior sigma of the position of a mount on the platform is the size of the machine. If a
    platform rotates about one axis only, no measurement determines the height of the board along
    the axis; without the prior, a tilt of a tenth of a degree would shift that height by metres.
    """
    table, u = machine.parameters, unknowns
    first, tolerance = table.first_of_free(), table.tolerances_free()
    radius = np.array([table.kinds[k] == "radius" for k in first], dtype=bool)
    # unknowns with a prior; radii always have one, since edges alone determine a tube's radius only
    # in units of its distance
    held = np.flatnonzero(radius | use_prior)
    moving = np.flatnonzero(on_platform)
    places = (u.mounts.start + 6 * moving[:, None] + [3, 4, 5]).ravel()
    upright = np.flatnonzero(level)
    tilts = (u.stations.start + 6 * upright[:, None] + [0, 1]).ravel()
    rows: list[Array] = []
    targets: list[Array] = []
    kinds: list[str] = []

    def add(kind: str, where: Integers, root: Array, at: Array | None = None) -> None:
        """Append rows on the unknowns at ``where``: covariance ``root root^T``, mean ``-at``."""
        part = np.zeros((len(where), u.count))
        inverse_root = np.diag(1 / root) if root.ndim == 1 else np.linalg.inv(root)
        part[:, where] = inverse_root
        rows.append(part)
        targets.append(np.zeros(len(part)) if at is None else -inverse_root @ at)
        kinds.extend([kind] * len(part))

    add("nominal", held, tolerance[held])
    first_column = u.effects.start
    roots = [one.prior for one in columns if one.prior is not None]
    for column, root in zip(columns, roots, strict=True):
        add(column.code, first_column + np.arange(column.count), root, column.at)
        first_column += column.count
    # positions of mounts, tilts of level stations
    size = machine_size(machine) if len(places) else 1.0
    add("mount", places, np.full(len(places), size))
    add("level", tilts, np.full(len(tilts), LEVEL_SIGMA))
    # without a nominal prior the gauge's constraints fix the frames
    if not use_prior and freedoms(machine).shape[1]:
        c = frame_rows(machine, gauge) @ table.free_matrix() / float(np.mean(tolerance[~radius]))
        rows.append(np.pad(c, ((0, 0), (0, u.count - u.n_free))))
        targets.append(np.zeros(len(c)))
        kinds += ["gauge"] * len(c)
    return np.concatenate(rows), np.concatenate(targets), tuple(kinds)


def machine_size(machine: Machine) -> float:
    """Size of a machine, m: the distance from the platform to the farthest joint on the base, plus
    that from the tool to the farthest joint on the platform.
    """
    base = np.linalg.norm(machine.base_centers() - machine.home()[:3, 3], axis=-1)
    platform = np.linalg.norm(machine.platform_centers(), axis=-1)
    return float(base.max() + platform.max())


def batch_of(machine: Machine, assembled: Assembled, state: State) -> BatchState:
    """Batch of one run from a state, with the free parameters only."""
    u = assembled.problem.unknowns
    columns = np.zeros((1, u.effects.stop - u.effects.start))
    for code, count in u.codes:
        number = state.columns.get(code)
        if number is not None and len(number) == count:
            first = u.of_code(code).start - u.effects.start
            columns[0, first : first + count] = number
    internal = np.zeros((len(state.T_base_platform), machine.layout.n_internal))
    if state.internal.shape == internal.shape:
        internal = state.internal
    return BatchState(
        machine.parameters.to_free(state.theta)[None],
        state.T_camera_base[None],
        state.T_base_platform[assembled.observed][None],
        columns,
        state.T_mount[None],
        internal[assembled.observed][None],
    )


def state_of(assembled: Assembled, batch: BatchState, start: State) -> State:
    """State from the first run of a batch.

    Unobserved configurations keep the poses of ``start``. The lines' shading is omitted, because
    its unit differs between estimates.
    """
    u = assembled.problem.unknowns
    parts = {code: u.of_code(code) for code, _ in u.codes if code != SHADING}
    first = u.effects.start
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
        {c: batch.columns[0, x.start - first : x.stop - first] for c, x in parts.items()},
        batch.T_mount[0],
        assembled.problem.pose_blocks.on_platform,
        internal,
    )
