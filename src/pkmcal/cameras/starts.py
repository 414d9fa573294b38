"""A start for every model without any guess: focal length (and xi) tried over a wide range.

For each try the corners become rays, the rays linear poses, the poses pixels again; the tries
whose pixels come nearest are refined. Every view takes part, however oblique.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras.contract import Camera, camera_models
from pkmcal.cameras.fit import Fit, Views, fit_camera
from pkmcal.cameras.resection import linear_poses, settled_poses
from pkmcal.geometry.rigid import apply

FOCALS = {"pinhole": (0.3, 6.0), "fisheye": (0.12, 2.0), "unified": (0.12, 2.0)}
"""Range of pixels a radian in the picture's middle, as a share of its width."""
TRIES = 16
XIS = (0.0, 0.5, 1.0, 1.5, 2.2)
KEPT = 3
"""Best tries that are refined, over so many rounds of weights: it is a start only."""
ROUNDS = 3


def positions(camera: Camera | type[Camera], terms: tuple[str, ...]) -> Integers:
    """Positions of the free intrinsics: focal length, centre, xi where there is one, and terms."""
    base = ("focal.x", "focal.y", "center.x", "center.y", "xi")
    names = camera.parameter_names
    return np.array([k for k, name in enumerate(names) if name in base or name in terms])


def first_fit(model: str, views: Views, image_size: tuple[int, int]) -> Fit | None:
    """The best fit without distortion, None where no try gives finite pixels."""
    scored: list[tuple[float, Camera, Array]] = []
    for camera in _tries(model, image_size):
        poses = linear_poses(camera.ray(views.pixels), views.points)
        score = _score(camera, poses, views)
        if np.isfinite(score):
            scored.append((score, camera, poses))
    scored.sort(key=lambda item: item[0])
    best: Fit | None = None
    for _, camera, poses in scored[:KEPT]:
        settled = settled_poses(camera, views, poses)
        fit = fit_camera(camera, positions(camera, ()), views, settled, ROUNDS)
        if best is None or _median(fit) < _median(best):
            best = fit
    return best


def extended(fit: Fit, views: Views, terms: tuple[str, ...]) -> Fit:
    """The fit continued with more free terms."""
    return fit_camera(fit.camera, positions(fit.camera, terms), views, fit.T_camera_board)


def _tries(model: str, image_size: tuple[int, int]) -> Iterator[Camera]:
    width, height = image_size
    kind = camera_models()[model]
    names = kind.parameter_names
    for scale in np.geomspace(*FOCALS[model], TRIES):
        for xi in XIS if "xi" in names else (0.0,):
            values = dict.fromkeys(names, 0.0)
            values["focal.x"] = values["focal.y"] = float(scale) * width * (1 + xi)
            values["center.x"], values["center.y"] = (width - 1) / 2, (height - 1) / 2
            if "xi" in names:
                values["xi"] = xi
            yield kind(image_size, np.array([values[name] for name in names]))


def _score(camera: Camera, poses: Array, views: Views) -> float:
    """Median distance, px, of predicted corners from seen ones; lost corners count as far."""
    off = camera.project(apply(poses[:, None], views.points)) - views.pixels
    distance = np.linalg.norm(off, axis=-1)[views.seen]
    return float(np.median(np.where(np.isfinite(distance), distance, np.inf)))


def _median(fit: Fit) -> float:
    distance = np.linalg.norm(fit.residuals, axis=-1)
    return float(np.nanmedian(distance))
