"""Poses all over a machine's workspace at which exports are compared with it."""

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
"""Least singular value of the scaled inverse Jacobian.

Nearer to singular poses, rounding of 1e-15 in a length moves the platform by more than the
comparison's tolerances.
"""
SAME_ELBOW_DIFFERENCE = 1e-9
"""Largest difference of readings, m or rad, with which inverse kinematics is on the same branch."""


def samples(
    machine: Machine, count: int = COMPARED_SAMPLES, seed: int = SAMPLES_SEED
) -> tuple[Array, Array]:
    """Poses (n, 4, 4) and their readings (n, m), n <= count, in the assembly mode of home.

    Raises ResultError if none is found.
    """
    rng = np.random.default_rng(seed)
    ranges = machine.joint_ranges
    # random readings within the ranges; of an overdetermined machine few would close, so there
    # poses near home are projected to the manifold instead
    if np.isfinite(ranges).all() and not machine.layout.overdetermined:
        wanted = rng.uniform(ranges[:, 0], ranges[:, 1], (4 * count, machine.n_joints))
        fk = machine.forward_result(wanted)
    else:
        away = machine.base_centers() - machine.home()[:3, 3]
        reach = float(np.linalg.norm(away, axis=1).mean())  # mean length of the limbs at home, m
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
    # readings that were put in come back unless inverse kinematics takes another branch
    if wanted is not None:
        good &= np.abs(joints - wanted).max(axis=-1) < SAME_ELBOW_DIFFERENCE
    if not good.any():
        raise ResultError(
            f"mechanism {machine.name!r} has no poses within its ranges to compare an export at",
            next_step="Check the ranges in the mechanism file",
            code="export.no_workspace",
        )
    return poses[good][:count], joints[good][:count]
