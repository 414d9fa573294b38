"""Images of a board per second, from files to fitted corners, and processor time.

    OPENBLAS_NUM_THREADS=1 python benchmarks/boards.py BOARD.yaml PHOTOGRAPH…

As in `pkmcal calibrate`, on `THREADS` threads; the best of ``ROUNDS``. On a machine with other load
wall time means nothing: processor time divided by the threads is then the best that a free machine
could reach.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from pkmcal.arrays import THREADS
from pkmcal.boards.board import load_board
from pkmcal.boards.poses import detect_in
from pkmcal.observe.images import Pictures
from pkmcal.session.image_files import image_header

ROUNDS = 5


def main() -> int:
    """Print the rates."""
    board = load_board(sys.argv[1])
    paths = [Path(word) for word in sys.argv[2:]]
    names = [path.name for path in paths]
    images = Pictures(paths, image_header(paths[0]), names)  # none is kept decoded
    detect_in(images[:1], board, names[:1])  # what is imported at first use
    walls, processors = list[float](), list[float]()
    count = 0
    for _ in range(ROUNDS):
        wall, processor = time.perf_counter(), time.process_time()
        count = sum(detection.success for detection in detect_in(images, board, names))
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    n = len(paths)
    sys.stdout.write(
        f"{count} of {n} found; {n / min(walls):.0f} a second,"
        f" {1e3 * min(processors) / n:.1f} ms of processor each:"
        f" {n * THREADS / min(processors):.0f} a second on {THREADS}"
        f" free processors\n"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
