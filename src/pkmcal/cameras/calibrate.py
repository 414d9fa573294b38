"""Calibration of a camera from photographs of a board: pinhole, fisheye or mirror, told by itself.

    calibration = calibrate_photographs(paths, load_board("board.yaml"))
    save_camera(calibration.camera, "camera.yaml")

The covariance says how much the intrinsics would scatter if other photographs of this kind were
taken. It is that of the corners' noise, widened where the views disagree by more than that noise
(a bent board, a lens that the model does not describe).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras import calibration_checks as checks
from pkmcal.cameras.choose import (
    TERMS,
    Candidate,
    best_of,
    candidates,
    fitted_to_all,
    thinned,
)
from pkmcal.cameras.contract import Camera
from pkmcal.cameras.fit import Fit, Views, covariance_of
from pkmcal.cameras.heldout import HeldOut, held_out, spread_of_views
from pkmcal.errors import InputError
from pkmcal.files import closest, listed

if TYPE_CHECKING:
    from pkmcal.observe.boards import Board, Detection

STRONG = 0.95
"""Correlation from which two intrinsics are named as hardly told apart."""


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera, how sure it is, and what it was found from.

    terms : distortion parameters that were estimated. covariance : (n, n) of the intrinsics,
        zero where not estimated. spread : factor on the corners' noise by which views disagree,
        contained in the covariance.
    views : names of the V photographs used. T_camera_board : (V, 4, 4) m.
    pose_covariance : (V, 6, 6), left perturbation, with the intrinsics' share.
    pixels : (V, N, 2) corners seen, NaN where not. residuals : (V, N, 2) px, predicted minus seen.
    weight : (V, N); corners far off count less, down to 0.
    rms, held_out : px, root mean square of the residual's length, on the views used and on views
        that the camera was not fitted to (their poses are). noise : px, corners' noise beyond
        their own sigma, a coordinate.
    compared : every model and set of terms that was tried.
    """

    camera: Camera
    terms: tuple[str, ...]
    covariance: Array
    spread: float
    views: tuple[str, ...]
    T_camera_board: Array
    pose_covariance: Array
    pixels: Array
    residuals: Array
    weight: Array
    noise: float
    rms: float
    held_out: HeldOut
    compared: tuple[Candidate, ...]
    board: Board
    detections: tuple[Detection, ...]
    warnings: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """Standard deviations of the intrinsics (n,), 0 where not estimated."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def kept(self) -> Booleans:
        """(V, N) corners in use: seen, and with at least half their weight."""
        return np.isfinite(self.residuals).all(axis=-1) & (self.weight >= 0.5)

    @property
    def correlations(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of intrinsics that are hardly told apart, the strongest first."""
        sigma = np.where(self.sigma > 0, self.sigma, 1.0)
        rho = self.covariance / sigma / sigma[:, None]
        names = self.camera.parameter_names
        pairs = [
            (names[i], names[j], float(rho[i, j]))
            for i in range(len(names))
            for j in range(i + 1, len(names))
            if abs(rho[i, j]) >= STRONG
        ]
        return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))

    def document(self) -> dict[str, Any]:
        """Everything in plain data, for JSON; the camera as its file has it."""
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
            "not_used": {d.name: d.reason for d in self.detections if not d.found},
            "board": self.board.document,
            "warnings": list(self.warnings),
        }


def calibrate_photographs(
    paths: Sequence[Path | str], board: Board, model: str = "auto"
) -> CameraCalibration:
    """Find the board in photographs of one size and calibrate the camera that took them."""
    from pkmcal.observe.boards import detect_boards

    _check_model(model)
    return calibrate_camera(detect_boards(paths, board), board, model)


def calibrate_camera(
    detections: Sequence[Detection], board: Board, model: str = "auto"
) -> CameraCalibration:
    """Calibrate from corners that were found. model : pinhole, fisheye, unified, or auto.

    Raises `InputError` where the views are too few or `model` does not fit, and `ResultError`
    where the views do not determine the camera.
    """
    _check_model(model)
    used = [detection for detection in detections if detection.found]
    checks.check_enough(used, len(detections))
    image_size = used[0].image_size
    views = views_of(used, board)
    pool = candidates(thinned(views), image_size, tuple(TERMS))
    mine = tuple(c for c in pool if model in ("auto", c.model))
    if not mine:
        raise checks.no_fit(model, pool)
    chosen, best = best_of(mine), best_of(pool)
    doubt = checks.check_model(model, chosen, best)
    fit = fitted_to_all(chosen, views)
    return _calibration(fit, chosen, pool, views, board, tuple(detections), doubt)


def views_of(detections: Sequence[Detection], board: Board) -> Views:
    """Detections as arrays."""
    shape = len(detections), len(board.points)
    pixels, sigma = np.full((*shape, 2), np.nan), np.zeros(shape)
    for v, detection in enumerate(detections):
        pixels[v, detection.ids] = detection.pixels
        sigma[v, detection.ids] = detection.sigma
    return Views(board.points, pixels, sigma)


def _calibration(
    fit: Fit,
    chosen: Candidate,
    pool: tuple[Candidate, ...],
    views: Views,
    board: Board,
    detections: tuple[Detection, ...],
    doubt: list[str],
) -> CameraCalibration:
    names = tuple(d.name for d in detections if d.found)
    by_noise, poses_by_noise, _ = covariance_of(fit, views)
    spread = spread_of_views(fit, views)
    covariance = by_noise * spread**2
    checks.check_determined(fit, covariance, views)
    tested = held_out(fit, views, board.lines)
    checks.check_explained(tested.rms, fit.camera)
    kept = (fit.weight >= 0.5) & views.seen
    lengths = np.sum(np.nan_to_num(fit.residuals) ** 2, axis=-1)
    calibration = CameraCalibration(
        camera=replace(fit.camera, covariance=covariance),
        terms=chosen.terms,
        covariance=covariance,
        spread=spread,
        views=names,
        T_camera_board=fit.T_camera_board,
        pose_covariance=poses_by_noise * spread**2,
        pixels=views.pixels,
        residuals=fit.residuals,
        weight=fit.weight,
        noise=fit.tau,
        rms=float(np.sqrt(lengths[kept].mean())),
        held_out=tested,
        compared=pool,
        board=board,
        detections=detections,
        warnings=(),
    )
    return replace(calibration, warnings=(*doubt, *checks.warnings_of(calibration)))


def _check_model(model: str) -> None:
    known = ("auto", *TERMS)
    if model not in known:
        raise InputError(
            "no such camera model",
            found=model,
            expected=closest(model, known) or listed(known),
        )
