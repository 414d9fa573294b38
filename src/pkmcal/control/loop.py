"""Visual servoing of a calibrated machine: from an image and its readings to motor velocities."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.control.goal import (
    GOAL_TOLERANCE,
    Goal,
    GoalImage,
    Status,
    Step,
    aspect_of,
    check_sides,
    checked_normals,
    goal_of,
    leaving,
    missing_clauses,
    motor_name,
    range_sentence,
    vague_sentence,
)
from pkmcal.control.laws import (
    UNCOMMANDED_MOTION_SHARE,
    Task,
    law_named,
    limited,
    solution,
    task_of,
)
from pkmcal.control.machine_view import MachineView, directions_of, legs_from_image, machine_view
from pkmcal.control.track import (
    READINGS_LAG_SIGMA,
    SAME_ASSEMBLY_ANGLE,
    LegLines,
    Sight,
    assembly_sentence,
    check_image,
    first_track_state,
    misfit,
    track,
    weighted_task,
)
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import dot, inverse
from pkmcal.levels import CONTRADICTION_SIGMAS, OUTLIER_SIGMAS
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import NEAR_SINGULAR
from pkmcal.observe.legs import first_binning
from pkmcal.wording import named

__all__ = ["GoalImage", "Status", "Step", "VisualServo"]

UNEXPLAINED_READINGS_LAG = OUTLIER_SIGMAS * READINGS_LAG_SIGMA
"""Difference, in metres, between an image and its readings that a control loop's delay does not
explain."""
VAGUE_DISTANCE_TOLERANCES = 1.48
"""Standard deviation of a reading's distance to the goal, in tolerances, above which there is a
warning; the loop goes on. A normal error is within 1 / 1.48 of its standard deviations in half of
all cases, so that a vaguer image of the goal is not found at the goal in most cases."""
UNSEEN_READING_SIGMA = 0.05
"""Standard deviation of a reading, in m or rad, above which an image does not determine it, and the
loop stops. Not checked within a factor of two."""
OTHER_POSITION_ANGLE = 0.02
"""RMS angle, in rad, that is more than noise: with readings at rest and edges this far from the
goal, the law has reached another equilibrium. Not checked within a factor of two."""
NO_EDGES_TEXT = (
    "likely causes: another assembly than the start's, readings of another image, a camera"
    " that was moved, too little light"
)


@dataclass(frozen=True)
class _Sample:
    """One sample of the control loop.

    normals : (s, 2, 3) edges of the seen legs.
    readings : (m,).
    reasons : (s,) why legs are missing.
    lines : lines of the legs, for a sample from an image.
    pose : (4, 4) from the readings, if computed.
    beside : m by which the image contradicts the readings.
    """

    normals: Array
    readings: Array
    reasons: tuple[str, ...]
    lines: LegLines | None = None
    pose: Array | None = None
    beside: float = 0.0


class VisualServo:
    """Controller of a calibrated machine by its legs in one camera, [B] III with the errata.

    machine : with calibrated values.
    camera : required for images only.
    T_camera_base : (4, 4).
    goal : a platform pose (4, 4), edges (s, 2, 3) of the seen legs, or a :class:`GoalImage`.
    law : "edges" or "directions".
    gain : 1/s; less than the inverse of the time between samples, delay included.
    rate_limits : largest velocity of all motors, or (m,) of each.
    legs : (s,) seen legs from 0, by default all with tubes.
    start : (4, 4) a pose near the machine's first pose, by default its home; it selects the
        assembly mode.
    tolerance : m or rad of a reading, at the goal.
    period : s between samples, to predict the end of a motor's range.
    edge_shift : px of an image, as calibrated.
    binning : pixels that are averaged in each direction before edges are measured; by default such
        that about 1024 remain along the longer side.

    Raises InputError for invalid arguments.
    """

    def __init__(
        self,
        machine: Machine,
        camera: Camera | None,
        T_camera_base: Array,
        goal: Array | GoalImage,
        *,
        law: str = "edges",
        gain: float = 1.0,
        rate_limits: float | Array | None = None,
        legs: Integers | None = None,
        start: Array | None = None,
        tolerance: float = GOAL_TOLERANCE,
        period: float = 0.0,
        edge_shift: float = 0.0,
        binning: int | None = None,
    ) -> None:
        law_named(law)
        _check_positive("gain", gain)
        _check_positive("tolerance", tolerance)
        self.machine, self.law, self.gain = machine, law, gain
        self.tolerance, self.period = tolerance, period
        self.view = machine_view(machine, np.asarray(T_camera_base, dtype=float), legs)
        self.rate_limits = _limits(machine, rate_limits)
        self._sight: Sight | None = None
        if camera is not None:
            pixels = binning or first_binning(camera.image_size)
            self._sight = Sight(self.view, camera, edge_shift, pixels)
        self._ranges = machine.joint_ranges
        self._parts: dict[bytes, MachineView] = {}
        self.goal: Goal = goal_of(self._sight, self.view, goal)
        self.reset(start)

    @classmethod
    def from_calibration(
        cls,
        folder: Path | str,
        station: str,
        goal: Array | GoalImage,
        *,
        session: Path | None = None,
        **options: Any,
    ) -> VisualServo:
        """Controller from the results of ``pkmcal calibrate``: machine, camera and its pose.

        session : folder of the cameras' files, if not above or beside the calibration. options : as
        for the class. Raises InputError if the calibration has no such station, and ResultError for
        a refused calibration.
        """
        from pkmcal.calibration.machine_source import load_source
        from pkmcal.calibration.saved_calibration import load

        saved = load(folder)
        if not saved.verdict.usable:
            raise ResultError(
                what="the calibration was refused: " + " ".join(saved.verdict.reasons),
                where=str(folder),
                next_step="control needs a machine that is known; calibrate again",
                code="calibration.refused",
            )
        source = load_source(folder, session)
        if station not in source.T_base_camera:
            raise InputError(
                what="the calibration has no such station",
                where=str(folder),
                found=station,
                expected=" or ".join(source.T_base_camera),
                code="calibration.no_station",
            )
        if station not in source.cameras:
            raise InputError(
                what="the station's camera file was not found",
                where=str(folder),
                found=station,
                expected="the session above or beside the calibration, with its cameras",
                next_step="give the session's folder as session",
                code="camera.missing",
            )
        file = next(s.camera for s in saved.stations if s.name == station)
        shifts = {c["file"]: float(c["edge_shift"]) for c in saved.document.get("cameras", [])}
        options.setdefault("edge_shift", shifts.get(file, 0.0))
        pixels = {s["name"]: s.get("binning") for s in saved.document.get("stations", [])}
        options.setdefault("binning", pixels.get(station))
        T_camera_base = inverse(source.T_base_camera[station])
        return cls(source.machine, source.cameras[station], T_camera_base, goal, **options)

    def reset(self, start: Array | None = None) -> None:
        """Forget all samples; the next sample is a first one near ``start`` (4, 4), by default
        home.
        """
        self._start = np.asarray(self.machine.home() if start is None else start, dtype=float)
        self._pose, self._started = self._start, False
        self._track = first_track_state(self.view, self._start)

    def step_edges(self, normals: Array, readings: Array) -> Step:
        """Velocities from the edges (s, 2, 3) of the seen legs and the readings (m,).

        The edges are in the camera frame, NaN for a leg that is not seen. Raises InputError for
        invalid arrays.
        """
        edges = checked_normals(self.view, normals, "the edges")
        reasons = ("no edges were given",) * len(self.view.legs)
        return self._step(_Sample(edges, self._checked(readings), reasons))

    def step_image(self, image: Integers, readings: Array) -> Step:
        """Velocities from an image (height, width), uint8, and the readings (m,).

        Raises InputError for an image of another size or type than the camera's.
        """
        if self._sight is None:
            raise InputError(
                "an image needs the camera",
                next_step="give it to VisualServo",
                code="servo.no_camera",
            )
        check_image(image, self._sight.camera)
        q = self._checked(readings)
        at = track(self._sight, self._track, image, q)
        self._track = at.state
        sample = _Sample(
            at.lines.normal, q, at.reasons, at.lines, at.state.T_base_platform, at.beside
        )
        if not at.closed:
            return self._stopped(sample, Status.UNREACHABLE, "")
        if not self._started and 2 * at.valid.sum() < len(at.valid):
            legs = self.view.legs[at.valid].tolist()
            value = f"only {named(legs)} found" if legs else "no leg was found"
            return self._stopped(sample, Status.NOT_AT_READINGS, f"{value}; {NO_EDGES_TEXT}")
        return self._step(sample)

    def _step(self, sample: _Sample) -> Step:
        """Velocities from a sample's edges: checks of the pose, then the law."""
        # legs with edges and a goal
        finite = np.isfinite(sample.normals + self.goal.normals)
        used = np.all(finite.reshape(len(finite), -1), axis=1)
        if not used.any():
            return self._stopped(sample, Status.LOST, self._missing(sample, used))
        in_view = self._part(used)
        pose = self._pose_of(sample, in_view)
        if pose is None:
            return self._stopped(sample, Status.UNREACHABLE, "")
        # first sample: sides of the edges, and the assembly mode
        if not self._started:
            check_sides(self.view, sample.normals, pose)
            off = misfit(self.view, sample.normals, pose, sample.readings)
            if off > SAME_ASSEMBLY_ANGLE:
                why = assembly_sentence(self.view, sample.normals, pose, sample.readings)
                return self._stopped(sample, Status.WRONG_ASSEMBLY, why)
        self._pose = pose
        cosine = dot(sample.normals[used], self.goal.normals[used])
        if np.min(cosine) < 0:
            far = named(in_view.legs[np.min(cosine, axis=1) < 0])
            why = f"{far} would turn by more than 90 degrees in the image; go there in parts"
            return self._stopped(sample, Status.TOO_FAR, why)
        # linearized law, its rows weighted by the image's covariances
        u = directions_of(sample.normals[used])
        legs = legs_from_image(in_view, u, sample.readings, self._pose)
        task = task_of(self.law, in_view, sample.normals[used], self.goal.normals[used], legs)
        error, noise = _root_mean_square(task.error), float("nan")
        if sample.lines is not None:
            task, noise = weighted_task(self.law, task, sample.lines, used)
        return self._answer(sample, used, task, error, noise)

    def _answer(
        self, sample: _Sample, used: Booleans, task: Task, error: float, noise: float
    ) -> Step:
        """Checks of the linearized law, then its solution; noise : standard deviation, in rad, of
        its rows.
        """
        stop = self._unfit(sample, used, task)
        if stop is not None:
            return stop
        has_noise = noise > 0
        sigma = np.full(self.machine.n_joints, np.nan)
        if has_noise:
            # covariance of the readings' distances: R (N^T N)^-1 R^T for rows with unit variance
            factor = task.readings @ np.linalg.inv(task.matrix.T @ task.matrix)
            sigma = noise * np.sqrt(np.sum(factor * task.readings, axis=1))
        vague = float(sigma.max()) if has_noise else 0.0
        if vague > UNSEEN_READING_SIGMA:
            return self._stopped(sample, Status.LOST, self._missing(sample, used))
        self._started = True
        off = task.readings @ solution(task)
        wanted = -self.gain * off
        velocities = limited(wanted, self.rate_limits)
        slowed = bool(np.any(velocities != wanted))
        leaves, outside = leaving(self._ranges, sample.readings, velocities, self.period)
        if leaves.any():
            why = range_sentence(self.machine, self._ranges, sample.readings, leaves)
            return self._stopped(sample, Status.OUT_OF_RANGE, why)
        still = bool(np.max(np.abs(off)) <= self.tolerance)
        # a single direction has more noise than that angle: compare images in standard deviations
        typical = _root_mean_square(task.error / np.sqrt(3)) / noise if has_noise else np.inf
        converged = still and (error < OTHER_POSITION_ANGLE or typical < CONTRADICTION_SIGMAS)
        warnings = self._warnings(sample, used, slowed, outside)
        if still and not converged:
            elsewhere = (
                f"the machine comes to rest with its legs {np.rad2deg(error):.2g} degrees from the"
                " goal's: another equilibrium of the law, or a goal of another machine or camera"
                " place"
            )
            warnings = (*warnings, elsewhere)
        if vague > VAGUE_DISTANCE_TOLERANCES * self.tolerance:
            warnings = (*warnings, vague_sentence(self.machine, sigma))
        status = Status.CONVERGED if converged else Status.RUNNING
        return Step(
            velocities, error, off, sigma, converged, status, status.value, warnings, used,
            sample.normals,
        )  # fmt: skip

    def _unfit(self, sample: _Sample, used: Booleans, task: Task) -> Step | None:
        """Stopped step if the linearized law must not be solved, else None."""
        if not (np.isfinite(task.matrix).all() and np.isfinite(task.readings).all()):
            return self._stopped(sample, Status.SINGULAR, "a motor is in line with its rod")
        # distance from a singular pose, as mechanisms.kinematics.singularity_of has it
        if self.machine.layout.n_internal:
            fk = self.machine.forward_result(sample.readings, self._pose)
            least = float(fk.singularity)
        else:
            rows = task.legs.rows @ task.twist
            least = float(np.linalg.svd(rows, compute_uv=False)[-1])
        if least < NEAR_SINGULAR:
            why = f"smallest singular value {least:.2g}; {NEAR_SINGULAR} is the least allowed"
            return self._stopped(sample, Status.SINGULAR, why)
        squares = np.linalg.eigvalsh(task.matrix.T @ task.matrix)
        if squares[0] < UNCOMMANDED_MOTION_SHARE**2 * squares[-1]:
            return self._stopped(sample, Status.LOST, self._missing(sample, used))
        if aspect_of(self.machine, task.legs) * self.goal.aspect < 0:
            why = "it was crossed, or the goal is in another assembly: choose a goal on this side"
            return self._stopped(sample, Status.CROSSING, why)
        return None

    def _pose_of(self, sample: _Sample, view: MachineView) -> Array | None:
        """Pose (4, 4) from forward kinematics; None if they do not converge.

        Laws that do not need the pose use the last one, which selects the assembly mode only.
        """
        if sample.pose is not None:
            return sample.pose
        if view.by_image_alone and self._started:
            return self._pose
        fk = self.machine.forward_result(sample.readings, self._pose)
        return fk.T_base_platform if bool(fk.converged) else None

    def _part(self, used: Booleans) -> MachineView:
        """Machine view with the used legs only; cached for each choice."""
        key = used.tobytes()
        if key not in self._parts:
            self._parts[key] = self.view.only(used)
        return self._parts[key]

    def _stopped(self, sample: _Sample, status: Status, why: str) -> Step:
        nothing = np.full(self.machine.n_joints, np.nan)
        return Step(
            joint_velocities=np.zeros(self.machine.n_joints),
            error=float("nan"),
            remaining=nothing,
            sigma=nothing,
            converged=False,
            status=status,
            sentence=f"{status.value}: {why}" if why else status.value,
            warnings=(),
            used=np.zeros(len(self.view.legs), dtype=bool),
            normals=sample.normals,
        )

    def _missing(self, sample: _Sample, used: Booleans) -> str:
        """Sentence on the missing legs with their reasons, and on the remaining ones."""
        lost = "; ".join(self._lost(sample, used))
        if not used.any():
            return lost
        remainder = f"{named(self.view.legs[used])} alone cannot show every motion"
        return f"{remainder}; {lost}" if lost else remainder

    def _lost(self, sample: _Sample, used: Booleans) -> list[str]:
        return missing_clauses(self.view.legs, used, self.goal.normals, sample.reasons)

    def _warnings(
        self, sample: _Sample, used: Booleans, slowed: bool, outside: Booleans
    ) -> tuple[str, ...]:
        out = self._lost(sample, used)
        if sample.beside > UNEXPLAINED_READINGS_LAG:
            out.append(
                f"the image contradicts the readings by {sample.beside * 1e3:.1f} mm in a"
                " rod's length: they are of another time, or not this machine's"
            )
        if slowed:
            out.append("slowed down to the motors' largest velocities")
        for k in np.flatnonzero(outside):
            out.append(f"the motor of {motor_name(self.machine, int(k))} is outside its range")
        return tuple(out)

    def _checked(self, readings: Array) -> Array:
        q = np.asarray(readings, dtype=float)
        if q.shape != (self.machine.n_joints,) or not np.isfinite(q).all():
            raise InputError(
                what="the readings are not one finite number a motor",
                found=f"{q.tolist()}" if q.ndim < 2 else f"shape {q.shape}",
                expected=f"{self.machine.n_joints} numbers, in m or rad",
            )
        return q


def _root_mean_square(error: Array) -> float:
    """RMS length, in rad, of a law's error vectors, stacked as (3 k,)."""
    return float(np.sqrt(3 * np.mean(error**2)))


def _check_positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(
            f"{name} must be a positive number", found=value, code="servo.not_positive"
        )


def _limits(machine: Machine, limits: float | Array | None) -> Array | None:
    if limits is None:
        return None
    array = np.broadcast_to(np.asarray(limits, dtype=float), (machine.n_joints,))
    if not (np.isfinite(array) & (array > 0)).all():
        raise InputError(
            "rate limits must be positive numbers", found=array.tolist(), code="servo.not_positive"
        )
    return array
