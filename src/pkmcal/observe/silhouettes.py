"""Coarse edges of a whole machine in one image, by distances of its silhouettes from image edges.

The log-likelihood of a pose (:mod:`pkmcal.observe.pose_likelihood`) uses distances of predicted
silhouettes from image edges. The same distances, weighted by the posterior probability that the
edge is the machine's and not a chance match, give a measured edge for each side of a tube, to a
pixel. In a cluttered image of polished legs these are three times as many edges as can be measured
one by one, enough to determine the machine together with the camera poses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.observe.legs import OTHER_OUTLINE_CLEARANCE, StationEdges
from pkmcal.observe.pose_likelihood import StationView, first_mixture, linearize_distances
from pkmcal.observe.predict import edge_points, legs_in_camera, unobstructed
from pkmcal.observe.profiles import edge_set, fit_edges

SILHOUETTE_SAMPLES = 40
"""Points along an edge at which distances are looked up."""
LEAST_OWN = 0.05
"""Least posterior probability of a point that is used: less likely ones have little weight, and
with a higher limit edges come and go between measurement passes."""
WIDEST_SCATTER = 2.0
"""Largest scatter (reduced px) of silhouettes about image edges, where the machine is predicted to
a few pixels."""


def silhouette_edges(
    view: StationView, T_camera_base: Array, station: int, refine_camera: bool = False
) -> StationEdges:
    """Edges of one image near a camera pose (4, 4).

    view : of this image alone. refine_camera : with derivatives by the camera's parameters.
    """
    tubes = view.tubes
    linearization = linearize_distances(
        view, T_camera_base[None], np.zeros(1, dtype=int), SILHOUETTE_SAMPLES
    )
    distances = linearization.distances
    mixture = distances.mixture(first_mixture(1), 10, WIDEST_SCATTER)
    legs = legs_in_camera(view.machine, T_camera_base, view.poses, view.joints)
    points = edge_points(view.machine, view.camera, legs, tubes, SILHOUETTE_SAMPLES)
    clear = unobstructed(view.machine, view.camera, legs, tubes, points, OTHER_OUTLINE_CLEARANCE)
    scale = view.tables.scale
    # how a distance grows as the edge moves outward by a pixel of the tables
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.nan_to_num(np.clip(linearization.slope * scale / points.gain, -1, 1))
    position = -scale * distances.distance * np.sign(slope)
    weight = distances.own(mixture) * slope**2
    valid = clear & (distances.length > 0) & (weight > LEAST_OWN)
    position = np.where(valid, position, 0.0)
    sigma = scale * mixture.sigma[:, None, None] / np.sqrt(np.where(valid, weight, 1.0))
    fits = fit_edges(points, position, sigma, valid)
    by_camera = view.camera.project_jacobians(points.point)[1] if refine_camera else None
    names = np.array([station]), view.configuration
    edges = edge_set(points, fits, tubes, *names, fits.good, by_camera)
    edges = replace(edges, coarse=np.ones(len(edges), dtype=bool))
    k, e, s = np.nonzero(fits.used & fits.good[..., None])
    xy = points.pixel[k, e, s] + position[k, e, s, None] * points.outward[k, e, s]
    number = np.cumsum(fits.good.ravel()).reshape(fits.good.shape) - 1
    return StationEdges(edges, (), xy, number[k, e], float("nan"), float("nan"))
