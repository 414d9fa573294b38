"""Errors of a machine against a reference machine, such as a simulation's truth.

Frames are conventions: the same machine in other frames has other parameters, and its poses differ
by the frames. So the frames of base and platform are first aligned to the reference by all joint
centres ([B] eq. 15), and the remaining difference is the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.errors import InputError
from pkmcal.identify.centres import joint_centres
from pkmcal.identify.tool import tool_error
from pkmcal.mechanisms import Machine


@dataclass(frozen=True)
class MachineErrors:
    """Errors of a machine against a reference machine, frames aligned; m and rad.

    T_base, T_platform : (4, 4) from its base and platform frame to those of the reference.
    base, platform : (L, 3) errors of the joint centres.
    offset : (k,) errors of the readings' offsets, in the order of the parameters.
    position, orientation : (n,) distance of the platform's origins and angle between the platforms
    at the same readings; NaN where one of the two machines has no pose.
    """

    T_base: Array
    T_platform: Array
    base: Array
    platform: Array
    offset: Array
    position: Array
    orientation: Array

    __repr__ = short_repr

    @property
    def centre(self) -> Array:
        """Distances (2L,) of the joint centres, base first, m."""
        return np.linalg.norm(np.concatenate([self.base, self.platform]), axis=-1)


def compare(
    machine: Machine, known: Machine, joints: Array, *, legs_observed: bool = True
) -> MachineErrors:
    """Errors of a machine against a reference machine of the same nominal model.

    Parameters
    ----------
    machine, known :
        The machine, and the reference machine.
    joints :
        Readings (n, m), m or rad, at which platform poses are compared.
    legs_observed :
        False where a board or a tracker observed the platform and no legs were measured: the joint
        centres are then unidentifiable, and frames are aligned by the poses besides.

    Raises
    ------
    pkmcal.errors.InputError
        The two machines have different parameters.
    """
    if machine.parameters.names != known.parameters.names:
        raise InputError(
            "these are two different machines",
            found=f"{machine.name}, {machine.n_legs} legs, {len(machine.parameters)} parameters",
            expected=f"{known.name}, {known.n_legs} legs, {len(known.parameters)} parameters",
            next_step="Compare machines of one nominal model",
            code="difference.machines",
        )
    # two exact machines: the covariances of centres and tool are not used
    joints = np.asarray(joints, dtype=float)
    nothing = np.zeros((len(known.parameters), len(known.parameters)))
    base, platform = joint_centres(machine, known, nothing)
    # poses by the frames of the joint centres, or of the poses themselves
    poses = known.forward(joints)
    tool = tool_error(machine, known, nothing, poses, joints, legs_observed=legs_observed)
    return MachineErrors(
        T_base=base.T_calibrated_nominal,
        T_platform=platform.T_calibrated_nominal,
        base=-base.change,
        platform=-platform.change,
        offset=(machine.values - known.values)[known.parameters.of_kind("offset")],
        position=tool.off_position,
        orientation=tool.off_orientation,
    )
