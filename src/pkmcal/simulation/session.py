"""Simulated session on disk, with the files that a user would write and a file of the truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.boards.board import Board
from pkmcal.cameras import Camera
from pkmcal.cameras.response import levels_of_light
from pkmcal.errors import GeometryError, InputError
from pkmcal.files import Exif, csv_text, entries, staged_folder, with_exif, yaml_text
from pkmcal.geometry.rigid import pose, rotation
from pkmcal.mechanisms import Machine, mechanism_text
from pkmcal.mechanisms.carriers.contract import PLANAR_MOTIONS
from pkmcal.placement.configurations import check_drawable
from pkmcal.placement.stations import one_a_station
from pkmcal.simulation.board import board_part, holder_part
from pkmcal.simulation.render import PixelRays, Scene, ScenePart, Sensor, render_light, sensor_image
from pkmcal.simulation.scene import Discs, Finish, discs_of, machine_parts, room_of
from pkmcal.simulation.surfaces import SmoothNoise
from pkmcal.simulation.truth import (
    HANDHELD_STATION_NAME,
    TRUTH_FILE,
    Settings,
    Truth,
    draw_truth,
    stream,
    truth_document,
)

ImageProgress = Callable[[int, int], None]
HANDHELD_JPEG_QUALITY = 95
"""Quality of the JPEG files of a hand-held camera, as phones write them."""


def simulate_session(
    folder: Path | str,
    nominal: Machine,
    camera: Camera | Sequence[Camera],
    settings: Settings | None = None,
    *,
    seed: int = 0,
    workers: int = 2,
    progress: ImageProgress | None = None,
) -> Truth:
    """Write a simulated session into a new folder, completely or not at all.

    The truth is written to truth.json.

    camera : one for all stations, or one for each.
    workers : threads that render; the result does not depend on their number.
    progress : called with the number of finished images and of all.

    Raises InputError if the folder is not empty or the machine cannot be rendered.
    """
    settings = settings or Settings()
    folder = Path(folder)
    cameras = one_a_station(camera, settings.n_stations)
    _check(folder, nominal)
    truth = draw_truth(nominal, cameras, settings, seed)
    lenses = cameras
    if truth.focal_scale is not None:
        pairs = zip(cameras, truth.focal_scale, strict=True)
        lenses = tuple(_breathed(one, float(scale)) for one, scale in pairs)
    with staged_folder(folder) as stage:
        _write_texts(stage, nominal, cameras, settings, truth)
        _write_images(stage, lenses, settings, truth, workers, progress)
    return truth


def _breathed(camera: Camera, scale: float) -> Camera:
    """The camera with scaled focal lengths."""
    focal = [name.startswith("focal.") for name in camera.parameter_names]
    return replace(camera, parameters=np.where(focal, scale, 1.0) * camera.parameters)


@dataclass(frozen=True)
class Studio:
    """Everything that the images of one session share.

    cameras : by station.
    views : rays of each camera with more than one image, by the camera's id.
    fixed : parts that are fixed to the base.
    as_built : with motors, rings and cables on the legs.
    """

    truth: Truth
    discs: Discs
    finish: Finish
    room: Scene
    cameras: tuple[Camera, ...]
    views: Mapping[int, PixelRays]
    sensor: Sensor
    fixed: tuple[ScenePart, ...] = ()
    board: Board | None = None
    as_built: bool = False

    @classmethod
    def of(cls, truth: Truth, cameras: Sequence[Camera], settings: Settings) -> Studio:
        """Build the room, and compute each camera's rays once."""
        seeds = stream(truth.seed, "room").spawn(2)
        noise = SmoothNoise.from_rng(np.random.default_rng(seeds[0]))
        discs = discs_of(truth.machine)
        places = np.array([pose.position for pose in truth.rough])
        reach = float(np.linalg.norm(places - discs.base, axis=1).max())
        sense = (places - discs.base).mean(axis=0)
        read = truth.T_platform_board is not None and discs.drives.any
        lit_from = float(np.arctan2(sense[1], sense[0])) if read else None
        rng = np.random.default_rng(seeds[1])
        room = room_of(discs, reach, noise, rng, lit_from, settings.light)
        views: dict[int, PixelRays] = {}
        if truth.focal_scale is None:
            views = {key: PixelRays.of(c) for key, c in {id(c): c for c in cameras}.items()}
        fixed: tuple[ScenePart, ...] = ()
        if settings.board is not None and truth.T_base_board is not None:
            fixed = (board_part(settings.board, truth.T_base_board),)
        flat = truth.machine.document.motion in PLANAR_MOTIONS
        finish = Finish.from_noise(noise, flat, settings.finish)
        board, built, eyes = settings.board, settings.as_built, tuple(cameras)
        return cls(truth, discs, finish, room, eyes, views, settings.sensor, fixed, board, built)

    def images(self, index: int, shake: tuple[float, float] = (0.0, 0.0)) -> list[Integers]:
        """Repeats, 8 bits (H, W) each, of the session's image number ``index``.

        Images of a camera at rest receive the same light and differ by noise only. shake : standard
        deviations of the camera's motion between repeats, m and rad.
        """
        seeds = stream(self.truth.seed, "photographs").spawn(len(self.truth.images))[index]
        children = (seeds, *seeds.spawn(self.truth.repeats - 1))
        rngs = [np.random.default_rng(child) for child in children]
        still = self.truth.T_camera_base[self.truth.images[index, 0]]
        if not any(shake):
            light = self._light(index, still, rngs[0])
            return [sensor_image(light, self.sensor, rng) for rng in rngs]
        # a camera that shakes about its own position
        lights: list[Array] = []
        for rng in rngs:
            turn, move = rng.standard_normal((2, 3))
            motion = pose(rotation(shake[1] * turn), shake[0] * move)
            lights.append(self._light(index, motion @ still, rng))
        return [sensor_image(x, self.sensor, rng) for x, rng in zip(lights, rngs, strict=True)]

    def _light(self, index: int, T_camera_base: Array, rng: np.random.Generator) -> Array:
        """Light (H, W) on a camera at T_camera_base for image number ``index``."""
        station, k = self.truth.images[index]
        poses, joints = self.truth.T_base_platform, self.truth.joints
        parts = machine_parts(
            self.truth.machine, self.discs, self.finish, poses[k], joints[k], self.as_built
        )
        on_platform = self.truth.T_platform_board
        if on_platform is not None and self.board is not None:
            parts.append(board_part(self.board, poses[k] @ on_platform))
            parts.append(holder_part(self.board, on_platform, poses[k], self.discs))
        scene = self.room.having([*parts, *self.fixed])
        camera = self.cameras[station]
        view = self.views.get(id(camera)) or PixelRays.of(camera)
        return render_light(scene, view, T_camera_base, rng)


def _check(folder: Path, nominal: Machine) -> None:
    """Raise InputError before any work for a session that cannot be simulated."""
    if entries(folder):
        raise InputError(
            what="the folder for the simulated session is not empty",
            where=str(folder),
            expected="a new or empty folder",
            next_step="name another folder, or remove what is in this one",
            code="output.not_empty",
        )
    if not any(len(radii) for radii in nominal.radii()):
        raise InputError(
            what=f"mechanism {nominal.name!r} has no tubes, so its images would show no legs",
            expected="tubes: [{radius: ..., from: ..., to: ...}] on its legs",
        )
    check_drawable(nominal)
    try:
        nominal.home()
    except GeometryError as error:  # the nominal model is input
        raise error.as_input("mechanism") from None


def _write_texts(
    stage: Path, nominal: Machine, cameras: Sequence[Camera], settings: Settings, truth: Truth
) -> None:
    """Write all files but the images."""
    same = all(camera is cameras[0] for camera in cameras)
    files = {
        name: "cameras/camera.yaml" if same else f"cameras/{name}.yaml" for name in truth.stations
    }
    # readings, with the temperatures where there are any
    columns, values = nominal.joint_names, truth.readings
    if truth.effects is not None and truth.effects.temperature is not None:
        columns = (*columns, "temperature [°C]")
        values = np.column_stack([values, truth.effects.temperature])
    texts = {
        "mechanism.yaml": mechanism_text(nominal),
        "session.yaml": yaml_text(_session_document(settings, truth, files)),
        "joints.csv": csv_text(columns, truth.configurations, values),
        TRUTH_FILE: json.dumps(truth_document(truth), indent=1) + "\n",
    }
    if settings.board is not None:
        texts["board.yaml"] = yaml_text(settings.board.document)
    for name, camera in zip(truth.stations, cameras, strict=True):
        texts[files[name]] = yaml_text(camera.document())
    for name, text in texts.items():
        path = stage / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")


def _session_document(
    settings: Settings, truth: Truth, camera_files: dict[str, str]
) -> dict[str, Any]:
    board = settings.board is not None
    name_of = "{configuration}" + _repeat_part(settings, "{repeat}")
    observe = list(settings.observe) if board else "legs"
    stations: dict[str, Any] = {
        name: {
            "camera": camera_files[name],
            "images": f"images/{name}/{name_of}.png",
            "observe": observe,
            "pose": {
                "position": list(pose.position),
                "look_at": list(pose.look_at),
                "up": list(pose.up),
            },
        }
        for name, pose in zip(truth.stations, truth.rough, strict=True)
    }
    if settings.handheld:
        stations = {
            HANDHELD_STATION_NAME: {
                "camera": camera_files[truth.stations[0]],
                "images": f"images/{HANDHELD_STATION_NAME}/{{configuration}}-{{repeat}}.jpg",
                "observe": observe,
                "handheld": True,
            }
        }
    return {
        "pkmcal": 1,
        "mechanism": "mechanism.yaml",
        "joints": {"file": "joints.csv", "noise": settings.joint_noise},
        "stations": stations,
        **({"board": {"file": "board.yaml", "fixed_to": settings.board_on}} if board else {}),
    }


def _write_images(
    stage: Path,
    cameras: Sequence[Camera],
    settings: Settings,
    truth: Truth,
    workers: int,
    progress: ImageProgress | None,
) -> None:
    """Render and write all images; NumPy releases the interpreter lock, so threads suffice."""
    studio = Studio.of(truth, cameras, settings)
    for name in [HANDHELD_STATION_NAME] if settings.handheld else truth.stations:
        (stage / "images" / name).mkdir(parents=True)
    total = len(truth.images)
    with ThreadPoolExecutor(max(1, workers)) as pool:
        jobs = [pool.submit(_write_one, stage, studio, settings, k) for k in range(total)]
        try:
            for done, job in enumerate(as_completed(jobs), start=1):
                job.result()
                if progress is not None:
                    progress(done * truth.repeats, total * truth.repeats)
        finally:
            for job in jobs:
                job.cancel()


def _write_one(stage: Path, studio: Studio, settings: Settings, index: int) -> None:
    import cv2

    truth = studio.truth
    station, k = truth.images[index]
    if settings.handheld:
        (picture,) = studio.images(index)
        name = truth.stations[station].removeprefix(f"{HANDHELD_STATION_NAME}-")
        path = stage / "images" / HANDHELD_STATION_NAME / f"{name}.jpg"
        camera, T_camera_base = studio.cameras[station], truth.T_camera_base[station]
        if truth.focal_scale is not None:  # phones write one focal length, however they focus
            camera = _breathed(camera, 1 / float(truth.focal_scale[station]))
        path.write_bytes(_as_by_telephone(picture, camera, T_camera_base))
        return
    folder = stage / "images" / truth.stations[station]
    for repeat, picture in enumerate(studio.images(index, settings.shake)):
        ok, data = cv2.imencode(".png", picture)
        if not ok:
            raise OSError(f"image {index} could not be encoded as PNG")
        name = f"{truth.configurations[k]}{_repeat_part(settings, str(repeat + 1))}.png"
        (folder / name).write_bytes(data.tobytes())


def _as_by_telephone(picture: Integers, camera: Camera, T_camera_base: Array) -> bytes:
    """JPEG file with sRGB levels and EXIF: the phone's orientation, and its focal length in whole
    mm.
    """
    import cv2

    coded = np.rint(levels_of_light(np.arange(256.0), "srgb")).astype(np.uint8)
    picture = coded[picture]
    ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, HANDHELD_JPEG_QUALITY])
    if not ok:
        raise OSError("an image could not be encoded as JPEG")
    # direction of up in the stored image: viewers rotate the image by it
    right, down = T_camera_base[:2, 2]
    upright, lying = 1 if down < 0 else 3, 6 if right < 0 else 8
    orientation = upright if abs(down) >= abs(right) else lying
    film = float(np.hypot(36.0, 24.0) / np.hypot(*camera.image_size))
    exif = Exif(orientation, float(camera.parameters[0]) * film)
    return with_exif(data.tobytes(), exif)


def _repeat_part(settings: Settings, text: str) -> str:
    """Suffix of an image's name for its repeat; empty for a single repeat."""
    return f"_{text}" if settings.repeats > 1 else ""
