"""What is wrong with a control by the legs, in sentences; and whether it may be used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pkmcal.control.analysis import Subset
from pkmcal.control.study import Study, Trials
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, Level, doubtful, note, wrong
from pkmcal.wording import named

ENOUGH_REACHED_SHARE = 0.9
"""Part of the runs with the identified geometry that must reach their goal."""
UNMENTIONED_HIDDEN_SHARE = 0.05
"""Part of the poses at which a leg may stand behind another without a warning."""
UNMENTIONED_OVERSHOOT = 0.05
"""Part of the way by which a platform may pass its goal without a word."""
UNMENTIONED_DEVIATION = 0.01
"""Part of the way by which a platform may leave it without a word."""
UNMENTIONED_GOAL_NOISE = 0.02
"""Noise at the goal, as a part of the usual way, that deserves a word."""


def judgement(found: Study) -> Verdict:
    """The study in words."""
    own, good = found.own, found.outcome("identified")
    reasons = (*_blind(found), *_failures(good))
    share = good.reached / len(good.runs.end)
    usable = not own.blind and share >= ENOUGH_REACHED_SHARE
    law = found.plan.loop.law
    legs = chosen_legs(own, found)
    headline = (
        f"Control by the {law} of {legs} brings the platform to its goal in {good.reached} of"
        f" {len(good.runs.end)} runs with the identified geometry."
    )
    if not usable:
        why = (
            "these legs do not show every motion of the platform."
            if own.blind
            else f"{good.reached} of {len(good.runs.end)} runs reach the goal."
        )
        headline = f"Control by the {law} of {legs} should not be used: {why}"
    warnings = (*_fading(found), *_others(found), *_hidden(found), *_by_hand(found), *_noise(found))
    if usable:
        reasons = tuple(replace(one, level=Level.DOUBTFUL) for one in reasons)
    return Verdict(usable, headline, (*reasons, *warnings, *_advice(found)))


def chosen_legs(choice: Subset, found: Study) -> str:
    """``all legs``, ``legs 1, 3 and 5``."""
    return named(choice.legs, found.scene.machine.n_legs)


def _blind(found: Study) -> tuple[Finding, ...]:
    """Motions that are never seen."""
    if not found.own.blind:
        return ()
    law, legs = found.plan.loop.law, chosen_legs(found.own, found)
    return (wrong("servo.blind", legs, law=law, legs=legs),)


def _failures(outcome: Trials) -> tuple[Finding, ...]:
    """How runs failed, the most frequent first."""
    n = len(outcome.runs.end)
    return tuple(
        wrong("servo.failures", number=count, of=n, end=end.sentence)
        for end, count in outcome.ends.items()
        if not end.good
    )


def _fading(found: Study) -> tuple[Finding, ...]:
    own = found.own
    if own.blind or not own.fading:
        return ()
    legs = chosen_legs(own, found)
    return (doubtful("servo.fading", legs, legs=legs, percent=100 * own.worst / own.usual),)


def _others(found: Study) -> Iterator[Finding]:
    """Other equilibria."""
    equilibria, legs = found.equilibria, chosen_legs(found.own, found)
    for looks_alike, part in ((True, equilibria.alike), (False, equilibria.cancelled)):
        rows = equilibria.looks_alike == looks_alike
        if rows.any():
            yield doubtful(
                "servo.other_equilibrium",
                legs,
                legs=legs,
                share=part,
                why="alike" if looks_alike else "cancelled",
                distance=float(equilibria.distance[rows].min()),
                readings=float(equilibria.readings[rows].min()),
                units=found.scene.machine.joint_units[:1],
            )


def _hidden(found: Study) -> tuple[Finding, ...]:
    legs = [
        f"leg {j + 1} ({100 * part:.0f} %)"
        for j, part in zip(found.eye.true.legs, found.hidden, strict=True)
        if part > UNMENTIONED_HIDDEN_SHARE
    ]
    if not legs:
        return ()
    return (doubtful("servo.hidden", legs=", ".join(legs)),)


def _by_hand(found: Study) -> Iterator[Finding]:
    """What calibration is good for here."""
    hand, n = found.outcome("hand"), found.plan.runs
    failed = n - hand.reached
    if failed > found.plan.runs - found.outcome("identified").reached:
        worst = next(end for end in hand.ends if not end.good)
        yield doubtful("servo.by_hand_fails", number=failed, of=n, end=worst.what)
    good = hand.runs.reached
    off, own = (
        float(np.median(o.astray[o.runs.reached])) if o.reached else 0.0
        for o in (hand, found.outcome("identified"))
    )
    if off > max(UNMENTIONED_DEVIATION * float(np.median(hand.runs.way[:, 0])), 2 * own):
        most = float(hand.astray[good].max())
        yield doubtful("servo.by_hand_astray", median=off, most=most, identified=own)
    over = float(hand.overshoot[good].max(initial=0.0))
    if over > max(
        UNMENTIONED_OVERSHOOT, 2 * float(found.outcome("identified").overshoot.max(initial=0.0))
    ):
        yield doubtful("servo.by_hand_overshoots", share=over)


def _noise(found: Study) -> tuple[Finding, ...]:
    way = float(np.median(found.outcome("true").runs.way[:, 0]))
    held = float(np.sqrt(np.mean(found.held.joints**2)))
    if not way > 0 or held < UNMENTIONED_GOAL_NOISE * way:
        return ()
    return (doubtful("servo.noise", rms=held, law=found.plan.loop.law),)


def _advice(found: Study) -> Iterator[Finding]:
    """Which legs would do better, where something is wrong with those seen."""
    own = found.own
    if not (own.blind or own.fading or found.equilibria.alike + found.equilibria.cancelled > 0):
        return
    more = [c for c in found.choices if len(c.legs) == len(own.legs) + 1]
    more = [c for c in more if set(own.legs) < set(c.legs) and c.worst > 2 * own.worst]
    same = [c for c in found.choices if len(c.legs) == len(own.legs) and c.worst > 2 * own.worst]
    if more:
        best = max(more, key=lambda c: c.worst)
        extra = chosen_legs(Subset(tuple(set(best.legs) - set(own.legs)), 0, 0), found)
        yield note("servo.more_legs", extra, legs=extra, before=own.worst, after=best.worst)
    if same:
        legs = chosen_legs(same[0], found)
        yield note("servo.other_legs", legs, legs=legs, number=len(own.legs), worst=same[0].worst)
    if own.blind and not more and found.plan.loop.law == "directions":
        yield note("servo.by_edges")
