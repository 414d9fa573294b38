"""Plots of a calibration with matplotlib, which is an extra: ``pip install '.[plot]'``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.identify.parameter_estimates import ParameterEstimates
from pkmcal.identify.tool import ToolAccuracy
from pkmcal.outcome.blocks.plot import log_axis
from pkmcal.wording import install_step

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CALIBRATED_COLOUR, NOMINAL_COLOUR, QUIET_COLOUR = "#c2480c", "#0068a8", "#8d97a1"
"""Colours of the calibrated machine, of the nominal model, and of reference lines: those of the
pages.
"""
PARAMETER_ROW_HEIGHT = 0.17
"""Height of a parameter's row in inches."""
RESIDUAL_PLOT_REACH = 5.0
"""Largest residual in standard deviations, to either side, that is plotted at its own value."""


def _axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    """The given axes, or new ones of a size in inches. Raises InputError without matplotlib."""
    if ax is not None:
        return ax
    try:
        from matplotlib import pyplot
    except ImportError:
        raise InputError(
            "plots need matplotlib", next_step=install_step("plot"), code="package.missing"
        ) from None
    return pyplot.subplots(figsize=size, layout="constrained")[1]


def draw_residuals(values: Array, ax: Axes | None = None) -> Axes:
    """Histogram of residuals (n,) in standard deviations, with the standard normal density."""
    ax = _axes(ax, (6.0, 3.4))
    if not values.size:
        ax.set_title("There are no edges and no measured poses")
        return ax
    at = np.linspace(-RESIDUAL_PLOT_REACH, RESIDUAL_PLOT_REACH, 200)
    outside = int(np.sum(np.abs(values) > RESIDUAL_PLOT_REACH))
    bins = np.linspace(-RESIDUAL_PLOT_REACH, RESIDUAL_PLOT_REACH, 51).tolist()
    drawn = np.clip(values, -RESIDUAL_PLOT_REACH, RESIDUAL_PLOT_REACH)
    ax.hist(drawn, bins=bins, density=True, color=CALIBRATED_COLOUR, alpha=0.6,
            label=f"{values.size} residuals")  # fmt: skip
    ax.plot(at, np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi), color=QUIET_COLOUR, label="noise alone")
    ax.set_xlabel("residual, standard deviations")
    ax.set_ylabel("density")
    ax.set_title(f"Residuals ({outside} beyond {RESIDUAL_PLOT_REACH:g}, in the outermost bars)")
    ax.legend(frameon=False)
    return ax


def parameters(estimates: ParameterEstimates, tolerance: Array, ax: Axes | None = None) -> Axes:
    """Change of each parameter from its nominal value, with two standard deviations, in prior
    sigmas.

    Parameters that the gauge or the file fixes are left out.

    tolerance : (P,) prior sigmas.
    """
    rows = [k for k, row in enumerate(estimates) if row.decided_by in ("data", "drawing")]
    ax = _axes(ax, (6.0, 1.2 + PARAMETER_ROW_HEIGHT * len(rows)))
    for place, k in enumerate(rows):
        row, size = estimates[k], float(tolerance[k])
        colour = CALIBRATED_COLOUR if row.decided_by == "data" else NOMINAL_COLOUR
        reach = 2 * row.sigma / size
        ax.errorbar(row.change / size, place, xerr=reach, fmt="o", ms=3, color=colour, lw=1)
    ax.axvline(0, color=QUIET_COLOUR, linewidth=0.8)
    ax.axvspan(-1, 1, color=QUIET_COLOUR, alpha=0.12, linewidth=0)
    ax.set_yticks(range(len(rows)), [estimates[k].name for k in rows], fontsize=7)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel("change ± 2σ, in tolerances")
    ax.set_title("Parameters: orange by the data, blue by the nominal model", fontsize=10)
    return ax


def tool(error: ToolAccuracy, ax: Axes | None = None) -> Axes:
    """Tool error of the nominal model, and standard deviation after the calibration, at each pose,
    mm.
    """
    ax = _axes(ax, (6.0, 3.4))
    finite = np.flatnonzero(np.isfinite(error.position))
    order = finite[np.argsort(error.position[finite])]
    place = np.arange(len(order))
    for values, colour, name in (
        (error.off_position, NOMINAL_COLOUR, "the nominal model's error"),
        (error.position, CALIBRATED_COLOUR, "calibrated, 1σ"),
    ):
        ax.plot(place, values[order] * 1e3, "o", ms=4, color=colour, label=name)
    axis = log_axis("tool position, mm", [*error.position * 1e3, *error.off_position * 1e3])
    ax.set_yscale("log")
    ax.set_ylim(axis.limits)
    ax.set_yticks([tick.at for tick in axis.ticks], [tick.label for tick in axis.ticks])
    ax.set_yticks([], minor=True)
    ax.locator_params(axis="x", integer=True)
    ax.set_xlabel("poses, the best known first")
    ax.set_ylabel(axis.label)
    ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    return ax
