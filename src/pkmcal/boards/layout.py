"""How the markers of a grid lie to each other in photographs, against how its file numbers them.

Each marker is a square by itself, so the place of another one near it is known in sides of the
square, whatever camera took the photograph. Neighbours along a row and down a column then tell the
step of the ids along both, which of them begin a row, and the pitch; no pose and no lens is needed.
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

LARGEST_LATTICE_MISFIT = 0.25
"""Pitches by which a neighbour may lie beside its place on the lattice."""
LEAST_MARKER_SIDE = 10.0
"""px; corners are found to half a pixel or so, a twentieth of the smallest that are looked at."""
LEAST_NEIGHBOURS = 4
"""Pairs that tell how ids go on along rows, or down columns."""
LEAST_AGREEMENT = 0.8
"""Part of the pairs that agree on it; ids that are read wrong are few."""
LEAST_CONTRADICTIONS = 2
"""Pairs of neighbours in one row that a description puts into two, before it is wrong."""


@dataclass(frozen=True)
class MarkerLayout:
    """How markers lie in photographs.

    along, down : steps of the ids to the right neighbour and to the one below. gap : between two
    markers, in sides of one. within_rows : pairs of ids (i, i + along) that are neighbours in a
    row, by how often. ids : all that were found.
    """

    along: int
    down: int
    gap: float
    within_rows: Counter[tuple[int, int]]
    ids: frozenset[int]

    def breaks(self, first: int) -> int:
        """Times that neighbours of a row would stand in two if the first marker had an id."""
        columns = abs(self.down)
        pairs = self.within_rows.items()
        return sum(n for (_, right), n in pairs if (right - first) % columns == 0)

    def first_ids(self) -> list[int]:
        """Ids that the first marker may have: those that begin a row, below all that were found,
        the largest first.
        """
        least = min(self.ids)
        return [k for k in range(least, max(least - self.down, -1), -1) if not self.breaks(k)]


class _Neighbours(NamedTuple):
    """Pairs of neighbours in a photograph: ids (n, 2), and the step (n, 2) from one to the other.

    pitch : distances (m,) of the nearest ones, in sides of a marker.
    """

    ids: Array
    step: Array
    pitch: Array


def marker_layout(photographs: Sequence[Markers]) -> MarkerLayout | None:
    """The layout that photographs show, None where they do not show one."""
    results = [part for markers in photographs if (part := _neighbours(markers)) is not None]
    if not results:
        return None
    ids = np.concatenate([part.ids for part in results])
    step = np.concatenate([part.step for part in results])
    difference = ids[:, 1] - ids[:, 0]
    along = _usual(difference[step[:, 0] == 1])
    down = _usual(difference[step[:, 1] == 1])
    if along is None or down is None:
        return None
    rows = ids[(step[:, 0] == 1) & (difference == along)].tolist()
    return MarkerLayout(
        along,
        down,
        float(np.median(np.concatenate([part.pitch for part in results]))) - 1,
        Counter((i, j) for i, j in rows),
        frozenset(int(number) for number in ids.flat),
    )


def another_grid(layout: MarkerLayout, board: Board) -> str | None:
    """What the markers show in place of a described grid, in words; None where it is as described.

    The pitch is not judged.
    """
    columns, rows = board.counts
    first, count = board.document.get("first_id", 0), columns * rows
    if rows > 1 and layout.along == 1 and layout.down > 1 and layout.down != columns:
        wide = layout.down
        high = count // wide if count % wide == 0 else -(-(max(layout.ids) + 1 - first) // wide)
        return f"a grid of {wide}x{high} markers"
    if columns > 1 and rows > 1 and (layout.along, layout.down) != (1, columns):
        return (
            f"markers whose ids go on by {layout.along:+d} to the right and by {layout.down:+d}"
            " downward"
        )
    beyond = [i for i in sorted(layout.ids) if not first <= i < first + count]
    if layout.breaks(first) < LEAST_CONTRADICTIONS and len(beyond) < LEAST_CONTRADICTIONS:
        return None
    possible = [k for k in layout.first_ids() if max(layout.ids) < k + count]
    if possible:
        return f"first_id: {possible[0]}, the marker with which the first row begins"
    return f"markers {', '.join(map(str, beyond[:4]))} beyond its {count}" if beyond else None


def _usual(differences: Array) -> int | None:
    """The step on which most pairs agree."""
    if len(differences) < LEAST_NEIGHBOURS:
        return None
    values, counts = np.unique(differences, return_counts=True)
    best = int(np.argmax(counts))
    return int(values[best]) if counts[best] >= LEAST_AGREEMENT * len(differences) else None


def _neighbours(markers: Markers) -> _Neighbours | None:
    """Those of one photograph."""
    ids, corners = markers
    wide = np.linalg.norm(np.diff(corners, axis=1), axis=-1).reshape(len(ids), 3)
    large = wide.min(axis=1, initial=np.inf) > LEAST_MARKER_SIDE
    ids, corners = ids[large], corners[large]
    if len(ids) < 2:
        return None
    # the detector's corners lie on the outermost dark pixels' centres
    bigger = (wide[large].mean(axis=1) + 1) / wide[large].mean(axis=1)
    right = (corners[:, 1] - corners[:, 0] + corners[:, 2] - corners[:, 3]) / 2
    below = (corners[:, 3] - corners[:, 0] + corners[:, 2] - corners[:, 1]) / 2
    axes = np.stack([right, below], axis=-1) * bigger[:, None, None]
    middle = corners.mean(axis=1)
    off = np.linalg.solve(axes[:, None], (middle[None] - middle[:, None])[..., None])[..., 0]
    # both ways together: what perspective makes of a step cancels
    off = (off - off.swapaxes(0, 1)) / 2
    distance = np.linalg.norm(off, axis=-1)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.min(axis=1)
    step = off / np.median(nearest)
    whole = np.rint(step)
    close: Booleans = (np.abs(step - whole) < LARGEST_LATTICE_MISFIT).all(axis=-1)
    one, other = np.nonzero(close & (np.abs(whole).sum(axis=-1) == 1))
    if not len(one):
        return None
    return _Neighbours(
        np.stack([ids[one], ids[other]], axis=-1), whole[one, other], distance[one, other]
    )
