"""Placement of machine and cameras in a session: configurations and station poses.

Configurations are within the joints' ranges, reachable, and away from singular poses. Cameras stand
round the machine, or in its middle if they are panoramic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, dot, inverse, look_at, perturb, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.kinematics import on_manifold, scaled_rows, singularity_of
from pkmcal.mechanisms.velocities import sign_of
from pkmcal.observe.predict import edge_points, legs_in_camera, tubes_of, unobstructed
from pkmcal.session.schema import BoardBody, Vector
from pkmcal.simulation.drives import ball_of, drives_of, legs_space, reaches
from pkmcal.wording import listed

FARTHEST_TILT = np.deg2rad(35)
"""Largest tilt of the platform, in rad; more than the universal joints of such machines allow."""
FARTHEST_TURN = 7 / 9
"""Largest turn of an articulated platform about z, relative to the turn at which its parts collide.
"""
LEAST_SINGULAR = 0.12
"""Smallest singular value of the scaled inverse Jacobian; here a reading's error grows by eight."""
GUIDE_SIDE_ROOM = 4.0
"""Clearance beside a guide for rail and carriage, in radii of the leg on it."""
SIDE_BY_SIDE = 0.9
"""Cosine of the angle between two guides' backs above which the guides lie side by side."""
READING_RANGE_SHARES = (0.03, 0.97)
"""Shares of a joint's range between which readings are drawn, away from the stops."""
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


def check_drawable(machine: Machine) -> None:
    """Raise `InputError` for a machine whose parts' positions do not follow from the pose and
    readings.
    """
    layout, legs = machine.layout, machine.document.legs
    hinged = {legs[j].platform.joint for j in np.flatnonzero(layout.internal >= 0)}
    if hinged:
        raise InputError(
            what=f"mechanism {machine.name!r} has side bars that turn on hinges, and how far they"
            " turn is not known where it is drawn",
            expected=f"platform joints other than {listed(sorted(hinged))}",
            next_step="take the machine with one rod a forearm, such as h4",
        )


def draw_configurations(
    machine: Machine, count: int, extreme: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Usable poses (n, 4, 4) with their exact readings (n, m), n >= count.

    extreme : share of configurations with every leg near an end of its range, which determine
    offsets best; the others are spread evenly over the ranges. Raises InputError if too few
    candidates are usable.
    """
    value, tried = 0, 0
    for attempt in range(6):
        tried = 8 * count * 3**attempt + 60
        poses, joints = _candidates(machine, tried, extreme, rng)
        keep = usable(machine, poses, joints)
        value = int(np.count_nonzero(keep))
        if value >= count:
            return poses[keep], joints[keep]
        if attempt and not value:  # a thousand candidates failed: more only make the user wait
            break
    raise InputError(
        what=f"mechanism {machine.name!r} has too few usable configurations in its joint ranges",
        found=f"{value} of {tried} tried",
        expected=f"{count}",
        next_step="check the ranges and centres in the mechanism file",
    )


def usable(machine: Machine, T_base_platform: Array, joints: Array) -> Booleans:
    """(n,) True where closed, in home's assembly mode, not singular, not tilted far, and legs are
    apart.
    """
    layout, values, home = machine.layout, machine.values, machine.home()
    c = closure(layout, values, joints, T_base_platform)
    at_home = closure(layout, values, machine.inverse(home[None])[0], home)
    rows, home_rows = scaled_rows(c), scaled_rows(at_home)
    good = np.abs(c.rows.value).max(axis=-1) < 1e-9
    # a machine that is close to singular at home is so everywhere, and is not refused for that
    good &= singularity_of(layout, rows) > min(
        LEAST_SINGULAR, 0.4 * float(singularity_of(layout, home_rows))
    )
    good &= sign_of(rows) == sign_of(home_rows)
    good &= T_base_platform[..., 2, 2] * np.sign(home[2, 2]) > np.cos(FARTHEST_TILT)
    good &= platform_unfolded(machine, T_base_platform)
    return good & _legs_apart(machine, T_base_platform, joints)


def platform_unfolded(machine: Machine, T_base_platform: Array) -> Booleans:
    """(n,) True where the parts of an articulated platform do not collide; True for a rigid
    platform.
    """
    turn = np.arctan2(T_base_platform[..., 1, 0], T_base_platform[..., 0, 0])
    return np.abs(turn) < FARTHEST_TURN * machine.most_turn[0]


def _candidates(
    machine: Machine, n: int, extreme: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Poses and readings that satisfy the closure equations, usable or not."""
    ranges = machine.joint_ranges
    share = rng.uniform(*READING_RANGE_SHARES, (n, machine.n_joints))
    ends = np.where(rng.random(share.shape) < 0.5, *READING_RANGE_SHARES)
    if not machine.layout.overdetermined:  # else no pose has every leg near an end
        share = np.where(rng.random((n, 1)) < extreme, ends, share)
    if ranges.size and np.isfinite(ranges).all():
        wanted = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        fk = machine.forward_result(wanted)
        # readings of a redundantly driven machine cannot be chosen freely: take the nearest pose
        near = fk.converged | machine.layout.overdetermined
        poses = fk.T_base_platform[near]
    else:
        poses = _around_home(machine, n, rng)
    joints = machine.inverse(poses)
    finite = np.isfinite(joints).all(axis=-1)
    if machine.layout.overdetermined and ranges.size:
        finite &= ~((joints < ranges[:, 0]) | (joints > ranges[:, 1])).any(axis=-1)
    return poses[finite], joints[finite]


def _around_home(machine: Machine, n: int, rng: np.random.Generator) -> Array:
    """Poses near home for machines without joint ranges.

    Within 15 degrees and an eighth of the machine's size; only poses that constant rods and joint
    axes allow.
    """
    a, b = (ends[0] for ends in reaches(machine))
    size = float(np.linalg.norm(np.concatenate([a, b]) - a.mean(axis=0), axis=1).max())
    scale = np.array([0.26, 0.26, 0.26, *np.full(3, 0.125 * size)])
    motion = machine.layout.motion
    delta = rng.uniform(-1, 1, (n, 6)) * scale @ motion @ motion.T
    value = on_manifold(machine.layout, machine.values, perturb(machine.home(), delta))
    return value.T_base_platform[value.converged]


def _legs_apart(machine: Machine, T_base_platform: Array, joints: Array) -> Booleans:
    """(n,) True where no two legs come nearer than their radii, nor a leg near another leg's guide.

    Legs with a common joint are exempt, as in nominal models that reduce the platform to a point:
    such legs come near each other nowhere else.
    """
    ends = machine.ends_at(joints, T_base_platform)
    along = np.linspace(0.06, 0.97, 24)[:, None]
    points = ends.a[..., None, :] * (1 - along) + ends.b[..., None, :] * along
    # components first: every sample of a leg is compared with every sample of another in long rows
    on_leg = np.ascontiguousarray(np.moveaxis(points, (-1, 1), (0, 1)))
    widths = np.array([r.max() if len(r) else 0.0 for r in machine.radii()])
    drives = drives_of(machine)
    apart = np.ones(T_base_platform.shape[0], dtype=bool)
    for i, j in np.ndindex(machine.n_legs, machine.n_legs):
        if j < i:
            thick = widths[i] + widths[j]
            gap = on_leg[:, i, :, :, None] - on_leg[:, j, :, None, :]
            gap *= gap
            meet = [
                np.linalg.norm(end[:, i] - end[:, j], axis=1) < thick for end in (ends.a, ends.b)
            ]
            nearest = np.sqrt((gap[0] + gap[1] + gap[2]).min(axis=(-1, -2)))
            apart &= (nearest > thick) | meet[0] | meet[1]
        # the legs of carriages side by side on one guide are beside that guide
        if j != i and drives.guides[j] and drives.away[i] @ drives.away[j] <= SIDE_BY_SIDE:
            for start, stop in pairwise(drives.ways[j]):
                axis = (stop - start) / np.linalg.norm(stop - start)
                s = np.clip((points[:, i] - start) @ axis, 0, (stop - start) @ axis)
                gap = points[:, i] - start - s[..., None] * axis
                apart &= (
                    np.sqrt(dot(gap, gap).min(axis=-1)) > widths[i] + GUIDE_SIDE_ROOM * widths[j]
                )
    return apart


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
    ends = machine.ends_at(joints, T_base_platform)
    along = np.linspace(0.06, 0.96, 12)[:, None]
    points = ends.a[..., None, :] * (1 - along) + ends.b[..., None, :] * along
    pixels = camera.project(apply(T_camera_base, points))
    share = camera.in_image(pixels, margin=6.0).mean(axis=-1)
    return (share.mean(axis=-1) > 0.8) & (share.min(axis=-1) > 0.4)
