"""How photographs code light, told by the edges: as sensors count it, or as telephones write it.

A file's kind says what is usual, not what is so. Blurred edges lean to their dark side where levels
are coded otherwise than believed, each by its own contrast, and no machine does that: so the way
from where edges lie by one code to where they lie by the other is a departure of one number
(:mod:`pkmcal.identify.score`), whose fit is 0 where the first is right. Some photographs tell
whether there is anything to gain; if so all are measured by the other code too, and right is the
code from which there is less to gain by going to the other one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Integers, evenly
from pkmcal.cameras.response import OTHER_RESPONSE, Response
from pkmcal.identify.bundle import as_ended, bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.score import Departures
from pkmcal.measurements import EdgeSet, Effect, Measurements, concatenate
from pkmcal.observe.legs import Photographs
from pkmcal.session.load import Session

PHOTOGRAPHS_ASKED_OF_CODE = 12
"""Photographs of a camera that are asked at first: their two hundred edges show a wrong code by
four standard deviations, even on metal."""
LEAST_GAIN_OF_CODE, MOST_DEVIATION_OF_CODE = 2.7, 0.1
"""chi2 from which all are asked, by chance one session of ten, and the way's standard deviation
from which a code that is wrong would not show by so much."""
ODDS_FOR_OTHER_CODE, ODDS_AGAINST_OTHER_CODE = 1000.0, 20.0
"""Odds from which the edges overrule what is usual for files of a kind; and from which what is
usual needs no caution."""
_WORDS: dict[Response, str] = {
    "linear": "linearly, as sensors count it",
    "srgb": "as sRGB, as telephones do",
}


@dataclass(frozen=True)
class CodeTold:
    """What edges say of a camera's code, where they do not say that it is as usual.

    file : of the camera. usual : by which its photographs were measured at first. gain : of chi2 by
    the other code, less what there would be to gain by going back.
    """

    file: str
    usual: Response
    gain: float

    @property
    def sure(self) -> bool:
        """Whether the other code is right."""
        return self.gain > 2 * np.log(ODDS_FOR_OTHER_CODE)

    @property
    def response(self) -> Response:
        """The code by which its photographs are measured."""
        return OTHER_RESPONSE[self.usual] if self.sure else self.usual

    @property
    def sentence(self) -> str:
        """For a verdict: a hint where the edges are sure, else a caution."""
        usual, other = _WORDS[self.usual], _WORDS[OTHER_RESPONSE[self.usual]]
        if self.sure:
            return (
                f"The photographs of {self.file} code light {other}, not {usual}, which is usual"
                f" for files of their kind: so their edges fit better, by {self.gain:.0f} of χ²."
                f" They are measured so; write response: {self.response} into {self.file} for"
                " check, view and servo."
            )
        return (
            f"Whether the photographs of {self.file} code light {usual}, which is usual for files"
            f" of their kind and believed here, or {other}, their edges do not tell; in the other"
            f" case errors are larger than stated. Write response: {self.usual} or response:"
            f" {OTHER_RESPONSE[self.usual]} into {self.file}: the camera's settings say it, as"
            " gamma, or a photograph of a chart of greys does."
        )


def told_by_edges(
    session: Session,
    photographs: Sequence[Photographs],
    measurements: Measurements,
    estimate: Estimate,
    measured: Callable[[list[Photographs]], EdgeSet],
    of_edges: Callable[[EdgeSet], Measurements],
) -> tuple[CodeTold, ...]:
    """Cameras whose files do not say how light is coded, and whose edges say that it is otherwise
    than usual.

    measurements, estimate : by the usual codes. measured : the edges of photographs, looked for
    where those of ``measurements`` were. of_edges : measurements with these edges instead.
    """
    asked: dict[str, list[Photographs]] = {}
    for p in photographs:
        station = session.stations[p.station]
        if not station.response_told:
            other = replace(p.camera, response=_other(p))
            asked.setdefault(station.camera_file, []).append(replace(p, camera=other))
    few = {file: measured(_spread(mine)) for file, mine in asked.items()}
    scores, ways = _asked(measurements, estimate, few)
    doubted = [
        file
        for file in asked
        if scores[file] > LEAST_GAIN_OF_CODE or not ways[file] < MOST_DEVIATION_OF_CODE
    ]
    if not doubted:
        return ()
    every = {file: measured(asked[file]) for file in doubted}
    there, _ = _asked(measurements, estimate, every)
    edges, moved = measurements.edges, [p.station for file in doubted for p in asked[file]]
    new = concatenate([edges.select(~np.isin(edges.station, moved)), *every.values()])
    otherwise = of_edges(new.select(np.argsort(new.station, kind="stable")))
    ended = bundle(estimate.machine, otherwise, estimate.state)
    back, _ = _asked(otherwise, ended, dict.fromkeys(doubted, edges))
    told = [CodeTold(file, _other(asked[file][0]), there[file] - back[file]) for file in doubted]
    return tuple(one for one in told if one.gain > -2 * np.log(ODDS_AGAINST_OTHER_CODE))


def _other(photographs: Photographs) -> Response:
    return OTHER_RESPONSE[photographs.camera.response or "linear"]


def _spread(photographs: Sequence[Photographs]) -> list[Photographs]:
    """Some photographs of one camera, evenly over its stations."""
    first = np.cumsum([0, *(len(p.images) for p in photographs)])
    some = evenly(int(first[-1]), PHOTOGRAPHS_ASKED_OF_CODE)
    parts = zip(photographs, first[:-1], first[1:], strict=True)
    here = [(p, some[(some >= since) & (some < end)] - since) for p, since, end in parts]
    return [p.select(numbers) for p, numbers in here if len(numbers)]


def _asked(
    measurements: Measurements, estimate: Estimate, by_other: Mapping[str, EdgeSet]
) -> tuple[dict[str, float], dict[str, float]]:
    """chi2 that would be gained by going to where other edges are, for the edges of each file, and
    the standard deviation of the way that fits.
    """
    effects = [Effect(edges=_way(measurements.edges, other)) for other in by_other.values()]
    if not effects:
        return {}, {}
    tests = Departures(*as_ended(measurements, estimate), effects)
    gains = [score.chi2 for score in tests.scores()]
    deviations = [float(freed.sigma[0]) for freed in tests.fitted(range(len(effects)))]
    return dict(zip(by_other, gains, strict=True)), dict(zip(by_other, deviations, strict=True))


def _way(edges: EdgeSet, other: EdgeSet) -> Array:
    """Turn (N, 2, 1) of the edges' normals, in their bases, to where another look has them; none of
    those that it does not have.
    """

    def places(of: EdgeSet) -> list[list[int]]:
        return np.stack([of.station, of.configuration, of.leg, of.tube, of.side], axis=1).tolist()

    number = {tuple(place): k for k, place in enumerate(places(other))}
    match: Integers = np.array([number.get(tuple(place), -1) for place in places(edges)], dtype=int)
    both = match >= 0
    turn = np.zeros((len(edges), 2, 1))
    moved = other.normal[match[both]] - edges.normal[both]
    turn[both, :, 0] = np.einsum("nij,ni->nj", edges.basis[both], moved)
    return turn
