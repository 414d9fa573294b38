"""Selection of holdout configurations, and the estimate without them.

Holdout configurations are spread over the workspace, or fill a region of it. The predictions of the
calibrated machine for them are judged in :mod:`pkmcal.judge.holdouts`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.refinement import RefinementResult
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import Measurements, Observation
from pkmcal.mechanisms import Machine
from pkmcal.session.load import SESSION_FILE_NAME, Session
from pkmcal.session.readings import same_pose
from pkmcal.wording import count, listed

FEWEST_TO_CALIBRATE = 3
"""Fewest configurations from which a calibration is meaningful. Whether it is, its own verdict
decides; not checked with other numbers."""

MOST_CLUSTERING_ROUNDS = 100
"""Upper bound of the k-means iterations."""
TIE = 1e-6
"""Difference of distances, as a share of the points' extent, that counts as none."""
NAMED_REGION_OFFSET = 3**-0.5
"""Offset of a region from the middle, in standard deviations of the whole workspace, from which a
direction is part of its name: a third of half the range of evenly spread configurations."""
REGION_DIRECTION_NAMES = (
    ("turned about −x", "turned about +x"),
    ("turned about −y", "turned about +y"),
    ("turned about −z", "turned about +z"),
    ("towards −x", "towards +x"),
    ("towards −y", "towards +y"),
    ("low", "high"),
)
"""Names of the negative and the positive direction of each coordinate of
:func:`points_of_poses`."""


@dataclass(frozen=True)
class Neighbours:
    """Configurations near each other.

    rows : (n,) their indices.
    name : their region in words.
    """

    rows: Integers
    name: str


@dataclass(frozen=True)
class Holdout:
    """Configurations that an estimate did not use, to judge it by.

    region : the configurations.
    measurements : of these and of those in use.
    """

    region: Neighbours
    measurements: Measurements


def check_predictable(session: Session) -> None:
    """Raise InputError for a session of which no configuration's readings can be predicted: its
    measurements have fewer numbers than a pose, so the pose follows from its own readings.
    """
    freedoms = session.machine.layout.motion.shape[1]
    measured = sum(len(table.target.known) for table in session.trackers)
    if session.stations or measured >= freedoms:
        return
    kinds = sorted({table.target.label for table in session.trackers})
    raise InputError(
        "readings cannot be predicted: poses follow from their own readings",
        where=str(session.folder / SESSION_FILE_NAME),
        found=f"{listed(kinds) or 'readings'} alone",
        expected=f"stations that measure all {count(freedoms, 'number')} of a pose, by legs, a"
        " board or a tracker's poses",
        next_step="To see whether the machine is as it was, use pkmcal watch with new measurements",
    )


def check_holdout(session: Session, n: int) -> None:
    """Raise InputError, before any image is read, where n poses cannot be held out of a session's
    images (:func:`chosen`): no more poses are measured than there are images of.
    """
    check_predictable(session)
    if session.trackers or session.links:
        return
    rows = sorted({photo.configuration for one in session.stations for photo in one.images})
    total = len(np.unique(same_pose(session.joints[rows], session.joint_noise)))
    _check(n, total - n, total, "configurations held out")


def points_of_poses(machine: Machine, poses: Array) -> Array:
    """Poses (n, 4, 4) as points (n, 6) in metres: rotations times the platform's radius, then
    positions.

    Both are relative to the mean.
    """
    joints = machine.platform_centers()
    radius = float(np.sqrt(np.mean(np.sum((joints - joints.mean(axis=0)) ** 2, axis=1))))
    turns = rotation_vector(poses[:, :3, :3] @ poses[0, :3, :3].T)
    out = np.concatenate([turns * radius, poses[:, :3, 3]], axis=1)
    return out - out.mean(axis=0)


def clusters(points: Array, n: int) -> Integers:
    """Cluster number (k,) of each point: k-means from points far from each other.

    Deterministic: the same points give the same clusters.
    """
    # farthest-point initialization
    centres = points[[int(np.argmax(np.sum(points**2, axis=1)))]]
    for _ in range(n - 1):
        far = _distances(points, centres).min(axis=1)
        centres = np.concatenate([centres, points[[int(np.argmax(far))]]])
    owner = np.argmin(_distances(points, centres), axis=1)
    # Lloyd's iterations
    for _ in range(MOST_CLUSTERING_ROUNDS):
        inside = owner[:, None] == np.arange(n)
        centres = (inside.T @ points) / np.maximum(inside.sum(axis=0), 1)[:, None]
        new = np.argmin(_distances(points, centres), axis=1)
        if np.array_equal(new, owner) or len(np.unique(new)) < n:
            break
        owner = new
    return owner


def spread(points: Array, n: int) -> Integers:
    """Indices of n points, in rising order, spread over all: the middle one of each of n clusters.

    Clusters are those of :func:`clusters`. The two points of a pair are equally far from its
    middle: of points that are equally far, but for rounding, the first is taken.
    """
    owner = clusters(points, n)
    chosen: list[int] = []
    for k in range(n):
        rows = np.flatnonzero(owner == k)
        far = np.linalg.norm(points[rows] - points[rows].mean(axis=0), axis=1)
        nearest = np.isclose(far, far.min(), rtol=0, atol=TIE * np.ptp(points))
        chosen.append(int(rows[np.argmax(nearest)]))
    return np.sort(np.array(chosen))


def regions(points: Array, rows: Integers, n: int) -> tuple[Neighbours, ...]:
    """The n regions of configurations ``rows`` at points (k, 6) of :func:`points_of_poses`."""
    owner = clusters(points, n)
    scale = points.std(axis=0)
    scale = np.where(scale > 1e-6, scale, np.inf)  # a coordinate that is constant
    results = [np.flatnonzero(owner == k) for k in range(n)]
    return tuple(
        Neighbours(rows[own], _named(points[own].mean(axis=0) / scale))
        for own in results
        if own.size
    )


def _named(middle: Array) -> str:
    """Name of a region by the directions of its two largest offsets, (6,) standard deviations."""
    order = np.argsort(-np.abs(middle))[:2]
    words = [
        REGION_DIRECTION_NAMES[k][int(middle[k] > 0)]
        for k in order
        if abs(middle[k]) > NAMED_REGION_OFFSET
    ]
    return ", ".join(words) or "the middle"


def _distances(points: Array, centres: Array) -> Array:
    """Squared distances (k, n) between points and centres."""
    return np.sum((points[:, None] - centres) ** 2, axis=-1)


def chosen(nominal: Machine, whole: Estimate, measurements: Measurements, n: int) -> Neighbours:
    """Configurations of n poses to hold out, spread over the workspace.

    All configurations of a pose are held out, because one in use determines the readings of the
    others. Raises InputError if too few poses remain.
    """
    rows, pose = _poses(whole, measurements)
    first, at = np.unique(pose, return_index=True)
    _check(n, first.size - n, first.size, "configurations held out")
    points = points_of_poses(nominal, whole.state.T_base_platform[rows[at]])
    out = np.isin(pose, first[spread(points, n)])
    return Neighbours(rows[out], "spread over the workspace")


def by_region(
    nominal: Machine, whole: Estimate, measurements: Measurements, n: int
) -> tuple[Neighbours, ...]:
    """Measured configurations in n regions of the workspace, all of a pose in the same region.

    Raises InputError if too few poses remain without a region.
    """
    rows, pose = _poses(whole, measurements)
    first, at = np.unique(pose, return_index=True)
    _check(n, first.size - first.size // n, first.size, "regions")
    points = points_of_poses(nominal, whole.state.T_base_platform[rows[at]])
    return tuple(
        replace(region, rows=rows[np.isin(pose, region.rows)])
        for region in regions(points, first, n)
    )


def _poses(whole: Estimate, measurements: Measurements) -> tuple[Integers, Integers]:
    """Indices (n,) of the measured configurations, and the pose number (n,) of each."""
    rows = np.flatnonzero(whole.configurations)
    if not rows.size:
        return rows, rows
    return rows, same_pose(measurements.joints[rows], measurements.joint_noise)


def _check(n: int, remainder: int, total: int, what: str) -> None:
    """Raise InputError if holding out n poses or regions of a total leaves too few poses to
    calibrate.
    """
    if (
        n >= 1
        and remainder >= max(FEWEST_TO_CALIBRATE, total // 2)
        and not (what == "regions" and n < 2)
    ):
        return
    least = 2 if what == "regions" else 1
    most = total if what == "regions" else total - max(FEWEST_TO_CALIBRATE, total // 2)
    if most < least:
        raise InputError(
            "there are too few configurations to hold any out",
            found=f"{count(total, 'pose')} seen",
            expected=f"{2 * FEWEST_TO_CALIBRATE} at least; configurations whose readings"
            " are equal within their noise are of one pose",
            next_step="Take images of more configurations",
        )
    raise InputError(
        f"this number of {what} is not possible",
        found=str(n),
        expected=f"{least} to {most}, for {count(total, 'pose')} seen",
    )


def select(measurements: Measurements, keep: Booleans) -> Measurements:
    """Measurements of some configurations, ``keep`` (K,); rows of the readings are kept.

    Links remain if both of their configurations do. Boards on the base belong to no configuration
    and remain.
    """
    edges, poses = measurements.edges, measurements.poses
    on_base = ~measurements.on_platform[poses.mount]
    return replace(
        measurements.with_links(measurements.links_among(keep)),
        edges=edges.select(keep[edges.configuration]),
        poses=poses.select(keep[poses.configuration] | on_base),
    )


def estimate_without(
    nominal: Machine, turns: RefinementResult, out: Neighbours
) -> RefinementResult:
    """Result of the last measurement pass without the configurations of a region.

    The configurations took part in predicting where legs are in the images; they contribute no
    measurement to the estimate.
    """
    keep = np.ones(len(turns.measurements.joints), dtype=bool)
    keep[out.rows] = False
    measurements = select(turns.measurements, keep)
    return turns._replace(
        observation=replace(_without(turns.observation, keep), poses=measurements.poses),
        measurements=measurements,
        estimate=bundle(nominal, measurements, turns.estimate.state),
    )


def _without(observation: Observation, keep: Booleans) -> Observation:
    """Observation of the configurations to keep, (K,), with edges renumbered."""
    retained = keep[observation.edges.configuration]
    points = retained[observation.point_edge]
    numbers = np.cumsum(retained) - 1
    return replace(
        observation,
        edges=observation.edges.select(retained),
        rejected=tuple(r for r in observation.rejected if keep[r.configuration]),
        points=observation.points[points],
        point_edge=numbers[observation.point_edge[points]],
    )
