"""Difference of two cameras as an outcome: maps over the image, and the parameters."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import enlargement
from pkmcal.cameras.contract import Camera
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.judge.camera_difference import CameraDifference
from pkmcal.outcome import Figure, Level, Outcome, Part, Row, Table
from pkmcal.outcome.blocks import Block
from pkmcal.outcome.blocks.images import Arrow, Images
from pkmcal.outcome.blocks.plot import panels
from pkmcal.report.camera_plots import image_map
from pkmcal.report.field import ImageField, field_image
from pkmcal.report.watch import NO_VALUE_SIGN
from pkmcal.wording import Chance, brief, decimals, number

DIFFERENCE_ARROW_LENGTH = 0.05
"""Length of a large difference's arrow, in image widths."""
SCALE_STRIP_HEIGHT = 0.1
"""Height of the strip below the arrows in which their scale stands, in image widths."""
ARROW_EVERY = 2
"""Cells of the maps from arrow to arrow."""
ROTATION_TEXT = (
    "The rays of A's pixels are rotated such that B's pixels of the same rays differ least: a"
    " rotation of the camera frame is no difference of lenses. The least squares are weighted by"
    " the standard deviations of the pixels where the files have covariances. Points are at"
    " infinity."
)


def outcome_of(d: CameraDifference) -> Outcome:
    """Outcome of ``pkmcal diff`` of two cameras."""
    # both cameras' parameters by their names
    sides = [_values(one.camera) for one in (d.a, d.b)]
    names = dict.fromkeys([*sides[0], *sides[1]])
    none = (NO_VALUE_SIGN, NO_VALUE_SIGN)
    rows = [Row(name, (*sides[0].get(name, none), *sides[1].get(name, none))) for name in names]
    columns = ("Parameter", "A", "1σ", "B", "1σ")
    note = "Parameters of two lenses differ where their projections do not: ξ with f, k1 with k2."
    return Outcome(
        command="diff",
        title="Difference of two cameras",
        kicker=f"{d.a.name} → {d.b.name}",
        subject=f"A: {d.a.name}, {d.a.camera.model}; B: {d.b.name}, {d.b.camera.model}",
        verdict=d.verdict,
        stamp="Changed" if d.changed else "No change",
        level=Level.WRONG if d.changed else Level.DOUBTFUL,
        figures=_cards(d),
        parts=(
            Part(
                "projection",
                "Difference of projections",
                blocks=_maps(d),
                tables=(_projection(d),),
            ),
            Part("parameters", "Parameters", tables=(Table("", columns, tuple(rows), note),)),
            Part("how", "How they were compared", (ROTATION_TEXT,)),
        ),
        document=d.as_dict(),
    )


def _cards(d: CameraDifference) -> tuple[Figure, ...]:
    """Main numbers."""
    turn = np.rad2deg(np.linalg.norm(rotation_vector(d.rotation)))
    cards = [
        Figure(
            "How much do pixels differ?",
            ((brief(float(np.nanmedian(d.lengths))), "px"),),
            f"median over the image; at worst {brief(float(np.nanmax(d.lengths)))} px",
        ),
        Figure(
            "How far was the frame rotated?",
            ((brief(float(turn)), "°"),),
            "best rotation of A's rays, which is not part of the difference",
        ),
    ]
    if d.chance is not None:
        cards.append(
            Figure(
                "How likely by chance alone?",
                ((Chance(d.chance), ""),),
                "of as large a difference between calibrations of one camera",
            )
        )
    return tuple(cards)


def _projection(d: CameraDifference) -> Table:
    """Table of the difference over the image."""
    nearest = np.unravel_index(
        np.nanargmin(np.linalg.norm(d.pixels - d.a.camera.center, axis=-1)), d.lengths.shape
    )
    kinds = [("Difference", d.lengths)]
    if d.sigma is not None:
        kinds.append(("By chance, 1σ", d.sigma))
    rows: list[Row] = []
    for name, values in kinds:
        cells = (values[nearest], np.nanmedian(values), np.nanmax(values))
        texts = [brief(float(v)) if np.isfinite(v) else NO_VALUE_SIGN for v in cells]
        rows.append(Row(name, tuple(texts)))
    columns = ("B's pixel minus A's, px", "Centre", "Median", "Worst")
    return Table("How far pixels differ", columns, tuple(rows))


def _values(camera: Camera) -> dict[str, tuple[str, str]]:
    """Values and standard deviations of a camera's parameters, as text."""
    n = len(camera.parameters)
    sigma = np.zeros(n) if camera.covariance is None else np.sqrt(np.diag(camera.covariance))
    values = zip(camera.parameter_names, camera.parameters.tolist(), sigma.tolist(), strict=True)
    return {
        name: (number(v, decimals(s)), brief(s))
        if s > 0
        else (f"{v:g}".replace("-", "−"), NO_VALUE_SIGN)
        for name, v, s in values
    }


def _maps(d: CameraDifference) -> tuple[Block, ...]:
    """Maps of the difference and of its standard deviation, and arrows."""
    size = d.a.camera.image_size
    most = brief(float(np.nanmax(d.lengths)))
    maps = [image_map("difference", "Difference", f"Up to {most} px", size, d.lengths, "px")]
    if d.sigma is not None:
        worst = brief(float(np.nanmax(d.sigma)))
        maps.append(
            image_map("chance", "By chance, 1σ", f"Up to {worst} px", size, d.sigma, "1σ, px")
        )
    some = slice(ARROW_EVERY // 2, None, ARROW_EVERY)
    at, off = (x[some, some].reshape(-1, 2) for x in (d.pixels, d.difference))
    arrows = tuple(
        Arrow(
            at=(x, y),
            displacement=(dx, dy),
            tip=f"{number(dx, 3, signed=True)}, {number(dy, 3, signed=True)} px",
        )
        for (x, y), (dx, dy) in zip(at.tolist(), off.tolist(), strict=True)
        if np.isfinite(dx)
    )
    lengths = np.linalg.norm(off[np.isfinite(off).all(axis=-1)], axis=-1)
    factor = enlargement(lengths, DIFFERENCE_ARROW_LENGTH * size[0])
    cx, cy = d.a.camera.center.tolist()
    # the arrows fill the image: the scale stands in a strip below it
    width, height = size
    strip = round(SCALE_STRIP_HEIGHT * width)
    field = ImageField("From A's pixel to B's", 0, (width, height + strip), (cx, cy), arrows)
    image = field_image(field, factor, (), f"arrows × {factor:g}")
    return (*panels(*maps), Images(images=(image,), size="figure"))
