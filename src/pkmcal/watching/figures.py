"""A watched machine's tests for programs: plain data, m, rad and ratios, legs from 1."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from pkmcal.mechanisms import Machine
from pkmcal.watching.chances import POWER, Change
from pkmcal.watching.judged import Judgement, LegTest, Suspect


def judgement_document(judged: Judgement, machine: Machine) -> dict[str, Any]:
    """All tests and findings; what a test does not see is null."""
    return {
        "alpha": judged.alpha,
        "level": judged.level,
        "power": POWER,
        "changed": judged.changed,
        "machine": asdict(judged.machine),
        "legs": [_leg(leg) for leg in judged.legs],
        "scale": {**asdict(judged.scale), **_change(judged.scale_change)},
        "findings": [
            {
                **_suspect(finding.suspect, machine),
                "test": asdict(finding.test),
                "or": [_suspect(other, machine) for other in finding.others],
            }
            for finding in judged.findings
        ],
        "unexplained": asdict(judged.left),
    }


def _leg(leg: LegTest) -> dict[str, Any]:
    return {
        "legs": [j + 1 for j in leg.legs],
        **asdict(leg.whole),
        "zero": leg.zero
        and {**asdict(leg.zero), "unit": leg.unit, **(_change(leg.change) if leg.change else {})},
        "detectable": {
            "zero": leg.detects_zero,
            "base": leg.detects_base,
            "platform": leg.detects_platform,
        },
    }


def _suspect(suspect: Suspect, machine: Machine) -> dict[str, Any]:
    """A cause with its numbers' names: parameters, or what a ratio is of."""
    return {
        "part": suspect.cause.part,
        "legs": [j + 1 for j in suspect.cause.legs],
        "numbers": list(numbers_of(suspect, machine)),
        **_change(suspect.change),
        "chi2": suspect.chi2,
    }


def numbers_of(suspect: Suspect, machine: Machine) -> tuple[str, ...]:
    """Names of the numbers that a cause changes."""
    names = (*machine.parameters.names, *("magnification",) * suspect.cause.columns.shape[0])
    if suspect.cause.part == "scale":
        return ("scale",)
    return tuple(names[int(abs(column).argmax())] for column in suspect.cause.columns.T)


def _change(change: Change) -> dict[str, Any]:
    return {"change": change.value, "sigma": change.sigma}
