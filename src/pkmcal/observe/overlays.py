"""Overlays on images: silhouettes of legs and joint centres, in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply, dot
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import (
    LegsInCamera,
    TubeList,
    edge_points,
    legs_in_camera,
    normals_of_edges,
    tubes_of,
    unobstructed,
)
from pkmcal.outcome.blocks import images as blocks
from pkmcal.outcome.blocks.base import leg_key
from pkmcal.wording import number

EDGE_CURVE_POINTS = 13
"""Points of an edge's curve; a mirror bends an edge by less than a pixel between two of them."""
EDGE_SIDE_NAMES = ("right", "left")
"""Names of sides 0 and 1 of a leg in an image, looking along the leg from A to B."""
EDGE_CURVE_FRACTIONS = np.linspace(0, 1, EDGE_CURVE_POINTS)
STRAIGHT_CURVE_DEVIATION = 0.1
"""Largest deviation from the chord, px, of a curve that is reduced to its two ends."""
FINE_EDGE_CURVE_POINTS = 65
"""Points of a predicted curve, so that occlusion by other legs is resolved to 1/64 of a leg."""
LEG_NUMBER_WIDTH = 0.04
"""Width of a leg's number and its joint mark, in image widths."""
PIXEL_DECIMALS = 2
"""Decimals of pixels in a document."""


@dataclass(frozen=True)
class EdgeCurve:
    """Edge as a polyline in pixels.

    leg : from 1.
    points : n pairs (x, y).
    quiet : not in use; dashed.
    tip : tooltip.
    strip : index of its rectified strip, None without one.
    """

    leg: int
    points: tuple[tuple[float, float], ...]
    quiet: bool
    tip: str
    strip: int | None = None


def edge_name(leg: int, tube: int, side: int) -> str:
    """Name of an edge of a leg's tube; leg, tube and side count from 0."""
    return f"leg {leg + 1}, tube {tube + 1}, {EDGE_SIDE_NAMES[side]} edge"


def polyline(
    leg: int, points: Sequence[Sequence[float]], quiet: bool, tip: str
) -> EdgeCurve | None:
    """Polyline through the points of :func:`straightened`; None for fewer than two.

    leg : from 0.
    """
    if len(points) < 2:
        return None
    return EdgeCurve(leg + 1, tuple((x, y) for x, y in points), quiet, tip)


@dataclass(frozen=True)
class Spot:
    """Joint centre in pixels, of the calibrated and of the nominal model.

    leg : from 1.
    calibrated : pixel by the model of the overlay.
    nominal : pixel by the nominal model, None without comparison.
    labelled : whether the leg's number stands here.
    """

    leg: int
    end: Literal["base", "platform"]
    calibrated: tuple[float, float]
    nominal: tuple[float, float] | None
    labelled: bool

    @property
    def tip(self) -> str:
        """Tooltip: name of the joint, and distance between the two models."""
        if self.nominal is None:
            return f"Leg {self.leg}, {self.end} joint"
        away = float(np.hypot(*np.subtract(self.calibrated, self.nominal)))
        return f"Leg {self.leg}, {self.end} joint: nominal model {number(away, 1)} px away"


def edge_layer(name: blocks.LayerName, edges: Sequence[EdgeCurve]) -> blocks.Layer:
    """Layer of edges in their legs' colours."""
    digits = PIXEL_DECIMALS
    shapes = tuple(
        blocks.Polyline(
            points=tuple((round(x, digits), round(y, digits)) for x, y in one.points),
            key=leg_key(one.leg),
            tip=one.tip,
            dashed=one.quiet,
            strip=one.strip,
        )
        for one in edges
    )
    return blocks.Layer(name=name, shapes=shapes)


def joint_layers(spots: Sequence[Spot]) -> tuple[blocks.Layer, ...]:
    """Layers of joint centres, and of those of the nominal model where it is compared."""
    rings = tuple(
        blocks.Ring(
            at=one.calibrated,
            key=leg_key(one.leg),
            tip=one.tip,
            label=str(one.leg) if one.labelled else "",
        )
        for one in spots
    )
    crosses = tuple(
        blocks.Cross(at=one.nominal, key=leg_key(one.leg))
        for one in spots
        if one.nominal is not None
    )
    layers = blocks.Layer(name="joints", shapes=rings), blocks.Layer(name="nominal", shapes=crosses)
    return tuple(layer for layer in layers if layer.shapes)


def machine_laid_over(
    machine: Machine,
    camera: Camera,
    T_camera_base: Array,
    joints: Array,
    T_base_platform: Array,
) -> tuple[tuple[EdgeCurve, ...], tuple[Spot, ...]]:
    """Visible silhouettes of a machine's tubes in an image, and its joint centres.

    Parts of a silhouette that another leg occludes are left out.

    joints : (m,) readings.
    T_base_platform : (4, 4).
    """
    tubes = tubes_of(machine)
    legs = legs_in_camera(machine, T_camera_base, T_base_platform[None], joints[None])
    points = edge_points(machine, camera, legs, tubes, FINE_EDGE_CURVE_POINTS)
    clear = unobstructed(machine, camera, legs, tubes, points, 0.0)[0]
    edges: list[EdgeCurve] = []
    # each visible stretch is a polyline of its own
    for e, (curve, visible) in enumerate(zip(points.pixel[0], clear, strict=True)):
        leg, tip = int(tubes.leg[e]), f"Leg {tubes.leg[e] + 1}, tube {tubes.tube[e] + 1}"
        ends = np.flatnonzero(np.diff(np.concatenate([[False], visible, [False]])))
        runs = [(a, b) for a, b in pairwise(ends.tolist()) if visible[a] and b - a > 1]
        parts = (straightened(curve[None, start:stop])[0] for start, stop in runs)
        lines = (polyline(leg, part, False, tip) for part in parts)
        edges += [line for line in lines if line]
    joint_ends = machine.ends_at(joints, T_base_platform)
    both = camera.project(apply(T_camera_base, np.stack([joint_ends.a, joint_ends.b])))
    return tuple(edges), _spots(both, camera.in_image(both), camera.image_size[0])


def measured_curves(
    machine: Machine,
    camera: Camera,
    legs: LegsInCamera,
    image: Integers,
    edges: EdgeSet,
    fraction: Array = EDGE_CURVE_FRACTIONS,
) -> Array:
    """Curves (n, m, 2) px of measured edges in images of one station.

    The rays of the predicted contour, each projected into the measured plane: r - (r . n) n.

    legs : (K, L, 3) axes in each image, camera frame.
    image : (n,) index of each edge's image.
    fraction : (m,) positions along the edges' spans.
    """
    # rays to the contour, moved from the axis to the measured side
    along = edges.span[:, :1] + (edges.span[:, 1:] - edges.span[:, :1]) * fraction
    radius = machine.radii_of(edges.leg, edges.tube)
    at = image, edges.leg
    axis = legs.a[at][:, None] + along[..., None] * legs.u[at][:, None]
    normal = edges.normal[:, None]
    rays = axis + radius[:, None, None] * normal
    rays = rays - dot(rays, normal)[..., None] * normal
    return camera.project(rays)


def own_edges(
    machine: Machine, legs: LegsInCamera, image: Integers, edges: EdgeSet, outward: float = 0.0
) -> EdgeSet:
    """Edges with the normals that the machine predicts; arguments as :func:`measured_curves`.

    outward : px by which the predicted edges are shifted.
    """
    radius = machine.layout.radius_of(edges.leg, edges.tube)
    start, stop = edges.span.T
    each = TubeList(edges.leg, edges.tube, edges.side, start, stop, radius)
    at = image, edges.leg
    own, _ = normals_of_edges(legs.a[at], legs.u[at], machine.values[radius], each)
    own = own + outward * (edges.basis @ edges.shift[..., None])[..., 0]
    return replace(edges, normal=own / np.sqrt(dot(own, own))[..., None])


def offsets_across_curves(expected: Array, measured: Array) -> tuple[Array, Array]:
    """Normals of predicted curves and offsets of measured curves along them.

    expected, measured : (n, m, 2) px. Returns unit normals (n, m, 2) and offsets (n, m), px.
    """
    tangent = np.gradient(expected, axis=1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal, dot(normal, measured - expected)


def residual_words(shift: float, tilt: float, weight: float) -> str:
    """Residual of an edge, in standard deviations, and its robust weight, in words."""
    return (
        f"residual {number(shift, 1, signed=True)} σ across, {number(tilt, 1, signed=True)} σ tilt;"
        f" weight {number(weight, 2)}"
    )


def straightened(curves: Array) -> list[list[list[float]]]:
    """Finite points of each curve (n, m, 2); of a curve that is straight only its two ends."""
    finite: Booleans = np.asarray(np.isfinite(curves).all(axis=-1))
    row = np.arange(len(curves))
    curves = np.where(finite[..., None], curves, np.nan)
    first = curves[row, np.argmax(finite, axis=1)]
    last = curves[row, -1 - np.argmax(finite[:, ::-1], axis=1)]
    # straight: no point is farther from the chord than the limit
    chord, off = last - first, curves - first[:, None]
    # twice the area with the chord: the distance from it, times its length
    area = np.abs(chord[:, :1] * off[..., 1] - chord[:, 1:] * off[..., 0])
    most = np.max(area, axis=1, where=finite, initial=0.0)
    straight = (most <= STRAIGHT_CURVE_DEVIATION * np.hypot(*chord.T)) & (finite.sum(axis=1) > 2)
    ends = np.stack([first, last], axis=1).tolist()
    return [ends[k] if straight[k] else curves[k, finite[k]].tolist() for k in row]


def _spots(pixel: Array, visible: Booleans, width: int) -> tuple[Spot, ...]:
    """Joint centres in an image, from pixels (2, L, 2) on base and platform.

    Each leg's number stands at its joint with more room to other numbers.
    """
    room, labels, spots = width * LEG_NUMBER_WIDTH, list[Array](), list[Spot]()
    for j in range(pixel.shape[1]):
        free = [min((np.hypot(*(p - q)) for q in labels), default=np.inf) for p in pixel[:, j]]
        at = [end for end in (0, 1) if visible[end, j]]
        # at the base, if both have room
        best = max(at, key=lambda end: (min(free[end], room), -end), default=None)
        for end in at:
            x, y = pixel[end, j]
            place = round(float(x), 1), round(float(y), 1)
            name: Literal["base", "platform"] = "platform" if end else "base"
            spots.append(Spot(j + 1, name, place, None, end == best))
        if best is not None:
            labels.append(pixel[best, j])
    return tuple(spots)
