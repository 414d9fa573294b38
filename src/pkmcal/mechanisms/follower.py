"""Forward kinematics for control loops: the pose at one set of readings after another.

At a single pose, NumPy's calls cost more than their arithmetic, so there are as few calls as
possible. The method is Newton's on ``|B - A|^2 - length^2 = 0``, from the last pose. The first step
uses the LU factors of the last search; a step that reduces the error too little triggers a new
factorisation.

The fast path covers machines with as many rods as freedoms whose ends are on elementary joints
(:class:`~pkmcal.mechanisms.carriers.contract.Chain`), without hinges on the platform: A is ``foot +
along q + across cos q + ahead sin q``, and B is ``R p + t + f``. All other machines, and steps that
do not converge, use the general search (:func:`~pkmcal.mechanisms.kinematics.forward`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.rigid import cross, dot, nearest_rotation, pose
from pkmcal.mechanisms.carriers.contract import Chain
from pkmcal.mechanisms.closure import scales
from pkmcal.mechanisms.kinematics import CONVERGED_CLOSURE_ERROR, forward
from pkmcal.mechanisms.layout import CarrierGroup, LimbLayout


@dataclass(frozen=True)
class FollowerOptions:
    """Constants of Newton's method from pose to pose."""

    # most steps; a pose 1 mm away takes three or four
    most_steps: int = 8
    # closure error (m) of all rods together at which a search ends
    closure_error: float = 0.1 * CONVERGED_CLOSURE_ERROR
    # ratio of squared errors after and before a step above which the next step needs new factors
    reused_factors_shrink: float = 1e-8
    # poses after which the rotation is orthonormalised; rounding is below 1e-12 by then
    poses_between_squarings: int = 512


FOLLOWER = FollowerOptions()


@dataclass(frozen=True)
class Rods:
    """Rods of a machine with n freedoms on elementary joints; vectors are columns, (3, n), m.

    along, across, ahead : coefficients of A in the joints' values q, see the module.
    turns, moves : whether any motor rotates A, and whether any moves it.
    on_body : (4, n) points p of the platform in homogeneous coordinates.
    still : f - foot.
    column, scale : q is ``scale * readings[column]``.
    length, grows : rods' lengths are ``length + grows q``.
    """

    along: Array
    across: Array
    ahead: Array
    turns: bool
    moves: bool
    on_body: Array
    still: Array
    column: Integers
    scale: Array
    length: Array
    grows: Array

    def ends(self, readings: Array) -> tuple[Array, Array]:
        """B - A without R p + t, (3, n), and the squared lengths, (n,)."""
        q = readings[self.column] * self.scale
        length = self.length + self.grows * q
        length *= length
        if not self.moves:
            return self.still, length
        off = self.still - self.along * q
        if self.turns:
            off -= self.across * np.cos(q)
            off -= self.ahead * np.sin(q)
        return off, length


def rods_of(layout: LimbLayout, theta: Array) -> Rods | None:
    """Rods of a machine with values theta (P,); None if the fast path does not cover it."""
    legs = np.flatnonzero(layout.closing)
    square = layout.n_equations == layout.motion.shape[1]
    if not square or not layout.rods_alone or layout.n_internal:
        return None
    n = layout.n_legs
    base, platform = (
        {j: one for j, one in leg_chains(groups, theta).items() if one is not None}
        for groups in (layout.base, layout.platform)
    )
    if len(base) < n or len(platform) < n:  # a carrier without an elementary joint
        return None
    foot, along, across, ahead, on_body, floating = np.zeros((6, n, 3))
    for j, chain in base.items():
        foot[j] = chain.point + chain.arm
        if chain.motion == "slide":
            along[j] = chain.axis
        elif chain.motion == "turn":
            straight = dot(chain.arm, chain.axis) * chain.axis
            foot[j], across[j] = chain.point + straight, chain.arm - straight
            ahead[j] = cross(chain.axis, chain.arm)
        elif chain.motion != "fixed":
            return None
    for j, chain in platform.items():
        on_body[j] = chain.point
        if chain.motion not in ("fixed", "float"):
            return None
        (on_body if chain.motion == "fixed" else floating)[j] += chain.arm
    driven = layout.actuated[legs] >= 0
    columns = (x[legs].T.copy() for x in (along, across, ahead, on_body, floating - foot))
    along, across, ahead, on_body, still = columns
    return Rods(
        along,
        across,
        ahead,
        bool(across.any()),
        bool(along.any() or across.any()),
        np.concatenate([on_body, np.ones((1, len(legs)))]),
        still,
        np.where(driven, layout.actuated[legs], 0),
        np.where(driven, scales(layout, theta)[legs], 0.0),
        theta[layout.rod[legs]],
        layout.rod_reads[legs].astype(float),
    )


def leg_chains(groups: tuple[CarrierGroup, ...], theta: Array) -> dict[int, Chain | None]:
    """Elementary joint of each leg on one side, None for a carrier without one."""
    chains: dict[int, Chain | None] = {}
    for group in groups:
        chain = group.carrier.chain(group.of(theta))
        for k, leg in enumerate(group.legs.tolist()):
            own = chain and Chain(chain.motion, chain.point[k], chain.axis[k], chain.arm[k])
            chains[leg] = own
    return chains


class Follower:
    """Forward kinematics of a moving machine: pose T_base_platform (4, 4) at readings (m,).

    Each call starts from the last pose, so readings should be those of a machine that moves by a
    few millimetres between calls and does not cross a singular pose. Made by
    :meth:`pkmcal.mechanisms.Machine.follower`.

    T_base_platform : the last pose. A call raises GeometryError if the machine cannot be closed at
        the readings; the last pose then stays.
    """

    def __init__(self, layout: LimbLayout, theta: Array, start: Array) -> None:
        from scipy.linalg import get_lapack_funcs

        self._layout, self._theta, self._rods = layout, theta, rods_of(layout, theta)
        functions: Any = get_lapack_funcs(("getrf", "getrs"), dtype=np.float64)
        self._getrf, self._getrs = functions
        self._ones, self._twist, self._free = np.ones(3), np.zeros(6), layout.freedoms
        self._reset(np.array(start, dtype=float))

    @property
    def T_base_platform(self) -> Array:
        """Last pose, (4, 4)."""
        return self._pose.copy()

    def __call__(self, joints: Array) -> Array:
        """Pose T_base_platform (4, 4) at readings (m,), m or rad; a new array each time."""
        readings = np.asarray(joints, dtype=float)
        if readings.shape != (self._layout.n_readings,):
            raise InputError(
                what="joints has the wrong shape",
                found=str(readings.shape),
                expected=f"({self._layout.n_readings},): one configuration at a time",
            )
        if self._rods is None or not self._newton(self._rods, readings):
            self._search(readings)
        return self._pose.copy()

    def _reset(self, T_base_platform: Array) -> None:
        """Set the pose, orthonormalised, and drop the factors."""
        self._pose = pose(nearest_rotation(T_base_platform[:3, :3]), T_base_platform[:3, 3])
        self._factors: tuple[Array, Array] | None = None
        self._enough, self._since = 0.0, 0

    def _search(self, readings: Array) -> None:
        """Set the pose found by the general search; raises GeometryError."""
        fk = forward(self._layout, self._theta, readings, self._pose)
        if not np.isfinite(readings).all() or not fk.converged:
            raise GeometryError(
                what="the machine cannot follow: it closes at no pose near the last one",
                found=f"closure error {float(fk.error) * 1e3:.3g} mm",
                expected="readings that the machine can reach, near those before them",
                next_step="check the readings, or begin anew with a start near the pose",
                code="readings.unreachable",
            )
        self._reset(fk.T_base_platform)

    def _newton(self, rods: Rods, readings: Array) -> bool:
        """Newton steps from the last pose; returns False, with no state changed, if they do not
        converge.

        The pose is perturbed from the left by a rotation omega about the base frame's origin and a
        shift tau, which change the row ``|line|^2 - length^2`` of a line B - A by 2
        (B x line, line) . (omega, tau). The factors are of half the derivatives, so the solution is
        twice the step.
        """
        off, square = rods.ends(readings)
        now, factors, twist = self._pose, self._factors, self._twist
        before = np.inf
        for _ in range(FOLLOWER.most_steps):
            b = now[:3].dot(rods.on_body)
            line = b + off
            residual = self._ones.dot(line * line)
            residual -= square
            error = float(residual.dot(residual))
            if not error < before:
                return False
            if factors is None or (
                error > FOLLOWER.reused_factors_shrink * before and before < np.inf
            ):
                factors = self._factors_at(b, line)
                self._enough = 4 * FOLLOWER.closure_error**2 * float(square.min())
            if error <= self._enough:
                self._factors, self._since = factors, self._since + 1
                if self._since == FOLLOWER.poses_between_squarings:
                    # Remove the rounding of many steps from the rotation.
                    self._since, now = 0, pose(nearest_rotation(now[:3, :3]), now[:3, 3])
                self._pose = now
                return True
            before = error
            twist[self._free] = self._getrs(*factors, residual)[0]
            now = _retracted_half_back(now, twist)
        return False

    def _factors_at(self, b: Array, line: Array) -> tuple[Array, Array]:
        """LU factors of half the derivatives of the rows by the freedoms, (n, n)."""
        rows = np.empty((6, line.shape[1]))
        rows[:3] = b[FIRST_CROSS_COMPONENTS] * line[SECOND_CROSS_COMPONENTS]
        rows[:3] -= b[SECOND_CROSS_COMPONENTS] * line[FIRST_CROSS_COMPONENTS]
        rows[3:] = line
        return self._getrf(rows[self._free].T)[:2]


FIRST_CROSS_COMPONENTS, SECOND_CROSS_COMPONENTS = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Indices of the components in a cross product: a[FIRST] b[SECOND] - a[SECOND] b[FIRST]."""


def _retracted_half_back(T_base_platform: Array, twice: Array) -> Array:
    """Pose (4, 4) moved from the left by minus half of (omega, tau), (6,).

    Cayley's map as in :func:`pkmcal.geometry.batches.stepped`, in plain Python numbers, which are
    faster for one pose.
    """
    x, y, z, a, b, c = twice.tolist()
    x, y, z = -0.25 * x, -0.25 * y, -0.25 * z
    s = 2 / (1 + x * x + y * y + z * z)
    move = np.array(
        [
            1 - s * (y * y + z * z), s * (x * y - z), s * (x * z + y), -0.5 * a,
            s * (x * y + z), 1 - s * (x * x + z * z), s * (y * z - x), -0.5 * b,
            s * (x * z - y), s * (y * z + x), 1 - s * (x * x + y * y), -0.5 * c,
            0.0, 0.0, 0.0, 1.0,
        ]
    )  # fmt: skip
    return move.reshape(4, 4).dot(T_base_platform)
