"""Difference between two cameras: pixels of the same far points, after the best rotation.

A calibration determines a camera only up to a rotation of its frame: a shift of the principal point
is almost a rotation of the camera. So the rays of A are rotated such that their pixels in B differ
least from those in A.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.camera_calibration.uncertainty import largest_sigma, pixel_grid
from pkmcal.cameras.contract import Camera
from pkmcal.cameras.files import load_camera
from pkmcal.errors import InputError
from pkmcal.files import json_value
from pkmcal.geometry.rigid import rotation, rotation_vector, skew
from pkmcal.judge.changes import CHANGE_ALPHA
from pkmcal.judge.difference import DIFFERENCE_FORMAT
from pkmcal.levels import NEGLIGIBLE, ROUNDING
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, note, wrong
from pkmcal.wording import brief

CAMERA_CELLS = (32, 24)
"""Columns and rows of cells in which two cameras are compared."""
ROTATION_STEPS = 50
"""Maximum number of Gauss-Newton steps for the best rotation; two or three suffice for equal
lenses."""

LEAST_MODE = NEGLIGIBLE
"""Standard deviation of a mode of the difference, as a share of the largest, below which changes of
second order exceed it.

On 300 new pairs of simulated calibrations each, 3 (pinhole) and 2 (fisheye) had a p-value below
0.01, and all 600 changes of one parameter by eight standard deviations were detected; figures are
the same with a half and with twice the share.
"""


@dataclass(frozen=True)
class ComparedCamera:
    """One of the two cameras. name : as given."""

    name: str
    camera: Camera


@dataclass(frozen=True)
class CameraDifference:
    """Difference between two cameras.

    rotation : (3, 3) from A's rays to B's frame.
    pixels : (rows, columns, 2) of A, middles of cells.
    difference : (rows, columns, 2) px, B's pixel minus A's; NaN where one has no ray.
    sigma : (rows, columns) px, standard deviation of the difference in the worst direction; None if
        neither file has a covariance.
    chance : p-value of the difference; None without sigma.
    """

    a: ComparedCamera
    b: ComparedCamera
    rotation: Array
    pixels: Array
    difference: Array
    sigma: Array | None
    chance: float | None
    changed: bool
    verdict: Verdict

    __repr__ = short_repr

    @property
    def lengths(self) -> Array:
        """Length of the difference (rows, columns), px."""
        return np.linalg.norm(self.difference, axis=-1)

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON: px and rad."""
        return json_value(
            {
                "pkmcal_diff": DIFFERENCE_FORMAT,
                "verdict": self.verdict.document(),
                "changed": self.changed,
                "cameras": [
                    {"name": one.name, "camera": one.camera.document()} for one in (self.a, self.b)
                ],
                "rotation": rotation_vector(self.rotation),
                "pixels": self.pixels,
                "difference": self.difference,
                "sigma": self.sigma,
                "chance": self.chance,
            }
        )


def camera_difference(a: Camera | Path | str, b: Camera | Path | str) -> CameraDifference:
    """Compare two cameras of images of one size.

    Raises InputError if their images have different sizes, or no ray of A has a pixel in B.
    """
    one, other = _compared(a), _compared(b)
    if tuple(one.camera.image_size) != tuple(other.camera.image_size):
        raise InputError(
            "the two cameras have images of different sizes",
            where=other.name,
            found=f"{other.camera.image_size[0]} x {other.camera.image_size[1]}",
            expected=f"{one.camera.image_size[0]} x {one.camera.image_size[1]}, as in {one.name}",
            next_step="Compare calibrations from images of one size",
            code="difference.image_sizes",
        )
    pixels = pixel_grid(one.camera.image_size, CAMERA_CELLS)
    rays = one.camera.ray(pixels)
    both = np.asarray(np.isfinite(rays + other.camera.project(rays)[..., :1]).all(axis=-1))
    if not both.any():
        raise InputError(
            "the two cameras have no direction in common",
            where=other.name,
            found="no direction with a pixel in both",
            expected=f"a camera whose field overlaps that of {one.name}",
            next_step="Check the two camera files",
        )
    # Weight of each cell by the standard deviation of its pixels, equal without covariances.
    spread = _spread(one.camera, other.camera, pixels[both], rays[both], np.eye(3))
    sigma_each = np.sqrt(np.sum(spread**2, axis=(-1, -2)) / 2)
    floor = NEGLIGIBLE * float(np.median(sigma_each))
    weight = 1 / np.maximum(sigma_each, floor) if floor > 0 else np.ones(len(spread))
    R = best_rotation(other.camera, rays[both], pixels[both], weight)
    # Cells whose rotated rays B does not see are left out.
    visible = np.isfinite(other.camera.project(rays[both] @ R.T)).all(axis=-1)
    both[both], weight = visible, weight[visible]
    rotated = rays[both] @ R.T
    off = other.camera.project(rotated) - pixels[both]
    difference = np.full(pixels.shape, np.nan)
    difference[both] = off
    sigma, chance = None, None
    if floor > 0:
        spread = _spread(one.camera, other.camera, pixels[both], rays[both], R)
        # projected orthogonally to the effect of a rotation
        w = weight[:, None, None]
        basis = np.linalg.qr((w * _by_rotation(other.camera, rotated)).reshape(-1, 3))[0]
        flat = (w * spread).reshape(-1, spread.shape[-1])
        spread = (flat - basis @ (basis.T @ flat)).reshape(spread.shape) / w
        sigma = np.full(pixels.shape[:-1], np.nan)
        sigma[both] = largest_sigma(spread @ spread.mT)
        chance = _p_value(off, spread, weight)
    largest = float(np.linalg.norm(off, axis=-1).max())
    changed = chance < CHANGE_ALPHA if chance is not None else largest > ROUNDING
    out = CameraDifference(
        one, other, R, pixels, difference, sigma, chance, bool(changed), Verdict(True, "")
    )
    return _with_verdict(out, largest)


def best_rotation(camera: Camera, rays: Array, pixels: Array, weight: Array) -> Array:
    """Rotation (3, 3) after which rays (n, 3) have pixels (n, 2) in a camera, by least squares.

    weight : (n,) inverse standard deviations.
    """
    R = np.eye(3)
    for _ in range(ROTATION_STEPS):
        turned = rays @ R.T
        by_rotation, off = _by_rotation(camera, turned), camera.project(turned) - pixels
        good = np.isfinite(off).all(axis=-1)
        w = weight[good, None]
        rows = (w[..., None] * by_rotation[good]).reshape(-1, 3)
        step = np.linalg.lstsq(rows, -(w * off[good]).reshape(-1), rcond=None)[0]
        R = rotation(step) @ R
        if np.linalg.norm(step) < ROUNDING:
            break
    return R


def _compared(origin: Camera | Path | str) -> ComparedCamera:
    if isinstance(origin, Camera):
        return ComparedCamera(f"a {origin.model} camera", origin)
    return ComparedCamera(str(origin), load_camera(origin))


def _by_rotation(camera: Camera, rays: Array) -> Array:
    """Derivatives (n, 2, 3) of pixels by a rotation of the rays (n, 3)."""
    return -camera.project_jacobians(rays)[0] @ skew(rays)


def _spread(a: Camera, b: Camera, pixels: Array, rays: Array, R: Array) -> Array:
    """Root (n, 2, m) of the covariance of B's pixels due to the parameters of both cameras.

    A's parameters change the rays. Zero for a camera without a covariance.
    """
    by_ray, by_b = b.project_jacobians(rays @ R.T)
    parts: list[Array] = []
    for camera, by in ((a, by_ray @ R @ a.ray_jacobians(pixels)[1]), (b, by_b)):
        n = len(camera.parameters)
        covariance = np.zeros((n, n)) if camera.covariance is None else camera.covariance
        values, vectors = np.linalg.eigh(covariance)
        parts.append(by @ (vectors * np.sqrt(np.maximum(values, 0.0))))
    return np.concatenate(parts, axis=-1)


def _p_value(off: Array, spread: Array, weight: Array) -> float:
    """Probability of as unlikely differences (n, 2) by chance, the smaller of two, doubled.

    The weighted sum of squares sees whatever differs over the image. It is one of chi-squares
    weighted by eigenvalues; a scaled chi-square with the same mean and variance takes its place
    (Satterthwaite). The amplitudes of the modes of the covariance, each over its standard
    deviation, see a change that is large for the directions that are known well, such as a
    distortion that differs at the border alone. spread : (n, 2, m) root of the covariance.
    """
    from scipy.special import gammaincc

    flat = (weight[:, None, None] * spread).reshape(-1, spread.shape[-1])
    normal = flat.T @ flat
    mean, variance = float(np.trace(normal)), 2 * float(np.sum(normal**2))
    weighted = (weight[:, None] * off).ravel()
    total = float(weighted @ weighted)
    if total <= ROUNDING**2 or variance == 0:
        return 1.0 if total <= ROUNDING**2 else 0.0
    overall = gammaincc(mean**2 / variance, total * mean / variance)
    modes, sigmas, _ = np.linalg.svd(flat, full_matrices=False)
    linear = sigmas > LEAST_MODE * sigmas[0]
    amplitudes = modes[:, linear].T @ weighted / sigmas[linear]
    by_modes = gammaincc(linear.sum() / 2, amplitudes @ amplitudes / 2)
    return float(min(1.0, 2 * min(overall, by_modes)))


def _with_verdict(d: CameraDifference, largest: float) -> CameraDifference:
    """Difference with its verdict."""
    middle = float(np.nanmedian(d.lengths))
    clause = f"{brief(middle)} px over the image (median), {brief(largest)} px at worst"
    findings: list[Finding] = []
    if largest <= ROUNDING:
        headline = "The two cameras are the same: no pixel differs by more than rounding."
    elif d.sigma is None:
        headline = f"The cameras differ: {clause}."
    else:
        by_chance = f"; chance alone makes {brief(float(np.nanmedian(d.sigma)))} px (1σ)"
        headline = (
            f"The cameras differ by more than chance explains: {clause}{by_chance}."
            if d.changed
            else f"No difference beyond what chance explains: {clause}{by_chance}."
        )
    if d.changed:
        findings.append(wrong("difference.cameras", d.b.name, value=middle, largest=largest))
    without = [one.name for one in (d.a, d.b) if one.camera.covariance is None]
    if without:
        findings.append(note("difference.no_covariance", names=without, matters=False))
    return replace(d, verdict=Verdict(not d.changed, headline, tuple(findings)))
