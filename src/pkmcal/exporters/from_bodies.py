"""Nominal model of a multibody model: its legs between base and platform, by bodies and joints.

The inverse of :mod:`pkmcal.exporters.bodies`, for models of other origin, too: legs are recognised
by their joints, not by names. What is made is closed at poses all over its workspace together with
the model that was read, so a part that a leg cannot represent is an error, not a difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import InputError, PkmcalError, legible
from pkmcal.exporters.leg_fit import GEOMETRY_SHARE, Chain, LegFit, list_text
from pkmcal.exporters.mujoco_read import read_mujoco
from pkmcal.exporters.read_model import JOINT_BODY, ReadModel
from pkmcal.exporters.rigid_bodies import RigidBodies, Step, rigid_bodies
from pkmcal.exporters.samples import samples
from pkmcal.exporters.sdf_read import read_sdf
from pkmcal.exporters.urdf_read import read_urdf
from pkmcal.exporters.xml_read import LARGEST_MODEL_FILE, label_of, xml_root
from pkmcal.files import read_text
from pkmcal.geometry.rigid import pose_difference, rotation_vector
from pkmcal.mechanisms import Machine
from pkmcal.starter.nominal import NominalModel
from pkmcal.starter.sources import StarterSource
from pkmcal.wording import listed

LOOPS_ENDING = ".loops.yaml"
FORMATS = {"mujoco": "MJCF", "sdf": "SDF", "robot": "URDF"}
"""Formats by the root of their XML."""
EQUAL_SHARE = 1e-9
"""Difference above which the nominal model's comment states it."""
COMPARED_POSES = 8
DRAWN_TUBES = (
    "The legs' tubes are the cylinders that the file draws along them, at home: measure their"
    " radii."
)
GEARED = (
    "Readings of {joints} are the joints' values; the gears that the file has between these and"
    " the drives' positions are not in them."
)
LEAST_SCALE, MOST_SCALE = 0.5, 2.0
"""Bounds of the ratio of a joint's value and its reading: those of ``scale`` in a mechanism file.
Other ratios are gears between joint and drive."""
PLATFORM_NAME, BASE_NAME = "platform", "base"
MOTIONS = {
    ("xyz", 3): "spatial",
    ("xyz", 1): "schoenflies",
    ("xyz", 0): "translation",
    ("xy", 1): "planar",
    ("xy", 0): "planar-translation",
}
"""Motion by the slides and the number of hinges between base and platform."""


@final
class BodiesModel(StarterSource):
    """MJCF, SDF, or URDF with its file of loops."""

    title: ClassVar = "a model of bodies"
    recognised: ClassVar = "the XML of MJCF, SDF or URDF"
    options: ClassVar = ("tube_radius",)

    def claims(self, text: str, path: Path) -> bool:
        """Whether a text is XML."""
        del path
        return text.lstrip().startswith("<")

    def read(
        self, text: str, path: Path, unit: str | None, given: Mapping[str, float]
    ) -> NominalModel:
        """Nominal model. Raises InputError for what is no machine of legs between a base and a
        platform.
        """
        del unit
        if len(text) > LARGEST_MODEL_FILE:
            raise InputError(
                "the file is too large",
                where=path.name,
                found=f"{len(text)} characters",
                expected=f"at most {LARGEST_MODEL_FILE}",
                code="file.too_large",
            )
        try:
            return _nominal(*_read(path, text), path, given.get("tube_radius"))
        except PkmcalError as error:
            raise error.as_input(path.name) from None


def _read(path: Path, text: str) -> tuple[ReadModel, str]:
    """Model of a file, and its format."""
    root = xml_root(text)
    if root.tag == "mujoco":
        return read_mujoco(text, path.parent), FORMATS[root.tag]
    if root.tag == "sdf":
        return read_sdf(text), FORMATS[root.tag]
    if root.tag != "robot":
        raise InputError(
            "the file is no model of bodies and joints",
            found=label_of(root),
            expected="<mujoco>, <sdf> or <robot>",
        )
    if foreign := [node.tag for node in root.iter() if "}" in node.tag]:
        raise InputError(
            "a xacro file is not read",
            found=foreign[0],
            expected="the URDF that it expands to",
            next_step="Expand it with xacro: xacro FILE > FILE.urdf",
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
    geared = model.actuated[~_is_scale(model.gear)]
    names = [body.name for body in model.bodies]
    if doubled := [name for name in names if names.count(name) > 1]:
        raise InputError("two bodies have one name", found=doubled[0])
    # rigid bodies; base and platform; chains between them; legs
    parts = rigid_bodies(model)
    base = _base(parts)
    if base:  # the model floats: its base is the frame
        bodies = [b._replace(joints=() if k == base else b.joints)
                  for k, b in enumerate(model.bodies)]  # fmt: skip
        model = replace(model, bodies=tuple(bodies))
        parts = rigid_bodies(model)
    parts, tool = _without_tools(parts)
    platform = _platform(parts)
    parts = _with_readings(parts, platform)
    # cranks and carriages: bodies on the base by one joint that a motor moves
    motors = {
        e.second: e.steps[0]
        for e in parts.of(0)
        if len(e.steps) == 1 and e.steps[0].dof in parts.model.actuated and e.second != platform
    }
    bars = _bars(parts, platform)
    chains = _chains(parts, {0, *motors}, {platform, *bars})
    guides = [c for c in chains if sum(s.kind == "slide" for s in c.steps) > 1]
    motion = _motion(guides, chains)
    T_base_platform = parts.at[_frame_body(parts, platform)]
    fits = [
        LegFit(parts, chain, number, motors, bars, T_base_platform, motion)
        for number, chain in enumerate((c for c in chains if c not in guides), 1)
    ]
    fits.sort(key=lambda fit: fit.column if fit.column >= 0 else len(model.actuated) + fit.number)
    joints = {j.dof: j.name for body in model.bodies for j in body.joints}
    unused = set(range(parts.model.actuated.size)) - {fit.column for fit in fits}
    if unused or not fits:
        raise InputError(
            "a motor moves a joint that is no leg's"
            if fits
            else "there are no legs between base and platform",
            found=listed([joints[int(parts.model.actuated[k])] for k in unused]) or None,
            expected="the slide along a leg, or a hinge or slide between base and leg",
        )
    columns = [fit.column for fit in fits]
    firsts = {k: fits[columns.index(k)] for k in columns if columns.count(k) > 1}
    legs = tuple(fit.leg(firsts.get(fit.column)) for fit in fits)
    turn = rotation_vector(T_base_platform[:3, :3])
    home = f"position: {list_text(T_base_platform[:3, 3])}"
    if np.abs(turn).max() > EQUAL_SHARE:
        home += f", rotation_vector: {list_text(turn)}"
    out = NominalModel(
        "".join(c if c.isalnum() or c in "-_" else "-" for c in path.stem) or "machine",
        (
            f"The machine of {legible(path.name)}, {form}: base, platform and legs by its bodies"
            " and joints, in its frame, m and rad. The format has no ties between parameters.",
            *((DRAWN_TUBES,) if tube is None and any(leg.tubes for leg in legs) else ()),
            *((f"Joints in no loop, held at home: {legible(listed(tool, 8))}.",) if tool else ()),
            *(
                (GEARED.format(joints=legible(listed([joints[k] for k in geared], 8))),)
                if geared.size
                else ()
            ),
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


def _base(parts: RigidBodies) -> int:
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


def _without_tools(parts: RigidBodies) -> tuple[RigidBodies, tuple[str, ...]]:
    """Parts without joints that are in no loop, such as a gripper's, and the names of those."""
    edges, names = parts.edges, {j.dof: j.name for b in parts.model.bodies for j in b.joints}
    tool: list[int] = []
    while True:
        ends = [body for edge in edges for body in (edge.first, edge.second)]
        single = {body for body in ends if ends.count(body) == 1} - {0}
        loose = [edge for edge in edges if {edge.first, edge.second} & single]
        if not loose:
            break
        edges = tuple(edge for edge in edges if edge not in loose)
        tool += [step.dof for edge in loose for step in edge.steps if step.dof >= 0]
    if not edges:
        raise InputError(
            "the model has no closed loop", found=f"{len(parts.edges)} joints in a tree",
            expected="legs between a base and a platform",
        )  # fmt: skip
    remain = ~np.isin(parts.model.actuated, tool)
    model = replace(
        parts.model, actuated=parts.model.actuated[remain], gear=parts.model.gear[remain]
    )
    return replace(parts, model=model, edges=edges), tuple(names[dof] for dof in tool)


def _platform(parts: RigidBodies) -> int:
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


def _frame_body(parts: RigidBodies, platform: int) -> int:
    """Body whose frame is the platform frame."""
    names = {k: parts.model.bodies[k].name for k, r in enumerate(parts.rigid) if r == platform}
    named = [k for k, name in names.items() if name.lower() == PLATFORM_NAME]
    own = [k for k, name in names.items() if not name.endswith(JOINT_BODY)]
    return (named or own)[0]


def _is_scale(gear: Array) -> Booleans:
    """Whether gears (m,) are scales of readings; others are those of a drive."""
    return (gear > 1 / MOST_SCALE) & (gear < 1 / LEAST_SCALE)


def _with_readings(parts: RigidBodies, platform: int) -> RigidBodies:
    """Parts with readings: the file's motors, or without any the legs' slides, or the first hinges
    or slides on the base.
    """
    model = parts.model
    gear = np.where(_is_scale(model.gear), model.gear, 1.0)
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


def _bars(parts: RigidBodies, platform: int) -> dict[int, Step]:
    """Bars: bodies on the platform by one hinge that hold several legs."""
    return {
        e.second: e.steps[0]
        for e in parts.of(platform)
        if e.second
        and len(e.steps) == 1
        and e.steps[0].kind == "hinge"
        and len(parts.of(e.second)) > 2
    }


def _chains(parts: RigidBodies, start: set[int], stop: set[int]) -> list[Chain]:
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
    """Motion of the platform: by the joints that guide it; without any spatial, or planar if all
    joints move in the plane.
    """
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


def _difference(model: ReadModel, parts: RigidBodies, platform: int, machine: Machine) -> float:
    """Largest difference of platform poses, a share of the size or rad, at common readings."""
    own = _frame_body(parts, platform)
    bodies = [b._replace(name=PLATFORM_NAME if k == own else f"{b.name} {k}")
              for k, b in enumerate(model.bodies)]  # fmt: skip
    model = replace(model, bodies=tuple(bodies), key=parts.x)
    try:
        poses, readings = samples(machine, COMPARED_POSES)
    except PkmcalError as error:
        raise InputError(error.what, next_step="Check the joints' limits") from None
    x = model.at(readings, poses)
    away = pose_difference(model.places(x)[PLATFORM_NAME], poses) / ([1.0] * 3 + [parts.size] * 3)
    gaps = np.abs(model.gaps(x)) / min(1.0, parts.size)
    worst = float(max(np.abs(away).max(), gaps.max(initial=0.0)))
    if not worst < GEOMETRY_SHARE:  # NaN, too
        raise InputError(
            "the legs between base and platform do not move it as the file's bodies do",
            found=f"a difference of {worst:.3g} of the machine's size",
            expected=f"less than {GEOMETRY_SHARE:g}",
        )
    return worst
