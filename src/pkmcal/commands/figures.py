"""The report's headline figures for the terminal, and the same as numbers for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.identify.centres import Centres
from pkmcal.identify.tool import ToolPoint, centres_and_tool
from pkmcal.outcome import Figure
from pkmcal.report.headline import headlines

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration


@dataclass(frozen=True)
class Figures:
    """Joint centres and poses of the configurations with their uncertainties, free of frames."""

    calibration: Calibration
    centres: tuple[Centres, ...]
    tool: ToolPoint

    def headlines(self) -> tuple[Figure, ...]:
        """As in the report."""
        c = self.calibration
        return headlines(c.session, c.observation, c.estimate, self.centres, self.tool)

    def as_dict(self) -> dict[str, Any]:
        """In m and rad; means over joint centres and configurations, sigma of one coordinate."""
        estimate = self.calibration.estimate
        statistics, table = estimate.statistics, estimate.machine.parameters
        offsets = np.sqrt(np.diag(estimate.covariance)[table.of_kind("offset")])
        sigma = np.concatenate([side.sigma for side in self.centres])
        change = np.concatenate([np.linalg.norm(side.change, axis=-1) for side in self.centres])
        return {
            "joint_centre_sigma": float(np.median(sigma)),
            "joint_offset_sigma": float(np.median(offsets)) if offsets.size else None,
            "joint_centre_change": float(change.mean()),
            "platform_position_sigma": _mean(self.tool.position),
            "platform_orientation_sigma": _mean(self.tool.orientation),
            "platform_position_change": _mean(self.tool.off_position),
            "platform_orientation_change": _mean(self.tool.off_orientation),
            "edges": len(self.calibration.observation.edges),
            "rejected": len(self.calibration.observation.rejected),
            "chi2_per_freedom": statistics.chi2 / statistics.dof if statistics.dof > 0 else None,
            "edge_noise_scale": statistics.noise_scale,
        }


def figures_of(calibration: Calibration) -> Figures:
    """The figures of a calibration."""
    session, estimate = calibration.session, calibration.estimate
    centres, tool = centres_and_tool(session.machine, estimate, session.joints)
    return Figures(calibration, centres, tool)


def _mean(values: np.ndarray[Any, Any]) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else None
