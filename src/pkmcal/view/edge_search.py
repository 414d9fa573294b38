"""Measurements in one image: edges of legs, rejected edges, and corners of the board.

Edges are measured as `calibrate` does: for the nominal model each leg as a whole within a few
pixels, for a calibrated machine each edge by itself to sub-pixel accuracy. Weights and residuals
of the calibration are read from its file.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import dot
from pkmcal.measurements import EdgeSet, Rejection
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.overlays import (
    EDGE_CURVE_POINTS,
    edge_name,
    measured_curves,
    offsets_across_curves,
    own_edges,
    polyline,
    residual_words,
    straightened,
)
from pkmcal.observe.predict import EdgePoints, edge_points, legs_in_camera, tubes_of
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.view.content import Pane, Viewed
from pkmcal.view.overlay import path_data, placed_by_hand
from pkmcal.view.requests import ViewRequest
from pkmcal.wording import count, number

MIDDLE_EDGE_SIGMAS = 2.0
"""Largest median offset of a fitting machine, in standard deviations.

Those of the nominal model and of the search count, added in squares.
"""


class _EdgeResult(NamedTuple):
    """Weight of an edge in the calibration, and its residuals in standard deviations."""

    weight: float
    shift: float
    tilt: float


def edge_search(viewed: Viewed, request: ViewRequest) -> dict[str, Any]:
    """Edges with their offsets (px) from the overlaid machine, edges not found, and board corners.

    Edges that are not found have a reason. Sentences summarize the result.
    """
    pane = placed_by_hand(viewed, request)
    texts: list[str] = []
    out: dict[str, Any] = {"edges": [], "missed": [], "corners": [], "told": texts, "median": None}
    if "legs" in viewed.station(request.station).observe and len(tubes_of(pane.machine)):
        _legs(viewed, request, pane, out)
    detection = viewed.corners(request.station, request.image)
    if detection is not None:
        out["corners"] = np.round(detection.pixels, 1)
        corners = count(len(detection.ids), "corner")
        texts.append(f"The board: {corners} found." if detection.success else
                    f"The board is not found: {detection.reason}.")  # fmt: skip
    return out


def _legs(viewed: Viewed, request: ViewRequest, pane: Pane, out: dict[str, Any]) -> None:
    """Measure the legs' edges and add them to the answer."""
    # measure the edges in a batch of this one image
    row = viewed.image_entry(request.station, request.image).configuration
    taken = StationImages(
        request.station,
        pane.camera,
        np.array([row]),
        pane.joints[None],
        [viewed.image(request.station, request.image)],
        pane.response,
        legs.first_binning(pane.camera.image_size),
    )
    measure = legs.measure if request.shown == "calibration" else legs.search
    measured = measure(taken, pane.machine, pane.T_camera_base, pane.T_base_platform[None])
    judged, reasons = _calibration_results(viewed, request)
    # measured edges, with weights and residuals of the calibration
    curves, away = _offset_curves(pane, measured.edges)
    for n, points in enumerate(straightened(curves)):
        place = (
            int(measured.edges.leg[n]),
            int(measured.edges.tube[n]),
            int(measured.edges.side[n]),
        )
        shift = number(float(away[n]), 2, signed=True)
        tip = f"{edge_name(*place).capitalize()}: {shift} px outward"
        quiet = False
        if (of := judged.get(place)) is not None:
            quiet = of.weight < INLIER_WEIGHT
            tip += f"; {residual_words(of.shift, of.tilt, of.weight)}"
        if place in reasons:
            quiet, tip = True, f"{tip}; {reasons[place]}"
        line = polyline(place[0], points, quiet, tip)
        if line:
            out["edges"].append({"leg": line.leg, "d": path_data(line), "quiet": quiet, "tip": tip})
    # predicted edges that were not measured
    missed = _missing_edges(pane, measured.edges, measured.rejected, reasons)
    out["missed"] = missed
    out["median"] = float(np.median(np.abs(away))) if len(away) else None
    out["told"] += _agreement_text(pane, request, len(curves), len(missed), out["median"])


def _calibration_results(
    viewed: Viewed, request: ViewRequest
) -> tuple[dict[tuple[int, int, int], _EdgeResult], dict[tuple[int, int, int], str]]:
    """Weights and residuals of an image's edges in the calibration, and reasons of rejections.

    Both by leg, tube and side from 0; -1 stands for all. Empty without a calibration.
    """
    if request.shown != "calibration":
        return {}, {}
    document, s = viewed.saved.document, viewed.number(request.station) + 1
    k = viewed.image_entry(request.station, request.image).configuration
    rows = (document.get("residuals") or {}).get("edges") or []
    judged = {
        (int(leg) - 1, int(tube) - 1, int(side) - 1): _EdgeResult(weight, shift, tilt)
        for station, row, leg, tube, side, weight, shift, tilt, *_ in rows
        if (station, row) == (s, k + 1)
    }
    own = [viewed.station(request.station).name, viewed.session.configurations[k]]
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
) -> list[dict[str, Any]]:
    """Predicted edges within the image that were not measured, each with the reason."""
    tubes = tubes_of(pane.machine)
    pixel = _contours(pane, EDGE_CURVE_POINTS).pixel
    measured = set(zip(edges.leg.tolist(), edges.tube.tolist(), edges.side.tolist(), strict=True))
    now = {(r.leg, r.tube, r.side): r.reason for r in rejected}
    out: list[dict[str, Any]] = []
    inside = np.where(pane.camera.in_image(pixel)[..., None], pixel, np.nan)
    for e, points in enumerate(straightened(inside)):
        place = (int(tubes.leg[e]), int(tubes.tube[e]), int(tubes.side[e]))
        if place in measured:
            continue
        whole = (place[0], -1, -1)
        why = reasons.get(place) or now.get(place) or reasons.get(whole) or now.get(whole)
        why = why or "too little of it is seen"
        tip = f"{edge_name(*place).capitalize()}: {why}"
        line = polyline(place[0], points, True, tip)
        if line:
            out.append({"leg": line.leg, "d": path_data(line), "tip": line.tip, "reason": why})
    return out


def _contours(pane: Pane, samples: int) -> EdgePoints:
    """Points of the machine's predicted edges."""
    legs = legs_in_camera(pane.machine, pane.T_camera_base, pane.T_base_platform, pane.joints)
    return edge_points(pane.machine, pane.camera, legs, tubes_of(pane.machine), samples)


def _agreement_text(
    pane: Pane, request: ViewRequest, measured: int, missed: int, median: float | None
) -> list[str]:
    """Sentences on the agreement of the machine with the image."""
    if measured + missed == 0:
        return ["No leg of the machine would be in this image at this pose."]
    text = f"{measured} of {measured + missed} edges of legs are found"
    if median is None:
        return [f"It does not fit: {text}."]
    if request.shown == "calibration":
        return [f"{text}; the middle one lies {number(median, 2)} px from the calibrated machine."]
    tolerance = pane.machine.document.tolerance.center
    gain = _contours(pane, 3).gain
    allowed = tolerance * float(np.nanmedian(gain))
    # expected offset: prior sigma of a centre, projected, and resolution of the search
    near = median < MIDDLE_EDGE_SIGMAS * np.hypot(allowed, legs.LEG_SEARCH_OPTIONS.sigma)
    # some background edges lie near by chance, but not most of the machine's
    verdict = (
        "It fits" if near and measured > missed else "It may fit" if near else "It does not fit"
    )
    # the search has a resolution of whole pixels
    half = legs.LEG_SEARCH_OPTIONS.sigma / 2
    off = f"{number(median, 1)} px" if median > half else "less than half a pixel"
    return [
        f"{verdict}: {text}, and the middle one lies {off} from the nominal model. The nominal"
        f" model's tolerance of {tolerance * 1e3:.3g} mm is {number(allowed, 1)} px here."
    ]
