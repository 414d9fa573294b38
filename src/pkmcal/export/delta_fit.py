"""A firmware's parameters fitted to a delta: least squares of the tool's place over the workspace.

Firmwares know ideal deltas: parallel towers on one circle, arms in vertical planes through one
axis. A calibrated machine has more freedoms, so a firmware's model follows it with an error, which
is told. The firmware's frame may lie otherwise than the base frame: where it lies is found along.

Model, firmware's frame, mm and degrees: a linear tower j carries its rod's end at
``(R cos a_j, R sin a_j, m_j)``, an arm at ``((R + U_j cos m_j) (cos a_j, sin a_j), H_j + U_j sin
m_j)``; the rod's length is L_j, and m_j = rate_j * reading_j + zero_j the motor's position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.export.delta import DEGREE, MM, Delta
from pkmcal.geometry.rigid import apply, pose, rotation

FOLLOWS = 0.05
"""mm at the tool beyond which a person is warned: a good kit's repeatability."""
REFUSED = 5.0
"""mm at the tool beyond which the parameters describe another machine."""


@dataclass(frozen=True)
class Freedoms:
    """What a format's parameters leave free.

    nominal : (3,) degrees, the towers' directions; angles : they may differ from it. rods, arms,
    heights : one for each leg, else one for all. flat : hips at Z = 0, so that Z moves instead.
    """

    nominal: tuple[float, float, float]
    angles: bool = True
    rods: bool = True
    arms: bool = True
    heights: bool = True
    flat: bool = False


@dataclass(frozen=True)
class Fit:
    """A firmware's parameters, mm and degrees; arrays (3,) in the firmware's order of towers.

    order : the legs of the mechanism file, from 0. angle : tower directions.
    T_firmware_base : (4, 4) m.
    largest, rms : mm, error at the tool over the grid, its poses taken as commands.
    """

    kind: str
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

    def motors(self, points: Array, near: Array) -> Array:
        """Motor positions (n, 3) at points (n, 3) mm in the firmware's frame; of an arm's two the
        one nearest to ``near`` (n, 3) degrees.
        """
        angle = self.angle / DEGREE
        along = points[:, :1] * np.cos(angle) + points[:, 1:2] * np.sin(angle) - self.radius
        across = points[:, 1:2] * np.cos(angle) - points[:, :1] * np.sin(angle)
        square = self.rod**2 - across**2
        if self.kind == "linear":
            return points[:, 2:] + np.sqrt(np.maximum(square - along**2, 0.0))
        up = points[:, 2:] - self.height
        away = np.hypot(along, up)
        share = (away**2 + self.arm**2 - square) / (2 * self.arm * away)
        half = np.arccos(np.clip(share, -1.0, 1.0))
        both = (np.arctan2(up, along) + np.stack([half, -half])) * DEGREE
        both = both + 360 * np.round((near - both) / 360)
        return np.where(np.abs(both[0] - near) < np.abs(both[1] - near), both[0], both[1])


def fitted(delta: Delta, freedoms: Freedoms, program: str) -> Fit:
    """The parameters that put the tool nearest to where it should be, over the workspace.

    Raises InputError where they leave an error of more than :data:`REFUSED`.
    """
    from scipy.optimize import least_squares

    start = _start(delta, freedoms)
    packed = _Packed(start, freedoms)
    points = delta.positions
    readings = delta.readings[:, start.order]
    by_reading = MM * delta.by_reading[:, :, start.order]

    def off(x: Array) -> Array:
        return _tool_error(packed.fit(x), points, readings, by_reading).ravel()

    # central differences: at an exact model the error ends below a nanometre
    solution = least_squares(off, packed.zeros, jac="3-point", method="lm", xtol=1e-14, ftol=1e-14)
    found = packed.fit(solution.x)
    error = np.linalg.norm(_tool_error(found, points, readings, by_reading), axis=1)
    found = replace(
        found, largest=float(error.max()), rms=float(np.sqrt(np.mean(np.square(error))))
    )
    if not found.largest <= REFUSED:
        raise InputError(
            f"{program} cannot follow this machine: its parameters leave the tool off",
            found=f"{found.largest:.2f} mm",
            expected=f"at most {REFUSED:g} mm over the workspace",
            next_step="Set towers or arms nearer to the drawing, or export the machine with --to c",
        )
    return found


def _tool_error(fit: Fit, positions: Array, readings: Array, by_reading: Array) -> Array:
    """How far (n, 3) mm the tool goes wrong, to first order, where the firmware commands it."""
    points = MM * apply(fit.T_firmware_base, positions)
    own = fit.rate * readings + fit.zero
    wrong = (fit.motors(points, own) - own) / fit.rate
    return (by_reading @ wrong[..., None])[..., 0]


class _Packed:
    """Changes of a start's parameters as one vector x, in mm and degrees, zero at the start."""

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
        """The parameters at x."""
        cuts = np.cumsum([count for _, count in self.parts])[:-1]
        names = [name for name, _ in self.parts]
        by = dict(zip(names, np.split(x, cuts), strict=True))
        own = {
            name: getattr(self.start, name) + by[name]
            for name in ("rod", "angle", "arm", "height", "zero")
            if name in by
        }
        turn = np.concatenate([by["tilt"], by.get("yaw", np.zeros(1))]) / DEGREE
        shift = np.concatenate([by["shift"], by.get("lift", np.zeros(1))]) / MM
        placed = self.start.T_firmware_base
        placed = pose(rotation(turn) @ placed[:3, :3], placed[:3, 3] + shift)
        radius = self.start.radius + float(by["radius"][0])
        return replace(self.start, radius=radius, T_firmware_base=placed, **own)


def _start(delta: Delta, freedoms: Freedoms) -> Fit:
    """The machine taken as ideal: circle through the three hinges, order by their directions."""
    hinge = MM * delta.hinge
    centre = _circle(hinge[:, :2])
    away = hinge[:, :2] - centre
    azimuth = np.arctan2(away[:, 1], away[:, 0]) * DEGREE
    nominal = np.array(freedoms.nominal)
    order = _order(azimuth, nominal)
    off = _wrapped(azimuth[order] - nominal)
    yaw = 0.0 if freedoms.angles else -float(off.mean())
    height = hinge[order, 2]
    lift = _lift(delta)
    if freedoms.flat and delta.kind == "rotary":
        lift = -float(height.mean())
    if not freedoms.heights or freedoms.flat:
        height = np.full(3, height.mean())
    height = np.zeros(3) if freedoms.flat else height + lift
    turn = rotation(np.array([0.0, 0.0, yaw / DEGREE]))
    shift = np.array([0.0, 0.0, lift]) - turn @ np.append(centre, 0.0)
    each = (freedoms.rods, freedoms.arms)
    rod, arm = (
        v[order] if own else np.full(3, v.mean())
        for v, own in zip((MM * delta.rod, MM * delta.arm), each, strict=True)
    )
    zero = delta.zero[order] + (lift if delta.kind == "linear" else 0.0)
    return Fit(
        kind=delta.kind,
        order=order,
        radius=float(np.linalg.norm(away, axis=1).mean()),
        angle=nominal + off if freedoms.angles else nominal,
        rod=rod,
        arm=arm,
        height=height,
        rate=delta.rate[order],
        zero=zero,
        T_firmware_base=pose(turn, shift / MM),
    )


def _lift(delta: Delta) -> float:
    """How far, mm, the firmware's Z is above the base's z: not, or so that no Z is negative."""
    lowest = float(MM * delta.positions[:, 2].min())
    return 0.0 if lowest >= 0 else float(np.ceil(-lowest))


def _order(azimuth: Array, nominal: Array) -> Integers:
    """The legs nearest to the nominal directions, of the orders that go anticlockwise."""
    around = np.argsort(azimuth % 360)
    first = np.argsort(nominal % 360)
    place = np.argsort(first)
    turns = [np.roll(around, k)[place] for k in range(3)]
    off = [float(np.sum(_wrapped(azimuth[order] - nominal) ** 2)) for order in turns]
    return turns[int(np.argmin(off))]


def _wrapped(angle: Array) -> Array:
    return (angle + 180) % 360 - 180


def _circle(points: Array) -> Array:
    """Centre (2,) of the circle through three points (3, 2)."""
    d = points[1:] - points[0]
    return points[0] + np.linalg.solve(2 * d, np.sum(d**2, axis=1))
