"""Leg of a mechanism file that moves as a chain of joints between base and platform does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.read_model import DISPLAY_MARK
from pkmcal.exporters.rigid_bodies import RigidBodies, Step
from pkmcal.files import MOST_LEG_TUBES
from pkmcal.geometry.rigid import apply, cross, inverse, rotation
from pkmcal.levels import ROUNDING
from pkmcal.starter.nominal import NominalLeg, millimetres

GEOMETRY_SHARE = 1e-4
"""Tolerance for axes that meet in a point and for poses, as a share of the machine's size, and of a
direction, rad: two numbers that files round to four decimals differ by 1e-4 at most."""


NO_TWIST = (
    "the axes of a joint do not meet, and it may not twist",
    "two hinges at each end",
    "a ball at one end, or a hinge along the leg",
)


class Chain(NamedTuple):
    """Steps from a body on the base's side to one on the platform's side."""

    start: int
    steps: tuple[Step, ...]
    stop: int


def _meeting_point(steps: Sequence[Step]) -> tuple[Array, float]:
    """Point (3,) where the axes of joints meet, or that of the ball, and its largest distance from
    an axis, m.
    """
    first = next((s for s in steps if s.kind == "ball"), steps[0])
    if np.ptp([s.point for s in steps], axis=0).max() < ROUNDING:
        return first.point, 0.0
    across = [np.eye(3) - np.outer(s.axis, s.axis) for s in steps]
    point = first.point
    if first.kind != "ball":
        sums = np.sum([P @ s.point for P, s in zip(across, steps, strict=True)], axis=0)
        point = np.linalg.lstsq(np.sum(across, axis=0), sums, rcond=1e-9)[0]
    off = [np.linalg.norm(P @ (point - s.point)) for P, s in zip(across, steps, strict=True)]
    return point, float(max(off))


class LegEnd(NamedTuple):
    """End of a leg.

    joints : in the order of the chain. point : (3,) of the rod. miss : largest distance of the
    joints' axes from it, m. center : (3,) of the joint, on its first axis. axis : (3,) unit first
    axis, fixed to the body, of a universal joint whose axes do not meet; None for other joints.
    """

    joints: Sequence[Step]
    point: Array
    miss: float
    center: Array
    axis: Array | None = None

    @classmethod
    def meeting(cls, joints: Sequence[Step]) -> LegEnd:
        """End whose axes meet in a point."""
        point, miss = _meeting_point(joints)
        return cls(joints, point, miss, point)

    @classmethod
    def offset(cls, joints: Sequence[Step], first: int) -> LegEnd:
        """End with a universal joint whose axes do not meet.

        first : 0 or -1, the joint on the body. The common normal of both axes leads from the
        joint's centre to the rod; a third joint, about the rod, leads through the same point.
        """
        if not 2 <= len(joints) <= 3 or any(s.kind != "hinge" for s in joints):
            return cls.meeting(joints)
        body, near_rod, *twist = list(joints)[:: 1 if first == 0 else -1]
        normal = cross(body.axis, near_rod.axis)
        if np.linalg.norm(normal) < 1 - GEOMETRY_SHARE:
            return cls.meeting(joints)
        gap = near_rod.point - body.point
        center = body.point + body.axis * float(gap @ body.axis)
        point = near_rod.point - near_rod.axis * float(gap @ near_rod.axis)
        off = [cross(s.axis, point - s.point) for s in twist]
        return cls(joints, point, float(np.linalg.norm(off)), center, body.axis)


class LegFit:
    """Leg of a chain of joints.

    column : reading, -1 for none. sign : -1 if the reading grows as the joint's value falls.
    """

    def __init__(
        self,
        parts: RigidBodies,
        chain: Chain,
        number: int,
        motors: Mapping[int, Step],
        bars: Mapping[int, Step],
        T_base_platform: Array,
        motion: str,
    ) -> None:
        self.parts, self.number, self.motion, self.sign = parts, number, motion, 1
        self.T_base_platform = T_base_platform
        self.motor, self.bar = motors.get(chain.start), bars.get(chain.stop)
        self.bar_number = list(bars).index(chain.stop) + 1 if self.bar else 0
        steps, tolerance = chain.steps, GEOMETRY_SHARE * parts.size
        slides = [k for k, s in enumerate(steps) if s.kind == "slide"]
        # the joints before and after the slide, or the split of them that is nearest to two points
        splits = [(k, k + 1) for k in slides] or [(k, k) for k in range(len(steps) - 1, 0, -1)]
        options = [(steps[:low], steps[high:]) for low, high in splits if low and high < len(steps)]
        if len(slides) > 1 or not options:
            raise self.error(
                "its joints are not those of a rod between two points",
                ", ".join(s.kind for s in steps),
                "hinges or a ball at either end, and at most one slide between them",
            )
        ends = [(LegEnd.meeting(near), LegEnd.meeting(far)) for near, far in options]
        # an end whose axes do not meet may have a joint with offset axes
        ends += [
            (
                near if near.miss <= tolerance else LegEnd.offset(near.joints, 0),
                far if far.miss <= tolerance else LegEnd.offset(far.joints, -1),
            )
            for near, far in ends
        ]
        apart = [
            (near, far) for near, far in ends if np.linalg.norm(far.point - near.point) > tolerance
        ]
        fitting = [pair for pair in apart if max(end.miss for end in pair) <= tolerance]
        if not fitting:
            miss = min((max(end.miss for end in pair) for pair in apart), default=np.inf)
            raise self.error(
                "the axes of the joints at one of its ends do not meet in a point",
                f"{millimetres(miss)} from the nearest point to one of them",
                "a common point, or the two axes of a universal joint at right angles",
            )
        self.ends = fitting[0]
        (near, a, *_), (far, b, *_) = self.ends
        # a single hinge has the point on its axis that is opposite the other end
        if len(near) == 1 and near[0].kind == "hinge" and "planar" not in motion:
            a = near[0].point + near[0].axis * float((b - near[0].point) @ near[0].axis)
        if len(far) == 1 and far[0].kind == "hinge":
            b = far[0].point + far[0].axis * float((a - far[0].point) @ far[0].axis)
        self.a, self.b = a, b
        self.length = float(np.linalg.norm(b - a))
        self.u = (b - a) / self.length
        self.near, self.far = near, far
        self.slide = steps[slides[0]] if slides else None
        self._find_drive()

    def error(self, what: str, found: object, expected: object) -> InputError:
        """Error about this leg."""
        return InputError(
            f"leg {self.number} cannot be represented: {what}", found=found, expected=expected
        )

    def _find_drive(self) -> None:
        """Find the reading that moves the leg."""
        drives = [s for s in (self.motor, self.slide) if s is not None]
        columns = [
            int(np.flatnonzero(self.parts.model.actuated == s.dof)[0])
            for s in drives
            if s.dof in self.parts.model.actuated
        ]
        if len(columns) > 1:
            raise self.error("two motors move it", len(columns), "one")
        self.column = columns[0] if columns else -1
        if self.motor is not None and self.slide is not None:
            raise self.error("a motor carries it, and its rod has no constant length", "a slide",
                             "a rod of constant length")  # fmt: skip
        if self.slide is not None:
            along = float(self.slide.axis @ self.u)
            if np.linalg.norm(cross(self.slide.axis, self.u)) > GEOMETRY_SHARE:
                angle = np.rad2deg(np.arccos(np.clip(abs(along), 0, 1)))
                raise self.error(
                    "its slide is not along the line between its joints", f"{angle:.3g} deg", "0"
                )
            self.sign = 1 if along > 0 else -1

    @property
    def reading_limits(self) -> Array:
        """Limits (2,) of the drive's joint in the leg's direction, m or rad."""
        dof = self.parts.model.actuated[self.column]
        joints = {j.dof: j for body in self.parts.model.bodies for j in body.joints}
        return np.sort(self.sign * joints[int(dof)].limits)

    def leg(self, first: LegFit | None) -> NominalLeg:
        """Leg of the nominal model; first : first leg on the motor of several."""
        base = self._joint("base")
        rod = f"{{actuated: false, constant: {number_text(self.length)}}}"
        if self.motor is not None:
            base = self._carrier(self.motor, first)
        elif self.slide is not None and self.column < 0:
            rod = "{passive: true}"
        elif self.slide is not None:
            offset = self.length - self.sign * float(self.parts.x[self.slide.dof])
            rod = f"{{actuated: true, offset: {number_text(offset)}"
            low, high = self.reading_limits + offset
            rod += f", range: {list_text([low, high])}}}" if 0 < low < high else "}"
        gear = 1.0 if self.column < 0 else float(self.parts.model.gear[self.column])
        held = self._joint("platform") if self.bar is None else self._bar(self.bar)
        if any(end.axis is not None for end in self.ends) and (self.motor or self.bar):
            raise self.error(
                "a motor or a bar carries a joint whose axes do not meet",
                "a universal joint with offset axes",
                "base and platform themselves at both its ends",
            )
        b = self.b if self.ends[1].axis is None else self.ends[1].center
        b_platform = (inverse(self.T_base_platform) @ np.append(b, 1.0))[:3]
        return NominalLeg(
            base,
            rod,
            self.a if self.ends[0].axis is None else self.ends[0].center,
            b_platform,
            held=held,
            scale="" if gear == 1 else number_text(1 / gear),
            tubes=self._tubes(),
        )

    def _tubes(self) -> tuple[tuple[float, float, float], ...]:
        """Radius, start and end, m from A, of the cylinders that the leg is drawn with.

        They are along its line, between its ends, and inside no thicker one.
        """
        tolerance = GEOMETRY_SHARE * self.parts.size
        candidates: list[tuple[float, float, float]] = []
        for cylinder in self.parts.model.cylinders:
            away = apply(self.parts.at[cylinder.body], cylinder.ends) - self.a
            along = away @ self.u
            beside = float(np.linalg.norm(away - along[:, None] * self.u, axis=1).max())
            start, stop = (float(x) for x in np.clip(np.sort(along), 0.0, self.length))
            drawn = DISPLAY_MARK not in cylinder.name and cylinder.radius > tolerance
            if drawn and beside < tolerance and stop - start > cylinder.radius:
                candidates.append((cylinder.radius, start, stop))
        out: list[tuple[float, float, float]] = []
        for radius, start, stop in sorted(candidates, key=lambda tube: (-tube[0], tube[1])):
            if not any(s - tolerance <= start and stop <= e + tolerance for _, s, e in out):
                out.append((radius, start, stop))
        return tuple(sorted(out, key=lambda tube: tube[1])[:MOST_LEG_TUBES])

    def _joint(self, side: str) -> str:
        """Entry of a joint on the base or on the platform."""
        T = np.eye(4) if side == "base" else inverse(self.T_base_platform)
        center = list_text((T @ np.append(self.a if side == "base" else self.b, 1.0))[:3])
        if self.motion != "spatial":
            kind = "revolute" if "planar" in self.motion else "spherical"
            return f"{{joint: {kind}, center: {center}}}"
        near, far = self._across(self.near), self._across(self.far)
        own, end = (near, self.ends[0]) if side == "base" else (far, self.ends[1])
        # hinges along the leg, and balls, let it twist
        count = len(near) + len(far)
        twists = max(len(near), len(far)) > 2 or count < len(self.near) + len(self.far)
        if not twists and count < 4:
            raise self.error(
                "it may not twist, and a hinge at one end restricts it besides",
                f"{len(near)} hinges on the base and {len(far)} on the platform",
                "two at each end, or a ball",
            )
        if end.axis is not None:
            return self._offset_joint(side, end, end.axis, twists)
        if len(own) == 1:
            if side == "base" and self.motor is not None:
                raise self.error("one hinge joins it to its motor", "a hinge", "two, or a ball")
            return f"{{joint: revolute, center: {center}, axis: {list_text(T[:3, :3] @ own[0])}}}"
        if len(own) > 2 or len(self.near if side == "base" else self.far) > 2:
            return f"{{joint: spherical, center: {center}}}"
        # the axis fixed to the body
        axis = T[:3, :3] @ (own[0] if side == "base" else own[-1])
        entry = "" if twists else f", axis: {list_text(axis)}"
        return f"{{joint: universal, center: {center}{entry}}}"

    def _offset_joint(self, side: str, end: LegEnd, axis: Array, twists: bool) -> str:
        """Entry of a universal joint whose axes do not meet."""
        if not twists or self.motion != "spatial":
            raise self.error(*NO_TWIST)
        T = np.eye(4) if side == "base" else inverse(self.T_base_platform)
        center, axis = T[:3, :3] @ end.center + T[:3, 3], T[:3, :3] @ axis
        ahead = self.u if side == "base" else -self.u
        offset = end.point - end.center
        size = float(np.copysign(np.linalg.norm(offset), offset @ ahead))
        return (
            f"{{joint: universal, center: {list_text(center)}, axis: {list_text(axis)},"
            f" offset: {number_text(size)}}}"
        )

    def _across(self, steps: Sequence[Step]) -> list[Array]:
        """Axes of hinges that are not along the leg; those of a ball are any three."""
        if any(s.kind == "ball" for s in steps):
            return list(np.eye(3))
        return [s.axis for s in steps if np.linalg.norm(cross(s.axis, self.u)) > GEOMETRY_SHARE]

    def _carrier(self, motor: Step, first: LegFit | None) -> str:
        """Entry of a crank or slider, whose reading 0 is the joint's value 0.

        first : first leg on the motor of several, whose crank gives them all their zero.
        """
        if self.motion == "spatial":
            self._joint("base")  # refuses a single hinge
        limits = np.sort(self.reading_limits * self.parts.model.gear[self.column])
        ends = f", range: {list_text(limits)}" if limits[0] < limits[1] else ""
        ends += "" if first is None else f", motor: {self.column + 1}"
        if motor.kind == "slide":
            center = self.a - float(self.parts.x[motor.dof]) * motor.axis
            place = f"center: {list_text(center)}, axis: {list_text(motor.axis)}"
            return f"{{joint: slider, {place}{ends}}}"
        along, arm = self.arm(motor)
        length, center = float(np.linalg.norm(arm)), motor.point
        if length < GEOMETRY_SHARE * self.parts.size:
            raise self.error("its joint is on its motor's axis", millimetres(length), "an arm")
        zero = arm / length
        if first is None:
            center = center + along * motor.axis
        else:
            zero = first.arm(motor)[1]
            zero /= np.linalg.norm(zero)
            angle = np.arctan2(float(cross(motor.axis, zero) @ arm), float(zero @ arm))
            ends += f", along: {number_text(along)}, angle: {number_text(angle)}"
        return (
            f"{{joint: crank, center: {list_text(center)}, axis: {list_text(motor.axis)}, zero:"
            f" {list_text(zero)}, arm: {number_text(length)}{ends}}}"
        )

    def arm(self, motor: Step) -> tuple[float, Array]:
        """Place of the arm along a crank's axis, m, and the arm (3,) at the joint's value 0."""
        off = self.a - motor.point
        along = float(off @ motor.axis)
        turn = rotation(-float(self.parts.x[motor.dof]) * motor.axis)
        return along, turn @ (off - along * motor.axis)

    def _bar(self, bar: Step) -> str:
        """Entry of a joint on a bar: one that keeps its direction if a coupling turns it."""
        T_platform_base = inverse(self.T_base_platform)
        hinge = (T_platform_base @ np.append(bar.point, 1.0))[:3]
        rest = f"hinge: {list_text(hinge)}, bar: {self.bar_number}"
        if any(bar.dof in (c.follower, c.leader) for c in self.parts.model.couplings):
            return f"{{joint: bar, center: {list_text(self.b - bar.point)}, {rest}}}"
        turn = T_platform_base[:3, :3]
        center, axis = turn @ (self.b - bar.point), turn @ bar.axis
        return (
            f"{{joint: hinged-bar, center: {list_text(center)}, axis: {list_text(axis)}, {rest}}}"
        )


def number_text(value: float) -> str:
    """Number with all digits, without an exponent."""
    return np.format_float_positional(float(np.round(value, 15)) + 0.0, trim="0")


def list_text(values: Array | Sequence[float]) -> str:
    """List of numbers."""
    return f"[{', '.join(number_text(float(value)) for value in values)}]"
