"""Delta robots in the parameters of firmwares, fitted over the workspace.

Firmwares model ideal deltas: parallel towers on one circle, or arms in vertical planes through one
axis. A calibrated machine has more degrees of freedom, so a firmware's model deviates from it; the
export states the deviation. The firmware's frame may differ from the base frame: the fit includes
the transformation.

Model, in the firmware's frame, mm and degrees: a linear tower j carries its rod's end at ``(R cos
a_j, R sin a_j, m_j)``, an arm at ``((R + U_j cos m_j) (cos a_j, sin a_j), H_j + U_j sin m_j)``;
L_j is the length of the rod, and m_j = rate_j * reading_j + zero_j the motor's position.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import UNWARNED_ERROR
from pkmcal.exporters.limbs import (
    FLOAT_CARRIER,
    SLIDE_CARRIER,
    TURN_CARRIER,
    Limbs,
    all_limbs,
    rod_limbs,
)
from pkmcal.geometry.rigid import apply, dot, pose, rotation
from pkmcal.identify.tool import pose_by_parameters
from pkmcal.levels import MAJORITY
from pkmcal.mechanisms import Machine
from pkmcal.outcome.finding import Finding, doubtful, note

STEPS_FROM_HOME = 8
"""Continuation steps from home to a pose of the grid."""
GRID_READINGS_A_MOTOR = 7
"""Grid readings of each motor: ends, middle, and two on either side."""
LEAST_DELTA_SINGULARITY = 0.12
"""Least singular value of the scaled inverse Jacobian: readings' errors grow at most eightfold."""
FASTEST_MOTOR_RATIO = 4.0
"""Largest ratio of a carriage's or elbow's speed to the tool's.

Beyond it a rod is nearly perpendicular to the motion of its motor, and firmwares divide by the
cosine.
"""
LEAST_UPRIGHT_PART = MAJORITY**0.5
"""Least vertical component of a tower, or radial component of an arm's plane: within 45 degrees,
more upright than level."""
MM_A_METRE = 1e3
DEGREES_A_RADIAN = 180 / np.pi
UNWARNED_TOOL_ERROR = MM_A_METRE * UNWARNED_ERROR
"""Largest tool error without a warning, mm."""
MOST_TOOL_ERROR = 5.0
"""Largest tool error, mm; beyond it the parameters describe another machine."""
UNPLACED_BED_SIGMA = 1.0
"""Prior sigma of the bed's height, m: far more than any data leave."""
VALUE_STEP = 1e-3
"""Step of numerical derivatives by a fit's parameters, mm or degrees."""


# The machine


@dataclass(frozen=True)
class Delta:
    """Three legs of a machine as a delta, in the order of its file; mm and degrees as in firmwares.

    program : target firmware.
    kind : linear or rotary.
    joint : (3,) columns of the readings.
    hinge : (3, 3) m; a tower's joint at reading zero, or a point of an arm's axis, less the
        platform's joint: the fixed point of the rod when its far end is moved to the platform's
        origin.
    arm, rod : (3,) m.
    rate, zero : (3,); motor position (carriage height in mm, or angle above the horizontal in
        degrees) = rate * reading + zero for an ideal machine.
    ends : (3,) readings at the upper end of the range.
    poses : (n, 4, 4) over the workspace.
    readings : (n, 3) by leg.
    by_reading : (n, 3, 3) derivative of the platform's position, m, by the legs' readings.
    bed : z of the platform's origin on a probed bed, m; None without.
    """

    machine: Machine
    program: str
    kind: str
    joint: Integers
    hinge: Array
    arm: Array
    rod: Array
    rate: Array
    zero: Array
    ends: Array
    poses: Array
    readings: Array
    by_reading: Array
    bed: float | None = None

    @property
    def positions(self) -> Array:
        """Platform positions of the grid, (n, 3) m, base frame."""
        return self.poses[:, :3, 3]


def delta_of(machine: Machine, program: str, bed: float | None = None) -> Delta:
    """Machine as a delta. Raises InputError for a machine that is none, or without ranges.

    program, bed : as in :class:`Delta`.
    """
    # a delta: three rods, each on a slide or crank of its own, platform without rotation
    limbs, motion = all_limbs(machine), machine.document.motion
    if motion != "translation" or set(limbs.drive) not in ({SLIDE_CARRIER}, {TURN_CARRIER}):
        joints = sorted({leg.base.joint for leg in machine.document.legs})
        description = f"motion {motion}, {machine.n_legs} legs on {', '.join(joints)} joints"
        raise _no_delta(machine, program, description)
    rods = rod_limbs(machine)
    if len(rods) != 3 or machine.n_joints != 3 or FLOAT_CARRIER in rods.held:
        raise _no_delta(machine, program, f"{len(rods)} rods, {machine.n_joints} motors")
    ranges = machine.joint_ranges[rods.joint]
    if not np.isfinite(ranges).all():
        raise InputError(
            f"mechanism {machine.name!r} gives no range for a motor, so its ends are not known",
            expected="range: [min, max] at every slider or crank",
            next_step="Add the ranges: the firmware's end switches are put at their upper ends",
            code="export.no_range",
        )
    # motor position = rate * reading + zero, for the ideal machine
    linear = rods.drive[0] == SLIDE_CARRIER
    rate, zero = _towers(rods) if linear else _arms(rods, rods.scale * ranges.mean(axis=1))
    rate = rods.scale * rate
    if np.isnan(zero).any():
        what = "towers that lean" if linear else "arms that do not swing outwards"
        raise _no_delta(machine, program, what)
    arm = np.ones(3) if linear else np.sqrt(dot(rods.arm, rods.arm))
    poses, readings, by_reading = _workspace(machine, rods.joint, arm)
    if linear:
        # beyond a horizontal rod lies the other assembly mode, with the tool above a carriage;
        # the inverse of firmwares has it not
        home = machine.home()
        at_home = machine.inverse(home)[rods.joint]
        above, above_home = (
            rate * q + zero - MM_A_METRE * (z + rods.platform[:, 2])
            for q, z in ((readings, poses[:, 2, 3, None]), (at_home, home[2, 3]))
        )
        hangs = (above * above_home > 0).all(axis=1)
        poses, readings, by_reading = poses[hangs], readings[hangs], by_reading[hangs]
    return Delta(
        machine=machine,
        program=program,
        kind="linear" if linear else "rotary",
        joint=rods.joint,
        hinge=rods.base - rods.platform @ machine.home()[:3, :3].T,
        arm=arm,
        rod=rods.length,
        rate=rate,
        zero=zero,
        ends=np.where(rate > 0, ranges[:, 1], ranges[:, 0]),
        poses=poses,
        readings=readings,
        by_reading=by_reading,
        bed=bed,
    )


def _no_delta(machine: Machine, program: str, text: str) -> InputError:
    """Error for a machine that is no delta."""
    return InputError(
        f"{program} has settings for deltas, and mechanism {machine.name!r} is none",
        found=text,
        expected="motion: translation with three sliders, or three cranks, and rods",
        next_step="Export it with --to c",
        code="export.no_delta",
    )


def _towers(rods: Limbs) -> tuple[Array, Array]:
    """Rate (mm/m) and zero (mm) of ideal towers; NaN where they lean."""
    up = rods.axis[:, 2]
    return np.sign(up) * MM_A_METRE, np.where(
        np.abs(up) > LEAST_UPRIGHT_PART, MM_A_METRE * rods.base[:, 2], np.nan
    )


def _arms(rods: Limbs, middle: Array) -> tuple[Array, Array]:
    """Rate (degree/rad) and zero (degrees) of ideal arms, exact at the middle of the range.

    middle : (3,) rad. NaN where an arm does not swing in a radial vertical plane.
    """
    # direction outwards from the centre, in the horizontal plane
    radial = (rods.base - rods.base.mean(axis=0)) * [1, 1, 0]
    radial = radial / np.linalg.norm(radial, axis=1, keepdims=True)
    size = np.sqrt(dot(rods.arm, rods.arm))[:, None]
    c, s = np.cos(middle)[:, None], np.sin(middle)[:, None]
    # arm and its derivative at mid-range, in the plane of radial direction and z
    at, ahead = (c * rods.arm + s * rods.rate) / size, (c * rods.rate - s * rods.arm) / size
    out, d_out = dot(at, radial), dot(ahead, radial)
    sign = np.sign(out * ahead[:, 2] - at[:, 2] * d_out)
    zero = np.arctan2(at[:, 2], out) - sign * middle
    return sign * DEGREES_A_RADIAN, np.where(
        np.hypot(out, d_out) > LEAST_UPRIGHT_PART, DEGREES_A_RADIAN * zero, np.nan
    )


def _workspace(machine: Machine, joint: Integers, arm: Array) -> tuple[Array, Array, Array]:
    """Grid poses far from singularities, their readings by leg, and derivatives of the position.

    Raises InputError if no grid pose closes.
    """
    ends = machine.joint_ranges
    axes = [np.linspace(low, high, GRID_READINGS_A_MOTOR) for low, high in ends]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(ends))
    # continuation from home: a start far away may converge to the assembly mode with the tool
    # above the carriages
    home = machine.home()
    begin = machine.inverse(home)
    begin = np.where(np.isfinite(begin), begin, grid)  # for a motor that cannot reach home
    fk = machine.forward_result(begin, np.broadcast_to(home, (len(grid), 4, 4)))
    for share in np.linspace(0, 1, STEPS_FROM_HOME + 1)[1:]:
        readings = begin + share * (grid - begin)
        fk = machine.forward_result(readings, fk.T_base_platform)
    poses = fk.T_base_platform
    # reachable poses, away from singularities, with the readings that were put in
    back = machine.inverse(poses)
    usable = fk.converged & (fk.singularity > LEAST_DELTA_SINGULARITY)
    usable &= np.nan_to_num(np.abs(back - grid).max(axis=1), nan=1.0) < 1e-9
    # speed of each carriage or elbow per speed of the tool
    speed_ratios = np.linalg.norm(machine.inverse_jacobian(poses)[:, joint, 3:], axis=-1)
    usable &= np.nan_to_num(speed_ratios * arm, nan=np.inf).max(axis=1) < FASTEST_MOTOR_RATIO
    if not usable.any():
        raise InputError(
            f"mechanism {machine.name!r} closes nowhere within its ranges",
            code="export.no_workspace",
            next_step="Check the ranges in the mechanism file",
        )
    poses = poses[usable]
    by_reading = machine.forward_jacobian(poses)[:, 3:, :][..., joint]
    return poses, grid[usable][:, joint], by_reading


# The fit


@dataclass(frozen=True)
class Freedoms:
    """Free parameters of a format.

    nominal : (3,) degrees, directions of the towers.
    angles : directions are free.
    rods, arms, heights : one value for each leg, else one for all.
    flat : shoulders are at Z = 0; the frame's Z shift is free instead.
    """

    nominal: tuple[float, float, float]
    angles: bool = True
    rods: bool = True
    arms: bool = True
    heights: bool = True
    flat: bool = False


@dataclass(frozen=True)
class Fit:
    """Parameters of a firmware, mm and degrees; arrays (3,) in the firmware's order of towers.

    delta : the machine fitted to.
    order : legs of the mechanism file, from 0.
    angle : tower directions.
    T_firmware_base : (4, 4) m.
    largest, rms : mm; error at the tool over the grid, its poses taken as commands.
    """

    delta: Delta
    order: Integers
    radius: float
    angle: Array
    rod: Array
    arm: Array
    height: Array
    rate: Array
    zero: Array
    T_firmware_base: Array
    largest: float = 0.0
    rms: float = 0.0

    @property
    def kind(self) -> str:
        """Linear or rotary."""
        return self.delta.kind

    @property
    def end_motors(self) -> Array:
        """Motor positions (3,) at the end switches."""
        return self.rate * self.delta.ends[self.order] + self.zero

    @property
    def following(self) -> Finding:
        """Finding on the agreement of settings and machine, a warning if it is poor.

        The error is rounded up, so that the statement holds.
        """
        facts = {
            "program": self.delta.program,
            "largest": math.ceil(self.largest * 1e3) / 1e3,
            "rms": self.rms,
        }
        if self.largest <= UNWARNED_TOOL_ERROR:
            return note("export.follows", **facts)
        return doubtful("export.follows_badly", **facts, kind=self.kind)

    def motors(self, points: Array, near: Array) -> Array:
        """Motor positions (n, 3) at points (n, 3) mm in the firmware's frame.

        near : (n, 3) degrees; of an arm's two solutions the nearest is taken.
        """
        angle = self.angle / DEGREES_A_RADIAN
        # coordinates of the tool in each tower's vertical plane: along, across, up
        along = points[:, :1] * np.cos(angle) + points[:, 1:2] * np.sin(angle) - self.radius
        across = points[:, 1:2] * np.cos(angle) - points[:, :1] * np.sin(angle)
        square = self.rod**2 - across**2
        if self.kind == "linear":
            return points[:, 2:] + np.sqrt(np.maximum(square - along**2, 0.0))
        up = points[:, 2:] - self.height
        # law of cosines for the angle between arm and line from shoulder to tool
        away = np.hypot(along, up)
        share = (away**2 + self.arm**2 - square) / (2 * self.arm * away)
        half = np.arccos(np.clip(share, -1.0, 1.0))
        both = (np.arctan2(up, along) + np.stack([half, -half])) * DEGREES_A_RADIAN
        both = both + 360 * np.round((near - both) / 360)
        return np.where(np.abs(both[0] - near) < np.abs(both[1] - near), both[0], both[1])


@lru_cache(maxsize=1)
def fit_of(
    source: MachineSource, program: str, linear: Freedoms, rotary: Freedoms | None = None
) -> Fit:
    """Parameters of a firmware for a source's machine, with the free parameters of its kind.

    The text, its check, its values and its notes have the same fit, so the last one is retained.
    Raises InputError for a machine that is no delta, or a rotary one without `rotary`.
    """
    delta = delta_of(source.machine, program, source.bed)
    freedoms = linear if delta.kind == "linear" else rotary
    if freedoms is None:
        raise InputError(
            f"{program} has settings for linear deltas, and mechanism"
            f" {source.machine.name!r} is a rotary one",
            expected="three sliders",
            next_step="Export it with --to klipper or --to reprap",
            code="export.no_linear_delta",
        )
    return nearest_fit(delta, freedoms)


def nearest_fit(delta: Delta, freedoms: Freedoms) -> Fit:
    """Parameters that minimise the tool's error over the workspace.

    Raises InputError if the error remains above :data:`MOST_TOOL_ERROR`.
    """
    from scipy.optimize import least_squares

    # minimise the tool's error over the grid, from the ideal machine
    start = _start(delta, freedoms)
    packed = _ParameterVector(start, freedoms)
    points = delta.positions
    readings = delta.readings[:, start.order]
    by_reading = MM_A_METRE * delta.by_reading[:, :, start.order]

    def off(x: Array) -> Array:
        return _tool_error(packed.fit(x), points, readings, by_reading).ravel()

    # central differences: at an exact model the error falls below a nanometre
    solution = least_squares(off, packed.zeros, jac="3-point", method="lm", xtol=1e-14, ftol=1e-14)
    fit = packed.fit(solution.x)
    error = np.linalg.norm(_tool_error(fit, points, readings, by_reading), axis=1)
    fit = replace(fit, largest=float(error.max()), rms=float(np.sqrt(np.mean(np.square(error)))))
    if not fit.largest <= MOST_TOOL_ERROR:
        raise InputError(
            f"{delta.program} cannot follow this machine: its parameters leave the tool off",
            found=f"{fit.largest:.2f} mm",
            expected=f"at most {MOST_TOOL_ERROR:g} mm over the workspace",
            next_step="Set towers or arms nearer to the nominal model, or export the"
            " machine with --to c",
            code="export.not_followed",
        )
    return fit


def value_sigmas(
    fit: Fit, freedoms: Freedoms, source: MachineSource, values: Callable[[Fit], Array]
) -> tuple[Array, Array] | None:
    """Standard deviations (k,) of a firmware's values, by the calibration and by the nominal
    model's prior sigmas alone; None for a machine without a covariance.

    The fit's parameters x minimise the tool's error r(x, theta) over the grid, so that ``dx = -J^+
    dr`` with J = dr/dx. A change of the machine, or of the bed's height, moves the tool at given
    motor positions: dr is that displacement. Scales of readings change no motor position.

    values : (k,) by the firmware's own formulas from a fit.
    """
    if source.covariance is None:
        return None
    delta, machine = fit.delta, source.machine
    # the tool's error by the fit's parameters, (3 n, x)
    packed = _ParameterVector(fit, freedoms)
    readings = delta.readings[:, fit.order]
    by_reading = MM_A_METRE * delta.by_reading[:, :, fit.order]

    def off(x: Array) -> Array:
        return _tool_error(packed.fit(x), delta.positions, readings, by_reading).ravel()

    by_fit = _differences(off, packed.zeros)
    # by the machine's parameters, and by the bed's height, which lowers the firmware's frame
    joints = np.zeros_like(delta.readings)
    joints[:, delta.joint] = delta.readings
    by_machine = MM_A_METRE * pose_by_parameters(machine, joints, delta.poses)[:, 3:]
    by_machine[..., machine.parameters.of_kind("scale")] = 0.0
    by_bed = np.zeros((len(joints), 3, 1))
    by_bed[:, 2] = -MM_A_METRE
    displaced = np.concatenate([by_machine, by_bed], axis=2).reshape(len(by_fit), -1)
    by_source = -np.linalg.lstsq(by_fit, displaced, rcond=None)[0]
    by_values = _differences(lambda x: values(packed.fit(x)), packed.zeros) @ by_source
    # covariance of the parameters and the bed
    n = len(source.covariance)
    root = np.eye(n + 1, n)
    if source.bed_by_parameters is not None:
        root[n] = source.bed_by_parameters
    covariance = root @ source.covariance @ root.T
    covariance[n, n] += (source.bed_sigma or 0.0) ** 2
    # prior of the same; nothing but the data places the bed
    free = machine.parameters.free_matrix() * machine.parameters.tolerances_free()
    prior = np.zeros((n + 1, n + 1))
    prior[:n, :n] = free @ free.T
    prior[n, n] = UNPLACED_BED_SIGMA**2
    variances = (
        np.einsum("ij,jk,ik->i", by_values, of_source, by_values)
        for of_source in (covariance, prior)
    )
    posterior, nominal = (np.sqrt(np.maximum(variance, 0.0)) for variance in variances)
    return posterior, nominal


def _differences(function: Callable[[Array], Array], at: Array) -> Array:
    """Derivative (n, x) by central differences of VALUE_STEP."""
    steps = VALUE_STEP * np.eye(len(at))
    columns = [(function(at + step) - function(at - step)) / (2 * VALUE_STEP) for step in steps]
    return np.stack(columns, axis=1)


def _tool_error(fit: Fit, positions: Array, readings: Array, by_reading: Array) -> Array:
    """Tool error (n, 3) mm, to first order, at positions that the firmware commands."""
    # motor positions that the firmware commands for the tool's true positions
    points = MM_A_METRE * apply(fit.T_firmware_base, positions)
    own = fit.rate * readings + fit.zero
    wrong = (fit.motors(points, own) - own) / fit.rate
    return (by_reading @ wrong[..., None])[..., 0]


class _ParameterVector:
    """Changes of the start's parameters as a vector x, mm and degrees; zero at the start."""

    def __init__(self, start: Fit, freedoms: Freedoms) -> None:
        self.start = start
        rotary = start.kind == "rotary"
        parts: list[tuple[str, int]] = [("radius", 1), ("zero", 3), ("tilt", 2), ("shift", 2)]
        parts.append(("rod", 3 if freedoms.rods else 1))
        parts.append(("angle", 3) if freedoms.angles else ("yaw", 1))
        if rotary:
            parts.append(("arm", 3 if freedoms.arms else 1))
            if freedoms.flat:
                parts.append(("lift", 1))
            else:
                parts.append(("height", 3 if freedoms.heights else 1))
        self.parts = parts
        self.zeros = np.zeros(sum(count for _, count in parts))

    def fit(self, x: Array) -> Fit:
        """Parameters at x."""
        cuts = np.cumsum([count for _, count in self.parts])[:-1]
        names = [name for name, _ in self.parts]
        changes = dict(zip(names, np.split(x, cuts), strict=True))
        own = {
            name: getattr(self.start, name) + changes[name]
            for name in ("rod", "angle", "arm", "height", "zero")
            if name in changes
        }
        turn = np.concatenate([changes["tilt"], changes.get("yaw", np.zeros(1))]) / DEGREES_A_RADIAN
        shift = np.concatenate([changes["shift"], changes.get("lift", np.zeros(1))]) / MM_A_METRE
        placed = self.start.T_firmware_base
        placed = pose(rotation(turn) @ placed[:3, :3], placed[:3, 3] + shift)
        radius = self.start.radius + float(changes["radius"][0])
        return replace(self.start, radius=radius, T_firmware_base=placed, **own)


def _start(delta: Delta, freedoms: Freedoms) -> Fit:
    """Start of the fit: the machine as an ideal delta, with the circle through the three hinges."""
    hinge = MM_A_METRE * delta.hinge
    # circle through the hinges, and the order of the legs by their directions
    d = hinge[1:, :2] - hinge[0, :2]
    centre = hinge[0, :2] + np.linalg.solve(2 * d, np.sum(d**2, axis=1))
    away = hinge[:, :2] - centre
    azimuth = np.arctan2(away[:, 1], away[:, 0]) * DEGREES_A_RADIAN
    nominal = np.array(freedoms.nominal)
    order = _order(azimuth, nominal)
    off = _wrapped(azimuth[order] - nominal)
    yaw = 0.0 if freedoms.angles else -float(off.mean())
    # heights: of each hinge, common, or zero with the frame at the hinges
    height = hinge[order, 2]
    lift = _lift(delta)
    if freedoms.flat and delta.kind == "rotary":
        lift = -float(height.mean())
    if not freedoms.heights or freedoms.flat:
        height = np.full(3, height.mean())
    height = np.zeros(3) if freedoms.flat else height + lift
    # frame: origin at the circle's centre, turned to the nominal directions if these are fixed
    turn = rotation(np.array([0.0, 0.0, yaw / DEGREES_A_RADIAN]))
    shift = np.array([0.0, 0.0, lift]) - turn @ np.append(centre, 0.0)
    # lengths: of each leg, or their mean
    each = (freedoms.rods, freedoms.arms)
    rod, arm = (
        v[order] if own else np.full(3, v.mean())
        for v, own in zip((MM_A_METRE * delta.rod, MM_A_METRE * delta.arm), each, strict=True)
    )
    zero = delta.zero[order] + (lift if delta.kind == "linear" else 0.0)
    return Fit(
        delta=delta,
        order=order,
        radius=float(np.linalg.norm(away, axis=1).mean()),
        angle=nominal + off if freedoms.angles else nominal,
        rod=rod,
        arm=arm,
        height=height,
        rate=delta.rate[order],
        zero=zero,
        T_firmware_base=pose(turn, shift / MM_A_METRE),
    )


def _lift(delta: Delta) -> float:
    """Z of the firmware's frame above the base's z, mm.

    A probed bed gets Z = 0. Without one: 0 if home is above z = 0, which then is the bed; for a
    machine that hangs from its base the least whole number of mm that leaves no Z negative.
    """
    if delta.bed is not None:
        return -MM_A_METRE * delta.bed
    lowest = float(MM_A_METRE * delta.positions[:, 2].min())
    above = delta.machine.home()[2, 3] > 0
    return 0.0 if above or lowest >= 0 else float(np.ceil(-lowest))


def _order(azimuth: Array, nominal: Array) -> Integers:
    """Cyclic order of the legs, anticlockwise, that is nearest to the nominal directions."""
    around = np.argsort(azimuth % 360)
    first = np.argsort(nominal % 360)
    place = np.argsort(first)
    turns = [np.roll(around, k)[place] for k in range(3)]
    off = [float(np.sum(_wrapped(azimuth[order] - nominal) ** 2)) for order in turns]
    return turns[int(np.argmin(off))]


def _wrapped(angle: Array) -> Array:
    """Angle in [-180, 180) degrees."""
    return (angle + 180) % 360 - 180
