"""[A] 3.2, step 1 of four: joint centres and revolute axes from the legs' axes.

Both are least-squares estimates from the constraints of a joint on its leg's axis: the axis passes
through the centre ([A] 6) and is perpendicular to a revolute joint's axis ([A] 7). The same
functions serve the camera frame (step 1) and the platform frame (step 4).

Arrays: B runs, C images (one station, one configuration each), L legs, S stations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, dot
from pkmcal.levels import NEGLIGIBLE
from pkmcal.measurements import EdgeSet, Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import joint_values
from pkmcal.solver.kernels import INLIER_WEIGHT

ONE_DIRECTION = 1e-6
"""Ratio of eigenvalues below which a leg has a single direction, so that its centre is
unidentifiable."""
REVOLUTE_WEIGHT_ROUNDS = 3
"""Iterations for the weights of a revolute axis's equations; they change little after the first."""
ONE_PLANE = NEGLIGIBLE**2
"""Ratio of eigenvalues below which a revolute axis is unidentifiable: directions within 10 mrad of
each other, where noise dominates."""


@dataclass(frozen=True)
class Axes:
    """Leg axes from images, camera frame.

    station, configuration : (C,) of each image.
    visible : (C, L).
    u, point : (B, C, L, 3) direction from A to B, and any point of the axis (m).
    readings : (B, C, L).
    information : (B, C, L, 3, 3) information of each direction up to a common factor, used where
        several images show the same leg; None for equal weights.
    """

    station: Integers
    configuration: Integers
    visible: Booleans
    u: Array
    point: Array
    readings: Array
    information: Array | None = None

    def of_legs(self, legs: Integers) -> Axes:
        """Axes of some legs."""
        return replace(
            self,
            visible=self.visible[:, legs],
            u=self.u[:, :, legs],
            point=self.point[:, :, legs],
            readings=self.readings[:, :, legs],
            information=None if self.information is None else self.information[:, :, legs],
        )

    def of_runs(self, runs: Integers) -> Axes:
        """Axes of some runs."""
        return replace(
            self,
            u=self.u[runs],
            point=self.point[runs],
            readings=self.readings[runs],
            information=None if self.information is None else self.information[runs],
        )


def across_directions(u: Array) -> Array:
    """Projections I - u u^T (..., 3, 3) on the planes across unit directions (..., 3)."""
    return np.eye(3) - u[..., :, None] * u[..., None, :]


def nearest_points(
    u: Array, point: Array, visible: Booleans, group: Integers, n_groups: int
) -> tuple[Array, Booleans]:
    """[A] 6: point nearest to a leg's axes, sum (I - u u^T)(M - A) = 0.

    The printed form, AM x u = 0 for all images by SVD, is the same least squares with dependent
    equations. u, point : (B, C, L, 3) in the frames of ``group`` (C,). Returns A (B, G, L, 3) and
    (G, L) whether the leg has two directions.
    """
    project = np.where(visible[..., None, None], across_directions(u), 0.0)
    right = (project @ np.where(visible[..., None], point, 0.0)[..., None])[..., 0]
    of_group = (group == np.arange(n_groups)[:, None]).astype(float)
    normal = np.einsum("sc,bclij->bslij", of_group, project)
    right = np.einsum("sc,bcli->bsli", of_group, right)
    values = np.linalg.eigvalsh(normal)
    value = np.all(values[..., 0] > ONE_DIRECTION * values[..., 2], axis=0)
    normal = np.where(value[..., None, None], normal, np.eye(3))
    return np.linalg.solve(normal, right[..., None])[..., 0], value


def centres_from_axes(axes: Axes, n_stations: int) -> tuple[Array, Booleans]:
    """Step 1, [A] 6, for the base centres in the stations' camera frames.

    Returns A (B, S, L, 3) and (S, L) whether each centre is identifiable.
    """
    return nearest_points(axes.u, axes.point, axes.visible, axes.station, n_stations)


def revolute_axes(
    u: Array,
    visible: Booleans,
    group: Integers,
    n_groups: int,
    information: Array | None = None,
) -> tuple[Array, Booleans]:
    """[A] 7: axis that is perpendicular to all directions of a leg, v . u = 0, by SVD.

    u : (B, C, L, 3) in the frames of ``group`` (C,). Returns unit v (B, G, L, 3), of either sign,
    and (G, L) whether each is identifiable, which takes two different directions of the leg.
    information : (B, C, L, 3, 3) of the directions. A direction is much less accurate along the
    line of sight than across it; with the information, each equation is weighted by its noise along
    v.
    """
    of_group = (group == np.arange(n_groups)[:, None]).astype(float)
    u = np.where(visible[..., None], u, 0.0)

    def least_along(weight: Array) -> tuple[Array, Array]:
        """Eigenvalues and -vectors of the weighted sum of u u^T in each group."""
        weighted = np.where(visible, weight, 0.0)[..., None] * u
        normal = np.einsum("sc,bcli,bclj->bslij", of_group, weighted, u, optimize=True)
        return np.linalg.eigh(normal)

    values, vectors = least_along(np.ones(u.shape[:-1]))
    fixed = np.all(values[..., 1] > ONE_PLANE * values[..., 2], axis=0)
    if information is not None:
        # covariances of the directions across themselves, up to a common factor
        size = np.trace(information, axis1=-2, axis2=-1)[..., None, None]
        determined = visible[..., None, None] & (size > 0)
        along = size * (u[..., :, None] * u[..., None, :])
        covariance = np.linalg.inv(np.where(determined, information + along, np.eye(3)))
        for _ in range(REVOLUTE_WEIGHT_ROUNDS):
            v = np.einsum("sc,bsli->bcli", of_group, vectors[..., 0])
            noise = dot(v, (covariance @ v[..., None])[..., 0])
            vectors = least_along(1 / np.maximum(noise, 1e-300))[1]
    return vectors[..., 0], fixed


def plane_normals(
    u: Array,
    visible: Booleans,
    group: Integers,
    n_groups: int,
    information: Array | None = None,
) -> tuple[Array, Booleans]:
    """[A] 7 for a planar machine, whose joints have a common axis: the normal of its plane.

    u : (B, C, L, 3) directions, all legs together. Returns (B, G, 1, 3) and (G, 1).
    """
    n = (u.shape[0], u.shape[1] * u.shape[2], 1)
    flat = None if information is None else information.reshape(*n, 3, 3)
    legs = np.repeat(group, u.shape[2])
    return revolute_axes(u.reshape(*n, 3), visible.reshape(-1, 1), legs, n_groups, flat)


def in_base(axes: Axes, T_camera_base: Array) -> Axes:
    """Directions in the base frame, one row for each configuration, without points.

    T_camera_base : (B, S, 4, 4). A leg that several stations see in one configuration gets the
    weighted mean direction: the minimum of u^T (sum R^T W R) u over the images, with their
    information W.
    """
    # directions in the base frame, one group of images for each configuration
    rot = T_camera_base[:, axes.station, None, :3, :3]
    back = rot.mT
    u = np.where(axes.visible[..., None], (back @ axes.u[..., None])[..., 0], 0.0)
    names, first, row = np.unique(axes.configuration, return_index=True, return_inverse=True)
    member = (row == np.arange(len(names))[:, None]).astype(float)
    count = member @ axes.visible
    total = np.einsum("kc,bcli->bkli", member, u)
    # weighted mean direction of legs with several images
    info = None
    if count.max(initial=0) > 1 or axes.information is not None:
        info = across_directions(axes.u) if axes.information is None else axes.information
        info = np.where(axes.visible[..., None, None], back @ info @ rot, 0.0)
        info = np.einsum("kc,bclij->bklij", member, info)
        joined = np.linalg.eigh(info)[1][..., 0]
        joined = joined * np.where(dot(joined, total) < 0, -1.0, 1.0)[..., None]
        total = np.where((count > 1)[..., None], joined, total)
    none = np.zeros(len(names), dtype=int)
    return Axes(none, names, count > 0, total, 0.0 * total, axes.readings[:, first], info)


def axes_from_edges(machine: Machine, measurements: Measurements, weights: Array) -> Axes:
    """Leg axes of a session (B = 1) from the inlier edges, [A] 4-5.

    The direction is the smallest eigenvector of the normals' scatter, over all edges of the leg in
    an image; edges of both sides are required, because one side leaves the direction undetermined.
    weights : (N,).
    """
    edges, n_legs = measurements.edges, machine.n_legs
    radius = machine.radii_of(edges.leg, edges.tube)
    # groups: one for each leg and image
    photo, index = np.unique(
        edges.station * len(measurements.joints) + edges.configuration, return_inverse=True
    )
    group, n = index * n_legs + edges.leg, len(photo) * n_legs
    # normal equations of each group, and the mean normals of both sides
    weight = np.where(
        weights >= INLIER_WEIGHT, 1 / np.trace(edges.covariance, axis1=1, axis2=2), 0.0
    )
    weighted = weight[:, None] * edges.normal
    information, right, sides = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((2, n, 3))
    np.add.at(information, group, weighted[:, :, None] * edges.normal[:, None])
    np.add.at(right, group, -radius[:, None] * weighted)
    np.add.at(sides, (edges.side, group), weighted)
    visible: Booleans = np.all(np.linalg.norm(sides, axis=-1) > 0, axis=0)
    total = np.maximum(np.bincount(group, weight, n), 1e-300)
    # direction: smallest eigenvector; its sign from the two sides, u = n1 x n0
    normal = np.where(visible[:, None, None], information / total[:, None, None], np.eye(3))
    u = np.linalg.eigh(normal)[1][..., 0]
    u = u * np.where(dot(u, cross(sides[1], sides[0])) < 0, -1.0, 1.0)[:, None]
    # n.M = -R in the plane across the axis, and u.M = 0
    fixed = normal + u[:, :, None] * u[:, None, :]
    point = np.linalg.solve(fixed, (right / total[:, None])[..., None])[..., 0]
    station, configuration = np.divmod(photo, len(measurements.joints))
    full = (1, len(photo), n_legs)
    return Axes(
        station,
        configuration,
        visible.reshape(full[1:]),
        u.reshape(*full, 3),
        point.reshape(*full, 3),
        joint_values(machine.layout, machine.values, measurements.joints[configuration])[None],
        information.reshape(*full, 3, 3),
    )


def through_centres(machine: Machine, edges: EdgeSet, centres: Array) -> EdgeSet:
    """Edges constrained to their base centre, n.A = -R, by the smallest Mahalanobis change.

    A centre is estimated from all configurations, so the constraint removes most of an edge's tilt
    error. centres : (S, L, 3) m, camera frames; edges of a NaN centre are unchanged.
    """
    a = centres[edges.station, edges.leg]
    finite: Booleans = np.all(np.isfinite(a), axis=-1)
    a = np.where(finite[:, None], a, 0.0)
    along = edges.basis.mT @ a[..., None]
    gain = edges.covariance @ along
    spread = np.maximum((along.mT @ gain)[..., 0], 1e-300)
    miss = np.where(finite, dot(edges.normal, a) + machine.radii_of(edges.leg, edges.tube), 0.0)
    change = (edges.basis @ gain)[..., 0] * (miss[:, None] / spread)
    normal = edges.normal - change
    return replace(edges, normal=normal / np.linalg.norm(normal, axis=-1, keepdims=True))
