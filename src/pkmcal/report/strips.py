"""Rectified strips along measured edges, with the fitted line: how well it lies on the edge.

The image is sampled by bilinear interpolation at native pixels, across the edge that the calibrated
machine predicts and along it. The strips of an image are one WebP file, one strip below the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.observe.overlays import (
    measured_curves,
    offsets_across_curves,
    own_edges,
)
from pkmcal.observe.page_images import base64_webp
from pkmcal.observe.predict import legs_in_camera
from pkmcal.outcome.blocks.images import Strip

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

STRIP_ROWS = 41
"""Rows of a strip: pixels across the edge."""
STRIP_CURVE_FRACTIONS = np.linspace(0, 1, 65)
"""Positions at which the curve of an edge is computed, as fractions of its span."""
STRIP_LINE_POINTS = 5
"""Points of the fitted line; it differs from the predicted edge by an almost straight line."""
STRIP_GREY_PERCENTILES = 1.0, 99.0
"""Percentiles of a strip's grey levels that become black and white."""


@dataclass(frozen=True)
class EdgeLines:
    """Predicted curves and fitted lines of edges in images.

    curve : (n, m, 2) px, of the calibrated machine.
    normal : (n, m, 2) unit normals of the curves, outward.
    offset, sigma : (n, m) px, of the fitted lines along the normals.
    """

    curve: Array
    normal: Array
    offset: Array
    sigma: Array

    def select(self, keep: Booleans) -> EdgeLines:
        """Lines of a mask."""
        return EdgeLines(self.curve[keep], self.normal[keep], self.offset[keep], self.sigma[keep])


def edge_lines(c: Calibration, mine: Integers, s: int) -> EdgeLines:
    """Predicted curves and fitted lines of the edges ``mine`` (n,) of station s."""
    edges, camera = c.observation.edges.select(mine), c.session.stations[s].camera
    machine, state = c.machine, c.estimate.state
    rows, image = np.unique(edges.configuration, return_inverse=True)
    legs = legs_in_camera(
        machine, state.T_camera_base[s], state.T_base_platform[rows], c.session.joints[rows]
    )
    shift = float(state.columns[EDGE_SHIFT][c.session.camera_of_station[s]])
    expected = own_edges(machine, legs, image, edges, shift)

    def curves(normal: Array) -> Array:
        some = replace(edges, normal=normal)
        return measured_curves(machine, camera, legs, image, some, STRIP_CURVE_FRACTIONS)

    curve = curves(expected.normal)
    normal, offset = offsets_across_curves(curve, curves(edges.normal))
    # the side that is outward: where the predicted edge goes with its normal
    outward = own_edges(machine, legs, image, edges, shift + 1.0)
    _, along_outward = offsets_across_curves(curve, curves(outward.normal))
    sign = np.sign(np.nansum(along_outward, axis=1))[:, None]
    # standard deviation: displacement of the line by each column of the covariance's root
    root = np.linalg.cholesky(edges.covariance) * c.estimate.statistics.noise_scale
    columns = [
        offsets_across_curves(
            curve, curves(edges.normal + (edges.basis @ root[..., k, None])[..., 0])
        )
        for k in (0, 1)
    ]
    sigma = np.hypot(*(value - offset for _, value in columns))
    return EdgeLines(curve, sign[..., None] * normal, sign * offset, sigma)


def sampled_strip(image: Array | Integers, curve: Array, normal: Array) -> tuple[Array, Array]:
    """Image (h, w) along a curve (m, 2) px, sampled at native pixels; outward is the first row.

    Returns the strip (STRIP_ROWS, length), and the position of each point of the curve along it, in
    columns.
    """
    from scipy.ndimage import map_coordinates

    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    length = int(np.ceil(along[-1])) + 1
    along *= (length - 1) / along[-1]
    column = np.arange(length)
    at, across = (
        np.stack([np.interp(column, along, one[:, axis]) for axis in (0, 1)], axis=-1)
        for one in (curve, normal)
    )
    distance = (STRIP_ROWS - 1) / 2 - np.arange(STRIP_ROWS)
    x, y = np.moveaxis(at + distance[:, None, None] * across, -1, 0)
    return map_coordinates(image, [y, x], order=1, mode="nearest", output=float), along


def strips_of_image(image: Integers, lines: EdgeLines) -> tuple[tuple[Strip, ...], str]:
    """Strips of the edges with these lines in an image, and their common WebP file in base64."""
    strips, levels = list[Strip](), list[Array]()
    for k in range(len(lines.curve)):
        level, along = sampled_strip(image, lines.curve[k], lines.normal[k])
        places = np.linspace(0, along[-1], STRIP_LINE_POINTS)
        offset, sigma = (np.interp(places, along, one[k]) for one in (lines.offset, lines.sigma))
        strips.append(
            Strip(
                length=level.shape[1],
                offset=tuple(np.round(offset, 3).tolist()),
                sigma=tuple(np.round(sigma, 3).tolist()),
            )
        )
        dark, light = np.percentile(level, STRIP_GREY_PERCENTILES)
        levels.append(np.clip((level - dark) / max(light - dark, 1.0), 0, 1) * 255)
    if not strips:
        return (), ""
    sheet = np.zeros((STRIP_ROWS * len(strips), max(one.length for one in strips)), np.uint8)
    for k, level in enumerate(levels):
        sheet[k * STRIP_ROWS : (k + 1) * STRIP_ROWS, : level.shape[1]] = np.rint(level)
    return tuple(strips), base64_webp(sheet)
