"""Presentation of a calibration in Python: summary text, HTML, tables and plots.

The same for a new calibration and for one read from its file.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.centres import free_of_gauge
from pkmcal.identify.parameter_estimates import ParameterEstimates, parameter_estimates
from pkmcal.identify.tool import ToolAccuracy, checked_poses, tool_error
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.wording import brief, count, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Overview:
    """Contents of a summary.

    source : the session's name.
    nominal : (P,) nominal values.
    covariance : (P, P) of the parameters.
    data_share : (P,) 1 - posterior variance / prior variance.
    poses : T_base_platform (n, 4, 4) of the configurations in use.
    legs_observed : whether edges of legs were measured.
    residuals : (n,) of edges and poses, whitened, of weight 1/2 and more.
    chi2 : per degree of freedom, with the noise as stated; NaN if unknown.
    warnings : about the session.
    """

    source: str
    method: str
    machine: Machine
    verdict: Verdict
    nominal: Array
    covariance: Array
    data_share: Array
    poses: Array
    stations: tuple[str, ...]
    legs_observed: bool
    residuals: Array
    chi2: float
    warnings: tuple[str, ...]


class CalibrationSummary(ABC):
    """Base class of calibrations that present themselves as text, HTML, tables and plots."""

    @abstractmethod
    def overview(self) -> Overview:
        """Contents of the summary."""

    def tool_error(self, T_base_platform: Array) -> ToolAccuracy:
        """Uncertainty of poses of the calibrated machine, and errors of the nominal model there.

        See :func:`pkmcal.identify.tool.tool_error`. The result does not depend on the gauge: base
        and platform are fitted to the nominal model's by all joint centres or, if only boards or
        trackers observed the machine, by these poses. NaN where the machine cannot reach a pose.
        Raises InputError for an array that holds no poses.

        T_base_platform : (n, 4, 4).
        """
        overview = self.overview()
        # the nominal values in a calibration's mechanism file are the calibrated ones
        table = replace(overview.machine.parameters, nominal=overview.nominal)
        machine = replace(overview.machine, parameters=table)
        return tool_error(
            machine.with_values(overview.nominal),
            machine,
            free_of_gauge(machine, overview.covariance),
            checked_poses(T_base_platform),
            legs_observed=overview.legs_observed,
        )

    @property
    def parameters(self) -> ParameterEstimates:
        """All parameters: nominal value, value, standard deviation and what determines them.

        The object shows itself as a table; ``to_pandas()`` makes a DataFrame.
        """
        overview = self.overview()
        return parameter_estimates(
            overview.nominal, overview.machine, overview.covariance, overview.data_share
        )

    def summary(self) -> str:
        """The verdict and the main figures, some ten lines of text."""
        overview = self.overview()
        verdict = overview.verdict
        mark = "✓" if verdict.usable else "✗"
        lines = [self._title(overview), f"{mark} {verdict.headline}"]
        lines += [f"  • {reason}" for reason in verdict.reasons]
        lines += [f"  {name + ':':12} {text}" for name, text in self._figures(overview)]
        lines += [f"! {text}" for text in (*verdict.warnings, *overview.warnings)]
        lines += [f"→ {text}" for text in verdict.advice]
        return "\n".join(lines)

    def __repr__(self) -> str:
        overview = self.overview()
        state = "usable" if overview.verdict.usable else "not to be used"
        return f"<{self._title(overview)}: {state}>"

    def _repr_html_(self) -> str:
        overview = self.overview()
        verdict = overview.verdict
        rows = "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>"
            for name, text in self._figures(overview)
        )
        words = [*verdict.reasons, *verdict.warnings, *overview.warnings, *verdict.advice]
        points = "".join(f"<li>{escape(text)}</li>" for text in words)
        mark = "✓" if verdict.usable else "✗"
        return (
            f"<p><b>{escape(self._title(overview))}</b></p>"
            f"<p>{mark} {escape(verdict.headline)}</p><table>{rows}</table>"
            + (f"<ul>{points}</ul>" if points else "")
        )

    def _title(self, values: Overview) -> str:
        """Machine, session, method and number of configurations."""
        return (
            f"Calibration of {values.machine.name} from {values.source or 'a session'}, method"
            f" {values.method}, {count(len(values.poses), 'configuration')}"
        )

    def _figures(self, values: Overview) -> list[tuple[str, str]]:
        """Names and values of the main figures."""
        out: list[tuple[str, str]] = []
        # mean and largest tool error, after and before
        tool = self.tool_error(values.poses)
        for name, place, turn in (
            ("Tool, σ", tool.position, tool.orientation),
            ("Nominal model off", tool.off_position, tool.off_orientation),
        ):
            finite = np.isfinite(place)
            if finite.any():
                angle = float(np.rad2deg(turn[finite].mean()))
                turned = f", {brief(angle)}°" if angle > np.rad2deg(ROUNDING) else ""
                where = f"{brief(float(place[finite].max()) * 1e3)} mm at worst"
                out.append(
                    (name, f"{brief(float(place[finite].mean()) * 1e3)} mm{turned} ({where})")
                )
        # what determines the parameters
        kinds = [row.decided_by for row in self.parameters]
        deciders = {"data": "the data", "drawing": "the nominal model"}
        parts = [f"{kinds.count(k)} by {text}" for k, text in deciders.items() if k in kinds]
        held = len(kinds) - kinds.count("data") - kinds.count("drawing")
        parts += [f"{held} held by frame or file"] if held else []
        out.append(("Parameters", f"{len(kinds)}: {', '.join(parts)}"))
        if values.stations:
            out.append(
                ("Stations", ", ".join(values.stations[:6]) + ", …" * (len(values.stations) > 6))
            )
        if np.isfinite(values.chi2):
            out.append(
                ("Fit", f"χ² {number(values.chi2, 2)} per degree of freedom, noise as stated")
            )
        return out

    # ------------------------------------------------------------------ plots

    def plot_residuals(self, ax: Axes | None = None) -> Axes:
        """Plot the residuals of edges and poses in standard deviations, with the standard normal
        density.

        Needs ``pip install '.[plot]'``.

        ax : axes to draw into; new ones by default.
        """
        from pkmcal.calibration.plots import draw_residuals

        return draw_residuals(self.overview().residuals, ax)

    def plot_parameters(self, ax: Axes | None = None) -> Axes:
        """Plot each parameter's change from its nominal value, with two standard deviations.

        In prior sigmas of the nominal model. Needs ``pip install '.[plot]'``.

        ax : as in :meth:`plot_residuals`.
        """
        from pkmcal.calibration.plots import parameters

        return parameters(self.parameters, self.overview().machine.parameters.tolerance, ax)

    def plot_tool(self, T_base_platform: Array | None = None, ax: Axes | None = None) -> Axes:
        """Plot the tool's error of the nominal model, and its standard deviation after the
        calibration.

        Needs ``pip install '.[plot]'``.

        T_base_platform : (n, 4, 4) poses; by default those of the configurations in use.
        ax : as in :meth:`plot_residuals`.
        """
        from pkmcal.calibration.plots import tool

        poses = self.overview().poses if T_base_platform is None else T_base_platform
        return tool(self.tool_error(poses), ax)
