"""Sentences about unidentifiable directions: the motion, its effect on the platform, and advice."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.identify.motions import AXIS_LETTERS, NamedChanges, Situation, changes
from pkmcal.levels import NAMED_SHARE, NEGLIGIBLE, ROUNDING, TRANSLATION_TURN
from pkmcal.mechanisms.parameters import EVERY_LEG, ParameterTable
from pkmcal.wording import capital, in_full, joined, listed, named, split_name, ways

MOST_SENTENCES = 8
"""Largest number of sentences in a report."""
MOST_NAMES_IN_SENTENCE = 5
"""Largest number of parameters named in a sentence."""


@dataclass(frozen=True)
class Sentence:
    """One unidentified or weakly identified motion of the machine.

    text, advice : sentences for the user: the motion, and how to determine it.
    parameters : names of the parameters, the most affected first.
    dimensions : number of independent changes.
    moves_platform : root mean square displacement of the platform, over its joints and poses, by
        these changes as the prior allows them, m.
    matters : whether that displacement is more than negligible.
    weak : whether the data contain information on the motion, but less than the nominal model does.
    """

    text: str
    advice: str
    parameters: tuple[str, ...]
    dimensions: int
    moves_platform: float
    matters: bool
    weak: bool = False


def negligible_shift(table: ParameterTable) -> float:
    """Displacement of the platform (m) that is negligible beside the nominal model's uncertainty,
    and so beside any calibration's.
    """
    return NEGLIGIBLE * float(table.tolerance[table.of_kind("center")].mean())


@dataclass(frozen=True)
class OpenMotion:
    """A motion of one or more legs that the data do not determine.

    space : (k, P) changes that it explains, in prior sigmas.
    numbers : (n, m) coefficients of the motion for these changes, of one leg.
    own : (k, P) changes made by these coefficients, in prior sigmas; they differ from ``space`` by
        frame changes.
    new : number of the k changes that no earlier motion explains.
    """

    motion: NamedChanges
    legs: tuple[int, ...]
    space: Array
    numbers: Array
    own: Array
    new: int

    def how(self, around: Situation) -> str:
        """Words made from the motion's own coefficients."""
        return self.motion.how(around, self.numbers) if self.motion.how else ""

    def and_of(self, other: OpenMotion) -> OpenMotion:
        """Merge with the same motion of other legs, or with another part of it for these legs."""
        again = self.legs == other.legs
        return replace(
            self,
            legs=tuple(sorted({*self.legs, *other.legs})),
            space=np.concatenate([self.space, other.space]),
            numbers=np.concatenate([self.numbers, other.numbers]) if again else self.numbers,
            own=np.concatenate([self.own, other.own]),
            new=self.new + other.new,
        )


def sentence(
    around: Situation, open_motion: OpenMotion, unit: Array, shifted: float, weak: bool
) -> Sentence:
    """Sentence of a motion.

    unit : (P,) prior sigmas of the parameters.
    shifted : displacement of the platform's joints, m.
    weak : whether the data contain information on the motion, but less than the nominal model does.
    """
    table = around.machine.parameters
    matters = shifted > negligible_shift(table)
    # parameters that change most
    size = np.linalg.norm(open_motion.own, axis=0)
    order = np.argsort(-np.round(size, 6), kind="stable")
    rows = order[: int(np.sum(size > NAMED_SHARE * size.max()))]
    names = tuple(table.names[k] for k in rows)
    several = len(open_motion.legs) > 1
    statement, n = (
        "known from the nominal model only" if weak else "free",
        len(open_motion.numbers),
    )
    open_ = f"{'is' if n == 1 else 'are'} {statement}"
    # fields of the motion's template
    places = {
        "legs": named(open_motion.legs),
        "each": "each of " if several else "",
        "is": f"is {statement}",
        "are": f"are {statement}",
        "open": "to the nominal model" if weak else "free",
        "better": " better than the nominal model does" if weak else "",
        "limited": ", which only the nominal model limits" if weak else "",
        "n": in_full(n),
        "combinations": f"{in_full(n)} combination{'' if n == 1 else 's'}"
        f"{' each' if several and len(open_motion.motion.legs) == 1 else ''} {open_}",
        "ways": ways(len(open_motion.space)),
        "mostly": _mostly(around, open_motion, rows, unit),
        "how": open_motion.how(around),
    }
    text = open_motion.motion.words(len(open_motion.legs)).format_map(places)
    # effect on the platform
    how_far = "This does not move the platform."
    if matters:
        how_far = (
            f"Within the nominal model's tolerances this moves the platform by {shifted * 1e3:.2g}"
            " mm (rms of its joints over these and nearby poses; what moves all poses alike, as"
            " other frames do, is not counted)."
        )
    return Sentence(
        f"{capital(text)}. {how_far}",
        advice_on(around, open_motion, names, matters, weak),
        names,
        open_motion.new,
        shifted,
        matters,
        weak,
    )


def _mostly(around: Situation, open_motion: OpenMotion, rows: Integers, unit: Array) -> str:
    """``: +1 mm of a goes with −0.7 mm of b`` for a single change; else the parameters.

    rows : parameters that change most.
    unit : (P,) prior sigmas.
    """
    table, single = around.machine.parameters, len(open_motion.space) == 1
    if open_motion.motion.labels:
        if not single:
            return f" {ways(len(open_motion.numbers))}" if len(open_motion.numbers) > 1 else ""
        text, _ = changes(open_motion.numbers[0], open_motion.motion.labels)
    else:
        if len({table.labels[k] for k in rows}) == 1 and len(rows) > 1:
            what = [f"leg {split_name(table.names[k])[0]}" for k in rows]
        else:
            what = [table.in_words(table.names[k]) for k in rows]
        if not single:
            return f", mostly of {listed(what, MOST_NAMES_IN_SENTENCE)}"
        labels = tuple((w, table.units[k]) for w, k in zip(what, rows, strict=True))
        text, _ = changes((open_motion.own[0] * unit)[rows], labels)
    return f": {text[0]} goes with {joined(text[1:])}" if len(text) > 1 else ""


def few(sentences: list[Sentence]) -> tuple[Sentence, ...]:
    """At most ``MOST_SENTENCES`` sentences; the last one stands for all less important ones, with
    their number.
    """
    if len(sentences) <= MOST_SENTENCES:
        return tuple(sentences)
    ranked = sorted(sentences, key=lambda s: -s.moves_platform)
    retained = [s for s in sentences if s in ranked[: MOST_SENTENCES - 1]]
    rest = ranked[MOST_SENTENCES - 1 :]
    last = replace(
        rest[0],
        text=f"And {len(rest)} more of this kind. {rest[0].text}",
        parameters=tuple(dict.fromkeys(name for s in rest for name in s.parameters)),
        dimensions=sum(s.dimensions for s in rest),
        moves_platform=float(np.sqrt(sum(s.moves_platform**2 for s in rest))),
    )
    return (*retained, last)


# ------------------------------------------------------------------ what to do


def advice_on(
    around: Situation, open_motion: OpenMotion, names: tuple[str, ...], matters: bool, weak: bool
) -> str:
    """Advice on a motion that changes these parameters."""
    held = _fixing(around, _enough(around, open_motion.motion, names))
    if not matters:
        return f"Nothing needs to be done; {held} silences this."
    legs = open_motion.legs
    more, take = _more(around, legs), "Take images of" if around.imaged else "Measure"
    caliper = f"Measure the tubes of {named(legs)} with a caliper"
    do = {
        "more": more,
        "photograph": f"Take images of {named(legs)}, from another station if need be",
        "tie": _tying(around, legs),
        "caliper": f"{caliper} and give a small tolerance.radius",
        "more or caliper": f"{more}; or measure the tubes with a caliper",
        "turn": f"{take} configurations that turn these joints further, to both sides",
        "size": _sizing(around),
        "drawing": "Legs look the same however these axes lie: leave them to the nominal model",
    }[open_motion.motion.advice]
    decide = f"{held} if the nominal model is sure of that"
    if weak:
        decide = "state smaller tolerances in the mechanism file if the nominal model warrants them"
    return f"{do}; or {decide}."


def _sizing(around: Situation) -> str:
    """Advice on measurements that determine the size of everything."""
    if not around.imaged:
        return (
            "Measure distances between positions of the tool (distances), which determine the size"
        )
    board = (
        "Observe a board with the legs (observe: [legs, board]), whose squares determine the size"
    )
    if "m" not in around.machine.joint_units:
        return board
    return f"{board}, or check the readings over a long way against a measure"


def _tying(around: Situation, legs: tuple[int, ...]) -> str:
    """Advice on measurements that join a group of legs to the others."""
    others = [j for j in around.legs if j not in legs]
    with_group = np.any(around.observed[around.observed[:, list(legs)].any(axis=1)], axis=0)
    apart = [j for j in others if not with_group[j]]
    return (
        f"Add a station that sees {named(legs)} together with {named(apart or others)}; or let a"
        " board fixed to the base be seen with the legs (observe: [legs, board], board: {fixed_to:"
        " base})"
    )


def _more(around: Situation, legs: tuple[int, ...]) -> str:
    """Advice on missing configurations."""
    if around.heights:  # more heights of the same bed would not help
        return "Measure x and y too, by a board on the platform (observe: board) or a tracker"
    take, poses = "Take images of" if around.imaged else "Measure", around.T_base_platform
    those = named(legs) if len(legs) < len(around.legs) else "all legs"
    elsewhere = f"{those} {'points' if len(legs) == 1 else 'point'} elsewhere"
    if len(poses) == 1:
        return f"{take} more configurations, so that {elsewhere} too"
    turn = rotation_vector(poses[:, :3, :3] @ poses[0, :3, :3].T)
    if around.machine.layout.motion[:3].any() and np.abs(turn).max() < TRANSLATION_TURN:
        return f"Turn the platform in some configurations, so that {elsewhere}"
    what = "lengths" if around.machine.layout.rod_reads.any() else "readings"
    return f"{take} configurations in which {elsewhere}, with {what} near both ends of their range"


def _enough(around: Situation, motion: NamedChanges, names: tuple[str, ...]) -> tuple[str, ...]:
    """Parameters that are sufficient to fix.

    For a convention one axis, or one end of legs of which only the difference is identifiable.
    """
    if not motion.convention:
        return names
    table = around.machine.parameters
    axes = [n for n in sorted(names) if ".axis." in n]
    axes = [n for n in axes if abs(table.nominal[table.index(n)]) < ROUNDING]
    return tuple(axes[:1]) or tuple(n for n in names if ".platform." in n) or names


def _fixing(around: Situation, names: tuple[str, ...]) -> str:
    """Line of the mechanism file that fixes parameters, in addition to those that it fixes already.

    An axis is fixed as a whole; a centre as a whole if all of its coordinates are listed, and all
    legs at once if all legs with that parameter are listed.
    """
    table = around.machine.parameters
    entries: dict[str, None] = {}
    for name in sorted(names, key=table.index):
        whole, _, component = name.rpartition(".")
        every = component in AXIS_LETTERS and all(f"{whole}.{c}" in names for c in AXIS_LETTERS)
        axis = ".axis." in name and len(names) > 1
        entries[whole if every or axis else name] = None
    texts: dict[str, None] = {}
    legs = dict.fromkeys(n.partition("]")[0] for n in table.names)
    # names and all groups of them: legs[1].base.center.x, legs[1].base.center, legs[1].base ...
    groups = {n[: dot.start()] for n in table.names for dot in re.finditer(r"\.|$", n)}
    for entry in entries:
        rest = entry.partition("]")[2]
        having = [f"{leg}]{rest}" for leg in legs if f"{leg}]{rest}" in groups]
        same = len(having) > 1 and all(other in entries for other in having)
        texts[f"{EVERY_LEG}{rest}" if same else entry] = None
    line = ", ".join(json.dumps(entry) for entry in texts)
    where = "in the mechanism file"
    if around.machine.model is not None:  # the file's own entries do not hold then
        where += f"'s model {around.machine.model}"
    if around.machine.document.fixed:
        return f"{line} beside what stands under fixed: {where}"
    return f"fixed: [{line}] {where}"
