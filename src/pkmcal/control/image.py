"""What the camera of a simulated loop measures: edges with noise, and whether legs are in view.

The edges are those that :mod:`pkmcal.observe.predict` expects, each with a sideways error and a
tilt in pixels as :class:`pkmcal.simulation.edges.EdgeNoise` has them; places a few along each edge,
because a loop runs a hundred thousand samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras import Camera
from pkmcal.control.seen import SeenMachine, visible_tubes
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot
from pkmcal.observe.predict import (
    EdgePoints,
    TubeList,
    edge_points,
    legs_in_camera,
    tubes_of,
    unobstructed,
)
from pkmcal.simulation.edges import EdgeNoise

PLACES = 5
"""Places along an edge; more change its noise by less than a tenth."""
IN_VIEW = 0.5
"""Part of a leg's edge that must be in the image; with less, a tracker has lost it."""


@dataclass(frozen=True)
class Eye:
    """The true machine before the true camera. tubes : the edges that are measured, E = 2 s, leg
    by leg in the order of ``true.legs``.
    """

    true: SeenMachine
    camera: Camera
    tubes: TubeList

    @classmethod
    def of(cls, true: SeenMachine, camera: Camera) -> Eye:
        """The edges of one tube a leg."""
        every = tubes_of(true.machine)
        chosen = visible_tubes(true.machine, true.legs)
        rows = [
            int(np.flatnonzero((every.leg == j) & (every.tube == t) & (every.side == side))[0])
            for j, t in zip(true.legs, chosen, strict=True)
            for side in (0, 1)
        ]
        picked = np.array(rows)
        tubes = TubeList(
            every.leg[picked], every.tube[picked], every.side[picked],
            every.start[picked], every.stop[picked], every.radius[picked],
        )  # fmt: skip
        return cls(true, camera, tubes)

    def points(self, poses: Array, readings: Array, places: int = PLACES) -> EdgePoints:
        """Places (R, E, n) along the edges at poses (R, 4, 4) and readings (R, m)."""
        legs = legs_in_camera(self.true.machine, self.true.T_camera_base, poses, readings)
        return edge_points(self.true.machine, self.camera, legs, self.tubes, places)

    def in_view(self, points: EdgePoints) -> Booleans:
        """(R, s) legs of which enough is in the image."""
        with np.errstate(invalid="ignore"):
            inside = points.valid & self.camera.in_image(points.pixel)
        share = inside.mean(axis=-1)
        return (share >= IN_VIEW).reshape(*share.shape[:-1], -1, 2).all(axis=-1)

    def hidden(self, poses: Array, readings: Array) -> Booleans:
        """(R, s) legs of which more than half stands behind another leg."""
        machine = self.true.machine
        legs = legs_in_camera(machine, self.true.T_camera_base, poses, readings)
        points = edge_points(machine, self.camera, legs, self.tubes, PLACES)
        clear = unobstructed(machine, self.camera, legs, self.tubes, points, 0.0)
        with np.errstate(invalid="ignore"):
            inside = points.valid & self.camera.in_image(points.pixel, margin=4.0)
        share = (inside & ~clear).mean(axis=-1)
        return (share > 1 - IN_VIEW).reshape(*share.shape[:-1], -1, 2).any(axis=-1)

    def normals(self, points: EdgePoints, noise: EdgeNoise, rng: np.random.Generator) -> Array:
        """Measured normals (R, s, 2, 3), camera frame."""
        shape = (*points.normal.shape[:-2], -1, 2, 3)
        if not (noise.shift or noise.tilt or noise.outward):
            return points.normal.reshape(shape)
        by_shift, by_tilt, basis = responses(points)
        error = rng.standard_normal((*by_shift.shape[:-1], 2)) * (noise.shift, noise.tilt)
        turn = by_shift * (error[..., :1] + noise.outward) + by_tilt * error[..., 1:]
        normal = points.normal + (basis @ turn[..., None])[..., 0]
        return (normal / np.sqrt(dot(normal, normal))[..., None]).reshape(shape)


def responses(points: EdgePoints) -> tuple[Array, Array, Array]:
    """Turns (R, E, 2) of the normals when an edge moves outward by one pixel everywhere, and when
    its far end moves out and its near end in; and the bases (R, E, 3, 2) that they are told in.
    """
    middle = points.point[..., points.point.shape[-2] // 2, :]
    basis = tangent_basis(points.normal, middle / np.sqrt(dot(middle, middle))[..., None])
    rows = np.nan_to_num(points.by_normal() @ basis)
    step = np.diff(np.nan_to_num(points.pixel), axis=-2)
    run = np.concatenate(
        [np.zeros((*step.shape[:-2], 1)), np.cumsum(np.sqrt(dot(step, step)), axis=-1)], axis=-1
    )
    tilt = 2 * run / np.maximum(run[..., -1:], 1e-300) - 1
    value = np.stack([np.ones(tilt.shape), tilt], axis=-1)
    turned = rows.mT
    normal = turned @ rows + 1e-300 * np.eye(2)
    gone = np.abs(np.linalg.det(normal)) < 1e-200  # no place of the edge has an image
    solved = np.linalg.solve(np.where(gone[..., None, None], np.eye(2), normal), turned @ value)
    return solved[..., 0], solved[..., 1], basis
