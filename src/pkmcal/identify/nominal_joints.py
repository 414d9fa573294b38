"""Nominal joints, legs with a length, and frames of a machine, as used by [A]'s four steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import skew
from pkmcal.identify.gauge import centre_index, default_gauge
from pkmcal.mechanisms import Machine

PLANAR_REVOLUTE_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class NominalJoints:
    """Joints of a machine's nominal model, m; each body in its own frame.

    base, platform : (L, 3) centres.
    base_axes, platform_axes : (L, 3) unit, NaN without an axis.
    base_revolute, platform_revolute : (L,) legs that are perpendicular to an axis on that body, [A]
        7.
    torsion : (L,) legs that cannot twist, with an axis on each body.
    rod : (L,) offsets and constant lengths.
    closing : (L,) legs with a length.
    constant : (L,) legs of constant length.
    planar : all axes are the plane's normal.
    motion : (6, d) of the platform.
    """

    base: Array
    platform: Array
    base_axes: Array
    platform_axes: Array
    base_revolute: Booleans
    platform_revolute: Booleans
    torsion: Booleans
    rod: Array
    closing: Booleans
    constant: Booleans
    planar: bool
    motion: Array

    @property
    def directions(self) -> Array:
        """Observable directions on the base, (D, 3): revolute axes, or the normal of a planar
        machine.
        """
        return PLANAR_REVOLUTE_AXIS[None] if self.planar else self.base_axes[self.base_revolute]

    @property
    def framed(self) -> bool:
        """Whether the steps hold the machine's own frames, by three centres each."""
        return self.motion.shape[1] == 6 and bool(self.closing.all())


def nominal_joints(machine: Machine) -> NominalJoints:
    """Joints of the machine's nominal model."""
    layout, nominal = machine.layout, machine.parameters.nominal
    base, platform = (nominal[index] for index in centre_index(layout))
    base_axes, platform_axes = (
        np.where(index >= 0, nominal[index], np.nan)
        for index in (layout.base_axis, layout.platform_axis)
    )
    angles = layout.angles

    def having(equation: Booleans) -> Booleans:
        return np.isin(np.arange(len(base)), angles.leg[equation])

    closing = layout.rod >= 0
    return NominalJoints(
        base=base,
        platform=platform,
        base_axes=base_axes,
        platform_axes=platform_axes,
        base_revolute=having(angles.on_base & ~angles.on_platform),
        platform_revolute=having(angles.on_platform & ~angles.on_base),
        torsion=having(angles.on_base & angles.on_platform),
        rod=np.where(closing, nominal[layout.rod], 0.0),
        closing=closing,
        constant=closing & (layout.actuated < 0),
        planar=machine.document.motion == "planar",
        motion=layout.motion,
    )


def base_gauge(machine: Machine, legs: NominalJoints) -> Array:
    """Rows (6, 3 (L + D)) that fix the base frame, on the centres and then the directions.

    Three centres for a spatial machine ([A] 3.3, N_d = 3); for a planar machine its normal, its
    mean height, one centre and the direction to another (N_d = 2).
    """
    n, d = len(legs.base), len(legs.directions)
    if not legs.planar:
        rows = default_gauge(machine).constraints(machine)[:6]
        rows = rows[:, centre_index(machine.layout)[0].ravel()]
        return np.concatenate([rows, np.zeros((6, 3 * d))], axis=1)
    rows = np.zeros((6, n + d, 3))
    rows[:3, :n] = _plane_rows(legs.base)
    rows[3, :n, 2] = 1 / np.sqrt(n)
    rows[4, n, 0] = rows[5, n, 1] = 1.0
    return rows.reshape(6, -1)


def platform_gauge(machine: Machine, legs: NominalJoints) -> Array:
    """Rows (d, 3 L) that fix the platform frame on the centres of the legs with a length.

    As many rows as the platform's motion has directions; the others are determined, because the
    base frame is known at this step.
    """
    n = len(legs.platform)
    if legs.planar:
        rows = np.zeros((3, n, 3))
        rows[:, legs.closing] = _plane_rows(legs.platform[legs.closing])
        return rows.reshape(3, -1)
    if legs.framed:
        rows = default_gauge(machine).constraints(machine)[6:]
        return rows[:, centre_index(machine.layout)[1].ravel()]
    p = legs.platform - legs.platform[legs.closing].mean(axis=0)
    rows = np.zeros((6, n, 3))
    rows[:3] = skew(p).transpose(1, 0, 2)
    rows[3:] = np.eye(3)[:, None]
    rows[:, ~legs.closing] = 0
    return legs.motion.T @ rows.reshape(6, -1)


def _plane_rows(points: Array) -> Array:
    """Rows (3, n, 3) that fix points in the x-y plane: the first, and the direction to the
    farthest.
    """
    away = points[:, :2] - points[0, :2]
    far = int(np.argmax(np.linalg.norm(away, axis=1)))
    along = away[far] / np.linalg.norm(away[far])
    rows = np.zeros((3, len(points), 3))
    rows[0, 0, 0] = rows[1, 0, 1] = 1.0
    rows[2, far, :2] = -along[1], along[0]
    rows[2, 0, :2] = along[1], -along[0]
    return rows
