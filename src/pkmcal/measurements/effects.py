"""Effects on measurements that every estimate contains, one function for the columns of each.

An effect is a function of the measurements. To add one, append it to :data:`EFFECTS`, or to
``Measurements.effects`` for some measurements only. Columns with a prior become unknowns of the
joint estimate, columns without one are score-tested.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.measurements.columns import Column
from pkmcal.measurements.line_cells import TUBE_CORRELATION
from pkmcal.measurements.poses import PoseSet
from pkmcal.measurements.sets import Effect, Measurements

EDGE_SHIFT, INTRINSICS, SHADING = "camera.edge_shift", "camera.intrinsics", "tube.shading"
FOCAL_EXCESS, BOARD_SIZE = "station.focal", "board.size"
SHIFT_SIGMA = 0.3
"""Standard deviation (px) of a camera's constant edge shift before any data: errata, B."""
FOCAL_SIGMA = 1.5e-3
"""Standard deviation of a hand-held image's focal length, relative to the camera's. A lens of focal
length f that is focused at a distance u forms its image at f u / (u - f): for a telephone (5 mm)
this changes by 0.3 % between 3 m and 1 m, usual distances to a machine; half of that to each
side."""


def edge_shifts(measurements: Measurements) -> Iterator[Column]:
    """Shift of all edges of a camera, px outward."""
    edges = measurements.edges
    camera = np.asarray(measurements.camera_of_station)[edges.station]
    for c in range(measurements.n_cameras):
        own = np.flatnonzero(camera == c)
        by, prior = -edges.shift[own][..., None], np.full((1, 1), SHIFT_SIGMA)
        yield Column(EDGE_SHIFT, str(c), edges=by, edge_rows=own, prior=prior)


def intrinsics(measurements: Measurements) -> Iterator[Column]:
    """Intrinsics of each camera where they are refined, in units of their calibration's
    covariance.
    """
    edges, poses, factor = measurements.edges, measurements.poses, measurements.intrinsics_factor
    if not factor.shape[-1]:
        return
    cameras = np.asarray(measurements.camera_of_station)
    n = poses.by_intrinsics.shape[-1]
    for c, root in enumerate(factor):
        of_edges, of_poses = (np.flatnonzero(cameras[x.station] == c) for x in (edges, poses))
        yield Column(
            INTRINSICS,
            str(c),
            edges=edges.by_intrinsics[of_edges] @ root if len(of_edges) else None,
            edge_rows=of_edges,
            poses=poses.by_intrinsics[of_poses] @ root[:n] if n else None,
            pose_rows=of_poses,
            prior=np.eye(root.shape[1]),
            at=measurements.intrinsics_at[c],
        )


def shading(measurements: Measurements) -> Iterator[Column]:
    """Outward shift of each line (:func:`lines`), in units of its estimated standard deviation.

    Derivatives are by px; ``EdgeData.unit`` contains the standard deviations. Lines of one side of
    a leg at a station have the correlation TUBE_CORRELATION.
    """
    keys, number = lines(measurements)
    if not len(keys):
        return
    order = np.argsort(number, kind="stable")
    first = np.flatnonzero(np.any(np.diff(keys[:, :2], axis=0, prepend=-1), axis=1))
    cuts = np.append(first, len(keys))
    ends = np.searchsorted(number[order], cuts).tolist()
    for k, (start, stop) in enumerate(pairwise(cuts.tolist())):
        own = order[ends[k] : ends[k + 1]]
        side = keys[start:stop, 3]
        correlation = np.where(side[:, None] == side, TUBE_CORRELATION, 0.0)
        np.fill_diagonal(correlation, 1.0)
        station, leg = keys[start, :2].tolist()
        yield Column(
            SHADING,
            f"station {station}, leg {leg}",
            edges=-measurements.edges.shift[own][..., None],
            edge_rows=own,
            edge_numbers=(number[own] - start)[:, None],
            prior=np.linalg.cholesky(correlation),
        )


def focal_lengths(measurements: Measurements) -> Iterator[Column]:
    """Relative excess of the focal lengths of each station whose camera is held by hand."""
    edges, poses = measurements.edges, measurements.poses
    for s, at in enumerate(measurements.focal_at.tolist()):
        of_edges, of_poses = (np.flatnonzero(x.station == s) for x in (edges, poses))
        yield Column(
            FOCAL_EXCESS,
            str(s),
            edges=edges.by_focal[of_edges][..., None],
            edge_rows=of_edges,
            poses=poses.by_focal[of_poses][..., None],
            pose_rows=of_poses,
            prior=np.full((1, 1), FOCAL_SIGMA),
            at=np.array([at]),
        )


def board_sizes(measurements: Measurements) -> Iterator[Column]:
    """Relative excess of the size of each board whose size is not known exactly."""
    for m, mount in enumerate(measurements.mounts):
        if mount.tolerance > 0:
            own, by = by_board_size(measurements.poses, m)
            prior = np.full((1, 1), mount.tolerance)
            yield Column(BOARD_SIZE, mount.name, poses=by, pose_rows=own, prior=prior)


def by_board_size(poses: PoseSet, mount: int) -> tuple[Integers, Array]:
    """Poses (n,) of a board, and their derivatives (n, 6, 1) by the relative excess of its size.

    At given corners in the image, a larger board is farther from the camera by the same ratio.
    """
    own = np.flatnonzero(poses.mount == mount)
    by = np.zeros((len(own), 6, 1))
    by[:, 3:, 0] = poses.T_station_target[own, :3, 3]
    return own, by


EFFECTS: tuple[Effect, ...] = (edge_shifts, intrinsics, shading, focal_lengths, board_sizes)


def columns_of_effects(measurements: Measurements) -> Iterator[Column]:
    """Columns of all effects, those of one code side by side."""
    columns = [one for effect in (*EFFECTS, *measurements.effects) for one in effect(measurements)]
    for code in dict.fromkeys(one.code for one in columns):
        yield from (one for one in columns if one.code == code)


def lines(measurements: Measurements) -> tuple[Integers, Integers]:
    """Lines of the shading: station, leg, tube and side (n, 4) of each, and the number (N,) of each
    edge's line.

    No lines if nothing is shaded. -1 at stations of one image, where each edge is a line of its
    own.
    """
    e = measurements.edges
    if not measurements.shaded or not len(e):
        return np.zeros((0, 4), dtype=int), np.zeros(0, dtype=int)
    number = np.full(len(e), -1)
    # stations with a single configuration, such as hand-held images
    pair = np.unique(np.stack([e.station, e.configuration], axis=1), axis=0)
    many = np.bincount(pair[:, 0], minlength=measurements.n_stations)[e.station] != 1
    keys = np.stack([e.station, e.leg, e.tube, e.side], axis=1)[many]
    keys, own = np.unique(keys, axis=0, return_inverse=True)
    number[many] = own.reshape(-1)
    return keys, number
