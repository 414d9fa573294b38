"""A board's corners in one image: found by OpenCV's detectors, then fitted to sub-pixel.

A detector says which corners there are and where they lie to a pixel; of boards with markers also
whether the picture is a mirror image. Each corner is then fitted to the grey levels around it
(:mod:`pkmcal.boards.corner_fit`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.boards.board import Board, Detection
from pkmcal.boards.circles import Circles, find_circles
from pkmcal.boards.corner_fit import (
    CORNER_FIT_OPTIONS,
    CornerFitOptions,
    Corners,
    Window,
    refine,
)
from pkmcal.boards.saddles import image_noise, largest_block
from pkmcal.levels import CONTRADICTION_SIGMAS, FEW, MAJORITY, NEARLY_ALL
from pkmcal.observe.images import narrowed
from pkmcal.solver.ranks import column_space


@dataclass(frozen=True)
class BoardDetectionOptions:
    """Constants of the detection of a board's corners.

    Limits count corners or markers; the widths bound the cost of the search.
    """

    # fit of each corner
    corner: CornerFitOptions = CORNER_FIT_OPTIONS
    # share of the corners of a chessboard or of a grid of circles that must fit: these are detected
    # as a whole, and what has less is something else
    whole_share: float = MAJORITY
    # share of the middles of 3 x 3 corners of a chessboard below which it is not searched; a corner
    # in glare, or covered, costs up to nine
    visible_share: float = FEW
    # px by which an edge may leave its tangent within the window before its bend is modelled
    straight: float = 0.02
    # share of the blank border between edge and marker that the window may fill
    blank_share: float = NEARLY_ALL
    # corners below which an image says nothing: four fix a board's pose, two more test it
    # (derived)
    least_corners: int = 6
    # width, px, from which images are tried at half their size as well
    half_size_from: int = 1000
    # width, px, to which larger images are reduced to search for a chessboard, and for outlines of
    # markers; one way takes ten
    # seconds on a cluttered image of twelve megapixels (measured)
    searched_width: int = 1600
    # fewest markers visible of a ChArUco board, six corners of which lie between six, and of a grid
    least_charuco_markers: int = 4
    least_grid_markers: int = 2
    # what may be a marker: the middle of the narrowest border, half of one of nine modules, as a
    # share of the marker's side; the least share of light and of dark bits in a marker of OpenCV's
    # dictionaries, 2 of 16; and the contrast between them, in standard deviations of the noise
    border_place: float = 1 / 18
    least_bits: float = 1 / 8
    marker_contrast: float = CONTRADICTION_SIGMAS


BOARD_DETECTION_OPTIONS = BoardDetectionOptions()


DETECTION_ORDER = ((False, True), (False, False), (True, True), (True, False))
"""Runs of the detector of markers: in the mirrored image or not, and by one threshold alone, five
times as fast and enough where it shows the whole board, or by all."""

Raw = tuple[Integers, Array]
"""Corner ids (n,) and pixels (n, 2) as a detector gives them."""
NO_CORNERS: Raw = (np.zeros(0, dtype=int), np.zeros((0, 2)))


def detect_board(
    image: Integers,
    board: Board,
    name: str = "",
    quick: bool = False,
    options: BoardDetectionOptions = BOARD_DETECTION_OPTIONS,
    block: int | None = None,
) -> Detection:
    """Find the board's corners in one image, grey levels (height, width) uint8.

    quick : only the first way of finding a chessboard. block : the image's `largest_block`, None if
        it is not known yet.
    """
    mirrored, why = False, ""
    circles: Circles | None = None
    if board.type == "charuco":
        raw, mirrored, why = _charuco(image, board, options)
    elif board.type == "aruco_grid":
        raw, mirrored, why = _marker_grid(image, board, options)
    else:
        if board.type == "chessboard":
            pixels = find_chessboard(image, board.counts, quick, block, options)
            why = f"no chessboard of {board.counts[0]}x{board.counts[1]} inner corners"
        else:
            circles, why = find_circles(image, board)
            pixels = None if circles is None else circles.pixels
        raw = NO_CORNERS if pixels is None else (np.arange(len(pixels)), pixels)
    size = (image.shape[1], image.shape[0])
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0)
    if len(raw[0]) < options.least_corners:
        return Detection(name, size, *nothing, reason=why)
    fitted = _fitted(image, board, raw, options) if circles is None else circles
    ids, good = raw[0], fitted.good
    weak = tuple(int(i) for i in ids[~good])
    least = (
        options.whole_share * len(board.points)
        if board.type in ("chessboard", "circle_grid")
        else options.least_corners
    )
    xy = board.points[ids[good], :2]
    # corners on one line do not determine a pose
    if good.sum() < least or column_space(xy - xy.mean(axis=0)).shape[1] < 2:
        why = f"only {good.sum()} of {len(board.points)} corners are sharp and uncovered"
        return Detection(name, size, *nothing, reason=why, weak=weak)
    return Detection(
        name, size, ids[good], fitted.pixels[good], fitted.sigma[good], "", weak, mirrored
    )


def _charuco(
    image: Integers, board: Board, options: BoardDetectionOptions
) -> tuple[Raw, bool, str]:
    best, markers = NO_CORNERS, 0
    for mirrored, quick in DETECTION_ORDER:
        picture = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        corners, ids, _, marker_ids = charuco_detector(board.document, quick).detectBoard(picture)
        markers = max(markers, _length(marker_ids))
        count = _raw(corners, ids, image.shape[1], mirrored)
        if len(count[0]) >= (len(board.points) if quick else options.least_corners):
            return count, mirrored, ""
        best = max(best, count, key=lambda raw: len(raw[0]))
        if (mirrored, quick) == DETECTION_ORDER[0] and _few_outlines(
            image, options.least_charuco_markers, options
        ):
            break
    why = f"{markers} of the board's markers and {len(best[0])} corners are detected"
    return best, False, why if markers else "none of the board's markers"


def charuco_detector(data: dict[str, Any], quick: bool = False) -> Any:
    """OpenCV's detector of a ChArUco board's fields; quick : by its finest threshold alone."""
    import cv2

    columns, rows = data["squares"]
    markers = dictionary(data["dictionary"], 0, columns * rows // 2)
    board = cv2.aruco.CharucoBoard((columns, rows), data["square"], data["marker"], markers)
    board.setLegacyPattern(bool(data.get("legacy", False)))
    return cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), _thresholds(quick))


def _thresholds(quick: bool) -> Any:
    """Parameters of OpenCV's marker detection: three thresholds, or quick, the finest alone."""
    import cv2

    how = cv2.aruco.DetectorParameters()
    if quick:
        how.adaptiveThreshWinSizeMax = how.adaptiveThreshWinSizeMin
    return how


def _raw(corners: Any, ids: Any, width: int, mirrored: bool) -> Raw:
    """OpenCV's corners and ids, whose shapes differ between versions."""
    if _length(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    pixels = np.asarray(corners, dtype=float).reshape(-1, 2)
    if mirrored:
        pixels = pixels * [-1, 1] + [width - 1, 0]
    return np.asarray(ids).reshape(-1).astype(int), pixels


def _length(value: Any) -> int:
    """Entries of what OpenCV found; None where it found nothing."""
    return 0 if value is None else len(value)


def dictionary(name: str, first: int = 0, count: int | None = None) -> Any:
    """OpenCV's dictionary of markers, or ``count`` of them, numbered from ``first`` on.

    A detector spends most of its time on comparing squares with all markers of its dictionary.
    """
    import cv2

    whole = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    if count is None:
        return whole
    some = whole.bytesList[first : first + count]
    return cv2.aruco.Dictionary(some, whole.markerSize, whole.maxCorrectionBits)


def marker_bits(name: str) -> int:
    """Bits of a marker's side without its border."""
    return int(dictionary(name).markerSize)


class Markers(NamedTuple):
    """Markers in an image: ids (k,) and corners (k, 4, 2) px."""

    ids: Integers
    corners: Array


def detect_markers(image: Integers, words: Any, quick: bool = False, border: int = 1) -> Markers:
    """The markers of a dictionary; quick : by the finest threshold alone. border : its modules."""
    import cv2

    how = _thresholds(quick)
    how.markerBorderBits = border
    corners, ids, _ = cv2.aruco.ArucoDetector(words, how).detectMarkers(image)
    if _length(ids) == 0:
        return Markers(np.zeros(0, dtype=int), np.zeros((0, 4, 2)))
    corners = np.asarray(corners, float).reshape(-1, 4, 2)
    return Markers(np.asarray(ids).reshape(-1).astype(int), corners)


def marker_outlines(
    image: Integers, options: BoardDetectionOptions = BOARD_DETECTION_OPTIONS
) -> Array:
    """Outlines (k, 4, 2) px of what may be markers of any dictionary: quadrilaterals with, inside,
    areas as dark as the border and light ones.

    A detector compares each quadrilateral with all markers of its dictionary, which takes most of
    its time; photographs without a board have hundreds of quadrilaterals.
    """
    import cv2

    # The smallest dictionary: what is none of its markers is returned as well.
    detector = cv2.aruco.ArucoDetector(dictionary("DICT_APRILTAG_16h5"), _thresholds(False))
    detected, _, rejected = detector.detectMarkers(image)
    outlines = np.array([*detected, *rejected], dtype=float).reshape(-1, 4, 2)
    # One ring of samples in the middle of the narrowest border, and a lattice of them inside.
    side, edge = np.linspace(0.08, 0.92, 11), options.border_place
    ring = [[(s, e), (e, s)] for s in side for e in (edge, 1 - edge)]
    lattice = np.stack(np.meshgrid(*[np.linspace(0.2, 0.8, 13)] * 2), axis=-1)
    u = np.concatenate([np.reshape(ring, (-1, 2)), lattice.reshape(-1, 2)])
    x, y = u[:, 0], u[:, 1]
    corners = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=-1)
    places = np.rint(corners @ outlines).astype(int)
    column, row = np.clip(places, 0, np.array(image.shape[::-1]) - 1).transpose(2, 0, 1)
    grey = image[row, column].astype(float)
    border, inside = grey[:, : 4 * len(side)], grey[:, 4 * len(side) :]
    dark = np.median(border, axis=1)
    # of the outer modules the lattice leaves out a part: a corner's have 4.9 % of it, not 1 of 16
    least = options.least_bits / 2
    light = np.quantile(inside, 1 - least, axis=1)
    middle = (dark + light)[:, None] / 2
    share = np.mean(inside > middle, axis=1)
    marker_like = (
        (light - dark > options.marker_contrast * image_noise(image))
        & (share >= least)
        & (share <= 1 - least)
    )
    return outlines[marker_like]


def _few_outlines(image: Integers, least: int, options: BoardDetectionOptions) -> bool:
    """Whether an image has too few outlines of markers for a board with `least` markers visible."""
    return len(marker_outlines(narrowed(image, options.searched_width)[0], options)) < least


def _marker_grid(
    image: Integers, board: Board, options: BoardDetectionOptions
) -> tuple[Raw, bool, str]:
    data = board.document
    count = board.counts[0] * board.counts[1]
    words = dictionary(data["dictionary"], data.get("first_id", 0), count)
    for mirrored, quick in DETECTION_ORDER:
        picture = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        ids, corners = detect_markers(picture, words, quick, data.get("border", 1))
        once = ~np.isin(ids, [i for i in np.unique(ids) if np.sum(ids == i) > 1])
        if once.sum() >= (count if quick else options.least_grid_markers):
            values = (4 * ids[once, None] + np.arange(4)).reshape(-1)
            return _raw(corners[once], values, image.shape[1], mirrored), mirrored, ""
        if (mirrored, quick) == DETECTION_ORDER[0] and _few_outlines(
            image, options.least_grid_markers, options
        ):
            break
    return NO_CORNERS, False, "fewer than two of the board's markers are detected"


def find_chessboard(
    image: Integers,
    counts: tuple[int, int],
    quick: bool = False,
    block: int | None = None,
    options: BoardDetectionOptions = BOARD_DETECTION_OPTIONS,
) -> Array | None:
    """Corners (rows * columns, 2) px in the board's order, None where not found.

    quick : the first way only, for trying many counts. block : the image's `largest_block`, None if
        it is not known yet.
    """
    if block is None:
        block = largest_block(narrowed(image, options.searched_width)[0])
    middles = (counts[0] - 2) * (counts[1] - 2)
    if block < max(1.0, options.visible_share * middles):
        return None
    for pixels in _attempts(image, counts, quick, options):
        grid = pixels.reshape(counts[1], counts[0], 2)
        if _is_grid(grid):
            return _oriented(image, grid).reshape(-1, 2)
    return None


def _attempts(
    image: Integers, counts: tuple[int, int], quick: bool, options: BoardDetectionOptions
) -> Iterator[Array]:
    """Corners by OpenCV's detectors in turn, the fastest and most successful first."""
    import cv2

    thorough = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    adaptive = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for picture, scale in _pictures(image, quick, options):
        ways = [
            lambda p=picture: cv2.findChessboardCornersSB(p, counts, flags=thorough),
            lambda p=picture: cv2.findChessboardCorners(p, counts, flags=adaptive),
        ]
        # On a large cluttered picture the second way takes seconds.
        large = picture.shape[1] > options.searched_width
        for attempt in ways[:1] if quick or large else ways:
            # OpenCV's detector draws random numbers: the same image shall give the same corners
            cv2.setRNGSeed(0)
            value, corners = attempt()
            if value and _length(corners) == counts[0] * counts[1]:
                pixels = np.asarray(corners, dtype=float).reshape(-1, 2)
                yield (pixels + 0.5) / scale - 0.5


def _pictures(
    image: Integers, quick: bool, options: BoardDetectionOptions
) -> Iterator[tuple[Any, float]]:
    """The image; with its contrast evened out; smaller; larger; each with its scale."""
    import cv2

    image, scale = narrowed(image, options.searched_width)
    yield image, scale
    if quick:
        return
    yield cv2.createCLAHE(3.0, (8, 8)).apply(image), scale
    if image.shape[1] > options.half_size_from:
        yield cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 0.5 * scale
    yield cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC), 2.0 * scale


def _is_grid(grid: Array) -> bool:
    """Whether corners (rows, columns, 2) are in order: the images of squares are convex and all
    have one orientation.
    """
    right, down = np.diff(grid, axis=1), np.diff(grid, axis=0)
    area = [
        x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]
        for x in (right[:-1], right[1:])
        for y in (down[:, :-1], down[:, 1:])
    ]
    return bool(np.all(np.array(area) > 0) or np.all(np.array(area) < 0))


def _oriented(image: Integers, grid: Array) -> Array:
    """The grid seen from the front and, where its colours tell, from its dark first square.

    Turns by 180 degrees only: the counts fix the rest, or (square boards) nothing does.
    """
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        grid = grid[:, ::-1]
    if sum(grid.shape[:2]) % 2 and _first_square_light(image, grid):
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid)


def _first_square_light(image: Integers, grid: Array) -> bool:
    """True where the square whose last corner is the grid's first is lighter than its neighbours.

    Decided by all inner squares, of which alternate ones have equal colours, since one may lie in
    a shadow.
    """
    centre = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    x, y = np.rint(centre).astype(int).reshape(-1, 2).T
    grey = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
    row, column = np.mgrid[: centre.shape[0], : centre.shape[1]].reshape(2, -1)
    # inner square (0, 0) has the colour of the first outer one, a diagonal step away
    same = (row + column) % 2 == 0
    return bool(grey[same].mean() > grey[~same].mean())


def _fitted(image: Integers, board: Board, raw: Raw, options: BoardDetectionOptions) -> Corners:
    """The corners' fits; a grid of markers may have plain corners or touching dark squares."""
    ids, pixels = raw
    data = board.document
    if board.type == "aruco_grid":
        module = 1 / (marker_bits(data["dictionary"]) + 2 * data.get("border", 1))
        reach = min(options.corner.reach, 0.8 * data["gap"] / data["marker"])
        axes = _marker_axes(ids, pixels)
        margin = options.blank_share * module
        plain, touching = (
            refine(image, pixels, axes, Window(reach, margin, saddle), options=options.corner)
            for saddle in (False, True)
        )
        # Both may be found: on a marker's inner pattern too. The right ones are the surer ones.
        right = plain.good.sum() > touching.good.sum() or (
            np.median(plain.sigma) <= np.median(touching.sigma)
        )
        return plain if right else touching
    margin = options.corner.reach
    if board.type == "charuco":
        margin = min(
            options.corner.reach, options.blank_share * 0.5 * (1 - data["marker"] / data["square"])
        )
    window = Window(options.corner.reach, margin, True)
    fitted = refine(image, pixels, _axes(board, ids, pixels)[0], window, options=options.corner)
    # The bend of lines is measured by the fitted corners; the detector's are too rough for it.
    sides, bends = _axes(board, ids, fitted.pixels)
    if np.abs(bends).max() * options.corner.reach**2 / 2 < options.straight:
        return fitted
    return refine(image, fitted.pixels, sides, window, bends, fitted, options=options.corner)


def _axes(board: Board, ids: Integers, pixels: Array) -> tuple[Array, Array]:
    """Pictures of the square's two sides at every corner, (n, 2, 2) px, [:, k] along axis k; and
    second differences along them, (n, 2, 2) px.

    From the neighbours found; where a corner has none along an axis, from the mean of the rest.
    """
    columns, rows = board.counts
    grid = np.full((rows * columns, 2), np.nan)
    grid[ids] = pixels
    grid = grid.reshape(rows, columns, 2)
    sides = np.empty((len(ids), 2, 2))
    bends = np.zeros((len(ids), 2, 2))
    for k, axis in enumerate((1, 0)):
        step = np.diff(grid, axis=axis)
        mean = np.nanmean(step.reshape(-1, 2), axis=0) if np.isfinite(step).any() else np.nan
        side = _nanmean(_padded(step, axis, 1, 0), _padded(step, axis, 0, 1))
        side = side.reshape(-1, 2)[ids]
        sides[:, k] = np.where(np.isfinite(side), side, mean)
        # At the board's border the bend of the nearest corner inside serves as well.
        second = _padded(np.diff(step, axis=axis), axis, 1, 1)
        around = _nanmean(np.roll(second, 1, axis), np.roll(second, -1, axis))
        second = np.where(np.isfinite(second), second, around)
        bends[:, k] = np.nan_to_num(second.reshape(-1, 2)[ids])
    # A single row of corners has no second side: take it square.
    for k in (0, 1):
        bare = ~np.isfinite(sides[:, k]).all(axis=1)
        sides[bare, k] = (1 - 2 * k) * sides[bare, 1 - k][:, ::-1] * [1, -1]
    return sides, bends


def _padded(values: Array, axis: int, before: int, after: int) -> Array:
    """With NaN before and after along an axis."""
    shape = list(values.shape)
    shape[axis] += before + after
    out = np.full(shape, np.nan)
    inner = [slice(None)] * values.ndim
    inner[axis] = slice(before, shape[axis] - after)
    out[tuple(inner)] = values
    return out


def _nanmean(*parts: Array) -> Array:
    """Means of what is known (not NaN) in parts of one shape."""
    both = np.stack(parts)
    finite = np.isfinite(both)
    total = np.where(finite, both, 0).sum(axis=0) / np.maximum(finite.sum(axis=0), 1)
    return np.where(finite.any(axis=0), total, np.nan)


def _marker_axes(ids: Integers, pixels: Array) -> Array:
    """Axes of a marker's corners, as :func:`_axes`, with the marker's sides away from the corner;
    ids come in fours.
    """
    corner = pixels.reshape(-1, 4, 2)
    top, right = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 1]
    bottom, left = corner[:, 2] - corner[:, 3], corner[:, 3] - corner[:, 0]
    x = np.stack([top, -top, -bottom, bottom], axis=1)
    y = np.stack([left, right, -right, -left], axis=1)
    return np.stack([x, y], axis=2).reshape(len(ids), 2, 2)
