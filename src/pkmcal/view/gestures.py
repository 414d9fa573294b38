"""Poses moved by hand in a photograph: what a pull of the mouse does to T_camera_base.

A pull turns the camera about its own centre, so that whatever was taken hold of stays under the
mouse, near or far, with every camera model. Turns, rolls and the distance are about the machine's
middle. Four such motions make all six freedoms of a pose.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply, pose, rotation

PINNED_JOINT_SIGMA = 2.0
"""Pixels (standard deviation) to which a hand puts a joint."""
HAND_POSE_SPREAD = np.array([*np.full(3, np.radians(6.0)), 0.1, *np.full(2, np.radians(6.0))])
"""Standard deviations of a pose by hand about which three joints or more move: aim and roll, the
distance's share, turns. It only decides what the joints leave open."""
PINNING_ROUNDS = 4
"""Times that the pose by hand is replaced by what was found, so that it pulls at nothing else."""
UNSEEN_JOINT_PIXELS = 1e3
"""Pixels by which a joint that has no picture counts as off."""


def aimed(camera: Camera, T_camera_base: Array, start: Array, end: Array) -> Array:
    """The pose in which what was seen at pixel ``start`` (2,) is seen at ``end``."""
    return _about_camera(_shortest(camera, start, end)) @ T_camera_base


def turned_as_ball(
    camera: Camera, T_camera_base: Array, points: Array, start: Array, end: Array
) -> Array:
    """The machine turned about its middle as a ball that is rolled by its near side.

    points : (n, 3) of the machine, base frame, m; the ball holds them.
    """
    middle = apply(T_camera_base, points.mean(axis=0))
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    angle = _shortest(camera, start, end) * np.linalg.norm(middle) / radius
    return _about(-angle, middle) @ T_camera_base


def rolled(camera: Camera, T_camera_base: Array, points: Array, start: Array, end: Array) -> Array:
    """The machine turned about the line of sight to its middle, by the angle that is pulled."""
    middle = apply(T_camera_base, points.mean(axis=0))
    axis = middle / np.linalg.norm(middle)
    before, after = (ray - (ray @ axis) * axis for ray in _rays(camera, start, end))
    angle = np.arctan2(axis @ np.cross(before, after), before @ after)
    return _about_camera(angle * axis) @ T_camera_base


def farther(camera: Camera, T_camera_base: Array, points: Array, at: Array, factor: float) -> Array:
    """The machine at ``factor`` times the distance, moved along the view ray of a pixel (2,)."""
    away = float(np.linalg.norm(apply(T_camera_base, points.mean(axis=0))))
    ray = np.nan_to_num(camera.ray(at))
    return pose(np.eye(3), (factor - 1) * away * ray) @ T_camera_base


def pinned(
    camera: Camera, T_camera_base: Array, points: Array, pins: Array, pixels: Array
) -> Array:
    """The pose that brings joints to their places in photographs of one station.

    points : as :func:`turned_as_ball`. pins : (n, 3) joint centres, base frame, each as its
    photograph's configuration has it. pixels : (n, 2). One joint aims the camera; two also roll and
    bring nearer, both exactly; from three on least squares move all six freedoms, near
    T_camera_base where the joints leave them open.
    """
    if len(pins) == 1:
        visible = camera.project(apply(T_camera_base, pins[0]))
        return aimed(camera, T_camera_base, visible, pixels[0])
    from scipy.optimize import least_squares

    count = 4 if len(pins) == 2 else 6
    spread = HAND_POSE_SPREAD[:count]

    def misfit(shifted: Callable[[Array], Array]) -> Callable[[Array], Array]:
        def rows(x: Array) -> Array:
            visible = camera.project(apply(shifted(x * spread), pins))
            off = (
                np.nan_to_num(visible - pixels, nan=UNSEEN_JOINT_PIXELS).ravel()
                / PINNED_JOINT_SIGMA
            )
            return off if count == 4 else np.concatenate([off, x])

        return rows

    for _ in range(1 if count == 4 else PINNING_ROUNDS):
        shifted = _motion(T_camera_base, points)
        with np.errstate(over="ignore"):  # of a pixel that is kilometres away
            x = least_squares(misfit(shifted), np.zeros(count)).x
        T_camera_base = shifted(x * spread)
    return T_camera_base


def _motion(T_camera_base: Array, points: Array) -> Callable[[Array], Array]:
    """A pose by up to six numbers: aim and roll (3, rad, about the camera), the distance's
    logarithm, and turns about the machine's middle (2, rad, across the line of sight).
    """
    middle = apply(T_camera_base, points.mean(axis=0))
    sight = middle / np.linalg.norm(middle)
    across = np.linalg.svd(sight[None])[2][1:]

    def shifted(x: Array) -> Array:
        turn = x[4:] @ across if len(x) > 4 else np.zeros(3)
        near = pose(np.eye(3), (np.exp(x[3]) - 1) * middle)
        return _about_camera(x[:3]) @ near @ _about(turn, middle) @ T_camera_base

    return shifted


def _rays(camera: Camera, start: Array, end: Array) -> Array:
    """View rays (2, 3) of two pixels; the first twice where one has none."""
    rays = camera.ray(np.stack([start, end]))
    return rays if np.isfinite(rays).all() else np.tile([0.0, 0.0, 1.0], (2, 1))


def _shortest(camera: Camera, start: Array, end: Array) -> Array:
    """Rotation vector (3,) that turns the one pixel's ray to the other's."""
    before, after = _rays(camera, start, end)
    axis = np.cross(before, after)
    sine = float(np.linalg.norm(axis))
    return axis / sine * np.arctan2(sine, before @ after) if sine else np.zeros(3)


def _about_camera(omega: Array) -> Array:
    return pose(rotation(omega), np.zeros(3))


def _about(omega: Array, middle: Array) -> Array:
    """A turn about a point of the camera frame."""
    rot = rotation(omega)
    return pose(rot, middle - rot @ middle)
