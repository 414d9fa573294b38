"""Background of hand-held images: points of the room that several images share.

A machine of equal parts looks nearly the same from several sides; the room around it does not.
Feature points that two images share lie on each other's epipolar lines if the relative pose of the
cameras is correct, and anywhere otherwise. Each candidate pose of an image is therefore scored by
how well the room agrees with the images whose poses are already accepted.

Points on the machine are excluded: they move with it, and a machine with symmetric parts is
consistent with itself from several sides. Features are Lowe's SIFT (International Journal of
Computer Vision 60, 2004) with square-rooted descriptors (Arandjelovic and Zisserman, CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, dot, inverse, pose, rotation
from pkmcal.observe.image_localization import PoseHypotheses
from pkmcal.observe.pose_candidates import same_pose
from pkmcal.observe.predict import LegsInCamera


@dataclass(frozen=True)
class BackgroundOptions:
    """Constants of the background's features, of their matches, and of landmarks."""

    # longer side, px, to which images are reduced for feature detection, which doubles them again.
    # Finer detail is mostly noise: with 1600, eight photographs of a room have an eighth more
    # correct matches and half again as many wrong ones (measured)
    largest_side: int = 800
    # largest number of features of an image; those of most contrast are used
    most_features: int = 3000
    # largest ratio of the descriptor distances to the nearest and the second nearest feature at
    # which two features are matched (Lowe, section 7.1)
    distance_ratio: float = 0.8
    # distance in px below which two matches count as one: a corner has several descriptors, but is
    # one observation
    apart: float = 8.0
    # fewest matches of two images from which a likelihood is computed; the distribution of chance
    # matches cannot be estimated from fewer
    fewest_pairs: int = 16
    # size of the image region that may belong to the machine, relative to the outline of its
    # joints: plates, motors and cables extend beyond the joints, to an extent that the nominal
    # model does not contain
    outline_factor: float = 1.5
    # standard deviations of points about their epipolar planes, rad, of which the likeliest is
    # used: from the localization error of a feature to the camera rotation that a nominal model
    # wrong by millimetres causes
    spreads: tuple[float, ...] = (np.radians(0.1), np.radians(0.25), np.radians(0.6))
    # smallest and largest share of correct matches
    shares: tuple[float, float] = (0.02, 0.98)
    # bisections of these to the likeliest share (numerical: to 1.5 %)
    share_bisections: int = 6
    # angle from the epipolar planes within which exchanged partners are counted, rad: three times
    # the largest spread
    window: float = np.radians(2.0)
    # number of landmark triples tried by RANSAC for the pose of an image: a share of one correct
    # landmark in ten suffices to draw three correct ones (derived)
    triples: int = 3000
    # largest number of sets of five matches tried by RANSAC for the relative pose of two images: a
    # share of one correct match in four suffices (derived)
    quintuples: int = 5000
    # probability of a set without wrong matches at which RANSAC ends before (statistical)
    confidence: float = 0.999
    # cosine of rays to the optical axis below which they are left out of it: normalized
    # coordinates grow beyond bounds
    least_cosine: float = 0.2
    # number of candidate poses of an image around which the background is evaluated
    candidates: int = 4
    # number of images with accepted poses, those with the most matches, that score a candidate
    neighbours: int = 8
    # number of images with which an image is matched: the most similar ones by the histograms of
    # their features over a vocabulary
    similar: int = 16
    # words of the vocabulary, features drawn from all images
    words: int = 256
    # largest rotation about the machine that is tried there, degrees; with larger ones the
    # silhouettes would match other legs
    turn_reach: float = 6.0
    # spacing of these rotations, degrees
    turn_step: float = 2.0

    @property
    def least_parallax(self) -> float:
        """Smallest angle between two rays, rad, at which their intersection is used as a landmark:
        five times the largest spread.
        """
        return 5 * max(self.spreads)

    @cached_property
    def turns(self) -> Array:
        """Rotations (n, 2) about the machine, rad, that are tried."""
        steps = np.arange(-self.turn_reach, self.turn_reach + self.turn_step / 2, self.turn_step)
        return np.radians(np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2))


BACKGROUND_OPTIONS = BackgroundOptions()


class Texture(NamedTuple):
    """Feature points of one image.

    ray : (n, 3) unit vectors, camera frame.
    pixel : (n, 2).
    descriptor : (n, 128) unit vectors.
    """

    ray: Array
    pixel: Array
    descriptor: Array


def texture_of(
    image: Integers, camera: Camera, options: BackgroundOptions = BACKGROUND_OPTIONS
) -> Texture:
    """Feature points of an image of grey levels (height, width)."""
    import cv2

    scale = min(options.largest_side / max(image.shape), 1.0)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, value = cv2.SIFT.create(options.most_features).detectAndCompute(small, None)
    if not points:
        return Texture(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32))
    pixel = (np.array([p.pt for p in points]) + 0.5) / scale - 0.5
    share = value / np.maximum(value.sum(axis=1, keepdims=True), 1e-9)
    ray = camera.ray(pixel)
    ok = np.isfinite(ray).all(axis=1)
    return Texture(ray[ok], pixel[ok], np.sqrt(share)[ok].astype(np.float32))


def partners(
    one: Texture, other: Texture, options: BackgroundOptions = BACKGROUND_OPTIONS
) -> Integers:
    """Indices (n, 2) of mutually nearest features that pass the ratio test, no image point used
    twice.
    """
    if min(len(one.ray), len(other.ray)) < 2:
        return np.zeros((0, 2), dtype=int)
    # nearest neighbours that pass the ratio test; descriptors have unit length
    cosine = one.descriptor @ other.descriptor.T
    rows = np.arange(len(cosine))
    best = cosine.argmax(axis=1)
    nearest = cosine[rows, best]
    cosine[rows, best] = -1
    ratio = np.sqrt(np.maximum(1 - nearest, 0) / np.maximum(1 - cosine.max(axis=1), 1e-9))
    cosine[rows, best] = nearest
    j = rows[ratio < options.distance_ratio]
    # and are mutual
    j = j[cosine[:, best[j]].argmax(axis=0) == j]
    j = j[np.argsort(ratio[j], kind="stable")]
    k = best[j]
    # best ratio first; a match near an accepted one, in either image, is the same point
    near = np.zeros((len(j), len(j)), dtype=bool)
    for pixel in (one.pixel[j], other.pixel[k]):
        near |= np.abs(pixel[:, None] - pixel).max(axis=-1) < options.apart
    taken = np.zeros(len(j), dtype=bool)
    for n in range(len(j)):
        taken[n] = not (near[n] & taken).any()
    return np.stack([j, k], axis=1)[taken]


def beside_machine(
    pixel: Array,
    camera: Camera,
    legs: LegsInCamera,
    options: BackgroundOptions = BACKGROUND_OPTIONS,
) -> Booleans:
    """Mask (n,) of the pixels (n, 2) that lie outside the machine's outline.

    legs : (L, 3) in the frame of this camera, for this image alone.
    """
    import cv2

    joints = camera.project(np.concatenate([legs.a, legs.b]))
    joints = joints[np.isfinite(joints).all(axis=1)]
    if len(joints) < 3:
        return np.ones(len(pixel), dtype=bool)
    middle = (joints.min(axis=0) + joints.max(axis=0)) / 2
    outline = (middle + options.outline_factor * (joints - middle)).astype(np.float32)
    corner = cv2.convexHull(outline).reshape(-1, 2).astype(float)
    # a point is outside a convex polygon if it is outside one of its sides
    side, away = np.roll(corner, -1, axis=0) - corner, pixel[:, None] - corner
    inward = side[:, 0] * away[..., 1] - side[:, 1] * away[..., 0]
    turn = side[:, 0] * np.roll(side[:, 1], -1) - side[:, 1] * np.roll(side[:, 0], -1)
    return (np.sign(turn.sum()) * inward < 0).any(axis=1)


def agreement(
    one: Array, other: Array, T_other_one: Array, options: BackgroundOptions = BACKGROUND_OPTIONS
) -> Array:
    """Log-likelihood ratios (H,) that matched unit rays (n, 3) observe the same points, against
    chance.

    A match is either correct, with a share common to all matches, or distributed as matches with
    exchanged partners. The share and the spread of the correct matches are maximized over, and each
    costs half the logarithm of n (Schwarz, Annals of Statistics 6, 1978). Zero for fewer than
    the options' fewest matches.

    T_other_one : (H, 4, 4), from the frame of the first camera to that of the other.
    """
    if len(one) < options.fewest_pairs:
        return np.zeros(len(T_other_one))
    # normals (H, n, 3) of the epipolar planes
    ray = one @ T_other_one[:, :3, :3].mT
    normal = cross(T_other_one[:, None, :3, 3], ray)
    normal /= np.maximum(np.sqrt(dot(normal, normal)), 1e-12)[..., None]
    # angles (H, n) from the planes, and their density (H, 1, 1) by chance: that of all exchanged
    # partners
    sine, window = dot(normal, other), np.sin(options.window)
    near = np.array([np.count_nonzero(np.abs(own @ other.T) < window) for own in normal])
    near -= np.count_nonzero(np.abs(sine) < window, axis=1)
    count = len(one) * (len(one) - 1)
    chance = (np.maximum(near, 1) / count / (2 * options.window))[:, None, None]
    off = np.arcsin(np.clip(sine, -1, 1))[:, None]
    # maximum over share and spread, less the penalty of both; the gain is concave in the share
    spread = np.array(options.spreads)[:, None]
    density = np.exp(-0.5 * (off / spread) ** 2) / (np.sqrt(2 * np.pi) * spread)
    excess = density / chance - 1
    least, most = (np.full((*excess.shape[:2], 1), share) for share in options.shares)
    for _ in range(options.share_bisections):
        share = (least + most) / 2
        rises = np.sum(excess / (1 + share * excess), axis=-1, keepdims=True) > 0
        least, most = np.where(rises, share, least), np.where(rises, most, share)
    gain = np.log1p((least + most) / 2 * excess).sum(axis=-1)
    return np.maximum(gain.max(axis=-1) - np.log(len(one)), 0.0)


class Neighbour(NamedTuple):
    """An image whose pose is accepted.

    T_camera_base : (4, 4).
    legs : (L, 3) in the frame of this camera.
    """

    camera: Camera
    T_camera_base: Array
    legs: LegsInCamera


class Landmarks(NamedTuple):
    """Points of the room that are triangulated from two images with accepted poses.

    point : (n, 3) m, base frame.
    number : (n,) index of each point among the image's features.
    """

    point: Array
    number: Integers


class Surroundings:
    """Features that the images of a session share with each other.

    Features and matches are computed on first use and cached. An image is matched with the most
    similar other images only, so that the effort is linear in the number of images.

    numbers : of the images. image : function that returns the grey levels and the camera of the
    image with a given number.
    """

    def __init__(
        self,
        numbers: Sequence[int],
        image: Callable[[int], tuple[Integers, Camera]],
        options: BackgroundOptions = BACKGROUND_OPTIONS,
    ) -> None:
        self.numbers, self.options = numbers, options
        self.texture: Callable[[int], Texture] = cache(lambda k: texture_of(*image(k), options))
        self._pairs: Callable[[int, int], Integers] = cache(
            lambda j, k: partners(self.texture(j), self.texture(k), options)
        )

    @cached_property
    def _similar(self) -> frozenset[tuple[int, int]]:
        """Pairs of images that are matched, the smaller number first.

        Similarity is the cosine of their histograms over the vocabulary, words weighted by the
        logarithm of their rarity (Sivic and Zisserman, ICCV 2003).
        """
        if len(self.numbers) <= self.options.similar + 1:
            return frozenset(combinations(sorted(self.numbers), 2))
        every = [self.texture(k).descriptor for k in self.numbers]
        pool = np.concatenate(every)
        drawn = np.random.default_rng(0).permutation(len(pool))[: self.options.words]
        words = pool[drawn].T
        count = (
            np.stack(
                [np.bincount((one @ words).argmax(axis=1), minlength=len(drawn)) for one in every]
            )
            if len(drawn)
            else np.zeros((len(every), 1))
        )
        rarity = np.log(len(every) / np.maximum((count > 0).sum(axis=0), 1))
        weight = count * rarity
        weight = weight / np.maximum(np.sqrt(dot(weight, weight)), 1e-9)[:, None]
        likeness = weight @ weight.T
        np.fill_diagonal(likeness, -1)
        nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : self.options.similar]
        at = np.array(self.numbers)
        return frozenset(
            (min(one, other), max(one, other))
            for one, others in zip(at.tolist(), at[nearest].tolist(), strict=True)
            for other in others
        )

    def shared(self, one: int, other: int) -> tuple[Integers, Integers]:
        """Indices (n,) of the matched features of two images, in each of them."""
        first, second = sorted((one, other))
        if (first, second) not in self._similar:
            return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
        pairs = self._pairs(first, second).T
        return (pairs[0], pairs[1]) if first == one else (pairs[1], pairs[0])

    def landmarks(self, placed: Mapping[int, Neighbour]) -> dict[int, Landmarks]:
        """Landmarks of each image with an accepted pose, triangulated from its matches with every
        other.
        """
        results: dict[int, list[tuple[Array, Integers]]] = {k: [] for k in placed}
        with ThreadPoolExecutor(THREADS) as pool:  # matches take nearly all of the time
            list(pool.map(lambda pair: self.shared(*pair), combinations(placed, 2)))
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
            point, ok = _crossing(eyes[0], rays[0], eyes[1], rays[1], self.options)
            results[one].append((point[ok], j[ok]))
            results[other].append((point[ok], k[ok]))
        empty = np.zeros((0, 3)), np.zeros(0, dtype=int)
        return {
            k: Landmarks(*(np.concatenate(part) for part in zip(*parts, empty, strict=True)))
            for k, parts in results.items()
        }

    def _beside(self, k: int, numbers: Integers, neighbour: Neighbour) -> Booleans:
        """Mask (n,) of the features of image ``k`` that lie outside the machine's outline."""
        return beside_machine(
            self.texture(k).pixel[numbers], neighbour.camera, neighbour.legs, options=self.options
        )

    def place(self, one: int, landmarks: Mapping[int, Landmarks]) -> Array:
        """Camera pose T_camera_base (0 or 1, 4, 4) of an image from its matches with landmarks.

        P3P in RANSAC, refined on the inliers; empty with fewer inliers than the options require.
        """
        import cv2

        # correspondences of the image's features and the landmarks
        rays: list[Array] = [np.zeros((0, 3))]
        points: list[Array] = [np.zeros((0, 3))]
        for other, landmark in landmarks.items():
            j, k = self.shared(one, other)
            at, where = np.nonzero(k[:, None] == landmark.number)
            rays.append(self.texture(one).ray[j[at]])
            points.append(landmark.point[where])
        ray, point = np.concatenate(rays), np.concatenate(points)
        ahead = ray[:, 2] > self.options.least_cosine
        ray, point = ray[ahead], point[ahead]
        if len(ray) < self.options.fewest_pairs:
            return np.zeros((0, 4, 4))
        # P3P with RANSAC on normalized image coordinates, then refinement on the inliers
        plane = np.ascontiguousarray(ray[:, :2] / ray[:, 2:])
        off = float(np.tan(self.options.spreads[-1]))
        ok, turn, shift, inside = cv2.solvePnPRansac(
            point, plane, np.eye(3), np.zeros(0),
            iterationsCount=self.options.triples, reprojectionError=off, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        which = np.asarray(inside, dtype=int).ravel() if ok else np.zeros(0, dtype=int)
        if len(which) < self.options.fewest_pairs:
            return np.zeros((0, 4, 4))
        turn, shift = cv2.solvePnPRefineLM(
            point[which], plane[which], np.eye(3), np.zeros(0), turn, shift
        )
        rot = rotation(np.asarray(turn, dtype=float).ravel())
        return pose(rot, np.asarray(shift, dtype=float).ravel())[None]

    def relative(self, one: int, placed: Mapping[int, Neighbour], apart: Array) -> Array:
        """Camera poses T_camera_base (n, D, 4, 4) of an image by each of its nearest neighbours.

        Two images determine their relative pose up to the distance of the cameras, for which the
        values ``apart`` (D,), m, are used. Neighbours with too few matches are left out. The
        relative pose is by the five-point method (Nister, IEEE Transactions on Pattern Analysis and
        Machine Intelligence 26, 2004) in RANSAC with local optimization (USAC: Raguram and others,
        IEEE Transactions on Pattern Analysis and Machine Intelligence 35, 2013).
        """
        import cv2

        out = [np.zeros((0, len(apart), 4, 4))]
        off = float(np.tan(self.options.spreads[1]))
        for other in self._nearest(one, placed):
            j, k = self.shared(one, other)
            rays = self.texture(one).ray[j], self.texture(other).ray[k]
            ok = self._beside(other, k, placed[other])
            for ray in rays:
                ok &= ray[:, 2] > self.options.least_cosine
            if np.count_nonzero(ok) < self.options.fewest_pairs:
                continue
            here, there = (np.ascontiguousarray(ray[ok, :2] / ray[ok, 2:]) for ray in rays)
            essential, inside = cv2.findEssentialMat(
                there, here, np.eye(3), cv2.USAC_DEFAULT, self.options.confidence, off,
                self.options.quintuples,
            )  # fmt: skip
            if essential is None or essential.shape != (3, 3):  # no solution, or several
                continue
            _, turn, along, _ = cv2.recoverPose(essential, there, here, np.eye(3), mask=inside)
            T = pose(np.asarray(turn, dtype=float), apart[:, None] * np.ravel(along))
            out.append((T @ placed[other].T_camera_base)[None])
        return np.concatenate(out)

    def _nearest(self, one: int, placed: Mapping[int, Neighbour]) -> list[int]:
        """Images with accepted poses that share the most features with an image."""
        order = sorted(placed, key=lambda k: -len(self.shared(one, k)[0]))
        return order[: self.options.neighbours]

    def about(
        self,
        hypotheses: PoseHypotheses,
        one: int,
        camera: Camera,
        legs: LegsInCamera,
        placed: Mapping[int, Neighbour],
    ) -> Array:
        """Poses (n, 4, 4) near the likeliest hypotheses of an image that agree better with the
        background.

        Errors of the nominal model, or clutter, rotate a pose that is estimated from legs alone.

        legs : (H, L, 3) for each of the hypotheses.
        """
        out = [np.zeros((0, 4, 4))]
        for h, T in enumerate(hypotheses.T_camera_base[: self.options.candidates]):
            to_base = inverse(T)
            middle = to_base[:3, :3] @ np.concatenate([legs.a[h], legs.b[h]]).mean(axis=0)
            middle = middle + to_base[:3, 3]
            # rotations about the camera's axes x and y, through the middle of the machine
            turn = rotation(self.options.turns @ to_base[:3, :2].T)
            near = T @ pose(turn, middle - turn @ middle)
            gain = self._gain(near, one, camera, [legs[h]], placed)
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
        """Pose hypotheses of an image, with the log-likelihood ratio of the background added.

        The background determines from which side the image was taken; the legs determine the exact
        pose. Hypotheses that are the same pose share the largest gain of the group.

        hypotheses : log-likelihood ratios in unit 1.
        camera : of this image.
        legs : (H, L, 3) for each of the hypotheses.
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
        """Log-likelihood ratio (H,) of camera poses by the background, against chance.

        legs : for each of the poses, or one for all.

        Any of the images with accepted poses may be the one that shows the same part of the room,
        so their likelihoods are added.
        """
        texture, nearest = self.texture(one), self._nearest(one, placed)
        gain = np.zeros((len(T_camera_base), len(nearest)))
        outside = [
            beside_machine(texture.pixel, camera, axes, options=self.options) for axes in legs
        ]
        # rows of the poses with the same legs
        rows = [slice(h, h + 1) for h in range(len(legs))] if len(legs) > 1 else [slice(None)]
        for n, other in enumerate(nearest):
            in_view = placed[other]
            j, k = self.shared(one, other)
            beside = self._beside(other, k, in_view)
            T_other_one = in_view.T_camera_base @ inverse(T_camera_base)
            for which, own in zip(rows, outside, strict=True):
                ok = beside & own[j]
                rays = texture.ray[j[ok]], self.texture(other).ray[k[ok]]
                gain[which, n] = agreement(*rays, T_other_one[which], options=self.options)
        # the best of several rotations and neighbours is chosen: the number of trials is paid for
        tries = len(nearest) * len(self.options.turns)
        return np.maximum(np.logaddexp.reduce(gain, axis=1) - np.log(tries), 0.0)


def _crossing(
    eye: Array, ray: Array, eye_b: Array, ray_b: Array, options: BackgroundOptions
) -> tuple[Array, Booleans]:
    """Midpoints (n, 3) of the common perpendiculars of rays (n, 3), and which of them are
    landmarks.

    A landmark lies in front of both centres ``eye`` (3,), within the largest spread of both rays,
    and the rays differ by the least parallax.
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
        & (off < options.spreads[-1])
        & (cosine < np.cos(options.least_parallax))
    )
    return point, good
