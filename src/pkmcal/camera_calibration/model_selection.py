"""Choice of the camera model: starting values, candidates and their held-out errors.

For each model a grid of focal lengths is tried without distortion, and the best continues with more
and more coefficients. Candidates are compared by their errors on held-out views: to first order
during selection, by refitting for the selected one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, rms
from pkmcal.boards.fit import (
    MEDIAN_LENGTH,
    CameraFit,
    Views,
    covariance_of,
    fit_board_poses,
    fit_camera,
    inverted,
    linear_poses,
    refit,
    settled_poses,
)
from pkmcal.cameras.contract import CENTER, FOCAL, Camera, camera_models
from pkmcal.geometry.rigid import apply, dot
from pkmcal.levels import FALSE_ALARM, NEGLIGIBLE
from pkmcal.ranges import CameraModelChoice
from pkmcal.solver.elimination import eliminate
from pkmcal.solver.kernels import INLIER_WEIGHT, NO_WEIGHT_DISTANCE
from pkmcal.solver.ranks import NORMAL_RANK_TOLERANCE, normal_root

CALIBRATED_MODELS: tuple[str, ...] = get_args(CameraModelChoice)[1:]
"""Camera models in the order of preference among equals."""


@dataclass(frozen=True)
class ModelSelectionOptions:
    """Constants of the selection of a camera model and its coefficients."""

    # camera models that are compared, a requested one among them
    models: tuple[str, ...] = CALIBRATED_MODELS
    # focal lengths of the grid, in geometric steps over the range
    focals: int = 16
    # number of best starting values that are refined
    starts: int = 3
    # IRLS rounds of this refinement
    start_rounds: int = 3
    # number of parts into which the views are dealt; each is predicted by a camera fitted to the
    # others
    parts: int = 10
    # least relative decrease of the held-out error that justifies a coefficient
    least_gain: float = NEGLIGIBLE
    # largest standard deviation of the focal length, as a share of it; a machine of 1 m would be
    # off by 2 cm. Of a simulated pinhole with 54 corners of 0.1 px, 3 images tilted by at most 7.5
    # degrees have 1.7 %, in the worst of 12 seeds 2.7 %; all images tilted by 15 degrees or more
    # have less than half of the limit
    least_sure: float = 0.02
    # number of corners used for the selection; the final fit uses all
    most_corners: int = 1500
    # fewest corners that determine a board's pose (derived)
    least_rays: int = 4
    # fewest corners kept of each view, if it has as many
    least_of_view: int = 12


MODEL_SELECTION_OPTIONS = ModelSelectionOptions()


def positions(camera: Camera | type[Camera], terms: tuple[str, ...]) -> Integers:
    """Indices of the free intrinsics: focal lengths, centre, the model's own, and ``terms``."""
    base, names = 4 + len(camera.own), camera.parameter_names
    return np.array([k for k, name in enumerate(names) if k < base or name in terms])


def first_fit(
    model: str,
    views: Views,
    image_size: tuple[int, int],
    options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS,
) -> CameraFit | None:
    """Best fit without distortion; None if no starting value gives finite pixels."""
    scored: list[tuple[float, Camera, Array]] = []
    for camera in starting_cameras(model, image_size, options=options):
        rays = camera.ray(views.pixels)
        if np.isfinite(rays).all(axis=-1).sum(axis=-1).min() < options.least_rays:
            continue  # this camera has no rays for the corners, and so no initial poses
        poses = linear_poses(rays, views.points)
        off = camera.project(apply(poses[:, None], views.points)) - views.pixels
        distance = np.linalg.norm(off, axis=-1)[views.visible]
        # corners without a projection count as infinitely far
        score = float(np.median(np.where(np.isfinite(distance), distance, np.inf)))
        if np.isfinite(score):
            scored.append((score, camera, poses))
    scored.sort(key=lambda item: item[0])
    # Refine the best few.
    best: CameraFit | None = None
    for _, camera, poses in scored[: options.starts]:
        settled = settled_poses(camera, views, poses)
        fit = fit_camera(camera, positions(camera, ()), views, settled, options.start_rounds)
        if best is None or _median_residual(fit) < _median_residual(best):
            best = fit
    return best


def extended(fit: CameraFit, views: Views, terms: tuple[str, ...]) -> CameraFit:
    """Fit continued with another set of free coefficients."""
    return fit_camera(fit.camera, positions(fit.camera, terms), views, fit.T_camera_board)


def starting_cameras(
    model: str,
    image_size: tuple[int, int],
    options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS,
) -> Iterator[Camera]:
    """Starting values of a model without distortion: a grid of focal lengths and own fields."""
    width, height = image_size
    kind = camera_models()[model]
    for scale in np.geomspace(*kind.search.focal_range, options.focals):
        for own in kind.search.own:
            parameters = np.zeros(len(kind.parameter_names))
            # with xi the image at the centre is smaller by 1 + xi
            xi = dict(zip(kind.own, own, strict=True)).get("xi", 0.0)
            parameters[FOCAL] = float(scale) * width * (1 + xi)
            parameters[CENTER] = (width - 1) / 2, (height - 1) / 2
            parameters[4 : 4 + len(own)] = own
            yield kind(image_size, parameters)


@dataclass(frozen=True)
class HeldOut:
    """Errors on held-out views.

    residuals : (V, N, 2) px; the pose of each view is fitted, the camera is estimated from other
        views.
    rms : px, of the residuals' lengths.
    by_view : (V,) px, the same by view.
    straightness : px, rms distance of corners from the great circle of their board line, in rays of
        the camera from other views; it depends on no pose.
    """

    residuals: Array
    rms: float
    by_view: Array
    straightness: float


def held_out(
    fit: CameraFit,
    views: Views,
    lines: tuple[tuple[int, ...], ...],
    options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS,
) -> HeldOut:
    """Errors of each part of the views under a camera refitted to the other parts."""
    count = len(fit.T_camera_board)
    inliers = (fit.weight >= INLIER_WEIGHT) & views.visible
    residuals = np.full(views.pixels.shape, np.nan)
    bends: list[Array] = []
    part_of = np.arange(count) % min(options.parts, count)
    for part in range(part_of.max() + 1):
        out = np.flatnonzero(part_of == part)
        # Camera from the other views; poses of this part fitted to it.
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

    pixels : (N, 2) of one view, NaN where not detected.
    lines : ids of corners on straight lines.

    The plane of a line is fitted to its rays, weighted such that distances are in pixels, not in
    angle.
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
        # The normal of the plane is the least eigenvector of the weighted rays.
        for _ in range(3):
            normal = np.linalg.eigh((s * weight[:, None]).T @ s)[1][:, 0]
            slope = np.linalg.norm(np.einsum("nik,i->nk", turn, normal), axis=-1)
            weight = 1 / np.maximum(slope, 1e-12) ** 2
        out.append(dot(s, normal) * np.sqrt(weight))
    return np.concatenate(out) if out else np.zeros(0)


def leave_one_out_residuals(fit: CameraFit, views: Views) -> Array:
    """Residuals (V, N, 2) px of each view under the camera estimated without it, to first order."""
    changes, rows, _ = _jackknife_changes(fit, views)
    change = (rows @ changes[..., None])[..., 0].reshape(*views.visible.shape, 2)
    scale = fit.problem(views).scale[0][..., None]
    return fit.residuals + np.where(scale > 0, change / np.where(scale > 0, scale, 1.0), 0.0)


def spread_of_views(fit: CameraFit, views: Views) -> float:
    """Ratio of the intrinsics' standard deviation by the jackknife over views to that expected of
    the corners' noise.

    Returns 1 if noise explains the sum of squares q of the changes c_v when a view v is left out,
    in standard deviations and about their mean, at the level FALSE_ALARM. With N_v the normal
    matrix of a view, N that of all views and R_v = (N - N_v)^-1 N_v, changes due to noise have the
    covariances, in units of N^-1,

        C_vv = R_v,   C_vw = -R_v R_w,

    because C_vw is (I - P_v)^-1 (d_vw P_v - P_v P_w) (I - P_w)^-1 with P_v = N^-1 N_v. So q has the
    mean tr(C') and the variance 2 tr(C'^2), where C' is C without the mean over views, and about
    the distribution of a multiple of chi-square (F. E. Satterthwaite, 1946). The leverage of single
    views is large where there are few: of 10 simulated views of a pinhole, q has a mean of 1.7
    times the number of intrinsics, and is beyond 3.6 times in one calibration of twenty.
    """
    from scipy.special import chdtri

    changes, rows, normal = _jackknife_changes(fit, views)
    deviation, count = changes - changes.mean(axis=0), len(changes)
    # R_v in whitened intrinsics, in which it is symmetric
    parts = rows @ normal_root(normal, NORMAL_RANK_TOLERANCE, loose=True)
    r = np.stack([inverted(np.eye(len(normal)) - part) @ part for part in parts.mT @ parts])
    # sums over the columns of C, for the mean over views
    total, squares = r.sum(axis=0), r @ r
    sums = r + squares - total @ r
    mean = np.trace(total) - np.trace(sums.sum(axis=0)) / count
    # tr(C'^2), as the sum of all squares
    second = squares.sum(axis=0)
    square = np.trace(second) + np.sum(second**2) - np.sum(squares**2)
    square += np.sum(sums.sum(axis=0) ** 2) / count**2 - 2 * np.sum(sums**2) / count
    q = float(np.trace(normal @ deviation.T @ deviation))
    limit = square / mean * chdtri(mean**2 / square, FALSE_ALARM)
    return float(np.sqrt(q / mean)) if q > limit else 1.0


def _jackknife_changes(fit: CameraFit, views: Views) -> tuple[Array, Array, Array]:
    """Changes of the free intrinsics (V, k) when each view is left out, to first order; the rows
    with poses eliminated (V, r, k); and the normal matrix of all views (k, k).

    With rows A_v and residuals r_v of view v, N_v = A_v^T A_v and N the sum of all N_v, the change
    is (N - N_v)^-1 A_v^T r_v, because the gradient of all views together vanishes.
    """
    linear = fit.problem(views).linearize(fit.state)
    rows = eliminate(linear).rows[0]
    normals = rows.mT @ rows
    whole = normals.sum(axis=0)
    right = rows.mT @ linear.value[0][..., None]
    changes = np.stack([inverted(whole - part) for part in normals]) @ right
    return changes[..., 0], rows, whole


@dataclass(frozen=True)
class Candidate:
    """A model with a set of distortion coefficients, fitted.

    parameters : number of free intrinsics.
    rms : px, root mean square length of the residuals, over the corners in use by the best
        candidate.
    left_out : px, the same for views left out of the fit, to first order.
    robust : px, the same as left_out over all corners, each bounded by the best candidate's noise.
    by_view : (V,) px^2, squares of ``robust`` by view.
    focal_share : standard deviation of the focal lengths, with the views' disagreement, as a share
        of them; the larger one.
    """

    model: str
    terms: tuple[str, ...]
    parameters: int
    rms: float
    left_out: float
    robust: float
    by_view: Array
    focal_share: float
    fit: CameraFit


def camera_candidates(
    views: Views,
    image_size: tuple[int, int],
    models: tuple[str, ...],
    options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS,
) -> tuple[Candidate, ...]:
    """All models with each of their sets of coefficients, fitted; models without a starting value
    are missing.
    """
    fits: list[tuple[str, tuple[str, ...], CameraFit]] = []
    for model in sorted(models, key=CALIBRATED_MODELS.index):
        first = first_fit(model, views, image_size, options=options)
        if first is None:
            continue
        for terms in camera_models()[model].search.terms:
            # A larger set starts from the largest set within it.
            within = (f for m, t, f in reversed(fits) if m == model and {*t} <= {*terms})
            fit = extended(next(within, first), views, terms)
            fits.append((model, terms, fit))
    if not fits:
        return ()
    # Compare all candidates on the same corners, rejected ones included. Each squared residual is
    # bounded by the rejection limit of the best fit, so no model wins by rejecting more.
    sigma = min(_median_residual(fit) for _, _, fit in fits) / MEDIAN_LENGTH
    limit = NO_WEIGHT_DISTANCE**2 * (sigma**2 + views.sigma**2)
    held_out_residuals = [leave_one_out_residuals(fit, views) for _, _, fit in fits]
    bounded = [
        np.minimum(_squares(residuals, views.visible), limit) for residuals in held_out_residuals
    ]
    best = int(np.argmin([np.sum(squares) for squares in bounded]))
    used = (fits[best][2].weight > INLIER_WEIGHT) & views.visible
    pool = [
        Candidate(
            model=model,
            terms=terms,
            parameters=len(fit.free),
            rms=_rms(fit.residuals, used),
            left_out=_rms(residuals, used),
            robust=float(np.sqrt(np.sum(squares) / max(int(views.visible.sum()), 1))),
            by_view=np.sum(squares, axis=1) / np.maximum(views.visible.sum(axis=1), 1),
            focal_share=_focal_share(fit, views),
            fit=fit,
        )
        for (model, terms, fit), residuals, squares in zip(
            fits, held_out_residuals, bounded, strict=True
        )
    ]
    return tuple(sorted(pool, key=lambda c: CALIBRATED_MODELS.index(c.model)))


def best_of(
    pool: tuple[Candidate, ...], options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS
) -> Candidate:
    """Simplest candidate among those not significantly worse than the best: a model without fields
    of its own (xi, alpha, beta) before one with them, then the one with the fewest parameters.

    On a narrow lens xi replaces k1 and k2, but the data determine it only together with the focal
    length, which may then be several times the lens's. Candidates whose focal length the views do
    not determine are therefore compared only if the others leave out more than the noise.
    """
    best = min(pool, key=lambda c: c.robust)
    determined = [c for c in pool if c.focal_share <= options.least_sure]
    if determined:
        surest = min(determined, key=lambda c: c.robust)
        # squares of errors add up: the noise, and as much again
        if surest.robust**2 <= 2 * best.robust**2:
            pool, best = tuple(determined), surest
    return min(
        (c for c in pool if not is_worse(c, best, options=options)),
        key=lambda c: (bool(c.fit.camera.own), c.parameters),
    )


def is_worse(
    candidate: Candidate, best: Candidate, options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS
) -> bool:
    """Whether held-out views favour ``best`` significantly: by the least gain, and by more
    than the standard error of the difference over the views.
    """
    if candidate.robust <= best.robust * (1 + options.least_gain):
        return False
    gain = candidate.by_view - best.by_view
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.mean() > error)


def fitted_to_all(chosen: Candidate, views: Views) -> CameraFit:
    """Fit of a candidate continued with all corners."""
    fit = chosen.fit
    return fit_camera(fit.camera, fit.free, views, fit.T_camera_board)


def thinned(views: Views, options: ModelSelectionOptions = MODEL_SELECTION_OPTIONS) -> Views:
    """Views with about the most corners in all, spread over the board."""
    total = int(views.visible.sum())
    if total <= options.most_corners:
        return views
    # One random set of corners for all views keeps arrays small and has no pattern of rows.
    order = np.random.default_rng(0).permutation(len(views.points))
    used = order[: max(len(order) * options.most_corners // total, options.least_of_view)]
    for visible in views.visible:
        mine = order[visible[order]]
        used = np.union1d(used, mine[: options.least_of_view])
    return Views(views.points[used], views.pixels[:, used], views.sigma[:, used])


def _focal_share(fit: CameraFit, views: Views) -> float:
    """Standard deviation of the focal lengths as a share of them, the larger one."""
    variance = np.diag(covariance_of(fit, views)[0])[FOCAL] * spread_of_views(fit, views) ** 2
    return float(np.max(np.sqrt(variance) / fit.camera.focal))


def _median_residual(fit: CameraFit) -> float:
    """Median length of the residuals, px."""
    return float(np.nanmedian(np.linalg.norm(fit.residuals, axis=-1)))


def _squares(off: Array, counted: Booleans) -> Array:
    """Squared lengths (V, N) of residuals (V, N, 2); 0 for corners that do not count."""
    return np.where(counted, np.sum(np.nan_to_num(off) ** 2, axis=-1), 0.0)


def _rms(off: Array, counted: Booleans) -> float:
    """Root mean square length of the residuals that count."""
    return float(np.sqrt(_squares(off, counted).sum() / max(int(counted.sum()), 1)))
