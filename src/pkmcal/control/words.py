"""What is wrong with a control by the legs, in sentences; and whether it may be used."""

from __future__ import annotations

import numpy as np

from pkmcal.control.analysis import Subset
from pkmcal.control.study import Study, Trials
from pkmcal.outcome import Verdict
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
        return Verdict(usable, headline, (), (*reasons, *warnings), _advice(found))
    return Verdict(usable, headline, reasons, warnings, _advice(found))


def chosen_legs(choice: Subset, found: Study) -> str:
    """``all legs``, ``legs 1, 3 and 5``."""
    return named(choice.legs, found.scene.machine.n_legs)


def _blind(found: Study) -> tuple[str, ...]:
    """Motions that are never seen."""
    if not found.own.blind:
        return ()
    return (
        f"The {found.plan.loop.law} of {chosen_legs(found.own, found)} stay the same under some"
        " motion of the platform, at every pose; the control leaves that motion alone.",
    )


def _failures(outcome: Trials) -> tuple[str, ...]:
    """How runs failed, the most frequent first."""
    n = len(outcome.runs.end)
    return tuple(f"In {count} of {n} runs: {end.sentence}" for end, count in outcome.ends.items()
                 if not end.good)  # fmt: skip


def _fading(found: Study) -> tuple[str, ...]:
    own = found.own
    if own.blind or not own.fading:
        return ()
    part = own.worst / own.usual
    return (
        f"There are poses in the workspace at which {chosen_legs(own, found)} hardly show some"
        f" motion of the platform (visibility falls to {100 * part:.1g} % of its usual value):"
        " near them the control is singular, and beyond them it may come to rest at another pose.",
    )


def _others(found: Study) -> tuple[str, ...]:
    """Other equilibria."""
    found_, text = found.equilibria, list[str]()
    legs = chosen_legs(found.own, found)
    for flag, part, what in (
        (True, found_.alike, f"{legs} look exactly as at the goal"),
        (False, found_.cancelled, f"the errors of {legs} cancel"),
    ):
        rows = found_.looks_alike == flag
        if not rows.any():
            continue
        nearest = 1e3 * float(found_.distance[rows].min())
        reading = float(found_.readings[rows].min())
        unit = found.scene.machine.joint_units[0]
        apart = f"{1e3 * reading:.2g} mm" if unit == "m" else f"{np.rad2deg(reading):.2g}°"
        text.append(
            f"The goal is not the only pose at which the control can rest: from {100 * part:.0f} %"
            f" of the starts tried it ends where {what}; the nearest such pose is {nearest:.2g} mm"
            f" away (mean of the platform's joints), its readings differ by {apart}."
        )
    return tuple(text)


def _hidden(found: Study) -> tuple[str, ...]:
    legs = [
        f"leg {j + 1} ({100 * part:.0f} %)"
        for j, part in zip(found.eye.true.legs, found.hidden, strict=True)
        if part > UNMENTIONED_HIDDEN_SHARE
    ]
    if not legs:
        return ()
    return (
        "The simulation measures every leg in the picture, but some stand behind others at a part"
        f" of the poses: {', '.join(legs)}. Put the camera elsewhere, or leave them out with"
        " --legs.",
    )


def _by_hand(found: Study) -> tuple[str, ...]:
    """What calibration is good for here."""
    hand, n = found.outcome("hand"), found.plan.runs
    text: list[str] = []
    failed = n - hand.reached
    if failed > found.plan.runs - found.outcome("identified").reached:
        worst = next(end for end in hand.ends if not end.good)
        text.append(
            f"With the camera's place by hand {failed} of {n} runs fail; most often {worst.what}."
        )
    good = hand.runs.reached
    off, own = (
        float(np.median(o.astray[o.runs.reached])) if o.reached else 0.0
        for o in (hand, found.outcome("identified"))
    )
    if off > max(UNMENTIONED_DEVIATION * float(np.median(hand.runs.way[:, 0])), 2 * own):
        text.append(
            "With the camera's place by hand the platform gets there beside its way, by"
            f" {1e3 * off:.2g} mm in half of the runs and up to"
            f" {1e3 * float(hand.astray[good].max()):.2g} mm; identified, by {1e3 * own:.2g} mm."
        )
    over = float(hand.overshoot[good].max(initial=0.0))
    if over > max(
        UNMENTIONED_OVERSHOOT, 2 * float(found.outcome("identified").overshoot.max(initial=0.0))
    ):
        text.append(
            f"With the camera's place by hand the platform passes its goal by up to"
            f" {100 * over:.0f} % of its way."
        )
    return tuple(text)


def _noise(found: Study) -> tuple[str, ...]:
    way = float(np.median(found.outcome("true").runs.way[:, 0]))
    held = float(np.sqrt(np.mean(found.held.joints**2)))
    if not way > 0 or held < UNMENTIONED_GOAL_NOISE * way:
        return ()
    better = " The edges hold it steadier." if found.plan.loop.law == "directions" else ""
    return (
        f"Noise keeps the platform in motion by {1e3 * held:.2g} mm (root mean square) at its"
        f" goal.{better}",
    )


def _advice(found: Study) -> tuple[str, ...]:
    """Which legs would do better, where something is wrong with those seen."""
    own = found.own
    wrong = own.blind or own.fading or found.equilibria.alike + found.equilibria.cancelled > 0
    if not wrong:
        return ()
    more = [c for c in found.choices if len(c.legs) == len(own.legs) + 1]
    more = [c for c in more if set(own.legs) < set(c.legs) and c.worst > 2 * own.worst]
    same = [c for c in found.choices if len(c.legs) == len(own.legs) and c.worst > 2 * own.worst]
    text: list[str] = []
    if more:
        best = max(more, key=lambda c: c.worst)
        extra = chosen_legs(Subset(tuple(set(best.legs) - set(own.legs)), 0, 0), found)
        text.append(
            f"Let the camera see {extra} as well: visibility at the worst pose rises from"
            f" {own.worst:.2g} to {best.worst:.2g}."
        )
    if same:
        text.append(
            f"Of {len(own.legs)} legs, {chosen_legs(same[0], found)} show the motions best"
            f" (visibility at the worst pose {same[0].worst:.2g})."
        )
    if own.blind and not more and found.plan.loop.law == "directions":
        text.append("Control by edges: they tell where a leg is, and not only how it points.")
    return tuple(text)
