"""Coarse edges of a whole machine in one image: its silhouettes, fitted to nearby image edges.

Candidate poses are compared by the distances of the machine's silhouettes from image edges
(:mod:`pkmcal.observe.pose_likelihood`). The same distances, each weighted by the probability that
the image edge belongs to the machine and is not a chance match, locate the silhouettes: one edge
for each side of a tube, to a pixel. In a cluttered image of polished legs this gives three times as
many edges as can be measured individually, and enough to estimate the machine together with the
poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.observe.legs import EDGE_OPTIONS, StationEdges
from pkmcal.observe.pose_likelihood import (
    LIKELIHOOD_OPTIONS,
    StationView,
    first_mixture,
    linearize_distances,
)
from pkmcal.observe.predict import edge_points, legs_in_camera, unobstructed
from pkmcal.observe.profiles import EDGE_FIT_OPTIONS, EdgeFitOptions, edge_set, fit_edges


@dataclass(frozen=True)
class SilhouetteOptions:
    """Constants of the coarse edges of a machine."""

    # number of samples along an edge
    samples: int = 40
    # smallest weight with which a sample is used: lower ones contribute little, and a higher limit
    # would make edges appear and disappear from one measurement pass to the next
    least_weight: float = 0.05
    # largest scatter of silhouettes about image edges, reduced pixels, once the machine is
    # accurate to a few pixels: half of the search's
    widest: float = LIKELIHOOD_OPTIONS.last_reach / 2
    # distance in pixels from the outlines of other legs
    clearance: float = EDGE_OPTIONS.clearance
    # fit of the edges' planes
    fit: EdgeFitOptions = EDGE_FIT_OPTIONS


SILHOUETTE_OPTIONS = SilhouetteOptions()


def silhouette_edges(
    view: StationView,
    T_camera_base: Array,
    station: int,
    refine_camera: bool = False,
    options: SilhouetteOptions = SILHOUETTE_OPTIONS,
) -> StationEdges:
    """Edges of one image, measured from a nearby camera pose (4, 4).

    view : of this image alone.
    station : number of the station in the returned edges.
    refine_camera : also compute the edges' derivatives by the camera's parameters.
    """
    # distances along the predicted silhouettes, and their mixture of own and chance edges
    tubes = view.tubes
    linearization = linearize_distances(
        view, T_camera_base[None], np.zeros(1, dtype=int), options.samples
    )
    distances = linearization.distances
    start = first_mixture(1, view.options)
    mixture = distances.mixture(start, view.options.mixture_rounds, options.widest, view.options)
    legs = legs_in_camera(view.machine, T_camera_base, view.poses, view.joints)
    points = edge_points(view.machine, view.camera, legs, tubes, options.samples)
    clear = unobstructed(view.machine, view.camera, legs, tubes, points, options.clearance)
    scale = view.tables.scale
    # derivative of a distance by an outward motion of the edge, in pixels of the tables
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.nan_to_num(np.clip(linearization.slope * scale / points.gain, -1, 1))
    # outward positions with weights; the slope's square is the information of a distance
    position = -scale * distances.distance * np.sign(slope)
    weight = distances.own(mixture) * slope**2
    valid = clear & (distances.length > 0) & (weight > options.least_weight)
    position = np.where(valid, position, 0.0)
    sigma = scale * mixture.sigma[:, None, None] / np.sqrt(np.where(valid, weight, 1.0))
    # planes through the positions, as measurements marked coarse
    fits = fit_edges(points, position, sigma, valid, options.fit)
    by_camera = view.camera.project_jacobians(points.point)[1] if refine_camera else None
    names = np.array([station]), view.configuration
    edges = edge_set(points, fits, tubes, *names, fits.good, by_camera)
    edges = replace(edges, coarse=np.ones(len(edges), dtype=bool))
    k, e, s = np.nonzero(fits.used & fits.good[..., None])
    xy = points.pixel[k, e, s] + position[k, e, s, None] * points.outward[k, e, s]
    number = np.cumsum(fits.good.ravel()).reshape(fits.good.shape) - 1
    return StationEdges(edges, (), xy, number[k, e], float("nan"), float("nan"))
