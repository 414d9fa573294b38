"""Hypothesis that images have another response than is usual for their kind of file, by a score
test.

A kind of file has a usual response: linear, or the sRGB curve. With a wrong response, blurred edges
are displaced to their dark side, each by its own contrast, which no change of the machine
reproduces. So the change from the edges by one response to those by the other is a column of one
number (:mod:`pkmcal.identify.score`), whose estimate is 0 if the first response is right. First a
few images are tested; they decide unless legs are polished. If they prefer the other response, or
do not decide, all images are measured by the other response as well, and the response from which
the change to the other gains less chi2 is right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import exp
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, evenly
from pkmcal.cameras.response import OTHER_RESPONSE, Response
from pkmcal.errors import PkmcalError
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.score import ScoreTests
from pkmcal.identify.verdict import POLISHED_SHADING
from pkmcal.levels import MAJORITY
from pkmcal.measurements import Column, EdgeSet, Measurements, concatenate
from pkmcal.observe.image_batches import StationImages
from pkmcal.outcome.finding import Finding, doubtful, note
from pkmcal.outcome.hypotheses import (
    HYPOTHESIS_THRESHOLDS,
    EvidenceLevel,
    Hypothesis,
    Ranked,
    decide,
    posterior,
)
from pkmcal.session.load import Session
from pkmcal.wording import listed

RESPONSE_TEST_CONFIGURATIONS = 6
"""Number of configurations of a camera whose images are tested first: with painted legs their
hundred and fifty edges detect a wrong response at six standard deviations."""
LEAST_RESPONSE_GAIN = 2.7
"""Decrease of chi2 above which all images are measured by the other response (exceeded by chance in
one session of ten)."""
MOST_TURN_DEVIATION = (2 * HYPOTHESIS_THRESHOLDS.act) ** -0.5
"""Standard deviation of the change above which few images do not decide: with a smaller one the
odds between no change and a whole one, 0 and 1, are those of an act."""
_Camera = tuple[str, Response]
"""A camera's file, and the usual response of its kind of image file."""


ResponseHypothesis = Hypothesis[Session]
"""Facts: ``stations``, entries in session.yaml; ``usual`` response of their images' kind, by which
they were measured first, and the ``other`` one."""


def other_response(entries: Sequence[str], usual: Response) -> ResponseHypothesis:
    """Images of a camera's stations, named in session.yaml, with another response than usual."""
    other = OTHER_RESPONSE[usual]
    return ResponseHypothesis(
        "image.response",
        listed(entries),
        partial(_with_response, entries=tuple(entries), response=other),
        action="repair",
        facts={"usual": usual, "other": other, "stations": tuple(entries)},
    )


def _with_response(session: Session, entries: tuple[str, ...], response: Response) -> Session:
    stations = tuple(
        replace(station, response=response, response_given=True)
        if station.entry in entries
        else station
        for station in session.stations
    )
    return replace(session, stations=stations)


class ResponseComparison(NamedTuple):
    """Cameras whose images may have another response than usual, with their log-odds, and notes on
    cameras that could not be compared.
    """

    ranked: tuple[Ranked[ResponseHypothesis], ...] = ()
    untested: tuple[Finding, ...] = ()

    @property
    def repairs(self) -> tuple[ResponseHypothesis, ...]:
        """Hypotheses that are decided for: their responses are used for the measurement."""
        return tuple(one.hypothesis for one in self.ranked if decide([one]))

    @property
    def by_entry(self) -> dict[str, Response]:
        """Responses by entry in session.yaml, where they are not the usual ones."""
        facts = [one.facts for one in self.repairs]
        return {entry: each["other"] for each in facts for entry in each["stations"]}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Notes where the edges decide, else warnings; then what was not compared."""
        return (*map(response_finding, self.ranked), *self.untested)


def response_finding(one: Ranked[ResponseHypothesis]) -> Finding:
    """A note where the images are measured by the other response, else a warning."""
    subject, facts = one.hypothesis.subject, {**one.hypothesis.facts, "log_odds": one.log_odds}
    if decide([one]):
        return note("image.response", subject, **facts, odds=round(exp(HYPOTHESIS_THRESHOLDS.act)))
    return doubtful("image.response_unknown", subject, **facts)


def responses_by_edges(
    session: Session,
    images: Sequence[StationImages],
    measurements: Measurements,
    estimate: Estimate,
    roughly: Callable[[list[StationImages]], EdgeSet],
    measured: Callable[[list[StationImages]], EdgeSet],
    of_edges: Callable[[EdgeSet], Measurements],
) -> ResponseComparison:
    """Compare the usual with the other response, for cameras without a response in session.yaml.

    The log-likelihood ratio is half the decrease of chi2 by the change to the other response, minus
    half that by the change back.

    measurements, estimate : by the usual responses.
    roughly, measured : functions that measure the edges of images at the predictions of
        ``measurements``, with the same blur, or with a blur of their own.
    of_edges : function that returns the measurements with other edges.

    Returns cameras whose edges prefer the other response, or do not decide.
    """
    # images by camera, where session.yaml does not state the response
    usual: dict[_Camera, list[StationImages]] = {}
    for p in images:
        station = session.stations[p.station]
        if not station.response_given:
            usual.setdefault((station.camera_file, p.response), []).append(p)
    try:
        questionable = _questionable(measurements, estimate, usual, roughly)
        if not questionable:
            return ResponseComparison()
        edges = measurements.edges
        own = {x: np.isin(edges.station, [p.station for p in usual[x]]) for x in questionable}
        every = {camera: measured(_otherwise(usual[camera])) for camera in questionable}
        # in dark images hardly an edge is measurable with a wrong response
        every = {x: e for x, e in every.items() if len(e) > MAJORITY * own[x].sum()}
        if not every:
            return ResponseComparison()
        # change to the other response, and back from an estimate with it
        there, _ = _scored(measurements, estimate, every)
        stay = ~np.any([own[camera] for camera in every], axis=0)
        new = concatenate([edges.select(stay), *every.values()])
        otherwise = of_edges(new.select(np.argsort(new.station, kind="stable")))
        ended = bundle(estimate.machine, otherwise, estimate.state)
        before = {camera: edges.select(own[camera]) for camera in every}
        back, _ = _scored(otherwise, ended, before)
    except PkmcalError as error:  # such as too few edges by the other response
        why = str(error).rstrip(".")
        each = (other_response(_entries(session, usual[camera]), camera[1]) for camera in usual)
        untested = (
            note("image.response_untested", one.subject, **one.facts, log_odds=np.nan, why=why)
            for one in each
        )
        return ResponseComparison(untested=tuple(untested))
    ranked: list[Ranked[ResponseHypothesis]] = []
    for camera in every:  # each camera by itself
        ratio = 0.5 * (there[camera] - back[camera])
        level = EvidenceLevel[ResponseHypothesis]("edges", lambda _, ratio=ratio: np.array([ratio]))
        one = other_response(_entries(session, usual[camera]), camera[1])
        ranked += posterior([one], [level])
    return ResponseComparison(
        tuple(one for one in ranked if one.log_odds > -HYPOTHESIS_THRESHOLDS.report)
    )


def _entries(session: Session, images: Sequence[StationImages]) -> tuple[str, ...]:
    """Entries of images' stations in session.yaml, each once."""
    return tuple(dict.fromkeys(session.stations[p.station].entry for p in images))


def _questionable(
    measurements: Measurements,
    estimate: Estimate,
    usual: Mapping[_Camera, Sequence[StationImages]],
    roughly: Callable[[list[StationImages]], EdgeSet],
) -> list[_Camera]:
    """Cameras all of whose images have to be measured by the other response.

    Those in which a few images prefer the other response, or do not determine the change, as with
    polished legs.
    """
    if estimate.edge_noise.shading.max() > POLISHED_SHADING:
        return list(usual)
    queries = {camera: _test_images(mine) for camera, mine in usual.items()}
    few = {x: roughly(_otherwise(_select(usual[x], some))) for x, some in queries.items()}
    # edges of the tested cameras outside the tested images do not change: they would oppose the
    # change, so they have no weight
    weight = np.where(_edge_mask(measurements.edges, usual, queries), estimate.edge_weights, 0.0)
    gains, ways = _scored(measurements, replace(estimate, edge_weights=weight), few)
    return [
        camera
        for camera in usual
        if gains[camera] > LEAST_RESPONSE_GAIN or not ways[camera] < MOST_TURN_DEVIATION
    ]


def _otherwise(images: Sequence[StationImages]) -> list[StationImages]:
    return [replace(p, response=OTHER_RESPONSE[p.response]) for p in images]


def _select(images: Sequence[StationImages], which: Sequence[Booleans]) -> list[StationImages]:
    """Some images of each station, where there are any."""
    pairs = zip(images, which, strict=True)
    return [p.select(np.flatnonzero(some)) for p, some in pairs if some.any()]


def _test_images(images: Sequence[StationImages]) -> list[Booleans]:
    """Masks of each station's images: those of some configurations, spread evenly over the stations
    of a camera.
    """
    visible = [np.unique(p.configuration) for p in images]
    first = np.cumsum([0, *map(len, visible)])
    some = evenly(int(first[-1]), RESPONSE_TEST_CONFIGURATIONS)
    return [
        np.isin(p.configuration, here[some[(some >= since) & (some < end)] - since])
        for p, here, since, end in zip(images, visible, first[:-1], first[1:], strict=True)
    ]


def _edge_mask(
    edges: EdgeSet,
    usual: Mapping[_Camera, Sequence[StationImages]],
    queries: Mapping[_Camera, Sequence[Booleans]],
) -> Booleans:
    """Mask (N,) of edges in the images that are tested, or of cameras that are not tested."""
    out = np.ones(len(edges), dtype=bool)
    for camera, mine in usual.items():
        for p, some in zip(mine, queries[camera], strict=True):
            visible = np.isin(edges.configuration, p.configuration[some])
            out &= (edges.station != p.station) | visible
    return out


def _scored(
    measurements: Measurements, estimate: Estimate, other: Mapping[_Camera, EdgeSet]
) -> tuple[dict[_Camera, float], dict[_Camera, float]]:
    """Decrease of chi2 by the change to other edges, for the edges of each camera, and the standard
    deviation of that change.
    """
    turns = [_normal_turn(measurements.edges, edges) for edges in other.values()]
    effects = [Column("camera.response", edges=turn) for turn in turns]
    if not effects:
        return {}, {}
    tests = ScoreTests(*estimate.linearized, effects)
    gains = [score.chi2 for score in tests.scores()]
    deviations = [float(freed.sigma[0]) for freed in tests.fitted(range(len(effects)))]
    return dict(zip(other, gains, strict=True)), dict(zip(other, deviations, strict=True))


def _normal_turn(edges: EdgeSet, other: EdgeSet) -> Array:
    """Rotation (N, 2, 1) of the edges' normals, in their bases, to those of another measurement
    pass.

    Zero for edges that the other pass lacks, and for coarse ones, which do not depend on the
    response.
    """
    mine, theirs = edges.same_as(other)
    both = ~edges.coarse[mine] & ~other.coarse[theirs]
    mine, theirs = mine[both], theirs[both]
    turn = np.zeros((len(edges), 2, 1))
    shifted = other.normal[theirs] - edges.normal[mine]
    turn[mine, :, 0] = np.einsum("nij,ni->nj", edges.basis[mine], shifted)
    return turn
