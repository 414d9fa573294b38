"""Whether a path of poses stays in the workspace and crosses no singular pose, and where not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb, pose_difference
from pkmcal.mechanisms.workspace import Limits, Reach, reachable

BETWEEN = 8
"""Poses looked at from one of the path's to the next."""
HALVINGS = 30


@dataclass(frozen=True)
class PathCheck:
    """What was found along a path of n poses; places count in poses, 2.5 is half way from the third
    to the fourth.

    inside : (n,) of the path's own poses. leaves : the first place where the path is outside the
        workspace, None where it stays. why : what stands against it there.
    crossings : places where the determinant changes its sign: a singular pose.
    closest : (place, singularity) nearest to a singular pose, of the poses looked at.
    readings : (n, m) along the path.
    """

    inside: Booleans
    leaves: float | None
    why: tuple[str, ...]
    crossings: tuple[float, ...]
    closest: tuple[float, float]
    readings: Array

    @property
    def usable(self) -> bool:
        """Whether a machine can follow the path."""
        return self.leaves is None and not self.crossings

    def __str__(self) -> str:
        place, least = self.closest
        if self.crossings:
            where = ", ".join(f"{x:.3f}" for x in self.crossings)
            return f"the path crosses a singular pose at {where} (poses count from 0)"
        if self.leaves is not None:
            reason = "; ".join(self.why)
            return (
                f"the path leaves the workspace at {self.leaves:.3f} (poses count from 0): {reason}"
            )
        return (
            f"the path stays in the workspace, and comes to {least:.2g} of a singular pose (1 is"
            f" far) at {place:.3f}"
        )


def check_path(limits: Limits, poses: Array, between: int = BETWEEN) -> PathCheck:
    """Look along a path T_base_platform (n, 4, 4), n >= 2, straight from each pose to the next.

    between : poses looked at from one to the next; a singular pose that is crossed twice within
    one of them, or a corner left so, is not seen.
    Raises InputError for a path that is none.
    """
    if poses.ndim != 3 or len(poses) < 2 or between < 1:
        raise InputError(
            what="a path needs two poses or more",
            found=f"an array of shape {poses.shape}",
            expected="(n, 4, 4)",
        )
    places = np.linspace(0, len(poses) - 1, (len(poses) - 1) * between + 1)
    found = reachable(limits, _at(poses, places))
    leaves, why = _leaving(limits, poses, places, found)
    nearest = np.where(np.isfinite(found.singularity), found.singularity, np.inf)
    k = int(np.argmin(nearest))
    own = slice(None, None, between)
    return PathCheck(
        inside=found.inside[own],
        leaves=leaves,
        why=why,
        crossings=_crossings(limits, poses, places, found),
        closest=(float(places[k]), float(nearest[k])),
        readings=found.readings[own],
    )


def _at(poses: Array, places: Array) -> Array:
    """Poses at places along the path."""
    first = np.minimum(places.astype(int), len(poses) - 2)
    step = pose_difference(poses[1:], poses[:-1])[first]
    return perturb(poses[first], (places - first)[:, None] * step)


def _leaving(
    limits: Limits, poses: Array, places: Array, found: Reach
) -> tuple[float | None, tuple[str, ...]]:
    """The first place outside and the reason there."""
    outside = np.flatnonzero(~found.inside)
    if not outside.size:
        return None, ()
    if outside[0] == 0:
        return 0.0, found.why(0)
    low, high = places[outside[0] - 1], places[outside[0]]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        good = bool(reachable(limits, _at(poses, np.array([middle]))).inside[0])
        low, high = (middle, high) if good else (low, middle)
    return float(high), reachable(limits, _at(poses, np.array([high]))).why(0)


def _crossings(limits: Limits, poses: Array, places: Array, found: Reach) -> tuple[float, ...]:
    """Places where the determinant changes its sign between two poses in reach."""
    reached = np.asarray(~found.lost.any(axis=-1))
    changes = np.diff(found.crossed.astype(int)) != 0
    at = np.flatnonzero(changes & reached[1:] & reached[:-1])
    low, high = places[at], places[at + 1]
    for _ in range(HALVINGS if at.size else 0):
        middle = (low + high) / 2
        same = reachable(limits, _at(poses, middle)).crossed == found.crossed[at]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return tuple(float(x) for x in high)
