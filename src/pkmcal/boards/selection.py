"""Which camera model: first fits, errors on photographs left out, and the choice among models.

Of each model a few focal lengths are tried without distortion, and the best goes on with more and
more terms. Candidates are judged by what they predict of views left out of their fit: to first
order while choosing, by refitting for the one that is chosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, rms
from pkmcal.boards.fit import (
    CameraFit,
    Views,
    fit_board_poses,
    fit_camera,
    inverted,
    linear_poses,
    refit,
    settled_poses,
)
from pkmcal.cameras.contract import Camera, camera_models
from pkmcal.geometry.rigid import apply, dot
from pkmcal.solver.elimination import eliminate
from pkmcal.solver.kernels import NO_WEIGHT_DISTANCE

FOCAL_RANGES = {"pinhole": (0.3, 6.0), "fisheye": (0.12, 2.0), "unified": (0.12, 2.0)}
"""Range of pixels a radian in the picture's middle, as a share of its width."""
FOCALS_TRIED = 16
XIS_TRIED = (0.0, 0.5, 1.0, 1.5, 2.2)
CAMERA_STARTS_REFINED = 3
"""Best tries that are refined, over so many rounds of weights: it is a start only."""
CAMERA_START_ROUNDS = 3
HELD_OUT_PARTS = 10
"""Parts that the views are dealt into; each is predicted by a camera fitted to the others."""
CHANCE_DISAGREEMENT_RATIO = 1.5
"""Disagreement of views (square) that chance alone explains, with ten views or so."""
DISTORTION_CANDIDATES: dict[str, tuple[tuple[str, ...], ...]] = {
    "pinhole": (
        (), ("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"),
    ),
    "fisheye": ((), ("k1",), ("k1", "k2"), ("k1", "k2", "k3"), ("k1", "k2", "k3", "k4")),
    "unified": ((), ("p1", "p2"), ("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2")),
}  # fmt: skip
"""Candidates, from few terms to many; the model with the fewest first among equals."""
LEAST_GAIN = 0.01
"""Share by which the error on left-out views must fall for a term to be worth having."""
MEDIAN_LENGTH = float(np.sqrt(2 * np.log(2)))
"""Median length of two normal numbers, in their standard deviations."""
MOST_CORNERS = 1500
"""Corners in all that the choice looks at; the final fit takes every one."""
LEAST_RAYS = 4
"""Corners that fix a board's pose."""
LEAST_OF_VIEW = 12
"""Corners that every view keeps, where it has them."""
HOPELESS_MODEL_RATIO = 5.0
"""A model that fits so many times worse than another, with two radial terms, gets no more."""


def positions(camera: Camera | type[Camera], terms: tuple[str, ...]) -> Integers:
    """Positions of the free intrinsics: focal length, centre, xi where there is one, and terms."""
    base = ("focal.x", "focal.y", "center.x", "center.y", "xi")
    names = camera.parameter_names
    return np.array([k for k, name in enumerate(names) if name in base or name in terms])


def first_fit(model: str, views: Views, image_size: tuple[int, int]) -> CameraFit | None:
    """The best fit without distortion, None where no try gives finite pixels."""
    scored: list[tuple[float, Camera, Array]] = []
    for camera in _tries(model, image_size):
        rays = camera.ray(views.pixels)
        if np.isfinite(rays).all(axis=-1).sum(axis=-1).min() < LEAST_RAYS:
            continue  # it did not take these photographs, and has no pose to begin from
        poses = linear_poses(rays, views.points)
        off = camera.project(apply(poses[:, None], views.points)) - views.pixels
        distance = np.linalg.norm(off, axis=-1)[views.visible]
        # Lost corners count as far.
        score = float(np.median(np.where(np.isfinite(distance), distance, np.inf)))
        if np.isfinite(score):
            scored.append((score, camera, poses))
    scored.sort(key=lambda item: item[0])
    best: CameraFit | None = None
    for _, camera, poses in scored[:CAMERA_STARTS_REFINED]:
        settled = settled_poses(camera, views, poses)
        fit = fit_camera(camera, positions(camera, ()), views, settled, CAMERA_START_ROUNDS)
        if best is None or _level(fit) < _level(best):
            best = fit
    return best


def extended(fit: CameraFit, views: Views, terms: tuple[str, ...]) -> CameraFit:
    """The fit continued with more free terms."""
    return fit_camera(fit.camera, positions(fit.camera, terms), views, fit.T_camera_board)


def _tries(model: str, image_size: tuple[int, int]) -> Iterator[Camera]:
    width, height = image_size
    kind = camera_models()[model]
    names = kind.parameter_names
    for scale in np.geomspace(*FOCAL_RANGES[model], FOCALS_TRIED):
        for xi in XIS_TRIED if "xi" in names else (0.0,):
            values = dict.fromkeys(names, 0.0)
            values["focal.x"] = values["focal.y"] = float(scale) * width * (1 + xi)
            values["center.x"], values["center.y"] = (width - 1) / 2, (height - 1) / 2
            if "xi" in names:
                values["xi"] = xi
            yield kind(image_size, np.array([values[name] for name in names]))


@dataclass(frozen=True)
class HeldOut:
    """Errors on held-out views.

    residuals : (V, N, 2) px; each view's pose is fitted, the camera is that of other views.
    rms : px, of the residuals' lengths. by_view : (V,) the same by view.
    straightness : px, root mean square distance of corners from the great circle of their board
        line, in rays of the camera of other views; no pose takes part in it.
    """

    residuals: Array
    rms: float
    by_view: Array
    straightness: float


def held_out(fit: CameraFit, views: Views, lines: tuple[tuple[int, ...], ...]) -> HeldOut:
    """Refit without each part of the views, and predict that part."""
    count = len(fit.T_camera_board)
    inliers = (fit.weight >= 0.5) & views.visible
    residuals = np.full(views.pixels.shape, np.nan)
    bends: list[Array] = []
    part_of = np.arange(count) % min(HELD_OUT_PARTS, count)
    for part in range(part_of.max() + 1):
        out = np.flatnonzero(part_of == part)
        camera = refit(fit, views, np.flatnonzero(part_of != part)).camera
        mine = views.take(out)
        scale = np.where(inliers[out], 1 / np.sqrt(mine.sigma**2 + fit.tau**2), 0.0)
        poses, _ = fit_board_poses(camera, mine, fit.T_camera_board[out], scale)
        predicted = camera.project(apply(poses[:, None], views.points))
        residuals[out] = np.where(inliers[out][..., None], predicted - mine.pixels, np.nan)
        for v in out:
            pixels = np.where(inliers[v][:, None], views.pixels[v], np.nan)
            bends.append(line_offsets(camera, pixels, lines))
    squares = np.sum(residuals**2, axis=-1)
    bend = np.concatenate(bends)
    return HeldOut(
        residuals,
        float(np.sqrt(np.nanmean(squares))),
        np.sqrt(np.nanmean(squares, axis=1)),
        rms(bend),
    )


def line_offsets(camera: Camera, pixels: Array, lines: tuple[tuple[int, ...], ...]) -> Array:
    """Distances (n,) px of corners from the great circle through their line's rays.

    pixels : (N, 2) of one view, NaN where not seen. lines : ids of corners on a straight line.
    A line's plane is fitted to its rays, weighted so that pixels count, not angles.
    """
    rays = camera.ray(pixels)
    by_pixel = camera.ray_jacobians(pixels)[0]
    good = np.asarray(np.isfinite(rays).all(axis=-1))
    out: list[Array] = []
    for line in lines:
        ids = np.array(line)[good[list(line)]]
        if len(ids) < 3:
            continue
        s, turn = rays[ids], by_pixel[ids]
        weight, normal = np.ones(len(ids)), np.zeros(3)
        for _ in range(3):
            normal = np.linalg.eigh((s * weight[:, None]).T @ s)[1][:, 0]
            slope = np.linalg.norm(np.einsum("nik,i->nk", turn, normal), axis=-1)
            weight = 1 / np.maximum(slope, 1e-12) ** 2
        out.append(dot(s, normal) * np.sqrt(weight))
    return np.concatenate(out) if out else np.zeros(0)


def leave_one_out_residuals(fit: CameraFit, views: Views) -> Array:
    """Residuals (V, N, 2) px of each view under the camera of the others, to first order."""
    shifted, rows, _ = _without_each(fit, views)
    change = (rows @ shifted[..., None])[..., 0].reshape(*views.visible.shape, 2)
    scale = fit.problem(views).scale[0][..., None]
    return fit.residuals + np.where(scale > 0, change / np.where(scale > 0, scale, 1.0), 0.0)


def spread_of_views(fit: CameraFit, views: Views) -> float:
    """Factor by which the intrinsics scatter over the views more than the corners' noise says.

    The jackknife over views, whose covariance is (V - 1) / V of the sum of squares of what each
    view's absence changes, against that of the noise; 1 where chance explains the difference.
    """
    shifted, _, normal = _without_each(fit, views)
    off = shifted - shifted.mean(axis=0)
    count = len(shifted)
    jackknife = (count - 1) / count * off.T @ off
    ratio = float(np.trace(normal @ jackknife)) / max(len(fit.free), 1)
    return float(np.sqrt(ratio)) if ratio > CHANCE_DISAGREEMENT_RATIO else 1.0


def _without_each(fit: CameraFit, views: Views) -> tuple[Array, Array, Array]:
    """How leaving out each view moves the free intrinsics (V, k), to first order; the rows with
    poses eliminated (V, r, k); the normal matrix of all (k, k).

    With rows A_v and residuals r_v of view v, that is (N - N_v)^-1 A_v^T r_v, since all views
    together are in balance.
    """
    linear = fit.problem(views).linearize(fit.state)
    rows = eliminate(linear).rows[0]
    normals = rows.mT @ rows
    whole = normals.sum(axis=0)
    right = rows.mT @ linear.value[0][..., None]
    shifted = np.stack([inverted(whole - part) for part in normals]) @ right
    return shifted[..., 0], rows, whole


@dataclass(frozen=True)
class Candidate:
    """One model with one set of terms.

    parameters : number of free intrinsics. rms : px, length of the residual, root mean square over
    the corners in use by the best candidate. left_out : the same on views left out of the fit, to
    first order. robust : the same of all corners, each counting for no more than the best
    candidate's noise allows; by_view : (V,) px^2, its squares by view.
    """

    model: str
    terms: tuple[str, ...]
    parameters: int
    rms: float
    left_out: float
    robust: float
    by_view: Array
    fit: CameraFit


def camera_candidates(
    views: Views, image_size: tuple[int, int], models: tuple[str, ...]
) -> tuple[Candidate, ...]:
    """Every model with each of its sets of terms, fitted; models without a start are missing."""
    fits: list[tuple[str, tuple[str, ...], CameraFit]] = []
    # The unified camera fits almost anything: it tells which of the others are hopeless.
    for model in sorted(models, key=list(DISTORTION_CANDIDATES).index, reverse=True):
        start = first_fit(model, views, image_size)
        if start is None:
            continue
        for terms in DISTORTION_CANDIDATES[model]:
            fit = extended(start, views, terms)
            fits.append((model, terms, fit))
            if "k2" in terms and _level(fit) > HOPELESS_MODEL_RATIO * min(
                _level(f) for _, _, f in fits
            ):
                break
            # A set that holds this one begins where it ended.
            start = fit if "k1" in terms else start
    if not fits:
        return ()
    # All are compared by the same corners, those that a fit gave up too: each counts for as much as
    # the one that fits best gives up, and no model wins by giving up more.
    usual = min(_level(fit) for _, _, fit in fits) / MEDIAN_LENGTH
    most = NO_WEIGHT_DISTANCE**2 * (usual**2 + views.sigma**2)
    off = [leave_one_out_residuals(fit, views) for _, _, fit in fits]
    bounded = [np.minimum(_squares(remainder, views.visible), most) for remainder in off]
    best = int(np.argmin([np.sum(squares) for squares in bounded]))
    used = (fits[best][2].weight > 0.5) & views.visible
    pool = [
        Candidate(
            model=model,
            terms=terms,
            parameters=len(fit.free),
            rms=_rms(fit.residuals, used),
            left_out=_rms(remainder, used),
            robust=float(np.sqrt(np.sum(squares) / max(int(views.visible.sum()), 1))),
            by_view=np.sum(squares, axis=1) / np.maximum(views.visible.sum(axis=1), 1),
            fit=fit,
        )
        for (model, terms, fit), remainder, squares in zip(fits, off, bounded, strict=True)
    ]
    return tuple(sorted(pool, key=lambda c: list(DISTORTION_CANDIDATES).index(c.model)))


def best_of(pool: tuple[Candidate, ...]) -> Candidate:
    """The fewest parameters among candidates that cannot be told from the best."""
    best = min(pool, key=lambda c: c.robust)
    return min((c for c in pool if not is_worse(c, best)), key=lambda c: c.parameters)


def is_worse(candidate: Candidate, best: Candidate) -> bool:
    """True where left-out views tell the two apart: by a hundredth of the error, and by more
    than the standard error of the difference over the views.
    """
    if candidate.robust <= best.robust * (1 + LEAST_GAIN):
        return False
    gain = candidate.by_view - best.by_view
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.mean() > error)


def fitted_to_all(chosen: Candidate, views: Views) -> CameraFit:
    """A candidate's fit continued with every corner."""
    fit = chosen.fit
    return fit_camera(fit.camera, fit.free, views, fit.T_camera_board)


def thinned(views: Views) -> Views:
    """The views with fewer corners each, where there are many: evenly over the board."""
    total = int(views.visible.sum())
    if total <= MOST_CORNERS:
        return views
    # One set of corners for all views, so that arrays stay small; no pattern of rows in it.
    order = np.random.default_rng(0).permutation(len(views.points))
    used = order[: max(len(order) * MOST_CORNERS // total, LEAST_OF_VIEW)]
    for in_view in views.visible:
        mine = order[in_view[order]]
        used = np.union1d(used, mine[:LEAST_OF_VIEW])
    return Views(views.points[used], views.pixels[:, used], views.sigma[:, used])


def _level(fit: CameraFit) -> float:
    """Median length of a residual, px."""
    return float(np.nanmedian(np.linalg.norm(fit.residuals, axis=-1)))


def _squares(off: Array, counted: Booleans) -> Array:
    """Squared lengths (V, N) of residuals (V, N, 2) of the corners that count."""
    return np.where(counted, np.sum(np.nan_to_num(off) ** 2, axis=-1), 0.0)


def _rms(off: Array, counted: Booleans) -> float:
    """Root mean square of the lengths."""
    return float(np.sqrt(_squares(off, counted).sum() / max(int(counted.sum()), 1)))
