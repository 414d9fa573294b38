"""Report section on what the data determine: rank and unidentifiable directions."""

from __future__ import annotations

import numpy as np

from pkmcal.identify.unidentified import Identification
from pkmcal.mechanisms import ParameterTable
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.plot import (
    BarsMark,
    Plot,
    Point,
    RuleMark,
    category_axis,
    log_axis,
    panels,
    rounded,
)
from pkmcal.outcome.blocks.table import Column, DataTable, TableRow
from pkmcal.outcome.blocks.text import Listing, Paragraph
from pkmcal.outcome.finding import Level
from pkmcal.report.parameters import grouped
from pkmcal.wording import brief, capital, count, joined

LEAST_BAR_INFORMATION = 1e-3
"""Information below which a bar is only a stub: the nominal model knows a thousand times more."""
STUB_INFORMATION = 1.15 * LEAST_BAR_INFORMATION
"""Value of a stub: visible, but not to be read."""
MOST_NAMES_LISTED = 6


def section(identification: Identification, table: ParameterTable) -> Part:
    """Section on the findings of a machine with these parameters."""
    listings = tuple(
        Listing(title=title, items=tuple(f"{one.text}\n{one.advice}" for one in sentences))
        for title, sentences in (
            ("Not determined by the data", identification.unidentified),
            ("Better known from the nominal model", identification.weak),
        )
        if sentences
    )
    held = " ".join(filter(None, (held_text(identification, table), tied(table))))
    return Part(
        "identifiability",
        "What the data determine",
        (
            f"{directions_headline(identification)} This is the rank of the data's own information"
            " with the nominal model left out, from exact derivatives.",
        ),
        blocks=(
            *panels(spectrum(identification)),
            *listings,
            *((Paragraph(text=held, small=True),) if held else ()),
            *((_conditions(identification),) if identification.conditions else ()),
        ),
        menu="Identifiability",
    )


def _conditions(identification: Identification) -> DataTable:
    """Table of [A]'s conditions."""
    rows = tuple(
        TableRow(
            cells=(
                one.equation, one.text, str(one.needed), str(one.available),
                "yes" if one.met else "no",
            ),
            values=(None, None, one.needed, one.available, None),
            mark="good" if one.met else Level.WRONG,
        )
        for one in identification.conditions
    )  # fmt: skip
    return DataTable(
        title="The paper's counts",
        columns=(
            Column(name="Equation", form="text"),
            Column(name="What is counted", form="text"),
            Column(name="Needed"),
            Column(name="There"),
            Column(name="Met", form="text"),
        ),
        rows=rows,
        note="Equations against unknowns as [A] counts them, for comparison: they are necessary at"
        " most, and count some equations twice. The rank above is the test.",
    )


def directions_headline(identification: Identification) -> str:
    """Number of directions that the data determine, in sentences."""
    ranks = identification.identifiability
    possible = ranks.n_parameters - ranks.n_frames
    frames = f"{ranks.n_parameters} free values less {ranks.n_frames} that only place the frames"
    lost = possible - ranks.rank
    start = f"The data determine {ranks.rank} of {possible} directions ({frames})."
    if lost == 0 and not ranks.weak:
        return f"{start} Each is determined better by the data than by the nominal model."
    parts: list[str] = []
    if lost:
        parts.append(f"no amount of such data would determine {count(lost, 'direction')}")
    if ranks.weak:
        verb = "is" if len(ranks.weak) == 1 else "are"
        parts.append(f"{count(len(ranks.weak), 'direction')} {verb} determined better by the prior")
    return f"{start} {capital(joined(parts))}."


def spectrum(identification: Identification) -> Plot | None:
    """Bars of the information in all directions, best known first, on a logarithmic scale."""
    information = np.asarray(identification.identifiability.singular_values, dtype=float)
    if information.size == 0:
        return None
    rank = identification.identifiability.rank
    bars: list[Point] = []
    for k, ratio in enumerate(information.tolist()):
        words = (
            "the data do not determine it"
            if k >= rank
            else f"the nominal model determines it {brief(1 / ratio)} times better"
            if ratio < 1
            else f"the data determine it {brief(ratio)} times better than the nominal model"
        )
        bars.append(
            Point(
                x=str(k + 1),
                y=rounded(max(ratio, STUB_INFORMATION)),
                tip=f"Direction {k + 1}: {words}",
                colour="quiet" if ratio >= 1 else None,
            )
        )
    return Plot(
        name="spectrum",
        title="How well each direction is known",
        caption="At the line, data and nominal model know as much.",
        alt=f"{len(bars)} directions; {rank} are fixed by the data and "
        f"{len(identification.identifiability.weak)} of those are known better by the nominal"
        " model",
        x=category_axis((str(bar.x) for bar in bars), "directions, best known first"),
        y=log_axis(
            "singular value, in tolerances",
            (LEAST_BAR_INFORMATION, 10.0, float(information.max())),
        ),
        marks=(
            BarsMark(name="", colour="calibrated", points=tuple(bars)),
            RuleMark(name="", axis="y", at=1.0),
        ),
    )


def held_text(identification: Identification, table: ParameterTable) -> str:
    """Sentences on the parameters that the mechanism file fixes; empty without any."""
    if not table.fixed:
        return ""
    names = [name for name in table.fixed if name in identification.conventional]
    if not names and not identification.also_conventional:
        verb, them = ("was", "it") if len(table.fixed) == 1 else ("were", "them")
        return (
            f"{_listed(table, table.fixed)} {verb} not estimated: the mechanism file lists {them}"
            " under fixed, so the nominal model's value counts as exact and no direction"
            " belongs to it."
        )
    # some fixed parameters only choose frames, or repeat free ones
    others = [name for name in table.fixed if name not in names]
    parts: list[str] = []
    if names:
        parts.append(
            f"{_listed(table, tuple(names))} {'is' if len(names) == 1 else 'are'} held by"
            " convention:"
            " any other value would only move a frame, or be made good by a value that is"
            " estimated, and the platform would be where it is."
        )
    if any(".platform." in name and name.endswith(".z") for name in names):
        parts.append(
            "Of the heights of base joints and platform only the sum counts: the camera and the "
            "board take up the rest."
        )
    if others:
        verb = "is" if len(others) == 1 else "are"
        parts.append(
            f"{_listed(table, tuple(others))} {verb} held by the model that the mechanism file"
            " describes: the nominal model's value counts as exact and no direction belongs to it."
        )
    if identification.also_conventional:
        parts.append(
            f"Of these, {count(identification.also_conventional, 'combination')} would only move a"
            " frame too, such as the heights of base joints and platform joints, of which with a"
            " camera and a board only the sum is determined."
        )
    return " ".join(parts)


def tied(table: ParameterTable) -> str:
    """Sentence on tied parameters; empty without any."""
    groups = [names for names in _tie_groups(table) if not names & set(table.fixed)]
    if not groups:
        return ""
    against = {name for names in table.opposed for name in names}
    order = [tuple(name for name in table.names if name in names) for names in groups]
    text = [
        joined(grouped(table, names)) + (" (by opposite amounts)" if against & set(names) else "")
        for names in order[:MOST_NAMES_LISTED]
    ]
    more = f" and {len(order) - MOST_NAMES_LISTED} more" if len(order) > MOST_NAMES_LISTED else ""
    return f"Changes together, as one value: {'; '.join(text)}{more}."


def _tie_groups(table: ParameterTable) -> list[set[str]]:
    """Groups of tied parameters; ties that share a name are merged."""
    out: list[set[str]] = []
    for names in table.tied:
        touching = [group for group in out if group & set(names)]
        out = [group for group in out if group not in touching]
        out.append(set(names).union(*touching))
    return out


def _listed(table: ParameterTable, names: tuple[str, ...]) -> str:
    """Names in words, at most ``MOST_NAMES_LISTED`` of them."""
    groups = grouped(table, names)
    words = groups[:MOST_NAMES_LISTED]
    if len(groups) > MOST_NAMES_LISTED:
        words.append(f"{len(groups) - MOST_NAMES_LISTED} more")
    return capital(joined(words))
