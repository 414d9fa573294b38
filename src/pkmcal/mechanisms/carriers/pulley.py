"""Cables that leave the base over a swivelling pulley, read as their length or at their spool.

The cable reaches the pulley at ``center``, in the direction of ``axis``, about which the pulley
swivels until the platform's end B lies in its plane. With the distance rho of B from the axis, the
unit vectors s along the axis and e square to it towards B, and the angle t of the cable around the
pulley::

    M = center + r e             middle of the pulley
    P = M + r (-e cos t + s sin t)   point where the free cable begins
    B = P + l (e sin t + s cos t)    end of the cable

The cable is ``r t + l`` long. Pott, Cable-Driven Parallel Robots (2018), 4.3.

A spool of radius R pays out ``R phi - k phi^2 / 4`` while it turns by phi: the cable left on it
grows the square of its radius by k for each metre, so that ``radius^2 = R^2 - k paid``.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Metres, Point, Schema
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms.carriers.contract import (
    BaseCarrier,
    Direction,
    ParameterKind,
    Site,
    Sweep,
    Winding,
    vectors,
)

PULLEY_ENTRY = (0.0, 0.0, 1.0)
"""Direction in which a cable reaches a pulley without radius, which has no effect."""
Radius = Annotated[Metres, Field(gt=0)]


class PulleyDocument(Schema):
    """Pulley in a file, ``{joint: pulley, center: [x, y, z], axis: [x, y, z], radius: 25 mm}``."""

    joint: Literal["pulley"]
    center: Annotated[Point, Field(description="where the cable reaches the pulley, base frame")]
    axis: Annotated[
        Direction,
        Field(description="the direction [x, y, z] of the cable there, about which it swivels"),
    ]
    radius: Annotated[Radius, Field(description="the pulley's radius at the cable's middle")]


class SpoolDocument(Schema):
    """Spool in a file, ``{joint: spool, center: [x, y, z], spool: 75 mm}``: a motor that winds up
    the cable, whose readings are the motor's turns.
    """

    joint: Literal["spool"]
    center: Annotated[Point, Field(description="where the cable leaves the base, base frame")]
    axis: Direction | None = None
    radius: Radius | None = None
    spool: Annotated[Radius, Field(description="the spool's radius at reading zero, such as 75 mm")]
    gear: Annotated[
        float,
        Field(description="turns of the motor for one of the spool; negative if it winds up"),
    ] = 1.0
    lines: Annotated[
        float, Field(ge=1, description="the lines side by side that bear one leg, such as 2")
    ] = 1.0
    buildup: Annotated[
        Metres, Field(ge=0, description="growth of the spool's squared radius by the cable on it")
    ] = 0.0
    motor: Annotated[int, Field(ge=1)] | None = None
    range: Sweep | None = None


class _Over(NamedTuple):
    """Cable over pulleys: axis s, e, rho (...,) m, sine and cosine of the angle t on the pulley,
    l (...,) m of free cable, r (...,) m, size (...,) of the axis in the file.
    """

    s: Array
    e: Array
    rho: Array
    height: Array
    t: Array
    sine: Array
    cosine: Array
    free: Array
    r: Array
    size: Array

    @property
    def u(self) -> Array:
        """Direction (..., 3) of the free cable."""
        return self.e * self.sine[..., None] + self.s * self.cosine[..., None]


def _over(parameters: Array, point_b: Array) -> _Over:
    """Cables to points B (..., 3) over pulleys with parameters (..., 7 or more)."""
    axis, r = parameters[..., 3:6], parameters[..., 6]
    size = np.sqrt(dot(axis, axis))
    s, d = axis / size[..., None], point_b - parameters[..., :3]
    height = dot(d, s)
    flat = d - height[..., None] * s
    rho = np.sqrt(dot(flat, flat))
    # on the axis itself, every direction square to it would do
    e = flat / np.where(rho > 0, rho, 1.0)[..., None]
    x = rho - r
    square = x * x + height * height
    free = np.sqrt(np.where(square >= r * r, square - r * r, np.nan))
    sine, cosine = (free * x + r * height) / square, (free * height - r * x) / square
    t = np.arctan2(sine, cosine)
    t = np.where(t < -np.pi / 2, t + 2 * np.pi, t)
    return _Over(s, e, rho, height, t, sine, cosine, free, r, size)


class OverPulley(Winding):
    """Cable over a pulley; parameters begin with center, axis and radius, m."""

    @staticmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """The centre, which no reading moves."""
        del readings
        center = parameters[..., :3]
        return center, np.zeros_like(center)

    @staticmethod
    def tangent_point(parameters: Array, point_b: Array) -> tuple[Array, Array]:
        """P and the length on the pulley."""
        c = _over(parameters, point_b)
        radial, axial = c.r * (1 - c.cosine), c.r * c.sine
        point = parameters[..., :3] + radial[..., None] * c.e + axial[..., None] * c.s
        return point, c.r * c.t

    @staticmethod
    def tangent_by_b(parameters: Array, point_b: Array) -> Array:
        """P rolls along the cable, and swivels about the axis."""
        c = _over(parameters, point_b)
        lateral, normal = cross(c.s, c.e), c.e * c.cosine[..., None] - c.s * c.sine[..., None]
        swivel = (c.r * (1 - c.cosine) / c.rho)[..., None, None]
        roll = (c.r / c.free)[..., None, None]
        return swivel * _outer(lateral, lateral) + roll * _outer(c.u, normal)

    @classmethod
    def tangent_by_parameters(cls, parameters: Array, point_b: Array) -> tuple[Array, Array]:
        """By the pulley's radius, the length changes by ``t - sin t``, by its centre by ``-u``."""
        c = _over(parameters, point_b)
        shape = np.broadcast_shapes(parameters.shape[:-1], point_b.shape[:-1])
        point = np.zeros((*shape, 3, parameters.shape[-1]))
        total = np.zeros((*shape, parameters.shape[-1]))
        by_b = cls.tangent_by_b(parameters, point_b)
        # centre
        point[..., :3], total[..., :3] = np.eye(3) - by_b, -c.u
        # radius
        by_r = (1 - c.cosine)[..., None] * c.e + c.sine[..., None] * c.s
        by_r = by_r + (c.r * (1 - c.cosine) / c.free)[..., None] * c.u
        point[..., 6], total[..., 6] = by_r, c.t - c.sine
        # axis: along e it turns in the cable's plane, along s x e out of it
        turns = (c.rho * c.cosine - c.height * c.sine) / c.size
        total[..., 3:6] = turns[..., None] * c.e
        lateral = cross(c.s, c.e)
        by_e = -(c.r * (c.height * c.cosine + c.rho * c.sine) / c.free)[..., None] * c.u
        by_e = by_e - (c.r * (1 - c.cosine))[..., None] * c.s + (c.r * c.sine)[..., None] * c.e
        out = c.r * c.sine - c.r * (1 - c.cosine) * c.height / c.rho
        by_axis = _outer(by_e, c.e) + _outer(out[..., None] * lateral, lateral)
        point[..., 3:6] = by_axis / c.size[..., None, None]
        # the length on the pulley is the whole less the free cable, whose end P moves
        wound = total + (c.u[..., None, :] @ point)[..., 0, :]
        return point, wound


@final
class Pulley(OverPulley, BaseCarrier):
    """Cable over a pulley, read as its length from ``center`` to the platform."""

    joints: ClassVar = ("pulley",)
    schema: ClassVar = PulleyDocument
    called: ClassVar = "pulleys"
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *vectors("axis", "1", "axis"),
        ParameterKind("radius", "m", "arm", label="pulley radius", part="pulley"),
    )

    @classmethod
    def check(cls, node: PulleyDocument, site: Site) -> None:
        """Refuse pulleys that swivel out of the plane of a planar machine."""
        del node
        _check_spatial(site, "radius")


@final
class Spool(OverPulley, BaseCarrier):
    """Motor with a spool, from which the cable may run over a pulley."""

    driven: ClassVar = True
    unit: ClassVar = "rad"
    joints: ClassVar = ("spool",)
    schema: ClassVar = SpoolDocument
    called: ClassVar = "spools"
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *(
            ParameterKind(f"axis.{c}", "1", "axis", value)
            for c, value in zip("xyz", PULLEY_ENTRY, strict=True)
        ),
        ParameterKind("radius", "m", "arm", label="pulley radius", part="pulley"),
        ParameterKind("spool", "m", "arm", label="spool radius", part="spool"),
        ParameterKind("gear", "", "", 1.0),
        ParameterKind("lines", "", "", 1.0),
        ParameterKind("buildup", "m", ""),
    )

    @classmethod
    def check(cls, node: SpoolDocument, site: Site) -> None:
        """Refuse a pulley without axis, an axis without pulley, and a gear of zero."""
        if (node.axis is None) != (node.radius is None):
            raise InputError(
                f"leg {site.leg} has one of a pulley's axis and radius without the other",
                where=site.where("radius" if node.radius is not None else "axis"),
                expected="both, or neither for a cable through a small eye",
            )
        if node.gear == 0:
            raise InputError(
                f"the motor of leg {site.leg} does not turn its spool",
                where=site.where("gear"),
                found="0",
                expected="turns of the motor for one of the spool, such as 1 or -12.75",
            )
        if node.radius is not None:
            _check_spatial(site, "radius")

    @staticmethod
    def paid_out(parameters: Array, readings: Array) -> tuple[Array, Array, Array]:
        """``R phi - k phi^2 / 4`` on each line."""
        spool, gear, lines, buildup = (parameters[..., k] for k in range(7, 11))
        phi = readings / gear
        length = (spool - buildup * phi / 4) * phi / lines
        by_parameters = np.zeros((*length.shape, parameters.shape[-1]))
        by_parameters[..., 7] = phi / lines
        return length, (spool - buildup * phi / 2) / (gear * lines), by_parameters

    @classmethod
    def reading(cls, parameters: Array, point_b: Array, length: Array, near: Array) -> Array:
        """Closed-form readings: ``phi = 2 x / (R + sqrt(R^2 - k x))`` for x paid out."""
        del near
        spool, gear, lines, buildup = (parameters[..., k] for k in range(7, 11))
        line = point_b - cls.tangent_point(parameters, point_b)[0]
        paid = lines * (np.sqrt(dot(line, line)) - length)
        square = spool**2 - buildup * paid
        root = np.sqrt(np.where(square > 0, square, np.nan))
        return gear * 2 * paid / (spool + root)


def _check_spatial(site: Site, field: str) -> None:
    """Raise InputError for a swivelling pulley on a planar machine."""
    if site.planar:
        raise InputError(
            f"the pulley of leg {site.leg} swivels out of the plane of a planar machine",
            where=site.where(field),
            expected="a cable through a small eye: joint: revolute, or a spool without radius",
        )


def _outer(a: Array, b: Array) -> Array:
    """Outer products (..., 3, 3) of vectors."""
    return a[..., :, None] * b[..., None, :]
