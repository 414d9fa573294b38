"""The page of a look at a calibrated machine: its tests as tables and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pkmcal.outcome import Figure, Row, Table
from pkmcal.report import charts, page
from pkmcal.watching.chances import POWER, ChiSquare
from pkmcal.watching.judged import LegTest, Suspect
from pkmcal.watching.words import cameras_of, said, signed
from pkmcal.wording import SCALES, brief, count, named, number

if TYPE_CHECKING:
    from pkmcal.watch import Watch

NONE = "–"
LARGE = 2.0
"""Standard deviations from which on a configuration's residuals stand out."""


def watch_html(w: Watch) -> str:
    """One HTML page that needs nothing else: no network, no other file."""
    return page.render(
        "watch.html.j2",
        w=w,
        verdict=w.verdict,
        stamp=stamp(w),
        cards=cards(w),
        legs=legs_table(w),
        others=others_table(w),
        findings=findings_table(w),
        pictures=[p for p in (statistics(w), zeros(w)) if p],
        residuals=[p for p in (by_configuration(w),) if p],
        left_out=[n for n, k in zip(w.session.configurations, w.known, strict=True) if k],
    )


def stamp(w: Watch) -> str:
    """The verdict in a word or three."""
    if w.verdict.usable:
        return "Still as calibrated"
    parts = {f.suspect.cause.part for f in w.judged.findings}
    return "Changed" if w.judged.changed and parts != {"camera"} else "Cannot be told"


def cards(w: Watch) -> tuple[Figure, ...]:
    """The main numbers."""
    judged = w.judged
    named_tests = [(named(leg.legs), leg.chance) for leg in judged.legs]
    named_tests += [("all legs together", judged.machine.adjusted)]
    seen = [(name, chance) for name, chance in named_tests if np.isfinite(chance)]
    who, least = min(seen, key=lambda item: item[1], default=("nothing", 1.0))
    out = [
        Figure(
            "How likely by chance alone?",
            ((chance_text(least), ""),),
            f"of {who}, the least of {count(len(judged.tests), 'test')},"
            f" their number allowed for; below {judged.alpha:g} counts as a change",
        )
    ]
    sizes = [leg for leg in judged.legs if leg.zero and leg.zero.dof]
    if sizes:
        unit = SCALES[sizes[0].unit]
        low, high = (f(leg.detects_zero for leg in sizes) * unit[0] for f in (min, max))
        out.append(
            Figure(
                "What would have been found?",
                ((brief(low) if low == high else f"{brief(low)} to {brief(high)}", unit[1]),),
                f"of the zero of a leg's reading, depending on the leg, with {POWER:.0%}"
                " probability",
            )
        )
    out.append(
        Figure(
            "What is it based on?",
            ((str(int(w.seen.sum())), "configurations"),),
            "seen by the session, not used by the calibration",
        )
    )
    return tuple(out)


def legs_table(w: Watch, brief: bool = False) -> Table:
    """One row a leg: statistics, chance, its zero's change, and what would have been found.

    brief : without the joints' columns, for a terminal.
    """
    rows = [
        Row(
            named(leg.legs).capitalize(),
            (
                _statistic(leg.whole),
                _statistic(leg.zero),
                chance_text(leg.chance),
                _zero(leg),
                _size(leg.detects_zero, leg.unit),
                *([] if brief else [_span(leg.detects_base), _span(leg.detects_platform)]),
            ),
        )
        for leg in w.judged.legs
    ]
    columns = ("Leg", "χ² / degrees", "of its zero", "chance", "zero off by", "found from")
    more = () if brief else ("base joint, mm", "platform joint, mm")
    return Table(
        "Legs",
        (*columns, *more),
        tuple(rows),
        "χ² of all numbers of a leg, and of the zero of its reading alone. Chance: of as much in a"
        " machine that did not change, all tests allowed for. Zero off by: if nothing else"
        " changed. Found from: the smallest change of that zero, and of the joints in the direction"
        f" seen best and worst, that has a {POWER:.0%} probability to be found. A leg that changed"
        " moves the tests of the others, too.",
    )


def others_table(w: Watch) -> Table:
    """Tests of all legs together."""
    j = w.judged
    scale = j.scale_change
    text = NONE
    if j.scale.dof:
        text = (
            f"{number(scale.value[0] * 1e6, 0, signed=True)} µm/m"
            f" (±{number(scale.sigma[0] * 1e6, 0)})"
        )
    rows = (
        Row("Every number of all legs", (*_cells(j.machine), "")),
        Row("All lengths by one factor", (*_cells(j.scale), text)),
    )
    return Table(
        "All legs together",
        ("Test", "χ²", "degrees", "chance", "change"),
        rows,
        "A common factor is seen against the readings: a frame that warmed, or readings of another"
        " scale.",
    )


def findings_table(w: Watch) -> Table | None:
    """What explains a change, best first, with what these data cannot tell from it."""
    rows: list[Row] = []
    cameras = cameras_of(w.session)
    for place, finding in enumerate(w.judged.findings, start=1):
        rows.append(_cause(f"{place}.", finding.suspect, cameras))
        rows += [_cause("or", other, cameras) for other in finding.others]
    if not rows:
        return None
    return Table(
        "What explains it",
        ("Cause", "χ² explained", "numbers"),
        tuple(rows),
        "Causes are compared by how likely they make the data, changes of a tolerance's size being"
        " usual; those that a hundred to one does not separate stand under the best with “or”.",
    )


def _cause(mark: str, suspect: Suspect, cameras: tuple[str, ...]) -> Row:
    text = said(suspect, cameras)
    return Row(f"{mark} {text}", (number(suspect.chi2, 1), str(len(suspect.cause.sizes))))


def chance_text(chance: float) -> str:
    """A probability with one or two digits, never zero."""
    if not np.isfinite(chance):
        return NONE
    if chance < 1e-4:
        return "< 0.0001"
    return f"{chance:.2g}" if chance < 0.995 else "1"


def _cells(test: ChiSquare) -> tuple[str, str, str]:
    told = (number(test.chi2, 1), chance_text(test.adjusted)) if test.dof else (NONE, NONE)
    return told[0], str(test.dof), told[1]


def _statistic(test: ChiSquare | None) -> str:
    return f"{number(test.chi2, 1)} / {test.dof}" if test is not None and test.dof else NONE


def _zero(leg: LegTest) -> str:
    if leg.change is None or leg.zero is None or not leg.zero.dof:
        return NONE
    return signed(float(leg.change.value[0]), float(leg.change.sigma[0]), leg.unit)


def _size(value: float, unit: str) -> str:
    if not np.isfinite(value):
        return NONE
    factor, name = SCALES[unit]
    return f"{brief(value * factor)}{'' if name == '°' else ' '}{name}"


def _span(sizes: tuple[float, float]) -> str:
    texts = [brief(v * 1e3) if np.isfinite(v) and v < 1 else NONE for v in sizes]
    return NONE if texts == [NONE, NONE] else " to ".join(texts)


def statistics(w: Watch) -> charts.BarChart | None:
    """Each leg's larger statistic, as a share of its threshold."""
    bars = [
        _bar(named(leg.legs), [t for t in (leg.whole, leg.zero) if t and t.dof], w.judged.level)
        for leg in w.judged.legs
        if leg.whole.dof
    ]
    return charts.bar_chart(
        "Each leg's χ² over its threshold",
        "the larger of both tests; 1: threshold",
        bars,
        tuple((k + 0.5, bar.label) for k, bar in enumerate(bars)),
        "Statistic of each leg as a share of its threshold",
        ((0.0, 1.0), (float(len(bars)), 1.0)),
    )


def _bar(label: str, tests: list[ChiSquare], level: float) -> charts.Bar:
    from scipy.special import chdtri

    limits = [float(chdtri(t.dof, level)) for t in tests]
    texts = [
        f"χ² {number(t.chi2, 1)} for {count(t.dof, 'degree')} of freedom,"
        f" threshold {number(limit, 1)}"
        for t, limit in zip(tests, limits, strict=True)
    ]
    share = max(t.chi2 / limit for t, limit in zip(tests, limits, strict=True))
    return charts.Bar(label, f"{label}: {'; '.join(texts)}", share, quiet=share < 1)


def zeros(w: Watch) -> charts.RowChart | None:
    """Changes of the readings' zeros: middle half and nine tenths of what they may be."""
    legs = [leg for leg in w.judged.legs if leg.change is not None and leg.zero and leg.zero.dof]
    if not legs or len({leg.unit for leg in legs}) > 1:
        return None
    factor, name = SCALES[legs[0].unit]
    boxes: list[charts.Box] = []
    for leg in legs:
        if leg.change is None or not np.isfinite(leg.change.sigma[0]):
            continue
        value, sigma = leg.change.value[0] * factor, leg.change.sigma[0] * factor
        at = value + sigma * np.array([-charts.NORMAL_90, -0.6745, 0.0, 0.6745, charts.NORMAL_90])
        q05, q25, q50, q75, q95 = (float(v) for v in at)
        tip = f"{named(leg.legs)}: {_zero(leg)}"
        boxes.append(charts.Box(named(leg.legs), tip, leg.legs[0] + 1, (q05, q25, q50, q75, q95)))
    return charts.row_chart(
        "The zero of each leg's reading, if nothing else changed",
        name,
        boxes,
        None,
        "Change of the zero of each leg's reading, middle half and nine tenths",
    )


def by_configuration(w: Watch) -> charts.BarChart | None:
    """Residuals of each configuration with the machine held, root mean square."""
    rows = np.flatnonzero(w.seen)
    values = [float(w.found.residuals[k]) for k in rows]
    names = [w.session.configurations[k] for k in rows]
    bars = [
        charts.Bar(
            name, f"{name}: {number(value, 2)} standard deviations", value, None, value < LARGE
        )
        for name, value in zip(names, values, strict=True)
        if np.isfinite(value)
    ]
    last = len(bars) - 1
    return charts.bar_chart(
        "Residuals by configuration, the machine held as calibrated",
        "standard deviations",
        bars,
        tuple((k + 0.5, bars[k].label) for k in sorted({0, last // 2, last}) if bars),
        f"Residuals of {count(len(bars), 'configuration')}",
        ((0.0, 1.0), (float(len(bars)), 1.0)),
    )
