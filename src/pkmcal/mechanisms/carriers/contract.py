"""What a carrier of limb ends offers; a new kind is one file in this folder.

A limb is a rod between a point A on the base side and a point B on the platform side,
``|B(X; theta) - A(q; theta)| = length(q; theta)``. The base carrier gives A, the platform
carrier gives B. A carrier names the joint kinds it serves in mechanism files, the schema of
its fields, its parameters, and the point with its exact derivatives, for any number of legs
and configurations at once. Kinematics needs the point and how it moves, ``place``; identification
also its derivatives by the parameters. All but ``place`` has an answer here that any carrier can
live with; a carrier gives its own where that is faster, or where it knows better.
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
from pkmcal.files import Metres, Radians, Schema
from pkmcal.geometry.rigid import apply, dot, skew

SHORTEST_AXIS_LENGTH = 1e-6
"""An axis shorter than this is a row of zeros, not a direction."""
READING_NEWTON_STEPS = 40
"""Newton's for a reading; from mid-range they take five."""
ROD_LENGTH_ROUNDING = 1e-15
ROD_CLOSED_SHARE = 1e-9
"""Of a rod's length, what is left when its reading is found, and what may be at most: where the
rod stands square to the motion, only half of the digits can be had."""
COMPLEX_STEP_SIZE = 1e-30
PLANAR_MOTIONS = ("planar", "planar-translation")
"""Motions in planes z = const of the base frame."""
IN_PLANE = 1e-6
"""Metres out of a plane, and radians off its normal, that rounding in a file explains."""

AxisRole = Literal["square", "twist"]
"""What a joint's axis adds to a spatial machine: the limb is square to it, or, where both ends'
axes do so, the limb does not twist between them."""


def _direction(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    length = hypot(*axis)
    if length < SHORTEST_AXIS_LENGTH:
        raise ValueError("an axis of length zero is no direction; write one such as [0, 0, 1]")
    if abs(length - 1) < 1e-12:  # read back what was written, to the last digit
        return axis
    x, y, z = (c / length for c in axis)
    return x, y, z


Direction = Annotated[tuple[float, float, float], AfterValidator(_direction)]


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError("should be two increasing readings [min, max]")
    return value


Stroke = Annotated[tuple[Metres, Metres], AfterValidator(_rising)]
"""Smallest and largest reading of a motor that goes, m."""
Sweep = Annotated[tuple[Radians, Radians], AfterValidator(_rising)]
"""Smallest and largest reading of a motor that turns, rad."""


class ParameterKind(NamedTuple):
    """One parameter of a part: path below the part, unit, and the drawing's tolerance for it.

    Where the file may leave the field out, ``otherwise`` is its value, and it is no parameter of
    a machine whose file does. Without a tolerance's name it is a constant of the drawing.
    label : what people call it, where its side and path say too little. part : what of a leg it
    changes, where that is not simply the joint on its side: ``zero`` of the reading (added to it),
    or an ``arm``, a ``hinge``, any word for a piece that can slip or be exchanged by itself.
    """

    path: str
    unit: str
    tolerance: str
    otherwise: float = 0.0
    label: str = ""
    part: str = ""


class NamedMotion(NamedTuple):
    """Changes of one leg's carrier that people can picture, should data leave them open.

    columns : (n, m) changes of the carrier's n parameters. one, several : what is open, of one leg
    and of several; together : of all legs, where only some combinations are open. Sentences without
    a full stop, with the places that :class:`pkmcal.identify.motions.NamedChanges` lists.
    """

    columns: Array
    one: str
    several: str
    together: str = ""


class Site(NamedTuple):
    """Where a carrier stands in a mechanism file: leg from 1, ``base`` or ``platform``, the file's
    motion, and what names the place of one of the part's keys, or of the whole part.
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
    """The one elementary joint that carries a limb's end, for programs of bodies and joints.

    motion : what the arm does by the reading (base side) or by the platform (platform side):
        ``fixed`` it stands on its body, ``slide`` it goes along the axis, ``turn`` it turns about
        it, by the right-hand rule, ``float`` it keeps its direction where the platform turns.
    point : (..., 3) m, where the arm stands: on the axis, if there is one; in the body's frame.
    axis : (..., 3) unit, in the body's frame; zeros where the motion has none.
    arm : (..., 3) m, from the point to the limb's end at reading or internal coordinate zero; in
        the body's frame, of a floating one along the base frame's axes.
    """

    motion: Literal["fixed", "slide", "turn", "float"]
    point: Array
    axis: Array
    arm: Array


class Carrier(ABC):
    """What both sides share: words in files, schema, parameters, and changes of the frames.

    joints : the words. schema : their fields; the first three parameters are ``center``.
    shared : fields that legs on one motor, or on one body of the platform, have in common.
    called : the limb's ends on this side, where sentences speak of all of them.
    held_in_plane : fields that are no unknowns on a planar machine, which they would tilt.
    side : of a leg. ways : fields of three lengths that lead from one point to another; others of
    three lengths are points, those without a unit directions.

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
        """Raise InputError for what the schema lets pass and no machine can be.

        On a planar machine an ``axis`` is what the part turns about, unless its carrier says
        otherwise.
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
        """What the ``axis`` of a part adds to the closure of a spatial machine."""
        del node
        return None

    @staticmethod
    def motions(parameters: Array, readings: Array) -> tuple[NamedMotion, ...]:
        """What of a leg's numbers (n,) data may leave open together, and has a name of its own.

        readings : (K,) of the leg's motor at the poses of a session, NaN on the platform side.
        """
        del parameters, readings
        return ()

    @classmethod
    @cache
    def _vectors(cls) -> tuple[tuple[slice, bool], ...]:
        """Places of the fields with three numbers, and which of them are points."""
        return tuple(
            (slice(k, k + 3), p.unit == "m" and p.path.removesuffix(".x") not in cls.ways)
            for k, p in enumerate(cls.parameters)
            if p.path.endswith(".x")
        )

    @classmethod
    def reframed(cls, parameters: Array, e: Array, f: Array) -> Array:
        """The parameters (..., n) told in the new frames, e and f (..., 4, 4).

        Points and directions of the side's own body, as here, move with its frame.
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
        """Their first-order change by E's and F's six numbers, (..., n, 12)."""
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
        """The same end as an elementary joint, for parameters (..., n), which exports build from;
        None where it is none, and then C, MuJoCo and the firmwares refuse the machine.
        """
        del parameters
        return None


class BaseCarrier(Carrier, ABC):
    """Gives A, the limb's end on the base side, as a function of the joint reading.

    driven : the reading moves A; the rod then has a length of its own. unit : of the reading, m or
    rad. A driven carrier's schema may have ``motor``, the reading's column from 1, and ``range``,
    its smallest and largest reading.
    """

    side: ClassVar = "base"
    driven: ClassVar[bool] = False
    called: ClassVar[str] = "base joints"
    unit: ClassVar[Literal["m", "rad"]] = "m"

    @staticmethod
    @abstractmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """A and its derivative by the reading, (..., 3) each, for parameters (..., n) and readings
        (...,) (m or rad). What the readings do not change needs not have their shape. Complex
        parameters give complex points, unless the carrier has derivatives of its own.
        """

    @classmethod
    def by_parameters(cls, parameters: Array, readings: Array) -> Array:
        """Derivatives (..., 3, n) of A by the parameters: here exactly, by complex steps."""
        shape = (*np.broadcast_shapes(parameters.shape[:-1], readings.shape), 3)
        return complex_steps(
            lambda p: np.broadcast_to(cls.place(p, readings)[0], shape), parameters
        )

    @classmethod
    def reading(cls, parameters: Array, point_b: Array, length: Array, near: Array) -> Array:
        """Readings (...,) that put A at a distance (...,) from B (..., 3), m.

        Of two the one nearest to ``near`` (...,); NaN where B is out of reach. Here the one to
        which Newton's steps lead from there, ``(|B - A|^2 - length^2) / (2 length) = 0``.
        """
        shape = np.broadcast_shapes(parameters.shape[:-1], point_b.shape[:-1], near.shape)
        q, off = np.array(np.broadcast_to(near, shape), dtype=float), np.full(shape, np.inf)
        with np.errstate(all="ignore"):  # what is out of reach goes anywhere
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
        """Points (..., k, 3) along the arm that carries A, from where the motor holds it to A
        itself, for pictures; m, base frame.

        Of a carrier that turns, by its chain, from its axis straight to A. A alone has no arm: it
        stands still, or runs along a guide, wherever its readings take it.
        """
        a, chain = cls.place(parameters, readings)[0], cls.chain(parameters)
        points = (chain.point, a) if chain is not None and chain.motion == "turn" else (a,)
        return np.stack(np.broadcast_arrays(*points), axis=-2)


class PlatformCarrier(Carrier, ABC):
    """Gives B, the limb's end on the platform side, as a function of the platform's pose.

    body : the field whose number says on which body of an articulated platform the leg ends.
    turns : B also turns about a hinge, by an internal coordinate of the pose that no reading
    knows; legs on the same body share it.
    floats : ``center`` is told along the base frame's axes.
    most_turn : how far the platform turns about z to either side, rad, until something is in the
    way; ``obstacle`` says what.
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
        """B and the arm that turns with the platform, (..., 3) m each, base frame: by the pose's
        left perturbation B moves by ``omega x arm + tau``.

        For parameters (..., n), poses (..., 4, 4) and internal coordinates (...,), rad. Complex
        parameters give complex points, unless the carrier has derivatives of its own.
        """

    @classmethod
    def by_parameters(
        cls, parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """Derivatives (..., 3, n) of B by the parameters: here exactly, by complex steps."""
        return complex_steps(lambda p: cls.place(p, T_base_platform, internal)[0], parameters)

    @staticmethod
    def upright(parameters: Array, T_base_platform: Array) -> Array:
        """Internal coordinates (...,) that leave a bar's direction as it is, about: a start for the
        search for the right ones.
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
    """Change (..., 3, 6) of a platform's point by the pose, its turned arm (..., 3) given."""
    out = np.zeros((*arm.shape, 6))
    out[..., :3] = -skew(arm)
    out[..., 3:] = np.eye(3)
    return out


def vectors(
    name: str, unit: str, tolerance: str, label: str = "", part: str = ""
) -> tuple[ParameterKind, ...]:
    """The three components of a field."""
    return tuple(
        ParameterKind(
            f"{name}.{axis}", unit, tolerance, label=label and f"{label} {axis}", part=part
        )
        for axis in "xyz"
    )


def of_part(node: Any, kind: ParameterKind) -> float | None:
    """What a part of a mechanism file says of a parameter, None where it is silent;
    ``center.y`` is the second number of ``center``.
    """
    field, _, axis = kind.path.partition(".")
    value = getattr(node, field)
    if value is None:
        return None
    return float(value["xyz".index(axis)] if axis else value)


def moved_point(p: Array, transform: Array) -> Array:
    """A body's point (..., 3) in its new frame."""
    return apply(transform, p)


def moved_direction(d: Array, transform: Array) -> Array:
    """A body's direction (..., 3) in its new frame."""
    return (transform[..., :3, :3] @ d[..., None])[..., 0]


def point_by_frame(p: Array) -> Array:
    """Change (..., 3, 6) of a body's point by its frame's six numbers."""
    return by_pose(p)


def direction_by_frame(d: Array) -> Array:
    """Change (..., 3, 6) of a body's direction by its frame's six numbers."""
    return np.concatenate([-skew(d), np.zeros((*d.shape, 3))], axis=-1)


def turned_blocks(n: int, *blocks: tuple[int, Array]) -> Array:
    """Identity (..., n, n) but for 3x3 turns of a transform (..., 4, 4) at the given rows."""
    shape = np.broadcast_shapes(*(t.shape[:-2] for _, t in blocks))
    out = np.zeros((*shape, n, n))
    out[...] = np.eye(n)
    for at, transform in blocks:
        out[..., at : at + 3, at : at + 3] = transform[..., :3, :3]
    return out


def base_carriers() -> dict[str, type[BaseCarrier]]:
    """The base carrier of every joint kind known to mechanism files: of the modules beside this
    one, of those that ``PKMCAL_CARRIERS`` names, and of any module imported before.
    """
    _import_all()
    return {joint: cls for cls in BaseCarrier.__subclasses__() for joint in cls.joints}


def platform_carriers() -> dict[str, type[PlatformCarrier]]:
    """The platform carrier of every joint kind known to mechanism files, as for the base."""
    _import_all()
    return {joint: cls for cls in PlatformCarrier.__subclasses__() for joint in cls.joints}


@cache
def _import_all() -> None:
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
