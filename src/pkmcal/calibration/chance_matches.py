"""Test of measured edges against chance matches.

Some image edge is within reach of any predicted edge. If a machine is localized that is not in the
images, a tenth of its edges are matched by chance, and the joint estimate reconciles these, with
large standard deviations. If few of the visible edges were measured, they are measured again with
the images shifted, in several directions: no leg is then at its predicted position, so all matches
are by chance. This is an absolute test, which a likelihood ratio between explanations cannot
replace. Its level is that of the localization: the probability with which a wrong pose is accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.case import Case
from pkmcal.calibration.localization import locate_stations, mistake_in
from pkmcal.calibration.refinement import RefinementResult
from pkmcal.errors import InputError
from pkmcal.levels import FEW
from pkmcal.observe import legs
from pkmcal.observe.image_batches import placed_at
from pkmcal.observe.repeats import combine_repeats
from pkmcal.observe.station_localization import LOCALIZATION_OPTIONS
from pkmcal.outcome.finding import Finding, wrong
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS, Explanation
from pkmcal.session.load import Session
from pkmcal.wording import how_often

IMAGE_OFFSET = 2 * legs.LEG_SEARCH_OPTIONS.reach
"""Shift of the images, px: further than legs are searched."""
OFFSET_DIRECTIONS = 8
"""Number of directions of the shift, evenly spaced; the p-value is that of one more draw."""


def explain_chance_matches(case: Case, turns: RefinementResult | None, seed: int) -> Explanation:
    """Mistake that explains the images of stations on tripods whose edges may be chance matches.

    The localization of such stations may be wrong, so their images are compared with the hypotheses
    as those of stations that were not localized.

    turns : None without an estimate, if there were too few edges.
    seed : for the search.
    """
    session = case.session
    images = [p for p in case.images if not session.stations[p.station].handheld]
    if not images or (turns is not None and not chance_match_reason(turns)):
        return Explanation()
    # another draw than the first search, which may find the mistake by itself
    (rng,) = np.random.default_rng(seed).spawn(1)
    search = locate_stations(session, images, case.boards, rng)
    error = search.error
    if error is None and (value := search.leg_localization) is not None:
        unconfirmed = tuple(replace(pose, p_value=1.0) for pose in value.localizations)
        error = mistake_in(session, images, replace(value, localizations=unconfirmed), rng)
    # that a station was not localized is in the verdict, and the report shows why
    if not isinstance(error, InputError) or error.code == "station.not_recognised":
        return Explanation()
    return Explanation(error, HYPOTHESIS_THRESHOLDS.report)


class _Offered(NamedTuple):
    """Numbers of edges of some stations: visible, measured, and expected by chance; and the p-value
    of the number measured.
    """

    in_sight: int
    measured: int
    expected: float
    p_value: float


def chance_match_reason(turns: RefinementResult) -> tuple[Finding, ...]:
    """Reason against a result whose edges may be chance matches; tested only where less than a
    third of the edges in sight were measured.
    """
    offered = _offered(turns, [p.station for p in turns.images])
    if offered is None:
        return ()
    return (
        wrong(
            "edges.by_chance",
            in_sight=offered.in_sight,
            measured=offered.measured,
            aside=offered.expected,
            distance=IMAGE_OFFSET,
            chance=offered.p_value,
        ),
    )


def misplaced_stations(session: Session, turns: RefinementResult) -> dict[int, str]:
    """Reasons why stations on a tripod may have a wrong pose, by station number: their edges may be
    chance matches.

    Empty if that applies to all stations. One search of a thousand is confirmed at a wrong pose,
    and little is lost with a station in which the machine is hardly visible. Stations that observe
    a board on the base have their pose from the board.
    """
    boards = set(turns.measurements.poses.station.tolist())
    reasons: dict[int, str] = {}
    for k in (p.station for p in turns.images):
        station = session.stations[k]
        if station.handheld or k in boards:
            continue
        if (offered := _offered(turns, [k])) is not None:
            advice = "" if station.T_camera_base is not None else "; a pose by hand would decide"
            reasons[k] = (
                f"only {offered.measured} of {offered.in_sight} edges in sight were measured where"
                f" the machine has them, and chance offers as many {how_often(offered.p_value)}: it"
                f" may stand elsewhere{advice}"
            )
    return reasons if len(reasons) < len(turns.images) else {}


def _offered(turns: RefinementResult, stations: Sequence[int]) -> _Offered | None:
    """Edges of some stations that may be chance matches.

    None if at least a third of the visible edges were measured, or significantly more than by
    chance.
    """
    in_view = turns.observation
    edges = in_view.edges.select(np.isin(in_view.edges.station, stations))
    measured = int(np.sum(~edges.coarse))
    # a measured edge may be among the rejections as well: rejected by the estimate, or in one of
    # several repeats
    columns = edges.station, edges.configuration, edges.leg, edges.tube, edges.side
    visible = set(zip(*(column.tolist() for column in columns), strict=True)) | {
        (r.station, r.configuration, r.leg, r.tube, r.side)
        for r in in_view.rejected
        if r.side >= 0 and r.code != "edges.out_of_sight" and r.station in stations
    }
    in_sight = len(visible)
    if not turns.images or measured >= FEW * in_sight:
        return None
    angle = 2 * np.pi * np.arange(OFFSET_DIRECTIONS) / OFFSET_DIRECTIONS
    lateral = IMAGE_OFFSET * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    counts = np.array([_count(turns, stations, away) for away in lateral])
    chance = chance_of_count(_count(turns, stations, np.zeros(2)), counts)
    surely = chance < LOCALIZATION_OPTIONS.false_alarm
    return None if surely else _Offered(in_sight, measured, float(counts.mean()), chance)


def chance_of_count(own: int, counts: Array) -> float:
    """P-value of a number of edges under chance matches, from the counts (n,) in shifted images."""
    from scipy.special import stdtr

    mean = float(counts.mean())
    # at least the scatter of a Poisson distribution: that of eight counts may be smaller by chance
    spread = max(float(counts.std(ddof=1)), np.sqrt(mean), 1.0)
    apart = (own - mean) / (spread * np.sqrt(1 + 1 / len(counts)))
    return float(stdtr(len(counts) - 1, -apart))


def _count(turns: RefinementResult, stations: Sequence[int], offset: Array) -> int:
    """Number of edges measured from some stations with the images shifted by ``offset`` (2,), in
    binned pixels.
    """
    state = turns.estimate.state
    shifted = [
        replace(p, camera=p.camera.shifted(p.binning * offset))
        for p in turns.images
        if p.station in stations
    ]
    placed = placed_at(shifted, state.T_camera_base, state.T_base_platform)
    passes = legs.measure_stations(placed, turns.estimate.machine, turns.blur)
    return sum(
        len(combine_repeats(station_edges).edges) for station_edges in passes
    )  # as those that were measured
