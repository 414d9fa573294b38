"""How far a machine is from one that is known, such as a simulation's truth.

Frames are conventions: the same machine told in frames of which the one stands elsewhere has other
numbers, and its poses differ by the frames alone. So its base and platform are laid over the known
machine's by all joint centres ([B] eq. 15), and what is left is an error.
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
    """A machine less the known one, its frames laid over the known one's; m and rad.

    T_base, T_platform : (4, 4) from its base and platform frame to the known machine's. base,
    platform : (L, 3) of the joint centres. offset : (k,) of the readings' zeros, in the order of
    the parameters. position, orientation : (n,) how far the platform's origin is off, and how far
    it is turned, at the same readings; NaN where one of the two has no pose.
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
        """(2L,) distances of the joint centres, base first, m."""
        return np.linalg.norm(np.concatenate([self.base, self.platform]), axis=-1)


def compare(
    machine: Machine, known: Machine, joints: Array, *, legs_observed: bool = True
) -> MachineErrors:
    """Errors of a machine against a known one of the same drawing.

    Parameters
    ----------
    machine, known :
        The machine, and the one that is known.
    joints :
        Readings (n, m), m or rad, at which platform poses are compared.
    legs_observed :
        False where a board or a tracker observed the platform and no legs were seen: the joints'
        places are then unidentifiable, and frames are aligned by the poses besides.

    Raises
    ------
    pkmcal.errors.InputError
        The two are not of one drawing.

    """
    if machine.parameters.names != known.parameters.names:
        raise InputError(
            "these are two different machines",
            found=f"{machine.name}, {machine.n_legs} legs, {len(machine.parameters)} parameters",
            expected=f"{known.name}, {known.n_legs} legs, {len(known.parameters)} parameters",
            next_step="Compare machines of one drawing",
        )
    joints = np.asarray(joints, dtype=float)
    nothing = np.zeros((len(known.parameters), len(known.parameters)))
    base, platform = joint_centres(machine, known, nothing)
    poses = known.forward(joints)
    tool = tool_error(machine, known, nothing, poses, joints, legs_observed=legs_observed)
    return MachineErrors(
        T_base=base.T_calibrated_drawing,
        T_platform=platform.T_calibrated_drawing,
        base=-base.change,
        platform=-platform.change,
        offset=(machine.values - known.values)[known.parameters.of_kind("offset")],
        position=tool.off_position,
        orientation=tool.off_orientation,
    )
