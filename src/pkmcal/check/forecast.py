"""What a full capture would give, told by a station's first photographs.

The first photographs are measured as `calibrate` measures them. How much each edge tells there, in
pixels, and lost edges nothing, is what such edges will tell: every edge that the machine would show
in configurations drawn over its joints' ranges gets what one of its like told, drawn at random.
With these the problem of the joint estimate is assembled as for a real session, and its covariance
followed to the platform.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.gather import refinement_of
from pkmcal.cameras import Camera
from pkmcal.check.look import Look, StationLook
from pkmcal.errors import PkmcalError, ResultError
from pkmcal.geometry.rigid import inverse, pose, rotation
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import information
from pkmcal.identify.estimate import Estimate, State
from pkmcal.identify.gauge import BestFit, default_gauge, transformation
from pkmcal.identify.start import start_state
from pkmcal.identify.tool import pose_by_parameters, without_frames
from pkmcal.measurements import EdgeSet, Measurements, concatenate
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.predict import tubes_of
from pkmcal.simulation.edges import EdgeNoise, simulate_edges
from pkmcal.simulation.placement import PANORAMIC, draw_configurations, view_angle

CAPTURE = 15
"""Photographs a station of a usual capture."""
FEWEST_EDGES = 24
"""Edges without which nothing is forecast: one photograph of a hexapod shows as many."""
OWN = 2.0
"""Edges that all of a kind at a station count for beside the leg's own, so that chance among three
photographs does not make a leg."""
NEAR_END = 0.15
"""Part of a joint's range, at either end, in which a reading is an extreme one."""
MOSTLY = 0.5
"""Part of an edge that has to be free for it to be expected: its place is fitted to as much."""
QUARTER = np.pi / 2
"""How far round the machine a second place is tried: what one camera sees worst, along its line of
sight, the other sees best."""
EXACT = EdgeNoise(1e-3, 1e-3)
"""px; errors of edges that are simulated for where they lie, and how they turn by a pixel."""
SEED = 7


@dataclass(frozen=True)
class LegForecast:
    """One leg (from 1) seen from one station.

    seen : share of its edges' points that nothing hides, in all photographs. found : share of the
    edges that ought to be seen whose place was measured and agrees with all others, in the first
    photographs; NaN where none ought to be. sigma : px across, median of these. tells : share of
    what all edges of the capture tell about the machine (their information in units of the
    drawing's tolerances). variance : share of the variance of the platform's position that comes
    from its edges' errors: where it is large, a better view of this leg gains most.
    """

    station: str
    leg: int
    seen: float
    found: float
    sigma: float
    tells: float
    variance: float


@dataclass(frozen=True)
class EdgesOf:
    """Edges (k, E) of a station's first photographs, in the order of ``tubes_of``.

    photographs : (k,) their numbers. expected : of which nothing hides the most. found : that were
    measured and agree with all others.
    """

    photographs: Integers
    expected: Booleans
    found: Booleans


@dataclass(frozen=True)
class Forecast:
    """What ``photographs`` a station like the first ones would give.

    position, orientation : standard deviations of the platform's pose at given readings, mean over
    poses, m and rad, as `calibrate` states them. readings, drawing : shares of the position's
    variance; the legs' edges make the rest. second : position, m, where half of the
    photographs are taken a quarter round the machine; NaN where there is more than one station, or
    a camera that looks all round. edges : by station, for advice.
    """

    photographs: int
    position: float
    orientation: float
    readings: float
    drawing: float
    second: float
    legs: tuple[LegForecast, ...]
    edges: tuple[EdgesOf, ...] = ()


def forecast(look: Look, photographs: int = CAPTURE) -> Forecast | None:
    """The forecast from the first photographs; None where these do not carry one.

    By the legs alone, whatever boards and trackers say besides.
    """
    machine, stations = look.session.machine, look.stations
    whole = bool(stations) and all(station.recognised for station in stations)
    # where hinges turn is not known where nothing was measured
    if not whole or machine.layout.n_internal:
        return None
    try:
        first = _measured(look)
        plan = _planned(look, first, photographs)
    except (PkmcalError, np.linalg.LinAlgError):
        return None  # `calibrate` would tell; a forecast is no finding
    told = _told(plan, first.pools)
    second = np.nan
    one = stations[0].photographs
    if len(stations) == 1 and view_angle(one.camera) < PANORAMIC:
        second = _told(_two_places(plan), first.pools * 2).position
    return Forecast(
        photographs=photographs,
        position=told.position,
        orientation=told.orientation,
        readings=told.readings,
        drawing=told.drawing,
        second=second,
        legs=_by_leg(look, first, told),
        edges=first.edges,
    )


class _Pool(NamedTuple):
    """Informations (n, 2, 2), px^-2 of shift and tilt, and their chances (n,)."""

    told: Array
    chance: Array


class _First(NamedTuple):
    """What the first photographs gave.

    pools : by station and edge (E,) what such an edge may tell. sigma : (S, L) px. edges : by
    station.
    """

    estimate: Estimate
    pools: tuple[tuple[_Pool, ...], ...]
    sigma: Array
    edges: tuple[EdgesOf, ...]


class _Plan(NamedTuple):
    """A capture: pairs (M, 2) of station and configuration, and where all stand; shading : px."""

    machine: Machine
    cameras: tuple[Camera, ...]
    camera_of_station: Integers
    joint_noise: float
    T_camera_base: Array
    T_base_platform: Array
    joints: Array
    pairs: Integers
    shading: float


class _Told(NamedTuple):
    """What a capture tells of the platform; tells, variance : (S, L)."""

    position: float
    orientation: float
    tells: Array
    variance: Array
    readings: float
    drawing: float


def _cameras(stations: tuple[StationLook, ...], look: Look) -> Integers:
    """Number of each station's camera file, (S,)."""
    files = [look.session.stations[s.photographs.station].camera_file for s in stations]
    return np.array([list(dict.fromkeys(files)).index(file) for file in files], dtype=int)


def _measured(look: Look) -> _First:
    """The first photographs' edges, by a look for the legs and one at the edges.

    Raises PkmcalError where they do not carry an estimate.
    """
    session, machine = look.session, look.session.machine
    few: list[legs.Photographs] = []
    for number, (station, rows) in enumerate(zip(look.stations, look.measured, strict=True)):
        p = station.photographs
        images = [p.images[k] for k in rows]
        few.append(
            replace(
                p,
                station=number,
                configuration=p.configuration[rows],
                joints=p.joints[rows],
                images=images,
            )
        )

    def measurements(edges: EdgeSet) -> Measurements:
        if len(edges) < FEWEST_EDGES:
            raise ResultError("too few edges for a forecast", found=len(edges))
        number = _cameras(look.stations, look)
        return Measurements(
            edges, session.joints, session.joint_noise, len(few), number, shaded=True
        )

    stations = np.stack([station.found for station in look.stations])
    looks = [
        legs.search(p, machine, T, look.poses[p.configuration])
        for p, T in zip(few, stations, strict=True)
    ]
    coarse = replace(measurements(concatenate([one.edges for one in looks])), shaded=False)
    # a pixel is what the search is good to, so there is no noise to be estimated
    start = start_state(machine, coarse, stations)
    estimate = bundle(machine, coarse, start, scale_noise=False)
    state = estimate.state
    looks = [
        legs.measure(
            p, estimate.machine, state.T_camera_base[k], state.T_base_platform[p.configuration]
        )
        for k, p in enumerate(few)
    ]
    fine = measurements(concatenate([one.edges for one in looks]))
    held = refinement_of(session, refine=False)
    fine = replace(fine, intrinsics_factor=held.factor, intrinsics_at=held.at)
    start = replace(state, intrinsics=np.zeros_like(held.at))
    estimate = bundle(machine, fine, start)
    return _information_of(look, few, estimate, fine.edges)


def _information_of(
    look: Look, few: list[legs.Photographs], estimate: Estimate, edges: EdgeSet
) -> _First:
    """What an edge that ought to be seen tells on average, lost ones with nothing."""
    machine, state = estimate.machine, estimate.state
    tubes = tubes_of(machine)
    n_edges, n_legs = len(tubes), machine.n_legs
    number = np.full((n_legs, int(tubes.tube.max()) + 1, 2), -1)
    number[tubes.leg, tubes.tube, tubes.side] = np.arange(n_edges)
    pairs = np.array([(p.station, k) for p in few for k in p.configuration])
    ideal, _ = simulate_edges(
        machine,
        state.T_camera_base,
        tuple(p.camera for p in few),
        state.T_base_platform,
        EXACT,
        np.random.default_rng(SEED),
        photographs=pairs,
    )

    shape = (len(few), len(state.T_base_platform), n_edges)

    def place(some: EdgeSet) -> tuple[Integers, Integers, Integers]:
        return some.station, some.configuration, number[some.leg, some.tube, some.side]

    expected, kept, whole = (np.zeros(shape, dtype=bool) for _ in range(3))
    expected[place(ideal)] = True
    # of a tube that is hidden for the most part nobody asks why its edges are lost
    length = np.ptp(ideal.span, axis=1)
    longest = np.zeros(n_edges)
    np.maximum.at(longest, place(ideal)[2], length)
    whole[place(ideal)] = length > MOSTLY * longest[place(ideal)[2]]
    kept[place(edges.select(estimate.edge_weights > 0.5))] = True
    kept &= expected
    unit = np.zeros((*shape, 2, 2))
    unit[place(ideal)] = pixel_turns(ideal)
    weight = estimate.edge_weights / estimate.statistics.noise_scale**2
    own = unit[place(edges)]
    told = np.zeros((*shape, 2, 2))  # lost edges stay zero
    told[place(edges)] = own.mT @ (np.linalg.inv(edges.covariance) * weight[:, None, None]) @ own
    kind = np.stack([tubes.tube, tubes.side], axis=1)
    pools = tuple(_pools(told[s], expected[s], kind) for s in range(len(few)))
    sigma = np.full((len(few), n_legs), np.nan)
    pixel = np.linalg.norm(edges.shift, axis=-1)
    across = np.sqrt(edges.covariance[:, 0, 0]) / pixel * estimate.statistics.noise_scale
    for s, j in np.ndindex(len(few), n_legs):
        mine = (edges.station == s) & (edges.leg == j) & (estimate.edge_weights > 0.5)
        sigma[s, j] = np.median(across[mine]) if mine.any() else np.nan
    by_station = tuple(
        EdgesOf(rows, whole[s, p.configuration], (kept & whole)[s, p.configuration])
        for s, (rows, p) in enumerate(zip(look.measured, few, strict=True))
    )
    return _First(estimate, pools, sigma, by_station)


def _pools(told: Array, expected: Booleans, kind: Integers) -> tuple[_Pool, ...]:
    """What edges of a station may tell, by edge (E,): its tube's own, and that of all of its kind.

    told : (K, E, 2, 2), zero where lost; expected : (K, E). kind : (E, 2) tube and side. Edges
    differ: a mean would promise more than edges of which some tell much and others nothing.
    """
    out: list[_Pool] = []
    for e in range(told.shape[1]):
        alike = np.all(kind == kind[e], axis=1)
        own = told[expected[:, e], e]
        like = told[:, alike][expected[:, alike]]
        chance = np.concatenate([np.ones(len(own)), np.full(len(like), OWN / max(len(like), 1))])
        out.append(_Pool(np.concatenate([own, like]), chance / max(chance.sum(), 1.0)))
    return tuple(out)


def _planned(look: Look, first: _First, photographs: int) -> _Plan:
    """Configurations over the joints' ranges, as many extreme ones among them as so far."""
    machine, stations = first.estimate.machine, look.stations
    low, high = machine.joint_ranges.T
    margin = NEAR_END * (high - low)
    joints = look.session.joints
    ends = np.all((joints < low + margin) | (joints > high - margin), axis=1)
    rows = [set(s.photographs.configuration.tolist()) for s in stations]
    shared = len(rows) > 1 and len(set.union(*rows)) < sum(map(len, rows)) / 2
    wanted = photographs * (1 if shared else len(stations))
    rng = np.random.default_rng(SEED)
    poses, readings = draw_configurations(machine, wanted, float(ends.mean()), rng)
    number = np.arange(photographs)
    pairs = [
        (s, k + (0 if shared else photographs * s)) for s in range(len(stations)) for k in number
    ]
    return _Plan(
        machine,
        tuple(s.photographs.camera for s in stations),
        _cameras(stations, look),
        look.session.joint_noise,
        first.estimate.state.T_camera_base,
        poses[:wanted],
        readings[:wanted],
        np.array(pairs),
        first.estimate.statistics.shading,
    )


def _two_places(plan: _Plan) -> _Plan:
    """The only station's photographs, every other one taken a quarter round the machine."""
    machine = plan.machine
    middle = np.concatenate([machine.base_centers(), plan.T_base_platform[:, :3, 3]]).mean(axis=0)
    turn = rotation(np.array([0.0, 0.0, QUARTER]))
    T = pose(turn, middle - turn @ middle)
    pairs = plan.pairs.copy()
    pairs[1::2, 0] = 1
    return plan._replace(
        cameras=plan.cameras * 2,
        camera_of_station=np.repeat(plan.camera_of_station, 2),
        T_camera_base=np.concatenate([plan.T_camera_base, plan.T_camera_base @ inverse(T)]),
        pairs=pairs,
    )


def _told(plan: _Plan, pools: tuple[tuple[_Pool, ...], ...]) -> _Told:
    """What a capture tells of the platform.

    With N = sum of N_g the information of all groups of rows (legs at stations, readings, drawing)
    and J the derivative of the platform's place, its covariance J N^-1 J^T is the sum over g of
    J N^-1 N_g N^-1 J^T: what comes from each group's errors. What edges tell of the machine is
    the trace of their N_g, its parameters in units of their tolerances.
    """
    machine, n_stations = plan.machine, len(plan.cameras)
    rng = np.random.default_rng(SEED)
    edges, _ = simulate_edges(
        machine,
        plan.T_camera_base,
        plan.cameras,
        plan.T_base_platform,
        EXACT,
        rng,
        photographs=plan.pairs,
    )
    edges = _drawn(machine, edges, pools, rng)
    measurements = Measurements(
        edges, plan.joints, plan.joint_noise, n_stations, plan.camera_of_station, shaded=True
    )
    gauge = default_gauge(machine)
    assembled = assemble(machine, measurements, gauge, shading=plan.shading)
    shift = np.zeros(measurements.n_cameras)
    state = State(machine.values, plan.T_camera_base, plan.T_base_platform, shift)
    problem = assembled.problem
    info = information(problem, batch_of(machine, assembled, state))
    seen = np.flatnonzero(assembled.seen)
    poses, joints = plan.T_base_platform[seen], plan.joints[seen]
    n = len(machine.values)
    free = transformation(machine, state, BestFit())[:n, :n] @ problem.free
    by = without_frames(machine, poses, pose_by_parameters(machine, joints, poses)) @ free
    machine_part = problem.unknowns.machine
    spread = by @ info.covariance[0][machine_part]  # (K, 6, na)
    variance = np.sum(spread[..., machine_part] * by, axis=-1)
    place = spread[:, 3:].reshape(-1, spread.shape[-1])
    rows = info.reduced.rows[0][:, : info.linear.value.shape[-1]]
    part = np.sum((rows @ place.T) ** 2, axis=-1)  # (K, r)
    prior = float(np.sum((info.linear.shared_by @ place.T) ** 2))
    tolerance = machine.parameters.tolerances_free()
    told = np.sum((rows[..., machine_part] * tolerance) ** 2, axis=-1)
    at = assembled.places.edges

    def by_leg(of_rows: Array) -> Array:
        own = of_rows[at.row[:, None], 2 * at.place[:, None] + np.arange(2)].sum(axis=1)
        out = np.zeros((n_stations, machine.n_legs))
        np.add.at(out, (edges.station, edges.leg), own)
        return out

    share, tells = by_leg(part), by_leg(told)
    readings = float(part[:, problem.closure_rows].sum())
    whole = float(share.sum()) + readings + prior
    return _Told(
        position=float(np.sqrt(variance[:, 3:].sum(axis=1)).mean()),
        orientation=float(np.sqrt(variance[:, :3].sum(axis=1)).mean()),
        tells=tells / tells.sum(),
        variance=share / whole,
        readings=readings / whole,
        drawing=prior / whole,
    )


def _drawn(
    machine: Machine,
    edges: EdgeSet,
    pools: tuple[tuple[_Pool, ...], ...],
    rng: np.random.Generator,
) -> EdgeSet:
    """Edges that tell as much as such edges did, drawn at random; those that tell nothing go."""
    tubes = tubes_of(machine)
    own = np.zeros((len(edges), 2, 2))
    for e in range(len(tubes)):
        alike = (edges.leg == tubes.leg[e]) & (edges.tube == tubes.tube[e])
        alike &= edges.side == tubes.side[e]
        for s, station in enumerate(pools):
            mine = np.flatnonzero(alike & (edges.station == s))
            if len(station[e].told):
                own[mine] = station[e].told[
                    rng.choice(len(station[e].told), len(mine), p=station[e].chance)
                ]
    told = np.linalg.eigvalsh(own)[:, 0] > 0
    edges, own = edges.select(told), own[told]
    unit = pixel_turns(edges)
    return replace(edges, covariance=unit @ np.linalg.inv(own) @ unit.mT)


def pixel_turns(edges: EdgeSet) -> Array:
    """Turns (N, 2, 2) of simulated edges' normals by a pixel of shift and of tilt, in columns.

    The Cholesky factor of their covariance: their bases have the shift first.
    """
    return np.linalg.cholesky(edges.covariance) / EXACT.shift


def _by_leg(look: Look, first: _First, told: _Told) -> tuple[LegForecast, ...]:
    tubes, out = tubes_of(look.session.machine), list[LegForecast]()
    for s, (station, edges) in enumerate(zip(look.stations, first.edges, strict=True)):
        hidden = station.quality.hidden.mean(axis=0) if station.quality else None
        for j in np.unique(tubes.leg):
            mine = tubes.leg == j
            expected = int(edges.expected[:, mine].sum())
            found = int(edges.found[:, mine].sum())
            out.append(
                LegForecast(
                    station=station.name,
                    leg=int(j) + 1,
                    seen=float("nan") if hidden is None else float(1 - hidden[j]),
                    found=found / expected if expected else float("nan"),
                    sigma=float(first.sigma[s, j]),
                    tells=float(told.tells[s, j]),
                    variance=float(told.variance[s, j]),
                )
            )
    return tuple(out)
