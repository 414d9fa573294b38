"""Nominal model of a multibody model: its legs between base and platform, by bodies and joints.

The inverse of :mod:`pkmcal.exporters.bodies`, for models of other origin, too: legs are recognised
by their joints, not by names. What is made is closed at poses all over its workspace together with
the model that was read, so a part that a leg cannot represent is an error, not a difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError, InputError, PkmcalError, legible
from pkmcal.exporters.mujoco_read import read_mujoco
from pkmcal.exporters.read_model import ReadModel, body_poses
from pkmcal.exporters.samples import samples
from pkmcal.exporters.sdf_read import read_sdf
from pkmcal.exporters.urdf_read import read_urdf
from pkmcal.exporters.xml_read import LARGEST_MODEL_FILE, label_of, xml_root
from pkmcal.files import read_text
from pkmcal.geometry.rigid import cross, inverse, pose, pose_difference, rotation, rotation_vector
from pkmcal.mechanisms import Machine
from pkmcal.starter.nominal import NominalLeg, NominalModel, millimetres, option_of
from pkmcal.wording import listed

LOOPS_ENDING = ".loops.yaml"
FORMATS = {"mujoco": "MJCF", "sdf": "SDF", "robot": "URDF"}
"""Formats by the root of their XML."""
GEOMETRY_SHARE = 1e-4
"""Tolerance for axes that meet in a point, as a share of the machine's size, and of a direction:
numbers of other files have few digits."""
SAME_POSE_SHARE = 1e-4
"""Largest difference of platform poses between file and nominal model: a share of the size, and
rad."""
EQUAL_SHARE = 1e-9
"""Difference above which the nominal model's comment states it."""
KEY_CLOSED_GAP = 1e-12
LARGEST_GAP = 1e-9
"""Gaps (m, rad) with which a stated state counts as closed, and with which one that was solved for
does."""
COMPARED_POSES = 8
LEAST_SCALE, MOST_SCALE = 0.5, 2.0
"""Bounds of the ratio of a joint's value and its reading; beyond them it is a gear of something
else."""
PLATFORM_NAME, BASE_NAME = "platform", "base"
MOTIONS = {
    ("xyz", 3): "spatial",
    ("xyz", 1): "schoenflies",
    ("xyz", 0): "translation",
    ("xy", 1): "planar",
    ("xy", 0): "planar-translation",
}
"""Motion by the slides and the number of hinges between base and platform."""


class Step(NamedTuple):
    """Elementary joint ``hinge``, ``slide`` or ``ball`` at home.

    axis, point : (3,) base frame; the axis is that of a growing value. dof : of the state, -1 for
    the joint of a loop.
    """

    kind: str
    axis: Array
    point: Array
    dof: int


class Edge(NamedTuple):
    """Joints in series between two rigid bodies."""

    first: int
    second: int
    steps: tuple[Step, ...]

    def onward(self, start: int) -> Edge:
        """Edge from one of its bodies to the other."""
        if start == self.first:
            return self
        steps = tuple(step._replace(axis=-step.axis) for step in reversed(self.steps))
        return Edge(self.second, self.first, steps)


class Chain(NamedTuple):
    """Steps from a body on the base's side to one on the platform's side."""

    start: int
    steps: tuple[Step, ...]
    stop: int


@dataclass(frozen=True)
class _Parts:
    """Rigid bodies of a model in a closed state.

    model : readings' joints included. x : (d,) closed state. at : poses of the model's bodies.
    rigid : number of each body's rigid body. edges : joints between rigid bodies.
    """

    model: ReadModel
    x: Array
    at: list[Array]
    rigid: tuple[int, ...]
    edges: tuple[Edge, ...]

    def name(self, body: int) -> str:
        """Name of a rigid body: that of its first part."""
        return self.model.bodies[body].name

    def of(self, body: int) -> list[Edge]:
        """Edges from a rigid body on."""
        return [e.onward(body) for e in self.edges if body in (e.first, e.second)]

    @property
    def size(self) -> float:
        """Largest distance of a joint from the base's origin, m."""
        return max(float(np.linalg.norm(s.point)) for e in self.edges for s in e.steps)


def is_model(path: Path) -> bool:
    """Whether a file is XML."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<")


def bodies_model(path: Path, given: Mapping[str, float]) -> NominalModel:
    """Nominal model of MJCF, of SDF, or of URDF with its file of loops.

    given : dimensions, m; only ``tube_radius``. Raises InputError for what is no machine of legs
    between a base and a platform.
    """
    if extra := [name for name in given if name != "tube_radius"]:
        raise InputError(
            "a model of bodies has all dimensions",
            where="--from",
            found=f"{listed(list(map(option_of, extra)))} besides",
            expected="no dimension but --tube-radius",
        )
    text = read_text(path, largest=LARGEST_MODEL_FILE)
    try:
        return _nominal(*_read(path, text), path, given.get("tube_radius"))
    except PkmcalError as error:
        raise error.as_input(path.name) from None


def _read(path: Path, text: str) -> tuple[ReadModel, str]:
    """Model of a file, and its format."""
    root = xml_root(text)
    if root.tag == "mujoco":
        return read_mujoco(text), FORMATS[root.tag]
    if root.tag == "sdf":
        return read_sdf(text), FORMATS[root.tag]
    if root.tag != "robot":
        raise InputError(
            "the file is no model of bodies and joints",
            found=label_of(root),
            expected="<mujoco>, <sdf> or <robot>",
        )
    beside = path.with_name(path.stem + LOOPS_ENDING)
    if not beside.is_file():
        raise InputError(
            "a URDF is a tree, so the loops that close a machine are in a file beside it",
            found=f"no {beside.name}",
            expected=f"{beside.name}, as pkmcal export --to urdf writes it",
        )
    loops = read_text(beside, largest=LARGEST_MODEL_FILE)
    return read_urdf(text, loops, beside.name), FORMATS[root.tag]


def _nominal(model: ReadModel, form: str, path: Path, tube: float | None) -> NominalModel:
    """Nominal model of a model that was read."""
    # rigid bodies; base and platform; chains between them; legs
    parts = _parts(model)
    base = _base(parts)
    if base:  # the model floats: its base is the frame
        bodies = [b._replace(joints=() if k == base else b.joints)
                  for k, b in enumerate(model.bodies)]  # fmt: skip
        model = replace(model, bodies=tuple(bodies))
        parts = _parts(model)
    platform = _platform(parts)
    parts = _with_readings(parts, platform)
    motors = _motors(parts, platform)
    bars = _bars(parts, platform)
    chains = _chains(parts, {0, *motors}, {platform, *bars})
    guides = [c for c in chains if sum(s.kind == "slide" for s in c.steps) > 1]
    motion = _motion(guides, chains)
    T_base_platform = parts.at[_shown(parts, platform)]
    fits = [
        _Fit(parts, chain, number, motors, bars, T_base_platform, motion)
        for number, chain in enumerate((c for c in chains if c not in guides), 1)
    ]
    fits.sort(key=lambda fit: fit.column if fit.column >= 0 else len(model.actuated) + fit.number)
    unused = set(range(parts.model.actuated.size)) - {fit.column for fit in fits}
    if unused or not fits:
        names = {j.dof: j.name for body in model.bodies for j in body.joints}
        raise InputError(
            "a motor moves a joint that is no leg's"
            if fits
            else "there are no legs between base and platform",
            found=listed([names[int(parts.model.actuated[k])] for k in unused]) or None,
            expected="the slide along a leg, or a hinge or slide between base and leg",
        )
    columns = [fit.column for fit in fits]
    firsts = {k: fits[columns.index(k)] for k in columns if columns.count(k) > 1}
    legs = tuple(fit.leg(firsts.get(fit.column)) for fit in fits)
    turn = rotation_vector(T_base_platform[:3, :3])
    home = f"position: {_list(T_base_platform[:3, 3])}"
    if np.abs(turn).max() > EQUAL_SHARE:
        home += f", rotation_vector: {_list(turn)}"
    out = NominalModel(
        "".join(c if c.isalnum() or c in "-_" else "-" for c in path.stem) or "machine",
        (
            f"The machine of {legible(path.name)}, {form}: base, platform and legs by its bodies"
            " and joints, in its frame, m and rad. The format has no ties between parameters.",
        ),
        (),
        motion,
        legs,
        T_base_platform[:3, 3],
        tube,
        home_entry=f"{{{home}}}",
    )
    signs = np.array([next(f.sign for f in fits if f.column == k) for k in range(max(columns) + 1)])
    gear = parts.model.gear * signs
    away = _difference(replace(parts.model, gear=gear), parts, platform, out.machine())
    if away > EQUAL_SHARE:
        remark = f"Platform poses of the file differ from this model's by {away:.2g} of its size."
        out = replace(out, heading=(*out.heading, remark))
    return out


# Bodies


def _parts(model: ReadModel) -> _Parts:
    """Rigid bodies of a model, closed from its key."""
    names = [body.name for body in model.bodies]
    if doubled := [name for name in names if names.count(name) > 1]:
        raise InputError("two bodies have one name", found=doubled[0])
    x = model.key
    if np.abs(model.gaps(x)).max(initial=0.0) > KEY_CLOSED_GAP:
        x = model.closed(x[None], np.zeros(x.size, dtype=bool))[0]
    gap = float(np.abs(model.gaps(x)).max(initial=0.0))
    if not gap < LARGEST_GAP:  # NaN, too
        raise InputError(
            "the loops do not close", found=f"a gap of {millimetres(gap)}", expected="none"
        )
    at = body_poses(model.bodies, x)
    # bodies without joints, and bodies that a loop holds as poses, are one
    rigid = list(range(len(model.bodies)))

    def joined(one: int, other: int) -> None:
        low, high = sorted((rigid[one], rigid[other]))
        rigid[:] = [low if r == high else r for r in rigid]

    for k, body in enumerate(model.bodies):
        if not body.joints:
            joined(k, body.parent)
    for loop in model.loops:
        if loop.rigid:
            joined(*loop.bodies)
    edges: list[Edge] = []
    for k, body in enumerate(model.bodies):
        if body.joints and body.joints[0].kind != "free":
            steps = tuple(_steps(model, at, x, k))
            edges.append(Edge(rigid[body.parent], rigid[k], steps))
    for loop in model.loops:
        if not loop.rigid:
            point = (at[loop.bodies[0]] @ loop.frames[0])[:3, 3]
            ends = [rigid[b] for b in loop.bodies]
            edges.append(Edge(ends[0], ends[1], (Step("ball", np.zeros(3), point, -1),)))
    if not edges:
        raise InputError("the model has no joints", found=f"{len(model.bodies) - 1} bodies")
    return _Parts(model, x, at, tuple(rigid), tuple(edges))


def _steps(model: ReadModel, at: Sequence[Array], x: Array, k: int) -> list[Step]:
    """Joints of body k, in the world at state x."""
    body, out = model.bodies[k], list[Step]()
    here = at[body.parent] @ body.T_parent_body
    for j in body.joints:
        if j.kind == "free":
            raise InputError("a free joint beside other joints is not read", where=body.name)
        out.append(Step(j.kind, here[:3, :3] @ j.axis, here[:3, 3], j.dof))
        moved = (x[j.dof] - j.ref) * j.axis
        turns = j.kind == "hinge"
        here = here @ (pose(rotation(moved), np.zeros(3)) if turns else pose(np.eye(3), moved))
    return out


def _base(parts: _Parts) -> int:
    """Body that is the base: the world, or of a model that floats the body named base."""
    if parts.of(0):
        return 0
    for k, body in enumerate(parts.model.bodies):
        if body.name.lower().startswith(BASE_NAME) and parts.of(parts.rigid[k]):
            return parts.rigid[k]
    raise InputError(
        "nothing is fastened to the world, and no body is named base",
        found=listed([b.name for b in parts.model.bodies[1:]], 8),
        expected="a base",
    )


def _platform(parts: _Parts) -> int:
    """Rigid body that is the platform: of that name, or with the most joints."""
    named = {
        parts.rigid[k]
        for k, body in enumerate(parts.model.bodies)
        if body.name.lower() == PLATFORM_NAME
    } - {0}
    if len(named) == 1:
        return named.pop()
    counts = {r: len(parts.of(r)) for r in parts.rigid if r}
    most = [r for r, count in counts.items() if count == max(counts.values())]
    if len(most) != 1 or counts[most[0]] < 2:
        raise InputError(
            "no body is the platform",
            found=f"{listed([parts.name(r) for r in most], 8)} with {max(counts.values())} joints"
            " each",
            expected="a body named platform, or one with more joints than the others",
        )
    return most[0]


def _shown(parts: _Parts, platform: int) -> int:
    """Body whose frame is the platform frame."""
    members = [k for k, r in enumerate(parts.rigid) if r == platform]
    named = (k for k in members if parts.model.bodies[k].name.lower() == PLATFORM_NAME)
    return next(named, members[0])


def _with_readings(parts: _Parts, platform: int) -> _Parts:
    """Parts with readings: the file's motors, or without any the legs' slides, or the first hinges
    or slides on the base.
    """
    model = parts.model
    gear = np.where((model.gear > 1 / MOST_SCALE) & (model.gear < 1 / LEAST_SCALE), model.gear, 1.0)
    if model.actuated.size:
        return replace(parts, model=replace(model, gear=gear))
    chains = _chains(parts, {0}, {platform, *_bars(parts, platform)})
    slides = [[s.dof for s in c.steps if s.kind == "slide"] for c in chains]
    dofs = [own[0] for own in slides if len(own) == 1]
    if not dofs:
        firsts = [e.steps for e in parts.of(0)]
        dofs = [steps[0].dof for steps in firsts if len(steps) == 1 and steps[0].dof >= 0]
    model = replace(model, actuated=np.array(dofs, dtype=int), gear=np.ones(len(dofs)))
    return replace(parts, model=model)


def _motors(parts: _Parts, platform: int) -> dict[int, Step]:
    """Cranks and carriages: bodies on the base by one joint that a motor moves."""
    return {
        e.second: e.steps[0]
        for e in parts.of(0)
        if len(e.steps) == 1 and e.steps[0].dof in parts.model.actuated and e.second != platform
    }


def _bars(parts: _Parts, platform: int) -> dict[int, Step]:
    """Bars: bodies on the platform by one hinge that hold several legs."""
    return {
        e.second: e.steps[0]
        for e in parts.of(platform)
        if e.second
        and len(e.steps) == 1
        and e.steps[0].kind == "hinge"
        and len(parts.of(e.second)) > 2
    }


def _chains(parts: _Parts, start: set[int], stop: set[int]) -> list[Chain]:
    """Chains of joints from the base's side to the platform's."""
    out: list[Chain] = []
    for edge in parts.edges:
        for body in sorted({edge.first, edge.second} & start):
            first = edge.onward(body)
            if first.second in start:
                continue
            steps, here, last = list(first.steps), first.second, first
            while here not in stop:
                onward = [e for e in parts.of(here) if e.steps[0].point is not last.steps[-1].point]
                if len(onward) != 1 or onward[0].second in start:
                    raise InputError(
                        "a leg does not lead from the base to the platform",
                        where=parts.name(here),
                        found=f"{len(onward)} further joints"
                        + (" back to the base" if len(onward) == 1 else ""),
                        expected="one, towards the platform",
                    )
                (last,) = onward
                steps += last.steps
                here = last.second
            out.append(Chain(body, tuple(steps), here))
    return out


def _motion(guides: Sequence[Chain], chains: Sequence[Chain]) -> str:
    """Motion of the platform: by the joints that guide it, or free; in a plane if all joints are."""
    level = all(
        s.kind != "ball" and abs(s.axis[2]) < GEOMETRY_SHARE
        if s.kind != "hinge"
        else abs(s.axis[2]) > 1 - GEOMETRY_SHARE**2
        for chain in chains
        for s in chain.steps
    )
    if not guides:
        return "planar" if level else "spatial"
    steps = [s for guide in guides for s in guide.steps]
    spans = np.abs(np.sum([s.axis**2 for s in steps if s.kind == "slide"], axis=0))
    slides = "xyz" if np.allclose(spans, 1) else "xy" if np.allclose(spans, [1, 1, 0]) else ""
    hinges = [s for s in steps if s.kind == "hinge"]
    upright = len(hinges) != 1 or abs(hinges[0].axis[2]) > 1 - GEOMETRY_SHARE**2
    if len(guides) > 1 or not upright or (slides, len(hinges)) not in MOTIONS:
        raise InputError(
            "the joints between base and platform leave it no motion that can be represented",
            found=f"{len(steps) - len(hinges)} slides and {len(hinges)} hinges",
            expected=listed([f"{len(axes)} slides and {n} hinges" for axes, n in MOTIONS]),
        )
    return MOTIONS[slides, len(hinges)]


# Legs


def _meeting_point(steps: Sequence[Step], tolerance: float) -> Array | None:
    """Point (3,) where the axes of joints meet, or that of the ball; None if there is none."""
    if not steps or any(s.kind == "slide" for s in steps):
        return None
    first = next((s for s in steps if s.kind == "ball"), steps[0])
    points = np.array([s.point for s in steps])
    if np.ptp(points, axis=0).max() < 1e-12:  # rounding
        return first.point
    across = [np.eye(3) - np.outer(s.axis, s.axis) for s in steps]
    if first.kind == "ball":
        point = first.point
    else:
        sums = sum(P @ s.point for P, s in zip(across, steps, strict=True))
        point = np.linalg.lstsq(np.sum(across, axis=0), np.asarray(sums), rcond=1e-9)[0]
    off = [np.linalg.norm(P @ (point - s.point)) for P, s in zip(across, steps, strict=True)]
    return point if max(off) < tolerance else None


class _Fit:
    """Leg of a chain of joints.

    column : reading, -1 for none. sign : -1 if the reading grows as the joint's value falls.
    """

    def __init__(
        self,
        parts: _Parts,
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
        splits = [(k, k + 1) for k in slides] or [(k, k) for k in range(len(steps) - 1, 0, -1)]
        for low, high in splits:
            near, far = steps[:low], steps[high:]
            a, b = _meeting_point(near, tolerance), _meeting_point(far, tolerance)
            if a is not None and b is not None and np.linalg.norm(b - a) > tolerance:
                break
        else:
            raise self.error(
                "its joints do not meet in two points, one on each side",
                f"{', '.join(s.kind for s in steps)}",
                "joints whose axes meet at either end, and at most one slide between them",
            )
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

    def leg(self, first: _Fit | None) -> NominalLeg:
        """Leg of the nominal model; first : first leg on the motor of several."""
        base = self._joint("base")
        rod = f"{{actuated: false, constant: {_number(self.length)}}}"
        if self.motor is not None:
            base = self._carrier(self.motor, first)
        elif self.slide is not None and self.column < 0:
            rod = "{passive: true}"
        elif self.slide is not None:
            offset = self.length - self.sign * float(self.parts.x[self.slide.dof])
            rod = f"{{actuated: true, offset: {_number(offset)}"
            low, high = self.reading_limits + offset
            rod += f", range: {_list([low, high])}}}" if 0 < low < high else "}"
        gear = 1.0 if self.column < 0 else float(self.parts.model.gear[self.column])
        held = self._joint("platform") if self.bar is None else self._bar(self.bar)
        b_platform = (inverse(self.T_base_platform) @ np.append(self.b, 1.0))[:3]
        return NominalLeg(
            base, rod, self.a, b_platform, held=held, scale="" if gear == 1 else _number(1 / gear)
        )

    def _joint(self, side: str) -> str:
        """Entry of a joint on the base or on the platform."""
        T = np.eye(4) if side == "base" else inverse(self.T_base_platform)
        center = _list((T @ np.append(self.a if side == "base" else self.b, 1.0))[:3])
        if self.motion != "spatial":
            kind = "revolute" if "planar" in self.motion else "spherical"
            return f"{{joint: {kind}, center: {center}}}"
        near, far = self._across(self.near), self._across(self.far)
        own = near if side == "base" else far
        # hinges along the leg, and balls, let it twist
        twists = max(len(near), len(far)) > 2 or len(near) + len(far) < len(self.near) + len(
            self.far
        )
        if not twists and len(near) + len(far) < 4:
            raise self.error(
                "it may not twist, and a hinge at one end restricts it besides",
                f"{len(near)} hinges on the base and {len(far)} on the platform",
                "two at each end, or a ball",
            )
        if len(own) == 1:
            if side == "base" and self.motor is not None:
                raise self.error("one hinge joins it to its motor", "a hinge", "two, or a ball")
            return f"{{joint: revolute, center: {center}, axis: {_list(T[:3, :3] @ own[0])}}}"
        if len(own) > 2:
            return f"{{joint: spherical, center: {center}}}"
        # the axis fixed to the body
        axis = T[:3, :3] @ (own[0] if side == "base" else own[-1])
        entry = "" if twists else f", axis: {_list(axis)}"
        return f"{{joint: universal, center: {center}{entry}}}"

    def _across(self, steps: Sequence[Step]) -> list[Array]:
        """Axes of hinges that are not along the leg; those of a ball are any three."""
        if any(s.kind == "ball" for s in steps):
            return list(np.eye(3))
        return [s.axis for s in steps if np.linalg.norm(cross(s.axis, self.u)) > GEOMETRY_SHARE]

    def _carrier(self, motor: Step, first: _Fit | None) -> str:
        """Entry of a crank or slider, whose reading 0 is the joint's value 0.

        first : first leg on the motor of several, whose crank gives them all their zero.
        """
        if self.motion == "spatial":
            self._joint("base")  # refuses a single hinge
        limits = np.sort(self.reading_limits * self.parts.model.gear[self.column])
        ends = f", range: {_list(limits)}" if limits[0] < limits[1] else ""
        ends += "" if first is None else f", motor: {self.column + 1}"
        if motor.kind == "slide":
            center = self.a - float(self.parts.x[motor.dof]) * motor.axis
            return f"{{joint: slider, center: {_list(center)}, axis: {_list(motor.axis)}{ends}}}"
        along, arm = self._arm(motor)
        length, center = float(np.linalg.norm(arm)), motor.point
        if length < GEOMETRY_SHARE * self.parts.size:
            raise self.error("its joint is on its motor's axis", millimetres(length), "an arm")
        zero = arm / length
        if first is None:
            center = center + along * motor.axis
        else:
            zero = first._arm(motor)[1]
            zero /= np.linalg.norm(zero)
            angle = np.arctan2(float(cross(motor.axis, zero) @ arm), float(zero @ arm))
            ends += f", along: {_number(along)}, angle: {_number(angle)}"
        return (
            f"{{joint: crank, center: {_list(center)}, axis: {_list(motor.axis)}, zero:"
            f" {_list(zero)}, arm: {_number(length)}{ends}}}"
        )

    def _arm(self, motor: Step) -> tuple[float, Array]:
        """Place of the arm along a crank's axis, m, and the arm (3,) at the joint's value 0."""
        off = self.a - motor.point
        along = float(off @ motor.axis)
        turn = rotation(-float(self.parts.x[motor.dof]) * motor.axis)
        return along, turn @ (off - along * motor.axis)

    def _bar(self, bar: Step) -> str:
        """Entry of a joint on a bar: one that keeps its direction if a coupling turns it."""
        T_platform_base = inverse(self.T_base_platform)
        hinge = (T_platform_base @ np.append(bar.point, 1.0))[:3]
        rest = f"hinge: {_list(hinge)}, bar: {self.bar_number}"
        if any(bar.dof in (c.follower, c.leader) for c in self.parts.model.couplings):
            return f"{{joint: bar, center: {_list(self.b - bar.point)}, {rest}}}"
        turn = T_platform_base[:3, :3]
        center, axis = turn @ (self.b - bar.point), turn @ bar.axis
        return f"{{joint: hinged-bar, center: {_list(center)}, axis: {_list(axis)}, {rest}}}"


def _difference(model: ReadModel, parts: _Parts, platform: int, machine: Machine) -> float:
    """Largest difference of platform poses, a share of the size or rad, at common readings."""
    shown = _shown(parts, platform)
    bodies = [b._replace(name=PLATFORM_NAME if k == shown else f"{b.name} {k}")
              for k, b in enumerate(model.bodies)]  # fmt: skip
    model = replace(model, bodies=tuple(bodies), key=parts.x)
    try:
        poses, readings = samples(machine, COMPARED_POSES)
    except PkmcalError as error:
        raise GeometryError(
            error.what, found=machine.name, expected="a machine that moves"
        ) from None
    x = model.at(readings, poses)
    away = pose_difference(model.places(x)[PLATFORM_NAME], poses) / ([1.0] * 3 + [parts.size] * 3)
    gaps = np.abs(model.gaps(x)) / min(1.0, parts.size)
    worst = float(max(np.abs(away).max(), gaps.max(initial=0.0)))
    if not worst < SAME_POSE_SHARE:  # NaN, too
        raise InputError(
            "the legs between base and platform do not move it as the file's bodies do",
            found=f"a difference of {worst:.3g} of the machine's size",
            expected=f"less than {SAME_POSE_SHARE:g}",
        )
    return worst


def _number(value: float) -> str:
    """Number with all digits, without an exponent."""
    return np.format_float_positional(float(np.round(value, 15)) + 0.0, trim="0")


def _list(values: Array | Sequence[float]) -> str:
    """List of numbers."""
    return f"[{', '.join(_number(float(value)) for value in values)}]"
