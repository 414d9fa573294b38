"""Findings about rejected heights, boards and images, and the effect of their rejection."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pkmcal.arrays import Integers
from pkmcal.identify.bed import bed_by_parameters
from pkmcal.identify.confirmation import RejectedUnit, rejected_units, rejections_of
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import platform_by_parameters, platform_sigma
from pkmcal.identify.unidentified import Findings
from pkmcal.measurements import LinkSet, Measurements
from pkmcal.measurements.contract import measurement_kinds
from pkmcal.outcome.finding import Finding, doubtful, wrong
from pkmcal.session.image_files import label_of
from pkmcal.session.load import Session
from pkmcal.wording import count, listed

LEAST_CHECKED_SHARE = 0.1
"""Mean degrees of freedom of a link's residual below which an error of up to ``4.13 / sqrt(0.1)``,
thirteen, of its standard deviations is undetected (Baarda 1968)."""


def rejection_findings(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    findings: Findings,
    *,
    at_minimum: bool,
) -> Iterator[Finding]:
    """Warnings that name the rejected units of an estimate, and a reason against the result where
    it depends on a rejection that nothing confirms.

    at_minimum : whether the estimate is the minimum of the joint problem, as one-step updates need.
    """
    units = rejected_units(measurements, estimate)
    if at_minimum:
        yield from _unchecked_links(measurements, estimate)
    if not units:
        return
    edges = measurements.edges
    kinds = np.array([_kind(session, k) for k in range(len(session.station_names))])
    every = kinds[measurements.poses.station].tolist() if len(measurements.poses) else []
    every += [name for links in measurements.links for name in [_link_name(links)] * len(links)]
    images = np.unique(np.stack([edges.station, edges.configuration]), axis=1).shape[1]
    for kind in dict.fromkeys(_kind_of(session, measurements, unit) for unit in units):
        mine = [unit for unit in units if _kind_of(session, measurements, unit) == kind]
        names = [_name(session, measurements, unit) for unit in mine]
        yield doubtful(
            "rejected.units",
            listed(names),
            kind=kind,
            number=len(names),
            of=count(images if kind == "image" else every.count(kind), kind),
            names=names,
        )
    if not at_minimum:
        return
    if findings.bed:
        tool, sigma, what = bed_by_parameters(estimate), findings.bed.sigma, "the bed"
    else:
        used = estimate.state.T_base_platform[estimate.configurations]
        tool, sigma = platform_by_parameters(estimate.machine, used), platform_sigma(estimate)
        what = "the platform"
    value = rejections_of(measurements, estimate, tool)
    if value.shift > sigma:
        worst = sorted(value.units, key=lambda unit: -unit.shift)
        share = [unit for unit in worst if unit.shift**2 * len(worst) >= value.shift**2]
        names = [
            f"{_kind_of(session, measurements, u)} {_name(session, measurements, u)}"
            for u in share or worst[:1]
        ]
        yield wrong(
            "rejected.unconfirmed",
            listed(names),
            names=names,
            what=what,
            tool_shift=value.shift,
            sigma=sigma,
        )


def _unchecked_links(measurements: Measurements, estimate: Estimate) -> Iterator[Finding]:
    """A warning about links that alone determine some parameters, so that an error has hardly any
    residual.
    """
    s = estimate.statistics
    if measurements.n_links and s.dof_links < LEAST_CHECKED_SHARE * s.n_links:
        labels = [measurement_kinds()[links.kind].label for links in measurements.links]
        yield doubtful("links.unchecked", listed(labels), names=labels)


def unused_configurations(
    session: Session, estimate: Estimate, held_out: Sequence[int] | Integers
) -> Iterator[Finding]:
    """A warning about configurations without measurements, except those held out."""
    unused = ~estimate.configurations
    unused[np.asarray(held_out, dtype=int)] = False
    names = [session.configurations[k] for k in np.flatnonzero(unused)]
    if names:
        by = "images" if session.stations else "others"
        yield doubtful("configurations.unused", listed(names), names=names, by=by)


def _kind(session: Session, station: int) -> str:
    """Name of one measured pose of a station."""
    tables = session.trackers[station - len(session.stations) :] if station >= len(
        session.stations) else ()  # fmt: skip
    return tables[0].target.one if tables else "board"


def _link_name(links: LinkSet) -> str:
    """Name of one of the links."""
    return measurement_kinds()[links.kind].one


def _kind_of(session: Session, measurements: Measurements, unit: RejectedUnit) -> str:
    if unit.link >= 0:
        return _link_name(measurements.link_at(unit.link)[0])
    return "image" if unit.is_image else _kind(session, unit.station)


def _name(session: Session, measurements: Measurements, unit: RejectedUnit) -> str:
    """Name of a unit: its image's file, else its configuration; both configurations of a link."""
    if unit.link >= 0:
        links, k = measurements.link_at(unit.link)
        first, second = (session.configurations[c] for c in links.configuration[k])
        return f"{first} to {second}"
    if unit.station < len(session.stations):
        for photo in session.stations[unit.station].photographs:
            if photo.configuration == unit.configuration:
                return label_of(session.folder, photo.path)
    return session.configurations[unit.configuration]
