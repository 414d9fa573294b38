"""The correlations of the parameters as a picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.identify.estimate import Estimate
from pkmcal.outcome import AXIS, LOOKS, Part, Plot
from pkmcal.report.parameters import correlations

MOST = 250
"""Parameters up to which they are shown: of more, a cell would be less than three pixels."""
COLOURS = [[0.0, "--drawing"], [0.5, "--card"], [1.0, "--calibrated"]]
HOW = (
    "Orange: when one is larger than told, so is the other; blue: the other is smaller. Only their"
    " sum, or difference, is as sure as the small deviations of other values suggest. In the"
    " frames that the parameters are told in; what a frame or the file holds is left out, and of"
    " values that are tied one stands for all."
)


def section(estimate: Estimate) -> Part | None:
    """The section; None where nothing was estimated, or too much to be drawn."""
    table = estimate.machine.parameters
    shown, rho, pairs = correlations(estimate)
    if not 1 < len(shown) <= MOST:
        return None
    names = [table.in_words(table.names[k]) for k in shown]
    off = np.abs(rho) * pairs
    a, b = np.unravel_index(np.argmax(off), off.shape)
    said = (
        f"Of {np.count_nonzero(pairs)} pairs, {np.count_nonzero(off > 0.8)} have a correlation of"
        f" more than 0.8; the closest are {names[a]} and {names[b]}, {rho[a, b]:+.2f}."
    ).replace("-", "−")
    if np.count_nonzero(pairs) < len(shown) * (len(shown) - 1) // 2:
        said += " Components of one axis, which its length binds, are not counted."
    plot = Plot(
        "correlations",
        "Correlations of the parameters",
        "Point at a cell for its two parameters.",
        f"A square of {len(shown)} by {len(shown)} cells, coloured by the correlation of two"
        " parameters each.",
        _figure(rho, names),
        height=600,
        width=600,
    )
    return Part("correlations", "What is known together", (f"{said} {HOW}",), plots=(plot,),
                menu="Correlations")  # fmt: skip


def _figure(rho: Any, names: list[str]) -> dict[str, Any]:
    """The heat map."""
    # where the first of a leg's, or of a kind, stands
    common = {
        **AXIS, "showgrid": False, "zeroline": False, "ticks": "", "tickfont": {"size": 9},
        "automargin": True, "constrain": "domain",
    }  # fmt: skip
    data = [
        {
            "type": "heatmap",
            "x": names,
            "y": names,
            "z": np.round(rho, 2),
            "zmin": -1,
            "zmax": 1,
            "colorscale": COLOURS,
            "xgap": 0.5,
            "ygap": 0.5,
            "hovertemplate": "%{y}<br>%{x}<br>ρ = %{z:.2f}<extra></extra>",
            "colorbar": {"thickness": 12, "outlinewidth": 0, "len": 0.6, "title": {"text": "ρ"},
                         "tickvals": [-1, -0.5, 0, 0.5, 1]},
        }
    ]  # fmt: skip
    layout = {
        **LOOKS,
        "margin": {"l": 20, "r": 10, "t": 8, "b": 20},
        "xaxis": {**common, "tickangle": -90},
        "yaxis": {**common, "autorange": "reversed", "scaleanchor": "x"},
    }
    return {"data": data, "layout": layout, "config": {}}
