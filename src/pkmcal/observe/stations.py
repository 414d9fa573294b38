"""The station's pose, refined on the images of all its configurations together.

The user's pose may be wrong by decimetres and ten degrees: a hundred pixels. Random poses around
it are scored by the distance from predicted silhouettes to picture edges (:mod:`distance`); the
best are refined by Gauss-Newton on those distances, all candidates at once, the capture range
shrinking; what remains is an error of a few pixels, from the drawing's errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, dot, inverse, perturb, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.distance import DistanceTables, direction_of
from pkmcal.observe.predict import (
    TubeList,
    edge_points,
    legs_in_camera,
    plane_normals,
    visible_stretch,
)

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
class View:
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
class StationPose:
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


def find_station(view: View, T_camera_base: Array, rng: np.random.Generator) -> StationPose:
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
    return StationPose(candidates[0], float(last[0]), float(chance))


def _random_search(view: View, T_camera_base: Array, rng: np.random.Generator) -> Array:
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


def _best(view: View, candidates: Array, photographs: Integers, reach: float, keep: int) -> Array:
    order = np.argsort(score(view, candidates, photographs, reach))
    return candidates[order[:keep]]


def score(
    view: View, T_camera_base: Array, photographs: Integers, reach: float, samples: int = 5
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
    view: View, candidates: Array, photographs: Integers, samples: int, reaches: tuple[float, ...]
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


def _look(view: View, candidates: Array, photographs: Integers, samples: int) -> _Look:
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
    weighted = np.swapaxes(look.jac * look.weight(reach)[..., None], -1, -2)
    normal = weighted @ look.jac
    diagonal = np.einsum("hii->hi", normal) + 1e-12
    normal = normal + (damping[:, None] * diagonal)[..., None] * np.eye(6)
    step = -np.linalg.solve(normal, weighted @ look.found[..., None])[..., 0]
    step = np.clip(step, -0.1, 0.1)  # further, the tables' slopes say nothing
    # turn about the camera: R <- Exp(omega) R, t <- Exp(omega) t + tau
    turned = pose(rotation(step[:, :3]), np.zeros((len(step), 3))) @ candidates
    return perturb(turned, np.concatenate([np.zeros((len(step), 3)), step[:, 3:]], axis=-1))
