"""Machine overlaid on an image, at a pose that the user adjusts; one request for each change.

Here and in the neighbouring modules, imports that the first image does not need are local.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, is_rigid
from pkmcal.observe.overlays import (
    EDGE_CURVE_POINTS,
    EdgeCurve,
    edge_layer,
    joint_layers,
    machine_laid_over,
    polyline,
    straightened,
)
from pkmcal.outcome.blocks.base import Pose
from pkmcal.outcome.blocks.machine import Property
from pkmcal.viewing.content import Pane, SessionContent
from pkmcal.viewing.gestures import (
    PINNED_JOINT_SIGMA,
    UNSEEN_JOINT_PIXELS,
    aimed,
    farther,
    pinned,
    rolled,
    triangle_poses,
    turned_as_ball,
)
from pkmcal.web.session_document import JointPixel, OverlayAnswer, Pin, ViewRequest
from pkmcal.web.stage import pose_row
from pkmcal.wording import number

AXIS_POINTS = 257
"""Points of a leg's axis among which the nearest to a pixel is taken: a leg as long as an image is
wide has one within a standard deviation of a hand."""
STATION_POSE_DECIMALS = 4
"""Decimals of a written position in m; nobody places a camera to a tenth of a millimetre."""


def pane_of(content: SessionContent, request: ViewRequest) -> Pane:
    """Machine of a request, in front of the camera at the pose of the files."""
    pane_at = content.calibrated if request.machine == "calibration" else content.nominal
    return pane_at(request.station, request.image)


def overlay_after_gesture(content: SessionContent, request: ViewRequest) -> OverlayAnswer:
    """Pose after the request's gesture, and the machine in pixels."""
    pane = placed_by_hand(content, request)
    edges, spots = machine_laid_over(
        pane.machine, pane.camera, pane.T_camera_base, pane.joints, pane.T_base_platform
    )
    place = place_of(pane.T_camera_base)
    return OverlayAnswer(
        pose=pose_rows(pane.T_camera_base),
        place=tuple(
            Property(
                label=name,
                value=", ".join(number(x, STATION_POSE_DECIMALS) for x in part)
                + ("" if name == "up" else " m"),
            )
            for name, part in place.items()
        ),
        layers=(edge_layer("machine", [*edges, *_bare_limbs(pane)]), *joint_layers(spots)),
        joints=tuple(JointPixel(leg=s.leg, end=s.end, at=s.calibrated) for s in spots),
    )


def pose_rows(T: Array) -> Pose:
    """Pose (4, 4) as rows of a document."""
    first, second, third, last = map(pose_row, T)
    return first, second, third, last


def requested_pose(request: ViewRequest) -> Array | None:
    """T_camera_base (4, 4) of a request, None without one.

    Raises InputError for a matrix that is not a rigid motion.
    """
    if request.pose is None:
        return None
    pose = np.array(request.pose, dtype=float)
    if not is_rigid(pose):
        raise InputError("the pose is no rotation and translation", where="the page, pose")
    return pose


def placed_by_hand(content: SessionContent, request: ViewRequest) -> Pane:
    """Machine of a request, in front of the camera at the pose after pins and gesture."""
    pane, T_camera_base = pane_of(content, request), requested_pose(request)
    if T_camera_base is None:
        T_camera_base = pane.T_camera_base
    camera, points = pane.camera, pane.points.reshape(-1, 3)
    # pinned joints first, then the gesture
    ends, pixels = _pinned_joints(content, request)
    if len(ends):
        T_camera_base = pinned(camera, T_camera_base, points, ends, pixels)
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


def poses_by_pins(content: SessionContent, request: ViewRequest) -> Array:
    """Poses (n, 4, 4), none to four, that bring three or more pinned joints to their pixels."""
    pane = pane_of(content, request)
    ends, pixels = _pinned_joints(content, request)
    points = pane.points.reshape(-1, 3)
    poses = triangle_poses(pane.camera, ends, pixels)
    pinned_poses = [pinned(pane.camera, T, points, ends, pixels) for T in poses]
    return np.array(pinned_poses).reshape(-1, 4, 4)


def _pinned_joints(content: SessionContent, request: ViewRequest) -> tuple[Array, Array]:
    """Pinned joints (n, 3), base frame, m, in the configuration of each one's image, and their
    pixels (n, 2).
    """
    joints = [pin for pin in request.pins if pin.end != "axis"]
    ends = [_place_on_leg(content, request, pin)[0] for pin in joints]
    pixels = [pin.pixel for pin in joints]
    return np.array(ends).reshape(-1, 3), np.array(pixels, dtype=float).reshape(-1, 2)


def place_of(T_camera_base: Array) -> dict[str, list[float]]:
    """Pose in the form of session.yaml, with the digits that are written there."""
    from pkmcal.placement.stations import StationPose

    return StationPose.of(T_camera_base).rounded(STATION_POSE_DECIMALS)


def pin_distances(
    content: SessionContent, request: ViewRequest, T_camera_base: Array
) -> tuple[Array, Array]:
    """Distances (n,), px, of what was pinned at a pose (4, 4) from where it was placed, and their
    standard deviations (n,), px: by hand, by the nominal model's tolerance and, of a leg, by its
    width.
    """
    pane = pane_of(content, request)
    camera, tolerance = pane.camera, pane.machine.document.tolerance.center
    distances, sigmas = np.zeros((2, len(request.pins)))
    for k, pin in enumerate(request.pins):
        points = apply(T_camera_base, _place_on_leg(content, request, pin))
        visible = camera.project(points)
        away = np.nan_to_num(np.hypot(*(visible - pin.pixel).T), nan=UNSEEN_JOINT_PIXELS)
        nearest = int(np.argmin(away))
        tubes = pane.machine.document.legs[pin.leg - 1].tubes if pin.end == "axis" else ()
        spread = np.hypot(tolerance, max((tube.radius for tube in tubes), default=0.0))
        # pixels of the spread, across the line of sight
        shifted = camera.project(points[nearest] + spread * np.eye(3)[0])
        distances[k] = away[nearest]
        sigmas[k] = np.nan_to_num(np.hypot(*(shifted - visible[nearest])))
    return distances, np.hypot(sigmas, PINNED_JOINT_SIGMA)


def _place_on_leg(content: SessionContent, request: ViewRequest, pin: Pin) -> Array:
    """Points (n, 3) of which one was pinned, base frame, m, in the configuration of the pin's
    image: a joint's centre, or points along a leg.

    Raises InputError for a leg that the machine lacks.
    """
    base, platform = pane_of(content, request.model_copy(update={"image": pin.image})).points
    if pin.leg > len(base):
        where = f"the page, pins[{request.pins.index(pin) + 1}]"
        raise InputError("there is no such leg", where=where, found=pin.leg)
    along = {"base": [0.0], "platform": [1.0], "axis": np.linspace(0, 1, AXIS_POINTS)}[pin.end]
    a, b = base[pin.leg - 1], platform[pin.leg - 1]
    return a + np.array(along)[:, None] * (b - a)


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
