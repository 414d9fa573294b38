"""Camera calibration from images of a board, with checks of the images and of the result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.board import Board, Detection
from pkmcal.boards.detect import detect_boards
from pkmcal.boards.fit import (
    CAMERA_FIT_OPTIONS,
    CameraFit,
    CameraFitOptions,
    Views,
    check_numbering,
    covariance_of,
    fit_camera,
    views_of,
)
from pkmcal.boards.shape import BoardDeviation, bend_of, board_columns, deviation, rows_of
from pkmcal.camera_calibration.model_selection import (
    CALIBRATED_MODELS,
    MODEL_SELECTION_OPTIONS,
    Candidate,
    HeldOut,
    ModelSelectionOptions,
    best_of,
    camera_candidates,
    fitted_to_all,
    held_out,
    is_worse,
    spread_of_views,
    thinned,
)
from pkmcal.camera_calibration.uncertainty import (
    BoardMotion,
    board_motion,
    largest_sigma,
    pixel_grid,
    projection_covariance,
)
from pkmcal.cameras.contract import Camera
from pkmcal.errors import InputError, ResultError
from pkmcal.files import closest, json_value
from pkmcal.geometry.rigid import apply, dot
from pkmcal.levels import (
    FALSE_ALARM,
    INSEPARABLE_CORRELATION,
    MAJORITY,
    NEGLIGIBLE,
    UNEXPLAINED_SCALE,
)
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import listed, percentage


@dataclass(frozen=True)
class CalibrationCheckOptions:
    """Thresholds of the checks of a camera calibration."""

    # fewest images that show the board: each gives two equations for the five intrinsics of a
    # camera without distortion (Z. Zhang, 2000)
    least_views: int = 3
    # number of images below which a warning is given. Of a simulated pinhole with 54 corners of 0.1
    # px and tilts up to 30 degrees (12 seeds), the focal length has a standard deviation of 0.2 %
    # with 3 images, 0.1 % with 6 and 0.07 % with 12
    good_views: int = 6
    # ratio of held-out errors above which a model named by the user is refused; a smaller
    # significant ratio gives a warning
    unfit_ratio: float = UNEXPLAINED_SCALE
    # largest share of rejected corners. Their noise is estimated from the better half of all
    # corners, which does not represent the rest if its errors are of another kind. Not checked
    # within a factor of two
    most_lost: float = 0.25
    # ratio of a view's held-out error to the median of all views above which the model does not
    # explain the view
    outlying_view: float = UNEXPLAINED_SCALE
    # tilt of a board in degrees below which views all have the same information on the focal
    # length, which is little: in the same simulation of 6 images, a standard deviation of 1 % up to
    # 7.5 degrees, 0.3 % up to 15 and 0.1 % up to 30
    facing_tilt: float = 15.0
    # most steps in which a board's bend and the rest are estimated in turn; two or three suffice
    bend_steps: int = 10
    # columns and rows of cells by which the coverage of the image is counted
    cells: tuple[int, int] = (8, 6)
    # share of cells with corners below which a warning is given
    least_covered: float = MAJORITY
    # selection of the model, and fit of its candidates
    selection: ModelSelectionOptions = MODEL_SELECTION_OPTIONS
    fit: CameraFitOptions = CAMERA_FIT_OPTIONS


CALIBRATION_CHECK_OPTIONS = CalibrationCheckOptions()
UNCERTAINTY_CELLS = (32, 24)
"""Columns and rows of cells in which the projection's uncertainty is computed."""


@dataclass(frozen=True)
class CameraCalibration:
    """Calibrated camera with its uncertainty and the data used.

    terms : estimated distortion coefficients.
    covariance : (n, n) of the intrinsics, zero for those not estimated.
    spread : factor on the corners' noise by which views disagree, contained in the covariance.
    views : names of the V images used.
    T_camera_board : (V, 4, 4) m.
    pose_covariance : (V, 6, 6), left perturbation, with the intrinsics' uncertainty.
    motion : mean motion of the boards, for the projection's uncertainty.
    pixels : (V, N, 2) detected corners, NaN where not detected.
    residuals : (V, N, 2) px, predicted minus detected.
    weight : (V, N) IRLS weights, 0 to 1.
    noise : px, corners' noise beyond their own sigma, per coordinate.
    rms, held_out : px, root mean square of the residuals' lengths, on the views used, and on views
        held out of the estimate of the camera (their poses are fitted).
    compared : all candidate models and sets of coefficients.
    bend : estimated bend of the board; None if it is taken to be flat.
    deviations : of the board from its file, tested only.
    distance : m, of the projection's uncertainty that is not at infinity.
    """

    camera: Camera
    terms: tuple[str, ...]
    covariance: Array
    spread: float
    views: tuple[str, ...]
    T_camera_board: Array
    pose_covariance: Array
    motion: BoardMotion
    pixels: Array
    residuals: Array
    weight: Array
    noise: float
    rms: float
    held_out: HeldOut
    compared: tuple[Candidate, ...]
    board: Board
    detections: tuple[Detection, ...]
    bend: BoardDeviation | None
    deviations: tuple[BoardDeviation, ...]
    distance: float
    findings: tuple[Finding, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings."""
        return tuple(one.text for one in self.findings)

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,) of the intrinsics, 0 for those not estimated."""
        return np.sqrt(np.diag(self.covariance))

    def projection_sigma(self, pixels: Array, distance: float = np.inf) -> Array:
        """Standard deviation (...) px of the pixels of fixed points, in the worst direction.

        pixels : (..., 2). distance : m, of the points from the camera. NaN for pixels without a
        ray.
        """
        return largest_sigma(
            projection_covariance(self.camera, self.covariance, self.motion, pixels, distance)
        )

    def projection_map(self, distance: float) -> Array:
        """``projection_sigma`` in the middles of the image's cells, (rows, columns)."""
        return self.projection_sigma(
            pixel_grid(self.camera.image_size, UNCERTAINTY_CELLS), distance
        )

    @property
    def inliers(self) -> Booleans:
        """Whether corners (V, N) are in use: detected, with a weight of at least one half."""
        return np.isfinite(self.residuals).all(axis=-1) & (self.weight >= INLIER_WEIGHT)

    @property
    def correlations(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of intrinsics with a strong correlation, the strongest first."""
        sigma = np.where(self.sigma > 0, self.sigma, 1.0)
        rho = self.covariance / sigma / sigma[:, None]
        names = self.camera.parameter_names
        pairs = [
            (names[i], names[j], float(rho[i, j]))
            for i in range(len(names))
            for j in range(i + 1, len(names))
            if abs(rho[i, j]) >= INSEPARABLE_CORRELATION
        ]
        return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))

    def correlated_with(self, name: str) -> list[str]:
        """Intrinsics that are determined only together with ``name``, with the correlations."""
        pairs = [pair for pair in self.correlations if name in pair]
        return [f"{a if b == name else b} ({rho:+.3f})" for a, b, rho in pairs]

    def as_dict(self) -> dict[str, Any]:
        """Calibration as plain data for JSON, with the camera as in its file."""
        names = self.camera.parameter_names
        return {
            "camera": self.camera.document(),
            "parameters": [
                {"name": name, "value": value, "sigma": sigma, "estimated": sigma > 0}
                for name, value, sigma in zip(
                    names, self.camera.parameters.tolist(), self.sigma.tolist(), strict=True
                )
            ],
            "covariance": self.covariance.tolist(),
            "projection_sigma": [
                {
                    "distance": distance,
                    "sigma": json_value(self.projection_map(distance or np.inf)),
                }
                for distance in (None, self.distance)
            ],
            "views_disagree_by": self.spread,
            "rms": self.rms,
            "held_out_rms": self.held_out.rms,
            "straightness": self.held_out.straightness,
            "corner_noise": self.noise,
            "correlations": [list(pair) for pair in self.correlations],
            "compared": [
                {"model": c.model, "terms": list(c.terms), "rms": c.rms, "left_out_rms": c.left_out}
                for c in self.compared
            ],
            "views": [
                {
                    "photograph": name,
                    "T_camera_board": self.T_camera_board[v].tolist(),
                    "covariance": self.pose_covariance[v].tolist(),
                    "held_out_rms": float(self.held_out.by_view[v]),
                }
                for v, name in enumerate(self.views)
            ],
            "not_used": {d.name: d.reason for d in self.detections if not d.success},
            "board": self.board.document,
            "board_bend": None if self.bend is None else _deviation_document(self.bend),
            "board_deviations": {one.code: _deviation_document(one) for one in self.deviations},
            "warnings": list(self.warnings),
            "findings": [one.document() for one in self.findings],
        }


def calibrate_images(
    paths: Sequence[Path | str],
    board: Board,
    model: str = "auto",
    progress: Progress = no_progress,
    distance: float | None = None,
    *,
    bend: bool = False,
) -> CameraCalibration:
    """Detect the board in images of one size and calibrate their camera."""
    _check_model_name(model)
    detections = detect_boards(paths, board, progress=part(progress, 0, 0.6))
    progress("Calibrating the camera", 0.6)
    return calibrate_camera(detections, board, model, distance=distance, bend=bend)


def calibrate_camera(
    detections: Sequence[Detection],
    board: Board,
    model: str = "auto",
    options: CalibrationCheckOptions = CALIBRATION_CHECK_OPTIONS,
    distance: float | None = None,
    *,
    bend: bool = False,
) -> CameraCalibration:
    """Calibrate a camera from detected corners.

    model : a camera model's name, or auto. distance : m, of points whose projection's uncertainty
    is computed; by default the median of the boards' middles. bend : estimate the board's bend.
    Raises `InputError` if the views are too few or `model` does not fit, and `ResultError` if the
    views do not determine the camera.
    """
    _check_model_name(model)
    used = [detection for detection in detections if detection.success]
    check_enough(used, len(detections), options=options)
    image_size = used[0].image_size
    views = views_of(used, board)
    selection, bent = options.selection, None
    pool, chosen, fit = _selected_fit(views, image_size, model, selection)
    if bend:
        fit, views, bent = _bent_board(fit, views, board, None, options)
        # The bend hides coefficients of the lens, which are selected again.
        pool, chosen, fit = _selected_fit(views, image_size, model, selection)
        fit, views, bent = _bent_board(fit, views, board, bent, options)
    model_warnings = check_model(model, chosen, best_of(pool, selection), options=options)
    check_corners(fit, views, board, options=options)
    # Covariance, scaled by the disagreement of the views.
    beside = rows_of(fit, views, bend_of(board)) if bend else None
    by_noise, poses_by_noise, by_intrinsics = covariance_of(fit, views, beside)
    spread = spread_of_views(fit, views)
    covariance = by_noise * spread**2
    check_determined(fit, covariance, views, options=options)
    # Test on held-out views.
    tested = held_out(fit, views, board.lines, selection)
    check_explained(tested.rms, fit.camera, options)
    inliers = (fit.weight >= INLIER_WEIGHT) & views.visible
    lengths = np.sum(np.nan_to_num(fit.residuals) ** 2, axis=-1)
    deviations = tuple(
        deviation(fit, views, column)
        for column in board_columns(board)
        if not (bend and column.code == "bend")
    )
    middles = apply(fit.T_camera_board, views.points.mean(axis=0))
    calibration = CameraCalibration(
        camera=replace(fit.camera, covariance=covariance),
        terms=chosen.terms,
        covariance=covariance,
        spread=spread,
        views=tuple(detection.name for detection in used),
        T_camera_board=fit.T_camera_board,
        pose_covariance=poses_by_noise * spread**2,
        motion=board_motion(
            fit.T_camera_board, poses_by_noise * spread**2, by_intrinsics, covariance
        ),
        pixels=views.pixels,
        residuals=fit.residuals,
        weight=fit.weight,
        noise=fit.tau,
        rms=float(np.sqrt(lengths[inliers].mean())),
        held_out=tested,
        compared=pool,
        board=board,
        detections=tuple(detections),
        bend=bent,
        deviations=deviations,
        distance=distance or float(np.median(np.linalg.norm(middles, axis=-1))),
        findings=(),
    )
    return replace(
        calibration, findings=(*model_warnings, *calibration_findings(calibration, options=options))
    )


def _deviation_document(one: BoardDeviation) -> dict[str, Any]:
    """Amplitudes of a board's deviation as plain data, m, or relative for a stretch."""
    sigma = np.sqrt(np.diag(one.covariance))
    return {"value": one.value.tolist(), "sigma": sigma.tolist(), "chance": one.chance}


def _selected_fit(
    views: Views, image_size: tuple[int, int], model: str, options: ModelSelectionOptions
) -> tuple[tuple[Candidate, ...], Candidate, CameraFit]:
    """All candidates and the selected one, on a subset of the corners, and its fit to all corners.

    Raises InputError if a named model has no fit.
    """
    pool = camera_candidates(thinned(views, options), image_size, options.models, options)
    mine = tuple(c for c in pool if model in ("auto", c.model))
    if not mine:
        raise no_fit(model, pool)
    chosen = best_of(mine, options)
    return pool, chosen, fitted_to_all(chosen, views)


def _bent_board(
    fit: CameraFit,
    views: Views,
    board: Board,
    before: BoardDeviation | None,
    options: CalibrationCheckOptions,
) -> tuple[CameraFit, Views, BoardDeviation]:
    """Fit with the board's bend, which is estimated in turn with the rest.

    before : the bend of ``views.points``; None for a flat board.
    """
    column, value = bend_of(board), np.zeros(2) if before is None else before.value
    step = deviation(fit, views, column)
    for _ in range(options.bend_steps):
        value = value + step.value
        points = board.points + np.tensordot(value, column.displacement, axes=1)
        views = views._replace(points=points)
        fit = fit_camera(fit.camera, fit.free, views, fit.T_camera_board)
        step = deviation(fit, views, column)
        if np.all(np.abs(step.value) < NEGLIGIBLE * np.sqrt(np.diag(step.covariance))):
            break
    return fit, views, step._replace(value=value)


def _check_model_name(model: str) -> None:
    """Raise InputError for an unknown camera model."""
    models = ("auto", *CALIBRATED_MODELS)
    if model not in models:
        raise InputError(
            "no such camera model",
            found=model,
            expected=closest(model, models) or listed(models),
        )


def _deviation_findings(c: CameraCalibration) -> Iterator[Finding]:
    """Warnings about a board that deviates from its file."""
    for one in c.deviations:
        if one.chance < FALSE_ALARM / len(c.deviations):
            largest = int(np.argmax(np.abs(one.value)))
            yield doubtful(
                f"lens.board_{one.code}",
                value=float(one.value[largest]),
                sigma=float(np.sqrt(one.covariance[largest, largest])),
                focal_shift=float(np.mean(one.focal_shift)),
            )


def check_enough(
    used: Sequence[Any], taken: int, options: CalibrationCheckOptions = CALIBRATION_CHECK_OPTIONS
) -> None:
    """Raise `InputError` if too few images show the board."""
    if len(used) < options.least_views:
        raise InputError(
            "too few images show the board",
            found=f"{len(used)} of {taken}",
            expected=f"{options.least_views} at least, better ten,"
            " with the board tilted differently",
            code="lens.too_few_views",
        )


def no_fit(model: str, pool: tuple[Candidate, ...]) -> InputError:
    """Error about a model for which no starting value gives finite pixels."""
    other = min(pool, key=lambda c: c.left_out) if pool else None
    return InputError(
        f"the model {model} does not fit the images",
        expected=f"{other.model}, which predicts views left out to {other.left_out:.2g} px"
        if other
        else "images of one flat board by one camera",
        code="lens.model_misfit",
    )


def check_model(
    model: str,
    chosen: Candidate,
    best: Candidate,
    options: CalibrationCheckOptions = CALIBRATION_CHECK_OPTIONS,
) -> list[Finding]:
    """Warnings about a model chosen by the user that is worse than another; raises `InputError` if
    it does not fit.
    """
    if (
        model == "auto"
        or best.model == chosen.model
        or not is_worse(chosen, best, options.selection)
    ):
        return []
    ratio = chosen.left_out / best.left_out
    if ratio > options.unfit_ratio:
        raise InputError(
            f"the model {model} does not fit the images",
            found=f"an error of {chosen.left_out:.2g} px on views left out",
            expected=f"{best.model}, with {best.left_out:.2g} px",
            code="lens.model_misfit",
        )
    return [
        doubtful(
            "lens.other_model",
            best.model,
            model=model,
            rms=best.left_out,
            own_rms=chosen.left_out,
        )
    ]


def check_determined(
    fit: CameraFit,
    covariance: Array,
    views: Views,
    options: CalibrationCheckOptions = CALIBRATION_CHECK_OPTIONS,
) -> None:
    """Raise `ResultError` if the views do not determine the focal length."""
    names = fit.camera.parameter_names
    mine = [names.index("focal.x"), names.index("focal.y")]
    if "xi" in names:
        # Pixels per radian at the centre, f / (1 + xi); f and xi alone are correlated.
        xi = names.index("xi")
        by = np.zeros((2, len(names)))
        by[[0, 1], mine] = 1.0
        by[:, xi] = -fit.camera.parameters[mine] / (1 + fit.camera.parameters[xi])
        sigma = np.sqrt(np.diag(by @ covariance @ by.T))
    else:
        sigma = np.sqrt(np.diag(covariance))[mine]
    share = float(np.max(sigma / fit.camera.parameters[mine]))
    if share <= options.selection.least_sure and np.isfinite(share):
        return
    tilt = tilts(fit.T_camera_board, views.points)
    raise ResultError(
        "the images do not determine the focal length, because the board looks much the same in"
        " all of them",
        found=f"a standard deviation of {100 * min(share, 9.99):.0f} % of it, with the board"
        f" tilted by {tilt.min():.0f} to {tilt.max():.0f} degrees",
        next_step="Take images with the board tilted by 20 to 45 degrees, each to another"
        " side, and near the picture's corners",
        code="lens.focal_unidentifiable",
    )


def check_corners(
    fit: CameraFit,
    views: Views,
    board: Board,
    options: CalibrationCheckOptions = CALIBRATION_CHECK_OPTIONS,
) -> None:
    """Raise `InputError` if the corners contradict the board file, and `ResultError` if too many
    corners are rejected.
    """
    check_numbering(fit.residuals, views.pixels, board, "the board file", options.fit)
    visible = views.visible
    rejected = 1 - float((visible & (fit.weight >= INLIER_WEIGHT)).sum()) / max(
        int(visible.sum()), 1
    )
    if rejected <= options.most_lost:
        return
    raise ResultError(
        "too many of the board's corners do not fit the rest",
        found=f"{percentage(rejected)} of them ({fit.camera.model} fits best)",
        expected=f"{percentage(options.most_lost)} at most",
        next_step="Look for a bent board, a wrong board file, motion blur, or a zoom or focus that"
        " moved",
        code="lens.too_many_rejected",
    )


def check_explained(rms: float, camera: Camera, options: CalibrationCheckOptions) -> None:
    """Raise `ResultError` if the best model does not explain the images."""
    limit = options.fit.residual_limit * camera.image_size[0]
    if rms <= limit:
        return
    raise ResultError(
        "no camera model explains these images",
        found=f"an error of {rms:.2g} px on views left out ({camera.model} fits best)",
        expected=f"{limit:.2g} px at most, usually a tenth of that",
        next_step="Look for a bent board, a wrong board file, a zoom or focus that moved, or"
        " images of two cameras",
        code="lens.no_model_fits",
    )


def tilts(T_camera_board: Array, points: Array) -> Array:
    """Angles (V,) in degrees between the board's normal and the line of sight to its centre."""
    middle = T_camera_board[:, :3, :3] @ points.mean(axis=0) + T_camera_board[:, :3, 3]
    normal = T_camera_board[:, :3, 2]
    across = np.linalg.norm(np.cross(normal, middle), axis=-1)
    return np.rad2deg(np.arctan2(across, np.abs(dot(normal, middle))))


def cell_numbers(pixels: Array, image_size: tuple[int, int], cells: tuple[int, int]) -> Integers:
    """Number (n,) of the cell of each of the pixels (n, 2), row by row.

    cells : columns and rows. Pixels outside the image count to the nearest cell.
    """
    at = np.floor((pixels + 0.5) / image_size * cells).astype(int)
    column, row = np.clip(at, 0, np.array(cells) - 1).T
    return row * cells[0] + column


def coverage(pixels: Array, image_size: tuple[int, int], cells: tuple[int, int]) -> Integers:
    """Number of corners in each cell of the image, (rows, columns). cells : columns and rows."""
    flat = pixels[np.isfinite(pixels).all(axis=-1)]
    counts = np.bincount(cell_numbers(flat, image_size, cells), minlength=cells[0] * cells[1])
    return counts.reshape(cells[::-1])


def calibration_findings(
    calibration: CameraCalibration, options: CalibrationCheckOptions = CALIBRATION_CHECK_OPTIONS
) -> Iterator[Finding]:
    """Warnings about a usable camera calibration."""
    c = calibration
    missed = [f"{d.name} ({d.reason})" for d in c.detections if not d.success]
    if missed:
        yield doubtful("lens.unused", number=len(missed), of=len(c.detections), names=missed)
    if len(c.views) < options.good_views:
        yield doubtful("lens.few_views", number=len(c.views))
    mirrored = [d.name for d in c.detections if d.mirrored]
    if mirrored and len(mirrored) < sum(d.success for d in c.detections):
        yield doubtful("lens.some_mirrored", listed(mirrored), names=mirrored)
    elif mirrored:
        yield doubtful("lens.all_mirrored", number=len(mirrored), first=mirrored[0])
    yield from _deviation_findings(c)
    if c.spread > 1:
        yield doubtful("lens.views_disagree", scale=c.spread)
    most = float(tilts(c.T_camera_board, c.board.points).max())
    if most < options.facing_tilt:
        yield doubtful("lens.little_tilt", degrees=most)
    covered = float(np.mean(coverage(c.pixels, c.camera.image_size, options.cells) > 0))
    if covered < options.least_covered:
        yield doubtful("lens.little_covered", percent=100 * covered)
    finite = np.isfinite(c.residuals).all(axis=-1)
    rejected = int((finite & ~c.inliers).sum())
    if rejected:
        yield doubtful("lens.rejected_corners", number=rejected, of=int(finite.sum()))
    middle = float(np.median(c.held_out.by_view))
    for name, rms in zip(c.views, c.held_out.by_view.tolist(), strict=True):
        if rms > options.outlying_view * middle:
            yield doubtful("lens.odd_view", name, scale=rms / middle)
    tied = {name: c.correlated_with(name) for name in c.camera.own}
    yield from (
        doubtful("lens.own_correlated", name, others=others)
        for name, others in tied.items()
        if others
    )
