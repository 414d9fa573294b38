"""Study of visual servoing with different estimates of the geometry, [B] Fig. 10.

Each estimate controls many runs of the simulated loop, and the visibility of the platform's motion
is analysed. The estimates are E1, the nominal model fitted to the identified base centres ([B] eq.
15); E2, the identified geometry; E3, the nominal model with a hand-measured camera pose. The true
geometry is the reference.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.control.analysis import Visibility, matrix_at
from pkmcal.control.image import Eye
from pkmcal.control.machine_view import MachineView, machine_view
from pkmcal.control.simulation import (
    ARRIVED_DISTANCE_SHARE,
    End,
    LoopSettings,
    ServoRuns,
    Stillness,
    loop_factor,
    one_image,
    platform_joints,
    simulate_servo_runs,
)
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, dot, inverse, perturb, pose, register, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure, limb_ends
from pkmcal.mechanisms.kinematics import inverse_result
from pkmcal.outcome.finding import Finding
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.placement.configurations import draw_configurations
from pkmcal.ranges import default

HAND_POSITION: float = default("servo", "hand_position")
HAND_ROTATION = float(np.deg2rad(default("servo", "hand_rotation")))
"""Errors, in m and rad, of a camera pose that was measured by ruler and eye."""
RANGE_END_SHARE = 0.15
"""Share of a reading's range at both ends in which no path begins or ends: a platform that is
controlled by its image does not follow a straight line in its readings."""
VISIBILITY_POSES = 60
"""Number of poses in the workspace at which visibility is computed."""
WRITTEN_POSE_ROUNDING = 1e-6
"""Error, in metres, of a pose written with six decimals."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of a calibration.

    covariance : (P, P) of the machine's values. rotation, translation : standard deviations (3,) of
    T_base_camera's six numbers, rad and m, base axes.
    """

    covariance: Array
    rotation: Array
    translation: Array


@dataclass(frozen=True)
class Belief:
    """Estimate of the geometry.

    view : with values (R, P) and camera poses (R, 4, 4), one for each run.
    """

    name: str
    title: str
    view: MachineView


def estimates(
    true: MachineView,
    nominal: Array,
    uncertainty: Uncertainty,
    runs: int,
    rng: np.random.Generator,
    hand_position: float = HAND_POSITION,
    hand_rotation: float = HAND_ROTATION,
) -> tuple[Belief, ...]:
    """True geometry, identified geometry, fitted nominal model, and hand-measured nominal model.

    true : the machine that is controlled. nominal : (P,) nominal values. Every run has its own
    error of calibration, drawn from the uncertainty, and its own error of the hand-measured pose,
    of the given size in a random direction.
    """
    identified = _identified(true, uncertainty, runs, rng)
    T_camera_base = np.broadcast_to(true.T_camera_base, (runs, 4, 4))
    values = np.broadcast_to(true.theta, (runs, true.theta.shape[-1]))
    repeated = replace(true, machine=true.machine.with_values(values), T_camera_base=T_camera_base)
    drawn = true.machine.with_values(nominal)
    fitted = _fitted(drawn, identified)
    exact = _fitted(drawn, replace(true, T_camera_base=T_camera_base))
    by_hand = _placed_by_hand(exact, hand_position, hand_rotation, rng)
    return (
        Belief("true", "True geometry", repeated),
        Belief("identified", "Identified", identified),
        Belief("cad", "Nominal model, fitted", fitted),
        Belief("hand", "By hand", by_hand),
    )


def _identified(
    true: MachineView, uncertainty: Uncertainty, runs: int, rng: np.random.Generator
) -> MachineView:
    """Random values and camera poses with the uncertainty of a calibration."""
    size, axes = np.linalg.eigh(uncertainty.covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    values = true.theta + rng.standard_normal((runs, len(size))) @ root.T
    sigma = np.concatenate([uncertainty.rotation, uncertainty.translation])
    T_base_camera = perturb(inverse(true.T_camera_base), rng.standard_normal((runs, 6)) * sigma)
    machine = true.machine.with_values(values)
    return replace(true, machine=machine, T_camera_base=inverse(T_base_camera))


def _fitted(nominal: Machine, view: MachineView) -> MachineView:
    """Nominal model with the camera pose that fits its base centres to the view's, [B] eq. 15."""
    middle, poses = nominal.middle_readings(), np.eye(4)
    here = limb_ends(nominal.layout, nominal.values, middle, poses).a
    there = limb_ends(view.machine.layout, view.theta, middle, poses).a
    target = apply(view.T_camera_base[..., None, :, :], there)
    T = register(np.broadcast_to(here, target.shape), target)
    return replace(view, machine=nominal, T_camera_base=T)


def _placed_by_hand(
    view: MachineView, position: float, turn: float, rng: np.random.Generator
) -> MachineView:
    """View with camera poses off by the given sizes, m and rad, in random directions."""
    drawn = rng.standard_normal((2, *view.T_camera_base.shape[:-2], 3))
    direction, axis = drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)
    T = inverse(view.T_camera_base)
    shifted = pose(rotation(turn * axis) @ T[..., :3, :3], T[..., :3, 3] + position * direction)
    return replace(view, T_camera_base=inverse(shifted))


@dataclass(frozen=True)
class Plan:
    """Settings of a study.

    runs : number for each estimate.
    hand_position, hand_rotation : errors of the hand-measured camera pose, m and rad.
    start, goal : (4, 4) of every run; random by default.
    """

    loop: LoopSettings = field(default_factory=LoopSettings)
    runs: int = default("servo", "runs")
    seed: int = 0
    hand_position: float = HAND_POSITION
    hand_rotation: float = HAND_ROTATION
    start: Array | None = None
    goal: Array | None = None


@dataclass(frozen=True)
class Plant:
    """Machine and camera under control.

    nominal : (P,) nominal values.
    uncertainty : of the calibration.
    legs : observed legs, from 0; by default all with tubes.
    origin : source of the plant, a sentence for people.
    station : the camera's station, None without a calibration.
    findings : findings on the source.
    """

    machine: Machine
    nominal: Array
    uncertainty: Uncertainty
    camera: Camera
    T_camera_base: Array
    legs: tuple[int, ...] | None = None
    origin: str = ""
    station: str | None = None
    findings: tuple[Finding, ...] = ()

    def view(self) -> MachineView:
        """View of the true machine by the camera."""
        legs = None if self.legs is None else np.array(self.legs, dtype=int)
        return machine_view(self.machine, self.T_camera_base, legs)


@dataclass(frozen=True)
class Trials:
    """Runs with one estimate of the geometry, and their figures.

    overshoot : (R,) largest distance beyond the goal, relative to the path's length.
    rise : (R,) largest increase of the norm of e above an earlier value, relative to its start.
    settling : (R,) s after which the platform stays within ARRIVED_DISTANCE_SHARE of its path, NaN
        for never.
    astray : (R,) m, largest RMS distance of the platform's joints from the path with the true
        geometry.
    """

    estimate: Belief
    runs: ServoRuns
    overshoot: Array
    rise: Array
    settling: Array
    astray: Array

    @property
    def reached(self) -> int:
        """Number of runs that ended at their goal."""
        return int(self.runs.reached.sum())

    @property
    def ends(self) -> dict[End, int]:
        """Number of runs for each end, the most frequent first."""
        return dict(Counter(self.runs.end).most_common())


@dataclass(frozen=True)
class Study:
    """Results of a study.

    outcomes : runs with the estimates true, identified, cad and hand.
    image, held : noise at the goals, of one image and in the loop.
    hidden : (s,) share of starts and goals at which a leg is behind another.
    visibility : visibility of the platform's motion by the observed legs.
    """

    scene: Plant
    plan: Plan
    eye: Eye
    outcomes: tuple[Trials, ...]
    image: Stillness
    held: Stillness
    hidden: Array
    visibility: Visibility

    def trials(self, name: str) -> Trials:
        """Trials of an estimate by its name."""
        return next(o for o in self.outcomes if o.estimate.name == name)


def study_servoing(scene: Plant, plan: Plan, progress: Progress = no_progress) -> Study:
    """Simulate the loop with every estimate, and analyse the visibility.

    Raises InputError if the loop would be unstable with perfect knowledge, if a start or goal is
    unreachable, and if the camera does not see the legs.
    """
    check_loop(plan.loop)
    # workspace, and starts and goals of the runs
    seeds = np.random.SeedSequence(plan.seed).spawn(5)
    eye = Eye.of(scene.view(), scene.camera)
    progress("Sampling the workspace", 0.02)
    drawn = draw_configurations(
        scene.machine, VISIBILITY_POSES, 0.2, np.random.default_rng(seeds[0])
    )
    workspace = drawn[0][:VISIBILITY_POSES]
    starts, goals = _ways(eye, plan, np.random.default_rng(seeds[1]))
    # runs with each estimate
    beliefs = estimates(
        eye.true, scene.nominal, scene.uncertainty, plan.runs, np.random.default_rng(seeds[2]),
        plan.hand_position, plan.hand_rotation,
    )  # fmt: skip
    outcomes: list[Trials] = []
    for k, belief in enumerate(beliefs):
        own = partial(
            part(progress, 0.05 + 0.2 * k, 0.25 + 0.2 * k), f"Servoing: {belief.title.lower()}"
        )
        # the same noise for all estimates, so that differences are due to the estimates
        rng = np.random.default_rng(seeds[3])
        runs = simulate_servo_runs(eye, belief.view, starts, goals, plan.loop, rng, own)
        ideal = outcomes[0].runs if outcomes else runs
        outcomes.append(outcome(eye.true.machine, belief, runs, ideal))
    # noise at the goals
    ends, joints = np.concatenate([starts, goals]), np.nan_to_num(scene.machine.inverse(goals))
    rng, loop = np.random.default_rng(seeds[4]), plan.loop
    image = one_image(eye, eye.true, loop.law, goals, joints, loop.noise, rng)
    return Study(
        scene=scene,
        plan=plan,
        eye=eye,
        outcomes=tuple(outcomes),
        image=image,
        held=image.held(loop.gain / loop.rate, loop.delay),
        hidden=eye.hidden(ends, np.nan_to_num(scene.machine.inverse(ends))).mean(axis=0),
        visibility=Visibility.of(matrix_at(eye.true, loop.law, workspace)),
    )


def check_loop(loop: LoopSettings) -> None:
    """Raise InputError if the loop is unstable even with perfect knowledge."""
    if np.isfinite(loop_factor(loop.gain / loop.rate, loop.delay)):
        return
    # largest stable step, by bisection, for the message
    low, high = 0.0, 3.0
    for _ in range(40):
        middle = (low + high) / 2
        stable = np.isfinite(loop_factor(middle, loop.delay))
        low, high = (middle, high) if stable else (low, middle)
    raise InputError(
        "the loop is unstable with perfect knowledge of the geometry",
        where="--gain",
        found=f"{loop.gain:g}/s at {loop.rate:g} samples a second and a delay of {loop.delay}",
        expected=f"less than {low * loop.rate:.3g}/s, better a quarter of it",
    )


def outcome(true: Machine, estimate: Belief, runs: ServoRuns, ideal: ServoRuns) -> Trials:
    """Figures of an estimate's runs; ideal : runs with the true machine's geometry."""
    last = np.arange(len(runs.time)) <= runs.last[:, None]
    past = np.where(last, runs.past, 0.0)
    lowest = np.minimum.accumulate(runs.error, axis=1)
    first = np.maximum(runs.error[:, :1], 1e-300)
    # time after which the platform stays within ARRIVED_DISTANCE_SHARE of its path
    far = runs.travel > ARRIVED_DISTANCE_SHARE * runs.travel[:, :1]
    n = far.shape[1]
    after = n - np.argmax(far[:, ::-1], axis=1)
    after = np.where(far.any(axis=1), after, 0)
    time = np.append(runs.time, np.nan)[after]
    return Trials(
        estimate,
        runs,
        overshoot=np.maximum(past.max(axis=1), 0.0),
        rise=np.max((runs.error - lowest) / first, axis=1),
        settling=np.where(runs.reached, time, np.nan),
        astray=_astray(true, runs, ideal),
    )


def _astray(machine: Machine, runs: ServoRuns, ideal: ServoRuns) -> Array:
    """Largest distance (R,), in m, of the platform's joints from their nearest point on the ideal
    path.
    """
    out = np.zeros(len(runs.end))
    for r, (last, end) in enumerate(zip(runs.last, ideal.last, strict=True)):
        here, there = (
            platform_joints(machine, one.T_base_platform[r, : n + 1])
            for one, n in ((runs, last), (ideal, end))
        )
        off = here[:, None] - there
        out[r] = np.sqrt(np.mean(dot(off, off), axis=-1).min(axis=1).max())
    return out


def _ways(eye: Eye, plan: Plan, rng: np.random.Generator) -> tuple[Array, Array]:
    """Starts and goals (R, 4, 4): those of the plan, or random ones with all legs in view."""
    n = plan.runs
    given = (plan.start, plan.goal)
    for wanted, where in zip(given, ("--start", "--goal"), strict=True):
        if wanted is not None:
            check_pose(eye.true.machine, wanted, where)
    drawn = iter(_drawn(eye, n * sum(wanted is None for wanted in given), rng).reshape(-1, n, 4, 4))
    starts, goals = (
        next(drawn) if wanted is None else np.broadcast_to(wanted, (n, 4, 4)) for wanted in given
    )
    return starts, goals


def check_pose(machine: Machine, T_base_platform: Array, where: str) -> None:
    """Raise InputError if a machine cannot take a pose (4, 4); where : its name in the message."""
    layout, theta = machine.layout, machine.values
    readings, internal = inverse_result(layout, theta, T_base_platform)
    unreached = np.flatnonzero(~np.isfinite(readings))
    c = closure(layout, theta, np.nan_to_num(readings), T_base_platform, internal)
    gap = float(np.abs(c.rows.value).max())
    if unreached.size or gap > WRITTEN_POSE_ROUNDING:
        raise InputError(
            "the machine cannot take this pose",
            where=where,
            found=f"a gap of {1e3 * gap:.2g} mm in its limbs",
            expected="a pose that its constant rods, axes and motion allow",
            code="pose.not_admissible",
        )
    low, high = machine.joint_ranges.T
    beyond = np.flatnonzero((readings < low) | (readings > high))
    if beyond.size:
        k = int(beyond[0])
        raise InputError(
            "the pose lies outside of the workspace",
            where=where,
            found=f"a reading of {readings[k]:.4g} {machine.joint_units[k]} for joint {k + 1}",
            expected=f"{low[k]:.4g} to {high[k]:.4g} {machine.joint_units[k]}",
            code="pose.outside_workspace",
        )


def _drawn(eye: Eye, count: int, rng: np.random.Generator) -> Array:
    """Random poses (count, 4, 4) well inside the ranges, with all seen legs in view."""
    machine, tried = eye.true.machine, 0
    results: list[Array] = [np.zeros((0, 4, 4))]
    low, high = machine.joint_ranges.T
    for _ in range(6):
        if sum(map(len, results)) >= count:
            break
        poses, joints = draw_configurations(machine, 4 * count + 20, 0.0, rng)
        with np.errstate(invalid="ignore"):
            edge = RANGE_END_SHARE * (high - low)
            out = (joints < low + edge) | (joints > high - edge)
        in_view = eye.in_view(eye.points(poses, joints)).all(axis=-1)
        good = ~np.asarray(out.any(axis=-1)) & np.asarray(in_view)
        results.append(poses[good])
        tried += len(poses)
    out = np.concatenate(results)[:count]
    if len(out) < count:
        raise InputError(
            "the camera does not see all legs that it should in enough poses of the workspace",
            found=f"{len(out)} of {tried}",
            expected=str(count),
            next_step="Use a wider lens, another place for the camera, or fewer --legs",
            code="station.sees_too_little",
        )
    return out
