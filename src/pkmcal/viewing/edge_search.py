"""Measurements in one image: edges of legs, rejected edges, and corners of the board.

Edges are measured as `calibrate` does: for the nominal model each leg as a whole within a few
pixels, for a calibrated machine each edge by itself to sub-pixel accuracy. Weights and residuals
of the calibration are read from its file.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import dot
from pkmcal.measurements import EdgeSet, Rejection
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.overlays import (
    EDGE_CURVE_POINTS,
    EdgeCurve,
    edge_layer,
    edge_name,
    measured_curves,
    offsets_across_curves,
    own_edges,
    polyline,
    residual_words,
    straightened,
)
from pkmcal.observe.predict import EdgePoints, edge_points, legs_in_camera, tubes_of
from pkmcal.outcome.blocks.images import Cross, Layer, Pixel
from pkmcal.outcome.finding import Level, Mark
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.viewing.content import Pane, SessionContent
from pkmcal.viewing.overlay import placed_by_hand
from pkmcal.web.session_document import EdgesAnswer, LegCount, ViewRequest
from pkmcal.wording import capital, count, named, number

MIDDLE_EDGE_SIGMAS = 2.0
"""Largest median offset of a fitting machine, in standard deviations of the nominal model and of
the search, added in squares: 95 % of normal offsets are smaller."""


class _EdgeResult(NamedTuple):
    """Weight of an edge in the calibration, and its residuals in standard deviations."""

    weight: float
    shift: float
    tilt: float


class _MissingEdge(NamedTuple):
    """Predicted edge that was not measured, with the reason."""

    curve: EdgeCurve
    reason: str


class _LegEdges(NamedTuple):
    """Edges of the legs in an image.

    measured, offsets : curves, and their median offset from the machine, px.
    """

    measured: list[EdgeCurve]
    missing: list[_MissingEdge]
    median: float | None
    texts: list[str]
    mark: Mark | None


def edge_search(content: SessionContent, request: ViewRequest) -> EdgesAnswer:
    """Edges with their offsets (px) from the overlaid machine, edges not measured with the reason,
    and board corners; a mark and sentences on the agreement.
    """
    pane, station = placed_by_hand(content, request), content.station(request.station)
    result = _LegEdges([], [], None, [], None)
    if "legs" in station.observe and len(tubes_of(pane.machine)):
        result = _leg_edges(content, request, pane)
    texts, marks, corners = result.texts, [result.mark], list[Pixel]()
    detection = content.corners(request.station, request.image)
    if detection is not None:
        corners = [(float(x), float(y)) for x, y in np.round(detection.pixels, 1)]
        n = count(len(detection.ids), "corner")
        reason = f"The board is not detected: {detection.reason}."
        texts.append(f"The board: {n} detected." if detection.success else reason)
        marks.append("good" if detection.success else Level.WRONG)
    order: tuple[Mark, ...] = ("good", Level.DOUBTFUL, Level.WRONG)
    # numbers of each leg's edges
    measured = [one.leg for one in result.measured]
    predicted = [*measured, *(one.curve.leg for one in result.missing)]
    return EdgesAnswer(
        mark=max((mark for mark in marks if mark is not None), key=order.index, default=None),
        texts=tuple(texts),
        legs=tuple(
            LegCount(leg=leg, measured=measured.count(leg), predicted=predicted.count(leg))
            for leg in range(1, pane.machine.n_legs + 1)
        ),
        reasons=tuple(_reasons(result.missing)),
        median=result.median,
        layers=(
            edge_layer("rejected", [one.curve for one in result.missing]),
            edge_layer("edges", result.measured),
            Layer(name="corners", shapes=tuple(Cross(at=at) for at in corners)),
        ),
    )


def _reasons(missing: list[_MissingEdge]) -> list[str]:
    """Sentence on each reason for which edges were not measured."""
    groups: dict[str, list[int]] = defaultdict(list)
    for one in missing:
        groups[one.reason].append(one.curve.leg - 1)
    out: list[str] = []
    for reason, numbers in groups.items():
        edges = "An edge" if len(numbers) == 1 else count(len(numbers), "edge")
        out.append(f"{edges} of {named(numbers)}: {reason}.")
    return out


def _leg_edges(content: SessionContent, request: ViewRequest, pane: Pane) -> _LegEdges:
    """Measure the legs' edges in an image."""
    # measure the edges in a batch of this one image
    row = content.image_entry(request.station, request.image).configuration
    taken = StationImages(
        request.station,
        pane.camera,
        np.array([row]),
        pane.joints[None],
        [content.image(request.station, request.image)],
        pane.response,
        legs.first_binning(pane.camera.image_size),
    )
    measure = legs.measure if request.machine == "calibration" else legs.search
    batch = measure(taken, pane.machine, pane.T_camera_base, pane.T_base_platform[None])
    judged, reasons = _calibration_results(content, request)
    # measured edges, with weights and residuals of the calibration
    curves, away = _offset_curves(pane, batch.edges)
    measured, n_used = list[EdgeCurve](), 0
    for n, points in enumerate(straightened(curves)):
        place = int(batch.edges.leg[n]), int(batch.edges.tube[n]), int(batch.edges.side[n])
        shift = number(float(away[n]), 2, signed=True)
        tip = f"{capital(edge_name(*place))}: {shift} px outward"
        rejected = place in reasons
        if (of := judged.get(place)) is not None:
            rejected |= of.weight < INLIER_WEIGHT
            tip += f"; {residual_words(of.shift, of.tilt, of.weight)}"
            n_used += not rejected
        if place in reasons:
            tip = f"{tip}; {reasons[place]}"
        if curve := polyline(place[0], points, rejected, tip):
            measured.append(curve)
    missing = _missing_edges(pane, batch.edges, batch.rejected, reasons)
    median = float(np.median(np.abs(away))) if len(away) else None
    counts = len(curves), len(missing)
    if sum(counts) == 0:
        text = "No leg of the machine would be in this image at this pose."
        return _LegEdges(measured, missing, median, [text], Level.WRONG)
    if request.machine == "calibration":
        text, mark = _calibrated_agreement(*counts, median, n_used)
    else:
        text, mark = _nominal_agreement(pane, *counts, median)
    return _LegEdges(measured, missing, median, [text], mark)


def _calibration_results(
    content: SessionContent, request: ViewRequest
) -> tuple[dict[tuple[int, int, int], _EdgeResult], dict[tuple[int, int, int], str]]:
    """Weights and residuals of an image's edges in the calibration, and reasons of rejections.

    Both by leg, tube and side from 0; -1 stands for all. Empty without a calibration.
    """
    if request.machine != "calibration":
        return {}, {}
    document, s = content.saved.document, content.number(request.station) + 1
    k = content.image_entry(request.station, request.image).configuration
    rows = (document.get("residuals") or {}).get("edges") or []
    judged = {
        (int(leg) - 1, int(tube) - 1, int(side) - 1): _EdgeResult(weight, shift, tilt)
        for station, row, leg, tube, side, weight, shift, tilt, *_ in rows
        if (station, row) == (s, k + 1)
    }
    own = [content.station(request.station).name, content.session.configurations[k]]
    reasons = {
        (leg - 1, tube - 1, side - 1): group["reason"]
        for group in document.get("rejected") or []
        for *where, leg, tube, side in group["cases"]
        if where == own
    }
    return judged, reasons


def _offset_curves(pane: Pane, edges: EdgeSet) -> tuple[Array, Array]:
    """Measured edges as curves (n, EDGE_CURVE_POINTS, 2) px, and their outward offsets (n,) px.

    The offset is that from the machine's own edge, at the middle of the curve.
    """
    if not len(edges):
        return np.zeros((0, EDGE_CURVE_POINTS, 2)), np.zeros(0)
    machine, one = pane.machine, np.zeros(len(edges), dtype=int)
    pose, joints = pane.T_base_platform[None], pane.joints[None]
    axes = legs_in_camera(machine, pane.T_camera_base, pose, joints)
    # curves of the measured edges and of the machine's own, over the same spans
    measured, predicted = (
        measured_curves(machine, pane.camera, axes, one, part)
        for part in (edges, own_edges(machine, axes, one, edges))
    )
    # outward: away from the image of the leg's axis
    a, u = axes.a[0, edges.leg], axes.u[0, edges.leg]
    axis = pane.camera.project(a + (edges.span.mean(axis=1))[:, None] * u)
    middle = EDGE_CURVE_POINTS // 2
    normal, off = offsets_across_curves(predicted, measured)
    outward = np.sign(dot(normal[:, middle], predicted[:, middle] - axis))
    return measured, outward * off[:, middle]


def _missing_edges(
    pane: Pane,
    edges: EdgeSet,
    rejected: tuple[Rejection, ...],
    reasons: dict[tuple[int, int, int], str],
) -> list[_MissingEdge]:
    """Predicted edges within the image that were not measured, each with the reason."""
    tubes = tubes_of(pane.machine)
    pixel = _contours(pane, EDGE_CURVE_POINTS).pixel
    measured = set(zip(edges.leg.tolist(), edges.tube.tolist(), edges.side.tolist(), strict=True))
    now = {(r.leg, r.tube, r.side): r.reason for r in rejected}
    out: list[_MissingEdge] = []
    inside = np.where(pane.camera.in_image(pixel)[..., None], pixel, np.nan)
    for e, points in enumerate(straightened(inside)):
        place = (int(tubes.leg[e]), int(tubes.tube[e]), int(tubes.side[e]))
        if place in measured:
            continue
        whole = (place[0], -1, -1)
        why = reasons.get(place) or now.get(place) or reasons.get(whole) or now.get(whole)
        why = why or "too little of it is visible"
        curve = polyline(place[0], points, True, f"{capital(edge_name(*place))}: {why}")
        if curve:
            out.append(_MissingEdge(curve, why))
    return out


def _contours(pane: Pane, samples: int) -> EdgePoints:
    """Points of the machine's predicted edges."""
    legs = legs_in_camera(pane.machine, pane.T_camera_base, pane.T_base_platform, pane.joints)
    return edge_points(pane.machine, pane.camera, legs, tubes_of(pane.machine), samples)


def _calibrated_agreement(
    measured: int, missing: int, median: float | None, used: int
) -> tuple[str, Mark]:
    """Agreement of the calibrated machine with the image; used : edges in use by the calibration.

    An image without any edge in use does not fit; one with less than half of the measured ones may.
    """
    text = f"{measured} of {measured + missing} edges of legs are measured"
    if median is None:
        return f"It does not fit: {text}.", Level.WRONG
    offset = f"the median lies {number(median, 2)} px from the calibrated machine"
    if not used:
        return f"{text}; {offset}; none is in use.", Level.WRONG
    return f"{text}; {offset}.", "good" if 2 * used > measured else Level.DOUBTFUL


def _nominal_agreement(
    pane: Pane, measured: int, missing: int, median: float | None
) -> tuple[str, Mark]:
    """Agreement of the nominal machine with the image."""
    text = f"{measured} of {measured + missing} edges of legs are measured"
    if median is None:
        return f"It does not fit: {text}.", Level.WRONG
    tolerance = pane.machine.document.tolerance.center
    gain = _contours(pane, 3).gain
    allowed = tolerance * float(np.nanmedian(gain))
    # expected offset: prior sigma of a centre, projected, and resolution of the search
    near = median < MIDDLE_EDGE_SIGMAS * np.hypot(allowed, legs.LEG_SEARCH_OPTIONS.sigma)
    # some background edges lie near by chance, but not most of the machine's
    verdict, mark = "It does not fit", Level.WRONG
    if near:
        verdict, mark = "It may fit", Level.DOUBTFUL
        if measured > missing:
            verdict, mark = "It fits", "good"
    # the search has a resolution of whole pixels
    half = legs.LEG_SEARCH_OPTIONS.sigma / 2
    off = f"{number(median, 1)} px" if median > half else "less than half a pixel"
    return (
        f"{verdict}: {text}, and the median lies {off} from the nominal model. The nominal model's"
        f" tolerance of {tolerance * 1e3:.3g} mm is {number(allowed, 1)} px here.",
        mark,
    )
