"""Images of a check with the nominal model overlaid, by the given and by the localized pose.

For the page, and as PNG files, in which large images are binned as for the search for edges.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.checks.inspection import Inspection, StationInspection
from pkmcal.files import place_below, staged_folder
from pkmcal.observe.images import upright_turns
from pkmcal.observe.overlays import (
    EdgeCurve,
    Spot,
    edge_layer,
    joint_layers,
    machine_laid_over,
)
from pkmcal.observe.page_images import PAGE_IMAGE_CHARACTERS, images_within
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import image_key
from pkmcal.outcome.blocks.images import Image, Images, Overlay
from pkmcal.outcome.blocks.plot import leg_colour
from pkmcal.outcome.blocks.text import Hint, Paragraph

DRAWN_PIXEL_BINARY_DIGITS = 4
"""Binary digits of the fractions of a pixel in cv2's drawing functions."""
CAPTION_BAR_HEIGHT = 26
"""Height (px) of the caption above each image."""
PANE_GAP = 6
"""Distance (px) between the two images."""
RGB = {
    "leg-1": 0xFFB52E, "leg-2": 0x6AD0FF, "leg-3": 0x28DCA8, "leg-4": 0xFF9FD8,
    "leg-5": 0x86AAFF, "leg-6": 0xFF7C3A, "leg-7": 0xF4E04D, "leg-8": 0xD5DBE0,
}  # fmt: skip
"""Colours of legs on images, those of ``viewer/src/overlay.css``."""
NOMINAL_OVER_IMAGES_TEXT = (
    "Lines: the nominal model's legs in their colours; circles: its joints. At the pose found they"
    " lie on the legs to a few pixels, as far as the nominal model is right; where they do not, or"
    " follow another leg, something is mixed up. At a pose by hand they need only lie near the"
    " legs."
)


def with_pictures(inspection: Inspection) -> Part:
    """Section of the page with the images, each with every available pose."""
    # a few of each station first
    first = [(s, k) for s, one in enumerate(inspection.stations) for k in one.few().tolist()]
    others = [
        (s, k) for s, one in enumerate(inspection.stations) for k in range(len(one.images.images))
    ]
    order = list(dict.fromkeys([*first, *others]))
    files = [(inspection.stations[s].images.images, k) for s, k in order]
    contents = images_within(files, PAGE_IMAGE_CHARACTERS)
    images = [_image(inspection, s, k, one) for (s, k), one in zip(order, contents, strict=False)]
    text = NOMINAL_OVER_IMAGES_TEXT
    if len(images) < len(order):
        text += f" Here are {len(images)} of {len(order)} images."
    block = Images(images=tuple(images), first=len(first), legs=inspection.session.machine.n_legs)
    return Part(
        "photographs",
        "The nominal model over the images",
        blocks=(
            Paragraph(text=text),
            Hint(text="Open an image to compare both poses (key o)."),
            block,
        ),
        menu="Images",
    )


def _image(inspection: Inspection, s: int, k: int, webp: str) -> Image:
    """Image k of a station with an overlay for each pose, that of the search first."""
    session, station = inspection.session, inspection.stations[s]
    camera, name = station.images.camera, station.name
    configuration = session.configurations[int(station.images.configuration[k])]
    overlays: list[Overlay] = []
    for title, T_camera_base in reversed(poses_of(station)):
        edges, spots = nominal_over_image(inspection, station, camera, T_camera_base, k)
        layers = edge_layer("edges", edges), *joint_layers(spots)
        overlays.append(Overlay(title=title.capitalize(), layers=layers))
    path = session.stations[station.images.station].images[k].path
    return Image(
        title=f"{name} / {configuration}",
        caption="" if webp else "the file could not be read",
        group=name,
        key=image_key(name, configuration),
        width=camera.image_size[0],
        height=camera.image_size[1],
        quarter_turns=upright_turns(path, camera.image_size),
        webp=webp,
        overlays=tuple(overlays),
    )


def poses_of(station: StationInspection) -> tuple[tuple[str, Array], ...]:
    """Poses T_camera_base for overlays with their captions; the given pose comes first."""
    after = "pose found" if station.recognised else "best candidate pose, not localized"
    by_hand = () if station.by_hand is None else (("pose by hand", station.by_hand),)
    return *by_hand, (after, station.T_camera_base)


def nominal_over_image(
    inspection: Inspection, station: StationInspection, camera: Camera, T_camera_base: Array, k: int
) -> tuple[tuple[EdgeCurve, ...], tuple[Spot, ...]]:
    """Visible silhouettes of the nominal tubes in image k, and the joint centres.

    camera : of the station, or of its binned images.
    """
    configuration = int(station.images.configuration[k])
    return machine_laid_over(
        inspection.session.machine,
        camera,
        T_camera_base,
        inspection.session.joints[configuration],
        inspection.poses[configuration],
    )


# ------------------------------------------------------------------ as files


def picture_names(inspection: Inspection) -> dict[tuple[int, int], str]:
    """File names by station and image."""
    out: dict[tuple[int, int], str] = {}
    for s, station in enumerate(inspection.stations):
        images = inspection.session.stations[station.images.station].images
        for k in range(len(images)):
            out[s, k] = re.sub(r"[/\\]", "-", f"{station.name}-{images[k].path.stem}.png")
    return out


def write_pictures(inspection: Inspection, folder: Path) -> None:
    """Write all images as PNG, the given pose left and the localized one right; all or none."""
    import cv2

    with staged_folder(folder) as stage:
        for (s, k), name in picture_names(inspection).items():
            done, packed = cv2.imencode(".png", picture(inspection, inspection.stations[s], k))
            if not done:
                raise OSError(f"{name} could not be encoded as PNG")
            place_below(stage, name, folder).write_bytes(packed.tobytes())


def picture(inspection: Inspection, station: StationInspection, k: int) -> Any:
    """Image k in colour with its overlays, (h, w, 3) uint8, in cv2's order BGR."""
    import cv2

    name = inspection.session.configurations[int(station.images.configuration[k])]
    small = station.images.select(np.array([k])).binned()
    panes: list[Any] = []
    for words, T_camera_base in poses_of(station):
        pane: Any = cv2.cvtColor(np.asarray(small.images[0]), cv2.COLOR_GRAY2BGR)
        edges, spots = nominal_over_image(inspection, station, small.camera, T_camera_base, k)
        _draw(pane, edges, spots)
        bar = np.full((CAPTION_BAR_HEIGHT, pane.shape[1], 3), 32, dtype=np.uint8)
        text = f"{station.name} / {name}: {words}"
        cv2.putText(bar, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235,) * 3, 1, cv2.LINE_AA)
        panes.append(np.concatenate([bar, pane]))
    gap = np.full((len(panes[0]), PANE_GAP, 3), 32, dtype=np.uint8)
    joined = [part for pane in panes for part in (gap, pane)][1:]
    return np.concatenate(joined, axis=1)


def _draw(pane: Any, edges: tuple[EdgeCurve, ...], spots: tuple[Spot, ...]) -> None:
    """Draw lines and joints into an image, each on a dark one for contrast with white."""
    import cv2

    def fixed(points: Any) -> Any:
        return np.rint(np.asarray(points) * 2**DRAWN_PIXEL_BINARY_DIGITS).astype(np.int32)

    radius = pane.shape[1] / 110
    for width, dark in ((3, True), (1, False)):
        for edge in edges:
            colour = (0, 0, 0) if dark else _colour(edge.leg)
            line = [fixed(edge.points)[:, None]]
            cv2.polylines(pane, line, False, colour, width, cv2.LINE_AA, DRAWN_PIXEL_BINARY_DIGITS)
        for spot in spots:
            colour = (0, 0, 0) if dark else _colour(spot.leg)
            x, y = fixed(spot.calibrated).tolist()
            size = round(radius * 2**DRAWN_PIXEL_BINARY_DIGITS)
            cv2.circle(pane, (x, y), size, colour, width, cv2.LINE_AA, DRAWN_PIXEL_BINARY_DIGITS)
            if spot.labelled:
                at = (
                    round(spot.calibrated[0] + 1.4 * radius),
                    round(spot.calibrated[1] + 2.4 * radius),
                )
                font, scale = cv2.FONT_HERSHEY_SIMPLEX, radius / 14
                cv2.putText(pane, str(spot.leg), at, font, scale, colour, width + 1, cv2.LINE_AA)


def _colour(leg: int) -> tuple[int, int, int]:
    """Colour of a leg on images, BGR."""
    n = RGB[leg_colour(leg)]
    return n & 255, n >> 8 & 255, n >> 16
