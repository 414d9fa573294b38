"""What the session takes for granted, tested: readings' scales and play, lenses, boards, tripods.

Each departure stands here with what it would do to the measurements
(:mod:`pkmcal.identify.score` says what freeing it would gain), and in which words it is told. All
are tested after every calibration, at one level together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.calibration.gather import edges_by_camera
from pkmcal.identify.assembly import Assembled, assemble, batch_of
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.rows import Kinds
from pkmcal.identify.score import Departures, Freed, Score, columns_of
from pkmcal.identify.tool import ToolError, tool_error
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import SHADING_SIGMA, Measurements, Observation
from pkmcal.mechanisms.closure import scales
from pkmcal.session.load import Session
from pkmcal.wording import amount, number

LEVEL = 0.005
"""Chance at which any departure at all is found in a session that has none."""
AGAINST = 1.0
"""Standard deviations by which a departure moves the tool, beyond which the result is refused."""
FEWEST = 3
"""Configurations on either side of a movement: fewer are outliers."""
SLIPS = 300
"""Single readings that are tried at most."""
MOMENTS = 12
"""Times at most, spread over a station's photographs, at which it may have moved."""


@dataclass(frozen=True)
class Departure:
    """One departure: k numbers, and what a session that has it is told.

    kind : for programs. of : what departs, by name. columns : (K', r, k). words : what the data
    show and what to do, from the fitted numbers and their standard deviations.
    """

    kind: str
    of: str
    columns: Array
    words: Callable[[Array, Array], tuple[str, str]]


@dataclass(frozen=True)
class Departed:
    """A departure that the data show.

    value, sigma : (k,) that fit, all that were found free together. tool : by how many of its
    standard deviations the platform's position moves if it is taken up, root mean square over the
    session's poses. shift : the same in m. what : the data show; todo : next.
    """

    kind: str
    of: str
    value: Array
    sigma: Array
    score: Score
    tool: float
    shift: float
    what: str
    todo: str

    @property
    def against(self) -> bool:
        """Whether the result should not be used for it."""
        return self.tool > AGAINST

    def document(self) -> dict[str, Any]:
        """For programs."""
        return {
            "kind": self.kind,
            "of": self.of,
            "value": self.value,
            "sigma": self.sigma,
            "chi2": self.score.chi2,
            "dof": self.score.dof,
            "chance": self.score.adjusted,
            "moves_tool": self.shift,
            "moves_tool_in_sigmas": self.tool,
        }

    @property
    def sentence(self) -> str:
        """For a verdict."""
        moves = f"taken up, it moves the tool by {amount(self.shift, 'm')}"
        return f"{self.what}; {moves}, {self.tool:.2g} standard deviations. {self.todo}."


def departures(
    session: Session, observation: Observation, measurements: Measurements, estimate: Estimate
) -> tuple[Departed, ...]:
    """What the data show that the model does not have, the surest first."""
    machine, told = estimate.machine, estimate.as_found(measurements)
    shading = estimate.line_shading if len(estimate.line_shading) else SHADING_SIGMA
    assembled = assemble(machine, told, default_gauge(machine), shading=shading)
    statistics = estimate.statistics
    problem = assembled.trusting(
        Kinds(
            estimate.edge_weights / statistics.noise_scale**2,
            estimate.pose_weights / statistics.pose_scale**2,
        )
    )
    assembled = replace(assembled, problem=problem)
    at = _At(session, observation, told, assembled, batch_of(machine, assembled, estimate.state))
    families = [list(declared(at)) for declared in DECLARED]
    tried = [one for family in families for one in family]
    if not tried:
        return ()
    number = np.repeat(np.arange(len(families)), [len(family) for family in families])
    tests = Departures(problem, at.state, [one.columns for one in tried], number.tolist())
    found = tests.found(LEVEL)
    fits = tests.fitted([k for k, _ in found]) if found else []
    used = estimate.configurations
    tool = tool_error(
        session.machine,
        machine,
        free_of_gauge(machine, estimate.covariance),
        estimate.state.T_base_platform[used],
        session.joints[used],
        legs_seen=estimate.edge_weights.size > 0,
    )
    return tuple(
        _departed(tried[k], score, fit, tool) for (k, score), fit in zip(found, fits, strict=True)
    )


def _departed(one: Departure, score: Score, fit: Freed, tool: ToolError) -> Departed:
    moved = np.linalg.norm((tool.by_parameters @ fit.moved)[:, 3:], axis=-1)
    shift = float(np.sqrt(np.nanmean(moved**2)))
    sigma = float(np.sqrt(np.nanmean(tool.position**2)))
    what, todo = one.words(fit.value, fit.sigma)
    return Departed(one.kind, one.of, fit.value, fit.sigma, score, shift / sigma, shift, what, todo)


@dataclass(frozen=True)
class _At:
    """Where departures are asked: a session's estimate, as a problem and its state."""

    session: Session
    observation: Observation
    measurements: Measurements
    assembled: Assembled
    state: BatchState

    def columns(
        self, edges: Array | None = None, readings: Array | None = None, poses: Array | None = None
    ) -> Array:
        """Columns (K', r, k): changes of edges (N, 2, k), readings (K, m, k), poses (N', 6, k)."""
        places = self.assembled.places
        return columns_of(
            self.assembled.problem,
            self.state,
            edges=None if edges is None else places.edges.filled(edges),
            readings=None if readings is None else readings[self.assembled.seen],
            poses=None if poses is None else places.poses.filled(poses),
        )


def _scales(at: _At) -> Iterator[Departure]:
    """A reading too large or small by a factor, beyond its scale's tolerance: a wrong lead, or
    counts a turn.
    """
    joints, names = at.measurements.joints, at.session.document["joints"]["columns"]
    layout, drawing = at.session.machine.layout, at.session.machine.parameters.drawing
    # a scale that is free beside its tolerance leaves this one to the drawing again, so its value
    # is all of the difference, as the present scale counts it
    present = scales(layout, at.assembled.problem.theta(at.state)[0]) / scales(layout, drawing)
    for m, name in enumerate(names):
        by = np.zeros((*joints.shape, 1))
        by[:, m, 0] = joints[:, m]
        own = float(present[np.argmax(layout.actuated == m)])

        def words(
            value: Array, sigma: Array, name: str = name, own: float = own
        ) -> tuple[str, str]:
            factor = 1 + own * value[0]
            return (
                f"The readings of {name} have another scale: true ones are"
                f" {_percent(factor - 1, sigma[0])} {'larger' if factor > 1 else 'smaller'}",
                f"Multiply this column of joints.csv by {factor:.5f} if the encoder's counts"
                " or the screw's lead agree, or correct it in the controller",
            )

        yield Departure("reading scale", name, at.columns(readings=by), words)


def _play(at: _At) -> Iterator[Departure]:
    """A reading that differs by the way from which its motor came, by the order of the table."""
    joints, names = at.measurements.joints, at.session.document["joints"]["columns"]
    units = at.session.machine.joint_units
    way = np.sign(np.diff(joints, axis=0, prepend=joints[:1]))
    for m, (name, unit) in enumerate(zip(names, units, strict=True)):
        by = np.zeros((*joints.shape, 1))
        by[:, m, 0] = way[:, m] / 2

        def words(value: Array, _s: Array, name: str = name, unit: str = unit) -> tuple[str, str]:
            return (
                f"The readings of {name} have a play of {amount(abs(value[0]), unit)}: they differ"
                " by the way from which the motor came",
                "Come to every configuration from the same side, or take the play out",
            )

        yield Departure("backlash", name, at.columns(readings=by), words)


def _slips(at: _At) -> Iterator[Departure]:
    """A single reading that is wrong: of those configurations whose rows fit worst, where there are
    too many to try all.
    """
    told, names = at.measurements, at.session.document["joints"]["columns"]
    units, m = at.session.machine.joint_units, told.joints.shape[1]
    seen = np.flatnonzero(at.assembled.seen)
    cost = np.sum(at.assembled.problem.residuals(at.state).value[0] ** 2, axis=-1)
    for k in np.sort(np.argsort(-cost, kind="stable")[: max(SLIPS // m, 1)]).tolist():
        configuration = at.session.configurations[seen[k]]
        for j, (name, unit) in enumerate(zip(names, units, strict=True)):
            by = np.zeros((*told.joints.shape, 1))
            by[seen[k], j] = 1.0

            def words(
                value: Array, sigma: Array, of: str = configuration, name: str = name,
                unit: str = unit,
            ) -> tuple[str, str]:  # fmt: skip
                return (
                    f"The reading of {name} in configuration {of} is off: what was seen tells"
                    f" {amount(abs(value[0]), unit)} {'more' if value[0] > 0 else 'less'}, to"
                    f" {amount(sigma[0], unit)}",
                    "Look it up where readings are logged, and whether this photograph bears the"
                    " right name, or leave the configuration out",
                )

            yield Departure("reading", f"{name}, {configuration}", at.columns(readings=by), words)


def _lenses(at: _At) -> Iterator[Departure]:
    """A camera that is not as its file says, by the departures that its model declares."""
    session, told = at.session, at.measurements
    cameras = [station.camera for station in session.stations]
    if told.intrinsics_factor.shape[-1] or not cameras:
        return  # they are estimated already
    number_of = np.asarray(told.camera_of_station)
    edges = edges_by_camera(at.observation, cameras)
    poses = np.zeros((len(told.poses), 6, edges.shape[-1]))
    own = told.poses.by_intrinsics
    poses[..., : own.shape[-1]] = own
    for c in range(int(number_of[: len(cameras)].max()) + 1):
        station = int(np.flatnonzero(number_of == c)[0])
        camera, file = cameras[station], session.stations[station].camera_file
        mine = (number_of[told.edges.station] == c)[:, None, None]
        also = (number_of[told.poses.station] == c) & (told.poses.station < len(cameras))
        for part in camera.departures():
            n = len(camera.parameters)
            by_edges = np.where(mine, edges[..., :n] @ part.columns, 0.0)
            by_poses = np.where(also[:, None, None], poses[..., :n] @ part.columns, 0.0)
            yield Departure(
                part.kind,
                file,
                at.columns(edges=by_edges, poses=by_poses),
                _lens_words(part.says, file),
            )


def _lens_words(
    says: Callable[[Array, Array], str], file: str
) -> Callable[[Array, Array], tuple[str, str]]:
    return lambda value, sigma: (
        f"The camera in {file} is not the one that took these photographs: {says(value, sigma)}",
        "Calibrate the camera again with `pkmcal camera`, focus and zoom as for these photographs,"
        " or estimate it with the machine: --refine-camera",
    )


def _boards(at: _At) -> Iterator[Departure]:
    """A board whose squares are not as large as its file says, by more than its tolerance."""
    poses, mounts = at.measurements.poses, at.measurements.mounts
    unsure = np.cumsum([mount.tolerance > 0 for mount in mounts])
    for m, mount in enumerate(mounts):
        if mount.name != "board":
            continue
        by = np.zeros((len(poses), 6, 1))
        mine = poses.mount == m
        by[mine, 3:, 0] = poses.T_station_target[mine, :3, 3]
        file = at.session.document["board"]["file"]
        # as far as the tolerance allowed the estimate has gone already
        gone = mount.tolerance and mount.tolerance * at.state.sizes[0, unsure[m] - 1]

        def words(
            value: Array, sigma: Array, file: str = file, gone: float = float(gone)
        ) -> tuple[str, str]:
            size = gone + value[0]
            return (
                f"The board's squares are {_percent(size, sigma[0])}"
                f" {'larger' if size > 0 else 'smaller'} than {file} says",
                f"Measure them over as many as there are; if a ruler agrees, multiply square and"
                f" marker by {1 + size:.5f}",
            )

        yield Departure("board size", file, at.columns(poses=by), words)


def _tripods(at: _At) -> Iterator[Departure]:
    """A camera, or tracker, that stands elsewhere from some configuration on."""
    problem, told = at.assembled.problem, at.measurements
    linear = problem.linearize(at.state)
    seen = np.flatnonzero(at.assembled.seen)
    start = problem.unknowns.stations.start
    for s, name in enumerate(at.session.station_names):
        used: Booleans = np.zeros(len(told.joints), dtype=bool)
        used[told.edges.configuration[told.edges.station == s]] = True
        used[told.poses.configuration[told.poses.station == s]] = True
        mine = np.flatnonzero(used)
        if len(mine) < 2 * FEWEST:
            continue
        by = linear.by_shared[0, :, :, start + 6 * s : start + 6 * s + 6]
        first = np.linspace(FEWEST, len(mine) - FEWEST, min(MOMENTS, len(mine) - 2 * FEWEST + 1))
        for at_first in np.unique(first.astype(int)).tolist():
            later = (seen >= mine[at_first])[:, None, None]
            before, after = (at.session.configurations[mine[at_first + d]] for d in (-1, 0))

            def words(
                value: Array, _s: Array, name: str = name, b: str = before, a: str = after
            ) -> tuple[str, str]:
                turn, shift = np.linalg.norm(value[:3]), np.linalg.norm(value[3:])
                return (
                    f"The camera of {name} stood elsewhere after configuration {b}, by some"
                    f" {amount(float(shift), 'm')} and {amount(float(turn), 'rad')}",
                    f"Make two stations of it, one up to {b} and one from {a} on",
                )

            yield Departure("station moved", name, np.where(later, by, 0.0), words)


DECLARED: Sequence[Callable[[_At], Iterator[Departure]]] = (
    _scales,
    _play,
    _slips,
    _lenses,
    _boards,
    _tripods,
)


def _percent(value: float, sigma: float) -> str:
    """A ratio in per cent, with its standard deviation where the data tell one."""
    if not np.isfinite(sigma):
        return f"some {100 * abs(value):.1g} %"
    places = max(0, 1 - int(np.floor(np.log10(max(100 * sigma, 1e-6)))))
    return f"{number(100 * abs(value), places)} ± {number(100 * sigma, places)} %"
