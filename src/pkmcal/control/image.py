"""Simulated camera of a control loop: edges with noise, and whether legs are in view.

The edges are those of :mod:`pkmcal.observe.predict`, each with a sideways error and a tilt in
pixels as in :class:`pkmcal.placement.edges.EdgeNoise`; an edge has few samples, because a loop
runs a hundred thousand images.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras import Camera
from pkmcal.control.machine_view import MachineView, visible_tubes
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot
from pkmcal.levels import MAJORITY
from pkmcal.observe.predict import (
    EdgePoints,
    TubeList,
    edge_points,
    legs_in_camera,
    tubes_of,
    unobstructed,
)
from pkmcal.placement.edges import EdgeNoise, disturbed, responses

IMAGED_EDGE_POINTS = 5
"""Samples along an edge; more samples change its noise by less than a tenth."""


@dataclass(frozen=True)
class Eye:
    """Simulated observation: the true machine in front of the true camera.

    tubes : the edges that are measured, E = 2 s, leg by leg in the order of ``true.legs``.
    """

    true: MachineView
    camera: Camera
    tubes: TubeList

    @classmethod
    def of(cls, true: MachineView, camera: Camera) -> Eye:
        """Eye with both edges of one tube of each leg."""
        every = tubes_of(true.machine)
        chosen = visible_tubes(true.machine, true.legs)
        rows = [
            int(np.flatnonzero((every.leg == j) & (every.tube == t) & (every.side == side))[0])
            for j, t in zip(true.legs, chosen, strict=True)
            for side in (0, 1)
        ]
        picked = np.array(rows)
        return cls(true, camera, TubeList(*(getattr(every, f.name)[picked] for f in fields(every))))

    def points(self, poses: Array, readings: Array, places: int = IMAGED_EDGE_POINTS) -> EdgePoints:
        """Samples (R, E, n) along the edges at poses (R, 4, 4) and readings (R, m)."""
        legs = legs_in_camera(self.true.machine, self.true.T_camera_base, poses, readings)
        return edge_points(self.true.machine, self.camera, legs, self.tubes, places)

    def in_view(self, points: EdgePoints) -> Booleans:
        """(R, s) legs with most of both edges in the image."""
        with np.errstate(invalid="ignore"):
            inside = points.valid & self.camera.in_image(points.pixel)
        share = inside.mean(axis=-1)
        return (share >= MAJORITY).reshape(*share.shape[:-1], -1, 2).all(axis=-1)

    def hidden(self, poses: Array, readings: Array) -> Booleans:
        """(R, s) legs with more than half of an edge behind another leg."""
        machine = self.true.machine
        legs = legs_in_camera(machine, self.true.T_camera_base, poses, readings)
        points = edge_points(machine, self.camera, legs, self.tubes, IMAGED_EDGE_POINTS)
        clear = unobstructed(machine, self.camera, legs, self.tubes, points, 0.0)
        with np.errstate(invalid="ignore"):
            inside = points.valid & self.camera.in_image(points.pixel, margin=4.0)
        share = (inside & ~clear).mean(axis=-1)
        return (share > MAJORITY).reshape(*share.shape[:-1], -1, 2).any(axis=-1)

    def normals(self, points: EdgePoints, noise: EdgeNoise, rng: np.random.Generator) -> Array:
        """Measured normals (R, s, 2, 3), camera frame."""
        shape = (*points.normal.shape[:-2], -1, 2, 3)
        if not (noise.shift or noise.tilt or noise.outward):
            return points.normal.reshape(shape)
        by_shift, by_tilt, basis = edge_responses(points)
        return disturbed(points.normal, basis, by_shift, by_tilt, noise, rng).reshape(shape)


def edge_responses(points: EdgePoints) -> tuple[Array, Array, Array]:
    """Rotations (R, E, 2) of the normals by a shift and by a tilt of one pixel, and their bases.

    The rotations are those of :func:`pkmcal.placement.edges.responses`, in the bases (R, E, 3, 2).
    """
    middle = points.point[..., points.point.shape[-2] // 2, :]
    basis = tangent_basis(points.normal, middle / np.sqrt(dot(middle, middle))[..., None])
    return *responses(points.by_normal() @ basis, points.pixel), basis
