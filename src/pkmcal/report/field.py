"""Residuals over the image: a wrong camera model leaves a systematic pattern there.

An edge constrains only the direction across itself, so a cell's mean shift is the least-squares
solution of the offsets of its edges and corners along their own directions. The section is `field`
in the document (`Part.name`); `viewer/src/overlay.ts` draws its shapes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, enlargement, evenly
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import dot
from pkmcal.identify.estimate import Estimate
from pkmcal.levels import NEARLY_ALL, NEGLIGIBLE
from pkmcal.measurements import EdgeSet, Observation
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.observe.images import upright_turns
from pkmcal.observe.jpegs import narrowed
from pkmcal.observe.overlays import measured_curves, offsets_across_curves, own_edges
from pkmcal.observe.page_images import base64_webp
from pkmcal.observe.predict import legs_in_camera
from pkmcal.outcome import Part
from pkmcal.outcome.blocks import images as blocks
from pkmcal.outcome.blocks.base import Key
from pkmcal.outcome.blocks.text import Hint, Paragraph
from pkmcal.report.corners import BoardCorners
from pkmcal.report.page_links import Links
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import brief, number

FIELD_EDGE_FRACTIONS = np.linspace(0.05, 0.95, 10)
"""Positions on an edge, as fractions of its span: an edge crosses several cells."""
FIELD_CELLS_ACROSS = 14
"""Cells across the image."""
FIELD_ARROW_LENGTH = 0.06
"""Length of a large mean shift as drawn, in image widths."""
MEAN_IMAGE_WIDTH, MEAN_IMAGES = 640, 12
"""Width (px) of a station's mean image, and the number of images in it."""
SCALE_ARROW_LENGTH = 0.2
"""Largest length of the scale as drawn, in image widths."""
FIELD_READING_TEXT = (
    "Arrows: from where the calibrated machine expects edges and corners to where they are, the"
    " mean of each cell of the image. Without order where the camera's file is right; arrows that"
    " grow with the distance from the principal point (cross), or turn round it, are a lens that"
    " the file does not describe. Pale: not significant; of a hundred cells one is strong by"
    " chance."
)


@dataclass(frozen=True)
class ImageField:
    """Mean residuals over the image of a camera.

    station : index of the first station with the camera's images.
    middle : principal point, px.
    cells : mean shifts, px; insignificant ones are dashed.
    quarter_turns : clockwise, that turn its images upright.
    """

    title: str
    station: int
    size: tuple[int, int]
    middle: tuple[float, float]
    cells: tuple[blocks.Arrow, ...]
    quarter_turns: int = 0


@dataclass(frozen=True)
class Offsets:
    """Residuals in images, (n,) each.

    station, configuration : indices.
    thing : number of the edge or corner.
    pixel : (n, 2) position.
    direction : (n, 2) unit vectors.
    value : px along the direction.
    """

    station: Integers
    configuration: Integers
    thing: Integers
    pixel: Array
    direction: Array
    value: Array

    def select(self, keep: Booleans) -> Offsets:
        """Offsets of a mask."""
        return Offsets(*(getattr(self, f.name)[keep] for f in dataclasses.fields(self)))


def section(
    session: Session,
    observation: Observation,
    estimate: Estimate,
    corners: BoardCorners,
    images: Mapping[int, Sequence[Integers]],
    keys: Iterable[Key],
) -> Part | None:
    """Section of the report; None without residuals.

    images : of the stations, by their indices. keys : of the images on the page.
    """
    offsets = field_offsets(session, observation.edges, estimate, corners)
    result = fields(session, offsets, keys)
    if not result:
        return None
    lengths = np.array([np.hypot(*cell.displacement) for one in result for cell in one.cells])
    factor = enlargement(lengths, FIELD_ARROW_LENGTH * max(one.size[0] for one in result))
    text = (
        f"{FIELD_READING_TEXT} Arrows are {factor:g} times as long as the residuals; the largest is"
        f" {brief(float(lengths.max()))} px."
    )
    block = blocks.Images(
        images=tuple(field_image(one, factor, images.get(one.station, ())) for one in result),
        size="figure",
    )
    return Part(
        "field",
        "Residuals over the image",
        blocks=(
            Paragraph(text=text),
            Hint(text="A click on an arrow leads to the image with the largest residual there."),
            block,
        ),
        menu="Over the image",
    )


def field_image(
    one: ImageField, factor: float, images: Sequence[Integers], caption: str = ""
) -> blocks.Image:
    """Mean residuals over the mean of images.

    factor : enlargement of the arrows.
    """
    cross = blocks.Cross(at=one.middle, tip="Principal point")
    scale = scale_arrow(one.size, factor, one.quarter_turns)
    shapes: tuple[blocks.Shape, ...] = (cross, *one.cells, scale)
    layer = blocks.Layer(name="residuals", shapes=shapes, enlargement=factor)
    mean = mean_image(images)
    return blocks.Image(
        title=one.title,
        caption=caption,
        width=one.size[0],
        height=one.size[1],
        quarter_turns=one.quarter_turns,
        webp="" if mean is None else base64_webp(mean),
        overlays=(blocks.Overlay(layers=(layer,)),),
    )


def scale_arrow(size: tuple[int, int], factor: float, quarter_turns: int = 0) -> blocks.Arrow:
    """Scale of enlarged arrows, a round length in px: to the right, at the lower left of the
    upright image.
    """
    width, height = size[::-1] if quarter_turns % 2 else size
    longest = SCALE_ARROW_LENGTH * width / factor
    power = 10.0 ** math.floor(math.log10(longest))
    length = max(m * power for m in (1, 2, 5) if m * power <= longest)
    turn = upright_turn(quarter_turns)
    from_middle = np.array([0.04 * width, height - 0.05 * width]) - np.array([width, height]) / 2
    x, y = (from_middle @ turn + np.array(size) / 2).tolist()
    right, down = (np.array([length, 0.0]) @ turn).tolist()
    return blocks.Arrow(at=(x, y), displacement=(right, down), label=f"{length:g} px")


def upright_turn(quarter_turns: int) -> Array:
    """Rotation (2, 2) of directions (right, down) in the camera's image to the upright one."""
    return np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarter_turns % 4)


def mean_image(images: Sequence[Integers]) -> Integers | None:
    """Mean of a few images, spread over all of them; None if none can be read."""
    chosen = evenly(len(images), MEAN_IMAGES)
    sizes = list[Array]()
    for k in chosen.tolist():
        try:
            sizes.append(narrowed(images[k], MEAN_IMAGE_WIDTH).astype(float))
        except InputError:  # the images' own section names it
            continue
    return np.rint(np.mean(sizes, axis=0)).astype(np.uint8) if sizes else None


def field_offsets(
    session: Session, edges: EdgeSet, estimate: Estimate, corners: BoardCorners
) -> Offsets:
    """Offsets of the inlying edges, at several places of each, and of the used corners in x and y.

    The camera's estimated edge shift is subtracted.
    """
    inlier = estimate.edge_weights >= INLIER_WEIGHT
    parts = [
        edge_offsets(session, edges, estimate, s, np.flatnonzero(inlier & (edges.station == s)))
        for s in np.unique(edges.station[inlier]).tolist()
    ]
    used, n = np.flatnonzero(corners.used), len(edges)
    parts += [
        Offsets(
            corners.station[used],
            corners.configuration[used],
            n + used,
            corners.pixel[used],
            np.broadcast_to(np.eye(2)[axis], (len(used), 2)),
            corners.off[used, axis],
        )
        for axis in (0, 1)
    ]
    offsets = Offsets(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Offsets))
    )
    finite = np.isfinite(offsets.value) & np.isfinite(offsets.pixel).all(axis=-1)
    return offsets.select(np.asarray(finite))


def edge_offsets(
    session: Session, edges: EdgeSet, estimate: Estimate, s: int, mine: Integers
) -> Offsets:
    """Offsets of one station's edges, each at all of ``FIELD_EDGE_FRACTIONS`` in turn; NaN outside
    the image.

    mine : (n,) indices of the edges.
    """
    state, machine, camera = estimate.state, estimate.machine, session.stations[s].camera
    some = edges.select(mine)
    rows, image = np.unique(some.configuration, return_inverse=True)
    # predicted edges with the estimated edge shift, from which measured ones are offset
    legs = legs_in_camera(
        machine, state.T_camera_base[s], state.T_base_platform[rows], session.joints[rows]
    )
    outward = float(state.columns[EDGE_SHIFT][session.camera_of_station[s]])
    shifted = own_edges(machine, legs, image, some, outward)
    measured, expected = (
        measured_curves(machine, camera, legs, image, part, FIELD_EDGE_FRACTIONS)
        for part in (some, shifted)
    )
    direction, value = offsets_across_curves(expected, measured)
    n = len(FIELD_EDGE_FRACTIONS)
    return Offsets(
        np.full(len(mine) * n, s),
        np.repeat(some.configuration, n),
        np.repeat(mine, n),
        expected.reshape(-1, 2),
        direction.reshape(-1, 2),
        value.ravel(),
    )


def fields(session: Session, value: Offsets, keys: Iterable[Key]) -> tuple[ImageField, ...]:
    """Field of each station with enough data; hand-held images of one camera share a field.

    keys : of the images on the page, to which arrows lead.
    """
    links, entries = Links.of(session, keys), [one.entry or one.name for one in session.stations]
    out: list[ImageField] = []
    for entry in dict.fromkeys(entries):
        of_entry = [s for s, name in enumerate(entries) if name == entry]
        mine = np.isin(value.station, of_entry)
        station = session.stations[of_entry[0]]
        camera, files = station.camera, station.images
        turns = upright_turns(files[0].path, camera.image_size) if files else 0
        cells = _cells(value.select(mine), camera.image_size, links, turns)
        if cells:
            intrinsics = dict(zip(camera.parameter_names, camera.parameters.tolist(), strict=True))
            middle = intrinsics["center.x"], intrinsics["center.y"]
            size = camera.image_size
            out.append(ImageField(entry, of_entry[0], size, middle, tuple(cells), turns))
    return tuple(out)


def _cells(
    result: Offsets, size: tuple[int, int], links: Links, quarter_turns: int
) -> list[blocks.Arrow]:
    """Mean shifts, px, of the image's cells with enough data.

    quarter_turns : to the upright image, in which tooltips name directions.
    """
    from scipy.special import fdtrc

    side = size[0] / FIELD_CELLS_ACROSS
    inside = np.all((result.pixel > -0.5) & (result.pixel < np.array(size) - 0.5), axis=1)
    some = result.select(np.asarray(inside))
    # cell of each offset
    at = np.floor((some.pixel + 0.5) / side).astype(int)
    # places of one edge in a cell are one measurement, corners are two
    steep = np.abs(some.direction).argmax(axis=1)
    keys = np.column_stack([at[:, 1] * FIELD_CELLS_ACROSS + at[:, 0], some.thing, steep])
    distinct, first, measurement = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    measurement, direction = measurement.reshape(-1), some.direction[first]
    sign = np.sign(dot(some.direction, direction[measurement]))
    value = np.bincount(measurement, sign * some.value) / np.bincount(measurement)
    cells, number_of = np.unique(distinct[:, 0], return_inverse=True)
    n = np.bincount(number_of)

    def total(values: Array) -> Array:
        out = np.zeros((len(cells), *values.shape[1:]))
        np.add.at(out, number_of, values)
        return out

    # per cell: least squares for the shift s in sum (d d^T) s = sum d value, without a direction
    # that has little of the information, nearly all of which is across parallel edges
    information = total(direction[:, :, None] * direction[:, None])
    strength, axes = np.linalg.eigh(information)
    strong = strength > (1 - NEARLY_ALL) * strength.sum(axis=1, keepdims=True)
    along = np.einsum("cij,ci->cj", axes, total(direction * value[:, None]))
    shift = np.einsum(
        "cij,cj->ci", axes, np.where(strong, along / np.maximum(strength, 1e-12), 0.0)
    )
    explained = np.einsum("ci,cij,cj->c", shift, information, shift)
    rank = strong.sum(axis=1)
    freedom = np.maximum(n - rank, 1)
    residual = np.maximum(total(value**2) - explained, 1e-300)
    # F-test of the shift against the scatter about it, of which a negligible share of the cells is
    # significant by chance
    significant = fdtrc(rank, freedom, explained / rank / (residual / freedom)) < NEGLIGIBLE
    places = (
        np.stack([cells % FIELD_CELLS_ACROSS, cells // FIELD_CELLS_ACROSS], axis=-1) + 0.5
    ) * side - 0.5
    out: list[blocks.Arrow] = []
    for c in np.flatnonzero(n > rank).tolist():
        here = first[number_of == c]
        (x, y), (right, down) = places[c].tolist(), shift[c].tolist()
        upright = (upright_turn(quarter_turns) @ shift[c]).tolist()
        tip = (
            f"{number(upright[0], 3, signed=True)} px to the right,"
            f" {number(-upright[1], 3, signed=True)} px upwards, of"
            f" {len(np.unique(some.thing[here]))} edges and corners"
        )
        size_of = np.abs(value[number_of == c])
        key = links.to_largest(some.station[here], some.configuration[here], size_of)
        out.append(
            blocks.Arrow(
                at=(round(x, 1), round(y, 1)),
                displacement=(round(right, 5), round(down, 5)),
                key=key,
                tip=tip,
                dashed=not significant[c],
            )
        )
    return out
