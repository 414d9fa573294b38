"""A board's corners in one image: found by OpenCV's detectors, then fitted to sub-pixel.

A detector says which corners there are and where they lie to a pixel; of boards with markers also
whether the picture is a mirror image. Each corner is then fitted to the grey levels around it.

Around a corner two edges cross. With e1 and e2 the signed distances of a pixel from them and s
the blur, the picture of a chessboard's corner is ``c + a g(e1 / s) g(e2 / s)`` with
``g = erf(. / sqrt 2)``, and that of a marker's corner the same with ``(1 + g) / 2``. Place, both
directions, blur and grey levels are fitted to all pixels of a window that follows the board's
local scale, so that it stays short where a lens or mirror makes the board small and bends its
lines. This is the maximum-likelihood place of the corner, and measures the same on a slanted
board as on a straight one. All corners of an image are fitted at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.board import Board, Detection
from pkmcal.boards.circles import LEAST_WINDOW_RADIUS, circle_centres, find_circles
from pkmcal.boards.saddles import image_noise, largest_block
from pkmcal.levels import CONTRADICTION_SIGMAS, FEW, MAJORITY, NEARLY_ALL
from pkmcal.observe.images import narrowed
from pkmcal.solver.marquardt import Damping
from pkmcal.solver.ranks import column_space


@dataclass(frozen=True)
class BoardDetectionOptions:
    """Constants of the detection of a board's corners and of their fit.

    A corner is accepted if its fit has more pixels than unknowns, explains most of the
    window's variance, and keeps the corner, its standard deviation and its blur within the window;
    other limits count corners or markers. The widths bound the cost of the search.
    """

    # most steps of a corner's fit
    steps: int = 12
    # step at which a corner has settled, px: a thirtieth of what the noise of a good image does
    settled: float = 1e-3
    # smallest radius of a window, px
    least_radius: float = LEAST_WINDOW_RADIUS
    # largest radius of a window, px: lines bend in a larger one
    most_radius: int = 14
    # share of the window's variance that a corner explains; with 0.5, measured, some corners beside
    # clutter are accepted that are wrong by pixels
    least_explained: float = 0.6
    # share of the corners of a chessboard or of a grid of circles that must fit: these are detected
    # as a whole, and what has less is something else
    whole_share: float = MAJORITY
    # share of the middles of 3 x 3 corners of a chessboard below which it is not searched; a corner
    # in glare, or covered, costs up to nine
    visible_share: float = FEW
    # longest step of each unknown: a pixel, a sixth of a right angle, half a natural unit of blur
    longest_step: tuple[float, ...] = (1.0, 1.0, 0.3, 0.3, 0.5, 1e3, 1e3)
    # squares around a corner that its fit uses, and by which it may move the corner: longer edges
    # contribute little more, and begin to bend
    reach: float = 0.25
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
) -> Detection:
    """Find the board's corners in one image, grey levels (height, width) uint8.

    quick : only the first way of finding a chessboard.
    """
    mirrored, why = False, ""
    if board.type == "charuco":
        raw, mirrored, why = _charuco(image, board, options)
    elif board.type == "aruco_grid":
        raw, mirrored, why = _marker_grid(image, board, options)
    else:
        if board.type == "chessboard":
            pixels = find_chessboard(image, board.counts, quick, options=options)
            why = f"no chessboard of {board.counts[0]}x{board.counts[1]} inner corners"
        else:
            pixels, why = find_circles(image, board), f"no grid like {board.described}"
        raw = NO_CORNERS if pixels is None else (np.arange(len(pixels)), pixels)
    size = (image.shape[1], image.shape[0])
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0)
    if len(raw[0]) < options.least_corners:
        return Detection(name, size, *nothing, reason=why)
    fitted = _fitted(image, board, raw, options)
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
    if board.type == "circle_grid":
        centres, good, sigma = circle_centres(image, board, pixels)
        return Corners(centres, good, sigma, np.zeros((len(ids), 7)))
    if board.type == "aruco_grid":
        module = 1 / (marker_bits(data["dictionary"]) + 2 * data.get("border", 1))
        reach = min(options.reach, 0.8 * data["gap"] / data["marker"])
        axes = _marker_axes(ids, pixels)
        plain = refine(
            image, pixels, axes, Window(reach, options.blank_share * module, False), options=options
        )
        touching = refine(
            image, pixels, axes, Window(reach, options.blank_share * module, True), options=options
        )
        # Both may be found: on a marker's inner pattern too. The right ones are the surer ones.
        right = plain.good.sum() > touching.good.sum() or (
            np.median(plain.sigma) <= np.median(touching.sigma)
        )
        return plain if right else touching
    margin = options.reach
    if board.type == "charuco":
        margin = min(
            options.reach, options.blank_share * 0.5 * (1 - data["marker"] / data["square"])
        )
    window = Window(options.reach, margin, True)
    fitted = refine(image, pixels, _axes(board, ids, pixels)[0], window, options=options)
    # The bend of lines is measured by the fitted corners; the detector's are too rough for it.
    sides, bends = _axes(board, ids, fitted.pixels)
    if np.abs(bends).max() * options.reach**2 / 2 < options.straight:
        return fitted
    return refine(image, fitted.pixels, sides, window, bends, fitted, options=options)


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


class Window(NamedTuple):
    """Pixels around a corner that are fitted, in squares of the board from the corner.

    reach : extent along the edges.
    margin : extent across them (a ChArUco board's markers begin behind it); equal to ``reach``
        where nothing is printed inside the squares.
    saddle : two dark squares meet at the corner, not one.
    """

    reach: float
    margin: float
    saddle: bool


class Corners(NamedTuple):
    """Fitted corners: places (n, 2) px, where the fit holds (n,), sigma (n,) px a coordinate, and
    the seven unknowns of the fit around those places (n, 7).
    """

    pixels: Array
    good: Booleans
    sigma: Array
    unknowns: Array


def refine(
    image: Integers,
    start: Array,
    axes: Array,
    window: Window,
    bends: Array | None = None,
    before: Corners | None = None,
    options: BoardDetectionOptions = BOARD_DETECTION_OPTIONS,
) -> Corners:
    """Fit corners near `start`.

    image : (height, width) grey levels. start : (n, 2) px.
    axes : (n, 2, 2) px; axes[:, k] is the picture of one square along the board's axis k; of a
        marker's corner, of its side, away from the corner.
    bends : (n, 2, 2) px; second differences of the picture along the same axes, by which a lens
        or mirror bends the edges; none for straight ones.
    before : an earlier fit, whose places are `start`, from where this one goes on.
    """
    if len(start) == 0:
        return Corners(start, np.zeros(0, dtype=bool), np.zeros(0), np.zeros((0, 7)))
    scale = np.sqrt(np.abs(np.linalg.det(axes)))
    widened = np.maximum(1.0, options.least_radius / np.maximum(window.reach * scale, 1e-6))
    places, weight = _window(image, start, axes, window, widened, options)
    grey = image[places[:, 1], places[:, 0]].astype(float)
    first = _first(grey, weight, axes, window.saddle)
    if before is not None:
        first[before.good] = before.unknowns[before.good]
    shape = _Shape(places - start[..., None], _curvature(first, axes, bends), window.saddle)
    return _judged(start, _fit(grey, weight, shape, first, options), grey, weight, scale, options)


def _window(
    image: Integers,
    start: Array,
    axes: Array,
    window: Window,
    widened: Array,
    options: BoardDetectionOptions,
) -> tuple[Integers, Array]:
    """Pixels x, y (n, 2, m) that count around every corner, and their weights (n, m).

    As wide as the largest window: a smaller one's pixels come first, then some of no weight.
    """
    reach, margin = window.reach * widened[:, None], window.margin * widened[:, None]
    longest = float(np.max(reach * np.abs(axes).sum(axis=1), initial=0.0))
    radius = int(np.clip(np.ceil(longest), 3, options.most_radius))
    around = np.mgrid[-radius : radius + 1, -radius : radius + 1][::-1].reshape(2, -1)
    places = np.rint(start).astype(int)[..., None] + around
    offsets = places - start[..., None]
    last = np.array(image.shape[::-1])[:, None] - 1
    inside = ((places >= 0) & (places <= last)).all(axis=1)
    board = np.abs(np.linalg.inv(axes.mT) @ offsets)
    along, across = board.max(axis=1), board.min(axis=1)
    # 1, falling to 0 over the last fifth of the reach
    taper = np.clip((reach - along) / (0.2 * reach), 0, 1)
    near = np.abs(offsets).max(axis=1) <= options.most_radius
    weight = taper * (across < margin) * near * inside
    most = max(int(np.count_nonzero(weight, axis=1).max()), 1)
    order = np.argsort(weight == 0, axis=1, kind="stable")[:, :most]
    packed = np.take_along_axis(places, order[:, None], axis=2)
    return np.clip(packed, 0, last), np.take_along_axis(weight, order, axis=1)


def _first(grey: Array, weight: Array, axes: Array, saddle: bool) -> Array:
    """Start of the fit: x, y, two directions, log blur, level, amplitude; (n, 7).

    Of a marker's corner both edges are directed so that the marker is on their positive side.
    """
    angle = np.arctan2(axes[..., 1], axes[..., 0])
    if not saddle:
        inward = np.sum(_normals(angle) * axes[:, ::-1], axis=-1)
        angle = angle + np.where(inward < 0, np.pi, 0.0)
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    spread = np.sqrt(np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total)
    zero = np.zeros(len(grey))
    return np.stack([zero, zero, angle[:, 0], angle[:, 1], zero, mean, spread], axis=-1)


def _normals(angle: Array) -> Array:
    """Positive sides (..., 2) of edges with these directions."""
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


class _Shape(NamedTuple):
    """Model of the image of a corner: offsets x, y of its pixels from the predicted corner (n, 2,
    m) px, curvatures (n, 2) 1/px of its two edges towards their positive sides, and whether two
    dark squares meet.
    """

    offsets: Array
    curvature: Array
    saddle: bool

    @property
    def bent(self) -> bool:
        """Whether any edge is."""
        return bool(self.curvature.any())

    def select(self, keep: Booleans) -> _Shape:
        """Some of the corners."""
        return _Shape(self.offsets[keep], self.curvature[keep], self.saddle)


def _curvature(first: Array, axes: Array, bends: Array | None) -> Array:
    """Curvatures of the edges, (n, 2): the part of the second difference across the edge."""
    if bends is None:
        return np.zeros((len(first), 2))
    across = np.sum(_normals(first[:, 2:4]) * bends, axis=-1)
    return across / np.maximum(np.sum(axes**2, axis=-1), 1e-9)


class _Fitted(NamedTuple):
    """A fit that has ended: unknowns (n, 7), what is left of the grey levels (n, m), and the normal
    matrix (n, 7, 7) there.
    """

    unknowns: Array
    residual: Array
    normal: Array


class _Fit(NamedTuple):
    """A fit on its way: numbers (k,) of the corners that have not settled, their unknowns (k, 7)
    and pixels (k, m), what is left of the grey levels, and the model's derivatives (k, 7, m) there.
    """

    number: Integers
    p: Array
    grey: Array
    weight: Array
    shape: _Shape
    residual: Array
    by: Array
    cost: Array
    damping: Damping

    @classmethod
    def begun(cls, grey: Array, weight: Array, shape: _Shape, p: Array) -> _Fit:
        """Before the first step, with level and amplitude fitted: these two are linear."""
        by = _model(np.concatenate([p[:, :6], np.ones((len(p), 1))], axis=1), shape)[1]
        form = by[:, 6]
        total = np.maximum(weight.sum(axis=1), 1e-9)
        mean = np.sum(weight * form, axis=1) / total
        off = form - mean[:, None]
        variance = np.maximum(np.sum(weight * off * off, axis=1), 1e-9)
        amplitude = np.sum(weight * off * grey, axis=1) / variance
        level = np.sum(weight * grey, axis=1) / total - amplitude * mean
        # the derivatives by place, directions and blur are in proportion to the amplitude
        by[:, :5] *= amplitude[:, None, None]
        p = np.concatenate([p[:, :5], level[:, None], amplitude[:, None]], axis=1)
        residual = grey - level[:, None] - amplitude[:, None] * form
        cost = np.sum(weight * residual**2, axis=1)
        return cls(
            np.arange(len(p)), p, grey, weight, shape, residual, by, cost, Damping.first(len(p))
        )

    @property
    def normal(self) -> Array:
        """Normal matrix (k, 7, 7)."""
        return (self.by * self.weight[:, None]) @ self.by.mT

    def stepped(self, longest: Array) -> tuple[_Fit, Array]:
        """After a damped step, where it is better, and that step (k, 7); longest : (7,)."""
        right = (self.by @ (self.weight * self.residual)[..., None])[..., 0]
        step = np.clip(self.damping.step(self.normal, right), -longest, longest)
        value, by = _model(self.p + step, self.shape)
        residual = self.grey - value
        cost = np.sum(self.weight * residual**2, axis=1)
        better = cost < self.cost
        after = self._replace(
            p=_taken(better, self.p + step, self.p),
            residual=_taken(better, residual, self.residual),
            by=_taken(better, by, self.by),
            cost=np.where(better, cost, self.cost),
            damping=self.damping.after(better),
        )
        return after, step

    def select(self, keep: Booleans) -> _Fit:
        """Fit of some of the corners."""
        if keep.all():
            return self
        parts = self._asdict().items()
        return _Fit(
            **{n: v.select(keep) if n in ("shape", "damping") else v[keep] for n, v in parts}
        )


def _fit(
    grey: Array, weight: Array, shape: _Shape, p: Array, options: BoardDetectionOptions
) -> _Fitted:
    """Weighted Levenberg-Marquardt of all corners at once.

    Corners that have settled are not looked at again: a few bad ones never do.
    """
    fit = _Fit.begun(grey, weight, shape, p)
    out = _Fitted(np.empty_like(p), np.empty_like(grey), np.empty((len(p), 7, 7)))
    for more in reversed(range(options.steps)):
        fit, step = fit.stepped(np.array(options.longest_step))
        on = (np.abs(step[:, :2]).max(axis=1) >= options.settled) & (more > 0)
        settled = fit.select(~on)
        for all_of_them, these in zip(
            out, (settled.p, settled.residual, settled.normal), strict=True
        ):
            all_of_them[settled.number] = these
        if not on.any():
            break
        fit = fit.select(on)
    return out


def _taken(better: Booleans, trial: Array, before: Array) -> Array:
    """Rows of the trial (n, ...) where it is better (n,), else those before."""
    if better.all():
        return trial
    return np.where(better.reshape(-1, *[1] * (trial.ndim - 1)), trial, before)


def _model(p: Array, shape: _Shape) -> tuple[Array, Array]:
    """Grey levels (n, m) and their derivatives by the seven unknowns, (n, 7, m).

    Of both edges at once (n, 2, m): how far along and across them a pixel lies, px, how far off
    in blurs times sqrt 2, z, and how light they make it, form.
    """
    from scipy.special import erf

    angle = p[:, 2:4]
    directions, normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1), _normals(angle)
    blur, level, amplitude = np.sqrt(2) * np.exp(p[:, 4:5]), p[:, 5:6], p[:, 6:7]
    offsets = shape.offsets - p[:, :2, None]
    along, across = directions @ offsets, normals @ offsets
    turned = shape.curvature[..., None] * along if shape.bent else None
    off = across if turned is None else across - 0.5 * turned * along
    z = off / blur[..., None]
    half = 1.0 if shape.saddle else 0.5
    form = half * erf(z) + (1 - half)
    # by the signed distance from the edge, px
    slope = np.exp(-z * z) * form[:, ::-1]
    slope *= (amplitude * half * 2 / np.sqrt(np.pi) / blur)[..., None]
    by = np.empty((len(p), 7, z.shape[-1]))
    by[:, :2] = -normals.mT @ slope
    by[:, 2:4] = -slope * along
    by[:, 4] = -np.sum(slope * off, axis=1)
    if turned is not None:
        turning = slope * turned
        by[:, :2] += directions.mT @ turning
        by[:, 2:4] -= turning * across
    by[:, 5] = 1.0
    by[:, 6] = form[:, 0] * form[:, 1]
    return level + amplitude * by[:, 6], by


def _judged(
    start: Array,
    fitted: _Fitted,
    grey: Array,
    weight: Array,
    scale: Array,
    options: BoardDetectionOptions,
) -> Corners:
    """Corners that the fit accepts, with standard deviations by its residuals."""
    p = fitted.unknowns
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    variance = np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total
    remainder = np.sum(weight * fitted.residual**2, axis=1) / total
    # A grey level is rounded to whole numbers, so it is never better than 1 / sqrt 12.
    noise = np.maximum(remainder, 1 / 12)
    covariance = np.linalg.inv(fitted.normal + 1e-9 * np.eye(7)) * noise[:, None, None]
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0) / 2)
    # A wider blur shows no edge in the window, and a corner outside it is another one; without blur
    # grey levels do not depend on the place, which is then unknown within the window.
    radius = np.clip(options.reach * scale, options.least_radius, options.most_radius)
    good = (
        (remainder < (1 - options.least_explained) * variance)
        & (np.exp(p[:, 4]) < radius)
        & (np.hypot(p[:, 0], p[:, 1]) < radius)
        & (sigma < radius)
        & (weight.sum(axis=1) > p.shape[1])
        & np.isfinite(p).all(axis=1)
    )
    pixels = start + np.where(good[:, None], p[:, :2], 0.0)
    return Corners(pixels, good, sigma, np.concatenate([0 * p[:, :2], p[:, 2:]], axis=1))
