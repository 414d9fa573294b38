"""[A] 4 reproduced: Table 1, Fig. 4 and the end-effector's errors, beside the paper's figures."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from pkmcal.identify.axis_measurements import AxisNoise
from pkmcal.studies.engine import StudyResult, run
from pkmcal.studies.paper_a import (
    END_EFFECTOR_QUANTITIES,
    FOUR_STEPS_CORRECTED,
    FOUR_STEPS_PRINTED,
    PAPER_A_BOUND,
    PAPER_A_JOINT,
    PAPER_A_METHODS,
    PAPER_A_NOMINAL,
    PAPER_A_PARAMETER_GROUPS,
    RADIAN_IN_DEGREES,
    HexapodByAxes,
    converged,
    hexapod_with_held_radii,
    mean_error,
    thirty,
)
from pkmcal.studies.paper_a_expected import (
    MEAN_ERRORS,
    PAPER_A_ERRORS_AFTER,
    PAPER_A_ERRORS_BEFORE,
    PROTOTYPE_POSES,
    TABLE_1,
    paper_a_checks,
    paper_a_figures,
)
from pkmcal.studies.reproduction import (
    NOT_PRINTED,
    Claim,
    Compared,
    Options,
    Reproduction,
    deg,
    mm,
    with_error,
)
from pkmcal.studies.statistics import covered, mean
from pkmcal.wording import brief, number

if TYPE_CHECKING:
    from pkmcal.studies.paper_a_images import MeasuredNoise

NARROW_NOMINAL_ERROR = 0.002 / 3**0.5
"""Standard deviation (m) of errors that are uniform within ± 2 mm, the other reading of "uniform
noise with variance equal to 2 mm".
"""
PAPER_A_METHOD_LABELS = {
    PAPER_A_NOMINAL: "before calibration",
    FOUR_STEPS_PRINTED: "four steps as printed",
    FOUR_STEPS_CORRECTED: "four steps corrected",
    PAPER_A_JOINT: "joint estimate",
    PAPER_A_BOUND: "Cramér-Rao bound",
}
PAPER_A_CITED = (
    "P. Renaud, N. Andreff, G. Gogu, P. Martinet: On vision-based kinematic calibration of n-leg"
    " parallel mechanisms, IFAC, 2002; sections 4.2 and 4.3."
)

HexapodByAxesStudy = StudyResult[HexapodByAxes]


def reproduce(options: Options) -> Reproduction:
    """Reproduce [A] 4."""
    began = perf_counter()
    measured, done = None, 0.0
    if options.images:
        from pkmcal.studies.paper_a_images import measured_noise

        done = 0.6
        measured = measured_noise(options.seed, options.within(0.0, done))
    share = (1 - done) * (0.1 if options.long else 0.5)
    study, narrow = (
        run(setting, options.runs, options.seed, options.within(begin, begin + share))
        for setting, begin in (
            (HexapodByAxes(), done),
            (HexapodByAxes(nominal_error=NARROW_NOMINAL_ERROR), done + share),
        )
    )
    done += 2 * share
    by_poses: dict[int, HexapodByAxesStudy] = {}  # by number of poses at a station
    for poses in PROTOTYPE_POSES if options.long else ():
        upto = done + (1 - done) * poses / sum(PROTOTYPE_POSES)
        progress = options.within(done, upto)
        same = poses == study.setting.poses
        setting = replace(study.setting, poses=poses)
        by_poses[poses] = study if same else run(setting, options.runs, options.seed, progress)
        done = upto
    figures = paper_a_figures(study)
    numbers = _numbers(study, narrow, figures, by_poses, perf_counter() - began)
    shift = {m: 1e3 * study.of(m)["displacement"].value for m in PAPER_A_METHODS}
    turn = study.of(PAPER_A_JOINT)["orientation"].value
    return Reproduction(
        "a",
        PAPER_A_CITED,
        (
            *_noise_claims(measured),
            *_parameter_claims(study),
            *_effector_claims(study, narrow, by_poses),
            *paper_a_checks(study),
        ),
        f"Reproduced in part: joint estimate {number(shift[PAPER_A_JOINT], 3)} mm, {deg(turn, 4)}"
        f" (paper {_printed(PAPER_A_ERRORS_AFTER)}); the four steps as printed leave"
        f" {brief(shift[FOUR_STEPS_PRINTED])} mm.",
        (
            f"{mm(PAPER_A_ERRORS_AFTER[0], places=2)} by the four steps as printed: they keep the"
            " nominal model's depth. With errors within ± 2 mm their mean error in z is the"
            " paper's 1 mm.",
            "1 mm before calibration: it needs errors of the nominal model with a standard"
            f" deviation of {2 / shift[PAPER_A_NOMINAL]:.1f} mm, not 2 mm, on this machine.",
        ),
        {**numbers, **_noise(measured)},
    )


def _printed(errors: tuple[float, float]) -> str:
    """Displacement and orientation of the end-effector that the paper reports."""
    return f"{1e3 * errors[0]:g} mm, {np.degrees(errors[1]):g}°"


def _noise_claims(measured: MeasuredNoise | None) -> list[Claim]:
    """[A] Table 1, whose noise the simulation has, beside that of rendered images."""
    if measured is None:
        return []
    return [
        Claim("Table 1", f"ψ, θ, x, z of an axis, rendered images, {which} leg", _axis(noise),
              f"{_axis(TABLE_1)} (angles printed in rad)")
        for which, noise in (("median", measured.middle), ("worst", measured.bound))
    ]  # fmt: skip


def _axis(noise: AxisNoise) -> str:
    psi, theta, x, z = noise.sigma().tolist()
    return f"{deg(psi, 2)}, {deg(theta, 2)}, {mm(x, z, places=2)}"


def _parameter_claims(s: HexapodByAxesStudy) -> list[Claim]:
    """[A] Fig. 4, and the errata's root mean square errors by kind of parameter."""
    names = thirty(hexapod_with_held_radii()).names
    figure_4: list[Claim] = []
    by_group: list[Claim] = []
    for method, label in PAPER_A_METHOD_LABELS.items():
        if method == PAPER_A_NOMINAL:
            continue
        error = mean_error(s, method)
        paper = mm(*MEAN_ERRORS, places=2) if method == FOUR_STEPS_PRINTED else NOT_PRINTED
        here = f"{mm(float(error.min()), float(error.max()))} ({names[int(np.argmax(error))]})"
        figure_4.append(Claim("Fig. 4", f"mean errors, smallest and largest, {label}", here, paper))
        rmse = mm(*(s.of(method)[group].value for group in PAPER_A_PARAMETER_GROUPS))
        by_group.append(Claim("errata", f"RMSE of A xy, A z, B xy, B z, q0, {label}", rmse))
    joint = s.samples[PAPER_A_JOINT,]
    inside = mean(covered(joint.values["parameters"], joint.sigma["parameters"])).times(100)
    what = "errors inside the 95 % intervals that the joint estimate states"
    return [*figure_4, *by_group, Claim("Sec. 4.3", what, with_error(inside, "%", 1))]


def _effector_claims(
    s: HexapodByAxesStudy, narrow: HexapodByAxesStudy, by_poses: dict[int, HexapodByAxesStudy]
) -> list[Claim]:
    """[A] eq. 20: errors of the end-effector, also with errors of the nominal model within ± 2 mm
    and by number of poses at a station.
    """
    before, after = _printed(PAPER_A_ERRORS_BEFORE), _printed(PAPER_A_ERRORS_AFTER)
    papers = {PAPER_A_NOMINAL: before, FOUR_STEPS_PRINTED: after}
    out = [
        Claim(
            "eq. 20",
            f"error of the end-effector, {label}",
            with_error(s.of(method)["displacement"].times(1e3), "mm", 3)
            + ", "
            + with_error(s.of(method)["orientation"].times(RADIAN_IN_DEGREES), "°", 4),
            papers.get(method, NOT_PRINTED),
        )
        for method, label in PAPER_A_METHOD_LABELS.items()
        if method != PAPER_A_JOINT  # a check
    ]
    displacement = {m: narrow.of(m)["displacement"].value for m in PAPER_A_METHODS}
    methods = (PAPER_A_NOMINAL, FOUR_STEPS_PRINTED, PAPER_A_JOINT)
    z = np.char.endswith(np.array(thirty(hexapod_with_held_radii()).names), "z")
    depth = float(mean_error(narrow, FOUR_STEPS_PRINTED)[z].mean())
    out += [
        Claim(
            "Sec. 4.3",
            "nominal model within ± 2 mm: end-effector before, as printed, joint estimate",
            mm(*(displacement[m] for m in methods)),
            mm(PAPER_A_ERRORS_BEFORE[0], PAPER_A_ERRORS_AFTER[0], places=2),
        ),
        Claim("Sec. 4.3", "nominal model within ± 2 mm: mean error in z, four steps as printed",
              mm(depth, places=2), "up to 1 mm"),
    ]  # fmt: skip
    for poses, study in by_poses.items():
        joint, bound = (study.of(m)["displacement"] for m in (PAPER_A_JOINT, PAPER_A_BOUND))
        here = f"{with_error(joint.times(1e3), 'mm', 4)} (bound {mm(bound.value, places=4)})"
        out.append(Claim("errata", f"end-effector, joint estimate, {poses} poses a station", here))
    return out


# ------------------------------------------------------------------ for programs


def _numbers(
    s: HexapodByAxesStudy,
    narrow: HexapodByAxesStudy,
    figures: list[Compared],
    by_poses: dict[int, HexapodByAxesStudy],
    elapsed: float,
) -> dict[str, Any]:
    """Figures for programs, m and rad."""
    names = thirty(hexapod_with_held_radii()).names
    return {
        "runs": s.runs,
        "seed": s.seed,
        "poses_per_station": s.setting.poses,
        "converged": converged(s),
        "chi2_per_dof": s.of(PAPER_A_JOINT)["chi2"].value,
        "seconds": {"wall": elapsed, "solving": s.solving, "cpu": s.cpu, "workers": s.workers},
        "paper": {
            "mean_error": MEAN_ERRORS,
            "before": dict(
                zip(("displacement", "orientation"), PAPER_A_ERRORS_BEFORE, strict=True)
            ),
            "after": dict(zip(("displacement", "orientation"), PAPER_A_ERRORS_AFTER, strict=True)),
        },
        "methods": {m: _accuracy(s, m) for m in PAPER_A_METHODS},
        "methods_with_drawing_within_2_mm": {m: _accuracy(narrow, m) for m in PAPER_A_METHODS},
        "mean_error": {
            m: dict(zip(names, mean_error(s, m).tolist(), strict=True)) for m in PAPER_A_METHODS
        },
        "prototype": [
            {
                "method": f.key[0],
                "quantity": f.quantity,
                "found": f.measured.value,
                "error": f.measured.error,
                "expected": f.expected,
                "rounding": f.rounding,
                "differs": f.differs,
                "tolerable": f.tolerable,
            }
            for f in figures
        ],
        "by_poses": {n: _accuracy(other, PAPER_A_JOINT) for n, other in by_poses.items()},
    }


def _accuracy(s: HexapodByAxesStudy, method: str) -> dict[str, Any]:
    summaries = {
        name: s.of(method)[name] for name in (*PAPER_A_PARAMETER_GROUPS, *END_EFFECTOR_QUANTITIES)
    }
    return {
        "found": {name: summary.value for name, summary in summaries.items()},
        "standard_error": {name: summary.error for name, summary in summaries.items()},
    }


def _noise(measured: MeasuredNoise | None) -> dict[str, Any]:
    """[A] Table 1 for one image and, if measured, the noise on rendered images."""

    def report(noise: AxisNoise) -> dict[str, float]:
        return dict(zip(("psi", "theta", "x", "z"), noise.sigma().tolist(), strict=True))

    out: dict[str, Any] = {"table_1": report(TABLE_1)}
    if measured is not None:
        out["table_1_measured"] = {
            "median": report(measured.middle),
            "worst": report(measured.bound),
            "edge_px": measured.edge,
        }
    return out
