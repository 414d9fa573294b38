"""A machine judged on poses that another one saw, frames laid over each other first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.gauge import pose_generators
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.kinematics import forward, inverse_result

STEPS = 20
SETTLED = 1e-10
"""Frame change (m, rad) below which the frames are laid."""
OPEN = 1e-9
"""Share of the largest singular value below which a frame change moves no reading."""


@dataclass(frozen=True)
class Errors:
    """Errors of n configurations.

    residuals : (n, m) readings measured less predicted, m or rad. position, orientation : (n,) of
    the tool point, m and rad; NaN where the machine cannot be closed.
    """

    residuals: Array
    position: Array
    orientation: Array

    def of(self, rows: Integers) -> Errors:
        """Those of some configurations."""
        return Errors(self.residuals[rows], self.position[rows], self.orientation[rows])


def errors_on(machine: Machine, joints: Array, poses: Array) -> Errors:
    """Errors of a machine on seen poses T_base_platform (n, 4, 4) in another machine's frames.

    joints : (n, m). The frames of base and platform, which are a convention, are laid so that the
    readings agree best. What that takes up is given back by the degrees of freedom, so few
    configurations flatter nobody.
    """
    e, f, used = laid(machine, joints, poses)
    own = e @ poses @ inverse(f)
    readings, internal = inverse_result(machine.layout, machine.values, own)
    found = forward(machine.layout, machine.values, joints, own, internal)
    off = np.full((len(poses), 6), np.nan)
    ok = found.converged
    off[ok] = pose_difference(inverse(e) @ found.T_base_platform[ok] @ f, poses[ok])
    more = np.sqrt(joints.size / max(joints.size - used, 1))
    return Errors(
        (joints - readings) * more,
        np.linalg.norm(off[:, 3:], axis=1) * more,
        np.linalg.norm(off[:, :3], axis=1) * more,
    )


def laid(machine: Machine, joints: Array, poses: Array) -> tuple[Array, Array, int]:
    """Frame changes E, F (4, 4) after which E X F^-1 closes the machine best at the readings, and
    how many numbers of them the readings fix.

    Gauss-Newton on the closure; changes that it does not see are left alone.
    """
    e, f = np.eye(4), np.eye(4)
    used = 0
    for _ in range(STEPS):
        own = e @ poses @ inverse(f)
        internal = inverse_result(machine.layout, machine.values, own)[1]
        c = closure(machine.layout, machine.values, joints, own, np.nan_to_num(internal))
        jac = c.by_pose @ pose_generators(own)
        if machine.layout.n_internal:
            jac, value = _without_internal(c.by_internal, jac, c.value)
        else:
            value = c.value
        y, used = _least(jac.reshape(-1, 12), value.reshape(-1))
        e, f = perturb(np.eye(4), y[:6]) @ e, perturb(np.eye(4), y[6:]) @ f
        if np.abs(y).max() < SETTLED:
            break
    return e, f, used


def _least(jac: Array, value: Array) -> tuple[Array, int]:
    """The shortest step that is best, and its rank."""
    step, _, rank, _ = np.linalg.lstsq(jac, -value, rcond=OPEN)
    return step, int(rank)


def _without_internal(by_internal: Array, jac: Array, value: Array) -> tuple[Array, Array]:
    """Rows of the closure that hinges do not move."""
    q = np.linalg.qr(by_internal)[0]
    rest = np.eye(q.shape[-2]) - q @ np.swapaxes(q, -1, -2)
    return rest @ jac, (rest @ value[..., None])[..., 0]
