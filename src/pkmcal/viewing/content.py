"""Contents of a session's page: its images, and its calibration if there is one.

An image is decoded, and anything computed from it, only when it is displayed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.file_names import CALIBRATION_DOCUMENT_FILE
from pkmcal.cameras import Camera, load_camera
from pkmcal.cameras.files import written_camera
from pkmcal.cameras.response import Response
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.rigid import inverse
from pkmcal.mechanisms import Machine
from pkmcal.observe.images import decode, upright_turns
from pkmcal.session.image_files import Image, label_of
from pkmcal.session.load import Session, Station
from pkmcal.viewing.stored_pages import FileState, file_state

if TYPE_CHECKING:
    from pkmcal.boards.board import Board, Detection
    from pkmcal.calibration.saved_calibration import SavedCalibration
    from pkmcal.observe.pose_likelihood import StationView

DECODED_IMAGES_CACHED = 16
"""Decoded images in the cache, for going back and forth between a few of them."""
IMAGE_JPEG_QUALITY = 95
"""Quality of images that are inspected to single pixels."""
THUMBNAIL_WIDTH, THUMBNAIL_JPEG_QUALITY = 180, 75


@dataclass(frozen=True)
class Pane:
    """Machine in front of a camera: the overlay of one image.

    joints : (m,) readings.
    T_base_platform, T_camera_base : (4, 4).
    response : tone curve of the image.
    """

    machine: Machine
    camera: Camera
    joints: Array
    T_base_platform: Array
    T_camera_base: Array
    response: Response

    @property
    def points(self) -> Array:
        """Joint centres (2, L, 3) on base and platform, base frame, m."""
        machine = self.machine
        ends = machine.ends_at(self.joints, self.T_base_platform)
        return np.stack([ends.a, ends.b])


class SessionContent:
    """Session and, if there is one, its calibration, as its files are at each request.

    calibration : folder into which `pkmcal calibrate` writes, None for none.
    """

    def __init__(self, session: Session, calibration: Path | None) -> None:
        self.session = session
        self._calibration = calibration
        self._read_calibration = lru_cache(1)(self._read)
        self.image = lru_cache(DECODED_IMAGES_CACHED)(self._image)
        self.corners = lru_cache(DECODED_IMAGES_CACHED)(self._corners)
        self.start = cache(self._start)
        self.thumbnail = cache(self._thumbnail)
        # by station, of Fit: the data of its search, and the poses (H, 4, 4) found everywhere
        self.views: dict[int, StationView] = {}
        self.poses_anywhere: dict[int, Array] = {}

    def station(self, s: int) -> Station:
        """Station by its index. Raises InputError for an index out of range."""
        if not 0 <= s < len(self.session.stations):
            raise InputError("there is no such station", found=s + 1)
        return self.session.stations[s]

    def set_pose(self, s: int, T_camera_base: Array) -> None:
        """Replace a station's pose, which was written into session.yaml."""
        stations = list(self.session.stations)
        stations[s] = replace(stations[s], T_camera_base=T_camera_base)
        self.session = replace(self.session, stations=tuple(stations))

    def image_entry(self, s: int, k: int) -> Image:
        """Image of a station by its index. Raises InputError for an index out of range."""
        images = self.station(s).images
        if not 0 <= k < len(images):
            raise InputError(f"station {self.station(s).name} has no such image", found=k + 1)
        return images[k]

    def _image(self, s: int, k: int) -> Integers:
        """Image as grey levels (height, width). Raises InputError as `decode`."""
        path = self.image_entry(s, k).path
        return decode(path, self.station(s).camera.image_size, label_of(self.session.folder, path))

    def jpeg(self, s: int, k: int) -> bytes:
        """Image as JPEG with all its pixels."""
        from pkmcal.observe.jpegs import coded

        return coded(self.image(s, k), IMAGE_JPEG_QUALITY)

    def _thumbnail(self, s: int, k: int) -> bytes:
        """Small JPEG of an image, upright."""
        from pkmcal.observe.jpegs import coded, narrowed

        turns = upright_turns(self.image_entry(s, k).path, self.station(s).camera.image_size)
        upright = np.ascontiguousarray(np.rot90(self.image(s, k), -turns))
        return coded(narrowed(upright, THUMBNAIL_WIDTH), THUMBNAIL_JPEG_QUALITY)

    def nominal(self, s: int, k: int) -> Pane:
        """Nominal machine in front of a station's camera.

        The camera is at the station's pose, or at a default pose without one.
        """
        row, station = self.image_entry(s, k).configuration, self.station(s)
        machine, joints = self.session.machine, self.session.joints[row]
        T_camera_base = station.T_camera_base
        T_camera_base = self.start(s) if T_camera_base is None else T_camera_base
        return Pane(
            machine, station.camera, joints, self.poses[row], T_camera_base, station.response
        )

    def _start(self, s: int) -> Array:
        """Default T_camera_base (4, 4) of a station without a pose.

        The camera faces the machine, far enough away to have all of it in the image.
        """
        from pkmcal.placement.stations import default_stations

        machine, camera = self.session.machine, self.station(s).camera
        (place,) = default_stations(machine, (camera,), np.random.default_rng(0))
        return place.T_camera_base()

    @cached_property
    def poses(self) -> Array:
        """T_base_platform (K, 4, 4) by the nominal model.

        The nearest pose where its loops do not close.
        """
        try:
            return self.session.forward.T_base_platform
        except GeometryError as error:  # the nominal model is the user's file
            raise error.as_input(self.session.document["mechanism"]) from None

    def calibrated(self, s: int, k: int) -> Pane:
        """Calibrated machine in front of the camera.

        With the estimated pose, intrinsics and focal scale of the station. Raises InputError if
        the calibration is of another session or lacks the station.
        """
        saved, row, station = self.saved, self.image_entry(s, k).configuration, self.station(s)
        number = self.number(s)
        T_camera_base = inverse(saved.stations[number].T_base_camera)
        response = saved.document["stations"][number].get("response") or station.response
        pose, joints = saved.T_base_platform[row], saved.joints[row]
        camera = self.calibrated_camera(s)
        return Pane(saved.machine, camera, joints, pose, T_camera_base, response)

    def calibrated_camera(self, s: int) -> Camera:
        """Camera of a station with the intrinsics and the focal scale of the calibration."""
        saved, station = self.saved, self.station(s)
        refined = saved.path.parent / written_camera(station.camera_file)
        camera = load_camera(refined) if refined.is_file() else station.camera
        # breathing: the station's own focal length differs from the camera file's
        excess = saved.document["stations"][self.number(s)].get("focal_scale", 1.0) - 1.0
        return replace(camera, parameters=camera.parameters + excess * camera.focal_part)

    @property
    def calibration(self) -> Path | None:
        """Folder of the calibration, None without one."""
        folder = self._calibration
        return folder if folder and (folder / CALIBRATION_DOCUMENT_FILE).is_file() else None

    @property
    def saved(self) -> SavedCalibration:
        """Calibration. Raises InputError if there is none, or if it is of another session."""
        folder = self._calibration
        return self._read_calibration(folder and file_state(folder / CALIBRATION_DOCUMENT_FILE))

    def _read(self, _state: FileState) -> SavedCalibration:
        """Calibration in the present state of its file."""
        from pkmcal.calibration.saved_calibration import load

        if self.calibration is None:
            raise InputError(
                "there is no calibration of this session",
                where=str(self._calibration or self.session.folder),
                next_step="Run pkmcal calibrate, or name its folder with --calibration",
                code="calibration.missing",
            )
        saved = load(self.calibration)
        # the same configurations with the same readings: otherwise poses belong to other images
        same = saved.configurations == self.session.configurations
        if not same or not np.allclose(saved.joints, self.session.joints):
            raise InputError(
                "this is the calibration of another session, or the readings changed since",
                where=str(saved.path),
                expected=f"the configurations and readings of {self.session.folder}",
                next_step="Calibrate again, or name another folder with --calibration",
                code="calibration.another_session",
            )
        return saved

    def number(self, s: int) -> int:
        """Index of a station in the calibration, which may have excluded some.

        Raises InputError for a station that the calibration lacks.
        """
        names = [station.name for station in self.saved.stations]
        if (name := self.station(s).name) not in names:
            raise InputError(
                f"the calibration has no station {name}: it was left out, or added since",
                where=str(self.saved.path),
                code="calibration.no_station",
            )
        return names.index(name)

    @cached_property
    def _board(self) -> Board | None:
        from pkmcal.boards.stations import board_of

        return board_of(self.session)

    def _corners(self, s: int, k: int) -> Detection | None:
        """Detection of the board in an image; None for a station that does not observe a board."""
        from pkmcal.boards.find import detect_board

        if self._board is None or "board" not in self.station(s).observe:
            return None
        return detect_board(self.image(s, k), self._board)
