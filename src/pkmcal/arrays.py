"""The one array type of the project, so that signatures stay readable; and its plain figure."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Integers = NDArray[np.integer[Any]]
Booleans = NDArray[np.bool_]


def rms(values: Array) -> float:
    """Root mean square of all values; NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
