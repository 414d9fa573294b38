"""Detection of a board in images, and diagnosis of images or board files that do not match."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import THREADS, Array, Integers
from pkmcal.boards.board import Board, Detection, board_from_document, chessboard, dictionaries
from pkmcal.boards.find import (
    BOARD_DETECTION_OPTIONS,
    BoardDetectionOptions,
    Markers,
    charuco_detector,
    detect_board,
    detect_markers,
    dictionary,
    find_chessboard,
    marker_outlines,
)
from pkmcal.boards.layout import (
    MARKER_LAYOUT_OPTIONS,
    MarkerLayoutOptions,
    another_grid,
    marker_layout,
)
from pkmcal.boards.saddles import largest_block
from pkmcal.errors import InputError
from pkmcal.files import Document
from pkmcal.levels import MAJORITY, NEARLY_ALL
from pkmcal.observe.images import decode, narrowed
from pkmcal.outcome.progress import Progress, no_progress
from pkmcal.session.image_files import image_header
from pkmcal.wording import listed


@dataclass(frozen=True)
class OtherBoardOptions:
    """Constants of the search for a board other than the one described."""

    # images examined for another board; a single sharp one would be enough
    images: int = 3
    # largest miscount of a chessboard's columns or rows that is tried
    miscounts: int = 2
    # columns and rows of a ChArUco board are tried up to below this number
    most_squares: int = 16
    # width in px to which images are reduced to try many sizes of chessboards: a try takes a
    # quarter of a second, and more than one second at full size (measured)
    width: int = 512
    # share of the corners inside another chessboard of which all neighbours must be seen: all its
    # corners must be fitted, and a corner not seen costs up to nine
    visible_share: float = MAJORITY
    # least relative difference between measured and described markers: corners of markers are
    # located to about half a pixel, a twentieth of the smallest markers used (derived)
    size_difference: float = 0.1
    # fewest markers for a measurement of their size, and for another dictionary; not checked with
    # other numbers
    least_markers: int = 4
    # most outlines of markers that are compared with all dictionaries, the largest first
    most_outlines: int = 24
    # detection of boards of other sizes, and layout of the markers of a grid
    detection: BoardDetectionOptions = BOARD_DETECTION_OPTIONS
    layout: MarkerLayoutOptions = MARKER_LAYOUT_OPTIONS


OTHER_BOARD_OPTIONS = OtherBoardOptions()

LARGEST_FAMILY_DICTIONARY = 1000
"""Number of markers in the largest dictionary of a family; the smaller dictionaries are its first
ones."""
NO_SIZE = 9999
"""Size of a dictionary that belongs to no family."""


def detect_boards(
    paths: Sequence[Path | str],
    board: Board,
    options: OtherBoardOptions = OTHER_BOARD_OPTIONS,
    progress: Progress = no_progress,
) -> tuple[Detection, ...]:
    """Detect the board in images; one detection each, with corners or with a reason.

    progress : called with each image.

    Raises `InputError` if the images differ in size, or if some or all of them show another board.
    """
    files = [Path(path) for path in paths]
    size = _common_size(files)
    with ThreadPoolExecutor(THREADS) as pool:
        detections: list[Detection] = []
        blocks: list[int | None] = []
        for detection, block in pool.map(
            lambda path: _detect_in_file(path, size, board, options.detection, quick=True), files
        ):
            detections.append(detection)
            blocks.append(block)
            done = len(detections)
            progress(f"Detecting the board: {done} of {len(files)} images", done / len(files) / 2)
        if not any(detection.success for detection in detections):
            # Check for another board before the slow methods run on all images.
            check_boards(files, detections, board, options=options)
        missed = [k for k, detection in enumerate(detections) if not detection.success]
        missed = missed if board.type == "chessboard" else []  # markers have no slow method
        again = pool.map(
            lambda k: _detect_in_file(
                files[k], size, board, options.detection, quick=False, block=blocks[k]
            ),
            missed,
        )
        for done, (k, (detection, _)) in enumerate(zip(missed, again, strict=True), start=1):
            detections[k] = detection
            text = f"Searching the rest for the board: {done} of {len(missed)} images"
            progress(text, (1 + done / len(missed)) / 2)
    check_any(detections, board)  # a different board was reported above
    return check_boards(files, detections, board, options=options)


def _detect_in_file(
    path: Path,
    size: tuple[int, int],
    board: Board,
    options: BoardDetectionOptions,
    *,
    quick: bool,
    block: int | None = None,
) -> tuple[Detection, int | None]:
    """Detection in one image file, and the image's `largest_block` for a chessboard."""
    image = decode(path, size, path.name)
    if board.type == "chessboard" and block is None:
        block = largest_block(narrowed(image, options.searched_width)[0])
    return detect_board(image, board, path.name, quick, options, block), block


def _common_size(files: Sequence[Path]) -> tuple[int, int]:
    """Common size of the images; raises InputError naming images of another size."""
    if not files:
        raise InputError("no images were named", expected="images of the board")
    sizes = {path: image_header(path) for path in files}
    counts = {size: list(sizes.values()).count(size) for size in sizes.values()}
    usual = max(counts, key=lambda size: counts[size])
    odd = [path for path, size in sizes.items() if size != usual]
    if not odd:
        return usual
    turned = all(sizes[path] == usual[::-1] for path in odd)
    raise InputError(
        "the images differ in size",
        where=listed([path.name for path in odd]),
        found="{}x{} pixels".format(*sizes[odd[0]]),
        expected="{}x{}, as the other {}".format(*usual, counts[usual]),
        next_step="They were turned by a quarter; keep images as the sensor gives them"
        if turned
        else "Calibrate each resolution on its own, from unscaled, uncropped images",
    )


def check_boards(
    files: Sequence[Path],
    detections: Sequence[Detection],
    board: Board,
    options: OtherBoardOptions = OTHER_BOARD_OPTIONS,
) -> tuple[Detection, ...]:
    """The detections; those of a few images that show a board other than `board` have it as their
    reason.

    Raises `InputError` if all images show another board, or most of them and the rest this one.
    """
    missed = [(f, k) for k, f in enumerate(files) if not detections[k].success]
    detected = [(f, d) for f, d in zip(files, detections, strict=True) if d.success]
    with_board = [path for path, _ in detected]
    size = detections[0].image_size
    other: str | None = None
    if board.type == "aruco_grid":
        _check_grid([path for path, _ in detected[: options.images]], size, board, options)
    for path, detection in detected[: options.images]:
        # A single image may show an object beside the board that looks like a continuation.
        image = decode(path, size, path.name)
        if board.type == "chessboard":
            other = _larger_chessboard(image, board, options)
        elif board.type == "circle_grid":
            other = None  # a lattice that goes on beyond the grid is no detection
        else:
            markers = _own_markers(image, board)
            other = _markers_beyond(image, board, markers, options)
            if other is None and board.type == "charuco":
                _check_size(markers, board, detection, path, options)
        if other is None:
            break
    if other is not None:
        raise _other_board_error(with_board[0], other, board)
    out, part = list(detections), not with_board
    with ThreadPoolExecutor(THREADS) as pool:
        others = pool.map(
            lambda file: other_board(decode(file[0], size, file[0].name), board, part, options),
            missed[: options.images],
        )
    for (path, k), other in zip(missed, others, strict=False):
        if other is not None and not with_board:
            raise _other_board_error(path, other, board)
        if other is not None and len(missed) > len(with_board):
            raise InputError(
                "images of two boards are mixed",
                where=path.name,
                found=other,
                expected=f"{board.described}, as in {listed([f.name for f in with_board], 3)}",
                next_step="Calibrate with the images of one board",
                code="board.mixed",
            )
        if other is not None:
            out[k] = replace(out[k], reason=f"it shows {other}; {out[k].reason}")
    return tuple(out)


def check_any(detections: Sequence[Detection], board: Board) -> None:
    """Raise `InputError` if no image shows the board."""
    if not any(detection.success for detection in detections):
        raise InputError(
            "the board is in none of the images",
            where=listed([detection.name for detection in detections], 3),
            found=detections[0].reason,
            expected=board.described,
            next_step="Check the board file, the light and the focus; a chessboard's white border"
            " must be seen as well",
            code="board.not_found",
        )


def _other_board_error(path: Path, other: str, board: Board) -> InputError:
    """Error about images of another board than the one described."""
    grid = board.type == "aruco_grid"
    first = f" with first_id: {board.document.get('first_id', 0)}" if grid else ""
    return InputError(
        "the images show another board than the one described",
        where=path.name,
        found=other,
        expected=f"{board.described}{first}, as the board file states",
        next_step="Write what the board has into the board file",
        code="board.another",
    )


def _own_markers(image: Integers, board: Board) -> Markers:
    """Markers of the board's dictionary."""
    border = board.document.get("border", 1)
    return detect_markers(image, dictionary(board.document["dictionary"]), border=border)


def _check_grid(
    paths: Sequence[Path], size: tuple[int, int], board: Board, options: OtherBoardOptions
) -> None:
    """Raise `InputError` if the layout of a grid's markers contradicts its file."""
    images = [_own_markers(decode(p, size, p.name), board) for p in paths]
    layout = marker_layout(images, options.layout)
    if layout is None:
        return
    other = another_grid(layout, board, options.layout)
    if other is not None:
        raise _other_board_error(paths[0], other, board)
    marker, gap = board.document["marker"], board.document["gap"]
    if abs((1 + layout.gap) * marker / (marker + gap) - 1) <= options.size_difference:
        return
    # Some programs state the gap as a share of the marker's side.
    ratio = abs((1 + layout.gap) / (1 + gap) - 1) <= options.size_difference
    raise InputError(
        "the gaps between the board's markers differ from those in its file",
        where=paths[0].name,
        found=f"gaps of {layout.gap:.2g} times a marker's side, which is"
        f" {layout.gap * marker:.2g} m beside marker: {marker:g}",
        expected=f"{gap / marker:.2g} times, by gap: {gap:g}",
        next_step=f"Write gap in metres, gap: {gap * marker:g}; {gap:g} is its part of a marker's"
        " side, as other programs have it"
        if ratio
        else "Measure a marker and a gap with a ruler, the marker with its black border",
        code="board.gaps",
    )


def _check_size(
    markers: Markers, board: Board, detection: Detection, path: Path, options: OtherBoardOptions
) -> None:
    """Raise `InputError` if the markers of a ChArUco board have another size than described.

    A wrong size changes corners by less than 0.02 px, but corners of squares that are described as
    full, or empty, of marker get up to six times their true sigma.
    """
    share = marker_share(markers, board, detection, options=options)
    if share is None:
        return
    square, marker = board.document["square"], board.document["marker"]
    if abs(share * square / marker - 1) <= options.size_difference:
        return
    raise InputError(
        "the board's markers have another size than its file states",
        where=path.name,
        found=f"markers {share:.2f} of a square wide",
        expected=f"{marker / square:.2f}, by marker: {marker:g} and square: {square:g}",
        next_step="Measure a marker and a square with a ruler, the marker with its black border",
        code="board.marker_size",
    )


def marker_share(
    markers: Markers,
    board: Board,
    detection: Detection,
    options: OtherBoardOptions = OTHER_BOARD_OPTIONS,
) -> float | None:
    """Side of a ChArUco board's markers in units of its squares, from the detected corners; None
    for too few markers.
    """
    import cv2

    ids, corners = markers
    wide = np.linalg.norm(np.diff(corners, axis=1), axis=-1).reshape(len(ids), 3)
    large = wide.min(axis=1, initial=np.inf) > options.layout.least_side
    corners, wide = corners[large], wide[large]
    if len(corners) < options.least_markers:
        return None
    places = board.points[detection.ids, :2] / board.document["square"]
    plane: Any = cv2.findHomography(detection.pixels, places, cv2.RANSAC, 0.05)[0]
    if plane is None:
        return None
    there = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), plane).reshape(-1, 4, 2)
    shares = np.linalg.norm(np.diff(there, axis=1), axis=-1)
    # The detector's corners are centres of the outermost dark pixels.
    return float(np.median(shares * (wide + 1) / wide))


def other_board(
    image: Integers, board: Board, part: bool, options: OtherBoardOptions = OTHER_BOARD_OPTIONS
) -> str | None:
    """Description of the board in an image if it is not `board`; None if there is none.

    part : whether a part of the described chessboard counts as another board, not as a partial
        detection.
    """
    if board.type in ("chessboard", "circle_grid"):
        # Markers and circles first: one search, where chessboards need one for each size.
        return (
            _other_markers(image, "", options)
            or _other_circles(image, board, options)
            or _other_chessboard(
                image, board.counts if board.type == "chessboard" else (0, 0), part, options
            )
        )
    name = board.document["dictionary"]
    if board.type == "charuco":
        best = _other_charuco(image, board, detect_markers(image, dictionary(name)), options)
        if best:
            return best
    if board.type == "aruco_grid":
        # the same markers with a border of another width, as Kalibr's differ from OpenCV's
        border = 3 - board.document.get("border", 1)
        own = dictionary(name, board.document.get("first_id", 0), board.counts[0] * board.counts[1])
        small, _ = narrowed(image, options.detection.searched_width)
        count = len(detect_markers(small, own, border=border).ids)
        if count >= options.least_markers:
            return f"{count} markers of {name} with border: {border}"
    return _other_markers(image, name, options) or _other_chessboard(
        image, (0, 0), part=True, options=options
    )


def _larger_chessboard(image: Integers, board: Board, options: OtherBoardOptions) -> str | None:
    """Description of a larger chessboard that contains the described one; None if there is none."""
    columns, rows = board.counts
    for counts in ((columns + 1, rows), (columns, rows + 1), (columns + 1, rows + 1)):
        if _all_corners(image, counts, options.detection):
            return chessboard(counts, 1.0).described
    return None


def _markers_beyond(
    image: Integers, board: Board, markers: Markers, options: OtherBoardOptions
) -> str | None:
    """Description of detected markers that the described board does not have; None without at least
    two.
    """
    ids = markers.ids
    if board.type == "aruco_grid":
        ids = ids - board.document.get("first_id", 0)
        count = board.counts[0] * board.counts[1]
    else:
        squares = board.document["squares"]
        count = squares[0] * squares[1] // 2
    beyond = ids[(ids < 0) | (ids >= count)]
    if len(beyond) < 2:
        return None
    if board.type == "charuco":
        return _other_charuco(image, board, markers, options)
    return f"markers {listed([str(i) for i in sorted(beyond.tolist())], 4)} beyond its {count}"


def _other_chessboard(
    image: Integers, counts: tuple[int, int], part: bool, options: OtherBoardOptions
) -> str | None:
    """Description of a chessboard whose size is near the described one and fits; with (0, 0), of
    usual sizes.
    """
    if counts == (0, 0):
        candidates = [(9, 6), (8, 6), (7, 6), (7, 5), (8, 5), (6, 5), (11, 8), (10, 7), (6, 4)]
    else:
        span = range(-options.miscounts, options.miscounts + 1)
        candidates = [(counts[0] + a, counts[1] + b) for a, b in product(span, span)]
    image, _ = narrowed(image, options.width)
    block = largest_block(image)
    # Largest first: smaller grids are also detected inside larger ones.
    for candidate in sorted(candidates, key=lambda c: -c[0] * c[1]):
        if min(candidate) < 3 or candidate in (counts, counts[::-1]):
            continue
        if not part and all(n <= m for n, m in zip(sorted(candidate), sorted(counts), strict=True)):
            continue
        # blocks of a part of the candidate, or of a pattern that goes on far beyond it
        middles = (candidate[0] - 2) * (candidate[1] - 2)
        if not options.visible_share * middles <= block <= middles / options.visible_share:
            continue
        if _all_corners(image, candidate, options.detection, block):
            return chessboard(candidate, 1.0).described
    return None


def _other_circles(image: Integers, board: Board, options: OtherBoardOptions) -> str | None:
    """Description of a grid of circles with the counts of a board of another type: symmetric
    instead of a chessboard or an asymmetric grid, asymmetric instead of a symmetric grid.
    """
    asymmetric = board.type == "circle_grid" and not board.document["asymmetric"]
    data = {"type": "circle_grid", "circles": list(board.counts), "spacing": 1.0}
    other = board_from_document(Document(Path(), "", {**data, "asymmetric": asymmetric}, {}))
    detection = detect_board(narrowed(image, options.width)[0], other, options=options.detection)
    return other.described if detection.success else None


def _all_corners(
    image: Integers,
    counts: tuple[int, int],
    options: BoardDetectionOptions,
    block: int | None = None,
) -> bool:
    """Whether a chessboard of these counts is in the image with all corners fitted; block : the
    image's `largest_block`, None if it is not known yet.
    """
    if find_chessboard(image, counts, quick=True, block=block, options=options) is None:
        return False
    detection = detect_board(image, chessboard(counts, 1.0), options=options)
    return len(detection.ids) == counts[0] * counts[1]


def _other_charuco(
    image: Integers, board: Board, markers: Markers, options: OtherBoardOptions
) -> str | None:
    """Description of the ChArUco board, by squares and pattern, with which most corners are
    detected; None if no more than with `board`.
    """
    ids, corners = markers
    if len(ids) < 2:
        return None
    most = int(ids.max()) + 1
    # The highest marker id is a lower bound of the number of markers, rarely below half of it.
    layouts: list[dict[str, Any]] = [
        {**board.document, "squares": [columns, rows], "legacy": legacy}
        for columns, rows in product(range(3, options.most_squares), repeat=2)
        if most <= (columns * rows) // 2 <= 2 * most + 4
        for legacy in [False, True][: 2 - rows % 2]
    ]
    scored = [(_charuco_corners(image, data, ids, corners), data) for data in layouts]
    mine = _charuco_corners(image, board.document, ids, corners)
    scored = [
        item for item in scored if item[0][0] >= max(options.detection.least_corners, mine[0] + 1)
    ]
    if not scored:
        return None
    data = max(scored, key=lambda item: item[0])[1]
    other = board_from_document(Document(Path(), "", data, {}))
    if len(detect_board(image, other, options=options.detection).ids) <= mine[0]:
        return None
    changed = bool(data["legacy"]) != bool(board.document.get("legacy", False))
    pattern = f" with legacy: {str(data['legacy']).lower()}" if changed else ""
    return other.described + pattern


def _charuco_corners(
    image: Integers, data: dict[str, Any], ids: Integers, corners: Array
) -> tuple[int, float]:
    """Number of corners of a ChArUco board between given markers, and their share of all its
    corners.
    """
    marker_corners = [corner[None].astype(np.float32) for corner in corners]
    marker_ids = ids.astype(np.int32)[:, None]
    detector: Any = charuco_detector(data)
    corner_ids: Any = detector.detectBoard(image, None, None, marker_corners, marker_ids)[1]
    count = 0 if corner_ids is None else len(corner_ids)
    columns, rows = data["squares"]
    return count, count / ((columns - 1) * (rows - 1))


def _other_markers(image: Integers, mine: str, options: OtherBoardOptions) -> str | None:
    """Description of the dictionary whose markers the image shows, the smallest that contains them;
    None for too few, or if most are of the dictionary ``mine``.
    """
    image, _ = narrowed(image, options.detection.searched_width)
    outlines = marker_outlines(image)
    if len(outlines) < options.least_markers:
        return None
    # DICT_4X4_50 is the first 50 markers of DICT_4X4_1000: one search covers the family.
    wanted = [
        n
        for n in dictionaries()
        if _dictionary_size(n) in (LARGEST_FAMILY_DICTIONARY, NO_SIZE) or n == mine
    ]
    # some names differ only in case
    names = list({name.lower(): name for name in wanted}.values())
    # The largest outlines choose the dictionary, which then is searched everywhere.
    size = np.ptp(outlines, axis=1).min(axis=1)
    largest = outlines[np.argsort(-size, kind="stable")[: options.most_outlines]]
    few = _only(image, largest)
    best = max(names, key=lambda name: len(detect_markers(few, dictionary(name)).ids))
    ids = {name: detect_markers(image, dictionary(name)).ids for name in {best, mine} & {*names}}
    count = len(ids[best])
    if count < options.least_markers or (mine in ids and len(ids[mine]) > MAJORITY * count):
        return None
    if _dictionary_size(best) == NO_SIZE:
        return f"{count} markers of {best}"
    family = best.rpartition("_")[0]
    sizes = [_dictionary_size(n) for n in dictionaries() if n.rpartition("_")[0] == family]
    size = min(size for size in sizes if size > np.quantile(ids[best], NEARLY_ALL))
    return f"{count} markers of {family}_{size}"


def _only(image: Integers, outlines: Array) -> Integers:
    """Image of white paper but for the surroundings of outlines (k, 4, 2) px."""
    out = np.full_like(image, 255)
    low, high = outlines.min(axis=1), outlines.max(axis=1)
    margin = 0.25 * (high - low)
    first = np.maximum(np.floor(low - margin), 0).astype(int)
    for (x, y), (right, bottom) in zip(first, np.ceil(high + margin).astype(int) + 1, strict=True):
        out[y:bottom, x:right] = image[y:bottom, x:right]
    return out


def _dictionary_size(name: str) -> int:
    """Number of markers in a dictionary by its name, DICT_5X5_100; NO_SIZE without a number."""
    last = name.rpartition("_")[2]
    return int(last) if last.isdigit() else NO_SIZE
