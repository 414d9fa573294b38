"""Cameras and trackers that did not stand still while they measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.measurements import Column
from pkmcal.wording import amount

FEWEST_BESIDE_MOVEMENT = 3
"""Configurations on either side of a movement: of three, the fewest of which most can agree
against one, two contradict an outlier."""
MOVEMENT_MOMENTS_TRIED = 12
"""Times at most, spread over a station's configurations, at which it may have moved."""


def movement_columns(
    station: int, name: str, used: Integers, configurations: Sequence[str], what: str = "camera"
) -> Iterator[Column]:
    """Columns of a station that moved after some configuration.

    station, name : its number and name.
    used : configurations of which it measured something, in their order.
    what : stands there.
    """
    few = FEWEST_BESIDE_MOVEMENT
    times = min(MOVEMENT_MOMENTS_TRIED, len(used) - 2 * few + 1)
    moments = np.linspace(few, len(used) - few, max(times, 0)).astype(int)
    for k in np.unique(moments).tolist():
        before, after = (configurations[int(used[k + d])] for d in (-1, 0))

        def facts(value: Array, _s: Array, b: str = before, a: str = after) -> dict[str, Any]:
            return {
                "what": what, "station": name, "before": b, "after": a, "moved": how_far(value),
                **{
                    key: float(np.linalg.norm(part)) if np.isfinite(part).all() else None
                    for key, part in (("turn", value[:3]), ("shift", value[3:]))
                },
            }  # fmt: skip

        yield Column(
            "station.moved",
            name,
            "station moved",
            station=station,
            since=int(used[k]),
            facts=facts,
        )


def how_far(change: Array) -> str:
    """Movement of a pose in words, as the end of a sentence.

    change : (omega, tau), rad and m; NaN where the data do not determine it.
    """
    turn, shift = change[:3], change[3:]
    sizes = [
        amount(float(np.linalg.norm(part[np.isfinite(part)])), unit)
        for part, unit in ((shift, "m"), (turn, "rad"))
        if np.isfinite(part).any()
    ]
    if not sizes:
        return ", by how much these data do not determine"
    partly = "" if np.isfinite(change).all() else ", as far as these data determine it"
    return f", by some {' and '.join(sizes)}{partly}"
