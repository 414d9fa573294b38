"""Simulated control: many runs in parallel, how each run ends, and the noise at the goal.

The true machine and the true camera are those of :class:`pkmcal.control.image.Eye`; the controller
has its own geometry, and its readings and edges are delayed and noisy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.control.goal import GOAL_TOLERANCE
from pkmcal.control.image import Eye
from pkmcal.control.laws import MatrixPlace, joint_velocities, law_named, limited, solution, task_of
from pkmcal.control.machine_view import MachineView, directions_of, legs_from_image
from pkmcal.geometry.rigid import dot
from pkmcal.levels import NEARLY_ALL, OUTLIER_SIGMAS
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR, closure_at, forward
from pkmcal.mechanisms.velocities import assembly_sign
from pkmcal.placement.edges import EdgeNoise
from pkmcal.ranges import default

IMAGES_A_GOAL = 24
"""Images of each goal; the standard deviation over all goals is then accurate to a few percent."""
ARRIVED_DISTANCE_SHARE = 0.02
"""Distance from the goal, relative to the path's length, of a platform that has arrived: 2 %, as
usual for settling times."""
FINAL_RUN_SHARE = 0.1
"""Share of a run, at its end, whose mean decides how the run ended."""
AT_STOP = 1e-9
"""Distance, in m or rad, by which rounding may put a reading beyond its range."""
NO_EDGE_NOISE = EdgeNoise(shift=0.0, tilt=0.0)
"""Camera without errors."""


class End(Enum):
    """End of a run: a word for files, what happened, and what would help.

    ``good`` is a platform at its goal; every other end is a failure.
    """

    REACHED = (
        "reached",
        "the platform reached the goal",
        "",
    )
    SLOW = (
        "slow",
        "the platform was still on its way when the time was up",
        "give it more time, a higher gain or faster drives",
    )
    UNSTEADY = (
        "unsteady",
        "noise of the edges kept the platform away from the goal",
        "let the camera see more legs, control by edges, or lower the gain",
    )
    OTHER_POSE = (
        "other_pose",
        "the legs look as wanted, but the platform is at another pose",
        "let the camera see more legs, start nearer to the goal, or compare the readings with"
        " those at the goal",
    )
    STUCK = (
        "stuck",
        "the control came to rest before the goal, where the errors of the legs cancel",
        "let the camera see more legs, or lead the platform through a pose in between",
    )
    DIVERGED = (
        "diverged",
        "the control did not converge; the legs are no nearer to the goal than at the start",
        "calibrate the camera's place, or lower the gain or the delay",
    )
    LOST_LEG = (
        "lost_leg",
        "a leg left the camera's view, so the control was stopped",
        "move the camera back, or lead the platform through a pose in between",
    )
    OUTSIDE_WORKSPACE = (
        "left_workspace",
        "a drive came to the end of its range, or a leg could not follow",
        "lead the platform through a pose in between, or improve the geometry of the controller's"
        " model",
    )
    SINGULAR = (
        "singular",
        "the platform came to a singular pose, where the drives do not hold it",
        "choose a start in the goal's assembly, or a path that keeps away from singular poses",
    )
    WRONG_ASSEMBLY = (
        "wrong_assembly",
        "the start is in another assembly than the goal; a way between them crosses a singular"
        " pose",
        "assemble the machine as at the goal before the control begins",
    )

    def __init__(self, word: str, what: str, help_: str) -> None:
        self.word = word
        self.what = what
        self.help = help_

    @property
    def good(self) -> bool:
        """Whether the platform is at its goal."""
        return self is End.REACHED

    @property
    def sentence(self) -> str:
        """Sentence of what happened and what would help."""
        what = self.what[0].upper() + self.what[1:] + "."
        return f"{what} {self.help[0].upper()}{self.help[1:]}." if self.help else what


RUN_ENDS = tuple(End)


@dataclass(frozen=True)
class Stillness:
    """Noise of one image as a displacement of the platform, RMS over images for each goal.

    joints : (R,) m, of the platform's joints.
    position : (R,) m, of the mean of the joints.
    turn : (R,) rad.
    """

    joints: Array
    position: Array
    turn: Array

    def held(self, step: float, delay: int) -> Stillness:
        """Noise of the platform in the closed loop."""
        part = loop_factor(step, delay)
        return Stillness(self.joints * part, self.position * part, self.turn * part)


def loop_factor(step: float, delay: int) -> float:
    """Standard deviation of the platform in the closed loop, relative to the noise of one image.

    step : gain / rate, the share of an error that is corrected in a sample. The platform follows
    x(k + 1) = x(k) - step (x(k - delay) + noise); without delay its variance is step / (2 - step)
    times the noise's. inf where the loop is unstable.
    """
    # companion matrix F of the states x(k), ..., x(k - delay)
    n = delay + 1
    follow = np.eye(n, k=-1)
    follow[0, 0] += 1.0
    follow[0, n - 1] -= step
    if np.abs(np.linalg.eigvals(follow)).max() >= 1:
        return float("inf")
    drive = np.zeros((n, n))
    drive[0, 0] = step**2
    # stationary covariance: P = F P F^T + Q, as one linear system
    whole = np.eye(n * n) - np.kron(follow, follow)
    return float(np.sqrt(np.linalg.solve(whole, drive.ravel())[0]))


def one_image(
    eye: Eye,
    believed: MachineView,
    law: str,
    goals: Array,
    readings: Array,
    noise: EdgeNoise,
    rng: np.random.Generator,
    draws: int = IMAGES_A_GOAL,
) -> Stillness:
    """Apparent displacement of the platform at goals (R, 4, 4) from the noise of single images."""
    points = eye.points(goals, readings)
    wanted = eye.normals(points, EdgeNoise(0.0, 0.0), rng)
    squares = np.zeros((3, len(goals)))
    for _ in range(draws):
        measured = eye.normals(points, noise, rng)
        legs = legs_from_image(believed, directions_of(measured), readings)
        task = task_of(law, believed, measured, wanted, legs)
        twist = (task.twist @ solution(task)[..., None])[..., 0]
        arms = legs.b - legs.pivot[..., None, :]
        turned = np.cross(twist[..., None, :3], arms) + twist[..., None, 3:]
        squares[0] += dot(turned, turned).mean(axis=-1)
        squares[1] += dot(twist[..., 3:], twist[..., 3:])
        squares[2] += dot(twist[..., :3], twist[..., :3])
    return Stillness(*np.sqrt(squares / draws))


@dataclass(frozen=True)
class LoopSettings:
    """Settings of a controller.

    gain : 1/s.
    rate : samples per second.
    delay : samples from the exposure to the motors' response.
    noise : of the edges, px.
    joint_noise : of a reading, m or rad.
    speed : (m,) largest velocities of the motors, which are scaled together.
    duration : s.
    at : where the interaction matrix is evaluated.
    """

    law: str = "edges"
    gain: float = default("servo", "gain")
    rate: float = default("servo", "rate")
    delay: int = default("servo", "delay")
    noise: EdgeNoise = field(default_factory=EdgeNoise)
    joint_noise: float = default("servo", "joint_noise")
    speed: Array | None = None
    duration: float = 10.0
    at: MatrixPlace = "measured"

    @property
    def samples(self) -> int:
        """Number of samples."""
        return max(2, round(self.duration * self.rate))


@dataclass(frozen=True)
class ServoRuns:
    """R runs of K samples.

    time : (K,) s.
    error : (R, K) norm of e.
    travel : (R, K) RMS distance of the platform's joints from the goal, m.
    past : (R, K) overshoot: distance beyond the goal, relative to the path.
    T_base_platform : (R, K, 4, 4).
    readings : (R, K, m).
    end : R ends.
    last : (R,) sample at which a run was stopped; later samples repeat it.
    goals : (R, 4, 4).
    """

    time: Array
    error: Array
    travel: Array
    past: Array
    T_base_platform: Array
    readings: Array
    end: tuple[End, ...]
    last: Integers
    goals: Array

    @property
    def reached(self) -> Booleans:
        """(R,) runs that ended at their goal."""
        return np.array([end.good for end in self.end])


def simulate_servo_runs(
    eye: Eye,
    believed: MachineView,
    starts: Array,
    goals: Array,
    loop: LoopSettings,
    rng: np.random.Generator,
    progress: Callable[[float], None] = lambda _: None,
) -> ServoRuns:
    """R runs from starts to goals (R, 4, 4), poses of the true platform.

    believed : controller's model, with values (R, P) or (P,) and camera poses (R, 4, 4) or (4, 4).
    The wanted edges are the true edges at the goal, without noise. progress : called with the share
    of samples done.
    """
    kind, goal_readings = law_named(loop.law), eye.true.machine.inverse(goals)
    wanted = eye.normals(eye.points(goals, np.nan_to_num(goal_readings)), NO_EDGE_NOISE, rng)
    now = _begin(eye, starts, goals)
    record = _Record.empty(eye.true.machine, starts, goals, now.readings.shape[-1], loop.samples)
    # distance of the platform's joints from the goal that is due to noise alone
    still = one_image(
        eye, eye.true, loop.law, goals, np.nan_to_num(goal_readings), loop.noise, rng, draws=8
    )
    part = loop_factor(loop.gain / loop.rate, loop.delay)
    floor = np.nan_to_num(OUTLIER_SIGMAS * still.joints * (part if np.isfinite(part) else 0.0))
    queue: list[tuple[Array, Array]] = []
    # each sample: record, image with noise, delay, motor velocities, motion
    for k in range(loop.samples):
        points = eye.points(now.poses, now.readings)
        record.take(k, now, kind.error(points.normal.reshape(wanted.shape), wanted))
        now = _stopped(now, ~np.all(eye.in_view(points), axis=-1), End.LOST_LEG, k)
        noise = loop.joint_noise * rng.standard_normal(now.readings.shape)
        queue.append((eye.normals(points, loop.noise, rng), now.readings + noise))
        if len(queue) > loop.delay and now.active.any():
            edges, readings = queue.pop(0)
            speeds = joint_velocities(
                loop.law, believed, edges, wanted, readings, loop.gain, at=loop.at,
                goal_readings=goal_readings if loop.at != "measured" else None,
            )  # fmt: skip
            now = _driven(eye.true.machine, now, limited(speeds, loop.speed) / loop.rate, k)
        if k % 16 == 0:
            progress(k / loop.samples)
    return record.runs(now, goals, loop, floor)


@dataclass(frozen=True)
class _Now:
    """State of all runs at one sample.

    sign : (R,) of the start's assembly mode.
    end : (R,) index into ``RUN_ENDS``, -1 for running.
    last : (R,) sample of the end.
    """

    poses: Array
    readings: Array
    sign: Array
    end: Integers
    last: Integers

    @property
    def active(self) -> Booleans:
        """(R,) runs that have not ended."""
        return self.end < 0


def _begin(eye: Eye, starts: Array, goals: Array) -> _Now:
    """All runs at their start; runs that cannot begin are ended."""
    machine = eye.true.machine
    readings, wanted = machine.inverse(starts), machine.inverse(goals)
    n = len(starts)
    sign, wanted_sign = (
        assembly_sign(machine.layout, machine.values, poses) for poses in (starts, goals)
    )
    now = _Now(starts, np.nan_to_num(readings), sign, np.full(n, -1), np.zeros(n, dtype=int))
    out = outside(machine, readings) | outside(machine, wanted)
    now = _stopped(now, out, End.OUTSIDE_WORKSPACE, 0)
    return _stopped(now, sign * wanted_sign < 0, End.WRONG_ASSEMBLY, 0)


def _stopped(now: _Now, which: Booleans, end: End, sample: int) -> _Now:
    """State with the running runs of ``which`` ended."""
    which = which & now.active
    return replace(
        now,
        end=np.where(which, RUN_ENDS.index(end), now.end),
        last=np.where(which, sample, now.last),
    )


def _driven(machine: Machine, now: _Now, step: Array, sample: int) -> _Now:
    """State after the motors have moved by steps (R, m), and the platforms have followed."""
    step = np.where(now.active[:, None], step, 0.0)
    now = _stopped(now, ~np.all(np.isfinite(step), axis=-1), End.LOST_LEG, sample)
    wanted = now.readings + np.nan_to_num(step)
    now = _stopped(now, outside(machine, wanted), End.OUTSIDE_WORKSPACE, sample)
    wanted = np.where(now.active[:, None], wanted, now.readings)
    fk = forward(machine.layout, machine.values, wanted, now.poses)
    poses, closed = fk.T_base_platform, fk.converged
    turned = assembly_sign(machine.layout, machine.values, poses) * now.sign < 0
    now = _stopped(now, closed & (turned | (fk.singularity < NEAR_SINGULAR)), End.SINGULAR, sample)
    now = _stopped(now, ~closed, End.OUTSIDE_WORKSPACE, sample)
    return replace(
        now,
        readings=np.where(now.active[:, None], wanted, now.readings),
        poses=np.where(now.active[:, None, None], poses, now.poses),
    )


def outside(machine: Machine, readings: Array) -> Booleans:
    """(R,) True where a reading (R, m) is beyond its range, or a limb cannot reach."""
    low, high = machine.joint_ranges.T
    with np.errstate(invalid="ignore"):
        beyond = (readings < low - AT_STOP) | (readings > high + AT_STOP)
    return (beyond | ~np.isfinite(readings)).any(axis=-1)


def platform_joints(machine: Machine, poses: Array) -> Array:
    """Joint centres (R, L, 3) of the platform at poses (R, 4, 4), m, base frame."""
    return closure_at(machine.layout, machine.values, poses).b


@dataclass(frozen=True)
class _Record:
    """Arrays that are filled during the loop.

    goals : (R, L, 3) the platform's joints at the goal. first : (R, L, 3) their displacement at the
    start.
    """

    machine: Machine
    goals: Array
    first: Array
    error: Array
    travel: Array
    past: Array
    poses: Array
    readings: Array

    @classmethod
    def empty(cls, machine: Machine, starts: Array, goals: Array, m: int, samples: int) -> _Record:
        n, ends = len(starts), platform_joints(machine, goals)
        first = platform_joints(machine, starts) - ends
        shape = (n, samples)
        return cls(
            machine, ends, first, np.zeros(shape), np.zeros(shape), np.zeros(shape),
            np.zeros((*shape, 4, 4)), np.zeros((*shape, m)),
        )  # fmt: skip

    def take(self, sample: int, now: _Now, error: Array) -> None:
        """Record one sample of all runs."""
        flat = error.reshape(len(error), -1)
        off = platform_joints(self.machine, now.poses) - self.goals
        whole = np.sum(self.first**2, axis=(-1, -2))
        self.error[:, sample] = np.sqrt(np.sum(flat * flat, axis=-1))
        self.travel[:, sample] = np.sqrt(np.mean(dot(off, off), axis=-1))
        ahead = np.sum(off * self.first, axis=(-1, -2))
        self.past[:, sample] = -ahead / np.where(whole > 0, whole, np.inf)
        self.poses[:, sample], self.readings[:, sample] = now.poses, now.readings

    def runs(self, now: _Now, goals: Array, loop: LoopSettings, floor: Array) -> ServoRuns:
        """The finished runs with their ends."""
        last = np.where(now.active, loop.samples - 1, now.last)
        judged = _judged(self.error, self.travel, loop, floor)
        ends = [RUN_ENDS[e] if e >= 0 else end for e, end in zip(now.end, judged, strict=True)]
        time = np.arange(loop.samples) / loop.rate
        return ServoRuns(
            time, self.error, self.travel, self.past, self.poses, self.readings, tuple(ends), last,
            goals,
        )  # fmt: skip


def _judged(error: Array, direction: Array, loop: LoopSettings, floor: Array) -> list[End]:
    """End of each run (R, K) that used all its time, from means over the last part of the run.

    floor : (R,) m, distance that noise alone explains.
    """
    n = max(1, round(FINAL_RUN_SHARE * error.shape[1]))
    e, w = error[:, -n:].mean(axis=1), direction[:, -n:].mean(axis=1)
    before = direction[:, -2 * n : -n].mean(axis=1) if error.shape[1] >= 2 * n else w
    # arrived : near the goal, or as near as noise allows. shaken : noise keeps the platform away
    near = np.maximum(ARRIVED_DISTANCE_SHARE * direction[:, 0], GOAL_TOLERANCE)
    # with nearly all of its path behind it
    arrived = w < np.maximum(near, np.minimum(floor, (1 - NEARLY_ALL) * direction[:, 0]))
    shaken = w < floor
    # at rest: much slower than an exponential approach with this gain
    approach = w * (1 - np.exp(-loop.gain * n / loop.rate))
    rest = np.abs(before - w) < ARRIVED_DISTANCE_SHARE * approach
    same = e < ARRIVED_DISTANCE_SHARE * error[:, 0]
    worse = w > direction[:, 0]
    return [_end(*case) for case in zip(arrived, shaken, same, rest, worse, strict=True)]


def _end(arrived: bool, shaken: bool, similar: bool, rest: bool, worse: bool) -> End:
    if arrived or shaken:
        return End.REACHED if arrived else End.UNSTEADY
    if similar and rest:
        return End.OTHER_POSE
    if rest:
        return End.STUCK
    return End.DIVERGED if worse else End.SLOW
