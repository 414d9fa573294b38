"""Crank on the base, turned by a motor: A is the end of its arm (H4, delta, 6-RUS)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Metres, Point, Radians, Schema
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms.carriers.contract import (
    BaseCarrier,
    Chain,
    Direction,
    NamedMotion,
    ParameterKind,
    Site,
    Sweep,
    direction_by_frame,
    moved_direction,
    moved_point,
    point_by_frame,
    turned_blocks,
    vectors,
)

CRANK_VERTICAL = np.array([0.0, 0.0, 1.0])
"""Vertical direction, from which e0 is derived without ``zero``."""
SLANTED_FROM_AXIS = 1e-3
"""Least angle (rad) between the zero direction and the axis; below it the direction does not define
an angle about the axis."""
CRANK_ZERO_KINDS = tuple(ParameterKind(f"zero.{axis}", "1", "", np.nan) for axis in "xyz")


class CrankDocument(Schema):
    """Crank in a file, ``{joint: crank, center: [x, y, z], axis: [x, y, z], arm: 0.26}``: m, rad,
    base frame.
    """

    joint: Literal["crank"]
    center: Annotated[
        Point,
        Field(description="a point [x, y, z] on the crank's axis, metres, base frame"),
    ]
    axis: Annotated[
        Direction, Field(description="the direction [x, y, z] that the crank turns about")
    ]
    arm: Annotated[Metres, Field(gt=0, description="the arm's length in metres")]
    angle: Radians = 0.0
    zero: Direction | None = None
    along: Metres | None = None
    radial: Metres | None = None
    motor: Annotated[int, Field(ge=1)] | None = None
    range: Sweep | None = None


class _Frame(NamedTuple):
    """Frame of a crank, and its derivatives.

    v : (..., 3) unit axis.
    e0, side : (..., 3) direction at angle zero, and v x e0.
    twist : (..., 3) rotation of e0 about v by a change of v.
    n : (..., 1) length that normalises e0; a change of ``zero`` rotates e0 by side / n.
    drawn : (..., 1) whether the file states ``zero``.
    """

    v: Array
    e0: Array
    side: Array
    twist: Array
    n: Array
    drawn: Array


@final
class Crank(BaseCarrier):
    """End of a crank's arm, ``A = center + along v + radial e0 + arm (cos Q e0 + sin Q v x e0)``
    with Q = reading + angle.

    v is the unit axis. e0 is the file's ``zero`` made orthogonal to v, or without it the horizontal
    ``v x z``, which gives [C] eq. 1 and 4 with Q = q - q0. ``radial`` moves the axis out along e0,
    ``along`` moves the arm along the axis.
    """

    driven: ClassVar = True
    unit: ClassVar = "rad"
    joints: ClassVar = ("crank",)
    schema: ClassVar = CrankDocument
    shared: ClassVar = ("center", "axis", "radial")
    held_in_plane: ClassVar = ("axis",)
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *vectors("axis", "1", "axis"),
        ParameterKind("arm", "m", "arm", label="arm length", part="arm"),
        ParameterKind("angle", "rad", "angle", label="crank angle", part="zero"),
        ParameterKind("along", "m", "center", label="place along the crank axis"),
        ParameterKind("radial", "m", "center", label="crank axis distance"),
        *CRANK_ZERO_KINDS,
    )

    @classmethod
    def check(cls, node: CrankDocument, site: Site) -> None:
        """Refuse a zero direction (the vertical by default) that is parallel to the axis."""
        super().check(node, site)
        direction = node.zero if node.zero is not None else (0.0, 0.0, 1.0)
        if np.linalg.norm(np.cross(direction, node.axis)) > SLANTED_FROM_AXIS:
            return
        if node.zero is None:
            raise InputError(
                f"the crank of leg {site.leg} turns about a vertical axis, so no horizontal "
                "direction square to it is the first",
                where=site.where("axis"),
                expected="zero: [x, y, z], the arm's direction at angle 0",
            )
        raise InputError(
            f"the crank of leg {site.leg} has its zero direction along its axis",
            where=site.where("zero"),
            expected="the arm's direction at angle 0, across the axis",
        )

    @staticmethod
    def motions(parameters: Array, readings: Array) -> tuple[NamedMotion, ...]:
        """Tilt of the axis, and position of the arm along it."""
        del readings
        tilt = np.zeros((parameters.size, 4))
        tilt[3:6, :3] = np.eye(3)
        tilt[:3, 3] = parameters[3:6]
        return (
            NamedMotion(
                tilt,
                one="how the crank's axis of {legs} is tilted, and where its arm is along it, {is}",
                several="how the crank's axis of each of {legs} is tilted, and where its arm is"
                " along it, {is}",
                together="how the cranks' axes of {legs} are tilted to each other, with the arms'"
                " places along them, {is} {ways}{mostly}",
            ),
        )

    @staticmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """A, and its derivative: the arm's length times its direction of motion."""
        frame = _frame(parameters)
        arm, _, along, radial = (parameters[..., k, None] for k in range(6, 10))
        out, ahead = _arm_directions(frame, parameters, readings)
        value = parameters[..., :3] + along * frame.v + radial * frame.e0 + arm * out
        return value, arm * ahead

    @classmethod
    def by_parameters(cls, parameters: Array, readings: Array) -> Array:
        """Derivatives in the parameters' order."""
        frame = _frame(parameters)
        v, e0, side = frame.v, frame.e0, frame.side
        arm, _, along, radial = (parameters[..., k, None] for k in range(6, 10))
        out, ahead = _arm_directions(frame, parameters, readings)
        by_reading = arm * ahead
        # A change of v rotates the frame by the twist about v, and tilts e0 and side with v.
        swing = radial * side + by_reading
        pull = radial * e0 + arm * out
        by_v = along[..., None] * np.eye(3) + _outer(swing, frame.twist) - _outer(v, pull)
        by_zero = _outer(swing, side * frame.drawn / frame.n)
        by_parameters = np.zeros((*by_reading.shape, 13))
        by_parameters[..., :3] = np.eye(3)
        by_parameters[..., 3:6] = _by_axis(by_v, v, parameters)
        for k, column in enumerate((out, by_reading, v, e0), start=6):
            by_parameters[..., k] = column
        by_parameters[..., 10:] = by_zero
        return by_parameters

    @classmethod
    def reading(cls, parameters: Array, point_b: Array, length: Array, near: Array) -> Array:
        """Closed-form readings, errata, Model 31: ``Q = atan2(s, p) -+ acos(g / |(p, s)|)``, d = B
        - center - along v - radial e0, p = d . e0, s = d . (v x e0), g = (|d|^2 + arm^2 - length^2)
        / (2 arm).
        """
        frame = _frame(parameters)
        arm, angle, along, radial = (parameters[..., k] for k in range(6, 10))
        foot = along[..., None] * frame.v + radial[..., None] * frame.e0
        d = point_b - parameters[..., :3] - foot
        p, s = dot(d, frame.e0), dot(d, frame.side)
        reach = np.sqrt(p * p + s * s)
        share = (dot(d, d) + arm**2 - length**2) / (2 * arm * np.where(reach > 0, reach, np.nan))
        half = np.arccos(np.where(np.abs(share) <= 1, share, np.nan))
        both = np.stack([np.arctan2(s, p) + half, np.arctan2(s, p) - half]) - angle
        apart = (both - near + np.pi) % (2 * np.pi) - np.pi
        first, second = apart
        return near + np.where(np.abs(first) <= np.abs(second), first, second)

    @classmethod
    def reframed(cls, parameters: Array, e: Array, f: Array) -> Array:
        """Parameters in new frames: centre and axis move with the base frame.

        ``zero`` and the vertical do not change, so the angle takes up the rotation of e0 against
        them.
        """
        del f
        out = np.array(
            np.broadcast_to(parameters, (*_leading_shape(parameters, e), parameters.shape[-1]))
        )
        out[..., :3] = moved_point(parameters[..., :3], e)
        out[..., 3:6] = moved_direction(parameters[..., 3:6], e)
        carried, now = moved_direction(_frame(parameters).e0, e), _frame(out)
        # radial is along e0, whose rotation shifts the centre
        out[..., :3] += parameters[..., 9, None] * (carried - now.e0)
        out[..., 7] += np.arctan2(dot(carried, now.side), dot(carried, now.e0))
        return out

    @classmethod
    def by_frames(cls, parameters: Array) -> Array:
        """Derivatives by E; the angle changes by ``v - v x twist``."""
        frame = _frame(parameters)
        out = np.zeros((*parameters.shape, 12))
        out[..., :3, :6] = point_by_frame(parameters[..., :3])
        out[..., 3:6, :6] = direction_by_frame(parameters[..., 3:6])
        turn = frame.v - cross(frame.v, frame.twist)
        out[..., 7, :3] = turn
        out[..., :3, :3] += parameters[..., 9, None, None] * _outer(frame.side, turn)
        return out

    @classmethod
    def carried(cls, parameters: Array, e: Array, f: Array) -> Array:
        """Rotations of centre and axis, and the change of the twist of e0 between the frames."""
        before, after = _frame(parameters), _frame(Crank.reframed(parameters, e, f))
        rot = e[..., :3, :3]
        n = parameters.shape[-1]
        shape = (*_leading_shape(parameters, e), n, n)
        out = np.array(np.broadcast_to(turned_blocks(n, (0, e), (3, e)), shape))
        # The angle takes up the change of the twist.
        twist = before.twist[..., None, :] - after.twist[..., None, :] @ rot
        out[..., 7:8, 3:6] = _by_axis(twist, before.v, parameters)
        # The centre takes up the change of radial e0.
        lag = rot @ _turn_of_e0(before) - _turn_of_e0(after) @ rot
        lag = parameters[..., 9, None, None] * lag
        out[..., :3, 3:6] = _by_axis(lag, before.v, parameters)
        out[..., :3, 9] = moved_direction(before.e0, e) - after.e0
        return out

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """Arm at reading zero, turning about v; its foot is ``center + along v + radial e0``."""
        frame = _frame(parameters)
        arm, _, along, radial = (parameters[..., k, None] for k in range(6, 10))
        out, _ = _arm_directions(frame, parameters, np.zeros(parameters.shape[:-1]))
        foot = parameters[..., :3] + along * frame.v + radial * frame.e0
        return Chain("turn", foot, frame.v, arm * out)


def _frame(parameters: Array) -> _Frame:
    """Frame of the crank with its derivatives by the parameters."""
    axis, zero = parameters[..., 3:6], parameters[..., 10:13]
    drawn = np.isfinite(zero[..., :1])
    zero = np.where(drawn, zero, CRANK_VERTICAL)
    v = axis / np.sqrt(dot(axis, axis))[..., None]
    high = dot(zero, v)[..., None]
    raw = np.where(drawn, zero - high * v, cross(v, zero))
    n = np.sqrt(dot(raw, raw))[..., None]
    e0 = raw / n
    side = cross(v, e0)
    twist = np.where(drawn, -high * side, cross(CRANK_VERTICAL, side)) / n
    return _Frame(v, e0, side, twist, n, drawn)


def _arm_directions(frame: _Frame, parameters: Array, readings: Array) -> tuple[Array, Array]:
    """Arm's direction, and the direction in which its end moves, (..., 3) each."""
    turn = readings[..., None] + parameters[..., 7, None]
    c, s = np.cos(turn), np.sin(turn)
    return c * frame.e0 + s * frame.side, c * frame.side - s * frame.e0


def _outer(a: Array, b: Array) -> Array:
    """Outer products (..., m, n) of vectors."""
    return a[..., :, None] * b[..., None, :]


def _leading_shape(parameters: Array, transform: Array) -> tuple[int, ...]:
    """Leading shape of parameters and transforms, broadcast."""
    return np.broadcast_shapes(parameters.shape[:-1], transform.shape[:-2])


def _turn_of_e0(frame: _Frame) -> Array:
    """Derivative (..., 3, 3) of e0 by v."""
    return _outer(frame.side, frame.twist) - _outer(frame.v, frame.e0)


def _by_axis(by_v: Array, v: Array, parameters: Array) -> Array:
    """Derivatives (..., k, 3) by the file's axis, of any length, from those by the unit axis."""
    size = np.sqrt(dot(parameters[..., 3:6], parameters[..., 3:6]))[..., None, None]
    return (by_v - (by_v @ v[..., None]) * v[..., None, :]) / size
