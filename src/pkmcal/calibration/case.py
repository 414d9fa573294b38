"""What is known of a session before its edges are measured: where everything stands."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from pkmcal.arrays import Array
from pkmcal.boards.views import Boards
from pkmcal.identify.bundle import MarginalPrior
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms import Machine
from pkmcal.observe.image_batches import Photographs
from pkmcal.outcome.finding import Finding
from pkmcal.session.load import Session


class PriorScene(NamedTuple):
    """The machine, T_camera_base (S, 4, 4) of the stations, NaN where one is not known, and
    T_base_platform (K, 4, 4) of the configurations.

    Of photographs by hand that have told the machine: edges, the silhouettes found in each, by its
    station; told, what they and the drawing know of the machine together; scatter, by how much more
    or less these edges scatter than each says. findings : notes on places that could not be tested.
    """

    machine: Machine
    T_camera_base: Array
    T_base_platform: Array
    edges: Mapping[int, EdgeSet] = MappingProxyType({})
    prior: MarginalPrior | None = None
    scatter: float = 1.0
    findings: tuple[Finding, ...] = ()

    @classmethod
    def as_drawn(cls, machine: Machine, T_camera_base: Array, joints: Array) -> PriorScene:
        """A drawing; of platforms the nearest poses, where it does not quite close."""
        return cls(machine, T_camera_base, machine.forward_result(joints).T_base_platform)


class Case(NamedTuple):
    """A session, the photographs of its stations that observe legs, the boards in all, and what is
    known of machine, stations and platforms.
    """

    session: Session
    photographs: list[Photographs]
    boards: Boards
    scene: PriorScene
