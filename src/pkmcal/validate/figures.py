"""Figures of a comparison: for tables ([C] Table 3), and for programs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import base_carriers
from pkmcal.validate.drawn import Errors
from pkmcal.validate.holdouts import HoldOut, Judged
from pkmcal.validate.judged import rms, weighed


@dataclass(frozen=True)
class Figures:
    """Of one machine, weighed by how well each configuration was seen; m and rad.

    joint_mean, joint_rms : (m,) of the readings' residuals ([C] Table 3). position, orientation :
    root mean squares of the tool point's errors.
    """

    joint_mean: Array
    joint_rms: Array
    position: float
    orientation: float


def reading_units(machine: Machine) -> tuple[str, ...]:
    """Unit of each reading, m or rad: a driven carrier with angles among its numbers turns."""
    out = ["m"] * machine.n_joints
    for leg, column in zip(machine.document.legs, machine.layout.actuated, strict=True):
        carrier = base_carriers()[leg.base.joint]
        if column >= 0 and carrier.driven and any(p.unit == "rad" for p in carrier.parameters):
            out[column] = "rad"
    return tuple(out)


def figures(errors: Errors, judged: Judged) -> Figures:
    """Of the drawing's or the calibrated machine's errors."""
    sigma = judged.promise.by_noise
    mean, root = weighed(errors.residuals, sigma)
    each = np.sqrt(np.mean(sigma**2, axis=1))
    return Figures(
        mean,
        root,
        float(weighed(errors.position, each)[1]),
        float(weighed(errors.orientation, each)[1]),
    )


def promised(judged: Judged) -> Array:
    """Root mean squares (m,) of the readings' residuals that the deviations promise, m or rad."""
    return weighed(judged.promise.expected, judged.promise.by_noise)[1]


def judged_document(judged: Judged, names: tuple[str, ...]) -> dict[str, Any]:
    """A comparison for programs, m and rad."""
    test = judged.promise
    return {
        "configurations": [names[row] for row in judged.rows],
        "drawing": _errors_document(judged.drawing, judged, judged.before),
        "calibrated": _errors_document(judged.calibrated, judged, judged.after),
        "times_better": asdict(judged.ratio),
        "photographs_noise": judged.floor,
        "promise": {
            "chi2": test.chi2,
            "dof": test.dof,
            "chance": test.chance,
            "factor": test.factor,
            "kept": test.kept,
            "common": test.common,
            "common_sigma": test.common_sigma,
            "common_chance": test.common_chance,
            "joint_rms": promised(judged),
        },
    }


def _errors_document(errors: Errors, judged: Judged, weighed_by_pose: Array) -> dict[str, Any]:
    """weighed_rms : as the verdict's, by how well each direction was seen."""
    return {
        "weighed_rms": rms(weighed_by_pose),
        **asdict(figures(errors, judged)),
        "residuals": errors.residuals,
        "tool_position": errors.position,
        "tool_orientation": errors.orientation,
    }


def holdout_document(item: HoldOut, names: tuple[str, ...]) -> dict[str, Any]:
    """Configurations held out for programs, beside those in use."""
    return {
        "where": item.region.name,
        "left_out": judged_document(item.left_out, names),
        "used": judged_document(item.used, names),
    }
