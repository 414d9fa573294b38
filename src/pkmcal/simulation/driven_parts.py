"""Arms with their motors, guides with their carriages and side bars, as parts of the scene.

Sizes follow the legs' joints, so that a drawing needs no more than its kinematics and its tubes.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import cross
from pkmcal.simulation.casting import Part
from pkmcal.simulation.drives import Drives
from pkmcal.simulation.shapes import Ball, Box, Cylinder
from pkmcal.simulation.surfaces import Finish, Material

MOTOR = 0.17
"""Radius of a motor, in its arm's length; three radii of the joint at least."""
CARRIAGE = (2.4, 1.4, 0.6)
"""Half a carriage's size along, across and from its guide, in radii of the joint on it."""
RAIL = 1.2
"""Half a guide's width, in radii of the joint on its carriage."""


def motor_radius(arm: float, ball: float) -> float:
    """Of an arm's motor, m."""
    return max(MOTOR * arm, 2.2 * ball)


def arm_parts(
    drives: Drives, j: int, chain: Array, balls: Array, plate: Array, up: Array, finish: Finish
) -> list[Part]:
    """The arm of leg j, the hub, the motor beside it, and its bracket.

    chain : (k, 3) along the arm, from its motor to the leg's end. balls : (L,) radii of the joints.
    plate : (3,) on the base plate's face; up : unit, to the legs.
    """
    foot, v, ball = drives.foot[j], drives.axis[j], float(balls[j])
    wide = motor_radius(float(np.linalg.norm(chain[-1] - foot)), ball)
    length = min(2.4 * wide, 0.6 * _room(drives.foot, j))
    way = _motor_side(drives, j) * v
    first = foot + 1.1 * ball * way
    post = float((foot - plate) @ up)
    middle = first + 0.5 * length * way
    return [
        *(Part(_web(start, stop, v, ball), finish.platform) for start, stop in pairwise(chain)),
        Part(Cylinder(foot - 1.1 * ball * v, v, 1.7 * ball, 2.2 * ball), finish.steel),
        Part(Cylinder(first, way, wide, length), finish.joint),
        Part(Cylinder(middle, -up, 0.6 * wide, max(post, 1e-4)), finish.joint),
        Part(Ball(chain[-1], ball), finish.joint),
    ]


def _web(start: Array, stop: Array, v: Array, ball: float) -> Box:
    """A straight piece of an arm, flat along its motor's axis v."""
    length = float(np.linalg.norm(stop - start))
    e = (stop - start) / length
    across = v - float(v @ e) * e
    if np.linalg.norm(across) < 1e-6:
        across = cross(e, np.eye(3)[np.abs(e).argmin()])
    across = across / float(np.linalg.norm(across))
    half = np.array([length / 2, 0.7 * ball, 1.1 * ball])
    return Box((start + stop) / 2, np.stack([e, across, np.cross(e, across)]), half)


def _room(feet: Array, j: int) -> float:
    """Distance to the nearest other motor, m."""
    apart = np.linalg.norm(np.delete(feet, j, axis=0) - feet[j], axis=1)
    # arms on one motor stand in one place
    apart = apart[apart > 1e-2 * apart.max(initial=0.0)]
    return float(apart.min(initial=np.inf))


def _motor_side(drives: Drives, j: int) -> float:
    """+1 or -1: along the axis or against it, away from the other arms where that says much."""
    off = drives.foot[j] - drives.foot[drives.arms].mean(axis=0)
    outward = float(off @ drives.axis[j])
    return -1.0 if outward < -0.1 * np.linalg.norm(off) else 1.0


def guide_parts(
    drives: Drives, j: int, a: Array, balls: Array, plate: Array, finish: Finish
) -> list[Part]:
    """The guide of leg j and the carriage with the leg's end ``a`` (3,); as :func:`arm_parts`.

    A straight guide that stands reaches down, or up, to the base plate; a bent one is drawn in
    straight pieces.
    """
    foot, away, ball = drives.foot[j], drives.away[j], float(balls[j])
    along, across, deep = (ball * size for size in CARRIAGE)
    width, spare, back = RAIL * ball, 1.2 * along, ball + 2 * deep + RAIL * ball
    way = drives.ways[j]
    rails: list[Box] = []
    if len(way) == 2:
        v = drives.axis[j]
        low, high = (float((end - foot) @ v) for end in way)
        low, high = min(low, high) - spare, max(low, high) + spare
        if drives.upright[j]:
            base = float(plate[2] - foot[2]) / v[2]
            low, high = min(low, base), max(high, base)
        rot = np.stack([v, np.cross(away, v), away])
        centre = foot + (low + high) / 2 * v + back * away
        rails.append(Box(centre, rot, np.array([(high - low) / 2, width, width])))
    else:
        for start, stop in pairwise(way):
            rot = _turned_along(stop - start, away)
            half = (float(np.linalg.norm(stop - start)) + width) / 2
            rails.append(
                Box((start + stop) / 2 + back * rot[2], rot, np.array([half, width, width]))
            )
        middles = (way[1:] + way[:-1]) / 2
        nearest = int(np.argmin(np.linalg.norm(middles - a, axis=1)))
        rot = _turned_along(way[nearest + 1] - way[nearest], away)
    block = Box(a + (ball + deep) * rot[2], rot, np.array([along, across, deep]))
    return [
        *(Part(rail, finish.platform) for rail in rails),
        Part(block, finish.joint),
        Part(Cylinder(a, rot[2], 0.6 * ball, ball), finish.joint),
        Part(Ball(a, ball), finish.joint),
    ]


def _turned_along(piece: Array, away: Array) -> Array:
    """Rows (3, 3) along a piece of a guide, across it, and from it, nearest to ``away``."""
    v = piece / np.linalg.norm(piece)
    back = away - (away @ v) * v
    back = back / np.linalg.norm(back)
    return np.stack([v, np.cross(back, v), back])


def beams(drives: Drives, balls: Array, finish: Finish) -> list[Part]:
    """Two beams across guides that lie side by side, and one that joins them; none where the
    guides are not parallel.
    """
    rows = np.flatnonzero(drives.guides & ~drives.upright)
    if rows.size < 2 or np.abs(drives.axis[rows] @ drives.axis[rows[0]]).min() < 0.99:
        return []
    u, away = drives.axis[rows[0]], drives.away[rows].mean(axis=0)
    away = away - (away @ u) * u
    away = away / np.linalg.norm(away)
    side, ball = np.cross(u, away), float(balls[rows].max())
    # on the far side of the guides, whose own depth is that of carriage and rail
    clear = ball * (1 + 2 * CARRIAGE[2] + 2 * RAIL)
    points = drives.ends[rows].reshape(-1, 3)
    t, s, h = points @ u, points @ side, (points @ away).max() + clear
    width = 2 * RAIL * ball
    half = np.array([np.ptp(s) / 2 + 2 * width, width, width])
    middle = (s.min() + s.max()) / 2 * side + (h + width) * away
    rot, ends = np.stack([side, u, away]), (t.min() + width, t.max() - width)
    spine = np.array([1.5 * width, (ends[1] - ends[0]) / 2, width])
    parts = [Box(middle + end * u, rot, half) for end in ends]
    parts.append(Box(middle + sum(ends) / 2 * u + 1e-3 * away, rot, spine))
    return [Part(part, finish.base) for part in parts]


def nacelle_parts(
    bars: tuple[Integers, ...], b: Array, balls: Array, centre: Array, up: Array, finish: Finish
) -> list[Part]:
    """Side bars between the joints of their legs, each on a pivot, and the bar that joins them.

    bars : legs of each. b : (L, 3) legs' ends. centre : (3,) of the tool's flange, m; up : unit,
    away from the joints.
    """
    ball = float(balls.max())
    parts: list[Part] = []
    pivots: list[Array] = []
    drop = 1.6 * ball
    for legs in bars:
        ends = b[legs]
        apart = np.linalg.norm(ends[:, None] - ends, axis=-1)
        first, last = np.unravel_index(int(np.argmax(apart)), apart.shape)
        parts.append(_rod(ends[first], ends[last], 0.7 * ball, finish.steel))
        pivots.append(ends.mean(axis=0))
        pin = Cylinder(pivots[-1] - 0.9 * ball * up, up, ball, 0.9 * ball + drop)
        parts.append(Part(pin, finish.joint))
    joined = np.array(pivots) + drop * up
    if len(joined) > 1:
        parts += [_rod(one, joined[0], 0.9 * ball, finish.platform) for one in joined[1:]]
    hub = joined.mean(axis=0)
    height = float((centre - hub) @ up)
    parts.append(Part(Cylinder(hub, up, 0.8 * ball, max(height, 1e-4)), finish.joint))
    return parts


def _rod(start: Array, stop: Array, radius: float, material: Material) -> Part:
    length = float(np.linalg.norm(stop - start))
    return Part(Cylinder(start, (stop - start) / length, radius, length), material)
