"""Model violations of stations that moved during the measurement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.measurements import Effect, ModelViolation
from pkmcal.wording import amount

FEWEST_BESIDE_MOVEMENT = 3
"""Fewest configurations before and after a movement; fewer are treated as outliers."""
MOVEMENT_MOMENTS_TRIED = 12
"""Most moments of movement tested for each station, spread over its configurations."""


def movement_violations(
    station: int, name: str, used: Integers, configurations: Sequence[str], what: str = "camera"
) -> Iterator[ModelViolation]:
    """Model violations: the station has another pose from some configuration on, one for each
    moment tested.

    station, name : number and name of the station.
    used : rows of the configurations that the station measured, in order.
    configurations : names of all configurations.
    what : camera, or another noun for messages.
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

        effect = Effect(station=station, since=int(used[k]))
        yield ModelViolation("station.moved", name, facts, effect)


def how_far(change: Array) -> str:
    """Size of a pose change as the end of a sentence.

    change : (6,) omega and tau, rad and m; NaN for components that the data do not determine.
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
