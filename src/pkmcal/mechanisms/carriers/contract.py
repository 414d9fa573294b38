"""Contract of the carriers of limb ends; a new kind of joint is one file in this folder.

A limb is a rod between a point A on the base side and a point B on the platform side, ``|B(X;
theta) - A(q; theta)| = length(q; theta)``. The base carrier defines A, the platform carrier defines
B. A carrier states the joint names it serves in mechanism files, the schema of its fields, its
parameters, and the point with exact derivatives, for any number of legs and configurations at once.
Kinematics needs ``place``, the point with its derivative by the reading or pose; identification
needs derivatives by the parameters too. All methods but ``place`` have defaults that are valid for
any carrier; a carrier overrides them with faster or more specific ones.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache
from math import hypot
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import FieldError, Metres, Radians, Schema
from pkmcal.geometry.rigid import apply, dot, skew

SHORTEST_AXIS_LENGTH = 1e-6
"""Length below which an axis is a row of zeros, not a direction."""
READING_NEWTON_STEPS = 40
"""Most Newton steps for a reading; from mid-range five are enough."""
ROD_LENGTH_ROUNDING = 1e-15
"""Relative rounding of a rod's length, at which Newton's method for a reading stops."""
ROD_CLOSED_SHARE = 1e-9
"""Largest closure error, as a share of the rod's length, with which a reading counts as found. If
the rod is orthogonal to the motion, only half of the digits are attainable."""
COMPLEX_STEP_SIZE = 1e-30
"""Step of derivatives by complex steps."""
PLANAR_MOTIONS = ("planar", "planar-translation")
"""Motions in planes z = const of the base frame."""
IN_PLANE = 1e-6
"""Distance from a plane (m), or angle from its normal (rad), due to rounding in a file."""

AxisRole = Literal["square", "twist"]
"""Equation that a joint's axis adds to a spatial machine: the limb is orthogonal to it (square),
or, if both ends have this role, the limb does not twist between the axes (twist)."""


def _direction(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    """Validate and normalise a direction."""
    length = hypot(*axis)
    if length < SHORTEST_AXIS_LENGTH:
        raise FieldError(
            "an axis of length zero is no direction",
            found=list(axis),
            expected="one such as [0, 0, 1]",
        )
    if abs(length - 1) < 1e-12:  # keep written unit axes to the last digit
        return axis
    x, y, z = (c / length for c in axis)
    return x, y, z


Direction = Annotated[tuple[float, float, float], AfterValidator(_direction)]


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    """Validate a range of readings."""
    if not value[0] < value[1]:
        raise FieldError(
            "the range is not increasing",
            found=list(value),
            expected="two increasing readings [min, max]",
        )
    return value


Stroke = Annotated[tuple[Metres, Metres], AfterValidator(_rising)]
"""Smallest and largest reading of a linear motor, m."""
Sweep = Annotated[tuple[Radians, Radians], AfterValidator(_rising)]
"""Smallest and largest reading of a rotary motor, rad."""


class ParameterKind(NamedTuple):
    """Kind of parameter of a carrier.

    path : below the part in the mechanism file.
    unit : m, rad, 1 for components of directions, empty for ratios.
    tolerance : name of the prior sigma; empty for a constant, which is not a parameter.
    otherwise : value if the file omits the field, which is then no parameter.
    label : name for people, if side and path are not clear enough.
    part : part of the leg that the parameter changes, if not simply the joint on its side: ``zero``
        of the reading (added to it), or an ``arm``, a ``hinge``, any word for a piece that can slip
        or be exchanged by itself.
    """

    path: str
    unit: str
    tolerance: str
    otherwise: float = 0.0
    label: str = ""
    part: str = ""


class NamedMotion(NamedTuple):
    """Change of a leg's carrier parameters with a name, for unidentifiable directions.

    columns : (n, m) changes of the carrier's n parameters.
    one, several : text for one leg and for several legs; together : for all legs, if only some
        combinations are unidentifiable. Sentences without a full stop, with the placeholders of
        :class:`pkmcal.identify.motions.NamedChanges`.
    """

    columns: Array
    one: str
    several: str
    together: str = ""


class Site(NamedTuple):
    """Location of a carrier in a mechanism file.

    leg : number from 1.
    side : ``base`` or ``platform``.
    motion : of the file.
    where : function that returns the location of one of the part's keys, or of the part.
    """

    leg: int
    side: str
    motion: str
    where: Callable[..., str]

    @property
    def planar(self) -> bool:
        """Whether the machine moves in planes z = const."""
        return self.motion in PLANAR_MOTIONS


class Chain(NamedTuple):
    """Elementary joint that carries a limb's end, for programs that model bodies and joints.

    motion : motion of the arm by the reading (base side) or by the platform (platform side):
        ``fixed`` to its body, ``slide`` along the axis, ``turn`` about it by the right-hand rule,
        ``float`` with a constant direction while the platform rotates.
    point : (..., 3) m, foot of the arm, on the axis if there is one; body's frame.
    axis : (..., 3) unit, body's frame; zeros without an axis.
    arm : (..., 3) m, from the point to the limb's end at reading or internal coordinate zero;
        body's frame, for ``float`` along the base frame's axes.
    """

    motion: Literal["fixed", "slide", "turn", "float"]
    point: Array
    axis: Array
    arm: Array


class Carrier(ABC):
    """Common part of both sides: names in files, schema, parameters, and changes of the frames.

    joints : names in mechanism files.
    schema : their fields.
    parameters : the first three are ``center``.
    shared : fields that legs on one motor, or on one body of the platform, have in common.
    called : noun for the limb's ends on this side, in sentences about all of them.
    held_in_plane : fields that are fixed on a planar machine, which they would tilt.
    side : of the leg.
    ways : fields of three lengths that are differences of points. Other fields of three lengths are
        points, those without a unit directions.

    Frames change by E on base coordinates and F on platform coordinates, (..., 4, 4), see
    :mod:`pkmcal.identify.gauge`.
    """

    side: ClassVar[Literal["base", "platform"]]

    joints: ClassVar[tuple[str, ...]]
    schema: ClassVar[type[Schema]]
    parameters: ClassVar[tuple[ParameterKind, ...]]
    shared: ClassVar[tuple[str, ...]] = ()
    called: ClassVar[str] = ""
    held_in_plane: ClassVar[tuple[str, ...]] = ()
    ways: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def check(cls, node: Any, site: Site) -> None:
        """Raise InputError for a part that the schema allows and the machine's motion does not.

        By default an ``axis`` is the part's axis of rotation, which on a planar machine must be the
        plane's normal.
        """
        axis = getattr(node, "axis", None)
        if site.planar and axis is not None and hypot(axis[0], axis[1]) > IN_PLANE:
            raise InputError(
                f"leg {site.leg} of a planar machine turns about an axis that is not the plane's",
                where=site.where("axis"),
                found=f"[{axis[0]:g}, {axis[1]:g}, {axis[2]:g}]",
                expected="[0, 0, 1]: a planar machine moves in the base frame's x-y plane",
            )

    @staticmethod
    def axis_role(node: Any) -> AxisRole | None:
        """Equation that the ``axis`` of a part adds to the closure of a spatial machine."""
        del node
        return None

    @staticmethod
    def motions(parameters: Array, readings: Array) -> tuple[NamedMotion, ...]:
        """Named combinations of a leg's parameters (n,) that data may not determine.

        readings : (K,) of the leg's motor at the poses of a session, NaN on the platform side.
        """
        del parameters, readings
        return ()

    @classmethod
    @cache
    def _vectors(cls) -> tuple[tuple[slice, bool], ...]:
        """Slices of the fields with three numbers, and whether each is a point."""
        return tuple(
            (slice(k, k + 3), p.unit == "m" and p.path.removesuffix(".x") not in cls.ways)
            for k, p in enumerate(cls.parameters)
            if p.path.endswith(".x")
        )

    @classmethod
    def reframed(cls, parameters: Array, e: Array, f: Array) -> Array:
        """Parameters (..., n) in new frames, e and f (..., 4, 4).

        By default, points and directions move with the frame of the side's own body.
        """
        own = e if cls.side == "base" else f
        shape = np.broadcast_shapes(parameters.shape[:-1], own.shape[:-2])
        out = np.array(np.broadcast_to(parameters, (*shape, parameters.shape[-1])))
        for at, is_point in cls._vectors():
            move = moved_point if is_point else moved_direction
            out[..., at] = move(parameters[..., at], own)
        return out

    @classmethod
    def by_frames(cls, parameters: Array) -> Array:
        """First-order change (..., n, 12) of the parameters by the six numbers each of E and F."""
        out = np.zeros((*parameters.shape, 12))
        own = slice(0, 6) if cls.side == "base" else slice(6, 12)
        for at, is_point in cls._vectors():
            change = point_by_frame if is_point else direction_by_frame
            out[..., at, own] = change(parameters[..., at])
        return out

    @classmethod
    def carried(cls, parameters: Array, e: Array, f: Array) -> Array:
        """Derivative (..., n, n) of :meth:`reframed` by the parameters."""
        own = e if cls.side == "base" else f
        return turned_blocks(parameters.shape[-1], *((at.start, own) for at, _ in cls._vectors()))

    @staticmethod
    def chain(parameters: Array) -> Chain | None:
        """Limb's end as an elementary joint, for parameters (..., n), from which exports are built.
        None if it is not elementary; C, MuJoCo and firmware exports then refuse the machine.
        """
        del parameters
        return None


class BaseCarrier(Carrier, ABC):
    """Carrier of A, the limb's end on the base side, as a function of the joint reading.

    driven : whether the reading moves A; the rod then has constant length.
    unit : of the reading, m or rad.

    The schema of a driven carrier may have ``motor``, the reading's column from 1, and ``range``,
    its smallest and largest reading.
    """

    side: ClassVar = "base"
    driven: ClassVar[bool] = False
    called: ClassVar[str] = "base joints"
    unit: ClassVar[Literal["m", "rad"]] = "m"

    @staticmethod
    @abstractmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """Point A and its derivative by the reading, (..., 3) each.

        parameters : (..., n).
        readings : (...,) m or rad.

        A result that does not depend on the readings need not have their shape. Complex parameters
        give complex points, unless the carrier overrides ``by_parameters``.
        """

    @classmethod
    def by_parameters(cls, parameters: Array, readings: Array) -> Array:
        """Derivatives (..., 3, n) of A by the parameters, by default exact by complex steps."""
        shape = (*np.broadcast_shapes(parameters.shape[:-1], readings.shape), 3)
        return complex_steps(
            lambda p: np.broadcast_to(cls.place(p, readings)[0], shape), parameters
        )

    @classmethod
    def reading(cls, parameters: Array, point_b: Array, length: Array, near: Array) -> Array:
        """Readings (...,) for which A is at a distance (...,) from B (..., 3), m; NaN if out of
        reach.

        Of two solutions the one nearest to ``near`` (...,). By default Newton's method from there
        on ``(|B - A|^2 - length^2) / (2 length) = 0``.
        """
        shape = np.broadcast_shapes(parameters.shape[:-1], point_b.shape[:-1], near.shape)
        q, off = np.array(np.broadcast_to(near, shape), dtype=float), np.full(shape, np.inf)
        with np.errstate(all="ignore"):  # rows out of reach diverge
            for _ in range(READING_NEWTON_STEPS):
                a, by_reading = cls.place(parameters, q)
                line = point_b - a
                off = (dot(line, line) - length**2) / (2 * length)
                slope = -dot(line, by_reading) / length
                step = np.where(np.abs(off) > ROD_LENGTH_ROUNDING * length, off / slope, 0.0)
                if not step.any():
                    break
                q = q - step
        return np.where(np.abs(off) <= ROD_CLOSED_SHARE * length, q, np.nan)

    @classmethod
    def skeleton(cls, parameters: Array, readings: Array) -> Array:
        """Points (..., k, 3) along the arm that carries A, from the motor to A, for nominal models;
        m, base frame.

        A rotary carrier's arm is drawn from its axis straight to A, by its chain. Others have no
        arm, only A, which is fixed or moves along a guide.
        """
        a, chain = cls.place(parameters, readings)[0], cls.chain(parameters)
        points = (chain.point, a) if chain is not None and chain.motion == "turn" else (a,)
        return np.stack(np.broadcast_arrays(*points), axis=-2)


class Winding(ABC):
    """Addition to a base carrier whose limb is a cable: its free part begins at a point A that
    depends on the platform's end B, and a part of its length lies on a pulley.

    The free cable touches the pulley, so that by B the whole length changes along the free cable's
    direction, as a rod's does.
    """

    @staticmethod
    @abstractmethod
    def tangent_point(parameters: Array, point_b: Array) -> tuple[Array, Array]:
        """Point A (..., 3) and the length (...,) of the cable from the carrier's place to it, m.

        parameters : (..., n). point_b : (..., 3). NaN where the cable cannot reach B.
        """

    @staticmethod
    @abstractmethod
    def tangent_by_b(parameters: Array, point_b: Array) -> Array:
        """Derivative (..., 3, 3) of A by B."""

    @classmethod
    @abstractmethod
    def tangent_by_parameters(cls, parameters: Array, point_b: Array) -> tuple[Array, Array]:
        """Derivatives (..., 3, n) of A and (..., n) of the length up to A, at a fixed B."""

    @staticmethod
    def paid_out(parameters: Array, readings: Array) -> tuple[Array, Array, Array]:
        """Length (...,) by which the reading makes the cable longer than its rod, with derivatives
        by the reading (...,) and by the parameters (..., n). By default none: the rod is read.
        """
        shape = np.broadcast_shapes(parameters.shape[:-1], readings.shape)
        zero = np.zeros(shape)
        return zero, zero, np.zeros((*shape, parameters.shape[-1]))


class PlatformCarrier(Carrier, ABC):
    """Carrier of B, the limb's end on the platform side, as a function of the platform's pose.

    body : name of the field with the number of the body of an articulated platform.
    turns : whether B also rotates about a hinge, by an internal coordinate of the pose without a
        reading; legs on the same body share it.
    floats : whether ``center`` is along the base frame's axes.
    most_turn : largest rotation of the platform about z to either side, rad.
    obstacle : text that states what limits this rotation.
    """

    side: ClassVar = "platform"
    body: ClassVar[str] = ""
    turns: ClassVar[bool] = False
    floats: ClassVar[bool] = False
    called: ClassVar[str] = "platform joints"
    most_turn: ClassVar[float] = np.inf
    obstacle: ClassVar[str] = ""

    @staticmethod
    @abstractmethod
    def place(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> tuple[Array, Array]:
        """Point B and its lever arm, (..., 3) m each, base frame: B changes by
        ``omega x arm + tau`` under the pose's left perturbation.

        parameters : (..., n).
        T_base_platform : (..., 4, 4).
        internal : (...,) rad.

        Complex parameters give complex points, unless the carrier overrides ``by_parameters``.
        """

    @classmethod
    def by_parameters(
        cls, parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """Derivatives (..., 3, n) of B by the parameters, by default exact by complex steps."""
        return complex_steps(lambda p: cls.place(p, T_base_platform, internal)[0], parameters)

    @staticmethod
    def upright(parameters: Array, T_base_platform: Array) -> Array:
        """Approximate internal coordinates (...,) that keep a bar's direction: the start of inverse
        kinematics.
        """
        shape = np.broadcast_shapes(parameters.shape[:-1], T_base_platform.shape[:-2])
        return np.zeros(shape)

    @staticmethod
    def by_internal(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """Derivative (..., 3) of B by the internal coordinate."""
        del internal
        shape = np.broadcast_shapes(parameters.shape[:-1], T_base_platform.shape[:-2])
        return np.zeros((*shape, 3))


def complex_steps(function: Callable[[Array], Array], parameters: Array) -> Array:
    """Derivatives (..., m, n) of a function (..., m) of parameters (..., n), exact to rounding."""
    columns: list[Array] = []
    for step in np.eye(parameters.shape[-1]):
        shifted: Any = parameters + 1j * COMPLEX_STEP_SIZE * step
        columns.append(function(shifted).imag / COMPLEX_STEP_SIZE)
    return np.stack(columns, axis=-1)


def by_pose(arm: Array) -> Array:
    """Derivative (..., 3, 6) of a platform's point by the pose, from its lever arm (..., 3)."""
    out = np.zeros((*arm.shape, 6))
    out[..., :3] = -skew(arm)
    out[..., 3:] = np.eye(3)
    return out


def vectors(
    name: str, unit: str, tolerance: str, label: str = "", part: str = ""
) -> tuple[ParameterKind, ...]:
    """Parameter kinds of the three components of a field."""
    return tuple(
        ParameterKind(
            f"{name}.{axis}", unit, tolerance, label=label and f"{label} {axis}", part=part
        )
        for axis in "xyz"
    )


def of_part(node: Any, kind: ParameterKind) -> float | None:
    """Value of a parameter in a part of a mechanism file, None if absent; ``center.y`` is the
    second number of ``center``.
    """
    field, _, axis = kind.path.partition(".")
    value = getattr(node, field)
    if value is None:
        return None
    return float(value["xyz".index(axis)] if axis else value)


def moved_point(p: Array, transform: Array) -> Array:
    """Body's point (..., 3) in a new frame."""
    return apply(transform, p)


def moved_direction(d: Array, transform: Array) -> Array:
    """Body's direction (..., 3) in a new frame."""
    return (transform[..., :3, :3] @ d[..., None])[..., 0]


def point_by_frame(p: Array) -> Array:
    """Derivative (..., 3, 6) of a body's point by its frame's six numbers."""
    return by_pose(p)


def direction_by_frame(d: Array) -> Array:
    """Derivative (..., 3, 6) of a body's direction by its frame's six numbers."""
    return np.concatenate([-skew(d), np.zeros((*d.shape, 3))], axis=-1)


def turned_blocks(n: int, *blocks: tuple[int, Array]) -> Array:
    """Identity matrix (..., n, n) with the rotation of a transform (..., 4, 4) as 3x3 diagonal
    block at each given row.
    """
    shape = np.broadcast_shapes(*(t.shape[:-2] for _, t in blocks))
    out = np.zeros((*shape, n, n))
    out[...] = np.eye(n)
    for at, transform in blocks:
        out[..., at : at + 3, at : at + 3] = transform[..., :3, :3]
    return out


def base_carriers() -> dict[str, type[BaseCarrier]]:
    """Base carriers by joint name: of the modules in this folder, of those named in
    ``PKMCAL_CARRIERS``, and of any module imported before.
    """
    _import_all()
    return {joint: cls for cls in BaseCarrier.__subclasses__() for joint in cls.joints}


def platform_carriers() -> dict[str, type[PlatformCarrier]]:
    """Platform carriers by joint name, from the same modules as :func:`base_carriers`."""
    _import_all()
    return {joint: cls for cls in PlatformCarrier.__subclasses__() for joint in cls.joints}


@cache
def _import_all() -> None:
    """Import the modules in this folder and those named in ``PKMCAL_CARRIERS``."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
    for name in os.environ.get("PKMCAL_CARRIERS", "").replace(",", " ").split():
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise InputError(
                "a module with carriers cannot be imported",
                where="the environment's PKMCAL_CARRIERS",
                found=str(error),
                expected="names of Python modules, which stand where Python looks for them",
            ) from None
