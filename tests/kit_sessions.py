"""Kits of deltas with errors of half a millimetre and a third of a degree, and their measurements:
a board in a webcam's images, or heights of the bed by a probe.

Nothing is rendered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple
from unittest.mock import patch

import cv2
import numpy as np
import yaml

from pkmcal.boards.board import Detection
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.cameras import load_camera
from pkmcal.files import csv_text, yaml_text
from pkmcal.geometry.rigid import apply, inverse, look_at, pose, register, rotation
from pkmcal.identify.gauge import pose_generators, respecting_motion
from pkmcal.identify.tool import pose_by_parameters
from pkmcal.mechanisms import load_mechanism, mechanism_text
from pkmcal.simulation.board import board_from_fields

LENGTH, ANGLE = 5e-4, np.deg2rad(0.3)
"""Standard deviations of a kit's parts about the nominal model."""
CORNER = 0.15
"""Noise of a corner in a webcam's image, px."""
TOUCH = 2e-5
"""Noise of a probe's touch on the bed, m."""
JOINT_NOISE = 1e-5
CAMERA = {"model": "pinhole", "image_size": [1280, 720], "focal": [1000.0, 1000.0],
          "center": [639.5, 359.5]}  # fmt: skip
BOARD = {"type": "charuco", "squares": [8, 6], "square": 0.012, "marker": 0.009,
         "dictionary": "DICT_4X4_50"}  # fmt: skip
WORKSPACE = {"delta": (0.06, -0.26, -0.18), "linear-delta": (0.08, 0.06, 0.2)}
"""Radius and heights of a cylinder, m, base frame."""
NOZZLE = 0.06
"""m below the effector's joints: where these are when it touches the bed."""


@dataclass(frozen=True)
class Kit:
    """Folder of a session, its nominal model, the true machine, and the corners of a detector."""

    name: str
    folder: object
    nominal: object
    truth: object
    detections: tuple = ()

    def calibrated(self):
        """Calibration by the program, with the corners in place of a detector's, as there are no
        images.
        """
        with patch("pkmcal.boards.stations.detect_in", lambda *_: self.detections):
            return calibrate_session(self.folder)


class Error(NamedTuple):
    """Errors of the tool over the workspace, root mean square, base frames fitted to each other, m.

    before, after : of the nominal model and of the calibration. expected : from the calibration's
    own covariance. sideways : after, x and y only.
    """

    before: float
    after: float
    expected: float
    sideways: float


def built(nominal, rng):
    """The machine as built from its parts."""
    table = nominal.parameters
    free = table.free_matrix()
    own = np.array([LENGTH if unit == "m" else ANGLE for unit in table.units])
    own[table.of_kind("scale")] = table.tolerance[table.of_kind("scale")]
    step = rng.normal(size=free.shape[1]) * (np.abs(free).T @ own) / np.abs(free).sum(axis=0)
    return nominal.with_values(table.unit_axes(nominal.values + free @ step))


def places(name, n, rng):
    """Poses (n, 4, 4) all over the workspace."""
    radius, low, high = WORKSPACE[name]
    angle, r = rng.uniform(0, 2 * np.pi, n), radius * np.sqrt(rng.uniform(size=n))
    t = np.stack([r * np.cos(angle), r * np.sin(angle), rng.uniform(low, high, n)], axis=-1)
    return pose(np.eye(3), t)


def board_kit(folder, name, seed=0, n=25):
    """A board on the effector, one webcam, n configurations; corners with normal noise."""
    rng = np.random.default_rng(seed)
    kit = _written(folder, name, rng)
    middle = np.array([0.0, 0.0, np.mean(WORKSPACE[name][1:])])
    T_camera_base = look_at(middle + np.array([0.25, -0.3, 0.35]), middle, np.array([0, 0, 1.0]))
    (folder / "cameras").mkdir()
    (folder / "cameras" / "webcam.yaml").write_text(yaml_text(CAMERA))
    (folder / "board.yaml").write_text(yaml_text(BOARD))
    camera, board = load_camera(folder / "cameras" / "webcam.yaml"), board_from_fields(BOARD)
    # tilted from the line of sight: seen from straight ahead, a board hardly determines its tilt
    facing = inverse(T_camera_base)[:3, :3] @ rotation(np.array([0.4, -0.35, 0.1]))
    T_platform_board = pose(facing, [0.0, 0.0, 0.02] - facing @ board.points.mean(axis=0))
    T = places(name, n, rng)
    pixels = camera.project(apply((T_camera_base @ T @ T_platform_board)[:, None], board.points))
    assert camera.in_image(pixels, margin=10.0).all()
    pixels = pixels + CORNER * rng.normal(size=pixels.shape)
    ids = np.arange(len(board.points))
    count = tuple(
        Detection(f"{k:03d}.png", camera.image_size, ids, p, np.full(len(ids), CORNER))
        for k, p in enumerate(pixels)
    )
    (folder / "images").mkdir()
    grey = cv2.imencode(".png", np.full((720, 1280), 128, dtype=np.uint8))[1].tobytes()
    for item in count:
        (folder / "images" / item.name).write_bytes(grey)
    station = {"camera": "cameras/webcam.yaml", "images": "images/{configuration}.png",
               "observe": "board"}  # fmt: skip
    _session(kit, {"webcam": station}, T, rng, board="board.yaml")
    return Kit(name, folder, kit.nominal, kit.truth, count)


def bed(n=7, radius=0.08):
    """The middle, and points on one circle for seven; on two and more for more, (n, 2)."""
    rings = [(0, 1), (radius, 6), (0.5 * radius, 6), (0.75 * radius, 12)]
    points = [
        r * np.stack([np.cos(a), np.sin(a)], axis=-1)
        for r, k in rings
        for a in [np.arange(k) * 2 * np.pi / k + 0.5]
    ]
    return np.concatenate(points)[:n]


def probe_kit(folder, seed=0, n=7, rods=None):
    """A linear delta that felt n points of a flat bed: z = 0 there, in poses.csv.

    rods : their lengths measured beforehand, to this standard deviation, m.
    """
    rng = np.random.default_rng(seed)
    kit = _written(folder, "linear-delta", rng)
    if rods is not None:
        document = yaml.safe_load(mechanism_text(_rods_measured(kit, rods, rng)))
        document["tolerance"]["offset"] = rods
        (folder / "mechanism.yaml").write_text(yaml_text(document))
        kit = replace(kit, nominal=load_mechanism(folder / "mechanism.yaml"))
    xy = bed(n)
    z = NOZZLE + TOUCH * rng.normal(size=n)
    T = pose(np.eye(3), np.column_stack([xy, z]))
    names = [f"{k:03d}" for k in range(n)]
    (folder / "poses.csv").write_text(csv_text(("z",), names, np.zeros((n, 1))))
    probe = {"tracker": {"poses": "poses.csv", "noise": {"position": TOUCH}}}
    _session(kit, {"probe": probe}, T, rng)
    return kit


def _rods_measured(kit, sigma, rng):
    """Nominal model with the true rods' lengths, as measured."""
    values = kit.nominal.values.copy()
    rows = [kit.nominal.parameters.index(f"legs[{j}].length.constant") for j in (1, 2, 3)]
    values[rows] = kit.truth.values[rows] + sigma * rng.normal(size=3)
    return kit.nominal.with_values(values)


def _written(folder, name, rng):
    nominal = load_mechanism(name)
    folder.mkdir()
    (folder / "mechanism.yaml").write_text(mechanism_text(nominal))
    return Kit(name, folder, nominal, built(nominal, rng))


def _session(kit, stations, T, rng, **more):
    """joints.csv and session.yaml."""
    joints = kit.truth.inverse(T)
    assert np.isfinite(joints).all()
    joints = joints + JOINT_NOISE * rng.normal(size=joints.shape)
    names = [f"{k:03d}" for k in range(len(T))]
    (kit.folder / "joints.csv").write_text(csv_text(("a", "b", "c"), names, joints))
    document = {
        "pkmcal": 1,
        "mechanism": "mechanism.yaml",
        "joints": {"file": "joints.csv", "noise": JOINT_NOISE},
        "stations": stations,
        **more,
    }
    (kit.folder / "session.yaml").write_text(yaml_text(document))


def tool(kit, value, n=200):
    """The tool's errors at readings that were not measured."""
    T = places(kit.name, n, np.random.default_rng(99))
    joints, there = kit.truth.inverse(T), T[:, :3, 3]
    before = laid_over(kit.nominal.forward(joints)[:, :3, 3], there)
    poses = value.machine.forward(joints)
    after = laid_over(poses[:, :3, 3], there)
    by = pose_by_parameters(value.machine, joints, poses)[:, 3:]
    frames = pose_generators(poses)[:, 3:] @ respecting_motion(value.machine.layout.motion)
    by, frames = by.reshape(3 * n, -1), frames.reshape(3 * n, -1)
    by = by - frames @ np.linalg.lstsq(frames, by, rcond=1e-9)[0]
    variance = np.sum((by @ value.estimate.covariance) * by) / n
    return Error(rms(before), rms(after), float(np.sqrt(variance)), rms(after[:, :2]))


def laid_over(points, there):
    """Residuals of points (n, 3) from the true points after the best rigid motion."""
    return apply(register(points, there), points) - there


def rms(off):
    """Root mean square of distances, off (n, k)."""
    return float(np.sqrt(np.mean(np.sum(off**2, axis=-1))))


def flatness(kit, machine, n=300):
    """Deviation (m, rms) from the best plane of a bed that the machine takes for flat: the true
    heights at readings for which the machine computes a common height.
    """
    rng = np.random.default_rng(7)
    angle = rng.uniform(0, 2 * np.pi, n)
    r = WORKSPACE[kit.name][0] * np.sqrt(rng.uniform(size=n))
    z = WORKSPACE[kit.name][1]
    t = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(n, z)], axis=-1)
    joints = machine.inverse(pose(np.eye(3), t))
    true = kit.truth.forward(joints)[:, :3, 3]
    plane = np.column_stack([true[:, :2], np.ones(n)])
    residual = true[:, 2] - plane @ np.linalg.lstsq(plane, true[:, 2], rcond=None)[0]
    return float(np.sqrt(np.mean(residual**2)))
