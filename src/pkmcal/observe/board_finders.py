"""The board found in a photograph by OpenCV, its corners then fitted by :mod:`board_corners`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.observe.board_corners import Corners, Window, refine
from pkmcal.observe.boards import Board, Detection

REACH = 0.25
"""Squares around a corner that its fit uses: longer edges say little more, and begin to bend."""
BENT = 0.02
"""px by which an edge may leave its tangent within the window before its bend is put in."""
CLEAR = 0.9
"""Share of the blank border between edge and marker that the window may fill."""
LEAST_CORNERS = 6
"""Corners below which a photograph says nothing: four fix a board's pose, two more test it."""
WHOLE = 0.75
"""Share of a chessboard's corners that must look like corners: what is found there is the whole
board, or something else."""
SMALL = 1000
"""px; pictures wider than this are tried at half their size as well."""
STRAIGHT_ENOUGH = 0.35
"""Share of a square by which a corner may lie off the middle of its two neighbours' line."""

Raw = tuple[Integers, Array]
"""Corner ids (n,) and pixels (n, 2) as a detector gives them."""


def find(image: Integers, board: Board, name: str, quick: bool = False) -> Detection:
    """One photograph's detection; quick : see :func:`find_chessboard`."""
    if board.type == "chessboard":
        raw, mirrored, why = _chessboard(image, board, quick)
    else:
        raw, mirrored, why = (_charuco if board.type == "charuco" else _marker_grid)(image, board)
    size = (image.shape[1], image.shape[0])
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0)
    if len(raw[0]) < LEAST_CORNERS:
        return Detection(name, size, *nothing, reason=why)
    fitted = _fitted(image, board, raw)
    ids, good = raw[0], fitted.good
    weak = tuple(int(i) for i in ids[~good])
    least = WHOLE * len(board.points) if board.type == "chessboard" else LEAST_CORNERS
    if good.sum() < least or _on_a_line(board.points[ids[good], :2]):
        why = f"only {good.sum()} of {len(board.points)} corners are sharp and uncovered"
        return Detection(name, size, *nothing, reason=why, weak=weak)
    return Detection(
        name, size, ids[good], fitted.pixels[good], fitted.sigma[good], "", weak, mirrored
    )


def _fitted(image: Integers, board: Board, raw: Raw) -> Corners:
    """The corners' fits; a grid of markers may have plain corners or touching dark squares."""
    ids, pixels = raw
    data = board.document
    if board.type == "aruco_grid":
        module = 1 / (marker_bits(data["dictionary"]) + 2)
        reach = min(REACH, 0.8 * data["gap"] / data["marker"])
        axes = _marker_axes(ids, pixels)
        plain = refine(image, pixels, axes, Window(reach, CLEAR * module, False))
        touching = refine(image, pixels, axes, Window(reach, CLEAR * module, True))
        # Both may be found: on a marker's inner pattern too. The right ones are the surer ones.
        right = plain.good.sum() > touching.good.sum() or (
            np.median(plain.sigma) <= np.median(touching.sigma)
        )
        return plain if right else touching
    margin = REACH
    if board.type == "charuco":
        margin = min(REACH, CLEAR * 0.5 * (1 - data["marker"] / data["square"]))
    window = Window(REACH, margin, True)
    fitted = refine(image, pixels, _axes(board, ids, pixels)[0], window)
    # How lines bend is told by the fitted corners; the detector's are too rough for it.
    sides, bends = _axes(board, ids, fitted.pixels)
    if np.abs(bends).max() * REACH**2 / 2 < BENT:
        return fitted
    return refine(image, fitted.pixels, sides, window, bends)


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
        side = _beside(step, axis).reshape(-1, 2)[ids]
        sides[:, k] = np.where(np.isfinite(side), side, mean)
        # At the board's border the bend of the nearest corner inside serves as well.
        second = _nearest(_padded(np.diff(step, axis=axis), axis, 1, 1), axis)
        bends[:, k] = np.nan_to_num(second.reshape(-1, 2)[ids])
    # A single row of corners has no second side: take it square.
    for k in (0, 1):
        bare = ~np.isfinite(sides[:, k]).all(axis=1)
        sides[bare, k] = (1 - 2 * k) * sides[bare, 1 - k][:, ::-1] * [1, -1]
    return sides, bends


def _padded(values: Array, axis: int, before: int, after: int) -> Array:
    """With NaN before and after along an axis."""
    pad = [(0, 0)] * values.ndim
    pad[axis] = (before, after)
    return np.pad(values, pad, constant_values=np.nan)


def _beside(step: Array, axis: int) -> Array:
    """Mean of the steps to both sides, or the one that there is."""
    both = np.stack([_padded(step, axis, 1, 0), _padded(step, axis, 0, 1)])
    known = np.isfinite(both)
    total = np.where(known, both, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), total, np.nan)


def _nearest(values: Array, axis: int) -> Array:
    """NaN replaced by the mean of the two neighbours' values, or the one that there is."""
    around = [np.roll(values, shift, axis) for shift in (1, -1)]
    known = np.isfinite(np.stack(around))
    total = np.where(known, np.stack(around), 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(np.isfinite(values), values, total)


def _marker_axes(ids: Integers, pixels: Array) -> Array:
    """As :func:`_axes`, with a marker's sides, away from the corner; ids come in fours."""
    corner = pixels.reshape(-1, 4, 2)
    top, right = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 1]
    bottom, left = corner[:, 2] - corner[:, 3], corner[:, 3] - corner[:, 0]
    x = np.stack([top, -top, -bottom, bottom], axis=1)
    y = np.stack([left, right, -right, -left], axis=1)
    return np.stack([x, y], axis=2).reshape(len(ids), 2, 2)


def _on_a_line(xy: Array) -> bool:
    spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 1e-6 * spread[0])


def _charuco(image: Integers, board: Board) -> tuple[Raw, bool, str]:
    detector = charuco_detector(board.document)
    best: Raw = (np.zeros(0, dtype=int), np.zeros((0, 2)))
    markers = 0
    for mirrored in (False, True):
        picture = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        corners, ids, _, marker_ids = detector.detectBoard(picture)
        markers = max(markers, _length(marker_ids))
        found = _raw(corners, ids, image.shape[1], mirrored)
        if len(found[0]) >= LEAST_CORNERS:
            return found, mirrored, ""
        best = max(best, found, key=lambda raw: len(raw[0]))
    why = f"{markers} of the board's markers and {len(best[0])} corners are recognised"
    return best, False, why if markers else "none of the board's markers is recognised"


def _raw(corners: Any, ids: Any, width: int, mirrored: bool) -> Raw:
    """OpenCV's corners and ids, whose shapes differ between versions."""
    if _length(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 2))
    pixels = np.asarray(corners, dtype=float).reshape(-1, 2)
    if mirrored:
        pixels = pixels * [-1, 1] + [width - 1, 0]
    return np.asarray(ids).reshape(-1).astype(int), pixels


def _length(found: Any) -> int:
    """Entries of what OpenCV found; None where it found nothing."""
    return 0 if found is None else len(found)


def charuco_detector(data: dict[str, Any]) -> Any:
    """OpenCV's detector of a ChArUco board's fields."""
    import cv2

    board = cv2.aruco.CharucoBoard(
        tuple(data["squares"]), data["square"], data["marker"], dictionary(data["dictionary"])
    )
    board.setLegacyPattern(bool(data.get("legacy", False)))
    return cv2.aruco.CharucoDetector(board)


def dictionary(name: str) -> Any:
    """OpenCV's dictionary of markers."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marker_bits(name: str) -> int:
    """Bits of a marker's side without its border."""
    return int(dictionary(name).markerSize)


def detect_markers(image: Integers, name: str) -> tuple[Integers, Array]:
    """Markers of a dictionary: ids (k,) and corners (k, 4, 2) px."""
    import cv2

    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(image)
    if _length(ids) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 4, 2))
    return np.asarray(ids).reshape(-1).astype(int), np.asarray(corners, float).reshape(-1, 4, 2)


def _marker_grid(image: Integers, board: Board) -> tuple[Raw, bool, str]:
    data = board.document
    count = board.counts[0] * board.counts[1]
    for mirrored in (False, True):
        picture = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        ids, corners = detect_markers(picture, data["dictionary"])
        ids = ids - data.get("first_id", 0)
        ours = (ids >= 0) & (ids < count)
        twice = np.isin(ids, [i for i in np.unique(ids) if np.sum(ids == i) > 1])
        ours &= ~twice
        if ours.sum() >= 2:
            found = (4 * ids[ours, None] + np.arange(4)).reshape(-1)
            return _raw(corners[ours], found, image.shape[1], mirrored), mirrored, ""
    return _raw([], [], 0, False), False, "fewer than two of the board's markers are recognised"


def _chessboard(image: Integers, board: Board, quick: bool) -> tuple[Raw, bool, str]:
    pixels = find_chessboard(image, board.counts, quick)
    if pixels is None:
        why = f"no chessboard of {board.counts[0]}x{board.counts[1]} inner corners is recognised"
        return _raw([], [], 0, False), False, why
    return (np.arange(len(pixels)), pixels), False, ""


def find_chessboard(image: Integers, counts: tuple[int, int], quick: bool = False) -> Array | None:
    """Corners (rows * columns, 2) px in the board's order, None where not found.

    quick : the first way only, for trying many counts.
    """
    for pixels in _attempts(image, counts, quick):
        grid = pixels.reshape(counts[1], counts[0], 2)
        if _is_grid(grid):
            return _oriented(image, grid).reshape(-1, 2)
    return None


def _attempts(image: Integers, counts: tuple[int, int], quick: bool) -> Iterator[Array]:
    """What OpenCV finds by several ways, the fastest and most successful first."""
    import cv2

    thorough = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    adaptive = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for picture, scale in _pictures(image, quick):
        ways = [
            lambda p=picture: cv2.findChessboardCornersSB(p, counts, flags=thorough),
            lambda p=picture: cv2.findChessboardCorners(p, counts, flags=adaptive),
        ]
        # Enlarged, the second way takes seconds on a cluttered picture.
        for way in ways[:1] if quick or scale > 1 else ways:
            found, corners = way()
            if found and _length(corners) == counts[0] * counts[1]:
                pixels = np.asarray(corners, dtype=float).reshape(-1, 2)
                yield (pixels + 0.5) / scale - 0.5


def _pictures(image: Integers, quick: bool) -> Iterator[tuple[Any, float]]:
    """The photograph; with its contrast evened out; smaller; larger; each with its scale."""
    import cv2

    yield image, 1.0
    if quick:
        return
    yield cv2.createCLAHE(3.0, (8, 8)).apply(image), 1.0
    if image.shape[1] > SMALL:
        yield cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 0.5
    yield cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC), 2.0


def _is_grid(grid: Array) -> bool:
    """Corners in order: every one near the middle between its neighbours, no row crossing."""
    for axis in (0, 1):
        step = np.diff(grid, axis=axis)
        length = np.linalg.norm(step, axis=-1)
        bend = np.linalg.norm(np.diff(step, axis=axis), axis=-1)
        near = np.minimum(*np.split(np.stack([
            np.take(length, range(length.shape[axis] - 1), axis),
            np.take(length, range(1, length.shape[axis]), axis),
        ]), 2))[0]  # fmt: skip
        if length.min() < 2 or np.any(bend > STRAIGHT_ENOUGH * 2 * near):
            return False
    right = grid[:-1, 1:] - grid[:-1, :-1]
    down = grid[1:, :-1] - grid[:-1, :-1]
    area = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    return bool(np.all(area > 0) or np.all(area < 0))


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

    Told by all inner squares, by turns of equal colour, since one may lie in a shadow.
    """
    centre = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    x, y = np.rint(centre).astype(int).reshape(-1, 2).T
    grey = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
    row, column = np.mgrid[: centre.shape[0], : centre.shape[1]].reshape(2, -1)
    # inner square (0, 0) has the colour of the first outer one, a diagonal step away
    same = (row + column) % 2 == 0
    return bool(grey[same].mean() > grey[~same].mean())
