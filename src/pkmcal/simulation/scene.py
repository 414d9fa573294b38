"""Scene of a session: the machine with its nominal shapes in a room with a table.

Room, lamps and surfaces are drawn at random from one seed and stay the same for the whole session,
as in a laboratory; only the machine moves. Sizes are relative to the machine's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import apply, cross, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import PLANAR_MOTIONS
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.drives import Drives, drives_of, reaches, side_bars
from pkmcal.ranges import Light
from pkmcal.simulation.render import Scene, ScenePart
from pkmcal.simulation.shapes import Ball, Box, Cylinder, Wall
from pkmcal.simulation.surfaces import (
    Checks,
    Clouds,
    Finish,
    Lamp,
    Lighting,
    Material,
    Slats,
    SmoothNoise,
    WavyStripes,
)

Z_AXIS = np.array([0.0, 0.0, 1.0])
MOTOR_RADIUS = 0.17
"""Radius of a motor relative to its arm's length; at least 2.2 radii of the joint."""
CARRIAGE_HALF_SIZE = (2.4, 1.4, 0.6)
"""Half a carriage's size along, across and from its guide, in radii of the joint on it."""
RAIL_HALF_WIDTH = 1.2
"""Half a guide's width, in radii of the joint on its carriage."""
PLANAR_POST_HEIGHTS = 3.5, 7.5
"""Heights of the posts on a planar machine's plates, platform and base, in radii of a joint. A
plate above the legs would hide them; the shadows on a plate close below them would look like edges.
"""
HANGING_COLUMN_SIZE = 0.12, 12.0
"""Radius and length of the column above a hanging machine, in radii of its base; it ends in the
ceiling."""
GUIDE_BED_DEPTH = 4.0
"""Distance of the plate that guides stand on below the platform's lowest joints, in radii of the
platform: room for a tool or a board under the platform."""
SKY_AND_GROUND_LIGHT = {False: (0.26, 0.13), True: (0.42, 0.28)}
SOFT_LAMP_SHARE = 0.7
"""Light from above and below, by whether the base carries motors, and the remaining share of the
lamps' power for such machines. Their rods are thin; in hard light a rod's edge in the image would
be the border of its lit side."""
KINDS_OF_LIGHT: dict[Light, tuple[float, float, float]] = {
    "usual": (1.0, 1.0, 1.0),
    "soft": (2.5, 0.5, 1.8),
    "hard": (0.3, 1.3, 0.4),
}
"""Factors on the lamps' radius and power and on the ambient light, by kind of light: under a white
ceiling (soft), in the sun or under a spot (hard)."""
BOARD_LAMP_ANGLE = 1.2
"""Largest angle, in rad, between the cameras' azimuth and a lamp that lights a board."""
MOTOR_SHARE, RING_AT, CABLE_PIECES = 0.5, 0.7, 8
"""Length of a leg's motor and position of its ring, relative to the length of the leg's first tube;
straight pieces of the motor's cable."""
TOOL_FLANGE_RADIUS = 0.3
"""Radius of an articulated platform's tool flange, relative to a rigid platform's plate."""


@dataclass(frozen=True)
class Discs:
    """Plates that carry the joints, and the actuators of the legs' ends on the base.

    base, platform : (3,) centre of the face towards the joints; base frame, platform frame.
    base_radius, platform_radius : m.
    side : +1 where the platform stands above the base along the frames' z, -1 below.
    platform_side : the same for the platform's plate relative to its joints.
    board_foot : (3,) point beyond which the platform carries a board; platform frame.
    board_side : the board's side of it: behind the plate, but before the joints of a planar
        machine, where its cameras are.
    thickness : m.
    """

    base: Array
    platform: Array
    base_radius: float
    platform_radius: float
    side: float
    platform_side: float
    board_foot: Array
    board_side: float
    thickness: float
    drives: Drives


def discs_of(machine: Machine) -> Discs:
    """Plates beyond the joints along the frames' z, as wide as the joints need.

    Both plates of a planar machine lie below its legs, the platform's above the base's.
    """
    ends = limb_ends(machine.layout, machine.values, np.zeros(machine.n_joints), np.eye(4))
    a, b = np.array(ends.a), np.array(ends.b)
    # sides of the plates
    rise = float(apply(machine.home(), b)[:, 2].mean() - a[:, 2].mean())
    side = -1.0 if rise < -1e-3 else 1.0
    balls, drives = _ball_radii(machine), drives_of(machine)
    ball = float(balls.max())
    # widths and heights of the plates, by what they carry
    held, room = _held(machine, drives, balls[:, 0])
    width_a, width_b = (
        float(np.linalg.norm(p[..., :2] - p[..., :2].mean(axis=0), axis=1).max())
        for p in (held[:, :2], b)
    )
    base, platform = held.mean(axis=0), b.mean(axis=0)
    planar = machine.document.motion in PLANAR_MOTIONS
    near, far = (p[0, :, 2].mean() for p in reaches(machine))
    lift, drop = PLANAR_POST_HEIGHTS if planar else (2.2, 2.2)
    over = -side if planar else -1.0 if far - near < -1e-3 else 1.0
    drop = max(drop * ball, room, GUIDE_BED_DEPTH * width_b if drives.upright.any() else 0.0)
    base[2] = (side * held[:, 2]).min() * side - side * drop
    platform[2] = (over * b[:, 2]).max() * over + over * lift * ball
    thickness = max(0.012, 0.8 * ball)
    board_side = side if planar else over
    foot = platform + board_side * thickness * np.array([0.0, 0.0, 1.0])
    if planar:
        foot[2] += 2.0 * (b[:, 2].mean() - platform[2])
    return Discs(
        base, platform, width_a + max(3.5 * ball, room), width_b + 2.0 * ball, side, over,
        foot, board_side, thickness, drives,
    )  # fmt: skip


def _held(machine: Machine, drives: Drives, balls: Array) -> tuple[Array, float]:
    """Points (n, 3) beyond which the base plate lies, and the least distance from them, m.

    For fixed joints and arms' motors these points are their feet; for guides, all points that their
    carriages and the platform reach.
    """
    if drives.guides.any():
        a, b = reaches(machine)
        reached = (a, b) if drives.upright.any() else (a,)
        points = np.concatenate([drives.ends.reshape(-1, 3), *(p.reshape(-1, 3) for p in reached)])
        return points, 6.0 * float(balls.max())
    arms = zip(drives.arm[drives.arms], balls[drives.arms], strict=True)
    sizes = [motor_radius(arm, ball) for arm, ball in arms]
    return drives.foot, 1.3 * max(sizes, default=0.0)


def machine_parts(
    machine: Machine,
    discs: Discs,
    finish: Finish,
    T_base_platform: Array,
    joints: Array,
    as_built: bool = False,
) -> list[ScenePart]:
    """Parts of the machine at one pose (4, 4) with readings (m,).

    as_built : with motors, rings and cables on the legs that are not in the nominal model.
    """
    ends = machine.ends_at(joints, T_base_platform)
    a, b = ends.rods
    balls = _ball_radii(machine)
    bars = side_bars(machine)
    chains = machine.arms_at(joints)
    parts = _base(discs, balls[:, 0], finish)
    parts += _platform(discs, bars, np.array(ends.b), balls[:, 1], T_base_platform, finish)
    for j in range(machine.n_legs):
        driven = bool(discs.drives.arms[j] or discs.drives.guides[j])
        bare = finish.forearm if driven else finish.steel
        parts += _leg(machine, j, a[j], b[j], finish, bare)
        if as_built:
            parts += _hung_on(machine, j, a[j], b[j], discs, finish)
        parts += _base_end(discs, j, chains[j], balls[:, 0], finish)
    return parts


def _base(discs: Discs, balls: Array, finish: Finish) -> list[ScenePart]:
    """Base plate and the column that it hangs from; or beams in its place for horizontal guides."""
    up = discs.side * Z_AXIS
    parts = beams(discs.drives, balls, finish)
    if not parts:
        parts = [
            ScenePart(Cylinder(discs.base, -up, discs.base_radius, discs.thickness), finish.base)
        ]
    if discs.side < 0 and discs.drives.any:
        radius, length = (size * discs.base_radius for size in HANGING_COLUMN_SIZE)
        parts.append(ScenePart(Cylinder(discs.base - discs.thickness * up, -up, radius, length),
                          finish.base))  # fmt: skip
    return parts


def _base_end(discs: Discs, j: int, chain: Array, balls: Array, finish: Finish) -> list[ScenePart]:
    """Parts that hold leg j's end on the base, the last point of its chain (k, 3)."""
    drives, up, a = discs.drives, discs.side * Z_AXIS, chain[-1]
    if drives.arms[j]:
        return arm_parts(drives, j, chain, balls, discs.base, up, finish)
    if drives.guides[j]:
        return guide_parts(drives, j, a, balls, discs.base, finish)
    return _joint(a, -up, float((a - discs.base) @ up), balls[j], finish)


def _platform(
    discs: Discs,
    bars: tuple[Integers, ...],
    b: Array,
    balls: Array,
    T_base_platform: Array,
    finish: Finish,
) -> list[ScenePart]:
    """Platform's plate with a tool holder, and its joints b (L, 3) or the side bars to them."""
    up = discs.platform_side * T_base_platform[:3, 2]
    centre = apply(T_base_platform, discs.platform)
    radius = discs.platform_radius * (TOOL_FLANGE_RADIUS if bars else 1.0)
    top = centre + discs.thickness * up
    parts = [
        ScenePart(Cylinder(centre, up, radius, discs.thickness), finish.platform),
        ScenePart(
            Cylinder(top, up, 0.28 * discs.platform_radius, 1.5 * discs.thickness), finish.joint
        ),
    ]
    if bars:
        parts += nacelle_parts(bars, b, balls, centre, up, finish)
        return parts + [ScenePart(Ball(p, r), finish.joint) for p, r in zip(b, balls, strict=True)]
    for p, r in zip(b, balls, strict=True):
        parts += _joint(p, up, float((centre - p) @ up), float(r), finish)
    return parts


def _joint(
    centre: Array, direction: Array, height: float, radius: float, finish: Finish
) -> list[ScenePart]:
    """Ball joint, and the post from the ball to its plate."""
    post = Cylinder(centre, direction, 0.6 * radius, height)
    return [ScenePart(Ball(centre, radius), finish.joint), ScenePart(post, finish.joint)]


def _leg(
    machine: Machine, j: int, a: Array, b: Array, finish: Finish, bare: Material
) -> list[ScenePart]:
    """Tubes of a leg, cut off at the leg's end, and the neck between joint and first tube.

    bare : material of all but the first of several tubes.
    """
    length = float(np.linalg.norm(b - a))
    u = (b - a) / length
    tubes = machine.document.legs[j].tubes
    parts: list[ScenePart] = []
    for t, (tube, radius) in enumerate(zip(tubes, machine.radii()[j], strict=True)):
        stop = min(tube.stop, length)
        if stop > tube.start:
            material = finish.paint if t == 0 and len(tubes) > 1 else bare
            shape = Cylinder(a + tube.start * u, u, float(radius), stop - tube.start)
            parts.append(ScenePart(shape, material))
    if tubes and tubes[0].start > 0:
        neck = Cylinder(a, u, 0.8 * float(machine.radii()[j][0]), tubes[0].start)
        parts.append(ScenePart(neck, finish.joint))
    return parts


def _hung_on(
    machine: Machine, j: int, a: Array, b: Array, discs: Discs, finish: Finish
) -> list[ScenePart]:
    """Motor beside the leg's first tube, a ring round the tube, and the motor's cable."""
    tubes, radii = machine.document.legs[j].tubes, machine.radii()[j]
    if not tubes:
        return []
    u = (b - a) / np.linalg.norm(b - a)
    out = a - discs.base
    out = out - (out @ u) * u
    out = out / max(float(np.linalg.norm(out)), 1e-9)
    radius, first = float(radii[0]), tubes[0]
    wide, long = 1.1 * radius, MOTOR_SHARE * (first.stop - first.start)
    foot = a + first.start * u + (radius + 1.2 * wide) * out
    ring = a + (first.start + RING_AT * (first.stop - first.start)) * u
    parts = [
        ScenePart(Cylinder(foot, u, wide, long), finish.joint),
        ScenePart(Cylinder(ring, u, 1.12 * radius, 0.5 * radius), finish.joint),
    ]
    # slack cable from the motor's upper end to the base's rim
    rim = discs.base + discs.base_radius * (foot - discs.base) / np.linalg.norm(foot - discs.base)
    t = np.linspace(0.0, 1.0, CABLE_PIECES + 1)[:, None]
    top = foot + long * u + wide * out
    bow = 4 * t * (1 - t) * (0.4 * long * out)
    cable = (1 - t) * top + t * rim + bow
    return parts + [
        _rod(start, stop, 0.18 * radius, finish.joint) for start, stop in pairwise(cable)
    ]


def _ball_radii(machine: Machine) -> Array:
    """Radii (L, 2), in m, of the joint balls at A and at B, a little wider than the tube between
    them.
    """
    spare = 0.01
    return np.array(
        [[1.2 * r[0], 1.5 * r[-1]] if len(r) else [spare, spare] for r in machine.radii()]
    )


def motor_radius(arm: float, ball: float) -> float:
    """Radius of an arm's motor, m."""
    return max(MOTOR_RADIUS * arm, 2.2 * ball)


def arm_parts(
    drives: Drives, j: int, chain: Array, balls: Array, plate: Array, up: Array, finish: Finish
) -> list[ScenePart]:
    """Arm of leg j with its hub, the motor beside it, and the motor's bracket.

    chain : (k, 3) along the arm, from its motor to the leg's end.
    balls : (L,) radii of the joints.
    plate : (3,) on the base plate's face.
    up : unit vector towards the legs.
    """
    foot, v, ball = drives.foot[j], drives.axis[j], float(balls[j])
    wide = motor_radius(float(np.linalg.norm(chain[-1] - foot)), ball)
    # length by the distance to the nearest other motor; arms that share one have the same foot
    apart = np.linalg.norm(np.delete(drives.foot, j, axis=0) - foot, axis=1)
    apart = apart[apart > 1e-2 * apart.max(initial=0.0)]
    length = min(2.4 * wide, 0.6 * float(apart.min(initial=np.inf)))
    # on the side away from the other arms, if the sides differ
    off = foot - drives.foot[drives.arms].mean(axis=0)
    sense = -v if off @ v < -0.1 * np.linalg.norm(off) else v
    first = foot + 1.1 * ball * sense
    post = float((foot - plate) @ up)
    middle = first + 0.5 * length * sense
    return [
        *(
            ScenePart(_web(start, stop, v, ball), finish.platform)
            for start, stop in pairwise(chain)
        ),
        ScenePart(Cylinder(foot - 1.1 * ball * v, v, 1.7 * ball, 2.2 * ball), finish.steel),
        ScenePart(Cylinder(first, sense, wide, length), finish.joint),
        ScenePart(Cylinder(middle, -up, 0.6 * wide, max(post, 1e-4)), finish.joint),
        ScenePart(Ball(chain[-1], ball), finish.joint),
    ]


def _web(start: Array, stop: Array, v: Array, ball: float) -> Box:
    """Straight piece of an arm, flat along its motor's axis v."""
    length = float(np.linalg.norm(stop - start))
    e = (stop - start) / length
    across = v - float(v @ e) * e
    if np.linalg.norm(across) < 1e-6:
        across = cross(e, np.eye(3)[np.abs(e).argmin()])
    across = across / float(np.linalg.norm(across))
    half = np.array([length / 2, 0.7 * ball, 1.1 * ball])
    return Box((start + stop) / 2, np.stack([e, across, np.cross(e, across)]), half)


def guide_parts(
    drives: Drives, j: int, a: Array, balls: Array, plate: Array, finish: Finish
) -> list[ScenePart]:
    """Guide of leg j and the carriage with the leg's end ``a`` (3,).

    The other arguments are those of :func:`arm_parts`. A straight upright guide reaches to the base
    plate; a bent guide consists of straight pieces.
    """
    foot, away, ball = drives.foot[j], drives.away[j], float(balls[j])
    along, across, deep = (ball * size for size in CARRIAGE_HALF_SIZE)
    width, spare = RAIL_HALF_WIDTH * ball, 1.2 * along
    back = ball + 2 * deep + width
    attempt = drives.ways[j]
    # rails: one along a straight guide, to the base plate if it is upright; else one for each piece
    rails: list[Box] = []
    if len(attempt) == 2:
        v = drives.axis[j]
        low, high = (float((end - foot) @ v) for end in attempt)
        low, high = min(low, high) - spare, max(low, high) + spare
        if drives.upright[j]:
            base = float(plate[2] - foot[2]) / v[2]
            low, high = min(low, base), max(high, base)
        rot = np.stack([v, np.cross(away, v), away])
        centre = foot + (low + high) / 2 * v + back * away
        rails.append(Box(centre, rot, np.array([(high - low) / 2, width, width])))
    else:
        for start, stop in pairwise(attempt):
            rot = _turned_along(stop - start, away)
            half = (float(np.linalg.norm(stop - start)) + width) / 2
            rails.append(
                Box((start + stop) / 2 + back * rot[2], rot, np.array([half, width, width]))
            )
        middles = (attempt[1:] + attempt[:-1]) / 2
        nearest = int(np.argmin(np.linalg.norm(middles - a, axis=1)))
        rot = _turned_along(attempt[nearest + 1] - attempt[nearest], away)
    # carriage, square to the rail at the leg's end
    block = Box(a + (ball + deep) * rot[2], rot, np.array([along, across, deep]))
    return [
        *(ScenePart(rail, finish.platform) for rail in rails),
        ScenePart(block, finish.joint),
        ScenePart(Cylinder(a, rot[2], 0.6 * ball, ball), finish.joint),
        ScenePart(Ball(a, ball), finish.joint),
    ]


def _turned_along(piece: Array, away: Array) -> Array:
    """Axes as rows (3, 3): along a piece of a guide, across it, and the normal nearest to
    ``away``.
    """
    v = piece / np.linalg.norm(piece)
    back = away - (away @ v) * v
    back = back / np.linalg.norm(back)
    return np.stack([v, np.cross(back, v), back])


def beams(drives: Drives, balls: Array, finish: Finish) -> list[ScenePart]:
    """Two beams across parallel horizontal guides, and one that joins them; none for
    other guides.
    """
    rows = np.flatnonzero(drives.guides & ~drives.upright)
    if rows.size < 2 or np.abs(drives.axis[rows] @ drives.axis[rows[0]]).min() < 0.99:
        return []
    u, away = drives.axis[rows[0]], drives.away[rows].mean(axis=0)
    away = away - (away @ u) * u
    away = away / np.linalg.norm(away)
    side, ball = np.cross(u, away), float(balls[rows].max())
    # behind the guides: beyond the depth of carriage and rail
    clear = ball * (1 + 2 * CARRIAGE_HALF_SIZE[2] + 2 * RAIL_HALF_WIDTH)
    points = drives.ends[rows].reshape(-1, 3)
    t, s, h = points @ u, points @ side, (points @ away).max() + clear
    width = 2 * RAIL_HALF_WIDTH * ball
    half = np.array([np.ptp(s) / 2 + 2 * width, width, width])
    middle = (s.min() + s.max()) / 2 * side + (h + width) * away
    rot, ends = np.stack([side, u, away]), (t.min() + width, t.max() - width)
    spine = np.array([1.5 * width, (ends[1] - ends[0]) / 2, width])
    parts = [Box(middle + end * u, rot, half) for end in ends]
    parts.append(Box(middle + sum(ends) / 2 * u + 1e-3 * away, rot, spine))
    return [ScenePart(part, finish.base) for part in parts]


def nacelle_parts(
    bars: tuple[Integers, ...], b: Array, balls: Array, centre: Array, up: Array, finish: Finish
) -> list[ScenePart]:
    """Side bars between the joints of their legs, each on a pivot, and the bar that joins them.

    bars : legs of each bar.
    b : (L, 3) legs' ends.
    centre : (3,) of the tool's flange, m.
    up : unit vector away from the joints.
    """
    ball = float(balls.max())
    parts: list[ScenePart] = []
    pivots: list[Array] = []
    drop = 1.6 * ball
    for legs in bars:
        ends = b[legs]
        apart = np.linalg.norm(ends[:, None] - ends, axis=-1)
        first, last = np.unravel_index(int(np.argmax(apart)), apart.shape)
        parts.append(_rod(ends[first], ends[last], 0.7 * ball, finish.steel))
        pivots.append(ends.mean(axis=0))
        pin = Cylinder(pivots[-1] - 0.9 * ball * up, up, ball, 0.9 * ball + drop)
        parts.append(ScenePart(pin, finish.joint))
    joined = np.array(pivots) + drop * up
    if len(joined) > 1:
        parts += [_rod(one, joined[0], 0.9 * ball, finish.platform) for one in joined[1:]]
    hub = joined.mean(axis=0)
    height = float((centre - hub) @ up)
    parts.append(ScenePart(Cylinder(hub, up, 0.8 * ball, max(height, 1e-4)), finish.joint))
    return parts


def _rod(start: Array, stop: Array, radius: float, material: Material) -> ScenePart:
    length = float(np.linalg.norm(stop - start))
    return ScenePart(Cylinder(start, (stop - start) / length, radius, length), material)


def room_of(
    discs: Discs,
    reach: float,
    noise: SmoothNoise,
    rng: np.random.Generator,
    lit_from: float | None = None,
    light: Light = "usual",
) -> Scene:
    """Room around a machine; cameras stand within ``reach`` (m) of the base plate's centre.

    lit_from : azimuth, in rad, about which the key lamp stands, if a plate would shade a board.
    """
    size = max(discs.base_radius, discs.platform_radius)
    reach = max(reach, 2.5 * size)
    middle = discs.base - discs.side * discs.thickness * Z_AXIS
    if discs.side < 0:  # a machine that hangs from its base has no table under it
        middle = middle - 4.0 * size * Z_AXIS
    parts = _table(middle, size, noise, rng)
    floor = middle[2] - 2.2 * size
    parts += _walls(middle, floor, reach, noise, rng)
    for azimuth in 2 * np.pi * (np.arange(11) + rng.uniform(-0.4, 0.4, 11)) / 11:
        parts.append(_furniture(middle, floor, size, reach, azimuth, noise, rng))
    usual = _lamps(middle, size, reach, rng, lit_from, discs.drives.any)
    wide, strong, around = KINDS_OF_LIGHT[light]
    lamps = tuple(
        replace(lamp, radius=wide * lamp.radius, power=strong * lamp.power) for lamp in usual
    )
    bulbs = [
        ScenePart(Ball(lamp.place, lamp.radius), Material(0.0, emission=3.0), False)
        for lamp in lamps
    ]
    sky, ground = SKY_AND_GROUND_LIGHT[discs.drives.any]
    return Scene((*parts, *bulbs), Lighting(lamps, around * sky, around * ground))


def _table(
    middle: Array, size: float, noise: SmoothNoise, rng: np.random.Generator
) -> list[ScenePart]:
    half = np.array([1.75, 1.6, 0.05]) * size
    turn = rotation(rng.uniform(-np.pi, np.pi) * Z_AXIS)
    pattern = WavyStripes(noise, 0.42 * size, 0.42)
    top = Box(middle - half[2] * Z_AXIS, turn, half)
    leg = Box(middle - size * Z_AXIS, turn, np.array([0.5, 0.5, 0.9]) * size)
    return [
        ScenePart(top, Material(0.30, pattern, gloss=0.04, sharpness=8.0)),
        ScenePart(leg, Material(0.05)),
    ]


def _walls(
    middle: Array, floor: float, reach: float, noise: SmoothNoise, rng: np.random.Generator
) -> list[ScenePart]:
    """Floor, ceiling and four walls, all with patterns."""
    patterns = [
        Slats(0.17 * reach, np.inf, 0.35),
        Clouds(noise, 0.045 * reach, 0.30),
        WavyStripes(noise, 0.5 * reach, 0.25),
        Clouds(noise, 0.012 * reach, 0.16),
    ]
    turn = rng.uniform(0, 2 * np.pi)
    parts = [
        ScenePart(
            Wall(np.array([*middle[:2], floor]), Z_AXIS),
            Material(0.32, Slats(0.12 * reach, 0.06 * reach, 0.3)),
            False,
        ),
        ScenePart(
            Wall(np.array([*middle[:2], floor + 4.5 * reach]), -Z_AXIS),
            Material(0.6, Slats(0.6 * reach, 0.6 * reach, 0.7)),
            False,
        ),
    ]
    for k, pattern in enumerate(np.array(patterns, dtype=object)[rng.permutation(4)]):
        angle = turn + np.pi / 2 * k
        inward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        wall = Wall(middle - inward * reach * rng.uniform(2.6, 3.4), inward)
        parts.append(ScenePart(wall, Material(rng.uniform(0.12, 0.3), pattern), False))
    return parts


def _furniture(
    middle: Array,
    floor: float,
    size: float,
    reach: float,
    azimuth: float,
    noise: SmoothNoise,
    rng: np.random.Generator,
) -> ScenePart:
    """Box or post behind the ring of cameras, in view of the opposite camera."""
    distance = reach * rng.uniform(1.45, 2.3)
    place = middle + distance * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    height = middle[2] - floor + size * rng.uniform(0.1, 2.6)
    place[2] = floor
    material = [
        Material(0.45, Checks(0.3 * size, 0.18)),
        Material(0.04),
        Material(0.35, Clouds(noise, 0.05 * size, 0.45)),
        Material(0.12, Checks(0.22 * size, 0.3)),
        Material(0.6, Clouds(noise, 0.2 * size, 0.1)),
    ][rng.integers(5)]
    if rng.random() < 0.25:
        return ScenePart(
            Cylinder(place, Z_AXIS, size * rng.uniform(0.06, 0.2), height), material, False
        )
    lean = rotation(np.array([*rng.normal(0, 0.03, 2), rng.uniform(-np.pi, np.pi)]))
    half = np.array([*rng.uniform(0.1, 0.45, 2) * size, height / 2])
    return ScenePart(Box(place + lean.T @ (half[2] * Z_AXIS), lean, half), material, False)


def _lamps(
    middle: Array,
    size: float,
    reach: float,
    rng: np.random.Generator,
    lit_from: float | None,
    soft: bool,
) -> tuple[Lamp, ...]:
    """Key lamp with shadows, a weaker lamp from the side, and one from above and behind."""
    azimuth = rng.uniform(0, 2 * np.pi)
    if lit_from is not None:
        azimuth = lit_from + BOARD_LAMP_ANGLE * (azimuth / np.pi - 1)
    share = SOFT_LAMP_SHARE if soft else 1.0
    lamps: list[Lamp] = []
    for turn, elevation, distance, power in (
        (0.0, rng.uniform(40, 60), 1.8, 1.25),
        (rng.uniform(100, 150), rng.uniform(20, 35), 1.9, 0.55),
        (rng.uniform(200, 260), rng.uniform(55, 75), 2.2, 0.45),
    ):
        a, e = azimuth + np.deg2rad(turn), np.deg2rad(elevation)
        direction = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        lamps.append(
            Lamp(
                middle + (distance * reach) * direction + size * Z_AXIS,
                0.16 * size,
                share * power,
                distance * reach,
                shadows=not lamps,
            )
        )
    return tuple(lamps)
