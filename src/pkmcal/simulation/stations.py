"""Where simulated cameras stand: round the machine, or in its middle for a mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply, inverse, look_at, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.observe.predict import edge_points, legs_in_camera, tubes_of, unobstructed
from pkmcal.session.schema import Body
from pkmcal.simulation.drives import reaches

_PANORAMIC = np.deg2rad(95)
"""A camera that sees more than this off its axis sees all legs from their middle."""
_NEAREST = np.deg2rad(35)
"""Half the angle under which the machine is seen at most; nearer, legs hide each other."""
_TRIED = 24
"""Places round the machine of which a single camera takes the best."""
_CLEAR = 0.03
"""Gap to another leg at home, in image widths, that keeps a leg free of it elsewhere."""
_ARC = np.deg2rad(80)
"""Between the first and the last camera that see the same face of a board."""
_BESIDE = {False: 1.45, True: 1.6}
"""Distance that leaves room for a board, in the machine's own, upright and flat."""

_SPARE = 1.18
"""Distance in the machine's own at home: platforms move, and plates reach beyond joints."""
_FULL = 1.1
"""The same where the machine's own takes in where its motors move it."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class StationPose:
    """A camera's place as people give it, base frame, m: as ``pose`` in session.yaml."""

    position: Vector
    look_at: Vector
    up: Vector = (0.0, 0.0, 1.0)

    def T_camera_base(self) -> Array:
        """(4, 4), base to camera coordinates."""
        return look_at(np.array(self.position), np.array(self.look_at), np.array(self.up))


def default_stations(
    machine: Machine,
    cameras: tuple[Camera, ...],
    rng: np.random.Generator,
    board: Body | None = None,
) -> tuple[StationPose, ...]:
    """One place for each camera: evenly round the machine, not quite regular, as by hand.

    A camera that is alone goes where it sees most of every leg, unless it sees a board on the base.
    board : what a board is fixed to that all see: they stand to one side of a machine that stands,
    round one that lies flat, and with room beside the machine for a board on the base.
    """
    space = np.concatenate(_space(machine))
    start = rng.uniform(0, 2 * np.pi)
    poses: list[StationPose] = []
    arc = board is not None and not _is_flat(space)
    for k, camera in enumerate(cameras):
        half = view_angle(camera)
        away = _distance(machine, min(half, _NEAREST), board)
        if half > _PANORAMIC:
            poses.append(_inside(*_space(machine), rng))
        elif len(cameras) == 1 and board != "base":
            poses.append(_clearest(machine, camera, away, start, rng))
        else:
            turn = (
                _ARC * (k / max(len(cameras) - 1, 1) - 0.5) if arc else 2 * np.pi * k / len(cameras)
            )
            azimuth = start + turn + np.deg2rad(rng.uniform(-8, 8))
            poses.append(_outside(space, away, azimuth, rng))
    return tuple(poses)


def _space(machine: Machine) -> tuple[Array, Array]:
    """Legs' ends A and B (n, 3), base frame, m, that a picture of the machine has to hold."""
    a, b = reaches(machine)
    return a.reshape(-1, 3), b.reshape(-1, 3)


def _clearest(
    machine: Machine, camera: Camera, away: float, start: float, rng: np.random.Generator
) -> StationPose:
    """The place on the ring, ``away`` from the machine in its own radius, from which the leg that
    is seen least is seen best.
    """
    space = np.concatenate(_space(machine))
    azimuths = start + 2 * np.pi * np.arange(_TRIED) / _TRIED
    poses = [_outside(space, away, azimuth, rng) for azimuth in azimuths]
    tubes, home = tubes_of(machine), machine.home()[None]
    T_camera_base = np.stack([pose.T_camera_base() for pose in poses])
    legs = legs_in_camera(machine, T_camera_base, home, machine.inverse(home))
    points = edge_points(machine, camera, legs, tubes, 12)
    # legs move: what comes near another one at home is behind it elsewhere
    clear = _CLEAR * camera.image_size[0]
    seen = unobstructed(machine, camera, legs, tubes, points, clear).mean(axis=-1)
    share = np.stack([seen[:, tubes.leg == j].mean(axis=1) for j in np.unique(tubes.leg)])
    return poses[int(np.argmax(share.min(axis=0)))]


def _is_flat(points: Array) -> bool:
    """Whether joints (n, 3) lie in about one level."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return bool(np.ptp(points[:, 2]) < 0.25 * np.linalg.norm(points - centre, axis=1).max())


def view_angle(camera: Camera) -> float:
    """Smallest angle (rad) from the image's middle to its border, or to the field's rim."""
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
    """A pose by hand: off by ``shift`` (m) and ``turn`` (rad) in random directions.

    distance : from the camera to what it looks at, m.
    """
    T_base_camera = inverse(T_camera_base)
    axis, way = rng.normal(size=(2, 3))
    rot = rotation(turn * axis / np.linalg.norm(axis)) @ T_base_camera[:3, :3]
    position = T_base_camera[:3, 3] + shift * way / np.linalg.norm(way)
    # nobody writes more digits than a tenth of a millimetre by hand
    return StationPose(
        _rounded(position), _rounded(position + distance * rot[:, 2]), _rounded(-rot[:, 1])
    )


def _rounded(v: Array) -> Vector:
    x, y, z = (round(float(c), 4) for c in v)
    return x, y, z


def _distance(machine: Machine, half: float, board: Body | None) -> float:
    """From which the machine, and the board, fill the picture, in the machine's own radius.

    half : of the view, rad.
    """
    if len(reaches(machine)[0]) > 1 and board != "base":
        share = _FULL
    else:
        share = _SPARE if board is None else _BESIDE[_is_flat(np.concatenate(_space(machine)))]
    return float(share / np.sin(half))


def _outside(
    points: Array, distance: float, azimuth: float, rng: np.random.Generator
) -> StationPose:
    """On a ring round the machine's points (n, 3), low, or high for a flat machine."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    flat = _is_flat(points)
    elevation = np.deg2rad(rng.uniform(42, 55) if flat else rng.uniform(7, 17))
    way = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
         np.sin(elevation)]
    )  # fmt: skip
    target = centre + rng.uniform(-0.03, 0.03, 3) * radius
    up = np.array([*rng.normal(0, 0.04, 2), 1.0])
    position = centre + distance * radius * way
    return StationPose(_rounded(position), _rounded(target), _rounded(up))


def _inside(a: Array, b: Array, rng: np.random.Generator) -> StationPose:
    """Between the legs, a little above the base joints, looking at the platform."""
    middle, rise = a.mean(axis=0), b.mean(axis=0) - a.mean(axis=0)
    width = float(np.linalg.norm(a - middle, axis=1).max())
    position = middle + 0.15 * rise + np.array([*rng.uniform(-0.15, 0.15, 2), 0.0]) * width
    angle = rng.uniform(0, 2 * np.pi)
    target = position + rise + np.array([*rng.uniform(-0.03, 0.03, 2), 0.0]) * width
    up = (float(np.cos(angle)), float(np.sin(angle)), 0.0)
    return StationPose(_rounded(position), _rounded(target), _rounded(np.array(up)))


def share_in_image(
    machine: Machine, camera: Camera, T_camera_base: Array, T_base_platform: Array, joints: Array
) -> Array:
    """Part of each leg that lies in the image, (K, L), for poses (K, 4, 4) and readings (K, m)."""
    ends = limb_ends(machine.layout, machine.values, joints, T_base_platform)
    along = np.linspace(0.06, 0.96, 12)[:, None]
    points = ends.a[..., None, :] * (1 - along) + ends.b[..., None, :] * along
    pixels = camera.project(apply(T_camera_base, points))
    return camera.in_image(pixels, margin=6.0).mean(axis=-1)
