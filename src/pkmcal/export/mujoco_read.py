"""A MuJoCo model read again from its text, with kinematics of its own.

Nothing here knows a machine: bodies, joints and equality constraints mean what MuJoCo's
documentation of MJCF says of them, as far as :mod:`pkmcal.export.mujoco_model` uses them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, fromstring

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import cross, pose, rotation, rotation_vector

STEPS = 30
CLOSED = 1e-13
"""m or rad of a step below which nothing changes any more."""


@dataclass(frozen=True)
class ReadJoint:
    """A joint: ``hinge``, ``slide`` or ``free``; axis (3,) in its body's frame; first freedom."""

    name: str
    kind: str
    axis: Array
    ref: float
    body: int
    dof: int


@dataclass(frozen=True)
class ReadBody:
    """A body: its parent's number (0 is the world), place in it as drawn (4, 4), and joints."""

    name: str
    parent: int
    T_parent_body: Array
    joints: tuple[ReadJoint, ...]


@dataclass(frozen=True)
class Loop:
    """``connect`` or ``weld``: points (3,) in the two bodies' frames that coincide, and of a weld
    the second's orientation in the first (3, 3).
    """

    kind: str
    bodies: tuple[int, int]
    points: tuple[Array, Array]
    rot: Array


@dataclass(frozen=True)
class ReadModel:
    """What a text says. n_dofs : freedoms. couplings : (joint, joint, ratio) by dofs.

    sites, radii : points (body, (3,)) and cylinders' radii (m) by name. actuated : dofs of the
    actuators' joints, in order. ctrl : (m,) their values in the keyframe.
    """

    bodies: tuple[ReadBody, ...]
    n_dofs: int
    loops: tuple[Loop, ...]
    couplings: tuple[tuple[int, int, float], ...]
    sites: dict[str, tuple[int, Array]]
    radii: dict[str, float]
    actuators: tuple[str, ...]
    actuated: tuple[int, ...]
    ctrl: Array
    key: State

    def number(self, name: str) -> int:
        """A body's number by its name."""
        return next(k for k, b in enumerate(self.bodies) if b.name == name)

    def joints(self) -> Iterator[ReadJoint]:
        """All joints in order."""
        for part in self.bodies:
            yield from part.joints


@dataclass(frozen=True)
class State:
    """Joints' values by freedom (n_dofs,), without meaning for a free joint's: it has its body's
    pose (4, 4) in ``free``.
    """

    x: Array
    free: dict[int, Array] = field(default_factory=lambda: dict[int, Array]())


@dataclass(frozen=True)
class _Placed:
    """Bodies' poses (4, 4), and each freedom's axis (3,), anchor (3,), and whether it turns."""

    T_world_body: list[Array]
    axis: Array
    anchor: Array
    turns: Booleans


def read(text: str) -> ReadModel:
    """The model of a text, with loops closed as MuJoCo's compiler closes them: as drawn."""
    root = fromstring(text)
    bodies = [ReadBody("world", 0, np.eye(4), ())]
    sites: dict[str, tuple[int, Array]] = {}
    radii: dict[str, float] = {}
    world = root.find("worldbody")
    dofs = 0 if world is None else _collect(world, 0, bodies, 0, sites, radii)
    joints = {j.name: j for b in bodies for j in b.joints}
    drawn = State(
        _drawn(bodies, dofs), {k: b.T_parent_body for k, b in enumerate(bodies) if _is_free(b)}
    )
    placed = _place(bodies, dofs, drawn)
    names = {b.name: k for k, b in enumerate(bodies)}
    nodes = [node for part in root.findall("equality") for node in part]
    loops = [_loop(n, names, placed) for n in nodes if n.tag in ("connect", "weld")]
    couplings = [
        (joints[n.attrib["joint1"]].dof, joints[n.attrib["joint2"]].dof, _vector(n, "polycoef")[1])
        for n in nodes
        if n.tag == "joint"
    ]
    drives = root.findall("actuator/position")
    key = root.find("keyframe/key")
    return ReadModel(
        tuple(bodies),
        dofs,
        tuple(loops),
        tuple(couplings),
        sites,
        radii,
        tuple(n.attrib["name"] for n in drives),
        tuple(joints[n.attrib["joint"]].dof for n in drives),
        np.zeros(0) if key is None else _vector(key, "ctrl"),
        drawn if key is None else _of_qpos(bodies, dofs, _vector(key, "qpos")),
    )


def site_places(model: ReadModel, state: State) -> dict[str, Array]:
    """Where the named points are, (3,) m, world frame."""
    at = _place(model.bodies, model.n_dofs, state).T_world_body
    return {name: _apply(at[k], p) for name, (k, p) in model.sites.items()}


def body_pose(model: ReadModel, state: State, name: str) -> Array:
    """A body's pose (4, 4) in the world frame."""
    return _place(model.bodies, model.n_dofs, state).T_world_body[model.number(name)]


def constraints(model: ReadModel, state: State) -> tuple[Array, Array]:
    """The equality constraints' residuals (E,), m and rad, and their derivatives (E, n_dofs) by
    changes as in :func:`moved`; a weld's turn is differentiated where it is closed.
    """
    placed = _place(model.bodies, model.n_dofs, state)
    values: list[Array] = []
    rows: list[Array] = []
    drawn = _drawn(list(model.bodies), model.n_dofs)
    for loop in model.loops:
        (k1, k2), (p1, p2) = loop.bodies, loop.points
        T1, T2 = placed.T_world_body[k1], placed.T_world_body[k2]
        w1, w2 = _apply(T1, p1), _apply(T2, p2)
        sign = _chain(model, k1).astype(float) - _chain(model, k2)
        arms = np.where(_chain(model, k1)[:, None], w1, w2) - placed.anchor
        swept = np.where(placed.turns[:, None], cross(placed.axis, arms), placed.axis)
        values.append(w1 - w2)
        rows.append((sign[:, None] * swept).T)
        if loop.kind == "weld":
            values.append(rotation_vector(T1[:3, :3] @ loop.rot @ T2[:3, :3].T))
            rows.append((sign[:, None] * placed.turns[:, None] * placed.axis).T)
    for first, second, ratio in model.couplings:
        x = state.x - drawn
        values.append(np.array([x[first] - ratio * x[second]]))
        row = np.zeros(model.n_dofs)
        row[first], row[second] = 1.0, -ratio
        rows.append(row[None])
    return np.concatenate(values), np.concatenate(rows)


def closed(model: ReadModel, state: State, held: Booleans) -> State:
    """The state with its loops closed by Gauss-Newton; held : (n_dofs,) freedoms that stay."""
    for _ in range(STEPS):
        value, by_dof = constraints(model, state)
        step = np.zeros(model.n_dofs)
        step[~held] = -np.linalg.lstsq(by_dof[:, ~held], value, rcond=1e-10)[0]
        state = moved(model, state, step)
        if np.abs(step).max() < CLOSED:
            break
    return state


def moved(model: ReadModel, state: State, step: Array) -> State:
    """The state after small changes (n_dofs,); a free joint's are (omega, tau), world frame."""
    free = dict(state.free)
    for j in model.joints():
        if j.kind == "free":
            d, T = step[j.dof : j.dof + 6], free[j.body]
            free[j.body] = pose(rotation(d[:3]) @ T[:3, :3], T[:3, 3] + d[3:])
    return State(state.x + step, free)


def platform_dofs(model: ReadModel) -> Booleans:
    """(n_dofs,) which freedoms are the body ``platform``'s."""
    out = np.zeros(model.n_dofs, dtype=bool)
    for j in model.bodies[model.number("platform")].joints:
        out[j.dof : j.dof + _width(j.kind)] = True
    return out


def with_platform(model: ReadModel, state: State, T: Array) -> State:
    """The state with the body ``platform`` as near to a pose (4, 4) as its freedoms allow."""
    number = model.number("platform")
    if number in state.free:
        return State(state.x, {**state.free, number: T})
    x = state.x.copy()
    for _ in range(2):  # the turn moves no axis of a slide, so one would do but for rounding
        placed = _place(model.bodies, model.n_dofs, State(x, state.free))
        here = placed.T_world_body[number]
        omega = rotation_vector(T[:3, :3] @ here[:3, :3].T)
        for j in model.bodies[number].joints:
            wanted = omega if j.kind == "hinge" else T[:3, 3] - here[:3, 3]
            x[j.dof] += placed.axis[j.dof] @ wanted
    return State(x, state.free)


def _collect(
    node: Element,
    number: int,
    bodies: list[ReadBody],
    dofs: int,
    sites: dict[str, tuple[int, Array]],
    radii: dict[str, float],
) -> int:
    """Everything below a body, in the text's order; returns the freedoms counted so far."""
    for site in node.findall("site"):
        sites[site.attrib["name"]] = (number, _vector(site, "pos"))
    for geom in node.findall("geom"):
        if "name" in geom.attrib:
            radii[geom.attrib["name"]] = float(_vector(geom, "size")[0])
    for child in node.findall("body"):
        me = len(bodies)
        joints: list[ReadJoint] = []
        for j in child:
            if j.tag in ("joint", "freejoint"):
                kind = "free" if j.tag == "freejoint" else j.attrib["type"]
                axis = _vector(j, "axis", "0 0 1")
                axis = axis / np.linalg.norm(axis)
                ref = float(j.get("ref", "0"))
                joints.append(ReadJoint(j.attrib["name"], kind, axis, ref, me, dofs))
                dofs += _width(kind)
        place = pose(_matrix(_vector(child, "quat", "1 0 0 0")), _vector(child, "pos", "0 0 0"))
        bodies.append(ReadBody(child.attrib["name"], number, place, tuple(joints)))
        dofs = _collect(child, me, bodies, dofs, sites, radii)
    return dofs


def _width(kind: str) -> int:
    return 6 if kind == "free" else 1


def _is_free(body: ReadBody) -> bool:
    return any(j.kind == "free" for j in body.joints)


def _drawn(bodies: list[ReadBody], n_dofs: int) -> Array:
    x = np.zeros(n_dofs)
    for part in bodies:
        for j in part.joints:
            x[j.dof] = j.ref
    return x


def _of_qpos(bodies: list[ReadBody], n_dofs: int, qpos: Array) -> State:
    """A keyframe: scalars, and of a free joint its place and quaternion."""
    x, free, at = np.zeros(n_dofs), dict[int, Array](), 0
    for number, part in enumerate(bodies):
        for j in part.joints:
            if j.kind == "free":
                free[number] = pose(_matrix(qpos[at + 3 : at + 7]), qpos[at : at + 3])
                at += 7
            else:
                x[j.dof] = qpos[at]
                at += 1
    return State(x, free)


def _place(bodies: list[ReadBody] | tuple[ReadBody, ...], n_dofs: int, state: State) -> _Placed:
    """Where everything is: joints act one after the other, each in the frame so far."""
    at: list[Array] = []
    axis, anchor = np.zeros((n_dofs, 3)), np.zeros((n_dofs, 3))
    turns = np.zeros(n_dofs, dtype=bool)
    for number, part in enumerate(bodies):
        here = at[part.parent] @ part.T_parent_body if number else np.eye(4)
        for j in part.joints:
            if j.kind == "free":
                here = state.free[number]
                axis[j.dof : j.dof + 6] = np.concatenate([np.eye(3), np.eye(3)])
                turns[j.dof : j.dof + 3] = True
                anchor[j.dof : j.dof + 6] = here[:3, 3]
                continue
            value = state.x[j.dof] - j.ref
            axis[j.dof], anchor[j.dof] = here[:3, :3] @ j.axis, here[:3, 3]
            turns[j.dof] = j.kind == "hinge"
            turn, way = (value, 0.0) if j.kind == "hinge" else (0.0, value)
            here = here @ pose(rotation(turn * j.axis), way * j.axis)
        at.append(here)
    return _Placed(at, axis, anchor, turns)


def _loop(node: Element, names: dict[str, int], placed: _Placed) -> Loop:
    """A closure; the second body's share is taken from the model as drawn, as MuJoCo does.

    ``connect``: its anchor is a point of the first body. ``weld``: the second body's origin.
    """
    first, second = names[node.attrib["body1"]], names[node.attrib["body2"]]
    T1, T2 = placed.T_world_body[first], placed.T_world_body[second]
    T_1_2 = np.linalg.inv(T1) @ T2
    if node.tag == "weld":
        points = (T_1_2[:3, 3], np.zeros(3))
    else:
        own = _vector(node, "anchor")
        points = (own, _apply(np.linalg.inv(T2), _apply(T1, own)))
    return Loop(node.tag, (first, second), points, T_1_2[:3, :3])


def _chain(model: ReadModel, number: int) -> Booleans:
    """(n_dofs,) the freedoms between a body and the world."""
    out = np.zeros(model.n_dofs, dtype=bool)
    while number:
        for j in model.bodies[number].joints:
            out[j.dof : j.dof + _width(j.kind)] = True
        number = model.bodies[number].parent
    return out


def _apply(T: Array, p: Array) -> Array:
    return T[:3, :3] @ p + T[:3, 3]


def _vector(node: Element, key: str, default: str = "") -> Array:
    return np.array([float(v) for v in node.get(key, default).split()])


def _matrix(q: Array) -> Array:
    """The rotation (3, 3) of a quaternion (4,), scalar first."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
