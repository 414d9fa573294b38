"""Shape of a machine for the viewer's stage: all lines and points, computed from the machine.

The viewer has no kinematics: each configuration that it draws is a :class:`Configuration` from
:func:`configurations`. Nothing here depends on the kind of a carrier; a new carrier is drawn by
its ``place``, ``skeleton`` and ``chain``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.cameras.frustum import frustum
from pkmcal.errors import InputError
from pkmcal.geometry.outlines import ring
from pkmcal.geometry.rigid import apply, rotation_vector
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.carriers.contract import Chain, base_carriers
from pkmcal.mechanisms.closure import base_ends, scales
from pkmcal.mechanisms.document import ActuatedLength
from pkmcal.mechanisms.follower import leg_chains
from pkmcal.mechanisms.motors import bodies
from pkmcal.outcome.blocks import machine as shapes
from pkmcal.outcome.blocks.base import Line, PoseRow, Vector
from pkmcal.web.motion import Postures, home_posture
from pkmcal.wording import DISPLAY_UNITS, number, split_name, with_unit

ARROW_LENGTH = {"m": 0.16, "rad": 0.6}
"""Lengths of the arrows of positive readings: a share of the machine's extent, and an angle."""
ARROW_POINTS = 9
ARROW_OFFSET = 0.035
"""Distance of straight arrows from the line that they run along, as a share of the extent."""
PATH_POINTS = 25
FRUSTUM_DEPTH = 0.2
"""Depth of the cameras' frusta, as a share of the extent."""
ASSUMED_RANGE = {"m": 0.2, "rad": np.pi / 4}
"""Half the range of a slider whose reading has no range in the file: a share of the machine's size,
and an angle."""
WORKSPACE_CONFIGURATIONS = 1500
WORKSPACE_GRID = 13
SAME_POINT = 1e-6
"""Distance, m, below which two points of an outline are one."""


def point(p: Array, decimals: int = 6) -> Vector:
    """Point (3,), m, rounded; to a micrometre by default."""
    x, y, z = (round(float(c), decimals) + 0.0 for c in p)
    return x, y, z


def pose_row(row: Array, decimals: int = 9) -> PoseRow:
    """Row (4,) of a pose, rounded; to a nanometre by default."""
    x, y, z, t = (round(float(c), decimals) + 0.0 for c in row)
    return x, y, z, t


def line(points: Array, decimals: int = 6) -> Line:
    """Points (n, 3) of a polyline."""
    return tuple(point(p, decimals) for p in points)


# ------------------------------------------------------------------ configurations


class LegLines(NamedTuple):
    """Lines of one leg at n postures, base frame, m.

    base : (n, k, 3) from where a motor holds the arm, if there is one, to A.
    platform : (n, k, 3) from the hinge of a bar, if there is one, to B.
    """

    base: Array
    platform: Array


def leg_lines(machine: Machine, postures: Postures) -> list[LegLines]:
    """Lines of all legs at n postures."""
    readings, poses = postures
    b = np.broadcast_to(machine.ends_at(readings, poses).b, (len(poses), machine.n_legs, 3))
    chains = leg_chains(machine.layout.platform, machine.values)
    out: list[LegLines] = []
    for j, arm in enumerate(machine.arms_at(readings)):
        base, platform = np.broadcast_to(arm, (len(poses), *arm.shape[-2:])), b[:, j, None]
        chain = chains[j]
        if chain is not None and chain.motion != "fixed":
            hinge = np.stack([apply(T, chain.point) for T in poses])
            platform = np.concatenate([hinge[:, None], platform], axis=1)
        out.append(LegLines(base, platform))
    return out


def configurations(machine: Machine, postures: Postures) -> list[shapes.Configuration]:
    """Machine at n postures, with the signs and zeros of its readings."""
    readings = postures.readings
    extent = extent_of(machine, home_posture(machine))
    lines = leg_lines(machine, postures)
    a, b = (np.stack([getattr(leg, side)[:, -1] for leg in lines], axis=1)
            for side in ("base", "platform"))  # fmt: skip
    zeros = machine.arms_at(np.zeros(machine.n_joints))
    offsets = np.where(machine.layout.closing, machine.values[machine.layout.rod], 0.0)
    low, high = machine.joint_ranges.T
    out: list[shapes.Configuration] = []
    for n, plain in enumerate(plain_configurations(postures, lines, decimals=6)):
        q, legs = readings[n], list[shapes.LegConfiguration]()
        positive = _positive_paths(machine, q, a[n], b[n], extent)
        for j, (leg, zero) in enumerate(zip(plain.legs, zeros, strict=True)):
            if machine.layout.lengthens[j]:
                along = b[n, j] - a[n, j]
                zero = (a[n, j] + offsets[j] * along / np.linalg.norm(along))[None]
            elif machine.layout.actuated[j] < 0:
                zero = np.zeros((0, 3))
            signs = {"positive": line(positive[j]), "zero": line(zero)}
            legs.append(leg.model_copy(update=signs))
        slack = 1e-9 * np.abs(q)
        beyond = np.flatnonzero((q < low - slack) | (q > high + slack))
        out.append(plain.model_copy(update={"legs": tuple(legs), "beyond": tuple(beyond.tolist())}))
    return out


def plain_configurations(
    postures: Postures, lines: Sequence[LegLines], decimals: int = 4
) -> list[shapes.Configuration]:
    """Configurations without the signs of the readings.

    decimals : of points in metres; a tenth of a millimetre by default.
    """
    return [
        shapes.Configuration(
            readings=tuple(round(float(x), decimals + 3) + 0.0 for x in q),
            T_base_platform=(
                pose_row(T[0], decimals + 3),
                pose_row(T[1], decimals + 3),
                pose_row(T[2], decimals + 3),
                pose_row(T[3], decimals + 3),
            ),
            rotation=point(rotation_vector(T[:3, :3])),
            legs=tuple(
                shapes.LegConfiguration(
                    base=line(leg.base[n], decimals),
                    platform=line(leg.platform[n], decimals),
                    positive=(),
                    zero=(),
                )
                for leg in lines
            ),
            beyond=(),
        )
        for n, (q, T) in enumerate(zip(*postures, strict=True))
    ]


def _positive_paths(machine: Machine, q: Array, a: Array, b: Array, extent: float) -> list[Array]:
    """Way of each leg's moving point as its reading grows from q (m,): the path of A, beside it if
    it is straight, or a line along the rod that grows.
    """
    layout, none = machine.layout, np.zeros((0, 3))
    out: list[Array] = [none for _ in range(machine.n_legs)]
    size = {unit: length * (extent if unit == "m" else 1) for unit, length in ARROW_LENGTH.items()}
    steps = np.array([size[unit] for unit in machine.joint_units])
    shares = np.linspace(0, 1, ARROW_POINTS)[:, None]
    paths = np.broadcast_to(
        base_ends(layout, machine.values, q + shares * steps).a, (ARROW_POINTS, *a.shape)
    )
    for j in np.flatnonzero(layout.actuated >= 0).tolist():
        along = b[j] - a[j]
        u = along / np.linalg.norm(along)
        if layout.lengthens[j]:
            arrow = a[j] + 0.5 * along + shares[[0, -1]] * size["m"] * u
        else:
            arrow = paths[:, j]
        ahead = arrow[-1] - arrow[0]
        ahead = ahead / np.linalg.norm(ahead)
        if np.abs(np.cross(arrow - arrow[0], ahead)).max() < 1e-6 * extent:
            # the side on which the rod is not; beside the rod itself, away from the machine's axis
            sideways = np.cross(ahead, [0.0, 0.0, 1.0]) if layout.lengthens[j] else -u
            sideways = sideways - (sideways @ ahead) * ahead
            if np.linalg.norm(sideways) < 1e-3:
                sideways = np.cross(ahead, [1.0, 0.0, 0.0])
            radius = max(machine.radii()[j], default=0.0)
            offset = ARROW_OFFSET * extent + float(radius)
            arrow = arrow[[0, -1]] + offset * sideways / np.linalg.norm(sideways)
        out[j] = arrow
    return out


def extent_of(machine: Machine, posture: Postures) -> float:
    """Largest side of the box around the joints at one posture, m."""
    points = [leg_part[0] for leg in leg_lines(machine, posture) for leg_part in leg]
    return float(np.ptp(np.concatenate(points), axis=0).max()) or 1.0


# ------------------------------------------------------------------ the machine


def machine_shape(
    machine: Machine,
    rows: Mapping[int, Sequence[shapes.Property]],
    cameras: Mapping[str, tuple[Camera, Array]],
    posture: Postures | None = None,
) -> shapes.Machine:
    """Machine of a stage.

    rows : parameters of each leg, from 0.
    cameras : camera and T_base_camera (4, 4) by name.
    posture : at which it is first drawn, without the signs of the readings and the workspace; home
        with both by default. Raises GeometryError for a machine that does not close at home.
    """
    if posture is None:
        at = home_posture(machine)
        (first,) = configurations(machine, at)
        workspace = workspace_points(machine)
    else:
        at, workspace = posture, np.zeros((0, 3))
        (first,) = plain_configurations(at, leg_lines(machine, at))
    extent = extent_of(machine, at)
    own = bodies(machine.document)
    ranges = slider_ranges(machine, at.readings[0])
    paths = _paths(machine, ranges)
    return shapes.Machine(
        name=machine.name,
        motion=machine.document.motion,
        legs=tuple(
            shapes.Leg(
                number=j + 1,
                reading=_index(machine.layout.actuated[j]),
                body=_index(own[j]),
                tubes=tuple(
                    shapes.Tube(radius=float(radius), start=tube.start, stop=tube.stop)
                    for radius, tube in zip(machine.radii()[j], leg.tubes, strict=True)
                ),
                path=line(paths[j]),
                rows=tuple(rows.get(j, ())),
            )
            for j, leg in enumerate(machine.document.legs)
        ),
        readings=_readings(machine, ranges),
        axes=tuple(_axes(machine)),
        base_outline=line(_outline(_feet(first, paths))),
        platform_outline=line(_outline(_platform_points(machine))),
        cameras=tuple(
            shapes.CameraShape(
                name=name,
                position=point(T[:3, 3]),
                lines=tuple(line(part) for part in frustum(camera, T, FRUSTUM_DEPTH * extent)),
            )
            for name, (camera, T) in cameras.items()
        ),
        workspace=line(workspace),
        home=first,
    )


def _index(value: Any) -> int | None:
    return None if value < 0 else int(value)


def slider_ranges(machine: Machine, readings: Array) -> Array:
    """Ranges (m, 2) of the sliders: the file's, or about the readings (m,) where it has none."""
    span = {"m": ASSUMED_RANGE["m"] * machine.size, "rad": ASSUMED_RANGE["rad"]}
    half = np.array([span[unit] for unit in machine.joint_units])
    assumed = np.stack([readings - half, readings + half], axis=-1)
    ranges = np.where(np.isfinite(machine.joint_ranges), machine.joint_ranges, assumed)
    return np.stack(
        [np.minimum(ranges[:, 0], readings), np.maximum(ranges[:, 1], readings)], axis=-1
    )


def _paths(machine: Machine, ranges: Array) -> list[Array]:
    """Path of A of each leg over its reading's range; (0, 3) if the reading does not move it."""
    q = ranges[:, 0] + np.linspace(0, 1, PATH_POINTS)[:, None] * np.diff(ranges, axis=1).T
    a = base_ends(machine.layout, machine.values, q).a
    a = np.broadcast_to(a, (PATH_POINTS, machine.n_legs, 3))
    paths = [a[:, j] for j in range(machine.n_legs)]
    moving = [np.ptp(path, axis=0).max() > SAME_POINT for path in paths]
    straight = [np.abs(path[12] - (path[0] + path[-1]) / 2).max() < SAME_POINT for path in paths]
    return [
        np.zeros((0, 3)) if not moves else path[[0, -1]] if is_straight else path
        for path, moves, is_straight in zip(paths, moving, straight, strict=True)
    ]


def _feet(home: shapes.Configuration, paths: list[Array]) -> Array:
    """Where each leg stands on the base, (L, 3): the motor of an arm, the lower end of a guide, or
    the joint.
    """
    feet: list[Any] = []
    for leg, path in zip(home.legs, paths, strict=True):
        on_guide = len(leg.base) == 1 and len(path) > 0
        feet.append(min(path, key=lambda p: p[2]) if on_guide else leg.base[0])
    return np.array(feet)


def _platform_points(machine: Machine) -> Array:
    """Joints of the rigid part of the platform, (L, 3), platform frame: a bar's is its hinge."""
    centres, chains = (
        machine.platform_centers(),
        leg_chains(machine.layout.platform, machine.values),
    )
    return np.array(
        [
            centre if (chain := chains[j]) is None or chain.motion == "fixed" else chain.point
            for j, centre in enumerate(centres)
        ]
    )


def _outline(points: Array) -> Array:
    """Closed polygon through the distinct points (n, 3); two points are a line, one is nothing."""
    distinct: list[Array] = []
    for p in points:
        if all(np.abs(p - other).max() > SAME_POINT for other in distinct):
            distinct.append(p)
    if len(distinct) < 2:
        return np.zeros((0, 3))
    return ring(np.array(distinct)) if len(distinct) > 2 else np.array(distinct)


def _axes(machine: Machine) -> Iterator[shapes.JointAxis]:
    """Axes of the joints: of turning carriers by their chain, of universal and revolute joints by
    the mechanism file or, in a planar machine, the plane's normal.
    """
    planar = machine.document.motion in ("planar", "planar-translation")
    sides = (
        ("base", machine.layout.base, machine.base_axes(), machine.base_centers()),
        ("platform", machine.layout.platform, machine.platform_axes(), machine.platform_centers()),
    )
    for side, groups, parameters, centres in sides:
        for j, chain in sorted(leg_chains(groups, machine.values).items()):
            node = getattr(machine.document.legs[j], side)
            turns = chain is not None and chain.motion == "turn"
            stated = getattr(node, "axis", None) if chain and chain.motion == "fixed" else None
            if chain is not None and turns:
                at, axis = chain.point, chain.axis
            elif np.isfinite(parameters[j]).all():
                at, axis = centres[j], parameters[j]
            elif stated is not None or (planar and node.joint == "revolute"):
                at, axis = centres[j], np.array(stated or (0.0, 0.0, 1.0))
            else:
                continue
            yield shapes.JointAxis(
                leg=j,
                side=side,
                point=point(at),
                direction=point(axis / np.linalg.norm(axis)),
                label=f"Axis of leg {j + 1}'s {node.joint} joint on the {side}",
            )


# ------------------------------------------------------------------ readings in words


def _readings(machine: Machine, ranges: Array) -> tuple[shapes.Reading, ...]:
    """Readings with their ranges and the sense of their signs."""
    layout, out = machine.layout, list[shapes.Reading]()
    chains = leg_chains(layout.base, machine.values)
    for k, (name, unit) in enumerate(zip(machine.joint_names, machine.joint_units, strict=True)):
        legs = np.flatnonzero(layout.actuated == k).tolist()
        direction, zero = _sense(machine, legs[0], chains[legs[0]])
        out.append(
            shapes.Reading(
                name=name,
                unit="rad" if unit == "rad" else "m",
                low=float(ranges[k, 0]),
                high=float(ranges[k, 1]),
                stated=bool(np.isfinite(machine.joint_ranges[k]).all()),
                legs=tuple(legs),
                direction=direction,
                zero=zero,
            )
        )
    return tuple(out)


def _sense(machine: Machine, j: int, chain: Chain | None) -> tuple[str, str]:
    """What a larger reading of leg j does, and where the reading is zero."""
    if machine.layout.lengthens[j]:
        offset = float(machine.values[machine.layout.rod[j]])
        length = "0" if abs(offset) < SAME_POINT else f"{number(offset * 1e3, 2)} mm"
        return "makes the leg longer", f"leg length {length}"
    at_zero = machine.arms_at(np.zeros(machine.n_joints))[j]
    where = f"joint at {millimetres(at_zero[-1])}"
    if chain is not None and chain.motion == "turn":
        arm = at_zero[-1] - at_zero[0]
        arm = arm / (np.linalg.norm(arm) or 1.0)
        return f"turns about {direction_text(chain.axis)}", f"arm along {direction_text(arm)}"
    if chain is not None and chain.motion == "slide":
        return f"moves along {direction_text(chain.axis)}", where
    middle = base_ends(machine.layout, machine.values, machine.middle_readings()).by_reading
    direction = np.broadcast_to(middle, (machine.n_legs, 3))[j]
    direction = direction / (np.linalg.norm(direction) or 1.0)
    return f"moves along {direction_text(direction)} at mid-range", where


AXIS_NAMES = {
    sign * k: f"{'+' if sign > 0 else '−'}{name}"
    for sign in (1, -1)
    for k, name in enumerate("xyz", start=1)
}
"""Names of the directions of the base's axes, by their number from 1 with its sign."""


def direction_text(direction: Array) -> str:
    """Direction as an axis of the base, such as +x, or as its components."""
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 1 - 1e-6:
        return AXIS_NAMES[(largest + 1) * int(np.sign(direction[largest]))]
    return f"({', '.join(number(float(c), 2) for c in direction)})"


def millimetres(p: Array) -> str:
    """Point (3,), m, as text in mm with one decimal, where it is not zero."""
    texts = (number(float(c) * 1e3, 1).removesuffix(".0") for c in p)
    return f"({', '.join(texts)}) mm"


def leg_rows(machine: Machine, sigma: Array | None) -> dict[int, list[shapes.Property]]:
    """Parameters of each leg, from 0, for people; vectors are one row.

    sigma : (P,) standard deviations; the prior sigmas by default.
    """
    table, out = machine.parameters, dict[int, list[shapes.Property]]()
    values = table.unit_axes(machine.values)
    spread = table.tolerance if sigma is None else sigma
    k = 0
    while k < len(values):
        leg, _ = split_name(table.names[k])
        stem = table.names[k].removesuffix(".x")
        width = 3 if stem != table.names[k] else 1
        scale, unit = DISPLAY_UNITS.get(table.units[k], (1.0, ""))
        places = {"mm": 2, "°": 3}.get(unit, 4)
        part = scale * values[k : k + width]
        text = with_unit(", ".join(number(float(x), places) for x in part), unit)
        largest = float(np.max(spread[k : k + width]))
        # of directions, which have no unit, the prior sigma is an angle
        factor, sigma_unit = DISPLAY_UNITS["rad"] if width == 3 and not unit else (scale, unit)
        if largest > 0:
            text += f" ± {with_unit(f'{factor * largest:.2g}', sigma_unit)}"
        if leg is not None:
            label = table.labels[k].removesuffix(" x")
            out.setdefault(leg - 1, []).append(
                shapes.Property(label=label[:1].upper() + label[1:], value=text)
            )
        k += width
    for j, leg in enumerate(machine.document.legs):
        rows = out.setdefault(j, [])
        kind = f"{leg.base.joint} on the base, {leg.platform.joint} on the platform"
        rows.insert(0, shapes.Property(label="Joints", value=kind))
        if isinstance(leg.length, ActuatedLength) or base_carriers()[leg.base.joint].driven:
            scale = np.broadcast_to(scales(machine.layout, machine.values), machine.n_legs)[j]
            if abs(scale - 1) > 1e-12 and not machine.layout.unsure_scales[j]:
                rows.append(shapes.Property(label="Reading scale", value=number(float(scale), 6)))
        if not leg.tubes:
            rows.append(shapes.Property(label="Tubes", value="none in the file; drawn thin"))
    return out


# ------------------------------------------------------------------ workspace


def workspace_points(machine: Machine) -> Array:
    """Positions (n, 3) of the platform's origin: at readings spread evenly over their ranges, in
    the assembly mode of home. Empty without ranges.

    Of a redundant machine, whose readings are not independent, positions at home's orientation.
    """
    none, ranges = np.zeros((0, 3)), machine.joint_ranges
    if not np.isfinite(ranges).all():
        return none
    (home,) = home_posture(machine).T_base_platform
    if machine.redundancy:
        try:
            grid = machine.grid(count=WORKSPACE_GRID)
        except InputError:  # no extent at this orientation
            return none
        directions = np.eye(3)[machine.layout.free[3:]]
        at = np.stack(np.meshgrid(*grid.axes, indexing="ij"), axis=-1)[grid.inside]
        return home[:3, 3] + at @ directions
    from scipy.stats.qmc import Halton

    spread = Halton(machine.n_joints, scramble=False).random(WORKSPACE_CONFIGURATIONS + 1)[1:]
    fk = machine.forward_result(ranges[:, 0] + spread * np.diff(ranges, axis=1)[:, 0], home)
    at_home = fk.converged & machine.same_assembly(fk.T_base_platform, home)
    return fk.T_base_platform[at_home, :3, 3]
