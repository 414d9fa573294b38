"""[C] IV computed again: Tables 2, 3 and 4, 26 mm and 5 mm, beside the paper's figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.outcome import Figure
from pkmcal.report.reproduction import Reproduction
from pkmcal.reproduce import Options
from pkmcal.reproduce.paper_c_expected import (
    PROTOTYPE,
    SQUARE_AFTER,
    SQUARE_BEFORE,
    TABLE_3,
    TABLE_4,
    checks,
    compared,
    largest_side,
)
from pkmcal.reproduce.paper_c_simulation import Kind, model
from pkmcal.reproduce.paper_c_study import (
    BOUND,
    DRAWING,
    EQ3,
    EQ5,
    JOINT,
    WHITENED,
    Study,
    study,
)
from pkmcal.reproduce.paper_c_tables import (
    accuracy_part,
    axis_part,
    before_part,
    how_part,
    mm,
    ranks_part,
    table_2_part,
    table_3_part,
    table_4_part,
)
from pkmcal.reproduce.paper_c_validation import Before, before
from pkmcal.wording import number

MODELS_31: tuple[Kind, Kind] = ("design", "calibration")
CITED = (
    "P. Renaud, N. Andreff, F. Marquet, P. Martinet: Vision-based kinematic calibration of a H4"
    " parallel mechanism, ICRA, 2003; section IV."
)


def reproduce(options: Options) -> Reproduction:
    """The whole reproduction."""
    found = study(options.runs, seed=options.seed, told=options.told)
    start = before(model("design"), found.truth)
    return Reproduction(
        letter="c",
        title="Paper C: an H4 calibrated with a board, simulated",
        cited=CITED,
        headline=_headline(found, start),
        cards=_cards(found, start),
        checks=checks(found, start),
        remarks=_remarks(found),
        parts=(
            accuracy_part(found),
            table_2_part(found),
            before_part(start),
            table_3_part(found),
            table_4_part(found),
            axis_part(found),
            ranks_part(found),
            how_part(found),
        ),
        numbers=_numbers(found, start),
    )


def _headline(s: Study, start: Before) -> str:
    printed, best = (s.accuracy["design", "design", m] for m in (EQ3, JOINT))
    return (
        f"The a priori parameters leave {mm(start.shift, 0)} mm, as in the paper. On simulated"
        f" poses equation 3 brings that to {mm(printed.shift)} mm and the joint estimate to"
        f" {mm(best.shift)} mm; the paper reports less than 0.5 mm on its machine."
    )


def _cards(s: Study, start: Before) -> tuple[Figure, ...]:
    a = s.accuracy
    printed = a["calibration", "calibration", EQ5]
    best = a["calibration", "calibration", JOINT]
    least = a["calibration", "calibration", BOUND]
    return (
        Figure(
            "How far off is the nacelle before?",
            ((mm(start.shift, 1), "mm"), (number(start.turn, 4), "rad")),
            "the paper: 26 mm, 0.022 rad",
        ),
        Figure(
            "What do the equations as printed leave?",
            ((mm(printed.shift), "mm"), (mm(printed.turn), "mrad")),
            f"Model 31, equation 5; the joint estimate {mm(best.shift)} mm, {mm(best.turn)} mrad",
        ),
        Figure(
            "Could any method do better?",
            ((number(best.larger_shift / least.larger_shift, 2), "of the bound"),),
            "Model 31, joint estimate over Cramér-Rao",
        ),
        *_more_cards(s),
    )


def _more_cards(s: Study) -> tuple[Figure, ...]:
    """What models leave out, and the time."""
    a = s.accuracy
    poor, right = (a["calibration", name, JOINT] for name in MODELS_31)
    rods = a["rods", "rods", JOINT]
    return (
        Figure(
            "What if the model is too poor?",
            ((mm(poor.shift), "mm"),),
            f"Model 12 on a machine whose arms differ; its χ² per degree of freedom,"
            f" {number(poor.chi2, 1)} for {number(right.chi2, 2)}, tells it",
        ),
        Figure(
            "And rods that differ by 0.3 mm?",
            ((mm(rods.shift), "mm"),),
            f"with the model with rods; Model 31 {mm(a['rods', 'calibration', JOINT].shift)} mm",
        ),
        Figure(
            "How long does it take?",
            ((number(s.wall, 0), "s"),),
            f"{s.runs} runs, all models and methods, on {s.threads} threads",
        ),
    )


def _remarks(s: Study) -> tuple[str, ...]:
    """What is not reproduced, and why."""
    a = s.accuracy
    twelve, thirty_one = a["design", "design", JOINT], a["design", "calibration", JOINT]
    poor, rich = a["calibration", "design", EQ3], a["calibration", "calibration", EQ5]
    line = float(np.sqrt(np.mean(s.validation[f"calibration, {EQ5}"].straightness[:, :2] ** 2)))
    apart = [f for f in compared(s) if not f.held and not f.tolerable]
    out = [
        "Not reproduced: the paper's Model 31 is worse than its Model 12 by tenths of a"
        " millimetre. Where Model 12 is true, the further parameters of Model 31 cost noise,"
        f" {mm(thirty_one.shift)} for {mm(twelve.shift)} mm; where the arms differ by a millimetre,"
        f" Model 31 leaves {mm(rich.shift)} mm and Model 12 {mm(poor.shift)} mm.",
        f"Not reproduced: the paper's floor of half a millimetre after calibration. Straightness is"
        f" {mm(line)} mm here. Noise of 0.2 mm and 0.03° does not explain it; something that"
        " both of its models leave out does.",
        "The paper's 0.12° spread of the axis is what noise alone gives; it does not show four"
        " degrees of freedom.",
    ]
    if apart:
        told = "; ".join(f"{', '.join(f.key)} {f.found:.3g} for {f.expected:g}" for f in apart)
        out.append(
            f"Other than the prototype's, with machines drawn anew and rods 60 mm apart: {told}."
        )
    return tuple(out)


def _numbers(s: Study, start: Before) -> dict[str, Any]:
    """Everything for programs, m and rad."""
    return {
        "runs": s.runs,
        "seed": s.seed,
        "seconds": {"wall": s.wall, "threads": s.threads},
        "before": start._asdict(),
        "paper": {
            "before": {"shift": 0.026, "turn": 0.022},
            "table_3": {k: {"mean": v[0], "rms": v[1]} for k, v in TABLE_3.items()},
            "table_4": TABLE_4,
            "square": {"before": SQUARE_BEFORE, "after": SQUARE_AFTER},
        },
        "accuracy": [
            {
                "truth": truth,
                "model": name,
                "method": method,
                **{k: None if np.isnan(v) else v for k, v in a._asdict().items()},
                "prototype": PROTOTYPE.get((truth, name, method)),
            }
            for (truth, name, method), a in s.accuracy.items()
        ],
        "table_2": {
            m: {
                "mean": s.validation[f"design, {m}"].table_2.mean(axis=0).tolist(),
                "std": s.validation[f"design, {m}"].table_2.std(axis=0).tolist(),
            }
            for m in (EQ3, WHITENED, JOINT)
        },
        "validation": {name: _validated(s, name) for name in s.validation},
        "axis": {
            "spread": float(np.sqrt(np.mean(s.axis.spread**2))),
            "expected": float(np.sqrt(np.mean(s.axis.expected**2))),
            "chi2_per_dof": float(s.axis.chi2.mean() / s.axis.dof),
        },
        "ranks": {f"{name}, {method}": rank for (name, method), rank in s.ranks.items()},
    }


def _validated(s: Study, name: str) -> dict[str, Any]:
    v = s.validation[name]
    mean = v.control_mean.mean(axis=0)
    if not name.endswith(DRAWING):
        mean = np.sqrt(np.mean(v.control_mean**2, axis=0))
    return {
        "control_mean": mean.tolist(),
        "control_rms": np.sqrt(np.mean(v.control_rms**2, axis=0)).tolist(),
        "straightness": np.sqrt(np.mean(v.straightness**2, axis=0)).tolist(),
        "square": largest_side(s, name),
    }
