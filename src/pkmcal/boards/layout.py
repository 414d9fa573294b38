"""Layout of a grid's markers in images, compared with the numbering in its file.

Each marker is a square, so the position of a neighbour is known in units of the square's side for
any camera. Neighbours along rows and columns determine the steps of the ids, the ids at which rows
begin, and the pitch, without a pose or a lens model.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.boards.board import Board
from pkmcal.boards.find import Markers
from pkmcal.levels import NEARLY_ALL


@dataclass(frozen=True)
class MarkerLayoutOptions:
    """Constants of the layout of markers."""

    # largest distance of a neighbour from its lattice point, in pitches: half of that to the next
    # cell. Not checked within a factor of two
    misfit: float = 0.25
    # shortest side of a marker, px; corners are located to about half a pixel, a twentieth of it
    least_side: float = 10.0
    # fewest pairs of neighbours that determine the step of the ids along rows or columns; not
    # checked with other numbers
    least_neighbours: int = 4
    # least share of the pairs that agree on a step; misread ids are rare
    agreement: float = NEARLY_ALL
    # fewest contradictions to a described numbering, pairs of row neighbours in different rows or
    # ids out of range, for which it is wrong: a single one may be a misread id. Not checked with
    # more
    contradictions: int = 2


MARKER_LAYOUT_OPTIONS = MarkerLayoutOptions()


@dataclass(frozen=True)
class MarkerLayout:
    """Layout of markers in images.

    along, down : steps of the ids to the right neighbour and to the one below.
    gap : between two markers, in marker sides.
    within_rows : number of occurrences of each pair of ids (i, i + along) as neighbours in a row.
    ids : all ids detected.
    """

    along: int
    down: int
    gap: float
    within_rows: Counter[tuple[int, int]]
    ids: frozenset[int]

    def breaks(self, first: int) -> int:
        """Number of row neighbours that are in different rows if the first marker has this id."""
        columns = abs(self.down)
        pairs = self.within_rows.items()
        return sum(n for pair, n in pairs if (max(pair) - first) % columns == 0)

    def first_ids(self) -> list[int]:
        """Possible ids of the first marker, largest first: they begin a row and are not above any
        detected id.
        """
        least = min(self.ids)
        return [k for k in range(least, max(least - self.down, -1), -1) if not self.breaks(k)]


class _Neighbours(NamedTuple):
    """Pairs of neighbours in one image.

    ids : (n, 2).
    step : (n, 2) lattice step from the first to the second.
    pitch : (n,) distance in marker sides.
    """

    ids: Array
    step: Array
    pitch: Array


def marker_layout(
    images: Sequence[Markers], options: MarkerLayoutOptions = MARKER_LAYOUT_OPTIONS
) -> MarkerLayout | None:
    """Layout of the markers in images; None if there are too few neighbours or they disagree."""
    neighbours = [part for markers in images if (part := _neighbours(markers, options)) is not None]
    if not neighbours:
        return None
    ids = np.concatenate([part.ids for part in neighbours])
    step = np.concatenate([part.step for part in neighbours])
    difference = ids[:, 1] - ids[:, 0]
    along = _common_step(difference[step[:, 0] == 1], options)
    down = _common_step(difference[step[:, 1] == 1], options)
    if along is None or down is None:
        return None
    rows = ids[(step[:, 0] == 1) & (difference == along)].tolist()
    return MarkerLayout(
        along,
        down,
        float(np.median(np.concatenate([part.pitch for part in neighbours]))) - 1,
        Counter((i, j) for i, j in rows),
        frozenset(int(number) for number in ids.flat),
    )


def another_grid(
    layout: MarkerLayout, board: Board, options: MarkerLayoutOptions = MARKER_LAYOUT_OPTIONS
) -> str | None:
    """Description of a detected grid that differs from the one described; None if they agree.

    The pitch is not compared.
    """
    columns, rows = board.counts
    first, count = board.document.get("first_id", 0), columns * rows
    along = -1 if board.document.get("leftward", False) else 1
    if rows > 1 and layout.along == along and layout.down > 1 and layout.down != columns:
        wide = layout.down
        high = count // wide if count % wide == 0 else -(-(max(layout.ids) + 1 - first) // wide)
        return f"a grid of {wide}x{high} markers"
    if columns > 1 and rows > 1 and (layout.along, layout.down) != (along, columns):
        return (
            f"markers whose ids go on by {layout.along:+d} to the right and by {layout.down:+d}"
            " downward"
        )
    beyond = [i for i in sorted(layout.ids) if not first <= i < first + count]
    if layout.breaks(first) < options.contradictions and len(beyond) < options.contradictions:
        return None
    possible = [k for k in layout.first_ids() if max(layout.ids) < k + count]
    if possible:
        return f"first_id: {possible[0]}, the marker with which the first row begins"
    return f"markers {', '.join(map(str, beyond[:4]))} beyond its {count}" if beyond else None


def _common_step(differences: Array, options: MarkerLayoutOptions) -> int | None:
    """Most frequent difference of ids; None if too few of the pairs share it."""
    if len(differences) < options.least_neighbours:
        return None
    steps, counts = np.unique(differences, return_counts=True)
    best = int(np.argmax(counts))
    return int(steps[best]) if counts[best] >= options.agreement * len(differences) else None


def _neighbours(markers: Markers, options: MarkerLayoutOptions) -> _Neighbours | None:
    """Neighbours in one image; None if there are none."""
    # Markers that are large enough.
    ids, corners = markers
    wide = np.linalg.norm(np.diff(corners, axis=1), axis=-1).reshape(len(ids), 3)
    large = wide.min(axis=1, initial=np.inf) > options.least_side
    ids, corners = ids[large], corners[large]
    if len(ids) < 2:
        return None
    # The detector's corners are centres of the outermost dark pixels: enlarge the axes.
    bigger = (wide[large].mean(axis=1) + 1) / wide[large].mean(axis=1)
    # Axes of each marker, and offsets to all others in units of its sides, (n, n, 2).
    right = (corners[:, 1] - corners[:, 0] + corners[:, 2] - corners[:, 3]) / 2
    below = (corners[:, 3] - corners[:, 0] + corners[:, 2] - corners[:, 1]) / 2
    axes = np.stack([right, below], axis=-1) * bigger[:, None, None]
    middle = corners.mean(axis=1)
    off = np.linalg.solve(axes[:, None], (middle[None] - middle[:, None])[..., None])[..., 0]
    # Average of the steps i to j and, reversed, j to i: first-order perspective cancels.
    off = (off - off.swapaxes(0, 1)) / 2
    # Steps on the lattice, in pitches.
    distance = np.linalg.norm(off, axis=-1)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.min(axis=1)
    step = off / np.median(nearest)
    whole = np.rint(step)
    close: Booleans = (np.abs(step - whole) < options.misfit).all(axis=-1)
    one, other = np.nonzero(close & (np.abs(whole).sum(axis=-1) == 1))
    if not len(one):
        return None
    return _Neighbours(
        np.stack([ids[one], ids[other]], axis=-1), whole[one, other], distance[one, other]
    )
