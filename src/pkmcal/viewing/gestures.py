"""Poses adjusted by mouse in an image: the change of T_camera_base by a gesture.

A pull turns the camera about its own centre, so that the point taken hold of stays under the
mouse, at any distance and with any camera model. Turn, roll and distance are about the machine's
middle. The four gestures together cover the six degrees of freedom of a pose.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply, pose, rotation

PINNED_JOINT_SIGMA = 2.0
"""Standard deviation of a joint placed by hand, px."""
HAND_POSE_SIGMA = np.radians(6.0)
"""Standard deviation of a pose set by hand: of aim, roll and turns, rad, and of the distance,
relative. A rough pose is asked for within 10 degrees, the norm over three axes."""
PINNING_ROUNDS = 4
"""Repetitions in which the result replaces the hand-set pose as the mean of the prior.

The prior then affects only what the joints leave undetermined.
"""
LEAST_DEPTH = 0.05
"""Third coordinate of a unit ray below which a ray, 87 degrees off the axis, has no usable point in
the plane before the camera."""
UNSEEN_JOINT_PIXELS = 1e3
"""Residual, px, of a joint that does not project into the image."""


def aimed(camera: Camera, T_camera_base: Array, start: Array, end: Array) -> Array:
    """Pose that moves what is seen at pixel ``start`` (2,) to pixel ``end`` (2,)."""
    return _about_camera(_shortest(camera, start, end)) @ T_camera_base


def turned_as_ball(
    camera: Camera, T_camera_base: Array, points: Array, start: Array, end: Array
) -> Array:
    """Pose with the machine turned about its middle, as a ball that is rolled by its near side.

    points : (n, 3) points of the machine, base frame, m, which the ball contains.
    """
    middle = apply(T_camera_base, points.mean(axis=0))
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    angle = _shortest(camera, start, end) * np.linalg.norm(middle) / radius
    return _about(-angle, middle) @ T_camera_base


def rolled(camera: Camera, T_camera_base: Array, points: Array, start: Array, end: Array) -> Array:
    """Pose with the machine turned about the line of sight to its middle.

    The angle is that of the pull about this line.
    """
    middle = apply(T_camera_base, points.mean(axis=0))
    axis = middle / np.linalg.norm(middle)
    before, after = (ray - (ray @ axis) * axis for ray in _rays(camera, start, end))
    angle = np.arctan2(axis @ np.cross(before, after), before @ after)
    return _about_camera(angle * axis) @ T_camera_base


def farther(camera: Camera, T_camera_base: Array, points: Array, at: Array, factor: float) -> Array:
    """Pose with the machine at ``factor`` times the distance.

    The machine moves along the view ray of pixel ``at`` (2,).
    """
    away = float(np.linalg.norm(apply(T_camera_base, points.mean(axis=0))))
    ray = np.nan_to_num(camera.ray(at))
    return pose(np.eye(3), (factor - 1) * away * ray) @ T_camera_base


def pinned(
    camera: Camera, T_camera_base: Array, points: Array, pins: Array, pixels: Array
) -> Array:
    """Pose that brings joints to given pixels in images of one station.

    One joint aims the camera; two also set roll and distance, both exactly; three or more adjust
    all six degrees of freedom by least squares with a prior at T_camera_base.

    points : as in :func:`turned_as_ball`.
    pins : (n, 3) joint centres, base frame, m, in the configuration of each one's image.
    pixels : (n, 2).
    """
    if len(pins) == 1:
        visible = camera.project(apply(T_camera_base, pins[0]))
        return aimed(camera, T_camera_base, visible, pixels[0])
    from scipy.optimize import least_squares

    freedoms = 4 if len(pins) == 2 else 6

    # two joints fix aim, roll and distance exactly; more are fitted together with the prior
    def misfit(shifted: Callable[[Array], Array]) -> Callable[[Array], Array]:
        """Residuals as a function of x in prior sigmas.

        The prior takes part from three joints on.
        """

        def rows(x: Array) -> Array:
            visible = camera.project(apply(shifted(x * HAND_POSE_SIGMA), pins))
            off = (
                np.nan_to_num(visible - pixels, nan=UNSEEN_JOINT_PIXELS).ravel()
                / PINNED_JOINT_SIGMA
            )
            return off if freedoms == 4 else np.concatenate([off, x])

        return rows

    for _ in range(1 if freedoms == 4 else PINNING_ROUNDS):
        shifted = _motion(T_camera_base, points)
        with np.errstate(over="ignore"):  # a pixel may be kilometres away
            x = least_squares(misfit(shifted), np.zeros(freedoms)).x
        T_camera_base = shifted(x * HAND_POSE_SIGMA)
    return T_camera_base


def triangle_poses(camera: Camera, pins: Array, pixels: Array) -> Array:
    """Poses (k, 4, 4), up to four, that bring three joints exactly to their pixels: those of n
    joints that span the largest triangle in the image. None for fewer than three joints.

    pins : (n, 3), base frame, m. pixels : (n, 2).
    """
    import cv2

    rays = camera.ray(pixels)
    triples = [
        list(k) for k in combinations(range(len(pins)), 3) if (rays[list(k), 2] > LEAST_DEPTH).all()
    ]
    if not triples:
        return np.empty((0, 4, 4))
    plane = rays[..., :2] / rays[..., 2:]
    widest = max(triples, key=lambda k: abs(np.linalg.det(plane[k[1:]] - plane[k[0]])))
    _, turns, shifts = cv2.solveP3P(
        pins[widest], plane[widest], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
    )
    turn, shift = (np.array(part, dtype=float).reshape(-1, 3) for part in (turns, shifts))
    poses = pose(rotation(turn), shift)
    # the mirror images of poses, behind the camera, solve the same equations
    before_camera = apply(poses[:, None], pins[widest])[..., 2] > 0
    return poses[before_camera.all(axis=1)]


def _motion(T_camera_base: Array, points: Array) -> Callable[[Array], Array]:
    """Pose as a function of up to six numbers.

    Aim and roll (3, rad, about the camera), logarithm of the distance, and turns about the
    machine's middle (2, rad, across the line of sight).
    """
    middle = apply(T_camera_base, points.mean(axis=0))
    sight = middle / np.linalg.norm(middle)
    # two axes across the line of sight
    across = np.linalg.svd(sight[None])[2][1:]

    def shifted(x: Array) -> Array:
        """Pose at x, (4,) or (6,)."""
        turn = x[4:] @ across if len(x) > 4 else np.zeros(3)
        near = pose(np.eye(3), (np.exp(x[3]) - 1) * middle)
        return _about_camera(x[:3]) @ near @ _about(turn, middle) @ T_camera_base

    return shifted


def _rays(camera: Camera, start: Array, end: Array) -> Array:
    """View rays (2, 3) of two pixels; the optical axis twice if one of them has no ray."""
    rays = camera.ray(np.stack([start, end]))
    return rays if np.isfinite(rays).all() else np.tile([0.0, 0.0, 1.0], (2, 1))


def _shortest(camera: Camera, start: Array, end: Array) -> Array:
    """Rotation vector (3,) that turns the ray of one pixel to that of the other."""
    before, after = _rays(camera, start, end)
    axis = np.cross(before, after)
    sine = float(np.linalg.norm(axis))
    return axis / sine * np.arctan2(sine, before @ after) if sine else np.zeros(3)


def _about_camera(omega: Array) -> Array:
    """Rotation about the camera's centre, (4, 4)."""
    return pose(rotation(omega), np.zeros(3))


def _about(omega: Array, middle: Array) -> Array:
    """Rotation about a point of the camera frame, (4, 4)."""
    rot = rotation(omega)
    return pose(rot, middle - rot @ middle)
