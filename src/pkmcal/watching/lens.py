"""What a camera whose picture became larger would do to what was measured.

Focus, temperature and a lens that was touched change the focal length first. Its effect on edges
and boards is not a machine's, but some of it looks like one; so it is a cause beside the legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.measurements import Measurements, Observation

FOCAL = ("focal.x", "focal.y")


def magnified(
    measurements: Measurements, observation: Observation, cameras: Sequence[Camera]
) -> Measurements:
    """The measurements with one more unknown a camera: the excess of its focal lengths over the
    calibrated ones, relative.

    cameras : (S,) of the stations that have one, which come first. Edges get their answer by the
    pixels that support them; a board's pose has it by its corners.
    """
    number = np.asarray(measurements.camera_of_station)
    n_cameras = int(number.max(initial=-1)) + 1
    poses = measurements.poses
    return replace(
        measurements,
        edges=replace(measurements.edges, by_intrinsics=_edges(observation, cameras)[..., None]),
        poses=replace(poses, by_intrinsics=_poses(measurements, cameras)[..., None]),
        intrinsics_factor=np.ones((n_cameras, 1, 1)),
        intrinsics_at=np.zeros((n_cameras, 1)),
    )


def _focal(camera: Camera) -> Array:
    """Change (n,) of the parameters when the focal lengths grow by their own size."""
    focal = np.isin(np.array(camera.parameter_names), FOCAL)
    return np.where(focal, camera.parameters, 0.0)


def _edges(observation: Observation, cameras: Sequence[Camera]) -> Array:
    """Turns (N, 2) of the measured normals, their pixels held, by the relative excess.

    A plane that holds the rays r has ``r . n = 0``; as rays turn by dr, ``r . dn = -n . dr``, least
    squares over an edge's points.
    """
    edges, at = observation.edges, observation.point_edge
    ray, turn = np.zeros((2, len(at), 3))
    for station, camera in enumerate(cameras):
        mine = edges.station[at] == station
        ray[mine] = camera.ray(observation.points[mine])
        by = camera.ray_jacobians(observation.points[mine])[1]
        turn[mine] = by @ _focal(camera)
    good = np.isfinite(ray + turn).all(axis=1)
    rows = np.einsum("ni,nij->nj", ray[good], edges.basis[at[good]])
    value = -np.einsum("ni,ni->n", turn[good], edges.normal[at[good]])
    normal, right = np.zeros((len(edges), 2, 2)), np.zeros((len(edges), 2))
    np.add.at(normal, at[good], rows[:, :, None] * rows[:, None])
    np.add.at(right, at[good], rows * value[:, None])
    return (np.linalg.pinv(normal, hermitian=True) @ right[..., None])[..., 0]


def _poses(measurements: Measurements, cameras: Sequence[Camera]) -> Array:
    """Changes (N, 6) of the boards' poses, corners held, by the relative excess; a tracker's 0."""
    poses = measurements.poses
    out = np.zeros((len(poses), 6))
    if not poses.by_intrinsics.shape[-1]:
        return out
    for station, camera in enumerate(cameras):
        mine, focal = poses.station == station, _focal(camera)
        out[mine] = poses.by_intrinsics[mine, :, : len(focal)] @ focal
    return out
