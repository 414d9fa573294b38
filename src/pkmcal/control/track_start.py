"""Why the machine is not seen where its readings put it: asked once, while it stands still."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.control.seen import SeenMachine, directions_of, seen_ends
from pkmcal.geometry.cylinders import line_through
from pkmcal.geometry.rigid import dot, pose_difference

FITS = float(np.deg2rad(5.0))
"""Angle between a leg as seen and as predicted, median over the legs, up to which it is the
assembly that was expected: a camera placed by hand is right to a few degrees, other assemblies
lie tens of degrees away."""


def misfit(seen: SeenMachine, normals: Array, T_base_platform: Array, readings: Array) -> float:
    """Median angle (rad) between the legs as seen, (s, 2, 3), and at a pose (4, 4)."""
    a, b = seen_ends(seen, T_base_platform, readings)
    known = np.isfinite(normals).all(axis=(-1, -2))
    cosine = dot(directions_of(normals[known]), line_through(a[known], b[known])[0])
    return float(np.median(np.arccos(np.clip(cosine, -1, 1))))


def nearest_assembly(
    seen: SeenMachine, normals: Array, readings: Array
) -> tuple[Array, float] | None:
    """Of all assemblies at the readings the one that the legs (s, 2, 3) show best, and its misfit;
    None where there is none. A search: takes a fraction of a second.
    """
    modes = seen.machine.assembly_modes(readings, np.random.default_rng(0))
    if not len(modes):
        return None
    angles = [misfit(seen, normals, T, readings) for T in modes]
    best = int(np.argmin(angles))
    return modes[best], angles[best]


def assembly_sentence(seen: SeenMachine, normals: Array, expected: Array, readings: Array) -> str:
    """What the legs show instead of the expected pose (4, 4)."""
    off = np.rad2deg(misfit(seen, normals, expected, readings))
    text = f"the legs point {off:.0f} degrees away from where the start and the readings put them"
    found = nearest_assembly(seen, normals, readings)
    if found is None or found[1] > FITS:
        return (
            f"{text}, and no other assembly fits them: check the readings' order and units,"
            " and the camera's place"
        )
    x, y, z = found[0][:3, 3]
    turn = np.rad2deg(np.linalg.norm(pose_difference(found[0], expected)[:3]))
    return (
        f"{text}; they show the assembly with the platform at ({x:.3f}, {y:.3f}, {z:.3f}) m,"
        f" turned by {turn:.0f} degrees against it: give that pose as start, or bring the machine"
        " back to the other assembly"
    )
