"""Camera calibration as an outcome: intrinsics, corners in the images, residuals over the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pkmcal.arrays import enlargement
from pkmcal.camera_calibration.calibrate import (
    CALIBRATION_CHECK_OPTIONS,
    CameraCalibration,
    cell_numbers,
    coverage,
    tilts,
)
from pkmcal.cameras.files import camera_text, foreign_text
from pkmcal.observe.images import Pictures, upright_turns
from pkmcal.observe.page_images import PAGE_IMAGE_CHARACTERS, images_within
from pkmcal.outcome import Figure, Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.blocks import Block
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.images import Arrow, Image, Images, Layer, Overlay, Ring, Shape
from pkmcal.outcome.blocks.plot import panels
from pkmcal.outcome.blocks.text import Listing, Paragraph
from pkmcal.report.camera_plots import field_plots, models_plot, uncertainty_plot
from pkmcal.report.field import ImageField, field_image
from pkmcal.wording import Chance, brief, count, decimals, number

VIEW_RESIDUAL_ARROW_LENGTH = 0.05
"""Length of a large residual's arrow, in image widths."""
FIELD_CELLS = (16, 12)
INTRINSIC_UNITS = {"focal": "px", "center": "px"}
INTRINSIC_WORDS = {
    "focal.x": "focal length x",
    "focal.y": "focal length y",
    "center.x": "centre x",
    "center.y": "centre y",
}
CAMERA_MODELS_TEXT = (
    "Every model with more and more distortion terms. What counts is the error on held-out"
    " views; a term is taken only where it lowers that, and among equals the model with the fewest"
    " parameters."
)
PROJECTION_TEXT = (
    "1σ, in the worst direction, of the pixel of a point that stands still relative to the boards,"
    " if other images of this kind were taken. A rotation of the camera frame that replaces a"
    " change of the intrinsics does not count. Where no corners were, the lens is extrapolated."
)
CAMERA_SIGMA_TEXT = (
    "The standard deviations are those with which the intrinsics would scatter if other"
    " images of this kind were taken. They hold the noise of the corners and the views'"
    " disagreement beyond it. They do not contain what all images share: a board whose"
    " squares are not as long as its file states leaves the intrinsics alone and scales every"
    " distance; a focus that moves afterwards makes it another camera."
)


def outcome_of(
    calibration: CameraCalibration,
    paths: Sequence[Path | str] = (),
    others: Sequence[tuple[str, str]] = (),
) -> Outcome:
    """Outcome of `pkmcal camera`.

    paths : image files to be shown; matched by name.
    others : names and formats of camera files for other programs.
    """
    c = calibration
    together = "; ".join(f"{a} with {b} (ρ = {rho:+.3f})" for a, b, rho in c.correlations)
    hardly = f"Hardly distinguished, and so to be used together only: {together}."
    distances = (np.inf, c.distance)
    # with its covariance, which is the prior of `calibrate --refine-camera`
    measured = replace(c.camera, covariance=c.covariance)
    return Outcome(
        command="camera",
        title=f"Calibration of a {c.camera.model} camera",
        verdict=Verdict(True, camera_headline(c), c.findings),
        figures=_cards(c),
        parts=(
            Part(
                "intrinsics",
                "Intrinsics",
                tables=(_intrinsics(c), _board(c)),
                notes=(hardly,) if together else (),
            ),
            Part(
                "models",
                "Models compared",
                (CAMERA_MODELS_TEXT,),
                blocks=panels(models_plot(c)),
                tables=(_compared(c),),
                menu="Models",
            ),
            Part(
                "field",
                "Residuals and coverage",
                blocks=(_field_block(c, [Path(path) for path in paths]), *field_plots(c)),
            ),
            Part(
                "uncertainty",
                "Projection uncertainty",
                (PROJECTION_TEXT,),
                blocks=panels(*(uncertainty_plot(c, one) for one in distances)),
                tables=(_projection(c, distances),),
                menu="Uncertainty",
            ),
            Part(
                "images",
                "Images",
                blocks=_image_blocks(c, [Path(path) for path in paths]),
            ),
            Part("how", "What σ means", (CAMERA_SIGMA_TEXT,)),
        ),
        document=c.as_dict(),
        texts={
            "camera.yaml": camera_text(measured),
            **{name: foreign_text(c.camera, name, form) for name, form in others},
        },
    )


def camera_headline(c: CameraCalibration) -> str:
    """Result in one sentence."""
    focal, sigma = c.camera.parameters[:2].mean(), c.sigma[:2].mean()
    kind = {"unified": "unified (mirror or wide-lens)"}.get(c.camera.model, c.camera.model)
    return (
        f"A {kind} camera, focal length {number(focal, decimals(sigma))} ± {brief(sigma)} px;"
        f" images outside the fit are predicted to {brief(c.held_out.rms)} px."
    )


def _intrinsics(c: CameraCalibration) -> Table:
    """Table of the intrinsics, with two digits of their sigma."""
    rows: list[Row] = []
    values = zip(
        c.camera.parameter_names, c.camera.parameters.tolist(), c.sigma.tolist(), strict=True
    )
    for name, value, sigma in values:
        unit = INTRINSIC_UNITS.get(name.partition(".")[0], "")
        places = decimals(sigma)
        cells = (
            (number(value, places), number(sigma, places))
            if sigma > 0
            else (f"{value:g}", "not estimated")
        )
        rows.append(Row(INTRINSIC_WORDS.get(name, name), (*cells, unit)))
    return Table("", ("Parameter", "Value", "σ", "Unit"), tuple(rows), words=(3,))


def _board(c: CameraCalibration) -> Table:
    """Table of the board's deviations from its file: estimated, or tested only."""
    rows: list[Row] = []
    for one in (*((c.bend,) if c.bend else ()), *c.deviations):
        sides = (" along x", " along y") if len(one.value) > 1 else ("",)
        for side, value, sigma in zip(
            sides, one.value.tolist(), np.sqrt(np.diag(one.covariance)).tolist(), strict=True
        ):
            factor, unit = (100.0, "%") if one.code == "stretch" else (1e3, "mm")
            places = decimals(sigma * factor)
            state = "estimated" if one is c.bend else Chance(one.chance)
            cells = (number(value * factor, places, signed=True), brief(sigma * factor), unit)
            rows.append(Row(f"{one.code}{side}", (*cells, state)))
    note = (
        "Values that are not estimated with the camera follow from one step of the fit; chance is"
        " the probability of as large a value for a board as its file states. Bend: out of the"
        " plane, of the middle relative to the border. Stretch: of x relative to y."
    )
    columns = ("Deviation of the board from its file", "Value", "1σ", "Unit", "Chance")
    return Table("", columns, tuple(rows), note, brief=c.bend is not None, words=(3,))


def _projection(c: CameraCalibration, distances: Sequence[float]) -> Table:
    """Table of the projection's standard deviation over the image."""
    rows: list[Row] = []
    for distance in distances:
        sigma = c.projection_map(distance)
        finite = sigma[np.isfinite(sigma)]
        middle = float(c.projection_sigma(c.camera.center, distance))
        name = f"{brief(distance)} m" if np.isfinite(distance) else "infinity"
        cells = (middle, float(np.median(finite)), float(finite.max()))
        rows.append(Row(name, tuple(map(brief, cells))))
    columns = ("Distance", "Centre, px", "Median, px", "Worst, px")
    return Table("Standard deviation of a point's pixel", columns, tuple(rows))


def _compared(c: CameraCalibration) -> Table:
    """Table of the compared models."""
    rows = [
        Row(
            one.model,
            (
                " ".join(one.terms) or "none",
                number(one.rms, decimals(one.rms) + 1),
                number(one.left_out, decimals(one.left_out) + 1),
            ),
            mark="good" if (one.model, one.terms) == (c.camera.model, c.terms) else None,
        )
        for one in c.compared
    ]
    columns = ("Model", "Distortion", "Fitted, px", "Held out, px")
    note = "✓: chosen."
    return Table("", columns, tuple(rows), note, brief=False, words=(1,))


def _cards(c: CameraCalibration) -> tuple[Figure, ...]:
    """Main numbers."""
    share = float(np.max(c.sigma[:2] / c.camera.parameters[:2])) * 100
    tilt = tilts(c.T_camera_board, c.board.points)
    cells = CALIBRATION_CHECK_OPTIONS.cells
    covered = 100 * float(np.mean(coverage(c.pixels, c.camera.image_size, cells) > 0))
    finite = int(np.isfinite(c.residuals).all(axis=-1).sum())
    return (
        Figure(
            "How sure is the focal length?",
            ((brief(share), "%"),),
            f"1σ, from {count(len(c.views), 'image')}; "
            + (
                f"the views disagree by {c.spread:.1f} times the corners' noise, which is in it"
                if c.spread > 1
                else "the views agree as far as the corners' noise lets them"
            ),
        ),
        Figure(
            "How well does it predict other images?",
            ((brief(c.held_out.rms), "px"),),
            f"length of a residual, root mean square, camera fitted to the other views;"
            f" {brief(c.rms)} px on the views that it was fitted to",
        ),
        Figure(
            "Are straight lines straight?",
            ((brief(c.held_out.straightness), "px"),),
            "distance of corners from their board line's great circle, on held-out views; no pose"
            " takes part in this",
        ),
        Figure(
            "What is it based on?",
            ((f"{len(c.views)} of {len(c.detections)}", "images"),),
            f"{count(finite, 'corner')}, {finite - int(c.inliers.sum())} of them rejected",
        ),
        Figure(
            "How different are the views?",
            ((f"{tilt.min():.0f} to {tilt.max():.0f}", "°"),),
            "tilt of the board from facing the camera; 20 to 45° to all sides are best",
        ),
        Figure(
            "How much of the image was tested?",
            ((f"{covered:.0f}", "%"),),
            "of {}×{} cells hold corners; elsewhere the lens is extrapolated".format(*cells),
        ),
    )


def _image_blocks(c: CameraCalibration, paths: list[Path]) -> tuple[Block, ...]:
    """All views with their images, found by file name, the largest held-out error first."""
    by_name = {path.name: path for path in paths}
    size = c.camera.image_size
    lengths = np.linalg.norm(c.residuals[c.inliers], axis=-1)
    factor = enlargement(lengths, VIEW_RESIDUAL_ARROW_LENGTH * size[0])
    order = np.argsort(-c.held_out.by_view, kind="stable").tolist()
    files = [by_name.get(c.views[v]) for v in order]
    present = [path for path in files if path]
    pictures = Pictures(present, size, [path.name for path in present])
    each = [(pictures, k) for k in range(len(present))]
    contents = dict(zip(present, images_within(each, PAGE_IMAGE_CHARACTERS), strict=False))
    images = tuple(
        _image(c, v, contents.get(path, "") if path else "", factor, path)
        for v, path in zip(order, files, strict=True)
    )
    text = (
        "Largest held-out error first. Circles: detected corners; arrows: from there to where"
        f" the calibrated camera expects them, {factor:g} times as long as they are; dashed:"
        " rejected."
    )
    missed = [f"{one.name}: {one.reason}" for one in c.detections if not one.success]
    listing = (Listing(title="Not used", items=tuple(missed)),) if missed else ()
    return Paragraph(text=text, small=True), Images(images=images), *listing


def _image(c: CameraCalibration, v: int, webp: str, factor: float, path: Path | None) -> Image:
    """One view with its detected corners."""
    finite = np.flatnonzero(np.isfinite(c.residuals[v]).all(axis=-1)).tolist()
    rings, arrows = list[Shape](), list[Shape]()
    places = decimals(max(c.rms, 1e-6)) + 1
    for i in finite:
        (x, y), (dx, dy) = c.pixels[v, i].tolist(), c.residuals[v, i].tolist()
        tip = (
            f"Corner {i}: {number(-dx, places, signed=True)}, {number(-dy, places, signed=True)} px"
            f" from where it is expected; weight {c.weight[v, i]:.2f}"
        )
        at, dashed = (round(x, 2), round(y, 2)), not c.inliers[v, i]
        rings.append(Ring(at=at, tip=tip, dashed=dashed))
        arrows.append(
            Arrow(at=at, displacement=(round(dx, 5), round(dy, 5)), tip=tip, dashed=dashed)
        )
    n_rejected = len(finite) - int(c.inliers[v, finite].sum())
    caption = f"{count(len(finite), 'corner')}" + (f", {n_rejected} rejected" if n_rejected else "")
    caption += f"; held-out error {brief(float(c.held_out.by_view[v]))} px"
    caption += "" if webp else "; the image cannot be read, or has no room here"
    width, height = c.camera.image_size
    layers = (
        Layer(name="corners", shapes=tuple(rings)),
        Layer(name="residuals", shapes=tuple(arrows), enlargement=factor),
    )
    return Image(
        title=c.views[v],
        caption=caption,
        key=configuration_key(c.views[v]),
        width=width,
        height=height,
        quarter_turns=upright_turns(path, c.camera.image_size) if path else 0,
        webp=webp,
        overlays=(Overlay(layers=layers),),
    )


def _field_block(c: CameraCalibration, paths: list[Path]) -> Images:
    """Mean residuals of cells with three or more corners, over the mean of the images.

    The means have an enlargement of their own, as they are smaller than single residuals.
    """
    width, height = c.camera.image_size
    # from the expected to the detected corner, as in the field of a calibration
    pixels, off = c.pixels[c.inliers], -c.residuals[c.inliers]
    flat = cell_numbers(pixels, c.camera.image_size, FIELD_CELLS)
    counts = np.bincount(flat)
    # mean residual of cells with three or more corners, at the corners' mean
    arrows: list[Arrow] = []
    for k in np.flatnonzero(counts >= 3).tolist():
        root, mean = pixels[flat == k].mean(axis=0), off[flat == k].mean(axis=0)
        tip = (
            f"{number(mean[0], 3, signed=True)}, {number(mean[1], 3, signed=True)} px, of"
            f" {count(int(counts[k]), 'corner')}"
        )
        arrows.append(Arrow(at=tuple(root.tolist()), displacement=tuple(mean.tolist()), tip=tip))
    means = np.array([one.displacement for one in arrows]).reshape(-1, 2)
    factor = enlargement(np.linalg.norm(means, axis=-1), VIEW_RESIDUAL_ARROW_LENGTH * width)
    middle = float(c.camera.parameters[2]), float(c.camera.parameters[3])
    field = ImageField("Mean residual", 0, (width, height), middle, tuple(arrows))
    caption = f"arrows × {factor:g}; without order where the model fits"
    pictures = Pictures(paths, c.camera.image_size, [path.name for path in paths])
    return Images(images=(field_image(field, factor, pictures, caption),), size="figure")
