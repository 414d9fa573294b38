"""Where a station's camera stands: a coarse search for the machine in its photographs.

Photographs are reduced, picture edges found, and for each of a few directions the distance to
the nearest edge of about that direction is tabulated. A predicted silhouette then scores by the
distances under its points, smooth enough to be descended from a hundred pixels away. Where a
station took several photographs, edges that never move are left out: the floor and the wall do
not say where the machine is.

About the rough pose many are tried at random, on a few photographs; the best descend by damped
steps on the distances, on more and more photographs, with distances cut off ever nearer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, dot, inverse, perturb, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import (
    TubeList,
    edge_points,
    legs_in_camera,
    plane_normals,
    visible_stretch,
)

DIRECTIONS = 8
"""Edge directions told apart; each table takes the neighbouring directions in as well."""
WORKING_WIDTH = 256
"""Width in pixels that photographs are reduced to: fine enough for a leg's two edges to stay
apart, coarse enough to search quickly."""
STILL = 10.0
"""Grey levels from the station's median photograph within which a place counts as still."""
ENOUGH_TO_COMPARE = 4
"""Photographs from which a median is a picture of the background."""
SEARCH_ANGLE = np.radians(6.0)
SEARCH_DISTANCE = 0.06
"""Spread (per axis, rad and m) of the poses tried around the user's: its norm over three axes
is 10 degrees and 10 cm."""
TRIES = 800
RETRIES = 400
GOOD_SCORE = 0.34
"""Mean truncated distance above which no leg was recognised. Photographs of the machine give 0.2;
another configuration, station or order of legs 0.36 to 0.6."""
BY_CHANCE = 0.5
"""Share of the score by chance that recognised legs stay below. Photographs that are all texture
score 0.3 anywhere; photographs of a machine score 0.2 where chance has 0.9."""
FIRST_DAMPING = 1e-3
"""Of a step, relative to the normal equations' diagonal."""
LAST_REACH = 4.0
"""Reduced pixels at which the final score cuts distances off."""


@dataclass(frozen=True)
class DistanceTables:
    """Distances in reduced pixels, (K, DIRECTIONS, h, w), and the reduction factor."""

    tables: Array
    scale: float

    def look(
        self, direction: Integers, pixel: Array, photograph: Integers
    ) -> tuple[Array, Booleans]:
        """Distances (reduced px) at full-size pixels (..., 2), and which lie in the photograph.

        direction, photograph : (...) table numbers. Nearest table entry; callers that need a
        slope look on both sides.
        """
        height, width = self.tables.shape[-2:]
        with np.errstate(invalid="ignore"):
            place = (pixel + 0.5) / self.scale - 0.5
            inside = (place[..., 0] >= 0) & (place[..., 0] <= width - 1)
            inside &= (place[..., 1] >= 0) & (place[..., 1] <= height - 1)
        x, y = (np.where(inside, np.rint(place[..., i]), 0).astype(np.intp) for i in (0, 1))
        return self.tables[photograph, direction, y, x], inside

    def look_smooth(
        self, direction: Integers, pixel: Array, photograph: Integers
    ) -> tuple[Array, Booleans]:
        """As :meth:`look`, bilinear between table entries."""
        height, width = self.tables.shape[-2:]
        with np.errstate(invalid="ignore"):
            place = (pixel + 0.5) / self.scale - 0.5
            inside = (place[..., 0] >= 0) & (place[..., 0] < width - 1)
            inside &= (place[..., 1] >= 0) & (place[..., 1] < height - 1)
        place = np.where(inside[..., None], place, 0.0)
        corner = np.floor(place).astype(np.intp)
        fx, fy = (place[..., i] - corner[..., i] for i in (0, 1))
        x, y = corner[..., 0], corner[..., 1]
        at = self.tables
        upper = (1 - fx) * at[photograph, direction, y, x]
        upper = upper + fx * at[photograph, direction, y, x + 1]
        lower = (1 - fx) * at[photograph, direction, y + 1, x]
        lower = lower + fx * at[photograph, direction, y + 1, x + 1]
        return (1 - fy) * upper + fy * lower, inside


def direction_of(normal: Array) -> Integers:
    """Direction number of edges whose image normals are (..., 2); the sign does not matter."""
    angle = np.arctan2(normal[..., 1], normal[..., 0]) % np.pi
    number = np.floor(np.nan_to_num(angle) * (DIRECTIONS / np.pi))
    return number.astype(np.intp) % DIRECTIONS


def distance_tables(images: list[Integers]) -> DistanceTables:
    """Tables of one station's photographs, K arrays (height, width) uint8 of one size."""
    import cv2

    scale = max(images[0].shape[1] / WORKING_WIDTH, 1.0)
    size = (round(images[0].shape[1] / scale), round(images[0].shape[0] / scale))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    still = np.median(np.stack(small), axis=0) if len(small) >= ENOUGH_TO_COMPARE else None
    return DistanceTables(np.stack([_tables_of(image, still) for image in small]), scale)


def _tables_of(image: Any, still: Array | None) -> Array:
    """Distance tables (DIRECTIONS, h, w) of one reduced photograph."""
    import cv2

    dx = cv2.Sobel(image, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(image, cv2.CV_16S, 0, 1)
    # weak edges count too: a dark rod before a dark wall differs by a few grey levels
    edges = cv2.Canny(dx, dy, 40, 80) > 0
    if still is not None:
        moving = (np.abs(image - still) > STILL).astype(np.uint8)
        edges &= cv2.dilate(moving, np.ones((3, 3), np.uint8)) > 0
    y, x = np.nonzero(edges)
    number = direction_of(np.stack([dx[y, x], dy[y, x]], axis=-1).astype(np.float32))
    tables = np.empty((DIRECTIONS, *image.shape), dtype=np.float32)
    for k in range(DIRECTIONS):
        near = np.isin(number, [(k - 1) % DIRECTIONS, k, (k + 1) % DIRECTIONS])
        mask = np.ones(image.shape, dtype=np.uint8)
        mask[y[near], x[near]] = 0
        tables[k] = cv2.distanceTransform(mask, cv2.DIST_L2, 3) if near.any() else 1e3
    return tables


@dataclass(frozen=True)
class StationView:
    """What the search looks at: one station's photographs and what should be in them.

    joints : (K, m) and poses : T_base_platform (K, 4, 4) of its photographs.
    """

    machine: Machine
    camera: Camera
    tubes: TubeList
    joints: Array
    poses: Array
    tables: DistanceTables

    def few(self, count: int) -> Integers:
        """Numbers of up to ``count`` photographs, spread over all."""
        n = len(self.joints)
        return np.unique(np.linspace(0, n - 1, min(count, n)).astype(int))


@dataclass(frozen=True)
class FoundStation:
    """A found pose T_camera_base (4, 4) and its score: 0 perfect, 1 nothing fits.

    chance : the score of legs laid anywhere, low where the photographs are full of edges.
    """

    T_camera_base: Array
    score: float
    chance: float

    @property
    def good(self) -> bool:
        """Whether the machine was recognised at all."""
        return self.score < min(GOOD_SCORE, BY_CHANCE * self.chance)


def find_station(view: StationView, T_camera_base: Array, rng: np.random.Generator) -> FoundStation:
    """Refine a rough pose; every photograph of the station takes part."""
    candidates = _random_search(view, T_camera_base, rng)
    few, more, every = view.few(4), view.few(8), view.few(len(view.joints))
    candidates = _descend(view, candidates, few, 5, (8, 8, 6, 6, 5, 5))
    candidates = _best(view, candidates, more, reach=5, keep=4)
    candidates = _descend(view, candidates, more, 6, (5, 4, 4, 3))
    candidates = _best(view, candidates, more, reach=3, keep=1)
    candidates = _descend(view, candidates, every, 8, (3, 2, 2, 1.5, 1.5))
    chance = np.minimum(view.tables.tables, LAST_REACH).mean() / LAST_REACH
    last = score(view, candidates, every, reach=LAST_REACH)
    return FoundStation(candidates[0], float(last[0]), float(chance))


def _random_search(view: StationView, T_camera_base: Array, rng: np.random.Generator) -> Array:
    """Candidates (16, 4, 4): a wide random draw, then a narrower one around its best."""
    spread = np.repeat([SEARCH_ANGLE, SEARCH_DISTANCE], 3)
    T_base_camera = inverse(T_camera_base)

    def moved(steps: Array) -> Array:
        return inverse(T_base_camera @ pose(rotation(steps[:, :3]), steps[:, 3:]))

    few = view.few(4)
    steps = rng.normal(size=(TRIES, 6)) * spread
    steps[0] = 0.0
    best = steps[np.argsort(score(view, moved(steps), few, reach=12))[:60]]
    again = best[rng.integers(0, len(best), RETRIES)]
    steps = np.concatenate([best, again + rng.normal(size=again.shape) * (0.45 * spread)])
    order = np.argsort(score(view, moved(steps), few, reach=10))[:16]
    return moved(steps[order])


def _best(
    view: StationView, candidates: Array, photographs: Integers, reach: float, keep: int
) -> Array:
    order = np.argsort(score(view, candidates, photographs, reach))
    return candidates[order[:keep]]


def score(
    view: StationView, T_camera_base: Array, photographs: Integers, reach: float, samples: int = 5
) -> Array:
    """Mean distance from predicted edges to picture edges, cut off at ``reach``: (H,), 0 to 1.

    T_camera_base : (H, 4, 4) hypotheses. reach : reduced pixels. Edges are taken as the chords
    between their ends, which is exact for a pinhole and near enough for this search elsewhere.
    """
    tubes = view.tubes
    legs = legs_in_camera(
        view.machine, T_camera_base[:, None], view.poses[photographs], view.joints[photographs]
    )
    a, b, u = (v[..., tubes.leg, :] for v in (legs.a, legs.b, legs.u))
    radius = view.machine.values[tubes.radius]
    normal, ok = plane_normals(a, u, radius, tubes)
    first, last = visible_stretch(a, b, tubes)
    base = a + radius[:, None] * normal
    ends = np.stack(
        [base + first[:, None] * u, base + last[..., None] * u], axis=-2
    )  # (H, K, E, 2, 3)
    pixel = view.camera.project(ends)
    chord = pixel[..., 1, :] - pixel[..., 0, :]
    direction = direction_of(np.stack([-chord[..., 1], chord[..., 0]], axis=-1))
    fraction = (np.arange(samples) + 0.5) / samples
    points = pixel[..., :1, :] + fraction[:, None] * chord[..., None, :]
    number = np.arange(len(view.joints))[photographs][:, None, None]
    found, inside = view.tables.look(direction[..., None], points, number)
    cost = np.where(inside & ok[..., None], np.minimum(found, reach) / reach, 1.0)
    weight = np.nan_to_num(np.sqrt(dot(chord, chord)))
    return np.sum(cost.mean(axis=-1) * weight, axis=(1, 2)) / np.sum(weight, axis=(1, 2))


class _Look(NamedTuple):
    """The picture under predicted edges, (H, n): distance found and whether in the image; the
    distance's derivatives by the camera frame's motion (H, n, 6).
    """

    found: Array
    inside: Booleans
    jac: Array

    def weight(self, reach: float) -> Array:
        """Geman-McClure: what is further than the reach is another edge."""
        return np.where(self.inside, (1 + (self.found / reach) ** 2) ** -2.0, 0.0)

    def cost(self, reach: float) -> Array:
        """What the weights minimise, (H,): 0 to 1 an edge point, and 1 outside the image."""
        part = (self.found / reach) ** 2
        return np.where(self.inside, part / (1 + part), 1.0).mean(axis=-1)

    def where(self, better: Booleans, other: _Look) -> _Look:
        """Take some of the hypotheses from here, the rest from the other look."""
        keep = better[:, None]
        return _Look(
            np.where(keep, self.found, other.found),
            np.where(keep, self.inside, other.inside),
            np.where(keep[..., None], self.jac, other.jac),
        )


def _descend(
    view: StationView,
    candidates: Array,
    photographs: Integers,
    samples: int,
    reaches: tuple[float, ...],
) -> Array:
    """Levenberg-Marquardt on the distances, candidates (H, 4, 4) side by side, a step a reach.

    Upright legs hardly say where their camera stands; undamped, steps there go astray.
    """
    look = _look(view, candidates, photographs, samples)
    damping = np.full(len(candidates), FIRST_DAMPING)
    for reach in reaches:
        trial = _step(candidates, look, reach, damping)
        seen = _look(view, trial, photographs, samples)
        better = seen.cost(reach) < look.cost(reach)
        candidates = np.where(better[:, None, None], trial, candidates)
        look = seen.where(better, look)
        damping = np.where(better, 0.3, 10.0) * damping
    return candidates


def _look(view: StationView, candidates: Array, photographs: Integers, samples: int) -> _Look:
    """Distances under the edges predicted from poses (H, 4, 4)."""
    number = np.arange(len(view.joints))[photographs][:, None, None]
    legs = legs_in_camera(
        view.machine, candidates[:, None], view.poses[photographs], view.joints[photographs]
    )
    points = edge_points(view.machine, view.camera, legs, view.tubes, samples)
    direction = direction_of(points.outward)
    step = points.outward * view.tables.scale
    found, inside = view.tables.look_smooth(direction, points.pixel, number)
    ahead, _ = view.tables.look_smooth(direction, points.pixel + step, number)
    behind, _ = view.tables.look_smooth(direction, points.pixel - step, number)
    slope = np.clip((ahead - behind) / 2, -1, 1)
    inside = inside & points.valid
    # the pixel moves outward by across . (omega x P + tau) for a motion of the camera frame
    motion = np.concatenate([cross(points.point, points.across), points.across], axis=-1)
    jac = np.where(inside[..., None], slope[..., None] * motion / view.tables.scale, 0.0)
    flat = (len(candidates), -1)
    return _Look(
        np.where(inside, found, 0.0).reshape(flat), inside.reshape(flat), jac.reshape(*flat, 6)
    )


def _step(candidates: Array, look: _Look, reach: float, damping: Array) -> Array:
    """One damped Gauss-Newton step of every candidate's pose, (H, 4, 4); damping (H,)."""
    weighted = (look.jac * look.weight(reach)[..., None]).mT
    normal = weighted @ look.jac
    diagonal = np.einsum("hii->hi", normal) + 1e-12
    normal = normal + (damping[:, None] * diagonal)[..., None] * np.eye(6)
    step = -np.linalg.solve(normal, weighted @ look.found[..., None])[..., 0]
    step = np.clip(step, -0.1, 0.1)  # further, the tables' slopes say nothing
    # turn about the camera: R <- Exp(omega) R, t <- Exp(omega) t + tau
    turned = pose(rotation(step[:, :3]), np.zeros((len(step), 3))) @ candidates
    return perturb(turned, np.concatenate([np.zeros((len(step), 3)), step[:, 3:]], axis=-1))
