"""Report sections on links between two configurations, one for each kind of link."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array, Booleans, rms
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import LinkSet
from pkmcal.measurements.contract import DISPLAY_UNITS, measurement_kinds
from pkmcal.outcome import Part, Row, Table
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import brief, capital, count, decimals, number


def sections(session: Session, every: Sequence[LinkSet], estimate: Estimate) -> tuple[Part, ...]:
    """Section for each kind of link.

    every : links of the estimate, one set for each kind.
    """
    out: list[Part] = []
    first = 0
    for links in every:
        # residuals and weights of all kinds are in one array, kind after kind
        mine = slice(first, first + len(links))
        first += len(links)
        if not len(links):
            continue
        kind = measurement_kinds()[links.kind]
        unit, factor = DISPLAY_UNITS[kind.unit]
        white, weight = estimate.link_residuals[mine], estimate.link_weights[mine]
        off = white * estimate.statistics.link_scale * links.sigma
        inliers = weight >= INLIER_WEIGHT
        n_rejected = "" if inliers.all() else f", {int(np.sum(~inliers))} rejected"
        joined = count(len(np.unique(links.configuration)), "configuration")
        times = number(rms(off[inliers] / links.sigma[inliers]), 2)
        text = (
            f"{count(len(links), kind.one)} between {joined}{n_rejected}. They are"
            f" {brief(rms(off[inliers]) * factor)} {unit} off the calibrated machine (root mean"
            f" square), which is {times} times their stated noise."
        )
        out.append(
            Part(
                kind.code,
                capital(kind.label),
                (text,),
                tables=(_table(session, links, off, white, inliers, unit, factor),),
            )
        )
    return tuple(out)


def weights(every: Sequence[LinkSet], estimate: Estimate) -> list[tuple[str, Array]]:
    """For each kind the name of one link, and the weights of all."""
    out: list[tuple[str, Array]] = []
    first = 0
    for links in every:
        one = measurement_kinds()[links.kind].one
        out.append((one, estimate.link_weights[first : first + len(links)]))
        first += len(links)
    return out


def _table(
    session: Session,
    links: LinkSet,
    off: Array,
    white: Array,
    inliers: Booleans,
    unit: str,
    factor: float,
) -> Table:
    """Table of the links, largest whitened residual first."""
    rows: list[Row] = []
    for k in np.argsort(-np.abs(white), kind="stable").tolist():
        first, second = (session.configurations[c] for c in links.configuration[k])
        digits = decimals(float(links.sigma[k]) * factor)
        cells = (
            second,
            number(float(links.value[k]) * factor, digits),
            number(float(links.value[k] + off[k]) * factor, digits),
            number(float(off[k]) * factor, digits),
            number(float(white[k]), 1),
            "used" if inliers[k] else "rejected",
        )
        rows.append(Row(first, cells))
    values = (f"Measured, {unit}", f"Calibrated, {unit}", f"Off, {unit}")
    columns = ("From", "To", *values, "In σ", "Use")
    title = "By the calibrated machine"
    return Table(title, columns, tuple(rows), brief=False, words=(1, 6))
