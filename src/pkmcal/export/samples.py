"""Poses all over a machine's workspace, at which an exported text is compared with it."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import ResultError
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import on_manifold

COMPARED_SAMPLES = 64
SAMPLES_SEED = 0
LEAST_SAMPLE_SINGULARITY = 0.05
"""Least singular value of the scaled inverse Jacobian: nearer to singular, 1e-15 of rounding in a
length moves a platform by more than comparisons allow."""
SAME_ELBOW_DIFFERENCE = 1e-9
"""Readings (m, rad) beyond which inverse kinematics chose another elbow than was put in."""


def samples(
    machine: Machine, count: int = COMPARED_SAMPLES, seed: int = SAMPLES_SEED
) -> tuple[Array, Array]:
    """Poses (n, 4, 4) and their readings (n, m), n <= count, in the home's assembly.

    Raises ResultError where there are none.
    """
    rng = np.random.default_rng(seed)
    ranges = machine.joint_ranges
    if np.isfinite(ranges).all() and not machine.layout.overdetermined:  # which few readings close
        wanted = rng.uniform(ranges[:, 0], ranges[:, 1], (4 * count, machine.n_joints))
        fk = machine.forward_result(wanted)
    else:
        away = machine.base_centers() - machine.home()[:3, 3]
        reach = float(np.linalg.norm(away, axis=1).mean())  # m, of the limbs at home
        shifts = rng.uniform(-1, 1, (4 * count, 6)) * [0.1, 0.1, 0.1, *[0.05 * reach] * 3]
        motion = machine.layout.motion
        shifted = perturb(machine.home(), shifts @ motion @ motion.T)
        fk = on_manifold(machine.layout, machine.values, shifted)
        wanted = None
    poses = fk.T_base_platform
    joints = machine.inverse(poses)
    good = (
        fk.converged
        & (fk.singularity > LEAST_SAMPLE_SINGULARITY)
        & np.isfinite(joints).all(axis=-1)
    )
    if wanted is not None:
        good &= np.abs(joints - wanted).max(axis=-1) < SAME_ELBOW_DIFFERENCE
    if not good.any():
        raise ResultError(
            f"mechanism {machine.name!r} has no poses within its ranges to compare an export at",
            next_step="Check the ranges in the mechanism file",
        )
    return poses[good][:count], joints[good][:count]
