"""State of the joint estimate: the values of all unknowns of one session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.identify.unknowns import Unknowns


@dataclass(frozen=True)
class State:
    """Values of all unknowns.

    theta : (P,) machine parameters.
    T_camera_base : (S, 4, 4).
    T_base_platform : (K, 4, 4).
    columns : numbers (n,) of the effects on measurements by code, as changes from the values with
        which the measurements were made; zero where a code is missing.
    T_mount : (M, 4, 4) boards in the frame of their body, T_base_board or T_platform_board by
        ``on_platform`` (M,).
    internal : (K, n) angles of the hinges of an articulated platform.
    """

    theta: Array
    T_camera_base: Array
    T_base_platform: Array
    columns: Mapping[str, Array] = field(default_factory=dict)
    T_mount: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    on_platform: Booleans = field(default_factory=lambda: np.zeros(0, dtype=bool))
    internal: Array = field(default_factory=lambda: np.zeros((0, 0)))

    __repr__ = short_repr


def estimated_unknowns(state: State) -> Unknowns:
    """Unknowns of results: all parameters, stations and mounts."""
    return Unknowns(state.theta.size, len(state.T_camera_base), n_mounts=len(state.T_mount))
