"""Machine overlaid on an image, at a pose that the user adjusts; one request for each change.

Here and in the neighbouring modules, imports that the first image does not need are local.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply
from pkmcal.observe.overlays import (
    EDGE_CURVE_POINTS,
    EdgeCurve,
    machine_laid_over,
    polyline,
    straightened,
)
from pkmcal.view.content import Pane, Viewed
from pkmcal.view.gestures import aimed, farther, pinned, rolled, turned_as_ball
from pkmcal.view.requests import ViewRequest, requested_pose

STATION_POSE_DECIMALS = 4
"""Decimals of a written position in m; nobody places a camera to a tenth of a millimetre."""


def pane_of(viewed: Viewed, request: ViewRequest) -> Pane:
    """Machine of a request, in front of the camera at the pose of the files."""
    pane_at = viewed.calibrated if request.shown == "calibration" else viewed.drawn
    return pane_at(request.station, request.image)


def overlay_after_gesture(viewed: Viewed, request: ViewRequest) -> dict[str, Any]:
    """Pose after the request's gesture, and the overlay in pixels."""
    pane = placed_by_hand(viewed, request)
    edges, spots = machine_laid_over(
        pane.machine, pane.camera, pane.T_camera_base, pane.joints, pane.T_base_platform
    )
    lines = [*edges, *_bare_limbs(pane)]
    # one SVG path for each leg
    legs = sorted({edge.leg for edge in lines})
    paths = [
        {
            "leg": leg,
            "quiet": not pane.machine.document.legs[leg - 1].tubes,
            "d": "".join(path_data(edge) for edge in lines if edge.leg == leg),
        }
        for leg in legs
    ]
    joints = [
        {
            "leg": s.leg,
            "end": s.end,
            "x": s.calibrated[0],
            "y": s.calibrated[1],
            "number": s.labelled,
        }
        for s in spots
    ]
    return {
        "pose": pane.T_camera_base,
        "place": place_of(pane.T_camera_base),
        "legs": paths,
        "joints": joints,
    }


def path_data(edge: EdgeCurve) -> str:
    """Edge as data of an SVG path."""
    return "M" + "L".join(f"{x:.2f},{y:.2f}" for x, y in edge.points)


def placed_by_hand(viewed: Viewed, request: ViewRequest) -> Pane:
    """Machine of a request, in front of the camera at the pose after pins and gesture."""
    pane, T_camera_base = pane_of(viewed, request), requested_pose(request)
    if T_camera_base is None:
        T_camera_base = pane.T_camera_base
    camera, points = pane.camera, pane.points.reshape(-1, 3)
    # pins first, then the gesture
    if request.pins:
        pins = np.stack([_joint(viewed, request, k) for k in range(len(request.pins))])
        pixels = np.array([pin.pixel for pin in request.pins], dtype=float)
        T_camera_base = pinned(camera, T_camera_base, points, pins, pixels)
    if request.gesture is not None:
        start, end = (
            np.array(p, dtype=float) for p in (request.gesture.start, request.gesture.end)
        )
        match request.gesture.kind:
            case "aim":
                T_camera_base = aimed(camera, T_camera_base, start, end)
            case "turn":
                T_camera_base = turned_as_ball(camera, T_camera_base, points, start, end)
            case "roll":
                T_camera_base = rolled(camera, T_camera_base, points, start, end)
            case "distance":
                factor = float(request.gesture.factor)
                T_camera_base = farther(camera, T_camera_base, points, start, factor)
    return replace(pane, T_camera_base=T_camera_base)


def place_of(T_camera_base: Array) -> dict[str, list[float]]:
    """Pose in the form of session.yaml, with the digits that are written there."""
    from pkmcal.placement.stations import StationPose

    return StationPose.of(T_camera_base).rounded(STATION_POSE_DECIMALS)


def _joint(viewed: Viewed, request: ViewRequest, k: int) -> Array:
    """Centre (3,) of a pinned joint, base frame, m, in the configuration of the pin's image.

    Raises InputError for a leg that the machine lacks.
    """
    pin = request.pins[k]
    other = request.model_copy(update={"image": pin.image})
    points = pane_of(viewed, other).points[0 if pin.end == "base" else 1]
    if pin.leg > len(points):
        raise InputError("there is no such leg", where=f"the page, pins[{k + 1}]", found=pin.leg)
    return points[pin.leg - 1]


def _bare_limbs(pane: Pane) -> list[EdgeCurve]:
    """Axes of the legs without tubes."""
    bare = [j for j, leg in enumerate(pane.machine.document.legs) if not leg.tubes]
    if not bare:
        return []
    a, b = (part[bare, None] for part in pane.points)
    pixel = pane.camera.project(
        apply(pane.T_camera_base, a + np.linspace(0, 1, EDGE_CURVE_POINTS)[:, None] * (b - a))
    )
    whole = np.isfinite(pixel).all(axis=(1, 2))
    curves = zip(np.array(bare)[whole].tolist(), straightened(pixel[whole]), strict=True)
    lines = (polyline(j, points, True, "") for j, points in curves)
    return [line for line in lines if line]
