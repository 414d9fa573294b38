"""Findings about rejected heights, boards and images, and about results that depend on
rejections.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pkmcal.arrays import Integers
from pkmcal.identify.bed import bed_by_parameters
from pkmcal.identify.confirmation import RejectedUnit, rejected_units, rejections_of
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.tool import platform_by_parameters, platform_sigma
from pkmcal.identify.unidentified import Identification
from pkmcal.levels import NEARLY_ALL
from pkmcal.measurements import LinkSet, Measurements
from pkmcal.measurements.contract import measurement_kinds
from pkmcal.outcome.finding import Finding, doubtful, wrong
from pkmcal.session.image_files import label_of
from pkmcal.session.load import Session
from pkmcal.wording import count, listed

LEAST_CHECKED_SHARE = 1 - NEARLY_ALL
"""Smallest mean redundancy of the links (degrees of freedom per equation), below which there is a
warning: the unknowns then absorb nearly all of an outlier's square, and one of up to ``4.13 /
sqrt(0.1)``, thirteen, standard deviations is not detected (Baarda 1968)."""


def rejection_findings(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    identification: Identification,
    *,
    at_minimum: bool,
) -> Iterator[Finding]:
    """Warnings that name the rejected units of an estimate, and a refusal if the result depends on
    an unconfirmed rejection.

    at_minimum : whether the estimate is at the minimum of the joint problem, as hypotheses about it
        require.
    """
    units = rejected_units(measurements, estimate)
    statistics, labels = estimate.statistics, session.labels.get("links")
    if at_minimum and labels and statistics.dof_links < LEAST_CHECKED_SHARE * statistics.n_links:
        # they alone determine something, so that an outlier leaves hardly any residual
        yield doubtful("links.unchecked", listed(labels), names=labels)
    if not units:
        return
    edges = measurements.edges
    # rejected units by kind, and how many there are of each kind
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
    # effect of the rejections on the bed or, without one, on the platform
    if identification.bed:
        tool, sigma, what = bed_by_parameters(estimate), identification.bed.sigma, "the bed"
    else:
        used = estimate.state.T_base_platform[estimate.configurations]
        tool, sigma = platform_by_parameters(estimate.machine, used), platform_sigma(estimate)
        what = "the platform"
    value = rejections_of(measurements, estimate, tool)
    if value.shift > sigma:
        # name the units with more than the mean effect
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


def unused_configurations(
    session: Session, estimate: Estimate, held_out: Sequence[int] | Integers
) -> Iterator[Finding]:
    """Warning about configurations without any measurement, except those held out."""
    unused = ~estimate.configurations
    unused[np.asarray(held_out, dtype=int)] = False
    names = [session.configurations[k] for k in np.flatnonzero(unused)]
    if names:
        by = "images" if session.stations else "others"
        yield doubtful("configurations.unused", listed(names), names=names, by=by)


def _kind(session: Session, station: int) -> str:
    """Singular noun for the measured poses of a station."""
    tables = session.trackers[station - len(session.stations) :] if station >= len(
        session.stations) else ()  # fmt: skip
    return tables[0].target.one if tables else "board"


def _link_name(links: LinkSet) -> str:
    """Singular noun for the links of a set."""
    return measurement_kinds()[links.kind].one


def _kind_of(session: Session, measurements: Measurements, unit: RejectedUnit) -> str:
    """Singular noun for a unit."""
    if unit.link >= 0:
        return _link_name(measurements.link_at(unit.link)[0])
    return "image" if unit.is_image else _kind(session, unit.station)


def _name(session: Session, measurements: Measurements, unit: RejectedUnit) -> str:
    """Name of a unit: its image's file or, without one, its configuration; for a link both
    configurations.
    """
    if unit.link >= 0:
        links, k = measurements.link_at(unit.link)
        first, second = (session.configurations[c] for c in links.configuration[k])
        return f"{first} to {second}"
    if unit.station < len(session.stations):
        for photo in session.stations[unit.station].images:
            if photo.configuration == unit.configuration:
                return label_of(session.folder, photo.path)
    return session.configurations[unit.configuration]
