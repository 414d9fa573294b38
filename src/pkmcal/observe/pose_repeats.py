"""Repeated photographs of a board that stands still in each configuration: one pose of several.

[C] averages the photographs of a configuration. What differs between them (the picture's noise, a
floor that shakes) averages out, and its size is told by their scatter; what they share (the lens,
the board's print) does not. So with n repeats of which each has the covariance C, of it the share
c in common, and which scatter with the covariance S about their mean,

    covariance of the mean = c C + max(S, (1 - c) C) / n.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.observe.edges import Rejection
from pkmcal.observe.poses import PoseSet
from pkmcal.observe.repeats import Groups, groups_of
from pkmcal.observe.targets import BoardViews, moving_poses, pose_set

MOST_COMMON = 0.99
ODD = "the board lies {:.1f} standard deviations from where the repeats show it"
FAR = 5.0
"""Standard deviations (of six numbers: root mean square) of a repeat from the middle one beyond
which it is not one of them."""


class MeanPoses(NamedTuple):
    """One pose a configuration, (G,); which repeats took part (N,), and how far each lies off (N,),
    in standard deviations.
    """

    first: Integers
    pose: Array
    covariance: Array
    used: Booleans
    off: Array


def mean_poses(configuration: Integers, T: Array, covariance: Array, common: float) -> MeanPoses:
    """The mean pose of each configuration's repeats.

    configuration : (N,). T : (N, 4, 4). covariance : (N, 6, 6), left perturbation. common : share
    of it that the repeats have in common.
    """
    groups = groups_of(configuration)
    delta = pose_difference(T, T[groups.first[groups.member]])
    off = _distance(delta - groups.median(delta)[groups.member], covariance)
    # Of two that differ nobody knows which is wrong, so both stay and their scatter tells.
    used = (off < FAR * max(1.0, _usual(off, groups))) | (groups.count[groups.member] < 3)
    kept = groups_of(configuration[used])
    delta, covariance_used = delta[used], covariance[used]
    mean, stated = kept.mean(delta), kept.mean(covariance_used)
    alone = (1 - common) * stated
    rest = delta - mean[kept.member]
    freedom = float(np.sum(kept.count - 1))
    spread = 1.0
    if freedom:
        size = np.sum(_distance(rest, alone[kept.member]) ** 2)
        spread = max(float(size) / freedom, 1.0)
    total = common * stated + spread * alone / kept.count[:, None, None]
    first = np.flatnonzero(used)[kept.first]
    reference = T[groups.first[groups.member]][used][kept.first]
    return MeanPoses(first, perturb(reference, mean), total, used, off)


def _distance(delta: Array, covariance: Array) -> Array:
    """Root mean square (N,) of six numbers (N, 6) in standard deviations."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), delta[..., None])[..., 0]
    return np.sqrt(np.mean(white**2, axis=-1))


def _usual(off: Array, groups: Groups) -> float:
    """The middle distance of repeats from their median, where there are several."""
    several = groups.count[groups.member] > 2
    return float(np.median(off[several])) if several.any() else 1.0


def one_a_configuration(seen: BoardViews, mount: int) -> tuple[PoseSet, tuple[Rejection, ...]]:
    """A board on the platform: one measurement a configuration, and the repeats that are odd."""
    kept = np.flatnonzero(seen.usable)
    rows = seen.configuration[seen.shown[kept]]
    if not len(kept):
        return moving_poses(seen, mount), ()
    sigma2 = float(np.median(seen.views.sigma[seen.views.seen]) ** 2)
    noise2 = seen.poses.noise**2
    common = min(noise2 / (noise2 + sigma2), MOST_COMMON)
    found = mean_poses(rows, seen.poses.T_camera_board[kept], seen.poses.covariance[kept], common)
    odd = tuple(
        seen.rejection(int(seen.shown[kept[k]]), ODD.format(found.off[k]))
        for k in np.flatnonzero(~found.used)
    )
    poses = pose_set(seen.station, rows[found.first], mount, found.pose, found.covariance)
    by = groups_of(rows[found.used]).mean(seen.poses.by_intrinsics[kept[found.used]])
    return replace(poses, by_intrinsics=by), odd
