"""The equations that joints' axes add to the closure, with exact derivatives; metres.

Each says that the limb's line d = B - A has no part along a direction w: ``d . w = 0``. A
revolute joint on the base has w = v, its unit axis ([A] eq. 7); on the platform w = R v'. A
universal-universal limb that cannot twist has ``w = v x R v'`` (errata, 3-UPU). In metres, so
that they stand beside lengths in one least-squares problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms.joints import equations
from pkmcal.mechanisms.schema import MechanismDocument


@dataclass(frozen=True)
class AngleLayout:
    """The E angle equations of a machine.

    leg : (E,). base, platform : (E, 3) positions of the axes' parameters (0 where there is none).
    on_base, on_platform : (E,) which of the axes each equation has; both for a torsion.
    """

    leg: Integers
    base: Integers
    platform: Integers
    on_base: Booleans
    on_platform: Booleans

    def __len__(self) -> int:
        return len(self.leg)


class AngleRows(NamedTuple):
    """Values (..., E) m, derivatives by the limb's line (..., E, 3), by the platform's turn
    (..., E, 3), and by the base and platform axes' parameters (..., E, 3) each.
    """

    value: Array
    by_line: Array
    by_turn: Array
    by_base_axis: Array
    by_platform_axis: Array


def angle_layout(document: MechanismDocument, base: Integers, platform: Integers) -> AngleLayout:
    """The equations of a document; base, platform : (L, 3) axes' positions, -1 for none."""
    found = equations(document)
    leg = np.array([j for j, _ in found], dtype=int)
    kinds = np.array([kind for _, kind in found], dtype=object)
    on_base = np.isin(kinds, ["revolute base", "torsion"])
    on_platform = np.isin(kinds, ["revolute platform", "torsion"])
    return AngleLayout(
        leg,
        np.where(on_base[:, None], base[leg], 0),
        np.where(on_platform[:, None], platform[leg], 0),
        on_base,
        on_platform,
    )


def angle_rows(layout: AngleLayout, theta: Array, rot: Array, line: Array) -> AngleRows:
    """The equations of the limbs' lines.

    theta : (..., P). rot : platform's rotation (..., 3, 3). line : (..., E, 3) B - A of each
    equation's leg, m.
    """
    first, second = layout.on_base[:, None], layout.on_platform[:, None]
    v, v_size = _unit(theta[..., layout.base], first)
    own, own_size = _unit(theta[..., layout.platform], second)
    turned = (rot[..., None, :, :] @ own[..., None])[..., 0]
    w = np.where(first & second, cross(v, turned), np.where(first, v, turned))
    by_v = np.where(second, cross(turned, line), line)
    by_turned = np.where(first, cross(line, v), line)
    by_own = (np.swapaxes(rot, -1, -2)[..., None, :, :] @ by_turned[..., None])[..., 0]
    return AngleRows(
        value=dot(line, w),
        by_line=w,
        by_turn=np.where(second, cross(turned, by_turned), 0.0),
        by_base_axis=np.where(first, _across(by_v, v) / v_size, 0.0),
        by_platform_axis=np.where(second, _across(by_own, own) / own_size, 0.0),
    )


def _unit(axis: Array, used: Booleans) -> tuple[Array, Array]:
    """Unit axes and their sizes (..., E, 1); z where an equation has none."""
    axis = np.where(used, axis, np.array([0.0, 0.0, 1.0]))
    size = np.sqrt(dot(axis, axis))[..., None]
    return axis / size, size


def _across(gradient: Array, axis: Array) -> Array:
    """The part of a gradient across a unit axis: its length changes nothing."""
    return gradient - dot(gradient, axis)[..., None] * axis
