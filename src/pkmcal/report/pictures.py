"""Images with the measured edges and corners drawn over them, as in [B] Figs. 6 and 8."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array, Integers, enlargement
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.identify.centres import Centres
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import centres_and_tool
from pkmcal.measurements import Observation, Rejection
from pkmcal.observe.images import Pictures, upright_turns
from pkmcal.observe.overlays import (
    EDGE_CURVE_POINTS,
    EdgeCurve,
    Spot,
    edge_layer,
    edge_name,
    joint_layers,
    machine_laid_over,
    measured_curves,
    polyline,
    residual_words,
    straightened,
)
from pkmcal.observe.page_images import PAGE_IMAGE_CHARACTERS, images_within
from pkmcal.observe.predict import LegsInCamera, edge_points, legs_in_camera, tubes_of
from pkmcal.outcome import Part
from pkmcal.outcome.blocks import images as blocks
from pkmcal.outcome.blocks.base import image_key
from pkmcal.outcome.blocks.text import Hint, Paragraph
from pkmcal.report.corners import BoardCorners, board_corners
from pkmcal.report.field import FIELD_EDGE_FRACTIONS, edge_offsets
from pkmcal.report.page_links import Place
from pkmcal.report.residuals import outward_shift
from pkmcal.report.strips import STRIP_ROWS, edge_lines, strips_of_image
from pkmcal.session.image_files import Image
from pkmcal.session.load import RejectedStation, Session, Station
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import brief, count, number

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

RESIDUAL_ARROW_LENGTH = 0.03
"""Length of a large residual as drawn, in image widths."""


@dataclass(frozen=True)
class AlbumSize:
    """Room for images on a page."""

    # images: browsers take a second to lay out as many
    images: int = 400
    # characters of all images
    characters: int = PAGE_IMAGE_CHARACTERS
    # characters of all strips, of the first images: those of some sixty
    strip_characters: int = 700_000


ALBUM_SIZE = AlbumSize()


@dataclass(frozen=True)
class Album:
    """Images on the page.

    rejected : images that could not be localized.
    total : number of all other images.
    held_out : whether some of the images were held out.
    factor : enlargement of the corners' residuals.
    corners : corners of the board in all images.
    """

    images: tuple[blocks.Image, ...]
    rejected: tuple[blocks.Image, ...]
    total: int
    held_out: bool
    factor: float
    corners: BoardCorners


def section(session: Session, album: Album) -> Part:
    """Section of the report."""
    if not (album.images or album.rejected):
        return Part("photographs", "Images", ("There is no image to show.",))
    legs = session.machine.n_legs
    parts = [
        Paragraph(text=_order_text(album)),
        Paragraph(text=_legend_text(album), small=True),
        *_strips_hint(album),
        blocks.Images(images=album.images, legs=legs if _has(album, "edges") else 0),
    ]
    if album.rejected:
        parts += [
            Paragraph(
                text="Rejected as a whole: these images do not show where they were taken from, and"
                " nothing of them is in use. Lines: the nominal model at the most likely pose. A"
                " hand-held image is used if pkmcal view saves its pose."
            ),
            blocks.Images(images=album.rejected),
        ]
    return Part("photographs", "Images", blocks=tuple(parts))


def _order_text(album: Album) -> str:
    """Which images there are, and their order."""
    n = len(album.images)
    some = f"{n} of {album.total} images" if n < album.total else f"All {count(n, 'image')}"
    text = f"{some}: those without data in use first, then by their residuals, the largest first"
    return text + ("; last those that were held out." if album.held_out else ".")


def _strips_hint(album: Album) -> tuple[Hint, ...]:
    """How to see the strips along the edges, of an album with some."""
    n, strips = len(album.images), sum(bool(one.strips) for one in album.images)
    which = "every image" if strips == n else count(strips, "image")
    text = (
        f"In {which}, a click on an edge shows the image along it, with the fitted line and its"
        " standard deviation."
    )
    return (Hint(text=text),) if strips else ()


def _legend_text(album: Album) -> str:
    """What the overlays' shapes are."""
    texts = {
        "edges": "Lines: measured edges in their leg's colour, dashed where the robust weight is"
        " below a half.",
        "rejected": "Dotted: edges that were searched and rejected.",
        "joints": "Circles: joints of the calibrated machine; crosses: of the nominal model.",
        "corners": "Small circles: detected corners of the board.",
        "residuals": "Arrows: from what was measured to where the calibrated machine expects it,"
        f" {album.factor:g} times as long as they are.",
    }
    return " ".join(text for name, text in texts.items() if _has(album, name))


def _has(album: Album, name: str) -> bool:
    """Whether an image has shapes in a layer."""
    return any(
        layer.name == name and layer.shapes
        for image in album.images
        for overlay in image.overlays
        for layer in overlay.layers
    )


def album(
    calibration: Calibration,
    shifts: Array,
    centres: tuple[Centres, ...],
    largest: AlbumSize = ALBUM_SIZE,
) -> Album:
    """Images with their overlays, as many as there is room for.

    Images without data in use come first, then those with the largest residuals, last those that
    were held out.

    shifts : (N,) px of the edges, for tooltips.
    """
    session, level = calibration.session, levels(calibration.observation, calibration.estimate)
    every = _first_images(session)
    held_out = set(calibration.holdout.region.rows.tolist() if calibration.holdout else ())

    def place_of(item: tuple[int, Image]) -> float:
        s, photo = item
        last = photo.configuration in held_out
        return np.inf if last else -level.get((s, photo.configuration), np.inf)

    ordered = sorted(every, key=place_of)
    images = station_images(calibration)
    files = [
        (images[s], session.stations[s].images.index(photo))
        for s, photo in ordered[: largest.images]
    ]
    # files until the budget is spent; overlays for the images that have one
    contents = list(images_within(files, largest.characters))
    chosen = ordered[: len(contents)]
    overlays = _ImageOverlays(calibration, shifts, centres, chosen)
    overlays.add_strips(images, chosen, largest.strip_characters)
    room = largest.characters - sum(map(len, contents))
    return Album(
        tuple(
            overlays.image(s, photo, webp, level.get((s, photo.configuration), np.nan))
            for (s, photo), webp in zip(chosen, contents, strict=True)
        ),
        tuple(_rejected(session, largest.images, room)),
        len(every),
        any(photo.configuration in held_out for _, photo in chosen),
        overlays.factor,
        overlays.corners,
    )


def _first_images(session: Session) -> list[tuple[int, Image]]:
    """First image of each configuration at each station, with the station's index."""
    return [
        (s, photo)
        for s, station in enumerate(session.stations)
        for photo in {p.configuration: p for p in reversed(station.images)}.values()
    ]


def images_of_configurations(
    calibration: Calibration, captions: Mapping[int, str]
) -> tuple[blocks.Image, ...]:
    """Images of some configurations with their measured edges, as many as there is room for.

    captions : what the images show, by the configurations' indices in the order of the images.
    """
    c, session = calibration, calibration.session
    images, order = station_images(c), {k: n for n, k in enumerate(captions)}
    chosen = [item for item in _first_images(session) if item[1].configuration in order]
    chosen.sort(key=lambda item: order[item[1].configuration])
    files = [(images[s], session.stations[s].images.index(photo)) for s, photo in chosen]
    contents = list(images_within(files[: ALBUM_SIZE.images], ALBUM_SIZE.characters))
    centres, _ = centres_and_tool(session.machine, c.estimate, session.joints)
    shifts = outward_shift(
        c.observation.edges, c.estimate, session.joints, session.camera_of_station
    )
    level = levels(c.observation, c.estimate)
    overlays = _ImageOverlays(c, shifts, centres, chosen[: len(contents)])
    out: list[blocks.Image] = []
    for (s, photo), webp in zip(chosen, contents, strict=False):
        k = photo.configuration
        image = overlays.image(s, photo, webp, level.get((s, k), np.nan))
        out.append(image.model_copy(update={"caption": f"{captions[k]}; {image.caption}"}))
    return tuple(out)


def station_images(calibration: Calibration) -> dict[int, Sequence[Integers]]:
    """Images of each station by its index, decoded on access where they are not in memory."""
    stations = enumerate(calibration.session.stations)
    return {s: _decoded(station) for s, station in stations} | {**calibration.images}


def _rejected(session: Session, most: int, room: int) -> Iterator[blocks.Image]:
    """Images that could not be localized, each with the reason.

    ``most`` of them have their JPEG, as far as ``room`` characters suffice; the others are listed
    without.
    """
    lost = [(one, photo) for one in session.rejected for photo in one.station.images]
    files = [(_decoded(one.station), one.station.images.index(photo)) for one, photo in lost[:most]]
    contents = list(images_within(files, room))
    contents += [""] * (len(lost) - len(contents))
    for (one, photo), webp in zip(lost, contents, strict=True):
        image = _block(
            one.station, photo, session.configurations, f"rejected, for {one.reason}", webp
        )
        yield image.model_copy(update={"overlays": _tried_overlay(session, one, photo)})


def _tried_overlay(
    session: Session, rejected: RejectedStation, photo: Image
) -> tuple[blocks.Overlay, ...]:
    """Nominal model at the most likely pose of a rejected station, if there is one."""
    T_camera_base, camera = rejected.T_camera_base, rejected.station.camera
    if T_camera_base is None:
        return ()
    joints, pose = (
        of[photo.configuration] for of in (session.joints, session.forward.T_base_platform)
    )
    edges, spots = machine_laid_over(session.machine, camera, T_camera_base, joints, pose)
    layers = edge_layer("edges", edges), *joint_layers(spots)
    return (blocks.Overlay(title="Most likely pose", layers=layers),)


def _block(
    station: Station, photo: Image, configurations: Sequence[str], caption: str, webp: str
) -> blocks.Image:
    """Image without overlays."""
    configuration = configurations[photo.configuration]
    width, height = station.camera.image_size
    return blocks.Image(
        title=f"{station.name} / {configuration}",
        caption=caption,
        group=station.name,
        key=image_key(station.name, configuration),
        width=width,
        height=height,
        quarter_turns=upright_turns(photo.path, station.camera.image_size),
        webp=webp,
    )


def _decoded(station: Station) -> Pictures:
    """Images of a station that need not be in the session any more, decoded on access."""
    paths = [photo.path for photo in station.images]
    return Pictures(paths, station.camera.image_size, [path.name for path in paths])


def levels(observation: Observation, estimate: Estimate) -> dict[Place, float]:
    """Root mean square residual of each image, in standard deviations, over edges and board poses.

    Unweighted: images with rejected edges are those that a reader has to see.
    """
    edges, poses = observation.edges, observation.poses
    # mean square residual by station and configuration
    squares = np.concatenate(
        [np.sum(estimate.edge_residuals**2, axis=1), np.sum(estimate.pose_residuals**2, axis=1)]
    )
    numbers = np.concatenate([np.full(len(edges), 2.0), poses.rows])
    places = np.concatenate([np.column_stack([x.station, x.configuration]) for x in (edges, poses)])
    each, group = np.unique(places, axis=0, return_inverse=True)
    group = group.reshape(-1)
    mean = np.bincount(group, squares) / np.bincount(group, numbers)
    return {(s, k): float(m) ** 0.5 for (s, k), m in zip(each.tolist(), mean, strict=True)}


class _ImageOverlays:
    """Overlays of the chosen images, computed for all images of a station at once.

    residuals : arrows of the edges, from measured to expected, at their middles.
    factor : enlargement of the residuals.
    """

    def __init__(
        self,
        calibration: Calibration,
        shifts: Array,
        centres: tuple[Centres, ...],
        chosen: Iterable[tuple[int, Image]],
    ) -> None:
        self.calibration = calibration
        session, estimate = calibration.session, calibration.estimate
        self.edges: dict[Place, dict[int, EdgeCurve]] = defaultdict(dict)
        self.residuals: dict[Place, list[blocks.Arrow]] = defaultdict(list)
        self.missed: dict[Place, list[EdgeCurve]] = defaultdict(list)
        self.strips: dict[Place, tuple[tuple[blocks.Strip, ...], str]] = {}
        self.spots: dict[Place, list[Spot]] = defaultdict(list)
        self.reasons: dict[Place, list[str]] = defaultdict(list)
        self.corners = board_corners(session, calibration.boards, estimate)
        # rejections by station; whole images have no leg
        rejected: dict[int, list[Rejection]] = defaultdict(list)
        for one in calibration.observation.rejected:
            rejected[one.station].append(one)
            if one.leg < 0:
                self.reasons[one.station, one.configuration].append(one.reason)
        # chosen configurations of each station, as far as their poses were estimated
        rows: dict[int, list[int]] = defaultdict(list)
        for s, photo in chosen:
            if estimate.configurations[photo.configuration]:
                rows[s].append(photo.configuration)
        for s, some in rows.items():
            if "legs" in session.stations[s].observe:
                configurations = np.array(sorted(some))
                self._edges(shifts, s, configurations)
                self._missed(rejected[s], s, configurations)
                self._spots(centres, s, configurations)
        arrows = [one.displacement for some in self.residuals.values() for one in some]
        lengths = np.hypot(*np.concatenate([self.corners.off, np.reshape(arrows, (-1, 2))]).T)
        width = max((s.camera.image_size[0] for s in session.stations), default=0)
        self.factor = enlargement(lengths, RESIDUAL_ARROW_LENGTH * width)

    def add_strips(
        self,
        images: Mapping[int, Sequence[Integers]],
        chosen: Sequence[tuple[int, Image]],
        room: int,
    ) -> None:
        """Strips of the edges in the first images, as many as ``room`` characters hold."""
        c, coarse = self.calibration, self.calibration.observation.edges.coarse
        for s, photo in chosen:
            if room <= 0:
                return
            place = s, photo.configuration
            mine = np.array([n for n in self.edges[place] if not coarse[n]], dtype=int)
            if not len(mine):
                continue
            try:
                image = images[s][c.session.stations[s].images.index(photo)]
            except InputError:  # the caption names it
                continue
            lines = edge_lines(c, mine, s)
            finite = np.isfinite(lines.curve).all(axis=(1, 2)) & np.isfinite(lines.sigma).all(
                axis=1
            )
            mine, lines = mine[finite], lines.select(np.asarray(finite))
            self.strips[place] = strips, sheet = strips_of_image(image, lines)
            room -= len(sheet) + sum(len(one.model_dump_json()) for one in strips)
            for k, (n, strip) in enumerate(zip(mine.tolist(), strips, strict=True)):
                middle = len(strip.offset) // 2
                outward = number(strip.offset[middle], 3, signed=True)
                tip = self._tip(n, f"{outward} ± {brief(strip.sigma[middle])}")
                self.edges[place][n] = replace(self.edges[place][n], strip=k, tip=tip)

    def image(self, s: int, photo: Image, webp: str, level: float) -> blocks.Image:
        """Image with its overlay."""
        session = self.calibration.session
        k, station = photo.configuration, session.stations[s]
        p, c = station.images.index(photo), self.corners
        mine = c.select((c.station == s) & (c.image == p))
        edges, missed = tuple(self.edges[s, k].values()), self.missed[s, k]
        n_rejected = sum(edge.quiet for edge in edges)
        rms = float(np.sqrt(np.mean(np.sum(mine.off**2, axis=1)))) if len(mine) else 0.0
        captions = [
            count(len(edges), "edge") + (f", {n_rejected} of them rejected" if n_rejected else "")
            if edges
            else "",
            f"{len(missed)} not used" if missed else "",
            f"{count(len(mine), 'corner')}, {brief(rms)} px off" if len(mine) else "",
            self._use(k, level),
            *self.reasons[s, k],
            "" if webp else "the file could not be read",
        ]
        caption = "; ".join(text for text in captions if text)
        layers = (
            edge_layer("rejected", missed),
            edge_layer("edges", edges),
            *self._corner_layers(mine, self.residuals[s, k]),
            *joint_layers(self.spots[s, k]),
        )
        strips, sheet = self.strips.get((s, k), ((), ""))
        return _block(station, photo, session.configurations, caption, webp).model_copy(
            update={
                "overlays": (blocks.Overlay(layers=tuple(one for one in layers if one.shapes)),),
                "strips": strips,
                "strip_webp": sheet,
                "strip_rows": STRIP_ROWS if strips else 0,
            }
        )

    def _use(self, configuration: int, level: float) -> str:
        """What is used of an image. level : of its residuals, NaN without any."""
        if np.isfinite(level):
            return f"residuals {number(level, 2)}\N{NO-BREAK SPACE}σ"
        out = self.calibration.holdout
        return "held out" if out and configuration in out.region.rows else "nothing in use"

    def _corner_layers(
        self, corners: BoardCorners, of_edges: Sequence[blocks.Arrow]
    ) -> tuple[blocks.Layer, blocks.Layer]:
        """Detected corners, and arrows to where they are predicted, with those of the edges."""
        rings, arrows = list[blocks.Shape](), list[blocks.Shape](of_edges)
        for n in range(len(corners)):
            (x, y), (dx, dy) = corners.pixel[n].tolist(), (-corners.off[n]).tolist()
            tip = (
                f"Corner {corners.name[n]}: {number(-dx, 2, signed=True)},"
                f" {number(-dy, 2, signed=True)} px from where it is expected"
            )
            at, dashed = (round(x, 2), round(y, 2)), not corners.used[n]
            rings.append(blocks.Ring(at=at, tip=tip, dashed=dashed))
            arrows.append(
                blocks.Arrow(
                    at=at, displacement=(round(dx, 4), round(dy, 4)), tip=tip, dashed=dashed
                )
            )
        return (
            blocks.Layer(name="corners", shapes=tuple(rings)),
            blocks.Layer(name="residuals", shapes=tuple(arrows), enlargement=self.factor),
        )

    def _edges(self, shifts: Array, s: int, configurations: Integers) -> None:
        """Collect the measured edges of a station."""
        edges, estimate = self.calibration.observation.edges, self.calibration.estimate
        mine = np.flatnonzero((edges.station == s) & np.isin(edges.configuration, configurations))
        curves = straightened(edge_curves(self.calibration, mine, s))
        for n, points in zip(mine.tolist(), curves, strict=True):
            weight = float(estimate.edge_weights[n])
            tip = self._tip(n, number(float(shifts[n]), 2, signed=True))
            drawn = polyline(int(edges.leg[n]), points, weight < INLIER_WEIGHT, tip)
            if drawn:
                self.edges[s, int(edges.configuration[n])][n] = drawn
        # residuals at the middles of the edges
        offsets = edge_offsets(self.calibration.session, edges, estimate, s, mine)
        middle = np.arange(len(mine)) * len(FIELD_EDGE_FRACTIONS) + len(FIELD_EDGE_FRACTIONS) // 2
        off = (offsets.value[:, None] * offsets.direction)[middle]
        measured = offsets.pixel[middle] + off
        for n, (x, y), (dx, dy) in zip(mine.tolist(), measured.tolist(), off.tolist(), strict=True):
            if np.isfinite([x, y, dx, dy]).all():
                arrow = blocks.Arrow(
                    at=(round(x, 1), round(y, 1)),
                    displacement=(round(-dx, 3), round(-dy, 3)),
                    dashed=bool(estimate.edge_weights[n] < INLIER_WEIGHT),
                )
                self.residuals[s, int(edges.configuration[n])].append(arrow)

    def _tip(self, n: int, outward: str) -> str:
        """Tooltip of an edge.

        outward : its displacement from the predicted edge, px.
        """
        edges, estimate = self.calibration.observation.edges, self.calibration.estimate
        across, tilt = estimate.edge_residuals[n].tolist()
        name = edge_name(int(edges.leg[n]), int(edges.tube[n]), int(edges.side[n])).capitalize()
        coarse = ", by its silhouette" if edges.coarse[n] else ""
        words = residual_words(across, tilt, float(estimate.edge_weights[n]))
        return f"{name}{coarse}: {outward} px outward; {words}"

    def _missed(self, rejected: list[Rejection], s: int, configurations: Integers) -> None:
        """Collect predictions of rejected edges, each with the reason."""
        machine, camera = self.calibration.machine, self.calibration.session.stations[s].camera
        row = {int(k): n for n, k in enumerate(configurations)}
        some = [one for one in rejected if one.leg >= 0 and one.configuration in row]
        if not some:
            return
        legs, tubes = _legs(self.calibration, s, configurations), tubes_of(machine)
        pixel = edge_points(machine, camera, legs, tubes, EDGE_CURVE_POINTS).pixel
        inside = np.where(camera.in_image(pixel)[..., None], pixel, np.nan)
        curves = [straightened(of_image) for of_image in inside]
        for one in some:
            at = row[one.configuration]
            meant = (tubes.leg == one.leg) & ((one.tube < 0) | (tubes.tube == one.tube))
            meant &= (one.side < 0) | (tubes.side == one.side)
            for e in np.flatnonzero(meant).tolist():
                edge = edge_name(one.leg, int(tubes.tube[e]), int(tubes.side[e]))
                tip = f"{edge.capitalize()}, not used: {one.reason}"
                drawn = polyline(one.leg, curves[at][e], True, tip)
                if drawn:
                    self.missed[s, one.configuration].append(drawn)

    def _spots(self, centres: tuple[Centres, ...], s: int, configurations: Integers) -> None:
        """Collect joint centres of the calibrated and of the aligned nominal machine."""
        session, state = self.calibration.session, self.calibration.estimate.state
        camera, T_camera_base = session.stations[s].camera, state.T_camera_base[s]
        pose, joints = state.T_base_platform[configurations], session.joints[configurations]
        base, platform = (side.T_calibrated_nominal for side in centres)
        after = self.calibration.machine.ends_at(joints, pose)
        # pose of the nominal machine in its own frames
        old_pose = inverse(base) @ pose @ platform
        before = session.machine.ends_at(joints, old_pose)
        calibrated = camera.project(apply(T_camera_base, np.stack([after.a, after.b])))
        nominal = camera.project(apply(T_camera_base @ base, np.stack([before.a, before.b])))
        inside = camera.in_image(calibrated)
        for n, k in enumerate(configurations.tolist()):
            labelled: set[int] = set()
            for side, end in enumerate(("base", "platform")):
                for j in np.flatnonzero(inside[side, n]).tolist():
                    old = nominal[side, n, j]
                    cross = _rounded_pixel(old) if np.isfinite(old).all() else None
                    new = _rounded_pixel(calibrated[side, n, j])
                    self.spots[s, k].append(Spot(j + 1, end, new, cross, j not in labelled))
                    labelled.add(j)


def edge_curves(c: Calibration, mine: Integers, s: int) -> Array:
    """Curves (n, EDGE_CURVE_POINTS, 2) px of the edges ``mine`` (n,) in the images of station s."""
    edges, camera = c.observation.edges.select(mine), c.session.stations[s].camera
    rows, image = np.unique(edges.configuration, return_inverse=True)
    return measured_curves(c.machine, camera, _legs(c, s, rows), image, edges)


def _legs(c: Calibration, s: int, rows: Integers) -> LegsInCamera:
    """Calibrated legs in the frame of a station's camera, in some configurations."""
    state = c.estimate.state
    return legs_in_camera(
        c.machine, state.T_camera_base[s], state.T_base_platform[rows], c.session.joints[rows]
    )


def _rounded_pixel(point: Array) -> tuple[float, float]:
    """Pixel with one decimal."""
    return round(float(point[0]), 1), round(float(point[1]), 1)
