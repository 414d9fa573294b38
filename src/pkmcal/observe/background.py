"""What stands around the machine, as photographs taken by hand from several places show it.

A machine of equal parts looks much the same from several sides; the room about it does not. Points
of texture that two photographs share lie on epipolar lines of each other where both were taken from
where they are believed to be, and anywhere elsewhere. So each place that a photograph could show is
asked how well the room agrees with photographs that are placed.

Points on the machine itself are left out: they move with it, and a machine alike from two sides
agrees with itself from both. Points are Lowe's scale-invariant features (International Journal of
Computer Vision 60, 2004) with the roots of their descriptors (Arandjelovic and Zisserman, CVPR
2012).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, dot, inverse, pose, rotation
from pkmcal.observe.image_localization import PoseHypotheses
from pkmcal.observe.pose_candidates import same_pose
from pkmcal.observe.predict import LegsInCamera

LARGEST_TEXTURE_SIDE = 1600
"""Pixels of a photograph's longer side on which texture is looked for: finer is mostly noise."""
MOST_TEXTURE_POINTS = 3000
"""Points of texture of a photograph, those of most contrast."""
PARTNER_DISTANCE_RATIO = 0.8
"""Distance to the likeliest partner, in that to the next, above which there is none (Lowe, 7.1)."""
TEXTURE_POINTS_APART = 8.0
"""Pixels within which points are one: a corner has several descriptions, and tells one thing."""
FEWEST_POINT_PAIRS = 16
"""Pairs of points without which two photographs tell nothing of each other: of fewer nobody knows
what chance makes of them."""
MACHINE_OUTLINE_FACTOR = 1.5
"""Size, in that of its joints' outline, of what may belong to the machine in a photograph: plates,
motors and cables reach beyond the joints, and a drawing does not tell how far."""
EPIPOLAR_SPREADS = np.radians([0.1, 0.25, 0.6])
"""Standard deviations (rad) of points from their epipolar planes, of which the likeliest is taken:
from what a feature is off, to what a drawing that is wrong by millimetres turns a camera."""
RIGHT_PAIR_SHARES = np.linspace(0.02, 0.98, 49)
"""Shares of right pairs, of which the likeliest is taken."""
PARTNER_EXCHANGES, EPIPOLAR_WINDOW = 20, np.radians(2.0)
"""How often partners are exchanged, to see how many chance puts within this angle of the planes."""

LEAST_LANDMARK_PARALLAX = np.radians(3.0)
"""Angle between two rays below which their crossing is no place: five of the widest spreads."""
LANDMARK_TRIPLES_TRIED, LEAST_COSINE_AHEAD = 3000, 0.2
"""Triples of landmarks that are tried for a photograph's place: one of ten right ones is enough for
three of them to be found. Rays further off the camera's axis than its cosine are left out."""

CANDIDATES_TESTED_BY_BACKGROUND = 4
"""Places of a photograph about which the room is asked."""
TURN_GRID = np.radians(
    np.stack(np.meshgrid(*[np.arange(-6.0, 7.0, 2.0)] * 2), axis=-1).reshape(-1, 2)
)
"""Turns (49, 2) of the machine that are tried there, rad: beyond, the legs are others'."""


class Texture(NamedTuple):
    """Points of one photograph. ray : (n, 3) unit, camera frame. pixel : (n, 2).
    descriptor : (n, 128).
    """

    ray: Array
    pixel: Array
    descriptor: Array


def texture_of(image: Integers, camera: Camera) -> Texture:
    """Points of texture of a photograph, grey levels (height, width)."""
    import cv2

    scale = min(LARGEST_TEXTURE_SIDE / max(image.shape), 1.0)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, value = cv2.SIFT.create(MOST_TEXTURE_POINTS).detectAndCompute(small, None)
    if not points:
        return Texture(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32))
    pixel = (np.array([p.pt for p in points]) + 0.5) / scale - 0.5
    share = value / np.maximum(value.sum(axis=1, keepdims=True), 1e-9)
    ray = camera.ray(pixel)
    ok = np.isfinite(ray).all(axis=1)
    return Texture(ray[ok], pixel[ok], np.sqrt(share)[ok].astype(np.float32))


def partners(one: Texture, other: Texture) -> Integers:
    """Pairs (n, 2) of points that are each other's likeliest partner, by far; no point twice."""
    import cv2

    if min(len(one.ray), len(other.ray)) < 2:
        return np.zeros((0, 2), dtype=int)
    match = cv2.BFMatcher(cv2.NORM_L2)
    there = match.knnMatch(one.descriptor, other.descriptor, k=2)
    back = {m.queryIdx: m.trainIdx for m in match.match(other.descriptor, one.descriptor)}
    mutual = [
        (best.distance / max(second.distance, 1e-9), best.queryIdx, best.trainIdx)
        for best, second in there
        if back[best.trainIdx] == best.queryIdx
    ]
    retained_rows: list[tuple[int, int]] = []
    taken = np.zeros((0, 2, 2))
    for worth, j, k in sorted(mutual):
        at = np.stack([one.pixel[j], other.pixel[k]])
        away = np.abs(taken - at).max(axis=-1)
        if worth < PARTNER_DISTANCE_RATIO and (away >= TEXTURE_POINTS_APART).all():
            retained_rows.append((j, k))
            taken = np.concatenate([taken, at[None]])
    return np.array(retained_rows, dtype=int).reshape(-1, 2)


def beside_machine(pixel: Array, camera: Camera, legs: LegsInCamera) -> Booleans:
    """Which pixels (n, 2) of a photograph lie beside the machine, legs : (L, 3) of it alone."""
    import cv2

    joints = camera.project(np.concatenate([legs.a, legs.b]))
    joints = joints[np.isfinite(joints).all(axis=1)]
    if len(joints) < 3:
        return np.ones(len(pixel), dtype=bool)
    middle = (joints.min(axis=0) + joints.max(axis=0)) / 2
    outline = (middle + MACHINE_OUTLINE_FACTOR * (joints - middle)).astype(np.float32)
    corner = cv2.convexHull(outline).reshape(-1, 2).astype(float)
    # outside of a convex outline is what lies outside of one of its sides
    side, away = np.roll(corner, -1, axis=0) - corner, pixel[:, None] - corner
    inward = side[:, 0] * away[..., 1] - side[:, 1] * away[..., 0]
    turn = side[:, 0] * np.roll(side[:, 1], -1) - side[:, 1] * np.roll(side[:, 0], -1)
    return (np.sign(turn.sum()) * inward < 0).any(axis=1)


def agreement(one: Array, other: Array, T_other_one: Array) -> float:
    """Log likelihood that pairs of unit rays (n, 3) see the same points, against chance.

    T_other_one : (4, 4) the one camera's frame in the other's. A pair is right, with a share that
    all have in common, or lies where exchanged partners do. The share and the spread of the right
    ones are chosen to fit, and paid for as two numbers are (Schwarz, Annals of Statistics 6, 1978).
    """
    if len(one) < FEWEST_POINT_PAIRS:
        return 0.0
    ray = one @ T_other_one[:3, :3].T
    normal = cross(np.broadcast_to(T_other_one[:3, 3], ray.shape), ray)
    normal /= np.maximum(np.sqrt(dot(normal, normal)), 1e-12)[:, None]
    rng = np.random.default_rng(0)
    exchanged = other[np.stack([rng.permutation(len(other)) for _ in range(PARTNER_EXCHANGES)])]
    off, by_chance = (np.arcsin(np.clip(dot(normal, v), -1, 1)) for v in (other, exchanged))
    chance = max(float(np.mean(np.abs(by_chance) < EPIPOLAR_WINDOW)), 1 / by_chance.size) / (
        2 * EPIPOLAR_WINDOW
    )
    spread = EPIPOLAR_SPREADS[:, None]
    density = np.exp(-0.5 * (off / spread) ** 2) / (np.sqrt(2 * np.pi) * spread)
    gain = np.log1p(RIGHT_PAIR_SHARES[:, None, None] * (density / chance - 1)).sum(axis=-1)
    return max(float(gain.max()) - np.log(len(one)), 0.0)


class Neighbour(NamedTuple):
    """A photograph that is placed. T_camera_base : (4, 4). legs : (L, 3) as it has them."""

    camera: Camera
    T_camera_base: Array
    legs: LegsInCamera


class Landmarks(NamedTuple):
    """Points of the room that two placed photographs show. point : (n, 3) m, base frame. number :
    (n,) of the photograph's texture that shows it.
    """

    point: Array
    number: Integers


class Surroundings:
    """What a session's photographs share of what stands around the machine.

    Texture and its partners are looked for once, when they are asked for. photograph : by its
    number, grey levels and camera.
    """

    def __init__(self, photograph: Callable[[int], tuple[Integers, Camera]]) -> None:
        self.texture: Callable[[int], Texture] = cache(lambda k: texture_of(*photograph(k)))
        self._pairs: Callable[[int, int], Integers] = cache(
            lambda j, k: partners(self.texture(j), self.texture(k))
        )

    def shared(self, one: int, other: int) -> tuple[Integers, Integers]:
        """Numbers (n,) of the texture that two photographs share, in each."""
        first, second = sorted((one, other))
        pairs = self._pairs(first, second).T
        return (pairs[0], pairs[1]) if first == one else (pairs[1], pairs[0])

    def landmarks(self, placed: Mapping[int, Neighbour]) -> dict[int, Landmarks]:
        """Points that two placed photographs see at one place, by the photograph."""
        results: dict[int, list[tuple[Array, Integers]]] = {k: [] for k in placed}
        for one, other in combinations(placed, 2):
            j, k = self.shared(one, other)
            if not len(j):
                continue
            beside = self._beside(one, j, placed[one]) & self._beside(other, k, placed[other])
            j, k = j[beside], k[beside]
            out = [inverse(placed[n].T_camera_base) for n in (one, other)]
            eyes = [T[:3, 3] for T in out]
            rays = [
                self.texture(n).ray[m] @ T[:3, :3].T
                for n, m, T in zip((one, other), (j, k), out, strict=True)
            ]
            point, ok = _crossing(eyes[0], rays[0], eyes[1], rays[1])
            results[one].append((point[ok], j[ok]))
            results[other].append((point[ok], k[ok]))
        empty = np.zeros((0, 3)), np.zeros(0, dtype=int)
        return {
            k: Landmarks(*(np.concatenate(part) for part in zip(*parts, empty, strict=True)))
            for k, parts in results.items()
        }

    def _beside(self, k: int, numbers: Integers, neighbour: Neighbour) -> Booleans:
        return beside_machine(self.texture(k).pixel[numbers], neighbour.camera, neighbour.legs)

    def place(self, one: int, landmarks: Mapping[int, Landmarks]) -> Array:
        """The places T_camera_base (0 or 1, 4, 4) that landmarks give a photograph."""
        import cv2

        rays: list[Array] = [np.zeros((0, 3))]
        points: list[Array] = [np.zeros((0, 3))]
        for other, reference_values in landmarks.items():
            j, k = self.shared(one, other)
            at, where = np.nonzero(k[:, None] == reference_values.number)
            rays.append(self.texture(one).ray[j[at]])
            points.append(reference_values.point[where])
        ray, point = np.concatenate(rays), np.concatenate(points)
        ahead = ray[:, 2] > LEAST_COSINE_AHEAD
        ray, point = ray[ahead], point[ahead]
        if len(ray) < FEWEST_POINT_PAIRS:
            return np.zeros((0, 4, 4))
        plane = np.ascontiguousarray(ray[:, :2] / ray[:, 2:])
        off = float(np.tan(EPIPOLAR_SPREADS[-1]))
        ok, turn, shift, inside = cv2.solvePnPRansac(
            point, plane, np.eye(3), np.zeros(0),
            iterationsCount=LANDMARK_TRIPLES_TRIED, reprojectionError=off, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        which = np.asarray(inside, dtype=int).ravel() if ok else np.zeros(0, dtype=int)
        if len(which) < FEWEST_POINT_PAIRS:
            return np.zeros((0, 4, 4))
        turn, shift = cv2.solvePnPRefineLM(
            point[which], plane[which], np.eye(3), np.zeros(0), turn, shift
        )
        rot = rotation(np.asarray(turn, dtype=float).ravel())
        return pose(rot, np.asarray(shift, dtype=float).ravel())[None]

    def about(
        self,
        hypotheses: PoseHypotheses,
        one: int,
        camera: Camera,
        legs: LegsInCamera,
        placed: Mapping[int, Neighbour],
    ) -> Array:
        """Of the likeliest places of a photograph, those near by (n, 4, 4) that agree with the room
        better: what the drawing has wrong, or clutter, turns a place that legs alone tell.

        legs : (H, L, 3) as each of the places has them.
        """
        out = [np.zeros((0, 4, 4))]
        for h, T in enumerate(hypotheses.T_camera_base[:CANDIDATES_TESTED_BY_BACKGROUND]):
            to_base = inverse(T)
            middle = to_base[:3, :3] @ np.concatenate([legs.a[h], legs.b[h]]).mean(axis=0)
            middle = middle + to_base[:3, 3]
            # about the camera's own axes x and y, through the machine's middle
            turn = rotation(TURN_GRID @ to_base[:3, :2].T)
            near = T @ pose(turn, middle - turn @ middle)
            gain = self._gain(near, one, camera, [legs[h]] * len(near), placed)
            best = int(np.argmax(gain))
            if gain[best] > 0 and best != len(near) // 2:
                out.append(near[best : best + 1])
        return np.concatenate(out)

    def weighed(
        self,
        hypotheses: PoseHypotheses,
        one: int,
        camera: Camera,
        legs: LegsInCamera,
        placed: Mapping[int, Neighbour],
    ) -> PoseHypotheses:
        """The places of a photograph, weighed with what it shares with placed ones as well.

        hypotheses : its evidence a log likelihood, unit 1. camera : the photograph's. legs : (H, L,
        3) as each of the places has them. The room tells from which side the photograph was taken;
        from where exactly, the legs.
        """
        if not placed:
            return hypotheses
        T = hypotheses.T_camera_base
        gain = self._gain(T, one, camera, [legs[h] for h in range(len(T))], placed)
        same = same_pose(T[:, None], T)
        worth = hypotheses.log_likelihood_ratio + np.where(same, gain, -np.inf).max(axis=1)
        order = np.argsort(-worth, kind="stable")
        order = order[~same[order, order[0]] | (order == order[0])]
        return PoseHypotheses(T[order], worth[order], hypotheses.unit)

    def _gain(
        self,
        T_camera_base: Array,
        one: int,
        camera: Camera,
        legs: Sequence[LegsInCamera],
        placed: Mapping[int, Neighbour],
    ) -> Array:
        """Log likelihood (H,) of places of a photograph by the room, against chance. Any of those
        that are placed may be the one that shows the same part of it.
        """
        texture = self.texture(one)
        gain = np.zeros((len(T_camera_base), len(placed)))
        for n, (other, in_view) in enumerate(placed.items()):
            j, k = self.shared(one, other)
            beside = self._beside(other, k, in_view)
            for h, T in enumerate(T_camera_base):
                ok = beside & beside_machine(texture.pixel[j], camera, legs[h])
                rays = texture.ray[j[ok]], self.texture(other).ray[k[ok]]
                gain[h, n] = agreement(*rays, in_view.T_camera_base @ inverse(T))
        # any turn of a place may be what agrees best, of any neighbour: tries are paid for
        tries = len(placed) * len(TURN_GRID)
        return np.maximum(np.logaddexp.reduce(gain, axis=1) - np.log(tries), 0.0)


def _crossing(eye: Array, ray: Array, eye_b: Array, ray_b: Array) -> tuple[Array, Booleans]:
    """Points (n, 3) halfway between rays (n, 3) where these are nearest, and where that is a place:
    before both eyes (3,), seen so from both, from directions that differ.
    """
    base = eye_b - eye
    cosine = dot(ray, ray_b)
    far = np.maximum(1 - cosine**2, 1e-9)
    away, away_b = ray @ base, ray_b @ base
    depth, depth_b = (away - cosine * away_b) / far, (cosine * away - away_b) / far
    point = (eye + depth[:, None] * ray + eye_b + depth_b[:, None] * ray_b) / 2
    off = np.zeros(len(ray))
    for start, along in ((eye, ray), (eye_b, ray_b)):
        to = point - start
        side = cross(to, along)
        off = np.maximum(off, np.sqrt(dot(side, side)) / np.maximum(np.sqrt(dot(to, to)), 1e-12))
    good = (
        (depth > 0)
        & (depth_b > 0)
        & (off < EPIPOLAR_SPREADS[-1])
        & (cosine < np.cos(LEAST_LANDMARK_PARALLAX))
    )
    return point, good
