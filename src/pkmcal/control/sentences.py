"""Findings of a servoing study, and whether the control may be used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pkmcal.arrays import rms
from pkmcal.control.simulation import ARRIVED_DISTANCE_SHARE
from pkmcal.control.study import Study
from pkmcal.levels import NEARLY_ALL, NEGLIGIBLE
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, Level, doubtful, note, wrong
from pkmcal.wording import named


def judgement(study: Study) -> Verdict:
    """Verdict on a study: headline and findings."""
    own, good = study.visibility, study.trials("identified")
    law, legs, n = study.plan.loop.law, observed_legs(study), len(good.runs.end)
    reasons = [wrong("servo.blind", legs, law=law, legs=legs)] if own.blind else []
    reasons += [
        wrong("servo.failures", number=count, of=n, end=end.sentence)
        for end, count in good.ends.items()
        if not end.good
    ]
    usable = not own.blind and good.reached / n >= NEARLY_ALL
    headline = (
        f"Control by the {law} of {legs} brings the platform to its goal in {good.reached} of"
        f" {n} runs with the identified geometry."
    )
    if not usable:
        why = (
            "these legs do not show every motion of the platform."
            if own.blind
            else f"{good.reached} of {n} runs reach the goal."
        )
        headline = f"Control by the {law} of {legs} should not be used: {why}"
    if usable:
        reasons = [replace(one, level=Level.DOUBTFUL) for one in reasons]
    findings = [*reasons, *_hidden(study), *_by_hand(study), *_noise(study)]
    if own.fading and not own.blind:
        fading = doubtful("servo.fading", legs, legs=legs, percent=100 * own.worst / own.usual)
        findings.insert(len(reasons), fading)
    if own.blind and law == "directions":  # which do not determine every motion
        findings.append(note("servo.by_edges"))
    return Verdict(usable, headline, tuple(findings))


def observed_legs(study: Study) -> str:
    """Observed legs as text: ``all legs``, ``legs 1, 3 and 5``."""
    return named(study.eye.true.legs.tolist(), study.scene.machine.n_legs)


def _hidden(study: Study) -> tuple[Finding, ...]:
    legs = [
        f"leg {j + 1} ({100 * part:.0f} %)"
        for j, part in zip(study.eye.true.legs, study.hidden, strict=True)
        if part > 1 - NEARLY_ALL
    ]
    if not legs:
        return ()
    return (doubtful("servo.hidden", legs=", ".join(legs)),)


def _by_hand(study: Study) -> Iterator[Finding]:
    """Findings on the hand-measured geometry: what calibration improves here."""
    hand, n = study.trials("hand"), study.plan.runs
    failed = n - hand.reached
    if failed > study.plan.runs - study.trials("identified").reached:
        worst = next(end for end in hand.ends if not end.good)
        yield doubtful("servo.by_hand_fails", number=failed, of=n, end=worst.what)
    good = hand.runs.reached
    off, own = (
        float(np.median(o.astray[o.runs.reached])) if o.reached else 0.0
        for o in (hand, study.trials("identified"))
    )
    if off > max(NEGLIGIBLE * float(np.median(hand.runs.travel[:, 0])), 2 * own):
        most = float(hand.astray[good].max())
        yield doubtful("servo.by_hand_astray", median=off, most=most, identified=own)
    over = float(hand.overshoot[good].max(initial=0.0))
    if over > max(
        ARRIVED_DISTANCE_SHARE, 2 * float(study.trials("identified").overshoot.max(initial=0.0))
    ):
        yield doubtful("servo.by_hand_overshoots", share=over)


def _noise(study: Study) -> tuple[Finding, ...]:
    direction = float(np.median(study.trials("true").runs.travel[:, 0]))
    held = rms(study.held.joints)
    if not direction > 0 or held < ARRIVED_DISTANCE_SHARE * direction:
        return ()
    return (doubtful("servo.noise", rms=held, law=study.plan.loop.law),)
