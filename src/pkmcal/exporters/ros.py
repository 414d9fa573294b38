"""``ros``: camera_info of each camera, and static transforms from the base to the cameras.

The camera frame is ROS' optical frame (REP 103): z forward, x right, y down. Transforms are
arguments of tf2_ros' static_transform_publisher in a ROS 2 launch file: parent first, quaternion x
y z w.
"""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar, final

import numpy as np
import yaml

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.cameras import Camera
from pkmcal.cameras.files import foreign_text, load_camera, ros_distortion
from pkmcal.errors import InputError
from pkmcal.exporters.contract import Difference, Exporter, commented, exact
from pkmcal.geometry.rigid import from_quaternion, pose, quaternion
from pkmcal.outcome.finding import Finding, doubtful, note
from pkmcal.wording import listed

ROS_LAUNCH_FILE = "static_transforms.launch.yaml"
ROS_BASE_FRAME = "base"
TRANSFORM_ROUNDING = 1e-12
"""Tolerance, m and elements of a rotation matrix: rounding of a quaternion with 17 digits."""


@final
class Ros(Exporter):
    """Camera files of a ROS 2 system."""

    name: ClassVar = "ros"
    title: ClassVar = "ROS 2: camera_info and static transforms"

    def files(self, source: MachineSource) -> dict[str, str]:
        """Launch file, and a camera_info file for each camera whose model ROS has.

        Raises InputError for a source without cameras.
        """
        if not source.T_base_camera:
            raise InputError(
                "no camera has a pose, so there is nothing for ROS",
                where=source.origin,
                expected="a folder that pkmcal calibrate wrote",
                next_step="Calibrate first; a mechanism file alone has no cameras",
                code="export.no_cameras",
            )
        out = {ROS_LAUNCH_FILE: _launch(source)}
        frames = frame_names(source)
        for station, camera in source.cameras.items():
            if _has_ros_model(camera):
                name = f"camera_info_{frames[station]}.yaml"
                text = foreign_text(camera, f"{frames[station]}.yaml", "ros")
                about = source.header(
                    f"Camera of station {station}; pixels, pixel centres at integers, frame"
                    f" {frames[station]}_optical_frame."
                )
                out[name] = commented(about, "#") + text
        return out

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences of transforms and cameras, read from the texts.

        Transforms by the quaternions, cameras by the reader of foreign camera files.
        """
        frames = frame_names(source)
        read_transforms = transforms(files[ROS_LAUNCH_FILE])
        off = [
            float(np.abs(read_transforms[frames[s]] - T).max())
            for s, T in source.T_base_camera.items()
        ]
        out = [Difference(f"{len(off)} transforms read again", max(off), TRANSFORM_ROUNDING)]
        for station, camera in source.cameras.items():
            text = files.get(f"camera_info_{frames[station]}.yaml")
            if text is not None:
                with TemporaryDirectory() as folder:
                    path = Path(folder) / "camera.yaml"
                    path.write_text(text, encoding="utf-8")
                    again = load_camera(path)
                worst = float(np.abs(again.parameters - camera.parameters).max())
                limit = 1e-12 * float(np.abs(camera.parameters).max())
                out.append(Difference(f"camera of {station} read again", worst, limit, "px"))
        return out

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Warnings of cameras that the files lack, and the use of the launch file."""
        lost = [s for s in source.T_base_camera if s not in source.cameras]
        out: list[Finding] = []
        if lost:
            out.append(doubtful("export.ros_no_camera_file", listed(lost), stations=lost))
        without_model = [s for s, camera in source.cameras.items() if not _has_ros_model(camera)]
        if without_model:
            out.append(doubtful("export.ros_lens", listed(without_model), stations=without_model))
        out.append(note("export.ros_launch", ROS_LAUNCH_FILE))
        return tuple(out)


def frame_names(source: MachineSource) -> dict[str, str]:
    """Distinct ROS name of each station, of letters, digits and underscores."""
    out: dict[str, str] = {}
    for station in source.T_base_camera:
        plain = re.sub(r"[^A-Za-z0-9_]+", "_", station).strip("_") or "camera"
        plain = plain if plain[0].isalpha() else f"camera_{plain}"
        name, k = plain, 2
        while name in out.values():
            name, k = f"{plain}_{k}", k + 1
        out[station] = name
    return out


def _has_ros_model(camera: Camera) -> bool:
    """Whether ROS has a distortion model of the camera."""
    try:
        ros_distortion(camera)
    except InputError:
        return False
    return True


def _launch(source: MachineSource) -> str:
    """Launch file with a static transform for each station."""
    names = frame_names(source)
    nodes: list[str] = []
    for station, transform in source.T_base_camera.items():
        shift = " ".join(
            f"--{axis} {exact(v)}" for axis, v in zip("xyz", transform[:3, 3].tolist(), strict=True)
        )
        turned = np.roll(quaternion(transform[:3, :3]), -1)
        turn = " ".join(
            f"--q{axis} {exact(v)}" for axis, v in zip("xyzw", turned.tolist(), strict=True)
        )
        frame = f"--frame-id {ROS_BASE_FRAME} --child-frame-id {names[station]}_optical_frame"
        nodes.append(
            "- node:\n    pkg: tf2_ros\n    exec: static_transform_publisher\n"
            f"    name: {names[station]}_transform\n"
            f'    args: "{shift} {turn} {frame}"\n'
        )
    about = source.header(
        f"Transforms from {ROS_BASE_FRAME} (the machine's base frame) to each camera's optical"
        " frame: z forward, x right, y down. Metres; quaternions x y z w, which turn camera"
        " coordinates into base coordinates.",
        *(
            f"Station {station}: sigma of rotation"
            f" {', '.join(f'{v:.2g}' for v in sigma[:3])} rad, of translation"
            f" {', '.join(f'{v:.2g}' for v in sigma[3:])} m, along the base's axes."
            for station, sigma in source.sigma_camera.items()
        ),
    )
    return commented(about, "#") + "launch:\n" + "".join(nodes)


def transforms(text: str) -> dict[str, Array]:
    """T_base_camera (4, 4) by frame name, from a launch file's arguments, as in tf2."""
    out: dict[str, Array] = {}
    for entry in yaml.safe_load(text)["launch"]:
        words = entry["node"]["args"].split()
        given = dict(zip(words[::2], words[1::2], strict=True))
        rot = from_quaternion(np.array([float(given[f"--q{axis}"]) for axis in "wxyz"]))
        place = np.array([float(given[f"--{axis}"]) for axis in "xyz"])
        out[given["--child-frame-id"].removesuffix("_optical_frame")] = pose(rot, place)
    return out
