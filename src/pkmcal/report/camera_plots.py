"""Plots of a camera calibration: its corners over the image and by angle, views, and models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.camera_calibration.calibrate import (
    CALIBRATION_CHECK_OPTIONS,
    CameraCalibration,
    coverage,
)
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.plot import (
    BarsMark,
    CellsMark,
    ColourScale,
    DotsMark,
    Panels,
    Plot,
    Point,
    category_axis,
    linear_axis,
    linear_ticks,
    log_axis,
    panels,
    rounded,
)
from pkmcal.report.charts import bar_plot
from pkmcal.wording import brief, count

ANGLE_STEP = 5.0
"""Width of a bar in the histogram of angles from the axis, degrees."""
COVERAGE_CELLS = (16, 12)
"""Columns and rows of cells in which corners are counted."""


def field_plots(c: CameraCalibration) -> tuple[Panels, ...]:
    """Plots of where the corners are, and of each view's error."""
    return panels(coverage_plot(c), angles_plot(c), views_plot(c))


def coverage_plot(c: CameraCalibration) -> Plot:
    """Number of corners in each cell of the image."""
    counts = coverage(c.pixels[c.inliers], c.camera.image_size, COVERAGE_CELLS)
    most = max(int(counts.max()), 1)
    return image_map(
        "coverage",
        "Corners by their place in the image",
        f"{np.count_nonzero(counts)} of {counts.size} cells of the image hold corners, the"
        f" fullest {most}",
        c.camera.image_size,
        np.where(counts > 0, counts, np.nan),
        "corners",
    )


def uncertainty_plot(c: CameraCalibration, distance: float) -> Plot:
    """Map of the projection's standard deviation at a distance."""
    sigma = c.projection_map(distance)
    where = f"at {brief(distance)} m" if np.isfinite(distance) else "at infinity"
    finite = sigma[np.isfinite(sigma)]
    return image_map(
        f"uncertainty-{'near' if np.isfinite(distance) else 'infinity'}",
        f"Projection uncertainty {where}",
        f"1σ from {brief(float(finite.min(initial=np.inf)))} to"
        f" {brief(float(finite.max(initial=0.0)))} px over the image",
        c.camera.image_size,
        sigma,
        "1σ, px",
    )


def image_map(
    name: str,
    title: str,
    alt: str,
    image_size: tuple[int, int],
    values: Array,
    label: str,
    most: float = 0.0,
) -> Plot:
    """Map of values (rows, columns) in the cells of an image, NaN for none.

    most : end of the colour scale, for maps with a common one; the largest value by default.
    """
    width, height = image_size
    rows, columns = values.shape
    most = most or float(np.nanmax(values, initial=0.0)) or 1.0
    x, y = (-0.5, width - 0.5), (-0.5, height - 0.5)
    return Plot(
        name=name,
        title=title,
        caption="",
        alt=alt,
        x=linear_axis("x, pixels", x).model_copy(update={"limits": x}),
        y=linear_axis("y, pixels", y).model_copy(update={"limits": (y[1], y[0])}),
        marks=(
            CellsMark(
                x=x,
                y=y,
                values=tuple(
                    tuple(rounded(v) if np.isfinite(v) else None for v in line)
                    for line in values.tolist()
                ),
                columns=tuple(f"column {k + 1}" for k in range(columns)),
                rows=tuple(f"row {k + 1}" for k in range(rows)),
            ),
        ),
        colours=ColourScale(label=label, limits=(0, most), ticks=linear_ticks(0, most)),
        equal=True,
    )


def angles_plot(c: CameraCalibration) -> Plot:
    """Histogram of the corners' angles from the optical axis."""
    rays = c.camera.ray(c.pixels[c.inliers])
    angle = np.rad2deg(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]))
    angle = angle[np.isfinite(angle)]
    last = int(np.ceil((angle.max() if angle.size else 1.0) / ANGLE_STEP)) + 1
    counts = np.bincount((angle / ANGLE_STEP).astype(int), minlength=last).tolist()
    bars = [
        Point(
            x=(k + 0.5) * ANGLE_STEP,
            y=float(n),
            tip=f"{k * ANGLE_STEP:.0f} to {(k + 1) * ANGLE_STEP:.0f}°: {count(n, 'corner')}",
        )
        for k, n in enumerate(counts)
    ]
    return Plot(
        name="angles",
        title="Corners by their angle from the axis",
        caption="",
        alt=f"Corners from {angle.min(initial=180):.0f} to {angle.max(initial=0):.0f} degrees",
        x=linear_axis("angle, °", (0.0, len(bars) * ANGLE_STEP), zero=True),
        y=linear_axis("number of corners", counts, zero=True),
        marks=(BarsMark(name="", colour="quiet", points=tuple(bars), width=ANGLE_STEP),),
    )


def views_plot(c: CameraCalibration) -> Plot | None:
    """Held-out error of each view; the fit's own error is in the tooltip."""
    squares = np.where(c.inliers, np.sum(np.nan_to_num(c.residuals) ** 2, axis=-1), 0.0)
    fitted = np.sqrt(squares.sum(axis=1) / np.maximum(c.inliers.sum(axis=1), 1))
    middle = float(np.median(c.held_out.by_view))
    bars = [
        Point(
            x=name,
            y=rounded(float(out)),
            tip=f"{name}: {brief(float(out))} px held out, {brief(float(own))} px when fitted",
            key=configuration_key(name),
            colour="quiet" if out < CALIBRATION_CHECK_OPTIONS.outlying_view * middle else None,
        )
        for name, out, own in zip(c.views, c.held_out.by_view, fitted, strict=True)
    ]
    return bar_plot(
        "views",
        "Held-out error of each image",
        "images",
        "root mean square, px",
        bars,
        f"Bars of {len(bars)} images, the middle one {brief(middle)} px",
    )


def _abbreviated(terms: Sequence[str]) -> list[str]:
    """Terms of a distortion with three or more in sequence as one, ``k3–k6``."""
    runs: list[list[str]] = []
    for term in terms:
        last = runs[-1][-1] if runs else ""
        follows = last[:1] == term[:1] and last[1:].isdigit() and term[1:] == f"{int(last[1:]) + 1}"
        if follows:
            runs[-1].append(term)
        else:
            runs.append([term])
    return [name for run in runs for name in ([f"{run[0]}–{run[-1]}"] if len(run) > 2 else run)]


def models_plot(c: CameraCalibration) -> Plot | None:
    """Error of each compared model on the views that it was fitted to, and on those held out; None
    for a single model.
    """
    if len(c.compared) < 2:
        return None
    fitted, left_out = list[Point](), list[Point]()
    for one in c.compared:
        chosen = (one.model, one.terms) == (c.camera.model, c.terms)
        name = ("✓ " if chosen else "") + " ".join((one.model, *_abbreviated(one.terms)))
        tip = f"{name}: fitted {brief(one.rms)} px, held out {brief(one.left_out)} px"
        for points, value in ((fitted, one.rms), (left_out, one.left_out)):
            if np.isfinite(value) and value > 0:
                points.append(Point(x=rounded(value), y=name, tip=tip))
    points = (*fitted, *left_out)
    names = dict.fromkeys(str(point.y) for point in points)
    return Plot(
        name="models",
        title="Error of each model",
        caption="",
        alt=f"Errors of {len(names)} models, fitted and held out; the table has the numbers",
        x=log_axis("root mean square, px", (float(point.x) for point in points)),
        y=category_axis(names),
        marks=(
            DotsMark(name="fitted", colour="nominal", points=tuple(fitted)),
            DotsMark(name="held out", colour="calibrated", points=tuple(left_out)),
        ),
    )
