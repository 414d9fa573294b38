"""Photographs with what was found in them drawn over, [B] Figs. 6 and 8."""

from __future__ import annotations

import base64
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, inverse
from pkmcal.identify.centres import Centres
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.observe.images import decode
from pkmcal.outcome import Part
from pkmcal.report import page
from pkmcal.report.drawn import Drawn, Spot, measured_curves, straightened
from pkmcal.report.residuals import KEPT, SIDES, rms
from pkmcal.session.load import Session
from pkmcal.session.photographs import Photograph
from pkmcal.wording import count, number

MOST = 12
LARGEST_WIDTH = 640
QUALITY = 70
THREADS = 4


@dataclass(frozen=True)
class Picture:
    """One photograph. jpeg : base64, empty where the file could not be read. kind : of its edges,
    measured or predicted.
    """

    station: str
    configuration: str
    why: str
    width: int
    height: int
    jpeg: str
    edges: tuple[Drawn, ...]
    spots: tuple[Spot, ...]
    rms: float
    kind: str = "measured"

    @property
    def caption(self) -> str:
        """Residuals and number of edges, in words."""
        if not self.edges:
            return "no edge in use"
        aside = sum(edge.quiet for edge in self.edges)
        text = count(len(self.edges), "edge") + (f", {aside} of them put aside" if aside else "")
        return f"{text}; residuals {number(self.rms, 2)} σ"


def section(
    session: Session,
    edges: EdgeSet,
    estimate: Estimate,
    shifts: Array,
    centres: tuple[Centres, ...],
) -> Part:
    """The section; as :func:`pictures`."""
    html = page.render(
        "photographs.html.j2",
        n_legs=session.machine.n_legs,
        pictures=pictures(session, edges, estimate, shifts, centres),
        total=sum(len({p.configuration for p in s.photographs}) for s in session.stations),
    )
    return Part("photographs", "Photographs", html=html)


def pictures(
    session: Session,
    edges: EdgeSet,
    estimate: Estimate,
    shifts: Array,
    centres: tuple[Centres, ...],
) -> tuple[Picture, ...]:
    """At most ``MOST`` photographs that stand for the rest. shifts : (N,) px, for tooltips."""
    chosen = choose(session, edges, estimate.edge_residuals, estimate.configurations)
    with ThreadPoolExecutor(THREADS) as pool:
        sizes = (session.stations[s].camera.image_size for s, _, _ in chosen)
        shots = list(pool.map(jpeg, (photo.path for _, photo, _ in chosen), sizes))
    out: list[Picture] = []
    for (s, photo, why), shot in zip(chosen, shots, strict=True):
        k, station = photo.configuration, session.stations[s]
        mine = np.flatnonzero((edges.station == s) & (edges.configuration == k))
        width, height = station.camera.image_size
        out.append(
            Picture(
                station=station.name,
                configuration=session.configurations[k],
                why=why,
                width=width,
                height=height,
                jpeg=shot,
                edges=_drawn(session, edges, estimate, shifts, mine, s, k),
                spots=_spots(session, estimate, centres, s, k),
                rms=rms(estimate.edge_residuals[mine], estimate.edge_weights[mine]),
            )
        )
    return tuple(out)


Choice = tuple[int, Photograph, str]


def choose(
    session: Session, edges: EdgeSet, white: Array, posed: Booleans, most: int = MOST
) -> list[Choice]:
    """Photographs for the page in the session's order: (station, photograph, why).

    Of every station the worst, the best, then the middle ones, in turn until there are enough.
    posed : (K,) True where the pose was estimated.
    """
    queues = [_queue(session, edges, white, posed, s) for s in range(len(session.stations))]
    taken: list[Choice] = []
    while len(taken) < most and any(queues):
        for queue in queues:
            if queue and len(taken) < most:
                taken.append(queue.pop(0))
    return sorted(taken, key=lambda item: (item[0], item[1].configuration))


def _queue(session: Session, edges: EdgeSet, white: Array, posed: Booleans, s: int) -> list[Choice]:
    """A station's photographs in the order of their worth to the reader.

    Ranked by all residuals alike: edges that were put aside are what a reader wants to see.
    """
    first = {photo.configuration: photo for photo in reversed(session.stations[s].photographs)}
    here = np.flatnonzero(edges.station == s)
    here = here[np.argsort(edges.configuration[here], kind="stable")]
    ends = np.searchsorted(edges.configuration[here], np.arange(len(posed) + 1))
    level: dict[int, float] = {}
    for k in first:
        if posed[k]:
            mine = white[here[ends[k] : ends[k + 1]]]
            level[k] = rms(mine, np.ones(len(mine)))
    ranked = sorted((k for k in level if np.isfinite(level[k])), key=lambda k: -level[k])
    blind = [k for k in level if not np.isfinite(level[k])]
    middle = len(ranked) // 2
    order = list(dict.fromkeys([*ranked[:1], *ranked[-1:], *ranked[middle:], *ranked, *blind]))
    names: dict[int, str] = {}
    if len(ranked) > 1:
        names = {ranked[-1]: "best of this station", ranked[0]: "worst of this station"}
    return [(s, first[k], names.get(k, "")) for k in order]


def jpeg(path: Path | None, size: tuple[int, int]) -> str:
    """A photograph in grey, small, as base64; empty where it is not there any more."""
    import cv2

    if path is None:
        return ""
    try:
        image: Any = decode(path, size, path.name)
    except InputError:
        return ""
    if size[0] > LARGEST_WIDTH:
        height = max(1, round(size[1] * LARGEST_WIDTH / size[0]))
        image = cv2.resize(image, (LARGEST_WIDTH, height), interpolation=cv2.INTER_AREA)
    packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    return base64.b64encode(packed.tobytes()).decode("ascii")


def _drawn(
    session: Session,
    edges: EdgeSet,
    estimate: Estimate,
    shifts: Array,
    mine: Integers,
    s: int,
    k: int,
) -> tuple[Drawn, ...]:
    """The fitted edges of one photograph."""
    curves = edge_curves(session, edges, estimate, mine, s, k)
    out: list[Drawn] = []
    for n, curve in zip(mine.tolist(), curves, strict=True):
        points = straightened(curve[np.isfinite(curve).all(axis=-1)])
        if len(points) > 1:
            quiet = bool(estimate.edge_weights[n] < KEPT)
            leg = int(edges.leg[n]) + 1
            across, tilt = estimate.edge_residuals[n]
            tip = (
                f"Leg {leg}, tube {edges.tube[n] + 1}, {SIDES[edges.side[n]]} edge: "
                f"{number(float(shifts[n]), 2, signed=True)} px outward; residual "
                f"{number(float(across), 1, signed=True)} σ across, "
                f"{number(float(tilt), 1, signed=True)} σ tilt; "
                f"weight {number(float(estimate.edge_weights[n]), 2)}"
            )
            line = tuple((float(x), float(y)) for x, y in points)
            out.append(Drawn(leg, line, quiet, tip))
    return tuple(out)


def edge_curves(
    session: Session, edges: EdgeSet, estimate: Estimate, mine: Integers, s: int, k: int
) -> Array:
    """Curves (n, CURVE, 2) px of the edges ``mine`` in the picture of station s."""
    state = estimate.state
    return measured_curves(
        estimate.machine,
        session.stations[s].camera,
        state.T_camera_base[s],
        state.T_base_platform[k],
        session.joints[k],
        edges.select(mine),
    )


def _spots(
    session: Session, estimate: Estimate, centres: tuple[Centres, ...], s: int, k: int
) -> tuple[Spot, ...]:
    """Joint centres in the picture, by the result and by the drawing laid over it."""
    state, camera = estimate.state, session.stations[s].camera
    pose, joints = state.T_base_platform[k], session.joints[k]
    base, platform = (side.T_calibrated_drawing for side in centres)
    after = limb_ends(estimate.machine.layout, estimate.machine.values, joints, pose)
    old_pose = inverse(base) @ pose @ platform
    before = limb_ends(session.machine.layout, session.machine.values, joints, old_pose)
    out: list[Spot] = []
    labelled: set[int] = set()
    for end, new, old in (("base", after.a, before.a), ("platform", after.b, before.b)):
        seen = camera.project(apply(state.T_camera_base[s], new))
        drawn = camera.project(apply(state.T_camera_base[s] @ base, old))
        inside = camera.in_image(seen)
        for j in np.flatnonzero(inside).tolist():
            cross = _pair(drawn[j]) if np.isfinite(drawn[j]).all() else None
            out.append(Spot(j + 1, end, _pair(seen[j]), cross, j not in labelled))
            labelled.add(j)
    return tuple(out)


def _pair(point: Array) -> tuple[float, float]:
    return round(float(point[0]), 1), round(float(point[1]), 1)
