"""What decides a parameter's value: the data, the drawing, or a convention."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.mechanisms import ParameterTable

Decider = Literal["data", "drawing", "frame", "fixed"]

DECIDES = 0.5
"""Share of what is known that has to come from the data for the value to be theirs."""
EXACT = 1e-9
"""Standard deviations (m or rad) below this are zero but for rounding: a nanometre."""


def decided_by(table: ParameterTable, covariance: Array, data_share: Array) -> tuple[Decider, ...]:
    """What decides each of the parameters: covariance (P, P), and the data's share (P,).

    frame : the value only defines the result's frames. fixed : the mechanism file holds it.
    """
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return tuple(
        "fixed" if name in table.fixed
        else "frame" if sigma[k] <= EXACT
        else "data" if data_share[k] >= DECIDES
        else "drawing"
        for k, name in enumerate(table.names)
    )  # fmt: skip
