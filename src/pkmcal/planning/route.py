"""Shortest open path through configurations, by readings."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

ROUTE_CHANGES_A_POINT = 50
"""Maximum number of improvements for each point; usually none is left before."""
ROUTE_GAIN_ROUNDING = 1e-12
MOST_POINTS_MOVED_TOGETHER = 3
"""Maximum length of a stretch that is moved (Or-opt)."""


def motor_distances(joints: Array, ranges: Array) -> Array:
    """Distances (n, n) between readings (n, m): the largest motion of a motor relative to its range
    (m, 2).
    """
    return np.abs((joints[:, None] - joints) / motor_spans(joints, ranges)).max(axis=-1)


def motor_spans(joints: Array, ranges: Array) -> Array:
    """Lengths (m,) of the motors' ranges (m, 2), or the span of the readings (n, m) for a motor
    without a range.
    """
    span, own = ranges[:, 1] - ranges[:, 0], np.ptp(joints, axis=0)
    return np.where(np.isfinite(span) & (span > 0), span, np.where(own > 0, own, 1.0))


def shortest_path(
    apart: Array, first: Array | None = None, barred: Booleans | None = None
) -> Integers:
    """Order (n,) of points that makes an open path through all of them short.

    apart : (n, n) distances.
    first : (n,) distances from the start of the path; None for any start.
    barred : (n, n) steps to be avoided if possible.

    Nearest neighbour, then reversed stretches (2-opt, Croes 1958) and moved stretches (Or 1976),
    each time the largest gain, until neither gains.
    """
    n = len(apart)
    # one more point represents the start and the open end
    cost = np.zeros((n + 1, n + 1))
    cost[:n, :n] = apart + (0.0 if barred is None else barred * (apart.max() * n + 1.0))
    cost[n, :n] = 0.0 if first is None else first
    # Nearest neighbour.
    order, remaining = [n], np.ones(n, dtype=bool)
    while remaining.any():
        rest = np.flatnonzero(remaining)
        order.append(int(rest[np.argmin(cost[order[-1], rest])]))
        remaining[order[-1]] = False
    # 2-opt and Or-opt.
    path = np.array([*order, n])
    for _ in range(ROUTE_CHANGES_A_POINT * n):
        gain, better = max(
            (_best_reversal(path, cost), _best_move(path, cost)), key=lambda item: item[0]
        )
        if gain < ROUTE_GAIN_ROUNDING * cost.max():
            break
        path = better
    return path[1:-1]


def length(path: Integers, apart: Array, first: Array | None = None) -> float:
    """Length of a path, including the distance to its start."""
    begin = 0.0 if first is None else float(first[path[0]])
    return begin + float(apart[path[:-1], path[1:]].sum())


def _best_reversal(path: Integers, cost: Array) -> tuple[float, Integers]:
    """Best gain by reversing a stretch i to j (2-opt), and the path after it."""
    before, here, after = path[:-2], path[1:-1], path[2:]
    now = cost[before, here][:, None] + cost[here, after]
    gain = now - cost[before[:, None], here] - cost[here[:, None], after]
    gain = np.triu(gain, 1)
    i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
    better = np.concatenate([path[: i + 1], path[i + 1 : j + 2][::-1], path[j + 2 :]])
    return float(gain[i, j]), better


def _best_move(path: Integers, cost: Array) -> tuple[float, Integers]:
    """Best gain by moving a stretch of up to three points between two others, and the path after
    it.
    """
    moves: list[tuple[float, int, int, int]] = []
    step = cost[path[:-1], path[1:]]
    for size in range(1, min(MOST_POINTS_MOVED_TOGETHER, len(path) - 3) + 1):
        i = np.arange(1, len(path) - size)
        first, last = path[i], path[i + size - 1]
        without = step[i - 1] + step[i + size - 1] - cost[path[i - 1], path[i + size]]
        j = np.arange(len(path) - 1)
        with_ = cost[path[j], first[:, None]] + cost[last[:, None], path[j + 1]] - step
        gain = without[:, None] - with_
        gain[(j >= i[:, None] - 1) & (j <= i[:, None] + size - 1)] = -np.inf
        a, b = np.unravel_index(int(np.argmax(gain)), gain.shape)
        moves.append((float(gain[a, b]), int(i[a]), size, int(b)))
    if not moves:
        return -np.inf, path
    gain, i, size, j = max(moves)
    part, rest = path[i : i + size], np.delete(path, np.s_[i : i + size])
    j = j if j < i else j - size
    return gain, np.concatenate([rest[: j + 1], part, rest[j + 1 :]])
