"""Measurements of a session as one set, and the refinement of its cameras.

The intrinsics of a refined camera are those of its calibration plus F u, where F F^T is the
calibration's covariance, and u are unknowns of the estimate with unit variance. The focal length of
a hand-held camera changes with the focus ("breathing"): each of its images has an unknown relative
excess of the focal lengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.boards.views import Boards
from pkmcal.calibration.reading_effects import effects_of_session
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import (
    BOARD_MOUNT_NAME,
    EdgeSet,
    LinkSet,
    Measurements,
    Mount,
    Observation,
    Set,
    concatenate,
)
from pkmcal.measurements.effects import FOCAL_EXCESS, INTRINSICS
from pkmcal.session.load import Session


@dataclass(frozen=True)
class CameraRefinement:
    """Cameras of a session, and the present state of their refinement.

    files, calibrated : names and cameras as calibrated, C of them.
    factor : (C, n, r) F, r = 0 where cameras are held.
    at : (C, r) u.
    of_station : (S,) file of each station's camera.
    breathes : (S,) whether the station is a hand-held image.
    breath : (S,) relative excess of its focal lengths.
    """

    files: tuple[str, ...]
    calibrated: tuple[Camera, ...]
    factor: Array
    at: Array
    of_station: tuple[str, ...]
    breathes: Booleans
    breath: Array

    __repr__ = short_repr

    @property
    def refined(self) -> bool:
        """Whether any camera's intrinsics are refined."""
        return self.factor.shape[-1] > 0

    @property
    def refines_all(self) -> bool:
        """Whether every camera's intrinsics are refined."""
        return self.refined and bool(np.any(self.factor != 0, axis=(1, 2)).all())

    @property
    def active(self) -> bool:
        """Whether intrinsics of a camera, or the focal length of an image, are refined."""
        return self.refined or bool(self.breathes.any())

    def camera(self, file: str) -> Camera:
        """Camera with its present intrinsics."""
        camera = self.calibrated[self.files.index(file)]
        if not self.refined:
            return camera
        change = self.change(file)[: len(camera.parameters)]
        return replace(camera, parameters=camera.parameters + change)

    def at_station(self, number: int) -> Camera:
        """Camera of a station, with the focal lengths of its image if it is hand-held."""
        camera = self.camera(self.of_station[number])
        excess = self.breath[number] * camera.focal_part
        return replace(camera, parameters=camera.parameters + excess)

    def of(self, stations: Integers) -> CameraRefinement:
        """Refinement of some of the stations, by their numbers."""
        return replace(
            self,
            of_station=tuple(self.of_station[k] for k in stations),
            breathes=self.breathes[stations],
            breath=self.breath[stations],
        )

    def change(self, file: str) -> Array:
        """Change of a camera's intrinsics so far, (n,), padded to the widest camera's."""
        number = self.files.index(file)
        return self.factor[number] @ self.at[number]

    def updated(self, estimate: Estimate) -> CameraRefinement:
        """The refinement after an estimate."""
        columns, at, breath = estimate.state.columns, self.at, self.breath
        if INTRINSICS in columns:
            at = at + columns[INTRINSICS].reshape(at.shape)
        if FOCAL_EXCESS in columns:
            breath = breath + columns[FOCAL_EXCESS][: len(breath)]
        return replace(self, at=at, breath=breath)

    def result(self, estimate: Estimate, file: str) -> Camera:
        """Camera by an estimate, with its covariance."""
        camera = self.updated(estimate).camera(file)
        if not self.refined:
            return camera
        n, number, r = len(camera.parameters), self.files.index(file), self.at.shape[1]
        own = slice(number * r, (number + 1) * r)
        covariance = estimate.column_covariance[INTRINSICS][own, own]
        covariance = self.factor[number] @ covariance @ self.factor[number].T
        return replace(camera, covariance=covariance[:n, :n])


def edges_by_camera(observation: Observation, cameras: Sequence[Camera]) -> Array:
    """Derivative (N, 2, n) of the measured normals by their camera's parameters, at fixed pixels.

    A plane that contains the rays r has ``r . n = 0``; as rays rotate by dr, ``r . dn = -n . dr``,
    in least squares over the pixels that support an edge.

    cameras : (S,) of the stations that have one, which come first; n parameters of the widest
        model.
    """
    edges, at = observation.edges, observation.point_edge
    widest = max((len(camera.parameters) for camera in cameras), default=0)
    ray, turn = np.zeros((len(at), 3)), np.zeros((len(at), 3, widest))
    for station, camera in enumerate(cameras):
        mine = edges.station[at] == station
        ray[mine] = camera.ray(observation.points[mine])
        turn[mine, :, : len(camera.parameters)] = camera.ray_jacobians(observation.points[mine])[1]
    good = np.isfinite(ray).all(axis=1) & np.isfinite(turn).all(axis=(1, 2))
    rows = np.einsum("ni,nij->nj", ray[good], edges.basis[at[good]])
    value = -np.einsum("nip,ni->np", turn[good], edges.normal[at[good]])
    normal, right = np.zeros((len(edges), 2, 2)), np.zeros((len(edges), 2, widest))
    np.add.at(normal, at[good], rows[:, :, None] * rows[:, None])
    np.add.at(right, at[good], rows[:, :, None] * value[:, None])
    return np.linalg.pinv(normal, hermitian=True) @ right


def refinement_of(session: Session, refine: bool) -> CameraRefinement:
    """Cameras of the session, held or to be refined; raises InputError if there are none.

    A camera with intrinsics by EXIF alone is refined in any case.
    """
    cameras = {s.camera_file: s.camera for s in session.stations}
    rough = {s.camera_file for s in session.stations if s.from_exif}
    files, calibrated = tuple(cameras), tuple(cameras.values())
    breathes = np.array([station.handheld for station in session.stations], dtype=bool)
    stations = tuple(s.camera_file for s in session.stations), breathes, np.zeros(len(breathes))
    if not refine and not rough:
        held = np.zeros((len(files), 0, 0))
        return CameraRefinement(files, calibrated, held, np.zeros((len(files), 0)), *stations)
    if not cameras:
        raise InputError(
            "no station has a camera whose intrinsics could be refined",
            where="session.yaml, stations",
            next_step="Leave --refine-camera out",
            code="camera.none_to_refine",
        )
    roots = [
        covariance_root(camera)
        if refine or file in rough
        else np.zeros((len(camera.parameters), 0))
        for file, camera in cameras.items()
    ]
    n, r = (max(root.shape[k] for root in roots) for k in (0, 1))
    factor = np.stack([np.pad(f, ((0, n - len(f)), (0, r - f.shape[1]))) for f in roots])
    return CameraRefinement(files, calibrated, factor, np.zeros((len(files), r)), *stations)


def covariance_root(camera: Camera) -> Array:
    """Root F (n, r) of a camera's covariance.

    Parameters that its calibration held have no variance and no column. A camera whose file states
    no covariance has a default one.
    """
    stated = camera.covariance
    covariance = camera.usual_covariance() if stated is None else stated
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    used = values > 1e-12 * values[-1]
    return scale[:, None] * vectors[:, used] * np.sqrt(values[used])


def measurements_of(
    session: Session,
    boards: Boards,
    edges: EdgeSet | None = None,
    cameras: CameraRefinement | None = None,
    estimate: Estimate | None = None,
) -> Measurements:
    """Measurements of a session's images and tables, by the present cameras.

    cameras : None for the first, coarse estimate, which cannot refine any.
    estimate : earlier estimate, at whose machine and poses the effects on the readings are
        evaluated; None for the nominal ones.
    """
    # Mounts: the board, then each tracker's target, then the points of links.
    mounts = [Mount(BOARD_MOUNT_NAME, boards.body, boards.tolerance)] if boards.stations else []
    poses, edges = boards.poses, EdgeSet.empty() if edges is None else edges
    # Changes of the cameras so far: poses are transformed to first order.
    focal_at = np.zeros(0)
    if cameras is not None and cameras.active and session.stations:
        if cameras.breathes.any():
            poses, edges = _with_focal(poses, cameras), _with_focal(edges, cameras)
            focal_at = np.pad(cameras.breath, (0, len(session.trackers)))
        change = [
            cameras.at_station(k).parameters - session.stations[k].camera.parameters
            for k in range(len(session.stations))
        ]
        widest = max(len(part) for part in change)
        poses = poses.transform(np.stack([np.pad(x, (0, widest - len(x))) for x in change]))
    # Trackers and links, each with a mount of its own.
    sets = [poses]
    for k, table in enumerate(session.trackers, start=len(session.stations)):
        sets.append(table.poses(k, len(mounts)))
        mounts.append(Mount(table.name, "platform"))
    links: list[LinkSet] = []
    for one in session.links:
        links.append(one.at_mount(len(mounts)))
        mounts.append(Mount(one.kind, "platform"))
    effects = effects_of_session(session, estimate)
    measurements = Measurements(
        edges=edges,
        joints=sum((effect.correction for effect in effects), session.joints),
        joint_noise=session.joint_noise,
        n_stations=len(session.station_names),
        camera_of_station=session.camera_of_station,
        poses=concatenate(sets),
        mounts=tuple(mounts),
        links=tuple(links),
        effects=effects,
        level=np.array(
            [False] * len(session.stations) + [table.level for table in session.trackers],
            dtype=bool,
        ),
    )
    if cameras is None or not cameras.files:
        return measurements
    return replace(
        measurements,
        intrinsics_factor=cameras.factor,
        intrinsics_at=cameras.at,
        shaded=len(measurements.edges) > 0,
        focal_at=focal_at,
    )


def _with_focal(measured: Set, cameras: CameraRefinement) -> Set:
    """Measurements with their derivative by the excess of each image's focal lengths."""
    each = [
        cameras.camera(file) if breathes else None
        for file, breathes in zip(cameras.of_station, cameras.breathes, strict=True)
    ]
    return replace(measured, by_focal=by_focal(measured.by_intrinsics, measured.station, each))


def by_focal(by: Array, station: Integers, cameras: Sequence[Camera | None]) -> Array:
    """Derivative (N, d) of measurements by the relative excess of the focal lengths.

    by : (N, d, n) derivative by the parameters of their camera.
    station : (N,); the result is zero for stations without a camera.
    """
    focal = np.zeros((int(station.max(initial=-1)) + 1, by.shape[-1]))
    for k, camera in enumerate(cameras[: len(focal)]):
        if camera is not None and by.shape[-1]:
            part = camera.focal_part
            focal[k, : len(part)] = part
    return (by @ focal[station][..., None])[..., 0]
