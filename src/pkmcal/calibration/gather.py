"""What a session's photographs and tables measured, put together; cameras refined with it.

A camera's intrinsics, where they are refined, are those of its calibration plus F u: F F^T is the
calibration's covariance, and the u are unknowns of the estimate with unit variance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards.views import Boards
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet, Measurements, Mount, concatenate
from pkmcal.session.load import Session


@dataclass(frozen=True)
class CameraRefinement:
    """The cameras of a session and where their refinement stands.

    files, calibrated : names and cameras as calibrated, C of them. factor : (C, n, r) the F above,
    r = 0 where cameras are held. at : (C, r).
    """

    files: tuple[str, ...]
    calibrated: tuple[Camera, ...]
    factor: Array
    at: Array

    @property
    def active(self) -> bool:
        """Whether there is anything to refine."""
        return self.factor.shape[-1] > 0

    def camera(self, file: str) -> Camera:
        """A camera with its intrinsics at the present place."""
        camera = self.calibrated[self.files.index(file)]
        if not self.active:
            return camera
        change = self.change(file)[: len(camera.parameters)]
        return replace(camera, parameters=camera.parameters + change)

    def change(self, file: str) -> Array:
        """What the intrinsics have changed by so far, (n,), as wide as the widest camera's."""
        number = self.files.index(file)
        return self.factor[number] @ self.at[number]

    def moved(self, estimate: Estimate) -> CameraRefinement:
        """The refinement after an estimate."""
        if estimate.state.intrinsics.shape != self.at.shape:
            return self
        return replace(self, at=self.at + estimate.state.intrinsics)

    def result(self, estimate: Estimate, file: str) -> Camera:
        """A camera as the last estimate has it, with its covariance."""
        camera = self.moved(estimate).camera(file)
        if not self.active:
            return camera
        covariance = estimate.intrinsics_covariance[self.files.index(file)]
        n = len(camera.parameters)
        return replace(camera, covariance=covariance[:n, :n])


def refinement_of(session: Session, refine: bool) -> CameraRefinement:
    """The session's cameras, held or to be refined; an InputError where one has no covariance."""
    cameras = {s.camera_file: s.camera for s in session.stations}
    files, calibrated = tuple(cameras), tuple(cameras.values())
    if not refine:
        held = np.zeros((len(files), 0, 0))
        return CameraRefinement(files, calibrated, held, np.zeros((len(files), 0)))
    if not cameras:
        raise InputError(
            "no station has a camera whose intrinsics could be refined",
            where="session.yaml, stations",
            next_step="Leave --refine-camera out",
        )
    roots = [covariance_root(file, camera) for file, camera in cameras.items()]
    n, r = (max(root.shape[k] for root in roots) for k in (0, 1))
    factor = np.stack([np.pad(f, ((0, n - len(f)), (0, r - f.shape[1]))) for f in roots])
    return CameraRefinement(files, calibrated, factor, np.zeros((len(files), r)))


def covariance_root(file: str, camera: Camera) -> Array:
    """F (n, r) of a camera; what its calibration held fixed has no variance and no column."""
    if camera.covariance is None:
        raise InputError(
            "the camera's covariance is not known, so its intrinsics cannot be refined",
            where=file,
            expected="covariance: [[...], ...], as `pkmcal camera` writes it",
            next_step="Calibrate the camera with `pkmcal camera`, or leave --refine-camera out",
        )
    scale = np.sqrt(np.diag(camera.covariance))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(camera.covariance / np.outer(scale, scale))
    used = values > 1e-12 * values[-1]
    return scale[:, None] * vectors[:, used] * np.sqrt(values[used])


def measurements_of(
    session: Session,
    boards: Boards,
    edges: EdgeSet | None = None,
    cameras: CameraRefinement | None = None,
) -> Measurements:
    """What is measured; no cameras at a first look, which is too coarse to refine any."""
    files = [station.camera_file for station in session.stations]
    numbers = {name: k for k, name in enumerate(dict.fromkeys(files))}
    # A tracker has no camera; the first one's number moves nothing of what it measured.
    number = [numbers[name] for name in files] + [0] * len(session.trackers)
    # What targets are fixed to: the board, then each tracker's own.
    mounts = [Mount("board", boards.body)] if boards.stations else []
    poses = boards.poses
    if cameras is not None and cameras.active:
        poses = poses.moved(np.stack([cameras.change(s.camera_file) for s in session.stations]))
    sets = [poses]
    for k, table in enumerate(session.trackers, start=len(session.stations)):
        sets.append(table.poses(k, len(mounts)))
        mounts.append(Mount(table.name, "platform"))
    measurements = Measurements(
        edges=EdgeSet.empty() if edges is None else edges,
        joints=session.joints,
        joint_noise=session.joint_noise,
        n_stations=len(number),
        camera_of_station=np.array(number, dtype=int),
        poses=concatenate(sets),
        mounts=tuple(mounts),
    )
    if cameras is None or not cameras.files:
        return measurements
    return replace(
        measurements,
        intrinsics_factor=cameras.factor,
        intrinsics_at=cameras.at,
        shaded=len(measurements.edges) > 0,
    )
