"""Stations of a session: cameras round the machine, or in its middle if they are panoramic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, inverse, look_at, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.drives import ball_of, legs_space, reaches
from pkmcal.observe.predict import edge_points, legs_in_camera, tubes_of, unobstructed
from pkmcal.session.schema import BoardBody, Vector

PANORAMIC_HALF_VIEW = np.deg2rad(95)
"""Half angle of view, in rad, above which a camera is placed between the legs and sees all of them.
"""
NEAREST_HALF_VIEW = np.deg2rad(35)
"""Largest half angle, in rad, under which a camera sees the machine; nearer, legs occlude each
other."""
CAMERA_POSES_TRIED = 24
"""Number of candidate poses round the machine for a single camera."""
HOME_LEG_GAP = 0.03
"""Gap between two legs in an image at home, in image widths, with which they stay apart elsewhere.
"""
BOARD_CAMERAS_ARC = np.deg2rad(80)
"""Angle, in rad, between the first and the last of the cameras that see the same face of a board.
"""
WITH_BOARD = {False: 1.45, True: 1.6}
"""Factor on the distance that leaves room for a board beside the machine, by whether it is flat."""
HOME_DISTANCE_FACTOR = 1.18
"""Factor on the distance for a space known at home only: platforms move, and plates are wider than
the joints."""
MOVED_DISTANCE_FACTOR = 1.1
"""Factor on the distance for a space that includes the motors' stops."""
NARROWEST_HALF_VIEW = 1e-6
"""Least half angle of view, in rad, that a distance is computed with."""

HANDHELD_ELEVATIONS = (np.deg2rad(5), np.deg2rad(45))
"""Lowest and highest elevation, in rad, of a person who walks about a machine with a phone."""
HANDHELD_DISTANCES = (1.0, 1.35)
"""Least and largest distance of a phone, relative to the distance at which the machine fills the
image."""
MOST_HANDHELD_ROLL = np.deg2rad(15)
"""Largest roll, in rad, of a phone held upright or on its side."""
UPRIGHT_IMAGE_SHARE = 1 / 3
"""Share of images for which the phone is held upright, so that its sensor lies on its side."""


@dataclass(frozen=True)
class StationPose:
    """Camera pose as a user gives it, base frame, m: the ``pose`` of a station in session.yaml."""

    position: Vector
    look_at: Vector
    up: Vector = (0.0, 0.0, 1.0)

    @classmethod
    def of(cls, T_camera_base: Array) -> StationPose:
        """Pose of a camera from T_camera_base (4, 4), looking at a point one metre ahead."""
        T = inverse(T_camera_base)
        position, forward, up = T[:3, 3], T[:3, 2], -T[:3, 1]
        return cls(*(tuple(v.tolist()) for v in (position, position + forward, up)))

    def rounded(self, digits: int) -> dict[str, list[float]]:
        """Fields of session.yaml, rounded to decimals, without -0.0."""
        return {name: [round(x, digits) + 0.0 for x in part] for name, part in vars(self).items()}

    def T_camera_base(self) -> Array:
        """(4, 4) transformation from base to camera coordinates."""
        return look_at(np.array(self.position), np.array(self.look_at), np.array(self.up))


def one_a_station(camera: Camera | Sequence[Camera], n_stations: int) -> tuple[Camera, ...]:
    """One camera for each station, from one for all or one for each.

    Raises InputError for any other number.
    """
    cameras = (camera,) * n_stations if isinstance(camera, Camera) else tuple(camera)
    if len(cameras) != n_stations or n_stations == 0:
        raise InputError(
            what="the simulation needs one camera for all stations, or one for each",
            found=f"{len(cameras)} cameras for {n_stations} stations",
            expected=f"1 or {n_stations}",
        )
    return cameras


def default_stations(
    machine: Machine,
    cameras: tuple[Camera, ...],
    rng: np.random.Generator,
    board: BoardBody | None = None,
    *,
    distance: float | None = None,
    elevation: float | None = None,
) -> tuple[StationPose, ...]:
    """One pose for each camera: spaced evenly round the machine with random deviations.

    A single camera takes the candidate from which every leg is seen best, unless it sees a board on
    the base.

    board : body that carries a board which all cameras see. Cameras then stand to one side of a
    machine, but round one that lies flat; with a board on the base they leave room for it.
    distance : from the machine's middle, m; by default such that the machine fills the image.
    elevation : rad above the horizontal; random by default. Neither applies to a camera between the
    legs.
    """
    space = legs_space(machine)
    start = rng.uniform(0, 2 * np.pi)
    poses: list[StationPose] = []
    arc = board is not None and not _is_flat(space)
    for k, camera in enumerate(cameras):
        half = view_angle(camera)
        away = fitting_distance(machine, camera, board)
        if distance is not None:
            away = distance / ball_of(space)[1]
        if half > PANORAMIC_HALF_VIEW:
            poses.append(_inside(machine, rng))
        elif len(cameras) == 1 and board != "base" and len(tubes_of(machine)):
            poses.append(_clearest(machine, camera, away, start, rng, elevation))
        else:
            turn = (
                BOARD_CAMERAS_ARC * (k / max(len(cameras) - 1, 1) - 0.5)
                if arc
                else 2 * np.pi * k / len(cameras)
            )
            azimuth = start + turn + np.deg2rad(rng.uniform(-8, 8))
            poses.append(_outside(space, away, azimuth, rng, elevation))
    return tuple(poses)


def rough_poses(
    machine: Machine, cameras: tuple[Camera, ...], rng: np.random.Generator
) -> tuple[StationPose, ...]:
    """One pose for each image of a person who walks round the machine, evenly with random
    deviations.
    """
    centre, radius = ball_of(legs_space(machine))
    start, out = rng.uniform(0, 2 * np.pi), list[StationPose]()
    # three turns about the machine, so that images of one configuration are not side by side
    turn = 2 * np.pi * 3 / len(cameras) * (1 + 1 / (3 * len(cameras)))
    for k, camera in enumerate(cameras):
        azimuth = start + turn * (k + rng.uniform(-0.3, 0.3))
        elevation = rng.uniform(*HANDHELD_ELEVATIONS)
        away = fitting_distance(machine, camera) * rng.uniform(*HANDHELD_DISTANCES)
        level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        direction = np.cos(elevation) * level + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
        position = centre + away * radius * direction
        target = centre + rng.uniform(-0.08, 0.08, 3) * radius
        forward = (target - position) / np.linalg.norm(target - position)
        roll = rng.uniform(-MOST_HANDHELD_ROLL, MOST_HANDHELD_ROLL)
        if rng.uniform() < UPRIGHT_IMAGE_SHARE:
            roll += np.pi / 2 * rng.choice([-1, 1])
        up = rotation(roll * forward) @ np.array([0.0, 0.0, 1.0])
        up = up - (up @ forward) * forward
        out.append(
            StationPose(_rounded(position), _rounded(target), _rounded(up / np.linalg.norm(up)))
        )
    return tuple(out)


def fitting_distance(machine: Machine, camera: Camera, board: BoardBody | None = None) -> float:
    """Distance from which machine and board fill the camera's image, in radii of the machine's
    space.
    """
    if len(reaches(machine)[0]) > 1 and board != "base":
        share = MOVED_DISTANCE_FACTOR
    else:
        share = HOME_DISTANCE_FACTOR if board is None else WITH_BOARD[_is_flat(legs_space(machine))]
    half = min(view_angle(camera), NEAREST_HALF_VIEW)
    return float(share / np.sin(max(half, NARROWEST_HALF_VIEW)))


def _clearest(
    machine: Machine,
    camera: Camera,
    away: float,
    start: float,
    rng: np.random.Generator,
    elevation: float | None,
) -> StationPose:
    """Candidate on the ring, ``away`` from the machine in its own radius, with the best worst leg.

    The score of a candidate is the visible share of the leg that is seen least at home.
    """
    space = legs_space(machine)
    azimuths = start + 2 * np.pi * np.arange(CAMERA_POSES_TRIED) / CAMERA_POSES_TRIED
    poses = [_outside(space, away, azimuth, rng, elevation) for azimuth in azimuths]
    tubes, home = tubes_of(machine), machine.home()[None]
    T_camera_base = np.stack([pose.T_camera_base() for pose in poses])
    legs = legs_in_camera(machine, T_camera_base, home, machine.inverse(home))
    points = edge_points(machine, camera, legs, tubes, 12)
    # legs move: a leg that is close to another in the image at home is hidden by it elsewhere
    clear = HOME_LEG_GAP * camera.image_size[0]
    visible = unobstructed(machine, camera, legs, tubes, points, clear).mean(axis=-1)
    share = np.stack([visible[:, tubes.leg == j].mean(axis=1) for j in np.unique(tubes.leg)])
    return poses[int(np.argmax(share.min(axis=0)))]


def _is_flat(points: Array) -> bool:
    """Whether points (n, 3) lie in about one horizontal plane."""
    return bool(np.ptp(points[:, 2]) < 0.25 * ball_of(points)[1])


def view_angle(camera: Camera) -> float:
    """Smallest angle, in rad, from the image's middle to its border, or to the rim of a lens's
    field.
    """
    width, height = camera.image_size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    borders = np.array([[0, middle[1]], [width - 1, middle[1]], [middle[0], 0]])
    borders = np.concatenate([borders, [[middle[0], height - 1]]])
    steps = np.linspace(0, 1, 60)[:, None, None]
    rays = camera.ray(middle + steps * (borders - middle))
    cosine = np.clip(rays @ camera.ray(middle), -1, 1)
    return float(np.nanmax(np.arccos(cosine), axis=0).min())


def rough_pose(
    T_camera_base: Array, distance: float, shift: float, turn: float, rng: np.random.Generator
) -> StationPose:
    """Hand-measured pose: off by ``shift`` (m) and ``turn`` (rad) in random directions.

    distance : from the camera to its target, m.
    """
    T_base_camera = inverse(T_camera_base)
    axis, direction = rng.normal(size=(2, 3))
    rot = rotation(turn * axis / np.linalg.norm(axis)) @ T_base_camera[:3, :3]
    position = T_base_camera[:3, 3] + shift * direction / np.linalg.norm(direction)
    # a pose measured by hand has no digits below a tenth of a millimetre
    return StationPose(
        _rounded(position), _rounded(position + distance * rot[:, 2]), _rounded(-rot[:, 1])
    )


def _rounded(v: Array) -> Vector:
    x, y, z = (round(float(c), 4) for c in v)
    return x, y, z


def _outside(
    points: Array,
    distance: float,
    azimuth: float,
    rng: np.random.Generator,
    elevation: float | None,
) -> StationPose:
    """Pose on a ring round the machine's points (n, 3), low, or high for a flat machine."""
    centre, radius = ball_of(points)
    usual = np.deg2rad(rng.uniform(42, 55) if _is_flat(points) else rng.uniform(7, 17))
    above = usual if elevation is None else elevation
    direction = np.array(
        [np.cos(azimuth) * np.cos(above), np.sin(azimuth) * np.cos(above), np.sin(above)]
    )  # fmt: skip
    target = centre + rng.uniform(-0.03, 0.03, 3) * radius
    up = np.array([*rng.normal(0, 0.04, 2), 1.0])
    position = centre + distance * radius * direction
    return StationPose(_rounded(position), _rounded(target), _rounded(up))


def _inside(machine: Machine, rng: np.random.Generator) -> StationPose:
    """Pose between the legs, a little above the base joints, looking at the platform."""
    a, b = (ends.reshape(-1, 3) for ends in reaches(machine))
    middle, rise = a.mean(axis=0), b.mean(axis=0) - a.mean(axis=0)
    width = float(np.linalg.norm(a - middle, axis=1).max())
    position = middle + 0.15 * rise + np.array([*rng.uniform(-0.15, 0.15, 2), 0.0]) * width
    angle = rng.uniform(0, 2 * np.pi)
    target = position + rise + np.array([*rng.uniform(-0.03, 0.03, 2), 0.0]) * width
    up = (float(np.cos(angle)), float(np.sin(angle)), 0.0)
    return StationPose(_rounded(position), _rounded(target), _rounded(np.array(up)))


def in_picture(
    machine: Machine, camera: Camera, T_camera_base: Array, T_base_platform: Array, joints: Array
) -> Booleans:
    """(K,) whether an image of each configuration shows the machine.

    T_base_platform : (K, 4, 4). joints : (K, m). The end of a leg may lie outside the image; an
    image with half a machine is not usable.
    """
    a, b = machine.ends_at(joints, T_base_platform).rods
    along = np.linspace(0.06, 0.96, 12)[:, None]
    points = a[..., None, :] * (1 - along) + b[..., None, :] * along
    pixels = camera.project(apply(T_camera_base, points))
    share = camera.in_image(pixels, margin=6.0).mean(axis=-1)
    return (share.mean(axis=-1) > 0.8) & (share.min(axis=-1) > 0.4)
