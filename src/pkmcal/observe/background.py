"""Log-likelihood of camera poses by the background that hand-held images share.

A machine of equal parts looks much the same from several sides; the room about it does not. Points
of texture that two images share are on each other's epipolar lines if both poses are right, and
anywhere otherwise. So each candidate pose of an image has a log-likelihood by the background in
images that are placed.

Points on the machine are omitted: they move with it, and a machine that is symmetric agrees with
itself from several sides. Points are Lowe's scale-invariant features (International Journal of
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
from pkmcal.geometry.rigid import angle_between, cross, dot, inverse, pose, rotation
from pkmcal.observe.image_localization import SAME_PLACE_TURN, PoseHypotheses
from pkmcal.observe.predict import LegsInCamera

LARGEST_TEXTURE_SIDE = 1600
"""Longer side (px) of the image in which texture is detected: finer texture is mostly noise."""
MOST_TEXTURE_POINTS = 3000
"""Most points of texture of an image, those of highest contrast."""
PARTNER_DISTANCE_RATIO = 0.8
"""Ratio of distances to the nearest and the next descriptor above which there is no partner (Lowe,
7.1)."""
TEXTURE_POINTS_APART = 8.0
"""Distance (px) within which points are one: a corner has several descriptors and is one
measurement."""
FEWEST_POINT_PAIRS = 16
"""Least number of pairs of points in two images: with fewer the distribution by chance is unknown.
"""
MACHINE_OUTLINE_FACTOR = 1.5
"""Size of the machine in an image, in that of its joints' outline: plates, motors and cables extend
beyond the joints, by an unknown amount."""
EPIPOLAR_SPREADS = np.radians([0.1, 0.25, 0.6])
"""Standard deviations (rad) of points from their epipolar planes, of which the likeliest is used:
from the error of a feature to the turn of a camera by millimetres of nominal error."""
RIGHT_PAIR_SHARES = np.linspace(0.02, 0.98, 49)
"""Shares of right pairs, of which the likeliest is used."""
PARTNER_EXCHANGES, EPIPOLAR_WINDOW = 20, np.radians(2.0)
"""Number of random exchanges of partners, and angle to the planes within which they are counted,
for the density by chance."""

LEAST_LANDMARK_PARALLAX = np.radians(3.0)
"""Least angle between two rays of a triangulated point: five of the widest spreads."""
LANDMARK_TRIPLES_TRIED, LEAST_COSINE_AHEAD = 3000, 0.2
"""Triples of landmarks that are tried for an image's pose: with one right one in ten, a right
triple is among them. Rays further off the camera's axis than this cosine are omitted."""

CANDIDATES_TESTED_BY_BACKGROUND = 4
"""Candidate poses of an image that are compared by the background."""
TURN_GRID = np.radians(
    np.stack(np.meshgrid(*[np.arange(-6.0, 7.0, 2.0)] * 2), axis=-1).reshape(-1, 2)
)
"""Trial turns (49, 2) of the machine, rad: beyond, predicted legs match others."""


class Texture(NamedTuple):
    """Points of one image. ray : (n, 3) unit, camera frame. pixel : (n, 2).
    descriptor : (n, 128).
    """

    ray: Array
    pixel: Array
    descriptor: Array


def texture_of(image: Integers, camera: Camera) -> Texture:
    """Points of texture of an image, grey levels (height, width)."""
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
    """Pairs (n, 2) of mutual nearest neighbours that pass the ratio test; no point twice."""
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
    """Mask (n,) of pixels (n, 2) of an image beside the machine; legs : (L, 3) of this image."""
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
    """Log-likelihood ratio that pairs of unit rays (n, 3) see the same points, against chance.

    T_other_one : (4, 4) the one camera's frame in the other's. A pair is right, with a probability
    common to all, or distributed as exchanged partners are. The share and the spread of the right
    ones are estimated, at the cost of two parameters (Schwarz, Annals of Statistics 6, 1978).
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
    """A placed image. T_camera_base : (4, 4). legs : (L, 3) in its camera frame."""

    camera: Camera
    T_camera_base: Array
    legs: LegsInCamera


class Landmarks(NamedTuple):
    """Points of the background in two placed images. point : (n, 3) m, base frame. number : (n,)
    index into the image's texture.
    """

    point: Array
    number: Integers


class Surroundings:
    """Background that a session's images share.

    Texture and its partners are computed on first use. photograph : grey levels and camera of an
    image, by its number.
    """

    def __init__(self, photograph: Callable[[int], tuple[Integers, Camera]]) -> None:
        self.texture: Callable[[int], Texture] = cache(lambda k: texture_of(*photograph(k)))
        self._pairs: Callable[[int, int], Integers] = cache(
            lambda j, k: partners(self.texture(j), self.texture(k))
        )

    def shared(self, one: int, other: int) -> tuple[Integers, Integers]:
        """Indices (n,) of the texture that two images share, in each."""
        first, second = sorted((one, other))
        pairs = self._pairs(first, second).T
        return (pairs[0], pairs[1]) if first == one else (pairs[1], pairs[0])

    def landmarks(self, placed: Mapping[int, Neighbour]) -> dict[int, Landmarks]:
        """Triangulated points of two placed images each, by image."""
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
        """Pose T_camera_base (0 or 1, 4, 4) of an image by landmarks."""
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
        """Poses (n, 4, 4) near the likeliest ones of an image that agree better with the
        background: nominal errors, or clutter, turn a pose that is determined by legs alone.

        legs : (H, L, 3) by each of the poses.
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
        """Pose hypotheses of an image with the likelihood of the background it shares with placed
        ones.

        hypotheses : with log-likelihoods in nats, unit 1. camera : of the image. legs : (H, L, 3)
        by each of the poses. The background determines from which side the image was taken, the
        legs from where exactly.
        """
        if not placed:
            return hypotheses
        T = hypotheses.T_camera_base
        gain = self._gain(T, one, camera, [legs[h] for h in range(len(T))], placed)
        same = angle_between(T[:, None], T) < SAME_PLACE_TURN
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
        """Log-likelihood ratios (H,) of poses of an image by the background, against chance, by the
        placed image that shares most with it.
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
    """Points (n, 3) halfway between rays (n, 3) at their closest approach, and which are valid: in
    front of both cameras (3,), near both rays, with enough parallax.
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
