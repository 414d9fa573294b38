"""Rejected heights, boards and images by name, and what the result may owe to their rejection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Integers
from pkmcal.identify.bed import bed_by_parameters
from pkmcal.identify.confirmation import RejectedUnit, Rejections, rejected_units, rejections_of
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import platform_by_parameters, platform_sigma
from pkmcal.identify.unidentified import Findings
from pkmcal.measurements import LinkSet, Measurements
from pkmcal.measurements.contract import measurement_kinds
from pkmcal.session.load import Session
from pkmcal.session.photographs import label_of
from pkmcal.wording import count, listed

LEAST_CHECKED_SHARE = 0.1
"""Degrees of freedom that a link leaves on average, below which a wrong one goes unnoticed up to
``4.13 / sqrt(0.1)``, thirteen, of its standard deviations (Baarda 1968)."""
MOST_UNITS_NAMED = 6
"""Units that a sentence names; the report and calibration.json have all."""


@dataclass(frozen=True)
class RejectionWords:
    """Sentences on rejected units: reasons against the result, and warnings that name them."""

    reasons: tuple[str, ...]
    warnings: tuple[str, ...]


def rejections_in_words(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    findings: Findings,
    *,
    at_minimum: bool,
) -> RejectionWords:
    """What is to be said of the rejected units of an estimate.

    at_minimum : whether the estimate is the joint problem's best, as hypotheses about it need.
    """
    units = rejected_units(measurements, estimate)
    unchecked = _unchecked_links(measurements, estimate) if at_minimum else ()
    if not units:
        return RejectionWords((), unchecked)
    warnings = tuple(_naming_sentences(session, measurements, units))
    if not at_minimum:
        return RejectionWords((), warnings)
    warnings += unchecked
    if findings.bed:
        tool, sigma, what = bed_by_parameters(estimate), findings.bed.sigma, "the bed"
    else:
        used = estimate.state.T_base_platform[estimate.configurations]
        tool, sigma = platform_by_parameters(estimate.machine, used), platform_sigma(estimate)
        what = "the platform"
    found = rejections_of(measurements, estimate, tool)
    if found.shift <= sigma:
        return RejectionWords((), warnings)
    return RejectionWords((_doubt_sentence(session, measurements, found, sigma, what),), warnings)


def _unchecked_links(measurements: Measurements, estimate: Estimate) -> tuple[str, ...]:
    """A sentence on links that determine what no other measurement does, so that a wrong one leaves
    hardly any residual.
    """
    s = estimate.statistics
    if not measurements.n_links or s.dof_links >= LEAST_CHECKED_SHARE * s.n_links:
        return ()
    kinds = [measurement_kinds()[links.kind] for links in measurements.links]
    labels = listed([kind.label for kind in kinds])
    return (
        f"Nothing would show that one of the {labels} is wrong: they determine what no other"
        " measurement does. Measure each of them again, or more of them.",
    )


def unused_configurations(
    session: Session, estimate: Estimate, held_out: Sequence[int] | Integers
) -> tuple[str, ...]:
    """A sentence on the configurations of which nothing was measured, but for those held out."""
    unused = ~estimate.configurations
    unused[np.asarray(held_out, dtype=int)] = False
    names = [session.configurations[k] for k in np.flatnonzero(unused)]
    if not names:
        return ()
    had = "had no usable photograph" if session.stations else "had nothing measured"
    return (
        f"{count(len(names), 'configuration')} {had} and did not take part:"
        f" {listed(names, MOST_UNITS_NAMED)}.",
    )


def _naming_sentences(
    session: Session, measurements: Measurements, units: Sequence[RejectedUnit]
) -> list[str]:
    """A sentence for each kind of unit: how many of how many were rejected, and which."""
    edges = measurements.edges
    kinds = np.array([_kind(session, k) for k in range(len(session.station_names))])
    every = kinds[measurements.poses.station].tolist() if len(measurements.poses) else []
    every += [name for links in measurements.links for name in [_link_name(links)] * len(links)]
    images = np.unique(np.stack([edges.station, edges.configuration]), axis=1).shape[1]
    out: list[str] = []
    for kind in dict.fromkeys(_kind_of(session, measurements, unit) for unit in units):
        mine = [unit for unit in units if _kind_of(session, measurements, unit) == kind]
        number = images if kind == "image" else every.count(kind)
        names = listed([_name(session, measurements, unit) for unit in mine], MOST_UNITS_NAMED)
        were = "was" if len(mine) == 1 else "were"
        out.append(
            f"{len(mine)} of {count(number, kind)} {were} rejected, for the others put"
            f" {'it' if len(mine) == 1 else 'them'} elsewhere: {names}."
        )
    return out


def _doubt_sentence(
    session: Session, measurements: Measurements, found: Rejections, sigma: float, what: str
) -> str:
    """Why a result is not to be used that rests on a rejection."""
    worst = sorted(found.units, key=lambda unit: -unit.shift)
    share = [unit for unit in worst if unit.shift**2 * len(worst) >= found.shift**2]
    names = listed(
        [
            f"{_kind_of(session, measurements, u)} {_name(session, measurements, u)}"
            for u in share or worst[:1]
        ]
    )
    one = len(share) < 2
    return (
        f"The other measurements do not confirm that {names} {'is' if one else 'are'} wrong: if"
        f" {'it is' if one else 'they are'} right, or another one is wrong in"
        f" {'its' if one else 'their'} place, {what} is {found.shift * 1e3:.2g} mm elsewhere, and"
        f" the result's own standard deviation is {sigma * 1e3:.2g} mm. Measure"
        f" {'it' if one else 'these'} again, and more configurations; if"
        f" {'it stays' if one else 'they stay'}, the drawing's tolerances are too small."
    )


def _kind(session: Session, station: int) -> str:
    """What a station's measured poses are called."""
    tables = session.trackers[station - len(session.stations) :] if station >= len(
        session.stations) else ()  # fmt: skip
    return tables[0].target.one if tables else "board"


def _link_name(links: LinkSet) -> str:
    """What one of the links is called."""
    return measurement_kinds()[links.kind].one


def _kind_of(session: Session, measurements: Measurements, unit: RejectedUnit) -> str:
    if unit.link >= 0:
        return _link_name(measurements.link_at(unit.link)[0])
    return "image" if unit.is_image else _kind(session, unit.station)


def _name(session: Session, measurements: Measurements, unit: RejectedUnit) -> str:
    """A unit by its image's file, or by its configuration where there is none, a link by both."""
    if unit.link >= 0:
        links, k = measurements.link_at(unit.link)
        first, second = (session.configurations[c] for c in links.configuration[k])
        return f"{first} to {second}"
    if unit.station < len(session.stations):
        for photo in session.stations[unit.station].photographs:
            if photo.configuration == unit.configuration:
                return label_of(session.folder, photo.path)
    return session.configurations[unit.configuration]
