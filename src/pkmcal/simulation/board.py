"""Calibration board in the simulated scene: exact geometry of its print, and a visible pose.

The board is a thin plate whose print is part of its shape. Black and white are separate faces, so
the renderer averages over the pixels between them as along every silhouette, and a printed corner
is accurate to a hundredth of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, final

import numpy as np

from pkmcal.arrays import Array, Integers, evenly
from pkmcal.boards.board import Board, board_from_document
from pkmcal.boards.prints import Print
from pkmcal.cameras import Camera
from pkmcal.errors import GeometryError
from pkmcal.geometry.rigid import apply, cross, inverse, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.drives import ball_of, legs_space
from pkmcal.session.schema import BoardBody
from pkmcal.simulation.render import ScenePart
from pkmcal.simulation.scene import Discs, Finish, discs_of, machine_parts
from pkmcal.simulation.shapes import Box, Cylinder, Shape, turned_components
from pkmcal.simulation.surfaces import Material, Pattern, SmoothNoise
from pkmcal.wording import percentage

BOARD_THICKNESS = 0.004
"""Thickness of the plate, in metres."""
HOLDER_ROD_RADIUS = 0.08
"""Radius of the rod that holds a board on the platform, relative to the platform's radius."""
PRINTED_BLACK_LIGHT = 0.06
"""Reflectance of printed black relative to white."""
MADE_BOARD_SQUARES = {"base": (6, 5), "platform": (5, 4)}
"""Squares (columns, rows) of a generated board: few and large, to be detected from a distance."""
BASE_BOARD_DIAGONAL = 1.4
"""Diagonal of a board on the base with its margin, in radii of the base."""
PLATFORM_BOARD_DIAGONAL = 2.0
"""Diagonal of a board on the platform with its margin, in radii of the platform."""
PICTURED_BOARD_DIAGONAL = 0.75
"""Minimum diagonal of a board on the platform, in radii of the machine's workspace. Cameras are so
far away that the whole workspace is in view, and the board has to fill enough of the image."""
BOARD_TRIAL_CONFIGURATIONS = 6
"""Number of configurations at which candidate poses of a board are tried."""
SLANTED_BOARD_COSINE = 0.6
"""Cosine of the angle between the board's normal and the line of sight below which fewer corners
are detected."""
STANDING_BOARD_LEAN = 0.25
"""Angle, in rad, by which a standing board leans and turns away from the mean direction of the
cameras."""
LEAST_VISIBLE_CORNERS = 0.4
"""Mean share of a board's corners that every station has to see."""
VISIBILITY_ADVICE = {
    "base": "put the stations higher, or use a wider lens",
    "platform": "put the stations on one side of the machine, or use one",
}
"""Advice for a station that sees fewer corners, by the body that carries the board."""


@final
@dataclass(frozen=True)
class Sheet(Shape):
    """Printed plate: a box with T_outer_board (4, 4) and a print on one face."""

    box: Box
    T_outer_board: Array
    print: Print

    @classmethod
    def at(cls, board: Board, T_outer_board: Array) -> Sheet:
        """Plate of a board with a white margin of half a square round its print."""
        printed = Print.of(board)
        low = np.array([printed.x[0], printed.y[0]])
        high = np.array([printed.x[-1], printed.y[-1]])
        part = next(key for key in ("square", "marker", "spacing") if key in board.document)
        margin = 0.5 * board.document[part]
        middle = np.array([*(low + high) / 2, BOARD_THICKNESS / 2])
        half = np.array([*(high - low) / 2 + margin, BOARD_THICKNESS / 2])
        box = Box(apply(T_outer_board, middle), T_outer_board[:3, :3].T, half)
        return cls(box, T_outer_board, printed)

    def enter(self, origin: Array, d: Array) -> Array:
        """Distance to the plate's box, as in `Shape.enter`."""
        return self.box.enter(origin, d)

    def normal(self, points: Array) -> Array:
        """Outward normals of the plate's box."""
        return self.box.normal(points)

    def local(self, points: Array) -> Array:
        """Surface points (3, n) in the board's frame."""
        T = inverse(self.T_outer_board)
        return turned_components(T[:3, :3], points) + T[:3, 3:]

    def face(self, points: Array) -> Integers:
        """Face number: 0 white, 1 black, 2 the sides and the back of the plate."""
        q = self.local(points)
        dark = self.print.dark_at(q[0], q[1])
        return np.where(q[2] < BOARD_THICKNESS / 2, dark.astype(np.int16), np.int16(2)).astype(
            np.int16
        )

    def balls(self) -> tuple[Array, Array]:
        """Bounding balls of the plate's box."""
        return self.box.balls()


@final
@dataclass(frozen=True)
class Printed(Pattern):
    """Pattern of black and white from the print, at points in the board's frame."""

    print: Print

    def factor(self, q: Array) -> Array:
        """Factors (n,): PRINTED_BLACK_LIGHT on black, 1 on white and on the plate's other sides."""
        dark = self.print.dark_at(q[0], q[1]) & (q[2] < BOARD_THICKNESS / 2)
        return np.where(dark, PRINTED_BLACK_LIGHT, 1.0)


def board_part(board: Board, T_base_board: Array) -> ScenePart:
    """Matt plate of a board as a part of the scene."""
    sheet = Sheet.at(board, T_base_board)
    return ScenePart(sheet, Material(0.75, Printed(sheet.print)))


def holder_part(
    board: Board, T_platform_board: Array, T_base_platform: Array, discs: Discs
) -> ScenePart:
    """Rod that holds a board on the platform, from the platform's plate to the board's back."""
    low, high = board.points.min(axis=0), board.points.max(axis=0)
    back = (low + high) / 2 + np.array([0.0, 0.0, BOARD_THICKNESS])
    lift = discs.platform_side * discs.thickness * np.array([0.0, 0.0, 1.0])
    start = apply(T_base_platform, discs.platform + lift)
    end = apply(T_base_platform @ T_platform_board, back)
    length = float(np.linalg.norm(end - start))
    shape = Cylinder(
        start, (end - start) / length, HOLDER_ROD_RADIUS * discs.platform_radius, length
    )
    return ScenePart(shape, Material(0.05))


def board_for(machine: Machine, on: BoardBody = "base") -> Board:
    """ChArUco board in proportion to the machine, by BASE_BOARD_DIAGONAL on the base, and by
    PLATFORM_BOARD_DIAGONAL and PICTURED_BOARD_DIAGONAL on the platform.
    """
    discs = discs_of(machine)
    diagonal = BASE_BOARD_DIAGONAL * discs.base_radius
    if on == "platform":
        space = ball_of(legs_space(machine))[1]
        diagonal = max(
            PLATFORM_BOARD_DIAGONAL * discs.platform_radius, PICTURED_BOARD_DIAGONAL * space
        )
    squares = MADE_BOARD_SQUARES[on]
    square = round(diagonal / float(np.hypot(squares[0] + 1, squares[1] + 1)), 3)
    return board_from_fields(
        {
            "type": "charuco",
            "squares": list(squares),
            "square": square,
            "marker": round(0.75 * square, 4),
            "dictionary": "DICT_4X4_50",
            "tolerance": 0.0,
        }
    )


def board_from_fields(fields: dict[str, Any]) -> Board:
    """Board with the fields of a board.yaml."""
    from pathlib import Path

    from pkmcal.files import Document

    return board_from_document(Document(Path(), "", fields, {}))


def place_board(
    machine: Machine,
    board: Board,
    on: BoardBody,
    cameras: tuple[Camera, ...],
    T_camera_base: Array,
    T_base_platform: Array,
    joints: Array,
    rng: np.random.Generator,
) -> Array:
    """Best visible pose (4, 4) of the board on the base or the platform, in that body's frame.

    On the base the candidates lie on the base plate, beside it, or stand behind it; on the platform
    they are held by a bracket above the plate. T_camera_base : (S, 4, 4). T_base_platform (K, 4, 4)
    and joints (K, m) : configurations of the session. Visible corners are those that no part of the
    machine occludes; a candidate's score is the share of the station that sees least. Raises
    GeometryError if that share is below LEAST_VISIBLE_CORNERS for all candidates.
    """
    discs = discs_of(machine)
    # candidate poses, in the frame of the board's body
    places: list[Array] = []
    if on == "base":
        eyes = inverse(T_camera_base)[:, :3, 3]
        places = [*_lying(board, discs, rng), *_standing(board, discs, eyes, rng)]
    finish = Finish.from_noise(SmoothNoise.from_rng(rng))
    if on == "platform":
        places = _brackets(board, discs, rng)
    # machine and board's body at a few configurations
    few = evenly(len(joints), BOARD_TRIAL_CONFIGURATIONS)
    carried = (
        T_base_platform[few] if on == "platform" else np.broadcast_to(np.eye(4), (few.size, 4, 4))
    )
    scenes = [machine_parts(machine, discs, finish, T_base_platform[k], joints[k]) for k in few]
    # visible share of each candidate: mean over configurations, least over stations
    there = np.stack(places)
    visible = np.min(
        [
            np.mean(
                [
                    _visible_shares(board, T, parts, eye, T_base_body @ there)
                    for parts, T_base_body in zip(scenes, carried, strict=True)
                ],
                axis=0,
            )
            for eye, T in zip(cameras, T_camera_base, strict=True)
        ],
        axis=0,
    )
    best = int(np.argmax(visible))
    if visible[best] < LEAST_VISIBLE_CORNERS:
        raise GeometryError(
            f"there is no place on the {on} where all stations see the board",
            found=f"{percentage(visible[best])} of its corners at most",
            expected=percentage(LEAST_VISIBLE_CORNERS),
            next_step=VISIBILITY_ADVICE[on],
        )
    return places[best]


def _brackets(board: Board, discs: Discs, rng: np.random.Generator) -> list[Array]:
    """Candidates beyond the board's foot, facing away from it and to all sides."""
    low, high = board.points.min(axis=0), board.points.max(axis=0)
    reach = 0.6 * float(np.linalg.norm(high - low))
    up = np.array([0.0, 0.0, discs.board_side])
    # below the plate the board would lie in the plate's shadow
    out_of = discs.platform_radius if discs.board_side < 0 else 0.0
    out: list[Array] = []
    for direction, lean in product(
        2 * np.pi * (np.arange(12) + rng.random()) / 12, (0.3, 0.8, 1.3)
    ):
        side = np.array([np.cos(direction), np.sin(direction), 0.0])
        into = -(np.cos(lean) * up + np.sin(lean) * side)
        right = cross(up, into)
        right = right / np.linalg.norm(right)
        rot = np.stack([right, cross(into, right), into], axis=-1)
        rot = rotation(rng.normal(0, 0.05, 3)) @ rot
        centre = discs.board_foot + (np.sin(lean) * reach + 0.01) * up + out_of * side
        out.append(pose(rot, centre - rot @ ((low + high) / 2)))
    return out


def _lying(board: Board, discs: Discs, rng: np.random.Generator) -> list[Array]:
    """Candidates on the base plate and beside it, turned at random, the print towards the
    platform.
    """
    low, high = board.points.min(axis=0), board.points.max(axis=0)
    up = discs.side
    # axes of the board; z points into the board, away from the platform
    flat = np.diag([1.0, -up, -up])
    radius = discs.base_radius + 0.65 * float(np.linalg.norm(high - low))
    ring = 2 * np.pi * (np.arange(12) + rng.random()) / 12
    spots = [np.zeros(2), *(radius * np.stack([np.cos(ring), np.sin(ring)], axis=-1))]
    heights = [BOARD_THICKNESS, *np.full(len(ring), BOARD_THICKNESS - discs.thickness)]
    out: list[Array] = []
    for spot, height in zip(spots, heights, strict=True):
        lean = rotation(np.array([*rng.normal(0, 0.01, 2), rng.uniform(-np.pi, np.pi)]))
        centre = discs.base + np.array([*spot, up * height])
        # a tilted board rests on its lowest corner
        rise = up * 0.02 * float(np.linalg.norm(high - low))
        rot = lean @ flat
        out.append(pose(rot, centre + np.array([0, 0, rise]) - rot @ ((low + high) / 2)))
    return out


def _standing(board: Board, discs: Discs, eyes: Array, rng: np.random.Generator) -> list[Array]:
    """Candidates upright behind the machine at several heights, facing the middle of the
    cameras.
    """
    direction = (eyes - discs.base).mean(axis=0)[:2]
    if np.linalg.norm(direction) < 0.4 * np.linalg.norm((eyes - discs.base)[:, :2], axis=1).mean():
        return []  # cameras stand all round: some would see only the back
    direction = np.append(direction / np.linalg.norm(direction), 0.0)
    low, high = board.points.min(axis=0), board.points.max(axis=0)
    out: list[Array] = []
    for depth, lateral, height in product(
        (0.6, 1.2), (-1.2, -0.6, 0.0, 0.6, 1.2), np.arange(0.2, 2.6, 0.15)
    ):
        # x to the right of a viewer, y down, z into the board
        right = np.cross([0.0, 0.0, 1.0], direction)
        flat = np.stack([right, [0.0, 0.0, -1.0], -direction], axis=-1)
        # seen from straight ahead, a board hardly determines its tilt
        slant = rotation(STANDING_BOARD_LEAN * right) @ rotation(
            np.array([0.0, 0.0, STANDING_BOARD_LEAN])
        )
        rot = rotation(rng.normal(0, 0.05, 3)) @ slant @ flat
        centre = discs.base + discs.base_radius * (lateral * right - depth * direction)
        centre = centre + discs.side * height * discs.base_radius * np.array([0, 0, 1])
        out.append(pose(rot, centre - rot @ ((low + high) / 2)))
    return out


def _visible_shares(
    board: Board, T_camera_base: Array, parts: list[ScenePart], camera: Camera, T_base_board: Array
) -> Array:
    """Visible share (P,) of a board's corners at each candidate pose (P, 4, 4).

    Corners seen at a slant, below SLANTED_BOARD_COSINE, count in proportion.
    """
    points = apply(T_base_board[:, None], board.points)
    pixels = camera.project(apply(T_camera_base, points))
    eye = inverse(T_camera_base)[:3, 3]
    rays = points - eye
    distance = np.linalg.norm(rays, axis=-1)
    rays = rays / distance[..., None]
    facing = np.clip(
        np.sum(T_base_board[:, None, :3, 2] * rays, axis=-1) / SLANTED_BOARD_COSINE, 0, 1
    )
    visible = camera.in_image(pixels, margin=10.0)
    # the rays of all candidates together: a call for one shape has a fixed cost
    ways = np.ascontiguousarray(rays[visible].T)
    hit = np.min([part.shape.enter(eye[:, None], ways) for part in parts], axis=0)
    visible[visible] = hit > distance[visible] - 1e-4
    return np.mean(visible * facing, axis=-1)
