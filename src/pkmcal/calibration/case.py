"""A session with its images and boards, and the scene from which its estimate starts."""

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
    """What an estimate starts from: machine, stations and platform poses.

    T_camera_base : (S, 4, 4), NaN for stations without a pose. T_base_platform : (K, 4, 4). After
    hand-held images have been placed: edges, the silhouettes measured in each, by station; prior,
    the information of these images and the nominal model on the machine, all else marginalized;
    scatter, ratio of these edges' scatter to their stated noise. findings : notes on poses that
    could not be tested.
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
        """The scene of the nominal model; nearest platform poses where loops do not quite close."""
        return cls(machine, T_camera_base, machine.forward_result(joints).T_base_platform)


class Case(NamedTuple):
    """A session, the images of its stations that observe legs, the boards in all images, and the
    prior scene.
    """

    session: Session
    photographs: list[Photographs]
    boards: Boards
    scene: PriorScene
