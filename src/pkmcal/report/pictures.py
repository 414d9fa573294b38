"""Images with the measured edges and corners drawn over them, as in [B] Figs. 6 and 8."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array, Integers, enlargement
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.identify.centres import Centres
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import Observation, Rejection
from pkmcal.observe.images import Pictures
from pkmcal.observe.predict import LegsInCamera, edge_points, legs_in_camera, tubes_of
from pkmcal.outcome import Part
from pkmcal.pages import page
from pkmcal.pages.jpegs import FULL_JPEGS, small_and_large
from pkmcal.pages.overlays import (
    EDGE_CURVE_POINTS,
    INLIER_WEIGHT,
    Arrow,
    Drawn,
    Picture,
    Spot,
    edge_name,
    measured_curves,
    polyline,
    residual_words,
    straightened,
)
from pkmcal.report.corners import BoardCorners, board_corners
from pkmcal.report.links import Links, Place
from pkmcal.session.image_files import Image
from pkmcal.session.load import Session, Station
from pkmcal.wording import brief, count, number

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

CORNER_ARROW_LENGTH = 0.03
"""Length of a large corner residual as drawn, in image widths."""


@dataclass(frozen=True)
class AlbumSize:
    """Room for images on a page."""

    # images: browsers take a second to lay out as many
    images: int = 400
    # characters of all JPEGs
    jpeg_characters: int = 8_000_000


ALBUM_SIZE = AlbumSize()


@dataclass(frozen=True)
class Album:
    """Images on the page.

    rejected : images that could not be localized.
    total : number of all other images.
    factor : enlargement of the corners' residuals.
    corners : corners of the board in all images.
    """

    pictures: tuple[Picture, ...]
    rejected: tuple[Picture, ...]
    total: int
    factor: float
    links: Links
    corners: BoardCorners


def section(session: Session, display: Album) -> Part:
    """Section of the report."""
    html = page.filled_template(
        "photographs.html.j2",
        n_legs=session.machine.n_legs,
        album=display,
        legs=any(p.edges or p.missed or p.spots for p in display.pictures),
        boards=any(p.corners for p in display.pictures),
        missed=any(p.missed for p in display.pictures),
        large=sum(bool(p.large) for p in display.pictures),
        full=FULL_JPEGS,
    )
    return Part("photographs", "Images", html=html)


def album(
    calibration: Calibration,
    shifts: Array,
    centres: tuple[Centres, ...],
    largest: AlbumSize = ALBUM_SIZE,
) -> Album:
    """Images with their overlays, as many as there is room for.

    Images without data in use come first, then those with the largest residuals.

    shifts : (N,) px of the edges, for tooltips.
    """
    session, level = calibration.session, levels(calibration.observation, calibration.estimate)
    # the first image of each configuration at each station
    every = [
        (s, photo)
        for s, station in enumerate(session.stations)
        for photo in {p.configuration: p for p in reversed(station.images)}.values()
    ]
    ordered = sorted(every, key=lambda item: -level.get((item[0], item[1].configuration), np.inf))
    images = {s: _decoded(station) for s, station in enumerate(session.stations)} | {
        **calibration.images
    }
    files = [
        (images[s], session.stations[s].images.index(photo))
        for s, photo in ordered[: largest.images]
    ]
    # JPEGs until the budget is spent; overlays for the images that have one
    shots = list(small_and_large(files, largest.jpeg_characters))
    chosen = ordered[: len(shots)]
    links = Links.of((s, photo.configuration) for s, photo in chosen)
    overlays = _ImageOverlays(calibration, shifts, centres, chosen)
    room = largest.jpeg_characters - sum(len(small) + len(large) for small, large in shots)
    return Album(
        tuple(
            overlays.picture(s, photo, shot, links.anchors[place], level.get(place, np.nan))
            for (s, photo), shot in zip(chosen, shots, strict=True)
            for place in [(s, photo.configuration)]
        ),
        tuple(_rejected(session, largest.images, room)),
        len(every),
        overlays.factor,
        links,
        overlays.corners,
    )


def _rejected(session: Session, most: int, room: int) -> Iterator[Picture]:
    """Images that could not be localized, each with the reason.

    ``most`` of them are shown, in ``room`` characters of JPEGs. Images without room are listed
    without their JPEG.
    """
    lost = [(one, photo) for one in session.rejected for photo in one.station.images]
    files = [(_decoded(one.station), one.station.images.index(photo)) for one, photo in lost[:most]]
    shots = list(small_and_large(files, room))
    shots += [("", "")] * (len(lost) - len(shots))
    for k, ((one, photo), shot) in enumerate(zip(lost, shots, strict=True), start=1):
        width, height = one.station.camera.image_size
        yield Picture(
            station=one.station.name,
            configuration=session.configurations[photo.configuration],
            width=width,
            height=height,
            jpeg=shot[0],
            large=shot[1],
            caption=f"left out, for {one.reason}",
            anchor=f"rejected-{k}",
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

    factor : enlargement of the corners' residuals.
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
        self.edges: dict[Place, list[Drawn]] = defaultdict(list)
        self.missed: dict[Place, list[Drawn]] = defaultdict(list)
        self.spots: dict[Place, list[Spot]] = defaultdict(list)
        self.reasons: dict[Place, list[str]] = defaultdict(list)
        self.corners = board_corners(session, calibration.boards, estimate)
        width = max((s.camera.image_size[0] for s in session.stations), default=0)
        self.factor = enlargement(
            np.linalg.norm(self.corners.off, axis=1), CORNER_ARROW_LENGTH * width
        )
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

    def picture(
        self, s: int, photo: Image, shot: tuple[str, str], anchor: str, level: float
    ) -> Picture:
        """Image with its overlays."""
        session = self.calibration.session
        k, station = photo.configuration, session.stations[s]
        p, c = station.images.index(photo), self.corners
        mine = c.select((c.station == s) & (c.image == p))
        width, height = station.camera.image_size
        edges, missed = self.edges[s, k], self.missed[s, k]
        n_rejected = sum(edge.quiet for edge in edges)
        rms = float(np.sqrt(np.mean(np.sum(mine.off**2, axis=1)))) if len(mine) else 0.0
        captions = [
            count(len(edges), "edge") + (f", {n_rejected} of them rejected" if n_rejected else "")
            if edges
            else "",
            f"{len(missed)} not used" if missed else "",
            f"{count(len(mine), 'corner')}, {brief(rms)} px off" if len(mine) else "",
            f"residuals {number(level, 2)} σ" if np.isfinite(level) else "nothing in use",
            *self.reasons[s, k],
            "" if shot[0] else "the file could not be read",
        ]
        return Picture(
            station=station.name,
            configuration=session.configurations[k],
            width=width,
            height=height,
            jpeg=shot[0],
            large=shot[1],
            edges=tuple(edges),
            missed=tuple(missed),
            spots=tuple(self.spots[s, k]),
            corners=tuple(self._corner(mine, n) for n in range(len(mine))),
            caption="; ".join(text for text in captions if text),
            anchor=anchor,
        )

    def _corner(self, corners: BoardCorners, n: int) -> Arrow:
        """Arrow from a detected corner to its prediction."""
        (x, y), (dx, dy) = corners.pixel[n].tolist(), (-corners.off[n]).tolist()
        tip = (
            f"Corner {corners.name[n]}: {number(-dx, 2, signed=True)},"
            f" {number(-dy, 2, signed=True)} px from where it is expected"
        )
        return Arrow(x, y, dx * self.factor, dy * self.factor, not corners.used[n], tip)

    def _edges(self, shifts: Array, s: int, configurations: Integers) -> None:
        """Collect the measured edges of a station."""
        edges, estimate = self.calibration.observation.edges, self.calibration.estimate
        mine = np.flatnonzero((edges.station == s) & np.isin(edges.configuration, configurations))
        curves = straightened(edge_curves(self.calibration, mine, s))
        for n, points in zip(mine.tolist(), curves, strict=True):
            weight = float(estimate.edge_weights[n])
            across, tilt = estimate.edge_residuals[n].tolist()
            leg, tube, side = (int(x[n]) for x in (edges.leg, edges.tube, edges.side))
            coarse = ", by its silhouette" if edges.coarse[n] else ""
            tip = (
                f"{edge_name(leg, tube, side).capitalize()}{coarse}:"
                f" {number(float(shifts[n]), 2, signed=True)} px outward;"
                f" {residual_words(across, tilt, weight)}"
            )
            drawn = polyline(leg, points, weight < INLIER_WEIGHT, tip)
            if drawn:
                self.edges[s, int(edges.configuration[n])].append(drawn)

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
