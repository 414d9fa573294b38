"""Figures that [A] reports, those of an independent prototype, and the checks against both."""

from __future__ import annotations

import numpy as np

from pkmcal.identify.axis_measurements import AxisNoise
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.paper_a import (
    FOUR_STEPS_CORRECTED,
    FOUR_STEPS_PRINTED,
    PAPER_A_BOUND,
    PAPER_A_JOINT,
    PAPER_A_PARAMETER_GROUPS,
    RADIAN_IN_DEGREES,
    HexapodByAxes,
    converged,
)
from pkmcal.studies.reproduction import (
    TWO_SIGMA,
    Claim,
    Compared,
    at_most,
    compared,
    deg,
    mm,
    prototype_claim,
)
from pkmcal.studies.statistics import ratio_of_figures
from pkmcal.studies.tasks import Key
from pkmcal.wording import number

TABLE_1 = AxisNoise(images=1)
"""[A] Table 1, a single image. It is printed in rad, but degrees are meant (errata): in rad the
end-effector would have errors of centimetres.
"""
MEAN_ERRORS = (0.04e-3, 1e-3)
"""Range of the mean errors of the thirty parameters, [A] 4.3, m."""
PAPER_A_ERRORS_BEFORE, PAPER_A_ERRORS_AFTER = (
    (1e-3, float(np.radians(0.12))),
    (0.08e-3, float(np.radians(0.018))),
)
"""Errors of the end-effector with the nominal model and calibrated, [A] 4.3, m and rad; angles are
printed in rad, but degrees are meant, as in Table 1.
"""

_GROUPS = {
    FOUR_STEPS_PRINTED: ("0.077", "1.79", "0.100", "1.62", "0.198"),
    FOUR_STEPS_CORRECTED: ("0.061", "0.181", "0.086", "0.146", "0.170"),
    PAPER_A_JOINT: ("0.034", "0.063", "0.021", "0.032", "0.060"),
    PAPER_A_BOUND: ("0.034", "0.060", "0.020", "0.030", "0.059"),
}
_EFFECTOR = {
    FOUR_STEPS_PRINTED: ("2.6", "0.49"),
    FOUR_STEPS_CORRECTED: ("0.27", "0.048"),
    PAPER_A_JOINT: ("0.091", "0.0142"),
}
PAPER_A_PROTOTYPE: dict[Key, dict[str, str]] = {
    (method,): {
        **dict(zip(PAPER_A_PARAMETER_GROUPS, figures, strict=True)),
        **dict(zip(("displacement", "orientation"), _EFFECTOR.get(method, ()), strict=False)),
    }
    for method, figures in _GROUPS.items()
}
"""RMSE (mm) of PAPER_A_PARAMETER_GROUPS and errors of the end-effector (mm and degrees) by an
independent prototype that shares no code with this program: 3 stations x 15 poses x 4 legs. The
poses of its cameras and the size of its nominal errors are not known.
"""
PROTOTYPE_POSES = {5: 0.169, 15: 0.091, 30: 0.060, 120: 0.029}
"""Prototype's end-effector error (mm) of the joint estimate by number of poses at a station."""
MOST_DISPLACEMENT, MOST_ORIENTATION = 0.095, 0.015
"""Maximum errors of the joint estimate's end-effector, mm and degrees."""

FOLLOWS_NOMINAL = {
    ((FOUR_STEPS_PRINTED,), name)
    for name in ("base_z", "platform_z", "displacement", "orientation")
}
"""Figures for which the four steps as printed leave the error of the nominal model."""
PAPER_A_TOLERANCE, PAPER_A_OPEN_TOLERANCE = 0.25, 0.35
"""Accepted relative differences from the prototype: its cameras had other poses, which changes the
bound by a tenth; for FOLLOWS_DRAWING the size of the nominal errors is open as well.
"""
BOUND_TOLERANCE = 1.05
CHI2_TOLERANCE = 0.02
"""Accepted deviation of chi2 from 1: the noise of directions, 1e-3 rad, is not linear and changes
chi2 by less.
"""


def tolerance(key: Key, quantity: str) -> float:
    """Accepted relative difference from one of the prototype's figures."""
    return PAPER_A_OPEN_TOLERANCE if (key, quantity) in FOLLOWS_NOMINAL else PAPER_A_TOLERANCE


def paper_a_figures(study: StudyResult[HexapodByAxes]) -> list[Compared]:
    """All figures of the prototype, those of the end-effector last."""
    figures = compared(study, PAPER_A_PROTOTYPE, tolerance)
    return sorted(figures, key=lambda figure: figure.quantity not in PAPER_A_PARAMETER_GROUPS)


def paper_a_checks(study: StudyResult[HexapodByAxes]) -> tuple[Claim, ...]:
    """Checks that must pass for the reproduction to succeed."""
    joint, right = study.of(PAPER_A_JOINT), converged(study)
    over = ratio_of_figures(joint["parameters"], study.of(PAPER_A_BOUND)["parameters"]).value
    chi2 = joint["chi2"].value
    dof = float(study.values("dof", PAPER_A_JOINT)[0])
    scatter = float(np.sqrt(2 / dof / study.runs))
    spread = max(joint[name].error / joint[name].value for name in PAPER_A_PARAMETER_GROUPS)
    shift, turn = PAPER_A_ERRORS_AFTER
    return (
        Claim(
            "Sec. 4.3",
            "runs in which the joint estimate finds the right minimum",
            f"{right} of {study.runs}",
            expected="all",
            passed=right == study.runs,
        ),
        at_most(
            "Sec. 4.3", "joint estimate, displacement of the end-effector", "mm",
            joint["displacement"].times(1e3), MOST_DISPLACEMENT, 4, mm(shift, places=2),
        ),
        at_most(
            "Sec. 4.3", "joint estimate, orientation of the end-effector", "°",
            joint["orientation"].times(RADIAN_IN_DEGREES), MOST_ORIENTATION, 4, deg(turn, 3),
        ),
        Claim(
            "Sec. 4.3",
            "joint estimate over its Cramér-Rao bound, all thirty parameters",
            number(over, 3),
            expected=f"≤ {BOUND_TOLERANCE:g}{TWO_SIGMA}",
            passed=over <= BOUND_TOLERANCE + 2 * spread,
        ),
        Claim(
            "Sec. 4.3",
            "χ² per degree of freedom of the joint estimate, mean",
            number(chi2, 3),
            expected=f"1 ± {CHI2_TOLERANCE:g}{TWO_SIGMA}",
            passed=abs(chi2 - 1) <= CHI2_TOLERANCE + 2 * scatter,
        ),
        prototype_claim(
            paper_a_figures(study),
            f"within {PAPER_A_TOLERANCE:.0%}; what follows the nominal model's error, within"
            f" {PAPER_A_OPEN_TOLERANCE:.0%}",
        ),
    )  # fmt: skip
